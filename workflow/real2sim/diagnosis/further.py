"""Further trials of the same person: what sets of effects that two trials were enough to fit predict of another one.

A set's numbers are known as well as the trials before let them be. What it leaves of a further trial is the least with
numbers that move no further than that, and the predictive likelihood is the one of Laplace's approximation: chi-squared
that is left, the distance that the numbers moved, and how much the trial narrows them down.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from real2sim.diagnosis.evidence import Evidence
from real2sim.diagnosis.predicted import Predicted, information, predict
from real2sim.diagnosis.refit import Hypothesis, JointResiduals, prior_widths
from real2sim.diagnosis.search import Pair, failed


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
    known = information((pair.train, pair.held_out), hypothesis, pair.system)
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
        # a coefficient of a trial's own history acts linearly however far it goes
        furthest = np.where(own, np.inf, longest)
        lower = np.maximum(problem.lower - z, -furthest) - moved
        upper = np.minimum(problem.upper - z, furthest) - moved
        told, step, known = predict(evidence, r + jacobian @ moved, jacobian, known, (lower, upper))
        out.append(told or Predicted(failed(len(evidence.sensors)), 0.0))
        moved = moved + step
    return out


def _of_each_trial(pair: Pair, hypothesis: Hypothesis) -> np.ndarray:
    """Return a mask (n + p,) of the held-out trial's own numbers: those of another trial are not known."""
    base = np.zeros(len(hypothesis.base), bool)
    effects = [p.of_trial(held_out=True) & ~p.of_trial(held_out=False) for p in hypothesis.effects]
    return np.concatenate([base, *effects])
