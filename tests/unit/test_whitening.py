"""Missing samples carry no information: whatever stands in their place, and however many there are."""

from __future__ import annotations

import numpy as np
import pytest
from real2sim.diagnosis.sensors import by_sensor
from real2sim.diagnosis.whitening import Bands, Whitening, without_gaps

N, CHANNELS, DRAWS = 1200, 3, 400
BANDS = Bands((0.0, 1.0, 4.0, 10.0), N, 0.01)
GAPS = ((slice(300, 350), 0), (slice(600, 612), 0), (slice(340, 420), 2), (slice(0, 40), 1))


def _noise(seed: int, draws: int = DRAWS) -> np.ndarray:
    """Noise (draws, n, c) of which the slow part is common to two channels."""
    rng = np.random.default_rng(seed)
    own = rng.standard_normal((draws, N, CHANNELS))
    slow = np.cumsum(rng.standard_normal((draws, N)), axis=1) / 30
    return own + slow[:, :, None] * np.array([1.0, 0.5, 0.0])


def _known() -> np.ndarray:
    known = np.ones((N, CHANNELS), bool)
    for run, channel in GAPS:
        known[run, channel] = False
    return known


def _whitening(known: np.ndarray | None, nuisance: np.ndarray | None = None) -> Whitening:
    error = _noise(1)
    none = np.empty((0, N, CHANNELS)) if nuisance is None else nuisance
    return Whitening.of_noise(BANDS, error, 0 * error, none, np.full(CHANNELS, 1e-3), known=known)


@pytest.fixture(scope="module")
def whitening() -> Whitening:
    return _whitening(_known())


def test_nothing_depends_on_what_stands_in_a_gap(whitening):
    row = _noise(2, 1)
    lines, bent = without_gaps(row.copy(), _known()), row.copy()
    for run, channel in GAPS:
        way = np.linspace(-1, 1, run.stop - run.start)
        bent[0, run, channel] = 50 + 20 * way - 30 * way**2
    one, other = (float(np.sum(whitening.apply(error) ** 2)) for error in (lines, bent))
    assert one == pytest.approx(other, rel=1e-3)
    blind = _whitening(None)
    assert np.sum(blind.apply(bent) ** 2) > 100 * np.sum(blind.apply(lines) ** 2)


def test_noise_alone_leaves_as_much_as_counts(whitening):
    noise = without_gaps(_noise(3), _known())
    left = by_sensor(whitening.apply(noise), (2, 1)).mean(axis=0)
    counts = whitening.counts_by_sensor((2, 1))
    rows = BANDS.last
    assert sum(counts) < 3 * rows - 20 * (0.5 + 0.12 + 0.8 + 0.4)
    assert sum(counts) > 3 * rows - 20 * (0.5 + 0.12 + 0.8 + 0.4) - 8 * len(GAPS)
    # the mean of 400 draws scatters by 0.2 %, and so does the covariance that whitens
    np.testing.assert_allclose(left, counts, rtol=0.01)
    # straight lines that count carry the noise of their ends, which is slow
    lines = by_sensor(_whitening(None).apply(noise), (2, 1)).mean(axis=0)
    assert lines[0] > 1.02 * left[0] * 2 * rows / counts[0]


def test_without_gaps_all_residuals_count_and_none_is_changed():
    every, masked = _whitening(None), _whitening(np.ones((N, CHANNELS), bool))
    assert every.counts_by_sensor((2, 1)) == (2 * BANDS.last, BANDS.last)
    row = _noise(4, 1)
    np.testing.assert_array_equal(every.apply(row), masked.apply(row))


def test_a_nuisance_beside_a_gap_is_still_marginalised():
    ramp = np.zeros((1, N, CHANNELS))
    ramp[0, :, 0] = np.linspace(-3, 3, N)
    both = _whitening(_known(), ramp)
    seen = float(np.sum(both.apply(ramp) ** 2))
    assert seen < 1.0
    assert both.counts_by_sensor((2, 1)) == pytest.approx(
        _whitening(_known()).counts_by_sensor((2, 1)), abs=1
    )


def test_a_channel_that_was_never_measured_counts_for_nothing():
    known = np.ones((N, CHANNELS), bool)
    known[:, 1] = False
    row = _noise(5, 1)
    row[0, :, 1] = np.nan
    lost = _whitening(known)
    assert np.isfinite(lost.apply(without_gaps(row, known))).all()
    assert lost.counts[1] == pytest.approx(0, abs=1)
    assert lost.counts.sum() == pytest.approx(2 * BANDS.last, abs=1)
