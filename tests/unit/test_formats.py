"""Readers and writers of what the phantom writes: round trips, variants of real exports, refusals."""

import struct
import sys

import numpy as np
import pytest
from readings import codes
from real2sim.errors import InputError
from real2sim.recording.formats.opensim import PELVIS_COORDINATES, read_coordinates, write_coordinates
from real2sim.recording.formats.qualisys import read_markers, write_markers
from real2sim.recording.formats.recordings import CoordinateRecording, MarkerRecording, RobotLog
from real2sim.recording.formats.robot_log import ARM_JOINTS, BASE_COLUMNS, read_log, write_log

# -------------------- Qualisys

HEAD = """NO_OF_FRAMES\t{n}
NO_OF_CAMERAS\t4
NO_OF_MARKERS\t2
FREQUENCY\t{rate}
DESCRIPTION\t--
TIME_STAMP\t2026-01-01, 00:00:00
DATA_INCLUDED\t3D
MARKER_NAMES\tIF_L\tNew 0001
"""
COLUMNS = "Frame\tTime\tIF_L X\tIF_L Y\tIF_L Z\tNew 0001 X\tNew 0001 Y\tNew 0001 Z\n"


def tsv(tmp_path, rows, columns=COLUMNS, rate="100", n=None, extra=""):
    path = tmp_path / "trial.tsv"
    n = len(rows) if n is None else n
    path.write_text(HEAD.format(n=n, rate=rate) + extra + columns + "".join(r + "\n" for r in rows))
    return path


def row(frame, *values, time=None):
    time = (frame - 1) / 100 if time is None else time
    return "\t".join([str(frame), f"{time:.5f}", *map(str, values or (1, 2, 3, 4, 5, 6))])


def markers(n=50, first_frame=1):
    rng = np.random.default_rng(1)
    positions = {name: rng.normal(size=(n, 3)).round(6) for name in ("ASIS_L", "New 0000", "IF_R")}
    positions["IF_R"][10:20] = np.nan
    return MarkerRecording((first_frame - 1 + np.arange(n)) / 100, 100.0, positions, first_frame)


@pytest.mark.parametrize("first_frame", [1, 2177])
def test_markers_round_trip_bit_exact(tmp_path, first_frame):
    given = markers(first_frame=first_frame)
    write_markers(tmp_path / "a.tsv", given)
    read = read_markers(tmp_path / "a.tsv")
    assert list(read.positions) == list(given.positions)
    assert read.first_frame == first_frame
    assert not read.findings
    np.testing.assert_array_equal(read.time_s, np.round(given.time_s, 5))
    for name, values in given.positions.items():
        np.testing.assert_array_equal(read.positions[name], np.round(values * 1000, 3) / 1000)
    write_markers(tmp_path / "b.tsv", read)
    assert (tmp_path / "a.tsv").read_bytes() == (tmp_path / "b.tsv").read_bytes()
    assert b"NaN\tNaN\tNaN" in (tmp_path / "a.tsv").read_bytes()


def test_tsv_without_columns_row_and_without_frame_and_time(tmp_path):
    read = read_markers(tsv(tmp_path, ["1\t2\t3\t4\t5\t6"] * 3, columns=""))
    np.testing.assert_allclose(read.positions["New 0001"], [[0.004, 0.005, 0.006]] * 3)
    np.testing.assert_allclose(read.time_s, [0, 0.01, 0.02])


def test_tsv_without_columns_row_but_with_frame_and_time(tmp_path):
    read = read_markers(tsv(tmp_path, [row(7), row(8)], columns=""))
    assert read.first_frame == 7
    np.testing.assert_allclose(read.time_s, [0.06, 0.07])


def test_tsv_header_row_one_cell_longer_crlf_events_types(tmp_path):
    extra = "TRAJECTORY_TYPES\tMeasured\tMixed\nEVENT\tstart\t1\t0.0\n"
    path = tsv(tmp_path, [row(1), row(2)], columns=COLUMNS.replace("\n", "\t\n"), extra=extra)
    path.write_bytes(path.read_bytes().replace(b"\n", b"\r\n"))
    read = read_markers(path)
    assert codes(read) == ["event"]
    np.testing.assert_allclose(read.positions["IF_L"][0], [0.001, 0.002, 0.003])


@pytest.mark.parametrize(
    ("cells", "finding"),
    [
        (("NaN",) * 3, []),
        (("", "", ""), []),
        (("0.000",) * 3, ["zero_triple"]),
        (("1.0", "NaN", "2.0"), ["partial_triple"]),
    ],
)
def test_tsv_missing_marker(tmp_path, cells, finding):
    read = read_markers(tsv(tmp_path, [row(1), row(2, *cells, 4, 5, 6), row(3)]))
    assert np.isnan(read.positions["IF_L"][1]).all()
    assert np.isfinite(read.positions["IF_L"][[0, 2]]).all()
    np.testing.assert_allclose(read.positions["New 0001"][1], [0.004, 0.005, 0.006])
    assert codes(read) == finding


def test_tsv_time_of_the_file_is_kept_even_if_frame_1_is_not_zero(tmp_path):
    read = read_markers(tsv(tmp_path, [row(i, time=i / 100) for i in (1, 2, 3)]))
    np.testing.assert_allclose(read.time_s, [0.01, 0.02, 0.03])


def test_a_cropped_tsv_with_times_alone_begins_at_the_frame_of_its_time(tmp_path):
    columns, rows = COLUMNS.partition("\t")[2], [row(i).partition("\t")[2] for i in (301, 302, 303)]
    read = read_markers(tsv(tmp_path, rows, columns=columns))
    assert read.first_frame == 301
    np.testing.assert_allclose(read.time_s, [3.0, 3.01, 3.02])
    since_1970 = [row(i, time=1.7e9 + i / 100).partition("\t")[2] for i in (1, 2)]
    with pytest.raises(InputError, match="no Frame column") as caught:
        read_markers(tsv(tmp_path, since_1970, columns=columns))
    assert caught.value.code == "frame_number"


def test_tsv_left_out_frames_are_missing_samples(tmp_path):
    read = read_markers(tsv(tmp_path, [row(1), row(2), row(5)]))
    assert codes(read) == ["frames_missing"]
    assert np.isnan(read.positions["IF_L"][2:4]).all()
    np.testing.assert_allclose(read.time_s, np.arange(5) / 100)


def test_tsv_wrong_count_is_reported_and_the_data_used(tmp_path):
    read = read_markers(tsv(tmp_path, [row(1), row(2)], n=900))
    assert codes(read) == ["count"]
    assert len(read.time_s) == 2


@pytest.mark.parametrize("key", ["NO_OF_FRAMES", "NO_OF_MARKERS", "FREQUENCY", "TIME_STAMP"])
def test_tsv_header_key_without_a_value_counts_as_not_there(tmp_path, key):
    path = tsv(tmp_path, [row(1), row(2), row(3)])
    head, _, rest = path.read_text().partition(f"{key}\t")
    path.write_text(head + key + "\n" + rest.partition("\n")[2])
    assert read_markers(path).rate_hz == pytest.approx(100)


@pytest.mark.parametrize("key", ["DATA_INCLUDED", "MARKER_NAMES"])
def test_tsv_header_without_names_or_data_type_is_refused_or_read(tmp_path, key):
    path = tsv(tmp_path, [row(1), row(2)])
    head, _, rest = path.read_text().partition(f"{key}\t")
    path.write_text(head + key + "\n" + rest.partition("\n")[2])
    if key == "DATA_INCLUDED":
        assert len(read_markers(path).time_s) == 2
    else:
        with pytest.raises(InputError, match="without a name"):
            read_markers(path)


def test_tsv_header_key_that_stands_twice_is_reported_or_refused(tmp_path):
    same = read_markers(tsv(tmp_path, [row(1), row(2)], extra="FREQUENCY\t100\t\n"))
    assert codes(same) == ["header_repeated"]
    assert "FREQUENCY" in same.findings[0].message
    with pytest.raises(InputError, match=r"line 9(.|\n)*MARKER_NAMES twice(.|\n)*'New 0001 IF_L'") as caught:
        read_markers(tsv(tmp_path, [row(1), row(2)], extra="MARKER_NAMES\tNew 0001\tIF_L\n"))
    assert caught.value.code == "header_repeated"


def test_what_was_found_never_reads_like_what_was_expected(tmp_path):
    rows = [row(i) + "\t" for i in (1, 2, 3)] + [row(4)] + [row(i) + "\t" for i in (5, 6)]
    with pytest.raises(InputError) as caught:
        read_markers(tsv(tmp_path, rows))
    assert caught.value.found == "8 cells, 9 in most rows"
    assert caught.value.expected == "9 cells as in most rows"
    with pytest.raises(InputError) as caught:
        read_markers(tsv(tmp_path, [row(1)], columns=COLUMNS.replace("IF_L X", "IF_L\u00a0X")))
    assert (caught.value.found, caught.value.expected[:8]) == ("'IF_L\\xa0X'", "'IF_L X'")


def test_tsv_external_rate_comes_from_the_time_column(tmp_path):
    assert read_markers(tsv(tmp_path, [row(1), row(2), row(3)], rate="EXT")).rate_hz == pytest.approx(100)


@pytest.mark.parametrize(
    ("rows", "options", "place", "message"),
    [
        ([row(1), row(3), row(2)], {}, "line 12, column 1", "increasing"),
        ([row(1), row(2, time=0)], {}, "line 11, column 2", "increasing"),
        ([row(1), row(2)[:-4]], {}, "line 11", "cut off"),
        ([row(1), row(2, 1, 2, "a", 4, 5, 6)], {}, "line 11, column 5", "'a'"),
        ([row(1), row(2, "1,5", 2, 3, 4, 5, 6)], {}, "line 11, column 3", "decimal point"),
        ([row(1), row(2, "inf", 2, 3, 4, 5, 6)], {}, "line 11, column 3", "infinite"),
        ([row(i) for i in range(1, 20)], {"rate": "200"}, "FREQUENCY", "200 Hz in the header, 100 Hz"),
        ([], {}, "", "no frames"),
        ([row(1)], {"columns": COLUMNS.replace("IF_L Y", "IF_R Y")}, "line 9, column 4", "IF_R Y"),
    ],
)
def test_tsv_refusals_name_the_place(tmp_path, rows, options, place, message):
    with pytest.raises(InputError) as error:
        read_markers(tsv(tmp_path, rows, **options))
    assert error.value.place == place
    assert message in str(error.value)
    assert "trial.tsv" in str(error.value)


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("a.tsv", b"", "empty file"),
        ("a.tsv", b"\x00\x01binary", "binary"),
        ("a.tsv", "NO_OF_FRAMES\t3\n".encode("utf-16"), "utf_16"),
        ("a.tsv", b"hello\tworld\n", "MARKER_NAMES"),
        ("a.tsv", HEAD.replace("3D", "6D").format(n=1, rate=1).encode(), "6D"),
        ("a.tsv", HEAD.replace("New 0001", "IF_L").format(n=1, rate=1).encode(), "twice: IF_L"),
    ],
)
def test_not_a_3d_tsv(tmp_path, name, content, message):
    (tmp_path / name).write_bytes(content)
    with pytest.raises(InputError, match=message):
        read_markers(tmp_path / name)


# -------------------- OpenSim


def coordinates(n=20):
    rng = np.random.default_rng(2)
    names = (*PELVIS_COORDINATES, "knee_angle_r")
    return CoordinateRecording(np.arange(n) / 50, {name: rng.uniform(0, 1, n) for name in names})


def test_coordinates_round_trip_bit_exact(tmp_path):
    given = coordinates()
    write_coordinates(tmp_path / "a.mot", given)
    read = read_coordinates(tmp_path / "a.mot")
    assert not read.findings
    for name, values in given.columns.items():
        rounding = 5e-9 if name.startswith("pelvis_t") and name != "pelvis_tilt" else np.radians(5e-9)
        np.testing.assert_allclose(read.columns[name], values, atol=1.01 * rounding, rtol=0)
    write_coordinates(tmp_path / "b.mot", read)
    assert (tmp_path / "a.mot").read_bytes() == (tmp_path / "b.mot").read_bytes()


def mot(tmp_path, text):
    path = tmp_path / "trial.mot"
    path.write_text(text)
    return path


def test_only_rotations_are_converted(tmp_path):
    text = "Coordinates\ninDegrees=yES\nendheader\ntime pelvis_tilt pelvis_tx\n0 90 1.5\n1 180 2.5\n"
    read = read_coordinates(mot(tmp_path, text))
    np.testing.assert_allclose(read.columns["pelvis_tilt"], [np.pi / 2, np.pi])
    np.testing.assert_array_equal(read.columns["pelvis_tx"], [1.5, 2.5])


@pytest.mark.parametrize(
    ("head", "values", "code"),
    [
        ("nRows=9\nnColumns=5\ninDegrees=no", "0.5", ["count", "count"]),
        ("inDegrees=no", "80", ["units_doubtful"]),
        ("version=1", "0.5", ["units_absent"]),
    ],
)
def test_coordinate_findings(tmp_path, head, values, code):
    text = f"Coordinates\n{head}\nendheader\ntime\thip_flexion_r\n0\t{values}\n1\t{values}\n"
    read = read_coordinates(mot(tmp_path, text))
    assert codes(read) == code
    np.testing.assert_array_equal(read.columns["hip_flexion_r"], [float(values)] * 2)


def test_negative_knee_is_reported_and_left(tmp_path):
    text = "inDegrees=yes\nendheader\ntime\tknee_angle_r\n0\t-60\n1\t-5\n"
    read = read_coordinates(mot(tmp_path, text))
    assert codes(read) == ["knee_sign"]
    np.testing.assert_allclose(np.degrees(read.columns["knee_angle_r"]), [-60, -5])


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "empty file"),
        ("pelvis_tilt\n0 1\n", "endheader"),
        ("endheader\ntime\tq1\n0\t60\n", "cannot be radians"),
        ("DataType=Quaternion\nendheader\ntime\tpelvis\n0\t1,0,0,0\n", "DataType=Quaternion"),
        ("inDegrees=no\nendheader\ntime\tq1\n0\t1\n0\t1\n", "time increasing"),
        ("inDegrees=no\nendheader\ntime\tq1\n0\t1\n1\n", "line 5\n"),
        ("inDegrees=no\nendheader\ntime\tq1\n0\tx\n", "line 4, column 2"),
        ("inDegrees=no\nendheader\ntime\tq1\tq1\n0\t1\t1\n", "twice: q1"),
        ("inDegrees=no\nendheader\ntime\tq1\n", "no data"),
        ("inDegrees=yes\nendheader\ntime\tground_force_vx\n0\t1\n", "forces"),
    ],
)
def test_coordinate_refusals(tmp_path, text, message):
    with pytest.raises(InputError) as error:
        read_coordinates(mot(tmp_path, text))
    assert message in str(error.value)


# -------------------- robot log


def robot_log(n=300, wrench=True, sync=(1.25,)):
    rng = np.random.default_rng(3)
    t = np.arange(n) / 100
    base = {name: rng.normal(size=n) for name in BASE_COLUMNS}
    joints = {name: rng.normal(size=(n, 2)) for name in ARM_JOINTS}
    log = RobotLog(1_767_225_600_000_000_000, t, base, t + 0.001, joints)
    if wrench:
        log.wrench_time_s, log.wrench = t + 0.002, rng.normal(size=(n, 6))
    log.sync_s = np.array(sync) if sync else None
    return log


def test_log_round_trip(tmp_path):
    given = robot_log(sync=(1.25, 2.5))
    write_log(tmp_path / "a.mcap", given)
    read = read_log(tmp_path / "a.mcap")
    assert read.start_ns == given.start_ns
    assert not read.findings
    np.testing.assert_allclose(read.base_time_s, given.base_time_s, atol=1e-9)
    np.testing.assert_allclose(read.joint_time_s, given.joint_time_s, atol=1e-9)
    np.testing.assert_allclose(read.sync_s, given.sync_s, atol=1e-9)
    for name in ("x", "y", "vx", "vy", "wz"):
        np.testing.assert_array_equal(read.base[name], given.base[name])
    np.testing.assert_allclose(np.sin(read.base["yaw"]), np.sin(given.base["yaw"]), atol=1e-14)
    for name in ARM_JOINTS:
        np.testing.assert_array_equal(read.joints[name], given.joints[name])
    np.testing.assert_array_equal(read.wrench, given.wrench)


def test_log_bytes_are_deterministic(tmp_path):
    for name in ("a.mcap", "b.mcap"):
        write_log(tmp_path / name, robot_log())
    assert (tmp_path / "a.mcap").read_bytes() == (tmp_path / "b.mcap").read_bytes()


def test_log_metadata_is_kept_and_deterministic(tmp_path):
    from mcap.reader import make_reader

    for name in ("a.mcap", "b.mcap"):
        write_log(tmp_path / name, robot_log(n=5), metadata={"notice": "synthetic"})
    assert (tmp_path / "a.mcap").read_bytes() == (tmp_path / "b.mcap").read_bytes()
    with open(tmp_path / "a.mcap", "rb") as stream:
        records = list(make_reader(stream).iter_metadata())
    assert [(record.name, record.metadata) for record in records] == [("real2sim", {"notice": "synthetic"})]
    assert len(read_log(tmp_path / "a.mcap").base_time_s) == 5


def test_log_reads_with_the_reference_decoder(tmp_path):
    from mcap.reader import make_reader
    from mcap_ros2.decoder import DecoderFactory

    given = robot_log(n=5)
    write_log(tmp_path / "a.mcap", given)
    with open(tmp_path / "a.mcap", "rb") as stream:
        reader = make_reader(stream, decoder_factories=[DecoderFactory()])
        messages = [(channel.topic, m) for _, channel, _, m in reader.iter_decoded_messages()]
    odometry = [m for topic, m in messages if topic == "/odom"]
    joints = [m for topic, m in messages if topic == "/joint_states"]
    wrenches = [m for topic, m in messages if topic == "/interface/wrench"]
    assert odometry[3].pose.pose.position.x == given.base["x"][3]
    assert odometry[3].twist.twist.angular.z == given.base["wz"][3]
    assert odometry[3].header.stamp.nanosec == 30_000_000
    assert list(joints[2].name) == list(ARM_JOINTS)
    assert joints[2].velocity[1] == given.joints["arm_roll"][2, 1]
    assert wrenches[1].wrench.torque.z == given.wrench[1, 5]
    assert [m.data for topic, m in messages if topic == "/sync"] == [False, True]


def test_a_missing_package_is_no_fault_of_the_log(tmp_path, monkeypatch):
    path = tmp_path / "log.mcap"
    write_log(path, robot_log(n=5))
    monkeypatch.setitem(sys.modules, "mcap_ros2.decoder", None)
    with pytest.raises(ImportError):
        read_log(path)


def test_log_without_wrench_and_sync(tmp_path):
    write_log(tmp_path / "a.mcap", robot_log(wrench=False, sync=None))
    read = read_log(tmp_path / "a.mcap")
    assert read.wrench is None
    assert read.sync_s is None
    assert codes(read) == ["no_sync"]


@pytest.mark.parametrize("keep", [0, 7, 40, 0.3, 0.9, -1])
def test_truncated_log_is_refused(tmp_path, keep):
    write_log(tmp_path / "a.mcap", robot_log())
    data = (tmp_path / "a.mcap").read_bytes()
    (tmp_path / "a.mcap").write_bytes(data[: int(keep * len(data)) if isinstance(keep, float) else keep])
    with pytest.raises(InputError, match=r"a\.mcap"):
        read_log(tmp_path / "a.mcap")


def test_every_flipped_byte_is_refused_or_harmless(tmp_path):
    write_log(tmp_path / "a.mcap", robot_log(n=20))
    good, data = read_log(tmp_path / "a.mcap"), bytearray((tmp_path / "a.mcap").read_bytes())
    for at in range(9, len(data), 97):
        broken = bytearray(data)
        broken[at] ^= 0x41
        (tmp_path / "b.mcap").write_bytes(broken)
        try:
            read = read_log(tmp_path / "b.mcap")
        except InputError:
            continue
        np.testing.assert_array_equal(read.base["x"], good.base["x"])


def write_messages(path, topic, type_name, definition, payloads, *, message_encoding="cdr", times=None):
    """One more topic beside a whole /joint_states."""
    from mcap.writer import Writer
    from real2sim.recording.formats import robot_log as module

    with open(path, "wb") as stream:
        writer = Writer(stream)
        writer.start(profile="ros2", library="test")
        text = module._schema_text(module.JOINT_STATE).encode()
        schema = writer.register_schema(name=module.JOINT_STATE, encoding="ros2msg", data=text)
        channel = writer.register_channel(topic="/joint_states", message_encoding="cdr", schema_id=schema)
        for i, payload in enumerate(module._messages(robot_log(n=5))["/joint_states"][1]):
            writer.add_message(channel_id=channel, log_time=i, publish_time=i, data=payload)
        schema = writer.register_schema(name=type_name, encoding="ros2msg", data=definition.encode())
        channel = writer.register_channel(topic=topic, message_encoding=message_encoding, schema_id=schema)
        for i, payload in enumerate(payloads):
            t = i if times is None else times[i]
            writer.add_message(channel_id=channel, log_time=t, publish_time=t, data=payload)
        writer.finish()


@pytest.mark.parametrize(
    ("case", "message"),
    [
        ("short", "not what its channel says"),
        ("long", "not what its channel says"),
        ("big-endian", "not what its channel says"),
        ("other fields", "not what its channel says"),
        ("json", "not JSON"),
        ("other type", "geometry_msgs/msg/Pose"),
        ("other topic", "topic /odom"),
    ],
)
def test_payloads_that_are_not_what_they_say_are_refused(tmp_path, case, message):
    from real2sim.recording.formats import robot_log as module

    payloads = module._messages(robot_log(n=5))["/odom"][1]
    topic, type_name, definition = "/odom", module.ODOMETRY, module._schema_text(module.ODOMETRY)
    if case == "short":
        payloads[3] = payloads[3][:-8]
    elif case == "long":
        payloads[3] += bytes(8)
    elif case == "big-endian":
        payloads[0] = b"\x00\x00" + payloads[0][2:]
    elif case == "other fields":
        definition = definition.replace("float64 x\nfloat64 y", "float64 y\nfloat32 x\nfloat32 pad", 1)
    elif case == "other type":
        type_name = "geometry_msgs/msg/Pose"
    elif case == "other topic":
        topic = "/odometry"
    encoding = "json" if case == "json" else "cdr"
    write_messages(tmp_path / "a.mcap", topic, type_name, definition, payloads, message_encoding=encoding)
    with pytest.raises(InputError) as error:
        read_log(tmp_path / "a.mcap")
    assert message in str(error.value)


def test_messages_out_of_order_and_without_stamps_are_ordered_by_log_time(tmp_path):
    from real2sim.recording.formats import robot_log as module

    given = robot_log(n=5)
    payloads = [payload[:4] + bytes(8) + payload[12:] for payload in module._messages(given)["/odom"][1]]
    times = [4, 0, 3, 1, 2]
    text = module._schema_text(module.ODOMETRY)
    write_messages(tmp_path / "a.mcap", "/odom", module.ODOMETRY, text, payloads, times=times)
    read = read_log(tmp_path / "a.mcap")
    np.testing.assert_array_equal(read.base["x"], given.base["x"][np.argsort(times)])
    assert "log_order" in codes(read)


def test_layout_rejects_random_bytes_quickly():
    from real2sim.recording.formats import robot_log as module

    rng = np.random.default_rng(4)
    for _ in range(300):
        payload = b"\x00\x01\x00\x00" + rng.bytes(rng.integers(0, 800))
        for name in module._FIELDS:
            if name == module.BOOL and len(payload) in range(5, 9):
                continue
            with pytest.raises((ValueError, struct.error)):
                module._layout(name, payload)
