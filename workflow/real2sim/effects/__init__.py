"""Effects that a plain model leaves out, and what a package needs to add its own.

An effect is one `Effect` entry and, where the plant does not have its law yet, one `Mechanism`::

    # bumpy.py
    from real2sim.effects import AtRest, Effect, EffectParameter, Mechanism, damping


    class CubicDamper(Mechanism):
        def set(self, fields, where, impedance, values):
            fields["dof_dampingpoly"][:, fields.dof(where.axis), 1] = values[:, 0]


    EFFECT = Effect(
        "cubic_damping",
        "interface",
        "F = d qdot + d3 qdot^3",
        (EffectParameter("cubic", "Ns3/m3|Nms3/rad3", 0.0, 1e3, (1.0,), damping),),
        separating_trial="the same amplitude at three speeds",
        at_rest=AtRest((0.0,)),
        confusable=("cubic_damping", "quadratic_damping"),
        plant=CubicDamper(),
    )

The package names it in its ``pyproject.toml``; the catalogue, the diagnosis and the table of effects have it then::

    [project.entry-points."real2sim.effects"]
    bumpy = "bumpy:EFFECT"
"""

from real2sim.effects.base import (
    FAR,
    AtRest,
    Effect,
    EffectParameter,
    Fields,
    InterfaceImpedance,
    Law,
    Mechanism,
    Placed,
    Scales,
    Where,
    add_branch,
    add_tendon,
    damping,
    excursion,
    interface_force,
    near_zero,
    rate,
    set_branch,
    stiffness,
)
from real2sim.effects.chains import Chains, Context, Observation, Poses
from real2sim.effects.planned import DrivenForce, PlannedForce, StandingForce

__all__ = [
    "FAR",
    "AtRest",
    "Chains",
    "Context",
    "DrivenForce",
    "Effect",
    "EffectParameter",
    "Fields",
    "InterfaceImpedance",
    "Law",
    "Mechanism",
    "Observation",
    "Placed",
    "PlannedForce",
    "Poses",
    "Scales",
    "StandingForce",
    "Where",
    "add_branch",
    "add_tendon",
    "damping",
    "excursion",
    "interface_force",
    "near_zero",
    "rate",
    "set_branch",
    "stiffness",
]
