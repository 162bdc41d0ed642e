"""How loud the noise of a recording's columns is: of what stands still, above the band, or from repeat to repeat."""

from __future__ import annotations

import numpy as np
from scipy.optimize import minimize_scalar

from real2sim import signals
from real2sim.signals import Scatter

# Share of the frequencies up to half the sample rate that a level is read off, at least
_LEAST_SHARE = 0.15
# The first frequencies above the band are left out: what moves does not end at a line
_MARGIN = 1.1
# How far a period that is told may be off, as a share of it
_PERIOD_OFF = 0.03
# Values between samples: parts of an interval, straight lines between them; and samples that a start may be off
_PARTS, _LATE = 16, 3
# Samples of one repeat at least
_LEAST_SAMPLES = 8
# Of what repeats do not share, samples for each weight of the drive at least, and share of a repeat that those reach
_SAMPLES_A_WEIGHT, _REACH = 8, 0.125
# A column whose SD is no larger than this share of its largest value stands still: the rest is rounding
_ROUNDING = 1e-9


def white_sd(values: np.ndarray) -> np.ndarray:
    """Return the SD (c,) of white noise of series (n, c) whose motion is slow: of their third differences."""
    third = np.diff(signals.bridged(values), n=3, axis=0)
    spread = np.median(np.abs(third - np.median(third, axis=0)), axis=0) / 0.6745
    return np.asarray(spread / np.sqrt(20.0))


def moving_sd(values: np.ndarray, rate_hz: float, band_hz: float) -> np.ndarray:
    """Return the SD (c,) of white noise of series (n, c) that move, up to ``band_hz``.

    It is read off the spectrum above the band, by the median, so that a few lines do not count, and off third
    differences (`white_sd`). Jumps add to the one and a fast motion to the other, so the smaller is taken. Where the
    sample rate leaves too little above the band, third differences alone tell it.
    """
    frequencies = np.fft.rfftfreq(len(values), 1 / rate_hz)
    above = frequencies > _MARGIN * band_hz
    if above.sum() < _LEAST_SHARE * len(frequencies):
        return white_sd(values)
    # a window without steps at its ends in value and slope: what moves must not leak up
    window = np.blackman(len(values))[:, None]
    known = signals.bridged(values)
    power = np.abs(np.fft.rfft((known - known.mean(axis=0)) * window, axis=0)) ** 2 / np.sum(window**2)
    # the power at one frequency is exponentially distributed about the level
    level = np.sqrt(np.median(power[above], axis=0) / np.log(2))
    return np.asarray(np.minimum(level, white_sd(values)))


def repeats(values: np.ndarray, samples: float, first: int = 0) -> np.ndarray:
    """Return the whole repeats (r, m, c) of series (n, c) from a sample on, ``samples`` (not rounded) each."""
    count = int((len(values) - 1 - first) // samples)
    phase = np.arange(int(samples))
    at = first + samples * np.arange(count)[:, None] + phase
    fine = signals.upsampled(signals.bridged(values), _PARTS)
    sample = np.arange(len(fine)) / _PARTS
    return np.stack([np.interp(at, sample, column) for column in fine.T], axis=-1)


def beyond_drive(off: np.ndarray, driven: np.ndarray, freedom: int) -> np.ndarray:
    """Return what a measured drive does not explain of the departures (r, m, c) of repeats from their mean.

    A command that is given twice is never carried out twice alike. Departures (r, m, k) of what drives the system were
    measured, and what they explain linearly, by weights at instants before and after, is motion and no noise. The mean
    square is corrected for the number of weights; samples at both ends, whose neighbours are unknown, are left out.
    ``freedom`` is how many of the r repeats are free.
    """
    r, m, k = driven.shape
    reach = min(int(_REACH * m), (freedom * m // (_SAMPLES_A_WEIGHT * max(k, 1)) - 1) // 2)
    if not k or reach < 0:
        return off
    lags = np.lib.stride_tricks.sliding_window_view(driven, 2 * reach + 1, axis=1)
    count = lags.shape[1]
    design = lags.reshape(r * count, -1)
    inner = off[:, reach : reach + count].reshape(r * count, -1)
    weights, _, rank, _ = np.linalg.lstsq(design, inner, rcond=None)
    left, samples = inner - design @ weights, freedom * count
    return np.asarray(left.reshape(r, count, -1) * np.sqrt(samples / (samples - rank)))


def _varies(values: np.ndarray) -> np.ndarray:
    """Return which columns (c,) of series (n, c) do not stand still."""
    return np.asarray(np.nanstd(values, axis=0) > _ROUNDING * np.nanmax(np.abs(values), axis=0))


def scatter_of_repeats(
    values: np.ndarray, samples: float, first: int = 0, driven: tuple[int, ...] = ()
) -> tuple[tuple[Scatter, ...], int, float]:
    """Return the noise of each column of series (n, c) about the mean of its repeats, their number and their length.

    Parameters
    ----------
    samples
        Length of a repeat, in samples, to 3 %; it is refined to what repeats best, in all columns that vary, as shares
        of what each varies.
    first
        First sample of the first repeat.
    driven
        Columns that drive the others: what they explain of the difference between repeats is no noise.

    Raises
    ------
    ValueError
        Where the recording holds fewer than two repeats, or repeats of a few samples.
    """
    if samples < _LEAST_SAMPLES or (len(values) - 1 - first) < 2 * samples * (1 + _PERIOD_OFF):
        raise ValueError(f"{len(values) - first} samples hold no two repeats of {samples:.1f} samples")
    varies = _varies(values)
    shares = values[:, varies] / np.nanstd(values[:, varies], axis=0)

    def apart(length: float) -> float:
        # where all columns stand still, every length repeats as well as another
        return float(repeats(shares, length, first).var(axis=0, ddof=1).mean()) if varies.any() else 0.0

    around = samples * (1 + _PERIOD_OFF * np.linspace(-1, 1, 61))
    best = around[int(np.argmin([apart(length) for length in around]))]
    near = samples * _PERIOD_OFF / 30
    best = float(minimize_scalar(apart, bounds=(best - near, best + near), method="bounded").x)
    laps = repeats(values, best, first)
    return _scatter(np.where(varies, laps - laps.mean(axis=0), 0.0), driven), len(laps), best


def _scatter(off: np.ndarray, driven: tuple[int, ...]) -> tuple[Scatter, ...]:
    """Return the noise of each column of departures (r, m, c) of repeats from their mean."""
    freedom = len(off) - 1
    left = beyond_drive(off, off[:, :, list(driven)], freedom)
    return tuple(
        Scatter.of_repeats((off if c in driven else left)[:, :, c], freedom) for c in range(off.shape[2])
    )


def scatter_of_pair(one: np.ndarray, other: np.ndarray, driven: tuple[int, ...] = ()) -> tuple[Scatter, ...]:
    """Return the noise of each column of two series (n, c), (m, c) of the same motion about their mean.

    Their clocks may be apart by a part of a sample, or by up to three: the second is moved to where it agrees best.
    ``driven`` as of `scatter_of_repeats`.

    Raises
    ------
    ValueError
        Where they share only a few samples.
    """
    shared = min(len(one), len(other)) - 2 * _LATE
    if shared < _LEAST_SAMPLES:
        raise ValueError(f"{len(one)} and {len(other)} samples")
    known = signals.bridged(other)
    fine = signals.upsampled(known, _PARTS)
    middle = signals.bridged(one)[_LATE : _LATE + shared]
    varies = _varies(middle)
    usual = middle[:, varies].std(axis=0)
    best, least = middle, np.inf
    for first in range(2 * _LATE * _PARTS + 1):
        moved = fine[first::_PARTS][:shared]
        apart = float(np.sum(((moved - middle)[:, varies] / usual) ** 2))
        if apart < least:
            best, least = moved, apart
    # between samples, what stands still is known but for rounding
    half = np.where(varies | _varies(known), best - middle, known[:shared] - middle) / 2
    return _scatter(np.stack([half, -half]), driven)
