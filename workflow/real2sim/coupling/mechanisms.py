"""How effects get into the plant: what MuJoCo has natively, set per simulation, and forces planned before it.

Each mechanism adds its elements to the description of the plant and writes its values into the fields of a batch:
springs with a dead band, polynomials, elasto-plastic springs, dry friction, LuGre, a hidden joint, turned axes, other
masses and impedances. No Python runs while it steps, but where a controller answers the strap: between short windows.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from itertools import combinations
from typing import Protocol

import mujoco
import numpy as np
from scipy.interpolate import CubicSpline
from scipy.optimize import nnls
from scipy.spatial.transform import Rotation

from real2sim.coupling.answers import Law
from real2sim.coupling.plant import STRAP_JOINTS
from real2sim.geometry import AXES


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

    def hardest(self, axis: int) -> float:
        """Damping that the time step bears on a strap axis where it is not part of MuJoCo's implicit damping."""
        return float(0.5 * self.scales.inertia[axis] / self.model.opt.timestep)


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


class SoftDeadBand:
    """The axis' spring in three equal parts with dead bands of their own: values are half width and softness, (m, 2).

    The half widths are the value less and plus the softness as a share of it, and the value: what a slack strap of foam
    or belt does, which takes up its load little by little.
    """

    _PARTS = (-1.0, 0.0, 1.0)

    def build(self, spec, where):
        """Three fixed tendons over the strap joint."""
        joint = STRAP_JOINTS[where.axes[0]]
        for i in range(len(self._PARTS)):
            _tendon(spec, f"band{i}_{where.element}", {joint: 1.0}, stiffness=[1, 0, 0], springlength=[0, 0])

    def set(self, fields, where, parameters, values):
        """Dead bands and stiffness of the parts; the joint's own spring is off."""
        axis = where.axes[0]
        half_width, softness = values.T
        fields["jnt_stiffness"][:, fields.joint(axis)] = 0
        for i, part in enumerate(self._PARTS):
            index, width = fields.tendon(f"band{i}_{where.element}"), half_width * (1 + part * softness)
            fields["tendon_lengthspring"][:, index] = np.stack([-width, width], axis=1)
            fields["tendon_stiffness"][:, index] = parameters[:, axis] / len(self._PARTS)


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


class ExponentialSpring:
    """The axis' spring stiffens exponentially, values (m, 2): a length, and how much of it begins as a toe.

    Between k L sinh(q / L), of which the beginning is linear, and k L (exp(|q| / L) - 1) sgn q, which bends at once.
    Each is a cubic spring and springs with dead bands, linear and cubic beyond them, to 1 % of the force and 0.03 k L
    up to 6 L.
    """

    _KNOTS = np.array([0.15, 0.5, 1.0, 2.0, 3.2, 4.5])

    def __init__(self):
        reach = np.linspace(0, 6, 601)[1:]
        beyond = np.maximum(reach[:, None] - self._KNOTS, 0)
        springs = np.column_stack([reach**3, beyond, beyond**3])
        self._shares = np.array(
            [
                nnls(springs / (law + reach)[:, None], law / (law + reach))[0]
                for law in (np.sinh(reach) - reach, np.expm1(reach) - reach)
            ]
        )

    def build(self, spec, where):
        """A fixed tendon over the strap joint for each dead band."""
        joint = STRAP_JOINTS[where.axes[0]]
        for i in range(len(self._KNOTS)):
            name = f"steeper{i}_{where.element}"
            _tendon(spec, name, {joint: 1.0}, stiffness=[1, 0, 1], springlength=[-_FAR, _FAR])

    def set(self, fields, where, parameters, values):
        """The joint's cubic term, dead bands and both terms of the tendons."""
        axis, n = where.axes[0], len(self._KNOTS)
        length, toe = values.T
        shares = (1 - toe)[:, None] * self._shares[0] + toe[:, None] * self._shares[1]
        cubic, linear, beyond = np.split(shares, [1, 1 + n], axis=1)
        stiffness = parameters[:, axis]
        third = stiffness / length**2
        fields["jnt_stiffnesspoly"][:, fields.joint(axis), 1] = third * cubic[:, 0]
        for i, knot in enumerate(self._KNOTS):
            index = fields.tendon(f"steeper{i}_{where.element}")
            fields["tendon_lengthspring"][:, index] = knot * np.stack([-length, length], axis=1)
            fields["tendon_stiffness"][:, index] = stiffness * linear[:, i]
            fields["tendon_stiffnesspoly"][:, index, 1] = third * beyond[:, i]


class EvenSpring:
    """A quadratic term of the axis' spring, which goes straight on beyond a coordinate: values are both, (m, 2).

    Without an end the strap would let go on one side, where nothing but the polynomial says so.
    """

    def build(self, spec, where):
        """One fixed tendon over the strap joint."""
        joint = {STRAP_JOINTS[where.axes[0]]: 1.0}
        _tendon(spec, f"straight_{where.element}", joint, stiffness=[1, 1, 0], springlength=[-_FAR, _FAR])

    def set(self, fields, where, parameters, values):
        """The joint's even term; beyond its dead band the tendon takes off what b q^2 has over its tangent."""
        axis, index = where.axes[0], fields.tendon(f"straight_{where.element}")
        quadratic, end = values.T
        fields["jnt_stiffnesspoly"][:, fields.joint(axis), 0] = quadratic
        fields["tendon_stiffness"][:, index] = 0
        fields["tendon_stiffnesspoly"][:, index, 0] = -quadratic
        fields["tendon_lengthspring"][:, index, 0], fields["tendon_lengthspring"][:, index, 1] = -end, end


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
        stretch = np.empty((len(q), *slips.shape))
        stretch[0] = np.clip(q[0], -slips, slips)
        # np.clip costs several times what it does here
        for last, now, way in zip(stretch[:-1], stretch[1:], np.diff(q), strict=True):
            np.add(last, way, out=now)
            np.minimum(now, slips, out=now)
            np.maximum(now, -slips, out=now)
        return np.asarray((stiffness * np.moveaxis(stretch, 0, 1)).sum(axis=2))


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


class UnevenFriction(DryFriction):
    """Dry friction that differs by direction: values (m, 2) are its mean and how much more of it resists upward motion.

    It is even friction beside a constant force, moving and sticking.
    """

    def build(self, spec, where):
        """Friction of the joint, and an actuator without a command."""
        super().build(spec, where)
        _without_command(spec, f"uneven_{where.element}", where)

    def set(self, fields, where, parameters, values):
        """Even friction, and the force."""
        super().set(fields, where, parameters, values)
        index = fields.model.actuator(f"uneven_{where.element}").id
        fields["actuator_biasprm"][:, index, 0] = -values[:, 0] * values[:, 1]


def _without_command(spec: mujoco.MjSpec, name: str, where: Where, **attributes) -> None:
    """An actuator of the axis whose force depends on nothing but the joint."""
    actuator = spec.add_actuator(
        name=name,
        trntype=mujoco.mjtTrn.mjTRN_JOINT,
        target=STRAP_JOINTS[where.axes[0]],
        gaintype=mujoco.mjtGain.mjGAIN_FIXED,
        biastype=mujoco.mjtBias.mjBIAS_AFFINE,
        **attributes,
    )
    actuator.gainprm = [0] * 10


class SmoothFriction:
    """Friction that fades towards standstill, f tanh(qdot / rate): values (m, 2) are force and rate.

    Dampers that saturate, whose sum runs along the tangent hyperbolic: it creeps where dry friction holds.
    """

    _parts = 3

    def __init__(self):
        # the curve's slope falls from 1 in equal shares, one wherever a damper saturates; all together make 1
        rates = np.arctanh(np.sqrt((np.arange(self._parts) + 0.5) / self._parts))
        self._weights = rates / rates.sum()
        self._rates = self._weights * self._parts

    def _names(self, where: Where) -> list[str]:
        return [f"smooth_{i}_{where.element}" for i in range(self._parts)]

    def build(self, spec, where):
        """Actuators without a command that brake up to a force."""
        for name in self._names(where):
            limited = mujoco.mjtLimited.mjLIMITED_TRUE
            _without_command(spec, name, where, forcelimited=limited, forcerange=[-1, 1])

    def set(self, fields, where, parameters, values):
        """Slope and limit of each damper, the slopes held to what the time step bears together."""
        force, rate = values.T
        limit = force[:, None] * self._weights
        slope = limit / (rate[:, None] * self._rates)
        most = fields.hardest(where.axes[0])
        slope *= np.minimum(1, most / slope.sum(axis=1, keepdims=True))
        for i, name in enumerate(self._names(where)):
            index = fields.model.actuator(name).id
            fields["actuator_biasprm"][:, index, 2] = -slope[:, i]
            fields["actuator_forcerange"][:, index] = np.stack([-limit[:, i], limit[:, i]], axis=1)


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
    """Springs and dampers in series beside a joint's own: values are stiffness and shortest time constant, (m, 2).

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
            _branch(spec, name, STRAP_JOINTS[where.axes[0]])

    def set(self, fields, where, parameters, values):
        """Stiffness and damping."""
        for name, ratio in zip(self._names(where), self._ratios, strict=True):
            _set_branch(fields, name, values[:, 0] / len(self._ratios), values[:, 1] * ratio)

    def relax(self, fields: Fields, where: Where, position: np.ndarray) -> None:
        """Let no branch pull at joint positions (m, nq), which are changed in place."""
        strap = fields.model.joint(STRAP_JOINTS[where.axes[0]]).qposadr[0]
        for name in self._names(where):
            own = fields.model.joint(name).qposadr[0]
            position[:, own] = position[:, strap] - fields["tendon_lengthspring"][:, fields.tendon(name), 0]


class TwoTimes(Maxwell):
    """Two such branches, values (m, 4): stiffness of both, share of the slower, time constant of the faster, ratio."""

    def __init__(self):
        super().__init__(2)

    def set(self, fields, where, parameters, values):
        """Stiffness and damping."""
        stiffness, slow, fast, ratio = values.T
        for name, part, time in zip(self._names(where), (1 - slow, slow), (fast, fast * ratio), strict=True):
            _set_branch(fields, name, part * stiffness, time)


def _branch(spec: mujoco.MjSpec, name: str, joint: str) -> None:
    """A spring and a damper in series on a joint, at rest where that is zero."""
    body = spec.worldbody.add_body(
        name=name, mass=1e-6, inertia=[1e-9] * 3, explicitinertial=True, gravcomp=1
    )
    body.add_joint(name=name, type=mujoco.mjtJoint.mjJNT_SLIDE, axis=[1, 0, 0], damping=[1, 0, 0])
    _tendon(spec, name, {joint: 1.0, name: -1.0}, stiffness=[1, 0, 0], springlength=[0, 0])


def _set_branch(fields: Fields, name: str, stiffness: np.ndarray, time_constant: np.ndarray) -> None:
    """Values (m,) of a branch. The slide needs no inertia: its damping is implicit."""
    fields["tendon_stiffness"][:, fields.tendon(name)] = stiffness
    fields["dof_damping"][:, int(fields.model.joint(name).dofadr[0])] = stiffness * time_constant


# Tendons over the sum and the difference of two coordinates: what they pull with opposite signs cancels but for the
# product of the two
_PRODUCT = ((1, "sum"), (-1, "difference"))


def _product(spec: mujoco.MjSpec, ending: str, axes: tuple[int, int]) -> None:
    """Both tendons over two strap joints."""
    a, b = (STRAP_JOINTS[i] for i in axes)
    for sign, name in _PRODUCT:
        _tendon(spec, f"{name}_{ending}", {a: 1.0, b: float(sign)}, stiffness=[0, 0, 0], springlength=[0, 0])


def _set_product(fields: Fields, ending: str, field: str, values: np.ndarray) -> None:
    """Off-diagonal stiffness or damping (m,): half of it on each."""
    for sign, name in _PRODUCT:
        fields[field][:, fields.tendon(f"{name}_{ending}")] = sign * values / 2


class Coupling:
    """Off-diagonal stiffness or damping between two axes, value (m, 1), the diagonal left alone."""

    def __init__(self, name: str):
        self._field = name

    def build(self, spec, where):
        """Both tendons."""
        _product(spec, where.element, where.axes)

    def set(self, fields, where, parameters, values):
        """Half the value on each, with opposite signs."""
        _set_product(fields, where.element, self._field, values[:, 0])


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


class TurnedLaw:
    """Stiffness and damping of the strap turned by a rotation vector, its coordinates left as they are: values (m, 3).

    What the turned matrices have beyond those of the strap is on tendons over each coordinate and over each two: it
    comes on top of whatever law an axis follows.
    """

    _blocks = ((0, 1, 2), (3, 4, 5))

    def build(self, spec, where):
        """Tendons of no stiffness."""
        for axis in range(6):
            joint = {STRAP_JOINTS[axis]: 1.0}
            _tendon(spec, self._name(where, axis), joint, stiffness=[0, 0, 0], springlength=[0, 0])
        for block in self._blocks:
            for a, b in combinations(block, 2):
                _product(spec, self._name(where, a, b), (a, b))

    def _name(self, where: Where, *axes: int) -> str:
        return "_".join(["turned", *(AXES[a] for a in axes), where.element])

    def set(self, fields, where, parameters, values):
        """What the turned matrices add."""
        turn = Rotation.from_rotvec(values).as_matrix()
        for field, first in (("tendon_stiffness", 0), ("tendon_damping", 6)):
            for block in self._blocks:
                plain = parameters[:, first + np.array(block)]
                added = np.einsum("mij,mj,mkj->mik", turn, plain, turn) - plain[:, :, None] * np.eye(3)
                for i, axis in enumerate(block):
                    fields[field][:, fields.tendon(self._name(where, axis))] = added[:, i, i]
                for (i, a), (j, b) in combinations(enumerate(block), 2):
                    _set_product(fields, self._name(where, a, b), field, added[:, i, j])


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
    """The axis' strap rests elsewhere, with all laws that it follows there: value (m, 1). Set after other effects."""

    def build(self, spec, where):
        """Nothing: the rest pose is a field."""

    def set(self, fields, where, parameters, values):
        """Spring reference of the joint, and lengths at which tendons over it are slack or stop."""
        rest_moved(fields, where.axes[0], values[:, 0])


def rest_moved(fields: Fields, axis: int, by: np.ndarray) -> None:
    """Move the rest of a strap axis by (m,) [m, rad]: its spring, and where tendons over it are slack or stop."""
    joint = fields.model.joint(STRAP_JOINTS[axis])
    fields["qpos_spring"][:, joint.qposadr[0]] += by
    for index, coefficient in _tendons_over(fields.model, joint.id):
        fields["tendon_lengthspring"][:, index] += coefficient * by[:, None]
        if fields.model.tendon_limited[index]:
            fields["tendon_range"][:, index] += coefficient * by[:, None]


def _tendons_over(model: mujoco.MjModel, joint: int) -> list[tuple[int, float]]:
    """Fixed tendons over a joint: index and coefficient."""
    out = []
    for index, (first, count) in enumerate(zip(model.tendon_adr, model.tendon_num, strict=True)):
        for wrap in range(first, first + count):
            if model.wrap_type[wrap] == mujoco.mjtWrap.mjWRAP_JOINT and model.wrap_objid[wrap] == joint:
                out.append((index, float(model.wrap_prm[wrap])))
    return out


# Share of the acceleration at a stop that MuJoCo's constraint imposes by itself: with as little, the stop pushes as a
# spring and a damper do, whatever else acts there
_STOP_IMPEDANCE = 0.2


class Stop:
    """A spring and a damper that only push, beyond a coordinate: place, stiffness and damping ratio (m, 3).

    The limit of a tendon, so that the damper pulls no one back. Its stiffness is held to what the time step bears.
    """

    def build(self, spec, where):
        """One tendon, limited far off."""
        _tendon(
            spec,
            f"stop_{where.element}",
            {STRAP_JOINTS[where.axes[0]]: 1.0},
            limited=mujoco.mjtLimited.mjLIMITED_TRUE,
            range=[-_FAR, _FAR],
            solref_limit=[-1.0, -1.0],
            solimp_limit=[_STOP_IMPEDANCE, _STOP_IMPEDANCE, 0.001, 0.5, 2.0],
        )

    def set(self, fields, where, parameters, values):
        """Its place, and rates in units of the inertia that comes against it."""
        index, axis = fields.tendon(f"stop_{where.element}"), where.axes[0]
        place, stiffness, ratio = values.T
        limits, rates = fields["tendon_range"], fields["tendon_solref_lim"]
        limits[:, index] = -_FAR, _FAR
        limits[:, index, 1 if where.side > 0 else 0] = where.side * place
        inertia = fields.scales.inertia[axis]
        square = np.minimum(stiffness, 2 * fields.stiffest(axis)) / inertia
        rates[:, index, 0], rates[:, index, 1] = -square, -2 * ratio * np.sqrt(square)


class GentleStop:
    """A stop that begins gently, with the square of what is beyond: values are place and curvature, (m, 2)."""

    def build(self, spec, where):
        """One tendon over the strap joint, its dead band without an end."""
        joint = {STRAP_JOINTS[where.axes[0]]: 1.0}
        _tendon(spec, f"gentle_{where.element}", joint, stiffness=[1, 1, 0], springlength=[-_FAR, _FAR])

    def set(self, fields, where, parameters, values):
        """The dead band ends at its place; the square is even, so that its sign is the side's."""
        index = fields.tendon(f"gentle_{where.element}")
        place, curvature = values.T
        fields["tendon_stiffness"][:, index] = 0
        fields["tendon_stiffnesspoly"][:, index, 0] = where.side * curvature
        fields["tendon_lengthspring"][:, index, 1 if where.side > 0 else 0] = where.side * place


class GentleStops:
    """Stops on both sides that begin with the cube of what is beyond: values are clearance and cubic, (m, 2)."""

    def build(self, spec, where):
        """One tendon over the strap joint, whose dead band is the clearance."""
        joint = {STRAP_JOINTS[where.axes[0]]: 1.0}
        _tendon(spec, f"stops_{where.element}", joint, stiffness=[1, 0, 1], springlength=[-_FAR, _FAR])

    def set(self, fields, where, parameters, values):
        """Dead band and cube."""
        index = fields.tendon(f"stops_{where.element}")
        clearance, cubic = values.T
        fields["tendon_stiffness"][:, index] = 0
        fields["tendon_stiffnesspoly"][:, index, 1] = cubic
        fields["tendon_lengthspring"][:, index] = np.stack([-clearance, clearance], axis=1)


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


class RobotRelaxation:
    """Joints of the robot with a spring and a damper in series beside their own impedance.

    Values are ln of the branches' stiffness in units of the configured one, joint by joint, and a time constant.
    """

    def __init__(self, joints: tuple[str, ...]):
        self._joints = joints

    def _names(self, where: Where) -> list[str]:
        return [f"series_{name}_{where.element}" for name in self._joints]

    def build(self, spec, where):
        """A branch per joint."""
        for name, joint in zip(self._names(where), self._joints, strict=True):
            _branch(spec, name, joint)

    def set(self, fields, where, parameters, values):
        """Stiffness and damping; at rest where the joint's own spring is."""
        for name, joint, ln in zip(self._names(where), self._joints, values[:, :-1].T, strict=True):
            number = fields.model.joint(joint).id
            _set_branch(fields, name, fields.model.jnt_stiffness[number] * np.exp(ln), values[:, -1])
            rest = fields["qpos_spring"][:, fields.model.jnt_qposadr[number]]
            fields["tendon_lengthspring"][:, fields.tendon(name)] = rest[:, None]


class YieldBeyondWheels:
    """Joints of the robot that yield beyond what its log measures: a spring in series with the configured impedance.

    Values are ln of the springs' stiffness in units of the configured one, joint by joint. The wheels are hidden slides
    in that impedance, and what the log shows.
    """

    def __init__(self, joints: tuple[str, ...]):
        self._joints = joints

    def logged(self, where: Where) -> dict[str, str]:
        """Joint that the log shows instead of each of the robot's."""
        return {joint: f"wheels_{joint}_{where.element}" for joint in self._joints}

    def build(self, spec, where):
        """A slide and a tendon per joint."""
        for joint, name in self.logged(where).items():
            _branch(spec, name, joint)

    def set(self, fields, where, parameters, values):
        """The impedance from the joint to its slide, and the spring between."""
        model, h = fields.model, fields.model.opt.timestep
        for (joint, name), ln in zip(self.logged(where).items(), values.T, strict=True):
            number, slide = model.joint(joint).id, model.joint(name)
            dof = int(model.jnt_dofadr[number])
            stiffness, damping = model.jnt_stiffness[number], model.dof_damping[dof]
            fields["jnt_stiffness"][:, number] = fields["dof_damping"][:, dof] = 0
            fields["dof_armature"][:, dof] = model.dof_armature[dof] + damping * h / 2
            fields["jnt_stiffness"][:, slide.id] = stiffness
            fields["dof_damping"][:, int(slide.dofadr[0])] = damping
            fields["tendon_stiffness"][:, fields.tendon(name)] = stiffness * np.exp(ln)
            rest = fields["qpos_spring"][:, model.jnt_qposadr[number]]
            fields["tendon_lengthspring"][:, fields.tendon(name)] = rest[:, None]


class SlackBeyondWheels(YieldBeyondWheels):
    """As `YieldBeyondWheels`, with play: values are ln of stiffness and then half of the play [m, rad], by joint."""

    def set(self, fields, where, parameters, values):
        """The spring of each joint has a dead band."""
        joints = len(self._joints)
        super().set(fields, where, parameters, values[:, :joints])
        for name, half in zip(self.logged(where).values(), values[:, joints:].T, strict=True):
            band = half[:, None] * np.array([-1.0, 1.0])
            fields["tendon_lengthspring"][:, fields.tendon(name)] += band


class Rocking:
    """The robot rocks on its suspension, which no encoder sees: what carries the arm turns about the floor.

    Values (m, 4) are stiffness in roll and pitch [Nm/rad], time constant of the damping [s] and inertia of what rocks
    beside the arm [kg m2]. The hinges are hidden, behind the arm's own.
    """

    def _names(self, where: Where) -> list[str]:
        return [f"rocking_{axis}_{where.element}" for axis in ("roll", "pitch")]

    def build(self, spec, where):
        """Two hinges on the floor below the middle of the base."""
        arm = spec.body("arm")
        base = np.array([arm.pos[0], arm.pos[1], arm.pos[2] + arm.parent.pos[2]])
        for name, axis in zip(self._names(where), np.eye(3)[:2], strict=True):
            arm.add_joint(
                name=name,
                type=mujoco.mjtJoint.mjJNT_HINGE,
                axis=axis,
                pos=-base,
                stiffness=[1, 0, 0],
                damping=[1, 0, 0],
            )

    def set(self, fields, where, parameters, values):
        """Springs, dampers and inertia."""
        for name, stiffness in zip(self._names(where), values[:, :2].T, strict=True):
            joint = fields.model.joint(name)
            fields["jnt_stiffness"][:, joint.id] = stiffness
            fields["dof_damping"][:, joint.dofadr[0]] = stiffness * values[:, 2]
            fields["dof_armature"][:, joint.dofadr[0]] = values[:, 3]


class DrivenForce:
    """Forces on some joints, fed in as controls.

    ``joints`` are names, or None for the strap joint of the effect's axis.
    """

    def __init__(self, joints: tuple[str, ...] | None = None):
        self._joints = joints

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


class PlannedForce(DrivenForce):
    """Forces that are planned before the simulation from what was measured.

    ``force`` maps values (m, p), context, place and strap parameters (m, 12) to (m, steps, j) [N, Nm].
    """

    def __init__(self, force: Callable[..., np.ndarray], joints: tuple[str, ...] | None = None):
        super().__init__(joints)
        self.force = force


class StandingForce(PlannedForce):
    """A steady force on the robot that has pulled in the neutral trial too, where the strap's rest pose was taken.

    The strap then rests elsewhere than it was seen to: by what the force stretched it (`EffectReplay`).
    """


class HangingMass(StandingForce):
    """`InterfaceMass` whose weight nothing balances: it hangs from the arm, in the neutral trial as well."""

    def __init__(self, force: Callable[..., np.ndarray], joints: tuple[str, ...]):
        super().__init__(force, joints)
        self._mass = InterfaceMass()

    def set(self, fields, where, parameters, values):
        """Add to the body."""
        self._mass.set(fields, where, parameters, values)


_BESIDE_M = 1e-6  # what MuJoCo still takes for a centre of mass beside its body's origin


class OffCentreMass(HangingMass):
    """A part on the interface beside its centre, in the neutral trial as well, whose moments nothing balances.

    Values (m, 6) are mass [kg], isotropic inertia [kg m^2], mass times its place in the interface (3) [kg m], and what
    of the mass the lift does not balance [kg].
    """

    def build(self, spec, where):
        """Motors; and a body whose centre of mass MuJoCo does not leave at the body's origin for good."""
        super().build(spec, where)
        body = spec.body("interface")
        body.ipos = body.ipos + _BESIDE_M

    def set(self, fields, where, parameters, values):
        """Add to the body and move its centre."""
        super().set(fields, where, parameters, values)
        model = fields.model
        body = model.body("interface").id
        centre = model.body_ipos[body] - _BESIDE_M
        moment = model.body_mass[body] * centre + values[:, 2:5]
        fields["body_ipos"][:, body] = moment / fields["body_mass"][:, body, None]


class AnsweringForce(DrivenForce):
    """Forces on joints of the base that answer, by a law, what the strap does to the interface or where the base is."""

    def __init__(self, law: type[Law], joints: tuple[str, ...]):
        super().__init__(joints)
        self.law = law


class BoucWen(PlannedForce):
    """Bouc-Wen of exponent 1, values (m, 3) are stiffness, loading and dissipation of `bouc_wen`.

    MuJoCo has no such element. Yielding springs with the same loading curve stand for most of it and answer to the
    simulated motion; what the law differs from them is planned along the measured coordinate. Were all of it planned, a
    stiff element would make a force of that coordinate's noise, and hold nothing in the simulation.
    """

    def __init__(self, elements: int):
        super().__init__(self._difference)
        self._springs = Elastoplastic(elements)
        # beside other effects the same law is asked for again and again while those are tried
        self._planned = lru_cache(maxsize=256)(self._plan)

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
        path = q.tobytes()
        return np.array([self._planned(tuple(row), path) for row in values.tolist()])[:, :, None]

    def _plan(self, row: tuple[float, ...], path: bytes) -> np.ndarray:
        values, q = np.array([row]), np.frombuffer(path)
        return (self._springs.along(q, self._yielding(values)) - bouc_wen(values, q))[0]


class FlowingMaxwell(PlannedForce):
    """A spring in series with a dashpot that flows the easier the more it carries, values (m, 3) of `eyring`.

    MuJoCo has no such dashpot. A linear one of the same time constant answers to the simulated motion; what the law
    differs from it is planned along the measured coordinate.
    """

    def __init__(self):
        super().__init__(self._difference)
        self._linear = Maxwell()

    def build(self, spec, where):
        """Hidden slide, tendon and motor."""
        self._linear.build(spec, where)
        super().build(spec, where)

    def set(self, fields, where, parameters, values):
        """The linear branch."""
        self._linear.set(fields, where, parameters, values)

    def relax(self, fields: Fields, where: Where, position: np.ndarray) -> None:
        """As of `Maxwell`."""
        self._linear.relax(fields, where, position)

    @staticmethod
    def _difference(values, context, where, parameters):
        q = CubicSpline(context.time_s, context.coordinates[:, where.axes[0]])(context.step_time_s)
        step = context.step_time_s[1] - context.step_time_s[0]
        return (maxwell(values[:, :2], q, step) - eyring(values, q, step))[:, :, None]


def maxwell(values: np.ndarray, q: np.ndarray, step_s: float) -> np.ndarray:
    """Force (m, n) of a spring and a linear dashpot in series, values (m, 2) are stiffness and time constant.

    Along a coordinate (n,) that they rest at the start of.
    """
    stiffness, time = values.T
    fades = np.exp(-step_s / time)
    return stiffness[:, None] * _stretched(q, lambda e: e * fades, len(values))


# Stretch in lengths at which a flowing dashpot is as fast as the linear one of its time constant
_AS_LINEAR = 2.0


def eyring(values: np.ndarray, q: np.ndarray, step_s: float) -> np.ndarray:
    """Force (m, n) of a spring and an Eyring dashpot in series along a coordinate (n,) that they rest at the start of.

    Stiffness, time constant of a stretch of two lengths, and length l, values (m, 3). The stretch e follows
    e' = q' - r sinh(e / l). Between steps tanh(e / 2 l) fades as exp(-r t / l), whatever the step. Source: Eyring,
    J. Chem. Phys. 4 (1936) 283.
    """
    stiffness, time, length = values.T
    fades = np.exp(-step_s * _AS_LINEAR / np.sinh(_AS_LINEAR) / time)
    both = 2 * length
    return stiffness[:, None] * _stretched(
        q, lambda e: both * np.arctanh(np.tanh(e / both) * fades), len(values)
    )


def _stretched(q: np.ndarray, flown: Callable[[np.ndarray], np.ndarray], count: int) -> np.ndarray:
    """Stretches (count, n) of springs along a coordinate (n,): ``flown`` is what a step leaves of them, (count,)."""
    stretch = np.zeros((len(q), count))
    for last, now, way in zip(stretch[:-1], stretch[1:], np.diff(q), strict=True):
        now[:] = flown(last + way)
    return stretch.T


def bouc_wen(values: np.ndarray, q: np.ndarray) -> np.ndarray:
    """Force z (m, n) of stiffness k, loading b + g and dissipation b, values (m, 3), along a coordinate (n,).

    z' = k v - b |v| z - g v |z|: k - (b + g) |z| is its slope while it is loaded, k + (b - g) |z| while it is relieved;
    it takes energy for b > 0. Source: Wen, J. Eng. Mech. Div. 102 (1976) 249, exponent 1.
    """
    way = np.diff(q)
    z = np.zeros((len(values), len(q)))
    for row, (stiffness, loading, dissipation) in zip(z, values, strict=True):
        # linear in z while the signs last, loaded or relieved: each step is exact for its increment
        rate = np.array([loading, 2 * dissipation - loading])[:, None] * np.abs(way)
        small = np.abs(rate) < 1e-9
        gain = np.where(small, 1.0, -np.expm1(-rate) / np.where(small, 1.0, rate))
        added, kept = (stiffness * way * gain).tolist(), np.exp(-rate).tolist()
        force, path = 0.0, []
        # plain numbers: a step of arrays this short is all overhead
        for push, k0, k1, a0, a1 in zip((stiffness * way).tolist(), *kept, *added, strict=True):
            force = force * k0 + a0 if push * force >= 0 else force * k1 + a1
            path.append(force)
        row[1:] = path
    return z
