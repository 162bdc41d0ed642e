"""Causes are named in systems that are not ours: short versions of the Bouc-Wen and EMPS benchmarks."""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path

import numpy as np
import pytest
from real2sim.configuration import validated

ROOT = Path(__file__).parents[2]
SETTINGS = validated({}, "config", Path("defaults"))["diagnosis"]
# The search of the diagnosis with fewer refits, and no sets of more than one effect
SHORT = SETTINGS | {
    "search": SETTINGS["search"]
    | {"refits": 8, "refits_close": 1, "iterations": 30, "pair_excess_sigma": 1e9}
}


@pytest.fixture(scope="module")
def foreign():
    spec = importlib.util.spec_from_file_location("foreign", ROOT / "benchmarks/foreign.py")
    module = importlib.util.module_from_spec(spec)
    sys.modules["foreign"] = module
    spec.loader.exec_module(module)
    return module


def test_the_plant_is_the_linear_system(foreign):
    """Without their nonlinearities both systems are a mass, a spring and a damper: only noise is left."""
    for system, k, d in (
        (foreign.bouc_wen_system(False, 512), 5e4, 10.0),
        (foreign.emps_system(False, 4.0), 1e-2, 203.5034),
    ):
        evidence = foreign.OneAxisEvidence(system, system.train)
        evidence.set_noise(k, d)
        parameters = np.ones((1, 12))
        parameters[0, [0, 6]] = k, d
        left = evidence.whitened(*evidence.replay([], 1).run_effects(parameters, []))[0]
        assert np.mean(left**2) == pytest.approx(1, abs=0.5)


def test_bouc_wen_of_the_benchmark_shows_its_published_size(foreign):
    record = foreign.bouc_wen_system(True, 1024).train
    assert np.std(record.position) == pytest.approx(0.66e-3, rel=0.05)


def test_hysteresis_and_friction_are_named_and_nothing_where_there_is_none(foreign):
    for system in (
        foreign.bouc_wen_system(True, 400),
        foreign.bouc_wen_system(False, 400),
        foreign.emps_system(True, 5.0),
        foreign.emps_system(False, 4.0),
    ):
        row = foreign.row_of(system, SHORT, lambda text: None)
        assert row["right"], row
