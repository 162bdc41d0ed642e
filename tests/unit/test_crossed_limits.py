"""Joint limits that a recording itself contradicts."""

from __future__ import annotations

import numpy as np
import pytest
from real2sim.recording.quality.gates import _limits
from real2sim.study.strap_recording import without_crossed
from real2sim.system.plant import JointLimits

LIMITS = JointLimits(np.full(6, -0.02), np.full(6, 0.03))


def _swaying(about: float) -> np.ndarray:
    """Coordinates (400, 6) that sway by 10 mm, along z about another place."""
    q = np.tile(0.01 * np.sin(np.linspace(0, 40, 400))[:, None], (1, 6))
    q[:, 2] += about
    return q


def test_a_recording_within_its_limits_keeps_them():
    kept, crossed = without_crossed(LIMITS, _swaying(0.0), 0.05)
    assert crossed == ()
    np.testing.assert_array_equal(kept.lower, LIMITS.lower)
    np.testing.assert_array_equal(kept.upper, LIMITS.upper)


@pytest.mark.parametrize(("about", "side"), [(-0.025, "lower"), (0.035, "upper")])
def test_a_side_that_the_recording_is_beyond_has_no_stop(about, side):
    kept, crossed = without_crossed(LIMITS, _swaying(about), 0.05)
    assert crossed == (f"tz {side}",)
    at_side = {"lower": kept.lower, "upper": kept.upper}
    other = {"lower": "upper", "upper": "lower"}[side]
    assert abs(at_side[side][2]) > 1.0
    assert at_side[other][2] == getattr(LIMITS, other)[2]
    # the other axes keep both
    np.testing.assert_array_equal(np.delete(kept.lower, 2), np.delete(LIMITS.lower, 2))
    np.testing.assert_array_equal(np.delete(kept.upper, 2), np.delete(LIMITS.upper, 2))


def test_a_few_samples_beyond_a_limit_leave_it():
    q = _swaying(0.0)
    q[:10, 2] = -0.05
    assert without_crossed(LIMITS, q, 0.05)[1] == ()


@pytest.mark.parametrize(("about", "remedy"), [(0.022, "Move less far"), (-0.03, "move after neutral")])
def test_the_gate_says_what_brings_a_recording_back_within_its_limits(about, remedy):
    gate = _limits(
        _swaying(about), (LIMITS.lower, LIMITS.upper), {"margin": 0.02, "warn": 0.2, "refuse": 0.6}
    )
    assert gate.verdict != "pass"
    assert remedy in gate.remedy


def test_the_gate_of_a_recording_within_its_limits_asks_for_nothing():
    gate = _limits(_swaying(0.0), (LIMITS.lower, LIMITS.upper), {"margin": 0.02, "warn": 0.2, "refuse": 0.6})
    assert (gate.verdict, gate.remedy) == ("pass", "")
