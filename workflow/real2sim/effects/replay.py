"""Replays of a trial through the plant with effects added: the plain plant plus what the hypotheses need."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cached_property
from typing import Any

import mujoco
import numpy as np
from scipy.spatial.transform import Rotation

from real2sim.effects.base import Fields, InterfaceImpedance, Placed, Scales
from real2sim.effects.chains import Context, Poses
from real2sim.effects.controller import Answer
from real2sim.effects.frames import move_rest
from real2sim.effects.free_run import FreeRuns, feed_back, with_strap_motion
from real2sim.effects.input_basis import InputChain, InputChanges
from real2sim.effects.seen import Unchained, chained, chained_slopes, simulations
from real2sim.system.description import System, shipped_system
from real2sim.system.drive import PelvisDrive, pelvis_drive
from real2sim.system.linear import Balanced, ForceResponse, Linearised
from real2sim.system.plant import RestPose, robot_pose_for
from real2sim.system.replay import Replay, Simulated, StartPose, servo_command

# Least length of the windows after which a controller that answers the strap is asked again; they are as long as the
# least delay where that is more, and then exact. Against windows of one step, an answer without delay of half the force
# errs by 0.012 mm of 2.4, a smoothed one by 0.003 (0.08 and 0.03 at 0.05 s)
WINDOW_S = 0.02
# What is recorded meanwhile
_HEARD = ("sensordata", "qfrc_passive", "qfrc_constraint", "actuator_force")

# Step by which the rest of a robot's spring is moved for its slope [m, rad]
_REST_STEP = 1e-4


class EffectReplay(FreeRuns, Replay):
    """A `Replay` with some effects, recording the robot's joints beside the interface.

    Parameters
    ----------
    effects
        Effects at their places; at most one of them may replace the spring of an axis.
    context
        What input chain, output chain and forces are computed from.
    scales
        Of the effects' parameters.
    bases
        What input chains do to the path of this trial, as far as other replays have asked; new ones are added.
    settled
        Whether the robot had come to rest against the strap before the path begins: its controller then holds where
        that balances what pulls at the start, and not at the start pose.
    system
        Whose joints, axes and bodies the effects act on; by default the strap's.
    replay
        Arguments of `Replay`.
    """

    def __init__(
        self,
        *,
        effects: Sequence[Placed],
        context: Context,
        scales: Scales,
        bases: dict[tuple[str, float, bytes], InputChain] | None = None,
        settled: bool = False,
        system: System | None = None,
        **replay: Any,
    ):
        self.effects, self._settled = tuple(effects), settled
        self.system = system or shipped_system("strap")
        self._context, self._scales = context, scales
        plants = [placed.effect.plant for placed in self.effects]
        self._frictional = any(plant.sticks for plant in plants)
        self._stopped = any(plant.weighed for plant in plants)
        self._standing = [i for i, plant in enumerate(plants) if plant.acts_in_neutral]
        self._shifted = any(plant.moves_rest for plant in plants) or bool(self._standing)
        self._order = sorted(range(len(plants)), key=lambda i: plants[i].order)
        self._laws = {i: plant.law for i, plant in enumerate(plants) if plant.law is not None}
        super().__init__(**replay)
        machine = self.system.machine_joints
        first = self.model.sensor(f"robot_{machine[0]}").adr[0]
        self._robot_columns = slice(first, first + len(machine))
        self._robot_joints = np.array([self.model.joint(name).id for name in machine])
        # several turns of the rest pose make R_x R_y R_z, as the interface's coordinates do: z is applied first
        self._sightings = sorted(
            (i for i, placed in enumerate(self.effects) if placed.effect.chains.observation),
            key=lambda i: [-axis for axis in self.effects[i].where.axes],
        )
        self._sights: list[StartPose] = []
        self._headings = np.zeros(0)
        self._values: list[np.ndarray] = []
        self.hold([placed.at_rest() for placed in self.effects])
        self.planned_from = context
        # whether simulations of equal parameters differ by what they are commanded
        self._own_commands = False
        self._impedance = self._impedance_of(np.empty((0, len(self.system.parameters))))
        self._beside = np.zeros((self._batch.nsim, 6))
        self._swaying = np.zeros((self._batch.nsim, 6))
        # pelvis command of each simulation before any input chain
        self._commands = np.tile(servo_command(self.drive), (self._batch.nsim, 1, 1))
        chains = {i: placed for i, placed in enumerate(self.effects) if placed.effect.chains.input}
        bases = {} if bases is None else bases
        self._changes = {}
        for i, placed in chains.items():
            reach = self._own(placed, np.array(placed.bounds()))
            key = placed.key, self.drive.timestep, reach.tobytes()
            if key not in bases:
                bases[key] = self._input_chain(placed)
            self._changes[i] = InputChanges(bases[key])
        columns = [placed.effect.plant.columns(self.model, placed.where) for placed in self.effects]
        self._columns_of = {i: found for i, found in enumerate(columns) if len(found)}

    def _extend(self, spec: mujoco.MjSpec) -> None:
        logged: dict[str, str] = {}
        for placed in self.effects:
            logged |= placed.effect.plant.logged(placed.where)
        for name in self.system.machine_joints:
            spec.add_sensor(
                name=f"robot_{name}",
                type=mujoco.mjtSensor.mjSENS_JOINTPOS,
                objtype=mujoco.mjtObj.mjOBJ_JOINT,
                objname=logged.get(name, name),
            )
        for axis in self.system.axes if feed_back(self.effects) else ():
            spec.add_sensor(
                name=f"axis_{axis.joint}",
                type=mujoco.mjtSensor.mjSENS_JOINTPOS,
                objtype=mujoco.mjtObj.mjOBJ_JOINT,
                objname=axis.joint,
            )
        if any(placed.effect.chains.observation for placed in self.effects):
            spec.add_sensor(
                name="interface_rotation",
                type=mujoco.mjtSensor.mjSENS_FRAMEQUAT,
                objtype=mujoco.mjtObj.mjOBJ_XBODY,
                objname=self.system.body,
            )
        for placed in self.effects:
            placed.effect.plant.build(spec, placed.where)

    def _may_be_constrained(self) -> bool:
        """As of `Replay`; dry friction is set in every simulation anew."""
        return self._frictional or super()._may_be_constrained()

    def _input_chain(self, placed: Placed) -> InputChain:
        """Return what an input chain does to the pelvis command and its start, up to its parameters' bounds."""
        context, chain, plain = self._context, placed.effect.chains.input, self.drive
        assert chain is not None
        zero = servo_command(plain), _first(plain)

        def changed(values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
            drive = _drive_for(plain, context, *chain(values, context))
            return servo_command(drive) - zero[0], _first(drive) - zero[1]

        low, high = self._own(placed, np.array(placed.bounds()))
        return InputChain(changed, low, high, self._own(placed, placed.bounds()[1][None] / 10)[0])

    def _impedance_of(self, parameters: np.ndarray) -> InterfaceImpedance:
        """Stiffness and damping of each axis for parameters (m, p): the model's own where they are no parameters."""
        dofs = self._dofs
        return InterfaceImpedance(
            by_axis(parameters, self.system.stiffness_of_axis, self.model.jnt_stiffness[self._joints]),
            by_axis(parameters, self.system.damping_of_axis, self.model.dof_damping[dofs]),
        )

    def _own(self, placed: Placed, x: np.ndarray) -> np.ndarray:
        """SI values (m, p) of those of the searched numbers (m, p) that say something of this trial."""
        return placed.values(x)[:, placed.of_trial(held_out=self._context.held_out)]

    def command_for(self, rotation: np.ndarray, position: np.ndarray) -> np.ndarray:
        """Pelvis command (nstep, 6) for another path (n, 3, 3), (n, 3) [m] of the same trial."""
        return servo_command(_drive_for(self.drive, self._context, rotation, position))

    def _starts(self, m: int) -> tuple[np.ndarray, np.ndarray]:
        if not self._changes and not self._sightings:
            return super()._starts(m)
        # a pelvis that is elsewhere than it was seen is so from the first step on: no jump, which would hit the robot
        first = np.tile(_first(self.drive), (m, 1))
        for i, changes in self._changes.items():
            first += changes.starts(self._values[i][:m])
        poses = self._sights or [self._start_pose] * m
        states = [self._state_at(row[:6], row[6:], pose) for row, pose in zip(first, poses, strict=False)]
        return np.array([q for q, _ in states]), np.array([v for _, v in states])

    def _see(self, m: int) -> None:
        """Find start of robot and interface, and rest pose of the strap, of each of m simulations."""
        self._sights, self._headings = [], np.zeros(m)
        seen = self._start_pose
        for k in range(m):
            sight = Poses(seen.rotation, seen.position, seen.rest.rotation, seen.rest.position)
            for i in self._sightings:
                observation = self.effects[i].effect.chains.observation
                assert observation is not None
                sight = observation.true_poses(
                    self._values[i][k], sight, self._context, self.effects[i].where.axes
                )
            rest = RestPose(sight.rest_rotation, sight.rest_position)
            # only the strap rests elsewhere: the robot stands where it was seen
            if sight.rotation is seen.rotation and sight.position is seen.position:
                self._sights.append(replace(seen, rest=rest))
                continue
            try:
                joints = robot_pose_for(self._twin, sight.rotation, sight.position)
            except (ValueError, np.linalg.LinAlgError):
                # out of the robot's reach: no simulation, like one that MuJoCo gives up on
                joints = np.full(6, np.nan)
            self._sights.append(StartPose(joints, sight.rotation, sight.position, rest))
            self._headings[k] = sight.heading

    def _set_up(self, m: int) -> None:
        """Write rest poses, and where the robot's controller holds, into the plants of m simulations."""
        model, batch = self.model, self._batch
        pelvis, site = model.body("pelvis").id, model.site("pelvis").id
        quat, centre, origin, spring = (
            batch.expand(name)[:m] for name in ("body_quat", "body_ipos", "site_pos", "qpos_spring")
        )
        for k, pose in enumerate(self._sights):
            mujoco.mju_mat2Quat(quat[k, pelvis], pose.rest.rotation.T.flatten())
            centre[k, pelvis] = origin[k, site] = -pose.rest.position
            spring[k, model.jnt_qposadr[self._robot_joints]] = pose.joints

    def hold_beside(self, shifts: np.ndarray, rates: np.ndarray) -> None:
        """Let the controller of a robot at rest hold beside the balance, and the robot not be quite at rest.

        ``shifts`` [m, rad] and ``rates`` [m/s, rad/s], (nsim, 6) by robot joint.
        """
        self._beside[:], self._swaying[:] = shifts, rates
        self._own_commands = True

    def set_command(self, simulation: int, command: np.ndarray) -> None:
        """Let one simulation follow another pelvis command (nstep, 6) from now on."""
        self._control[simulation, :, :6] = self._commands[simulation] = command
        self._own_commands = True

    def hold(self, x: Sequence[np.ndarray]) -> None:
        """Let the effects have these searched numbers, (p,) each, in every `run`."""
        self._held = [part[None] for part in x]

    def run(self, parameters: np.ndarray) -> np.ndarray:
        """As of `Replay`, with the effects at the numbers that `hold` was told."""
        held = [np.repeat(part, len(parameters), axis=0) for part in self._held]
        return self.run_effects(parameters, held)[0]

    def run_effects(self, parameters: np.ndarray, x: Sequence[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
        """Simulate strap parameters (m, 12) with searched numbers (m, p) of each effect.

        Returns interface sites (m, n, 2, 3) [m, world] as the markers show them and robot joints (m, n, 6) as its log
        shows them, relative to the start pose [m, rad]. A simulation that MuJoCo gave up on is NaN.
        """
        values = [self._own(placed, part) for placed, part in zip(self.effects, x, strict=True)]
        # every simulation that has a command or start of its own is its own
        first = which = np.arange(len(parameters))
        if not self._own_commands:
            first, which = simulations(self.effects, parameters, values)
        self._values, self._impedance = [v[first] for v in values], self._impedance_of(parameters[first])
        if self._sightings:
            self._see(len(first))
        self._parameters = parameters[first][:1].copy()
        sensors = self._simulate(parameters[first])
        paths = self._samples(sensors)
        start = np.array([pose.joints for pose in self._sights or [self._start_pose]])[:, None]
        joints = sensors[:, :: self.stride, self._robot_columns] - start
        if self._sightings:
            # what MuJoCo gave up on stays NaN, and the others are none the worse for it
            done = np.flatnonzero(np.isfinite(paths).all(axis=(1, 2, 3)))
            if len(done):
                paths[done], joints[done] = self._seen(paths[done], joints[done], sensors[done], done)
        self._unchained: Unchained = paths[0], joints[0], [v[:1] for v in values]
        return chained(self.effects, paths[which], joints[which], values, self._context)

    def _motion(self) -> np.ndarray:
        """As of `FreeRuns`: positions of the strap's joints."""
        columns = [self.model.sensor(f"axis_{axis.joint}").adr[0] for axis in self.system.axes]
        return np.asarray(self._sensors[0, :: self.stride][:, columns])

    def _moved(self, recorded: Context, motion: np.ndarray) -> Context:
        """As of `FreeRuns`: markers and rotation of the interface move along."""
        return with_strap_motion(recorded, motion)

    def _seen(
        self, paths: np.ndarray, joints: np.ndarray, sensors: np.ndarray, which: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Marker paths and robot joints as they are seen, for joint centres (m, n, 2, 3) and joints (m, n, 6).

        ``which`` (m,) are their numbers among the simulations.
        """
        column = self.model.sensor("interface_rotation").adr[0]
        wxyz = sensors[:, :: self.stride, column : column + 4]
        rotation = Rotation.from_quat(wxyz.reshape(-1, 4), scalar_first=True).as_matrix()
        rotation = rotation.reshape(*wxyz.shape[:2], 3, 3)
        for i in reversed(self._sightings):
            observation = self.effects[i].effect.chains.observation
            assert observation is not None
            paths = observation.observe(paths, rotation, self._values[i][which], self._context)
        heading = self._headings[which, None]
        c, s = np.cos(heading), np.sin(heading)
        x, y = joints[..., 0], joints[..., 1]
        return paths, np.stack([c * x - s * y, s * x + c * y, *np.moveaxis(joints[..., 2:], 2, 0)], axis=2)

    def _roll(self, m: int) -> np.ndarray:
        fields = Fields(self._batch, self.model, m, self._scales, self.system)
        if self._sightings:
            self._set_up(m)
        if self._shifted:
            # the rest of the last call is moved already, and effects write only what they change
            strap = self.model.jnt_qposadr[self._joints]
            fields["qpos_spring"][:, strap] = self.model.qpos_spring[strap]
            for name in ("tendon_lengthspring", "tendon_range") if self.model.ntendon else ():
                fields[name][:] = getattr(self.model, name)
        if self._settled and not self._sightings:
            # where the robot was in balance in the last call
            robot = self.model.jnt_qposadr[self._robot_joints]
            fields["qpos_spring"][:, robot] = self.model.qpos_spring[robot]
        for i in self._order:
            placed, values = self.effects[i], self._values[i]
            placed.effect.plant.set(fields, placed.where, self._impedance, values)
            if i in self._changes or i in self._columns_of:
                self._add_control(i, placed, values, m)
        # a robot at rest has balanced what pulls, in the neutral trial as well
        if self._standing and not self._settled:
            self._stretch_at_rest(fields, m)
        for placed, values in zip(self.effects, self._values, strict=True):
            placed.effect.plant.before_run(fields, placed.where, self._impedance, values)
        if self._shifted and self.model.tendon_springyield.any():
            # MuJoCo's reset lets what yields begin where the springs rest, which was another place before
            self._reset_to(self._state(m))
        self._damp_explicitly(m)
        if self._stopped:
            self._weigh(m)
        if self._laws:
            return self._roll_answering(fields, m)
        if self._settled:
            self._settle(fields, m)
        return self._step(m)

    def _roll_answering(self, fields: Fields, m: int) -> np.ndarray:
        """As of `Replay`, window by window.

        Before the trial the person stood as in its first moments: they are simulated beforehand, since what the strap
        does in them depends on its law. The very first sample is a jolt of the simulation.
        """
        start = self._context.start * self.stride
        before = self._pull_while_standing(m)
        for last in (start, self.nstep):
            answers = self._begin(before)
            if self._settled:
                self._settle(fields, m)
            state = self._state(m)
            pull = self._roll_windows(answers, last, m)
            before = pull[:, :start].mean(axis=1)
            if last < self.nstep:
                self._reset_to(state)
        return self._without_failed(m)

    def _pull_while_standing(self, m: int) -> np.ndarray:
        """Force (m, 2) [N, world] on the interface that springs and dampers make of the measured coordinates."""
        context, start = self._context, self._context.start
        k, d = self._impedance.k[:m, None, :3], self._impedance.d[:m, None, :3]
        force = k * context.coordinates[:start, :3]
        force = -(force + d * context.rates[:start, :3])
        return np.asarray(np.einsum("nij,mnj->mi", context.pelvis_rotation[:start, :2], force) / start)

    def _begin(self, pulled: np.ndarray) -> dict[int, Answer]:
        """Controllers up to the start, where the strap pulled with (m, 2) [N], by number of their effect."""
        m, h = len(pulled), self.model.opt.timestep
        answers = {}
        for i, law in self._laws.items():
            before = pulled if law.hears == "interface" else np.zeros((m, 3))
            answers[i] = Answer(law(self._values[i][:m], before, h), before, h, self.nstep)
            self._control[:m, :1, self._columns_of[i]] = answers[i].plan(1)
        return answers

    def _roll_windows(self, answers: dict[int, Answer], last: int, m: int) -> np.ndarray:
        """Step to step ``last``, window by window; force of the strap on the interface (m, last, 2) [N, world]."""
        batch, least = self._batch, max(round(WINDOW_S / self.model.opt.timestep), 1)
        # what a controller answers is known as far ahead as its delay
        count = max(least, min(answer.foreseen for answer in answers.values()))
        # all simulations need no list, which MuJoCo would check at every window
        ids = None if m == batch.nsim else np.arange(m)
        out: dict[int, dict[str, np.ndarray]] = {}
        pull = np.empty((m, last, 2))
        base = slice(self._robot_columns.start, self._robot_columns.start + 3)
        start = self._state(m)[0][..., self.model.jnt_qposadr[self._robot_joints[:3]]].reshape(-1, 1, 3)
        for first in range(0, last, count):
            window = slice(first, min(first + count, last))
            for i, answer in answers.items():
                self._control[:m, window, self._columns_of[i]] = answer.plan(window.stop - first)
            steps, control = window.stop - first, self._control[:m, window]
            done = out[steps] = batch.rollout(steps, control, record=_HEARD, ids=ids, out=out.get(steps))
            self._sensors[:m, window] = done["sensordata"]
            pull[:, window] = self._strap_force(done, window)
            heard = {"interface": pull[:, window], "base": done["sensordata"][..., base] - start}
            for answer in answers.values():
                answer.learn(heard[answer.hears])
        return pull

    def _strap_force(self, done: dict[str, np.ndarray], window: slice) -> np.ndarray:
        """Force (m, w, 2) [N, world] of the strap on the interface in some steps, by whatever law it pulls."""
        # joints of one body follow each other
        dofs = slice(self._dofs[0], self._dofs[2] + 1)
        force = done["qfrc_passive"][..., dofs] + done["qfrc_constraint"][..., dofs]
        for axis, actuators in self._on_strap.items():
            force[..., axis] += done["actuator_force"][..., actuators].sum(axis=-1)
        return np.asarray(np.einsum("nij,mnj->mni", self._pelvis_at_steps[window], force))

    @cached_property
    def _on_strap(self) -> dict[int, np.ndarray]:
        """Actuators of the translational joints of the strap, by axis: planned forces, and bristles of a friction."""
        model = self.model
        of_joint = model.actuator_trntype == mujoco.mjtTrn.mjTRN_JOINT
        found = {i: of_joint & (model.actuator_trnid[:, 0] == j) for i, j in enumerate(self._joints[:3])}
        return {i: np.flatnonzero(of_axis) for i, of_axis in found.items() if of_axis.any()}

    @cached_property
    def _pelvis_at_steps(self) -> np.ndarray:
        """Horizontal rows of the pelvis' rotation at every step, (nstep, 2, 3)."""
        context = self._context
        rows = context.pelvis_rotation[:, :2].reshape(-1, 6)
        steps = [np.interp(context.step_time_s, context.time_s, row) for row in rows.T]
        return np.stack(steps, axis=1).reshape(-1, 2, 3)

    def _settle(self, fields: Fields, m: int) -> None:
        """Let every spring between floor and interface rest where it balances what pulls at the robot at the start.

        That is strap and planned forces where nothing moves, by whatever law; what relaxes has done so, and friction is
        taken to hold nothing.
        """
        model, batch = self.model, self._batch
        joints, adr, dofs = self._chain
        position, velocity = self._state(m)
        for placed in self.effects:
            placed.effect.plant.relax(fields, placed.where, position)
        springs = fields["qpos_spring"]
        springs[:, adr] = position[:, adr]
        batch.bind("qpos")[:m], batch.bind("qvel")[:m] = position, 0
        pull = batch.rollout(1, self._control[:m, :1], record=("qfrc_passive",), ids=np.arange(m))
        force = pull["qfrc_passive"][:, 0]
        for i, columns in self._columns_of.items():
            if self.effects[i].effect.plant.control_is_force:
                driven = model.jnt_dofadr[model.actuator_trnid[columns, 0]]
                force[:, driven] += self._control[:m, 0, columns]
        stiffness = fields["jnt_stiffness"][:, joints]
        for k in range(m):
            # how the strap's joints go where those of the robot move and the pelvis stays
            given = self._jacobian(batch.get_model(k), position[k])
            follow = -np.linalg.solve(given[:, self._dofs], given[:, dofs])
            pulled = force[k, dofs] + follow.T @ force[k, self._dofs]
            moving = np.zeros(model.nv)
            moving[model.jnt_dofadr[self._robot_joints]] = self._swaying[k]
            velocity[k] += moving
            velocity[k, self._dofs] += follow @ moving[dofs]
            springs[k, adr] -= np.where(stiffness[k] > 0, pulled / np.maximum(stiffness[k], 1e-9), 0.0)
        springs[:, model.jnt_qposadr[self._robot_joints]] += self._beside[:m]
        self._reset_to([position, velocity])
        self._began_at = position[0]

    def _stretch_at_rest(self, fields: Fields, m: int) -> None:
        """Let the strap rest elsewhere by what standing forces stretched its springs when its rest pose was taken.

        The robot was let go in the neutral trial as in this one, and came to where springs of robot and strap hold the
        force. Small displacements; the strap's other laws are taken to be quiet about its rest.
        """
        model, context = self.model, self._context
        robot = model.jnt_dofadr[self._robot_joints]
        held = fields["jnt_stiffness"][:, self._robot_joints]
        # the robot stood by the pelvis as it does now, which looked elsewhere
        heading = context.pelvis_rotation[0] @ context.neutral.rotation.T
        there = replace(context, interface_rotation=heading.T @ context.interface_rotation)
        position = np.atleast_2d(self._starts(m)[0])
        given = self._jacobian(model, position[0])
        follow = -np.linalg.solve(given[:, self._dofs], given[:, robot])
        force = np.zeros((m, model.nv))
        for i in self._standing:
            plant, columns = self.effects[i].effect.plant, self._columns_of[i]
            driven = model.jnt_dofadr[model.actuator_trnid[columns, 0]]
            planned = plant.force(self._values[i], there, self.effects[i].where, self._impedance)
            assert planned is not None
            force[:, driven] += planned[:, 0]
        pulled = force[:, robot]
        pulled[:, :2] = pulled[:, :2] @ heading[:2, :2].T
        stiffness = held[:, :, None] * np.eye(len(robot)) + np.einsum(
            "ai,ma,aj->mij", follow, self._impedance.k[:m], follow
        )
        stretch = np.linalg.solve(stiffness, pulled[..., None])[..., 0] @ follow.T
        for axis in range(len(self._dofs)):
            move_rest(fields, axis, -stretch[:, axis])

    def linearised(self) -> ForceResponse | None:
        """Return the last call's first simulation as a linear system; None where forces do not act linearly.

        Something sticks, stops, answers the interface, stands at rest by forces or is seen from another frame.
        """
        rough = self._frictional or self._stopped or self._standing or self._laws
        if self._sightings or rough:
            return None
        return self._balanced() if self._settled else Linearised(self.as_simulated(), self.stride)

    def _balanced(self) -> ForceResponse | None:
        """As of `linearised`, of a robot whose controller holds where that balances forces at the start as well.

        None where other springs than the robot's stand between floor and interface.
        """
        joints, _, dofs = self._chain
        if not np.array_equal(joints, self._robot_joints):
            return None
        kept = self._beside[0].copy()
        by_rest = []
        for step in _REST_STEP * np.eye(len(joints)):
            shown = []
            for beside in (kept + step, kept - step):
                self._beside[0] = beside
                shown.append(self._simulate(self._parameters)[0, :: self.stride].copy())
            by_rest.append((shown[0] - shown[1]) / (2 * _REST_STEP))
        self._beside[0] = kept
        # the last call's first simulation is the plain one again
        self._simulate(self._parameters)
        model = self._batch.get_model(0)
        given = self._jacobian(model, self._began_at)
        pull = np.zeros((model.nv, len(dofs)))
        # how the strap's joints go where those of the robot move and the pelvis stays, as in `_settle`
        pull[self._dofs] = -np.linalg.solve(given[:, self._dofs], given[:, dofs])
        linear = Linearised(self.as_simulated(), self.stride)
        return Balanced(linear, model, np.array(by_rest), dofs, pull, model.jnt_stiffness[joints])

    @property
    def linearisation_cost(self) -> int:
        """Simulations that take as long as a linearisation: every other step, one either way by state and control."""
        resting = 2 * len(self._robot_joints) + 1 if self._settled else 0
        return int(2 * self.model.nv + self.model.na + self.model.nu + resting)

    def response(
        self, linear: ForceResponse, effect: int, forces: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return how forces (p, n, j) of an effect's motors at the samples change what `run_effects` returned first.

        Paths (p, n, 2, 3) [m] and joints (p, n, 6) [m, rad].
        """
        sensors = linear.sensors(forces, self._columns_of[effect])
        paths = sensors[:, :, self._columns]
        moved = paths.reshape(*paths.shape[:2], 2, 3), sensors[:, :, self._robot_columns]
        return chained_slopes(self.effects, self._unchained, moved, self._context)

    def as_simulated(self) -> Simulated:
        """As of `Replay`; what relaxes starts where it has done so."""
        simulated = super().as_simulated()
        return replace(simulated, position=self._began_at.copy()) if self._settled else simulated

    @cached_property
    def _chain(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Joints between floor and interface: their indices, where they are in qpos, and their degrees of freedom."""
        model = self.model
        body, bodies = model.body("interface").id, []
        while body:
            bodies.append(body)
            body = model.body_parentid[body]
        joints = np.flatnonzero(np.isin(model.jnt_bodyid, bodies))
        return joints, model.jnt_qposadr[joints], model.jnt_dofadr[joints]

    @staticmethod
    def _jacobian(model: mujoco.MjModel, position: np.ndarray) -> np.ndarray:
        """Of the pelvis by all degrees of freedom (6, nv), at joint positions (nq,)."""
        data = mujoco.MjData(model)
        data.qpos[:] = position
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        out = np.zeros((6, model.nv))
        mujoco.mj_jacSite(model, data, out[:3], out[3:], model.site("pelvis").id)
        return out

    def _state(self, m: int) -> list[np.ndarray]:
        """Joint positions and rates of m simulations, (m, nq) and (m, nv)."""
        return [self._batch.bind(name)[:m].copy() for name in ("qpos", "qvel")]

    def _reset_to(self, state: list[np.ndarray]) -> None:
        """Reset the first simulations to joint positions and rates."""
        m = len(state[0])
        self._batch.reset(np.arange(m), stage=mujoco.mjtStage.mjSTAGE_NONE)
        self._batch.bind("qpos")[:m], self._batch.bind("qvel")[:m] = state

    def _weigh(self, m: int) -> None:
        """Let a stop know the inertia that comes against it with these dampers."""
        state = self._state(m)
        self._batch.set_const(np.arange(m))
        self._batch.bind("qpos")[:m], self._batch.bind("qvel")[:m] = state

    def _add_control(self, i: int, placed: Placed, values: np.ndarray, m: int) -> None:
        # controls start anew at every call: the first effect that adds to them restores the plain command
        first = min([*self._changes, *self._columns_of])
        if i == first:
            self._control[:m, :, :6] = self._commands[:m]
            self._control[:m, :, 6:] = 0
        if i in self._changes:
            self._control[:m, :, :6] += self._changes[i].commands(values)
        else:
            force = placed.effect.plant.force(values, self._context, placed.where, self._impedance)
            if force is not None:
                self._control[:m, :, self._columns_of[i]] += force


def by_axis(parameters: np.ndarray, index_of: Mapping[int, int], own: np.ndarray) -> np.ndarray:
    """Return one parameter for each axis, (m, axes) of (m, p), by its index; ``own`` (axes,) where there is none.

    A view where the parameters of all axes are side by side.
    """
    index = [index_of.get(axis, -1) for axis in range(len(own))]
    if index == list(range(index[0], index[0] + len(own))) and index[0] >= 0:
        return parameters[:, index[0] : index[0] + len(own)]
    return np.where(np.array(index) >= 0, parameters[:, np.maximum(index, 0)], own)


def _drive_for(
    plain: PelvisDrive, context: Context, rotation: np.ndarray, position: np.ndarray
) -> PelvisDrive:
    """Return the drive along another path (n, 3, 3), (n, 3) [m] of the trial that ``plain`` drives."""
    frame = (plain.reference_rotation, plain.reference_origin)
    return pelvis_drive(context.time_s, rotation, position, plain.timestep, frame)


def _first(drive: PelvisDrive) -> np.ndarray:
    """Pelvis and its rate at the start, (12,)."""
    return np.concatenate([drive.position[0], drive.velocity[0]])
