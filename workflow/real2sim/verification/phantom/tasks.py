"""What a synthetic person does in each trial, as a `Motion` of the pelvis."""

from __future__ import annotations

from typing import Any

import numpy as np

from real2sim.verification.phantom.motions import Motion
from real2sim.verification.phantom.person import Person, active, stream

_TO_SI = np.array([1e-3] * 3 + [np.pi / 180] * 3)  # poses are written in mm and degrees


def motion_of(settings: dict[str, Any], person: Person, trial: str) -> Motion:
    """Pelvis motion of one trial, deterministic by seed, person and trial."""
    kind = trial.rsplit("_", 1)[0]
    rng = stream(settings, person.name, trial, "motion")
    if kind == "dynamic":
        return dynamic(settings, rng)
    if kind.startswith("walk"):
        return walk(settings, kind, rng)
    if kind == "rotation":
        return rotation(settings, person.stops[int(trial[-2:])])
    if kind == "translation":
        return translation(settings)
    return neutral(settings, rng)


def neutral(settings: dict[str, Any], rng: np.random.Generator) -> Motion:
    """Quiet standing with a little sway; in whole cycles its mean over the swaying time is zero."""
    trials, sway = settings["trials"], settings["effects"]["neutral_sway"]
    motion = Motion(trials["neutral_s"])
    if not active(settings, "effects", "neutral_sway"):
        return motion
    motion.fade = (trials["quiet_s"] / 4, 1.0, trials["neutral_s"] - 1.3, 1.0)
    for cycles in (2, 3, 5):
        amplitude = np.array([sway["amplitude_m"]] * 3 + [np.radians(sway["amplitude_deg"])] * 3)
        amplitude = amplitude * rng.uniform(0.2, 0.6, 6) * np.array([1, 1, 0.2, 1, 1, 1])
        phase = rng.uniform(0, 2 * np.pi)
        whole = cycles if sway["whole_cycles"] else cycles * rng.uniform(0.1, 0.7)
        motion.sines.append((whole / (trials["neutral_s"] - 2.3), phase, amplitude))
    return motion


def dynamic(settings: dict[str, Any], rng: np.random.Generator) -> Motion:
    """Continuous reaching toward three cones in random order at the metronome's pace, and slow sway."""
    task, trials = settings["motions"]["dynamic"], settings["trials"]
    motion = Motion(trials["dynamic_s"])
    targets = np.array(task["targets"], float) * _TO_SI
    longest = max(task["durations_s"])
    t, here, last = trials["quiet_s"], np.zeros(6), -1
    end = trials["dynamic_s"] - 0.5
    while t + 2 * longest + max(task["dwells_s"]) < end:
        last = int(rng.choice([i for i in range(-1, len(targets)) if i != last]))
        goal = np.zeros(6) if last < 0 else targets[last]
        reach = np.max(np.abs(targets), axis=0)
        goal = goal * rng.uniform(0.75, 1.0) + task["variation"] * reach * rng.uniform(-1, 1, 6)
        duration = float(rng.choice(task["durations_s"]))
        motion.moves.append((t, duration, goal - here))
        t += duration + float(rng.choice(task["dwells_s"]))
        here = goal
    motion.moves.append((t, longest, -here))
    motion.fade = (trials["quiet_s"], 1.5, end - 2.0, 1.5)
    for row in task["sway"]:
        # each axis on a phase of its own, as two sinusoids in quadrature
        phase, amplitude = rng.uniform(0, 2 * np.pi, 6), np.array(row["pose"]) * _TO_SI
        motion.sines.append((row["frequency_hz"], 0.0, amplitude * np.cos(phase)))
        motion.sines.append((row["frequency_hz"], np.pi / 2, amplitude * np.sin(phase)))
    return motion


def _through(motion: Motion, start: float, steps: list[tuple[float, float, np.ndarray]]) -> Motion:
    # steps: move time, hold time, goal
    t, here = start, np.zeros(6)
    for move, hold, goal in steps:
        motion.moves.append((t, move, goal - here))
        t, here = t + move + hold, goal
    return motion


def rotation(settings: dict[str, Any], stops: tuple[np.ndarray, np.ndarray]) -> Motion:
    """Return yaw to both stops, lower and upper (6,) [m, rad], and beyond the slack, as in contralateral reaching."""
    task, trials = settings["motions"]["rotation"], settings["trials"]
    accompany = np.array(task["accompany"]) * _TO_SI
    beyond, steps = np.radians(task["overreach_deg"]), []
    for i in range(task["swings"]):
        side = 1 if i % 2 == 0 else -1
        # x, z and pitch go the same way on both sides; y, roll and yaw change sign
        goal = accompany * np.array([1, side, 1, side, 1, side])
        goal[5] = stops[1][5] + beyond if side > 0 else stops[0][5] - beyond
        steps.append((task["move_s"] if i == 0 else task["swing_s"], task["hold_s"], goal))
    steps.append((task["move_s"], 0.0, np.zeros(6)))
    return _through(Motion(trials["sweep_s"]), trials["quiet_s"], steps)


def translation(settings: dict[str, Any]) -> Motion:
    """Lateral reaches, leaning and dragging, crouch and tiptoe."""
    task, trials = settings["motions"]["translation"], settings["trials"]
    steps = [(task["move_s"], task["hold_s"], np.array(pose) * _TO_SI) for pose in task["poses"]]
    steps.append((task["move_s"], 0.0, np.zeros(6)))
    return _through(Motion(trials["sweep_s"]), trials["quiet_s"], steps)


def walk(settings: dict[str, Any], kind: str, rng: np.random.Generator) -> Motion:
    """Straight walking from standing; OpenSim's pelvis coordinates turned into x, y, z, roll, pitch, yaw."""
    gait, trials = settings["gait"], settings["trials"]
    motion = Motion(trials["walk_s"], speed=gait[kind]["speed_mps"])
    motion.ramp = (trials["quiet_s"], gait["ramp_s"])
    motion.fade = (trials["quiet_s"], gait["ramp_s"], np.inf, 1.0)
    spread = settings["effects"]["gait_variability"]["sd"] * active(settings, "effects", "gait_variability")
    where = {"tx": (0, 1), "tz": (1, -1), "ty": (2, 1), "list": (3, 1), "tilt": (4, -1), "rotation": (5, 1)}
    for name, terms in gait["pelvis"].items():
        column, sign = where[name]
        scale = sign * gait[kind]["pelvis_scale"][name] * (1 + spread * rng.standard_normal())
        for k, (cosine, sine) in enumerate(terms, start=1):
            amplitude = np.zeros(6)
            amplitude[column] = scale * np.hypot(cosine, sine) * _TO_SI[column]
            phase = np.arctan2(cosine, sine) - 2 * np.pi * k * trials["quiet_s"] / gait["stride_s"]
            motion.sines.append((k / gait["stride_s"], float(phase), amplitude))
    return motion
