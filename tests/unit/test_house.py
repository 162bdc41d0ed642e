"""The shape of the library: sizes of functions and classes, and which room may import from which."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from functools import cache
from graphlib import TopologicalSorter
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


@cache
def _classes() -> list[tuple[str, ast.ClassDef]]:
    return [
        (name, node)
        for name, tree in modules().items()
        for node in ast.walk(tree)
        if isinstance(node, ast.ClassDef)
    ]


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


def test_no_two_packages_of_the_proofs_need_each_other():
    def package(name: str) -> str:
        return name.split(".")[2]

    names = [name for name in modules() if _room(name) == "verification" and name.count(".") > 1]
    needs: dict[str, set[str]] = {}
    for name in names:
        others = imports(name, into_functions=True) & set(names)
        needs.setdefault(package(name), set()).update({package(o) for o in others} - {package(name)})
    assert list(TopologicalSorter(needs).static_order()), "a cycle is an error of the sorter"


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


# A dimension: n, n_r, nq, 3k, 21, PHASES, or a sum or product of such; `...` for any number of them
_ATOM = r"(?:\.\.\.|\d*[a-x]|n[a-z]|[a-z]_[a-z]|\d+|[A-Za-z_]{3,})"
_DIMENSION = rf"{_ATOM}(?: [*+-] {_ATOM})*"
SHAPE = re.compile(rf"\(({_DIMENSION}(?:, ?{_DIMENSION})*)(,?)\)")


def _states_shape(docstring: str) -> bool:
    """Return whether a docstring holds a shape; words in brackets, ``(mean, median)``, are none without a symbol."""
    shapes = (
        comma
        or any(not re.fullmatch("[A-Za-z]?[a-z_]{2,}", dimension) for dimension in dimensions.split(", "))
        for dimensions, comma in SHAPE.findall(docstring)
        if comma or "," in dimensions or dimensions == "..."
    )
    return "any shape" in docstring or any(shapes)


def _has_array(function: ast.FunctionDef) -> bool:
    of = function.args
    annotations = [
        a.annotation for a in [*of.posonlyargs, *of.args, *of.kwonlyargs, of.vararg, of.kwarg] if a
    ]
    return any("ndarray" in ast.unparse(a) for a in [*annotations, function.returns] if a)


def _methods(of: ast.ClassDef) -> Iterator[ast.FunctionDef]:
    return (node for node in of.body if isinstance(node, ast.FunctionDef))


def _bases(module: str, of: ast.ClassDef) -> Iterator[ast.ClassDef]:
    """Yield the base classes, by name: of the own module, else of any; and theirs."""
    for base in of.bases:
        name = ast.unparse(base).split("[")[0].split(".")[-1]
        named = [(m, c) for m, c in _classes() if c.name == name and c is not of]
        for where, found in [pair for pair in named if pair[0] == module] or named:
            yield found
            yield from _bases(where, found)


def _docstrings() -> Iterator[tuple[str, list[str]]]:
    """Yield the public functions with arrays, each with its docstring and those of the methods that it overrides."""
    for module, tree in modules().items():
        of_module: list[tuple[ast.ClassDef | None, ast.FunctionDef]] = [
            (None, node) for node in tree.body if isinstance(node, ast.FunctionDef)
        ]
        for name, found in _classes():
            if name == module and not found.name.startswith("_"):
                of_module += [(found, method) for method in _methods(found)]
        for owner, function in of_module:
            if function.name.startswith("_") or not _has_array(function):
                continue
            overridden = [
                method
                for base in (_bases(module, owner) if owner else ())
                for method in _methods(base)
                if method.name == function.name
            ]
            where = f"{module}.{owner.name}" if owner else module
            yield f"{where}.{function.name}", [ast.get_docstring(f) or "" for f in [function, *overridden]]


@pytest.mark.parametrize(
    ("docstring", "stated"),
    [
        ("Return forces (m, n, 6) [N, Nm].", True),
        ("Return times (n,) [s] of (3k, n + p) values.", True),
        ("Take values (...) [m].", True),
        ("Clip values of any shape.", True),
        ("Return the gap (amplitude, speed) of (R0, p0).", False),
        ("Return a quaternion (w, x, y, z), for one side (+1, -1).", False),
    ],
)
def test_a_shape_is_told_from_other_brackets(docstring, stated):
    assert _states_shape(docstring) == stated


def test_public_functions_with_arrays_state_shapes():
    """A method may leave the shapes to the docstring of the method that it overrides."""
    found = dict(_docstrings())
    assert len(found) > 500
    assert [name for name, said in found.items() if not any(map(_states_shape, said))] == []
