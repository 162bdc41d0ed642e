"""Springs of another shape than a straight line, and stops."""

from __future__ import annotations

from collections.abc import Callable

import mujoco
import numpy as np
from scipy.optimize import nnls

from real2sim.effects.base import FAR, Where, add_tendon
from real2sim.system.plant import STRAP_JOINTS


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
            add_tendon(
                spec, f"{half}_{where.element}", {joint: 1.0}, stiffness=[1, 0, 0], springlength=[-FAR, FAR]
            )

    def set(self, fields, where, parameters, values):
        """Dead bands and stiffness of both tendons; the joint's own spring is off."""
        axis = where.axes[0]
        low, high, lower, upper = self._shape(values, where)
        below, above = fields.tendon(f"below_{where.element}"), fields.tendon(f"above_{where.element}")
        fields["jnt_stiffness"][:, fields.joint(axis)] = 0
        fields["tendon_lengthspring"][:, below, 0], fields["tendon_lengthspring"][:, below, 1] = low, FAR
        fields["tendon_lengthspring"][:, above, 0], fields["tendon_lengthspring"][:, above, 1] = -FAR, high
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
            add_tendon(
                spec, f"band{i}_{where.element}", {joint: 1.0}, stiffness=[1, 0, 0], springlength=[0, 0]
            )

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
        add_tendon(
            spec, f"one_sided_{where.element}", {joint: 1.0}, stiffness=[1, 0, 0], springlength=[-FAR, FAR]
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
            add_tendon(spec, name, {joint: 1.0}, stiffness=[1, 0, 1], springlength=[-FAR, FAR])

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
        add_tendon(spec, f"straight_{where.element}", joint, stiffness=[1, 1, 0], springlength=[-FAR, FAR])

    def set(self, fields, where, parameters, values):
        """The joint's even term; beyond its dead band the tendon takes off what b q^2 has over its tangent."""
        axis, index = where.axes[0], fields.tendon(f"straight_{where.element}")
        quadratic, end = values.T
        fields["jnt_stiffnesspoly"][:, fields.joint(axis), 0] = quadratic
        fields["tendon_stiffness"][:, index] = 0
        fields["tendon_stiffnesspoly"][:, index, 0] = -quadratic
        fields["tendon_lengthspring"][:, index, 0], fields["tendon_lengthspring"][:, index, 1] = -end, end


# Share of the acceleration at a stop that MuJoCo's constraint imposes by itself: with as little, the stop pushes as a
# spring and a damper do, whatever else acts there
_STOP_IMPEDANCE = 0.2


class Stop:
    """A spring and a damper that only push, beyond a coordinate: place, stiffness and damping ratio (m, 3).

    The limit of a tendon, so that the damper pulls no one back. Its stiffness is held to what the time step bears.
    """

    def build(self, spec, where):
        """One tendon, limited far off."""
        add_tendon(
            spec,
            f"stop_{where.element}",
            {STRAP_JOINTS[where.axes[0]]: 1.0},
            limited=mujoco.mjtLimited.mjLIMITED_TRUE,
            range=[-FAR, FAR],
            solref_limit=[-1.0, -1.0],
            solimp_limit=[_STOP_IMPEDANCE, _STOP_IMPEDANCE, 0.001, 0.5, 2.0],
        )

    def set(self, fields, where, parameters, values):
        """Its place, and rates in units of the inertia that comes against it."""
        index, axis = fields.tendon(f"stop_{where.element}"), where.axes[0]
        place, stiffness, ratio = values.T
        limits, rates = fields["tendon_range"], fields["tendon_solref_lim"]
        limits[:, index] = -FAR, FAR
        limits[:, index, 1 if where.side > 0 else 0] = where.side * place
        inertia = fields.scales.inertia[axis]
        square = np.minimum(stiffness, 2 * fields.stiffest(axis)) / inertia
        rates[:, index, 0], rates[:, index, 1] = -square, -2 * ratio * np.sqrt(square)


class GentleStop:
    """A stop that begins gently, with the square of what is beyond: values are place and curvature, (m, 2)."""

    def build(self, spec, where):
        """One tendon over the strap joint, its dead band without an end."""
        joint = {STRAP_JOINTS[where.axes[0]]: 1.0}
        add_tendon(spec, f"gentle_{where.element}", joint, stiffness=[1, 1, 0], springlength=[-FAR, FAR])

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
        add_tendon(spec, f"stops_{where.element}", joint, stiffness=[1, 0, 1], springlength=[-FAR, FAR])

    def set(self, fields, where, parameters, values):
        """Dead band and cube."""
        index = fields.tendon(f"stops_{where.element}")
        clearance, cubic = values.T
        fields["tendon_stiffness"][:, index] = 0
        fields["tendon_stiffnesspoly"][:, index, 1] = cubic
        fields["tendon_lengthspring"][:, index] = np.stack([-clearance, clearance], axis=1)
