"""Figures of one trial's raw recordings, before any verdict."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cached_property, partial
from typing import TYPE_CHECKING

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation

from real2sim import geometry, signals
from real2sim.recording import alignment
from real2sim.recording.formats.opensim import PELVIS_COORDINATES
from real2sim.recording.formats.recordings import CoordinateRecording, Length, MarkerRecording, RobotLog
from real2sim.recording.landmarks import missing_of_pelvis, pelvis_of_landmarks
from real2sim.recording.quality import clocks, markers, pairing, sameness, scale, stillness
from real2sim.recording.subjects import parse_trial

if TYPE_CHECKING:
    from real2sim.settings import IngestSettings, QualityRateSettings, QualitySettings

_GRID_HZ = 200.0  # grid on which rates are compared: on a coarser one the lag decides as much as the rate
_PAIR_HZ = 10.0  # samples of both systems' pelvis that are kept for the frames
_EXPLAINED_M = 0.01  # residual of the robot's clock from which another start is tried
_STRIDES_S = (-1.0, 1.0, -2.0, 2.0)  # a fit finds its way from half a stride
_FINE_RATES = np.linspace(0.97, 1.03, 25)  # rates beside the declared one that are tried


@dataclass
class RawTrial:
    """Raw recordings of one trial: markers by our names in the world, the others as they are."""

    name: str
    recording: MarkerRecording
    coordinates: CoordinateRecording | None
    log: RobotLog | None
    # of a markerless export without coordinates: by our names in the file's frame, the pelvis' four among them
    landmarks: MarkerRecording | None = None

    @property
    def markerless(self) -> CoordinateRecording | MarkerRecording | None:
        """Markerless export: coordinates or landmarks."""
        return self.coordinates if self.coordinates is not None else self.landmarks

    @property
    def kind(self) -> str:
        """Kind of the trial."""
        return parse_trial(self.name)[0]


@dataclass
class Rate:
    """Rate of the markers [Hz]: declared, by the Time column (None without), by the motion (None: no motion)."""

    declared: float
    by_time: float | None
    by_motion: float | None = None
    correlation: float | None = None
    correlation_declared: float | None = None


@dataclass
class Markerless:
    """Markerless against Qualisys; ``pairs`` are rotations (k, 3, 3) of the pelvis at the same times."""

    correlation: float
    time_fit: alignment.TimeFit
    space: alignment.SpaceFit
    clock: clocks.ClockFit | None
    pairs: tuple[np.ndarray, np.ndarray]
    shared: pairing.Shared | None = None
    scale: scale.ScaleFit | None = None


@dataclass
class Robot:
    """Robot against Qualisys: offset by /sync [s] or None, correlation of the motion, clock, heading [rad]."""

    sync_s: float | None
    correlation: float
    clock: clocks.ClockFit | None
    heading_rad: float
    floor_sd_rad: float
    shared: pairing.Shared | None = None
    scale: scale.ScaleFit | None = None


@dataclass
class Rigid:
    """Departures (n, 7) [m] of the rigid distances after swaps and spikes, and what sliding skin explains of them."""

    departures: np.ndarray
    skin: np.ndarray


@dataclass
class Identity:
    """Evidence for or against a trial being what its name says.

    ``lengths`` and ``exchanged`` are by system: ``markers``, ``markerless``, ``robot log``. ``same`` names trials of
    the person that are the same recording.
    """

    lengths: dict[str, Length]
    sway: stillness.Sway | None = None
    exchanged: dict[str, pairing.Exchanged] = field(default_factory=dict)
    same: list[sameness.Same] = field(default_factory=list)


@dataclass
class Measured:
    """Everything the gates of one trial judge."""

    name: str
    kind: str
    frames: int
    rate: Rate
    extent_m: float
    complete: dict[str, float]
    gaps: list[markers.Gap]
    swaps: list[markers.Swap]
    spikes: dict[str, int]
    rigid: Rigid
    identity: Identity
    noise_m: dict[str, float]
    spacing: dict[str, tuple[float, float]] = field(default_factory=dict)  # SD [s], longest gap [s] by system
    robot: Robot | None = None
    markerless: Markerless | None = None


def marker_clock(recording: MarkerRecording) -> np.ndarray:
    """Times (n,) [s] of a recording: frame 1 is time 0, also of a cropped export."""
    return (recording.first_frame - 1 + np.arange(len(recording.time_s))) / recording.rate_hz


@dataclass
class _Cleaned:
    """Markers by our names (n, 3) [m] after exchanged labels were exchanged back and spikes left out."""

    used: dict[str, np.ndarray]
    positions: dict[str, np.ndarray]
    swaps: list[markers.Swap]
    spikes: dict[str, int]


def _cleaned(
    recording: MarkerRecording, reference: np.ndarray, settings: QualitySettings, ingest: IngestSettings
) -> _Cleaned:
    used = {name: recording.positions[name] for name in markers.MARKERS if name in recording.positions}
    swaps = markers.find_swaps(
        used,
        reference,
        violation_m=ingest["swap"]["violation_m"],
        restored_m=ingest["swap"]["restored_m"],
    )
    clean = markers.repaired(used, swaps)
    found = {name: markers.spikes(values, settings["spikes"]["height_m"]) for name, values in clean.items()}
    for name, rows in found.items():
        clean[name][rows] = np.nan
    return _Cleaned(used, clean, swaps, {name: len(rows) for name, rows in found.items()})


def measure(
    trial: RawTrial, reference: np.ndarray, settings: QualitySettings, ingest: IngestSettings
) -> Measured:
    """All figures of a trial; ``reference`` (7,) are the rigid distances of quiet standing [m]."""
    recording = trial.recording
    frames, rate = len(recording.time_s), recording.rate_hz
    time_s = marker_clock(recording)
    cleaned = _cleaned(recording, reference, settings, ingest)
    used, clean = cleaned.used, cleaned.positions
    cloud = np.concatenate(list(used.values()))
    seen = cloud[signals.known(cloud)]
    extent = float(np.ptp(seen, axis=0).max()) if len(seen) else 0.0
    pelvis = _pelvis_path(time_s, clean, rate, ingest)
    departures = markers.departures(clean, reference)
    rotation = np.full((frames, 3, 3), np.nan) if pelvis is None else pelvis.rotation
    out = Measured(
        trial.name,
        trial.kind,
        frames,
        Rate(rate, _column_rate(recording)),
        extent,
        {name: float(signals.known(values).mean()) for name, values in used.items()},
        markers.find_gaps(used),
        cleaned.swaps,
        cleaned.spikes,
        Rigid(departures, markers.skin(departures, rotation)),
        Identity(_lengths(trial)),
        {name: markers.noise_sd(values) for name, values in clean.items()},
    )
    if out.kind == "neutral":
        out.identity.sway = stillness.sway(pelvis, clean, rate, settings["still"]["band_hz"])
    if trial.log is not None and set(geometry.INTERFACE_MARKERS) <= set(clean):
        out.spacing["robot log"] = _spacing(trial.log.joint_time_s)
        out.robot = _robot(trial.log, time_s, clean, ingest)
    if trial.markerless is not None and _shows_pelvis(trial.markerless):
        out.spacing["markerless"] = _spacing(trial.markerless.time_s)
        out.markerless = _markerless(trial.markerless, pelvis, settings, ingest)
    _rate_by_motion(out, trial, pelvis, clean, time_s, settings["rate"])
    return out


def _lengths(trial: RawTrial) -> dict[str, Length]:
    both = {
        "markers": trial.recording.length,
        "markerless": trial.markerless.length if trial.markerless is not None else None,
    }
    return {system: length for system, length in both.items() if length is not None}


@dataclass
class Suspect:
    """Trial on whose markers the files of other trials are laid; ``reference`` as in `measure`."""

    trial: RawTrial
    reference: np.ndarray
    settings: QualitySettings
    ingest: IngestSettings

    @property
    def time_s(self) -> np.ndarray:
        """Times (n,) [s] of the markers."""
        return marker_clock(self.trial.recording)

    @cached_property
    def clean(self) -> dict[str, np.ndarray]:
        """Positions (n, 3) [m] of the markers after cleaning."""
        return _cleaned(self.trial.recording, self.reference, self.settings, self.ingest).positions

    @cached_property
    def pelvis(self) -> alignment.PelvisPath | None:
        """Pelvis of the markers."""
        return _pelvis_path(self.time_s, self.clean, self.trial.recording.rate_hz, self.ingest)

    @cached_property
    def bridged(self) -> alignment.PelvisPath | None:
        """Pelvis without holes, for the coarse search."""
        return _bridged(self.pelvis) if self.pelvis is not None else None


File = RobotLog | CoordinateRecording | MarkerRecording


def find_exchanges(
    trials: dict[str, RawTrial],
    measured: dict[str, Measured],
    reference: np.ndarray,
    settings: QualitySettings,
    ingest: IngestSettings,
    lay: Callable[[Suspect, File], pairing.Shared | None] | None = None,
) -> None:
    """Note, in ``measured``, trials whose robot log or markerless file fits another trial of the person better.

    Only trials are compared whose residual is ``quality.exchanged.suspect`` times the person's smallest of that
    system, as each comparison takes as long as a measurement. Quiet standing cannot be told apart. ``lay`` takes the
    place of `lay_file`, for who has laid the same files before. ``reference`` (7,) [m] as in `measure`.
    """
    limits = settings["exchanged"]
    moving = [name for name, m in measured.items() if m.kind != "neutral"]
    suspects = {name: Suspect(trials[name], reference, settings, ingest) for name in moving}
    for system in ("robot log", "markerless"):
        files = {name: file for name in moving if (file := _file_of(trials[name], system)) is not None}
        known = {name: shared for name in moving if (shared := _shared(measured[name], system)) is not None}
        least = min((shared.residual_m for shared in known.values()), default=np.inf)
        better = {}
        for name, own in known.items():
            if own.residual_m < limits["suspect"] * least:
                continue
            others = [other for other in files if other != name]
            fit = partial(_lay_other, lay or lay_file, suspects[name], files)
            better[name] = pairing.find_better(own, others, fit, limits["least_s"])
        for name, found in pairing.choose_exchanges(better, limits["certainty_sd"]).items():
            measured[name].identity.exchanged[system] = found


def _lay_other(
    lay: Callable[[Suspect, File], pairing.Shared | None],
    suspect: Suspect,
    files: Mapping[str, File],
    other: str,
) -> pairing.Shared | None:
    return lay(suspect, files[other])


def _file_of(trial: RawTrial, system: str) -> File | None:
    return trial.log if system == "robot log" else trial.markerless


def _shared(m: Measured, system: str) -> pairing.Shared | None:
    other = m.robot if system == "robot log" else m.markerless
    return other.shared if other is not None else None


def lay_file(suspect: Suspect, file: File) -> pairing.Shared | None:
    """Return the motion that the markers of a trial share with a robot log or markerless file.

    None where the motion of one is not found in the other: a file that cannot be synchronised is not the right one.
    """
    ingest = suspect.ingest
    if isinstance(file, RobotLog):
        coarse = _coarse_robot(file, suspect.time_s, suspect.clean)
        if coarse is None or coarse.correlation < ingest["robot_log"]["min_correlation"]:
            return None
        return _robot(file, suspect.time_s, suspect.clean, ingest).shared
    path = _path_of(file) if _shows_pelvis(file) else None
    if suspect.bridged is None or path is None:
        return None
    if alignment.coarse_offset(suspect.bridged, path)[1] < ingest["markerless"]["min_correlation"]:
        return None
    found = _markerless(file, suspect.pelvis, suspect.settings, ingest)
    return found.shared if found is not None else None


def _column_rate(recording: MarkerRecording) -> float | None:
    step = np.diff(recording.time_s)
    step = step[np.isfinite(step) & (step > 0)]
    return float(len(step) / step.sum()) if len(step) else None


def _spacing(time_s: np.ndarray) -> tuple[float, float]:
    step = np.diff(time_s)
    step = step[step > 0]
    if not len(step):
        return 0.0, 0.0
    return float(np.std(step - np.median(step))), float(step.max())


def _pelvis_path(
    time_s: np.ndarray, clean: dict[str, np.ndarray], rate: float, ingest: IngestSettings
) -> alignment.PelvisPath | None:
    if not set(geometry.PELVIS_MARKERS) <= set(clean):
        return None
    smooth = []
    for name in geometry.PELVIS_MARKERS:
        filled, _ = signals.fill_gaps(clean[name], rate, ingest["max_gap_s"])
        smooth.append(signals.lowpass(filled, rate, ingest["cutoff_hz"], ingest["filter_order"]))
    rotation, position = geometry.pelvis_frame(*smooth)
    if (np.isfinite(rotation).all(axis=(1, 2)) & signals.known(position)).sum() < 100:
        return None
    return alignment.PelvisPath(time_s, rotation, position)


# -------------------- robot


def _line_angles(clean: dict[str, np.ndarray]) -> np.ndarray:
    """Heading and elevation (n, 2) [rad] of the line between the interface markers."""
    across = clean["IF_L"] - clean["IF_R"]
    heading = np.arctan2(-across[:, 0], across[:, 1])
    good = np.isfinite(heading)
    heading[good] = np.unwrap(heading[good])
    return np.column_stack([heading, np.arctan2(across[:, 2], np.hypot(across[:, 0], across[:, 1]))])


def _log_angles(log: RobotLog, rate_hz: float) -> tuple[np.ndarray, np.ndarray]:
    """Times and yaw, roll (n, 2) [rad] of the log on a uniform grid."""
    start = max(log.base_time_s[0], log.joint_time_s[0])
    end = min(log.base_time_s[-1], log.joint_time_s[-1])
    grid = np.arange(start, end, 1 / rate_hz)
    yaw = np.interp(grid, log.base_time_s, np.unwrap(log.base["yaw"]))
    return grid, np.column_stack([yaw, np.interp(grid, log.joint_time_s, log.joints["arm_roll"][:, 0])])


def _rate_of(time_s: np.ndarray) -> float:
    return float((len(time_s) - 1) / (time_s[-1] - time_s[0]))


def _coarse_robot(
    log: RobotLog, time_s: np.ndarray, clean: dict[str, np.ndarray]
) -> alignment.TimeFit | None:
    """Time by the turning of the line between the interface markers; None where there is too little of it."""
    rate = _rate_of(time_s)
    angles = _line_angles(clean)
    grid, theirs = _log_angles(log, rate)
    if len(grid) <= 100 or signals.known(angles).sum() <= 100:
        return None
    ours = signals.derivative(_closed(angles), rate)
    return alignment.align_signals(time_s, ours, grid, signals.derivative(theirs, rate))


def _robot(log: RobotLog, time_s: np.ndarray, clean: dict[str, np.ndarray], ingest: IngestSettings) -> Robot:
    angles = _line_angles(clean)
    grid, theirs = _log_angles(log, _rate_of(time_s))
    sync = -float(log.sync_s[0]) if log.sync_s is not None and len(log.sync_s) else None
    offset = sync if sync is not None else float(time_s[0])
    correlation = 0.0
    coarse = _coarse_robot(log, time_s, clean)
    if coarse is not None:
        correlation = coarse.correlation
        if correlation >= ingest["robot_log"]["min_correlation"] and coarse.offset_sd_s < 0.1:
            offset = coarse.offset_s
    fit = _robot_clock(time_s, clean, log, [offset, *([sync] if sync is not None else [])])
    offset = fit.offset_s if fit is not None else offset
    phasor = np.exp(1j * (angles[:, 0] - np.interp(time_s - offset, grid, theirs[:, 0])))
    heading = float(np.angle(np.nanmean(phasor))) if np.isfinite(phasor).any() else float("nan")
    floor = float(np.max(fit.ground_sd[:2])) if fit is not None else float("inf")
    left, right = (clean[name] for name in geometry.INTERFACE_MARKERS)
    scaled = clocks.robot_clock(time_s, left, right, log, offset_s=offset, scaled=True)
    # markers of another scale still belong to their log
    closer = scaled if fit is None or (scaled is not None and scaled.residual_m < fit.residual_m) else fit
    shared = pairing.robot_shared(closer, time_s, np.hstack([left, right]))
    return Robot(sync, correlation, fit, heading, floor, shared, scale.robot_scale(scaled))


def _robot_clock(
    time_s: np.ndarray, clean: dict[str, np.ndarray], log: RobotLog, starts: list[float]
) -> clocks.ClockFit | None:
    """Clock from the first start that explains the markers, or the best of all.

    Gait repeats itself: the coarse offset may be one stride off, where the fit finds a minimum of its own.
    """
    best: clocks.ClockFit | None = None
    around = [starts[0] + shift for shift in _STRIDES_S]
    for start in [*starts, *around]:
        fit = clocks.robot_clock(time_s, clean["IF_L"], clean["IF_R"], log, offset_s=start)
        if fit is None or not np.isfinite([fit.offset_s, fit.drift, fit.residual_m]).all():
            continue
        if best is None or fit.residual_m < best.residual_m:
            best = fit
        if best.residual_m < _EXPLAINED_M:
            break
    return best


# -------------------- markerless


def _shows_pelvis(file: CoordinateRecording | MarkerRecording) -> bool:
    """Return whether a markerless export has what the pose of the pelvis is computed from."""
    if isinstance(file, MarkerRecording):
        return not missing_of_pelvis(file.positions)
    return set(PELVIS_COORDINATES) <= set(file.columns)


def _path_of(file: CoordinateRecording | MarkerRecording) -> alignment.PelvisPath | None:
    """Return the markerless pelvis; None of less than ten rows or with missing values."""
    if len(file.time_s) < 10:
        return None
    if isinstance(file, MarkerRecording):
        path = pelvis_of_landmarks(file.time_s, file.positions)
    else:
        path = alignment.PelvisPath(file.time_s, *alignment.pelvis_of_coordinates(file.columns))
    return path if np.isfinite(path.position).all() and np.isfinite(path.rotation).all() else None


def _markerless(
    file: CoordinateRecording | MarkerRecording,
    pelvis: alignment.PelvisPath | None,
    settings: QualitySettings,
    ingest: IngestSettings,
) -> Markerless | None:
    other = _path_of(file)
    if pelvis is None or other is None:
        return None
    bridged = _bridged(pelvis)
    offset, correlation = alignment.coarse_offset(bridged, other)
    moving = correlation >= ingest["markerless"]["min_correlation"]
    if not moving:
        offset = float(pelvis.time_s[0] - other.time_s[0])
    time_fit, space = alignment.align_pelvis(
        pelvis, other, offset_s=offset, correlation=correlation, with_time=moving, with_drift=False
    )
    clock = None
    if moving:
        clock = clocks.markerless_clock(pelvis, other, space, offset_s=time_fit.offset_s)
    at = clock.offset_s if clock is not None else time_fit.offset_s
    shared = pairing.markerless_shared(pelvis, other, space, at, settings["markerless_pair"]["lever_m"])
    metres = None
    if moving:
        metres = scale.markerless_scale(pelvis, other, space.rotation, at, settings["scale"]["least_s"])
    return Markerless(correlation, time_fit, space, clock, _pairs(pelvis, other, at), shared, metres)


def _closed(values: np.ndarray) -> np.ndarray:
    """Values (n, k) with every hole closed by a straight line; unchanged where nothing is known."""
    good, rows = signals.known(values), np.arange(len(values))
    if not good.any():
        return values
    return np.column_stack([np.interp(rows, rows[good], column[good]) for column in values.T])


def _bridged(path: alignment.PelvisPath) -> alignment.PelvisPath:
    """The path with every hole closed by straight lines, for the coarse search only."""
    good = np.isfinite(path.rotation).all(axis=(1, 2)) & signals.known(path.position)
    flat = np.hstack([path.rotation.reshape(-1, 9), path.position])
    flat[~good] = np.nan
    closed = _closed(flat)
    return alignment.PelvisPath(path.time_s, closed[:, :9].reshape(-1, 3, 3), closed[:, 9:])


def _pairs(
    ours: alignment.PelvisPath, other: alignment.PelvisPath, offset_s: float
) -> tuple[np.ndarray, np.ndarray]:
    good = np.isfinite(ours.rotation).all(axis=(1, 2))
    rate = (len(ours.time_s) - 1) / (ours.time_s[-1] - ours.time_s[0])
    rows = np.flatnonzero(good)[:: max(1, round(rate / _PAIR_HZ))]
    t = ours.time_s[rows] - offset_s
    inside = (t >= other.time_s[0]) & (t <= other.time_s[-1])
    if not inside.any():
        return np.zeros((0, 3, 3)), np.zeros((0, 3, 3))
    theirs = CubicSpline(other.time_s, other.rotation.reshape(-1, 9))(t[inside])
    return ours.rotation[rows][inside], Rotation.from_matrix(theirs.reshape(-1, 3, 3)).as_matrix()


# -------------------- rate


def _rate_by_motion(
    out: Measured,
    trial: RawTrial,
    pelvis: alignment.PelvisPath | None,
    clean: dict[str, np.ndarray],
    time_s: np.ndarray,
    limits: QualityRateSettings,
) -> None:
    """The rate at which the markers' motion agrees best with that of the other systems."""
    declared = out.rate.declared
    if out.kind == "neutral":
        return  # nothing moves
    if out.robot is not None and trial.log is not None:
        ours = signals.derivative(_closed(_line_angles(clean)), declared)
        grid, angles = _log_angles(trial.log, _GRID_HZ)
        theirs = signals.derivative(angles, _GRID_HZ)
    elif (
        out.markerless is not None
        and trial.markerless is not None
        and pelvis is not None
        and (other := _path_of(trial.markerless)) is not None
    ):
        bridged = _bridged(pelvis)
        ours = _speeds(bridged.rotation, bridged.position, declared)
        own = other.time_s
        grid = np.arange(own[0], own[-1], 1 / _GRID_HZ)
        flat = np.hstack([other.rotation.reshape(-1, 9), other.position])
        table = np.column_stack([np.interp(grid, own, column) for column in flat.T])
        theirs = _speeds(table[:, :9].reshape(-1, 3, 3), table[:, 9:], _GRID_HZ)
    else:
        return
    good = signals.known(ours)
    if good.sum() < 100 or len(grid) < 50:
        return
    ours = signals.lowpass(ours[good], declared, 5.0, 4)

    def agreement(rate: float) -> float:
        duration = (len(ours) - 1) / rate
        t = np.arange(0, duration, 1 / _GRID_HZ)
        if len(t) < 50:
            return -1.0
        own = np.arange(len(ours)) / rate
        resampled = np.column_stack([np.interp(t, own, column) for column in ours.T])
        return alignment.correlate(resampled, theirs)[1]

    at_declared = agreement(declared)
    candidates = [*(float(r) for r in limits["common_hz"]), *(declared * _FINE_RATES)]
    scores = [agreement(rate) for rate in candidates]
    best = int(np.argmax(scores))
    out.rate.correlation_declared, out.rate.correlation = at_declared, float(scores[best])
    if max(at_declared, scores[best]) < limits["min_correlation"]:
        return
    better = scores[best] > at_declared + limits["better_by"]
    out.rate.by_motion = candidates[best] if better else declared


def _speeds(r: np.ndarray, p: np.ndarray, rate: float) -> np.ndarray:
    linear = np.linalg.norm(signals.derivative(signals.lowpass(p, rate, 5.0, 4), rate), axis=1)
    smooth = signals.lowpass(r.reshape(-1, 9), rate, 5.0, 4).reshape(-1, 3, 3)
    return np.column_stack([linear, alignment.angular_speed(smooth, rate)])
