"""Raw exports to tables: a person in closed form, bad input, what quality.json says."""

import json
import re
import shutil
from dataclasses import replace

import numpy as np
import pyarrow.parquet
import pytest
from handmade_person import (
    MARKERLESS_OFFSET_S,
    ODOM_YAW,
    PELVIS,
    SETTINGS,
    SIDES,
    SUBJECT,
    SYNC_S,
    TRIALS,
    change_markers,
    pelvis_pose,
    robot_state,
    true_q,
    write_person,
    write_trial,
)
from real2sim import geometry
from real2sim.configuration import validated
from real2sim.errors import InputError
from real2sim.recording.formats.detect import read_markerless
from real2sim.recording.formats.opensim import write_coordinates
from real2sim.recording.formats.recordings import CoordinateRecording
from real2sim.recording.formats.robot_log import read_log, write_log
from real2sim.recording.ingest import ingest_subject, lab_to_world


@pytest.fixture(scope="module")
def raw(tmp_path_factory):
    return write_person(tmp_path_factory.mktemp("raw") / "S01")


@pytest.fixture(scope="module")
def done(raw, tmp_path_factory):
    out = tmp_path_factory.mktemp("trials") / "S01"
    ingest_subject(subject="S01", folder=raw, settings=SETTINGS, raw=sorted(raw.iterdir()), out=out)
    return out


@pytest.fixture
def copy(raw, tmp_path):
    """A copy of the person with neutral and dynamic_1 only in play, and a function that ingests it."""
    folder = tmp_path / "S01"
    shutil.copytree(raw, folder)

    def run(**settings):
        arguments = {"folder": folder, "settings": SETTINGS | settings, "raw": [], "out": tmp_path / "out"}
        ingest_subject(subject="S01", **arguments)
        return tmp_path / "out"

    return folder, run


def table(path):
    read = pyarrow.parquet.read_table(path)
    return {name: read[name].to_numpy() for name in read.column_names}


def quality(out, trial):
    return json.loads((out / trial / "quality.json").read_text())


def refusal(run, **settings):
    with pytest.raises(InputError) as error:
        run(**settings)
    assert error.value.remedy
    return str(error.value)


# -------------------- what comes out


def test_files(done):
    for trial in TRIALS:
        names = {path.name for path in (done / trial).iterdir()}
        tables = {"markers.parquet", "pose.parquet", "joints.parquet", "robot.parquet"}
        assert names == tables | {"quality.json"}
        clocks = [table(done / trial / name)["time_s"] for name in sorted(tables)]
        for clock in clocks:
            np.testing.assert_array_equal(clock, np.arange(1200) / 100)


def test_interface_coordinates_are_the_true_ones(done):
    pose = table(done / "dynamic_1" / "pose.parquet")
    t = pose["time_s"]
    truth = true_q(t, True)
    rates = (true_q(t + 1e-4, True) - true_q(t - 1e-4, True)) / 2e-4
    inner = slice(20, -20)
    for i, axis in enumerate(geometry.AXES):
        tolerance = 2e-5 if i < 3 else 1e-4
        np.testing.assert_allclose(pose[f"q_{axis}"][inner], truth[inner, i], atol=tolerance)
        np.testing.assert_allclose(pose[f"qd_{axis}"][inner], rates[inner, i], atol=50 * tolerance)
    assert np.abs(truth[:, 4]).max() > 0.02  # rotation about y is there, by the arm's pitch


def test_poses(done):
    pose = table(done / "dynamic_1" / "pose.parquet")
    rotation, position = pelvis_pose(pose["time_s"], True)
    measured = np.column_stack([pose[f"pelvis_q{c}"] for c in "wxyz"])
    np.testing.assert_allclose(geometry.rotation_matrix(measured), rotation, atol=1e-4)
    for i, axis in enumerate("xyz"):
        np.testing.assert_allclose(pose[f"pelvis_{axis}"], position[:, i], atol=5e-5)


def test_robot_on_the_qualisys_clock(done):
    robot = table(done / "dynamic_1" / "robot.parquet")
    t = robot["time_s"]
    state = robot_state(t, True)
    np.testing.assert_allclose(robot["base_yaw"], state[:, 2] - ODOM_YAW, atol=1e-6)
    for i, name in enumerate(("arm_lift", "arm_roll", "arm_pitch")):
        np.testing.assert_allclose(robot[name], state[:, 3 + i], atol=1e-6)
    np.testing.assert_allclose(robot["wrench_fx"], np.sin(t + SYNC_S), atol=1e-6)
    report = quality(done, "dynamic_1")["robot"]
    assert report["offset_s"] == pytest.approx(-SYNC_S, abs=1e-9)
    assert report["yaw_odom_to_world_rad"] == pytest.approx(ODOM_YAW, abs=1e-4)


def test_joints_on_the_qualisys_clock(done):
    joints = table(done / "dynamic_1" / "joints.parquet")
    report = quality(done, "dynamic_1")["markerless"]
    assert report["offset_s"] == pytest.approx(MARKERLESS_OFFSET_S, abs=1e-4)
    assert report["drift_ppm"] == 0
    assert report["rms_m"] < 1e-4
    np.testing.assert_allclose(report["translation_m"], [0.5, 0.3, 0.0], atol=2e-3)
    position = pelvis_pose(joints["time_s"], True)[1]
    np.testing.assert_allclose(joints["pelvis_tx"], position[:, 0] - 0.5, atol=1e-4)
    np.testing.assert_allclose(joints["pelvis_ty"], position[:, 2], atol=1e-4)


def test_neutral_carries_rest_and_noise(done):
    values = quality(done, "neutral")
    np.testing.assert_allclose(values["rest"]["rotation"], np.eye(3), atol=1e-4)
    np.testing.assert_allclose(values["rest"]["position"], [0.0, 0.0, 0.0], atol=1e-5)
    np.testing.assert_allclose(values["pelvis_geometry"]["PSIS_L"], PELVIS["PSIS_L"], atol=1e-6)
    assert set(values["standing_sd_m"]) == {*PELVIS, *SIDES}
    assert values["markerless"]["synchronised"] is False
    metadata = pyarrow.parquet.read_schema(done / "dynamic_1" / "pose.parquet").metadata
    about = json.loads(metadata[b"real2sim"])
    assert about["rest"] == values["rest"]
    assert (about["subject"], about["trial"], about["phantom"]) == ("S01", "dynamic_1", True)


def test_units_and_frames_of_every_column(done):
    expected = {
        "markers": {"time_s": ("s", "qualisys"), "IF_L_x": ("m", "world"), "IF_L_filled": ("", "")},
        "pose": {"q_tx": ("m", "interface"), "q_rx": ("rad", "interface"), "qd_rz": ("rad/s", "interface")},
        "joints": {"pelvis_tx": ("m", "opensim"), "knee_angle_r": ("rad", "opensim")},
        "robot": {"base_x": ("m", "odom"), "base_vx": ("m/s", "base"), "wrench_tz": ("N m", "sensor")},
    }
    for name, columns in expected.items():
        schema = pyarrow.parquet.read_schema(done / "dynamic_1" / f"{name}.parquet")
        assert all(b"unit" in field.metadata and b"frame" in field.metadata for field in schema)
        for column, (unit, frame) in columns.items():
            assert schema.field(column).metadata == {b"unit": unit.encode(), b"frame": frame.encode()}


def test_walking_without_a_robot(done):
    pose, robot = (table(done / "walk_normal_1" / f"{name}.parquet") for name in ("pose", "robot"))
    assert all(np.isnan(pose[f"q_{axis}"]).all() for axis in geometry.AXES)
    assert np.isfinite(pose["pelvis_x"]).all()
    assert np.isnan(robot["base_x"]).all()
    values = quality(done, "walk_normal_1")
    assert values["robot"] == {"status": "no robot log"}
    assert "no_robot_log" in [finding["code"] for finding in values["findings"]]


def _findings(out, trial):
    return {finding["code"]: finding for finding in quality(out, trial)["findings"]}


def test_a_trial_that_alone_lacks_the_robot_log_has_another_axis(done, copy):
    assert all("interface_axis" not in _findings(done, trial) for trial in TRIALS)
    folder, run = copy
    (folder / "dynamic_1.mcap").unlink()
    found = _findings(run(), "dynamic_1")["interface_axis"]
    assert found["severity"] == "warning"
    assert "world z here and by arm in neutral" in found["message"]


def test_quality_says_what_it_rests_on(done, raw):
    import hashlib

    values = quality(done, "dynamic_1")
    assert values["phantom"] is True
    assert set(values["sha256"]) == {"dynamic_1.tsv", "dynamic_1.mot", "dynamic_1.mcap"}
    digest = hashlib.sha256((raw / "dynamic_1.tsv").read_bytes()).hexdigest()
    assert values["sha256"]["dynamic_1.tsv"] == digest
    assert values["settings"]["cutoff_hz"] == 12


def test_same_bytes_again(done, copy):
    out = copy[1]()
    for path in sorted(done.rglob("*.*")):
        assert path.read_bytes() == (out / path.relative_to(done)).read_bytes()


def test_progress_names_every_trial(copy, capsys):
    copy[1]()
    lines = capsys.readouterr().out.splitlines()
    order = ["neutral", *sorted(set(TRIALS) - {"neutral"})]
    assert [line.split(":")[0] for line in lines] == [f"S01 {name}" for name in order]


# -------------------- variants


def test_200_hz_and_a_cropped_export(copy):
    folder, run = copy
    write_trial(folder, "dynamic_1", rate=200.0, first_frame=60, duration=11.0)
    pose = table(run() / "dynamic_1" / "pose.parquet")
    assert pose["time_s"][0] == pytest.approx(0.30)
    truth = true_q(pose["time_s"], True)
    np.testing.assert_allclose(pose["q_rz"][20:-20], truth[20:-20, 5], atol=1e-4)


def test_log_without_sync_is_laid_on_by_motion(copy):
    folder, run = copy
    write_trial(folder, "dynamic_1", sync=False)
    report = quality(run(), "dynamic_1")["robot"]
    assert report["status"] == "synchronised by motion"
    assert report["offset_s"] == pytest.approx(-SYNC_S, abs=5e-4)


def test_robot_log_is_optional(copy):
    folder, run = copy
    (folder / "dynamic_1.mcap").unlink()
    out = run()
    pose = table(out / "dynamic_1" / "pose.parquet")
    assert np.isfinite(pose["q_rz"]).all()
    assert np.isnan(table(out / "dynamic_1" / "robot.parquet")["base_x"]).all()
    assert quality(out, "dynamic_1")["interface_up_axis"] == "world z"


def test_other_lab_axes(copy):
    folder, run = copy

    def turn(positions):
        return {
            name: values @ np.array([[0, 1, 0], [-1, 0, 0], [0, 0, 1]]) for name, values in positions.items()
        }

    for name in TRIALS:
        change_markers(folder / f"{name}.tsv", turn)
    pose = table(run(lab_to_world={"x": "+y", "y": "-x", "z": "+z"}) / "dynamic_1" / "pose.parquet")
    truth = true_q(pose["time_s"], True)
    np.testing.assert_allclose(pose["q_tx"][20:-20], truth[20:-20, 0], atol=3e-5)


def test_lab_axes_must_be_right_handed():
    np.testing.assert_array_equal(lab_to_world({"x": "+y", "y": "-x", "z": "+z"}) @ [1, 2, 3], [2, -1, 3])
    for axes in ({"x": "-x", "y": "+y", "z": "+z"}, {"x": "+x", "y": "+x", "z": "+z"}, {"x": "+x"}):
        with pytest.raises(InputError, match="right-handed"):
            lab_to_world(axes)


def test_lab_axes_are_checked_with_the_configuration():
    for axes, found in (({"x": "-x"}, "left-handed"), ({"x": "+y"}, "not three different axes")):
        with pytest.raises(InputError, match=f"my.yaml, ingest.lab_to_world(?s:.*){found}"):
            validated({"ingest": {"lab_to_world": axes}}, "config", "my.yaml")


def test_lab_marker_names(copy):
    folder, run = copy
    names = {"LASI": "ASIS_L", "strap left": "IF_L"}
    back = {ours: lab for lab, ours in names.items()}
    for name in TRIALS:
        change_markers(folder / f"{name}.tsv", lambda p: {back.get(key, key): v for key, v in p.items()})
    text = refusal(run)
    assert "neutral.tsv, marker ASIS_L, IF_L" in text
    assert "LASI" in text
    assert "markers: in subject.yaml" in text
    (folder / "subject.yaml").write_text(SUBJECT + f"markers: {json.dumps(names)}\n")
    run()
    mistyped = {"LASI": "ASIS_L", "Strap_Left": "IF_L"}
    (folder / "subject.yaml").write_text(SUBJECT + f"markers: {json.dumps(mistyped)}\n")
    text = refusal(run)
    assert "Strap_Left, which is to be IF_L, is no marker of this file; did you mean strap left?" in text
    assert "found:    markers LASI," in text, "the file's own names"


def test_gaps(copy):
    folder, run = copy

    def holes(positions):
        positions["IF_L"][300:315] = np.nan
        positions["ASIS_R"][500:540] = np.nan
        positions["IF_R"][700:740] = np.nan
        return positions

    change_markers(folder / "dynamic_1.tsv", holes)
    out = run()
    markers, pose = (table(out / "dynamic_1" / f"{name}.parquet") for name in ("markers", "pose"))
    truth = true_q(pose["time_s"], True)
    assert set(np.flatnonzero(markers["IF_L_filled"])) == set(range(300, 315))
    assert np.isnan(markers["ASIS_R_x"][500:540]).all()
    assert not markers["ASIS_R_filled"].any()
    # One pelvis marker can be rebuilt, one interface marker cannot.
    np.testing.assert_allclose(pose["q_rz"][490:550], truth[490:550, 5], atol=5e-4)
    assert np.isnan(pose["q_rz"][700:740]).all()
    assert np.isnan(pose["qd_rz"][700:740]).all()
    values = quality(out, "dynamic_1")
    codes = [finding["code"] for finding in values["findings"]]
    assert codes.count("gap_masked") == 2
    assert codes.count("pelvis_rebuilt") == 1
    assert values["markers"]["IF_L"]["samples_filled"] == 15
    assert values["markers"]["IF_R"]["samples_masked"] == 40


def test_marker_jump_is_reported(copy):
    folder, run = copy

    def swap(positions):
        positions["ASIS_L"][600:], positions["ASIS_R"][600:] = (
            positions["ASIS_R"][600:].copy(),
            positions["ASIS_L"][600:].copy(),
        )
        return positions

    change_markers(folder / "dynamic_1.tsv", swap)
    codes = [finding["code"] for finding in quality(run(), "dynamic_1")["findings"]]
    assert codes.count("marker_jump") == 2


def test_angles_that_jump_by_a_turn_in_the_export_are_continuous(copy):
    """The ground of the video system looks the other way: the heading sways about 180 deg, and an arm turns."""
    folder, run = copy
    path = folder / "dynamic_1.mot"
    whole = read_markerless(path)
    turned = {f"pelvis_t{axis}": -whole.columns[f"pelvis_t{axis}"] for axis in "xz"}
    turned["pelvis_rotation"] = whole.columns["pelvis_rotation"] + np.pi
    turned["arm_flex_r"] = 2 * whole.time_s
    plain = table(run() / "dynamic_1" / "joints.parquet")
    for name in ("pelvis_rotation", "arm_flex_r"):
        turned[name] = np.angle(np.exp(1j * turned[name]))
        assert np.abs(np.diff(turned[name])).max() > 6
    turned["arm_flex_r"][300:310] = np.nan
    write_coordinates(path, CoordinateRecording(whole.time_s, whole.columns | turned))
    joints = table(run() / "dynamic_1" / "joints.parquet")
    off = joints["pelvis_rotation"] - plain["pelvis_rotation"]
    assert np.nanmax(np.abs(np.angle(np.exp(1j * (off - np.pi))))) < 1e-3
    for name in ("pelvis_rotation", "arm_flex_r"):
        known = joints[name][np.isfinite(joints[name])]
        assert len(known) > 0.9 * len(joints[name])
        assert np.abs(np.diff(known)).max() < 0.5, name


# -------------------- bad input (more of it in test_bad_input.py)


def test_coordinates_without_pelvis(copy):
    folder, run = copy
    t = np.arange(100) / 60
    write_coordinates(folder / "dynamic_1.mot", CoordinateRecording(t, {"knee_angle_r": t}))
    text = refusal(run)
    assert "dynamic_1.mot, column pelvis_tilt" in text


def test_a_coordinate_without_a_number_takes_nothing_from_the_others(copy):
    folder, run = copy
    path = folder / "dynamic_1.mot"
    whole = read_markerless(path)
    columns = {**whole.columns, "wrist_flex_r": np.full(len(whole.time_s), np.nan)}
    write_coordinates(path, CoordinateRecording(whole.time_s, columns))
    out = run()
    joints = table(out / "dynamic_1" / "joints.parquet")
    assert not np.isfinite(joints["wrist_flex_r"]).any()
    assert np.isfinite(joints["pelvis_tx"]).mean() > 0.95
    found = {f["code"]: f for f in quality(out, "dynamic_1")["findings"]}
    assert found["column_empty"]["place"] == "wrist_flex_r"
    # an export that breaks off
    half = slice(0, len(whole.time_s) // 2)
    columns = {name: values[half] for name, values in whole.columns.items()}
    write_coordinates(path, CoordinateRecording(whole.time_s[half], columns))
    found = {f["code"]: f for f in quality(run(), "dynamic_1")["findings"]}
    assert re.search(r"over [2-5]\d % of the time", found["markerless_part"]["message"])


@pytest.mark.parametrize(
    ("milliseconds", "millimetres", "told"),
    [(1000, 1, "column time"), (1, 1000, "pelvis")],
)
def test_milliseconds_and_millimetres_are_told(copy, milliseconds, millimetres, told):
    folder, run = copy
    path = folder / "dynamic_1.mot"
    whole = read_markerless(path)
    columns = {
        name: values * (millimetres if name.startswith("pelvis_t") and name != "pelvis_tilt" else 1)
        for name, values in whole.columns.items()
    }
    write_coordinates(path, CoordinateRecording(whole.time_s * milliseconds, columns))
    text = refusal(run)
    assert f"dynamic_1.mot, {told}" in text
    assert ("milliseconds?" if milliseconds > 1 else "centimetres or millimetres?") in text


@pytest.mark.parametrize(
    ("joint", "factor", "told"),
    [("arm_roll", 180 / np.pi, "degrees?"), ("arm_lift", 1000.0, "millimetres?")],
)
def test_a_log_in_degrees_or_millimetres_is_told(copy, joint, factor, told):
    folder, run = copy
    path = folder / "dynamic_1.mcap"
    log = read_log(path, SETTINGS["robot_log"]["stamps"], SETTINGS["max_gap_s"])
    joints = log.joints | {joint: log.joints[joint] * factor}
    write_log(path, replace(log, joints=joints))
    text = refusal(run)
    assert f"/joint_states, {joint}" in text
    assert told in text


def test_log_of_another_trial(copy):
    folder, run = copy
    log = read_log(folder / "dynamic_1.mcap")
    write_log(folder / "dynamic_1.mcap", replace(log, sync_s=log.sync_s + 100))
    assert "no time at which both" in refusal(run)


def _within(log, first_s, last_s):
    """A log without what lies outside a span of its own time."""
    base = (log.base_time_s >= first_s) & (log.base_time_s <= last_s)
    arm = (log.joint_time_s >= first_s) & (log.joint_time_s <= last_s)
    return replace(
        log,
        base_time_s=log.base_time_s[base],
        base={name: values[base] for name, values in log.base.items()},
        joint_time_s=log.joint_time_s[arm],
        joints={name: values[arm] for name, values in log.joints.items()},
    )


def test_a_log_of_part_of_a_trial_is_told(copy):
    folder, run = copy
    path = folder / "dynamic_1.mcap"
    log = read_log(path)
    write_log(path, _within(log, log.base_time_s[0], log.base_time_s[0] + 5.0))
    found = _findings(run(), "dynamic_1")["log_partial"]
    assert found["severity"] == "warning"
    assert "roll, pitch and yaw are known in" in found["message"]


@pytest.mark.parametrize("kept_s", [0.0, 0.5])
def test_a_log_of_hardly_anything_is_refused(copy, kept_s):
    folder, run = copy
    path = folder / "dynamic_1.mcap"
    log = read_log(path)
    write_log(path, replace(_within(log, log.base_time_s[0], log.base_time_s[0] + kept_s), sync_s=None))
    text = refusal(run)
    assert "dynamic_1.mcap" in text
    assert "/joint_states" in text
    assert "log_too_short" in text


def test_a_log_of_a_message_in_a_quarter_of_a_second_is_refused_by_its_rate(copy):
    folder, run = copy
    path = folder / "dynamic_1.mcap"
    log = read_log(path)
    rare = slice(None, None, round(0.25 / float(np.median(np.diff(log.joint_time_s)))))
    joints = {name: values[rare] for name, values in log.joints.items()}
    write_log(path, replace(log, joint_time_s=log.joint_time_s[rare], joints=joints))
    text = refusal(run)
    assert "topic /joint_states" in text
    assert "a message every 0.25 s" in text
    assert "log_rate" in text


def test_a_marker_that_is_labelled_and_never_seen_is_taken_as_not_there(copy):
    folder, run = copy

    def labelled(positions):
        return positions | {"LHEE": np.full_like(positions["IF_L"], np.nan)}

    for name in ("neutral", "dynamic_1"):
        change_markers(folder / f"{name}.tsv", labelled)
    out = run()
    assert _findings(out, "neutral")["marker_unseen"]["place"] == "LHEE"
    assert "LHEE" not in quality(out, "dynamic_1")["markers"]


def _exchange(folder, name):
    def labels(positions):
        return positions | {"PSIS_R": positions["PSIS_L"], "PSIS_L": positions["PSIS_R"]}

    change_markers(folder / f"{name}.tsv", labels)


def test_labels_that_are_exchanged_in_neutral_alone_are_its_fault(copy):
    folder, run = copy
    _exchange(folder, "neutral")
    text = refusal(run)
    assert "neutral.tsv, PSIS_L and PSIS_R" in text
    assert "neutral_swap" in text


def test_labels_that_are_exchanged_in_one_trial_are_exchanged_back(copy):
    folder, run = copy
    _exchange(folder, "dynamic_1")
    found = _findings(run(), "dynamic_1")
    assert {"marker_swap", "marker_swap_whole"} <= set(found)


def test_markers_that_a_lab_numbers_keep_their_names(copy):
    folder, run = copy
    for name in TRIALS:
        change_markers(folder / f"{name}.tsv", lambda p: {"1" if k == "IF_L" else k: v for k, v in p.items()})
    (folder / "subject.yaml").write_text(SUBJECT + "markers: {1: IF_L}\n")
    run()
    (folder / "subject.yaml").write_text(SUBJECT + "markers: {on: IF_L}\n")
    text = refusal(run)
    assert "key markers" in text
    assert "put the name in quotes" in text


def test_files_that_were_not_planned(copy, tmp_path):
    folder, _ = copy
    planned = [path for path in folder.iterdir() if path.name != "dynamic_1.mot"]
    with pytest.raises(InputError, match=r"dynamic_1\.mot"):
        ingest_subject(subject="S01", folder=folder, settings=SETTINGS, raw=planned, out=tmp_path / "out")


def test_rebuilt_marker_joins_the_measured_path_without_a_jump():
    from real2sim.recording.missing_marker import bridge

    offset = np.full((50, 3), np.nan)
    offset[:20], offset[30:] = [0.004, 0.0, -0.002], [0.010, 0.0, -0.002]
    bridged = bridge(offset, slice(20, 30))
    assert np.allclose(bridged[0], offset[19])
    assert np.all(np.diff(bridged[:, 0]) > 0)
    assert np.abs(bridged[-1] - offset[30]).max() < 0.001
    assert np.allclose(bridge(offset, slice(0, 0)).shape, (0, 3))
    offset[30:] = np.nan
    assert np.allclose(bridge(offset, slice(20, 50)), offset[0])
