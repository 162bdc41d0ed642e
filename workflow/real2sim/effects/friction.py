"""Dry friction, even and uneven, smooth and with bristles."""

from __future__ import annotations

import mujoco
import numpy as np

from real2sim.effects.base import Where
from real2sim.system.plant import STRAP_JOINTS


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
