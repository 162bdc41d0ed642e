"""Whether pelvis and interface are known while the person stands at the start, which gives the robot's start pose."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pyarrow.parquet as pq

REMEDY = "Crop the export so that it starts with a measured span, or exclude the trial in subject.yaml."
EXPECTED = "both measured while the person stands quietly, which gives the robot's start pose"

_POSE = ("qw", "qx", "qy", "qz", "x", "y", "z")


def find_start_problem(
    time_s: np.ndarray, interface: np.ndarray, pelvis: np.ndarray, start_window_s: float, known_share: float
) -> tuple[float, str]:
    """Return the share of the start window in which the interface is known, and what is wrong with it, else "".

    ``time_s`` (n,) [s]; ``interface`` and ``pelvis`` (n,) say where the pose of each is known. ``known_share`` is the
    least share of the window in which the interface has to be.
    """
    window = time_s - time_s[0] < start_window_s
    share = float(interface[window].mean())
    if share < known_share:
        return share, f"interface masked by a gap: known in {100 * share:.0f} % of the window"
    return share, "" if pelvis[window].any() else "pelvis masked by a gap"


def check_pose_table(pose: Path, start_window_s: float, known_share: float) -> tuple[float, str]:
    """Return what `find_start_problem` says of a trial's pose.parquet, with the arguments of that."""
    table = pq.read_table(
        pose, columns=["time_s", *(f"{b}_{c}" for b in ("interface", "pelvis") for c in _POSE)]
    )
    interface, pelvis = (
        np.isfinite(np.column_stack([table[f"{body}_{column}"].to_numpy() for column in _POSE])).all(axis=1)
        for body in ("interface", "pelvis")
    )
    return find_start_problem(table["time_s"].to_numpy(), interface, pelvis, start_window_s, known_share)
