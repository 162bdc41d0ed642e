"""From fits to an answer: probabilities over effects, `none` and `unknown`, the ambiguity group and the next trial.

A refitted set of effects has an evidence: the marginal likelihood of the training trial (Laplace's approximation) times
the likelihood of the held-out one, or the marginal likelihood of both (`both_trials`), as a deviance in units of
chi-squared. The likelihood has a heavier tail than noise alone: models are inexact in a few ways that no noise
describes, and where even the best set leaves something, a difference of that size means nothing. To that come prior
probabilities: of any cause against `none`, of every further one, and of a cause that the catalogue does not hold, the
larger the more is left of the gap by what is fitted to the training trial alone. The constants are in the
configuration, ``diagnosis.calibration``; ``benchmarks/calibrate_diagnosis.py`` fits them to development cases, by the
logarithm of the probability that the truth gets.
"""

from __future__ import annotations

from collections.abc import Hashable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from real2sim.diagnosis.sensors import above
from real2sim.effects.catalogue import EFFECT_NAMES, EFFECTS

if TYPE_CHECKING:
    from real2sim.settings import DiagnosisCalibrationSettings

NONE, UNKNOWN = "none", "unknown"

# What to record where no effect of the catalogue is likely
_NO_LEAD = "the same motion twice, then at half the speed: it tells a law from what never repeats, and place from speed"

# Effects that no inexact law of another effect looks like: single samples that jump
ISOLATED = ("outliers",)


@dataclass(frozen=True)
class Candidate:
    """A set of effects as the decision sees it: names and chi-squared of each trial, by which it competes with others.

    ``occam`` is what the marginal likelihood adds to chi-squared (`JointResiduals.occam_of`), less what it adds for the
    plain plant. ``places`` are, by name, where its effects of that name act and in which forms: as many as ``names``,
    or none. ``unlisted``: a law without a name; ``ambiguous``: one of its effects stands for laws without a name as
    often as for itself. ``sensors``: chi-squared and residuals of each sensor, all trials together, and whether
    it is on its floor; empty: all is of one sensor that is not. Theirs is the chi-squared of the fit to the first
    trial, which tells how much is unexplained, also where that of ``chi2`` is of numbers fitted to both trials.
    """

    names: tuple[str, ...]
    chi2: tuple[float, ...]
    occam: float = 0.0
    unlisted: bool = False
    ambiguous: bool = False
    places: tuple[tuple[str, ...], ...] = ()
    sensors: tuple[tuple[float, float, bool], ...] = ()

    def beyond(self, samples: tuple[int, ...], share: float = 0.0) -> float:
        """Return chi-squared beyond noise that is louder by a ``share`` of its expectation, at least 0."""
        left, expected, on_floor = zip(
            *(self.sensors or ((sum(self.chi2), sum(samples), False),)), strict=True
        )
        return max(above(left, expected, on_floor, share), 0.0)

    @property
    def left(self) -> float:
        """Chi-squared of all trials that tells how much is unexplained."""
        return sum(left for left, _, _ in self.sensors) if self.sensors else sum(self.chi2)

    @property
    def deviance(self) -> float:
        """Minus twice the logarithm of its evidence, but for what all candidates have in common."""
        return sum(self.chi2) + self.occam

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
        """Names of the cause: the same for every order, form and place of its effects."""
        return frozenset(self.names), self.unlisted


@dataclass(frozen=True)
class Decision:
    """Probabilities by effect name, `none` and `unknown` (they add up to 1), and by candidate (same order).

    ``doubt`` is the probability that was taken from ambiguous sets and counts for `unknown`.
    """

    probabilities: dict[str, float]
    sets: np.ndarray
    verdict: str
    group: tuple[str, ...]
    chosen: int | None
    doubt: float = 0.0


def _gap(plain: Candidate, samples: tuple[int, ...]) -> float:
    """Chi-squared of both trials that the plain plant leaves above its expectation, at least its SD."""
    return max(plain.beyond(samples), float(np.sqrt(2 * sum(samples))))


def unexplained(
    plain: Candidate,
    candidates: Sequence[Candidate],
    samples: tuple[int, ...],
    c: DiagnosisCalibrationSettings,
) -> float:
    """Share of the gap that even the best set leaves beyond noise: 0 where all of it is explained.

    The level of noise is known to ``noise_share``.
    """
    left = min(x.beyond(samples, c["noise_share"]) for x in (plain, *candidates))
    return left / _gap(plain, samples)


def _odds_of_unlisted(share: float, c: DiagnosisCalibrationSettings) -> float:
    """Odds that something acts which explains more, where the best explanation leaves a ``share`` of the gap."""
    return float((share / c["even_share"]) ** c["share_power"])


def log_likelihood(difference: float, left: float, c: DiagnosisCalibrationSettings) -> float:
    """Logarithm of the likelihood ratio for a deviance that is larger by ``difference`` than the best one.

    ``left`` is what the best set leaves beyond noise. That of Student's distribution with as many degrees of freedom as
    a model has ways of being inexact: a Gaussian of ``overdispersion`` for small differences, logarithmic beyond.
    """
    width = c["overdispersion"] * c["inexact_ways"] + left
    return -c["inexact_ways"] / 2 * float(np.log1p(difference / width))


def difference_for(log_odds: float, c: DiagnosisCalibrationSettings, left: float = 0.0) -> float:
    """Return the difference in deviance that makes up for prior odds, where the better set leaves so much beyond noise.

    The inverse of `log_likelihood`.
    """
    return (c["overdispersion"] * c["inexact_ways"] + left) * float(
        np.expm1(2 * log_odds / c["inexact_ways"])
    )


def further_price(c: DiagnosisCalibrationSettings) -> float:
    """Return what a second and every further effect must take from the deviance to be likelier than without it."""
    return difference_for(c["further_log_odds"], c)


def gain_of_a_law(c: DiagnosisCalibrationSettings) -> float:
    """Return the gain in deviance from which on a cause is likelier than `none`."""
    return difference_for(c["cause_log_odds"], c)


def is_out_of_reach(left: float, samples: int, questionable: float, c: DiagnosisCalibrationSettings) -> bool:
    """Return whether the plain plant leaves so little that even a law which explained all of it would not be believed.

    ``left`` is chi-squared of the plain plant less its expectation (`sensors.above`), of ``samples`` residuals in both
    trials. Two standard deviations of what noise leaves are granted to that law, and it has to be as likely as
    ``questionable``.
    """
    return left < reach(samples, questionable, c)


def reach(samples: int, questionable: float, c: DiagnosisCalibrationSettings) -> float:
    """Return chi-squared above its expectation from which on `is_out_of_reach` no longer holds."""
    log_odds = c["cause_log_odds"] + float(np.log(questionable / (1 - questionable)))
    return difference_for(log_odds, c) - 2 * float(np.sqrt(2 * samples))


def _laws(candidate: Candidate) -> int:
    return sum(name not in ISOLATED for name in candidate.names)


def _further(candidate: Candidate, c: DiagnosisCalibrationSettings) -> float:
    """Logarithm of the prior odds against the effects of a set beside its first law."""
    laws = _laws(candidate)
    return c["further_log_odds"] * (max(laws - 1, 0) + len(candidate.names) - laws)


def logits(
    plain: Candidate,
    candidates: Sequence[Candidate],
    samples: tuple[int, ...],
    c: DiagnosisCalibrationSettings,
) -> np.ndarray:
    """Return log-odds (k + 2,) against none: of the k candidates, then of none (0) and unknown.

    First a cause competes with none, by what the best set gains, or what one that is not listed would if it left only
    noise. What a cause has is shared out between the listed sets, by their evidence, and `unknown`, by what they leave.
    A candidate that is not listed competes with the sets by evidence. What it explains is not explained by listed
    effects, so that it neither makes `unknown`, which it counts for, less likely, nor one set surer against another.
    """
    listed = [x for x in candidates if not x.unlisted]
    share = unexplained(plain, listed, samples, c)
    # what a law that explains all but noise would leave, by the set that leaves least
    least = min((plain, *listed), key=lambda x: x.left)
    noise = least.left - least.beyond(samples, c["noise_share"])
    odds = _odds_of_unlisted(share, c)

    def gained(deviance: float) -> float:
        return -log_likelihood(max(plain.deviance - deviance, 0.0), 0.0, c)

    # jumps are no law, and stand beside none at their own odds
    rows = np.array([gained(x.deviance) - _further(x, c) for x in candidates])
    laws = np.array([_laws(x) > 0 for x in candidates], dtype=bool)
    named = laws & np.array([not x.unlisted for x in candidates], dtype=bool)
    named = named if named.any() else laws
    if laws.any():
        # that many laws compete is no reason to believe in one of them
        together = rows[named].max() - c["cause_log_odds"] - np.log1p(odds)
        # a law competes with all sets together, by what the best of all leaves
        left = unexplained(plain, candidates, samples, c) * _gap(plain, samples)
        rows[laws] = _among(_masked(candidates, laws), left, c)
        rows[laws] += together - np.logaddexp.reduce(rows[named])
        # and sets with each other as if there were no law
        rows[named] = _among(_masked(candidates, named), share * _gap(plain, samples), c) + together
    # something that is not listed explains all but noise, or looks the same as what is listed
    unknown = gained(min(noise, plain.deviance)) - c["cause_log_odds"] - np.log1p(1 / max(odds, 1e-300))
    alike = np.log(c["unlisted_odds"]) + float(np.logaddexp.reduce(rows[named], initial=-np.inf))
    return np.array([*rows, 0.0, np.logaddexp(unknown, alike)])


def _masked(candidates: Sequence[Candidate], which: np.ndarray) -> list[Candidate]:
    """Return the candidates that a mask (k,) holds."""
    return [candidate for candidate, taken in zip(candidates, which, strict=True) if taken]


def shares_of(
    laws: Sequence[Candidate], samples: tuple[int, ...], calibration: DiagnosisCalibrationSettings
) -> np.ndarray:
    """Return the share (n,) of each measured law in the probability of `unknown`, by evidence as between listed sets.

    ``samples`` are the residuals of each trial.
    """
    left = min(law.beyond(samples, calibration["noise_share"]) for law in laws)
    return np.asarray(np.exp(_among(laws, left, calibration)))


def _among(sets: Sequence[Candidate], left: float, c: DiagnosisCalibrationSettings) -> np.ndarray:
    """Log-probabilities of sets beside each other, where even the best one leaves so much beyond noise."""
    best = min(x.deviance for x in sets)
    own = [log_likelihood(x.deviance - best, left, c) - _further(x, c) for x in sets]
    # an effect has no better chance for having many forms and places: its best one counts, the others share with it
    rows = np.array(_shared(own, [x.answer for x in sets]))
    return np.asarray(rows - np.logaddexp.reduce(rows))


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
    samples: tuple[int, ...],
    calibration: DiagnosisCalibrationSettings,
) -> Decision:
    """Probabilities, verdict and ambiguity group. ``samples`` are the residuals of training and held-out trial."""
    z = logits(plain, candidates, samples, calibration)
    p = np.exp(z - z.max())
    p /= p.sum()
    probabilities = dict.fromkeys((*EFFECT_NAMES, NONE, UNKNOWN), 0.0)
    unlisted = np.array([candidate.unlisted for candidate in candidates], dtype=bool)
    sets = p[: len(candidates)]
    doubted = np.where(unlisted, 0.0, sets * calibration["ambiguous_share"] * _doubted(candidates, z))
    sets, doubt = sets - doubted, float(doubted.sum())
    probabilities |= _shares(plain, candidates, sets)
    probabilities[NONE] = float(p[-2])
    probabilities[UNKNOWN] = float(p[-1] + sets[unlisted].sum() + doubt)
    return replace(_judged(candidates, sets, probabilities, calibration), doubt=doubt)


def _judged(
    candidates: Sequence[Candidate],
    sets: np.ndarray,
    probabilities: dict[str, float],
    calibration: DiagnosisCalibrationSettings,
) -> Decision:
    """Verdict and group by the probabilities of candidates, ``sets`` (candidates,), and of names."""
    unlisted = np.array([candidate.unlisted for candidate in candidates], dtype=bool)
    effects = 1 - probabilities[NONE] - probabilities[UNKNOWN]
    together = [sets[[x.answer == other.answer for x in candidates]].sum() for other in candidates]
    # the likeliest effect, whatever is beside it; of the sets that hold it the likeliest effects, and of those the
    # likeliest places and forms
    likeliest_effect = _likeliest_effect(candidates, sets, unlisted)
    open_to = ~unlisted & np.array([likeliest_effect in x.names for x in candidates], dtype=bool)
    named = np.where(open_to, sets, -1.0)
    likeliest = np.where(open_to, together, -1.0)
    chosen = int(np.lexsort((named, likeliest))[-1]) if not unlisted.all() else None
    if chosen is None or max(probabilities[NONE], probabilities[UNKNOWN]) >= effects:
        verdict = NONE if probabilities[NONE] >= probabilities[UNKNOWN] else UNKNOWN
        return Decision(probabilities, sets, verdict, (verdict,), None)
    names = candidates[chosen].names
    verdict = max(names, key=lambda name: probabilities[name])
    group = _group(names, verdict, probabilities, calibration["ambiguity_probability"])
    return Decision(probabilities, sets, verdict, group, chosen)


def with_layers(
    decision: Decision,
    candidates: Sequence[Candidate],
    plain: Candidate,
    layers: Mapping[int, Candidate],
    alone: Sequence[Candidate],
    samples: tuple[int, ...],
    calibration: DiagnosisCalibrationSettings,
    mended: Mapping[int, frozenset[str]],
) -> Decision:
    """Share out the probability of `unknown` between laws without a name and listed sets with such a law beside them.

    That more is left than listed effects explain says that something acts which is not listed. Whether a listed effect
    acts too is told by evidence: of a set with a measured law on top, against measured laws without the set.

    Parameters
    ----------
    decision, candidates
        A decision, and what it was made of.
    layers
        By index of a listed set among the candidates: the same set with a measured law on top.
    alone
        Measured laws without a listed effect, the names those of their families.
    samples
        Residuals of each trial.
    mended
        By the same index, the effects of the set that the law on top may only give another equation: they stand for
        laws without a name as often as for themselves, like a set that is ``ambiguous``.
    """
    if not layers or not alone:
        return decision
    c, everything = calibration, [*layers.values(), *alone]
    best = min(x.deviance for x in everything)
    left = min(x.beyond(samples, c["noise_share"]) for x in everything)
    # the law on top stands beside the first effect of its set, as every further one does
    further = [_further(candidates[i], c) + c["further_log_odds"] for i in layers]
    further += [c["further_log_odds"] * (len(x.names) - 1) for x in alone]
    rows = np.array(
        [log_likelihood(x.deviance - best, left, c) - f for x, f in zip(everything, further, strict=True)]
    )
    # that many sets or laws compete is no reason to believe in one of them: the best of either counts
    of_sets = np.exp(rows[: len(layers)] - rows.max())
    listed = of_sets.max() / (of_sets.max() + float(np.exp(rows[len(layers) :].max() - rows.max())))
    # and where even that leaves much, it is neither
    listed /= 1 + _odds_of_unlisted(left / _gap(plain, samples), c)
    # the doubt about a set that is ambiguous by itself is not taken back by a law on top
    open_to_all = decision.probabilities[UNKNOWN] - decision.doubt
    moved = np.zeros(len(candidates))
    moved[list(layers)] = open_to_all * listed * of_sets / of_sets.sum()
    shares, moved = _without_doubt(plain, candidates, moved, mended, c["ambiguous_share"])
    probabilities = {n: p + shares.get(n, 0.0) for n, p in decision.probabilities.items()}
    probabilities[UNKNOWN] = decision.probabilities[UNKNOWN] - float(moved.sum())
    return replace(_judged(candidates, decision.sets + moved, probabilities, c), doubt=decision.doubt)


def _without_doubt(
    plain: Candidate,
    candidates: Sequence[Candidate],
    p: np.ndarray,
    mended: Mapping[int, frozenset[str]],
    doubt: float,
) -> tuple[dict[str, float], np.ndarray]:
    """Return `_shares` less the ``doubt`` about ambiguous and mended effects, and those of each set together."""
    shares: dict[str, float] = {}
    kept = np.zeros(len(candidates))
    for i, candidate in enumerate(candidates):
        for name, part in _shares(plain, candidates, np.where(np.arange(len(p)) == i, p, 0.0)).items():
            doubted = candidate.ambiguous or name in mended.get(i, frozenset())
            won = part * (1 - doubt) if doubted else part
            shares[name] = shares.get(name, 0.0) + won
            kept[i] += won
    return shares, kept


def _doubted(candidates: Sequence[Candidate], z: np.ndarray) -> np.ndarray:
    """Return a mask (n,) of candidates whose answer's likeliest form, by log-probabilities ``z``, is ambiguous."""
    best: dict[tuple[frozenset[str], bool], int] = {}
    for i, candidate in enumerate(candidates):
        if candidate.answer not in best or z[i] > z[best[candidate.answer]]:
            best[candidate.answer] = i
    return np.array([candidates[best[x.answer]].ambiguous for x in candidates], dtype=float)


def share_of_other(costs: tuple[float, float], left: float, c: DiagnosisCalibrationSettings) -> float:
    """Probability of the other hold, of the costs (`cost_of_answer`) of the answers for one and the other.

    ``left`` is what the set that leaves least under either leaves beyond noise.
    """
    better = min(costs)
    own, other = (log_likelihood(cost - better, left, c) for cost in costs)
    return float(1 / (1 + np.exp(np.clip(own - other, -50, 50))))


def averaged(
    decision: Decision,
    other: Decision,
    share: float,
    ambiguity_probability: float,
    named: Sequence[str] = (),
) -> Decision:
    """Return a decision with a ``share`` of the probabilities under the other initial state (`share_of_other`).

    Verdict and ``named`` set stay those of the likelier initial state. Effects outside that set whose probability
    exceeds ``ambiguity_probability`` join its group.
    """
    mixed = {
        name: (1 - share) * value + share * other.probabilities[name]
        for name, value in decision.probabilities.items()
    }
    known = {*decision.group, *named}
    also = [n for n in EFFECT_NAMES if n not in known and mixed[n] > ambiguity_probability]
    group = (*decision.group, *sorted(also, key=lambda n: -mixed[n]))
    return replace(decision, probabilities=mixed, sets=decision.sets * (1 - share), group=group)


def cost_of_answer(
    plain: Candidate,
    candidates: Sequence[Candidate],
    samples: tuple[int, ...],
    calibration: DiagnosisCalibrationSettings,
) -> float:
    """Deviance of what the answer names, and the price of a further effect for each of its effects.

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
        answer = min((plain, *candidates), key=lambda x: x.deviance)
    return answer.deviance + further_price(calibration) * _laws(answer)


def _shares(plain: Candidate, candidates: Sequence[Candidate], p: np.ndarray) -> dict[str, float]:
    """Probability of each effect from that of the sets, ``p`` (candidates,): a set's is shared by what they earn."""
    shares: dict[str, float] = {}
    for candidate, of_set in zip(candidates, p, strict=True):
        if not candidate.unlisted:
            earned = _earned(candidate, plain, candidates)
            for name, part in zip(candidate.names, earned, strict=True):
                shares[name] = shares.get(name, 0.0) + float(of_set * part)
    return shares


def _likeliest_effect(candidates: Sequence[Candidate], sets: np.ndarray, unlisted: np.ndarray) -> str | None:
    """Effect whose sets are the likeliest together; None without a set."""
    held: dict[str, float] = {}
    for candidate, of_set, makes_do in zip(candidates, sets, unlisted, strict=True):
        if not makes_do:
            for name in set(candidate.names):
                held[name] = held.get(name, 0.0) + float(of_set)
    return max(held, key=lambda name: held[name], default=None)


def _earned(candidate: Candidate, plain: Candidate, candidates: Sequence[Candidate]) -> np.ndarray:
    """Shares (names,) of a set's probability, by what the set loses when it has to do without each effect.

    What would be left then is read off the best fit that has only the others, at their places; effects that earn alike
    share alike.
    """
    if len(candidate.names) == 1:
        return np.ones(1)

    lost = []
    for own in candidate.placed:
        others = candidate.everywhere - own
        without = min(sum(x.chi2) for x in (plain, *candidates) if x.everywhere <= others)
        lost.append(max(without - sum(candidate.chi2), 1.0))
    return np.array(lost) / sum(lost)


def _group(
    names: Sequence[str], verdict: str, probabilities: Mapping[str, float], least: float
) -> tuple[str, ...]:
    """Return the verdict, then effects outside the named set above the ``least`` probability, likeliest first."""
    rest = [n for n in EFFECT_NAMES if n not in names and probabilities[n] > least]
    return (verdict, *sorted(rest, key=lambda n: -probabilities[n]))


def next_trial(decision: Decision, certain: float, likely: float) -> str | None:
    """Return the trial that would separate the likeliest effects, in one phrase.

    None where a cause or a set of effects has the probability ``certain`` or more: nothing is left to separate. There
    always is one where the cause is unknown; where no effect is as ``likely``, one that tells what a law depends on.
    """
    top = sorted(decision.probabilities.items(), key=lambda item: -item[1])
    # the probability of a set of effects is shared out between them
    if decision.verdict != UNKNOWN and max([top[0][1], *decision.sets]) >= certain:
        return None
    if decision.verdict == UNKNOWN and max(decision.probabilities[e.name] for e in EFFECTS) < likely:
        return _NO_LEAD
    for name, _ in top:
        for effect in EFFECTS:
            if effect.name == name:
                return effect.separating_trial
    return None
