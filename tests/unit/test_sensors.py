"""A quiet sensor excuses nothing that another one leaves."""

from types import SimpleNamespace

import numpy as np
import pytest
from real2sim.diagnosis import trials
from real2sim.diagnosis.attribute import Attribution
from real2sim.diagnosis.decide import UNKNOWN, Candidate, decide, unexplained
from real2sim.diagnosis.refit import Hypothesis
from real2sim.diagnosis.search import Pair, Search, samples_by_sensor
from real2sim.diagnosis.sensors import above, are_on_floor, by_sensor

from tests.unit.simulated_effects import STRAP
from tests.unit.test_coupling import CONFIG

CALIBRATION = CONFIG["diagnosis"]["calibration"]
N = 3600
# Markers that leave 30 % more than noise, and a robot log that is far quieter than its floor
LOUD, QUIET = 1.3 * N, 0.2 * N


def _left(markers: float, robot: float) -> Hypothesis:
    total = markers + robot
    return Hypothesis((), np.zeros(12), (total, total), sensors=((markers, robot), (markers, robot)))


def _search(robot: float = QUIET) -> Search:
    """A search in two trials; noise leaves so much of the robot's log."""
    trial = SimpleNamespace(
        samples=2 * N,
        samples_by_sensor=(N, N),
        sensors={"markers": 6, "robot log": 6},
        noise_by_sensor=(0.97 * N, robot),
    )
    return Search(Pair(trial, trial, STRAP), CONFIG["diagnosis"]["search"])


def test_chi_squared_is_split_by_the_channels_of_each_sensor():
    rows = np.arange(12.0).reshape(2, 6)
    # two coefficients of three channels; the last channel is a sensor of its own
    np.testing.assert_array_equal(
        by_sensor(rows, (2, 1)), [[0 + 1 + 9 + 16, 4 + 25], [36 + 49 + 81 + 100, 64 + 121]]
    )
    np.testing.assert_allclose(by_sensor(rows, (3,))[:, 0], (rows**2).sum(axis=1))


def test_a_sensor_is_on_its_floor_where_noise_alone_leaves_less_than_chance_does():
    assert are_on_floor((970.0, 200.0), (1000, 1000), 4.0) == (False, True)
    assert _search().on_floor == (False, True)
    assert _search(robot=N).on_floor == (False, False)


def test_what_a_sensor_on_its_floor_leaves_below_its_expectation_counts_for_nothing():
    on_floor = (False, True)
    assert above((130.0, 20.0), (100, 100), on_floor) == 30
    assert above((130.0, 120.0), (100, 100), on_floor) == 50
    assert above((130.0, 110.0), (100, 100), on_floor, 0.2) == pytest.approx(10)
    assert above((90.0, 20.0), (100, 100), on_floor) == -10
    # noise of two sensors that are not on their floors averages out
    assert above((130.0, 80.0), (100, 100), (False, False)) == 10


def test_each_trial_counts_its_residuals_by_sensor():
    first, second = (SimpleNamespace(samples_by_sensor=counts) for counts in ((360, 240), (351, 240)))
    assert samples_by_sensor([first, second]) == ((360, 240), (351, 240))


def test_a_misfit_of_the_markers_does_not_hide_in_a_quiet_log():
    search, hidden = _search(), _left(LOUD, QUIET)
    assert sum(hidden.chi2) < sum(search.samples), "all together it is less than noise"
    assert not search.is_noise(hidden)
    assert search.excess(hidden) == pytest.approx(2 * 0.3 * N / np.sqrt(2 * 4 * N))
    assert search.beyond(hidden) == pytest.approx(2 * 0.3 * N)
    assert search.is_noise(_left(N, QUIET))
    # a log that is as loud as it was taken to be, and by chance leaves less
    assert _search(robot=N).is_noise(_left(1.05 * N, 0.95 * N))


def test_a_trial_without_a_log_can_stand_beside_one_with_it():
    with_log = SimpleNamespace(
        samples=2 * N,
        samples_by_sensor=(N, N),
        sensors={"markers": 6, "robot log": 6},
        noise_by_sensor=(N, QUIET),
    )
    without = SimpleNamespace(
        samples=N,
        samples_by_sensor=(N, 0),
        sensors={"markers": 6, "robot log": 0},
        noise_by_sensor=(N, 0.0),
    )
    search = Search(Pair(with_log, without, STRAP), CONFIG["diagnosis"]["search"])
    assert search.samples_by_sensor == ((N, N), (N, 0))
    assert search.on_floor == (False, True)
    np.testing.assert_array_equal(by_sensor(np.ones((1, 12)), (6, 0)), [[12, 0]])
    fit = Hypothesis((), np.zeros(12), (N + QUIET, LOUD), sensors=((N, QUIET), (LOUD, 0.0)))
    assert search.beyond(fit) == pytest.approx(0.3 * N)
    assert search.excess(fit) == pytest.approx(0.3 * N / np.sqrt(2 * 3 * N))


def _candidate(names: tuple[str, ...], markers: float, robot: float) -> Candidate:
    total = markers + robot
    sensors = ((2 * markers, 2 * N, False), (2 * robot, 2 * N, True))
    return Candidate(names, (total, total), sensors=sensors)


def test_unknown_asks_what_markers_leave_beside_a_quiet_log():
    plain, samples = _candidate((), 10.0 * N, QUIET), (2 * N, 2 * N)
    # 10 % beyond the allowance, of a gap of nine times noise
    best = _candidate(("coulomb",), LOUD, QUIET)
    assert unexplained(plain, [best], samples, CALIBRATION) == pytest.approx(0.1 / 9)
    worse = _candidate(("coulomb",), 3.0 * N, QUIET)
    loud, full = (
        decide(plain, [c], samples, CALIBRATION).probabilities[UNKNOWN]
        for c in (worse, _candidate(("coulomb",), N, QUIET))
    )
    assert full < 0.05 < 0.5 < loud
    # the same sum where the log may leave less than it should
    summed = [Candidate(c.names, c.chi2) for c in (plain, worse)]
    together = decide(summed[0], summed[1:], samples, CALIBRATION).probabilities[UNKNOWN]
    assert together < loud


def test_a_trial_whose_markers_are_not_explained_is_not_explained():
    plain = _left(10.0 * N, QUIET)
    for best, explained in ((_left(2.5 * N, QUIET), False), (_left(LOUD, QUIET), True)):
        found = trials.Found(_search().pair, Attribution(plain, [best], [], (2 * N, 2 * N), None))
        assert trials.explains_fitted(found, CONFIG["diagnosis"]) is explained
