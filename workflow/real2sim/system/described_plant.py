"""The plant of a described system: its MJCF, impedances of its controllers, interface and drive."""

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np

from real2sim.errors import InputError
from real2sim.system.description import FORCE, MASS, PATH, POSE, System
from real2sim.system.mjcf import read_model, without_drives
from real2sim.system.plant import PELVIS_INERTIA, PELVIS_MASS, RestPose, servo_gains

# Inertia of a joint that is moved along a path: the machine's forces do not move it against its servo [kg, kg m2]
PATH_INERTIA = 1e7
_SITE = "driven"
LETTERS = ("tx", "ty", "tz", "rx", "ry", "rz")


@dataclass(frozen=True)
class Anchor:
    """Anchor of the segment: ``middle`` (3,) [m] of the interface's markers in its body, and the rest pose there."""

    middle: np.ndarray
    rest: RestPose


def load_model(system: System) -> mujoco.MjSpec:
    """Read the MJCF of a system and check that it has what the description names.

    Raises
    ------
    InputError
        Naming the file, where it does not compile or a joint, body or site is missing.
    """
    spec = read_model(system.model)
    own = [a.joint for a in system.axes if a.direction is None]
    joints = [*system.machine_joints, *own, *system.drive.columns, *(o.joint for o in system.outputs)]
    missing = [f"joint {n}" for n in dict.fromkeys(joints) if spec.joint(n) is None]
    missing += [f"site {s}" for s in (system.markers.sites or {}).values() if spec.site(s) is None]
    bodies = [system.body] if system.body else []
    bodies += [p.of for p in system.parameters if p.sets == MASS]
    missing += [f"body {n}" for n in dict.fromkeys(bodies) if spec.body(n) is None]
    if missing:
        raise InputError(
            system.model,
            "",
            f"no {', '.join(missing)}",
            f"what {system.name}'s system.yaml names",
            "Correct either of them.",
            "model_names",
        )
    _check_types(spec, system)
    system.check_units()
    return spec


def _check_types(spec: mujoco.MjSpec, system: System) -> None:
    """Refuse an axis whose type is not that of its joint: its units would be wrong."""
    hinge, slide = mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_SLIDE
    for axis in system.axes:
        if axis.direction is not None:
            continue
        kind = spec.joint(axis.joint).type
        if kind != (hinge if axis.rotational else slide):
            said = "hinge" if axis.rotational else "slide"
            names = {hinge: "a hinge", slide: "a slide"}
            raise InputError(
                system.model,
                f"joint {axis.joint}",
                f"{names.get(kind, 'neither hinge nor slide')}, and type: {said} in the description of {system.name}",
                "the type of the joint in interface.axes (slide where it says none)",
                f"Write type: {'slide' if axis.rotational else 'hinge'} for the axis {axis.name} in the description."
                if kind in names
                else "Model the interface by hinges and slides.",
                "value",
            )


def plant_of(system: System, timestep: float, anchor: Anchor | None, frame: RestPose | None) -> mujoco.MjSpec:
    """Describe the plant, its parameters and the rest of its springs left to the simulations.

    Parameters
    ----------
    anchor
        Of the driven segment, for a system that is driven by a pose.
    frame
        Reference frame of the drive in the world, for the same.
    """
    spec = load_model(system)
    without_drives(spec)
    spec.option.timestep = timestep
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_EULER
    spec.option.cone = mujoco.mjtCone.mjCONE_PYRAMIDAL
    spec.option.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONTACT)
    for joint in system.machine:
        if joint.impedance is not None:
            described = spec.joint(joint.name)
            described.stiffness = [joint.impedance.stiffness, 0, 0]
            described.damping = [joint.impedance.damping, 0, 0]
            described.armature = described.armature - joint.impedance.damping * timestep / 2
    if system.drive.by == POSE and anchor is not None and frame is not None:
        _hang_segment(spec, system, anchor)
        _drive_by_pose(spec, frame, timestep)
    elif system.drive.by == PATH:
        _drive_by_path(spec, system, timestep)
    elif system.drive.by == FORCE:
        for driven in system.drive.columns:
            spec.add_actuator(
                name=f"drive_{driven}", trntype=mujoco.mjtTrn.mjTRN_JOINT, target=driven
            ).set_to_motor()
    for parameter in system.parameters:
        if parameter.sets == "offset":
            axis = system.axes[system.axis_names.index(parameter.of)]
            spec.add_actuator(
                name=f"offset_{axis.joint}", trntype=mujoco.mjtTrn.mjTRN_JOINT, target=axis.joint
            ).set_to_motor()
    return spec


def rests_of(system: System, model: mujoco.MjModel) -> np.ndarray:
    """Return the coordinates (axes,) [m, rad] at which the springs of the axes rest in a compiled plant."""
    return np.array([model.qpos_spring[model.joint(name).qposadr[0]] for name in system.axis_joints])


def own_actuators(system: System) -> list[str]:
    """Return the actuators of a system's MJCF, by name or number: `plant_of` leaves them out."""
    return [a.name or f"number {i + 1}" for i, a in enumerate(load_model(system).actuators)]


def _hang_segment(spec: mujoco.MjSpec, system: System, anchor: Anchor) -> None:
    """Add the driven segment behind the interface's joints, hinges of the last axis first, then the slides."""
    quat = np.zeros(4)
    mujoco.mju_mat2Quat(quat, anchor.rest.rotation.T.flatten())
    segment = spec.body(system.body).add_body(
        name=system.segment,
        pos=anchor.middle,
        quat=quat,
        mass=PELVIS_MASS,
        ipos=-anchor.rest.position,
        inertia=[PELVIS_INERTIA] * 3,
        explicitinertial=True,
        gravcomp=1,  # its path is known, and no servo holds such a mass without a sag
    )
    made = [axis for axis in system.axes if axis.direction is not None]
    hinges = [axis for axis in reversed(made) if axis.rotational]
    for axis in [*hinges, *(axis for axis in made if not axis.rotational)]:
        kind = mujoco.mjtJoint.mjJNT_HINGE if axis.rotational else mujoco.mjtJoint.mjJNT_SLIDE
        direction = -np.array(axis.direction)
        segment.add_joint(name=axis.joint, type=kind, axis=direction / np.linalg.norm(direction))
    segment.add_site(name=_SITE, pos=-anchor.rest.position)


def _drive_by_pose(spec: mujoco.MjSpec, frame: RestPose, timestep: float) -> None:
    """Add a position and velocity servo on all six coordinates of the segment."""
    quat = np.zeros(4)
    mujoco.mju_mat2Quat(quat, frame.rotation.flatten())
    spec.worldbody.add_site(name=f"{_SITE}_reference", pos=frame.position, quat=quat)
    kp, kd = servo_gains(timestep)
    for i, letter in enumerate(LETTERS):
        inertia = PELVIS_MASS if i < 3 else PELVIS_INERTIA
        spec.add_actuator(
            name=f"{_SITE}_{letter}",
            trntype=mujoco.mjtTrn.mjTRN_SITE,
            target=_SITE,
            refsite=f"{_SITE}_reference",
            gear=np.eye(6)[i],
            gaintype=mujoco.mjtGain.mjGAIN_FIXED,
            gainprm=[inertia * kp] + [0] * 9,
            biastype=mujoco.mjtBias.mjBIAS_AFFINE,
            biasprm=[0, -inertia * kp, -inertia * kd] + [0] * 7,
        )


def _drive_by_path(spec: mujoco.MjSpec, system: System, timestep: float) -> None:
    """Let driven joints follow a path against an immense inertia of their own."""
    kp, kd = (PATH_INERTIA * gain for gain in servo_gains(timestep))
    for joint in system.drive.columns:
        spec.joint(joint).armature = PATH_INERTIA
        actuator = spec.add_actuator(name=f"drive_{joint}", trntype=mujoco.mjtTrn.mjTRN_JOINT, target=joint)
        actuator.gainprm = [kp] + [0] * 9
        actuator.biastype = mujoco.mjtBias.mjBIAS_AFFINE
        actuator.biasprm = [0, -kp, -kd] + [0] * 7


DRIVEN_SITE = _SITE
