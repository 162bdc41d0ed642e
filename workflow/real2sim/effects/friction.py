"""Dry friction, even and uneven, smooth and with bristles."""

from __future__ import annotations

from typing import Any

import mujoco
import numpy as np

from real2sim.effects.base import (
    AtRest,
    Effect,
    EffectParameter,
    Fields,
    InterfaceImpedance,
    Mechanism,
    Where,
    excursion,
    interface_force,
    rate,
)

# Confusable effects
LOSSES = ("coulomb", "lugre", "hysteresis", "relaxation", "creep", "quadratic_damping")
# An axis that hardly slips is fitted as a stiff one, and friction beyond its force in the plain fit holds it
FRICTION = EffectParameter("force", "N|Nm", 0.002, 15.0, (0.05, 0.3), interface_force, log=True)


class DryFriction(Mechanism):
    """Coulomb friction as a constraint, which sticks and slips at any time step: value (m, 1) is its force.

    The constraint is made as hard as MuJoCo allows; its default lets the joint creep.
    """

    kinds = ("dissipative", "hysteresis")
    sticks = True

    def build(self, spec: mujoco.MjSpec, where: Where) -> None:
        """Give the joint friction, which has to be there when compiled."""
        joint = spec.joint(where.joint())
        joint.frictionloss = 1e-6
        joint.solref_friction = [2.0 * spec.option.timestep, 1.0]
        joint.solimp_friction = [0.9999, 0.9999, 0.001, 0.5, 2.0]

    def set(self, fields: Fields, where: Where, impedance: InterfaceImpedance, values: np.ndarray) -> None:
        """Write the force."""
        fields["dof_frictionloss"][:, fields.dof(where.axis)] = np.maximum(values[:, 0], 1e-9)


class UnevenFriction(DryFriction):
    """Dry friction that differs by direction: values (m, 2) are its mean and the excess against upward motion.

    It equals even friction beside a constant force, moving and sticking.
    """

    def build(self, spec: mujoco.MjSpec, where: Where) -> None:
        """Give the joint friction and an actuator without a command."""
        super().build(spec, where)
        _without_command(spec, f"uneven_{where.element}", where)

    def set(self, fields: Fields, where: Where, impedance: InterfaceImpedance, values: np.ndarray) -> None:
        """Write the even friction and the force."""
        super().set(fields, where, impedance, values)
        index = fields.model.actuator(f"uneven_{where.element}").id
        fields["actuator_biasprm"][:, index, 0] = -values[:, 0] * values[:, 1]


def _without_command(spec: mujoco.MjSpec, name: str, where: Where, **attributes: Any) -> None:
    """Add an actuator of the axis whose force depends on nothing but the joint."""
    actuator = spec.add_actuator(
        name=name,
        trntype=mujoco.mjtTrn.mjTRN_JOINT,
        target=where.joint(),
        gaintype=mujoco.mjtGain.mjGAIN_FIXED,
        biastype=mujoco.mjtBias.mjBIAS_AFFINE,
        **attributes,
    )
    actuator.gainprm = [0] * 10


class SmoothFriction(Mechanism):
    """Friction that fades towards standstill, f tanh(qdot / rate): values (m, 2) are force and rate.

    Dampers that saturate, whose sum runs along the tangent hyperbolic: it creeps where dry friction holds.
    """

    kinds = ("dissipative", "hysteresis")
    substeps = 4
    _parts = 3

    def __init__(self) -> None:
        # the curve's slope falls from 1 in equal shares, one wherever a damper saturates; all together make 1
        rates = np.arctanh(np.sqrt((np.arange(self._parts) + 0.5) / self._parts))
        self._weights = rates / rates.sum()
        self._rates = self._weights * self._parts

    def _names(self, where: Where) -> list[str]:
        return [f"smooth_{i}_{where.element}" for i in range(self._parts)]

    def build(self, spec: mujoco.MjSpec, where: Where) -> None:
        """Add actuators without a command that brake up to a force."""
        for name in self._names(where):
            limited = mujoco.mjtLimited.mjLIMITED_TRUE
            _without_command(spec, name, where, forcelimited=limited, forcerange=[-1, 1])

    def set(self, fields: Fields, where: Where, impedance: InterfaceImpedance, values: np.ndarray) -> None:
        """Write slope and limit of each damper, all slopes together limited to what the time step allows."""
        force, rate = values.T
        limit = force[:, None] * self._weights
        slope = limit / (rate[:, None] * self._rates)
        most = fields.hardest(where.axis)
        slope *= np.minimum(1, most / slope.sum(axis=1, keepdims=True))
        for i, name in enumerate(self._names(where)):
            index = fields.model.actuator(name).id
            fields["actuator_biasprm"][:, index, 2] = -slope[:, i]
            fields["actuator_forcerange"][:, index] = np.stack([-limit[:, i], limit[:, i]], axis=1)


class Bristles(Mechanism):
    """LuGre friction of MuJoCo's motor model: values are Coulomb force, static excess, deflection, Stribeck rate.

    Source: Canudas de Wit et al., IEEE Trans. Autom. Control 40 (1995) 419.
    """

    kinds = ("dissipative", "hysteresis")
    substeps = 4

    def build(self, spec: mujoco.MjSpec, where: Where) -> None:
        """Add a passive motor without an electrical side."""
        actuator = spec.add_actuator(
            name=f"bristles_{where.element}",
            trntype=mujoco.mjtTrn.mjTRN_JOINT,
            target=where.joint(),
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

    def set(self, fields: Fields, where: Where, impedance: InterfaceImpedance, values: np.ndarray) -> None:
        """Write a bristle stiffness at which it slips at the deflection, limited to what the time step allows."""
        axis = where.axis
        index = fields.model.actuator(f"bristles_{where.element}").id
        force, excess, deflection, rate = values.T
        stiffness = np.minimum(np.abs(force) / deflection, fields.stiffest(axis))
        fields["actuator_dynprm"][:, index, 5] = stiffness
        fields["actuator_dynprm"][:, index, 6] = 0
        fields["actuator_biasprm"][:, index, 3] = force
        fields["actuator_biasprm"][:, index, 4] = force * (1 + excess)
        fields["actuator_biasprm"][:, index, 5] = rate


EFFECTS = (
    Effect(
        "coulomb",
        "interface",
        "F = Fc sgn(qdot)",
        (FRICTION,),
        separating_trial="slow ramps and reversals at several speeds",
        at_rest=AtRest((1e-9,), limit="no force"),
        confusable=LOSSES,
        group="V",
        plant=DryFriction(),
    ),
    Effect(
        "coulomb",
        "interface",
        "F = Fc (1 + uneven sgn(qdot)) sgn(qdot)",
        (FRICTION, EffectParameter("uneven", "1", -0.95, 0.95, (0.0,))),
        separating_trial="slow ramps and reversals at several speeds",
        at_rest=AtRest((1e-9, 0.0), limit="no force"),
        confusable=LOSSES,
        group="V",
        plant=UnevenFriction(),
        form="_uneven",
    ),
    Effect(
        "coulomb",
        "interface",
        "F = Fc tanh(qdot / rate): friction that fades towards standstill",
        (
            FRICTION,
            EffectParameter("rate", "m/s|rad/s", 0.003, 1.0, (0.05,), rate, log=True),
        ),
        separating_trial="slow ramps and reversals at several speeds",
        at_rest=AtRest((1e-9, 0.05), limit="no force"),
        confusable=LOSSES,
        group="V",
        plant=SmoothFriction(),
        form="_smooth",
    ),
    Effect(
        "lugre",
        "interface",
        "F = s0 z, zdot = v - s0 |v| z / (Fc + (Fs - Fc) exp(-(v/vs)^2))",
        (
            FRICTION,
            EffectParameter("static_excess", "1", 0.05, 2.0, (0.5,)),
            EffectParameter("deflection", "m|rad", 0.0005, 0.2, (0.03, 0.003), excursion, log=True),
            EffectParameter("stribeck_rate", "m/s|rad/s", 0.01, 1.0, (0.1,), rate, log=True),
        ),
        separating_trial="sub-millimetre reversals and a ladder of speeds",
        at_rest=AtRest((1e-9, 0.5, 0.03, 0.1), limit="no force"),
        confusable=LOSSES,
        plant=Bristles(),
    ),
)
