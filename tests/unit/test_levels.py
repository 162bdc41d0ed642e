"""Noise is read off what stands above the band, or off repeats; a fast signal is kept between samples."""

from __future__ import annotations

import numpy as np
import pytest
from real2sim import signals
from real2sim.errors import InputError
from real2sim.recording.levels import moving_sd, scatter_of_pair, scatter_of_repeats, white_sd
from real2sim.recording.table import Recording
from real2sim.system.description import shipped_system

RATE_HZ = 600.0


def _moving(samples: int, sd: float, seed: int = 1) -> np.ndarray:
    """A sine of 70 Hz and a slow one with white noise, (samples, 1)."""
    time_s = np.arange(samples) / RATE_HZ
    clean = np.sin(2 * np.pi * 70 * time_s) + 3 * np.sin(2 * np.pi * 0.7 * time_s)
    return (clean + sd * np.random.default_rng(seed).standard_normal(samples))[:, None]


def test_noise_of_a_fast_motion_is_read_above_its_band():
    values = _moving(4000, 1e-3)
    assert moving_sd(values, RATE_HZ, 200.0)[0] == pytest.approx(1e-3, rel=0.15)
    assert white_sd(values)[0] > 20e-3  # third differences take the motion for noise


def test_a_line_above_the_band_is_not_taken_for_noise():
    values = _moving(4000, 1e-3)
    values[:, 0] += 0.1 * np.sin(2 * np.pi * 250 * np.arange(4000) / RATE_HZ)
    assert moving_sd(values, RATE_HZ, 200.0)[0] == pytest.approx(1e-3, rel=0.2)


def test_jumps_are_not_taken_for_noise():
    values = np.sin(2 * np.pi * np.arange(4000) / RATE_HZ)[:, None]
    values += 1e-3 * np.random.default_rng(2).standard_normal(values.shape)
    values[np.random.default_rng(3).choice(4000, 80, replace=False)] += 5.0
    assert moving_sd(values, RATE_HZ, 20.0)[0] == pytest.approx(1e-3, rel=0.3)


def test_without_room_above_the_band_third_differences_tell_the_noise():
    values = 1e-3 * np.random.default_rng(0).standard_normal((2000, 2))
    assert moving_sd(values, 100.0, 45.0) == pytest.approx(white_sd(values))


@pytest.mark.parametrize("told_off", [0.0, 0.02, -0.02])
def test_repeats_tell_the_noise_whatever_the_motion(told_off):
    period = 119.3
    phase = 2 * np.pi * np.arange(1500) / period
    rng = np.random.default_rng(3)
    motion = np.column_stack([np.sin(phase), np.tanh(20 * np.cos(phase))])
    scatter, count, length = scatter_of_repeats(
        motion + [0.01, 0.05] * rng.standard_normal(motion.shape), period * (1 + told_off)
    )
    assert count == 12
    assert length == pytest.approx(period, rel=2e-3)
    assert [s.sd for s in scatter] == pytest.approx([0.01, 0.05], rel=0.25)


def test_zeros_that_differ_between_repeats_are_told_apart_from_their_noise():
    rng = np.random.default_rng(7)
    laps = 0.01 * rng.standard_normal((40, 500)) + 0.2 * rng.standard_normal((40, 1))
    motion = np.tile(np.sin(2 * np.pi * np.arange(500) / 500), (40, 1))
    (scatter,), count, _ = scatter_of_repeats((motion + laps).reshape(-1, 1), 500.0)
    assert count == 39
    assert scatter.zero_sd == pytest.approx(0.2, rel=0.3)
    assert scatter.sd == pytest.approx(0.01, rel=0.5)


def test_what_a_measured_drive_explains_of_the_difference_between_repeats_is_no_noise():
    rng = np.random.default_rng(9)
    command = rng.standard_normal(2000)
    weights = np.exp(-np.arange(60) / 15)
    records = []
    for _ in range(2):
        drive = command + 0.2 * rng.standard_normal(2000)
        moved = np.convolve(drive, weights)[:2000] + 0.01 * rng.standard_normal(2000)
        records.append(np.column_stack([drive, moved]))
    drive, moved = scatter_of_pair(*records, driven=(0,))
    assert drive.sd == pytest.approx(0.2, rel=0.1)
    assert moved.sd == pytest.approx(0.01, rel=0.2)
    # not so of a drive that was not measured
    assert scatter_of_pair(*records)[1].sd > 0.3


def test_two_recordings_of_one_command_tell_the_noise_though_their_clocks_are_apart():
    time_s = np.arange(1200) / RATE_HZ
    rng = np.random.default_rng(4)
    one, other = (
        np.sin(2 * np.pi * 70 * (time_s - late))[:, None] + 0.01 * rng.standard_normal((1200, 1))
        for late in (0.0, 0.7 / RATE_HZ)
    )
    assert scatter_of_pair(one, other)[0].sd == pytest.approx(0.01, rel=0.3)


def test_values_between_samples_keep_a_fast_sine():
    time_s = np.arange(400) / 100.0
    fine = signals.upsampled(np.sin(2 * np.pi * 33 * time_s + 0.3)[:, None], 5)[:, 0]
    at = np.arange(len(fine)) / 500.0
    assert len(fine) == 399 * 5 + 1
    assert np.abs(fine - np.sin(2 * np.pi * 33 * at + 0.3))[300:-300].max() < 1e-4


@pytest.mark.parametrize("value", [5.0, 0.25, 0.0])
def test_a_column_that_stands_still_leaves_the_noise_of_others_as_it_is(value):
    """What interpolation rounds of a constant weighed more than all misfit of the columns that move."""
    time_s, rng = np.arange(1000) / 100, np.random.default_rng(0)
    one, other = (
        np.sin(2 * np.pi * (time_s + late) / 2)[:, None] + 0.01 * rng.standard_normal((1000, 1))
        for late in (0.0, 0.005)
    )
    still = np.full((1000, 1), value)
    (alone,), _, length = scatter_of_repeats(one, 196)
    (beside, constant), _, same = scatter_of_repeats(np.hstack([one, still]), 196)
    assert (beside.sd, same) == pytest.approx((alone.sd, length), rel=1e-9)
    assert (constant.sd, constant.zero_sd) == (0, 0)
    (alone,) = scatter_of_pair(one, other)
    beside, constant = scatter_of_pair(np.hstack([one, still]), np.hstack([other, still]))
    assert beside.sd == pytest.approx(alone.sd, rel=1e-9)
    assert (constant.sd, constant.zero_sd) == (0, 0)


def test_columns_that_stand_still_at_another_value_have_another_zero():
    still = np.full((100, 1), 0.25)
    (scatter,) = scatter_of_pair(still, still + 0.02)
    assert (scatter.sd, scatter.zero_sd) == pytest.approx((0, 0.02 / np.sqrt(2)))
    assert scatter_of_repeats(still, 20.0)[0] == (signals.Scatter(0.0, 0.0),)


def _recording(values: np.ndarray) -> Recording:
    return Recording("laps", np.arange(len(values)) / 100.0, {"motor_force_N": values, "carriage_m": values})


def test_a_description_trusts_no_further_than_its_repeats():
    phase = 2 * np.pi * np.arange(1000) / 100
    noise = 0.02 * np.random.default_rng(5).standard_normal(1000)
    scatter = _recording(np.sin(phase) + noise).scatter_of_repeats(1.0)
    system = shipped_system("emps")
    assert scatter["carriage_m"].sd == pytest.approx(0.02, rel=0.25)
    assert system.trusting(scatter).outputs[0].scatter is scatter["carriage_m"]
    assert system.trusting({}).outputs == system.outputs


def test_a_command_that_is_the_same_to_the_last_digit_explains_nothing_and_costs_nothing():
    rng = np.random.default_rng(10)
    command = rng.standard_normal(800)
    records = [np.column_stack([command, command + 0.01 * rng.standard_normal(800)]) for _ in range(2)]
    assert scatter_of_pair(*records, driven=(0,))[1].sd == pytest.approx(
        scatter_of_pair(*records)[1].sd, rel=0.03
    )


def test_too_few_repeats_are_refused():
    with pytest.raises(InputError, match="two repeats"):
        _recording(np.sin(np.arange(150.0))).scatter_of_repeats(1.0)
