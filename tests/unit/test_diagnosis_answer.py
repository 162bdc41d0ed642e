"""The answer of diagnosis.json: its causes, and pairs of trials where machines or initial states order them apart."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from real2sim.diagnosis import answer as answers
from real2sim.diagnosis.decide import Decision
from real2sim.diagnosis.evidence import BALANCE, CONFIGURED, START_POSE
from real2sim.diagnosis.machines import Machine
from real2sim.diagnosis.misfit import CompetingLaw
from real2sim.diagnosis.refit import Hypothesis
from real2sim.diagnosis.search import Pair
from real2sim.diagnosis.trials import Outcome
from real2sim.effects.base import Placed
from real2sim.effects.catalogue import EFFECT_NAMES, EFFECTS

from tests.unit.simulated_effects import SCALES, STRAP
from tests.unit.test_coupling import CONFIG

OPTIONS = CONFIG["diagnosis"]
COUNTS = {"dynamic_1": 7000, "dynamic_2": 7400}
# What the plain plant makes of each trial with each machine, and J of that
PATHS = {CONFIGURED: {"dynamic_1": 10.0, "dynamic_2": 20.0}, "study": {"dynamic_1": 1.0, "dynamic_2": 2.0}}


class Trial:
    """A trial as the answer asks it: J of a path is its value, and the path that of its machine."""

    sensors = {"markers": 12}  # noqa: RUF012
    noise_source = "none"
    plain_samples = 100.0

    def __init__(self, name: str, machine: str):
        self.name, self.machine, self.samples = name, machine, COUNTS[name]
        self.samples_by_sensor = (self.samples,)

    def j(self, paths):
        return paths[:, 0]

    def floor_draws(self):
        return np.ones(31)

    def residual_sd(self):
        return {}

    def axis_shares(self, path):
        return {"tx": 1.0}

    def locate(self, path, explained):
        return {}


def pair_of(machine: str, train: str, held_out: str, *, exchanged: bool = False) -> Pair:
    return Pair(Trial(train, machine), Trial(held_out, machine), None, exchanged)


def plain(first: float, second: float) -> Hypothesis:
    """Return the plain plant with chi-squared of the trials in the order of its pair."""
    return Hypothesis((), np.zeros(12), (first, second), (first, second))


def placed(name: str, form: str = "", place: int = 0) -> Placed:
    effect = next(e for e in EFFECTS if (e.name, e.form) == (name, form))
    return Placed(effect, effect.places(STRAP)[place], SCALES)


def fit_of(*effects: Placed) -> Hypothesis:
    x = [p.starts()[0] + 0.1 * i for i, p in enumerate(effects)]
    return Hypothesis(effects, np.concatenate([np.zeros(12), *x]), (7000.0, 7000.0))


def found_of(pair: Pair, fit: Hypothesis, state: str = START_POSE, hypotheses=None, further=()):
    sets = [fit_of(placed("coulomb"))] if hypotheses is None else hypotheses
    attribution = SimpleNamespace(
        plain=fit, hypotheses=sets, samples=(pair.train.samples, pair.held_out.samples)
    )
    return SimpleNamespace(
        pair=pair,
        attribution=attribution,
        further=further,
        initial_state=state,
        cost=lambda options: 0.0,
        left=lambda options: 0.0,
        predict_further=lambda h, options: [SimpleNamespace(chi2=h.chi2[0] + 1) for _ in further],
    )


def decision_of(verdict: str, sets=(0.0,), chosen=None, **probabilities: float) -> Decision:
    of_all = dict.fromkeys((*EFFECT_NAMES, "none", "unknown"), 0.0) | probabilities
    return Decision(of_all, np.array(sets, float), verdict, (verdict,), chosen)


@pytest.fixture
def stubs(monkeypatch):
    """Replace what the answer asks of simulations and of the judgement of machines."""
    monkeypatch.setattr(
        answers, "simulate", lambda evidence, pair, h: np.array([PATHS[evidence.machine][evidence.name]])
    )
    monkeypatch.setattr(Pair, "on_floor", lambda pair, sd: (False,))
    monkeypatch.setattr(answers._Account, "_parameters", lambda account, named: {})
    monkeypatch.setattr(answers._Account, "_closed", lambda account, path: {"gap_closed": None})
    monkeypatch.setattr(answers, "could_have_shown", lambda pair, fit, options: [])
    monkeypatch.setattr(answers, "precision_by_fit", lambda pair, h, samples, options: None)
    monkeypatch.setattr(answers, "with_others", lambda decision, machines, options, named: decision)
    monkeypatch.setattr(answers, "describe_machines", lambda machines, options: None)
    return monkeypatch


def unit_intervals(hypothesis, precision, options):
    """An interval from 0 to 1 for every parameter of each effect."""
    return [[(0.0, 1.0)] * len(one.effect.parameters) for one in hypothesis.effects]


def with_likelier_machine(own, own_trials, other, other_trials):
    """Return the answer `none` where another machine, found with ``other``, is likelier than the configured one."""
    outcome = Outcome(other, decision_of("none", none=1.0), None, False)
    searched = replace(outcome, found=own)
    machines = [
        Machine("study", other_trials, other.pair, other.attribution.plain, 0.0, outcome),
        Machine(CONFIGURED, own_trials, own.pair, own.attribution.plain, 900.0, searched),
    ]
    return answers.answer(outcome, CONFIG, machines=machines)


IN_ORDER, REVERSED = ("dynamic_1", "dynamic_2"), ("dynamic_2", "dynamic_1")


@pytest.mark.parametrize("own_order", [IN_ORDER, REVERSED])
@pytest.mark.parametrize(
    ("order", "exchanged", "shown"),
    [
        (IN_ORDER, False, "dynamic_2"),
        (REVERSED, True, "dynamic_2"),
        (REVERSED, False, "dynamic_1"),  # fitted the other way
    ],
)
def test_the_configured_machine_is_compared_on_the_trials_of_the_likeliest(
    stubs, own_order, order, exchanged, shown
):
    left = {CONFIGURED: {"dynamic_1": 90_000.0, "dynamic_2": 95_000.0}}
    left["study"] = {"dynamic_1": 7100.0, "dynamic_2": 7300.0}
    own = found_of(pair_of(CONFIGURED, *own_order), plain(*(left[CONFIGURED][t] for t in own_order)))
    pair = pair_of("study", *order, exchanged=exchanged)
    other = found_of(pair, plain(*(left["study"][t] for t in order)))
    gap = with_likelier_machine(own, own_order, other, order).gap
    assert gap["J_base"] == PATHS[CONFIGURED][shown]
    assert gap["J_with_effect"] == PATHS["study"][shown]
    assert gap["chi2_plain"] == [left[CONFIGURED][t] for t in order]
    assert gap["chi2_best"] == [left["study"][t] for t in order]
    assert gap["chi2_expected"] == [COUNTS[t] for t in order]
    assert gap["by_sensor"]["chi2_plain"] == [[left[CONFIGURED][t]] for t in order]


def test_further_trials_show_what_the_configured_machine_leaves_of_them(stubs):
    trial = SimpleNamespace(samples=7000)
    own, other = (
        found_of(pair_of(name, *IN_ORDER), plain(chi2, chi2), further=(trial,))
        for name, chi2 in ((CONFIGURED, 90_000.0), ("study", 7100.0))
    )
    gap = with_likelier_machine(own, IN_ORDER, other, IN_ORDER).gap
    assert gap["further"] == [{"chi2_plain": 90_001.0, "chi2_best": 7101.0, "chi2_expected": 7000}]


@pytest.mark.parametrize("exchanged", [False, True])
@pytest.mark.parametrize("other_exchanged", [False, True])
def test_pairs_under_the_other_initial_state_are_in_the_order_of_the_answer(
    stubs, exchanged, other_exchanged
):
    left = {"dynamic_1": 7001.0, "dynamic_2": 7402.0}
    order, others = (REVERSED if each else IN_ORDER for each in (exchanged, other_exchanged))
    found = found_of(pair_of("study", *order, exchanged=exchanged), plain(9000.0, 9000.0))
    pair = pair_of("study", *others, exchanged=other_exchanged)
    other = found_of(pair, plain(*(left[t] for t in others)), BALANCE)
    none = decision_of("none", none=1.0)
    stubs.setattr(answers, "conclude", lambda found, options: none)
    stubs.setattr(answers, "share_of_other", lambda costs, left, c: 0.0)
    otherwise = answers.answer(Outcome(found, none, other, False), CONFIG).otherwise
    assert otherwise["chi2_best"] == [left[t] for t in order]
    assert otherwise["chi2_expected"] == [COUNTS[t] for t in order]
    # searched with the trials exchanged: the other initial state was not
    again = found_of(pair_of("study", *REVERSED), plain(9000.0, 9000.0))
    otherwise = answers.answer(Outcome(again, none, other, True), CONFIG).otherwise
    assert otherwise["chi2_best"] == [left[t] for t in REVERSED]


@pytest.mark.parametrize("exchanged", [False, True])
@pytest.mark.parametrize("other_exchanged", [False, True])
def test_a_cause_under_the_other_initial_state_tells_the_cost_of_the_held_out_trial_of_the_answer(
    stubs, exchanged, other_exchanged
):
    order, others = (REVERSED if each else IN_ORDER for each in (exchanged, other_exchanged))
    own, theirs = fit_of(placed("coulomb")), fit_of(placed("tilt"))
    found = found_of(pair_of("study", *order, exchanged=exchanged), plain(9e4, 9e4), hypotheses=[own])
    pair = pair_of("study", *others, exchanged=other_exchanged)
    other = found_of(pair, plain(9e4, 9e4), BALANCE, hypotheses=[theirs])
    one, another = decision_of("coulomb", [1.0], 0, coulomb=1.0), decision_of("tilt", [1.0], 0, tilt=1.0)
    stubs.setattr(answers, "_checked", lambda found, decision, *rest: (decision, None, None))
    stubs.setattr(answers, "conclude", lambda found, options: another)
    stubs.setattr(answers, "share_of_other", lambda costs, left, c: 0.4)
    stubs.setattr(answers, "effect_intervals", unit_intervals)
    causes = answers.answer(Outcome(found, one, other, False), CONFIG).causes
    j = {cause.effect: cause.j_held_out for cause in causes}
    assert j == dict.fromkeys(("coulomb", "tilt"), PATHS["study"][order[1]])
    assert {cause.effect: cause.robot_holds for cause in causes} == {"coulomb": None, "tilt": BALANCE}


@pytest.mark.parametrize(("share", "checked"), [(0.04, False), (0.06, True)])
def test_laws_compete_with_what_is_named_under_the_other_initial_state_where_that_matters(
    stubs, share, checked
):
    found = found_of(pair_of("study", *IN_ORDER), plain(9e4, 9e4))
    other = found_of(pair_of("study", *IN_ORDER), plain(9e4, 9e4), BALANCE)
    named, none = decision_of("tilt", [1.0], 0, tilt=1.0), decision_of("none", none=1.0)
    stubs.setattr(answers, "conclude", lambda found, options: named)
    stubs.setattr(answers, "_checked", lambda found, decision, *rest: (none, None, None))
    stubs.setattr(answers, "share_of_other", lambda costs, left, c: share)
    outcome = Outcome(found, none, other, False)
    decision, told = answers._under_other(outcome, other, CONFIG["diagnosis"], print)
    assert told == share
    assert decision.verdict == ("none" if checked else "tilt")


def test_a_measured_law_shares_its_probability_with_the_other_initial_state_as_sets_do(stubs):
    hypothesis = fit_of(placed("coulomb"))
    found = found_of(pair_of("study", *IN_ORDER), plain(90_000.0, 90_000.0), hypotheses=[hypothesis])
    other = found_of(pair_of("study", *IN_ORDER), plain(90_000.0, 90_000.0), BALANCE)
    own = decision_of("coulomb", [0.6], 0, coulomb=0.6, unknown=0.4)
    law = SimpleNamespace(families=[SimpleNamespace(key="spline q_ty")], hypothesis=plain(8000.0, 8000.0))
    misfit = SimpleNamespace(
        rival=CompetingLaw(law, 40.0, 0.3),
        measured=SimpleNamespace(laws=[law], library=None),
        to_dict=lambda found: {},
    )
    none = decision_of("none", none=1.0)
    checked = {START_POSE: (own, misfit, None), BALANCE: (none, None, None)}
    stubs.setattr(answers, "_checked", lambda found, *rest: checked[found.initial_state])
    stubs.setattr(answers, "conclude", lambda found, options: none)
    stubs.setattr(answers, "share_of_other", lambda costs, left, c: 0.25)
    stubs.setattr(answers, "effect_intervals", unit_intervals)
    considered = answers.answer(Outcome(found, own, other, False), CONFIG).considered
    assert [row["effects"] for row in considered] == [["coulomb"], []]
    assert [row["probability"] for row in considered] == pytest.approx([0.75 * 0.6, 0.75 * 0.3])
    assert considered[1]["handicap"] == 40.0


def test_a_set_that_both_initial_states_name_has_the_probability_of_both(stubs):
    pair = fit_of(placed("coulomb"), placed("tilt"))
    found = found_of(pair_of("study", *IN_ORDER), plain(90_000.0, 90_000.0), hypotheses=[pair])
    other = found_of(pair_of("study", *IN_ORDER), plain(90_000.0, 90_000.0), BALANCE, hypotheses=[pair])
    own = decision_of("coulomb", [0.9], 0, coulomb=0.5, tilt=0.4, unknown=0.1)
    theirs = decision_of("coulomb", [0.8], 0, coulomb=0.4, tilt=0.4, unknown=0.2)
    decisions = {START_POSE: (own, None, None), BALANCE: (theirs, None, None)}
    stubs.setattr(answers, "_checked", lambda found, *rest: decisions[found.initial_state])
    stubs.setattr(answers, "conclude", lambda found, options: theirs)
    stubs.setattr(answers, "share_of_other", lambda costs, left, c: 0.25)
    stubs.setattr(answers, "effect_intervals", unit_intervals)
    answer = answers.answer(Outcome(found, own, other, False), CONFIG)
    assert answer.otherwise["named_probability"] == pytest.approx(0.25 * 0.8)
    assert sum(row["probability"] for row in answer.considered) == pytest.approx(0.75 * 0.9)


def causes_of(stubs, hypotheses, sets, chosen=0, report=None, **probabilities):
    """Return the causes of sets with these probabilities; intervals hold the searched numbers of each effect."""

    def intervals(hypothesis, precision, options):
        each = zip(hypothesis.effects, hypothesis.split(), strict=True)
        return [[(v, v) for v in one.values(x[None])[0]] for one, x in each]

    stubs.setattr(answers, "effect_intervals", intervals)
    found = found_of(pair_of("study", *IN_ORDER), plain(90_000.0, 90_000.0), hypotheses=hypotheses)
    names = hypotheses[chosen].names if chosen is not None else ("none",)
    decision = decision_of(names[0], sets, chosen, **probabilities)
    settings = CONFIG | {"diagnosis": OPTIONS | {"report": OPTIONS["report"] | (report or {})}}
    return [cause.to_dict() for cause in answers._Account(found, decision, settings).causes()]


def test_a_cause_on_two_axes_has_the_values_of_both(stubs):
    ty, tx = placed("coulomb", place=1), placed("coulomb", place=0)
    (cause,) = causes_of(stubs, [fit_of(ty, placed("tilt"), tx)], [1.0], coulomb=1.0)[:1]
    assert (cause["effect"], cause["axes"], cause["with"]) == ("coulomb", ["ty", "tx"], ["tilt"])
    assert cause["equation"] == ty.effect.equation
    named = [ty.named(ty.starts()[0]), tx.named(tx.starts()[0] + 0.2)]
    assert {k: v["value"] for k, v in cause["parameters"].items()} == {
        k: value for each in named for k, (value, _) in each.items()
    }
    assert all(v["ci95"] == pytest.approx([v["value"]] * 2) for v in cause["parameters"].values())


@pytest.mark.parametrize(
    ("members", "keys"),
    [
        # markers and joints are no axes: the names of their values do not tell them apart
        (
            [placed("marker_drift", "asis_l"), placed("marker_drift", "psis_r")],
            ["steady_x_asis_l_m_per_s", "steady_x_psis_r_m_per_s"],
        ),
        (
            [placed("marker_drift", "left"), placed("marker_drift", "asis_l")],
            ["left_x_m_per_s", "steady_x_m_per_s"],
        ),
    ],
)
def test_values_of_a_cause_at_two_places_keep_apart(stubs, members, keys):
    (cause,) = causes_of(stubs, [fit_of(*members)], [1.0], marker_drift=1.0)
    assert set(keys) <= set(cause["parameters"])
    assert len(cause["parameters"]) == sum(len(p.effect.parameters) for p in members)
    assert cause["equation"] == "; ".join(p.effect.equation for p in members)


def test_joints_of_the_machine_keep_their_values_apart(stubs):
    effect = next(e for e in EFFECTS if e.scope == "joint")
    where = effect.place(STRAP)
    members = [Placed(effect, replace(where, machine_joint=joint), SCALES) for joint in ("shoulder", "elbow")]
    (cause,) = causes_of(stubs, [fit_of(*members)], [1.0], **{effect.name: 1.0})
    assert len(cause["parameters"]) == 2 * len(effect.parameters)
    for one in members:
        assert any(one.where.machine_joint in key for key in cause["parameters"])


def test_causes_stand_likeliest_first(stubs):
    both, alone = (
        fit_of(placed("cross_coupling", "_elastic"), placed("soft_tissue")),
        fit_of(placed("soft_tissue")),
    )
    causes = causes_of(stubs, [both, alone], [0.72, 0.26], cross_coupling=0.0003, soft_tissue=0.98)
    assert [cause["effect"] for cause in causes] == ["soft_tissue", "cross_coupling"]
    assert causes[0]["with"] == ["cross_coupling"]


def test_members_of_the_named_set_are_causes_however_unlikely(stubs):
    both = fit_of(placed("cross_coupling", "_elastic"), placed("soft_tissue"))
    others = [fit_of(placed("coulomb")), fit_of(placed("tilt")), fit_of(placed("preload"))]
    told = {"soft_tissue": 0.98, "coulomb": 0.004, "tilt": 0.003, "cross_coupling": 0.0003, "preload": 0.002}
    causes = causes_of(
        stubs, [both, *others], [0.98, 0.004, 0.003, 0.002], report={"detailed_causes": 3}, **told
    )
    assert [c["effect"] for c in causes] == ["soft_tissue", "coulomb", "tilt", "cross_coupling"]
    assert "J_held_out" in causes[-1]
    assert not any("ci95" in v for v in causes[-1]["parameters"].values())
