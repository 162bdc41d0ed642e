"""Frames of pelvis and interface, and the interface coordinates q between them.

World: x forward, y left, z up. All rotations are (..., 3, 3) matrices whose columns are the axes in the world.
"""

from __future__ import annotations

import numpy as np

AXES = ("tx", "ty", "tz", "rx", "ry", "rz")
PELVIS_MARKERS = ("ASIS_L", "ASIS_R", "PSIS_L", "PSIS_R")
INTERFACE_MARKERS = ("IF_L", "IF_R")


def _unit(v: np.ndarray) -> np.ndarray:
    return np.asarray(v / np.linalg.norm(v, axis=-1, keepdims=True))


def pelvis_frame(
    asis_l: np.ndarray, asis_r: np.ndarray, psis_l: np.ndarray, psis_r: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return the pelvis frame P of four markers: origin mid-ASIS, y to the left, x forward in the ASIS-PSIS plane.

    Parameters are (..., 3) [m]; returns rotation (..., 3, 3) and origin (..., 3) [m]. NaN in, NaN out.
    """
    origin = (asis_l + asis_r) / 2
    y = _unit(asis_l - asis_r)
    forward = origin - (psis_l + psis_r) / 2
    x = _unit(forward - np.sum(forward * y, axis=-1, keepdims=True) * y)
    return np.stack([x, y, np.cross(x, y)], axis=-1), origin


def interface_frame(
    if_l: np.ndarray, if_r: np.ndarray, z_ref: np.ndarray | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """Return the interface frame I of its two joint centres: origin the midpoint, y to the left.

    ``z_ref`` (3,) or (..., 3) is the arm's up axis from the robot log, world z without one: rotation about y is
    not observable from two points on the y axis. Returns rotation (..., 3, 3) and origin (..., 3) [m].
    """
    y = _unit(if_l - if_r)
    z = np.array([0.0, 0.0, 1.0]) if z_ref is None else z_ref
    x = _unit(np.cross(y, np.broadcast_to(z, y.shape)))
    return np.stack([x, y, np.cross(x, y)], axis=-1), (if_l + if_r) / 2


def rotation_xyz(angles: np.ndarray) -> np.ndarray:
    """Return R_x(a) R_y(b) R_z(c) (intrinsic x-y-z) of angles (..., 3) [rad], as (..., 3, 3)."""
    a, b, c = np.moveaxis(np.asarray(angles, float), -1, 0)
    ca, sa, cb, sb, cc, sc = np.cos(a), np.sin(a), np.cos(b), np.sin(b), np.cos(c), np.sin(c)
    rows = [
        [cb * cc, -cb * sc, sb],
        [ca * sc + sa * sb * cc, ca * cc - sa * sb * sc, -sa * cb],
        [sa * sc - ca * sb * cc, sa * cc + ca * sb * sc, ca * cb],
    ]
    return np.stack([np.stack(r, axis=-1) for r in rows], axis=-2)


def angles_xyz(rotation: np.ndarray) -> np.ndarray:
    """Return intrinsic x-y-z angles (..., 3) [rad] of rotations (..., 3, 3); inverse of `rotation_xyz`."""
    return np.stack(
        [
            np.arctan2(-rotation[..., 1, 2], rotation[..., 2, 2]),
            np.arcsin(np.clip(rotation[..., 0, 2], -1, 1)),
            np.arctan2(-rotation[..., 0, 1], rotation[..., 0, 0]),
        ],
        axis=-1,
    )


def cardan_angles(rotation: np.ndarray) -> np.ndarray:
    """Return Cardan angles (n, 3) [rad] about x, y, z of rotations R_z R_y R_x (n, 3, 3)."""
    # the inverse turns back in the other order
    return -angles_xyz(rotation.swapaxes(1, 2))


def turn_products(angles: np.ndarray) -> np.ndarray:
    """Return 1, angles (n, 3) [rad] about x, y, z and their products xx, xy, xz, yy, yz, zz, (n, 10)."""
    a, b = np.triu_indices(3)
    return np.hstack([np.ones((len(angles), 1)), angles, angles[:, a] * angles[:, b]])


def relative_pose(
    r_p: np.ndarray, p_p: np.ndarray, r_i: np.ndarray, p_i: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return the pose of I in P: rotation R_P^T R_I (..., 3, 3) and position R_P^T (p_I - p_P) (..., 3)."""
    r_pt = np.swapaxes(r_p, -1, -2)
    return r_pt @ r_i, np.einsum("...ij,...j->...i", r_pt, p_i - p_p)


def mean_rotation(rotations: np.ndarray) -> np.ndarray:
    """Return the chordal mean of rotations (n, 3, 3), rows with NaN left out."""
    good = np.isfinite(rotations).all(axis=(1, 2))
    return nearest_rotation(rotations[good].mean(axis=0))


def nearest_rotation(matrix: np.ndarray) -> np.ndarray:
    """Return the rotation (3, 3) nearest to a matrix (3, 3) in the Frobenius norm (Kabsch 1976)."""
    u, _, vt = np.linalg.svd(matrix)
    return np.asarray(u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt)


def interface_coordinates(
    relative_rotation: np.ndarray,
    relative_position: np.ndarray,
    rest_rotation: np.ndarray,
    rest_position: np.ndarray,
) -> np.ndarray:
    """Return the interface coordinates q = (tx, ty, tz, rx, ry, rz), (..., 6) [m, rad].

    t = R_P^T (p_I - p_P) - p0 and R_P^T R_I R0^T = R_x R_y R_z, with (R0, p0) the pose of I in P at rest: the
    coordinates of three slides along the pelvis axes followed by hinges x, y, z.
    """
    angles = angles_xyz(relative_rotation @ rest_rotation.T)
    return np.concatenate([relative_position - rest_position, angles], axis=-1)


def quaternion(rotation: np.ndarray) -> np.ndarray:
    """Return unit quaternions (n, 4) w, x, y, z of rotations (n, 3, 3), continuous in sign; NaN where NaN."""
    from scipy.spatial.transform import Rotation

    good = np.isfinite(rotation).all(axis=(1, 2))
    out = np.full((len(rotation), 4), np.nan)
    if good.any():
        q = Rotation.from_matrix(rotation[good]).as_quat()[:, [3, 0, 1, 2]]
        flips = np.cumprod(np.where(np.sum(q[1:] * q[:-1], axis=1) < 0, -1.0, 1.0))
        q[1:] *= flips[:, None]
        out[good] = q * (1.0 if q[0, 0] >= 0 else -1.0)
    return out


def rotation_matrix(quaternions: np.ndarray) -> np.ndarray:
    """Return rotations (n, 3, 3) of unit quaternions (n, 4) w, x, y, z; NaN where NaN."""
    from scipy.spatial.transform import Rotation

    good = np.isfinite(quaternions).all(axis=1)
    out = np.full((len(quaternions), 3, 3), np.nan)
    if good.any():
        out[good] = Rotation.from_quat(quaternions[good][:, [1, 2, 3, 0]]).as_matrix()
    return out
