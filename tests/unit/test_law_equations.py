"""Laws on the tangent: what is computed from products equals what is computed from the slopes themselves."""

import numpy as np
import pytest
from real2sim.diagnosis.law_equations import SCALES, Equations, Products
from real2sim.inference.least_squares import bounded_step

ROWS, N, P = 400, 6, 5


@pytest.fixture(params=[10.0, 0.3, 0.02], ids=["far bounds", "some bounds", "near bounds"])
def problem(request):
    rng = np.random.default_rng(3)
    base, columns = rng.normal(size=(ROWS, N)), rng.normal(size=(ROWS, P))
    columns += 0.5 * base[:, :P]
    residuals = columns @ rng.normal(size=P) + base @ (0.4 * rng.normal(size=N)) + rng.normal(size=ROWS)
    room = np.full(N, request.param)
    return base, columns, residuals, room, np.linspace(1.0, 0.3, P)


def _brute_force(base, columns, residuals, room, weights, scale):
    """Step, what it leaves, and ln evidence over the base alone, from the slopes themselves."""
    sd = scale * weights
    slopes = np.vstack([np.hstack([base, columns]), np.hstack([np.zeros((P, N)), np.diag(1 / sd)])])
    rows = np.concatenate([residuals, np.zeros(P)])
    far = np.full(P, np.inf)
    step = bounded_step(
        slopes.T @ slopes, slopes.T @ rows, np.concatenate([-room, -far]), np.concatenate([room, far])
    )
    left = np.sum((rows + slopes @ step) ** 2)
    alone = np.sum((residuals + base @ bounded_step(base.T @ base, base.T @ residuals, -room, room)) ** 2)
    occam = np.linalg.slogdet(slopes.T @ slopes)[1] - np.linalg.slogdet(base.T @ base)[1]
    return step, 0.5 * (alone - left - occam - 2 * np.sum(np.log(sd)))


def test_scale_and_gain_are_those_of_every_scale_tried_by_itself(problem):
    base, columns, residuals, room, weights = problem
    equations = Equations(base, residuals, -room, room)
    scale, gain = equations.best_scale(Products.of(columns, base, residuals), weights)
    gains = [_brute_force(base, columns, residuals, room, weights, s)[1] for s in SCALES]
    assert scale == SCALES[int(np.argmax(gains))]
    assert gain == pytest.approx(max(gains), abs=1e-5)


def test_a_solution_and_what_it_leaves_are_those_of_the_slopes(problem):
    base, columns, residuals, room, weights = problem
    equations, products = Equations(base, residuals, -room, room), Products.of(columns, base, residuals)
    step, coefficients = equations.solve(products, 0.5 * weights)
    expected = _brute_force(base, columns, residuals, room, weights, 0.5)[0]
    assert np.concatenate([step, coefficients]) == pytest.approx(expected, abs=1e-6)
    left = np.sum((residuals + base @ step + columns @ coefficients) ** 2)
    assert equations.left(products, step, coefficients) == pytest.approx(left, rel=1e-9)


def test_sums_of_columns_have_the_products_of_the_summed_slopes(problem):
    base, columns, residuals, *_ = problem
    mixed = np.array([[1.0, 0.0], [1.0, 0.0], [0.0, 2.0]])
    summed = Products.of(columns[:, [0, 3, 4]] @ mixed, base, residuals)
    through = Products.of(columns[:, [0, 3, 4]], base, residuals).mixed(mixed)
    for name in ("across", "own", "slope"):
        assert getattr(through, name) == pytest.approx(getattr(summed, name))


def test_trials_share_coefficients_or_have_their_own(problem):
    base, columns, residuals, *_ = problem
    first, second = (Products.of(columns[r], base[r], residuals[r]) for r in (slice(200), slice(200, None)))
    both = Products.of(columns, base, residuals)
    assert first.plus(second).own == pytest.approx(both.own)
    apart = np.zeros((ROWS, 2 * P))
    apart[:200, :P], apart[200:, P:] = columns[:200], columns[200:]
    own = Products.of(apart, base, residuals)
    assert first.beside(second).own == pytest.approx(own.own)
    assert first.beside(second).across == pytest.approx(own.across)
