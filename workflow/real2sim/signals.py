"""Gaps, filter, derivative, resampling: signals (n,) or (n, k) with NaN where nothing is known."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import TypeVar

import numpy as np
import scipy
from scipy.interpolate import CubicSpline

Sd = TypeVar("Sd", float, np.ndarray)

# What the cubic across a gap is fitted to on either side: two samples determine it, four halve the effect of noise, and
# at high rates four samples are so short a time that their noise swings the cubic far out between them [s].
_SUPPORT, _SUPPORT_S = 4, 0.04
# Samples to either side that a value between samples is made of
_INTERPOLATION = 32


@dataclass(frozen=True)
class Scatter:
    """Noise of a column from repeat to repeat, in the column's unit.

    ``zero_sd`` is the SD of the mean of a repeat, ``sd`` that of a sample about it.
    """

    sd: float
    zero_sd: float

    @classmethod
    def of_repeats(cls, apart: np.ndarray, freedom: int) -> Scatter:
        """Return the noise of repeats (r, m) about their mean, which holds ``freedom`` of the r repeats."""
        zero = apart.mean(axis=1, keepdims=True)
        samples = freedom * (apart.shape[1] - 1)
        sd, zero_sd = np.sqrt(np.sum((apart - zero) ** 2) / samples), np.sqrt(np.sum(zero**2) / freedom)
        return cls(float(sd), float(zero_sd))


def segments(good: np.ndarray) -> list[slice]:
    """Return the contiguous runs where ``good`` (n,) is true."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], good, [False]]).astype(np.int8)))
    return [slice(int(a), int(b)) for a, b in zip(edges[::2], edges[1::2], strict=True)]


def known(values: np.ndarray) -> np.ndarray:
    """Return the samples (n,) at which every column is finite."""
    finite = np.isfinite(values)
    return finite if values.ndim == 1 else np.asarray(finite.all(axis=1))


def fill_gaps(values: np.ndarray, rate_hz: float, max_gap_s: float) -> tuple[np.ndarray, np.ndarray]:
    """Fill gaps of at most ``max_gap_s`` by a cubic; returns the signal and where it was filled (n,).

    The cubic is fitted to 40 ms and at least four samples on either side, or to as many as there are (two at least).
    Longer gaps and both ends stay NaN.
    """
    out, good = values.copy(), known(values)
    out[~good] = np.nan
    filled = np.zeros(len(values), bool)
    runs = segments(good)
    support_samples = max(_SUPPORT, round(_SUPPORT_S * rate_hz))
    longest = int(np.floor(max_gap_s * rate_hz + 1e-6))
    for before, after in pairwise(runs):
        gap = slice(before.stop, after.start)
        left = np.arange(max(before.start, before.stop - support_samples), before.stop)
        right = np.arange(after.start, min(after.stop, after.start + support_samples))
        if gap.stop - gap.start > longest or min(len(left), len(right)) < 2:
            continue
        support, missing = np.concatenate([left, right]), np.arange(gap.start, gap.stop)
        middle, half = (support[0] + support[-1]) / 2, (support[-1] - support[0]) / 2
        basis = np.vander((support - middle) / half, 4)
        cubic = np.linalg.lstsq(basis, values[support], rcond=None)[0]
        out[gap] = np.vander((missing - middle) / half, 4) @ cubic
        filled[gap] = True
    return out, filled


def bridged(values: np.ndarray) -> np.ndarray:
    """Return a series (n, k) with unknown samples bridged by straight lines."""
    out, sample = values.copy(), np.arange(len(values))
    for c in range(values.shape[1]):
        known = np.isfinite(values[:, c])
        out[~known, c] = np.interp(sample[~known], sample[known], values[known, c])
    return out


def lowpass(values: np.ndarray, rate_hz: float, cutoff_hz: float, order: int) -> np.ndarray:
    """Filter by a zero-phase Butterworth low-pass, each contiguous stretch by itself.

    ``values`` is (n,) or (n, k). ``order`` counts both passes (4: second order forward and backward). The design cutoff
    is raised so that the double pass is at -3 dB at ``cutoff_hz`` (Winter, Biomechanics and Motor Control of Human
    Movement, 2.2.4.4), in the prewarped frequency so that it holds at any rate. A cutoff above the Nyquist frequency
    filters nothing.
    """
    if order % 2 or order < 2:
        raise ValueError(f"order {order}: a double pass has an even order")
    if cutoff_hz >= rate_hz / 2:
        return values.copy()
    correction = (np.sqrt(2) - 1) ** (-1 / order)
    warped = np.tan(np.pi * cutoff_hz / rate_hz) * correction
    sos = scipy.signal.butter(order // 2, np.arctan(warped) / np.pi * 2, output="sos")
    out = np.full(values.shape, np.nan)
    for run in segments(known(values)):
        length = run.stop - run.start
        pad = min(length - 1, int(3 * rate_hz / cutoff_hz))
        out[run] = scipy.signal.sosfiltfilt(sos, values[run], axis=0, padlen=pad)
    return out


def derivative(values: np.ndarray, rate_hz: float) -> np.ndarray:
    """Return the time derivative: five-point central differences, three-point at the ends of each stretch.

    ``values`` is (n,) or (n, k), the derivative too, in their unit per second. Exact for quadratics everywhere and for
    quartics inside; stretches of fewer than three samples give NaN.
    """
    out = np.full(values.shape, np.nan)
    for run in segments(known(values)):
        x = values[run]
        if len(x) < 3:
            continue
        slope = np.gradient(x, 1 / rate_hz, axis=0, edge_order=2)
        if len(x) > 4:
            slope[2:-2] = (8 * (x[3:-1] - x[1:-3]) - (x[4:] - x[:-4])) * (rate_hz / 12)
        out[run] = slope
    return out


def correlation_at_lags(
    x: np.ndarray, y: np.ndarray, floor: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the lags (n + m - 1,) of y (m,) in x (n,), Pearson's correlation there and the samples it rests on.

    Row i of y belongs to row i + lag of x; means and variances are those of the overlap. ``floor``, times the sum of
    squares of either, is the least product of the two variances that is divided by.
    """
    n, m = len(x), len(y)
    lags = np.arange(n + m - 1) - (m - 1)
    first, last = np.maximum(0, lags), np.minimum(n, m + lags)
    count = last - first
    mean_x, power_x = _moments(x, first, last)
    mean_y, power_y = _moments(y, first - lags, last - lags)
    product = scipy.signal.fftconvolve(x, y[::-1]) - mean_x * mean_y * count
    least = floor * np.sum(x * x) * np.sum(y * y)
    return lags, product / np.sqrt(np.maximum(power_x * power_y, least)), count


def _moments(x: np.ndarray, first: np.ndarray, last: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return mean and sum of squares about it of the stretches from ``first`` up to ``last`` (k,) of x (n,)."""
    sums, squares = (np.concatenate([[0.0], np.cumsum(values)]) for values in (x, x * x))
    mean = (sums[last] - sums[first]) / (last - first)
    return mean, squares[last] - squares[first] - mean**2 * (last - first)


def sums_of_runs(values: np.ndarray, labels: np.ndarray) -> np.ndarray:
    """Return the sum of each run of rows of ``values`` (n, k) with one label (n,), shape (runs, k)."""
    return np.add.reduceat(values, np.flatnonzero(np.diff(labels, prepend=labels[0] - 1)), axis=0)


def resample(
    time_s: np.ndarray, values: np.ndarray, new_time_s: np.ndarray, max_gap_s: float = np.inf
) -> np.ndarray:
    """Return values at new times (m,) [s] by cubic splines through each contiguous stretch; NaN outside of them.

    ``values`` is (n,) or (n, k) at times (n,) [s]. Where two samples lie more than ``max_gap_s`` apart, a stretch ends.
    """
    if len(time_s) == len(new_time_s) and np.abs(time_s - new_time_s).max() < 1e-9:
        return values.copy()
    out = np.full((len(new_time_s), *values.shape[1:]), np.nan)
    good = known(values)
    t_good, x_good = time_s[good], values[good]
    # A stretch ends where a sample is missing and where the clock jumps.
    rows = np.flatnonzero(good)
    breaks = np.flatnonzero((np.diff(rows) > 1) | (np.diff(t_good) > max_gap_s)) + 1
    for t, x in zip(np.split(t_good, breaks), np.split(x_good, breaks), strict=True):
        if not len(t):
            continue
        inside = (new_time_s >= t[0] - 1e-9) & (new_time_s <= t[-1] + 1e-9)
        out[inside] = CubicSpline(t, x)(new_time_s[inside]) if len(t) > 1 else x[0]
    return out


def upsampled(values: np.ndarray, parts: int) -> np.ndarray:
    """Return a band-limited signal (n, k) at ``parts`` times its rate, ((n - 1) parts + 1, k), the samples kept.

    A low-pass of 32 samples to either side: a sine at nine tenths of half the rate is kept to 1e-4. A cubic spline
    would make one at two thirds of it smaller by 6 %. At its ends the signal goes on along its odd reflection.
    """
    if parts == 1:
        return values.copy()
    around = min(_INTERPOLATION, len(values) - 1)
    padded = np.concatenate(
        [2 * values[0] - values[around:0:-1], values, 2 * values[-1] - values[-2 : -around - 2 : -1]]
    )
    window = scipy.signal.firwin(2 * _INTERPOLATION * parts + 1, 1 / parts, window=("kaiser", 10.0)) * parts
    # zeros of the low-pass lie on the samples, but for its finite length: they are kept as they are
    out = scipy.signal.upfirdn(window, padded, up=parts, axis=0)
    first = (around + _INTERPOLATION) * parts
    out = out[first : first + (len(values) - 1) * parts + 1]
    out[::parts] = values
    return np.asarray(out)


def white_sd_at(sd: Sd, rate_hz: float, other_hz: float) -> Sd:
    """Return the SD of white noise at another rate [Hz] that has the same power per hertz as ``sd`` (any shape) has.

    A low-pass far below both rates leaves as much of either.
    """
    return sd * float(np.sqrt(other_hz / rate_hz))


def common_clock(start_s: float, end_s: float, rate_hz: float) -> np.ndarray:
    """Return the times (n,) [s] k / rate within [start, end]."""
    first, last = int(np.ceil(start_s * rate_hz - 1e-6)), int(np.floor(end_s * rate_hz + 1e-6))
    return np.arange(first, last + 1) / rate_hz


def steady_and_fading(time_s: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the distance (n,) per initial rate [s] at a steady rate, and at one that fades over a third of a trial."""
    t = time_s - time_s[0]
    fades = t[-1] / 3
    return t, fades * (1 - np.exp(-t / fades))
