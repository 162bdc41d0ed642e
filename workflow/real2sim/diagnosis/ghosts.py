"""Pelvis markers that jump for some frames: another reflection was taken for them.

A jump is of one marker and not of the other three, whatever the body does. The pose is taken from those as long as it
lasts. Without that the replayed pelvis jumps, and shakes the robot in the simulation for seconds.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from real2sim import signals
from real2sim.geometry import pelvis_frame
from real2sim.identification.trial import Trial, usable

# A marker jumps where what is faster than the cut-off in its path, less what the others do, stands out by so many SD,
# and by more than what filters make of noise [m]; the low-pass of the ingest smears it so far, and so far from the end
# of a path nothing is looked for [s]
CUTOFF_HZ, SD, LEAST_M, SMEAR_S, EDGE_S = 4.0, 8.0, 1e-3, 0.1, 0.05


def ghosts(markers: np.ndarray, rate_hz: float) -> np.ndarray:
    """Which of the pelvis' markers (n, 4, 3) [m] are another reflection, (n, 4), with what a filter smears of it."""
    n = len(markers)
    lost = ~np.isfinite(markers).all(axis=2)
    if lost.all(axis=0).any():
        return np.zeros((n, 4), bool)
    flat = signals.bridged(markers.reshape(n, 12))
    fast = (flat - signals.lowpass(flat, rate_hz, CUTOFF_HZ, 4)).reshape(n, 4, 3)
    alone = np.linalg.norm(fast - np.median(fast, axis=1, keepdims=True), axis=2)
    near = np.ones(2 * round(EDGE_S * rate_hz) + 1)
    ends = np.pad(lost, ((1, 1), (0, 0)), constant_values=True)
    at_edge = np.stack([np.convolve(row, near, "same")[1:-1] > 0 for row in ends.T], axis=1)
    jumps = (alone > np.maximum(SD * np.median(alone, axis=0), LEAST_M)) & ~at_edge
    width = np.ones(2 * round(SMEAR_S * rate_hz) + 1)
    return np.stack([np.convolve(row, width, "same") > 0 for row in jumps.T], axis=1)


def without_ghosts(trial: Trial, rate_hz: float, settle_s: float) -> Trial:
    """The trial with the pelvis from its other three markers where one is a ghost, unknown where two are.

    Skin goes on as it did: a ghost is put where its marker was to the other three before, and is after. ``settle_s``:
    see `load_trial`.
    """
    found = ghosts(trial.pelvis_markers, rate_hz)
    if not found.any():
        return trial
    markers = trial.pelvis_markers.copy()
    for marker in np.flatnonzero(found.any(axis=0)):
        others = [i for i in range(4) if i != marker]
        rotation, origin = _frame(trial.pelvis_markers[:, others])
        place = np.einsum("nji,nj->ni", rotation, trial.pelvis_markers[:, marker] - origin)
        place[found.any(axis=1)] = np.nan
        if not np.isfinite(place).any():
            continue
        put = origin + np.einsum("nij,nj->ni", rotation, signals.bridged(place))
        markers[found[:, marker], marker] = put[found[:, marker]]
    markers[found.sum(axis=1) > 1] = np.nan
    changed = found.any(axis=1)
    rotation, position = trial.pelvis_rotation.copy(), trial.pelvis_position.copy()
    rotation[changed], position[changed] = pelvis_frame(*np.moveaxis(markers[changed], 1, 0))
    counts = trial.usable & usable(np.isfinite(position).all(axis=1), rate_hz, settle_s)
    there = replace(trial, pelvis_rotation=rotation, pelvis_position=position)
    return replace(there, pelvis_markers=markers, usable=counts)


def _frame(markers: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Frames (n, 3, 3) and origins (n, 3) of three markers (n, 3, 3)."""
    a, b, c = np.moveaxis(markers, 1, 0)
    return pelvis_frame(a, b, c, c)
