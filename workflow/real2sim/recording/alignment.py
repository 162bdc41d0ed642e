"""Clocks and frames of three systems laid on each other: Qualisys, markerless, robot.

A time offset is what has to be added to the other system's time to get Qualisys time.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation

from real2sim.geometry import nearest_rotation
from real2sim.signals import correlation_at_lags, derivative, known, lowpass, sums_of_runs

# OpenSim ground (X forward, Y up, Z right) to world (x forward, y left, z up).
OPENSIM_TO_WORLD = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])

_LEVER_M = 0.1  # weighs rotations against positions: half the width of a pelvis
# How far the two systems' pelvis frames may plausibly be turned and shifted against each other.
_FRAME_PRIOR_RAD, _FRAME_PRIOR_M = 0.3, 0.05
_MIN_OVERLAP = 0.5  # of the shorter record
_LEAST_VARIANCE = 1e-6  # of an overlap, over the whole record's: below it nothing moves there
_AT_REST = 1e-6  # SD of a speed [m/s, rad/s] that is rounding and no movement
# Both systems are smoothed alike before they are laid on each other: a pelvis moves below 5 Hz, a markerless
# system's noise does not.
_CUTOFF_HZ, _ORDER = 5.0, 4


def _rate(time_s: np.ndarray) -> float:
    return float((len(time_s) - 1) / (time_s[-1] - time_s[0]))


def _smooth(time_s: np.ndarray, values: np.ndarray) -> np.ndarray:
    flat = lowpass(values.reshape(len(values), -1), _rate(time_s), _CUTOFF_HZ, _ORDER)
    return flat.reshape(values.shape)


@dataclass(frozen=True)
class PelvisPath:
    """A measured pelvis on its system's clock: times (n,) [s], rotations (n, 3, 3), positions (n, 3) [m]."""

    time_s: np.ndarray
    rotation: np.ndarray
    position: np.ndarray


@dataclass(frozen=True)
class TimeFit:
    """Offset [s] at the middle of the overlap, drift [s/s], standard errors, correlation at the peak."""

    offset_s: float
    drift: float
    offset_sd_s: float
    drift_sd: float
    correlation: float
    middle_s: float

    def other_time(self, time_s: np.ndarray) -> np.ndarray:
        """Return times (n,) [s] on the other system's clock at Qualisys times (n,) [s]."""
        return time_s - self.offset_s - self.drift * (time_s - self.middle_s)


@dataclass(frozen=True)
class SpaceFit:
    """World = rotation @ other + translation, for the point ``lever`` of the other's pelvis frame [m].

    ``body`` turns the other's pelvis frame into ours.
    """

    rotation: np.ndarray
    translation: np.ndarray
    body: np.ndarray
    lever: np.ndarray
    rms_m: float
    rms_rad: float


def pelvis_of_coordinates(columns: dict[str, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Pelvis orientation (n, 3, 3) and position (n, 3) of Rajagopal coordinates, in z-up axes of its ground.

    Body-fixed Z (tilt), X (list), Y (rotation); the columns of the orientation are forward, left and up.
    """
    angles = np.column_stack([columns[f"pelvis_{name}"] for name in ("tilt", "list", "rotation")])
    orientation = Rotation.from_euler("ZXY", angles).as_matrix()
    position = np.column_stack([columns[f"pelvis_t{axis}"] for axis in "xyz"])
    return OPENSIM_TO_WORLD @ orientation @ OPENSIM_TO_WORLD.T, position @ OPENSIM_TO_WORLD.T


def angular_speed(rotation: np.ndarray, rate_hz: float) -> np.ndarray:
    """Angular speed [rad/s] (n,) of rotations (n, 3, 3)."""
    slope = derivative(rotation.reshape(len(rotation), 9), rate_hz)
    speed: np.ndarray = np.sqrt(np.sum(slope**2, axis=1) / 2)
    return speed


def correlate(ours: np.ndarray, other: np.ndarray) -> tuple[int, float]:
    """Lag [samples] of ``other`` (m, k) in ``ours`` (n, k) and the correlation there, all channels together.

    Row i of ``other`` belongs to row i + lag of ``ours``. At each lag the mean over channels of Pearson's
    correlation over the overlap is taken; lags with less than half the shorter record in common are left out.
    """
    n, m = len(ours), len(other)
    total, used = np.zeros(n + m - 1), 0
    lags = np.arange(n + m - 1) - (m - 1)
    for x, y in zip(ours.T, other.T, strict=True):
        if min(np.nanstd(x), np.nanstd(y)) < _AT_REST:
            continue
        x, y = np.nan_to_num(x - np.nanmean(x)), np.nan_to_num(y - np.nanmean(y))
        total += correlation_at_lags(x, y, _LEAST_VARIANCE)[1]
        used += 1
    count = np.minimum(n, m + lags) - np.maximum(0, lags)
    total[count < _MIN_OVERLAP * min(n, m)] = -np.inf
    best = int(np.argmax(total))
    return int(lags[best]), float(total[best] / max(used, 1))


def align_signals(
    time_s: np.ndarray, ours: np.ndarray, other_time_s: np.ndarray, other: np.ndarray
) -> TimeFit:
    """Time offset between two sets of channels (n, k), (m, k) that measure the same up to a gain each.

    Coarse by cross-correlation, fine by least squares on offset and gains. ``time_s`` is uniform.
    """
    rate = _rate(time_s)
    grid = np.arange(other_time_s[0], other_time_s[-1], 1 / rate)
    ours, spline = _smooth(time_s, ours), CubicSpline(other_time_s, _smooth(other_time_s, other))
    lag, correlation = correlate(ours, spline(grid))
    offset = time_s[0] + lag / rate - grid[0]
    sd = np.inf
    for _ in range(10):
        t = time_s - offset
        good = known(ours) & (t >= other_time_s[0]) & (t <= other_time_s[-1])
        y, slope = spline(t[good]), -spline(t[good], 1)
        x = ours[good] - ours[good].mean(axis=0)
        y, scale = y - y.mean(axis=0), np.std(ours[good], axis=0)
        gain = np.sum(x * y, axis=0) / np.maximum(np.sum(y * y, axis=0), 1e-30)
        residual, jacobian = (x - gain * y) / scale, gain * slope / scale
        information = np.sum(jacobian**2)
        step = float(np.sum(jacobian * residual) / information)
        offset += np.clip(step, -1 / rate, 1 / rate)
        sd = float(np.sqrt(np.mean(residual**2) / information / min(1.0, 2 * _CUTOFF_HZ / rate)))
        if abs(step) < 1e-7:
            break
    return TimeFit(float(offset), 0.0, sd, np.inf, correlation, float(time_s.mean()))


@dataclass
class _Pose:
    """A pelvis pose with its rates as functions of time, by splines."""

    position: CubicSpline
    axes: CubicSpline

    def at(self, t: np.ndarray, order: int = 0) -> tuple[np.ndarray, np.ndarray]:
        return self.position(t, order), self.axes(t, order).reshape(-1, 3, 3)


def _cross_matrix(v: np.ndarray) -> np.ndarray:
    out = np.zeros((*v.shape[:-1], 3, 3))
    out[..., 0, 1], out[..., 0, 2], out[..., 1, 2] = -v[..., 2], v[..., 1], -v[..., 0]
    return out - np.swapaxes(out, -1, -2)


def coarse_offset(ours: PelvisPath, other: PelvisPath) -> tuple[float, float]:
    """Offset [s] and correlation by the pelvis' linear and angular speed, the same in all frames."""
    rate = _rate(ours.time_s)
    grid = np.arange(other.time_s[0], other.time_s[-1], 1 / rate)

    def speeds(r: np.ndarray, p: np.ndarray) -> np.ndarray:
        r, p = _smooth(np.arange(len(r)) / rate, r), _smooth(np.arange(len(p)) / rate, p)
        linear = np.linalg.norm(derivative(p, rate), axis=1)
        return np.column_stack([linear, angular_speed(r, rate)])

    resampled = CubicSpline(other.time_s, other.rotation.reshape(-1, 9))(grid).reshape(-1, 3, 3)
    their_speeds = speeds(resampled, CubicSpline(other.time_s, other.position)(grid))
    lag, correlation = correlate(speeds(ours.rotation, ours.position), their_speeds)
    return float(ours.time_s[0] + lag / rate - grid[0]), correlation


def align_pelvis(
    ours: PelvisPath,
    other: PelvisPath,
    *,
    offset_s: float,
    correlation: float,
    with_time: bool = True,
    with_drift: bool = True,
) -> tuple[TimeFit, SpaceFit]:
    """Fit time and space between two measurements of one pelvis, in one least-squares problem.

    Unknown are offset, drift, rotation and translation between the grounds, and those between the pelvis
    frames, which are constant: walking at even speed, an offset looks like a translation, so they cannot
    be had one after the other. Gauss-Newton from a coarse offset, on positions and on the axes of the pelvis
    times 0.1 m. ``with_time=False`` keeps the offset (nothing moves). Standard errors are robust to residuals
    that hang together over a second, as those of soft tissue and of smoothed video do.
    """
    time_s, other_time_s = ours.time_s, other.time_s
    rotation, position = _smooth(time_s, ours.rotation), _smooth(time_s, ours.position)
    axes = _smooth(other_time_s, other.rotation).reshape(-1, 9)
    pose = _Pose(
        CubicSpline(other_time_s, _smooth(other_time_s, other.position)), CubicSpline(other_time_s, axes)
    )
    inside = (time_s - offset_s >= other_time_s[0]) & (time_s - offset_s <= other_time_s[-1])
    good = inside & known(position) & np.isfinite(rotation).all(axis=(1, 2))
    t, r_ours, p_ours = time_s[good], rotation[good], position[good]
    middle = float(t.mean())
    drift, body, lever = 0.0, np.eye(3), np.zeros(3)
    p, r = pose.at(t - offset_s)
    ground = nearest_rotation(np.einsum("nij,nkj->ik", r_ours, r))
    shift = (p_ours - p @ ground.T).mean(axis=0)
    columns = [*([0] if with_time else []), *([1] if with_time and with_drift else []), *range(2, 14)]
    for _ in range(20):
        t_other = np.clip(t - offset_s - drift * (t - middle), other_time_s[0], other_time_s[-1])
        residual, jacobian = _pelvis_system(
            pose, t_other, t - middle, r_ours, p_ours, ground, shift, body, lever
        )
        step, inverse, weight = _pelvis_step(residual, jacobian, columns, body, lever)
        offset_s, drift = offset_s + float(np.clip(step[0], -0.1, 0.1)), drift + float(step[1])
        ground = Rotation.from_rotvec(step[2:5]).as_matrix() @ ground
        shift = shift + step[5:8]
        body = body @ Rotation.from_rotvec(step[8:11]).as_matrix()
        lever = lever + step[11:14]
        if abs(step[0]) < 1e-7 and np.abs(step[1:]).max() < 1e-7:
            break
    variance = np.full(14, np.inf)
    variance[columns] = _variances(inverse, residual, jacobian[:, columns] / weight, t)
    t_other = np.clip(t - offset_s - drift * (t - middle), other_time_s[0], other_time_s[-1])
    p, r = pose.at(t_other)
    error = (p + r @ lever) @ ground.T + shift - p_ours
    rms_m = float(np.sqrt(np.mean(np.sum(error**2, axis=1))))
    rms_rad = float(np.sqrt(np.mean(np.sum((ground @ r @ body - r_ours) ** 2, axis=(1, 2)) / 2)))
    sd = np.sqrt(np.maximum(variance, 0))
    time_fit = TimeFit(float(offset_s), float(drift), float(sd[0]), float(sd[1]), correlation, middle)
    return time_fit, SpaceFit(ground, shift, body, lever, rms_m, rms_rad)


def _pelvis_step(
    residual: np.ndarray,
    jacobian: np.ndarray,
    columns: list[int],
    body: np.ndarray,
    lever: np.ndarray,
) -> tuple[np.ndarray, np.ndarray, float]:
    """Gauss-Newton step (14,), 0 where an unknown is not among ``columns``, their covariance, the mean square left."""
    weight = max(float(residual @ residual) / len(residual), 1e-12)
    normal = jacobian.T @ jacobian / weight
    gradient = jacobian.T @ residual / weight
    # Standing still, ground and body frame cannot be told apart: a weak prior keeps the body's small.
    prior = np.repeat([_FRAME_PRIOR_RAD, _FRAME_PRIOR_M], 3) ** -2
    normal[range(8, 14), range(8, 14)] += prior
    gradient[8:] += prior * np.concatenate([Rotation.from_matrix(body).as_rotvec(), lever])
    inverse = np.linalg.pinv(normal[np.ix_(columns, columns)], rcond=1e-13, hermitian=True)
    step = np.zeros(14)
    step[columns] = -inverse @ gradient[columns]
    return step, inverse, weight


def _pelvis_system(
    pose: _Pose,
    t_other: np.ndarray,
    t_centred: np.ndarray,
    r_ours: np.ndarray,
    p_ours: np.ndarray,
    ground: np.ndarray,
    shift: np.ndarray,
    body: np.ndarray,
    lever: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """Residuals and their Jacobian by offset, drift, ground rotation, translation, body rotation, lever."""
    (p, r), (dp, dr) = pose.at(t_other), pose.at(t_other, 1)
    p, dp = p + r @ lever, dp + dr @ lever
    n = len(p)
    moved, axes = p @ ground.T, ground @ r @ body
    jacobian = np.zeros((n, 4, 3, 14))
    residual = np.empty((n, 4, 3))
    residual[:, 0] = moved + shift - p_ours
    residual[:, 1:] = _LEVER_M * np.swapaxes(axes - r_ours, 1, 2)
    jacobian[:, 0, :, 0] = -dp @ ground.T
    jacobian[:, 1:, :, 0] = -_LEVER_M * np.swapaxes(ground @ dr @ body, 1, 2)
    jacobian[..., 1] = jacobian[..., 0] * t_centred[:, None, None]
    jacobian[:, 0, :, 2:5] = -_cross_matrix(moved)
    jacobian[:, 1:, :, 2:5] = -_LEVER_M * _cross_matrix(np.swapaxes(axes, 1, 2))
    jacobian[:, 0, :, 5:8] = np.eye(3)
    jacobian[:, 1:, :, 8:11] = -_LEVER_M * axes[:, None] @ _cross_matrix(np.eye(3))
    jacobian[:, 0, :, 11:14] = ground @ r
    return residual.ravel(), jacobian.reshape(-1, 14)


def _variances(inverse: np.ndarray, residual: np.ndarray, jacobian: np.ndarray, t: np.ndarray) -> np.ndarray:
    """Variances of the estimates, the larger of two: few seconds make the clustered one uncertain itself.

    One takes the residual as white within the band the smoothing leaves, one is clustered by second (sandwich
    of Liang & Zeger 1986, with the correction for few clusters).
    """
    block = np.floor(t - t[0]).astype(int)
    scores = (jacobian * residual[:, None]).reshape(len(t), -1, jacobian.shape[1]).sum(axis=1)
    sums = sums_of_runs(scores, block)
    count = max(len(sums), 2)
    clustered = np.diag(inverse @ (sums.T @ sums) @ inverse) * count / (count - 1)
    white = np.diag(inverse) / min(1.0, 2 * _CUTOFF_HZ / _rate(t))
    return np.maximum(clustered, white)


def rebuild_point(points: np.ndarray, model: np.ndarray, missing: int) -> tuple[np.ndarray, np.ndarray]:
    """Rotation (n, 3, 3) of a rigid body of four by three of its points, and the other point (n, 3).

    ``points`` (n, 4, 3) are measured, ``model`` (4, 3) are their places in the body.
    """
    rest = [i for i in range(points.shape[1]) if i != missing]
    measured, reference = points[:, rest], model[rest]
    centre, origin = measured.mean(axis=1), reference.mean(axis=0)
    u, _, vt = np.linalg.svd(np.swapaxes(measured - centre[:, None], 1, 2) @ (reference - origin))
    sign = np.linalg.det(u @ vt)
    u[:, :, 2] *= sign[:, None]
    rotation: np.ndarray = u @ vt
    return rotation, centre + rotation @ (model[missing] - origin)
