"""The diagnosis suite: its plan, the equations of its effects against closed forms, its severities, its files."""

from __future__ import annotations

import copy
import json
from collections import Counter
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import yaml
from real2sim.artefacts import write_json
from real2sim.configuration import validated
from real2sim.diagnosis.free_form import Library
from real2sim.diagnosis.search import Pair
from real2sim.effects.base import InterfaceImpedance, Placed
from real2sim.effects.catalogue import EFFECTS
from real2sim.recording.ingest import ingest_subject
from real2sim.recording.noise import Bands, NoiseModel, robot_noise
from real2sim.study.strap_evidence import StrapEvidence
from real2sim.study.strap_imagined import _moved, imagined, injected, motions
from real2sim.study.strap_recording import load_evidence
from real2sim.verification.phantom import tasks
from real2sim.verification.phantom.motions import Motion, pelvis_path
from real2sim.verification.phantom.person import Person
from real2sim.verification.phantom.physics import Controller, Robot
from real2sim.verification.suite import excitation, laws, measurement, plan
from real2sim.verification.suite.effects import FORMS
from real2sim.verification.suite.laws import EffectLaw
from real2sim.verification.suite.setups import Setup, run
from real2sim.verification.suite.severity import Search
from real2sim.verification.suite.write import regimes, write_cases
from scipy.spatial.transform import Rotation

ROOT = Path(__file__).parents[2]
ROBOT = ROOT / "resources/robot/drba.xml"
SUITES = ("suite", "suite-standard", "suite-ci", "suite-development")
STEP = 5e-4


def load(name):
    source = ROOT / "config" / f"{name}.yaml"
    return validated(yaml.safe_load(source.read_text()), "suite", source)


# -------------------- plan


@pytest.mark.parametrize("name", SUITES)
def test_plan_has_every_stratum_in_balance(name):
    suite = load(name)
    cases = plan.cases(suite)
    assert Counter(c.stratum for c in cases) == Counter({k: v for k, v in suite["cases"].items() if v})
    single = [c for c in cases if c.stratum == "in_library"]
    per_effect = Counter(c.forms[0] for c in single)
    assert max(per_effect.values()) - min(per_effect.get(e, 0) for e in plan.EFFECTS) <= 1
    per_visibility = Counter(c.target for c in single)
    assert set(per_visibility) == {0.05, 0.2, 1.0}
    assert max(per_visibility.values()) - min(per_visibility.values()) <= 8
    assert all((c.target is None) == c.stratum.startswith("null") for c in cases)


def test_sizes_are_those_of_the_specification():
    assert [sum(load(name)["cases"].values()) for name in SUITES[:3]] == [720, 240, 40]
    assert sum(load("suite-development")["cases"].values()) >= 240
    assert len({load(name)["seed"] for name in SUITES}) == 4


def test_plan_is_a_function_of_the_seed():
    suite = load("suite-ci")
    assert plan.cases(suite) == plan.cases(copy.deepcopy(suite))
    assert plan.cases(suite) != plan.cases(suite | {"seed": suite["seed"] + 1})


def test_shards_part_the_cases():
    suite = load("suite-standard") | {"shard_cases": 7}
    names = [name for shard in range(plan.shards(suite)) for name in plan.case_names(suite, shard)]
    assert names == [case.id for case in plan.cases(suite)]


def test_mixtures_take_no_two_of_an_ambiguity_group():
    for case in plan.cases(load("suite")):
        if case.stratum == "mixture":
            assert not any(set(case.forms) <= set(group) for group in plan.GROUPS)


def test_every_planned_form_exists_and_has_a_family():
    assert set(plan.EFFECTS) <= set(FORMS)
    for name in SUITES:
        suite = load(name)
        assert set(suite["effects"]) == set(plan.EFFECTS)
        assert all(FORMS[form].family in plan.EFFECTS for form in suite["form_mismatch"])
        assert all(FORMS[form].effect not in plan.EFFECTS for form in suite["out_of_library"])


# -------------------- equations of the strap


def on_tx(**values):
    """Parameters of one term: numbers go to tx, the other axes get what leaves them alone."""
    neutral = {"yield_travel": 1.0, "stribeck": 1.0, "spring": 1.0, "width": 1.0, "length": 1e6}
    return {
        name: value if np.ndim(value) else np.array([value] + [neutral.get(name, 0.0)] * 5)
        for name, value in values.items()
    }


def forces(kind, values, q, step=STEP):
    """Force along tx (n,) of a term that follows q(t) (n,) at rates by central differences."""
    term = kind(np.array([0]), step, [values])
    rates = np.gradient(q, step)
    out = []
    for position, rate in zip(q, rates, strict=True):
        row, speed = np.zeros((1, 6)), np.zeros((1, 6))
        row[0, 0], speed[0, 0] = position, rate
        out.append(term.force(row, speed)[0])
    assert np.abs(np.array(out)[:, 1:]).max() < 1e-9
    return np.array(out)[:, 0]


def loop_area(kind, values, amplitude, hz, step=STEP):
    """Work taken out in the third period of a sinusoid."""
    period = round(1 / hz / step)
    t = np.arange(3 * period + 1) * step
    q = amplitude * np.sin(2 * np.pi * hz * t)
    f = forces(kind, values, q, step)
    return -np.trapezoid(f[2 * period :], q[2 * period :])


def test_slack_leaves_no_force_inside_the_dead_band():
    k, w = 2000.0, 0.008
    q = np.linspace(-0.03, 0.03, 121)
    total = -k * q + forces(laws.Slack, on_tx(stiffness=k, half_width=w), q)
    inside = np.abs(q) <= w
    np.testing.assert_allclose(total[inside], 0, atol=1e-9)
    np.testing.assert_allclose(total, -k * np.sign(q) * np.maximum(np.abs(q) - w, 0), atol=1e-9)


def test_smooth_slack_is_slack_far_from_its_edge():
    k, w, q = 2000.0, 0.004, np.array([-0.03, 1e-6, 0.03])
    total = -k * q + forces(laws.SmoothSlack, on_tx(stiffness=k, half_width=w), q)
    np.testing.assert_allclose(total, -k * np.sign(q) * np.maximum(np.abs(q) - w, 0), atol=1e-4)


def test_one_sided_strap_of_full_share_is_loose_on_its_other_side():
    k, q = 900.0, np.linspace(-0.02, 0.02, 41)
    extra = forces(laws.OneSided, on_tx(stiffness=k, share=1.0, side=1.0, onset=0.005), q)
    np.testing.assert_allclose(-k * q + extra, -k * np.maximum(q - 0.005, 0), atol=1e-9)


def test_even_part_keeps_the_stiffness_positive():
    k, reach, q = 900.0, 0.02, np.linspace(-0.06, 0.06, 601)
    extra = forces(laws.Quadratic, on_tx(quadratic=0.45 * k / reach, range=reach), q)
    np.testing.assert_allclose(extra[np.abs(q) < reach], (-0.45 * k / reach * q**2)[np.abs(q) < reach])
    assert (np.diff(-k * q + extra) < 0).all()


@pytest.mark.parametrize(
    ("kind", "values"),
    [
        (laws.Stick, on_tx(upper=10.0, lower=10.0, spring=1e6)),
        (laws.BoucWen, on_tx(strength=10.0, yield_travel=0.004) | {"shape": 0.7}),
        (laws.Iwan, on_tx(strength=10.0, yield_travel=0.004)),
    ],
)
def test_rate_independent_laws_take_the_same_work_at_any_speed(kind, values):
    areas = [loop_area(kind, values, 0.02, hz) for hz in (0.25, 1.0, 4.0)]
    np.testing.assert_allclose(areas, areas[0], rtol=0.02)


def test_coulomb_loop_is_four_times_force_times_amplitude():
    area = loop_area(laws.Stick, on_tx(upper=10.0, lower=10.0, spring=1e6), 0.02, 1.0)
    assert area == pytest.approx(4 * 10 * 0.02, rel=0.01)


def test_bouc_wen_saturates_at_its_strength_and_begins_with_its_stiffness():
    values = on_tx(strength=10.0, yield_travel=0.004) | {"shape": 0.5}
    q = np.arange(0, 0.08, 1e-5)
    f = -forces(laws.BoucWen, values, q)
    np.testing.assert_allclose(f, 10 * (1 - np.exp(-q / 0.004)), atol=1e-9)


def test_iwan_slips_element_by_element():
    q = np.arange(0, 0.02, 1e-5)
    f = -forces(laws.Iwan, on_tx(strength=10.0, yield_travel=0.004), q)
    assert f[-1] == pytest.approx(10.0)
    slopes = np.diff(f)[:800:100]
    assert (np.diff(slopes) <= 1e-9).all()
    assert slopes[0] > 3 * slopes[-1]


def test_lugre_slides_at_its_stribeck_curve():
    values = on_tx(coulomb=10.0, static=15.0, stribeck=0.02, spring=1e5)
    for speed in (0.002, 0.02, 0.2):
        f = -forces(laws.LuGre, values, speed * np.arange(2000) * STEP)
        assert f[-1] == pytest.approx(10 + 5 * np.exp(-((speed / 0.02) ** 2)), rel=1e-3)


def test_relaxing_branch_decays_with_its_time_constant():
    tau, k1 = 0.4, 800.0
    t = np.arange(0, 3, STEP)
    q = 0.01 * np.clip(t / 0.01, 0, 1)  # a step within 10 ms, then held
    f = -forces(laws.Maxwell, on_tx(branch=k1) | {"tau": tau}, q)
    assert f.max() == pytest.approx(k1 * 0.01, rel=0.02)
    late = t > 0.1
    assert -1 / np.polyfit(t[late], np.log(f[late]), 1)[0] == pytest.approx(tau, rel=1e-3)


def test_relaxation_loop_peaks_at_its_time_constant():
    tau, k1, amplitude = 0.2, 500.0, 0.01
    for hz in (0.25, 1 / (2 * np.pi * tau), 4.0):
        w = 2 * np.pi * hz * tau
        expected = np.pi * amplitude**2 * k1 * w / (1 + w * w)
        values = on_tx(branch=k1) | {"tau": tau}
        assert loop_area(laws.Maxwell, values, amplitude, hz) == pytest.approx(expected, rel=0.01)


def test_several_branches_are_the_sum_of_single_ones():
    q = 0.01 * np.sin(np.arange(0, 6, STEP) * 5)
    branch = np.zeros((6, 2))
    branch[0] = [300.0, 200.0]
    both = forces(laws.Prony, {"branch": branch, "tau": np.array([0.1, 1.0])}, q)
    singles = [
        forces(laws.Maxwell, on_tx(branch=k) | {"tau": tau}, q) for k, tau in ((300.0, 0.1), (200.0, 1.0))
    ]
    np.testing.assert_allclose(both, sum(singles), atol=1e-9)


def test_migration_steps_after_a_peak_and_never_returns():
    t = np.arange(0, 4, STEP)
    q = 0.02 * np.sin(np.pi * np.clip(t - 1, 0, 1)) ** 2  # one excursion from 1 s to 2 s
    values = on_tx(stiffness=1000.0, rate=5.0, threshold=0.008, side=1.0)
    slipped = forces(laws.Ratchet, values, q) / 1000
    assert slipped[t < 1].max() == 0
    assert (np.diff(slipped) >= 0).all()
    assert 0.002 < slipped[-1] < 0.012
    np.testing.assert_allclose(slipped[t > 2], slipped[-1])


def test_power_damping_works_against_the_motion():
    q = 0.02 * np.sin(2 * np.pi * np.arange(0, 2, STEP))
    f = forces(laws.PowerDamping, on_tx(coefficient=50.0) | {"exponent": 2.0}, q)
    v = np.gradient(q, STEP)
    np.testing.assert_allclose(f, -50 * v * np.abs(v))


def test_backlash_passes_no_force_while_it_crosses_its_gap():
    k, w = 1000.0, 0.004
    q = np.concatenate([np.linspace(0, 0.02, 400), np.linspace(0.02, 0.013, 140)])
    values = on_tx(stiffness=k, half_width=w, knock=0.0)
    spring = k * q - forces(laws.Backlash, values, q)
    np.testing.assert_allclose(spring[:80], 0, atol=1e-9)
    np.testing.assert_allclose(spring[399:], k * 0.016, atol=1e-9)


def test_a_law_with_state_takes_no_other_trials():
    n = 3
    law = EffectLaw(
        *(np.zeros((n, 6)) for _ in range(4)),
        np.zeros(6),
        np.zeros(6),
        np.tile(np.eye(3), (n, 1, 1)),
        np.zeros((n, 3)),
        np.zeros((n, 3)),
    )
    assert law.take(np.arange(n)) is law
    with pytest.raises(ValueError, match="one duration"):
        law.take(np.array([1, 0, 2]))


# -------------------- the robot's side


STOPS = {"stiffness": [4e5] * 3 + [5e3] * 3, "damping": [2.0] * 6}


def swaying(duration=2.0):
    motion = Motion(duration, sines=[(1.3, 0.4, np.array([0.03, 0.02, 0.01, 0.05, 0.04, 0.06]))])
    rest = Rotation.from_euler("y", 0.15).as_matrix()
    robot = Robot(ROBOT, 1e-3)
    rotation, position = robot.rest_middle(np.zeros(6))
    pelvis = rotation @ rest.T
    home = np.array([-0.08, 0.0, -0.02])
    path = pelvis_path(motion, 0.0, pelvis, position - pelvis @ home, np.zeros(3), 0.0)
    stiffness = np.array([700.0, 2000, 3800, 39, 120, 15])
    damping = np.array([600.0, 130, 70, 1.3, 2.2, 7.2])
    hold = Controller(
        np.zeros(6), np.array([150.0, 300, 60, 400, 30, 30]), np.array([250.0, 400, 60, 60, 3, 3])
    )
    return Setup(path, rest, home, stiffness, damping, hold)


def test_added_mass_is_mass_of_the_interface_body(tmp_path):
    carried = replace(swaying(), added=np.array([2.0, 0.01, 0.02, 0.03]))
    heavier = tmp_path / "heavier.xml"
    text = ROBOT.read_text()
    own = 'mass="3" diaginertia="0.03 0.03 0.03"'
    assert own in text
    heavier.write_text(text.replace(own, 'mass="5" diaginertia="0.04 0.05 0.06"'))
    plain = swaying()
    one = run(Robot(ROBOT, 1e-3), [carried, plain], STOPS, 100.0)
    other = run(Robot(heavier, 1e-3), [plain], STOPS, 100.0)
    np.testing.assert_allclose(one[0].left, other[0].left, atol=1e-12)
    assert np.abs(one[0].left - one[1].left).max() > 1e-3


def test_terms_act_on_their_own_trials_alone():
    plain, slack = swaying(), swaying()
    slack.terms.append((laws.Slack, {"half_width": np.full(6, 0.005), "stiffness": slack.stiffness}))
    push = swaying()
    pulse = {
        "times": np.array([0.5]),
        "strength": np.array([50.0]),
        "width": 0.3,
        "direction": np.array([0.0, 1.0]),
    }
    push.terms.append((laws.Push, pulse))
    alone = run(Robot(ROBOT, 1e-3), [plain], STOPS, 100.0)[0]
    together = run(Robot(ROBOT, 1e-3), [slack, plain, push], STOPS, 100.0)
    np.testing.assert_allclose(together[1].left, alone.left, atol=1e-12)
    assert np.abs(together[0].left - alone.left).max() > 1e-3
    moved = np.abs(together[2].joints[:, 1] - alone.joints[:, 1])
    assert moved[:50].max() < 1e-12
    assert moved.max() > 5e-3


def test_tilt_pulls_with_the_weight_of_each_body():
    term = laws.Tilt(
        np.array([0]),
        STEP,
        [
            {
                "lean": np.array([0.01, 0.02, 0.0]),
                "masses": np.array([91.0, 6.0, 3.0]),
                "sway": 0.0,
                "frequency": 0.1,
                "phase": 0.0,
            }
        ],
    )
    from real2sim.verification.phantom.physics import Step

    nothing, bodies = np.zeros((1, 6)), np.zeros((1, 3, 3))
    term(Step(0.3, nothing, nothing, np.zeros((1, 3)), np.zeros((1, 3))), nothing, bodies)
    np.testing.assert_allclose(bodies[0].sum(axis=0), 9.81 * 100 * np.array([0.01, 0.02, 0.0]))


# -------------------- measurement


def test_replayed_path_is_the_recorded_one():
    setup = swaying()
    geometry = {
        "ASIS_L": np.array([0.0, 0.13, 0.0]),
        "ASIS_R": np.array([0.0, -0.13, 0.0]),
        "PSIS_L": np.array([-0.165, 0.045, 0.0]),
        "PSIS_R": np.array([-0.165, -0.045, 0.0]),
    }
    t = np.arange(200) / 100
    rotation, position = setup.path(t)[:2]
    markers = {name: position + rotation @ place for name, place in geometry.items()}
    replayed = measurement.replayed_path(markers, 100.0)
    inner = np.linspace(0.3, 1.7, 333)
    # the low-pass takes half a per mille of 1.3 Hz
    np.testing.assert_allclose(replayed(inner)[1], setup.path(inner)[1], atol=5e-5)
    np.testing.assert_allclose(replayed(inner)[2], setup.path(inner)[2], atol=1e-3)


def test_residual_is_the_cost_of_the_paper():
    t = np.arange(1200) / 100
    e = np.zeros((1200, 2, 3))
    e[:, 0, 0] = 0.01 * np.sin(2 * np.pi * t)
    r = measurement.residual(e, 100.0)
    position = 0.01**2 / 2 / 2 / 0.041**2
    velocity = (0.01 * 2 * np.pi) ** 2 / 2 / 2 / 0.080**2
    assert r @ r == pytest.approx(position + velocity, rel=5e-3)


def test_trials_differ_in_regime_and_start_quietly():
    suite = load("suite-ci")
    rng = np.random.default_rng(0)
    train = excitation.dynamic(suite, 12.0, rng, (1.0, 1.0))
    held = excitation.dynamic(suite, 12.0, rng, (0.6, 1.4))
    t = np.arange(0, 12, 0.01)
    for motion in (train, held):
        assert np.abs(motion(t[t <= 1.2])[0]).max() == 0
    spread = [motion(t)[0].std(axis=0) for motion in (train, held)]
    assert (spread[1] < 0.85 * spread[0]).all()
    shares = np.corrcoef(train(t[t > 1.5])[0].T)
    assert np.abs(shares - np.eye(6)).max() < 0.8


# -------------------- severity and files


def test_search_finds_the_severity_of_a_power_law():
    for power in (1.0, 2.0, 4.0):
        search = Search(0.2, 0.05)
        for _ in range(10):
            if search.done:
                break
            severity = search.ask()
            search.tell(severity, 30 * severity**power)
        assert search.done
        assert search.best[1] == pytest.approx(0.2, rel=0.06)


def test_search_takes_the_bound_where_it_cannot_reach_the_target():
    search = Search(1.0, 0.05)
    search.tell(search.ask(), 0.3)
    assert search.done
    assert search.best == (1.0, 0.3)


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    suite = load("suite-development")
    suite |= {"name": "test", "effects": ["slack", "sync_offset", "preload"], "seed": 5}
    suite["cases"] = dict.fromkeys(plan.STRATA, 0) | {"null": 1, "in_library": 3, "shared_axis": 1}
    suite["visibilities"] |= {"in_library": [0.2], "shared_axis": [0.2]}
    suite["trials"] |= {"dynamic_s": 7.0, "neutral_s": 4.5}
    # louder than what the robot does in a sway as hasty as so short a trial makes it
    suite["noise"]["log_low"] = 2e-4
    suite["severity"] |= {"step_s": 0.005, "candidates": 1, "refits": 1}
    settings = yaml.safe_load((ROOT / "config/phantom.yaml").read_text())
    settings["simulation"]["step_s"] = 0.002
    study = validated({}, "config", Path("none"))
    folder = tmp_path_factory.mktemp("suite")
    for again in ("a", "b"):
        write_cases(
            suite=suite,
            shard=0,
            settings=settings,
            controllers=study["robot"],
            robot=ROBOT,
            out=folder / again / "raw",
            truth=folder / again / "sealed.json",
        )
    return folder, suite, study


def test_the_gaps_asked_for_are_reached(written):
    folder, _, _ = written
    sealed = json.loads((folder / "a/sealed.json").read_text())
    with_effect = [case for case in sealed["cases"] if case["stratum"] == "in_library"]
    assert {case["effects"][0]["effect"] for case in with_effect} == {"slack", "sync_offset", "preload"}
    for case in with_effect:
        assert case["visibility"]["target"] == 0.2
        assert case["visibility"]["predicted"] == pytest.approx(0.2, rel=0.15)
        assert 0 < case["effects"][0]["severity"] <= 1
        assert set(case["regimes"]) == {
            f"{a} amplitude, {v}" for a in ("large", "small") for v in ("fast", "slow")
        }
        assert sum(case["regimes"].values()) == pytest.approx(1)


def test_a_pair_on_one_axis_is_on_one_axis(written):
    folder, _, _ = written
    sealed = json.loads((folder / "a/sealed.json").read_text())
    (pair,) = (case for case in sealed["cases"] if case["stratum"] == "shared_axis")
    one, other = pair["effects"]
    assert {one["effect"], other["effect"]} == {"slack", "preload"}
    assert one["axes"] == other["axes"]
    assert len(one["axes"]) == 1


def test_pairs_on_one_axis_are_those_of_laws_along_one_axis():
    suite = load("suite-standard")
    suite["cases"] = dict.fromkeys(plan.STRATA, 0) | {"shared_axis": 40}
    pairs = [case.forms for case in plan.cases(suite)]
    assert {name for forms in pairs for name in forms} == set(plan.OF_ONE_AXIS)
    assert not any(set(forms) <= set(group) for forms in pairs for group in plan.GROUPS)


def test_regimes_part_a_gap_by_amplitude_and_speed():
    n = 400
    t = np.arange(n) / 100
    q = np.zeros((n, 6))
    # the first half slow, the second fast; each has small and large excursions
    q[:, 0] = np.where(t < 2, np.sin(np.pi * t / 2), np.sin(8 * np.pi * t))
    paths = SimpleNamespace(q=q, qd=np.gradient(q, 0.01, axis=0))
    error = np.zeros((n, 2, 3))
    where = (t < 2) & (np.abs(q[:, 0]) > 0.9)
    error[where, 0, 0] = 0.01
    left = np.concatenate([error.ravel(), np.zeros(6 * (n - 2))])
    shares = regimes(left, paths, paths)
    assert sum(shares.values()) == pytest.approx(1)
    assert shares["large amplitude, slow"] > 0.9


def test_files_are_those_planned_the_same_twice_and_can_be_ingested(written, tmp_path):
    folder, suite, study = written
    names = plan.case_names(suite, 0)
    assert sorted(p.name for p in (folder / "a/raw").iterdir()) == names
    for path in sorted((folder / "a").rglob("*")):
        if path.is_file():
            assert path.read_bytes() == (folder / "b" / path.relative_to(folder / "a")).read_bytes()
    for name in names:
        ingest_subject(
            subject=name,
            folder=folder / "a/raw" / name,
            settings=study["ingest"],
            raw=[],
            out=tmp_path / name,
        )
        assert (tmp_path / name / "dynamic_2" / "pose.parquet").exists()


def _evidence(written, folder: Path, limits: Path | None = None) -> StrapEvidence:
    """Evidence of the first person's first dynamic trial, ingested into ``folder``."""
    source, suite, study = written
    name = plan.case_names(suite, 0)[0]
    ingest_subject(
        subject=name, folder=source / "a/raw" / name, settings=study["ingest"], raw=[], out=folder / name
    )
    neutral = folder / name / "neutral"
    return load_evidence(
        folder=folder / name / "dynamic_1",
        neutral=neutral,
        limits=limits,
        robot=ROBOT,
        settings=study | {"plant": study["plant"] | {"timestep_s": 0.01}},
        noise=NoiseModel.measure(neutral, study["ingest"], study["diagnosis"]["noise"]),
    )


def test_a_simulation_has_no_stop_where_its_recording_is_beyond_the_limit(written, tmp_path):
    limits = tmp_path / "limits.json"
    # who moves at all is above this limit along y half of the time
    write_json(limits, {"q_min": [-0.5] * 6, "q_max": [0.5, 0.0, 0.5, 0.5, 0.5, 0.5]})
    evidence = _evidence(written, tmp_path, limits)
    assert evidence.recorded.crossed == ("ty upper",)
    left = evidence.setup.limits
    assert left.upper[1] > 1.0
    np.testing.assert_array_equal(np.delete(left.upper, 1), 0.5)
    np.testing.assert_array_equal(left.lower, -0.5)


def test_imagined_trials_are_those_of_the_plain_strap_and_no_larger_than_a_person_can(written, tmp_path):
    evidence = _evidence(written, tmp_path)
    lower, upper = evidence.setup.system.bounds()
    parameters = evidence.setup.system.values((lower + upper) / 2)
    large = np.percentile(np.abs(_moved(evidence)), 95, axis=0)
    found = list(motions(evidence, ["ty", "rz"]))
    assert len(found) == 7
    for motion in found:
        assert not motion.path[: evidence.context.start].any()
        assert np.all(np.abs(motion.path).max(axis=0) <= 1.5001 * np.maximum(large, 0.03))
    new = imagined(evidence, found[0], parameters)
    paths, joints = new.replay([], 1).run_effects(parameters[None], [])
    assert np.abs(new.raw(paths, joints)).max() < 1e-9
    # it begins where the recorded one does, and moves along the axis that was asked for
    np.testing.assert_allclose(new.trial.interface[0].mean(axis=0), evidence.trial.start_position, atol=1e-3)
    moved = np.ptp(new.trial.pelvis_position @ evidence.context.pelvis_rotation[0], axis=0)
    assert moved[1] > 5 * moved[0]
    _check_injection(evidence, parameters)


def _check_injection(evidence: StrapEvidence, parameters: np.ndarray) -> None:
    """What an effect changes is added to what was measured: a fit with it leaves what one without it left before."""
    friction = next(e for e in EFFECTS if e.name == "coulomb")
    evidence = evidence.adapted(parameters)
    placed = Placed(friction, friction.places(evidence.setup.system)[1], evidence.scales)
    x = placed.starts()[0]
    with_it = injected(evidence, placed, x, parameters)
    before = evidence.raw(*evidence.replay([], 1).run_effects(parameters[None], []))
    after = with_it.raw(*with_it.replay([placed], 1).run_effects(parameters[None], [x[None]]))
    plain = with_it.raw(*with_it.replay([], 1).run_effects(parameters[None], []))
    scale = np.nanmax(np.abs(plain - before))
    assert scale > 1e-5
    # the force of friction is planned from nothing that was measured, so that only rounding is left
    np.testing.assert_allclose(after, before, atol=1e-6 + 0.02 * scale)


def test_the_robots_log_is_as_noisy_as_the_truth_says(written, tmp_path):
    """The first suites had logs of 3 um, and a diagnosis that took logs as exact was never found out."""
    folder, _, study = written
    cases = json.loads((folder / "a/sealed.json").read_text())["cases"]
    for case in cases:
        source = folder / "a/raw" / case["id"]
        ingest_subject(
            subject=case["id"], folder=source, settings=study["ingest"], raw=[], out=tmp_path / case["id"]
        )
        log = tmp_path / case["id"] / "neutral" / "robot.parquet"
        truth = case["log_noise"]
        expected = [truth["m"], truth["m"], truth["rad"], truth["m"], truth["rad"], truth["rad"]]
        found = robot_noise(log, log, Bands.from_settings(study["ingest"], study["diagnosis"]["noise"]))
        # some seconds tell a variance to a quarter, and an arm that swings is no noise
        assert np.median(found / np.hypot(expected, 1e-5 / np.sqrt(12))) == pytest.approx(1, rel=0.25)
    assert len({case["log_noise"]["m"] for case in cases}) == len(cases)


def test_slow_noise_lies_beside_the_white_one_and_forgets():
    person = SimpleNamespace(marker_noise_m=1e-3, slow_noise=0.8, slow_noise_s=0.3)
    noise = Person.marker_noise(person, np.random.default_rng(0), (40_000, 3), 100)
    np.testing.assert_allclose(noise.std(axis=0), 1e-3 * np.hypot(1, 0.8), rtol=0.05)
    ahead = 30  # samples: the time over which it forgets
    shared = np.mean(noise[ahead:] * noise[:-ahead])
    assert shared == pytest.approx((0.8e-3) ** 2 / np.e, rel=0.2)
    person.slow_noise = 0.0
    white = Person.marker_noise(person, np.random.default_rng(0), (100, 3), 100)
    np.testing.assert_array_equal(white, 1e-3 * np.random.default_rng(0).standard_normal((100, 3)))


def test_people_of_a_suite_do_not_stand_still_about_their_pose_of_rest():
    settings = yaml.safe_load((ROOT / "config/phantom.yaml").read_text())
    far = {}
    for whole in (True, False):
        settings["effects"]["neutral_sway"]["whole_cycles"] = whole
        motions = [tasks.neutral(settings, np.random.default_rng(seed)) for seed in range(10)]
        t = np.linspace(0, motions[0].duration_s, 2000)
        far[whole] = np.mean([np.abs(motion(t)[0][:, :2].mean(axis=0)) for motion in motions])
    assert far[False] > 2 * far[True]
    assert far[False] > 1e-4


def test_no_file_of_a_case_tells_its_cause(written):
    folder, _, _ = written
    for path in (folder / "a/raw").rglob("*"):
        if path.suffix in (".tsv", ".mot", ".yaml"):
            text = path.read_text()
            assert not any(f"{name}" in text for name in ("slack", "sync_offset", "severity"))


def test_nothing_of_the_library_imports_the_room_of_proofs():
    library = ROOT / "workflow" / "real2sim"
    for path in library.rglob("*.py"):
        if "verification" not in path.relative_to(library).parts:
            lines = [line.lstrip() for line in path.read_text().splitlines()]
            imports = [line for line in lines if line.startswith(("import real2sim", "from real2sim"))]
            assert not any("real2sim.verification" in line for line in imports), path


@pytest.mark.parametrize("settled", [False, True])
def test_slopes_by_planned_forces_are_those_of_replays_for_a_robot_in_balance_too(written, tmp_path, settled):
    evidence = _evidence(written, tmp_path)
    evidence = evidence.as_settled() if settled else evidence
    system = evidence.setup.system
    library = Library(Pair(evidence, evidence.as_held_out(), system), 1.0)
    terms = [t for t in library.terms.values() if t.joint in ("strap_tx", "strap_ry")][:8]
    # constant forces, which a robot in balance has taken up: on its own joint wholly
    terms += [t for t in library.terms.values() if t.name == "constant" and t not in terms]
    placed = library.columns_effect(terms)
    parameters = system.values(sum(system.bounds()) / 2)[None]
    replay = evidence.replay([placed], 1)
    unit, step = np.eye(len(terms)), 0.02

    def shown(row: np.ndarray) -> np.ndarray:
        paths, joints = replay.run_effects(parameters, [row[None]])
        return np.hstack([paths[0].reshape(len(paths[0]), -1), joints[0]])

    by_replays = [(shown(step * row) - shown(-step * row)) / (2 * step) for row in unit]
    usual = np.median([np.linalg.norm(slope) for slope in by_replays])
    shown(0 * unit[0])
    linear = replay.linearised()
    nothing = InterfaceImpedance(np.empty((0, 0)), np.empty((0, 0)))
    forces = placed.effect.plant.force(unit, evidence.context, placed.where, nothing)
    moved, turned = replay.response(linear, 0, forces)
    for wanted, path, joints in zip(by_replays, moved, turned, strict=True):
        found = np.hstack([path.reshape(len(path), -1), joints])
        assert np.linalg.norm(found - wanted) < 0.06 * np.linalg.norm(wanted) + 1e-3 * usual
