"""All forms that a suite can draw, by name: those of the catalogue, of other equations, outside it, and random laws."""

from __future__ import annotations

from real2sim.verification.suite import random_forms
from real2sim.verification.suite.effects import FORMS

__all__ = ["FORMS", "random_forms"]
