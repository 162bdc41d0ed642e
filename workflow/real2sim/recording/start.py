"""Where the robot was when it was let go: its log tells, where a strap has moved it before the mean is taken.

The start pose is the mean over the first moments, while the person stands. A robot that is let go there by a strap that
pulls moves by millimetres meanwhile, and its controller holds where it was, not where it was on average.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from scipy.spatial.transform import Rotation

from real2sim.recording.trial import Trial
from real2sim.system.plant import interface_pose_at, load_robot, robot_pose_for

if TYPE_CHECKING:
    from real2sim.settings import DiagnosisStartSettings

# Step of the joints that says what they do to the interface [m, rad]
_STEP = 1e-5


def at_first(
    robot: np.ndarray, start: int, rate_hz: float, sd: np.ndarray, options: DiagnosisStartSettings
) -> tuple[np.ndarray, np.ndarray]:
    """Return how far (6,) [m, rad] the robot's joints were, when first seen, from their mean while all stand; and SD.

    Both are 0 for a joint that has not moved beyond noise ``sd`` (6,), or is unknown then. ``robot`` (n, 6) as from
    `robot_motion`, ``start`` its first samples while the person stands, ``options`` the slice ``diagnosis.start`` of
    the configuration. A joint starts from rest, so that a constant
    and a square of time tell its start.
    """
    n = max(3, round(options["first_s"] * rate_hz))
    first, time_s = robot[:n], np.arange(n) / rate_hz
    weights = np.linalg.pinv(np.column_stack([np.ones(n), time_s**2]))[0]
    shift = weights @ first
    # the mean over all the standing is taken off, and shares a part of its samples
    spread = np.sqrt(max(float(np.sum(weights**2)) - 1 / max(start, n), 0.0)) * sd
    moved = np.isfinite(shift) & (np.abs(shift) > options["moved_sd"] * spread)
    return np.where(moved, shift, 0.0), np.where(moved, spread, 0.0)


def moved_to_first(
    trial: Trial, robot_file: Path, shift: np.ndarray, sd: np.ndarray
) -> tuple[Trial, np.ndarray]:
    """The trial with its start pose moved by ``shift`` (6,) of the robot's joints, and what one SD of each does to it.

    The latter (6, 6) [m, rad, world] are displacement and turn of the interface, by joint. A robot that cannot reach
    its start pose is left to the replay's error.
    """
    if not shift.any():
        return trial, np.zeros((6, 6))
    twin = load_robot(robot_file).compile()
    try:
        joints = robot_pose_for(twin, trial.start_rotation, trial.start_position) + shift
    except (ValueError, np.linalg.LinAlgError):
        return trial, np.zeros((6, 6))
    rotation, position = interface_pose_at(twin, joints)
    moves = np.empty((6, 6))
    for i, step in enumerate(_STEP * np.eye(6)):
        turned, placed = interface_pose_at(twin, joints + step)
        moves[i, :3] = placed - position
        moves[i, 3:] = Rotation.from_matrix(turned @ rotation.T).as_rotvec()
    return replace(trial, start_rotation=rotation, start_position=position), sd[:, None] * moves / _STEP
