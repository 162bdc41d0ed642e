"""Figure of the cohort's gaps: how far everyone's plain model is off, how far the diagnosed one, and noise alone."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes

from real2sim.artefacts import read_json
from real2sim.diagnosis.stated import answer_probability
from real2sim.pages import style
from real2sim.pages.diagnosis import answer_words, chi2_per_residual, is_shown_by_fitted
from real2sim.pages.page import likely

_KEYS = ("subject", "verdict", "probabilities", "gap", "misfit", "train", "held_out", "phantom")
_ROW_IN, _FRAME_IN = 0.36, 1.0
# Characters of an answer in a line: what stands right of the line of noise, however small the gaps are
_LABEL_WIDTH = 38


def gap_figure(*, diagnoses: list[Path], out: list[Path]) -> None:
    """Draw chi-squared per residual of everyone's held-out trial: plain and with cause or law; noise alone leaves 1.

    ``diagnoses`` are files diagnosis.json. Where the fitted trial alone shows the gap, it is drawn and marked. Of more
    people than a page holds, those with the largest gap are shown.
    """
    answers = [read_json(path, _KEYS) for path in diagnoses]
    told = [(d, both) for d in answers if (both := chi2_per_residual(d)) is not None]
    largest = sorted(told, key=lambda one: one[1][0])[-style.NAMED_PEOPLE :]
    shown = sorted(largest, key=lambda one: str(one[0]["subject"]), reverse=True)
    with matplotlib.rc_context(style.RC):
        height = _FRAME_IN + _ROW_IN * max(len(shown), 2)
        figure = style.new_figure(height, phantom=any(d["phantom"] for d in answers))
        axes = figure.subplots()
        if shown:
            _gaps(axes, shown)
            figure.legend(loc="outside lower center", ncols=2, columnspacing=0.9)
        else:
            style.say(axes, "nobody was diagnosed: it takes two dynamic trials")
        style.save(figure, out)


def _gaps(axes: Axes, shown: Sequence[tuple[dict[str, Any], tuple[float, float]]]) -> None:
    place = np.arange(len(shown))
    plain, cause = np.array([both for _, both in shown]).T
    axes.hlines(place, cause, plain, color=style.GREY, linewidth=1.2)
    axes.axvline(1.0, color=style.BLACK, linewidth=0.9, linestyle="--", label="noise alone")
    axes.plot(plain, place, "o", color=style.VERMILION, markersize=6, label="plain model")
    marked = np.array([bool(d["misfit"] and d["misfit"]["marked"]) for d, _ in shown])
    diamond: dict[str, Any] = {"marker": "D", "linestyle": "", "color": style.BLUE, "markersize": 4.5}
    for which, face, label in (
        (~marked, style.BLUE, "with cause or law"),
        (marked, "white", "the same, misfit mark"),
    ):
        if which.any():
            axes.plot(cause[which], place[which], **diamond, markerfacecolor=face, label=label)
    low, high = min(1.0, cause.min()), max(1.0, plain.max())
    left, right = low / 1.4, high * 1.4
    axes.set_xscale("log")
    axes.set_xlim(left, right)
    style.log_axis(axes.xaxis, left, right)
    words = [f"{answer_words(d)} ({likely(answer_probability(d))})" for d, _ in shown]
    labels = ["\n".join(textwrap.wrap(text, _LABEL_WIDTH)) for text in words]
    for text, y in zip(labels, place, strict=True):
        # right of the line of noise; the axes stay as wide for any answer
        beside = axes.annotate(
            text, (1.0, y + 0.2), (4, 0), textcoords="offset points", va="bottom", fontsize=7, linespacing=1.0
        )
        beside.set_in_layout(False)
    exchanged = [is_shown_by_fitted(d) for d, _ in shown]
    names = [f"{d['subject']}{'*' * other}" for (d, _), other in zip(shown, exchanged, strict=True)]
    axes.set_yticks(place, names)
    lines = labels[-1].count("\n") + 1
    axes.set_ylim(-0.5, len(shown) - 0.6 + 0.3 * lines)
    about = "misfit of the held-out trial (chi-squared per residual)"
    axes.set_xlabel(about + "\n* of the fitted trial, which alone shows the gap" * any(exchanged))
