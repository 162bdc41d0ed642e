"""The bias that noise of what is replayed gives a fit, on a problem whose answer is known: errors in variables."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from real2sim.diagnosis.corrected import Correction, corrected
from real2sim.diagnosis.refit import Hypothesis
from real2sim.diagnosis.search import Pair

from tests.unit.simulated_effects import STRAP
from tests.unit.test_coupling import CONFIG

SAMPLES, NOISE = 4000, 0.5
TRUTH = np.linspace(-1.0, 1.0, 12)
RULE = replace(Correction.from_options(CONFIG["diagnosis"]["search"]), draws=8, iterations=8, seed=3)


class _Measured:
    """y = X z, of which X is known with noise of its own; the derivatives of the residuals have it, too."""

    def __init__(self, noise: float):
        rng = np.random.default_rng(1)
        self._noise = noise
        clean = rng.standard_normal((SAMPLES, 12))
        self.x = clean + noise * rng.standard_normal((SAMPLES, 12))
        # residuals in units of their own noise, as whitening leaves them
        self.unit = np.sqrt(0.1**2 + noise**2 * TRUTH @ TRUTH)
        self.y = clean @ TRUTH + 0.1 * rng.standard_normal(SAMPLES)

    def whiten(self, error: np.ndarray) -> np.ndarray:
        return error / self.unit

    def shaken(self, draws: int, seed: int):
        noise = self._noise * np.random.default_rng(seed).standard_normal((draws, SAMPLES, 12))
        return lambda parameters: noise @ np.log(parameters)


class _Problem:
    """As `JointResiduals`, of that problem."""

    lower, upper = np.full(12, -5.0), np.full(12, 5.0)

    def __init__(self, evidence, effects, system, *, coarse=False):
        self._evidence = evidence

    def _residuals(self, z):
        return (self._evidence.x @ z - self._evidence.y) / self._evidence.unit

    def follow(self, z):
        """Nothing is planned."""

    def with_jacobian(self, z, free):
        return self._residuals(z), self._evidence.x / self._evidence.unit

    def costs(self, z):
        return np.array([np.sum(self._residuals(row) ** 2) for row in z])


def _fits(monkeypatch, noise: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Least squares, its correction and the covariance of that."""
    monkeypatch.setattr("real2sim.diagnosis.refit.JointResiduals", _Problem)
    evidence = _Measured(noise)
    plain = np.linalg.lstsq(evidence.x, evidence.y, rcond=None)[0]
    pair = Pair(evidence, evidence, STRAP)
    return (plain, *corrected(pair, Hypothesis((), plain, (1.0, 1.0)), RULE))


def test_what_noise_takes_is_given_back(monkeypatch):
    plain, point, covariance = _fits(monkeypatch, NOISE)
    shrunk = 1 / (1 + NOISE**2)
    assert plain == pytest.approx(shrunk * TRUTH, abs=0.05)
    assert point == pytest.approx(TRUTH, abs=0.08)
    z = (point - TRUTH) / np.sqrt(np.diag(covariance))
    assert np.abs(z).max() < 3.5
    assert np.abs((plain - TRUTH) / np.sqrt(np.diag(covariance))).max() > 8


def test_without_noise_nothing_is_corrected(monkeypatch):
    plain, point, covariance = _fits(monkeypatch, 0.0)
    assert point == pytest.approx(plain, abs=1e-9)
    x = _Measured(0.0)
    assert covariance == pytest.approx(np.linalg.inv(x.x.T @ x.x) * x.unit**2, rel=1e-6)


def test_what_only_noise_tells_is_told_as_not_known(monkeypatch):
    """A parameter that moves nothing but noise keeps an interval that is far wider than its curvature says."""
    monkeypatch.setattr("real2sim.diagnosis.refit.JointResiduals", _Problem)
    evidence = _Measured(NOISE)
    rng = np.random.default_rng(5)
    evidence.x[:, 0] = NOISE * rng.standard_normal(SAMPLES)
    evidence.y = evidence.x @ TRUTH + 0.1 * rng.standard_normal(SAMPLES)
    plain = np.linalg.lstsq(evidence.x, evidence.y, rcond=None)[0]
    pair = Pair(evidence, evidence, STRAP)
    _, covariance = corrected(pair, Hypothesis((), plain, (1.0, 1.0)), replace(RULE, iterations=1))
    curvature = np.linalg.inv(evidence.x.T @ evidence.x) * evidence.unit**2
    assert covariance[0, 0] > 100 * curvature[0, 0]
    assert covariance[1, 1] < 10 * curvature[1, 1]
