"""Cost of a replay against the measured interface markers (paper, eq. 3)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

# Where MuJoCo gives up on a parameter vector the search must be told that it is bad, and how bad is known: no
# finite replay of a person in a lab comes near 100 m
FAILED_COST = 1e6


@dataclass(frozen=True)
class CostScales:
    """Characteristic scales of the residuals: position [m], velocity [m/s]."""

    position: float
    velocity: float


@dataclass(frozen=True)
class CostTerms:
    """Cost of each of m replays, (m,): total and its two terms, and the position RMSE [m]."""

    total: np.ndarray
    position: np.ndarray
    velocity: np.ndarray
    rmse_position: np.ndarray


class TrialCost:
    """Cost of simulated interface paths against one trial.

    Parameters
    ----------
    measured
        (n, 2, 3) interface markers left, right [m, world]; NaN where masked.
    rate_hz
        Sample rate.
    scales
        sigma_p and sigma_v of eq. 3.
    usable
        (n,) optional mask of samples whose pelvis is measured.

    Attributes
    ----------
    measured
        (n, 2, 3) as given, 0 where masked.
    """

    def __init__(
        self, measured: np.ndarray, rate_hz: float, scales: CostScales, usable: np.ndarray | None = None
    ):
        valid = np.isfinite(measured).all(axis=2)
        if usable is not None:
            valid &= usable[:, None]
        # velocity by central differences: both neighbours must be measured
        valid_rate = valid[2:] & valid[:-2] & valid[1:-1]
        if not valid_rate.any():
            raise ValueError("no sample of the interface markers is usable")
        self.measured = np.where(valid[:, :, None], measured, 0.0)
        self._weight = valid / valid.sum()
        self._weight_rate = valid_rate / valid_rate.sum()
        self._half_rate = rate_hz / 2
        self.scales = scales
        self.samples = int(valid.sum())

    def residuals(self, simulated: np.ndarray) -> np.ndarray:
        """Return weighted residuals (m, n_r) of simulated paths (m, n, 2, 3), whose sum of squares is J.

        Position residuals first, then velocity residuals, each by sample, side and axis. A failed simulation is NaN.
        """
        error = simulated - self.measured
        rate = (error[:, 2:] - error[:, :-2]) * self._half_rate
        m = len(simulated)
        error *= np.sqrt(self._weight)[:, :, None] / self.scales.position
        rate *= np.sqrt(self._weight_rate)[:, :, None] / self.scales.velocity
        return np.concatenate([error.reshape(m, -1), rate.reshape(m, -1)], axis=1)

    def energy(self, difference: np.ndarray) -> np.ndarray:
        """Return J (m,) of differences of paths (m, n, 2, 3) [m] alone, such as noise."""
        return self(difference + self.measured).total

    def sample_of_residual(self) -> np.ndarray:
        """Return the sample index (n_r,) of each residual: residuals near in time are not independent."""
        n = len(self.measured)
        return np.concatenate([np.repeat(np.arange(n), 6), np.repeat(np.arange(1, n - 1), 6)])

    def __call__(self, simulated: np.ndarray) -> CostTerms:
        """Return the cost of simulated paths (m, n, 2, 3) [m, world]."""
        error = simulated - self.measured
        rate = (error[:, 2:] - error[:, :-2]) * self._half_rate
        position = np.einsum("mscx,mscx,sc->m", error, error, self._weight)
        velocity = np.einsum("mscx,mscx,sc->m", rate, rate, self._weight_rate)
        # a masked sample has weight 0, but 0 * NaN would hide a failed simulation as NaN: name it instead
        bad = ~np.isfinite(position + velocity)
        position = np.where(bad, FAILED_COST * self.scales.position**2 / 2, position)
        velocity = np.where(bad, FAILED_COST * self.scales.velocity**2 / 2, velocity)
        j_p, j_v = position / self.scales.position**2, velocity / self.scales.velocity**2
        return CostTerms(j_p + j_v, j_p, j_v, np.sqrt(position))
