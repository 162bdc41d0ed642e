"""Write the table of configuration keys into config/README.md from the schema.

python docs/make_config_reference.py [--check]
"""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator
from pathlib import Path

import yaml

ROOT = Path(__file__).parents[1]
PAGE = ROOT / "config" / "README.md"
START, END = "<!-- keys: made by docs/make_config_reference.py -->\n", "<!-- end of keys -->\n"


def rows(schema: dict, place: str = "") -> Iterator[str]:
    """Table rows of a schema's leaves, depth first."""
    for key, sub in schema["properties"].items():
        name = f"{place}{key}"
        if sub.get("type") == "object" and "default" not in sub:
            yield from rows(sub, f"{name}.")
        else:
            yield f"| `{name}` | {sub['description']} | `{json.dumps(sub.get('default'))}` |\n"


def reference() -> str:
    """Return the table of keys."""
    schema = yaml.safe_load(
        (ROOT / "workflow" / "real2sim" / "schemas" / "config.schema.yaml").read_text(encoding="utf-8")
    )
    return "| key | meaning | default |\n|---|---|---|\n" + "".join(rows(schema))


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
