"""Tests that two trials are not one recording: copies share the noise of the cameras, two recordings never do."""

from __future__ import annotations

import base64
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.optimize import minimize_scalar
from scipy.signal import find_peaks
from scipy.spatial import cKDTree

from real2sim import geometry, signals

if TYPE_CHECKING:
    from real2sim.settings import QualitySameSettings

_RATE_HZ = 20.0  # of the stored path
_BAND_HZ = 2.0  # of the stored path: no filter of a lab reaches down to here
_EDGE_S = 0.75  # where the filter has only one side
_UNIT_M = 1e-6  # of the stored path
# numerical: how the difference is found, not what it means
_LEAST_VARIANCE = 1e-9  # of an overlap, over the whole path's: below it nothing moves there
_CANDIDATES = 6  # maxima that are tried: gait repeats itself
_HOPELESS = 200.0  # difference over noise at a whole sample that no fraction of a sample explains
_KEPT = 0.98  # of the second differences: gaps and spikes are in the rest
_ROUNDS = 3  # of leaving out what does not fit
_REACH = 2  # rows on either side of which a difference of order four is made
_FITTED = 11  # place, turn, shift and the four differences
_MEDIAN_CHI2 = 0.4549  # of one degree of freedom


@dataclass(frozen=True)
class Signature:
    """Signature of a trial: the part of a recording that its copies have in common with it.

    ``path`` (n, 3) [m] is the mean of the pelvis' markers below 2 Hz at 20 Hz, ``noise_m`` the SD per axis of the
    white noise that is in it, ``shape`` (6,) [m] the median distances of the markers; ``files`` maps the kind of a file
    to its SHA-256.
    """

    path: np.ndarray
    noise_m: float
    shape: np.ndarray
    files: dict[str, str]

    def packed(self) -> dict[str, Any]:
        """Return the signature as JSON: the path as compressed steps of a micrometre."""
        steps = np.diff(np.rint(self.path / _UNIT_M).astype("<i4"), axis=0, prepend=0)
        text = base64.b64encode(zlib.compress(np.ascontiguousarray(steps.T, "<i4").tobytes(), 9)).decode()
        shape = [float(x) if np.isfinite(x) else None for x in self.shape]
        return {"path": text, "noise_m": self.noise_m, "shape_m": shape, "files": self.files}

    @classmethod
    def unpacked(cls, content: Mapping[str, Any]) -> Signature:
        """Return the signature that `packed` wrote."""
        steps = np.frombuffer(zlib.decompress(base64.b64decode(content["path"])), "<i4").reshape(3, -1).T
        shape = np.array([np.nan if x is None else x for x in content["shape_m"]])
        path = np.cumsum(steps.astype(np.int64), axis=0) * _UNIT_M
        return cls(path, content["noise_m"], shape, dict(content["files"]))


@dataclass(frozen=True)
class Same:
    """Two trials that are one recording: difference of their paths over that of two recordings of one motion [1].

    ``file`` is the kind of file that both have byte for byte, empty where it was not copied as it is.
    """

    first: str
    second: str
    ratio: float
    file: str = ""


def signature(positions: dict[str, np.ndarray], rate_hz: float, files: dict[str, str]) -> Signature:
    """Return the signature of a trial by its markers: names to (n, 3) [m], NaN where missing."""
    there = [positions[name] for name in geometry.PELVIS_MARKERS if name in positions]
    points = np.stack(there, axis=1) if there else np.zeros((0, 0, 3))
    good = np.asarray(np.isfinite(points).all(axis=(1, 2)) if there else np.zeros(0, bool))
    shape = np.full(6, np.nan)
    if len(there) == len(geometry.PELVIS_MARKERS) and good.any():
        pairs = list(combinations(range(len(there)), 2))
        shape = np.array(
            [np.median(np.linalg.norm(points[good, a] - points[good, b], axis=1)) for a, b in pairs]
        )
    edge, step = round(_EDGE_S * rate_hz), rate_hz / _RATE_HZ
    if good.sum() < 2 * edge + 2 * rate_hz:
        return Signature(np.zeros((0, 3)), 0.0, shape, files)
    centre = points.mean(axis=1)
    rows = np.arange(len(centre))
    closed = np.column_stack([np.interp(rows, rows[good], column[good]) for column in centre.T])
    slow = signals.lowpass(closed, rate_hz, _BAND_HZ, 4)
    at = np.arange(edge, len(centre) - edge - 1, step)
    path = CubicSpline(rows, slow)(at)
    second = np.sort(np.diff(closed, 2, axis=0)[good[1:-1]] ** 2, axis=0)
    white = float(np.sqrt(second[: round(_KEPT * len(second))].mean() / 6))
    impulse = np.zeros(2 * round(4 * rate_hz) + 1)
    impulse[len(impulse) // 2] = 1.0
    passed = float(np.sqrt(np.sum(signals.lowpass(impulse, rate_hz, _BAND_HZ, 4) ** 2)))
    return Signature(path - path.mean(axis=0), white * passed, shape, files)


def difference(a: Signature, b: Signature, settings: QualitySameSettings) -> float:
    """Return the difference of two paths over that of two recordings of one motion [1].

    Copies, also of a part, shifted, filtered, rounded or in other axes, give less than 1: they share the noise. Two
    recordings give more than 1 whatever was done, as the noise of either is independent; they give infinity where the
    speeds have too little in common to be laid on each other. ``settings`` is the slice ``quality.same``.
    """
    least = round(settings["least_s"] * _RATE_HZ)
    noise = max(a.noise_m, b.noise_m)
    if min(len(a.path), len(b.path)) < least or not noise > 0:
        return float("inf")
    ours, theirs = (np.linalg.norm(np.gradient(x.path, axis=0), axis=1) for x in (a, b))
    lags = _lags(ours, theirs, least, settings["least_correlation"])
    spline = CubicSpline(np.arange(_REACH, len(b.path) - _REACH), _with_differences(b.path))
    rows = np.arange(len(a.path))

    def apart(shift: float) -> float:
        inside = (rows - shift >= _REACH) & (rows - shift <= len(b.path) - 1 - _REACH)
        if inside.sum() < least:
            return float("inf")
        return _apart(a.path[inside], spline(rows[inside] - shift))

    out = float("inf")
    for lag in lags:
        whole = apart(float(lag))
        if whole > _HOPELESS * noise:
            continue
        best = minimize_scalar(
            apart, bounds=(lag - 1.0, lag + 1.0), method="bounded", options={"xatol": 1e-3}
        )
        out = min(out, float(best.fun) / noise, whole / noise)
    return out


def _lags(x: np.ndarray, y: np.ndarray, least: int, correlation: float) -> list[int]:
    """Lags [samples] of y (m,) in x (n,) at which Pearson's correlation over the overlap has a maximum.

    It must reach ``correlation``, over at least ``least`` samples and half of the shorter path.
    """
    lags, value, count = signals.correlation_at_lags(x, y, _LEAST_VARIANCE)
    value[count < max(min(len(x), len(y)) // 2, least)] = -1.0
    peaks, _ = find_peaks(np.concatenate([[-1.0], value, [-1.0]]), height=correlation)
    order = np.argsort(value[peaks - 1])[::-1][:_CANDIDATES]
    return [int(lags[i]) for i in peaks[order] - 1]


def _with_differences(path: np.ndarray) -> np.ndarray:
    """Return a path (n, 3) and its central differences of orders 1 to 4, (n - 4, 5, 3), without two rows at each end.

    A filter that a copy went through acts below 2 Hz like a kernel of five taps with unit gain at rest: its gain and
    delay are smooth in frequency there. The differences span these kernels.
    """
    first, second = (path[2:] - path[:-2]) / 2, np.diff(path, 2, axis=0)
    third, fourth = (second[2:] - second[:-2]) / 2, np.diff(second, 2, axis=0)
    return np.stack([path[2:-2], first[1:-1], second[1:-1], third, fourth], axis=1)


def _apart(x: np.ndarray, y: np.ndarray) -> float:
    """Return the robust SD per axis [m] between a path (n, 3) and another with its differences (n, 5, 3), laid on it.

    One kernel for all axes and the whole overlap is fitted beside place and turn, and the SD is for the freedom that
    is left. Gaps that one of the two has filled do not count.
    """
    use = np.ones(len(x), bool)
    taps = np.array([1.0, 0.0, 0.0, 0.0, 0.0])
    left = np.zeros_like(x)
    for _ in range(_ROUNDS):
        passed = np.einsum("k,nki->ni", taps, y)
        turn = geometry.nearest_rotation((x[use] - x[use].mean(axis=0)).T @ passed[use])
        turned = y @ turn.T
        target, parts = x - turned[:, 0], turned[:, 1:]
        target, parts = target - target[use].mean(axis=0), parts - parts[use].mean(axis=0)
        design = np.moveaxis(parts[use], 1, 2).reshape(-1, 4)
        taps[1:] = np.linalg.lstsq(design, target[use].ravel(), rcond=None)[0]
        left = target - np.einsum("k,nki->ni", taps[1:], parts)
        size = np.linalg.norm(left, axis=1)
        use = size <= 2 * np.median(size)
    known = left.size * 2 * _BAND_HZ / _RATE_HZ  # independent values that the band leaves
    return float(np.sqrt(np.median(left**2) / _MEDIAN_CHI2 * known / (known - _FITTED)))


def find_same(
    signatures: Mapping[str, Signature],
    settings: QualitySameSettings,
    pairs: Sequence[tuple[str, str]] | None = None,
) -> list[Same]:
    """Return the pairs of trials that are one recording, by name.

    ``settings`` is the slice ``quality.same``; ``pairs`` are those to compare, all if None.
    """
    out = []
    for first, second in pairs if pairs is not None else combinations(signatures, 2):
        a, b = signatures[first], signatures[second]
        twice = [kind for kind, digest in a.files.items() if b.files.get(kind) == digest]
        ratio = 0.0 if "markers" in twice else difference(a, b, settings)
        if twice or ratio < settings["least_difference"]:
            out.append(Same(first, second, ratio, twice[0] if twice else ""))
    return out


def near(signatures: Mapping[str, Signature], shape_m: float) -> list[tuple[str, str]]:
    """Return the pairs that can be one recording: a file in common, or pelvis markers as far from each other.

    Distances may differ by ``shape_m`` [m].
    """
    names = list(signatures)
    pairs: set[tuple[str, str]] = set()
    seen: dict[str, list[str]] = {}
    for name in names:
        for digest in signatures[name].files.values():
            pairs.update((before, name) for before in seen.setdefault(digest, []))
            seen[digest].append(name)
    known = [name for name in names if np.isfinite(signatures[name].shape).all()]
    if known:
        tree = cKDTree(np.array([signatures[name].shape for name in known]))
        pairs.update((known[i], known[j]) for i, j in tree.query_pairs(shape_m, p=np.inf))
    return sorted(pairs)
