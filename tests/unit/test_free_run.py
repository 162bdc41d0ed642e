"""Free runs: planned forces follow the simulated motion and know nothing of the recorded one."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from real2sim.diagnosis.refit import JointResiduals, refit, refit_freely
from real2sim.effects.base import AtRest, Effect, EffectParameter, Placed, Where
from real2sim.effects.chains import Context, MarkerShapes, NeutralPose, RobotMass
from real2sim.effects.free_run import settled, with_strap_motion
from real2sim.effects.planned import FamilyForce
from real2sim.effects.replay import EffectReplay
from real2sim.geometry import interface_coordinates, relative_pose, rotation_xyz
from real2sim.signals import lowpass

from tests.unit.simulated_effects import SCALES, STRAP, replay
from tests.unit.test_coupling import PRIOR


@pytest.mark.parametrize("gain", [0.3, 0.9, 3.0])
def test_a_motion_is_found_that_agrees_with_its_own_forces(gain):
    """Also where planning again and again would grow without bound: a law stiffer than the plant."""
    rng = np.random.default_rng(1)
    turn = np.linalg.qr(rng.standard_normal((40, 40)))[0][:, :3]
    answer = -gain * turn @ np.diag([1.0, 0.7, 0.4]) @ turn.T
    plain, scale = rng.standard_normal((20, 2)), np.array([0.01, 0.2])

    def simulated(motion):
        return (plain + (answer @ (motion / scale).ravel()).reshape(20, 2)) * scale

    exact = np.linalg.solve(np.eye(40) - answer, plain.ravel()).reshape(20, 2) * scale
    found = settled(simulated, plain * scale, scale)
    np.testing.assert_allclose(found / scale, exact / scale, atol=5e-3)


def test_a_law_that_cannot_be_simulated_has_no_free_run():
    start = np.ones((5, 1))
    assert settled(lambda motion: motion * np.nan, start, np.ones(1)) is None
    # a force that always pushes further has no motion that agrees with it
    assert settled(lambda motion: motion + 1.0, start, np.ones(1)) is None


def test_the_interface_moves_along_with_its_coordinates(moving_strap):
    context, rest_rotation, rest_position = moving_strap
    rng = np.random.default_rng(2)
    q = context.coordinates + 0.01 * rng.standard_normal(context.coordinates.shape)
    moved = with_strap_motion(context, q)
    relative = relative_pose(
        context.pelvis_rotation,
        context.pelvis_position,
        moved.interface_rotation,
        moved.measured.mean(axis=1),
    )
    np.testing.assert_allclose(interface_coordinates(*relative, rest_rotation, rest_position), q, atol=1e-12)


@pytest.fixture
def moving_strap():
    """A context of a person who sways in the strap, and pose of the interface at rest."""
    n, rng = 50, np.random.default_rng(3)
    time_s, still = np.arange(n) / 100, np.zeros((n, 6))
    pelvis = rotation_xyz(0.2 * rng.standard_normal((n, 3)))
    q = 0.05 * rng.standard_normal((n, 6))
    rest_rotation, rest_position = rotation_xyz(np.array([0.0, -0.15, 0.0])), np.array([-0.08, 0.0, -0.03])
    middle = np.einsum("nij,nj->ni", pelvis, rest_position + q[:, :3])
    bar = pelvis @ rotation_xyz(q[:, 3:]) @ rest_rotation
    side = 0.2 * bar[:, :, 1]
    markers = np.stack([middle + side, middle - side], axis=1)
    context = Context(
        time_s,
        time_s,
        pelvis,
        np.zeros((n, 3)),
        bar,
        0,
        RobotMass(100.0, np.zeros(2)),
        markers,
        np.zeros((n, 2), bool),
        q,
        still,
        NeutralPose(np.eye(3), np.zeros(3)),
        MarkerShapes(np.zeros((4, 3)), np.zeros((2, 3))),
        np.zeros(3),
    )
    return context, rest_rotation, rest_position


def _planned(name: str, plan: Callable[[Context], np.ndarray], *, feeds_back: bool) -> Placed:
    """A force (steps,) across the strap, times the one number of the effect."""
    effect = Effect(
        name,
        "interface",
        "a planned force",
        (EffectParameter("size", "1", -1e4, 1e4, (0.0,)),),
        separating_trial="none",
        at_rest=AtRest((0.0,)),
        scope="whole",
        plant=FamilyForce(
            lambda values, context, where, impedance: values[:, :1, None] * plan(context)[:, None],
            ("strap_ty",),
            feeds_back=feeds_back,
        ),
    )
    return Placed(effect, Where(STRAP, (), 0, "", name), SCALES)


def _spring() -> Placed:
    """A spring whose force is planned from the coordinate; its number is the stiffness [N/m]."""

    def force(context: Context) -> np.ndarray:
        return -np.interp(context.step_time_s, context.time_s, context.coordinates[:, 1])

    return _planned("spring", force, feeds_back=True)


def _push() -> Placed:
    """A slow push from outside; its number is the largest force [N]."""
    return _planned("push", lambda context: np.sin(np.pi * context.step_time_s / 3), feeds_back=False)


@pytest.mark.parametrize("added", [800.0, 6000.0])
def test_a_planned_spring_moves_as_a_spring_of_the_plant(added):
    """Also where it is three times as stiff as the strap."""
    stiffer = PRIOR.copy()
    stiffer[1] += added
    plain, expected = (replay([]).run_effects(k[None], [])[0] for k in (PRIOR, stiffer))
    planned = replay([_spring()])
    paths, _ = planned.run_freely(PRIOR[None], [np.array([[added]])])
    moved = np.std(plain - expected)
    assert moved > 1e-3
    assert np.std(paths - expected) < 0.03 * moved
    # its forces are those of the simulated motion
    assert np.abs(planned.planned_from.coordinates - planned._context.coordinates).max() > 1e-3


def test_a_free_run_knows_nothing_of_the_recorded_motion():
    rng, x = np.random.default_rng(4), [np.array([[800.0]])]
    recorded = [0.0, lowpass(rng.standard_normal((300, 6)), 100, 3.0, 2) * 0.05]
    freely = [replay([_spring()], noise=n).run_freely(PRIOR[None], x)[0] for n in recorded]
    planned = [replay([_spring()], noise=n).run_effects(PRIOR[None], x)[0] for n in recorded]
    np.testing.assert_allclose(freely[0], freely[1], atol=1e-9)
    assert np.abs(planned[0] - planned[1]).max() > 1e-3


def test_a_law_that_repeats_a_push_from_outside_does_nothing_by_itself():
    """Planned from the recorded motion it explains the push; a person who stands gives it nothing to go by."""
    still, at = np.zeros((300, 6)), PRIOR[None]
    pushed = replay([_push(), _spring()], motion=still)
    recorded, _ = pushed.run_freely(at, [np.array([[30.0]]), np.zeros((1, 1))])
    q = pushed.planned_from.coordinates
    plain, _ = replay([], motion=still).run_effects(at, [])
    assert np.abs(recorded - plain).max() > 2e-3
    # the stiffness that makes the push of the motion, with the sign of a law that pushes on
    push = 30 * np.sin(np.pi * np.arange(300) / 300)
    law = [np.array([[-(push @ q[:, 1]) / (q[:, 1] @ q[:, 1])]])]
    planned, _ = replay([_spring()], motion=still, noise=q).run_effects(at, law)
    freely, _ = replay([_spring()], motion=still, noise=q).run_freely(at, law)
    assert np.std(planned - recorded) < 0.2 * np.std(recorded - plain)
    np.testing.assert_allclose(freely, plain, atol=1e-6)


class _Recorded:
    """A trial: marker ``paths`` (1, n, 2, 3) [m], and what its interface moves beside the pelvis, ``noise`` (n, 6).

    Residuals are in millimetres.
    """

    held_out, skin, cost = False, None, None

    def __init__(self, paths: np.ndarray, noise: np.ndarray):
        self._paths, self._noise = paths, noise
        self.context = self.replay([], 1).planned_from

    def replay(self, effects: list[Placed], nsim: int, *, coarse: bool = False) -> EffectReplay:
        return replay(effects, nsim, noise=self._noise)

    def whitened(self, paths: np.ndarray, joints: np.ndarray) -> np.ndarray:
        return 1e3 * (paths - self._paths).reshape(len(paths), -1)


def test_a_law_beside_a_gap_is_not_bent_by_what_was_recorded():
    """A spring is fitted beside a push that no hypothesis has: the motion of the free run has not been told of it."""
    true, at = 800.0, PRIOR[None]
    recorded = replay([_push(), _spring()])
    paths, _ = recorded.run_freely(at, [np.array([[30.0]]), np.array([[true]])])
    noise = recorded.planned_from.coordinates - recorded._context.coordinates
    trial = _Recorded(paths, noise)
    problem = JointResiduals(trial, [_spring()], STRAP)
    problem.free = np.array([len(PRIOR)])
    start = np.append(STRAP.searched(PRIOR), 0.0)
    planned, _ = refit(problem, start, iterations=20, ftol=1e-6)
    freely = refit_freely(problem, planned, iterations=20, ftol=1e-6)
    assert problem.cost_freely(freely) < problem.cost_freely(planned)
    assert abs(freely[-1] - true) < 0.5 * abs(planned[-1] - true)
    # nearly as good as the best of the cost itself
    around = [problem.cost_freely(np.append(start[:-1], freely[-1] * f)) for f in (0.9, 1.1)]
    assert problem.cost_freely(freely) < min(around)
