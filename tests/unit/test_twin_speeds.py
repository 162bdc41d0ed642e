"""A twin that knows its speed: gaits at other speeds, people in training who mean to walk at them, and aware walks."""

from __future__ import annotations

import copy
from functools import cache
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from real2sim.errors import InputError
from real2sim.geometry import interface_coordinates, relative_pose
from real2sim.study.twin.coupled import (
    Condition,
    CoupledWalk,
    height_of_reference,
    standing_interface,
    walking_interface,
)
from real2sim.study.twin.env import ACTIONS, OBSERVATIONS, WalkEnv, rotations
from real2sim.study.twin.evaluate import keeps_speeds, speeds_of, walkers_at_speeds
from real2sim.study.twin.gait import Reference, scaled_curves, with_speeds
from real2sim.study.twin.policy import Policy, load_policy, save_policy
from real2sim.study.twin.ppo import init_layers
from real2sim.study.twin.reference import cadence_exponent
from real2sim.study.twin.stage import bar_rows, load_walker, vertical_stretch
from real2sim.study.twin.study_robot import StudyRobot
from real2sim.study.twin.train import Trainer

from tests.unit.test_twin_coupled import LIMITS, PRIOR, REST, STUDY, STUDY_ROBOT
from tests.unit.walking_person import WHO, measured_curves, reference, twin_settings

PHASE = np.linspace(0, 1, 7)[:-1]


@cache
def adaptable() -> Reference:
    """The reference of `WHO` at three speeds, cadence going with the root of speed."""
    settings = copy.deepcopy(twin_settings())
    settings["reference"]["speeds"]["shares"] = [0.7, 1.1]
    return with_speeds(reference(), WHO, settings["human"], settings["reference"], 0.5)


def _policy(gait: Reference) -> Policy:
    layers = init_layers([OBSERVATIONS, 8, ACTIONS], 0.0, np.random.default_rng(0))
    return Policy(layers, np.zeros(OBSERVATIONS), np.ones(OBSERVATIONS), gait, WHO)


def test_gaits_at_other_speeds_are_ordered_and_hold_the_own_one():
    gait = adaptable()
    shares = gait.speeds.shares
    assert np.all(np.diff(shares) > 0.05)
    assert 1.0 in shares
    # nearly as asked for: what can be walked decides
    assert shares[[0, -1]] == pytest.approx([0.7, 1.1], abs=0.02)
    for one, other in zip(gait.at(PHASE), gait.at(PHASE, np.ones(6)), strict=True):
        np.testing.assert_allclose(one, other, atol=1e-12)
    np.testing.assert_allclose(gait.speed_at(shares), gait.speed * shares)
    # steps and cadence share what speed does
    assert gait.stride_at(shares)[0] == pytest.approx(1.2 * 0.7**-0.5)
    ranges = [row["range_of_motion_deg"]["hip_flexion"] for row in gait.report["speeds"]]
    assert ranges == sorted(ranges)
    # forward speed of the pelvis over a cycle is that of the share
    forward = [gait.at(np.arange(48) / 48, np.full(48, s))[1][:, 0].mean() for s in shares]
    np.testing.assert_allclose(forward, gait.speed * shares, rtol=0.01)


def test_between_and_beyond_the_known_speeds():
    gait = adaptable()
    low, high = gait.speeds.shares[0], 1.0
    between = gait.at(PHASE, np.full(6, (low + high) / 2))[1]
    ends = [gait.at(PHASE, np.full(6, s))[1] for s in (low, high)]
    np.testing.assert_allclose(between, (ends[0] + ends[1]) / 2, atol=1e-9)
    np.testing.assert_allclose(gait.at(PHASE, np.full(6, 0.2))[1], ends[0])
    assert gait.speed_at(np.array([0.2]))[0] == pytest.approx(gait.speed * low)
    plain = reference()
    assert plain.stride_at(np.full(3, 0.7)) == plain.stride_s


def test_shorter_steps_scale_joints_as_published():
    measured = measured_curves()
    settings = twin_settings()["reference"]["speeds"]
    scaled = scaled_curves(measured, 36.7 / 42.5, settings)
    ranges = {"hip_flexion": 36.7 / 42.5, "knee_angle": 51.6 / 55.1, "ankle_angle": 27.3 / 31.6}
    for name, published in ranges.items():
        assert np.ptp(scaled[name]) / np.ptp(measured[name]) == pytest.approx(published, abs=0.002)
    assert scaled["hip_flexion"].mean() == pytest.approx(measured["hip_flexion"].mean())
    shorter = (36.7 / 42.5) ** 2
    assert np.ptp(scaled["pelvis_ty"]) == pytest.approx(shorter * np.ptp(measured["pelvis_ty"]))


def test_cadence_at_other_speeds_is_the_persons_own_where_it_was_recorded():
    def walks(speed: float, stride_s: float) -> list:
        return [SimpleNamespace(speed=speed, stride_s=stride_s)]

    settings = twin_settings()["reference"]["speeds"]
    normal = walks(1.1, 1.2)
    assert cadence_exponent(normal, walks(0.88, 1.2), settings) == 0
    assert cadence_exponent(normal, walks(0.88, 1.2 / 0.8**0.5), settings) == pytest.approx(0.5)
    published = settings["cadence_exponent"]
    for assisted, options in (
        ([], settings),
        (walks(1.08, 1.3), settings),
        (walks(0.88, 1.2), {**settings, "cadence_from": "published"}),
    ):
        assert cadence_exponent(normal, assisted, options) == published


def test_speeds_survive_a_file(tmp_path):
    save_policy(tmp_path / "policy.npz", _policy(adaptable()))
    read = load_policy(tmp_path / "policy.npz").reference
    np.testing.assert_allclose(read.speeds.table, adaptable().speeds.table, rtol=1e-6, atol=1e-5)
    np.testing.assert_array_equal(read.speeds.shares, adaptable().speeds.shares)
    save_policy(tmp_path / "one.npz", _policy(reference()))
    assert load_policy(tmp_path / "one.npz").reference.speeds is None


def _env(n: int, gait: Reference) -> WalkEnv:
    settings = twin_settings()
    return WalkEnv(WHO, settings["human"], gait, settings["training"], nsim=n, threads=1, seed=1)


def test_a_strap_is_as_high_as_the_pelvis_at_the_held_speed():
    env, hold = _env(60, adaptable()), twin_settings()["training"]["hold"]
    env.hold(hold | {"share": 0.6, "stops": hold["stops"] | {"share": 0.0}, "speed": [0.7, 1.0]})
    held, shares = env._held, env._held_share
    own, slowest = env.reference.height_at(1.0), env.reference.height_at(np.array([0.7]))[0]
    assert slowest > own + 0.003, "whoever walks slower takes shorter steps and is higher"
    np.testing.assert_allclose(env._strap_height[~held], own)
    np.testing.assert_allclose(env._strap_height[held], env.reference.height_at(shares[held]))
    assert np.ptp(env._strap_height[held]) > 0.5 * (slowest - own)


def test_people_in_training_mean_to_walk_at_speeds_of_their_own():
    settings = twin_settings()["training"]
    env = _env(400, adaptable())
    env.hold(settings["hold"])
    env.vary(settings["speeds"])
    env.reset(np.arange(400))
    # as far as the gaits are known
    low, high = np.clip(settings["speeds"]["range"], *adaptable().speeds.shares[[0, -1]])
    assert env.share.min() >= low
    assert env.share.max() <= high
    assert 0.3 < np.mean(env.share == 1.0) < 0.6
    changing = env.share_goal != env.share
    assert 0.1 < changing.mean() < 0.35
    # whoever knows the speed of what holds them means to be little faster
    held = np.isfinite(env._held_share)
    ratio = env.share[held] / env._held_share[held]
    assert np.mean((ratio >= 0.979) & (ratio <= 1.061)) > 0.45
    assert env.observation()[:, 15] == pytest.approx(env.share)
    before = env.share.copy()
    env.step(np.zeros((400, ACTIONS)))
    moved = np.abs(env.share - before)
    assert moved.max() == pytest.approx(settings["speeds"]["rate_per_s"] * env.control_s)
    assert not moved[~changing].any()


def test_one_speed_alone_cannot_vary_or_be_aware():
    with pytest.raises(ValueError, match="one speed"):
        _env(2, reference()).vary(twin_settings()["training"]["speeds"])
    with pytest.raises(ValueError, match="one speed"):
        _walk(reference(), [Condition("prior", PRIOR, 0.8, (), True)])


def test_an_aware_walk_of_a_policy_of_one_speed_is_refused_by_name(tmp_path):
    coupled, path = twin_settings()["coupled"], tmp_path / "policy.npz"
    save_policy(path, _policy(adaptable()))
    assert load_walker(path, coupled).reference.speeds is not None
    save_policy(path, _policy(reference()))
    load_walker(path, {**coupled, "gaits": ["fixed"]})
    with pytest.raises(InputError, match=r"(?s)policy.npz.*twin.coupled.gaits.*twin.reference.speeds.shares"):
        load_walker(path, coupled)


def test_speeds_that_are_the_same_are_refused_by_name():
    settings = copy.deepcopy(twin_settings())
    settings["reference"]["speeds"]["shares"] = [1.0]
    with pytest.raises(InputError, match=r"twin\.reference\.speeds\.shares"):
        with_speeds(reference(), WHO, settings["human"], settings["reference"], 0.5)


def test_a_walker_is_also_examined_at_the_speeds_of_robots():
    settings = {**twin_settings()["evaluation"], "walkers": 5, "shares": [0.7, 0.9]}
    settings |= {"walk_s": 0.9, "settle_s": 0.3}
    assert walkers_at_speeds(settings) == 4
    twin = twin_settings()
    env = WalkEnv(WHO, twin["human"], adaptable(), twin["training"], nsim=4, threads=1, seed=0)
    found = speeds_of(env, lambda obs: np.zeros((len(obs), ACTIONS)), settings)
    np.testing.assert_array_equal(env.share, [0.7, 0.7, 0.9, 0.9])
    assert [row["share"] for row in found] == [0.7, 0.9]
    # before anybody falls they go as fast as they start
    for row in found:
        assert row["falls"] == 0
        assert row["speed_m_per_s"] == pytest.approx(row["share"] * env.reference.speed, rel=0.2)
        assert row["speed_error"] == pytest.approx(
            row["speed_m_per_s"] / (row["share"] * env.reference.speed) - 1
        )
    bars = twin_settings()["acceptance"]
    good = {"share": 0.7, "falls": 0, "speed_m_per_s": 0.7, "speed_error": -0.049}
    assert keeps_speeds([good, good], bars)
    for worse in ({"falls": 1}, {"speed_error": 0.051}, {"speed_error": None}):
        assert not keeps_speeds([good, good | worse], bars)
    env = WalkEnv(WHO, twin["human"], reference(), twin["training"], nsim=4, threads=1, seed=0)
    with pytest.raises(ValueError, match="one speed"):
        env.walk_at(np.full(4, 0.8))


def test_a_training_examines_other_speeds_too():
    settings = copy.deepcopy(twin_settings())
    settings["training"] |= {"simulations": 4, "horizon": 4}
    settings["evaluation"] |= {"walkers": 3, "walk_s": 1.0, "settle_s": 0.4, "shares": [0.75, 0.9]}
    verdict = Trainer(WHO, adaptable(), settings, seed=1, threads=1).evaluate()
    assert [row["share"] for row in verdict["speeds"]] == [0.75, 0.9]
    assert verdict["met"]["speeds"] == keeps_speeds(verdict["speeds"], settings["acceptance"])
    assert "speeds" not in Trainer(WHO, reference(), settings, seed=1, threads=1).evaluate()["met"]


def test_a_speed_that_is_not_kept_is_a_bar_that_is_missed():
    joints = {
        j: {"rom_error_deg": 0.0, "peak_error_deg": 0.0, "r": 1.0, "rmse_deg": 0.0}
        for j in ("hip_flexion", "knee_angle", "ankle_angle")
    }
    walk = {"falls": 0, "speed_error": 0.0, "joints": joints, "saturated_share": 0.0, "warnings": 0}
    walk["floor_force_peak_bw"] = {"mean_of_strides": 1.2}
    names = ("falls", "speed", "floor_force", "saturation", "warnings", "pushes", "battery")
    found = {
        "walk": walk,
        "bars": twin_settings()["acceptance"],
        "met": dict.fromkeys(names, True),
        "pushes": [{"force_n": 100, "falls_per_minute": 0.0}],
        "battery": {"survived_share": 1.0},
        "speeds": [
            {"share": 0.7, "falls": 1, "speed_error": 0.051},
            {"share": 0.9, "falls": 0, "speed_error": None},
        ],
        "seed": 1,
        "phantom": True,
    }
    rows = {row["bar"]: row for row in bar_rows("S06", found)}
    assert [name for name, row in rows.items() if not row["met"]] == [
        "speed_error_at_70_percent",
        "falls_at_70_percent",
        "speed_error_at_90_percent",
    ]
    assert rows["falls_at_90_percent"]["met"]


def test_nobody_means_to_walk_slower_than_their_gait_is_known():
    walk = _walk(adaptable(), [Condition("prior", PRIOR, 0.4, (), True), Condition("prior", PRIOR, 0.4)])
    np.testing.assert_allclose(walk._share, np.repeat([adaptable().speeds.shares[0], 1.0], 2))


def _walk(gait: Reference, conditions: list[Condition]) -> CoupledWalk:
    return CoupledWalk(
        _policy(gait),
        twin=STUDY["twin"],
        plant=STUDY["plant"],
        robot=StudyRobot(STUDY_ROBOT, STUDY["twin"]["study_robot"]),
        rest=REST,
        limits=LIMITS,
        conditions=conditions,
        walkers=2,
    )


def test_the_aware_start_at_the_speed_of_the_robot_and_the_others_at_their_own():
    walk = _walk(adaptable(), [Condition("prior", PRIOR, 0.8, (), True), Condition("prior", PRIOR, 0.8)])
    np.testing.assert_allclose(walk._share, [0.8, 0.8, 1, 1])
    recording = walk.run(0.5)
    assert recording.alive.all()
    assert 0.75 < walk._share[:2].mean() < 0.9
    np.testing.assert_array_equal(walk._share[2:], 1.0)
    # the reference that both start in: the aware are slower from the first step on
    first = recording.along[:, 10] - recording.along[:, 0]
    assert first[:2].mean() < 0.9 * first[2:].mean()


def _without_pull(walk: CoupledWalk) -> dict[str, np.ndarray]:
    """Return what a rollout records where nothing pulls."""
    model = walk.model
    widths = {"qpos": model.nq, "qfrc_passive": model.nv, "sensordata": model.nsensordata}
    record = {name: np.zeros((walk.n, walk.substeps, n)) for name, n in widths.items()}
    record["sensordata"][..., walk.model.sensor("root_quaternion").adr[0]] = 1.0
    return record


@pytest.mark.parametrize("part", ["spring", "stop"])
def test_the_aware_slow_down_by_a_steady_pull_of_spring_or_stop(part: str):
    walk = _walk(adaptable(), [Condition("prior", PRIOR, 0.9, (), True), Condition("prior", PRIOR, 0.9)])
    walk.run(2 * walk.control_s)
    coupled = STUDY["twin"]["coupled"]
    # along the axis of the pelvis' frame, which leans by the rest pose
    pull = 0.1 * coupled["stopping_pull_bw"] * WHO.weight / REST.rotation[0, 0]
    record = _without_pull(walk)
    forward = walk._strap[0]
    if part == "spring":
        record["qfrc_passive"][..., forward] = pull
    else:
        # the interface lags behind the person as far as the strap goes
        record["qpos"][..., forward] = LIMITS.lower[0]
        record["sensordata"][..., walk.model.sensor("strap_stop").adr[0]] = pull
    for _ in range(round(12 * coupled["pull_sense_s"] / walk.control_s)):
        walk._feel(record)
    np.testing.assert_allclose(walk._share, [0.9, 0.9, 1, 1], atol=1e-4)


def test_an_arm_that_lifts_slows_nobody_down():
    walk = _walk(adaptable(), [Condition("prior", PRIOR, 0.9, (), True)])
    walk.run(2 * walk.control_s)
    record = _without_pull(walk)
    # 200 N upwards, which the leaning frame of the pelvis has in part along its forward axis
    record["qfrc_passive"][..., walk._strap[:3]] = REST.rotation @ [0.0, 0.0, 200.0]
    assert abs(record["qfrc_passive"][0, 0, walk._strap[0]]) > 10
    np.testing.assert_allclose(walk._pull_back(record), 0.0, atol=1e-9)
    # turned to the left by 0.5 rad, and held back by 30 N
    turned = walk.model.sensor("root_quaternion").adr[0]
    record["sensordata"][..., turned : turned + 4] = [np.cos(0.25), 0, 0, np.sin(0.25)]
    record["qfrc_passive"][..., walk._strap[:3]] = REST.rotation @ [30.0, 0.0, 200.0]
    np.testing.assert_allclose(walk._pull_back(record), 30.0)


def test_a_slow_robot_that_pulls_at_nothing_slows_nobody_down():
    walk = _walk(adaptable(), [Condition("prior", PRIOR, 0.8, (), True)])
    walk.run(2 * walk.control_s)
    still = _without_pull(walk)
    for _ in range(round(12 * STUDY["twin"]["coupled"]["pull_sense_s"] / walk.control_s)):
        walk._feel(still)
    np.testing.assert_allclose(walk._share, 1.0, atol=1e-4)


def test_the_arm_is_set_up_for_the_mean_height_of_the_walk():
    policy, stretch = _policy(adaptable()), 0.004
    level, place = walking_interface(WHO, REST, height_of_reference(policy, REST), stretch)
    _, standing = standing_interface(WHO, REST)
    np.testing.assert_array_equal(level, np.eye(3))
    np.testing.assert_array_equal(place[:2], standing[:2])
    # held there, the strap of someone who walks as the reference is stretched by that much in the mean
    qpos = policy.reference.at(np.linspace(0, 1, 50, endpoint=False))[0]
    turned, ahead = rotations(qpos[:, 3:7]), np.column_stack([qpos[:, 0], np.zeros((50, 2))])
    pelvis = turned @ REST.rotation.T, qpos[:, :3] + turned @ WHO.mid_asis
    q = interface_coordinates(*relative_pose(*pelvis, level, place + ahead), REST.rotation, REST.position)
    np.testing.assert_allclose(q[:, 2].mean(), stretch, atol=1e-3)
    assert place[2] < standing[2]


def test_the_strap_is_stretched_as_in_the_steady_part_of_the_own_walks(monkeypatch, tmp_path: Path):
    heights = {"walk_robot_1": [0.5, -0.002, np.nan, -0.004], "walk_robot_2": [0.5, -0.003, -0.003, -0.003]}
    stage = "real2sim.study.twin.stage"
    monkeypatch.setattr(
        f"{stage}.read_pose", lambda path: ({"q_tz": np.array(heights[path.parent.name])}, {})
    )
    monkeypatch.setattr(f"{stage}._steady_rows", lambda folder: np.array([1, 2, 3]))
    np.testing.assert_allclose(vertical_stretch([tmp_path / name for name in heights]), -0.003)
    assert vertical_stretch([]) == 0.0
