"""A person whose files are of other formats than the phantom's goes through ingest to the same tables."""

import json
import shutil

import numpy as np
import pyarrow.parquet
import pytest
from handmade_person import SETTINGS, write_person
from real2sim.errors import InputError
from real2sim.recording import alignment
from real2sim.recording.formats.opensim import read_coordinates
from real2sim.recording.formats.qualisys import read_markers
from real2sim.recording.formats.robot_log import read_log
from real2sim.recording.ingest import ingest_subject

from tests.fuzz import seeds

TRIAL = "dynamic_1"


@pytest.fixture(scope="module")
def raw(tmp_path_factory):
    return write_person(tmp_path_factory.mktemp("raw") / "S01")


@pytest.fixture(scope="module")
def plain(raw, tmp_path_factory):
    return tables(raw, tmp_path_factory.mktemp("plain"))


def tables(folder, out):
    ingest_subject(subject="S01", folder=folder, settings=SETTINGS, raw=[], out=out)
    read = {}
    for path in (out / TRIAL).glob("*.parquet"):
        table = pyarrow.parquet.read_table(path)
        read[path.stem] = {name: table[name].to_numpy() for name in table.column_names}
    return read, json.loads((out / TRIAL / "quality.json").read_text())


@pytest.fixture
def folder(raw, tmp_path):
    return shutil.copytree(raw, tmp_path / "S01")


@pytest.mark.parametrize("suffix", [".c3d", ".mat"])
def test_markers(folder, plain, tmp_path, suffix):
    path = folder / f"{TRIAL}.tsv"
    write = {".c3d": seeds.write_c3d, ".mat": seeds.write_mat}[suffix]
    options = {"missing": ()} if suffix == ".c3d" else {}
    write(path.with_suffix(suffix), read_markers(path).positions, rate=100.0, **options)
    path.unlink()
    read, quality = tables(folder, tmp_path / "out")
    for name, values in plain[0]["markers"].items():
        np.testing.assert_allclose(read["markers"][name], values, atol=1e-6)
    assert f"{TRIAL}{suffix}" in quality["sha256"]


def test_coordinates_in_radians(folder, plain, tmp_path):
    path = folder / f"{TRIAL}.mot"
    recording = read_coordinates(path)
    path.unlink()
    rows = np.column_stack([recording.time_s, *recording.columns.values()])
    text = "\n".join("\t".join(repr(float(v)) for v in row) for row in rows)
    names = "\t".join(["time", *(f"/jointset/j/{name}/value" for name in recording.columns)])
    head = f"inDegrees=no\nDataType=double\nversion=3\nendheader\n{names}\n"
    path.with_suffix(".sto").write_text(head + text + "\n")
    read, quality = tables(folder, tmp_path / "out")
    assert quality["markerless"]["kind"] == "coordinates"
    for name, values in plain[0]["joints"].items():
        np.testing.assert_allclose(read["joints"][name], values, atol=1e-9)


PLACES = {
    "ASIS_L": (0, 0.12, 0),
    "ASIS_R": (0, -0.12, 0),
    "PSIS_L": (-0.15, 0.05, 0),
    "PSIS_R": (-0.15, -0.05, 0),
    "my knee": (0.0, 0.1, -0.4),
}


def landmarks_of(path):
    """Landmarks (n, 3) [m] in OpenSim's axes, fixed to the pelvis of an export of coordinates."""
    recording = read_coordinates(path)
    rotation, position = alignment.pelvis_of_coordinates(recording.columns)
    return {
        name: (position + rotation @ np.array(place, float)) @ alignment.OPENSIM_TO_WORLD
        for name, place in PLACES.items()
    }


@pytest.mark.parametrize(
    ("unit", "found"), [("m", "millimetres in a file of metres"), ("mm", "metres in a file of m")]
)
def test_landmarks_in_another_unit_than_the_header_says(folder, tmp_path, unit, found):
    path = folder / f"{TRIAL}.mot"
    ground = landmarks_of(path)
    path.unlink()
    # seeds writes millimetres
    written = ground if unit == "m" else {name: values / 1000 for name, values in ground.items()}
    text = seeds.trc_text(written, unit, rate=60)
    path.with_suffix(".trc").write_text(text)
    with pytest.raises(InputError, match=found) as caught:
        tables(folder, tmp_path / "out")
    assert (caught.value.code, caught.value.path.name) == ("units_contradicted", f"{TRIAL}.trc")


def test_landmarks(folder, plain, tmp_path):
    """Landmarks of the pelvis are enough to synchronise by; what is there is kept, as positions."""
    path = folder / f"{TRIAL}.mot"
    ground = landmarks_of(path)
    path.unlink()
    text = seeds.trc_text(ground, rate=60)
    path.with_suffix(".trc").write_text(text)
    read, quality = tables(folder, tmp_path / "out")
    report = quality["markerless"]
    assert report["kind"] == "landmarks"
    assert report["offset_s"] == pytest.approx(plain[1]["markerless"]["offset_s"], abs=1e-3)
    assert report["rms_m"] < 1e-3
    assert set(read["joints"]) == {"time_s", *(f"{name}_{axis}" for name in PLACES for axis in "xyz")}
    middle = (read["joints"]["ASIS_L_y"] + read["joints"]["ASIS_R_y"]) / 2
    np.testing.assert_allclose(middle, plain[0]["joints"]["pelvis_ty"], atol=1e-3)


def test_json_log(folder, plain, tmp_path):
    path = folder / f"{TRIAL}.mcap"
    log = read_log(path)
    seeds.write_json_log(path, log)
    read, quality = tables(folder, tmp_path / "out")
    assert quality["robot"]["status"] == "synchronised by motion"
    np.testing.assert_allclose(read["robot"]["arm_pitch"], plain[0]["robot"]["arm_pitch"], atol=1e-3)
