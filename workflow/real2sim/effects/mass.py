"""An interface that is heavier than its model."""

from __future__ import annotations

from collections.abc import Callable

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
    load_inertias,
    loads,
)
from real2sim.effects.chains import Context
from real2sim.effects.planned import StandingForce
from real2sim.effects.robot import LOADS
from real2sim.system.description import ARM_JOINTS

# Smallest distance that MuJoCo takes for a centre of mass off its body's origin [m]
_OFF_ORIGIN_M = 1e-6


class InterfaceMass(Mechanism):
    """Mass and isotropic inertia that the model's interface body lacks, values (m, 2) [kg, kg m^2]."""

    kinds = ("inertial",)

    def overwrites(self, where: Where) -> frozenset[str]:
        """Return that it writes the mass of the body."""
        return frozenset({"mass of the interface"})

    def set(self, fields: Fields, where: Where, impedance: InterfaceImpedance, values: np.ndarray) -> None:
        """Add to the body."""
        body = fields.model.body(where.system.body).id
        fields["body_mass"][:, body] = fields.model.body_mass[body] + values[:, 0]
        fields["body_inertia"][:, body] = fields.model.body_inertia[body] + values[:, 1:2]


class HangingMass(StandingForce):
    """`InterfaceMass` whose weight nothing balances: it hangs from the arm, in the neutral trial as well."""

    kinds = ("inertial",)

    def __init__(self, plan: Callable[..., np.ndarray], joints: tuple[str, ...]):
        super().__init__(plan, joints)
        self._mass = InterfaceMass()

    def overwrites(self, where: Where) -> frozenset[str]:
        """As of `InterfaceMass`."""
        return self._mass.overwrites(where)

    def set(self, fields: Fields, where: Where, impedance: InterfaceImpedance, values: np.ndarray) -> None:
        """Add to the body."""
        self._mass.set(fields, where, impedance, values)


class OffCentreMass(HangingMass):
    """A part on the interface beside its centre, in the neutral trial as well, whose moments nothing balances.

    Values (m, 6) are mass [kg], isotropic inertia [kg m^2], mass times its place in the interface (3) [kg m], and the
    mass that the lift does not balance [kg].
    """

    def build(self, spec: mujoco.MjSpec, where: Where) -> None:
        """Add the motors; MuJoCo fixes a centre of mass that is at the body's origin when compiled, so move it."""
        super().build(spec, where)
        body = spec.body(where.system.body)
        body.ipos = body.ipos + _OFF_ORIGIN_M

    def set(self, fields: Fields, where: Where, impedance: InterfaceImpedance, values: np.ndarray) -> None:
        """Add to the body and move its centre."""
        super().set(fields, where, impedance, values)
        model = fields.model
        body = model.body(where.system.body).id
        centre = model.body_ipos[body] - _OFF_ORIGIN_M
        moment = model.body_mass[body] * centre + values[:, 2:5]
        fields["body_ipos"][:, body] = moment / fields["body_mass"][:, body, None]


def weight(values: np.ndarray, context: Context, where: Where, impedance: InterfaceImpedance) -> np.ndarray:
    """Return forces (m, steps, 1) [N] on the lift of masses, the first of values (m, p) [kg]."""
    return np.repeat(-9.81 * values[:, :1, None], len(context.step_time_s), axis=1)


def moments(values: np.ndarray, context: Context, where: Where, impedance: InterfaceImpedance) -> np.ndarray:
    """Return forces (m, steps, 3) [N, Nm] on lift, roll and pitch of parts, values (m, 6) of `OffCentreMass`."""
    mass, _, x, y, _, unbalanced = values.T
    # the arm turns about its own origin
    pull = 9.81 * np.stack([-unbalanced, -y - context.on_arm[1] * mass, x + context.on_arm[0] * mass], axis=1)
    return np.repeat(pull[:, None], len(context.step_time_s), axis=1)


_MASS = "the same motion with a plate of known mass on the interface"

EFFECTS = (
    Effect(
        "added_mass",
        "robot",
        "the interface is heavier than the twin's",
        (
            EffectParameter("mass", "kg", -2.0, 40.0, (2.0,), loads),
            EffectParameter("inertia", "kgm2", -0.02, 2.0, (0.02,), load_inertias),
        ),
        separating_trial=_MASS,
        at_rest=AtRest((0.0, 0.0)),
        confusable=LOADS,
        group="M",
        scope="whole",
        needs=frozenset({"interface_body"}),
        plant=InterfaceMass(),
    ),
    Effect(
        "added_mass",
        "robot",
        "the interface is heavier than the twin's, and its weight hangs from the arm, in the neutral trial as well",
        (
            EffectParameter("mass", "kg", -2.0, 40.0, (2.0,), loads),
            EffectParameter("inertia", "kgm2", -0.02, 2.0, (0.02,), load_inertias),
        ),
        separating_trial=_MASS,
        at_rest=AtRest((0.0, 0.0)),
        confusable=LOADS,
        group="M",
        scope="whole",
        needs=frozenset({"arm", "interface_body", "pose"}),
        plant=HangingMass(weight, ARM_JOINTS[:1]),
        form="hanging",
        remedy="Push the arm's lift down by 9.81 m/s2 times the mass, which is part of this model",
    ),
    Effect(
        "added_mass",
        "robot",
        "a part sits on the interface off its centre, in the neutral trial as well: the lift balances some of its"
        " weight, nothing its moments",
        (
            EffectParameter("mass", "kg", -2.0, 40.0, (2.0,), loads),
            EffectParameter("inertia", "kgm2", -0.02, 2.0, (0.02,), load_inertias),
            *(EffectParameter(f"moment_{c}", "kgm", -3.0, 3.0, (0.0,), loads) for c in "xyz"),
            EffectParameter("unbalanced", "kg", -2.0, 40.0, (0.0,), loads),
        ),
        separating_trial=_MASS,
        at_rest=AtRest((0.0,) * 6),
        confusable=LOADS,
        group="M",
        scope="whole",
        needs=frozenset({"arm", "interface_body", "pose"}),
        plant=OffCentreMass(moments, ARM_JOINTS),
        form="off_centre",
        remedy=(
            "Push the arm's lift down by 9.81 m/s2 times the unbalanced mass, and turn its roll and pitch by 9.81 m/s2"
            " times the mass' moments about the arm"
        ),
    ),
)
