"""Continuous two-segment regression with a free breakpoint, and a test that the breakpoint exists.

The model is y = a[g] + b[g] x + d max(0, x - c), with a straight line for each group g (a person), and the change of
slope d and the breakpoint c shared. Were the slope shared too, people with different slopes would bend the residuals,
and their differences would pass for a breakpoint. Given c it is linear, so the reduction of the sum of squares against
straight lines is closed form in c: r(c) = (h.y)^2 / (h.h), with h the hinge max(0, x - c) after projection off the
lines.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.optimize import minimize_scalar

GRID_POINTS = 401


@dataclass(frozen=True)
class PiecewiseFit:
    """Breakpoint in x, slopes k1 (below) and k2 (above), and the value at the breakpoint (means over groups).

    ``sse`` and ``sse_line`` are residual sums of squares with and without it; ``f`` is the sup-F
    statistic with the degrees of freedom of a known breakpoint.
    """

    breakpoint: float
    slope_1: float
    slope_2: float
    value_at_breakpoint: float
    sse: float
    sse_line: float
    f: float
    n: int

    def predict(self, x: np.ndarray) -> np.ndarray:
        """Return the fitted curve at x, an array of any shape, with the mean line of the groups."""
        d = np.asarray(x, float) - self.breakpoint
        return self.value_at_breakpoint + np.where(d < 0, self.slope_1, self.slope_2) * d


def _dummies(n: int, groups: np.ndarray | None) -> np.ndarray:
    labels = np.zeros(n, int) if groups is None else np.unique(np.asarray(groups), return_inverse=True)[1]
    return np.eye(labels.max() + 1)[labels]


def _candidates(x: np.ndarray) -> np.ndarray:
    """Grid of breakpoints that leave two distinct levels on either side, the outer ones included."""
    levels = np.unique(x)
    if len(levels) < 5:
        raise ValueError(f"a breakpoint needs five distinct levels, got {len(levels)}")
    return np.linspace(levels[1], levels[-2], GRID_POINTS)


def _lines(x: np.ndarray, dummies: np.ndarray) -> np.ndarray:
    """Columns (n, k) of a straight line for each group, of a constant where a group has one level."""
    slopes = dummies * x[:, None]
    sloped = [np.ptp(x[own > 0]) > 0 for own in dummies.T]
    return np.column_stack([dummies, slopes[:, sloped]])


def _off_line(x: np.ndarray, dummies: np.ndarray) -> np.ndarray:
    """Projector (n, n) onto what the groups' straight lines cannot explain."""
    q, _ = np.linalg.qr(_lines(x, dummies))
    return np.asarray(np.eye(len(x)) - q @ q.T)


def _unit_hinges(x: np.ndarray, off_line: np.ndarray, breakpoints: np.ndarray) -> np.ndarray:
    """Projected hinges (n, g) of unit length; zero where a hinge is a straight line."""
    hinges = off_line @ np.maximum(0.0, x[:, None] - breakpoints)
    length = np.linalg.norm(hinges, axis=0)
    usable = length > 1e-9 * np.ptp(x)
    return np.asarray(hinges / np.where(usable, length, np.inf))


def fit_piecewise(x: np.ndarray, y: np.ndarray, groups: np.ndarray | None = None) -> PiecewiseFit:
    """Least squares over breakpoint and slopes: a grid, then a local search around its best point.

    ``x``, ``y`` (n,); ``groups`` (n,) labels with a straight line each. Raises ValueError below five levels of x.
    """
    x, y = np.asarray(x, float), np.asarray(y, float)
    dummies = _dummies(len(x), groups)
    off_line, grid = _off_line(x, dummies), _candidates(x)
    reductions = (y @ _unit_hinges(x, off_line, grid)) ** 2
    best = int(np.argmax(reductions))
    around = (grid[max(best - 1, 0)], grid[min(best + 1, len(grid) - 1)])
    local = minimize_scalar(
        lambda c: -float((y @ _unit_hinges(x, off_line, np.array([c])))[0] ** 2),
        bounds=around,
        method="bounded",
        options={"xatol": 1e-10 * np.ptp(x)},
    )
    c = float(local.x) if -local.fun > reductions[best] else float(grid[best])
    lines, k = _lines(x - c, dummies), dummies.shape[1]
    design = np.column_stack([lines, np.maximum(0.0, x - c)])
    beta = np.linalg.lstsq(design, y, rcond=None)[0]
    slope = float(beta[k:-1].mean())
    sse = float(np.sum((y - design @ beta) ** 2))
    sse_line = float(np.sum((off_line @ y) ** 2))
    freedom = len(x) - design.shape[1]
    # Exact data leave no residual; the statistic is then as large as rounding allows.
    floor = np.finfo(float).eps * max(float(np.sum(y**2)), np.finfo(float).tiny)
    f = max(sse_line - sse, 0.0) / max(sse / freedom, floor)
    return PiecewiseFit(c, slope, slope + float(beta[-1]), float(beta[:k].mean()), sse, sse_line, f, len(x))


def _shuffled(size: int, labels: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Row orders (size, n) that permute within each group only."""
    order = np.tile(np.arange(len(labels)), (size, 1))
    for label in np.unique(labels):
        rows = np.flatnonzero(labels == label)
        order[:, rows] = rng.permuted(np.tile(rows, (size, 1)), axis=1)
    return order


def breakpoint_p_value(
    x: np.ndarray, y: np.ndarray, groups: np.ndarray | None = None, *, permutations: int, seed: int
) -> float:
    """Return the permutation p-value of sup-F of a breakpoint against straight lines, for x, y and groups (n,).

    Residuals of each group's straight line are permuted within groups (Freedman & Lane 1983) and the largest reduction
    over the grid is compared: the search over breakpoints is part of the null distribution (Andrews 1993).
    """
    x, y = np.asarray(x, float), np.asarray(y, float)
    dummies = _dummies(len(x), groups)
    off_line = _off_line(x, dummies)
    unit = _unit_hinges(x, off_line, _candidates(x))
    residual = off_line @ y
    scale = np.sum(residual**2)
    if scale <= 1e-24 * max(float(np.sum(y**2)), np.finfo(float).tiny):
        return 1.0
    observed = np.max((residual @ unit) ** 2) / scale
    order = _shuffled(permutations, np.argmax(dummies, axis=1), np.random.default_rng(seed))
    permuted = residual[order] @ off_line
    null = np.max((permuted @ unit) ** 2, axis=1) / np.sum(permuted**2, axis=1)
    return float((1 + np.sum(null >= observed * (1 - 1e-12))) / (1 + permutations))


def _percentiles(values: np.ndarray, confidence: float) -> tuple[float, float]:
    low, high = np.quantile(values, [(1 - confidence) / 2, (1 + confidence) / 2])
    return float(low), float(high)


def breakpoint_interval(
    x: np.ndarray,
    y: np.ndarray,
    groups: np.ndarray | None = None,
    *,
    bootstrap: int,
    seed: int,
    confidence: float,
) -> tuple[float, float]:
    """Percentile interval of the breakpoint by resampling the residuals of the two-segment fit.

    ``x``, ``y`` and ``groups`` (n,). Residuals are inflated by sqrt(n / (n - parameters)). Resolution: 1/400 of the
    range searched.
    """
    x, y = np.asarray(x, float), np.asarray(y, float)
    dummies, grid = _dummies(len(x), groups), _candidates(x)
    fit = fit_piecewise(x, y, groups)
    hinge = np.maximum(0.0, x - fit.breakpoint)
    design = np.column_stack([_lines(x, dummies), hinge])
    fitted = design @ np.linalg.lstsq(design, y, rcond=None)[0]
    residual = (y - fitted) * np.sqrt(len(x) / (len(x) - design.shape[1] - 1))
    draws = np.random.default_rng(seed).integers(0, len(x), (bootstrap, len(x)))
    samples = fitted + residual[draws]
    unit = _unit_hinges(x, _off_line(x, dummies), grid)
    return _percentiles(grid[np.argmax((samples @ unit) ** 2, axis=1)], confidence)


def _within_products(
    x: np.ndarray, y: np.ndarray, dummies: np.ndarray, grid: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return h.h and h.y (groups, grid) of the hinges after projection off each group's straight line."""
    off_line = _off_line(x, dummies)
    hinges = off_line @ np.maximum(0.0, x[:, None] - grid)
    return dummies.T @ hinges**2, dummies.T @ (hinges * y[:, None])


def breakpoint_interval_by_group(
    x: np.ndarray, y: np.ndarray, groups: np.ndarray, *, bootstrap: int, seed: int, confidence: float
) -> tuple[float, float]:
    """Return the percentile interval of the shared breakpoint of x, y (n,), resampling whole groups (n,), persons.

    Resamples of people none of whom can show a bend are left out; NaN where all are.
    """
    x, y = np.asarray(x, float), np.asarray(y, float)
    dummies, grid = _dummies(len(x), groups), _candidates(x)
    k = dummies.shape[1]
    draws = np.random.default_rng(seed).multinomial(k, np.full(k, 1 / k), size=bootstrap).astype(float)
    length, along = (draws @ products for products in _within_products(x, y, dummies, grid))
    usable = length > 1e-12 * np.ptp(x) ** 2
    reduction = along**2 / np.where(usable, length, np.inf)
    told = usable.any(axis=1)
    if not told.any():
        return np.nan, np.nan
    return _percentiles(grid[np.argmax(reduction[told], axis=1)], confidence)
