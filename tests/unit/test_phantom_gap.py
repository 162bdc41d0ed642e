"""The sealed gap of a phantom: drawn causes, a plain fit that costs what was drawn, recordings that hold them."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import yaml
from real2sim.configuration import validated
from real2sim.errors import InputError
from real2sim.verification.cohort import plan
from real2sim.verification.cohort import write as cohort
from real2sim.verification.cohort.gap import Gap
from real2sim.verification.phantom import exports
from real2sim.verification.suite.forms import FORMS
from real2sim.verification.suite.synthetic import Cause

ROOT = Path(__file__).parents[2]
ROBOT = ROOT / "resources/robot/drba.xml"
CONTROLLERS = validated({}, "config", Path("defaults"))["robot"]
SHORT = {
    "cohort": {"S01": {"tightness": {"loosest_cm": 10, "tightest_cm": 10, "safe_comfortable_cm": 10}}},
    "trials": {
        "neutral_s": 4.5,
        "sweep_s": 3.0,
        "dynamic_s": 8.0,
        "walk_normal_trials": 0,
        "walk_robot_trials": 0,
    },
    "gap": {"draws": 2, "sizes": 4, "refits": 2, "two_share": 1.0, "prior": {"soft_tissue": 1, "tilt": 1}},
}


def _settings(tmp_path, own):
    """Settings of a file that extends config/phantom-gap.yaml's base."""
    gap = yaml.safe_load((ROOT / "config/phantom-gap.yaml").read_text())
    gap["gap"] |= own.pop("gap", {})
    path = tmp_path / "own.yaml"
    path.write_text(yaml.safe_dump(gap | own | {"extends": str(ROOT / "config/phantom.yaml")}))
    return plan.read_settings(path)


@pytest.fixture(scope="module")
def simulated(tmp_path_factory):
    settings = _settings(tmp_path_factory.mktemp("gap"), {k: dict(v) for k, v in SHORT.items()})
    return settings, cohort.simulate_subject(settings, CONTROLLERS, ROBOT, "S01")


def test_the_plain_fit_costs_what_was_drawn(simulated):
    settings, done = simulated
    truth = done.gap.truth()
    low, high = settings["gap"]["j"]
    assert low <= truth["j_wanted"] <= high
    assert truth["j_of_the_plain_fit"] == pytest.approx(truth["j_wanted"], rel=0.1)
    assert {cause["effect"] for cause in truth["causes"]} == {"soft_tissue", "tilt"}
    assert all(0 < c["severity"] <= settings["gap"]["largest"] for c in truth["causes"])


def test_only_the_neutral_and_dynamic_trials_hold_the_gap(simulated):
    settings, done = simulated
    person, trials = done.person, done.trials
    assert {t.name for t in trials if t.shown is not None} == {"neutral", "dynamic_1", "dynamic_2"}
    dynamic = next(t for t in trials if t.name == "dynamic_1")
    t = np.arange(0, 8, 0.1)
    shown, true = dynamic.shown(t), exports.true_markers(settings, person, dynamic, t)
    # the skin slides under the pelvis markers, and under none of the interface's
    assert np.abs(shown["ASIS_L"] - true["ASIS_L"]).max() > 1e-3
    np.testing.assert_allclose(shown["IF_L"], true["IF_L"], atol=1e-4)


@pytest.mark.parametrize(("sign", "largest"), [(1.0, 1.2), (-1.0, 0.4)])
def test_a_preload_leaves_the_motion_room_before_the_stops(sign, largest):
    gap, form = Gap.__new__(Gap), FORMS["preload"]
    gap._person = SimpleNamespace(stops={9: (np.full(6, -0.014), np.full(6, 0.05))}, operating_level=9)
    gap._options = {"largest": 2.5}
    gap._p = SimpleNamespace(about=SimpleNamespace(lower=np.full(6, -0.004), upper=np.full(6, 0.02)))
    draw = SimpleNamespace(axes=np.eye(6)[2], values={"sign": np.full(6, sign)})
    # the largest published preload is 25 mm
    assert gap._largest(Cause(form, "preload"), draw) == pytest.approx(largest)
    assert gap._largest(Cause(FORMS["soft_tissue"], "soft_tissue"), draw) == 2.5


@pytest.mark.long
def test_the_same_person_has_the_same_gap(simulated, tmp_path):
    settings, done = simulated
    again = _settings(tmp_path, {k: dict(v) for k, v in SHORT.items()})
    assert again == settings
    assert cohort.simulate_subject(again, CONTROLLERS, ROBOT, "S01").gap.truth() == done.gap.truth()


def test_the_clean_cohort_has_none():
    assert not plan.read_settings(ROOT / "config/phantom.yaml")["gap"]["enabled"]


@pytest.mark.parametrize(
    ("own", "place"),
    [
        ({"gap": {"prior": {"soft_tissue": 1, "soft_tisue": 1}}}, "gap.prior"),
        ({"trials": {"dynamic_trials": 1}}, "dynamic"),
    ],
)
def test_a_gap_that_cannot_be_is_refused_before_any_job(tmp_path, own, place):
    with pytest.raises(InputError, match=place) as refused:
        _settings(tmp_path, own)
    assert "own.yaml" in str(refused.value)


def test_a_file_extends_one_that_says_everything(tmp_path):
    (tmp_path / "own.yaml").write_text(f"extends: {ROOT / 'config/phantom-gap.yaml'}\n")
    with pytest.raises(InputError, match="extends another one"):
        plan.read_settings(tmp_path / "own.yaml")
