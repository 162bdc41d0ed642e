"""The thigh cuff: its description and degrees of freedom, the generator against closed forms and against MuJoCo."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import mujoco
import numpy as np
import pyarrow.parquet as pq
import pytest
from mujoco_machine import add_segment, drive, machine_spec
from real2sim.system.description import System, shipped
from real2sim.verification.systems import cuff, pose_driven
from real2sim.verification.systems.interface_law import InterfaceLaw
from real2sim.verification.systems.recordings import TRIALS
from real2sim.verification.systems.rigid_tree import Description, Tree
from real2sim.verification.systems.segment_path import Excitation, segment_path
from real2sim.verification.systems.stepping import Friction, next_rate, rest

ROOT = Path(__file__).parents[2]


def setup() -> pose_driven.Setup:
    system, tree = cuff.describe()
    return cuff.setup_of(system, tree, 3)


def test_joints_of_the_description_are_those_of_the_model():
    system = System.from_yaml(shipped("cuff") / "system.yaml")
    spec = mujoco.MjSpec.from_file(str(system.model))
    model = spec.compile()
    assert system.machine_joints == tuple(model.joint(i).name for i in range(model.njnt))
    assert all(joint.logged and joint.impedance is not None for joint in system.machine)
    assert model.body_mass.sum() == pytest.approx(6.6)
    places = np.array([model.site(site).pos for site in system.markers.sites.values()])
    assert np.allclose(places.mean(axis=0), 0)
    assert np.linalg.norm(np.cross(places[1] - places[0], places[2] - places[0])) > 0.01


def test_thigh_and_three_interface_joints_determine_the_machine():
    """The six joints before the cuff reach any motion of it, so the thigh's six coordinates are free."""
    system = System.from_yaml(shipped("cuff") / "system.yaml")
    model = machine_spec(system, 1e-3).compile()
    data = mujoco.MjData(model)
    rng = np.random.default_rng(0)
    for _ in range(5):
        data.qpos[:] = rng.uniform(-0.4, 0.4, model.nq)
        mujoco.mj_forward(model, data)
        position, rotation = np.zeros((3, model.nv)), np.zeros((3, model.nv))
        mujoco.mj_jacBody(model, data, position, rotation, model.body("cuff").id)
        jacobian = np.vstack([position, rotation])
        assert np.linalg.matrix_rank(jacobian[:, :6]) == 6
        assert not jacobian[:, 6].any()


def test_thigh_markers_make_the_frame_that_the_axes_are_in():
    a, b, c = cuff.THIGH_MARKERS.values()
    x = (b - a) / np.linalg.norm(b - a)
    z = np.cross(x, c - a) / np.linalg.norm(np.cross(x, c - a))
    frame = np.column_stack([x, np.cross(z, x), z])
    system = System.from_yaml(shipped("cuff") / "system.yaml")
    wanted = {"tx": [1, 0, 0], "tz": [0, 0, 1], "rz": [0, 0, 1]}
    for axis in system.axes:
        assert np.allclose(frame @ axis.direction, wanted[axis.name])


def test_tree_has_the_inertia_and_bias_of_mujoco():
    system = System.from_yaml(shipped("cuff") / "system.yaml")
    model = mujoco.MjModel.from_xml_path(str(system.model))
    data = mujoco.MjData(model)
    tree = Tree(Description.read(system.model), "cuff")
    rng = np.random.default_rng(1)
    y, rate = rng.uniform(-0.6, 0.6, (4, model.nq)), rng.uniform(-2, 2, (4, model.nq))
    motion = tree.move(y, rate)
    for i in range(4):
        data.qpos, data.qvel = y[i], rate[i]
        mujoco.mj_forward(model, data)
        inertia = np.zeros((model.nv, model.nv))
        mujoco.mj_fullM(model, data, inertia)
        assert np.allclose(motion.inertia[i], inertia, atol=1e-9)
        assert np.allclose(motion.bias[i], data.qfrc_bias, atol=1e-9)
        assert np.allclose(motion.origin[i, tree.end], data.body("cuff").xpos, atol=1e-12)


def test_energy_of_the_free_machine_is_kept():
    """Without springs, dampers and a moving thigh the energy of cuff and knee stays as it is."""
    system, tree = cuff.describe()
    quiet = Excitation((0.0,) * 6, sway=True)
    path = segment_path(1e-3, 1.0, [quiet], cuff.THIGH_HOME, 0, [1.0])
    mechanism = cuff.CuffMechanism(tree, path)
    free = pose_driven.servo_of(system, tree, {})
    free.stiffness[:], free.damping[:] = 0, 0
    law = InterfaceLaw(np.zeros(3), np.zeros(3), 1e-3)
    x, half, energies = np.zeros((1, 4)), np.array([[0.05, -0.04, 0.6, 2.0]]), []
    friction, before = Friction(np.zeros(7), law), half
    for k in range(400):
        state = mechanism.state(k, x, 1.5 * half - 0.5 * before)
        new = next_rate(state, free, law, half, 1.5 * half - 0.5 * before, 1e-3, friction)
        rate = (state.reduction @ ((half + new) / 2)[:, :, None])[:, :, 0]
        energies.append((rate @ state.motion.inertia[0] @ rate.T).item() / 2)
        before, half = half, new
        x = x + 1e-3 * half
    assert np.ptp(energies[2:]) < 2e-3 * energies[2]


def test_slow_pull_gives_the_static_force():
    """A frame displaced by its controllers' goals ends where springs balance: F = k q along each coordinate."""
    system, tree = cuff.describe()
    path = segment_path(1e-3, 0.1, [cuff.EXCITATIONS["quiet"]], cuff.THIGH_HOME, 0, [0.1])
    mechanism = cuff.CuffMechanism(tree, path)
    servo = pose_driven.servo_of(system, tree, {})
    servo.goal = mechanism.joints_at(0, np.zeros((1, 4)))
    servo.goal[0, :3] += 0.01
    law = InterfaceLaw(cuff.STIFFNESS, cuff.DAMPING, 1e-3)
    x = rest(mechanism, servo, law, np.zeros((1, 4)))
    state = mechanism.state(0, x, np.zeros_like(x))
    frame = servo.stiffness * (servo.goal - state.y)
    # forces on the cuff along x and z of the upright thigh are those of the frame's slides
    assert np.allclose(frame[0, [0, 2]], cuff.STIFFNESS[:2] * x[0, :2], rtol=1e-6)


@pytest.fixture(scope="module")
def traced():
    s = setup()
    return s, *pose_driven.trace_trials(s, None, 0.0, 3, "tz", 3.0)


def test_mujoco_agrees_with_the_generator(traced):
    """Same thigh, same parameters: the cuff's markers are the same to 0.1 mm (0.01 mm found)."""
    s, trace, _ = traced
    step = 2e-4
    spec = machine_spec(s.system, step)
    k, d = s.interface
    rest = Tree(Description.read(s.system.model), "cuff").bodies_at(np.zeros((1, 7)))[1][0, s.tree.end]
    axes = [(n, n, float(a), float(b)) for n, a, b in zip(cuff.AXES, k, d, strict=True)]
    add_segment(spec, "cuff", rest - cuff.THIGH_HOME, axes)
    names = list(s.system.markers.sites.values())
    fine = segment_path(step, 3.0, [s.excitations[n] for n in TRIALS], s.home, 3, [3.0, 3.0, 3.0])
    found = drive(spec.compile(), np.zeros(7), fine, 1, 10, names)
    places = np.array([s.tree.description.sites[n][1] for n in names])
    true = trace.origin[:, 1, None] + np.einsum("tij,kj->tki", trace.rotation[:, 1], places)
    assert np.ptp(trace.q[:, 1], axis=0).min() > 0.003
    n = min(len(found), len(true))
    assert np.abs(found[:n] - true[:n]).max() < 1e-5


def test_step_is_fine_enough(traced, monkeypatch):
    _, trace, _ = traced
    monkeypatch.setattr(pose_driven, "STEP_S", 5e-4)
    monkeypatch.setattr(pose_driven, "STORED_EVERY", 4)
    finer, _ = pose_driven.trace_trials(setup(), None, 0.0, 3, "tz", 1.2)
    # sway of the quiet trial depends on its length
    assert np.abs(finer.origin - trace.origin[: len(finer.origin)])[:, 1:].max() < 1e-7


@pytest.mark.parametrize("effect", [None, "preload", "sync_offset"])
def test_recordings_have_the_columns_of_the_description(effect, tmp_path):
    size = cuff.EFFECTS[effect].typical if effect else 0.0
    case = cuff.simulate(effect, size, 2, tmp_path, duration_s=1.0)
    system = System.from_yaml(shipped("cuff") / "system.yaml")
    markers = (*system.markers.segment, *system.markers.interface)
    wanted = {"time_s", *(f"{m}_{c}_m" for m in markers for c in "xyz")}
    wanted |= {f"{j}_{'m' if j.startswith('mount') else 'rad'}" for j in system.machine_joints}
    for trial in TRIALS:
        table = pq.read_table(case / f"{trial}.parquet")
        assert set(table.column_names) == wanted
        assert all(np.isfinite(table[name].to_numpy()).all() for name in wanted)
        first = table["THI_A_z_m"].to_numpy()[:50]
        assert np.ptp(first) < (0.003 if trial == "quiet" else 0.002)
    truth = json.loads((case / "sealed/truth.json").read_text())
    assert truth["effect"] == effect
    assert set(truth["values"]) == set(system.parameter_names)


def test_friction_sticks_exactly_and_is_bounded():
    """Dry friction far above every other force holds the coordinate still; the knee and the other two move on."""
    s = setup()
    trace, _ = pose_driven.trace_trials(s, "coulomb", 500.0, 3, "tz", 1.0)
    assert np.abs(trace.q[:, :, 1]).max() < 1e-9
    assert np.abs(trace.q[:, 1, 0]).max() > 1e-5


def test_generators_do_not_import_mujoco():
    code = (
        "import sys; import real2sim.verification.systems.cuff, real2sim.verification.systems.one_axis;"
        "sys.exit('mujoco' in sys.modules)"
    )
    found = subprocess.run([sys.executable, "-c", code], cwd=ROOT / "workflow", check=False)
    assert found.returncode == 0
