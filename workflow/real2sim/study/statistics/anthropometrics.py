"""Do mass, height and waist predict a person's parameters? A power law each, where there are people enough."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from real2sim.artefacts import needs_people, read_table, write_table
from real2sim.errors import InputError
from real2sim.inference.parameters import PARAMETERS, unit
from real2sim.recording.quality.verdict import overridden_trials
from real2sim.recording.subjects import SUBJECT_FILE, subject_values
from real2sim.study.statistics.nested import best_restarts, fit_columns, log_parameters
from real2sim.study.statistics.shareability import read_fits_table

if TYPE_CHECKING:
    from real2sim.settings import StatisticsSettings

ANTHROPOMETRICS_COLUMNS = (
    "parameter",
    "unit",
    "predictor",
    "status",
    "exponent",
    "exponent_low",
    "exponent_high",
    "p_value",
    "p_holm",
    "variance_inflation",
    "at_average",
    "average_of_predictor",
    "r_squared",
    "sd_residual_ln",
    "n_subjects",
    "n_needed",
    "confidence",
    "overridden",
    "phantom",
)


@dataclass(frozen=True)
class PowerLaw:
    """ln y = ln at_average + sum of exponent * ln(x / average): k predictors, exponents and intervals (k,)."""

    at_average: float
    exponent: np.ndarray
    low: np.ndarray
    high: np.ndarray
    p_value: np.ndarray
    r_squared: float
    sd_residual: float


def power_law(log_y: np.ndarray, log_x: np.ndarray, confidence: float) -> PowerLaw:
    """Least squares of ``log_y`` (n,) on ``log_x`` (n, k), centred, with t intervals (statsmodels OLS)."""
    import statsmodels.api as sm

    fit = sm.OLS(log_y, sm.add_constant(log_x - log_x.mean(axis=0), has_constant="add")).fit()
    low, high = fit.conf_int(alpha=1 - confidence).T
    return PowerLaw(
        float(np.exp(fit.params[0])),
        fit.params[1:],
        low[1:],
        high[1:],
        fit.pvalues[1:],
        float(fit.rsquared),
        float(np.sqrt(fit.scale)),
    )


def variance_inflation(log_x: np.ndarray) -> np.ndarray:
    """By how much the others blow up the variance of each exponent, (n, k) -> (k,); infinite if they fix it."""
    standard = (log_x - log_x.mean(axis=0)) / log_x.std(axis=0)
    correlation = standard.T @ standard / len(log_x)
    if np.linalg.cond(correlation) > 1e10:
        return np.full(log_x.shape[1], np.inf)
    return np.diag(np.linalg.inv(correlation))


def _holm(p_values: np.ndarray) -> np.ndarray:
    """Holm's correction for as many tests as there are values, (m,)."""
    order = np.argsort(p_values)
    steps = p_values[order] * np.arange(len(p_values), 0, -1)
    out = np.empty(len(p_values))
    out[order] = np.minimum(np.maximum.accumulate(steps), 1.0)
    return out


def _refusal(log_x: np.ndarray, predictors: list[str], needed: int) -> str:
    """Return the reason why nothing can be regressed on these people; empty if it can."""
    if len(log_x) < needed:
        of = f"{len(predictors)} predictor" + ("s" if len(predictors) > 1 else "")
        return f"{needs_people(needed, len(log_x))}: {of}"
    flat = [name for name, column in zip(predictors, log_x.T, strict=True) if np.ptp(column) < 1e-9]
    if flat:
        return f"{flat[0]} is the same for everybody"
    if np.isinf(variance_inflation(log_x)).any():
        return "the predictors determine each other"
    return ""


def _person_estimates(fits: list[dict[str, str]]) -> tuple[list[str], np.ndarray]:
    """People and the ln of their parameters (people, 12): mean over trials of the best restart."""
    best = best_restarts(fits)
    logs, names = log_parameters(best), [row["subject"] for row in best]
    people = sorted(set(names))
    return people, np.array([logs[[name == p for name in names]].mean(axis=0) for p in people])


def _bodies(subjects: list[Path], people: list[str], predictors: list[str]) -> np.ndarray:
    """Predictors of the people, (people, k), from their subject.yaml."""
    values = {v["id"]: v for v in (subject_values(path.parent) for path in subjects)}
    lost = [name for name in people if name not in values]
    if lost:
        raise InputError(
            lost[0], "", f"fits, but no {SUBJECT_FILE} among those given", "one per person", "Add the file."
        )
    return np.array([[float(values[name][key]) for key in predictors] for name in people])


def _rows(
    log_y: np.ndarray, log_x: np.ndarray, predictors: list[str], settings: StatisticsSettings
) -> list[dict[str, Any]]:
    inflation, averages = variance_inflation(log_x), np.exp(log_x.mean(axis=0))
    rows: list[dict[str, Any]] = []
    for j in range(len(PARAMETERS)):
        if np.ptp(log_y[:, j]) < 1e-9:
            rows += [{"status": "no variance: all people are equal"} for _ in predictors]
            continue
        law = power_law(log_y[:, j], log_x, settings["confidence"])
        for k in range(len(predictors)):
            rows.append(
                {
                    "status": "ok",
                    "exponent": float(law.exponent[k]),
                    "exponent_low": float(law.low[k]),
                    "exponent_high": float(law.high[k]),
                    "p_value": float(law.p_value[k]),
                    "variance_inflation": float(inflation[k]),
                    "at_average": law.at_average,
                    "average_of_predictor": float(averages[k]),
                    "r_squared": law.r_squared,
                    "sd_residual_ln": law.sd_residual,
                    "confidence": settings["confidence"],
                }
            )
    tested = [row for row in rows if row["status"] == "ok"]
    for row, p in zip(tested, _holm(np.array([row["p_value"] for row in tested])), strict=True):
        row["p_holm"] = float(p)
    return rows


def anthropometrics(*, fits: Path, subjects: list[Path], settings: StatisticsSettings, out: Path) -> None:
    """Regress ln of each person's parameters on ln of mass [kg], height and waist [m]: exponents with intervals.

    ``fits`` is the table of `shareability`, ``subjects`` are the people's subject.yaml. ``settings`` holds
    ``regression`` (``predictors``, ``people_per_predictor``) and ``confidence``. A person's estimate is the mean over
    trials of the best restart's ln. One row per parameter and predictor; below people_per_predictor people for each
    predictor the status says how many are needed, and there are no numbers. ``p_holm`` is corrected for all rows.
    """
    options = settings["regression"]
    predictors, records = options["predictors"], read_table(fits, (*fit_columns(), "phantom"))
    people, log_y = _person_estimates(records) if records else ([], np.empty((0, len(PARAMETERS))))
    log_x = np.log(_bodies(subjects, people, predictors).reshape(len(people), len(predictors)))
    # a residual needs more people than coefficients whatever the settings say
    needed = max(options["people_per_predictor"] * len(predictors), len(predictors) + 2)
    refused = _refusal(log_x, predictors, needed)
    blank: list[dict[str, Any]] = [{"status": refused} for _ in range(len(PARAMETERS) * len(predictors))]
    rows = blank if refused else _rows(log_y, log_x, predictors, settings)
    common = {
        "n_subjects": len(people),
        "n_needed": needed,
        "overridden": overridden_trials(read_fits_table(fits)),
        "phantom": any(row["phantom"] == "true" for row in records),
    }
    named = [(name, predictor) for name in PARAMETERS for predictor in predictors]
    write_table(
        out,
        ANTHROPOMETRICS_COLUMNS,
        [
            {"parameter": name, "unit": unit(name), "predictor": predictor} | row | common
            for (name, predictor), row in zip(named, rows, strict=True)
        ],
    )
