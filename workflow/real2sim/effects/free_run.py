"""Free runs: simulations in which a force that depends on the interface's motion follows the simulated motion.

A force that is planned from the recorded motion of the interface has been told the answer: whatever pulled is in that
motion, and a law of it can repeat a force that has nothing to do with it. What a law explains is what a simulation
shows that knows the motion of the driven segment alone (simulation error against equation error: Ljung, System
Identification, 2nd ed. 1999, sections 3.2 and 7.2).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from real2sim import signals
from real2sim.effects.base import Placed, Scales
from real2sim.effects.chains import Context
from real2sim.geometry import rotation_xyz

# Most simulations of one free run, all of which the next plan is made of: a law three times as stiff as the strap takes
# 13, usual ones 4 to 8. How far plan and simulation may differ in the end, as a share of a large excursion (RMS over
# axes and samples): about a tenth of the noise of markers
_MOST, _APART = 20, 1e-3


class _NoSimulationError(Exception):
    """MuJoCo gave up on a simulation, or it went to infinity."""


def feed_back(effects: Sequence[Placed]) -> bool:
    """Return whether a planned force of one of the effects depends on the interface's own motion."""
    return any(placed.effect.plant.feeds_back for placed in effects)


class FreeRuns:
    """The free run of a replay, whose class says how to simulate and how the interface moved.

    ``effects``, ``_context`` and ``_scales`` are the replay's; forces are planned from ``_context``. ``planned_from``
    is the context that those of the last free run were planned from, or that `plan_from` asked for.
    """

    effects: Sequence[Placed]
    _context: Context
    _scales: Scales
    planned_from: Context
    # whether `_context` is already that of a free run
    _follows = False

    def run_effects(self, parameters: np.ndarray, x: Sequence[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
        """Simulate parameters (m, n) with searched numbers (m, p) of each effect; see the replay."""
        raise NotImplementedError

    def _motion(self) -> np.ndarray:
        """Simulated motion (n, axes) [m, rad] of the interface in the last call's first simulation."""
        raise NotImplementedError

    def plan_from(self, motion: np.ndarray) -> None:
        """Plan forces from the motion (n, axes) [m, rad] of a free run instead of the recorded one from now on.

        The next free run begins with it.
        """
        self._context = self.planned_from = self._moved(self._context, motion)
        self._follows = True

    def _moved(self, recorded: Context, motion: np.ndarray) -> Context:
        """Context of a trial whose interface moves otherwise, motion (n, axes) [m, rad]."""
        return with_motion(recorded, motion)

    def run_freely(self, parameters: np.ndarray, x: Sequence[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
        """As `run_effects` of one point (1, n), planned forces following the simulated motion.

        NaN where no motion is found that agrees with the forces that are planned from it.
        """
        recorded = self._context
        without = [
            0 * part if placed.effect.plant.feeds_back else part
            for placed, part in zip(self.effects, x, strict=True)
        ]

        def simulated(motion: np.ndarray) -> np.ndarray:
            self._context = self._moved(recorded, motion)
            self.run_effects(parameters, x)
            return self._motion()

        try:
            start = recorded.coordinates
            if not self._follows:
                # begun without the law: what was recorded agrees with whatever repeats it
                self.run_effects(parameters, without)
                start = self._motion()
            motion = settled(simulated, start, self._scales.q)
            self.planned_from = recorded if motion is None else self._moved(recorded, motion)
            self._context = self.planned_from
            paths, joints = self.run_effects(parameters, x)
        finally:
            self._context = recorded
        if motion is None:
            return np.full_like(paths, np.nan), np.full_like(joints, np.nan)
        return paths, joints


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
        difference = np.asarray((there / scale).ravel() - motion)
        if not np.isfinite(difference @ difference):
            raise _NoSimulationError
        return difference

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
    except (NoConvergence, _NoSimulationError):
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
