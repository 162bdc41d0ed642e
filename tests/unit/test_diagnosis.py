"""The diagnosis of a person from end to end, and its score."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from real2sim.diagnosis import trials as trials_module
from real2sim.diagnosis.attribute import Attribution, finished
from real2sim.diagnosis.decide import NONE, UNKNOWN, Decision
from real2sim.diagnosis.intervals import Precision, parameter_verdicts, precision_by_fit
from real2sim.diagnosis.refit import Hypothesis
from real2sim.diagnosis.search import Pair, Search
from real2sim.diagnosis.trials import Found, Trials, conclude, is_shown_by_held_out_alone, search_both_ways
from real2sim.effects import catalogue
from real2sim.effects.catalogue import EFFECT_NAMES, Placed
from real2sim.study.strap import strap_system
from real2sim.verification.score import score_diagnosis

from tests.unit.simulated_effects import SCALES, STRAP
from tests.unit.test_coupling import CONFIG, ROBOT

# Effects that the strap can have
EFFECTS = tuple(effect for effect in catalogue.EFFECTS if effect.places(STRAP))


def _case(name: str, stratum: str, effects: list[str], verdict: str, folder: Path) -> tuple[dict, Path]:
    probabilities = dict.fromkeys((*EFFECT_NAMES, NONE, UNKNOWN), 0.0) | {verdict: 1.0}
    regimes = [
        {"bin": "large amplitude, fast, outward", "share": 0.2},
        {"bin": "large amplitude, fast, returning", "share": 0.5},
        {"bin": "large amplitude, slow, outward", "share": 0.3 if verdict == "relaxation" else 0.1},
    ]
    answer = {
        "subject": name,
        "verdict": verdict,
        "verdict_set": [verdict],
        "probabilities": probabilities,
        "where": {"stage": "interface", "axes": {"tx": 1.0, "ty": 0.0}, "regimes": regimes},
        "gap": {"J_base": 2.0, "J_floor": 1.0, "J_with_effect": 1.0},
        "parameters": {
            "k_tx": {"base": 800.0, "with_effect": 710.0, "ci95": [690.0, 730.0], "verdict": "determined"},
            "d_ry": {"base": 2.0, "with_effect": 9.0, "ci95": [1.0, 15.0], "verdict": "not determined"},
        },
        "causes": [
            {
                "effect": "slack",
                "equation": next(e.equation for e in EFFECTS if (e.name, e.form) == ("slack", "")),
                "parameters": {"half_width_tx_m": {"value": 2.2e-3, "ci95": [2.1e-3, 2.3e-3]}},
            }
        ],
        "baselines": {"AIC": verdict},
        "considered": [
            {"effects": ["slack"], "J": 1.2},
            {"effects": ["slack"], "J": 1.1},
            {"effects": ["slack", "tilt"], "J": 0.9},
        ],
    }
    target = folder / name / "diagnosis.json"
    target.parent.mkdir()
    target.write_text(json.dumps(answer))
    (target.parent / "seconds.json").write_text('{"seconds": 3.0}')
    truth = {
        "id": name,
        "stratum": stratum,
        "effects": [
            {"effect": e, "form": e, "family": e, "axes": ["tx"], "stage": "interface", "severity": 0.3}
            | {"parameters": {"half_width_tx_m": 2e-3} if e == "slack" else {}}
            for e in effects
        ],
        "regimes": {"large amplitude, fast": 0.5, "small amplitude, fast": 0.4, "small amplitude, slow": 0.1},
        "visibility": {"target": 0.2, "predicted": 0.2},
        "parameters": {"k_tx": {"value": 700.0}, "d_ry": {"value": 3.0}},
    }
    return truth, target


@pytest.mark.parametrize(
    ("first", "second", "verdict"),
    [
        ("unknown", "joint_limit", "joint_limit"),
        ("unknown", "unknown", "unknown"),
        ("unknown", "none", "unknown"),
        ("slack", "joint_limit", "slack"),
    ],
)
def test_the_other_trial_is_fitted_where_nothing_explains_it(monkeypatch, first, second, verdict):
    """Stops that the first trial hardly reaches were `unknown` 0.81 of it, and `joint_limit` 0.95 of the second."""
    pair = SimpleNamespace(exchanged=False, train=SimpleNamespace(settled=True))
    asked = []

    class Two(Trials):
        def prepare(self, *, settled=False):
            asked.append((self.train, self.held_out, settled))
            return pair, np.zeros(12)

        def attribute(self, pair, z):
            return Found(pair, second)

    def conclusion(found, options):
        verdict = found.attribution
        return Decision({}, np.zeros(1), verdict, (), None if verdict in ("unknown", "none") else 0)

    monkeypatch.setattr(trials_module, "search_initial_states", lambda trials: (Found(pair, first), None))
    monkeypatch.setattr(trials_module, "conclude", conclusion)
    monkeypatch.setattr(trials_module, "explains_fitted", lambda found, options: True)
    two = Two("dynamic_1", "dynamic_2", None, None, CONFIG["diagnosis"], lambda text: None)
    outcome = search_both_ways(two)
    assert outcome.decision.verdict == verdict
    assert outcome.the_other_way is (first == "unknown" and second == "joint_limit")
    # under the same initial state as before, and not at all where something was named
    assert asked == ([("dynamic_2", "dynamic_1", True)] if first == "unknown" else [])


@pytest.mark.parametrize(("left", "explained"), [(2_900.0, True), (10_000.0, True), (40_000.0, False)])
def test_a_trial_that_nothing_explains_is_not_explained_by_fits_to_the_other(left, explained):
    plain = Hypothesis((), np.zeros(12), (102_880.0, 90_000.0))
    sets = [Hypothesis((), np.zeros(12), (left, 80_000.0))]
    pair = SimpleNamespace(samples_by_sensor=((2880,), (2880,)), on_floor=lambda sd: (False,))
    found = Found(pair, Attribution(plain, sets, [], (2880, 2880), None))
    assert trials_module.explains_fitted(found, CONFIG["diagnosis"]) is explained


@pytest.mark.parametrize(
    ("left", "exchanged"),
    [
        ((2500.0, 16_000.0), True),
        ((2500.0, 2900.0), False),  # nobody shows a gap
        ((2500.0, 3250.0), False),  # no law could earn its place there
        ((4000.0, 16_000.0), False),  # both do
        ((16_000.0, 2500.0), False),
    ],
)
def test_the_trial_that_alone_shows_a_gap_is_the_one_to_fit(monkeypatch, left, exchanged):
    pair = Pair(
        *(
            SimpleNamespace(samples=2880, samples_by_sensor=(2880,), noise_by_sensor=(2880.0,), left=x)
            for x in left
        ),
        system=None,
    )

    class Given:
        def __init__(self, evidence, effects, system):
            self.left = evidence.left

        def judged(self, z):
            return (self.left,), 1.0

    monkeypatch.setattr(trials_module, "JointResiduals", Given)
    assert is_shown_by_held_out_alone(pair, np.zeros(12), CONFIG["diagnosis"]) is exchanged


def test_what_is_told_of_the_gap_is_told_of_the_trial_that_shows_it():
    pair = Pair("fitted", "other", system=None)
    assert pair.shown == "other"
    assert replace(pair, exchanged=True).shown == "fitted"


@pytest.mark.parametrize(("left", "key"), [(2880.0, "final_iterations"), (50_000.0, "iterations")])
def test_what_leaves_far_more_than_noise_is_not_fitted_to_its_last_digit(monkeypatch, left, key):
    settings, used = CONFIG["diagnosis"]["search"], []

    def fit(self, effects, start, final=False, tangent=None):
        used.append(self._settings["final_iterations"])
        return Hypothesis(effects, start, (left, left))

    monkeypatch.setattr(Search, "fit", fit)
    monkeypatch.setattr(Search, "is_noise", lambda self, hypothesis: sum(hypothesis.chi2) < 6000)
    finished(None, Hypothesis((), np.zeros(12), (left, left)), settings)
    assert used == [settings[key]]


def test_the_set_that_a_verdict_names_has_converged(monkeypatch):
    """Its form is not the likeliest of all sets: two forms of its effect share."""
    places = {(e.name, e.form): Placed(e, e.places(STRAP)[0], SCALES) for e in EFFECTS}
    left = {("sync_offset", ""): 2883.0, ("filter_lag", ""): 2880.0, ("filter_lag", "first_order"): 2880.5}
    found = [Hypothesis((places[key],), np.zeros(13), (2880.0, chi2)) for key, chi2 in left.items()]
    attribution = Attribution(Hypothesis((), np.zeros(12), (9e4, 9e4)), found, [], (2880, 2880), None)
    pair = SimpleNamespace(samples_by_sensor=((2880,), (2880,)), on_floor=lambda sd: (False,))
    refitted = []

    def finish(pair, hypothesis, settings):
        refitted.append(hypothesis.key)
        return hypothesis

    monkeypatch.setattr("real2sim.diagnosis.trials.finished", finish)
    monkeypatch.setattr(Found, "fit_rivals_to_both", lambda *given: None)
    decision = conclude(Found(pair, attribution), CONFIG["diagnosis"])
    assert decision.verdict == "filter_lag"
    assert int(np.argmax(decision.sets)) == 0
    assert refitted == ["filter_lag", "sync_offset"], "and so has what may be the cause in its place"


@pytest.mark.parametrize("axes", [1, 2])
def test_credit_does_not_depend_on_which_smaller_sets_were_tried(monkeypatch, axes):
    """Of friction with slack, only the friction was fitted alone: without it only the plain fit would be left."""
    listed = {e.name: e for e in reversed(EFFECTS)}
    own = {
        "coulomb": tuple(
            Placed(listed["coulomb"], w, SCALES) for w in listed["coulomb"].places(STRAP)[:axes]
        ),
        "slack": (Placed(listed["slack"], listed["slack"].places(STRAP)[0], SCALES),),
    }
    left = {("coulomb",): 9000.0, ("slack",): 3500.0, ("coulomb", "slack"): 2880.0}

    def fit_of(*names):
        effects = tuple(placed for name in names for placed in own[name])
        z = np.zeros(12 + sum(len(placed.effect.parameters) for placed in effects))
        return Hypothesis(effects, z, (left[names], left[names]), converged=True)

    found = [fit_of("coulomb", "slack"), fit_of("coulomb")]
    attribution = Attribution(Hypothesis((), np.zeros(12), (9e4, 9e4)), found, [], (2880, 2880), None)
    pair = SimpleNamespace(
        samples_by_sensor=((2880,), (2880,)), on_floor=lambda sd: (False,), train=SimpleNamespace(threads=1)
    )

    def refit(self, effects, start, **more):
        return fit_of(*dict.fromkeys(placed.effect.name for placed in effects))

    monkeypatch.setattr(Search, "fit", refit)
    monkeypatch.setattr(Found, "fit_rivals_to_both", lambda *given: None)
    decision = conclude(Found(pair, attribution), CONFIG["diagnosis"])
    assert [h.names for h in attribution.hypotheses[2:]] == [("slack",)]
    assert decision.probabilities["slack"] > 0.8


def test_strap_parameters_are_called_what_they_are(monkeypatch):
    """Tight; wide; at a bound; known to nothing; moved by noise. What is beyond noise by the curvature widens them."""
    sd, bias = np.full(13, 0.05), np.zeros(13)
    bias[4] = 0.2
    monkeypatch.setattr(
        "real2sim.diagnosis.intervals.corrected", lambda pair, fit, rule: (fit.z - bias, np.diag(sd**2))
    )
    sd[1], sd[3] = 0.2, 0.9
    system = strap_system(ROBOT, CONFIG)
    lower, upper = system.bounds()
    z = (lower + upper) / 2
    z[2] = upper[2]
    lag = next(e for e in EFFECTS if e.name == "replay_lag")
    placed = Placed(lag, lag.places(STRAP)[0], SCALES)
    fit = Hypothesis((placed,), np.append(z, 0.0), (1000.0, 900.0))
    trial = SimpleNamespace(samples=1000, samples_by_sensor=(1000,), noise_by_sensor=(1000.0,))
    pair = Pair(trial, trial, system)
    monkeypatch.setattr(
        "real2sim.diagnosis.intervals.precision_by_noise",
        lambda pair, fit, options: Precision(np.eye(13), np.ones(13)),
    )
    wider = precision_by_fit(pair, fit, 1000, CONFIG["diagnosis"]).wider
    rows = parameter_verdicts(pair, fit, wider, CONFIG)
    verdicts = ["determined", "weak", "at bound", "not determined", "weak"]
    assert [row.verdict for row in rows[:5]] == verdicts
    assert rows[4].bias_ln == pytest.approx(0.2)
    # only a bias that stands out is taken off, and only of what is known
    assert [row.unbiased for row in rows[:4]] == pytest.approx(np.exp(z[:4]))
    assert rows[4].unbiased == pytest.approx(np.exp(z[4] - 0.2))
    assert rows[4].ci95[0] < np.exp(z[4] - 0.2) < rows[4].ci95[1]
    wide = np.hypot(0.05, CONFIG["diagnosis"]["report"]["plant_sd_ln"])
    assert rows[0].ci95 == pytest.approx(np.exp(z[0] + 1.96 * wide * np.array([-1, 1])))
    assert rows[2].ci95[1] == pytest.approx(np.exp(upper[2]))
    worse = replace(fit, chi2=(9000.0, 900.0))
    again = parameter_verdicts(
        pair, fit, precision_by_fit(pair, worse, 1000, CONFIG["diagnosis"]).wider, CONFIG
    )
    assert again[0].verdict == "weak", "three times as wide"
    # a log that is quieter than its floor makes up for none of what the markers leave
    trial = SimpleNamespace(samples=1000, samples_by_sensor=(500, 500), noise_by_sensor=(500.0, 10.0))
    loud = replace(fit, chi2=(1000.0, 900.0), sensors=((990.0, 10.0), (890.0, 10.0)))
    wide = precision_by_fit(Pair(trial, trial, system), loud, 1000, CONFIG["diagnosis"]).wider
    told = parameter_verdicts(pair, fit, wide, CONFIG)
    assert np.diff(np.log(told[0].ci95)) > 1.15 * np.diff(np.log(rows[0].ci95))
    # an SD that cannot be computed says nothing, and least of all that it is small
    sd[0] = np.nan
    lost = parameter_verdicts(pair, fit, wider, CONFIG)
    assert [row.verdict for row in lost[:5]] == ["not determined", *verdicts[1:]]
    assert lost[0].ci95 == pytest.approx(np.exp([lower[0], upper[0]]))


def test_score_counts_what_is_right_and_what_is_wrong(tmp_path):
    made = [
        _case("C0001", "in_library", ["slack"], "slack", tmp_path),
        _case("C0002", "in_library", ["coulomb"], "relaxation", tmp_path),
        _case("C0003", "null", [], NONE, tmp_path),
        _case("C0004", "null", [], "slack", tmp_path),
        _case("C0005", "out_of_library", ["push"], UNKNOWN, tmp_path),
        _case("C0006", "mixture", ["slack", "coulomb"], "slack", tmp_path),
        _case("C0007", "mixture", ["slack", "creep"], "slack", tmp_path),
        _case("C0008", "shared_axis", ["slack", "coulomb"], UNKNOWN, tmp_path),
        _case("C0009", "shared_axis", ["slack", "creep"], "slack", tmp_path),
    ]
    for effect, alone in zip(made[6][0]["effects"], (1.0, 0.01), strict=True):
        effect["visibility"] = {"alone": alone}
    truth, answers = tmp_path / "truth.json", tmp_path / "answers.json"
    truth.write_text(json.dumps({"cases": [t for t, _ in made]}))
    answers.write_text(json.dumps({"answers": [str(path) for _, path in made]}))
    score_diagnosis(answers=[answers], truths=[truth], suite="test", out=tmp_path / "score.json")
    score = json.loads((tmp_path / "score.json").read_text())
    claims = {row["claim"]: row for row in score["targets"]}
    assert claims["cause, top-1, rho >= 0.2"]["value"] == 0.5
    assert claims["ambiguity group, rho >= 0.2"]["value"] == 1.0
    assert claims["false alarm on null"]["value"] == 0.5
    assert not claims["false alarm on null"]["met"]
    assert claims["out of library: unknown"]["value"] == 1.0
    assert claims["mixture: exact set"]["value"] == 0.0
    assert claims["pair on one axis: unknown"]["value"] == 0.5
    assert claims["pair on one axis: another set, sure and not marked"]["value"] == 0.5
    assert claims["mixture of two that each can be seen: exact set"]["n"] == 1
    # six of nine are not wholly right: two that are wrong, one `unknown` and three pairs of which one name is missing
    surer = claims["every answer surer than 90 %: right"]
    assert (surer["value"], surer["n"], surer["met"]) == (pytest.approx(3 / 9), 9, False)
    named = claims["every answer surer than 90 %: right, or one of two causes named first"]
    assert (named["value"], named["n"]) == (pytest.approx(6 / 9), 9)
    single = claims["right where surer than 90 %: one cause or none, neither left out nor a random law"]
    assert (single["value"], single["n"]) == (pytest.approx(3 / 5), 5)
    assert {row["case"] for row in score["wrong"]} == {"C0002", "C0004", "C0008"}
    assert [row["name"] for row in score["baselines"]] == ["this diagnosis", "always none", "AIC"]
    assert score["baselines"][1] == {
        "name": "always none",
        "top1": 0.0,
        "false_alarm": 0.0,
        "wrong_name_out_of_library": 0.0,
        "right_of_all": 0.4,
    }
    assert score["baselines"][2]["top1"] == 0.5
    assert score["baselines"][2]["false_alarm"] == 0.5
    # large and fast: said and so; small and fast: so, but not said; large and slow: said of one case, but not so
    assert claims["where: regime F1"]["n"] == 2
    assert claims["where: regime F1"]["value"] == pytest.approx(2 * 2 / (3 + 4))
    # the oracle of slack is the better of its two refits; coulomb was never refitted, and the floor stands for it
    assert claims["gap closed on the held-out regime, median"]["value"] == pytest.approx(
        np.mean([1 / 0.9, 1.0])
    )
    assert claims["gap closed of what lies above the estimated floor, median"]["met"] is None
    sure = claims["RMS ln-error of the determined K, D cut by (median)"]
    assert sure["value"] == pytest.approx(np.log(800 / 700) / np.log(710 / 700))
    assert claims["RMS ln-error of K, D cut by (median)"]["value"] < sure["value"], "with what nobody knows"
    held = claims["95 % intervals of the determined K, D hold the truth"]
    assert (held["value"], held["n"]) == (1.0, 2), "of one right answer in the catalogue and one null"
    sizes = claims["95 % intervals of an effect's parameters hold the truth"]
    assert (sizes["value"], sizes["n"]) == (0.0, 1), "of one right answer"
    effects = {row["effect"]: row for row in score["per_effect"]}
    assert effects["slack"]["smallest_rho"] == 0.2
    assert effects["slack"]["smallest_severity"] == 0.3
    assert effects["coulomb"]["smallest_rho"] is None
