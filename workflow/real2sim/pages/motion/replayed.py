"""The replay of a fitted trial with everything that a viewer wants to see recorded."""

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np

from real2sim.geometry import rotation_xyz
from real2sim.system.plant import ROBOT_JOINTS, STRAP_JOINTS
from real2sim.system.replay import Replay, centred

_KINDS = {
    "position": mujoco.mjtSensor.mjSENS_JOINTPOS,
    "velocity": mujoco.mjtSensor.mjSENS_JOINTVEL,
    "limit": mujoco.mjtSensor.mjSENS_JOINTLIMITFRC,
}


@dataclass(frozen=True)
class Replayed:
    """A replay at the trial's n samples.

    ``sites`` (n, 2, 3) interface left, right and ``pelvis`` (n, 3) [m, world], ``robot`` (n, 6) joints of the robot
    and ``q`` (n, 6) interface coordinates [m, rad], ``force`` (n, 6) generalised force on each of them [N, Nm].
    """

    sites: np.ndarray
    pelvis: np.ndarray
    robot: np.ndarray
    q: np.ndarray
    force: np.ndarray


class MotionReplay(Replay):
    """A `Replay` of one simulation that records robot, interface coordinates and what acts on them."""

    def _extend(self, spec: mujoco.MjSpec) -> None:
        asked = [("position", name) for name in ROBOT_JOINTS]
        asked += [(kind, name) for kind in _KINDS for name in STRAP_JOINTS]
        for kind, name in asked:
            spec.add_sensor(
                name=f"{kind}_{name}",
                type=_KINDS[kind],
                objtype=mujoco.mjtObj.mjOBJ_JOINT,
                objname=name,
            )

    @property
    def _middle(self) -> np.ndarray:
        """Coordinates (6,) [m, rad] halfway between the limits of the strap's joints."""
        return np.array([self.model.joint(name).range.mean() for name in STRAP_JOINTS])

    def record(self, parameters: np.ndarray) -> Replayed:
        """Simulate strap parameters (12,)."""
        raw = self._simulate(parameters[None])
        every = raw[0]

        def columns(kind: str, names: tuple[str, ...]) -> np.ndarray:
            chosen: np.ndarray = every[:, [self.model.sensor(f"{kind}_{name}").adr[0] for name in names]]
            return chosen

        q, rate = columns("position", STRAP_JOINTS), centred(columns("velocity", STRAP_JOINTS)[None])[0]
        # MuJoCo gives the size of what a limit pushes with
        pushes = np.where(q > self._middle, -1, 1) * columns("limit", STRAP_JOINTS)
        force = -q * parameters[:6] - rate * parameters[6:] + pushes
        samples = slice(None, None, self.stride)
        return Replayed(
            self._samples(raw)[0],
            every[samples, self._pelvis_columns],
            columns("position", ROBOT_JOINTS)[samples],
            q[samples],
            force[samples],
        )


def strap_wrench(force: np.ndarray, q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Force (n, 3) [N] and torque (n, 3) [Nm] of the strap on the robot's interface, about its origin, in pelvis axes.

    ``force`` (n, 6) are the generalised forces on the interface coordinates ``q`` (n, 6). The slides run along the
    pelvis axes; the torque h about hinges a follows from h = a^T torque.
    """
    first, both = q[:, 3:].copy(), q[:, 3:].copy()
    first[:, 1:], both[:, 2] = 0, 0
    axes = np.stack(
        [
            np.broadcast_to(np.eye(3)[0], (len(q), 3)),
            rotation_xyz(first)[:, :, 1],
            rotation_xyz(both)[:, :, 2],
        ],
        axis=1,
    )
    return force[:, :3], np.linalg.solve(axes, force[:, 3:, None])[:, :, 0]
