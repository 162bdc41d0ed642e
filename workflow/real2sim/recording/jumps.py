"""Markers that jump for some frames: another reflection was taken for them.

A jump of an interface marker stands out of its path, or of what a simulation leaves of it; such samples are left out
where `outliers` is the cause. A jump of a pelvis marker is of that one and not of the other three, whatever the body
does. The pose is taken from those as long as it lasts: the replayed pelvis would jump, and shake the robot for seconds.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, cast

import numpy as np

from real2sim import signals
from real2sim.geometry import PELVIS_MARKERS, pelvis_frame
from real2sim.recording import missing_marker
from real2sim.recording.trial import Trial, usable

if TYPE_CHECKING:
    from real2sim.settings import DiagnosisJumpsSettings, IngestSkinSettings


@dataclass(frozen=True)
class JumpRule:
    """Criterion for a jump of a marker, for a rate and a cut-off.

    ``rate_hz`` and ``cutoff_hz`` are of the common clock and of the low-pass of the ingest, ``options`` is the slice
    ``diagnosis.jumps`` of the configuration.
    """

    rate_hz: float
    cutoff_hz: float
    options: DiagnosisJumpsSettings

    def reach(self, name: str) -> float:
        """Return an option that is a time [s], longer where the low-pass is slower and smears further."""
        return float(
            cast("Mapping[str, float]", self.options)[name]
            * max(1.0, self.options["smear_cutoff_hz"] / self.cutoff_hz)
        )


def spikes(
    paths: np.ndarray, rule: JumpRule, sd: float | None = None, simulated: np.ndarray | None = None
) -> np.ndarray:
    """Return where marker paths, or residuals of them, (n, k, 3) jump, (n, k): fast content beyond ``sd`` usual ones.

    ``sd`` is that of a path by default. With a jump comes what the filter smears around it. Where a path begins or
    ends, also at a gap, a filter has one side only and leaves most of the noise: nothing is looked for there.
    ``simulated`` (n, k, 3) are the paths that residuals were taken from: as much as these have of fast content of their
    own, where a stop is hit, say, may be an error of the simulation.
    """
    fast = np.abs(_fast(paths, rule))
    usual = np.median(fast, axis=0) / 0.6745
    least = (rule.options["path_sd"] if sd is None else sd) * np.maximum(usual, rule.options["least_usual_m"])
    own = 0.0 if simulated is None else np.abs(_fast(simulated, rule))
    hit = (fast - own > least).any(axis=2)
    return _smeared(hit, paths, rule, "smear_s")


def ghosts(markers: np.ndarray, rule: JumpRule) -> np.ndarray:
    """Return which of the pelvis markers (n, 4, 3) [m] are another reflection, (n, 4), and where a filter smears it."""
    if np.isnan(markers).any(axis=2).all(axis=0).any():
        return np.zeros(markers.shape[:2], bool)
    fast = _fast(markers, rule)
    alone = np.linalg.norm(fast - np.median(fast, axis=1, keepdims=True), axis=2)
    hit = alone > np.maximum(rule.options["ghost_sd"] * np.median(alone, axis=0), rule.options["ghost_m"])
    return _smeared(hit, markers, rule, "ghost_smear_s")


def _fast(paths: np.ndarray, rule: JumpRule) -> np.ndarray:
    """Return what is faster than ``fast_hz`` in paths (n, k, 3)."""
    flat = signals.bridged(paths.reshape(len(paths), -1))
    slow = signals.lowpass(flat, rule.rate_hz, rule.options["fast_hz"], 4)
    return np.asarray(flat - slow).reshape(paths.shape)


def _smeared(hit: np.ndarray, paths: np.ndarray, rule: JumpRule, smear: str) -> np.ndarray:
    """Return hits (n, k) that are not at an end of their path (n, k, 3), and the samples around them."""
    lost = np.pad(~np.isfinite(paths).all(axis=2), ((1, 1), (0, 0)), constant_values=True)
    inside = hit & ~around(lost, rule, "edge_s")[1:-1]
    return around(inside, rule, smear)


def around(marked: np.ndarray, rule: JumpRule, reach: str) -> np.ndarray:
    """Return samples (n, k) that are no further from marked ones than the option ``reach``."""
    width = np.ones(2 * round(rule.reach(reach) * rule.rate_hz) + 1)
    return np.stack([np.convolve(column, width, "same") > 0.5 for column in marked.T], axis=1)


def without_ghosts(
    trial: Trial, rule: JumpRule, skin: IngestSkinSettings, settle_s: float
) -> tuple[Trial, dict[str, float]]:
    """The trial with the pelvis from its other three markers where one is a ghost, unknown where two are.

    A ghost is put where its marker would have been, had it been lost (`missing_marker`); ``skin`` is the slice
    ``ingest.skin``. ``settle_s``: see `load_trial`. Also for how long [s] which markers are not believed.
    """
    found = ghosts(trial.pelvis_markers, rule)
    lasts = found.sum(axis=0) / rule.rate_hz
    jumped = {name: float(s) for name, s in zip(PELVIS_MARKERS, lasts, strict=True) if s}
    if not jumped:
        return trial, {}
    markers = trial.pelvis_markers.copy()
    believed = np.isfinite(markers).all(axis=2) & ~found
    if believed.all(axis=1).any():
        lost = np.where(believed[:, :, None], markers, np.nan)
        model = missing_marker.places_in_pelvis(lost)
        for marker in np.flatnonzero(found.any(axis=0)).tolist():
            runs = signals.segments(found[:, marker])
            filled = missing_marker.put_back(lost, believed, model, marker, runs, skin)
            markers[found[:, marker], marker] = filled[found[:, marker]]
    markers[found.sum(axis=1) > 1] = np.nan
    changed = found.any(axis=1)
    rotation, position = trial.pelvis_rotation.copy(), trial.pelvis_position.copy()
    rotation[changed], position[changed] = pelvis_frame(*np.moveaxis(markers[changed], 1, 0))
    counts = trial.usable & usable(np.isfinite(position).all(axis=1), rule.rate_hz, settle_s)
    there = replace(trial, pelvis_rotation=rotation, pelvis_position=position)
    return replace(there, pelvis_markers=markers, usable=counts), jumped
