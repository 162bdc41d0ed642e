"""Further trials of the same person: what sets of effects that two trials were enough to fit predict of another one.

A set's numbers are known as well as the trials before let them be. What it leaves of a further trial is the least with
numbers that move no further than that, and the predictive likelihood is the one of Laplace's approximation: chi-squared
that is left, the distance that the numbers moved, and how much the trial narrows them down.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from real2sim.diagnosis.evidence import Evidence
from real2sim.diagnosis.refit import Hypothesis, JointResiduals, following, prior_widths
from real2sim.diagnosis.search import Pair, failed
from real2sim.diagnosis.sensors import by_sensor
from real2sim.inference.least_squares import bounded_step


@dataclass(frozen=True)
class Predicted:
    """Chi-squared that a set leaves of a further trial by sensor, and what the predictive likelihood adds to it."""

    by_sensor: tuple[float, ...]
    occam: float

    @property
    def chi2(self) -> float:
        """Chi-squared of all sensors."""
        return sum(self.by_sensor)


def information(pair: Pair, hypothesis: Hypothesis) -> np.ndarray:
    """Return what both trials and the priors tell of a hypothesis' searched numbers: normal matrix (n + p, n + p)."""
    everything = np.arange(len(hypothesis.z))
    total = np.zeros((len(everything), len(everything)))
    for evidence in (pair.train, pair.held_out):
        problem = following(evidence, hypothesis, pair.system, coarse=True)
        _, jacobian = problem.with_jacobian(hypothesis.z, everything)
        # rows of the priors count once
        rows = jacobian[: evidence.rows] if evidence is pair.held_out else jacobian
        total += rows.T @ rows
    # a number without a prior of its own has a uniform one between its bounds
    width = prior_widths(problem.prior_sd, problem.lower, problem.upper)
    total[np.diag_indices_from(total)] += np.where(np.isfinite(problem.prior_sd), 1e-9, 1 / width**2)
    return total


def predict_further(
    pair: Pair, hypothesis: Hypothesis, further: Sequence[Evidence], longest: float
) -> list[Predicted]:
    """Return what a hypothesis leaves of further trials, one after the other, each told by those before.

    ``longest`` is the longest step of a searched number that a tangent is believed for.
    """
    if not further:
        return []
    own, z = _of_each_trial(pair, hypothesis), hypothesis.z.copy()
    z[own] = 0.0
    known = information(pair, hypothesis)
    moved, out = np.zeros(len(z)), []
    for evidence in further:
        problem = JointResiduals(evidence, hypothesis.effects, pair.system, coarse=True)
        problem.follow(z)
        r, jacobian = problem.with_jacobian(z, np.arange(len(z)))
        r, jacobian = r[: evidence.rows], jacobian[: evidence.rows]
        moved[own] = 0.0
        known[own], known[:, own] = 0.0, 0.0
        width = prior_widths(problem.prior_sd, problem.lower, problem.upper)
        known[own, own] = 1 / width[own] ** 2
        if not (np.isfinite(r).all() and np.isfinite(jacobian).all()):
            out.append(Predicted(failed(len(evidence.sensors)), 0.0))
            continue
        here = r + jacobian @ moved
        # a coefficient of a trial's own history acts linearly however far it goes
        furthest = np.where(own, np.inf, longest)
        lower = np.maximum(problem.lower - z, -furthest) - moved
        upper = np.minimum(problem.upper - z, furthest) - moved
        more = known + jacobian.T @ jacobian
        step = bounded_step(more, jacobian.T @ here, lower, upper)
        narrowed = np.linalg.slogdet(more)[1] - np.linalg.slogdet(known)[1]
        left = by_sensor((here + jacobian @ step)[None], evidence.sensors.values())[0].tolist()
        moved_by = float(step @ known @ step + narrowed)
        if not np.isfinite([*left, moved_by]).all():
            out.append(Predicted(failed(len(evidence.sensors)), 0.0))
            continue
        out.append(Predicted(tuple(left), moved_by))
        known, moved = more, moved + step
    return out


def _of_each_trial(pair: Pair, hypothesis: Hypothesis) -> np.ndarray:
    """Return a mask (n + p,) of the held-out trial's own numbers: those of another trial are not known."""
    base = np.zeros(len(hypothesis.base), bool)
    effects = [p.of_trial(held_out=True) & ~p.of_trial(held_out=False) for p in hypothesis.effects]
    return np.concatenate([base, *effects])
