"""The noise of a recording at other rates and cut-offs than 100 Hz and 12 Hz."""

from __future__ import annotations

from copy import deepcopy
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from real2sim import signals
from real2sim.configuration import validated
from real2sim.errors import InputError
from real2sim.recording.jumps import JumpRule
from real2sim.recording.noise import Bands, LowPass, NoiseModel, robot_noise
from real2sim.study.diagnose import time_step
from real2sim.system.plant import ROBOT_JOINTS

STUDY = validated({}, "config", Path("defaults"))
OPTIONS = STUDY["diagnosis"]["noise"]
RATES, CUTOFFS = (50, 100, 200, 300), (6, 8, 12, 20)
PLACES = {
    "ASIS_L": (0.1, 0.12, 1.0),
    "ASIS_R": (0.1, -0.12, 1.0),
    "PSIS_L": (-0.08, 0.05, 1.01),
    "PSIS_R": (-0.08, -0.05, 1.01),
    "IF_L": (0.0, 0.15, 0.95),
    "IF_R": (0.0, -0.15, 0.95),
}


def ingest(rate_hz: float, cutoff_hz: float) -> dict:
    return STUDY["ingest"] | {"rate_hz": rate_hz, "cutoff_hz": cutoff_hz}


def bands(rate_hz: float, cutoff_hz: float) -> Bands:
    return Bands.from_settings(ingest(rate_hz, cutoff_hz), OPTIONS)


def write_neutral(
    folder: Path, raw_hz: float, clock_hz: float, cutoff_hz: float, seed: int, *, slow_m: float = 0.0
) -> Path:
    """Write 8 s of quiet standing with white noise of 0.3 mm at the raw rate, filtered and resampled as ingested."""
    rng, seconds = np.random.default_rng(seed), 8.0
    raw, clock = (
        np.arange(round(seconds * raw_hz)) / raw_hz,
        np.arange(round(seconds * clock_hz) - 10) / clock_hz,
    )
    sway = 0.004 * np.sin(2 * np.pi * 0.3 * raw)[:, None]
    columns = {}
    for name, place in PLACES.items():
        seen = np.array(place) + sway + 3e-4 * rng.standard_normal((len(raw), 3))
        seen += slow_m * np.sin(2 * np.pi * rng.uniform(0.2, 0.5, 3) * raw[:, None] + rng.uniform(0, 6, 3))
        smooth = signals.resample(raw, signals.lowpass(seen, raw_hz, cutoff_hz, 4), clock)
        columns |= {f"{name}_{c}": smooth[:, i] for i, c in enumerate("xyz")}
    pq.write_table(pa.table(columns), folder / "markers.parquet")
    return folder


def test_the_bands_of_12_hz_and_100_hz_are_those_of_the_configuration():
    usual = bands(100, 12)
    assert usual.edges_hz == (0.0, *OPTIONS["edges_hz"])
    assert usual.standing_hz == usual.log_standing_hz == tuple(OPTIONS["standing_hz"])
    assert usual.log_moving_hz == tuple(map(tuple, OPTIONS["log_moving_hz"]))
    assert (usual.response(np.linspace(0, 7)) == 1).all()
    assert not usual.is_filtered
    np.testing.assert_array_equal(usual.floor, [5e-5] * 6 + OPTIONS["robot_floor"])


@pytest.mark.parametrize("rate", RATES)
@pytest.mark.parametrize("cutoff", CUTOFFS)
def test_no_residual_counts_where_the_low_pass_leaves_little(rate, cutoff):
    own = bands(rate, cutoff)
    assert own.edges_hz[-1] == pytest.approx(min(10, cutoff / 1.2))
    assert own.low_pass.power(np.array(own.edges_hz)).min() > 0.6
    assert (np.diff(own.edges_hz) > 0).all()
    # a last band of few coefficients would be whitened by chance
    assert own.edges_hz[-1] >= 1.4 * own.edges_hz[-2]
    low, high = own.standing_hz
    assert low == 3
    assert 4 <= high <= 7
    assert own.low_pass.power(np.array([high])) >= 0.3 - 1e-9
    assert own.coefficients(12 * rate, 12.0) == int(24 * own.edges_hz[-1])
    # least errors are as loud per hertz at any rate
    np.testing.assert_allclose(own.floor**2 / rate, bands(100, 12).floor ** 2 / 100)


@pytest.mark.parametrize(
    ("rate", "cutoff", "order"), [(50, 6, 4), (100, 12, 4), (300, 20, 4), (100, 8, 2), (200, 8, 8)]
)
def test_the_response_is_that_of_the_filter(rate, cutoff, order):
    n = 4001
    impulse = np.zeros((n, 1))
    impulse[n // 2] = 1.0
    low_pass = LowPass(rate, cutoff, order)
    kernel = low_pass.apply(impulse)[:, 0]
    frequency = np.linspace(0.1, rate / 2.1, 40)
    turns = np.exp(-2j * np.pi * np.outer(frequency, np.arange(n) - n // 2) / rate)
    np.testing.assert_allclose(low_pass.power(frequency), np.abs(turns @ kernel) ** 2, atol=1e-6)
    assert low_pass.power(np.array([low_pass.passes_up_to(0.3)])) == pytest.approx(0.3)
    unfiltered = LowPass(rate, rate, order)
    assert (unfiltered.power(frequency) == 1).all()
    assert unfiltered.passes_up_to(0.3) == rate / 2


@pytest.mark.parametrize(
    ("raw", "clock"), [(50, 50), (100, 100), (200, 200), (300, 300), (150, 100), (300, 50), (50, 200)]
)
@pytest.mark.parametrize("cutoff", CUTOFFS)
def test_white_noise_is_read_back_whatever_rate_and_cut_off(tmp_path, raw, clock, cutoff):
    """At 6 Hz the SD came out a sixth too small, and what the filter takes looked like slow noise."""
    model = NoiseModel.measure(
        write_neutral(tmp_path, raw, clock, cutoff, raw + clock + cutoff), ingest(clock, cutoff), OPTIONS
    )
    # the power per hertz is that of the raw samples
    true = 3e-4**2 * clock / raw
    seen = np.mean([sd**2 for sd in model.marker_sd.values()]) / true
    chance = np.sqrt(2 / (18 * model.bands.freedom(8.0)))
    # up to a tenth of the power is not made up for (`passes`), a twentieth on average
    assert 0.95 - 3 * chance < seen < 1 + 3 * chance
    np.testing.assert_array_equal(model.colour, 1)


@pytest.mark.parametrize(("clock", "cutoff"), [(50, 6), (300, 6), (300, 20)])
def test_drawn_noise_has_the_power_of_recorded_noise(tmp_path, clock, cutoff):
    model = NoiseModel.measure(
        write_neutral(tmp_path, clock, clock, cutoff, 1), ingest(clock, cutoff), OPTIONS
    )
    rng = np.random.default_rng(2)
    drawn = model.filtered(tuple(PLACES)[:4], 60 * clock, rng)
    low_pass = LowPass(clock, cutoff, 4)
    recorded = low_pass.apply(3e-4 * rng.standard_normal(drawn.shape))
    assert drawn.std() == pytest.approx(recorded.std(), rel=0.1)


def test_slow_noise_is_found_at_a_low_cut_off(tmp_path):
    loud = NoiseModel.measure(
        write_neutral(tmp_path, 100, 100, 6, 3, slow_m=6e-4), ingest(100, 6), OPTIONS
    ).colour
    assert loud.shape == (2, len(bands(100, 6).edges_hz) - 1)
    assert loud[0, 1] > 3
    assert loud[0, -1] < 1.5


@pytest.mark.parametrize("rate", RATES)
def test_noise_of_the_log_is_read_at_any_rate(tmp_path, rate):
    rng, own = np.random.default_rng(rate), bands(rate, 8)
    sd = np.array([4e-4, 3e-4, 6e-4, 1e-4, 5e-4, 2e-4])
    for name, seconds in (("neutral", 8), ("moved", 15)):
        joints = sd * rng.standard_normal((seconds * rate, 6))
        pq.write_table(pa.table(dict(zip(ROBOT_JOINTS, joints.T, strict=True))), tmp_path / f"{name}.parquet")
    seen = robot_noise(tmp_path / "neutral.parquet", tmp_path / "moved.parquet", own)
    np.testing.assert_allclose(seen, sd, rtol=0.35)


@pytest.mark.parametrize(
    ("rate", "cutoff", "code", "says"),
    [
        (100, 4, "noise_cutoff", "at least 4.8 Hz"),
        (100, 45, "noise_rate", "Raise ingest.rate_hz to 112.5 Hz"),
        (25, 12, "noise_rate", "a common clock of 25 Hz for a cut-off of 12 Hz"),
    ],
)
def test_what_the_noise_model_cannot_bear_it_refuses_by_name(rate, cutoff, code, says):
    with pytest.raises(InputError) as caught:
        bands(rate, cutoff)
    assert caught.value.code == code
    assert says in str(caught.value)


def test_a_neutral_trial_that_is_too_short_is_refused(tmp_path):
    neutral = write_neutral(tmp_path, 100, 100, 6, 0)
    NoiseModel.measure(neutral, ingest(100, 6), OPTIONS)
    table = pq.read_table(neutral / "markers.parquet")
    pq.write_table(table[:150], neutral / "markers.parquet")
    with pytest.raises(InputError, match=r"1\.5 s of quiet standing(.|\n)*at least 2\.0 s") as caught:
        NoiseModel.measure(neutral, ingest(100, 6), OPTIONS)
    assert caught.value.code == "noise_neutral"


@pytest.mark.parametrize("rate", [100, 200, 300])
def test_a_filled_gap_is_no_louder_at_a_high_rate(rate):
    """Four samples at 300 Hz are 13 ms. Gaps of 0.2 s swung by 3.4 SD, and the noise came out 2.6 times too loud."""
    rng, swing = np.random.default_rng(0), []
    for _ in range(100):
        values = rng.standard_normal((rate, 3))
        values[rate // 2 : rate // 2 + rate // 5] = np.nan
        filled, flag = signals.fill_gaps(values, rate, 0.2)
        swing.append(filled[flag].std())
    assert np.median(swing) < 1.5


@pytest.mark.parametrize("cutoff", [3.0, 6.0, 12.0, 20.0])
def test_a_slower_low_pass_smears_a_jump_further(cutoff):
    options = STUDY["diagnosis"]["jumps"]
    reach = JumpRule(100, cutoff, options).reach("smear_s")
    assert reach == pytest.approx(0.08 * max(1, 12 / cutoff))


@pytest.mark.parametrize(
    ("rate", "step"), [(50, 0.01), (100, 0.01), (150, 1 / 150), (200, 0.005), (300, 1 / 300), (1000, 0.001)]
)
def test_the_time_step_divides_the_sample_interval_whatever_the_rate(rate, step):
    settings = deepcopy(STUDY) | {"ingest": ingest(rate, 8)}
    assert time_step(settings, None) == pytest.approx(step)
    assert 1 / rate / time_step(settings, None) == pytest.approx(round(1 / rate / step))
