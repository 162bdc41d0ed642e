"""From figures to verdicts: every gate, its threshold, what it means and what to do."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.spatial.transform import Rotation

from real2sim import geometry, signals
from real2sim.recording.quality import clocks, identity
from real2sim.recording.quality.markers import RIGID_PAIRS, needed
from real2sim.recording.quality.measure import Measured
from real2sim.recording.quality.verdict import PASS, REFUSE, WARN, Gate, by_size, sized_gate, worst
from real2sim.recording.subjects import parse_trial

if TYPE_CHECKING:
    from real2sim.settings import (
        IngestSettings,
        QualityExcitationSettings,
        QualityLimitsSettings,
        QualitySettings,
    )

GATES = (
    "readable",
    "completeness",
    "gaps",
    "start",
    "rigid",
    "swaps",
    "spikes",
    "units",
    "rate",
    "spacing",
    "robot_sync",
    "robot_drift",
    "robot_residual",
    "markerless_sync",
    "markerless_drift",
    "markerless_residual",
    "frame_robot",
    "frame_markerless",
    "excitation",
    "limits",
    "noise",
    *identity.GATES,
)
_ROUNDS = 20  # of alternating means
_ENOUGH = 3  # trials of which a median says something
_ANGULAR = ("rx", "ry", "rz")


@dataclass
class Session:
    """Facts from all trials of a person: drifts of the clocks, ground of the other systems."""

    robot_drift: clocks.Pooled | None
    markerless_drift: clocks.Pooled | None
    heading_rad: dict[str, float]  # of the odometry, from the person's consensus, by trial
    heading_sd_rad: float
    turned: dict[
        str, np.ndarray
    ]  # rotation vector [rad] of the markerless ground from the consensus, by trial
    noise_m: dict[str, float]  # of neutral, by marker


def session_of(trials: list[Measured]) -> Session:
    """Pool what is one for all trials of a person, recorded in one session."""
    robot = [m.robot.clock for m in trials if m.robot is not None and m.robot.clock is not None]
    video = [
        m.markerless.clock for m in trials if m.markerless is not None and m.markerless.clock is not None
    ]
    headings = {m.name: m.robot.heading_rad for m in trials if m.robot is not None}
    away, spread = _headings({k: v for k, v in headings.items() if np.isfinite(v)})
    neutral = next((m for m in trials if m.kind == "neutral"), None)
    return Session(
        clocks.pool((c.drift for c in robot), (c.drift_sd for c in robot)),
        clocks.pool((c.drift for c in video), (c.drift_sd for c in video)),
        away,
        spread,
        _grounds(trials),
        neutral.noise_m if neutral is not None else {},
    )


def _headings(headings: dict[str, float]) -> tuple[dict[str, float], float]:
    """Departure [rad] of each trial from the median, and the scatter of the others (1.4826 MAD)."""
    if len(headings) < _ENOUGH:
        return {}, float("inf")
    phasors = np.exp(1j * np.array(list(headings.values())))
    # the median direction: the one with the least total departure from all
    total = np.abs(np.angle(phasors[:, None] / phasors)).sum(axis=0)
    away = np.angle(phasors / phasors[total.argmin()])
    away -= np.median(away)
    return dict(zip(headings, away.tolist(), strict=True)), float(1.4826 * np.median(np.abs(away)))


def _grounds(trials: list[Measured]) -> dict[str, np.ndarray]:
    """Turn of each trial's markerless ground from the median of all, the pelvis frames laid on each other once.

    Our pelvis = ground · theirs · body, with one body for all trials; alternating chordal means.
    """
    pairs = {
        m.name: m.markerless.pairs for m in trials if m.markerless is not None and len(m.markerless.pairs[0])
    }
    if len(pairs) < _ENOUGH:
        return {}
    ours, theirs = (np.concatenate([pair[i] for pair in pairs.values()]) for i in (0, 1))
    body, ground = np.eye(3), np.eye(3)
    for _ in range(_ROUNDS):
        ground = geometry.mean_rotation(ours @ np.swapaxes(theirs @ body, 1, 2))
        body = geometry.mean_rotation(np.swapaxes(ground @ theirs, 1, 2) @ ours)
    each = {name: geometry.mean_rotation(a @ np.swapaxes(b @ body, 1, 2)) for name, (a, b) in pairs.items()}
    vectors = np.array([Rotation.from_matrix(g @ ground.T).as_rotvec() for g in each.values()])
    vectors -= np.median(vectors, axis=0)
    # skin moves with the posture: a kind of trial with enough of its own is compared with itself
    kinds = np.array([parse_trial(name)[0] for name in each])
    for kind in np.unique(kinds):
        if (kinds == kind).sum() >= _ENOUGH:
            vectors[kinds == kind] -= np.median(vectors[kinds == kind], axis=0)
    return dict(zip(each, vectors, strict=True))


# -------------------- one trial


def judge(
    m: Measured,
    session: Session,
    settings: QualitySettings,
    ingest: IngestSettings,
    *,
    scales: dict[str, float],
    q: np.ndarray | None = None,
    limits: tuple[np.ndarray, np.ndarray] | None = None,
) -> list[Gate]:
    """All gates of one trial. ``q`` (n, 6) interface coordinates at the common rate, ``limits`` q_min and q_max."""
    out = [
        _completeness(m, settings, q),
        _gaps(m, settings),
        _rigid(m, settings),
        _swaps(m),
        _spikes(m, settings),
        _units(m, ingest),
        _rate(m, settings),
        _spacing(m, settings),
    ]
    if m.robot is not None:
        times = [_robot_sync(m, settings), _robot_drift(m, session, settings)]
        out += [*_of_clocks(m, times), _robot_residual(m, settings)]
    if m.markerless is not None:
        times = [_markerless_sync(m, settings), _markerless_drift(m, session, settings)]
        out += [*_of_clocks(m, times), _markerless_residual(m, settings)]
    out += [_frame_robot(m, session, settings), _frame_markerless(m, session, settings)]
    if q is not None and m.kind == "dynamic":
        out.append(_excitation(q, settings["excitation"], ingest["rate_hz"]))
        if limits is not None:
            out.append(_limits(q, limits, settings["limits"]))
    if m.kind == "neutral":
        out.append(_noise(m, settings, ingest, scales))
    return out + identity.judge(m, settings)


def _of_clocks(m: Measured, gates: Sequence[Gate]) -> list[Gate]:
    """Gates of a trial's clocks; of somebody who stands none refuses.

    Sway of a millimetre or two shows little of a clock beside the steps of an encoder, and the rest pose hangs on none.
    """
    standing = m.kind == "neutral"
    return [replace(g, verdict=WARN) if standing and g.verdict == REFUSE else g for g in gates]


def _completeness(m: Measured, settings: QualitySettings, q: np.ndarray | None) -> Gate:
    share = {name: m.complete.get(name, 0.0) for name in needed(m.kind)}
    worst_marker = min(share, key=share.__getitem__)
    known = 1.0 if q is None else float(np.isfinite(q).all(axis=1).mean())
    if known < share[worst_marker]:
        return sized_gate(
            "completeness",
            known,
            "1",
            settings,
            f"all six coordinates of the interface are known in {100 * known:.1f} % of the samples (its markers and the"
            " pose of the robot's arm)",
            "Record the robot log over the whole trial, and fill or relabel markers in QTM.",
        )
    listed = ", ".join(f"{name} {100 * s:.1f} %" for name, s in share.items() if s < 1)
    return sized_gate(
        "completeness",
        share[worst_marker],
        "1",
        settings,
        f"{worst_marker} is measured in {100 * share[worst_marker]:.1f} % of the frames"
        + (f" ({listed})" if listed else ""),
        "Fill or relabel the marker in QTM, or record the trial again.",
    )


def _gaps(m: Measured, settings: QualitySettings) -> Gate:
    gaps = [gap for gap in m.gaps if gap.marker in needed(m.kind)]
    if not gaps:
        return sized_gate("gaps", 0.0, "s", settings, "no gap", "")
    longest = max(gaps, key=lambda gap: gap.stop - gap.start)
    length = (longest.stop - longest.start) / m.rate.declared
    return sized_gate(
        "gaps",
        length,
        "s",
        settings,
        f"{len(gaps)} gaps, the longest {length:.2f} s of {longest.marker} from frame {longest.start + 1}",
        "Fill or relabel the marker in QTM, or record the trial again.",
    )


def _rigid(m: Measured, settings: QualitySettings) -> Gate:
    size = np.abs(m.rigid.departures - m.rigid.skin)
    seen = np.isfinite(size).any(axis=0)
    if not seen.any():
        return sized_gate("rigid", None, "m", settings, "no two markers of a body are seen at once", "")
    per_pair = np.full(size.shape[1], np.nan)
    per_pair[seen] = np.nanpercentile(size[:, seen], 99, axis=0)
    pair = int(np.nanargmax(per_pair))
    a, b = RIGID_PAIRS[pair]
    whole = float(np.nanmax(np.nanpercentile(np.abs(m.rigid.departures[:, seen]), 99, axis=0)))
    limits = settings["rigid"]
    verdict = by_size(float(per_pair[pair]), [limits["warn"], limits["refuse"]])
    if whole >= limits["refuse"]:  # no skin slides that far
        verdict = worst([verdict, WARN])
    return sized_gate(
        "rigid",
        float(per_pair[pair]),
        "m",
        settings,
        f"the distance {a} to {b} departs from quiet standing by {1e3 * per_pair[pair]:.1f} mm (99th percentile) more "
        f"than skin that slides with the pelvis' rotation explains; by {1e3 * whole:.1f} mm at most with it",
        "Look for exchanged or moved markers in QTM; if a marker was moved, record neutral again.",
        verdict=verdict,
    )


def _swaps(m: Measured) -> Gate:
    frames = sum(swap.stop - swap.start for swap in m.swaps)
    spans = "; ".join(
        f"{s.first} and {s.second} in frames {s.start + 1} to {s.stop}" for s in m.swaps[:6]
    ) + ("; ..." if len(m.swaps) > 6 else "")
    message = f"{spans}: exchanged back" if m.swaps else "no exchanged labels"
    verdict = WARN if m.swaps else PASS
    remedy = "Correct the labels in QTM and export again." if m.swaps else ""
    return sized_gate("swaps", float(frames), "frames", None, message, remedy, verdict=verdict)


def _spikes(m: Measured, settings: QualitySettings) -> Gate:
    count = sum(m.spikes.values())
    share = count / max(m.frames, 1)
    named = ", ".join(f"{name} {n}" for name, n in m.spikes.items() if n)
    verdict = REFUSE if share >= settings["spikes"]["refuse"] else WARN if count else PASS
    message = f"{count} samples stand out of their neighbours ({named})" if count else "no spike"
    remedy = "Delete the spikes in QTM and fill the gaps." if count else ""
    return sized_gate("spikes", share, "1", settings, message, remedy, verdict=verdict)


def _units(m: Measured, ingest: IngestSettings) -> Gate:
    low, high = ingest["units"]["marker_extent_m"]
    verdict = PASS if low <= m.extent_m <= high else REFUSE
    message = f"the markers span {m.extent_m:.3g} m (allowed: {low:g} to {high:g} m)"
    remedy = "" if verdict == PASS else "Export again from QTM in millimetres."
    return Gate(
        "units", verdict, m.extent_m, "m", None, message, remedy, None, "ingest.units.marker_extent_m"
    )


def _rate(m: Measured, settings: QualitySettings) -> Gate:
    rate, limits = m.rate, settings["rate"]
    remedy = "Correct FREQUENCY in the header, or export again."
    off = abs(rate.by_time / rate.declared - 1) if rate.by_time is not None else 0.0
    if off >= limits["warn"]:
        message = f"the header declares {rate.declared:g} Hz, the Time column {rate.by_time:.4g} Hz"
        return sized_gate("rate", off, "1", settings, message, remedy)
    if rate.by_motion is None:
        message = f"{rate.declared:g} Hz declared; no common motion to check it by"
        return sized_gate("rate", off if rate.by_time is not None else None, "1", settings, message, "")
    off = abs(rate.by_motion / rate.declared - 1)
    if off == 0:
        message = (
            f"{rate.declared:g} Hz, as the other systems say (correlation {rate.correlation_declared:.2f})"
        )
        return sized_gate("rate", 0.0, "1", settings, message, "")
    message = (
        f"the header declares {rate.declared:g} Hz, but the motion fits that of the other systems at "
        f"{rate.by_motion:.4g} Hz (correlation {rate.correlation:.2f} instead of {rate.correlation_declared:.2f})"
    )
    return sized_gate("rate", off, "1", settings, message, remedy)


def _spacing(m: Measured, settings: QualitySettings) -> Gate:
    if not m.spacing:
        return sized_gate("spacing", None, "s", settings, "no other system", "")
    system = max(m.spacing, key=lambda name: m.spacing[name][1])
    sd, longest = m.spacing[system]
    return sized_gate(
        "spacing",
        longest,
        "s",
        settings,
        f"longest step between samples of the {system} {1e3 * longest:.1f} ms, jitter {1e3 * sd:.2f} ms (SD)",
        "Look for lost messages or frames; lower the load of the recording computer.",
    )


def _interval(value: float, sd: float) -> list[float] | None:
    if not np.isfinite([value, sd]).all():
        return None
    return [value - clocks.NORMAL_95 * sd, value + clocks.NORMAL_95 * sd]


def _robot_sync(m: Measured, settings: QualitySettings) -> Gate:
    """Offset of /sync from the motion, or of the joints from the base, whichever is graver."""
    robot, limits = m.robot, settings["robot_sync"]
    assert robot is not None
    fit = robot.clock
    judged: list[tuple[str, float, float, str, str]] = []
    notes, span = [], None
    if fit is not None and fit.offset_sd_s <= limits["certain_s"]:
        start = fit.offset_s - fit.drift * fit.middle_s
        sd = float(np.hypot(fit.offset_sd_s, fit.drift_sd * fit.middle_s))
        if robot.sync_s is None:
            notes, span = [f"offset {1e3 * start:.2f} ms by the motion, no /sync"], _interval(start, sd)
        else:
            off = start - robot.sync_s
            message = (
                f"/sync says {1e3 * robot.sync_s:.2f} ms, the motion {1e3 * start:.2f} +- "
                f"{1e3 * clocks.NORMAL_95 * sd:.2f} ms: {1e3 * off:+.2f} ms apart"
            )
            remedy = (
                "Check the wiring of /sync, or leave the topic out of the log. Interface markers that come late in the"
                " export look the same."
            )
            judged.append((_sure_by_size(off, sd, limits), off, sd, message, remedy))
    if fit is not None and fit.joint_delay_sd_s <= limits["certain_s"]:
        late, sd = fit.joint_delay_s, fit.joint_delay_sd_s
        message = (
            f"/joint_states is logged {1e3 * late:+.2f} +- {1e3 * clocks.NORMAL_95 * sd:.2f} ms after /odom, "
            "by the motion of the markers"
        )
        remedy = "Let the publishers stamp their messages with one clock, and record again."
        judged.append((_sure_by_size(late, sd, limits), late, sd, message, remedy))
    if not judged:
        message = notes[0] if notes else "too little motion to check the offset"
        return sized_gate("robot_sync", None, "s", settings, message, "", interval=span)
    verdict = worst(v for v, *_ in judged)
    value, sd, remedy = next((value, sd, remedy) for v, value, sd, _, remedy in judged if v == verdict)
    message = "; ".join([*notes, *(text for *_, text, _ in judged)])
    remedy = "" if verdict == PASS else remedy
    return sized_gate(
        "robot_sync", value, "s", settings, message, remedy, verdict=verdict, interval=_interval(value, sd)
    )


def _sure_by_size(value: float, sd: float, limits: Mapping[str, Any]) -> str:
    """Verdict of a time by its size, pass within four standard errors."""
    return by_size(abs(value), [limits["warn"], limits["refuse"]]) if abs(value) > 4 * sd else PASS


def _drift_gate(
    gate: str,
    own: clocks.ClockFit | None,
    pooled: clocks.Pooled | None,
    settings: Mapping[str, Any],
    system: str,
) -> Gate:
    limits = settings[gate]
    if own is None and pooled is None:
        return sized_gate(gate, None, "ppm", settings, "too little motion", "")
    candidates = []
    if pooled is not None:
        source = f"pooled over {pooled.trials} trials of the session"
        candidates.append((pooled.value, pooled.sd, limits["pooled_certainty_sd"], source))
    if own is not None and np.isfinite(own.drift_sd):
        certainty = own.certainty(limits["certainty_sd"])
        candidates.append((own.drift, own.drift_sd, certainty, "of this trial alone"))
    judged = []
    for value, sd, certainty, source in candidates:
        sure = abs(value) > certainty * sd
        judged.append(
            (
                by_size(1e6 * abs(value), [limits["warn"], limits["refuse"]]) if sure else PASS,
                value,
                sd,
                source,
            )
        )
    verdict = worst(v for v, *_ in judged)
    # the pooled figure speaks for the trial unless its own is graver
    _, value, sd, source = next(j for j in judged if j[0] == verdict)
    message = (
        f"the {system} clock drifts by {1e6 * value:.1f} +- {1e6 * clocks.NORMAL_95 * sd:.1f} ppm, {source}"
    )
    remedy = "" if verdict == PASS else f"Synchronise the {system} clock (NTP, PTP or a common trigger)."
    span = _interval(1e6 * value, 1e6 * sd)
    return sized_gate(gate, 1e6 * value, "ppm", settings, message, remedy, verdict=verdict, interval=span)


def _robot_drift(m: Measured, session: Session, settings: QualitySettings) -> Gate:
    assert m.robot is not None
    return _drift_gate("robot_drift", m.robot.clock, session.robot_drift, settings, "robot")


def _robot_residual(m: Measured, settings: QualitySettings) -> Gate:
    assert m.robot is not None
    fit = m.robot.clock
    if fit is None:
        return sized_gate("robot_residual", None, "m", settings, "nothing in common with the robot log", "")
    message = f"interface markers and the robot's joints agree to {1e3 * fit.residual_m:.2f} mm RMS per axis"
    remedy = "Check that log and export belong to one trial, and that the markers sit on the interface."
    return sized_gate("robot_residual", fit.residual_m, "m", settings, message, remedy)


def _markerless_sync(m: Measured, settings: QualitySettings) -> Gate:
    assert m.markerless is not None
    fit = m.markerless.clock
    if fit is None:
        if m.kind == "neutral":
            message = "quiet standing: nothing to synchronise by, starts laid on each other"
            return sized_gate("markerless_sync", None, "s", settings, message, "", verdict=PASS)
        message = (
            f"correlation of the pelvis speeds {m.markerless.correlation:.2f}: starts laid on each other"
        )
        remedy = "Check that both exports belong to one trial."
        return sized_gate("markerless_sync", None, "s", settings, message, remedy, verdict=WARN)
    half = clocks.NORMAL_95 * fit.offset_sd_s
    message = f"offset {1e3 * fit.offset_s:.1f} +- {1e3 * half:.1f} ms by the motion of the pelvis"
    remedy = "Record with a common trigger, or a trial with more motion."
    return sized_gate(
        "markerless_sync",
        half,
        "s",
        settings,
        message,
        remedy,
        interval=_interval(fit.offset_s, fit.offset_sd_s),
    )


def _markerless_drift(m: Measured, session: Session, settings: QualitySettings) -> Gate:
    assert m.markerless is not None
    return _drift_gate(
        "markerless_drift", m.markerless.clock, session.markerless_drift, settings, "markerless"
    )


def _markerless_residual(m: Measured, settings: QualitySettings) -> Gate:
    assert m.markerless is not None
    space = m.markerless.space
    message = (
        f"the two pelvises agree to {1e3 * space.rms_m:.1f} mm and {np.degrees(space.rms_rad):.2f} deg RMS, "
        "laid on each other"
    )
    remedy = "Check that both exports belong to one trial and one person, and their units."
    return sized_gate("markerless_residual", space.rms_m, "m", settings, message, remedy)


def _frame_robot(m: Measured, session: Session, settings: QualitySettings) -> Gate:
    limits = settings["frame_robot"]
    if m.robot is None:
        return sized_gate("frame_robot", None, "deg", settings, "no robot log", "")
    parts, verdicts = [], []
    thresholds = [limits["warn"], limits["refuse"]]
    fit = m.robot.clock
    if fit is not None and np.degrees(m.robot.floor_sd_rad) < limits["certain_deg"]:
        tilt = float(np.degrees(np.arccos(np.clip(fit.ground[2, 2], -1, 1))))
        parts.append((tilt, f"the vertical is {tilt:.2f} deg from that of the robot's floor"))
        verdicts.append(by_size(tilt, thresholds))
    if m.name in session.heading_rad and np.degrees(session.heading_sd_rad) < limits["certain_deg"]:
        turn = float(np.degrees(session.heading_rad[m.name]))
        parts.append(
            (abs(turn), f"the robot's heading is {turn:+.2f} deg from that in the person's other trials")
        )
        # odometry that was started anew turns the robot's heading, and not the lab, which the other system sees too
        still = settings["frame_markerless"]["warn"]
        alone = m.name in session.turned and abs(np.degrees(session.turned[m.name][2])) < still
        verdict = by_size(abs(turn), thresholds)
        verdicts.append(WARN if alone and verdict == REFUSE else verdict)
    if not parts:
        message = "too little motion, or an odometry that starts anew in each trial"
        return sized_gate("frame_robot", None, "deg", settings, message, "")
    value = max(size for size, _ in parts)
    remedy = (
        "Calibrate Qualisys again with the L-frame level and along the robot, or correct ingest.lab_to_world. A"
        " heading alone turns where the odometry was started anew: ingest finds it trial by trial."
    )
    message = "; ".join(text for _, text in parts)
    return sized_gate("frame_robot", value, "deg", settings, message, remedy, verdict=worst(verdicts))


def _frame_markerless(m: Measured, session: Session, settings: QualitySettings) -> Gate:
    if m.name not in session.turned:
        message = "needs the markerless pelvis of at least three trials of the person"
        return sized_gate("frame_markerless", None, "deg", settings, message, "")
    vector = np.degrees(session.turned[m.name])
    size = float(np.linalg.norm(vector))
    message = (
        f"the markerless ground is turned by {vector[2]:+.2f} deg about the vertical and "
        f"{np.hypot(vector[0], vector[1]):.2f} deg about a level axis from that in the person's other trials"
    )
    remedy = "Calibrate both systems again, or correct ingest.lab_to_world."
    return sized_gate("frame_markerless", size, "deg", settings, message, remedy)


# -------------------- what the interface sees


def reversals(values: np.ndarray, band: float) -> int:
    """Count the reversals of a signal (n,) by more than ``band``, in its unit."""
    values = values[np.isfinite(values)]
    if not len(values):
        return 0
    count, direction, extreme = 0, 0, values[0]
    for x in values:
        if (direction >= 0 and x > extreme) or (direction <= 0 and x < extreme):
            direction = direction or (1 if x > extreme else -1)
            extreme = x
        elif abs(x - extreme) > band:
            count += direction != 0
            direction, extreme = (1 if x > extreme else -1), x
    return count


def bandwidth_hz(values: np.ndarray, rate_hz: float, share: float = 0.95) -> float:
    """Return the frequency [Hz] below which ``share`` of the power of a motion (n,) lies."""
    x = np.where(np.isfinite(values), values, np.nanmean(values))
    power = np.abs(np.fft.rfft((x - x.mean()) * np.hanning(len(x)))) ** 2
    total = np.cumsum(power)
    if not total[-1] > 0:
        return 0.0
    return float(np.fft.rfftfreq(len(x), 1 / rate_hz)[np.searchsorted(total, share * total[-1])])


def _excitation(q: np.ndarray, limits: QualityExcitationSettings, rate_hz: float) -> Gate:
    """Smallest ratio over the axes of what is there to what is asked for, in range and in reversals."""
    ratios, parts = [], []
    for axis, values in zip(geometry.AXES, q.T, strict=True):
        angular = axis in _ANGULAR
        needed = np.radians(limits["range_deg"]) if angular else limits["range_m"]
        if not np.isfinite(values).any():
            ratios.append(0.0)
            parts.append(f"{axis} unknown")
            continue
        span = float(np.nanpercentile(values, 99) - np.nanpercentile(values, 1))
        turns = reversals(values, needed / 2)
        ratios.append(min(span / needed, turns / limits["reversals"]))
        shown = f"{np.degrees(span):.1f} deg" if angular else f"{1e3 * span:.0f} mm"
        parts.append(f"{axis} {shown}, {bandwidth_hz(values, rate_hz):.1f} Hz, {turns} reversals")
    value = min(ratios)
    verdict = by_size(value, [limits["warn"], limits["refuse"]])
    remedy = "Record a longer trial with more motion along the weak axis." if verdict != PASS else ""
    return Gate(
        "excitation",
        verdict,
        value,
        "1",
        [limits["warn"], limits["refuse"]],
        "; ".join(parts),
        remedy,
        None,
        "quality.excitation",
    )


def _limits(q: np.ndarray, limits: tuple[np.ndarray, np.ndarray], settings: QualityLimitsSettings) -> Gate:
    low, high = limits
    margin = settings["margin"] * (high - low)
    near = (q <= low + margin) | (q >= high - margin)
    known = np.isfinite(q)
    share = near.sum(axis=0) / np.maximum(known.sum(axis=0), 1)
    worst_axis = int(share.argmax())
    parts = ", ".join(f"{a} {100 * s:.1f} %" for a, s in zip(geometry.AXES, share, strict=True) if s > 0)
    message = f"samples at a joint limit: {parts or 'none'}"
    verdict = by_size(float(share[worst_axis]), [settings["warn"], settings["refuse"]])
    remedy = ""
    if verdict != PASS:
        middle = float(np.nanmedian(q[:, worst_axis]))
        # moving less far brings nobody back who is beyond a limit in the middle of the motion
        remedy = (
            "Move less far, or record rotation and translation at T* to the limits."
            if low[worst_axis] <= middle <= high[worst_axis]
            else "The strap stays beyond it: did it, or a marker, move after neutral? Record neutral and sweeps again."
        )
    threshold = [settings["warn"], settings["refuse"]]
    value = float(share[worst_axis])
    return Gate("limits", verdict, value, "1", threshold, message, remedy, None, "quality.limits")


def noise_cost(sd_m: float, camera_hz: float, ingest: IngestSettings, scales: dict[str, float]) -> float:
    """J that white marker noise of SD ``sd_m`` per axis and frame leaves after the low-pass, by eq. 3 of the paper.

    ``camera_hz`` is the rate of the frames [Hz]: a low-pass leaves less of the same SD the more frames there are.
    """
    rate = ingest["rate_hz"]
    sd_m = signals.white_sd_at(sd_m, camera_hz, rate)
    impulse = np.zeros(1001)
    impulse[500] = 1.0
    response = signals.lowpass(impulse, rate, ingest["cutoff_hz"], ingest["filter_order"])
    slope = (response[2:] - response[:-2]) * rate / 2
    position, velocity = 3 * sd_m**2 * np.sum(response**2), 3 * sd_m**2 * np.sum(slope**2)
    return float(position / scales["position_m"] ** 2 + velocity / scales["velocity_m_per_s"] ** 2)


def _noise(m: Measured, settings: QualitySettings, ingest: IngestSettings, scales: dict[str, float]) -> Gate:
    sd = [m.noise_m[name] for name in geometry.INTERFACE_MARKERS if np.isfinite(m.noise_m.get(name, np.nan))]
    if not sd:
        return sized_gate("noise", None, "1", settings, "no interface marker", "")
    level = float(np.sqrt(np.mean(np.square(sd))))
    cost = noise_cost(level, m.rate.declared, ingest, scales)
    message = (
        f"marker noise {1e3 * level:.2f} mm per axis (SD); alone it gives J = {cost:.3g} after the filter"
    )
    remedy = (
        "Improve the calibration or the camera set-up of Qualisys."
        if cost >= settings["noise"]["warn"]
        else ""
    )
    return sized_gate("noise", cost, "1", settings, message, remedy)
