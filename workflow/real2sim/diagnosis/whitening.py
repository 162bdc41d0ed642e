"""Residuals in units of their own noise, per band of frequency and over all channels at once.

Noise that is simulated through the plant is slow and common to several channels. A covariance per band whitens it;
constants that are unknown but the same for a whole trial are marginalised. After that a sum of squares is a likelihood.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass

import numpy as np
from scipy.fft import dct

from real2sim.diagnosis.sensors import by_sensor


@dataclass(frozen=True)
class Bands:
    """Cosine spectra of a trial of ``n`` samples at intervals of ``step_s`` [s], in bands between ``edges`` [Hz]."""

    edges: tuple[float, ...]
    n: int
    step_s: float

    @property
    def last(self) -> int:
        """Number of cosine coefficients up to the last band's edge."""
        duration = self.n * self.step_s
        return min(self.n, int(2 * duration * self.edges[-1]))

    def spectrum(self, error: np.ndarray) -> np.ndarray:
        """Return the cosine coefficients (m, f, c) of residuals (m, n, c) up to the last band's edge."""
        return np.asarray(dct(error, axis=1, norm="ortho")[:, : self.last])

    def index(self) -> np.ndarray:
        """Return the band of each cosine coefficient, (f,)."""
        duration = self.n * self.step_s
        frequency = np.arange(self.last) / (2 * duration)
        return np.searchsorted(self.edges[1:-1], frequency, side="right")


@dataclass(frozen=True)
class Whitening:
    """Matrices and directions that bring residuals to unit variance.

    ``matrices`` (bands, c, c) whiten the noise of each band; ``unknowns`` (k, n_r) are directions of unit length among
    the whitened residuals along which per-trial nuisance parameters move them, and ``discounts`` (k,) the share of each
    that is marginalised. ``noise`` (draws, n, c) are simulated residuals of a perfect model, nuisance included.
    """

    bands: Bands
    matrices: np.ndarray
    noise: np.ndarray
    unknowns: np.ndarray
    discounts: np.ndarray

    @classmethod
    def of_noise(
        cls,
        bands: Bands,
        error: np.ndarray,
        drawn: np.ndarray,
        nuisance: np.ndarray,
        floor: np.ndarray,
        scatter: np.ndarray | float = 0.0,
    ) -> Whitening:
        """Whiten by simulated noise.

        Parameters
        ----------
        error
            Residuals (draws, n, c) of a perfect model by noise alone.
        drawn
            Residuals (draws, n, c) by drawn nuisance parameters.
        nuisance
            Residuals (k, n, c) by one standard deviation of each per-trial nuisance parameter.
        floor
            SD (c,) below which no residual of a channel is trusted.
        scatter
            SD (c,) of all noise of a channel from repeat to repeat, 0 where it was not measured. Simulated noise
            is part of it, so that only what is beyond counts.
        """
        coefficients, band = bands.spectrum(error), bands.index()
        channels, matrices = error.shape[2], []
        for b in range(len(bands.edges) - 1):
            rows = coefficients[:, band == b].reshape(-1, channels)
            covariance = rows.T @ rows / max(len(rows), 1)
            covariance += np.diag(np.maximum(floor**2, scatter**2 - np.diag(covariance)))
            matrices.append(np.linalg.inv(np.linalg.cholesky(covariance)))
        plain = cls(bands, np.array(matrices), error + drawn, np.empty((0, 0)), np.empty(0))
        # noise and nuisance together are white after this: the inverse root of 1 + X' X
        _, sizes, directions = np.linalg.svd(plain.in_noise(nuisance), full_matrices=False)
        return cls(bands, plain.matrices, plain.noise, directions, 1 - 1 / np.sqrt(1 + sizes**2))

    @property
    def log_determinant(self) -> float:
        """Logarithm of the determinant of the covariance of noise and nuisance together, of all residuals."""
        counts = np.bincount(self.bands.index(), minlength=len(self.matrices))
        noise = -2 * counts @ np.linalg.slogdet(self.matrices)[1]
        return float(noise - 2 * np.log1p(-self.discounts).sum())

    def of_noise_by_sensor(self, channels: Collection[int]) -> tuple[float, ...]:
        """Return the mean chi-squared (s,) of the simulated noise by sensor; ``channels`` (s,): see `by_sensor`."""
        return tuple(by_sensor(self.apply(self.noise), channels).mean(axis=0).tolist())

    def in_noise(self, error: np.ndarray) -> np.ndarray:
        """Return residuals (m, n_r) in units of simulated noise alone, of residuals (m, n, c)."""
        coefficients, band = self.bands.spectrum(error), self.bands.index()
        out = np.empty_like(coefficients)
        for b, matrix in enumerate(self.matrices):
            out[:, band == b] = coefficients[:, band == b] @ matrix.T
        return out.reshape(len(error), out.shape[1] * out.shape[2])

    def apply(self, error: np.ndarray) -> np.ndarray:
        """Return residuals (m, n_r) whose squares sum to chi-squared, of residuals (m, n, c)."""
        out = self.in_noise(error)
        return np.asarray(out - (out @ self.unknowns.T * self.discounts) @ self.unknowns)
