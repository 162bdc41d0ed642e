"""A named cause that does not fit: what stands against it, what is said of it, and how the suite scores the mark."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from real2sim.diagnosis import misfit as misfit_module
from real2sim.diagnosis.decide import Candidate, decide
from real2sim.diagnosis.free_form import Law
from real2sim.diagnosis.kin import gives_way, is_kin, mended_by, stands_for
from real2sim.diagnosis.misfit import Misfit, _reach, _replaces, misfit_of, told_apart
from real2sim.diagnosis.refit import Hypothesis
from real2sim.effects.base import Placed, Scales
from real2sim.effects.catalogue import EFFECTS
from real2sim.effects.displacements import displacements
from real2sim.effects.families import Family, families
from real2sim.pages.law import misfit_sentence
from real2sim.system.description import shipped_system
from real2sim.verification.score import _score_misfit

from tests.unit.test_coupling import CONFIG
from tests.unit.test_displacements import CONTEXT

SYSTEM = shipped_system("strap")
ONES = np.ones(6)
SCALES = Scales(ONES, ONES, ONES, ONES, ONES)


def _named(name: str, axis: str = "") -> Hypothesis:
    effect = next(e for e in EFFECTS if e.name == name)
    where = next(w for w in effect.places(SYSTEM) if not axis or w.axis_names == [axis])
    placed = Placed(effect, where, SCALES)
    return Hypothesis((placed,), np.zeros(12 + len(effect.parameters)), (1.0, 1.0))


def _law(family) -> Law:
    return Law((family,), Hypothesis((), np.zeros(12), (1.0, 1.0)), 0.0)


def _family(kind: str, axis: str) -> Family:
    names = [f"{x}_{a.name}" for a in SYSTEM.axes for x in "qv"]
    unit = {a.joint: 1.0 for a in SYSTEM.axes}
    return next(f for f in families(SYSTEM, names, unit, unit, 10.0) if f.kind == kind and axis in f.axes)


@pytest.mark.parametrize(
    ("name", "axis", "kind", "kin"),
    [
        ("slack", "ty", "elastic", True),
        ("slack", "ty", "dissipative", False),
        ("slack", "tx", "elastic", False),
        ("coulomb", "ty", "hysteresis", True),
        ("relaxation", "ty", "dissipative", False),
    ],
)
def test_a_law_is_kin_of_a_name_of_its_kind_and_axis(name, axis, kind, kin):
    assert is_kin(_law(_family(kind, "ty")), _named(name, axis)) is kin


@pytest.mark.parametrize(
    ("members", "axis", "replaced"),
    [
        ((("coulomb", "ty"), ("quadratic_damping", "ty")), "ty", {"coulomb", "quadratic_damping"}),
        ((("coulomb", "ty"), ("quadratic_damping", "ty")), "tx", set()),
        ((("coulomb", "ty"), ("quadratic_damping", "tx")), "ty", set()),  # no axis in common
        ((("coulomb", "ty"), ("coulomb", "tx")), "ty", set()),
        ((("coulomb", "ty"), ("soft_tissue", "")), "ty", set()),  # an effect without an axis
        ((("coulomb", "ty"), ("slack", "ty"), ("lugre", "tx")), "ty", {"coulomb", "slack"}),
    ],
)
def test_a_law_stands_for_names_on_one_axis(members, axis, replaced):
    named = Hypothesis(tuple(_named(*m).effects[0] for m in members), np.zeros(30), (1.0, 1.0))
    assert stands_for(_law(_family("dissipative", axis)), named) == replaced


@pytest.mark.parametrize(
    ("alone", "replaces"),
    [
        ({}, True),
        ({"coulomb": 1_300.0, "slack": 1_500.0}, True),
        ({"coulomb": 1_050.0}, False),  # one of the names alone does nearly as well: another equation of it
        ({"tilt": 1_000.0}, True),  # of none of the names
    ],
)
def test_a_law_replaces_several_names_where_it_explains_more_than_each_alone(alone, replaces):
    law = Candidate(("dissipative",), (500.0, 500.0), unlisted=True)
    sets = [Candidate((name,), (left / 2, left / 2)) for name, left in alone.items()]
    several = frozenset({"coulomb", "slack"})
    assert _replaces(law, sets, several, CONFIG["diagnosis"]) is replaces
    assert not _replaces(law, sets, frozenset(), CONFIG["diagnosis"])


@pytest.mark.parametrize(
    ("names", "noise", "measured", "marked"),
    [
        (("coulomb",), True, False, False),
        (("coulomb",), False, True, True),
        # one law may do what two names do, and that they leave noise alone says nothing against it
        (("coulomb", "quadratic_damping"), True, True, False),
        (("coulomb", "outliers"), True, False, False),
        (("coulomb", "soft_tissue"), True, False, False),
    ],
)
def test_laws_are_measured_beside_what_leaves_more_than_noise_or_has_several_laws(
    monkeypatch, names, noise, measured, marked
):
    members = [_named(n, "" if n in ("outliers", "soft_tissue") else "ty").effects[0] for n in names]
    named = Hypothesis(tuple(members), np.zeros(20), (1.0, 1.0))
    search = SimpleNamespace(is_noise=lambda h: noise, beyond=lambda h: 0.0, samples=(10, 10))
    left = Misfit(named.key, (0.0, 0.0), "markers", 0.0, marked=False)
    monkeypatch.setattr(misfit_module, "Search", lambda *rest: search)
    monkeypatch.setattr(misfit_module, "_left", lambda *rest: left)
    monkeypatch.setattr(misfit_module, "measure", lambda *rest: "laws")
    found = SimpleNamespace(pair=None, attribution=SimpleNamespace(plain=None))
    misfit = misfit_of(found, named, CONFIG["diagnosis"], lambda text: None)
    assert (misfit.measured == "laws", misfit.marked) == (measured, marked)


def test_displacements_are_kin_of_what_they_are_a_case_of():
    late, drifting = (
        next(d for d in displacements(10.0, CONTEXT) if d.name == f"{n} markers")
        for n in ("late", "drifting")
    )
    assert is_kin(_law(late), _named("sync_offset"))
    assert not is_kin(_law(late), _named("soft_tissue"))
    # a strap that migrates and markers that drift cannot be told apart
    assert is_kin(_law(drifting), _named("migration"))
    assert not is_kin(_law(drifting), _named("slack", "ty"))


@pytest.mark.parametrize(
    ("kind", "law_axis", "mended"),
    [
        ("memory", "ty", True),
        ("elastic", "ty", False),
        # any course in time can stand for every law of its axis, and for none of another
        ("external force", "ty", True),
        ("external force", "tx", False),
    ],
)
def test_a_law_on_top_mends_a_name_of_its_kind_or_with_any_history(kind, law_axis, mended):
    named, law = _named("relaxation", "ty"), _law(_family(kind, law_axis))
    assert mended_by(law, named) == (frozenset({"relaxation"}) if mended else frozenset())


@pytest.mark.parametrize(
    ("kind", "axis", "by_name", "gives"),
    [
        ("external force", "ty", 90.0, True),
        ("external force", "ty", 80.0, False),  # the name explains too little
        ("external force", "tx", 90.0, False),  # of another axis
        ("elastic", "ty", 90.0, False),  # predicts, and may be the better law
    ],
)
def test_a_free_history_gives_way_to_a_name_of_its_axis_that_gains_as_much(kind, axis, by_name, gives):
    assert gives_way(_law(_family(kind, axis)), _named("coulomb", "ty"), (by_name, 100.0), 0.15) is gives


OTHER, FREE, OWN = "another axis", "any history of its axis", "its own kind"


@pytest.mark.parametrize(
    ("left", "competes", "handicap"),
    [
        (
            {OWN: 900.0, OTHER: 1_000.0},
            OTHER,
            2_900.0,
        ),  # the first law is of the name's kind, another one near it
        ({OTHER: 900.0, OWN: 1_000.0}, OTHER, 2_800.0),
        ({OTHER: 900.0}, OTHER, 0.0),
        ({OTHER: 900.0, OWN: 5_000.0}, OTHER, 0.0),  # a law of its kind that is worse than the name
        ({OWN: 900.0}, None, 0.0),
        ({FREE: 900.0, OTHER: 1_000.0}, OTHER, 0.0),  # a history that gains hardly more gives way
        ({}, None, 0.0),
    ],
)
def test_the_best_law_of_another_kind_competes_with_a_name_beyond_its_own_kind(
    monkeypatch, left, competes, handicap
):
    expected, options = 14_400.0, CONFIG["diagnosis"]
    named = _named("coulomb", "ty")
    attribution = SimpleNamespace(plain=Hypothesis((), np.zeros(12), (1.0, 1.0)), hypotheses=[named])

    def candidate(names, more, **kind):
        return Candidate(names, ((expected + more) / 2,) * 2, **kind)

    plain, sets = candidate((), 40_000.0), [candidate(("coulomb",), 3_800.0)]
    laws = [SimpleNamespace(name=name, hypothesis=name, families=[], is_free=name == FREE) for name in left]
    found = SimpleNamespace(
        attribution=attribution,
        pair=None,
        samples=(7_200, 7_200),
        candidate=lambda name, options, law: candidate((name,), left[name], unlisted=True),
    )
    monkeypatch.setattr(misfit_module, "candidates_of", lambda found, options: (plain, sets))
    monkeypatch.setattr(misfit_module, "is_kin_of", lambda law, *rest: law.name == OWN)
    monkeypatch.setattr(misfit_module, "gives_way", lambda law, *rest: law.name == FREE)
    before = decide(plain, sets, found.samples, options["calibration"])
    misfit = Misfit("coulomb ty", (5.0, 5.0), "markers", 0.1, True, SimpleNamespace(laws=laws, library=None))
    decision, after = told_apart(misfit, found, before, options)
    assert sum(decision.probabilities.values()) == pytest.approx(1)
    if competes is None:
        assert (decision, after) == (before, misfit)
        return
    assert (after.rival.law.name, after.rival.handicap) == (competes, pytest.approx(handicap))
    assert after.rival.probability <= decision.probabilities["unknown"]
    # the sooner the further its lead over the name's own kind is
    ahead = left.get(OWN, np.inf) - left[OTHER]
    assert (decision.probabilities["coulomb"] > 0.5) == (ahead < 0)


def test_effects_name_families_that_exist():
    names = [f"{x}_{a.name}" for a in SYSTEM.axes for x in "qv"]
    names += ["place_x", "place_y", "heading", "time", *(f"acceleration_{a.name}" for a in SYSTEM.axes)]
    joints = [*(a.joint for a in SYSTEM.axes), "base_x", "base_y", "base_yaw"]
    unit = dict.fromkeys(joints, 1.0)
    known = {f.kind for f in families(SYSTEM, names, unit, unit, 10.0)} | {
        d.name for d in displacements(10.0, CONTEXT)
    }
    unknown = {k for e in EFFECTS for k in e.kinds} - known
    assert not unknown
    # of these, in one form or all, no family holds what they do
    assert {e.name for e in EFFECTS if not e.kinds} == {"clock_drift", "log_latency", "outliers", "preload"}


def test_the_page_says_what_is_left_and_of_what_kind():
    law = {
        "axes": ["ty"],
        "depends_on": ["q_ty"],
        "kind": "elastic",
        "size": {"rms": 12.04, "unit": "N"},
        "own_history_in_each_trial": False,
    }
    text = misfit_sentence({"marked": True, "left_sd": [30.1, 71.2], "left_share": 0.01, "law": law})
    assert "takes away 99 % of chi-squared above noise, and is not all" in text
    assert "71" in text
    assert "12 N (RMS) along ty that depends on q_ty (elastic)" in text
    told = {"marked": True, "left_sd": [30.1, 71.2], "sensor": "robot log", "left_share": 0.01, "law": law}
    assert "are left, most of it in the robot log: 12 N" in misfit_sentence(told)
    assert misfit_sentence({"marked": False, "left_sd": [0.1, 0.2], "left_share": 0.0, "law": None}) == ""
    assert misfit_sentence(None) == ""


def _row(verdict: str, *, marked: bool) -> dict:
    return {"names": ["slack"], "answer": {"verdict": verdict, "misfit": {"marked": marked}}}


def test_the_score_counts_marks_of_what_is_named_rightly():
    library = [_row("slack", marked=False)] * 19 + [_row("slack", marked=True), _row("coulomb", marked=True)]
    other = [_row("slack", marked=True), _row("slack", marked=False), _row("coulomb", marked=False)]
    named, another = _score_misfit(library, other)
    assert (named["value"], named["n"], named["met"]) == (0.05, 20, True)
    assert (another["value"], another["n"], another["met"]) == (0.5, 2, None)


def test_noise_that_an_effect_passes_on_is_not_left_by_it():
    from real2sim.diagnosis.search import _excess

    draws = np.random.default_rng(1).normal(1500, 60, 200)
    alone = ([1520.0], [1000], [False])
    assert _excess(*alone, draws[:, None]) < 1
    assert _excess(*alone, None) > 10
    assert _excess(*alone, np.full((5, 1), np.nan)) > 10


def test_laws_compete_as_far_as_the_named_set_is_not_nearly_everything():
    settings = CONFIG["diagnosis"]["search"]
    left = 6000.0 - 5760
    assert _reach(left, settings["nearly_all"], 5760, settings) == np.inf
    reach = 5760 + settings["far_behind"] * left + settings["out_of_reach"]
    assert _reach(left, 0.01, 5760, settings) == reach
