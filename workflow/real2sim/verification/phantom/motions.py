"""Pelvis motions, analytic in time: smooth moves between poses, sums of sinusoids, forward progress.

A motion has six coordinates in the trial's heading frame: x, y, z of the pelvis pivot [m] and roll, pitch,
yaw [rad] relative to standing at rest; rotations are applied as Rz(yaw) Ry(pitch) Rx(roll). Moves are
septic blends (velocity, acceleration and jerk vanish at their ends), so the path is three times
differentiable.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
from scipy.interpolate import CubicSpline

from real2sim.verification.phantom.physics import PelvisPath, Poses


def smooth(s: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the septic step from 0 to 1 over s in [0, 1], of any shape, and its derivative by s."""
    s = np.clip(s, 0.0, 1.0)
    value = s**4 * (35 - 84 * s + 70 * s**2 - 20 * s**3)
    return value, 140 * s**3 * (1 - s) ** 3


def smooth_integral(s: np.ndarray) -> np.ndarray:
    """Return the integral of the septic step from 0 to s, of any shape, for s in [0, 1]."""
    s = np.clip(s, 0.0, 1.0)
    integral: np.ndarray = 7 * s**5 - 14 * s**6 + 10 * s**7 - 2.5 * s**8
    return integral


@dataclass
class Motion:
    """Six coordinates as functions of time.

    ``moves``: rows of start [s], duration [s] and six increments; ``sines``: rows of frequency [Hz], phase
    [rad] and six amplitudes, faded in and out by ``fade`` = (start, rise, end, fall) [s]; ``speed`` [m/s]
    is reached over ``ramp`` = (start, duration) [s].
    """

    duration_s: float
    moves: list[tuple[float, float, np.ndarray]] = field(default_factory=list)
    sines: list[tuple[float, float, np.ndarray]] = field(default_factory=list)
    fade: tuple[float, float, float, float] = (0.0, 1.0, np.inf, 1.0)
    speed: float = 0.0
    ramp: tuple[float, float] = (0.0, 1.0)

    def __call__(self, t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Coordinates (m, 6) and their rates (m, 6) at times t (m,)."""
        u, du = np.zeros((len(t), 6)), np.zeros((len(t), 6))
        if self.moves:
            start, duration = np.array([m[:2] for m in self.moves]).T
            steps = np.array([m[2] for m in self.moves])
            value, slope = smooth((t[:, None] - start) / duration)
            u += value @ steps
            du += (slope / duration) @ steps
        if self.sines:
            omega = 2 * np.pi * np.array([s[0] for s in self.sines])
            angle = t[:, None] * omega + np.array([s[1] for s in self.sines])
            amplitude = np.array([s[2] for s in self.sines])
            gain, slope = self.envelope(t)
            wave = np.sin(angle) @ amplitude
            u += gain[:, None] * wave
            du += slope[:, None] * wave + gain[:, None] * ((omega * np.cos(angle)) @ amplitude)
        if self.speed:
            u[:, 0] += self.progress(t)
            du[:, 0] += self.speed * smooth((t - self.ramp[0]) / self.ramp[1])[0]
        return u, du

    def envelope(self, t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the fade (m,) of the sinusoids in [0, 1] at times (m,) [s], and its rate (m,) [1/s]."""
        start, rise, end, fall = self.fade
        up, up_slope = smooth((t - start) / rise)
        if not np.isfinite(end):
            return up, up_slope / rise
        down, down_slope = smooth((t - end) / fall)
        return up * (1 - down), up_slope / rise * (1 - down) - up * down_slope / fall

    def progress(self, t: np.ndarray) -> np.ndarray:
        """Distance walked (m,) [m]."""
        start, duration = self.ramp
        s = (t - start) / duration
        return self.speed * (duration * smooth_integral(s) + np.maximum(t - start - duration, 0.0))


@dataclass
class SampledMotion(Motion):
    """A motion through sampled coordinates ``path`` (n, 6) [m, rad] at ``rate_hz``, by cubic splines."""

    path: np.ndarray = field(default_factory=lambda: np.zeros((2, 6)))
    rate_hz: float = 100.0

    def __post_init__(self) -> None:
        """Prepare the spline; the last sample is held."""
        spline = CubicSpline(np.arange(len(self.path)) / self.rate_hz, self.path)
        self._value, self._slope = spline, spline.derivative()

    def __call__(self, t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """As of `Motion`."""
        end = (len(self.path) - 1) / self.rate_hz
        inside = np.clip(t, 0.0, end)
        return self._value(inside), np.where((t <= end)[:, None], self._slope(inside), 0.0)


class PelvisMotion(Protocol):
    """Six coordinates (m, 6) and their rates (m, 6) at times t (m,) [s], as `Motion` gives them."""

    duration_s: float

    def __call__(self, t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Coordinates and rates [SI]."""


def _axes(angle: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    return np.cos(angle), np.sin(angle)


def pelvis_path(
    motion: PelvisMotion,
    heading: float,
    rest_rotation: np.ndarray,
    rest_position: np.ndarray,
    pivot: np.ndarray,
    tail_s: float,
) -> PelvisPath:
    """Return the world path of a pelvis that starts at (``rest_rotation`` (3, 3), ``rest_position`` (3,)).

    ``heading`` [rad] turns the motion's x axis; ``pivot`` (3,) [m] is the turning point in pelvis axes.
    """
    ch, sh = np.cos(heading), np.sin(heading)
    turn = np.array([[ch, -sh, 0], [sh, ch, 0], [0, 0, 1]])
    tilted = turn.T @ rest_rotation
    pivot_rest = rest_position + rest_rotation @ pivot

    def evaluate(t: np.ndarray) -> Poses:
        u, du = motion(t)
        (cr, sr), (cp, sp), (cy, sy) = (_axes(u[:, i]) for i in (3, 4, 5))
        rotation = np.empty((len(t), 3, 3))
        rotation[:, 0] = np.stack([cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr], axis=-1)
        rotation[:, 1] = np.stack([sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr], axis=-1)
        rotation[:, 2] = np.stack([-sp, cp * sr, cp * cr], axis=-1)
        spin = np.stack(
            [
                cy * cp * du[:, 3] - sy * du[:, 4],
                sy * cp * du[:, 3] + cy * du[:, 4],
                du[:, 5] - sp * du[:, 3],
            ],
            axis=-1,
        )
        r_p = turn @ rotation @ tilted
        omega = spin @ turn.T
        lever = r_p @ pivot
        position = pivot_rest + u[:, :3] @ turn.T - lever
        velocity = du[:, :3] @ turn.T - np.cross(omega, lever)
        return r_p, position, velocity, omega

    return PelvisPath(evaluate, motion.duration_s + tail_s)
