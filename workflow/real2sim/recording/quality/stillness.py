"""Sway of a person in `neutral`: range of pelvis and interface below the band of measurement noise."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from real2sim import geometry, signals
from real2sim.recording import alignment

_ENDS_S = 1.0  # at either end, for the drift


@dataclass(frozen=True)
class Sway:
    """Largest range along an axis of pelvis and interface [m] and of the pelvis' rotation [rad]; drift of the pelvis.

    ``drift_m`` and ``drift_rad`` are between the means of the first and the last second.
    """

    pelvis_m: float
    interface_m: float
    rotation_rad: float
    drift_m: float
    drift_rad: float


def _slow(values: np.ndarray, rate_hz: float, band_hz: float) -> np.ndarray:
    """Values (n, k) below ``band_hz``, of rows without NaN."""
    good = signals.known(values)
    rows = np.arange(len(values))
    if good.sum() < 3:
        return np.zeros((0, values.shape[1]))
    closed = np.column_stack([np.interp(rows, rows[good], column[good]) for column in values.T])
    slow: np.ndarray = signals.lowpass(closed, rate_hz, band_hz, 4)[good]
    return slow


def sway(
    pelvis: alignment.PelvisPath | None, positions: dict[str, np.ndarray], rate_hz: float, band_hz: float
) -> Sway | None:
    """Return how far pelvis and interface move in quiet standing; None without a pelvis.

    ``positions`` maps marker names to (n, 3) [m]; what lies above ``band_hz`` is left out as noise.
    """
    if pelvis is None:
        return None
    path = _slow(pelvis.position, rate_hz, band_hz)
    known = np.isfinite(pelvis.rotation).all(axis=(1, 2))
    if not known.any() or not len(path):
        return None
    turn = np.full((len(known), 3), np.nan)
    rotations = Rotation.from_matrix(pelvis.rotation[known])
    turn[known] = (rotations * rotations.mean().inv()).as_rotvec()
    angles = _slow(turn, rate_hz, band_hz)
    sides = [positions[name] for name in geometry.INTERFACE_MARKERS if name in positions]
    interface = [_slow(values, rate_hz, band_hz) for values in sides]
    k = max(1, min(round(_ENDS_S * rate_hz), len(path) // 2))
    return Sway(
        float(np.ptp(path, axis=0).max()),
        max((float(np.ptp(values, axis=0).max()) for values in interface if len(values)), default=0.0),
        float(np.ptp(angles, axis=0).max()),
        float(np.linalg.norm(path[-k:].mean(axis=0) - path[:k].mean(axis=0))),
        float(np.linalg.norm(angles[-k:].mean(axis=0) - angles[:k].mean(axis=0))),
    )
