"""How wide intervals are: noise that moves many residuals together, effects beside parameters of the system."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from real2sim.configuration import read_yaml, validated
from real2sim.diagnosis import intervals
from real2sim.diagnosis.intervals import Precision, effect_intervals, precision_by_noise
from real2sim.diagnosis.refit import Hypothesis
from real2sim.diagnosis.search import Pair
from real2sim.effects.catalogue import EFFECTS, Placed
from real2sim.inference.identifiability import AT_BOUND, DETERMINED, NOT_DETERMINED, WEAK
from real2sim.system.description import Parameter

from tests.unit.simulated_effects import SCALES, STRAP

ROOT = Path(__file__).parents[2]
CONFIG = validated(read_yaml(ROOT / "config/config.yaml"), "config", ROOT / "config/config.yaml")
OPTIONS = CONFIG["diagnosis"]
ROWS = 600


class _Trial:
    """White noise on all residuals, and beside it one number per draw of size ``together`` along ``direction``."""

    def __init__(self, direction: np.ndarray, together: float):
        self.direction, self.together = direction, together

    def noise_of(self, effects, parameters, x, draws, seed):
        rng = np.random.default_rng(seed)
        common = self.together * rng.standard_normal((draws, 1)) * self.direction
        return rng.standard_normal((draws, ROWS)) + common


@pytest.fixture
def linear(monkeypatch):
    """Residuals that are linear in twelve numbers, with two rows of priors below those of the data."""
    rng = np.random.default_rng(3)
    data, _ = np.linalg.qr(rng.standard_normal((ROWS, 12)))
    jacobian = np.vstack([data, 1e-3 * np.eye(12)[:2]])
    covariance = np.linalg.inv(jacobian.T @ jacobian)
    monkeypatch.setattr(intervals, "_curvature", lambda pair, fit: (jacobian, covariance))
    return data


def _scatter(trial: _Trial, draws: int = 400) -> np.ndarray:
    fit = Hypothesis((), np.zeros(12), (1.0, 1.0))
    return precision_by_noise(Pair(trial, trial, STRAP), fit, OPTIONS | {"noise_draws": draws}).wider


def test_noise_that_moves_residuals_together_widens_what_it_looks_like(linear):
    """A start pose that is off by three SD of what the curvature says of one parameter, and of no other."""
    wider = _scatter(_Trial(linear[:, 4], 3.0))
    assert wider[4] == pytest.approx(np.hypot(1, 3), rel=0.1)
    assert np.delete(wider, 4) == pytest.approx(1.0, abs=0.1)


def test_white_noise_widens_nothing(linear):
    wider = _scatter(_Trial(linear[:, 4], 0.0))
    assert wider.min() == 1.0
    assert wider == pytest.approx(1.0, abs=0.1)


def test_a_direction_that_the_data_say_nothing_of_stays_as_its_prior_left_it(monkeypatch):
    jacobian = np.vstack([np.eye(ROWS)[:, :12], np.eye(12)[:1]])
    jacobian[0, 0] = 0.0
    covariance = np.linalg.inv(jacobian.T @ jacobian)
    monkeypatch.setattr(intervals, "_curvature", lambda pair, fit: (jacobian, covariance))
    assert _scatter(_Trial(np.zeros(ROWS), 0.0))[0] == 1.0


def test_no_effect_is_known_better_than_the_plant():
    """The size of a delay, and the logarithm of a friction: by curvature both are exact."""
    least = OPTIONS["report"]["plant_sd_ln"]
    for name, x in (("sync_offset", 0.05), ("coulomb", np.log(0.5))):
        effect = next(e for e in EFFECTS if e.name == name and not e.form)
        place = Placed(effect, effect.places(STRAP)[0], SCALES)
        z = np.zeros(12 + len(effect.parameters))
        z[12] = x
        fit = Hypothesis((place,), z, (1.0, 1.0))
        exact = Precision(np.zeros((len(z), len(z))), np.ones(len(z)))
        ends = effect_intervals(fit, exact, OPTIONS)[0][0]
        value = place.values(z[None, 12:])[0, 0]
        assert (np.log(ends[1] / ends[0]) / 2) == pytest.approx(1.96 * least, rel=0.02), name
        assert ends[0] < value < ends[1]


@pytest.mark.parametrize("scale", [1.0, 1e-3, 200.0])
def test_an_offset_has_the_same_verdict_in_any_unit(monkeypatch, scale):
    """Value, SD [N], verdict of a constant force of which up to 50 N are searched."""
    for value, sd, expected in (
        (12.0, 0.1, DETERMINED),
        (0.0, 0.1, DETERMINED),
        (12.0, 3.0, WEAK),
        (0.0, 50.0, NOT_DETERMINED),
        (35.0, 0.1, DETERMINED),
        (49.9, 0.1, AT_BOUND),
    ):
        offset = Parameter("push", "N", -50.0 * scale, 50.0 * scale, "offset", "x", log=False)
        bounds = np.array([offset.lower]), np.array([offset.upper])
        pair = SimpleNamespace(system=SimpleNamespace(parameters=[offset], bounds=lambda b=bounds: b))
        fit, covariance = np.array([value * scale]), np.array([[(sd * scale) ** 2]])
        monkeypatch.setattr(intervals, "corrected", lambda *_, z=fit, c=covariance: (z, c))
        (known,) = intervals.parameter_verdicts(pair, Hypothesis((), fit, (1.0, 1.0)), np.ones(1), CONFIG)
        assert known.verdict == expected, (value, sd)
        half = 1.96 * np.hypot(sd, OPTIONS["report"]["plant_sd_ln"] * value)
        ends = np.clip([value - half, value + half], -50, 50)
        assert known.ci95 == pytest.approx(scale * ends, abs=1e-9)
