"""A fitted trial as an MCAP file: what was measured and what the twin makes of it, on one clock.

The file opens in Foxglove and in anything else that reads MCAP with JSON messages. It holds no time of day: the same
trial and fit give the same bytes.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import mujoco
import numpy as np
import pyarrow.parquet as pq
from mcap.writer import CompressionType, Writer

from real2sim.artefacts import read_json
from real2sim.files import replacing
from real2sim.geometry import AXES, INTERFACE_MARKERS, PELVIS_MARKERS, quaternion
from real2sim.inference.parameters import as_vector
from real2sim.pages.motion.replayed import MotionReplay, Replayed, strap_wrench
from real2sim.pages.motion.scene import (
    Message,
    arrow,
    entity,
    named,
    pose,
    robot_bodies,
    sphere,
    stamp,
    transform,
    update,
    xyz,
)
from real2sim.pages.motion.schemas import SCHEMAS
from real2sim.provenance import fingerprint
from real2sim.recording.formats.mcap_file import finish_file
from real2sim.recording.ingest import WRENCH
from real2sim.recording.trial import Trial, load_limits, load_trial, replay_inputs, with_step
from real2sim.study.fit import best_of
from real2sim.system.plant import (
    ROBOT_JOINTS,
    JointLimits,
    interface_site_offset,
    load_robot,
)

if TYPE_CHECKING:
    from real2sim.settings import Settings

CHANNELS = {
    "/about": "foxglove.Log",
    "/tf": "foxglove.FrameTransforms",
    "/measured/pelvis": "foxglove.PoseInFrame",
    "/measured/interface": "foxglove.PoseInFrame",
    "/measured/markers": "foxglove.SceneUpdate",
    "/measured/robot": "real2sim.RobotJoints",
    "/measured/wrench": "real2sim.Wrench",
    "/simulated/interface": "foxglove.PoseInFrame",
    "/simulated/robot": "real2sim.RobotJoints",
    "/simulated/robot_bodies": "foxglove.SceneUpdate",
    "/strap/wrench": "real2sim.Wrench",
    "/strap/arrow": "foxglove.SceneUpdate",
    "/residual": "real2sim.Residual",
    "/residual/arrows": "foxglove.SceneUpdate",
    "/q": "real2sim.InterfaceCoordinates",
}
# Topics of a trial whose robot log holds them
OPTIONAL = ("/measured/robot", "/measured/wrench")
FORCE_SCALE = 0.002  # metres of arrow per newton
RESIDUAL_SCALE = 10.0  # residual arrows are drawn so many times as long
_CHUNK = 1 << 20
_BLACK, _BLUE, _ORANGE, _RED = (
    (0.1, 0.1, 0.1, 1.0),
    (0.0, 0.45, 0.7, 1.0),
    (0.9, 0.6, 0.0, 1.0),
    (0.84, 0.37, 0.0, 1),
)
_FILLED = (0.1, 0.1, 0.1, 0.35)


@dataclass(frozen=True)
class _Table:
    """Columns of a canonical table and what its metadata say."""

    columns: dict[str, np.ndarray]
    meta: dict[str, Any]

    @classmethod
    def read(cls, path: Path) -> _Table:
        table = pq.read_table(path)
        meta = json.loads(table.schema.metadata[b"real2sim"])
        return cls({name: table[name].to_numpy() for name in table.column_names}, meta)

    def stack(self, *names: str) -> np.ndarray:
        return np.column_stack([self.columns[name] for name in names])


def export_motion(
    *,
    subject: str,
    trial: str,
    fits: list[Path],
    pose: Path,
    markers: Path,
    robot_log: Path,
    limits: Path,
    step: Path,
    robot: Path,
    settings: Settings,
    out: Path,
) -> None:
    """Write measured and simulated motion of a trial under its best fit as MCAP (channels: `CHANNELS`).

    Parameters
    ----------
    fits
        All restarts of the trial; the best one is shown.
    pose, markers, robot_log
        Canonical tables of the trial; of the robot's, columns that are NaN throughout are left out.
    limits, step, robot
        Joint limits and step study of the person, MJCF of the robot twin.
    settings
        Slices ``identification``, ``plant`` and ``robot`` of the configuration.

    Raises
    ------
    InputError
        Where a file is broken, or the twin does not reach the trial's start pose.
    """
    fit = best_of([read_json(path, ("subject", "trial", "parameters", "cost")) for path in fits])
    settings = with_step(settings, step)
    recorded = load_trial(pose, markers, settings["identification"])
    bounds = load_limits(limits)
    replay = MotionReplay(**replay_inputs(recorded, bounds, robot, settings), nsim=1)
    view = _View(
        recorded,
        _Table.read(pose),
        _Table.read(markers),
        _Table.read(robot_log),
        bounds,
        load_robot(robot).compile(),
        replay.record(as_vector(fit["parameters"])),
    )
    about = {"subject": subject, "trial": trial, "phantom": json.dumps(recorded.phantom)}
    _write(out, view, about | _describe_fit(fit))


def _describe_fit(fit: dict[str, Any]) -> dict[str, str]:
    """The fit that is shown, and the scales of the arrows, as metadata of the file."""
    return {
        "J": repr(fit["cost"]["J"]),
        "restart": str(fit["restart"]),
        "parameters": json.dumps(fit["parameters"]),
        "overridden_gates": json.dumps(fit.get("overridden_gates", {})),
        "force_arrow_m_per_N": str(FORCE_SCALE),
        "residual_arrow_magnified": str(RESIDUAL_SCALE),
        "code_fingerprint": fingerprint(__name__),
    }


def _write(out: Path, view: _View, about: dict[str, str]) -> None:
    with replacing(out) as temporary, temporary.open("wb") as stream:
        writer = Writer(stream, chunk_size=_CHUNK, compression=CompressionType.ZSTD, enable_data_crcs=True)
        writer.start(profile="", library="pHRI Real2Sim")
        schemas = {
            name: writer.register_schema(name, "jsonschema", json.dumps(SCHEMAS[name]).encode())
            for name in sorted(set(CHANNELS.values()))
        }
        channels = {
            topic: writer.register_channel(topic, "json", schemas[name])
            for topic, name in CHANNELS.items()
            if topic in view.topics()
        }
        writer.add_metadata("real2sim", about)
        for sequence, (time_ns, topic, message) in enumerate(view.messages(about)):
            data = json.dumps(message, allow_nan=False, separators=(",", ":")).encode()
            writer.add_message(channels[topic], time_ns, data, time_ns, sequence)
        finish_file(writer)


class _View:
    """The trial and its replay as messages in the order of time."""

    def __init__(
        self,
        trial: Trial,
        pose: _Table,
        markers: _Table,
        log: _Table,
        limits: JointLimits,
        twin: mujoco.MjModel,
        replayed: Replayed,
    ):
        self.trial, self.pose, self.markers, self.log = trial, pose, markers, log
        self.limits, self.twin, self.replayed = limits, twin, replayed
        # the clock of a file cannot start before zero
        start = min(0.0, float(trial.time_s[0]))
        self.times = np.round((trial.time_s - start) * 1e9).astype(np.int64)
        self.bodies, self.interface = self._kinematics()
        self.pelvis_quat = quaternion(trial.pelvis_rotation)
        self.force, self.torque = strap_wrench(replayed.force, replayed.q)
        self.robot = self._robot_joints()

    def topics(self) -> list[str]:
        """Topics that the file has: those of the robot log only where it holds them."""
        there = {
            "/measured/robot": np.isfinite(self.robot).all(axis=1).any(),
            "/measured/wrench": np.isfinite(self._wrench()).all(axis=1).any(),
        }
        return [topic for topic in CHANNELS if there.get(topic, True)]

    def _wrench(self) -> np.ndarray:
        """Logged wrench (n, 6) on the interface [N, Nm], NaN where the log has none: its topic is optional."""
        if not set(WRENCH) <= set(self.log.columns):
            return np.full((len(self.times), 6), np.nan)
        return self.log.stack(*WRENCH)

    def _robot_joints(self) -> np.ndarray:
        """Logged robot joints (n, 6) relative to their first sample, the base in the axes of the world."""
        joints = self.log.stack(*ROBOT_JOINTS)
        turn = self.log.meta.get("yaw_odom_to_world_rad", 0.0)
        c, s = np.cos(turn), np.sin(turn)
        joints[:, :2] = joints[:, :2] @ np.array([[c, s], [-s, c]])
        measured = np.isfinite(joints).all(axis=1)
        return joints - joints[np.argmax(measured)] if measured.any() else joints

    def _kinematics(self) -> tuple[dict[str, np.ndarray], np.ndarray]:
        """Poses (n, 7) of the twin's bodies and of the interface: position [m], quaternion w, x, y, z."""
        twin, data = self.twin, mujoco.MjData(self.twin)
        names = [twin.body(i).name for i in range(1, twin.nbody)]
        address = [twin.joint(name).qposadr[0] for name in ROBOT_JOINTS]
        body, offset = twin.body("interface").id, interface_site_offset(twin)
        poses = np.empty((len(self.times), twin.nbody, 7))
        middle = np.empty((len(self.times), 7))
        for i, joints in enumerate(self.replayed.robot):
            data.qpos[address] = joints
            mujoco.mj_kinematics(twin, data)
            poses[i] = np.hstack([data.xpos, data.xquat])
            point = data.xpos[body] + data.xmat[body].reshape(3, 3) @ offset
            middle[i] = np.concatenate([point, data.xquat[body]])
        return {name: poses[:, k + 1] for k, name in enumerate(names) if name}, middle

    def messages(self, about: dict[str, str]) -> Iterator[tuple[int, str, Message]]:
        """Time [ns], topic and message."""
        first = int(self.times[0])
        kind = "PHANTOM: a synthetic person. " if self.trial.phantom else ""
        text = f"{kind}{about['subject']} {about['trial']}, J = {about['J']}"
        log = {
            "timestamp": stamp(first),
            "level": 2,
            "message": text,
            "name": "real2sim",
            "file": "",
            "line": 0,
        }
        yield first, "/about", log
        yield first, "/simulated/robot_bodies", robot_bodies(self.twin, first)
        topics = self.topics()
        wrench = self._wrench()
        for i, time in enumerate(self.times.tolist()):
            yield time, "/tf", {"transforms": self._transforms(i, time)}
            yield from self._measured(i, time)
            if "/measured/robot" in topics and np.isfinite(self.robot[i]).all():
                yield time, "/measured/robot", {"timestamp": stamp(time)} | named(ROBOT_JOINTS, self.robot[i])
            if "/measured/wrench" in topics and np.isfinite(wrench[i]).all():
                yield time, "/measured/wrench", _wrench(time, "robot/interface", wrench[i, :3], wrench[i, 3:])
            yield from self._simulated(i, time)
            yield from self._residual(i, time)

    def _transforms(self, i: int, time: int) -> list[Message]:
        """Frames of the sample; the measured pelvis only where it is measured."""
        frames = [
            transform(time, f"robot/{name}", path[i, :3], path[i, 3:]) for name, path in self.bodies.items()
        ]
        frames.append(transform(time, "interface_simulated", self.interface[i, :3], self.interface[i, 3:]))
        if np.isfinite(self.pelvis_quat[i]).all():
            frames.append(transform(time, "pelvis", self.trial.pelvis_position[i], self.pelvis_quat[i]))
        position, quat = self._measured_interface(i)
        if np.isfinite(position).all() and np.isfinite(quat).all():
            frames.append(transform(time, "interface_measured", position, quat))
        return frames

    def _measured_interface(self, i: int) -> tuple[np.ndarray, np.ndarray]:
        row = np.array(
            [self.pose.columns[f"interface_{part}"][i] for part in ["x", "y", "z", "qw", "qx", "qy", "qz"]]
        )
        return row[:3], row[3:]

    def _measured(self, i: int, time: int) -> Iterator[tuple[int, str, Message]]:
        for name, (position, quat) in (
            ("pelvis", (self.trial.pelvis_position[i], self.pelvis_quat[i])),
            ("interface", self._measured_interface(i)),
        ):
            if np.isfinite(position).all() and np.isfinite(quat).all():
                yield time, f"/measured/{name}", _pose_in_world(time, position, quat)
        balls = []
        for marker in (*PELVIS_MARKERS, *INTERFACE_MARKERS):
            place = np.array([self.markers.columns[f"{marker}_{axis}"][i] for axis in "xyz"])
            if np.isfinite(place).all():
                colour = _FILLED if self.markers.columns[f"{marker}_filled"][i] else _BLACK
                balls.append(sphere(place, 0.015, colour))
        yield time, "/measured/markers", update(entity(time, "markers", spheres=balls))

    def _simulated(self, i: int, time: int) -> Iterator[tuple[int, str, Message]]:
        r, place = self.replayed, self.interface[i]
        yield time, "/simulated/interface", _pose_in_world(time, place[:3], place[3:])
        joints = r.robot[i] - r.robot[0]
        yield time, "/simulated/robot", {"timestamp": stamp(time)} | named(ROBOT_JOINTS, joints)
        yield (
            time,
            "/q",
            {
                "timestamp": stamp(time),
                "measured": named(AXES, [self.pose.columns[f"q_{axis}"][i] for axis in AXES]),
                "simulated": named(AXES, r.q[i]),
                "lower_limit": named(AXES, self.limits.lower),
                "upper_limit": named(AXES, self.limits.upper),
            },
        )
        # what the strap does to the person is the reverse of what it does to the robot
        force, torque = -self.force[i], -self.torque[i]
        yield time, "/strap/wrench", _wrench(time, "pelvis", force, torque)
        rotation = self.trial.pelvis_rotation[i]
        if np.isfinite(rotation).all():
            shown = arrow(place[:3], FORCE_SCALE * (rotation @ force), 0.012, _ORANGE)
            about = {"force_N": f"{np.linalg.norm(force):.3f}", "acts on": "the person"}
            yield time, "/strap/arrow", update(entity(time, "force", about=about, arrows=[shown]))

    def _residual(self, i: int, time: int) -> Iterator[tuple[int, str, Message]]:
        sites, measured = self.replayed.sites[i], self.trial.interface[i]
        balls = [sphere(site, 0.012, _BLUE) for site in sites]
        error = sites - measured
        there = np.isfinite(error).all(axis=1)
        arrows = [
            arrow(point, RESIDUAL_SCALE * e, 0.006, _RED)
            for point, e, good in zip(measured, error, there, strict=True)
            if good
        ]
        about = {"magnified": str(RESIDUAL_SCALE)}
        drawn = entity(time, "residual", about=about, arrows=arrows, spheres=balls)
        yield time, "/residual/arrows", update(drawn)
        if there.all():
            left, right = error
            yield (
                time,
                "/residual",
                {
                    "timestamp": stamp(time),
                    "frame_id": "world",
                    "left": xyz(left),
                    "right": xyz(right),
                    **named(("left_norm", "right_norm"), np.linalg.norm(error, axis=1)),
                    "counted": bool(self.trial.usable[i]),
                },
            )


def _pose_in_world(time: int, position: np.ndarray, quat: np.ndarray) -> Message:
    return {"timestamp": stamp(time), "frame_id": "world", "pose": pose(position, quat)}


def _wrench(time: int, frame: str, force: np.ndarray, torque: np.ndarray) -> Message:
    return {"timestamp": stamp(time), "frame_id": frame, "force": xyz(force), "torque": xyz(torque)}
