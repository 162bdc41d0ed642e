"""Legs of the synthetic person: joint angles from Fourier terms, foot markers from planted footprints."""

from __future__ import annotations

from typing import Any

import numpy as np

from real2sim.verification.phantom.motions import Motion, smooth
from real2sim.verification.phantom.person import active


def leg_angles(
    settings: dict[str, Any], kind: str, motion: Motion, t: np.ndarray, rng: np.random.Generator
) -> dict[str, np.ndarray]:
    """hip_flexion, knee_angle, ankle_angle of both legs (m,) [rad] at times t (m,) [s].

    Walking: published mean curves, scaled to the range of motion of the settings. Else: knees and hips bend
    as the pelvis drops.
    """
    if not kind.startswith("walk"):
        return _crouch(motion(t)[0][:, 2])
    gait = settings["gait"]
    envelope = motion.envelope(t)[0]
    spread = settings["effects"]["gait_variability"]["sd"] * active(settings, "effects", "gait_variability")
    out = {}
    for side, shift in (("r", 0.0), ("l", 0.5)):
        phase = (t - motion.ramp[0]) / gait["stride_s"] + shift
        for joint, name in (("hip", "hip_flexion"), ("knee", "knee_angle"), ("ankle", "ankle_angle")):
            mean, wave = _wave(gait[kind][joint], gait[kind]["range_of_motion_deg"][joint], phase)
            # strides differ a little: a slow modulation of the amplitude
            slow = np.sin(2 * np.pi * 0.21 * t + rng.uniform(0, 2 * np.pi)) + rng.standard_normal()
            out[f"{name}_{side}"] = np.radians(envelope * (mean + (1 + spread * slow / 2) * wave))
    return out


def _wave(curve: dict[str, Any], target: float, phase: np.ndarray) -> tuple[float, np.ndarray]:
    def raw(p: np.ndarray) -> np.ndarray:
        pairs = enumerate(curve["terms"], start=1)
        waves = [a * np.cos(2 * np.pi * k * p) + b * np.sin(2 * np.pi * k * p) for k, (a, b) in pairs]
        total: np.ndarray = np.sum(waves, axis=0)
        return total

    return curve["mean"], raw(phase) * target / float(np.ptp(raw(np.linspace(0, 1, 400))))


def _crouch(height: np.ndarray) -> dict[str, np.ndarray]:
    leg = 0.81  # thigh and shank of the Rajagopal model [m]
    bend = np.arccos(np.clip(1 + np.minimum(height, 0) / leg, -1, 1))
    heel_raise = np.arcsin(np.clip(np.maximum(height, 0) / 0.2, 0, 0.6))
    out = {}
    for side in "rl":
        out[f"hip_flexion_{side}"] = bend
        out[f"knee_angle_{side}"] = 2 * bend
        out[f"ankle_angle_{side}"] = bend - heel_raise
    return out


def foot_markers(
    settings: dict[str, Any], motion: Motion, t: np.ndarray, height_m: float, stance_x: float
) -> dict[str, np.ndarray]:
    """Heel and toe markers (m, 3) [m] in the heading frame, x from the pelvis pivot at rest, z from the
    floor.

    Feet stand still in stance; strikes follow the phase of the joint angles. ``stance_x`` is where the
    heels stand.
    """
    gait, feet = settings["gait"], settings["gait"]["feet"]
    stride, swing = gait["stride_s"], (1 - gait["stance"]) * gait["stride_s"]
    start = motion.ramp[0]
    out = {}
    for side, shift, sign in (("R", 0.0, -1), ("L", 0.5, 1)):
        x, heel_up, toe_up, here = np.zeros_like(t), np.zeros_like(t), np.zeros_like(t), 0.0
        first = 1 - shift if shift else 1.0
        for strike in np.arange(start + first * stride, t[-1] + stride, stride):
            speed = motion.speed * smooth((np.array([strike]) - motion.ramp[0]) / motion.ramp[1])[0][0]
            goal = motion.progress(np.array([strike]))[0] + 0.28 * speed * stride
            lift = strike - swing
            x += (goal - here) * smooth((t - lift) / swing)[0]
            heel_off = lift - 0.15 * stride
            heel_up += _bump((t - heel_off) / (strike - heel_off))
            toe_up += _bump((t - lift) / swing)
            here = goal
        y = np.full_like(t, sign * feet["half_width_m"])
        length = feet["foot_length_ratio"] * height_m
        out[f"{side}HEE"] = np.stack(
            [stance_x + x, y, feet["heel_height_m"] + feet["lift_m"] * heel_up], axis=-1
        )
        out[f"{side}TOE"] = np.stack(
            [stance_x + length + x, y, feet["toe_height_m"] + feet["lift_m"] * 0.4 * toe_up], axis=-1
        )
    return {name: out[name] for name in ("LHEE", "RHEE", "LTOE", "RTOE")}


def _bump(s: np.ndarray) -> np.ndarray:
    bump: np.ndarray = np.sin(np.pi * np.clip(s, 0, 1)) ** 2
    return bump
