"""Levels of the tightness sweep. Light imports: the Snakefile calls this when parsed."""

from __future__ import annotations

from typing import Any


def tightness_levels(person: dict[str, Any]) -> list[int]:
    """Levels of the tightness sweep [cm], loosest first."""
    t = person["tightness"]
    return list(range(t["loosest_cm"], t["tightest_cm"] + 1))
