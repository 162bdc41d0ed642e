"""What the marker trajectories say about themselves: gaps, rigid distances, swapped labels, spikes."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations

import numpy as np
from scipy.ndimage import median_filter

from real2sim import geometry, signals

MARKERS = (*geometry.PELVIS_MARKERS, *geometry.INTERFACE_MARKERS)
# Markers that sit on one body: the pelvis by itself and the interface by itself.
RIGID_PAIRS = (*combinations(geometry.PELVIS_MARKERS, 2), geometry.INTERFACE_MARKERS)
_SWAPS = tuple(combinations(range(len(MARKERS)), 2))
_UPRIGHT = 0.3  # least cosine of the pelvis' up axis to the vertical, and of the two bodies' left axes
_SPIKE_FRAMES = 7  # of the running median: spikes of up to three frames stand out of it


@dataclass(frozen=True)
class Swap:
    """Two labels exchanged over frames [start, stop)."""

    first: str
    second: str
    start: int
    stop: int


@dataclass(frozen=True)
class Gap:
    """A marker missing over frames [start, stop)."""

    marker: str
    start: int
    stop: int


def stacked(positions: dict[str, np.ndarray]) -> np.ndarray:
    """The six markers as (n, 6, 3) in the order of `MARKERS`; a marker that is not there is NaN."""
    n = len(next(iter(positions.values())))
    out = np.full((n, len(MARKERS), 3), np.nan)
    for i, name in enumerate(MARKERS):
        if name in positions:
            out[:, i] = positions[name]
    out[~np.isfinite(out).all(axis=2)] = np.nan
    return out


def distances(points: np.ndarray) -> np.ndarray:
    """Distances (n, 7) [m] of the rigid pairs of markers (n, 6, 3)."""
    index = [(MARKERS.index(a), MARKERS.index(b)) for a, b in RIGID_PAIRS]
    return np.stack([np.linalg.norm(points[:, a] - points[:, b], axis=1) for a, b in index], axis=1)


def reference_distances(positions: dict[str, np.ndarray]) -> np.ndarray:
    """Median distances (7,) [m] of a trial of quiet standing; NaN for a pair never seen together."""
    measured = distances(stacked(positions))
    out = np.full(measured.shape[1], np.nan)
    seen = np.isfinite(measured).any(axis=0)
    out[seen] = np.nanmedian(measured[:, seen], axis=0)
    return out


def _violation(points: np.ndarray, reference: np.ndarray) -> np.ndarray:
    """Largest departure (n,) [m] from the reference; infinite where left and right, or up and down, are exchanged."""
    off = np.abs(distances(points) - reference)
    out = np.where(np.isfinite(off).any(axis=1), np.nanmax(np.nan_to_num(off, nan=-1.0), axis=1), np.nan)
    rotation, _ = geometry.pelvis_frame(*np.moveaxis(points[:, :4], 1, 0))
    across = points[:, 4] - points[:, 5]
    with np.errstate(invalid="ignore"):
        flipped = rotation[:, 2, 2] < _UPRIGHT
        along = np.einsum("ni,ni->n", rotation[:, :, 1], across) / np.linalg.norm(across, axis=1)
        flipped |= along < _UPRIGHT
    out[flipped] = np.inf
    return out


def departures(positions: dict[str, np.ndarray], reference: np.ndarray) -> np.ndarray:
    """Departure (n, 7) [m] of the rigid distances from the reference, NaN where a marker is missing."""
    return distances(stacked(positions)) - reference


def find_swaps(
    positions: dict[str, np.ndarray], reference: np.ndarray, *, violation_m: float, restored_m: float
) -> list[Swap]:
    """Spans over which exchanging exactly one pair of labels restores every rigid distance and orientation.

    A frame is looked at where a distance departs by more than ``violation_m`` or a body is the wrong way round;
    an exchange counts if it brings everything within ``restored_m``, and only if no other one does.
    """
    points = stacked(positions)
    with np.errstate(invalid="ignore", divide="ignore"):
        bad = np.flatnonzero(_violation(points, reference) > violation_m)
        if not len(bad):
            return []
        some = points[bad]
        fits = np.zeros((len(_SWAPS), len(bad)), bool)
        for k, (a, b) in enumerate(_SWAPS):
            order = np.arange(len(MARKERS))
            order[[a, b]] = b, a
            there = np.isfinite(some[:, a, 0]) & np.isfinite(some[:, b, 0])
            fits[k] = there & (_violation(some[:, order], reference) <= restored_m)
    label = np.full(len(points), -1)
    label[bad] = np.where(fits.sum(axis=0) == 1, fits.argmax(axis=0), -1)
    out = []
    for k in np.unique(label[label >= 0]):
        a, b = _SWAPS[k]
        spread = _spread(points, reference, label == k, a, b)
        out += [Swap(MARKERS[a], MARKERS[b], run.start, run.stop) for run in signals.segments(spread)]
    return sorted(out, key=lambda swap: swap.start)


def _spread(points: np.ndarray, reference: np.ndarray, sure: np.ndarray, a: int, b: int) -> np.ndarray:
    """Frames of an exchange: those that are sure, and their neighbours as long as it fits better than the labels."""
    order = np.arange(len(MARKERS))
    order[[a, b]] = b, a
    with np.errstate(invalid="ignore", divide="ignore"):
        better = _violation(points[:, order], reference) < _violation(points, reference)
    out = sure.copy()
    for run in signals.segments(sure | better):
        if sure[run].any():
            out[run] = True
    return out


def repaired(positions: dict[str, np.ndarray], swaps: list[Swap]) -> dict[str, np.ndarray]:
    """Positions with the labels exchanged back."""
    out = {name: values.copy() for name, values in positions.items()}
    for swap in swaps:
        span = slice(swap.start, swap.stop)
        out[swap.first][span], out[swap.second][span] = (
            positions[swap.second][span],
            positions[swap.first][span],
        )
    return out


def find_gaps(positions: dict[str, np.ndarray]) -> list[Gap]:
    """Every span over which one of the six markers is missing."""
    out = []
    for name in MARKERS:
        if name in positions:
            missing = ~signals.known(positions[name])
            out += [Gap(name, run.start, run.stop) for run in signals.segments(missing)]
    return out


def spikes(values: np.ndarray, height_m: float) -> np.ndarray:
    """Frames (k,) at which a marker (n, 3) [m] stands more than ``height_m`` out of its running median."""
    good = signals.known(values)
    if good.sum() < 2 * _SPIKE_FRAMES:
        return np.zeros(0, int)
    rows = np.arange(len(values))
    filled = np.column_stack([np.interp(rows, rows[good], values[good, i]) for i in range(3)])
    off = np.linalg.norm(filled - median_filter(filled, size=(_SPIKE_FRAMES, 1), mode="nearest"), axis=1)
    return np.flatnonzero((off > height_m) & good)


def noise_sd(values: np.ndarray) -> float:
    """SD [m] per axis of a marker's white noise by second differences, which movement hardly enters; NaN if unknown."""
    second = np.diff(values, 2, axis=0)
    second = second[signals.known(second)]
    return float(np.sqrt(np.mean(second**2) / 6)) if len(second) else float("nan")
