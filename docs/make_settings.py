"""Write the types of the configuration into the library from its schema.

python docs/make_settings.py [--check]
"""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import yaml

ROOT = Path(__file__).parents[1]
MODULE = ROOT / "workflow" / "real2sim" / "settings.py"
HEAD = '''"""Types of the configuration's slices: made from schemas/config.schema.yaml by docs/make_settings.py.

A settings object is the validated configuration, or slices of it, as a rule passes them on. What a key means, its unit
and its default stand in config/README.md.
"""

# ruff: noqa: UP013 (mappings, not classes)

from __future__ import annotations

from typing import TypedDict

'''
_PLAIN = {"number": "float", "integer": "int", "string": "str", "boolean": "bool"}


def type_of(schema: dict[str, Any], name: str) -> str:
    """Return the Python type of what a schema allows, ``name`` being that of a group of keys."""
    kind = schema.get("type")
    given = schema.get("enum") or ([schema["const"]] if "const" in schema else [])
    if given:
        return " | ".join(sorted({type(value).__name__ for value in given}))
    if kind is None:
        choices = schema.get("anyOf") or schema.get("oneOf") or [{"type": "object"}]
        return " | ".join(dict.fromkeys(type_of(choice, name) for choice in choices))
    if isinstance(kind, list):
        return " | ".join(_PLAIN.get(k, "None") for k in kind)
    if kind == "array":
        return f"list[{type_of(schema.get('items', {}), name)}]"
    if kind == "object" and schema.get("properties"):
        return name
    if kind == "object":
        named = schema.get("additionalProperties")
        value = type_of(named, f"{name}Entry") if isinstance(named, dict) else "object"
        return f"dict[str, {value}]"
    return _PLAIN.get(str(kind), "object")


def groups(schema: dict[str, Any], name: str) -> Iterator[str]:
    """Yield the types of a group of keys, those within it first."""
    rows = []
    for key, sub in schema["properties"].items():
        own = name.removesuffix("Settings") + "".join(p.capitalize() for p in key.split("_")) + "Settings"
        for inner, inner_name in _within(sub, own):
            yield from groups(inner, inner_name)
        rows.append(f'    "{key}": {type_of(sub, own)},\n')
    body = "".join(rows)
    yield f'{name} = TypedDict("{name}", {{\n{body}}})\n'


def _within(schema: dict[str, Any], name: str) -> Iterator[tuple[dict[str, Any], str]]:
    """Yield the groups of keys that a value holds, with their names."""
    if schema.get("type") == "object" and schema.get("properties"):
        yield schema, name
    elif schema.get("type") == "array":
        yield from _within(schema.get("items", {}), name)
    elif isinstance(schema.get("additionalProperties"), dict):
        yield from _within(schema["additionalProperties"], f"{name}Entry")


def module() -> str:
    """Return the text of the module."""
    path = ROOT / "workflow" / "real2sim" / "schemas" / "config.schema.yaml"
    schema = yaml.safe_load(path.read_text(encoding="utf-8"))
    text = HEAD + "\n".join(groups(schema, "Settings"))
    command = [sys.executable, "-m", "ruff", "format", "--stdin-filename", str(MODULE), "-"]
    return subprocess.run(command, input=text, capture_output=True, text=True, check=True).stdout


def main() -> int:
    """Write the module, or with --check say whether it is current."""
    made = module()
    if "--check" in sys.argv:
        return 0 if made == MODULE.read_text(encoding="utf-8") else 1
    MODULE.write_text(made, encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
