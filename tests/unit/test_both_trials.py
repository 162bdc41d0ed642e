"""What a hypothesis leaves of two trials with numbers that are fitted to both."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from real2sim.diagnosis import refit
from real2sim.diagnosis.answer import _of_both_trials
from real2sim.diagnosis.attribute import Attribution
from real2sim.diagnosis.both_trials import fit_both
from real2sim.diagnosis.refit import FitToBoth, Hypothesis, JointResiduals
from real2sim.diagnosis.trials import Found

from tests.unit.test_coupling import CONFIG

_PRIOR_SD = np.array([2.0, 3.0, 0.5])


class Linear:
    """Residuals of a trial that are linear in three numbers, with a prior for each."""

    occam_of = JointResiduals.occam_of

    def __init__(self, evidence, effects, system, *, coarse=False):
        self.lower, self.upper = np.full(3, -1e3), np.full(3, 1e3)
        self.prior_mean, self.prior_sd = np.zeros(3), _PRIOR_SD
        self.free = np.arange(0 if evidence.held_out else 3)
        self._evidence, self.evaluations = evidence, 0

    def follow(self, z):
        """Nothing is planned."""

    def many(self, z):
        self.evaluations += len(z)
        e = self._evidence
        return np.hstack([z @ e.matrix.T - e.measured, z / self.prior_sd])

    def with_jacobian(self, z, free):
        return self.many(z[None])[0], np.vstack([self._evidence.matrix, np.diag(1 / self.prior_sd)])[:, free]

    def judged(self, z):
        left = self.many(z[None])[0, : self._evidence.rows] ** 2
        return (left[0::2].sum(), left[1::2].sum()), 0.0


@pytest.fixture
def pair(monkeypatch):
    monkeypatch.setattr(refit, "JointResiduals", Linear)
    rng = np.random.default_rng(4)

    def trial(rows, held_out):
        return SimpleNamespace(
            matrix=rng.standard_normal((rows, 3)),
            measured=5 * rng.standard_normal(rows),
            rows=rows,
            held_out=held_out,
        )

    return SimpleNamespace(train=trial(8, False), held_out=trial(6, True), system=None)


def _fitted(pair, z=None) -> Hypothesis:
    """The fit to the first trial alone, or a hypothesis with numbers z (3,)."""
    problem, other = (Linear(e, (), None) for e in (pair.train, pair.held_out))
    matrix = problem.with_jacobian(np.zeros(3), np.arange(3))[1]
    if z is None:
        z = np.linalg.lstsq(matrix, -problem.many(np.zeros((1, 3)))[0], rcond=None)[0]
    left = tuple(p.judged(z)[0] for p in (problem, other))
    occam = problem.occam_of(z, matrix)
    return Hypothesis((), z, tuple(map(sum, left)), occam=occam, sensors=left)


def test_the_evidence_of_both_trials_is_that_of_a_gaussian(pair):
    fit = _fitted(pair)
    both, count = fit_both(pair, fit, iterations=20, ftol=1e-12)
    matrix = np.vstack([pair.train.matrix, pair.held_out.matrix])
    measured = np.concatenate([pair.train.measured, pair.held_out.measured])
    spread = np.eye(14) + matrix @ np.diag(_PRIOR_SD**2) @ matrix.T
    exact = measured @ np.linalg.solve(spread, measured) + np.linalg.slogdet(spread)[1]
    told = sum(map(sum, both.by_sensor)) + both.occam
    assert told == pytest.approx(exact, rel=1e-6)
    assert count > 0
    # what was withheld stays as it was, and what is left of the fitted trial pays for what the other gains
    assert fit.chi2 == _fitted(pair).chi2
    assert sum(both.by_sensor[0]) > fit.chi2[0]
    assert sum(both.by_sensor[1]) < fit.chi2[1]


def test_numbers_that_the_first_trial_tells_do_not_move_for_the_second(pair):
    """A law that is wrong about the second trial stays wrong: the first one holds its numbers."""
    pair.train.matrix *= 1e4
    fit = _fitted(pair)
    both, _ = fit_both(pair, fit, iterations=20, ftol=1e-12)
    assert sum(both.by_sensor[1]) == pytest.approx(fit.chi2[1], rel=1e-3)


def test_a_fit_that_cannot_be_simulated_on_the_second_trial_stands(pair):
    fit = _fitted(pair)
    pair.held_out.measured[0] = np.nan
    both, _ = fit_both(pair, fit, iterations=20, ftol=1e-12)
    assert both.z is fit.z
    assert both.by_sensor == fit.by_sensor
    assert both.occam == fit.occam


def test_what_is_left_is_told_in_the_time_step_of_the_fit(pair):
    """The refit may take a coarser step; only what it changes is carried over."""
    fit = _fitted(pair)
    finer = Hypothesis(
        (),
        fit.z,
        fit.chi2,
        occam=fit.occam,
        sensors=tuple(tuple(x + 100 for x in own) for own in fit.sensors),
    )
    coarse, _ = fit_both(pair, fit, iterations=20, ftol=1e-12)
    fine, _ = fit_both(pair, finer, iterations=20, ftol=1e-12)
    assert np.array(fine.by_sensor) == pytest.approx(np.array(coarse.by_sensor) + 100)


def test_a_set_competes_with_what_numbers_fitted_to_both_trials_leave():
    pair = SimpleNamespace(samples_by_sensor=((100,), (100,)), on_floor=lambda sd: (False,))
    plain = Hypothesis((), np.zeros(12), (900.0, 900.0), occam=3.0)
    told = Hypothesis((), np.ones(12), (110.0, 900.0), occam=5.0)
    attribution = Attribution(plain, [told], [], (100, 100), None)
    found, options = Found(pair, attribution), CONFIG["diagnosis"]
    assert found.candidate(told, options).chi2 == (110, 900)
    assert _of_both_trials(told, attribution) is None
    told.both = FitToBoth(np.ones(12), ((120.0,), (105.0,)), 9.0)
    candidate = found.candidate(told, options)
    assert candidate.chi2 == (120, 105)
    assert candidate.occam == 6
    assert candidate.deviance == told.deviance - plain.occam
    # how much is unexplained is asked of what the fit to the first trial predicts
    assert candidate.sensors == ((1010, 200, False),)
    assert candidate.left == 1010
    assert candidate.beyond((100, 100)) == 810
    assert _of_both_trials(told, attribution) == {"chi2": [120, 105], "occam": 6}
