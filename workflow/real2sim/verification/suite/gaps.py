"""The gap that effects leave where the twelve parameters are refitted to them, by the phantom's own physics."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from real2sim.verification.phantom.physics import PelvisPath, Robot, TruePaths
from real2sim.verification.suite.measurement import (
    Recording,
    interface_pose,
    pelvis_markers,
    pelvis_pose,
    replayed_path,
    residual,
    sampled,
)
from real2sim.verification.suite.setups import Setup, run, run_centres
from real2sim.verification.suite.severity import HELD_OUT, STEP_LN, TRAIN, Fit, perturbed
from real2sim.verification.suite.synthetic import (
    RATE_HZ,
    Applied,
    Synthetic,
    World,
    about_of,
    as_long,
    samples_of,
    setup_of,
)

_START_WINDOW_S = 0.5

# by index of the person and name of the trial
_Setups = dict[tuple[int, str], Setup]
_Recorded = dict[tuple[int, str], Recording]


def gaps(
    world: World, people: list[Synthetic], effects: list[Applied], starts: list[np.ndarray] | None = None
) -> list[Fit]:
    """Refit of the base to each person under some effects, by coarse simulations.

    ``starts`` (12,) each: where a refit begins, if that is better than at the true parameters.
    """
    true_setups: _Setups = {}
    models: _Setups = {}
    pairs = [(i, trial) for i in range(len(people)) for trial in (TRAIN, HELD_OUT)]
    for i, trial in pairs:
        if any(form.moves_truth for form, _ in effects[i]):
            true_setups[i, trial] = with_effects(people[i], trial, effects[i])
    true = run_keys(world.coarse, world.stops, true_setups)
    recorded: _Recorded = {}
    for i, trial in pairs:
        p = people[i]
        paths = true.get((i, trial), p.base[trial])
        pelvis = true_setups[i, trial].path if (i, trial) in true_setups else p.paths[trial]
        recorded[i, trial] = record_of(p, trial, pelvis, paths, effects[i])
        if any(form.moves_model for form, _ in effects[i]) and np.isfinite(paths.left).all():
            models[i, trial] = _as_analysed(world.coarse, p, trial, pelvis, recorded[i, trial], effects[i])
    fits = _fits(world, people, recorded, models)
    if starts is not None:
        _start(world, people, recorded, models, fits, starts)
    for _ in range(world.suite["severity"]["refits"]):
        _refit(world, people, recorded, models, fits)
    return fits


def _fits(world: World, people: list[Synthetic], recorded: _Recorded, models: _Setups) -> list[Fit]:
    """Return the residuals of an analysis with the true parameters."""
    replayed = dict(
        zip(
            models,
            run_centres(world.coarse, list(models.values()), world.stops, RATE_HZ),
            strict=True,
        )
    )
    out = []
    for i, p in enumerate(people):
        left = []
        for trial in (TRAIN, HELD_OUT):
            base = np.stack([p.base[trial].left, p.base[trial].right], axis=1)
            left.append(_left(p, recorded[i, trial], replayed.get((i, trial), base)))
        assert p.refit is not None
        out.append(Fit(p.refit, left[0], left[1]))
    return out


def _left(p: Synthetic, recorded: Recording, replayed: np.ndarray) -> np.ndarray:
    n = samples_of(p)
    return residual(recorded.interface(np.arange(n) / RATE_HZ) - replayed[:n], RATE_HZ)


def _start(
    world: World,
    people: list[Synthetic],
    recorded: _Recorded,
    models: _Setups,
    fits: list[Fit],
    starts: list[np.ndarray],
) -> None:
    """Let refits begin elsewhere, with the tangents of that place."""
    chosen = [i for i, fit in enumerate(fits) if fit.usable and starts[i].any()]
    setups = []
    for i in chosen:
        for trial in (TRAIN, HELD_OUT):
            plain = models.get((i, trial)) or setup_of(people[i], trial)
            factor = np.exp(starts[i])
            stiffness, damping = plain.stiffness * factor[:6], plain.damping * factor[6:]
            setups.append(replace(plain, stiffness=stiffness, damping=damping))
            if trial == TRAIN:
                setups += [replace(plain, stiffness=k, damping=d) for k, d in perturbed(stiffness, damping)]
    done = iter(run_centres(world.coarse, setups, world.stops, RATE_HZ))
    for i in chosen:
        train, *others = (_left(people[i], recorded[i, TRAIN], next(done)) for _ in range(13))
        tangent = np.column_stack([(train - other) / STEP_LN for other in others])
        fits[i].start(starts[i], train, _left(people[i], recorded[i, HELD_OUT], next(done)), tangent)


def _refit(
    world: World, people: list[Synthetic], recorded: _Recorded, models: _Setups, fits: list[Fit]
) -> None:
    """One step of every refit that can be made."""
    asked, setups = [], []
    for i, (p, fit) in enumerate(zip(people, fits, strict=True)):
        if not fit.usable:
            continue
        moved = fit.propose()
        asked.append((i, moved))
        factor = np.exp(moved)
        for trial in (TRAIN, HELD_OUT):
            plain = models.get((i, trial)) or setup_of(p, trial)
            stiffness, damping = plain.stiffness * factor[:6], plain.damping * factor[6:]
            setups.append(replace(plain, stiffness=stiffness, damping=damping))
    replayed = iter(run_centres(world.coarse, setups, world.stops, RATE_HZ))
    for i, moved in asked:
        left = [_left(people[i], recorded[i, trial], next(replayed)) for trial in (TRAIN, HELD_OUT)]
        fits[i].tell(moved, *left)


def run_keys(robot: Robot, stops: dict[str, Any], setups: dict[Any, Setup]) -> dict[Any, TruePaths]:
    """Return true paths of simulations by the keys of their setups."""
    return dict(zip(setups, run(robot, list(setups.values()), stops, RATE_HZ), strict=True))


def with_effects(p: Synthetic, trial: str, effects: Applied) -> Setup:
    """A trial's simulation under some effects; the strap is at rest at the start, also where its rest moved."""
    setup = setup_of(p, trial).copy()
    for form, values in effects:
        form.change(setup, values, trial, about_of(p))
    return setup


def record_of(p: Synthetic, trial: str, pelvis: PelvisPath, paths: TruePaths, effects: Applied) -> Recording:
    """Return what is recorded of a trial before noise, with what effects do to the recording."""
    centres = np.stack([paths.left, paths.right], axis=1)
    recording = Recording(
        trial,
        p.motions[trial].duration_s,
        p.settings["trials"]["quiet_s"],
        sampled(paths.time_s, centres),
        sampled(paths.time_s, paths.interface_rotation),
        pelvis_markers(p.person, pelvis),
    )
    for form, values in effects:
        form.record(recording, values, about_of(p))
    return recording


def _as_analysed(
    robot: Robot, p: Synthetic, trial: str, pelvis: PelvisPath, recorded: Recording, effects: Applied
) -> Setup:
    """The replay that an analysis would set up: recorded pelvis, rest pose of neutral, recorded start pose."""
    rest_rotation, rest_position = _recorded_rest(robot, p, effects)
    window = np.arange(round(_START_WINDOW_S * RATE_HZ)) / RATE_HZ
    rotation, middle = interface_pose(
        recorded.interface(window).mean(axis=0), recorded.axes(window[:1])[0][:, 2]
    )
    start = _joints_for(robot, rotation, middle)
    path = pelvis
    if any(form.stage == "input" for form, _ in effects):
        t = np.arange(samples_of(p)) / RATE_HZ
        path = as_long(replayed_path(recorded.pelvis(t), RATE_HZ), pelvis)
    base = setup_of(p, trial)
    return replace(
        base,
        path=path,
        rest_rotation=rest_rotation,
        rest_position=rest_position,
        controller=replace(base.controller, start=start),
    )


def _recorded_rest(robot: Robot, p: Synthetic, effects: Applied) -> tuple[np.ndarray, np.ndarray]:
    """Pose of the interface in the pelvis as the neutral trial shows it, standing still."""
    rotation, position = robot.rest_middle(p.starts["neutral"])
    offset = rotation @ robot.side
    still = Recording(
        "neutral",
        p.motions["neutral"].duration_s,
        p.settings["trials"]["quiet_s"],
        lambda t: np.broadcast_to(np.stack([position + offset, position - offset]), (len(t), 2, 3)),
        lambda t: np.broadcast_to(rotation, (len(t), 3, 3)),
        pelvis_markers(p.person, PelvisPath(lambda t: p.paths["neutral"](0.0 * t), 1.0)),
    )
    for form, values in effects:
        form.record(still, values, about_of(p))
    t = np.zeros(1)
    r_p, p_p = (x[0] for x in pelvis_pose(still.pelvis(t)))
    r_i, p_i = interface_pose(still.interface(t)[0], still.axes(t)[0][:, 2])
    return r_p.T @ r_i, r_p.T @ (p_i - p_p)


def _joints_for(robot: Robot, rotation: np.ndarray, middle: np.ndarray) -> np.ndarray:
    """Robot joints (6,) that put the interface at a pose: yaw, roll and pitch turn, slides and lift move it."""
    zero = robot.rest_middle(np.zeros(6))[0]
    yaw, roll, pitch = Rotation.from_matrix(rotation @ zero.T).as_euler("ZXY")
    joints = np.array([0.0, 0.0, yaw, 0.0, roll, pitch])
    away = middle - robot.rest_middle(joints)[1]
    joints[:2], joints[3] = away[:2], away[2]
    return joints
