"""Clocks of robot log and markerless system against Qualisys: offset and drift with their uncertainty.

Sharper than what lays the tables on each other (`alignment`): every coordinate that two systems share is used,
weighted by its own residual. An offset is what has to be added to the other system's time, at the middle of the
overlap, to get Qualisys time; a drift d means that the other clock runs (1 - d) times as fast.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation
from scipy.stats import norm
from scipy.stats import t as student

from real2sim import signals
from real2sim.geometry import rotation_xyz
from real2sim.recording import alignment
from real2sim.recording.formats.recordings import RobotLog

_BAND_HZ = 5.0  # a pelvis moves below; a markerless system's noise fills what lies above
_GRID_HZ = 10.0  # samples that this band leaves independent
_CLUSTER_S = 1.0  # residuals within are not taken as independent
_ITERATIONS = 12
_CONVERGED_S = 1e-7
_EXPLAINED = 0.5  # residual over motion from which a log is of something else, and no delay is looked for
_UNKNOWN = 0.0, float("inf")  # value and standard error
_DELAY_CONVERGED_S = 1e-5  # a hundredth of what is warned of
NORMAL_95 = 1.959963984540054


@dataclass(frozen=True)
class ClockFit:
    """Offset [s] at ``middle_s``, drift [s/s], their standard errors, SD of the residual [m], coordinates used.

    ``ground`` (3, 3) turns the other system's ground frame into the world; ``ground_sd`` [rad] of its three angles.
    ``seconds`` of motion are what the errors rest on: as many independent pieces. ``scale`` is the length of the
    markers' motion over that of the other system's, with its standard error, infinite where it was not estimated.
    ``by_second`` (k, 2) has each second of the markers' time and the mean square of its residual [m^2].
    ``joint_delay_s`` is how much later than the base the joints are logged, with its standard error, infinite where
    it was not estimated.
    """

    offset_s: float
    offset_sd_s: float
    drift: float
    drift_sd: float
    middle_s: float
    residual_m: float
    ground: np.ndarray
    ground_sd: np.ndarray
    seconds: int
    scale: float = 1.0
    scale_sd: float = float("inf")
    by_second: np.ndarray = field(default_factory=lambda: np.zeros((0, 2)))
    joint_delay_s: float = 0.0
    joint_delay_sd_s: float = float("inf")

    def certainty(self, normal_sd: float) -> float:
        """Standard errors that are as rare as ``normal_sd`` of a normal distribution: Student's t, seconds - 2.

        Few pieces leave the error itself uncertain (Cameron & Miller, J. Human Resources 50 (2015), section VI).
        """
        return float(student.isf(norm.sf(normal_sd), max(self.seconds - 2, 1)))


@dataclass(frozen=True)
class Pooled:
    """One value from several trials: weighted mean, its standard error, and how many trials it rests on."""

    value: float
    sd: float
    trials: int


def pool(values: Iterable[float], errors: Iterable[float]) -> Pooled | None:
    """Inverse-variance mean; the error is widened where trials scatter more than theirs say (Birge 1932)."""
    x, sd = np.array(list(values), float), np.array(list(errors), float)
    good = np.isfinite(x) & np.isfinite(sd) & (sd > 0)
    if not good.any():
        return None
    x, weight = x[good], sd[good] ** -2.0
    mean = float(np.sum(weight * x) / weight.sum())
    excess = np.sum(weight * (x - mean) ** 2) / max(len(x) - 1, 1)
    return Pooled(mean, float(np.sqrt(max(1.0, excess) / weight.sum())), len(x))


def solve(jacobian: np.ndarray, residual: np.ndarray, cluster: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the least-squares step (p,) and its variances (p,), the larger of the white and the clustered estimate.

    For a Jacobian (n, p), residuals (n,) and the index of the cluster (n,) that each belongs to.
    """
    scale = np.maximum(np.linalg.norm(jacobian, axis=0), 1e-30)
    design = jacobian / scale
    inverse = np.linalg.pinv(design.T @ design, rcond=1e-12, hermitian=True)
    step = -inverse @ (design.T @ residual)
    left = residual + design @ step
    white = np.diag(inverse) * np.sum(left**2) / max(len(left) - design.shape[1], 1)
    sums = signals.sums_of_runs(design * left[:, None], cluster)
    count = max(len(sums), 2)
    clustered = np.diag(inverse @ (sums.T @ sums) @ inverse) * count / (count - 1)
    return step / scale, np.maximum(white, clustered) / scale**2


# -------------------- robot


@dataclass
class _Arm:
    """The robot's measured joints as functions of its own time: base x, y, yaw, lift, roll, pitch."""

    spline: CubicSpline
    start_s: float
    end_s: float

    @classmethod
    def of(cls, log: RobotLog) -> _Arm:
        """Joints on the times of /joint_states that /odom covers."""
        base_time, base = _increasing(
            log.base_time_s, np.column_stack([log.base[c] for c in ("x", "y", "yaw")])
        )
        joint_time, joints = _increasing(
            log.joint_time_s,
            np.column_stack([log.joints[j][:, 0] for j in ("arm_lift", "arm_roll", "arm_pitch")]),
        )
        inside = (joint_time >= base_time[0]) & (joint_time <= base_time[-1])
        time_s = joint_time[inside]
        base[:, 2] = np.unwrap(base[:, 2])
        values = np.hstack([CubicSpline(base_time, base)(time_s), joints[inside]])
        return cls(CubicSpline(time_s, values), float(time_s[0]), float(time_s[-1]))

    def at(
        self, time_s: np.ndarray, joints_s: np.ndarray | None = None
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Position of the arm's turning point over the floor, base and arm orientation; (n, 3), (n, 3, 3).

        ``joints_s`` (n,) are the times of lift, roll and pitch where these differ from those of the base.
        """
        x, y, yaw, lift, roll, pitch = self.spline(time_s).T
        if joints_s is not None and joints_s is not time_s:
            lift, roll, pitch = self.spline(joints_s).T[3:]
        zero = np.zeros(len(yaw))
        base = rotation_xyz(np.column_stack([zero, zero, yaw]))
        arm = base @ rotation_xyz(np.column_stack([roll, pitch, zero]))
        return np.column_stack([x, y, lift]), base, arm, yaw


def _increasing(time_s: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    keep = np.concatenate([[True], np.diff(np.maximum.accumulate(time_s)) > 0])
    return time_s[keep], values[keep].astype(float)


@dataclass
class _Geometry:
    """Constants between robot and markers: marker = ground (path + base · mount + arm · place) + shift.

    ``scale`` stretches the path about ``centre`` (3,) [m]; all lengths in metres.
    """

    ground: np.ndarray
    centre: np.ndarray
    shift: np.ndarray = field(default_factory=lambda: np.zeros(3))
    mount: np.ndarray = field(default_factory=lambda: np.zeros(3))
    place: np.ndarray = field(default_factory=lambda: np.zeros((2, 3)))
    scale: float = 1.0

    def move(self, step: np.ndarray) -> None:
        """Add a Gauss-Newton step (18,) of which the first two are time."""
        self.ground = Rotation.from_rotvec(step[2:5]).as_matrix() @ self.ground
        self.shift, self.mount = self.shift + step[5:8], self.mount + step[8:11]
        self.place = self.place + step[11:17].reshape(2, 3)
        self.scale += float(step[17])


def robot_clock(
    time_s: np.ndarray,
    left: np.ndarray,
    right: np.ndarray,
    log: RobotLog,
    *,
    offset_s: float,
    scaled: bool = False,
) -> ClockFit | None:
    """Clock and floor of the robot by the two interface markers (n, 3) [m], raw, NaN where missing.

    The markers are rigid to the end of the chain base x, y, yaw, lift, roll, pitch:
    marker = ground (path + base · mount + arm · place) + shift, all four unknown constants, so no geometry of the
    robot is assumed. With ``scaled`` the path's length is a further unknown: only base and lift carry metres, as the
    places on the robot are free. None where less than a second is in common.
    """
    arm = _Arm.of(log)
    points = np.stack([left, right], axis=1)
    drift, sd = 0.0, np.full(18, np.inf)
    inside = (time_s - offset_s >= arm.start_s + 0.3) & (time_s - offset_s <= arm.end_s - 0.3)
    good = inside & np.isfinite(points).all(axis=(1, 2))
    if good.sum() < 100:
        return None
    t, points = time_s[good], points[good]
    middle, cluster = float(t.mean()), np.floor((t - t[0]) / _CLUSTER_S).astype(int)
    geometry = _Geometry(_first_ground(arm, t - offset_s, points), arm.at(t - offset_s)[0].mean(axis=0))
    residual = np.zeros(0)
    for iteration in range(2 * _ITERATIONS if scaled else _ITERATIONS):
        own = np.clip(t - offset_s - drift * (t - middle), arm.start_s, arm.end_s)
        residual, jacobian = _robot_system(arm, own, t - middle, points, geometry)
        settled = not scaled or iteration > _ITERATIONS // 2  # while walking, a drift looks like a scale
        columns = _free_unknowns(iteration, scaled, settled)
        step = np.zeros(18)
        step[columns], variance = solve(jacobian[:, columns], residual, np.repeat(cluster, 6))
        offset_s += float(np.clip(step[0], -0.1, 0.1))
        drift += float(step[1])
        geometry.move(step)
        if iteration > 1:
            sd[columns] = np.sqrt(variance)
            if settled and abs(step[0]) < _CONVERGED_S and abs(step[1]) < 1e-8:
                break
    rms = float(np.sqrt(np.mean(residual**2)))
    explained = rms < _EXPLAINED * points.std(axis=0).max()
    joints = _joint_delay(arm, own, t - middle, points, geometry) if explained and not scaled else _UNKNOWN
    return ClockFit(
        offset_s,
        float(sd[0]),
        drift,
        float(sd[1]),
        middle,
        rms,
        geometry.ground,
        sd[2:5],
        len(np.unique(cluster)),
        geometry.scale,
        float(sd[17]),
        mean_squares(t, residual.reshape(-1, 6)),
        *joints,
    )


def _free_unknowns(iteration: int, scaled: bool, settled: bool) -> np.ndarray:
    """Return which of the unknowns of `robot_clock` move in an iteration: without drift until it has settled."""
    # the first rounds settle the geometry, or a wrong mount would look like time
    columns = np.arange(0 if iteration > 1 else 2, 18 if scaled and iteration > 1 else 17)
    return columns if settled else columns[columns != 1]


def _joint_delay(
    arm: _Arm, own: np.ndarray, centred: np.ndarray, points: np.ndarray, geometry: _Geometry
) -> tuple[float, float]:
    """Return how much later than the base the joints are logged [s], and its standard error.

    Goes on from a fit in which both have one clock; clock and geometry are unknown here too.
    """
    geometry, delay, sd = replace(geometry), 0.0, float("inf")
    cluster = np.repeat(np.floor((centred - centred[0]) / _CLUSTER_S).astype(int), 6)
    for _ in range(_ITERATIONS // 2):
        late = np.clip(own + delay, arm.start_s, arm.end_s)
        residual, jacobian = _robot_system(arm, own, centred, points, geometry, late)
        slope = _chain(arm, geometry, own, late + 1e-4)[0] - _chain(arm, geometry, own, late - 1e-4)[0]
        column = (slope @ geometry.ground.T / 2e-4).reshape(-1, 1)
        if not np.linalg.norm(column) > 0:
            return _UNKNOWN
        step, variance = solve(np.hstack([jacobian[:, :17], column]), residual, cluster)
        own = np.clip(own - step[0] - step[1] * centred, arm.start_s, arm.end_s)
        geometry.move(np.append(step[:17], 0.0))
        delay, sd = float(delay + np.clip(step[17], -0.1, 0.1)), float(np.sqrt(variance[17]))
        if abs(step[17]) < _DELAY_CONVERGED_S:
            break
    return delay, sd


def mean_squares(time_s: np.ndarray, residual: np.ndarray) -> np.ndarray:
    """Return each second of ``time_s`` (n,) and the mean square of ``residual`` (n, k) in it, shape (seconds, 2)."""
    second, index = np.unique(np.floor(time_s), return_inverse=True)
    total = np.bincount(index, weights=np.mean(residual**2, axis=1))
    return np.column_stack([second, total / np.bincount(index)])


def _first_ground(arm: _Arm, own: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Turn about the vertical from the odometry's heading to that of the markers."""
    across = points[:, 0] - points[:, 1]
    difference = np.arctan2(-across[:, 0], across[:, 1]) - arm.at(own)[3]
    heading = float(np.angle(np.exp(1j * difference).mean()))
    ground: np.ndarray = Rotation.from_euler("z", heading).as_matrix()
    return ground


def _robot_system(
    arm: _Arm,
    own: np.ndarray,
    centred: np.ndarray,
    points: np.ndarray,
    geometry: _Geometry,
    joints_s: np.ndarray | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """Residuals (6n,) and Jacobian (6n, 18) by offset, drift, ground, shift, mount, the two places and scale.

    ``joints_s`` (n,) are the times of the joints where these differ from those of the base, ``own`` (n,).
    """
    ground, shift = geometry.ground, geometry.shift
    late = own if joints_s is None else joints_s
    local, base, turned = _chain(arm, geometry, own, late)
    after, before = (
        _chain(arm, geometry, own + 1e-4, late + 1e-4),
        _chain(arm, geometry, own - 1e-4, late - 1e-4),
    )
    slope = (after[0] - before[0]) / 2e-4
    moved = local @ ground.T
    n = len(own)
    jacobian = np.zeros((n, 2, 3, 18))
    jacobian[..., 0] = -slope @ ground.T
    jacobian[..., 1] = jacobian[..., 0] * centred[:, None, None]
    jacobian[..., 2:5] = -_cross(moved)
    jacobian[..., 5:8] = np.eye(3)
    jacobian[..., 8:11] = (ground @ base)[:, None]
    for k in range(2):
        jacobian[:, k, :, 11 + 3 * k : 14 + 3 * k] = ground @ turned
    jacobian[..., 17] = ((arm.at(own)[0] - geometry.centre) @ ground.T)[:, None]
    return (moved + shift - points).ravel(), jacobian.reshape(6 * n, 18)


def _chain(
    arm: _Arm, geometry: _Geometry, time_s: np.ndarray, joints_s: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return both markers (n, 2, 3) [m] in the robot's ground, and the orientations (n, 3, 3) of base and arm."""
    path, base, turned, _ = arm.at(time_s, joints_s)
    reached = path + (geometry.scale - 1) * (path - geometry.centre) + base @ geometry.mount
    return reached[:, None] + np.einsum("nij,kj->nki", turned, geometry.place), base, turned


def _cross(v: np.ndarray) -> np.ndarray:
    out = np.zeros((*v.shape[:-1], 3, 3))
    out[..., 0, 1], out[..., 0, 2], out[..., 1, 2] = -v[..., 2], v[..., 1], -v[..., 0]
    return out - np.swapaxes(out, -1, -2)


# -------------------- markerless


def markerless_clock(
    ours: alignment.PelvisPath,
    other: alignment.PelvisPath,
    space: alignment.SpaceFit,
    *,
    offset_s: float,
    band_hz: float = _BAND_HZ,
) -> ClockFit | None:
    """Clock of the markerless system by all six pelvis coordinates, by generalised least squares.

    ``space`` and ``offset_s`` come from `alignment.align_pelvis`. What is left between the two systems is explained
    by the time shift, by a constant and by a linear function of the angles (soft tissue, model geometry); each
    coordinate is weighted by its residual, and the residual is whitened by an autoregression of order one.
    None where less than two seconds are in common.
    """
    rate = 1 / np.median(np.diff(other.time_s))
    low = max(other.time_s[0], ours.time_s[0] - offset_s)
    high = min(other.time_s[-1], ours.time_s[-1] - offset_s)
    if high - low < 2:
        return None
    own = np.arange(low, high, 1 / rate)
    good = np.isfinite(ours.rotation).all(axis=(1, 2)) & signals.known(ours.position)
    if good.sum() < 100:
        return None
    splined = _OtherPelvis(
        CubicSpline(other.time_s, other.position),
        CubicSpline(other.time_s, other.rotation.reshape(-1, 9)),
        space,
    )
    step = max(1, round(rate / _GRID_HZ))
    fit, state, drift = None, offset_s, 0.0
    middle = float(own.mean())
    for _ in range(3):
        system = _markerless_system(ours, good, splined, own, (state, drift), middle, band_hz)
        if system is None:
            return fit
        fit = _generalised(system, step, middle, space.rotation)
        if fit is None:
            return None
        # ours(t) - ours(t + correction) is what the error holds
        state, drift = state - fit.offset_s, drift - fit.drift
        if abs(fit.offset_s) < 1e-6:
            break
    assert fit is not None
    return ClockFit(
        state,
        fit.offset_sd_s,
        drift,
        fit.drift_sd,
        middle + state,
        fit.residual_m,
        space.rotation,
        fit.ground_sd,
        fit.seconds,
    )


@dataclass
class _OtherPelvis:
    """The markerless pelvis as splines over its own time, and how it is laid on ours."""

    position: CubicSpline
    rotation: CubicSpline
    space: alignment.SpaceFit

    def at(self, time_s: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Position (n, 3) [m] and rotation (n, 3, 3) in our world at times (n,) [s] of the other clock."""
        p, r = self.position(time_s), _orthonormal(self.rotation(time_s))
        p = (p + r @ self.space.lever) @ self.space.rotation.T + self.space.translation
        return p, self.space.rotation @ r @ self.space.body


@dataclass
class _System:
    time_s: np.ndarray  # (n,) on the other clock
    error: np.ndarray  # (n, 6) ours minus other, positions [m] and rotation vectors [rad]
    speed: np.ndarray  # (n, 6) of our pose
    pose: np.ndarray  # (n, 6) ours about its mean
    covered: np.ndarray  # (n,)


def _markerless_system(
    ours: alignment.PelvisPath,
    good: np.ndarray,
    other: _OtherPelvis,
    own: np.ndarray,
    correction: tuple[float, float],
    middle: float,
    band_hz: float,
) -> _System | None:
    # the two pelvises at times ``own`` of the other clock, by its offset [s] and drift [s/s] so far
    offset, drift = correction
    rate = 1 / (own[1] - own[0])
    t = own + offset + drift * (own - middle)
    inside = (t >= ours.time_s[good][0]) & (t <= ours.time_s[good][-1])
    if inside.sum() < 2 * rate:
        return None
    own, t = own[inside], t[inside]
    # missing stretches are bridged for the filter and left out of the fit
    p_ours = CubicSpline(ours.time_s[good], ours.position[good])
    r_ours = CubicSpline(ours.time_s[good], ours.rotation[good].reshape(-1, 9))
    nearest = np.clip(np.searchsorted(ours.time_s, t), 0, len(good) - 1)
    covered = good[nearest] & good[np.maximum(nearest - 1, 0)]
    p_o, r_o = other.at(own)
    r_q = _orthonormal(r_ours(t))
    turn = Rotation.from_matrix(r_q @ np.swapaxes(r_o, 1, 2)).as_rotvec()
    mean = Rotation.from_matrix(r_q).mean().as_matrix()
    pose = np.hstack([p_ours(t), Rotation.from_matrix(r_q @ mean.T).as_rotvec()])
    speed = np.hstack([p_ours(t, 1), _angular_velocity(r_q, r_ours(t, 1).reshape(-1, 3, 3))])
    smooth = [signals.lowpass(x, rate, band_hz, 4) for x in (np.hstack([p_ours(t) - p_o, turn]), speed, pose)]
    return _System(own, smooth[0], smooth[1], smooth[2] - smooth[2].mean(axis=0), covered)


def _orthonormal(flat: np.ndarray) -> np.ndarray:
    rotation: np.ndarray = Rotation.from_matrix(flat.reshape(-1, 3, 3)).as_matrix()
    return rotation


def _angular_velocity(r: np.ndarray, slope: np.ndarray) -> np.ndarray:
    w = slope @ np.swapaxes(r, 1, 2)
    return np.column_stack([w[:, 2, 1] - w[:, 1, 2], w[:, 0, 2] - w[:, 2, 0], w[:, 1, 0] - w[:, 0, 1]]) / 2


def _generalised(system: _System, step: int, middle: float, ground: np.ndarray) -> ClockFit | None:
    """Offset and drift that are still in the error: ours(t) - other(t - offset) = speed * correction + ..."""
    edge = 5 * step // 2  # half a second, where the filter has only one side
    rows = np.arange(edge, len(system.time_s) - edge, step)
    if len(rows) < 20:
        return None
    t, covered = system.time_s[rows], system.covered[rows]
    # skin moves with the angles of the pelvis
    features = np.column_stack([np.ones(len(rows)), system.pose[rows, 3:]])
    y, s = system.error[rows], system.speed[rows]
    k = features.shape[1]
    weight, rho = np.ones(6), np.zeros(6)
    beta: np.ndarray = np.zeros(2)
    inverse: np.ndarray = np.eye(2)
    use = covered[1:] & covered[:-1]
    for _ in range(4):
        normal, right, parts = np.zeros((2, 2)), np.zeros(2), []
        for c in range(6):
            x = np.column_stack([s[:, c], s[:, c] * (t - middle), features])
            white_x, white_y = (x[1:] - rho[c] * x[:-1])[use], (y[1:, c] - rho[c] * y[:-1, c])[use]
            q, _ = np.linalg.qr(white_x[:, 2:])
            a, b = white_x[:, :2] - q @ (q.T @ white_x[:, :2]), white_y - q @ (q.T @ white_y)
            normal += weight[c] * a.T @ a
            right += weight[c] * a.T @ b
            parts.append((a, b))
        inverse = np.linalg.pinv(normal, rcond=1e-14, hermitian=True)
        beta = inverse @ right
        for c, (a, b) in enumerate(parts):
            weight[c] = max(use.sum() - k, 1) / max(float(np.sum((b - a @ beta) ** 2)), 1e-16)
            x = np.column_stack([s[:, c], s[:, c] * (t - middle), features])
            free = y[:, c] - x[:, :2] @ beta
            free = free - features @ np.linalg.lstsq(features[covered], free[covered], rcond=None)[0]
            lagged = float(np.sum(free[1:][use] * free[:-1][use]) / max(np.sum(free[:-1][use] ** 2), 1e-30))
            rho[c] = np.clip(lagged, -0.2, 0.95)
    sd = np.sqrt(np.maximum(np.diag(inverse), _clustered(parts, weight, beta, inverse, t[1:][use])))
    rms = float(np.sqrt(np.sum(1 / weight[:3]) / 3))
    unknown = np.full(3, np.inf)
    offset_sd, drift_sd = float(sd[0]), float(sd[1])
    seconds = len(np.unique(np.floor(t[1:][use] / _CLUSTER_S)))
    return ClockFit(
        float(beta[0]), offset_sd, float(beta[1]), drift_sd, middle, rms, ground, unknown, seconds
    )


def _clustered(
    parts: list[tuple[np.ndarray, np.ndarray]],
    weight: np.ndarray,
    beta: np.ndarray,
    inverse: np.ndarray,
    time_s: np.ndarray,
) -> np.ndarray:
    """Variances (2,) clustered by the second: what the estimated weights and autoregression may have missed."""
    scores = sum(w * a * (b - a @ beta)[:, None] for w, (a, b) in zip(weight, parts, strict=True))
    cluster = np.floor((time_s - time_s[0]) / _CLUSTER_S).astype(int)
    sums = signals.sums_of_runs(scores, cluster)
    count = max(len(sums), 2)
    return np.diag(inverse @ (sums.T @ sums) @ inverse) * count / (count - 1)
