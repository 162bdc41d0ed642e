"""A listed effect that acts beside something unlisted is named; one that only imitates it is not."""

from __future__ import annotations

import numpy as np
import pytest
from real2sim.diagnosis.decide import NONE, UNKNOWN, Candidate, decide, with_layers

from tests.unit.test_coupling import CONFIG

SAMPLES = (1000, 1000)
PLAIN = Candidate((), (50_000.0, 50_000.0))
COULOMB = Candidate(("coulomb",), (6_000.0, 8_000.0))


@pytest.fixture(name="constants")
def _constants():
    return CONFIG["diagnosis"]["calibration"]


def _after(constants, on_top: float, alone: float, sets=(COULOMB,)):
    decision = decide(PLAIN, list(sets), SAMPLES, constants)
    assert decision.verdict == UNKNOWN
    layer = Candidate(sets[0].names, (on_top / 2, on_top / 2))
    law = Candidate(("damping by coordinate",), (alone / 2, alone / 2), unlisted=True)
    return with_layers(decision, list(sets), PLAIN, {0: layer}, [law], SAMPLES, constants, {})


def test_an_effect_that_a_law_alone_cannot_replace_is_named(constants):
    decision = _after(constants, on_top=2_300.0, alone=9_000.0)
    assert decision.verdict == "coulomb"
    assert decision.probabilities["coulomb"] > 0.9
    assert sum(decision.probabilities.values()) == pytest.approx(1.0)


def test_an_effect_that_a_law_alone_replaces_stays_unknown(constants):
    decision = _after(constants, on_top=2_300.0, alone=2_300.0)
    before = decide(PLAIN, [COULOMB], SAMPLES, constants).probabilities["coulomb"]
    assert decision.verdict == UNKNOWN
    assert before <= decision.probabilities["coulomb"] < before + 0.01


def test_where_even_both_together_leave_much_it_is_neither(constants):
    decision = _after(constants, on_top=30_000.0, alone=45_000.0)
    assert decision.verdict == UNKNOWN


def test_a_form_that_stands_for_unlisted_laws_keeps_its_doubt(constants):
    doubtful = Candidate(("relaxation",), COULOMB.chi2, ambiguous=True)
    decision = _after(constants, on_top=2_300.0, alone=9_000.0, sets=(doubtful,))
    assert decision.probabilities[UNKNOWN] >= 0.9 * constants["ambiguous_share"]


def test_no_set_is_surer_than_sure_with_a_law_on_top(constants):
    doubtful = Candidate(("relaxation",), (1_100.0, 1_150.0), ambiguous=True)
    decision = decide(PLAIN, [doubtful], SAMPLES, constants)
    layer = Candidate(("relaxation",), (1_000.0, 1_000.0))
    law = Candidate(("external force",), (4_500.0, 4_500.0), unlisted=True)
    after = with_layers(decision, [doubtful], PLAIN, {0: layer}, [law], SAMPLES, constants, {})
    # what is doubted of a form is no place for a law on top
    assert after.probabilities["relaxation"] == pytest.approx(decision.probabilities["relaxation"], abs=0.02)
    assert after.sets.sum() + after.probabilities[UNKNOWN] + after.probabilities[NONE] == pytest.approx(1.0)


def test_a_name_that_the_law_gives_another_equation_keeps_its_doubt(constants):
    decision = decide(PLAIN, [COULOMB], SAMPLES, constants)
    layer = Candidate(COULOMB.names, (1_150.0, 1_150.0))
    law = Candidate(("external force",), (4_500.0, 4_500.0), unlisted=True)
    after = with_layers(
        decision, [COULOMB], PLAIN, {0: layer}, [law], SAMPLES, constants, {0: frozenset(COULOMB.names)}
    )
    sure = with_layers(decision, [COULOMB], PLAIN, {0: layer}, [law], SAMPLES, constants, {})
    before, lost = decision.probabilities, sure.probabilities[UNKNOWN]
    expected = lost + constants["ambiguous_share"] * (before[UNKNOWN] - lost)
    assert after.probabilities[UNKNOWN] == pytest.approx(expected)
    assert sum(after.probabilities.values()) == pytest.approx(1.0)


def test_an_effect_beside_the_mended_one_wins_all(constants):
    slack = Candidate(("slack",), (40_000.0, 40_000.0))
    friction = Candidate(("coulomb",), (20_000.0, 20_000.0))
    both = Candidate(("coulomb", "slack"), (6_000.0, 8_000.0))
    sets, layer = [slack, friction, both], Candidate(both.names, (1_150.0, 1_150.0))
    law = Candidate(("external force",), (4_500.0, 4_500.0), unlisted=True)
    decision = decide(PLAIN, sets, SAMPLES, constants)
    assert decision.verdict == UNKNOWN
    after = with_layers(
        decision, sets, PLAIN, {2: layer}, [law], SAMPLES, constants, {2: frozenset({"slack"})}
    )
    sure = with_layers(decision, sets, PLAIN, {2: layer}, [law], SAMPLES, constants, {})
    won = {n: sure.probabilities[n] - decision.probabilities[n] for n in both.names}
    still = {n: after.probabilities[n] - decision.probabilities[n] for n in both.names}
    assert still["coulomb"] == pytest.approx(won["coulomb"])
    assert still["slack"] == pytest.approx((1 - constants["ambiguous_share"]) * won["slack"])
    assert sum(after.probabilities.values()) == pytest.approx(1.0)


def test_nothing_changes_without_a_law_on_top(constants):
    decision = decide(PLAIN, [COULOMB], SAMPLES, constants)
    assert with_layers(decision, [COULOMB], PLAIN, {}, [], SAMPLES, constants, {}) is decision
    assert np.isclose(sum(decision.probabilities.values()), 1.0)
