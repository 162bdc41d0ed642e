"""Causes by how near their cohorts come to the paper's numbers, and which of them the numbers cannot tell apart."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from real2sim.artefacts import finite_or_none, read_json, write_json, write_table
from real2sim.provenance import fingerprint
from real2sim.verification.paper_gap.people import published_j
from real2sim.verification.paper_gap.summary import GROUPS, HANGING, NUMBERS, Published, numbers_of

if TYPE_CHECKING:
    from real2sim.settings import Settings

COLUMNS = (
    "rank",
    "cause",
    "status",
    "size_median",
    "size_largest",
    "motion_share",
    "J_within",
    "overhead_cross_percent",
    "overhead_loso_percent",
    "same_classes",
    "k_rz_prior",
    "damping_ratios",
    *(f"distance_{group}" for group in GROUPS),
    "distance",
    "distance_low",
    "distance_high",
    "distance_free",
    "nearest_share",
    "nearest_share_free",
    "not_told_apart",
    "not_told_apart_free",
    "phantom",
)


def usual_misses(values: np.ndarray, paper: np.ndarray) -> np.ndarray:
    """Return by how much cohorts (c, k) usually miss each of the paper's numbers (k,): the median, over the cohorts.

    So a number that every cohort misses by the same tells none apart, and does not drown the others. Where more than
    half hit it the mean stands in; NaN where all do.
    """
    missed = np.abs(values - paper)
    usual = np.median(missed, axis=0)
    usual = np.where(usual > 0, usual, missed.mean(axis=0))
    return np.where(usual > 0, usual, np.nan)


def distances(values: np.ndarray, paper: np.ndarray, usual: np.ndarray) -> np.ndarray:
    """Return distances (c, 2 + g) of cohorts (c, k) from the paper (k,): of all groups, of the free ones, by group.

    Of a group the mean of its misses over the usual ones (`usual_misses`); of several the mean of the groups. Free are
    the groups that do not hang on which parameters the people truly have (`summary.HANGING`).
    """
    missed = np.abs(values - paper) / usual
    index = {name: i for i, name in enumerate(NUMBERS)}
    by_group = np.column_stack(
        [np.nanmean(missed[:, [index[name] for name in names]], axis=1) for names in GROUPS.values()]
    )
    free = [i for i, group in enumerate(GROUPS) if group not in HANGING]
    return np.column_stack([by_group.mean(axis=1), by_group[:, free].mean(axis=1), by_group])


def rank_causes(*, cohorts: list[Path], published: Path, settings: Settings, out: Path, table: Path) -> None:
    """Rank causes by how near their cohorts come to what the paper prints.

    Parameters
    ----------
    cohorts
        Files of `cohort.cohort_with_cause`.
    published
        Folder of the paper's tables, resources/published.
    settings
        Slices ``identification``, ``statistics`` and ``paper_gap`` of the configuration.
    out, table
        JSON with everything, CSV with `COLUMNS`. Causes that cannot cost the paper's J within
        ``paper_gap.j_tolerance`` have no rank; nor has one that leaves the recordings without an analysis.
    """
    paper = Published.read(published, settings["identification"]["at_bound_ln"])
    records = [read_json(path, ("cause", "status", "sealed")) for path in cohorts]
    wanted = published_j(published / "cross_trial.csv")
    for record in records:
        record["status"] = _status(record, wanted, settings["paper_gap"]["j_tolerance"])
    measured = [r for r in records if "people" in r]
    numbers = np.array([numbers_of(r["people"], paper, settings) for r in measured]).reshape(-1, len(NUMBERS))
    ranked = [i for i, r in enumerate(measured) if r["status"] == "ok"]
    goal = np.array([paper.values[name] for name in NUMBERS])
    usual = usual_misses(numbers[ranked], goal) if ranked else np.ones(len(NUMBERS))
    away = distances(numbers, goal, usual)
    resampled = _resampled([measured[i] for i in ranked], paper, goal, usual, settings)
    rows = [_row(r) for r in records if "people" not in r]
    for i, record in enumerate(measured):
        row = _row(record) | dict(zip(_DISTANCES, away[i].tolist(), strict=True))
        row |= {name: numbers[i][NUMBERS.index(name)] for name in ("same_classes", "damping_ratios")}
        row["k_rz_prior"] = float(np.exp(numbers[i][NUMBERS.index("prior_k_rz")]))
        row["numbers"] = dict(zip(NUMBERS, numbers[i].tolist(), strict=True))
        if i in ranked:
            own = ranked.index(i)
            low, high = np.quantile(resampled[:, own, 0], [0.05, 0.95])
            row |= {"distance_low": float(low), "distance_high": float(high)}
            for j, name in enumerate(("nearest_share", "nearest_share_free")):
                row[name] = float(np.mean(resampled[:, :, j].argmin(axis=1) == own))
        rows.append(row)
    _number(rows, settings["paper_gap"]["not_told_apart"])
    write_table(table, COLUMNS, rows)
    write_json(
        out,
        {
            "schema": 1,
            "rests_on": "phantom: synthetic people, each with one unmodelled effect",
            "published": {name: finite_or_none(value) for name, value in paper.values.items()},
            "J": wanted,
            "groups": list(GROUPS),
            "hanging": list(HANGING),
            "usual_misses": {n: finite_or_none(float(s)) for n, s in zip(NUMBERS, usual, strict=True)},
            "causes": [{key: _plain(value) for key, value in row.items()} for row in rows],
            "settings": settings["paper_gap"],
            "people": len(measured[0]["people"]) if measured else 0,
            "code_fingerprint": fingerprint(__name__),
        },
    )


_DISTANCES = ("distance", "distance_free", *(f"distance_{group}" for group in GROUPS))


def _plain(value: Any) -> Any:
    return finite_or_none(float(value)) if isinstance(value, float | np.floating) else value


def _status(record: Mapping[str, Any], wanted: float, tolerance: float) -> str:
    if "people" not in record:
        return str(record["status"])
    j = float(np.mean([person["J_within"] for person in record["people"]]))
    if abs(np.log(j / wanted)) > np.log1p(tolerance):
        return f"J {j:.3g}, not {wanted:g}"
    return "ok"


def _row(record: Mapping[str, Any]) -> dict[str, Any]:
    sealed = record["sealed"].values()
    sizes = [one["severity"] for one in sealed if "severity" in one]
    shares = [one["motion_share"] for one in sealed if "motion_share" in one]
    row: dict[str, Any] = {"cause": record["cause"], "status": record["status"], "phantom": True}
    if sizes:
        row |= {"size_median": float(np.median(sizes)), "size_largest": float(max(sizes))}
    row["motion_share"] = float(np.median(shares)) if shares else 1.0
    if "people" in record:
        people = record["people"]
        within, cross, loso = (
            np.array([person[key] for person in people]) for key in ("J_within", "J_cross", "overhead_loso_J")
        )
        row["J_within"] = float(within.mean())
        row["overhead_cross_percent"] = 100 * float(np.mean(cross / within - 1))
        row["overhead_loso_percent"] = 100 * float(loso.mean())
    return row


def _resampled(
    records: Sequence[Mapping[str, Any]],
    paper: Published,
    goal: np.ndarray,
    usual: np.ndarray,
    settings: Settings,
) -> np.ndarray:
    """Return distances (b, c, 2), of all groups and of the free ones, of cohorts whose people are drawn anew.

    The people drawn are the same for every cause.
    """
    options = settings["paper_gap"]
    rng = np.random.default_rng(settings["statistics"]["seed"])
    people = len(records[0]["people"]) if records else 0
    rows: list[np.ndarray] = []
    while len(rows) < options["resamples"] and records:
        drawn = rng.integers(people, size=people)
        if len(set(drawn.tolist())) < 2:  # one person, five times: nothing is between people
            continue
        numbers = np.array([numbers_of([r["people"][i] for i in drawn], paper, settings) for r in records])
        rows.append(distances(numbers, goal, usual)[:, :2])
    return np.array(rows)


def _number(rows: list[dict[str, Any]], share: float) -> None:
    """Give ranks to rows with ``nearest_share``, nearest first, and mark those that cannot be told from the first."""
    rows.sort(key=lambda row: (row["status"] != "ok", row.get("distance", np.inf), row["cause"]))
    ranked = [row for row in rows if "nearest_share" in row]
    for rank, row in enumerate(ranked, 1):
        row["rank"] = rank
    for end in ("", "_free"):
        nearest = min((float(row[f"distance{end}"]) for row in ranked), default=0.0)
        for row in ranked:
            near = row[f"distance{end}"] == nearest or row[f"nearest_share{end}"] >= share
            row[f"not_told_apart{end}"] = bool(near)
