"""What the marker trajectories say about themselves: gaps, rigid distances, swapped labels, spikes."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from scipy.ndimage import median_filter
from scipy.spatial.transform import Rotation

from real2sim import geometry, signals

MARKERS = (*geometry.PELVIS_MARKERS, *geometry.INTERFACE_MARKERS)


def needed(kind: str) -> list[str]:
    """Return the markers that a trial of a kind needs: no one wears the strap in a normal walk."""
    return [*geometry.PELVIS_MARKERS, *(() if kind == "walk_normal" else geometry.INTERFACE_MARKERS)]


def without_unseen(positions: Mapping[str, np.ndarray], needed: Collection[str]) -> dict[str, np.ndarray]:
    """Return trajectories (n, 3) without markers that are never seen, but for those that are needed."""
    return {
        name: values for name, values in positions.items() if name in needed or signals.known(values).any()
    }


def find_frozen(
    positions: Mapping[str, np.ndarray], *, frames: int, moved_steps: float, jump_m: float
) -> list[Gap]:
    """Return the spans [start, stop) over which a marker (n, 3) [m] stands still to the last digit while others move.

    That is a gap that somebody filled with its last sample: ``frames`` and more that repeat the one before. The others
    have to move by ``moved_steps`` of the steps in which the file counts: in one with few digits, a slow marker repeats
    itself. The sample that is repeated counts as seen, unless the marker jumps to it by more than ``jump_m`` [m]: then
    it is a number that stands for a missing sample, as 9999.999.
    """
    seen = {name: signals.known(values) for name, values in positions.items()}
    repeats = {
        name: np.concatenate([[False], (np.diff(values, axis=0) == 0).all(axis=1)])
        for name, values in positions.items()
    }
    runs = [
        (name, run)
        for name, again in repeats.items()
        for run in signals.segments(again & seen[name])
        if run.stop - run.start >= frames
    ]
    least = moved_steps * _step(positions) if runs else 0.0
    out = []
    for name, run in runs:
        moved = [
            float(np.abs(values[run] - values[run.start]).max())
            for other, values in positions.items()
            if other != name and seen[other][run].all()
        ]
        if moved and np.median(moved) >= least:
            made_up = _jump_into(positions[name], seen[name], run) > jump_m
            out.append(Gap(name, run.start - made_up, run.stop))
    return out


def _jump_into(values: np.ndarray, seen: np.ndarray, run: slice) -> float:
    """Return how far [m] a marker (n, 3) is, at the sample that ``run`` repeats, from where it was last seen before.

    From where it is next seen, in a record that begins with that sample; 0 if it is never seen elsewhere.
    """
    first = run.start - 1
    beside = [*np.flatnonzero(seen[:first])[-1:], *(run.stop + np.flatnonzero(seen[run.stop :])[:1])]
    return float(np.linalg.norm(values[first] - values[beside[0]])) if beside else 0.0


def _step(positions: Mapping[str, np.ndarray]) -> float:
    """Return the step [m] in which a file counts: the smallest change of a coordinate from one frame to the next."""
    changes = np.abs(np.concatenate([np.diff(values, axis=0).ravel() for values in positions.values()]))
    # what binary numbers make of a decimal is no step
    changes = changes[changes > _NO_STEP]
    return float(changes.min()) if len(changes) else np.inf


def without_frozen(positions: Mapping[str, np.ndarray], frozen: Collection[Gap]) -> dict[str, np.ndarray]:
    """Return trajectories (n, 3) [m] that are missing (NaN) over spans of `find_frozen`."""
    out = dict(positions)
    for gap in frozen:
        out[gap.marker] = out[gap.marker].copy()
    for gap in frozen:
        out[gap.marker][gap.start : gap.stop] = np.nan
    return out


# Markers that sit on one body: the pelvis by itself and the interface by itself.
RIGID_PAIRS = (*combinations(geometry.PELVIS_MARKERS, 2), geometry.INTERFACE_MARKERS)
_SWAPS = tuple(combinations(range(len(MARKERS)), 2))
_UPRIGHT = 0.3  # least cosine of the pelvis' up axis to the vertical, and of the two bodies' left axes
_ENOUGH = 50  # frames to see how skin slides
_ROUNDS = 15  # of reweighting
_HUBER = 2.0  # in median absolute residuals, 1.35 SD of a normal distribution
_NO_STEP = 1e-9  # a smaller change of a coordinate is rounding [m]
_SPIKE_FRAMES = 7  # of the running median: spikes of up to three frames stand out of it


@dataclass(frozen=True)
class Swap:
    """Two labels exchanged over frames [start, stop).

    ``unsure`` are frames [start, stop) beside it, up to where the labels are right again, in which a marker is missing,
    so that nothing says whether they are.
    """

    first: str
    second: str
    start: int
    stop: int
    unsure: tuple[tuple[int, int], ...] = ()


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
    departure: np.ndarray = distances(stacked(positions)) - reference
    return departure


def find_swaps(
    positions: dict[str, np.ndarray], reference: np.ndarray, *, violation_m: float, restored_m: float
) -> list[Swap]:
    """Spans over which exchanging exactly one pair of labels restores every rigid distance and orientation.

    ``positions`` (n, 3) [m] by marker, ``reference`` (7,) [m] as of `reference_distances`. A frame is looked at where a
    distance departs by more than ``violation_m`` or a body is the wrong way round; an exchange counts if it brings
    everything within ``restored_m``, and only if no other one does, and if the labels jump where it begins and ends:
    skin that slides far moves distances too, but it does so without a jump.
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
    out: list[Swap] = []
    for k in np.unique(label[label >= 0]):
        out += _swaps_of(points, reference, label == k, *_SWAPS[k])
    return sorted(out, key=lambda swap: swap.start)


def _swaps_of(points: np.ndarray, reference: np.ndarray, sure: np.ndarray, a: int, b: int) -> list[Swap]:
    """Return the spans over which labels ``a`` and ``b`` are exchanged, where frames ``sure`` (n,) say so.

    Neighbours belong to a span as long as the exchange fits better than the labels. A gap of a marker belongs to it
    where the labels are exchanged on both sides, or on one and the record ends on the other.
    """
    better, silent = _evidence(points, reference, a, b)
    spread = sure.copy()
    for run in signals.segments(sure | better):
        if sure[run].any():
            spread[run] = True
    silent &= ~spread
    unsure = []
    for run in signals.segments(silent):
        sides = [spread[i] for i in (run.start - 1, run.stop) if 0 <= i < len(spread)]
        if sides and all(sides):
            spread[run] = True
        elif any(sides):
            unsure.append((run.start, run.stop))
    return [
        Swap(
            MARKERS[a],
            MARKERS[b],
            run.start,
            run.stop,
            tuple(gap for gap in unsure if gap[1] == run.start or gap[0] == run.stop),
        )
        for run in signals.segments(spread)
        if _jumps(points, a, b, run, silent)
    ]


def _evidence(points: np.ndarray, reference: np.ndarray, a: int, b: int) -> tuple[np.ndarray, np.ndarray]:
    """Return where exchanging two labels fits better (n,), and where nothing tells, for want of a marker (n,)."""
    order = np.arange(len(MARKERS))
    order[[a, b]] = b, a
    there = np.isfinite(points[:, [a, b], 0]).all(axis=1)
    with np.errstate(invalid="ignore", divide="ignore"):
        as_labelled, exchanged = _violation(points, reference), _violation(points[:, order], reference)
        # the interface's two markers show by the pelvis alone which is which
        same = np.isnan(as_labelled) | np.isnan(exchanged) | (as_labelled == exchanged)
        return there & (exchanged < as_labelled), ~there | (same & ~np.isinf(as_labelled))


def _jumps(points: np.ndarray, a: int, b: int, run: slice, silent: np.ndarray) -> bool:
    """Return whether two labels (of (n, 6, 3)) go on smoothly at both ends of a span only if they are exchanged there.

    Frames that tell nothing, ``silent`` (n,), are passed over. An end that is the record's says nothing.
    """
    told = np.flatnonzero(~silent)
    inside = told[(told >= run.start) & (told < run.stop)]
    outside = told[told < run.start][-1:], told[told >= run.stop][:1]
    for within, beyond in zip((inside[:1], inside[-1:]), outside, strict=True):
        if not len(within) or not len(beyond):
            continue
        (a_0, b_0), (a_1, b_1) = points[beyond[0], [a, b]], points[within[0], [a, b]]
        kept = np.linalg.norm(a_1 - a_0) + np.linalg.norm(b_1 - b_0)
        exchanged = np.linalg.norm(b_1 - a_0) + np.linalg.norm(a_1 - b_0)
        if kept <= exchanged:  # false where one is NaN
            return False
    return True


def skin(departure: np.ndarray, rotation: np.ndarray) -> np.ndarray:
    """Return the part (n, 7) [m] of the departures of the rigid distances (n, 7) [m] that sliding skin explains.

    The part that is linear in the rotation (n, 3, 3) of the pelvis from where the trial begins, by robust regression
    (Huber's weights), so that frames with a fault do not decide it; a constant, as of a marker that was moved, is not
    explained. Zero for the interface, which has no skin, and where the rotation is unknown.
    """
    out = np.zeros_like(departure)
    known = np.flatnonzero(np.isfinite(rotation).all(axis=(1, 2)))
    if len(known) < _ENOUGH:
        return out
    turn = np.zeros((len(rotation), 3))
    turn[known] = Rotation.from_matrix(rotation[known[0]].T @ rotation[known]).as_rotvec()
    design = np.column_stack([np.ones(len(turn)), turn])
    for pair in range(departure.shape[1] - 1):
        rows = known[np.isfinite(departure[known, pair])]
        if len(rows) < _ENOUGH:
            continue
        x, y = design[rows], departure[rows, pair]
        weight = np.ones(len(rows))
        beta = np.zeros(4)
        for _ in range(_ROUNDS):
            root = np.sqrt(weight)
            beta = np.linalg.lstsq(x * root[:, None], y * root, rcond=1e-6)[0]
            left = np.abs(y - x @ beta)
            weight = np.minimum(1.0, _HUBER * max(float(np.median(left)), 1e-6) / np.maximum(left, 1e-12))
        out[:, pair] = turn @ beta[1:]
    return out


def repaired(positions: dict[str, np.ndarray], swaps: list[Swap]) -> dict[str, np.ndarray]:
    """Return positions (n, 3) [m] by marker with the labels exchanged back, NaN where that is unsure."""
    out = {name: values.copy() for name, values in positions.items()}
    for swap in swaps:
        span = slice(swap.start, swap.stop)
        out[swap.first][span], out[swap.second][span] = (
            positions[swap.second][span],
            positions[swap.first][span],
        )
        for start, stop in swap.unsure:
            out[swap.first][start:stop] = out[swap.second][start:stop] = np.nan
    return out


def find_gaps(positions: dict[str, np.ndarray]) -> list[Gap]:
    """Return every span over which one of the six markers, positions (n, 3) [m] by name, is missing."""
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
    """Return the SD [m] per axis of the white noise of a marker's path (n, 3) [m], NaN if unknown.

    By second differences, which movement hardly enters.
    """
    second = np.diff(values, 2, axis=0)
    second = second[signals.known(second)]
    return float(np.sqrt(np.mean(second**2) / 6)) if len(second) else float("nan")
