"""Benchmarks that others published are diagnosed through the public calls: EMPS, Bouc-Wen, and EMPS as measured."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import mujoco
import numpy as np
import pandas as pd
import pytest
import real2sim as r2s
from real2sim.configuration import validated
from real2sim.diagnosis.described_trial import DescribedTrial
from real2sim.effects.base import Placed
from real2sim.effects.families import variables
from real2sim.effects.markers import drifting_marker
from real2sim.errors import InputError
from real2sim.recording.table import marker_columns, required_columns
from real2sim.system.described_plant import load_model
from real2sim.system.description import shipped
from real2sim.verification.systems import cuff, drba, one_axis
from real2sim.verification.systems.emps_data import read_emps

from tests.conftest import SHORT_SEARCH

GENERATORS = {"cuff": cuff, "drba": drba}
MEASURED = Path(__file__).parents[3] / "shared" / "measured" / "emps" / "DATA_EMPS.mat"
SETTINGS = {"diagnosis": {"search": SHORT_SEARCH}}


def _diagnosed(name: str, effect: str | None, folder: Path, duration_s: float) -> r2s.Diagnosis:
    system = r2s.System.from_yaml(shipped(name) / "system.yaml")
    simulate, effects = one_axis.SYSTEMS[name]
    size = effects[effect].typical if effect else 0.0
    simulate(effect, size, 1, folder, duration_s)
    quiet, train, held_out = (
        r2s.Recording.read(system, folder / f"{trial}.parquet") for trial in ("quiet", "train", "held_out")
    )
    return r2s.diagnose(system, train=train, held_out=held_out, quiet=quiet, settings=SETTINGS)


@pytest.mark.parametrize(
    ("name", "effect", "duration_s", "verdicts"),
    [
        # with dry friction it is diagnosed by its example (test_examples.py)
        ("emps", None, 4.0, ("none",)),
        ("bouc_wen", "hysteresis", 2.0, ("hysteresis",)),
        # two milliseconds and 150 Hz: delays and filters are searched at the pace of the system, not of a person
        ("bouc_wen", "sync_offset", 2.0, ("sync_offset",)),
        ("bouc_wen", "filter_lag", 2.0, ("filter_lag",)),
    ],
)
def test_nonlinearity_is_named_and_nothing_where_there_is_none(name, effect, duration_s, verdicts, tmp_path):
    answer = _diagnosed(name, effect, tmp_path, duration_s)
    assert answer.verdict in verdicts, answer.table().to_string()
    assert answer.probabilities[answer.verdict] > 0.5
    if name == "emps":
        found = answer.answer.parameters["d_x"]["with_effect"]
        assert found == pytest.approx(one_axis.EMPS["viscous"], rel=0.1)


def test_nothing_is_named_where_there_is_nothing_and_the_answer_is_the_same_bits_again(tmp_path):
    files = [tmp_path / "first.json", tmp_path / "again.json"]
    for path in files:
        answer = _diagnosed("bouc_wen", None, tmp_path, 1.0)
        assert (answer.verdict, answer.probabilities["none"] > 0.5) == ("none", True), (
            answer.table().to_string()
        )
        answer.save(path)
    assert str(answer).startswith(f"{answer.system.name}: none, probability ")
    assert files[0].read_bytes() == files[1].read_bytes()


@pytest.mark.skipif(not MEASURED.is_file(), reason=f"{MEASURED}: published without a licence, not in here")
def test_dry_friction_of_the_measured_emps_has_the_published_size():
    """The first stroke is fitted and the next one predicted; there is no recording of standing still."""
    system = r2s.System.from_yaml(shipped("emps") / "by_path.yaml")
    table = pd.DataFrame(read_emps(MEASURED))
    parts = []
    for name, begin_s, end_s in (("first", 0.0, 5.0), ("second", 5.0, 10.0)):
        part = table[(table["time_s"] >= begin_s) & (table["time_s"] < end_s)].reset_index(drop=True)
        part["time_s"] = np.arange(len(part)) * 1e-3
        parts.append(r2s.Recording.from_table(system, part, name))
    answer = r2s.diagnose(system, train=parts[0], held_out=parts[1], settings=SETTINGS)
    assert answer.verdict == "coulomb", answer.table().to_string()
    (force,) = (v["value"] for k, v in answer.answer.causes[0].parameters.items() if k.startswith("force"))
    assert force == pytest.approx(20.39, rel=0.05)
    assert answer.answer.parameters["mass"]["with_effect"] == pytest.approx(95.11, rel=0.02)


def test_replay_of_an_imposed_path_leaves_noise_alone_up_to_the_end_of_a_record(tmp_path):
    """The path ends in motion: a filter that reflects it there left 3.5 N of a noise of 0.2 N."""
    system = r2s.System.from_yaml(shipped("bouc_wen") / "system.yaml")
    one_axis.simulate_bouc_wen(None, 0.0, 1, tmp_path, 2.0)
    settings = validated({}, "config", Path("defaults"))["diagnosis"]["described"]
    recording = r2s.Recording.read(system, tmp_path / "train.parquet")
    evidence = DescribedTrial(system, recording, None, settings).evidence()
    values = np.array([[one_axis.BOUC_WEN["stiffness"], one_axis.BOUC_WEN["damping"]]])
    left = evidence.replay((), 1).run_effects(values, ())[0][0] - evidence.measured.observed
    assert np.std(left[-60:]) == pytest.approx(one_axis.BOUC_WEN_FORCE_NOISE_N, rel=0.2)
    assert np.std(left) == pytest.approx(one_axis.BOUC_WEN_FORCE_NOISE_N, rel=0.1)


def test_jumps_are_faster_than_the_system_and_a_large_swing_is_none(tmp_path):
    system = r2s.System.from_yaml(shipped("bouc_wen") / "system.yaml")
    one_axis.simulate_bouc_wen(None, 0.0, 1, tmp_path, 2.0)
    settings = validated({}, "config", Path("defaults"))["diagnosis"]["described"]
    recording = r2s.Recording.read(system, tmp_path / "train.parquet")
    evidence = DescribedTrial(system, recording, None, settings).evidence()
    n, sd = len(recording.time_s), evidence.measured.observed_sd[0]
    error = sd * np.random.default_rng(1).standard_normal((n, 1))
    assert evidence.with_spikes(evidence.measured.observed + error) is evidence
    swing = 40 * sd * np.exp(-(((recording.time_s - 1.0) / 0.05) ** 2))[:, None]
    assert evidence.with_spikes(evidence.measured.observed + error + swing) is evidence
    jumped = error.copy()
    jumped[300:303] += 40 * sd
    found = evidence.with_spikes(evidence.measured.observed + jumped).context.spikes
    assert np.flatnonzero(found[:, 0]).tolist() == [300, 301, 302]


def test_the_zero_of_a_sensor_may_differ_and_nothing_else(tmp_path):
    """A force sensor that is off by two of its SD leaves next to nothing; a force that swings as much is left."""
    fixed = r2s.System.from_yaml(shipped("bouc_wen") / "system.yaml")
    free = replace(fixed, outputs=(replace(fixed.outputs[0], zero_sd=5.0),))
    one_axis.simulate_bouc_wen(None, 0.0, 1, tmp_path, 2.0)
    settings = validated({}, "config", Path("defaults"))["diagnosis"]["described"]
    values = np.array([one_axis.BOUC_WEN["stiffness"], one_axis.BOUC_WEN["damping"]])
    left = {}
    for name, system in (("fixed", fixed), ("free", free)):
        recording = r2s.Recording.read(system, tmp_path / "train.parquet")
        evidence = DescribedTrial(system, recording, None, settings).evidence().with_noise(values, 20, 1)
        offset = np.full((1, len(recording.time_s), 1), 10.0)
        swinging = offset * np.sin(2 * np.pi * recording.time_s)[None, :, None]
        left[name] = [float(np.sum(evidence.whiten(error) ** 2)) for error in (offset, swinging)]
    assert left["free"][0] < 20 < 1000 < left["fixed"][0]
    assert left["free"][1] > 0.9 * left["fixed"][1]


@pytest.mark.parametrize(("name", "places"), [("cuff", 7), ("drba", 3)])
def test_joints_of_a_described_machine_yield_as_described_at_rest_and_otherwise_elsewhere(
    name, places, tmp_path
):
    system = r2s.System.from_yaml(shipped(name) / "system.yaml")
    GENERATORS[name].simulate(None, 0.0, 1, tmp_path, duration_s=3.2)
    settings = validated({}, "config", Path("defaults"))["diagnosis"]["described"]
    train, quiet = (r2s.Recording.read(system, tmp_path / f"{t}.parquet") for t in ("train", "quiet"))
    evidence = DescribedTrial(system, train, quiet, settings).evidence()
    lower, upper = system.bounds()
    middle = system.values((lower + upper)[None] / 2)
    plain = evidence.raw(*evidence.replay((), 1).run_effects(middle, ()))
    effects = [e for e in r2s.catalogue(system) if e.name == "base_compliance"]
    found = [Placed(e, where, evidence.scales) for e in effects for where in e.places(system)]
    assert len(found) == places
    for placed in found:
        rest = np.array([placed.effect.at_rest.values])
        there = evidence.raw(*evidence.replay((placed,), 1).run_effects(middle, (rest,)))
        assert np.abs(there - plain).max() < 1e-9, placed.key
        away = evidence.raw(*evidence.replay((placed,), 1).run_effects(middle, (rest - 1.0,)))
        assert np.abs(away - plain).max() > 1e-5, placed.key


def test_the_machine_weighs_what_its_model_weighs(tmp_path):
    """The driven segment is a body of immense inertia behind it."""
    system = r2s.System.from_yaml(shipped("cuff") / "system.yaml")
    cuff.simulate(None, 0.0, 1, tmp_path, duration_s=3.2)
    settings = validated({}, "config", Path("defaults"))["diagnosis"]["described"]
    train, quiet = (r2s.Recording.read(system, tmp_path / f"{t}.parquet") for t in ("train", "quiet"))
    evidence = DescribedTrial(system, train, quiet, settings).evidence()
    own = load_model(system).compile().body_mass.sum()
    assert own < 1e3
    assert evidence.context.robot.mass == pytest.approx(own)
    # variables of measured laws, where what is observed is no pair of markers
    ones = np.ones(len(system.axes))
    moved = variables(evidence.context, system, ones, ones, 10.0)
    assert {"pelvis_tilt", "place_x"} <= set(moved)
    assert all(np.isfinite(v.values).all() for v in moved.values())


def test_quiet_recording_that_is_too_short_for_a_rest_pose_is_refused(tmp_path):
    system = r2s.System.from_yaml(shipped("cuff") / "system.yaml")
    cuff.simulate(None, 0.0, 1, tmp_path, duration_s=1.2)
    train, quiet = (r2s.Recording.read(system, tmp_path / f"{t}.parquet") for t in ("train", "quiet"))
    with pytest.raises(InputError, match=r"(?s)quiet.*1\.2 s.*at least 3 s"):
        r2s.identify(system, train, quiet)


def _cuff_standing(marker: str, lost: slice) -> DescribedTrial:
    """Return a trial of the cuff on a thigh of four markers that stands still, one of them lost for a while."""
    system = r2s.System.from_yaml(shipped("cuff") / "system.yaml")
    system = replace(system, markers=replace(system.markers, segment=(*system.markers.segment, "THI_D")))
    model = load_model(system).compile()
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    places = {m: data.site(site).xpos.copy() for m, site in system.markers.sites.items()}
    thigh = [[0.08, 0, 0.1], [0.08, 0, -0.1], [0.02, -0.07, 0], [0.05, 0, 0]]
    places |= dict(zip(system.markers.segment, np.array(thigh) + data.body("cuff").xpos, strict=True))
    rng, time_s, given = np.random.default_rng(1), np.arange(400) / 100, []
    for name in ("quiet", "train"):
        columns = {c: 1e-5 * rng.standard_normal(400) for c in required_columns(system)}
        for m, place in places.items():
            for c, value in zip(marker_columns(m), place, strict=True):
                columns[c] += value
                columns[c][lost if (m, name) == (marker, "train") else slice(0)] = np.nan
        given.append(r2s.Recording.from_table(system, pd.DataFrame({"time_s": time_s} | columns), name))
    settings = validated({}, "config", Path("defaults"))["diagnosis"]["described"]
    return DescribedTrial(system, given[1], given[0], settings)


def test_a_segment_whose_pose_is_unknown_for_long_does_not_drive_a_simulation():
    with pytest.raises(InputError) as refused:
        _cuff_standing("THI_A", slice(150, 200))
    assert (refused.value.code, refused.value.place) == ("drive_gap", "column THI_A_x_m, from 1.5 s")


@pytest.mark.parametrize(("marker", "last"), [("THI_A", 153), ("THI_D", 200)])
def test_a_segment_drives_through_short_gaps_and_without_markers_that_its_pose_does_not_need(marker, last):
    setup = _cuff_standing(marker, slice(150, last)).setup(1)
    assert np.isfinite(setup.commands).all()


def test_marker_of_a_described_system_drifts_as_one_of_the_strap():
    """Observations of a described system are columns: three of each marker, then the outputs."""
    context = SimpleNamespace(time_s=np.linspace(0.0, 1.0, 5))
    rate = np.array([[0.1, 0.2, 0.3], [0.0, -0.1, 0.0]])
    for side in (0, 1):
        pairs = drifting_marker(side)(np.zeros((2, 5, 2, 3)), rate, context)
        columns = drifting_marker(side)(np.zeros((2, 5, 7)), rate, context)
        assert np.array_equal(columns[:, :, :6], pairs.reshape(2, 5, 6))
        assert not columns[:, :, 6].any()
