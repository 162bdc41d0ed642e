"""Simulate, measure and write the cases of one shard; their truth goes to a file that no analysis reads."""

from __future__ import annotations

import copy
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from real2sim.artefacts import write_json
from real2sim.files import write_text
from real2sim.recording.subjects import SYNTHETIC_NOTICE
from real2sim.verification.phantom import exports, tasks
from real2sim.verification.phantom.exports import Trial
from real2sim.verification.phantom.motions import Motion, pelvis_path
from real2sim.verification.phantom.person import UNITS, Person, draw_person
from real2sim.verification.phantom.physics import AXES, PelvisPath, Robot, TruePaths, robot_controller
from real2sim.verification.suite import excitation
from real2sim.verification.suite.effects import Draw, axis_weights
from real2sim.verification.suite.forms import FORMS
from real2sim.verification.suite.gaps import gaps, record_of, run_keys, with_effects
from real2sim.verification.suite.measurement import (
    Recording,
)
from real2sim.verification.suite.plan import Case, case_names, cases, stream
from real2sim.verification.suite.random_forms import RandomForm
from real2sim.verification.suite.severity import (
    HELD_OUT,
    TRAIN,
    Fit,
    Search,
)
from real2sim.verification.suite.synthetic import (
    Cause,
    Synthetic,
    World,
    about_of,
    applied,
    cause_truth,
    describe,
    linearise,
    setup_of,
)
from real2sim.verification.suite.true_laws import PLACES, SPEEDS, curve_of, library_law

TRIALS = ("neutral", TRAIN, HELD_OUT)
FURTHER = "dynamic_3"
# Most draws of an effect until it acts along one asked axis alone: about one in ten does
_MOST_DRAWS = 1000


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
    world = World(suite, settings, coarse, fine)
    describe(world, people)
    say("trials without effects")
    linearise(world, people)
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


# -------------------- people and trials


def _synthesise(
    suite: dict[str, Any],
    case: Case,
    phantom: dict[str, Any],
    controllers: dict[str, Any],
    robot: Robot,
    further: Motion | None,
) -> Synthetic:
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
    causes = [Cause(FORMS[name], name) for name in case.forms]
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
    return Synthetic(case, person, settings, motions, paths, starts, hands, smooth, tuple(regime), causes)


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


# -------------------- severity


def _solve(world: World, people: list[Synthetic], say: Callable[[str], None]) -> None:
    """Choose the draw of every cause and the severity that makes the gap asked for."""
    options = world.suite["severity"]
    jobs: list[tuple[Synthetic, Cause]] = [(p, c) for p in people for c in p.causes]
    trials: list[tuple[Synthetic, Cause, Draw, float]] = []
    for p in people:
        _draw(world.suite, p, options["candidates"])
    for p, cause in jobs:
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
    together = gaps(world, mixed, [applied(p) for p in mixed], starts) if mixed else []
    for p in people:
        if p.causes:
            p.rho, p.left = p.causes[0].rho, p.causes[0].left[p.causes[0].severity]
    for p, fit in zip(mixed, together, strict=True):
        p.rho, p.left = fit.visibility(), fit.held_out


def _draw(suite: dict[str, Any], p: Synthetic, count: int) -> None:
    """Draw ``count`` candidates of every cause of a person, in `shared_axis` all of them along one axis."""
    shared = None
    if p.case.stratum == "shared_axis":
        weights, rng = axis_weights(), stream(suite, p.case.id, "axis")
        shared = np.arange(6) == rng.choice(6, p=weights / weights.sum())
    for cause in p.causes:
        rng = stream(suite, p.case.id, cause.name, "draw")
        cause.candidates = [_one_draw(cause, rng, p, shared) for _ in range(count)]


def _one_draw(cause: Cause, rng: np.random.Generator, p: Synthetic, axes: np.ndarray | None) -> Draw:
    """One draw of a cause, along these ``axes`` (6,) and no others where they are given."""
    for _ in range(_MOST_DRAWS):
        draw = cause.form.draw(rng, about_of(p))
        if axes is None or np.array_equal(draw.axes, axes):
            return draw
    raise RuntimeError(
        f"{p.case.id}: {cause.name} was not drawn along the pair's axis in {_MOST_DRAWS} draws"
    )


def _settle(world: World, jobs: list[tuple[Synthetic, Cause]], options: dict[str, Any]) -> None:
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


def _quieten(p: Synthetic, most: float, lowest_m: float) -> float:
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


_Asked = list[tuple[Synthetic, Cause, Draw, float]]


def _alone(world: World, asked: _Asked, starts: list[np.ndarray] | None = None) -> list[Fit]:
    """Refit of the base to each cause alone, at a severity."""
    effects = [[(c.form, c.form.values(draw, s, about_of(p)))] for p, c, draw, s in asked]
    return gaps(world, [p for p, *_ in asked], effects, starts)


def _again(world: World, asked: _Asked) -> None:
    """Refit from where the cause's last refit ended, with tangents of that place; the cause keeps what it finds."""
    fits = _alone(world, asked, [cause.moved for _, cause, _, _ in asked])
    for (_, cause, _, severity), fit in zip(asked, fits, strict=True):
        cause.moved, cause.rho, cause.left[severity] = fit.moved, fit.visibility(), fit.held_out


# -------------------- true trials and files


@dataclass
class _Measured:
    """A true trial at the fine step: the pelvis' path, the true paths, and what is recorded before noise."""

    path: PelvisPath
    paths: TruePaths
    recording: Recording


def _simulate(world: World, people: list[Synthetic]) -> list[dict[str, _Measured]]:
    """All trials of every case with its effects."""
    setups = {(i, t): with_effects(p, t, applied(p)) for i, p in enumerate(people) for t in p.motions}
    done = run_keys(world.fine, world.stops, setups)
    out: list[dict[str, _Measured]] = [{} for _ in people]
    for (i, trial), paths in done.items():
        if not np.isfinite(paths.left).all():
            raise RuntimeError(
                f"{people[i].case.id} {trial}: the simulation is unstable, {people[i].case.forms}"
            )
        path = setups[i, trial].path
        recording = record_of(people[i], trial, path, paths, applied(people[i]))
        out[i][trial] = _Measured(path, paths, recording)
    return out


def _write(p: Synthetic, true: dict[str, _Measured], folder: Path, home: np.ndarray) -> dict[str, Any]:
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
    text = f"# {SYNTHETIC_NOTICE}\n" + yaml.safe_dump(facts, sort_keys=False, default_flow_style=False)
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
    p: Synthetic, notes: dict[str, Any], shares: dict[str, float] | None, dynamic: list[TruePaths]
) -> dict[str, Any]:
    assert p.refit is not None
    return {
        "id": p.case.id,
        "stratum": p.case.stratum,
        "effects": [
            cause_truth(p, cause)
            | {"visibility": {"target": p.case.target, "alone": cause.rho}}
            | _law_truth(p, cause, dynamic)
            for cause in p.causes
        ],
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


def _law_truth(p: Synthetic, cause: Cause, dynamic: list[TruePaths]) -> dict[str, Any]:
    """Return place, variables and curves of the law, in the strata whose free-form answers are scored."""
    if p.case.stratum not in ("left_out", "random_law"):
        return {}
    form = cause.form
    if isinstance(form, RandomForm):
        law = form.law(cause.draw)
    else:
        axes = [axis for axis, on in zip(AXES, cause.draw.axes, strict=True) if on]
        law = library_law(form.effect, form.stage, axes)
    setup = setup_of(p, TRAIN).copy()
    form.change(setup, form.values(cause.draw, cause.severity, about_of(p)), TRAIN, about_of(p))
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
