"""The simulated plant: robot twin, strap of six joints and a pelvis that follows its path and feels no reaction.

The pelvis hangs at the end of the robot's own chain, behind the six strap joints in reverse (interface, hinges z y x,
slides x y z, pelvis), as a body of immense inertia. Its path is imposed by a position and velocity servo with
acceleration feed-forward. The strap's wrench moves it by less than a micrometre, so it is a kinematic input, and no
loop has to be closed: the six strap joints are exactly the six coordinates q of the interface, their stiffness, damping
and limits are MuJoCo's own. A weld would err by 0.2-0.4 mm and cost about twice the time (benchmarks/welded.py).

Steps are centred: the semi-implicit Euler step is a leapfrog whose velocities live half a step late, and implicit
joint damping d acts as an extra inertia d h / 2 on it. An armature of -d h / 2 on each damped joint removes that
first-order error, which leaves second order (measured: benchmarks/plant.py).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import mujoco
import numpy as np

from real2sim.errors import InputError
from real2sim.geometry import AXES
from real2sim.system.mjcf import read_model, without_drives

if TYPE_CHECKING:
    from real2sim.settings import PlantSettings

ROBOT_JOINTS = ("base_x", "base_y", "base_yaw", "arm_lift", "arm_roll", "arm_pitch")
STRAP_JOINTS = tuple(f"strap_{axis}" for axis in AXES)
INTERFACE_SITES = ("interface_left", "interface_right")
_SENSORS = (*INTERFACE_SITES, "pelvis")

# Inertia of the pelvis stand-in: 10^4 robots, so that a strap force of 1 kN moves it by 50 nm against the servo
PELVIS_MASS = 1e6
PELVIS_INERTIA = 1e5
# Servo in units of the time step: all of a velocity error and half of a position error are made good in one step
SERVO_POSITION, SERVO_VELOCITY = 0.5, 1.0


@dataclass(frozen=True)
class RestPose:
    """Pose (R0, p0) of the interface in the pelvis frame where q = 0: (3, 3) and (3,) [m]."""

    rotation: np.ndarray
    position: np.ndarray


@dataclass(frozen=True)
class JointLimits:
    """Joint limits of the interface, (6,) each [m, rad]."""

    lower: np.ndarray
    upper: np.ndarray


def load_robot(path: Path) -> mujoco.MjSpec:
    """Read a robot twin without drives of its own, and check that it has the names that the plant needs.

    Raises
    ------
    InputError
        Where the file does not compile, a body, joint or site that the plant needs is missing, or the interface's
        left and right site are exchanged.
    """
    spec = read_model(path)
    missing = (
        [f"body {n}" for n in ("base", "arm", "interface") if spec.body(n) is None]
        + [f"joint {n}" for n in ROBOT_JOINTS if spec.joint(n) is None]
        + [f"site {n}" for n in INTERFACE_SITES if spec.site(n) is None]
    )
    if missing:
        raise InputError(
            path,
            "",
            f"no {', '.join(missing)}",
            "the names of the robot twin (docs, own robot)",
            "Rename them.",
            "model_names",
        )
    _check_sides(path, spec)
    without_drives(spec)
    return spec


def _check_sides(path: Path, spec: mujoco.MjSpec) -> None:
    """Refuse interface sites that are not left and right of each other along y, as the markers IF_L and IF_R are."""
    left, right = (np.array(spec.site(name).pos) for name in INTERFACE_SITES)
    along = left - right
    if along[1] > 0 and np.argmax(np.abs(along)) == 1:
        return
    found = f"interface_left at {left.round(3).tolist()} and interface_right at {right.round(3).tolist()} m"
    expected = "interface_left on the +y side (left) of the body interface, interface_right on its -y side"
    remedy = "Exchange the names of the two sites, or turn the body's frame: x forward, y left, z up."
    place = f"sites {', '.join(INTERFACE_SITES)}"
    raise InputError(path, place, found, expected, remedy, "site_sides")


def interface_site_offset(robot: mujoco.MjModel) -> np.ndarray:
    """Middle of the two interface sites in the interface body's frame, (3,) [m]."""
    return np.asarray(np.mean([robot.site(name).pos for name in INTERFACE_SITES], axis=0))


def robot_pose_for(robot: mujoco.MjModel, rotation: np.ndarray, position: np.ndarray) -> np.ndarray:
    """Robot joint positions (6,) that put the interface at a pose of the world (inverse kinematics by Newton).

    ``rotation`` (3, 3) and ``position`` (3,) [m] are those of the interface midpoint, order `ROBOT_JOINTS`.
    Raises ValueError where the robot cannot reach the pose.
    """
    data = mujoco.MjData(robot)
    body = robot.body("interface").id
    offset = interface_site_offset(robot)
    address = [robot.joint(name).qposadr[0] for name in ROBOT_JOINTS]
    dofs = [robot.joint(name).dofadr[0] for name in ROBOT_JOINTS]
    jac_p, jac_r = np.zeros((3, robot.nv)), np.zeros((3, robot.nv))
    for _ in range(50):
        mujoco.mj_kinematics(robot, data)
        mujoco.mj_comPos(robot, data)
        r_now = data.xmat[body].reshape(3, 3)
        point = data.xpos[body] + r_now @ offset
        error_r = rotation @ r_now.T
        vector = np.array(
            [error_r[2, 1] - error_r[1, 2], error_r[0, 2] - error_r[2, 0], error_r[1, 0] - error_r[0, 1]]
        )
        # half the skew part is sin(angle) axis: exact at convergence, contracting up to 90 degrees
        error = np.concatenate([position - point, vector / 2])
        if np.abs(error).max() < 1e-12:
            return np.asarray(data.qpos[address].copy())
        mujoco.mj_jac(robot, data, jac_p, jac_r, point, body)
        data.qpos[address] += np.linalg.solve(np.vstack([jac_p, jac_r])[:, dofs], error)
    if np.abs(error).max() < 1e-9:
        return np.asarray(data.qpos[address].copy())
    raise ValueError(f"the robot twin cannot reach the interface pose at {np.round(position, 3)} m")


def interface_pose_at(robot: mujoco.MjModel, joints: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rotation (3, 3) and midpoint (3,) [m, world] of the interface at robot joints (6,), order `ROBOT_JOINTS`."""
    data = mujoco.MjData(robot)
    for name, value in zip(ROBOT_JOINTS, joints, strict=True):
        data.joint(name).qpos = value
    mujoco.mj_kinematics(robot, data)
    rotation = data.body("interface").xmat.reshape(3, 3).copy()
    return rotation, data.body("interface").xpos + rotation @ interface_site_offset(robot)


def mass_on_base(model: mujoco.MjModel, body: str = "") -> tuple[float, np.ndarray]:
    """Return the mass [kg] that the base moves, and the moment (2,) [kg m] of what turns with it.

    The moment is mass times the horizontal place of its centre, from the axis of ``base_yaw``, in the model's own pose
    and in the heading of ``body`` or else of the world. Where a positive angle turns clockwise, its sign is changed.
    Without these joints, the mass is that of the whole model and the moment zero.
    """
    x, yaw = (mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_JOINT, ROBOT_JOINTS[i]) for i in (0, 2))
    if min(x, yaw) < 0:
        return float(model.body_mass.sum()), np.zeros(2)
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    mujoco.mj_comPos(model, data)
    turning = model.jnt_bodyid[yaw]
    moment = model.body_subtreemass[turning] * (data.subtree_com[turning] - data.xanchor[yaw])
    moment *= np.sign(data.xaxis[yaw, 2])
    frame = data.body(body).xmat.reshape(3, 3) if body else np.eye(3)
    heading = np.arctan2(frame[1, 0], frame[0, 0])
    c, s = np.cos(heading), np.sin(heading)
    turned = np.array([c * moment[0] + s * moment[1], c * moment[1] - s * moment[0]])
    return float(model.body_subtreemass[model.jnt_bodyid[x]]), turned


def impedances(robot_settings: Mapping[str, Any], controller: str) -> dict[str, dict[str, float]]:
    """Stiffness and damping of the robot's joints by name, from the slice ``robot`` of the configuration."""
    base, arm = robot_settings[controller], robot_settings["arm"]
    return {
        **{f"base_{name}": base[name] for name in ("x", "y", "yaw")},
        **{f"arm_{name}": arm[name] for name in ("lift", "roll", "pitch")},
    }


# Inertial constants of the robot twin: the body and which of its mass (None) or inertia's axes
INERTIAL_CONSTANTS: dict[str, tuple[str, int | None]] = {
    "base.mass": ("base", None),
    "base.inertia_yaw": ("base", 2),
    "arm.mass": ("arm", None),
    "arm.inertia_roll": ("arm", 0),
    "arm.inertia_pitch": ("arm", 1),
    "interface.mass": ("interface", None),
}


def drop_geoms(spec: mujoco.MjSpec) -> None:
    """Take away shapes of bodies whose inertia is written down: nothing touches, but each costs time at every step."""
    if spec.compiler.inertiafromgeom == mujoco.mjtInertiaFromGeom.mjINERTIAFROMGEOM_TRUE:
        return
    for body in spec.bodies:
        if body.explicitinertial:
            for geom in list(body.geoms):
                spec.delete(geom)


def _scale_inertia(spec: mujoco.MjSpec, key: str, factor: float) -> None:
    name, axis = INERTIAL_CONSTANTS[key]
    body = spec.body(name)
    if not body.explicitinertial:
        raise ValueError(f"body {name} has no <inertial>: {key} cannot be scaled")
    if axis is None:
        body.mass *= factor
    else:
        inertia = np.array(body.inertia)
        inertia[axis] *= factor
        body.inertia = inertia


def plant_spec(
    robot: Path,
    robot_settings: Mapping[str, Any],
    plant_settings: PlantSettings,
    rest: RestPose,
    limits: JointLimits | None,
    start: np.ndarray,
    reference_rotation: np.ndarray,
    reference_origin: np.ndarray,
    controller: str = "hold",
    scale: dict[str, float] | None = None,
) -> mujoco.MjSpec:
    """Describe the plant, the strap without stiffness and damping (set them per simulation, see `replay.Replay`).

    Parameters
    ----------
    robot
        MJCF of the robot twin.
    robot_settings, plant_settings
        The slices ``robot`` and ``plant`` of the configuration.
    rest, limits
        Of the interface; None for no limits.
    start
        (6,) robot joints in the start pose, where the controller's springs rest.
    reference_rotation, reference_origin
        Frame of the pelvis drive in the world.
    scale
        Factors on inertial constants of the robot by name (`INERTIAL_CONSTANTS`), to see what hangs on them.
    """
    spec = load_robot(robot)
    drop_geoms(spec)
    for key, factor in (scale or {}).items():
        _scale_inertia(spec, key, factor)
    h = float(plant_settings["timestep_s"])
    spec.option.timestep = h
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_EULER
    spec.option.cone = mujoco.mjtCone.mjCONE_PYRAMIDAL
    # the arm works about gravity balance and the base in the plane: weight does no work on the plant
    spec.option.disableflags |= mujoco.mjtDisableBit.mjDSBL_GRAVITY | mujoco.mjtDisableBit.mjDSBL_CONTACT
    _hold_robot(spec, impedances(robot_settings, controller), start)
    middle = (np.array(spec.site("interface_left").pos) + np.array(spec.site("interface_right").pos)) / 2
    pelvis = hang_segment(spec.body("interface"), "pelvis", "pelvis", middle, rest)
    add_strap(pelvis, limits, plant_settings)
    drive_segment(spec, "pelvis", RestPose(reference_rotation, reference_origin), h)
    for name in _SENSORS:
        spec.add_sensor(
            name=f"position_{name}",
            type=mujoco.mjtSensor.mjSENS_FRAMEPOS,
            objtype=mujoco.mjtObj.mjOBJ_SITE,
            objname=name,
        )
    return spec


def _hold_robot(spec: mujoco.MjSpec, impedance_of: dict[str, dict[str, float]], start: np.ndarray) -> None:
    """Give the robot's joints their controller's impedance, at rest at joint positions ``start`` (6,)."""
    h = spec.option.timestep
    for name, impedance in impedance_of.items():
        joint = spec.joint(name)
        joint.stiffness = [impedance["stiffness"], 0, 0]
        joint.damping = [impedance["damping"], 0, 0]
        joint.armature = joint.armature - impedance["damping"] * h / 2
        joint.springref = start[ROBOT_JOINTS.index(name)]


def hang_segment(
    carrier: mujoco.MjsBody, name: str, site: str, middle: np.ndarray, rest: RestPose
) -> mujoco.MjsBody:
    """Return a new body of immense inertia behind the interface, without joints, with a site at its origin.

    Parameters
    ----------
    carrier
        The body of the interface.
    name, site
        Of the new body and of its site.
    middle
        (3,) where the interface's joints turn, in the carrier [m].
    rest
        Pose of the interface in the new body where all joints are zero.
    """
    quat = np.zeros(4)
    mujoco.mju_mat2Quat(quat, rest.rotation.T.flatten())
    segment = carrier.add_body(
        name=name,
        pos=middle,
        quat=quat,
        mass=PELVIS_MASS,
        ipos=-rest.position,
        inertia=[PELVIS_INERTIA] * 3,
        explicitinertial=True,
    )
    segment.add_site(name=site, pos=-rest.position)
    return segment


def add_strap(pelvis: mujoco.MjsBody, limits: JointLimits | None, plant_settings: PlantSettings) -> None:
    """Add the strap's six joints in reverse, hinges z y x before slides x y z, and their limits."""
    hinge, slide = mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_SLIDE
    axes = dict(zip(AXES, [*np.eye(3), *np.eye(3)], strict=True))
    for axis in ("rz", "ry", "rx", "tx", "ty", "tz"):
        joint = pelvis.add_joint(
            name=f"strap_{axis}", type=hinge if axis[0] == "r" else slide, axis=-axes[axis]
        )
        if limits is not None:
            i = AXES.index(axis)
            joint.range = [limits.lower[i], limits.upper[i]]
            joint.limited = mujoco.mjtLimited.mjLIMITED_TRUE
            joint.solref_limit = plant_settings["limit_solref"]
            joint.solimp_limit = plant_settings["limit_solimp"]


def drive_segment(spec: mujoco.MjSpec, site: str, frame: RestPose, timestep: float) -> None:
    """Add a position and velocity servo on the six coordinates of a segment's site in a frame of the world."""
    quat = np.zeros(4)
    mujoco.mju_mat2Quat(quat, frame.rotation.flatten())
    spec.worldbody.add_site(name=f"{site}_reference", pos=frame.position, quat=quat)
    kp, kd = servo_gains(timestep)
    for i, axis in enumerate(AXES):
        inertia = PELVIS_MASS if i < 3 else PELVIS_INERTIA
        spec.add_actuator(
            name=f"{site}_{axis}",
            trntype=mujoco.mjtTrn.mjTRN_SITE,
            target=site,
            refsite=f"{site}_reference",
            gear=np.eye(6)[i],
            gaintype=mujoco.mjtGain.mjGAIN_FIXED,
            gainprm=[inertia * kp] + [0] * 9,
            biastype=mujoco.mjtBias.mjBIAS_AFFINE,
            biasprm=[0, -inertia * kp, -inertia * kd] + [0] * 7,
        )


def compiled(spec: mujoco.MjSpec, robot: Path) -> mujoco.MjModel:
    """Compile a plant; raises InputError naming the robot twin (MJCF) where MuJoCo refuses it."""
    try:
        return spec.compile()
    except ValueError as error:
        raise InputError(robot, "", str(error), "an MJCF that compiles", "Correct the model.") from error


def servo_gains(timestep: float) -> tuple[float, float]:
    """Position and velocity gain of the pelvis servo per unit of inertia [1/s^2, 1/s]."""
    return SERVO_POSITION / timestep**2, SERVO_VELOCITY / timestep
