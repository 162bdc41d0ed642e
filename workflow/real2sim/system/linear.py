"""What small forces do to a simulation: a linear system that varies along the simulated motion.

MuJoCo gives state and sensors of one step as a linear function of state and control (`mjd_transitionFD`). Along the
motion of a simulation these matrices are the exact slope by any history of forces, so that thousands of histories cost
a matrix product a step instead of a simulation each. Forces on joints that follow a prescribed path move nothing at
all: what is seen of them is the force that holds the path.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Protocol

import mujoco
import numpy as np

from real2sim.system.replay import Simulated

# Step of the finite differences of MuJoCo [SI of state and control]
_STEP = 1e-6
# Forces that are followed side by side: as many as stay in the processor's cache
_CHUNK = 256


class ForceResponse(Protocol):
    """Change of the sensors of one simulation by small forces."""

    def sensors(self, forces: np.ndarray, columns: np.ndarray) -> np.ndarray:
        """Return the change of the sensors (p, n, s) by forces (p, n, j) at the samples of motors (j,)."""


class PrescribedMotion:
    """A simulation whose motors all act on joints that follow a prescribed path.

    The motion stays as it is. What holds a joint to its path gives way by the motor's force, exactly.

    Parameters
    ----------
    model
        The plant.
    shown
        Sensor by joint (both indices): the force that moves the joint along its path.
    """

    def __init__(self, model: mujoco.MjModel, shown: Mapping[int, int]):
        self._model, self._shown = model, dict(shown)

    def sensors(self, forces: np.ndarray, columns: np.ndarray) -> np.ndarray:
        """Return the change of the sensors (p, n, s) by forces (p, n, j) of motors (j,): as of `ForceResponse`."""
        out = np.zeros((*forces.shape[:2], self._model.nsensordata))
        for j, joint in enumerate(joints_of(self._model, columns)):
            if int(joint) in self._shown:
                out[:, :, self._shown[int(joint)]] -= forces[:, :, j]
        return out


def joints_of(model: mujoco.MjModel, columns: np.ndarray) -> np.ndarray:
    """Return the joints (j,) that the actuators of control columns (j,) act on."""
    # an actuator without a command has no column, so that columns and actuators are counted differently
    actuators = [int(np.flatnonzero(model.actuator_ctrladr == column)[0]) for column in columns]
    return np.asarray(model.actuator_trnid[actuators, 0])


class Linearised:
    """A simulation, linearised along its motion.

    ``simulated`` is the simulation; ``stride`` steps make a sample; the matrices are taken anew every ``every`` steps.
    ``rates`` are sensors of joint rates, which a leapfrog step keeps of half a step before.
    """

    def __init__(self, simulated: Simulated, stride: int, rates: Sequence[int] = (), every: int = 2):
        self._model, self._stride, self._every = simulated.model, stride, every
        self._rates = list(rates)
        self._steps = len(simulated.control)
        model = simulated.model
        data = mujoco.MjData(model)
        data.qpos[:], data.qvel[:] = simulated.position, simulated.velocity
        n = 2 * model.nv + model.na
        a, b = np.zeros((n, n)), np.zeros((n, model.nu))
        c, d = np.zeros((model.nsensordata, n)), np.zeros((model.nsensordata, model.nu))
        self._a, self._b, self._c = [], [], []
        for k, control in enumerate(simulated.control):
            data.ctrl[:] = control
            if k % every == 0:
                mujoco.mjd_transitionFD(model, data, _STEP, True, a, b, c, d)
                self._a.append(a.copy())
                self._b.append(b.copy())
                self._c.append(c.copy())
            mujoco.mj_step(model, data)

    def sensors(self, forces: np.ndarray, columns: np.ndarray) -> np.ndarray:
        """Return the change of the sensors (p, n, s) by forces (p, n, j) at the samples of motors (j,).

        Between samples a force goes straight.
        """
        # steps that grow without bound give infinities, and who asks looks for them
        with np.errstate(over="ignore", invalid="ignore"):
            parts = [self._some(forces[i : i + _CHUNK], columns) for i in range(0, len(forces), _CHUNK)]
        return np.concatenate(parts) if parts else np.zeros((0, 0, self._model.nsensordata))

    def _some(self, forces: np.ndarray, columns: np.ndarray) -> np.ndarray:
        by_sample = np.ascontiguousarray(np.moveaxis(forces, 0, 2))
        last = len(by_sample) - 1
        state = np.zeros((2 * self._model.nv + self._model.na, len(forces)))
        out = np.empty((-(-self._steps // self._stride), self._model.nsensordata, len(forces)))
        for k in range(self._steps):
            i, (sample, part) = k // self._every, divmod(k, self._stride)
            share = part / self._stride
            now = by_sample[min(sample, last)]
            if part and sample < last:
                now = (1 - share) * now + share * by_sample[sample + 1]
            after = self._a[i] @ state + self._b[i][:, columns] @ now
            if part == 0:
                out[sample] = self._c[i] @ state
                out[sample, self._rates] = self._c[i][self._rates] @ (state + after) / 2
            state = after
        return np.moveaxis(out, 2, 0)


class Balanced:
    """A simulation whose machine had come to rest against what pulls at it at the start, as a `ForceResponse`.

    A force that is there at the start has moved the machine's springs to where they balance it, before the simulation
    begins: its slope is that of the force and of the springs' new rest. On a joint that has such a spring of its own
    the two are the same, and nothing is left of what the force is at the start.

    Parameters
    ----------
    linear
        The simulation without that, linearised.
    model
        The plant.
    by_rest
        Change of the sensors (k, n, s) by the rest of each of the machine's springs [per m, rad].
    dofs
        Degrees of freedom (k,) of these springs' joints.
    pull
        What one unit of force on each degree of freedom of the plant pulls at these joints (nv, k).
    stiffness
        Of these springs (k,) [N/m, Nm/rad]; a joint without one has none that could move.
    """

    def __init__(
        self,
        linear: ForceResponse,
        model: mujoco.MjModel,
        by_rest: np.ndarray,
        dofs: np.ndarray,
        pull: np.ndarray,
        stiffness: np.ndarray,
    ):
        self._linear, self._model, self._by_rest = linear, model, by_rest
        held = stiffness > 0
        self._own = dofs[held]
        self._moved = np.where(held, -pull / np.where(held, stiffness, 1.0), 0.0)
        self._moved[self._own] = 0.0

    def sensors(self, forces: np.ndarray, columns: np.ndarray) -> np.ndarray:
        """Return the change of the sensors (p, n, s) by forces (p, n, j) of motors (j,): as of `ForceResponse`."""
        driven = self._model.jnt_dofadr[joints_of(self._model, columns)]
        rest = forces[:, 0] @ self._moved[driven]
        left = forces - np.where(np.isin(driven, self._own), forces[:, :1], 0.0)
        return self._linear.sensors(left, columns) + np.tensordot(rest, self._by_rest, axes=1)
