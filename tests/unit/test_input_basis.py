"""Changes of the driven path by an input chain: interpolated where that is exact enough, else the chain's own."""

from __future__ import annotations

import numpy as np
import pytest
from real2sim.effects.input_basis import InputChain, InputChanges

STEPS = 50
LOW, HIGH = np.full(2, -1.0), np.full(2, 1.0)


class Chain:
    """A path that moves by its values (2,), and by their product times ``together`` [m]; ``asked`` counts answers."""

    def __init__(self, together: float):
        self.together, self.asked = together, 0

    def __call__(self, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        self.asked += 1
        command, start = np.zeros((STEPS, 6)), np.zeros(12)
        command[:, 0] = start[0] = 0.01 * values[0] + 0.02 * values[1] ** 2 + self.together * values.prod()
        command[:, 3] = start[3] = 0.05 * values[1]
        return command, start


@pytest.mark.parametrize("together", [0.0, 0.01])
def test_changes_are_those_of_the_chain_whatever_two_parameters_do_together(together):
    chain = Chain(together)
    changes = InputChanges(InputChain(chain, LOW, HIGH, HIGH / 10))
    values = np.array([[0.8, -0.9], [0.8, -0.9], [0.2, 0.5]])
    commands, starts = changes.commands(values), changes.starts(values)
    for row, command, start in zip(values, commands, starts, strict=True):
        np.testing.assert_allclose(command, chain(row)[0], atol=1e-12)
        np.testing.assert_allclose(start, chain(row)[1], atol=1e-12)


def test_a_chain_that_its_basis_describes_is_not_asked_again():
    chain = Chain(0.0)
    changes = InputChanges(InputChain(chain, LOW, HIGH, HIGH / 10))
    chain.asked = 0
    for scale in (0.1, 0.1001, 0.1002):
        changes.commands(scale * np.eye(2))
    # once, to compare
    assert chain.asked == 1


def test_one_point_is_asked_for_once_however_often_it_comes():
    chain = Chain(1.0)
    changes = InputChanges(InputChain(chain, LOW, HIGH, HIGH / 10))
    chain.asked = 0
    values = np.tile([0.8, -0.9], (16, 1))
    changes.starts(values)
    changes.commands(values)
    assert chain.asked == 1


def test_a_path_that_cannot_be_driven_has_no_start():
    chain = Chain(1.0)

    def short(values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        if np.abs(values).max() > 0.5:
            raise ValueError("the pelvis turns by 170 degrees from its first pose")
        return chain(values)

    changes = InputChanges(InputChain(short, LOW, HIGH, HIGH / 10))
    starts = changes.starts(np.array([[0.8, 0.8], [0.2, 0.4]]))
    assert np.isnan(starts[0]).all()
    np.testing.assert_allclose(starts[1], chain(np.array([0.2, 0.4]))[1])
