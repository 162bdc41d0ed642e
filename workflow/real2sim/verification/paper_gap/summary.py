"""The numbers by which a cohort is compared with the paper's: each one that the paper prints, of any cohort."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from real2sim.artefacts import number, read_table
from real2sim.inference.parameters import PARAMETERS
from real2sim.study.statistics import icc
from real2sim.study.statistics.shareability import classify, point_prior

if TYPE_CHECKING:
    from real2sim.settings import Settings

# Groups of numbers that weigh the same in a distance, however many numbers they hold
GROUPS = {
    "transfer": ("overhead_mean", "overhead_lowest", "overhead_highest", "loso_J", "loso_rmse"),
    "centre": tuple(f"prior_{name}" for name in PARAMETERS),
    "spread": tuple(f"sd_{name}" for name in PARAMETERS),
    "classes": ("same_classes",),
    "limits": ("k_rz_at_bound", "damping_ratios"),
}
# Groups that hang on which parameters the people truly have. The cohorts' are those of Table I; in the study a cause
# that bends fits would have bent others into Table I.
HANGING = ("centre", "limits")
NUMBERS = tuple(name for names in GROUPS.values() for name in names)
# SD that half of a 95 % interval is of a normal distribution
_HALF_95 = 1.959964

Person = Mapping[str, Any]


@dataclass(frozen=True)
class Published:
    """Numbers that the paper prints, with all that it takes to compute the same of a cohort.

    ``values`` by `NUMBERS`; ``classes`` by parameter; ``inertia`` [kg, kg m²] by axis; ``bound`` lower bound of k_rz
    [Nm/rad]; ``ratio`` that the bounds are said to keep damping ratios below.
    """

    values: dict[str, float]
    classes: dict[str, str]
    inertia: dict[str, float]
    bound: float
    ratio: float

    @classmethod
    def read(cls, folder: Path, tolerance_ln: float) -> Published:
        """Read the tables of resources/published; a prior is at a bound within ``tolerance_ln`` of its ln."""
        prior = {row["parameter"]: row for row in read_table(folder / "table1_priors.csv", ("prior",))}
        cross, loso, body = (
            _quantities(folder / f"{name}.csv") for name in ("cross_trial", "loso", "pelvis_inertia")
        )
        bounds = {row["parameter"]: number(row["lower"]) for row in read_table(folder / "bounds.csv")}
        said = {row["claim"]: row["published"] for row in read_table(folder / "claims.csv", ("published",))}
        inertia = {axis: body["mass" if axis[0] == "t" else f"inertia_{axis}"] for axis in _AXES}
        centre = np.array([number(prior[name]["prior"]) for name in PARAMETERS])
        width = [
            math.log(number(prior[n]["interval_high"]) / number(prior[n]["interval_low"])) for n in PARAMETERS
        ]
        ratio = number(said["damping_ratio"])
        values = {
            "overhead_mean": _ln(cross["overhead_mean"] / 100),
            "overhead_lowest": _ln(cross["overhead_lowest_person"] / 100),
            "overhead_highest": _ln(cross["overhead_highest_person"] / 100),
            "loso_J": _ln(loso["overhead_J_mean"] / 100),
            "loso_rmse": _ln(loso["overhead_rmse_mean"] / 100),
            "same_classes": float(len(PARAMETERS)),
        }
        values |= _of_priors(centre, inertia, ratio, bounds["k_rz"], tolerance_ln)
        values |= {f"sd_{n}": w / (2 * _HALF_95) for n, w in zip(PARAMETERS, width, strict=True)}
        classes = {name: prior[name]["class"] for name in PARAMETERS}
        return cls(values, classes, inertia, bounds["k_rz"], ratio)


_AXES = tuple(name[2:] for name in PARAMETERS[:6])


def _quantities(source: Path) -> dict[str, float]:
    return {row["quantity"]: number(row["value"]) for row in read_table(source, ("quantity", "value"))}


def _ln(share: float) -> float:
    """Logarithm of how many times larger a cost is, of its overhead; an overhead may be below zero."""
    return math.log1p(share)


def _of_priors(
    prior: np.ndarray, inertia: Mapping[str, float], ratio: float, bound: float, tolerance_ln: float
) -> dict[str, float]:
    """Return the numbers that follow from priors (12,) alone."""
    by = dict(zip(PARAMETERS, prior.tolist(), strict=True))
    ratios = [by[f"d_{axis}"] / (2 * math.sqrt(by[f"k_{axis}"] * inertia[axis])) for axis in _AXES]
    return {f"prior_{name}": math.log(value) for name, value in by.items()} | {
        "k_rz_at_bound": float(math.log(by["k_rz"] / bound) < tolerance_ln),
        "damping_ratios": float(sum(value > ratio for value in ratios)),
    }


def numbers_of(people: Sequence[Person], published: Published, settings: Settings) -> np.ndarray:
    """Return the numbers (k,) of a cohort, in the order of `NUMBERS`.

    ``people`` as `cohort.cohort_with_cause` writes them; one may stand several times, as in a bootstrap.
    ``settings`` has the slices ``statistics`` and ``identification``.
    """
    logs = np.concatenate([logs_of(person) for person in people])
    owner = np.repeat(np.arange(len(people)), [len(person["fits"]) for person in people])
    within, cross = (np.array([person[key] for person in people]) for key in ("J_within", "J_cross"))
    overhead = cross / within - 1
    values = {
        "overhead_mean": _ln(float(overhead.mean())),
        "overhead_lowest": _ln(float(overhead.min())),
        "overhead_highest": _ln(float(overhead.max())),
        "loso_J": _ln(float(np.mean([person["overhead_loso_J"] for person in people]))),
        "loso_rmse": _ln(float(np.mean([person["overhead_loso_rmse"] for person in people]))),
        "same_classes": _same_classes(logs, owner, published, settings),
    }
    tolerance = settings["identification"]["at_bound_ln"]
    prior = point_prior(np.exp(logs))
    values |= _of_priors(prior, published.inertia, published.ratio, published.bound, tolerance)
    values |= {f"sd_{n}": float(sd) for n, sd in zip(PARAMETERS, logs.std(axis=0, ddof=1), strict=True)}
    return np.array([values[name] for name in NUMBERS])


def logs_of(person: Person) -> np.ndarray:
    """Return ln of the parameters (n, 12) of a person's fits."""
    return np.log([[fit["parameters"][name] for name in PARAMETERS] for fit in person["fits"]])


def _same_classes(logs: np.ndarray, owner: np.ndarray, published: Published, settings: Settings) -> float:
    """Return how many of the twelve parameters get the published class."""
    if len(np.unique(owner)) < 2:
        return math.nan
    statistics = settings["statistics"]
    boot = icc.cluster_bootstrap(
        logs,
        owner,
        resamples=settings["paper_gap"]["class_resamples"],
        seed=statistics["seed"],
        confidence=statistics["confidence"],
    )
    zones = {key: statistics[key] for key in ("common_below", "distinct_from")}
    found = [classify(low, high, **zones) for low, high in zip(boot.low, boot.high, strict=True)]
    return float(sum(f == published.classes[n] for f, n in zip(found, PARAMETERS, strict=True)))
