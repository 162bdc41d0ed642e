"""A robot that had come to rest before the record begins, and one that is let go at its start pose."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import mujoco
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from real2sim.diagnosis import answer, trials
from real2sim.diagnosis.attribute import Attribution
from real2sim.diagnosis.decide import Candidate, cost_of_answer, further_price
from real2sim.diagnosis.refit import Hypothesis
from real2sim.diagnosis.search import Pair, Search
from real2sim.effects.catalogue import EFFECTS, Placed
from real2sim.errors import InputError
from real2sim.recording.noise import hold_uncertainty
from real2sim.study import strap_evidence
from real2sim.system.plant import impedances

from tests.unit.simulated_effects import LEVEL, SCALES, STRAP, replay
from tests.unit.test_coupling import CONFIG, PRIOR, ROBOT

RESTING = (
    "",
    "slack",
    "one_sided",
    "relaxation",
    "misalignment",
    "tilt",
    "preload",
    "base_compliance series",
)


@pytest.mark.parametrize("key", RESTING)
def test_a_robot_at_rest_against_its_controller_stays_where_it_is(key):
    """Where a person stands off the rest pose, a controller that holds at the start would let the robot go there."""
    pose = np.eye(3), LEVEL[1] + np.array([0.004, -0.003, 0.002])
    name, _, form = key.partition(" ")
    law = [e for e in EFFECTS if e.name == name and e.form.strip("_") == form][:1]
    placed = [Placed(e, e.places(STRAP)[0], SCALES) for e in law]
    x = [np.tile(p.starts()[-1], (2, 1)) for p in placed]
    drift = []
    for settled in (False, True):
        model = replay(placed, nsim=2, seen=pose, settled=settled)
        _, joints = model.run_effects(np.stack([PRIOR, 1.5 * PRIOR]), x)
        quiet = 15  # samples before the pelvis has moved
        drift.append(np.abs(joints[:, quiet] - joints[:, 0]).max(axis=1))
    assert (drift[1] < 0.1 * drift[0]).all()


def test_where_a_settled_robot_holds_is_kept_from_one_call_to_the_next():
    """Neither what was asked before nor how many go together changes an answer."""
    pose = np.eye(3), LEVEL[1] + np.array([0.004, -0.003, 0.002])
    placed = Placed(strap_evidence._START, strap_evidence._START.place(STRAP), SCALES)
    x = np.zeros((2, 6))
    x[1] = [2e-3, -1e-3, 3e-3, 0.0, 0.0, 0.004]
    two = np.stack([PRIOR, 1.5 * PRIOR])
    model = replay([placed], nsim=2, seen=pose, settled=True)
    both, _ = model.run_effects(two, [x])
    for k in (1, 0):
        alone, _ = model.run_effects(two[k : k + 1], [x[k : k + 1]])
        np.testing.assert_array_equal(alone[0], both[k])


def test_a_robot_at_rest_may_hold_beside_the_balance(tmp_path):
    """A person who swayed was never in balance: two nulls of a stranger's left 3 000 and 800 more than noise."""
    pose = np.eye(3), LEVEL[1] + np.array([0.004, -0.003, 0.002])
    model = replay([], nsim=2, seen=pose, settled=True)
    shift = np.array([3e-3, 0.0, 0.0, 0.0, 0.0, 0.0])
    model.hold_beside(np.stack([np.zeros(6), shift]), np.zeros((2, 6)))
    _, joints = model.run_effects(np.stack([PRIOR, PRIOR]), [])
    hold = CONFIG["robot"]["hold"]["x"]["stiffness"]
    moved = joints[1, -1] - joints[0, -1]
    # the strap holds against the controller
    assert moved[0] == pytest.approx(shift[0] * hold / (hold + PRIOR[0]), rel=0.3)
    model.hold_beside(np.zeros((2, 6)), np.zeros((2, 6)))
    _, again = model.run_effects(np.stack([PRIOR, PRIOR]), [])
    np.testing.assert_array_equal(again[0], joints[0])
    np.testing.assert_array_equal(again[1], again[0])


def test_a_robot_that_sways_with_the_person_has_a_rate_at_the_start():
    """A stranger's robot went at 11 mm/s where the record began: a null left 890 more than noise."""
    model = replay([], nsim=2, seen=(np.eye(3), LEVEL[1]), settled=True)
    rate = np.array([0.011, 0.0, 0.0, 0.004, 0.0, 0.0])
    model.hold_beside(np.zeros((2, 6)), np.stack([np.zeros(6), rate]))
    paths, joints = model.run_effects(np.stack([PRIOR, PRIOR]), [])
    h, moved = 0.01, joints[1] - joints[0]
    np.testing.assert_allclose(moved[1] / h, rate, atol=1.5e-3)
    # the pelvis stays on its path: what the robot does the strap gives way to
    assert np.abs(paths[1, 1] - paths[0, 1]).max() < 2 * h * rate[0]


def test_how_far_a_swaying_person_keeps_the_robot_from_balance(tmp_path):
    time = np.arange(0, 40, 0.01)
    columns = {f"interface_{c}": np.zeros(len(time)) for c in "yz"} | {
        "interface_x": 2e-3 * np.sin(2 * np.pi * 0.1 * time),
        "interface_qw": np.ones(len(time)),
        **{f"interface_q{c}": np.zeros(len(time)) for c in "xyz"},
    }
    pq.write_table(pa.table(columns), tmp_path / "pose.parquet")
    held = impedances(CONFIG["robot"], "hold")
    robot = mujoco.MjModel.from_xml_path(str(ROBOT))
    still = columns | {"interface_x": np.zeros(len(time))}
    pq.write_table(pa.table(still), tmp_path / "still.parquet")
    pq.write_table(pa.table(still | {"interface_z": 0.02 * time}), tmp_path / "rising.parquet")
    swaying, standing, rising = (tmp_path / f"{name}.parquet" for name in ("pose", "still", "rising"))
    beside, rate = hold_uncertainty(swaying, standing, 50, 100, robot, held)
    speed = 2e-3 * 2 * np.pi * 0.1 / np.sqrt(2)
    x = held["base_x"]
    assert beside[0] == pytest.approx(x["damping"] * speed / x["stiffness"], rel=0.1)
    assert rate[0] == pytest.approx(speed, rel=0.1)
    np.testing.assert_allclose([beside[1:], rate[1:]], 0, atol=1e-9)
    # as fast as the trial itself begins, where that is faster than anything in quiet standing
    beside, rate = hold_uncertainty(standing, rising, 50, 100, robot, held)
    np.testing.assert_allclose(rate, [0, 0, 0, 0.02, 0, 0], atol=1e-9)
    np.testing.assert_allclose(beside, 0, atol=1e-9)
    # a joint that no spring holds has no set-point to be beside
    free = held | {"base_x": x | {"stiffness": 0}}
    np.testing.assert_array_equal(hold_uncertainty(swaying, standing, 50, 100, robot, free)[0][0], 0)


@pytest.mark.parametrize(
    ("left", "then", "standing", "at_rest", "settled"),
    [
        (3000.0, 100.0, 1.0, 1.0, True),  # a robot that came to rest, and no other cause
        (3000.0, 2400.0, 1.0, 1.0, False),  # something else leaves most of it
        (90.0, 0.0, 1.0, 1.0, False),  # nothing to explain
        (3e5, 2.9e5, 3.0, 1.2, True),  # another cause leaves most, but not while the person stands
        (3e5, 2.9e5, 3.0, 2.5, False),  # a tilt, say: the robot was not at rest
        (3e5, 2.9e5, 1.2, 0.6, False),  # noise does as much
    ],
)
def test_a_robot_at_rest_is_searched_for_where_it_explains_all_or_how_people_stand(
    monkeypatch, left, then, standing, at_rest, settled
):
    class Trial(SimpleNamespace):
        def standing(self, error):
            # draws of noise, or what is left
            return np.array([0.7, 1.1, 1.3]) if error is self.noise else np.full(1, error)

        def as_settled(self):
            return Trial(**(vars(self) | {"settled": True}))

    items = [
        Trial(
            samples=2880,
            samples_by_sensor=(2880,),
            noise_by_sensor=(2880.0,),
            settled=False,
            noise=np.zeros(3),
        )
        for _ in range(2)
    ]
    pair = Pair(*items, system=None)

    def fit(self, effects, start):
        return Hypothesis((), start, (2880 + then / 2, 2880 + then / 2))

    class Residuals:
        def __init__(self, evidence, effects, system):
            self.raw = lambda z: at_rest if evidence.settled else standing

    monkeypatch.setattr(Search, "fit", fit)
    monkeypatch.setattr(trials, "JointResiduals", Residuals)
    plain = Hypothesis((), np.zeros(12), (2880 + left / 2, 2880 + left / 2))
    assert trials.looks_settled(pair, plain, CONFIG["diagnosis"]) is settled
    assert not any(e.settled for e in items)


def _pair(samples: int, log_determinant: float = 0.0, *, settled: bool) -> SimpleNamespace:
    """Two trials of so many residuals, whose noise has a log-determinant each."""
    trial = SimpleNamespace(settled=settled, log_determinant=log_determinant)
    by_sensor = ((samples,), (samples,))
    return SimpleNamespace(
        train=trial, held_out=trial, samples_by_sensor=by_sensor, on_floor=lambda sd: (False,)
    )


@pytest.mark.parametrize(
    ("said", "looks", "left", "holds", "other"),
    [
        ("auto", True, 2900.0, True, False),
        ("auto", True, 9000.0, False, True),
        ("auto", False, 0.0, False, None),
        ("start pose", True, 0.0, False, None),  # the lab knows
        ("balance", False, 9000.0, True, None),
    ],
)
def test_a_robot_at_rest_is_believed_where_it_leaves_less(monkeypatch, said, looks, left, holds, other):
    def search_pair(trials, *, settled=False, complete=None):
        chi2 = (left if settled else 4000.0,) * 2
        found = Attribution(Hypothesis((), np.zeros(12), chi2), [], [], (2880, 2880), None)
        return trials_module.Found(_pair(2880, settled=settled), found)

    trials_module = trials
    monkeypatch.setattr(trials, "search_pair", search_pair)
    monkeypatch.setattr(trials.Found, "fit_rivals_to_both", lambda *given: None)
    monkeypatch.setattr(trials, "looks_settled", lambda *about: looks)
    options = CONFIG["diagnosis"] | {"robot_holds": said}
    two = trials.Trials("dynamic_1", "dynamic_2", None, None, options, lambda text: None)
    found, rest = trials.search_initial_states(two)
    assert found.pair.train.settled is holds
    assert (rest.pair.train.settled if rest else None) is other


@pytest.mark.parametrize(("larger_by", "holds"), [(40.0, True), (60.0, False)])
def test_noise_that_a_robot_at_rest_adds_counts_against_it(monkeypatch, larger_by, holds):
    """Chi-squared in units of a louder noise is smaller, whatever explains the recordings."""

    def search_pair(of, *, settled=False, complete=None):
        plain = Hypothesis(
            (), np.zeros(12), (2900.0, 2900.0) if settled else (2950.0, 2950.0), converged=True
        )
        pair = _pair(2880, larger_by if settled else 0.0, settled=settled)
        return trials.Found(pair, Attribution(plain, [], [], (2880, 2880), None))

    monkeypatch.setattr(trials, "search_pair", search_pair)
    monkeypatch.setattr(trials.Found, "fit_rivals_to_both", lambda *given: None)
    monkeypatch.setattr(trials, "looks_settled", lambda *about: True)
    two = trials.Trials("dynamic_1", "dynamic_2", None, None, CONFIG["diagnosis"], lambda text: None)
    found, _ = trials.search_initial_states(two)
    assert found.pair.train.settled is holds


def test_the_initial_state_is_chosen_by_sets_that_have_converged(monkeypatch):
    """Friction whose refit was cut short left more than a tilted floor, and less once it was refitted to the end."""
    cut_short, tilt = (3750.0, 3760.0), (3650.0, 3700.0)
    places = {e.name: Placed(e, e.places(STRAP)[0], SCALES) for e in EFFECTS if not e.form}

    def search_pair(of, *, settled=False, complete=None):
        name, chi2 = ("coulomb", cut_short) if settled else ("tilt", tilt)
        own = places[name]
        h = Hypothesis((own,), np.concatenate([np.zeros(12), own.starts()[0]]), chi2)
        plain = Hypothesis((), np.zeros(12), (9000.0, 9000.0), converged=True)
        return trials.Found(_pair(3600, settled=settled), Attribution(plain, [h], [], (3600, 3600), None))

    def finished(pair, hypothesis, settings):
        chi2 = (3640.0, 3600.0) if hypothesis.names == ("coulomb",) else hypothesis.chi2
        return replace(hypothesis, chi2=chi2, converged=True)

    monkeypatch.setattr(trials, "search_pair", search_pair)
    monkeypatch.setattr(trials.Found, "fit_rivals_to_both", lambda *given: None)
    monkeypatch.setattr(trials, "looks_settled", lambda *about: True)
    monkeypatch.setattr(trials, "finished", finished)
    two = trials.Trials("dynamic_1", "dynamic_2", None, None, CONFIG["diagnosis"], lambda text: None)
    outcome = trials.search_both_ways(two)
    assert outcome.found.pair.train.settled
    assert outcome.decision.verdict == "coulomb"
    assert not outcome.other.pair.train.settled


@pytest.mark.parametrize("code", ["not_simulated", "no_data"])
def test_a_second_search_that_cannot_be_simulated_leaves_the_first_one_standing(monkeypatch, code):
    released = SimpleNamespace(pair=None, attribution=SimpleNamespace(plain=None, hypotheses=[]))
    told = []

    def search_pair(of, *, settled=False, complete=None):
        if settled:
            raise InputError("dynamic_2", "", "a simulation that fails", "one that ends", "correct it", code)
        return released

    monkeypatch.setattr(trials, "search_pair", search_pair)
    monkeypatch.setattr(trials.Found, "fit_rivals_to_both", lambda *given: None)
    monkeypatch.setattr(trials, "looks_settled", lambda *about: True)
    two = trials.Trials("dynamic_1", "dynamic_2", None, None, CONFIG["diagnosis"], told.append)
    if code != "not_simulated":
        with pytest.raises(InputError):
            trials.search_initial_states(two)
        return
    assert trials.search_initial_states(two) == (released, None)
    assert "a simulation that fails" in told[-1]


def test_of_two_searches_the_one_is_taken_whose_answer_leaves_less_for_its_price():
    def cost(plain, *sets):
        return cost_of_answer(plain, sets, (2880, 2880), CONFIG["diagnosis"]["calibration"])

    loud, quiet = Candidate((), (9000.0, 9000.0)), Candidate((), (2700.0, 2800.0))
    # a preload that was let go leaves less than a robot at rest without it, though less than a law must earn there
    preload = Candidate(("preload",), (2600.0, 2700.0))
    assert cost(quiet, preload) == cost(quiet) == 5500
    assert cost(loud, preload) < cost(quiet, preload)
    # two laws that imitate a robot at rest leave as much as it does with one
    both = Candidate(("relaxation", "tilt"), (2650.0, 2950.0))
    one = Candidate(("relaxation",), (2700.0, 3000.0))
    assert cost(loud, one) < cost(loud, both)
    # what nothing explains counts by what comes nearest
    assert cost(loud, Candidate(("tilt",), (8000.0, 8000.0))) == pytest.approx(
        16_000 + further_price(CONFIG["diagnosis"]["calibration"])
    )


def test_a_cause_has_the_values_of_the_initial_state_that_contributes_most_of_it():
    def cause(effect, probability, value):
        return answer.Cause(effect, probability, [], "robot", "", [], "", {"x": {"value": value}})

    own = [cause("creep", 0.1, 1), cause("tilt", 0.3, 2)]
    theirs = [cause("tilt", 1.0, 3), cause("creep", 0.0, 4)]
    both = answer._of_both_states(
        own, theirs, {"tilt": True, "creep": False}, {"tilt": 0.3, "creep": 0.1}, "start pose"
    )
    assert both == [replace(cause("tilt", 0.3, 3), robot_holds="start pose"), own[0]]
    assert both[0].to_dict()["robot_holds"] == "start pose"
    assert "robot_holds" not in both[1].to_dict()
