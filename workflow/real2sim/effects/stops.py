"""Stops inside the range that the joint limits allow."""

from __future__ import annotations

import mujoco
import numpy as np

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
    stiffness,
)
from real2sim.effects.springs import SHAPES

# Share of the acceleration at a stop that MuJoCo's constraint imposes by itself: a small one makes the stop push as a
# spring and a damper do, whatever else acts there
_STOP_IMPEDANCE = 0.2


class Stop(Mechanism):
    """A spring and a damper that only push, beyond a coordinate: place, stiffness and damping ratio (m, 3).

    The limit of a tendon, so that the damper does not pull back. Its stiffness is limited to what the time step allows.
    """

    kinds = ("elastic",)
    weighed = True

    def build(self, spec: mujoco.MjSpec, where: Where) -> None:
        """Add one tendon, limited far off."""
        add_tendon(
            spec,
            f"stop_{where.element}",
            {where.joint(): 1.0},
            limited=mujoco.mjtLimited.mjLIMITED_TRUE,
            range=[-FAR, FAR],
            solref_limit=[-1.0, -1.0],
            solimp_limit=[_STOP_IMPEDANCE, _STOP_IMPEDANCE, 0.001, 0.5, 2.0],
        )

    def set(self, fields: Fields, where: Where, impedance: InterfaceImpedance, values: np.ndarray) -> None:
        """Write its place, and its rates in units of the inertia against it."""
        index, axis = fields.tendon(f"stop_{where.element}"), where.axis
        place, stiffness, ratio = values.T
        limits, rates = fields["tendon_range"], fields["tendon_solref_lim"]
        limits[:, index] = -FAR, FAR
        limits[:, index, 1 if where.side > 0 else 0] = where.side * place
        inertia = fields.scales.inertia[axis]
        square = np.minimum(stiffness, 2 * fields.stiffest(axis)) / inertia
        rates[:, index, 0], rates[:, index, 1] = -square, -2 * ratio * np.sqrt(square)


class GentleStop(Mechanism):
    """A stop that begins gently, with the square of the distance beyond: values are place and curvature, (m, 2)."""

    kinds = ("elastic",)

    def build(self, spec: mujoco.MjSpec, where: Where) -> None:
        """Add one tendon over the joint, its dead band without an end."""
        joint = {where.joint(): 1.0}
        add_tendon(spec, f"gentle_{where.element}", joint, stiffness=[1, 1, 0], springlength=[-FAR, FAR])

    def set(self, fields: Fields, where: Where, impedance: InterfaceImpedance, values: np.ndarray) -> None:
        """Write the end of the dead band and the square, which is even, so that its sign is the side's."""
        index = fields.tendon(f"gentle_{where.element}")
        place, curvature = values.T
        fields["tendon_stiffness"][:, index] = 0
        fields["tendon_stiffnesspoly"][:, index, 0] = where.side * curvature
        fields["tendon_lengthspring"][:, index, 1 if where.side > 0 else 0] = where.side * place


class GentleStops(Mechanism):
    """Stops on both sides that begin with the cube of the distance beyond: values are clearance and cubic, (m, 2)."""

    kinds = ("elastic",)

    def build(self, spec: mujoco.MjSpec, where: Where) -> None:
        """Add one tendon over the joint, whose dead band is the clearance."""
        joint = {where.joint(): 1.0}
        add_tendon(spec, f"stops_{where.element}", joint, stiffness=[1, 0, 1], springlength=[-FAR, FAR])

    def set(self, fields: Fields, where: Where, impedance: InterfaceImpedance, values: np.ndarray) -> None:
        """Write dead band and cube."""
        index = fields.tendon(f"stops_{where.element}")
        clearance, cubic = values.T
        fields["tendon_stiffness"][:, index] = 0
        fields["tendon_stiffnesspoly"][:, index, 1] = cubic
        fields["tendon_lengthspring"][:, index] = np.stack([-clearance, clearance], axis=1)


EFFECTS = (
    Effect(
        "joint_limit",
        "interface",
        "a stop inside the range that the limits allow: a spring and a damper that only push",
        (
            EffectParameter("place", "m|rad", 0.3, 1.2, (0.6, 0.85), excursion, log=True),
            EffectParameter("stiffness", "N/m|Nm/rad", 1.0, 5000.0, (8.0,), stiffness, log=True),
            EffectParameter("damping_ratio", "1", 0.0, 1.0, (0.1,)),
        ),
        separating_trial="a slow ramp into the stop",
        at_rest=AtRest((100.0, 8.0, 0.1), limit="a stop that is never reached"),
        confusable=SHAPES,
        group="A",
        scope="side",
        plant=Stop(),
    ),
    Effect(
        "joint_limit",
        "interface",
        "F = k q + c (q - place)^2 beyond a place, or its mirror image: a stop that begins gently",
        (
            EffectParameter("place", "m|rad", 0.05, 1.2, (0.4,), excursion, log=True),
            EffectParameter(
                "curvature",
                "N/m2|Nm/rad2",
                0.5,
                2000.0,
                (10.0,),
                quadratic_stiffness,
                log=True,
            ),
        ),
        separating_trial="a slow ramp into the stop",
        at_rest=AtRest((100.0, 10.0), limit="a stop that is never reached"),
        confusable=SHAPES,
        group="A",
        scope="side",
        plant=GentleStop(),
        form="_gentle",
    ),
    Effect(
        "joint_limit",
        "interface",
        "F = k q + c (|q| - clearance)^3 sgn(q) beyond the clearance: stops on both sides that begin gently",
        (
            EffectParameter("clearance", "m|rad", 0.05, 1.0, (0.4,), excursion, log=True),
            EffectParameter(
                "cubic",
                "N/m3|Nm/rad3",
                0.5,
                5000.0,
                (10.0,),
                cubic_stiffness,
                log=True,
            ),
        ),
        separating_trial="a slow ramp into the stop",
        at_rest=AtRest((100.0, 10.0), limit="stops that are never reached"),
        confusable=SHAPES,
        group="A",
        plant=GentleStops(),
        form="_clearance",
    ),
)
