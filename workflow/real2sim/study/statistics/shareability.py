"""Which parameters are shared between people, and the priors that follow (paper eqs. 4-6)."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.special import stdtrit

from real2sim.artefacts import (
    needs_people,
    number,
    read_json,
    read_table,
    write_table,
)
from real2sim.errors import InputError
from real2sim.inference.parameters import PARAMETERS, parameter_column, unit
from real2sim.recording.quality.verdict import overridden_trials
from real2sim.study.statistics import icc as icc_module

if TYPE_CHECKING:
    from real2sim.settings import StatisticsSettings

USE = {
    "common": "fixed at the prior",
    "distinct": "calibrated per person",
    "uncertain": "refined inside the interval",
}
ICC_COLUMNS = (
    "parameter",
    "unit",
    "status",
    "class",
    "class_by_exact_interval",
    "icc",
    "icc_untruncated",
    "bootstrap_low",
    "bootstrap_high",
    "exact_low",
    "exact_high",
    "sd_between_ln",
    "sd_within_ln",
    "share_at_bound",
    "n_subjects",
    "n_fits",
    "balanced",
    "common_below",
    "distinct_from",
    "confidence",
    "bootstrap_resamples",
    "bootstrap_one_subject",
    "bootstrap_undefined",
    "seed",
    "overridden",
    "phantom",
)
PRIOR_COLUMNS = (
    "parameter",
    "unit",
    "prior",
    "interval_low",
    "interval_high",
    "class",
    "prediction_low",
    "prediction_high",
    "use",
    "source",
    "status",
    "confidence",
    "n_subjects",
    "n_fits",
    "overridden",
    "phantom",
)


def classify(low: float, high: float, *, common_below: float, distinct_from: float) -> str:
    """Class of a parameter by where the interval of its ICC falls (paper eq. 6).

    An interval that does not exist (NaN) falls under the equation's "otherwise": uncertain.
    """
    if high < common_below:
        return "common"
    if low >= distinct_from:
        return "distinct"
    return "uncertain"


def point_prior(values: np.ndarray) -> np.ndarray:
    """Return the geometric mean over the fits, (n, p) -> (p,): exp of the log grand mean (paper eq. 6)."""
    mean: np.ndarray = np.exp(np.log(values).mean(axis=0))
    return mean


def empirical_spread(values: np.ndarray, confidence: float) -> tuple[np.ndarray, np.ndarray]:
    """Central empirical percentiles over the fits, (n, p) -> two (p,): 2.5 and 97.5 % at 0.95."""
    low, high = np.quantile(values, [(1 - confidence) / 2, (1 + confidence) / 2], axis=0)
    return low, high


def prediction_interval(
    values: np.ndarray, subjects: Sequence[str], confidence: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return Student's prediction interval in ln of the next person's parameters, (n, p) -> two (p,).

    People are the repeats, each by the mean of ln over their fits: geometric mean times exp(±t SD sqrt(1 + 1/N)).
    Unlike the spread of the fits it grows as people get fewer. NaN with fewer than two people.
    """
    names = np.asarray(subjects)
    means = np.array([np.log(values[names == name]).mean(axis=0) for name in np.unique(names)])
    people = len(means)
    if people < 2:
        return np.full(values.shape[1], np.nan), np.full(values.shape[1], np.nan)
    reach = stdtrit(people - 1, (1 + confidence) / 2) * means.std(axis=0, ddof=1) * np.sqrt(1 + 1 / people)
    return np.exp(means.mean(axis=0) - reach), np.exp(means.mean(axis=0) + reach)


def read_fits(paths: Sequence[Path]) -> list[dict[str, Any]]:
    """Read fit files, sorted by subject, trial and restart whatever the order of the paths.

    Raises InputError for a missing key, a parameter that is not positive, a fit given twice, or a cohort that
    mixes phantom and real people.
    """
    fits: list[dict[str, Any]] = []
    seen: dict[tuple[str, str, int], Path] = {}
    for path in paths:
        fit = read_json(path, ("subject", "trial", "restart", "parameters", "cost", "phantom"))
        bad = [n for n in PARAMETERS if not fit["parameters"].get(n, 0) > 0]
        if bad:
            found = ", ".join(f"{n} = {fit['parameters'].get(n)}" for n in bad)
            raise InputError(
                path, "parameters", found, "twelve positive numbers", "Delete the fit and run again."
            )
        key = (fit["subject"], fit["trial"], fit["restart"])
        if key in seen:
            raise InputError(
                path,
                "",
                f"the fit {key} that {seen[key]} holds too",
                "each fit once",
                "Delete one of the two.",
            )
        seen[key] = path
        if fits and fit["phantom"] != fits[0]["phantom"]:
            raise InputError(
                path,
                "phantom",
                str(fit["phantom"]),
                f"{fits[0]['phantom']} as in {paths[0]}",
                "Analyse phantom and real people in separate runs.",
            )
        fits.append(fit)
    return sorted(fits, key=lambda f: (f["subject"], f["trial"], f["restart"]))


def read_fits_table(path: Path) -> list[dict[str, Any]]:
    """Fits of the table that `shareability` writes: subject, parameters [SI] and gates that were overridden."""
    rows = read_table(path, ("subject", "overridden_gates", *map(parameter_column, PARAMETERS)))
    return [
        {
            "subject": row["subject"],
            "parameters": {name: number(row[parameter_column(name)]) for name in PARAMETERS},
            "overridden_gates": json.loads(row["overridden_gates"] or "{}"),
        }
        for row in rows
    ]


def parameter_matrix(fits: Sequence[dict[str, Any]]) -> np.ndarray:
    """Parameters of the fits as (n, 12), columns in the order of PARAMETERS, SI units."""
    return np.array([[fit["parameters"][n] for n in PARAMETERS] for fit in fits], float)


def _fit_row(fit: dict[str, Any]) -> dict[str, Any]:
    row: dict[str, Any] = {k: fit[k] for k in ("subject", "trial", "restart", "phantom")}
    row["J"] = fit["cost"]["J"]
    row["rmse_position_m"] = fit["cost"]["rmse_position_m"]
    row["at_bound"] = " ".join(fit.get("at_bound", []))
    row["overridden"] = overridden_trials([fit])
    row["overridden_gates"] = json.dumps(fit["overridden_gates"]) if fit.get("overridden_gates") else ""
    return row | {parameter_column(n): float(fit["parameters"][n]) for n in PARAMETERS}


def _icc_rows(fits: list[dict[str, Any]], settings: StatisticsSettings) -> list[dict[str, Any]]:
    subjects = np.array([fit["subject"] for fit in fits])
    logs = np.log(parameter_matrix(fits))
    anova = icc_module.one_way_anova(logs, subjects)
    estimate, truncated = icc_module.icc_untruncated(anova), icc_module.icc_truncated(anova)
    exact = icc_module.exact_interval(anova, settings["confidence"])
    boot = icc_module.cluster_bootstrap(
        logs,
        subjects,
        resamples=settings["bootstrap"],
        seed=settings["seed"],
        confidence=settings["confidence"],
    )
    between, within = icc_module.variance_components(anova)
    zones = {k: settings[k] for k in ("common_below", "distinct_from")}
    balanced = len(set(np.unique(subjects, return_counts=True)[1].tolist())) == 1
    rows: list[dict[str, Any]] = []
    for j, name in enumerate(PARAMETERS):
        rows.append(
            {
                "status": "ok" if np.isfinite(estimate[j]) else "no variance: all fits are equal",
                "class": classify(boot.low[j], boot.high[j], **zones),
                "class_by_exact_interval": classify(exact[0][j], exact[1][j], **zones),
                "icc": float(truncated[j]),
                "icc_untruncated": float(estimate[j]),
                "bootstrap_low": float(boot.low[j]),
                "bootstrap_high": float(boot.high[j]),
                "exact_low": float(exact[0][j]),
                "exact_high": float(exact[1][j]),
                "sd_between_ln": float(np.sqrt(between[j])),
                "sd_within_ln": float(np.sqrt(within[j])),
                "share_at_bound": float(np.mean([name in fit.get("at_bound", []) for fit in fits])),
                "balanced": balanced,
                "confidence": settings["confidence"],
                **zones,
                "bootstrap_resamples": boot.resamples,
                "bootstrap_one_subject": boot.one_subject,
                "bootstrap_undefined": int(boot.undefined[j]),
                "seed": settings["seed"],
            }
        )
    return rows


def _missing(fits: list[dict[str, Any]], minimum: int) -> str:
    """Return the reason why there can be no ICC; empty if there can."""
    subjects = {fit["subject"] for fit in fits}
    if len(subjects) < minimum:
        return needs_people(minimum, len(subjects))
    if len(fits) == len(subjects):
        return "needs at least 2 fits of one person, have 1 each"
    return ""


def shareability(*, fits: list[Path], settings: StatisticsSettings, out_fits: Path, out_icc: Path) -> None:
    """Collect all fits in one table and compute ICC, intervals and class of each parameter.

    ``settings`` is the config slice ``statistics``. Parameters in the wide table carry their SI unit in the
    column name. With too few people the ICC table says so in ``status`` and holds no numbers.
    """
    records = read_fits(fits)
    parameters = [parameter_column(n) for n in PARAMETERS]
    columns = ["subject", "trial", "restart", "J", "rmse_position_m", *parameters, "at_bound"]
    columns += ["overridden", "overridden_gates", "phantom"]
    write_table(out_fits, columns, [_fit_row(fit) for fit in records])
    missing = _missing(records, settings["min_subjects"])
    rows = [{"status": missing} for _ in PARAMETERS] if missing else _icc_rows(records, settings)
    common = {
        "n_subjects": len({fit["subject"] for fit in records}),
        "n_fits": len(records),
        "overridden": overridden_trials(records),
        "phantom": records[0]["phantom"] if records else False,
    }
    named = [
        {"parameter": n, "unit": unit(n)} | row | common for n, row in zip(PARAMETERS, rows, strict=True)
    ]
    write_table(out_icc, ICC_COLUMNS, named)


# Begins the column ``source`` where the published table stands in
_PUBLISHED = "published"


def is_published(source: str) -> bool:
    """Return whether a prior of this source is the paper's, in place of one of the fits."""
    return source.startswith(_PUBLISHED)


def rests_on_study(row: Mapping[str, str]) -> bool:
    """Return whether a row of a table of priors holds what a study found; the published table has no source."""
    return "source" in row and not is_published(row["source"])


def _published_row(row: dict[str, str], status: str) -> dict[str, Any]:
    return {
        "prior": number(row["prior"]),
        "interval_low": number(row["interval_low"]),
        "interval_high": number(row["interval_high"]),
        "class": row["class"],
        "use": USE[row["class"]],
        "source": f"{_PUBLISHED} ({row['place']})",
        "status": status,
    }


def priors(*, fits: Path, icc: Path, published: Path, settings: StatisticsSettings, out: Path) -> None:
    """Prior and search ranges of each parameter: spread of the fits, and where the next person is expected.

    ``prior`` is the geometric mean, ``interval_*`` the empirical 95 % spread (paper eq. 6), ``prediction_*`` that of
    `prediction_interval`. ``fits`` and ``icc`` are the tables of `shareability`, ``published`` is
    resources/published/table1_priors.csv and stands in, marked as such in ``source``, where there are too few
    people for an ICC.
    """
    fit_rows = read_table(fits, ["subject", *(parameter_column(n) for n in PARAMETERS)])
    subjects = [row["subject"] for row in fit_rows]
    icc_rows = {
        row["parameter"]: row
        for row in read_table(icc, ("parameter", "status", "class", "overridden", "phantom"))
    }
    stand_in = {
        row["parameter"]: row for row in read_table(published, ("parameter", "prior", "class", "place"))
    }
    rows: list[dict[str, Any]] = []
    for name in PARAMETERS:
        found = icc_rows[name]
        row: dict[str, Any]
        if found["class"]:
            values = np.array([[number(r[parameter_column(name)])] for r in fit_rows])
            low, high = empirical_spread(values, settings["confidence"])
            next_low, next_high = prediction_interval(values, subjects, settings["confidence"])
            row = {
                "prior": float(point_prior(values)[0]),
                "interval_low": float(low[0]),
                "interval_high": float(high[0]),
                "class": found["class"],
                "prediction_low": float(next_low[0]),
                "prediction_high": float(next_high[0]),
                "use": USE[found["class"]],
                "source": "this cohort",
                "status": found["status"],
                "confidence": settings["confidence"],
            }
        else:
            row = _published_row(stand_in[name], found["status"])
        # Counts and status rest on this cohort also where the numbers are the paper's.
        cohort = {key: found[key] for key in ("n_subjects", "n_fits", "overridden", "phantom")}
        rows.append({"parameter": name, "unit": unit(name)} | row | cohort)
    write_table(out, PRIOR_COLUMNS, rows)
