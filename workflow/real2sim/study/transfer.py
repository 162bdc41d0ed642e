"""Parameters carried to where they were not fitted: another trial, another person."""

from __future__ import annotations

from itertools import permutations
from pathlib import Path

import numpy as np

from real2sim.artefacts import needs_people, read_json, read_table, write_json
from real2sim.inference.parameters import as_vector
from real2sim.provenance import fingerprint
from real2sim.recording.quality.verdict import overridden_gates
from real2sim.recording.trial import TrialModel, trial_model, with_step
from real2sim.study.fit import best_of
from real2sim.study.statistics.loso import leave_one_out_prior, overhead
from real2sim.study.statistics.shareability import read_fits_table

_FIT_KEYS = ("subject", "trial", "restart", "parameters", "cost")


def _best_per_trial(fits: list[dict], subject: str) -> dict[str, dict]:
    mine = [fit for fit in fits if fit["subject"] == subject]
    return {
        trial: best_of([fit for fit in mine if fit["trial"] == trial])
        for trial in sorted({fit["trial"] for fit in mine})
    }


def _models(
    poses: list[Path], markers: list[Path], limits: Path, robot: Path, settings: dict, nsim: int
) -> dict[str, TrialModel]:
    return {
        pose.parent.name: trial_model(
            pose=pose, markers=marker, limits=limits, robot=robot, settings=settings, nsim=nsim
        )
        for pose, marker in zip(poses, markers, strict=True)
    }


def cross_trial(
    *,
    subject: str,
    fits: list[Path],
    poses: list[Path],
    markers: list[Path],
    limits: Path,
    step: Path,
    robot: Path,
    settings: dict,
    out: Path,
) -> None:
    """Simulate each trial's best fit on the person's other trials (paper, section V-B).

    ``poses`` and ``markers`` are those of the dynamic trials, in one order. ``overhead`` compares the mean over
    all train/test directions with the mean of the within-trial best fits.
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
            poses, markers, limits, robot, with_step(settings, step), len(names)
        ).items()
    }
    pairs = []
    for train, test in permutations(names, 2):
        i, j = names.index(train), names.index(test)
        within, cross = float(costs[test].total[j]), float(costs[test].total[i])
        pairs.append(
            {
                "train": train,
                "test": test,
                "J_within": within,
                "J_cross": cross,
                "overhead": overhead(cross, within),
                "rmse_within_m": float(costs[test].rmse_position[j]),
                "rmse_cross_m": float(costs[test].rmse_position[i]),
            }
        )
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
    settings: dict,
    out: Path,
) -> None:
    """Deploy the prior of the others on one person, with that person's own joint limits (paper, eq. 7).

    ``fits`` are those of ``subject``, ``cohort`` is the table of all fits (`shareability`), which need not hold
    theirs. With fewer than ``statistics.min_subjects`` people in the cohort there is no prior of the others: the
    published one is deployed and the file says so. M(theta*) is the mean over the trials of each trial's best fit.
    """
    records = [read_json(path, _FIT_KEYS) for path in fits]
    everyone = read_fits_table(cohort)
    people = {r["subject"] for r in everyone}
    minimum = settings["statistics"]["min_subjects"]
    base = {"schema": 1, "subject": subject, "phantom": any(r["phantom"] for r in records)}
    if len(people) < minimum:
        table = read_table(published, ("parameter", "prior"))
        prior = {row["parameter"]: float(row["prior"]) for row in table}
        source, status = "published", needs_people(minimum, len(people))
        rests_on = records
    else:
        prior = leave_one_out_prior(everyone, subject)
        source, status = "leave-one-out", "ok"
        rests_on = [*records, *everyone]
    best = _best_per_trial(records, subject)
    trials = []
    for name, model in _models(poses, markers, limits, robot, with_step(settings, step), 2).items():
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

    def mean(key: str) -> float:
        return float(np.mean([trial[key] for trial in trials]))

    overheads = {
        "overhead_J": overhead(mean("J_prior"), mean("J_best")),
        "overhead_rmse": overhead(mean("rmse_prior_m"), mean("rmse_best_m")),
    }
    if source == "published":
        overheads = {f"published_{key}": value for key, value in overheads.items()}
    write_json(
        out,
        base
        | {"overridden_gates": overridden_gates(rests_on), "status": status}
        | {"prior_source": source, "prior": prior, "trials": trials}
        | overheads
        | {"provenance": {"code_fingerprint": fingerprint(__name__)}},
    )
