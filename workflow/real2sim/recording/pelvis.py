"""The driven pelvis path: low-passed to what stands out of its noise, and its markers as a rigid body."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from scipy.fft import dct
from scipy.spatial.transform import Rotation

from real2sim import signals
from real2sim.geometry import PELVIS_MARKERS, pelvis_frame
from real2sim.recording.tables import rotation_vectors
from real2sim.recording.trial import Trial


@dataclass(frozen=True)
class CutoffRule:
    """Cut-off of the pelvis path's low-pass: slice ``diagnosis.pelvis`` of the configuration.

    ``lowest_cutoff_hz``: never below this [Hz]; ``loud_power``: a frequency counts where its power is so many times
    that of the noise; ``cutoff_margin``: the cut-off over the highest frequency that counts.
    """

    lowest_cutoff_hz: float
    loud_power: float
    cutoff_margin: float


def lowpass_from_standing(values: np.ndarray, rate_hz: float, cutoff_hz: float, start: int) -> np.ndarray:
    """Low-passed series (n, ...) of somebody who stood still before it as on average in its first samples.

    A filter that knows no better takes the first sample as it is, with all its noise, and the simulation starts there:
    with markers of 3.4 mm the strap was 8 mm off at the start, and let the robot go there and come back.
    """
    before = np.repeat(values[:start].mean(axis=0)[None], round(rate_hz), axis=0)
    flat = np.concatenate([before, values]).reshape(len(before) + len(values), -1)
    return signals.lowpass(flat, rate_hz, cutoff_hz, 4)[len(before) :].reshape(values.shape)


def smoothed_pelvis(
    trial: Trial,
    sd: Mapping[str, np.ndarray],
    rate_hz: float,
    cutoff_hz: float,
    start: int,
    rule: CutoffRule,
) -> tuple[Trial, float]:
    """The trial with its pelvis path low-passed to what stands out of the noise, and the cut-off [Hz].

    Noise of the replayed pelvis shakes loose what friction holds: a law with memory sees another motion than the
    person made. Above the cut-off none of the six pelvis coordinates has ``rule.loud_power`` times the power of its
    noise. The person stands still in the first ``start`` samples. ``sd`` (3,) [m] is the SD of each pelvis marker's
    white noise.
    """
    position, vectors = signals.bridged(trial.pelvis_position), rotation_vectors(trial.pelvis_rotation)
    rigid = rigid_markers(trial)
    rng = np.random.default_rng(0)
    white = np.stack([rng.standard_normal(rigid.shape[1:]) * sd[name] for name in PELVIS_MARKERS])
    clean, shaken = pelvis_frame(*rigid), pelvis_frame(*(rigid + white))
    turn = np.einsum("nji,njk->nik", clean[0], shaken[0])
    known = np.isfinite(turn).all(axis=(1, 2))
    noise = np.hstack([(shaken[1] - clean[1])[known], Rotation.from_matrix(turn[known]).as_rotvec()])
    power = dct(np.hstack([position, vectors]), axis=0, norm="ortho") ** 2
    frequency = np.arange(len(power)) * rate_hz / (2 * len(power))
    width = max(6, int(2 * len(power) / rate_hz))  # one hertz
    mean = np.stack([np.convolve(row, np.ones(width) / width, "same") for row in power.T], axis=1)
    loud = (mean > rule.loud_power * noise.var(axis=0)).any(axis=1) & (frequency < cutoff_hz)
    last = float(frequency[loud].max()) if loud.any() else rule.lowest_cutoff_hz
    chosen = float(np.clip(rule.cutoff_margin * last, rule.lowest_cutoff_hz, cutoff_hz))
    if chosen >= cutoff_hz:
        return trial, cutoff_hz
    lost = ~np.isfinite(trial.pelvis_position).all(axis=1)
    position = lowpass_from_standing(position, rate_hz, chosen, start)
    vectors = lowpass_from_standing(vectors, rate_hz, chosen, start)
    first = trial.pelvis_rotation[np.argmax(np.isfinite(trial.pelvis_rotation).all(axis=(1, 2)))]
    rotation = first @ Rotation.from_rotvec(vectors).as_matrix()
    position[lost], rotation[lost] = np.nan, np.nan
    return replace(trial, pelvis_position=position, pelvis_rotation=rotation), chosen


def rigid_markers(trial: Trial) -> np.ndarray:
    """Pelvis markers (4, n, 3) [m, world] as a rigid body on the measured pose: there also where one was lost."""
    rotation, position = trial.pelvis_rotation, trial.pelvis_position
    seen = position[:, None] + np.einsum("nij,kj->nki", rotation, pelvis_shape(trial))
    return np.moveaxis(seen, 1, 0)


def pelvis_shape(trial: Trial) -> np.ndarray:
    """Return the mean places of the pelvis' markers on it, (4, 3) [m]."""
    rotation, away = trial.pelvis_rotation, trial.pelvis_markers - trial.pelvis_position[:, None]
    return np.asarray(np.nanmean(np.einsum("nji,nkj->nki", rotation, away), axis=0))
