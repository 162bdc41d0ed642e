"""Write docs/effects.md, all effects of the catalogue with a section each.

python docs/make_effects_reference.py [--check]
"""

from __future__ import annotations

import sys
import textwrap
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path

ROOT = Path(__file__).parents[1]
sys.path.insert(0, str(ROOT / "workflow"))

from real2sim.effects.base import Effect, EffectParameter
from real2sim.effects.catalogue import EFFECT_NAMES, EFFECTS, are_confusable

PAGE = ROOT / "docs" / "effects.md"
IMAGES = ROOT / "docs" / "images" / "effects"
WIDTH = 120
TITLE = (
    "# Effects\n\n"
    "<!-- Made by docs/make_effects_reference.py from workflow/real2sim/effects: edit the entries there. -->\n\n"
    "The causes of a gap between simulation and measurement that the diagnosis compares. An *effect* is a cause with\n"
    "a name. Its *forms* are variants of it, each with an equation of its own, such as a strap that takes up load at\n"
    "once or little by little. The diagnosis tries every form at every *place* (axis, side, pair of axes, joint or\n"
    "the whole plant) and answers with the name. An effect that is missing here can be\n"
    "[added by a package of your own](how-to/effect.md).\n\n"
    "In the sections, `q` is a coordinate of the interface, `k` and `d` are its stiffness and damping, `y` the paths\n"
    "that the interface's markers show. A unit after a bar is that of a rotation. *Confused with* lists effects that\n"
    "can take its place in a fit; the *separating trial* is the recording that tells them apart. Each picture shows\n"
    "the channel that the effect changes most in a made-up motion (no person, no study): grey without the effect,\n"
    "blue with it, at a size that shows, and below the difference. Names of published laws (LuGre, Bouc-Wen,\n"
    "Stribeck, Eyring) and of angles (Cardan) are explained in the [glossary](glossary.md).\n\n"
)
STAGES = {
    "input": "input: what the markers of the pelvis (the driven segment) show",
    "interface": "interface: the strap between person and robot",
    "robot": "robot: base, arm and controller",
    "output": "output: what the markers of the interface and the robot's log show",
}
MEANING = {
    "slack": "The strap hangs loose before it pulls: a dead zone about its rest pose.",
    "one_sided": "A part of the strap pulls to one side alone, as a webbing does that can be pulled but not pushed.",
    "stiffening": "The strap becomes stiffer the further it is stretched.",
    "asymmetric_stiffness": "The strap is stiffer to one side than to the other.",
    "coulomb": "Dry friction: a constant force against the motion, whatever its speed.",
    "lugre": "Dry friction that first yields like a stiff spring (pre-sliding) and is larger at rest than in motion.",
    "hysteresis": "The force depends on the path: loading and unloading follow different curves, at any speed.",
    "relaxation": "After a quick stretch the force sinks within seconds to a lower level.",
    "creep": "The same within many seconds to minutes: under load the strap goes on giving way.",
    "migration": "The strap slips on the body beyond a threshold and stays where it slipped to.",
    "cross_coupling": "Motion along one axis makes a force along another.",
    "misalignment": "The axes of the strap are turned against those of the model.",
    "preload": "The strap rests elsewhere than in the neutral trial, so that it pulls from the start.",
    "joint_limit": "A stop: beyond some excursion something hard is in the way.",
    "quadratic_damping": "Damping that grows with the square of the speed.",
    "added_mass": "The interface body is heavier than in the robot's model.",
    "base_compliance": "The robot's base gives way more, or less, than its model says.",
    "controller_reaction": "The robot's controller answers the force of the strap.",
    "tilt": "The floor is not level: gravity pulls the robot to one side.",
    "soft_tissue": "Skin and fat move over the bone, so that the pelvis markers show another motion than the pelvis.",
    "lab_yaw": "Two measuring systems disagree about the directions (or the scale) of the lab.",
    "replay_lag": "The pelvis was recorded late against everything else.",
    "sync_offset": "The interface's markers were recorded late or early against the pelvis.",
    "log_latency": "The robot's log alone is late.",
    "clock_drift": "The clock of the interface's recording runs faster or slower.",
    "filter_lag": "The recording was low-pass filtered by a causal filter, which delays and smooths it.",
    "marker_offset": "A marker of the interface sits beside the joint centre that the model takes it for.",
    "marker_drift": "A marker comes loose and wanders off slowly.",
    "outliers": "Single samples of a marker are wrong: another marker, or a reflection, was taken for it.",
}


def _parameters(parameters: Iterable[EffectParameter]) -> str:
    found = [f"{p.name} [{p.unit}]" for p in parameters]
    return ", ".join(found) or "none"


def _cell(text: str) -> str:
    return text.replace("|", "\\|").strip()


def _form(effect: Effect) -> str:
    return effect.form.strip("_").replace("_", " ") or "(first)"


def _confusable(name: str) -> str:
    others = [n for n in EFFECT_NAMES if n != name and are_confusable(name, n)]
    return ", ".join(f"[`{n}`](#{n})" for n in others) or "none"


def _scope(effect: Effect) -> str:
    each = "the whole" if effect.scope == "whole" else f"each {effect.scope}"
    needs = f", needs of a system: {', '.join(sorted(effect.needs))}" if effect.needs else ""
    return f"{each}{needs}"


def _acts_on(forms: list[Effect]) -> str:
    if len({e.stage for e in forms}) == 1:
        return f"{STAGES[forms[0].stage]}; {_of_forms(forms, _scope)}"
    return _of_forms(forms, lambda e: f"{STAGES[e.stage]}; {_scope(e)}")


def _of_forms(forms: Iterable[Effect], text: Callable[[Effect], str]) -> str:
    """Return what a text says of forms: once where it is the same for all, else beside their names."""
    by_text: dict[str, list[str]] = {}
    for effect in forms:
        by_text.setdefault(text(effect), []).append(_form(effect))
    if len(by_text) == 1:
        return next(iter(by_text))
    return "; ".join(f"*{', '.join(names)}*: {said}" for said, names in by_text.items())


def _distinct(texts: Iterable[str]) -> str:
    return "; ".join(dict.fromkeys(t for t in texts if t))


def _item(text: str) -> str:
    """An item of a list, wrapped as the other pages are."""
    lines = textwrap.wrap(
        text,
        WIDTH,
        initial_indent="- ",
        subsequent_indent="  ",
        break_long_words=False,
        break_on_hyphens=False,
    )
    return "\n".join(lines) + "\n"


def section(name: str, forms: list[Effect]) -> Iterator[str]:
    """Yield the lines of an effect's section."""
    yield f"## {name}\n\n{MEANING.get(name, '')}\n\n"
    if (IMAGES / f"{name}.png").exists():
        yield f"![{name}: with and without the effect](images/effects/{name}.png)\n\n"
    yield "| form | equation | parameters |\n|---|---|---|\n"
    for effect in forms:
        yield f"| {_form(effect)} | {_cell(effect.equation)} | {_cell(_parameters(effect.parameters))} |\n"
    yield "\n" + _item(f"Acts on: {_acts_on(forms)}.")
    yield _item(f"Confused with: {_confusable(name)}.")
    yield _item(f"Separating trial: {_distinct(e.separating_trial for e in forms)}.")
    yield _item(f"In an exported model: {_distinct(e.exported for e in forms)}.")
    # the first remedy of each stage: those of further forms differ in their numbers
    remedies = [e for e in {e.stage: e for e in reversed(forms)}.values() if e.remedy][::-1]
    remedy = _of_forms(remedies, lambda e: e.remedy) if remedies else ""
    yield _item(f"What to do: {remedy}.") + "\n" if remedy else "\n"


def reference(effects: Iterable[Effect] = EFFECTS) -> str:
    """Return the page."""
    by_name: dict[str, list[Effect]] = {}
    for effect in effects:
        by_name.setdefault(effect.name, []).append(effect)
    overview = "| effect | stage | in plain words |\n|---|---|---|\n"
    for name, forms in by_name.items():
        stages = _distinct(e.stage for e in forms)
        overview += f"| [`{name}`](#{name}) | {stages} | {MEANING.get(name, '')} |\n"
    sections = (line for name, forms in by_name.items() for line in section(name, forms))
    return TITLE + overview + "\n" + "".join(sections).rstrip() + "\n"


def main() -> int:
    """Write the page, or with --check say whether it is current."""
    made = reference()
    if "--check" in sys.argv:
        return 0 if PAGE.exists() and PAGE.read_text(encoding="utf-8") == made else 1
    PAGE.write_text(made, encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
