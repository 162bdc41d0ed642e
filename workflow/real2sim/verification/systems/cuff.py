"""Recordings of the thigh cuff (resources/systems/cuff), simulated in four minimal coordinates.

The thigh is prescribed. The cuff moves on it along tx and tz and about rz; the frame and hip joints of the orthosis
follow from the cuff's pose in closed form, and the knee swings freely. See `rigid_tree` and `stepping`.
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

# Thigh frame at the person's hip, x forward, z up along the thigh; markers on its outer side
THIGH_HOME = np.array([0.0, -0.09, 0.90])
THIGH_MARKERS = {
    "THI_A": np.array([-0.05, -0.09, -0.32]),
    "THI_B": np.array([0.07, -0.09, -0.32]),
    "THI_C": np.array([0.0, -0.09, -0.08]),
}
AXES = ("tx", "tz", "rz")
# Interface of the person: middle of what is drawn
STIFFNESS = np.array([3000.0, 2200.0, 8.0])
DAMPING = np.array([40.0, 30.0, 0.15])

EFFECTS = {
    "slack": Size("half_width", 0.004, "m"),
    "coulomb": Size("force", 8.0, "N"),
    "stiffening": Size("cubic", 2e7, "N/m3"),
    "preload": Size("rest_shift", 0.006, "m"),
    "relaxation": Size("stiffness", 1500.0, "N/m"),
    "quadratic_damping": Size("quadratic", 2500.0, "Ns2/m2"),
    "added_mass": Size("mass", 1.5, "kg"),
    "machine_impedance": Size("ln_stiffness", 0.4, "1"),
    "sync_offset": Size("offset", 0.010, "s"),
    "clock_drift": Size("drift", 2e-3, "1"),
    "filter_lag": Size("cutoff", 8.0, "Hz"),
}
# Joints whose stiffness machine_impedance multiplies by exp(size)
CHANGED_JOINTS = ("mount_x", "mount_y", "mount_z")

EXCITATIONS = {
    "quiet": Excitation((0.0012, 0.0012, 0.0004, 0.001, 0.002, 0.001), sway=True),
    "train": Excitation((0.035, 0.030, 0.030, 0.07, 0.40, 0.22), 0.8),
    "held_out": Excitation((0.025, 0.025, 0.020, 0.06, 0.28, 0.16), 1.2),
}

_X, _Z = np.array([1.0, 0.0, 0.0]), np.array([0.0, 0.0, 1.0])


class CuffMechanism:
    """The orthosis behind the thigh; x is (tx, tz, rz, knee) for each trial of the path."""

    names = AXES

    def __init__(self, tree: Tree, path: SegmentPath):
        self.tree, self._path = tree, path
        body = tree.description.bodies[tree.end]
        upright = tree.bodies_at(np.zeros((1, 7)))[1][0, tree.end]
        self._rest = upright - THIGH_HOME
        self._to_hip = -body.origin
        self._mount_home = tree.description.joints[0].offset

    def start(self) -> np.ndarray:
        """Return minimal coordinates (b, 4) at rest."""
        return np.zeros((self._path.position.shape[1], 4))

    def joints_at(self, step: int, x: np.ndarray) -> np.ndarray:
        """Return the machine joints (b, 7) that hold the cuff at x (b, 4) on the thigh."""
        thigh = self._path.rotation[step]
        own = np.zeros((len(x), 3, 3))
        c, s = np.cos(x[:, 2]), np.sin(x[:, 2])
        own[:, 0, 0], own[:, 0, 1], own[:, 1, 0], own[:, 1, 1], own[:, 2, 2] = c, -s, s, c, 1
        r = np.matmul(thigh, own)
        at = self._path.position[step] + turn(thigh, self._place(x))
        y = np.empty((len(x), 7))
        y[:, :3] = at + r @ self._to_hip - self._mount_home
        # r = R_x R_z R_y of abduction, rotation, flexion
        y[:, 3] = np.arctan2(r[:, 2, 1], r[:, 1, 1])
        y[:, 4] = np.arcsin(-r[:, 0, 1])
        y[:, 5] = np.arctan2(r[:, 0, 2], r[:, 0, 0])
        y[:, 6] = x[:, 3]
        return y

    def _place(self, x: np.ndarray) -> np.ndarray:
        place: np.ndarray = self._rest + x[:, :1] * _X + x[:, 1:2] * _Z
        return place

    def state(self, step: int, x: np.ndarray, rate: np.ndarray) -> State:
        """Return the state at minimal coordinates and rates (b, 4) [m, rad; m/s, rad/s], see `stepping.Mechanism`."""
        path, b = self._path, len(x)
        thigh, omega = path.rotation[step], path.omega[step]
        u, w = thigh[:, :, 0], thigh[:, :, 2]
        arm = turn(thigh, self._place(x))
        slip = u * rate[:, :1] + w * rate[:, 1:2]
        swing = cross(omega, arm)
        imposed = np.concatenate([path.velocity[step] + swing, omega], axis=1)
        bias = np.concatenate(
            [
                path.acceleration[step] + cross(path.alpha[step], arm) + cross(omega, swing + 2 * slip),
                path.alpha[step] + cross(omega, w) * rate[:, 2:3],
            ],
            axis=1,
        )
        free = np.zeros((b, 6, 3))
        free[:, :3, 0], free[:, :3, 1], free[:, 3:, 2] = u, w, w
        y = self.joints_at(step, x)
        upstream = self._upstream(y)
        solved = np.linalg.solve(upstream, np.concatenate([free, imposed[:, :, None]], axis=2))
        reduction, carried = np.zeros((b, 7, 4)), np.zeros((b, 7))
        reduction[:, :6, :3], carried[:, :6] = solved[:, :, :3], solved[:, :, 3]
        reduction[:, 6, 3] = 1
        y_rate = np.matmul(reduction, rate[:, :, None])[:, :, 0] + carried
        motion = self.tree.move(y, y_rate)
        missing = bias - np.concatenate([motion.linear_bias, motion.angular_bias], axis=1)
        reduction_bias = np.zeros((b, 7))
        reduction_bias[:, :6] = np.linalg.solve(upstream, missing[:, :, None])[:, :, 0]
        interface = np.zeros((b, 3, 4))
        interface[:, range(3), range(3)] = 1
        return State(y, motion, reduction, carried, reduction_bias, x[:, :3], interface, np.zeros((b, 3)))

    def _upstream(self, y: np.ndarray) -> np.ndarray:
        """Return velocity of the cuff's origin and its angular velocity per rate of the first six joints (b, 6, 6)."""
        sa, ca, sr, cr = np.sin(y[:, 3]), np.cos(y[:, 3]), np.sin(y[:, 4]), np.cos(y[:, 4])
        sf, cf = np.sin(y[:, 5]), np.cos(y[:, 5])
        zero = np.zeros_like(sa)
        axes = np.stack(
            [
                np.stack([zero + 1, zero, zero], axis=1),
                np.stack([zero, -sa, ca], axis=1),
                np.stack([-sr, ca * cr, sa * cr], axis=1),
            ],
            axis=1,
        )
        # the columns of R_x R_z R_y
        first = np.stack([cr * cf, ca * sr * cf + sa * sf, sa * sr * cf - ca * sf], axis=1)
        third = np.stack([cr * sf, ca * sr * sf - sa * cf, sa * sr * sf + ca * cf], axis=1)
        px, py, pz = -self._to_hip
        arm = px * first + py * axes[:, 2] + pz * third
        out = np.zeros((len(y), 6, 6))
        out[:, range(3), range(3)] = 1
        out[:, :3, 3:] = cross(axes, arm[:, None]).swapaxes(1, 2)
        out[:, 3:, 3:] = axes.swapaxes(1, 2)
        return out


def describe() -> tuple[System, Tree]:
    """Return the description and the tree of the shipped system."""
    system = System.from_yaml(shipped("cuff") / "system.yaml")
    return system, Tree(Description.read(system.model), "cuff")


def setup_of(system: System, tree: Tree, seed: int) -> pose_driven.Setup:
    """Return what is simulated for a seed."""
    return pose_driven.Setup(
        system,
        tree,
        CuffMechanism,
        pose_driven.draw_interface(STIFFNESS, DAMPING, seed),
        EXCITATIONS,
        THIGH_HOME,
        THIGH_MARKERS,
        EFFECTS,
        CHANGED_JOINTS,
    )


def simulate(
    effect: str | None,
    size: float,
    seed: int,
    out: Path,
    *,
    axis: str = "tz",
    duration_s: float = 12.0,
) -> Path:
    """Write the recordings of a thigh cuff with an effect of `EFFECTS` or with none; return ``out``.

    ``axis`` is the interface coordinate of an effect of the interface; ``size`` has its unit there (Nm/rad for rz
    where N/m stands). Interface, path and noise follow from ``seed``; ``duration_s`` is that of train and held_out.
    """
    return pose_driven.simulate(setup_of(*describe(), seed), effect, size, seed, out, axis, duration_s)
