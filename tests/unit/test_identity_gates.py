"""Gates on whether a trial is what its name says: length, stillness, copies, exchanged files, scale."""

from __future__ import annotations

import json
import os
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from gate_person import CONFIG, SETTINGS, simulate_person
from handmade_person import PELVIS
from real2sim import signals
from real2sim.artefacts import read_json, read_table, write_json
from real2sim.errors import InputError
from real2sim.recording import alignment
from real2sim.recording.formats import qualisys
from real2sim.recording.formats.recordings import Length, MarkerRecording
from real2sim.recording.quality import clocks, identity, measure, pairing, sameness, scale
from real2sim.recording.quality.stage import quality_subject, quality_table, raw_trial
from real2sim.recording.subjects import read_subject
from scipy.signal import butter, filtfilt, lfilter

from benchmarks import faults
from benchmarks.mistaken_files import MISTAKES, Lab
from tests.fuzz import seeds

SAME = CONFIG["quality"]["same"]


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return simulate_person(tmp_path_factory.mktemp("phantom"), 15.0)


@pytest.fixture(scope="module")
def person(folder):
    return faults.load(folder / "raw", folder / "sealed", "S01")


def _change_markers(path: Path, change) -> None:
    old = qualisys.read_markers(path)
    positions = change(old.positions)
    frames = len(next(iter(positions.values())))
    qualisys.write_markers(
        path, MarkerRecording(np.arange(frames) / old.rate_hz, old.rate_hz, positions, old.first_frame)
    )


def _swap(a: Path, b: Path) -> None:
    aside = a.with_name("aside")
    a.rename(aside)
    b.rename(a)
    aside.rename(b)


def _later_and_rounded(positions):
    return {name: np.round(values[123:-80], 3) for name, values in positions.items()}


def _walking_off(positions):
    ramp = np.linspace(0, 0.06, len(positions["IF_L"]))[:, None] * [1.0, 0.0, 0.0]
    return {name: values + ramp for name, values in positions.items()}


@pytest.fixture(scope="module")
def mixed_up(folder, tmp_path_factory):
    """Gates of a person whose recordings were mixed up in six ways, each in its own trials; by trial and gate."""
    root = tmp_path_factory.mktemp("mixed_up")
    raw = root / "S01"
    shutil.copytree(folder / "raw" / "S01", raw)
    _swap(raw / "dynamic_1.mot", raw / "dynamic_2.mot")
    _swap(raw / "rotation_T09.mcap", raw / "rotation_T11.mcap")
    _change_markers(raw / "neutral.tsv", _walking_off)
    lines = (raw / "rotation_T10.tsv").read_bytes().split(b"\r\n")
    (raw / "rotation_T10.tsv").write_bytes(b"\r\n".join(lines[: len(lines) // 2]) + b"\r\n")
    shutil.copy(raw / "translation_T09.tsv", raw / "translation_T10.tsv")
    _change_markers(raw / "translation_T10.tsv", _later_and_rounded)
    shutil.copy(raw / "walk_normal_1.mot", raw / "walk_robot_1.mot")
    quality_subject(subject="S01", folder=raw, settings=SETTINGS, raw=[], out=root / "out")
    content = read_json(root / "out" / "gates.json")
    return {
        name: {gate["gate"]: gate for gate in about["gates"]} for name, about in content["trials"].items()
    }


@pytest.mark.parametrize(
    ("trial", "gate", "named"),
    [
        ("dynamic_1", "markerless_pair", "dynamic_2"),
        ("dynamic_2", "markerless_pair", "dynamic_1"),
        ("rotation_T09", "robot_pair", "rotation_T11"),
        ("rotation_T11", "robot_pair", "rotation_T09"),
        ("neutral", "still", "60 mm"),
        ("rotation_T10", "length", "declares"),
        ("translation_T09", "same", "translation_T10"),
        ("translation_T10", "same", "translation_T09"),
        ("walk_robot_1", "same", "walk_normal_1"),
    ],
)
def test_trial_that_is_not_what_its_name_says_is_refused(mixed_up, trial, gate, named):
    found = mixed_up[trial][gate]
    assert found["verdict"] == "refuse"
    assert named in found["message"]
    assert found["remedy"]


def test_untouched_trials_of_the_same_person_pass_these_gates(mixed_up):
    for name in ("translation_T11",):
        verdicts = {
            gate: mixed_up[name][gate]["verdict"] for gate in identity.GATES if gate in mixed_up[name]
        }
        assert set(verdicts.values()) == {"pass"}


@pytest.mark.parametrize(
    "make", dict.fromkeys(m for ways in MISTAKES.values() for m in ways), ids=lambda m: m.__name__
)
def test_mistake_is_made_on_files_of_its_own(folder, tmp_path, make):
    """The benchmark's sessions are hard links: what a mistake changes must not reach the clean session."""
    clean = folder / "raw" / "S01"
    before = {path.name: path.read_bytes() for path in clean.iterdir()}
    own = tmp_path / "S01"
    own.mkdir()
    for path in clean.iterdir():
        os.link(path, own / path.name)
    mistake = make(Lab(own, [clean], np.random.default_rng(5)))
    assert {path.name: path.read_bytes() for path in clean.iterdir()} == before
    changed = {path.stem for path in own.iterdir() if path.read_bytes() != before[path.name]}
    # the only other person is the same one here, whose trial is no change
    assert changed == set(mistake.changed) or mistake.donor is not None
    assert mistake.right


# -------------------- scale


@pytest.mark.parametrize("factor", [0.8, 0.9, 0.95, 1.05, 1.1])
@pytest.mark.parametrize("trial", ["dynamic_1", "translation_T10", "walk_robot_1"])
def test_scale_of_the_markers_is_refused_from_three_per_cent(person, trial, factor):
    gate = _scale_gate(person, trial, factor)
    assert gate.verdict == "refuse"
    assert gate.value == pytest.approx(100 * (factor - 1), abs=0.3)


@pytest.mark.parametrize(("factor", "verdict"), [(0.995, "pass"), (1.0, "pass"), (1.02, "warn")])
def test_small_scale_passes_or_warns(person, factor, verdict):
    gate = _scale_gate(person, "dynamic_1", factor)
    assert gate.verdict == verdict
    low, high = gate.interval
    assert low < 100 * (factor - 1) < high


def test_scale_is_seen_without_a_robot(person):
    gate = _scale_gate(person, "translation_T10", 0.9, log=None)
    assert gate.verdict == "refuse"
    assert "markerless" in gate.message


def test_scale_that_is_known_to_a_third_says_nothing(person, monkeypatch):
    """Rotation in place moves the pelvis too little: of 166 clean trials two were refused at -44 and -50 %."""
    vague = scale.ScaleFit(0.557, 0.308)
    monkeypatch.setattr("real2sim.recording.quality.scale.markerless_scale", lambda *arguments: vague)
    gate = _scale_gate(person, "translation_T10", 1.0, log=None)
    assert (gate.verdict, gate.value) == ("pass", None)
    assert "too little motion" in gate.message


def _scale_gate(person, name, factor, **changes):
    trial = person.raw[name]
    positions = {marker: factor * values for marker, values in trial.recording.positions.items()}
    trial = replace(trial, recording=replace(trial.recording, positions=positions), **changes)
    return faults._judged(person, trial)[1]["scale"]


# -------------------- clocks within a log


@pytest.mark.parametrize(("late_s", "verdict"), [(0.0, "pass"), (0.02, "warn"), (0.08, "refuse")])
@pytest.mark.parametrize("trial", ["dynamic_1", "translation_T10", "walk_robot_1"])
def test_joints_that_are_logged_later_than_the_base_are_found_by_the_motion(person, trial, late_s, verdict):
    raw = person.raw[trial]
    late = replace(raw, log=replace(raw.log, joint_time_s=raw.log.joint_time_s + late_s))
    measured, gates = faults._judged(person, late)
    assert measured.robot.clock.joint_delay_s == pytest.approx(late_s, abs=5e-4)
    assert gates["robot_sync"].verdict == verdict
    assert "/joint_states" in gates["robot_sync"].message


def test_file_of_another_motion_is_not_laid_on_the_markers(person):
    suspect = measure.Suspect(
        person.raw["rotation_T10"], person.reference, CONFIG["quality"], CONFIG["ingest"]
    )
    own, other = person.raw["rotation_T11"], person.raw["dynamic_1"]
    for file, found in (
        (own.log, True),
        (own.coordinates, True),
        (other.log, False),
        (other.coordinates, False),
    ):
        assert (measure.lay_file(suspect, file) is not None) == found


# -------------------- landmarks in the place of coordinates


def _with_landmarks(person, name, of="", factor=1.0):
    """The trial with a markerless export of landmarks: of ``of``, where that is given, and ``factor`` times as long."""
    trial, other = person.raw[name], person.raw[of or name]
    rotation, position = alignment.pelvis_of_coordinates(other.coordinates.columns)
    points = {
        marker: factor * (position + rotation @ np.array(place)) @ alignment.OPENSIM_TO_WORLD
        for marker, place in PELVIS.items()
    }
    landmarks = MarkerRecording(other.coordinates.time_s, 60.0, points, length=Length(500, 400))
    return replace(trial, coordinates=None, landmarks=landmarks)


def test_gates_judge_landmarks_as_they_judge_coordinates(person):
    plain = faults._judged(person, person.raw["dynamic_1"])[1]
    gates = faults._judged(person, _with_landmarks(person, "dynamic_1"))[1]
    assert set(gates) == set(plain)
    for name in ("markerless_sync", "markerless_residual", "markerless_pair", "scale"):
        assert gates[name].verdict == plain[name].verdict == "pass"
        assert gates[name].value == pytest.approx(plain[name].value, rel=0.05)
    assert "markerless: the header declares 500 rows" in gates["length"].message


def test_landmarks_of_another_trial_and_of_another_scale_are_refused(person):
    wrong = _with_landmarks(person, "dynamic_1", of="translation_T10")
    assert faults._judged(person, wrong)[1]["markerless_pair"].verdict == "refuse"
    gate = faults._judged(person, _with_landmarks(person, "translation_T10", factor=1.2))[1]["scale"]
    assert gate.verdict == "refuse"
    assert "off those of the markerless system" in gate.message


def test_the_stage_lays_landmarks_on_the_markers(person, folder, tmp_path):
    files = read_subject(folder / "raw" / "S01").trials["dynamic_1"]
    points = _with_landmarks(person, "dynamic_1").landmarks.positions
    named = {f"my {name}": values for name, values in points.items()}
    path = tmp_path / "dynamic_1.trc"
    path.write_text(seeds.trc_text(named, rate=60))
    names = {f"my {name}": name for name in points}
    trial = raw_trial("dynamic_1", replace(files, markerless=path), names, CONFIG["ingest"])
    assert trial.coordinates is None
    assert faults._judged(person, trial)[1]["markerless_pair"].value < 0.2


# -------------------- copies


def _recording(seed: int, moved: float = 0.05, seconds: float = 20.0) -> dict[str, np.ndarray]:
    """Four pelvis markers that all recordings move alike, with 0.3 mm of noise of their own."""
    t = np.arange(0, seconds, 0.01)
    waves = [(0.3, 0.7, 0), (0.45, 1.1, 1), (0.8, 0.2, 2)]
    path = moved * np.column_stack([np.sin(2 * np.pi * f * t + p) * (1 + 0.2 * k) for f, p, k in waves])
    rng = np.random.default_rng(seed)
    places = {
        "ASIS_L": (0, 0.13, 1),
        "ASIS_R": (0, -0.13, 1),
        "PSIS_L": (-0.16, 0.04, 1),
        "PSIS_R": (-0.16, -0.04, 1),
    }
    return {name: place + path + rng.normal(0, 3e-4, path.shape) for name, place in places.items()}


def _signature(positions):
    return sameness.signature(positions, 100.0, {})


@pytest.mark.parametrize(
    "copy",
    [
        lambda p: p,
        lambda p: {k: v[431:] for k, v in p.items()},
        lambda p: {k: v[:1300] for k, v in p.items()},
        lambda p: {k: np.round(v, 3) for k, v in p.items()},
        lambda p: {k: signals.lowpass(v, 100.0, 6.0, 4)[50:] for k, v in p.items()},
        lambda p: {k: v[:, [1, 0, 2]] * [1, -1, 1] + 0.4 for k, v in p.items()},
    ],
    ids=["exact", "starts later", "ends earlier", "rounded to mm", "filtered", "other axes"],
)
def test_copy_of_a_recording_is_found(copy):
    original = _recording(1)
    assert sameness.difference(_signature(original), _signature(copy(original)), SAME) < 1


def _moving_average(values):
    return np.apply_along_axis(
        lambda x: np.convolve(np.pad(x, 2, "edge"), np.ones(5) / 5, "valid"), 0, values
    )


@pytest.mark.parametrize(
    "smooth",
    [
        lambda v: filtfilt(*butter(2, 10 / 50), v, axis=0),
        lambda v: filtfilt(*butter(1, 15 / 50), v, axis=0),
        lambda v: lfilter(*butter(4, 6 / 50), v - v[0], axis=0) + v[0],
        _moving_average,
    ],
    ids=["10 Hz", "15 Hz, first order", "6 Hz, causal", "moving average"],
)
def test_copy_that_was_filtered_is_found_though_it_walks(smooth):
    """The filter takes more of a step than the cameras' noise is: 0.3 m at 0.8 Hz by a moving average, 0.8 mm."""
    original = _recording(1, moved=0.3)
    copied = {name: smooth(values) for name, values in original.items()}
    assert sameness.difference(_signature(original), _signature(copied), SAME) < 0.5


def test_two_recordings_of_one_motion_are_no_copies():
    ratios = [
        sameness.difference(_signature(_recording(2 * i)), _signature(_recording(2 * i + 1)), SAME)
        for i in range(20)
    ]
    assert min(ratios) > 1.1


def test_two_recordings_of_little_in_common_are_no_copies():
    """Whatever is fitted takes a part of the noise, and of two seconds a large one."""
    ratios = []
    for i in range(20):
        a, b = (_signature(_recording(seed, seconds=4.5)) for seed in (2 * i, 2 * i + 1))
        ratios.append(sameness.difference(a, b, SAME))
    assert min(ratios) > 1


def test_signature_survives_its_file():
    own = _signature(_recording(1))
    again = sameness.Signature.unpacked(json.loads(json.dumps(own.packed())))
    np.testing.assert_allclose(again.path, own.path, atol=1e-6)
    assert sameness.difference(own, again, SAME) < 0.1


def test_one_file_under_two_names_is_a_copy_whatever_it_holds():
    a = sameness.signature(_recording(1), 100.0, {"markers": "1", "robot log": "7"})
    b = sameness.signature(_recording(2, moved=0.2), 100.0, {"markers": "2", "robot log": "7"})
    (found,) = sameness.find_same({"a": a, "b": b}, SAME)
    assert found.file == "robot log"


def _person_of(folder: Path, subject: str, positions) -> Path:
    gate = {
        "gate": "same",
        "verdict": "pass",
        "value": None,
        "unit": "1",
        "threshold": None,
        "interval": None,
    }
    gate |= {"message": "", "remedy": "", "key": ""}
    trial = {
        "verdict": "pass",
        "override": None,
        "gates": [gate],
        "signature": _signature(positions).packed(),
    }
    path = folder / subject / "gates.json"
    path.parent.mkdir()
    write_json(path, {"subject": subject, "phantom": True, "trials": {"dynamic_1": trial}})
    return path


def test_recording_of_another_person_is_an_error_that_names_both(tmp_path):
    original = _recording(1)
    copied = {name: values[211:] for name, values in original.items()}
    people = {"S01": original, "S02": copied, "S03": _recording(3)}
    gates = [_person_of(tmp_path, name, positions) for name, positions in people.items()]
    out = tmp_path / "quality.csv"
    with pytest.raises(InputError, match=r"S01/dynamic_1 and S02/dynamic_1") as error:
        quality_table(gates=gates, settings=CONFIG["quality"], out=out)
    assert "S03" not in str(error.value)
    quality_table(gates=[gates[0], gates[2]], settings=CONFIG["quality"], out=out)
    accepted = CONFIG["quality"] | {"override": {"S02/dynamic_1": "one person twice, on purpose"}}
    quality_table(gates=gates, settings=accepted, out=out)
    refused = [row for row in read_table(out) if row["verdict"] == "refuse"]
    assert [row["subject"] for row in refused] == ["S02"]
    assert "S01/dynamic_1" in refused[0]["message"]


# -------------------- length and pairs


def test_length_comes_from_every_header(tmp_path):
    recording = MarkerRecording(np.arange(300) / 100, 100.0, {"ASIS_L": np.ones((300, 3))})
    path = tmp_path / "neutral.tsv"
    qualisys.write_markers(path, recording)
    assert qualisys.read_markers(path).length == Length(300, 300)
    lines = path.read_bytes().split(b"\r\n")
    path.write_bytes(b"\r\n".join(lines[:-151]) + b"\r\n")
    cut = qualisys.read_markers(path)
    assert cut.length == Length(300, 150)
    assert [finding.code for finding in cut.findings] == ["count"]
    assert Length.of("", 3) is None
    assert Length.of("12.5", 3) is None


def test_better_file_needs_certainty():
    rng = np.random.default_rng(1)
    seconds = np.arange(12.0)

    def shared(rms: float) -> pairing.Shared:
        return pairing.Shared(0.1, rms, np.column_stack([seconds, rms**2 * rng.chisquare(30, 12) / 30]))

    own = shared(0.005)
    better = pairing.find_better(
        own, ["a", "b", "c"], lambda name: shared({"a": 0.0049, "b": 0.002, "c": 0.001}[name]), 5
    )
    assert better["a"].certainty < 5
    assert pairing.choose_exchanges({"own": better}, 5)["own"].trial == "c"
    assert pairing.choose_exchanges({"own": {"a": better["a"]}}, 5) == {}


def test_evidence_of_both_trials_counts_for_an_exchange():
    """Two rotations whose logs were exchanged: 4.8 standard errors each, as the holds between the swings agree."""

    def found(trial: str, certainty: float) -> dict[str, pairing.Exchanged]:
        return {trial: pairing.Exchanged(trial, 0.00099, 0.00036, certainty)}

    both = pairing.choose_exchanges({"a": found("b", 4.79), "b": found("a", 4.80)}, 5)
    assert {name: other.trial for name, other in both.items()} == {"a": "b", "b": "a"}
    assert both["a"].certainty == pytest.approx(6.78, abs=0.01)
    assert pairing.choose_exchanges({"a": found("b", 4.79), "b": {}}, 5) == {}
    assert pairing.choose_exchanges({"a": found("b", 4.79), "b": found("a", 0.5)}, 5) == {}


def test_mean_squares_are_by_second():
    t = np.array([0.1, 0.9, 1.5, 7.0])
    found = clocks.mean_squares(t, np.array([[1.0, 1.0], [3.0, 3.0], [2.0, 0.0], [0.0, 0.0]]))
    np.testing.assert_allclose(found, [[0, 5], [1, 2], [7, 0]])
