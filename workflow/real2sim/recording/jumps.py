"""Markers that jump for some frames: another reflection was taken for them.

A jump of an interface marker stands out of its path, or of what a simulation leaves of it; such samples are left out
where `outliers` is the cause. A jump of a pelvis marker is of that one and not of the other three, whatever the body
does. The pose is taken from those as long as it lasts: the replayed pelvis would jump, and shake the robot for seconds.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from real2sim import signals
from real2sim.geometry import PELVIS_MARKERS, pelvis_frame
from real2sim.recording.trial import Trial, usable

# No marker is trusted beyond this [m]
MARKER_FLOOR_M = 5e-5
# A jump stands out of what is faster than this
CUTOFF_HZ = 4.0
# ... by so many SD, of a path or of what the best fit leaves of it; the low-pass of the ingest smears it so far [s]
SPIKE_SD, SPIKE_RESIDUAL_SD, SPIKE_SMEAR_S = 7.0, 5.0, 0.08
# ... and of what the other pelvis markers do, and by more than what filters make of noise [m]
GHOST_SD, GHOST_M, GHOST_SMEAR_S = 8.0, 1e-3, 0.1
# So far from the end of a path its noise is as loud as anywhere [s]
EDGE_S = 0.05


def spikes(paths: np.ndarray, rate_hz: float, sd: float = SPIKE_SD) -> np.ndarray:
    """Where marker paths, or residuals of them, (n, k, 3) jump, (n, k): fast content beyond ``sd`` times the usual.

    With it comes what the filter smears around it. Where a path begins or ends, also at a gap, a filter has one side
    only and leaves most of the noise: nothing is looked for there.
    """
    fast = np.abs(_fast(paths, rate_hz))
    usual = np.median(fast, axis=0) / 0.6745
    hit = (fast > sd * np.maximum(usual, MARKER_FLOOR_M)).any(axis=2)
    return _smeared(hit, paths, rate_hz, SPIKE_SMEAR_S)


def ghosts(markers: np.ndarray, rate_hz: float) -> np.ndarray:
    """Which of the pelvis' markers (n, 4, 3) [m] are another reflection, (n, 4), with what a filter smears of it."""
    if np.isnan(markers).any(axis=2).all(axis=0).any():
        return np.zeros(markers.shape[:2], bool)
    fast = _fast(markers, rate_hz)
    alone = np.linalg.norm(fast - np.median(fast, axis=1, keepdims=True), axis=2)
    hit = alone > np.maximum(GHOST_SD * np.median(alone, axis=0), GHOST_M)
    return _smeared(hit, markers, rate_hz, GHOST_SMEAR_S)


def _fast(paths: np.ndarray, rate_hz: float) -> np.ndarray:
    """What is faster than the cut-off in paths (n, k, 3)."""
    flat = signals.bridged(paths.reshape(len(paths), -1))
    return np.asarray(flat - signals.lowpass(flat, rate_hz, CUTOFF_HZ, 4)).reshape(paths.shape)


def _smeared(hit: np.ndarray, paths: np.ndarray, rate_hz: float, smear_s: float) -> np.ndarray:
    """Hits (n, k) that are not at an end of their path (n, k, 3), and the samples around them."""
    lost = np.pad(~np.isfinite(paths).all(axis=2), ((1, 1), (0, 0)), constant_values=True)
    inside = hit & ~around(lost, rate_hz, EDGE_S)[1:-1]
    return around(inside, rate_hz, smear_s)


def around(marked: np.ndarray, rate_hz: float, reach_s: float) -> np.ndarray:
    """Samples (n, k) that are no further than a time from marked ones."""
    width = np.ones(2 * round(reach_s * rate_hz) + 1)
    return np.stack([np.convolve(column, width, "same") > 0.5 for column in marked.T], axis=1)


def without_ghosts(trial: Trial, rate_hz: float, settle_s: float) -> tuple[Trial, dict[str, float]]:
    """The trial with the pelvis from its other three markers where one is a ghost, unknown where two are.

    Skin goes on as it did: a ghost is put where its marker was to the other three before, and is after. ``settle_s``:
    see `load_trial`. Also for how long [s] which markers are not believed.
    """
    found = ghosts(trial.pelvis_markers, rate_hz)
    lasts = found.sum(axis=0) / rate_hz
    jumped = {name: float(s) for name, s in zip(PELVIS_MARKERS, lasts, strict=True) if s}
    if not jumped:
        return trial, {}
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
    return replace(there, pelvis_markers=markers, usable=counts), jumped


def _frame(markers: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Frames (n, 3, 3) and origins (n, 3) of three markers (n, 3, 3)."""
    a, b, c = np.moveaxis(markers, 1, 0)
    return pelvis_frame(a, b, c, c)
