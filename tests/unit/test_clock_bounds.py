"""Cramer-Rao bounds of the markerless clock against closed forms and against an estimate that reaches them."""

from __future__ import annotations

import numpy as np
import pytest
from real2sim.recording.formats.recordings import CoordinateRecording

from benchmarks import clock_bounds

RATE, NOISE = 60.0, {"position_m": 0.003, "angle_deg": 0.6, "cutoff_hz": 6.0}


def record(seconds: float, amplitude: float = 0.05, moving: str = "pelvis_tx") -> CoordinateRecording:
    t = np.arange(round(seconds * RATE)) / RATE
    columns = {name: np.zeros(len(t)) for name in clock_bounds.COORDINATES}
    columns[moving] = amplitude * np.sin(2 * np.pi * 0.5 * t)
    return CoordinateRecording(t, columns)


def test_white_noise_gives_the_textbooks_bound():
    white = NOISE | {"cutoff_hz": 29.999}
    bound = clock_bounds.bound(record(20), white, 0.0, known=True)
    speed = 0.05 * 2 * np.pi * 0.5
    # sum of v^2 is n / 2 times its square; a drift has the lever t - mean, of variance T^2 / 12
    offset = 0.003 / (speed * np.sqrt(20 * RATE / 2))
    assert bound.offset_s == pytest.approx(offset, rel=0.02)
    assert bound.drift == pytest.approx(offset / np.sqrt(20**2 / 12), rel=0.03)


def test_bound_falls_with_motion_and_with_duration():
    one, large, long = (
        clock_bounds.bound(record(*a), NOISE, 3e-4, known=True) for a in ((15,), (15, 0.1), (30,))
    )
    assert large.offset_s == pytest.approx(one.offset_s / 2, rel=1e-6)
    assert one.drift / long.drift == pytest.approx(2**1.5, rel=0.05)
    unknown = clock_bounds.bound(record(15), NOISE, 3e-4, known=False)
    assert unknown.drift >= one.drift


def test_generalised_least_squares_reaches_the_bound():
    path, rng = record(15), np.random.default_rng(1)
    least = clock_bounds.bound(path, NOISE, 3e-4, known=True)
    n = len(path.time_s)
    covariance = 9e-6 * clock_bounds._filtered(n, RATE, 6.0)
    covariance += (3e-4 * np.sqrt(RATE / 100) * 0.5) ** 2 * np.eye(n)
    root = np.linalg.cholesky(covariance)
    speed = np.gradient(path.columns["pelvis_tx"], 1 / RATE)
    design = np.linalg.solve(root, np.column_stack([speed, speed * (path.time_s - path.time_s.mean())]))
    errors = np.array([np.linalg.lstsq(design, rng.standard_normal(n), rcond=None)[0] for _ in range(2000)])
    assert errors.std(axis=0) == pytest.approx([least.offset_s, least.drift], rel=0.05)


def test_power_and_share_within_a_limit():
    assert clock_bounds.within(1.96, 1.0) == pytest.approx(0.95, abs=1e-3)
    assert clock_bounds.power(1e-9, 3.0, 1e-5, 2e-4) == pytest.approx(1.0)
    assert clock_bounds.power(1.0, 3.0, 1e-5, 2e-4) == pytest.approx(0.0027, abs=1e-4)
    assert clock_bounds.pooled([clock_bounds.Bound(0, 2.0)] * 4) == pytest.approx(1.0)
