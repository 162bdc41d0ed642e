"""Where the gap lies: shares of J above its floor by axis, side, regime, time, frequency and term."""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.fft import dct

from real2sim.effects.base import Scales
from real2sim.geometry import AXES
from real2sim.inference.cost import TrialCost

TIME_SPANS = 6
FREQUENCY_EDGES_HZ = (0.0, 0.3, 1.0, 3.0, 12.0)


@dataclass(frozen=True)
class Gap:
    """One trial and a simulation of it.

    ``time_s`` (n,); ``measured`` and ``simulated`` (n, 2, 3) interface markers [m, world]; ``noise`` (draws, n, 6) [m]
    residuals of a perfect model; ``cost`` is J; ``scales``, ``coordinates`` and ``rates`` (n, 6) of the interface;
    ``pelvis_rotation`` (n, 3, 3).
    """

    time_s: np.ndarray
    measured: np.ndarray
    simulated: np.ndarray
    noise: np.ndarray
    cost: TrialCost
    scales: Scales
    coordinates: np.ndarray
    rates: np.ndarray
    pelvis_rotation: np.ndarray

    @property
    def error(self) -> np.ndarray:
        """Simulated minus measured markers (n, 2, 3) [m], 0 where they were not seen."""
        return np.where(np.isfinite(self.measured), self.simulated - self.measured, 0.0)


def _energy(cost: TrialCost, error: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Position and velocity part of J per sample, side and axis, (n, 2, 3) each; they sum to the terms of J."""
    rows = cost.residuals((error + cost.measured)[None])[0]
    n = len(error)
    position = rows[: n * 6].reshape(n, 2, 3) ** 2
    velocity = np.zeros_like(position)
    velocity[1:-1] = rows[n * 6 :].reshape(n - 2, 2, 3) ** 2
    return position, velocity


def _shares(values: dict[str, float]) -> dict[str, float]:
    """Positive parts, normalised to 1; all 0 where nothing stands out of the noise."""
    positive = {key: max(value, 0.0) for key, value in values.items()}
    total = sum(positive.values())
    return {key: (v / total if total > 0 else 0.0) for key, v in positive.items()}


def where(gap: Gap, explained: np.ndarray | None = None) -> dict[str, Any]:
    """Split J of a simulation, less what noise alone would cost.

    Parameters
    ----------
    explained
        Simulated paths (n, 2, 3) with the effect that was named. What it changes is the gap without its noise, and
        parts more surely into regimes than what is left of noise after noise is subtracted.

    Returns shares that add up to 1 (or are all 0 where J is at its floor): ``sides``, ``terms``, ``world_axes``,
    ``times`` (equal spans), ``bands_hz`` and ``regimes`` (amplitude by speed by phase of the pelvis' motion).
    """
    error = gap.error
    position, velocity = _energy(gap.cost, error)
    floor = [_energy(gap.cost, draw.reshape(-1, 2, 3)) for draw in gap.noise]
    position = position - np.mean([f[0] for f in floor], axis=0)
    velocity = velocity - np.mean([f[1] for f in floor], axis=0)
    both = position + velocity
    spans = np.array_split(both.sum(axis=(1, 2)), TIME_SPANS)
    time = gap.time_s
    edges = np.linspace(time[0], time[-1], TIME_SPANS + 1)
    return {
        "sides": _shares({"L": both[:, 0].sum(), "R": both[:, 1].sum()}),
        "terms": _shares({"position": position.sum(), "velocity": velocity.sum()}),
        "world_axes": _shares({axis: both[:, :, i].sum() for i, axis in enumerate("xyz")}),
        "times": [
            {"from_s": float(a), "to_s": float(b), "share": share}
            for a, b, share in zip(
                edges[:-1],
                edges[1:],
                _shares({str(i): s.sum() for i, s in enumerate(spans)}).values(),
                strict=True,
            )
        ],
        "bands_hz": _bands(gap, error),
        "regimes": _regimes(
            gap, both.sum(axis=(1, 2)) if explained is None else _change(gap, gap.simulated - explained)
        ),
    }


def _change(gap: Gap, difference: np.ndarray) -> np.ndarray:
    """Return J, per sample, of a difference (n, 2, 3) [m] of paths alone."""
    known = np.isfinite(gap.measured)
    position, velocity = _energy(gap.cost, np.where(known, difference, 0.0))
    return np.asarray((position + velocity).sum(axis=(1, 2)))


def _bands(gap: Gap, error: np.ndarray) -> list[dict[str, Any]]:
    rate = 1 / float(gap.time_s[1] - gap.time_s[0])
    power = np.sum(dct(error.reshape(len(error), 6), axis=0, norm="ortho") ** 2, axis=1)
    floor = np.mean(np.sum(dct(gap.noise, axis=1, norm="ortho") ** 2, axis=2), axis=0)
    frequency = np.arange(len(power)) * rate / (2 * len(power))
    rows = {}
    for low, high in itertools.pairwise(FREQUENCY_EDGES_HZ):
        inside = (frequency >= low) & (frequency < high)
        rows[(low, high)] = float(np.sum(power[inside] - floor[inside]))
    shares = _shares({str(k): v for k, v in rows.items()})
    return [
        {"from_hz": low, "to_hz": high, "share": share}
        for (low, high), share in zip(rows, shares.values(), strict=True)
    ]


def _regimes(gap: Gap, energy: np.ndarray) -> list[dict[str, Any]]:
    """Share of the gap by amplitude, speed and phase of the interface's motion, largest first.

    Amplitude and speed are norms of q and of its rate, each axis in units of its large excursion and its large rate.
    """
    scales = gap.scales
    q, rate = gap.coordinates / scales.q, gap.rates
    amplitude, speed = np.linalg.norm(q, axis=1), np.linalg.norm(rate / scales.v, axis=1)
    outward = np.sum(q * rate / scales.q, axis=1) > 0
    large, fast = amplitude > np.median(amplitude), speed > np.median(speed)
    sums = {}
    for is_large in (True, False):
        for is_fast in (True, False):
            for is_outward in (True, False):
                inside = (large == is_large) & (fast == is_fast) & (outward == is_outward)
                name = ", ".join(
                    (
                        "large amplitude" if is_large else "small amplitude",
                        "fast" if is_fast else "slow",
                        "outward" if is_outward else "returning",
                    )
                )
                sums[name] = float(energy[inside].sum())
    shares = _shares(sums)
    return [
        {"bin": name, "share": share} for name, share in sorted(shares.items(), key=lambda item: -item[1])
    ]


def axis_shares(gap: Gap) -> dict[str, float]:
    """Share of the gap by interface coordinate: error of the pose in the pelvis' axes, each in units of its noise."""
    error = gap.error
    span = float(np.linalg.norm(np.nanmean(gap.measured[:, 0] - gap.measured[:, 1], axis=0)))
    turn = np.swapaxes(gap.pelvis_rotation, 1, 2)

    def split(e: np.ndarray) -> np.ndarray:
        middle = np.einsum("nij,nj->ni", turn, e.mean(axis=1))
        across = np.einsum("nij,nj->ni", turn, e[:, 0] - e[:, 1]) / span
        # the line between the markers lies along y: its x and z components turn about z and x
        return np.column_stack([middle, across[:, 2], -across[:, 0]])

    floor = np.mean([split(draw.reshape(-1, 2, 3)) ** 2 for draw in gap.noise], axis=(0, 1))
    excess = np.mean(split(error) ** 2, axis=0) / np.maximum(floor, 1e-18) - 1
    shares = _shares(dict(zip(("tx", "ty", "tz", "rx", "rz"), excess, strict=True)))
    return {axis: shares.get(axis, 0.0) for axis in AXES}
