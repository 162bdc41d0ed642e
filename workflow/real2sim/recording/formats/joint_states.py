"""Joint states of any robot's log: positions and efforts of the joints that are asked for, by joint."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from real2sim.errors import InputError
from real2sim.recording.formats.mcap_file import Channel, Contents, read_messages
from real2sim.recording.formats.recordings import Finding
from real2sim.recording.formats.robot_log import JOINT_STATE, check_same_messages, decode_messages
from real2sim.recording.formats.stamps import (
    StampedTopic,
    choose_times,
    default_settings,
    large_delays,
    stamp_ns,
)

_BATCH = 1 << 22  # bytes of a topic that are decoded at once
_BATCH_MESSAGES = 1 << 15  # the same in messages: small ones take thirty times their bytes
_LAST_NS = 1 << 62  # the year 2116
_RECORD = "record it again with `ros2 bag record --storage mcap`"


@dataclass
class _Topic:
    """Messages of one topic: those that wait to be decoded, and of the others times [ns] and numbers of the joints.

    ``parts`` holds (joint, quantity, numbers of messages (k,), values (k,)).
    """

    channel: Channel
    waiting: list[bytes] = field(default_factory=list)
    bytes_waiting: int = 0
    count: int = 0
    logged: list[int] = field(default_factory=list)
    stamps: list[np.ndarray] = field(default_factory=list)
    used: list[np.ndarray] = field(default_factory=list)
    parts: list[tuple[str, str, np.ndarray, np.ndarray]] = field(default_factory=list)

    def flush(self, path: Path, joints: Collection[str]) -> None:
        """Decode what waits."""
        if not self.waiting:
            return
        stamps, used = np.zeros(len(self.waiting), np.int64), np.zeros(len(self.waiting), bool)
        for group in decode_messages(path, self.channel, JOINT_STATE, self.waiting, self.count):
            rows = group.index - self.count
            stamps[rows] = stamp_ns(*group.values["stamp"].T)
            columns = {name: i for i, name in enumerate(group.names) if name in joints}
            used[rows] = bool(columns)
            for quantity in ("position", "effort"):
                values = group.values[quantity]
                if values.shape[1] not in (0, len(group.names)):
                    found = f"{len(group.names)} names, {values.shape[1]} numbers of {quantity}"
                    expected, remedy = "as many numbers as names, or none", "correct the publisher"
                    place = f"topic {self.channel.topic}, message {int(group.index[0]) + 1}"
                    raise InputError(path, place, found, expected, remedy, "joint_count")
                if values.shape[1]:
                    index = group.index.astype(np.int32)
                    self.parts += [(n, quantity, index, values[:, i].copy()) for n, i in columns.items()]
        self.stamps.append(stamps)
        self.used.append(used)
        self.count += len(self.waiting)
        self.waiting, self.bytes_waiting = [], 0

    def stamped(self) -> StampedTopic:
        """Return the times of all messages; those with a joint that is asked for are counted."""
        logged = np.array(self.logged, np.int64)
        return StampedTopic(
            self.channel.topic, logged, np.concatenate(self.stamps), np.concatenate(self.used)
        )


def read_joint_states(
    path: Path, joints: Collection[str]
) -> tuple[dict[tuple[str, str], tuple[np.ndarray, np.ndarray]], list[Finding]]:
    """Return times (n,) [s] and values (n,) by joint and quantity ("position", "effort"), in order, and findings.

    Times are those of the stamps in the messages' headers laid on log time, and log time where there are none, as for
    the study's own robot (docs/quality-codes.md, times of a log). Every topic of sensor_msgs/JointState is read.
    Raises InputError where a message is not what its channel says.
    """
    contents = Contents()
    topics: dict[str, _Topic] = {}
    start_ns = None
    for message in read_messages(path, contents):
        if message.channel.schema_name.replace(".", "/").split("/")[-1] != "JointState":
            continue
        name = message.channel.topic
        if message.log_time >= _LAST_NS:
            found = f"a message at {message.log_time} ns"
            raise InputError(path, f"topic {name}", found, "a time", _RECORD, "damaged")
        start_ns = message.log_time if start_ns is None else min(start_ns, message.log_time)
        topic = topics.setdefault(name, _Topic(message.channel))
        check_same_messages(path, topic.channel, message.channel)
        topic.waiting.append(message.data)
        topic.logged.append(message.log_time)
        topic.bytes_waiting += len(message.data)
        if topic.bytes_waiting > _BATCH or len(topic.waiting) >= _BATCH_MESSAGES:
            topic.flush(path, joints)
    for topic in topics.values():
        topic.flush(path, joints)
    findings = contents.findings
    stamped = [topic.stamped() for topic in topics.values()]
    times, delays = choose_times(path, stamped, default_settings(), findings)
    findings += large_delays(path, delays, default_settings())
    return _series(topics, times, start_ns or 0), findings


def _series(
    topics: dict[str, _Topic], times: dict[str, np.ndarray], start_ns: int
) -> dict[tuple[str, str], tuple[np.ndarray, np.ndarray]]:
    """Times [s since the first message] and values by joint and quantity, in the order of time."""
    gathered: dict[tuple[str, str], list[tuple[np.ndarray, np.ndarray]]] = {}
    for name, topic in topics.items():
        time_s = (times[name] - start_ns) / 1e9
        for joint, quantity, index, values in topic.parts:
            gathered.setdefault((joint, quantity), []).append((time_s[index], values))
    out = {}
    for key, pieces in gathered.items():
        time_s, values = (np.concatenate(part) for part in zip(*pieces, strict=True))
        order = np.argsort(time_s, kind="stable")
        out[key] = time_s[order], values[order]
    return out
