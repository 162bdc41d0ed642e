"""The robot's log: topics in an MCAP file, messages in CDR (ROS 2), JSON or protobuf.

Topics: ``/odom`` nav_msgs/msg/Odometry, ``/joint_states`` sensor_msgs/msg/JointState,
optional ``/interface/wrench`` geometry_msgs/msg/WrenchStamped, optional ``/sync`` std_msgs/msg/Bool.

The four message types are read and written by their CDR layout, many messages at a time: every byte of a
message is accounted for, and a log reads four times as fast as message by message. The first message of each
topic is checked against mcap-ros2-support, which goes by the definition stored in the file. JSON and protobuf
messages have the same fields by the same names (``pose.pose.position.x``); one that lacks a field is refused.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from real2sim import signals
from real2sim.errors import InputError
from real2sim.files import replacing
from real2sim.recording.formats.mcap_file import (
    Channel,
    Contents,
    Undecodable,
    decoder,
    finish_file,
    read_messages,
)
from real2sim.recording.formats.recordings import Finding, RobotLog
from real2sim.recording.formats.stamps import StampedTopic, choose_times, default_settings, stamp_ns

if TYPE_CHECKING:
    from real2sim.settings import IngestRobotLogStampsSettings

ODOMETRY = "nav_msgs/msg/Odometry"
JOINT_STATE = "sensor_msgs/msg/JointState"
WRENCH = "geometry_msgs/msg/WrenchStamped"
BOOL = "std_msgs/msg/Bool"
TOPICS = {"/odom": ODOMETRY, "/joint_states": JOINT_STATE, "/interface/wrench": WRENCH, "/sync": BOOL}
ARM_JOINTS = ("arm_lift", "arm_roll", "arm_pitch")
BASE_COLUMNS = ("x", "y", "yaw", "vx", "vy", "wz")

# Fields of a message in order: name, kind, and for "f8" and "u1" their number.
# Kinds: "stamp" (int32 s, uint32 ns), "string", "string[]", "f8", "f8[]", "u1".
_HEADER = (("stamp", "stamp", 1), ("frame_id", "string", 1))
_FIELDS: dict[str, tuple[tuple[str, str, int], ...]] = {
    ODOMETRY: (
        *_HEADER,
        ("child_frame_id", "string", 1),
        ("position", "f8", 3),
        ("orientation", "f8", 4),
        ("pose_covariance", "f8", 36),
        ("linear", "f8", 3),
        ("angular", "f8", 3),
        ("twist_covariance", "f8", 36),
    ),
    JOINT_STATE: (
        *_HEADER,
        ("name", "string[]", 1),
        ("position", "f8[]", 1),
        ("velocity", "f8[]", 1),
        ("effort", "f8[]", 1),
    ),
    WRENCH: (*_HEADER, ("force", "f8", 3), ("torque", "f8", 3)),
    BOOL: (("data", "u1", 1),),
}

_CDR_LITTLE_ENDIAN = b"\x00\x01\x00\x00"
_START = len(_CDR_LITTLE_ENDIAN)  # alignment counts from here

_DEFINITIONS = {
    "builtin_interfaces/Time": "int32 sec\nuint32 nanosec",
    "std_msgs/Header": "builtin_interfaces/Time stamp\nstring frame_id",
    "geometry_msgs/Point": "float64 x\nfloat64 y\nfloat64 z",
    "geometry_msgs/Vector3": "float64 x\nfloat64 y\nfloat64 z",
    "geometry_msgs/Quaternion": "float64 x 0\nfloat64 y 0\nfloat64 z 0\nfloat64 w 1",
    "geometry_msgs/Pose": "geometry_msgs/Point position\ngeometry_msgs/Quaternion orientation",
    "geometry_msgs/PoseWithCovariance": "geometry_msgs/Pose pose\nfloat64[36] covariance",
    "geometry_msgs/Twist": "geometry_msgs/Vector3 linear\ngeometry_msgs/Vector3 angular",
    "geometry_msgs/TwistWithCovariance": "geometry_msgs/Twist twist\nfloat64[36] covariance",
    "geometry_msgs/Wrench": "geometry_msgs/Vector3 force\ngeometry_msgs/Vector3 torque",
    "nav_msgs/Odometry": (
        "std_msgs/Header header\nstring child_frame_id\n"
        "geometry_msgs/PoseWithCovariance pose\ngeometry_msgs/TwistWithCovariance twist"
    ),
    "sensor_msgs/JointState": (
        "std_msgs/Header header\nstring[] name\nfloat64[] position\nfloat64[] velocity\nfloat64[] effort"
    ),
    "geometry_msgs/WrenchStamped": "std_msgs/Header header\ngeometry_msgs/Wrench wrench",
    "std_msgs/Bool": "bool data",
}


def _schema_text(type_name: str) -> str:
    """Message definition with all it depends on, as rosbag2 stores it."""
    root = type_name.replace("/msg/", "/")
    order, queue = [root], [root]
    while queue:
        for line in _DEFINITIONS[queue.pop(0)].splitlines():
            child = line.split()[0]
            if child in _DEFINITIONS and child not in order:
                order.append(child)
                queue.append(child)
    rest = [f"{'=' * 80}\nMSG: {name}\n{_DEFINITIONS[name]}\n" for name in order[1:]]
    return f"{_DEFINITIONS[root]}\n" + "".join(rest)


# -------------------- CDR layout


@dataclass(frozen=True)
class _Layout:
    """Layout of one message: offset and number of items of its fields, and its structure."""

    items: dict[str, tuple[int, int]]
    strings: dict[str, list[str]]
    structure: tuple[tuple[int, int], ...]
    size: int


def _align(offset: int, size: int) -> int:
    return _START + -(-(offset - _START) // size) * size


def _layout(type_name: str, payload: bytes) -> _Layout:
    """Walk through one CDR payload. Raises ValueError or struct.error where it is not of this type."""
    if payload[:2] != _CDR_LITTLE_ENDIAN[:2]:
        raise ValueError("not little-endian CDR")
    items: dict[str, tuple[int, int]] = {}
    strings: dict[str, list[str]] = {}
    structure: list[tuple[int, int]] = [(0, 2)]
    at = _START

    def length() -> int:
        nonlocal at
        at = _align(at, 4)
        value: int = struct.unpack_from("<I", payload, at)[0]
        structure.append((at, at + 4))
        at += 4
        if value > len(payload):
            raise ValueError(f"a length of {value} in a message of {len(payload)} bytes")
        return value

    def string() -> str:
        nonlocal at
        n = length()
        raw = payload[at : at + n]
        if len(raw) < n or (n and raw[-1] != 0):
            raise ValueError("a string without its end")
        structure.append((at, at + n))
        at += n
        return raw[:-1].decode()

    for name, kind, count in _FIELDS[type_name]:
        if kind == "string":
            strings[name] = [string()]
        elif kind == "string[]":
            strings[name] = [string() for _ in range(length())]
        elif kind == "stamp":
            at = _align(at, 4)
            items[name] = (at, 2)
            at += 8
        else:
            n = length() if kind == "f8[]" else count
            size = 1 if kind == "u1" else 8
            at = _align(at, size) if n else at
            items[name] = (at, n)
            at += n * size
    if not at <= len(payload) <= at + 3:
        raise ValueError(f"{len(payload)} bytes where the type takes {at}")
    return _Layout(items, strings, tuple(structure), at)


def _compose(type_name: str, strings: dict[str, list[str]], counts: dict[str, int]) -> bytes:
    """One CDR payload with all numbers zero."""
    out = bytearray(_CDR_LITTLE_ENDIAN)

    def pad(size: int) -> None:
        out.extend(bytes(_align(len(out), size) - len(out)))

    def string(text: str) -> None:
        raw = text.encode() + b"\0"
        pad(4)
        out.extend(struct.pack("<I", len(raw)) + raw)

    for name, kind, count in _FIELDS[type_name]:
        if kind == "string":
            string(strings[name][0])
        elif kind == "string[]":
            pad(4)
            out.extend(struct.pack("<I", len(strings[name])))
            for text in strings[name]:
                string(text)
        elif kind == "stamp":
            pad(4)
            out.extend(bytes(8))
        else:
            n = counts.get(name, 0) if kind == "f8[]" else count
            if kind == "f8[]":
                pad(4)
                out.extend(struct.pack("<I", n))
            if n:
                pad(1 if kind == "u1" else 8)
            out.extend(bytes(n * (1 if kind == "u1" else 8)))
    return bytes(out)


def _payloads(
    type_name: str, stamps_ns: np.ndarray, strings: dict[str, list[str]], values: dict[str, np.ndarray]
) -> list[bytes]:
    """Messages of one topic: ``values`` maps a field to (n, items)."""
    template = _compose(type_name, strings, {name: v.shape[1] for name, v in values.items()})
    layout = _layout(type_name, template)
    table = np.tile(np.frombuffer(template, np.uint8), (len(stamps_ns), 1))
    if "stamp" in layout.items:
        at = layout.items["stamp"][0]
        stamp = np.column_stack([stamps_ns // 10**9, stamps_ns % 10**9]).astype("<u4")
        table[:, at : at + 8] = stamp.view(np.uint8)
    for name, value in values.items():
        at = layout.items[name][0]
        raw = np.ascontiguousarray(value, np.uint8 if type_name == BOOL else "<f8").view(np.uint8)
        table[:, at : at + raw.shape[1]] = raw
    return [row.tobytes() for row in table]


# -------------------- writing


def _messages(log: RobotLog) -> dict[str, tuple[np.ndarray, list[bytes]]]:
    """Log times [ns] and payloads of every topic of a log."""

    def nanoseconds(time_s: np.ndarray) -> np.ndarray:
        return log.start_ns + np.rint(np.asarray(time_s, float) * 1e9).astype(np.int64)

    out: dict[str, tuple[np.ndarray, list[bytes]]] = {}
    t = nanoseconds(log.base_time_s)
    base, zero = {k: np.asarray(v, float) for k, v in log.base.items()}, np.zeros(len(t))
    values = {
        "position": np.column_stack([base["x"], base["y"], zero]),
        "orientation": np.column_stack([zero, zero, np.sin(base["yaw"] / 2), np.cos(base["yaw"] / 2)]),
        "linear": np.column_stack([base["vx"], base["vy"], zero]),
        "angular": np.column_stack([zero, zero, base["wz"]]),
    }
    out["/odom"] = t, _payloads(ODOMETRY, t, {"frame_id": ["odom"], "child_frame_id": ["base"]}, values)

    t = nanoseconds(log.joint_time_s)
    names = list(log.joints)
    values = {
        "position": np.column_stack([log.joints[name][:, 0] for name in names]),
        "velocity": np.column_stack([log.joints[name][:, 1] for name in names]),
    }
    out["/joint_states"] = t, _payloads(JOINT_STATE, t, {"frame_id": [""], "name": names}, values)

    if log.wrench is not None and log.wrench_time_s is not None:
        t = nanoseconds(log.wrench_time_s)
        values = {"force": log.wrench[:, :3], "torque": log.wrench[:, 3:]}
        out["/interface/wrench"] = t, _payloads(WRENCH, t, {"frame_id": ["interface"]}, values)

    if log.sync_s is not None and len(log.sync_s):
        edges = np.asarray(log.sync_s, float)
        # The signal is low from the log's start, and falls again halfway between two edges.
        low = np.concatenate([[0.0], (edges[1:] + edges[:-1]) / 2])
        t = nanoseconds(np.column_stack([low, edges]).ravel())
        state = np.tile(np.array([0, 1], np.uint8), len(edges))[:, None]
        out["/sync"] = t, _payloads(BOOL, t, {}, {"data": state})
    return out


METADATA = "real2sim"  # name of the metadata record


def write_log(path: Path, log: RobotLog, *, metadata: dict[str, str] | None = None) -> None:
    """Write a log as rosbag2 does (profile ros2, CDR, zstd chunks); the same log gives the same bytes.

    Times [s] count from ``log.start_ns`` [ns since the Unix epoch]. ``/sync`` is false at time 0 and true at
    each of ``log.sync_s``. ``metadata`` becomes the file's metadata record `METADATA`.
    """
    from mcap.writer import CompressionType, Writer

    topics = _messages(log)
    with replacing(path) as temporary, temporary.open("wb") as stream:
        writer = Writer(stream, compression=CompressionType.ZSTD)
        writer.start(profile="ros2", library="real2sim")
        if metadata:
            writer.add_metadata(METADATA, metadata)
        channels = {}
        for topic in topics:
            text = _schema_text(TOPICS[topic]).encode()
            schema = writer.register_schema(name=TOPICS[topic], encoding="ros2msg", data=text)
            channels[topic] = writer.register_channel(topic=topic, message_encoding="cdr", schema_id=schema)
        order = [
            (int(t), rank, i)
            for rank, (times, _) in enumerate(topics.values())
            for i, t in enumerate(times.tolist())
        ]
        names = list(topics)
        for t, rank, i in sorted(order):
            topic = names[rank]
            writer.add_message(
                channel_id=channels[topic], log_time=t, publish_time=t, sequence=i, data=topics[topic][1][i]
            )
        finish_file(writer)


# -------------------- reading

_RECORD = "record it again with `ros2 bag record --storage mcap`, or leave it out"
_BATCH = 1 << 22  # bytes of a topic that are decoded at once
_BATCH_MESSAGES = 1 << 15  # the same in messages: small ones take thirty times their bytes
_LAST_NS = 1 << 62  # the year 2116
_UPRIGHT = 0.7  # least cosine of a base's up axis to the vertical
_UNIT = 0.01  # a quaternion's length may be off by this
_MOST_GROUPS = 100  # structures of messages in a batch: sound logs have one for each publisher


def read_log(
    path: Path, stamps: IngestRobotLogStampsSettings | None = None, max_gap_s: float = np.inf
) -> RobotLog:
    """Read a robot log; times [s] since its first message, by the stamps of the messages where they have any.

    ``stamps`` is the slice ``ingest.robot_log.stamps`` of the configuration, by default that of an empty one. Joints in
    messages of their own are not interpolated over more than ``max_gap_s`` (``ingest.max_gap_s``). Memory is bounded by
    the numbers of the four topics, not by the file. Raises InputError where the file is truncated, a required topic is
    missing, or a message cannot be decoded as what its channel says it is.
    """
    path = Path(path)
    contents = Contents()
    start_ns, topics = _collect(path, contents)
    findings = contents.findings
    for topic in ("/odom", "/joint_states"):
        if topic not in topics:
            names = sorted({c.topic for c in contents.channels.values()})
            found = f"topics {', '.join(names[:50]) or 'none'}" + (", ..." if len(names) > 50 else "")
            expected, remedy = f"{topic} ({TOPICS[topic]})", "record the topic, or remap it"
            raise InputError(path, f"topic {topic}", found, expected, remedy, "topic_missing")
    stamped = [topic.stamped() for topic in topics.values() if topic.channel.topic != "/sync"]
    times, delays = choose_times(path, stamped, stamps or default_settings(), findings)
    for name, chosen in times.items():
        topics[name].time_ns = chosen
    del stamped, times
    base_time, table = topics.pop("/odom").table(start_ns)
    base = dict(zip(BASE_COLUMNS, table.T, strict=True))
    _unwrap(base["yaw"])
    joint_time, joints = _joints(path, start_ns, topics.pop("/joint_states"), findings, max_gap_s)
    wrench_time = wrench = sync = None
    if "/interface/wrench" in topics:
        forces = topics["/interface/wrench"].table(start_ns)
        wrench_time, wrench = _known_forces(path, forces[0], forces[1], findings)
    if "/sync" in topics:
        state = topics["/sync"].table(start_ns)
        sync = _edges(path, state[0], state[1], findings)
    else:
        findings.append(
            Finding("no_sync", "info", path.name, "/sync", "not in the log", "synchronised by motion")
        )
    if not np.isfinite(table).all():
        found = "values that are not finite"
        raise InputError(path, "topic /odom", found, "numbers", _RECORD, "not_finite")
    return RobotLog(
        start_ns, base_time, base, joint_time, joints, wrench_time, wrench, sync, findings, delays
    )


@dataclass
class Group:
    """Messages of one topic with the same joints: their numbers within the topic, and fields (n, items)."""

    index: np.ndarray
    names: tuple[str, ...]
    values: dict[str, np.ndarray]


@dataclass
class _Topic:
    """The messages of one topic: those that wait to be decoded, and the numbers of those that were."""

    path: Path
    channel: Channel
    waiting: list[bytes] = field(default_factory=list)
    bytes_waiting: int = 0
    count: int = 0
    logged: list[np.ndarray] = field(default_factory=list)
    logged_waiting: list[int] = field(default_factory=list)
    stamps: list[np.ndarray] = field(default_factory=list)
    time_ns: np.ndarray | None = None
    groups: list[Group] = field(default_factory=list)
    rows: bytearray = field(default_factory=bytearray)

    def add(self, logged: int, payload: bytes) -> None:
        self.waiting.append(payload)
        self.logged_waiting.append(logged)
        self.bytes_waiting += len(payload)
        if self.bytes_waiting > _BATCH or len(self.waiting) >= _BATCH_MESSAGES:
            self.flush()

    def flush(self) -> None:
        """Decode what waits. Raises InputError where a message is not what its channel says."""
        if not self.waiting:
            return
        type_name = TOPICS[self.channel.topic]
        groups = decode_messages(self.path, self.channel, type_name, self.waiting, self.count)
        stamps = np.zeros(len(self.waiting), np.int64)
        for group in groups:
            if "stamp" in group.values:
                stamps[group.index - self.count] = stamp_ns(*group.values["stamp"].T)
            group.values = _needed(self.path, self.channel.topic, group)
            group.index = group.index.astype(np.int32)
        self.stamps.append(stamps)
        if self.channel.topic == "/joint_states":
            self.groups.extend(groups)
        else:
            self._extend(groups)
        self.logged.append(np.array(self.logged_waiting, np.int64))
        self.count += len(self.waiting)
        self.waiting, self.logged_waiting, self.bytes_waiting = [], [], 0

    def stamped(self) -> StampedTopic:
        """Return the times of all messages; of joint states, those that the arm's joints are taken from are counted."""
        counted = np.ones(self.count, bool)
        if self.channel.topic == "/joint_states":
            counted[:] = False
            whole = _with_arm(self.groups)
            for group in whole or self.groups:
                counted[group.index] = bool(whole) or bool(set(ARM_JOINTS) & set(group.names))
        logged, stamps = np.concatenate(self.logged), np.concatenate(self.stamps)
        self.logged, self.stamps = [logged], []
        return StampedTopic(self.channel.topic, logged, stamps, counted)

    def times(self, start_ns: int) -> np.ndarray:
        """Return the times [s] of all messages in the order they came: those that were chosen, else log times."""
        time_ns = np.concatenate(self.logged) if self.time_ns is None else self.time_ns
        return (time_ns - start_ns) / 1e9

    def table(self, start_ns: int) -> tuple[np.ndarray, ...]:
        """Times [s] and the columns ``table`` of all messages, in the order of time."""
        return _in_order(self.times(start_ns), np.frombuffer(self.rows).reshape(self.count, -1))

    def _extend(self, groups: list[Group]) -> None:
        """Append the rows of a batch: one buffer that grows needs half the memory of a list of arrays."""
        table = np.full((len(self.waiting), groups[0].values["table"].shape[1]), np.nan)
        for group in groups:
            table[group.index - self.count] = group.values["table"]
        self.rows.extend(table.tobytes())


def _in_order(time_s: np.ndarray, *tables: np.ndarray) -> tuple[np.ndarray, ...]:
    """The same in the order of time; without a copy where they are."""
    if (time_s[1:] >= time_s[:-1]).all():
        return time_s, *tables
    order = np.argsort(time_s, kind="stable")
    return time_s[order], *(table[order] for table in tables)


def _collect(path: Path, contents: Contents) -> tuple[int, dict[str, _Topic]]:
    """First log time [ns], and the topics that we know, decoded."""
    topics: dict[str, _Topic] = {}
    start_ns: int | None = None
    for message in read_messages(path, contents):
        if message.log_time >= _LAST_NS:
            found = f"a message at {message.log_time} ns"
            raise InputError(path, f"topic {message.channel.topic}", found, "a time", _RECORD, "damaged")
        start_ns = message.log_time if start_ns is None else min(start_ns, message.log_time)
        name = message.channel.topic
        if name not in TOPICS:
            continue
        topic = topics.get(name)
        if topic is None:
            _check_channel(path, message.channel)
            topic = topics[name] = _Topic(path, message.channel)
        elif topic.channel != message.channel:
            check_same_messages(path, topic.channel, message.channel)
        topic.add(message.log_time, message.data)
    if start_ns is None:
        expected = "a log with /odom and /joint_states"
        raise InputError(path, "", "no message", expected, _RECORD, "no_data")
    for topic in topics.values():
        topic.flush()
    if contents.backwards:
        message_ = f"{contents.backwards} steps back in time"
        finding = Finding("log_order", "info", path.name, "", message_, "ordered by log time")
        contents.findings.append(finding)
    return start_ns, topics


def _check_channel(path: Path, channel: Channel) -> None:
    place, expected = f"topic {channel.topic}", f"{TOPICS[channel.topic]} in CDR, JSON or protobuf"
    if channel.message_encoding == "cdr" and channel.schema_encoding == "ros2msg":
        if channel.schema_name != TOPICS[channel.topic]:
            remedy = "remap the topic, or record the right one"
            raise InputError(path, place, channel.schema_name, expected, remedy, "message_type")
    elif channel.message_encoding not in ("json", "protobuf"):
        found = f"encoding {channel.message_encoding!r}, schema {channel.schema_encoding!r}"
        remedy = "this encoding is not read: convert the log with `ros2 bag convert` to CDR"
        raise InputError(path, place, found, expected, remedy, "encoding")


def check_same_messages(path: Path, first: Channel, other: Channel) -> None:
    """Refuse two channels of one topic (two publishers) that carry different kinds of message."""
    kinds = [(c.message_encoding, c.schema_name, c.schema_encoding, c.schema_data) for c in (first, other)]
    if kinds[0] != kinds[1]:
        found = f"channels {first.id} and {other.id} with different messages"
        remedy = "record one of the two publishers"
        raise InputError(path, f"topic {first.topic}", found, "one kind of message", remedy, "message_type")


# -------------------- decoding of a batch


def decode_messages(
    path: Path, channel: Channel, type_name: str, payloads: list[bytes], before: int
) -> list[Group]:
    """Return messages of one topic as groups of the same joints, with the numbers of their fields.

    ``type_name`` is the ROS type whose fields are read, ``before`` the number of messages that came before these.
    Raises InputError where a message is not what its channel says, or where hardly two messages are alike.
    """
    decode = _decode_cdr if channel.message_encoding == "cdr" else _decode_any
    return decode(path, channel, type_name, payloads, before)


def _check_alike(path: Path, channel: Channel, groups: int) -> None:
    """Refuse messages of many structures: each group costs as much time and memory as thousands of messages."""
    if groups > _MOST_GROUPS:
        found = f"more than {_MOST_GROUPS} different lists of names or counts of numbers among its messages"
        expected, remedy = "messages of a few publishers", "record the topic with one publisher"
        raise InputError(path, f"topic {channel.topic}", found, expected, remedy, "message_kinds")


def _decode_cdr(
    path: Path, channel: Channel, type_name: str, payloads: list[bytes], before: int
) -> list[Group]:
    """Messages of one topic, in groups of one structure (same strings, same counts)."""
    groups: list[Group] = []
    rest = np.arange(len(payloads))
    try:
        if before == 0:
            _check_against_definition(type_name, payloads[0], channel)
        while len(rest):
            first = payloads[rest[0]]
            layout = _layout(type_name, first)
            same = np.array([i for i in rest if len(payloads[i]) == len(first)])
            table = np.frombuffer(b"".join(payloads[i] for i in same), np.uint8).reshape(len(same), -1)
            alike = np.ones(len(same), bool)
            for begin, end in layout.structure:
                alike &= (table[:, begin:end] == table[0, begin:end]).all(axis=1)
            values = {}
            for name, (at, count) in layout.items.items():
                size, kind = (1, "u1") if type_name == BOOL else (8, "<f8")
                if name == "stamp":
                    seconds, rest_ns = (np.ascontiguousarray(table[alike, i : i + 4]) for i in (at, at + 4))
                    values[name] = np.hstack([seconds.view("<i4").astype(np.int64), rest_ns.view("<u4")])
                elif not name.endswith("_covariance"):
                    columns = np.ascontiguousarray(table[alike, at : at + size * count])
                    values[name] = (
                        columns.view(kind).reshape(-1, count) if count else np.zeros((alike.sum(), 0))
                    )
            names = tuple(layout.strings.get("name", ()))
            groups.append(Group(same[alike] + before, names, values))
            rest = np.setdiff1d(rest, same[alike], assume_unique=True)
            _check_alike(path, channel, len(groups))
    except (ValueError, struct.error, UnicodeDecodeError, IndexError) as error:
        code = error.code if isinstance(error, Undecodable) else "payload"
        raise _not_what_it_says(path, channel, type_name, before + int(rest[0]), error, code) from error
    return groups


def _not_what_it_says(
    path: Path, channel: Channel, type_name: str, index: int, error: Exception, code: str
) -> InputError:
    place = f"topic {channel.topic}, message {index + 1}"
    found = f"a message that is not what its channel says ({error})"
    expected = f"{type_name} in {channel.message_encoding}"
    return InputError(path, place, found, expected, _RECORD, code)


def _check_against_definition(type_name: str, payload: bytes, channel: Channel) -> None:
    """Compare our layout with the definition in the file: a type of the same name may have other fields."""
    theirs = list(_numbers(decoder(channel)(payload)))
    layout = _layout(type_name, payload)
    ours: list[float] = []
    for name, (at, count) in layout.items.items():
        kind = "<iI" if name == "stamp" else f"<{count}{'B' if type_name == BOOL else 'd'}"
        ours.extend(struct.unpack_from(kind, payload, at))
    if not np.array_equal(np.array(ours, float), np.array(theirs, float), equal_nan=True):
        raise ValueError("its definition has other fields than the ROS type of that name")


def _numbers(value: Any) -> Iterator[float]:
    # every number of a decoded message, in the order of its fields
    if isinstance(value, str):
        return
    if hasattr(value, "__slots__") or hasattr(value, "__dict__"):
        for name in value.__slots__:
            yield from _numbers(getattr(value, name))
    elif isinstance(value, (int, float)):
        yield value
    else:
        for item in value:
            yield from _numbers(item)


def _decode_any(
    path: Path, channel: Channel, type_name: str, payloads: list[bytes], before: int
) -> list[Group]:
    """Messages in JSON or protobuf, one by one, in groups of the same joints."""
    try:
        decode = decoder(channel)
    except Undecodable as error:
        raise _not_what_it_says(path, channel, type_name, before, error, error.code) from error
    rows: dict[tuple[Any, ...], list[tuple[int, dict[str, list[float]]]]] = {}
    for i, payload in enumerate(payloads):
        try:
            names, values = _fields(type_name, decode(payload))
        except Undecodable as error:
            raise _not_what_it_says(path, channel, type_name, before + i, error, error.code) from error
        key = names, *(len(v) for v in values.values())
        rows.setdefault(key, []).append((before + i, values))
        _check_alike(path, channel, len(rows))
    out = []
    for (joints, *_), group in rows.items():
        index = np.array([i for i, _ in group])
        tables = {
            name: np.array([v[name] for _, v in group], float).reshape(len(group), -1) for name in group[0][1]
        }
        out.append(Group(index, joints, tables))
    return out


_XYZ = ("x", "y", "z")


def _fields(type_name: str, message: Any) -> tuple[tuple[str, ...], dict[str, list[float]]]:
    """Joint names, and the numbers of one message by field. Raises Undecodable where one is missing."""
    if type_name == ODOMETRY:
        pose, twist = _inner(message, "pose"), _inner(message, "twist")
        return (), {
            "stamp": _stamp(message),
            "position": _vector(_member(pose, "position"), ("x", "y")),
            "orientation": _vector(_member(pose, "orientation"), (*_XYZ, "w")),
            "linear": _vector(_member(twist, "linear"), ("x", "y")),
            "angular": [0.0, 0.0, *_vector(_member(twist, "angular"), ("z",))],
        }
    if type_name == WRENCH:
        wrench = _member(message, "wrench")
        return (), {
            "stamp": _stamp(message),
            "force": _vector(_member(wrench, "force"), _XYZ),
            "torque": _vector(_member(wrench, "torque"), _XYZ),
        }
    if type_name == BOOL:
        data = _member(message, "data")
        if not isinstance(data, bool):
            raise Undecodable(f"data is {data!r}, no truth value")
        return (), {"data": [float(data)]}
    names = _list(_member(message, "name"), "name")
    if not all(isinstance(name, str) for name in names):
        raise Undecodable("joint names that are no text")
    position = [_scalar(v, "position") for v in _list(_member(message, "position"), "position")]
    velocity = [_scalar(v, "velocity") for v in _list(_member(message, "velocity", []), "velocity")]
    effort = [_scalar(v, "effort") for v in _list(_member(message, "effort", []), "effort")]
    stamp = _stamp(message)
    return tuple(names), {"stamp": stamp, "position": position, "velocity": velocity, "effort": effort}


def _stamp(message: Any) -> list[float]:
    """Seconds and nanoseconds of ``header.stamp`` by the names of ROS 2, ROS 1 or protobuf; 0, 0 without one."""
    header = _member(message, "header", None)
    stamp = None if header is None else _member(header, "stamp", None)
    if stamp is None:
        return [0.0, 0.0]
    fields = []
    for names in (("sec", "secs", "seconds"), ("nanosec", "nsec", "nsecs", "nanos")):
        given = (_member(stamp, name, None) for name in names)
        value = next((value for value in given if value is not None), 0)
        fields.append(_scalar(value, f"header.stamp.{names[0]}"))
    return fields


def _inner(message: Any, name: str) -> Any:
    """``pose.pose`` of an Odometry, or ``pose`` where a log leaves out the level of the covariance."""
    outer = _member(message, name)
    inner = _member(outer, name, None)
    return outer if inner is None else inner


_REQUIRED = object()


def _member(message: Any, name: str, default: Any = _REQUIRED) -> Any:
    """A field of a JSON object or protobuf message; proto3 leaves a scalar out that is zero, never a part."""
    if isinstance(message, dict):
        value = message.get(name, _REQUIRED)
    else:
        descriptor = getattr(message, "DESCRIPTOR", None)
        member = descriptor.fields_by_name.get(name) if descriptor is not None else None
        value = _REQUIRED
        if member is not None and not (_is_part(member) and not message.HasField(name)):
            value = getattr(message, name)
    if value is _REQUIRED:
        if default is _REQUIRED:
            raise Undecodable(f"no field {name}", "field_missing")
        return default
    return value


def _is_part(member: Any) -> bool:
    """Return whether a protobuf field is one message."""
    repeated = member.is_repeated if hasattr(member, "is_repeated") else member.label == member.LABEL_REPEATED
    return member.message_type is not None and not repeated


def _vector(message: Any, names: tuple[str, ...]) -> list[float]:
    return [_scalar(_member(message, name), name) for name in names]


def _scalar(value: Any, name: str) -> float:
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        raise Undecodable(f"{name} is {value!r}, no number"[:100])
    try:
        return float(value)
    except OverflowError:
        raise Undecodable(f"{name} is no number that fits") from None


def _list(value: Any, name: str) -> list[Any]:
    if isinstance(value, (str, bytes, dict)) or not hasattr(value, "__len__"):
        raise Undecodable(f"{name} is no list")
    return list(value)


# -------------------- numbers


def _needed(path: Path, topic: str, group: Group) -> dict[str, np.ndarray]:
    """Of a group's fields, what a RobotLog holds."""
    values = group.values
    if topic == "/odom":
        x, y, z, w = values["orientation"].T
        with np.errstate(over="ignore"):  # an infinite length is none of a rotation, and refused
            length = np.sqrt(x * x + y * y + z * z + w * w)
        if not (np.abs(length - 1) < _UNIT).all():
            index = int(group.index[np.argmax(~(np.abs(length - 1) < _UNIT))]) + 1
            place, found = f"topic {topic}, message {index}", "an orientation that is no unit quaternion"
            raise InputError(path, place, found, "x, y, z, w of length 1", _RECORD, "quaternion")
        lies = 1 - 2 * (x * x + y * y) < _UPRIGHT
        if lies.any():
            index = int(group.index[np.argmax(lies)]) + 1
            place, found = f"topic {topic}, message {index}", "an orientation that is not about the vertical"
            expected = "x, y, z, w of a base that stands on its wheels: x and y near 0"
            remedy = "Correct the publisher; w may stand first there."
            raise InputError(path, place, found, expected, remedy, "quaternion")
        yaw = np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
        parts = (values["position"][:, :2], yaw[:, None], values["linear"][:, :2], values["angular"][:, 2:])
        return {"table": np.hstack(parts)}
    if topic == "/interface/wrench":
        return {"table": np.hstack([values["force"], values["torque"]])}
    if topic == "/sync":
        return {"table": values["data"].astype(float)}
    return {"position": values["position"].copy(), "velocity": values["velocity"].copy()}


def _with_arm(groups: list[Group]) -> list[Group]:
    """Groups of messages that hold all joints of the arm."""
    return [g for g in groups if set(ARM_JOINTS) <= set(g.names)]


def _known_forces(
    path: Path, time_s: np.ndarray, wrench: np.ndarray, findings: list[Finding]
) -> tuple[np.ndarray | None, np.ndarray | None]:
    """Times (n,) and forces (n, 6) without messages that hold no number, as a sensor sends while it starts.

    None where none does.
    """
    known = np.isfinite(wrench).all(axis=1)
    if not known.all():
        message = f"{int((~known).sum())} of {len(known)} messages with values that are not finite"
        findings.append(
            Finding("wrench_not_finite", "warning", path.name, "/interface/wrench", message, "left out")
        )
    return (time_s[known], wrench[known]) if known.any() else (None, None)


def _joints(
    path: Path, start_ns: int, topic: _Topic, findings: list[Finding], max_gap_s: float
) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """Position and velocity of each joint that every message with the arm's joints carries."""
    groups = topic.groups
    with_arm = _with_arm(groups)
    if not with_arm:
        return _split_joints(path, start_ns, topic, findings, max_gap_s)
    if len(with_arm) < len(groups):
        left = sum(len(g.index) for g in groups) - sum(len(g.index) for g in with_arm)
        message = f"{left} messages without the arm's joints"
        findings.append(Finding("joint_subset", "info", path.name, "/joint_states", message, "left out"))
    _check_names(path, with_arm)
    names = [n for n in with_arm[0].names if all(n in g.names for g in with_arm)]
    index = np.concatenate([g.index for g in with_arm])
    time_s = topic.times(start_ns)
    places = None
    if len(with_arm) < len(groups) or (np.diff(index) < 0).any():
        places = np.argsort(index, kind="stable")
        time_s = time_s[index[places]]
    del index
    values = []
    for name in names:
        column = np.concatenate([_joint(path, name, group) for group in with_arm])
        values.append(column if places is None else column[places])
    groups.clear()
    time_s, *values = _in_order(time_s, *values)
    joints = dict(zip(names, values, strict=True))
    _check_positions(path, joints)
    return time_s, joints


def _split_joints(
    path: Path, start_ns: int, topic: _Topic, findings: list[Finding], max_gap_s: float
) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """Position and velocity of the arm's joints that come in different messages, at the times of the rarest joint.

    As where each controller publishes its own joint. Times in a gap of more than ``max_gap_s`` of another joint are
    left out.
    """
    groups = topic.groups
    if not set(ARM_JOINTS) <= {name for g in groups for name in g.names}:
        found = f"joints {', '.join(sorted({n for g in groups for n in g.names})[:20]) or 'none'}"
        expected, remedy = ", ".join(ARM_JOINTS), "name the arm's joints so in the URDF"
        raise InputError(path, "topic /joint_states", found, expected, remedy, "joint_missing")
    _check_names(path, groups)
    times, series = topic.times(start_ns), {}
    for name in ARM_JOINTS:
        own = [g for g in groups if name in g.names]
        index = np.concatenate([g.index for g in own])
        values = np.concatenate([_joint(path, name, g) for g in own])
        time_s, first = np.unique(times[index], return_index=True)
        series[name] = time_s, values[first]
    _check_positions(path, {name: values for name, (_, values) in series.items()})
    rarest = min(series, key=lambda name: len(series[name][0]))
    if len(series[rarest][0]) < 2:
        found, expected = (
            f"a single message with {rarest}",
            "messages throughout the log, as of the other joints",
        )
        remedy = "let its publisher repeat the position, or take the log away: a trial may have none"
        raise InputError(path, "topic /joint_states", found, expected, remedy, "joint_missing")
    at = series[rarest][0]
    # a joint without velocities has positions all the same
    joints = {
        name: np.column_stack([signals.resample(time_s, column, at, max_gap_s) for column in values.T])
        for name, (time_s, values) in series.items()
    }
    known = np.all([np.isfinite(values[:, 0]) for values in joints.values()], axis=0)
    shared = [(time_s[0], time_s[-1]) for time_s, _ in series.values()]
    within = (at >= max(first for first, _ in shared)) & (at <= min(last for _, last in shared))
    left = int((within & ~known).sum())
    message, action = "the arm's joints come in different messages", f"joined at the times of {rarest}"
    if left:
        message += f"; at {left} of {int(within.sum())} times another joint has none within {max_gap_s:g} s"
        action += ", these left out"
    severity = "warning" if left else "info"
    findings.append(Finding("joint_split", severity, path.name, "/joint_states", message, action))
    groups.clear()
    return at[known], {name: values[known] for name, values in joints.items()}


def _check_names(path: Path, groups: list[Group]) -> None:
    """Refuse a message that holds a joint twice."""
    if any(len(set(g.names)) < len(g.names) for g in groups):
        found, remedy = "a joint twice in one message", "name the joints apart"
        raise InputError(path, "topic /joint_states", found, "each joint once", remedy, "names")


def _check_positions(path: Path, joints: dict[str, np.ndarray]) -> None:
    """Refuse positions (n, 2) of the arm's joints that are no numbers."""
    if not all(np.isfinite(joints[name][:, 0]).all() for name in ARM_JOINTS):
        found = "positions that are not finite"
        raise InputError(path, "topic /joint_states", found, "numbers", _RECORD, "not_finite")


def _joint(path: Path, name: str, group: Group) -> np.ndarray:
    """Position and velocity (n, 2) of one joint; velocity NaN where the message carries none."""
    column, n = group.names.index(name), len(group.names)
    position, velocity = group.values["position"], group.values["velocity"]
    if position.shape[1] != n or velocity.shape[1] not in (0, n):
        found = f"{n} names, {position.shape[1]} positions, {velocity.shape[1]} velocities"
        expected = "as many positions as names"
        raise InputError(path, "topic /joint_states", found, expected, _RECORD, "joint_count")
    rate = velocity[:, column] if velocity.shape[1] else np.full(len(position), np.nan)
    return np.column_stack([position[:, column], rate])


def _unwrap(angle: np.ndarray) -> None:
    """Take the jumps of a whole turn out of an angle [rad], in place: np.unwrap takes six copies."""
    turns = np.diff(angle)
    turns /= 2 * np.pi
    np.rint(turns, out=turns)
    np.cumsum(turns, out=turns)
    turns *= 2 * np.pi
    angle[1:] -= turns


def _edges(path: Path, time_s: np.ndarray, table: np.ndarray, findings: list[Finding]) -> np.ndarray:
    """Times [s] at which /sync rises."""
    state = table[:, 0] > 0
    rising = np.flatnonzero(state[1:] & ~state[:-1]) + 1
    if state[0]:
        message = "true from the first message on: the edge lies before the log"
        findings.append(Finding("sync_high", "warning", path.name, "/sync", message, "that edge is not used"))
    return time_s[rising]
