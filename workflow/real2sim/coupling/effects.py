"""Effects that the plain plant leaves out, as declarative entries: what they are and how the simulation gets them.

Each entry of `EFFECTS` names an effect of the sim-to-real gap, its stage, equation, free parameters with units and
bounds, the effects it is confused with and the trial that would tell them apart. How it acts is one of a few mechanisms
that MuJoCo has natively (springs with a dead band, polynomials, elasto-plastic springs, LuGre, a hidden joint, fields
of the model), or a change of the pelvis path that is replayed (input chain) or of the simulated marker paths (output
chain). Adding an effect is one entry.

Parameters are searched without dimension: an SI value is the searched number times a scale that comes from the trial
(`Scales`), so that bounds and starts hold for millimetres and for radians.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from itertools import combinations
from typing import Protocol

import mujoco
import numpy as np
from scipy.interpolate import CubicSpline
from scipy.signal import butter, lfilter, sosfilt
from scipy.spatial.transform import Rotation

from real2sim.coupling.plant import ROBOT_JOINTS, STRAP_JOINTS
from real2sim.geometry import AXES, interface_frame

TRANSLATIONAL = AXES[:3]


@dataclass(frozen=True)
class Scales:
    """What the effects' parameters are measured in, for one person.

    ``q``, ``v`` (6,) are large excursions and rates of the interface [m, rad; m/s, rad/s], ``k``, ``d`` (6,) stiffness
    and damping of the plain fit, ``inertia`` (6,) what the robot puts against each strap axis [kg, kg m^2].
    """

    q: np.ndarray
    v: np.ndarray
    k: np.ndarray
    d: np.ndarray
    inertia: np.ndarray

    @property
    def force(self) -> np.ndarray:
        """Strap force in a large excursion (6,) [N, Nm]."""
        return self.k * self.q + self.d * self.v


@dataclass(frozen=True)
class EffectParameter:
    """One free parameter: searched between ``lower`` and ``upper`` (in units of ``scale``), from each of ``starts``.

    ``log`` searches the logarithm. ``scale`` maps scales and axis index to the SI value of 1; ``unit`` is the unit for
    a translation, with the one for a rotation after a bar where it differs. ``prior_sd`` (of the searched number)
    holds linear nuisance-like parameters near 0.
    """

    name: str
    unit: str
    lower: float
    upper: float
    starts: tuple[float, ...]
    scale: Callable[[Scales, int], float] = lambda scales, axis: 1.0
    log: bool = False
    prior_sd: float | None = None

    def unit_for(self, axis: str | None) -> str:
        """Unit for an axis of the interface; None where the effect has none."""
        both = self.unit.split("|")
        return both[-1] if axis is not None and axis not in TRANSLATIONAL else both[0]


class Mechanism(Protocol):
    """How an effect of the plant is compiled into it and set per simulation."""

    def build(self, spec: mujoco.MjSpec, where: Where) -> None:
        """Add elements to the plant, neutral or not."""

    def set(self, fields: Fields, where: Where, parameters: np.ndarray, values: np.ndarray) -> None:
        """Write values (m, p) [SI] and what follows from the strap parameters (m, 12) into the fields."""


@dataclass(frozen=True)
class Where:
    """Where an effect acts: axis indices, a side (+1, -1, or 0 for none), a variant of its form; and whose it is."""

    axes: tuple[int, ...] = ()
    side: int = 0
    variant: str = ""
    owner: str = ""

    @property
    def tag(self) -> str:
        """Suffix for the names of what is built there."""
        side = {1: "_upper", -1: "_lower", 0: ""}[self.side]
        return "_".join(AXES[a] for a in self.axes) + side + self.variant

    @property
    def element(self) -> str:
        """Ending of the names of elements in the model: no two effects share them."""
        return f"{self.owner}_{self.tag}"


class Fields:
    """Fields of the plant's batch, expanded per simulation when they are first asked for."""

    def __init__(self, batch, model: mujoco.MjModel, m: int, scales: Scales):
        self._batch, self.model, self.m, self.scales = batch, model, m, scales

    def __getitem__(self, name: str) -> np.ndarray:
        return self._batch.expand(name)[: self.m]

    def joint(self, axis: int) -> int:
        """Joint index of a strap axis."""
        return self.model.joint(STRAP_JOINTS[axis]).id

    def dof(self, axis: int) -> int:
        """Degree of freedom of a strap axis."""
        return int(self.model.joint(STRAP_JOINTS[axis]).dofadr[0])

    def tendon(self, name: str) -> int:
        """Index of a tendon."""
        return self.model.tendon(name).id

    def stiffest(self, axis: int) -> float:
        """Stiffness that the time step bears on a strap axis."""
        return float(0.5 * self.scales.inertia[axis] / self.model.opt.timestep**2)


def _tendon(spec: mujoco.MjSpec, name: str, joints: dict[str, float], **attributes) -> None:
    tendon = spec.add_tendon(name=name, **attributes)
    for joint, coefficient in joints.items():
        tendon.wrap_joint(joint, coefficient)


_FAR = 10.0  # a dead band's end that is never reached [m, rad]


class SplitSpring:
    """The axis' spring replaced by two one-way springs: one pulls below ``low``, one above ``high``.

    ``shape`` maps values (m, p) to (low, high, factor of the lower, factor of the upper stiffness), each (m,).
    """

    def __init__(self, shape: Callable[[np.ndarray, Where], tuple]):
        self._shape = shape

    def build(self, spec, where):
        """Two fixed tendons over the strap joint."""
        joint = STRAP_JOINTS[where.axes[0]]
        for half in ("below", "above"):
            _tendon(
                spec, f"{half}_{where.element}", {joint: 1.0}, stiffness=[1, 0, 0], springlength=[-_FAR, _FAR]
            )

    def set(self, fields, where, parameters, values):
        """Dead bands and stiffness of both tendons; the joint's own spring is off."""
        axis = where.axes[0]
        low, high, lower, upper = self._shape(values, where)
        below, above = fields.tendon(f"below_{where.element}"), fields.tendon(f"above_{where.element}")
        fields["jnt_stiffness"][:, fields.joint(axis)] = 0
        fields["tendon_lengthspring"][:, below, 0], fields["tendon_lengthspring"][:, below, 1] = low, _FAR
        fields["tendon_lengthspring"][:, above, 0], fields["tendon_lengthspring"][:, above, 1] = -_FAR, high
        fields["tendon_stiffness"][:, below] = lower * parameters[:, axis]
        fields["tendon_stiffness"][:, above] = upper * parameters[:, axis]


class OneSided:
    """A share of the axis' spring pulls to one side alone, beyond a coordinate: values are place and share, (m, 2)."""

    def build(self, spec, where):
        """One fixed tendon over the strap joint."""
        joint = STRAP_JOINTS[where.axes[0]]
        _tendon(
            spec, f"one_sided_{where.element}", {joint: 1.0}, stiffness=[1, 0, 0], springlength=[-_FAR, _FAR]
        )

    def set(self, fields, where, parameters, values):
        """The joint keeps the rest of its spring; the tendon's free side is the dead band."""
        axis, index = where.axes[0], fields.tendon(f"one_sided_{where.element}")
        place, share = values.T
        fields["jnt_stiffness"][:, fields.joint(axis)] = (1 - share) * parameters[:, axis]
        fields["tendon_lengthspring"][:, index, 1 if where.side > 0 else 0] = where.side * place
        fields["tendon_stiffness"][:, index] = share * parameters[:, axis]


class Polynomial:
    """Higher terms of the axis' spring or damper: ``field`` and which of its two coefficients."""

    def __init__(self, name: str, term: int):
        self._name, self._term = name, term

    def build(self, spec, where):
        """Nothing: every joint has them."""

    def set(self, fields, where, parameters, values):
        """Write the coefficient."""
        axis = where.axes[0]
        index = fields.joint(axis) if self._name.startswith("jnt") else fields.dof(axis)
        fields[self._name][:, index, self._term] = values[:, 0]


class Elastoplastic:
    """Springs in parallel that yield one after the other: values are yield force and yield travel, (m, 2).

    Equal springs whose travels are quantiles of an exponential law: together they approach the force as
    1 - exp(-x / travel), as the Bouc-Wen law of exponent 1 does, with the memory of reversals that Masing described.
    """

    def __init__(self, elements: int):
        self.travels = -np.log(1 - (np.arange(elements) + 0.5) / elements)

    def _names(self, where: Where) -> list[str]:
        return [f"yield{i}_{where.element}" for i in range(len(self.travels))]

    def build(self, spec, where):
        """One yielding tendon per element."""
        for name in self._names(where):
            _yielding_tendon(spec, name, where)

    def set(self, fields, where, parameters, values):
        """Stiffness so that they yield at the force; never stiffer than the time step bears."""
        stiffness = values[:, 0] / values[:, 1] / self.travels.sum() * len(self.travels)
        share = np.minimum(stiffness, fields.stiffest(where.axes[0])) / len(self.travels)
        for name, travel in zip(self._names(where), self.travels, strict=True):
            index = fields.tendon(name)
            fields["tendon_stiffness"][:, index] = share
            fields["tendon_springyield"][:, index] = (
                travel * values[:, 1] * stiffness / (share * len(self.travels))
            )

    def along(self, q: np.ndarray, values: np.ndarray) -> np.ndarray:
        """Force (m, n) of the springs along a coordinate (n,) that they rest at the origin of."""
        slips = self.travels * values[:, 1:]
        stiffness = values[:, :1, None] / values[:, 1:, None] / self.travels.sum()
        stretch = np.empty((len(values), len(q), len(self.travels)))
        stretch[:, 0] = np.clip(q[0], -slips, slips)
        for i, way in enumerate(np.diff(q)):
            stretch[:, i + 1] = np.clip(stretch[:, i] + way, -slips, slips)
        return np.asarray((stiffness * stretch).sum(axis=2))


def _yielding_tendon(spec: mujoco.MjSpec, name: str, where: Where) -> None:
    joint = {STRAP_JOINTS[where.axes[0]]: 1.0}
    _tendon(spec, name, joint, stiffness=[1, 0, 0], springlength=[0, 0], springyield=0.01)


class DryFriction:
    """Coulomb friction as a constraint, which sticks and slips at any time step: value (m, 1) is its force.

    The constraint is made as hard as MuJoCo allows; its default lets the joint creep.
    """

    def build(self, spec, where):
        """Friction of the joint, which has to be there when compiled."""
        joint = spec.joint(STRAP_JOINTS[where.axes[0]])
        joint.frictionloss = 1e-6
        joint.solref_friction = [2.0 * spec.option.timestep, 1.0]
        joint.solimp_friction = [0.9999, 0.9999, 0.001, 0.5, 2.0]

    def set(self, fields, where, parameters, values):
        """Write the force."""
        fields["dof_frictionloss"][:, fields.dof(where.axes[0])] = np.maximum(values[:, 0], 1e-9)


class Bristles:
    """LuGre friction of MuJoCo's motor model: values are Coulomb force, static excess, deflection, Stribeck rate.

    Source: Canudas de Wit et al., IEEE Trans. Autom. Control 40 (1995) 419.
    """

    def build(self, spec, where):
        """A passive motor without an electrical side."""
        actuator = spec.add_actuator(
            name=f"bristles_{where.element}",
            trntype=mujoco.mjtTrn.mjTRN_JOINT,
            target=STRAP_JOINTS[where.axes[0]],
        )
        # the compiled form of <dcmotor input="none" motorconst="0" resistance="1" lugre="...">, which the interface for
        # descriptions refuses to write because it wants a motor constant
        actuator.dyntype = mujoco.mjtDyn.mjDYN_DCMOTOR
        actuator.gaintype = mujoco.mjtGain.mjGAIN_DCMOTOR
        actuator.biastype = mujoco.mjtBias.mjBIAS_DCMOTOR
        actuator.gainprm = [1] + [0] * 9
        actuator.biasprm = [0, 0, 0, 0.001, 0.001, 0.01, 0, 0, 0, 0]
        actuator.dynprm = [0, 0, 0, 0, 0, 1, 0.1, 0, 0, 0]
        actuator.ctrlspec, actuator.actdim, actuator.actearly = 0, 1, True

    def set(self, fields, where, parameters, values):
        """Bristle stiffness so that it slips at the deflection, bristles damped half critically for the step."""
        axis = where.axes[0]
        index = fields.model.actuator(f"bristles_{where.element}").id
        force, excess, deflection, rate = values.T
        stiffness = np.minimum(np.abs(force) / deflection, fields.stiffest(axis))
        fields["actuator_dynprm"][:, index, 5] = stiffness
        fields["actuator_dynprm"][:, index, 6] = 0
        fields["actuator_biasprm"][:, index, 3] = force
        fields["actuator_biasprm"][:, index, 4] = force * (1 + excess)
        fields["actuator_biasprm"][:, index, 5] = rate


class Maxwell:
    """Springs and dampers in series beside the axis' own: values are stiffness and shortest time constant, (m, 2).

    ``branches`` of equal stiffness, which adds up to the value, have time constants that grow by ``ratio``: together
    they relax with the logarithm of time. The point between spring and damper of each is a hidden slide in the world,
    tied to the strap joint by a tendon.
    """

    def __init__(self, branches: int = 1, ratio: float = 1.0):
        self._ratios = ratio ** np.arange(branches)

    def _names(self, where: Where) -> list[str]:
        return [f"maxwell{i or ''}_{where.element}" for i in range(len(self._ratios))]

    def build(self, spec, where):
        """Hidden slide and tendon of each branch."""
        for name in self._names(where):
            body = spec.worldbody.add_body(
                name=name, mass=1e-6, inertia=[1e-9] * 3, explicitinertial=True, gravcomp=1
            )
            body.add_joint(name=name, type=mujoco.mjtJoint.mjJNT_SLIDE, axis=[1, 0, 0], damping=[1, 0, 0])
            joints = {STRAP_JOINTS[where.axes[0]]: 1.0, name: -1.0}
            _tendon(spec, name, joints, stiffness=[1, 0, 0], springlength=[0, 0])

    def set(self, fields, where, parameters, values):
        """Stiffness and damping. The slides need no inertia: their damping is implicit."""
        for name, ratio in zip(self._names(where), self._ratios, strict=True):
            dof = int(fields.model.joint(name).dofadr[0])
            stiffness = values[:, 0] / len(self._ratios)
            fields["tendon_stiffness"][:, fields.tendon(name)] = stiffness
            fields["dof_damping"][:, dof] = stiffness * values[:, 1] * ratio


class Coupling:
    """Off-diagonal stiffness or damping between two axes, value (m, 1), the diagonal left alone.

    Two tendons over the sum and the difference of the (scaled) coordinates, with opposite signs: their diagonal terms
    cancel, the product term is left.
    """

    def __init__(self, name: str):
        self._field = name

    def build(self, spec, where):
        """Both tendons."""
        a, b = (STRAP_JOINTS[i] for i in where.axes)
        for sign, name in ((1.0, "sum"), (-1.0, "difference")):
            _tendon(
                spec, f"{name}_{where.element}", {a: 1.0, b: sign}, stiffness=[1, 0, 0], springlength=[0, 0]
            )

    def set(self, fields, where, parameters, values):
        """Half the value on each, with opposite signs."""
        for sign, name in ((1, "sum"), (-1, "difference")):
            index = fields.tendon(f"{name}_{where.element}")
            fields["tendon_stiffness"][:, index] = 0
            fields[self._field][:, index] = sign * values[:, 0] / 2


class TurnedAxes:
    """All strap axes turned by a rotation vector, values (m, 3) [rad]."""

    def build(self, spec, where):
        """Nothing: axes are fields."""

    def set(self, fields, where, parameters, values):
        """Turn the axis of each joint."""
        turn = Rotation.from_rotvec(values).as_matrix()
        for axis in range(6):
            joint = fields.joint(axis)
            fields["jnt_axis"][:, joint] = turn @ fields.model.jnt_axis[joint]


def _pelvis_at_rest(model: mujoco.MjModel) -> np.ndarray:
    """Pelvis in the interface's axes at rest, (3, 3); the interface is level, so the last row is the vertical."""
    rest = np.zeros(9)
    mujoco.mju_quat2Mat(rest, model.body("pelvis").quat)
    return rest.reshape(3, 3)


class TurnedBack:
    """All strap axes turned about the vertical against a turn of the pelvis' path, value (m, 1) [rad]."""

    def build(self, spec, where):
        """Nothing: axes are fields."""

    def set(self, fields, where, parameters, values):
        """The path carries the axes along with it; the strap hangs on the person all the same."""
        vertical = _pelvis_at_rest(fields.model)[2]
        TurnedAxes().set(fields, where, parameters, -values * vertical)


class RestShift:
    """The axis' spring rests elsewhere: value (m, 1)."""

    def build(self, spec, where):
        """Nothing: the rest pose is a field."""

    def set(self, fields, where, parameters, values):
        """Spring reference of the joint."""
        joint = fields.model.joint(STRAP_JOINTS[where.axes[0]])
        fields["qpos_spring"][:, joint.qposadr[0]] = values[:, 0]


class Stop:
    """A stiff one-way spring beyond a coordinate, values are place and stiffness (m, 2)."""

    def build(self, spec, where):
        """One tendon."""
        joint = STRAP_JOINTS[where.axes[0]]
        _tendon(spec, f"stop_{where.element}", {joint: 1.0}, stiffness=[1, 0, 0], springlength=[-_FAR, _FAR])

    def set(self, fields, where, parameters, values):
        """Its free side is the dead band."""
        index, axis = fields.tendon(f"stop_{where.element}"), where.axes[0]
        end = 1 if where.side > 0 else 0
        fields["tendon_lengthspring"][:, index, end] = where.side * values[:, 0]
        fields["tendon_stiffness"][:, index] = np.minimum(values[:, 1], fields.stiffest(axis))


class InterfaceMass:
    """Mass and isotropic inertia that the twin's interface body lacks, values (m, 2) [kg, kg m^2]."""

    def build(self, spec, where):
        """Nothing: mass is a field."""

    def set(self, fields, where, parameters, values):
        """Add to the body."""
        body = fields.model.body("interface").id
        fields["body_mass"][:, body] = fields.model.body_mass[body] + values[:, 0]
        fields["body_inertia"][:, body] = fields.model.body_inertia[body] + values[:, 1:2]


class RobotImpedance:
    """Other impedance of the robot's joints than configured: ln-factors on stiffness and damping of some joints."""

    def __init__(self, joints: tuple[str, ...]):
        self._joints = joints

    def build(self, spec, where):
        """Nothing: impedances are fields."""

    def set(self, fields, where, parameters, values):
        """Scale, with the step's centring of the damping."""
        factor, h = np.exp(values), fields.model.opt.timestep
        for column, name in enumerate(self._joints):
            joint = fields.model.joint(name)
            dof, base = int(joint.dofadr[0]), fields.model.dof_damping[joint.dofadr[0]]
            fields["jnt_stiffness"][:, joint.id] = (
                fields.model.jnt_stiffness[joint.id] * factor[:, 2 * column]
            )
            damping = base * factor[:, 2 * column + 1]
            fields["dof_damping"][:, dof] = damping
            fields["dof_armature"][:, dof] = fields.model.dof_armature[dof] + (base - damping) * h / 2


class PlannedForce:
    """Forces on some joints, planned before the simulation from what was measured, and fed in as controls.

    ``force`` maps values (m, p), context, place and strap parameters (m, 12) to (m, steps, j) [N, Nm]; ``joints`` are
    names, or None for the strap joint of the effect's axis.
    """

    def __init__(self, force: Callable[..., np.ndarray], joints: tuple[str, ...] | None = None):
        self.force, self._joints = force, joints

    def columns(self, model: mujoco.MjModel, where: Where) -> np.ndarray:
        """Columns of the control that belong to the motors."""
        return np.array([model.actuator_ctrladr[model.actuator(n).id] for n in self._names(where)])

    def _names(self, where: Where) -> list[str]:
        return [f"planned_{joint}_{where.element}" for joint in self._targets(where)]

    def _targets(self, where: Where) -> tuple[str, ...]:
        return self._joints or (STRAP_JOINTS[where.axes[0]],)

    def build(self, spec, where):
        """Motors."""
        for name, joint in zip(self._names(where), self._targets(where), strict=True):
            actuator = spec.add_actuator(name=name, trntype=mujoco.mjtTrn.mjTRN_JOINT, target=joint)
            actuator.set_to_motor()

    def set(self, fields, where, parameters, values):
        """Nothing: forces are controls."""


class BoucWen(PlannedForce):
    """Bouc-Wen of exponent 1, values (m, 3) are stiffness, loading and dissipation of `_bouc_wen`.

    MuJoCo has no such element. Yielding springs with the same loading curve stand for most of it and answer to the
    simulated motion; what the law differs from them is planned along the measured coordinate. Were all of it planned, a
    stiff element would make a force of that coordinate's noise, and hold nothing in the simulation.
    """

    def __init__(self, elements: int):
        super().__init__(self._difference)
        self._springs = Elastoplastic(elements)

    def build(self, spec, where):
        """Yielding tendons and a motor."""
        self._springs.build(spec, where)
        super().build(spec, where)

    def set(self, fields, where, parameters, values):
        """Springs of the law's stiffness that yield along its loading curve."""
        self._springs.set(fields, where, parameters, self._yielding(values))

    def _yielding(self, values: np.ndarray) -> np.ndarray:
        # force and travel of those springs; a slope that does not fall makes springs that never yield
        travel = 1 / np.maximum(values[:, 1], 1e-3)
        return np.stack([values[:, 0] * travel * self._springs.travels.mean(), travel], axis=1)

    def _difference(self, values, context, where, parameters):
        q = CubicSpline(context.time_s, context.coordinates[:, where.axes[0]])(context.step_time_s)
        return (self._springs.along(q, self._yielding(values)) - _bouc_wen(values, q))[:, :, None]


@dataclass
class Context:
    """What the chains and forces of a trial are computed from.

    ``time_s`` (n,) samples and ``step_time_s`` (nstep,) steps; ``pelvis_rotation`` (n, 3, 3), ``pelvis_position``
    (n, 3); ``interface_rotation`` (n, 3, 3) measured; ``start`` sample index up to which the person stands;
    ``robot_mass`` [kg]; ``measured`` (n, 2, 3) interface markers and ``spikes`` (n, 2) where they jump;
    ``coordinates`` and ``rates`` (n, 6) of the interface; ``neutral_rotation`` (3, 3) and ``neutral_position`` (3,) of
    the pelvis in the neutral trial [m, world], where the rest pose was taken.
    """

    time_s: np.ndarray
    step_time_s: np.ndarray
    pelvis_rotation: np.ndarray
    pelvis_position: np.ndarray
    interface_rotation: np.ndarray
    start: int
    robot_mass: float
    measured: np.ndarray
    spikes: np.ndarray
    coordinates: np.ndarray
    rates: np.ndarray
    neutral_rotation: np.ndarray
    neutral_position: np.ndarray


# ---------------------------------------------------------------- how the interface was seen


@dataclass(frozen=True)
class Sight:
    """What the plant is set up by: poses of the interface in the world at the start, and in the pelvis at rest.

    ``heading`` [rad] is how far the robot's log, laid on the interface's markers, is turned from the world.
    """

    rotation: np.ndarray
    position: np.ndarray
    rest_rotation: np.ndarray
    rest_position: np.ndarray
    heading: float = 0.0


class Sighting(Protocol):
    """An effect by which the interface's markers are not where it is."""

    def true(self, values: np.ndarray, seen: Sight, context: Context) -> Sight:
        """What was the case, from what was seen, for values (p,)."""

    def seen(
        self, paths: np.ndarray, rotation: np.ndarray, values: np.ndarray, context: Context
    ) -> np.ndarray:
        """Marker paths (m, n, 2, 3) for joint centres and rotation (m, n, 3, 3) of the interface, values (m, p)."""


class TurnedLab:
    """The interface's markers are seen in a lab turned about the vertical, values (m, 1) [rad]."""

    def true(self, values, seen, context):
        """Turned back about the lab's origin, in the neutral trial as well."""
        back = Rotation.from_rotvec([0, 0, -values[0]]).as_matrix()
        pelvis, origin = context.neutral_rotation, context.neutral_position
        return Sight(
            back @ seen.rotation,
            back @ seen.position,
            pelvis.T @ back @ pelvis @ seen.rest_rotation,
            pelvis.T @ (back @ (origin + pelvis @ seen.rest_position) - origin),
            seen.heading + float(values[0]),
        )

    def seen(self, paths, rotation, values, context):
        """Turned about the lab's origin."""
        turn = Rotation.from_rotvec(values * np.array([0.0, 0.0, 1.0])).as_matrix()
        return np.einsum("mij,mnkj->mnki", turn, paths)


class OffCentre:
    """Markers that sit off the joint centres, fixed in the interface: values (m, 6) [m, interface], left and right."""

    def true(self, values, seen, context):
        """Pose from the centres; of the neutral trial's, from its mean pelvis."""
        pelvis, origin = context.neutral_rotation, context.neutral_position
        left, right = context.measured[: context.start].mean(axis=0)
        half = float(np.linalg.norm(left - right)) / 2
        offsets = values.reshape(2, 3)
        rotation, position = _from_centres(seen.rotation, seen.position, half, offsets)
        rest = pelvis @ seen.rest_rotation, origin + pelvis @ seen.rest_position
        rest_rotation, rest_position = _from_centres(*rest, half, offsets)
        turned = seen.rotation @ rotation.T
        return Sight(
            rotation,
            position,
            pelvis.T @ rest_rotation,
            pelvis.T @ (rest_position - origin),
            seen.heading + float(np.arctan2(turned[1, 0], turned[0, 0])),
        )

    def seen(self, paths, rotation, values, context):
        """Joint centres and their offsets."""
        return paths + np.einsum("mnij,mkj->mnki", rotation, values.reshape(-1, 2, 3))


def _from_centres(
    rotation: np.ndarray, position: np.ndarray, half: float, offsets: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Pose of the interface from that of its markers, ``half`` [m] from their middle, with offsets (2, 3) [m]."""
    markers = position + half * np.array([rotation[:, 1], -rotation[:, 1]])
    true = rotation
    # the offsets are known in the axes that are sought
    for _ in range(3):
        left, right = markers - offsets @ true.T
        true, centre = interface_frame(left, right, rotation[:, 2])
    return true, centre


# ---------------------------------------------------------------- input and output chain


def _turned_motion(values, context):
    # The pelvis in the interface's frame, turned about the vertical through the lab's origin. The rest pose was taken
    # in two frames too: what it holds of the turn at the place of the neutral trial goes with the pelvis.
    turn = Rotation.from_rotvec([0, 0, -values[0]]).as_matrix()
    rest, where = context.neutral_rotation, context.neutral_position
    fixed = rest.T @ turn.T @ rest
    offset = rest.T @ turn.T @ (where - turn @ where)
    rotation = turn @ context.pelvis_rotation
    return rotation @ fixed, context.pelvis_position @ turn.T + rotation @ offset


def _earlier_pelvis(values, context):
    # the measured pelvis is late: it was there already
    t = np.clip(context.time_s + values[0], context.time_s[0], context.time_s[-1])
    position = CubicSpline(context.time_s, context.pelvis_position)(t)
    vectors = Rotation.from_matrix(context.pelvis_rotation[0].T @ context.pelvis_rotation).as_rotvec()
    return (
        context.pelvis_rotation[0]
        @ Rotation.from_rotvec(CubicSpline(context.time_s, vectors)(t)).as_matrix(),
        position,
    )


def _soft_tissue(values, context):
    # skin moves over bone in proportion to how far the pelvis has turned: translation and rotation artefact
    start = context.pelvis_rotation[0]
    turn = Rotation.from_matrix(start.T @ context.pelvis_rotation).as_rotvec()
    moved = turn @ values[:9].reshape(3, 3).T
    spun = turn @ values[9:].reshape(3, 3).T
    rotation = context.pelvis_rotation @ Rotation.from_rotvec(-spun).as_matrix()
    return rotation, context.pelvis_position - np.einsum("nij,nj->ni", context.pelvis_rotation, moved)


def _at_times(paths, time_s, wanted):
    # paths (m, n, 2, 3) at other times: what lies outside stays at the end
    clipped = np.clip(wanted, time_s[0], time_s[-1])
    out = np.empty_like(paths)
    for i in range(len(paths)):
        out[i] = CubicSpline(time_s, paths[i])(clipped[i])
    return out


def _late_markers(paths, values, context):
    return _at_times(paths, context.time_s, context.time_s[None] - values[:, :1])


def _drifting_clock(paths, values, context):
    t = context.time_s - context.time_s[0]
    return _at_times(paths, context.time_s, context.time_s[0] + t[None] * (1 + values[:, :1]))


def _filtered_markers(paths, values, context):
    rate = 1 / (context.time_s[1] - context.time_s[0])
    out = np.empty_like(paths)
    for i, cutoff in enumerate(values[:, 0]):
        sos = butter(2, cutoff, fs=rate, output="sos")
        start = paths[i, :1]
        out[i] = start + sosfilt(sos, paths[i] - start, axis=0)
    return out


def _drifting_marker(side: int):
    def drift(paths, values, context):
        out = paths.copy()
        t = context.time_s - context.time_s[0]
        out[:, :, side] += t[None, :, None] * values[:, None, :]
        return out

    return drift


def _without_spikes(paths, values, context):
    # what is no marker says nothing about the model
    out = paths.copy()
    out[:, context.spikes] = context.measured[context.spikes]
    return out


# ---------------------------------------------------------------- forces on the base


def _tilt(values, context, where, parameters):
    force = 9.81 * context.robot_mass * values
    return np.repeat(force[:, None, :], len(context.step_time_s), axis=1)


def _reaction(values, context, where, parameters):
    # what the strap does to the interface, seen by a controller in the plane, answered late and with its bandwidth
    force = -(
        parameters[:, None, :3] * context.coordinates[:, :3] + parameters[:, None, 6:9] * context.rates[:, :3]
    )
    world = np.einsum("nij,mnj->mni", context.pelvis_rotation, force)
    out = np.empty((len(values), len(context.step_time_s), 2))
    dt = context.step_time_s[1] - context.step_time_s[0]
    for i, (gain, delay, smoothing) in enumerate(values):
        decay = np.exp(-dt / max(smoothing, 1e-9))
        for c in range(2):
            late = np.interp(context.step_time_s - delay, context.time_s, world[i, :, c])
            out[i, :, c] = gain * lfilter([1 - decay], [1, -decay], late, zi=[decay * late[0]])[0]
    return out


def _ratchet(values, context, where, parameters):
    # the rest pose follows what is pulled beyond a threshold, at a rate, and never returns
    axis, dt = where.axes[0], context.time_s[1] - context.time_s[0]
    pulled = where.side * context.coordinates[:, axis]
    threshold, rate = values.T
    slipped = np.zeros((len(values), len(pulled)))
    for i in range(1, len(pulled)):
        beyond = np.maximum(pulled[i] - slipped[:, i - 1] - threshold, 0.0)
        slipped[:, i] = slipped[:, i - 1] + beyond * (1 - np.exp(-rate * dt))
    force = where.side * parameters[:, axis, None] * slipped
    return np.stack([np.interp(context.step_time_s, context.time_s, row) for row in force])[:, :, None]


def _bouc_wen(values: np.ndarray, q: np.ndarray) -> np.ndarray:
    # z (m, n) along a coordinate (n,): z' = k v - b |v| z - g v |z|; k - (b + g) |z| is its slope while it is loaded,
    # k + (b - g) |z| while it is relieved; it takes energy for b > 0
    stiffness, loading, dissipation = values.T
    z = np.zeros((len(values), len(q)))
    for i, way in enumerate(np.diff(q)):
        step, last = stiffness * way, z[:, i]
        # linear in z while the signs last: each step is exact for its increment
        rate = np.where(step * last >= 0, loading, 2 * dissipation - loading) * abs(way)
        small = np.abs(rate) < 1e-9
        gain = np.where(small, 1.0, -np.expm1(-rate) / np.where(small, 1.0, rate))
        z[:, i + 1] = last * np.exp(-rate) + step * gain
    return z


# ---------------------------------------------------------------- the catalogue


@dataclass(frozen=True)
class Effect:
    """One entry of the catalogue; ``plant``, ``input_chain``, ``output_chain`` and ``sighting`` say how it acts.

    ``scope`` is "axis", "side" (axis and direction), "pair" (of axes) or "whole"; ``forms`` names variants with
    other equations for the same name. ``input_chain`` maps values (p,) and context to a pelvis path; ``output_chain``
    maps simulated paths (m, n, 2, 3), values (m, p) and context to paths; ``sighting`` sets the plant up otherwise and
    says what its markers show. ``remedy`` says what to do about an effect
    that cannot be part of a model: chains and planned forces have one.
    """

    name: str
    stage: str
    equation: str
    parameters: tuple[EffectParameter, ...]
    group: str
    separating_trial: str
    scope: str = "axis"
    plant: Mechanism | None = None
    input_chain: Callable[[np.ndarray, Context], tuple[np.ndarray, np.ndarray]] | None = None
    output_chain: Callable[[np.ndarray, np.ndarray, Context], np.ndarray] | None = None
    sighting: Sighting | None = None
    form: str = ""
    replaces_spring: bool = False
    substeps: int = 1
    remedy: str = ""

    def places(self) -> list[Where]:
        """Everywhere that it can act."""
        if self.scope == "axis":
            return [Where((axis,), 0, self.form, self.name) for axis in range(6)]
        if self.scope == "side":
            return [Where((axis,), side, self.form, self.name) for axis in range(6) for side in (1, -1)]
        if self.scope == "pair":
            return [Where(pair, 0, self.form, self.name) for pair in combinations(range(6), 2)]
        return [Where((), 0, self.form, self.name)]


@dataclass(frozen=True)
class Placed:
    """An effect at a place, with what turns searched numbers into SI values."""

    effect: Effect
    where: Where
    scales: Scales = field(repr=False)

    @property
    def key(self) -> str:
        """Name of effect and place: ``slack ty``."""
        return f"{self.effect.name} {self.where.tag}".strip()

    @property
    def axes(self) -> list[str]:
        """Axes it acts on."""
        return [AXES[a] for a in self.where.axes]

    def _scale(self) -> np.ndarray:
        axis = self.where.axes[0] if self.where.axes else 0
        if len(self.where.axes) == 2:
            a, b = self.where.axes
            return np.array(
                [
                    np.sqrt(abs(p.scale(self.scales, a) * p.scale(self.scales, b)))
                    for p in self.effect.parameters
                ]
            )
        return np.array([p.scale(self.scales, axis) for p in self.effect.parameters])

    def values(self, x: np.ndarray) -> np.ndarray:
        """SI values (m, p) of searched numbers (m, p)."""
        log = np.array([p.log for p in self.effect.parameters], dtype=bool)
        return np.where(log, np.exp(np.where(log, x, 0.0)), x) * self._scale()

    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """Bounds (p,) of the searched numbers."""
        pairs = [
            (np.log(p.lower), np.log(p.upper)) if p.log else (p.lower, p.upper)
            for p in self.effect.parameters
        ]
        lower, upper = np.array(pairs, dtype=float).reshape(-1, 2).T
        return lower, upper

    def starts(self) -> np.ndarray:
        """Starting points (s, p) of the searched numbers."""
        count = max((len(p.starts) for p in self.effect.parameters), default=1)
        rows = [
            [
                np.log(p.starts[min(i, len(p.starts) - 1)]) if p.log else p.starts[min(i, len(p.starts) - 1)]
                for p in self.effect.parameters
            ]
            for i in range(count)
        ]
        return np.array(rows, dtype=float)

    def weaker(self, x: np.ndarray) -> np.ndarray:
        """A quarter of the searched numbers (p,) that are no logarithms, inside the bounds."""
        log = np.array([p.log for p in self.effect.parameters], dtype=bool)
        return np.clip(np.where(log, x, x / 4), *self.bounds())

    def prior_sd(self) -> np.ndarray:
        """Prior SD (p,) of the searched numbers, infinite for none."""
        return np.array([p.prior_sd or np.inf for p in self.effect.parameters])

    def named(self, x: np.ndarray) -> dict[str, tuple[float, str]]:
        """SI values by name, with their units, of one set of searched numbers (p,)."""
        axis = AXES[self.where.axes[0]] if self.where.axes else None
        out = {}
        for parameter, value in zip(self.effect.parameters, self.values(x[None])[0], strict=True):
            place = f"_{self.where.tag}" if self.where.axes else ""
            unit = parameter.unit_for(axis)
            suffix = (
                "" if unit == "1" else "_" + unit.replace("/", "_per_").replace("^", "").replace(" ", "_")
            )
            out[f"{parameter.name}{place}{suffix}"] = (float(value), unit)
        return out


def _q(scales: Scales, axis: int) -> float:
    return float(scales.q[axis])


def _per_q(scales: Scales, axis: int) -> float:
    return float(1 / scales.q[axis])


def _force(scales: Scales, axis: int) -> float:
    return float(scales.force[axis])


def _k(scales: Scales, axis: int) -> float:
    return float(scales.k[axis])


def _d(scales: Scales, axis: int) -> float:
    return float(scales.d[axis])


def _linear(name: str, unit: str, sd: float, bound: float) -> EffectParameter:
    return EffectParameter(name, unit, -bound, bound, (0.0,), prior_sd=sd)


_LADDER = "one motion at three amplitudes, from smaller than the slack upward"
_SPEEDS = "the same amplitude at three speeds"
_HOLDS = "steps with holds of 5-10 s"
_JERK = "one sharp jerk at the start and at the end, seen by all systems"
_STAND = "quiet standing at three headings before and after"
_SINGLE = "motions along one axis at a time"
_MASS = "the same motion with a plate of known mass on the interface"

_FRICTION = EffectParameter("force", "N|Nm", 0.002, 2.0, (0.05, 0.3), _force, log=True)

EFFECTS: tuple[Effect, ...] = (
    Effect(
        "slack",
        "interface",
        "F = k sgn(q) max(|q| - w, 0)",
        (EffectParameter("half_width", "m|rad", 0.01, 1.2, (0.15, 0.5), _q, log=True),),
        "A",
        _LADDER,
        plant=SplitSpring(lambda v, where: (-v[:, 0], v[:, 0], 1.0, 1.0)),
        replaces_spring=True,
    ),
    Effect(
        "one_sided",
        "interface",
        "F = k ((1 - s) q + s max(q - q0, 0)), or its mirror image: a share of the strap pulls to one side alone",
        (
            # from zero on it would be asymmetric_stiffness by another name
            EffectParameter("engages_at", "m|rad", 0.03, 0.5, (0.06,), _q),
            EffectParameter("share", "1", 0.05, 1.0, (0.5, 0.9)),
        ),
        "S",
        _LADDER,
        scope="side",
        plant=OneSided(),
        replaces_spring=True,
    ),
    Effect(
        "stiffening",
        "interface",
        "F = k q + c q^3",
        (
            EffectParameter(
                "cubic", "N/m3|Nm/rad3", 0.0, 30.0, (0.5, 3.0), lambda s, i: float(s.k[i] / s.q[i] ** 2)
            ),
        ),
        "A",
        _LADDER,
        plant=Polynomial("jnt_stiffnesspoly", 1),
    ),
    Effect(
        "asymmetric_stiffness",
        "interface",
        "F = k (1 + b sgn(q)) q",
        (
            # a side that carries a tenth of the other or less is loose: one_sided
            EffectParameter("asymmetry", "1", -0.8, 0.8, (-0.4, 0.4)),
        ),
        "asymmetric_stiffness",
        _LADDER,
        plant=SplitSpring(lambda v, where: (0.0 * v[:, 0], 0.0 * v[:, 0], 1 - v[:, 0], 1 + v[:, 0])),
        replaces_spring=True,
    ),
    Effect(
        "asymmetric_stiffness",
        "interface",
        "F = k q + b q^2",
        (
            EffectParameter(
                "quadratic", "N/m2|Nm/rad2", -0.6, 0.6, (-0.2, 0.2), lambda s, i: float(s.k[i] / s.q[i])
            ),
        ),
        "asymmetric_stiffness",
        _LADDER,
        plant=Polynomial("jnt_stiffnesspoly", 0),
        form="_quadratic",
    ),
    Effect(
        "coulomb",
        "interface",
        "F = Fc sgn(qdot)",
        (_FRICTION,),
        "V",
        "slow ramps and reversals at several speeds",
        plant=DryFriction(),
    ),
    Effect(
        "lugre",
        "interface",
        "F = s0 z, zdot = v - s0 |v| z / (Fc + (Fs - Fc) exp(-(v/vs)^2))",
        (
            _FRICTION,
            EffectParameter("static_excess", "1", 0.05, 2.0, (0.5,)),
            EffectParameter("deflection", "m|rad", 0.005, 0.2, (0.03,), _q, log=True),
            EffectParameter(
                "stribeck_rate", "m/s|rad/s", 0.01, 1.0, (0.1,), lambda s, i: float(s.v[i]), log=True
            ),
        ),
        "lugre",
        "sub-millimetre reversals and a ladder of speeds",
        plant=Bristles(),
        substeps=4,
    ),
    Effect(
        "hysteresis",
        "interface",
        "springs beside the strap's own that yield one after the other (Maxwell slip)",
        (
            _FRICTION,
            EffectParameter("travel", "m|rad", 0.04, 2.0, (0.1, 0.5), _q, log=True),
        ),
        "hysteresis",
        "the same amplitude at 0.1, 1 and 4 Hz",
        plant=Elastoplastic(4),
    ),
    Effect(
        "hysteresis",
        "interface",
        "F = z, z' = k qdot - b |qdot| z - g qdot |z|, loading = b + g, dissipation = b (Bouc-Wen, exponent 1)",
        (
            EffectParameter("stiffness", "N/m|Nm/rad", 0.02, 50.0, (0.5, 0.6), _k, log=True),
            EffectParameter("loading", "1/m|1/rad", -1.5, 25.0, (10.0, 2.0), _per_q),
            EffectParameter("dissipation", "1/m|1/rad", 0.0, 12.5, (3.0, 0.6), _per_q),
        ),
        "hysteresis",
        "the same amplitude at 0.1, 1 and 4 Hz",
        plant=BoucWen(8),
        form="_bouc_wen",
        remedy=(
            "Take out the yielding springs of this effect, which stand for most of it, and add a force -z to the strap"
            " joint, z stepped with the rate qdot by the equation, from z = 0"
        ),
    ),
    Effect(
        "relaxation",
        "interface",
        "F1' = k1 qdot - F1 / tau beside the strap's own spring",
        (
            EffectParameter("stiffness", "N/m|Nm/rad", 0.02, 30.0, (0.5, 3.0), _k, log=True),
            EffectParameter("time_constant", "s", 0.03, 2.5, (0.4, 0.1), log=True),
        ),
        "V",
        _HOLDS,
        plant=Maxwell(),
    ),
    Effect(
        "creep",
        "interface",
        "as relaxation, with a time constant of many seconds",
        (
            EffectParameter("stiffness", "N/m|Nm/rad", 0.02, 10.0, (0.5,), _k, log=True),
            EffectParameter("time_constant", "s", 2.5, 60.0, (6.0,), log=True),
        ),
        "creep",
        "reload after a rest",
        plant=Maxwell(),
    ),
    Effect(
        "creep",
        "interface",
        "as relaxation, by the logarithm of time: four branches, each four times as slow as the one before",
        (
            EffectParameter("stiffness", "N/m|Nm/rad", 0.02, 10.0, (0.5,), _k, log=True),
            EffectParameter("shortest_time_constant", "s", 0.3, 5.0, (1.0,), log=True),
        ),
        "creep",
        "reload after a rest",
        plant=Maxwell(4, 4.0),
        form="_log_time",
    ),
    Effect(
        "migration",
        "interface",
        "F = k (q - r), r' = c max(q - r - w, 0): beyond a threshold the rest pose follows, and stays",
        (
            EffectParameter("threshold", "m|rad", 0.02, 1.3, (0.6, 0.25), _q, log=True),
            EffectParameter("rate", "1/s", 0.02, 50.0, (1.0, 1.0), log=True),
        ),
        "Dft",
        _STAND,
        scope="side",
        plant=PlannedForce(_ratchet),
        remedy=(
            "Add a force k r to the strap joint on its side, k its stiffness: r follows q - threshold at the rate"
            " while the strap is beyond it, and never returns"
        ),
    ),
    Effect(
        "cross_coupling",
        "interface",
        "F_i = K_ij q_j, F_j = K_ij q_i",
        (EffectParameter("stiffness", "SI", -0.9, 0.9, (-0.15, 0.15), _k),),
        "F",
        _SINGLE,
        scope="pair",
        plant=Coupling("tendon_stiffness"),
        form="_elastic",
    ),
    Effect(
        "cross_coupling",
        "interface",
        "F_i = D_ij qdot_j, F_j = D_ij qdot_i",
        (EffectParameter("damping", "SI", -0.9, 0.9, (-0.15, 0.15), _d),),
        "F",
        _SINGLE,
        scope="pair",
        plant=Coupling("tendon_damping"),
        form="_viscous",
    ),
    Effect(
        "misalignment",
        "interface",
        "interface axes turned by a rotation vector",
        tuple(_linear(f"turn_{axis}", "rad", 0.2, 0.6) for axis in "xyz"),
        "F",
        _SINGLE,
        scope="whole",
        plant=TurnedAxes(),
    ),
    Effect(
        "preload",
        "interface",
        "F = k (q - q0)",
        (EffectParameter("rest_shift", "m|rad", -2.0, 2.0, (-0.2, 0.2), _q),),
        "S",
        _STAND,
        plant=RestShift(),
    ),
    Effect(
        "joint_limit",
        "interface",
        "a stop inside the range that the limits allow",
        (
            EffectParameter("place", "m|rad", 0.3, 1.2, (0.6, 0.85), _q, log=True),
            EffectParameter("stiffness", "N/m|Nm/rad", 1.0, 200.0, (8.0,), _k, log=True),
        ),
        "A",
        "a slow ramp into the stop",
        scope="side",
        plant=Stop(),
    ),
    Effect(
        "quadratic_damping",
        "interface",
        "F = d qdot + d2 qdot |qdot|",
        (
            EffectParameter(
                "quadratic", "Ns2/m2|Nms2/rad2", 0.0, 30.0, (0.5, 3.0), lambda s, i: float(s.d[i] / s.v[i])
            ),
        ),
        "V",
        _SPEEDS,
        plant=Polynomial("dof_dampingpoly", 0),
    ),
    Effect(
        "added_mass",
        "robot",
        "the interface is heavier than the twin's",
        (
            EffectParameter("mass", "kg", -2.0, 40.0, (2.0,)),
            EffectParameter("inertia", "kgm2", -0.02, 2.0, (0.02,)),
        ),
        "M",
        _MASS,
        scope="whole",
        plant=InterfaceMass(),
    ),
    Effect(
        "base_compliance",
        "robot",
        "the base yields other than configured",
        tuple(
            EffectParameter(f"ln_{what}_{axis}", "1", -3.0, 3.0, (-0.3,), prior_sd=1.0)
            for axis in ("x", "y", "yaw")
            for what in ("stiffness", "damping")
        ),
        "M",
        "the robot's own log, brakes on against brakes off",
        scope="whole",
        plant=RobotImpedance(ROBOT_JOINTS[:3]),
    ),
    Effect(
        "controller_reaction",
        "robot",
        "F_base = g y, T y' = F_interaction(t - delay) - y",
        (
            EffectParameter("gain", "1", -1.5, 4.0, (-0.3, 0.3)),
            EffectParameter("delay", "s", 0.0, 0.5, (0.1, 0.02)),
            EffectParameter("smoothing", "s", 0.0, 0.5, (0.0, 0.1)),
        ),
        "controller_reaction",
        "the same motion with the controller off",
        scope="whole",
        plant=PlannedForce(_reaction, ROBOT_JOINTS[:2]),
        remedy=(
            "Add to base_x and base_y the gain times the strap's horizontal force on the interface, delayed and passed"
            " through a low-pass of first order with the smoothing as time constant"
        ),
    ),
    Effect(
        "tilt",
        "robot",
        "gravity has a component along the floor",
        tuple(EffectParameter(f"slope_{axis}", "rad", -0.1, 0.1, (0.003,)) for axis in "xy"),
        "S",
        "turning in place",
        scope="whole",
        plant=PlannedForce(_tilt, ROBOT_JOINTS[:2]),
        remedy="Add to base_x and base_y a constant force: slope times 9.81 m/s2 times the robot's mass",
    ),
    Effect(
        "soft_tissue",
        "input",
        "pelvis markers move over the bone in proportion to the pelvis' rotation",
        (
            *(_linear(f"shift_{a}_by_r{b}", "m/rad", 0.03, 0.3) for a in "xyz" for b in "xyz"),
            *(_linear(f"turn_{a}_by_r{b}", "rad/rad", 0.1, 0.8) for a in "xyz" for b in "xyz"),
        ),
        "V",
        "a marker cluster beside the pelvis markers, quiet standing and a passive pull",
        scope="whole",
        input_chain=_soft_tissue,
        remedy=(
            "Correct the pelvis before it is replayed: with v its rotation vector from the start pose, take from its"
            " position R (shift v) and from its rotation the vector turn v, both in the pelvis' frame"
        ),
    ),
    Effect(
        "lab_yaw",
        "input",
        "pelvis and interface are seen in frames turned about the vertical",
        (EffectParameter("yaw", "rad", -0.35, 0.35, (0.03,)),),
        "F",
        "a static wand seen by both systems",
        scope="whole",
        plant=TurnedBack(),
        input_chain=_turned_motion,
        remedy="Turn the pelvis' markers of all trials by minus the yaw about the vertical through the lab's origin and"
        " ingest anew; the strap's axes of this model are turned with the path as it was recorded",
    ),
    Effect(
        "lab_yaw",
        "input",
        "pelvis and interface are seen in frames turned about the vertical; the robot's axes are the pelvis' frame's",
        (EffectParameter("yaw", "rad", -0.35, 0.35, (0.03,)),),
        "F",
        "a static wand seen by both systems",
        scope="whole",
        sighting=TurnedLab(),
        form="interface",
        remedy="Turn the interface's markers of all trials by minus the yaw about the vertical through the lab's origin"
        " and ingest anew; start and rest pose of this model are those of the turned markers",
    ),
    Effect(
        "replay_lag",
        "input",
        "the pelvis is late by tau",
        (EffectParameter("lag", "s", -0.1, 0.1, (0.01,)),),
        "T",
        _JERK,
        scope="whole",
        input_chain=_earlier_pelvis,
        remedy="Replay the pelvis earlier by the lag: what it shows at t happened at t - lag",
    ),
    Effect(
        "sync_offset",
        "output",
        "y(t - tau)",
        (EffectParameter("offset", "s", -0.25, 0.25, (0.01,)),),
        "T",
        _JERK,
        scope="whole",
        output_chain=_late_markers,
        remedy="Shift the interface markers earlier by the offset before they are compared with the simulation",
    ),
    Effect(
        "clock_drift",
        "output",
        "y((1 + eps) t)",
        (EffectParameter("drift", "1", -0.02, 0.02, (0.001,)),),
        "clock_drift",
        _JERK,
        scope="whole",
        output_chain=_drifting_clock,
        remedy="Read the simulation at (1 + drift) t, t from the start, where the interface markers say t",
    ),
    Effect(
        "filter_lag",
        "output",
        "y low-passed by a causal filter of second order",
        (EffectParameter("cutoff", "Hz", 0.5, 20.0, (6.0,), log=True),),
        "T",
        "fast content near the filter's cut-off",
        scope="whole",
        output_chain=_filtered_markers,
        remedy=(
            "Pass the simulated interface markers through a causal Butterworth low-pass of second order with this"
            " cut-off, or export the markers without the filter"
        ),
    ),
    Effect(
        "marker_offset",
        "output",
        "a marker sits off the joint centre, fixed in the interface",
        tuple(_linear(f"{side}_{c}", "m", 0.03, 0.15) for side in ("left", "right") for c in "xyz"),
        "S",
        "static poses at several headings",
        scope="whole",
        sighting=OffCentre(),
        remedy=(
            "Take from each interface marker its offset, turned with the interface, and ingest anew. Start and rest"
            " pose of this model are the true ones; its sites are the joint centres, not the markers"
        ),
    ),
    *(
        Effect(
            "marker_drift",
            "output",
            f"a ramp in the {side} interface marker",
            tuple(_linear(f"{side}_{c}", "m/s", 0.005, 0.05) for c in "xyz"),
            "Dft",
            "distance between markers at the start and at the end",
            scope="whole",
            output_chain=_drifting_marker(index),
            remedy="Take from the interface marker the ramp: its rate times the time from the start",
            form=f"{side}",
        )
        for index, side in enumerate(("left", "right"))
    ),
    Effect(
        "outliers",
        "output",
        "isolated samples of a marker are not the marker",
        (),
        "outliers",
        "the same trial, labelled again",
        scope="whole",
        output_chain=_without_spikes,
        remedy="Label the jumping interface markers again, or leave those samples out",
    ),
)

EFFECT_NAMES = tuple(dict.fromkeys(effect.name for effect in EFFECTS))
# Effects by ambiguity group: those that a first-order pass predicts to look alike (design, effects.md)
GROUPS = {
    group: tuple(dict.fromkeys(effect.name for effect in EFFECTS if effect.group == group))
    for group in dict.fromkeys(effect.group for effect in EFFECTS)
}
