"""Figure of the cohort's gaps: what the plain model costs everyone, what the diagnosed one costs, and noise alone."""

from __future__ import annotations

from pathlib import Path

import matplotlib
import numpy as np
from matplotlib.axes import Axes

from real2sim.artefacts import number, read_table
from real2sim.pages import style

_COLUMNS = (
    "subject",
    "verdict",
    "verdict_set",
    "probability",
    "J_base",
    "J_floor",
    "J_with_effect",
    "phantom",
)
_ROW_IN, _FRAME_IN = 0.32, 1.0


def gap_figure(*, diagnoses: Path, out: list[Path]) -> None:
    """Draw cost J of everyone's held-out trial: plain, with the diagnosed cause, and of noise alone.

    ``diagnoses`` is the table of `diagnosis_table`. Of more people than a page holds, those with the largest plain cost
    over that of noise are shown.
    """
    rows = read_table(diagnoses, _COLUMNS)
    rows.sort(key=lambda row: number(row["J_base"]) / number(row["J_floor"]))
    shown = rows[-style.NAMED_PEOPLE :]
    shown.sort(key=lambda row: row["subject"], reverse=True)
    with matplotlib.rc_context(style.RC):
        height = _FRAME_IN + _ROW_IN * max(len(shown), 2)
        figure = style.new_figure(height, phantom=any(row["phantom"] == "true" for row in rows))
        axes = figure.subplots()
        if shown:
            _gaps(axes, shown)
            figure.legend(loc="outside upper center", ncols=3, columnspacing=0.9)
        else:
            style.say(axes, "nobody has two dynamic trials")
        style.save(figure, out)


def _gaps(axes: Axes, rows: list[dict[str, str]]) -> None:
    place = np.arange(len(rows))
    plain, floor, cause = (
        np.array([number(row[column]) for row in rows]) for column in ("J_base", "J_floor", "J_with_effect")
    )
    axes.hlines(place, cause, plain, color=style.GREY, linewidth=1.2)
    axes.plot(floor, place, "|", color=style.BLACK, markersize=11, markeredgewidth=1.4, label="noise alone")
    axes.plot(plain, place, "o", color=style.VERMILION, markersize=6, label="plain model")
    axes.plot(cause, place, "D", color=style.BLUE, markersize=4.5, label="with the cause")
    low, high = min(floor.min(), cause.min()), max(plain.max(), floor.max())
    # room for the words to the right of the points
    axes.set_xscale("log")
    axes.set_xlim(low / 1.4, high * (high / low + 2) ** 0.75 * 1.6)
    for row, x, y in zip(rows, np.maximum(plain, floor), place, strict=True):
        axes.annotate(_answer(row), (x, y), (8, 0), textcoords="offset points", va="center", fontsize=7)
    axes.set_yticks(place, [row["subject"] for row in rows])
    axes.set_ylim(-0.6, len(rows) - 0.4)
    axes.set_xlabel("cost $J$ of the held-out trial")


def _answer(row: dict[str, str]) -> str:
    named = row["verdict_set"].split() or [row["verdict"]]
    words = " + ".join(name.replace("_", " ") for name in named)
    return f"{words} ({100 * number(row['probability']):.0f} %)"
