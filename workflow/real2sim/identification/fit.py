"""One restart of the identification of one trial, from tables to a cached file."""

from __future__ import annotations

import hashlib
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

from real2sim.artefacts import write_json
from real2sim.coupling.replay import replay_check
from real2sim.errors import InputError
from real2sim.identification import cmaes, least_squares
from real2sim.identification.parameters import Bounds, as_dict
from real2sim.identification.result import SearchResult
from real2sim.identification.trial import TrialModel, trial_model, with_step
from real2sim.provenance import fingerprint, provenance
from real2sim.quality.verdict import require

_PACKAGES = ["mujoco", "cma", "numpy", "scipy"]
# A point and its 12 neighbours: one Jacobian by finite differences
BATCH = 13


def restart_seed(seed: int, subject: str, trial: str, restart: int) -> int:
    """Seed of one restart: a function of names and the configured seed alone."""
    digest = hashlib.sha256(f"{seed}/{subject}/{trial}/{restart}".encode()).digest()
    return int.from_bytes(digest[:4], "little")


class _Progress:
    """A line to stderr every few seconds: evaluations, cost and time left."""

    def __init__(self, label: str, total: int, interval_s: float = 5.0):
        self._label, self._total, self._interval = label, total, interval_s
        self._start = self._last = time.monotonic()

    def __call__(self, done: int, best: float) -> None:
        now = time.monotonic()
        if now - self._last < self._interval and done < self._total:
            return
        self._last = now
        left = (now - self._start) * max(self._total - done, 0) / done
        print(
            f"{self._label}: {done}/{self._total} evaluations, J {best:.4g}, {left:.0f} s left",
            file=sys.stderr,
            flush=True,
        )


def _search(
    model: TrialModel, bounds: Bounds, ident: dict, seed: int, progress: Callable[[int, float], None]
) -> SearchResult:
    """The search that the configuration asks for."""
    if ident["method"] == "least_squares":
        return least_squares.search(
            lambda parameters: model.cost.residuals(model.replay.run(parameters)),
            bounds,
            batch=BATCH,
            seed=seed,
            progress=progress,
            **ident["least_squares"],
        )
    return cmaes.search(
        lambda parameters: model.cost(model.replay.run(parameters)).total,
        bounds,
        population=ident["population"],
        sigma0=ident["sigma0"],
        evaluations=ident["evaluations"],
        tolfun=ident["tolfun"],
        diagonal_iterations=ident["diagonal_iterations"],
        seed=seed,
        progress=progress,
    )


def fit_restart(
    *,
    subject: str,
    trial: str,
    restart: int,
    pose: Path,
    markers: Path,
    limits: Path,
    step: Path,
    robot: Path,
    settings: dict,
    out: Path,
    gates: list[Path] | None = None,
    threads: int = 1,
) -> None:
    """Identify the 12 interface parameters of one trial from one log-uniform start (paper, section III-B).

    Parameters
    ----------
    pose, markers, limits, step, robot
        Canonical tables of the trial, joint limits and step study of the person, MJCF of the robot twin.
    settings
        Slices ``identification``, ``plant`` and ``robot`` of the configuration.
    gates
        Verdicts on the trial and on those that the fit rests on (`quality.verdict.require`); None where the caller
        vouches for them, as benchmarks do.
    threads
        That the replays may use. The file is the same bytes with any number.
    out
        JSON with parameters [SI], cost and its terms, history, replay check, settings and provenance.

    Raises
    ------
    InputError
        Where a gate refuses one of these trials, or the replay misses the bar of the contract (0.1 mm RMS, 0.1 ms).
    """
    overridden = {} if gates is None else require(gates, trial)
    settings = with_step(settings, step)
    ident = settings["identification"]
    bounds = Bounds.from_config(ident["bounds"])
    seed = restart_seed(ident["seed"], subject, trial, restart)
    batch = ident["population"] if ident["method"] == "cma" else BATCH
    model = trial_model(
        pose=pose,
        markers=markers,
        limits=limits,
        robot=robot,
        settings=settings,
        nsim=batch,
        threads=threads,
    )
    model.replay.check_bounds(bounds.upper[6:])
    label = f"{subject} {trial} restart {restart}"
    result = _search(model, bounds, ident, seed, _Progress(label, ident["evaluations"]))
    paths, pelvis = model.replay.run_with_pelvis(result.parameters[None])
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
    terms = model.cost(paths)
    write_json(
        out,
        {
            "schema": 1,
            "subject": subject,
            "trial": trial,
            "restart": restart,
            "method": ident["method"],
            "phantom": model.trial.phantom,
            "overridden_gates": overridden,
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
            "seed": seed,
            "evaluations": result.evaluations,
            "stop": result.stop,
            "history": result.history,
            "replay": check,
            "settings": settings,
            "provenance": provenance([pose, markers, limits, robot], _PACKAGES, fingerprint(__name__)),
        },
    )


def best_of(fits: list[dict]) -> dict:
    """The fit with the lowest cost; ties go to the first restart."""
    return min(fits, key=lambda fit: (fit["cost"]["J"], fit["restart"]))


def parameter_array(fits: list[dict]) -> np.ndarray:
    """Parameters of fit records as (m, 12), in the order of `PARAMETERS`."""
    from real2sim.identification.parameters import as_vector

    return np.array([as_vector(fit["parameters"]) for fit in fits])
