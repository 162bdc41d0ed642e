"""Figures of the identification: convergence, ICC and spread, leave-one-out cost (paper Fig. 4)."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from real2sim.artefacts import number, read_json, read_table
from real2sim.inference.parameters import PARAMETERS, parameter_column
from real2sim.pages import style
from real2sim.recording.quality.verdict import overridden_gates


def _phantom(rows: list[dict[str, str]]) -> bool:
    return any(row["phantom"] == "true" for row in rows)


def _overridden(rows: list[dict[str, str]]) -> list[str]:
    return [trial for row in rows for trial in row.get("overridden", "").split()]


def _convergence_panel(axes: Axes, fits: list[dict[str, Any]], floor: float | None) -> None:
    best = min(fits, key=lambda fit: fit["cost"]["J"])
    for fit in [f for f in fits if f is not best] + [best]:
        axes.plot(
            fit["history"]["evaluations"],
            fit["history"]["best"],
            color=style.BLUE if fit is best else style.GREY,
            linewidth=1.4 if fit is best else 0.8,
        )
    if floor is not None:
        axes.axhline(floor, color=style.VERMILION, linestyle="--", linewidth=0.9)
    text = f"{best['subject']}, {best['trial']}\nbest $J$ = {best['cost']['J']:.3g}"
    axes.text(0.97, 0.95, text, transform=axes.transAxes, ha="right", va="top", fontsize=7)


def _least_agreeing(fits: list[dict[str, Any]]) -> list[str]:
    """At most `style.NAMED_PEOPLE` people, in order; where there are more, those whose restarts end farthest apart."""
    costs: dict[str, dict[str, list[float]]] = {}
    for fit in fits:
        costs.setdefault(fit["subject"], {}).setdefault(fit["trial"], []).append(fit["cost"]["J"])
    apart = {name: max(max(v) / min(v) for v in trials.values()) for name, trials in costs.items()}
    return sorted(sorted(apart, key=lambda name: (-apart[name], name))[: style.NAMED_PEOPLE])


def convergence_figure(*, fits: list[Path], floors: list[Path], out: list[Path]) -> None:
    """Draw cost J against evaluations, a row per person and a column per trial.

    Restarts are grey, the best one of each trial is blue (paper, Fig. 4 top); dashed, the person's noise floor of J. Of
    more people than a page holds, those are shown whose restarts end farthest apart.
    """
    floor = {
        record["subject"]: record["J"] for record in (read_json(path, ("subject", "J")) for path in floors)
    }
    records = [read_json(p, ("subject", "trial", "restart", "history", "cost", "phantom")) for p in fits]
    everyone = {fit["subject"] for fit in records}
    people = _least_agreeing(records)
    note = f"{len(people)} of {len(everyone)} people:\nwhose restarts agree least"
    records = [fit for fit in records if fit["subject"] in people]
    floor = {name: value for name, value in floor.items() if name in people}
    trials = sorted({fit["trial"] for fit in records})
    with matplotlib.rc_context(style.RC):
        height = 0.8 + 0.85 * max(len(people), 1)
        figure = style.new_figure(
            height,
            phantom=any(fit["phantom"] for fit in records),
            overridden=overridden_gates(records),
            note=note if len(people) < len(everyone) else "",
        )
        shape = max(len(people), 1), max(len(trials), 1)
        panels = figure.subplots(*shape, sharex=True, sharey=True, squeeze=False)
        if not records:
            style.say(panels[0, 0], "no fits")
        for row, person in zip(panels, people, strict=False):
            for axes, trial in zip(row, trials, strict=True):
                own = [fit for fit in records if (fit["subject"], fit["trial"]) == (person, trial)]
                if own:
                    _convergence_panel(axes, own, floor.get(person))
                else:
                    axes.set_axis_off()
        if records:
            panels[0, 0].set_yscale("log")
            every = np.concatenate([*(fit["history"]["best"] for fit in records), list(floor.values())])
            style.log_axis(panels[0, 0].yaxis, every.min(), every.max())
            for axes in panels[-1]:
                axes.set_xlabel("cost evaluations (1)")
            figure.supylabel(r"cost $J$ (1)", fontsize=7.5)
            lines = {
                "restart": Line2D([], [], color=style.GREY),
                "best restart": Line2D([], [], color=style.BLUE, linewidth=1.4),
                "noise floor": Line2D([], [], color=style.VERMILION, linestyle="--", linewidth=0.9),
            }
            figure.legend(lines.values(), lines.keys(), loc="outside lower center", ncols=3)
        style.save(figure, out)


def _icc_panel(axes: Axes, rows: list[dict[str, str]]) -> None:
    edges = (0.0, number(rows[0]["common_below"]), number(rows[0]["distinct_from"]), 1.0)
    for low, high, name in zip(edges, edges[1:], ("common", "uncertain", "distinct"), strict=False):
        axes.axvspan(low, high, color=style.CLASS_COLOURS[name], alpha=0.13, linewidth=0)
        axes.axvline(low, color=style.GREY, linewidth=0.5)
        axes.text((low + high) / 2, -0.42, name[0], ha="center", va="center", fontsize=6.5)
    for place, row in enumerate(rows):
        if not row["icc"]:
            axes.text(0.02, place, row["status"], va="center", fontsize=7)
            continue
        estimate = number(row["icc"])
        for offset, method, look in (
            (-0.17, "bootstrap", {"color": style.BLACK, "marker": "o"}),
            (0.17, "exact", {"color": style.BLUE, "marker": "s"}),
        ):
            low, high = number(row[f"{method}_low"]), number(row[f"{method}_high"])
            y = place + offset
            point = estimate if method == "bootstrap" else number(row["icc_untruncated"])
            axes.plot([low, high], [y, y], color=look["color"], linewidth=1.1)
            axes.plot([point], [y], color=look["color"], marker=look["marker"], markersize=2.8)
    # an ICC that is not truncated reaches down to -1 / (fits per person - 1), its interval too
    axes.set_xlim(min(-0.15, axes.dataLim.x0 - 0.05), 1.02)
    axes.set_xticks(edges, [f"{edge:g}" for edge in edges])
    axes.set_xlabel("ICC(1,1) (1)")


def _distribution_panel(axes: Axes, rows: list[dict[str, str]], classes: dict[str, str]) -> None:
    """Each fit's parameter over the geometric mean of all; a person's fits share a line, and a colour if few do."""
    subjects = sorted({row["subject"] for row in rows})
    many = len(subjects) > style.NAMED_PEOPLE
    for place, name in enumerate(PARAMETERS):
        values = np.array([number(row[parameter_column(name)]) for row in rows])
        ratio = values / np.exp(np.log(values).mean())
        axes.axhspan(
            place - 0.45,
            place + 0.45,
            color=style.CLASS_COLOURS.get(classes.get(name, ""), "#FFFFFF"),
            alpha=0.13,
            linewidth=0,
        )
        # the class is read without its colour too
        beside, initial = axes.get_yaxis_transform(), classes.get(name, "")[:1]
        axes.text(1.02, place, initial, transform=beside, va="center", fontsize=6.5)
        for index, subject in enumerate(subjects):
            own = ratio[[row["subject"] == subject for row in rows]]
            y = np.full(len(own), place + (index - (len(subjects) - 1) / 2) * 0.8 / max(len(subjects), 2))
            look = (
                style.CLOUD
                if many
                else style.person_style(index)
                | {"markersize": 2.0, "linewidth": 0.5, "label": subject if place == 0 else None}
            )
            axes.plot(np.sort(own), y, **look)
    axes.axvline(1.0, color=style.GREY, linewidth=0.5, zorder=0)
    axes.set_xscale("log")
    style.log_axis(axes.xaxis, *axes.get_xlim())
    axes.set_xlabel("fit / geometric mean (1)")


def icc_figure(*, fits: Path, icc: Path, out: list[Path]) -> None:
    """Draw ICC with bootstrap and exact F interval in their zones, and the fits relative to their mean.

    ``fits`` and ``icc`` are the tables of `shareability`; without enough people the ICC panel says what it
    needs.
    """
    fit_rows = read_table(fits, [parameter_column(n) for n in PARAMETERS])
    rows = read_table(icc, ("parameter", "icc", "status", "phantom"))
    classes = {row["parameter"]: row["class"] for row in rows}
    with matplotlib.rc_context(style.RC):
        figure = style.new_figure(4.4, phantom=_phantom(rows), overridden=_overridden(rows))
        left, right = figure.subplots(1, 2, sharey=True)
        if any(classes.values()):
            _icc_panel(left, rows)
        else:
            left.text(0.5, 5.5, rows[0]["status"].replace(", ", ",\n"), ha="center", va="center")
            left.set_xlim(0, 1)
            left.set_xticks([])
            left.set_xlabel("no ICC(1,1)")
        _distribution_panel(right, fit_rows, classes)
        left.set_yticks(range(len(PARAMETERS)), [style.math_name(n) for n in PARAMETERS], fontsize=8.5)
        left.set_ylim(len(PARAMETERS) - 0.4, -0.6)
        style.panel_letter(left, "a", "shareability")
        style.panel_letter(right, "b", "all fits")
        _icc_legend(figure, right, rows)
        style.save(figure, out)


def _icc_legend(figure: Figure, right: Axes, rows: list[dict[str, str]]) -> None:
    """Legend in columns: methods, classes, people; a legend fills column by column, hence the blanks."""
    confidence = next((f"{100 * number(r['confidence']):g} %" for r in rows if r["confidence"]), "")
    people = right.get_legend_handles_labels()[0]
    groups: list[list[Artist]] = [list(people)]
    if confidence:
        methods: list[Artist] = [
            Line2D([], [], color=style.BLACK, marker="o", label=f"bootstrap {confidence}"),
            Line2D([], [], color=style.BLUE, marker="s", label=f"exact F {confidence}"),
        ]
        classes: list[Artist] = [
            Patch(color=c, alpha=0.3, label=f"{n[0]}: {n}") for n, c in style.CLASS_COLOURS.items()
        ]
        groups = [methods, classes, *groups]
    height = max(3, -(-len(people) // 3))
    handles: list[Artist] = []
    for group in groups:
        handles += group + [Line2D([], [], linestyle="none", label=" ")] * (-len(group) % height)
    figure.legend(
        handles=handles, loc="outside lower center", ncols=len(handles) // height, columnspacing=0.9
    )


def loso_figure(*, loso: Path, out: list[Path]) -> None:
    """Draw the overhead of the others' prior per person and its mean, cost J and position RMSE [%].

    ``loso`` is the table of `loso_table`.
    """
    rows = read_table(loso, ("subject", "status", "overhead_J_percent", "overhead_rmse_percent"))
    drawn = [row for row in rows if row["status"] == "ok"]
    with matplotlib.rc_context(style.RC):
        figure = style.new_figure(2.2, phantom=_phantom(rows), overridden=_overridden(rows))
        axes = figure.subplots()
        if not drawn:
            style.say(axes, "leave-one-subject-out " + (rows[-1]["status"] if rows else "has no data"))
        elif len(drawn) > style.NAMED_PEOPLE + 1:
            _loso_shares(axes, [row for row in drawn if row["subject"] != "mean"])
        else:
            _loso_bars(axes, drawn)
        style.save(figure, out)


def _loso_shares(axes: Axes, rows: list[dict[str, str]]) -> None:
    """Of many people, the share whose overhead is at most so much."""
    for column, colour, label, dashed in (
        ("overhead_J_percent", style.BLUE, r"cost $J$", "-"),
        ("overhead_rmse_percent", style.VERMILION, "position RMSE", "--"),
    ):
        values = np.sort([number(row[column]) for row in rows])
        share = np.arange(1, len(values) + 1) / len(values)
        axes.plot(values, 100 * share, color=colour, linestyle=dashed, label=label)
    axes.set_xlabel("overhead of the prior (%)")
    axes.set_ylabel(f"of {len(rows)} people (%)")
    axes.set_ylim(0, 100)
    axes.legend()


def _loso_bars(axes: Axes, rows: list[dict[str, str]]) -> None:
    place = np.arange(len(rows))
    for offset, column, colour, hatch, label in (
        (-0.2, "overhead_J_percent", style.BLUE, "", r"cost $J$"),
        (0.2, "overhead_rmse_percent", style.ORANGE, "////", "position RMSE"),
    ):
        values = [number(row[column]) for row in rows]
        bars = axes.bar(
            place + offset,
            values,
            0.38,
            color=colour,
            hatch=hatch,
            edgecolor="white",
            linewidth=0,
            label=label,
        )
        labels = [f"{v:.1f}" if abs(v) < 100 else f"{v:.0f}" for v in values]
        axes.bar_label(bars, labels, fontsize=7, padding=1.5)
    axes.axhline(0.0, color=style.BLACK, linewidth=0.6)
    axes.margins(y=0.14)
    axes.set_xticks(place, [row["subject"] for row in rows])
    axes.set_ylabel("overhead of the prior (%)")
    axes.set_xlabel("person left out")
    axes.legend(loc="best", ncols=2)
