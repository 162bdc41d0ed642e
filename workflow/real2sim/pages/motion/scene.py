"""Messages of the exported channels, as dictionaries that fit `schemas`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import mujoco
import numpy as np

from real2sim.pages.motion.schemas import PRIMITIVES

Message = dict[str, Any]
_DIGITS = 6  # micrometres, microradians
_IDENTITY = (1.0, 0.0, 0.0, 0.0)
_FOREVER = {"sec": 0, "nsec": 0}


def stamp(time_ns: int) -> Message:
    """Time of the trial."""
    return {"sec": time_ns // 10**9, "nsec": time_ns % 10**9}


def named(names: Sequence[str], values: Sequence[float] | np.ndarray) -> Message:
    """Return numbers (n,) by name, rounded; NaN and infinity become null."""
    return {
        name: round(float(value), _DIGITS) if np.isfinite(value) else None
        for name, value in zip(names, values, strict=True)
    }


def xyz(vector: Sequence[float] | np.ndarray) -> Message:
    """Return a vector (3,) by its three names."""
    return named("xyz", vector)


def pose(position: np.ndarray, quaternion: Sequence[float] | np.ndarray = _IDENTITY) -> Message:
    """Return a position (3,) [m] and a unit quaternion (4,), w first."""
    return {"position": xyz(position), "orientation": named("wxyz", quaternion)}


def transform(time_ns: int, child: str, position: np.ndarray, quaternion: np.ndarray) -> Message:
    """Return the pose of a frame in the world: position (3,) [m] and unit quaternion (4,), w first."""
    return {
        "timestamp": stamp(time_ns),
        "parent_frame_id": "world",
        "child_frame_id": child,
        "translation": xyz(position),
        "rotation": named("wxyz", quaternion),
    }


def entity(
    time_ns: int,
    name: str,
    frame: str = "world",
    about: Mapping[str, str] | None = None,
    **drawn: list[Message],
) -> Message:
    """Something to draw in a frame, until it is drawn anew; ``drawn`` are lists of primitives."""
    return {
        "timestamp": stamp(time_ns),
        "frame_id": frame,
        "id": name,
        "lifetime": _FOREVER,
        "frame_locked": True,
        "metadata": [{"key": key, "value": value} for key, value in (about or {}).items()],
        **{kind: drawn.get(kind, []) for kind in PRIMITIVES},
    }


def update(*entities: Message) -> Message:
    """A scene with these entities."""
    return {"deletions": [], "entities": list(entities)}


def sphere(position: np.ndarray, diameter_m: float, colour: Sequence[float]) -> Message:
    """Return a ball about a position (3,) [m]."""
    return {"pose": pose(position), "size": xyz([diameter_m] * 3), "color": named("rgba", colour)}


def arrow(start: np.ndarray, vector: np.ndarray, width_m: float, colour: Sequence[float]) -> Message:
    """Return an arrow from a point (3,) along a vector (3,) [m]."""
    length = float(np.linalg.norm(vector))
    head = min(3 * width_m, length / 2)
    return {
        "pose": pose(start, _from_x(vector / length if length else np.eye(3)[0])),
        "shaft_length": round(length - head, _DIGITS),
        "shaft_diameter": width_m,
        "head_length": round(head, _DIGITS),
        "head_diameter": 2.5 * width_m,
        "color": named("rgba", colour),
    }


def _from_x(direction: np.ndarray) -> np.ndarray:
    """Shortest rotation (w, x, y, z) of the x axis onto a unit vector."""
    q = np.array([1 + direction[0], 0, -direction[2], direction[1]])
    norm = np.linalg.norm(q)
    return q / norm if norm > 1e-9 else np.array([0.0, 0.0, 0.0, 1.0])


def robot_bodies(twin: mujoco.MjModel, time_ns: int) -> Message:
    """The shapes of a robot twin, each fixed to the frame of its body (``robot/<body>``)."""
    entities = []
    for geom in range(twin.ngeom):
        body = twin.body(int(twin.geom_bodyid[geom])).name
        if body in ("", "world"):
            continue
        name = twin.geom(geom).name or f"geom {geom}"
        entities.append(entity(time_ns, name, f"robot/{body}", None, **_shape(twin, geom)))
    return update(*entities)


def _shape(twin: mujoco.MjModel, geom: int) -> dict[str, list[Message]]:
    kinds, kind, size = mujoco.mjtGeom, mujoco.mjtGeom(twin.geom_type[geom]), twin.geom_size[geom]
    colour = named("rgba", twin.geom_rgba[geom])
    position, quat = twin.geom_pos[geom], twin.geom_quat[geom]
    if kind == kinds.mjGEOM_SPHERE:
        return {"spheres": [{"pose": pose(position, quat), "size": xyz([2 * size[0]] * 3), "color": colour}]}
    if kind in (kinds.mjGEOM_CAPSULE, kinds.mjGEOM_CYLINDER):
        body = {
            "pose": pose(position, quat),
            "size": xyz([2 * size[0], 2 * size[0], 2 * size[1]]),
            "bottom_scale": 1,
            "top_scale": 1,
            "color": colour,
        }
        ends = []
        if kind == kinds.mjGEOM_CAPSULE:
            axis = np.zeros(3)
            mujoco.mju_rotVecQuat(axis, np.array([0.0, 0.0, size[1]]), quat)
            ends = [
                {"pose": pose(position + side * axis), "size": xyz([2 * size[0]] * 3), "color": colour}
                for side in (-1, 1)
            ]
        return {"cylinders": [body], "spheres": ends}
    # a box as it is; anything else, a mesh say, by the box around it
    centre = np.zeros(3)
    mujoco.mju_rotVecQuat(centre, twin.geom_aabb[geom, :3], quat)
    return {
        "cubes": [
            {
                "pose": pose(position + centre, quat),
                "size": xyz(2 * twin.geom_aabb[geom, 3:]),
                "color": colour,
            }
        ]
    }
