"""Checks of a lab by quiet standing: the axes that point up and forward, and the left and right markers.

In standing the ASIS and PSIS lie nearly in a horizontal plane, so that the z axis of the pelvis frame points up. The
nearest lab axis is the lab's up axis unless left and right, or front and back, are exchanged among the four markers.
Then the z axis points down, to the floor. The floor is where the lab's coordinates are zero.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from real2sim import geometry
from real2sim.errors import InputError

_XYZ = ("x", "y", "z")
_KEY = "ingest.lab_to_world in the configuration"


def signed_axis(direction: np.ndarray, without: str = "") -> str:
    """Return the signed axis, e.g. ``-y``, that is nearest to a direction (3,), leaving out the axis of ``without``."""
    size = np.abs(direction).copy()
    if without:
        size[_XYZ.index(without[1])] = -1.0
    nearest = int(np.argmax(size))
    return f"{'-' if direction[nearest] < 0 else '+'}{_XYZ[nearest]}"


def _vector(axis: str) -> np.ndarray:
    out = np.zeros(3)
    out[_XYZ.index(axis[1])] = -1.0 if axis[0] == "-" else 1.0
    return out


def lab_axes(up: str, forward: np.ndarray) -> dict[str, str]:
    """Return `lab_to_world`, right-handed, of the lab's up axis and the direction (3,) that the person faces."""
    x = signed_axis(forward, without=up)
    return {"x": x, "y": signed_axis(np.cross(_vector(up), _vector(x))), "z": up}


def as_line(axes: Mapping[str, str]) -> str:
    """Return the line of a configuration that says which lab axis is which world axis."""
    return "lab_to_world: {" + ", ".join(f'{axis}: "{axes[axis]}"' for axis in _XYZ) + "}"


def check_standing(
    path: Path,
    stated: Mapping[str, Any],
    lab: np.ndarray,
    pelvis: tuple[np.ndarray, np.ndarray],
    across: np.ndarray | None,
    facing_deg: float,
) -> str:
    """Refuse a neutral trial whose up axis is another than stated, or whose left and right are exchanged.

    Parameters
    ----------
    path
        The marker export.
    stated, lab
        ``ingest.lab_to_world``, and the rotation (3, 3) from lab to world axes that it stands for.
    pelvis
        Rotation (n, 3, 3) and origin (n, 3) [m] of the pelvis in the world as stated.
    across
        (n, 3) from IF_R to IF_L [m] in the world as stated; None without them.
    facing_deg
        ``ingest.facing_deg``: angle [deg] between the person's mean heading and the world's x axis up to which the
        frame is taken for right.

    Returns what is odd about where the person faces, empty where they face along the world's x axis.
    Raises InputError (`lab_axes`, `sides`).
    """
    rotation = geometry.mean_rotation(pelvis[0])
    place = np.nanmean(pelvis[1], axis=0)
    upward = signed_axis(rotation[:, 2])
    if upward == "-z" and place[2] > 0:
        found = "a pelvis frame that is upside down: left and right, or ASIS and PSIS, are exchanged"
        remedy = (
            f"correct the labels in QTM or markers: in subject.yaml; if the lab's axis points down, {_KEY}"
        )
        raise InputError(path, ", ".join(geometry.PELVIS_MARKERS), found, "left on the left", remedy, "sides")
    if upward != "+z":
        _refuse_axes(path, stated, lab.T @ rotation, lab.T @ place)
    if across is not None and float(np.nanmean(across @ rotation[:, 1])) < 0:
        found = "IF_L on the right of the pelvis and IF_R on its left"
        remedy = "exchange IF_L and IF_R in QTM or under markers: in subject.yaml"
        raise InputError(path, "IF_L, IF_R", found, "IF_L on the side of ASIS_L", remedy, "sides")
    return _odd_heading(stated, lab, rotation[:, 0], facing_deg)


def _odd_heading(stated: Mapping[str, Any], lab: np.ndarray, forward: np.ndarray, most_deg: float) -> str:
    """Return what is odd about a person's forward direction (3,) in the world; empty up to an angle ``most_deg``.

    Names of axes mend quarter turns only. What is left of the angle is an L-frame that does not lie along the robot.
    """
    heading = float(np.degrees(np.arctan2(forward[1], forward[0])))
    if abs(heading) <= most_deg:
        return ""
    side = "left" if heading > 0 else "right"
    found = f"the person faces {abs(heading):.0f} deg to the {side} of the world's x axis; if the robot heads there"
    line = as_line(lab_axes(str(stated["z"]), lab.T @ forward))
    left = (heading + 45) % 90 - 45
    parts = [f"set ingest: {line}"] if abs(heading) > 45 else []
    if abs(left) > most_deg:
        rest = "also " if parts else ""
        parts.append(
            f"{rest}calibrate Qualisys again with the L-frame along the robot, because stiffness along x and y is mixed"
        )
    return f"{found}, {'; '.join(parts)}"


def _refuse_axes(path: Path, stated: Mapping[str, Any], pelvis: np.ndarray, place: np.ndarray) -> None:
    """Raise the refusal with the line that is right; pelvis axes (3, 3) and origin (3,) [m] in the lab."""
    up = signed_axis(pelvis[:, 2])
    if place @ _vector(up) < 0:
        # whoever stands below the floor has their labels exchanged too, which the next run says
        up = signed_axis(-_vector(up))
    line = as_line(lab_axes(up, pelvis[:, 0]))
    height = float(place @ _vector(up))
    found = f"a person standing along the lab's {up} axis (pelvis at {height:.2f} m), which is not the world's z axis"
    expected = f"the lab's up axis as {_KEY} has it: {stated['z']}"
    raise InputError(path, "axes of the lab", found, expected, f"write into ingest: {line}", "lab_axes")
