"""Answers as plain text."""

import copy
from types import SimpleNamespace

import pytest
from real2sim.api import Diagnosis
from real2sim.diagnosis.stated import answer_probability
from real2sim.pages.answer_text import answer_text, lines_of
from real2sim.recording.formats.recordings import Finding

CONTENT = {
    "verdict": "coulomb",
    "verdict_set": ["coulomb", "preload"],
    "probabilities": {"coulomb": 0.6, "preload": 0.35, "none": 0.0, "unknown": 0.05},
    "considered": [
        {"effects": ["preload", "coulomb"], "probability": 0.9},
        {"effects": ["coulomb", "preload"], "probability": 0.05},
        {"effects": ["coulomb"], "probability": None},
    ],
    "gap": {"chi2_plain": [900.0, 5000.0], "chi2_best": [480.0, 510.0], "chi2_expected": [500, 500]},
    "causes": [
        {
            "effect": "coulomb",
            "axes": ["tx", "tz"],
            "probability": 0.6,
            "gap_closed": 0.98,
            "with": ["preload"],
            "parameters": {"level_tx_N": {"value": 12.3456, "unit": "N", "ci95": [11.0, 13.0]}},
        },
        {
            "effect": "preload",
            "axes": [],
            "probability": 0.35,
            "gap_closed": None,
            "with": [],
            "parameters": {"force_tx_N": {"value": -3.0, "unit": "N"}},
        },
        {"effect": "slack", "axes": [], "probability": 0.001, "with": [], "parameters": {}},
    ],
    "misfit": {"marked": True, "left_sd": [1.0, 12.4]},
    "free_form": None,
    "parameters": {
        "k_tx": {"with_effect": 800.0, "unit": "N/m", "ci95": [790.0, 810.0], "verdict": "determined"},
        "d_ry": {"with_effect": 2.0, "unit": "Nms/rad", "ci95": None, "verdict": "not determined"},
    },
    "next_trial": "move forward by 74 mm within 0.5 s, " * 4,
}


def test_an_answer_says_cause_numbers_doubt_and_next_trial():
    lines = answer_text("exo", CONTENT, ("slow", "fast")).split("\n")
    assert lines[:10] == [
        "exo: coulomb and preload, probability 0.950",
        "Otherwise: unknown 0.050",
        "Left of each recording, in units of noise (1: noise alone):",
        "  slow, fitted    1.8 by the plain model  0.96 with what was found",
        "  fast, held out  10 by the plain model   1.02 with what was found",
        "coulomb along tx and tz: probability 0.600, takes away 98 % of J above noise, with preload",
        "  level_tx_N  12.35 N  11 to 13",
        "preload: probability 0.350",
        "  force_tx_N  -3 N",
        "Its form may not be right: it leaves up to 12 standard deviations of noise.",
    ]
    assert lines[10:13] == [
        "Parameters of the model:",
        "  k_tx  800 N/m    790 to 810  determined",
        "  d_ry  2 Nms/rad              not determined",
    ]
    assert lines[13].startswith("To be recorded next: move forward")
    assert max(map(len, lines[13:])) <= 100
    assert "slack" not in "\n".join(lines)


def test_a_printed_answer_names_its_recordings_and_warns():
    pair = SimpleNamespace(train=SimpleNamespace(name="fast"), held_out=SimpleNamespace(name="slow"))
    answer = SimpleNamespace(found=SimpleNamespace(pair=pair), to_dict=lambda: CONTENT)
    odd = [
        Finding("step_coarse", kind, "slow", "k_x", "half the step", "Used.") for kind in ("warning", "info")
    ]
    lines = str(Diagnosis(SimpleNamespace(name="exo"), answer, tuple(odd))).split("\n")
    assert lines[3].startswith("  fast, fitted")
    assert lines[-1] == "Warning: slow, k_x: half the step. Used."
    assert "Info" not in "".join(lines)


def test_none_says_from_which_size_effects_would_have_been_seen():
    content = copy.deepcopy(CONTENT) | {
        "verdict": "none",
        "verdict_set": ["none"],
        "causes": [],
        "parameters": {},
    }
    content |= {"misfit": None, "next_trial": None}
    content["probabilities"]["none"] = 0.99
    lines = answer_text("exo", content, ("slow", "fast")).split("\n")
    assert lines[0] == "exo: none, probability 0.990"
    assert len(lines) == 5
    entry = {"effect": "coulomb", "axes": ["x"], "parameter": "level", "from": 0.123, "unit": "N"}
    content["could_show"] = [entry, entry | {"effect": "tilt", "axes": [], "from": None}]
    lines = answer_text("exo", content, ("slow", "fast")).split("\n")
    assert lines[5:] == [
        "Would have been seen from:",
        "  coulomb x  level  0.12 N",
        "Does not show at any size that is searched: tilt",
    ]


def test_a_set_has_the_probability_of_its_own_rows_and_not_of_its_names():
    sets = {("preload", "slack"): 0.456, ("preload", "tilt"): 0.279, ("preload", "coulomb"): 0.253}
    content = {
        "verdict": "preload",
        "verdict_set": ["preload", "slack"],
        "probabilities": {
            "preload": 0.834,
            "slack": 0.071,
            "coulomb": 0.039,
            "tilt": 0.043,
            "unknown": 0.013,
        },
        "considered": [{"effects": list(names), "probability": p} for names, p in sets.items()],
    }
    assert answer_probability(content) == 0.456
    both = content | {"otherwise": {"verdict_set": ["preload"], "named_probability": 0.1}}
    assert answer_probability(both) == pytest.approx(0.556), "the same set under the other initial state"


def test_an_answer_beside_another_robot_counts_that_robot_once():
    content = {
        "verdict": "slack",
        "verdict_set": ["slack"],
        "probabilities": {"slack": 0.7, "none": 0.3},
        # 0.2 of the 0.7 are slack with the configured robot
        "considered": [{"effects": ["slack"], "probability": 0.5}],
        "machine": {"name": "other", "probability": 0.52},
    }
    assert answer_probability(content) == 0.5
    assert answer_probability(content | {"machine": {"name": "configured", "probability": 0.52}}) == 0.7
    nothing = content | {"verdict": "none", "verdict_set": ["none"]}
    assert answer_probability(nothing) == 0.3
    sure = nothing | {"probabilities": {"none": 0.9}}
    assert answer_probability(sure) == 0.52, "no surer than that it is this robot"


def test_cells_stand_below_each_other():
    assert lines_of([["a", "bb"], ["ccc", ""]]) == ["a    bb", "ccc"]
