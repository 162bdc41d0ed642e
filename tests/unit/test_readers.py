"""Readers of C3D, MAT, 6D, TRC, OpenSim tables and MCAP on small files made here; values and refusals."""

import json
import struct

import numpy as np
import pytest
from mcap.writer import CompressionType, Writer
from real2sim.errors import InputError
from real2sim.recording.formats import (
    c3d,
    detect,
    mat5,
    mcap_file,
    opensim,
    qualisys,
    qualisys_mat,
    robot_log,
    trc,
)
from real2sim.recording.formats.robot_log import ARM_JOINTS

from tests.fuzz import seeds


def codes(recording):
    return [finding.code for finding in recording.findings]


def refused(reader, path, code):
    with pytest.raises(InputError) as error:
        reader(path)
    assert error.value.code == code, error.value
    assert error.value.remedy
    assert code in str(error.value)


# -------------------- 6D

HEAD_6D = "NO_OF_FRAMES\t2\r\nFREQUENCY\t100\r\nDATA_INCLUDED\t6D\r\nBODY_NAMES\tArm\tLeg 1\r\n"
TURNED = "0.0\t1.0\t0.0\t-1.0\t0.0\t0.0\t0.0\t0.0\t1.0"  # by columns: 90 degrees about z
ROT = "\t".join(f"Rot[{i}]" for i in range(9))


def block(x, angles="10.0\t20.0\t90.0", residual="0.5", rot=TURNED):
    return f"{x}\t2000.0\t3000.0\t{angles}\t{residual}\t{rot}"


def bodies(tmp_path, layout, rows=None, angles=("Yaw", "Pitch", "Roll")):
    """Layouts: one list of names, blank cell after each body (2010); names on the first cell (2020)."""
    rows = rows or [(block(1000.0), block(-1000.0))] * 2
    own = "\t".join(["X", "Y", "Z", *angles, "Residual", ROT])
    if layout == "2010":
        names, body = own, ["\t".join(f"{cell}\t" for cell in row) for row in rows]
    else:
        names = f"Frame\tTime\tArm {own}\tLeg 1 {own}\t"
        body = [f"{i + 1}\t{i / 100:.5f}\t" + "\t".join(row) + "\t" for i, row in enumerate(rows)]
    path = tmp_path / "a_6D.tsv"
    path.write_text(HEAD_6D + names + "\r\n" + "\r\n".join(body) + "\r\n", newline="")
    return path


@pytest.mark.parametrize("layout", ["2010", "2020"])
def test_pose_comes_from_the_columns_of_rot_and_angles_by_name(tmp_path, layout):
    read = qualisys.read_bodies(bodies(tmp_path, layout))
    assert list(read.positions) == ["Arm", "Leg 1"]
    np.testing.assert_allclose(read.positions["Leg 1"], [[-1.0, 2.0, 3.0]] * 2)
    np.testing.assert_allclose(read.rotations["Arm"][0], [[0, -1, 0], [1, 0, 0], [0, 0, 1]])
    assert list(read.angles_rad["Arm"]) == ["Yaw", "Pitch", "Roll"]
    np.testing.assert_allclose(read.angles_rad["Arm"]["Roll"], np.pi / 2)
    np.testing.assert_allclose(read.residual_m["Arm"], 5e-4)
    assert read.findings == []


def test_lost_body_is_missing_and_no_rotation_is_reported(tmp_path):
    lost = block(0.0, "0.0\t0.0\t0.0", "-1.00000", "\t".join(["0.0"] * 9))
    wrong = block(1.0, rot=TURNED.replace("-1.0", "-0.9"))
    read = qualisys.read_bodies(bodies(tmp_path, "2010", [(lost, block(1.0)), (wrong, block(1.0))]))
    assert np.isnan(read.positions["Arm"]).all()
    assert np.isnan(read.rotations["Arm"]).all()
    assert np.isfinite(read.positions["Leg 1"]).all()
    assert codes(read) == ["rotation", "body_lost"]


def test_6d_refusals(tmp_path):
    path = bodies(tmp_path, "2010")
    refused(detect.read_markers, path, "wrong_kind")
    text = path.read_text()
    path.write_text(text.replace("Rot[8]", "Rot[9]"))
    refused(qualisys.read_bodies, path, "columns")
    path.write_text(text.replace("-1000.0\t", "", 1))
    refused(qualisys.read_bodies, path, "row_cells")
    path.write_text(text.replace("6D", "Force"))
    refused(detect.read, path, "wrong_kind")


# -------------------- 3D: what must not shift


@pytest.mark.parametrize("extra", ["", "\t"])
def test_a_row_with_a_cell_too_many_is_refused_even_if_its_last_marker_is_missing(tmp_path, extra):
    row = "1\t2\t3\t\t\t"
    head = "NO_OF_FRAMES\t3\nFREQUENCY\t100\nMARKER_NAMES\tA\tB\n"
    path = tmp_path / "a.tsv"
    path.write_text(head + "\n".join([row + extra] * 3) + "\n")
    np.testing.assert_allclose(qualisys.read_markers(path).positions["A"], [[0.001, 0.002, 0.003]] * 3)
    path.write_text(head + "\n".join([row + extra, "9\t" + row + extra, row + extra]) + "\n")
    refused(qualisys.read_markers, path, "row_cells")


def test_fast_and_slow_parsers_give_the_same_bits(tmp_path):
    rng = np.random.default_rng(3)
    positions = {f"M {i}": rng.normal(0, 2, (900, 3)) for i in range(20)}
    positions["M 3"][5:9] = np.nan
    path = tmp_path / "a.tsv"
    qualisys.write_markers(path, qualisys.MarkerRecording(np.arange(900) / 100, 100.0, positions))
    from real2sim.recording.formats import text

    fast = qualisys.read_markers(path)
    large, text._LARGE = text._LARGE, 10**9
    try:
        slow = qualisys.read_markers(path)
    finally:
        text._LARGE = large
    for name in positions:
        np.testing.assert_array_equal(fast.positions[name], slow.positions[name])


@pytest.mark.parametrize("rate", [60.0, 100.0, 119.88, 256.0, 1000.0])
@pytest.mark.parametrize("first_frame", [1, 4364])
def test_written_markers_read_bit_exact_at_every_rate(tmp_path, rate, first_frame):
    rng = np.random.default_rng(4)
    positions = {f"M {i}": rng.normal(0, 3, (400, 3)) for i in range(3)}
    given = qualisys.MarkerRecording((first_frame - 1 + np.arange(400)) / rate, rate, positions, first_frame)
    qualisys.write_markers(tmp_path / "a.tsv", given)
    read = detect.read_markers(tmp_path / "a.tsv")
    assert (read.rate_hz, read.first_frame, read.findings) == (rate, first_frame, [])
    for name, values in positions.items():
        np.testing.assert_array_equal(read.positions[name], np.round(values * 1000, 3) / 1000)
    qualisys.write_markers(tmp_path / "b.tsv", read)
    assert (tmp_path / "a.tsv").read_bytes() == (tmp_path / "b.tsv").read_bytes()


def test_written_log_reads_bit_exact_twice(tmp_path):
    log = seeds.robot_log(n=50)
    robot_log.write_log(tmp_path / "a.mcap", log)
    first = detect.read_log(tmp_path / "a.mcap")
    robot_log.write_log(tmp_path / "b.mcap", first)
    second = detect.read_log(tmp_path / "b.mcap")
    same_log(first, log)
    same_log(second, first)
    np.testing.assert_array_equal(first.wrench, log.wrench)
    np.testing.assert_array_equal(first.sync_s, second.sync_s)


def test_frame_and_time_must_agree(tmp_path):
    rows = [f"{i}\t{(i - 1) / 100 + (0.02 if i > 5 else 0):.5f}\t1\t2\t3" for i in range(1, 400)]
    head = "FREQUENCY\t100\nMARKER_NAMES\tA\nFrame\tTime\tA X\tA Y\tA Z\n"
    path = tmp_path / "a.tsv"
    path.write_text(head + "\n".join(rows) + "\n")
    refused(qualisys.read_markers, path, "frame_time")


# -------------------- C3D


@pytest.fixture
def points():
    return seeds.banded(n=8)


def test_c3d(tmp_path, points):
    path = tmp_path / "a.c3d"
    seeds.write_c3d(path, points, rate=200.0, missing=((2, 1), (3, 1)))
    read = detect.read_markers(path)
    assert list(read.positions) == list(points)
    assert read.rate_hz == 200.0
    np.testing.assert_allclose(read.time_s, np.arange(8) / 200)
    for name, values in points.items():
        given = values.astype(np.float32)
        if name == "M 1":
            given[2:4] = np.nan
        np.testing.assert_allclose(read.positions[name], given, rtol=1e-6)
    assert np.isnan(read.residual_m["M 1"][2])


def integer_c3d(points, processor, *, events=False, units=b"mm", labels=None):
    """A C3D by hand: int16, of any processor; points are (frames, n, 3) in tenths of the unit."""
    order = ">" if processor == 86 else "<"

    def real(value):
        raw = struct.pack(f"{order}f", value * (4 if processor == 85 else 1))
        return raw[2:] + raw[:2] if processor == 85 else raw

    def parameter(group, name, kind, dimensions, data):
        body = struct.pack("bB", kind, len(dimensions)) + bytes(dimensions) + data + b"\0"
        return struct.pack("bb", len(name), group) + name + struct.pack(f"{order}h", len(body) + 2) + body

    def group(number, name):
        return struct.pack("bb", len(name), -number) + name + struct.pack(f"{order}h", 3) + b"\0"

    frames, n, _ = points.shape
    labels = labels or [f"P{i}" for i in range(n)]
    text = b"".join(label.encode().ljust(4) for label in labels)
    records = group(1, b"POINT")
    records += parameter(1, b"UNITS", -1, [len(units)], units)
    records += parameter(1, b"RATE", 4, [], real(50.0))
    records += parameter(1, b"LABELS", -1, [4, len(labels)], text)
    if events:
        records += group(2, b"EVENT") + parameter(2, b"USED", 2, [], struct.pack(f"{order}h", 1))
        records += parameter(2, b"LABELS", -1, [3, 1], b"LHS")
        records += parameter(2, b"TIMES", 4, [2, 1], real(1.0) + real(3.5))
    section = (bytes([1, 80, 1, processor]) + records).ljust(512, b"\0")
    header = bytes([2, 80]) + struct.pack(f"{order}5H", n, 0, 101, 100 + frames, 0) + real(0.1)
    header += struct.pack(f"{order}2H", 3, 0) + real(50.0)
    fourth = np.full((frames, n, 1), 5)
    fourth[0, 0] = -1
    data = np.concatenate([points, fourth], axis=2).astype(f"{order}i2").tobytes()
    return header.ljust(512, b"\0") + section + data


@pytest.mark.parametrize("processor", [84, 85, 86])
def test_c3d_of_every_processor_keeps_its_frames_and_events(tmp_path, processor):
    given = np.arange(2 * 3 * 3).reshape(2, 3, 3) * 100
    path = tmp_path / "a.c3d"
    path.write_bytes(integer_c3d(given, processor, events=True))
    read = c3d.read_c3d(path)
    np.testing.assert_allclose(read.positions["P2"], given[:, 2] * 0.1 / 1000, rtol=1e-6)
    assert np.isnan(read.positions["P0"][0]).all()
    np.testing.assert_allclose(read.residual_m["P1"], 0.5e-3, rtol=1e-6)
    assert read.first_frame == 101
    np.testing.assert_allclose(read.time_s, [2.0, 2.02])
    assert [(e.label, e.time_s) for e in read.events] == [("LHS", 63.5)]


def test_c3d_repeated_names_belong_to_nobody(tmp_path):
    path = tmp_path / "a.c3d"
    path.write_bytes(integer_c3d(np.ones((2, 3, 3)), 84, labels=["A", "B", "A"]))
    read = c3d.read_c3d(path)
    assert list(read.positions) == ["A #1", "B", "A #3"]
    assert codes(read) == ["names_repeated"]


def test_c3d_refusals(tmp_path):
    path = tmp_path / "a.c3d"
    whole = integer_c3d(np.ones((2, 3, 3)), 84)
    path.write_bytes(whole[:-1])
    refused(c3d.read_c3d, path, "damaged")
    path.write_bytes(integer_c3d(np.ones((2, 3, 3)), 84, units=b"ft"))
    refused(c3d.read_c3d, path, "units")
    path.write_bytes(b"MATLAB")
    refused(c3d.read_c3d, path, "header")


# -------------------- MAT


@pytest.mark.parametrize("options", [{}, {"do_compression": True}])
def test_mat(tmp_path, points, options):
    path = tmp_path / "a.mat"
    points["M 2"][3] = np.nan
    seeds.write_mat(path, points, rate=120.0, **options)
    read = detect.read_markers(path)
    assert list(read.positions) == list(points)
    assert (read.rate_hz, read.first_frame) == (120.0, 1)
    for name, values in points.items():
        np.testing.assert_allclose(read.positions[name], values, rtol=1e-14)
    np.testing.assert_allclose(read.residual_m["M 0"], 5e-4)


def test_mat_reads_like_scipy(tmp_path):
    import scipy.io

    path = tmp_path / "a.mat"
    given = {
        "a": {"text": "hello", "cell": np.array(["x", np.arange(6.0).reshape(2, 3)], dtype=object)},
        "numbers": np.arange(24, dtype=np.int16).reshape(2, 3, 4),
        "single": np.float32(1.5),
    }
    scipy.io.savemat(path, given)
    read = mat5.variables(path.read_bytes())
    assert read["a"]["text"] == "hello"
    assert read["a"]["cell"][0] == "x"
    np.testing.assert_array_equal(read["a"]["cell"][1], given["a"]["cell"][1])
    np.testing.assert_array_equal(read["numbers"], given["numbers"])
    assert read["single"].reshape(()) == 1.5


def test_mat_type_0_is_missing_and_filled_samples_are_reported(tmp_path, points):
    import scipy.io

    path = tmp_path / "a.mat"
    seeds.write_mat(path, points)
    root = scipy.io.loadmat(path, simplify_cells=True)["trial"]
    kinds = np.ones((5, 8), np.uint8)
    kinds[1, 2], kinds[3, 4:6] = 0, 2
    root["Trajectories"]["Labeled"]["Type"] = kinds
    root["Trajectories"]["Labeled"]["Labels"] = np.array(list(points), dtype=object)
    root["Frames"] = 9.0
    scipy.io.savemat(path, {"trial": root}, oned_as="row")
    read = qualisys_mat.read_mat(path)
    assert codes(read) == ["count", "not_measured"]
    assert np.isnan(read.positions["M 1"][2]).all()
    assert np.isfinite(read.positions["M 3"]).all()


def test_mat_refusals(tmp_path, points):
    import scipy.io

    path = tmp_path / "a.mat"
    scipy.io.savemat(path, {"x": np.arange(3.0)})
    refused(detect.read_markers, path, "wrong_kind")
    path.write_bytes(b"\x89HDF\r\n\x1a\n" + bytes(600))
    refused(detect.read_markers, path, "mat_version")
    seeds.write_mat(path, points)
    path.write_bytes(path.read_bytes()[:-40])
    refused(detect.read_markers, path, "damaged")


# -------------------- TRC


def trc_file(tmp_path, change=lambda text: text, unit="mm"):
    positions = seeds.banded(n=6)
    positions["M 4"][2] = np.nan
    path = tmp_path / "a.trc"
    path.write_text(change(seeds.trc_text(positions, unit)))
    return path, positions


@pytest.mark.parametrize(
    ("change", "finding"),
    [
        (lambda text: text, []),
        (lambda text: text.replace("\n1\t", "\n\t\t\t\n1\t", 1).replace("\n", "\r\n"), []),
        (lambda text: text.replace("\t100\t6\t5\t", "\t100\t900\t5\t"), ["count"]),
        (lambda text: text.replace("\t100\t6\t5\t", "\t100\t6\t28\t"), ["count"]),
        (lambda text: text.replace("PathFileType\t4\t", "PathFileType  4\t"), []),
        (lambda text: text.replace("M 0\t\t\tM 1\t\t\tM 2\t\t\tM 3\t\t\tM 4", "M 0\tM 1\tM 2\tM 3\tM 4"), []),
        (lambda text: text.replace("\n100\t", "\n50\t"), ["rate_differs"]),
    ],
)
def test_trc(tmp_path, change, finding):
    path, positions = trc_file(tmp_path, change)
    read = detect.read_markerless(path)
    assert codes(read) == finding
    assert read.rate_hz == pytest.approx(100)
    for name, values in positions.items():
        np.testing.assert_allclose(read.positions[name], values, atol=1e-9)


def test_trc_in_metres(tmp_path):
    path, positions = trc_file(tmp_path, unit="m")
    np.testing.assert_allclose(trc.read_landmarks(path).positions["M 1"], positions["M 1"] * 1000)


@pytest.mark.parametrize(
    ("change", "code"),
    [
        (lambda text: text.replace("\tmm\t", "\tft\t"), "units"),
        (lambda text: text.replace("M 1\t\t\t", "M 1\t\t"), "columns"),
        (lambda text: text.replace("\tZ5", ""), "columns"),
        (lambda text: text.replace("M 1", "M 0"), "names"),
        (lambda text: text.replace("\n3\t", "\n3\t\t"), "row_cells"),
        (lambda text: text.replace("\n3\t0.02", "\n3\t0.00"), "time_order"),
        (lambda text: "\n".join(text.splitlines()[:5]), "no_data"),
        (lambda text: text.replace("Frame#", "Frame"), "header"),
    ],
)
def test_trc_refusals(tmp_path, change, code):
    refused(trc.read_landmarks, trc_file(tmp_path, change)[0], code)


# -------------------- OpenSim tables


def table(tmp_path, text, name="a.sto"):
    path = tmp_path / name
    path.write_text(text)
    return path


@pytest.mark.parametrize(
    ("data_type", "cells", "width"),
    [
        ("Vec3", "1,2,3", 3),
        ("Quaternion", "0.5,0.5,0.5,0.5", 4),
        ("Vec3", "~[1,2,3]", 3),
        ("Vec6", "1,2,3,4,5,6", 6),
    ],
)
def test_storage_of_vectors(tmp_path, data_type, cells, width):
    text = (
        f"DataType={data_type}\nversion=3\nendheader\ntime\tp\tq\n0\t{cells}\t{cells}\n1\t{cells}\t{cells}\n"
    )
    path = table(tmp_path, text)
    read = detect.read(path)
    assert read.columns["q"].shape == (2, width)
    np.testing.assert_allclose(read.columns["p"][1], [float(v) for v in cells.strip("~[]").split(",")])
    refused(detect.read_markerless, path, "wrong_kind")
    refused(detect.read, table(tmp_path, text.replace(f"\t{cells}\n", "\t1,2\n", 1)), "row_cells")


def test_simm_header_counts(tmp_path):
    head = "name walk\ndatacolumns 9\ndatarows 2\notherdata 1\nrange 0 1\ninDegrees=yes\nendheader\n"
    read = opensim.read_coordinates(table(tmp_path, f"{head}time hip_flexion_r\n0 90\n1 180\n"))
    assert codes(read) == ["count"]
    np.testing.assert_allclose(read.columns["hip_flexion_r"], [np.pi / 2, np.pi])


def test_table_without_header(tmp_path):
    read = detect.read_markerless(table(tmp_path, "time\tknee_angle_r\n0\t0.1\n1\t0.2\n", "a.mot"))
    assert codes(read) == ["header_absent", "units_absent"]
    np.testing.assert_array_equal(read.columns["knee_angle_r"], [0.1, 0.2])


@pytest.mark.parametrize("stated", ["yes", "yES", "y", "true"])
def test_in_degrees_however_written(tmp_path, stated):
    text = f"inDegrees={stated}\nendheader\ntime\tq1\n0\t90\n1\t90\n"
    assert opensim.read_coordinates(table(tmp_path, text)).columns["q1"][0] == pytest.approx(np.pi / 2)


def test_in_degrees_as_text_and_contradicted(tmp_path):
    text = "Angles are in degrees.\nendheader\ntime\thip_flexion_r\n0\t90\n1\t90\n"
    assert opensim.read_coordinates(table(tmp_path, text)).columns["hip_flexion_r"][0] == pytest.approx(
        np.pi / 2
    )
    read = opensim.read_coordinates(table(tmp_path, "inDegrees=no\n" + text))
    assert codes(read) == ["units_doubtful"]
    assert read.columns["hip_flexion_r"][0] == 90
    refused(
        opensim.read_coordinates,
        table(tmp_path, text.replace("Angles are in", "inDegrees=")),
        "units_ambiguous",
    )


def test_speeds_are_left_out(tmp_path):
    text = "inDegrees=yes\nendheader\ntime\thip_flexion_r\thip_flexion_r_u\n0\t90\t1\n1\t90\t1\n"
    read = opensim.read_coordinates(table(tmp_path, text))
    assert list(read.columns) == ["hip_flexion_r"]
    assert codes(read) == ["other_states"]


# -------------------- one path


def test_extension_is_compared_with_the_content(tmp_path, points):
    path = tmp_path / "a.tsv"
    seeds.write_mat(path, points)
    assert codes(detect.read_markers(path)) == ["extension"]
    refused(detect.read_markerless, path, "wrong_kind")
    refused(detect.read_log, path, "wrong_kind")
    (tmp_path / "a.mcap").write_text("time,base_x\n0,0\n1,0\n")
    with pytest.raises(InputError, match="convert the log to MCAP"):
        detect.read_log(tmp_path / "a.mcap")
    (tmp_path / "b.tsv").write_text("hello")
    refused(detect.read_markers, tmp_path / "b.tsv", "unknown_format")
    refused(detect.read_markers, tmp_path / "none.tsv", "unreadable")
    (tmp_path / "b.tsv").write_bytes(b"PNG\0\0")
    refused(detect.read, tmp_path / "b.tsv", "unknown_format")


# -------------------- MCAP


def log_file(tmp_path, form, **options):
    log = seeds.robot_log(n=40)
    path = tmp_path / f"{form}.mcap"
    if form == "json":
        seeds.write_json_log(path, log)
    elif form == "protobuf":
        write_protobuf_log(path, log)
    else:
        robot_log.write_log(path, log)
    if options:
        whole, path = path, tmp_path / "other.mcap"
        seeds.unchecked(whole, path, **options)
    return path, log


def same_log(read, log):
    for name in ("x", "y", "vx", "vy", "wz"):
        np.testing.assert_array_equal(read.base[name], log.base[name])
    for name in ARM_JOINTS:
        np.testing.assert_array_equal(read.joints[name], log.joints[name])
    np.testing.assert_allclose(np.sin(read.base["yaw"]), np.sin(log.base["yaw"]), atol=1e-14)
    np.testing.assert_allclose(read.base_time_s, log.base_time_s, atol=1e-9)


@pytest.mark.parametrize("form", ["cdr", "json", "protobuf"])
@pytest.mark.parametrize(
    "options",
    [
        {},
        {"compression": CompressionType.LZ4},
        {"compression": CompressionType.NONE},
        {"use_chunking": False},
        {
            "use_chunking": False,
            "use_statistics": False,
            "use_summary_offsets": False,
            "repeat_channels": False,
        },
    ],
)
def test_log_however_stored(tmp_path, form, options):
    path, log = log_file(tmp_path, form, **options)
    read = detect.read_log(path)
    same_log(read, log)
    assert set(codes(read)) <= {"no_sync", "stamps_absent"}


def odometry_proto():
    """Classes of Odometry and JointState as a protobuf log would define them."""
    from google.protobuf import descriptor_pb2, descriptor_pool, message_factory

    file = descriptor_pb2.FileDescriptorProto(name="robot.proto", package="robot", syntax="proto3")
    fields = {
        "Vector3": [(n, 1, None) for n in "xyz"],
        "Quaternion": [(n, 1, None) for n in "xyzw"],
        "Pose": [("position", 11, "Vector3"), ("orientation", 11, "Quaternion")],
        "PoseWithCovariance": [("pose", 11, "Pose")],
        "Twist": [("linear", 11, "Vector3"), ("angular", 11, "Vector3")],
        "TwistWithCovariance": [("twist", 11, "Twist")],
        "Odometry": [("pose", 11, "PoseWithCovariance"), ("twist", 11, "TwistWithCovariance")],
        "JointState": [("name", -9, None), ("position", -1, None), ("velocity", -1, None)],
    }
    for name, members in fields.items():
        message = file.message_type.add(name=name)
        for number, (member, kind, type_name) in enumerate(members, start=1):
            message.field.add(
                name=member,
                number=number,
                type=abs(kind),
                label=3 if kind < 0 else 1,
                type_name=f".robot.{type_name}" if type_name else None,
            )
    pool = descriptor_pool.DescriptorPool()
    pool.Add(file)
    get = message_factory.GetMessageClass
    classes = [get(pool.FindMessageTypeByName(f"robot.{name}")) for name in ("Odometry", "JointState")]
    return descriptor_pb2.FileDescriptorSet(file=[file]).SerializeToString(), *classes


def write_protobuf_log(path, log, change=lambda payload: payload):
    from google.protobuf.json_format import ParseDict

    definition, odometry, joint_state = odometry_proto()
    kinds = {"/odom": odometry, "/joint_states": joint_state}
    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start()
        channels = {}
        for topic, stamp, message in seeds.json_messages(log):
            kind = kinds[topic]
            if topic not in channels:
                schema = writer.register_schema(kind.DESCRIPTOR.full_name, "protobuf", definition)
                channels[topic] = writer.register_channel(topic, "protobuf", schema)
            data = change(ParseDict(message, kind()).SerializeToString())
            writer.add_message(channels[topic], stamp, data, stamp)
        writer.finish()


def test_protobuf_payload_with_other_fields_is_refused(tmp_path):
    path = tmp_path / "a.mcap"
    write_protobuf_log(path, seeds.robot_log(n=3), lambda payload: payload + b"\xf8\x06\x01")
    refused(robot_log.read_log, path, "payload")
    write_protobuf_log(path, seeds.robot_log(n=3), lambda payload: b"")
    refused(robot_log.read_log, path, "field_missing")


@pytest.mark.parametrize(
    ("old", "new", "code"),
    [
        ('"orientation"', '"orient"', "field_missing"),
        ('"x": ', '"x": true, "was": ', "payload"),
        ('"w": ', '"w": 9', "quaternion"),
        ('"w": ', '"w": 1e300, "was": ', "quaternion"),
        # w, x, y, z in the place of x, y, z, w
        (
            '"orientation": {',
            '"orientation": {"x": 1.0, "y": 0.0, "z": 0.0, "w": 0.0}, "was": {',
            "quaternion",
        ),
        ('"linear": {"x": ', '"linear": {"x": NaN, "was": ', "not_finite"),
        ('"pose": {"pose"', '"pose": [{"pose"', "payload"),
        ('"name": [', '"name": ["arm_lift", ', "names"),
        ('"name": ["arm_lift", ', '"name": [', "joint_missing"),
    ],
)
def test_json_log_refusals(tmp_path, monkeypatch, old, new, code):
    whole = json.dumps
    monkeypatch.setattr(seeds.json, "dumps", lambda message: whole(message).replace(old, new))
    path = tmp_path / "a.mcap"
    seeds.write_json_log(path, seeds.robot_log(n=3))
    refused(robot_log.read_log, path, code)


def raw_log(tmp_path, encoding, schema, payload=b"x", topic="/odom"):
    path = tmp_path / "a.mcap"
    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start()
        number = writer.register_schema(robot_log.ODOMETRY, schema, b"") if schema else 0
        channel = writer.register_channel(topic, encoding, number)
        writer.add_message(channel, 1, payload, 1)
        writer.finish()
    return path


@pytest.mark.parametrize(
    ("encoding", "schema", "code"),
    [
        ("raw", "", "encoding"),
        ("cdr", "ros2idl", "encoding"),
        ("cdr", "ros2msg", "payload"),
        ("protobuf", "protobuf", "schema"),
    ],
)
def test_log_encodings_that_are_refused(tmp_path, encoding, schema, code):
    refused(robot_log.read_log, raw_log(tmp_path, encoding, schema), code)


def test_log_damage(tmp_path):
    path, _ = log_file(tmp_path, "cdr")
    whole = path.read_bytes()
    path.write_bytes(whole[:-100])
    refused(detect.read_log, path, "truncated")
    at = whole.index(b"zstd") + 40
    path.write_bytes(whole[:at] + bytes([whole[at] ^ 1]) + whole[at + 1 :])
    with pytest.raises(InputError) as error:
        detect.read_log(path)
    assert error.value.code in ("damaged", "checksum")
    path.write_bytes(whole.replace(b"zstd", b"none").replace(b"none", b"brot", 1))
    with pytest.raises(InputError) as error:
        detect.read_log(path)
    assert error.value.code in ("compression", "checksum")
    flat, _ = log_file(tmp_path, "json", compression=CompressionType.NONE, use_chunking=True)
    assert len(detect.read_log(flat).base_time_s) == 40


def test_wrong_checksum_and_wrong_statistics(tmp_path):
    path = tmp_path / "a.mcap"
    with path.open("wb") as stream:
        writer = Writer(stream, compression=CompressionType.NONE)
        writer.start()
        channel = writer.register_channel("/a", "json", 0)
        writer.add_message(channel, 1, b'"hello"', 1)
        writer.finish()
    whole = path.read_bytes()
    path.write_bytes(whole.replace(b"hello", b"jello"))
    with pytest.raises(InputError) as error:
        list(mcap_file.read_messages(path))
    assert error.value.code == "checksum"
    body = struct.pack("<QHIIIIQQ", 1, 0, 1, 0, 0, 1, 1, 1)
    assert body[:10] in whole
    path.write_bytes(whole.replace(body[:10], struct.pack("<QH", 7, 0)))
    contents = mcap_file.Contents()
    assert [m.data for m in mcap_file.read_messages(path, contents)] == [b'"hello"']
    assert [f.code for f in contents.findings] == ["count"]


def test_two_publishers_of_one_topic_with_different_messages(tmp_path):
    path = tmp_path / "a.mcap"
    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start()
        for encoding in ("json", "protobuf"):
            channel = writer.register_channel("/sync", encoding, 0)
            writer.add_message(channel, 1, b'{"data": true}', 1)
        writer.finish()
    refused(robot_log.read_log, path, "message_type")


def test_a_csv_under_the_name_of_a_log_is_called_a_table_of_text(tmp_path):
    path = tmp_path / "a.mcap"
    path.write_text("time;arm_lift\n0,01;0,5\n")
    with pytest.raises(InputError) as caught:
        detect.read_log(path)
    assert (caught.value.code, caught.value.found) == ("wrong_kind", "a table of text, such as a CSV")
    path.write_text("inDegrees=no\nendheader\ntime\tpelvis_tx\n0.0\t0.0\n")
    with pytest.raises(InputError, match=r"an OpenSim \.mot or \.sto"):
        detect.read_log(path)
