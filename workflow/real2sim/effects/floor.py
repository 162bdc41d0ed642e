"""A floor that slopes."""

from __future__ import annotations

import numpy as np

from real2sim.effects.base import AtRest, Effect, EffectParameter, InterfaceImpedance, Where
from real2sim.effects.chains import Context
from real2sim.effects.frames import RESTS
from real2sim.effects.planned import PlannedForce, StandingForce
from real2sim.system.description import BASE_JOINTS


def tilt(values: np.ndarray, context: Context, where: Where, impedance: InterfaceImpedance) -> np.ndarray:
    """Return forces (m, steps, 2) [N] on the base, for slopes (m, 2) [rad]."""
    force = 9.81 * context.robot_mass * values
    return np.repeat(force[:, None, :], len(context.step_time_s), axis=1)


_SLOPING_FLOOR = "Add to base_x and base_y a constant force: slope times 9.81 m/s2 times the robot's mass"

EFFECTS = (
    Effect(
        "tilt",
        "robot",
        "gravity has a component along the floor",
        tuple(EffectParameter(f"slope_{axis}", "rad", -0.1, 0.1, (0.003,)) for axis in "xy"),
        separating_trial="turning in place",
        at_rest=AtRest((0.0, 0.0)),
        confusable=RESTS,
        group="S",
        scope="whole",
        needs=frozenset({"base"}),
        plant=PlannedForce(tilt, BASE_JOINTS[:2], ("place",)),
        remedy=_SLOPING_FLOOR,
    ),
    Effect(
        "tilt",
        "robot",
        "gravity has a component along the floor, and had it in the neutral trial, where it stretched the strap",
        tuple(EffectParameter(f"slope_{axis}", "rad", -0.1, 0.1, (0.003,)) for axis in "xy"),
        separating_trial="turning in place",
        at_rest=AtRest((0.0, 0.0)),
        confusable=RESTS,
        group="S",
        scope="whole",
        needs=frozenset({"base", "pose"}),
        plant=StandingForce(tilt, BASE_JOINTS[:2], ("place",)),
        form="always",
        remedy=_SLOPING_FLOOR,
    ),
)
