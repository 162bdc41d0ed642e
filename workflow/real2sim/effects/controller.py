"""Forces of a robot's controller that answers what the strap does to it, or where the base is.

Such a force rests on the motion that it makes. The simulation is run in short windows, and what is fed in during the
next one is made of what was heard up to there: with a delay of a window or more that is exact.
"""

from __future__ import annotations

from typing import Protocol

import numpy as np


class Law(Protocol):
    """Force of a controller on the base, of some simulations side by side; made of values, `before` and the step.

    ``hears`` is "strap", the strap's force on the interface along world x and y, or "base", where the base is from its
    start along x, y and about z. ``before`` (m, j) [N, world | m, rad] is what was heard until the trial began.
    """

    hears: str
    delay: np.ndarray

    def __init__(self, values: np.ndarray, before: np.ndarray, step_s: float): ...

    def force(self, heard: np.ndarray, *, keep: bool) -> np.ndarray:
        """Forces (m, w, j) [N, Nm] of the next w steps in which ``heard`` (m, w, j) is heard.

        With ``keep`` the next call goes on from there.
        """


class Reaction:
    """F = g y, T y' = pull - y: values (m, 3) are gain, delay [s] and smoothing T [s]."""

    hears = "strap"

    def __init__(self, values: np.ndarray, before: np.ndarray, step_s: float):
        self._gain, self.delay, smoothing = values.T
        self._felt = _LowPass(smoothing, before, step_s)

    def force(self, heard, *, keep):
        """Of `Law`."""
        return self._gain[:, None, None] * self._felt(heard, keep=keep)


class Admittance:
    """F = g y + r I, T y' = pull - y, I' = y - I / leak: values (m, 6) are g and r by axis, leak [s] and T [s].

    What was pulled before has leaked away or is part of where the controller holds.
    """

    hears = "strap"

    def __init__(self, values: np.ndarray, before: np.ndarray, step_s: float):
        self.delay = np.zeros(len(values))
        self._gains, self._rates = values[:, None, :2], values[:, None, 2:4]
        self._before = before[:, None]
        self._felt = _LowPass(values[:, 5], before, step_s)
        # a leaky integral is a low-pass times its time constant
        self._leak = values[:, 4, None, None]
        self._kept = _LowPass(values[:, 4], np.zeros_like(before), step_s)

    def force(self, heard, *, keep):
        """Of `Law`."""
        felt = self._felt(heard, keep=keep)
        return self._gains * felt + self._rates * self._leak * self._kept(felt - self._before, keep=keep)


# Power by which a limited integral takes in the less, the fuller it is: a limit that shows itself before it is met
_WINDUP = 4


class HoldIntegral:
    """F' = -r x up to a limit, values (m, 6) are r [N/(m s), Nm/(rad s)] and limits [N, Nm] by joint of the base.

    The integral term of a controller that holds the base, whose windup ends. What it had gathered before the trial is
    part of where the controller holds.
    """

    hears = "base"

    def __init__(self, values: np.ndarray, before: np.ndarray, step_s: float):
        self.delay = np.zeros(len(values))
        self._change, self._limit = -values[:, :3] * step_s, values[:, 3:]
        self._state = np.zeros_like(before)

    def force(self, heard, *, keep):
        """Of `Law`."""
        out, state = np.empty_like(heard), self._state
        for k in range(heard.shape[1]):
            step = self._change * heard[:, k]
            full = (state / self._limit) ** _WINDUP * (step * state > 0)
            state = state + step * np.maximum(1 - full, 0.0)
            out[:, k] = state
        if keep:
            self._state = state
        return out


class _LowPass:
    """First order, of time constants (m,) [s], step by step on rows (m, w, 2)."""

    def __init__(self, time_s: np.ndarray, state: np.ndarray, step_s: float):
        self._decay, self._state = np.exp(-step_s / np.maximum(time_s, 1e-9))[:, None], state

    def __call__(self, rows: np.ndarray, *, keep: bool) -> np.ndarray:
        out, state = np.empty_like(rows), self._state
        for k in range(rows.shape[1]):
            state = self._decay * state + (1 - self._decay) * rows[:, k]
            out[:, k] = state
        if keep:
            self._state = state
        return out


class Answer:
    """The force of one controller in the course of a simulation of ``steps`` steps; it hears what its law does."""

    def __init__(self, law: Law, before: np.ndarray, step_s: float, steps: int):
        self._law, self._before = law, before
        self.hears = law.hears
        self._delay = law.delay[:, None] / step_s
        self._heard = np.empty((len(before), steps, before.shape[1]))
        self._known = 0

    def plan(self, count: int) -> np.ndarray:
        """Forces (m, count, j) [N, Nm] of the next steps, what is heard taken to go straight on."""
        return self._law.force(self._late(self._known, count), keep=False)

    def learn(self, heard: np.ndarray) -> None:
        """Go on by what was heard (m, w, j) in these steps."""
        first, count = self._known, heard.shape[1]
        self._known += count
        self._heard[:, first : self._known] = heard
        self._law.force(self._late(first, count), keep=True)

    def _late(self, first: int, count: int) -> np.ndarray:
        """What the controller hears in ``count`` steps from ``first`` on, (m, count, j)."""
        at = first + np.arange(count) - self._delay
        last = self._known - 1
        if last < 1:
            return np.repeat(self._before[:, None], count, axis=1)
        row = np.arange(len(at))[:, None]
        low = np.clip(np.floor(at).astype(int), 0, last - 1)
        here, share = self._heard[row, low], (at - low)[..., None]
        heard = here + np.minimum(share, 1) * (self._heard[row, low + 1] - here)
        if at.max() > last:
            # a slope over as long as it is to go on: that of the last step is the step's own noise
            back = min(count, last)
            slope = (self._heard[:, last] - self._heard[:, last - back]) / back
            heard += np.maximum(at - last, 0)[..., None] * slope[:, None]
        return np.where(at[..., None] < 0, self._before[:, None], heard)
