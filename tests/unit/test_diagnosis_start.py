"""Where the robot was let go, where a strap rests that was pulled before, and effects that were there in neutral."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from types import SimpleNamespace

import mujoco
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from real2sim.configuration import validated
from real2sim.diagnosis.answer import _stages
from real2sim.effects import replay as replay_module
from real2sim.effects.catalogue import EFFECT_NAMES, EFFECTS, Placed
from real2sim.effects.chains import MarkerShapes, NeutralPose
from real2sim.effects.friction import SmoothFriction
from real2sim.geometry import INTERFACE_MARKERS, PELVIS_MARKERS, pelvis_frame, rotation_xyz
from real2sim.recording.jumps import JumpRule
from real2sim.recording.start import at_first, moved_to_first
from real2sim.recording.tables import without_filled
from real2sim.system.plant import STRAP_JOINTS, RestPose, interface_pose_at, load_robot, robot_pose_for
from scipy.signal import lsim
from scipy.spatial.transform import Rotation

from tests.unit.simulated_effects import LEVEL, PELVIS_SHAPE, SCALES, STRAP, replay
from tests.unit.test_coupling import PRIOR, REST, ROBOT

RATE, START = 100.0, 50
STUDY = validated({}, "config", Path("defaults"))
OPTIONS, JUMPS = STUDY["diagnosis"]["start"], STUDY["diagnosis"]["jumps"]
TWIN = load_robot(ROBOT).compile()


@dataclass(frozen=True)
class Start:
    start_rotation: np.ndarray
    start_position: np.ndarray


@dataclass(frozen=True)
class Seen:
    time_s: np.ndarray
    pelvis_rotation: np.ndarray
    pelvis_position: np.ndarray
    shapes: MarkerShapes = field(default_factory=lambda: MarkerShapes(np.zeros((4, 3)), np.zeros((2, 3))))


def placed(name: str, form: str = "") -> Placed:
    effect = next(e for e in EFFECTS if (e.name, e.form) == (name, form))
    return Placed(effect, effect.places(STRAP)[0], SCALES)


def searched(effect: Placed, *values: float) -> np.ndarray:
    return np.array([values]) / effect.values(np.ones((1, len(values))))


def log(acceleration: float, sd: float, rng: np.random.Generator) -> np.ndarray:
    """Robot joints (n, 6) relative to their mean over the first samples: the base's x pulled from rest."""
    t = np.arange(200) / RATE
    joints = sd * rng.standard_normal((len(t), 6))
    joints[:, 0] += acceleration * t**2 / 2
    return joints - joints[:START].mean(axis=0)


def test_a_robot_that_is_pulled_starts_where_its_log_first_saw_it():
    """7 N on 100 kg move it by 9 mm within the half second whose mean would be its start."""
    rng = np.random.default_rng(0)
    sd = np.full(6, 1e-4)
    found = [at_first(log(0.07, 1e-4, rng), START, RATE, sd, OPTIONS) for _ in range(200)]
    shift, spread = (np.array(part) for part in zip(*found, strict=True))
    t = np.arange(START) / RATE
    true = -0.07 * np.mean(t**2) / 2
    assert (shift[:, 1:] == 0).all()
    assert (spread[:, 1:] == 0).all()
    assert shift[:, 0].mean() == pytest.approx(true, rel=0.01)
    assert shift[:, 0].std() == pytest.approx(spread[0, 0], rel=0.2)


def test_a_robot_that_stands_starts_at_its_mean():
    rng = np.random.default_rng(1)
    for _ in range(100):
        shift, spread = at_first(log(0.0, 1e-4, rng), START, RATE, np.full(6, 1e-4), OPTIONS)
        assert not shift.any()
        assert not spread.any()


def test_a_log_that_begins_late_moves_nothing():
    joints = log(0.07, 0.0, np.random.default_rng(0))
    joints[: round(OPTIONS["first_s"] * RATE)] = np.nan
    shift, _ = at_first(joints, START, RATE, np.zeros(6), OPTIONS)
    assert not shift.any()


def test_the_start_pose_moves_with_the_joints():
    rotation, position = interface_pose_at(TWIN, np.array([0.1, -0.2, 0.3, 0.02, 0.01, -0.02]))
    trial = Start(rotation, position)
    shift, sd = np.array([2e-3, 0.0, 0.0, 0.0, 0.01, 0.0]), np.array([1e-4, 0.0, 0.0, 0.0, 2e-4, 0.0])
    moved, uncertain = moved_to_first(trial, ROBOT, shift, sd)
    joints = robot_pose_for(TWIN, moved.start_rotation, moved.start_position)
    np.testing.assert_allclose(joints - robot_pose_for(TWIN, rotation, position), shift, atol=1e-9)
    # one SD of the base's x is a displacement along x, one of roll a turn
    np.testing.assert_allclose(uncertain[0], [1e-4, 0, 0, 0, 0, 0], atol=1e-10)
    assert np.linalg.norm(uncertain[4, 3:]) == pytest.approx(2e-4, rel=1e-3)
    assert not uncertain[[1, 2, 3, 5]].any()
    same, nothing = moved_to_first(trial, ROBOT, np.zeros(6), np.zeros(6))
    assert same is trial
    assert not nothing.any()


@pytest.mark.parametrize(
    ("name", "form", "plain", "values"),
    [
        ("tilt", "always", "tilt", (0.006, -0.004)),
        ("added_mass", "hanging", "added_mass", (2.0, 0.0)),
        ("added_mass", "off_centre", "added_mass", (2.0, 0.0, 0.1, -0.1, 0.1, 0.5)),
    ],
)
def test_a_force_that_pulled_in_neutral_too_has_stretched_the_strap_there(name, form, plain, values):
    """Where it has settled the rest pose is taken: against the strap's own, known here."""
    effect = placed(name, form)
    x = searched(effect, *values)
    still = np.zeros((600, 6))
    # with its rest pose known: a robot that is let go at the strap's own rest comes to stand elsewhere
    model = replay([effect], motion=still)
    model._stretch_at_rest = lambda fields, m: None
    truly, joints = model.run_effects(PRIOR[None], [x])
    rotation, position = interface_pose_at(TWIN, model.start_joints + joints[0, -1])
    assert np.abs(truly[0, -1] - truly[0, 0]).max() > 2e-3
    pelvis = LEVEL[1] - REST.position
    seen = RestPose(rotation, position - pelvis)
    known = replay([effect], motion=still, seen=(rotation, position))
    known._stretch_at_rest = lambda fields, m: None
    expected, _ = known.run_effects(PRIOR[None], [x])
    found, _ = replay([effect], motion=still, seen=(rotation, position), rest=seen).run_effects(
        PRIOR[None], [x]
    )
    moved = np.abs(expected - expected[:, :1]).max()
    assert np.abs(found - expected).max() < 0.03 * moved


def test_a_slope_stretched_the_strap_by_where_the_robot_looked_in_neutral(monkeypatch):
    """A robot that was turned by an angle on a slope stood as one that was not, on a slope that is turned back."""
    effect, turned, slope = placed("tilt", "always"), 0.8, np.array([0.006, -0.004])
    stretched = []
    monkeypatch.setattr(
        replay_module, "move_rest", lambda fields, axis, by: stretched.append((axis, float(by[0])))
    )

    def stretch(heading, values):
        stretched.clear()
        model = replay([effect], motion=np.zeros((60, 6)))
        neutral = NeutralPose(rotation_xyz([0.0, 0.0, heading]), model._context.neutral.position)
        model._context = replace(model._context, neutral=neutral)
        model.run_effects(PRIOR[None], [searched(effect, *values)])
        return np.array([by for _, by in sorted(stretched)])

    back = rotation_xyz([0.0, 0.0, -turned])[:2, :2]
    there, here = stretch(turned, slope), stretch(0.0, back @ slope)
    np.testing.assert_allclose(there, here, atol=1e-12)
    assert np.abs(there - stretch(0.0, slope)).max() > 1e-3


def test_a_part_above_the_interface_turns_it_where_the_base_speeds_up():
    """MuJoCo leaves the place of a centre of mass out of account where the model was compiled with it at the origin."""
    effect = placed("added_mass", "off_centre")
    x = np.concatenate([searched(effect, 2.0, 0.01, 0.0, 0.0, z, 0.0) for z in (0.0, 0.2)])
    _, joints = replay([effect], nsim=2).run_effects(np.tile(PRIOR, (2, 1)), [x])
    assert np.abs(joints[1] - joints[0]).max(axis=0)[4:].min() > 3e-4
    model = replay([effect])
    model.run_effects(PRIOR[None], [x[1:]])
    body = model.model.body("interface").id
    heavier = model.model.body_mass[body] + 2.0
    assert model._batch.get_model(0).body_ipos[body, 2] == pytest.approx(0.2 / heavier, rel=2e-3)


def test_a_robot_at_rest_was_so_in_neutral_and_stretched_nothing():
    effect = placed("tilt", "always")
    x = searched(effect, 0.006, -0.004)
    found, plain = (
        replay([e], settled=True).run_effects(PRIOR[None], [x])[0]
        for e in (effect, Placed(placed("tilt").effect, effect.where, SCALES))
    )
    np.testing.assert_array_equal(found, plain)


@pytest.mark.parametrize("first", ["preload", "tilt"])
def test_what_yields_begins_where_a_strap_rests_that_rests_elsewhere(first):
    """MuJoCo's reset anchors it: the first call did so before the rest was moved, and was another than the second."""
    effects = [placed(first, "always" if first == "tilt" else ""), placed("hysteresis")]
    model = replay(effects)
    x = [e.starts()[:1] for e in effects]
    one, other = (model.run_effects(PRIOR[None], x)[0] for _ in range(2))
    np.testing.assert_array_equal(one, other)


@pytest.mark.parametrize(("toe", "law"), [(0.0, np.sinh), (1.0, np.expm1)])
def test_an_exponential_spring_is_one(toe, law):
    """The force that MuJoCo makes of its elements, by a strap that is held off its rest."""
    effect, length = placed("stiffening", "_exponential"), 0.01
    x = np.array([[np.log(length / effect.values(np.zeros((1, 2)))[0, 0]), toe]])
    model = replay([effect])
    model.run_effects(PRIOR[None], [x])
    plant = model.as_simulated().model
    data, joint = mujoco.MjData(plant), plant.joint(STRAP_JOINTS[0])
    for u in (-5.0, -2.0, -0.7, 0.3, 1.5, 4.0):
        data.qpos[joint.qposadr] = u * length
        mujoco.mj_forward(plant, data)
        expected = -PRIOR[0] * length * np.sign(u) * law(abs(u))
        assert data.qfrc_passive[joint.dofadr[0]] == pytest.approx(
            expected, rel=0.01, abs=0.035 * PRIOR[0] * length
        )


def test_smooth_friction_runs_along_the_tangent_hyperbolic():
    law = SmoothFriction()
    speed = np.linspace(-6, 6, 401)
    force = (law._weights * np.clip(speed[:, None] / law._rates, -1, 1)).sum(axis=1)
    assert np.abs(force - np.tanh(speed)).max() < 0.08
    assert np.sum(law._weights / law._rates) == pytest.approx(1.0)
    assert law._weights.sum() == pytest.approx(1.0)


def test_smooth_friction_creeps_where_dry_friction_holds():
    """Under a pull below the friction: f tanh(v / rate) = pull lets it go at a steady speed."""
    dry, smooth = placed("coulomb"), placed("coulomb", "_smooth")
    place = np.eye(3), LEVEL[1] + np.array([0.02, 0.0, 0.0])
    force = 3 * PRIOR[0] * 0.02
    way = []
    for effect, values in ((dry, (force,)), (smooth, (force, 0.05))):
        x = _of(effect, values)
        paths, _ = replay([effect], motion=np.zeros((200, 6)), seen=place).run_effects(PRIOR[None], [x])
        way.append(np.abs(paths[0, -1, 0] - paths[0, 0, 0]).max())
    assert way[0] < 1e-4
    assert way[1] > 5e-3


def _of(effect: Placed, values: tuple[float, ...]) -> np.ndarray:
    """Searched numbers of logarithmic parameters."""
    unit = effect.values(np.zeros((1, len(values))))[0]
    return np.log(np.array(values) / unit)[None]


@pytest.mark.parametrize("marker", PELVIS_MARKERS)
def test_a_pelvis_marker_that_slides_takes_the_pelvis_along(marker):
    """The chain gives the bone back: what it makes of the seen path is the one without the slide."""
    index = PELVIS_MARKERS.index(marker)
    chain = placed("marker_drift", marker.lower()).effect.chains.input
    time = np.arange(300) / RATE
    true_rotation = Rotation.from_euler("z", 0.3 * np.sin(2 * np.pi * 0.5 * time)[:, None]).as_matrix()
    true_position = np.column_stack([0.1 * np.sin(time), 0 * time, 0.9 + 0 * time])
    steady, fading = np.array([1e-3, -5e-4, 2e-4]), np.array([0.0, 2e-3, 0.0])
    fades = time[-1] / 3
    way = time[:, None] * steady + fades * (1 - np.exp(-time / fades))[:, None] * fading
    shape = PELVIS_SHAPE - pelvis_frame(*PELVIS_SHAPE)[1]
    markers = true_position[:, None] + np.einsum("nij,kj->nki", true_rotation, shape)
    markers[:, index] += np.einsum("nij,nj->ni", true_rotation, way)
    rotation, position = pelvis_frame(*np.moveaxis(markers, 1, 0))
    r0, p0 = pelvis_frame(*shape)
    context = SimpleNamespace(
        time_s=time,
        pelvis_rotation=rotation @ r0.T,
        pelvis_position=position - p0,
        shapes=SimpleNamespace(segment=shape),
    )
    found_rotation, found_position = chain(np.concatenate([steady, fading]), context)
    np.testing.assert_allclose(found_position, true_position, atol=5e-5)
    np.testing.assert_allclose(found_rotation, true_rotation, atol=5e-4)


def test_a_stage_is_where_the_likeliest_form_acts():
    """A sliding marker of the pelvis goes in, one of the interface comes out."""
    slides = [placed("marker_drift", form) for form in ("left", "asis_r")]
    attribution = SimpleNamespace(hypotheses=[SimpleNamespace(effects=(p,)) for p in slides])
    probabilities = dict.fromkeys(EFFECT_NAMES, 0.0) | {"marker_drift": 0.9, "tilt": 0.1}
    for sets, stage in (([0.7, 0.2], "output"), ([0.2, 0.7], "input")):
        decision = SimpleNamespace(sets=np.array(sets), probabilities=probabilities)
        stages = _stages(attribution, decision)
        assert max(stages, key=lambda name: stages[name]) == stage
        assert stages["robot"] == pytest.approx(0.1)
        assert sum(stages.values()) == pytest.approx(1.0)


def test_a_wobbling_skin_gives_the_bone_back():
    """Seen through a mass on a spring of 2.5 Hz, damped against the room: rate and acceleration undo it."""
    chain = placed("soft_tissue", "wobble").effect.chains.input
    time, w, damping = np.arange(600) / RATE, 2 * np.pi * 2.5, 0.2
    rise = np.clip(time - 0.5, 0, 1) ** 2
    bone = np.column_stack([0.1 * np.sin(2 * np.pi * 0.8 * time) * rise, 0 * time, 0.9 + 0 * time])
    yaw = 0.3 * np.sin(2 * np.pi * 0.6 * time) * rise
    seen = [lsim(([w * w], [1, 2 * damping * w, w * w]), x, time)[1] for x in (bone[:, 0], yaw)]
    context = Seen(
        time_s=time,
        pelvis_rotation=Rotation.from_euler("z", seen[1][:, None]).as_matrix(),
        pelvis_position=np.column_stack([seen[0], bone[:, 1:]]),
    )
    values = np.zeros(20)
    values[18:] = 2 * damping / w, 1 / w**2
    rotation, position = chain(values, context)
    wrong = np.abs(context.pelvis_position - bone).max()
    assert np.abs(position - bone).max() < 0.02 * wrong
    turn = Rotation.from_matrix(rotation).as_rotvec()[:, 2]
    assert np.abs(turn - yaw).max() < 0.02 * np.abs(seen[1] - yaw).max()


def test_skin_does_not_ring_as_fast_as_the_low_pass_of_the_path():
    """Without that bound it made up for the filter, and a null of the standard suite was a soft-tissue artefact."""
    mobility = placed("soft_tissue", "wobble").effect.parameters[-1]
    assert mobility.name == "mobility"
    assert 1 / (2 * np.pi * np.sqrt(mobility.lower)) < 4.0


def test_what_fills_a_gap_is_no_measurement(tmp_path):
    n = 100
    columns = {f"{m}_filled": np.zeros(n, bool) for m in INTERFACE_MARKERS}
    columns[f"{INTERFACE_MARKERS[1]}_filled"][40:50] = True
    pq.write_table(pa.table(columns), tmp_path / "markers.parquet")
    seen = without_filled(np.ones((n, 2, 3)), tmp_path / "markers.parquet", JumpRule(RATE, 12.0, JUMPS))
    assert np.isfinite(seen[:, 0]).all()
    lost = np.flatnonzero(np.isnan(seen[:, 1, 0]))
    # five hundredths of a second beyond both ends
    assert (lost[0], lost[-1], len(lost)) == (35, 54, 20)


def test_markers_taped_anew_leave_the_rest_pose_that_was_seen():
    offsets = np.array([0.004, -0.002, 0.003, 0.004, -0.001, 0.002])
    before, after = placed("marker_offset"), placed("marker_offset", "retaped")
    x = searched(after, *offsets)
    models = [replay([e]) for e in (before, after)]
    paths = [m.run_effects(PRIOR[None], [x])[0] for m in models]
    rests = [m._sights[0].rest for m in models]
    np.testing.assert_array_equal(rests[1].position, REST.position)
    assert np.abs(rests[0].position - REST.position).max() > 1e-3
    # taped anew, the strap is seen to pull where it rests
    assert np.abs(paths[0] - paths[1]).max() > 1e-3
    # and its markers start where they were seen
    np.testing.assert_allclose(paths[1][0, 0].mean(axis=0), LEVEL[1], atol=5e-4)
