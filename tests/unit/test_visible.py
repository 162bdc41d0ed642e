"""What two records could have shown, and what a set could have been: sizes and Occam's term."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from real2sim.diagnosis.refit import JointResiduals
from real2sim.diagnosis.visible import _confirmed, _crossed, _Left, _occam, _Trials, of_size
from real2sim.effects.base import Scales
from real2sim.system.description import shipped_system

STRAP = shipped_system("strap")
SCALES = Scales(*(np.arange(1.0, 7.0) * s for s in (0.01, 0.1, 1e4, 100.0, 2.0)))


@pytest.mark.parametrize(
    ("effect", "axes", "parameter", "size"),
    [
        ("coulomb", ["tz"], "force", 3.0),  # searched as a logarithm
        ("preload", ["ty"], "rest_shift", 2e-3),
        ("tilt", [], "slope_y", 0.02),
        ("slack", ["rx"], "half_width", 0.004),
    ],
)
def test_a_statement_is_turned_into_the_effect_of_that_size(effect, axes, parameter, size):
    statement = {"effect": effect, "axes": axes, "side": 0, "parameter": parameter, "from": size}
    placed, x = of_size(statement, STRAP, SCALES)
    named = placed.named(x)
    assert placed.effect.name == effect
    assert placed.axes == axes
    key = next(k for k in named if k.startswith(parameter))
    assert named[key][0] == pytest.approx(size)


def test_a_statement_of_no_place_is_an_error():
    statement = {"effect": "slack", "axes": ["ta"], "side": 0, "parameter": "half_width", "from": 1.0}
    with pytest.raises(ValueError, match="no place of slack"):
        of_size(statement, STRAP, SCALES)


def test_what_the_data_leave_of_a_prior_is_what_a_set_pays_for():
    problem = SimpleNamespace(
        free=np.arange(2),
        lower=np.array([-6.0, -50.0]),
        upper=np.array([6.0, 50.0]),
        prior_mean=np.zeros(2),
        prior_sd=np.array([np.inf, 2.0]),
    )

    def occam(known: float, z: float) -> float:
        # the second coordinate's prior is a row of the residuals
        jacobian = np.array([[known, 0.0], [0.0, 1 / 2.0]])
        return JointResiduals.occam_of(problem, np.array([0.0, z]), jacobian)

    # nothing is known of either but the priors
    assert occam(0.0, 0.0) == pytest.approx(0.0)
    # a coordinate between -6 and 6 that is known to 0.01: twice the logarithm of the share
    assert occam(100.0, 0.0) == pytest.approx(2 * np.log(12 / np.sqrt(12) / 0.01), abs=1e-3)
    # two prior SD away
    assert occam(0.0, 4.0) == pytest.approx(4.0)


def test_the_smallest_visible_size_is_where_it_is_sure_to_earn_what_it_needs():
    sizes = np.array([1.0, 2.0, 4.0, 8.0])
    needed = np.full(4, 400.0)
    # what is earned grows with the square of the size: 400 at a size of 2.828
    assert _crossed(sizes, 50.0 * sizes**2, needed) == pytest.approx(np.sqrt(8), rel=1e-6)
    assert _crossed(sizes, 5.0 * sizes**2, needed) is None
    assert _crossed(sizes, 500.0 * sizes**2, needed) == 1.0
    # from where on it stays visible: an effect that is swallowed in between is not
    assert _crossed(sizes, np.array([500.0, 300.0, 600.0, 600.0]), needed) == pytest.approx(
        2 * 2 ** (np.log(4 / 3) / np.log(2)), rel=1e-6
    )


def test_a_size_that_cannot_be_simulated_is_passed_over():
    sizes, needed = np.array([1.0, 2.0, 4.0, 8.0]), np.full(4, 400.0)
    earned = 50.0 * sizes**2
    # the line from 200 at a size of 2 to 3200 at a size of 8 crosses 400 where that from 200 to 800 would
    earned[2] = np.nan
    assert _crossed(sizes, earned, needed) == pytest.approx(np.sqrt(8), rel=1e-6)
    # one that is seen from the smallest simulated size on
    assert _crossed(sizes, np.array([np.nan, 500.0, 600.0, np.nan]), needed) == 2.0
    assert _crossed(sizes, np.array([5.0, 50.0, np.nan, np.nan]), needed) is None
    assert _crossed(sizes, np.full(4, np.nan), needed) is None


@pytest.mark.parametrize(("loudness", "expected"), [(3.0, 3.0), (0.5, 1.0)])
def test_what_an_effect_earns_scatters_as_simulated_noise_does_and_no_less_than_white_noise(
    loudness, expected
):
    trials, rng = object.__new__(_Trials), np.random.default_rng(1)
    noise = loudness * rng.standard_normal((4_000, 20))
    noise[0, 0] = np.nan
    # the same random numbers in both trials
    trials._noise = [noise, -noise]
    ways = [np.full(20, 2.0), np.full(20, 1.0)]
    assert trials._scatter(ways) == pytest.approx(2 * expected * np.sqrt(100.0), rel=0.05)


def _left(fitted, held_out, shown=1e9, step=0.0):
    return _Left((fitted, held_out), 10.0, shown, step)


def test_an_effect_is_seen_where_it_earns_enough_and_rises_above_quiet_noise():
    sure = 1.645 * 10
    told = SimpleNamespace(gain=368.0, hidden=-5.0)
    assert _left(200.0, 184.0 + sure).sure(16.0, told) == pytest.approx(1.0)
    # the plain fit leaves less than expected: 200 more are taken for noise
    quiet = SimpleNamespace(gain=368.0, hidden=200.0)
    assert _left(900.0, 900.0, shown=100.0 + sure).sure(16.0, quiet) == pytest.approx(0.5)


def test_a_sensor_that_is_quieter_than_expected_hides_what_an_effect_adds_to_it():
    trials = object.__new__(_Trials)
    sensors = SimpleNamespace(sensors={"markers": 1, "log": 1})
    trials._items, trials._noise = (sensors, sensors), [np.zeros((2, 4))] * 2
    trials._plain, trials._expected = np.array([100.0, 60.0]), (100, 100)
    trials._on_floor, trials._above = (False, True), 0.0
    # 25 of the markers and 25 of the log in each trial, of which the log is granted 40
    told = trials._told((np.tile([5.0, 5.0], 2)[:4] / np.sqrt(2),) * 2, np.array([0.1, -0.4]))
    assert told.by_trial == pytest.approx((50.0, 50.0))
    assert told.shown == pytest.approx(50.0 + 10.0)
    assert told.step == 0.4


def test_a_size_that_long_steps_of_the_plain_parameters_hide_is_enlarged_until_refits_leave_enough():
    placed, x = of_size(
        {"effect": "coulomb", "axes": ["tz"], "side": 0, "parameter": "force", "from": 1.0}, STRAP, SCALES
    )
    asked = []

    def refitted(placed, row):
        size = float(placed.values(row[None])[0, 0])
        asked.append(size)
        return _left(0.0, 100.0 * size**2 + 1.645 * 10)

    trials = SimpleNamespace(gain=400.0, hidden=0.0, refitted=refitted)
    size = _confirmed(placed, 0, x, 1.0, 50.0, trials)
    occam = _occam(placed, 0, np.log([[size / placed.values(np.zeros((1, 1)))[0, 0]]]), np.zeros(1))
    assert size == asked[-1]
    assert 2.0 <= size < 2.3
    assert 100 * size**2 >= 400 + occam[0]
    assert len(asked) < 6
    assert _confirmed(placed, 0, x, 1.0, 1.5, trials) is None
    assert _confirmed(placed, 0, x, 1.0, 50.0, SimpleNamespace(refitted=lambda *rest: None)) is None
