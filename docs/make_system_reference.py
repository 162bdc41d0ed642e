"""Write the table of keys of a system.yaml into docs/library.md from the schema.

python docs/make_system_reference.py [--check]
"""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import yaml

ROOT = Path(__file__).parents[1]
PAGE = ROOT / "docs" / "library.md"
SCHEMA = ROOT / "workflow" / "real2sim" / "schemas" / "system.schema.yaml"
START, END = "<!-- keys: made by docs/make_system_reference.py -->\n", "<!-- end of keys -->\n"


def rows(schema: dict[str, Any], place: str = "") -> Iterator[str]:
    """Table rows of a schema's keys, depth first; ``<name>`` stands for a name that the author chooses."""
    required = schema.get("required", ())
    named = dict(schema.get("properties", {}))
    if isinstance(schema.get("additionalProperties"), dict) and not named:
        named = {"<name>": schema["additionalProperties"]}
    for key, sub in named.items():
        name = f"{place}{key}"
        default = json.dumps(sub["default"]) if "default" in sub else ""
        default = "required" if key in required else default.replace("{}", "none").replace('""', "empty")
        yield f"| `{name}` | {sub['description']} | {default} |\n"
        if sub.get("type") == "object":
            yield from rows(sub, f"{name}.")


def reference() -> str:
    """Return the table of keys."""
    schema = yaml.safe_load(SCHEMA.read_text(encoding="utf-8"))
    return "| key | what it says | default |\n|---|---|---|\n" + "".join(rows(schema))


def main() -> int:
    """Write the page, or with --check say whether it is current."""
    text = PAGE.read_text(encoding="utf-8")
    before, rest = text.split(START)
    after = rest.split(END)[1]
    made = f"{before}{START}{reference()}{END}{after}"
    if "--check" in sys.argv:
        return 0 if made == text else 1
    PAGE.write_text(made, encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
