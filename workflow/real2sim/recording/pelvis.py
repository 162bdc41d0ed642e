"""The driven pelvis path: what the person most probably did, given markers that are noisy; its markers as a rigid body.

A replay that is driven by what the markers showed shakes with their noise, and whatever shakes less fits better: a
weaker damping, a law that filters the path. The mean of the person's path given the measured one (Wiener's filter) has
no such part. What is left of the person's path beside it does not depend on it (Berkson's model of errors, J. Am. Stat.
Assoc. 45 (1950) 164), so that no parameter gains by passing on less of it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.fft import dct, idct
from scipy.spatial.transform import Rotation

from real2sim import signals
from real2sim.geometry import PELVIS_MARKERS, pelvis_frame
from real2sim.recording.noise import NoiseModel
from real2sim.recording.tables import rotation_vectors
from real2sim.recording.trial import Trial

# Standing before a trial and slowing down after it [s], which a path is given so that its ends do not look like motion
_BEFORE_S, _AFTER_S = 1.0, 1.0
# How much of the end of a path [s] a polynomial is fitted to, and its degree: it tells where the motion after it begins
_END_S, _END_DEGREE = 0.5, 3
# Power of a motion in that of the noise, from which on the filter takes none of it
_LOUD = 100.0
# Draws of the noise that its spectrum is the mean of
_DRAWS = 8


@dataclass(frozen=True)
class PathRule:
    """Widths and levels by which spectra of a pelvis path are read: slice ``diagnosis.pelvis`` of the configuration.

    Power is averaged over ``smoothing_hz`` [Hz], or the ``smoothing_share`` of the frequency where that is more. A line
    of the spectrum, as steps make them, is averaged over ``line_coefficients`` cosine coefficients alone where that has
    ``loud_power`` times the power of the noise, whose level is known to ``level_share``. What laws depend on is never
    low-passed below ``lowest_cutoff_hz`` [Hz].
    """

    smoothing_hz: float
    smoothing_share: float
    level_share: float
    line_coefficients: int
    loud_power: float
    lowest_cutoff_hz: float


@dataclass(frozen=True)
class PathFilter:
    """Filter of a pelvis path (n, 6) at ``rate_hz`` by the power (f, 6) of ``motion`` and ``noise``.

    Powers are those of cosine coefficients of the path with its surroundings. The person stands still in the first
    ``start`` samples.
    """

    rate_hz: float
    start: int
    motion: np.ndarray
    noise: np.ndarray

    @classmethod
    def of_path(
        cls, path: np.ndarray, noise: np.ndarray, rate_hz: float, last_hz: float, start: int, rule: PathRule
    ) -> PathFilter:
        """Return the filter of a measured path (n, 6) by draws (d, n, 6) of its noise.

        Above ``last_hz`` the ingest has left little of either: what counts there is as loud as noise is below.
        """
        unknown = cls(rate_hz, start, np.empty(0), np.empty(0))
        power = _spectrum(unknown._surrounded(path)) ** 2
        per_hz = 2 * len(power) / rate_hz
        frequency = np.arange(len(power)) / per_hz
        wide = per_hz * np.maximum(rule.smoothing_hz, rule.smoothing_share * frequency)
        around = (unknown._before, unknown._after), (0, 0)
        loud = _averaged(np.mean([_spectrum(np.pad(draw, around)) ** 2 for draw in noise], axis=0), wide)
        beyond = frequency > last_hz
        loud[beyond] = np.maximum(loud[beyond], loud[~beyond][-1])
        loud *= 1 + rule.level_share
        line = _averaged(power, np.full(len(power), float(rule.line_coefficients)))
        # a line counts where noise alone would hardly make it, and the wide average everywhere
        of_line = np.where(line > rule.loud_power * loud, line, 0.0)
        motion = np.maximum(np.maximum(_averaged(power, wide), of_line) - loud, 0.0)
        return cls(rate_hz, start, motion, loud)

    @property
    def passed(self) -> np.ndarray:
        """Share (f, 6) of each coefficient that the person made: that of the motion in the power of both."""
        return np.asarray(self.motion / (self.motion + self.noise))

    def cutoff_hz(self, lowest_hz: float, last_hz: float) -> float:
        """Return the highest frequency [Hz] about which half of some coordinate is motion, within limits.

        Shares are averaged over 1 Hz: among hundreds of coefficients, noise makes a line here and there.
        """
        passed, per_hz = self.passed, 2 * len(self.passed) / self.rate_hz
        frequency = np.arange(len(passed)) / per_hz
        about = _averaged(passed, np.full(len(passed), per_hz))
        highest = frequency[(about >= 0.5).any(axis=1)].max(initial=0.0)
        return float(np.clip(highest, lowest_hz, last_hz))

    def most_probable(self, path: np.ndarray) -> np.ndarray:
        """Return the mean (n, 6) of the person's path given a measured one (n, 6)."""
        return self._filtered(self._surrounded(path))

    def left(self, noise: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        """Return a draw (n, 6) of how the person's path differs from that mean, by a draw (n, 6) of the noise.

        A motion of the same power is drawn after the standing, measured with that noise, and filtered as the path was
        (Matheron's rule). Of what is far louder than the noise only that much is drawn: nothing is lost of it.
        """
        power = np.sqrt(np.minimum(self.motion, _LOUD * self.noise))
        motion = idct(power * rng.standard_normal(power.shape), axis=0, norm="ortho")
        seen = self._before + len(noise)
        begun = np.clip((np.arange(len(motion)) - self._before) / self.start - 1, 0, 1)
        motion *= (begun**2 * (3 - 2 * begun))[:, None]
        # the mean of the noise is what is taken for the place where the person stands
        stands = np.repeat(noise[: self.start].mean(axis=0)[None], self._before, axis=0)
        path = motion[:seen] + np.concatenate([stands, noise])
        return np.asarray(self._filtered(self._slowed_down(path)) - motion[self._before : seen])

    def _filtered(self, surrounded: np.ndarray) -> np.ndarray:
        """Return a path (n, 6) of its surroundings (f, 6), with the share of each coefficient that the person made."""
        out = idct(_spectrum(surrounded) * self.passed, axis=0, norm="ortho")
        return np.asarray(out[self._before : len(out) - self._after])

    @property
    def _before(self) -> int:
        return round(_BEFORE_S * self.rate_hz)

    @property
    def _after(self) -> int:
        return round(_AFTER_S * self.rate_hz)

    def _surrounded(self, path: np.ndarray) -> np.ndarray:
        """Path (n, k) with the mean of the standing before it, and a motion after it that comes to rest."""
        before = np.repeat(path[: self.start].mean(axis=0)[None], self._before, axis=0)
        return self._slowed_down(np.concatenate([before, path]))

    def _slowed_down(self, path: np.ndarray) -> np.ndarray:
        """Path (n, k) with a motion after it that comes to rest."""
        last = path[-round(_END_S * self.rate_hz) :]
        *_, slope, value = np.polyfit(np.arange(1 - len(last), 1), last, _END_DEGREE)
        step = np.arange(1, self._after + 1)[:, None]
        return np.concatenate([path, value + slope * (step - step**2 / (2 * self._after))])


def _spectrum(surrounded: np.ndarray) -> np.ndarray:
    """Return the cosine coefficients (f, k) of a path with its surroundings (f, k)."""
    return np.asarray(dct(surrounded, axis=0, norm="ortho"))


def _averaged(power: np.ndarray, width: np.ndarray) -> np.ndarray:
    """Return spectra (f, k) averaged over ``width`` (f,) neighbours of each coefficient, fewer at the ends."""
    total = np.concatenate([np.zeros((1, power.shape[1])), np.cumsum(power, axis=0)])
    index = np.arange(len(power))
    half = np.maximum(width / 2, 0.5)
    low = np.clip(np.round(index + 0.5 - half).astype(int), 0, len(power) - 1)
    high = np.clip(np.round(index + 0.5 + half).astype(int), low + 1, len(power))
    return np.asarray((total[high] - total[low]) / (high - low)[:, None])


def path_of(trial: Trial) -> np.ndarray:
    """Return the pelvis path (n, 6) [m, rad]: position, rotation vector from the first known pose; gaps are bridged."""
    return np.hstack([signals.bridged(trial.pelvis_position), rotation_vectors(trial.pelvis_rotation)])


def with_path(trial: Trial, path: np.ndarray) -> Trial:
    """Return the trial with another pelvis path (n, 6), as of `path_of`; what was lost stays so."""
    lost = ~np.isfinite(trial.pelvis_position).all(axis=1)
    first = trial.pelvis_rotation[np.argmax(np.isfinite(trial.pelvis_rotation).all(axis=(1, 2)))]
    position, rotation = path[:, :3].copy(), first @ Rotation.from_rotvec(path[:, 3:]).as_matrix()
    position[lost], rotation[lost] = np.nan, np.nan
    return replace(trial, pelvis_position=position, pelvis_rotation=rotation)


def path_noise(trial: Trial, noise: NoiseModel, rng: np.random.Generator) -> np.ndarray:
    """Draw what noise of its markers adds to a pelvis path, (n, 6) [m, rad]."""
    rigid = rigid_markers(trial)
    moved = noise.filtered(PELVIS_MARKERS, rigid.shape[1], rng)
    clean, shaken = pelvis_frame(*rigid), pelvis_frame(*(rigid + np.moveaxis(moved, 1, 0)))
    first = clean[0][np.argmax(np.isfinite(clean[0]).all(axis=(1, 2)))]
    still, turned = (rotation_vectors(pose[0], first) for pose in (clean, shaken))
    return np.hstack([signals.bridged(shaken[1] - clean[1]), turned - still])


def most_probable_pelvis(
    trial: Trial, noise: NoiseModel, start: int, rule: PathRule
) -> tuple[Trial, PathFilter]:
    """Return the trial with the most probable pelvis path, and the filter that made it.

    Noise of the replayed pelvis shakes loose what friction holds: a law with memory sees another motion than the
    person made. The person stands still in the first ``start`` samples.
    """
    rng, path = np.random.default_rng(0), path_of(trial)
    draws = np.array([path_noise(trial, noise, rng) for _ in range(_DRAWS)])
    made = PathFilter.of_path(path, draws, noise.bands.rate_hz, noise.bands.low_pass.cutoff_hz, start, rule)
    return with_path(trial, made.most_probable(path)), made


def rigid_markers(trial: Trial) -> np.ndarray:
    """Pelvis markers (4, n, 3) [m, world] as a rigid body on the measured pose: there also where one was lost."""
    rotation, position = trial.pelvis_rotation, trial.pelvis_position
    seen = position[:, None] + np.einsum("nij,kj->nki", rotation, pelvis_shape(trial))
    return np.moveaxis(seen, 1, 0)


def pelvis_shape(trial: Trial) -> np.ndarray:
    """Return the mean places of the pelvis' markers on it, (4, 3) [m]."""
    rotation, away = trial.pelvis_rotation, trial.pelvis_markers - trial.pelvis_position[:, None]
    return np.asarray(np.nanmean(np.einsum("nji,nkj->nki", rotation, away), axis=0))
