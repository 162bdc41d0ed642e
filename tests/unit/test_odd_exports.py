"""Sound exports that are written in unusual ways are read, and what contradicts itself is reported or refused."""

import numpy as np
import pytest
from real2sim.errors import InputError
from real2sim.recording.formats import detect, opensim, qualisys, trc

from tests.fuzz import seeds


def codes(recording):
    return [finding.code for finding in recording.findings]


def refusal(reader, path):
    with pytest.raises(InputError) as error:
        reader(path)
    assert path.name in str(error.value)
    assert error.value.remedy
    return error.value


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
