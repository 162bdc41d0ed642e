"""Further trials: what fits to two trials predict of another one."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from real2sim.diagnosis import further, refit
from real2sim.diagnosis.further import predict_further
from real2sim.diagnosis.predicted import information
from real2sim.diagnosis.refit import Hypothesis
from real2sim.diagnosis.search import FAILED


@pytest.fixture
def pair(monkeypatch):
    """Two trials whose residuals are linear in three numbers, and what makes another."""
    rng = np.random.default_rng(1)

    class Linear:
        """Residuals of evidence with matrix and measurements."""

        def __init__(self, evidence, effects, system, *, coarse):
            self.lower, self.upper = np.full(3, -1e3), np.full(3, 1e3)
            self.prior_sd = np.array([np.inf, np.inf, 0.5])
            self._evidence = evidence

        def follow(self, z):
            """Nothing is planned."""

        def with_jacobian(self, z, free):
            e = self._evidence
            return self.many(z[None])[0], e.matrix[:, free]

        def many(self, z):
            e = self._evidence
            return z @ e.matrix.T - e.measured

    def trial(rows: int, scale: float = 1.0):
        matrix = scale * rng.standard_normal((rows, 3))
        return SimpleNamespace(
            matrix=matrix, measured=rng.standard_normal(rows), samples=rows, rows=rows, sensors={"outputs": 1}
        )

    for module in (further, refit):
        monkeypatch.setattr(module, "JointResiduals", Linear)
    return SimpleNamespace(train=trial(8), held_out=trial(6), system=None), trial


def _at_optimum(pair) -> Hypothesis:
    both = [np.vstack([e.matrix for e in (pair.train, pair.held_out)])]
    y = np.concatenate([pair.train.measured, pair.held_out.measured])
    return Hypothesis((), np.linalg.lstsq(both[0], y, rcond=None)[0], (1.0, 1.0))


def test_the_predictive_likelihood_is_that_of_a_gaussian(pair):
    two, trial = pair
    third, fourth = trial(5), trial(4, 3.0)
    fit = _at_optimum(two)
    found = predict_further(two, fit, [third, fourth], np.inf)
    # both together: what is measured scatters by noise, and by what is not known of the numbers
    matrix = np.vstack([third.matrix, fourth.matrix])
    spread = np.eye(9) + matrix @ np.linalg.inv(information((two.train, two.held_out), fit, None)) @ matrix.T
    error = matrix @ fit.z - np.concatenate([third.measured, fourth.measured])
    exact = error @ np.linalg.solve(spread, error) + np.linalg.slogdet(spread)[1]
    assert sum(f.chi2 + f.occam for f in found) == pytest.approx(exact)
    assert all(f.chi2 > 0 for f in found)


def test_what_only_a_third_trial_tells_pays_for_its_own_prior(pair):
    """A number that two trials say nothing of is known to lie between its bounds, and no worse."""
    two, trial = pair
    for evidence in (two.train, two.held_out):
        evidence.matrix[:, 0] = 0.0
    uniform = 12 / 2000.0**2
    assert information((two.train, two.held_out), _at_optimum(two), None)[0, 0] == pytest.approx(uniform)
    third = trial(5)
    third.matrix[:, 1:] = 0.0
    told = float(third.matrix[:, 0] @ third.matrix[:, 0])
    fit = _at_optimum(two)
    third.measured = third.matrix @ fit.z
    found = predict_further(two, fit, [third], np.inf)[0]
    assert found.occam == pytest.approx(np.log1p(told / uniform), rel=1e-6)


def test_a_step_beyond_what_a_tangent_bears_is_not_taken(pair):
    two, trial = pair
    third = trial(5, 1e-3)
    third.measured = 10 * np.ones(5)
    free, held = (predict_further(two, _at_optimum(two), [third], longest)[0] for longest in (np.inf, 1e-3))
    assert held.chi2 >= free.chi2


def test_a_simulation_that_fails_explains_nothing_of_that_trial(pair):
    two, trial = pair
    broken, sound = trial(5), trial(5)
    broken.measured = np.full(5, np.nan)
    first, second = predict_further(two, _at_optimum(two), [broken, sound], np.inf)
    assert first.chi2 == FAILED
    assert second.chi2 < 1e3


def test_without_further_trials_there_is_nothing_to_foretell(pair):
    assert predict_further(pair[0], _at_optimum(pair[0]), [], 1.0) == []


def test_a_history_of_the_held_out_trial_is_not_that_of_another(pair):
    two, trial = pair
    effect = SimpleNamespace(parameters=[None])
    placed = SimpleNamespace(
        effect=effect, key="force", of_trial=lambda held_out: np.array([held_out], dtype=bool)
    )
    fit = Hypothesis((placed,), np.array([0.1, 0.2, 7.0]), (1.0, 1.0))
    third = trial(5)
    found = predict_further(two, fit, [third], 1.0)[0]
    # of its own number nothing is known but the prior
    known = information((two.train, two.held_out), fit, None)
    known[2], known[:, 2] = 0.0, 0.0
    known[2, 2] = 4.0
    spread = np.eye(5) + third.matrix @ np.linalg.inv(known) @ third.matrix.T
    error = third.matrix @ np.array([0.1, 0.2, 0.0]) - third.measured
    exact = error @ np.linalg.solve(spread, error) + np.linalg.slogdet(spread)[1]
    assert found.chi2 + found.occam == pytest.approx(exact, rel=1e-6)


def test_a_number_of_each_trial_without_a_gaussian_prior_has_a_uniform_one(pair):
    """The clock of the held-out trial, say: of another trial's nothing is known but the bounds of the search."""
    two, trial = pair
    placed = SimpleNamespace(
        effect=SimpleNamespace(parameters=[None, None]),
        key="clock",
        of_trial=lambda held_out: np.array([held_out, True]),
    )
    fit = Hypothesis((placed,), np.array([0.1, 7.0, 0.2]), (1.0, 1.0))
    third = trial(5)
    found = predict_further(two, fit, [third], np.inf)[0]
    known = information((two.train, two.held_out), fit, None)
    known[1], known[:, 1] = 0.0, 0.0
    known[1, 1] = 12 / 2000.0**2
    spread = np.eye(5) + third.matrix @ np.linalg.inv(known) @ third.matrix.T
    error = third.matrix @ np.array([0.1, 0.0, 0.2]) - third.measured
    exact = error @ np.linalg.solve(spread, error) + np.linalg.slogdet(spread)[1]
    assert found.chi2 < FAILED
    assert found.chi2 + found.occam == pytest.approx(exact, rel=1e-6)
