"""Does the named cause fit? What it leaves beyond noise, and whether a law without a name fits better.

The probability of a name says that it is likelier than the other names. It may be the likeliest and yet leave many
standard deviations: its form is wrong, or it only imitates the cause. Where a named set leaves more than noise, laws of
which only place and variables are said (`free_form`) are measured without it. One that acts elsewhere, or depends on
something else, competes with the names, and its probability counts for `unknown`. One of the kind and place of a named
effect says that the name is right and its equation is not; then a family is fitted on top and tells what is left.

Several names on one axis may be what the catalogue makes of one law that it does not hold: dry friction with a
quadratic damping and a spring of one side is a damping that depends on the place. So laws are measured beside such a
set also where that leaves nothing but noise, and one that could be in the place of several of its effects competes with
it. Each name beyond the first has its price, and evidence tells which it is.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from real2sim.diagnosis.attribute import Attribution
from real2sim.diagnosis.decide import Candidate, Decision, decide, further_price
from real2sim.diagnosis.free_form import Law, Measured, measure
from real2sim.diagnosis.kin import gives_way, is_kin_of, on_one_axis, stands_for
from real2sim.diagnosis.law import named_family, size
from real2sim.diagnosis.layers import Layers
from real2sim.diagnosis.refit import Hypothesis
from real2sim.diagnosis.search import Search
from real2sim.diagnosis.trials import Found, candidates_of

if TYPE_CHECKING:
    from real2sim.settings import DiagnosisSearchSettings, DiagnosisSettings


@dataclass(frozen=True)
class CompetingLaw:
    """A measured law that competes with the names: its deviance is counted higher by the ``handicap``."""

    law: Law
    handicap: float
    probability: float


@dataclass(frozen=True)
class Misfit:
    """Chi-squared that a named set, ``key``, leaves, and the laws that could explain it.

    ``sd``: chi-squared of the fitted and the held-out trial beyond its expectation, in SD of what noise leaves;
    ``sensor``: where most of it is, both trials together; ``share``: of what the plain plant leaves beyond noise, on
    both trials. ``measured`` are the laws without a name, None where none was asked for (`misfit_of`); ``law``
    is the family that explains most beside the set; ``rival`` is the measured law that competes with the names, if one
    does.
    """

    key: str
    sd: tuple[float, float]
    sensor: str
    share: float
    marked: bool
    measured: Measured | None = None
    law: Law | None = None
    rival: CompetingLaw | None = None

    def to_dict(self, found: Found) -> dict[str, Any]:
        """Return the entry ``misfit`` of diagnosis.json."""
        about = None
        if self.law is not None and self.measured is not None:
            about = named_family(self.law.families[0])
            about |= {
                "own_history_in_each_trial": self.law.is_history,
                "size": size(found.pair, self.law, self.measured.library),
                "chi2": list(self.law.hypothesis.chi2),
            }
        return {
            "marked": self.marked,
            "left_sd": list(self.sd),
            "sensor": self.sensor,
            "left_share": self.share,
            "law": about,
        }


def misfit_of(
    found: Found, named: Hypothesis, options: DiagnosisSettings, progress: Callable[[str], None]
) -> Misfit:
    """Return what a named set leaves, with measured laws where that is more than noise or names share an axis.

    ``options`` is the slice ``diagnosis`` of the configuration.
    """
    search, plain = Search(found.pair, options["search"]), found.attribution.plain
    left = _left(search, named, plain)
    sd, noise = left.sd, search.is_noise(named)
    if noise and not on_one_axis(named):
        return left
    asked = "would one law do as well?" if noise else "is its form right?"
    progress(f"{named.key} leaves {sd[0]:.0f} and {sd[1]:.0f} SD of noise: {asked}")
    free, searched = options["free_form"], options["search"]
    reach = _reach(search.beyond(named), left.share, sum(search.samples), searched)
    measured = measure(found.pair, plain, named.base, search, free, searched, progress, reach)
    return replace(left, marked=not noise, measured=measured)


def _reach(left: float, share: float, samples: int, settings: DiagnosisSearchSettings) -> float:
    """Chi-squared of both trials beyond which a law is no rival of a named set that leaves a ``share`` of the gap.

    As of an effect beside another that explains nearly everything. ``left`` is that share in chi-squared, ``samples``
    are the residuals of both trials.
    """
    if share >= settings["nearly_all"]:
        return float("inf")
    return samples + settings["far_behind"] * left + settings["out_of_reach"]


def told_apart(
    misfit: Misfit, found: Found, decision: Decision, options: DiagnosisSettings
) -> tuple[Decision, Misfit]:
    """Return the decision with a measured law among the candidates, and the misfit with that law.

    A law of the kind and place of a named effect does not compete: it is that effect with another equation. It does
    where it could be in the place of several effects (`_replaces`). A free history on an effect's axis that gains
    hardly more does not compete either. The best of the others does, and what a law of the name's kind explains too
    says nothing against the name.
    """
    if decision.chosen is None or misfit.measured is None:
        return decision, misfit
    plain, sets = candidates_of(found, options)
    named = sets[decision.chosen]
    rival, own_kind = _best_rival(misfit.measured, found, decision, plain, sets, options)
    if rival is None:
        return decision, misfit
    law, told = rival
    handicap = named.deviance - min(own_kind, named.deviance)
    handicapped = replace(told, occam=told.occam + handicap)
    with_rival = decide(plain, [*sets, handicapped], found.samples, options["calibration"])
    misfit = replace(misfit, rival=CompetingLaw(law, handicap, float(with_rival.sets[-1])))
    return replace(with_rival, sets=with_rival.sets[:-1]), misfit


def _best_rival(
    measured: Measured,
    found: Found,
    decision: Decision,
    plain: Candidate,
    sets: Sequence[Candidate],
    options: DiagnosisSettings,
) -> tuple[tuple[Law, Candidate] | None, float]:
    """Return the best law that speaks against the named set, and the least deviance of a law of the set's own kind.

    ``plain`` and ``sets`` are as of `candidates_of`. A law that gives way to the name is neither.
    """
    named, main_share = chosen(found.attribution, decision), options["free_form"]["main_share"]
    assert decision.chosen is not None, "a set is named"
    by_name = plain.deviance - sets[decision.chosen].deviance
    rivals, own_kind = [], float("inf")
    for law in measured.laws:
        told = found.candidate(law.hypothesis, options, [f.key for f in law.families])
        gains = by_name, plain.deviance - told.deviance
        kin = is_kin_of(law, named, measured.library, found.pair, main_share)
        if kin and not _replaces(told, sets, stands_for(law, named), options):
            own_kind = min(own_kind, told.deviance)
        elif not gives_way(law, named, gains, options["search"]["grow_share"]):
            rivals.append((law, told))
    return min(rivals, key=lambda pair: pair[1].deviance, default=None), own_kind


def _replaces(
    law: Candidate, sets: Sequence[Candidate], several: frozenset[str], options: DiagnosisSettings
) -> bool:
    """Return whether a law could be in the place of ``several`` names, as `kin.stands_for`.

    It has to explain more than each of them alone does, by the price of a further effect. One that does not is that
    effect with another equation.
    """
    alone = [x.deviance for x in sets if set(x.names) <= several and len(x.names) == 1]
    price = further_price(options["calibration"])
    return bool(several) and law.deviance + price < min(alone, default=float("inf"))


def with_law(
    misfit: Misfit | None, layers: Layers, found: Found, decision: Decision, options: DiagnosisSettings
) -> Misfit:
    """Return the misfit of the named set with the law that tells what is left beside it.

    ``misfit`` is that of the set that was named before, if any: one may be named for what it explains beside a law.
    """
    named, index = chosen(found.attribution, decision), decision.chosen
    if misfit is None or misfit.key != named.key:
        search, plain = Search(found.pair, options["search"]), found.attribution.plain
        noise = search.is_noise(named)
        misfit = replace(_left(search, named, plain), marked=not noise, measured=layers.measured)
    if not misfit.marked:
        return misfit
    if index in layers.beside:
        return replace(misfit, law=layers.beside[index])
    share = options["search"]["grow_share"]
    return replace(misfit, law=layers.measured.on_top(named, options["free_form"], share))


def _left(search: Search, named: Hypothesis, plain: Hypothesis) -> Misfit:
    """Return the misfit of a named set, not marked yet."""
    share = search.beyond(named) / max(search.beyond(plain), float(np.sqrt(2 * sum(search.samples))))
    return Misfit(
        named.key, search.excess_of_trials(named), search.loudest_sensor(named), share, marked=False
    )


def chosen(attribution: Attribution, decision: Decision) -> Hypothesis:
    """Return the fit that a decision rests on: the plain one where nothing is named."""
    return attribution.plain if decision.chosen is None else attribution.hypotheses[decision.chosen]
