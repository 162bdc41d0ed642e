"""Tables as printed: our numbers beside the published ones."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from real2sim.artefacts import needs_people, number, read_json, read_table, write_table
from real2sim.recording.quality.verdict import overridden_trials
from real2sim.study.statistics.shareability import PRIOR_COLUMNS, is_published

PRIORS_COLUMNS = (
    *PRIOR_COLUMNS[:6],
    "published_prior",
    "published_interval_low",
    "published_interval_high",
    "published_class",
    "ratio_to_published_1",
    "inside_published_interval",
    "same_class",
    "prediction_low",
    "prediction_high",
    "use",
    "source",
    "status",
    "confidence",
    "published_place",
    "overridden",
    "phantom",
)
CROSS_TRIAL_COLUMNS = (
    "subject",
    "status",
    "J_within_mean_1",
    "J_cross_mean_1",
    "J_floor_1",
    "J_floor_low_1",
    "J_floor_high_1",
    "overhead_percent",
    "n_pairs",
    "place",
    "overridden",
    "phantom",
)


def priors_table(*, priors: Path, published: Path, out: Path) -> None:
    """Set our priors beside the paper's Table I: values, intervals, classes, ratio, and inside or not.

    Comparisons stay empty where our prior is the published one.
    """
    theirs = {
        row["parameter"]: row for row in read_table(published, ("parameter", "prior", "class", "place"))
    }
    rows: list[dict[str, Any]] = []
    for ours in read_table(priors, ("parameter", "prior", "source", "class")):
        paper = theirs[ours["parameter"]]
        row: dict[str, Any] = ours | {
            "published_prior": paper["prior"],
            "published_interval_low": paper["interval_low"],
            "published_interval_high": paper["interval_high"],
            "published_class": paper["class"],
            "published_place": paper["place"],
        }
        if not is_published(ours["source"]):
            value = number(ours["prior"])
            row["ratio_to_published_1"] = value / number(paper["prior"])
            inside = number(paper["interval_low"]) <= value <= number(paper["interval_high"])
            row["inside_published_interval"] = inside
            row["same_class"] = ours["class"] == paper["class"]
        rows.append(row)
    write_table(out, PRIORS_COLUMNS, rows)


def _cross_trial_row(record: dict[str, Any]) -> dict[str, Any]:
    row = {"subject": record["subject"], "phantom": record.get("phantom", False)}
    row["overridden"] = overridden_trials([record])
    if "overhead" not in record:
        return row | {"status": record["status"]}
    return row | {
        "status": "ok",
        "J_within_mean_1": record["J_within_mean"],
        "J_cross_mean_1": record["J_cross_mean"],
        "overhead_percent": 100.0 * record["overhead"],
        "n_pairs": len(record["pairs"]),
    }


def _published_cross_trial(published: Path) -> dict[str, Any]:
    rows = {row["quantity"]: row for row in read_table(published, ("quantity", "value", "place"))}
    return {
        "subject": "paper",
        "status": "published",
        "J_within_mean_1": rows["J_within_mean"]["value"],
        "J_cross_mean_1": rows["J_cross_mean"]["value"],
        "overhead_percent": rows["overhead_mean"]["value"],
        "place": rows["overhead_mean"]["place"],
        "phantom": False,
    }


def cross_trial_table(*, cross_trial: list[Path], floors: list[Path], published: Path, out: Path) -> None:
    """Cross-trial cost per person beside its noise floor, the mean over persons, and the published mean below.

    Costs J have no unit; the mean overhead is the mean of the persons' overheads. ``floors`` are those of
    `identification.noise_floor`; the study published none.
    """
    floor = {
        record["subject"]: record for record in (read_json(path, ("subject", "J", "ci95")) for path in floors)
    }
    records = [read_json(path, ("subject",)) for path in cross_trial]
    rows = [_cross_trial_row(record) for record in records]
    for row in rows:
        if row["subject"] in floor:
            low, high = floor[row["subject"]]["ci95"]
            row |= {"J_floor_1": floor[row["subject"]]["J"], "J_floor_low_1": low, "J_floor_high_1": high}
    rows.sort(key=lambda row: row["subject"])
    done = [row for row in rows if row["status"] == "ok"]
    mean: dict[str, Any] = {"subject": "mean", "phantom": any(row["phantom"] for row in rows)}
    mean["overridden"] = overridden_trials(records)
    if done:
        complete = len(done) == len(rows)
        mean["status"] = "ok" if complete else f"only {len(done)} of {len(rows)} people have a result"
        for key in ("J_within_mean_1", "J_cross_mean_1", "overhead_percent"):
            mean[key] = float(np.mean([row[key] for row in done]))
        if all("J_floor_1" in row for row in done):
            mean["J_floor_1"] = float(np.mean([row["J_floor_1"] for row in done]))
    else:
        missing = "needs two dynamic trials of a person, and nobody has them"
        mean["status"] = missing if rows else needs_people(1, 0)
    write_table(out, CROSS_TRIAL_COLUMNS, [*rows, mean, _published_cross_trial(published)])
