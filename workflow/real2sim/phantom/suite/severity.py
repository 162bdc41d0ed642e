"""How strong an effect has to be to make a gap of a given size, by the phantom's own physics.

The gap of a case is what is left of the effect on the held-out trial when the twelve parameters are refitted to
the training trial, over the noise floor: rho = (J - floor) / floor. The refit takes a few Gauss-Newton steps with
the tangents at the true parameters, each of which is simulated.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from real2sim.phantom.suite.measurement import residual

TRAIN, HELD_OUT = "dynamic_1", "dynamic_2"
_STEP_LN = 1e-3
_PRIOR_SD_LN = 1.0  # a refit stays within the search bounds: about this far in ln
_REALISATIONS = 20  # of the noise, for its expected cost
_BANDWIDTH_HZ = 12.0


@dataclass
class Refit:
    """Tangents of one case: columns of residual per ln of a parameter, on both trials, and the floors.

    ``lower``, ``upper`` (12,): how far the ln parameters may move.
    """

    train: np.ndarray
    held_out: np.ndarray
    floor_train: float
    floor_held_out: float
    duration_s: float
    lower: np.ndarray
    upper: np.ndarray

    def step(self, misfit: np.ndarray, moved: np.ndarray) -> np.ndarray:
        """Where the ln parameters (12,) go from ``moved`` to make good a misfit on the training trial."""
        # independent values: two markers, three axes, twice the band-width
        count = 2 * 3 * 2 * _BANDWIDTH_HZ * self.duration_s
        ridge = self.floor_train / count / _PRIOR_SD_LN**2
        normal = self.train.T @ self.train + ridge * np.eye(12)
        step = np.linalg.solve(normal, self.train.T @ misfit - ridge * moved)
        return np.clip(moved + np.clip(step, -1.5, 1.5), self.lower, self.upper)


@dataclass
class Fit:
    """Refit of the base to one effect as it goes on: the ln parameters moved by (12,), residuals on both trials."""

    refit: Refit
    train: np.ndarray
    held_out: np.ndarray
    moved: np.ndarray = field(default_factory=lambda: np.zeros(12))
    share: float = 1.0

    @property
    def usable(self) -> bool:
        """Whether the trials could be simulated at all."""
        return bool(np.isfinite(self.train).all() and np.isfinite(self.held_out).all())

    def propose(self) -> np.ndarray:
        """Where to look next."""
        return self.moved + self.share * (self.refit.step(self.train, self.moved) - self.moved)

    def tell(self, moved: np.ndarray, train: np.ndarray, held_out: np.ndarray) -> None:
        """Take in the residuals found there."""
        if train @ train < self.train @ self.train and np.isfinite(held_out).all():
            self.moved, self.train, self.held_out = moved, train, held_out
        else:
            self.share /= 3

    def visibility(self) -> float:
        """Gap rho that is left on the held-out trial."""
        if not self.usable:
            return np.inf
        return float(self.held_out @ self.held_out) / self.refit.floor_held_out


@dataclass
class Search:
    """Bracketing search for one severity in (0, 1], on logarithmic scales."""

    target: float
    tolerance: float
    low: tuple[float, float] | None = None
    high: tuple[float, float] | None = None
    best: tuple[float, float] = (1.0, np.nan)
    done: bool = False

    def tell(self, severity: float, reached: float) -> None:
        """Take in what a severity reached."""
        reached = max(reached, 1e-12)
        if not np.isfinite(self.best[1]) or self._miss(reached) < self._miss(self.best[1]):
            self.best = (severity, reached)
        if self._miss(reached) < self.tolerance or (severity >= 1.0 and reached < self.target):
            self.done = True
        if reached < self.target:
            if self.low is None or severity > self.low[0]:
                self.low = (severity, reached)
        elif self.high is None or severity < self.high[0]:
            self.high = (severity, reached)

    def _miss(self, reached: float) -> float:
        return abs(np.log(max(reached, 1e-12) / self.target))

    def ask(self) -> float:
        """The next severity to try."""
        if self.high is None:
            return 1.0
        # an unstable trial says only that there is too much
        s1, r1 = np.log(self.high[0]), np.log(min(self.high[1], 1e4 * self.target))
        if self.low is None:
            # a small effect is linear in its severity, so the gap is quadratic
            return float(np.exp(s1 - (r1 - np.log(self.target)) / 2))
        s0, r0 = np.log(self.low)
        share = np.clip((np.log(self.target) - r0) / max(r1 - r0, 1e-9), 0.15, 0.85)
        return float(np.exp(s0 + share * (s1 - s0)))


def refit_of(
    centres: dict[str, dict[str, Any]],
    noise: Callable[[tuple[int, ...]], np.ndarray],
    rate_hz: float,
    room: tuple[np.ndarray, np.ndarray],
) -> Refit:
    """Tangents and floors from simulated centres per trial: ``base``, ``tangent`` (12 of them), ``noisy``.

    ``noise`` draws the noise of a marker path of some shape; ``noisy`` are replays of pelvis markers with
    noise. ``room`` (12,), (12,): how far the ln parameters may move down and up.
    """
    tangents, floors = {}, {}
    for trial, runs in centres.items():
        base = runs["base"]
        tangents[trial] = np.column_stack([residual(c - base, rate_hz) / _STEP_LN for c in runs["tangent"]])
        own = [residual(noise(base.shape), rate_hz) for _ in range(_REALISATIONS)]
        replayed = [residual(c - base, rate_hz) for c in runs["noisy"]]
        floors[trial] = float(np.mean([r @ r for r in own]) + np.mean([r @ r for r in replayed]))
    duration = len(centres[TRAIN]["base"]) / rate_hz
    return Refit(tangents[TRAIN], tangents[HELD_OUT], floors[TRAIN], floors[HELD_OUT], duration, *room)


def perturbed(stiffness: np.ndarray, damping: np.ndarray) -> list[tuple[np.ndarray, np.ndarray]]:
    """Twelve copies of the strap's parameters, each with one of them larger by the tangents' step."""
    both = np.concatenate([stiffness, damping])
    grown = both * np.exp(_STEP_LN * np.eye(12))
    return [(row[:6], row[6:]) for row in grown]
