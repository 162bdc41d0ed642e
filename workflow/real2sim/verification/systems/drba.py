"""Recordings of the strap on the study's robot (resources/systems/drba), simulated in five minimal coordinates.

The pelvis is prescribed. Minimal coordinates are yaw and path of the base and the three hinges of the left chain of
the arm; the right chain follows in closed form, and the strap's six coordinates from the poses of pelvis and interface.
See `rigid_tree` and `stepping`.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from real2sim.system.description import System, shipped
from real2sim.verification.systems import pose_driven
from real2sim.verification.systems.recordings import Size
from real2sim.verification.systems.rigid_tree import Description, Tree, cross, turn
from real2sim.verification.systems.segment_path import Excitation, SegmentPath
from real2sim.verification.systems.stepping import State

# Pelvis frame: origin between the ASIS, x forward, z up; the interface rests behind and below it
PELVIS_HOME = np.array([0.53, 0.0, 1.00])
PELVIS_MARKERS = {
    "ASIS_L": np.array([0.0, 0.125, 0.0]),
    "ASIS_R": np.array([0.0, -0.125, 0.0]),
    "PSIS_L": np.array([-0.15, 0.045, 0.0]),
    "PSIS_R": np.array([-0.15, -0.045, 0.0]),
}
AXES = ("tx", "ty", "tz", "rx", "ry", "rz")
# Strap of the person: middle of what is drawn
STIFFNESS = np.array([1500.0, 1200.0, 2500.0, 70.0, 70.0, 60.0])
DAMPING = np.array([60.0, 50.0, 60.0, 2.0, 2.0, 2.0])

EFFECTS = {
    "slack": Size("half_width", 0.006, "m"),
    "coulomb": Size("force", 8.0, "N"),
    "stiffening": Size("cubic", 3e6, "N/m3"),
    "preload": Size("rest_shift", 0.008, "m"),
    "relaxation": Size("stiffness", 1200.0, "N/m"),
    "quadratic_damping": Size("quadratic", 1500.0, "Ns2/m2"),
    "added_mass": Size("mass", 4.0, "kg"),
    "machine_impedance": Size("ln_damping", 0.8, "1"),
    "sync_offset": Size("offset", 0.010, "s"),
    "clock_drift": Size("drift", 2e-3, "1"),
    "filter_lag": Size("cutoff", 8.0, "Hz"),
}
# Passive joints whose damping machine_impedance multiplies by exp(size); the held base is too stiff to show a change
CHANGED_JOINTS = tuple(f"arm_{side}_{i}" for side in ("left", "right") for i in (1, 2, 3))

EXCITATIONS = {
    # so small that the dry friction of the arm holds the interface still
    "quiet": Excitation((0.0006, 0.0006, 0.0004, 0.001, 0.001, 0.0005), sway=True),
    "train": Excitation((0.050, 0.035, 0.015, 0.07, 0.07, 0.16), 0.8),
    "held_out": Excitation((0.040, 0.028, 0.010, 0.05, 0.05, 0.12), 1.15),
}

_LEFT, _RIGHT = slice(2, 5), slice(5, 8)


class DrbaMechanism:
    """The robot behind the pelvis; x is (base_yaw, base_forward, arm_left_1, 2, 3) for each trial of the path."""

    names = AXES

    def __init__(self, tree: Tree, path: SegmentPath):
        self.tree, self._path = tree, path
        description = tree.description
        joints = description.joints
        left, right = (
            [description.joint(f"arm_{side}_{i}") for i in (1, 2, 3)] for side in ("left", "right")
        )
        to = tree.description.bodies[tree.end].origin[:2]
        # vectors in the plane from hinge to hinge at zero angles, and from the last hinge to the interface's origin
        self._links = [np.array([joints[i].offset[:2] for i in chain]) for chain in (left, right)]
        interface = self._links[0].sum(axis=0) + to
        self._ends = [to, interface - self._links[1].sum(axis=0)]
        self._lengths = np.linalg.norm(self._links[1][1:], axis=1)
        self._angles = np.arctan2(self._links[1][1:, 1], self._links[1][1:, 0])
        self._rest = tree.bodies_at(np.zeros((1, 8)))[1][0, tree.end] - PELVIS_HOME

    def start(self) -> np.ndarray:
        """Return minimal coordinates (b, 5) at rest."""
        return np.zeros((self._path.position.shape[1], 5))

    def joints_at(self, step: int, x: np.ndarray) -> np.ndarray:
        """Return the machine joints (b, 8) at x (b, 5)."""
        y = np.zeros((len(x), 8))
        y[:, :5] = x
        angle, _, points = self._chain(0, x[:, 2:])
        # hinge of the right chain at the interface, in the base's plane
        target = points[:, 3] - _turned(angle[:, 2], self._ends[1])
        y[:, _RIGHT] = self._reach(target, angle[:, 2])
        return y

    def _reach(self, target: np.ndarray, yaw: np.ndarray) -> np.ndarray:
        """Return the hinge angles (b, 3) of the right chain that put its last hinge at a point and turn it by yaw."""
        a, b = self._lengths
        to = target - self._links[1][0]
        d = np.hypot(to[:, 0], to[:, 1])
        inner = np.arccos((a * a + d * d - b * b) / (2 * a * d))
        # the right elbow is outside, to the right of the line from hinge to hinge
        first = np.arctan2(to[:, 1], to[:, 0]) - inner
        elbow = self._links[1][0] + a * np.stack([np.cos(first), np.sin(first)], axis=1)
        rest = target - elbow
        second = np.arctan2(rest[:, 1], rest[:, 0])
        one, two = first - self._angles[0], second - self._angles[1]
        return np.stack([one, two - one, yaw - two], axis=1)

    def _chain(self, side: int, hinges: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return angles (b, 3) of the links, vectors (b, 3, 2) along them, points (b, 4, 2): hinges and interface."""
        angle = np.cumsum(hinges, axis=1)
        links, end = self._links[side], self._ends[side]
        vectors = np.stack(
            [_turned(angle[:, 0], links[1]), _turned(angle[:, 1], links[2]), _turned(angle[:, 2], end)],
            axis=1,
        )
        points = links[0] + np.concatenate(
            [np.zeros((len(hinges), 1, 2)), np.cumsum(vectors, axis=1)], axis=1
        )
        return angle, vectors, points

    def _closure(self, side: int, hinges: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the interface's motion (x, y, yaw) per hinge rate (b, 3, 3), vectors and angles of the links."""
        angle, vectors, points = self._chain(side, hinges)
        arms = points[:, 3:] - points[:, :3]
        out = np.ones((len(hinges), 3, 3))
        out[:, 0], out[:, 1] = -arms[:, :, 1], arms[:, :, 0]
        return out, vectors, angle

    def state(self, step: int, x: np.ndarray, rate: np.ndarray) -> State:
        """Return the state at minimal coordinates and rates (b, 5) [m, rad; m/s, rad/s], see `stepping.Mechanism`."""
        b = len(x)
        y = self.joints_at(step, x)
        left, vectors_left, _ = self._closure(0, y[:, _LEFT])
        right, vectors_right, _ = self._closure(1, y[:, _RIGHT])
        coupled = np.linalg.solve(right, left)
        reduction = np.zeros((b, 8, 5))
        reduction[:, range(5), range(5)] = 1
        reduction[:, _RIGHT, 2:] = coupled
        y_rate = np.matmul(reduction, rate[:, :, None])[:, :, 0]
        # both ends have one acceleration: centripetal parts of the links differ
        pull = _centripetal(vectors_right, y_rate[:, _RIGHT]) - _centripetal(vectors_left, y_rate[:, _LEFT])
        reduction_bias = np.zeros((b, 8))
        reduction_bias[:, _RIGHT] = np.linalg.solve(right, pull[:, :, None])[:, :, 0]
        motion = self.tree.move(y, y_rate)
        q, per_twist, carried = self._strap(
            step, motion.rotation[:, self.tree.end], motion.origin[:, self.tree.end]
        )
        twist = np.matmul(np.concatenate([motion.linear, motion.angular], axis=1), reduction)
        interface = np.matmul(per_twist, twist)
        return State(y, motion, reduction, np.zeros((b, 8)), reduction_bias, q, interface, carried)

    def _strap(
        self, step: int, rotation: np.ndarray, origin: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return q (b, 6), its rates per linear and angular velocity of the interface (b, 6, 6), and the pelvis' part.

        Slides along the pelvis' axes, then hinges x, y, z: the interface is turned by R_x R_y R_z in the pelvis.
        """
        path, b = self._path, len(origin)
        pelvis, omega = path.rotation[step], path.omega[step]
        back = pelvis.swapaxes(1, 2)
        arm = origin - path.position[step]
        r = np.matmul(back, rotation)
        q = np.empty((b, 6))
        q[:, :3] = turn(back, arm) - self._rest
        q[:, 3] = np.arctan2(-r[:, 1, 2], r[:, 2, 2])
        q[:, 4] = np.arcsin(r[:, 0, 2])
        q[:, 5] = np.arctan2(-r[:, 0, 1], r[:, 0, 0])
        # angular velocity in the pelvis is E times the rates of the hinges
        sx, cx, sy, cy = np.sin(q[:, 3]), np.cos(q[:, 3]), np.sin(q[:, 4]), np.cos(q[:, 4])
        e = np.zeros((b, 3, 3))
        e[:, 0, 0], e[:, 0, 2] = 1, sy
        e[:, 1, 1], e[:, 1, 2] = cx, -sx * cy
        e[:, 2, 1], e[:, 2, 2] = sx, cx * cy
        per_twist = np.zeros((b, 6, 6))
        per_twist[:, :3, :3] = back
        per_twist[:, 3:, 3:] = np.linalg.solve(e, back)
        imposed = np.concatenate([path.velocity[step] + cross(omega, arm), omega], axis=1)
        return q, per_twist, -np.matmul(per_twist, imposed[:, :, None])[:, :, 0]


def _turned(angle: np.ndarray, vector: np.ndarray) -> np.ndarray:
    """Return a vector (2,) turned by angles (b,), (b, 2)."""
    c, s = np.cos(angle), np.sin(angle)
    return np.stack([c * vector[0] - s * vector[1], s * vector[0] + c * vector[1]], axis=1)


def _centripetal(vectors: np.ndarray, rates: np.ndarray) -> np.ndarray:
    """Return the pull towards the axes (b, 3: x, y, and 0) at the end of a chain of links with hinge rates (b, 3)."""
    spin = np.cumsum(rates, axis=1)
    out = np.zeros((len(rates), 3))
    out[:, :2] = np.sum(spin[:, :, None] ** 2 * vectors, axis=1)
    return out


def describe() -> tuple[System, Tree]:
    """Return the description and the tree of the shipped system."""
    system = System.from_yaml(shipped("drba") / "system.yaml")
    return system, Tree(Description.read(system.model), "interface")


def setup_of(system: System, tree: Tree, seed: int) -> pose_driven.Setup:
    """Return what is simulated for a seed."""
    return pose_driven.Setup(
        system,
        tree,
        DrbaMechanism,
        pose_driven.draw_interface(STIFFNESS, DAMPING, seed),
        EXCITATIONS,
        PELVIS_HOME,
        PELVIS_MARKERS,
        EFFECTS,
        CHANGED_JOINTS,
    )


def simulate(
    effect: str | None,
    size: float,
    seed: int,
    out: Path,
    *,
    axis: str = "tx",
    duration_s: float = 12.0,
) -> Path:
    """Write the recordings of a strap with an effect of `EFFECTS` or with none; return ``out``.

    ``axis`` is the interface coordinate of an effect of the interface; ``size`` has its unit there (Nm/rad for rz
    where N/m stands). Strap, path and noise follow from ``seed``; ``duration_s`` is that of train and held_out.
    """
    return pose_driven.simulate(setup_of(*describe(), seed), effect, size, seed, out, axis, duration_s)
