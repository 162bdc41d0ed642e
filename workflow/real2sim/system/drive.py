"""The pelvis path that a replay prescribes: position, velocity and acceleration at every step."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.interpolate import PchipInterpolator, make_interp_spline
from scipy.spatial.transform import Rotation

# The servo measures the pelvis by a rotation vector, which is unique up to half a revolution
LARGEST_TURN = 2.8


@dataclass(frozen=True)
class PelvisDrive:
    """A pelvis path in a fixed reference frame, at the plant's steps.

    ``reference_rotation`` (3, 3) and ``reference_origin`` (3,) [m] place the frame in the world. ``position``,
    ``velocity`` and ``acceleration`` are (n, 6): translation [m], then for the position the rotation vector of
    R_ref^T R_P and for its rates the angular velocity and acceleration in the reference frame [rad].
    Velocities are those of half a step earlier: there a leapfrog step keeps them.
    """

    timestep: float
    reference_rotation: np.ndarray
    reference_origin: np.ndarray
    position: np.ndarray
    velocity: np.ndarray
    acceleration: np.ndarray


def _left_jacobian(v: np.ndarray) -> np.ndarray:
    """Left Jacobian of SO(3), (n, 3, 3): spatial angular velocity = J(v) dv/dt for R = exp(v)."""
    angle = np.linalg.norm(v, axis=1)
    small = angle < 1e-6
    safe = np.where(small, 1.0, angle)
    a = np.where(small, 0.5, (1 - np.cos(safe)) / safe**2)
    b = np.where(small, 1 / 6, (safe - np.sin(safe)) / safe**3)
    skew = np.zeros((len(v), 3, 3))
    skew[:, 0, 1], skew[:, 0, 2], skew[:, 1, 2] = -v[:, 2], v[:, 1], -v[:, 0]
    skew -= np.swapaxes(skew, 1, 2)
    return np.eye(3) + a[:, None, None] * skew + b[:, None, None] * (skew @ skew)


def _bridged(time_s: np.ndarray, pose: np.ndarray, good: np.ndarray) -> np.ndarray:
    """Return poses (n, 6) at all times, from those (k, 6) of the ``good`` samples (n,).

    A gap is crossed without leaving the range of its two ends, and before the first and after the last known sample the
    pose stands still. A quintic spline alone would swing by more than the recorded motion within a second, and run off
    without a limit at an end.
    """
    if good.all():
        return pose
    out = np.empty((len(time_s), pose.shape[1]))
    out[good] = pose
    known = time_s[good]
    out[~good] = PchipInterpolator(known, pose)(np.clip(time_s[~good], known[0], known[-1]))
    return out


def pelvis_drive(
    time_s: np.ndarray,
    rotation: np.ndarray,
    position: np.ndarray,
    timestep: float,
    frame: tuple[np.ndarray, np.ndarray] | None = None,
) -> PelvisDrive:
    """Interpolate a sampled pelvis pose by quintic splines at the plant's steps.

    Parameters
    ----------
    time_s
        (n,) uniform sample times [s].
    rotation, position
        (n, 3, 3) and (n, 3) [m] pelvis pose in the world. Samples with NaN are bridged (`_bridged`): a replay
        cannot stop in a gap. Whoever computes a cost masks them.
    timestep
        Of the plant [s]; steps run from ``time_s[0]`` to ``time_s[-1]``.
    frame
        Reference rotation (3, 3) and origin (3,) [m]; the first measured pose without.

    Raises
    ------
    ValueError
        Where the pelvis turns farther from its first pose than the servo can follow.
    """
    good = np.isfinite(position).all(axis=1) & np.isfinite(rotation).all(axis=(1, 2))
    first = int(np.argmax(good))
    reference, origin = (rotation[first], position[first]) if frame is None else frame
    vectors = Rotation.from_matrix(reference.T @ rotation[good]).as_rotvec()
    largest = np.linalg.norm(vectors, axis=1).max()
    if largest > LARGEST_TURN:
        raise ValueError(f"the pelvis turns by {np.degrees(largest):.0f} degrees from its first pose")
    pose = np.hstack([(position[good] - origin) @ reference, vectors])
    path = make_interp_spline(time_s, _bridged(time_s, pose, good), k=5)
    rate = path(time_s, 1)
    rate[:, 3:] = np.einsum("nij,nj->ni", _left_jacobian(path(time_s)[:, 3:]), rate[:, 3:])
    rates = make_interp_spline(time_s, rate[:, 3:], k=5)
    n = round((time_s[-1] - time_s[0]) / timestep) + 1
    t = np.minimum(time_s[0] + timestep * np.arange(n), time_s[-1])
    half = np.maximum(t - timestep / 2, time_s[0])
    return PelvisDrive(
        timestep,
        reference,
        origin,
        path(t),
        np.hstack([path(half, 1)[:, :3], rates(half)]),
        np.hstack([path(t, 2)[:, :3], rates(t, 1)]),
    )
