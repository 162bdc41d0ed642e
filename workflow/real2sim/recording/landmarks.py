"""Landmarks of a markerless system (.trc): by our names, and the pelvis that they show."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from real2sim import geometry, signals
from real2sim.errors import InputError
from real2sim.recording.alignment import OPENSIM_TO_WORLD, PelvisPath
from real2sim.recording.formats.recordings import MarkerRecording


def name_landmarks(
    path: Path, recording: MarkerRecording, marker_names: Mapping[str, str], max_gap_s: float
) -> dict[str, np.ndarray]:
    """Return the landmarks by our names, (n, 3) [m] in the file's frame, with gaps up to ``max_gap_s`` [s] filled.

    Raises InputError where two of them are the same marker of ours.
    """
    points: dict[str, np.ndarray] = {}
    for lab, values in recording.positions.items():
        ours = marker_names.get(lab, lab)
        if ours in points:
            remedy = "correct markers: in subject.yaml"
            raise InputError(path, "names", f"two landmarks that are {ours}", "one", remedy, "names")
        points[ours], _ = signals.fill_gaps(values, recording.rate_hz, max_gap_s)
    return points


def missing_of_pelvis(points: Mapping[str, np.ndarray]) -> list[str]:
    """Return the markers of the pelvis that are not among the landmarks (n, 3) [m]."""
    return [name for name in geometry.PELVIS_MARKERS if name not in points]


def pelvis_of_landmarks(time_s: np.ndarray, points: Mapping[str, np.ndarray]) -> PelvisPath:
    """Return the pelvis of its four landmarks, in z-up axes of the file's ground; times (n,) [s]."""
    world = (points[name] @ OPENSIM_TO_WORLD.T for name in geometry.PELVIS_MARKERS)
    return PelvisPath(time_s, *geometry.pelvis_frame(*world))
