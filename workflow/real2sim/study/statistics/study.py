"""What the intervals of an ICC are worth, by simulation: their coverage, and how many people a class needs.

People, trials and restarts are normal with known variances, so the true ICC and class are known. Two designs of ten
fits per person: ten independent repeats, which is what the one-way model assumes; and two trials of five restarts that
nearly agree, which is what is recorded.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.special import fdtr, fdtri
from statsmodels.stats.proportion import proportion_confint

from real2sim.artefacts import write_table
from real2sim.study.statistics import icc as icc_module

if TYPE_CHECKING:
    from real2sim.settings import StatisticsSettings

TRIALS, RESTARTS = 2, 5
# Share of the variance within people that lies between restarts of one trial, where restarts share data
RESTART_SHARE = 0.1
INDEPENDENT, SHARED_DATA = "independent repeats", "restarts of trials"
DESIGNS = (INDEPENDENT, SHARED_DATA)
BOOTSTRAP, EXACT, BY_TRIALS = "bootstrap", "exact", "exact by trials"
METHODS = (BOOTSTRAP, EXACT, BY_TRIALS)
ICC_GRID = (0.0, 0.1, 0.3, 0.5, 0.7, 0.75, 0.9)
# True ICC of a parameter that people share, and of one that is their own
TRUTHS = {"common": 0.1, "distinct": 0.9}
POWER = 0.8
# draws whose bootstraps share one set of resamples
CHUNK = 250
COVERAGE_COLUMNS = (
    "design",
    "method",
    "icc",
    "n_people",
    "fits_per_person",
    "draws",
    "coverage",
    "coverage_low",
    "coverage_high",
    "mean_width",
    "share_common",
    "share_distinct",
    "common_below",
    "distinct_from",
    "confidence",
    "bootstrap_resamples",
    "seed",
)
POWER_COLUMNS = (
    "design",
    "method",
    "truth",
    "icc",
    "n_people",
    "draws",
    "right",
    "right_low",
    "right_high",
    "wrong",
    "smallest_people",
    "power",
    "seed",
)


@dataclass(frozen=True)
class Intervals:
    """Intervals (draws,) of one method."""

    low: np.ndarray
    high: np.ndarray


def wilson(hits: int, n: int) -> tuple[float, float]:
    """95 % Wilson interval of a share."""
    low, high = proportion_confint(hits, n, method="wilson")
    return float(low), float(high)


def simulated(
    icc: float, people: int, draws: int, design: str, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Fits of ``draws`` cohorts, (people * 10, draws), with the labels of person and trial of each row.

    The variance is 1, that between people ``icc``; 1 - ``icc`` lies between fits, or between trials and, by
    RESTART_SHARE, between restarts.
    """
    person = np.repeat(np.arange(people), TRIALS * RESTARTS)
    trial = np.repeat(np.arange(people * TRIALS), RESTARTS)
    alone = 1.0 if design == INDEPENDENT else RESTART_SHARE
    values = np.sqrt(icc) * rng.standard_normal((people, draws))[person]
    values += np.sqrt((1 - icc) * alone) * rng.standard_normal((len(person), draws))
    if alone < 1:
        values += np.sqrt((1 - icc) * (1 - alone)) * rng.standard_normal((people * TRIALS, draws))[trial]
    return values, person, trial


def _intervals(
    values: np.ndarray, person: np.ndarray, trial: np.ndarray, confidence: float, resamples: int, seed: int
) -> dict[str, Intervals]:
    boot = icc_module.cluster_bootstrap(values, person, resamples=resamples, seed=seed, confidence=confidence)
    # Nothing tells which restart is best here: the first stands for it.
    first = np.unique(trial, return_index=True)[1]
    exact = icc_module.exact_interval(icc_module.one_way_anova(values, person), confidence)
    by_trial = icc_module.exact_interval(icc_module.one_way_anova(values[first], person[first]), confidence)
    return {
        BOOTSTRAP: Intervals(boot.low, boot.high),
        EXACT: Intervals(*exact),
        BY_TRIALS: Intervals(*by_trial),
    }


def study_intervals(
    icc: float, people: int, design: str, settings: StatisticsSettings
) -> dict[str, Intervals]:
    """Intervals of all methods on simulated cohorts; ``settings`` as in `coverage_study`."""
    options = settings["study"]
    # every cell has a stream of its own: a longer list of people leaves the other cells as they are
    cell = [options["seed"], DESIGNS.index(design), people, round(1000 * icc)]
    sizes = [min(CHUNK, options["draws"] - i) for i in range(0, options["draws"], CHUNK)]
    parts: dict[str, list[Intervals]] = {method: [] for method in METHODS}
    for size, seed in zip(sizes, np.random.SeedSequence(cell).spawn(len(sizes)), strict=True):
        rng = np.random.default_rng(seed)
        data = simulated(icc, people, size, design, rng)
        found = _intervals(*data, settings["confidence"], options["bootstrap"], int(rng.integers(2**31)))
        for method, part in found.items():
            parts[method].append(part)
    return {
        method: Intervals(*(np.concatenate([getattr(p, end) for p in own]) for end in ("low", "high")))
        for method, own in parts.items()
    }


def class_shares(found: Intervals, settings: StatisticsSettings) -> dict[str, float]:
    """Share of intervals (paper eq. 6) that say common, and distinct."""
    return {
        "common": float(np.mean(found.high < settings["common_below"])),
        "distinct": float(np.mean(found.low >= settings["distinct_from"])),
    }


def exact_class_shares(
    icc: float, people: int, repeats: int, settings: StatisticsSettings
) -> dict[str, float]:
    """Probability that the exact F interval says common, and distinct, on ``repeats`` independent repeats a person.

    In closed form: F / (1 + repeats * icc / (1 - icc)) has an F distribution.
    """
    df = people - 1, people * (repeats - 1)
    upper = (1 + settings["confidence"]) / 2

    def f_at(edge: float) -> float:
        return (1 + (repeats - 1) * edge) / (1 - edge)

    inflation = 1 + repeats * icc / (1 - icc)
    common = f_at(settings["common_below"]) / fdtri(df[1], df[0], upper)
    distinct = f_at(settings["distinct_from"]) * fdtri(df[0], df[1], upper)
    return {
        "common": float(fdtr(*df, common / inflation)),
        "distinct": float(1 - fdtr(*df, distinct / inflation)),
    }


def icc_grid(settings: StatisticsSettings) -> list[float]:
    """True ICC of the simulated cohorts: ICC_GRID and the edges of the classes."""
    return sorted({*ICC_GRID, settings["common_below"], settings["distinct_from"]} - {1.0})


def _coverage_rows(settings: StatisticsSettings) -> Iterator[dict[str, Any]]:
    options = settings["study"]
    for design in DESIGNS:
        for people in options["people"]:
            for icc in icc_grid(settings):
                for method, found in study_intervals(icc, people, design, settings).items():
                    n = len(found.low)
                    hits = int(np.sum((found.low <= icc) & (icc <= found.high)))
                    low, high = wilson(hits, n)
                    width = np.clip(found.high, 0, 1) - np.clip(found.low, 0, 1)
                    shares = class_shares(found, settings)
                    yield {
                        "design": design,
                        "method": method,
                        "icc": icc,
                        "n_people": people,
                        "fits_per_person": TRIALS * RESTARTS,
                        "draws": n,
                        "coverage": hits / n,
                        "coverage_low": low,
                        "coverage_high": high,
                        "mean_width": float(width.mean()),
                        **{f"share_{name}": share for name, share in shares.items()},
                        **{key: settings[key] for key in ("common_below", "distinct_from", "confidence")},
                        "bootstrap_resamples": options["bootstrap"],
                        "seed": options["seed"],
                    }


def smallest_people(right: dict[int, float], power: float = POWER) -> int | None:
    """Fewest people from which on the share of right classes is at least ``power``; None if there are none."""
    enough = None
    for people in sorted(right, reverse=True):
        if right[people] < power:
            break
        enough = people
    return enough


def _power_rows(settings: StatisticsSettings) -> Iterator[dict[str, Any]]:
    options = settings["study"]
    for design in DESIGNS:
        for truth, icc in TRUTHS.items():
            other = next(name for name in TRUTHS if name != truth)
            shares = {
                people: {
                    method: class_shares(found, settings)
                    for method, found in study_intervals(icc, people, design, settings).items()
                }
                for people in options["power_people"]
            }
            for method in METHODS:
                right = {people: own[method][truth] for people, own in shares.items()}
                enough = smallest_people(right)
                for people, own in shares.items():
                    low, high = wilson(round(right[people] * options["draws"]), options["draws"])
                    yield {
                        "design": design,
                        "method": method,
                        "truth": truth,
                        "icc": icc,
                        "n_people": people,
                        "draws": options["draws"],
                        "right": right[people],
                        "right_low": low,
                        "right_high": high,
                        "wrong": own[method][other],
                        "smallest_people": enough,
                        "power": POWER,
                        "seed": options["seed"],
                    }


def coverage_study(*, settings: StatisticsSettings, out_coverage: Path, out_power: Path) -> None:
    """Simulate cohorts of known ICC; tabulate what each interval covers and how often each class is right.

    ``settings`` holds ``study`` (``draws``, ``bootstrap``, ``people``, ``power_people``, ``seed``), ``confidence``,
    ``common_below`` and ``distinct_from``. Truth is person / (person + trial + restart). Shares have a 95 % Wilson
    interval; widths are those of the part between 0 and 1. ``wrong`` in the second table is the share of the opposite
    class, ``smallest_people`` the fewest people from which on ``right`` is at least ``power``.
    """
    write_table(out_coverage, COVERAGE_COLUMNS, _coverage_rows(settings))
    write_table(out_power, POWER_COLUMNS, _power_rows(settings))
