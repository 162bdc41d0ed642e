"""Axes that are turned or coupled, and another rest pose."""

from __future__ import annotations

from dataclasses import replace
from itertools import combinations

import mujoco
import numpy as np
from scipy.spatial.transform import Rotation

from real2sim.effects.base import (
    AtRest,
    Effect,
    EffectParameter,
    Fields,
    InterfaceImpedance,
    Mechanism,
    Where,
    add_tendon,
    damping,
    excursion,
    near_zero,
    stiffness,
)
from real2sim.effects.chains import Chains, Context, Observation, Poses

# Confusable effects
TURNS = ("cross_coupling", "misalignment", "lab_yaw")
RESTS = ("preload", "tilt", "marker_offset")
# Tendons over the sum and the difference of two coordinates: with opposite signs they leave the product of the two
_PRODUCT = ((1, "sum"), (-1, "difference"))


def _product(spec: mujoco.MjSpec, ending: str, joints: tuple[str, str]) -> None:
    """Add both tendons over two joints."""
    a, b = joints
    for sign, name in _PRODUCT:
        add_tendon(
            spec, f"{name}_{ending}", {a: 1.0, b: float(sign)}, stiffness=[0, 0, 0], springlength=[0, 0]
        )


def _set_product(fields: Fields, ending: str, field: str, values: np.ndarray) -> None:
    """Write off-diagonal stiffness or damping (m,): half of it on each tendon."""
    for sign, name in _PRODUCT:
        fields[field][:, fields.tendon(f"{name}_{ending}")] = sign * values / 2


class Coupling(Mechanism):
    """Off-diagonal stiffness or damping between two axes, value (m, 1), the diagonal left alone."""

    kinds = ("elastic coupling", "coupling")

    def __init__(self, name: str):
        self._field = name

    def build(self, spec: mujoco.MjSpec, where: Where) -> None:
        """Add both tendons."""
        a, b = where.axes
        _product(spec, where.element, (where.joint(a), where.joint(b)))

    def set(self, fields: Fields, where: Where, impedance: InterfaceImpedance, values: np.ndarray) -> None:
        """Write half the value on each, with opposite signs."""
        _set_product(fields, where.element, self._field, values[:, 0])


class TurnedAxes(Mechanism):
    """All axes turned by a rotation vector, values (m, 3) [rad]."""

    kinds = ("elastic coupling", "coupling")

    def overwrites(self, where: Where) -> frozenset[str]:
        """Return that it writes the axes of the joints."""
        return frozenset({"joint axes"})

    def set(self, fields: Fields, where: Where, impedance: InterfaceImpedance, values: np.ndarray) -> None:
        """Turn the axis of each joint."""
        turn = Rotation.from_rotvec(values).as_matrix()
        for axis in range(len(where.system.axes)):
            joint = fields.joint(axis)
            fields["jnt_axis"][:, joint] = turn @ fields.model.jnt_axis[joint]


class TurnedLaw(Mechanism):
    """Stiffness and damping turned by a rotation vector, the coordinates left as they are: values (m, 3) [rad].

    The difference of the turned matrices from the plain ones is on tendons over each coordinate and over each two, on
    top of whatever law an axis follows.
    """

    kinds = ("elastic coupling", "coupling")
    _blocks = ((0, 1, 2), (3, 4, 5))

    def build(self, spec: mujoco.MjSpec, where: Where) -> None:
        """Add tendons of no stiffness."""
        for axis in range(len(where.system.axes)):
            joint = {where.joint(axis): 1.0}
            add_tendon(spec, self._name(where, axis), joint, stiffness=[0, 0, 0], springlength=[0, 0])
        for block in self._blocks:
            for a, b in combinations(block, 2):
                _product(spec, self._name(where, a, b), (where.joint(a), where.joint(b)))

    def _name(self, where: Where, *axes: int) -> str:
        return "_".join(["turned", *(where.system.axes[a].name for a in axes), where.element])

    def set(self, fields: Fields, where: Where, impedance: InterfaceImpedance, values: np.ndarray) -> None:
        """Write the difference of the turned matrices."""
        turn = Rotation.from_rotvec(values).as_matrix()
        for field, diagonal in (("tendon_stiffness", impedance.k), ("tendon_damping", impedance.d)):
            for block in self._blocks:
                plain = diagonal[:, np.array(block)]
                added = np.einsum("mij,mj,mkj->mik", turn, plain, turn) - plain[:, :, None] * np.eye(3)
                for i, axis in enumerate(block):
                    fields[field][:, fields.tendon(self._name(where, axis))] = added[:, i, i]
                for (i, a), (j, b) in combinations(enumerate(block), 2):
                    _set_product(fields, self._name(where, a, b), field, added[:, i, j])


def segment_at_rest(model: mujoco.MjModel, segment: str) -> np.ndarray:
    """Return the segment in the interface's axes at rest, (3, 3); of a level interface the last row is the vertical."""
    rest = np.zeros(9)
    mujoco.mju_quat2Mat(rest, model.body(segment).quat)
    return rest.reshape(3, 3)


class RestShift(Mechanism):
    """The axis rests elsewhere, with all laws that it follows: value (m, 1). Set after other effects."""

    kinds = ("elastic",)
    order = 1
    moves_rest = True

    def set(self, fields: Fields, where: Where, impedance: InterfaceImpedance, values: np.ndarray) -> None:
        """Write the spring reference of the joint, and the lengths at which tendons over it are slack or stop."""
        move_rest(fields, where.axis, values[:, 0])


def move_rest(fields: Fields, axis: int, by: np.ndarray) -> None:
    """Move the rest of an axis by (m,) [m, rad]: its spring, and where tendons over it are slack or stop."""
    joint = fields.joint(axis)
    fields["qpos_spring"][:, fields.model.jnt_qposadr[joint]] += by
    move_tendons(fields, joint, by)


def move_tendons(fields: Fields, joint: int, by: np.ndarray, first: int = 0) -> None:
    """Move where tendons over a joint are slack or stop by (m,) [m, rad] of it; those from index ``first`` on."""
    for index, coefficient in _tendons_over(fields.model, joint):
        if index < first:
            continue
        fields["tendon_lengthspring"][:, index] += coefficient * by[:, None]
        if fields.model.tendon_limited[index]:
            fields["tendon_range"][:, index] += coefficient * by[:, None]


def _tendons_over(model: mujoco.MjModel, joint: int) -> list[tuple[int, float]]:
    """Return the fixed tendons over a joint: index and coefficient."""
    out = []
    for index, (first, count) in enumerate(zip(model.tendon_adr, model.tendon_num, strict=True)):
        for wrap in range(first, first + count):
            if model.wrap_type[wrap] == mujoco.mjtWrap.mjWRAP_JOINT and model.wrap_objid[wrap] == joint:
                out.append((index, float(model.wrap_prm[wrap])))
    return out


class RestTurned(Observation):
    """The interface rests turned about one of its axes against the neutral trial, value (m, 1) [rad]."""

    of_markers = False

    def true_poses(self, values: np.ndarray, seen: Poses, context: Context, axes: tuple[int, ...]) -> Poses:
        """Turn the rest pose about the segment's axis; the start is as observed."""
        turn = Rotation.from_rotvec(values[0] * np.eye(3)[axes[0] - 3]).as_matrix()
        return replace(seen, rest_rotation=turn @ seen.rest_rotation)


_SINGLE = "motions along one axis at a time"
_STAND = "quiet standing at three headings before and after"
_TURN = tuple(near_zero(f"turn_{axis}", "rad", 0.2, 0.6) for axis in "xyz")

EFFECTS = (
    Effect(
        "cross_coupling",
        "interface",
        "F_i = K_ij q_j, F_j = K_ij q_i",
        (EffectParameter("stiffness", "SI", -0.9, 0.9, (-0.15, 0.15), stiffness),),
        separating_trial=_SINGLE,
        at_rest=AtRest((0.0,)),
        confusable=TURNS,
        group="F",
        scope="pair",
        plant=Coupling("tendon_stiffness"),
        form="_elastic",
    ),
    Effect(
        "cross_coupling",
        "interface",
        "F_i = D_ij qdot_j, F_j = D_ij qdot_i",
        (EffectParameter("damping", "SI", -0.9, 0.9, (-0.15, 0.15), damping),),
        separating_trial=_SINGLE,
        at_rest=AtRest((0.0,)),
        confusable=TURNS,
        group="F",
        scope="pair",
        plant=Coupling("tendon_damping"),
        form="_viscous",
    ),
    Effect(
        "misalignment",
        "interface",
        "interface axes turned by a rotation vector",
        _TURN,
        separating_trial=_SINGLE,
        at_rest=AtRest((0.0, 0.0, 0.0)),
        confusable=TURNS,
        group="F",
        scope="whole",
        needs=frozenset({"six_axes"}),
        plant=TurnedAxes(),
    ),
    Effect(
        "misalignment",
        "interface",
        "F = R K R' q + R D R' qdot: stiffness and damping turned by a rotation vector, the coordinates as they are",
        _TURN,
        separating_trial=_SINGLE,
        at_rest=AtRest((0.0, 0.0, 0.0)),
        confusable=TURNS,
        group="F",
        scope="whole",
        needs=frozenset({"six_axes"}),
        plant=TurnedLaw(),
        form="law",
    ),
    Effect(
        "preload",
        "interface",
        "F = k (q - q0)",
        (EffectParameter("rest_shift", "m|rad", -2.0, 2.0, (-0.2, 0.2), excursion),),
        separating_trial=_STAND,
        at_rest=AtRest((0.0,)),
        confusable=RESTS,
        group="S",
        plant=RestShift(),
    ),
    Effect(
        "preload",
        "interface",
        "the strap rests turned about an axis, and its other axes turn with it",
        (EffectParameter("rest_turn", "rad", -2.0, 2.0, (-0.2, 0.2), excursion),),
        separating_trial=_STAND,
        at_rest=AtRest((0.0,)),
        confusable=RESTS,
        group="S",
        scope="turn",
        needs=frozenset({"pose", "six_axes"}),
        chains=Chains(observation=RestTurned()),
        form="_turned",
    ),
)
