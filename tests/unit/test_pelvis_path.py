"""The most probable pelvis path, given one that was measured with noise: what a replay is driven by."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from real2sim.configuration import validated
from real2sim.recording.pelvis import PathFilter, PathRule
from real2sim.signals import lowpass
from scipy.fft import idct

RATE, START, SD = 100.0, 50, 2e-3
RULE = PathRule(**validated({}, "config", Path("defaults"))["diagnosis"]["pelvis"])
TIME = np.arange(3000) / RATE
# standing for a second, then setting out within another
BEGUN = np.clip(TIME - 1, 0, 1) ** 3 * (10 - 15 * np.clip(TIME - 1, 0, 1) + 6 * np.clip(TIME - 1, 0, 1) ** 2)


def _noise(seed: int, count: int | None = None) -> np.ndarray:
    shape = (len(TIME), 6) if count is None else (count, len(TIME), 6)
    return SD * np.random.default_rng(seed).standard_normal(shape)


def _wander(seed: int) -> np.ndarray:
    """Paths (n, 6) of a person who stands for a second and then sways, as loud as the noise at 2.2 Hz."""
    count = len(TIME) + 400
    frequency = np.arange(count) * RATE / (2 * count)
    louder = np.sqrt((2.2 / 0.8) ** 6 / (1 + (frequency / 0.8) ** 6))
    white = np.random.default_rng(seed).standard_normal((count, 6))
    path = idct(SD * louder[:, None] * white, axis=0, norm="ortho")[200:-200]
    return path * BEGUN[:, None]


def _filter(path: np.ndarray) -> PathFilter:
    return PathFilter.of_path(path, _noise(99, 16), RATE, 12.0, START, RULE)


def test_what_is_left_of_a_path_does_not_depend_on_the_most_probable_one():
    """Only then does no parameter gain by passing on less of what drives it."""
    shares, usual, left, drawn = [], [], [], []
    for seed in range(4):
        true, noise = _wander(seed), _noise(10 + seed)
        made = _filter(true + noise)
        mean = made.most_probable(true + noise)
        # where neither motion nor noise is nearly all
        band = [
            lowpass(x, RATE, 3.0, 4) - lowpass(x, RATE, 1.5, 4) for x in (mean, true - mean, true + noise)
        ]
        shares.append(np.sum(band[0] * band[1]) / np.sum(band[0] ** 2))
        usual.append(np.sum(band[2] * (true - true - noise)) / np.sum(band[2] ** 2))
        left.append(np.mean((true - mean)[200:-200] ** 2))
        drawn.append(np.mean(made.left(_noise(20 + seed), np.random.default_rng(seed))[200:-200] ** 2))
    assert np.mean(usual) < -0.3
    assert abs(np.mean(shares)) < 0.1
    assert np.mean(drawn) == pytest.approx(np.mean(left), rel=0.2)


def test_noise_alone_is_no_motion():
    made = _filter(_noise(1))
    frequency = np.arange(len(made.passed)) * RATE / (2 * len(made.passed))
    assert made.passed[frequency > 2].mean() < 0.03


def test_what_laws_depend_on_is_low_passed_within_limits():
    """Of a person who stood still, nothing is left: no filter has a cut-off of zero."""
    assert _filter(_noise(2)).cutoff_hz(3.0, 12.0) == 3.0
    assert 3.0 < _filter(20 * _wander(2) + _noise(3)).cutoff_hz(3.0, 12.0) < 12.0
    assert _filter(_wander(2) + 1e3 * _noise(4)).cutoff_hz(3.0, 12.0) == 12.0


def test_a_motion_that_is_far_louder_than_the_noise_is_left_as_it_is():
    true = _wander(3)
    quiet = 0.01 * _noise(4)
    made = PathFilter.of_path(true + quiet, 0.01 * _noise(5, 16), RATE, 12.0, START, RULE)
    error = made.most_probable(true + quiet) - true
    assert error.std() < 0.01 * SD
    assert np.abs(error).max() < 0.2 * SD


def test_a_line_of_the_spectrum_counts_where_its_surroundings_do_not():
    """Steps are heard at a few frequencies alone; averaged over a hertz, they are as quiet as the noise."""
    step = 4e-4 * np.sin(2 * np.pi * 6.0 * TIME)[:, None] * np.ones(6)
    made = _filter(_wander(5) + step + _noise(6))
    without = _filter(_wander(5) + _noise(6))
    assert made.most_probable(step)[500:-500].std() > 0.5 * step.std()
    assert without.most_probable(step)[500:-500].std() < 0.2 * step.std()


def test_a_path_starts_where_the_person_stood_and_not_at_a_noisy_sample():
    """Markers of 3.4 mm put the first sample 6 mm off: a null was called a pair of lags."""
    starts = []
    for seed in range(30):
        path = _wander(seed) + 1.7 * _noise(50 + seed)
        made = PathFilter.of_path(path, 1.7 * _noise(99, 8), RATE, 12.0, START, RULE)
        starts.append(made.most_probable(path)[0])
    assert np.std(starts) < 1.2e-3


def test_a_path_that_ends_in_motion_keeps_its_end():
    """A spectrum takes the end of a walk for a jump, which would count as motion at every frequency."""
    true = _wander(7) + 1.2 * np.cumsum(BEGUN)[:, None] / RATE
    made = _filter(true + _noise(8))
    frequency = np.arange(len(made.passed)) * RATE / (2 * len(made.passed))
    assert made.passed[(frequency > 5) & (frequency < 12)].mean() < 0.05
    end = made.most_probable(true + _noise(8))[-30:] - true[-30:]
    assert np.sqrt(np.mean(end**2)) < 1.5 * SD
