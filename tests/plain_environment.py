"""The environment that a user has: only packages of environment-lock.txt can be imported.

The tests' own environment holds more (pytest, sphinx, ...), and a command that needs one of these works there and fails
for everybody else.
"""

from __future__ import annotations

import os
import re
import sys
from importlib.metadata import packages_distributions
from pathlib import Path

ROOT = Path(__file__).parents[1]
# Needed to run at all, and of no distribution of the lock
_OWN = {"pip", "setuptools", "phri-real2sim"}
_SITE = """
import sys


class _Absent:
    names = frozenset({names!r})

    def find_spec(self, name, path=None, target=None):
        if name.split(".")[0] in self.names:
            raise ModuleNotFoundError(f"No module named {{name!r}}: not in environment-lock.txt", name=name)


sys.meta_path.insert(0, _Absent())
"""


def _name(text: str) -> str:
    return re.sub(r"[-_.]+", "-", text).lower()


def locked() -> set[str]:
    """Return the names of the distributions of environment-lock.txt."""
    text = (ROOT / "environment-lock.txt").read_text(encoding="utf-8")
    return {_name(found) for found in re.findall(r"^([A-Za-z0-9._-]+)==", text, re.M)}


def absent() -> set[str]:
    """Return the modules of this environment that a user's does not have."""
    there = locked() | _OWN
    return {
        module
        for module, distributions in packages_distributions().items()
        if not there & {_name(d) for d in distributions}
    }


def plain_environment(folder: Path) -> dict[str, str]:
    """Return variables for a process that can import what a user can; ``folder`` holds what sees to it."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "sitecustomize.py").write_text(_SITE.format(names=sorted(absent())), encoding="utf-8")
    path = os.pathsep.join([str(Path(sys.executable).parent), os.environ["PATH"]])
    return {"PATH": path, "PYTHONPATH": str(folder)}
