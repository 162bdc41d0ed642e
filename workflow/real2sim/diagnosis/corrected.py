"""Where the parameters would be without the noise of what drives a system, and how well they are known then.

Where the motion that drives a system is replayed as it was measured, the simulation shakes with its noise. A fit
prefers parameters that shake less, and the curvature there says that they are well known. The cost that noise adds on
average is simulated and taken off, and so is what only noise tells about a parameter: the corrected score of Stefanski
(Commun. Stat. Theory 14, 1985) and Nakamura (Biometrika 77, 1990), with simulated draws for its expectation. The
corrected point scatters with the draws; it says how far a fit can be trusted, and is no fit itself. A replay of the
most probable motion (`recording.pelvis`) has no such noise.

`inference.identifiability.corrected_fit` does the same for a fit of J by itself. Two implementations stand because
their information differs: residuals of J are correlated in time, so its covariance needs the long-run scores of each
sample, while residuals here are whitened and carry the parameters of effects and prior rows beside the twelve.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from real2sim.diagnosis.refit import Hypothesis, JointResiduals, following
from real2sim.diagnosis.search import Pair

if TYPE_CHECKING:
    from real2sim.settings import DiagnosisSearchSettings

# Step of the ln-parameters for derivatives of what noise does: the same draws on either side, so a small one is exact
_STEP_LN = 1e-3


@dataclass(frozen=True)
class Correction:
    """Limits of the correction for noise of the drive: keys ``corrected_*`` of ``diagnosis.search``.

    ``draws`` of the noise and their ``seed``; ``iterations`` at most; ``longest_ln``, the longest step of an
    ln-parameter; ``enough_sd``, the step in SD at which the iteration ends; ``near_ln``, how far an ln-parameter may
    move before the noise is simulated anew; ``least_share`` of its information that a direction keeps.
    """

    draws: int
    iterations: int
    seed: int
    longest_ln: float
    enough_sd: float
    near_ln: float
    least_share: float

    @classmethod
    def from_options(cls, search: DiagnosisSearchSettings) -> Correction:
        """Return the rule of the slice ``diagnosis.search`` of the configuration."""
        return cls(
            search["corrected_draws"],
            search["corrected_iterations"],
            search["seed"],
            search["corrected_longest_ln"],
            search["corrected_enough_sd"],
            search["corrected_near_ln"],
            search["corrected_least_share"],
        )


def noise_terms(
    residuals: Callable[[np.ndarray], np.ndarray], z: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return the part of slope (n,) and normal matrix (n, n) of half the sum of squares that noise makes, at (n,).

    ``residuals`` (draws, n_r) are what it does to them at a point (n,).
    """
    here = residuals(z)
    slopes = []
    for i in range(len(z)):
        step = np.zeros(len(z))
        step[i] = _STEP_LN
        slopes.append((residuals(z + step) - here) / _STEP_LN)
    tangent = np.array(slopes)
    slope = np.einsum("idr,dr->i", tangent, here) / len(here)
    normal = np.einsum("idr,jdr->ij", tangent, tangent, optimize=True) / len(here)
    return slope, normal


def corrected(pair: Pair, hypothesis: Hypothesis, rule: Correction) -> tuple[np.ndarray, np.ndarray]:
    """``z`` (n + p,) of a converged hypothesis without the bias by noise of the drive, and its covariance.

    The system's parameters are corrected for what noise does to the residuals, the effects' own follow. Where the
    simulation does not bear a step, it stops there. It is the fitted point where the drive has no noise.
    """
    problem = following(pair.train, hypothesis, pair.system)
    everything = np.arange(len(hypothesis.z))
    shaken = pair.train.shaken(rule.draws, rule.seed)
    if shaken is None:
        return _as_it_is(problem, hypothesis.z)

    def noise(point: np.ndarray) -> np.ndarray:
        return pair.train.whiten(shaken(pair.system.values(point)))

    z = hypothesis.z.copy()
    n = len(hypothesis.base)
    seen, there = np.full(n, np.inf), (np.empty(0), np.empty((0, 0)))
    for iteration in range(rule.iterations + 1):
        r, jacobian = problem.with_jacobian(z, everything)
        slope, normal = jacobian.T @ r, jacobian.T @ jacobian
        normal[np.diag_indices_from(normal)] += 1e-9
        if np.abs(z[:n] - seen).max() > rule.near_ln:
            seen, there = z[:n], noise_terms(noise, z[:n])
        noise_slope, noise_normal = there
        if not np.isfinite(noise_normal).all():
            return z, np.asarray(np.linalg.inv(normal))
        slope[:n] -= noise_slope + noise_normal @ (z[:n] - seen)
        inverse = _inverse(normal, noise_normal, rule.least_share)
        # whitened residuals have unit variance: the meat of the sandwich is what they tell with their noise
        covariance = inverse @ normal @ inverse
        if iteration == rule.iterations:
            break
        step = np.clip(-inverse @ slope, -rule.longest_ln, rule.longest_ln)
        moved = np.clip(z + step, problem.lower, problem.upper)
        if not np.isfinite(problem.costs(moved[None])[0]):
            break
        done = np.all(np.abs(moved - z) < rule.enough_sd * np.sqrt(np.diag(covariance)))
        z = moved
        if done:
            break
    return z, covariance


def _as_it_is(problem: JointResiduals, z: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The point (n + p,) and its covariance by the curvature there."""
    _, jacobian = problem.with_jacobian(z, np.arange(len(z)))
    normal = jacobian.T @ jacobian
    normal[np.diag_indices_from(normal)] += 1e-9
    return z.copy(), np.asarray(np.linalg.inv(normal))


def _inverse(normal: np.ndarray, noise: np.ndarray, least_share: float) -> np.ndarray:
    """Inverse of the normal matrix less what noise tells, no direction below ``least_share`` of what it was."""
    # in the coordinates in which the normal matrix is the identity
    root = np.linalg.inv(np.linalg.cholesky(normal))
    own = np.zeros_like(normal)
    own[: len(noise), : len(noise)] = noise
    told, directions = np.linalg.eigh(root @ own @ root.T)
    left = np.maximum(1 - told, least_share)
    back = root.T @ directions
    return np.asarray((back / left) @ back.T)
