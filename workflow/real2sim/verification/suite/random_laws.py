"""Forces of the stratum `random_law`, stepped with their state as those of `laws`.

Functions are those of `random_functions`; an axis or joint is given by its index. Histories are tables from time 0 on,
`TABLE_HZ` apart, between which forces are interpolated.
"""

from __future__ import annotations

import numpy as np

from real2sim.verification.phantom.physics import Step
from real2sim.verification.suite.laws import RobotTerm, Term
from real2sim.verification.suite.random_functions import Function, evaluate, gradient

TABLE_HZ = 200.0


def table_times(duration_s: float) -> np.ndarray:
    """Times (n,) [s] of a table that covers a trial."""
    return np.arange(int(np.ceil(duration_s * TABLE_HZ)) + 3) / TABLE_HZ


def _look_up(table: np.ndarray, time_s: float) -> np.ndarray:
    # tables (rows, n)
    place = min(time_s * TABLE_HZ, table.shape[1] - 1.001)
    i = int(place)
    values: np.ndarray = table[:, i] + (place - i) * (table[:, i + 1] - table[:, i])
    return values


class _OnAxis(Term):
    # a force on one axis per trial
    axis: np.ndarray

    def prepare(self) -> None:
        self.own = np.arange(len(self.rows))
        self.on = self.axis.astype(int)

    def placed(self, force: np.ndarray) -> np.ndarray:
        """Forces (rows,) on the axis as forces (rows, 6)."""
        out = np.zeros((len(self.rows), 6))
        out[self.own, self.on] = force
        return out

    def function(self) -> Function:
        """The random function of every trial."""
        return {name: getattr(self, name) for name in ("frequency", "phase", "amplitude")}


class Potential(Term):
    """Forces -dV/dq of a potential of up to three coordinates; none at q = 0.

    ``which`` (3,) are the coordinates, ``scale`` (3,) their visited half ranges, ``energy`` [J]; coordinates beyond
    those that the potential depends on have zero frequencies.
    """

    which: np.ndarray
    scale: np.ndarray
    energy: np.ndarray
    frequency: np.ndarray
    phase: np.ndarray
    amplitude: np.ndarray

    def prepare(self) -> None:
        self.on = self.which.astype(int)
        self.own = np.arange(len(self.rows))[:, None]
        self.function = {name: getattr(self, name) for name in ("frequency", "phase", "amplitude")}
        self.rest = gradient(self.function, np.zeros_like(self.scale))

    def force(self, q: np.ndarray, qd: np.ndarray) -> np.ndarray:
        slope = gradient(self.function, q[self.own, self.on] / self.scale) - self.rest
        out = np.zeros_like(q)
        np.add.at(out, (self.own, self.on), -self.energy[:, None] * slope / self.scale)
        return out


class Drag(_OnAxis):
    """Dissipation -c max(g(q / reach, v / speed) - least, 0) v on one axis."""

    reach: np.ndarray
    speed: np.ndarray
    damping: np.ndarray
    least: np.ndarray
    frequency: np.ndarray
    phase: np.ndarray
    amplitude: np.ndarray

    def force(self, q: np.ndarray, qd: np.ndarray) -> np.ndarray:
        own, rate = q[self.own, self.on], qd[self.own, self.on]
        share = evaluate(self.function(), np.column_stack([own / self.reach, rate / self.speed])) - self.least
        return self.placed(-self.damping * np.maximum(share, 0.0) * rate)


class Plays(Term):
    """Rate-independent hysteresis: parallel springs (6, m) that slip at thresholds (6, m) of their force."""

    spring: np.ndarray
    threshold: np.ndarray

    def prepare(self) -> None:
        self.held = np.zeros(self.spring.shape)

    def force(self, q: np.ndarray, qd: np.ndarray) -> np.ndarray:
        moved = self.held + self.spring * self.travel(q)[:, :, None]
        self.held = np.clip(moved, -self.threshold, self.threshold)
        force: np.ndarray = -self.held.sum(axis=2)
        return force


class Cross(_OnAxis):
    """Force on one axis from the coordinate (``of_rate`` 0) or rate (1) of another: F = A (g(s) - g(0))."""

    source: np.ndarray
    of_rate: np.ndarray
    scale: np.ndarray
    strength: np.ndarray
    frequency: np.ndarray
    phase: np.ndarray
    amplitude: np.ndarray

    def prepare(self) -> None:
        super().prepare()
        self.rest = evaluate(self.function(), np.zeros((len(self.rows), 1)))

    def force(self, q: np.ndarray, qd: np.ndarray) -> np.ndarray:
        of = self.source.astype(int)
        value = np.where(self.of_rate > 0, qd[self.own, of], q[self.own, of]) / self.scale
        return self.placed(self.strength * (evaluate(self.function(), value[:, None]) - self.rest))


class Product(_OnAxis):
    """Force on one axis from its coordinate times the rate of another: F = c q_a v_b."""

    source: np.ndarray
    coefficient: np.ndarray

    def force(self, q: np.ndarray, qd: np.ndarray) -> np.ndarray:
        other = qd[self.own, self.source.astype(int)]
        return self.placed(self.coefficient * q[self.own, self.on] * other)


class Scheduled(_OnAxis):
    """Tables over time on one axis: a force, and gains that stiffness and damping have on top of the linear law."""

    push: np.ndarray
    gain: np.ndarray
    stiffness: np.ndarray
    damping: np.ndarray

    def prepare(self) -> None:
        super().prepare()
        self.steps = 0

    def force(self, q: np.ndarray, qd: np.ndarray) -> np.ndarray:
        push, gain = (_look_up(table, self.steps * self.step_s) for table in (self.push, self.gain))
        self.steps += 1
        pull = self.stiffness * q[self.own, self.on] + self.damping * qd[self.own, self.on]
        return self.placed(push - gain * pull)


class PlaceGain(_OnAxis):
    """Gain of stiffness and damping of one axis in the place of a joint of the robot: the gain is
    most max(g(s) - least, 0).

    The strap's forces are asked for before the robot's place is told, so the place is that of the step before.
    """

    joint: np.ndarray
    start: np.ndarray
    scale: np.ndarray
    most: np.ndarray
    least: np.ndarray
    stiffness: np.ndarray
    damping: np.ndarray
    frequency: np.ndarray
    phase: np.ndarray
    amplitude: np.ndarray

    def prepare(self) -> None:
        super().prepare()
        self.place = self.start.copy()

    def watch(self, joints: np.ndarray) -> None:
        """Take in the robot's joints (n, 6) [m, rad] in the n trials of the batch."""
        self.place = joints[self.rows, self.joint.astype(int)].copy()

    def force(self, q: np.ndarray, qd: np.ndarray) -> np.ndarray:
        s = (self.place - self.start) / self.scale
        gain = self.most * np.maximum(evaluate(self.function(), s[:, None]) - self.least, 0.0)
        pull = self.stiffness * q[self.own, self.on] + self.damping * qd[self.own, self.on]
        return self.placed(-gain * pull)


class Watch:
    """Tells strap terms that depend on it the robot's place, as an effect on the robot that adds no force."""

    def __init__(self, terms: list[PlaceGain]):
        self.terms = terms

    def __call__(self, step: Step, joint_force: np.ndarray, body_force: np.ndarray) -> None:
        """See `physics.RobotEffect`."""
        for term in self.terms:
            term.watch(step.joints)


class _OnJoint(RobotTerm):
    # a force on one joint of the robot per trial
    joint: np.ndarray

    def add(self, joint_force: np.ndarray, force: np.ndarray) -> None:
        """Add forces (rows,) to those on the joints."""
        joint_force[self.rows, self.joint.astype(int)] += force

    def function(self) -> Function:
        """The random function of every trial."""
        return {name: getattr(self, name) for name in ("frequency", "phase", "amplitude")}


class PlaceForce(_OnJoint):
    """Force on a joint of the robot by its place: F = A (g((x - start) / scale) - g(0))."""

    start: np.ndarray
    scale: np.ndarray
    strength: np.ndarray
    frequency: np.ndarray
    phase: np.ndarray
    amplitude: np.ndarray

    def prepare(self) -> None:
        self.rest = evaluate(self.function(), np.zeros((len(self.rows), 1)))

    def __call__(self, step: Step, joint_force: np.ndarray, body_force: np.ndarray) -> None:
        s = (step.joints[self.rows, self.joint.astype(int)] - self.start) / self.scale
        self.add(joint_force, self.strength * (evaluate(self.function(), s[:, None]) - self.rest))


class SpeedForce(_OnJoint):
    """Dissipation on a joint of the robot: F = -c max(g(v / scale) - least, 0) v."""

    scale: np.ndarray
    damping: np.ndarray
    least: np.ndarray
    frequency: np.ndarray
    phase: np.ndarray
    amplitude: np.ndarray

    def __call__(self, step: Step, joint_force: np.ndarray, body_force: np.ndarray) -> None:
        rate = step.rates[self.rows, self.joint.astype(int)]
        share = evaluate(self.function(), (rate / self.scale)[:, None]) - self.least
        self.add(joint_force, -self.damping * np.maximum(share, 0.0) * rate)


class ScheduledPush(_OnJoint):
    """Force on a joint of the robot from a table over time."""

    push: np.ndarray

    def __call__(self, step: Step, joint_force: np.ndarray, body_force: np.ndarray) -> None:
        self.add(joint_force, _look_up(self.push, step.time_s))
