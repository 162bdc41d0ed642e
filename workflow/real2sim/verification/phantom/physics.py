"""The phantom's own physics: the robot tree stepped by MuJoCo, the strap as a wrench law outside it.

Nothing here is shared with the identification plant, so that the two can be checked against each other. The
pelvis is prescribed and feels no reaction. Everything is vectorised over trials, because one step of one
small robot is cheaper than the Python around it.

Time stepping. MuJoCo's semi-implicit Euler keeps positions at whole steps and velocities half a step
behind, a leapfrog of second order as long as forces are taken at the whole step. Velocities are therefore
extrapolated by half a step before the damping forces are evaluated; otherwise damping would cost the second
order.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Protocol, TypeVar

import mujoco
import numpy as np

from real2sim.system.batches import untimed_batch

AXES = ("tx", "ty", "tz", "rx", "ry", "rz")
BASE_JOINTS = ("base_x", "base_y", "base_yaw")
ARM_JOINTS = ("arm_lift", "arm_roll", "arm_pitch")

# Rotation (n, 3, 3), position (n, 3) [m], velocity (n, 3) [m/s] and angular velocity (n, 3) [rad/s]
Poses = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]


@dataclass(frozen=True)
class StrapLaw:
    """Generalised force law of the strap, one row per trial.

    ``stiffness``, ``damping`` (n, 6) [N/m, Nm/rad; Ns/m, Nms/rad]; slack range ``lower``, ``upper`` (n, 6)
    [m, rad]; ``stop_stiffness`` (6,) [N/m, Nm/rad] and ``stop_damping`` (6,) [s/m, s/rad] beyond it;
    rest pose of the interface in the pelvis ``rest_rotation`` (n, 3, 3), ``rest_position`` (n, 3) [m],
    which creeps at ``migration`` (n, 3) [m/s].
    """

    stiffness: np.ndarray
    damping: np.ndarray
    lower: np.ndarray
    upper: np.ndarray
    stop_stiffness: np.ndarray
    stop_damping: np.ndarray
    rest_rotation: np.ndarray
    rest_position: np.ndarray
    migration: np.ndarray

    def take(self, trials: np.ndarray) -> StrapLaw:
        """Return the law of some trials, indices (k,)."""
        return StrapLaw(
            self.stiffness[trials],
            self.damping[trials],
            self.lower[trials],
            self.upper[trials],
            self.stop_stiffness,
            self.stop_damping,
            self.rest_rotation[trials],
            self.rest_position[trials],
            self.migration[trials],
        )

    def generalised_force(self, q: np.ndarray, qd: np.ndarray) -> np.ndarray:
        """Force on the interface along q (n, 6) [N, Nm]: -(K q + D qdot) and the stops, which only push."""
        force: np.ndarray = -(self.stiffness * q + self.damping * qd)
        excess = q - np.minimum(np.maximum(q, self.lower), self.upper)
        if excess.any():
            push = np.maximum(0.0, 1.0 + self.stop_damping * qd * np.sign(excess))
            force -= self.stop_stiffness * excess * push
        return force


def _cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    # np.cross spends more time on its arguments than on the product
    out = np.empty_like(b)
    out[..., 0] = a[..., 1] * b[..., 2] - a[..., 2] * b[..., 1]
    out[..., 1] = a[..., 2] * b[..., 0] - a[..., 0] * b[..., 2]
    out[..., 2] = a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]
    return out


def _turn(rotation: np.ndarray, vector: np.ndarray) -> np.ndarray:
    turned: np.ndarray = np.matmul(rotation, vector[..., None])[..., 0]
    return turned


def strap_wrench(
    law: StrapLaw, pelvis: Poses, interface: Poses
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return the wrench of the strap on the interface, from the poses of pelvis and interface in the world.

    Returns force (n, 3) at the interface midpoint [N] and torque (n, 3) [Nm] in world axes, q (n, 6) [m, rad] and
    its rate (n, 6). The map is the transposed Jacobian of three slides along the pelvis axes followed by hinges x,
    y, z, so that F·v + tau·omega equals the generalised force times qdot.
    """
    r_p, p_p, v_p, w_p = pelvis
    r_i, p_i, v_i, w_i = interface
    r_pt = r_p.transpose(0, 2, 1)
    arm = p_i - p_p
    relative = r_pt @ r_i @ law.rest_rotation.transpose(0, 2, 1)
    q, qd = np.empty((len(arm), 6)), np.empty((len(arm), 6))
    q[:, :3] = _turn(r_pt, arm) - law.rest_position
    qd[:, :3] = _turn(r_pt, v_i - v_p - _cross(w_p, arm))
    sb = relative[:, 0, 2]
    cb = np.sqrt(1.0 - sb * sb)
    sa, ca = -relative[:, 1, 2] / cb, relative[:, 2, 2] / cb
    q[:, 3] = np.arctan2(sa, ca)
    q[:, 4] = np.arcsin(sb)
    q[:, 5] = np.arctan2(-relative[:, 0, 1], relative[:, 0, 0])
    w = _turn(r_pt, w_i - w_p)
    qd[:, 5] = (ca * w[:, 2] - sa * w[:, 1]) / cb
    qd[:, 4] = ca * w[:, 1] + sa * w[:, 2]
    qd[:, 3] = w[:, 0] - sb * qd[:, 5]
    g = law.generalised_force(q, qd)
    # E^T tau = g with the current hinge axes as columns of E
    h = (g[:, 5] - sb * g[:, 3]) / cb
    tau = np.empty_like(arm)
    tau[:, 0] = g[:, 3]
    tau[:, 1] = ca * g[:, 4] - sa * h
    tau[:, 2] = sa * g[:, 4] + ca * h
    return _turn(r_p, g[:, :3]), _turn(r_p, tau), q, qd


@dataclass
class PelvisPath:
    """A prescribed pelvis in the world; called with times t (m,) [s]."""

    evaluate: Callable[[np.ndarray], Poses]
    duration_s: float

    def __call__(self, t: np.ndarray) -> Poses:
        """Rotation (m, 3, 3), position, velocity, angular velocity (m, 3) at times t (m,) [s]."""
        return self.evaluate(t)


@dataclass
class Controller:
    """Joint forces of the robot: springs and dampers about ``start`` (6,), order BASE_JOINTS + ARM_JOINTS.

    With ``follow`` the base follows the pelvis along its start heading by a velocity servo toward the
    distance at the start: keys ``distance_gain`` [1/s], ``servo_gain`` [Ns/m], ``speed_cap`` [m/s],
    ``force_cap`` [N], ``filter_s`` [s].
    """

    start: np.ndarray
    stiffness: np.ndarray
    damping: np.ndarray
    follow: dict[str, float] | None = None


def robot_controller(
    settings: dict[str, Any], controllers: dict[str, Any], kind: str, start: np.ndarray
) -> Controller:
    """Return a hold about the start pose (6,) [m, rad]; in walking the base follows the person forward."""
    base = [controllers["hold"][key] for key in ("x", "y", "yaw")]
    arm = [controllers["arm"][key] for key in ("lift", "roll", "pitch")]
    stiffness = np.array([j["stiffness"] for j in base + arm], float)
    damping = np.array([j["damping"] for j in base + arm], float)
    # the arm's springs pull to zero, which is where it starts
    rest = np.array([*start[:3], 0.0, 0.0, 0.0])
    follow = settings["gait"]["follow"] if kind == "walk_robot" else None
    return Controller(rest, stiffness, damping, follow)


@dataclass
class TruePaths:
    """Noise-free paths of one trial, at the sample rate.

    ``time_s`` (m,); pelvis rotation (m, 3, 3) and position (m, 3); interface rotation, position and the two
    joint centres ``left``, ``right`` (m, 3); ``joints``, ``joint_rates`` (m, 6); ``q``, ``qd`` (m, 6);
    ``force``, ``torque`` (m, 3) on the interface in world axes; all SI.
    """

    time_s: np.ndarray
    pelvis_rotation: np.ndarray
    pelvis_position: np.ndarray
    interface_rotation: np.ndarray
    interface_position: np.ndarray
    left: np.ndarray
    right: np.ndarray
    joints: np.ndarray
    joint_rates: np.ndarray
    q: np.ndarray
    qd: np.ndarray
    force: np.ndarray
    torque: np.ndarray


@dataclass
class Step:
    """Quantities at one step that an effect on the robot's side may use, one row per trial.

    ``time_s``; ``joints``, ``rates`` (n, 6) in the order BASE_JOINTS + ARM_JOINTS; ``force``, ``torque``
    (n, 3) of the strap on the interface midpoint in world axes; all SI.
    """

    time_s: float
    joints: np.ndarray
    rates: np.ndarray
    force: np.ndarray
    torque: np.ndarray


class RobotEffect(Protocol):
    """A force on the robot that its controllers do not know of; called once per step."""

    def __call__(self, step: Step, joint_force: np.ndarray, body_force: np.ndarray) -> None:
        """Add to ``joint_force`` (n, 6) [N, Nm] and ``body_force`` (n, 3, 3): base, arm, interface [N]."""


class Robot:
    """The robot tree of an MJCF file, without gravity (arm balanced, base planar) and without contacts."""

    def __init__(self, path: Path, step_s: float):
        spec = mujoco.MjSpec.from_file(str(path))
        spec.option.timestep = step_s
        spec.option.integrator = mujoco.mjtIntegrator.mjINT_EULER
        spec.option.disableflags |= mujoco.mjtDisableBit.mjDSBL_GRAVITY | mujoco.mjtDisableBit.mjDSBL_CONTACT
        sites = [spec.site(f"interface_{side}") for side in ("left", "right")]
        middle = (np.array(sites[0].pos) + np.array(sites[1].pos)) / 2
        spec.body("interface").add_site(name="phantom_middle", pos=middle)
        kinds = ("FRAMEPOS", "FRAMEXAXIS", "FRAMEYAXIS", "FRAMEZAXIS", "FRAMELINVEL", "FRAMEANGVEL")
        for kind in kinds:
            spec.add_sensor(
                type=getattr(mujoco.mjtSensor, f"mjSENS_{kind}"),
                objtype=mujoco.mjtObj.mjOBJ_SITE,
                objname="phantom_middle",
            )
        self.model = spec.compile()
        self.body = self.model.body("interface").id
        self.side = np.array(sites[0].pos) - middle
        self.to_com = self.model.body_ipos[self.body] - middle
        self.bodies = [self.model.body(n).id for n in ("base", "arm", "interface")]
        self.masses = self.model.body_mass[self.bodies].copy()
        names = BASE_JOINTS + ARM_JOINTS
        self.dofs = np.array([self.model.joint(n).dofadr[0] for n in names])
        self.step_s = step_s

    def rest_middle(self, start: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Rotation (3, 3) and position (3,) of the interface with the joints at ``start`` (6,)."""
        data = mujoco.MjData(self.model)
        data.qpos[self.dofs] = start
        mujoco.mj_kinematics(self.model, data)
        site = data.site("phantom_middle")
        return data.body("interface").xmat.reshape(3, 3).copy(), site.xpos.copy()


def _follow_feedforward(
    follow: dict[str, float], path: PelvisPath, heading: float, step_s: float, steps: int
) -> np.ndarray:
    # the robot's estimate of the user's speed: pelvis speed along the heading, first-order low-pass
    from scipy.signal import lfilter

    out = np.empty(steps)
    along = np.array([np.cos(heading), np.sin(heading)])
    a, state = np.exp(-step_s / follow["filter_s"]), np.zeros(1)
    for start in range(0, steps, 4000):
        t = np.arange(start, min(start + 4000, steps)) * step_s
        out[start : start + len(t)], state = lfilter([1 - a], [1, -a], path(t)[2][:, :2] @ along, zi=state)
    return out


def simulate(
    robot: Robot,
    paths: list[PelvisPath],
    law: StrapLaw,
    controllers: list[Controller],
    rate_hz: float,
    effects: Sequence[RobotEffect] = (),
    added_mass: np.ndarray | None = None,
) -> list[TruePaths]:
    """Step all trials at once and sample them at ``rate_hz``; results in the order given.

    Where a simulation was unstable, the interface's position is NaN.

    ``effects`` act on the robot and see the trials in the order given, so they ask for trials of one
    duration; ``added_mass`` (n, 4) is carried by the interface: mass [kg] and inertia about x, y, z [kg m^2].
    """
    runs, back = _sorted(_Runs, robot, paths, law, controllers, rate_hz, effects, added_mass)
    runs.run()
    return [runs.collect(i) for i in back]


def simulate_centres(
    robot: Robot,
    paths: list[PelvisPath],
    law: StrapLaw,
    controllers: list[Controller],
    rate_hz: float,
    effects: Sequence[RobotEffect] = (),
    added_mass: np.ndarray | None = None,
) -> np.ndarray:
    """As `simulate`, for many trials of one duration: joint centres left, right (n, m, 2, 3) [m] alone."""
    runs, back = _sorted(_Centres, robot, paths, law, controllers, rate_hz, effects, added_mass)
    runs.run()
    centres: np.ndarray = runs.centres()[back]
    return centres


_AnyRuns = TypeVar("_AnyRuns", bound="_Runs")


def _sorted(
    kind: type[_AnyRuns],
    robot: Robot,
    paths: list[PelvisPath],
    law: StrapLaw,
    controllers: list[Controller],
    rate_hz: float,
    effects: Sequence[RobotEffect],
    added_mass: np.ndarray | None,
) -> tuple[_AnyRuns, np.ndarray]:
    # the runs, and where each trial is among them
    order = np.argsort([-p.duration_s for p in paths], kind="stable")
    if len(effects) and (order != np.arange(len(paths))).any():
        raise ValueError("effects on the robot need trials of one duration")
    runs = kind(robot, [paths[i] for i in order], law.take(order), [controllers[i] for i in order], rate_hz)
    runs.effects, runs.added_mass = effects, None if added_mass is None else added_mass[order]
    return runs, np.argsort(order)


@dataclass
class _Follower:
    """A trial whose base follows the pelvis: its index, the controller's keys, the estimated speed (steps,) [m/s]."""

    trial: int
    follow: dict[str, float]
    feedforward: np.ndarray
    pelvis_start: np.ndarray


class _Runs:
    """Trials sorted by falling duration, so that those still running are always the first ones."""

    def __init__(
        self,
        robot: Robot,
        paths: list[PelvisPath],
        law: StrapLaw,
        controllers: list[Controller],
        rate_hz: float,
    ):
        self.robot, self.paths, self.law = robot, paths, law
        self.every = round(1 / (rate_hz * robot.step_s))
        if abs(self.every * rate_hz * robot.step_s - 1) > 1e-9:
            raise ValueError(f"step {robot.step_s} s does not divide the sample interval of {rate_hz} Hz")
        self.steps = np.array([round(p.duration_s / robot.step_s) for p in paths])
        self.start = np.array([c.start for c in controllers])
        self.stiffness = np.array([c.stiffness for c in controllers])
        self.damping = np.array([c.damping for c in controllers])
        self.followers = [self._follower(i, c.follow) for i, c in enumerate(controllers) if c.follow]
        self.rate_hz = rate_hz
        self.effects: Sequence[RobotEffect] = ()
        self.added_mass: np.ndarray | None = None
        self.failed = np.zeros(len(paths), bool)
        self.samples: list[tuple[np.ndarray, ...]] = []

    def _follower(self, trial: int, follow: dict[str, float]) -> _Follower:
        path, heading = self.paths[trial], self.start[trial, 2]
        speed = _follow_feedforward(follow, path, heading, self.robot.step_s, self.steps[trial] + 1)
        return _Follower(trial, follow, speed, path(np.zeros(1))[1][0, :2])

    def run(self) -> None:
        """Step all trials from the first sample to the last."""
        n, total = len(self.paths), int(self.steps[0])
        batch = untimed_batch(self.robot.model, n, 1, persistent=True)
        if self.added_mass is not None:
            batch.expand("body_mass")[:, self.robot.body] += self.added_mass[:, 0]
            batch.expand("body_inertia")[:, self.robot.body] += self.added_mass[:, 1:]
            batch.set_const()
        qpos, qvel = batch.bind("qpos"), batch.bind("qvel")
        sensors = batch.bind("sensordata")
        qpos[:, self.robot.dofs] = self.start
        batch.forward(stage=mujoco.mjtStage.mjSTAGE_VEL)
        applied, wrench = batch.bind("qfrc_applied"), batch.bind("xfrc_applied")
        chunk, k = 500, 0
        old_sensor_rates, old_qvel = np.zeros((n, 6)), np.zeros((n, 6))  # everything starts at rest
        while k <= total:
            active = int(np.sum(self.steps >= k))
            last = min(k + chunk - 1, int(self.steps[:active].min()))
            pelvis = self._pelvis(active, np.arange(k, last + 1) * self.robot.step_s)
            ids = np.arange(active)
            law = self.law.take(ids)
            home = law.rest_position
            old_sensor_rates, old_qvel = old_sensor_rates[:active], old_qvel[:active]
            for j, step in enumerate(range(k, last + 1)):
                s, v = sensors[:active].copy(), qvel[:active][:, self.robot.dofs]
                rates = s[:, 12:18]
                now, v_now = 1.5 * rates - 0.5 * old_sensor_rates, 1.5 * v - 0.5 * old_qvel
                old_sensor_rates, old_qvel = rates, v
                rotation = s[:, 3:12].reshape(-1, 3, 3).transpose(0, 2, 1)
                here = tuple(part[j] for part in pelvis)
                state = (rotation, s[:, :3], now[:, :3], now[:, 3:])
                if law.migration.any():
                    law = replace(law, rest_position=home + law.migration * (step * self.robot.step_s))
                force, torque, q, qd = strap_wrench(law, here, state)
                positions = qpos[:active][:, self.robot.dofs]
                if step % self.every == 0:
                    self._sample(active, here, state, positions, v_now, q, qd, force, torque)
                wrench[:active, self.robot.body, :3] = force
                shift = _turn(rotation, np.broadcast_to(self.robot.to_com, force.shape))
                wrench[:active, self.robot.body, 3:] = torque - _cross(shift, force)
                joints = -self.stiffness[:active] * (positions - self.start[:active])
                joints -= self.damping[:active] * v_now
                for one in self.followers:
                    if one.trial < active:
                        joints[one.trial, :2] = self._follow(one, step, here, positions, v_now)
                if self.effects:
                    on_bodies = np.zeros((active, 3, 3))
                    seen = Step(step * self.robot.step_s, positions, v_now, force, torque)
                    for effect in self.effects:
                        effect(seen, joints, on_bodies)
                    wrench[:active, self.robot.bodies[:2], :3] = on_bodies[:, :2]
                    wrench[:active, self.robot.body, :3] += on_bodies[:, 2]
                applied[:active, self.robot.dofs] = joints
                batch.step(ids, stage=mujoco.mjtStage.mjSTAGE_VEL)
            k = last + 1
        self.failed = batch.warning.reshape(n, -1).any(axis=1)

    def _pelvis(self, active: int, t: np.ndarray) -> tuple[np.ndarray, ...]:
        # trials that share a path share its evaluation
        seen = {id(path): path(t) for path in {id(p): p for p in self.paths[:active]}.values()}
        parts = [seen[id(path)] for path in self.paths[:active]]
        return tuple(np.ascontiguousarray(np.stack([p[c] for p in parts], axis=1)) for c in range(4))

    def _follow(
        self, follower: _Follower, step: int, pelvis: Poses, positions: np.ndarray, rates: np.ndarray
    ) -> np.ndarray:
        """Planar force (2,) on the base: speed servo along the start heading, spring and damper across it."""
        i, follow = follower.trial, follower.follow
        heading = self.start[i, 2]
        along = np.array([np.cos(heading), np.sin(heading)])
        across = np.array([-along[1], along[0]])
        travelled = positions[i, :2] - self.start[i, :2]
        stretch = along @ (pelvis[1][i, :2] - follower.pelvis_start - travelled)
        wanted = follower.feedforward[step] + follow["distance_gain"] * stretch
        wanted = min(max(wanted, 0.0), follow["speed_cap"])
        push = follow["servo_gain"] * (wanted - along @ rates[i, :2])
        push = min(max(push, -follow["force_cap"]), follow["force_cap"])
        aside = -self.stiffness[i, 1] * (across @ travelled) - self.damping[i, 1] * (across @ rates[i, :2])
        force: np.ndarray = push * along + aside * across
        return force

    def _sample(self, active: int, pelvis: Poses, interface: Poses, *rest: np.ndarray) -> None:
        row = [pelvis[0], pelvis[1], interface[0], interface[1], *rest]
        self.samples.append(tuple(np.array(x) for x in row))

    def collect(self, trial: int) -> TruePaths:
        """Paths of one trial."""
        rows = [row for row in self.samples if len(row[0]) > trial]
        r_p, p_p, r_i, p_i, joints, rates, q, qd, force, torque = (
            np.array([row[c][trial] for row in rows]) for c in range(10)
        )
        if self.failed[trial]:  # MuJoCo starts a simulation anew that it cannot go on with
            p_i = np.full_like(p_i, np.nan)
        offset = r_i @ self.robot.side
        time = np.arange(len(rows)) / self.rate_hz
        return TruePaths(
            time, r_p, p_p, r_i, p_i, p_i + offset, p_i - offset, joints, rates, q, qd, force, torque
        )


class _Centres(_Runs):
    """Keeps the joint centres alone: hundreds of trials at once would fill the memory."""

    def _sample(self, active: int, pelvis: Poses, interface: Poses, *rest: np.ndarray) -> None:
        rotation, position = interface[:2]
        offset = rotation @ self.robot.side
        self.samples.append((np.stack([position + offset, position - offset], axis=1),))

    def centres(self) -> np.ndarray:
        """Left and right joint centres (n, m, 2, 3) [m]."""
        out = np.stack([row[0] for row in self.samples], axis=1)
        out[self.failed] = np.nan
        return out
