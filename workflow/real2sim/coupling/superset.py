"""Replays of a trial through the plant with effects added: the plain plant plus what the hypotheses need."""

from __future__ import annotations

from collections.abc import Sequence

import mujoco
import numpy as np

from real2sim.coupling.drive import pelvis_drive
from real2sim.coupling.effects import Context, Fields, Placed, PlannedForce, Scales
from real2sim.coupling.plant import ROBOT_JOINTS
from real2sim.coupling.replay import Replay, servo_command


class EffectReplay(Replay):
    """A `Replay` with some effects, recording the robot's joints beside the interface.

    Parameters
    ----------
    effects
        Effects at their places; at most one of them may replace the spring of an axis.
    context
        What input chain, output chain and forces are computed from.
    scales
        Of the effects' parameters.
    replay
        Arguments of `Replay`.
    """

    def __init__(self, *, effects: Sequence[Placed], context: Context, scales: Scales, **replay):
        self.effects = tuple(effects)
        self._context, self._scales = context, scales
        super().__init__(**replay)
        first = self.model.sensor(f"robot_{ROBOT_JOINTS[0]}").adr[0]
        self._robot_columns = slice(first, first + 6)
        joints = [self.model.joint(name).qposadr[0] for name in ROBOT_JOINTS]
        self.start = self._start_state[0][joints].copy()
        self._values: list[np.ndarray] = []
        self._parameters = np.empty((0, 12))
        self._basis = {
            i: self._input_basis(placed) for i, placed in enumerate(self.effects) if placed.effect.input_chain
        }
        self._columns_of = {
            i: placed.effect.plant.columns(self.model, placed.where)
            for i, placed in enumerate(self.effects)
            if isinstance(placed.effect.plant, PlannedForce)
        }

    def _extend(self, spec: mujoco.MjSpec) -> None:
        for name in ROBOT_JOINTS:
            spec.add_sensor(
                name=f"robot_{name}",
                type=mujoco.mjtSensor.mjSENS_JOINTPOS,
                objtype=mujoco.mjtObj.mjOBJ_JOINT,
                objname=name,
            )
        for placed in self.effects:
            if placed.effect.plant is not None:
                placed.effect.plant.build(spec, placed.where)

    def _input_basis(self, placed: Placed) -> np.ndarray:
        """Change of the pelvis command (2, p, nstep, 6) with each parameter and its square, about none [SI].

        A parabola through steps of a tenth of the range: a lever arm of metres makes the square count.
        """
        context, chain = self._context, placed.effect.input_chain
        assert chain is not None
        count = len(placed.effect.parameters)
        command = servo_command(self.drive)
        step = placed.values(placed.bounds()[1][None] / 10)[0]
        out = np.empty((2, count, *command.shape))
        for i in range(count):
            ahead, behind = (
                self.command_for(*chain(sign * step[i] * np.eye(count)[i], context)) - command
                for sign in (1, -1)
            )
            out[0, i] = (ahead - behind) / (2 * step[i])
            out[1, i] = (ahead + behind) / (2 * step[i] ** 2)
        return out

    def command_for(self, rotation: np.ndarray, position: np.ndarray) -> np.ndarray:
        """Pelvis command (nstep, 6) for another path (n, 3, 3), (n, 3) [m] of the same trial."""
        frame = (self.drive.reference_rotation, self.drive.reference_origin)
        moved = pelvis_drive(self._context.time_s, rotation, position, self.drive.timestep, frame)
        return servo_command(moved)

    def set_command(self, simulation: int, command: np.ndarray) -> None:
        """Let one simulation follow another pelvis command (nstep, 6) from now on."""
        self._control[simulation, :, :6] = command

    def run_effects(self, parameters: np.ndarray, x: Sequence[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
        """Simulate strap parameters (m, 12) with searched numbers (m, p) of each effect.

        Returns interface sites (m, n, 2, 3) [m, world] as the markers show them and robot joints (m, n, 6) relative to
        the start pose [m, rad]. A simulation that MuJoCo gave up on is NaN.
        """
        m = len(parameters)
        values = [placed.values(part) for placed, part in zip(self.effects, x, strict=True)]
        self._values, self._parameters = values, parameters
        sensors = self._simulate(parameters)
        paths = self._samples(sensors)
        joints = sensors[:, :: self.stride, self._robot_columns] - self.start
        for placed, value in zip(self.effects, values, strict=True):
            if placed.effect.output_chain is not None and np.isfinite(paths).all():
                paths = placed.effect.output_chain(paths, value, self._context)
        assert len(paths) == m
        return paths, joints

    def _roll(self, m: int) -> np.ndarray:
        fields = Fields(self._batch, self.model, m, self._scales)
        for i, (placed, values) in enumerate(zip(self.effects, self._values, strict=True)):
            if placed.effect.plant is not None:
                placed.effect.plant.set(fields, placed.where, self._parameters, values)
            if i in self._basis or i in self._columns_of:
                self._add_control(i, placed, values, m)
        return super()._roll(m)

    def _add_control(self, i: int, placed: Placed, values: np.ndarray, m: int) -> None:
        # controls start anew at every call: the first effect that adds to them restores the plain command
        first = min([*self._basis, *self._columns_of])
        if i == first:
            self._control[:m, :, :6] = servo_command(self.drive)
            self._control[:m, :, 6:] = 0
        if i in self._basis:
            self._control[:m, :, :6] += np.einsum(
                "kmp,kpnc->mnc", np.array([values, values**2]), self._basis[i], optimize=True
            )
        else:
            assert isinstance(placed.effect.plant, PlannedForce)
            force = placed.effect.plant.force(values, self._context, placed.where, self._parameters[:m])
            self._control[:m, :, self._columns_of[i]] += force
