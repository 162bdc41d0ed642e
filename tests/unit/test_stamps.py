"""A robot log is read by the stamps of its messages where these can be used, and by log time elsewhere."""

import json
from dataclasses import replace

import numpy as np
import pyarrow.parquet
import pytest
from handmade_person import SETTINGS, write_person
from real2sim.errors import InputError
from real2sim.recording.formats import detect, robot_log
from real2sim.recording.formats.robot_log import ARM_JOINTS
from real2sim.recording.ingest import ingest_subject

from tests.fuzz import seeds

SECOND = 10**9


def write_messages(path, messages):
    """Write messages (log time [ns], topic, payload) in the order of time."""
    from mcap.writer import Writer

    with path.open("wb") as stream:
        writer, channels = Writer(stream), {}
        writer.start(profile="ros2", library="test")
        for at, topic, payload in sorted(messages):
            if topic not in channels:
                kind = robot_log.TOPICS[topic]
                schema = writer.register_schema(kind, "ros2msg", robot_log._schema_text(kind).encode())
                channels[topic] = writer.register_channel(topic, "cdr", schema)
            writer.add_message(channels[topic], at, payload, at)
        writer.finish()


def write_log(path, log, *, delays=None, stamps=None):
    """Write a log whose topics arrive late: ``delays`` [s] and a change of ``stamps`` (n,) [ns] by topic."""
    messages = []
    for topic, (logged, payloads) in robot_log._messages(log).items():
        delay = np.broadcast_to((delays or {}).get(topic, 0.0), len(logged))
        change = (stamps or {}).get(topic, lambda stamp: stamp)
        for time, payload, late, stamp in zip(logged, payloads, delay, change(logged), strict=True):
            if topic != "/sync":
                seconds, rest = divmod(int(stamp), SECOND)
                payload = payload[:4] + np.array([seconds, rest], "<u4").tobytes() + payload[12:]
            messages.append((int(time) + round(late * SECOND), topic, payload))
    write_messages(path, messages)


def lasting_log(n=600):
    """Six seconds: a clock that stands still is none."""
    rng = np.random.default_rng(3)
    t = np.arange(n) / 100
    base = {name: rng.normal(size=n) for name in robot_log.BASE_COLUMNS}
    joints = {name: rng.normal(size=(n, 2)) for name in ARM_JOINTS}
    return replace(seeds.robot_log(), base_time_s=t, base=base, joint_time_s=t, joints=joints, wrench=None)


@pytest.fixture
def log():
    return lasting_log()


def codes(read):
    return [(f.code, f.severity, f.place) for f in read.findings]


def test_stamps_undo_the_delay_of_a_topic(tmp_path, log):
    write_log(tmp_path / "a.mcap", log, delays={"/joint_states": 0.05})
    read = detect.read_log(tmp_path / "a.mcap")
    np.testing.assert_allclose(read.joint_time_s, log.joint_time_s, atol=1e-9)
    np.testing.assert_allclose(read.base_time_s, log.base_time_s, atol=1e-9)
    np.testing.assert_allclose(read.sync_s, log.sync_s, atol=1e-9)
    np.testing.assert_array_equal(read.joints["arm_roll"], log.joints["arm_roll"])
    assert read.delays["/joint_states"].median_s == pytest.approx(0.05)
    assert read.delays["/odom"].median_s == 0
    assert read.findings == []


def test_stamps_undo_a_delay_that_varies(tmp_path, log):
    late = np.random.default_rng(1).uniform(0, 0.03, len(log.joint_time_s))
    write_log(tmp_path / "a.mcap", log, delays={"/joint_states": late})
    read = detect.read_log(tmp_path / "a.mcap")
    np.testing.assert_allclose(read.joint_time_s, log.joint_time_s, atol=1e-9)
    assert 0.025 < read.delays["/joint_states"].spread_s < 0.03


@pytest.mark.parametrize("epoch_s", [0.25, -0.25, -999_999_999.0, 300_000_000.0])
def test_a_delay_that_all_topics_share_is_that_of_the_clock(tmp_path, log, epoch_s):
    """Also of a clock of another epoch: topics keep their order, and /sync, which has no stamp, fits them."""
    shift = round(epoch_s * SECOND)
    stamps = dict.fromkeys(("/odom", "/joint_states"), lambda stamp: stamp + shift)
    write_log(tmp_path / "a.mcap", log, delays={"/joint_states": 0.05}, stamps=stamps)
    read = detect.read_log(tmp_path / "a.mcap")
    np.testing.assert_allclose(read.base_time_s, log.base_time_s, atol=1e-6)
    np.testing.assert_allclose(read.joint_time_s, log.joint_time_s, atol=1e-6)
    np.testing.assert_allclose(read.sync_s, log.sync_s, atol=1e-9)
    assert read.delays["/joint_states"].beyond_clock_s == pytest.approx(0.05)
    other = [("stamps_other_clock", "info", topic) for topic in ("/joint_states", "/odom")]
    assert sorted(codes(read)) == (other if abs(epoch_s) > 1 else [])


@pytest.mark.parametrize(
    ("change", "code"),
    [
        (lambda stamp: stamp * 0, ("stamps_absent", "info")),
        (lambda stamp: stamp * 0 + stamp[0], ("stamps_unusable", "warning")),
        (lambda stamp: np.where(np.arange(len(stamp)) % 2, stamp, 0), ("stamps_unusable", "warning")),
        (lambda stamp: stamp[0] + 3 * (stamp - stamp[0]), ("stamps_unusable", "warning")),
    ],
    ids=["zero", "stands still", "half of them zero", "runs at another rate"],
)
def test_log_time_where_stamps_cannot_be_used(tmp_path, log, change, code):
    write_log(tmp_path / "a.mcap", log, stamps={"/joint_states": change})
    read = detect.read_log(tmp_path / "a.mcap")
    np.testing.assert_allclose(read.joint_time_s, log.joint_time_s, atol=1e-9)
    assert codes(read) == [(*code, "/joint_states")]
    assert list(read.delays) == ["/odom"]


def test_single_stamps_that_are_far_away_or_missing(tmp_path, log):
    def change(stamp):
        stamp = stamp.copy()
        stamp[[5, 50]] = 0, stamp[50] + 3600 * SECOND
        return stamp

    write_log(tmp_path / "a.mcap", log, delays={"/joint_states": 0.05}, stamps={"/joint_states": change})
    read = detect.read_log(tmp_path / "a.mcap")
    np.testing.assert_allclose(read.joint_time_s, log.joint_time_s, atol=1e-9)
    assert codes(read) == [("stamp_far", "warning", "/joint_states")]


def test_stamps_out_of_order_and_repeated(tmp_path, log):
    """Messages are ordered by stamp; one that repeats the stamp before it is left to ingest, which reports it."""
    late = np.zeros(len(log.joint_time_s))
    late[10] = 0.025
    repeat = {"/odom": lambda stamp: np.where(np.arange(len(stamp)) == 20, np.roll(stamp, 1), stamp)}
    write_log(tmp_path / "a.mcap", log, delays={"/joint_states": late}, stamps=repeat)
    read = detect.read_log(tmp_path / "a.mcap")
    np.testing.assert_allclose(read.joint_time_s, log.joint_time_s, atol=1e-9)
    np.testing.assert_array_equal(read.joints["arm_roll"], log.joints["arm_roll"])
    assert (np.diff(read.base_time_s) == 0).sum() == 1
    assert codes(read) == [("stamp_order", "info", "/joint_states")]


def test_other_publishers_of_joint_states_have_no_say(tmp_path, log):
    """A gripper that publishes on the same topic without stamps leaves the arm's stamps in use."""
    from mcap.reader import make_reader
    from mcap.writer import Writer

    write_log(tmp_path / "a.mcap", log, delays={"/joint_states": 0.05})
    kind = robot_log.JOINT_STATE
    values = {"position": np.zeros((600, 1)), "velocity": np.zeros((600, 1))}
    gripper = robot_log._payloads(
        kind, np.zeros(600, np.int64), {"frame_id": [""], "name": ["gripper"]}, values
    )
    with (tmp_path / "a.mcap").open("rb") as source, (tmp_path / "b.mcap").open("wb") as stream:
        writer, channels = Writer(stream), {}
        writer.start(profile="ros2", library="test")
        for _, channel, message in make_reader(source).iter_messages():
            if channel.topic not in channels:
                name = robot_log.TOPICS[channel.topic]
                schema = writer.register_schema(name, "ros2msg", robot_log._schema_text(name).encode())
                channels[channel.topic] = writer.register_channel(channel.topic, "cdr", schema)
            number = channels[channel.topic]
            writer.add_message(number, message.log_time, message.data, message.log_time)
            if channel.topic == "/joint_states":
                writer.add_message(number, message.log_time, gripper.pop(), message.log_time)
        writer.finish()
    read = detect.read_log(tmp_path / "b.mcap")
    np.testing.assert_allclose(read.joint_time_s, log.joint_time_s, atol=1e-9)
    assert [code for code, _, _ in codes(read)] == ["joint_subset"]


def write_split_log(path, log, *, late, lost=None, rare=""):
    """Write a log with each of the arm's joints in a message of its own, ``late`` [s] after the base.

    ``lost``: joint without messages between two times [s]; ``rare``: joint with every other message alone.
    """
    messages = [
        (int(at), "/odom", payload)
        for at, payload in zip(*robot_log._messages(replace(log, sync_s=None))["/odom"], strict=True)
    ]
    kind = robot_log.TOPICS["/joint_states"]
    for name, delay in late.items():
        t = log.joint_time_s + delay
        keep = np.ones(len(t), bool) if lost is None or name != lost[0] else ~((t > lost[1]) & (t < lost[2]))
        keep[1::2] &= name != rare
        wave = np.column_stack([np.sin(2 * t + delay), 2 * np.cos(2 * t + delay)])[keep]
        stamps = log.start_ns + np.rint(t[keep] * 1e9).astype(np.int64)
        values = {"position": wave[:, :1], "velocity": wave[:, 1:]}
        payloads = robot_log._payloads(kind, stamps, {"frame_id": [""], "name": [name]}, values)
        messages += [
            (int(at), "/joint_states", payload) for at, payload in zip(stamps, payloads, strict=True)
        ]
    write_messages(path, messages)


def test_joints_that_each_controller_publishes_alone_are_joined(tmp_path, log):
    late = {"arm_lift": 0.0, "arm_roll": 0.003, "arm_pitch": 0.006}
    write_split_log(tmp_path / "a.mcap", log, late=late)
    read = detect.read_log(tmp_path / "a.mcap")
    assert ("joint_split", "info", "/joint_states") in codes(read)
    t = read.joint_time_s
    assert len(t) >= len(log.joint_time_s) - 2
    for name, delay in late.items():
        np.testing.assert_allclose(read.joints[name][:, 0], np.sin(2 * t + delay), atol=1e-6)
        np.testing.assert_allclose(read.joints[name][:, 1], 2 * np.cos(2 * t + delay), atol=1e-5)


def test_a_joint_that_falls_silent_is_not_made_up(tmp_path, log):
    late = {"arm_lift": 0.0, "arm_roll": 0.003, "arm_pitch": 0.006}
    write_split_log(tmp_path / "a.mcap", log, late=late, lost=("arm_roll", 2.0, 3.0))
    read = detect.read_log(tmp_path / "a.mcap")
    assert ("joint_split", "info", "/joint_states") in codes(read)
    t = read.joint_time_s
    assert not ((t > 2.01) & (t < 2.99)).any()
    assert ((t > 1.9) & (t < 2.0)).any()
    assert ((t > 3.0) & (t < 3.1)).any()


def test_times_at_which_a_more_frequent_joint_is_silent_are_left_out_and_counted(tmp_path, log):
    late = {"arm_lift": 0.0, "arm_roll": 0.003, "arm_pitch": 0.006}
    write_split_log(tmp_path / "a.mcap", log, late=late, lost=("arm_roll", 2.0, 3.0), rare="arm_lift")
    read = detect.read_log(tmp_path / "a.mcap", max_gap_s=0.2)
    (split,) = (f for f in read.findings if f.code == "joint_split")
    assert split.severity == "warning"
    # a message every 20 ms, from the last one before the second without to the first one after
    assert "at 51 of 299 times another joint has none within 0.2 s" in split.message
    assert not ((read.joint_time_s > 2.01) & (read.joint_time_s < 2.99)).any()


def test_joints_that_come_in_bursts_are_known_between_them(tmp_path, log):
    """Ten messages a millisecond apart, then none for a while: as of a driver that flushes its queue."""
    bursts = (np.arange(60)[:, None] * 0.1 + np.arange(10) * 0.001).ravel()
    late = {"arm_lift": 0.0, "arm_roll": 0.03, "arm_pitch": 0.05}
    write_split_log(tmp_path / "a.mcap", replace(log, joint_time_s=bursts), late=late)
    read = detect.read_log(tmp_path / "a.mcap")
    assert ("joint_split", "info", "/joint_states") in codes(read)
    assert len(read.joint_time_s) > 0.95 * len(bursts)
    t = read.joint_time_s
    np.testing.assert_allclose(read.joints["arm_pitch"][:, 0], np.sin(2 * t + 0.05), atol=1e-3)


def test_a_joint_of_a_single_message_is_named(tmp_path, log):
    late = {"arm_lift": 0.0, "arm_roll": 0.003, "arm_pitch": 0.006}
    write_split_log(tmp_path / "a.mcap", log, late=late, lost=("arm_roll", 0.005, 9.0))
    with pytest.raises(InputError, match="a single message with arm_roll"):
        detect.read_log(tmp_path / "a.mcap")


def test_forces_that_are_no_numbers_are_left_out(tmp_path, log):
    forces = np.tile(np.arange(600.0)[:, None], (1, 6))
    forces[:50] = np.nan
    given = replace(log, wrench_time_s=log.base_time_s, wrench=forces)
    write_log(tmp_path / "a.mcap", given)
    read = detect.read_log(tmp_path / "a.mcap")
    assert codes(read) == [("wrench_not_finite", "warning", "/interface/wrench")]
    assert "50 of 600" in read.findings[0].message
    np.testing.assert_array_equal(read.wrench, forces[50:])
    np.testing.assert_allclose(read.wrench_time_s, log.base_time_s[50:], atol=1e-9)
    write_log(tmp_path / "b.mcap", replace(given, wrench=np.full_like(forces, np.nan)))
    assert detect.read_log(tmp_path / "b.mcap").wrench is None


@pytest.mark.parametrize("names", [("sec", "nanosec"), ("secs", "nsecs"), ("seconds", "nanos")])
def test_stamps_of_json_logs(tmp_path, monkeypatch, log, names):
    plain = seeds.json_messages

    def stamped(given):
        for topic, at, message in plain(given):
            message["header"] = {"stamp": dict(zip(names, divmod(at, SECOND), strict=True))}
            yield topic, at + (50_000_000 if topic == "/joint_states" else 0), message

    monkeypatch.setattr(seeds, "json_messages", stamped)
    seeds.write_json_log(tmp_path / "a.mcap", log)
    read = detect.read_log(tmp_path / "a.mcap")
    np.testing.assert_allclose(read.joint_time_s, log.joint_time_s, atol=1e-9)
    assert read.delays["/joint_states"].median_s == pytest.approx(0.05)


def test_joint_states_that_arrive_late_leave_the_interface_where_it_is(tmp_path):
    """The failure as a lab would see it: q_ry was off by 0.033 rad."""
    folder = write_person(tmp_path / "S01", trials=("neutral", "dynamic_1"))

    def pose(out):
        ingest_subject(subject="S01", folder=folder, settings=SETTINGS, raw=[], out=out)
        quality = json.loads((out / "dynamic_1" / "quality.json").read_text())
        return pyarrow.parquet.read_table(out / "dynamic_1" / "pose.parquet")["q_ry"].to_numpy(), quality

    before, quality = pose(tmp_path / "plain")
    assert quality["robot"]["stamp_delay_s"]["/odom"] == {"median": 0, "beyond_clock": 0, "spread": 0}
    path = folder / "dynamic_1.mcap"
    write_log(path, detect.read_log(path), delays={"/joint_states": 0.05})
    after, quality = pose(tmp_path / "late")
    np.testing.assert_allclose(after, before, atol=1e-6)
    warned = [(f["code"], f["place"]) for f in quality["findings"] if f["severity"] == "warning"]
    assert warned == [("stamp_delay", "/joint_states")]
    assert "logged 50.0 ms after its stamps" in next(
        f["message"] for f in quality["findings"] if f["code"] == "stamp_delay"
    )
