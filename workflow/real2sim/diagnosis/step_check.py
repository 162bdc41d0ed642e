"""Is the time step of a described system fine enough for what its recordings determine? Halve it until it is."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import TYPE_CHECKING, cast

import numpy as np

from real2sim.diagnosis.intervals import least_sd
from real2sim.diagnosis.refit import JointResiduals
from real2sim.diagnosis.search import Pair
from real2sim.recording.formats.recordings import Finding

if TYPE_CHECKING:
    from real2sim.diagnosis.system_evidence import SystemEvidence
    from real2sim.settings import DiagnosisSettings
    from real2sim.system.description import System

# An error that goes with the step, as that of a simulation of first order, is twice what half the step changes
_ERROR_OF_CHANGE = 2.0


def fine_enough(pair: Pair, z: np.ndarray, settings: DiagnosisSettings) -> System:
    """Return the system of a pair with the time step that its recordings ask for: its own, or a half, a quarter, ...

    ``pair`` holds whitened recordings of a described system, ``z`` (p,) is their plain fit, ``settings`` the slice
    ``diagnosis``. The step is halved until its error is less than an SD of chi-squared of noise (``step_chi2_sd``) and
    moves no parameter by much of its SD (``step_sd``), or ``most_step_parts`` is reached.
    """
    channels, parts = settings["described"]["channels"], 1
    error, coarse = _error(pair, z, parts, settings)
    while coarse and parts < channels["most_step_parts"]:
        finer, coarse = _error(pair, z, 2 * parts, settings)
        if finer > error / 2:  # what does not shrink with the step is no error of it
            break
        error, parts = finer, 2 * parts
    return replace(pair.system, step_s=base_step_s(pair) / parts) if parts > 1 else pair.system


def base_step_s(pair: Pair) -> float:
    """Return the time step [s] with which a pair of a described system is simulated."""
    return cast("SystemEvidence", pair.train).simulated.base_step_s


def _error(pair: Pair, z: np.ndarray, parts: int, settings: DiagnosisSettings) -> tuple[float, bool]:
    """Return chi-squared of what a step in parts does to both recordings, and whether that is too much.

    Infinite and no reason to halve it where a simulation fails.
    """
    channels, values = settings["described"]["channels"], pair.system.values(z)
    total, coarse = 0.0, False
    for given in (pair.train, pair.held_out):
        evidence = cast("SystemEvidence", given)
        changed = evidence.changed_by_half_the_step(values, parts)
        if not np.isfinite(changed).all():
            return np.inf, False
        error = _ERROR_OF_CHANGE**2 * float(changed @ changed)
        coarse |= error > channels["step_chi2_sd"] * np.sqrt(2 * evidence.samples)
        if given is pair.train:
            _, moved = _moved(pair, z, changed, settings)
            coarse |= bool(np.abs(moved).max(initial=0.0) > channels["step_sd"])
        total += error
    return total, bool(coarse)


def _moved(
    pair: Pair, z: np.ndarray, changed: np.ndarray, settings: DiagnosisSettings
) -> tuple[np.ndarray, np.ndarray]:
    """Return searched parameters (k,), and how far each moves (k,) [SD] as residuals of the first trial change (n_r,).

    By one Gauss-Newton step, in units of the SD that the parameter's interval is made of. Empty where no Jacobian can
    be had.
    """
    problem = JointResiduals(pair.train, (), pair.system)
    free = problem.free
    _, jacobian = problem.with_jacobian(z, free)
    rows = jacobian[: len(changed)]
    if not (len(free) and np.isfinite(rows).all()):
        return free[:0], np.zeros(0)
    # in units of their SD; those that the recording does not determine have none to speak of
    scale = np.maximum(np.linalg.norm(rows, axis=0), 1e-12)
    covariance = np.linalg.pinv((rows / scale).T @ (rows / scale), rcond=1e-8)
    least = least_sd(pair.system, z, settings["report"])[free]
    sd = np.hypot(np.sqrt(np.diag(covariance)) / scale, least)
    return free, covariance @ (rows / scale).T @ changed / scale / sd


def step_findings(
    pair: Pair, z: np.ndarray, described: System, settings: DiagnosisSettings
) -> Iterator[Finding]:
    """Yield that the time step was made finer than ``described``, and a warning where even that moves a parameter far.

    ``pair`` holds recordings of a described system, ``z`` (p,) their plain fit; ``settings`` is the slice
    ``diagnosis``.
    """
    evidence, system = cast("SystemEvidence", pair.train), pair.system
    if system.step_s != described.step_s:
        yield Finding(
            "step_refined",
            "info",
            evidence.name,
            "step_s",
            f"steps of {described.step_s:.4g} s are coarser than the recordings bear",
            f"Simulated with {system.step_s:.4g} s. Write that into the description to save the trial of coarser ones.",
        )
    changed = evidence.changed_by_half_the_step(system.values(z))
    if not np.isfinite(changed).all():
        return
    free, moved = _moved(pair, z, changed, settings)
    if np.abs(moved).max(initial=0.0) > settings["described"]["channels"]["step_sd"]:
        worst = int(np.argmax(np.abs(moved)))
        yield Finding(
            "step_coarse",
            "warning",
            evidence.name,
            system.parameter_names[free[worst]],
            f"half the time step ({base_step_s(pair) / 2:.4g} s) would move it by {abs(moved[worst]):.2g} standard "
            "deviations",
            "Used as it is: intervals do not know of that. Lower step_s of the system.",
        )
