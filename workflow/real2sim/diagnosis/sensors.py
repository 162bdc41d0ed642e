"""Chi-squared sensor by sensor: a sensor that is quieter than its floor excuses nothing that another one leaves.

Such a sensor leaves less than one per residual, however wrong the simulation of the others is. A sum over all of them
would let a misfit of the one hide in the silence of the other, so it counts for no less than its expectation.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence

import numpy as np


def by_sensor(whitened: np.ndarray, channels: Collection[int]) -> np.ndarray:
    """Return chi-squared (m, s) by sensor of whitened residuals (m, n_r).

    ``channels`` (s,) are the numbers of channels of each sensor, in the order of the channels; a channel is whitened
    given those before it.
    """
    squares = whitened.reshape(len(whitened), -1, sum(channels)) ** 2
    parts = np.split(squares.sum(axis=1), np.cumsum([*channels])[:-1], axis=1)
    return np.stack([part.sum(axis=1) for part in parts], axis=1)


def pooled(by_trial: Sequence[Sequence[float]]) -> tuple[float, ...]:
    """Return the sums (s,) over all trials of what each trial has by sensor (s,)."""
    return tuple(map(sum, zip(*by_trial, strict=True)))


def are_on_floor(noise: Sequence[float], expected: Sequence[float], sd: float) -> tuple[bool, ...]:
    """Return of each sensor whether noise alone leaves ``sd`` standard deviations less than expected: its floor does.

    ``noise`` (s,) is the mean chi-squared of simulated noise, ``expected`` (s,) the numbers of residuals.
    """
    return tuple(bool(a < n - sd * np.sqrt(2 * n)) for a, n in zip(noise, expected, strict=True))


def above(
    left: Sequence[float], expected: Sequence[float], on_floor: Sequence[bool], share: float = 0.0
) -> float:
    """Return chi-squared (s,) less its expectation (s,) and a ``share`` of that, which may be negative.

    A sensor on its floor (s,) counts where it leaves more than that, and not where it leaves less.
    """
    each = [a - (1 + share) * n for a, n in zip(left, expected, strict=True)]
    return float(sum(max(a, 0.0) if quiet else a for a, quiet in zip(each, on_floor, strict=True)))
