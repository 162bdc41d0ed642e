"""The step study chooses the largest step that a fine reference cannot tell apart, and says where there is none."""

from __future__ import annotations

import copy
import json
from pathlib import Path

import numpy as np
import pytest
from real2sim.configuration import validated
from real2sim.errors import InputError
from real2sim.inference.parameters import Bounds
from real2sim.study.step_study import _choose, parameter_draws, step_study
from recorded_trial import CONFIG, PUBLISHED, ROBOT, record

BOUNDS = Bounds.from_config(CONFIG["identification"]["bounds"])


@pytest.fixture(scope="module")
def trial(tmp_path_factory):
    return record(tmp_path_factory.mktemp("trial"), noise_m=0.0003)


def study(trial, out, timestep="auto", **changes) -> dict:
    settings = copy.deepcopy({key: CONFIG[key] for key in ("identification", "plant", "robot")})
    settings["plant"]["timestep_s"] = timestep
    settings["plant"]["study"] |= {
        "candidates_s": [0.01, 0.005, 0.0025],
        "reference_s": 0.001,
        "draws": 3,
    } | changes
    step_study(
        subject="S02",
        pose=trial.pose,
        markers=trial.markers,
        limits=trial.limits,
        robot=ROBOT,
        published=PUBLISHED,
        settings=settings,
        out=out,
    )
    return json.loads(out.read_text())


@pytest.fixture(scope="module")
def result(trial, tmp_path_factory) -> dict:
    return study(trial, tmp_path_factory.mktemp("study") / "plant.json")


def test_largest_passing_step_is_chosen(result):
    passing = [row["timestep_s"] for row in result["steps"] if row["passes"]]
    assert result["status"] == "ok"
    assert result["timestep_s"] == max(passing)
    assert result["trial"] == "dynamic_1"
    assert result["phantom"] is True


def test_rows_say_why_they_pass(result):
    options, bar = CONFIG["plant"]["study"], CONFIG["plant"]["replay_bar"]
    for row in result["steps"]:
        passes = (
            row["marker_rms_m_max"] < options["marker_rms_m"]
            and row["J_relative_max"] < options["J_relative"]
            and row["replay_rms_m"] < bar["rms_m"]
            and row["replay_lag_s"] < bar["lag_s"]
        )
        assert row["passes"] == passes
        assert row["marker_rms_m_median"] <= row["marker_rms_m_max"]


def test_error_on_a_smooth_path_falls_with_the_square_of_the_step(tmp_path):
    result = study(record(tmp_path), tmp_path / "plant.json")
    error = {row["timestep_s"]: row["marker_rms_m_median"] for row in result["steps"]}
    # against a reference at h_0 the difference goes with h^2 - h_0^2
    ratio = (0.01**2 - 0.001**2) / (0.005**2 - 0.001**2)
    assert error[0.01] / error[0.005] == pytest.approx(ratio, rel=0.05)


def test_bar_that_no_step_meets_is_said_and_the_smallest_is_taken(trial, tmp_path):
    result = study(trial, tmp_path / "plant.json", marker_rms_m=1e-9)
    assert result["status"] == "no candidate passes"
    assert not any(row["passes"] for row in result["steps"])
    assert result["timestep_s"] == 0.0025


def test_tight_bar_takes_a_smaller_step(trial, result, tmp_path):
    error = {row["timestep_s"]: row["marker_rms_m_max"] for row in result["steps"]}
    tight = study(trial, tmp_path / "plant.json", marker_rms_m=(error[0.01] + error[0.005]) / 2)
    assert tight["timestep_s"] == 0.005


def test_step_set_by_hand_is_kept_and_said(trial, tmp_path):
    result = study(trial, tmp_path / "plant.json", timestep=0.002)
    assert result["timestep_s"] == 0.002
    assert result["status"] == "set by hand"


def test_a_step_set_by_hand_that_fails_the_bars_says_so():
    rows = [{"timestep_s": 0.01, "passes": False}, {"timestep_s": 0.005, "passes": True}]
    plant = {"timestep_s": 0.01, "study": {"candidates_s": [0.01, 0.005]}}
    assert _choose(rows, plant) == (0.01, "set by hand, does not pass the bars of the step study")
    rows[1]["passes"] = False
    assert _choose(rows, plant) == (0.01, "set by hand, no candidate passes")
    assert _choose(rows, plant | {"timestep_s": "auto"}) == (0.005, "no candidate passes")


def test_draws_are_the_prior_and_points_of_its_intervals_within_the_bounds():
    draws = parameter_draws(PUBLISHED, BOUNDS, 6, 1)
    assert draws.shape == (6, 12)
    assert draws[0, 0] == 725
    assert (draws[1:] >= BOUNDS.lower).all()
    assert (draws[1:] <= BOUNDS.upper).all()
    assert np.array_equal(draws, parameter_draws(PUBLISHED, BOUNDS, 6, 1))
    assert not np.array_equal(draws[1:], parameter_draws(PUBLISHED, BOUNDS, 6, 2)[1:])


@pytest.mark.parametrize("k_rz", [[20, 500], [5, 14]])
def test_bounds_beside_the_published_interval_are_drawn_from(k_rz):
    bounds = Bounds.from_config(CONFIG["identification"]["bounds"] | {"k_rz": k_rz})
    draws = parameter_draws(PUBLISHED, bounds, 6, 1)
    assert (draws >= bounds.lower).all()
    assert (draws <= bounds.upper).all()
    assert len(np.unique(draws[1:, 5])) == 5


@pytest.mark.parametrize("step_s", [0.004, 0.003, 0.0015, 0.0007])
def test_the_step_that_is_advised_is_accepted(step_s):
    with pytest.raises(InputError, match="divided by a whole number") as refused:
        validated({"plant": {"timestep_s": step_s}}, "config", Path("mine.yaml"))
    advised = float(refused.value.remedy.removeprefix("Write ").partition(",")[0])
    assert advised < step_s
    validated({"plant": {"timestep_s": advised}}, "config", Path("mine.yaml"))
