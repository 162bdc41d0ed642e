"""Prescribed motion of a person's segment in all six coordinates, with exact rates."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.interpolate import make_interp_spline

from real2sim.verification.systems.recordings import raise_gradually

STILL_S, RISE_S = 0.7, 1.2


@dataclass(frozen=True)
class SegmentPath:
    """Poses at the steps of a simulation; arrays are (steps, trials, ...), world axes, SI.

    ``rotation`` (..., 3, 3); ``position``, ``velocity``, ``acceleration`` (..., 3) of the origin; ``omega``, ``alpha``
    (..., 3) angular velocity and acceleration.
    """

    time_s: np.ndarray
    rotation: np.ndarray
    position: np.ndarray
    velocity: np.ndarray
    acceleration: np.ndarray
    omega: np.ndarray
    alpha: np.ndarray


@dataclass(frozen=True)
class Excitation:
    """Motion of a segment: peak ``amplitudes`` (6,) of displacement along and turn about x, y, z [m, rad], and pace.

    Each coordinate is a sum of three sines at about ``base_hz`` and its ratios. ``sway`` of a standing person instead:
    whole cycles over the trial from standstill, whose mean is zero.
    """

    amplitudes: tuple[float, ...]
    base_hz: float = 1.0
    sway: bool = False


_RATIOS = np.array([0.43, 1.0, 1.71])
_SHARES = np.array([0.45, 0.4, 0.15])


def coordinates(
    time_s: np.ndarray, excitation: Excitation, duration_s: float, rng: np.random.Generator
) -> np.ndarray:
    """Return displacement and turn (n, 6) [m, rad] of the segment from its start pose."""
    out = np.empty((len(time_s), 6))
    rise = raise_gradually(time_s, STILL_S, RISE_S)
    for i, amplitude in enumerate(excitation.amplitudes):
        if excitation.sway:
            cycles = rng.choice([2, 3, 4, 5], 2, replace=False)
            w = 2 * np.pi * cycles / duration_s
            out[:, i] = amplitude / 2 * (np.cos(w[0] * time_s) - np.cos(w[1] * time_s))
            continue
        hz = excitation.base_hz * _RATIOS * rng.uniform(0.9, 1.1, 3)
        phase = rng.uniform(0, 2 * np.pi, 3)
        sine = np.sin(2 * np.pi * np.outer(time_s - STILL_S, hz) + phase) @ _SHARES
        out[:, i] = amplitude * rise * sine
    return out


def segment_path(
    step_s: float,
    duration_s: float,
    excitations: Sequence[Excitation],
    home: np.ndarray,
    seed: int,
    durations_s: Sequence[float],
) -> SegmentPath:
    """Return the path of all trials at once; the segment starts upright at ``home`` (3,) [m].

    Its rotation is R_z R_y R_x of the last three coordinates. ``durations_s`` are the lengths of the trials, over which
    sway has whole cycles.
    """
    time_s = np.arange(round(duration_s / step_s) + 1) * step_s
    all_coordinates = np.stack(
        [
            coordinates(time_s, e, d, np.random.default_rng([seed, i]))
            for i, (e, d) in enumerate(zip(excitations, durations_s, strict=True))
        ],
        axis=1,
    )
    spline = make_interp_spline(time_s, all_coordinates, k=5)
    c, c1, c2 = (spline.derivative(i)(time_s) if i else all_coordinates for i in range(3))
    rotation, rates_to_omega = _turned(c[..., 3:])
    omega = np.matmul(rates_to_omega, c1[..., 3:, None])[..., 0]
    alpha = make_interp_spline(time_s, omega, k=5).derivative()(time_s)
    return SegmentPath(time_s, rotation, home + c[..., :3], c1[..., :3], c2[..., :3], omega, alpha)


def _turned(angles: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return R_z R_y R_x (..., 3, 3) of angles (..., 3), and the map from their rates to angular velocity."""
    sine, cosine = np.sin(angles), np.cos(angles)
    zero, one = np.zeros_like(sine[..., 0]), np.ones_like(sine[..., 0])

    def matrix(rows: list[list[np.ndarray]]) -> np.ndarray:
        return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)

    s, c = np.moveaxis(sine, -1, 0), np.moveaxis(cosine, -1, 0)
    about_x = matrix([[one, zero, zero], [zero, c[0], -s[0]], [zero, s[0], c[0]]])
    about_y = matrix([[c[1], zero, s[1]], [zero, one, zero], [-s[1], zero, c[1]]])
    about_z = matrix([[c[2], -s[2], zero], [s[2], c[2], zero], [zero, zero, one]])
    both = np.matmul(about_z, about_y)
    return np.matmul(both, about_x), np.stack(
        [both[..., 0], about_z[..., 1], matrix([[zero], [zero], [one]])[..., 0]], axis=-1
    )
