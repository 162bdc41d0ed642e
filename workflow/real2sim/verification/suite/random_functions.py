"""Random smooth functions of one to three numbers, as sums of cosines with random frequencies and phases.

A function is a dictionary of arrays, so that terms of a batch can hold one per trial: ``frequency`` (..., m, d),
``phase`` (..., m), ``amplitude`` (..., m). Its arguments are scaled: the visited range is about -1 to 1. Sums of
cosines stay bounded beyond it.
"""

from __future__ import annotations

import numpy as np
from numpy.random import Generator

Function = dict[str, np.ndarray]

FEATURES = 12
# Length over which a function changes, in units of the visited half range: several bends to hardly one
_LENGTHS = (0.45, 1.3)
_GRID = np.linspace(-1.0, 1.0, 81)


def draw_function(
    rng: Generator, dimensions: int = 1, lengths: tuple[float, float] = _LENGTHS, padded: int | None = None
) -> Function:
    """Draw a function of so many numbers (Gaussian covariance); it ignores arguments up to ``padded``."""
    length = np.exp(rng.uniform(*np.log(lengths)))
    frequency = np.zeros((FEATURES, padded or dimensions))
    frequency[:, :dimensions] = rng.standard_normal((FEATURES, dimensions)) / length
    return {
        "frequency": frequency,
        "phase": rng.uniform(0, 2 * np.pi, FEATURES),
        "amplitude": rng.standard_normal(FEATURES) * np.sqrt(2 / FEATURES),
    }


def evaluate(function: Function, s: np.ndarray) -> np.ndarray:
    """Return values (...) at scaled arguments (..., d)."""
    angle = (function["frequency"] @ s[..., None])[..., 0] + function["phase"]
    values: np.ndarray = np.sum(function["amplitude"] * np.cos(angle), axis=-1)
    return values


def gradient(function: Function, s: np.ndarray) -> np.ndarray:
    """Return the gradient (..., d) by the scaled arguments (..., d)."""
    angle = (function["frequency"] @ s[..., None])[..., 0] + function["phase"]
    slope = -function["amplitude"] * np.sin(angle)
    out: np.ndarray = (slope[..., None, :] @ function["frequency"])[..., 0, :]
    return out


def hessian(function: Function, s: np.ndarray) -> np.ndarray:
    """Return the second derivatives (k, d, d) at scaled arguments (k, d)."""
    angle = s @ function["frequency"].T + function["phase"]
    bend = -function["amplitude"] * np.cos(angle)
    out: np.ndarray = np.einsum("km,mi,mj->kij", bend, function["frequency"], function["frequency"])
    return out


def scale(function: Function, factor: float) -> Function:
    """Return the function times a factor."""
    return function | {"amplitude": function["amplitude"] * factor}


def curved(rng: Generator, lengths: tuple[float, float] = _LENGTHS) -> Function:
    """Draw a function of one number whose departure from a straight line over (-1, 1) is 1 at most there."""
    drawn = draw_function(rng, lengths=lengths)
    values = evaluate(drawn, _GRID[:, None])
    bend = values - np.polyval(np.polyfit(_GRID, values, 1), _GRID)
    return scale(drawn, 1 / max(float(np.abs(bend).max()), 1e-3))


def box(dimensions: int, padded: int, size: float = 1.15) -> np.ndarray:
    """Return points (k, padded) that fill a box a little larger than the visited range, the same ones always."""
    points = np.zeros((400, padded))
    points[:, :dimensions] = np.random.default_rng(0).uniform(-size, size, (400, dimensions))
    return points


def band_limited(rng: Generator, t: np.ndarray, lowest_hz: float, highest_hz: float) -> np.ndarray:
    """Draw a history (n,) of 16 sinusoids between two frequencies, of standard deviation 1 in the long run."""
    frequency = rng.uniform(lowest_hz, highest_hz, 16)
    phase = rng.uniform(0, 2 * np.pi, 16)
    weight = rng.standard_normal(16)
    weight /= np.sqrt(np.sum(weight**2) / 2)
    history: np.ndarray = np.cos(2 * np.pi * t[:, None] * frequency + phase) @ weight
    return history
