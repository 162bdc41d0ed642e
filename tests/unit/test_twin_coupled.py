"""Person, strap and robot in one tree: the same strap as in the fits, and what is read out of the walk."""

from __future__ import annotations

import copy
import json
from pathlib import Path
from types import SimpleNamespace

import mujoco
import numpy as np
import pytest
import yaml
from real2sim.configuration import validated
from real2sim.geometry import angles_xyz, relative_pose, rotation_xyz
from real2sim.inference.parameters import PARAMETERS
from real2sim.pages.twin import gait_figure, interface_figure, speed_figure, wrench_figure
from real2sim.study.twin import adaptation, stage
from real2sim.study.twin.coupled import (
    Condition,
    CoupledWalk,
    FreeWalk,
    Recording,
    coupled_spec,
    standing_interface,
    strap_vectors,
)
from real2sim.study.twin.env import ACTIONS, OBSERVATIONS
from real2sim.study.twin.gait import SAGITTAL
from real2sim.study.twin.policy import Policy
from real2sim.study.twin.ppo import init_layers
from real2sim.study.twin.robots import COMPLIANCES, CompliantRobot
from real2sim.study.twin.stage import (
    best_fit,
    cap_to_compare,
    cloud_rows,
    conditions_of,
    gait_rows,
    read_paper,
    strap_rows,
    walk_rows,
    walking_robots,
    wrench_rows,
)
from real2sim.system.batches import untimed_batch
from real2sim.system.plant import ROBOT_JOINTS, STRAP_JOINTS, JointLimits, RestPose

from tests.unit.walking_person import ROOT, WHO, reference

ROBOT = ROOT / "resources" / "robot" / "drba.xml"
STUDY_ROBOT = ROOT / "resources" / "systems" / "drba" / "drba.xml"
PUBLISHED = ROOT / "resources" / "published"
STUDY = validated({}, "config", Path("config"))
REST = RestPose(rotation_xyz(np.radians([1.0, -9.0, 0.5])), np.array([-0.075, 0.004, -0.032]))
LIMITS = JointLimits(
    np.array([-0.08, -0.055, -0.03, -0.3, -0.2, -0.38]), np.array([0.08, 0.055, 0.03, 0.3, 0.2, 0.38])
)
PRIOR = np.array([725, 2120, 3850, 39.2, 122, 15.2, 588, 133, 70.8, 1.26, 2.2, 7.21])


def _unlearnt() -> Policy:
    layers = init_layers([OBSERVATIONS, 8, ACTIONS], 0.0, np.random.default_rng(0))
    return Policy(layers, np.zeros(OBSERVATIONS), np.ones(OBSERVATIONS), reference(), WHO)


def _walk(conditions: list[Condition], walkers: int = 2, twin: dict | None = None, **other) -> CoupledWalk:
    return CoupledWalk(
        _unlearnt(),
        twin=twin or STUDY["twin"],
        plant=STUDY["plant"],
        robot=CompliantRobot(ROBOT, STUDY["twin"]["follow"]),
        rest=REST,
        limits=LIMITS,
        conditions=conditions,
        walkers=walkers,
        **other,
    )


def _model() -> tuple[mujoco.MjModel, np.ndarray]:
    robot = CompliantRobot(ROBOT, STUDY["twin"]["follow"])
    stand = standing_interface(WHO, REST)
    model = coupled_spec(WHO, STUDY["twin"]["human"], robot, STUDY["plant"], REST, LIMITS, stand).compile()
    robot.bind(model, untimed_batch(model, 1, 1), np.ones(1))
    return model, robot.standing()[0]


def test_one_tree_of_robot_strap_and_person():
    model, _ = _model()
    assert model.nv == 6 + 6 + 21
    assert model.neq == 0
    assert model.body_subtreemass[model.body("base").id] == pytest.approx(100 + WHO.mass_kg, rel=1e-3)
    np.testing.assert_allclose(model.joint("strap_ty").range, [-0.055, 0.055])
    assert model.joint("base_y").stiffness[0] == STUDY["twin"]["follow"]["lateral"]["stiffness"]
    assert model.joint("base_x").stiffness[0] == 0


def test_the_strap_is_at_rest_when_the_person_stands():
    model, stand = _model()
    data = mujoco.MjData(model)
    for name, value in zip(ROBOT_JOINTS, stand, strict=True):
        data.joint(name).qpos = value
    mujoco.mj_forward(model, data)
    np.testing.assert_allclose(data.site("human_root").xpos[2], WHO.hip_height, atol=1e-9)
    np.testing.assert_allclose(data.body("human").xmat.reshape(3, 3), np.eye(3), atol=1e-9)


def test_strap_joints_are_the_interface_coordinates():
    # any posture: q from the poses of pelvis markers and interface is what the six joints say
    model, _ = _model()
    data = mujoco.MjData(model)
    q = np.array([0.02, -0.03, 0.01, 0.1, -0.05, 0.2])
    data.qpos[[model.joint(j).qposadr[0] for j in STRAP_JOINTS]] = q
    data.qpos[[model.joint(j).qposadr[0] for j in ROBOT_JOINTS]] = [0.3, 0.1, 0.4, 0.02, 0.05, -0.03]
    mujoco.mj_forward(model, data)
    pelvis = data.body("human").xmat.reshape(3, 3) @ REST.rotation.T
    place = data.site("mid_asis").xpos
    interface = data.body("interface").xmat.reshape(3, 3)
    middle = (data.site("interface_left").xpos + data.site("interface_right").xpos) / 2
    r, p = relative_pose(pelvis, place, interface, middle)
    np.testing.assert_allclose(p - REST.position, q[:3], atol=1e-9)
    np.testing.assert_allclose(angles_xyz(r @ REST.rotation.T), q[3:], atol=1e-9)


def test_the_start_is_the_references_state():
    walk = _walk([Condition("prior", PRIOR, 0.9)], walkers=4)
    phase = np.arange(4) / 4
    walk._start(phase)
    walk.batch.bind("sensordata")
    walk.batch.forward(stage=mujoco.mjtStage.mjSTAGE_VEL)
    s = walk.batch.bind("sensordata")
    qpos, qvel, _ = reference().at(phase)
    first = walk.model.sensor("root_position").adr[0]
    np.testing.assert_allclose(s[:, first : first + 3], qpos[:, :3], atol=1e-9)
    np.testing.assert_allclose(s[:, first + 7 : first + 10], qvel[:, :3], atol=1e-6)
    sign = np.sign(np.sum(s[:, first + 3 : first + 7] * qpos[:, 3:7], axis=1, keepdims=True))
    np.testing.assert_allclose(sign * s[:, first + 3 : first + 7], qpos[:, 3:7], atol=1e-6)


def test_a_stiff_strap_moves_less_and_the_wrench_is_that_of_its_law():
    straps = strap_vectors(
        {"soft": {"stiffness": 10, "damping": 1}, "stiff": {"stiffness": 1e4, "damping": 1e3}}
    )
    names = {"soft": straps["soft"], "prior": PRIOR, "stiff": straps["stiff"]}
    walk = _walk([Condition(n, v, 0.9) for n, v in names.items()])
    recording = walk.run(0.6, stride=1)
    assert recording.alive.all()
    spread = [np.ptp(recording.interface[2 * i : 2 * i + 2, :, 1], axis=1).mean() for i in range(3)]
    assert spread[0] > spread[1] > spread[2]
    # springs and dampers along q, taken at the beginning of a step while q is recorded at its end
    q, f = recording.interface[2:4], recording.wrench[2:4]
    rate = np.gradient(q, recording.time_s, axis=1)
    expected = -(PRIOR[:6] * q + PRIOR[6:] * rate)[:, :-1]
    error = np.abs(f[:, 1:] - expected)[:, 5:-5].max(axis=(0, 1))
    assert np.all(error < 0.15 * np.abs(expected).max(axis=(0, 1)))


def test_robot_factors_act_on_their_axis_alone():
    conditions = [
        Condition("prior", PRIOR, 0.9),
        *(Condition("prior", PRIOR, 0.9, ((a, 3.0),)) for a in COMPLIANCES),
    ]
    walk = _walk(conditions, walkers=1)
    stiffness = walk.batch.expand("jnt_stiffness")
    stiffness = stiffness if stiffness.ndim == 2 else stiffness[..., 0]
    for k, joint in enumerate(COMPLIANCES.values(), start=1):
        changed = np.flatnonzero(stiffness[k] != stiffness[0])
        assert list(changed) == [walk.model.joint(joint).id]
        assert stiffness[k, changed[0]] == 3 * stiffness[0, changed[0]]


def test_the_same_walk_with_two_threads_and_a_cadence_that_adapts():
    conditions = [Condition("prior", PRIOR, 0.8)]
    one, two = (_walk(conditions, threads=n).run(0.3) for n in (1, 2))
    np.testing.assert_array_equal(one.interface, two.interface)
    twin = copy.deepcopy(STUDY["twin"])
    twin["coupled"]["cadence_exponent"] = 1.0
    adapted = _walk(conditions, twin=twin).run(0.6)
    fixed = _walk(conditions).run(0.6)
    assert not np.array_equal(adapted.interface, fixed.interface)


def _steady(sigma: np.ndarray) -> Recording:
    """Walkers who follow the reference for 10 s, their interface swaying by ``sigma`` (3,) [m]."""
    r, n = reference(), 3
    time_s = np.arange(1, 1251) * 0.008
    qpos, _, _ = r.at(time_s / r.stride_s)
    along = np.tile(r.speed * time_s, (n, 1))
    phase = np.mod(time_s / r.stride_s, 1)
    joints = {f"{j}_{s}": np.tile(qpos[:, 7 + _index(f"{j}_{s}")], (n, 1)) for j in SAGITTAL for s in "rl"}
    heel = {
        s: along + np.tile(0.3 * np.cos(2 * np.pi * (phase - shift)), (n, 1))
        for s, shift in (("r", 0), ("l", 0.5))
    }
    wave = np.sqrt(2) * np.stack(
        [np.sin(2 * np.pi * f * time_s) for f in (1.7, 0.9, 1.3)] + [0 * time_s] * 3, axis=-1
    )
    q = np.tile(wave * np.r_[sigma, 0, 0, 0], (n, 1, 1))
    return Recording(
        time_s,
        joints,
        {s: x - along for s, x in heel.items()},
        heel,
        {s: 0 * x for s, x in heel.items()},
        {s: 0 * x for s, x in heel.items()},
        along,
        0 * along + 0.9,
        np.tile([0.0, 0.0, 1.0], (*along.shape, 1)),
        0.05 * np.sin(2 * np.pi * np.tile(phase, (n, 1))),
        q,
        100 * q,
        0 * along + r.speed,
        np.ones(n, bool),
        np.full(n, 10.0),
    )


def _index(name: str) -> int:
    from real2sim.study.twin.human import JOINTS

    return JOINTS.index(name)


def test_cycles_ranges_and_peaks_of_a_known_walk():
    cycles = adaptation.cycles_of(_steady(np.array([0.003, 0.009, 0.002])), 2.0)
    about = adaptation.describe(cycles, cycles)
    for joint in SAGITTAL:
        goal = np.degrees(reference().curve(f"{joint}_r"))
        assert about[joint]["cycles"] >= 8 * 2
        assert about[joint]["rom_deg"][0] == pytest.approx(np.ptp(goal), abs=0.3)
        assert about[joint]["peak_deg"][0] == pytest.approx(goal.max(), abs=0.3)
        assert about[joint]["r"] == pytest.approx(1)
    assert adaptation.describe({j: np.empty((0, 101)) for j in SAGITTAL})["knee_angle"] == {"cycles": 0}


def test_gait_figures_of_a_known_walk():
    recording, r = _steady(np.array([0.003, 0.009, 0.002])), reference()
    gait = adaptation.gait_of(recording, 2.0)
    assert gait["speed_m_per_s"] == pytest.approx(r.speed, rel=1e-3)
    assert gait["stride_m"] == pytest.approx(r.speed * r.stride_s, rel=5e-3)
    assert gait["cadence_per_min"] == pytest.approx(120 / r.stride_s, rel=5e-3)
    assert gait["stride_speed_m_per_s"] == pytest.approx(gait["speed_m_per_s"], rel=5e-3)
    assert gait["pelvis_rotation_deg"] == pytest.approx(np.degrees(0.1), rel=0.02)
    # these heels swing along the floor while the body goes on
    assert gait["stance_slip_m_per_s"] > 0.1
    assert gait["heel_stands_share"] == 1.0
    assert adaptation.gait_of(recording.of(np.array([], int)), 2.0) == {}


def test_a_heel_in_the_air_does_not_slip():
    recording = _steady(np.array([0.003, 0.009, 0.002]))
    phase = np.mod(recording.time_s / reference().stride_s, 1)
    for side, shift in (("r", 0.0), ("l", 0.5)):
        # a foot that lands late, amid what is foot flat of this walk
        above = np.where(np.mod(phase - shift, 1) < 0.38, 0.01, 0.0)
        recording.heel_above[side] = np.tile(above, (3, 1))
    standing = adaptation.gait_of(_steady(np.array([0.003, 0.009, 0.002])), 2.0)
    late = adaptation.gait_of(recording, 2.0)
    assert late["heel_stands_share"] == pytest.approx(0.4, abs=0.1)
    # what is in the air does not count
    assert late["stance_slip_m_per_s"] != pytest.approx(standing["stance_slip_m_per_s"], rel=1e-3)
    for side in "rl":
        recording.heel_above[side] = np.full_like(recording.along, 0.01)
    hanging = adaptation.gait_of(recording, 2.0)
    assert hanging["stance_slip_m_per_s"] is None
    assert hanging["heel_stands_share"] == 0.0


def test_the_cap_is_the_persons_own():
    class Own:
        speed = 0.8

    coupled = STUDY["twin"]["coupled"]
    assert cap_to_compare([Own, Own], 1.0, coupled) == (0.8, "own walks with the robot")
    assert cap_to_compare([], 1.0, coupled)[0] == coupled["main_cap"]
    assert cap_to_compare([Own], 1.0, {**coupled, "cap_from": "main_cap"})[0] == coupled["main_cap"]


def test_the_cloud_of_a_known_sway():
    recording = _steady(np.array([0.003, 0.009, 0.002]))
    cloud = adaptation.cloud(recording.interface, 125.0, 12.0, 4)
    np.testing.assert_allclose(cloud["sigma_mm"], [3, 9, 2], rtol=0.02)
    assert cloud["gamma"] == pytest.approx(1 / 3, rel=0.02)
    # 95 % of a normal cloud: 2.4477 standard deviations along each axis
    np.testing.assert_allclose(cloud["ellipse"]["semi_axes_mm"], 2.4477 * np.array([9, 3]), rtol=0.02)
    assert abs(abs(cloud["ellipse"]["angle_deg"]) - 90) < 2
    # a short trial counts as one, and shortens no other
    short = recording.interface[0][:200]
    mixed = adaptation.cloud([*recording.interface, short], 125.0, 12.0, 4)
    assert mixed["trials"] == cloud["trials"] + 1
    assert mixed["sigma_mm"][1] == pytest.approx(9, rel=0.06)
    assert adaptation.cloud([short[:20]], 125.0, 12.0, 4) == {"trials": 0}
    gone = np.full((2, 500, 6), np.nan)
    assert adaptation.cloud(gone, 125.0, 12.0, 4) == {"trials": 0}


def test_the_wrench_over_the_cycle_beside_a_measured_one():
    recording = _steady(np.array([0.003, 0.009, 0.002]))
    # the interface is turned by a quarter about the vertical: the pelvis' y is its -x
    rest = rotation_xyz(np.array([0, 0, np.pi / 2]))
    seen = adaptation.on_interface(recording, rest)
    np.testing.assert_allclose(seen[..., 0], recording.wrench[..., 1], atol=1e-9)
    phase = np.mod(recording.time_s / reference().stride_s, 1)
    force = np.zeros((3, len(phase), 6))
    force[..., 0] = 10 + 20 * np.cos(2 * np.pi * phase)
    cycles = adaptation.wrench_cycles(recording, force, 2.0)
    earlier = np.roll(cycles[:, :-1], -10, axis=1)
    other = 2 * np.concatenate([earlier, earlier[:, :1]], axis=1)
    found = adaptation.wrench_of(cycles, other)
    assert found["tx"]["mean"] == pytest.approx(10, abs=0.3)
    assert found["tx"]["rms"] == pytest.approx(np.sqrt(100 + 200), rel=0.01)
    assert found["tx"]["peak"] == pytest.approx(30, rel=0.01)
    assert found["tx"]["rms_ratio"] == pytest.approx(0.5, rel=0.01)
    assert found["tx"]["r"] == pytest.approx(1, abs=1e-3)
    assert found["tx"]["phase_percent"] == 10
    # what repeats every step agrees half a cycle away as well: noise must not say which
    twice = np.zeros((1, 101, 6))
    twice[0, :, 0] = np.cos(4 * np.pi * np.arange(101) / 100)
    rng = np.random.default_rng(0)
    for _ in range(20):
        late = np.roll(twice[:, :-1], 3, axis=1) + 0.02 * rng.standard_normal((1, 100, 6))
        late = np.concatenate([late, late[:, :1]], axis=1)
        assert abs(adaptation.wrench_of(late, twice)["tx"]["phase_percent"] - 3) <= 1
    assert found["ty"]["r"] == 0
    # a stride with a gap in the log is left out
    gap = other.copy()
    gap[0, 50] = np.nan
    assert adaptation.wrench_of(cycles, gap)["tx"]["rms_ratio"] == pytest.approx(0.5, rel=0.01)
    assert adaptation.wrench_of(np.empty((0, 101, 6))) == {}


def test_who_fell_counts_in_no_free_walk(monkeypatch):
    recording = _steady(np.array([0.003, 0.009, 0.002]))
    recording.alive[0] = False
    # who falls stumbles before: a range of motion of half the size
    for curve in recording.joints.values():
        curve[0] *= 0.5

    class Walks:
        def __init__(self, learnt, **options):
            pass

        def run(self, seconds):
            return recording

    monkeypatch.setattr(stage, "FreeWalk", Walks)
    learnt = SimpleNamespace(reference=SimpleNamespace(speeds=None))
    twin = {"coupled": {"walkers": 3, "settle_s": 2.0, "speed_caps": [], "walk_s": 10.0}}
    walks = stage.walk_free(learnt, twin, 0.9, 1)
    free = stage._free(walks, 0.9, SimpleNamespace(cycles={}))["free"]
    assert (free["walkers"], free["survived"]) == (3, 2)
    goal = np.ptp(np.degrees(reference().curve("hip_flexion_r")))
    assert free["hip_flexion"]["rom_deg"] == pytest.approx([goal, 0.0], abs=0.3)
    rows = walk_rows("S06", _record() | {"free": free})
    assert [(r["survived"], r["walkers"]) for r in rows if r["condition"] == "free"] == [(2, 3)]


def test_the_arm_is_set_up_at_the_height_that_is_walked():
    recording, rest = (
        _steady(np.array([0.003, 0.009, 0.002])),
        RestPose(np.eye(3), np.array([0.0, 0.0, -0.03])),
    )
    # another height at the speed that is compared, and one who lies
    recording.pelvis_height[1:] = [[0.95], [0.96]]
    recording.alive[0] = False
    recording.pelvis_height[0] = 0.2
    free = stage.FreeWalks([1.0, 0.8, 0.9], 1, recording, 2.0)
    above = WHO.mid_asis[2] - 0.03
    assert stage.height_walked(free, 0.8, WHO, rest) == pytest.approx(0.95 + above)
    assert stage.height_walked(free, 0.9, WHO, rest) == pytest.approx(0.96 + above)
    assert stage.height_walked(free, 1.0, WHO, rest) is None
    # a pelvis that leans forward carries an interface ahead of it lower
    recording.pelvis_up[:] = [-np.sin(0.1), 0.0, np.cos(0.1)]
    ahead = WHO.mid_asis + np.array([0, 0, -0.03])
    lower = 0.95 - np.sin(0.1) * ahead[0] + np.cos(0.1) * ahead[2]
    assert stage.height_walked(free, 0.8, WHO, rest) == pytest.approx(lower)


def test_free_walkers_are_recorded_in_the_same_way():
    recording = FreeWalk(_unlearnt(), twin=STUDY["twin"], walkers=2).run(0.4)
    assert recording.alive.all()
    assert recording.interface.shape[2] == 0
    step = recording.along[:, -1] - recording.along[:, 0]
    span = recording.time_s[-1] - recording.time_s[0]
    assert np.all(np.abs(step / span / reference().speed - 1) < 0.15)


def test_conditions_and_own_parameters(tmp_path):
    coupled = STUDY["twin"]["coupled"]
    both = {**coupled, "robots": ["compliant", "study"]}
    coupled = {**coupled, "gaits": ["fixed"]}
    compliant, study = walking_robots({**STUDY["twin"], "coupled": both}, ROBOT, STUDY_ROBOT)
    conditions = conditions_of(PRIOR, None, coupled, compliant, 0.9)
    assert {c.name for c in conditions} == {"soft", "prior", "stiff"}
    assert sum(bool(c.factors) for c in conditions) == 3 * len(coupled["sensitivity"])
    assert len(conditions_of(PRIOR, PRIOR * 2, coupled, compliant, 0.9)) == len(conditions) + 3
    # a cap of the person's own is one more for every strap
    of_study = conditions_of(PRIOR, None, coupled, study, 0.77)
    assert sum(not c.factors for c in of_study) == 3 * 4
    assert {c.cap for c in of_study if c.factors} == {0.77}
    twice = conditions_of(PRIOR, None, {**coupled, "gaits": ["aware", "fixed"]}, study, 0.77)
    assert [sum(c.aware is aware and not c.factors for c in twice) for aware in (True, False)] == [12, 12]
    assert all(c.aware for c in twice if c.factors)
    files = []
    for trial, factor, cost in (("dynamic_1", 2.0, 0.1), ("dynamic_1", 9.0, 0.3), ("dynamic_2", 8.0, 0.2)):
        files.append(tmp_path / f"{len(files)}.json")
        values = dict(zip(PARAMETERS, (factor * PRIOR).tolist(), strict=True))
        files[-1].write_text(json.dumps({"trial": trial, "cost": {"J": cost}, "parameters": values}))
    np.testing.assert_allclose(best_fit(files), 4 * PRIOR)
    assert best_fit([]) is None


def _record() -> dict:
    """A coupled.json as `twin_coupled` writes it, of made-up walks."""
    cycles = adaptation.cycles_of(_steady(np.array([0.003, 0.009, 0.002])), 2.0)
    about = adaptation.describe(cycles, cycles)
    cloud = adaptation.cloud(_steady(np.array([0.003, 0.009, 0.002])).interface, 125.0, 12.0, 4)
    gait = adaptation.gait_of(_steady(np.array([0.003, 0.009, 0.002])), 2.0)
    wrench = adaptation.wrench_of(np.ones((4, 101, 6)) * np.sin(np.linspace(0, 6.28, 101))[None, :, None])
    place = {"robot": "study", "aware": False, "main": True, "cap": 0.9, "robot_factors": {}}
    case = {**place, "walkers": 8, "survived": 8, "joints": about, "cloud": cloud, "gait": gait}
    case["wrench"] = wrench
    none = {
        **place,
        "gait": {},
        "wrench": {},
        "walkers": 8,
        "survived": 0,
        "joints": {j: {"cycles": 0} for j in SAGITTAL},
        "cloud": {"trials": 0},
    }
    return {
        "seed": 1,
        "phantom": True,
        "main_cap": 0.9,
        "main_robot": "study",
        "paper": read_paper(PUBLISHED / "table3_gait.csv", PUBLISHED / "table2_interface.csv"),
        "free": {**about, "gait": gait},
        "free_at_speeds": [{"share": 0.9, "joints": about, "gait": gait}],
        "conditions": [
            {"name": "prior", **case},
            {"name": "stiff", **none},
            {"name": "prior", **case, "robot_factors": {"roll": 3.0}},
        ],
        "measured": {
            "walk_normal": {**about, "gait": gait},
            "walk_robot": {**about, "gait": gait},
            "cloud": cloud,
            "wrench": wrench,
        },
    }


def test_tables_and_figure_also_where_everybody_fell(tmp_path):
    record = _record()
    gait = gait_rows("S06", record)
    walked = {"free", "free_at_cap", "walk_normal", "walk_robot", "prior"}
    assert {row["condition"] for row in gait if row["cycles"]} == walked
    fallen = [row for row in gait if row["condition"] == "stiff"]
    assert [(row["joint"], row["cycles"]) for row in fallen] == [(joint, 0) for joint in SAGITTAL]
    assert (fallen[0]["survived"], fallen[0]["walkers"], fallen[0]["main"]) == (0, 8, True)
    angles = ("rom_deg", "rom_sd_deg", "rom_change_deg", "peak_deg", "r_walk_robot")
    assert all(row[key] is None for row in fallen for key in angles)
    assert not strap_rows([row for row in gait if row["condition"] in ("prior", "stiff")])
    assert all(row["phantom"] for row in gait)
    prior = next(row for row in gait if row["condition"] == "prior" and row["joint"] == "hip_flexion")
    assert prior["rom_change_deg"] == 0
    assert prior["rom_paper_deg"] == 28.3
    free = next(row for row in gait if row["condition"] == "free" and row["joint"] == "ankle_angle")
    assert free["rom_paper_deg"] == 12.1
    assert prior["main"]
    assert not next(row for row in gait_rows("S06", {**record, "main_robot": "compliant"}) if row["cap"])[
        "main"
    ]
    walks = walk_rows("S06", record)
    assert [row["condition"] for row in walks] == [
        "free",
        "free_at_cap",
        "walk_normal",
        "walk_robot",
        "prior",
        "stiff",
    ]
    assert "speed_m_per_s" not in walks[-1]
    wrenches = wrench_rows("S06", record)
    assert {row["condition"] for row in wrenches} == {"walk_robot", "prior"}
    assert {row["unit"] for row in wrenches if row["axis"][0] == "r"} == {"Nm"}
    clouds = cloud_rows("S06", record)
    assert [row["robot_factor"] for row in clouds] == ["", "", "", "roll x3"]
    assert clouds[2]["gamma"] is None
    assert clouds[1]["gamma_paper"] == 0.360
    path = tmp_path / "coupled.json"
    path.write_text(json.dumps(record))
    for draw in (gait_figure, interface_figure, speed_figure, wrench_figure):
        out = [tmp_path / f"{draw.__name__}.{kind}" for kind in ("png", "pdf", "svg")]
        draw(coupled=[path, path], out=out)
        assert all(p.stat().st_size > 5000 for p in out)
    legend = (tmp_path / "speed_figure.svg").read_text()
    assert ">prior<" in legend
    assert ">own<" not in legend, "a condition without a point"
    # a walker that falls before its first whole stride without a robot, and goes on with one
    path.write_text(json.dumps(record | {"free": record["free"] | {"gait": {}}}))
    speed_figure(coupled=[path], out=[tmp_path / "fallen.svg"])
    assert "1 of 1 seeds not drawn" in (tmp_path / "fallen.svg").read_text()


def test_the_measured_change_is_drawn_of_joints_with_whole_strides_in_both_walks(tmp_path):
    record, path = _record(), tmp_path / "coupled.json"
    for joints, legend in (
        (("hip_flexion",), True),
        (("hip_flexion", "knee_angle"), False),
    ):
        short = {joint: {"cycles": 0} for joint in joints}
        measured = record["measured"] | {"walk_robot": record["measured"]["walk_robot"] | short}
        path.write_text(json.dumps(record | {"measured": measured}))
        for draw in (gait_figure, speed_figure):
            draw(coupled=[path], out=[tmp_path / f"{draw.__name__}.svg"])
        assert (">measured<" in (tmp_path / "speed_figure.svg").read_text()) is legend


def test_straps_are_told_apart_by_more_than_the_seeds_differ():
    place = {"subject": "S06", "robot": "study", "aware": True, "cap": 0.8, "joint": "hip_flexion"}
    rows = [
        place | {"phantom": True, "condition": name, "seed": seed, "rom_change_deg": change}
        for name, changes in {
            "soft": (-2.0, -2.5, -1.5),
            "prior": (-5.0, -5.2, -4.9),
            "stiff": (-5.5, -4.0, -6.5),
        }.items()
        for seed, change in enumerate(changes)
    ]
    found = {(row["strap"], row["against"]): row for row in strap_rows(rows)}
    assert set(found) == {("soft", "prior"), ("stiff", "prior"), ("stiff", "soft")}
    assert found["soft", "prior"]["told_apart"]
    assert found["soft", "prior"]["difference_deg"] == pytest.approx(3.0333, abs=1e-3)
    assert not found["stiff", "prior"]["told_apart"]
    # one seed says nothing
    (alone, *_) = strap_rows([row for row in rows if row["seed"] == 0])
    assert (alone["seeds"], alone["seed_sd_deg"], alone["told_apart"]) == (1, None, False)


def test_every_compliance_of_the_robot_names_its_source():
    follow = yaml.safe_load((ROOT / "config" / "config.yaml").read_text(encoding="utf-8"))["twin"]["follow"]
    for axis in (*COMPLIANCES, "yaw", "pitch"):
        assert follow[axis]["source"]
