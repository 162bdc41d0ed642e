"""How a true trial is measured and written: Qualisys markers, markerless coordinates, robot log."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.signal import butter, sosfiltfilt
from scipy.spatial.transform import Rotation

from real2sim.recording.formats.opensim import write_coordinates
from real2sim.recording.formats.qualisys import write_markers
from real2sim.recording.formats.recordings import CoordinateRecording, MarkerRecording, RobotLog
from real2sim.recording.formats.robot_log import write_log
from real2sim.recording.subjects import SYNTHETIC_NOTICE
from real2sim.verification.phantom.gait import foot_markers, leg_angles
from real2sim.verification.phantom.motions import Motion
from real2sim.verification.phantom.person import Person, active, stream
from real2sim.verification.phantom.physics import ARM_JOINTS, PelvisPath, TruePaths

# Coordinates of Rajagopal2016.osim in its order; legs and arms are given per side.
_LEG = (
    "hip_flexion",
    "hip_adduction",
    "hip_rotation",
    "knee_angle",
    "knee_angle_*_beta",
    "ankle_angle",
    "subtalar_angle",
    "mtp_angle",
)
_ARM = ("arm_flex", "arm_add", "arm_rot", "elbow_flex", "pro_sup", "wrist_flex", "wrist_dev")


def _sided(name: str, side: str) -> str:
    return name.replace("*", side) if "*" in name else f"{name}_{side}"


RAJAGOPAL = (
    "pelvis_tilt",
    "pelvis_list",
    "pelvis_rotation",
    "pelvis_tx",
    "pelvis_ty",
    "pelvis_tz",
    *(_sided(name, side) for side in "rl" for name in _LEG),
    "lumbar_extension",
    "lumbar_bending",
    "lumbar_rotation",
    *(_sided(name, side) for side in "rl" for name in _ARM),
)

# Columns: OpenSim's ground axes X, Y, Z written in the world (x forward, y left, z up).
_TO_OPENSIM = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])
# Pelvis body of Rajagopal2016 against the ASIS-PSIS frame: marker coordinates ASIS (.0095, .0181, ±.1285) and
# PSIS (-.155, .035, ±.045) put the frame's x axis 5.9 degrees below the body's, and its origin at mid-ASIS.
_FRAME_DROP = np.arctan2(0.035 - 0.0181, 0.155 + 0.0095)
_ASIS_IN_BODY = np.array([0.0095, 0.0, 0.0181])


@dataclass
class Trial:
    """One trial before it is measured; ``truth`` is None without the robot, ``heading`` in rad.

    ``shown``, where markers are not where the truth has them: all of them (m, 3) [m, world] by times (m,) [s].
    """

    name: str
    motion: Motion
    path: PelvisPath
    heading: float
    pivot_start: np.ndarray
    truth: TruePaths | None
    shown: Callable[[np.ndarray], dict[str, np.ndarray]] | None = None

    @property
    def kind(self) -> str:
        """Trial name without its number or level."""
        return self.name.rsplit("_", 1)[0]


def draw_clocks(settings: dict[str, Any], person: Person, trial: str, index: int) -> dict[str, float]:
    """Offsets of the two other clocks: times of an event are t (Qualisys), see the keys for the others.

    ``markerless_start_s``: Qualisys time of the markerless record's time 0; ``markerless_drift``: its clock
    runs (1 + drift) times as fast; ``robot_start_s``: Qualisys time of the robot log's first message;
    ``robot_epoch_ns``: epoch of that message.
    """
    m, rng = settings["measurement"], stream(settings, person.name, trial, "clocks")
    start, drift, lead, epoch = 0.0, 0.0, 0.5, 0
    if active(settings, "measurement", "markerless_clock"):
        clock = m["markerless_clock"]
        start = float(rng.uniform(*clock["offset_s"]))
        drift = clock["drift_ms_per_min"] / 60e3 if person.name == clock["drift_person"] else 0.0
    if active(settings, "measurement", "robot_clock"):
        lead = float(rng.uniform(*m["robot_clock"]["lead_s"]))
        epoch = int(m["robot_clock"]["epoch_s"]) + 120 * index
        epoch = epoch * 10**9 + int(rng.integers(10**9))
    return {
        "markerless_start_s": start,
        "markerless_drift": drift,
        "robot_start_s": -round(lead, 6),
        "robot_epoch_ns": epoch,
    }


def _frame(settings: dict[str, Any], item: str, name: str) -> tuple[float, np.ndarray]:
    # heading [rad] and origin of another system's frame, seen from the world
    if not active(settings, "measurement", item):
        return 0.0, np.zeros(2)
    frame, rng = settings["measurement"][item], stream(settings, name, item)
    heading = np.radians(frame["heading_sd_deg"]) * rng.standard_normal()
    return float(heading), frame["position_sd_m"] * rng.standard_normal(2)


def markerless_frame(settings: dict[str, Any], person: Person) -> tuple[float, np.ndarray]:
    """Heading [rad] and origin (2,) [m] of the markerless ground frame in the world."""
    return _frame(settings, "markerless_frame", person.name)


def odometry_frame(settings: dict[str, Any], person: Person) -> tuple[float, np.ndarray]:
    """Heading [rad] and origin (2,) [m] of the odometry frame in the world."""
    return _frame(settings, "odometry_frame", person.name)


# -------------------- Qualisys


def write_trial_markers(
    path: Path,
    settings: dict[str, Any],
    person: Person,
    trial: Trial,
    positions: dict[str, np.ndarray] | None = None,
    smooth_hz: float | None = None,
) -> dict[str, Any]:
    """Write the marker trajectories of a trial; returns what the truth file keeps about it.

    ``positions`` (m, 3) [m, world] are the markers before noise where they are not the true ones; with ``smooth_hz``
    the export is low-passed (fourth order, zero phase), as some labs set their software to do.
    """
    rate = settings["rates"]["markers_hz"]
    t = np.arange(round(trial.motion.duration_s * rate)) / rate
    if positions is None:
        positions = true_markers(settings, person, trial, t) if trial.shown is None else trial.shown(t)
    rng = stream(settings, person.name, trial.name, "markers")
    for name, values in positions.items():
        values += person.marker_noise(rng, values.shape, rate)
        if smooth_hz is not None:
            positions[name] = smoothed(values, rate, smooth_hz)
    gaps = _gaps(settings, trial.kind, list(positions), t[-1], rng)
    for marker, start, end in gaps:
        positions[marker][(t >= start) & (t < end)] = np.nan
    write_markers(path, MarkerRecording(t, float(rate), positions), description=SYNTHETIC_NOTICE)
    return {"gaps": [{"marker": m, "start_s": s, "end_s": e} for m, s, e in gaps]}


def smoothed(values: np.ndarray, rate_hz: float, cutoff_hz: float) -> np.ndarray:
    """Return values (n, ...) after a fourth-order zero-phase low-pass along the first axis."""
    filtered: np.ndarray = sosfiltfilt(butter(2, cutoff_hz, fs=rate_hz, output="sos"), values, axis=0)
    return filtered


def true_markers(
    settings: dict[str, Any], person: Person, trial: Trial, t: np.ndarray
) -> dict[str, np.ndarray]:
    """Markers (m, 3) [m, world] at times t (m,), with soft tissue and without noise or gaps."""
    rotation, position = trial.path(t)[:2]
    angles = trial.motion(t)[0][:, 3:]
    out = {
        name: position + np.einsum("nij,nj->ni", rotation, place + angles @ person.soft_tissue[name].T)
        for name, place in person.markers.items()
    }
    if trial.truth is not None:
        for name, values in (("IF_L", trial.truth.left), ("IF_R", trial.truth.right)):
            out[name] = CubicSpline(trial.truth.time_s, values)(t)
    if trial.kind.startswith("walk"):
        c, s = np.cos(trial.heading), np.sin(trial.heading)
        turn = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
        origin = trial.pivot_start * np.array([1, 1, 0])
        height = person.facts["height_m"]
        feet = foot_markers(settings, trial.motion, t, height, stance_x=-0.05)
        out |= {name: origin + values @ turn.T for name, values in feet.items()}
    return out


def _gaps(
    settings: dict[str, Any], kind: str, names: list[str], end: float, rng: np.random.Generator
) -> list[tuple[str, float, float]]:
    if not active(settings, "measurement", "gaps"):
        return []
    g, out = settings["measurement"]["gaps"], []
    plan = [g["short_s"]] * g["short"] + ([g["long_s"]] * g["long"] if kind == "dynamic" else [])
    quiet = settings["trials"]["quiet_s"]
    for span in plan:
        length = float(rng.uniform(*span))
        start = float(rng.uniform(quiet, end - quiet - length))
        pool = [n for n in names if n[-3:] not in ("HEE", "TOE")]
        out.append((pool[rng.integers(len(pool))], round(start, 2), round(start + length, 2)))
    return out


# -------------------- markerless


def write_trial_coordinates(
    path: Path, settings: dict[str, Any], person: Person, trial: Trial, clocks: dict[str, float]
) -> None:
    """Write the OpenSim coordinates of a trial on the markerless system's own clock and ground frame."""
    rate = settings["rates"]["coordinates_hz"]
    start, drift = clocks["markerless_start_s"], clocks["markerless_drift"]
    own = np.arange(int((trial.motion.duration_s - start) * rate)) / rate
    columns = coordinates(settings, person, trial, start + own / (1 + drift))
    _add_markerless_noise(settings, person, trial, columns, rate)
    write_coordinates(path, CoordinateRecording(own, columns), name=f"Coordinates - {SYNTHETIC_NOTICE}")


def coordinates(
    settings: dict[str, Any], person: Person, trial: Trial, t: np.ndarray
) -> dict[str, np.ndarray]:
    """Rajagopal coordinates (m,) [rad, m] at Qualisys times t (m,), in the markerless frame, no noise."""
    scale = person.facts["height_m"] / 1.75
    heading, origin = markerless_frame(settings, person)
    rotation, position = trial.path(np.clip(t, 0, None))[:2]
    body = rotation @ Rotation.from_euler("y", -_FRAME_DROP).as_matrix()
    place = position - body @ (scale * _ASIS_IN_BODY)
    c, s = np.cos(heading), np.sin(heading)
    to_frame = np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]])
    ground = _TO_OPENSIM @ to_frame
    # body axes of OpenSim's pelvis: X forward, Y up, Z right
    angles = Rotation.from_matrix(ground @ body @ _TO_OPENSIM.T).as_euler("ZXY")
    translations = (place - np.array([*origin, 0.0])) @ ground.T
    out = {name: np.zeros(len(t)) for name in RAJAGOPAL}
    for i, name in enumerate(("pelvis_tilt", "pelvis_list", "pelvis_rotation")):
        out[name] = np.unwrap(angles[:, i])
    for i, name in enumerate(("pelvis_tx", "pelvis_ty", "pelvis_tz")):
        out[name] = translations[:, i]
    legs = leg_angles(
        settings,
        trial.kind,
        trial.motion,
        np.clip(t, 0, None),
        stream(settings, person.name, trial.name, "legs"),
    )
    out |= legs
    for side in "rl":
        out[f"knee_angle_{side}_beta"] = out[f"knee_angle_{side}"]
        out[f"arm_flex_{side}"] = np.full(len(t), np.radians(10.0))
        out[f"elbow_flex_{side}"] = np.full(len(t), np.radians(20.0))
    # the trunk keeps upright over the pelvis
    out["lumbar_extension"] = -(out["pelvis_tilt"] - out["pelvis_tilt"][0])
    out["lumbar_bending"] = -out["pelvis_list"]
    out["lumbar_rotation"] = -(out["pelvis_rotation"] - out["pelvis_rotation"][0])
    return {name: out[name] for name in RAJAGOPAL}


def _add_markerless_noise(
    settings: dict[str, Any], person: Person, trial: Trial, columns: dict[str, np.ndarray], rate: float
) -> None:
    if not active(settings, "measurement", "markerless_noise"):
        return
    noise, rng = (
        settings["measurement"]["markerless_noise"],
        stream(settings, person.name, trial.name, "markerless"),
    )
    low_pass = butter(2, noise["cutoff_hz"], fs=rate, output="sos")
    for name, values in columns.items():
        if not np.ptp(values):
            continue  # locked or held coordinates are exact in OpenSim
        white = sosfiltfilt(low_pass, rng.standard_normal(len(values)))
        sd = (
            noise["position_m"]
            if name.startswith("pelvis_t") and name[-2] == "t" and name[-1] in "xyz"
            else 0
        )
        values += (sd or np.radians(noise["angle_deg"])) * white / white.std()


# -------------------- robot


def write_trial_log(
    path: Path,
    settings: dict[str, Any],
    person: Person,
    trial: Trial,
    clocks: dict[str, float],
    base_home: np.ndarray,
) -> None:
    """Write the robot's log of a trial; ``base_home`` (2,) [m]: where the base stands at zero joints."""
    truth = trial.truth
    if truth is None:
        raise ValueError(f"{trial.name}: no robot in this trial")
    rate, start = settings["rates"]["log_hz"], clocks["robot_start_s"]
    own = np.arange(int((truth.time_s[-1] - start) * rate)) / rate
    # before the record begins, the robot stands at its start pose
    t = np.clip(start + own, 0, None)
    joints, rates = (
        CubicSpline(truth.time_s, truth.joints)(t),
        CubicSpline(truth.time_s, truth.joint_rates)(t),
    )
    base = _odometry(settings, person, joints, rates, base_home)
    arm = {name: np.stack([joints[:, 3 + i], rates[:, 3 + i]], axis=-1) for i, name in enumerate(ARM_JOINTS)}
    if active(settings, "measurement", "encoder"):
        _encode(settings, base, arm, stream(settings, person.name, trial.name, "encoder"))
    wrench = None
    if active(settings, "measurement", "wrench"):
        wrench = _wrench(settings, person, trial, t)
    log = RobotLog(
        start_ns=int(clocks["robot_epoch_ns"]),
        base_time_s=own,
        base=base,
        joint_time_s=own,
        joints=arm,
        wrench_time_s=None if wrench is None else own,
        wrench=wrench,
        sync_s=np.array([-start]),
    )
    write_log(path, log, metadata={"notice": SYNTHETIC_NOTICE})


def _odometry(
    settings: dict[str, Any], person: Person, joints: np.ndarray, rates: np.ndarray, base_home: np.ndarray
) -> dict[str, np.ndarray]:
    heading, origin = odometry_frame(settings, person)
    c, s = np.cos(heading), np.sin(heading)
    xy = (joints[:, :2] + base_home - origin) @ np.array([[c, -s], [s, c]])
    yaw = joints[:, 2] - heading
    cy, sy = np.cos(joints[:, 2]), np.sin(joints[:, 2])
    return {
        "x": xy[:, 0],
        "y": xy[:, 1],
        "yaw": yaw,
        "vx": cy * rates[:, 0] + sy * rates[:, 1],
        "vy": -sy * rates[:, 0] + cy * rates[:, 1],
        "wz": rates[:, 2].copy(),
    }


def _encode(
    settings: dict[str, Any],
    base: dict[str, np.ndarray],
    arm: dict[str, np.ndarray],
    rng: np.random.Generator,
) -> None:
    encoder = settings["measurement"]["encoder"]

    def read(values: np.ndarray, kind: str) -> None:
        values += encoder[f"noise_{kind}"] * rng.standard_normal(values.shape)
        step = encoder[f"step_{kind}"]
        values[:] = np.round(values / step) * step

    for name, kind in (("x", "m"), ("y", "m"), ("yaw", "rad")):
        read(base[name], kind)
    for name, values in arm.items():
        read(values[:, 0], "m" if name == "arm_lift" else "rad")


def _wrench(settings: dict[str, Any], person: Person, trial: Trial, t: np.ndarray) -> np.ndarray:
    # what a sensor at the interface midpoint would read: the strap on the interface, in interface axes
    truth, noise = trial.truth, settings["measurement"]["wrench"]
    assert truth is not None
    parts = [np.einsum("nji,nj->ni", truth.interface_rotation, v) for v in (truth.force, truth.torque)]
    clean = CubicSpline(truth.time_s, np.hstack(parts))(t)
    rng = stream(settings, person.name, trial.name, "wrench")
    sd = np.array([noise["force_sd_n"]] * 3 + [noise["torque_sd_nm"]] * 3)
    noisy: np.ndarray = clean + sd * rng.standard_normal(clean.shape)
    return noisy
