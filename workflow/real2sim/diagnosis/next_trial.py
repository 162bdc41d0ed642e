"""The trial to record next: of those that a person could make, the one that parts the leading hypotheses most.

The leading hypotheses are simulated in trials that nobody has recorded yet. How far two of them are apart there is
what one leaves of the other's simulation when its own parameters are fitted anew, as far as the two trials at hand let
them: in units of the noise, the square root of that chi-squared is a number of standard deviations.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from real2sim.diagnosis.attribute import Attribution
from real2sim.diagnosis.decide import UNKNOWN, Decision
from real2sim.diagnosis.evidence import Evidence
from real2sim.diagnosis.free_form import Law
from real2sim.diagnosis.predicted import information
from real2sim.diagnosis.refit import Hypothesis, JointResiduals, following
from real2sim.diagnosis.search import Pair
from real2sim.inference.least_squares import bounded_step

# From a recorded trial, axes of the interface and parameters of the plain plant (p,): trials that could be recorded
# next, in words and as the plain plant would be measured in them
Imagine = Callable[[Any, Sequence[str], np.ndarray], Iterable[tuple[str, Evidence]]]


@dataclass(frozen=True)
class Rival:
    """A hypothesis that may be the truth, and what it is called."""

    name: str
    hypothesis: Hypothesis


def rivals_of(
    attribution: Attribution, decision: Decision, laws: Sequence[Law], shares: Sequence[float]
) -> list[Rival]:
    """Return the two likeliest answers, of sets and measured laws together.

    The probability of `unknown` is that of the laws, by their ``shares`` (laws,). Laws that share families say the same
    in part and are no rivals; sets of the same names are one answer.
    """
    ranked: list[tuple[float, set[Hashable], Rival]] = []
    for law, share in zip(laws, shares, strict=True):
        keys = [family.key for family in law.families]
        more = f" (and {len(keys) - 1} more)" if len(keys) > 1 else ""
        rival = Rival(keys[0] + more, law.hypothesis)
        ranked.append((decision.probabilities[UNKNOWN] * share, set(keys), rival))
    for hypothesis, probability in zip(attribution.hypotheses, decision.sets, strict=True):
        name = " + ".join(n.replace("_", " ") for n in hypothesis.names)
        ranked.append((float(probability), {frozenset(hypothesis.names)}, Rival(name, hypothesis)))
    out: list[Rival] = []
    told: set[Hashable] = set()
    for _, own, rival in sorted(ranked, key=lambda row: -row[0]):
        if told.isdisjoint(own):
            out.append(rival)
            told |= own
    return out[:2]


def axes_of(rivals: Sequence[Rival], pair: Pair, shares: dict[str, float], most: int) -> list[str]:
    """Return the axes that rivals act on, then those that carry most of the gap, ``most`` in all."""
    known = [axis.name for axis in pair.system.axes]
    own = [axis for r in rivals for placed in r.hypothesis.effects for axis in placed.axes]
    own += [axis for axis in known for r in rivals if f" {axis}" in r.name.replace(",", "")]
    rest = sorted(shares, key=lambda axis: -shares[axis])
    return [axis for axis in dict.fromkeys([*own, *rest]) if axis in known][:most]


def propose(
    pair: Pair, rivals: Sequence[Rival], axes: Sequence[str], longest: float, imagine: Imagine
) -> dict[str, Any] | None:
    """Return the trial that parts two rivals most, None where there are no two of them, or no trials to imagine.

    Keys: ``motion`` in words, ``rivals``, ``difference_sd`` (the smaller of both ways round), ``now_sd`` (how far they
    are apart in the held-out trial at hand; None where either cannot be simulated as the other says), ``tried`` (every
    motion with its difference). ``longest`` is the longest step of a searched number that the tangent is believed for.
    """
    if len(rivals) < 2:
        return None
    told_by_both = [
        information((pair.train, pair.held_out), rival.hypothesis, pair.system) for rival in rivals
    ]

    def apart(evidence: Evidence) -> float:
        return min(
            _left(evidence, pair, a.hypothesis, b.hypothesis, known, longest)
            for a, b, known in (
                (rivals[0], rivals[1], told_by_both[1]),
                (rivals[1], rivals[0], told_by_both[0]),
            )
        )

    tried: list[tuple[float, str]] = []
    for words, evidence in imagine(pair.train, axes, pair.system.values(rivals[0].hypothesis.base)):
        difference = apart(evidence)
        if np.isfinite(difference):
            tried.append((difference, words))
    if not tried:
        return None
    tried.sort(key=lambda row: -row[0])
    difference, motion = tried[0]
    now = apart(pair.held_out)
    return {
        "motion": motion,
        "rivals": [rival.name for rival in rivals],
        "difference_sd": difference,
        "now_sd": now if np.isfinite(now) else None,
        "tried": [{"motion": words, "difference_sd": sd} for sd, words in tried],
    }


def told(proposal: Mapping[str, Any]) -> str:
    """Return a proposal of `propose` in one phrase: a motion, or the held-out trial again where none parts better."""
    one, other = proposal["rivals"]
    far, now = round(proposal["difference_sd"]), proposal["now_sd"]
    if now is not None and far <= round(now):
        # the difference at hand is counted beside what both trials tell: a second take adds as much again
        return (
            f"the held-out trial once more; {one} and {other} are {round(now)} standard deviations of noise apart in "
            f"it, and further apart in none of the {len(proposal['tried'])} motions that were tried"
        )
    known = "" if now is None else f", where they are {round(now)} apart in the trial at hand"
    return f"{proposal['motion']}; {one} and {other} would then be {far} standard deviations of noise apart{known}"


def _left(
    evidence: Evidence, pair: Pair, truth: Hypothesis, other: Hypothesis, known: np.ndarray, longest: float
) -> float:
    """Standard deviations that the other hypothesis leaves of what the truth makes of a trial; NaN where one fails."""
    n = evidence.rows
    here = JointResiduals(evidence, truth.effects, pair.system, coarse=True).freely(truth.z)
    problem = following(evidence, other, pair.system, coarse=True, known=False)
    _, jacobian = problem.with_jacobian(other.z, np.arange(len(other.z)))
    apart, slopes = problem.freely(other.z) - here, jacobian[:n]
    if not (np.isfinite(apart).all() and np.isfinite(slopes).all()):
        return float("nan")
    lower = np.maximum(problem.lower - other.z, -longest)
    upper = np.minimum(problem.upper - other.z, longest)
    step = bounded_step(known + slopes.T @ slopes, slopes.T @ apart, lower, upper)
    return float(np.sqrt(np.sum((apart + slopes @ step) ** 2) + step @ known @ step))
