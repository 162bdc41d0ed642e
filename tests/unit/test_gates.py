"""Gates: verdicts, the check before a fit, and injected faults on a small phantom (benchmarks/faults.py has 200)."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from gate_person import CONFIG, SETTINGS, simulate_person
from real2sim.artefacts import read_json, read_table
from real2sim.errors import InputError
from real2sim.pages.quality import quality_figure
from real2sim.recording.formats.qualisys import read_markers, write_markers
from real2sim.recording.formats.robot_log import read_log, write_log
from real2sim.recording.quality import clocks, markers
from real2sim.recording.quality.gates import (
    _frame_robot,
    _gaps,
    _of_clocks,
    bandwidth_hz,
    noise_cost,
    reversals,
)
from real2sim.recording.quality.measure import _robot_clock
from real2sim.recording.quality.stage import quality_subject, quality_table
from real2sim.recording.quality.verdict import PASS, REFUSE, WARN, Gate, by_size, require
from scipy.spatial.transform import Rotation

from benchmarks import faults

FROZEN = CONFIG["ingest"]["frozen"] | {"jump_m": CONFIG["ingest"]["max_marker_jump_m"]}


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return simulate_person(tmp_path_factory.mktemp("phantom"), 20.0)


@pytest.fixture(scope="module")
def person(folder):
    return faults.load(folder / "raw", folder / "sealed", "S01")


def test_clean_trials_raise_no_alarm(person):
    alarms, count = faults.false_alarms([person])
    assert count == 11
    assert not alarms


@pytest.mark.parametrize(
    "kind", [k for k in faults.KINDS if k is not faults.drift_markerless], ids=lambda kind: kind.__name__
)
def test_fault_is_seen(person, kind):
    case = kind(person, np.random.default_rng(5))
    assert case.detected, case.detail
    if kind is faults.sync_robot:
        assert abs(case.offset[0]) < 1e-3
    if kind is faults.drift_robot:
        assert abs(case.drift[0]) < 1.5e-5  # three short trials only
    if kind is faults.swap:
        assert case.exact


def test_markerless_drift_lies_in_its_interval(person):
    error, sd = faults.drift_markerless(person, np.random.default_rng(5)).drift
    assert abs(error) < 4 * sd


def test_robot_clock_that_starts_a_stride_off_finds_back(person):
    trial = person.raw["walk_robot_1"]
    truth = person.clocks["walk_robot_1"]["robot_start_s"]
    for off in (-1.2, 1.2):
        fit = _robot_clock(trial.recording.time_s, trial.recording.positions, trial.log, [truth + off])
        assert abs(fit.offset_s - fit.drift * fit.middle_s - truth) < 1e-3


@pytest.fixture(scope="module")
def few(folder, tmp_path_factory):
    """The person with no more trials than the stage needs to tell them apart."""
    out = tmp_path_factory.mktemp("few")
    (out / "raw" / "S01").mkdir(parents=True)
    for path in (folder / "raw" / "S01").iterdir():
        if path.stem in ("subject", "neutral", "dynamic_1", "dynamic_2", "rotation_T10", "translation_T10"):
            shutil.copy(path, out / "raw" / "S01")
    return out


def _run(folder, out, **quality):
    quality_subject(
        subject="S01",
        folder=folder / "raw" / "S01",
        settings=SETTINGS | {"quality": CONFIG["quality"] | quality},
        raw=[],
        out=out,
    )


def test_refused_trial_is_held_back_unless_overridden_by_name(few, tmp_path):
    strict = {
        "noise": {"warn": 0.0, "refuse": 0.0},
        "excitation": CONFIG["quality"]["excitation"] | {"refuse": 99.0},
    }
    strict["excitation"]["warn"] = 100.0
    _run(few, tmp_path / "a", **strict)
    with pytest.raises(InputError, match="excitation") as error:
        require([tmp_path / "a" / "dynamic_1.json"], "dynamic_1")
    assert "S01/dynamic_1" in error.value.remedy
    assert require([tmp_path / "a" / "rotation_T10.json"], "rotation_T10") == {}
    _run(few, tmp_path / "b", **strict, override={"S01/dynamic_1": "pilot"})
    assert require([tmp_path / "b" / "dynamic_1.json"], "dynamic_1") == {"S01/dynamic_1": ["excitation"]}
    assert (tmp_path / "a" / "dynamic_2.json").read_bytes() == (
        tmp_path / "b" / "dynamic_2.json"
    ).read_bytes()
    with pytest.raises(InputError, match="dynamic_9"):
        _run(few, tmp_path / "c", override={"S01/dynamic_9": "typo"})
    gates = tmp_path / "b" / "gates.json"
    quality_table(gates=[gates], settings=CONFIG["quality"], out=tmp_path / "quality.csv")
    rows = read_table(tmp_path / "quality.csv")
    assert {r["trial"] for r in rows if r["overridden"] == "true"} == {"dynamic_1"}
    settings = CONFIG["quality"] | {"override": {"S77/dynamic_1": "typo"}}
    with pytest.raises(InputError, match="S77"):
        quality_table(gates=[gates], settings=settings, out=tmp_path / "quality.csv")
    quality_figure(gates=gates, out=[tmp_path / "gates.png"])
    assert (tmp_path / "gates.png").stat().st_size > 10_000


def test_warnings_of_the_files_are_in_the_table_and_the_log(few, tmp_path, capsys):
    settings = SETTINGS | {"ingest": SETTINGS["ingest"] | {"facing_deg": 1e-3}}
    quality_subject(subject="S01", folder=few / "raw" / "S01", settings=settings, raw=[], out=tmp_path)
    assert "facing: neutral.tsv: the person faces" in capsys.readouterr().out
    quality_table(gates=[tmp_path / "gates.json"], settings=CONFIG["quality"], out=tmp_path / "quality.csv")
    rows = [row for row in read_table(tmp_path / "quality.csv") if row["source"] == "finding"]
    [row] = [row for row in rows if row["gate"] == "facing"]
    assert (row["trial"], row["verdict"]) == ("neutral", "warn")
    assert "the person faces" in row["message"]
    assert row["remedy"] == "used as stated"
    # a line for each code of a trial, however many markers have it
    assert len({(row["trial"], row["gate"]) for row in rows}) == len(rows)
    # a warning of a file is no gate
    assert read_json(tmp_path / "neutral.json")["verdict"] == "pass"
    quality_figure(gates=tmp_path / "gates.json", out=[tmp_path / "gates.png"])


def _copied(few, tmp_path):
    """Folder of a copy of the raw files of the person with few trials."""
    return shutil.copytree(few / "raw" / "S01", tmp_path / "x" / "raw" / "S01")


def _refused(tmp_path, trial):
    """Gates that refuse a trial of the copy, whose dynamic_1 passes."""
    _run(tmp_path / "x", tmp_path / "out")
    assert read_json(tmp_path / "out" / "dynamic_1.json")["verdict"] == "pass"
    return read_json(tmp_path / "out" / f"{trial}.json")["refused"]


def test_unreadable_trial_is_refused_and_the_others_are_judged(few, tmp_path):
    (_copied(few, tmp_path) / "dynamic_2.tsv").write_text("nothing\n")
    assert _refused(tmp_path, "dynamic_2")[0]["gate"] == "readable"


def test_a_trial_whose_start_is_masked_is_refused_before_the_step_study_meets_it(few, tmp_path):
    path = _copied(few, tmp_path) / "dynamic_2.tsv"
    recording = read_markers(path)
    recording.positions["IF_L"][:60] = np.nan
    write_markers(path, recording)
    [gate] = _refused(tmp_path, "dynamic_2")
    assert gate["gate"] == "start"
    assert "interface masked by a gap: known in 0 %" in gate["message"]
    assert "Crop the export" in gate["remedy"]


def test_a_log_of_part_of_a_sweep_is_refused_before_it_makes_limits(few, tmp_path):
    path = _copied(few, tmp_path) / "rotation_T10.mcap"
    log = read_log(path)
    for times, kept in ((log.base_time_s, log.base), (log.joint_time_s, log.joints)):
        part = times <= times[0] + 4.0
        kept.update({name: values[part] for name, values in kept.items()})
    arm, base = (t[t <= t[0] + 4.0] for t in (log.joint_time_s, log.base_time_s))
    write_log(path, replace(log, base_time_s=base, joint_time_s=arm))
    refused = _refused(tmp_path, "rotation_T10")
    assert [gate["gate"] for gate in refused] == ["completeness"]
    assert "all six coordinates of the interface are known in" in refused[0]["message"]


def test_a_log_of_one_message_is_refused_and_the_others_are_judged(few, tmp_path):
    path = _copied(few, tmp_path) / "dynamic_2.mcap"
    log = read_log(path)
    joints = {name: values[:1] for name, values in log.joints.items()}
    write_log(path, replace(log, joint_time_s=log.joint_time_s[:1], joints=joints))
    assert "1 of /joint_states" in _refused(tmp_path, "dynamic_2")[0]["message"]


def test_a_strap_that_nobody_wears_has_no_gaps():
    gap = markers.Gap("IF_L", 0, 1000)
    for kind, verdict in (("walk_normal", PASS), ("dynamic", REFUSE)):
        trial = SimpleNamespace(kind=kind, gaps=[gap], rate=SimpleNamespace(declared=100.0))
        assert _gaps(trial, CONFIG["quality"]).verdict == verdict
    seen = {"ASIS_L": np.full((5, 3), np.nan), "IF_L": np.full((5, 3), np.nan), "IF_R": np.zeros((5, 3))}
    assert set(markers.without_unseen(seen, markers.needed("walk_normal"))) == {"ASIS_L", "IF_R"}
    assert set(markers.without_unseen(seen, markers.needed("dynamic"))) == set(seen)


@pytest.mark.parametrize(
    ("seen_deg", "verdict"),
    [
        ({}, REFUSE),  # no other system tells
        ({"walk": 0.0}, WARN),
        ({"walk": 4.0}, REFUSE),  # the lab did turn
    ],
)
def test_an_odometry_that_starts_anew_turns_no_lab(seen_deg, verdict):
    trial = SimpleNamespace(name="walk", robot=SimpleNamespace(clock=None))
    session = SimpleNamespace(
        heading_rad={"walk": np.radians(4.0)},
        heading_sd_rad=0.0,
        turned={name: np.radians([0.0, 0.0, turn]) for name, turn in seen_deg.items()},
    )
    assert _frame_robot(trial, session, CONFIG["quality"]).verdict == verdict


def test_file_of_another_trial_is_refused(tmp_path):
    path = tmp_path / "dynamic_1.json"
    path.write_text(json.dumps({"subject": "S01", "trial": "dynamic_2", "refused": [], "override": None}))
    with pytest.raises(InputError, match="dynamic_2"):
        require([path], "dynamic_1")


def test_clocks_do_not_refuse_somebody_who_stands():
    gate = Gate("robot_drift", REFUSE, 2968.0, "ppm", [50.0, 500.0], "drifts", "Synchronise.")
    for kind, verdict in (("neutral", WARN), ("dynamic", REFUSE)):
        assert [g.verdict for g in _of_clocks(SimpleNamespace(kind=kind), [gate])] == [verdict]


def test_verdict_by_size():
    assert [by_size(x, [1.0, 2.0]) for x in (0.5, 1.0, 2.0)] == ["pass", "warn", "refuse"]
    assert [by_size(x, [0.9, 0.5]) for x in (0.95, 0.8, 0.4)] == ["pass", "warn", "refuse"]


def test_pooling_weighs_by_variance_and_widens_for_scatter():
    pooled = clocks.pool([1.0, 3.0], [1.0, 1.0])
    assert pooled.value == pytest.approx(2.0)
    assert pooled.sd == pytest.approx(np.sqrt(2.0 / 2))  # chi-square 2 on one degree of freedom
    assert clocks.pool([], []) is None


def test_motion_measures():
    t = np.arange(0, 10, 0.01)
    wave = np.sin(2 * np.pi * 2 * t)
    assert reversals(wave, 0.5) == 40
    assert bandwidth_hz(wave, 100.0) == pytest.approx(2.0, abs=0.15)


def test_noise_cost_is_quadratic_and_near_the_band_limited_value():
    one, two = (noise_cost(sd, 100, SETTINGS["ingest"], SETTINGS["scales"]) for sd in (0.5e-3, 1e-3))
    assert two == pytest.approx(4 * one)
    assert 0.03 < one < 0.12
    # of the same noise per frame, a low-pass leaves a third where there are three times as many frames
    faster = noise_cost(0.5e-3, 300, SETTINGS["ingest"], SETTINGS["scales"])
    assert faster == pytest.approx(one / 3)


def _pelvis(n: int, slide_m_per_rad: float) -> tuple[dict[str, np.ndarray], np.ndarray]:
    """Six markers of a person who turns by 60 degrees to either side, one ASIS sliding with the skin; rotations."""
    body = np.array(
        [[0, 0.13, 1], [0, -0.13, 1], [-0.16, 0.045, 1], [-0.16, -0.045, 1], [0.1, 0.17, 1], [0.1, -0.17, 1]]
    )
    yaw = np.radians(60) * np.sin(np.linspace(0, 4 * np.pi, n))
    r = Rotation.from_euler("z", yaw[:, None]).as_matrix()
    points = np.repeat(body[None], n, axis=0)
    points[:, 0, 1] += slide_m_per_rad * yaw
    points = np.einsum("nij,nkj->nki", r, points)
    return {name: points[:, i] for i, name in enumerate(markers.MARKERS)}, r


def test_sliding_skin_is_neither_a_swap_nor_a_moved_marker():
    still, _ = _pelvis(50, 0.0)
    reference = markers.reference_distances({name: values[:1] for name, values in still.items()})
    positions, rotation = _pelvis(1500, 0.045)
    off = markers.departures(positions, reference)
    assert np.abs(off).max() > 0.04
    assert np.abs(off - markers.skin(off, rotation)).max() < 0.005
    assert markers.find_swaps(positions, reference, **CONFIG["ingest"]["swap"]) == []
    # a marker that was moved stays visible, and so does an exchange that nothing repairs
    moved = positions | {"PSIS_L": positions["PSIS_L"] + np.einsum("nij,j->ni", rotation, [0.0, 0.06, 0.0])}
    off = markers.departures(moved, reference)
    assert np.percentile(np.abs(off - markers.skin(off, rotation)), 99, axis=0).max() > 0.03
    exchanged = markers.repaired(positions, [markers.Swap("ASIS_L", "PSIS_L", 300, 500)])
    off = markers.departures(exchanged, reference)
    assert np.percentile(np.abs(off - markers.skin(off, rotation)), 99, axis=0).max() > 0.03


def test_swap_on_sliding_skin_is_still_exchanged_back():
    still, _ = _pelvis(50, 0.0)
    reference = markers.reference_distances({name: values[:1] for name, values in still.items()})
    positions, _ = _pelvis(1500, 0.01)
    swap = markers.Swap("ASIS_R", "IF_R", 600, 700)
    found = markers.find_swaps(markers.repaired(positions, [swap]), reference, **CONFIG["ingest"]["swap"])
    assert found == [swap]


@pytest.mark.parametrize(
    ("span", "gaps", "unsure"),
    [
        # seen on both sides of a gap of one of the two, of a marker that tells which is which, at the record's end
        ((300, 900), {"IF_R": [(500, 520)]}, ()),
        ((300, 900), {"ASIS_L": [(500, 503)]}, ()),
        ((0, 1500), {"ASIS_L": [(700, 703)], "IF_L": [(0, 40), (1480, 1500)]}, ()),
        # it ends within a gap, and nobody knows where
        ((300, 900), {"IF_R": [(890, 930)]}, ((890, 930),)),
        ((300, 900), {"IF_L": [(280, 310)], "ASIS_R": [(895, 905)]}, ((280, 310), (895, 905))),
    ],
)
def test_a_gap_does_not_hide_that_labels_are_exchanged(span, gaps, unsure):
    clean, _ = _pelvis(1500, 0.0)
    reference = markers.reference_distances({name: values[:1] for name, values in clean.items()})
    positions = markers.repaired(clean, [markers.Swap("IF_L", "IF_R", *span)])
    for name, runs in gaps.items():
        for start, stop in runs:
            positions[name][start:stop] = np.nan
    (swap,) = markers.find_swaps(positions, reference, **CONFIG["ingest"]["swap"])
    assert swap.unsure == unsure
    back = markers.repaired(positions, [swap])
    for name in ("IF_L", "IF_R"):
        known = np.isfinite(back[name][:, 0])
        np.testing.assert_array_equal(back[name][known], clean[name][known])
        assert (~known).sum() <= sum(stop - start for runs in gaps.values() for start, stop in runs)
    # without an exchange, a gap is no reason for one
    for name in positions:
        clean[name][~np.isfinite(positions[name])] = np.nan
    assert markers.find_swaps(clean, reference, **CONFIG["ingest"]["swap"]) == []


def test_a_gap_that_was_filled_with_its_last_sample_is_a_gap():
    positions, _ = _pelvis(600, 0.0)
    noise = np.random.default_rng(3)
    positions = {name: values + noise.normal(0, 2e-4, values.shape) for name, values in positions.items()}
    assert markers.find_frozen(positions, **FROZEN) == []
    positions["IF_L"][101:140] = positions["IF_L"][100]
    positions["ASIS_R"][120:130] = positions["ASIS_R"][119]
    frozen = markers.find_frozen(positions, **FROZEN)
    assert frozen == [markers.Gap("ASIS_R", 120, 130), markers.Gap("IF_L", 101, 140)]
    masked = markers.without_frozen(positions, frozen)
    assert markers.find_gaps(masked) == frozen
    # an export with few digits, in which nobody moves, or slowly
    still = {name: np.round(values[:1] + 0 * values, 3) for name, values in positions.items()}
    assert markers.find_frozen(still, **FROZEN) == []
    slow, _ = _pelvis(6000, 0.0)
    slow = {name: np.round(values + noise.normal(0, 2e-4, values.shape), 3) for name, values in slow.items()}
    assert any(((np.diff(v[:, 0]) == 0)[k : k + 4]).all() for v in slow.values() for k in range(500))
    assert markers.find_frozen(slow, **FROZEN) == []
    slow["IF_L"][101:180] = slow["IF_L"][100]
    (gap,) = markers.find_frozen(slow, **FROZEN)
    assert (gap.marker, gap.stop) == ("IF_L", 180)
    assert gap.start in (100, 101)


@pytest.mark.parametrize("number", [9.999999, -0.001])
@pytest.mark.parametrize("span", [(100, 140), (0, 40), (560, 600)])
def test_a_number_that_stands_for_a_missing_sample_is_none_from_its_first_frame(number, span):
    positions, _ = _pelvis(600, 0.0)
    noise = np.random.default_rng(3)
    positions = {name: values + noise.normal(0, 2e-4, values.shape) for name, values in positions.items()}
    positions["IF_L"][slice(*span)] = number
    assert markers.find_frozen(positions, **FROZEN) == [markers.Gap("IF_L", *span)]
    # a gap on either side of it
    positions["IF_L"][max(span[0] - 5, 0) : span[0]] = np.nan
    assert markers.find_frozen(positions, **FROZEN) == [markers.Gap("IF_L", *span)]


def test_few_seconds_ask_for_more_standard_errors():
    fits = [
        clocks.ClockFit(0.0, 1.0, 0.0, 1.0, 0.0, 0.0, np.eye(3), np.zeros(3), n) for n in (12, 30, 10_000)
    ]
    certain = [fit.certainty(4.0) for fit in fits]
    assert certain[0] > certain[1] > certain[2] == pytest.approx(4.0, abs=0.01)


def test_spikes_and_gaps_are_found():
    t = np.arange(0, 5, 0.01)
    values = np.column_stack([0.1 * np.sin(t), 0.1 * np.cos(t), 0 * t])
    values[100:102] += 0.05
    values[200:250] = np.nan
    assert list(markers.spikes(values, 0.008)) == [100, 101]
    assert markers.find_gaps({"ASIS_L": values}) == [markers.Gap("ASIS_L", 200, 250)]
