"""What is said of a measured law: the simplest kind that carries it."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from real2sim.diagnosis.law import least_family
from real2sim.effects.families import Family, Range, Variable, families
from real2sim.system.description import shipped_system

STRAP = shipped_system("strap")
TIME_S = np.arange(1500) * 0.01


@pytest.fixture(scope="module")
def library():
    """Families of the strap, and a motion in which no two coordinates go together."""
    own = {}
    for i, axis in enumerate(STRAP.axes):
        hz = 0.23 + 0.11 * i
        q = np.sin(2 * np.pi * hz * TIME_S) + 0.4 * np.sin(2 * np.pi * 1.7 * hz * TIME_S + i)
        own[f"q_{axis.name}"] = Variable(f"q_{axis.name}", "m", 0.01, q)
        own[f"v_{axis.name}"] = Variable(f"v_{axis.name}", "m/s", 0.1, np.gradient(q, TIME_S) / 3)
    ranges = {n: Range(float(v.values.min()), float(v.values.max())) for n, v in own.items()}
    unit = {axis.joint: 1.0 for axis in STRAP.axes}

    def signals(terms, context):
        rows = [t.basis(own, ranges, 0.01) * t.factor for t in terms]
        return np.array(rows).reshape(len(rows), len(TIME_S))

    return SimpleNamespace(forces=families(STRAP, list(own), unit, unit, 10.0), signals=signals)


PAIR = SimpleNamespace(train=SimpleNamespace(context=None))


def _told(library, kind: str, axes: tuple[str, ...], wanted) -> dict:
    family: Family = next(f for f in library.forces if (f.kind, f.axes) == (kind, axes))
    x = np.array([wanted([t.name for t in row]) for row in family.terms], float)
    assert x.any()
    return least_family(family, x, library, PAIR)


def test_a_potential_of_two_springs_is_elastic(library):
    told = _told(library, "elastic coupling", ("ty", "tz"), lambda names: names[0].startswith("P3"))
    assert (told["kind"], told["axes"], told["depends_on"]) == ("elastic", ["ty", "tz"], ["q_ty", "q_tz"])


def test_of_two_axes_the_one_that_feels_nothing_is_left_out(library):
    told = _told(library, "elastic coupling", ("ty", "tz"), lambda names: names == ["P3(q_tz)"])
    assert (told["kind"], told["axes"], told["depends_on"]) == ("elastic", ["tz"], ["q_tz"])


def test_a_potential_that_couples_stays_one(library):
    told = _told(library, "elastic coupling", ("ty", "tz"), lambda names: len(names) == 2)
    assert (told["kind"], told["axes"]) == ("elastic coupling", ["ty", "tz"])


def test_damping_that_the_coordinate_does_not_change_is_dissipative(library):
    told = _told(library, "damping by coordinate", ("ty",), lambda names: names == ["v_ty |v_ty|"])
    assert (told["kind"], told["depends_on"]) == ("dissipative", ["v_ty"])
    told = _told(library, "damping by coordinate", ("ty",), lambda names: names == ["P2(q_ty) v_ty"])
    assert (told["kind"], told["depends_on"]) == ("damping by coordinate", ["q_ty", "v_ty"])


def test_other_kinds_are_told_as_they_are(library):
    told = _told(library, "memory", ("ty",), lambda names: True)
    assert (told["kind"], told["depends_on"]) == ("memory", ["history of q_ty"])
