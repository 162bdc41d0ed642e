"""A described system in MuJoCo with a driven segment, stepped finely: what the generators are checked against."""

from __future__ import annotations

import mujoco
import numpy as np
from real2sim.system.description import System
from real2sim.verification.systems.segment_path import SegmentPath

# Against the machine's few kilograms the segment feels no reaction
MASS, INERTIA = 1e6, 1e6


def machine_spec(system: System, step_s: float) -> mujoco.MjSpec:
    """The MJCF of a system with the impedances of its YAML; velocities of MuJoCo's step are half a step late."""
    spec = mujoco.MjSpec.from_file(str(system.model))
    spec.option.timestep = step_s
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_EULER
    spec.option.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONTACT
    for joint in system.machine:
        if joint.impedance is not None:
            spec.joint(joint.name).stiffness = [joint.impedance.stiffness, 0, 0]
            spec.joint(joint.name).damping = [joint.impedance.damping, 0, 0]
    return spec


def add_segment(
    spec: mujoco.MjSpec, body: str, rest: np.ndarray, axes: list[tuple[str, str, float, float]]
) -> None:
    """Hang the segment behind the interface: hinges z, y, x, then slides, of (name, kind axis, stiffness, damping)."""
    segment = spec.body(body).add_body(
        name="segment", mass=MASS, ipos=-rest, inertia=[INERTIA] * 3, explicitinertial=True
    )
    kinds = {"r": mujoco.mjtJoint.mjJNT_HINGE, "t": mujoco.mjtJoint.mjJNT_SLIDE}
    order = sorted(axes, key=lambda a: ("rt".index(a[1][0]), "zyx".index(a[1][1])))
    for name, kind, stiffness, damping in order:
        joint = segment.add_joint(name=name, type=kinds[kind[0]], axis=-np.eye(3)["xyz".index(kind[1])])
        joint.stiffness, joint.damping = [stiffness, 0, 0], [damping, 0, 0]


def drive(
    model: mujoco.MjModel, start: np.ndarray, path: SegmentPath, trial: int, record: int, sites: list[str]
) -> np.ndarray:
    """Drive the segment along a path whose step is the model's; return sites (m, k, 3) at every ``record``-th step."""
    data = mujoco.MjData(model)
    data.qpos[: len(start)] = start
    h, out = model.opt.timestep, []
    segment = model.body("segment").id
    velocity = np.zeros(6)
    for k in range(len(path.time_s) - 1):
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        if k % record == 0:
            out.append([data.site(name).xpos.copy() for name in sites])
        mujoco.mj_fwdVelocity(model, data)
        mujoco.mj_objectVelocity(model, data, mujoco.mjtObj.mjOBJ_BODY, segment, velocity, 0)
        # velocity over the coming step that ends on the path
        error = path.position[k + 1, trial] - data.xipos[segment]
        turn = path.rotation[k + 1, trial] @ data.xmat[segment].reshape(3, 3).T
        vector = np.array([turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]]) / 2
        data.xfrc_applied[segment, :3] = MASS * (error / h - velocity[3:]) / h
        data.xfrc_applied[segment, 3:] = INERTIA * (vector / h - velocity[:3]) / h
        mujoco.mj_step(model, data)
    return np.array(out)
