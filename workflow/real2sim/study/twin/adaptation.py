"""What a coupled walk looks like, simulated or measured: gait cycles, ranges of motion, interface cloud, forces."""

from __future__ import annotations

from collections.abc import Iterable
from itertools import pairwise
from typing import Any

import numpy as np
import scipy

from real2sim.geometry import AXES, rotation_xyz
from real2sim.signals import lowpass
from real2sim.study.twin.coupled import Recording
from real2sim.study.twin.gait import SAGITTAL, Walk, heel_strikes, settled, strides, whole_strides
from real2sim.study.twin.human import FEET

JOINT_NAMES = dict(zip(SAGITTAL, ("hip", "knee", "ankle"), strict=True))
CYCLE = 101  # samples of a normalised cycle, 0-100 %
# Part of the cycle, from heel strike, in which the whole foot is on the floor
_FLAT = (0.15, 0.35)
DRAWN = 300  # samples of a cloud that a figure shows, at most


def cycles_of(recording: Recording, settle_s: float) -> dict[str, np.ndarray]:
    """Normalised strides (k, 101) [degrees] of each sagittal joint, both legs, from whole strides after settling."""
    time = recording.time_s
    out: dict[str, list[np.ndarray]] = {joint: [] for joint in SAGITTAL}
    for row in range(len(recording.alive)):
        for side in FEET:
            ahead, along = recording.heel_ahead[side][row], recording.heel_along[side][row]
            known = np.isfinite(ahead) & (time >= settle_s)
            if known.sum() < 100:
                continue
            t = time[known]
            speed = float((along[known][-1] - along[known][0]) / (t[-1] - t[0]))
            strikes = settled(t, along[known], heel_strikes(t, ahead[known]), speed)
            for joint in SAGITTAL:
                curve = np.degrees(recording.joints[f"{joint}_{side}"][row][known])
                out[joint].append(strides(t, curve, strikes, CYCLE))
    return {joint: np.concatenate(rows) if rows else np.empty((0, CYCLE)) for joint, rows in out.items()}


def measured_cycles(walks: list[Walk]) -> dict[str, np.ndarray]:
    """Return the normalised strides (k, 101) [degrees] of each sagittal joint, both legs, of measured walks."""
    return {
        joint: np.concatenate(
            [
                strides(w.time_s, np.degrees(w.joints[f"{joint}_{side}"]), w.strikes[side], CYCLE)
                for w in walks
                for side in FEET
            ]
        )
        for joint in SAGITTAL
    }


def _strikes_of(recording: Recording, row: int, side: str, known: np.ndarray) -> np.ndarray:
    """Return the times of a foot's strikes [s] among the ``known`` samples of a walker."""
    time = recording.time_s[known]
    along = recording.heel_along[side][row][known]
    speed = float((along[-1] - along[0]) / (time[-1] - time[0]))
    return settled(time, along, heel_strikes(time, recording.heel_ahead[side][row][known]), speed)


def gait_of(recording: Recording, settle_s: float) -> dict[str, Any]:
    """Return how walkers went after settling, each figure a mean over them; {} where nobody has a whole stride.

    ``speed_m_per_s`` of the pelvis, ``stride_m``, ``cadence_per_min`` (steps), ``stride_speed_m_per_s`` (stride times
    half the cadence), ``stance_slip_m_per_s`` (RMS speed over the floor of a heel that stands on it, from foot flat to
    heel off, ``_FLAT`` of the cycle; None where none stands), ``heel_stands_share`` (share of that time in which it
    does), ``pelvis_rotation_deg`` (range of the heading within a stride), ``robot_speed_m_per_s`` (None without a
    robot).
    """
    rows = []
    for row in range(len(recording.alive)):
        known = np.isfinite(recording.along[row]) & (recording.time_s >= settle_s)
        if known.sum() < 100:
            continue
        found = [f for side in FEET if (f := _stride_figures(recording, row, side, known))]
        if found:
            time, along = recording.time_s[known], recording.along[row][known]
            speed = (along[-1] - along[0]) / (time[-1] - time[0])
            robot = float(np.mean(recording.base_speed[row][known]))
            rows.append([speed, robot, *np.mean(found, axis=0)])
    if not rows:
        return {}
    speed, robot, length, lasts, moves, stands, turn = np.mean(rows, axis=0)
    return {
        "speed_m_per_s": float(speed),
        "stride_m": float(length),
        "cadence_per_min": float(120 / lasts),
        "stride_speed_m_per_s": float(length / lasts),
        "stance_slip_m_per_s": float(np.sqrt(moves / stands)) if stands else None,
        "heel_stands_share": float(stands),
        "pelvis_rotation_deg": float(turn),
        "robot_speed_m_per_s": float(robot) if np.isfinite(robot) else None,
    }


def _stride_figures(recording: Recording, row: int, side: str, known: np.ndarray) -> list[float]:
    """Return stride length [m] and time [s], slip of the heel and its share of standing, range of heading [deg].

    The slip is the mean over foot flat to heel off of the square of the heel's speed over the floor [m2/s2], zero where
    it does not stand on it: at or below its level.
    """
    strikes = _strikes_of(recording, row, side, known)
    if len(strikes) < 2:
        return []
    time = recording.time_s[known]
    heel = np.column_stack([recording.heel_along[side][row][known], recording.heel_across[side][row][known]])
    stands = recording.heel_above[side][row][known] <= 0.0
    moving = np.where(stands, np.sum(np.gradient(heel, time, axis=0) ** 2, axis=1), 0.0)
    yaw = np.degrees(np.unwrap(recording.pelvis_yaw[row][known]))
    slips, turns = [], []
    for a, b in pairwise(strikes):
        phase = (time - a) / (b - a)
        flat = (phase >= _FLAT[0]) & (phase <= _FLAT[1])
        slips.append([moving[flat].mean(), stands[flat].mean()])
        turns.append(np.ptp(yaw[(phase >= 0) & (phase <= 1)]))
    length = np.diff(np.interp(strikes, time, heel[:, 0])).mean()
    return [float(length), float(np.diff(strikes).mean()), *np.mean(slips, axis=0), float(np.mean(turns))]


def measured_gait(walks: list[Walk]) -> dict[str, Any]:
    """Return speed, stride, cadence and pelvis rotation of measured walks in the form of `gait_of`."""
    speed = float(np.mean([w.speed for w in walks]))
    lasts = float(np.mean([w.stride_s for w in walks]))
    headings = [
        np.degrees(w.joints["pelvis_rotation"][(w.time_s >= a) & (w.time_s <= b)])
        for w in walks
        for side in FEET
        for a, b in whole_strides(w.strikes[side])
    ]
    turns = [np.nanmax(h) - np.nanmin(h) for h in headings if np.isfinite(h).any()]
    return {
        "speed_m_per_s": speed,
        "stride_m": speed * lasts,
        "cadence_per_min": 120 / lasts,
        "pelvis_rotation_deg": float(np.mean(turns)) if turns else None,
    }


def describe(cycles: dict[str, np.ndarray], other: dict[str, np.ndarray] | None = None) -> dict[str, Any]:
    """Return curve, range of motion and peak of cycles (k, 101) [degrees] by joint, and r with the mean of ``other``'s.

    Each as mean and SD over the cycles.
    """
    out: dict[str, Any] = {}
    for joint, rows in cycles.items():
        if not len(rows):
            out[joint] = {"cycles": 0}
            continue
        mean, rom, peak = rows.mean(axis=0), np.ptp(rows, axis=1), rows.max(axis=1)
        entry: dict[str, Any] = {
            "cycles": len(rows),
            "mean_deg": [round(float(v), 3) for v in mean],
            "sd_deg": [round(float(v), 3) for v in rows.std(axis=0)],
            "rom_deg": [float(rom.mean()), float(rom.std())],
            "peak_deg": [float(peak.mean()), float(peak.std())],
        }
        if other is not None and len(other[joint]):
            entry["r"] = float(np.corrcoef(mean, other[joint].mean(axis=0))[0, 1])
        out[joint] = entry
    return out


def cloud(q: Iterable[np.ndarray], rate_hz: float, cutoff_hz: float, order: int) -> dict[str, Any]:
    """Spread of the interface midpoint relative to the pelvis over trials q, (n, 6) each [m, rad]; NaN where unknown.

    Low-passed, each trial about its own mean. ``sigma_mm`` x, y, z (mean over trials, SD), ``gamma`` = sigma_x /
    sigma_y of the means, the 95 % ellipse of the pooled x-y cloud (paper, section V-C.1), and ``points_mm``, samples of
    it evenly spaced in time, to draw.
    """
    centred, sigmas = [], []
    for trial in q:
        if len(trial) <= rate_hz:
            continue
        smooth = lowpass(trial[:, :3], rate_hz, cutoff_hz, order)
        known = smooth[np.isfinite(smooth).all(axis=1)]
        if len(known) > rate_hz:
            centred.append(known - known.mean(axis=0))
            sigmas.append(centred[-1].std(axis=0))
    if not sigmas:
        return {"trials": 0}
    sigma = 1e3 * np.array(sigmas)
    mean = sigma.mean(axis=0)
    pooled = np.concatenate(centred)[:, :2]
    values, vectors = np.linalg.eigh(np.cov(pooled.T))
    axes = 1e3 * np.sqrt(values[::-1] * scipy.stats.chi2.ppf(0.95, 2))
    return {
        "trials": len(sigmas),
        "sigma_mm": mean.tolist(),
        "sigma_sd_mm": sigma.std(axis=0).tolist(),
        "gamma": float(mean[0] / mean[1]),
        "ellipse": {
            "semi_axes_mm": axes.tolist(),
            "angle_deg": float(np.degrees(np.arctan2(vectors[1, 1], vectors[0, 1]))),
            "area_mm2": float(np.pi * axes[0] * axes[1]),
        },
        "points_mm": np.round(1e3 * pooled[:: -(-len(pooled) // DRAWN)], 2).tolist(),
    }


def on_interface(recording: Recording, rest: np.ndarray) -> np.ndarray:
    """Return the strap's wrench (m, n, 6) on the interface in the interface's axes, as a sensor there reads it [N, Nm].

    ``rest`` (3, 3) is the interface's rotation in the pelvis frame where q = 0. The strap's own wrench is along the
    pelvis' axes; torques along its hinges are taken as a vector, which they are for small angles.
    """
    angles = np.nan_to_num(recording.interface[..., 3:])
    rotation = rotation_xyz(angles) @ rest
    parts = [recording.wrench[..., :3], recording.wrench[..., 3:]]
    return np.concatenate([np.einsum("...ji,...j->...i", rotation, part) for part in parts], axis=-1)


def wrench_cycles(recording: Recording, wrench: np.ndarray, settle_s: float) -> np.ndarray:
    """Return a wrench (m, n, 6) over whole strides from right heel strike, (k, 101, 6), after settling."""
    out = []
    for row in range(len(recording.alive)):
        known = np.isfinite(recording.along[row]) & (recording.time_s >= settle_s)
        if known.sum() >= 100:
            strikes = _strikes_of(recording, row, FEET[0], known)
            out.append(_six_strides(recording.time_s[known], wrench[row][known], strikes))
    return np.concatenate(out) if out else np.empty((0, CYCLE, 6))


def measured_wrench_cycles(
    walks: list[Walk], logged: list[tuple[np.ndarray, np.ndarray] | None]
) -> np.ndarray:
    """Return the logged wrench of measured walks over their strides (k, 101, 6) [N, Nm].

    ``logged`` are time (n,) [s] and wrench (n, 6) of each walk, None where it was not logged.
    """
    out = [
        _six_strides(*found, walk.strikes[FEET[0]])
        for walk, found in zip(walks, logged, strict=True)
        if found is not None
    ]
    return np.concatenate(out) if out else np.empty((0, CYCLE, 6))


def _six_strides(time_s: np.ndarray, wrench: np.ndarray, strikes: np.ndarray) -> np.ndarray:
    return np.stack([strides(time_s, column, strikes, CYCLE) for column in wrench.T], axis=-1)


def wrench_of(cycles: np.ndarray, other: np.ndarray | None = None) -> dict[str, dict[str, Any]]:
    """Return RMS, mean and mean peak of each component of a wrench over strides (k, 101, 6), and its mean curve.

    With the measured strides ``other``: ``rms_ratio`` to theirs, and the correlation ``r`` of the mean curves where
    they agree best, with the ``phase_percent`` of the cycle by which the first is late there.
    """
    cycles = cycles[np.isfinite(cycles).all(axis=(1, 2))]
    other = None if other is None else other[np.isfinite(other).all(axis=(1, 2))]
    if not len(cycles):
        return {}
    out: dict[str, dict[str, Any]] = {}
    for i, axis in enumerate(AXES):
        rows = cycles[..., i]
        mean = rows.mean(axis=0)
        out[axis] = {
            "strides": len(rows),
            "rms": float(np.sqrt(np.mean(rows**2))),
            "mean": float(rows.mean()),
            "peak": float(np.abs(rows).max(axis=1).mean()),
            "curve": np.round(mean, 3).tolist(),
        }
        if other is not None and len(other):
            theirs = other[..., i]
            r, late = _agreement(mean, theirs.mean(axis=0))
            ratio = out[axis]["rms"] / max(float(np.sqrt(np.mean(theirs**2))), 1e-9)
            out[axis] |= {"rms_ratio": ratio, "r": r, "phase_percent": late}
    return out


def _agreement(ours: np.ndarray, theirs: np.ndarray) -> tuple[float, float]:
    """Return the best correlation of two curves (101,) over a cycle, and the lateness of the first there [%].

    Within a quarter of a cycle either way: a force that repeats every step agrees as well half a cycle away.
    """
    one, other = ours[:-1] - ours[:-1].mean(), theirs[:-1] - theirs[:-1].mean()
    scale = np.linalg.norm(one) * np.linalg.norm(other)
    if not scale:
        return 0.0, 0.0
    lags = np.arange(-(len(one) // 4), len(one) // 4 + 1)
    r = np.array([np.roll(one, -k) @ other for k in lags]) / scale
    best = int(np.argmax(r))
    return float(r[best]), float(lags[best])
