"""Simulate, measure and write the synthetic people; the truth goes to a file that no analysis reads."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from real2sim.files import write_text
from real2sim.recording.subjects import SYNTHETIC_NOTICE
from real2sim.verification.cohort.gap import Gap
from real2sim.verification.cohort.plan import has_log, planned_files, trial_names
from real2sim.verification.phantom import exports
from real2sim.verification.phantom.exports import Trial
from real2sim.verification.phantom.motions import Motion, pelvis_path
from real2sim.verification.phantom.person import PARAMETER_NAMES, UNITS, Person, active, draw_person, stream
from real2sim.verification.phantom.physics import (
    AXES,
    PelvisPath,
    Robot,
    StrapLaw,
    TruePaths,
    robot_controller,
    simulate,
)
from real2sim.verification.phantom.tasks import motion_of

FREE = np.full(6, np.inf)  # a strap without stops


def write_subject(
    *,
    subject: str,
    settings: dict[str, Any],
    controllers: dict[str, Any],
    robot: Path,
    out: list[Path],
    truth: Path,
) -> None:
    """Write every raw export of one synthetic person, and the sealed truth.

    ``settings`` is config/phantom.yaml, ``controllers`` the robot's controllers (config.yaml, ``robot``),
    ``robot`` the MJCF of the robot; ``out`` names subject.yaml and every trial file in one folder, exactly as
    `plan.planned_files` does. Raises ValueError where ``out`` and the plan differ.
    """
    folder = Path(out[0]).parent
    planned = planned_files(settings, folder.parent, subject)
    if sorted(planned) != sorted(Path(p) for p in out):
        raise ValueError(
            f"the files asked for are not those planned for {subject}: {set(out) ^ set(planned)}"
        )
    simulated = simulate_subject(settings, controllers, robot, subject)
    notes = write_trials(folder, settings, robot, simulated)
    sealed = simulated.gap
    write_text(
        truth,
        json.dumps(
            _truth(settings, simulated.person, notes, robot, controllers)
            | ({} if sealed is None else {"gap": sealed.truth()}),
            indent=1,
            allow_nan=False,
        ),
    )


@dataclass
class Simulated:
    """A person with trials and their true paths, the robot's start pose (6,) by trial, and the sealed gap."""

    person: Person
    trials: list[Trial]
    starts: dict[str, np.ndarray]
    gap: Gap | None


def write_trials(folder: Path, settings: dict[str, Any], robot: Path, simulated: Simulated) -> dict[str, Any]:
    """Write subject.yaml and the raw exports of every trial into ``folder``; return what is sealed of each trial."""
    home = _base_home(robot)
    person = simulated.person
    notes: dict[str, Any] = {}
    for index, trial in enumerate(simulated.trials):
        clocks = exports.draw_clocks(settings, person, trial.name, index)
        notes[trial.name] = exports.write_trial_markers(folder / f"{trial.name}.tsv", settings, person, trial)
        exports.write_trial_coordinates(folder / f"{trial.name}.mot", settings, person, trial, clocks)
        if trial.truth is not None:
            exports.write_trial_log(folder / f"{trial.name}.mcap", settings, person, trial, clocks, home)
            notes[trial.name] |= _reached(trial.truth)
        notes[trial.name] |= {"clocks": clocks, "robot_start": simulated.starts[trial.name].tolist()}
    write_text(folder / "subject.yaml", _subject_yaml(person))
    return notes


def prepared(settings: dict[str, Any], robot: Robot, subject: str, names: Sequence[str]) -> Simulated:
    """Return a person and their trials before anything is simulated: paths of the pelvis and start poses."""
    person = draw_person(settings, subject, float(robot.rest_middle(np.zeros(6))[1][2]))
    starts = {name: _place(settings, person, name) for name in names}
    trials = [prepare(settings, person, robot, name, starts[name]) for name in names]
    return Simulated(person, trials, starts, None)


def simulate_subject(
    settings: dict[str, Any],
    controllers: dict[str, Any],
    robot: Path,
    subject: str,
    names: Sequence[str] | None = None,
) -> Simulated:
    """Return a person with their trials; ``names`` of the trials, all that are planned where none are given."""
    plant = Robot(robot, settings["simulation"]["step_s"])
    about_to_move = prepared(settings, plant, subject, names or trial_names(settings, subject))
    person, trials, starts = about_to_move.person, about_to_move.trials, about_to_move.starts
    with_robot = [t for t in trials if has_log(t.name)]
    law = _law(settings, person, [t.name for t in with_robot])
    hands = [robot_controller(settings, controllers, t.kind, starts[t.name]) for t in with_robot]
    done = simulate(plant, [t.path for t in with_robot], law, hands, settings["rates"]["log_hz"])
    for trial, paths in zip(with_robot, done, strict=True):
        trial.truth = paths
    if not settings["gap"]["enabled"]:
        return Simulated(person, trials, starts, None)
    about = [(t, hand) for t, hand in zip(with_robot, hands, strict=True) if t.kind in ("neutral", "dynamic")]
    sealed = Gap(
        settings,
        robot,
        person,
        motions={t.name: t.motion for t, _ in about},
        paths={t.name: t.path for t, _ in about},
        starts={t.name: starts[t.name] for t, _ in about},
        controllers={t.name: hand for t, hand in about},
    )
    sealed.put_into([t for t, _ in about])
    return Simulated(person, trials, starts, sealed)


def simulate_trial(
    *,
    robot: Path,
    settings: dict[str, Any],
    controllers: dict[str, Any],
    parameters: dict[str, float],
    motion: Motion,
    rest_rotation: np.ndarray,
    rest_position: np.ndarray,
    lower: np.ndarray = -FREE,
    upper: np.ndarray = FREE,
    start: np.ndarray | None = None,
    kind: str = "dynamic",
    pivot: np.ndarray | None = None,
    rate_hz: float = 100.0,
) -> TruePaths:
    """True paths of one trial with explicit values: no noise, no effects, nothing written.

    ``parameters`` k_tx … d_rz [SI]; (``rest_rotation`` (3, 3), ``rest_position`` (3,)) of the interface in
    the pelvis at q = 0; ``lower``, ``upper`` (6,) stops; ``start`` (6,) robot joints at t = 0. The robot's
    step is ``settings["simulation"]["step_s"]``.
    """
    plant = Robot(robot, settings["simulation"]["step_s"])
    start = np.zeros(6) if start is None else start
    pivot = np.array(settings["person"]["pivot_m"]) if pivot is None else pivot
    path = _path_from_start(plant, motion, start, rest_rotation, rest_position, pivot, 0.0)
    law = StrapLaw(
        np.array([[parameters[n] for n in PARAMETER_NAMES[:6]]]),
        np.array([[parameters[n] for n in PARAMETER_NAMES[6:]]]),
        np.array([lower]),
        np.array([upper]),
        np.array(settings["stops"]["stiffness"]),
        np.array(settings["stops"]["damping"]),
        rest_rotation[None],
        rest_position[None],
        np.zeros((1, 3)),
    )
    hands = robot_controller(settings, controllers, kind, start)
    return simulate(plant, [path], law, [hands], rate_hz)[0]


def _place(settings: dict[str, Any], person: Person, trial: str) -> np.ndarray:
    body, rng = settings["person"], stream(settings, person.name, trial, "placement")
    xy = body["placement_sd_m"] * rng.standard_normal(2)
    yaw = np.radians(body["placement_sd_deg"]) * rng.standard_normal()
    return np.array([*xy, yaw, 0.0, 0.0, 0.0])


def _path_from_start(
    plant: Robot,
    motion: Motion,
    start: np.ndarray,
    rest_rotation: np.ndarray,
    rest_position: np.ndarray,
    pivot: np.ndarray,
    tail: float,
) -> PelvisPath:
    # the pelvis that has q = 0 while the robot stands at its start pose
    rotation, position = plant.rest_middle(start)
    pelvis = rotation @ rest_rotation.T
    return pelvis_path(motion, float(start[2]), pelvis, position - pelvis @ rest_position, pivot, tail)


def prepare(settings: dict[str, Any], person: Person, plant: Robot, name: str, start: np.ndarray) -> Trial:
    """Return a trial before it is simulated: what the person does, and the pelvis' path from ``start`` (6,)."""
    motion = motion_of(settings, person, name)
    tail = settings["simulation"]["tail_s"]
    path = _path_from_start(
        plant, motion, start, person.rest_rotation, person.rest_position, person.pivot, tail
    )
    rotation, position = (x[0] for x in path(np.zeros(1))[:2])
    return Trial(name, motion, path, float(start[2]), position + rotation @ person.pivot, None)


def _law(settings: dict[str, Any], person: Person, names: list[str]) -> StrapLaw:
    migration = np.zeros(3)  # straps creep upward
    if active(settings, "effects", "strap_migration"):
        migration[2] = settings["effects"]["strap_migration"]["rate_m_per_min"] / 60
    levels = [int(n[-2:]) if "_T" in n else person.operating_level for n in names]
    n = len(names)
    return StrapLaw(
        np.tile(person.stiffness, (n, 1)),
        np.tile(person.damping, (n, 1)),
        np.array([person.stops[level][0] for level in levels]),
        np.array([person.stops[level][1] for level in levels]),
        np.array(settings["stops"]["stiffness"]),
        np.array(settings["stops"]["damping"]),
        np.tile(person.rest_rotation, (n, 1, 1)),
        np.tile(person.rest_position, (n, 1)),
        np.tile(migration, (n, 1)),
    )


def _base_home(robot: Path) -> np.ndarray:
    import mujoco

    model = mujoco.MjModel.from_xml_path(str(robot))
    home: np.ndarray = model.body("base").pos[:2].copy()
    return home


def _reached(paths: TruePaths) -> dict[str, Any]:
    return {
        "q_min": dict(zip(AXES, paths.q.min(axis=0).tolist(), strict=True)),
        "q_max": dict(zip(AXES, paths.q.max(axis=0).tolist(), strict=True)),
    }


def _subject_yaml(person: Person) -> str:
    facts = {"id": person.name, "phantom": True, **person.facts}
    head = f"# {SYNTHETIC_NOTICE}\n"
    return head + yaml.safe_dump(facts, sort_keys=False, default_flow_style=False)


def _truth(
    settings: dict[str, Any], person: Person, notes: dict[str, Any], robot: Path, controllers: dict[str, Any]
) -> dict[str, Any]:
    markerless, odometry = (
        exports.markerless_frame(settings, person),
        exports.odometry_frame(settings, person),
    )
    return {
        "phantom": True,
        "note": "Sealed truth of a synthetic person. No analysis may read this file.",
        "subject": person.name,
        "parameters": {
            name: {"value": value, "unit": UNITS[name]} for name, value in person.parameters.items()
        },
        "rest_pose": {
            "rotation": person.rest_rotation.tolist(),
            "position_m": person.rest_position.tolist(),
        },
        "operating_level_cm": person.operating_level,
        "stops": {
            str(level): {"lower": low.tolist(), "upper": high.tolist(), "units": ["m"] * 3 + ["rad"] * 3}
            for level, (low, high) in person.stops.items()
        },
        "pelvis_markers_m": {name: place.tolist() for name, place in person.markers.items()},
        "soft_tissue_m_per_rad": {name: c.tolist() for name, c in person.soft_tissue.items()},
        "marker_noise_sd_m": person.marker_noise_m,
        "markerless_frame": {"heading_rad": markerless[0], "origin_m": markerless[1].tolist()},
        "odometry_frame": {"heading_rad": odometry[0], "origin_m": odometry[1].tolist()},
        "effects": settings["effects"],
        "measurement": settings["measurement"],
        "seed": settings["seed"],
        "step_s": settings["simulation"]["step_s"],
        "controllers": controllers,
        "robot": robot.name,
        "trials": notes,
    }
