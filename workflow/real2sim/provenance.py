"""What a result rests on: input hashes, package versions, and a fingerprint of the code that made it."""

from __future__ import annotations

import ast
import hashlib
import json
import platform
from contextlib import suppress
from functools import cache
from importlib.metadata import version
from pathlib import Path
from typing import TypedDict

from real2sim.files import write_text

LIBRARY = Path(__file__).parent
# hash of a module's code, and what it imports from the library: module, and the name taken from it or ""
_Text = tuple[str, list[tuple[str, str]]]


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


class CodeMemory:
    """Memory of the code's text in a JSON file, so that only a changed module is parsed again.

    Parsing all of the library takes seconds, and each start of Snakemake needs it. An entry is found by the SHA-256 of
    the text it was made of; the file counts only for the Python and for this module by which it was written.
    """

    def __init__(self) -> None:
        self._known: dict[str, _Text] = {}
        self._used: dict[str, _Text] = {}
        self._made_by = f"Python {platform.python_version()}, {sha256(Path(__file__))}"

    def load(self, memory: Path) -> None:
        """Take in what a file holds; one that is missing, damaged or of another Python costs time and nothing else."""
        try:
            content = json.loads(memory.read_text(encoding="utf-8"))
            if content["made_by"] == self._made_by:
                self._known |= {
                    str(text): (str(digest), [(str(module), str(name)) for module, name in imported])
                    for text, (digest, imported) in content["texts"].items()
                }
        except (OSError, ValueError, KeyError, AttributeError, TypeError):
            return

    def save(self, memory: Path) -> None:
        """Write what this process used, where that is not what was known; a folder that cannot be written is left."""
        if self._used and self._used != self._known:
            with suppress(OSError):
                write_text(memory, json.dumps({"made_by": self._made_by, "texts": self._used}))

    def of(self, path: Path) -> _Text:
        """Return the hash of a module's code and the names that it imports from the library."""
        text = path.read_bytes()
        key = hashlib.sha256(text).hexdigest()
        self._used[key] = self._known[key] if key in self._known else _parsed(text)
        return self._used[key]


def _parsed(text: bytes) -> _Text:
    """Hash of code without comments, docstrings and layout, and the (module, name) that it imports of the library."""
    tree = ast.parse(text)
    # what only a type checker reads does not run
    tree.body = [node for node in tree.body if not _is_for_types(node)]
    imported = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and node.module and node.module.startswith(LIBRARY.name):
            imported |= {(node.module, alias.name) for alias in node.names}
        elif isinstance(node, ast.Import):
            imported |= {(a.name, "") for a in node.names if a.name.split(".")[0] == LIBRARY.name}
        body = getattr(node, "body", None)
        if (
            isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef)
            and body
            and isinstance(body[0], ast.Expr)
            and isinstance(body[0].value, ast.Constant)
            and isinstance(body[0].value.value, str)
        ):
            body[0].value.value = ""
    return hashlib.sha256(ast.dump(tree).encode()).hexdigest(), sorted(imported)


def _is_for_types(node: ast.stmt) -> bool:
    return isinstance(node, ast.If) and isinstance(node.test, ast.Name) and node.test.id == "TYPE_CHECKING"


CODE = CodeMemory()
# what the rules remember of the code, for them and for their jobs
CODE_FILE = Path(".snakemake") / "real2sim" / "code.json"


def _file(module: str) -> Path | None:
    """File of a module or package of the library, if it is one."""
    path = LIBRARY.parent / (module.replace(".", "/") + ".py")
    return next((each for each in (path, path.with_suffix("") / "__init__.py") if each.exists()), None)


@cache
def _tree(module: str) -> tuple[str, frozenset[str]]:
    """Hash of a module's code and the modules of the library that it imports."""
    path = _file(module)
    if path is None:
        raise ModuleNotFoundError(f"{module} is no module of {LIBRARY}")
    digest, names = CODE.of(path)
    # a name that is imported from a package may be a module in it
    return digest, frozenset(
        submodule if name and _file(submodule := f"{package}.{name}") else package for package, name in names
    )


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
