"""A cohort of people with one cause, through the paper's statistics: ICC, cross-trial and leave-one-out replays."""

from __future__ import annotations

from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any

import numpy as np

from real2sim.artefacts import needs_people, read_json, write_json
from real2sim.provenance import fingerprint
from real2sim.study.statistics.shareability import shareability
from real2sim.study.transfer import cross_trial, loso_subject
from real2sim.verification.paper_gap.people import DYNAMIC, LIMITS, PERSON, STEP, known_robot, restart_files

if TYPE_CHECKING:
    from real2sim.settings import Settings


def cohort_with_cause(
    *, cause: str, people: list[Path], robot: Path, published: Path, settings: Settings, out: Path
) -> None:
    """Collect what the paper reports of its cohort, for a cohort whose people all have one cause.

    Parameters
    ----------
    cause
        One of `plan.CAUSES`.
    people
        Folders of `people.person_with_cause`.
    robot
        MJCF of the robot that the analysis knows.
    published
        table1_priors.csv, which stands in where there are too few people for a prior of the others.
    settings
        Slices ``identification``, ``plant``, ``robot``, ``statistics`` and ``paper_gap`` of the configuration.
    out
        JSON: sealed sizes, all fits, cross-trial and leave-one-out costs of everyone. ``status`` is ``ok``, or why
        there is nothing to compare.
    """
    about = {"schema": 1, "phantom": True, "cause": cause}
    persons = [read_json(folder / PERSON, ("subject", "status", "sealed")) for folder in people]
    failed = [f"{p['subject']}: {p['status']}" for p in persons if p["status"] != "ok"]
    if len(persons) < settings["statistics"]["min_subjects"]:
        failed.append(needs_people(settings["statistics"]["min_subjects"], len(persons)))
    about |= {"sealed": {p["subject"]: p["sealed"] for p in persons}}
    if failed:
        write_json(out, about | {"status": "; ".join(failed)})
        return
    with TemporaryDirectory() as work:
        result = _through_the_statistics(
            {p["subject"]: folder for p, folder in zip(persons, people, strict=True)},
            robot,
            published,
            settings,
            Path(work),
        )
    write_json(out, about | {"status": "ok"} | result | {"code_fingerprint": fingerprint(__name__)})


def _through_the_statistics(
    folders: dict[str, Path], robot: Path, published: Path, settings: Settings, work: Path
) -> dict[str, Any]:
    restarts = settings["paper_gap"]["restarts"]
    fits = {
        name: [path for trial in DYNAMIC for path in restart_files(folder, trial, restarts)]
        for name, folder in folders.items()
    }
    table = work / "fits.csv"
    everyone = [path for paths in fits.values() for path in paths]
    shareability(fits=everyone, settings=settings["statistics"], out_fits=table, out_icc=work / "icc.csv")
    people = []
    for name, folder in folders.items():
        files: dict[str, Any] = {
            "poses": [folder / "trials" / trial / "pose.parquet" for trial in DYNAMIC],
            "markers": [folder / "trials" / trial / "markers.parquet" for trial in DYNAMIC],
            "limits": folder / LIMITS,
            "step": folder / STEP,
            "robot": known_robot(folder, robot),
            "settings": settings,
        }
        crossed, left_out = work / f"{name}-cross.json", work / f"{name}-loso.json"
        cross_trial(subject=name, fits=fits[name], out=crossed, **files)
        loso_subject(subject=name, fits=fits[name], cohort=table, published=published, out=left_out, **files)
        people.append(_person(name, fits[name], read_json(crossed), read_json(left_out)))
    return {"people": people}


def _person(name: str, fits: list[Path], crossed: dict[str, Any], left_out: dict[str, Any]) -> dict[str, Any]:
    keep = ("trial", "restart", "parameters", "at_bound")
    records = [read_json(path) for path in fits]
    trials = left_out["trials"]
    return {
        "subject": name,
        "fits": [{key: fit[key] for key in keep} | {"J": fit["cost"]["J"]} for fit in records],
        "J_within": crossed["J_within_mean"],
        "J_cross": crossed["J_cross_mean"],
        "J_prior": float(np.mean([t["J_prior"] for t in trials])),
        "overhead_cross": crossed["overhead"],
        "overhead_loso_J": left_out["overhead_J"],
        "overhead_loso_rmse": left_out["overhead_rmse"],
    }
