"""How much of J is measurement noise: the cost of a replay in which nothing but noise happens."""

from __future__ import annotations

from typing import TypedDict

import numpy as np

from real2sim.inference.cost import TrialCost
from real2sim.inference.identifiability import Options


class Floor(TypedDict):
    """J of a quiet trial, its terms, and the 95 % interval of J."""

    J: float
    J_position: float
    J_velocity: float
    ci95: list[float]


def block_bootstrap_mean(
    values: np.ndarray, block: int, samples: int, confidence: float, seed: int
) -> tuple[float, float]:
    """Return the percentile interval of the mean of a correlated series (n,), by moving blocks.

    Source: Kuensch, Annals of Statistics 17 (1989) 1217. ``block`` is their length in samples, at most n / 2.
    """
    n = len(values)
    block = max(1, min(block, n // 2))
    starts = np.random.default_rng(seed).integers(0, n - block + 1, (samples, -(-n // block)))
    cumulated = np.concatenate([[0.0], np.cumsum(values)])
    means = (cumulated[starts + block] - cumulated[starts]).mean(axis=1) / block
    tail = (1 - confidence) / 2
    low, high = np.quantile(means, [tail, 1 - tail])
    return float(low), float(high)


def floor_of(cost: TrialCost, simulated: np.ndarray, rate_hz: float, options: Options) -> Floor:
    """Return the cost of one simulated path (1, n, 2, 3) [m] of a quiet trial, with a block-bootstrap interval.

    This floor is measured: what a person who stands leaves, gaps and sway included, in one realisation. The diagnosis
    has no quiet trial at the poses of its trials and simulates marker noise through the plant instead: its floor is the
    mean of `TrialCost.energy` over draws. ``options`` is the slice ``identifiability`` of the configuration.
    """
    residual, terms = cost.residuals(simulated)[0], cost(simulated)
    energy = np.bincount(cost.sample_of_residual(), weights=residual**2)
    used = energy > 0
    low, high = block_bootstrap_mean(
        energy[used] * used.sum(),
        round(options["floor_block_s"] * rate_hz),
        options["floor_bootstrap"],
        0.95,
        options["seed"],
    )
    return {
        "J": float(terms.total[0]),
        "J_position": float(terms.position[0]),
        "J_velocity": float(terms.velocity[0]),
        "ci95": [low, high],
    }
