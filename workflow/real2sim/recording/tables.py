"""What the diagnosis reads of a trial's canonical tables, gaps bridged or left open as each reader says."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from scipy.spatial.transform import Rotation

from real2sim import signals
from real2sim.artefacts import read_json
from real2sim.geometry import AXES, INTERFACE_MARKERS, mean_rotation, rotation_matrix
from real2sim.recording.jumps import JumpRule, around
from real2sim.system.plant import ROBOT_JOINTS


def robot_motion(path: Path, interface: np.ndarray, start: int) -> np.ndarray | None:
    """Logged robot joints (n, 6) relative to their mean over the first ``start`` samples, the base in world axes.

    The heading of the odometry is laid on that of the interface markers (n, 2, 3) while the person stands: later on the
    markers may drift, and the log must not follow. None where the trial has no log, or one that knows less than half.
    """
    table = pq.read_table(path)
    columns = np.column_stack([table[name].to_numpy() for name in ROBOT_JOINTS])
    known = np.isfinite(columns).all(axis=1)
    across = interface[:start, 0] - interface[:start, 1]
    turn = np.arctan2(-across[:, 0], across[:, 1]) - columns[:start, 2]
    if known.mean() < 0.5 or not np.isfinite(turn).any():
        return None
    turn = float(np.angle(np.nanmean(np.exp(1j * turn))))
    x, y = columns[:, 0].copy(), columns[:, 1].copy()
    columns[:, 0] = np.cos(turn) * x - np.sin(turn) * y
    columns[:, 1] = np.sin(turn) * x + np.cos(turn) * y
    columns[known, 2] = np.unwrap(columns[known, 2])
    moved: np.ndarray = columns - np.nanmean(columns[:start], axis=0)
    return moved


def log_offset_sd(quality: Path) -> float:
    """SD [s] of the robot log's clock against the markers', from quality.json; 0 for an edge that both have seen."""
    return float((read_json(quality).get("robot") or {}).get("offset_sd_s") or 0.0)


def without_filled(interface: np.ndarray, markers: Path, rule: JumpRule) -> np.ndarray:
    """Return interface markers (n, 2, 3) [m], unknown where a gap was filled or is open, as far as a filter carries it.

    What fills a gap starts from noise at both ends, and with loud markers it was taken for a jump. Beside an open one
    the filter has one side only.
    """
    table = pq.read_table(markers)
    filled = np.column_stack([table[f"{name}_filled"].to_numpy() for name in INTERFACE_MARKERS])
    out = interface.copy()
    lost = np.isnan(interface).any(axis=2)
    out[around(filled | lost, rule, "edge_s")] = np.nan
    return out


def mean_pelvis(neutral: Path) -> tuple[np.ndarray, np.ndarray]:
    """Mean pelvis rotation (3, 3) and position (3,) [m, world] of the neutral trial's tables."""
    table = pq.read_table(neutral / "pose.parquet")
    rotation = rotations(table, "pelvis")
    position = np.column_stack([table[f"pelvis_{c}"].to_numpy() for c in "xyz"])
    known = np.isfinite(rotation).all(axis=(1, 2))
    return mean_rotation(rotation[known]), position[known].mean(axis=0)


def rotations(table: pa.Table, body: str) -> np.ndarray:
    """Rotations (n, 3, 3) of a body in a table of poses."""
    return rotation_matrix(np.column_stack([table[f"{body}_q{c}"].to_numpy() for c in "wxyz"]))


def measured_coordinates(path: Path, prefix: str) -> np.ndarray:
    """Measured interface coordinates ("q") or rates ("qd") (n, 6) of pose.parquet, gaps bridged."""
    table = pq.read_table(path, columns=[f"{prefix}_{axis}" for axis in AXES])
    return signals.bridged(np.column_stack([column.to_numpy() for column in table.columns]))


def rotation_vectors(rotation: np.ndarray, reference: np.ndarray | None = None) -> np.ndarray:
    """Rotation vectors (n, 3) of rotations (n, 3, 3) from a reference (3, 3), unknown ones bridged.

    Without a reference, from the first known rotation.
    """
    known = np.isfinite(rotation).all(axis=(1, 2))
    vectors = np.full((len(rotation), 3), np.nan)
    first = rotation[np.argmax(known)] if reference is None else reference
    vectors[known] = Rotation.from_matrix(first.T @ rotation[known]).as_rotvec()
    return signals.bridged(vectors)


def bridged_rotation(rotation: np.ndarray) -> np.ndarray:
    """Rotations (n, 3, 3) with unknown samples bridged along the rotation vector from the first known one."""
    first = rotation[np.argmax(np.isfinite(rotation).all(axis=(1, 2)))]
    bridged: np.ndarray = first @ Rotation.from_rotvec(rotation_vectors(rotation)).as_matrix()
    return bridged


def interface_path(pose: Path) -> np.ndarray:
    """Place and small turns (n, 6) [m, rad] of the interface, in the order of the robot's joints, of pose.parquet."""
    table = pq.read_table(pose)
    place = signals.bridged(np.column_stack([table[f"interface_{c}"].to_numpy() for c in "xyz"]))
    turn = rotation_vectors(rotations(table, "interface"))
    return np.column_stack([place[:, :2], turn[:, 2], place[:, 2], turn[:, :2]])
