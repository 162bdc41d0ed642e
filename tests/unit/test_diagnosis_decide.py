"""From what sets of effects leave to probabilities and a verdict."""

from __future__ import annotations

import numpy as np
import pytest
from real2sim.diagnosis.decide import (
    NONE,
    UNKNOWN,
    Candidate,
    Decision,
    averaged,
    decide,
    further_price,
    gain_of_a_law,
    is_out_of_reach,
    next_trial,
    share_of_other,
    shares_of,
    unexplained,
)
from real2sim.effects.catalogue import EFFECT_NAMES

from tests.unit.test_coupling import CONFIG

CALIBRATION = CONFIG["diagnosis"]["calibration"]
LEAST = CALIBRATION["ambiguity_probability"]
CERTAIN = CONFIG["diagnosis"]["report"]["next_trial_certain"]


def test_no_gap_is_none():
    plain = Candidate((), (1000.0, 1000.0))
    other = Candidate(("slack",), (990.0, 995.0))
    decision = decide(plain, [other], (1000, 1000), CALIBRATION)
    assert decision.verdict == NONE
    assert sum(decision.probabilities.values()) == pytest.approx(1)


def test_an_effect_that_explains_the_gap_is_named():
    plain = Candidate((), (9000.0, 8000.0))
    sets = [Candidate(("slack",), (1010.0, 1020.0)), Candidate(("stiffening",), (4000.0, 5000.0))]
    decision = decide(plain, sets, (1000, 1000), CALIBRATION)
    assert decision.verdict == "slack"
    assert decision.probabilities["slack"] > 0.8


def test_a_gap_that_nothing_explains_is_unknown():
    plain = Candidate((), (90000.0, 80000.0))
    sets = [Candidate(("slack",), (70000.0, 65000.0))]
    decision = decide(plain, sets, (1000, 1000), CALIBRATION)
    assert decision.verdict == UNKNOWN


def test_a_cause_is_the_less_certain_the_more_it_leaves():
    plain = Candidate((), (67_000.0, 162_000.0))

    def unknown(share: float) -> float:
        left = tuple(2880 + share * (chi2 - 2880) for chi2 in plain.chi2)
        found = decide(plain, [Candidate(("lugre",), left)], (2880, 2880), CALIBRATION)
        assert found.probabilities["lugre"] + found.probabilities[UNKNOWN] == pytest.approx(1)
        return found.probabilities[UNKNOWN]

    assert unknown(0.0) == pytest.approx(CALIBRATION["unlisted_odds"] / (1 + CALIBRATION["unlisted_odds"]))
    assert unknown(0.02) < 0.2 < 0.5 < unknown(0.25) < unknown(0.5)


def test_many_effects_that_explain_a_part_are_no_reason_to_believe_in_one_of_them():
    plain = Candidate((), (67_000.0, 162_000.0))
    rivals = [Candidate((name,), (49_000.0, 74_000.0)) for name in ("slack", "hysteresis", "tilt", "preload")]
    one, four = (decide(plain, rivals[:n], (5000, 4400), CALIBRATION).probabilities for n in (1, 4))
    assert four[UNKNOWN] == pytest.approx(one[UNKNOWN], rel=1e-3)
    assert four[UNKNOWN] > 0.9


def test_noise_that_is_a_little_louder_than_measured_is_no_unknown_cause():
    plain = Candidate((), (5193.0, 5550.0))
    sets = [Candidate((name,), (5150.0, 5500.0)) for name in ("slack", "creep", "tilt")]
    assert unexplained(plain, sets, (4992, 4488), CALIBRATION) < 0.5
    assert decide(plain, sets, (4992, 4488), CALIBRATION).verdict == NONE


def test_a_measured_law_that_leaves_less_than_every_name_is_an_unknown_cause():
    plain = Candidate((), (90_000.0, 95_000.0))
    sets = [
        Candidate(("relaxation",), (20_000.0, 22_000.0)),
        Candidate(("memory ty",), (2_800.0, 2_900.0), occam=60.0, unlisted=True),
    ]
    decision = decide(plain, sets, (2880, 2880), CALIBRATION)
    assert decision.verdict == UNKNOWN
    assert decision.chosen is None
    assert sum(decision.probabilities.values()) == pytest.approx(1)
    # one that leaves as much as a name loses by what it could have been
    alike = [
        Candidate(("relaxation",), (2_800.0, 2_900.0), occam=20.0),
        Candidate(("memory ty",), (2_800.0, 2_900.0), occam=160.0, unlisted=True),
    ]
    assert decide(plain, alike, (2880, 2880), CALIBRATION).verdict == "relaxation"


@pytest.mark.parametrize("occam", [100.0, 1_000.0, 3_000.0])
def test_a_law_that_loses_by_evidence_makes_no_name_surer(occam):
    """It leaves nothing, with so much freedom that this says little: what the names leave is left all the same."""
    plain, name = Candidate((), (13_000.0, 13_000.0)), Candidate(("slack",), (3_900.0, 3_900.0))
    law = Candidate(("external force",), (2_900.0, 2_900.0), occam, unlisted=True)
    alone = decide(plain, [name], (2880, 2880), CALIBRATION)
    beside = decide(plain, [name, law], (2880, 2880), CALIBRATION)
    assert alone.probabilities[UNKNOWN] <= beside.probabilities[UNKNOWN] + 1e-9
    assert sum(beside.probabilities.values()) == pytest.approx(1)


@pytest.mark.parametrize("occam", [2_000.0, 4_000.0])
def test_a_law_that_loses_by_evidence_tells_no_names_apart(occam):
    """Where even the best name leaves much, 150 between two of them mean little, law or no law."""
    plain, samples = Candidate((), (57_200.0, 57_200.0)), (7_200, 7_200)
    names = [
        Candidate(("slack",), (10_640.0, 10_640.0)),
        Candidate(("coulomb",), (10_715.0, 10_715.0)),
    ]
    law = Candidate(("external force",), (7_300.0, 7_300.0), occam + 6_680.0, unlisted=True)
    alone = decide(plain, names, samples, CALIBRATION).probabilities
    beside = decide(plain, [*names, law], samples, CALIBRATION).probabilities
    assert alone["coulomb"] > 0.2
    for name in ("slack", "coulomb"):
        assert beside[name] <= alone[name] + 1e-9
        assert beside[name] == pytest.approx(alone[name], abs=0.05)


def test_measured_laws_share_what_is_unknown_by_their_evidence():
    good = Candidate(("memory ty",), (2_800.0, 2_900.0), occam=60.0, unlisted=True)
    alike = Candidate(("elastic ty",), (2_805.0, 2_905.0), occam=60.0, unlisted=True)
    worse = Candidate(("external base_x",), (5_800.0, 6_900.0), occam=60.0, unlisted=True)
    shares = shares_of([worse, good, alike], (2880, 2880), CALIBRATION)
    assert shares.sum() == pytest.approx(1)
    assert shares[1] > shares[2] > 0.3
    assert shares[0] < 1e-6


def test_an_effect_that_could_have_been_more_things_pays_for_it():
    plain = Candidate((), (9000.0, 8000.0))
    sets = [
        Candidate(("slack",), (1010.0, 1020.0), occam=10.0),
        Candidate(("soft_tissue",), (1005.0, 1010.0), occam=180.0),
    ]
    assert decide(plain, sets, (1000, 1000), CALIBRATION).verdict == "slack"


def test_two_time_constants_share_with_what_is_unknown_unless_one_does_as_well():
    plain = Candidate((), (90_000.0, 95_000.0))
    two = Candidate(("relaxation",), (2_800.0, 2_900.0), 20.0, ambiguous=True)
    alone = decide(plain, [Candidate(("relaxation",), (3_500.0, 3_900.0)), two], (2880, 2880), CALIBRATION)
    assert alone.verdict == "relaxation"
    assert alone.probabilities[UNKNOWN] == pytest.approx(CALIBRATION["ambiguous_share"], abs=0.02)
    as_well = decide(
        plain, [Candidate(("relaxation",), (2_802.0, 2_903.0), 10.0), two], (2880, 2880), CALIBRATION
    )
    assert as_well.probabilities["relaxation"] > 0.97
    assert sum(alone.probabilities.values()) == pytest.approx(1)


def test_what_the_answer_would_be_for_the_other_hold_shares_by_what_it_leaves():
    """A tilt of a robot let go and a robot at rest beside nothing, 20 of deviance apart: neither is certain."""
    plain = Candidate((), (6_000.0, 6_000.0))
    let_go = decide(plain, [Candidate(("tilt",), (2_787.0, 2_663.0))], (2880, 2880), CALIBRATION)
    quiet = Candidate((), (2_827.0, 2_721.0))
    at_rest = decide(quiet, [Candidate(("tilt",), (2_827.0, 2_721.0))], (2880, 2880), CALIBRATION)
    assert (let_go.verdict, at_rest.verdict) == ("tilt", NONE)
    mixed = averaged(at_rest, let_go, share_of_other((5_548.0, 5_568.0), 0.0, CALIBRATION), LEAST)
    assert mixed.verdict == NONE
    assert mixed.group == (NONE, "tilt")
    other = share_of_other((5_548.0, 5_568.0), 0.0, CALIBRATION)
    assert mixed.probabilities["tilt"] == pytest.approx(other * let_go.probabilities["tilt"], abs=1e-3)
    assert 0.1 < other < 0.5
    assert sum(mixed.probabilities.values()) == pytest.approx(1)
    assert next_trial(mixed, CERTAIN, LEAST) is not None
    far = averaged(at_rest, let_go, share_of_other((5_548.0, 19_608.0), 0.0, CALIBRATION), LEAST)
    assert far.probabilities[NONE] == pytest.approx(at_rest.probabilities[NONE])
    assert far.group == (NONE,)


def test_companions_of_the_verdict_are_no_rivals_of_it():
    """Two effects that act together, under either initial state: neither is mistaken for the other."""
    plain = Candidate((), (60_000.0, 60_000.0))
    together = Candidate(("slack", "coulomb"), (2_900.0, 2_900.0))
    alone = [Candidate(("slack",), (20_000.0, 20_000.0)), Candidate(("coulomb",), (30_000.0, 30_000.0))]
    decision = decide(plain, [together, *alone], (2880, 2880), CALIBRATION)
    assert decision.chosen == 0
    assert min(decision.probabilities[n] for n in together.names) > LEAST
    assert averaged(decision, decision, 0.3, LEAST, together.names).group == decision.group


def test_samples_that_jump_are_a_second_cause_beside_any_gap():
    plain = Candidate((), (200_000.0, 1_600_000.0))
    sets = [
        Candidate(("stiffening",), (3_700.0, 5_900.0)),
        Candidate(("stiffening", "outliers"), (2_850.0, 2_860.0)),
        Candidate(("stiffening", "preload"), (2_850.0, 2_860.0), occam=10.0),
    ]
    with_jumps = decide(plain, sets, (2880, 2880), CALIBRATION)
    assert with_jumps.chosen == 1


def test_what_the_data_leave_in_the_running_is_the_ambiguity_group():
    plain = Candidate((), (9000.0, 8000.0))
    sets = [Candidate((name,), (1010.0, chi2)) for name, chi2 in (("lugre", 1020.0), ("coulomb", 1030.0))]
    decision = decide(plain, sets, (1000, 1000), CALIBRATION)
    assert decision.group == ("lugre", "coulomb")
    assert next_trial(decision, CERTAIN, LEAST) is not None


def test_the_next_trial_of_an_unknown_cause_without_a_lead_is_no_unlikely_effects_own():
    names = dict.fromkeys(EFFECT_NAMES, 0.0)
    for likely, own in ((0.001, False), (0.2, True)):
        probabilities = names | {"outliers": likely, NONE: 0.0, UNKNOWN: 1 - likely}
        told = next_trial(Decision(probabilities, np.zeros(0), UNKNOWN, (UNKNOWN,), None), CERTAIN, LEAST)
        assert ("labelled" in told) is own


def test_two_causes_that_are_sure_together_need_no_further_trial():
    plain = Candidate((), (90000.0, 80000.0))
    sets = [
        Candidate(("slack", "tilt"), (1010.0, 1020.0)),
        Candidate(("slack",), (30000.0, 20000.0)),
        Candidate(("tilt",), (70000.0, 50000.0)),
    ]
    decision = decide(plain, sets, (1000, 1000), CALIBRATION)
    assert decision.chosen == 0
    assert max(decision.probabilities.values()) < 0.9
    assert decision.group == (decision.verdict,)
    assert next_trial(decision, CERTAIN, LEAST) is None


def test_a_set_shares_its_probability_by_what_each_effect_earns():
    plain = Candidate((), (90000.0, 80000.0))
    sets = [
        Candidate(("tilt", "slack"), (1010.0, 1020.0)),
        Candidate(("slack",), (3000.0, 2000.0)),
        Candidate(("tilt",), (70000.0, 50000.0)),
    ]
    decision = decide(plain, sets, (1000, 1000), CALIBRATION)
    assert decision.chosen == 0
    assert decision.verdict == "slack"
    # without slack 68990 + 48980 more are left, without tilt 1990 + 980
    share = decision.probabilities["tilt"] / decision.probabilities["slack"]
    assert share == pytest.approx(2970 / 117970, rel=1e-6)


def test_a_gap_that_no_law_could_earn_its_place_with_leaves_none_unquestioned():
    samples, least = (2880, 2880), 0.05
    assert is_out_of_reach(-160.0, sum(samples), least, CALIBRATION)
    assert not is_out_of_reach(840.0, sum(samples), least, CALIBRATION)
    # nor would the decision name a law that explained so little, all of it
    for left in ((2800.0, 2800.0), (2750.0, 2850.0)):
        assert is_out_of_reach(sum(left) - sum(samples), sum(samples), least, CALIBRATION)
        law = Candidate(("coulomb",), (2880.0, 2880.0))
        assert decide(Candidate((), left), [law], samples, CALIBRATION).probabilities["coulomb"] < least


def test_a_second_cause_has_to_earn_its_odds():
    plain = Candidate((), (9_000.0, 9_000.0))
    one = Candidate(("slack",), (2_900.0, 2_900.0))

    def both(gain: float) -> float:
        two = Candidate(("slack", "tilt"), (2_900.0, 2_900.0 - gain))
        sets = decide(plain, [one, two], (2880, 2880), CALIBRATION).sets
        return float(sets[1] / sets.sum())

    assert both(further_price(CALIBRATION)) == pytest.approx(0.5, abs=0.01)
    assert both(0.0) < 0.02


def test_near_what_a_cause_must_earn_none_is_not_certain():
    sets = [Candidate(("creep",), (1000.0, 1000.0))]

    def none(gain: float) -> float:
        plain = Candidate((), (1000.0, 1000.0 + gain))
        return decide(plain, sets, (1000, 1000), CALIBRATION).probabilities["none"]

    price = gain_of_a_law(CALIBRATION)
    assert none(price) == pytest.approx(0.5, abs=0.03)
    assert 0.55 < none(0.8 * price) < 0.97
    assert none(20.0) > 0.99
    assert none(2 * price) < 0.1


def test_jumps_need_no_more_than_their_own_price():
    plain = Candidate((), (2880.0, 3080.0))
    sets = [Candidate(("outliers",), (2880.0, 2830.0)), Candidate(("creep",), (2880.0, 2830.0))]
    decision = decide(plain, sets, (2880, 2880), CALIBRATION)
    assert decision.verdict == "outliers"


def test_an_effect_of_many_forms_has_no_better_chance():
    plain = Candidate((), (90_000.0, 90_000.0))
    sync = Candidate(("sync_offset",), (2372.0, 2316.0))
    filters = [Candidate(("filter_lag",), (2372.0, 2317.0 + i)) for i in range(3)]
    decision = decide(plain, [*filters, sync], (2880, 2880), CALIBRATION)
    assert decision.verdict == "sync_offset"
    one = decide(plain, [filters[0], sync], (2880, 2880), CALIBRATION)
    assert decision.probabilities["filter_lag"] == pytest.approx(one.probabilities["filter_lag"], rel=1e-6)


def test_the_same_effects_in_another_order_are_one_answer_and_a_law_is_another():
    plain = Candidate((), (90_000.0, 90_000.0))
    pair = [
        Candidate(("slack", "tilt"), (2880.0, 2885.0)),
        Candidate(("tilt", "slack"), (2880.0, 2886.0)),
    ]
    rival = Candidate(("slack", "preload"), (2880.0, 2885.5))
    alone = decide(plain, [pair[0], rival], (2880, 2880), CALIBRATION)
    decision = decide(plain, [*pair, rival], (2880, 2880), CALIBRATION)
    assert decision.sets[:2].sum() == pytest.approx(alone.sets[0], rel=1e-9)
    assert decision.chosen == 0
    assert decision.sets[2] > decision.sets[0]
    law = Candidate(("relaxation", "creep"), (2880.0, 2880.0), unlisted=True)
    elsewhere = Candidate(("relaxation", "creep"), (2880.0, 2880.0))
    other = Candidate(("slack", "preload"), (2880.0, 2880.0))
    three = decide(plain, [law, elsewhere, other], (2880, 2880), CALIBRATION)
    assert three.probabilities[UNKNOWN] == pytest.approx(1 / 3, abs=0.03)


def test_the_verdict_is_the_likeliest_effect_whatever_is_beside_it():
    plain = Candidate((), (100_000.0, 100_000.0))
    candidates = [
        Candidate(("sync_offset",), (2900.0, 2950.0)),
        Candidate(("filter_lag",), (2900.0, 2953.0)),
        Candidate(("filter_lag", "outliers"), (2900.0, 2865.0)),
    ]
    decision = decide(plain, candidates, (2880, 2880), CALIBRATION)
    assert decision.sets[0] > decision.sets[1] > decision.sets[2] > 0.1
    assert max(decision.probabilities, key=lambda name: decision.probabilities[name]) == "filter_lag"
    assert decision.verdict == "filter_lag"
    assert decision.chosen == 1


def test_an_effect_on_two_axes_has_one_share_and_no_credit_goes_to_a_form_elsewhere():
    plain = Candidate((), (50_000.0, 50_000.0))
    both = Candidate(
        ("relaxation", "slack"),
        (1_000.0, 1_000.0),
        places=(("relaxation tx", "relaxation ty"), ("slack rz",)),
    )
    here = Candidate(("relaxation",), (9_000.0, 9_000.0), places=(("relaxation tx", "relaxation ty"),))
    # the same name somewhere else explains nearly all: it is another law, and takes nothing from slack's share
    elsewhere = Candidate(("relaxation",), (1_900.0, 1_900.0), places=(("relaxation rx",),))
    slack = Candidate(("slack",), (30_000.0, 30_000.0), places=(("slack rz",),))
    found = decide(plain, [both, here, elsewhere, slack], (1000, 1000), CALIBRATION)
    assert found.chosen == 0
    shares = [found.probabilities[name] for name in ("relaxation", "slack")]
    assert shares[0] > shares[1] > 0.15
    unplaced = [Candidate(c.names, c.chi2) for c in (both, here, elsewhere, slack)]
    assert decide(plain, unplaced, (1000, 1000), CALIBRATION).probabilities["slack"] < 0.1
