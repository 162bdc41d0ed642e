"""Gates on whether a trial is what its name says: length, stillness, sameness, files of one trial, scale."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from real2sim.recording.quality import pairing
from real2sim.recording.quality.scale import ScaleFit
from real2sim.recording.quality.verdict import PASS, REFUSE, Gate, by_size, sized_gate, worst

if TYPE_CHECKING:
    from real2sim.recording.quality.measure import Measured
    from real2sim.settings import QualitySettings

GATES = ("length", "still", "same", "robot_pair", "markerless_pair", "scale")


def judge(m: Measured, settings: QualitySettings) -> list[Gate]:
    """Return the verdicts of these gates on one trial."""
    out = [_length(m, settings), _same(m)]
    if m.kind == "neutral":
        out.append(_still(m, settings))
    if m.robot is not None:
        out.append(_pair("robot_pair", "robot log", m, m.robot.shared, settings))
    if m.markerless is not None:
        out.append(_pair("markerless_pair", "markerless", m, m.markerless.shared, settings))
    out.append(_scale(m, settings))
    return out


def _length(m: Measured, settings: QualitySettings) -> Gate:
    lengths = m.identity.lengths
    if not lengths:
        return sized_gate("length", None, "1", settings, "no file declares its length", "")
    off = {system: abs(1 - x.found / max(x.declared, 1)) for system, x in lengths.items()}
    system = max(off, key=off.__getitem__)
    length = lengths[system]
    message = f"{system}: the header declares {length.declared} rows, the file has {length.found}"
    remedy = "Export or copy the file again: it is cut off, or joined." if off[system] else ""
    return sized_gate("length", off[system], "1", settings, message, remedy)


def _still(m: Measured, settings: QualitySettings) -> Gate:
    """Largest of the ranges of quiet standing, each as a share of the range that is allowed."""
    sway, limits = m.identity.sway, settings["still"]
    if sway is None:
        return sized_gate("still", None, "1", settings, "the pelvis is never seen", "")
    turn = float(np.degrees(sway.rotation_rad))
    moved = max(sway.pelvis_m, sway.interface_m) / limits["range_m"]
    value = max(moved, turn / limits["range_deg"])
    message = (
        f"the pelvis moves by {1e3 * sway.pelvis_m:.0f} mm and {turn:.1f} deg, the interface by "
        f"{1e3 * sway.interface_m:.0f} mm; from the first to the last second the pelvis drifts by "
        f"{1e3 * sway.drift_m:.0f} mm and {np.degrees(sway.drift_rad):.1f} deg"
    )
    remedy = "Record neutral again: stand still with the robot at rest, or crop the export to the quiet part."
    return sized_gate("still", value, "1", settings, message, remedy if value >= limits["warn"] else "")


def _same(m: Measured) -> Gate:
    if not m.identity.same:
        message = "no other trial of the person is the same recording"
        return sized_gate("same", None, "1", None, message, "")
    same = min(m.identity.same, key=lambda s: s.ratio)
    other = same.second if same.first == m.name else same.first
    return same_gate(other, same.ratio, same.file)


def same_gate(other: str, ratio: float, file: str) -> Gate:
    """Return the refusal of a trial that is the same recording as ``other``.

    ``ratio`` is the difference of the markers over their noise [1]; ``file`` is the kind of file that both have byte
    for byte, empty if none.
    """
    how = (
        f"the {file} file is the same, byte for byte" if file else f"they differ by {ratio:.2f} of the noise"
    )
    message = f"the same recording as {other}: {how}, and two recordings differ by more than their noise"
    remedy = "Export the right recording under this name, or exclude one of the two in subject.yaml."
    value = ratio if np.isfinite(ratio) else None
    return Gate("same", REFUSE, value, "1", None, message, remedy, None, "quality.same.least_difference")


def _pair(
    gate: str, system: str, m: Measured, shared: pairing.Shared | None, settings: QualitySettings
) -> Gate:
    remedy = f"Put the {system} file of this trial in place; two trials may have been exchanged."
    exchanged = m.identity.exchanged.get(system)
    if exchanged is not None:
        message = (
            f"the {system} of {exchanged.trial} fits the markers of this trial better: residual "
            f"{1e3 * exchanged.other_m:.1f} mm RMS, its own {1e3 * exchanged.own_m:.1f} mm "
            f"({exchanged.certainty:.0f} standard errors)"
        )
        apart = shared.apart if shared is not None else None
        return sized_gate(gate, apart, "1", settings, message, remedy, verdict=REFUSE)
    if shared is None or shared.motion_m < settings[gate]["least_motion_m"]:  # type: ignore[literal-required]
        message = f"too little motion to say whether the {system} belongs to the trial"
        return sized_gate(gate, None, "1", settings, message, "")
    message = (
        f"of {1e3 * shared.motion_m:.0f} mm RMS of motion, {1e3 * shared.residual_m:.1f} mm are not shared "
        f"with the {system}"
    )
    warned = shared.apart >= settings[gate]["warn"]  # type: ignore[literal-required]
    return sized_gate(gate, shared.apart, "1", settings, message, remedy if warned else "")


def _scale(m: Measured, settings: QualitySettings) -> Gate:
    """Scale of the markers less 1 [%]: judged by the part of it that the 95 % interval leaves."""
    known = _scales(m, settings)
    if not known:
        return sized_gate("scale", None, "%", settings, "too little motion to compare metres by", "")
    limits = settings["scale"]
    threshold = [limits["warn"], limits["refuse"]]
    verdicts = {system: by_size(100 * _sure(fit), threshold) for system, fit in known.items()}
    verdict = worst(verdicts.values())
    # the sharper of those that say so
    system = min((s for s in known if verdicts[s] == verdict), key=lambda s: known[s].half)
    value, half = 100 * (known[system].value - 1), 100 * known[system].half
    message = "; ".join(
        f"lengths of the markers are {100 * (fit.value - 1):+.2f} +- {100 * fit.half:.2f} % off those of the {name}"
        for name, fit in known.items()
    )
    remedy = (
        ""
        if verdict == PASS
        else "Check the wand length of the Qualisys calibration, and units of all files."
    )
    span = [value - half, value + half]
    return sized_gate("scale", value, "%", settings, message, remedy, verdict=verdict, interval=span)


def _scales(m: Measured, settings: QualitySettings) -> dict[str, ScaleFit]:
    """Scale against each system whose file belongs to the trial, and whose interval is narrower than the threshold.

    A slope that is known to a third says nothing of a per cent: what soft tissue makes of little motion is not in its
    interval.
    """
    out = {}
    exchanged, robot, markerless = m.identity.exchanged, m.robot, m.markerless
    if robot is not None and robot.scale is not None and "robot log" not in exchanged:
        shared = robot.shared
        if shared is not None and shared.apart < settings["robot_pair"]["refuse"]:
            out["robot"] = robot.scale
    if markerless is not None and markerless.scale is not None and "markerless" not in exchanged:
        out["markerless system"] = markerless.scale
    return {name: fit for name, fit in out.items() if 100 * fit.half <= settings["scale"]["refuse"]}


def _sure(fit: ScaleFit) -> float:
    """The part of a departure from 1 that lies outside its interval."""
    return max(abs(fit.value - 1) - fit.half, 0.0)
