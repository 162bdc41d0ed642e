"""Build the plant as a loop closed by a weld, to compare the library's plant with.

The pelvis is a servo-driven body of its own on six joints, the strap's six joints hang a plate on it, and a weld of
stiff impedance (solimp .999 .9999) closes the loop from the plate to the robot's interface. Both bodies of the weld
carry half of the interface's inertia, so that rigidly welded they are the interface.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import mujoco
import numpy as np
from mujoco.batch import Batch
from real2sim.geometry import AXES
from real2sim.system.plant import (
    INTERFACE_SITES,
    STRAP_JOINTS,
    drop_geoms,
    impedances,
    interface_site_offset,
    load_robot,
    servo_gains,
)
from real2sim.system.replay import Replay
from scipy.interpolate import make_interp_spline
from scipy.spatial.transform import Rotation

if TYPE_CHECKING:
    # not at run time: sysid_search.py runs without pyarrow
    from real2sim.recording.trial import TrialModel

PELVIS_JOINTS = ("x", "y", "z", "yaw", "pitch", "roll")
_PELVIS_AXES = ([1, 0, 0], [0, 1, 0], [0, 0, 1], [0, 0, 1], [0, 1, 0], [1, 0, 0])
# Lighter than the project's: MuJoCo's solver measures its tolerance by the mean inertia. 100 N move it by 0.1 um
PELVIS_MASS, PELVIS_INERTIA, TOLERANCE = 1e4, 1e3, 1e-12
SOLIMP = (0.999, 0.9999, 0.001, 0.5, 2.0)


def _quat(rotation: np.ndarray) -> np.ndarray:
    quat = np.zeros(4)
    mujoco.mju_mat2Quat(quat, rotation.flatten())
    return quat


class WeldedReplay:
    """Replays of a trial through the welded plant; `run` as that of `Replay`.

    ``model`` and ``own`` are the trial and its replay in the project's plant at the same time step, whose start pose is
    taken over; ``solref_s`` is the weld's time constant [s].
    """

    def __init__(
        self, model: TrialModel, own: Replay, robot: Path, settings: dict, *, nsim: int, solref_s: float
    ):
        h = own.model.opt.timestep
        trial, self.nstep, self.stride, self.nsim = model.trial, own.nstep, own.stride, nsim
        rest = trial.rest
        spec = load_robot(robot)
        drop_geoms(spec)
        twin = load_robot(robot).compile()
        spec.option.timestep, spec.option.tolerance = h, TOLERANCE
        spec.option.disableflags |= mujoco.mjtDisableBit.mjDSBL_GRAVITY | mujoco.mjtDisableBit.mjDSBL_CONTACT
        start = {
            name: own._start_state[0][own.model.joint(name).qposadr[0]]
            for name in (*impedances(settings["robot"], "hold"), *STRAP_JOINTS)
        }
        for name, impedance in impedances(settings["robot"], "hold").items():
            joint = spec.joint(name)
            joint.stiffness = [impedance["stiffness"], 0, 0]
            joint.damping = [impedance["damping"], 0, 0]
            joint.springref = start[name]
        interface, middle = spec.body("interface"), interface_site_offset(twin)
        interface.mass /= 2
        interface.inertia = np.array(interface.inertia) / 2
        reference, origin = own.drive.reference_rotation, own.drive.reference_origin
        pelvis = spec.worldbody.add_body(
            name="pelvis",
            pos=origin,
            quat=_quat(reference),
            mass=PELVIS_MASS,
            # without these MjSpec takes the body's own place
            ipos=[0, 0, 0],
            iquat=[1, 0, 0, 0],
            inertia=[PELVIS_INERTIA] * 3,
            explicitinertial=True,
        )
        slide, hinge = mujoco.mjtJoint.mjJNT_SLIDE, mujoco.mjtJoint.mjJNT_HINGE
        kp, kd = servo_gains(h)
        for i, (name, axis) in enumerate(zip(PELVIS_JOINTS, _PELVIS_AXES, strict=True)):
            pelvis.add_joint(name=f"pelvis_{name}", type=slide if i < 3 else hinge, axis=axis)
            inertia = PELVIS_MASS if i < 3 else PELVIS_INERTIA
            spec.add_actuator(
                name=f"pelvis_{name}",
                trntype=mujoco.mjtTrn.mjTRN_JOINT,
                target=f"pelvis_{name}",
                gaintype=mujoco.mjtGain.mjGAIN_FIXED,
                gainprm=[inertia * kp] + [0] * 9,
                biastype=mujoco.mjtBias.mjBIAS_AFFINE,
                biasprm=[0, -inertia * kp, -inertia * kd] + [0] * 7,
            )
        pelvis.add_site(name="pelvis")
        plate = pelvis.add_body(
            name="plate",
            pos=rest.position,
            quat=_quat(rest.rotation),
            mass=interface.mass,
            ipos=np.array(interface.ipos) - middle,
            iquat=interface.iquat,
            inertia=interface.inertia,
            explicitinertial=True,
        )
        for i, axis in enumerate(AXES):
            joint = plate.add_joint(
                name=f"strap_{axis}", type=slide if i < 3 else hinge, axis=rest.rotation.T @ np.eye(3)[i % 3]
            )
            if model.limits is not None:
                joint.range = [model.limits.lower[i], model.limits.upper[i]]
                joint.limited = mujoco.mjtLimited.mjLIMITED_TRUE
                joint.solref_limit = settings["plant"]["limit_solref"]
                joint.solimp_limit = settings["plant"]["limit_solimp"]
        weld = spec.add_equality(
            type=mujoco.mjtEq.mjEQ_WELD,
            objtype=mujoco.mjtObj.mjOBJ_BODY,
            name1="interface",
            name2="plate",
            solref=[solref_s, 1.0],
            solimp=SOLIMP,
        )
        weld.data = np.array([0, 0, 0, *middle, 1, 0, 0, 0, 1, 1])
        for name in (*INTERFACE_SITES, "pelvis"):
            spec.add_sensor(
                name=f"position_{name}",
                type=mujoco.mjtSensor.mjSENS_FRAMEPOS,
                objtype=mujoco.mjtObj.mjOBJ_SITE,
                objname=name,
            )
        self.spec, self.model = spec, spec.compile()
        self._control, pelvis_start, pelvis_rate = self._commands(trial, own, h)
        self._control = np.ascontiguousarray(np.broadcast_to(self._control, (nsim, *self._control.shape)))
        qpos, qvel = np.zeros(self.model.nq), np.zeros(self.model.nv)
        for name, value in start.items():
            qpos[self.model.joint(name).qposadr[0]] = value
        for i, name in enumerate(PELVIS_JOINTS):
            joint = self.model.joint(f"pelvis_{name}")
            qpos[joint.qposadr[0]], qvel[joint.dofadr[0]] = pelvis_start[i], pelvis_rate[i]
        for name in STRAP_JOINTS:
            rate = own._start_state[1][own.model.joint(name).dofadr[0]]
            qvel[self.model.joint(name).dofadr[0]] = rate
        self._start_state = qpos, qvel
        self._batch = Batch(self.model, nsim, 1)
        self._dofs = [self.model.joint(name).dofadr[0] for name in STRAP_JOINTS]
        self._joints = [self.model.joint(name).id for name in STRAP_JOINTS]
        self._stiffness, self._damping = (self._batch.expand(f) for f in ("jnt_stiffness", "dof_damping"))
        self._record = {"sensordata": np.empty((nsim, self.nstep, self.model.nsensordata))}

    def _commands(self, trial, own: Replay, h: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Controls (nstep, 6), and position and rate (6,) of the pelvis joints at the start."""
        reference, origin = own.drive.reference_rotation, own.drive.reference_origin
        good = np.isfinite(trial.pelvis_position).all(axis=1) & np.isfinite(trial.pelvis_rotation).all((1, 2))
        turns = Rotation.from_matrix(reference.T @ trial.pelvis_rotation[good]).as_euler("ZYX")
        place = (trial.pelvis_position[good] - origin) @ reference
        path = make_interp_spline(trial.time_s[good], np.hstack([place, np.unwrap(turns, axis=0)]), k=5)
        t = np.minimum(trial.time_s[0] + h * np.arange(self.nstep), trial.time_s[-1])
        half = np.maximum(t - h / 2, trial.time_s[0])
        kp, kd = servo_gains(h)
        command = path(t) + kd / kp * path(half, 1) + path(t, 2) / kp
        return command, path(t[0]), path(half[0], 1)

    def run(self, parameters: np.ndarray) -> np.ndarray:
        """Interface sites (nsim, n, 2, 3) [m, world] of parameters (nsim, 12)."""
        self._stiffness[:, self._joints] = parameters[:, :6]
        self._damping[:, self._dofs] = parameters[:, 6:]
        self._batch.reset(stage=mujoco.mjtStage.mjSTAGE_NONE)
        self._batch.bind("qpos")[:] = self._start_state[0]
        self._batch.bind("qvel")[:] = self._start_state[1]
        sensors = self._batch.rollout(self.nstep, self._control, record=("sensordata",), out=self._record)
        sites = sensors["sensordata"][:, :: self.stride, :6]
        return sites.reshape(*sites.shape[:2], 2, 3).copy()
