"""Raw exports of a trial to tables on one clock: markers, poses, joints, robot, and what was found."""

from __future__ import annotations

import difflib
import json
from collections.abc import Collection, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from real2sim import geometry, signals
from real2sim.artefacts import read_json, write_json
from real2sim.configuration import check_lab_axes
from real2sim.errors import InputError
from real2sim.files import replacing
from real2sim.provenance import sha256
from real2sim.recording import alignment, missing_marker, units
from real2sim.recording.findings import warnings_by_code
from real2sim.recording.formats.detect import read_log, read_markerless, read_markers
from real2sim.recording.formats.opensim import PELVIS_COORDINATES, is_translation
from real2sim.recording.formats.recordings import CoordinateRecording, Finding, MarkerRecording, RobotLog
from real2sim.recording.formats.robot_log import ARM_JOINTS
from real2sim.recording.formats.stamps import large_delays
from real2sim.recording.landmarks import missing_of_pelvis, name_landmarks, pelvis_of_landmarks
from real2sim.recording.quality import markers
from real2sim.recording.standing import check_standing
from real2sim.recording.subjects import SUBJECT_FILE, TrialFiles, parse_trial, read_subject

if TYPE_CHECKING:
    from real2sim.settings import IngestSettings

OUR_MARKERS = (*geometry.PELVIS_MARKERS, *geometry.INTERFACE_MARKERS, "LHEE", "RHEE", "LTOE", "RTOE")
WRENCH = ("wrench_fx", "wrench_fy", "wrench_fz", "wrench_tx", "wrench_ty", "wrench_tz")
_XYZ = ("x", "y", "z")
_TRANSLATIONAL = {"tx", "ty", "tz"}

# Columns of a table by name: values (n,), unit and frame
Columns = dict[str, tuple[np.ndarray, str, str]]


@dataclass
class _Trial:
    """Data that the steps of one trial share."""

    subject: str
    name: str
    phantom: bool
    settings: IngestSettings
    tsv: Path
    mot: Path
    log: Path | None
    findings: list[Finding]
    # names under markers: in subject.yaml that no file of the trial has, as far as they have been read
    absent: set[str]

    def note(self, code: str, severity: str, path: Path, place: str, message: str, action: str) -> None:
        self.findings.append(Finding(code, severity, path.name, place, message, action))


# -------------------- markers


def _load_markers(trial: _Trial, marker_names: dict[str, str]) -> MarkerRecording:
    """Markers by our names in the world frame, gated."""
    recording = read_markers(trial.tsv)
    trial.findings.extend(recording.findings)
    _check_rate(trial, recording.rate_hz)
    trial.absent -= recording.positions.keys()
    positions: dict[str, np.ndarray] = {}
    for lab, values in recording.positions.items():
        ours = marker_names.get(lab, lab)
        if ours in positions:
            found = f"two markers that are {ours}"
            raise InputError(
                trial.tsv, "MARKER_NAMES", found, "one", "correct markers: in subject.yaml", "names"
            )
        positions[ours] = values
    others = [name for name in positions if name not in OUR_MARKERS]
    if others:
        listed = ", ".join(others[:8]) + (", ..." if len(others) > 8 else "")
        trial.note("other_markers", "info", trial.tsv, "MARKER_NAMES", listed, "not used")
    required = _required_markers(trial, recording.positions, marker_names)
    rotation = lab_to_world(trial.settings["lab_to_world"])
    labelled = {name: positions[name] @ rotation.T for name in OUR_MARKERS if name in positions}
    used = markers.without_unseen(labelled, required)
    if len(used) < len(labelled):
        listed = ", ".join(sorted(labelled.keys() - used.keys()))
        trial.note(
            "marker_unseen", "info", trial.tsv, listed, "labelled and never seen", "taken as not there"
        )
    jump_m = trial.settings["max_marker_jump_m"]
    frozen = markers.find_frozen(used, **trial.settings["frozen"], jump_m=jump_m)
    for gap in frozen:
        place = f"{gap.marker}, rows {gap.start + 1} to {gap.stop}"
        message = f"the same coordinates in {gap.stop - gap.start} frames while other markers move"
        trial.note("marker_frozen", "warning", trial.tsv, place, message, "taken as not seen")
    used = markers.without_frozen(used, frozen)
    _check_extent(trial, used)
    for name in required:
        _check_complete(trial, name, used[name])
    _check_jumps(trial, used)
    return MarkerRecording(recording.time_s, recording.rate_hz, used, recording.first_frame)


def _required_markers(trial: _Trial, own: Collection[str], marker_names: dict[str, str]) -> list[str]:
    """Our names of the markers that a trial needs; InputError where one is not among ``own``, the file's names."""
    required = markers.needed(parse_trial(trial.name)[0])
    there = {marker_names.get(name, name) for name in own}
    missing = [name for name in required if name not in there]
    if missing:
        found = f"markers {', '.join(own)}"
        mapped = {lab: ours for lab, ours in marker_names.items() if ours in missing}
        remedy = "label it in QTM, or say which of the lab's names it is under markers: in subject.yaml"
        if mapped:
            remedy = f"correct markers: in subject.yaml: {'; '.join(_absent_name(*m, own) for m in mapped.items())}"
        raise InputError(
            trial.tsv, f"marker {', '.join(missing)}", found, ", ".join(required), remedy, "marker_missing"
        )
    return required


def _absent_name(lab: str, ours: str, own: Collection[str]) -> str:
    """Return that a name of subject.yaml is not in the file, and the nearest that is."""
    lowered = {name.lower(): name for name in own}
    near = difflib.get_close_matches(lab.lower(), lowered, 1)
    meant = f"; did you mean {lowered[near[0]]}?" if near else ""
    return f"{lab}, which is to be {ours}, is no marker of this file{meant}"


def lab_to_world(axes: Mapping[str, Any]) -> np.ndarray:
    """Rotation (3, 3) from lab to world axes, of e.g. ``{x: "+x", y: "+y", z: "+z"}``: world axis, lab axis.

    Raises InputError unless the result is a right-handed set of axes.
    """
    check_lab_axes(axes, "the configuration")
    rotation = np.zeros((3, 3))
    for row, axis in enumerate(_XYZ):
        sign, lab = axes[axis]
        rotation[row, _XYZ.index(lab)] = float(f"{sign}1")
    return rotation


def _check_rate(trial: _Trial, rate_hz: float) -> None:
    """Refuse markers whose rate is too low for the low-pass, which would then leave all noise in them."""
    cutoff = trial.settings["cutoff_hz"]
    if cutoff >= rate_hz / 2:
        found = f"markers at {rate_hz:g} Hz, which no low-pass at {cutoff:g} Hz (ingest.cutoff_hz) can filter"
        remedy = "Export at the rate of the cameras, or lower ingest.cutoff_hz."
        expected = f"more than {2 * cutoff:g} Hz"
        raise InputError(trial.tsv, "", found, expected, remedy, "rate_below_cutoff")


def _check_extent(trial: _Trial, positions: dict[str, np.ndarray]) -> None:
    """Refuse files that are not in millimetres, by the size of what was recorded."""
    low, high = trial.settings["units"]["marker_extent_m"]
    cloud = np.concatenate(list(positions.values()))
    if not np.isfinite(cloud).any():
        remedy = "label the trajectories in QTM and export again"
        raise InputError(trial.tsv, "", "no marker is ever seen", "positions", remedy, "no_data")
    extent = float(np.max(np.nanmax(cloud, axis=0) - np.nanmin(cloud, axis=0)))
    if low <= extent <= high:
        return
    found = f"markers that span {extent:.3g} m in the unit of the file: {units.guess_unit(extent, low, high)}"
    remedy = "export again from QTM, which writes millimetres (C3D: in the unit that POINT:UNITS says)"
    raise InputError(trial.tsv, "", found, f"{low:g} to {high:g} m", remedy, "extent")


def _check_complete(trial: _Trial, name: str, values: np.ndarray) -> None:
    good = signals.known(values)
    if good.mean() >= trial.settings["min_complete"]:
        return
    gaps = signals.segments(~good)
    longest = max(gap.stop - gap.start for gap in gaps)
    found = f"missing in {100 * (1 - good.mean()):.0f} % of {len(good)} frames, longest gap {longest} frames"
    expected = f"at most {100 * (1 - trial.settings['min_complete']):.0f} % missing"
    remedy = "fill or relabel the marker in QTM, or name the trial under exclude: in subject.yaml"
    raise InputError(trial.tsv, f"marker {name}", found, expected, remedy, "incomplete")


def _check_jumps(trial: _Trial, positions: dict[str, np.ndarray]) -> None:
    limit = trial.settings["max_marker_jump_m"]
    for name, values in positions.items():
        jump = np.linalg.norm(np.diff(values, axis=0), axis=1)
        jumps = np.flatnonzero(np.nan_to_num(jump) > limit)
        if len(jumps):
            largest = jumps[np.argmax(jump[jumps])]
            message = f"{len(jumps)} jumps, the largest {1e3 * jump[largest]:.0f} mm between frames"
            trial.note("marker_jump", "warning", trial.tsv, f"{name}, row {largest + 1}", message, "kept")


def _repair_swaps(
    trial: _Trial, recording: MarkerRecording, reference: dict[str, Any] | None
) -> tuple[MarkerRecording, float | None]:
    """Labels exchanged back where that is unambiguous; and the distance of the interface markers [m] at rest."""
    if reference is None:
        rigid = markers.reference_distances(recording.positions)
    else:
        local = {name: np.array([place]) for name, place in reference["pelvis_geometry"].items()}
        rigid = markers.reference_distances(local)
        rigid[-1] = reference.get("interface_width_m") or np.nan
    swaps = markers.find_swaps(recording.positions, rigid, **trial.settings["swap"])
    for swap in swaps:
        place = f"{swap.first} and {swap.second}, rows {swap.start + 1} to {swap.stop}"
        message = f"labels exchanged over {swap.stop - swap.start} frames"
        beside = " and ".join(f"{start + 1} to {stop}" for start, stop in swap.unsure)
        action = f"exchanged back; unknown over rows {beside}" if beside else "exchanged back"
        trial.note("marker_swap", "warning", trial.tsv, place, message, action)
        share = (swap.stop - swap.start) / len(recording.time_s)
        if reference is not None and share >= trial.settings["min_complete"]:
            pair, message = f"{swap.first} and {swap.second}", "exchanged throughout, against neutral"
            trial.note("marker_swap_whole", "warning", trial.tsv, pair, message, "exchanged back")
    positions = recording.positions | (markers.repaired(recording.positions, swaps) if swaps else {})
    width = float(rigid[-1]) if np.isfinite(rigid[-1]) else None
    return MarkerRecording(recording.time_s, recording.rate_hz, positions, recording.first_frame), width


def _filter_markers(
    trial: _Trial, recording: MarkerRecording
) -> tuple[np.ndarray, dict[str, np.ndarray], dict[str, np.ndarray], dict[str, Any]]:
    """Clock [s], filtered positions, flags where filled, and figures per marker."""
    settings, rate = trial.settings, recording.rate_hz
    frames = len(recording.time_s)
    # Frame 1 is time 0 of the Qualisys clock, also in a cropped export; the Time column is rounded.
    time_s = (recording.first_frame - 1 + np.arange(frames)) / rate
    clock = signals.common_clock(time_s[0], time_s[-1], settings["rate_hz"])
    nearest = np.clip(np.rint((clock - time_s[0]) * rate).astype(int), 0, frames - 1)
    positions, flags, report = {}, {}, {}
    for name, raw in recording.positions.items():
        filled, flag = signals.fill_gaps(raw, rate, settings["max_gap_s"])
        smooth = signals.lowpass(filled, rate, settings["cutoff_hz"], settings["filter_order"])
        positions[name] = signals.resample(time_s, smooth, clock)
        masked = np.isnan(filled[:, 0])
        flags[name] = flag[nearest] & np.isfinite(positions[name][:, 0])
        report[name] = {
            "complete": float(signals.known(raw).mean()),
            "gaps_filled": len(signals.segments(flag)),
            "samples_filled": int(flag.sum()),
            "gaps_masked": len(signals.segments(masked)),
            "samples_masked": int(masked.sum()),
            "noise_sd_m": _noise(raw),
        }
        for gap in signals.segments(masked):
            span = f"{name}, {time_s[gap.start]:.2f} to {time_s[gap.stop - 1]:.2f} s"
            message = f"{gap.stop - gap.start} samples, more than {settings['max_gap_s']:g} s or at an end"
            trial.note("gap_masked", "warning", trial.tsv, span, message, "masked, left out of the cost")
    return clock, positions, flags, report


def _noise(values: np.ndarray) -> list[float] | None:
    """SD [m] of the noise per axis by second differences, which movement hardly enters; 6 is their gain."""
    second = np.diff(values, 2, axis=0)
    second = second[signals.known(second)]
    return [float(x) for x in np.sqrt(np.mean(second**2, axis=0) / 6)] if len(second) else None


def _standing_noise(recording: MarkerRecording) -> dict[str, list[float]]:
    """SD [m] per marker and axis of quiet standing, after a straight line is taken out."""
    out = {}
    for name, values in recording.positions.items():
        good = signals.known(values)
        if good.sum() < 3:  # nothing is left beside a straight line
            continue
        t = np.linspace(-1, 1, len(good))[good]
        line = np.polynomial.polynomial.polyfit(t, values[good], 1)
        residual = values[good] - np.polynomial.polynomial.polyval(t, line).T
        out[name] = [float(x) for x in residual.std(axis=0)]
    return out


# -------------------- poses


def _pelvis_geometry(positions: dict[str, np.ndarray]) -> dict[str, list[float]]:
    """The four pelvis markers in the pelvis frame [m], averaged over samples at which all are there."""
    points = np.stack([positions[name] for name in geometry.PELVIS_MARKERS], axis=1)
    places = missing_marker.places_in_pelvis(points)
    return dict(zip(geometry.PELVIS_MARKERS, places.tolist(), strict=True))


def _pelvis(
    trial: _Trial, clock: np.ndarray, positions: dict[str, np.ndarray], model: dict[str, list[float]]
) -> tuple[np.ndarray, np.ndarray]:
    """Pelvis rotation (n, 3, 3) and origin (n, 3); one missing marker is rebuilt from the other three."""
    points = np.stack([positions[name] for name in geometry.PELVIS_MARKERS], axis=1)
    there = np.isfinite(points).all(axis=2)
    reference = np.array([model[name] for name in geometry.PELVIS_MARKERS])
    for i, name in enumerate(geometry.PELVIS_MARKERS):
        alone = ~there[:, i] & (there.sum(axis=1) == 3)
        if not alone.any():
            continue
        runs = signals.segments(alone)
        filled = missing_marker.put_back(points, there, reference, i, runs, trial.settings["skin"])
        points[alone, i] = filled[alone]
        for run in runs:
            span = f"{name}, {clock[run.start]:.2f} to {clock[run.stop - 1]:.2f} s"
            message = f"{run.stop - run.start} samples of the pelvis pose without this marker"
            action = "rebuilt from the other three, and from how skin carries it along in this trial"
            trial.note("pelvis_rebuilt", "warning", trial.tsv, span, message, action)
    return geometry.pelvis_frame(*np.moveaxis(points, 1, 0))


def _rest(r: np.ndarray, p: np.ndarray, trial: _Trial) -> dict[str, Any]:
    good = np.isfinite(r).all(axis=(1, 2)) & signals.known(p)
    if not good.any():
        found = "no sample with pelvis and interface"
        raise InputError(
            trial.tsv, "", found, "quiet standing with all markers", "record neutral again", "pelvis_unknown"
        )
    rotation = geometry.mean_rotation(r[good])
    return {"rotation": rotation.tolist(), "position": p[good].mean(axis=0).tolist()}


# -------------------- markerless


def _joints(
    trial: _Trial, clock: np.ndarray, r_pelvis: np.ndarray, p_pelvis: np.ndarray, marker_names: dict[str, str]
) -> tuple[Columns, dict[str, Any]]:
    """Coordinates, or landmarks, on the Qualisys clock, and how time and space were laid on each other."""
    named = trial.settings["markerless"]
    recording = read_markerless(trial.mot, translations=named["translations"], rotations=named["rotations"])
    trial.findings.extend(recording.findings)
    if isinstance(recording, CoordinateRecording):
        units.check_kinds(trial.mot, recording)
        units.check_angles(trial.mot, recording, trial.settings["units"])
        kind, columns, pelvis = "coordinates", recording.columns, _coordinate_pelvis(trial, recording)
    else:
        kind = "landmarks"
        columns, pelvis = _landmarks(trial, recording, marker_names)
    ours = alignment.PelvisPath(clock, r_pelvis, p_pelvis)
    units.check_thousands(trial.mot, ours, pelvis, trial.settings["units"], landmarks=kind == "landmarks")
    if isinstance(recording, CoordinateRecording):
        # landmarks have no angles that could be in another unit
        units.check_pelvis(trial.mot, recording, ours, pelvis, trial.settings["units"])
    time_fit, space_fit, drift = _fit_markerless(trial, clock, r_pelvis, p_pelvis, pelvis)
    synchronised = drift is not None
    lengths = (
        {*columns} if kind == "landmarks" else {*filter(is_translation, columns), *named["translations"]}
    )
    lengths -= {*named["rotations"]} if kind == "coordinates" else set()
    table = np.column_stack([v if name in lengths else _unwrapped(v) for name, v in columns.items()])
    gap = trial.settings["max_gap_s"]
    at = time_fit.other_time(clock)
    # column by column: what one coordinate lacks takes nothing from the others
    values = np.column_stack([signals.resample(recording.time_s, own, at, gap) for own in table.T])
    covered = np.isfinite(values).mean(axis=0)
    _note_what_is_missing(trial, dict(zip(columns, covered.tolist(), strict=True)))
    report = {
        "kind": kind,
        "offset_s": time_fit.offset_s,
        "offset_sd_s": time_fit.offset_sd_s if synchronised else None,
        "offset_at_s": time_fit.middle_s,
        "drift_ppm": 1e6 * time_fit.drift,
        "drift_estimate_ppm": drift[0] if drift else None,
        "drift_estimate_sd_ppm": drift[1] if drift else None,
        "correlation": time_fit.correlation,
        "synchronised": synchronised,
        "rotation": space_fit.rotation.tolist(),
        "translation_m": space_fit.translation.tolist(),
        "pelvis_frame_rotation": space_fit.body.tolist(),
        "pelvis_frame_lever_m": space_fit.lever.tolist(),
        "rms_m": space_fit.rms_m,
        "rms_deg": float(np.degrees(space_fit.rms_rad)),
        "from": "OpenSim ground in z-up axes (X, -Z, Y)",
        "to": "world",
        "covered": float(covered.max()),
    }
    return {
        name: (column, "m" if name in lengths else "rad", "opensim")
        for name, column in zip(columns, values.T, strict=True)
    }, report


def _unwrapped(angle: np.ndarray) -> np.ndarray:
    """Return an angle (n,) [rad] without jumps of a whole turn, as an export within 180 deg has them.

    What lies between samples is then no way across the whole range, and what reads the table sees no jump either.
    """
    out, known = angle.copy(), np.isfinite(angle)
    out[known] = np.unwrap(angle[known])
    return out


def _note_what_is_missing(trial: _Trial, covered: dict[str, float]) -> None:
    """Note coordinates or landmarks that are empty, or known over a part of the markers' time: shares by column."""
    empty = [name for name, share in covered.items() if share == 0]
    most = max(covered.values())
    if most < trial.settings["min_complete"]:
        message = f"known over {100 * most:.0f} % of the time of the markers"
        trial.note("markerless_part", "warning", trial.mot, "", message, "unknown elsewhere")
    if empty and most:
        message = f"{len(empty)} of {len(covered)} columns without a number"
        trial.note("column_empty", "warning", trial.mot, ", ".join(empty), message, "left empty")


def _coordinate_pelvis(trial: _Trial, recording: CoordinateRecording) -> alignment.PelvisPath:
    missing = [name for name in PELVIS_COORDINATES if name not in recording.columns]
    if missing:
        found = f"coordinates {', '.join(list(recording.columns)[:8])}, ..."
        expected, remedy = "the six of the pelvis", "export all coordinates of a full-body model (Rajagopal)"
        place = f"column {', '.join(missing)}"
        raise InputError(trial.mot, place, found, expected, remedy, "column_missing")
    return alignment.PelvisPath(recording.time_s, *alignment.pelvis_of_coordinates(recording.columns))


def _landmarks(
    trial: _Trial, recording: MarkerRecording, marker_names: dict[str, str]
) -> tuple[dict[str, np.ndarray], alignment.PelvisPath]:
    """Columns ``<landmark>_x/_y/_z`` [m, as in the file], and the pelvis of its four landmarks, z up."""
    trial.absent -= recording.positions.keys()
    points = name_landmarks(trial.mot, recording, marker_names, trial.settings["max_gap_s"])
    missing = missing_of_pelvis(points)
    if missing:
        found = f"landmarks {', '.join(list(points)[:8])}, ..."
        remedy = (
            "say which of its names they are under markers: in subject.yaml, or export coordinates (.mot)"
        )
        expected = "the four of the pelvis, to synchronise by"
        raise InputError(trial.mot, ", ".join(missing), found, expected, remedy, "column_missing")
    trial.note(
        "landmarks", "info", trial.mot, "", f"{len(points)} landmarks, no coordinates", "kept as positions"
    )
    columns = {f"{name}_{axis}": v[:, i] for name, v in points.items() for i, axis in enumerate(_XYZ)}
    return columns, pelvis_of_landmarks(recording.time_s, points)


def _fit_markerless(
    trial: _Trial,
    clock: np.ndarray,
    r_pelvis: np.ndarray,
    p_pelvis: np.ndarray,
    other: alignment.PelvisPath,
) -> tuple[alignment.TimeFit, alignment.SpaceFit, tuple[float, float] | None]:
    """Fits, and the drift with its standard error [ppm]; None where nothing could be synchronised.

    A drift is corrected only where it is large enough to matter and certain enough to be believed.
    """
    settings = trial.settings["markerless"]
    ours = alignment.PelvisPath(clock, r_pelvis, p_pelvis)
    _check_pelvises(trial, ours, other)
    offset, correlation = alignment.coarse_offset(ours, other)
    synchronised = correlation >= settings["min_correlation"]
    if not synchronised:
        offset = float(clock[0] - other.time_s[0])
        standing = trial.name == "neutral"
        message = f"correlation of pelvis speeds {correlation:.2f}: too little in common to synchronise by"
        message += ", as in any quiet standing" if standing else ""
        severity = "info" if standing else "warning"
        trial.note(
            "markerless_not_synchronised", severity, trial.mot, "", message, "starts laid on each other"
        )

    def fit(with_drift: bool) -> tuple[alignment.TimeFit, alignment.SpaceFit]:
        return alignment.align_pelvis(
            ours,
            other,
            offset_s=offset,
            correlation=correlation,
            with_time=synchronised,
            with_drift=with_drift,
        )

    if not synchronised:
        return *fit(False), None
    time_fit, space_fit = fit(True)
    drift = (1e6 * time_fit.drift, 1e6 * time_fit.drift_sd)
    limit = settings["drift_report_ms_per_min"] / 60e3
    if abs(time_fit.drift) > max(limit, settings["drift_certainty_sd"] * time_fit.drift_sd):
        message = f"{drift[0]:.0f} +- {drift[1]:.0f} ppm ({60e3 * time_fit.drift:.1f} ms/min)"
        trial.note("markerless_drift", "warning", trial.mot, "", message, "corrected")
        return time_fit, space_fit, drift
    return *fit(False), drift


def _check_pelvises(trial: _Trial, ours: alignment.PelvisPath, other: alignment.PelvisPath) -> None:
    """Refuse a markerless pelvis with gaps, and markers that never show the pelvis."""
    if len(other.time_s) < 10 or not (
        np.isfinite(other.position).all() and np.isfinite(other.rotation).all()
    ):
        found = f"{len(other.time_s)} rows, or missing values in the pelvis"
        raise InputError(
            trial.mot, "", found, "the pelvis throughout the trial", "export the trial again", "pelvis_gaps"
        )
    if not (np.isfinite(ours.rotation).all(axis=(1, 2)) & signals.known(ours.position)).any():
        raise InputError(
            trial.tsv,
            "",
            "no sample with a pelvis pose",
            "the pelvis",
            "relabel the markers in QTM",
            "pelvis_unknown",
        )


# -------------------- robot


def _robot(
    trial: _Trial, clock: np.ndarray, positions: dict[str, np.ndarray], log: RobotLog | None
) -> tuple[dict[str, np.ndarray], np.ndarray | None, dict[str, Any]]:
    """Robot columns on the Qualisys clock, the arm's up axis (n, 3) in the world, the report."""
    names = [*(f"base_{c}" for c in ("x", "y", "yaw", "vx", "vy", "wz")), *ARM_JOINTS]
    names += [f"{joint}_rate" for joint in ARM_JOINTS]
    if trial.log is None:
        trial.note("no_robot_log", "info", trial.tsv, "", "no robot log", "robot columns empty")
        return {name: np.full(len(clock), np.nan) for name in names}, None, {"status": "no robot log"}
    gap = trial.settings["max_gap_s"]
    if log is None:
        log = read_log(trial.log, trial.settings["robot_log"]["stamps"], gap)
    trial.findings.extend(log.findings)
    _check_log(trial.log, log, trial.settings["robot_log"]["least_s"], gap)
    units.check_log(trial.log, log, trial.settings["units"])
    offset, report = _synchronise_log(trial, clock, positions, log)
    report["stamp_delay_s"] = _stamp_delays(trial, trial.log, log)
    base_time, base = _unique(trial, log.base_time_s, np.column_stack(list(log.base.values())), "/odom")
    joints = np.column_stack([log.joints[j] for j in ARM_JOINTS])[:, [0, 2, 4, 1, 3, 5]]
    joint_time, joints = _unique(trial, log.joint_time_s, joints, "/joint_states")
    other = clock - offset
    position = signals.resample(joint_time, joints[:, :3], other, gap)
    if np.isfinite(joints[:, 3:]).all():
        rates = signals.resample(joint_time, joints[:, 3:], other, gap)
    else:
        rates = signals.derivative(position, trial.settings["rate_hz"])
        trial.note(
            "joint_rates", "info", trial.log, "/joint_states", "no velocities", "derived from positions"
        )
    table = np.hstack([signals.resample(base_time, base, other, gap), position, rates])
    columns = dict(zip(names, table.T, strict=True))
    if log.wrench is not None and log.wrench_time_s is not None:
        wrench_time, wrench = _unique(trial, log.wrench_time_s, log.wrench, "/interface/wrench")
        columns |= dict(zip(WRENCH, signals.resample(wrench_time, wrench, other, gap).T, strict=True))
    up = _arm_up(trial, columns, positions, report)
    return columns, up, report


def _check_log(path: Path, log: RobotLog, least_s: float, max_gap_s: float) -> None:
    """Refuse a log whose base and arm are not both there for a while at the same time, or come too rarely."""
    base, arm = log.base_time_s, log.joint_time_s
    together = min(base[-1], arm[-1]) - max(base[0], arm[0]) if len(base) and len(arm) else 0.0
    if together >= least_s:
        for topic, time_s in (("/odom", base), ("/joint_states", arm)):
            period = float(np.median(np.diff(time_s)))
            if period > max_gap_s:
                found = f"a message every {period:.3g} s"
                expected = f"one in {max_gap_s:g} s at least (ingest.max_gap_s)"
                remedy = "record the topic at a higher rate, or remove the log: a trial may have none"
                raise InputError(path, f"topic {topic}", found, expected, remedy, "log_rate")
        return
    found = f"{len(base)} messages of /odom and {len(arm)} of /joint_states, together for {max(together, 0.0):.2f} s"
    expected = f"both for at least {least_s:g} s (ingest.robot_log.least_s)"
    remedy = "record the log over the whole trial, or take the file away: a trial may be without one"
    raise InputError(path, "", found, expected, remedy, "log_too_short")


def _stamp_delays(trial: _Trial, path: Path, log: RobotLog) -> dict[str, dict[str, float]]:
    """Median and spread [s] of the delay from stamp to log time by topic; warn where one is large."""
    trial.findings += large_delays(path, log.delays, trial.settings["robot_log"]["stamps"])
    return {
        topic: {"median": delay.median_s, "beyond_clock": delay.beyond_clock_s, "spread": delay.spread_s}
        for topic, delay in log.delays.items()
    }


def _unique(
    trial: _Trial, time_s: np.ndarray, table: np.ndarray, topic: str
) -> tuple[np.ndarray, np.ndarray]:
    """Drop messages with the time of their predecessor."""
    keep = np.concatenate([[True], np.diff(time_s) > 0])
    if not keep.all() and trial.log is not None:
        message = f"{int((~keep).sum())} messages with the time of the one before"
        trial.note("same_time", "warning", trial.log, topic, message, "left out")
    return time_s[keep], table[keep]


def _synchronise_log(
    trial: _Trial, clock: np.ndarray, positions: dict[str, np.ndarray], log: RobotLog
) -> tuple[float, dict[str, Any]]:
    assert trial.log is not None
    if log.sync_s is not None and len(log.sync_s):
        if len(log.sync_s) > 1:
            message = f"{len(log.sync_s)} rising edges"
            trial.note("sync_edges", "warning", trial.log, "/sync", message, "the first is used")
        offset = -float(log.sync_s[0])
        return offset, {"status": "synchronised by /sync", "offset_s": offset}
    if not set(geometry.INTERFACE_MARKERS) <= set(positions):
        found = "neither a rising edge of /sync nor the markers IF_L and IF_R"
        raise InputError(
            trial.log, "", found, "one of them", "record /sync, or remove the log", "no_synchronisation"
        )
    fit = _fit_log(trial, clock, positions, log)
    if fit.correlation < trial.settings["robot_log"]["min_correlation"]:
        # At rest there is nothing to go by, and nothing that an offset would change.
        offset = float(clock[0])
        message = f"correlation {fit.correlation:.2f} of interface and robot motion"
        severity = "info" if trial.name == "neutral" else "warning"
        trial.note("robot_not_synchronised", severity, trial.log, "", message, "starts laid on each other")
        return offset, {"status": "not synchronised", "offset_s": offset, "correlation": fit.correlation}
    report = {"status": "synchronised by motion", "offset_s": fit.offset_s}
    return fit.offset_s, report | {"offset_sd_s": fit.offset_sd_s, "correlation": fit.correlation}


def _fit_log(
    trial: _Trial, clock: np.ndarray, positions: dict[str, np.ndarray], log: RobotLog
) -> alignment.TimeFit:
    """Offset by the rates of yaw and roll of the line between the interface markers.

    They are those of base and arm in every z-up frame and whatever the arm's geometry; its height is not, because
    pitch moves the interface up and down.
    """
    rate = trial.settings["rate_hz"]
    across = positions["IF_L"] - positions["IF_R"]
    heading = np.arctan2(-across[:, 0], across[:, 1])
    good = np.isfinite(heading)
    heading[good] = np.unwrap(heading[good])
    roll = np.arctan2(across[:, 2], np.hypot(across[:, 0], across[:, 1]))
    ours = signals.derivative(np.column_stack([heading, roll]), rate)
    base_time, yaw = _unique(trial, log.base_time_s, log.base["yaw"][:, None], "/odom")
    joint_time, arm_roll = _unique(trial, log.joint_time_s, log.joints["arm_roll"][:, :1], "/joint_states")
    start, end = max(base_time[0], joint_time[0]), min(base_time[-1], joint_time[-1])
    grid = np.arange(start, end, 1 / rate)
    angles = np.hstack([signals.resample(base_time, yaw, grid), signals.resample(joint_time, arm_roll, grid)])
    other = signals.derivative(angles, rate)
    return alignment.align_signals(clock, ours, grid, other)


def _arm_up(
    trial: _Trial, columns: dict[str, np.ndarray], positions: dict[str, np.ndarray], report: dict[str, Any]
) -> np.ndarray | None:
    """The arm's up axis (n, 3) in the world, the odometry's heading laid on that of the interface markers."""
    if not set(geometry.INTERFACE_MARKERS) <= set(positions):
        return None
    across = positions["IF_L"] - positions["IF_R"]
    difference = np.arctan2(-across[:, 0], across[:, 1]) - columns["base_yaw"]
    phasor = np.exp(1j * difference[np.isfinite(difference)])
    if not len(phasor):
        found = "no time at which both markers and robot log are there"
        remedy = "check that log and export belong to one trial, and the /sync signal"
        raise InputError(trial.log or trial.tsv, "", found, "an overlap", remedy, "no_overlap")
    yaw_offset = float(np.angle(phasor.mean()))
    spread = np.angle(phasor * np.exp(-1j * yaw_offset))
    report["yaw_odom_to_world_rad"] = yaw_offset
    report["yaw_rms_rad"] = float(np.sqrt(np.mean(spread**2)))
    yaw = columns["base_yaw"] + yaw_offset
    roll, pitch = columns["arm_roll"], columns["arm_pitch"]
    # Rz(yaw) Rx(roll) Ry(pitch) applied to z
    x, y, z = np.sin(pitch), -np.sin(roll) * np.cos(pitch), np.cos(roll) * np.cos(pitch)
    return np.column_stack([np.cos(yaw) * x - np.sin(yaw) * y, np.sin(yaw) * x + np.cos(yaw) * y, z])


# -------------------- files


def _write_table(path: Path, trial: _Trial, columns: Columns, extra: dict[str, Any]) -> None:
    """Parquet with unit and frame per column; ``columns`` maps a name to values, unit, frame."""
    import pyarrow
    import pyarrow.parquet

    fields = [
        pyarrow.field(
            name,
            pyarrow.bool_() if values.dtype == bool else pyarrow.float64(),
            metadata={"unit": unit, "frame": frame},
        )
        for name, (values, unit, frame) in columns.items()
    ]
    about = {"subject": trial.subject, "trial": trial.name, "phantom": trial.phantom, **extra}
    schema = pyarrow.schema(fields, metadata={"real2sim": json.dumps(about, allow_nan=False)})
    table = pyarrow.Table.from_arrays([_arrow(values) for values, _, _ in columns.values()], schema=schema)
    with replacing(path) as temporary:
        pyarrow.parquet.write_table(table, temporary, compression="zstd")


def _arrow(values: np.ndarray) -> Any:
    """Arrow array by its buffer: pyarrow.array() would import pandas, which costs more than a trial."""
    import pyarrow

    if values.dtype == bool:
        buffer = np.packbits(values, bitorder="little")
        return pyarrow.Array.from_buffers(pyarrow.bool_(), len(values), [None, pyarrow.py_buffer(buffer)])
    buffer = np.ascontiguousarray(values, float)
    return pyarrow.Array.from_buffers(pyarrow.float64(), len(values), [None, pyarrow.py_buffer(buffer)])


def _marker_columns(
    clock: np.ndarray, positions: dict[str, np.ndarray], flags: dict[str, np.ndarray]
) -> Columns:
    columns: Columns = {"time_s": (clock, "s", "qualisys")}
    for name, values in positions.items():
        columns |= {f"{name}_{axis}": (values[:, i], "m", "world") for i, axis in enumerate(_XYZ)}
        columns[f"{name}_filled"] = (flags[name], "", "")
    return columns


def _pose_columns(
    clock: np.ndarray, poses: dict[str, tuple[np.ndarray, np.ndarray]], q: np.ndarray, rate_hz: float
) -> Columns:
    columns: Columns = {"time_s": (clock, "s", "qualisys")}
    for name, (rotation, origin) in poses.items():
        columns |= {f"{name}_{axis}": (origin[:, i], "m", "world") for i, axis in enumerate(_XYZ)}
        quaternion = geometry.quaternion(rotation)
        columns |= {f"{name}_q{c}": (quaternion[:, i], "1", "world") for i, c in enumerate("wxyz")}
    rates = signals.derivative(q, rate_hz)
    units = ["m" if axis in _TRANSLATIONAL else "rad" for axis in geometry.AXES]
    columns |= {f"q_{a}": (q[:, i], units[i], "interface") for i, a in enumerate(geometry.AXES)}
    columns |= {f"qd_{a}": (rates[:, i], f"{units[i]}/s", "interface") for i, a in enumerate(geometry.AXES)}
    return columns


_ROBOT_UNITS = {
    "base_x": ("m", "odom"),
    "base_y": ("m", "odom"),
    "base_yaw": ("rad", "odom"),
    "base_vx": ("m/s", "base"),
    "base_vy": ("m/s", "base"),
    "base_wz": ("rad/s", "base"),
    "arm_lift": ("m", "base"),
    "arm_roll": ("rad", "base"),
    "arm_pitch": ("rad", "base"),
    "arm_lift_rate": ("m/s", "base"),
    "arm_roll_rate": ("rad/s", "base"),
    "arm_pitch_rate": ("rad/s", "base"),
} | {name: ("N" if "_f" in name else "N m", "sensor") for name in WRENCH}


def _robot_columns(robot: dict[str, np.ndarray]) -> Columns:
    return {name: (values, *_ROBOT_UNITS[name]) for name, values in robot.items()}


# -------------------- stages


def ingest_trial(
    *,
    subject: str,
    trial: str,
    files: TrialFiles,
    neutral: Path | None,
    marker_names: dict[str, str],
    settings: IngestSettings,
    phantom: bool,
    out: Path,
    log: RobotLog | None = None,
) -> dict[str, Any]:
    """Write one trial's raw exports as tables on the Qualisys clock, and return what its quality.json says.

    Parameters
    ----------
    neutral
        quality.json of the person's ``neutral`` trial: rest pose and pelvis geometry. None for that trial.
    marker_names
        The lab's marker names and ours for them.
    settings
        The slice ``ingest`` of the configuration.
    out, log
        Folder for quality.json and {markers,pose,joints,robot}.parquet (SI units; each column's metadata has its own).
        The robot log where it has been read before.

    Raises InputError where a file cannot be used.
    """
    raw = (files.markers, files.markerless, files.log)
    work = _Trial(subject, trial, phantom, settings, *raw, [], set(marker_names))
    reference = None if neutral is None else read_json(neutral, ("rest", "pelvis_geometry"))
    recording, width = _repair_swaps(work, _load_markers(work, marker_names), reference)
    clock, positions, flags, marker_report = _filter_markers(work, recording)
    _check_geometry(work, positions, reference)
    model = reference["pelvis_geometry"] if reference else _pelvis_geometry(positions)
    pelvis = _pelvis(work, clock, positions, model)
    _check_standing(work, positions, pelvis, reference)
    robot, up, robot_report = _robot(work, clock, positions, log)
    joints, markerless_report = _joints(work, clock, *pelvis, marker_names)
    interface, up_axis = _interface(work, clock, positions, up, reference)
    q, rest = _interface_coordinates(work, pelvis, interface, reference)
    poses = _pose_columns(clock, {"pelvis": pelvis, "interface": interface}, q, settings["rate_hz"])
    time: Columns = {"time_s": (clock, "s", "qualisys")}
    _write_table(out / "markers.parquet", work, _marker_columns(clock, positions, flags), {})
    _write_table(out / "pose.parquet", work, poses, {"rest": rest})
    _write_table(out / "joints.parquet", work, time | joints, {})
    _write_table(out / "robot.parquet", work, time | _robot_columns(robot), _turn_of(robot_report))
    quality = _summary(work, clock, q) | {
        "markers": marker_report,
        "markers_rate_hz": recording.rate_hz,
        "markerless": markerless_report,
        "robot": robot_report,
        "interface_up_axis": up_axis,
        **_sources(work),
    }
    if reference is None:
        quality |= {"rest": rest, "pelvis_geometry": model, "standing_sd_m": _standing_noise(recording)}
        quality["interface_width_m"] = width
    write_json(out / "quality.json", quality)
    return quality


def _turn_of(robot_report: dict[str, Any]) -> dict[str, float]:
    """Turn of the odometry in the world, for the metadata of the robot's table; empty without a log."""
    return {key: value for key, value in robot_report.items() if key == "yaw_odom_to_world_rad"}


def _interface(
    work: _Trial,
    clock: np.ndarray,
    positions: dict[str, np.ndarray],
    up: np.ndarray | None,
    reference: dict[str, Any] | None,
) -> tuple[tuple[np.ndarray, np.ndarray], str]:
    """Rotation (n, 3, 3) and origin (n, 3) [m] of the interface in the world, and what it is upright by.

    NaN without its two markers, as in a walk without the strap. A warning where ``neutral`` is upright by another axis.
    """
    own = "world z" if up is None else "arm"
    if not set(geometry.INTERFACE_MARKERS) <= set(positions):
        nothing = np.full((len(clock), 3, 3), np.nan)
        return (nothing, nothing[:, 0]), own
    theirs = own if reference is None else reference.get("interface_up_axis", own)
    if own != theirs:
        message = (
            f"the interface is upright by {own} here and by {theirs} in neutral: its roll and pitch (q_rx, q_ry) count"
            " from different axes"
        )
        action = "nothing: not comparable with trials that have the other axis; record the robot log of all or of none"
        work.note("interface_axis", "warning", work.tsv, "", message, action)
    return geometry.interface_frame(positions["IF_L"], positions["IF_R"], up), own


def _interface_coordinates(
    work: _Trial,
    pelvis: tuple[np.ndarray, np.ndarray],
    interface: tuple[np.ndarray, np.ndarray],
    reference: dict[str, Any] | None,
) -> tuple[np.ndarray, dict[str, Any]]:
    """Interface coordinates q (n, 6) [m, rad] and the rest pose from which they count."""
    r, p = geometry.relative_pose(*pelvis, *interface)
    rest: dict[str, Any] = reference["rest"] if reference else _rest(r, p, work)
    q = geometry.interface_coordinates(r, p, np.array(rest["rotation"]), np.array(rest["position"]))
    _note_coverage(work, q)
    return q, rest


def _note_coverage(work: _Trial, q: np.ndarray) -> None:
    """Note that the log leaves much of a trial without the orientation of the interface, which hangs on the arm's."""
    placed, whole = signals.known(q[:, :3]), signals.known(q)
    if work.log is None or not placed.any():
        return
    share = float(whole.sum() / placed.sum())
    if share < work.settings["min_complete"]:
        message = (
            f"the interface's roll, pitch and yaw are known in {100 * share:.0f} % of where its position is"
        )
        action = "left out where they are not; record the log over the whole trial"
        work.note("log_partial", "warning", work.log, "", message, action)


def _summary(work: _Trial, clock: np.ndarray, q: np.ndarray) -> dict[str, Any]:
    return {
        "subject": work.subject,
        "trial": work.name,
        "phantom": work.phantom,
        "samples": len(clock),
        "duration_s": float(clock[-1] - clock[0]),
        "interface_known": float(np.isfinite(q).all(axis=1).mean()),
        "findings": [asdict(finding) for finding in work.findings],
        "names_absent": sorted(work.absent),
    }


def _sources(work: _Trial) -> dict[str, Any]:
    raw = [path for path in (work.tsv, work.mot, work.log) if path is not None]
    return {"sha256": {path.name: sha256(path) for path in raw}, "settings": work.settings}


def _check_geometry(work: _Trial, positions: dict[str, np.ndarray], reference: dict[str, Any] | None) -> None:
    """Refuse a trial that is too short, and one without a sample at which the pelvis is known."""
    samples = len(next(iter(positions.values())))
    if samples < 10:
        remedy = "record the trial again"
        raise InputError(work.tsv, "", f"{samples} samples", "at least 0.1 s", remedy, "too_short")
    points = np.stack([positions[name] for name in geometry.PELVIS_MARKERS], axis=1)
    needed = 4 if reference is None else 3
    if not (np.isfinite(points).all(axis=2).sum(axis=1) >= needed).any():
        found = f"never {needed} of the pelvis markers at once"
        remedy = "fill or relabel the pelvis markers in QTM"
        raise InputError(
            work.tsv,
            ", ".join(geometry.PELVIS_MARKERS),
            found,
            "all four most of the time",
            remedy,
            "pelvis_unknown",
        )


def _check_standing(
    work: _Trial,
    positions: dict[str, np.ndarray],
    pelvis: tuple[np.ndarray, np.ndarray],
    reference: dict[str, Any] | None,
) -> None:
    """Refuse a lab whose axes are not as stated, and exchanged sides; warn about a person who faces elsewhere.

    Only ``neutral``, the trial without a ``reference``, shows a person who stands.
    """
    if reference is not None:
        return
    stated = work.settings["lab_to_world"]
    sides = [positions[name] for name in geometry.INTERFACE_MARKERS if name in positions]
    across = sides[0] - sides[1] if len(sides) == 2 else None
    odd = check_standing(work.tsv, stated, lab_to_world(stated), pelvis, across, work.settings["facing_deg"])
    if odd:
        work.note("facing", "warning", work.tsv, "", odd, "used as stated")


def ingest_subject(
    *, subject: str, folder: Path, settings: IngestSettings, raw: list[Path], out: Path
) -> None:
    """Write the tables of all trials of one person to ``<out>/<TRIAL>/``, see `ingest_trial`.

    ``neutral`` comes first, for the rest pose. ``raw`` lists the person's files as the workflow saw them; the
    trials that `subject.yaml` excludes are left out. Raises InputError where a file cannot be used.
    """
    person = read_subject(folder)
    _check_files(person.trials, folder, raw)
    neutral = out / "neutral" / "quality.json"
    absent = set(person.markers)
    exchanged: list[str] = []
    for trial in sorted(person.trials, key=lambda name: (name != "neutral", name)):
        quality = ingest_trial(
            subject=subject,
            trial=trial,
            files=person.trials[trial],
            neutral=None if trial == "neutral" else neutral,
            marker_names=person.markers,
            settings=settings,
            phantom=person.phantom,
            out=out / trial,
        )
        absent &= set(quality["names_absent"])
        exchanged += [f["place"] for f in quality["findings"] if f["code"] == "marker_swap_whole"]
        _print_trial(quality)
    for trial, reason in person.exclude.items():
        print(f"{subject} {trial}: excluded ({reason})", flush=True)
    _check_neutral(person.trials, exchanged)
    if absent:
        found = f"{', '.join(sorted(absent))}, which no marker or landmark of any trial is called"
        remedy = "correct the name, or remove the line"
        raise InputError(
            folder / SUBJECT_FILE, "key markers", found, "names of the recordings", remedy, "marker_source"
        )


def _print_trial(quality: dict[str, Any]) -> None:
    """Print what became of a trial, and each warning that reading its files gave."""
    warnings = sum(finding["severity"] != "info" for finding in quality["findings"])
    line = (
        f"{quality['subject']} {quality['trial']}: {quality['duration_s']:.1f} s, {warnings} warnings, "
        f"markerless {1e3 * quality['markerless']['rms_m']:.1f} mm, robot: {quality['robot']['status']}"
    )
    told = [f"  {w['code']}: {w['message']}; {w['action']}" for w in warnings_by_code(quality["findings"])]
    print("\n".join([line, *told]), flush=True)


def _check_neutral(trials: dict[str, TrialFiles], exchanged: list[str]) -> None:
    """Refuse ``neutral`` where most other trials have the same two labels exchanged against it throughout.

    ``exchanged`` names the pair of every such trial. One trial may be labelled wrongly; of most, ``neutral`` is.
    """
    for pair in sorted(set(exchanged)):
        count, others = exchanged.count(pair), len(trials) - 1
        if count > 1 and 2 * count > others:
            found = f"{pair} exchanged in {count} of {others} other trials, throughout and against this one"
            remedy = "exchange the two labels in neutral in QTM, or in the others if neutral is right; export again"
            raise InputError(
                trials["neutral"].markers, pair, found, "the labels of the others", remedy, "neutral_swap"
            )


def _check_files(trials: dict[str, TrialFiles], folder: Path, raw: list[Path]) -> None:
    """Refuse to run on other files than the workflow planned with."""
    planned = {path.resolve() for path in raw}
    there = {
        p.resolve() for files in trials.values() for p in (files.markers, files.markerless, files.log) if p
    }
    if raw and not there <= planned:
        found = f"files that were not planned for: {', '.join(sorted(p.name for p in there - planned))}"
        raise InputError(
            folder,
            "",
            found,
            "the files the workflow started with",
            "start the workflow again",
            "files_changed",
        )
