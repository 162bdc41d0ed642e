"""The pages of a diagnosis and of a suite's score: whole, valid, telling every cause, loading nothing."""

import re
from html.parser import HTMLParser

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from real2sim.__main__ import main
from real2sim.artefacts import number, read_table, write_json
from real2sim.diagnosis.stated import answer_probability
from real2sim.errors import InputError
from real2sim.geometry import AXES, INTERFACE_MARKERS
from real2sim.pages.diagnosis import (
    _model,
    answer_words,
    chi2_closed,
    diagnosis_page,
    diagnosis_table,
    digest,
)
from real2sim.pages.page import likely
from real2sim.pages.style import PHANTOM_LABEL
from real2sim.pages.suite import suite_page

VOID = {"meta", "br"}


class _Page(HTMLParser):
    """Tags closed in order, ids once, text, what it would load, headings and pictures without words."""

    def __init__(self):
        super().__init__()
        self.open, self.ids, self.references, self.text, self.headings, self.wordless = [], [], [], "", [], 0

    def handle_starttag(self, tag, attrs):
        given = dict(attrs)
        self.ids += [given["id"]] if "id" in given else []
        self.references += [given[k] for k in ("src", "href", "srcset", "data", "action") if k in given]
        self.headings += [int(tag[1])] if re.fullmatch("h[1-6]", tag) else []
        self.wordless += tag == "svg" and not given.get("aria-label")
        if tag not in VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag, attrs):
        self.handle_starttag(tag, attrs)
        if tag not in VOID:
            self.open.pop()

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        self.text += data


def _parsed(path):
    content = path.read_text(encoding="utf-8")
    page = _Page()
    page.feed(content)
    assert page.open == []
    assert len(page.ids) == len(set(page.ids))
    assert all(r.startswith("#") and r[1:] in page.ids for r in page.references)
    assert all(r in page.ids for r in re.findall(r"url\(#([^)]+)\)", content))
    assert not re.search(r"https?:|<script|@import|url\((?!#)|nan\b", content)
    assert page.headings[0] == 1
    assert page.headings.count(1) == 1
    assert page.wordless == 0
    assert "prefers-color-scheme: dark" in content
    return page


def _diagnosis(verdict="slack", phantom=True, causes=("slack", "soft_tissue"), **changes):
    named = verdict not in ("none", "unknown")
    probabilities = dict.fromkeys(("slack", "soft_tissue", "tilt", "none", "unknown"), 0.02) | {verdict: 0.92}
    cause = {"axes": ["ty"], "stage": "interface", "equation": "F < k & q", "with": [], "group": "A"}
    width = {"value": 0.0081, "unit": "m", "ci95": [0.0062, 0.0104]}
    base, floor = (0.61, 0.12) if verdict != "none" else (0.119, 0.12)
    return {
        "schema": 1,
        "subject": "S01",
        "phantom": phantom,
        "refused_gates": {},
        "robot_holds": "start pose",
        "otherwise": None,
        "pelvis_markers_jumped_s": {},
        "limits_crossed": {},
        "fitted_the_other_way": False,
        "train": ["dynamic_1"],
        "held_out": ["dynamic_2"],
        "noise_floor": {
            "J": floor,
            "ci95": [0.1, 0.15],
            "source": "noise",
            "residual_sd_m": {"IF_R_z": 2e-4},
        },
        "gap": {
            "J_base": base,
            "J_floor": floor,
            "visibility": 4.1,
            "J_with_effect": 0.169 if named else base,
            "chi2_plain": [900, 800],
            "chi2_best": [110, 120],
            "chi2_expected": [100, 100],
        },
        "where": {
            "stage": "interface",
            "stages": {"interface": 0.94, "input": 0.02},
            "axes": dict.fromkeys(AXES, 0.04) | {"ty": 0.8},
            "sides": {"L": 0.5, "R": 0.5},
            "terms": {"position": 0.4, "velocity": 0.6},
            "world_axes": {"x": 0.1, "y": 0.9, "z": 0.0},
            "times": [{"from_s": 0.0, "to_s": 6.0, "share": 1.0}],
            "bands_hz": [{"from_hz": 0.0, "to_hz": 12.0, "share": 1.0}],
            "regimes": [{"bin": "large amplitude, slow", "share": 1.0}],
        },
        "causes": [
            cause
            | {"effect": name, "probability": probabilities[name], "parameters": {"half_width_ty_m": width}}
            | ({"J_held_out": 0.169, "gap_closed": 0.9, "gap_closed_ci95": [0.8, 1.0]} if i == 0 else {})
            for i, name in enumerate(causes)
        ],
        "probabilities": probabilities,
        "verdict": verdict,
        "verdict_set": [verdict],
        "ambiguity_group": [verdict, "soft_tissue"] if named else [verdict],
        "next_trial": "one motion at three amplitudes" if named else None,
        "parameters": {
            "k_tx": {
                "base": 725.0,
                "with_effect": 8000.0 if named else 725.0,
                "unit": "N/m",
                "ci95": [7123.0, 8000.0],
                "bias_ln": 0.0,
                "verdict": "at bound",
            },
            "d_tx": {
                "base": 40.0,
                "with_effect": 39.0 if named else 40.0,
                "unit": "Ns/m",
                "ci95": [12.0, 81.0],
                "bias_ln": 0.4,
                "verdict": "weak",
            },
        },
        "settings": {},
        "provenance": {
            "inputs_sha256": {"/a/pose.parquet": "ab" * 32},
            "python": "3.11",
            "packages": {"numpy": "2"},
        },
    } | changes


def _write(folder, diagnosis):
    """Files of a diagnosis whose plain model errs most at the right marker, up."""
    folder.mkdir(exist_ok=True)
    write_json(folder / "diagnosis.json", diagnosis)
    time = np.arange(300) / 100
    columns = {"time_s": time}
    for marker in INTERFACE_MARKERS:
        for axis in "xyz":
            measured = np.sin(time)
            error = (0.003 if (marker, axis) == ("IF_R", "z") else 0.001) * np.cos(9 * time)
            measured[100:120] = np.nan
            named = diagnosis["verdict"] not in ("none", "unknown")
            for kind, share in (("measured", 0.0), ("plain", 1.0), ("with_effect", 0.1 if named else 1.0)):
                columns[f"{kind}_{marker}_{axis}"] = measured + share * error
    pq.write_table(pa.table(columns), folder / "traces.parquet")
    return folder / "diagnosis.json", folder / "traces.parquet"


def _page(folder, diagnosis):
    written, traces = _write(folder, diagnosis)
    diagnosis_page(diagnosis=written, traces=traces, out=folder / "diagnosis.html")
    return _parsed(folder / "diagnosis.html")


def test_page_tells_verdict_causes_values_and_what_next(tmp_path):
    text = _page(tmp_path, _diagnosis()).text
    assert "Slack causes the gap with a probability of 92 %" in text
    assert (
        "with the effect in the model the misfit (chi-squared) of the held-out trial dynamic_2 falls from 8 to 1.2"
        in text
    )
    assert "so that 2.9 % of chi-squared above noise is left" in text
    assert (
        "J falls from 0.61 to 0.169 with it, which leaves 10 % [0, 20] of J above what noise alone costs"
        in text
    )
    assert "soft tissue" in text
    assert "F < k & q" in text
    assert "8.1 mm" in text
    assert "[6.2, 10.4]" in text
    assert "[80, 100]" in text
    assert "One motion at three amplitudes." in text
    assert "do not tell slack from soft tissue" in text
    for cell in ("8000", "[7120, 8000]", "at bound", "[12, 81]", "weak"):
        assert cell in text
    assert "Marker IF_R along world z" in text
    assert "noise (2 SD)" in text
    assert "all others together" in text
    assert "2.9 % of chi-squared above noise is left" in text  # (1.2 - 1) / (8 - 1)


def test_page_says_that_the_data_are_synthetic_only_where_they_are(tmp_path):
    assert PHANTOM_LABEL in _page(tmp_path / "a", _diagnosis()).text
    assert PHANTOM_LABEL not in _page(tmp_path / "b", _diagnosis(phantom=False)).text


@pytest.mark.parametrize("causes", [(), ("slack",)])
def test_page_of_no_cause_claims_none(tmp_path, causes):
    text = _page(tmp_path, _diagnosis("none", causes=causes)).text
    assert "No cause is named" in text
    assert "There is no gap to place" in text
    assert "none is needed to tell causes apart" in text
    assert "causes the gap" not in text
    assert "With effect" not in text


def test_page_names_the_gates_that_refuse_what_it_rests_on(tmp_path):
    text = _page(tmp_path, _diagnosis(refused_gates={"S01/dynamic_2": ["spikes", "rate"]})).text
    assert "S01/dynamic_2 is refused by its gates (spikes, rate)" in text
    assert "refused by its gates" not in _page(tmp_path, _diagnosis()).text


def test_the_page_tells_which_pelvis_markers_were_not_believed(tmp_path):
    """What is mended in silence is never labelled again."""
    jumped = {"dynamic_2": {"PSIS_R": 0.34, "ASIS_L": 0.2}}
    text = _page(tmp_path, _diagnosis(pelvis_markers_jumped_s=jumped)).text
    assert "In dynamic_2 pelvis markers jump (PSIS_R for 0.34 s, ASIS_L for 0.2 s)" in text
    assert "markers jump" not in _page(tmp_path, _diagnosis()).text


def test_the_page_tells_which_joint_limits_the_recording_contradicts(tmp_path):
    text = _page(tmp_path, _diagnosis(limits_crossed={"dynamic_1": ["tz lower", "ry upper"]})).text
    assert "dynamic_1 is beyond joint limits of the sweeps (tz lower, ry upper)" in text
    assert "joint limits of the sweeps" not in _page(tmp_path, _diagnosis()).text


def test_page_says_where_the_controller_holds_where_that_is_not_the_start_pose(tmp_path):
    text = _page(tmp_path, _diagnosis(robot_holds="balance")).text
    assert "The robot is taken to have come to rest against the strap before the trials began" in text
    assert "come to rest" not in _page(tmp_path, _diagnosis()).text


def test_page_says_what_the_answer_would_be_for_a_robot_that_was_held_otherwise(tmp_path):
    other = {
        "robot_holds": "start pose",
        "verdict_set": ["preload", "slack"],
        "probability": 0.97,
        "chi2_best": [2500.0, 2600.0],
        "chi2_expected": [2880, 2880],
    }
    text = _page(tmp_path, _diagnosis("none", robot_holds="balance", otherwise=other)).text
    assert (
        "Had the robot been let go at its start pose when the trials began, the answer would be preload and slack"
        in text
    )
    assert "(97 %), which leaves 5100 of chi-squared where noise leaves 5760" in text
    assert "Next trial: The same trials, begun where the strap pulls at nothing" in text
    same = _diagnosis(otherwise=other | {"robot_holds": "balance", "verdict_set": ["slack"]})
    assert "Had the robot been" not in _page(tmp_path, same | {"verdict_set": ["slack"]}).text


def _compared(first, second):
    """The entry ``machine`` of diagnosis.json: two robots with their probability and plain chi-squared of dynamic_2."""
    rows = [
        {
            "name": name,
            "probability": probability,
            "deviance": 0.0,
            "chi2_plain": {"dynamic_1": chi2, "dynamic_2": chi2},
            "chi2_expected": {"dynamic_1": 100, "dynamic_2": 100},
            "J_plain": {"dynamic_1": 0.6, "dynamic_2": 0.6},
            "verdict": None,
        }
        for name, probability, chi2 in (first, second)
    ]
    model = None if first[0] == "configured" else "robots/mine.xml"
    return {"name": first[0], "probability": first[1], "model": model, "compared": rows}


def test_page_says_which_robot_held_the_strap_and_what_it_explains(tmp_path):
    machine = _compared(("study", 0.99, 110.0), ("configured", 0.01, 800.0))
    gap = _diagnosis()["gap"] | {"J_with_effect": 0.169}
    d = _diagnosis("none", machine=machine, causes=(), gap=gap)
    text = _page(tmp_path, d).text
    assert "The plain model with another robot explains the gap" in text
    assert (
        "Not the configured robot held the strap but study (robots/mine.xml), with a probability of 99 %"
        in text
    )
    assert "in units of what noise leaves is 1.1 with study, 8 with the configured one" in text
    assert "The gap lies in the model of the robot" in text
    assert "No cause is named" not in text
    table = tmp_path / "diagnosis.csv"
    diagnosis_table(diagnoses=[tmp_path / "diagnosis.json"], out=table)
    row = read_table(table, ("robot", "stage", "gap_closed"))[0]
    assert (row["robot"], row["stage"]) == ("study", "interface")
    assert float(row["gap_closed"]) == pytest.approx(0.9, abs=1e-6)
    assert answer_words(d) == "another robot, study"
    assert answer_probability(d) == pytest.approx(0.92), "averaged over robots already"
    assert answer_words(d | {"verdict_set": ["tilt"], "verdict": "tilt"}) == "another robot, study + tilt"


def test_page_says_that_the_configured_robot_is_right_or_that_nobody_can_tell(tmp_path):
    certain = _compared(("configured", 0.99, 110.0), ("study", 0.01, 800.0))
    text = _page(tmp_path / "a", _diagnosis(machine=certain)).text
    assert "The configured robot held the strap, with a probability of 99 %, and not study." in text
    even = _compared(("configured", 0.6, 110.0), ("study", 0.4, 120.0))
    text = _page(tmp_path / "b", _diagnosis(machine=even)).text
    assert "do not tell which robot held the strap (the configured one 60 %, study 40 %)" in text
    assert "held the strap" not in _page(tmp_path / "c", _diagnosis()).text


def test_page_says_that_the_trial_with_the_gap_is_the_one_that_was_fitted(tmp_path):
    exchanged = _diagnosis(train=["dynamic_2"], held_out=["dynamic_1"], shown_on=["dynamic_2"])
    text = _page(tmp_path, exchanged).text
    assert "Only dynamic_2 leaves more than noise: effects were fitted on it" in text
    assert "On dynamic_2, J falls" in text
    # chi-squared of the trial that shows the gap, the first of the two
    assert (
        "with the effect in the model the misfit (chi-squared) of dynamic_2 falls from 9 to 1.1 times" in text
    )
    assert "leaves more than noise: effects" not in _page(tmp_path, _diagnosis()).text


def test_page_says_that_the_other_trial_was_fitted_where_nothing_explained_it(tmp_path):
    other_way = {"train": ["dynamic_2"], "held_out": ["dynamic_1"], "shown_on": ["dynamic_1"]}
    text = _page(tmp_path, _diagnosis(fitted_the_other_way=True, **other_way)).text
    assert (
        "Nothing that was fitted to dynamic_1 explains dynamic_2. Effects were fitted to dynamic_2 instead"
        in text
    )
    assert "Nothing that was fitted" not in _page(tmp_path, _diagnosis()).text


def test_page_of_an_unknown_cause_does_not_say_that_all_is_done(tmp_path):
    text = _page(tmp_path, _diagnosis("unknown")).text
    assert "The cause is unknown" in text
    assert "the best of the catalogue takes away 90 % of J above noise" in text
    assert "the catalogue has none for a cause that it does not hold" in text
    assert "needed to tell" not in text


def test_page_of_an_unknown_cause_shows_the_law_that_was_measured(tmp_path):
    text = _page(tmp_path, _diagnosis("unknown", free_form=_law())).text
    assert "a force along ty that depends on q_ty (elastic)" in text
    assert "J falls by 95 % (92 to 97)" in text
    assert "The best set of names, slack, takes away 60 % of J above noise" in text
    assert "It is no proof of a cause" in text
    assert "q_ty^2" in text
    assert "goes beyond the range of what the measured law depends on" in text


def test_an_unknown_cause_is_told_by_its_law_wherever_answers_are_listed(tmp_path):
    d = _diagnosis("unknown", free_form=_law())
    d["gap"] |= {"J_with_effect": 0.145, "chi2_best": [110, 120]}
    assert answer_words(d) == "unknown: elastic along ty"
    assert chi2_closed(d) == pytest.approx(680 / 700)
    text = _page(tmp_path, d).text
    assert "costs J = 0.61 and the model with the measured law 0.145 where noise alone costs 0.12" in text
    assert "The gap lies most likely in the interface law (the strap), along ty." in text
    assert (
        "the measured law in the model the misfit (chi-squared) of the held-out trial dynamic_2 falls from 8 to 1.2"
        in text
    )
    table = tmp_path / "diagnosis.csv"
    diagnosis_table(diagnoses=[tmp_path / "diagnosis.json"], out=table)
    row = read_table(table, ("law", "gap_closed"))[0]
    assert "a force along ty that depends on q_ty (elastic)" in digest(d)
    assert (row["law"], float(row["gap_closed"])) == ("elastic along ty", pytest.approx(0.465 / 0.49))
    # a displacement of markers is no force: the model is the plain one, and its parameters do not move
    own = {"effects": []}
    assert "without an effect: the plain plant" in _model(d | {"model": own})
    moved = {k: {"value": 1.1 * v["base"], "unit": v["unit"]} for k, v in d["parameters"].items()}
    d |= {"free_form": _law() | {"model": {"parameters": moved}}}
    with_force = _page(tmp_path, d).text
    assert "How the parameters move" in with_force
    assert "With measured law" in with_force
    assert "with the measured law, its forces on motors of their own" in _model(d | {"model": own})
    without = _diagnosis("unknown", free_form=None)
    assert answer_words(without) == "unknown"
    assert chi2_closed(without) is None


def _law():
    grid = [-0.01, 0.0, 0.01]
    curve = {
        "variable": "q_ty",
        "unit": "m",
        "quantity": "force along ty",
        "quantity_unit": "N",
        "grid": grid,
        "mean": [-1.0, 2.0, -1.0],
        "low": [-1.5, 1.8, -1.5],
        "high": [-0.5, 2.2, -0.5],
    }
    term = {
        "term": "q_ty^2",
        "on": "strap_ty",
        "value": -8056.0,
        "unit": "N per m^2",
        "ci95": [-8396.0, -7716.0],
    }
    family = {
        "family": "elastic",
        "stage": "interface",
        "kind": "elastic",
        "axes": ["ty"],
        "depends_on": ["q_ty"],
    }
    return family | {
        "families": [family],
        "ln_evidence": 100.0,
        "equation": [term | {"share": 0.99}],
        "curve": curve,
        "model": None,
        "rivals": [],
        "gap_closed": 0.95,
        "gap_closed_ci95": [0.92, 0.97],
        "chi2": [110.0, 120.0],
        "chi2_closed": 0.97,
        "nearest": {
            "effect": "slack",
            "chi2": [300.0, 400.0],
            "gap_closed": 0.6,
            "gap_closed_ci95": [0.5, 0.7],
        },
    }


def test_page_of_an_effect_that_does_not_carry_over_says_so(tmp_path):
    worse = _diagnosis()
    worse["gap"]["J_with_effect"] = 0.9
    assert "it does not help: J goes from 0.61 to 0.9" in _page(tmp_path, worse).text
    worse["gap"]["chi2_best"] = [1000, 900]
    text = _page(tmp_path, worse).text
    assert "goes from 8 to 9 times what noise leaves: it does not help" in text


@pytest.mark.parametrize(("base", "told"), [(0.1225, True), (0.1223, False), (0.119, False)])
def test_no_share_is_told_of_a_gap_that_j_does_not_show(tmp_path, base, told):
    """The causes of such an answer have none either (`diagnosis.report.smallest_gap`)."""
    d = _diagnosis(settings={"diagnosis": {"report": {"smallest_gap": 0.02}}})
    d["gap"] |= {"J_base": base, "J_with_effect": 0.13}
    text = _page(tmp_path, d).text
    assert ("it does not help: J goes from" in text) is told
    said = f"J is {base} without and 0.13 with it where noise alone costs 0.12: J does not show this gap"
    assert (said in text) is not told
    diagnosis_table(diagnoses=[tmp_path / "diagnosis.json"], out=tmp_path / "table.csv")
    assert bool(read_table(tmp_path / "table.csv")[0]["gap_closed"]) is told


def test_page_says_where_the_shares_of_a_gap_are_chance(tmp_path):
    """A gap that chi-squared sees may be next to nothing in J, of which the shares are."""
    d = _diagnosis()
    assert "axes and shares are chance" not in _page(tmp_path, d).text
    d["gap"]["J_base"] = d["noise_floor"]["ci95"][1]
    assert "axes and shares are chance" in _page(tmp_path, d).text


def test_page_of_two_causes_names_both(tmp_path):
    names = ["slack", "soft_tissue"]
    both = _diagnosis(verdict_set=names, probabilities={"slack": 0.5, "soft_tissue": 0.5})
    both["considered"] = [
        {"effects": names, "probability": 0.6},
        {"effects": ["slack", "tilt"], "probability": 0.4},
    ]
    said = "Slack and soft tissue together cause the gap with a probability of 60 %"
    assert said in _page(tmp_path, both).text


def test_page_refuses_a_table_without_traces(tmp_path):
    written, traces = _write(tmp_path, _diagnosis())
    pq.write_table(pq.read_table(traces).drop_columns(["measured_IF_L_x"]), traces)
    with pytest.raises(InputError, match="measured_IF_L_x"):
        diagnosis_page(diagnosis=written, traces=traces, out=tmp_path / "page.html")


def test_pages_are_the_same_bytes_for_the_same_data(tmp_path):
    for name in ("a", "b"):
        _page(tmp_path / name, _diagnosis())
        _suite(tmp_path / name, _score())
    for page in ("diagnosis.html", "suite.html"):
        assert (tmp_path / "a" / page).read_bytes() == (tmp_path / "b" / page).read_bytes()


def test_table_has_a_row_per_person_and_no_stage_where_there_is_no_gap(tmp_path):
    verdicts = ("slack", "none", "unknown")
    paths = [_write(tmp_path / v, _diagnosis(v, subject=v))[0] for v in verdicts]
    out = tmp_path / "table.csv"
    assert main(["diagnosis-table", "--diagnoses", *map(str, paths), "--out", str(out)]) == 0
    slack, none, unknown = read_table(out)
    assert [row["verdict"] for row in (slack, none, unknown)] == list(verdicts)
    assert number(slack["gap_closed"]) == pytest.approx(0.9)
    assert (slack["stage"], slack["axes"], slack["phantom"]) == ("interface", "ty", "true")
    assert (none["stage"], none["axes"], none["gap_closed"], unknown["gap_closed"]) == ("", "", "", "")
    diagnosis_table(diagnoses=[], out=out)
    assert read_table(out) == []


def _score(**changes):
    return {
        "schema": 1,
        "suite": "small",
        "phantom": True,
        "cases": 40,
        "targets": [
            {
                "claim": "top-1",
                "value": 0.95,
                "n": 20,
                "wilson95": [0.8, 0.99],
                "target": "≥ 90 %",
                "met": True,
            },
            {
                "claim": "slowest",
                "value": 400.0,
                "n": 40,
                "wilson95": None,
                "target": "≤ 300 s",
                "met": False,
            },
            {
                "claim": "cut by",
                "value": 5.1,
                "n": 31,
                "wilson95": None,
                "target": "none: no bar",
                "met": None,
            },
        ],
        "confusion": {"labels": ["slack", "none", "unknown"], "counts": [[19, 1, 0], [2, 8, 0], [0, 0, 10]]},
        "power": [
            {"rho": r, "n": 10, "top1": t, "wilson95": [0.3, 1.0]} for r, t in ((0.2, 0.9), (0.05, 0.6))
        ],
        "per_effect": [{"effect": "slack", "n": 20, "top1": 19, "smallest_rho": None}],
        "calibration": {
            "bins": [
                {"from": 0.0, "to": 0.1, "n": 0, "mean_probability": 0.0, "fraction_true": 0.0},
                {"from": 0.9, "to": 1.0, "n": 30, "mean_probability": 0.95, "fraction_true": 0.9},
            ],
            "ece": 0.043,
            "set90_coverage": 0.9,
            "set90_mean_size": 1.4,
        },
        "gap_closed": [0.9, 1.0, -3.0, 2.0],
        "baselines": [
            {"name": "this diagnosis", "top1": 0.9, "false_alarm": 0.2},
            {"name": "always <none>", "top1": 0.0, "false_alarm": 0.0},
        ],
        "time_s": {"median": 120.0, "max": 400.0},
    } | changes


def _suite(folder, score):
    folder.mkdir(exist_ok=True)
    write_json(folder / "score.json", score)
    suite_page(score=folder / "score.json", out=folder / "suite.html")
    return _parsed(folder / "suite.html")


def test_suite_page_tells_targets_confusion_and_baselines(tmp_path):
    text = _suite(tmp_path, _score()).text
    assert "1 of 2 targets are met on 40 cases; missed: slowest." in text
    assert "5.1" in text
    assert "510" not in text, "a factor without a target is no percentage"
    assert "95.0 %" in text
    assert "[80.0 %, 99.0 %]" in text
    assert "always <none>" in text
    assert "20.0 %" in text  # two of ten null cases were given a name
    assert "19 (95 %)" in text
    assert "made worse in 25.0 % of 4 cases" in text
    assert PHANTOM_LABEL in text


def test_suite_page_of_an_empty_score_says_what_is_missing(tmp_path):
    none = {"bins": [], "ece": None, "set90_coverage": None, "set90_mean_size": None}
    empty = {name: [] for name in ("targets", "power", "per_effect", "gap_closed", "baselines")}
    score = _score(confusion={"labels": [], "counts": []}, calibration=none, phantom=False, **empty)
    text = _suite(tmp_path, score).text
    for what in (
        "targets",
        "baselines",
        "matrix of confusion",
        "power",
        "bins of probability",
        "shares of gap",
    ):
        assert f"This score has no {what}" in text
    assert PHANTOM_LABEL not in text


def test_suite_page_refuses_a_matrix_that_does_not_fit_its_labels(tmp_path):
    with pytest.raises(InputError, match="one per label"):
        _suite(tmp_path, _score(confusion={"labels": ["slack", "none"], "counts": [[1, 2]]}))


@pytest.mark.parametrize(
    ("probability", "digits", "text"),
    [
        (1.0, 0, "100 %"),
        (0.9999, 0, "over 99 %"),
        (0.994, 0, "99 %"),
        (0.9999, 1, "over 99.9 %"),
        (0.987, 1, "98.7 %"),
        (0.0003, 1, "under 0.1 %"),
        (0.0, 1, "0.0 %"),
    ],
)
def test_what_is_not_quite_certain_is_not_said_to_be(probability, digits, text):
    assert likely(probability, digits) == text


def test_nothing_on_a_page_is_certain_that_is_not(tmp_path):
    others = dict.fromkeys(("soft_tissue", "tilt", "none", "unknown"), 1e-5)
    text = _page(tmp_path, _diagnosis(probabilities={"slack": 1 - 4e-5} | others)).text
    assert "with a probability of over 99 %" in text
    assert "over 99.9 %" in text
