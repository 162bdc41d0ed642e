"""A floor that slopes."""

from __future__ import annotations

import numpy as np

from real2sim.effects.base import AtRest, Effect, EffectParameter, InterfaceImpedance, Where
from real2sim.effects.chains import Context
from real2sim.effects.frames import RESTS
from real2sim.effects.planned import PlannedForce, StandingForce
from real2sim.system.description import BASE_JOINTS


def tilt(values: np.ndarray, context: Context, where: Where, impedance: InterfaceImpedance) -> np.ndarray:
    """Return forces on the base along x and y [N] and about its axis [Nm], (m, steps, 3), for slopes (m, 2) [rad].

    Gravity pulls at the centre of mass. What carries the interface lies ahead of the axis that the base turns about, so
    that a slope turns the robot, too, by a moment that depends on where it looks.
    """
    pull = 9.81 * values
    turned = context.interface_rotation
    heading = np.unwrap(np.arctan2(turned[:, 1, 0], turned[:, 0, 0]))
    heading = np.interp(context.step_time_s, context.time_s, heading)
    x, y = context.robot.moment
    ahead = np.stack([np.cos(heading) * x - np.sin(heading) * y, np.sin(heading) * x + np.cos(heading) * y])
    out = np.empty((len(values), len(heading), 3))
    out[..., :2] = context.robot.mass * pull[:, None]
    out[..., 2] = pull[:, 1:] * ahead[0] - pull[:, :1] * ahead[1]
    return out


_SLOPING_FLOOR = (
    "Add to base_x and base_y a constant force, slope times 9.81 m/s2 times the robot's mass, and to base_yaw the"
    " moment of that force at the centre of mass, which turns with the robot"
)

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
        plant=PlannedForce(tilt, BASE_JOINTS, ("place",)),
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
        plant=StandingForce(tilt, BASE_JOINTS, ("place",)),
        form="always",
        remedy=_SLOPING_FLOOR,
    ),
)
