"""Which time step is exact enough for a person: the cheapest one that a fine reference cannot tell apart."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from real2sim.artefacts import number, read_table, write_json
from real2sim.inference.parameters import PARAMETERS, Bounds
from real2sim.provenance import fingerprint
from real2sim.recording.trial import trial_model
from real2sim.system.replay import replay_check


def parameter_draws(published: Path, bounds: Bounds, count: int, seed: int) -> np.ndarray:
    """The published prior and log-uniform draws from its published intervals, within the bounds, (count, 12)."""
    rows = {row["parameter"]: row for row in read_table(published, ("parameter", "prior", "interval_low"))}
    prior = np.array([number(rows[name]["prior"]) for name in PARAMETERS])
    low = np.maximum([number(rows[name]["interval_low"]) for name in PARAMETERS], bounds.lower)
    high = np.minimum([number(rows[name]["interval_high"]) for name in PARAMETERS], bounds.upper)
    rng = np.random.default_rng(seed)
    return np.vstack([prior, np.exp(rng.uniform(np.log(low), np.log(high), (count - 1, 12)))])


def step_study(
    *,
    subject: str,
    pose: Path,
    markers: Path,
    limits: Path,
    robot: Path,
    published: Path,
    settings: dict,
    out: Path,
) -> None:
    """Replay one dynamic trial at several time steps against a fine one, and choose (contract, section 5).

    Parameters
    ----------
    pose, markers, limits
        Canonical tables of the trial and joint limits of the person.
    published
        Table I of the paper: parameters are drawn from its intervals.
    settings
        Slices ``identification``, ``plant`` and ``robot`` of the configuration; ``plant.study`` has the candidates
        and the bars, ``plant.timestep_s`` is "auto" or the step to use whatever the study says.
    out
        JSON: errors per step (markers [m], J relative to the reference, replay [m, s]) and the chosen step [s].
    """
    plant = settings["plant"]
    study = plant["study"]
    bounds = Bounds.from_config(settings["identification"]["bounds"])
    parameters = parameter_draws(published, bounds, study["draws"], study["seed"])
    runs: dict[float, dict[str, Any]] = {}
    phantom = False
    for step in (study["reference_s"], *study["candidates_s"]):
        stepped = settings | {"plant": plant | {"timestep_s": step}}
        model = trial_model(
            pose=pose, markers=markers, limits=limits, robot=robot, settings=stepped, nsim=len(parameters)
        )
        phantom = model.trial.phantom
        paths, pelvis = model.replay.run_with_pelvis(parameters)
        checks = [replay_check(model.replay, path) for path in pelvis]
        runs[step] = {
            "paths": paths,
            "J": model.cost(paths).total,
            "replay_rms_m": max(check["rms_m"] for check in checks),
            "replay_max_m": max(check["max_m"] for check in checks),
            "replay_lag_s": max(abs(check["lag_s"]) for check in checks),
        }
    reference = runs[study["reference_s"]]
    rows = [
        _row(step, runs[step], reference, study, plant["replay_bar"])
        for step in sorted(study["candidates_s"], reverse=True)
    ]
    passing = [row["timestep_s"] for row in rows if row["passes"]]
    best = passing[0] if passing else min(study["candidates_s"])
    chosen = best if plant["timestep_s"] == "auto" else plant["timestep_s"]
    write_json(
        out,
        {
            "schema": 1,
            "subject": subject,
            "trial": pose.parent.name,
            "phantom": phantom,
            "reference_s": study["reference_s"],
            "steps": rows,
            "timestep_s": chosen,
            "status": "ok" if chosen in passing else "no candidate passes" if not passing else "set by hand",
            "settings": study,
            "provenance": {"code_fingerprint": fingerprint(__name__)},
        },
    )


def _row(step: float, run: dict, reference: dict, study: dict, bar: dict) -> dict[str, Any]:
    error = np.sqrt(np.mean(np.sum((run["paths"] - reference["paths"]) ** 2, axis=-1), axis=(1, 2)))
    relative = np.abs(run["J"] - reference["J"]) / reference["J"]
    row = {
        "timestep_s": step,
        "marker_rms_m_median": float(np.median(error)),
        "marker_rms_m_max": float(error.max()),
        "J_relative_max": float(relative.max()),
        **{key: float(run[key]) for key in ("replay_rms_m", "replay_max_m", "replay_lag_s")},
    }
    row["passes"] = bool(
        row["marker_rms_m_max"] < study["marker_rms_m"]
        and row["J_relative_max"] < study["J_relative"]
        and row["replay_rms_m"] < bar["rms_m"]
        and row["replay_lag_s"] < bar["lag_s"]
    )
    return row
