"""How strong an effect has to be to make a gap of a given size, by the phantom's own physics.

The gap of a case is what is left of the effect on the held-out trial when the twelve parameters are refitted to
the training trial, over the noise floor: rho = (J - floor) / floor. The refit takes a few Gauss-Newton steps, each
of which is simulated, with tangents by finite differences and Broyden's update of them; the next severity's refit
begins where the last one's ended.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from scipy.optimize import lsq_linear

from real2sim.verification.suite.measurement import residual

TRAIN, HELD_OUT = "dynamic_1", "dynamic_2"
STEP_LN = 1e-3
_PRIOR_SD_LN = 1.0  # a refit stays within the search bounds: about this far in ln
_REALISATIONS = 20  # of the noise, for its expected cost
_FARTHEST_LN = 1.5  # of one step
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

    def step(self, tangent: np.ndarray, misfit: np.ndarray, moved: np.ndarray) -> np.ndarray:
        """Return the ln parameters (12,) to which a misfit on the training trial moves them from ``moved``."""
        # independent values: two markers, three axes, twice the band-width
        count = 2 * 3 * 2 * _BANDWIDTH_HZ * self.duration_s
        ridge = self.floor_train / count / _PRIOR_SD_LN**2
        normal = tangent.T @ tangent + ridge * np.eye(12)
        root = np.linalg.cholesky(normal)
        goal = np.linalg.solve(root, tangent.T @ misfit - ridge * moved)
        low = np.maximum(self.lower - moved, -_FARTHEST_LN)
        high = np.minimum(self.upper - moved, _FARTHEST_LN)
        # where a parameter is stopped by a bound, the others make up for it
        reached: np.ndarray = moved + lsq_linear(root.T, goal, (low - 1e-9, high + 1e-9), method="bvls").x
        return reached


@dataclass
class Fit:
    """Refit of the base to one effect as it goes on: the ln parameters moved by (12,), residuals on both trials."""

    refit: Refit
    train: np.ndarray
    held_out: np.ndarray
    moved: np.ndarray = field(default_factory=lambda: np.zeros(12))
    share: float = 1.0
    tangent: np.ndarray = field(init=False)

    def __post_init__(self) -> None:
        self.tangent = self.refit.train

    @property
    def usable(self) -> bool:
        """Return whether the trials could be simulated at all."""
        return bool(np.isfinite(self.train).all() and np.isfinite(self.held_out).all())

    def start(self, moved: np.ndarray, train: np.ndarray, held_out: np.ndarray, tangent: np.ndarray) -> None:
        """Begin at ``moved`` (12,) with residuals (r,), (s,) of the trials and tangent (r, 12), if that is better."""
        if np.isfinite(tangent).all() and train @ train < self.train @ self.train:
            self.moved, self.train, self.held_out, self.tangent = moved, train, held_out, tangent

    def propose(self) -> np.ndarray:
        """Return the ln parameters (12,) to simulate next."""
        goal = self.refit.step(self.tangent, self.train, self.moved)
        proposed: np.ndarray = self.moved + self.share * (goal - self.moved)
        return proposed

    def tell(self, moved: np.ndarray, train: np.ndarray, held_out: np.ndarray) -> None:
        """Take in the residuals (r,), (s,) of both trials at ln-parameters moved by ``moved`` (12,)."""
        # Broyden's update: the tangents far from the true parameters are others
        way = moved - self.moved
        if np.isfinite(train).all() and way @ way > 0:
            missed = (self.train - train) - self.tangent @ way
            self.tangent = self.tangent + np.outer(missed, way / (way @ way))
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
    """Bracketing search for one severity in (0, 1], on logarithmic scales.

    The first told is severity 1. A refit goes on from where the last one ended, so that a severity that makes
    the gap is asked for once more; where it does not keep it, the search begins anew with what is known now.
    """

    target: float
    tolerance: float
    low: tuple[float, float] | None = None
    high: tuple[float, float] | None = None
    top: tuple[float, float] | None = None
    best: tuple[float, float] = (1.0, np.nan)
    confirm: bool = False
    done: bool = False

    def tell(self, severity: float, reached: float) -> None:
        """Take in what a severity reached."""
        reached = min(max(reached, 1e-12), 1e12)
        if self.top is None:
            self.top = (severity, reached)
            self.done = reached < self.target * np.exp(self.tolerance)
        if self.confirm and self._miss(reached) < self.tolerance:
            self.done = True
        elif self.confirm:
            self.low, self.high, self.best = None, self.top, (severity, reached)
        if not np.isfinite(self.best[1]) or self._miss(reached) < self._miss(self.best[1]):
            self.best = (severity, reached)
        self.confirm = self._miss(reached) < self.tolerance
        if reached < self.target:
            if self.low is None or severity > self.low[0]:
                self.low = (severity, reached)
        elif self.high is None or severity < self.high[0]:
            self.high = (severity, reached)

    def _miss(self, reached: float) -> float:
        return float(abs(np.log(reached / self.target)))

    def ask(self) -> float:
        """The next severity to try."""
        if self.high is None:
            return 1.0
        if self.confirm:
            return self.best[0]
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
        tangents[trial] = np.column_stack([residual(c - base, rate_hz) / STEP_LN for c in runs["tangent"]])
        own = [residual(noise(base.shape), rate_hz) for _ in range(_REALISATIONS)]
        replayed = [residual(c - base, rate_hz) for c in runs["noisy"]]
        floors[trial] = float(np.mean([r @ r for r in own]) + np.mean([r @ r for r in replayed]))
    duration = len(centres[TRAIN]["base"]) / rate_hz
    return Refit(tangents[TRAIN], tangents[HELD_OUT], floors[TRAIN], floors[HELD_OUT], duration, *room)


def perturbed(stiffness: np.ndarray, damping: np.ndarray) -> list[tuple[np.ndarray, np.ndarray]]:
    """Return twelve copies of stiffness and damping (6,), each with one of the numbers larger by the tangents' step."""
    both = np.concatenate([stiffness, damping])
    grown = both * np.exp(STEP_LN * np.eye(12))
    return [(row[:6], row[6:]) for row in grown]
