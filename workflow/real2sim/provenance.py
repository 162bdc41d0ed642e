"""What a result rests on: input hashes, package versions, and a fingerprint of the code that made it."""

from __future__ import annotations

import ast
import hashlib
import platform
from functools import cache
from importlib.metadata import version
from pathlib import Path
from typing import TypedDict

LIBRARY = Path(__file__).parent


class Provenance(TypedDict):
    """Provenance of a result: SHA-256 by input path, versions by package, fingerprint of the code."""

    inputs_sha256: dict[str, str]
    python: str
    packages: dict[str, str]
    code_fingerprint: str


def sha256(path: Path) -> str:
    """Return the hex SHA-256 of a file."""
    with path.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


@cache
def _tree(module: str) -> tuple[str, frozenset[str]]:
    """Hash of a module's code without comments, docstrings and layout, and the library modules it imports."""
    path = LIBRARY.parent / (module.replace(".", "/") + ".py")
    if not path.exists():
        path = path.with_suffix("") / "__init__.py"
    tree = ast.parse(path.read_text(encoding="utf-8"))
    # what only a type checker reads does not run
    tree.body = [node for node in tree.body if not _is_for_types(node)]
    imported = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and node.module and node.module.startswith(LIBRARY.name):
            for alias in node.names:
                submodule = f"{node.module}.{alias.name}"
                base = LIBRARY.parent / submodule.replace(".", "/")
                is_module = base.with_suffix(".py").exists() or (base / "__init__.py").exists()
                imported.add(submodule if is_module else node.module)
        elif isinstance(node, ast.Import):
            imported |= {a.name for a in node.names if a.name.split(".")[0] == LIBRARY.name}
        body = getattr(node, "body", None)
        if (
            isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef)
            and body
            and isinstance(body[0], ast.Expr)
            and isinstance(body[0].value, ast.Constant)
            and isinstance(body[0].value.value, str)
        ):
            body[0].value.value = ""
    return hashlib.sha256(ast.dump(tree).encode()).hexdigest(), frozenset(imported)


def _is_for_types(node: ast.stmt) -> bool:
    return isinstance(node, ast.If) and isinstance(node.test, ast.Name) and node.test.id == "TYPE_CHECKING"


@cache
def fingerprint(module: str) -> str:
    """Return the fingerprint of a library module and of all library modules that it imports, however far.

    A comment, a docstring or a reformatting leaves it; a changed constant or statement changes it. It is a param
    of the rules, because Snakemake does not see an edit of an imported module.
    """
    seen: dict[str, str] = {}
    todo = [module]
    while todo:
        name = todo.pop()
        if name not in seen:
            seen[name], imported = _tree(name)
            todo.extend(imported)
    joined = "\n".join(f"{name} {digest}" for name, digest in sorted(seen.items()))
    return hashlib.sha256(joined.encode()).hexdigest()[:16]


def provenance(inputs: list[Path], packages: list[str], code: str) -> Provenance:
    """Return the record of what a result rests on. No time and no host: the same work gives the same file.

    Parameters
    ----------
    inputs
        Files whose SHA-256 is recorded.
    packages
        Distributions whose version is recorded.
    code
        `fingerprint` of the module at work.
    """
    return {
        "inputs_sha256": {path.as_posix(): sha256(path) for path in inputs},
        "python": platform.python_version(),
        "packages": {name: version(name) for name in packages},
        "code_fingerprint": code,
    }
