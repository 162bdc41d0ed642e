"""Identify and diagnose simulation models of people coupled to robots.

The names in ``__all__`` are the public ones. Each is imported on first use, so that ``import real2sim`` and the command
line load no numerical library that they do not need.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from real2sim.api import Diagnosis, Fit, catalogue, diagnose, identify
    from real2sim.errors import InputError
    from real2sim.recording.table import Recording
    from real2sim.system.description import System

__version__ = "0.1.0"
__all__ = [
    "Diagnosis",
    "Fit",
    "InputError",
    "Recording",
    "System",
    "__version__",
    "catalogue",
    "diagnose",
    "identify",
]

# public name: module that defines it; the imports above tell type checkers the same
_HOMES = {
    "Diagnosis": "real2sim.api",
    "Fit": "real2sim.api",
    "InputError": "real2sim.errors",
    "Recording": "real2sim.recording.table",
    "System": "real2sim.system.description",
    "catalogue": "real2sim.api",
    "diagnose": "real2sim.api",
    "identify": "real2sim.api",
}

if not TYPE_CHECKING:  # a type checker would take any name for one that `__getattr__` has

    def __getattr__(name: str) -> object:
        """Import the module of a public name and return what it names."""
        if name not in _HOMES:
            raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
        value = globals()[name] = getattr(import_module(_HOMES[name]), name)
        return value


def __dir__() -> list[str]:
    """List the names of the module, public ones that nobody has used yet included."""
    return sorted({*globals(), *__all__})
