"""The identification of one trial, all restarts side by side, from tables to a cached file per restart."""

from __future__ import annotations

import hashlib
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from real2sim.artefacts import write_json
from real2sim.errors import InputError
from real2sim.inference import cmaes, least_squares
from real2sim.inference.cost import FAILED_COST
from real2sim.inference.parameters import Bounds, as_dict, as_vector
from real2sim.inference.result import SearchResult
from real2sim.provenance import fingerprint, provenance
from real2sim.recording.quality.verdict import require
from real2sim.recording.trial import TrialModel, trial_model, with_step
from real2sim.system.replay import replay_check

if TYPE_CHECKING:
    from real2sim.settings import IdentificationSettings, Settings

_PACKAGES = ["mujoco", "cma", "numpy", "scipy"]
# A point and its 12 neighbours: one Jacobian by finite differences
BATCH = 13
# Replays in memory at once; more restarts take turns
LARGEST_BATCH = 66


def restart_seed(seed: int, subject: str, trial: str, restart: int) -> int:
    """Return the seed of one restart: a function of names and the configured seed alone."""
    digest = hashlib.sha256(f"{seed}/{subject}/{trial}/{restart}".encode()).digest()
    return int.from_bytes(digest[:4], "little")


class Progress:
    """A line to stderr every few seconds: evaluations, cost, and time left where the ``total`` is known."""

    def __init__(self, label: str, total: int | None, interval_s: float = 5.0):
        self._label, self._total, self._interval = label, total, interval_s
        self._start = self._last = time.monotonic()

    def __call__(self, done: int, best: float) -> None:
        """Say so many evaluations are done, if the last line is old enough, and the best cost so far."""
        now = time.monotonic()
        if now - self._last < self._interval and (self._total is None or done < self._total):
            return
        self._last = now
        of, left = "", ""
        if self._total is not None:
            of = f"/{self._total}"
            left = f", {(now - self._start) * max(self._total - done, 0) / done:.0f} s left"
        print(f"{self._label}: {done}{of} evaluations, J {best:.4g}{left}", file=sys.stderr, flush=True)


def search(
    model: TrialModel,
    bounds: Bounds,
    ident: IdentificationSettings,
    seeds: list[int],
    progress: Callable[[int, float], None],
) -> list[SearchResult]:
    """Run the searches that the configuration asks for, one per seed."""
    if ident["method"] == "cma":
        return cmaes.search(
            model.costs,
            bounds,
            population=ident["population"],
            sigma0=ident["sigma0"],
            evaluations=ident["evaluations"],
            tolfun=ident["tolfun"],
            diagonal_iterations=ident["diagonal_iterations"],
            seeds=seeds,
            progress=progress,
        )
    results: list[SearchResult] = []
    for seed in seeds:
        before = sum(result.evaluations for result in results)

        def counted(done: int, best: float, before: int = before) -> None:
            progress(before + done, best)

        results.append(
            least_squares.search(
                lambda parameters: model.cost.residuals(model.replay.run(parameters)),
                bounds,
                batch=BATCH,
                seed=seed,
                progress=counted,
                **ident["least_squares"],
            )
        )
    return results


def progress_of(label: str, ident: IdentificationSettings, restarts: int) -> Progress:
    """Return the progress of `search` with so many seeds; when least squares will have converged is not known."""
    return Progress(label, ident["evaluations"] * restarts if ident["method"] == "cma" else None)


def _batch_size(ident: IdentificationSettings, restarts: int) -> int:
    """Return the number of replays in one batch."""
    return min(LARGEST_BATCH, ident["population"] * restarts) if ident["method"] == "cma" else BATCH


def fit_trial(
    *,
    subject: str,
    trial: str,
    restarts: list[int],
    pose: Path,
    markers: Path,
    limits: Path,
    step: Path,
    robot: Path,
    settings: Settings,
    out: list[Path],
    gates: list[Path] | None = None,
    threads: int = 1,
) -> None:
    """Identify the 12 interface parameters of one trial from log-uniform starts (paper, section III-B).

    All restarts are simulated in one batch.

    Parameters
    ----------
    restarts
        Numbers of the restarts; a restart's result does not depend on which others run beside it.
    pose, markers, limits, step, robot
        Canonical tables of the trial, joint limits and step study of the person, MJCF of the robot twin.
    settings
        Slices ``identification``, ``plant`` and ``robot`` of the configuration.
    gates
        Verdicts on the trial and on those that the fit rests on (`quality.verdict.require`); None where the caller
        vouches for them, as benchmarks do.
    threads
        That the replays may use. The files are the same bytes with any number.
    out
        JSON of each restart: parameters [SI], cost and its terms, history, replay check, settings and provenance.

    Raises
    ------
    InputError
        Where a gate refuses one of these trials, or the replayed pelvis is farther from the measured one than
        ``plant.replay_bar`` allows (0.1 mm RMS, 0.1 ms).
    """
    overridden = {} if gates is None else require(gates, trial)
    settings = with_step(settings, step)
    ident = settings["identification"]
    bounds = Bounds.from_config(ident["bounds"])
    seeds = [restart_seed(ident["seed"], subject, trial, restart) for restart in restarts]
    batch = _batch_size(ident, len(restarts))
    tables = {"pose": pose, "markers": markers, "limits": limits}
    model = trial_model(**tables, robot=robot, settings=settings, nsim=batch, threads=threads)
    model.replay.check_bounds(bounds.upper[6:])
    label = f"{subject} {trial}" + (f", {len(restarts)} restarts" if len(restarts) > 1 else "")
    results = search(model, bounds, ident, seeds, progress_of(label, ident, len(restarts)))
    _require_a_replay(results, pose)
    source = provenance([pose, markers, limits, robot], _PACKAGES, fingerprint(__name__))
    about = {"schema": 1, "subject": subject, "trial": trial, "restart": None, "method": ident["method"]}
    about |= {"phantom": model.trial.phantom, "overridden_gates": overridden}
    tail = {"settings": settings, "provenance": source}
    outcomes = [_outcome(model, result, bounds, settings, pose) for result in results]
    for path, restart, seed, outcome in zip(out, restarts, seeds, outcomes, strict=True):
        write_json(path, about | {"restart": restart} | outcome | {"seed": seed} | tail)


def _require_a_replay(results: list[SearchResult], pose: Path) -> None:
    """Raise InputError where a search found no parameters that can be simulated: all of them cost FAILED_COST."""
    if any(not result.cost < FAILED_COST for result in results):
        raise InputError(
            pose,
            "pelvis path",
            "no stable simulation with any of the parameters that were tried",
            "a motion that the plant can follow",
            "Look for jumps in the pelvis markers, and lower plant.timestep_s.",
        )


def _outcome(
    model: TrialModel, result: SearchResult, bounds: Bounds, settings: Settings, pose: Path
) -> dict[str, Any]:
    """Return what a search found, with its replay checked."""
    _, pelvis = model.replay.run_with_pelvis(result.parameters[None])
    check = replay_check(model.replay, pelvis[0])
    bar = settings["plant"]["replay_bar"]
    if check["rms_m"] > bar["rms_m"] or abs(check["lag_s"]) > bar["lag_s"]:
        raise InputError(
            pose,
            "pelvis path",
            f"a replay error of {check['rms_m'] * 1e3:.3f} mm RMS and {check['lag_s'] * 1e3:.3f} ms",
            f"at most {bar['rms_m'] * 1e3} mm and {bar['lag_s'] * 1e3} ms",
            "Lower plant.timestep_s, and look for jumps in the pelvis markers.",
        )
    return outcome(model, result, bounds, settings["identification"]) | {"replay": check}


def outcome(
    model: TrialModel, result: SearchResult, bounds: Bounds, ident: IdentificationSettings
) -> dict[str, Any]:
    """Return what a search found, as the entries of a fit's file: parameters [SI], cost and its terms, history."""
    terms = model.cost(model.replay.run(result.parameters[None]))
    return {
        "parameters": as_dict(result.parameters),
        "cost": {
            "J": float(terms.total[0]),
            "J_position": float(terms.position[0]),
            "J_velocity": float(terms.velocity[0]),
            "rmse_position_m": float(terms.rmse_position[0]),
            "samples": model.cost.samples,
        },
        "at_bound": bounds.at_bound(result.parameters, ident["at_bound_ln"]),
        "start": as_dict(result.start),
        "evaluations": result.evaluations,
        "stop": result.stop,
        "history": result.history,
    }


def best_of(fits: list[dict[str, Any]]) -> dict[str, Any]:
    """Return the fit with the lowest cost; ties go to the first restart."""
    return min(fits, key=lambda fit: (fit["cost"]["J"], fit["restart"]))


def parameter_array(fits: list[dict[str, Any]]) -> np.ndarray:
    """Return the parameters of fit records as (m, 12), in the order of `PARAMETERS`."""
    return np.array([as_vector(fit["parameters"]) for fit in fits])
