"""JSON schemas of the exported channels: Foxglove's well-known ones by their names, and a few of our own.

A viewer tells by a schema's name what it can draw (https://docs.foxglove.dev/docs/visualization/message-schemas). Every
field that is written is required here, so that a message that lacks one does not pass.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from real2sim.geometry import AXES
from real2sim.system.plant import ROBOT_JOINTS

Schema = dict[str, Any]

_NUMBER: Schema = {"type": "number"}
_TEXT: Schema = {"type": "string"}
_FLAG: Schema = {"type": "boolean"}


def _record(title: str, fields: Mapping[str, Schema], about: str = "") -> Schema:
    content = {"title": title, "type": "object", "properties": dict(fields), "required": list(fields)}
    return content | ({"description": about} if about else {})


def _list(item: Schema) -> Schema:
    return {"type": "array", "items": item}


def _numbers(names: str | tuple[str, ...], title: str, about: str = "") -> Schema:
    return _record(title, dict.fromkeys(names, _NUMBER), about)


_NSEC: Schema = {"type": "integer", "minimum": 0, "maximum": 999_999_999}
_TIME = _record("time", {"sec": {"type": "integer", "minimum": 0}, "nsec": _NSEC})
_DURATION = _record("duration", {"sec": {"type": "integer"}, "nsec": _NSEC})
_VECTOR = _numbers("xyz", "foxglove.Vector3")
_POINT = _numbers("xyz", "foxglove.Point3")
_QUATERNION = _numbers("xyzw", "foxglove.Quaternion")
_COLOUR = _numbers("rgba", "foxglove.Color")
_POSE = _record("foxglove.Pose", {"position": _VECTOR, "orientation": _QUATERNION})
_STAMPED = {"timestamp": _TIME, "frame_id": _TEXT}

_SOLID = {"pose": _POSE, "size": _VECTOR, "color": _COLOUR}
_PRIMITIVES = {
    "arrows": _record(
        "foxglove.ArrowPrimitive",
        {
            "pose": _POSE,
            **dict.fromkeys(("shaft_length", "shaft_diameter", "head_length", "head_diameter"), _NUMBER),
            "color": _COLOUR,
        },
    ),
    "cubes": _record("foxglove.CubePrimitive", _SOLID),
    "spheres": _record("foxglove.SpherePrimitive", _SOLID),
    "cylinders": _record(
        "foxglove.CylinderPrimitive", _SOLID | {"bottom_scale": _NUMBER, "top_scale": _NUMBER}
    ),
    "lines": _record(
        "foxglove.LinePrimitive",
        {
            "type": {"type": "integer", "enum": [0, 1, 2]},
            "pose": _POSE,
            "thickness": _NUMBER,
            "scale_invariant": _FLAG,
            "points": _list(_POINT),
            "color": _COLOUR,
            "colors": _list(_COLOUR),
            "indices": _list({"type": "integer", "minimum": 0}),
        },
    ),
    "triangles": {"title": "foxglove.TriangleListPrimitive", "type": "object"},
    "texts": {"title": "foxglove.TextPrimitive", "type": "object"},
    "models": {"title": "foxglove.ModelPrimitive", "type": "object"},
}
# the names of the lists that an entity holds, drawn or not
PRIMITIVES = tuple(_PRIMITIVES)

_ENTITY = _record(
    "foxglove.SceneEntity",
    {
        **_STAMPED,
        "id": _TEXT,
        "lifetime": _DURATION,
        "frame_locked": _FLAG,
        "metadata": _list(_record("foxglove.KeyValuePair", {"key": _TEXT, "value": _TEXT})),
        **{name: _list(item) for name, item in _PRIMITIVES.items()},
    },
)
_DELETION = _record(
    "foxglove.SceneEntityDeletion", {"timestamp": _TIME, "type": {"type": "integer"}, "id": _TEXT}
)
_TRANSFORM = _record(
    "foxglove.FrameTransform",
    {
        "timestamp": _TIME,
        "parent_frame_id": _TEXT,
        "child_frame_id": _TEXT,
        "translation": _VECTOR,
        "rotation": _QUATERNION,
    },
)
_Q = {axis: {"type": ["number", "null"]} for axis in AXES}

SCHEMAS: dict[str, Schema] = {
    schema["title"]: schema
    for schema in (
        _record("foxglove.FrameTransforms", {"transforms": _list(_TRANSFORM)}),
        _record("foxglove.PoseInFrame", _STAMPED | {"pose": _POSE}),
        _record("foxglove.SceneUpdate", {"deletions": _list(_DELETION), "entities": _list(_ENTITY)}),
        _record(
            "foxglove.Log",
            {
                "timestamp": _TIME,
                "level": {"type": "integer", "minimum": 0, "maximum": 5},
                "message": _TEXT,
                "name": _TEXT,
                "file": _TEXT,
                "line": {"type": "integer", "minimum": 0},
            },
        ),
        _record(
            "real2sim.InterfaceCoordinates",
            {
                "timestamp": _TIME,
                **{
                    name: _record(name, _Q)
                    for name in ("measured", "simulated", "lower_limit", "upper_limit")
                },
            },
            "Interface coordinates q: t [m] along the pelvis axes, r [rad] intrinsic x-y-z; null in a gap or "
            "where the joint has no limit",
        ),
        _record(
            "real2sim.Wrench",
            _STAMPED | {"force": _VECTOR, "torque": _VECTOR},
            "Force [N] and torque [Nm] in the axes of frame_id",
        ),
        _record(
            "real2sim.Residual",
            {
                **_STAMPED,
                "left": _VECTOR,
                "right": _VECTOR,
                "left_norm": _NUMBER,
                "right_norm": _NUMBER,
                "counted": _FLAG,
            },
            "Simulated less measured interface marker [m, world]; counted: the cost J looks at this sample",
        ),
        _record(
            "real2sim.RobotJoints",
            {"timestamp": _TIME, **dict.fromkeys(ROBOT_JOINTS, _NUMBER)},
            "Robot joints relative to the start of the trial [m, rad], the base in the axes of the world",
        ),
    )
}
