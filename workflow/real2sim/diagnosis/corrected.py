"""Where the parameters would be without the noise of the replayed pelvis, and how well they are known then.

The pelvis path that is replayed is measured, so the simulation shakes with its noise. A fit prefers parameters that
shake less: a stiff pitch axis is given several times its damping, and the curvature there says that this is known to
a tenth. The cost that noise adds on average is simulated and taken off, and so is what only noise tells about a
parameter: the corrected score of Stefanski (Commun. Stat. Theory 14, 1985) and Nakamura (Biometrika 77, 1990), with
simulated draws for its expectation. The corrected point scatters with the draws; it says how far a fit can be
trusted, and is no fit itself.

`inference.identifiability.corrected_fit` does the same for a fit of J by itself. Two implementations stand because
their information differs: residuals of J are correlated in time, so its covariance needs the long-run scores of each
sample, while residuals here are whitened and carry the parameters of effects and prior rows beside the twelve.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from real2sim.diagnosis.refit import Hypothesis, JointResiduals
from real2sim.diagnosis.search import Pair

# Step of the ln-parameters for derivatives of what noise does: the same draws on either side, so a small one is exact
_STEP_LN = 1e-3
# Share of what the residuals tell about a direction that is left to it at least, however much of it noise may tell
_LEAST_SHARE = 0.02
# Longest correction of an ln-parameter in one iteration, and the correction in SD at which it ends
_LONGEST, _ENOUGH_SD = 0.7, 0.1
# As long as no ln-parameter has moved further, what noise does there is reckoned from where it was simulated
_NEAR = 0.1


def noise_terms(
    residuals: Callable[[np.ndarray], np.ndarray], z: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """What noise adds to slope (12,) and normal matrix (12, 12) of half the sum of squares at ln-parameters (12,).

    ``residuals`` (draws, n_r) are what it does to them at a point (12,).
    """
    here = residuals(z)
    slopes = []
    for i in range(12):
        step = np.zeros(12)
        step[i] = _STEP_LN
        slopes.append((residuals(z + step) - here) / _STEP_LN)
    tangent = np.array(slopes)
    slope = np.einsum("idr,dr->i", tangent, here) / len(here)
    normal = np.einsum("idr,jdr->ij", tangent, tangent, optimize=True) / len(here)
    return slope, normal


def corrected(
    pair: Pair, hypothesis: Hypothesis, *, draws: int, iterations: int, seed: int
) -> tuple[np.ndarray, np.ndarray]:
    """``z`` (12 + p,) of a converged hypothesis without the bias by noise of the pelvis, and its covariance.

    The strap's parameters are corrected for what noise does to the residuals, the effects' own follow. Where the
    simulation does not bear a step, it stops there.
    """
    problem = JointResiduals(pair.train, hypothesis.effects, pair.system)
    everything = np.arange(len(hypothesis.z))
    shaken = pair.train.shaken(draws, seed)

    def noise(point: np.ndarray) -> np.ndarray:
        return pair.train.whiten(shaken(pair.system.values(point)))

    z = hypothesis.z.copy()
    seen, there = np.full(12, np.inf), (np.empty(0), np.empty((0, 0)))
    for iteration in range(iterations + 1):
        r, jacobian = problem.with_jacobian(z, everything)
        slope, normal = jacobian.T @ r, jacobian.T @ jacobian
        normal[np.diag_indices_from(normal)] += 1e-9
        if np.abs(z[:12] - seen).max() > _NEAR:
            seen, there = z[:12], noise_terms(noise, z[:12])
        noise_slope, noise_normal = there
        if not np.isfinite(noise_normal).all():
            return z, np.asarray(np.linalg.inv(normal))
        slope[:12] -= noise_slope + noise_normal @ (z[:12] - seen)
        inverse = _inverse(normal, noise_normal)
        # whitened residuals have unit variance: the meat of the sandwich is what they tell with their noise
        covariance = inverse @ normal @ inverse
        if iteration == iterations:
            break
        step = np.clip(-inverse @ slope, -_LONGEST, _LONGEST)
        moved = np.clip(z + step, problem.lower, problem.upper)
        if not np.isfinite(problem.costs(moved[None])[0]):
            break
        done = np.all(np.abs(moved - z) < _ENOUGH_SD * np.sqrt(np.diag(covariance)))
        z = moved
        if done:
            break
    return z, covariance


def _inverse(normal: np.ndarray, noise: np.ndarray) -> np.ndarray:
    """Inverse of the normal matrix less what noise tells (12, 12), no direction below a share of what it was."""
    # in the coordinates in which the normal matrix is the identity
    root = np.linalg.inv(np.linalg.cholesky(normal))
    own = np.zeros_like(normal)
    own[:12, :12] = noise
    told, directions = np.linalg.eigh(root @ own @ root.T)
    left = np.maximum(1 - told, _LEAST_SHARE)
    back = root.T @ directions
    return np.asarray((back / left) @ back.T)
