"""Units of markerless angles: judged by what a body can do, and by the pelvis of the markers."""

from __future__ import annotations

import re
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from real2sim import geometry
from real2sim.errors import InputError
from real2sim.recording.alignment import PelvisPath
from real2sim.recording.formats.recordings import CoordinateRecording, RobotLog

if TYPE_CHECKING:
    from real2sim.settings import IngestUnitsSettings

# Joints that stop short of half a turn. Not the pelvis' heading and the arms; knee_angle_r_beta is the patella's.
_STOPPED = re.compile(r"pelvis_(tilt|list)|(hip|knee|ankle|subtalar|mtp|lumbar)_(?!.*beta).*")
_TO_DEGREES = "write inDegrees=yes into the header, or export again in degrees"
_TO_RADIANS = "write inDegrees=no into the header, or export again in degrees"


def guess_unit(extent: float, low: float, high: float) -> str:
    """Return which unit markers may be in that span ``extent`` [m] as read, instead of ``low`` to ``high`` [m]."""
    if extent > high:
        return "a unit smaller than millimetres (C3D: than POINT:UNITS), or outliers"
    for factor, unit in ((10, "centimetres"), (1000, "metres")):
        if low <= factor * extent <= high:
            return f"{unit} in a file of millimetres"
    return "a unit larger than millimetres"


def check_kinds(path: Path, recording: CoordinateRecording) -> None:
    """Refuse coordinates in degrees of which neither name nor configuration says whether they are translations."""
    if not recording.in_degrees or not recording.unknown:
        return
    expected = "names that say whether they are rotations, in degrees, or translations, in metres"
    remedy = "say which they are: ingest.markerless.rotations or ingest.markerless.translations in config/config.yaml"
    place = f"column {', '.join(recording.unknown)}"
    raise InputError(path, place, "angles or lengths?", expected, remedy, "coordinate_kind")


def check_angles(path: Path, recording: CoordinateRecording, settings: IngestUnitsSettings) -> None:
    """Refuse angles that no joint reaches, which are degrees read as radians where the file says radians."""
    limit = settings["largest_angle_deg"]
    reached = {
        name: float(np.nanmax(np.abs(values)))
        for name, values in recording.columns.items()
        if _STOPPED.fullmatch(name) and np.isfinite(values).any()
    }
    name = max(reached, key=lambda key: reached[key], default="")
    if not name or np.degrees(reached[name]) <= limit:
        return
    found = f"{np.degrees(reached[name]):.0f} deg"
    remedy = "export the coordinates again"
    if not recording.in_degrees:
        found += f": the file holds {reached[name]:.4g}, degrees that are taken for radians"
        remedy = _TO_DEGREES
    raise InputError(path, f"column {name}", found, f"at most {limit:g} deg", remedy, "units_contradicted")


def check_thousands(
    path: Path,
    ours: PelvisPath,
    other: PelvisPath,
    settings: IngestUnitsSettings,
    *,
    landmarks: bool,
) -> None:
    """Refuse times in milliseconds and lengths in another unit, by the clock and the pelvis of the markers.

    ``ours`` is the pelvis of the markers, ``other`` that of the coordinates or ``landmarks``; each on its own clock.
    """
    lasts, ours_lasts = float(np.ptp(other.time_s)), float(np.ptp(ours.time_s))
    if _is_thousand(lasts, ours_lasts, settings):
        what = "landmarks" if landmarks else "coordinates"
        found = f"{lasts:.4g} s of {what} beside {ours_lasts:.4g} s of markers: milliseconds?"
        remedy = "export the times in seconds"
        raise InputError(path, "column time", found, "times in seconds", remedy, "units_contradicted")
    travelled, ours_travelled = _travelled(other.position), _travelled(ours.position)
    found = f"a pelvis that travels by {travelled:.3g} m (RMS), and by {ours_travelled:.3g} m in the markers"
    larger = _is_thousand(travelled, ours_travelled, settings)
    if landmarks and (larger or _is_thousand(ours_travelled, travelled, settings)):
        found += (
            ": centimetres or millimetres in a file of metres?"
            if larger
            else ": metres in a file of millimetres?"
        )
        remedy = "write the true unit under Units in the header, or export the landmarks again"
        expected = "landmarks in the unit that the header says"
        raise InputError(path, "key Units", found, expected, remedy, "units_contradicted")
    if larger:
        remedy = "export the translations in metres"
        found += ": centimetres or millimetres?"
        raise InputError(path, "pelvis", found, "translations in metres", remedy, "units_contradicted")


def _is_thousand(one: float, other: float, settings: IngestUnitsSettings) -> bool:
    """Return whether one number is about a thousand times the other: a wrong unit, and no difference of two systems."""
    least, most = settings["thousand"]
    return least * other < one < most * other


def check_pelvis(
    path: Path,
    recording: CoordinateRecording,
    ours: PelvisPath,
    other: PelvisPath,
    settings: IngestUnitsSettings,
) -> None:
    """Refuse a pelvis that travels as that of the markers, and turns many times as much or as little.

    ``ours`` is the pelvis of the markers, ``other`` that of the coordinates; each on its own clock.
    """
    limits = settings["pelvis_angles"]
    turned, theirs = _turned_deg(ours.rotation), _turned_deg(other.rotation)
    travelled = _travelled(ours.position), _travelled(other.position)
    times = theirs / turned if turned > 0 else np.inf
    seen = turned >= limits["markers_moved_deg"] if times < 1 else theirs >= limits["markerless_moved_deg"]
    if not np.isfinite([turned, theirs, *travelled]).all() or not seen:
        return
    if (
        max(travelled) > limits["travel_ratio"] * min(travelled)
        or 1 / limits["ratio"] < times < limits["ratio"]
    ):
        return
    found = f"a pelvis that turns by {theirs:.2g} deg (RMS), and by {turned:.2g} deg in the markers"
    if times < 1 and recording.in_degrees:
        found, remedy = f"{found}: radians that are taken for degrees", _TO_RADIANS
    elif times > 1 and not recording.in_degrees:
        found, remedy = f"{found}: degrees that are taken for radians", _TO_DEGREES
    else:
        remedy = "export the coordinates again in degrees, and check how they are converted"
    expected = f"less than {limits['ratio']:g} times as much or as little"
    raise InputError(path, "pelvis", found, expected, remedy, "units_contradicted")


def check_log(path: Path, log: RobotLog, settings: IngestUnitsSettings) -> None:
    """Refuse arm angles in degrees and a lift in millimetres: no arm rolls or pitches that far, or is that high."""
    angle = settings["arm_angle_rad"], "rad", "degrees"
    reaches = {
        "arm_lift": (settings["arm_lift_m"], "m", "millimetres"),
        "arm_roll": angle,
        "arm_pitch": angle,
    }
    for joint, (most, unit, other) in reaches.items():
        positions = log.joints[joint][:, 0]
        reached = float(np.nanmax(np.abs(positions), initial=0.0))
        if reached > most:
            found, expected = f"{reached:.4g} {unit}: {other}?", f"{unit}, at most {most:g}"
            place, remedy = f"topic /joint_states, {joint}", f"publish {joint} in {unit}"
            raise InputError(path, place, found, expected, remedy, "units_contradicted")


def _turned_deg(rotation: np.ndarray) -> float:
    """Return the RMS angle [deg] of rotations (n, 3, 3) from their mean; NaN where none is known."""
    good = rotation[np.isfinite(rotation).all(axis=(1, 2))]
    if not len(good):
        return float("nan")
    cosine = (np.einsum("ij,nij->n", geometry.mean_rotation(good), good) - 1) / 2
    return float(np.degrees(np.sqrt(np.mean(np.arccos(np.clip(cosine, -1, 1)) ** 2))))


def _travelled(position: np.ndarray) -> float:
    """Return the RMS distance [m] of positions (n, 3) from their mean; NaN where none is known."""
    good = position[np.isfinite(position).all(axis=1)]
    return float(np.sqrt(np.sum(good.var(axis=0)))) if len(good) else float("nan")
