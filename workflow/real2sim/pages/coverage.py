"""Figure of the coverage study: what the intervals of an ICC hold, and how many people a class needs."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.lines import Line2D
from matplotlib.ticker import FixedLocator, FuncFormatter, NullLocator

from real2sim.artefacts import number, read_table
from real2sim.pages import style

Row = dict[str, str]
# Keys are those of the study's tables
DESIGNS = {"independent repeats": "independent repeats", "restarts of trials": "2 trials × 5 restarts"}
METHODS: dict[str, dict[str, Any]] = {
    "bootstrap": {"color": style.BLACK, "marker": "o", "markersize": 3.0},
    # larger, because it lies under the next one where both are right
    "exact": {"color": style.BLUE, "marker": "s", "markersize": 4.2},
    "exact by trials": {"color": style.ORANGE, "marker": "^", "markersize": 3.0},
}
LABELS = {
    "bootstrap": "cluster bootstrap, all fits",
    "exact": "exact F, all fits",
    "exact by trials": "exact F, one fit per trial",
}
COVERAGE = ("design", "method", "icc", "n_people", "coverage", "share_common", "common_below", "confidence")
POWER = ("design", "method", "truth", "icc", "n_people", "right", "power")
TRUTH_LINES = {"common": "-", "distinct": "--"}


def _of(rows: list[Row], **wanted: str) -> list[Row]:
    return [row for row in rows if all(row[key] == value for key, value in wanted.items())]


def _people_axis(axes: Axes, people: list[float]) -> None:
    axes.set_xscale("log")
    # labels of neighbours closer than a fifth would touch
    shown = [p for p in (5, 10, 20, 50, 100) if min(people) <= p <= max(people)] or people
    axes.xaxis.set_major_locator(FixedLocator(shown))
    axes.xaxis.set_minor_locator(NullLocator())
    axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axes.set_xlim(min(people) / 1.15, max(people) * 1.15)


def _by_icc(axes: Axes, rows: list[Row], people: int) -> None:
    """Coverage of each method against the true ICC, with the simulation's own interval."""
    for place, (method, look) in enumerate(METHODS.items()):
        own = _of(rows, method=method, n_people=str(people))
        x = np.array([number(row["icc"]) for row in own]) + 0.012 * (place - 1)
        y, low, high = (
            np.array([number(row[f"coverage{end}"]) for row in own]) for end in ("", "_low", "_high")
        )
        axes.errorbar(x, y, yerr=np.maximum([y - low, high - y], 0.0), linewidth=0.9, elinewidth=0.7, **look)
    axes.set_xlim(-0.05, 0.95)
    axes.set_xlabel("true ICC (1)")


def _lowest(axes: Axes, rows: list[Row]) -> None:
    """Lowest coverage over all true ICC against the number of people."""
    people = sorted({int(row["n_people"]) for row in rows})
    for method, look in METHODS.items():
        lowest = [
            min(number(row["coverage"]) for row in _of(rows, method=method, n_people=str(p))) for p in people
        ]
        axes.plot(people, lowest, linewidth=0.9, **look)
    _people_axis(axes, [float(p) for p in people])
    axes.set_xlabel("people (1)")


def _lines(axes: Axes, rows: list[Row], column: dict[str, str]) -> None:
    """A share against the number of people, a line per method and truth; ``column`` by truth."""
    for method, look in METHODS.items():
        for truth, line in TRUTH_LINES.items():
            own = sorted(_of(rows, method=method, truth=truth), key=lambda row: int(row["n_people"]))
            x = [number(row["n_people"]) for row in own]
            y = [number(row[column[truth]]) for row in own]
            filled = look["color"] if truth == "common" else "white"
            axes.plot(x, y, linestyle=line, linewidth=0.9, markerfacecolor=filled, **look)
    _people_axis(axes, [number(row["n_people"]) for row in rows])
    axes.set_xlabel("people (1)")


def _power(axes: Axes, rows: list[Row]) -> None:
    _lines(axes, rows, dict.fromkeys(TRUTH_LINES, "right"))


def _false(axes: Axes, rows: list[Row]) -> None:
    """Share of false claims where the true ICC lies on the edge of a class."""
    _lines(axes, rows, {"common": "share_common", "distinct": "share_distinct"})


def _on_the_edge(rows: list[Row]) -> list[Row]:
    """Rows whose true ICC is where "common" ends or "distinct" begins, named by the class that would be false."""
    out = []
    for row in rows:
        for truth, edge in (("common", "common_below"), ("distinct", "distinct_from")):
            if number(row["icc"]) == number(row[edge]):
                out.append(row | {"truth": truth})
    return out


def coverage_figure(*, coverage: Path, power: Path, out: list[Path]) -> None:
    """Draw coverage against ICC and people, and the share of right classes, for both designs of ten fits.

    ``coverage`` and ``power`` are the tables of `coverage_study`. The data are simulated normals, nobody's.
    """
    covered = read_table(coverage, COVERAGE)
    told = read_table(power, POWER)
    fewest = min(int(row["n_people"]) for row in covered)
    edge, confidence = _on_the_edge(covered), number(covered[0]["confidence"])
    panels: dict[str, tuple[str, list[Row], Callable[[Axes, list[Row]], None]]] = {
        f"{fewest} people": ("coverage (1)", covered, lambda axes, rows: _by_icc(axes, rows, fewest)),
        "lowest over ICC": ("lowest coverage (1)", covered, _lowest),
        "power": ("classed right (1)", told, _power),
        "ICC on the edge": ("false claims (1)", edge, _false),
    }
    levels = {"power": number(told[0]["power"]), "ICC on the edge": (1 - confidence) / 2}
    with matplotlib.rc_context(style.RC):
        figure = style.new_figure(6.6, phantom=False)
        grid = figure.subplots(4, 2, sharey="row")
        letters = iter("abcdefgh")
        for own, (title, (label, rows, draw)) in zip(grid, panels.items(), strict=True):
            own[0].set_ylabel(label)
            for axes, design in zip(own, DESIGNS, strict=True):
                draw(axes, _of(rows, design=design))
                axes.axhline(levels.get(title, confidence), color=style.GREY, linewidth=0.7, linestyle=":")
                axes.set_ylim(-0.04, 1.04)
                style.panel_letter(axes, next(letters), title)
        for axes, name in zip(grid[0], DESIGNS.values(), strict=True):
            axes.annotate(
                name, (0.5, 1.0), (0, 18), "axes fraction", "offset points", ha="center", fontweight="bold"
            )
        handles = [Line2D([], [], label=LABELS[name], **look) for name, look in METHODS.items()]
        for truth, line in TRUTH_LINES.items():
            at = next(row["icc"] for row in told if row["truth"] == truth)
            on = next((row["icc"] for row in edge if row["truth"] == truth), "")
            look: dict[str, Any] = {"color": style.GREY, "marker": "o", "markersize": 3.0, "linestyle": line}
            look["markerfacecolor"] = style.GREY if truth == "common" else "white"
            text = f"{truth}: ICC {number(at):g}" + (f"; edge {number(on):g}" if on else "")
            handles.append(Line2D([], [], label=text, **look))
        figure.legend(handles=handles, loc="outside lower center", ncols=2, columnspacing=1.0)
        style.save(figure, out)
