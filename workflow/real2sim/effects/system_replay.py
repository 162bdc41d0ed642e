"""Replays of a described system with effects added: many parameter vectors at once, in one batch."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property

import mujoco
import numpy as np

from real2sim.effects.base import Fields, InterfaceImpedance, Placed, Scales
from real2sim.effects.chains import Context
from real2sim.effects.frames import move_tendons
from real2sim.effects.free_run import FreeRuns, feed_back
from real2sim.effects.replay import by_axis
from real2sim.effects.seen import Unchained, chained, chained_slopes, simulations
from real2sim.errors import InputError
from real2sim.system.batches import untimed_batch
from real2sim.system.described_plant import DRIVEN_SITE, LETTERS, Anchor, load_model, plant_of, rests_of
from real2sim.system.description import MASS, PATH, POSE, System
from real2sim.system.drive import PelvisDrive, pelvis_drive
from real2sim.system.linear import ForceResponse, Linearised, PrescribedMotion, joints_of
from real2sim.system.lone_joint import LoneJoint, lone_joint
from real2sim.system.plant import RestPose, compiled
from real2sim.system.replay import Simulated, centred, servo_command

# Time step for which an effect's substeps are meant [s]
_REFERENCE_STEP_S = 0.01
_FORCES = ("qfrc_passive", "qfrc_constraint", "actuator_force", "qfrc_bias")


@dataclass(frozen=True)
class Setup:
    """One trial of a described system, as its simulations need it.

    ``commands`` (nstep, c) of the drive at the steps; ``acceleration`` (n, c) of driven joints at the samples, for
    outputs that are forces; ``start`` and ``start_rate`` are positions and rates of joints by name; ``segment`` is the
    drive of a segment, and ``anchor`` where it hangs. ``settled``: the machine's springs balance the start.
    """

    system: System
    timestep: float
    stride: int
    commands: np.ndarray
    start: Mapping[str, float]
    start_rate: Mapping[str, float]
    acceleration: np.ndarray | None = None
    segment: PelvisDrive | None = None
    anchor: Anchor | None = None
    settled: bool = False
    threads: int = 1


@dataclass(frozen=True)
class Channels:
    """Places of the observations and of the machine's log in the sensor data."""

    markers: int
    outputs: tuple[str, ...]
    logged: tuple[str, ...] = field(default=())

    @property
    def observed(self) -> int:
        """Number of observed channels: three a marker, then the outputs."""
        return 3 * self.markers + len(self.outputs)

    @property
    def columns(self) -> tuple[slice, slice]:
        """Columns of the sensor data that are observed, and those of the log."""
        return slice(self.observed), slice(self.observed, self.observed + len(self.logged))


def supports(placed: Placed) -> bool:
    """Return whether the simulation of a described system can have an effect.

    It has neither another observation model than its markers nor a controller that answers the interface.
    """
    plant, chains = placed.effect.plant, placed.effect.chains
    return plant.law is None and not plant.acts_in_neutral and chains.observation is None


class SystemReplay(FreeRuns):
    """Simulate one trial of a described system with some effects.

    Parameters
    ----------
    effects
        Effects at their places (`supports`).
    context, scales
        Of the trial, see `Context` and `Scales`.
    nsim
        Simulations per call, at most.

    Attributes
    ----------
    model
        The compiled plant.
    """

    def __init__(self, setup: Setup, effects: Sequence[Placed], context: Context, scales: Scales, nsim: int):
        self._setup, self.effects, self._context, self._scales = setup, tuple(effects), context, scales
        system = setup.system
        frame = None
        if setup.segment is not None:
            frame = RestPose(setup.segment.reference_rotation, setup.segment.reference_origin)
        spec = plant_of(system, setup.timestep, setup.anchor, frame)
        self.channels = self._sense(spec)
        self._own_tendons = len(spec.tendons)
        for placed in self.effects:
            placed.effect.plant.build(spec, placed.where)
        self._sticks = any(p.effect.plant.sticks for p in self.effects)
        # dampers are explicit, with what makes that the same motion (`_write_effects`): a tenth of a step is spared
        spec.option.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_EULERDAMP)
        self.spec = spec
        self.model = model = compiled(spec, system.model)
        self._batch = untimed_batch(model, nsim, setup.threads)
        self.nstep = len(setup.commands)
        self._control = np.zeros((nsim, self.nstep, model.nu))
        self._drive = slice(0, setup.commands.shape[1])
        self._commands = np.tile(setup.commands, (nsim, 1, 1))
        self._accelerations = (
            None if setup.acceleration is None else np.tile(setup.acceleration, (nsim, 1, 1))
        )
        self._joints = [model.joint(name) for name in system.axis_joints]
        self._start = self._start_state()
        # of the first simulation of the last call, half a step before its start
        self._first_rate = self._start[1]
        self._shift, self._hurry = np.zeros((nsim, model.nq)), np.zeros((nsim, model.nv))
        # simulations whose segment would have to be driven farther than it can be
        self._failed, self._impossible = np.zeros(nsim, bool), set[bytes]()
        # whether simulations of equal parameters differ by command or start
        self._own_commands = False
        self._chains = [i for i, p in enumerate(self.effects) if p.effect.chains.input is not None]
        self.planned_from = context
        # what the last call's sensors showed
        self._sensed = np.empty((0, self.nstep, 0))

    def _sense(self, spec: mujoco.MjSpec) -> Channels:
        """Add sensors of markers, outputs and the machine's log."""
        system = self._setup.system
        sites = tuple((system.markers.sites or {}).values()) if system.drive.by == POSE else ()
        for site in sites:
            _sensor(spec, f"marker_{site}", mujoco.mjtSensor.mjSENS_FRAMEPOS, mujoco.mjtObj.mjOBJ_SITE, site)
        joint = mujoco.mjtObj.mjOBJ_JOINT
        kinds = {
            "position": mujoco.mjtSensor.mjSENS_JOINTPOS,
            "force": mujoco.mjtSensor.mjSENS_JOINTPOS,
            "velocity": mujoco.mjtSensor.mjSENS_JOINTVEL,
        }
        for output in system.outputs:
            _sensor(spec, f"output_{output.column}", kinds[output.quantity], joint, output.joint)
        shown: dict[str, str] = {}
        for placed in self.effects:
            shown |= placed.effect.plant.logged(placed.where)
        logged = tuple(j.name for j in system.machine if j.logged)
        for name in logged:
            _sensor(spec, f"log_{name}", kinds["position"], joint, shown.get(name, name))
        for axis in system.axes if feed_back(self.effects) else ():
            _sensor(spec, f"axis_{axis.joint}", kinds["position"], joint, axis.joint)
        return Channels(len(sites), tuple(o.column for o in system.outputs), logged)

    def _start_state(self) -> tuple[np.ndarray, np.ndarray]:
        """Joint positions (nq,) and rates (nv,) at the start."""
        model, setup = self.model, self._setup
        position, rate = model.qpos0.copy(), np.zeros(model.nv)
        for name, value in setup.start.items():
            position[model.joint(name).qposadr[0]] = value
            rate[model.joint(name).dofadr[0]] = setup.start_rate.get(name, 0.0)
        return position, rate

    def _starts(self, m: int) -> np.ndarray:
        """Joint positions (m, nq) at the start of each simulation."""
        return self._start[0] + self._shift[:m]

    def set_command(
        self, simulation: int, command: np.ndarray, acceleration: np.ndarray | None = None
    ) -> None:
        """Let one simulation follow another command (nstep, c) from now on, along a path of ``acceleration`` (n, c)."""
        self._commands[simulation] = command
        if self._accelerations is not None and acceleration is not None:
            self._accelerations[simulation] = acceleration
        self._own_commands = True

    def shift_start(self, simulation: int, joint: str, by: float, *, rate: bool = False) -> None:
        """Let one simulation start with another position or ``rate`` of a joint [SI], the segment as it is."""
        self._own_commands = True
        index = self.model.joint(joint)
        wanted = np.zeros(self.model.nv)
        wanted[index.dofadr[0]] = by
        free = self._free_motions(self._start[0])
        moved = free.T @ (free @ wanted)
        lever = moved[index.dofadr[0]] / by
        moved = moved / lever if lever > 1e-3 else 0 * moved
        if rate:
            self._hurry[simulation] = moved
            return
        position = self._start[0].copy()
        mujoco.mj_integratePos(self.model, position, moved, 1.0)
        self._shift[simulation] = position - self._start[0]

    def command_for(self, rotation: np.ndarray, position: np.ndarray) -> np.ndarray:
        """Return the command (nstep, 6) for another path (n, 3, 3), (n, 3) [m] of the segment."""
        segment = self._setup.segment
        assert segment is not None
        frame = (segment.reference_rotation, segment.reference_origin)
        return servo_command(pelvis_drive(self._context.time_s, rotation, position, segment.timestep, frame))

    def run_effects(self, parameters: np.ndarray, x: Sequence[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
        """Simulate parameters (m, p) with searched numbers (m, q) of each effect.

        Returns observations (m, n, c), marker by marker [m, world] and then output by output, and the log of the
        machine (m, n, j) [m, rad]. A simulation that MuJoCo gave up on is NaN.
        """
        held_out = self._context.held_out
        values = [
            placed.values(part)[:, placed.of_trial(held_out=held_out)]
            for placed, part in zip(self.effects, x, strict=True)
        ]
        # every simulation that has a command or start of its own is its own
        first = which = np.arange(len(parameters))
        if not self._own_commands:
            first, which = simulations(self.effects, parameters, values)
        impedance = self._impedance(parameters[first])
        out = self._simulate(parameters[first], impedance, [v[first] for v in values])
        self._sensed = out
        stride, (observed, logged) = self._setup.stride, self.channels.columns
        paths, logs = out[:, ::stride, observed], out[:, ::stride, logged]
        self._unchained: Unchained = paths[0], logs[0], [v[:1] for v in values]
        return chained(self.effects, paths[which], logs[which], values, self._context)

    def _motion(self) -> np.ndarray:
        """As of `FreeRuns`: coordinates of the axes, from their rest."""
        columns = [self.model.sensor(f"axis_{axis.joint}").adr[0] for axis in self._setup.system.axes]
        return np.asarray(
            self._sensed[0, :: self._setup.stride][:, columns] - rests_of(self._setup.system, self.model)
        )

    def linearised(self) -> ForceResponse | None:
        """Return the last call's first simulation as a linear system; None where forces do not act linearly.

        Something sticks, stops or stands at rest by forces, or a force is seen. Motors that all act on joints with a
        prescribed path move nothing, whatever sticks.
        """
        if self._prescribed:
            return PrescribedMotion(self.model, self._forces_shown)
        seen = any(o.quantity == "force" for o in self._setup.system.outputs)
        rough = self._sticks or self._setup.settled or any(p.effect.plant.weighed for p in self.effects)
        return None if seen or rough else Linearised(self.as_simulated(), self._setup.stride, self._rates)

    @property
    def _prescribed(self) -> bool:
        """Every motor of a planned force acts on a joint that follows a path."""
        if self._setup.system.drive.by != PATH:
            return False
        held = {self.model.joint(name).id for name in self._setup.system.drive.columns}
        motors = [p.effect.plant.columns(self.model, p.where) for p in self.effects if p.effect.plant.linear]
        return all(set(joints_of(self.model, columns).tolist()) <= held for columns in motors)

    @property
    def _forces_shown(self) -> dict[int, int]:
        """Sensor of each joint whose force is an output, by the joint's index."""
        first = 3 * self.channels.markers
        return {
            self.model.joint(output.joint).id: first + self.channels.outputs.index(output.column)
            for output in self._setup.system.outputs
            if output.quantity == "force"
        }

    @property
    def linearisation_cost(self) -> int:
        """Simulations that take as long as a linearisation: every other step, one either way by state and control."""
        return 0 if self._prescribed else int(2 * self.model.nv + self.model.na + self.model.nu)

    def response(
        self, linear: ForceResponse, effect: int, forces: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return how forces (p, n, j) of an effect's motors at the samples change what `run_effects` returned first.

        Observations (p, n, c) and log (p, n, j).
        """
        placed = self.effects[effect]
        sensors = linear.sensors(forces, placed.effect.plant.columns(self.model, placed.where))
        observed, logged = self.channels.columns
        moved = sensors[:, :, observed], sensors[:, :, logged]
        return chained_slopes(self.effects, self._unchained, moved, self._context)

    def as_simulated(self) -> Simulated:
        """Return model, start and command of the first simulation of the last call, as plain MuJoCo takes them."""
        position = self._starts(1)[0]
        return Simulated(self._batch.get_model(0), position, self._first_rate.copy(), self._control[0].copy())

    def _impedance(self, parameters: np.ndarray) -> InterfaceImpedance:
        system, model = self._setup.system, self.model
        stiffness = np.array([model.jnt_stiffness[j.id] for j in self._joints])
        damping = np.array([model.dof_damping[j.dofadr[0]] for j in self._joints])
        return InterfaceImpedance(
            by_axis(parameters, system.stiffness_of_axis, stiffness),
            by_axis(parameters, system.damping_of_axis, damping),
        )

    def _simulate(
        self, parameters: np.ndarray, impedance: InterfaceImpedance, values: list[np.ndarray]
    ) -> np.ndarray:
        m, batch = len(parameters), self._batch
        ids = np.arange(m)
        fields = Fields(batch, self.model, m, self._scales, self._setup.system)
        self._restore(fields)
        self._control[:m] = 0
        self._control[:m, :, self._drive] = self._commands[:m]
        self._write_parameters(fields, parameters, impedance)
        self._write_effects(fields, impedance, values, m)
        batch.reset(ids, stage=mujoco.mjtStage.mjSTAGE_NONE)
        batch.bind("qpos")[:m], batch.bind("qvel")[:m] = self._starts(m), self._start[1] + self._hurry[:m]
        self._update_constants(fields, m)
        if self._setup.settled:
            self._settle(fields, m)
        self._half_a_step_back(m)
        return self._roll(fields, m)

    def _half_a_step_back(self, m: int) -> None:
        """Let rates at the start be those of half a step before, as a leapfrog step keeps them.

        Commands of driven joints are so already, and a segment that is driven holds all that hangs on it. A machine
        that forces move would start too fast by what half a step adds.
        """
        batch, ids = self._batch, np.arange(m)
        position, rate = (batch.bind(name)[:m].copy() for name in ("qpos", "qvel"))
        if self._let_go.any():
            batch.rollout(1, self._control[:m, :1], record=(), ids=ids)
            gained = np.nan_to_num(batch.bind("qvel")[:m] - rate)
            rate[:, self._let_go] -= gained[:, self._let_go] / 2
            batch.reset(ids, stage=mujoco.mjtStage.mjSTAGE_NONE)
            batch.bind("qpos")[:m], batch.bind("qvel")[:m] = position, rate
        self._first_rate = rate[0]

    @cached_property
    def _let_go(self) -> np.ndarray:
        """Mask (nv,) of joints that neither follow a path nor hold a driven segment."""
        drive = self._setup.system.drive
        out = np.full(self.model.nv, drive.by != POSE)
        for joint in drive.columns if drive.by == PATH else ():
            out[self.model.joint(joint).dofadr[0]] = False
        return out

    def _restore(self, fields: Fields) -> None:
        """Give fields that effects change only in part their compiled values back."""
        for name in (
            "qpos_spring",
            "dof_armature",
            "body_mass",
            "body_inertia",
            "dof_damping",
            "jnt_stiffness",
        ):
            fields[name][:] = getattr(self.model, name)
        if self.model.ntendon:
            for name in ("tendon_lengthspring", "tendon_range"):
                fields[name][:] = getattr(self.model, name)
        held = [j.name for j in self._setup.system.machine if j.impedance is not None]
        for name in held:
            joint = self.model.joint(name)
            fields["qpos_spring"][:, joint.qposadr[0]] = self._starts(fields.m)[:, joint.qposadr[0]].ravel()

    def _write_parameters(
        self, fields: Fields, parameters: np.ndarray, impedance: InterfaceImpedance
    ) -> None:
        system, model, h = self._setup.system, self.model, self.model.opt.timestep
        for axis, joint in enumerate(self._joints):
            dof = joint.dofadr[0]
            fields["jnt_stiffness"][:, joint.id] = impedance.k[:, axis]
            fields["dof_damping"][:, dof] = impedance.d[:, axis]
            # centred steps: implicit damping is an inertia of half of it times the step
            fields["dof_armature"][:, dof] = model.dof_armature[dof] - impedance.d[:, axis] * h / 2
        for column, parameter in enumerate(system.parameters):
            if parameter.sets == MASS:
                fields["body_mass"][:, model.body(parameter.of).id] = parameters[:, column]
        offsets = [i for i, p in enumerate(system.parameters) if p.sets == "offset"]
        self._control[: len(parameters), :, self._offsets] = parameters[:, None, offsets]

    def _write_effects(
        self, fields: Fields, impedance: InterfaceImpedance, values: list[np.ndarray], m: int
    ) -> None:
        order = sorted(range(len(self.effects)), key=lambda i: self.effects[i].effect.plant.order)
        for i in order:
            placed, value = self.effects[i], values[i]
            plant, where = placed.effect.plant, placed.where
            plant.set(fields, where, impedance, value)
            force = plant.force(value, self._context, where, impedance)
            if force is not None:
                self._control[:m, :, plant.columns(self.model, where)] += force
        # an effect's law is about the place where the axis rests, which an MJCF can put elsewhere than at zero
        for joint, rest in zip(self._joints, rests_of(self._setup.system, self.model), strict=True):
            if rest:
                move_tendons(fields, joint.id, np.full(m, rest), self._own_tendons)
        self._failed[:] = False
        for i in self._chains:
            self._write_input_chain(self.effects[i], values[i], m)
        for placed, value in zip(self.effects, values, strict=True):
            placed.effect.plant.before_run(fields, placed.where, impedance, value)
        # an implicit damper is an inertia of damping times step, which constraints do not see: as one proper, the same
        # motion is held
        fields["dof_armature"][:] += self.model.opt.timestep * fields["dof_damping"]

    def _write_input_chain(self, placed: Placed, values: np.ndarray, m: int) -> None:
        chain = placed.effect.chains.input
        assert chain is not None
        context = self._context
        plain = self.command_for(context.pelvis_rotation, context.pelvis_position)
        changed: dict[bytes, np.ndarray] = {}
        for k in range(m):
            key = values[k].tobytes()
            if key not in changed:
                try:
                    changed[key] = self.command_for(*chain(values[k], context)) - plain
                except ValueError:
                    # farther than a segment can be driven: no simulation, like one that MuJoCo gives up on
                    changed[key] = np.zeros_like(plain)
                    self._impossible.add(key)
            self._failed[k] |= key in self._impossible
            self._control[k, :, self._drive] += changed[key]

    def _update_constants(self, fields: Fields, m: int) -> None:
        """Let MuJoCo know changed inertia where it takes that of a lone joint as it was compiled."""
        model = self.model
        lone = np.flatnonzero(model.dof_simplenum > 0)
        bodies = model.dof_bodyid[lone]
        slide = model.jnt_type[model.dof_jntid[lone]] == mujoco.mjtJoint.mjJNT_SLIDE
        if len(lone):
            added = fields["dof_armature"][:, lone] - model.dof_armature[lone]
            mass = fields["body_mass"][:, bodies] - model.body_mass[bodies]
            turn = (fields["body_inertia"][:, bodies] - model.body_inertia[bodies]).mean(axis=2)
            fields["dof_M0"][:, lone] = model.dof_M0[lone] + added + np.where(slide, mass, turn)
        if any(p.effect.plant.weighed for p in self.effects):
            state = [self._batch.bind(name)[:m].copy() for name in ("qpos", "qvel")]
            self._batch.set_const(np.arange(m))
            self._batch.bind("qpos")[:m], self._batch.bind("qvel")[:m] = state

    def _settle(self, fields: Fields, m: int) -> None:
        """Let springs of the machine rest where they balance what pulls at the start, with the segment held."""
        model, batch = self.model, self._batch
        position = self._starts(m)
        for placed in self.effects:
            placed.effect.plant.relax(fields, placed.where, position)
        batch.bind("qpos")[:m], batch.bind("qvel")[:m] = position, 0
        force = self._standing_force(m)
        held = [model.joint(j.name) for j in self._setup.system.machine if j.impedance is not None]
        dofs = np.array([j.dofadr[0] for j in held], int)
        for k in range(m):
            free = self._free_motions(position[k])
            stiffness = np.array([fields["jnt_stiffness"][k, j.id] for j in held])
            lever = free[:, dofs] * stiffness
            shift = -np.linalg.lstsq(lever, free @ force[k], rcond=None)[0]
            for j, by in zip(held, shift, strict=True):
                fields["qpos_spring"][k, j.qposadr[0]] += by
        batch.reset(np.arange(m), stage=mujoco.mjtStage.mjSTAGE_NONE)
        batch.bind("qpos")[:m], batch.bind("qvel")[:m] = position, self._start[1] + self._hurry[:m]

    def _standing_force(self, m: int) -> np.ndarray:
        """Forces (m, nv) of springs, weight, offsets and effects on the joints of the first step, without the drive."""
        model, control = self.model, self._control[:m, 0]
        done = self._batch.rollout(
            1, self._control[:m, :1], record=("qfrc_passive", "qfrc_bias"), ids=np.arange(m)
        )
        force = done["qfrc_passive"][:, 0] - done["qfrc_bias"][:, 0]
        pushed = [
            p.effect.plant.columns(model, p.where) for p in self.effects if p.effect.plant.control_is_force
        ]
        for columns in (*pushed, self._offsets):
            if len(columns):
                force[:, model.jnt_dofadr[joints_of(model, columns)]] += control[:, columns]
        return np.asarray(force)

    @property
    def _offsets(self) -> np.ndarray:
        """Control columns of the parameters that are constant forces."""
        system, model = self._setup.system, self.model
        axes = [system.axes[system.axis_names.index(p.of)] for p in system.parameters if p.sets == "offset"]
        actuators = [model.actuator(f"offset_{axis.joint}").id for axis in axes]
        return np.asarray(model.actuator_ctrladr[actuators], int)

    def _free_motions(self, position: np.ndarray) -> np.ndarray:
        """Orthonormal joint rates (k, nv) that leave the segment, loops and driven joints where they are."""
        model = self.model
        data = mujoco.MjData(model)
        data.qpos[:] = position
        mujoco.mj_fwdPosition(model, data)
        rows = []
        if self._setup.segment is not None:
            jac = np.zeros((6, model.nv))
            mujoco.mj_jacSite(model, data, jac[:3], jac[3:], model.site(DRIVEN_SITE).id)
            rows.append(jac)
        for joint in self._setup.system.drive.columns if self._setup.system.drive.by == PATH else ():
            row = np.zeros((1, model.nv))
            row[0, model.joint(joint).dofadr[0]] = 1
            rows.append(row)
        if not rows:
            return np.eye(model.nv)
        _, sizes, directions = np.linalg.svd(np.vstack(rows))
        return directions[int(np.sum(sizes > 1e-9)) :]

    def _roll(self, fields: Fields, m: int) -> np.ndarray:
        """Step to the end; observations and log (m, nstep, c + j)."""
        forced = [o for o in self._setup.system.outputs if o.quantity == "force"]
        record = ("sensordata", *(_FORCES if forced else ()))
        done = self._batch.rollout(self.nstep, self._control[:m], record=record, ids=np.arange(m))
        out = done["sensordata"].copy()
        out[:, :, self._rates] = centred(out[:, :, self._rates])
        for output in forced:
            column = 3 * self.channels.markers + self.channels.outputs.index(output.column)
            out[:, :, column] = self._drive_force(fields, done, output.joint, m)
        warning = self._batch.warning[:m]
        out[warning.any(axis=tuple(range(1, warning.ndim))) | self._failed[:m]] = np.nan
        return np.asarray(out)

    def _drive_force(self, fields: Fields, done: Mapping[str, np.ndarray], joint: str, m: int) -> np.ndarray:
        """Force (m, nstep) that moves a driven joint along its path: inertia times acceleration, less other forces.

        The joint is alone on its chain (`along_path`): weight and what its springs and dampers do are all other forces.
        """
        model, setup = self.model, self._setup
        index = model.joint(joint)
        dof = int(index.dofadr[0])
        if self._accelerations is None:
            raise InputError(
                setup.system.model,
                f"joint {joint}",
                "an output that is the force on a joint without a prescribed path",
                "a joint of drive.of, driven by path",
                "Drive it, or measure its position.",
            )
        others = [
            a
            for a in range(model.nu)
            if model.actuator_trnid[a, 0] == index.id and a >= setup.commands.shape[1]
        ]
        force = done["qfrc_passive"][:, :, dof] + done["qfrc_constraint"][:, :, dof]
        force = force - done["qfrc_bias"][:, :, dof] + done["actuator_force"][:, :, others].sum(axis=2)
        column = list(setup.system.drive.columns).index(joint)
        acceleration = np.repeat(self._accelerations[:m, :, column], setup.stride, axis=1)[:, : self.nstep]
        inertia = self._along_path[joint].inertia(fields["body_mass"][:m], fields["body_inertia"][:m])
        # the rate of a step is that of half a step before
        late = fields["dof_damping"][:m, dof, None] * model.opt.timestep / 2 * acceleration
        return np.asarray(inertia[:, None] * acceleration - force + late)

    @property
    def _rates(self) -> list[int]:
        """Columns of the sensor data that are outputs of a joint's rate."""
        first = 3 * self.channels.markers
        return [first + i for i, o in enumerate(self._setup.system.outputs) if o.quantity == "velocity"]

    @cached_property
    def _along_path(self) -> dict[str, LoneJoint]:
        """Joints whose force is an output, by name."""
        system = self._setup.system
        # the plant's own joint has the inertia that holds it to its path
        spec = load_model(system)
        forced = [o.joint for o in system.outputs if o.quantity == "force"]
        return {n: lone_joint(self.model, n, float(spec.joint(n).armature), system.model) for n in forced}


def _sensor(spec: mujoco.MjSpec, name: str, kind: mujoco.mjtSensor, obj: mujoco.mjtObj, target: str) -> None:
    spec.add_sensor(name=name, type=kind, objtype=obj, objname=target)


def substeps(effects: Sequence[Placed], timestep: float) -> int:
    """Return into how many parts a time step [s] is divided for these effects."""
    finest = max([1, *(p.effect.plant.substeps for p in effects)])
    return max(1, int(np.ceil(timestep * finest / _REFERENCE_STEP_S - 1e-9)))


__all__ = ["LETTERS", "Setup", "SystemReplay", "substeps", "supports"]
