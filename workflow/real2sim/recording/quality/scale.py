"""Scale of the markers against the robot and the markerless system, which both measure in metres."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation
from scipy.stats import t as student

from real2sim import signals
from real2sim.recording import alignment
from real2sim.recording.quality import clocks

_BAND_HZ = 5.0  # a pelvis moves below; a markerless system's noise fills what lies above
_GRID_HZ = 10.0  # samples that this band leaves independent
_EDGE_S = 0.5  # where the filter has only one side


@dataclass(frozen=True)
class ScaleFit:
    """Length of the markers' motion over that of another system [1], and half of its 95 % interval [1]."""

    value: float
    half: float


def half_interval(sd: float, seconds: int, unknowns: int) -> float:
    """Return half of the 95 % interval of an estimate with standard error ``sd`` from ``seconds`` pieces."""
    return float(sd * student.isf(0.025, max(seconds - unknowns, 1)))


def robot_scale(fit: clocks.ClockFit | None) -> ScaleFit | None:
    """Return the scale against the robot's base and lift, of a fit with ``scaled``; None where there is none."""
    if fit is None or not np.isfinite([fit.scale, fit.scale_sd]).all() or fit.scale <= 0:
        return None
    return ScaleFit(fit.scale, half_interval(fit.scale_sd, fit.seconds, 3))


def markerless_scale(
    ours: alignment.PelvisPath,
    other: alignment.PelvisPath,
    ground: np.ndarray,
    offset_s: float,
    least_s: float,
) -> ScaleFit | None:
    """Return the scale against the markerless pelvis; None where less than ``least_s`` [s] are in common.

    The markerless position is regressed on ours and not the reverse: its noise is ten times as large, and noise in
    the regressor would attenuate the slope. Further regressors are a turn between the grounds, an error of the offset,
    the lever between the two origins and soft tissue (linear in the angles of the pelvis).

    Parameters
    ----------
    ground
        Rotation (3, 3) from the markerless ground to the world.
    offset_s
        What has to be added to the markerless time to get ours [s].
    """
    good = np.isfinite(ours.rotation).all(axis=(1, 2)) & signals.known(ours.position)
    low = max(other.time_s[0] + offset_s, ours.time_s[good][0]) + _EDGE_S
    high = min(other.time_s[-1] + offset_s, ours.time_s[good][-1]) - _EDGE_S
    t = np.arange(low, high, 1 / _GRID_HZ)
    t = t[good[np.clip(np.searchsorted(ours.time_s, t), 0, len(good) - 1)]]
    if len(t) < least_s * _GRID_HZ:
        return None
    p, r, speed = _smooth_at(ours, good, t)
    smooth = signals.lowpass(other.position, _rate(other.time_s), _BAND_HZ, 4)
    theirs = CubicSpline(other.time_s, smooth)(t - offset_s) @ ground.T
    design = _design(p, r, speed)
    cluster = np.repeat(np.floor(t - t[0]).astype(int), 3)
    # as residual of the model 0: the step is the least-squares solution
    step, variance = clocks.solve(design, -theirs.ravel(), cluster)
    slope, sd = float(step[0]), float(np.sqrt(variance[0]))
    if not np.isfinite([slope, sd]).all() or slope <= 0:
        return None
    return ScaleFit(1 / slope, half_interval(sd, len(np.unique(cluster)), 8) / slope**2)


def _rate(time_s: np.ndarray) -> float:
    return float((len(time_s) - 1) / (time_s[-1] - time_s[0]))


def _smooth_at(
    path: alignment.PelvisPath, good: np.ndarray, t: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Position (k, 3) [m], rotation (k, 3, 3) and velocity (k, 3) [m/s] of a pelvis at times (k,) [s]."""
    flat = np.hstack([path.position, path.rotation.reshape(-1, 9)])
    rows = np.arange(len(flat))
    closed = np.column_stack([np.interp(rows, rows[good], column[good]) for column in flat.T])
    spline = CubicSpline(path.time_s, signals.lowpass(closed, _rate(path.time_s), _BAND_HZ, 4))
    values = spline(t)
    rotation = Rotation.from_matrix(values[:, 3:].reshape(-1, 3, 3)).as_matrix()
    return values[:, :3], rotation, spline(t, 1)[:, :3]


def _design(p: np.ndarray, r: np.ndarray, speed: np.ndarray) -> np.ndarray:
    """Regressors (3k, 20): position, velocity, turn of the ground, constant, lever and angles times direction."""
    n, centred = len(p), p - p.mean(axis=0)
    angles = Rotation.from_matrix(r @ Rotation.from_matrix(r).mean().as_matrix().T).as_rotvec()
    out = np.zeros((n, 3, 20))
    out[..., 0], out[..., 1] = centred, speed
    for i in range(3):
        unit = np.eye(3)[i]
        out[..., 2 + i] = np.cross(unit, centred)
        out[:, i, 5 + i] = 1
        out[..., 8 + i] = r @ unit
        out[:, i, 11 + 3 * i : 14 + 3 * i] = angles
    return out.reshape(3 * n, 20)
