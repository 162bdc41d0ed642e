"""The person and the robot in one simulation: strap between pelvis and arm, the base follows under a speed cap.

No loop is closed. The plant of the identification (`system.plant`) ends in a pelvis at the end of the robot's chain
behind the six strap joints, whose path is imposed there. Here that pelvis is the person's: legs and trunk hang on it
and nothing imposes its path. The strap joints are therefore exactly the interface coordinates q
(`geometry.interface_coordinates`), with the same code, stiffness, damping and limits as in the fits; the person's six
root coordinates are those of robot and strap.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields
from typing import TYPE_CHECKING, Any

import mujoco
import numpy as np

from real2sim.geometry import interface_coordinates, relative_pose
from real2sim.study.twin.env import RootState, correction_of, gains, observe, rotations, servo_target
from real2sim.study.twin.gait import PHASES, SAGITTAL
from real2sim.study.twin.human import FEET, JOINTS, Body, add_actuators, add_floor, add_human, human_spec
from real2sim.study.twin.policy import Policy
from real2sim.study.twin.robots import WalkingRobot
from real2sim.system.batches import untimed_batch
from real2sim.system.plant import STRAP_JOINTS, JointLimits, RestPose, compiled

if TYPE_CHECKING:
    from real2sim.settings import (
        PlantSettings,
        TwinHumanContactSettings,
        TwinHumanSettings,
        TwinSettings,
    )

_TINY_MASS, _TINY_INERTIA = 1e-3, 1e-6
_SENSORS = 19  # columns of `add_gait_sensors`
_TURNED = 1.0  # heading from which a walker does not walk along any more, as in training [rad]
_CADENCE_FILTER_S = 1.0  # over which the person senses the robot's speed


def standing_interface(who: Body, rest: RestPose) -> tuple[np.ndarray, np.ndarray]:
    """Return the interface pose (3, 3), (3,) [m] of the person standing upright: level, heading straight.

    The pelvis frame of the markers is the one in which the interface is level while standing.
    """
    pelvis = rest.rotation.T
    place = np.array([0, 0, who.hip_height]) + who.mid_asis
    return np.eye(3), place + pelvis @ rest.position


def walking_interface(
    who: Body, rest: RestPose, height_m: float, stretch_m: float = 0.0
) -> tuple[np.ndarray, np.ndarray]:
    """Return the pose (3, 3), (3,) [m] of `standing_interface` at the height that a walk has in the mean.

    A walking pelvis is lower than a standing one, and an arm that holds its height would lift it. ``height_m`` is the
    mean height over the floor of an unloaded interface (`height_of_interface`), ``stretch_m`` how much higher than at
    rest the interface is in the pelvis frame while walking, in the mean.
    """
    level, place = standing_interface(who, rest)
    place[2] = height_m + stretch_m
    return level, place


def height_of_interface(recording: Recording, who: Body, rest: RestPose, settle_s: float = 0.0) -> float:
    """Return the mean height [m] over the floor of an interface that stays at its rest pose, after settling."""
    after = recording.time_s >= settle_s
    level = recording.pelvis_up[:, after] @ (who.mid_asis + rest.rotation.T @ rest.position)
    return float(np.nanmean(recording.pelvis_height[:, after] + level))


def height_of_reference(policy: Policy, rest: RestPose) -> float:
    """Return the height of `height_of_interface` in the gait that a policy was trained to walk."""
    qpos, _, _ = policy.reference.at(np.arange(PHASES) / PHASES)
    arm = rotations(qpos[:, 3:7]) @ (policy.body.mid_asis + rest.rotation.T @ rest.position)
    return float(np.mean(qpos[:, 2] + arm[:, 2]))


def coupled_spec(
    who: Body,
    human: TwinHumanSettings,
    robot: WalkingRobot,
    plant: PlantSettings,
    rest: RestPose,
    limits: JointLimits | None,
    stand: tuple[np.ndarray, np.ndarray],
) -> mujoco.MjSpec:
    """Describe robot, strap and person as one tree; the robot knows its stand from then on.

    ``human`` is a slice of ``twin``, ``plant`` the slice ``plant`` (its limits are used), ``stand`` the pose (3, 3),
    (3,) [m] of the interface for which the robot is set up. Strap stiffness and damping are set per simulation.

    Raises
    ------
    InputError
        Where the robot cannot reach the interface.
    """
    settings: PlantSettings = {**plant, "timestep_s": human["timestep_s"]}
    spec = robot.describe(settings, rest, limits, stand)
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    spec.option.disableflags &= ~(mujoco.mjtDisableBit.mjDSBL_GRAVITY | mujoco.mjtDisableBit.mjDSBL_CONTACT)
    _add_person(spec, who, rest, human["contact"])
    add_floor(spec)
    add_gait_sensors(spec)
    return spec


def _add_person(spec: mujoco.MjSpec, who: Body, rest: RestPose, contact: TwinHumanContactSettings) -> None:
    """Hang the person, with their servos, on the plant's pelvis, upright in the frame of the pelvis markers."""
    pelvis = spec.body("pelvis")
    pelvis.mass, pelvis.inertia = _TINY_MASS, [_TINY_INERTIA] * 3
    quat = np.zeros(4)
    # upright body in the marker frame, which is inclined by the rest pose
    mujoco.mju_mat2Quat(quat, rest.rotation.flatten())
    origin = -rest.position - rest.rotation @ who.mid_asis
    person = pelvis.add_body(name="human", pos=origin, quat=quat)
    add_human(person, who, contact, degrees=bool(spec.compiler.degree))
    add_actuators(spec, who)


def add_gait_sensors(spec: mujoco.MjSpec) -> None:
    """Add sensors of the pelvis' pose and velocity and of both heels, in this order: 3, 4, 3, 3, 3, 3 columns."""
    site = mujoco.mjtObj.mjOBJ_SITE
    kinds = mujoco.mjtSensor
    for name, kind in (
        ("root_position", kinds.mjSENS_FRAMEPOS),
        ("root_quaternion", kinds.mjSENS_FRAMEQUAT),
        ("root_velocity", kinds.mjSENS_FRAMELINVEL),
        ("root_spin", kinds.mjSENS_FRAMEANGVEL),
    ):
        spec.add_sensor(name=name, type=kind, objtype=site, objname="human_root")
    for side in FEET:
        spec.add_sensor(name=f"heel_{side}", type=kinds.mjSENS_FRAMEPOS, objtype=site, objname=f"heel_{side}")


@dataclass(frozen=True)
class Condition:
    """One way of coupling: strap parameters (12,), speed cap as a share of the person's speed, robot's factors.

    ``factors`` multiply constants of the robot by name (`WalkingRobot.constants`). An ``aware`` person means to walk
    the slower the more the strap pulls them back; another one means to walk at their own speed.
    """

    name: str
    parameters: np.ndarray
    cap: float
    factors: tuple[tuple[str, float], ...] = ()
    aware: bool = False


@dataclass
class Recording:
    """Motion of some walkers, (m, n) unless said otherwise; NaN after a fall.

    ``time_s`` (n,); ``joints`` by coordinate [rad]; ``heel_ahead`` of the pelvis, ``heel_along``, ``heel_across`` and
    ``heel_above`` the floor in the world, by side, and ``along``, the pelvis' path [m]; ``pelvis_height`` over the
    floor [m], ``pelvis_up`` (m, n, 3) the vertical in the frame of the upright pelvis, ``pelvis_yaw`` [rad];
    ``interface`` (m, n, 6) strap coordinates q; ``wrench`` (m, n, 6) of springs and dampers of the strap on the
    interface along them [N, Nm], without the stops; ``base_speed`` of the robot [m/s], NaN without one; ``alive``,
    ``survived_s`` (m,).
    """

    time_s: np.ndarray
    joints: dict[str, np.ndarray]
    heel_ahead: dict[str, np.ndarray]
    heel_along: dict[str, np.ndarray]
    heel_across: dict[str, np.ndarray]
    heel_above: dict[str, np.ndarray]
    along: np.ndarray
    pelvis_height: np.ndarray
    pelvis_up: np.ndarray
    pelvis_yaw: np.ndarray
    interface: np.ndarray
    wrench: np.ndarray
    base_speed: np.ndarray
    alive: np.ndarray
    survived_s: np.ndarray

    def of(self, rows: np.ndarray) -> Recording:
        """Return the recording of some of the walkers, indices (k,)."""
        parts: dict[str, Any] = {}
        for item in fields(self):
            value = getattr(self, item.name)
            if isinstance(value, dict):
                parts[item.name] = {key: rows_of[rows] for key, rows_of in value.items()}
            else:
                parts[item.name] = value if item.name == "time_s" else value[rows]
        return Recording(**parts)


class _Walkers:
    """Walkers in a batch that are recorded; what they are strapped to is up to the subclasses.

    ``_q`` and ``_v`` are the places of the person's 21 joints in qpos and qvel, ``_strap`` those of the strap or empty,
    ``_base`` that of the robot's base or None.
    """

    def __init__(self, policy: Policy, model: mujoco.MjModel, twin: TwinSettings, n: int, threads: int):
        self.policy, self.model, self.n = policy, model, n
        self.substeps = int(twin["human"]["substeps"])
        self.control_s = self.substeps * model.opt.timestep
        self.batch = untimed_batch(model, n, threads)
        self.kp = gains(policy.body)
        self._q = np.array([model.joint(j).qposadr[0] for j in JOINTS])
        self._v = np.array([model.joint(j).dofadr[0] for j in JOINTS])
        self._servos = np.array([model.actuator(j).id for j in JOINTS])
        # speed that each means to walk at, as a share of their own; 1 where the reference knows one speed alone
        self._share: np.ndarray | float = 1.0
        self._strap = np.empty(0, int)
        self._base: int | None = None

    def _start(self, phase: np.ndarray) -> None:
        raise NotImplementedError

    def _command_robot(self, root: RootState, control: np.ndarray) -> None:
        """Write the robot's part of ``control``: none."""

    def _feel(self, record: dict[str, np.ndarray]) -> None:
        """Take note of a rollout: nothing."""

    def _cadence(self) -> np.ndarray | float:
        """Return the factor on the clock."""
        return 1.0

    def run(
        self, seconds: float, stride: int = 2, watch: Callable[[np.ndarray], None] | None = None
    ) -> Recording:
        """Walk for ``seconds`` from phases spread over the cycle, recording every ``stride`` simulation steps.

        ``watch`` is shown the positions (n, nq) at every control step.
        """
        n, batch, reference = self.n, self.batch, self.policy.reference
        phase = self._phases()
        self._start(phase)
        batch.bind("qacc_warmstart")[:] = 0
        batch.warning[:] = 0
        # bound before the call that fills it: derived fields are zero until then
        qpos, qvel, sensors = batch.bind("qpos"), batch.bind("qvel"), batch.bind("sensordata")
        batch.forward(stage=mujoco.mjtStage.mjSTAGE_VEL)
        first = self.model.sensor("root_position").adr[0]
        steps, per = round(seconds / self.control_s), self.substeps // stride
        kept = self._room(steps * per)
        alive, survived = np.ones(n, bool), np.full(n, float(seconds))
        height = float(reference.qpos[:, 2].mean())
        control = np.zeros((n, self.model.nu))
        for k in range(steps):
            s = sensors[:, first : first + _SENSORS]
            rotation = rotations(s[:, 3:7])
            root = RootState(s[:, :3], s[:, 7:10], rotation, np.einsum("mji,mj->mi", rotation, s[:, 10:13]))
            cadence = self._command(phase, root, qpos, qvel, control)
            if watch is not None:
                watch(qpos)
            fallen = self._fallen(root, qpos, height)
            record = batch.rollout(
                self.substeps,
                np.repeat(control[:, None], self.substeps, axis=1),
                record=("qpos", "qvel", "sensordata", "qfrc_passive"),
            )
            self._feel(record)
            survived[alive & fallen] = k * self.control_s
            alive &= ~fallen
            at = slice(k * per, (k + 1) * per)
            for name, values in self._recorded(record, first).items():
                kept[name][alive, at] = values[alive, stride - 1 :: stride]
            phase = np.mod(phase + cadence * self.control_s / reference.stride_at(self._share), 1.0)
            batch.forward(stage=mujoco.mjtStage.mjSTAGE_VEL)
        return self._recording(kept, alive, survived, stride)

    def _room(self, samples: int) -> dict[str, np.ndarray]:
        """Return arrays (n, samples, columns) for what is recorded, NaN."""
        strap = len(self._strap)
        widths = {"sensor": _SENSORS, "joint": len(JOINTS), "q": strap, "wrench": strap, "base": 1}
        return {name: np.full((self.n, samples, w), np.nan, np.float32) for name, w in widths.items()}

    def _command(
        self, phase: np.ndarray, root: RootState, qpos: np.ndarray, qvel: np.ndarray, control: np.ndarray
    ) -> np.ndarray | float:
        """Write the commands of servos and robot into ``control`` (n, nu); return the factor on the clock."""
        policy, reference = self.policy, self.policy.reference
        cadence = self._cadence()
        share = self._share
        joints, rates = qpos[:, self._q], qvel[:, self._v]
        obs, mirrored = observe(reference, phase, root, joints, rates, np.zeros(self.n), cadence, share)
        correction = correction_of(np.clip(policy(obs), -1.5, 1.5), mirrored)
        control[:, self._servos] = servo_target(
            reference, phase, self.control_s, self.kp, correction, cadence, share
        )
        self._command_robot(root, control)
        return cadence

    def _fallen(self, root: RootState, qpos: np.ndarray, height: float) -> np.ndarray:
        """Return who lies, hangs, turned away or diverged (n,); ``height`` [m] is that of the reference's pelvis."""
        warning = self.batch.warning
        return np.asarray(
            (root.position[:, 2] < 0.75 * height)
            | (root.tilt_sq > 0.3)
            | (np.abs(root.yaw) > _TURNED)
            | ~np.isfinite(qpos).all(axis=1)
            | warning.any(axis=tuple(range(1, warning.ndim)))
        )

    def _recorded(self, record: dict[str, np.ndarray], first: int) -> dict[str, np.ndarray]:
        """Return what is kept of a rollout, (n, substeps, columns) by name; ``first`` column of the sensors."""
        base = (
            np.full((self.n, self.substeps, 1), np.nan)
            if self._base is None
            else record["qvel"][..., [self._base]]
        )
        return {
            "sensor": record["sensordata"][..., first : first + _SENSORS],
            "joint": record["qpos"][..., self._q],
            "q": record["qpos"][..., self._strap],
            "wrench": record["qfrc_passive"][..., self._strap],
            "base": base,
        }

    def _phases(self) -> np.ndarray:
        return np.arange(self.n) / self.n

    def _recording(
        self, kept: dict[str, np.ndarray], alive: np.ndarray, survived: np.ndarray, stride: int
    ) -> Recording:
        s = kept["sensor"].astype(float)
        along = s[..., 0]
        heel = {side: s[..., 13 + 3 * i] for i, side in enumerate(FEET)}
        return Recording(
            np.arange(1, s.shape[1] + 1) * stride * self.model.opt.timestep,
            {
                name: kept["joint"][..., JOINTS.index(name)].astype(float)
                for name in (f"{j}_{side}" for j in SAGITTAL for side in FEET)
            },
            {side: x - along for side, x in heel.items()},
            heel,
            {side: s[..., 14 + 3 * i] for i, side in enumerate(FEET)},
            {side: s[..., 15 + 3 * i] for i, side in enumerate(FEET)},
            along,
            s[..., 2],
            _vertical(s[..., 3:7]),
            _yaw(s[..., 3:7]),
            kept["q"].astype(float),
            kept["wrench"].astype(float),
            kept["base"][..., 0].astype(float),
            alive,
            survived,
        )


class FreeWalk(_Walkers):
    """The same people without a robot, recorded in the same way.

    ``walkers`` of them mean to walk at each of ``shares`` of their own speed, one after the other in the recording.
    """

    def __init__(
        self,
        policy: Policy,
        *,
        twin: TwinSettings,
        walkers: int,
        threads: int = 1,
        shares: Sequence[float] = (1.0,),
    ):
        if policy.reference.speeds is None and set(shares) != {1.0}:
            raise ValueError("a policy whose reference knows one speed alone cannot walk at another")
        spec = human_spec(policy.body, twin["human"])
        add_gait_sensors(spec)
        super().__init__(policy, spec.compile(), twin, len(shares) * walkers, threads)
        self._walkers = walkers
        if policy.reference.speeds is not None:
            self._share = np.repeat(shares, walkers)

    def _phases(self) -> np.ndarray:
        return np.tile(np.arange(self._walkers) / self._walkers, self.n // self._walkers)

    def _start(self, phase: np.ndarray) -> None:
        qpos, qvel, _ = self.policy.reference.at(phase, self._share)
        self.batch.bind("qpos")[:], self.batch.bind("qvel")[:] = qpos, qvel


class CoupledWalk(_Walkers):
    """Walkers strapped to robots, ``walkers`` of them per condition, all in one batch.

    Parameters
    ----------
    policy
        Who walks, and how.
    twin, plant
        Slices ``twin`` and ``plant`` of the configuration.
    robot, rest, limits
        Robot, rest pose and joint limits of the interface.
    conditions
        What to simulate.
    height_m, stretch_m
        Mean height of the unloaded interface over the floor [m], see `walking_interface`; that of the reference where
        it is not said. Mean vertical stretch of the strap while walking [m].
    walkers, threads
        Per condition, and threads that step them.
    """

    def __init__(
        self,
        policy: Policy,
        *,
        twin: TwinSettings,
        plant: PlantSettings,
        robot: WalkingRobot,
        rest: RestPose,
        limits: JointLimits | None,
        conditions: list[Condition],
        walkers: int,
        height_m: float | None = None,
        stretch_m: float = 0.0,
        threads: int = 1,
    ):
        height = height_of_reference(policy, rest) if height_m is None else height_m
        self._stand = walking_interface(policy.body, rest, height, stretch_m)
        spec = coupled_spec(policy.body, twin["human"], robot, plant, rest, limits, self._stand)
        self._dress(spec, robot)
        if limits is not None:
            kind, joint = mujoco.mjtSensor.mjSENS_JOINTLIMITFRC, mujoco.mjtObj.mjOBJ_JOINT
            spec.add_sensor(name="strap_stop", type=kind, objtype=joint, objname="strap_tx")
        model = compiled(spec, robot.path)
        super().__init__(policy, model, twin, len(conditions) * walkers, threads)
        self.robot, self.conditions, self.walkers, self.rest = robot, conditions, walkers, rest
        self._coupled = twin["coupled"]
        self._aware = np.repeat([c.aware for c in conditions], walkers)
        if self._aware.any() and policy.reference.speeds is None:
            raise ValueError("a policy whose reference knows one speed alone cannot be aware of another")
        # every joint of robot, strap and person has one coordinate: its place in qpos is that in qvel
        self._robot = np.array([model.joint(j).dofadr[0] for j in robot.joints])
        self._drives = np.array([model.actuator(name).id for name in robot.commands])
        self._strap = np.array([model.joint(j).dofadr[0] for j in STRAP_JOINTS])
        self._stop = None if limits is None else int(model.sensor("strap_stop").adr[0])
        self._middle = 0.0 if limits is None else float(limits.lower[0] + limits.upper[0]) / 2
        self._stopping_n = twin["coupled"]["stopping_pull_bw"] * policy.body.weight
        self._first = int(model.sensor("root_position").adr[0])
        self._base = int(self._robot[0])
        self.cap = np.repeat([c.cap for c in conditions], walkers) * policy.reference.speed
        if policy.reference.speeds is not None:
            self._share = self._meant(np.repeat([c.cap for c in conditions], walkers))
            self._pull = (1 - self._share) * self._stopping_n
        robot.bind(model, self.batch, self.cap)
        self._set_conditions()

    def _dress(self, spec: mujoco.MjSpec, robot: WalkingRobot) -> None:
        """Add what only a camera needs: nothing."""

    def _set_conditions(self) -> None:
        """Set strap impedances and the robot's constants per simulation."""
        stiffness, damping = self.batch.expand("jnt_stiffness"), self.batch.expand("dof_damping")
        ids = [self.model.joint(j).id for j in STRAP_JOINTS]
        for k, condition in enumerate(self.conditions):
            rows = slice(k * self.walkers, (k + 1) * self.walkers)
            for i, joint in enumerate(ids):
                # MuJoCo's fields of a spring and a damper hold the coefficients of a polynomial: the first is linear
                _linear(stiffness, joint)[rows] = condition.parameters[i]
                _linear(damping, self._strap[i])[rows] = condition.parameters[6 + i]
            for constant, factor in condition.factors:
                self.robot.multiply(rows, constant, factor)

    def _phases(self) -> np.ndarray:
        return np.tile(np.arange(self.walkers) / self.walkers, len(self.conditions))

    def _start(self, phase: np.ndarray) -> None:
        """Start everyone in the reference's state at their phase, the robot where it is while standing, at its cap."""
        model, data = self.model, mujoco.MjData(self.model)
        who, reference = self.policy.body, self.policy.reference
        qpos, qvel, _ = reference.at(phase, self._share)
        turned = rotations(qpos[:, 3:7])
        site = model.site("human_root").id
        jac_p, jac_r = np.zeros((3, model.nv)), np.zeros((3, model.nv))
        level, place = self._stand
        stand = self.robot.standing()
        position, velocity = self.batch.bind("qpos"), self.batch.bind("qvel")
        for i, rotation in enumerate(turned):
            shift = np.array([qpos[i, 0], 0, 0])
            pelvis = rotation @ self.rest.rotation.T, qpos[i, :3] + rotation @ who.mid_asis
            data.qpos[self._robot] = stand[i]
            data.qpos[self._base] += shift[0]
            data.qpos[self._strap] = interface_coordinates(
                *relative_pose(*pelvis, level, place + shift), self.rest.rotation, self.rest.position
            )
            data.qpos[self._q] = qpos[i, 7:]
            data.qvel[:] = 0
            data.qvel[self._base] = min(self.cap[i], reference.speed)
            data.qvel[self._v] = qvel[i, 6:]
            mujoco.mj_kinematics(model, data)
            mujoco.mj_comPos(model, data)
            mujoco.mj_jacSite(model, data, jac_p, jac_r, site)
            jacobian = np.vstack([jac_p, jac_r])
            twist = np.concatenate([qvel[i, :3], rotation @ qvel[i, 3:6]])
            moving = jacobian[:, self._robot] @ data.qvel[self._robot]
            data.qvel[self._strap] = np.linalg.solve(jacobian[:, self._strap], twist - moving)
            position[i], velocity[i] = data.qpos, data.qvel
        self.robot.start(reference.speed)
        self._base_speed = velocity[:, self._base].copy()

    def _command_robot(self, root: RootState, control: np.ndarray) -> None:
        """Write the robot's commands into ``control``."""
        control[:, self._drives] = self.robot.command(root, self.control_s)

    def _feel(self, record: dict[str, np.ndarray]) -> None:
        """Let the aware slow down by how much strap and stops pull them back.

        Not by the robot's speed: who lags behind what they mean cannot tell by it whether the robot holds them back,
        and a robot that follows slows down with them.
        """
        if not self._aware.any():
            return
        taken_up = min(1.0, self.control_s / self._coupled["pull_sense_s"])
        self._pull += (self._pull_back(record) - self._pull) * taken_up
        self._share = self._meant(1 - self._pull / self._stopping_n)

    def _pull_back(self, record: dict[str, np.ndarray]) -> np.ndarray:
        """Return the mean force (n,) [N] over a rollout with which strap and stop hold the person back.

        Level, against where the pelvis heads: its own forward axis leans, and would take an arm that lifts for one that
        pulls.
        """
        along = record["qfrc_passive"][..., self._strap[:3]].copy()
        if self._stop is not None:
            side = np.sign(self._middle - record["qpos"][..., self._strap[0]])
            along[..., 0] += side * record["sensordata"][..., self._stop]
        turned = record["sensordata"][..., self._first + 3 : self._first + 7].reshape(-1, 4)
        force = np.einsum("ijk,ik->ij", rotations(turned), along.reshape(-1, 3) @ self.rest.rotation)
        yaw = _yaw(turned)
        back = force[:, 0] * np.cos(yaw) + force[:, 1] * np.sin(yaw)
        return np.asarray(back.reshape(along.shape[:2]).mean(axis=1))

    def _meant(self, share: np.ndarray) -> np.ndarray:
        """Return the speed that each means to walk at (n,): the aware ``share``, no slower than their gait is known."""
        speeds = self.policy.reference.speeds
        slowest = 1.0 if speeds is None else float(speeds.shares[0])
        return np.where(self._aware, np.clip(share, slowest, 1.0), 1.0)

    def _cadence(self) -> np.ndarray | float:
        exponent = self._coupled["cadence_exponent"]
        if not exponent:
            return 1.0
        speed = self.batch.bind("qvel")[:, self._base]
        self._base_speed += (speed - self._base_speed) * self.control_s / _CADENCE_FILTER_S
        share = self._base_speed / self.policy.reference.speed
        # whoever is aware has a cadence of each speed already
        return np.where(self._aware, 1.0, np.clip(share, 0.5, 1.2) ** exponent)


def _yaw(quaternion: np.ndarray) -> np.ndarray:
    """Return the heading (...) [rad] of unit quaternions (..., 4), w first."""
    w, x, y, z = np.moveaxis(quaternion, -1, 0)
    return np.asarray(np.arctan2(2 * (x * y + w * z), 1 - 2 * (y * y + z * z)))


def _vertical(quaternion: np.ndarray) -> np.ndarray:
    """Return the vertical (..., 3) in the frames that unit quaternions (..., 4), w first, turn into the world's."""
    w, x, y, z = np.moveaxis(quaternion, -1, 0)
    return np.stack([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)], axis=-1)


def _linear(field: np.ndarray, index: int) -> np.ndarray:
    """Return the linear coefficient of a joint's spring or damper in an expanded field, (nsim,)."""
    return field[:, index] if field.ndim == 2 else field[:, index, 0]


def strap_vectors(conditions: dict[str, Any]) -> dict[str, np.ndarray]:
    """Return the parameters (12,) of the isotropic conditions by name: all six axes have the same values."""
    return {
        name: np.array([float(v["stiffness"])] * 6 + [float(v["damping"])] * 6)
        for name, v in conditions.items()
    }
