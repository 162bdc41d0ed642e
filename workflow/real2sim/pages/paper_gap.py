"""Which unmodelled effect would have made the paper's numbers: a figure, and a section of the report.

Both are of the record that `snakemake paper_gap` writes and resources/paper_gap holds.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from html import escape
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes

from real2sim.artefacts import read_json
from real2sim.pages import style
from real2sim.pages.page import folded, listed, paragraph, percent, rounded, table

RECORD_KEYS = ("published", "J", "groups", "causes", "people", "settings", "commit", "date")
# Causes that are no effects of the catalogue
NAMES = {"nothing": "nothing unmodelled", "study_robot": "the study's robot"}
_ROW_IN, _FRAME_IN = 0.19, 1.0
_GROUP_NAMES = {
    "transfer": "Transfer",
    "centre": "Priors",
    "spread": "Spread",
    "classes": "Classes",
    "limits": "Bounds",
}

Cause = Mapping[str, Any]


def paper_gap_figure(*, record: Path, out: list[Path]) -> None:
    """Draw how far the cohort of each cause lies from the paper's numbers; ``record`` as shipped."""
    ranked = _ranked(read_json(record, RECORD_KEYS))[::-1]
    with matplotlib.rc_context(style.RC):
        figure = style.new_figure(_FRAME_IN + _ROW_IN * max(len(ranked), 2), phantom=True)
        axes = figure.subplots()
        if ranked:
            _distances(axes, ranked)
            figure.legend(loc="outside lower center", ncols=1)
        else:
            style.say(axes, "no cohort costs the paper's J")
        style.save(figure, out)


def _distances(axes: Axes, ranked: Sequence[Cause]) -> None:
    place = np.arange(len(ranked))
    low, middle, high = (
        np.array([c[key] for c in ranked]) for key in ("distance_low", "distance", "distance_high")
    )
    axes.hlines(place, low, high, color=style.GREY, linewidth=1.2)
    near = np.array([c["not_told_apart"] for c in ranked])
    for which, face, label in (
        (near, style.BLUE, "cannot be told from the nearest"),
        (~near, "white", "farther"),
    ):
        axes.plot(
            middle[which],
            place[which],
            "o",
            color=style.BLUE,
            markerfacecolor=face,
            markersize=4,
            label=label,
        )
    axes.set_yticks(place, [_labelled(c) for c in ranked])
    axes.set_ylim(-0.7, len(ranked) - 0.3)
    axes.set_xlim(0, 1.05 * float(high.max()))
    axes.set_xlabel("distance from the paper (1: usual cause)")
    free = np.array([c["distance_free"] for c in ranked])
    axes.plot(free, place, "|", color=style.VERMILION, markersize=7, label="without priors and bounds")


def _labelled(cause: Cause) -> str:
    """Name of a cause with its size, in sizes of the largest that is published; a robot has none."""
    size = cause.get("size_median")
    return _name(cause) if size is None else f"{_name(cause)}, {rounded(size, 2)}\N{MULTIPLICATION SIGN}"


def _name(cause: Cause) -> str:
    return NAMES.get(cause["cause"], str(cause["cause"]).replace("_", " "))


def _ranked(record: Mapping[str, Any]) -> list[Cause]:
    return sorted((c for c in record["causes"] if "rank" in c), key=lambda c: int(c["rank"]))


def told(record: Mapping[str, Any], figure: str) -> str:
    """Return the section's markup: the answer in words, ``figure`` (markup), the numbers of every cause folded."""
    ranked = _ranked(record)
    others = [c for c in record["causes"] if "rank" not in c]
    return "\n".join(
        [
            paragraph(_question(record)),
            paragraph(_answer(ranked, others, record["settings"]["largest"])),
            figure,
            folded("Every cause, in numbers", _table(record, ranked, others)),
            paragraph(
                f"Computed by commit {record['commit']}, {record['date']}, with snakemake paper_gap. Everything here "
                "is of synthetic people; the study's own data are not known to this project.",
                "small",
            ),
        ]
    )


def _question(record: Mapping[str, Any]) -> str:
    noise = next(c["J_within"] for c in record["causes"] if c["cause"] == "nothing")
    return (
        f"The paper's fits cost J {rounded(record['J'])}, where those of people without any unmodelled effect cost "
        f"{rounded(noise, 2)}: its simulation has a gap too. Which one unmodelled effect would leave the numbers that "
        f"it prints? For each, {record['people']} "
        "synthetic people were recorded with that effect, so large that the plain fits cost this J, and put through "
        "the paper's analysis. What was compared: the cost on another trial and another person, the prior and spread "
        "of each parameter, classes, and what lies at bounds."
    )


def _answer(ranked: Sequence[Cause], others: Sequence[Cause], largest: float) -> str:
    if not ranked:
        return "No cohort costs this J."
    text = (
        "No cause makes all of the paper's numbers. In units of what causes usually miss a number by (the median of "
        f"all causes), the nearest miss them by {rounded(ranked[0]['distance'], 2)} on average. They are "
        f"{_near(ranked, 'not_told_apart')}. Priors and what lies at bounds hang on which parameters the people truly "
        "have, which in the study nobody knows; without these two the nearest are "
        f"{_near(ranked, 'not_told_apart_free')}. Causes that are listed together cannot be told apart by these "
        "numbers. In brackets: size, over the largest that is published."
    )
    modest = [c for c in ranked if (c.get("size_median") or 0.0) <= 1]
    if modest:
        text += f" Only {listed([_name(c) for c in modest])} leave this J without being exaggerated."
    unable = [c for c in others if c["cause"] not in NAMES]
    if unable:
        text += (
            f" {len(unable)} other effects cannot leave this J with the motion of these people, up to "
            f"{rounded(largest, 2)} times the largest published size or as far as their equations mean something."
        )
    return text


def _near(ranked: Sequence[Cause], key: str) -> str:
    return listed([_with_size(c) for c in ranked if c[key]])


def _with_size(cause: Cause) -> str:
    size = cause.get("size_median")
    return _name(cause) if size is None else f"{_name(cause)} ({rounded(size, 2)})"


def _table(record: Mapping[str, Any], ranked: Sequence[Cause], others: Sequence[Cause]) -> str:
    published = record["published"]
    head = [
        "Cause",
        "Size",
        "J",
        "Cross-trial",
        "LOSO",
        "Same classes",
        "Prior k_rz",
        "Ratios",
        *(_GROUP_NAMES[group] for group in record["groups"]),
        "Distance",
        "Nearest in",
        "Without priors",
        "Nearest without",
    ]
    paper = [
        "The paper",
        "",
        rounded(record["J"]),
        percent(math.expm1(published["overhead_mean"]), 1),
        percent(math.expm1(published["loso_J"]), 1),
        rounded(published["same_classes"]),
        rounded(math.exp(published["prior_k_rz"])),
        rounded(published["damping_ratios"]),
        *[""] * len(record["groups"]),
        *[""] * 4,
    ]
    caption = (
        "Size: times the largest that is published or that the trial carries, median of the people. J, cross-trial and "
        "LOSO overhead: means. Same classes: parameters of the published class, of 12. Prior k_rz in Nm/rad. Ratios: "
        "priors with a damping ratio that the paper's bounds are said to exclude. Then the distance by group of "
        "numbers, and overall; without priors and bounds. Nearest in: share of resamples of the people in which this "
        "cause is the nearest. Causes without a distance do not leave the paper's J."
    )
    rows = [paper, *(_row(c, record["groups"]) for c in [*ranked, *others])]
    return table(head, rows, caption=caption, numeric=tuple(range(1, len(head))))


def _row(cause: Cause, groups: Sequence[str]) -> list[str]:
    def number(key: str, digits: int = 3) -> str:
        return rounded(cause.get(key), digits)

    def share(key: str, scale: float = 1.0, digits: int = 1) -> str:
        value = cause.get(key)
        return percent(None if value is None else value / scale, digits)

    ranked = "rank" in cause
    return [
        escape(_name(cause)),
        number("size_median", 2),
        number("J_within"),
        share("overhead_cross_percent", 100),
        share("overhead_loso_percent", 100),
        number("same_classes"),
        number("k_rz_prior"),
        number("damping_ratios"),
        *(number(f"distance_{group}", 2) if ranked else "" for group in groups),
        number("distance") if ranked else "",
        share("nearest_share", digits=0) if ranked else "",
        number("distance_free") if ranked else "",
        share("nearest_share_free", digits=0) if ranked else "",
    ]
