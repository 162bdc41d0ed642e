"""The plant: exact where a closed form or an independent solution says what it must do."""

from __future__ import annotations

import copy
from pathlib import Path

import mujoco
import numpy as np
import pytest
from mujoco.batch import Batch
from real2sim.configuration import read_yaml, validated
from real2sim.errors import InputError
from real2sim.geometry import rotation_xyz
from real2sim.inference.cost import CostScales, TrialCost
from real2sim.inference.parameters import PARAMETERS, Bounds
from real2sim.system.batches import untimed_batch
from real2sim.system.drive import pelvis_drive
from real2sim.system.plant import (
    ROBOT_JOINTS,
    JointLimits,
    RestPose,
    interface_site_offset,
    load_robot,
    robot_pose_for,
)
from real2sim.system.replay import Replay, replay_check
from real2sim.verification.cohort.write import simulate_trial
from real2sim.verification.phantom.person import draw_person
from real2sim.verification.phantom.tasks import motion_of

ROOT = Path(__file__).parents[2]
ROBOT = ROOT / "resources" / "robot" / "drba.xml"
CONFIG = validated({"plant": {"timestep_s": 0.005}}, "config", Path("defaults"))
PRIOR = np.array([725, 2120, 3850, 39.2, 122, 15.2, 588, 133, 70.8, 1.26, 2.2, 7.21])
REST = RestPose(np.eye(3), np.array([-0.08, 0.0, -0.02]))


def replay_of(offset: np.ndarray, *, nsim=1, limits=None, timestep=None, robot=ROBOT, threads=1) -> Replay:
    """Replay whose pelvis is ``offset`` (n, 6) [m, rad] from rest."""
    plant = CONFIG["plant"] | ({"timestep_s": timestep} if timestep else {})
    return Replay(
        robot=robot,
        robot_settings=CONFIG["robot"],
        plant_settings=plant,
        time_s=np.arange(len(offset)) / 100,
        pelvis_rotation=rotation_xyz(offset[:, 3:]),
        pelvis_position=np.array([0.0, 0.0, 0.95]) - REST.position + offset[:, :3],
        start_rotation=np.eye(3),
        start_position=np.array([0.0, 0.0, 0.95]),
        rest=REST,
        limits=limits,
        nsim=nsim,
        threads=threads,
    )


def smooth_motion(seconds=6.0) -> np.ndarray:
    t = np.arange(0, seconds, 0.01)
    amplitude = [0.05, 0.04, 0.02, 0.08, 0.1, 0.25]
    waves = [
        a * np.sin(2 * np.pi * f * t) for a, f in zip(amplitude, [0.4, 0.6, 1.3, 0.9, 0.7, 0.5], strict=True)
    ]
    return np.column_stack(waves) * (1 - np.exp(-((t / 0.8) ** 4)))[:, None]


@pytest.mark.parametrize(("axis", "hold"), [(0, ("hold", "x")), (1, ("hold", "y")), (2, ("arm", "lift"))])
def test_static_equilibrium_is_that_of_two_springs_in_series(axis, hold):
    displacement = np.zeros((4000, 6))
    displacement[:, axis] = 0.03 * np.minimum(1, np.arange(4000) / 500) ** 2
    soft_turn = PRIOR.copy()
    soft_turn[3:6] = [500, 500, 500]
    replay = replay_of(displacement)
    end = replay.run(soft_turn[None])[0, -1].mean(axis=0) - [0, 0, 0.95]
    strap, robot = soft_turn[axis], CONFIG["robot"][hold[0]][hold[1]]["stiffness"]
    compliance = 1 / robot
    if axis == 1:
        # a side force at the interface also turns the base, 0.55 m behind it, against its hold and the strap
        compliance += 0.55**2 / (CONFIG["robot"]["hold"]["yaw"]["stiffness"] + soft_turn[5])
    assert end[axis] == pytest.approx(0.03 * strap * compliance / (1 + strap * compliance), rel=2e-3)


def test_replay_follows_its_path_in_space_and_time():
    replay = replay_of(smooth_motion())
    _, pelvis = replay.run_with_pelvis(PRIOR[None])
    check = replay_check(replay, pelvis[0])
    assert check["rms_m"] < 1e-4
    assert abs(check["lag_s"]) < 1e-4
    path = replay.drive.reference_origin + replay.drive.position[:, :3] @ replay.drive.reference_rotation.T
    late = replay_check(replay, np.vstack([path[:1], path[:-1]]))
    assert late["lag_s"] == pytest.approx(CONFIG["plant"]["timestep_s"], rel=0.05)


def test_pelvis_feels_no_reaction():
    replay = replay_of(smooth_motion(), nsim=2, timestep=0.0005)
    stiff = np.array([8e3, 8e3, 1e4, 500, 500, 500, 1e3, 500, 500, 15, 15, 15], float)
    soft = np.array([150, 150, 150, 15, 15, 15, 5, 5, 5, 0.3, 0.3, 0.3], float)
    _, pelvis = replay.run_with_pelvis(np.array([stiff, soft]))
    assert np.abs(pelvis[0] - pelvis[1]).max() < 1e-6


def test_marker_paths_agree_with_the_phantoms_own_physics():
    source = ROOT / "config" / "phantom.yaml"
    settings = copy.deepcopy(validated(read_yaml(source), "phantom", source))
    settings["effects"]["enabled"] = settings["measurement"]["enabled"] = False
    settings["trials"]["dynamic_s"] = 9.0
    person = draw_person(settings, "S02", 0.95)
    truth = simulate_trial(
        robot=ROBOT,
        settings=settings,
        controllers=CONFIG["robot"],
        parameters=person.parameters,
        motion=motion_of(settings, person, "dynamic_1"),
        rest_rotation=person.rest_rotation,
        rest_position=person.rest_position,
    )
    replay = Replay(
        robot=ROBOT,
        robot_settings=CONFIG["robot"],
        plant_settings=CONFIG["plant"],
        time_s=truth.time_s - truth.time_s[0],
        pelvis_rotation=truth.pelvis_rotation,
        pelvis_position=truth.pelvis_position,
        start_rotation=truth.interface_rotation[0],
        start_position=truth.interface_position[0],
        rest=RestPose(person.rest_rotation, person.rest_position),
        limits=None,
        nsim=1,
    )
    measured = np.stack([truth.left, truth.right], axis=1)
    simulated = replay.run(np.array([[person.parameters[name] for name in PARAMETERS]]))
    rms = np.sqrt(np.mean(np.sum((simulated[0] - measured) ** 2, axis=-1)))
    assert np.ptp(measured, axis=0).max() > 0.05
    assert rms < 5e-5  # the bar is 0.4 mm
    cost = TrialCost(measured, 100, CostScales(0.041, 0.08))
    assert cost(simulated).total[0] < 5e-5


def test_time_step_of_ten_milliseconds_is_within_the_studys_bars():
    rng = np.random.default_rng(2)
    near = PRIOR * np.exp(0.3 * rng.standard_normal((4, 12)))
    coarse, fine = (replay_of(smooth_motion(), nsim=4, timestep=h).run(near) for h in (0.01, 0.0005))
    rms = np.sqrt(np.mean(np.sum((coarse - fine) ** 2, axis=-1), axis=(1, 2)))
    assert rms.max() < CONFIG["plant"]["study"]["marker_rms_m"]


def test_shapes_of_a_robot_without_written_inertia_keep_their_mass(tmp_path):
    own = tmp_path / "own.xml"
    text = ROBOT.read_text().replace('<inertial pos="0 0 0.3" mass="91" diaginertia="8 8 12"/>', "")
    own.write_text(
        text.replace('pos="0 0 0.15" contype="0" conaffinity="0" mass="0"', 'pos="0 0 0.15" mass="91"')
    )
    model = replay_of(smooth_motion(1.0), robot=own).model
    assert model.body("base").mass[0] == pytest.approx(91)
    assert replay_of(smooth_motion(1.0)).model.ngeom == 0


def test_half_the_time_step_changes_little():
    rng = np.random.default_rng(1)
    bounds = Bounds.from_config(CONFIG["identification"]["bounds"])
    many = np.exp([bounds.log_uniform(rng) for _ in range(6)])
    coarse, fine = (replay_of(smooth_motion(), nsim=6, timestep=h).run(many) for h in (0.005, 0.001))
    rms = np.sqrt(np.mean(np.sum((coarse - fine) ** 2, axis=-1), axis=(1, 2)))
    assert rms.max() < 1e-4


def test_each_simulation_is_its_own_whatever_the_batch():
    replay = replay_of(smooth_motion(2.0), nsim=3)
    other = PRIOR * 1.5
    together = replay.run(np.array([PRIOR, other, PRIOR]))
    assert np.array_equal(together[0], together[2])
    assert np.array_equal(replay.run(other[None])[0], together[1])


def test_threads_change_no_bit():
    motion, many = smooth_motion(2.0), PRIOR * np.linspace(0.6, 1.8, 7)[:, None]
    limits = JointLimits(np.full(6, -0.03), np.full(6, 0.03))
    one, two = (replay_of(motion, nsim=7, limits=limits, threads=n) for n in (1, 2))
    assert np.array_equal(one.run(many), two.run(many))
    # fewer simulations than the batch holds, and again after other parameters
    assert np.array_equal(one.run(many[4:]), two.run(many[4:]))


def test_joint_limits_stop_the_strap():
    motion = smooth_motion()
    soft = np.array([150, 150, 150, 15, 15, 15, 5, 5, 5, 0.3, 0.3, 0.3], float)
    free = replay_of(motion).run(soft[None])[0]
    limits = JointLimits(np.full(6, -0.01), np.full(6, 0.01))
    stopped = replay_of(motion, limits=limits).run(soft[None])[0]

    def reach(paths):
        pelvis = np.array([0, 0, 0.95]) - REST.position + motion[:, :3]
        rotation = rotation_xyz(motion[:, 3:])
        local = np.einsum("nji,nj->ni", rotation, paths.mean(axis=1) - pelvis) - REST.position
        return np.abs(local).max()

    assert reach(free) > 0.02
    assert reach(stopped) < 0.012


def test_drive_has_the_derivatives_of_its_path():
    t = np.arange(0, 2, 0.01)
    turn = 0.3 * np.sin(3 * t)
    position = np.column_stack([0.1 * np.sin(2 * t), 0 * t, 0 * t])
    drive = pelvis_drive(t, rotation_xyz(np.column_stack([0 * t, 0 * t, turn])), position, 0.005)
    steps = 0.005 * np.arange(len(drive.position))
    inner = slice(20, -20)
    assert np.allclose(drive.position[inner, 5], 0.3 * np.sin(3 * steps[inner]), atol=1e-9)
    assert np.allclose(drive.velocity[inner, 5], 0.9 * np.cos(3 * (steps[inner] - 0.0025)), atol=1e-6)
    assert np.allclose(drive.acceleration[inner, 0], -0.4 * np.sin(2 * steps[inner]), atol=1e-5)


def test_drive_bridges_a_gap_and_refuses_a_turn_beyond_the_servo():
    t = np.arange(0, 3, 0.01)
    rotation = rotation_xyz(np.column_stack([0 * t, 0 * t, 0.8 * t]))
    rotation[100:115] = np.nan
    drive = pelvis_drive(t, rotation, np.zeros((len(t), 3)), 0.01)
    assert np.allclose(drive.position[:, 5], 0.8 * t, atol=1e-6)
    with pytest.raises(ValueError, match="turns by"):
        pelvis_drive(t, rotation_xyz(np.column_stack([0 * t, 0 * t, 1.0 * t])), np.zeros((len(t), 3)), 0.01)


@pytest.mark.parametrize("lost", [slice(0, 30), slice(-30, None), slice(400, 600)])
def test_a_lost_pelvis_neither_runs_off_nor_swings_beyond_what_is_known(lost: slice):
    t, rng = np.arange(0, 10, 0.01), np.random.default_rng(0)
    position = np.column_stack([0.05 * np.sin(3.1 * t), 0.03 * np.sin(5 * t), 0 * t])
    position += 1e-4 * rng.standard_normal(position.shape)
    rotation = rotation_xyz(np.column_stack([0 * t, 0 * t, 0.2 * np.sin(4 * t)]))
    whole = pelvis_drive(t, rotation, position, 0.01).position
    gone = position.copy()
    gone[lost] = np.nan
    drive = pelvis_drive(t, rotation, gone, 0.01, (rotation[0], position[0])).position
    known = np.ones(len(t), bool)
    known[lost] = False
    assert np.allclose(drive[known], whole[known], atol=1e-9)
    low, high = drive[known].min(axis=0), drive[known].max(axis=0)
    over = 0.02 * (high - low)  # what the spline rings where it comes to stand
    assert np.all((drive >= low - over) & (drive <= high + over))


def test_inverse_kinematics_reaches_the_pose():
    import mujoco

    robot = load_robot(ROBOT).compile()
    rotation, position = rotation_xyz(np.array([0.05, -0.1, 0.4])), np.array([0.2, -0.1, 1.0])
    data = mujoco.MjData(robot)
    for name, value in zip(ROBOT_JOINTS, robot_pose_for(robot, rotation, position), strict=True):
        data.joint(name).qpos = value
    mujoco.mj_kinematics(robot, data)
    reached = data.body("interface").xmat.reshape(3, 3)
    assert np.allclose(reached, rotation, atol=1e-9)
    assert np.allclose(
        data.body("interface").xpos + reached @ interface_site_offset(robot), position, atol=1e-9
    )


def test_robot_without_the_contracts_names_is_refused(tmp_path):
    own = tmp_path / "own.xml"
    own.write_text(ROBOT.read_text().replace('name="arm_lift"', 'name="lift"'))
    with pytest.raises(InputError, match=r"own\.xml(.|\n)*joint arm_lift"):
        load_robot(own)
    own.write_text("<mujoco><worldbody>")
    with pytest.raises(InputError, match=r"own\.xml"):
        load_robot(own)


def test_robot_too_light_for_the_time_step_is_refused(tmp_path):
    own = tmp_path / "light.xml"
    text = ROBOT.read_text().replace('mass="6"', 'mass="0.2"').replace('mass="3"', 'mass="0.1"')
    own.write_text(text)
    with pytest.raises(InputError, match="inertia too small"):
        replay_of(smooth_motion(1.0), robot=own).check_bounds(np.full(6, 500.0))
    replay_of(smooth_motion(1.0)).check_bounds(np.array([1000, 500, 500, 15, 15, 15.0]))


def test_a_simulation_that_diverges_says_nothing_and_leaves_no_file(capfd, tmp_path, monkeypatch):
    """One suite wrote 3 246 such lines, and a MUJOCO_LOG.TXT into the folder it was started from."""
    monkeypatch.chdir(tmp_path)
    stiff = """<mujoco><worldbody><body><joint type="slide" stiffness="1e7" damping="0"/>
    <geom size=".1" mass=".001"/></body></worldbody><option timestep="0.01"/></mujoco>"""
    batch = untimed_batch(mujoco.MjModel.from_xml_string(stiff), 2, 2)
    batch.bind("qpos")[:] = 1.0
    batch.rollout(300, np.zeros((2, 300, 0)), record=("qpos",), ids=np.arange(2))
    assert capfd.readouterr() == ("", "")
    assert list(tmp_path.iterdir()) == []
    mujoco.get_mju_user_warning()(
        "Inertia matrix is too close to singular at DOF 4. Check model. Time = 4.56."
    )
    # another warning is shown, once: a search can meet it in ten thousand simulations
    for at in ("0.1", "0.2"):
        mujoco.get_mju_user_warning()(f"Too many contacts. Time = {at}.")
    shown = capfd.readouterr().err
    assert shown.startswith("MuJoCo: Too many contacts. Time = 0.1.")
    assert shown.count("Too many contacts") == 1


def test_constraints_are_divided_into_islands_only_where_there_can_be_several():
    def model(bodies: int) -> mujoco.MjModel:
        body = '<body pos="{} 0 0.1"><freejoint/><geom size="0.1" mass="1"/></body>'
        inside = "".join(body.format(i) for i in range(bodies))
        return mujoco.MjModel.from_xml_string(
            f'<mujoco><worldbody><geom type="plane" size="9 9 1"/>{inside}</worldbody></mujoco>'
        )

    paths = {}
    for bodies, divided in ((1, False), (2, True)):
        own, as_made = model(bodies), model(bodies)
        batch, plain = untimed_batch(own, 1, 1), Batch(as_made, 1, 1, False)
        assert bool(own.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_ISLAND) is not divided
        for one in (batch, plain):
            one.step(nstep=50)
        paths[bodies] = [np.array(one.bind("qpos")) for one in (batch, plain)]
    assert all(np.array_equal(*both) for both in paths.values())
