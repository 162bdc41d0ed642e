"""What a hypothesis leaves of a trial that it was not fitted to, with numbers that move as far as is left open.

The numbers of a fit are known as well as its trials let them be. With fixed numbers, a true law leaves more than noise
of another trial that tells those better, and that says nothing against the law.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from real2sim.diagnosis.evidence import Evidence
from real2sim.diagnosis.refit import Hypothesis, following, prior_widths
from real2sim.diagnosis.sensors import by_sensor
from real2sim.inference.least_squares import bounded_step
from real2sim.system.description import System


@dataclass(frozen=True)
class Predicted:
    """Chi-squared that a set leaves of a further trial by sensor, and what the predictive likelihood adds to it."""

    by_sensor: tuple[float, ...]
    occam: float

    @property
    def chi2(self) -> float:
        """Chi-squared of all sensors."""
        return sum(self.by_sensor)


def information(trials: Sequence[Evidence], hypothesis: Hypothesis, system: System) -> np.ndarray:
    """Return what trials and the priors tell of a hypothesis' searched numbers: normal matrix (n + p, n + p).

    ``trials`` are the fitted one and, where it has told too, the held-out one.
    """
    everything = np.arange(len(hypothesis.z))
    total = np.zeros((len(everything), len(everything)))
    for index, evidence in enumerate(trials):
        problem = following(evidence, hypothesis, system, coarse=True)
        _, jacobian = problem.with_jacobian(hypothesis.z, everything)
        # rows of the priors count once
        rows = jacobian[: evidence.rows] if index else jacobian
        total += rows.T @ rows
    # a number without a prior of its own has a uniform one between its bounds
    width = prior_widths(problem.prior_sd, problem.lower, problem.upper)
    total[np.diag_indices_from(total)] += np.where(np.isfinite(problem.prior_sd), 1e-9, 1 / width**2)
    return total


def predict(
    evidence: Evidence,
    residuals: np.ndarray,
    slopes: np.ndarray,
    known: np.ndarray,
    bounds: tuple[np.ndarray, np.ndarray],
) -> tuple[Predicted | None, np.ndarray, np.ndarray]:
    """Return the prediction of a trial, the step (m,) of the numbers, and what is known of them then (m, m).

    ``residuals`` (n_r,) and their ``slopes`` (n_r, m) are those of the trial, ``known`` (m, m) is what was known of the
    numbers, ``bounds`` (m,) each are those of the step. None where the simulation does not bear it.
    """
    step = np.zeros(len(known))
    if not (np.isfinite(residuals).all() and np.isfinite(slopes).all()):
        return None, step, known
    more = known + slopes.T @ slopes
    step = bounded_step(more, slopes.T @ residuals, *bounds)
    narrowed = np.linalg.slogdet(more)[1] - np.linalg.slogdet(known)[1]
    left = by_sensor((residuals + slopes @ step)[None], evidence.sensors.values())[0].tolist()
    out = Predicted(tuple(left), float(step @ known @ step + narrowed))
    if not np.isfinite([*left, out.occam]).all():
        return None, np.zeros(len(known)), known
    return out, step, more
