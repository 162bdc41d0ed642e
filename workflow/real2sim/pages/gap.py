"""Figure of the cohort's gaps: how far everyone's plain model is off, how far the diagnosed one, and noise alone."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes

from real2sim.artefacts import read_json
from real2sim.pages import style

_KEYS = ("subject", "verdict", "verdict_set", "probabilities", "gap", "phantom")
_ROW_IN, _FRAME_IN = 0.32, 1.0


def gap_figure(*, diagnoses: list[Path], out: list[Path]) -> None:
    """Draw chi-squared per residual of everyone's held-out trial: plain and with the diagnosed cause; noise alone is 1.

    ``diagnoses`` are files diagnosis.json. Of more people than a page holds, those with the largest gap are shown.
    """
    answers = [read_json(path, _KEYS) for path in diagnoses]
    answers.sort(key=lambda d: per_residual(d, "plain"))
    shown = sorted(answers[-style.NAMED_PEOPLE :], key=lambda d: str(d["subject"]), reverse=True)
    with matplotlib.rc_context(style.RC):
        height = _FRAME_IN + _ROW_IN * max(len(shown), 2)
        figure = style.new_figure(height, phantom=any(d["phantom"] for d in answers))
        axes = figure.subplots()
        if shown:
            _gaps(axes, shown)
            figure.legend(loc="outside lower center", ncols=3, columnspacing=0.9)
        else:
            style.say(axes, "nobody was diagnosed: it takes two dynamic trials")
        style.save(figure, out)


def _gaps(axes: Axes, answers: list[dict[str, Any]]) -> None:
    place = np.arange(len(answers))
    plain, cause = (np.array([per_residual(d, key) for d in answers]) for key in ("plain", "best"))
    axes.hlines(place, cause, plain, color=style.GREY, linewidth=1.2)
    axes.axvline(1.0, color=style.BLACK, linewidth=0.9, linestyle="--", label="noise alone")
    axes.plot(plain, place, "o", color=style.VERMILION, markersize=6, label="plain model")
    axes.plot(cause, place, "D", color=style.BLUE, markersize=4.5, label="with the cause")
    low, high = min(1.0, cause.min()), max(1.0, plain.max())
    # room for the words to the right of the points
    left, right = low / 1.4, high * (high / low + 2) ** 0.75 * 1.6
    axes.set_xscale("log")
    axes.set_xlim(left, right)
    style.log_axis(axes.xaxis, left, right)
    for d, x, y in zip(answers, plain, place, strict=True):
        axes.annotate(_answer(d), (x, y), (8, 0), textcoords="offset points", va="center", fontsize=7)
    axes.set_yticks(place, [d["subject"] for d in answers])
    axes.set_ylim(-0.6, len(answers) - 0.4)
    axes.set_xlabel("misfit of the held-out trial (chi-squared per residual)")


def per_residual(d: dict[str, Any], which: str) -> float:
    """Return chi-squared per residual [1] of the held-out trial of diagnosis.json; ``which`` is plain or best."""
    return float(d["gap"][f"chi2_{which}"][1] / d["gap"]["chi2_expected"][1])


def _answer(d: dict[str, Any]) -> str:
    words = " + ".join(name.replace("_", " ") for name in d["verdict_set"] or [d["verdict"]])
    return f"{words} ({100 * d['probabilities'][d['verdict']]:.0f} %)"
