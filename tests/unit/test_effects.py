"""Effects in the simulation: what each does is what its equation says, and nothing where it does nothing."""

from __future__ import annotations

from dataclasses import replace
from itertools import combinations
from types import SimpleNamespace

import mujoco
import numpy as np
import pytest
from real2sim.diagnosis.refit import JointResiduals
from real2sim.diagnosis.search import Pair, Search, conflict
from real2sim.effects import chains, lab, timing, tissue
from real2sim.effects.base import NEUTRAL, Effect, InterfaceImpedance, Placed, Where
from real2sim.effects.catalogue import EFFECTS, SHIPPED
from real2sim.effects.controller import Admittance, Answer, HoldIntegral, Reaction
from real2sim.effects.floor import tilt
from real2sim.effects.memory import bouc_wen, eyring, maxwell
from real2sim.effects.planned import PlannedForce
from real2sim.effects.replay import _drive_for
from real2sim.geometry import AXES, interface_frame, pelvis_frame
from real2sim.recording.skin import on_pelvis, skin_by_turn
from real2sim.signals import lowpass
from real2sim.study import strap_evidence
from real2sim.system.plant import (
    ROBOT_JOINTS,
    STRAP_JOINTS,
    RestPose,
    load_robot,
    mass_on_base,
    robot_pose_for,
)
from real2sim.system.replay import servo_command
from scipy.signal import lfilter
from scipy.spatial.transform import Rotation

from tests.unit.simulated_effects import (
    HALF,
    LEVEL,
    SCALES,
    STRAP,
    about,
    at_rest_on,
    pelvis_at_start,
    placed_whole,
    replay,
    undriven,
)
from tests.unit.test_coupling import CONFIG, PRIOR, REST, ROBOT, rotation_xyz, smooth_motion

IMPEDANCE = InterfaceImpedance(PRIOR[None, :6], PRIOR[None, 6:])


@pytest.fixture(scope="module")
def plain() -> tuple[np.ndarray, np.ndarray]:
    """Marker paths and robot joints of the plain plant."""
    return replay([]).run_effects(PRIOR[None], [])


def _everywhere(effect: Effect) -> list[Placed]:
    """Return the effect at every place, with small scales, so that thresholds are passed."""
    return [Placed(effect, where, replace(SCALES, q=SCALES.q / 5)) for where in effect.places(STRAP)]


@pytest.mark.parametrize("effect", SHIPPED, ids=lambda e: e.label)
def test_an_effect_at_rest_is_the_plain_plant_at_every_place(effect, plain):
    for placed in _everywhere(effect):
        simulated = replay([placed]).run_effects(PRIOR[None], [placed.at_rest()[None]])
        away = max(np.abs(a - b).max() for a, b in zip(simulated, plain, strict=True))
        assert away <= effect.at_rest.tolerance, f"{placed.key}: {away}"


@pytest.mark.parametrize("effect", [e for e in SHIPPED if e.parameters], ids=lambda e: e.label)
def test_an_effect_away_from_rest_changes_the_simulation_at_every_place(effect):
    for placed in _everywhere(effect):
        x = np.array([placed.at_rest(), *(point for point in _away(placed) for _ in range(2))])
        model = replay([placed], nsim=len(x))
        simulated = model.run_effects(np.tile(PRIOR, (len(x), 1)), [x])
        assert np.isfinite(simulated[0]).all(), placed.key
        for part in simulated:
            np.testing.assert_allclose(part[1::2], part[2::2], rtol=0, atol=1e-10)
        away = max(np.abs(part[1:] - part[0]).max() for part in simulated)
        assert away > 1e-5, f"{placed.key}: {away}"


def test_two_effects_that_do_not_exclude_each_other_stand_in_one_plant():
    acting = [effect for effect in SHIPPED if effect.plant is not NEUTRAL]
    first = [Placed(effect, effect.places(STRAP)[0], SCALES) for effect in acting if effect.places(STRAP)]
    # what carries the arm takes degrees of freedom of one body, of which MuJoCo has six
    carrier = next(p for p in first if p.effect.label == "base_compliance rocking")
    written = carrier.effect.plant.overwrites(carrier.where)
    pairs = [
        pair
        for pair in combinations(first, 2)
        if any(p.effect.plant.overwrites(p.where) & written for p in pair)
    ]
    assert any(conflict(pair) for pair in pairs)
    for pair in pairs:
        if not conflict(pair):
            assert replay(list(pair)).model.nv > 12


def _away(placed: Placed) -> np.ndarray:
    """Return the starts (s, p) of an effect, or where it starts at rest a third of the way to the upper bound."""
    starts, rest, upper = placed.starts(), placed.at_rest(), placed.bounds()[1]
    return starts if (starts != rest).any(axis=1).all() else (rest + (upper - rest) / 3)[None]


def test_outliers_show_the_measurement_where_a_marker_jumps(plain):
    model = replay([placed_whole("outliers")])
    context = model._context
    context.spikes[50, 0] = True
    paths, _ = model.run_effects(PRIOR[None], [np.empty((1, 0))])
    np.testing.assert_array_equal(paths[0, 50, 0], context.measured[50, 0])
    paths[0, 50, 0] = plain[0][0, 50, 0]
    np.testing.assert_array_equal(paths, plain[0])


@pytest.mark.parametrize("heading", [0.0, 0.7, -2.5])
def test_a_slope_pulls_every_body_as_gravity_does(heading):
    """What is ahead of the axis that the base turns about turns it: the force is MuJoCo's own."""
    slope = np.array([0.02, -0.013])
    spec = load_robot(ROBOT)
    spec.option.gravity = [*(9.81 * slope), 0.0]
    for body in spec.bodies:
        body.gravcomp = 0
    model = spec.compile()
    data = mujoco.MjData(model)
    data.joint("base_yaw").qpos[0] = heading
    mujoco.mj_forward(model, data)
    context = replay([])._context
    looks = np.tile(rotation_xyz([0.0, 0.0, heading]), (len(context.time_s), 1, 1))
    turned = replace(context, interface_rotation=looks)
    force = placed_whole("tilt").effect.plant.force(slope[None], turned, Where(STRAP, ()), IMPEDANCE)
    np.testing.assert_allclose(force[0, 0], -data.qfrc_bias[:3], atol=1e-9)
    assert abs(force[0, 0, 2]) > 0.1


@pytest.mark.parametrize(("axis", "turned"), [("0 0 1", 0.0), ("0 0 -1", 0.0), ("0 0 1", 0.6)])
def test_what_a_slope_turns_does_not_hang_on_how_the_base_is_modelled(axis, turned):
    """A base that turns the other way round, and one whose interface looks elsewhere; a post that stands still."""
    text = f"""<mujoco><option gravity="0.3 -0.2 0"/><worldbody>
      <body pos="5 5 0"><geom size="0.1" mass="40"/></body>
      <body pos="1 2 0"><joint name="base_x" type="slide" axis="1 0 0"/><joint name="base_y" type="slide" axis="0 1 0"/>
        <joint name="base_yaw" axis="{axis}"/><geom size="0.1" mass="9" pos="0.1 0 0"/>
        <body name="tool" pos="0.4 0.1 0.5" euler="0 0 {np.degrees(turned)}"><geom size="0.1" mass="2"/></body>
      </body></worldbody></mujoco>"""
    model = mujoco.MjModel.from_xml_string(text)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    mass, moment = mass_on_base(model, "tool")
    context = SimpleNamespace(
        robot=chains.RobotMass(mass, moment),
        interface_rotation=rotation_xyz([[0.0, 0.0, turned]]),
        time_s=np.zeros(1),
        step_time_s=np.zeros(1),
    )
    force = tilt(np.array([[0.3, -0.2]]) / 9.81, context, Where(STRAP, ()), IMPEDANCE)
    np.testing.assert_allclose(force[0, 0], -data.qfrc_bias, atol=1e-9)


def test_dry_friction_holds_without_creeping():
    effect = next(e for e in EFFECTS if e.name == "coulomb")
    placed = [Placed(effect, where, SCALES) for where in effect.places(STRAP)[:3]]
    held = [p.bounds()[1][None] for p in placed]
    paths = [
        replay(placed, step=step, seconds=12).run_effects(PRIOR[None], held)[0] for step in (0.01, 0.0025)
    ]
    # where constraints do not know of the dampers' inertia, a coarse step creeps by centimetres
    assert np.abs(paths[0] - paths[1]).max() < 2e-4


def test_a_base_that_relaxes_slowly_is_a_stiffer_one():
    slow, stiff = placed_whole("base_compliance", "series"), placed_whole("base_compliance")
    share = np.array([0.5, 0.2, 0.8])
    factors = np.stack([np.log1p(share), np.zeros(3)], axis=1).reshape(1, 6)
    one = replay([slow]).run_effects(PRIOR[None], [np.array([[*np.log(share), np.log(1e4)]])])
    other = replay([stiff]).run_effects(PRIOR[None], [factors])
    np.testing.assert_allclose(one[1], other[1], atol=2e-5)


def test_a_base_that_yields_beyond_its_wheels_goes_further_than_they_show(plain):
    placed = placed_whole("base_compliance", "beyond_wheels")
    model = replay([placed])
    _, configured = replay([]).run_effects(PRIOR[None], [])
    away = []
    for ln in (2.0, 3.0, 4.0):
        paths, log = model.run_effects(PRIOR[None], [np.full((1, 3), ln)])
        away.append((np.abs(paths[0] - plain[0][0]).max(), np.abs(log - configured).max()))
    # a stiffer spring is nearer to none, about in proportion
    assert np.all(np.divide(away[:-1], away[1:]) > 2)
    soft, log = model.run_effects(PRIOR[None], [np.zeros((1, 3))])
    moved = [np.ptp(x.mean(axis=1)[:, 0]) for x in (soft[0], plain[0][0])]
    shown = [np.ptp(x[0, :, 0]) for x in (log, configured)]
    assert moved[0] > 1.05 * moved[1]
    assert shown[0] < 0.95 * shown[1]


def test_a_robot_that_rocks_turns_about_the_floor_and_its_log_does_not_show_it(plain):
    placed = placed_whole("base_compliance", "rocking")
    model = replay([placed])
    away = []
    for stiffness in (300.0, 3_000.0, 30_000.0):
        x = np.log([[stiffness, stiffness, 0.1, 1.0]])
        paths, _ = model.run_effects(PRIOR[None], [x])
        away.append(np.abs(paths[0] - plain[0][0]).max())
        plant = model.as_simulated().model
        data = mujoco.MjData(plant)
        joint = plant.joint(f"rocking_pitch_{placed.where.element}")
        data.qpos[joint.qposadr[0]] = 0.01
        mujoco.mj_forward(plant, data)
        assert float(data.qfrc_passive[joint.dofadr[0]]) == pytest.approx(-0.01 * stiffness)
        # ten milliradians about the floor below the base, whose middle the interface is 0.55 m ahead of
        c, sine = 1 - np.cos(0.01), np.sin(0.01)
        expected = [0.95 * sine - 0.55 * c, 0.17, 0.95 * (1 - c) - 0.55 * sine]
        np.testing.assert_allclose(data.site("interface_left").xpos, expected, atol=1e-4)
        assert not any(data.joint(name).qpos[0] for name in ROBOT_JOINTS[1:])
    assert away[0] > 3 * away[1] > 9 * away[2]


def test_a_strap_that_wanders_pulls_by_its_way_from_the_first_motion_on():
    effect = next(e for e in EFFECTS if e.name == "migration" and e.form == "_steady")
    placed = Placed(effect, effect.places(STRAP)[1], SCALES)
    model = replay([placed])
    rate = placed.values(placed.bounds()[1][None])
    force = effect.plant.force(rate, model._context, placed.where, IMPEDANCE)[0, :, 0]
    moves = model._context.time_s[model._context.start]
    since = np.maximum(model._context.step_time_s - moves, 0)
    np.testing.assert_allclose(force, PRIOR[1] * rate[0, 0] * since, rtol=1e-12)
    assert force[0] == 0
    assert force[-1] != 0


def test_a_second_call_does_not_remember_the_first(plain):
    placed = [
        Placed(e, e.places(STRAP)[0], SCALES) for e in EFFECTS if e.name in ("tilt", "lab_yaw", "hysteresis")
    ]
    model = replay(placed)
    x = [p.starts()[:1] for p in placed]
    first, _ = model.run_effects(PRIOR[None], x)
    again, _ = model.run_effects(PRIOR[None], x)
    np.testing.assert_array_equal(first, again)


def test_late_markers_are_the_plain_ones_later(plain):
    effect = next(e for e in EFFECTS if e.name == "sync_offset")
    placed = Placed(effect, effect.places(STRAP)[0], SCALES)
    late, _ = replay([placed]).run_effects(PRIOR[None], [np.array([[0.05]])])
    np.testing.assert_allclose(late[0, 50:], plain[0][0, 45:-5], atol=1e-6)


class Recorded:
    """What a search asks of a trial: markers that were ``late`` [s]."""

    skin, threads = None, 2

    def __init__(self, late: float, held_out: bool):
        self.held_out = held_out
        self.seen = replay([placed_whole("sync_offset")]).run_effects(PRIOR[None], [np.array([[late]])])[0]
        self.samples, self.sensors = self.seen.size, {"markers": 6}

    def replay(self, effects, nsim, coarse=False):
        model = replay(effects, nsim)
        model._context = replace(model._context, held_out=self.held_out)
        return model

    def whitened(self, paths, joints):
        return 2000 * (paths - self.seen).reshape(len(paths), -1)

    def j(self, paths):
        return np.zeros(len(paths))


def test_an_offset_of_each_trial_is_fitted_to_its_own_trial():
    """Two camera groups that are started by hand: the held-out trial says its offset itself, and nothing else."""
    pair = Pair(Recorded(0.05, held_out=False), Recorded(-0.03, held_out=True), about(PRIOR))
    search = Search(pair, CONFIG["diagnosis"]["search"])
    own = placed_whole("sync_offset", "each_trial")
    found = search.fit((own,), np.concatenate([np.log(PRIOR), own.starts()[0]]))
    np.testing.assert_allclose(own.values(found.split()[0][None])[0], [0.05, -0.03], atol=1e-4)
    assert max(found.chi2) < 0.05 * search.samples[0]
    both = placed_whole("sync_offset")
    common = search.fit((both,), np.concatenate([np.log(PRIOR), both.starts()[0]]))
    assert common.chi2[1] > 100 * found.chi2[1]
    of_train, of_other = (
        JointResiduals(trial, (both, own), pair.system).free for trial in (pair.train, pair.held_out)
    )
    assert list(of_train) == list(range(14))
    assert list(of_other) == [14]


def test_a_turned_lab_of_the_interface_gives_back_the_motion_that_it_turned(plain):
    turn = rotation_xyz(np.array([0.0, 0.0, 0.12]))
    pelvis, origin = pelvis_at_start()
    true = np.eye(3), np.array([0.0, 0.0, 0.95])
    seen = turn @ true[0], turn @ true[1]
    # the rest pose was taken in two labs as well
    rest = RestPose(
        pelvis.T @ turn @ pelvis @ REST.rotation,
        pelvis.T @ (turn @ (origin + pelvis @ REST.position) - origin),
    )
    model = replay([placed_whole("lab_yaw", "interface")], seen=seen, rest=rest)
    paths, joints = model.run_effects(PRIOR[None], [np.array([[0.12]])])
    np.testing.assert_allclose(paths[0], plain[0][0] @ turn.T, atol=1e-9)
    # the log is laid on the interface's markers
    _, own = replay([]).run_effects(PRIOR[None], [])
    np.testing.assert_allclose(joints[0, :, :2], own[0, :, :2] @ turn[:2, :2].T, atol=1e-9)
    np.testing.assert_allclose(joints[0, :, 2:], own[0, :, 2:], atol=1e-9)


def test_the_bone_is_found_under_markers_that_each_slide_their_own_way():
    """Skin moves each marker by up to 60 mm per radian (SD), the largest published: 30 mm and 10 degrees here."""
    rng = np.random.default_rng(3)
    time = np.linspace(0, 20, 1000)
    angles = 0.25 * np.sin(2 * np.pi * np.outer(time, [0.3, 0.5, 0.4]))
    found, without, plain = _find_bone(rng, angles, 0.06)
    assert found < 0.04 * plain
    # what the markers show of each other is used: a rigid set with the same numbers is several times as wrong
    assert found < 0.25 * without


def test_skin_that_leaves_no_bone_to_be_driven_is_no_simulation():
    """Values within their bounds whose bone turns by more than can be driven: beside others that can be simulated."""
    skin = placed_whole("soft_tissue")
    far = np.concatenate([np.zeros(9), (-0.99 * np.eye(3)).ravel()])
    x = skin.searched(np.array([far, np.zeros(18)]))
    paths, _ = replay([skin], nsim=2).run_effects(np.tile(PRIOR, (2, 1)), [x])
    assert np.isnan(paths[0]).any()
    np.testing.assert_allclose(paths[1], replay([]).run_effects(PRIOR[None], [])[0][0], atol=1e-9)


def test_the_bone_of_a_person_who_turns_round_is_found():
    """Up to 150 degrees to the left, on skin that slides by 10 mm per radian."""
    rng = np.random.default_rng(4)
    angles = (
        0.2 * np.sin(np.outer(np.linspace(0, 40, 1000), [1.0, 2.0, 0.0]))
        + [0.0, 0.0, 1.0] * np.linspace(0, 2.6, 1000)[:, None]
    )
    found, _, plain = _find_bone(rng, angles, 0.01)
    assert found < 0.04 * plain


def _find_bone(rng: np.random.Generator, angles: np.ndarray, slide: float) -> tuple[float, float, float]:
    """Return how far the bone is off [m, RMS] by the chain, by it without marker shapes, and where it was seen.

    The bone has Cardan angles (n, 3) [rad]; skin moves each of its markers by ``slide`` [m/rad] (SD) times these.
    """
    shape = np.array([[0.0, 0.13, 0.0], [0.0, -0.13, 0.0], [-0.17, 0.045, 0.005], [-0.17, -0.05, -0.005]])
    bone = REST.rotation @ Rotation.from_euler("ZYX", angles[:, ::-1]).as_matrix()
    position = rng.standard_normal(3) + 0.1 * angles
    ways = slide * rng.standard_normal((4, 3, 3))
    on_bone = shape + np.einsum("kij,nj->nki", ways, angles)
    markers = position[:, None] + np.einsum("nij,nkj->nki", bone, on_bone)
    rotation, origin = pelvis_frame(*np.moveaxis(markers, 1, 0))
    mean = on_pelvis(markers).mean(axis=0)
    by_turn = skin_by_turn(rotation, on_pelvis(markers), mean)
    away = shape - shape.mean(axis=0)
    inertia = np.sum(away**2) * np.eye(3) - away.T @ away
    turn = np.linalg.solve(inertia, np.cross(away[:, :, None], ways, axisa=1, axisb=1, axisc=1).sum(axis=0))
    values = np.concatenate([ways.mean(axis=0).ravel(), turn.ravel()])
    off = []
    for number, shown in ((values, by_turn), (values, None), (0 * values, None)):
        shapes = chains.MarkerShapes(mean, np.zeros((2, 3)), shown)
        context = SimpleNamespace(pelvis_rotation=rotation, pelvis_position=origin, shapes=shapes)
        r, p = tissue.soft_tissue(number, context)
        # of a point of the pelvis 0.2 m away along each axis
        lever = 0.2 * (r - bone)
        off.append(float(np.sqrt(np.mean((p - position) ** 2) + np.mean(lever**2))))
    return off[0], off[1], off[2]


def test_markers_off_their_centres_give_back_the_motion_of_the_centres(plain):
    offsets = np.array([[0.012, -0.004, 0.008], [-0.005, 0.015, 0.003]])
    pelvis, origin = pelvis_at_start()
    position = np.array([0.0, 0.0, 0.95])
    centres = position + np.array([[0.0, HALF, 0.0], [0.0, -HALF, 0.0]])
    seen = interface_frame(*(centres + offsets))
    # in the neutral trial the interface was where REST says
    level = pelvis @ REST.rotation
    at_rest = origin + pelvis @ REST.position + HALF * np.array([level[:, 1], -level[:, 1]])
    rotation, middle = interface_frame(*(at_rest + offsets @ level.T), level[:, 2])
    rest = RestPose(pelvis.T @ rotation, pelvis.T @ (middle - origin))
    apart = np.array([0.0, 2 * HALF, 0.0]) + offsets[0] - offsets[1]
    half = float(np.linalg.norm(apart)) / 2
    model = replay([placed_whole("marker_offset")], seen=seen, half=half, rest=rest)
    paths, _ = model.run_effects(PRIOR[None], [offsets.reshape(1, 6)])
    length = np.linalg.norm(paths[0, :, 0] - paths[0, :, 1], axis=1)
    np.testing.assert_allclose(length, 2 * half, atol=1e-9)
    wrong = np.abs(replay([], seen=seen, rest=rest).run_effects(PRIOR[None], [])[0][0] - plain[0][0]).max()
    middle_path = paths[0].mean(axis=1) - plain[0][0].mean(axis=1)
    assert wrong > 0.01
    # what is left is the mean offset, turned with the interface, but for its pitch, which two markers do not show
    left = np.linalg.norm(middle_path, axis=1)
    np.testing.assert_allclose(left, np.linalg.norm(offsets.mean(axis=0)), atol=1e-5)


def test_a_start_out_of_reach_leaves_the_other_simulations_alone(monkeypatch):
    model = replay([placed_whole("marker_offset"), placed_whole("sync_offset")], nsim=3)
    offsets = np.array([[0.0, 0.01, 0.0, 0.0, -0.01, 0.0]])
    x = [offsets * [[1.0], [1.5], [0.5]], np.full((3, 1), 0.03)]
    whole, _ = model.run_effects(np.tile(PRIOR, (3, 1)), x)
    asked = iter([False, True, False])

    def reach(*pose):
        if next(asked):
            raise ValueError("too far")
        return robot_pose_for(*pose)

    monkeypatch.setattr("real2sim.effects.replay.robot_pose_for", reach)
    paths, joints = model.run_effects(np.tile(PRIOR, (3, 1)), x)
    assert np.isnan(paths[1]).all()
    np.testing.assert_array_equal(paths[[0, 2]], whole[[0, 2]])
    assert np.isfinite(joints[[0, 2]]).all()


def test_a_pelvis_that_was_seen_elsewhere_is_there_from_the_start():
    """A jump at the first step would hit the robot through the strap's damping."""
    model = replay([placed_whole("lab_yaw")], seconds=1.0, neutral_at=np.array([0.5, 0.3, 0.0]))
    _, joints = model.run_effects(PRIOR[None], [np.array([[0.05]])])
    # 29 mm from where it was seen: the strap pulls, and the robot takes its time
    assert np.abs(joints[0, :3, :2]).max() < 2e-3


def test_a_strap_that_is_one_sided_from_the_origin_on_has_two_slopes():
    share = 0.6
    one_sided, asymmetric = (
        next(e for e in EFFECTS if e.name == name and not e.form)
        for name in ("one_sided", "asymmetric_stiffness")
    )
    upper = Placed(
        one_sided, next(w for w in one_sided.places(STRAP) if w.axes == (1,) and w.side == 1), SCALES
    )
    slopes = Placed(asymmetric, asymmetric.places(STRAP)[1], SCALES)
    model = replay([upper])
    first, _ = model.run_effects(PRIOR[None], [np.array([[0.0, share]])])
    mean = PRIOR.copy()
    mean[1] *= 1 - share / 2
    other, _ = replay([slopes]).run_effects(mean[None], [np.array([[share / (2 - share)]])])
    np.testing.assert_allclose(first, other, atol=1e-9)


def test_noise_of_the_measured_coordinate_hardly_moves_a_strap_with_hysteresis():
    """Springs answer to the simulated motion; planned as a whole, the law would make a force of the noise."""
    effect = next(e for e in EFFECTS if e.form == "_bouc_wen")
    whole = replace(
        effect,
        plant=PlannedForce(
            lambda v, context, where, p: (
                -bouc_wen(
                    v, np.interp(context.step_time_s, context.time_s, context.coordinates[:, where.axes[0]])
                )[:, :, None]
            )
        ),
    )
    x = [np.array([[np.log(8.0), 10.0, 3.0]])]
    rng = np.random.default_rng(0)
    noise = np.zeros((300, 6))
    noise[:, 1] = 5e-4 * rng.standard_normal(300)
    shaken = []
    for kind in (effect, whole):
        placed = Placed(kind, kind.places(STRAP)[1], SCALES)
        paths = [
            replay([placed], noise=n[: len(noise)]).run_effects(PRIOR[None], x)[0] for n in (noise, 0 * noise)
        ]
        shaken.append(np.abs(paths[0] - paths[1]).max())
    assert shaken[0] < 0.3 * shaken[1]


def test_a_turned_rest_pose_is_that_of_the_coordinates_whatever_the_order():
    turned = next(e for e in EFFECTS if (e.name, e.form) == ("preload", "_turned"))
    about = [Placed(turned, where, SCALES) for where in turned.places(STRAP)]
    angles = np.array([0.04, -0.05, 0.06])
    for order in ([0, 1, 2], [2, 0, 1]):
        model = replay([about[i] for i in order])
        x = [np.array([[angles[i] / SCALES.q[3 + i]]]) for i in order]
        model.run_effects(PRIOR[None], x)
        turn = Rotation.from_euler("XYZ", angles).as_matrix()
        np.testing.assert_allclose(
            model._sights[0].rest.rotation, turn @ model._start_pose.rest.rotation, atol=1e-12
        )


def test_a_rest_pose_turned_by_little_is_a_spring_that_rests_elsewhere(plain):
    forms = [e for e in EFFECTS if e.name == "preload"]
    shifted, turned = (
        replay([p]).run_effects(PRIOR[None], [np.array([[0.01]])])[0][0]
        for p in (Placed(e, next(w for w in e.places(STRAP) if w.axes == (5,)), SCALES) for e in forms)
    )
    assert np.abs(shifted - plain[0][0]).max() > 1e-5
    assert np.abs(turned - shifted).max() < 0.05 * np.abs(shifted - plain[0][0]).max()


def test_an_admittance_is_a_reaction_and_what_it_has_kept_of_the_force():
    steps, h, before = 400, 0.01, np.zeros((2, 2))
    values = np.array([[0.4, 0.4, 0.0, 0.0, 2.0, 0.05], [0.0, 0.0, 0.5, 0.2, 2.0, 0.0]])
    pull = np.zeros((2, steps, 2))
    pull[:, 100:, 0] = 10.0
    both = Admittance(values, before, h).force(pull, keep=False)
    plain = Reaction(np.array([[0.4, 0.0, 0.05]]), before[:1], h).force(pull[:1], keep=False)
    np.testing.assert_allclose(both[0], plain[0], atol=1e-12)
    # a force of 10 N along x, that leaks over 2 s
    assert both[1, -1, 0] == pytest.approx(0.5 * 10 * 2.0 * (1 - np.exp(-3.0 / 2.0)), rel=1e-6)


@pytest.mark.parametrize("delay", [0.0, 0.03])
def test_a_controller_answers_alike_in_windows_of_any_length(delay):
    steps, h, before = 60, 0.01, np.array([[3.0, -1.0]])
    values = np.array([[0.4, delay, 0.05]])
    pull = np.cumsum(np.random.default_rng(2).normal(size=(1, steps, 2)), axis=1)
    # step by step: what was heard a delay ago, through the low-pass
    late = np.concatenate([np.repeat(before[:, None], round(delay / h), axis=1), pull], axis=1)[:, :steps]
    state, expected = before, []
    for k in range(steps):
        state = np.exp(-h / 0.05) * state + (1 - np.exp(-h / 0.05)) * late[:, k]
        expected.append(0.4 * state)
    for count in (2, 3):
        answer = Answer(Reaction(values, before, h), before, h, steps)
        for first in range(0, steps, count):
            window = pull[:, first : first + count]
            planned = answer.plan(count)
            if answer.foreseen >= count and first >= count:
                np.testing.assert_allclose(
                    planned[0], np.array(expected)[first : first + count, 0], atol=1e-12
                )
            answer.learn(window)
        # what it has learnt is all of it: the next steps of a force that stays
        kept = answer._law._felt._state
        np.testing.assert_allclose(0.4 * kept, expected[-1], atol=1e-12)


def test_a_hold_with_an_integral_term_gathers_where_the_base_is_up_to_its_limit():
    steps, h = 1000, 0.01
    values = np.array([[60.0, 120.0, 12.0, 500.0, 6.0, 500.0]])
    away = np.tile([0.02, -0.03, 0.0], (1, steps, 1))
    law = HoldIntegral(values, np.zeros((1, 3)), h)
    force = law.force(away, keep=True)[0]
    # pulled back by r x t, and on the other axis up to the limit, from which it returns without winding up
    assert force[-1, 0] == pytest.approx(-60 * 0.02 * 10.0, rel=0.01)
    assert 0.9 * 6 < force[-1, 1] < 6
    assert not force[:, 2].any()
    back = law.force(-away, keep=True)[0]
    assert back[99, 1] == pytest.approx(force[-1, 1] - 120 * 0.03 * 1.0, rel=0.02)


def test_a_hold_with_an_integral_term_brings_the_base_back():
    """7 N along x beside it: without it the base gives way by force over stiffness, with it hardly at the end."""
    tilt, hold = placed_whole("tilt"), placed_whole("controller_reaction", "hold_integral")
    slope = np.array([[0.007, 0.0]]) / tilt.values(np.ones((1, 2)))
    still = np.zeros((2000, 6))
    x = np.array([[150.0, 300.0, 60.0, np.log(500.0), np.log(500.0), np.log(100.0)]])
    _, plain = replay([tilt], motion=still).run_effects(PRIOR[None], [slope])
    _, held = replay([tilt, hold], motion=still).run_effects(PRIOR[None], [slope, x])
    assert abs(plain[0, -1, 0]) > 1e-3
    assert abs(held[0, -1, 0]) < 0.2 * abs(plain[0, -1, 0])


def test_play_beyond_the_wheels_is_not_seen_by_the_log():
    """Beyond half of the play the base takes its wheels along; within it, they hardly move."""
    play = placed_whole("base_compliance", "play")
    stiff, half = np.full(3, 5.0), np.array([0.004, 0.004, 0.01])
    x = np.concatenate([stiff, np.log(half)])[None]
    motion = smooth_motion(6.0)
    paths, seen = replay([play], motion=motion).run_effects(PRIOR[None], [x])
    base = paths[0].mean(axis=1)[:, 0] - paths[0, 0, :, 0].mean()
    gap = np.abs(base - seen[0, :, 0])
    assert gap.max() > 0.003
    assert np.abs(seen[0, :, 0]).max() > 1e-3


def test_an_answer_hears_the_strap_late_and_the_mean_of_standing_until_then():
    rng = np.random.default_rng(0)
    steps, h, before = 60, 0.01, np.array([[3.0, -2.0]])
    pull = np.cumsum(rng.standard_normal((1, steps, 2)), axis=1)
    values = np.array([[-0.5, 0.105, 0.04]])
    answer, got = Answer(Reaction(values, before, h), before, h, steps), []
    for first in range(0, steps, 7):
        count = min(7, steps - first)
        got.append(answer.plan(count))
        answer.learn(pull[:, first : first + count])
    time, decay = h * np.arange(steps), np.exp(-h / 0.04)
    for axis in range(2):
        late = np.interp(time - 0.105, time, pull[0, :, axis], left=before[0, axis])
        expected = lfilter([1 - decay], [1, -decay], late, zi=[decay * before[0, axis]])[0]
        np.testing.assert_allclose(np.concatenate(got, axis=1)[0, :, axis], -0.5 * expected, atol=1e-9)


def test_an_answer_without_a_delay_takes_the_strap_to_go_straight_on():
    steps, h = 40, 0.01
    line = np.zeros((1, steps, 2)) + np.arange(steps)[:, None]
    answer = Answer(Reaction(np.array([[1.0, 0.0, 0.0]]), line[:, 0], h), line[:, 0], h, steps)
    for first in range(0, steps, 5):
        planned = answer.plan(5)
        # of the first window nothing is known but what was before
        expected = line[:, first : first + 5] if first else 0 * planned
        np.testing.assert_allclose(planned, expected, atol=1e-9)
        answer.learn(line[:, first : first + 5])


def test_a_late_answer_is_the_same_in_windows_as_long_as_its_delay(monkeypatch):
    effect = next(e for e in EFFECTS if e.name == "controller_reaction" and not e.form)
    placed = Placed(effect, effect.places(STRAP)[0], SCALES)
    values = [np.array([[0.8, 0.105, 0.03], [-0.5, 0.23, 0.0]])]
    calls, rollout = [], mujoco.batch.Batch.rollout

    def counted(batch: mujoco.batch.Batch, steps: int, *args, **options):
        calls.append(steps)
        return rollout(batch, steps, *args, **options)

    monkeypatch.setattr(mujoco.batch.Batch, "rollout", counted)
    parameters = np.tile(PRIOR, (2, 1))
    long, _ = replay([placed], nsim=2).run_effects(parameters, values)
    in_long = len(calls)
    monkeypatch.setattr(Answer, "foreseen", 0)
    short, _ = replay([placed], nsim=2).run_effects(parameters, values)
    assert len(calls) - in_long > 4 * in_long
    np.testing.assert_allclose(long, short, atol=1e-9)


def test_a_reaction_answers_the_force_of_the_strap_whatever_law_that_has():
    """Slack beside a reaction was never found: the reaction answered a force as if there were none."""
    by_name = {e.name: e for e in EFFECTS if not e.form}
    placed = [
        Placed(by_name["controller_reaction"], by_name["controller_reaction"].places(STRAP)[0], SCALES),
        Placed(by_name["slack"], by_name["slack"].places(STRAP)[0], SCALES),
        Placed(by_name["preload"], by_name["preload"].places(STRAP)[0], SCALES),
        Placed(by_name["migration"], by_name["migration"].places(STRAP)[0], SCALES),
    ]
    model = replay(placed, seconds=4)
    wide, shift, gain, delay, smoothing = 0.02, 0.01, -0.3, 0.1, 0.02
    x = [
        [gain, delay, smoothing],
        [np.log(wide / SCALES.q[0])],
        [shift / SCALES.q[0]],
        [np.log(0.02), np.log(0.5)],
    ]
    model.run_effects(PRIOR[None], [np.array([row]) for row in x])
    planned = model._control[0, :, model._columns_of[3][0]]
    # the same from the coordinates of the simulation: markers, pelvis and rest pose
    data, q, qd = mujoco.MjData(model.model), [], []
    state = model.as_simulated()
    data.qpos[:], data.qvel[:] = state.position, state.velocity
    joints = [model.model.joint(f"strap_{axis}") for axis in ("tx", "ty", "tz")]
    for command in state.control:
        data.ctrl[:] = command
        q.append([float(data.qpos[j.qposadr[0]]) for j in joints])
        qd.append([float(data.qvel[j.dofadr[0]]) for j in joints])
        mujoco.mj_step(state.model, data)
    pulled = np.array(q)
    beyond = pulled[:, 0] - shift
    pulled[:, 0] = np.sign(beyond) * np.maximum(np.abs(beyond) - wide, 0)
    assert np.abs(pulled[:, 0]).max() > 0.005
    force = -PRIOR[:3] * pulled - PRIOR[6:9] * np.array(qd)
    force[:, 0] += planned
    world = np.einsum("nij,nj->ni", model._context.pelvis_rotation, force)
    time, decay = model._context.time_s, np.exp(-0.01 / smoothing)
    for axis, column in enumerate(model._columns_of[0]):
        # from the first sample alone, a jolt of the simulation, it would go on with that
        before = world[: model._context.start, axis].mean()
        late = np.interp(time - delay, time, world[:, axis], left=before)
        expected = gain * lfilter([1 - decay], [1, -decay], late, zi=[decay * before])[0]
        np.testing.assert_allclose(state.control[:, column], expected, atol=0.02 * np.abs(expected).max())


def test_a_reaction_begins_with_what_the_strap_does_while_the_person_stands():
    """From nothing, or from the first sample, a jolt of the simulation, it would start the trial with a push."""
    by_name = {e.name: e for e in EFFECTS if not e.form}
    placed = [
        Placed(by_name[n], by_name[n].places(STRAP)[0], SCALES) for n in ("controller_reaction", "preload")
    ]
    model = replay(placed, seconds=1)
    gain, delay, shift = 0.5, 0.2, 0.03
    model.run_effects(PRIOR[None], [np.array([[gain, delay, 0.1]]), np.array([[shift / SCALES.q[0]]])])
    applied = model.as_simulated().control[:, model._columns_of[0][0]]
    # the strap is stretched by the shift, and the robot has moved by little so soon
    assert applied[0] == pytest.approx(gain * PRIOR[0] * shift, rel=0.3)
    np.testing.assert_allclose(applied[:20], applied[0], rtol=1e-9)


def test_a_reaction_hears_the_bristles_of_a_friction():
    """They are an actuator of MuJoCo's, and no passive force; without them a true pair left 9760 instead of 3489."""
    by_name = {e.name: e for e in EFFECTS if not e.form}
    placed = [
        Placed(by_name[n], by_name[n].places(STRAP)[0], SCALES) for n in ("controller_reaction", "lugre")
    ]
    model = replay(placed, seconds=3)
    gain, force = 0.4, 8.0
    law = [force / SCALES.force[0], 0.5, 0.002 / SCALES.q[0], 0.01 / SCALES.v[0]]
    model.run_effects(PRIOR[None], [np.array([[gain, 0.0, 0.0]]), np.log(np.array([law]))])
    state, data = model.as_simulated(), mujoco.MjData(model.model)
    felt, bristles = [], []
    data.qpos[:], data.qvel[:] = state.position, state.velocity
    rotation, joints = model._context.pelvis_rotation, [model.model.joint(n) for n in STRAP_JOINTS[:3]]
    for command, turned in zip(state.control, rotation, strict=True):
        data.ctrl[:] = command
        q, qd = (
            np.array([float(getattr(data.joint(j.name), x)[0]) for j in joints]) for x in ("qpos", "qvel")
        )
        mujoco.mj_step(state.model, data)
        bristles.append(float(data.actuator(f"bristles_{placed[1].where.element}").force[0]))
        felt.append(turned @ (np.array([bristles[-1], 0, 0]) - PRIOR[:3] * q - PRIOR[6:9] * qd))
    applied = state.control[:, model._columns_of[0]]
    expected = gain * np.array(felt)[:, :2]
    assert np.abs(bristles).max() > 0.5 * force
    # a window late at most, and taken to go straight on
    np.testing.assert_allclose(applied[40:], expected[40:], atol=0.1 * np.abs(expected).max())


def test_a_quadratic_spring_goes_straight_on_along_its_tangent():
    effect = next(e for e in EFFECTS if e.form == "_quadratic")
    placed = Placed(effect, effect.places(STRAP)[0], SCALES)
    model = replay([placed])
    k, b, end = PRIOR[0], -4000.0, 0.02
    x = np.array([[b * SCALES.q[0] / SCALES.k[0], np.log(end / SCALES.q[0])]])
    np.testing.assert_allclose(placed.values(x), [[b, end]])
    model.run_effects(PRIOR[None], [x])
    plant = model.as_simulated().model
    data = mujoco.MjData(plant)
    joint = plant.joint("strap_tx")
    for q in (-0.05, -0.02, -0.01, 0.0, 0.01, 0.02, 0.05):
        data.qpos[joint.qposadr[0]] = q
        mujoco.mj_forward(plant, data)
        even = b * q**2 if abs(q) < end else b * end * (2 * abs(q) - end)
        assert data.qfrc_spring[joint.dofadr[0]] == pytest.approx(-(k * q + even), abs=1e-9)


@pytest.mark.parametrize("side", [1, -1])
def test_a_gentle_stop_pushes_with_the_square_of_what_is_beyond(side):
    effect = next(e for e in EFFECTS if e.form == "_gentle")
    where = next(w for w in effect.places(STRAP) if w.axes == (0,) and w.side == side)
    placed = Placed(effect, where, SCALES)
    model = replay([placed])
    x = placed.starts()[:1]
    place, curvature = placed.values(x)[0]
    model.run_effects(PRIOR[None], [x])
    for beyond in (-1.5 * place, -0.5 * place, 0.01, 0.03):
        q = side * (place + beyond)
        pushes = -side * curvature * max(beyond, 0.0) ** 2
        assert at_rest_on(model, "strap_tx", q) == pytest.approx(-PRIOR[0] * q + pushes, abs=1e-9)


@pytest.mark.parametrize("name", ["slack", "one_sided", "asymmetric_stiffness", "stiffening", "joint_limit"])
def test_a_strap_that_rests_elsewhere_takes_its_other_laws_along(name):
    law, rest = (next(e for e in EFFECTS if e.name == n) for n in (name, "preload"))
    law, rest = (Placed(e, e.places(STRAP)[0], SCALES) for e in (law, rest))
    own, shift = law.starts()[:1], 0.5 * SCALES.q[0]
    alone = replay([law])
    alone.run_effects(PRIOR[None], [own])
    beside = replay([rest, law])
    # called twice: shifts do not add up
    for _ in range(2):
        beside.run_effects(PRIOR[None], [np.array([[shift / SCALES.q[0]]]), own])
    for q in np.linspace(-1.4, 1.4, 9) * SCALES.q[0]:
        # a stop imposes a little of the acceleration, which hangs on the pose too
        expected = at_rest_on(alone, "strap_tx", q)
        assert at_rest_on(beside, "strap_tx", q + shift) == pytest.approx(expected, rel=1e-2, abs=1e-9)


def test_a_turned_law_is_the_turned_matrices():
    effect = next(e for e in EFFECTS if (e.name, e.form) == ("misalignment", "law"))
    model = replay([Placed(effect, effect.places(STRAP)[0], SCALES)])
    vector = np.array([0.1, -0.3, 0.2])
    placed = model.effects[0]
    x = (vector / placed.values(np.ones((1, 3)))[0])[None]
    np.testing.assert_allclose(placed.values(x)[0], vector)
    model.run_effects(PRIOR[None], [x])
    turn = np.kron(np.eye(2), Rotation.from_rotvec(vector).as_matrix())
    stiffness, damping = (turn @ np.diag(part) @ turn.T for part in (PRIOR[:6], PRIOR[6:]))
    plant = model.as_simulated().model
    data = mujoco.MjData(plant)
    q, qd = np.array([0.02, -0.01, 0.03, 0.1, -0.2, 0.15]), np.array([0.1, 0.3, -0.2, 0.5, 1.0, -0.7])
    joints = [plant.joint(f"strap_{axis}") for axis in AXES]
    dofs = [j.dofadr[0] for j in joints]
    data.qpos[[j.qposadr[0] for j in joints]] = q
    data.qvel[dofs] = qd
    mujoco.mj_forward(plant, data)
    np.testing.assert_allclose(data.qfrc_spring[dofs], -stiffness @ q, rtol=1e-9)
    np.testing.assert_allclose(data.qfrc_damper[dofs], -damping @ qd, rtol=1e-9)


def test_both_forms_of_misalignment_agree_where_little_is_turned(plain):
    forms = [Placed(e, e.places(STRAP)[0], SCALES) for e in EFFECTS if e.name == "misalignment"]
    axes, law = (
        replay([p]).run_effects(PRIOR[None], [np.full((1, 3), 0.01)])[0][0] - plain[0][0] for p in forms
    )
    assert np.abs(axes).max() > 1e-6
    assert np.abs(axes - law).max() < 0.2 * np.abs(axes).max()


def test_a_stop_pushes_back_and_pulls_no_one():
    effect = next(e for e in EFFECTS if e.name == "joint_limit")
    placed = Placed(effect, next(w for w in effect.places(STRAP) if w.axes == (1,) and w.side < 0), SCALES)
    model = replay([placed])
    x = np.array([[np.log(0.5), np.log(20.0), 0.5]])
    place, *_ = placed.values(x)[0]
    model.run_effects(PRIOR[None], [x])
    plant = undriven(model)
    data = mujoco.MjData(plant)
    joint = plant.joint("strap_ty")

    def push(q: float, rate: float) -> float:
        data.qpos[joint.qposadr[0]], data.qvel[joint.dofadr[0]] = q, rate
        mujoco.mj_forward(plant, data)
        return float(data.qfrc_constraint[joint.dofadr[0]])

    assert push(-0.99 * place, -1.0) == 0
    near, far = push(-1.1 * place, 0.0), push(-1.2 * place, 0.0)
    assert far == pytest.approx(2 * near, rel=0.3)
    assert push(-1.1 * place, -0.1) > near
    # leaving faster than the spring follows
    assert push(-1.1 * place, 10.0) == 0


@pytest.mark.parametrize("form", ["", "_soft"])
def test_slack_leaves_the_strap_without_force_inside(form):
    """Inside the dead band a strap without damping does not move a robot that stands still."""
    effect = next(e for e in EFFECTS if (e.name, e.form) == ("slack", form))
    loose = [Placed(effect, where, SCALES) for where in effect.places(STRAP)]
    parameters = PRIOR.copy()
    parameters[6:] = 1e-6
    model = replay(loose)
    wide = [np.array([[np.log(20.0), 0.3][: len(effect.parameters)]])] * 6
    paths, joints = model.run_effects(parameters[None], wide)
    assert np.abs(joints).max() < 1e-4
    assert np.abs(paths[0] - paths[0, 0]).max() < 1e-4


def test_soft_slack_takes_up_its_load_little_by_little():
    effect = next(e for e in EFFECTS if (e.name, e.form) == ("slack", "_soft"))
    model = replay([Placed(effect, effect.places(STRAP)[0], SCALES)])
    x = np.array([[np.log(0.4), 0.5]])
    model.run_effects(PRIOR[None], [x])
    plant = undriven(model)
    data = mujoco.MjData(plant)
    joint = plant.joint("strap_tx")
    width = 0.4 * SCALES.q[0]
    for q in (0.0, 0.6 * width, 1.2 * width, -1.2 * width, 3 * width):
        data.qpos[joint.qposadr[0]] = q
        mujoco.mj_forward(plant, data)
        parts = [max(abs(q) - width * part, 0) for part in (0.5, 1.0, 1.5)]
        expected = -PRIOR[0] * np.sign(q) * np.mean(parts)
        assert float(data.qfrc_passive[joint.dofadr[0]]) == pytest.approx(expected, abs=1e-9)


def test_an_eyring_dashpot_flows_by_its_law_at_small_and_at_large_stretch():
    step, seconds = 0.002, 6.0
    q = 0.5 * np.arange(0, seconds, step)
    stiffness, time, length = 700.0, 1.2, 0.004
    r = 2 * length / (time * np.sinh(2.0))
    force = eyring(np.array([[stiffness, time, length]]), q, step)[0]
    # at a steady rate the spring is stretched until the dashpot follows
    assert force[-1] == pytest.approx(stiffness * length * np.arcsinh(0.5 / r), rel=0.03)
    # stretched by a fraction of its length it is linear
    little = 1e-5 * np.sin(np.arange(0, seconds, step))
    slow = maxwell(np.array([[stiffness, length / r]]), little, step)
    np.testing.assert_allclose(eyring(np.array([[stiffness, time, length]]), little, step), slow, atol=1e-8)
    # let alone at two lengths it begins to fade as the linear one of its time constant does
    jump = np.where(np.arange(0, 0.1, step) > 0, 2 * length, 0.0)
    both = (
        eyring(np.array([[stiffness, time, length]]), jump, step)[0],
        maxwell(np.array([[stiffness, time]]), jump, step)[0],
    )
    assert both[0][2] - both[0][1] == pytest.approx(both[1][2] - both[1][1], rel=0.02)


def test_what_a_flowing_branch_plans_is_what_it_differs_from_its_linear_one():
    """Along the measured coordinate: nothing for a branch that is never stretched far from two lengths' flow."""
    model = replay([])
    context, where = model._context, Where(STRAP, (1,), 0, "_flow", "relaxation")
    flow = next(e for e in EFFECTS if (e.name, e.form) == ("relaxation", "_flow")).plant
    values = np.array([[900.0, 0.4, 0.004], [900.0, 0.4 * 2.0 / np.sinh(2.0), 10.0]])
    planned = flow.force(
        values, context, where, InterfaceImpedance(np.tile(PRIOR[:6], (2, 1)), np.tile(PRIOR[6:], (2, 1)))
    )
    assert planned.shape == (2, len(context.step_time_s), 1)
    q = np.interp(context.step_time_s, context.time_s, context.coordinates[:, 1])
    step = context.step_time_s[1] - context.step_time_s[0]
    branch = maxwell(values[:, :2], q, step) - planned[:, :, 0]
    np.testing.assert_allclose(branch, eyring(values, q, step), atol=0.02 * np.abs(branch).max())
    # the long one is linear, with the time constant of small stretches
    np.testing.assert_allclose(branch[1], maxwell(np.array([[900.0, 0.4]]), q, step)[0], atol=1e-3)


def test_a_robot_that_starts_elsewhere_is_a_start_pose_that_was_misjudged(plain):
    placed = Placed(strap_evidence._START, strap_evidence._START.place(STRAP), SCALES)
    moved = replay([placed], nsim=2)
    x = np.zeros((2, 6))
    x[1] = [2e-3, -1e-3, 3e-3, 0.0, 0.0, 0.004]
    paths, _ = moved.run_effects(np.tile(PRIOR, (2, 1)), [x])
    np.testing.assert_allclose(paths[0], plain[0][0], atol=1e-9)
    turn = Rotation.from_rotvec(x[1, 3:]).as_matrix()
    asked = replay([], seen=(turn @ LEVEL[0], LEVEL[1] + x[1, :3])).run_effects(PRIOR[None], [])[0][0]
    np.testing.assert_allclose(paths[1], asked, atol=1e-7)


def test_a_lag_is_exact_far_from_none():
    lag = next(e for e in EFFECTS if e.name == "replay_lag")
    model = replay([Placed(lag, lag.places(STRAP)[0], SCALES)])
    changes = model._changes[0]
    late = np.array([0.061])
    asked = servo_command(
        _drive_for(model.drive, model._context, *timing.earlier_pelvis(late, model._context))
    )
    told = servo_command(model.drive) + changes.commands(late[None])[0]
    # where the path ends it has a corner
    np.testing.assert_allclose(told[20:-20], asked[20:-20], atol=2e-5)
    basis = changes.chain.basis
    np.testing.assert_allclose(
        basis.weights(basis.nodes[[3]][None])[0], np.eye(len(basis.nodes))[3], atol=1e-9
    )


def test_a_pelvis_that_is_early_is_an_offset_of_all_the_rest_and_no_lag_of_the_replay():
    lag = next(e for e in EFFECTS if e.name == "replay_lag")
    offset = next(e for e in EFFECTS if e.form == "with_log")
    for effect in (lag, offset):
        assert Placed(effect, effect.places(STRAP)[0], SCALES).bounds()[0] == [0.0]
    context = replay([])._context
    early = offset.chains.input(np.array([0.03]), context)
    back = lag.chains.input(
        np.array([0.03]), replace(context, pelvis_rotation=early[0], pelvis_position=early[1])
    )
    np.testing.assert_allclose(back[1][10:-10], context.pelvis_position[10:-10], atol=1e-5)


def test_a_column_that_bends_carries_the_arm_and_its_log_does_not_show_it(plain):
    placed = placed_whole("base_compliance", "column")
    model = replay([placed])
    away = []
    for stiffness in (300.0, 3_000.0, 30_000.0):
        paths, _ = model.run_effects(PRIOR[None], [np.log([[stiffness, 2 * stiffness, 0.03]])])
        away.append(np.abs(paths[0] - plain[0][0]).max())
        plant = model.as_simulated().model
        data = mujoco.MjData(plant)
        bends = [plant.joint(f"bending_{axis}_{placed.where.element}") for axis in "xy"]
        for joint in bends:
            data.qpos[joint.qposadr[0]] = 0.01
        mujoco.mj_forward(plant, data)
        force = data.qfrc_passive[[joint.dofadr[0] for joint in bends]]
        np.testing.assert_allclose(force, [-0.01 * stiffness, -0.02 * stiffness])
        np.testing.assert_allclose(data.site("interface_left").xpos, [0.01, 0.18, 0.95], atol=1e-12)
        # the column stands on the base: it does not turn with the arm that it carries
        data.qpos[plant.joint("arm_pitch").qposadr[0]] = 0.3
        mujoco.mj_kinematics(plant, data)
        bent = data.site("interface_left").xpos.copy()
        data.qpos[bends[0].qposadr[0]] = 0.03
        mujoco.mj_kinematics(plant, data)
        np.testing.assert_allclose(data.site("interface_left").xpos - bent, [0.02, 0.0, 0.0], atol=1e-12)
    assert away[0] > 3 * away[1] > 9 * away[2]


def test_markers_on_the_strap_go_a_part_of_the_way_with_the_person():
    placed = placed_whole("marker_offset", "on_strap")
    part = np.array([0.3, 0.2, 0.0])
    context = replay([])._context
    shift = np.array([0.004, -0.003, 0.002])
    rng = np.random.default_rng(3)
    robot = context.pelvis_position[:, None] + np.einsum(
        "nij,kj->nki", context.pelvis_rotation, context.shapes.interface + shift
    )
    robot = robot + 0.01 * rng.standard_normal(robot.shape)
    seen = placed.effect.chains.observation.observe(robot[None], None, part[None], context)[0]
    away = [
        np.einsum("nji,nkj->nki", context.pelvis_rotation, paths - context.pelvis_position[:, None])
        - context.shapes.interface
        for paths in (robot, seen)
    ]
    np.testing.assert_allclose(away[1], (1 - part) * away[0], atol=1e-12)


def test_a_robot_starts_where_its_markers_would_be_if_they_sat_on_it():
    placed = placed_whole("marker_offset", "on_strap")
    observation, values = placed.effect.chains.observation, np.array([0.4, 0.25, 0.1])
    context = replay([])._context
    rotation, position = context.pelvis_rotation[0], context.pelvis_position[: context.start].mean(axis=0)
    turn = Rotation.from_rotvec([0.0, 0.0, 0.02]).as_matrix()
    centre = position + rotation @ REST.position + np.array([0.005, -0.004, 0.003])
    true = centre + HALF * np.array([turn[:, 1], -turn[:, 1]])
    still = replace(
        context,
        pelvis_rotation=np.tile(rotation, (len(context.time_s), 1, 1)),
        pelvis_position=np.tile(position, (len(context.time_s), 1)),
    )
    paths = np.tile(true, (1, len(context.time_s), 1, 1))
    markers = observation.observe(paths, None, values[None], still)[0]
    seen_rotation, seen_position = interface_frame(markers[0, 0], markers[0, 1], np.array([0.0, 0.0, 1.0]))
    sight = chains.Poses(seen_rotation, seen_position, REST.rotation, REST.position)
    found = observation.true_poses(values, sight, replace(still, measured=markers), ())
    np.testing.assert_allclose(found.position, centre, atol=1e-5)
    np.testing.assert_allclose(found.rotation, turn, atol=1e-4)


def test_a_trailing_mean_is_the_mean_of_the_last_samples():
    context = SimpleNamespace(time_s=np.arange(300) / 100)
    rng = np.random.default_rng(4)
    path = lowpass(rng.standard_normal((300, 6)).cumsum(axis=0), 100, 5, 4).reshape(1, 300, 2, 3)
    seen = timing.averaged_markers(path, np.array([[0.1]]), context)
    before = np.concatenate([np.repeat(path[:, :1], 10, axis=1), path], axis=1)
    trapezium = np.array(
        [(before[0, i : i + 11].sum(axis=0) - before[0, [i, i + 10]].mean(axis=0)) for i in range(300)]
    )
    assert np.abs(seen[0] - trapezium / 10).max() < 2e-3 * np.ptp(path)


@pytest.mark.parametrize(("form", "value"), [("", 5.0), ("first_order_", 5.0), ("mean_", 0.1)])
def test_a_log_that_was_laid_on_filtered_markers_is_as_late_as_they_are(form, value):
    """A ramp behind a filter is the ramp, later: by the filter's lag to what is slow."""
    effect = placed_whole("filter_lag", f"{form}with_log").effect
    context = SimpleNamespace(time_s=np.arange(600) / 100)
    ramp = np.tile(np.maximum(context.time_s - 1.0, 0.0)[:, None], (1, 1, 6))
    values = np.array([[value]])
    markers = effect.chains.output(ramp.reshape(1, 600, 2, 3), values, context)
    log = effect.chains.log(ramp, values, context)
    assert log[0, -1, 0] < ramp[0, -1, 0] - 0.02
    np.testing.assert_allclose(log[0, 300:, 0], markers[0, 300:, 0, 0], atol=1.5e-3)


def test_a_pelvis_that_was_seen_too_large_is_where_it_was_with_the_rest_pose_that_was_taken_of_it():
    """True pelvis and rest pose, and the seen rest pose on what replays instead, put the interface in one place."""
    context = replay([], neutral_at=np.array([0.4, -0.2, 0.0]))._context
    rotation, position = lab.scaled_motion(np.array([0.03]), context)
    true = context.pelvis_position / 1.03
    neutral, stood = context.neutral.rotation, context.neutral.position
    interface_at_neutral = stood + neutral @ REST.position
    true_rest = neutral.T @ (interface_at_neutral - stood / 1.03)
    np.testing.assert_allclose(position + rotation @ REST.position, true + rotation @ true_rest, atol=1e-12)


def test_a_strap_that_settles_pulls_towards_where_it_goes():
    placed = next(
        Placed(e, e.places(STRAP)[0], SCALES)
        for e in EFFECTS
        if (e.name, e.form) == ("migration", "_settling")
    )
    context = replay([placed])._context
    values = np.array([[0.01, 0.5]])
    force = placed.effect.plant.force(values, context, placed.where, IMPEDANCE)[0, :, 0]
    since = context.step_time_s - context.time_s[context.start]
    assert not force[since <= 0].any()
    moving = since > 0
    np.testing.assert_allclose(force[moving], PRIOR[0] * 0.01 * -np.expm1(-since[moving] / 0.5), rtol=1e-9)


@pytest.mark.parametrize(("name", "side"), [("slack", 0), ("one_sided", 1), ("one_sided", -1)])
def test_a_strap_that_is_loose_does_not_damp(name, side):
    effect = next(e for e in EFFECTS if (e.name, e.form) == (name, "_undamped"))
    where = next(w for w in effect.places(STRAP) if w.axes == (1,) and w.side == side)
    placed = Placed(effect, where, SCALES)
    model = replay([placed])
    x = np.array([[np.log(0.2)]]) if name == "slack" else np.array([[0.2, 0.75]])
    model.run_effects(PRIOR[None], [x])
    plant, width = model.as_simulated().model, 0.2 * SCALES.q[1]
    q = model._context.coordinates[:, 1]
    loose = np.abs(q) < width - 1e-4 if name == "slack" else side * q < width - 1e-4
    tight = np.abs(q) > width + 1e-4 if name == "slack" else side * q > width + 1e-4
    assert loose.any()
    assert tight.any()
    control = effect.plant.force(placed.values(x), model._context, where, IMPEDANCE)[0, :, 0]
    data = mujoco.MjData(plant)
    dof, column = plant.joint(STRAP_JOINTS[1]).dofadr[0], effect.plant.columns(plant, where)[0]
    damping = []
    for at in (np.argmax(loose), np.argmax(tight)):
        forces = []
        for rate in (0.0, 0.1):
            data.ctrl[:], data.qvel[:] = 0, 0
            data.ctrl[column], data.qvel[dof] = control[at], rate
            mujoco.mj_forward(plant, data)
            forces.append(data.qfrc_passive[dof] + data.actuator_force[column])
        damping.append((forces[0] - forces[1]) / 0.1)
    kept = 0.0 if name == "slack" else 0.25
    np.testing.assert_allclose(damping, [kept * PRIOR[7], PRIOR[7]], atol=1e-6)
