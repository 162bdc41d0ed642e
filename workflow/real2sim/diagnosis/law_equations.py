"""Least squares of laws on the tangent: thousands of families beside the same parameters, from products made once.

A family is linear in its coefficients c = s w y, with y standard normal, weights w and a scale s of its prior. With the
parameters of the base eliminated (Schur complement), one eigenvalue decomposition gives what it leaves and its marginal
likelihood at every scale (MacKay, Neural Comput. 4 (1992) 415, section 4).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import block_diag

from real2sim.inference.least_squares import bounded_step

# Prior scales that are tried, in units of a large force of the joint
SCALES = np.exp(np.linspace(-7.0, 1.5, 18))


def solved(
    a: np.ndarray, b: np.ndarray, lower: np.ndarray, upper: np.ndarray, square: float
) -> tuple[np.ndarray, float]:
    """Return the step inside the bounds of normal equations ``a`` (n, n), ``b`` (n,), and the square that it leaves."""
    step = bounded_step(a, b, lower, upper)
    return step, float(square + 2 * b @ step + step @ a @ step)


@dataclass(frozen=True)
class Products:
    """Products of slopes F (r, p) with the base's slopes B (r, n) and residuals (r,).

    ``across`` B'F (n, p), ``own`` F'F (p, p), ``slope`` F'r (p,).
    """

    across: np.ndarray
    own: np.ndarray
    slope: np.ndarray

    @classmethod
    def of(cls, columns: np.ndarray, base: np.ndarray, residuals: np.ndarray) -> Products:
        """Return those of columns (r, p)."""
        return cls(base.T @ columns, columns.T @ columns, columns.T @ residuals)

    def mixed(self, by: np.ndarray) -> Products:
        """Return those of sums of the columns, ``by`` (p, q)."""
        return Products(self.across @ by, by.T @ self.own @ by, by.T @ self.slope)

    def plus(self, other: Products) -> Products:
        """Return those of the rows of both, for the same coefficients."""
        return Products(self.across + other.across, self.own + other.own, self.slope + other.slope)

    def beside(self, other: Products) -> Products:
        """Return those of the rows of both, for coefficients of their own."""
        return Products(
            np.hstack([self.across, other.across]),
            block_diag(self.own, other.own),
            np.concatenate([self.slope, other.slope]),
        )

    @property
    def nothing(self) -> Products:
        """Those of as many columns that do nothing."""
        return Products(0 * self.across, 0 * self.own, 0 * self.slope)


class Equations:
    """Least squares in the base's parameters and the coefficients of one family.

    For slopes ``base`` (r, n) and residuals (r,), and room of the parameters' steps (n,). ``alone`` is the square that
    the base leaves without a family.
    """

    def __init__(self, base: np.ndarray, residuals: np.ndarray, lower: np.ndarray, upper: np.ndarray):
        self._lower, self._upper = lower, upper
        self._a = base.T @ base
        self._a[np.diag_indices_from(self._a)] += 1e-9
        self._b = base.T @ residuals
        self._square = float(residuals @ residuals)
        self.alone = solved(self._a, self._b, lower, upper, self._square)[1]

    def solve(self, family: Products, sd: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the step of the base (n,) and the coefficients (p,) for a prior ``sd`` (p,)."""
        step, _ = self._held(family, sd)
        n = len(self._b)
        return step[:n], step[n:]

    def left(self, family: Products, step: np.ndarray, coefficients: np.ndarray) -> float:
        """Return the square that a step of the base (n,) and coefficients (p,) leave, without their prior."""
        a, b = self._normal(family)
        z = np.concatenate([step, coefficients])
        return float(self._square + 2 * b @ z + z @ a @ z)

    def best_scale(self, family: Products, weights: np.ndarray) -> tuple[float, float]:
        """Return the prior scale of the largest evidence at weights (p,), and its gain in ln evidence on the base."""
        spread = _Spread(self._a, self._b, family, weights)
        occam = np.log1p(SCALES[:, None] ** 2 * spread.shares).sum(axis=1)
        gains = 0.5 * (self.alone - self._left_at(family, weights) - occam)
        best = int(np.argmax(gains))
        return float(SCALES[best]), float(gains[best])

    def _left_at(self, family: Products, weights: np.ndarray) -> np.ndarray:
        """Squares (s,) that are left with each of the scales, coefficients and their prior counted."""
        n = len(self._b)
        ends = [self._held(family, scale * weights)[0][:n] for scale in (SCALES[0], SCALES[-1])]
        first, last = ((end <= self._lower) | (end >= self._upper) for end in ends)
        if (first == last).all() and np.array_equal(ends[0][first], ends[1][first]):
            free, square = self._beside_stopped(family, weights, first, ends[0][first])
            steps = free.steps(SCALES)
            if ((steps > self._lower[~first]) & (steps < self._upper[~first])).all():
                return free.left(SCALES, square)
        # bounds that some scales meet and others do not: each is solved by itself
        return np.array([self._held(family, scale * weights)[1] for scale in SCALES])

    def _beside_stopped(
        self, family: Products, weights: np.ndarray, stopped: np.ndarray, held: np.ndarray
    ) -> tuple[_Spread, float]:
        """Return the family beside the parameters that no bound has ``stopped`` (n,), and the square without them.

        ``held`` (k,) are the steps of the stopped ones.
        """
        loose, a = ~stopped, self._a
        square = self._square + 2 * self._b[stopped] @ held + held @ a[np.ix_(stopped, stopped)] @ held
        b = self._b[loose] + a[np.ix_(loose, stopped)] @ held
        rest = Products(family.across[loose], family.own, family.slope + family.across[stopped].T @ held)
        return _Spread(a[np.ix_(loose, loose)], b, rest, weights), float(square)

    def _normal(self, family: Products) -> tuple[np.ndarray, np.ndarray]:
        """Normal matrix and slope of base and family, without a prior of the coefficients."""
        a = np.block([[self._a, family.across], [family.across.T, family.own]])
        return a, np.concatenate([self._b, family.slope])

    def _held(self, family: Products, sd: np.ndarray) -> tuple[np.ndarray, float]:
        """Step (n + p,) and the square that it leaves with coefficients of prior ``sd`` (p,)."""
        a, b = self._normal(family)
        n, far = len(self._b), np.full(len(sd), np.inf)
        a[range(n, len(a)), range(n, len(a))] += 1 / sd**2
        lower, upper = np.concatenate([self._lower, -far]), np.concatenate([self._upper, far])
        return solved(a, b, lower, upper, self._square)


class _Spread:
    """A family beside free parameters of the base, along the directions in which its coefficients act apart.

    For normal matrix (n, n) and slope (n,) of the base.
    """

    def __init__(self, a: np.ndarray, b: np.ndarray, family: Products, weights: np.ndarray):
        solution = np.linalg.solve(a, np.column_stack([family.across, b]))
        self._by_family, self._by_base = solution[:, :-1], solution[:, -1]
        beyond = family.own - family.across.T @ self._by_family
        shares, self._directions = np.linalg.eigh(weights[:, None] * beyond * weights)
        # rounding alone makes one of them negative
        self.shares = np.maximum(shares, 0.0)
        slope = family.slope - family.across.T @ self._by_base
        self._slope, self._weights = self._directions.T @ (weights * slope), weights
        # what the base takes from the square by itself
        self._alone = float(b @ self._by_base)

    def left(self, scales: np.ndarray, square: float) -> np.ndarray:
        """Squares (s,) that are left of a square, coefficients and their prior counted."""
        s2 = scales[:, None] ** 2
        gained = np.sum(s2 * self._slope**2 / (1 + s2 * self.shares), axis=1)
        return np.asarray(square - self._alone - gained)

    def steps(self, scales: np.ndarray) -> np.ndarray:
        """Steps (s, n) of the base."""
        s2 = scales[:, None] ** 2
        coefficients = -(s2 * self._slope / (1 + s2 * self.shares)) @ self._directions.T * self._weights
        return np.asarray(-(self._by_base + coefficients @ self._by_family.T))
