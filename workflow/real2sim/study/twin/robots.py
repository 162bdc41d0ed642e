"""Robots that a strapped person walks with: what every one of them offers, and the compliant one.

A robot describes its part of the tree up to the strap, stands where a person begins to walk, and writes its commands at
every control step. The study's own robot is in `study_robot`.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

import mujoco
import numpy as np

from real2sim.errors import InputError
from real2sim.study.twin.env import RootState
from real2sim.system.plant import (
    ROBOT_JOINTS,
    JointLimits,
    RestPose,
    load_robot,
    plant_spec,
    robot_pose_for,
)

if TYPE_CHECKING:
    from real2sim.settings import PlantSettings, TwinFollowSettings


class WalkingRobot(ABC):
    """A robot in the walks of `coupled.CoupledWalk`.

    Attributes
    ----------
    name
        How tables and figures call it.
    joints
        Names of its joints; the first is the slide of its base along the path.
    commands
        Names of its actuators, in the order in which `command` returns their values.
    constants
        Names that a condition may multiply by a factor: assumed or doubtful constants of the robot.
    path
        Its MJCF.
    """

    name: ClassVar[str]
    joints: ClassVar[tuple[str, ...]]
    commands: ClassVar[tuple[str, ...]]
    constants: ClassVar[tuple[str, ...]]
    path: Path

    @abstractmethod
    def describe(
        self,
        plant: PlantSettings,
        rest: RestPose,
        limits: JointLimits | None,
        stand: tuple[np.ndarray, np.ndarray],
    ) -> mujoco.MjSpec:
        """Describe robot, strap and a body ``pelvis`` without a person in it.

        ``plant`` is the slice ``plant`` with the time step of the walk, ``stand`` the pose (3, 3), (3,) [m, world] of
        the interface while the person stands. Raises InputError where the robot cannot reach it.
        """

    @abstractmethod
    def bind(self, model: mujoco.MjModel, batch: mujoco.batch.Batch, cap: np.ndarray) -> None:
        """Take the model of the walk, its simulations, and the highest speed (n,) [m/s] of each robot."""

    @abstractmethod
    def standing(self) -> np.ndarray:
        """Return joint positions (n, joints) that hold the interface where the standing person has it."""

    @abstractmethod
    def multiply(self, rows: slice, constant: str, factor: float) -> None:
        """Multiply one of ``constants`` in some of the simulations."""

    @abstractmethod
    def start(self, speed: float) -> None:
        """Forget what the controller remembers; everybody begins at ``speed`` [m/s]."""

    @abstractmethod
    def command(self, root: RootState, control_s: float) -> np.ndarray:
        """Return the actuators' commands (n, commands) over the next control step of ``control_s`` [s]."""


# Assumed axes whose impedance may be multiplied, and the joint that has it
COMPLIANCES = {"lateral": "base_y", "vertical": "arm_lift", "roll": "arm_roll"}


def robot_settings(follow: Mapping[str, Any]) -> dict[str, Any]:
    """Return the impedances of the follow mode in the form of the slice ``robot`` of the configuration."""
    free = {"stiffness": 0.0, "damping": 0.0}

    def impedance(name: str) -> dict[str, float]:
        return {key: follow[name][key] for key in ("stiffness", "damping")}

    return {
        "follow": {"x": free, "y": impedance("lateral"), "yaw": impedance("yaw")},
        "arm": {"lift": impedance("vertical"), "roll": impedance("roll"), "pitch": impedance("pitch")},
    }


class CompliantRobot(WalkingRobot):
    """The robot of the identification: a base that yields in the plane, an arm that yields in height, roll and pitch.

    Its base follows the person's speed and keeps the distance of standing, under a cap. Every impedance is assumed
    (``twin.follow``).

    Parameters
    ----------
    path
        MJCF of the robot twin.
    follow
        Slice ``twin.follow`` of the configuration.
    """

    name = "compliant"
    joints = ROBOT_JOINTS
    commands = ("follow",)
    constants = tuple(COMPLIANCES)

    def __init__(self, path: Path, follow: TwinFollowSettings):
        self.path, self._follow = path, follow

    def describe(
        self,
        plant: PlantSettings,
        rest: RestPose,
        limits: JointLimits | None,
        stand: tuple[np.ndarray, np.ndarray],
    ) -> mujoco.MjSpec:
        """Describe the plant of the identification, see `WalkingRobot.describe`."""
        self._stand = self._reach(*stand)
        settings = robot_settings(self._follow)
        frame = np.eye(3), np.zeros(3)
        spec = plant_spec(self.path, settings, plant, rest, limits, self._stand, *frame, controller="follow")
        for actuator in list(spec.actuators):
            spec.delete(actuator)
        for name in ("base", "arm", "interface"):
            spec.body(name).gravcomp = 1
        self._add_follow(spec)
        return spec

    def _reach(self, rotation: np.ndarray, position: np.ndarray) -> np.ndarray:
        """Return the robot's joints (6,) at an interface pose; raise InputError where it cannot reach it."""
        try:
            return robot_pose_for(load_robot(self.path).compile(), rotation, position)
        except (ValueError, np.linalg.LinAlgError) as error:
            expected = "a twin that reaches a standing person's pelvis"
            raise InputError(self.path, "", str(error), expected, "Check its geometry.") from error

    def _add_follow(self, spec: mujoco.MjSpec) -> None:
        """Add the velocity servo of the base, limited in force."""
        follow = self._follow
        spec.add_actuator(
            name="follow",
            trntype=mujoco.mjtTrn.mjTRN_JOINT,
            target="base_x",
            gaintype=mujoco.mjtGain.mjGAIN_FIXED,
            gainprm=[follow["speed_gain"]] + [0] * 9,
            biastype=mujoco.mjtBias.mjBIAS_AFFINE,
            biasprm=[0, 0, -follow["speed_gain"]] + [0] * 7,
            forcerange=[-follow["force_cap_n"], follow["force_cap_n"]],
            forcelimited=mujoco.mjtLimited.mjLIMITED_TRUE,
        )

    def bind(self, model: mujoco.MjModel, batch: mujoco.batch.Batch, cap: np.ndarray) -> None:
        """Take model, simulations and caps, see `WalkingRobot.bind`."""
        self._model, self._batch, self._cap = model, batch, cap
        self._base = int(model.joint("base_x").qposadr[0])
        self._stiffness, self._damping, self._armature = (
            batch.expand(n) for n in ("jnt_stiffness", "dof_damping", "dof_armature")
        )

    def standing(self) -> np.ndarray:
        """Return joint positions (n, 6) while the person stands."""
        return np.tile(self._stand, (len(self._cap), 1))

    def multiply(self, rows: slice, constant: str, factor: float) -> None:
        """Multiply stiffness and damping of an axis of `COMPLIANCES`."""
        joint = self._model.joint(COMPLIANCES[constant]).id
        dof = int(self._model.jnt_dofadr[joint])
        own = float(self._model.dof_damping[dof])
        self._stiffness[rows, joint] *= factor
        self._damping[rows, dof] *= factor
        # the plant centres its steps by an armature of -d h / 2, which follows the damping
        self._armature[rows, dof] -= (factor - 1) * own * self._model.opt.timestep / 2

    def start(self, speed: float) -> None:
        """Begin with the person's speed as the robot sees it, and with the distance of standing."""
        self._pelvis_speed = np.full(len(self._cap), speed)

    def command(self, root: RootState, control_s: float) -> np.ndarray:
        """Command the base: the person's speed as the robot sees it, and the distance of standing, under the cap."""
        follow, base = self._follow, self._batch.bind("qpos")[:, self._base]
        share = min(1.0, control_s / follow["speed_filter_s"])
        self._pelvis_speed += (root.velocity[:, 0] - self._pelvis_speed) * share
        # the distance that the robot keeps is the one of standing
        gap = root.position[:, 0] + self._stand[0] - base
        speed = np.clip(self._pelvis_speed + follow["distance_gain_per_s"] * gap, 0, self._cap)
        return np.asarray(speed[:, None])
