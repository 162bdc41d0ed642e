"""Springs of another shape than a straight line."""

from __future__ import annotations

from collections.abc import Callable

import mujoco
import numpy as np
from scipy.interpolate import CubicSpline
from scipy.optimize import nnls

from real2sim.effects.base import (
    FAR,
    AtRest,
    Effect,
    EffectParameter,
    Fields,
    InterfaceImpedance,
    Mechanism,
    Where,
    add_tendon,
    cubic_stiffness,
    excursion,
    quadratic_stiffness,
)
from real2sim.effects.chains import Context
from real2sim.effects.planned import DrivenForce

# Confusable effects
# One number, or one a simulation (m,)
Share = float | np.ndarray
SHAPES = ("slack", "one_sided", "stiffening", "asymmetric_stiffness", "joint_limit")


class SplitSpring(Mechanism):
    """The axis' spring replaced by two one-way springs: one pulls below ``low``, one above ``high``.

    ``shape`` maps values (m, p) to (low, high, factor of the lower, factor of the upper stiffness), each (m,).
    """

    kinds = ("elastic",)
    replaces_spring = True

    def __init__(self, shape: Callable[[np.ndarray, Where], tuple[Share, Share, Share, Share]]):
        self._shape = shape

    def build(self, spec: mujoco.MjSpec, where: Where) -> None:
        """Add two fixed tendons over the joint."""
        joint = where.joint()
        for half in ("below", "above"):
            add_tendon(
                spec, f"{half}_{where.element}", {joint: 1.0}, stiffness=[1, 0, 0], springlength=[-FAR, FAR]
            )

    def set(self, fields: Fields, where: Where, impedance: InterfaceImpedance, values: np.ndarray) -> None:
        """Write dead bands and stiffness of both tendons; the joint's own spring is off."""
        axis = where.axis
        low, high, lower, upper = self._shape(values, where)
        below, above = fields.tendon(f"below_{where.element}"), fields.tendon(f"above_{where.element}")
        fields["jnt_stiffness"][:, fields.joint(axis)] = 0
        fields["tendon_lengthspring"][:, below, 0], fields["tendon_lengthspring"][:, below, 1] = low, FAR
        fields["tendon_lengthspring"][:, above, 0], fields["tendon_lengthspring"][:, above, 1] = -FAR, high
        fields["tendon_stiffness"][:, below] = lower * impedance.k[:, axis]
        fields["tendon_stiffness"][:, above] = upper * impedance.k[:, axis]


class SoftDeadBand(Mechanism):
    """The axis' spring in three equal parts with dead bands of their own: values are half width and softness, (m, 2).

    The half widths are the value less and plus the softness as a share of it, and the value: a slack strap of foam or
    belt takes up its load little by little.
    """

    kinds = ("elastic",)
    replaces_spring = True

    _PARTS = (-1.0, 0.0, 1.0)

    def build(self, spec: mujoco.MjSpec, where: Where) -> None:
        """Add three fixed tendons over the joint."""
        joint = where.joint()
        for i in range(len(self._PARTS)):
            add_tendon(
                spec, f"band{i}_{where.element}", {joint: 1.0}, stiffness=[1, 0, 0], springlength=[0, 0]
            )

    def set(self, fields: Fields, where: Where, impedance: InterfaceImpedance, values: np.ndarray) -> None:
        """Write dead bands and stiffness of the parts; the joint's own spring is off."""
        axis = where.axis
        half_width, softness = values.T
        fields["jnt_stiffness"][:, fields.joint(axis)] = 0
        for i, part in enumerate(self._PARTS):
            index, width = fields.tendon(f"band{i}_{where.element}"), half_width * (1 + part * softness)
            fields["tendon_lengthspring"][:, index] = np.stack([-width, width], axis=1)
            fields["tendon_stiffness"][:, index] = impedance.k[:, axis] / len(self._PARTS)


class OneSided(Mechanism):
    """A share of the axis' spring pulls to one side alone, beyond a coordinate: values are place and share, (m, 2)."""

    kinds = ("elastic",)
    replaces_spring = True

    def build(self, spec: mujoco.MjSpec, where: Where) -> None:
        """Add one fixed tendon over the joint."""
        joint = where.joint()
        add_tendon(
            spec, f"one_sided_{where.element}", {joint: 1.0}, stiffness=[1, 0, 0], springlength=[-FAR, FAR]
        )

    def set(self, fields: Fields, where: Where, impedance: InterfaceImpedance, values: np.ndarray) -> None:
        """Write both springs: the joint keeps the rest, the tendon's free side is the dead band."""
        axis, index = where.axis, fields.tendon(f"one_sided_{where.element}")
        place, share = values.T
        fields["jnt_stiffness"][:, fields.joint(axis)] = (1 - share) * impedance.k[:, axis]
        fields["tendon_lengthspring"][:, index, 1 if where.side > 0 else 0] = where.side * place
        fields["tendon_stiffness"][:, index] = share * impedance.k[:, axis]


class Polynomial(Mechanism):
    """Higher terms of the axis' spring or damper: name of the field, and which of its two coefficients."""

    def __init__(self, name: str, term: int):
        self._name, self._term = name, term
        self.kinds = ("elastic",) if name.startswith("jnt") else ("dissipative",)

    def set(self, fields: Fields, where: Where, impedance: InterfaceImpedance, values: np.ndarray) -> None:
        """Write the coefficient."""
        axis = where.axis
        index = fields.joint(axis) if self._name.startswith("jnt") else fields.dof(axis)
        fields[self._name][:, index, self._term] = values[:, 0]


class ExponentialSpring(Mechanism):
    """The axis' spring stiffens exponentially, values (m, 2): a length, and how much of it begins as a toe.

    Between k L sinh(q / L), of which the beginning is linear, and k L (exp(|q| / L) - 1) sgn q, which bends at once.
    Each is a cubic spring and springs with dead bands, linear and cubic beyond them, to 1 % of the force and 0.03 k L
    up to 6 L.
    """

    kinds = ("elastic",)
    _KNOTS = np.array([0.15, 0.5, 1.0, 2.0, 3.2, 4.5])

    def __init__(self) -> None:
        reach = np.linspace(0, 6, 601)[1:]
        beyond = np.maximum(reach[:, None] - self._KNOTS, 0)
        springs = np.column_stack([reach**3, beyond, beyond**3])
        self._shares = np.array(
            [
                nnls(springs / (law + reach)[:, None], law / (law + reach))[0]
                for law in (np.sinh(reach) - reach, np.expm1(reach) - reach)
            ]
        )

    def build(self, spec: mujoco.MjSpec, where: Where) -> None:
        """Add a fixed tendon over the joint for each dead band."""
        joint = where.joint()
        for i in range(len(self._KNOTS)):
            name = f"steeper{i}_{where.element}"
            add_tendon(spec, name, {joint: 1.0}, stiffness=[1, 0, 1], springlength=[-FAR, FAR])

    def set(self, fields: Fields, where: Where, impedance: InterfaceImpedance, values: np.ndarray) -> None:
        """Write the joint's cubic term, and dead bands and both terms of the tendons."""
        axis, n = where.axis, len(self._KNOTS)
        length, toe = values.T
        shares = (1 - toe)[:, None] * self._shares[0] + toe[:, None] * self._shares[1]
        cubic, linear, beyond = np.split(shares, [1, 1 + n], axis=1)
        stiffness = impedance.k[:, axis]
        third = stiffness / length**2
        fields["jnt_stiffnesspoly"][:, fields.joint(axis), 1] = third * cubic[:, 0]
        for i, knot in enumerate(self._KNOTS):
            index = fields.tendon(f"steeper{i}_{where.element}")
            fields["tendon_lengthspring"][:, index] = knot * np.stack([-length, length], axis=1)
            fields["tendon_stiffness"][:, index] = stiffness * linear[:, i]
            fields["tendon_stiffnesspoly"][:, index, 1] = third * beyond[:, i]


class EvenSpring(Mechanism):
    """A quadratic term of the axis' spring, which goes straight on beyond a coordinate: values are both, (m, 2).

    Without an end the polynomial alone would make the interface lose all stiffness on one side.
    """

    kinds = ("elastic",)

    def build(self, spec: mujoco.MjSpec, where: Where) -> None:
        """Add one fixed tendon over the joint."""
        joint = {where.joint(): 1.0}
        add_tendon(spec, f"straight_{where.element}", joint, stiffness=[1, 1, 0], springlength=[-FAR, FAR])

    def set(self, fields: Fields, where: Where, impedance: InterfaceImpedance, values: np.ndarray) -> None:
        """Write the joint's even term; beyond its dead band the tendon cancels the excess of b q^2 over its tangent."""
        axis, index = where.axis, fields.tendon(f"straight_{where.element}")
        quadratic, end = values.T
        fields["jnt_stiffnesspoly"][:, fields.joint(axis), 0] = quadratic
        fields["tendon_stiffness"][:, index] = 0
        fields["tendon_stiffnesspoly"][:, index, 0] = -quadratic
        fields["tendon_lengthspring"][:, index, 0], fields["tendon_lengthspring"][:, index, 1] = -end, end


class LooseDamper(DrivenForce):
    """A strap that does not damp where it is loose, beside a ``spring`` that does not pull there.

    ``tight`` maps values (m, p), coordinate (steps,) and side to the share (m, steps) of the axis' damper that is at
    work, ``always`` values to the share (m,) that is at work everywhere. The measured coordinate decides where the
    strap is loose; the simulated motion is damped.
    """

    kinds = ("elastic", "damping by coordinate")
    replaces_spring = True
    control_is_force = False

    def __init__(
        self, spring: Mechanism, tight: Callable[..., np.ndarray], always: Callable[..., np.ndarray]
    ):
        super().__init__()
        self._spring, self._tight, self._always = spring, tight, always

    def build(self, spec: mujoco.MjSpec, where: Where) -> None:
        """Add the spring, and an actuator that damps by its control."""
        self._spring.build(spec, where)
        super().build(spec, where)
        for name in self._names(where):
            damper = spec.actuator(name)
            damper.gaintype = mujoco.mjtGain.mjGAIN_AFFINE
            damper.gainprm[:3] = 0, 0, -1

    def set(self, fields: Fields, where: Where, impedance: InterfaceImpedance, values: np.ndarray) -> None:
        """Write the spring; the joint keeps the damping that is at work everywhere."""
        self._spring.set(fields, where, impedance, values)
        axis = where.axis
        fields["dof_damping"][:, fields.dof(axis)] = self._always(values) * impedance.d[:, axis]

    def force(
        self, values: np.ndarray, context: Context, where: Where, impedance: InterfaceImpedance
    ) -> np.ndarray:
        """Return the damping that is at work beyond that of the joint."""
        axis = where.axis
        q = CubicSpline(context.time_s, context.coordinates[:, axis])(context.step_time_s)
        share = self._tight(values, q, where.side) - self._always(values)[:, None]
        return np.asarray((impedance.d[:, axis, None] * share)[..., None])


_LADDER = "one motion at three amplitudes, from smaller than the slack upward"

EFFECTS = (
    Effect(
        "slack",
        "interface",
        "F = k sgn(q) max(|q| - w, 0)",
        (EffectParameter("half_width", "m|rad", 0.01, 1.2, (0.15, 0.5), excursion, log=True),),
        separating_trial=_LADDER,
        at_rest=AtRest((1e-9,), limit="no slack"),
        confusable=SHAPES,
        group="A",
        plant=SplitSpring(lambda v, where: (-v[:, 0], v[:, 0], 1.0, 1.0)),
    ),
    Effect(
        "slack",
        "interface",
        "F = k sgn(q) mean of max(|q| - w_i, 0), w_i = w (1 - s), w, w (1 + s): the load is taken up little by little",
        (
            EffectParameter("half_width", "m|rad", 0.02, 1.2, (0.3,), excursion, log=True),
            EffectParameter("softness", "1", 0.1, 1.0, (0.5,)),
        ),
        separating_trial=_LADDER,
        at_rest=AtRest((1e-9, 0.5), limit="no slack"),
        confusable=SHAPES,
        group="A",
        plant=SoftDeadBand(),
        form="_soft",
    ),
    Effect(
        "slack",
        "interface",
        "as slack; inside, the strap does not damp either",
        (EffectParameter("half_width", "m|rad", 0.01, 1.2, (0.1, 0.4), excursion, log=True),),
        separating_trial=_LADDER,
        at_rest=AtRest((1e-9,), tolerance=7e-4, limit="no slack, but damping by a planned force"),
        confusable=SHAPES,
        group="A",
        plant=LooseDamper(
            SplitSpring(lambda v, where: (-v[:, 0], v[:, 0], 1.0, 1.0)),
            lambda v, q, side: np.abs(q) > v,
            lambda v: np.zeros(len(v)),
        ),
        form="_undamped",
        remedy="Let the strap's joint damp only beyond half_width",
    ),
    Effect(
        "one_sided",
        "interface",
        "F = k ((1 - s) q + s max(q - q0, 0)), or its mirror image: a share of the strap pulls to one side alone",
        (
            # from zero on it would be asymmetric_stiffness by another name
            EffectParameter("engages_at", "m|rad", 0.03, 0.5, (0.06,), excursion),
            EffectParameter("share", "1", 0.05, 1.0, (0.5, 0.9)),
        ),
        separating_trial=_LADDER,
        at_rest=AtRest((0.06, 0.0), limit="no share"),
        confusable=SHAPES,
        group="S",
        scope="side",
        plant=OneSided(),
    ),
    Effect(
        "one_sided",
        "interface",
        "as one_sided; where that share of the strap is loose it does not damp either",
        (
            EffectParameter("engages_at", "m|rad", -0.05, 0.5, (0.03,), excursion),
            EffectParameter("share", "1", 0.05, 1.0, (0.4, 0.8)),
        ),
        separating_trial=_LADDER,
        at_rest=AtRest((0.03, 0.0), limit="no share"),
        confusable=SHAPES,
        group="S",
        scope="side",
        plant=LooseDamper(
            OneSided(),
            lambda v, q, side: 1 - v[:, 1:] * (side * q < v[:, :1]),
            lambda v: 1 - v[:, 1],
        ),
        form="_undamped",
        remedy="Scale the damping of the strap's joint by 1 - share while it is on the loose side",
    ),
    Effect(
        "stiffening",
        "interface",
        "F = k q + c q^3",
        (EffectParameter("cubic", "N/m3|Nm/rad3", 0.0, 30.0, (0.5, 3.0), cubic_stiffness),),
        separating_trial=_LADDER,
        at_rest=AtRest((0.0,)),
        confusable=SHAPES,
        group="A",
        plant=Polynomial("jnt_stiffnesspoly", 1),
    ),
    Effect(
        "stiffening",
        "interface",
        "F = k L ((1 - toe) sinh(|q| / L) + toe (exp(|q| / L) - 1)) sgn q",
        (
            EffectParameter("length", "m|rad", 0.12, 5.0, (0.4, 1.0), excursion, log=True),
            EffectParameter("toe", "1", 0.0, 1.0, (0.3,)),
        ),
        separating_trial=_LADDER,
        at_rest=AtRest((1e9, 0.5), limit="an infinite length"),
        confusable=SHAPES,
        group="A",
        plant=ExponentialSpring(),
        form="_exponential",
    ),
    Effect(
        "asymmetric_stiffness",
        "interface",
        "F = k (1 + b sgn(q)) q",
        (
            # a side that carries a tenth of the other or less is loose: one_sided
            EffectParameter("asymmetry", "1", -0.8, 0.8, (-0.4, 0.4)),
        ),
        separating_trial=_LADDER,
        at_rest=AtRest((0.0,)),
        confusable=SHAPES,
        plant=SplitSpring(lambda v, where: (0.0 * v[:, 0], 0.0 * v[:, 0], 1 - v[:, 0], 1 + v[:, 0])),
    ),
    Effect(
        "asymmetric_stiffness",
        "interface",
        "F = k q + b q^2, b q^2 along its tangent beyond a coordinate on either side",
        (
            EffectParameter("quadratic", "N/m2|Nm/rad2", -0.6, 0.6, (-0.2, 0.2), quadratic_stiffness),
            EffectParameter("straight_beyond", "m|rad", 0.3, 4.0, (1.0,), excursion, log=True),
        ),
        separating_trial=_LADDER,
        at_rest=AtRest((0.0, 1.0)),
        confusable=SHAPES,
        plant=EvenSpring(),
        form="_quadratic",
    ),
)
