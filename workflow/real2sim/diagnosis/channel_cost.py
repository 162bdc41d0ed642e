"""Plain cost of observed channels: the mean square of their residuals, each in units of how much it varies."""

from __future__ import annotations

import numpy as np

_FAILED = 1e6


class ChannelCost:
    """Cost of simulated channels against one trial.

    Attributes
    ----------
    scale
        (c,) standard deviation of each measured channel over the trial.
    """

    def __init__(self, measured: np.ndarray):
        self._valid = np.isfinite(measured)
        self._measured = np.where(self._valid, measured, 0.0)
        spread = np.nanstd(measured, axis=0)
        self.scale = np.where(spread > 0, spread, 1.0)
        self._weight = self._valid / self._valid.sum()

    def residuals(self, simulated: np.ndarray) -> np.ndarray:
        """Return residuals (m, n_r) of simulated channels (m, n, c), whose sum of squares is the cost."""
        error = (simulated - self._measured) / self.scale * np.sqrt(self._weight)
        return np.asarray(error.reshape(len(simulated), -1))

    def sample_of_residual(self) -> np.ndarray:
        """Return the sample index (n_r,) of each residual."""
        n, c = self._measured.shape
        return np.repeat(np.arange(n), c)

    def energy(self, difference: np.ndarray) -> np.ndarray:
        """Return what differences (m, n, c) would cost by themselves, (m,)."""
        return self(difference + self._measured)

    def __call__(self, simulated: np.ndarray) -> np.ndarray:
        """Return the cost (m,) of simulated channels (m, n, c); large where a simulation failed."""
        cost = np.sum(self.residuals(simulated) ** 2, axis=1)
        return np.where(np.isfinite(cost), cost, _FAILED)
