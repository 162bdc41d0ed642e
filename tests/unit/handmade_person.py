"""A person in closed form, as raw exports: what the pipeline must find is known exactly."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
from real2sim import geometry
from real2sim.configuration import validated
from real2sim.recording.formats.opensim import write_coordinates
from real2sim.recording.formats.qualisys import read_markers, write_markers
from real2sim.recording.formats.recordings import CoordinateRecording, MarkerRecording, RobotLog
from real2sim.recording.formats.robot_log import write_log
from scipy.spatial.transform import Rotation

SETTINGS = validated({}, "config", Path("defaults"))["ingest"]
SUBJECT = """id: S01
cohort: calibration
sex: female
age_years: 27
mass_kg: 60.5
height_m: 1.66
waist_m: 0.74
tightness: {loosest_cm: 3, tightest_cm: 11, safe_comfortable_cm: 8}
phantom: true
"""
TRIALS = ("neutral", "rotation_T08", "translation_T08", "dynamic_1", "walk_normal_1")
PELVIS = {
    "ASIS_L": (0.0, 0.13, 0.0),
    "ASIS_R": (0.0, -0.13, 0.0),
    "PSIS_L": (-0.16, 0.045, 0.0),
    "PSIS_R": (-0.16, -0.045, 0.0),
}
SYNC_S, MARKERLESS_OFFSET_S, ODOM_YAW = 1.25, -0.4, 0.6
SIDES = {"IF_L": (0.12, 0.17, 0.0), "IF_R": (0.12, -0.17, 0.0)}


def waves(t, seed, amplitudes, moving):
    """Smooth signals (n, k), at rest for the first and the last second."""
    rng = np.random.default_rng(seed)
    if not moving:
        return np.zeros((len(t), len(amplitudes)))
    rise, fall = np.clip((t - 1) / 2, 0, 1), np.clip((11 - t) / 2, 0, 1)
    envelope = (rise * fall) ** 3 * (10 - 15 * rise + 6 * rise**2) * (10 - 15 * fall + 6 * fall**2)
    frequency, phase = rng.uniform(0.3, 0.9, len(amplitudes)), rng.uniform(0, 6, len(amplitudes))
    return envelope[:, None] * np.sin(2 * np.pi * frequency * t[:, None] + phase) * amplitudes


def pelvis_pose(t, moving):
    w = waves(t, 1, [0.05, 0.06, 0.02, 0.06, 0.05, 0.3], moving)
    return Rotation.from_euler("ZYX", w[:, [5, 4, 3]]).as_matrix(), w[:, :3] + [0.0, 0.0, 0.95]


def robot_state(t, moving):
    """Base x, y, yaw and arm lift, roll, pitch in the world."""
    return waves(t, 2, [0.03, 0.04, 0.2, 0.01, 0.05, 0.04], moving)


def interface_pose(t, moving):
    x, y, yaw, lift, roll, pitch = robot_state(t, moving).T
    base = Rotation.from_euler("z", yaw[:, None]).as_matrix()
    arm = base @ Rotation.from_euler("XY", np.column_stack([roll, pitch])).as_matrix()
    pivot = np.column_stack([x - 0.55, y, lift + 0.95]) + base @ [0.43, 0.0, 0.0]
    return arm, pivot


def true_q(t, moving):
    def relative(times, move):
        r_i, pivot = interface_pose(times, move)
        return geometry.relative_pose(*pelvis_pose(times, move), r_i, pivot + r_i @ [0.12, 0.0, 0.0])

    r0, p0 = relative(np.zeros(1), False)
    r, p = relative(t, moving)
    return geometry.interface_coordinates(r, p, r0[0], p0[0])


def write_trial(folder, name, *, rate=100.0, sync=True, duration=12.0, first_frame=1):
    moving, robot = name != "neutral", not name.startswith("walk_normal")
    t = (first_frame - 1 + np.arange(int(duration * rate))) / rate
    r, p = pelvis_pose(t, moving)
    positions = {key: p + r @ local for key, local in PELVIS.items()}
    if robot:
        arm, pivot = interface_pose(t, moving)
        positions |= {key: pivot + arm @ local for key, local in SIDES.items()}
    write_markers(folder / f"{name}.tsv", MarkerRecording(t, rate, positions, first_frame))

    own = np.arange(0, 13, 1 / 60)
    r, p = pelvis_pose(own + MARKERLESS_OFFSET_S, moving)
    ground = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])  # world to OpenSim
    angles = np.unwrap(Rotation.from_matrix(ground @ r @ ground.T).as_euler("ZXY"), axis=0)
    values = np.hstack([angles, (p - [0.5, 0.3, 0.0]) @ ground.T, 0.3 + angles[:, :1]])
    names = [f"pelvis_{c}" for c in ("tilt", "list", "rotation", "tx", "ty", "tz")] + ["knee_angle_r"]
    columns = dict(zip(names, values.T, strict=True))
    write_coordinates(folder / f"{name}.mot", CoordinateRecording(own, columns))
    if robot:
        write_log(folder / f"{name}.mcap", log_of(moving, sync))


def log_of(moving, sync=True):
    own = np.arange(0, 13.5, 0.01)
    state = robot_state(own - SYNC_S, moving)
    rate = (robot_state(own - SYNC_S + 5e-5, moving) - robot_state(own - SYNC_S - 5e-5, moving)) / 1e-4
    c, s = np.cos(ODOM_YAW), np.sin(ODOM_YAW)
    base = {
        "x": 3 + c * state[:, 0] + s * state[:, 1],
        "y": -s * state[:, 0] + c * state[:, 1],
        "yaw": state[:, 2] - ODOM_YAW,
        "vx": np.cos(state[:, 2]) * rate[:, 0] + np.sin(state[:, 2]) * rate[:, 1],
        "vy": -np.sin(state[:, 2]) * rate[:, 0] + np.cos(state[:, 2]) * rate[:, 1],
        "wz": rate[:, 2],
    }
    joints = {
        name: np.column_stack([state[:, 3 + i], rate[:, 3 + i]])
        for i, name in enumerate(("arm_lift", "arm_roll", "arm_pitch"))
    }
    wrench = np.column_stack([np.sin(own + i) for i in range(6)])
    edges = np.array([SYNC_S]) if sync else None
    return RobotLog(10**18, own, base, own, joints, own, wrench, edges)


def write_person(folder, trials=TRIALS):
    """A whole person: subject.yaml and some trials."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "subject.yaml").write_text(SUBJECT)
    for name in trials:
        write_trial(folder, name)
    return folder


def change_markers(path, change):
    """Rewrite a marker export; ``change`` maps its positions by name to others."""
    recording = read_markers(path)
    write_markers(path, replace(recording, positions=change(dict(recording.positions))))
