"""Bad input ends with a message that names the file and the remedy, never with a traceback or in silence.

One case per kind of fault, each made in a person who is fine otherwise. Nobody at all is tested with the workflow.
"""

import shutil

import numpy as np
import pytest
from handmade_person import SETTINGS, change_markers, write_person
from real2sim.configuration import read_yaml, validated
from real2sim.errors import InputError
from real2sim.recording.ingest import ingest_subject
from real2sim.recording.subjects import discover

TRIALS = ("neutral", "rotation_T08", "translation_T08", "dynamic_1")


@pytest.fixture(scope="module")
def sound(tmp_path_factory):
    """A study of one person that nothing is wrong with."""
    root = tmp_path_factory.mktemp("sound")
    write_person(root / "subjects" / "S01", TRIALS)
    (root / "config.yaml").write_text("ingest: {rate_hz: 100}\n")
    return root


def run(root):
    """What the workflow does with raw files: configuration, people, one ingest job each."""
    validated(read_yaml(root / "config.yaml"), "config", root / "config.yaml")
    for name, person in discover(root / "subjects").items():
        ingest_subject(
            subject=name, folder=person.folder, settings=SETTINGS, raw=[], out=root / "trials" / name
        )


def misnamed_trial(root, person):
    (person / "dynamic_1.tsv").rename(person / "dinamic_1.tsv")


def missing_partner(root, person):
    (person / "dynamic_1.mot").unlink()


def unknown_key(root, person):
    (root / "config.yaml").write_text("ingest: {max_gap: 0.1}\n")


def missing_marker(root, person):
    change_markers(person / "dynamic_1.tsv", lambda p: {k: v for k, v in p.items() if k != "IF_L"})


def long_gap(root, person):
    def hole(positions):
        positions["IF_L"][300:780] = np.nan
        return positions

    change_markers(person / "dynamic_1.tsv", hole)


def scaled(factor):
    def make(root, person):
        change_markers(person / "neutral.tsv", lambda p: {k: v * factor for k, v in p.items()})

    return make


def time_goes_back(root, person):
    path = person / "dynamic_1.tsv"
    lines = path.read_text().split("\n")
    lines[100], lines[101] = lines[101], lines[100]
    path.write_text("\n".join(lines))


def duplicate_subject(root, person):
    shutil.copytree(person, person.with_name("S02"))


def emptied(suffix):
    def make(root, person):
        (person / f"dynamic_1{suffix}").write_bytes(b"")

    return make


def truncated_log(root, person):
    path = person / "dynamic_1.mcap"
    path.write_bytes(path.read_bytes()[:-200])


def level_out_of_range(root, person):
    for suffix in (".tsv", ".mot"):
        shutil.copy(person / f"rotation_T08{suffix}", person / f"rotation_T12{suffix}")


@pytest.mark.parametrize(
    ("fault", "file", "found", "expected"),
    [
        pytest.param(
            misnamed_trial, "S01/dinamic_1.tsv", "trial name 'dinamic_1'", "dynamic_<N>", id="misnamed trial"
        ),
        pytest.param(
            missing_partner,
            "S01/dynamic_1",
            "only dynamic_1.mcap, dynamic_1.tsv",
            "a markerless export dynamic_1.mot",
            id="missing partner file",
        ),
        pytest.param(
            unknown_key, "config.yaml", "unknown key 'max_gap'", "max_gap_s", id="unknown configuration key"
        ),
        pytest.param(
            missing_marker,
            "dynamic_1.tsv, marker IF_L",
            "markers ASIS_L, ASIS_R, PSIS_L, PSIS_R, IF_R",
            "IF_L",
            id="missing marker",
        ),
        pytest.param(
            long_gap,
            "dynamic_1.tsv, marker IF_L",
            "missing in 40 % of 1200 frames, longest gap 480 frames",
            "at most 20 % missing",
            id="40 % gap",
        ),
        pytest.param(
            scaled(1e-3), "neutral.tsv", ": metres in a file of millimetres", "0.2 to 20 m", id="metres"
        ),
        pytest.param(
            scaled(0.1),
            "neutral.tsv",
            "centimetres in a file of millimetres",
            "0.2 to 20 m",
            id="centimetres",
        ),
        pytest.param(
            scaled(1e3), "neutral.tsv", "a unit smaller than millimetres", "0.2 to 20 m", id="micrometres"
        ),
        pytest.param(
            time_goes_back,
            "dynamic_1.tsv, line 102, column 1",
            "frame 89 after 90",
            "increasing",
            id="non-monotonic time",
        ),
        pytest.param(
            duplicate_subject,
            "S02/subject.yaml, key id",
            "id S01, which S01/subject.yaml has already",
            "id S02",
            id="duplicate subject",
        ),
        pytest.param(
            emptied(".tsv"), "dynamic_1.tsv", "an empty file", "TSV export", id="empty marker export"
        ),
        pytest.param(emptied(".mot"), "dynamic_1.mot", "an empty file", "an OpenSim .mot", id="empty .mot"),
        pytest.param(
            emptied(".mcap"), "dynamic_1.mcap", "an empty file", "an MCAP log", id="empty robot log"
        ),
        pytest.param(
            truncated_log, "dynamic_1.mcap", "breaks off", "a complete MCAP log", id="truncated MCAP"
        ),
        pytest.param(
            level_out_of_range,
            "S01/rotation_T12",
            "tightness 12 cm",
            "3 to 11 cm",
            id="tightness out of range",
        ),
    ],
)
def test_bad_input_is_refused_by_name(sound, tmp_path, fault, file, found, expected):
    root = tmp_path / "study"
    shutil.copytree(sound, root)
    fault(root, root / "subjects" / "S01")
    with pytest.raises(InputError) as caught:
        run(root)
    error = caught.value
    first_line = str(error).splitlines()[0]
    assert file in first_line
    assert found in error.found
    assert expected in error.expected
    assert error.remedy
    assert error.remedy in str(error)


def test_the_person_is_fine_without_a_fault(sound, tmp_path):
    root = tmp_path / "study"
    shutil.copytree(sound, root)
    run(root)
    assert len(list((root / "trials").rglob("quality.json"))) == len(TRIALS)
