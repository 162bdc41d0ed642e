"""How good the diagnosis is: the page of a suite's score."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from html import escape
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.patches import Rectangle
from matplotlib.ticker import NullLocator
from statsmodels.stats.proportion import proportion_confint

from real2sim.artefacts import read_json
from real2sim.errors import InputError
from real2sim.files import write_text
from real2sim.pages import style
from real2sim.pages.page import (
    document,
    page_style,
    paragraph,
    percent,
    picture,
    rounded,
    section,
    table,
)
from real2sim.pages.validation import claim_words, target_words

_KEYS = (
    "suite",
    "phantom",
    "cases",
    "targets",
    "confusion",
    "power",
    "per_effect",
    "calibration",
    "gap_closed",
    "baselines",
    "time_s",
)
# Claims on a measured law, in the order of the table
_LAW_CLAIMS = ("stage", "axes", "variables", "kind")
_GAP_RANGE = (-0.5, 1.5)  # of the histogram; what lies beyond is counted in its outer bins
_DASH = "\N{EN DASH}"


def suite_page(*, score: Path, out: Path) -> None:
    """Write the page of a suite's score: targets, confusion, power, calibration, gap closed, baselines.

    ``score`` is score.json. Any of its lists may be empty; what cannot be shown is said. The page holds its figures and
    loads nothing. Raises InputError where the matrix of confusion does not fit its labels.
    """
    s = read_json(score, _KEYS)
    _check(score, s["confusion"])
    body = [_lead(s), _targets(s), _unlisted(s), _confusion(s), _power(s), _calibration(s), _gap(s), _foot(s)]
    write_text(out, document(f"Diagnosis suite: {s['suite']}", body, phantom=s["phantom"]))


def _check(path: Path, confusion: Mapping[str, Any]) -> None:
    n = len(confusion["labels"])
    rows = [len(row) for row in confusion["counts"]]
    if rows != [n] * n:
        raise InputError(
            path,
            "confusion.counts",
            f"rows of {rows}",
            f"{n} rows of {n}, one per label",
            "Score the suite again.",
        )


def _words(name: str) -> str:
    return name.replace("_", " ")


def _missing(what: str) -> str:
    return paragraph(f"This score has no {what}.")


def _lead(s: Mapping[str, Any]) -> str:
    judged = [t for t in s["targets"] if t["met"] is not None]
    missed = [claim_words(t["claim"]) for t in judged if not t["met"]]
    total = len(judged)
    if not total:
        text = f"{s['cases']} cases were scored against no targets."
    elif missed:
        text = f"{total - len(missed)} of {total} targets are met on {s['cases']} cases; missed: {'; '.join(missed)}."
    else:
        text = f"All {total} targets are met on {s['cases']} cases."
    time = s["time_s"]
    spent = [f"median {rounded(time.get('median'))} s, longest {rounded(time.get('max'))} s"] if time else []
    return paragraph(text, "lead") + "".join(paragraph(f"Time per case: {t}.") for t in spent)


# ---- targets and baselines


def _amount(row: Mapping[str, Any]) -> str:
    """As a percentage where it is a share, or where the target is one."""
    share = row["wilson95"] is not None or "%" in row["target"]
    return percent(row["value"], 1) if share else rounded(row["value"])


def _between(ci: Sequence[float] | None) -> str:
    return _DASH if ci is None else f"[{percent(ci[0], 1)}, {percent(ci[1], 1)}]"


def _verdict(met: bool | None) -> str:
    """Met, missed, or a dash for a figure that has no target."""
    if met is None:
        return _DASH
    if met:
        return '<span class="met">\N{CHECK MARK} met</span>'
    return '<span class="missed">\N{MULTIPLICATION SIGN} missed</span>'


def _targets(s: Mapping[str, Any]) -> str:
    rows = [
        [
            escape(claim_words(t["claim"])),
            _verdict(t["met"]),
            _amount(t),
            escape(target_words(t["target"])),
            _between(t["wilson95"]),
            str(t["n"]),
        ]
        for t in s["targets"]
    ]
    targets = (
        table(
            ["Claim", "Verdict", "Value", "Target", "Wilson 95 %", "n"],
            rows,
            caption="Targets, which were fixed before the suite was scored. The verdict is on the value; the "
            "interval says how far n cases can tell.",
            numeric=(2, 4, 5),
        )
        if rows
        else _missing("targets")
    )
    return section("targets", "Targets and baselines", targets, _baselines(s))


def _baselines(s: Mapping[str, Any]) -> str:
    if not s["baselines"]:
        return _missing("baselines")
    columns = {
        "top1": "Top-1",
        "false_alarm": "False alarm",
        "wrong_name_out_of_library": "Wrong name, out of library",
        "right_of_all": "Right, all with one answer",
    }
    shown = [key for key in columns if key in s["baselines"][0]]
    rows = [[escape(b["name"]), *(percent(b.get(key), 1) for key in shown)] for b in s["baselines"]]
    return table(
        ["Way to decide", *(columns[key] for key in shown)],
        rows,
        caption="Baselines on the same cases and fits, at every visibility: top-1 where an effect of the library was "
        "put in, false alarm where none was and one was named.",
        numeric=tuple(range(1, len(shown) + 1)),
    )


# ---- laws outside the catalogue


def _unlisted(s: Mapping[str, Any]) -> str:
    """Table of the strata whose causes the catalogue does not hold; nothing where the suite has none."""
    if not s.get("unlisted"):
        return ""
    rows = [
        [
            escape(_words(row["form"])),
            escape(_words(row["stratum"])),
            f"{row['right']} of {row['n']}",
            str(row["laws"]),
            *(f"{right} of {n}" if n else _DASH for right, n in (row[key] for key in _LAW_CLAIMS)),
            percent(row["closed"]),
        ]
        for row in s["unlisted"]
    ]
    heads = ["Cause", "Stratum", "Unknown or equal law", "Laws", *map(str.capitalize, _LAW_CLAIMS), "Closed"]
    return section(
        "unlisted",
        "Causes that the catalogue does not hold",
        table(
            heads,
            rows,
            caption="Per cause: right answers (`unknown`, or a listed law that closes as much), laws that were "
            "measured, and of these the right ones; closed is the median share of the gap on the held-out trial.",
            numeric=tuple(range(2, len(heads))),
        ),
    )


# ---- confusion


def _confusion(s: Mapping[str, Any]) -> str:
    labels, counts = s["confusion"]["labels"], np.array(s["confusion"]["counts"], dtype=float)
    heading = "What was put in, and what was answered"
    if not labels or not counts.sum():
        return section("confusion", heading, _missing("matrix of confusion"))
    rows = [_confused(labels, i, row) for i, row in enumerate(counts) if row.sum()]
    words = table(
        ["Put in", "Cases", "Answered right", "Most frequent other answers"],
        rows,
        caption="The same in words",
        numeric=(1, 2),
    )
    return section(
        "confusion",
        heading,
        _matrix(s, labels, counts),
        f"<details><summary>The same in words</summary>\n{words}\n</details>",
    )


def _confused(labels: Sequence[str], i: int, row: np.ndarray) -> list[str]:
    others = [j for j in np.argsort(-row, kind="stable") if j != i and row[j]][:3]
    wrong = ", ".join(f"{_words(labels[j])} {row[j]:.0f}" for j in others)
    right = f"{row[i]:.0f} ({percent(row[i] / row.sum())})"
    return [escape(_words(labels[i])), f"{row.sum():.0f}", right, escape(wrong) or _DASH]


def _matrix(s: Mapping[str, Any], labels: Sequence[str], counts: np.ndarray) -> str:
    n, names = len(labels), [_words(label) for label in labels]
    totals = counts.sum(axis=1)
    with page_style():
        figure = style.new_figure(1.4 + 0.18 * n, phantom=s["phantom"], width_in=max(3.5, 1.6 + 0.2 * n))
        axes = figure.subplots()
        for i, j in zip(*np.nonzero(counts), strict=True):
            share = counts[i, j] / totals[i]
            colour = style.BLUE if i == j else style.VERMILION
            axes.add_patch(Rectangle((j, i), 1, 1, facecolor=colour, alpha=0.12 + 0.5 * share, linewidth=0))
            axes.text(j + 0.5, i + 0.52, f"{counts[i, j]:.0f}", ha="center", va="center", fontsize=6.5)
        axes.set_xlim(0, n)
        axes.set_ylim(n, 0)
        middle = [i + 0.5 for i in range(n)]
        axes.set_yticks(middle, [f"{name} ({t:.0f})" for name, t in zip(names, totals, strict=True)])
        axes.set_xticks(middle, names, rotation=60, ha="left", rotation_mode="anchor")
        axes.xaxis.tick_top()
        axes.xaxis.set_label_position("top")
        axes.tick_params(length=0)
        for i in range(n + 1):
            axes.axhline(i, color=style.GREY, linewidth=0.25, alpha=0.5)
            axes.axvline(i, color=style.GREY, linewidth=0.25, alpha=0.5)
        axes.set_xlabel("answered")
        axes.set_ylabel("put in (cases)")
        right = percent(float(np.trace(counts) / counts.sum()))
        return picture(
            figure,
            "matrix",
            f"Matrix of {n} causes put in by {n} answers; {right} of {counts.sum():.0f} cases lie on the diagonal.",
            "Confusion. A row per cause that was put in, a column per answer; numbers are cases, shade is the share "
            "of the row: blue right, orange wrong.",
            wide=n > 12,
        )


# ---- power


def _power(s: Mapping[str, Any]) -> str:
    curve = _power_figure(s) if s["power"] else _missing("power against visibility")
    rows = [
        [
            escape(_words(e["effect"])),
            str(e["n"]),
            f"{e['top1']} ({percent(e['top1'] / e['n'])})" if e["n"] else _DASH,
            rounded(e["smallest_rho"]),
            percent(e.get("smallest_severity")),
        ]
        for e in s["per_effect"]
    ]
    each = (
        table(
            ["Effect", "Cases", "Top-1", "Smallest ρ", "Severity"],
            rows,
            caption="Per effect, with the smallest visibility at which at least 80 % of its cases are named first, and "
            "the severity there (share of the largest that is drawn; medians); a dash: at none of the suite.",
            numeric=(1, 2, 3, 4),
        )
        if rows
        else _missing("figures per effect")
    )
    return section("power", "What it takes to be seen", f'<div class="grid">\n{curve}\n{each}\n</div>')


def _power_figure(s: Mapping[str, Any]) -> str:
    points = sorted(s["power"], key=lambda p: p["rho"])
    rho = [p["rho"] for p in points]
    with page_style():
        figure = style.new_figure(2.4, phantom=s["phantom"])
        axes = figure.subplots()
        for p in points:
            if p["wilson95"] is not None:
                axes.vlines(p["rho"], *p["wilson95"], color=style.BLUE, linewidth=0.8)
        axes.plot(rho, [p["top1"] for p in points], "o-", color=style.BLUE)
        if min(rho) > 0:
            axes.set_xscale("log")
            axes.set_xlim(min(rho) / 1.4, max(rho) * 1.4)
        axes.set_xticks(rho, [f"{r:.2g}\nn = {p['n']}" for r, p in zip(rho, points, strict=True)])
        axes.xaxis.set_minor_locator(NullLocator())
        axes.set_ylim(0, 1.03)
        axes.set_xlabel("visibility ρ = (J − floor) / floor")
        axes.set_ylabel("top-1")
        words = ", ".join(f"{percent(p['top1'])} at {p['rho']:g}" for p in points)
        return picture(
            figure,
            "curve",
            f"Top-1 against visibility: {words}.",
            "Power. Share of cases whose cause is named first, against how far the gap stands above noise; bars are "
            "Wilson intervals of 95 %.",
        )


# ---- calibration


def _calibration(s: Mapping[str, Any]) -> str:
    c = s["calibration"]
    heading = "Can the probabilities be believed?"
    facts = (
        f"Expected calibration error {rounded(c.get('ece'))}; sets of 90 % hold the truth in "
        f"{percent(c.get('set90_coverage'), 1)} of the cases and name {rounded(c.get('set90_mean_size'))} causes "
        "on average."
    )
    bins = [b for b in c.get("bins", []) if b["n"]]
    return section(
        "calibration",
        heading,
        paragraph(facts) if c.get("ece") is not None else "",
        _reliability(s, bins) if bins else _missing("bins of probability"),
    )


def _reliability(s: Mapping[str, Any], bins: Sequence[Mapping[str, Any]]) -> str:
    with page_style():
        figure = style.new_figure(3.3, phantom=s["phantom"])
        top, bottom = figure.subplots(2, 1, sharex=True, height_ratios=(3, 1))
        top.plot([0, 1], [0, 1], color=style.GREY, linewidth=0.8, linestyle="--")
        for b in bins:
            low, high = proportion_confint(round(b["n"] * b["fraction_true"]), b["n"], method="wilson")
            top.vlines(b["mean_probability"], low, high, color=style.BLUE, linewidth=0.8)
        top.plot(
            [b["mean_probability"] for b in bins], [b["fraction_true"] for b in bins], "o", color=style.BLUE
        )
        top.set_ylim(-0.03, 1.03)
        top.set_xlim(0, 1)
        top.set_ylabel("share that is true")
        _bins(bottom, bins)
        bottom.set_ylabel("answers")
        bottom.set_xlabel("probability given")
        words = ", ".join(
            f"{percent(b['mean_probability'])} true {percent(b['fraction_true'])}" for b in bins
        )
        return picture(
            figure,
            "reliability",
            f"Reliability: given probability against share that is true. {words}.",
            "Calibration. On the dashed line probabilities are what they say; bars are Wilson intervals of 95 %, "
            "below is how many answers each point stands for.",
        )


def _bins(axes: Axes, bins: Sequence[Mapping[str, Any]]) -> None:
    widths = [b["to"] - b["from"] for b in bins]
    axes.bar(
        [b["from"] for b in bins],
        [b["n"] for b in bins],
        width=widths,
        align="edge",
        color=style.GREY,
        edgecolor="#ffffff",
    )


# ---- gap closed


def _gap(s: Mapping[str, Any]) -> str:
    heading = "How much of the gap is closed"
    shares = np.array(s["gap_closed"], dtype=float)
    if not len(shares):
        return section("gap", heading, _missing("shares of gap closed"))
    median, low = float(np.median(shares)), float(np.percentile(shares, 10))
    worse = float(np.mean(shares < 0))
    facts = (
        f"Median {percent(median, 1)}, 10th percentile {percent(low, 1)}; made worse in {percent(worse, 1)} of "
        f"{len(shares)} cases."
    )
    first, last = _GAP_RANGE
    with page_style():
        figure = style.new_figure(2.3, phantom=s["phantom"])
        axes = figure.subplots()
        edges = np.linspace(first, last, 41).tolist()
        axes.hist(np.clip(shares, first, last), edges, color=style.BLUE, edgecolor="#ffffff", linewidth=0.4)
        axes.axvline(0, color=style.GREY, linewidth=0.8)
        for value, line, label in ((median, "-", "median"), (low, "--", "10th percentile")):
            axes.axvline(
                float(np.clip(value, first, last)),
                color=style.BLACK,
                linestyle=line,
                linewidth=0.9,
                label=label,
            )
        axes.legend(loc="upper left")
        axes.set_xlim(first, last)
        axes.set_xticks([-0.5, 0, 0.5, 1, 1.5], ["≤ −50 %", "0", "50 %", "100 %", "≥ 150 %"])
        axes.set_ylabel("cases")
        axes.set_xlabel("gap closed on the held-out trial")
        shown = picture(
            figure,
            "closed",
            f"Histogram of the share of the gap that is closed. {facts}",
            "Share of the closable gap that is closed on the held-out trial. Left of 0: made worse. Outer bins hold "
            "what lies beyond.",
        )
    return section("gap", heading, paragraph(facts), shown)


def _foot(s: Mapping[str, Any]) -> str:
    return (
        "<footer>\n"
        + paragraph(f"Suite {s['suite']}; format {s.get('schema', 1)}; {s['cases']} cases.")
        + "\n</footer>"
    )
