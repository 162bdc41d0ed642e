"""Which time step is exact enough for a person: the cheapest one that a fine reference cannot tell apart."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from real2sim.artefacts import number, read_table, write_json
from real2sim.inference.parameters import PARAMETERS, Bounds
from real2sim.provenance import fingerprint
from real2sim.recording.trial import TrialModel, trial_model
from real2sim.system.replay import replay_check

# Begins the status of a time step that the configuration sets (plant.timestep_s) and that passes no bar
BY_HAND = "set by hand"

if TYPE_CHECKING:
    from real2sim.settings import PlantReplayBarSettings, PlantSettings, PlantStudySettings, Settings


def parameter_draws(published: Path, bounds: Bounds, count: int, seed: int) -> np.ndarray:
    """Return the published prior and log-uniform draws from its intervals, within the bounds, (count, 12).

    Where interval and bounds do not overlap, draws come from between the bounds.
    """
    rows = {row["parameter"]: row for row in read_table(published, ("parameter", "prior", "interval_low"))}
    prior = np.clip([number(rows[name]["prior"]) for name in PARAMETERS], bounds.lower, bounds.upper)
    low = np.maximum([number(rows[name]["interval_low"]) for name in PARAMETERS], bounds.lower)
    high = np.minimum([number(rows[name]["interval_high"]) for name in PARAMETERS], bounds.upper)
    apart = low >= high
    low, high = np.where(apart, bounds.lower, low), np.where(apart, bounds.upper, high)
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
    settings: Settings,
    out: Path,
) -> None:
    """Replay one dynamic trial at several time steps against a fine one, and choose the largest that is exact enough.

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
    runs: dict[float, _Run] = {}
    phantom = False
    for step in (study["reference_s"], *study["candidates_s"]):
        stepped = settings | {"plant": plant | {"timestep_s": step}}
        model = trial_model(
            pose=pose, markers=markers, limits=limits, robot=robot, settings=stepped, nsim=len(parameters)
        )
        phantom = model.trial.phantom
        runs[step] = _run(model, parameters)
    reference = runs[study["reference_s"]]
    rows = [
        _row(step, runs[step], reference, study, plant["replay_bar"])
        for step in sorted(study["candidates_s"], reverse=True)
    ]
    chosen, status = _choose(rows, plant)
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
            "status": status,
            "settings": study,
            "provenance": {"code_fingerprint": fingerprint(__name__)},
        },
    )


@dataclass(frozen=True)
class _Run:
    """Replays with one time step.

    ``paths`` (m, n, 2, 3) [m, world] and ``cost`` (m,), J, of each parameter vector; largest errors of the replayed
    pelvis.
    """

    paths: np.ndarray
    cost: np.ndarray
    replay_rms_m: float
    replay_max_m: float
    replay_lag_s: float


def _run(model: TrialModel, parameters: np.ndarray) -> _Run:
    """Replay parameters (m, 12) and check the pelvis of each replay."""
    paths, pelvis = model.replay.run_with_pelvis(parameters)
    checks = [replay_check(model.replay, path) for path in pelvis]
    return _Run(
        paths,
        model.cost(paths).total,
        max(check["rms_m"] for check in checks),
        max(check["max_m"] for check in checks),
        max(abs(check["lag_s"]) for check in checks),
    )


def _choose(rows: list[dict[str, Any]], plant: PlantSettings) -> tuple[float, str]:
    """Return the time step [s] and how it came about, from the candidates' rows, largest step first."""
    passing = [row["timestep_s"] for row in rows if row["passes"]]
    best = passing[0] if passing else min(plant["study"]["candidates_s"])
    configured = plant["timestep_s"]
    chosen = best if isinstance(configured, str) else configured
    if chosen in passing:
        return chosen, "ok"
    if not passing:
        failure = "no candidate passes"
    else:
        tried = any(row["timestep_s"] == chosen for row in rows)
        failure = "does not pass the bars of the step study" if tried else ""
    return chosen, failure if isinstance(configured, str) else ", ".join(filter(None, (BY_HAND, failure)))


def _row(
    step: float, run: _Run, reference: _Run, study: PlantStudySettings, bar: PlantReplayBarSettings
) -> dict[str, Any]:
    """Return the errors of a step against the reference, and whether they pass the bars."""
    error = np.sqrt(np.mean(np.sum((run.paths - reference.paths) ** 2, axis=-1), axis=(1, 2)))
    relative = np.abs(run.cost - reference.cost) / reference.cost
    row: dict[str, Any] = {
        "timestep_s": step,
        "marker_rms_m_median": float(np.median(error)),
        "marker_rms_m_max": float(error.max()),
        "J_relative_max": float(relative.max()),
        "replay_rms_m": float(run.replay_rms_m),
        "replay_max_m": float(run.replay_max_m),
        "replay_lag_s": float(run.replay_lag_s),
    }
    row["passes"] = bool(
        row["marker_rms_m_max"] < study["marker_rms_m"]
        and row["J_relative_max"] < study["J_relative"]
        and row["replay_rms_m"] < bar["rms_m"]
        and row["replay_lag_s"] < bar["lag_s"]
    )
    return row
