"""From fits to an answer: probabilities over effects, `none` and `unknown`, the ambiguity group and the next trial.

Every refitted set of effects is scored by what it leaves of chi-squared on the training and the held-out trial. The
scores become probabilities by a softmax whose temperature grows with what even the best set leaves over: where the
model is not exact, small differences mean nothing. `none` is the plain plant; `unknown` grows with the share of the gap
that nothing in the catalogue explains, and the more so where different effects explain the rest equally badly. The
constants are in the configuration, ``diagnosis.calibration``.
"""

from __future__ import annotations

from collections.abc import Hashable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from real2sim.effects.catalogue import EFFECT_NAMES, EFFECTS

if TYPE_CHECKING:
    from real2sim.settings import DiagnosisCalibrationSettings

NONE, UNKNOWN = "none", "unknown"

# Effects that no inexact law of another effect looks like: single samples that jump
ISOLATED = ("outliers",)


@dataclass(frozen=True)
class Candidate:
    """A set of effects as the decision sees it: names, free parameters, chi-squared on both trials.

    ``places`` are, by name, where its effects of that name act and in which forms: as many as ``names``, or none.
    ``makeshift``: together its effects are the sign of a cause that the catalogue does not hold; ``doubtful``: they are
    what such a cause looks like as often as themselves.
    """

    names: tuple[str, ...]
    parameters: int
    chi2: tuple[float, float]
    makeshift: bool = False
    doubtful: bool = False
    places: tuple[tuple[str, ...], ...] = ()

    @property
    def placed(self) -> tuple[frozenset[str], ...]:
        """Places of the effects of each name, or the name: they tell them from those of other sets."""
        return tuple(map(frozenset, self.places)) or tuple(frozenset((name,)) for name in self.names)

    @property
    def everywhere(self) -> frozenset[str]:
        """All of `placed` together."""
        return frozenset().union(*self.placed)

    @property
    def answer(self) -> tuple[frozenset[str], bool]:
        """What it says of the cause: the same for every order, form and place of its effects."""
        return frozenset(self.names), self.makeshift


@dataclass(frozen=True)
class Decision:
    """Probabilities by effect name, `none` and `unknown` (they add up to 1), and by candidate (same order)."""

    probabilities: dict[str, float]
    sets: np.ndarray
    verdict: str
    group: tuple[str, ...]
    chosen: int | None


def unexplained(
    plain: Candidate,
    candidates: Sequence[Candidate],
    samples: tuple[int, int],
    c: DiagnosisCalibrationSettings,
) -> float:
    """Share of the gap that even the best set leaves, less what noise may leave: 0 where all of it is explained."""
    total, n = sum(plain.chi2), sum(samples)
    best = min((_least(x, c) for x in candidates), default=total)
    spread = np.sqrt(2 * n)
    left = min(best, total) - (1 + c["granted_share"]) * n - c["granted_sd"] * spread
    return float(max(left, 0.0) / max(total - n, spread))


def further_price(
    plain: tuple[float, float], samples: tuple[int, int], c: DiagnosisCalibrationSettings
) -> float:
    """What a second and every further law must take from chi-squared, given that of the plain plant on both trials.

    It must earn something in itself and, lest it mend the form of another, beside the gap.
    """
    return c["second_effect"] + c["second_effect_share"] * max(sum(plain) - sum(samples), 0.0)


def gain_of_a_law(parameters: int, c: DiagnosisCalibrationSettings) -> float:
    """Chi-squared, the training trial weighted, from which on a law of some parameters is likelier than `none`."""
    return c["none_gain"] + c["per_parameter"] * parameters


def is_out_of_reach(
    plain: tuple[float, float], samples: tuple[int, int], c: DiagnosisCalibrationSettings
) -> bool:
    """Whether the plain plant leaves so little that even a law which explained all of it would not be believed.

    Given chi-squared of the plain plant on both trials; ``granted_sd`` of what noise leaves are granted to that law.
    """
    weights = np.array([c["train_weight"], 1.0])
    gain = float(weights @ (np.array(plain) - samples)) + c["granted_sd"] * float(
        np.sqrt(weights**2 @ (2 * np.array(samples)))
    )
    return bool(
        (c["none_gain"] - gain) / c["none_temperature"] > np.log(1 / c["questionable_probability"] - 1)
    )


def _least(candidate: Candidate, c: DiagnosisCalibrationSettings) -> float:
    """Chi-squared of both trials that a set leaves, and what its free parameters count for."""
    return sum(candidate.chi2) + c["chance_per_parameter"] * candidate.parameters


def _left(candidate: Candidate, c: DiagnosisCalibrationSettings) -> float:
    """What a set leaves of chi-squared, the training trial weighted."""
    return c["train_weight"] * candidate.chi2[0] + candidate.chi2[1]


def _laws(candidate: Candidate) -> int:
    return sum(name not in ISOLATED for name in candidate.names)


def logits(
    plain: Candidate,
    candidates: Sequence[Candidate],
    samples: tuple[int, int],
    c: DiagnosisCalibrationSettings,
) -> np.ndarray:
    """Unnormalised log-probabilities of the candidates, then of none and unknown."""
    best_chi2 = min(sum(plain.chi2), *(_least(x, c) for x in candidates), np.inf)
    temperature = c["temperature"] + c["temperature_per_excess"] * max(best_chi2 - sum(samples), 0.0)

    further = further_price(plain.chi2, samples, c)

    def score(candidate: Candidate) -> float:
        price = c["per_parameter"] * candidate.parameters
        price += c["isolated"] * (len(candidate.names) - _laws(candidate))
        price += further * max(_laws(candidate) - 1, 0)
        return -(_left(candidate, c) + price) / temperature

    best = max([score(x) for x in candidates] + [score(plain)])
    # an effect has no better chance for having many forms and places: its best one counts, the others share with it
    rows = _shared([score(x) - best for x in candidates], [x.answer for x in candidates])
    # a first law has to earn its price, and near that price less is certain than between what two laws leave; jumps
    # are no law and stand beside none at their own price
    none = (temperature * (score(plain) - best) + c["none_gain"]) / max(c["none_temperature"], temperature)
    none += c["none"]
    rows = [
        row if _laws(x) else none + score(x) - score(plain) for row, x in zip(rows, candidates, strict=True)
    ]
    scatter = _scatter(plain, candidates, np.array(rows), c)
    # odds against all laws together: that many of them compete is no reason to believe in one of them
    of_laws = [row for row, x in zip(rows, candidates, strict=True) if _laws(x)]
    unknown = c["unknown"] + float(np.logaddexp.reduce(of_laws) if of_laws else 0.0)
    unknown += c["unknown_unexplained"] * np.log(
        max(unexplained(plain, candidates, samples, c), c["least_unexplained"])
    )
    unknown += c["unknown_scatter"] * np.log(max(scatter, c["least_scatter"]))
    return np.array([*rows, none, unknown])


def _scatter(
    plain: Candidate, candidates: Sequence[Candidate], rows: np.ndarray, c: DiagnosisCalibrationSettings
) -> float:
    """How much of the effects' probability does not belong to the likeliest one: 0 where one effect has it all."""
    named = [i for i, candidate in enumerate(candidates) if not candidate.makeshift]
    if not named:
        return 1.0
    p = np.zeros(len(rows))
    p[named] = np.exp(rows[named] - rows[named].max())
    shares = _shares(plain, candidates, p, c)
    return 1 - max(shares.values()) / sum(shares.values())


def _shared(rows: Sequence[float], answers: Sequence[Hashable]) -> list[float]:
    """Log-probabilities with those of the same answer lowered until together they weigh as much as their best."""
    values = np.array(rows)
    for answer in set(answers):
        same = [i for i, other in enumerate(answers) if other == answer]
        most = values[same].max()
        values[same] -= np.log(np.sum(np.exp(values[same] - most)))
    return list(values)


def decide(
    plain: Candidate,
    candidates: Sequence[Candidate],
    samples: tuple[int, int],
    calibration: DiagnosisCalibrationSettings,
) -> Decision:
    """Probabilities, verdict and ambiguity group. ``samples`` are the residuals of training and held-out trial."""
    z = logits(plain, candidates, samples, calibration)
    p = np.exp(z - z.max())
    p /= p.sum()
    probabilities = dict.fromkeys((*EFFECT_NAMES, NONE, UNKNOWN), 0.0)
    makeshift = np.array([candidate.makeshift for candidate in candidates], dtype=bool)
    sets = p[: len(candidates)]
    doubt = calibration["doubtful"] * _doubted(candidates, z)
    probabilities |= _shares(plain, candidates, sets * (1 - doubt), calibration)
    probabilities[NONE] = float(p[-2])
    probabilities[UNKNOWN] = float(p[-1] + sets[makeshift].sum() + (sets * doubt)[~makeshift].sum())
    effects = 1 - probabilities[NONE] - probabilities[UNKNOWN]
    together = [sets[[x.answer == other.answer for x in candidates]].sum() for other in candidates]
    # the likeliest effect, whatever is beside it; of the sets that hold it the likeliest effects, and of those the
    # likeliest places and forms
    likeliest_effect = _likeliest_effect(candidates, sets, makeshift)
    open_to = ~makeshift & np.array([likeliest_effect in x.names for x in candidates], dtype=bool)
    named = np.where(open_to, sets, -1.0)
    likeliest = np.where(open_to, together, -1.0)
    chosen = int(np.lexsort((named, likeliest))[-1]) if not makeshift.all() else None
    if chosen is None or max(probabilities[NONE], probabilities[UNKNOWN]) >= effects:
        verdict = NONE if probabilities[NONE] >= probabilities[UNKNOWN] else UNKNOWN
        return Decision(probabilities, sets, verdict, (verdict,), None)
    names = candidates[chosen].names
    verdict = max(names, key=lambda name: probabilities[name])
    group = _group(names, verdict, probabilities, calibration["ambiguity_probability"])
    return Decision(probabilities, sets, verdict, group, chosen)


def _doubted(candidates: Sequence[Candidate], z: np.ndarray) -> np.ndarray:
    """Which candidates (n,) give an answer whose likeliest form, by log-probabilities ``z``, is doubtful."""
    best: dict[tuple[frozenset[str], bool], int] = {}
    for i, candidate in enumerate(candidates):
        if candidate.answer not in best or z[i] > z[best[candidate.answer]]:
            best[candidate.answer] = i
    return np.array([candidates[best[x.answer]].doubtful for x in candidates], dtype=float)


def share_of_other(costs: tuple[float, float], temperature: float) -> float:
    """Probability of the other hold, of the costs (`cost_of_answer`) of the answers for one and the other."""
    return 1 / (1 + float(np.exp(np.clip((costs[1] - costs[0]) / temperature, -50, 50))))


def averaged(decision: Decision, other: Decision, share: float, ambiguity_probability: float) -> Decision:
    """A decision with a ``share`` of the probabilities of the one for the other hold (`share_of_other`).

    Verdict and named set stay those of the likelier hold. Effects above ``ambiguity_probability`` join its group.
    """
    mixed = {
        name: (1 - share) * value + share * other.probabilities[name]
        for name, value in decision.probabilities.items()
    }
    also = [n for n in EFFECT_NAMES if n not in decision.group and mixed[n] > ambiguity_probability]
    group = (*decision.group, *sorted(also, key=lambda n: -mixed[n]))
    return replace(decision, probabilities=mixed, sets=decision.sets * (1 - share), group=group)


def cost_of_answer(
    plain: Candidate,
    candidates: Sequence[Candidate],
    samples: tuple[int, int],
    calibration: DiagnosisCalibrationSettings,
) -> float:
    """What the answer leaves of chi-squared on both trials, and a price for its parameters and laws.

    It tells which of two ways to hold the robot is the better one. A static law does under one what no law has to under
    the other, so that a law costs little here beside what it must earn to be named. Where the answer is `unknown`, the
    set counts that leaves least. Arguments as of `decide`.
    """
    decision = decide(plain, candidates, samples, calibration)
    if decision.chosen is not None:
        answer = candidates[decision.chosen]
    elif decision.verdict == NONE:
        answer = plain
    else:
        answer = min((plain, *candidates), key=lambda x: sum(x.chi2))
    price = calibration["per_parameter"] * answer.parameters + calibration["law_of_hold"] * _laws(answer)
    return sum(answer.chi2) + price


def _shares(
    plain: Candidate, candidates: Sequence[Candidate], p: np.ndarray, c: DiagnosisCalibrationSettings
) -> dict[str, float]:
    """Probability of each effect from that of the sets, ``p`` (candidates,): a set's is shared by what they earn."""
    shares: dict[str, float] = {}
    for candidate, of_set in zip(candidates, p, strict=True):
        if not candidate.makeshift:
            earned = _earned(candidate, plain, candidates, c)
            for name, part in zip(candidate.names, earned, strict=True):
                shares[name] = shares.get(name, 0.0) + float(of_set * part)
    return shares


def _likeliest_effect(candidates: Sequence[Candidate], sets: np.ndarray, makeshift: np.ndarray) -> str | None:
    """Effect whose sets are the likeliest together; None without a set."""
    held: dict[str, float] = {}
    for candidate, of_set, makes_do in zip(candidates, sets, makeshift, strict=True):
        if not makes_do:
            for name in set(candidate.names):
                held[name] = held.get(name, 0.0) + float(of_set)
    return max(held, key=lambda name: held[name], default=None)


def _earned(
    candidate: Candidate, plain: Candidate, candidates: Sequence[Candidate], c: DiagnosisCalibrationSettings
) -> np.ndarray:
    """Shares (names,) of a set's probability, by what the set loses when it has to do without each effect.

    What would be left then is read off the best fit that has only the others, at their places; effects that earn alike
    share alike.
    """
    if len(candidate.names) == 1:
        return np.ones(1)

    lost = []
    for own in candidate.placed:
        others = candidate.everywhere - own
        without = min(_left(x, c) for x in (plain, *candidates) if x.everywhere <= others)
        lost.append(max(without - _left(candidate, c), 1.0))
    return np.array(lost) / sum(lost)


def _group(
    names: Sequence[str], verdict: str, probabilities: Mapping[str, float], least: float
) -> tuple[str, ...]:
    """Return the verdict, then effects outside the named set above the ``least`` probability, likeliest first."""
    rest = [n for n in EFFECT_NAMES if n not in names and probabilities[n] > least]
    return (verdict, *sorted(rest, key=lambda n: -probabilities[n]))


def next_trial(decision: Decision, certain: float) -> str | None:
    """Return the trial that would separate the likeliest effects, in one phrase.

    None where a cause or a set of effects has the probability ``certain`` or more: nothing is left to separate. There
    always is one where the cause is unknown.
    """
    top = sorted(decision.probabilities.items(), key=lambda item: -item[1])
    # the probability of a set of effects is shared out between them
    if decision.verdict != UNKNOWN and max(top[0][1], *decision.sets) >= certain:
        return None
    for name, _ in top:
        for effect in EFFECTS:
            if effect.name == name:
                return effect.separating_trial
    return None
