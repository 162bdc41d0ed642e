"""The trial to record next: rivals, and how far a trial parts them."""

from __future__ import annotations

import json
from types import SimpleNamespace

import numpy as np
import pytest
from real2sim.diagnosis.decide import Decision
from real2sim.diagnosis.free_form import Law
from real2sim.diagnosis.next_trial import axes_of, rivals_of, told
from real2sim.diagnosis.refit import Hypothesis
from real2sim.effects.base import Placed, Scales
from real2sim.effects.catalogue import EFFECTS
from real2sim.effects.families import families
from real2sim.system.description import shipped_system

SYSTEM = shipped_system("strap")
ONES = np.ones(6)
SCALES = Scales(ONES, ONES, ONES, ONES, ONES)


def _set(*names: str) -> Hypothesis:
    effects = [next(e for e in EFFECTS if e.name == name) for name in names]
    placed = tuple(Placed(e, e.places(SYSTEM)[0], SCALES) for e in effects)
    return Hypothesis(placed, np.zeros(12 + sum(len(e.parameters) for e in effects)), (1.0, 1.0))


def _laws(*kinds: str) -> list[Law]:
    names = [f"{x}_{a.name}" for a in SYSTEM.axes for x in "qv"]
    unit = {a.joint: 1.0 for a in SYSTEM.axes}
    own = [f for f in families(SYSTEM, names, unit, unit, 10.0) if f.axes == ("ty",)]
    by_kind = {f.kind: f for f in own}
    return [Law(tuple(by_kind[k] for k in kind.split("+")), _set("slack"), 0.0) for kind in kinds]


SETS = SimpleNamespace(hypotheses=[_set("slack"), _set("slack"), _set("coulomb"), _set("lugre")])


def _decision(chosen: int | None, unknown: float = 0.0) -> Decision:
    sets = np.array([0.5, 0.2, 0.2, 0.1]) * (1 - unknown)
    return Decision({"unknown": unknown}, sets, "slack", ("slack",), chosen)


def test_rivals_are_two_answers_and_not_two_forms_of_one():
    assert [r.name for r in rivals_of(SETS, _decision(0), [], [])] == ["slack", "coulomb"]


def test_laws_that_share_a_family_are_no_rivals():
    laws = _laws("dissipative+memory", "dissipative", "elastic")
    names = [r.name for r in rivals_of(SETS, _decision(None, 0.9), laws, [0.5, 0.3, 0.2])]
    assert names == ["dissipative force along ty of v_ty (and 1 more)", "elastic force along ty of q_ty"]
    assert [r.name for r in rivals_of(SETS, _decision(None, 0.9), laws[:2], [0.6, 0.4])][1] == "slack"


def test_names_and_laws_are_rivals_by_their_probability():
    laws = _laws("dissipative", "elastic")
    # a name of 0.4 is a rival of two laws that share 0.2, and one of 0.4 is a rival of a name of 0.3
    assert [r.name for r in rivals_of(SETS, _decision(None, 0.2), laws, [0.5, 0.5])] == ["slack", "coulomb"]
    names = [r.name for r in rivals_of(SETS, _decision(0, 0.4), laws, [1.0, 0.0])]
    assert names == ["dissipative force along ty of v_ty", "slack"]


def test_axes_are_those_of_the_rivals_first():
    rivals = rivals_of(SETS, _decision(None, 0.9), _laws("dissipative", "elastic"), [0.5, 0.5])
    shares = {"tx": 0.7, "ty": 0.1, "tz": 0.2}
    pair = SimpleNamespace(system=SYSTEM)
    assert axes_of(rivals, pair, shares, 2)[0] in ("tx", "ty")
    assert set(axes_of(rivals, pair, shares, 3)) >= {"ty", "tx"}
    assert len(axes_of(rivals, pair, shares, 3)) == 3


def test_a_proposal_is_told_in_one_phrase():
    proposal = {
        "motion": "sway sideways",
        "rivals": ["a", "b"],
        "difference_sd": 41.2,
        "now_sd": 3.4,
        "tried": [],
    }
    text = told(json.loads(json.dumps(proposal)))
    assert text.startswith("sway sideways; a and b would then be 41 standard deviations of noise apart")
    assert text.endswith("where they are 3 apart in the trial at hand")
    nowhere = told(proposal | {"now_sd": None})
    assert nowhere.endswith("41 standard deviations of noise apart")
    with pytest.raises(KeyError):
        told({"motion": "sway"})


def test_a_motion_that_parts_no_better_than_the_trial_at_hand_is_not_proposed():
    tried = [
        {"motion": "sway sideways", "difference_sd": 3.6},
        {"motion": "sway in pitch", "difference_sd": 1.0},
    ]
    proposal = {"motion": "sway sideways", "rivals": ["a", "b"], "difference_sd": 3.6, "now_sd": 4.4}
    text = told(proposal | {"tried": tried})
    assert text.startswith(
        "the held-out trial once more; a and b are 4 standard deviations of noise apart in it"
    )
    assert text.endswith("in none of the 2 motions that were tried")
    assert told(proposal | {"tried": tried, "now_sd": 2.0}).startswith("sway sideways")
