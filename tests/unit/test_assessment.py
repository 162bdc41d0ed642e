"""What a fit is worth, on a trial whose parameters are known and whose noise is."""

from __future__ import annotations

import csv
import json

import numpy as np
import pytest
from real2sim.geometry import PELVIS_MARKERS
from real2sim.inference.identifiability import central_jacobian
from real2sim.inference.least_squares import Residuals, minimise
from real2sim.inference.parameters import PARAMETERS, Bounds, as_vector
from real2sim.recording.trial import TrialModel, replay_of, trial_model
from real2sim.signals import lowpass
from real2sim.study import assessment as module
from real2sim.study.assessment import (
    InputNoise,
    assessment,
    assessment_table,
    pelvis_marker_noise,
    robot_sensitivity,
    with_pelvis_noise,
)
from real2sim.study.fit import fit_trial
from recorded_trial import CONFIG, ROBOT, record

NOISE_M = 0.0003
SETTINGS = {key: CONFIG[key] for key in ("identification", "identifiability", "plant", "robot", "ingest")}
STEPPED = SETTINGS | {"plant": SETTINGS["plant"] | {"timestep_s": 0.01}}
BOUNDS = Bounds.from_config(CONFIG["identification"]["bounds"])


def model_of(trial, robot=ROBOT) -> TrialModel:
    return trial_model(
        pose=trial.pose, markers=trial.markers, limits=trial.limits, robot=robot, settings=STEPPED, nsim=13
    )


def problem_of(model: TrialModel) -> Residuals:
    return Residuals(lambda p: model.cost.residuals(model.replay.run(p)), BOUNDS, 13)


@pytest.fixture(scope="module")
def trial(tmp_path_factory):
    return record(tmp_path_factory.mktemp("trial"), noise_m=NOISE_M)


@pytest.fixture(scope="module")
def model(trial):
    return model_of(trial)


@pytest.fixture(scope="module")
def assessed(trial, tmp_path_factory) -> dict:
    folder = tmp_path_factory.mktemp("assessed")
    fits = []
    for restart, factor in ((1, 1.3), (2, 1.0)):
        fits.append(folder / f"restart-{restart}.json")
        parameters = {name: value * factor for name, value in trial.parameters.items()}
        fits[-1].write_text(
            json.dumps({"restart": restart, "parameters": parameters, "cost": {"J": factor}, "phantom": True})
        )
    assessment(
        subject="S02",
        trial="dynamic_1",
        fits=fits,
        pose=trial.pose,
        markers=trial.markers,
        neutral_quality=trial.neutral_quality,
        limits=trial.limits,
        step=trial.step,
        robot=ROBOT,
        settings=SETTINGS,
        out=folder / "out.json",
    )
    return json.loads((folder / "out.json").read_text())


def test_best_restart_is_assessed_and_its_intervals_hold_the_truth(trial, assessed):
    assert assessed["restart"] == 2
    assert assessed["phantom"] is True
    assert assessed["input_noise_m"] == pytest.approx([NOISE_M] * 4)
    sure = {name: row for name, row in assessed["parameters"].items() if row["verdict"] == "determined"}
    assert len(sure) >= 6
    held = [row["ci95"][0] <= trial.parameters[name] <= row["ci95"][1] for name, row in sure.items()]
    assert sum(held) >= len(held) - 1
    for name, row in sure.items():
        assert row["value"] == pytest.approx(trial.parameters[name], rel=0.25)
        assert row["sd_ln"] <= SETTINGS["identifiability"]["determined_sd_ln"]


def test_every_assumed_constant_has_its_sensitivity(assessed):
    sensitivity = assessed["robot_sensitivity_percent_per_10_percent"]
    assert {"hold.x.stiffness", "hold.yaw.damping", "arm.pitch.stiffness", "base.mass"} <= set(sensitivity)
    assert len(sensitivity) == 12 + 6
    # without a force sensor only ratios to the robot's impedance are seen: a stiffer hold makes a stiffer strap
    assert sensitivity["hold.x.damping"]["d_tx"] > 1


def test_sensitivity_foretells_the_refit(trial, model):
    z, _, _, _ = minimise(
        problem_of(model), np.log(as_vector(trial.parameters)), np.arange(12), iterations=20, ftol=1e-9
    )
    _, jacobian = central_jacobian(problem_of(model), z, 1e-3)
    moved = robot_sensitivity(model, np.exp(z), jacobian, np.arange(12), robot=ROBOT, settings=STEPPED)
    heavier = replay_of(model.trial, model.limits, ROBOT, STEPPED, nsim=13, scale={"base.mass": 1.1})
    changed = TrialModel(model.trial, heavier, model.cost, model.limits)
    again, _, _, _ = minimise(problem_of(changed), z, np.arange(12), iterations=20, ftol=1e-9)
    for name in ("k_tx", "d_tx", "k_ty"):
        i = PARAMETERS.index(name)
        expected = moved["base.mass"][name] / 100
        assert np.expm1(again[i] - z[i]) == pytest.approx(expected, rel=0.15, abs=2e-3), name


def test_a_parameter_beside_which_the_simulation_fails_has_no_sensitivity(trial, model):
    jacobian = np.random.default_rng(1).standard_normal(
        (len(problem_of(model).many(np.zeros((1, 12)))[0]), 12)
    )
    jacobian[:, 2] = np.nan
    parameters = as_vector(trial.parameters)
    moved = robot_sensitivity(model, parameters, jacobian, np.arange(12), robot=ROBOT, settings=STEPPED)
    assert all(set(row) == set(PARAMETERS) - {PARAMETERS[2]} for row in moved.values())


def test_added_noise_has_the_size_that_was_asked_for(model):
    noise = np.array([0.001, 0.001, 0.0, 0.0])
    noisy = with_pelvis_noise(model.trial, noise, CONFIG["ingest"], np.random.default_rng(1))
    shift = noisy.pelvis_position - model.trial.pelvis_position
    # the origin is the middle of two markers; a 12 Hz low-pass leaves a quarter of the variance at 100 Hz
    expected = 0.001 / np.sqrt(2) * np.sqrt(2 * 12 / 100)
    assert shift.std(axis=0) == pytest.approx([expected] * 3, rel=0.2)
    clean = with_pelvis_noise(model.trial, np.zeros(4), CONFIG["ingest"], np.random.default_rng(1))
    assert np.allclose(clean.pelvis_rotation, model.trial.pelvis_rotation, atol=1e-12)


def test_gaps_of_the_pelvis_stay_gaps_when_noise_is_added(model):
    import dataclasses

    position, rotation = model.trial.pelvis_position.copy(), model.trial.pelvis_rotation.copy()
    markers = model.trial.pelvis_markers.copy()
    markers[200:230, 0] = position[200:230] = rotation[200:230] = np.nan
    gapped = dataclasses.replace(
        model.trial, pelvis_position=position, pelvis_rotation=rotation, pelvis_markers=np.nan_to_num(markers)
    )
    noisy = with_pelvis_noise(gapped, np.full(4, 0.001), CONFIG["ingest"], np.random.default_rng(1))
    assert np.isnan(noisy.pelvis_position[200:230]).all()
    assert np.isfinite(noisy.pelvis_position[:200]).all()


def test_input_noise_costs_with_the_square_of_its_size(trial, model):
    z = np.log(as_vector(trial.parameters))
    small, large = (
        InputNoise(model, np.full(4, sd), robot=ROBOT, settings=STEPPED)(z) for sd in (1e-4, 2e-4)
    )
    assert large.score == pytest.approx(4 * small.score, rel=0.1, abs=1e-3 * np.abs(large.score).max())
    assert np.diag(large.curvature) == pytest.approx(4 * np.diag(small.curvature), rel=0.1)
    none = InputNoise(model, np.zeros(4), robot=ROBOT, settings=STEPPED)(z)
    assert np.abs(none.score).max() < 1e-9 * np.abs(small.score).max()


def test_slope_of_the_input_noise_is_the_excess_slope_of_the_cost(trial, tmp_path):
    # over many noisy recordings of one trial the mean slope of J at the truth is what the noise of the input adds
    z = np.log(as_vector(trial.parameters))
    slopes, predicted = [], []
    for seed in range(6):
        noisy = model_of(record(tmp_path / str(seed), noise_m=0.0005, seed=10 + seed))
        residual, jacobian = central_jacobian(problem_of(noisy), z, 1e-3)
        slopes.append(jacobian.T @ residual)
        if seed < 2:
            predicted.append(InputNoise(noisy, np.full(4, 0.0005), robot=ROBOT, settings=STEPPED)(z).score)
    mean, spread = np.mean(slopes, axis=0), np.std(slopes, axis=0, ddof=1) / np.sqrt(len(slopes))
    expected = np.mean(predicted, axis=0)
    clear = np.abs(expected) > 4 * spread
    assert clear.sum() >= 3
    assert mean[clear] == pytest.approx(expected[clear], rel=0.4)
    assert np.all(np.abs(mean - expected) < 5 * spread + 0.2 * np.abs(expected))


def test_noise_is_read_from_the_neutral_or_not_known(trial, tmp_path):
    assert pelvis_marker_noise(trial.neutral_quality, 100) == pytest.approx([NOISE_M] * 4)
    axes = {name: {"noise_sd_m": [3e-4, 4e-4, 0.0]} for name in PELVIS_MARKERS}
    path = tmp_path / "quality.json"
    path.write_text(json.dumps({"markers": axes, "markers_rate_hz": 100}))
    assert pelvis_marker_noise(path, 100) == pytest.approx([5e-4 / np.sqrt(3)] * 4)
    axes["PSIS_L"]["noise_sd_m"] = [3e-4, None, 1e-4]
    path.write_text(json.dumps({"markers": axes, "markers_rate_hz": 100}))
    assert pelvis_marker_noise(path, 100) is None
    del axes["PSIS_L"]
    path.write_text(json.dumps({"markers": axes, "markers_rate_hz": 100}))
    assert pelvis_marker_noise(path, 100) is None


@pytest.mark.parametrize("camera_hz", [60, 100, 200, 300])
def test_noise_of_fast_cameras_is_what_the_low_pass_of_the_ingest_leaves_of_it(model, tmp_path, camera_hz):
    # the ingest filters at the rate of the cameras and then takes every so many frames; the study adds noise at 100 Hz
    seconds, sd = 200, 0.0015
    raw = sd * np.random.default_rng(2).standard_normal((camera_hz * seconds, 3))
    left = lowpass(raw, camera_hz, CONFIG["ingest"]["cutoff_hz"], CONFIG["ingest"]["filter_order"])
    axes = {name: {"noise_sd_m": [sd] * 3} for name in PELVIS_MARKERS}
    path = tmp_path / "quality.json"
    path.write_text(json.dumps({"markers": axes, "markers_rate_hz": camera_hz}))
    known = pelvis_marker_noise(path, 100)
    assert known is not None
    white = known[0] * np.random.default_rng(3).standard_normal((100 * seconds, 3))
    added = lowpass(white, 100, CONFIG["ingest"]["cutoff_hz"], CONFIG["ingest"]["filter_order"])
    assert added.std() == pytest.approx(left.std(), rel=0.05)


def test_table_names_the_constant_that_matters_most(trial, assessed, tmp_path):
    source = tmp_path / "one.json"
    source.write_text(json.dumps(assessed))
    assessment_table(assessments=[source], out=tmp_path / "table.csv")
    with (tmp_path / "table.csv").open() as stream:
        rows = {row["parameter"]: row for row in csv.DictReader(stream)}
    assert list(rows) == list(PARAMETERS)
    assert tuple(next(iter(rows.values()))) == module.TABLE_COLUMNS
    sensitivity = assessed["robot_sensitivity_percent_per_10_percent"]
    for name, row in rows.items():
        known = {constant: moved[name] for constant, moved in sensitivity.items() if name in moved}
        if known:
            assert abs(float(row["change_percent_per_10_percent"])) == max(map(abs, known.values()))
        low, high = assessed["parameters"][name]["ci95"]
        # the assessed value is not the fit's own: least squares go on from the best restart
        assert float(row["fitted"]) == trial.parameters[name]
        assert row["fitted"] != row["value"]
        assert row["ci95_low"] == ("" if low is None else repr(low))
        assert row["ci95_high"] == ("" if high is None else repr(high))


def test_fit_is_the_same_bytes_with_one_thread_and_two_alone_and_beside_another(trial, tmp_path):
    settings = {key: CONFIG[key] for key in ("identification", "plant", "robot")}
    settings["identification"] = settings["identification"] | {"evaluations": 33}
    for method in ("cma", "least_squares"):
        settings["identification"] |= {
            "method": method,
            "least_squares": {"screen": 13, "iterations": 2, "ftol": 1e-6},
        }
        files = []
        for threads, restarts in ((1, [1]), (2, [2, 1])):
            out = [tmp_path / f"{method}-{threads}-{restart}.json" for restart in restarts]
            files.append(out[-1])
            fit_trial(
                subject="S02",
                trial="dynamic_1",
                restarts=restarts,
                pose=trial.pose,
                markers=trial.markers,
                limits=trial.limits,
                step=trial.step,
                robot=ROBOT,
                settings=settings,
                out=out,
                threads=threads,
            )
        assert files[0].read_bytes() == files[1].read_bytes()


def test_a_robot_with_actuators_of_its_own_is_moved_by_the_pelvis_alone(trial, model, tmp_path):
    """A published model has drives: they are not what moved the strap, nor do they take the place of what did."""
    drives = """<actuator><position name="own" joint="base_x" kp="5000"/><velocity joint="arm_lift" kv="90"/>
      </actuator><sensor><jointpos joint="arm_roll"/><actuatorfrc actuator="own"/></sensor>
      <keyframe><key ctrl="0.5 0.5"/></keyframe></mujoco>"""
    other = tmp_path / "robot.xml"
    other.write_text(ROBOT.read_text(encoding="utf-8").replace("</mujoco>", drives), encoding="utf-8")
    parameters = as_vector(trial.parameters)[None]
    moved = model_of(trial, other).replay.run(parameters)
    assert np.isfinite(moved).all()
    assert np.array_equal(moved, model.replay.run(parameters))
