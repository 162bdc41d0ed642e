"""Write docs/effects.md, the table of all effects, from the catalogue.

python docs/make_effects_reference.py [--check]
"""

from __future__ import annotations

import sys
from collections.abc import Iterable
from pathlib import Path

ROOT = Path(__file__).parents[1]
sys.path.insert(0, str(ROOT / "workflow"))

from real2sim.effects.base import Effect, EffectParameter
from real2sim.effects.catalogue import EFFECT_NAMES, EFFECTS, are_confusable

PAGE = ROOT / "docs" / "effects.md"
TITLE = (
    "# Effects\n\n"
    "<!-- Made by docs/make_effects_reference.py from workflow/real2sim/effects: edit the entries there. -->\n\n"
    "The causes of a gap between simulation and measurement that the diagnosis compares. Effects of one name are one"
    " answer; their forms differ in the equation. [How to add your own](how-to/effect.md).\n\n"
    "- *needs*: what a system must offer for the effect to make sense there; nothing for most laws of one axis.\n"
    "- *equation*: `q` is a coordinate of the interface, `k` and `d` are its stiffness and damping, `y` the paths that"
    " the interface's markers show.\n"
    "- *parameters*: with the unit of a translation, and after a bar that of a rotation.\n"
    "- *confusable*: effects that can take its place in a fit. The *separating trial* tells them apart.\n"
    "- *exported*: what an exported model holds of the effect.\n\n"
)
COLUMNS = (
    "effect",
    "form",
    "acts on",
    "needs",
    "equation",
    "parameters",
    "confusable",
    "separating trial",
    "exported",
)


def _parameters(parameters: Iterable[EffectParameter]) -> str:
    return ", ".join(f"{p.name} [{p.unit}]" for p in parameters) or "none"


def _confusable(effect: Effect) -> str:
    return ", ".join(n for n in EFFECT_NAMES if n != effect.name and are_confusable(effect.name, n)) or "none"


def row(effect: Effect) -> str:
    """Return the table row of one entry."""
    cells = (
        f"`{effect.name}`",
        effect.form.strip("_").replace("_", " "),
        f"{effect.stage}, {'each ' if effect.scope != 'whole' else ''}{effect.scope}",
        ", ".join(sorted(effect.needs)),
        effect.equation,
        _parameters(effect.parameters),
        _confusable(effect),
        effect.separating_trial,
        effect.exported,
    )
    return "| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |\n"


def reference(effects: Iterable[Effect] = EFFECTS) -> str:
    """Return the page."""
    head = "| " + " | ".join(COLUMNS) + " |\n" + "|---" * len(COLUMNS) + "|\n"
    return TITLE + head + "".join(row(effect) for effect in effects)


def main() -> int:
    """Write the page, or with --check say whether it is current."""
    made = reference()
    if "--check" in sys.argv:
        return 0 if PAGE.exists() and PAGE.read_text(encoding="utf-8") == made else 1
    PAGE.write_text(made, encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
