"""How often do bootstrap intervals of 95 % hold the truth? Shared breakpoint of a sweep, and noise floor of J.

    python benchmarks/bootstrap_coverage.py

Sweeps: nine levels per person, whose slopes differ (SD 2 of a mean of 10), a bend at a normalised tightness of 0.1 (a
change of slope of 8, the same for everybody or with SD 2 between people) and noise of SD 1. Floor: the square of noise
with an autocorrelation of 0.2 s, at 100 Hz, in blocks of 1 s. Prints shares of simulated cohorts and recordings.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1] / "workflow"))

from real2sim.inference.noise_floor import block_bootstrap_mean
from real2sim.study.statistics.piecewise import breakpoint_interval_by_group

CONFIDENCE, KNEE, LEVELS = 0.95, 0.1, np.linspace(-1, 1, 9)
# noise as the moving average of so many samples; block of the bootstrap [samples]
MOVING, BLOCK = 20, 100


def breakpoint_covered(people: int, bend_sd: float, rng: np.random.Generator, seed: int) -> bool:
    """Return whether the interval of one simulated cohort holds the true breakpoint."""
    person, x = np.repeat(np.arange(people), len(LEVELS)), np.tile(LEVELS, people)
    slope, bend = rng.normal(-10, 2, people)[person], rng.normal(8, bend_sd, people)[person]
    y = 20 + slope * x + bend * np.maximum(0, x - KNEE) + rng.normal(size=len(x))
    low, high = breakpoint_interval_by_group(x, y, person, bootstrap=400, seed=seed, confidence=CONFIDENCE)
    return bool(low <= KNEE <= high)


def floor_covered(seconds: int, rng: np.random.Generator, seed: int) -> bool:
    """Return whether the interval of one simulated recording holds the true mean of squared noise."""
    white = rng.normal(size=100 * seconds + MOVING - 1)
    noise = np.convolve(white, np.full(MOVING, 1 / MOVING), "valid")
    low, high = block_bootstrap_mean(noise**2, BLOCK, 500, CONFIDENCE, seed)
    return bool(low <= 1 / MOVING <= high)


def main() -> None:
    """Print the coverage of both intervals."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--cohorts", type=int, default=1000, help="simulated cohorts or recordings per row")
    count = parser.parse_args().cohorts
    rng = np.random.default_rng(1)
    for people in (3, 5, 10):
        for bend_sd in (0.0, 2.0):
            share = np.mean([breakpoint_covered(people, bend_sd, rng, seed) for seed in range(count)])
            print(f"breakpoint, {people} people, SD of the bend {bend_sd:g}: {share:.1%}")
    for seconds in (10, 30, 60):
        share = np.mean([floor_covered(seconds, rng, seed) for seed in range(count)])
        print(f"noise floor, {seconds} blocks of 1 s: {share:.1%}")


if __name__ == "__main__":
    main()
