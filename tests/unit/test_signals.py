"""Gaps, filter, derivative and alignment against closed forms."""

import numpy as np
import pytest
from real2sim import geometry, signals
from real2sim.recording import alignment
from scipy.spatial.transform import Rotation

RATE = 100.0


def test_segments():
    runs = signals.segments(np.array([True, True, False, True, False, False, True]))
    assert runs == [slice(0, 2), slice(3, 4), slice(6, 7)]
    assert signals.segments(np.zeros(3, bool)) == []


def test_short_gaps_of_a_cubic_are_filled_exactly():
    t = np.arange(200) / RATE
    x = np.column_stack([1 + t - 2 * t**2 + 3 * t**3, t, 0 * t])
    broken = x.copy()
    broken[50:70] = np.nan  # 0.2 s: the longest that is filled
    broken[100, 1] = np.nan  # one coordinate is enough to lose the sample
    filled, flag = signals.fill_gaps(broken, RATE, 0.2)
    np.testing.assert_allclose(filled, x, atol=1e-10)
    assert set(np.flatnonzero(flag)) == {*range(50, 70), 100}


def test_long_gaps_and_ends_are_never_invented():
    x = np.ones((200, 3))
    x[:5] = x[50:71] = x[190:] = np.nan
    filled, flag = signals.fill_gaps(x, RATE, 0.2)
    assert not flag.any()
    np.testing.assert_array_equal(np.isnan(filled), np.isnan(x))


def test_a_lone_sample_between_gaps_carries_no_gap():
    x = np.ones((60, 3))
    x[20:25] = x[26:30] = np.nan
    filled, flag = signals.fill_gaps(x, RATE, 0.2)
    assert not flag.any()
    assert np.isnan(filled[20:25]).all()


def test_gap_rule_is_in_seconds():
    x = np.ones((400, 3))
    x[100:130] = np.nan
    assert signals.fill_gaps(x, 200.0, 0.2)[1].sum() == 30
    assert signals.fill_gaps(x, 100.0, 0.2)[1].sum() == 0


def test_filter_is_zero_phase_and_halves_power_at_the_cutoff():
    t = np.arange(2000) / RATE
    middle = slice(500, 1500)
    for frequency in (1.0, 6.0, 12.0, 20.0):
        x = np.sin(2 * np.pi * frequency * t)
        y = signals.lowpass(x, RATE, 12.0, 4)
        ratio = np.tan(np.pi * frequency / RATE) / np.tan(np.pi * 12 / RATE)
        gain = 1 / (1 + (np.sqrt(2) - 1) * ratio**4)
        np.testing.assert_allclose(y[middle], gain * x[middle], atol=2e-6)
    assert gain < 0.2


def test_filter_keeps_a_line_and_works_on_each_stretch():
    t = np.arange(300) / RATE
    x = np.column_stack([t, 2 - t])
    x[100:150] = np.nan
    x[200] = np.nan
    x[202] = np.nan  # leaves stretches of one sample
    y = signals.lowpass(x, RATE, 12.0, 4)
    np.testing.assert_allclose(y, x, atol=1e-9)


def test_filter_above_nyquist_changes_nothing():
    x = np.random.default_rng(1).normal(size=100)
    np.testing.assert_array_equal(signals.lowpass(x, 20.0, 12.0, 4), x)


def test_derivative_of_t_squared():
    t = np.arange(100) / RATE
    x = np.column_stack([t**2, 3 * t])
    x[40:50] = np.nan
    x[60] = x[62] = np.nan
    d = signals.derivative(x, RATE)
    good = np.isfinite(d[:, 0])
    np.testing.assert_allclose(d[good], np.column_stack([2 * t, 3 + 0 * t])[good], atol=1e-11)
    assert set(np.flatnonzero(~good)) == {*range(40, 50), 60, 61, 62}


def test_derivative_of_a_fast_sine():
    t = np.arange(500) / RATE
    d = signals.derivative(np.sin(2 * np.pi * 5 * t), RATE)
    np.testing.assert_allclose(d[5:-5], (10 * np.pi * np.cos(10 * np.pi * t))[5:-5], atol=0.011)


def test_resample_leaves_gaps_and_outsides_open():
    t = np.arange(0, 3, 1 / 60)
    x = np.sin(t)
    x[60:90] = np.nan
    clock = signals.common_clock(-0.1, 3.2, 100)
    y = signals.resample(t, x, clock)
    good = np.isfinite(y)
    np.testing.assert_allclose(y[good], np.sin(clock[good]), atol=1e-5)
    assert not good[
        (clock < -1e-6) | ((clock > 59 / 60 + 1e-6) & (clock < 1.5 - 1e-6)) | (clock > t[-1] + 1e-6)
    ].any()


def test_resample_ends_a_stretch_where_the_clock_jumps():
    t = np.concatenate([np.arange(0, 1, 0.01), np.arange(1.5, 2, 0.01)])
    y = signals.resample(t, t**2, np.arange(0, 2, 0.005), max_gap_s=0.2)
    assert np.isnan(y[205:295]).all()
    assert np.isfinite(y[:190]).all()


def test_common_clock_is_whole_hundredths():
    np.testing.assert_allclose(signals.common_clock(0.29, 0.333, 100), [0.29, 0.30, 0.31, 0.32, 0.33])


# -------------------- alignment


def motion(t, walk=False):
    """Pelvis pose over 30 s: still, moving in every axis, still again."""
    envelope = np.clip(t - 1, 0, 1) * np.clip(29 - t, 0, 1)
    waves = np.sin(2 * np.pi * 0.6 * np.array([0.7, 1.1, 1.7, 0.5, 1.3, 0.9]) * t[:, None] + np.arange(6.0))
    waves = envelope[:, None] * waves
    position = np.array([0, 0, 0.95]) + waves[:, :3] * [0.05, 0.06, 0.02]
    if walk:
        s = np.clip((t - 2) / 24, 0, 1)
        position[:, 0] += 20 * s**3 * (10 - 15 * s + 6 * s**2)
    return Rotation.from_euler("ZYX", waves[:, 3:] * [0.3, 0.05, 0.08]).as_matrix(), position


def other_system(offset, drift, walk, noise=0.0, seed=0):
    """The same motion in another ground, of another pelvis frame, at 60 Hz, by another clock."""
    rng = np.random.default_rng(seed)
    ground = Rotation.from_euler("zyx", [0.5, 0.02, -0.01]).as_matrix()
    body = Rotation.from_euler("y", 0.1).as_matrix()
    t = np.arange(0, 33, 1 / 60)
    rotation, position = motion((t + offset) / (1 - drift), walk)
    rotation = ground.T @ rotation @ body.T
    lever = np.array([0.01, 0.0, 0.02])
    position = (position - [1.0, 2.0, 0.1]) @ ground - rotation @ lever
    rotation = rotation @ Rotation.from_rotvec(rng.normal(size=(len(t), 3)) * noise).as_matrix()
    return t, rotation, position + rng.normal(size=position.shape) * noise, ground, body, lever


@pytest.mark.parametrize("walk", [False, True])
@pytest.mark.parametrize(("offset", "drift"), [(1.2345, 0.0), (-0.777, 1e-4)])
def test_pelvis_alignment_recovers_clock_and_frames(walk, offset, drift):
    clock = np.arange(3000) / RATE
    ours = alignment.PelvisPath(clock, *motion(clock, walk))
    t, r, p, ground, body, lever = other_system(offset, drift, walk)
    other = alignment.PelvisPath(t, r, p)
    coarse, correlation = alignment.coarse_offset(ours, other)
    assert coarse == pytest.approx(offset - drift * 15, abs=0.03)
    time_fit, space = alignment.align_pelvis(ours, other, offset_s=coarse, correlation=correlation)
    # t_ours = (t_other + offset) / (1 - drift)
    np.testing.assert_allclose(time_fit.other_time(clock), clock * (1 - drift) - offset, atol=1e-4)
    assert time_fit.drift == pytest.approx(drift, abs=3e-6)
    np.testing.assert_allclose(space.body, body, atol=2e-3)
    np.testing.assert_allclose(space.rotation, ground, atol=2e-3)
    np.testing.assert_allclose(space.lever, lever, atol=2e-3)
    assert space.rms_m < 1e-4


def test_pelvis_alignment_within_a_millisecond_under_noise():
    clock = np.arange(3000) / RATE
    ours = alignment.PelvisPath(clock, *motion(clock, True))
    errors, scores = [], []
    for seed in range(5):
        other = alignment.PelvisPath(*other_system(1.2345, 0.0, True, noise=0.005, seed=seed)[:3])
        coarse, correlation = alignment.coarse_offset(ours, other)
        fit, _ = alignment.align_pelvis(
            ours, other, offset_s=coarse, correlation=correlation, with_drift=False
        )
        errors.append(fit.offset_s - 1.2345)
        scores.append(errors[-1] / fit.offset_sd_s)
    assert np.abs(errors).max() < 1e-3
    assert np.abs(scores).max() < 4


def test_signals_of_two_clocks():
    clock = np.arange(2000) / RATE

    def channels(t):
        envelope = np.exp(-(((t - 9) / 4) ** 2))
        return np.column_stack([envelope * np.sin(3 * t), envelope * np.sin(5 * t + 1) ** 3])

    other_time = np.arange(0, 25, 0.004)
    other = channels(other_time - 2.3456) * [2.0, 0.5]
    fit = alignment.align_signals(clock, channels(clock), other_time, other)
    assert fit.offset_s == pytest.approx(-2.3456, abs=1e-4)
    assert fit.correlation > 0.95


def test_rebuild_point():
    rng = np.random.default_rng(6)
    model = rng.normal(size=(4, 3)) * 0.1
    rotation = Rotation.random(30, random_state=1).as_matrix()
    points = np.einsum("nij,kj->nki", rotation, model) + rng.normal(size=(30, 1, 3))
    for missing in range(4):
        turned, rebuilt = alignment.rebuild_point(points, model, missing)
        np.testing.assert_allclose(turned, rotation, atol=1e-12)
        np.testing.assert_allclose(rebuilt, points[:, missing], atol=1e-12)


def test_opensim_pelvis_axes():
    """+tilt turns the front up, +list the right side down, +rotation to the left (facts, section 4)."""
    names = ("tilt", "list", "rotation", "tx", "ty", "tz")
    columns = {f"pelvis_{name}": np.zeros(4) for name in names}
    columns["pelvis_tilt"][1] = columns["pelvis_list"][2] = columns["pelvis_rotation"][3] = 0.1
    columns["pelvis_tx"][0], columns["pelvis_ty"][0], columns["pelvis_tz"][0] = 1, 2, 3
    rotation, position = alignment.pelvis_of_coordinates(columns)
    np.testing.assert_allclose(position[0], [1, -3, 2])
    np.testing.assert_allclose(rotation[0], np.eye(3), atol=1e-15)
    assert rotation[1][2, 0] > 0
    assert rotation[2][2, 1] > 0
    assert rotation[3][1, 0] > 0
    np.testing.assert_allclose(geometry.angles_xyz(rotation[3]), [0, 0, 0.1], atol=1e-12)


def test_correlation_at_every_lag_is_that_of_the_overlap():
    rng = np.random.default_rng(3)
    x, y = rng.normal(2.0, 1.0, 40), rng.normal(-1.0, 3.0, 25)
    lags, found, count = signals.correlation_at_lags(x, y, 1e-12)
    np.testing.assert_array_equal(lags, np.arange(-24, 40))
    for lag, value, samples in zip(lags, found, count, strict=True):
        rows = np.arange(max(0, lag), min(40, 25 + lag))
        assert len(rows) == samples
        if samples > 2:
            np.testing.assert_allclose(value, np.corrcoef(x[rows], y[rows - lag])[0, 1], atol=1e-10)


def test_sums_of_runs():
    values = np.arange(10.0).reshape(5, 2)
    np.testing.assert_array_equal(
        signals.sums_of_runs(values, np.array([0, 0, 3, 4, 4])), [[2, 4], [4, 5], [14, 16]]
    )
