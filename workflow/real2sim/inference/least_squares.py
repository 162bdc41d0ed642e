"""Bounded least squares on ln-parameters: far fewer evaluations than CMA-ES to the same optimum.

The cost is a sum of squares, so its slope and most of its curvature come from one Jacobian, and a Jacobian by finite
differences is one batch of 13 replays. A few log-uniform points are tried first; the best of them starts a trust-region
search (scipy.optimize.least_squares, Branch, Coleman & Li 1999).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.linalg import solve_triangular
from scipy.optimize import least_squares, lsq_linear

from real2sim.inference.parameters import Bounds
from real2sim.inference.result import SearchResult

# Finite-difference step in ln-parameters: truncation and round-off of a replay balance over a wide range around it
STEP = 1e-4
# Rounds in which steps are held at bounds and let go, before scipy takes over, and what it adds to curvatures of 1
_EXCHANGES, _RIDGE = 10, 1e-12
# Residual that stands for each one of a simulation that failed
_FAILED = 1e3


@dataclass(frozen=True)
class Tangent:
    """Residuals (n_r,) at a point (n,) and their Jacobian (n_r, n) there."""

    z: np.ndarray
    residuals: np.ndarray
    jacobian: np.ndarray


class Residuals:
    """Residuals and Jacobian of a trial in ln-parameters, in batches, with the evaluations counted.

    ``residuals`` maps parameters (m, 12) to (m, n_r), whose sum of squares is the cost; ``batch`` is the most that it
    takes at once.
    """

    def __init__(self, residuals: Callable[[np.ndarray], np.ndarray], bounds: Bounds, batch: int):
        self._residuals, self._batch = residuals, batch
        self.lower, self.upper = np.log(bounds.lower), np.log(bounds.upper)
        self.evaluations = 0

    def many(self, z: np.ndarray) -> np.ndarray:
        """Return residuals (m, n_r) of ln-parameters (m, 12)."""
        self.evaluations += len(z)
        parts = [self._residuals(np.exp(z[i : i + self._batch])) for i in range(0, len(z), self._batch)]
        return np.concatenate(parts)

    def costs(self, z: np.ndarray) -> np.ndarray:
        """Return the costs (m,) of ln-parameters (m, 12); infinite where a simulation failed."""
        cost = np.array([np.sum(r * r) for r in self.many(z)])
        return np.where(np.isfinite(cost), cost, np.inf)

    def with_jacobian(self, z: np.ndarray, free: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return residuals (n_r,) and forward-difference Jacobian (n_r, k) by the k free ln-parameters at z (12,).

        Where the neighbour of a simulation fails, the other neighbour is asked; where both fail, the column is zero and
        the search leaves that parameter alone.
        """
        points, step = self._neighbours(z, free)
        out = self.many(np.vstack([z, points]))
        return out[0], self._slopes(z, free, out[0], out[1:], step)

    def jacobian(self, z: np.ndarray, r: np.ndarray, free: np.ndarray) -> np.ndarray:
        """Return the Jacobian of `with_jacobian` where the residuals ``r`` (n_r,) at z are known."""
        if len(free) == 0:
            return np.empty((len(r), 0))
        points, step = self._neighbours(z, free)
        return self._slopes(z, free, r, self.many(points), step)

    def _neighbours(self, z: np.ndarray, free: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        step = np.where(z + STEP > self.upper, -STEP, STEP)[free]
        points = np.tile(z, (len(free), 1))
        points[np.arange(len(free)), free] += step
        return points, step

    def _slopes(
        self, z: np.ndarray, free: np.ndarray, r: np.ndarray, out: np.ndarray, step: np.ndarray
    ) -> np.ndarray:
        failed = ~np.isfinite(out).all(axis=1)
        if np.isfinite(r).all() and failed.any():
            other = np.tile(z, (int(failed.sum()), 1))
            other[np.arange(len(other)), free[failed]] -= step[failed]
            out[failed], step[failed] = self.many(other), -step[failed]
            out = np.where(np.isfinite(out).all(axis=1)[:, None], out, r)
        return np.asarray(((out - r) / step[:, None]).T)


def minimise(
    residuals: Residuals,
    start: np.ndarray,
    free: np.ndarray,
    *,
    iterations: int,
    ftol: float,
    keep: float = 0.0,
    known: Tangent | None = None,
) -> tuple[np.ndarray, float, list[tuple[int, float]], int]:
    """Minimise the sum of squares from ln-parameters (12,), of which those listed in ``free`` move (trust region).

    As long as the Jacobian predicts the residuals of a step to a share ``keep`` of their change, it is updated (Broyden
    1965) instead of taken anew; 0 takes it anew at every step. ``known`` is a Jacobian taken before near the start, to
    go on from as if the search had begun there. Returns the best point, its cost, (evaluations, best cost) per
    iteration and scipy's status.
    """
    problem = _Visited(residuals, start, free, keep, known)
    lower, upper = residuals.lower[free], residuals.upper[free]
    margin = np.minimum(1e-6, (upper - lower) / 4)
    solution = least_squares(
        problem.value,
        np.clip(start[free], lower + margin, upper - margin),
        jac=problem.slope,
        bounds=(lower, upper),
        method="trf",
        ftol=ftol,
        xtol=1e-6,
        gtol=1e-10,
        max_nfev=iterations,
    )
    problem.history.append((residuals.evaluations, problem.best_cost))
    return problem.best_z, problem.best_cost, problem.history, int(solution.status)


def bounded_step(normal: np.ndarray, slope: np.ndarray, lower: np.ndarray, upper: np.ndarray) -> np.ndarray:
    """Return the Gauss-Newton step (n,) that minimises s'Ns + 2 b's inside bounds (n,) each, which hold zero.

    ``normal`` (n, n) is N, positive definite, and ``slope`` (n,) b. Steps that meet a bound are held there and let go
    where the slope leads back inside; where that does not come to an end, scipy's BVLS solves it (Stark, Parker,
    Comput. Stat. 10 (1995) 129).
    """
    held, step = np.zeros(len(slope), bool), np.zeros(len(slope))
    for _ in range(_EXCHANGES):
        free = ~held
        step[free] = -np.linalg.solve(
            normal[np.ix_(free, free)], slope[free] + normal[np.ix_(free, held)] @ step[held]
        )
        outside = free & ((step < lower) | (step > upper))
        step = np.clip(step, lower, upper)
        if outside.any():
            held |= outside
            continue
        back = held & _leads_inside(normal, slope, step, lower, upper)
        if not back.any():
            return step
        held &= ~back
    return _bvls(normal, slope, lower, upper)


def _leads_inside(
    normal: np.ndarray, slope: np.ndarray, step: np.ndarray, lower: np.ndarray, upper: np.ndarray
) -> np.ndarray:
    """Return of each coordinate (n,) of a step whether the square falls on its way inside from a bound."""
    uphill = normal @ step + slope
    rounding = 1e-12 * (np.abs(normal) @ np.abs(step) + np.abs(slope))
    inside = ((step <= lower) & (uphill < -rounding)) | ((step >= upper) & (uphill > rounding))
    return np.asarray(inside)


def _bvls(normal: np.ndarray, slope: np.ndarray, lower: np.ndarray, upper: np.ndarray) -> np.ndarray:
    """Return the same by scipy, which asks for bounds that leave room."""
    step, room = np.clip(np.zeros(len(slope)), lower, upper), upper > lower
    # coordinates of one curvature: those of laws and of parameters are many powers of ten apart
    unit = np.sqrt(np.diag(normal)[room])
    scaled = normal[np.ix_(room, room)] / np.outer(unit, unit)
    factor = np.linalg.cholesky(scaled + _RIDGE * np.eye(len(unit)))
    target = solve_triangular(factor, -(slope + normal @ (step * ~room))[room] / unit, lower=True)
    bounds = lower[room] * unit, upper[room] * unit
    step[room] = lsq_linear(factor.T, target, bounds, method="bvls", max_iter=10 * len(unit)).x / unit
    return np.asarray(np.clip(step, lower, upper))


class _Visited:
    """Residuals and Jacobian as scipy asks for them, with the best point visited and (evaluations, best cost) so far.

    Arguments as of `minimise`.
    """

    def __init__(
        self, residuals: Residuals, start: np.ndarray, free: np.ndarray, keep: float, known: Tangent | None
    ):
        self._residuals, self._start, self._free, self._keep = residuals, start, free, keep
        self.best_z, self.best_cost = start, np.inf
        self.history: list[tuple[int, float]] = []
        self._asked: tuple[np.ndarray, np.ndarray] = (np.empty(0), np.empty(0))
        self._last = (
            None if known is None else Tangent(known.z[free], known.residuals, known.jacobian[:, free])
        )

    def _at(self, x: np.ndarray) -> np.ndarray:
        z = self._start.copy()
        z[self._free] = x
        return z

    def value(self, x: np.ndarray) -> np.ndarray:
        """Return the residuals (n_r,) at the free ln-parameters x (k,)."""
        z = self._at(x)
        r: np.ndarray = self._residuals.many(z[None])[0]
        cost = float(np.sum(r * r))
        if not np.isfinite(cost):
            # a step into a simulation that fails: so bad that the trust region shrinks
            r = np.full_like(r, _FAILED)
        elif cost < self.best_cost:
            self.best_z, self.best_cost = z, cost
        self._asked = x.copy(), r
        self.history.append((self._residuals.evaluations, self.best_cost))
        return r

    def slope(self, x: np.ndarray) -> np.ndarray:
        """Return the Jacobian (n_r, k) by the free ln-parameters at x (k,)."""
        # scipy asks for the slope where it last asked for the value
        r = self._asked[1] if np.array_equal(self._asked[0], x) else self.value(x)
        jacobian = _updated(self._last, x, r, self._keep)
        if jacobian is None and np.all(r == _FAILED):
            jacobian = np.zeros((len(r), len(self._free)))
        elif jacobian is None:
            jacobian = self._residuals.jacobian(self._at(x), r, self._free)
        self._last = Tangent(x.copy(), r, jacobian)
        return jacobian


def _updated(last: Tangent | None, x: np.ndarray, r: np.ndarray, keep: float) -> np.ndarray | None:
    """Return the last point's Jacobian with a secant of rank one; None where it predicted the residuals too badly."""
    if last is None or keep <= 0:
        return None
    step = x - last.z
    predicted = last.jacobian @ step
    missed = r - last.residuals - predicted
    if step @ step == 0 or np.linalg.norm(missed) > keep * np.linalg.norm(predicted):
        return None
    return np.asarray(last.jacobian + np.outer(missed, step / (step @ step)))


def search(
    residuals: Callable[[np.ndarray], np.ndarray],
    bounds: Bounds,
    *,
    batch: int,
    screen: int,
    iterations: int,
    ftol: float,
    seed: int,
    progress: Callable[[int, float], None] | None = None,
) -> SearchResult:
    """Minimise a sum of squares from the best of a few log-uniform points.

    Parameters
    ----------
    residuals
        Maps parameters (m, 12), m <= batch, to residuals (m, n_r).
    batch
        Replays per call.
    screen
        Log-uniform points tried before the search starts from the best of them.
    iterations, ftol
        Most iterations, and the relative change of the cost at which the search ends.
    seed
        Of the points: same seed, same result.
    progress
        Called with the evaluations done and the best cost at the end.
    """
    problem = Residuals(residuals, bounds, batch)
    rng = np.random.default_rng(seed)
    points = np.array([bounds.log_uniform(rng) for _ in range(screen)])
    costs = problem.costs(points)
    start = points[int(np.argmin(costs))]
    screened = (problem.evaluations, float(costs.min()))
    z, cost, history, status = minimise(problem, start, np.arange(12), iterations=iterations, ftol=ftol)
    if progress is not None:
        progress(problem.evaluations, cost)
    # where no screened point could be simulated there is no best cost yet
    steps = [(n, min(c, screened[1])) for n, c in (screened, *history) if np.isfinite(min(c, screened[1]))]
    return SearchResult(
        np.exp(z),
        cost,
        problem.evaluations,
        np.exp(start),
        {"evaluations": [n for n, _ in steps], "best": [c for _, c in steps]},
        {"least_squares_status": float(status)},
    )
