"""Sound exports that are written in unusual ways are read, and what contradicts itself is reported or refused."""

import struct

import numpy as np
import pytest
from readings import codes, refusal
from real2sim.recording.formats import detect, opensim, qualisys, trc

from tests.fuzz import seeds


def written(tmp_path, text, name="trial.mot"):
    path = tmp_path / name
    path.write_text(text)
    return path


# -------------------- text: dividers and ends of rows

MOT = "inDegrees=no\nendheader\ntime\tpelvis_tilt\tpelvis_tx\n0\t0.1\t1\n1\t0.2\t2\n2\t0.3\t3\n"


@pytest.mark.parametrize(
    "text",
    [
        MOT.replace("\t", ","),
        MOT.replace("\t", ", "),
        MOT.replace("\t", ",").replace("endheader", "endheader,,").replace("=no", "=no,,"),
    ],
    ids=["commas", "commas and blanks", "saved by a spreadsheet"],
)
@pytest.mark.parametrize("name", ["trial.mot", "trial.sto"])
def test_coordinates_divided_by_commas(tmp_path, text, name):
    read = detect.read_markerless(written(tmp_path, text, name))
    np.testing.assert_array_equal(read.columns["pelvis_tilt"], [0.1, 0.2, 0.3])
    np.testing.assert_array_equal(read.columns["pelvis_tx"], [1, 2, 3])
    assert codes(read) == ["commas"]


def test_decimal_commas_are_no_dividers(tmp_path):
    text = MOT.replace("0.1", "0,1")
    assert refusal(detect.read_markerless, written(tmp_path, text)).code == "not_a_number"


def test_landmarks_divided_by_commas(tmp_path):
    positions = seeds.banded(n=6)
    positions["M 4"][2] = np.nan
    path = written(tmp_path, seeds.trc_text(positions).replace("\t", ","), "trial.trc")
    read = detect.read_markerless(path)
    for name, values in positions.items():
        np.testing.assert_allclose(read.positions[name], values, atol=1e-9)
    assert codes(read) == ["commas"]


HEAD = "NO_OF_FRAMES\t3\nFREQUENCY\t100\nMARKER_NAMES\tA\tB\n"
ROWS = ["1.5\t2.5\t3.5\t4.5\t5.5\t6.5\t", "1.0\t2.0\t3.0\t4.0\t5.0\t6.0\t", "1.1\t2.1\t3.1\t4.1\t5.1\t6.1"]


@pytest.mark.parametrize("end", ["\n", ""])
def test_a_last_row_without_its_tab(tmp_path, end):
    path = written(tmp_path, HEAD + "\n".join(ROWS) + end, "trial.tsv")
    np.testing.assert_allclose(qualisys.read_markers(path).positions["B"][-1], [0.0041, 0.0051, 0.0061])


@pytest.mark.parametrize(
    "last", ["1.1\t2.1\t3.1\t4.1\t5.1\t", "1.1\t2.1\t3.1\t4.1\t5.1\t6", "1.1\t2.1\t3.1\t4.1\t5.1"]
)
def test_a_last_row_that_breaks_off_is_refused(tmp_path, last):
    path = written(tmp_path, HEAD + "\n".join([*ROWS[:2], last]), "trial.tsv")
    assert refusal(qualisys.read_markers, path).code == "row_cells"


def test_a_row_in_the_middle_without_its_tab_is_refused(tmp_path):
    path = written(tmp_path, HEAD + "\n".join([ROWS[2], *ROWS[:2]]) + "\n", "trial.tsv")
    assert refusal(qualisys.read_markers, path).code == "row_cells"


def test_landmarks_whose_last_row_lacks_its_tab(tmp_path):
    positions = seeds.banded(n=6)
    lines = seeds.trc_text(positions).splitlines()
    text = "\n".join([*lines[:5], *(line + "\t" for line in lines[5:-1]), lines[-1]]) + "\n"
    read = trc.read_landmarks(written(tmp_path, text, "trial.trc"))
    np.testing.assert_allclose(read.positions["M 4"], positions["M 4"], atol=1e-9)


# -------------------- OpenSim: outputs of its tools


def test_states_beside_columns_of_the_forceset(tmp_path):
    text = (
        "states\ninDegrees=no\nDataType=double\nversion=3\nendheader\n"
        "time\t/jointset/ground_pelvis/pelvis_tilt/value\t/jointset/ground_pelvis/pelvis_tilt/speed\t"
        "/forceset/soleus_r/activation\t/forceset/soleus_r/normalized_tendon_force\n"
        "0\t0.1\t1\t0.5\t7\n1\t0.2\t1\t0.5\t7\n"
    )
    read = detect.read_markerless(written(tmp_path, text, "trial.sto"))
    assert list(read.columns) == ["pelvis_tilt"]
    assert codes(read) == ["other_states"]
    only = "inDegrees=no\nendheader\ntime\t/forceset/soleus_r/activation\n0\t1\n1\t1\n"
    assert refusal(detect.read_markerless, written(tmp_path, only, "forces.sto")).code == "wrong_kind"


def test_states_of_opensim_3_are_no_angles(tmp_path):
    text = "inDegrees=yes\nendheader\ntime\tknee_angle_r\tknee_angle_r_u\tsoleus_r.activation\n0\t9\t1\t2\n1\t8\t1\t2\n"
    read = detect.read_markerless(written(tmp_path, text, "trial.sto"))
    assert list(read.columns) == ["knee_angle_r"]


@pytest.mark.parametrize("title", ["Speeds", "Accelerations"])
def test_speeds_are_no_coordinates(tmp_path, title):
    path = written(tmp_path, f"{title}\n{MOT}", "trial.sto")
    assert refusal(detect.read_markerless, path).code == "wrong_kind"
    assert list(opensim.read_storage(path).columns) == ["pelvis_tilt", "pelvis_tx"]


@pytest.mark.parametrize(("last", "severity"), [("2\t0.3\t3\n", "info"), ("2\t0.4\t3\n", "warning")])
def test_a_last_time_that_is_repeated(tmp_path, last, severity):
    read = detect.read_markerless(written(tmp_path, f"nRows=4\n{MOT}{last}", "trial.sto"))
    np.testing.assert_array_equal(read.time_s, [0, 1, 2])
    np.testing.assert_array_equal(read.columns["pelvis_tilt"], [0.1, 0.2, 0.3])
    assert [(f.code, f.severity) for f in read.findings] == [("time_repeated", severity)]
    path = written(tmp_path, MOT + last * 2, "thrice.sto")
    assert refusal(detect.read_markerless, path).code == "time_order"


# -------------------- C3D that contradicts itself, or is written otherwise

HEADER = {"points": 2, "first": 1, "last": 3, "scale": 0.1, "samples": 2, "analogs": 6, "rate": 100.0}
PARAMETERS = {
    ("POINT", "USED"): 2,
    ("POINT", "FRAMES"): 3,
    ("POINT", "SCALE"): 0.1,
    ("POINT", "RATE"): 100.0,
    ("POINT", "UNITS"): "mm",
    ("POINT", "LABELS"): ["A", "B"],
    ("ANALOG", "USED"): 3,
}


def c3d_bytes(header=None, parameters=None, fourth=5, pad=" ", size=None):
    """A small C3D of integers: 2 points, 3 frames, 3 analog channels of 2 samples; 512 bytes of header, parameters."""
    head = HEADER | (header or {})
    records = b""
    groups = {"POINT": 1, "ANALOG": 2}
    for name, number in groups.items():
        records += struct.pack("bb", len(name), -number) + name.encode() + struct.pack("<h", 3) + b"\0"
    for (group, name), value in (PARAMETERS | (parameters or {})).items():
        if value is None:
            continue
        kind, dimensions, data = 2, [], b""
        if isinstance(value, float):
            kind, data = 4, struct.pack("<f", value)
        elif isinstance(value, int):
            data = struct.pack("<h", value)
        else:
            texts = [value] if isinstance(value, str) else value
            kind, dimensions = -1, [8] if isinstance(value, str) else [8, len(texts)]
            data = b"".join(text.ljust(8, pad).encode() for text in texts)
        body = struct.pack("bB", kind, len(dimensions)) + bytes(dimensions) + data + b"\0"
        records += (
            struct.pack("bb", len(name), groups[group])
            + name.encode()
            + struct.pack("<h", len(body) + 2)
            + body
        )
    section = (bytes([1, 80, 1, 84]) + records).ljust(512, b"\0")
    words = struct.pack("<5H", head["points"], head["analogs"], head["first"], head["last"], 0)
    words += struct.pack("<f2H", head["scale"], 3, head["samples"]) + struct.pack("<f", head["rate"])
    points = np.arange(18).reshape(3, 2, 3) * 1000 + 500
    points = np.concatenate([points, np.broadcast_to(fourth, (3, 2))[:, :, None]], axis=2).reshape(3, 8)
    data = np.hstack([points, np.full((3, 6), 7)]).astype("<i2").tobytes()
    return (bytes([2, 80]) + words).ljust(512, b"\0") + section + data.ljust(size or 512, b"\0")


def c3d_file(tmp_path, *args, **options):
    path = tmp_path / "trial.c3d"
    path.write_bytes(c3d_bytes(*args, **options))
    return path


def check_points(read):
    np.testing.assert_allclose(read.positions["A"][0], [0.05, 0.15, 0.25], rtol=1e-6)
    np.testing.assert_allclose(read.positions["B"][2], [1.55, 1.65, 1.75], rtol=1e-6)
    assert read.rate_hz == 100


def test_a_c3d_that_agrees_with_itself(tmp_path):
    read = detect.read_markers(c3d_file(tmp_path))
    check_points(read)
    assert read.findings == []


def test_c3d_strings_padded_by_null_bytes(tmp_path):
    read = detect.read_markers(c3d_file(tmp_path, pad="\0"))
    assert list(read.positions) == ["A", "B"]
    check_points(read)


@pytest.mark.parametrize("rate", [None, 0.0])
def test_c3d_with_a_rate_in_its_header_only(tmp_path, rate):
    read = detect.read_markers(c3d_file(tmp_path, parameters={("POINT", "RATE"): rate}))
    check_points(read)
    assert codes(read) == ["rate_header"]


@pytest.mark.parametrize(
    ("header", "parameters", "code", "found"),
    [
        ({"points": 0}, {("POINT", "USED"): 0, ("POINT", "LABELS"): None}, "no_data", "no points"),
        ({"points": 1}, {}, "c3d_contradiction", "2 points, 1 in the header"),
        ({}, {("POINT", "USED"): 1}, "c3d_contradiction", "1 points, 2 in the header"),
        ({}, {("POINT", "SCALE"): 0.2}, "c3d_contradiction", "scale 0.2, 0.1"),
        ({}, {("POINT", "RATE"): 120.0}, "rate", "120 Hz, 100 Hz in the header"),
        ({"rate": 0.0}, {("POINT", "RATE"): None}, "rate", "0 Hz"),
        ({"analogs": 4}, {}, "c3d_contradiction", "3 channels of 2 samples, 4 words"),
    ],
)
def test_c3d_that_contradicts_itself_is_refused(tmp_path, header, parameters, code, found):
    error = refusal(detect.read_markers, c3d_file(tmp_path, header, parameters))
    assert error.code == code
    assert found in error.found


def test_analog_parameters_are_reported_where_the_header_fits_the_file(tmp_path):
    path = c3d_file(tmp_path, parameters={("ANALOG", "USED"): 300})
    read = detect.read_markers(path)
    check_points(read)
    assert [(f.code, f.place) for f in read.findings] == [("count", "ANALOG:USED")]


def test_another_number_of_frames_is_reported(tmp_path):
    read = detect.read_markers(c3d_file(tmp_path, parameters={("POINT", "FRAMES"): 900}))
    assert [(f.code, f.place) for f in read.findings] == [("count", "POINT:FRAMES")]


def test_residual_words_that_take_whole_recordings(tmp_path):
    error = refusal(detect.read_markers, c3d_file(tmp_path, fourth=-1))
    assert (
        error.code,
        "missing in all frames of all 2 points, 2 of which have positions" in error.found,
    ) == (
        "no_data",
        True,
    )
    read = detect.read_markers(c3d_file(tmp_path, fourth=[[5, -1]] * 3))
    assert np.isfinite(read.positions["A"]).all()
    assert np.isnan(read.positions["B"]).all()
    assert [(f.code, f.severity) for f in read.findings] == [("residual_missing", "warning")]
