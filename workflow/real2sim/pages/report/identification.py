"""What the fits cost, and which parameters each trial determines."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from html import escape

from real2sim.artefacts import number
from real2sim.inference.parameters import PARAMETERS, unit
from real2sim.pages.diagnosis import shows_gap
from real2sim.pages.page import bar, folded, paragraph, percent, section, table, verdict
from real2sim.pages.report.parts import (
    DASH,
    MANY_PEOPLE,
    by_subject,
    downloads,
    figure,
    interval_cell,
    one_by_one,
    percent_cell,
    rows_of,
    value_cell,
    words,
)
from real2sim.pages.report.study import Row, Study

VERDICTS = ("determined", "weak", "not determined", "at bound")


def identification_section(study: Study) -> str:
    """Costs of the fits, and which parameters each trial determines."""
    rows = [
        [
            escape(row["subject"]),
            value_cell(row["J_within_mean_1"], 4),
            value_cell(row["J_floor_1"], 4),
            interval_cell(row["J_floor_low_1"], row["J_floor_high_1"]),
            value_cell(row["J_cross_mean_1"], 4),
            percent_cell(row["overhead_percent"]),
        ]
        for row in study.identification.cross_trial.rows
    ]
    costs = table(
        ["Person", "J", "J of neutral", "95 % interval", "J on the other trial", "Overhead"],
        rows,
        caption="Cost J (no unit): mean of the best fits on their own trial, what measurement noise alone costs (the "
        "neutral trial replayed with the best fit; of a short trial, the interval holds the true mean less often than"
        " it says, see docs/statistics.md), and the same parameters on the person's other trial. "
        "Paper: section V-B.1, and its figures in the last row.",
        numeric=(1, 2, 3, 4, 5),
    )
    people = by_subject(study.identification.identifiability.rows)
    own = "\n".join(
        folded(f"{name}: {_counted(mine)}", _parameters(name, mine), unfolded=i == 0)
        for i, (name, mine) in enumerate(people.items())
    )
    if len(people) > MANY_PEOPLE:
        own = paragraph(f"The verdicts on {len(people)} people one by one stand in the table below.")
    return section(
        "identification",
        "Identification",
        f'<div class="grid">{figure(study, "convergence")}<div>{one_by_one(study, costs)}'
        f"{downloads(study.identification.cross_trial)}</div></div>",
        "<h3>What each trial determines</h3>",
        paragraph(
            "A value that is not called determined is not a result. The interval of 95 % takes the residuals' "
            "autocorrelation and the noise of the pelvis markers into account."
        ),
        paragraph(_bias(study)),
        paragraph(_far_from_fits(study.identification.identifiability.rows)),
        _per_parameter(study),
        own,
        downloads(study.identification.identifiability),
    )


def _bias(study: Study) -> str:
    """Intervals of the plain model do not hold what it lacks; empty where nothing is known to be lacking."""
    named = [str(d["subject"]) for d in study.diagnoses if shows_gap(d)]
    if not named:
        return ""
    who = ", ".join(named) if len(named) < len(study.diagnoses) else "everyone who was diagnosed"
    return (
        "These intervals hold for a model that lacks nothing. The diagnosis finds that the plain model lacks something "
        f"for {who}: there values may lie further from the truth than their intervals say, and the parameters with the "
        "cause in the model are in the person's diagnosis.json."
    )


def _far_from_fits(rows: Sequence[Row]) -> str:
    """Say in how many trials verdicts are on other values than those of the best fit; empty where in none."""
    trials = dict.fromkeys((row["subject"], row["trial"]) for row in rows)
    far = dict.fromkeys((row["subject"], row["trial"]) for row in rows if _is_far_from_fit(row))
    if not far:
        return ""
    named = ", ".join(f"{name} {words(trial)}" for name, trial in far)
    return (
        "Before a fit is judged, least squares go on from it to the nearest minimum of J. In "
        f"{len(far)} of {len(trials)} trials ({named}) they moved at least one parameter that is called determined by "
        "more than half the width of its interval: the verdicts are on the values given here and not on those of the "
        "fits (column fitted of the table), which priors, ICC and costs rest on. There the search ended early: give "
        "it more (identification.evaluations; for least squares identification.least_squares.iterations)."
    )


def _is_far_from_fit(row: Row) -> bool:
    """Return whether the best fit is farther from a determined value than the interval reaches, in ln-units."""
    if row["verdict"] != "determined":
        return False
    value, fitted, low, high = (number(row[key]) for key in ("value", "fitted", "ci95_low", "ci95_high"))
    return abs(math.log(fitted / value)) > math.log(high / low) / 2


def _counted(rows: Sequence[Row]) -> str:
    counts = Counter(row["verdict"] for row in rows)
    return ", ".join(f"{counts[verdict]} {verdict}" for verdict in VERDICTS if counts[verdict])


def _per_parameter(study: Study) -> str:
    rows = []
    for name in PARAMETERS:
        counts = Counter(
            row["verdict"] for row in rows_of(study.identification.identifiability.rows, parameter=name)
        )
        if counts:
            share = counts["determined"] / counts.total()
            rows.append(
                [escape(name), *(str(counts[verdict]) for verdict in VERDICTS), bar(share) + percent(share)]
            )
    return table(
        ["Parameter", *(verdict.capitalize() for verdict in VERDICTS), "Determined"],
        rows,
        caption="Verdicts over all people and dynamic trials. Rotation about y is informed only through the arm's "
        "pitch.",
        numeric=(1, 2, 3, 4),
    )


def _parameters(name: str, mine: Sequence[Row]) -> str:
    trials = list(dict.fromkeys(row["trial"] for row in mine))
    rows = []
    for parameter in PARAMETERS:
        cells = [escape(parameter), escape(unit(parameter))]
        for trial in trials:
            found = rows_of(mine, parameter=parameter, trial=trial)
            cells += _judged(found[0]) if found else [DASH, DASH]
        rows.append(cells)
    head = ["Parameter", "Unit"]
    for trial in trials:
        head += [words(trial), "Verdict"]
    reasons = [
        [
            escape(f"{row['parameter']}, {words(row['trial'])}"),
            escape(row["reason"]),
            escape(row["next_trial"]),
        ]
        for row in mine
        if row["verdict"] != "determined"
    ]
    why = (
        table(["Value", "Reason", "Trial that would help"], reasons, caption=f"What {name} lacks")
        if reasons
        else ""
    )
    numeric = tuple(range(2, len(head), 2))
    return table(head, rows, caption=f"Parameters of {name} with 95 % intervals", numeric=numeric) + why


def _judged(row: Row) -> list[str]:
    between = interval_cell(row["ci95_low"], row["ci95_high"])
    return [f"{value_cell(row['value'])} <span class='small'>{between}</span>", verdict(row["verdict"])]
