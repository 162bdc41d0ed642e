"""What a hypothesis leaves of two trials with numbers that are fitted to both.

A fit to one trial leaves much more than noise of another that tells what the first left open, also where the law is
true: friction that holds most of the time hides the spring beneath it. With fixed numbers that counts against the law.
The evidence of a law in two trials is that of numbers which serve both: where the first trial left a number open, it
costs nothing to move it, and where it told the number, what a move brings on the second is paid for on the first. So a
wrong law gains little by it. What is withheld stays withheld: gaps closed are those of the fit to the first trial.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from real2sim.diagnosis.refit import FitToBoth, Hypothesis, following
from real2sim.inference import least_squares

if TYPE_CHECKING:
    from real2sim.diagnosis.search import Pair


class BothResiduals(least_squares.Residuals):
    """Whitened residuals of two trials in the numbers of a hypothesis, and the rows of their priors.

    Those of the held-out trial follow those of the fitted one, rows of the priors once. ``free`` are the coordinates
    that either trial is fitted in.
    """

    def __init__(self, pair: Pair, hypothesis: Hypothesis):
        trials = (pair.train, pair.held_out)
        self.each = [following(e, hypothesis, pair.system, coarse=True) for e in trials]
        self._rows = pair.held_out.rows
        self.lower, self.upper = self.each[0].lower, self.each[0].upper
        self.free = np.union1d(self.each[0].free, self.each[1].free)
        self.evaluations = 0

    def many(self, z: np.ndarray) -> np.ndarray:
        """Residuals (m, n_r) of points (m, n + p)."""
        first, second = (trial.many(z) for trial in self.each)
        self._count()
        return np.hstack([first, second[:, : self._rows]])

    def with_jacobian(self, z: np.ndarray, free: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """As of `least_squares.Residuals`."""
        (first, slopes), (second, more) = (trial.with_jacobian(z, free) for trial in self.each)
        self._count()
        rows = self._rows
        return np.concatenate([first, second[:rows]]), np.vstack([slopes, more[:rows]])

    def jacobian(self, z: np.ndarray, r: np.ndarray, free: np.ndarray) -> np.ndarray:
        """As of `least_squares.Residuals`."""
        return self.with_jacobian(z, free)[1]

    def _count(self) -> None:
        self.evaluations = sum(trial.evaluations for trial in self.each)

    def judged(self, z: np.ndarray) -> list[np.ndarray]:
        """Chi-squared (s,) by sensor of each trial at a point (n + p,)."""
        left = [np.asarray(trial.judged(z)[0]) for trial in self.each]
        self._count()
        return left


def fit_both(
    pair: Pair, hypothesis: Hypothesis, *, iterations: int, ftol: float, keep: float = 0.0
) -> tuple[FitToBoth, int]:
    """Refit a hypothesis to both trials, from its fit to one; what that leaves, and how many replays it took.

    What is left differs from that of the fit by what the refit changes: the fit may be of a finer time step. Where the
    refit does not lead to less on both trials together, or cannot be simulated, the fit stands. ``iterations``,
    ``ftol`` and ``keep``: see `least_squares.minimise`.
    """
    problem, z = BothResiduals(pair, hypothesis), hypothesis.z
    before = problem.judged(z)
    moved, _, _, _ = least_squares.minimise(
        problem, z, problem.free, iterations=iterations, ftol=ftol, keep=keep
    )
    _, slopes = problem.with_jacobian(moved, problem.free)
    occam, after = problem.each[0].occam_of(moved, slopes, problem.free), problem.judged(moved)
    cost = sum(float(left.sum()) for left in after) + occam
    fixed = sum(float(left.sum()) for left in before) + hypothesis.occam
    if not (np.isfinite(cost) and cost < fixed):
        return FitToBoth(z, hypothesis.by_sensor, hypothesis.occam), problem.evaluations
    left = [
        tuple(np.maximum(np.asarray(own) + b - a, 0.0).tolist())
        for own, a, b in zip(hypothesis.by_sensor, before, after, strict=True)
    ]
    return FitToBoth(moved, tuple(left), occam), problem.evaluations
