"""What people share: classes, priors, what they cost someone left out, and the same with diagnosed causes."""

from __future__ import annotations

from collections import Counter
from html import escape

from real2sim.artefacts import number
from real2sim.pages.page import folded, paragraph, percent, rounded, section, table
from real2sim.pages.report.parts import (
    DASH,
    downloads,
    figure,
    interval_cell,
    joined,
    one_by_one,
    percent_cell,
    value_cell,
    words,
)
from real2sim.pages.report.study import Row, Study, Table
from real2sim.study.paper.tables import missing_priors, percent_of_fits
from real2sim.study.statistics.shareability import is_published

# As the columns of tables with both are called
_MODELS = ("plain", "with_effects")


def priors_section(study: Study) -> str:
    """Classes of the parameters, priors, and what these cost someone unseen."""
    shared = study.sharing
    return section(
        "priors",
        "What people share, and priors",
        f'<div class="grid">{figure(study, "icc")}{figure(study, "loso")}</div>',
        _classes(study),
        figure(study, "coverage"),
        _priors_table(study),
        _with_effects(study),
        one_by_one(study, _loso_table(study)),
        _refinements(study),
        _regression(study),
        downloads(shared.icc, shared.classes, shared.priors, shared.loso, shared.anthropometrics),
    )


def _with_effects(study: Study) -> str:
    """Table I and the transfer costs twice, where the calibration people are diagnosed."""
    if not study.sharing.explained:
        return ""
    priors, transfer = study.sharing.explained[:2]
    first = priors.rows[0]
    who = (
        f"{first['n_with_a_cause']} of {first['n_subjects']} calibration people have a diagnosed cause. Both models "
        f"are fitted to the first two dynamic trials of the same people: the plain one by {first['search_plain']}, the "
        f"one with causes by {first['search_with_effects']}"
    )
    tables = [_transfer_twice(transfer, who), _priors_twice(priors, who), downloads(priors, transfer)]
    return folded("The same with the diagnosed causes in the model", "\n".join(tables))


def _transfer_twice(transfer: Table, who: str) -> str:
    rows = [
        [
            escape(row["says"]),
            *(value_cell(row[column]) for column in (*_MODELS, "published")),
            escape(row["unit"]),
        ]
        for row in transfer.rows
    ]
    return table(
        ["Quantity", "Plain model", "With causes", "Published", "Unit"],
        rows,
        caption="What the parameters of the strap cost on the person's other trial and with the prior of the other "
        f"people: cost J, means over {transfer.rows[0]['n_subjects']} people. {who}. An overhead is small where "
        "the gap makes up most of J, whatever the parameters are: the extra J says what they cost",
        numeric=(1, 2, 3),
    )


def _priors_twice(priors: Table, who: str) -> str:
    missing = [row[f"status_{m}"] for row in priors.rows for m in _MODELS if is_published(row[f"source_{m}"])]
    dashes = f". {missing_priors(missing)}" if missing else ""
    share = percent_of_fits(priors.rows)
    of_model = [f"{share} spread", "ICC", "Class"]
    rows = [
        [
            escape(row["parameter"]),
            *_prior_of(row, "plain"),
            *_prior_of(row, "with_effects"),
            escape(row["unit"]),
            value_cell(row["published_prior"], 4),
            escape(row["published_class"]),
        ]
        for row in priors.rows
    ]
    return table(
        ["Parameter", "Plain model", *of_model, "With causes", *of_model, "Unit", "Published", "Class"],
        rows,
        caption=f"Table I with the plain model and with the diagnosed causes in it: prior, central {share} of the "
        f"fits, their ICC and the class by it. {who}{dashes}",
        numeric=(1, 3, 5, 7, 10),
    )


def _prior_of(row: Row, model: str) -> list[str]:
    """Cells of a model's prior, spread, ICC and class; dashes where the published prior stands in."""
    if is_published(row[f"source_{model}"]):
        return [DASH, DASH, value_cell(row[f"icc_{model}"]), DASH]
    return [
        value_cell(row[f"prior_{model}"], 4),
        interval_cell(row[f"interval_low_{model}"], row[f"interval_high_{model}"]),
        value_cell(row[f"icc_{model}"]),
        escape(row[f"class_{model}"]),
    ]


def _priors_table(study: Study) -> str:
    shared = {row["parameter"]: row for row in study.sharing.icc.rows}
    share = percent_of_fits(study.sharing.priors.rows)
    rows = [
        [
            escape(row["parameter"]),
            value_cell(row["prior"], 4),
            interval_cell(row["interval_low"], row["interval_high"]),
            interval_cell(row["prediction_low"], row["prediction_high"]),
            escape(row["unit"]),
            escape(row["class"]),
            value_cell(shared.get(row["parameter"], {}).get("icc", "")),
            escape(row["use"]),
            value_cell(row["published_prior"], 4),
            escape(row["published_class"]),
        ]
        for row in study.sharing.priors.rows
    ]
    return table(
        [
            "Parameter",
            "Prior",
            f"{share} spread",
            f"Next person ({share})",
            "Unit",
            "Class",
            "ICC",
            "Use",
            "Published",
            "Published class",
        ],
        rows,
        caption="Geometric mean and empirical spread of the fits, beside the paper's Table I. Where there are too few "
        "people the published prior stands in.",
        numeric=(1, 2, 3, 6, 8),
    )


def _loso_table(study: Study) -> str:
    rows = [
        [
            escape(row["subject"]),
            value_cell(row["J_best"], 4),
            value_cell(row["J_prior"], 4),
            percent_cell(row["overhead_J_percent"]),
            percent_cell(row["overhead_rmse_percent"]),
            escape(row["status"]),
        ]
        for row in study.sharing.loso.rows
    ]
    return table(
        ["Person", "J, own fit", "J, prior of the others", "Overhead J", "Overhead RMSE", "Status"],
        rows,
        caption="Leave one subject out: what the prior of the others costs the one left out. Paper: eq. 7.",
        numeric=(1, 2, 3, 4),
    )


def _classes(study: Study) -> str:
    """Return the part about the classes that can be trusted."""
    rows = [
        [
            escape(row["parameter"]),
            *(escape(row[f"class{by}"]) or DASH for by in ("", "_by_exact_interval", "_by_nested_interval")),
            percent_cell(str(100 * number(row["share_determined"])) if row["share_determined"] else ""),
            f"<strong>{escape(row['verdict'])}</strong>",
            escape(row["reason"]),
        ]
        for row in study.sharing.classes.rows
    ]
    return table(
        ["Parameter", "Class (paper)", "By exact interval", "By trials", "Determined", "Verdict", "Why"],
        rows,
        caption="Class by the paper's bootstrap over fits, by the exact interval over fits, and by the exact interval "
        "over trials, which alone counts independent repeats; in how many trials the value was determined; what can "
        "be told",
        numeric=(4,),
    )


def _refinements(study: Study) -> str:
    """Return the part about priors for someone unseen: as they are, refined, and beside a full calibration."""
    rows = []
    for record in study.sharing.refined:
        for trial, found in record["trials"].items():
            full, against = found["full"], found["against_full"]
            rows.append(
                [
                    escape(f"{record['subject']}, {words(trial)}"),
                    rounded(found["prior"]["J"], 4),
                    rounded(found["refined"]["J"], 4),
                    rounded(full["J"], 4) if full else DASH,
                    percent(against["J_ratio"] - 1, 1) if against else DASH,
                    str(found["refined"]["evaluations"]),
                    percent(against["evaluations_over_best_restart"], 0) if against else DASH,
                ]
            )
    waiting = [f"{r['subject']}: {r['status']}." for r in study.sharing.refined if not r["trials"]]
    markup = "".join(paragraph(text) for text in waiting)
    if not rows:
        return markup
    free = study.sharing.refined[0]["free"]
    return markup + table(
        [
            "Person, trial",
            "J, prior",
            "J, refined",
            "J, full calibration",
            "Refined above full",
            "Evaluations",
            "Of one restart's",
        ],
        rows,
        caption=f"Unseen people: only {joined(free)} are refined, the rest stays at the prior. Each person has a page "
        "of their own in results/people",
        numeric=(1, 2, 3, 4, 5, 6),
    )


def _regression(study: Study) -> str:
    """Does the body predict a parameter, or how many people it takes to ask."""
    body = joined(
        [
            words(name)
            for name in dict.fromkeys(row["predictor"] for row in study.sharing.anthropometrics.rows)
        ]
    )
    states = Counter(row["status"] for row in study.sharing.anthropometrics.rows)
    told = "; ".join(status for status in states if status != "ok")
    known = [row for row in study.sharing.anthropometrics.rows if row["status"] == "ok"]
    if not known:
        return paragraph(f"Regression on {body}: {told or 'none asked for'}.")
    rows = [
        [
            escape(row["parameter"]),
            escape(row["predictor"]),
            value_cell(row["exponent"]),
            interval_cell(row["exponent_low"], row["exponent_high"]),
            value_cell(row["p_holm"]),
        ]
        for row in known
    ]
    without: dict[str, list[str]] = {}
    for row in study.sharing.anthropometrics.rows:
        if row["status"] != "ok":
            without.setdefault(row["status"], []).append(row["parameter"])
    return table(
        ["Parameter", "Predictor", "Exponent", f"{percent_of_fits(known)} interval", "p (Holm)"],
        rows,
        caption=f"By which power of {body} a parameter grows",
        numeric=(2, 4),
    ) + "".join(
        paragraph(f"No regression of {joined(list(dict.fromkeys(names)))}: {status}.")
        for status, names in without.items()
    )
