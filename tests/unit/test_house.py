"""The shape of the library: sizes of functions and classes, and which room may import from which."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import pytest

ROOT = Path("workflow/real2sim")
LONGEST_FUNCTION, MOST_FIELDS = 60, 15
_FEW = frozenset({"diagnosis", "study", "verification", "pages"})
# What each room imports nothing of
CLOSED = {
    "system": _FEW | {"effects", "recording", "inference"},
    "effects": _FEW | {"recording", "inference"},
    "inference": _FEW | {"effects"},
    "recording": _FEW | {"effects"},
    "diagnosis": frozenset({"study", "verification", "pages"}),
}
# Imports (importer, imported) that go against `CLOSED`, and why each may
EXCEPTIONS: dict[tuple[str, str], str] = {}


@cache
def modules() -> dict[str, ast.Module]:
    """Return the syntax trees of all modules by dotted name."""
    found = {}
    for path in sorted(ROOT.rglob("*.py")):
        parts = path.relative_to(ROOT.parent).with_suffix("").parts
        found[".".join(parts[:-1] if parts[-1] == "__init__" else parts)] = ast.parse(path.read_text())
    return found


def _for_types_only(node: ast.AST) -> bool:
    return isinstance(node, ast.If) and ast.unparse(node.test) in ("TYPE_CHECKING", "typing.TYPE_CHECKING")


def _nodes(tree: ast.AST, *, into_functions: bool) -> Iterator[ast.AST]:
    """Yield the nodes of a tree without blocks for type checkers, and without functions where not asked for them."""
    for node in ast.iter_child_nodes(tree):
        if _for_types_only(node):
            continue
        if not into_functions and isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.Lambda):
            continue
        yield node
        yield from _nodes(node, into_functions=into_functions)


@cache
def imports(name: str, *, into_functions: bool) -> frozenset[str]:
    """Return the modules of the library that a module imports."""
    found: set[str] = set()
    for node in _nodes(modules()[name], into_functions=into_functions):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{name}: relative import"
            whole = [f"{node.module}.{alias.name}" for alias in node.names]
            found |= {part if part in modules() else str(node.module) for part in whole}
    return frozenset(found & modules().keys()) - {name}


def _room(name: str) -> str:
    parts = name.split(".")
    return parts[1] if len(parts) > 1 else ""


def _functions() -> Iterator[tuple[str, int]]:
    for name, tree in modules().items():
        for node in ast.walk(tree):
            if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
                assert node.end_lineno is not None
                yield f"{name}.{node.name}", node.end_lineno - node.lineno + 1


def _classes() -> Iterator[tuple[str, ast.ClassDef]]:
    for name, tree in modules().items():
        for node in ast.walk(tree):
            if isinstance(node, ast.ClassDef):
                yield name, node


def test_no_function_is_longer_than_a_screen():
    assert {f: lines for f, lines in _functions() if lines > LONGEST_FUNCTION} == {}


def test_no_class_has_more_fields_than_one_remembers():
    fields = {f"{m}.{c.name}": sum(isinstance(n, ast.AnnAssign) for n in c.body) for m, c in _classes()}
    assert {c: count for c, count in fields.items() if count > MOST_FIELDS} == {}


def _mechanisms() -> set[str]:
    """Return names of classes in effects/ that derive from `Mechanism`, directly or not, and itself."""
    bases = {
        c.name: {ast.unparse(base).split(".")[-1] for base in c.bases}
        for module, c in _classes()
        if _room(module) == "effects"
    }
    found = {"Mechanism"}
    while more := {name for name, of in bases.items() if of & found} - found:
        found |= more
    return found


def test_nobody_outside_effects_asks_of_what_class_a_mechanism_is():
    mechanisms, asked = _mechanisms(), []
    assert len(mechanisms) > 20
    for name, tree in modules().items():
        if _room(name) == "effects":
            continue
        for node in ast.walk(tree):
            if isinstance(node, ast.Call) and ast.unparse(node.func) in ("isinstance", "issubclass"):
                named = {n.id for n in ast.walk(node.args[1]) if isinstance(n, ast.Name)}
                named |= {n.attr for n in ast.walk(node.args[1]) if isinstance(n, ast.Attribute)}
                asked += [f"{name}:{node.lineno} {who}" for who in named & mechanisms]
    assert asked == []


def test_modules_do_not_import_each_other_in_a_circle():
    state: dict[str, bool] = {}

    def visit(name: str, path: list[str]) -> None:
        if state.get(name):
            return
        assert name not in path, " -> ".join([*path[path.index(name) :], name])
        for other in sorted(imports(name, into_functions=False)):
            visit(other, [*path, name])
        state[name] = True

    for name in modules():
        visit(name, [])


@pytest.mark.parametrize("room", CLOSED)
def test_a_room_imports_only_from_rooms_below_it(room):
    against = {
        (name, other)
        for name in modules()
        if _room(name) == room
        for other in imports(name, into_functions=True)
        if _room(other) in CLOSED[room]
    }
    assert against - EXCEPTIONS.keys() == set()


def test_nothing_imports_the_proofs():
    against = {
        (name, other)
        for name in modules()
        if _room(name) != "verification"
        for other in imports(name, into_functions=True)
        if _room(other) == "verification"
    }
    assert against - EXCEPTIONS.keys() == set()


def test_every_exception_is_still_needed():
    assert {pair for pair in EXCEPTIONS if pair[1] not in imports(pair[0], into_functions=True)} == set()


@pytest.mark.parametrize("said", [r"\bcontract\b", "design/", "superset", r"(?<!docs/)effects\.md"])
def test_the_library_refers_to_no_document_outside_the_repository(said):
    assert [str(path) for path in ROOT.rglob("*.py") if re.search(said, path.read_text())] == []


QUESTIONS = {"What", "Where", "How", "Whether", "Which", "Why", "When", "Who"}


def test_no_docstring_opens_with_a_question():
    """A first line says what is returned or done, to somebody who has not read the module."""
    opened = [
        f"{module}.{node.name}"
        for module, tree in modules().items()
        for node in ast.walk(tree)
        if isinstance(node, ast.FunctionDef | ast.ClassDef)
        and (said := ast.get_docstring(node))
        and said.split()[0].rstrip(",:") in QUESTIONS
    ]
    assert opened == []
