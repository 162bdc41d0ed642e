"""Dynamics of a tree of rigid bodies by Newton and Euler, in batches, without MuJoCo.

The tree is read from an MJCF of a plain kind: bodies without turned frames, slides and hinges through the origin of
their body, inertia given by mass, centre and principal moments along the axes of the body. Arrays have one row per
simulation, of which there are b; the tree has n joints and m bodies.
"""

from __future__ import annotations

import xml.etree.ElementTree as ET
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

_EYE = np.eye(3)


def cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return a x b (..., 3)."""
    ax, ay, az, bx, by, bz = a[..., 0], a[..., 1], a[..., 2], b[..., 0], b[..., 1], b[..., 2]
    first = ay * bz
    out = np.empty((*first.shape, 3))
    np.subtract(first, az * by, out=out[..., 0])
    np.subtract(az * bx, ax * bz, out=out[..., 1])
    np.subtract(ax * by, ay * bx, out=out[..., 2])
    return out


def turn(rotation: np.ndarray, vector: np.ndarray) -> np.ndarray:
    """Return rotations (..., 3, 3) times vectors (..., 3)."""
    turned: np.ndarray = np.matmul(rotation, vector[..., None])[..., 0]
    return turned


def _numbers(text: str | None, size: int) -> np.ndarray:
    return np.array(text.split(), float) if text else np.zeros(size)


@dataclass
class Joint:
    """A slide or hinge with ``axis`` (3,), ``offset`` (3,) [m] from joint ``parent`` (index, -1: world)."""

    name: str
    parent: int
    offset: np.ndarray
    axis: np.ndarray
    hinge: bool
    armature: float
    damping: float
    friction: float


@dataclass
class Body:
    """A rigid body on ``joint`` (index): origin, centre (3,) [m] in its frame, mass [kg], moments (3,) [kg m^2]."""

    name: str
    joint: int
    origin: np.ndarray
    centre: np.ndarray
    mass: float
    moments: np.ndarray


@dataclass
class Description:
    """Joints and bodies of an MJCF, and its sites: body index and place (3,) [m] in the body."""

    joints: list[Joint] = field(default_factory=list)
    bodies: list[Body] = field(default_factory=list)
    sites: dict[str, tuple[int, np.ndarray]] = field(default_factory=dict)

    @classmethod
    def read(cls, path: Path) -> Description:
        """Read the MJCF at ``path``."""
        out = cls()
        root = ET.parse(path).getroot().find("worldbody")
        for body in root.findall("body") if root is not None else []:
            out._add(body, -1, np.zeros(3))
        return out

    def _add(self, body: ET.Element, joint: int, offset: np.ndarray) -> None:
        if {"quat", "euler", "axisangle"} & set(body.attrib):
            raise ValueError(f"body {body.get('name')} has a turned frame")
        origin = offset + _numbers(body.get("pos"), 3)
        for j in body.findall("joint"):
            self.joints.append(
                Joint(
                    j.get("name", ""),
                    joint,
                    origin,
                    _numbers(j.get("axis"), 3),
                    j.get("type") == "hinge",
                    float(j.get("armature", 0)),
                    float(j.get("damping", 0)),
                    float(j.get("frictionloss", 0)),
                )
            )
            joint, origin = len(self.joints) - 1, np.zeros(3)
        inertial = body.find("inertial")
        if inertial is None:
            raise ValueError(f"body {body.get('name')} has no inertial")
        self.bodies.append(
            Body(
                body.get("name", ""),
                joint,
                origin,
                _numbers(inertial.get("pos"), 3),
                float(inertial.get("mass", 0)),
                _numbers(inertial.get("diaginertia"), 3),
            )
        )
        index = len(self.bodies) - 1
        for site in body.findall("site"):
            self.sites[site.get("name", "")] = (index, _numbers(site.get("pos"), 3))
        for child in body.findall("body"):
            self._add(child, joint, origin)

    def body(self, name: str) -> int:
        """Index of a body."""
        return [b.name for b in self.bodies].index(name)

    def joint(self, name: str) -> int:
        """Index of a joint."""
        return [j.name for j in self.joints].index(name)


@dataclass
class Motion:
    """Pose and motion of the tree at y (b, n) and its rate, and the forces that it takes.

    ``rotation`` (b, m, 3, 3) and ``origin`` (b, m, 3) [m] of the bodies; ``linear``, ``angular`` (b, 3, n): velocity of
    the origin, and angular velocity, of body `Tree.end` per joint rate; ``linear_bias``, ``angular_bias`` (b, 3): its
    accelerations at zero joint accelerations; ``inertia`` (b, n, n) and ``bias`` (b, n): joint forces are
    inertia y'' + bias.
    """

    rotation: np.ndarray
    origin: np.ndarray
    linear: np.ndarray
    angular: np.ndarray
    linear_bias: np.ndarray
    angular_bias: np.ndarray
    inertia: np.ndarray
    bias: np.ndarray


class Tree:
    """Equations of motion of a `Description`; ``end`` is the body whose motion is asked for."""

    def __init__(self, description: Description, end: str):
        self.description, self.end = description, description.body(end)
        joints, bodies = description.joints, description.bodies
        self._n = len(joints)
        self._hinge = np.array([j.hinge for j in joints])
        self.armature = np.array([j.armature for j in joints])
        self.damping = np.array([j.damping for j in joints])
        self.friction = np.array([j.friction for j in joints])
        self._skew = [_skew(j.axis) for j in joints]
        # which joints move a joint's anchor (those before it) and a body
        before = np.zeros((self._n, self._n))
        for i, joint in enumerate(joints):
            if joint.parent >= 0:
                before[i] = before[joint.parent]
                before[i, joint.parent] = 1
        carried = np.array([before[b.joint] + np.eye(self._n)[b.joint] for b in bodies])
        self._before = before * self._hinge
        self._carried = carried * self._hinge
        self._on = np.array([b.joint for b in bodies])
        self._places = np.array([b.origin for b in bodies])
        self._centres = np.array([b.origin + b.centre for b in bodies])
        # points: centres of the bodies, anchors of the joints, origin of the end
        moves = np.vstack([carried, before, carried[self.end : self.end + 1]])[:, :, None]
        self._turns = np.flatnonzero(self._hinge)
        self._moves = moves
        self._moves_turned = moves[:, self._turns]
        self._root_mass = np.sqrt([b.mass for b in bodies])
        self._moments = np.array([b.moments for b in bodies])
        self._root_moments = np.sqrt(self._moments)

    def add_mass(self, body: str, mass: float, moment: float) -> None:
        """Add mass [kg] at the centre of a body, and to each of its moments of inertia [kg m^2]."""
        i = self.description.body(body)
        self._root_mass[i] = np.sqrt(self._root_mass[i] ** 2 + mass)
        self._moments[i] += moment
        self._root_moments = np.sqrt(self._moments)

    def place(self, y: np.ndarray) -> tuple[list[np.ndarray], list[np.ndarray], np.ndarray]:
        """Return rotation (b, 3, 3) and anchor (b, 3) behind each joint, and the axes (b, n, 3), in the world."""
        joints = self.description.joints
        sine, cosine = np.sin(y), 1 - np.cos(y)
        rotations: list[np.ndarray] = []
        anchors: list[np.ndarray] = []
        axes = np.empty((len(y), self._n, 3))
        world = np.zeros((len(y), 3, 3)) + _EYE
        for i, joint in enumerate(joints):
            if joint.parent < 0:
                r, p = world, joint.offset
            else:
                r = rotations[joint.parent]
                p = anchors[joint.parent]
                if joint.offset.any():
                    p = p + r @ joint.offset
            axes[:, i] = r @ joint.axis
            if joint.hinge:
                k, k2 = self._skew[i]
                own = _EYE + sine[:, i, None, None] * k + cosine[:, i, None, None] * k2
                r = np.matmul(r, own)
            else:
                p = p + axes[:, i] * y[:, i, None]
            rotations.append(r)
            anchors.append(p)
        if len(self._hinge) and self._hinge[0]:
            anchors[0] = np.zeros((len(y), 3)) + anchors[0]
        return rotations, anchors, axes

    def bodies_at(self, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return rotation (b, m, 3, 3) and origin (b, m, 3) [m] of the bodies."""
        rotations, anchors, _ = self.place(y)
        rotation = np.stack([rotations[i] for i in self._on], axis=1)
        anchor = np.stack([anchors[i] for i in self._on], axis=1)
        return rotation, anchor + turn(rotation, self._places)

    def move(self, y: np.ndarray, rate: np.ndarray) -> Motion:
        """Return the `Motion` at joint positions and rates (b, n)."""
        rotations, anchor_list, axes = self.place(y)
        rotation = np.stack([rotations[i] for i in self._on], axis=1)
        anchors = np.stack(anchor_list, axis=1)
        on = anchors[:, self._on]
        centres = on + turn(rotation, self._centres)
        origins = on + turn(rotation, self._places)
        points = np.concatenate([centres, anchors, origins[:, self.end : self.end + 1]], axis=1)
        # velocity of each point per joint rate, (b, points, n, 3)
        turns = self._turns
        hinge_axes, arms = axes[:, None, turns], points[:, :, None] - anchors[:, None, turns]
        per_rate = axes[:, None] * self._moves
        per_rate[:, :, turns] = cross(hinge_axes, arms) * self._moves_turned
        spun = axes * rate[:, :, None]
        velocity = np.sum(per_rate * rate[:, None, :, None], axis=2)
        omega_before = np.matmul(self._before, spun)
        omega = np.matmul(self._carried, spun)
        # accelerations at zero joint accelerations
        axes_rate = cross(omega_before, axes) * rate[:, :, None]
        m = len(self._on)
        relative = velocity[:, :, None] - velocity[:, None, m + turns]
        swing = cross(axes_rate[:, None, turns], arms) + cross(spun[:, None, turns], relative)
        accelerations = axes_rate[:, None] * self._moves
        accelerations[:, :, turns] = swing * self._moves_turned
        acceleration = accelerations.sum(axis=2)
        alpha = np.matmul(self._carried, axes_rate)
        return self._dynamics(rotation, origins, axes, per_rate, acceleration, omega, alpha)

    def _dynamics(
        self,
        rotation: np.ndarray,
        origins: np.ndarray,
        axes: np.ndarray,
        per_rate: np.ndarray,
        acceleration: np.ndarray,
        omega: np.ndarray,
        alpha: np.ndarray,
    ) -> Motion:
        b, m = rotation.shape[:2]
        back = rotation.swapaxes(-1, -2)
        turning = self._carried[:, :, None] * axes[:, None]  # (b, m, n, 3)
        local = np.matmul(turning, rotation)  # angular velocity in the body's frame per joint rate
        omega_local, alpha_local = turn(back, omega), turn(back, alpha)
        gyroscopic = cross(omega_local, self._moments * omega_local)
        torque = self._moments * alpha_local + gyroscopic
        rows = np.concatenate(
            [
                (per_rate[:, :m] * self._root_mass[:, None, None]).swapaxes(2, 3),
                (local * self._root_moments[:, None]).swapaxes(2, 3),
            ],
            axis=1,
        ).reshape(b, 6 * m, self._n)
        loads = np.concatenate(
            [acceleration[:, :m] * self._root_mass[:, None], torque / self._root_moments], axis=1
        ).reshape(b, 6 * m)
        inertia = np.matmul(rows.swapaxes(1, 2), rows)
        inertia[:, range(self._n), range(self._n)] += self.armature
        return Motion(
            rotation,
            origins,
            per_rate[:, -1].swapaxes(1, 2),
            turning[:, self.end].swapaxes(1, 2),
            acceleration[:, -1],
            alpha[:, self.end],
            inertia,
            np.matmul(rows.swapaxes(1, 2), loads[:, :, None])[:, :, 0],
        )


def _skew(axis: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    x, y, z = axis
    k = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return k, k @ k
