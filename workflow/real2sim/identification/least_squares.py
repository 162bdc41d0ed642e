"""Bounded least squares on ln-parameters: far fewer evaluations than CMA-ES to the same optimum.

The cost is a sum of squares, so its slope and most of its curvature come from one Jacobian, and a Jacobian by finite
differences is one batch of 13 replays. A few log-uniform points are tried first; the best of them starts a trust-region
search (scipy.optimize.least_squares, Branch, Coleman & Li 1999).
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy.optimize import least_squares

from real2sim.identification.parameters import Bounds
from real2sim.identification.result import SearchResult

# Finite-difference step in ln-parameters: truncation and round-off of a replay balance over a wide range around it
STEP = 1e-4


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
        """Residuals (m, n_r) of ln-parameters (m, 12)."""
        self.evaluations += len(z)
        parts = [self._residuals(np.exp(z[i : i + self._batch])) for i in range(0, len(z), self._batch)]
        return np.concatenate(parts)

    def costs(self, z: np.ndarray) -> np.ndarray:
        """Costs (m,) of ln-parameters (m, 12); infinite where a simulation failed."""
        cost = np.array([np.sum(r * r) for r in self.many(z)])
        return np.where(np.isfinite(cost), cost, np.inf)

    def with_jacobian(self, z: np.ndarray, free: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Residuals (n_r,) and forward-difference Jacobian (n_r, k) by the k free ln-parameters at z (12,).

        Where the neighbour of a simulation fails, the other neighbour is asked; where both fail, the column is zero and
        the search leaves that parameter alone.
        """
        step = np.where(z + STEP > self.upper, -STEP, STEP)[free]
        points = np.tile(z, (len(free) + 1, 1))
        points[np.arange(1, len(free) + 1), free] += step
        out = self.many(points)
        failed = ~np.isfinite(out[1:]).all(axis=1)
        if np.isfinite(out[0]).all() and failed.any():
            other = np.tile(z, (int(failed.sum()), 1))
            other[np.arange(len(other)), free[failed]] -= step[failed]
            out[1:][failed], step[failed] = self.many(other), -step[failed]
            out[1:] = np.where(np.isfinite(out[1:]).all(axis=1)[:, None], out[1:], out[0])
        return out[0], ((out[1:] - out[0]) / step[:, None]).T


def minimise(
    residuals: Residuals, start: np.ndarray, free: np.ndarray, *, iterations: int, ftol: float
) -> tuple[np.ndarray, float, list[tuple[int, float]], int]:
    """Trust-region search from ln-parameters (12,), of which those listed in ``free`` move.

    Returns the best point, its cost, (evaluations, best cost) per iteration and scipy's status.
    """
    memory: dict[bytes, tuple[np.ndarray, np.ndarray]] = {}
    history: list[tuple[int, float]] = []
    best_z, best_cost = start, np.inf

    def both(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        nonlocal best_z, best_cost
        key = x.tobytes()
        if key not in memory:
            memory.clear()
            z = start.copy()
            z[free] = x
            memory[key] = residuals.with_jacobian(z, free)
            cost = float(np.sum(memory[key][0] ** 2))
            if not np.isfinite(cost):
                # a step into a simulation that fails: so bad that the trust region shrinks
                memory[key] = np.full_like(memory[key][0], 1e3), np.zeros_like(memory[key][1])
            elif cost < best_cost:
                best_z, best_cost = z, cost
            history.append((residuals.evaluations, best_cost))
        return memory[key]

    margin = 1e-6
    lower, upper = residuals.lower[free], residuals.upper[free]
    solution = least_squares(
        lambda x: both(x)[0],
        np.clip(start[free], lower + margin, upper - margin),
        jac=lambda x: both(x)[1],
        bounds=(lower, upper),
        method="trf",
        ftol=ftol,
        xtol=1e-6,
        gtol=1e-10,
        max_nfev=iterations,
    )
    return best_z, best_cost, history, int(solution.status)


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
    steps = [screened, *history]
    return SearchResult(
        np.exp(z),
        cost,
        problem.evaluations,
        np.exp(start),
        {"evaluations": [n for n, _ in steps], "best": [min(c, screened[1]) for _, c in steps]},
        {"least_squares_status": float(status)},
    )
