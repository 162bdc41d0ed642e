"""The phantom: its wrench law against closed forms, its plan, its determinism, its truth."""

from __future__ import annotations

import copy
import json
from pathlib import Path

import jsonschema
import numpy as np
import pytest
import yaml
from mcap.reader import make_reader
from real2sim.recording.formats.qualisys import read_markers
from real2sim.recording.formats.robot_log import read_log
from real2sim.recording.subjects import SYNTHETIC_NOTICE, discover, read_subject
from real2sim.verification.cohort import plan
from real2sim.verification.cohort import write as cohort
from real2sim.verification.phantom import exports
from real2sim.verification.phantom.motions import Motion, pelvis_path
from real2sim.verification.phantom.person import PARAMETER_NAMES, draw_person
from real2sim.verification.phantom.physics import StrapLaw, strap_wrench
from real2sim.verification.phantom.tasks import dynamic, motion_of
from scipy.spatial.transform import Rotation

ROOT = Path(__file__).parents[2]
ROBOT = ROOT / "resources/robot/drba.xml"
CONTROLLERS = {
    "hold": {
        "x": {"stiffness": 150, "damping": 250},
        "y": {"stiffness": 300, "damping": 400},
        "yaw": {"stiffness": 60, "damping": 60},
    },
    "arm": {
        "lift": {"stiffness": 400, "damping": 60},
        "roll": {"stiffness": 30, "damping": 3},
        "pitch": {"stiffness": 30, "damping": 3},
    },
}


@pytest.fixture
def settings():
    return yaml.safe_load((ROOT / "config/phantom.yaml").read_text())


def small(settings):
    """One person, two levels, short trials: all kinds of files in a second."""
    settings = copy.deepcopy(settings)
    settings["cohort"] = {"S01": settings["cohort"]["S01"]}
    settings["cohort"]["S01"]["tightness"] = {
        "loosest_cm": 9,
        "tightest_cm": 10,
        "safe_comfortable_cm": 10,
    }
    settings["trials"] |= {"neutral_s": 5.0, "sweep_s": 3.0, "dynamic_s": 8.0, "walk_s": 4.0}
    settings["trials"] |= {"dynamic_trials": 1, "walk_robot_trials": 1}
    return settings


# -------------------- wrench law


def law(n, rng=None, bound=np.inf):
    k = np.array([700.0, 2000, 3800, 39, 120, 15])
    d = np.array([600.0, 130, 70, 1.3, 2.2, 7.2])
    rest = np.eye(3) if rng is None else Rotation.random(rng=rng).as_matrix()
    return StrapLaw(
        np.tile(k, (n, 1)),
        np.tile(d, (n, 1)),
        np.full((n, 6), -bound),
        np.full((n, 6), bound),
        np.full(6, 1e4),
        np.full(6, 2.0),
        np.tile(rest, (n, 1, 1)),
        np.tile(np.array([-0.08, 0.0, 0.02]), (n, 1)),
        np.zeros((n, 3)),
    )


def still(rotation, position):
    zero = np.zeros((1, 3))
    return rotation[None], position[None], zero, zero


def test_pure_translation_gives_the_spring_force_in_pelvis_axes():
    strap, turn = law(1), Rotation.from_euler("z", 30, degrees=True).as_matrix()
    shift = np.array([0.01, -0.02, 0.03])
    there = turn @ (strap.rest_position[0] + shift)
    force, torque, q, _ = strap_wrench(strap, still(turn, np.zeros(3)), still(turn, there))
    np.testing.assert_allclose(q[0], [*shift, 0, 0, 0], atol=1e-12)
    np.testing.assert_allclose(force[0], -turn @ (strap.stiffness[0, :3] * shift))
    np.testing.assert_allclose(torque[0], 0, atol=1e-12)


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_pure_rotation_gives_the_spring_torque_about_that_axis(axis):
    strap, angle = law(1), 0.3
    turn = Rotation.from_rotvec(angle * np.eye(3)[axis]).as_matrix()
    force, torque, q, _ = strap_wrench(
        strap, still(np.eye(3), np.zeros(3)), still(turn, strap.rest_position[0])
    )
    expected = np.zeros(3)
    expected[axis] = -strap.stiffness[0, 3 + axis] * angle
    np.testing.assert_allclose(q[0], [0, 0, 0, *(angle * np.eye(3)[axis])], atol=1e-12)
    np.testing.assert_allclose(torque[0], expected, atol=1e-10)
    np.testing.assert_allclose(force[0], 0, atol=1e-10)


def random_states(n, rng, fixed_pelvis):
    def body(spread):
        rotation = Rotation.from_euler("xyz", rng.uniform(-spread, spread, (n, 3))).as_matrix()
        return [rotation, *(0.1 * rng.standard_normal((n, 3)) for _ in range(3))]

    pelvis, interface = body(0.4), body(0.4)
    if fixed_pelvis:
        pelvis[2:] = [np.zeros((n, 3))] * 2
    return tuple(pelvis), tuple(interface)


def test_power_balances_for_a_fixed_pelvis():
    rng = np.random.default_rng(3)
    strap = law(200, rng, bound=0.05)
    strap.rest_rotation[:] = Rotation.from_euler("y", -0.15).as_matrix()
    pelvis, interface = random_states(200, rng, fixed_pelvis=True)
    force, torque, q, qd = strap_wrench(strap, pelvis, interface)
    power = np.sum(force * interface[2] + torque * interface[3], axis=1)
    np.testing.assert_allclose(power, np.sum(strap.generalised_force(q, qd) * qd, axis=1), atol=1e-9)


def test_rates_are_derivatives_of_the_coordinates():
    rng, h = np.random.default_rng(4), 1e-6
    strap = law(50)
    pelvis, interface = random_states(50, rng, fixed_pelvis=False)

    def moved(body, t):
        rotation, position, velocity, omega = body
        return (
            Rotation.from_rotvec(omega * t).as_matrix() @ rotation,
            position + velocity * t,
            velocity,
            omega,
        )

    q = [strap_wrench(strap, moved(pelvis, t), moved(interface, t))[2] for t in (-h, h)]
    qd = strap_wrench(strap, pelvis, interface)[3]
    np.testing.assert_allclose((q[1] - q[0]) / (2 * h), qd, atol=1e-7)


def test_stops_push_and_never_pull():
    strap = law(1, bound=0.01)
    q, leaving = np.array([[0.02, 0, 0, 0, 0, 0]]), np.array([[-5.0, 0, 0, 0, 0, 0]])
    free = -(strap.stiffness * q + strap.damping * leaving)
    np.testing.assert_allclose(strap.generalised_force(q, leaving), free)
    rest = strap.generalised_force(q, 0 * leaving)[0, 0]
    assert rest == pytest.approx(-strap.stiffness[0, 0] * 0.02 - 1e4 * 0.01)


# -------------------- pelvis paths


def test_pelvis_velocities_are_derivatives_of_its_pose(settings):
    motion = dynamic(settings, np.random.default_rng(0))
    rest = Rotation.from_euler("y", 0.15).as_matrix()
    path = pelvis_path(motion, 0.1, rest, np.array([0.1, 0, 1.0]), np.array([-0.07, 0, -0.06]), 0.0)
    t, h = np.linspace(1.5, 28, 400), 1e-5
    before, here, after = path(t - h), path(t), path(t + h)
    np.testing.assert_allclose((after[1] - before[1]) / (2 * h), here[2], atol=1e-8)
    turned = Rotation.from_matrix(after[0]) * Rotation.from_matrix(before[0]).inv()
    np.testing.assert_allclose(turned.as_rotvec() / (2 * h), here[3], atol=1e-8)
    np.testing.assert_allclose(path(np.array([0.0, 0.9]))[2], 0, atol=1e-12)


# -------------------- plan and settings


def test_settings_fit_their_schema_and_every_key_is_described(settings):
    schema = yaml.safe_load((ROOT / "workflow/real2sim/schemas/phantom.schema.yaml").read_text())
    jsonschema.validate(settings, schema)

    def walk(node):
        for name, child in node.get("properties", {}).items():
            assert "description" in child, name
            walk(child)
        if "properties" in node:
            assert node["additionalProperties"] is False

    for node in (schema, *schema["$defs"].values()):
        walk(node)


def test_cohort_has_the_published_anthropometrics(settings):
    people = list(settings["cohort"].values())
    for key, mean, sd, unit in (
        ("mass_kg", 82.7, 10.4, 1),
        ("height_m", 174.7, 4.2, 100),
        ("waist_m", 92.3, 10.2, 100),
    ):
        values = unit * np.array([p[key] for p in people])
        assert values.mean() == pytest.approx(mean, abs=0.06)
        assert values.std(ddof=1) == pytest.approx(sd, abs=0.06)
    ages = [p["age_years"] for p in people]
    assert (min(ages), max(ages)) == (21, 40)
    assert sum(p["cohort"] == "calibration" for p in people) == 5
    for name in settings["cohort"]:
        assert 8 <= len(plan.tightness_levels(settings["cohort"][name])) <= 10


def test_parameters_lie_inside_the_bounds_and_only_the_uncertain_ones_differ(settings):
    drawn = {name: draw_person(settings, name, 0.95).parameters for name in settings["cohort"]}
    for parameter in PARAMETER_NAMES:
        p = settings["parameters"]["values"][parameter]
        values = [person[parameter] for person in drawn.values()]
        assert all(p["low"] < v < p["high"] for v in values)
        differs = parameter in ("d_tx", "k_ty", "d_rx", "k_ry", "d_rz")
        assert (len(set(values)) == len(values)) if differs else set(values) == {p["prior"]}


def test_yaw_stops_have_a_knee_at_the_operating_level(settings):
    settings["effects"]["enabled"] = False
    person = draw_person(settings, "S01", 0.95)
    yaw = {level: np.degrees(high[5]) for level, (_, high) in person.stops.items()}
    slopes = {level: yaw[level] - yaw[level + 1] for level in list(yaw)[:-1]}
    for level, slope in slopes.items():
        law = settings["stops"]
        before = level < person.operating_level
        assert slope == pytest.approx(
            law["yaw_slope_deg_per_cm"] if before else law["yaw_plateau_deg_per_cm"]
        )


# -------------------- whole people


def write(settings, folder):
    out = plan.planned_files(settings, folder / "raw", "S01")
    truth = folder / "sealed" / "S01.json"
    cohort.write_subject(
        subject="S01", settings=settings, controllers=CONTROLLERS, robot=ROBOT, out=out, truth=truth
    )
    return out, truth


def test_writes_exactly_what_is_planned_twice_the_same(settings, tmp_path):
    settings = small(settings)
    out, truth = write(settings, tmp_path / "a")
    again, truth_again = write(settings, tmp_path / "b")
    assert sorted(out) == sorted(p for p in (tmp_path / "a/raw/S01").iterdir())
    for one, two in zip([*out, truth], [*again, truth_again], strict=True):
        assert one.read_bytes() == two.read_bytes(), one.name
    planned = plan.planned_subjects(settings, tmp_path / "a/raw")
    found = discover(tmp_path / "a/raw")
    assert found["S01"].trials == planned["S01"].trials
    assert found["S01"].tightness == planned["S01"].tightness
    sealed = json.loads(truth.read_text())
    assert sealed["phantom"] is True
    assert list(sealed["parameters"]) == list(PARAMETER_NAMES)
    assert "PHANTOM" in (tmp_path / "a/raw/S01/neutral.tsv").read_text().splitlines()[6]
    assert "PHANTOM" in (tmp_path / "a/raw/S01/neutral.mot").read_text().splitlines()[0]
    with (tmp_path / "a/raw/S01/dynamic_1.mcap").open("rb") as stream:
        assert [r.metadata for r in make_reader(stream).iter_metadata()] == [{"notice": SYNTHETIC_NOTICE}]
    log = read_log(tmp_path / "a/raw/S01/dynamic_1.mcap")
    assert log.sync_s == pytest.approx([-sealed["trials"]["dynamic_1"]["clocks"]["robot_start_s"]])
    # whoever copies the recordings beside a subject.yaml of their own is told by the recordings
    about = tmp_path / "a/raw/S01/subject.yaml"
    about.write_text(about.read_text().replace("phantom: true\n", ""))
    assert "phantom:" not in about.read_text()
    assert read_subject(about.parent).phantom


def test_refuses_files_that_are_not_planned(settings, tmp_path):
    with pytest.raises(ValueError, match="not those planned"):
        cohort.write_subject(
            subject="S01",
            settings=small(settings),
            controllers=CONTROLLERS,
            robot=ROBOT,
            out=[tmp_path / "S01/subject.yaml"],
            truth=tmp_path / "t.json",
        )


def test_markers_without_noise_and_effects_are_the_true_ones(settings, tmp_path):
    settings = small(settings)
    settings["effects"]["enabled"] = settings["measurement"]["enabled"] = False
    done = cohort.simulate_subject(settings, CONTROLLERS, ROBOT, "S01")
    person, trial = done.person, next(t for t in done.trials if t.name == "dynamic_1")
    truth = trial.truth
    exports.write_trial_markers(tmp_path / "dynamic_1.tsv", settings, person, trial)
    seen = read_markers(tmp_path / "dynamic_1.tsv")
    n = len(seen.time_s)
    np.testing.assert_allclose(seen.positions["IF_L"], truth.left[:n], atol=6e-7)
    middle = (seen.positions["ASIS_L"] + seen.positions["ASIS_R"]) / 2
    np.testing.assert_allclose(middle, truth.pelvis_position[:n], atol=6e-7)


def test_dynamic_motion_stays_inside_the_slack_and_inside_the_limits_reached(settings):
    settings["trials"] |= {"walk_robot_trials": 0}
    facts = settings["cohort"]["S03"]["tightness"]
    facts["loosest_cm"] = facts["tightest_cm"] = facts["safe_comfortable_cm"]
    done = cohort.simulate_subject(settings, CONTROLLERS, ROBOT, "S03")
    person = done.person
    q = {t.name: t.truth.q for t in done.trials if t.truth is not None}
    lower, upper = person.stops[person.operating_level]
    moved = np.vstack([q["dynamic_1"], q["dynamic_2"]])
    assert (moved > lower).all()
    assert (moved < upper).all()
    swept = np.vstack([values for name, values in q.items() if "_T" in name])
    assert (swept.min(axis=0) < 1.15 * moved.min(axis=0)).all()
    assert (swept.max(axis=0) > 1.15 * moved.max(axis=0)).all()
    assert not np.allclose(q["dynamic_1"], q["dynamic_2"], atol=1e-3)


def test_halving_the_step_changes_nothing_that_can_be_seen(settings):
    person = draw_person(settings, "S04", 0.95)
    settings["trials"]["dynamic_s"] = 9.0
    motion = motion_of(settings, person, "dynamic_1")
    runs = []
    for step in (5e-4, 2.5e-4):
        settings["simulation"]["step_s"] = step
        runs.append(
            cohort.simulate_trial(
                robot=ROBOT,
                settings=settings,
                controllers=CONTROLLERS,
                parameters=person.parameters,
                motion=motion,
                rest_rotation=person.rest_rotation,
                rest_position=person.rest_position,
            )
        )
    assert np.abs(runs[0].left - runs[1].left).max() < 5e-6
    assert np.ptp(runs[0].left, axis=0).max() > 0.02


def test_a_still_person_and_robot_stay_still(settings):
    person = draw_person(settings, "S01", 0.95)
    done = cohort.simulate_trial(
        robot=ROBOT,
        settings=settings,
        controllers=CONTROLLERS,
        parameters=person.parameters,
        motion=Motion(1.0),
        rest_rotation=person.rest_rotation,
        rest_position=person.rest_position,
        start=np.array([0.1, -0.05, 0.04, 0, 0, 0]),
    )
    assert np.abs(done.q).max() < 1e-9
    assert np.abs(done.force).max() < 1e-6
