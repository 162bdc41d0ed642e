"""What the people of a suite do: amplitude and speed ladder, holds, slow ramps and reversals on six axes."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from real2sim.verification.phantom.motions import Motion

_TO_SI = np.array([1e-3] * 3 + [np.pi / 180] * 3)  # amplitudes are written in mm and degrees


def dynamic(
    suite: dict[str, Any], duration_s: float, rng: np.random.Generator, regime: tuple[float, float]
) -> Motion:
    """One dynamic trial; ``regime`` = (amplitude, speed) factors, which tell the held-out trial from training.

    Every axis goes its own way through the ladder of amplitudes and durations, with holds between, so that no
    two axes stay in phase; a ripple of two sinusoids per axis, no frequency twice, lies on top.
    """
    plan, quiet = suite["motion"], suite["trials"]["quiet_s"]
    amplitude, speed = regime
    motion = Motion(duration_s)
    end = duration_s - 0.3
    size = np.array(plan["amplitude"]) * _TO_SI * amplitude * rng.uniform(0.85, 1.15, 6)
    for axis in range(6):
        t, here, sign = quiet + rng.uniform(0, 0.8), 0.0, rng.choice([-1, 1])
        levels, times, holds = (_endless(plan[key], rng) for key in ("levels", "durations_s", "holds_s"))
        while True:
            length = next(times) / speed * rng.uniform(0.9, 1.1)
            if t + length > end:
                break
            goal = sign * next(levels) * size[axis] * rng.uniform(0.85, 1.0)
            motion.moves.append((t, length, (goal - here) * np.eye(6)[axis]))
            t, here = t + length + next(holds), goal
            # mostly to the other side, now and then further on the same one
            sign = -sign if rng.random() < 0.8 else sign
    low, high = plan["ripple_hz"]
    frequencies = rng.permutation(np.geomspace(low, high, 12)) * speed
    for i, frequency in enumerate(frequencies):
        # equal speeds: the slow half of the ripple goes further than the fast one
        reach = plan["ripple"] * size[i % 6] * np.sqrt(low * speed / frequency)
        motion.sines.append((frequency, rng.uniform(0, 2 * np.pi), reach * np.eye(6)[i % 6]))
    motion.fade = (quiet, 1.0, np.inf, 1.0)
    return motion


def _endless(values: list[float], rng: np.random.Generator) -> Iterator[float]:
    # each value once in random order, again and again
    while True:
        yield from rng.permutation(values)
