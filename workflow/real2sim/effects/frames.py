"""Axes that are turned or coupled, and a strap that rests elsewhere."""

from __future__ import annotations

from itertools import combinations

import mujoco
import numpy as np
from scipy.spatial.transform import Rotation

from real2sim.effects.base import Fields, Where, add_tendon
from real2sim.geometry import AXES
from real2sim.system.plant import STRAP_JOINTS

# Tendons over the sum and the difference of two coordinates: what they pull with opposite signs cancels but for the
# product of the two
_PRODUCT = ((1, "sum"), (-1, "difference"))


def _product(spec: mujoco.MjSpec, ending: str, axes: tuple[int, int]) -> None:
    """Both tendons over two strap joints."""
    a, b = (STRAP_JOINTS[i] for i in axes)
    for sign, name in _PRODUCT:
        add_tendon(
            spec, f"{name}_{ending}", {a: 1.0, b: float(sign)}, stiffness=[0, 0, 0], springlength=[0, 0]
        )


def _set_product(fields: Fields, ending: str, field: str, values: np.ndarray) -> None:
    """Off-diagonal stiffness or damping (m,): half of it on each."""
    for sign, name in _PRODUCT:
        fields[field][:, fields.tendon(f"{name}_{ending}")] = sign * values / 2


class Coupling:
    """Off-diagonal stiffness or damping between two axes, value (m, 1), the diagonal left alone."""

    def __init__(self, name: str):
        self._field = name

    def build(self, spec, where):
        """Both tendons."""
        _product(spec, where.element, where.axes)

    def set(self, fields, where, parameters, values):
        """Half the value on each, with opposite signs."""
        _set_product(fields, where.element, self._field, values[:, 0])


class TurnedAxes:
    """All strap axes turned by a rotation vector, values (m, 3) [rad]."""

    def build(self, spec, where):
        """Nothing: axes are fields."""

    def set(self, fields, where, parameters, values):
        """Turn the axis of each joint."""
        turn = Rotation.from_rotvec(values).as_matrix()
        for axis in range(6):
            joint = fields.joint(axis)
            fields["jnt_axis"][:, joint] = turn @ fields.model.jnt_axis[joint]


class TurnedLaw:
    """Stiffness and damping of the strap turned by a rotation vector, its coordinates left as they are: values (m, 3).

    What the turned matrices have beyond those of the strap is on tendons over each coordinate and over each two: it
    comes on top of whatever law an axis follows.
    """

    _blocks = ((0, 1, 2), (3, 4, 5))

    def build(self, spec, where):
        """Tendons of no stiffness."""
        for axis in range(6):
            joint = {STRAP_JOINTS[axis]: 1.0}
            add_tendon(spec, self._name(where, axis), joint, stiffness=[0, 0, 0], springlength=[0, 0])
        for block in self._blocks:
            for a, b in combinations(block, 2):
                _product(spec, self._name(where, a, b), (a, b))

    def _name(self, where: Where, *axes: int) -> str:
        return "_".join(["turned", *(AXES[a] for a in axes), where.element])

    def set(self, fields, where, parameters, values):
        """What the turned matrices add."""
        turn = Rotation.from_rotvec(values).as_matrix()
        for field, first in (("tendon_stiffness", 0), ("tendon_damping", 6)):
            for block in self._blocks:
                plain = parameters[:, first + np.array(block)]
                added = np.einsum("mij,mj,mkj->mik", turn, plain, turn) - plain[:, :, None] * np.eye(3)
                for i, axis in enumerate(block):
                    fields[field][:, fields.tendon(self._name(where, axis))] = added[:, i, i]
                for (i, a), (j, b) in combinations(enumerate(block), 2):
                    _set_product(fields, self._name(where, a, b), field, added[:, i, j])


def _pelvis_at_rest(model: mujoco.MjModel) -> np.ndarray:
    """Pelvis in the interface's axes at rest, (3, 3); the interface is level, so the last row is the vertical."""
    rest = np.zeros(9)
    mujoco.mju_quat2Mat(rest, model.body("pelvis").quat)
    return rest.reshape(3, 3)


class TurnedBack:
    """All strap axes turned about the vertical against a turn of the pelvis' path, value (m, 1) [rad]."""

    def build(self, spec, where):
        """Nothing: axes are fields."""

    def set(self, fields, where, parameters, values):
        """The path carries the axes along with it; the strap hangs on the person all the same."""
        vertical = _pelvis_at_rest(fields.model)[2]
        TurnedAxes().set(fields, where, parameters, -values * vertical)


class RestShift:
    """The axis' strap rests elsewhere, with all laws that it follows there: value (m, 1). Set after other effects."""

    def build(self, spec, where):
        """Nothing: the rest pose is a field."""

    def set(self, fields, where, parameters, values):
        """Spring reference of the joint, and lengths at which tendons over it are slack or stop."""
        rest_moved(fields, where.axes[0], values[:, 0])


def rest_moved(fields: Fields, axis: int, by: np.ndarray) -> None:
    """Move the rest of a strap axis by (m,) [m, rad]: its spring, and where tendons over it are slack or stop."""
    joint = fields.model.joint(STRAP_JOINTS[axis])
    fields["qpos_spring"][:, joint.qposadr[0]] += by
    for index, coefficient in _tendons_over(fields.model, joint.id):
        fields["tendon_lengthspring"][:, index] += coefficient * by[:, None]
        if fields.model.tendon_limited[index]:
            fields["tendon_range"][:, index] += coefficient * by[:, None]


def _tendons_over(model: mujoco.MjModel, joint: int) -> list[tuple[int, float]]:
    """Fixed tendons over a joint: index and coefficient."""
    out = []
    for index, (first, count) in enumerate(zip(model.tendon_adr, model.tendon_num, strict=True)):
        for wrap in range(first, first + count):
            if model.wrap_type[wrap] == mujoco.mjtWrap.mjWRAP_JOINT and model.wrap_objid[wrap] == joint:
                out.append((index, float(model.wrap_prm[wrap])))
    return out
