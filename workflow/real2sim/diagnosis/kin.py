"""Is a measured law a named effect with another equation?"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from real2sim.diagnosis.free_form import AnyFamily, Law, Library
from real2sim.diagnosis.law import least_family, named_family
from real2sim.diagnosis.refit import Hypothesis
from real2sim.diagnosis.search import Pair
from real2sim.effects.catalogue import EFFECTS, Effect, Placed, are_confusable


def said_of(law: Law, library: Library, pair: Pair, main_share: float) -> Mapping[str, Any]:
    """Return what is said of the first family of a law, by the kind that it has in the main.

    A damping that depends on the place too, most of which the rate alone tells, is of the kind of dry friction;
    ``main_share`` is `diagnosis.free_form.main_share`.
    """
    return least_family(law.families[0], law.first_coefficients, library, pair, main_share)


def is_kin_of(law: Law, named: Hypothesis, library: Library, pair: Pair, main_share: float) -> bool:
    """Return whether a law is a named effect with another equation (`is_kin`, `said_of`)."""
    return is_kin(law, named, said_of(law, library, pair, main_share))


def on_one_axis(named: Hypothesis) -> frozenset[str]:
    """Return the names of a set's effects that share an axis with an effect of another name."""
    return frozenset(
        one.effect.name
        for one in named.effects
        for other in named.effects
        if one.effect.name != other.effect.name and set(one.axes) & set(other.axes)
    )


def stands_for(law: Law, named: Hypothesis) -> frozenset[str]:
    """Return the names of a set's effects in whose place a law could be: they share an axis with it and each other.

    None where that is one name: a law of one effect's kind and place is that effect with another equation.
    """
    several = on_one_axis(named)
    if not several:
        return several
    axes = set(named_family(law.families[0])["axes"])
    held = frozenset(p.effect.name for p in named.effects if p.effect.name in several and axes & set(p.axes))
    return held if len(held) > 1 else frozenset()


def mended_by(law: Law, named: Hypothesis, told: Mapping[str, Any] | None = None) -> frozenset[str]:
    """Return the names of a set's effects that a law on top of the set may only give another equation.

    Those that it is kin of, and those on an axis of a free history, which can stand for every law of that axis.
    ``told`` as of `is_kin`.
    """
    about = told or named_family(law.families[0])
    return frozenset(
        p.effect.name
        for p in named.effects
        if _is_kin(law, p, about) or (law.is_free and _share_an_axis(p, about))
    )


def gives_way(law: Law, named: Hypothesis, gains: tuple[float, float], share: float) -> bool:
    """Return whether a free history says nothing against a named set on its axis, which gains nearly as much.

    Such a history can imitate every law of its axis and predicts nothing; a name predicts, as a measured law does that
    goes before a history (`free_form.measure`). ``gains`` are what set and law take from the deviance of the plain
    plant, ``share`` is `diagnosis.search.grow_share`.
    """
    by_name, by_law = gains
    return law.is_free and bool(mended_by(law, named)) and by_name > (1 - share) * by_law


def is_kin(law: Law, named: Hypothesis, told: Mapping[str, Any] | None = None) -> bool:
    """Return whether the first family of a law has the kind, stage and an axis of one of the named effects.

    Or of an effect of another stage that it cannot be told from: what comes in by the measurement looks like a force.
    ``told`` is what is said of that family in its place (`law.least_family`).
    """
    about = told or named_family(law.families[0])
    return any(_is_kin(law, placed, about) for placed in named.effects)


def _is_kin(law: Law, placed: Placed, told: Mapping[str, Any]) -> bool:
    family = law.families[0]
    kinds = {family.kind, told["kind"]}
    effects = (placed.effect, *_alike_elsewhere(placed.effect))
    return _share_an_axis(placed, told) and any(_holds(kinds, family, e) for e in effects)


def _share_an_axis(placed: Placed, told: Mapping[str, Any]) -> bool:
    axes = set(told["axes"])
    return not placed.axes or not axes or bool(set(placed.axes) & axes)


def _holds(kinds: set[str], family: AnyFamily, effect: Effect) -> bool:
    """Return whether an effect is a special case of a family, which is of these ``kinds``."""
    return family.name in effect.kinds or (family.stage == effect.stage and bool(kinds & set(effect.kinds)))


def _alike_elsewhere(effect: Effect) -> list[Effect]:
    """Effects of another stage that take the place of an effect in a fit."""
    return [e for e in EFFECTS if e.stage != effect.stage and are_confusable(e.name, effect.name)]
