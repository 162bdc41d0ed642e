"""Residuals in units of their own noise, per band of frequency and over all channels at once.

Noise that is simulated through the plant is slow and common to several channels. A covariance per band whitens it;
constants that are unknown but the same for a whole trial are marginalised, and so are samples that are missing. After
that a sum of squares is a likelihood.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, replace

import numpy as np
from scipy.fft import dct

from real2sim import signals
from real2sim.diagnosis.sensors import by_sensor

# SD of a missing sample in SD of the noise: a prior so flat that the sample may be anything
_FLAT_SD = 1e4
# Functions that a missing stretch may follow beside those that its length and the last band's edge ask for
_MORE_FUNCTIONS = 4


def without_gaps(error: np.ndarray, known: np.ndarray) -> np.ndarray:
    """Return residuals (m, n, c) with straight lines, or zero, where ``known`` (n, c) says that nothing was measured.

    Filters of frequency need a number everywhere. None of these counts: see `Whitening.of_noise`.
    """
    sample = np.arange(len(known))
    for c in np.flatnonzero(~known.all(axis=0)):
        good = known[:, c]
        for row in error:
            row[~good, c] = np.interp(sample[~good], sample[good], row[good, c]) if good.any() else 0.0
    return error


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

    def functions(self, run: slice) -> np.ndarray:
        """Return what a stretch of samples may be (k, n), as far as the bands see it: cosines on it, zero elsewhere."""
        length = run.stop - run.start
        count = min(length, int(np.ceil(2 * length * self.step_s * self.edges[-1])) + _MORE_FUNCTIONS)
        out = np.zeros((count, self.n))
        phase = np.pi * (np.arange(length) + 0.5) / length
        out[:, run] = np.cos(np.arange(count)[:, None] * phase)
        return out

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
    counts: np.ndarray

    @classmethod
    def of_noise(
        cls,
        bands: Bands,
        error: np.ndarray,
        drawn: np.ndarray,
        nuisance: np.ndarray,
        floor: np.ndarray,
        scatter: np.ndarray | float = 0.0,
        known: np.ndarray | None = None,
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
        known
            Mask (n, c) of the samples that were measured, all by default. Nothing depends on what stands in the place
            of the others, as long as it is smooth.
        """
        coefficients, band = bands.spectrum(error), bands.index()
        channels, matrices = error.shape[2], []
        for b in range(len(bands.edges) - 1):
            rows = coefficients[:, band == b].reshape(-1, channels)
            covariance = rows.T @ rows / max(len(rows), 1)
            covariance += np.diag(np.maximum(floor**2, scatter**2 - np.diag(covariance)))
            matrices.append(np.linalg.inv(np.linalg.cholesky(covariance)))
        every = np.full(channels, float(bands.last))
        plain = cls(bands, np.array(matrices), error + drawn, np.empty((0, 0)), np.empty(0), every)
        missing = plain._missing(np.ones(error.shape[1:], bool) if known is None else known)
        # noise, nuisance and missing samples together are white after this: the inverse root of 1 + X' X
        unknown = np.concatenate([plain.in_noise(nuisance), missing])
        _, sizes, directions = np.linalg.svd(unknown, full_matrices=False)
        both = replace(plain, unknowns=directions, discounts=1 - 1 / np.sqrt(1 + sizes**2))
        # of unit variance in each direction, missing samples have this share, and noise the rest
        taken = (both._without_unknowns(missing) ** 2).sum(axis=0).reshape(-1, channels).sum(axis=0)
        return replace(both, counts=every - taken)

    def _missing(self, known: np.ndarray) -> np.ndarray:
        """Return whitened residuals (k, n_r) of what may stand where samples are missing; ``known`` (n, c)."""
        out = []
        for c in range(known.shape[1]):
            for run in signals.segments(~known[:, c]):
                functions = self.bands.functions(run)
                rows = np.zeros((*functions.shape, known.shape[1]))
                rows[:, :, c] = functions
                white = self.in_noise(rows)
                out.append(_FLAT_SD / np.sqrt((white**2).sum(axis=1).max()) * white)
        return np.concatenate([*out, np.empty((0, self.bands.last * known.shape[1]))])

    @property
    def log_determinant(self) -> float:
        """Logarithm of the determinant of the covariance of noise and nuisance together, of all residuals."""
        counts = np.bincount(self.bands.index(), minlength=len(self.matrices))
        noise = -2 * counts @ np.linalg.slogdet(self.matrices)[1]
        return float(noise - 2 * np.log1p(-self.discounts).sum())

    def counts_by_sensor(self, channels: Collection[int]) -> tuple[int, ...]:
        """Return the residuals (s,) that count, by sensor; ``channels`` (s,): see `by_sensor`."""
        parts = np.split(self.counts, np.cumsum([*channels])[:-1])
        return tuple(round(float(part.sum())) for part in parts)

    def of_noise_by_sensor(self, channels: Collection[int]) -> tuple[float, ...]:
        """Return the mean chi-squared (s,) of the simulated noise by sensor; ``channels`` (s,): see `by_sensor`."""
        return tuple(by_sensor(self.apply(self.noise), channels).mean(axis=0).tolist())

    def in_noise(self, error: np.ndarray) -> np.ndarray:
        """Return residuals (m, n_r) in units of simulated noise alone, of residuals (m, n, c)."""
        coefficients, band = self.bands.spectrum(error), self.bands.index()
        out: np.ndarray = np.empty_like(coefficients)
        for b, matrix in enumerate(self.matrices):
            out[:, band == b] = coefficients[:, band == b] @ matrix.T
        return out.reshape(len(error), out.shape[1] * out.shape[2])

    def apply(self, error: np.ndarray) -> np.ndarray:
        """Return residuals (m, n_r) whose squares sum to chi-squared, of residuals (m, n, c)."""
        return self._without_unknowns(self.in_noise(error))

    def _without_unknowns(self, out: np.ndarray) -> np.ndarray:
        """Return residuals (m, n_r) in units of simulated noise with what is marginalised taken away."""
        return np.asarray(out - (out @ self.unknowns.T * self.discounts) @ self.unknowns)
