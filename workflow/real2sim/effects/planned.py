"""Forces that are planned before the simulation, or answered between its windows."""

from __future__ import annotations

from collections.abc import Callable

import mujoco
import numpy as np
from scipy.interpolate import CubicSpline

from real2sim.effects.base import Mechanism, Where
from real2sim.effects.controller import Law
from real2sim.effects.robot import InterfaceMass
from real2sim.system.plant import STRAP_JOINTS


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


class LooseDamper(PlannedForce):
    """A strap that does not damp where it is loose, beside a ``spring`` that does not pull there.

    ``tight`` maps values (m, p), coordinate (steps,) and side to the share (m, steps) of the axis' damper that is at
    work, ``always`` values to the share (m,) that is so everywhere. Where the strap is loose is told by the measured
    coordinate; what is damped is the simulated motion.
    """

    def __init__(
        self, spring: Mechanism, tight: Callable[..., np.ndarray], always: Callable[..., np.ndarray]
    ):
        super().__init__(self._at_work)
        self._spring, self._tight, self._always = spring, tight, always

    def build(self, spec, where):
        """The spring, and an actuator that damps by its control."""
        self._spring.build(spec, where)
        super().build(spec, where)
        for name in self._names(where):
            damper = spec.actuator(name)
            damper.gaintype = mujoco.mjtGain.mjGAIN_AFFINE
            damper.gainprm[:3] = 0, 0, -1

    def set(self, fields, where, parameters, values):
        """The joint keeps what damps everywhere."""
        self._spring.set(fields, where, parameters, values)
        axis = where.axes[0]
        fields["dof_damping"][:, fields.dof(axis)] = self._always(values) * parameters[:, 6 + axis]

    def _at_work(self, values, context, where, parameters):
        axis = where.axes[0]
        q = CubicSpline(context.time_s, context.coordinates[:, axis])(context.step_time_s)
        share = self._tight(values, q, where.side) - self._always(values)[:, None]
        return (parameters[:, 6 + axis, None] * share)[..., None]


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
