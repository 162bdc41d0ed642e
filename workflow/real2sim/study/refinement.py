"""A new person from the priors: what the cohort leaves open is refined on their trials, the rest stays at the prior.

The paper maps each parameter to a fixed prior (common), to an interval to search (uncertain) or to a calibration of its
own (distinct; eq. 6) and leaves the search inside the intervals to future work (section III-C). Here it is: bounded
least squares from the point prior over the free parameters alone. Beside it stand the point prior, a full calibration
where there is one, and what each fixed parameter would gain if it were free too.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import permutations
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from real2sim.artefacts import number, read_json, read_table, write_json
from real2sim.errors import InputError
from real2sim.inference.identifiability import (
    NORMAL_95,
    AssessedParameter,
    Options,
    central_jacobian,
    information,
)
from real2sim.inference.least_squares import Residuals, minimise
from real2sim.inference.noise_floor import Floor
from real2sim.inference.parameters import PARAMETERS, Bounds, as_dict, as_vector, unit
from real2sim.provenance import fingerprint, provenance
from real2sim.recording.quality.verdict import held_back, overridden_gates, require
from real2sim.recording.trial import TrialModel, trial_model, with_step
from real2sim.study.assessment import assess_model, pelvis_marker_noise
from real2sim.study.fit import BATCH, best_of
from real2sim.study.noise_floor import floor_of_trial
from real2sim.study.statistics.loso import overhead
from real2sim.study.statistics.shareability import USE, rests_on_study

if TYPE_CHECKING:
    from real2sim.settings import Settings

OK = "ok"
PREDICTION = "prediction"
_NOT_HELD = ": the interval does not hold this person"
ASKED = "free by refinement.also_free"
ALIKE = "fixed at the prior: the others' fits are alike"
# Rounding of a geometric mean of many fits, and a width that no cost tells from none [ln]
_ROUNDING_LN, _NO_ROOM_LN = 1e-9, 1e-4
# A refinement is as good as a full calibration up to this, and worth it below that share of its evaluations
J_BAR, EVALUATIONS_BAR = 1.02, 0.25
_PACKAGES = ["mujoco", "numpy", "scipy"]


@dataclass(frozen=True)
class Search:
    """Start of a refinement and the parameters that it may change.

    ``prior`` (12,) [SI]; ``bounds`` of the search, the interval's for what is refined inside it; ``free`` (k,) indices
    of what moves; ``use`` of each parameter by name.
    """

    prior: np.ndarray
    bounds: Bounds
    free: np.ndarray
    use: dict[str, str]


def read_search(priors: Path, bounds: Bounds, also_free: Iterable[str], interval: str = PREDICTION) -> Search:
    """Read what priors.csv leaves open, inside the bounds of the search.

    Parameters
    ----------
    priors
        Table of `statistics.shareability.priors`, or the published one, which has no column ``use``.
    bounds
        Of the search: intervals are clipped to them, and they hold what is calibrated per person.
    interval
        ``prediction``: where the next person is expected, where the table has it; ``spread``: that of the fits (paper).
    also_free
        Names of parameters that are free whatever their class, inside the bounds of the search.

    Raises
    ------
    InputError
        Where a parameter is missing, its class unknown, its prior outside the bounds or its interval empty.
    """
    columns = ("parameter", "prior", "interval_low", "interval_high", "class")
    rows = {row["parameter"]: row for row in read_table(priors, columns)}
    prior, lower, upper = np.empty(12), bounds.lower.copy(), bounds.upper.copy()
    free, use = [], {}
    for i, name in enumerate(PARAMETERS):
        row = rows.get(name)
        if row is None or row["class"] not in USE:
            found = f"class {row['class']!r}" if row else "no such row"
            raise _unusable(priors, name, found, f"one of {', '.join(USE)}")
        prior[i] = number(row["prior"])
        low, high = _interval(row, interval)
        # a prior on a bound may be beyond it by rounding
        within = np.clip(prior[i], bounds.lower[i], bounds.upper[i])
        prior[i] = within if abs(np.log(prior[i] / within)) < _ROUNDING_LN else prior[i]
        if not bounds.lower[i] <= prior[i] <= bounds.upper[i]:
            inside = f"within identification.bounds, {bounds.lower[i]:g} to {bounds.upper[i]:g}"
            raise _unusable(priors, name, f"prior {row['prior'] or 'missing'}", inside)
        use[name] = row.get("use") or USE[row["class"]]
        if name in also_free:
            use[name] = ASKED
        elif use[name] == USE["common"]:
            continue
        elif use[name] == USE["uncertain"]:
            lower[i], upper[i] = max(low, lower[i]), min(high, upper[i])
            if not np.log(lower[i] / upper[i]) < _ROUNDING_LN:
                raise _unusable(
                    priors, name, f"interval [{low:g}, {high:g}]", "one that reaches into the bounds"
                )
            if np.log(upper[i] / lower[i]) < _NO_ROOM_LN:
                use[name] = ALIKE
                continue
        free.append(i)
    start = np.clip(prior, lower, upper)
    fixed = np.setdiff1d(np.arange(12), free)
    start[fixed] = prior[fixed]
    return Search(start, Bounds(lower, upper), np.array(free, int), use)


def _interval(row: Mapping[str, str], kind: str) -> tuple[float, float]:
    """Return the ends of a parameter's interval; a table without predictions has its spread."""
    ends = "prediction" if kind == PREDICTION and row.get("prediction_low") else "interval"
    return number(row[f"{ends}_low"]), number(row[f"{ends}_high"])


def _unusable(priors: Path, name: str, found: str, expected: str) -> InputError:
    return InputError(
        priors, f"parameter {name}", found, expected, "Correct the table, or delete it and run again."
    )


@dataclass(frozen=True)
class Refined:
    """Outcome: values (12,) [SI], of which the fixed are the prior's to the last bit; J; evaluations; J after each."""

    values: np.ndarray
    cost: float
    evaluations: int
    history: list[tuple[int, float]]


def refine_residuals(
    residuals: Callable[[np.ndarray], np.ndarray],
    search: Search,
    *,
    batch: int,
    iterations: int,
    ftol: float,
    start: np.ndarray | None = None,
) -> Refined:
    """Minimise a sum of squares over the free parameters, from the prior or another start (12,) [SI].

    ``residuals`` maps parameters (m, 12) to (m, n_r); ``iterations`` and ``ftol`` as in `least_squares.search`.
    """
    problem = Residuals(residuals, search.bounds, batch)
    begin = search.prior if start is None else start
    if not len(search.free):
        cost = float(problem.costs(np.log(begin)[None])[0])
        return Refined(search.prior.copy(), cost, problem.evaluations, [(1, cost)])
    z, cost, history, _ = minimise(problem, np.log(begin), search.free, iterations=iterations, ftol=ftol)
    values = search.prior.copy()
    ends = search.bounds.lower[search.free], search.bounds.upper[search.free]
    values[search.free] = np.clip(np.exp(z[search.free]), *ends)
    return Refined(values, cost, problem.evaluations, history)


def would_gain(
    residuals: Callable[[np.ndarray], np.ndarray],
    sample: np.ndarray,
    refined: Refined,
    search: Search,
    bounds: Bounds,
    *,
    batch: int,
    lags: int,
    settings: Options,
) -> tuple[dict[str, dict[str, Any]], int]:
    """Return what J falls to if one more parameter is free inside ``bounds``, and whether noise would do as much.

    ``residuals`` maps parameters (m, 12) [SI] to (m, n_r), ``sample`` (n_r,) is the sample index of each.
    ``settings`` is the slice ``identifiability``; ``lags`` the range of autocorrelation [samples]. The threshold is
    that of the 95 % profile (`identifiability`). Returns ``{parameter: J, gain, value, contradicts_prior}``, largest
    gain first, and the evaluations.
    """
    problem = Residuals(residuals, bounds, batch)
    z = np.log(refined.values)
    residual, jacobian = central_jacobian(problem, z, settings["step_ln"])
    out = {}
    for i in np.setdiff1d(np.arange(12), search.free):
        free = np.sort(np.append(search.free, i))
        wider = opened(search, bounds, [PARAMETERS[i]]).bounds
        problem.lower, problem.upper = np.log(wider.lower), np.log(wider.upper)
        best, cost, _, _ = minimise(problem, z, free, iterations=settings["profile_iterations"], ftol=1e-4)
        inflation = information(residual, jacobian, sample, free, lags=lags).inflation[i]
        gain = refined.cost - cost
        out[PARAMETERS[i]] = {
            "J": cost,
            "gain": gain / refined.cost,
            "value": float(np.exp(best[i])),
            "contradicts_prior": bool(gain > NORMAL_95**2 * inflation),
        }
    ordered = dict(sorted(out.items(), key=lambda item: -item[1]["gain"]))
    return ordered, problem.evaluations


def ends_reached(values: np.ndarray, search: Search, bounds: Bounds, tolerance: float) -> dict[str, str]:
    """Return the free parameters of (12,) that stand within ``tolerance`` (ln-units) of an end, and what that means.

    An end of an interval that is as near to one of the ``bounds`` of the search is called by that name.
    """
    at_end = search.bounds.at_bound(values, tolerance)
    at_bound = bounds.at_bound(values, 2 * tolerance)
    out = {}
    for i in search.free.tolist():
        name = PARAMETERS[i]
        if name not in at_end:
            continue
        side = "lower" if values[i] ** 2 < search.bounds.lower[i] * search.bounds.upper[i] else "upper"
        if name in at_bound:
            out[name] = f"at the {side} bound of the search: the optimum may lie beyond it"
        else:
            out[name] = f"at the {side} end of the interval{_NOT_HELD}"
    return out


def refine(
    *,
    subject: str,
    priors: Path,
    poses: list[Path],
    markers: list[Path],
    neutral_pose: Path,
    neutral_markers: Path,
    neutral_quality: Path,
    gates: list[Path],
    robot: Path,
    settings: Settings,
    in_priors: bool,
    out: Path,
    limits: Path | None = None,
    step: Path | None = None,
    fits: list[Path] | None = None,
) -> None:
    """Refine one person's open parameters on each dynamic trial and on all of them together.

    Parameters
    ----------
    priors, in_priors
        Table of priors with class and interval per parameter; whether the person is one of the study behind it.
    poses, markers
        Canonical tables of the dynamic trials, in one order; none if there are none.
    neutral_pose, neutral_markers, neutral_quality
        Tables of the person's neutral trial: noise of the markers, and how much of J is noise.
    gates
        results/quality/<SUBJECT>/<TRIAL>.json of the dynamic trials and of those that a fit rests on. A dynamic trial
        that a gate refuses is left out, and the file names it.
    settings
        Slices ``identification``, ``identifiability``, ``ingest``, ``plant``, ``refinement`` and ``robot``.
    limits, step, fits
        Joint limits and step study of the person, without which nothing is refined; fits of a full calibration.
    out
        JSON: the person's parameters with their ends; per trial J and position RMSE [m] at the prior, refined and fully
        calibrated, evaluations, verdicts, what more would gain; the same on the other trials; the noise floor.
    """
    bounds, options = Bounds.from_config(settings["identification"]["bounds"]), settings["refinement"]
    search = read_search(priors, bounds, options["also_free"], options["interval"])
    refused = held_back(gates)
    usable = _usable(subject, poses, markers, refused)
    status = _status(poses, list(usable), limits, step, refused)
    record = _about(subject, status, neutral_quality, refused) | _behind_priors(priors, in_priors)
    record |= {"free": [PARAMETERS[i] for i in search.free], "also_free": list(options["also_free"])}
    result = _Result(search.prior)
    used = [path for path in (limits, step) if path is not None]
    if status == OK and limits is not None and step is not None:
        neutral = _Neutral(neutral_pose, neutral_markers, neutral_quality)
        person = _Person(subject, usable, neutral, limits, robot, with_step(settings, step))
        result = person.refine(search, bounds, gates, refused, fits or [])
        used += [path for tables in usable.values() for path in tables]
    record["overridden_gates"] = result.overridden
    source = provenance([priors, robot, *used], _PACKAGES, fingerprint(__name__))
    slices = {key: settings[key] for key in ("refinement", "plant", "identification")}
    parameters = _parameters(result.values, search, result.ends, status)
    rest = {"settings": slices, "provenance": source}
    write_json(out, record | {"parameters": parameters} | result.found() | rest)


def _usable(
    subject: str, poses: list[Path], markers: list[Path], refused: Mapping[str, Sequence[str]]
) -> dict[str, tuple[Path, Path]]:
    """Return pose and marker tables of the dynamic trials that no gate refuses, by trial."""
    pairs = zip(poses, markers, strict=True)
    return {p.parent.name: (p, m) for p, m in pairs if f"{subject}/{p.parent.name}" not in refused}


def _about(
    subject: str, status: str, neutral_quality: Path, refused: Mapping[str, Sequence[str]]
) -> dict[str, Any]:
    """Return the head of the file: whom it is about, its status, and which gates were refused or overridden."""
    return {
        "schema": 1,
        "subject": subject,
        "phantom": bool(read_json(neutral_quality).get("phantom", False)),
        "status": status,
        "overridden_gates": {},
        "refused_gates": refused,
    }


def _behind_priors(priors: Path, in_priors: bool) -> dict[str, Any]:
    """Return whether the person and which refused trials are behind the priors; none where the published stand in."""
    found = [row for row in read_table(priors) if rests_on_study(row)]
    return {
        "prior_rests_on_person": in_priors and bool(found),
        "priors_rest_on_refused": sorted(
            {trial for row in found for trial in row.get("overridden", "").split()}
        ),
    }


@dataclass(frozen=True)
class _Result:
    """Values (12,) [SI] of a person and figures about them; the prior and empty fields where nothing was refined."""

    values: np.ndarray
    ends: dict[str, str] = field(default_factory=dict)
    overridden: dict[str, list[str]] = field(default_factory=dict)
    trials: dict[str, dict[str, Any]] = field(default_factory=dict)
    pooled: dict[str, Any] | None = None
    cross_trial: dict[str, Any] | None = None
    noise_floor: Floor | None = None

    def found(self) -> dict[str, Any]:
        """Return what was found, as the file has it."""
        names = ("trials", "pooled", "cross_trial", "noise_floor")
        return {name: getattr(self, name) for name in names}


@dataclass(frozen=True)
class _Neutral:
    """Canonical tables of a neutral trial."""

    pose: Path
    markers: Path
    quality: Path


@dataclass(frozen=True)
class _Person:
    """Files and settings that a refinement of one person rests on.

    ``trials`` pose and marker tables of the dynamic trials by name; ``settings`` with the time step of the person.
    """

    subject: str
    trials: Mapping[str, tuple[Path, Path]]
    neutral: _Neutral
    limits: Path
    robot: Path
    settings: Settings

    def model(self, pose: Path, markers: Path, nsim: int) -> TrialModel:
        """Return the replay and cost of a trial, for batches of ``nsim``."""
        return trial_model(
            pose=pose,
            markers=markers,
            limits=self.limits,
            robot=self.robot,
            settings=self.settings,
            nsim=nsim,
        )

    def refine(
        self,
        search: Search,
        bounds: Bounds,
        gates: Sequence[Path],
        refused: Mapping[str, Sequence[str]],
        fits: Sequence[Path],
    ) -> _Result:
        """Refine the open parameters on every trial and on all of them; arguments as of `refine` and `read_search`."""
        kept = [path for path in gates if f"{self.subject}/{path.stem}" not in refused]
        models = {name: self.model(*tables, nsim=BATCH) for name, tables in self.trials.items()}
        overridden = overridden_gates([{"overridden_gates": require(kept, name)} for name in models])
        for model in models.values():
            model.replay.check_bounds(bounds.upper[6:])
        noise = pelvis_marker_noise(self.neutral.quality, self.settings["ingest"]["rate_hz"])
        full = _full(fits, models)
        values, trials, pooled, cross = _refine_all(
            self.subject, models, search, bounds, noise, full, self.robot, self.settings
        )
        quiet = self.model(self.neutral.pose, self.neutral.markers, nsim=1)
        floor = floor_of_trial(quiet, values, self.settings["identifiability"])
        ends = ends_reached(values, search, bounds, self.settings["identification"]["at_bound_ln"])
        return _Result(values, ends, overridden, trials, pooled, cross, floor)


def _status(
    poses: Sequence[Path],
    usable: Sequence[str],
    limits: Path | None,
    step: Path | None,
    refused: Mapping[str, Sequence[str]],
) -> str:
    """Return ``ok``, or why nothing can be refined and the point prior stands."""
    dynamic = {path.parent.name for path in poses}
    elsewhere = {trial: names for trial, names in refused.items() if trial.split("/")[1] not in dynamic}
    if not poses:
        return "no dynamic trial: nothing to refine on, the point prior stands"
    if limits is None or step is None:
        return "no joint limits, as the sweeps at T* are missing: the point prior stands"
    if elsewhere:
        listed = "; ".join(f"{trial}: {', '.join(gates)}" for trial, gates in elsewhere.items())
        return f"refused by its gates, and every fit rests on it ({listed}): the point prior stands"
    if not usable:
        return "every dynamic trial is refused by its gates: the point prior stands"
    return OK


def _full(fits: Sequence[Path], models: Mapping[str, TrialModel]) -> dict[str, dict[str, Any]]:
    """Return the best restart of each trial of a full calibration, with the evaluations of it and of all restarts."""
    records = [read_json(path, ("trial", "restart", "parameters", "cost", "evaluations")) for path in fits]
    out = {}
    for trial in models:
        mine = [fit for fit in records if fit["trial"] == trial]
        if mine:
            best = best_of(mine)
            out[trial] = {
                "method": best["method"],
                "restart": best["restart"],
                "restarts": len(mine),
                "parameters": best["parameters"],
                "evaluations_best_restart": best["evaluations"],
                "evaluations": sum(fit["evaluations"] for fit in mine),
            }
    return out


def _refine_all(
    subject: str,
    models: Mapping[str, TrialModel],
    search: Search,
    bounds: Bounds,
    noise: np.ndarray | None,
    full: Mapping[str, dict[str, Any]],
    robot: Path,
    settings: Settings,
) -> tuple[np.ndarray, dict[str, dict[str, Any]], dict[str, Any] | None, dict[str, Any] | None]:
    """Return the person's values (12,) [SI], and figures per trial, of all together and across trials."""
    how = _how(settings)
    refined, trials = {}, {}
    for name, model in models.items():
        residuals = _residuals([model])
        begin = time.monotonic()
        refined[name] = refine_residuals(residuals, search, **how)
        spent = time.monotonic() - begin
        print(
            f"{subject} {name}: {len(search.free)} parameters refined in {refined[name].evaluations} evaluations,"
            f" {spent:.1f} s, J {refined[name].history[0][1]:.4g} to {refined[name].cost:.4g}",
            file=sys.stderr,
            flush=True,
        )
        trials[name] = _trial(model, refined[name], search, bounds, noise, full.get(name), robot, settings)
    values = refined[next(iter(models))].values
    pooled = None
    if len(models) > 1:
        start = search.prior.copy()
        each = np.array([r.values for r in refined.values()])
        start[search.free] = np.exp(np.log(each[:, search.free]).mean(axis=0))
        joint = refine_residuals(_residuals(list(models.values())), search, start=start, **how)
        values = joint.values
        pooled = {
            "parameters": as_dict(values),
            "J": joint.cost,
            "evaluations": joint.evaluations * len(models),
            "trials": {name: _terms(model, values[None])[0] for name, model in models.items()},
        }
    cross = None if len(models) < 2 else _cross(models, refined, full)
    return values, trials, pooled, cross


def _how(settings: Settings) -> dict[str, Any]:
    """Return the options of `refine_residuals`."""
    options = settings["identification"]["least_squares"]
    return {"batch": BATCH, "iterations": options["iterations"], "ftol": options["ftol"]}


def _residuals(models: Sequence[TrialModel]) -> Callable[[np.ndarray], np.ndarray]:
    """Return residuals (m, n_r) of parameters (m, 12) whose sum of squares is the mean J of some trials."""
    weight = 1 / np.sqrt(len(models))
    return lambda p: np.concatenate([weight * m.cost.residuals(m.replay.run(p)) for m in models], axis=1)


def _terms(model: TrialModel, parameters: np.ndarray) -> list[dict[str, float]]:
    """Return J, its terms and the position RMSE [m] of parameters (m, 12)."""
    terms = model.cost(model.replay.run(parameters))
    columns = zip(terms.total, terms.position, terms.velocity, terms.rmse_position, strict=True)
    names = ("J", "J_position", "J_velocity", "rmse_position_m")
    return [dict(zip(names, map(float, row), strict=True)) for row in columns]


def _trial(
    model: TrialModel,
    refined: Refined,
    search: Search,
    bounds: Bounds,
    noise: np.ndarray | None,
    full: dict[str, Any] | None,
    robot: Path,
    settings: Settings,
) -> dict[str, Any]:
    """Compare prior, refined and full calibration on one trial, and assess the refinement."""
    vectors = [search.prior, refined.values, *([as_vector(full["parameters"])] if full else [])]
    costs = _terms(model, np.array(vectors))
    options = settings["identifiability"]
    lags = round(options["autocorrelation_s"] / float(model.trial.time_s[1] - model.trial.time_s[0]))
    more, evaluations = would_gain(
        _residuals([model]),
        model.cost.sample_of_residual(),
        refined,
        search,
        bounds,
        batch=BATCH,
        lags=lags,
        settings=options,
    )
    ends = ends_reached(refined.values, search, bounds, settings["identification"]["at_bound_ln"])
    out: dict[str, Any] = {
        "prior": costs[0],
        "refined": costs[1]
        | {
            "parameters": as_dict(refined.values),
            "evaluations": refined.evaluations,
            "J_over_prior": costs[1]["J"] / costs[0]["J"],
            "ends": ends,
            "history": {
                "evaluations": [n for n, _ in refined.history],
                "best": [best for _, best in refined.history],
            },
        },
        "verdicts": _verdicts(model, refined, search, noise, robot, settings),
        "beyond_ends": beyond_ends(_residuals([model]), refined, search, bounds, ends, **_how(settings)),
        "if_also_free": more,
        "evaluations_of_if_also_free": evaluations,
        "full": None,
        "against_full": None,
    }
    if full:
        out["full"] = full | costs[2]
        out["against_full"] = against_full(costs[1]["J"], refined.evaluations, out["full"])
    return out


def opened(search: Search, bounds: Bounds, names: Iterable[str]) -> Search:
    """Return the same search with some parameters free between the ``bounds``."""
    wider = Bounds(search.bounds.lower.copy(), search.bounds.upper.copy())
    index = [PARAMETERS.index(name) for name in names]
    wider.lower[index], wider.upper[index] = bounds.lower[index], bounds.upper[index]
    return Search(search.prior, wider, np.union1d(search.free, index).astype(int), search.use)


def beyond_ends(
    residuals: Callable[[np.ndarray], np.ndarray],
    refined: Refined,
    search: Search,
    bounds: Bounds,
    ends: Mapping[str, str],
    **how: Any,
) -> dict[str, Any] | None:
    """Return what J falls to where the search goes on from the ends of intervals it reached; None if it reached none.

    ``residuals`` maps parameters (m, 12) [SI] to (m, n_r); ``how`` as in `refine_residuals`.
    """
    names = [name for name, end in ends.items() if end.endswith(_NOT_HELD)]
    if not names:
        return None
    further = refine_residuals(residuals, opened(search, bounds, names), start=refined.values, **how)
    return {
        "J": further.cost,
        "evaluations": further.evaluations,
        "parameters": {name: float(further.values[PARAMETERS.index(name)]) for name in names},
    }


def against_full(cost: float, evaluations: int, full: Mapping[str, Any]) -> dict[str, Any]:
    """Return how a refinement compares with a full calibration, and whether it meets both bars."""
    ratio, share = cost / full["J"], evaluations / full["evaluations_best_restart"]
    return {
        "J_ratio": ratio,
        "evaluations_over_best_restart": share,
        "evaluations_over_all_restarts": evaluations / full["evaluations"],
        "bar": {"J_ratio": J_BAR, "evaluations_over_best_restart": EVALUATIONS_BAR},
        "met": bool(ratio <= J_BAR and share <= EVALUATIONS_BAR),
    }


def _verdicts(
    model: TrialModel,
    refined: Refined,
    search: Search,
    noise: np.ndarray | None,
    robot: Path,
    settings: Settings,
) -> dict[str, AssessedParameter]:
    """Return what the trial determines of the free parameters, the others taken for known."""
    if not len(search.free):
        return {}
    result = assess_model(
        model, refined.values, search.bounds, noise, robot=robot, settings=settings, fitted=search.free
    )
    return result["parameters"]


def _cross(
    models: Mapping[str, TrialModel], refined: Mapping[str, Refined], full: Mapping[str, dict[str, Any]]
) -> dict[str, Any]:
    """Return J of parameters of one trial on another one, refined and fully calibrated."""
    vectors = {"refined": {name: r.values for name, r in refined.items()}}
    if set(full) == set(models):
        vectors["full"] = {name: as_vector(f["parameters"]) for name, f in full.items()}
    out: dict[str, Any] = {}
    for kind, by_trial in vectors.items():
        # J[test][train]
        costs = {
            test: {train: _terms(model, values[None])[0]["J"] for train, values in by_trial.items()}
            for test, model in models.items()
        }
        pairs = [
            {"train": train, "test": test, "J_cross": costs[test][train], "J_within": costs[test][test]}
            for train, test in permutations(by_trial, 2)
        ]
        within = float(np.mean([costs[name][name] for name in by_trial]))
        mean = float(np.mean([pair["J_cross"] for pair in pairs]))
        out[kind] = {"pairs": pairs, "J_cross_mean": mean, "overhead": overhead(mean, within)}
    return out


def _parameters(
    values: np.ndarray, search: Search, ends: Mapping[str, str], status: str
) -> dict[str, dict[str, Any]]:
    """Return the person's parameters, each with where it comes from."""
    out = {}
    for i, name in enumerate(PARAMETERS):
        free = i in search.free
        out[name] = {
            "value": float(values[i]),
            "unit": unit(name),
            "prior": float(search.prior[i]),
            "low": float(search.bounds.lower[i]) if free else None,
            "high": float(search.bounds.upper[i]) if free else None,
            "use": search.use[name],
            "source": "refined" if free and status == OK else "prior",
            "end": ends.get(name),
        }
    return out
