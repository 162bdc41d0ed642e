"""Every option of the configuration is read by the code, and every rule's options are documented."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from itertools import chain
from pathlib import Path

import pytest
import yaml
from mypy import build
from mypy.config_parser import parse_config_file
from mypy.find_sources import create_source_list
from mypy.nodes import IndexExpr
from mypy.options import Options
from mypy.types import LiteralType, TypedDictType, UnionType, get_proper_type
from real2sim.inference.parameters import PARAMETERS

ROOT = Path(__file__).parents[2]
LIBRARY = ROOT / "workflow" / "real2sim"


def _schema(name):
    return yaml.safe_load((LIBRARY / "schemas" / f"{name}.schema.yaml").read_text(encoding="utf-8"))


def _leaves(schema: dict, above: tuple[str, ...] = ()) -> Iterator[tuple[str, ...]]:
    """Yield the path of every option that is no group of options."""
    for key, sub in schema.get("properties", {}).items():
        path = (*above, key)
        yield from _leaves(sub, path) if sub.get("properties") else [path]


def _type_name(path: tuple[str, ...]) -> str:
    """Name in settings.py of the group that holds an option."""
    return "".join(p.capitalize() for key in path[:-1] for p in key.split("_")) + "Settings"


def _parts(of):
    of = get_proper_type(of)
    return list(chain.from_iterable(map(_parts, of.items))) if isinstance(of, UnionType) else [of]


@pytest.fixture(scope="module")
def looked_up() -> set[tuple[str, str]]:
    """Groups of settings and their keys that the library looks up, by the types that mypy finds."""
    options = Options()
    parse_config_file(options, lambda: None, str(ROOT / "pyproject.toml"))
    options.export_types, options.incremental = True, False
    result = build.build(create_source_list([str(LIBRARY)], options), options)
    assert not result.errors
    found = set()
    for node in list(result.types):
        if not isinstance(node, IndexExpr) or node.base not in result.types:
            continue
        keys = [p.value for p in map(_literal, _parts(result.types.get(node.index))) if p is not None]
        for group in _parts(result.types[node.base]):
            if isinstance(group, TypedDictType):
                found |= {(group.fallback.type.name, key) for key in keys}
    return found


def _literal(of):
    of = getattr(of, "last_known_value", None) or of
    return of if isinstance(of, LiteralType) else None


class _Words:
    """Strings, names of fields and of arguments in the library, but for the types of the settings themselves.

    A key is also found that is made where it is looked up, by its constant part: ``x[f"{kind}_trials"]``.
    """

    def __init__(self):
        self._exact: set[str] = set(PARAMETERS)
        self._made: set[str] = set()
        for path in LIBRARY.rglob("*.py"):
            if path.name != "settings.py":
                self._take(ast.parse(path.read_text(encoding="utf-8")))

    def _take(self, tree: ast.AST) -> None:
        for node in ast.walk(tree):
            if isinstance(node, ast.Subscript) and isinstance(node.slice, ast.JoinedStr):
                own = [v.value if isinstance(v, ast.Constant) else None for v in node.slice.values]
                if any(part is not None and part.strip("_") for part in own):
                    self._made.add("".join("[a-z_]+" if part is None else re.escape(part) for part in own))
            elif isinstance(node, ast.Constant) and isinstance(node.value, str):
                self._exact.add(node.value)
            elif isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name):
                self._exact.add(node.target.id)
            elif isinstance(node, ast.arg):
                self._exact.add(node.arg)

    def __contains__(self, word: str) -> bool:
        return word in self._exact or any(re.fullmatch(made, word) for made in self._made)


def _rules() -> str:
    return "".join(p.read_text(encoding="utf-8") for p in sorted((ROOT / "workflow" / "rules").glob("*.smk")))


def test_every_option_is_read(looked_up):
    """Most are looked up in their own group; a group that is handed on as a whole has its keys named elsewhere."""
    options = list(_leaves(_schema("config")))
    own = [path for path in options if (_type_name(path), path[-1]) in looked_up]
    # so many that a library without types of its settings, which would let everything pass, is noticed
    assert len(own) > 0.5 * len(options)
    words, rules = _Words(), _rules()
    others = [path for path in options if path not in own]
    assert [p for p in others if p[-1] not in words and f'["{p[-1]}"]' not in rules] == []


@pytest.mark.parametrize("name", ["phantom", "suite"])
def test_every_option_of_synthetic_people_is_read(name):
    words = _Words()
    assert [path for path in _leaves(_schema(name)) if path[-1] not in words] == []


def _documented() -> dict[str, list[str]]:
    """Keys of the configuration by rule, as docs/rules.md lists them (made by docs/make_rule_graph.py)."""
    page = (ROOT / "docs" / "rules.md").read_text(encoding="utf-8").split("## Which settings each reads")[1]
    return {
        rule: re.findall(r"`([^`]+)`", keys)
        for rule, keys in re.findall(r"^\| `([^`]+)` \| (.+) \|$", page, re.M)
    }


def test_every_option_belongs_to_a_step_and_every_steps_options_are_documented():
    listed = set(chain.from_iterable(_documented().values())) - {"config/phantom.yaml"}
    options = [".".join(path) for path in _leaves(_schema("config"))]
    explained = (ROOT / "config" / "README.md").read_text(encoding="utf-8")
    assert [key for key in listed if not any(o == key or o.startswith(f"{key}.") for o in options)] == []
    assert [o for o in options if not any(o == key or o.startswith(f"{key}.") for key in listed)] == []
    # a spring and its damper stand in one row
    rows = {row.split("`")[1]: row for row in explained.splitlines() if row.startswith("| `")}
    above = {o: rows.get(o.rpartition(".")[0], "") for o in options}
    assert [o for o in options if o not in rows and f'"{o.rpartition(".")[2]}"' not in above[o]] == []


def test_every_rule_with_settings_is_in_the_table():
    blocks = re.split(r"^(?=\s*rule\b)", _rules(), flags=re.M)[1:]
    named = [re.match(r"\s*rule\s+(\w+):", block) for block in blocks if "--settings" in block]
    assert [m[1] for m in named if m and m[1] not in _documented()] == []
