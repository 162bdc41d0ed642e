"""A robot that is heavier, softer or built otherwise than its twin."""

from __future__ import annotations

import mujoco
import numpy as np

from real2sim.effects.base import Fields, Where, add_branch, set_branch


class InterfaceMass:
    """Mass and isotropic inertia that the twin's interface body lacks, values (m, 2) [kg, kg m^2]."""

    def build(self, spec, where):
        """Nothing: mass is a field."""

    def set(self, fields, where, parameters, values):
        """Add to the body."""
        body = fields.model.body("interface").id
        fields["body_mass"][:, body] = fields.model.body_mass[body] + values[:, 0]
        fields["body_inertia"][:, body] = fields.model.body_inertia[body] + values[:, 1:2]


class RobotImpedance:
    """Other impedance of the robot's joints than configured: ln-factors on stiffness and damping of some joints."""

    def __init__(self, joints: tuple[str, ...]):
        self._joints = joints

    def build(self, spec, where):
        """Nothing: impedances are fields."""

    def set(self, fields, where, parameters, values):
        """Scale, with the step's centring of the damping."""
        factor, h = np.exp(values), fields.model.opt.timestep
        for column, name in enumerate(self._joints):
            joint = fields.model.joint(name)
            dof, base = int(joint.dofadr[0]), fields.model.dof_damping[joint.dofadr[0]]
            fields["jnt_stiffness"][:, joint.id] = (
                fields.model.jnt_stiffness[joint.id] * factor[:, 2 * column]
            )
            damping = base * factor[:, 2 * column + 1]
            fields["dof_damping"][:, dof] = damping
            fields["dof_armature"][:, dof] = fields.model.dof_armature[dof] + (base - damping) * h / 2


class RobotRelaxation:
    """Joints of the robot with a spring and a damper in series beside their own impedance.

    Values are ln of the branches' stiffness in units of the configured one, joint by joint, and a time constant.
    """

    def __init__(self, joints: tuple[str, ...]):
        self._joints = joints

    def _names(self, where: Where) -> list[str]:
        return [f"series_{name}_{where.element}" for name in self._joints]

    def build(self, spec, where):
        """A branch per joint."""
        for name, joint in zip(self._names(where), self._joints, strict=True):
            add_branch(spec, name, joint)

    def set(self, fields, where, parameters, values):
        """Stiffness and damping; at rest where the joint's own spring is."""
        for name, joint, ln in zip(self._names(where), self._joints, values[:, :-1].T, strict=True):
            number = fields.model.joint(joint).id
            set_branch(fields, name, fields.model.jnt_stiffness[number] * np.exp(ln), values[:, -1])
            rest = fields["qpos_spring"][:, fields.model.jnt_qposadr[number]]
            fields["tendon_lengthspring"][:, fields.tendon(name)] = rest[:, None]


class YieldBeyondWheels:
    """Joints of the robot that yield beyond what its log measures: a spring in series with the configured impedance.

    Values are ln of the springs' stiffness in units of the configured one, joint by joint. The wheels are hidden slides
    in that impedance, and what the log shows.
    """

    def __init__(self, joints: tuple[str, ...]):
        self._joints = joints

    def logged(self, where: Where) -> dict[str, str]:
        """Joint that the log shows instead of each of the robot's."""
        return {joint: f"wheels_{joint}_{where.element}" for joint in self._joints}

    def build(self, spec, where):
        """A slide and a tendon per joint."""
        for joint, name in self.logged(where).items():
            add_branch(spec, name, joint)

    def set(self, fields, where, parameters, values):
        """The impedance from the joint to its slide, and the spring between."""
        model, h = fields.model, fields.model.opt.timestep
        for (joint, name), ln in zip(self.logged(where).items(), values.T, strict=True):
            number, slide = model.joint(joint).id, model.joint(name)
            dof = int(model.jnt_dofadr[number])
            stiffness, damping = model.jnt_stiffness[number], model.dof_damping[dof]
            fields["jnt_stiffness"][:, number] = fields["dof_damping"][:, dof] = 0
            fields["dof_armature"][:, dof] = model.dof_armature[dof] + damping * h / 2
            fields["jnt_stiffness"][:, slide.id] = stiffness
            fields["dof_damping"][:, int(slide.dofadr[0])] = damping
            fields["tendon_stiffness"][:, fields.tendon(name)] = stiffness * np.exp(ln)
            rest = fields["qpos_spring"][:, model.jnt_qposadr[number]]
            fields["tendon_lengthspring"][:, fields.tendon(name)] = rest[:, None]


class SlackBeyondWheels(YieldBeyondWheels):
    """As `YieldBeyondWheels`, with play: values are ln of stiffness and then half of the play [m, rad], by joint."""

    def set(self, fields, where, parameters, values):
        """The spring of each joint has a dead band."""
        joints = len(self._joints)
        super().set(fields, where, parameters, values[:, :joints])
        for name, half in zip(self.logged(where).values(), values[:, joints:].T, strict=True):
            band = half[:, None] * np.array([-1.0, 1.0])
            fields["tendon_lengthspring"][:, fields.tendon(name)] += band


# What a joint has of the description it is in, and is not told
_OF_SPEC = ("id", "parent", "frame", "signature", "classname", "compiler", "set_frame")


def _carry(spec: mujoco.MjSpec, name: str, carrying: list[dict]) -> None:
    """Add joints with springs and dampers that carry a body with its own joints.

    MuJoCo appends joints, and a later one turns with the earlier ones: the body's own are taken off and put back.
    """
    body = spec.body(name)
    own = []
    for joint in list(body.joints):
        told = [key for key in dir(joint) if not key.startswith("_") and key not in _OF_SPEC]
        values = {key: getattr(joint, key) for key in told}
        own.append(
            {key: value.copy() if isinstance(value, np.ndarray) else value for key, value in values.items()}
        )
        spec.delete(joint)
    for attributes in carrying:
        body.add_joint(stiffness=[1, 0, 0], damping=[1, 0, 0], **attributes)
    for attributes in own:
        joint = body.add_joint()
        for key, value in attributes.items():
            setattr(joint, key, value)


def _set_carrying(fields: Fields, names: list[str], values: np.ndarray) -> None:
    """Stiffness of two joints and time constant of their dampers, the first three of values (m, p)."""
    for name, stiffness in zip(names, values[:, :2].T, strict=True):
        joint = fields.model.joint(name)
        fields["jnt_stiffness"][:, joint.id] = stiffness
        fields["dof_damping"][:, joint.dofadr[0]] = stiffness * values[:, 2]


class Rocking:
    """The robot rocks on its suspension, which no encoder sees: what carries the arm turns about the floor.

    Values (m, 4) are stiffness in roll and pitch [Nm/rad], time constant of the damping [s] and inertia of what rocks
    beside the arm [kg m2]. The hinges are hidden and carry the arm.
    """

    def _names(self, where: Where) -> list[str]:
        return [f"rocking_{axis}_{where.element}" for axis in ("roll", "pitch")]

    def build(self, spec, where):
        """Two hinges on the floor below the middle of the base."""
        arm = spec.body("arm")
        base = np.array([arm.pos[0], arm.pos[1], arm.pos[2] + arm.parent.pos[2]])
        joints = zip(self._names(where), np.eye(3)[:2], strict=True)
        hinge = mujoco.mjtJoint.mjJNT_HINGE
        _carry(
            spec, "arm", [{"name": name, "type": hinge, "axis": axis, "pos": -base} for name, axis in joints]
        )

    def set(self, fields, where, parameters, values):
        """Springs, dampers and inertia."""
        _set_carrying(fields, self._names(where), values)
        for name in self._names(where):
            fields["dof_armature"][:, fields.model.joint(name).dofadr[0]] = values[:, 3]


class Bending:
    """The column between base and arm bends, which no encoder sees.

    Values (m, 3) are stiffness along x and y [N/m] and time constant of the damping [s]. The slides are hidden and
    carry the arm.
    """

    def _names(self, where: Where) -> list[str]:
        return [f"bending_{axis}_{where.element}" for axis in "xy"]

    def build(self, spec, where):
        """Two slides that carry the arm."""
        joints = zip(self._names(where), np.eye(3)[:2], strict=True)
        slide = mujoco.mjtJoint.mjJNT_SLIDE
        _carry(spec, "arm", [{"name": name, "type": slide, "axis": axis} for name, axis in joints])

    def set(self, fields, where, parameters, values):
        """Springs and dampers."""
        _set_carrying(fields, self._names(where), values)
