"""The study's robot as a described system: each fact of its source, and its generator against MuJoCo."""

from __future__ import annotations

import json
from pathlib import Path

import mujoco
import numpy as np
import pyarrow.parquet as pq
import pytest
from mujoco_machine import add_segment, drive, machine_spec
from real2sim.system.description import System, shipped
from real2sim.verification.systems import drba, pose_driven
from real2sim.verification.systems.recordings import TRIALS
from real2sim.verification.systems.rigid_tree import Description, Tree
from real2sim.verification.systems.segment_path import segment_path

ARM = [f"arm_{side}_{i}" for side in ("left", "right") for i in (1, 2, 3)]


@pytest.fixture(scope="module")
def system() -> System:
    return System.from_yaml(shipped("drba") / "system.yaml")


@pytest.fixture(scope="module")
def model(system) -> mujoco.MjModel:
    return machine_spec(system, 1e-3).compile()


def loop_error(model: mujoco.MjModel, data: mujoco.MjData) -> float:
    """Largest distance [m] between the points that the closure holds together."""
    worst = 0.0
    for i in range(model.neq):
        points = []
        for body, part in ((model.eq_obj1id[i], slice(0, 3)), (model.eq_obj2id[i], slice(3, 6))):
            rotation = data.xmat[body].reshape(3, 3)
            points.append(data.xpos[body] + rotation @ model.eq_data[i, part])
        worst = max(worst, float(np.linalg.norm(points[0] - points[1])))
    return worst


def interface_twists(model: mujoco.MjModel, data: mujoco.MjData, joints: list[str]) -> np.ndarray:
    """Motions (6, r) of the interface that joints allow while the loop stays closed."""
    mujoco.mj_forward(model, data)
    dofs = [model.joint(name).dofadr[0] for name in joints]
    closure = []
    at = data.xpos[model.body("to_interface_right").id]
    for body in ("to_interface_right", "interface"):
        linear, angular = np.zeros((3, model.nv)), np.zeros((3, model.nv))
        mujoco.mj_jac(model, data, linear, angular, at, model.body(body).id)
        closure.append(np.vstack([linear, angular])[:, dofs])
    linear, angular = np.zeros((3, model.nv)), np.zeros((3, model.nv))
    mujoco.mj_jacBody(model, data, linear, angular, model.body("interface").id)
    wanted = np.vstack([linear, angular])[:, dofs]
    gap = closure[0] - closure[1]
    _, values, rows = np.linalg.svd(gap)
    rank = int(np.sum(values > 1e-9 * values[0]))
    return wanted @ rows[rank:].T


def test_masses_are_those_of_the_source(model):
    parts = {
        "base": 76.0,
        "sit_to_stand": 17.9,
        "wheel_left": 1.5,
        "omni_link_left": 5.75,
        "omni_link_right": 7.44,
        "distal_left": 7.20,
        "fore_right": 7.52,
        "to_interface_left": 0.56,
        "interface": 4.31,
        "handle_left": 3.5,
    }
    for name, mass in parts.items():
        assert model.body(name).mass == pytest.approx(mass), name
    # of the 158.9 kg of the source 6.94 kg belong to no part that it lists
    assert model.body_mass.sum() == pytest.approx(158.9 - 6.94)


def test_centres_track_and_wheels_are_those_of_the_source(model):
    assert np.allclose(model.body("base").ipos, [0.117, 0.021, 0.316])
    assert np.allclose(model.body("base").inertia, [1.99, 1.70, 0.48])
    assert np.allclose(model.body("sit_to_stand").ipos, [0.165, 0.004, 0.742])
    track = model.body("wheel_left").pos[1] - model.body("wheel_right").pos[1]
    assert track == pytest.approx(0.628)
    inertia, radius = model.body("wheel_left").inertia[1], 0.16
    assert inertia == pytest.approx(0.0192)
    forward, yaw = (model.dof_armature[model.joint(j).dofadr[0]] for j in ("base_forward", "base_yaw"))
    assert forward == pytest.approx(2 * inertia / radius**2)
    assert yaw == pytest.approx(forward * (track / 2) ** 2, rel=1e-3)


def test_impedance_of_the_held_base_follows_from_the_wheel_servo(system):
    stiffness, damping, radius, half_track = 32 * 2.0, 32 * 2.5 + 0.2, 0.16, 0.314
    joints = {joint.name: joint.impedance for joint in system.machine}
    forward, yaw = joints["base_forward"], joints["base_yaw"]
    assert forward.stiffness == pytest.approx(2 * stiffness / radius**2, rel=1e-3)
    assert forward.damping == pytest.approx(2 * damping / radius**2, rel=1e-3)
    assert yaw.stiffness == pytest.approx(forward.stiffness * half_track**2, rel=1e-3)
    assert yaw.damping == pytest.approx(forward.damping * half_track**2, rel=1e-3)
    assert all(joints[name] is None for name in ARM)


def test_arm_has_lengths_reach_damping_and_friction_of_the_source(model):
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    for side, sign in (("left", 1), ("right", -1)):
        places = [data.body(f"{part}_{side}").xpos for part in ("distal", "fore", "to_interface")]
        base = data.body("base").xpos
        assert np.allclose(places[0] - base, [0.1515, sign * 0.149, 0.776])
        lengths = np.linalg.norm(np.diff(places, axis=0), axis=1)
        assert np.allclose(lengths, [0.250, 0.263], atol=1e-5)
        assert lengths.sum() == pytest.approx(0.513, abs=1e-5)
    for side in ("left", "right"):
        for i, (damping, friction) in enumerate(((0.2, 0.2), (0.2, 0.2), (0.3, 0.3)), 1):
            dof = model.joint(f"arm_{side}_{i}").dofadr[0]
            assert model.dof_damping[dof] == pytest.approx(damping)
            assert model.dof_frictionloss[dof] == pytest.approx(friction)
    left, right = data.site("interface_left").xpos, data.site("interface_right").xpos
    assert np.allclose((left + right) / 2 - data.body("base").xpos, [0.43, 0, 0.80])
    assert np.allclose(left - right, [0, 2 * 0.253, 0])


def test_interface_is_free_in_the_plane_alone(model):
    data = mujoco.MjData(model)
    twists = interface_twists(model, data, ARM)
    values = np.linalg.svd(twists)[1]
    assert np.sum(values > 1e-6) == 3
    assert np.abs(twists[2:5]).max() < 1e-9  # height, roll and pitch are those of the base
    assert np.linalg.matrix_rank(twists[[0, 1, 5]], tol=1e-6) == 3


def test_interface_yields_in_the_plane_and_nowhere_else(model):
    """Half a second of 12 N or 4 Nm moves x, y and yaw, and height, roll and pitch by nothing."""
    body = model.body("interface").id
    moved = np.empty(6)
    for i in range(6):
        data = mujoco.MjData(model)
        mujoco.mj_forward(model, data)
        place, turn = data.xpos[body].copy(), data.xmat[body].reshape(3, 3).copy()
        data.xfrc_applied[body, i] = 12.0 if i < 3 else 4.0
        for _ in range(500):
            mujoco.mj_step(model, data)
        relative = data.xmat[body].reshape(3, 3) @ turn.T
        vector = [
            relative[2, 1] - relative[1, 2],
            relative[0, 2] - relative[2, 0],
            relative[1, 0] - relative[0, 1],
        ]
        moved[i] = np.concatenate([data.xpos[body] - place, np.array(vector) / 2])[i]
    assert (moved[[0, 1, 5]] > [0.005, 0.005, 0.02]).all()
    assert np.abs(moved[2:5]).max() < 1e-6


def test_base_drives_and_turns_but_does_not_move_sideways(model):
    """By Jacobian, and pushed sideways with 50 N for a second: what moves sideways is the path times the yaw rate."""
    data = mujoco.MjData(model)
    data.joint("base_yaw").qpos = 0.4
    data.joint("base_yaw").qvel = 0.0
    data.joint("base_forward").qvel = 1.0
    mujoco.mj_forward(model, data)
    velocity = np.zeros(6)
    body = model.body("base").id
    mujoco.mj_objectVelocity(model, data, mujoco.mjtObj.mjOBJ_XBODY, body, velocity, 1)
    assert np.allclose(velocity[3:], [1, 0, 0], atol=1e-12)
    data = mujoco.MjData(model)
    data.xfrc_applied[body, 1] = 50.0
    sideways = []
    for _ in range(1000):
        mujoco.mj_step(model, data)
        mujoco.mj_objectVelocity(model, data, mujoco.mjtObj.mjOBJ_XBODY, body, velocity, 1)
        sideways.append(velocity[4])
    assert np.abs(sideways).max() < 1e-5


def test_loop_stays_closed_at_one_millisecond(model):
    data = mujoco.MjData(model)
    body = model.body("interface").id
    rng, worst = np.random.default_rng(0), 0.0
    for k in range(2000):
        if k % 250 == 0:
            data.xfrc_applied[body] = rng.uniform(-1, 1, 6) * [40, 40, 40, 10, 10, 10]
        mujoco.mj_step(model, data)
        mujoco.mj_kinematics(model, data)
        worst = max(worst, loop_error(model, data))
    assert worst < 1e-4


def test_tree_has_the_inertia_and_bias_of_mujoco(system):
    model = mujoco.MjModel.from_xml_path(str(system.model))
    data = mujoco.MjData(model)
    tree = Tree(Description.read(system.model), "interface")
    rng = np.random.default_rng(1)
    y, rate = rng.uniform(-0.6, 0.6, (3, model.nq)), rng.uniform(-2, 2, (3, model.nq))
    motion = tree.move(y, rate)
    for i in range(3):
        data.qpos, data.qvel = y[i], rate[i]
        mujoco.mj_forward(model, data)
        inertia = np.zeros((model.nv, model.nv))
        mujoco.mj_fullM(model, data, inertia)
        assert np.allclose(motion.inertia[i], inertia, atol=1e-9)
        assert np.allclose(motion.bias[i], data.qfrc_bias, atol=1e-9)


@pytest.fixture(scope="module")
def traced():
    setup = drba.setup_of(*drba.describe(), 3)
    return setup, pose_driven.trace_trials(setup, None, 0.0, 3, "tx", 2.5)[0]


def test_loop_of_the_generator_is_closed(traced):
    """Both chains of the generator put the interface at one place, and its rates obey the closure."""
    setup, trace = traced
    tree = setup.tree
    rotation, origin = tree.bodies_at(trace.y[::25, 1])
    end, other = tree.end, tree.description.body("to_interface_right")
    from_right = origin[:, other] + rotation[:, other] @ [0, 0.1285, 0.024]
    assert np.abs(from_right - origin[:, end]).max() < 1e-5  # lengths in the MJCF have six decimals
    assert np.abs(rotation[:, other] - rotation[:, end]).max() < 1e-9


def test_mujoco_agrees_with_the_generator(traced):
    """Same pelvis and parameters, friction in six hinges: markers differ by < 0.1 mm (0.05 mm found)."""
    setup, trace = traced
    step = 2e-4
    spec = machine_spec(setup.system, step)
    k, d = setup.interface
    home = setup.tree.bodies_at(np.zeros((1, 8)))[1][0, setup.tree.end]
    axes = [(f"strap_{n}", n, float(a), float(b)) for n, a, b in zip(drba.AXES, k, d, strict=True)]
    add_segment(spec, "interface", home - drba.PELVIS_HOME, axes)
    names = list(setup.system.markers.sites.values())
    fine = segment_path(step, 2.5, [setup.excitations[n] for n in TRIALS], setup.home, 3, [2.5] * 3)
    found = drive(spec.compile(), np.zeros(8), fine, 1, 10, names)
    places = np.array([setup.tree.description.sites[n][1] for n in names])
    true = trace.origin[:, 1, None] + np.einsum("tij,kj->tki", trace.rotation[:, 1], places)
    n = min(len(found), len(true))
    assert np.abs(true[:n] - true[0]).max() > 0.02
    error = np.abs(found[:n] - true[:n]).max()
    assert error < 1e-4, error


@pytest.mark.parametrize("effect", [None, "added_mass"])
def test_recordings_have_the_columns_of_the_description(effect, tmp_path, system):
    size = drba.EFFECTS[effect].typical if effect else 0.0
    case = drba.simulate(effect, size, 2, tmp_path, duration_s=0.8)
    markers = (*system.markers.segment, *system.markers.interface)
    wanted = {"time_s", *(f"{m}_{c}_m" for m in markers for c in "xyz")}
    wanted |= {f"{j}_{'m' if j == 'base_forward' else 'rad'}" for j in system.machine_joints}
    for trial in TRIALS:
        table = pq.read_table(case / f"{trial}.parquet")
        assert set(table.column_names) == wanted
        assert all(np.isfinite(table[name].to_numpy()).all() for name in wanted)
    truth = json.loads((case / "sealed/truth.json").read_text())
    assert truth["effect"] == effect
    assert set(truth["values"]) == set(system.parameter_names)
    assert Path(case) == tmp_path
