"""A joint alone on its chain, whose force along a prescribed path is computed: what of the model moves with it."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import mujoco
import numpy as np

from real2sim.errors import InputError


@dataclass(frozen=True)
class LoneJoint:
    """Bodies that a joint moves, and what each adds to the joint's inertia.

    ``bodies`` (b,) are their indices. Of each, ``by_mass`` (b,) is what a unit of mass adds (1 for a slide; the squared
    distance of its centre from the axis [m^2] for a hinge), and ``by_inertia`` (b, 3) what units of its principal
    inertias add. ``rotor`` is the joint's own inertia, MJCF's armature [kg, kg m^2].
    """

    bodies: np.ndarray
    by_mass: np.ndarray
    by_inertia: np.ndarray
    rotor: float

    def inertia(self, mass: np.ndarray, inertia: np.ndarray) -> np.ndarray:
        """Return the inertia (m,) [kg, kg m^2] along the joint, of all bodies' masses (m, n) and inertias (m, n, 3)."""
        own = np.einsum("mbi,bi->m", inertia[:, self.bodies], self.by_inertia)
        return np.asarray(self.rotor + mass[:, self.bodies] @ self.by_mass + own)


def lone_joint(model: mujoco.MjModel, name: str, rotor: float, source: Path) -> LoneJoint:
    """Return what moves with a joint of a compiled model; ``rotor`` is its own inertia, ``source`` the MJCF.

    Raises
    ------
    InputError
        Naming the file and the joint, where other joints are on its chain: their motion would add to its force.
    """
    joint = model.joint(name)
    body = int(model.jnt_bodyid[joint.id])
    tree = model.body_treeid
    others = [
        model.joint(j).name or f"joint number {j + 1}"
        for j in range(model.njnt)
        if j != joint.id and tree[model.jnt_bodyid[j]] == tree[body]
    ]
    if others:
        raise InputError(
            source,
            f"joint {name}",
            f"an output that is a force, and {', '.join(others)} on the same chain",
            "a driven joint that is alone on its chain, whose force is computed exactly",
            "Weld the other joints for this system, or measure a position instead.",
            "value",
        )
    bodies = np.array([b for b in range(model.nbody) if tree[b] == tree[body]], int)
    if model.jnt_type[joint.id] == mujoco.mjtJoint.mjJNT_SLIDE:
        return LoneJoint(bodies, np.ones(len(bodies)), np.zeros((len(bodies), 3)), rotor)
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    axis, anchor = data.xaxis[joint.id], data.xanchor[joint.id]
    arms = np.cross(axis, data.xipos[bodies] - anchor)
    along = np.einsum("bij,i->bj", data.ximat[bodies].reshape(-1, 3, 3), axis)
    return LoneJoint(bodies, (arms**2).sum(axis=1), along**2, rotor)
