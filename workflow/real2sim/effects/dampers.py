"""Damping of another shape than a straight line."""

from __future__ import annotations

from real2sim.effects.base import AtRest, Effect, EffectParameter, quadratic_damping
from real2sim.effects.friction import LOSSES
from real2sim.effects.springs import Polynomial

_SPEEDS = "the same amplitude at three speeds"

EFFECTS = (
    Effect(
        "quadratic_damping",
        "interface",
        "F = d qdot + d2 qdot |qdot|",
        (EffectParameter("quadratic", "Ns2/m2|Nms2/rad2", 0.0, 30.0, (0.5, 3.0), quadratic_damping),),
        separating_trial=_SPEEDS,
        at_rest=AtRest((0.0,)),
        confusable=LOSSES,
        group="V",
        plant=Polynomial("dof_dampingpoly", 0),
    ),
)
