"""Restarts in trials in people: variance components by REML, and the interval that counts trials, not restarts.

The model is ln theta[s, t, r] = mu + person[s] + trial[s, t] + restart[s, t, r]. Restarts of one trial share its data:
they say how well the search repeats itself, not how well the parameter does. `icc` counts them as independent.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.optimize import minimize

from real2sim.artefacts import needs_people, number, read_table, write_table
from real2sim.inference.parameters import PARAMETERS, parameter_column, unit
from real2sim.study.statistics import icc as icc_module
from real2sim.study.statistics.shareability import classify

if TYPE_CHECKING:
    from real2sim.settings import StatisticsSettings

# Below this share of all variance, restarts (or trials) count as equal: rounding, or one search found twice.
EQUAL = 1e-8
# ln of a variance over that of the restarts that passes for zero
LOG_ZERO = -20.0
NESTED_COLUMNS = (
    "parameter",
    "unit",
    "status",
    "class",
    "icc_reml",
    "sd_person_ln",
    "sd_trial_ln",
    "sd_restart_ln",
    "method",
    "icc_trials",
    "trials_low",
    "trials_high",
    "class_by_fits",
    "fits_low",
    "fits_high",
    "n_subjects",
    "n_trials",
    "n_fits",
    "effective_fits",
    "balanced",
    "common_below",
    "distinct_from",
    "confidence",
    "overridden",
    "phantom",
)


@dataclass(frozen=True)
class Components:
    """Variances of ln between people, trials of a person and restarts of a trial, and what was found on the way.

    ``restart`` is NaN where no trial has two restarts: ``trial`` then holds both. ``notes`` say where an estimate
    lies on its boundary or none was found; ``method`` is "closed form", "MixedLM" or "none" (then all are NaN).
    """

    person: float
    trial: float
    restart: float
    method: str
    notes: tuple[str, ...] = ()

    @property
    def icc(self) -> float:
        """ICC, person / (person + trial + restart): how alike two trials of one person are, one fit each."""
        total = self.person + self.trial + (0.0 if np.isnan(self.restart) else self.restart)
        return self.person / total if total > 0 else float("nan")


# -------------------- variance components


def _codes(labels: np.ndarray) -> np.ndarray:
    return np.unique(labels, return_inverse=True)[1]


def _means(values: np.ndarray, codes: np.ndarray) -> np.ndarray:
    return np.bincount(codes, values) / np.bincount(codes)


def _ordered(mean_squares: np.ndarray, freedom: np.ndarray) -> np.ndarray:
    """Mean squares made non-increasing by pooling neighbours, each weighing its degrees of freedom."""
    blocks: list[list[float]] = []
    for ms, df in zip(mean_squares, freedom, strict=True):
        blocks.append([ms, df, 1])
        while len(blocks) > 1 and blocks[-1][0] > blocks[-2][0]:
            last = blocks.pop()
            both = blocks[-1]
            both[0] = (both[0] * both[1] + last[0] * last[1]) / (both[1] + last[1])
            both[1:] = [both[1] + last[1], both[2] + last[2]]
    return np.repeat([b[0] for b in blocks], [int(b[2]) for b in blocks])


def closed_form(values: np.ndarray, person: np.ndarray, trial: np.ndarray) -> np.ndarray:
    """Variances (person, trial, restart) from the nested ANOVA; REML itself where the design is balanced.

    ``values`` (n,), ``person`` (n,) and ``trial`` (n,) codes from 0, a trial belonging to one person. In a balanced
    design the three mean squares are independent multiples of chi-square, so that REML under non-negative variances is
    their isotonic regression. In an unbalanced one group sizes are averages, and this is a start for REML.
    """
    n, n_trials, n_people = len(values), trial.max() + 1, person.max() + 1
    owner = np.zeros(n_trials, int)
    owner[trial] = person
    of_trial, of_person = _means(values, trial), _means(values, person)
    ss = [
        np.sum((of_person[person] - values.mean()) ** 2),
        np.sum((of_trial[trial] - of_person[person]) ** 2),
        np.sum((values - of_trial[trial]) ** 2),
    ]
    df = np.array([n_people - 1, n_trials - n_people, n - n_trials], float)
    ms = _ordered(np.array(ss) / df, df)
    return np.array([(ms[0] - ms[1]) * n_people / n, (ms[1] - ms[2]) * n_trials / n, ms[2]])


def _is_balanced(person: np.ndarray, trial: np.ndarray) -> bool:
    per_trial, per_person = np.bincount(trial), np.bincount(person)
    return len(set(per_trial.tolist())) == 1 and len(set(per_person.tolist())) == 1


def _mixed_model(values: np.ndarray, person: np.ndarray, trial: np.ndarray | None) -> Any:
    """Random intercept per person, and one per trial unless trials are the rows; its likelihood is restricted."""
    from statsmodels.regression.mixed_linear_model import MixedLM, VCSpec

    ones = np.ones((len(values), 1))
    if trial is None:
        model = MixedLM(values, ones, groups=person, exog_re=ones)
    else:
        own = [_codes(trial[person == p]) for p in range(person.max() + 1)]
        columns = [[f"trial {t}" for t in range(codes.max() + 1)] for codes in own]
        spec = VCSpec(["trial"], [columns], [[np.eye(codes.max() + 1)[codes] for codes in own]])
        model = MixedLM(values, ones, groups=person, exog_re=ones, exog_vc=spec)
    # what its `fit` would set
    model.reml, model.cov_pen, model.fe_pen, model._cov_sing = True, None, None, 0
    return model


def mixed_model_reml(
    values: np.ndarray, person: np.ndarray, trial: np.ndarray | None, start: np.ndarray
) -> tuple[np.ndarray, bool]:
    """Variances (person, [trial,] rest) that maximise MixedLM's restricted likelihood, and whether they were found.

    ``values`` (n,), ``person`` and ``trial`` (n,) codes from 0, ``start`` variances. MixedLM's own optimisers work on
    square roots and say "converged" short of the maximum in a third of hard cases (restarts that nearly agree, a
    variance of zero); its likelihood is exact, and is maximised here over ln of the variance ratios.
    """
    from statsmodels.regression.mixed_linear_model import MixedLMParams

    centred = values - values.mean()
    scale = float(np.mean(centred**2))
    model = _mixed_model(centred / np.sqrt(scale), person, trial)

    def cost(log_ratio: np.ndarray) -> float:
        ratio = np.exp(log_ratio)
        at = MixedLMParams.from_components(
            fe_params=np.zeros(1), cov_re=np.array([[ratio[0]]]), vcomp=ratio[1:]
        )
        return -float(model.loglike(at, profile_fe=True))

    with np.errstate(all="ignore"), warnings.catch_warnings():
        # a covariance that is nearly singular is what the boundary looks like; it is told by `components`
        warnings.simplefilter("ignore")
        firsts = [np.log(np.maximum(start[:-1] / start[-1], 1e-4)), np.zeros(len(start) - 1)]
        runs = [
            minimize(
                cost,
                first,
                method="L-BFGS-B",
                bounds=[(LOG_ZERO, -LOG_ZERO)] * len(first),
                # shorter steps are lost in rounding where the restarts nearly agree
                options={"eps": 1e-4},
            )
            for first in firsts
        ]
        best = min(runs, key=lambda run: run.fun)
        found = best.x.copy()
        for i in range(len(found)):
            nothing = np.where(np.arange(len(found)) == i, LOG_ZERO, found)
            # towards zero the likelihood is flat, where a search ends anywhere
            if cost(nothing) <= best.fun + 1e-6:
                found = nothing
        ratio = np.exp(found)
        cov_re, vcomp = np.array([[ratio[0]]]), ratio[1:]
        rest = float(model.get_scale(model.get_fe_params(cov_re, vcomp)[0], cov_re, vcomp)) * scale
    ratio[found <= LOG_ZERO] = 0.0
    out = np.append(ratio, 1.0) * rest
    # a line search that gives up in the last digits is no failure where both starts end in one place
    ended = best.success or abs(runs[0].fun - runs[1].fun) < 1e-4
    return out, bool(ended and np.isfinite(out).all())


def _reml(values: np.ndarray, person: np.ndarray, trial: np.ndarray | None) -> tuple[np.ndarray, str, str]:
    """Variances (person, [trial,] rest), method and note: in closed form where the design is balanced."""
    if trial is None:
        rows = np.arange(len(values))
        twice = [np.repeat(each, 2) for each in (values, person, rows)]
        # each trial counted twice has restarts that agree: the rest of its closed form is the two-level one
        first = closed_form(*twice)[:2]
        balanced = _is_balanced(person, rows)
    else:
        first, balanced = closed_form(values, person, trial), _is_balanced(person, trial)
    if balanced:
        return first, "closed form", ""
    found, converged = mixed_model_reml(values, person, trial, first)
    if not converged:
        return np.full_like(first, np.nan), "none", "REML did not converge"
    return found, "MixedLM", ""


def components(values: np.ndarray, person: np.ndarray, trial: np.ndarray) -> Components:
    """REML estimate of the variance components of one parameter.

    ``values`` (n,) in ln-units; ``person`` and ``trial`` (n,) labels, where trials of two people may have one label.
    Raises ValueError unless there are two people, one of whom has two trials.
    """
    values, person = np.asarray(values, float), _codes(np.asarray(person))
    trial = _codes(np.array([f"{p}/{t}" for p, t in zip(person, trial, strict=True)]))
    n, n_trials, n_people = len(values), int(trial.max()) + 1, int(person.max()) + 1
    if n_people < 2 or n_trials == n_people:
        raise ValueError(f"a nested model needs two people and a second trial; got {n_people} and {n_trials}")
    rounding = n * (1e-10 * max(1.0, float(np.abs(values).max()))) ** 2
    within = float(np.sum((values - _means(values, trial)[trial]) ** 2))
    total = float(np.sum((values - values.mean()) ** 2))
    if total <= rounding:
        return Components(np.nan, np.nan, np.nan, "none", ("no variance: all fits are equal",))
    notes: list[str] = []
    repeated = n > n_trials
    if not repeated:
        notes.append("one restart per trial: trial and restart cannot be told apart")
    equal = repeated and within <= max(rounding, EQUAL * total)
    if repeated and not equal:
        found, method, note = _reml(values, person, trial)
    else:
        if equal:
            notes.append("restarts of a trial are equal")
        owner = np.zeros(n_trials, int)
        owner[trial] = person
        found, method, note = _of_trials(_means(values, trial), owner, rounding)
        # what is left between restarts is known without a model
        left = np.nan if not equal else within / (n - n_trials) if within > rounding else 0.0
        found = np.append(found, left)
    notes += [note] if note else []
    for variance, what in ((found[0], "between people"), (found[1], "between trials")):
        if variance == 0.0:
            notes.append(f"no variance {what}: REML on its boundary")
    return Components(float(found[0]), float(found[1]), float(found[2]), method, tuple(notes))


def _of_trials(values: np.ndarray, owner: np.ndarray, rounding: float) -> tuple[np.ndarray, str, str]:
    """Variances (person, trial) from one value per trial."""
    within = float(np.sum((values - _means(values, owner)[owner]) ** 2))
    total = float(np.sum((values - values.mean()) ** 2))
    if within <= max(rounding, EQUAL * total):
        # trials repeat each other exactly: no likelihood has a maximum, the means say it all
        spread = float(np.var(_means(values, owner), ddof=1))
        return np.array([spread, 0.0]), "closed form", "trials of a person are equal"
    return _reml(values, owner, None)


def effective_fits(found: Components, person: np.ndarray, trial: np.ndarray) -> float:
    """Return the number of independent fits that say as much about their person's value as all fits together.

    A person's n fits on m trials with R restarts each count n / (1 + (R - 1) c) times, c = trial / (trial + restart):
    m where restarts only repeat each other, n where trials do not differ. Summed over people; R is the mean there.
    ``person`` and ``trial`` (n,) are labels of all fits.
    """
    within = found.trial + found.restart
    if not np.isfinite(within):
        return float("nan")
    shared = found.trial / within if within > 0 else 1.0
    out = 0.0
    for p in np.unique(person):
        own = np.asarray(trial)[np.asarray(person) == p]
        per_trial = len(own) / len(np.unique(own))
        out += len(own) / (1 + (per_trial - 1) * shared)
    return out


# -------------------- the stage


def best_restarts(rows: list[dict[str, str]]) -> list[dict[str, str]]:
    """The fit with the lowest J of each trial (the first of equals), rows of the table of `shareability`."""
    best: dict[tuple[str, str], dict[str, str]] = {}
    for row in sorted(rows, key=lambda r: (r["subject"], r["trial"], int(r["restart"]))):
        key = row["subject"], row["trial"]
        if key not in best or number(row["J"]) < number(best[key]["J"]):
            best[key] = row
    return list(best.values())


def log_parameters(rows: list[dict[str, str]]) -> np.ndarray:
    """Logarithms of the parameters of rows of the table of `shareability`, (n, 12), SI units."""
    return np.log([[number(row[parameter_column(name)]) for name in PARAMETERS] for row in rows])


def fit_columns() -> tuple[str, ...]:
    """Columns of the table of all fits that this stage reads."""
    return "subject", "trial", "restart", "J", *map(parameter_column, PARAMETERS)


def _missing(rows: list[dict[str, str]], minimum: int) -> str:
    """Return the reason why there can be no nested model; empty if there can."""
    people = {row["subject"] for row in rows}
    if len(people) < minimum:
        return needs_people(minimum, len(people))
    if len({(row["subject"], row["trial"]) for row in rows}) == len(people):
        return "needs at least 2 trials of one person, have 1 each"
    return ""


def _rows(fits: list[dict[str, str]], settings: StatisticsSettings) -> list[dict[str, Any]]:
    person = np.array([row["subject"] for row in fits])
    trial = np.array([row["trial"] for row in fits])
    logs = log_parameters(fits)
    best = best_restarts(fits)
    anova = icc_module.one_way_anova(log_parameters(best), np.array([row["subject"] for row in best]))
    estimate = icc_module.icc_untruncated(anova)
    low, high = icc_module.exact_interval(anova, settings["confidence"])
    zones = {key: settings[key] for key in ("common_below", "distinct_from")}
    balanced = _is_balanced(_codes(person), _codes(np.char.add(np.char.add(person, "/"), trial)))
    rows: list[dict[str, Any]] = []
    for j in range(len(PARAMETERS)):
        found = components(logs[:, j], person, trial)
        defined = bool(np.isfinite(estimate[j]))
        rows.append(
            {
                "status": "; ".join(found.notes) or "ok",
                "class": classify(low[j], high[j], **zones) if defined else "uncertain",
                "icc_reml": found.icc,
                "sd_person_ln": float(np.sqrt(found.person)),
                "sd_trial_ln": float(np.sqrt(found.trial)),
                "sd_restart_ln": float(np.sqrt(found.restart)),
                "method": found.method,
                "icc_trials": float(estimate[j]),
                "trials_low": float(low[j]),
                "trials_high": float(high[j]),
                "effective_fits": effective_fits(found, person, trial),
                "balanced": balanced,
                "confidence": settings["confidence"],
                **zones,
            }
        )
    return rows


def nested_variance(*, fits: Path, icc: Path, settings: StatisticsSettings, out: Path) -> None:
    """Variance components of restarts in trials in people, and the class by an interval that counts trials.

    ``fits`` and ``icc`` are the tables of `shareability`; ``settings`` is the config slice ``statistics``. The interval
    is the exact F interval on one value per trial, its best restart; ``fits_low`` and ``fits_high`` beside it are those
    of ``icc``, which count every restart. Standard deviations in ln-units. With too few people, or one trial each,
    the table says so in ``status`` and holds no numbers.
    """
    records = read_table(fits, fit_columns())
    by_fits = {
        row["parameter"]: row
        for row in read_table(icc, ("parameter", "exact_low", "exact_high", "overridden", "phantom"))
    }
    missing = _missing(records, settings["min_subjects"])
    rows = [{"status": missing} for _ in PARAMETERS] if missing else _rows(records, settings)
    counts = {
        "n_subjects": len({row["subject"] for row in records}),
        "n_trials": len({(row["subject"], row["trial"]) for row in records}),
        "n_fits": len(records),
    }
    named = []
    for name, row in zip(PARAMETERS, rows, strict=True):
        beside = by_fits[name]
        old = {} if missing else {f"fits_{end}": beside[f"exact_{end}"] for end in ("low", "high")}
        old |= {} if missing else {"class_by_fits": beside["class_by_exact_interval"]}
        marks = {key: beside[key] for key in ("overridden", "phantom")}
        named.append({"parameter": name, "unit": unit(name)} | row | old | counts | marks)
    write_table(out, NESTED_COLUMNS, named)
