"""Parameters carried to where they were not fitted: another trial, another person."""

from __future__ import annotations

from itertools import permutations
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from real2sim.artefacts import needs_people, read_json, read_table, write_json
from real2sim.inference.cost import CostTerms
from real2sim.inference.parameters import as_vector
from real2sim.provenance import fingerprint
from real2sim.recording.quality.verdict import overridden_gates
from real2sim.recording.trial import TrialModel, trial_model, with_step
from real2sim.study.explained import Causes
from real2sim.study.fit import best_of
from real2sim.study.statistics.loso import leave_one_out_prior, overhead
from real2sim.study.statistics.shareability import read_fits_table

if TYPE_CHECKING:
    from real2sim.settings import Settings

PUBLISHED = "published"
_FIT_KEYS = ("subject", "trial", "restart", "parameters", "cost")


def _best_per_trial(fits: list[dict[str, Any]], subject: str) -> dict[str, dict[str, Any]]:
    mine = [fit for fit in fits if fit["subject"] == subject]
    return {
        trial: best_of([fit for fit in mine if fit["trial"] == trial])
        for trial in sorted({fit["trial"] for fit in mine})
    }


def _models(
    poses: list[Path],
    markers: list[Path],
    limits: Path,
    robot: Path,
    settings: Settings,
    nsim: int,
    causes: Causes | None,
) -> dict[str, TrialModel]:
    """Trials by name, with the causes in their replays where there are any."""
    if causes is not None:
        return {pose.parent.name: causes.model(pose.parent, limits, nsim) for pose in poses}
    return {
        pose.parent.name: trial_model(
            pose=pose, markers=marker, limits=limits, robot=robot, settings=settings, nsim=nsim
        )
        for pose, marker in zip(poses, markers, strict=True)
    }


def _causes(diagnosis: Path | None, neutral: Path | None, robot: Path) -> Causes | None:
    """Diagnosed causes of a person, where a diagnosis is given."""
    return None if diagnosis is None or neutral is None else Causes.read(diagnosis, neutral, robot)


def cross_trial(
    *,
    subject: str,
    fits: list[Path],
    poses: list[Path],
    markers: list[Path],
    limits: Path,
    step: Path,
    robot: Path,
    settings: Settings,
    out: Path,
    diagnosis: Path | None = None,
    neutral: Path | None = None,
) -> None:
    """Simulate each trial's best fit on the person's other trials (paper, section V-B).

    ``poses`` and ``markers`` are those of the dynamic trials, in one order. ``overhead`` compares the mean over
    all train/test directions with the mean of the within-trial best fits. With ``diagnosis`` (diagnosis.json) and
    ``neutral`` (folder of canonical tables), the diagnosed causes are in the replays.
    """
    records = [read_json(path, _FIT_KEYS) for path in fits]
    best = _best_per_trial(records, subject)
    base = {
        "schema": 1,
        "subject": subject,
        "phantom": any(r["phantom"] for r in records),
        "overridden_gates": overridden_gates(records),
    }
    if len(best) < 2:
        write_json(out, base | {"status": f"needs at least 2 dynamic trials, has {len(best)}", "pairs": []})
        return
    names = list(best)
    parameters = np.array([as_vector(best[name]["parameters"]) for name in names])
    costs = {
        name: model.cost(model.replay.run(parameters))
        for name, model in _models(
            poses,
            markers,
            limits,
            robot,
            with_step(settings, step),
            len(names),
            _causes(diagnosis, neutral, robot),
        ).items()
    }
    pairs = [_pair(names, costs, train, test) for train, test in permutations(range(len(names)), 2)]
    within_mean = float(np.mean([costs[name].total[i] for i, name in enumerate(names)]))
    cross_mean = float(np.mean([pair["J_cross"] for pair in pairs]))
    write_json(
        out,
        base
        | {
            "status": "ok",
            "pairs": pairs,
            "J_within_mean": within_mean,
            "J_cross_mean": cross_mean,
            "overhead": overhead(cross_mean, within_mean),
            "provenance": {"code_fingerprint": fingerprint(__name__)},
        },
    )


def _pair(names: list[str], costs: dict[str, CostTerms], train: int, test: int) -> dict[str, Any]:
    """Return what the fit of one trial costs on another, beside that trial's own; costs are in the order of names."""
    terms = costs[names[test]]
    within, cross = float(terms.total[test]), float(terms.total[train])
    return {
        "train": names[train],
        "test": names[test],
        "J_within": within,
        "J_cross": cross,
        "overhead": overhead(cross, within),
        "rmse_within_m": float(terms.rmse_position[test]),
        "rmse_cross_m": float(terms.rmse_position[train]),
    }


def loso_subject(
    *,
    subject: str,
    fits: list[Path],
    cohort: Path,
    poses: list[Path],
    markers: list[Path],
    limits: Path,
    step: Path,
    robot: Path,
    published: Path,
    settings: Settings,
    out: Path,
    diagnosis: Path | None = None,
    neutral: Path | None = None,
) -> None:
    """Deploy the prior of the others on one person, with that person's own joint limits (paper, eq. 7).

    ``fits`` are those of ``subject``, ``cohort`` is the table of all fits (`shareability`), which need not hold
    theirs. With fewer than ``statistics.min_subjects`` people in the cohort there is no prior of the others: the
    published one is deployed and the file says so. M(theta*) is the mean over the trials of each trial's best fit.
    ``diagnosis`` and ``neutral``: see `cross_trial`.
    """
    records = [read_json(path, _FIT_KEYS) for path in fits]
    everyone = read_fits_table(cohort)
    minimum = settings["statistics"]["min_subjects"]
    prior, source, status = _prior_of_others(subject, everyone, minimum, published)
    rests_on = records if source == PUBLISHED else [*records, *everyone]
    best = _best_per_trial(records, subject)
    trials = []
    causes = _causes(diagnosis, neutral, robot)
    for name, model in _models(poses, markers, limits, robot, with_step(settings, step), 2, causes).items():
        both = np.array([as_vector(best[name]["parameters"]), as_vector(prior)])
        terms = model.cost(model.replay.run(both))
        trials.append(
            {
                "trial": name,
                "J_best": float(terms.total[0]),
                "J_prior": float(terms.total[1]),
                "rmse_best_m": float(terms.rmse_position[0]),
                "rmse_prior_m": float(terms.rmse_position[1]),
            }
        )
    overheads = _overheads(trials)
    if source == PUBLISHED:
        overheads = {f"published_{key}": value for key, value in overheads.items()}
    write_json(
        out,
        {"schema": 1, "subject": subject, "phantom": any(r["phantom"] for r in records)}
        | {"overridden_gates": overridden_gates(rests_on), "status": status}
        | {"prior_source": source, "prior": prior, "trials": trials}
        | overheads
        | {"provenance": {"code_fingerprint": fingerprint(__name__)}},
    )


def _prior_of_others(
    subject: str, everyone: list[dict[str, Any]], minimum: int, published: Path
) -> tuple[dict[str, float], str, str]:
    """Return prior by parameter, where it is from, and the status; the published one where there are too few people."""
    people = {r["subject"] for r in everyone}
    if len(people) < minimum:
        table = read_table(published, ("parameter", "prior"))
        prior = {row["parameter"]: float(row["prior"]) for row in table}
        return prior, PUBLISHED, needs_people(minimum, len(people))
    return leave_one_out_prior(everyone, subject), "leave-one-out", "ok"


def _overheads(trials: list[dict[str, Any]]) -> dict[str, float]:
    """Return how much more than the best fits the prior costs, of J and of the RMSE, each a mean over the trials."""

    def mean(key: str) -> float:
        return float(np.mean([trial[key] for trial in trials]))

    return {
        "overhead_J": overhead(mean("J_prior"), mean("J_best")),
        "overhead_rmse": overhead(mean("rmse_prior_m"), mean("rmse_best_m")),
    }
