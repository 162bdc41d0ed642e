"""The MCAP of a fitted trial: whole, complete, and true to the replay."""

from __future__ import annotations

import json
from collections import defaultdict
from dataclasses import dataclass
from itertools import pairwise

import jsonschema
import mujoco
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from mcap.reader import make_reader
from mcap.records import Schema
from PIL import Image
from real2sim.errors import InputError
from real2sim.geometry import AXES, interface_coordinates, relative_pose, rotation_matrix, rotation_xyz
from real2sim.inference.parameters import PARAMETERS
from real2sim.pages.motion.export import CHANNELS, OPTIONAL, export_motion
from real2sim.pages.motion.replayed import MotionReplay, strap_wrench
from real2sim.pages.motion.scene import arrow, robot_bodies
from real2sim.pages.motion_clip import motion_clip
from real2sim.recording.formats.mcap_file import Contents, read_messages
from real2sim.recording.ingest import WRENCH
from real2sim.recording.trial import load_trial, replay_inputs
from real2sim.system.plant import ROBOT_JOINTS, JointLimits, load_robot
from recorded_trial import CONFIG, ROBOT, RecordedTrial, record

GAP = slice(500, 560)
SETTINGS = {name: CONFIG[name] for name in ("identification", "plant", "robot")}


def _canonical(trial: RecordedTrial) -> None:
    """Complete the trial's tables as ingest writes them, with a gap in the interface markers."""
    pose = pq.read_table(trial.pose)
    meta = json.loads(pose.schema.metadata[b"real2sim"])

    def body(name: str) -> tuple[np.ndarray, np.ndarray]:
        quat = np.column_stack([pose[f"{name}_q{c}"].to_numpy() for c in "wxyz"])
        return rotation_matrix(quat), np.column_stack([pose[f"{name}_{c}"].to_numpy() for c in "xyz"])

    rest = np.array(meta["rest"]["rotation"]), np.array(meta["rest"]["position"])
    q = interface_coordinates(*relative_pose(*body("pelvis"), *body("interface")), *rest)
    columns = {name: pose[name].to_numpy().copy() for name in pose.column_names}
    columns |= {f"q_{axis}": q[:, i] for i, axis in enumerate(AXES)}
    for name in columns:
        if name.startswith(("interface_", "q_")):
            columns[name][GAP] = np.nan
    pq.write_table(pa.table(columns).replace_schema_metadata(pose.schema.metadata), trial.pose)
    markers = pq.read_table(trial.markers)
    wide = {name: markers[name].to_numpy().copy() for name in markers.column_names}
    for name in list(wide):
        if name.endswith("_x"):
            wide[f"{name[:-2]}_filled"] = np.zeros(len(markers), bool)
        if name.startswith("IF_"):
            wide[name][GAP] = np.nan
    pq.write_table(pa.table(wide).replace_schema_metadata({"real2sim": "{}"}), trial.markers)


@dataclass
class Exported:
    path: object
    messages: dict
    times: dict
    reader: object
    trial: RecordedTrial


def _robot_log(path, n: int, measured: bool, wrench: bool):
    """Write robot.parquet as `ingest` does: of a wrench that was not logged there is no column."""
    nothing = np.full(n, np.nan)
    names = [*ROBOT_JOINTS, *(WRENCH if wrench else ())]
    values = {name: np.full(n, 0.1 * i) if measured else nothing for i, name in enumerate(names)}
    table = pa.table(values).replace_schema_metadata({"real2sim": json.dumps({"yaw_odom_to_world_rad": 0.3})})
    pq.write_table(table, path)
    return path


def _export(trial: RecordedTrial, folder, out, measured=True, wrench=True):
    fit = folder / "restart-1.json"
    content = {"subject": "S02", "trial": "dynamic_1", "restart": 1, "parameters": trial.parameters}
    fit.write_text(json.dumps(content | {"cost": {"J": 0.01}}))
    n = pq.read_metadata(trial.pose).num_rows
    export_motion(
        subject="S02",
        trial="dynamic_1",
        fits=[fit],
        pose=trial.pose,
        markers=trial.markers,
        robot_log=_robot_log(folder / "robot.parquet", n, measured, wrench),
        limits=trial.limits,
        step=trial.step,
        robot=ROBOT,
        settings=SETTINGS,
        out=out,
    )
    return out


@pytest.fixture(scope="module")
def exported(tmp_path_factory) -> Exported:
    folder = tmp_path_factory.mktemp("motion")
    trial = record(folder)
    _canonical(trial)
    path = _export(trial, folder, folder / "S02.mcap")
    messages, times = defaultdict(list), defaultdict(list)
    with path.open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True)
        summary = reader.get_summary()
        for _, channel, message in reader.iter_messages():
            messages[channel.topic].append(json.loads(message.data))
            times[channel.topic].append(message.log_time)
        metadata = list(reader.iter_metadata())
    return Exported(path, messages, times, (summary, metadata), trial)


def test_file_is_whole_and_its_summary_true(exported):
    summary, metadata = exported.reader
    assert summary.statistics.message_count == sum(map(len, exported.messages.values()))
    assert {c.topic for c in summary.channels.values()} == set(CHANNELS)
    assert summary.chunk_indexes
    assert metadata[0].metadata["phantom"] == "true"
    # a second reader, which checks every checksum and takes nothing from the index
    contents = Contents()
    count = sum(1 for _ in read_messages(exported.path, contents))
    assert count == summary.statistics.message_count
    assert contents.findings == []
    assert contents.backwards == 0


def test_a_flipped_byte_is_noticed(exported, tmp_path):
    raw = bytearray(exported.path.read_bytes())
    raw[len(raw) // 2] ^= 1
    broken = tmp_path / "broken.mcap"
    broken.write_bytes(raw)
    with pytest.raises(InputError, match=r"checksum|decompress|damaged"):
        list(read_messages(broken))


def test_every_channel_has_a_schema_that_its_messages_fit(exported):
    summary, _ = exported.reader
    for channel in summary.channels.values():
        schema: Schema = summary.schemas[channel.schema_id]
        assert (channel.message_encoding, schema.encoding) == ("json", "jsonschema")
        assert schema.name == CHANNELS[channel.topic]
        content = json.loads(schema.data)
        jsonschema.Draft202012Validator.check_schema(content)
        check = jsonschema.Draft202012Validator(content)
        own = exported.messages[channel.topic]
        assert own, channel.topic
        for message in {0: own[0], 1: own[len(own) // 2], 2: own[-1]}.values():
            check.validate(message)
        broken = dict(own[0])
        broken.popitem()
        assert not check.is_valid(broken), channel.topic


def test_thirty_seconds_are_less_than_ten_megabytes(exported):
    seconds = len(exported.messages["/tf"]) / 100
    assert exported.path.stat().st_size * 30 / seconds < 10e6


def test_simulation_follows_the_measurement_it_was_made_of(exported):
    norms = [(m["left_norm"], m["right_norm"]) for m in exported.messages["/residual"]]
    # true parameters, no noise: the plants differ by micrometres
    assert 0 < np.max(norms) < 1e-4
    q = exported.messages["/q"]
    there = [m for m in q if m["measured"]["tx"] is not None]
    assert len(q) - len(there) == GAP.stop - GAP.start
    # rotations differ: two markers do not show the one about y
    for axis in ("tx", "ty", "tz"):
        assert max(abs(m["measured"][axis] - m["simulated"][axis]) for m in there) < 5e-4


def test_what_was_not_measured_is_not_shown(exported):
    gap = {round(1e9 * i / 100) for i in range(GAP.start, GAP.stop)}
    for topic in ("/measured/interface", "/residual"):
        assert not gap & set(exported.times[topic]), topic
    assert gap <= set(exported.times["/simulated/interface"])
    assert gap <= set(exported.times["/measured/pelvis"])


def _vectors(messages, *path):
    for key in path:
        messages = [m[key] for m in messages]
    return np.array([[m[c] for c in "xyz"] for m in messages])


def test_strap_force_is_spring_and_damper_and_reverses_between_robot_and_person(exported):
    q = np.array([[m["simulated"][axis] for axis in AXES] for m in exported.messages["/q"]])
    rate = np.gradient(q, 0.01, axis=0)
    p = exported.trial.parameters
    stiffness = np.array([p[f"k_{axis}"] for axis in AXES])
    damping = np.array([p[f"d_{axis}"] for axis in AXES])
    expected = stiffness * q + damping * rate  # on the person; no limit is touched
    force = _vectors(exported.messages["/strap/wrench"], "force")
    inner = slice(3, -3)
    assert np.abs(force - expected[:, :3])[inner].max() < 0.02 * np.abs(expected[:, :3]).max()
    torque = _vectors(exported.messages["/strap/wrench"], "torque")
    assert np.abs(torque[inner, 0] - expected[inner, 3]).max() < 0.02 * np.abs(expected[:, 3]).max()


@pytest.mark.parametrize("side", [-1, 1])
def test_a_limit_pushes_the_strap_back_from_either_side(exported, side):
    """A limit at 2 mm, which the pelvis pulls the strap through its spring and damper against."""
    trial = exported.trial
    reach = 0.002  # m
    lower, upper = np.full(6, -1.0), np.full(6, 1.0)
    (upper if side > 0 else lower)[0] = side * reach
    loaded = load_trial(trial.pose, trial.markers, SETTINGS["identification"])
    settings = SETTINGS | {"plant": SETTINGS["plant"] | {"timestep_s": 0.005}}
    inputs = replay_inputs(loaded, JointLimits(lower, upper), ROBOT, settings)
    parameters = np.array([trial.parameters[name] for name in PARAMETERS])
    found = MotionReplay(**inputs, nsim=1).record(parameters)
    beyond = side * found.q[:, 0] > reach
    assert beyond.sum() > 10
    rate = np.gradient(found.q[:, 0], loaded.time_s[1] - loaded.time_s[0])
    strap = -parameters[0] * found.q[:, 0] - parameters[6] * rate
    pushes = side * (found.force[:, 0] - strap)[beyond]
    assert np.median(pushes) < -5.0, "[N] back, and beside spring and damper"


def test_hinge_torques_do_the_work_of_the_torque_vector():
    rng = np.random.default_rng(1)
    q, force = 0.3 * rng.standard_normal((5, 6)), rng.standard_normal((5, 6))
    _, torque = strap_wrench(force, q)
    step = 1e-6
    for i in range(3):
        moved = q.copy()
        moved[:, 3 + i] += step
        turn = np.einsum("nij,nkj->nik", rotation_xyz(moved[:, 3:]), rotation_xyz(q[:, 3:]))
        axis = np.stack([turn[:, 2, 1], turn[:, 0, 2], turn[:, 1, 0]], axis=-1) / step
        np.testing.assert_allclose(np.sum(axis * torque, axis=1), force[:, 3 + i], rtol=1e-4)


def test_frames_of_the_robot_end_at_the_simulated_interface(exported):
    twin = load_robot(ROBOT).compile()
    drawn = {e["frame_id"] for e in exported.messages["/simulated/robot_bodies"][0]["entities"]}
    frames = {t["child_frame_id"]: t for t in exported.messages["/tf"][600]["transforms"]}
    assert drawn == {f"robot/{twin.body(i).name}" for i in range(1, twin.nbody)} <= set(frames)
    assert {"pelvis", "interface_measured", "interface_simulated"} <= set(frames)
    middle = _vectors([frames["interface_simulated"]], "translation")[0]
    sites = _vectors(exported.messages["/residual/arrows"][600]["entities"][0]["spheres"], "pose", "position")
    np.testing.assert_allclose(sites.mean(axis=0), middle, atol=2e-6)


def test_logged_robot_is_turned_into_the_world_and_left_out_without_a_log(exported, tmp_path):
    assert {exported.messages["/measured/robot"][5][joint] for joint in ROBOT_JOINTS} == {0.0}
    for measured, absent in ((False, set(OPTIONAL)), (True, {"/measured/wrench"})):
        without = _export(
            exported.trial, tmp_path, tmp_path / "without.mcap", measured=measured, wrench=False
        )
        with without.open("rb") as stream:
            summary = make_reader(stream).get_summary()
        assert {c.topic for c in summary.channels.values()} == set(CHANNELS) - absent


def test_same_trial_gives_the_same_bytes(exported, tmp_path):
    again = _export(exported.trial, tmp_path, tmp_path / "again.mcap")
    assert again.read_bytes() == exported.path.read_bytes()


def test_shapes_of_any_robot_are_drawn():
    twin = mujoco.MjModel.from_xml_string(
        "<mujoco><worldbody><geom type='plane' size='1 1 1'/><body name='b'>"
        "<geom name='s' type='sphere' size='.1'/><geom name='c' type='capsule' size='.1 .2'/>"
        "<geom name='y' type='cylinder' size='.1 .2'/><geom name='x' type='box' size='.1 .2 .3'/>"
        "<geom name='e' type='ellipsoid' size='.1 .2 .3'/></body></worldbody></mujoco>"
    )
    entities = {e["id"]: e for e in robot_bodies(twin, 0)["entities"]}
    assert set(entities) == set("scyxe")
    assert len(entities["c"]["cylinders"]) == 1
    assert len(entities["c"]["spheres"]) == 2
    assert entities["e"]["cubes"][0]["size"] == {"x": 0.2, "y": 0.4, "z": 0.6}


@pytest.mark.parametrize("vector", [(0.3, 0, 0), (-0.3, 0, 0), (0, 0.2, -0.1), (0, 0, 0)])
def test_arrow_points_along_its_vector(vector):
    drawn = arrow(np.zeros(3), np.array(vector, float), 0.01, (1, 0, 0, 1))
    quat = np.array([[drawn["pose"]["orientation"][c] for c in "wxyz"]])
    length = drawn["shaft_length"] + drawn["head_length"]
    np.testing.assert_allclose(rotation_matrix(quat)[0][:, 0] * length, vector, atol=2e-6)


def test_clip_of_a_trial_moves_and_says_what_it_rests_on(tmp_path):
    trial = record(tmp_path)
    _canonical(trial)
    fit = tmp_path / "restart-1.json"
    content = {"subject": "S02", "trial": "dynamic_1", "restart": 1, "parameters": trial.parameters}
    fit.write_text(json.dumps(content | {"cost": {"J": 0.01}}))
    out = tmp_path / "clip.gif"
    motion_clip(
        fits=[fit],
        pose=trial.pose,
        markers=trial.markers,
        limits=trial.limits,
        step=trial.step,
        robot=ROBOT,
        settings=SETTINGS,
        out=out,
        seconds=1.0,
    )
    with Image.open(out) as clip:
        frames = []
        for k in range(clip.n_frames):
            clip.seek(k)
            frames.append(np.asarray(clip.convert("RGB")).copy())
    # 12 a second; those in the gap of the interface markers are left out
    assert 5 <= len(frames) <= 13
    assert any((a != b).any() for a, b in pairwise(frames))
    assert out.stat().st_size < 1e6
