"""A robot that yields otherwise than configured."""

from __future__ import annotations

from typing import Any

import mujoco
import numpy as np

from real2sim.effects.base import (
    AtRest,
    Effect,
    EffectParameter,
    Fields,
    InterfaceImpedance,
    Mechanism,
    Where,
    add_branch,
    set_branch,
)
from real2sim.system.description import ARM_JOINTS, BASE_JOINTS

# Confusable effects
LOADS = ("added_mass", "base_compliance", "controller_reaction")


# What a mechanism overwrites whose joints carry the arm
_CARRIER = frozenset({"carrier of the arm"})


def impedance_of(joints: tuple[str, ...]) -> frozenset[str]:
    """Return what a mechanism overwrites that writes stiffness and damping of some joints of the robot."""
    return frozenset(f"impedance of {joint}" for joint in joints)


class RobotImpedance(Mechanism):
    """Other impedance of the robot's joints than configured: ln-factors on stiffness and damping of some joints."""

    kinds = ("place", "dissipative")

    def __init__(self, joints: tuple[str, ...]):
        self._joints = joints

    def overwrites(self, where: Where) -> frozenset[str]:
        """Return that it writes the impedance of its joints."""
        return impedance_of(self._joints)

    def set(self, fields: Fields, where: Where, impedance: InterfaceImpedance, values: np.ndarray) -> None:
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


class JointImpedance(Mechanism):
    """`RobotImpedance` of the one joint of the machine that it is placed at: ln-factors on stiffness and damping."""

    kinds = ("place", "dissipative")

    def overwrites(self, where: Where) -> frozenset[str]:
        """As of `RobotImpedance`."""
        return impedance_of((where.machine_joint,))

    def set(self, fields: Fields, where: Where, impedance: InterfaceImpedance, values: np.ndarray) -> None:
        """Scale."""
        RobotImpedance((where.machine_joint,)).set(fields, where, impedance, values)


class PassiveDamping(Mechanism):
    """All joints of the machine without a controller damped by one factor, whose logarithm is the value (m, 1)."""

    kinds = ("dissipative",)

    def set(self, fields: Fields, where: Where, impedance: InterfaceImpedance, values: np.ndarray) -> None:
        """Scale."""
        joints = tuple(joint.name for joint in where.system.machine if joint.impedance is None)
        factors = np.zeros((len(values), 2 * len(joints)))
        factors[:, 1::2] = values
        RobotImpedance(joints).set(fields, where, impedance, factors)


class RobotRelaxation(Mechanism):
    """Joints of the robot with a spring and a damper in series beside their own impedance.

    Values are ln of the branches' stiffness in units of the configured one, joint by joint, and a time constant.
    """

    kinds = ("memory",)

    def __init__(self, joints: tuple[str, ...]):
        self._joints = joints

    def _names(self, where: Where) -> list[str]:
        return [f"series_{name}_{where.element}" for name in self._joints]

    def build(self, spec: mujoco.MjSpec, where: Where) -> None:
        """Add a branch per joint."""
        for name, joint in zip(self._names(where), self._joints, strict=True):
            add_branch(spec, name, joint)

    def set(self, fields: Fields, where: Where, impedance: InterfaceImpedance, values: np.ndarray) -> None:
        """Write stiffness and damping; at rest where the joint's own spring is."""
        for name, joint, ln in zip(self._names(where), self._joints, values[:, :-1].T, strict=True):
            number = fields.model.joint(joint).id
            set_branch(fields, name, fields.model.jnt_stiffness[number] * np.exp(ln), values[:, -1])
            rest = fields["qpos_spring"][:, fields.model.jnt_qposadr[number]]
            fields["tendon_lengthspring"][:, fields.tendon(name)] = rest[:, None]


class YieldBeyondWheels(Mechanism):
    """Joints of the robot that yield beyond what its log measures: a spring in series with the configured impedance.

    Values are ln of the springs' stiffness in units of the configured one, joint by joint. The wheels are hidden slides
    in that impedance, and the log shows these.
    """

    kinds = ("place", "dissipative")

    def __init__(self, joints: tuple[str, ...]):
        self._joints = joints

    def overwrites(self, where: Where) -> frozenset[str]:
        """Return that it moves the impedance of its joints to their slides."""
        return impedance_of(self._joints)

    def logged(self, where: Where) -> dict[str, str]:
        """Return the slide that the log shows instead of each joint."""
        return {joint: f"wheels_{joint}_{where.element}" for joint in self._joints}

    def build(self, spec: mujoco.MjSpec, where: Where) -> None:
        """Add a slide and a tendon per joint."""
        for joint, name in self.logged(where).items():
            add_branch(spec, name, joint)

    def set(self, fields: Fields, where: Where, impedance: InterfaceImpedance, values: np.ndarray) -> None:
        """Move the impedance from the joint to its slide, and write the spring between."""
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

    def set(self, fields: Fields, where: Where, impedance: InterfaceImpedance, values: np.ndarray) -> None:
        """Give the spring of each joint a dead band."""
        joints = len(self._joints)
        super().set(fields, where, impedance, values[:, :joints])
        for name, half in zip(self.logged(where).values(), values[:, joints:].T, strict=True):
            band = half[:, None] * np.array([-1.0, 1.0])
            fields["tendon_lengthspring"][:, fields.tendon(name)] += band


# Attributes of a joint that its place in the description sets
_OF_SPEC = ("id", "parent", "frame", "signature", "classname", "compiler", "set_frame")


def _arm(spec: mujoco.MjSpec) -> mujoco.MjsBody:
    """Return the body that the arm's joints move."""
    return spec.joint(ARM_JOINTS[0]).parent


def _carry(spec: mujoco.MjSpec, body: mujoco.MjsBody, carrying: list[dict[str, Any]]) -> None:
    """Add joints with springs and dampers that carry a body with its own joints.

    MuJoCo appends joints, and a later one turns with the earlier ones: the body's own are taken off and put back.
    """
    own = []
    for joint in list(body.joints):
        keys = [key for key in dir(joint) if not key.startswith("_") and key not in _OF_SPEC]
        values = {key: getattr(joint, key) for key in keys}
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
    """Write the stiffness of two joints and the time constant of their dampers, the first three of values (m, p)."""
    for name, stiffness in zip(names, values[:, :2].T, strict=True):
        joint = fields.model.joint(name)
        fields["jnt_stiffness"][:, joint.id] = stiffness
        fields["dof_damping"][:, joint.dofadr[0]] = stiffness * values[:, 2]


class Rocking(Mechanism):
    """The robot rocks on its suspension, unseen by its encoders: the body below the arm turns about the floor.

    Values (m, 4) are stiffness in roll and pitch [Nm/rad], time constant of the damping [s] and inertia of the parts
    that rock beside the arm [kg m2]. The hinges are hidden and carry the arm.
    """

    kinds = ("place", "dissipative")

    def overwrites(self, where: Where) -> frozenset[str]:
        """Return that it carries the arm: a body's six degrees of freedom are those of one carrier and its own."""
        return _CARRIER

    def _names(self, where: Where) -> list[str]:
        return [f"rocking_{axis}_{where.element}" for axis in ("roll", "pitch")]

    def build(self, spec: mujoco.MjSpec, where: Where) -> None:
        """Add two hinges on the floor below the middle of the base."""
        arm = _arm(spec)
        base = np.array([arm.pos[0], arm.pos[1], arm.pos[2] + arm.parent.pos[2]])
        joints = zip(self._names(where), np.eye(3)[:2], strict=True)
        hinge = mujoco.mjtJoint.mjJNT_HINGE
        _carry(
            spec, arm, [{"name": name, "type": hinge, "axis": axis, "pos": -base} for name, axis in joints]
        )

    def set(self, fields: Fields, where: Where, impedance: InterfaceImpedance, values: np.ndarray) -> None:
        """Write springs, dampers and inertia."""
        _set_carrying(fields, self._names(where), values)
        for name in self._names(where):
            fields["dof_armature"][:, fields.model.joint(name).dofadr[0]] = values[:, 3]


class Bending(Mechanism):
    """The column between base and arm bends, unseen by the encoders.

    Values (m, 3) are stiffness along x and y [N/m] and time constant of the damping [s]. The slides are hidden and
    carry the arm.
    """

    kinds = ("place", "dissipative")

    def overwrites(self, where: Where) -> frozenset[str]:
        """Return that it carries the arm: a body's six degrees of freedom are those of one carrier and its own."""
        return _CARRIER

    def _names(self, where: Where) -> list[str]:
        return [f"bending_{axis}_{where.element}" for axis in "xy"]

    def build(self, spec: mujoco.MjSpec, where: Where) -> None:
        """Add two slides that carry the arm."""
        joints = zip(self._names(where), np.eye(3)[:2], strict=True)
        slide = mujoco.mjtJoint.mjJNT_SLIDE
        _carry(spec, _arm(spec), [{"name": name, "type": slide, "axis": axis} for name, axis in joints])

    def set(self, fields: Fields, where: Where, impedance: InterfaceImpedance, values: np.ndarray) -> None:
        """Write springs and dampers."""
        _set_carrying(fields, self._names(where), values)


_RIGID = "a spring as stiff as a time step of 10 ms allows, and no play"

EFFECTS = (
    Effect(
        "base_compliance",
        "robot",
        "the base yields other than configured",
        tuple(
            EffectParameter(f"ln_{what}_{axis}", "1", -3.0, 3.0, (-0.3,), prior_sd=1.0)
            for axis in ("x", "y", "yaw")
            for what in ("stiffness", "damping")
        ),
        separating_trial="the robot's own log, brakes on against brakes off",
        at_rest=AtRest((0.0,) * 6),
        confusable=LOADS,
        group="M",
        scope="whole",
        needs=frozenset({"base"}),
        plant=RobotImpedance(BASE_JOINTS),
    ),
    Effect(
        "base_compliance",
        "robot",
        "a joint of the machine yields other than described",
        tuple(
            EffectParameter(f"ln_{what}", "1", -3.0, 3.0, (-0.3,), prior_sd=1.0)
            for what in ("stiffness", "damping")
        ),
        separating_trial="the machine's own log while its end is pushed, without a person",
        at_rest=AtRest((0.0, 0.0)),
        confusable=LOADS,
        group="M",
        scope="joint",
        needs=frozenset({"controllers"}),
        plant=JointImpedance(),
        form="_joint",
    ),
    Effect(
        "base_compliance",
        "robot",
        "the joints of the machine that no controller holds are damped other than described",
        (EffectParameter("ln_damping", "1", -3.0, 3.0, (-0.3, 0.3), prior_sd=1.0),),
        separating_trial="the machine's own log while its end is pushed, without a person",
        at_rest=AtRest((0.0,)),
        confusable=LOADS,
        group="M",
        scope="whole",
        needs=frozenset({"passive_joints"}),
        plant=PassiveDamping(),
        form="passive",
    ),
    Effect(
        "base_compliance",
        "robot",
        "the base yields behind its servo: springs and dampers in series beside the configured impedance",
        (
            *(
                EffectParameter(f"ln_series_stiffness_{axis}", "1", -5.0, 4.0, (-1.0,), prior_sd=2.0)
                for axis in ("x", "y", "yaw")
            ),
            EffectParameter("time_constant", "s", 0.03, 5.0, (0.3,), log=True),
        ),
        separating_trial="the robot's own log, brakes on against brakes off",
        at_rest=AtRest((-40.0, -40.0, -40.0, 0.3), limit="no stiffness"),
        confusable=LOADS,
        group="M",
        scope="whole",
        needs=frozenset({"base"}),
        plant=RobotRelaxation(BASE_JOINTS),
        form="series",
    ),
    Effect(
        "base_compliance",
        "robot",
        "the base yields beyond its wheels, unseen by their odometry: a spring in series with the configured impedance",
        tuple(
            EffectParameter(f"ln_stiffness_{axis}", "1", -2.0, 4.0, (1.0,), prior_sd=2.0)
            for axis in ("x", "y", "yaw")
        ),
        separating_trial="the robot's own log, brakes on against brakes off",
        at_rest=AtRest((5.0, 5.0, 5.0), tolerance=2e-3, limit=_RIGID),
        confusable=LOADS,
        group="M",
        scope="whole",
        needs=frozenset({"base"}),
        plant=YieldBeyondWheels(BASE_JOINTS),
        form="beyond_wheels",
    ),
    Effect(
        "base_compliance",
        "robot",
        "the base has play beyond its wheels, unseen by their odometry: a spring with a dead band in series",
        (
            *(
                EffectParameter(f"ln_stiffness_{axis}", "1", -1.0, 6.0, (3.0,), prior_sd=3.0)
                for axis in ("x", "y", "yaw")
            ),
            *(
                EffectParameter(f"half_play_{axis}", "m", 2e-4, 0.05, (0.003,), log=True)
                for axis in ("x", "y")
            ),
            EffectParameter("half_play_yaw", "rad", 2e-4, 0.1, (0.006,), log=True),
        ),
        separating_trial="the robot's own log, brakes on against brakes off",
        at_rest=AtRest((5.0, 5.0, 5.0, 1e-6, 1e-6, 1e-6), tolerance=2e-3, limit=_RIGID),
        confusable=LOADS,
        group="M",
        scope="whole",
        needs=frozenset({"base"}),
        plant=SlackBeyondWheels(BASE_JOINTS),
        form="play",
    ),
    Effect(
        "base_compliance",
        "robot",
        "the robot rocks in roll and pitch on its suspension, unseen by its log: springs and dampers at the floor",
        (
            *(
                EffectParameter(f"{axis}_stiffness", "Nm/rad", 50.0, 50_000.0, (600.0,), log=True)
                for axis in ("roll", "pitch")
            ),
            EffectParameter("time_constant", "s", 0.005, 1.0, (0.1,), log=True),
            EffectParameter("inertia", "kg m2", 0.1, 50.0, (3.0,), log=True),
        ),
        separating_trial="the robot's own log, brakes on against brakes off",
        at_rest=AtRest((1e9, 1e9, 1.0, 3.0), tolerance=1e-7, limit="a rigid suspension"),
        confusable=LOADS,
        group="M",
        scope="whole",
        needs=frozenset({"arm", "base"}),
        plant=Rocking(),
        form="rocking",
    ),
    Effect(
        "base_compliance",
        "robot",
        "the column that carries the arm bends along x and y, unseen by the log: springs and dampers below the arm",
        (
            *(
                EffectParameter(f"column_stiffness_{axis}", "N/m", 100.0, 100_000.0, (3_000.0,), log=True)
                for axis in ("x", "y")
            ),
            EffectParameter("time_constant", "s", 0.002, 1.0, (0.03,), log=True),
        ),
        separating_trial="the robot's own log, brakes on against brakes off",
        at_rest=AtRest((1e9, 1e9, 1.0), tolerance=1e-7, limit="a rigid column"),
        confusable=LOADS,
        group="M",
        scope="whole",
        needs=frozenset({"arm"}),
        plant=Bending(),
        form="column",
    ),
)
