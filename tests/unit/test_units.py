"""Degrees taken for radians, radians for degrees, and translations taken for rotations are refused by name."""

import copy
import json
import re
import shutil
from pathlib import Path

import numpy as np
import pyarrow.parquet
import pytest
from handmade_person import SETTINGS, write_person
from real2sim.errors import InputError
from real2sim.recording import units
from real2sim.recording.formats.opensim import is_rotation, is_translation, read_coordinates
from real2sim.recording.ingest import ingest_subject

FOLDER = Path(__file__).parents[3] / "shared" / "third_party"
TRIAL = "dynamic_1"


@pytest.fixture(scope="module")
def raw(tmp_path_factory):
    return write_person(tmp_path_factory.mktemp("raw") / "S01", trials=("neutral", TRIAL, "walk_normal_1"))


@pytest.fixture
def folder(raw, tmp_path):
    return shutil.copytree(raw, tmp_path / "S01")


def ingest(folder, out, settings=SETTINGS):
    ingest_subject(subject="S01", folder=folder, settings=settings, raw=[], out=out)
    table = pyarrow.parquet.read_table(out / TRIAL / "joints.parquet")
    return table, json.loads((out / TRIAL / "quality.json").read_text())


def refusal(folder, tmp_path):
    with pytest.raises(InputError) as error:
        ingest(folder, tmp_path / "out")
    assert error.value.remedy
    return error.value


def rewrite(path, *, in_degrees="yes", factor=1.0, extra=None):
    """Write coordinates again, rotations times a factor, with columns ``extra`` (n,) and another inDegrees."""
    head, _, body = path.read_text().partition("endheader\n")
    names, *rows = body.splitlines()
    names = names.split("\t")
    table = np.array([row.split() for row in rows], float)
    rotations = [i for i, name in enumerate(names) if name != "time" and not is_translation(name)]
    table[:, rotations] *= factor
    for name, values in (extra or {}).items():
        names, table = [*names, name], np.column_stack([table, np.broadcast_to(values, len(table))])
    head = re.sub("inDegrees=yes", f"inDegrees={in_degrees}", head)
    head = re.sub(r"nColumns=\d+", f"nColumns={len(names)}", head).replace("Angles are in degrees.\n", "")
    rows = ["\t".join(f"{v:.10f}" for v in row) for row in table]
    path.write_text(f"{head}endheader\n" + "\n".join(["\t".join(names), *rows]) + "\n")


@pytest.mark.parametrize("trial", [TRIAL, "walk_normal_1"])
def test_radians_that_are_called_degrees(folder, tmp_path, trial):
    rewrite(folder / f"{trial}.mot", factor=np.pi / 180)
    error = refusal(folder, tmp_path)
    assert (error.code, error.path.name) == ("units_contradicted", f"{trial}.mot")
    assert "radians that are taken for degrees" in error.found
    assert "inDegrees=no" in error.remedy


def test_degrees_that_are_called_radians(folder, tmp_path):
    rewrite(folder / f"{TRIAL}.mot", in_degrees="no")
    error = refusal(folder, tmp_path)
    assert error.code == "units_contradicted"
    assert "degrees that are taken for radians" in error.found
    assert "inDegrees=yes" in error.remedy


def test_small_degrees_that_are_called_radians(folder, tmp_path):
    """No joint beyond half a turn: the markers' pelvis tells."""
    settings = copy.deepcopy(SETTINGS)
    settings["units"]["largest_angle_deg"] = 1e6
    rewrite(folder / f"{TRIAL}.mot", in_degrees="no")
    with pytest.raises(InputError) as error:
        ingest(folder, tmp_path / "out", settings)
    assert (error.value.code, error.value.place) == ("units_contradicted", "pelvis")


def test_true_radians_pass(folder, tmp_path):
    rewrite(folder / f"{TRIAL}.mot", in_degrees="no", factor=np.pi / 180)
    _, quality = ingest(folder, tmp_path / "out")
    assert quality["markerless"]["rms_deg"] < 0.1


def test_another_trial_is_not_called_another_unit(folder, tmp_path):
    """A pelvis that neither turns nor travels is of a trial that stands still."""
    shutil.copy(folder / "neutral.mot", folder / f"{TRIAL}.mot")
    _, quality = ingest(folder, tmp_path / "out")
    assert not quality["markerless"]["synchronised"]


@pytest.mark.parametrize(
    ("name", "rotation", "translation"),
    [
        ("pelvis_tx", False, True),
        ("knee_tx_r", False, True),
        ("pelvis_tilt", True, False),
        ("knee_angle_r_beta", True, False),
        ("L5_S1_FE", True, False),
        ("wrist_dev_l", True, False),
        ("patella_slide_r", False, False),
        ("pelvis_x", False, False),
        ("q1", False, False),
    ],
)
def test_names_that_tell_what_a_coordinate_is(name, rotation, translation):
    assert (is_rotation(name), is_translation(name)) == (rotation, translation)


def test_coordinates_of_unknown_kind_are_asked_for(folder, tmp_path):
    rewrite(folder / f"{TRIAL}.mot", extra={"patella_slide_r": 0.04})
    error = refusal(folder, tmp_path)
    assert (error.code, error.place) == ("coordinate_kind", "column patella_slide_r")
    assert "ingest.markerless.translations" in error.remedy


@pytest.mark.parametrize(
    ("kind", "value", "unit"), [("translations", 0.04, b"m"), ("rotations", 0.04 * np.pi / 180, b"rad")]
)
def test_coordinates_of_a_kind_that_the_configuration_tells(folder, tmp_path, kind, value, unit):
    rewrite(folder / f"{TRIAL}.mot", extra={"patella_slide_r": 0.04})
    settings = copy.deepcopy(SETTINGS)
    settings["markerless"][kind] = ["patella_slide_r"]
    table, quality = ingest(folder, tmp_path / "out", settings)
    values = table["patella_slide_r"].to_numpy()
    np.testing.assert_allclose(values[np.isfinite(values)], value, atol=1e-9)
    assert table.schema.field("patella_slide_r").metadata[b"unit"] == unit
    assert "coordinate_kind" not in {f["code"] for f in quality["findings"]}


def test_unknown_kinds_in_radians_need_no_answer(folder, tmp_path):
    rewrite(folder / f"{TRIAL}.mot", in_degrees="no", factor=np.pi / 180, extra={"patella_slide_r": 0.04})
    table, quality = ingest(folder, tmp_path / "out")
    assert np.nanmax(table["patella_slide_r"].to_numpy()) == pytest.approx(0.04)
    assert ("coordinate_kind", "info") in {(f["code"], f["severity"]) for f in quality["findings"]}


def real_exports():
    """Exports of a whole body by others: all have a pelvis and state their unit."""
    paths = [p for kind in ("opensim_mot_sto", "walking_ref") for p in sorted((FOLDER / kind).glob("*.mot"))]
    texts = {path: path.read_text() for path in paths}
    return [
        p
        for p, text in texts.items()
        if re.search("inDegrees=yes", text, re.IGNORECASE) and "pelvis_tilt" in text
    ]


@pytest.mark.skipif(not FOLDER.is_dir(), reason=f"no third-party files at {FOLDER}")
def test_real_exports_pass_and_are_refused_in_the_other_unit(tmp_path):
    paths = real_exports()
    assert len(paths) > 8
    for path in paths:
        read = read_coordinates(path)
        units.check_kinds(path, read)
        units.check_angles(path, read, SETTINGS["units"])
        other = tmp_path / path.name
        other.write_text(re.sub("inDegrees=yes", "inDegrees=no", path.read_text(), flags=re.IGNORECASE))
        with pytest.raises(InputError) as error:
            units.check_angles(other, read_coordinates(other), SETTINGS["units"])
        assert error.value.code == "units_contradicted"
