"""The study's robot in a coupled walk: two driven wheels, a passive planar arm, and its follow law.

Facts are those of its authors' earlier public model (resources/systems/drba; `twin.study_robot` of the configuration
names the source of each number). The base rolls: it drives and turns, and yields sideways only as far as its tyres
creep. The arm is a five-bar of six passive hinges whose loop MuJoCo closes; height, roll and pitch of the interface are
those of the base. The speed follows the distance between arm base and interface.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import mujoco
import numpy as np

from real2sim.errors import InputError
from real2sim.study.twin.env import RootState
from real2sim.study.twin.robots import WalkingRobot
from real2sim.system.mjcf import read_model
from real2sim.system.plant import JointLimits, RestPose, add_strap, drop_geoms, hang_segment

if TYPE_CHECKING:
    from real2sim.settings import PlantSettings, TwinStudyRobotSettings

_SIDES = ("left", "right")
_ARM = tuple(f"arm_{side}_{i}" for side in _SIDES for i in (1, 2, 3))
_LINKS = ("distal", "fore", "to_interface")
_BODIES = ("base", *(f"wheel_{side}" for side in _SIDES), *(f"{b}_{s}" for s in _SIDES for b in _LINKS))


def wheel_speeds(
    distance: np.ndarray,
    bearing: np.ndarray,
    yaw: np.ndarray,
    cap: np.ndarray,
    law: TwinStudyRobotSettings,
    track: float,
    gain: np.ndarray | float = 1.0,
    turn: np.ndarray | float = 1.0,
) -> np.ndarray:
    """Return the speeds (n, 2) of the left and the right wheel that the follow law asks for [m/s].

    Parameters
    ----------
    distance, bearing, yaw
        Of the interface from the middle between the distal hinges, (n,) each [m, rad, rad].
    cap
        Highest speed (n,) [m/s].
    law
        Slice ``twin.study_robot`` of the configuration.
    track
        Distance between the wheels [m].
    gain, turn
        Factors on the slope of the speed law, and on both ways of turning.
    """
    slope = gain * law["full_speed_m_per_s"] / (law["full_distance_m"] - law["stop_distance_m"])
    curved = np.abs(bearing) > np.radians(law["straight_deg"])
    sine = np.where(curved, np.sin(bearing), 1.0)
    # the circle that leaves the arm base straight ahead and meets the interface
    arc = np.where(curved, distance * bearing / sine, distance)
    curvature = np.where(curved, 2 * np.sin(bearing) / np.maximum(distance, 1e-6), 0.0)
    speed = np.clip(slope * (arc - law["stop_distance_m"]), 0.0, cap)
    turning = law["arc_share"] * speed * curvature * track / 2
    first, full = np.radians(law["yaw_from_deg"]), np.radians(law["yaw_full_deg"])
    share = np.clip((np.abs(yaw) - first) / (full - first), 0.0, 1.0)
    turning += law["yaw_share"] * law["yaw_speed_m_per_s"] * share * np.sign(yaw)
    return np.column_stack([speed - turn * turning, speed + turn * turning])


class StudyRobot(WalkingRobot):
    """The study's robot, see the module.

    Parameters
    ----------
    path
        Its MJCF (resources/systems/drba/drba.xml).
    law
        Slice ``twin.study_robot`` of the configuration.
    """

    name = "study"
    joints = ("base_x", "base_y", "base_yaw", *_ARM)
    commands = ("drive_left", "drive_right", "grip")
    constants = ("gain", "turn", "arm_mass", "arm_friction")

    def __init__(self, path: Path, law: TwinStudyRobotSettings):
        self.path, self._law = path, law

    # ---------------------------------------------------------------- model

    def describe(
        self,
        plant: PlantSettings,
        rest: RestPose,
        limits: JointLimits | None,
        stand: tuple[np.ndarray, np.ndarray],
    ) -> mujoco.MjSpec:
        """Describe the robot at the height of the person's interface, see `WalkingRobot.describe`."""
        spec = read_model(self.path)
        missing = [name for name in (*_BODIES, "interface") if spec.body(name) is None]
        if missing:
            expected = "the bodies of resources/systems/drba/drba.xml"
            raise InputError(self.path, "", f"no body {', '.join(missing)}", expected, "Rename them.")
        self._stand = stand[1]
        middle = np.mean([spec.site(f"interface_{side}").pos for side in _SIDES], axis=0)
        self._read_arm(spec, middle)
        self._lift(spec, middle)
        drop_geoms(spec)
        _set_options(spec, float(plant["timestep_s"]))
        self._roll(spec)
        pelvis = hang_segment(spec.body("interface"), "pelvis", "pelvis", middle, rest)
        add_strap(pelvis, limits, plant)
        return spec

    def _read_arm(self, spec: mujoco.MjSpec, middle: np.ndarray) -> None:
        """Keep the arm's lengths: vectors (3, 2) from hinge to hinge and to the interface, by side [m]."""
        place = {name: np.array(spec.body(name).pos)[:2] for name in (*_BODIES, "interface")}
        self.track = float(place["wheel_left"][1] - place["wheel_right"][1])
        self.radius = float(spec.geom("wheel_left").size[0])
        self._arm_base = {side: place[f"distal_{side}"] for side in _SIDES}
        left = [place["fore_left"], place["to_interface_left"], place["interface"] + middle[:2]]
        home = self._arm_base["left"] + sum(left)
        right = [place["fore_right"], place["to_interface_right"]]
        right.append(home - self._arm_base["right"] - sum(right))
        self._links = {"left": np.array(left), "right": np.array(right)}

    def _lift(self, spec: mujoco.MjSpec, middle: np.ndarray) -> None:
        """Put the arm at the height of the person's interface, as the sit-to-stand module does."""
        base, carrier = spec.body("base"), spec.body("interface")
        height = base.pos[2] + spec.body("distal_left").pos[2] + carrier.pos[2] + middle[2]
        for side in _SIDES:
            spec.body(f"distal_{side}").pos[2] += self._stand[2] - height

    def _roll(self, spec: mujoco.MjSpec) -> None:
        """Let the base move in the plane on two driven wheels that hardly slide sideways."""
        base, law = spec.body("base"), self._law
        wheels_turn, wheels_roll = (spec.joint(name).armature for name in ("base_yaw", "base_forward"))
        for joint in list(base.joints):
            spec.delete(joint)
        slide, hinge = mujoco.mjtJoint.mjJNT_SLIDE, mujoco.mjtJoint.mjJNT_HINGE
        base.add_joint(name="base_x", type=slide, axis=[1, 0, 0], armature=wheels_roll)
        base.add_joint(name="base_y", type=slide, axis=[0, 1, 0])
        base.add_joint(name="base_yaw", type=hinge, axis=[0, 0, 1], armature=wheels_turn)
        base.add_site(name="grip", pos=[0, 0, 0])
        # the proportional part of the wheels' speed controller, and the damping of their axles, as forces on the road
        servo = law["wheel_p"] * law["gear"] / self.radius**2
        for k, side in enumerate(_SIDES):
            base.add_site(name=f"drive_{side}", pos=[0, (0.5 - k) * self.track, 0])
            _add_servo(spec, f"drive_{side}", 0, servo, law["axle_damping"] / self.radius**2)
            spec.actuators[-1].forcelimited = mujoco.mjtLimited.mjLIMITED_TRUE
            spec.actuators[-1].forcerange = [-law["wheel_force_cap_n"], law["wheel_force_cap_n"]]
        _add_servo(spec, "grip", 1, 0.0, law["grip"])

    # ---------------------------------------------------------------- start

    def bind(self, model: mujoco.MjModel, batch: mujoco.batch.Batch, cap: np.ndarray) -> None:
        """Take model, simulations and caps, see `WalkingRobot.bind`."""
        self._model, self._batch, self._cap = model, batch, cap
        self._qpos = np.array([model.joint(j).qposadr[0] for j in self.joints])
        self._qvel = np.array([model.joint(j).dofadr[0] for j in self.joints])
        self._gain, self._turn = np.ones(len(cap)), np.ones(len(cap))
        self._mass, self._inertia, self._friction, self._damping = (
            batch.expand(n) for n in ("body_mass", "body_inertia", "dof_frictionloss", "dof_damping")
        )

    def standing(self) -> np.ndarray:
        """Return joint positions (n, 9): at the distance at which the law asks for the cap, within the arm's reach."""
        law = self._law
        slope = self._gain * law["full_speed_m_per_s"] / (law["full_distance_m"] - law["stop_distance_m"])
        distance = np.minimum(law["stop_distance_m"] + self._cap / slope, law["reach_m"])
        arm = {side: self._bend(side, distance) for side in _SIDES}
        base = np.zeros((len(distance), 3))
        base[:, 0] = self._stand[0] - self._arm_base["left"][0] - distance
        base[:, 1] = self._stand[1]
        return np.hstack([base, arm["left"], arm["right"]])

    def _bend(self, side: str, distance: np.ndarray) -> np.ndarray:
        """Return the hinges (n, 3) of a chain with the interface level, straight ahead at ``distance`` (n,)."""
        upper, fore, last = self._links[side]
        start = np.column_stack([distance, np.full_like(distance, -self._arm_base[side][1])])
        to = start - last
        a, b = np.linalg.norm(upper), np.linalg.norm(fore)
        reach = np.linalg.norm(to, axis=1)
        # the elbow stays on its side
        sign = np.sign(np.arctan2(upper[1], upper[0]))
        within = np.clip((a**2 + reach**2 - b**2) / (2 * a * reach), -1, 1)
        first = np.arctan2(to[:, 1], to[:, 0]) + sign * np.arccos(within)
        elbow = a * np.column_stack([np.cos(first), np.sin(first)])
        second = np.arctan2(to[:, 1] - elbow[:, 1], to[:, 0] - elbow[:, 0])
        q1 = first - np.arctan2(upper[1], upper[0])
        q2 = second - np.arctan2(fore[1], fore[0]) - q1
        return np.column_stack([_wrapped(q1), _wrapped(q2), _wrapped(-q1 - q2)])

    def multiply(self, rows: slice, constant: str, factor: float) -> None:
        """Multiply the slope of the speed law, its turns, or inertia or friction of the arm's links."""
        if constant in ("gain", "turn"):
            (self._gain if constant == "gain" else self._turn)[rows] *= factor
            return
        if constant == "arm_mass":
            links = [self._model.body(f"{b}_{s}").id for b in _LINKS for s in _SIDES]
            self._mass[rows, links] *= factor
            self._inertia[rows, links] *= factor
            return
        hinges = [self._model.joint(j).dofadr[0] for j in _ARM]
        self._friction[rows, hinges] *= factor
        # MuJoCo's fields of a damper hold the coefficients of a polynomial: the first is linear
        (self._damping if self._damping.ndim == 2 else self._damping[..., 0])[rows, hinges] *= factor

    # ---------------------------------------------------------------- control

    def start(self, speed: float) -> None:
        """Begin without a memory of speed errors."""
        self._error = np.zeros((len(self._cap), 2))

    def interface(self, arm: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return distance, bearing and yaw (n,) of the interface from the hinges (n, 3) of the left chain."""
        place = np.tile(self._arm_base["left"], (len(arm), 1))
        place[:, 1] -= self._middle_y
        angle = np.cumsum(arm, axis=1)
        for link, turned in zip(self._links["left"], angle.T, strict=True):
            c, s = np.cos(turned), np.sin(turned)
            place += np.column_stack([c * link[0] - s * link[1], s * link[0] + c * link[1]])
        place[:, 0] -= self._arm_base["left"][0]
        return np.hypot(*place.T), np.arctan2(place[:, 1], place[:, 0]), angle[:, 2]

    @property
    def _middle_y(self) -> float:
        return float(self._arm_base["left"][1] + self._arm_base["right"][1]) / 2

    def command(self, root: RootState, control_s: float) -> np.ndarray:
        """Command both wheels by the follow law; the integral of the speed error is added to the command."""
        law = self._law
        q = self._batch.bind("qpos")[:, self._qpos]
        v = self._batch.bind("qvel")[:, self._qvel]
        wanted = wheel_speeds(*self.interface(q[:, 3:6]), self._cap, law, self.track, self._gain, self._turn)
        along = np.cos(q[:, 2]) * v[:, 0] + np.sin(q[:, 2]) * v[:, 1]
        turning = 0.5 * self.track * v[:, 2]
        error = wanted - np.column_stack([along - turning, along + turning])
        ratio = law["wheel_i"] / law["wheel_p"]
        # the integral asks for no more than the wheels' largest force
        largest = law["wheel_force_cap_n"] * self.radius**2 / (law["wheel_p"] * law["gear"])
        self._error = np.clip(self._error + ratio * error * control_s, -largest, largest)
        return np.column_stack([wanted + self._error, np.zeros(len(wanted))])


def _set_options(spec: mujoco.MjSpec, timestep: float) -> None:
    """Set what a walk needs: weight, the time step, and the solver as MuJoCo has it by default."""
    spec.option.timestep = timestep
    spec.option.gravity = [0, 0, -9.81]
    spec.option.tolerance, spec.option.iterations = 1e-8, 100


def _add_servo(spec: mujoco.MjSpec, name: str, axis: int, gain: float, damping: float) -> None:
    """Add a force along an axis of the site of that name: ``gain`` times the speed error, and a damper [Ns/m]."""
    spec.add_actuator(
        name=name,
        trntype=mujoco.mjtTrn.mjTRN_SITE,
        target=name,
        gear=np.eye(6)[axis],
        gaintype=mujoco.mjtGain.mjGAIN_FIXED,
        gainprm=[gain] + [0] * 9,
        biastype=mujoco.mjtBias.mjBIAS_AFFINE,
        biasprm=[0, 0, -gain - damping] + [0] * 7,
    )


def _wrapped(angle: np.ndarray) -> np.ndarray:
    return (angle + np.pi) % (2 * np.pi) - np.pi
