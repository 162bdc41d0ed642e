"""All effects that the plain plant leaves out: those of the modules of this package, and of other packages.

An entry is an `Effect`. Other packages add theirs by the entry point group `real2sim.effects`, each an `Effect` or an
iterable of them; they come after the shipped ones.
"""

from __future__ import annotations

from collections.abc import Iterable
from importlib.metadata import EntryPoint, entry_points

from real2sim.effects import (
    controller,
    dampers,
    floor,
    frames,
    friction,
    lab,
    markers,
    mass,
    memory,
    migration,
    robot,
    springs,
    stops,
    timing,
    tissue,
)
from real2sim.effects.base import NEUTRAL, AtRest, Effect, EffectParameter, Mechanism, Placed
from real2sim.effects.chains import Chains
from real2sim.errors import InputError

__all__ = [
    "EFFECTS",
    "EFFECT_NAMES",
    "GROUPS",
    "SHIPPED",
    "Effect",
    "EffectParameter",
    "Placed",
    "are_confusable",
]

ENTRY_POINTS = "real2sim.effects"
# In this order: a search breaks ties by it
_MODULES = (
    springs,
    friction,
    memory,
    migration,
    frames,
    stops,
    dampers,
    mass,
    robot,
    controller,
    floor,
    tissue,
    lab,
    timing,
    markers,
)

STAGES = ("input", "interface", "robot", "output")
SCOPES = ("axis", "turn", "side", "pair", "joint", "whole")
OFFERS = frozenset(
    (
        "pose",
        "path",
        "force",
        "base",
        "arm",
        "controllers",
        "passive_joints",
        "interface_body",
        "six_axes",
        "markers",
        "bar",
        "pelvis_markers",
    )
)


def faults(effect: Effect, taken: Iterable[str], names: Iterable[str]) -> list[str]:
    """Return what is wrong with an entry, beside entries with the labels ``taken`` and effects called ``names``."""
    if kinds := _faults_of_kind(effect):
        return kinds
    found = []
    if effect.label in taken:
        found.append("name and form are taken by another entry")
    if effect.stage not in STAGES:
        found.append(f"stage {effect.stage!r} is none of {', '.join(STAGES)}")
    if effect.scope not in SCOPES:
        found.append(f"scope {effect.scope!r} is none of {', '.join(SCOPES)}")
    if not effect.equation or not effect.separating_trial:
        found.append("equation and separating_trial must not be empty")
    if unknown := effect.needs - OFFERS:
        found.append(f"needs {', '.join(sorted(unknown))}, which no system offers")
    if strangers := set(effect.confusable) - set(names):
        found.append(f"confusable with {', '.join(sorted(strangers))}, which the catalogue does not hold")
    if effect.plant is NEUTRAL and effect.chains.empty:
        found.append("neither plant nor chains: it does nothing")
    return found + _faults_of_parameters(effect)


def _faults_of_kind(effect: Effect) -> list[str]:
    """Return which fields of an entry are of another kind than the class says: the slips of a file that still loads."""
    wanted: dict[str, tuple[object, type | tuple[type, ...], str]] = {
        "parameters": (effect.parameters, tuple, "a tuple: one parameter takes a comma after it"),
        "needs": (effect.needs, (frozenset, set), "a set of texts"),
        "confusable": (effect.confusable, (tuple, list, frozenset, set), "a tuple of texts"),
        "at_rest": (effect.at_rest, AtRest, "an AtRest"),
        "plant": (effect.plant, Mechanism, "an instance of a subclass of Mechanism, made with brackets"),
        "chains": (effect.chains, Chains, "a Chains"),
    }
    found = [
        f"{name} is {value!r}, expected {what}"
        for name, (value, kind, what) in wanted.items()
        if not isinstance(value, kind)
    ]
    if not isinstance(effect.parameters, tuple):
        return found
    for parameter in effect.parameters:
        if not isinstance(parameter, EffectParameter):
            found.append(f"parameters holds {parameter!r}, expected an EffectParameter")
        elif not isinstance(parameter.starts, (tuple, list)):
            found.append(f"starts of {parameter.name} is {parameter.starts!r}, expected a tuple")
    return found


def _faults_of_parameters(effect: Effect) -> list[str]:
    found = []
    rest = effect.at_rest
    if len(rest.values) != len(effect.parameters):
        return [f"at_rest has {len(rest.values)} values for {len(effect.parameters)} parameters"]
    for parameter, value in zip(effect.parameters, rest.values, strict=True):
        name, lower, upper = parameter.name, parameter.lower, parameter.upper
        if not lower < upper or (parameter.log and lower <= 0):
            found.append(f"bounds [{lower}, {upper}] of {name} are no range")
        elif not all(lower <= start <= upper for start in parameter.starts) or not parameter.starts:
            found.append(f"starts of {name} are outside [{lower}, {upper}]")
        if not (lower <= value <= upper or rest.limit):
            found.append(f"at_rest of {name} is outside [{lower}, {upper}] and at_rest.limit is empty")
        if not parameter.unit:
            found.append(f"{name} has no unit")
    return found


def check(effects: Iterable[Effect], known: Iterable[Effect] = (), source: str = "real2sim") -> None:
    """Refuse entries that contradict themselves, each other or ``known`` ones.

    Raises
    ------
    InputError
        Naming the source, the entry and what is wrong with it.
    """
    effects, known = tuple(effects), tuple(known)
    names = {effect.name for effect in (*known, *effects)}
    taken = {effect.label for effect in known}
    for effect in effects:
        if found := faults(effect, taken, names):
            raise InputError(
                source,
                effect.label,
                "; ".join(found),
                "a valid effect (docs/how-to/effect.md)",
                "Correct the entry.",
            )
        taken.add(effect.label)


def collect(entries: Iterable[EntryPoint], known: Iterable[Effect]) -> tuple[Effect, ...]:
    """Return the effects of other packages' entry points, checked beside the ``known`` ones.

    Raises
    ------
    InputError
        Naming the package, the entry point or entry, and what is wrong with it.
    """
    found: list[Effect] = []
    for entry in sorted(entries, key=lambda e: (_package(e), e.name)):
        added = _effects_of(entry)
        check(added, (*known, *found), _package(entry))
        found += added
    return tuple(found)


def _package(entry: EntryPoint) -> str:
    return entry.dist.name if entry.dist is not None else entry.value


def _effects_of(entry: EntryPoint) -> tuple[Effect, ...]:
    place = f"entry point {entry.name} = {entry.value}"
    expected, remedy = "an Effect or an iterable of them", "Correct the package, or uninstall it."
    try:
        value = entry.load()
    except Exception as error:
        raise InputError(
            _package(entry), place, f"{type(error).__name__}: {error}", expected, remedy
        ) from error
    effects = (value,) if isinstance(value, Effect) else tuple(value) if isinstance(value, Iterable) else None
    if effects is None or not all(isinstance(effect, Effect) for effect in effects):
        raise InputError(_package(entry), place, f"{value!r}", expected, remedy)
    return effects


SHIPPED: tuple[Effect, ...] = tuple(effect for module in _MODULES for effect in module.EFFECTS)
check(SHIPPED)
EFFECTS: tuple[Effect, ...] = (*SHIPPED, *collect(entry_points(group=ENTRY_POINTS), SHIPPED))
EFFECT_NAMES = tuple(dict.fromkeys(effect.name for effect in EFFECTS))
# Names of effects that the suite's score counts as one answer, by label
GROUPS = {
    group: tuple(dict.fromkeys(effect.name for effect in EFFECTS if effect.group == group))
    for group in dict.fromkeys(effect.group for effect in EFFECTS)
}
_CONFUSABLE = {
    pair
    for effect in EFFECTS
    for name in effect.confusable
    for pair in ((effect.name, name), (name, effect.name))
}


def are_confusable(one: str, other: str) -> bool:
    """Return whether two effects, by name, take each other's place in a fit; of one name, whether its forms do."""
    return (one, other) in _CONFUSABLE
