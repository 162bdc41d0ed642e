"""Forces that are fed into a simulation as controls."""

from __future__ import annotations

from collections.abc import Callable

import mujoco
import numpy as np

from real2sim.effects.base import InterfaceImpedance, Mechanism, Where
from real2sim.effects.chains import Context


class DrivenForce(Mechanism):
    """Forces on some joints, fed in as controls.

    ``joints`` are names, or None for the joint of the effect's axis.
    """

    planned = True

    def __init__(self, joints: tuple[str, ...] | None = None):
        self._joints = joints

    def columns(self, model: mujoco.MjModel, where: Where) -> np.ndarray:
        """Return the columns of the motors."""
        return np.array([model.actuator_ctrladr[model.actuator(n).id] for n in self._names(where)])

    def _names(self, where: Where) -> list[str]:
        return [f"planned_{joint}_{where.element}" for joint in self._targets(where)]

    def _targets(self, where: Where) -> tuple[str, ...]:
        return self._joints or (where.joint(),)

    def build(self, spec: mujoco.MjSpec, where: Where) -> None:
        """Add the motors."""
        for name, joint in zip(self._names(where), self._targets(where), strict=True):
            actuator = spec.add_actuator(name=name, trntype=mujoco.mjtTrn.mjTRN_JOINT, target=joint)
            actuator.set_to_motor()


class PlannedForce(DrivenForce):
    """Forces that are planned before the simulation from measurements.

    ``plan`` maps values (m, p), context, place and the interface's impedance to forces (m, steps, j) [N, Nm];
    ``kinds`` as of `Mechanism`.
    """

    def __init__(
        self,
        plan: Callable[..., np.ndarray],
        joints: tuple[str, ...] | None = None,
        kinds: tuple[str, ...] = (),
    ):
        super().__init__(joints)
        self._plan = plan
        if kinds:
            self.kinds = kinds

    def force(
        self, values: np.ndarray, context: Context, where: Where, impedance: InterfaceImpedance
    ) -> np.ndarray:
        """Return the planned forces."""
        return self._plan(values, context, where, impedance)


class FamilyForce(PlannedForce):
    """A planned force that is linear in its values and depends on measurements alone.

    ``feeds_back`` as of `Mechanism`.
    """

    linear = True

    def __init__(
        self,
        plan: Callable[..., np.ndarray],
        joints: tuple[str, ...] | None = None,
        *,
        feeds_back: bool = False,
    ):
        super().__init__(plan, joints)
        self.feeds_back = feeds_back


class StandingForce(PlannedForce):
    """A steady force on the robot that has acted in the neutral trial too, where the rest pose was taken.

    The force stretched the interface there, whose rest pose differs by that from the observed one (`EffectReplay`).
    """

    acts_in_neutral = True
