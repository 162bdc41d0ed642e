"""Forces of a robot's controller that answers what the strap does to it.

Such a force rests on the motion that it makes. The simulation is run in short windows, and what is fed in during the
next one is made of the strap's force up to there: with a delay of a window or more that is exact.
"""

from __future__ import annotations

from typing import Protocol

import numpy as np


class Law(Protocol):
    """Force of a controller on the base, of some simulations side by side; made of values, `before` and the step.

    ``before`` (m, 2) [N, world] is what the strap did to the interface until the trial began.
    """

    delay: np.ndarray

    def __init__(self, values: np.ndarray, before: np.ndarray, step_s: float): ...

    def force(self, pull: np.ndarray, *, keep: bool) -> np.ndarray:
        """Forces (m, w, 2) [N] of the next w steps in which the strap pulls with ``pull``.

        With ``keep`` the next call goes on from there.
        """


class Reaction:
    """F = g y, T y' = pull - y: values (m, 3) are gain, delay [s] and smoothing T [s]."""

    def __init__(self, values: np.ndarray, before: np.ndarray, step_s: float):
        self._gain, self.delay, smoothing = values.T
        self._felt = _LowPass(smoothing, before, step_s)

    def force(self, pull, *, keep):
        """Of `Law`."""
        return self._gain[:, None, None] * self._felt(pull, keep=keep)


class Admittance:
    """F = g y + r I, T y' = pull - y, I' = y - I / leak: values (m, 6) are g and r by axis, leak [s] and T [s].

    What was pulled before has leaked away or is part of where the controller holds.
    """

    def __init__(self, values: np.ndarray, before: np.ndarray, step_s: float):
        self.delay = np.zeros(len(values))
        self._gains, self._rates = values[:, None, :2], values[:, None, 2:4]
        self._before = before[:, None]
        self._felt = _LowPass(values[:, 5], before, step_s)
        # a leaky integral is a low-pass times its time constant
        self._leak = values[:, 4, None, None]
        self._kept = _LowPass(values[:, 4], np.zeros_like(before), step_s)

    def force(self, pull, *, keep):
        """Of `Law`."""
        felt = self._felt(pull, keep=keep)
        return self._gains * felt + self._rates * self._leak * self._kept(felt - self._before, keep=keep)


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
    """The force of one controller in the course of a simulation of ``steps`` steps."""

    def __init__(self, law: Law, before: np.ndarray, step_s: float, steps: int):
        self._law, self._before = law, before
        self._delay = law.delay[:, None] / step_s
        self._pull = np.empty((len(before), steps, 2))
        self._known = 0

    def plan(self, count: int) -> np.ndarray:
        """Forces (m, count, 2) [N] of the next steps, the strap's force taken to go straight on."""
        return self._law.force(self._late(self._known, count), keep=False)

    def learn(self, pull: np.ndarray) -> None:
        """Go on by what the strap did (m, w, 2) [N, world] in these steps."""
        first, count = self._known, pull.shape[1]
        self._known += count
        self._pull[:, first : self._known] = pull
        self._law.force(self._late(first, count), keep=True)

    def _late(self, first: int, count: int) -> np.ndarray:
        """What the controller hears of the strap in ``count`` steps from ``first`` on, (m, count, 2)."""
        at = first + np.arange(count) - self._delay
        last = self._known - 1
        if last < 1:
            return np.repeat(self._before[:, None], count, axis=1)
        row = np.arange(len(at))[:, None]
        low = np.clip(np.floor(at).astype(int), 0, last - 1)
        here, share = self._pull[row, low], (at - low)[..., None]
        heard = here + np.minimum(share, 1) * (self._pull[row, low + 1] - here)
        if at.max() > last:
            # a slope over as long as it is to go on: that of the last step is the step's own noise
            back = min(count, last)
            slope = (self._pull[:, last] - self._pull[:, last - back]) / back
            heard += np.maximum(at - last, 0)[..., None] * slope[:, None]
        return np.where(at[..., None] < 0, self._before[:, None], heard)
