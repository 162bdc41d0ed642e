"""Which cases a suite has and what each of them holds. Light imports: the Snakefile calls this when parsed."""

from __future__ import annotations

import json
import math
import statistics
import zlib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

# The effects that the suite is made of: those shipped, in the order of the catalogue. Listed again, because the
# Snakefile imports this module whenever it is parsed, and the catalogue imports MuJoCo.
EFFECTS = (
    "slack",
    "one_sided",
    "stiffening",
    "asymmetric_stiffness",
    "coulomb",
    "lugre",
    "hysteresis",
    "relaxation",
    "creep",
    "migration",
    "cross_coupling",
    "misalignment",
    "preload",
    "joint_limit",
    "quadratic_damping",
    "added_mass",
    "base_compliance",
    "controller_reaction",
    "tilt",
    "soft_tissue",
    "lab_yaw",
    "replay_lag",
    "sync_offset",
    "clock_drift",
    "filter_lag",
    "marker_offset",
    "marker_drift",
    "outliers",
)

# A mixture takes no two effects of one group. These are not `are_confusable` of the catalogue: the pairs are drawn by
# their number, and other groups would change the cases of every seed that has been answered.
GROUPS = (
    ("replay_lag", "sync_offset", "filter_lag", "clock_drift"),
    ("one_sided", "preload", "tilt", "marker_offset", "asymmetric_stiffness"),
    ("migration", "marker_drift", "creep"),
    ("added_mass", "base_compliance", "controller_reaction"),
    ("coulomb", "lugre", "hysteresis", "relaxation", "quadratic_damping", "soft_tissue"),
    ("slack", "stiffening", "joint_limit"),
    ("cross_coupling", "misalignment", "lab_yaw"),
    ("outliers",),
)

# Effects that can share an axis with another one in `shared_axis`: laws of the interface along one axis. Without
# `migration`, which is one too: with it, the seeds that have been answered would draw other pairs.
OF_ONE_AXIS = (
    "slack",
    "one_sided",
    "stiffening",
    "asymmetric_stiffness",
    "coulomb",
    "lugre",
    "hysteresis",
    "relaxation",
    "creep",
    "preload",
    "joint_limit",
    "quadratic_damping",
)

# Laws that no catalogue lists, by distribution, as they are drawn in `random_law`; listed here for the same reason.
RANDOM_LAWS = (
    "random_elastic",
    "random_elastic_coupling",
    "random_coupling",
    "random_dissipation",
    "random_damping_by_coordinate",
    "random_memory",
    "random_hysteresis",
    "random_gain_time",
    "random_gain_posture",
    "random_gain_place",
    "random_rhythm",
    "random_force_strap",
    "random_force_base",
    "random_base_place",
    "random_base_speed",
    "random_pelvis_markers",
    "random_interface_markers",
    "random_deflected_markers",
)

# Seconds that a case took to write and to answer on one core of a 2-core machine, where nothing was measured yet
WRITE_S, ANSWER_S = 5.0, 40.0

STRATA = (
    "null",
    "null_hard",
    "in_library",
    "form_mismatch",
    "mixture",
    "out_of_library",
    "left_out",
    "random_law",
    "shared_axis",
)


@dataclass(frozen=True)
class Case:
    """One case before anything is drawn but its cause: names of the forms and the visibility asked for."""

    id: str
    stratum: str
    forms: tuple[str, ...]
    target: float | None

    @property
    def left_out(self) -> tuple[str, ...]:
        """Names that the catalogue is without when the case is diagnosed: public, as the analysis has to be told."""
        return self.forms if self.stratum == "left_out" else ()


def left_out(suite: dict[str, Any], shard: int) -> dict[str, list[str]]:
    """Names to leave out of the catalogue, by case, for the cases of one shard that ask for it."""
    names = set(case_names(suite, shard))
    return {case.id: list(case.left_out) for case in cases(suite) if case.id in names and case.left_out}


def shards(suite: dict[str, Any]) -> int:
    """Number of shards of a suite."""
    count: int = -(-sum(suite["cases"].values()) // suite["shard_cases"])
    return count


def case_names(suite: dict[str, Any], shard: int) -> list[str]:
    """Names of the cases of one shard, counted from 0."""
    size, total = suite["shard_cases"], sum(suite["cases"].values())
    return [f"C{i + 1:04d}" for i in range(shard * size, min((shard + 1) * size, total))]


def expected_time(suite: dict[str, Any], results: Path, cores: int) -> str:
    """Return the expected time of a suite in one line, from the answers of any suite on this machine.

    ``results`` is results/suite. Cases that have been answered already cost nothing more.
    """
    total = sum(suite["cases"].values())
    # a job per shard: a core that has no shard of its own stands still
    busy = max(1, min(cores, shards(suite)))
    times = [_seconds(path) for path in results.glob("*/cases/*/seconds.json")]
    known = [t for t in times if t is not None]
    answer = statistics.median(known) if known else ANSWER_S
    own = results / suite["name"]
    answered = sum(
        1
        for i in range(shards(suite))
        for c in case_names(suite, i)
        if (own / "cases" / c / "seconds.json").exists()
    )
    written = sum(
        len(case_names(suite, i)) for i in range(shards(suite)) if (own / "sealed" / f"{i:03d}.json").exists()
    )
    left = ((total - answered) * answer + (total - written) * WRITE_S) / busy
    source = f"measured on {len(known)} cases here" if known else "measured on a 2-core machine"
    return (
        f"suite {suite['name']}: {total} cases in {shards(suite)} shards, {answered} answered already; about"
        f" {answer + WRITE_S:.0f} s a case ({source}), {busy} at a time: about {math.ceil(left / 60)} min left."
        " It can be stopped at any time: the same command goes on."
    )


def _seconds(path: Path) -> float | None:
    try:
        return float(json.loads(path.read_text(encoding="utf-8"))["seconds"])
    except (OSError, ValueError, KeyError):
        return None


def stream(suite: dict[str, Any], *names: str) -> np.random.Generator:
    """Random numbers of one purpose, independent of every other and of the order of the draws."""
    return np.random.default_rng([suite["seed"], *(zlib.crc32(name.encode()) for name in names)])


def cases(suite: dict[str, Any]) -> list[Case]:
    """All cases of a suite: counts per stratum as configured, effects and visibilities in balance.

    The order is shuffled, so that a name says nothing about the stratum.
    """
    planned: list[tuple[str, tuple[str, ...], float | None]] = []
    for stratum in STRATA:
        count = suite["cases"][stratum]
        if stratum.startswith("null"):
            planned += [(stratum, (), None)] * count
        else:
            planned += [(stratum, *pick) for pick in _picks(suite, stratum, count)]
    order = stream(suite, "order").permutation(len(planned))
    return [Case(f"C{i + 1:04d}", *planned[j]) for i, j in enumerate(order)]


def _picks(suite: dict[str, Any], stratum: str, count: int) -> list[tuple[tuple[str, ...], float]]:
    rng, targets = stream(suite, stratum), suite["visibilities"][stratum]
    if stratum in ("mixture", "shared_axis"):
        shared = stratum == "shared_axis"
        pairs = _pairs([name for name in suite["effects"] if not shared or name in OF_ONE_AXIS])
        chosen = [pairs[i] for i in rng.permutation(len(pairs))]
        return [(chosen[i % len(chosen)], targets[i % len(targets)]) for i in range(count)]
    pool = suite["effects"] if stratum in ("in_library", "left_out") else suite[stratum]
    pool = [pool[i] for i in rng.permutation(len(pool))]
    shift = rng.integers(len(targets), size=len(pool))
    # every round has each form once, at another visibility than the round before
    return [
        ((pool[i % len(pool)],), targets[(i // len(pool) + shift[i % len(pool)]) % len(targets)])
        for i in range(count)
    ]


def _pairs(effects: list[str]) -> list[tuple[str, str]]:
    group = {name: i for i, names in enumerate(GROUPS) for name in names}
    return [
        (a, b) for i, a in enumerate(effects) for b in effects[i + 1 :] if group.get(a, a) != group.get(b, b)
    ]
