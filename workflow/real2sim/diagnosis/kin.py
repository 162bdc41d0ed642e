"""Is a measured law a named effect with another equation?"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from real2sim.diagnosis.free_form import AnyFamily, Law, Library
from real2sim.diagnosis.law import least_family, named_family
from real2sim.diagnosis.refit import Hypothesis
from real2sim.diagnosis.search import Pair
from real2sim.effects.catalogue import EFFECTS, Effect, are_confusable


def is_kin_of(law: Law, named: Hypothesis, library: Library, pair: Pair, main_share: float) -> bool:
    """Return whether a law is a named effect with another equation, by the kind that it has in the main.

    A damping that depends on the place too, most of which the rate alone tells, is of the kind of dry friction;
    ``main_share`` is `diagnosis.free_form.main_share`.
    """
    family, x = law.families[0], law.first_coefficients
    return is_kin(law, named, least_family(family, x, library, pair, main_share))


def is_kin(law: Law, named: Hypothesis, told: Mapping[str, Any] | None = None) -> bool:
    """Return whether the first family of a law has the kind, stage and an axis of one of the named effects.

    Or of an effect of another stage that it cannot be told from: what comes in by the measurement looks like a force.
    ``told`` is what is said of that family in its place (`law.least_family`).
    """
    family = law.families[0]
    about = told or named_family(family)
    kinds, axes = {family.kind, about["kind"]}, set(about["axes"])
    return any(
        _holds(kinds, family, e) and (not p.axes or not axes or bool(set(p.axes) & axes))
        for p in named.effects
        for e in (p.effect, *_alike_elsewhere(p.effect))
    )


def _holds(kinds: set[str], family: AnyFamily, effect: Effect) -> bool:
    """Return whether an effect is a special case of a family, which is of these ``kinds``."""
    return family.name in effect.kinds or (family.stage == effect.stage and bool(kinds & set(effect.kinds)))


def _alike_elsewhere(effect: Effect) -> list[Effect]:
    """Effects of another stage that take the place of an effect in a fit."""
    return [e for e in EFFECTS if e.stage != effect.stage and are_confusable(e.name, effect.name)]
