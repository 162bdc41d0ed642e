"""Files of described systems: logs by their stamps, sites at their markers, damaged tables and odd models."""

from __future__ import annotations

import json
import os
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import real2sim as r2s
from mcap.writer import Writer
from real2sim.configuration import validated
from real2sim.diagnosis.described_trial import DescribedTrial
from real2sim.errors import InputError
from real2sim.recording.formats import robot_log
from real2sim.system.description import shipped
from real2sim.system.model_files import model_files
from real2sim.system.plant import load_robot
from real2sim.verification.systems import cuff

SECOND = 10**9
START_NS = 1_700_000_000 * SECOND
LIFT, ROLL = "arm_lift", "arm_roll"
ARM = """<mujoco><worldbody><body name="carriage">
  <inertial pos="0 0 0" mass="1" diaginertia="1 1 1"/>
  <joint name="arm_lift" type="slide"/><joint name="arm_roll" type="hinge"/>
</body></worldbody></mujoco>"""

CONTENT = {
    "name": "arm",
    "model": "arm.xml",
    "machine": {LIFT: {}, ROLL: {}},
    "interface": {"axes": {"x": {"joint": LIFT}}},
    "drive": {"by": "path", "of": {LIFT: "arm_lift_m"}},
    "parameters": {"k": {"unit": "N/m", "bounds": [1, 2], "sets": "stiffness", "of": "x"}},
}


@pytest.fixture
def system(tmp_path):
    """Two logged joints, one of which is driven along its path."""
    (tmp_path / "arm.xml").write_text(ARM)
    return r2s.System.from_dict(CONTENT, tmp_path / "system.yaml")


def motion(joint, t):
    return np.sin(2 * np.pi * t + (joint == ROLL))


def stamped(ns):
    return {"sec": int(ns) // SECOND, "nanosec": int(ns) % SECOND}


def write_json(path, messages):
    """Write joint states in JSON: (topic, log time [ns], message)."""
    with path.open("wb") as stream:
        writer, channels = Writer(stream), {}
        writer.start()
        schema = writer.register_schema("sensor_msgs/msg/JointState", "jsonschema", b"{}")
        for topic, logged, message in sorted(messages, key=lambda m: m[1]):
            if topic not in channels:
                channels[topic] = writer.register_channel(topic, "json", schema)
            data = json.dumps(message).encode()
            writer.add_message(channels[topic], int(logged), data, int(logged))
        writer.finish()
    return path


def two_topics(stamp, late_s, n=300):
    """Joint states of two topics at 100 Hz, those of arm_roll logged late; ``stamp`` maps joint, number, time."""
    for i in range(n):
        for joint in (LIFT, ROLL):
            at = START_NS + i * SECOND // 100
            logged = at + (round(late_s * SECOND) if joint == ROLL else 0)
            message = {"name": [joint], "position": [float(motion(joint, i / 100))]}
            given = stamp(joint, i, at)
            if given is not None:
                message["header"] = {"stamp": given}
            yield f"/{joint}", logged, message


def largest_error(recording):
    """Departure of both joints from their motion, from the first sample on which both were measured."""
    t = recording.time_s
    columns = {LIFT: "arm_lift_m", ROLL: "arm_roll_rad"}
    return max(float(np.abs(recording.columns[c] - motion(joint, t)).max()) for joint, c in columns.items())


EPOCH_NS = START_NS - 1000 * SECOND  # the robot's clock counts from its start


@pytest.mark.parametrize(
    "stamp",
    [
        pytest.param(lambda joint, i, at: stamped(at), id="stamped"),
        pytest.param(lambda joint, i, at: stamped(at - EPOCH_NS), id="by the robot's own clock"),
        pytest.param(lambda joint, i, at: None if i % 50 == 7 else stamped(at), id="some without a stamp"),
        pytest.param(
            lambda joint, i, at: {"secs": at // SECOND, "nsecs": at % SECOND}, id="stamps as ROS 1 has them"
        ),
    ],
)
def test_a_log_of_a_described_system_is_read_by_its_stamps(tmp_path, system, stamp):
    """By log time the joints are 50 ms apart, 0.3 rad; single stamps that are missing tear the clock."""
    path = write_json(tmp_path / "train.mcap", two_topics(stamp, 0.05))
    recording = r2s.Recording.read(system, path)
    assert largest_error(recording) < 0.01
    delays = [f for f in recording.findings if f.code == "stamp_delay"]
    assert [f.place for f in delays] == ["/arm_roll"]


def test_log_time_where_a_topic_has_no_stamps(tmp_path, system):
    def stamp(joint, i, at):
        return stamped(at - EPOCH_NS) if joint == LIFT else None

    path = write_json(tmp_path / "train.mcap", two_topics(stamp, 0.0))
    recording = r2s.Recording.read(system, path)
    assert len(recording.time_s) == pytest.approx(300, abs=2)
    assert largest_error(recording) < 0.01
    assert "stamps_absent" in {f.code for f in recording.findings}


@pytest.mark.parametrize(
    ("change", "code"),
    [
        ({"position": ["x"]}, "payload"),
        ({"position": [None]}, "payload"),
        ({"position": [1.0, 2.0]}, "joint_count"),
        ({"name": [3]}, "payload"),
        ({"header": {"stamp": {"sec": "now", "nanosec": 0}}}, "payload"),
    ],
)
def test_odd_joint_states_are_refused(tmp_path, system, change, code):
    messages = list(two_topics(lambda joint, i, at: stamped(at), 0.0, n=20))
    messages[5] = (*messages[5][:2], messages[5][2] | change)
    with pytest.raises(InputError) as caught:
        r2s.Recording.read(system, write_json(tmp_path / "train.mcap", messages))
    assert caught.value.code == code
    assert "topic /arm_roll" in caught.value.place


def test_cdr_and_json_give_the_same(tmp_path, system):
    t = np.arange(200) / 100
    joints = {name: np.column_stack([motion(name, t), t]) for name in (LIFT, ROLL)}
    base = {name: np.zeros(1) for name in robot_log.BASE_COLUMNS}
    log = robot_log.RobotLog(START_NS, np.zeros(1), base, t, joints)
    robot_log.write_log(tmp_path / "a.mcap", log)
    recording = r2s.Recording.read(system, tmp_path / "a.mcap")
    np.testing.assert_allclose(recording.columns["arm_lift_m"], motion(LIFT, t), atol=1e-6)
    assert largest_error(recording) < 1e-6


# -------------------- tables


@pytest.mark.parametrize("suffix", ["parquet", "csv", "mcap"])
def test_damaged_recordings_are_refused_with_a_code(tmp_path, system, suffix):
    path = tmp_path / f"train.{suffix}"
    t = np.arange(30) / 100
    table = pd.DataFrame({"time_s": t, "arm_lift_m": t, "arm_roll_rad": t})
    if suffix == "parquet":
        table.to_parquet(path)
    elif suffix == "csv":
        table.to_csv(path, index=False)
    else:
        write_json(path, two_topics(lambda joint, i, at: stamped(at), 0.0, n=30))
    raw = path.read_bytes()
    r2s.Recording.read(system, path)
    rng = np.random.default_rng(8)
    incomplete = []
    for _ in range(150):
        data = bytearray(raw)
        for _ in range(int(rng.integers(1, 5))):
            data[int(rng.integers(len(data)))] = int(rng.integers(256))
        path.write_bytes(bytes(data[: int(rng.integers(1, len(data) + 1))] if rng.random() < 0.3 else data))
        try:
            r2s.Recording.read(system, path)
        except InputError as error:
            incomplete += [] if error.code and error.remedy else [str(error)]
    assert not incomplete


@pytest.mark.parametrize(
    ("header", "rows", "code", "place"),
    [
        # names of rows, as R writes them; a comma in a cell; a cell that is missing
        ("time_s,arm_lift_m,arm_roll_rad", "{i},{t},{t},{t}", "row_cells", "line 2"),
        ("time_s,arm_lift_m,arm_roll_rad,note", "{t},{t},{t},a,b", "row_cells", "line 2"),
        ("time_s,arm_lift_m,arm_roll_rad,note", "{t},{t},{t}", "row_cells", "line 2"),
        ("time_s,arm_lift_m,arm_roll_rad,arm_lift_m", "{t},{t},{t},{t}", "names", "names of the columns"),
        ("time_s,arm_lift_m,arm_roll_rad", "{t},{t},1_000", "not_a_number", "column arm_roll_rad"),
        ("time_s,arm_lift_m,arm_roll_rad", "{t},{t},True", "not_a_number", "column arm_roll_rad"),
        ("time_s,arm_lift_m,arm_roll_rad", "{t},{t},inf", "not_finite", "column arm_roll_rad, sample 1"),
        ("time_s,arm_lift_m,arm_roll_rad", "{t},{t},1e300", "not_finite", "column arm_roll_rad, sample 1"),
    ],
)
def test_a_table_that_pandas_would_read_as_another_is_refused(tmp_path, system, header, rows, code, place):
    path = tmp_path / "train.csv"
    lines = [rows.format(i=i + 1, t=i / 100) for i in range(30)]
    path.write_text("\n".join([header, *lines]) + "\n")
    with pytest.raises(InputError) as caught:
        r2s.Recording.read(system, path)
    assert (caught.value.code, caught.value.place) == (code, place)


@pytest.mark.parametrize("index", ["time_s", "arm_lift_m"])
def test_an_index_of_pandas_in_a_parquet_file_is_a_column(tmp_path, system, index):
    t = np.arange(30) / 100
    table = pd.DataFrame({"time_s": t, "arm_lift_m": np.sin(t), "arm_roll_rad": np.arange(30)})
    table["arm_roll_rad"] = table["arm_roll_rad"].astype("Int64").where(table.index != 3)
    table.set_index(index).to_parquet(tmp_path / "train.parquet")
    recording = r2s.Recording.read(system, tmp_path / "train.parquet")
    assert np.array_equal(recording.time_s, t)
    assert np.array_equal(recording.columns["arm_lift_m"], np.sin(t))
    assert np.flatnonzero(np.isnan(recording.columns["arm_roll_rad"])).tolist() == [3]


def test_nothing_is_invented_where_messages_are_missing(tmp_path, system):
    messages = list(two_topics(lambda joint, i, at: stamped(at), 0.0, n=300))
    whole = r2s.Recording.read(system, write_json(tmp_path / "whole.mcap", messages))
    hole = [m for m in messages if not 1.0 < (m[1] - messages[0][1]) / SECOND < 1.5]
    recording = r2s.Recording.read(system, write_json(tmp_path / "hole.mcap", hole))
    column = recording.columns["arm_lift_m"]
    unknown = ~np.isfinite(column)
    assert 45 <= unknown.sum() <= 51
    known = np.isfinite(column)
    np.testing.assert_allclose(column[known], whole.columns["arm_lift_m"][: len(column)][known], atol=1e-3)
    # two messages in a row that are lost leave no hole
    few = [m for i, m in enumerate(messages) if i not in (100, 101, 102, 103)]
    recording = r2s.Recording.read(system, write_json(tmp_path / "few.mcap", few))
    assert np.isfinite(recording.columns["arm_lift_m"]).all()


def _log_of_a_second_of_roll(folder, system):
    """Read a log of 3 s in which arm_roll is published for a second."""
    messages = two_topics(lambda joint, i, at: stamped(at), 0.0, n=300)
    kept = [m for m in messages if m[0] == f"/{LIFT}" or m[1] < START_NS + SECOND]
    return r2s.Recording.read(system, write_json(folder / "train.mcap", kept))


def test_a_joint_that_nothing_reads_does_not_cut_a_log(tmp_path, system):
    """The description gives arm_roll a controller and says that it is not logged."""
    other = r2s.System.from_dict(
        CONTENT | {"machine": {LIFT: {}, ROLL: {"logged": False}}}, tmp_path / "system.yaml"
    )
    recording = _log_of_a_second_of_roll(tmp_path, other)
    assert (len(recording.time_s), recording.findings) == (300, ())


def test_a_log_that_is_cut_to_what_one_joint_covers_says_so(tmp_path, system):
    recording = _log_of_a_second_of_roll(tmp_path, system)
    (finding,) = recording.findings
    assert len(recording.time_s) == 100
    assert (finding.code, finding.severity, finding.place) == ("log_cut", "warning", "column arm_roll_rad")
    assert "0.99 s of 2.99 s" in finding.message


@pytest.mark.parametrize("make", [os.mkfifo, os.mkdir])
def test_what_is_no_recording_is_not_waited_for(tmp_path, system, make):
    make(tmp_path / "train.csv")
    with pytest.raises(InputError) as caught:
        r2s.Recording.read(system, tmp_path / "train.csv")
    assert caught.value.code == "no_file"


# -------------------- models


def test_a_pipe_in_the_place_of_a_model_is_not_waited_for(tmp_path):
    os.mkfifo(tmp_path / "part.xml")
    (tmp_path / "robot.xml").write_text('<mujoco><include file="part.xml"/></mujoco>')
    assert [p.name for p in model_files(tmp_path / "robot.xml")] == ["robot.xml", "part.xml"]
    for name in ("robot.xml", "part.xml"):
        with pytest.raises(InputError) as caught:
            load_robot(tmp_path / name)
        assert (caught.value.code, caught.value.path.name) == ("no_file", "part.xml")


@pytest.mark.parametrize("file", ["a.xml", "../{folder}/a.xml", "b.xml"])
def test_a_model_that_attaches_itself_is_refused_before_it_ends_the_process(tmp_path, file):
    """MuJoCo calls itself until its stack overflows."""
    attach = '<mujoco><asset><model name="m" file="{}"/></asset></mujoco>'
    (tmp_path / "a.xml").write_text(attach.format(file.format(folder=tmp_path.name)))
    (tmp_path / "b.xml").write_text('<mujoco><include file="c.xml"/></mujoco>')
    (tmp_path / "c.xml").write_text(attach.format("a.xml"))
    assert len(model_files(tmp_path / "a.xml")) == (3 if file == "b.xml" else 1)
    with pytest.raises(InputError) as caught:
        load_robot(tmp_path / "a.xml")
    assert caught.value.code == "model"
    assert "attaches itself" in caught.value.found


@pytest.mark.parametrize("head", ['<?xml version="1.0" encoding="UTF-16"?>', "<!-- a -- b -->"])
def test_parts_of_a_model_that_is_no_sound_xml_are_found(tmp_path, head):
    """MuJoCo reads both, and so crashed on those that attach themselves."""
    path = tmp_path / "robot.xml"
    path.write_text(f'{head}<mujoco><asset><model name="m" file="robot.xml"/></asset></mujoco>')
    with pytest.raises(InputError, match="attaches itself"):
        load_robot(path)
    path.write_text(f"{head}<mujoco><include file='part.xml'/><!-- <include file='old.xml'/> --></mujoco>")
    assert [p.name for p in model_files(path)] == ["robot.xml", "part.xml"]


@pytest.mark.parametrize(
    "text", ["x" * 200_000, "<!--" * 50_000, "<" + "a" * 200_000, '<a b="' + "c" * 200_000]
)
def test_what_is_no_xml_is_looked_through_quickly(tmp_path, text):
    (tmp_path / "robot.xml").write_text(f"<mujoco {text}>")
    start = time.process_time()
    assert len(model_files(tmp_path / "robot.xml")) == 1
    assert time.process_time() - start < 1


@pytest.mark.parametrize("name", ["a\0.xml", "a\ud800.xml"])
def test_a_name_that_no_file_can_have_is_refused(tmp_path, system, name):
    with pytest.raises(InputError) as caught:
        r2s.System.from_dict({**CONTENT, "model": name}, tmp_path / "system.yaml")
    assert (caught.value.code, caught.value.place) == ("value", "model")


@pytest.mark.parametrize(
    "text",
    [
        '<?xml version="1.0" encoding="none-such"?><mujoco/>',
        '<?xml version="1.0" encoding="shift_jis"?><mujoco/>',
        f'<mujoco><asset><mesh file="{"m" * 5000}.stl"/></asset></mujoco>',
    ],
    ids=["unknown encoding", "encoding of several bytes", "a name longer than any file's"],
)
def test_odd_models_have_files_all_the_same(tmp_path, text):
    path = tmp_path / "robot.xml"
    path.write_text(text)
    assert model_files(path)[0] == path


# -------------------- sites of a described system


@pytest.fixture(scope="module")
def cuff_recordings(tmp_path_factory):
    folder = tmp_path_factory.mktemp("cuff")
    cuff.simulate(None, 0.0, 1, folder, duration_s=3.2)
    system = r2s.System.from_yaml(shipped("cuff") / "system.yaml")
    return system, *(r2s.Recording.read(system, folder / f"{name}.parquet") for name in ("train", "quiet"))


@pytest.mark.parametrize("pair", [("CUF_A", "CUF_B"), ("CUF_A", "CUF_C"), ("CUF_B", "CUF_C")])
def test_exchanged_sites_of_a_described_system_are_refused(cuff_recordings, pair):
    system, train, quiet = cuff_recordings
    sites = dict(system.markers.sites)
    sites[pair[0]], sites[pair[1]] = sites[pair[1]], sites[pair[0]]
    exchanged = replace(system, markers=replace(system.markers, sites=sites))
    settings = validated({}, "config", Path("defaults"))["diagnosis"]["described"]
    with pytest.raises(InputError) as caught:
        DescribedTrial(exchanged, train, quiet, settings)
    assert caught.value.code == "site_sides"
    assert all(sites[name] in caught.value.place for name in pair)


def test_sites_as_they_are_pass(cuff_recordings):
    system, train, quiet = cuff_recordings
    settings = validated({}, "config", Path("defaults"))["diagnosis"]["described"]
    DescribedTrial(system, train, quiet, settings)
