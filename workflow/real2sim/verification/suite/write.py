"""Simulate, measure and write the cases of one shard; their truth goes to a file that no analysis reads."""

from __future__ import annotations

import copy
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import yaml
from scipy.spatial.transform import Rotation

from real2sim.artefacts import write_json
from real2sim.files import write_text
from real2sim.verification.phantom import exports, tasks
from real2sim.verification.phantom.cohort import robot_controller
from real2sim.verification.phantom.exports import Trial
from real2sim.verification.phantom.motions import Motion, pelvis_path
from real2sim.verification.phantom.person import PARAMETER_NAMES, UNITS, Person, draw_person
from real2sim.verification.phantom.physics import AXES, Controller, PelvisPath, Robot, TruePaths
from real2sim.verification.suite import excitation
from real2sim.verification.suite.effects import Context, Draw, Form
from real2sim.verification.suite.forms import FORMS
from real2sim.verification.suite.measurement import (
    Recording,
    interface_pose,
    pelvis_markers,
    pelvis_pose,
    replayed_path,
    residual,
    sampled,
)
from real2sim.verification.suite.plan import EFFECTS, Case, case_names, cases, stream
from real2sim.verification.suite.random_forms import RandomForm, posture
from real2sim.verification.suite.setups import Setup, run, run_centres
from real2sim.verification.suite.severity import (
    HELD_OUT,
    STEP_LN,
    TRAIN,
    Fit,
    Refit,
    Search,
    perturbed,
    refit_of,
)
from real2sim.verification.suite.true_laws import PLACES, SPEEDS, curve_of, library_law

RATE_HZ = 100.0
TRIALS = ("neutral", TRAIN, HELD_OUT)
FURTHER = "dynamic_3"
_START_WINDOW_S = 0.5
_NOISY = 3  # replays with noise, for the floor


@dataclass
class _Cause:
    """One effect of a case: its form, the draw of it, the severity found, and the gap it makes alone.

    ``left`` holds, per severity, the residual on the held-out trial that the refitted base leaves.
    """

    form: Form
    name: str
    draw: Draw = field(default_factory=Draw)
    severity: float = 0.0
    rho: float = 0.0
    moved: np.ndarray = field(default_factory=lambda: np.zeros(12))
    search: Search | None = None
    candidates: list[Draw] = field(default_factory=list)
    left: dict[float, np.ndarray] = field(default_factory=dict)


@dataclass
class _Synthetic:
    """A case with its person and its trials without any effect."""

    case: Case
    person: Person
    settings: dict[str, Any]
    motions: dict[str, Motion]
    paths: dict[str, PelvisPath]
    starts: dict[str, np.ndarray]
    controllers: dict[str, Controller]
    smooth_hz: float | None
    regime: tuple[float, float]
    causes: list[_Cause]
    base: dict[str, TruePaths] = field(default_factory=dict)
    about: Context | None = None
    refit: Refit | None = None
    rho: float | None = None
    left: np.ndarray | None = None

    @property
    def target(self) -> float:
        """The visibility asked for."""
        if self.case.target is None:
            raise ValueError(f"{self.case.id} has no effect")
        return self.case.target


def write_cases(
    *,
    suite: dict[str, Any],
    shard: int,
    settings: dict[str, Any],
    controllers: dict[str, Any],
    robot: Path,
    out: Path,
    truth: Path,
) -> None:
    """Write the cases of one shard as raw exports below ``out``, and their sealed truth.

    ``suite`` is a validated suite configuration, ``settings`` config/phantom.yaml, ``controllers`` the robot's
    controllers (config.yaml, ``robot``), ``robot`` its MJCF; ``out`` becomes ``<out>/<CASE>/*`` for the cases
    that `plan.case_names` gives.
    """
    write_with_further(
        suite=suite,
        shard=shard,
        settings=settings,
        controllers=controllers,
        robot=robot,
        out=out,
        truth=truth,
        further={},
    )


def write_with_further(
    *,
    suite: dict[str, Any],
    shard: int,
    settings: dict[str, Any],
    controllers: dict[str, Any],
    robot: Path,
    out: Path,
    truth: Path,
    further: Mapping[str, Motion],
) -> None:
    """As `write_cases`; some cases record one more dynamic trial, with the motion that ``further`` gives for them."""
    begun = time.perf_counter()
    names = case_names(suite, shard)
    plan = [case for case in cases(suite) if case.id in set(names)]
    print(f"{suite['name']} shard {shard}: {len(plan)} cases, about {5 * len(plan)} s", flush=True)

    def say(what: str) -> None:
        print(f"  {time.perf_counter() - begun:5.1f} s  {what}", flush=True)

    coarse, fine = (Robot(robot, s) for s in (suite["severity"]["step_s"], settings["simulation"]["step_s"]))
    people = [_synthesise(suite, case, settings, controllers, fine, further.get(case.id)) for case in plan]
    world = _World(suite, settings, coarse, fine)
    _describe(world, people)
    say("trials without effects")
    _linearise(world, people)
    say("tangents and noise floors")
    _solve(world, people, say)
    finished = _simulate(world, people)
    say("true trials")
    home = np.array(fine.model.body("base").pos[:2])
    write_json(
        truth,
        {
            "schema": 1,
            "phantom": True,
            "note": "Sealed truth of synthetic people. No analysis may read this file.",
            "suite": suite["name"],
            "shard": shard,
            "robot": robot.name,
            "cases": [
                _write(p, true, out / p.case.id, home) for p, true in zip(people, finished, strict=True)
            ],
        },
    )
    say("written")


@dataclass
class _World:
    """Configuration, and the robot with a coarse and a fine time step, that all cases share."""

    suite: dict[str, Any]
    settings: dict[str, Any]
    coarse: Robot
    fine: Robot

    @property
    def stops(self) -> dict[str, Any]:
        """Stiffness and damping of the strap's stops, as in the settings."""
        stops: dict[str, Any] = self.settings["stops"]
        return stops


# -------------------- people and trials


def _synthesise(
    suite: dict[str, Any],
    case: Case,
    phantom: dict[str, Any],
    controllers: dict[str, Any],
    robot: Robot,
    further: Motion | None,
) -> _Synthetic:
    settings = _settings(suite, case, phantom)
    person = draw_person(settings, case.id, float(robot.rest_middle(np.zeros(6))[1][2]))
    rng = stream(suite, case.id, "noise")
    low, high = (np.log(suite["noise"][key]) for key in ("low_m", "high_m"))
    person.marker_noise_m = float(np.exp(rng.uniform(low, high)))
    rng = stream(suite, case.id, "slow noise")
    if rng.random() < suite["noise"]["slow_share"]:
        person.slow_noise = float(rng.uniform(*suite["noise"]["slow"]))
        person.slow_noise_s = float(np.exp(rng.uniform(*np.log(suite["noise"]["slow_s"]))))
    smooth = None
    if case.stratum == "null_hard":
        person.marker_noise_m *= suite["noise"]["hard_factor"]
        if settings["trials"]["dynamic_s"] == suite["trials"]["dynamic_s"]:
            smooth = float(suite["noise"]["hard_filter_hz"])
    causes = [_Cause(FORMS[name], name) for name in case.forms]
    regimes = suite["motion"]["held_out"]
    if any(cause.form.within_training for cause in causes):
        regimes = [min(regimes)]
    regime = regimes[int(stream(suite, case.id, "regime").integers(len(regimes)))]
    motions = {name: _motion(suite, case, settings, name, regime) for name in TRIALS}
    if further is not None:
        motions[FURTHER] = further
    paths, starts, hands = {}, {}, {}
    for name in motions:
        starts[name] = _place(settings, suite, case.id, name)
        hands[name] = robot_controller(settings, controllers, "dynamic", starts[name])
        paths[name] = _path(robot, motions[name], starts[name], person, settings)
    return _Synthetic(case, person, settings, motions, paths, starts, hands, smooth, tuple(regime), causes)


def _motion(
    suite: dict[str, Any], case: Case, settings: dict[str, Any], trial: str, regime: Sequence[float]
) -> Motion:
    rng = stream(suite, case.id, trial, "motion")
    if trial == "neutral":
        return tasks.neutral(settings, rng)
    amplitude, speed = regime if trial == HELD_OUT else (1.0, 1.0)
    return excitation.dynamic(suite, settings["trials"]["dynamic_s"], rng, (amplitude, speed))


def _settings(suite: dict[str, Any], case: Case, phantom: dict[str, Any]) -> dict[str, Any]:
    """Phantom's settings for one case: its own person, short trials, no effect but neutral sway."""
    settings = copy.deepcopy(phantom)
    rng = stream(suite, case.id, "facts")
    height = float(np.clip(1.747 + 0.06 * rng.standard_normal(), 1.55, 1.95))
    mass = float(np.clip(82.7 + 10.4 * rng.standard_normal(), 50, 120))
    own = int(rng.integers(7, 13))
    settings["seed"] = suite["seed"]
    settings["cohort"] = {
        case.id: {
            "cohort": "calibration",
            "sex": str(rng.choice(["female", "male"])),
            "age_years": int(rng.integers(21, 41)),
            "mass_kg": round(mass, 1),
            "height_m": round(height, 3),
            "waist_m": round(0.923 + 0.008 * (mass - 82.7), 3),
            "tightness": {"loosest_cm": own - 4, "tightest_cm": own + 4, "safe_comfortable_cm": own},
        }
    }
    settings["parameters"] = suite["parameters"]
    settings["trials"] |= {key: suite["trials"][key] for key in ("quiet_s", "neutral_s", "dynamic_s")}
    if case.stratum == "null_hard" and rng.random() < 0.5:
        settings["trials"]["dynamic_s"] = suite["trials"]["short_s"]
    for effect in ("soft_tissue", "strap_migration"):
        settings["effects"][effect]["enabled"] = False
    settings["measurement"]["gaps"] |= suite["gaps"]
    # the study measures no force
    settings["measurement"]["wrench"]["enabled"] = False
    settings["measurement"]["markerless_clock"]["drift_person"] = ""
    settings["effects"]["neutral_sway"]["whole_cycles"] = False
    rng = stream(suite, case.id, "robot noise")
    low, high = (np.log(suite["noise"][f"log_{key}"]) for key in ("low", "high"))
    settings["measurement"]["encoder"] |= {
        "noise_m": float(np.exp(rng.uniform(low, high))),
        "noise_rad": float(np.exp(rng.uniform(low, high))),
    }
    return settings


def _place(settings: dict[str, Any], suite: dict[str, Any], case: str, trial: str) -> np.ndarray:
    body, rng = settings["person"], stream(suite, case, trial, "placement")
    x, y = body["placement_sd_m"] * rng.standard_normal(2)
    return np.array([x, y, np.radians(body["placement_sd_deg"]) * rng.standard_normal(), 0.0, 0.0, 0.0])


def _path(
    robot: Robot, motion: Motion, start: np.ndarray, person: Person, settings: dict[str, Any]
) -> PelvisPath:
    # the pelvis that has the strap at rest while the robot stands at its start pose
    rotation, position = robot.rest_middle(start)
    pelvis = rotation @ person.rest_rotation.T
    origin = position - pelvis @ person.rest_position
    return pelvis_path(
        motion, float(start[2]), pelvis, origin, person.pivot, settings["simulation"]["tail_s"]
    )


def _setup(p: _Synthetic, trial: str) -> Setup:
    person = p.person
    return Setup(
        p.paths[trial],
        person.rest_rotation,
        person.rest_position,
        person.stiffness,
        person.damping,
        p.controllers[trial],
    )


# -------------------- base trials, tangents, floors


def _describe(world: _World, people: list[_Synthetic]) -> None:
    """Trials without effects, and what the draws of the effects may know of them."""
    setups = [_setup(p, trial) for p in people for trial in (TRAIN, HELD_OUT)]
    done = iter(run(world.coarse, setups, world.stops, RATE_HZ))
    for p in people:
        p.base = {trial: next(done) for trial in (TRAIN, HELD_OUT)}
        base = p.base[TRAIN]
        q, qd = base.q, base.qd
        p.about = Context(
            p.person.stiffness,
            p.person.damping,
            q.min(axis=0),
            q.max(axis=0),
            np.abs(q).max(axis=0),
            np.abs(qd).max(axis=0),
            _mobility(world.coarse, p.person),
            world.coarse.masses,
            p.settings["trials"]["dynamic_s"],
            p.settings["trials"]["quiet_s"],
            np.abs(base.joints - base.joints[0]).max(axis=0),
            np.abs(base.joint_rates).max(axis=0),
            np.abs(posture(base.pelvis_rotation, base.pelvis_position)).max(axis=0),
        )


def _mobility(robot: Robot, person: Person) -> np.ndarray:
    """Inertia (6,) that the strap feels along each axis at the start pose [kg, kg m^2]."""
    model, data = robot.model, mujoco.MjData(robot.model)
    mujoco.mj_forward(model, data)
    jac_p, jac_r = np.zeros((3, model.nv)), np.zeros((3, model.nv))
    mujoco.mj_jacSite(model, data, jac_p, jac_r, model.site("phantom_middle").id)
    mass = np.zeros((model.nv, model.nv))
    mujoco.mj_fullM(model, data, mass)
    pelvis = data.body("interface").xmat.reshape(3, 3) @ person.rest_rotation.T
    j = np.vstack([pelvis.T @ jac_p, pelvis.T @ jac_r])
    inertia: np.ndarray = 1 / np.einsum("ij,jk,ik->i", j, np.linalg.inv(mass), j)
    return inertia


def _linearise(world: _World, people: list[_Synthetic]) -> None:
    """Tangents of the twelve parameters and noise floors of every case."""
    setups = []
    for p in people:
        for trial in (TRAIN, HELD_OUT):
            plain = _setup(p, trial)
            setups += [replace(plain, path=_noisy_path(world, p, trial, k)) for k in range(_NOISY)]
            for stiffness, damping in perturbed(p.person.stiffness, p.person.damping):
                setups.append(replace(plain, stiffness=stiffness, damping=damping))
    done = iter(run_centres(world.coarse, setups, world.stops, RATE_HZ))
    for p in people:
        centres = {}
        for trial in (TRAIN, HELD_OUT):
            n = _samples(p)
            base = np.stack([p.base[trial].left, p.base[trial].right], axis=1)[:n]
            noisy = [next(done)[:n] for _ in range(_NOISY)]
            centres[trial] = {"base": base, "noisy": noisy, "tangent": [next(done)[:n] for _ in range(12)]}
        rng = stream(world.suite, p.case.id, "floor")
        p.refit = refit_of(centres, partial(_noise, p, rng), RATE_HZ, _room(world, p.person))


def _noise(p: _Synthetic, rng: np.random.Generator, shape: tuple[int, ...]) -> np.ndarray:
    noise = p.person.marker_noise(rng, shape, RATE_HZ)
    return noise if p.smooth_hz is None else exports.smoothed(noise, RATE_HZ, p.smooth_hz)


def _room(world: _World, person: Person) -> tuple[np.ndarray, np.ndarray]:
    """Return the distances of the ln parameters from the search bounds, down and up."""
    rows = [world.suite["parameters"]["values"][name] for name in PARAMETER_NAMES]
    true = np.log(np.concatenate([person.stiffness, person.damping]))
    return np.log([r["low"] for r in rows]) - true, np.log([r["high"] for r in rows]) - true


def _samples(p: _Synthetic) -> int:
    return round(float(p.settings["trials"]["dynamic_s"]) * RATE_HZ)


def _noisy_path(world: _World, p: _Synthetic, trial: str, index: int) -> PelvisPath:
    t = np.arange(_samples(p)) / RATE_HZ
    markers = pelvis_markers(p.person, p.paths[trial])(t)
    rng = stream(world.suite, p.case.id, trial, f"floor {index}")
    noisy = {name: values + _noise(p, rng, values.shape) for name, values in markers.items()}
    return _as_long(replayed_path(noisy, RATE_HZ), p.paths[trial])


def _as_long(path: PelvisPath, other: PelvisPath) -> PelvisPath:
    return PelvisPath(path.evaluate, other.duration_s)


# -------------------- severity


def _solve(world: _World, people: list[_Synthetic], say: Callable[[str], None]) -> None:
    """Choose the draw of every cause and the severity that makes the gap asked for."""
    options = world.suite["severity"]
    jobs: list[tuple[_Synthetic, _Cause]] = [(p, c) for p in people for c in p.causes]
    trials: list[tuple[_Synthetic, _Cause, Draw, float]] = []
    for p, cause in jobs:
        rng = stream(world.suite, p.case.id, cause.name, "draw")
        cause.candidates = [cause.form.draw(rng, _about(p)) for _ in range(options["candidates"])]
        trials += [(p, cause, draw, 1.0) for draw in cause.candidates]
    fits = iter(_alone(world, trials))
    for p, cause in jobs:
        tried = [next(fits) for _ in cause.candidates]
        found = [fit.visibility() for fit in tried]
        # the first draw that can make the gap at all, else the one that comes nearest
        able = [i for i, rho in enumerate(found) if rho >= p.target]
        pick = able[0] if able else int(np.argmax(found))
        cause.draw, cause.moved = cause.candidates[pick], tried[pick].moved
        cause.rho = found[pick]
        cause.left = {1.0: tried[pick].held_out}
    _settle(world, jobs, options)
    say("severity: largest of each")
    for p in people:
        if p.causes:
            quieter = _quieten(p, min(c.rho for c in p.causes), world.suite["noise"]["low_m"])
            for cause in p.causes:
                cause.search = Search(p.target, options["tolerance"])
                cause.search.tell(1.0, cause.rho / quieter**2)
    for turn in range(options["rounds"]):
        left = [(p, c, c.search) for p, c in jobs if c.search is not None and not c.search.done]
        if not left:
            break
        asked = [(p, c, c.draw, search.ask()) for p, c, search in left]
        _again(world, asked)
        for (_, cause, _, severity), (*_, search) in zip(asked, left, strict=True):
            search.tell(severity, cause.rho)
        say(f"severity, round {turn + 1}: {len(left)} open")
    for _, cause in jobs:
        assert cause.search is not None
        cause.severity, cause.rho = cause.search.best
    mixed = [p for p in people if len(p.causes) > 1]
    starts = [p.causes[0].moved for p in mixed]
    together = _gaps(world, mixed, [_applied(p) for p in mixed], starts) if mixed else []
    for p in people:
        if p.causes:
            p.rho, p.left = p.causes[0].rho, p.causes[0].left[p.causes[0].severity]
    for p, fit in zip(mixed, together, strict=True):
        p.rho, p.left = fit.visibility(), fit.held_out


def _settle(world: _World, jobs: list[tuple[_Synthetic, _Cause]], options: dict[str, Any]) -> None:
    """Refit to each cause at its largest until its gap stays where it is; where it is ample, nothing hangs on it."""
    jobs = [(p, cause) for p, cause in jobs if cause.rho < 5 * p.target]
    for _ in range(options["rounds"]):
        if not jobs:
            return
        before = [cause.rho for _, cause in jobs]
        _again(world, [(p, cause, cause.draw, 1.0) for p, cause in jobs])
        jobs = [
            job
            for job, old in zip(jobs, before, strict=True)
            if np.isfinite(job[1].rho) and abs(np.log(job[1].rho / old)) > options["tolerance"]
        ]


def _quieten(p: _Synthetic, most: float, lowest_m: float) -> float:
    """Lower the noise, within its range, where the largest effect would not be visible enough in it.

    Returns the factor on the noise; the floor goes with its square.
    """
    assert p.refit is not None
    wanted = np.sqrt(most / (1.05 * p.target))
    factor = float(np.clip(wanted, min(1.0, lowest_m / p.person.marker_noise_m), 1.0))
    p.person.marker_noise_m *= factor
    p.refit.floor_train *= factor**2
    p.refit.floor_held_out *= factor**2
    return factor


def _about(p: _Synthetic) -> Context:
    assert p.about is not None
    return p.about


_Asked = list[tuple[_Synthetic, _Cause, Draw, float]]


def _alone(world: _World, asked: _Asked, starts: list[np.ndarray] | None = None) -> list[Fit]:
    """Refit of the base to each cause alone, at a severity."""
    effects = [[(c.form, c.form.values(draw, s, _about(p)))] for p, c, draw, s in asked]
    return _gaps(world, [p for p, *_ in asked], effects, starts)


def _again(world: _World, asked: _Asked) -> None:
    """Refit from where the cause's last refit ended, with tangents of that place; the cause keeps what it finds."""
    fits = _alone(world, asked, [cause.moved for _, cause, _, _ in asked])
    for (_, cause, _, severity), fit in zip(asked, fits, strict=True):
        cause.moved, cause.rho, cause.left[severity] = fit.moved, fit.visibility(), fit.held_out


Applied = list[tuple[Form, dict[str, Any]]]
# by index of the person and name of the trial
_Setups = dict[tuple[int, str], Setup]
_Recorded = dict[tuple[int, str], Recording]


def _gaps(
    world: _World, people: list[_Synthetic], effects: list[Applied], starts: list[np.ndarray] | None = None
) -> list[Fit]:
    """Refit of the base to each person under some effects, by coarse simulations.

    ``starts`` (12,) each: where a refit begins, if that is better than at the true parameters.
    """
    true_setups: _Setups = {}
    models: _Setups = {}
    pairs = [(i, trial) for i in range(len(people)) for trial in (TRAIN, HELD_OUT)]
    for i, trial in pairs:
        if any(form.moves_truth for form, _ in effects[i]):
            true_setups[i, trial] = _with(people[i], trial, effects[i])
    true = _run_keys(world.coarse, world.stops, true_setups)
    recorded: _Recorded = {}
    for i, trial in pairs:
        p = people[i]
        paths = true.get((i, trial), p.base[trial])
        pelvis = true_setups[i, trial].path if (i, trial) in true_setups else p.paths[trial]
        recorded[i, trial] = _record(p, trial, pelvis, paths, effects[i])
        if any(form.moves_model for form, _ in effects[i]) and np.isfinite(paths.left).all():
            models[i, trial] = _as_analysed(world.coarse, p, trial, pelvis, recorded[i, trial], effects[i])
    fits = _fits(world, people, recorded, models)
    if starts is not None:
        _start(world, people, recorded, models, fits, starts)
    for _ in range(world.suite["severity"]["refits"]):
        _refit(world, people, recorded, models, fits)
    return fits


def _fits(world: _World, people: list[_Synthetic], recorded: _Recorded, models: _Setups) -> list[Fit]:
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


def _left(p: _Synthetic, recorded: Recording, replayed: np.ndarray) -> np.ndarray:
    n = _samples(p)
    return residual(recorded.interface(np.arange(n) / RATE_HZ) - replayed[:n], RATE_HZ)


def _start(
    world: _World,
    people: list[_Synthetic],
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
            plain = models.get((i, trial)) or _setup(people[i], trial)
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
    world: _World, people: list[_Synthetic], recorded: _Recorded, models: _Setups, fits: list[Fit]
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
            plain = models.get((i, trial)) or _setup(p, trial)
            stiffness, damping = plain.stiffness * factor[:6], plain.damping * factor[6:]
            setups.append(replace(plain, stiffness=stiffness, damping=damping))
    replayed = iter(run_centres(world.coarse, setups, world.stops, RATE_HZ))
    for i, moved in asked:
        left = [_left(people[i], recorded[i, trial], next(replayed)) for trial in (TRAIN, HELD_OUT)]
        fits[i].tell(moved, *left)


def _run_keys(robot: Robot, stops: dict[str, Any], setups: dict[Any, Setup]) -> dict[Any, TruePaths]:
    return dict(zip(setups, run(robot, list(setups.values()), stops, RATE_HZ), strict=True))


def _with(p: _Synthetic, trial: str, effects: Applied) -> Setup:
    """A trial's simulation under some effects; the strap is at rest at the start, also where its rest moved."""
    setup = _setup(p, trial).copy()
    for form, values in effects:
        form.change(setup, values, trial, _about(p))
    return setup


def _record(p: _Synthetic, trial: str, pelvis: PelvisPath, paths: TruePaths, effects: Applied) -> Recording:
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
        form.record(recording, values, _about(p))
    return recording


def _as_analysed(
    robot: Robot, p: _Synthetic, trial: str, pelvis: PelvisPath, recorded: Recording, effects: Applied
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
        t = np.arange(_samples(p)) / RATE_HZ
        path = _as_long(replayed_path(recorded.pelvis(t), RATE_HZ), pelvis)
    base = _setup(p, trial)
    return replace(
        base,
        path=path,
        rest_rotation=rest_rotation,
        rest_position=rest_position,
        controller=replace(base.controller, start=start),
    )


def _recorded_rest(robot: Robot, p: _Synthetic, effects: Applied) -> tuple[np.ndarray, np.ndarray]:
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
        form.record(still, values, _about(p))
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


# -------------------- true trials and files


def _applied(p: _Synthetic) -> Applied:
    return [(c.form, c.form.values(c.draw, c.severity, _about(p))) for c in p.causes]


@dataclass
class _Measured:
    """A true trial at the fine step: the pelvis' path, the true paths, and what is recorded before noise."""

    path: PelvisPath
    paths: TruePaths
    recording: Recording


def _simulate(world: _World, people: list[_Synthetic]) -> list[dict[str, _Measured]]:
    """All trials of every case with its effects."""
    setups = {(i, t): _with(p, t, _applied(p)) for i, p in enumerate(people) for t in p.motions}
    done = _run_keys(world.fine, world.stops, setups)
    out: list[dict[str, _Measured]] = [{} for _ in people]
    for (i, trial), paths in done.items():
        if not np.isfinite(paths.left).all():
            raise RuntimeError(
                f"{people[i].case.id} {trial}: the simulation is unstable, {people[i].case.forms}"
            )
        path = setups[i, trial].path
        recording = _record(people[i], trial, path, paths, _applied(people[i]))
        out[i][trial] = _Measured(path, paths, recording)
    return out


def _write(p: _Synthetic, true: dict[str, _Measured], folder: Path, home: np.ndarray) -> dict[str, Any]:
    settings, person = p.settings, p.person
    notes: dict[str, Any] = {}
    for index, trial_name in enumerate(p.motions):
        path, paths, recording = (getattr(true[trial_name], key) for key in ("path", "paths", "recording"))
        motion = p.motions[trial_name]
        trial = Trial(trial_name, motion, path, float(p.starts[trial_name][2]), np.zeros(3), paths)
        rate = settings["rates"]["markers_hz"]
        t = np.arange(round(motion.duration_s * rate)) / rate
        centres = recording.interface(t)
        positions = recording.pelvis(t) | {"IF_L": centres[:, 0].copy(), "IF_R": centres[:, 1].copy()}
        clocks = exports.draw_clocks(settings, person, trial_name, index)
        stem = folder / trial_name
        notes[trial_name] = exports.write_trial_markers(
            stem.with_suffix(".tsv"), settings, person, trial, positions, p.smooth_hz
        )
        exports.write_trial_coordinates(stem.with_suffix(".mot"), settings, person, trial, clocks)
        exports.write_trial_log(stem.with_suffix(".mcap"), settings, person, trial, clocks, home)
        notes[trial_name] |= {"clocks": clocks, "q_max": np.abs(paths.q).max(axis=0).tolist()}
    facts = {"id": person.name, "phantom": True, **person.facts}
    text = f"# {exports.NOTICE}\n" + yaml.safe_dump(facts, sort_keys=False, default_flow_style=False)
    write_text(folder / "subject.yaml", text)
    dynamic = [true[t].paths for t in (TRAIN, HELD_OUT)]
    return _truth(p, notes, None if p.left is None else regimes(p.left, *dynamic), dynamic)


def regimes(left: np.ndarray, train: TruePaths, held_out: TruePaths) -> dict[str, float]:
    """Share of a gap by regime of the interface's motion: amplitude and speed, each above or below its median.

    ``left`` (n_r,) is a residual without noise (`measurement.residual`) of the held-out trial. Amplitude and speed are
    norms of q and of its rate, each axis over its large excursion (95th percentile) in the training trial.
    """
    m = (len(left) + 12) // 12
    energy = np.sum(left[: 6 * m].reshape(m, 6) ** 2, axis=1)
    energy[1:-1] += np.sum(left[6 * m :].reshape(m - 2, 6) ** 2, axis=1)
    large = np.maximum(np.percentile(np.abs(train.q), 95, axis=0), 1e-6)
    amplitude, speed = (np.linalg.norm(x[:m] / large, axis=1) for x in (held_out.q, held_out.qd))
    far, fast = amplitude > np.median(amplitude), speed > np.median(speed)
    total = max(float(energy.sum()), 1e-300)
    return {
        f"{'large' if a else 'small'} amplitude, {'fast' if v else 'slow'}": float(
            energy[(far == a) & (fast == v)].sum() / total
        )
        for a in (True, False)
        for v in (True, False)
    }


def _truth(
    p: _Synthetic, notes: dict[str, Any], shares: dict[str, float] | None, dynamic: list[TruePaths]
) -> dict[str, Any]:
    assert p.refit is not None
    return {
        "id": p.case.id,
        "stratum": p.case.stratum,
        "effects": [_cause_truth(p, cause) | _law_truth(p, cause, dynamic) for cause in p.causes],
        "visibility": {"target": p.case.target, "predicted": p.rho},
        "regimes": shares,
        "floor": {TRAIN: p.refit.floor_train, HELD_OUT: p.refit.floor_held_out},
        "parameters": {
            name: {"value": value, "unit": UNITS[name]} for name, value in p.person.parameters.items()
        },
        "noise_m": p.person.marker_noise_m,
        "slow_noise": {"share": p.person.slow_noise, "forgets_s": p.person.slow_noise_s},
        "log_noise": {key: p.settings["measurement"]["encoder"][f"noise_{key}"] for key in ("m", "rad")},
        "smooth_hz": p.smooth_hz,
        "held_out_regime": {"amplitude": p.regime[0], "speed": p.regime[1]},
        "rest_pose": {
            "rotation": p.person.rest_rotation.tolist(),
            "position_m": p.person.rest_position.tolist(),
        },
        "trials": notes,
    }


def _cause_truth(p: _Synthetic, cause: _Cause) -> dict[str, Any]:
    form = cause.form
    values = form.values(cause.draw, cause.severity, _about(p))
    return {
        "effect": form.effect,
        "family": form.family or (form.effect if form.effect in EFFECTS else None),
        "axes": [axis for axis, on in zip(AXES, cause.draw.axes, strict=True) if on],
        "stage": form.stage,
        "form": form.form,
        "parameters": form.truth(cause.draw, values),
        "regime": form.regime,
        "severity": cause.severity,
        "visibility": {"target": p.case.target, "alone": cause.rho},
    }


def _law_truth(p: _Synthetic, cause: _Cause, dynamic: list[TruePaths]) -> dict[str, Any]:
    """Return place, variables and curves of the law, in the strata whose free-form answers are scored."""
    if p.case.stratum not in ("left_out", "random_law"):
        return {}
    form = cause.form
    if isinstance(form, RandomForm):
        law = form.law(cause.draw)
    else:
        axes = [axis for axis, on in zip(AXES, cause.draw.axes, strict=True) if on]
        law = library_law(form.effect, form.stage, axes)
    setup = _setup(p, TRAIN).copy()
    form.change(setup, form.values(cause.draw, cause.severity, _about(p)), TRAIN, _about(p))
    curves = [curve_of(*curve, setup, _visited(curve[0], dynamic)) for curve in law.curves]
    return {"law": law.to_dict() | {"curves": curves}}


def _visited(variable: str, dynamic: list[TruePaths]) -> np.ndarray:
    """Values (n,) that a variable of a law took in the dynamic trials [SI], places from the start on."""
    if variable in PLACES:
        return np.concatenate(
            [d.joints[:, PLACES.index(variable)] - d.joints[0, PLACES.index(variable)] for d in dynamic]
        )
    if variable in SPEEDS:
        return np.concatenate([d.joint_rates[:, SPEEDS.index(variable)] for d in dynamic])
    values = np.concatenate([d.q if variable.startswith("q_") else d.qd for d in dynamic])
    along: np.ndarray = values[:, AXES.index(variable[2:])]
    return along
