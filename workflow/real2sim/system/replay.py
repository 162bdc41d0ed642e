"""Replays of one trial: many parameter vectors at once, one `mujoco.batch` call."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import mujoco
import numpy as np

from real2sim.errors import InputError
from real2sim.geometry import interface_coordinates, relative_pose
from real2sim.system.batches import untimed_batch
from real2sim.system.drive import PelvisDrive, pelvis_drive
from real2sim.system.plant import (
    ROBOT_JOINTS,
    STRAP_JOINTS,
    JointLimits,
    RestPose,
    compiled,
    load_robot,
    plant_spec,
    robot_pose_for,
    servo_gains,
)

if TYPE_CHECKING:
    from real2sim.settings import PlantSettings


@dataclass(frozen=True)
class Simulated:
    """One simulation: compiled model with all values, joint positions and rates at the start, command (nstep, nu)."""

    model: mujoco.MjModel
    position: np.ndarray
    velocity: np.ndarray
    control: np.ndarray


@dataclass(frozen=True)
class StartPose:
    """Robot joints (6,) and interface pose (3, 3), (3,) [m, world] at the start, and the strap's rest pose."""

    joints: np.ndarray
    rotation: np.ndarray
    position: np.ndarray
    rest: RestPose


class Replay:
    """Replay a measured pelvis path through the plant under many strap parameters.

    Parameters
    ----------
    robot, robot_settings, plant_settings, rest, limits
        See `plant.plant_spec`.
    time_s, pelvis_rotation, pelvis_position
        Measured pelvis path: (n,), (n, 3, 3), (n, 3) [s, m], uniformly sampled.
    start_rotation, start_position
        Interface pose at the start (3, 3), (3,) [m], where the robot's controller holds.
    nsim
        Simulations per call, at most.
    scale
        Factors on inertial constants of the robot (`plant.INERTIAL_CONSTANTS`).
    drive
        Of the same path and time step, where another replay has made it already.
    start_joints
        Robot joints (6,) at the start, where another replay of the trial has found them already.
    threads
        That step the simulations of a call. Results are the same bits with any number.

    Attributes
    ----------
    nstep
        Steps of one replay.
    stride
        Steps per sample.
    nsim
        Most simulations per call.
    spec, model
        The plant, described and compiled.
    start_joints
        Robot joints (6,) at the start.
    """

    def __init__(
        self,
        *,
        robot: Path,
        robot_settings: Mapping[str, Any],
        plant_settings: PlantSettings,
        time_s: np.ndarray,
        pelvis_rotation: np.ndarray,
        pelvis_position: np.ndarray,
        start_rotation: np.ndarray,
        start_position: np.ndarray,
        rest: RestPose,
        limits: JointLimits | None,
        nsim: int,
        scale: dict[str, float] | None = None,
        drive: PelvisDrive | None = None,
        start_joints: np.ndarray | None = None,
        threads: int = 1,
    ):
        h = float(plant_settings["timestep_s"])
        sample = float(time_s[1] - time_s[0])
        self.stride = round(sample / h)
        if abs(self.stride * h - sample) > 1e-9:
            raise ValueError(f"plant.timestep_s = {h} does not divide the sample interval {sample}")
        self.drive = drive or pelvis_drive(time_s, pelvis_rotation, pelvis_position, h)
        self._robot_file = robot
        if start_joints is None:
            start_joints = self._joints_for(start_rotation, start_position)
        self.start_joints = start_joints
        self.spec = plant_spec(
            robot,
            robot_settings,
            plant_settings,
            rest,
            limits,
            start_joints,
            self.drive.reference_rotation,
            self.drive.reference_origin,
            scale=scale,
        )
        self._extend(self.spec)
        # dampers are explicit, with what makes that the same motion (`_roll`): a tenth of a step is spared
        self.spec.option.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_EULERDAMP)
        self.model = compiled(self.spec, robot)
        if not self._may_be_constrained():
            self.model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONSTRAINT)
        self.nstep = len(self.drive.position)
        command = np.zeros((self.nstep, self.model.nu))
        command[:, :6] = servo_command(self.drive)
        self._control = np.tile(command, (nsim, 1, 1))
        self.nsim = nsim
        self._make_batch(threads)
        self._start_pose = StartPose(start_joints, start_rotation, start_position, rest)
        self._start_state = self._state_at(self.drive.position[0], self.drive.velocity[0], self._start_pose)

    def _make_batch(self, threads: int) -> None:
        """Make the batch of simulations, views of the fields that a run sets, and memory for what it records."""
        self._batch = untimed_batch(self.model, self.nsim, threads)
        joints = [self.model.joint(name) for name in STRAP_JOINTS]
        self._dofs = np.array([j.dofadr[0] for j in joints])
        self._joints = np.array([j.id for j in joints])
        self._stiffness = self._batch.expand("jnt_stiffness")
        self._damping = self._batch.expand("dof_damping")
        self._armature = self._batch.expand("dof_armature")
        adr = self.model.sensor("position_interface_left").adr[0]
        self._columns = slice(adr, adr + 6)
        self._pelvis_columns = slice(adr + 6, adr + 9)
        self._sensors = np.empty((self.nsim, self.nstep, self.model.nsensordata))

    @cached_property
    def _twin(self) -> mujoco.MjModel:
        """The robot alone."""
        return load_robot(self._robot_file).compile()

    def _joints_for(self, rotation: np.ndarray, position: np.ndarray) -> np.ndarray:
        try:
            return robot_pose_for(self._twin, rotation, position)
        except (ValueError, np.linalg.LinAlgError) as error:
            raise InputError(
                self._robot_file,
                "",
                str(error),
                "a twin that reaches the measured start pose",
                "Check its geometry.",
            ) from error

    def _extend(self, spec: mujoco.MjSpec) -> None:
        """Elements that the plain plant lacks: none."""

    def _may_be_constrained(self) -> bool:
        """Return whether the model has a limit, dry friction or a closed loop: what MuJoCo solves constraints for."""
        m = self.model
        limits, frictions = (m.jnt_limited, m.tendon_limited), (m.dof_frictionloss, m.tendon_frictionloss)
        return m.neq > 0 or any(np.any(field) for field in (*limits, *frictions))

    def _state_at(self, pelvis: np.ndarray, rate: np.ndarray, at: StartPose) -> tuple[np.ndarray, np.ndarray]:
        """Joint positions and velocities with the robot at rest and the pelvis (6,) and its rate (6,) in the drive."""
        from scipy.spatial.transform import Rotation

        model, drive = self.model, self.drive
        reference = drive.reference_rotation
        r_p = reference @ Rotation.from_rotvec(pelvis[3:]).as_matrix()
        p_p = drive.reference_origin + reference @ pelvis[:3]
        q = interface_coordinates(
            *relative_pose(r_p, p_p, at.rotation, at.position), at.rest.rotation, at.rest.position
        )
        data = mujoco.MjData(model)
        for name, value in zip(ROBOT_JOINTS, at.joints, strict=True):
            data.joint(name).qpos = value
        data.qpos[model.jnt_qposadr[self._joints]] = q
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        jac_p, jac_r = np.zeros((3, model.nv)), np.zeros((3, model.nv))
        mujoco.mj_jacSite(model, data, jac_p, jac_r, model.site("pelvis").id)
        twist = np.concatenate([reference @ rate[:3], reference @ rate[3:]])
        qvel = np.zeros(model.nv)
        qvel[self._dofs] = np.linalg.solve(np.vstack([jac_p, jac_r])[:, self._dofs], twist)
        return data.qpos.copy(), qvel

    def check_bounds(self, upper_damping: np.ndarray) -> None:
        """Refuse a robot too light for the time step: the step's centring needs a positive mass matrix.

        ``upper_damping`` (6,) are the largest damping values that will be asked for. Raises InputError.
        """
        model = self._batch.get_model(0)
        # what is left of the inertia once the robot's dampers and these are centred: see `_roll`
        model.dof_armature[:] = self.model.dof_armature
        model.dof_armature[self._dofs] -= upper_damping * model.opt.timestep / 2
        data = mujoco.MjData(model)
        data.qpos[:] = self._start_state[0]
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        mujoco.mj_makeM(model, data)
        mass = np.zeros((model.nv, model.nv))
        mujoco.mj_fullM(model, data, mass)
        scale = 1 / np.sqrt(np.abs(np.diag(mass)))
        if np.linalg.eigvalsh(mass * np.outer(scale, scale)).min() <= 1e-9:
            raise InputError(
                self._robot_file,
                "",
                f"inertia too small for plant.timestep_s = {model.opt.timestep} at the upper damping bounds",
                "a robot heavier than half the damping times the time step",
                "Lower plant.timestep_s or the upper bounds of the damping.",
            )

    def run(self, parameters: np.ndarray) -> np.ndarray:
        """Simulate strap parameters (m, 12), m <= nsim; returns interface sites (m, n, 2, 3) [m, world].

        Sample i is at ``time_s[i]``; sites are left, right. A simulation that MuJoCo gave up on is NaN.
        """
        return self._samples(self._simulate(parameters))

    def run_with_pelvis(self, parameters: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """As `run`, with the simulated pelvis origin (m, nstep, 3) [m, world] at every step."""
        sensors = self._simulate(parameters)
        return self._samples(sensors), sensors[:, :, self._pelvis_columns].copy()

    def as_simulated(self) -> Simulated:
        """Model, start and command of the first simulation of the last call, as plain MuJoCo takes them."""
        position, velocity = (np.broadcast_to(x, (1, x.shape[-1]))[0].copy() for x in self._starts(1))
        return Simulated(self._batch.get_model(0), position, velocity, self._control[0].copy())

    def sites(self) -> np.ndarray:
        """Interface sites (nstep, 2, 3) [m, world] of the last call's first simulation, before any output chain."""
        return self._sensors[0, :, self._columns].reshape(self.nstep, 2, 3).copy()

    def _samples(self, sensors: np.ndarray) -> np.ndarray:
        sites = sensors[:, :: self.stride, self._columns]
        # a copy: the record is written anew by the next call
        return sites.reshape(*sites.shape[:2], 2, 3).copy()

    def _simulate(self, parameters: np.ndarray) -> np.ndarray:
        m = len(parameters)
        batch, h = self._batch, self.model.opt.timestep
        self._stiffness[:m, self._joints] = parameters[:, :6]
        self._damping[:m, self._dofs] = parameters[:, 6:]
        self._armature[:m] = self.model.dof_armature
        self._armature[:m, self._dofs] -= parameters[:, 6:] * h / 2
        ids = np.arange(m)
        batch.reset(ids, stage=mujoco.mjtStage.mjSTAGE_NONE)
        batch.bind("qpos")[:m], batch.bind("qvel")[:m] = self._starts(m)
        return self._roll(m)

    def _starts(self, m: int) -> tuple[np.ndarray, np.ndarray]:
        """Joint positions and velocities at the start of the first m simulations, (nq,) and (nv,) or (m, n)."""
        return self._start_state

    def _roll(self, m: int) -> np.ndarray:
        """Step the first m simulations to the end of the path; sensors (m, nstep, nsensordata)."""
        self._damp_explicitly(m)
        return self._step(m)

    def _damp_explicitly(self, m: int) -> None:
        """Add to the inertia of m simulations what MuJoCo would add for implicit dampers: damping times step.

        With it the explicit step has the same motion. It costs no second factorisation of the inertia, and constraints
        know of it: what dry friction holds would creep by what is missing.
        """
        self._armature[:m] += self.model.opt.timestep * self._damping[:m]
        # of a joint whose body stands alone MuJoCo knows the inertia by another field
        lone = np.flatnonzero(self.model.dof_simplenum > 0)
        if len(lone):
            added = self._armature[:m, lone] - self.model.dof_armature[lone]
            self._batch.expand("dof_M0")[:m, lone] = self.model.dof_M0[lone] + added

    def _step(self, m: int) -> np.ndarray:
        """As of `_roll`, by the fields as they are."""
        batch, ids = self._batch, np.arange(m)
        whole = m == batch.nsim
        batch.rollout(
            self.nstep,
            self._control[:m],
            record=("sensordata",),
            ids=None if whole else ids,
            out={"sensordata": self._sensors[:m]},
        )
        return self._without_failed(m)

    def _without_failed(self, m: int) -> np.ndarray:
        """Sensors (m, nstep, nsensordata) of the last call, NaN where MuJoCo gave up."""
        warning, sensors = self._batch.warning[:m], self._sensors[:m]
        sensors[warning.any(axis=tuple(range(1, warning.ndim)))] = np.nan
        return sensors


def centred(rates: np.ndarray) -> np.ndarray:
    """Return rates (m, nstep, c) at the steps, of those half a step before, which a leapfrog step keeps."""
    after = 2 * rates[:, -1:] - rates[:, -2:-1]
    return np.asarray((rates + np.concatenate([rates[:, 1:], after], axis=1)) / 2)


def servo_command(drive: PelvisDrive) -> np.ndarray:
    """Command (nstep, 6) of the pelvis servo: position with velocity and acceleration fed forward."""
    kp, kd = servo_gains(drive.timestep)
    return drive.position + (kd / kp) * drive.velocity + (1 / kp) * drive.acceleration


def replay_check(replay: Replay, pelvis: np.ndarray) -> dict[str, float]:
    """Return the distance of the simulated pelvis (nstep, 3) [m] from its path, in space and in time.

    Returns ``rms_m``, ``max_m`` and ``lag_s``: the shift of time that explains most of the error (least squares
    of the error on the velocity; positive if the simulation is late).
    """
    drive = replay.drive
    path = drive.reference_origin + drive.position[:, :3] @ drive.reference_rotation.T
    velocity = drive.velocity[:, :3] @ drive.reference_rotation.T
    error = pelvis - path
    distance = np.linalg.norm(error, axis=1)
    return {
        "rms_m": float(np.sqrt(np.mean(distance**2))),
        "max_m": float(distance.max()),
        "lag_s": float(-np.sum(error * velocity) / max(np.sum(velocity * velocity), 1e-12)),
    }
