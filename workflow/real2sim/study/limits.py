"""Joint limits of the interface: what the person reached in it at the operating point (section III-B)."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from real2sim.artefacts import write_json
from real2sim.errors import InputError
from real2sim.geometry import AXES
from real2sim.recording.pose_table import read_pose

RY_NOTE = (
    "r_y: without a robot log the rotation about y is not observable from two markers on the y axis; its "
    "limits are then those of the pelvis against the world's vertical, and k_ry, d_ry are informed only "
    "through the arm's pitch."
)


def _where(
    trials: dict[Path, dict[str, np.ndarray]], axis: str, largest: bool
) -> tuple[float, dict[str, Any]]:
    """Return the extreme value of one axis over the trials, and the trial and time at which it was recorded.

    ``trials`` are pose tables by their file. Raises InputError where none of them has a value.
    """
    best: tuple[float, dict[str, Any]] | None = None
    for path, q in trials.items():
        values = q[f"q_{axis}"]
        if not np.isfinite(values).any():
            continue
        index = int(np.nanargmax(values) if largest else np.nanargmin(values))
        value = float(values[index])
        if best is None or (value > best[0] if largest else value < best[0]):
            best = value, {"trial": path.parent.name, "time_s": float(q["time_s"][index])}
    if best is None:
        first, *others = trials
        raise InputError(
            first,
            f"column q_{axis}, and in {' and '.join(map(str, others))}",
            "no finite value",
            "a value of every axis in one of the sweeps at T* at least",
            "Fill the gaps of the interface and pelvis markers in the export, or name both trials under exclude in "
            "subject.yaml.",
        )
    return best


def joint_limits(*, subject: str, rotation: Path, translation: Path, neutral: Path, out: Path) -> None:
    """Write the smallest and largest interface coordinate over the rotation and translation trials at T*.

    q_min, q_max [m, rad] in the order of AXES, with the trial and time of each. ``neutral`` defines q = 0;
    its own range is kept beside for scale. Raises InputError where the limits do not hold q = 0: rest would
    lie beyond a stop.
    """
    read = {path: read_pose(path) for path in (rotation, translation)}
    trials = {path: columns for path, (columns, _) in read.items()}
    rest, about_rest = read_pose(neutral)
    abouts = [about_rest, *(about for _, about in read.values())]
    axes: dict[str, dict[str, Any]] = {}
    for axis in AXES:
        (low, at_low), (high, at_high) = (_where(trials, axis, largest) for largest in (False, True))
        if not low <= 0.0 <= high:
            raise InputError(
                rotation.parent.parent,
                f"axis {axis}, trials {' and '.join(path.parent.name for path in trials)}",
                f"[{low:.4g}, {high:.4g}]",
                "an interval that holds rest (0)",
                "Check that the neutral trial was recorded at T* with the same markers.",
            )
        noise = [float(np.nanmin(rest[f"q_{axis}"])), float(np.nanmax(rest[f"q_{axis}"]))]
        axes[axis] = {"min_at": at_low, "max_at": at_high, "neutral_range": noise, "limits": [low, high]}
    write_json(
        out,
        {
            "subject": subject,
            "phantom": any(bool(about.get("phantom", False)) for about in abouts),
            "axes": list(AXES),
            "units": ["m"] * 3 + ["rad"] * 3,
            "q_min": [axes[a]["limits"][0] for a in AXES],
            "q_max": [axes[a]["limits"][1] for a in AXES],
            "recorded": {a: {k: axes[a][k] for k in ("min_at", "max_at", "neutral_range")} for a in AXES},
            "notes": [RY_NOTE],
        },
    )
