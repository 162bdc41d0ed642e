"""Free-form displacements of what is measured: markers by where the interface is against the segment."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from real2sim.effects.displacements import DEFLECTIONS, deflected_by, deflections, displacements
from real2sim.geometry import AXES, rotation_xyz

from tests.unit.simulated_effects import replay

CONTEXT = replay([])._context
BY_NAME = {d.name: d for d in displacements(10.0, CONTEXT)}


def _paths(coordinates):
    """Marker paths (1, n, 2, 3) [m] of an interface that moves by coordinates (n, 6) against the segment."""
    rest = CONTEXT.shapes.interface
    middle = rest.mean(axis=0)
    turned = np.einsum("nij,kj->nki", rotation_xyz(coordinates[:, 3:]), rest - middle)
    along = turned + middle + coordinates[:, None, :3]
    world = np.einsum("nij,nkj->nki", CONTEXT.pelvis_rotation, along)
    return (world + CONTEXT.pelvis_position[:, None])[None]


def _moving(axis, size=0.05):
    out = np.zeros((len(CONTEXT.time_s), 6))
    out[:, AXES.index(axis)] = size * np.sin(3 * CONTEXT.time_s)
    return out


@pytest.mark.parametrize("axis", DEFLECTIONS)
def test_two_markers_show_five_coordinates_of_the_interface(axis):
    coordinates = _moving(axis)
    shown = deflections(_paths(coordinates), CONTEXT)[0]
    column = DEFLECTIONS.index(axis)
    size = np.abs(coordinates).max()
    np.testing.assert_allclose(shown[:, column], coordinates.sum(axis=1), atol=1e-3 * size)
    others = np.delete(shown, column, axis=1)
    # a turn of the bar shortens it across by its square
    assert np.abs(others).max() < 0.03 * size
    # a turn about the line between the markers does not show
    assert np.abs(deflections(_paths(_moving("ry")), CONTEXT)).max() < 1e-12


def test_markers_are_displaced_by_where_the_simulation_has_the_interface():
    """What was recorded holds the displacement that is looked for, and would explain itself."""
    fitted = replace(CONTEXT, measured=_paths(_moving("ty"))[0])
    family = {d.name: d for d in displacements(10.0, fitted)}[deflected_by("ty")]
    assert (family.depends_on, family.stage) == (("q_ty",), "output")
    chain, values = family.chains.output, np.zeros((1, len(family.terms)))
    values[0, family.terms.index("left y P1(ty)")] = 1.0
    for size in (0.05, 0.02, 0.0):
        paths = _paths(_moving("ty", size))
        way = chain(paths, values, fitted) - paths
        np.testing.assert_allclose(way[:, :, 1], 0)
        expected = 0.005 * _moving("ty", size)[:, 1] / 0.05
        along = np.einsum("nij,ni->nj", fitted.interface_rotation, way[0, :, 0])
        np.testing.assert_allclose(along, expected[:, None] * [0, 1, 0], atol=2e-5)
    # beyond the visited range it stays as it is at its edge
    far = _paths(_moving("ty", 0.2))
    assert np.abs(chain(far, values, fitted) - far).max() == pytest.approx(0.005, rel=1e-3)


def test_deflected_markers_are_linear_in_their_coefficients():
    paths = np.tile(_paths(_moving("rz") + _moving("tx", 0.01)), (3, 1, 1, 1))
    rng = np.random.default_rng(1)
    for axis in DEFLECTIONS:
        family = BY_NAME[deflected_by(axis)]
        one, other = rng.standard_normal((2, len(family.terms)))
        moved = family.chains.output(paths, np.array([one, other, one - 2 * other]), CONTEXT) - paths
        np.testing.assert_allclose(moved[2], moved[0] - 2 * moved[1], atol=1e-12)
        assert len(family.weights) == len(family.terms)
