"""A rest pose that moves in the course of a trial, and stays."""

from __future__ import annotations

import numpy as np

from real2sim.effects.base import AtRest, Effect, EffectParameter, InterfaceImpedance, Where, excursion
from real2sim.effects.chains import Context
from real2sim.effects.planned import PlannedForce

# Confusable effects
DRIFTS = ("migration", "marker_drift", "creep")


def ratchet(values: np.ndarray, context: Context, where: Where, impedance: InterfaceImpedance) -> np.ndarray:
    """Return forces (m, steps, 1) [N, Nm] on the joint, values (m, 2) are threshold [m, rad] and rate [1/s]."""
    # the rest pose follows the coordinate beyond a threshold, at a rate, and never returns
    axis, dt = where.axis, context.time_s[1] - context.time_s[0]
    pulled = (where.side * context.coordinates[:, axis]).tolist()
    slipped = np.zeros((len(values), len(pulled)))
    # plain numbers: a step of arrays this short is all overhead
    for row, (threshold, rate) in zip(slipped, values.tolist(), strict=True):
        share, way, path = 1 - np.exp(-rate * dt), 0.0, []
        for here in pulled[1:]:
            beyond = here - way - threshold
            way += beyond * share if beyond > 0 else 0.0
            path.append(way)
        row[1:] = path
    force = where.side * impedance.k[:, axis, None] * slipped
    return np.stack([np.interp(context.step_time_s, context.time_s, row) for row in force])[:, :, None]


def wandering(
    values: np.ndarray, context: Context, where: Where, impedance: InterfaceImpedance
) -> np.ndarray:
    """Return forces (m, steps, 1) [N, Nm] on the joint of a rest pose that drifts at rates (m, 1) [m/s, rad/s]."""
    return np.asarray(
        impedance.k[:, where.axis, None, None] * values[:, None, :] * _since_motion(context)[:, None]
    )


def settling(values: np.ndarray, context: Context, where: Where, impedance: InterfaceImpedance) -> np.ndarray:
    """Return forces (m, steps, 1) [N, Nm] on the joint, values (m, 2) are way [m, rad] and time constant [s]."""
    gone = 1 - np.exp(-_since_motion(context) / values[:, 1:])
    return np.asarray((impedance.k[:, where.axis, None] * values[:, :1] * gone)[..., None])


def _since_motion(context: Context) -> np.ndarray:
    """Return the time (steps,) [s] since motion onset, 0 before."""
    return np.asarray(np.maximum(context.step_time_s - context.time_s[context.start], 0.0))


_STAND = "quiet standing at three headings before and after"

EFFECTS = (
    Effect(
        "migration",
        "interface",
        "F = k (q - r), r' = c max(q - r - w, 0): beyond a threshold the rest pose follows, and stays",
        (
            EffectParameter("threshold", "m|rad", 0.02, 1.3, (0.6, 0.25), excursion, log=True),
            EffectParameter("rate", "1/s", 0.02, 50.0, (1.0, 1.0), log=True),
        ),
        separating_trial=_STAND,
        at_rest=AtRest((1e3, 1.0), limit="a threshold that is never reached"),
        confusable=DRIFTS,
        group="Dft",
        scope="side",
        plant=PlannedForce(ratchet, kinds=("memory", "hysteresis", "slow change")),
        remedy=(
            "Add a force k r to the strap joint on its side, k its stiffness: r follows q - threshold at the rate"
            " while the strap is beyond it, and never returns"
        ),
    ),
    Effect(
        "migration",
        "interface",
        "F = k (q - c t): the rest pose wanders at one rate from where the person starts to move",
        (EffectParameter("rate", "m/s|rad/s", -0.3, 0.3, (-0.03, 0.03), excursion),),
        separating_trial=_STAND,
        at_rest=AtRest((0.0,)),
        confusable=DRIFTS,
        group="Dft",
        plant=PlannedForce(wandering, kinds=("memory", "hysteresis", "slow change")),
        form="_steady",
        remedy="Add a force k rate t to the strap joint, k its stiffness, t from where the person starts to move",
    ),
    Effect(
        "migration",
        "interface",
        "F = k (q - a (1 - exp(-t / tau))): the rest pose goes over to another from where the person starts to move",
        (
            EffectParameter("way", "m|rad", -1.0, 1.0, (-0.2, 0.2), excursion),
            EffectParameter("time_constant", "s", 0.5, 10.0, (3.0,), log=True),
        ),
        separating_trial=_STAND,
        at_rest=AtRest((0.0, 3.0)),
        confusable=DRIFTS,
        group="Dft",
        plant=PlannedForce(settling, kinds=("memory", "hysteresis", "slow change")),
        form="_settling",
        remedy=(
            "Add a force k way (1 - exp(-t / time_constant)) to the strap joint, k its stiffness, t from where the"
            " person starts to move"
        ),
    ),
)
