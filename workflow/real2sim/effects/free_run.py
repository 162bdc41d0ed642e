"""Free runs: simulations in which a force that depends on the interface's motion follows the simulated motion.

A force that is planned from the recorded motion of the interface has been told the answer: whatever pulled is in that
motion, and a law of it can repeat a force that has nothing to do with it. What a law explains is what a simulation
shows that knows the motion of the driven segment alone (simulation error against equation error: Ljung, System
Identification, 2nd ed. 1999, sections 3.2 and 7.2).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from real2sim import signals
from real2sim.effects.base import Placed
from real2sim.effects.chains import Context
from real2sim.geometry import rotation_xyz

# Most simulations of one free run, all of which the next plan is made of: a law three times as stiff as the strap takes
# 13, usual ones 4 to 8. How far plan and simulation may differ in the end, as a share of a large excursion (RMS over
# axes and samples): about a tenth of the noise of markers
_MOST, _APART = 20, 1e-3


class _NoSimulationError(Exception):
    """MuJoCo gave up on a simulation."""


def feed_back(effects: Sequence[Placed]) -> bool:
    """Return whether a planned force of one of the effects depends on the interface's own motion."""
    return any(placed.effect.plant.feeds_back for placed in effects)


@dataclass(frozen=True)
class Run:
    """One simulation: what is observed and the machine's joints, (1, n, ...) each, and the interface's ``motion``.

    The motion (n, axes) [m, rad] is the simulated one; planned forces were computed from ``context``.
    """

    paths: np.ndarray
    joints: np.ndarray
    motion: np.ndarray
    context: Context


def free_run(
    run: Callable[[Sequence[np.ndarray], Context], Run],
    recorded: Context,
    move: Callable[[Context, np.ndarray], Context],
    effects: Sequence[Placed],
    x: Sequence[np.ndarray],
    scale: np.ndarray,
) -> Run:
    """Return the simulation whose planned forces follow the motion that they lead to, all NaN where there is none.

    Parameters
    ----------
    run
        Simulates with searched numbers of each effect and forces planned from a context.
    recorded
        Context of the recorded motion.
    move
        Returns a context whose interface moves by other coordinates (n, axes) [m, rad].
    effects, x
        Effects and their searched numbers (1, p) each.
    scale
        Large excursions (axes,) [m, rad].
    """
    quiet = [0 * part if p.effect.plant.feeds_back else part for p, part in zip(effects, x, strict=True)]
    # begun without the law: what was recorded agrees with whatever repeats it
    start = run(quiet, recorded).motion
    motion = settled(lambda motion: run(x, move(recorded, motion)).motion, start, scale)
    found = run(x, recorded if motion is None else move(recorded, motion))
    if motion is None:
        return replace(
            found, paths=np.full_like(found.paths, np.nan), joints=np.full_like(found.joints, np.nan)
        )
    return found


def settled(
    simulated: Callable[[np.ndarray], np.ndarray], start: np.ndarray, scale: np.ndarray
) -> np.ndarray | None:
    """Return the motion (n, axes) that planned forces are made of and that they lead to; None where there is none.

    Parameters
    ----------
    simulated
        Motion (n, axes) [m, rad] that forces planned from another one lead to, NaN where it cannot be simulated.
    start
        Motion (n, axes) to begin with: one that has not been told what was recorded.
    scale
        Large excursions (axes,) [m, rad].
    """
    from scipy.optimize import NoConvergence, anderson

    def apart(motion: np.ndarray) -> np.ndarray:
        there = simulated(motion.reshape(start.shape) * scale)
        if not np.isfinite(there).all():
            raise _NoSimulationError
        return np.asarray((there / scale).ravel() - motion)

    def rms(difference: np.ndarray) -> float:
        return float(np.sqrt(np.mean(np.square(difference))))

    try:
        found = anderson(
            apart,
            (start / scale).ravel(),
            alpha=1.0,
            M=_MOST,
            maxiter=_MOST,
            f_tol=_APART,
            tol_norm=rms,
            line_search=None,
        )
    except (NoConvergence, _NoSimulationError, np.linalg.LinAlgError, ValueError):
        return None
    return np.asarray(found.reshape(start.shape) * scale)


def with_motion(context: Context, coordinates: np.ndarray) -> Context:
    """Return a context whose interface moves by other coordinates (n, axes) [m, rad]."""
    rate = float(1 / (context.time_s[1] - context.time_s[0]))
    return replace(context, coordinates=coordinates, rates=signals.derivative(coordinates, rate))


def with_strap_motion(context: Context, coordinates: np.ndarray) -> Context:
    """Return a context with other coordinates (n, 6) [m, rad] of a strap; its markers and rotation follow."""
    r, before, after = context.pelvis_rotation, context.coordinates, coordinates
    turned = rotation_xyz(after[:, 3:]) @ rotation_xyz(before[:, 3:]).swapaxes(1, 2)
    moved = np.einsum("nij,nj->ni", r, after[:, :3] - before[:, :3])
    return replace(
        with_motion(context, coordinates),
        measured=context.measured + moved[:, None],
        interface_rotation=r @ turned @ r.swapaxes(1, 2) @ context.interface_rotation,
    )
