"""A measured law on the page of a diagnosis: one sentence, its curve with a band, its equation."""

from __future__ import annotations

import math
from collections.abc import Mapping
from html import escape
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from real2sim.pages import style
from real2sim.pages.page import page_style, paragraph, percent, picture, rounded, section, table

_DEGREES = 180 / math.pi
# Variables in words; coordinates and rates of the interface keep their names
_VARIABLES = {
    "pelvis_tilt": "the pelvis' tilt",
    "pelvis_list": "the pelvis' list",
    "pelvis_heading": "the pelvis' heading",
    "pelvis_height": "the pelvis' height",
    "pelvis_speed": "the walking speed",
    "place_x": "the robot's place along x",
    "place_y": "the robot's place along y",
    "heading": "the robot's heading",
    "speed_x": "the robot's speed along x",
    "speed_y": "the robot's speed along y",
    "heading_rate": "the rate of the robot's heading",
    "rate": "the rate of the path",
    "time": "time",
}


def law_section(law: Mapping[str, Any] | None, *, phantom: bool) -> list[str]:
    """Return the section of a measured law, nothing without one; ``law`` is ``free_form`` of diagnosis.json."""
    if law is None:
        return []
    parts = [paragraph(law_sentence(law))]
    if law["curve"] is not None:
        parts += ['<div class="grid">', _picture(law["curve"], phantom=phantom), "</div>"]
    if law["equation"]:
        parts.append(_equation(law))
    return [section("law", "The law that was measured", *parts)]


def law_words(law: Mapping[str, Any]) -> str:
    """Return kind and place of a law in a few words, for a row of a table."""
    if law["kind"] == "measurement":
        return "interface markers displaced" if law["stage"] == "output" else "segment displaced"
    return f"{law['kind']} along {' and '.join(law['axes'])}"


def law_sentence(law: Mapping[str, Any]) -> str:
    """Return place, variables, kind and share of the gap of a law, and what it does not claim, in plain words."""
    if law["kind"] == "measurement":
        on = " and ".join(_words(name) for name in law["depends_on"])
        what = "interface markers" if law["stage"] == "output" else "segment's path"
        text = f"The gap looks like a displacement of the {what} that depends on {on}"
    else:
        text = f"The gap looks like a force along {' and '.join(law['axes'])} {_dependence(law)}"
    if law["gap_closed"] is not None and law["gap_closed"] >= 1:
        text += "; with it J is no more than noise alone costs"
    elif law["gap_closed"] is not None:
        low, high = (percent(x).removesuffix(" %") for x in law["gap_closed_ci95"])
        text += (
            f"; with it J falls by {percent(law['gap_closed'])} ({low} to {high}) of what lies above noise"
        )
    else:
        text += f"; it takes away {percent(law['chi2_closed'])} of what chi-squared has above noise"
    if law.get("own_history_in_each_trial"):
        text += "; nothing that was recorded predicts it, so that its history was fitted on both trials. "
    else:
        text += " on the trial that it was not fitted to. "
    if law["nearest"] is not None and law["nearest"]["gap_closed"] is not None:
        closest = law["nearest"]
        share = percent(closest["gap_closed"])
        text += f"The best set of names, {closest['effect']}, takes away {share} of J above noise. "
    if len(law["families"]) > 1:
        text += f"{len(law['families'])} such laws act together: this one is missed most, the table has them all. "
    return text + (
        "It describes what these trials show, within the range that the fitted one visited. It is no proof of a cause."
    )


def _dependence(law: Mapping[str, Any]) -> str:
    """Return the variables of a force and its kind, in words."""
    others = [_words(name) for name in law["depends_on"] if name != "time"]
    if not law.get("own_history_in_each_trial"):
        on = " and ".join(_words(name) for name in law["depends_on"])
        return f"that depends on {on} ({law['kind']})"
    gained = f", times {' and '.join(others)}," if others else ""
    return f"with a history of its own in each trial{gained} ({law['kind']})"


def misfit_sentence(misfit: Mapping[str, Any] | None) -> str:
    """Return what a named cause leaves, nothing where that is no more than noise; ``misfit`` is of diagnosis.json."""
    if misfit is None or not misfit["marked"]:
        return ""
    fitted, held_out = (rounded(x, 2) for x in misfit["left_sd"])
    closed = f"{100 * (1 - misfit['left_share']):.3g}"
    text = (
        f"What is named takes away {closed} % of chi-squared above noise, and is not all: {fitted} (fitted trial) and "
        f"{held_out} (held-out trial) standard deviations of noise are left{_in_sensor(misfit)}"
    )
    law = misfit["law"]
    if law is None:
        return f"{text}, which no law of one kind explains."
    size = (
        "a force" if law["size"] is None else f"{rounded(law['size']['rms'], 2)} {law['size']['unit']} (RMS)"
    )
    return f"{text}: {size} along {' and '.join(law['axes'])} {_dependence(law)}."


def _in_sensor(misfit: Mapping[str, Any]) -> str:
    """Return the sensor where most is left, in words; nothing in answers from before sensors were told apart."""
    return f", most of it in the {misfit['sensor']}" if misfit.get("sensor") else ""


def _words(name: str) -> str:
    if name.startswith("history of "):
        return f"the history of {_words(name.removeprefix('history of '))}"
    if name.startswith("acceleration_"):
        return f"the interface's acceleration along {name.removeprefix('acceleration_')}"
    return _VARIABLES.get(name, name)


def law_figure(curve: Mapping[str, Any], *, phantom: bool) -> Figure:
    """Return the figure of a measured law: ``curve`` of ``free_form``, force over its variable with the 95 % band."""
    unit = curve["unit"]
    factor, shown = {"m": (1e3, "mm"), "rad": (_DEGREES, "deg")}.get(unit, (1.0, unit))
    if unit == "rad/s":
        factor, shown = _DEGREES, "deg/s"
    grid = factor * np.array(curve["grid"])
    figure = style.new_figure(2.6, phantom=phantom)
    axes = figure.subplots()
    axes.axhline(0, color=style.GREY, linewidth=0.6)
    axes.fill_between(
        grid, curve["low"], curve["high"], color=style.BLUE, alpha=0.25, label="95 % band", linewidth=0
    )
    axes.plot(grid, curve["mean"], color=style.BLUE, label="measured law")
    axes.set_xlabel(f"{curve['variable']} [{shown}]")
    axes.set_ylabel(f"{curve['quantity']} [{curve['quantity_unit']}]")
    axes.legend()
    return figure


def _picture(curve: Mapping[str, Any], *, phantom: bool) -> str:
    with page_style():
        figure = law_figure(curve, phantom=phantom)
        caption = (
            "The measured law over the range that the fitted trial visited, without its linear part: that is stiffness "
            "or damping of the axis."
        )
        alt = f"{curve['quantity']} over {curve['variable']} with its band"
        return picture(figure, "law", alt, caption)


def _equation(law: Mapping[str, Any]) -> str:
    rows = [
        [
            escape(row["on"]),
            escape(row["term"]),
            rounded(row["value"]),
            f"{rounded(row['ci95'][0])} to {rounded(row['ci95'][1])}",
            escape(row["unit"]),
        ]
        for row in law["equation"]
    ]
    caption = "Terms that carry most of each law on the fitted trial, with 95 % intervals"
    return table(["On", "Term", "Value", "95 %", "Unit"], rows, caption=caption, numeric=(2,))
