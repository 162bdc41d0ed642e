"""Does a listed effect act beside something that is not listed?

Real machines have several layers: friction that a name fits, and below it a force that depends on the place, on the
temperature, on nothing that a catalogue holds. That the best set leaves much says only that something is not listed.
Whether its effects act too is asked here: a measured law is fitted on top of the set, and both together are compared
with measured laws alone, by their evidence on all trials.

A law on top that has the kind and place of a named effect may be no second layer, but that effect with another
equation. A wrong name that is mended explains as much as the right one, so such a name stands for laws without a name
as often as for itself.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from real2sim.diagnosis.decide import UNKNOWN, Candidate, Decision, with_layers
from real2sim.diagnosis.free_form import Law, Measured
from real2sim.diagnosis.kin import is_kin_of, mended_by, said_of
from real2sim.diagnosis.refit import Hypothesis
from real2sim.diagnosis.search import Search
from real2sim.diagnosis.trials import Found, candidates_of

if TYPE_CHECKING:
    from real2sim.settings import DiagnosisSettings


@dataclass(frozen=True)
class Layers:
    """Measured laws of a gap: ``measured`` alone, and ``beside`` a listed set, by its index among the hypotheses."""

    measured: Measured
    beside: dict[int, Law] = field(default_factory=dict)


def layered(
    found: Found,
    decision: Decision,
    measured: Measured,
    options: DiagnosisSettings,
    progress: Callable[[str], None],
) -> tuple[Decision, Layers]:
    """Return the decision once listed sets with a measured law on top compete with measured laws alone.

    ``options`` is the slice ``diagnosis`` of the configuration. Nothing is asked where `unknown` is out of the question
    or no law was measured.
    """
    if decision.probabilities[UNKNOWN] < options["search"]["questionable_probability"] or not measured.laws:
        return decision, Layers(measured)
    plain, sets = candidates_of(found, options)
    share, main_share = options["search"]["grow_share"], options["free_form"]["main_share"]
    # where a set is named, a law of its kind does not speak against it
    named = None if decision.chosen is None else found.attribution.hypotheses[decision.chosen]
    alone = [
        found.candidate(law.hypothesis, options, [f.key for f in law.families])
        for law in measured.laws
        if named is None or not is_kin_of(law, named, measured.library, found.pair, main_share)
    ]
    beside: dict[int, Law] = {}
    on_top: dict[int, Candidate] = {}
    mended: dict[int, frozenset[str]] = {}
    for index in _worth_a_layer(found, decision, options):
        own = found.attribution.hypotheses[index]
        if _only_mends(sets[index], own, found, measured, options):
            continue
        # the best law alone is also tried beside the set: what the set adds to it is asked of nothing else
        tried = [
            law
            for law in (
                measured.on_top(own, options["free_form"], share),
                measured.beside(own, measured.laws[0]),
            )
            if law is not None
        ]
        found.fit_rivals_to_both([own, *(law.hypothesis for law in tried)], options)
        told = [found.candidate(law.hypothesis, options, sets[index].names) for law in tried]
        if tried:
            best = min(range(len(tried)), key=lambda i: told[i].deviance)
            beside[index], on_top[index] = tried[best], told[best]
            told_of_law = said_of(tried[best], measured.library, found.pair, main_share)
            mended[index] = mended_by(tried[best], own, told_of_law)
            kind = tried[best].families[0].kind
            progress(f"{own.key} with a {kind} law on top: deviance {told[best].deviance:.0f}")
    c = options["calibration"]
    decision = with_layers(decision, sets, plain, on_top, alone, found.samples, c, mended)
    return decision, Layers(measured, beside)


def _only_mends(
    candidate: Candidate, own: Hypothesis, found: Found, measured: Measured, options: DiagnosisSettings
) -> bool:
    """Return whether one measured law of another kind does better than a set, which then only mends that law.

    The first layer is what explains most by itself. A law of the set's own kind is that set with another equation.
    """
    main_share = options["free_form"]["main_share"]
    return any(
        found.candidate(law.hypothesis, options, [law.families[0].key]).deviance < candidate.deviance
        for law in measured.laws
        if len(law.families) == 1 and not is_kin_of(law, own, measured.library, found.pair, main_share)
    )


def _worth_a_layer(found: Found, decision: Decision, options: DiagnosisSettings) -> list[int]:
    """Indices of the sets that a law is fitted on top of: the named one, else the likeliest of all and of one effect.

    Only sets that explain a share of the gap themselves (``search.grow_share``).
    """
    attribution, search = found.attribution, Search(found.pair, options["search"])
    if decision.chosen is not None:
        return [decision.chosen]
    gap = search.beyond(attribution.plain)
    share = options["search"]["grow_share"]
    order = sorted(
        (i for i, h in enumerate(attribution.hypotheses) if search.beyond(h) < (1 - share) * gap),
        key=lambda i: attribution.hypotheses[i].deviance,
    )
    single = [i for i in order if len(attribution.hypotheses[i].effects) == 1]
    return list(dict.fromkeys([*order[:1], *single[:1]]))
