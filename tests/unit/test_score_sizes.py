"""Scores: which intervals of an effect's parameters hold the sealed truth, and what no case says."""

from __future__ import annotations

import pytest
from real2sim.effects.catalogue import EFFECT_NAMES, EFFECTS
from real2sim.verification.claims import claim, figure
from real2sim.verification.score_sizes import SAME, held_sizes
from real2sim.verification.suite.forms import FORMS


def _row(effect, truth, told, verdict=None, form=None, axes=(), answered=""):
    equation = next(e.equation for e in EFFECTS if (e.name, e.form) == (effect, answered))
    case = {"effects": [{"effect": effect, "form": form or effect, "axes": list(axes), "parameters": truth}]}
    parameters = {k: {"value": sum(v) / 2, "ci95": v} for k, v in told.items()}
    causes = [{"effect": effect, "equation": equation, "parameters": parameters}]
    return {"case": case, "names": [effect], "answer": {"verdict": verdict or effect, "causes": causes}}


@pytest.mark.parametrize(
    ("effect", "axes", "truth", "told", "held"),
    [
        ("coulomb", ["ry"], {"friction_ry_Nm": 4.0}, {"force_ry_Nm": [3.9, 4.1]}, [True]),
        ("coulomb", ["ry"], {"friction_ry_Nm": 4.0}, {"force_ry_Nm": [4.01, 4.05]}, [False]),
        ("clock_drift", [], {"rate": 4e-3}, {"drift": [3e-3, 5e-3]}, [True]),
        ("preload", ["tx"], {"shift_tx_m": 0.01}, {"rest_shift_tx_m": [0.02, 0.03]}, [False]),
        (
            "joint_limit",
            ["tx"],
            {"limit_tx_m": 0.01, "side": -1.0},
            {"place_tx_lower_m": [0.0, 0.009]},
            [False],
        ),
        (
            "stiffening",
            ["tx", "ty"],
            {"cubic_tx_N/m3": 1e7, "cubic_ty_N/m3": 4e6},
            {"cubic_ty_N_per_m3": [5e6, 6e6], "cubic_tx_N_per_m3": [0.9e7, 1.1e7]},
            [True, False],
        ),
        # the stiffness of a side that pulls alone is no number of the catalogue's equation
        ("one_sided", ["ty"], {"one_sided_stiffness_ty_N/m": 6562.0}, {"share_ty_lower": [0.9, 1.0]}, []),
    ],
)
def test_a_quantity_is_found_under_the_name_that_the_answer_has_for_it(effect, axes, truth, told, held):
    assert held_sizes(_row(effect, truth, told, axes=axes)) == held


def test_what_was_not_named_or_made_otherwise_is_not_counted():
    size, told = {"friction_ry_Nm": 4.0}, {"force_ry_Nm": [3.9, 4.1]}
    assert held_sizes(_row("coulomb", size, told, verdict="lugre", axes=["ry"])) == []
    assert held_sizes(_row("coulomb", size, told, form="coulomb_tanh", axes=["ry"])) == []
    assert held_sizes(_row("coulomb", size, told, axes=["ry"], answered="_smooth")) == []
    turned = {"rest_turn_rx_turned_rad": [-0.2, -0.05]}
    assert held_sizes(_row("preload", {"shift_rx_rad": -0.1}, turned, axes=["rx"], answered="_turned")) == [
        True
    ]
    without = _row("coulomb", size, told, axes=["ry"])
    del without["answer"]["causes"][0]["parameters"]["force_ry_Nm"]["ci95"]
    assert held_sizes(without) == []


def test_every_listed_effect_is_one_that_suites_make_and_the_catalogue_names():
    assert set(SAME) <= set(FORMS)
    assert set(SAME) <= set(EFFECT_NAMES)


def test_what_no_case_was_asked_is_not_met():
    """An average over nothing may be computed as zero, which would meet a target of at most that."""
    rows = [
        claim("share", [], "<= 5 %", lambda v: v <= 0.05),
        figure("error", 0.0, 0, "<= 0.04", lambda v: v <= 0.04),
    ]
    assert [(row["value"], row["met"]) for row in rows] == [(None, False), (None, False)]
    assert figure("error", 0.0, 3, "<= 0.04", lambda v: v <= 0.04)["met"]
