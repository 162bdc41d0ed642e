"""What four markers on one body say of one that is said to slide."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from real2sim.configuration import validated
from real2sim.effects.catalogue import EFFECTS
from real2sim.geometry import PELVIS_MARKERS, pelvis_frame
from real2sim.recording.skin import skin_of
from scipy.spatial.transform import Rotation

from tests.unit.simulated_effects import PELVIS_SHAPE

RATE, SD = 100.0, 5e-4
OPTIONS = validated({}, "config", Path("defaults"))["diagnosis"]["skin"]
TIME = np.arange(1200) / RATE
SHAPE = PELVIS_SHAPE - pelvis_frame(*PELVIS_SHAPE)[1]
SHAPE = SHAPE @ pelvis_frame(*SHAPE)[0]
CONTEXT = SimpleNamespace(time_s=TIME, shapes=SimpleNamespace(segment=SHAPE))


def ways(marker: str, *values: float) -> np.ndarray:
    effect = next(e for e in EFFECTS if (e.name, e.form) == ("marker_drift", marker.lower()))
    return effect.chains.displacement(np.array(values), CONTEXT)


def seen(rng: np.random.Generator, slides: np.ndarray | float = 0.0) -> np.ndarray:
    """Markers (n, 4, 3) of a person who moves and turns, with noise and slides (n, 4, 3) in the pelvis."""
    turn = Rotation.from_euler(
        "ZYX", 0.3 * np.sin(np.outer(TIME, [2.0, 3.1, 1.3])) + [1.0, 0.1, 0.0]
    ).as_matrix()
    place = 0.1 * np.cos(np.outer(TIME, [1.7, 2.3, 0.9]))
    noise = SD * rng.standard_normal((len(TIME), 4, 3))
    return place[:, None] + np.einsum("nij,nkj->nki", turn, SHAPE + noise + slides)


def test_what_a_rigid_body_does_moves_no_marker_against_another():
    rng = np.random.default_rng(0)
    found = np.array([skin_of(TIME, seen(rng), SHAPE, OPTIONS).seen for _ in range(60)])
    assert found.shape == (60, 12)
    # the sample SD of nine degrees of freedom, drawn up to the mean of all six, makes them a little smaller than one
    assert 0.8 < found.std() < 1.1


@pytest.mark.parametrize("marker", PELVIS_MARKERS)
@pytest.mark.parametrize("axis", range(3))
def test_a_marker_that_is_said_to_slide_is_contradicted_where_it_does_not(marker, axis):
    """2 mm, in the plane of the four markers or out of it, where one of the ASIS tilts the plane nearly as a body."""
    rng = np.random.default_rng([1, axis])
    rate = np.zeros(6)
    rate[axis] = 2e-3 / TIME[-1]
    slides = ways(marker, *rate)
    still, slid = skin_of(TIME, seen(rng), SHAPE, OPTIONS), skin_of(TIME, seen(rng, slides), SHAPE, OPTIONS)
    assert still.against_it(slides) > 30
    assert slid.against_it(slides) == 0
    assert slid.against_it(-slides) > 100


def test_a_slide_that_was_seen_speaks_for_no_cause():
    rng = np.random.default_rng(2)
    slides = ways("PSIS_L", 0, 0, 2e-4, 0, 0, 4e-4)
    skin = skin_of(TIME, seen(rng, slides), SHAPE, OPTIONS)
    assert np.sum(skin.departures(slides) ** 2) < 30 < np.sum(skin.seen**2)
    assert skin.against_it(0 * slides) == 0
    assert skin.against_it(slides) == 0


def test_gaps_are_left_out_and_too_little_says_nothing():
    rng = np.random.default_rng(3)
    markers, slides = seen(rng), ways("ASIS_L", 3e-4, 0, 0, 0, 0, 0)
    markers[300:480, 2] = np.nan
    assert skin_of(TIME, markers, SHAPE, OPTIONS).against_it(slides) > 100
    markers[400:, 1] = np.nan
    assert skin_of(TIME, markers, SHAPE, OPTIONS) is None
