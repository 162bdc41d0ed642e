"""From what sets of effects leave to probabilities and a verdict."""

from __future__ import annotations

import numpy as np
import pytest
from real2sim.diagnosis.attribute import is_makeshift
from real2sim.diagnosis.decide import (
    NONE,
    UNKNOWN,
    Candidate,
    averaged,
    decide,
    further_price,
    is_out_of_reach,
    next_trial,
    share_of_other,
    unexplained,
)
from real2sim.effects.catalogue import EFFECTS, Placed

from tests.unit.simulated_effects import SCALES, STRAP
from tests.unit.test_coupling import CONFIG

CALIBRATION = CONFIG["diagnosis"]["calibration"]
MOST_LAWS, LEAST = CALIBRATION["most_laws_of_axis"], CALIBRATION["ambiguity_probability"]
CERTAIN = CONFIG["diagnosis"]["report"]["next_trial_certain"]


def test_no_gap_is_none():
    plain = Candidate((), 0, (1000.0, 1000.0))
    other = Candidate(("slack",), 1, (990.0, 995.0))
    decision = decide(plain, [other], (1000, 1000), CALIBRATION)
    assert decision.verdict == NONE
    assert sum(decision.probabilities.values()) == pytest.approx(1)


def test_an_effect_that_explains_the_gap_is_named():
    plain = Candidate((), 0, (9000.0, 8000.0))
    sets = [Candidate(("slack",), 1, (1010.0, 1020.0)), Candidate(("stiffening",), 1, (4000.0, 5000.0))]
    decision = decide(plain, sets, (1000, 1000), CALIBRATION)
    assert decision.verdict == "slack"
    assert decision.probabilities["slack"] > 0.8


def test_a_gap_that_nothing_explains_is_unknown():
    plain = Candidate((), 0, (90000.0, 80000.0))
    sets = [Candidate(("slack",), 1, (70000.0, 65000.0))]
    decision = decide(plain, sets, (1000, 1000), CALIBRATION)
    assert decision.verdict == UNKNOWN


def test_one_cause_that_explains_most_is_named_and_several_that_explain_as_little_are_not():
    """Another law of a known cause leaves a seventh of the gap; causes outside the catalogue are nobody's."""
    plain = Candidate((), 0, (67_000.0, 162_000.0))
    friction = Candidate(("lugre",), 4, (19_000.0, 23_000.0))
    far = [Candidate((name,), 1, (50_000.0, 140_000.0)) for name in ("slack", "stiffening", "tilt")]
    alone = decide(plain, [friction, *far], (5000, 4400), CALIBRATION)
    assert alone.verdict == "lugre"
    assert 0.01 < alone.probabilities[UNKNOWN] < 0.35
    rivals = [Candidate((name,), 4, (49_000.0, 74_000.0)) for name in ("slack", "hysteresis", "tilt")]
    several = decide(plain, rivals, (5000, 4400), CALIBRATION)
    assert several.verdict == UNKNOWN
    # and the more of the same, the surer
    more = [
        Candidate((name,), 4, (49_000.0, 74_000.0)) for name in ("slack", "hysteresis", "tilt", "preload")
    ]
    assert decide(plain, more, (5000, 4400), CALIBRATION).probabilities[UNKNOWN] > 0.7


def test_a_cause_that_leaves_nearly_half_of_the_gap_is_unknown_however_far_it_is_ahead():
    """A hand on the robot, by somebody else: 18 numbers of a soft-tissue artefact took 54 % of it, 0.62."""
    plain = Candidate((), 0, (141_812.0, 471_278.0))
    other = Candidate(("cross_coupling",), 1, (138_439.0, 431_872.0))
    half = decide(
        plain, [Candidate(("soft_tissue",), 18, (113_068.0, 190_888.0)), other], (2880, 2880), CALIBRATION
    )
    assert half.verdict == UNKNOWN
    most = decide(
        plain, [Candidate(("soft_tissue",), 18, (18_000.0, 72_000.0)), other], (2880, 2880), CALIBRATION
    )
    assert most.verdict == "soft_tissue"


def test_noise_that_is_a_little_louder_than_measured_is_no_unknown_cause():
    plain = Candidate((), 0, (5193.0, 5550.0))
    sets = [Candidate((name,), 2, (5150.0, 5500.0)) for name in ("slack", "creep", "tilt")]
    assert unexplained(plain, sets, (4992, 4488), CALIBRATION) < 0.5
    assert decide(plain, sets, (4992, 4488), CALIBRATION).verdict == NONE


def test_fast_and_slow_relaxation_of_one_axis_are_a_cause_outside_the_catalogue():
    relaxation, creep = (next(e for e in EFFECTS if e.name == name) for name in ("relaxation", "creep"))
    fast, slow = (Placed(e, e.places(STRAP)[2], SCALES) for e in (relaxation, creep))
    elsewhere = Placed(creep, creep.places(STRAP)[1], SCALES)
    assert is_makeshift((slow, fast), leaves_noise=True, most_laws_of_axis=MOST_LAWS)
    assert not is_makeshift((fast, elsewhere), leaves_noise=False, most_laws_of_axis=MOST_LAWS)
    # two time constants are all there is to know where they leave nothing, and a spectrum where they do
    both = next(e for e in EFFECTS if (e.name, e.form) == ("relaxation", "_two_times"))
    two = Placed(both, both.places(STRAP)[2], SCALES)
    assert not is_makeshift((two,), leaves_noise=True, most_laws_of_axis=MOST_LAWS)
    assert is_makeshift((two,), leaves_noise=False, most_laws_of_axis=MOST_LAWS)
    plain = Candidate((), 0, (90_000.0, 95_000.0))
    sets = [
        Candidate(("relaxation",), 2, (20_000.0, 22_000.0)),
        Candidate(("relaxation", "creep"), 4, (2_800.0, 2_900.0), makeshift=True),
    ]
    decision = decide(plain, sets, (2880, 2880), CALIBRATION)
    assert decision.verdict == UNKNOWN
    assert decision.chosen is None
    assert sum(decision.probabilities.values()) == pytest.approx(1)


def test_three_laws_of_one_axis_are_a_cause_outside_the_catalogue():
    def placed(name: str, axis: int) -> Placed:
        effect = next(e for e in EFFECTS if e.name == name)
        return Placed(effect, next(w for w in effect.places(STRAP) if w.axes == (axis,)), SCALES)

    assert not is_makeshift(
        (placed("migration", 2), placed("joint_limit", 2)), leaves_noise=True, most_laws_of_axis=MOST_LAWS
    )
    assert is_makeshift(
        (placed("migration", 2), placed("joint_limit", 2), placed("coulomb", 2)),
        leaves_noise=True,
        most_laws_of_axis=MOST_LAWS,
    )
    assert not is_makeshift(
        (placed("migration", 2), placed("joint_limit", 2), placed("coulomb", 1)),
        leaves_noise=True,
        most_laws_of_axis=MOST_LAWS,
    )


def test_two_time_constants_share_with_what_is_unknown_unless_one_does_as_well():
    plain = Candidate((), 0, (90_000.0, 95_000.0))
    two = Candidate(("relaxation",), 4, (2_800.0, 2_900.0), doubtful=True)
    alone = decide(plain, [Candidate(("relaxation",), 2, (3_500.0, 3_900.0)), two], (2880, 2880), CALIBRATION)
    assert alone.verdict == "relaxation"
    assert alone.probabilities[UNKNOWN] == pytest.approx(CALIBRATION["doubtful"], abs=0.01)
    as_well = decide(
        plain, [Candidate(("relaxation",), 2, (2_802.0, 2_903.0)), two], (2880, 2880), CALIBRATION
    )
    assert as_well.probabilities["relaxation"] > 0.99
    assert sum(alone.probabilities.values()) == pytest.approx(1)


def test_what_the_answer_would_be_for_the_other_hold_shares_by_what_it_leaves():
    """A tilt of a robot let go and a robot at rest beside nothing, 60 of chi-squared apart: neither is certain."""
    plain = Candidate((), 0, (6_000.0, 6_000.0))
    let_go = decide(plain, [Candidate(("tilt",), 2, (2_787.0, 2_663.0))], (2880, 2880), CALIBRATION)
    quiet = Candidate((), 0, (2_827.0, 2_721.0))
    at_rest = decide(quiet, [Candidate(("tilt",), 2, (2_827.0, 2_721.0))], (2880, 2880), CALIBRATION)
    assert (let_go.verdict, at_rest.verdict) == ("tilt", NONE)
    mixed = averaged(
        at_rest, let_go, share_of_other((5_548.0, 5_608.0), CALIBRATION["none_temperature"]), LEAST
    )
    assert mixed.verdict == NONE
    assert mixed.group == (NONE, "tilt")
    assert mixed.probabilities["tilt"] == pytest.approx(1 / (1 + np.exp(60 / 80)), abs=0.01)
    assert sum(mixed.probabilities.values()) == pytest.approx(1)
    assert next_trial(mixed, CERTAIN) is not None
    far = averaged(
        at_rest, let_go, share_of_other((5_548.0, 9_608.0), CALIBRATION["none_temperature"]), LEAST
    )
    assert far.probabilities[NONE] == pytest.approx(at_rest.probabilities[NONE])
    assert far.group == (NONE,)


def test_samples_that_jump_are_a_second_cause_beside_any_gap():
    plain = Candidate((), 0, (200_000.0, 1_600_000.0))
    sets = [
        Candidate(("stiffening",), 2, (3_700.0, 5_900.0)),
        Candidate(("stiffening", "outliers"), 2, (2_850.0, 2_860.0)),
        Candidate(("stiffening", "preload"), 3, (2_850.0, 2_860.0)),
    ]
    with_jumps = decide(plain, sets, (2880, 2880), CALIBRATION)
    assert with_jumps.chosen == 1


def test_what_the_data_leave_in_the_running_is_the_ambiguity_group():
    plain = Candidate((), 0, (9000.0, 8000.0))
    sets = [Candidate((name,), 1, (1010.0, chi2)) for name, chi2 in (("lugre", 1020.0), ("coulomb", 1030.0))]
    decision = decide(plain, sets, (1000, 1000), CALIBRATION)
    assert decision.group == ("lugre", "coulomb")
    assert next_trial(decision, CERTAIN) is not None


def test_two_causes_that_are_sure_together_need_no_further_trial():
    plain = Candidate((), 0, (90000.0, 80000.0))
    sets = [
        Candidate(("slack", "tilt"), 3, (1010.0, 1020.0)),
        Candidate(("slack",), 1, (30000.0, 20000.0)),
        Candidate(("tilt",), 2, (70000.0, 50000.0)),
    ]
    decision = decide(plain, sets, (1000, 1000), CALIBRATION)
    assert decision.chosen == 0
    assert max(decision.probabilities.values()) < 0.9
    assert decision.group == (decision.verdict,)
    assert next_trial(decision, CERTAIN) is None


def test_a_set_shares_its_probability_by_what_each_effect_earns():
    plain = Candidate((), 0, (90000.0, 80000.0))
    sets = [
        Candidate(("tilt", "slack"), 3, (1010.0, 1020.0)),
        Candidate(("slack",), 1, (3000.0, 2000.0)),
        Candidate(("tilt",), 2, (70000.0, 50000.0)),
    ]
    decision = decide(plain, sets, (1000, 1000), CALIBRATION | {"second_effect": 100.0})
    assert decision.chosen == 0
    assert decision.verdict == "slack"
    # without slack 34495 + 48980 more are left, without tilt 995 + 980
    share = decision.probabilities["tilt"] / decision.probabilities["slack"]
    assert share == pytest.approx(1975 / 83475, rel=1e-6)


def test_a_gap_that_no_law_could_earn_its_price_with_leaves_none_unquestioned():
    samples = (2880, 2880)
    assert is_out_of_reach((3030.0, 2900.0), samples, CALIBRATION)
    assert not is_out_of_reach((3300.0, 3300.0), samples, CALIBRATION)
    # nor would the decision name a law that explained so little, all of it
    for left in ((3030.0, 2900.0), (2900.0, 3060.0)):
        assert is_out_of_reach(left, samples, CALIBRATION)
        law = Candidate(("coulomb",), 1, (2880.0, 2880.0))
        assert decide(Candidate((), 0, left), [law], samples, CALIBRATION).probabilities["coulomb"] < 0.05


def test_the_price_of_a_second_cause_grows_with_the_gap():
    none, gap = (further_price((2880.0 + x, 2880.0), (2880, 2880), CALIBRATION) for x in (-500.0, 1e6))
    assert none == CALIBRATION["second_effect"]
    assert gap == none + CALIBRATION["second_effect_share"] * 1e6


def test_near_the_price_of_a_cause_none_is_not_certain():
    sets = [Candidate(("creep",), 2, (1000.0, 1000.0))]

    def none(gain: float) -> float:
        plain = Candidate((), 0, (1000.0, 1000.0 + gain))
        return decide(plain, sets, (1000, 1000), CALIBRATION).probabilities["none"]

    price = CALIBRATION["none_gain"] + 2 * CALIBRATION["per_parameter"]
    assert none(price) == pytest.approx(0.5, abs=0.02)
    assert 0.6 < none(price - 100) < 0.95
    assert none(20.0) > 0.99
    assert none(2 * price) < 0.01


def test_jumps_need_no_more_than_their_own_price():
    plain = Candidate((), 0, (2880.0, 3080.0))
    sets = [Candidate(("outliers",), 0, (2880.0, 2830.0)), Candidate(("creep",), 2, (2880.0, 2830.0))]
    decision = decide(plain, sets, (2880, 2880), CALIBRATION)
    assert decision.verdict == "outliers"


def test_an_effect_of_many_forms_has_no_better_chance():
    plain = Candidate((), 0, (90_000.0, 90_000.0))
    sync = Candidate(("sync_offset",), 1, (2372.0, 2316.0))
    filters = [Candidate(("filter_lag",), 1, (2372.0, 2317.0 + i)) for i in range(3)]
    decision = decide(plain, [*filters, sync], (2880, 2880), CALIBRATION)
    assert decision.verdict == "sync_offset"
    one = decide(plain, [filters[0], sync], (2880, 2880), CALIBRATION)
    assert decision.probabilities["filter_lag"] == pytest.approx(one.probabilities["filter_lag"], rel=1e-6)


def test_the_same_effects_in_another_order_are_one_answer_and_a_makeshift_is_another():
    plain = Candidate((), 0, (90_000.0, 90_000.0))
    pair = [
        Candidate(("slack", "tilt"), 3, (2880.0, 2885.0)),
        Candidate(("tilt", "slack"), 3, (2880.0, 2886.0)),
    ]
    rival = Candidate(("slack", "preload"), 3, (2880.0, 2885.5))
    alone = decide(plain, [pair[0], rival], (2880, 2880), CALIBRATION)
    decision = decide(plain, [*pair, rival], (2880, 2880), CALIBRATION)
    assert decision.sets[:2].sum() == pytest.approx(alone.sets[0], rel=1e-9)
    assert decision.chosen == 0
    assert decision.sets[2] > decision.sets[0]
    spectrum = Candidate(("relaxation", "creep"), 4, (2880.0, 2880.0), makeshift=True)
    elsewhere = Candidate(("relaxation", "creep"), 4, (2880.0, 2880.0))
    other = Candidate(("slack", "preload"), 4, (2880.0, 2880.0))
    three = decide(plain, [spectrum, elsewhere, other], (2880, 2880), CALIBRATION)
    assert three.probabilities[UNKNOWN] == pytest.approx(1 / 3, abs=0.01)


def test_the_verdict_is_the_likeliest_effect_whatever_is_beside_it():
    plain = Candidate((), 0, (100_000.0, 100_000.0))
    candidates = [
        Candidate(("sync_offset",), 1, (2900.0, 2950.0)),
        Candidate(("filter_lag",), 1, (2900.0, 2953.0)),
        Candidate(("filter_lag", "outliers"), 1, (2900.0, 2865.0)),
    ]
    decision = decide(plain, candidates, (2880, 2880), CALIBRATION)
    assert decision.sets[0] > decision.sets[1] > decision.sets[2] > 0.1
    assert max(decision.probabilities, key=lambda name: decision.probabilities[name]) == "filter_lag"
    assert decision.verdict == "filter_lag"
    assert decision.chosen == 1


def test_an_effect_on_two_axes_has_one_share_and_no_credit_goes_to_a_form_elsewhere():
    plain = Candidate((), 0, (50_000.0, 50_000.0))
    both = Candidate(
        ("relaxation", "slack"),
        5,
        (1_000.0, 1_000.0),
        places=(("relaxation tx", "relaxation ty"), ("slack rz",)),
    )
    here = Candidate(("relaxation",), 4, (9_000.0, 9_000.0), places=(("relaxation tx", "relaxation ty"),))
    # the same name somewhere else explains nearly all: it is another law, and takes nothing from slack's share
    elsewhere = Candidate(("relaxation",), 2, (1_900.0, 1_900.0), places=(("relaxation rx",),))
    slack = Candidate(("slack",), 1, (30_000.0, 30_000.0), places=(("slack rz",),))
    found = decide(plain, [both, here, elsewhere, slack], (1000, 1000), CALIBRATION)
    assert found.chosen == 0
    shares = [found.probabilities[name] for name in ("relaxation", "slack")]
    assert shares[0] > shares[1] > 0.15
    unplaced = [Candidate(c.names, c.parameters, c.chi2) for c in (both, here, elsewhere, slack)]
    assert decide(plain, unplaced, (1000, 1000), CALIBRATION).probabilities["slack"] < 0.1
