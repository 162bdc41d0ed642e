"""Soft tissue: pelvis markers that move over the bone."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation

from real2sim.effects.base import AtRest, Effect, EffectParameter, near_zero
from real2sim.effects.chains import Chains, Context
from real2sim.geometry import cardan_angles, rotation_xyz

# Most Newton iterations in which the bone's angles are found whose skin shows the measured ones, and the correction
# [rad] after which there is none: far below what a marker shows
_BONE_ROUNDS, _FOUND = 6, 1e-12


def soft_tissue(values: np.ndarray, context: Context) -> tuple[np.ndarray, np.ndarray]:
    """Return the path (n, 3, 3), (n, 3) of the bone under the skin, values (18,).

    Each marker moves over the bone in proportion to the bone's Cardan angles. How markers move against each other is
    seen (`MarkerShapes.by_turn`); ``values`` say how they move together: 9 of their centre [m/rad], 9 of their turn as
    a least-squares fit of small turns sees it [rad/rad].
    """
    start = context.pelvis_rotation[0]
    shift, turn = values[:9].reshape(3, 3), values[9:].reshape(3, 3)
    seen = start.T @ context.pelvis_rotation
    angles = cardan_angles(seen)
    places = context.shapes.places(angles)
    centres = places.mean(axis=1)
    first = places[0] - centres[0]
    # sums over the markers of where they are seen, from their centre, times where they were first
    moments = np.einsum("nki,kj->nij", places - centres[:, None], first)
    if np.linalg.matrix_rank(first) < 2:
        # markers on a line, or none: as if there were as many in every direction
        moments = np.broadcast_to(np.eye(3), moments.shape)
    turn = (np.trace(moments[0]) * np.eye(3) - moments[0]) @ turn
    # a bone that is turned far is sought from where the skin is
    for _ in range(_BONE_ROUNDS):
        on_bone = _from_cardan(angles).swapaxes(1, 2) @ seen @ moments
        rest = _antisymmetric(on_bone) - angles @ turn.T
        along = np.trace(on_bone, axis1=1, axis2=2)[:, None, None] * np.eye(3)
        slope = (along - on_bone) @ _cardan_slope(angles) + turn
        correction = np.linalg.solve(slope, rest[..., None])[..., 0]
        angles = angles + correction
        if np.abs(correction).max() < _FOUND:
            break
    rotation = start @ _from_cardan(angles)
    centre = context.pelvis_position + np.einsum("nij,nj->ni", context.pelvis_rotation, centres)
    return rotation, centre - np.einsum("nij,nj->ni", rotation, centres[0] + angles @ shift.T)


def wobbling_tissue(values: np.ndarray, context: Context) -> tuple[np.ndarray, np.ndarray]:
    """Return the path of the bone under skin that rings, values (20,): of `soft_tissue`, lag [s], mobility [s^2].

    Skin on a spring and a damper follows the bone as a mass does: its own pose, plus its rate times the lag, plus its
    acceleration times the mobility (one over the square of its angular frequency) is its pose without mass.
    """
    start = context.pelvis_rotation[0]
    turn = Rotation.from_matrix(start.T @ context.pelvis_rotation).as_rotvec()
    path = CubicSpline(context.time_s, np.hstack([context.pelvis_position, turn]))
    still = path(context.time_s[0], 1)
    bone = path(context.time_s) + values[18] * (path(context.time_s, 1) - still)
    bone += values[19] * path(context.time_s, 2)
    rotation = start @ Rotation.from_rotvec(bone[:, 3:]).as_matrix()
    return soft_tissue(values[:18], replace(context, pelvis_rotation=rotation, pelvis_position=bone[:, :3]))


def _from_cardan(angles: np.ndarray) -> np.ndarray:
    """Return rotations R_z R_y R_x (n, 3, 3) of Cardan angles (n, 3) [rad] about x, y, z."""
    # the inverse turns back in the other order
    return rotation_xyz(-angles).swapaxes(1, 2)


def _cardan_slope(angles: np.ndarray) -> np.ndarray:
    """Return the turn about its own axes that a change of each of the Cardan angles (n, 3) makes, (n, 3, 3)."""
    (sx, sy), (cx, cy) = np.sin(angles[:, :2].T), np.cos(angles[:, :2].T)
    zero = np.zeros(len(angles))
    rows = [[zero + 1, zero, -sy], [zero, cx, cy * sx], [zero, -sx, cy * cx]]
    return np.moveaxis(np.array(rows), 2, 0)


def _antisymmetric(products: np.ndarray) -> np.ndarray:
    """Return the vectors (n, 3) whose cross products are the antisymmetric parts, times two, of (n, 3, 3)."""
    return np.asarray(products[:, [2, 0, 1], [1, 2, 0]] - products[:, [1, 2, 0], [2, 0, 1]])


_SKIN = (
    *(near_zero(f"shift_{a}_by_r{b}", "m/rad", 0.03, 0.3) for a in "xyz" for b in "xyz"),
    *(near_zero(f"turn_{a}_by_r{b}", "rad/rad", 0.1, 1.5) for a in "xyz" for b in "xyz"),
)
_BONE = (
    "let x be the markers' places from their centre at the start, in the bone's axes, and y where they are seen; solve"
    " sum(cross(x, y)) = J turn v with J = sum(|x|^2 - x x^T) for the Cardan angles v of the bone from the start"
    " (Newton); the bone is turned by B = R0 R_z R_y R_x(v), R0 the pelvis' rotation at the start, and the markers'"
    " centre has moved over it by shift v"
)

EFFECTS = (
    Effect(
        "soft_tissue",
        "input",
        "each pelvis marker moves over the bone in proportion to its Cardan angles (x, y, z of R_z R_y R_x) from the"
        " start; how markers move against each other is seen, how they move together is fitted",
        _SKIN,
        separating_trial="a marker cluster beside the pelvis markers, quiet standing and a passive pull",
        at_rest=AtRest((0.0,) * 18),
        group="V",
        scope="whole",
        needs=frozenset({"pose"}),
        chains=Chains(input=soft_tissue, kinds=("turned segment",)),
        remedy=f"Correct the pelvis before it is replayed: {_BONE}",
    ),
    Effect(
        "soft_tissue",
        "input",
        "pelvis markers move over the bone in proportion to its Cardan angles, and follow it as masses on springs do",
        (
            *_SKIN,
            near_zero("lag", "s", 0.01, 0.1),
            # skin rings at 1 to 4 Hz; the low-pass of the path removes faster ringing
            EffectParameter("mobility", "s2", 0.0016, 0.025, (0.004,)),
        ),
        separating_trial="a marker cluster beside the pelvis markers, quiet standing and a passive pull",
        at_rest=AtRest((0.0,) * 20, limit="skin without mass"),
        group="V",
        scope="whole",
        needs=frozenset({"pose"}),
        chains=Chains(input=wobbling_tissue, kinds=("turned segment", "trailing segment")),
        form="wobble",
        remedy=(
            "Correct the pelvis before it is replayed: add to its pose the lag times its rate and the mobility times"
            f" its acceleration, and then: {_BONE}"
        ),
    ),
)
