"""Forces of a robot's controller in answer to the force of the interface or the displacement of the base.

Such a force depends on the motion that it causes. The simulation is run in short windows, and the force of the next one
is computed from the input up to there: with a delay of a window or more that is exact.
"""

from __future__ import annotations

import numpy as np

from real2sim.effects.base import AtRest, Effect, EffectParameter, Law
from real2sim.effects.planned import DrivenForce
from real2sim.effects.robot import LOADS
from real2sim.system.description import BASE_JOINTS


class Reaction:
    """F = g y, T y' = pull - y: values (m, 3) are gain, delay [s] and smoothing T [s]."""

    hears = "interface"

    def __init__(self, values: np.ndarray, before: np.ndarray, step_s: float):
        self._gain, self.delay, smoothing = values.T
        self._felt = _LowPass(smoothing, before, step_s)

    def force(self, heard: np.ndarray, *, keep: bool) -> np.ndarray:
        """Return forces (m, w, 2) [N] for interface forces (m, w, 2) [N], see `Law`."""
        return np.asarray(self._gain[:, None, None] * self._felt(heard, keep=keep))


class Admittance:
    """F = g y + r I, T y' = pull - y, I' = y - I / leak: values (m, 6) are g and r by axis, leak [s] and T [s].

    The force before the trial has leaked away or is part of the controller's set-point.
    """

    hears = "interface"

    def __init__(self, values: np.ndarray, before: np.ndarray, step_s: float):
        self.delay = np.zeros(len(values))
        self._gains, self._rates = values[:, None, :2], values[:, None, 2:4]
        self._before = before[:, None]
        self._felt = _LowPass(values[:, 5], before, step_s)
        # a leaky integral is a low-pass times its time constant
        self._leak = values[:, 4, None, None]
        self._kept = _LowPass(values[:, 4], np.zeros_like(before), step_s)

    def force(self, heard: np.ndarray, *, keep: bool) -> np.ndarray:
        """Return forces (m, w, 2) [N] for interface forces (m, w, 2) [N], see `Law`."""
        felt = self._felt(heard, keep=keep)
        return np.asarray(
            self._gains * felt + self._rates * self._leak * self._kept(felt - self._before, keep=keep)
        )


# Power by which a limited integral takes in less, the fuller it is: the limit shows before it is reached
_WINDUP = 4


class HoldIntegral:
    """F' = -r x up to a limit, values (m, 6) are r [N/(m s), Nm/(rad s)] and limits [N, Nm] by joint of the base.

    The integral term of a controller that holds the base, with limited windup. Its state before the trial is part of
    the controller's set-point.
    """

    hears = "base"

    def __init__(self, values: np.ndarray, before: np.ndarray, step_s: float):
        self.delay = np.zeros(len(values))
        self._change, self._limit = -values[:, :3] * step_s, values[:, 3:]
        self._state = np.zeros_like(before)

    def force(self, heard: np.ndarray, *, keep: bool) -> np.ndarray:
        """Return forces (m, w, 3) [N, Nm] for displacements (m, w, 3) [m, rad] of the base, see `Law`."""
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
    """First order, of time constants (m,) [s], on rows (m, w, 2), all w steps at once."""

    def __init__(self, time_s: np.ndarray, state: np.ndarray, step_s: float):
        self._decay, self._state = np.exp(-step_s / np.maximum(time_s, 1e-9)), state
        # by number of steps: what is left of the state after each, and of the input of each step in each later one
        self._by_steps: dict[int, tuple[np.ndarray, np.ndarray]] = {}

    def __call__(self, rows: np.ndarray, *, keep: bool) -> np.ndarray:
        count = rows.shape[1]
        if count not in self._by_steps:
            self._by_steps[count] = self._weights(count)
        of_state, of_input = self._by_steps[count]
        out = of_input @ rows
        out += of_state * self._state[:, None]
        if keep:
            self._state = out[:, -1]
        return np.asarray(out)

    def _weights(self, count: int) -> tuple[np.ndarray, np.ndarray]:
        """Return weights of the state (m, count, 1) and of the input (m, count, count) in the output of each step."""
        decay, steps = self._decay[:, None], np.arange(count)
        later = steps[:, None] - steps
        of_input = np.where(
            later >= 0, (1 - decay[..., None]) * decay[..., None] ** np.maximum(later, 0), 0.0
        )
        return (decay ** (steps + 1))[..., None], of_input


class Answer:
    """The force of one controller in the course of a simulation of ``steps`` steps."""

    def __init__(self, law: Law, before: np.ndarray, step_s: float, steps: int):
        self._law, self._before = law, before[:, None]
        self.hears = law.hears
        self._delay = law.delay[:, None] / step_s
        self._at_once = not self._delay.any()
        self._heard = np.empty((len(before), steps, before.shape[1]))
        # rows one after the other, which one index reaches
        self._flat = self._heard.reshape(-1, before.shape[1])
        self._row = steps * np.arange(len(before))[:, None]
        self._known = 0

    @property
    def foreseen(self) -> int:
        """Return the number of steps whose force `plan` knows without extrapolation: those within the least delay."""
        return int(self._delay.min())

    def plan(self, count: int) -> np.ndarray:
        """Return forces (m, count, j) [N, Nm] of the next steps, the input extrapolated linearly."""
        return self._law.force(self._late(self._known, count), keep=False)

    def learn(self, heard: np.ndarray) -> None:
        """Go on by the input (m, w, j) of these steps."""
        first, count = self._known, heard.shape[1]
        self._known += count
        self._heard[:, first : self._known] = heard
        # what is heard at once is not looked up; of a single sample `_late` takes nothing
        at_once = self._at_once and self._known > 1
        self._law.force(heard if at_once else self._late(first, count), keep=True)

    def _late(self, first: int, count: int) -> np.ndarray:
        """Return the delayed input in ``count`` steps from ``first`` on, (m, count, j)."""
        last = self._known - 1
        if last < 1:
            return np.repeat(self._before, count, axis=1)
        if self._at_once and first > last:
            ahead = np.arange(first - last, first - last + count)[:, None]
            return np.asarray(self._heard[:, last, None] + ahead * self._slope(count)[:, None])
        at = np.arange(first, first + count) - self._delay
        low = np.minimum(np.maximum(np.floor(at).astype(int), 0), last - 1)
        share = np.minimum(at - low, 1)[..., None]
        low += self._row
        here = self._flat[low]
        low += 1
        heard = self._flat[low]
        heard -= here
        heard *= share
        heard += here
        if at.max() > last:
            heard += np.maximum(at - last, 0)[..., None] * self._slope(count)[:, None]
        early = at < 0
        return np.where(early[..., None], self._before, heard) if early.any() else heard

    def _slope(self, count: int) -> np.ndarray:
        """Return the slope (m, j) a step, over as many steps as are extrapolated: that of the last alone is noise."""
        last = self._known - 1
        back = min(count, last)
        return np.asarray((self._heard[:, last] - self._heard[:, last - back]) / back)


class AnsweringForce(DrivenForce):
    """Forces of a controller law on joints of the base, computed between the windows of a run."""

    kinds = ("place", "dissipative", "memory")

    def __init__(self, law: type[Law], joints: tuple[str, ...]):
        super().__init__(joints)
        self.law = law


EFFECTS = (
    Effect(
        "controller_reaction",
        "robot",
        "F_base = g y, T y' = F_interaction(t - delay) - y",
        (
            EffectParameter("gain", "1", -1.5, 4.0, (-0.3, 0.3)),
            EffectParameter("delay", "s", 0.0, 0.5, (0.1, 0.02)),
            EffectParameter("smoothing", "s", 0.0, 0.5, (0.0, 0.1)),
        ),
        separating_trial="the same motion with the controller off",
        at_rest=AtRest((0.0, 0.1, 0.1)),
        confusable=LOADS,
        scope="whole",
        needs=frozenset({"base", "pose", "six_axes"}),
        plant=AnsweringForce(Reaction, BASE_JOINTS[:2]),
        remedy=(
            "Add to base_x and base_y the gain times the strap's horizontal force on the interface, delayed and passed"
            " through a low-pass of first order with the smoothing as time constant"
        ),
    ),
    Effect(
        "controller_reaction",
        "robot",
        "F_base = g y + r I, T y' = F_interaction - y, I' = y - I / leak, g and r along x and y: an admittance",
        (
            *(EffectParameter(f"gain_{axis}", "1", -1.5, 4.0, (0.3,)) for axis in "xy"),
            *(EffectParameter(f"integral_gain_{axis}", "1/s", -3.0, 6.0, (0.3,)) for axis in "xy"),
            EffectParameter("leak", "s", 0.3, 20.0, (2.0,), log=True),
            EffectParameter("smoothing", "s", 0.0, 0.5, (0.05,)),
        ),
        separating_trial="the same motion with the controller off",
        at_rest=AtRest((0.0, 0.0, 0.0, 0.0, 2.0, 0.1)),
        confusable=LOADS,
        scope="whole",
        needs=frozenset({"base", "pose", "six_axes"}),
        plant=AnsweringForce(Admittance, BASE_JOINTS[:2]),
        form="integral",
        remedy=(
            "Add to base_x and base_y the strap's horizontal force on the interface, passed through a low-pass of first"
            " order with the smoothing as time constant, times the gain, and its leaky integral (less what it was at"
            " the start) times the integral gain"
        ),
    ),
    Effect(
        "controller_reaction",
        "robot",
        "F' = -r x on each joint of the base, x from its start, held within a limit: the integral term of the hold",
        (
            *(EffectParameter(f"rate_{axis}", "N/m/s", -300.0, 2000.0, (60.0,)) for axis in "xy"),
            EffectParameter("rate_yaw", "Nm/rad/s", -60.0, 400.0, (12.0,)),
            *(EffectParameter(f"limit_{axis}", "N", 1.0, 500.0, (30.0,), log=True) for axis in "xy"),
            EffectParameter("limit_yaw", "Nm", 0.2, 100.0, (6.0,), log=True),
        ),
        separating_trial="the same motion with the controller off",
        at_rest=AtRest((0.0, 0.0, 0.0, 30.0, 30.0, 6.0)),
        confusable=LOADS,
        scope="whole",
        needs=frozenset({"base", "pose", "six_axes"}),
        plant=AnsweringForce(HoldIntegral, BASE_JOINTS),
        form="hold_integral",
        remedy=(
            "Take from each joint of the base its rate times the integral of where it is from its start, held within"
            " its limit"
        ),
    ),
)
