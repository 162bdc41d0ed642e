"""What sensors show of simulations: output chains, and which simulations several hypotheses share.

An effect that changes only what the sensors show leaves the simulation as it is: points that differ in its numbers
alone need one simulation between them.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from real2sim.effects.base import Placed
from real2sim.effects.chains import Context

# Share of a change at which an output chain is asked for its slope: it may bend further out
_SMALL = 1e-3

# Paths (n, ...) and log (n, j) of a simulation before any output chain, and the values (1, p) of each effect
Unchained = tuple[np.ndarray, np.ndarray, list[np.ndarray]]


def simulations(
    effects: Sequence[Placed], parameters: np.ndarray, values: Sequence[np.ndarray]
) -> tuple[np.ndarray, np.ndarray]:
    """Return the first row (u,) of each different simulation, and which of them each row (m,) needs.

    For parameters (m, p) and values (m, q) of each effect.
    """
    acting = [v for placed, v in zip(effects, values, strict=True) if not placed.effect.only_seen]
    rows = np.hstack([parameters, *acting])
    _, first, which = np.unique(rows, axis=0, return_index=True, return_inverse=True)
    order = np.argsort(first)
    return first[order], np.argsort(order)[which.ravel()]


def chained(
    effects: Sequence[Placed],
    paths: np.ndarray,
    logs: np.ndarray,
    values: Sequence[np.ndarray],
    context: Context,
) -> tuple[np.ndarray, np.ndarray]:
    """Return simulated paths (m, n, ...) and logs (m, n, j) as output chains of effects with values (m, p) show them.

    Both are changed in place. What MuJoCo gave up on stays NaN, and the others are none the worse for it.
    """
    done = np.flatnonzero(np.isfinite(paths).reshape(len(paths), -1).all(axis=1))
    for placed, value in zip(effects, values, strict=True):
        chains = placed.effect.chains
        if chains.output is not None and len(done):
            paths[done] = chains.output(paths[done], value[done], context)
        if chains.log is not None and len(done):
            logs[done] = chains.log(logs[done], value[done], context)
    return paths, logs


def chained_slopes(
    effects: Sequence[Placed], first: Unchained, moved: tuple[np.ndarray, np.ndarray], context: Context
) -> tuple[np.ndarray, np.ndarray]:
    """Return small changes of paths (p, n, ...) and logs (p, n, j) of a simulation as output chains show them."""
    if not any(p.effect.chains.output or p.effect.chains.log for p in effects):
        return moved
    paths, logs, values = first
    here = chained(effects, paths[None].copy(), logs[None].copy(), values, context)
    count = len(moved[0])
    alike = [np.repeat(value, count, axis=0) for value in values]
    there = chained(effects, paths + _SMALL * moved[0], logs + _SMALL * moved[1], alike, context)
    return (there[0] - here[0]) / _SMALL, (there[1] - here[1]) / _SMALL
