"""Forces of the strap beyond K q + D qdot, by equations of the phantom's own, stepped with their state.

A term serves some of the trials of a batch (``rows``) and adds its force along q to the linear law. Parameters
are arrays of one row per trial and, where they belong to an axis, six columns; an axis of amplitude 0 is left
alone. `force` is called exactly once per step of ``step_s``.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, ClassVar

import numpy as np

from real2sim.verification.phantom.physics import Step, StrapLaw


class Term:
    """A force along q of some trials; subclasses name their parameters and say what they add."""

    def __init__(self, rows: np.ndarray, step_s: float, values: list[dict[str, Any]]):
        self.rows, self.step_s = rows, step_s
        for name in values[0]:
            setattr(self, name, np.array([v[name] for v in values], float))
        self.last: np.ndarray | None = None
        self.prepare()

    def prepare(self) -> None:
        """Set up the state."""

    def travel(self, q: np.ndarray) -> np.ndarray:
        """Return the travel of q (rows, 6) since the last step: states are those of now, not of the next step."""
        out = np.zeros_like(q) if self.last is None else q - self.last
        self.last = q
        return out

    def force(self, q: np.ndarray, qd: np.ndarray) -> np.ndarray:
        """Force (rows, 6) [N, Nm] at the next step, from q and its rate (rows, 6)."""
        raise NotImplementedError


@dataclass(frozen=True)
class EffectLaw(StrapLaw):
    """The strap's linear law with terms on top, for trials that all run from the first step to the last."""

    terms: list[Term] = field(default_factory=list)

    def take(self, trials: np.ndarray) -> EffectLaw:
        """The same law: the terms keep their state, so trials cannot be chosen anew."""
        if len(trials) != len(self.stiffness) or (np.asarray(trials) != np.arange(len(trials))).any():
            raise ValueError("the trials of a law with state have to be of one duration")
        return self

    def generalised_force(self, q: np.ndarray, qd: np.ndarray) -> np.ndarray:
        """Force on the interface along q (n, 6) [N, Nm]; advances the terms by one step."""
        out = super().generalised_force(q, qd)
        for term in self.terms:
            out[term.rows] += term.force(q[term.rows], qd[term.rows])
        return out


# -------------------- springs


class Matrix(Term):
    """Full matrices dK, dD (6, 6) on top of the diagonal ones: -(dK q + dD qdot)."""

    damping: np.ndarray
    stiffness: np.ndarray

    def force(self, q: np.ndarray, qd: np.ndarray) -> np.ndarray:
        force: np.ndarray = -np.einsum("nij,nj->ni", self.stiffness, q) - np.einsum(
            "nij,nj->ni", self.damping, qd
        )
        return force


class Slack(Term):
    """Dead band of half width w: F = -k sgn(q) max(|q| - w, 0)."""

    stiffness: np.ndarray
    half_width: np.ndarray

    def force(self, q: np.ndarray, qd: np.ndarray) -> np.ndarray:
        force: np.ndarray = self.stiffness * np.clip(q, -self.half_width, self.half_width)
        return force


class SmoothSlack(Term):
    """Dead band that the strap leaves gradually: F = -k (q - w tanh(q / w))."""

    half_width: np.ndarray
    stiffness: np.ndarray

    def force(self, q: np.ndarray, qd: np.ndarray) -> np.ndarray:
        width = np.maximum(self.half_width, 1e-12)
        force: np.ndarray = self.stiffness * width * np.tanh(q / width)
        return force


class OneSided(Term):
    """The share s of the spring pulls to one side alone: F = -k ((1 - s) q + s sgn max(sgn q - q0, 0))."""

    side: np.ndarray
    stiffness: np.ndarray
    share: np.ndarray
    onset: np.ndarray

    def force(self, q: np.ndarray, qd: np.ndarray) -> np.ndarray:
        pull = self.side * np.maximum(self.side * q - self.onset, 0.0)
        force: np.ndarray = self.stiffness * self.share * (q - pull)
        return force


class SoftOneSided(Term):
    """As `OneSided` with a rounded onset: max(x, 0) becomes r ln(1 + exp(x / r)) - r ln 2."""

    rounding: np.ndarray
    side: np.ndarray
    stiffness: np.ndarray
    share: np.ndarray

    def force(self, q: np.ndarray, qd: np.ndarray) -> np.ndarray:
        r = np.maximum(self.rounding, 1e-9)
        pull = self.side * r * (np.logaddexp(0.0, self.side * q / r) - np.log(2))
        force: np.ndarray = self.stiffness * self.share * (q - pull)
        return force


class Cubic(Term):
    """Stiffening spring: -c q^3."""

    cubic: np.ndarray

    def force(self, q: np.ndarray, qd: np.ndarray) -> np.ndarray:
        force: np.ndarray = -self.cubic * q**3
        return force


class Exponential(Term):
    """Spring of exponential stiffening over x0: -k (x0 (exp(|q| / x0) - 1) sgn q - q)."""

    stiffness: np.ndarray
    length: np.ndarray

    def force(self, q: np.ndarray, qd: np.ndarray) -> np.ndarray:
        force: np.ndarray = -self.stiffness * (
            self.length * np.expm1(np.abs(q) / self.length) * np.sign(q) - q
        )
        return force


class Quadratic(Term):
    """Even part -b q^2, straight beyond the range, where the total would lose its sign."""

    quadratic: np.ndarray
    range: np.ndarray

    def force(self, q: np.ndarray, qd: np.ndarray) -> np.ndarray:
        a = np.abs(q)
        force: np.ndarray = -self.quadratic * np.where(
            a < self.range, q * q, self.range * (2 * a - self.range)
        )
        return force


class TwoSlopes(Term):
    """k (1 + a) for q > 0 and k (1 - a) for q < 0: adds -a k |q|."""

    asymmetry: np.ndarray
    stiffness: np.ndarray

    def force(self, q: np.ndarray, qd: np.ndarray) -> np.ndarray:
        force: np.ndarray = -self.stiffness * self.asymmetry * np.abs(q)
        return force


class SoftStop(Term):
    """A stop that begins gently: -c (q - L)^2 beyond L on one side."""

    curvature: np.ndarray
    side: np.ndarray
    limit: np.ndarray

    def force(self, q: np.ndarray, qd: np.ndarray) -> np.ndarray:
        force: np.ndarray = -self.side * self.curvature * np.maximum(self.side * q - self.limit, 0.0) ** 2
        return force


# -------------------- dissipation without memory


class PowerDamping(Term):
    """-c |v|^p sgn v; p = 2 is quadratic damping."""

    coefficient: np.ndarray
    exponent: np.ndarray

    def force(self, q: np.ndarray, qd: np.ndarray) -> np.ndarray:
        force: np.ndarray = -self.coefficient * np.abs(qd) ** self.exponent[:, None] * np.sign(qd)
        return force


# -------------------- dissipation with memory


class Stick(Term):
    """Coulomb friction with an elastic stick (Prandtl): a spring whose force saturates at +-F, or at F+ and F-."""

    upper: np.ndarray
    lower: np.ndarray
    spring: np.ndarray

    def prepare(self) -> None:
        self.held = np.zeros((len(self.rows), 6))

    def force(self, q: np.ndarray, qd: np.ndarray) -> np.ndarray:
        self.held = np.clip(self.held + self.spring * self.travel(q), -self.lower, self.upper)
        return -self.held


class Iwan(Term):
    """Maxwell slip: parallel Prandtl elements of equal springs whose thresholds are spread evenly."""

    strength: np.ndarray
    yield_travel: np.ndarray

    elements: ClassVar[int] = 8

    def prepare(self) -> None:
        share = (np.arange(self.elements) + 0.5) * 2 / self.elements**2
        self.threshold = self.strength[:, :, None] * share
        self.spring = self.threshold[:, :, -1:] / np.maximum(2 * self.yield_travel[:, :, None], 1e-12)
        self.held = np.zeros((len(self.rows), 6, self.elements))

    def force(self, q: np.ndarray, qd: np.ndarray) -> np.ndarray:
        moved = self.held + self.spring * self.travel(q)[:, :, None]
        self.held = np.clip(moved, -self.threshold, self.threshold)
        force: np.ndarray = -self.held.sum(axis=2)
        return force


class LuGre(Term):
    """LuGre: z' = v - sigma |v| / g(v) z, F = -sigma z, g = Fc + (Fs - Fc) exp(-(v / vs)^2).

    z is stepped exactly for the velocity of the step, so a stiff sigma costs no stability (Canudas de Wit
    1995).
    """

    coulomb: np.ndarray
    spring: np.ndarray
    static: np.ndarray
    stribeck: np.ndarray

    def prepare(self) -> None:
        self.z = np.zeros((len(self.rows), 6))

    def force(self, q: np.ndarray, qd: np.ndarray) -> np.ndarray:
        travel = self.travel(q)
        g = self.coulomb + (self.static - self.coulomb) * np.exp(-((qd / self.stribeck) ** 2))
        g = np.maximum(g, 1e-12)
        goal = np.sign(travel) * g / self.spring
        decay = np.exp(-self.spring * np.abs(travel) / g)
        self.z = goal + (self.z - goal) * decay
        return -self.spring * self.z


class BoucWen(Term):
    """Bouc-Wen with exponent 1: z' = (v / x_y) (1 - |z| (b + (1 - b) sgn(v z))), F = -F_y z.

    z is linear in itself while v z keeps its sign, so each step is exact for its travel.
    """

    yield_travel: np.ndarray
    strength: np.ndarray
    shape: np.ndarray

    def prepare(self) -> None:
        self.z = np.zeros((len(self.rows), 6))

    def force(self, q: np.ndarray, qd: np.ndarray) -> np.ndarray:
        travel = self.travel(q) / self.yield_travel
        z = self.z
        loading = travel * z >= 0
        # loading: dz = (1 - |z|) dx; unloading: dz = (1 + (1 - 2 b) |z|) dx until z changes its sign
        up = np.sign(travel) - (np.sign(travel) - z) * np.exp(-np.abs(travel))
        rate = 1 + (1 - 2 * self.shape[:, None]) * np.abs(z)
        self.z = np.where(loading, up, z + travel * rate)
        return -self.strength * self.z


class Maxwell(Term):
    """Relaxing branch (standard linear solid): F1' = -k1 v - F1 / tau, exact for a steady rate."""

    tau: np.ndarray
    branch: np.ndarray

    def prepare(self) -> None:
        self.held = np.zeros((len(self.rows), 6))

    def force(self, q: np.ndarray, qd: np.ndarray) -> np.ndarray:
        tau = self.tau[:, None]
        decay = np.exp(-self.step_s / tau)
        self.held = self.held * decay + self.branch * tau * (1 - decay) * self.travel(q) / self.step_s
        return -self.held


class Prony(Term):
    """Several relaxing branches: ``branch`` (n, 6, m), ``tau`` (n, m)."""

    tau: np.ndarray
    branch: np.ndarray

    def prepare(self) -> None:
        self.held = np.zeros(self.branch.shape)

    def force(self, q: np.ndarray, qd: np.ndarray) -> np.ndarray:
        tau = self.tau[:, None, :]
        decay = np.exp(-self.step_s / tau)
        rate = self.travel(q)[:, :, None] / self.step_s
        self.held = self.held * decay + self.branch * tau * (1 - decay) * rate
        force: np.ndarray = -self.held.sum(axis=2)
        return force


class Ratchet(Term):
    """The strap slips while it is stretched beyond a threshold and stays there: F = -k (q - r), r never returns.

    r' = rate max(sgn q - r - threshold, 0): the slip ends where the strap is relieved.
    """

    threshold: np.ndarray
    rate: np.ndarray
    stiffness: np.ndarray
    side: np.ndarray

    def prepare(self) -> None:
        self.slipped = np.zeros((len(self.rows), 6))

    def force(self, q: np.ndarray, qd: np.ndarray) -> np.ndarray:
        beyond = np.maximum(self.side * q - self.slipped - self.threshold, 0.0)
        self.slipped += self.rate * beyond * self.step_s
        force: np.ndarray = self.stiffness * self.side * self.slipped
        return force


class Wander(Term):
    """The rest pose creeps steadily from a start time on: F = -k (q - rate (t - t0))."""

    stiffness: np.ndarray
    rate: np.ndarray
    onset: np.ndarray

    def prepare(self) -> None:
        self.time = 0.0

    def force(self, q: np.ndarray, qd: np.ndarray) -> np.ndarray:
        self.time += self.step_s
        late = np.maximum(self.time - self.onset, 0.0)[:, None]
        force: np.ndarray = self.stiffness * self.rate * late
        return force


# -------------------- outside the library


class Backlash(Term):
    """A gap that is crossed freely and ends in an impact: the spring sees a play operator of q, with a knock."""

    half_width: np.ndarray
    stiffness: np.ndarray
    knock: np.ndarray

    def prepare(self) -> None:
        self.followed = np.zeros((len(self.rows), 6))

    def force(self, q: np.ndarray, qd: np.ndarray) -> np.ndarray:
        before = self.followed
        self.followed = np.clip(before, q - self.half_width, q + self.half_width)
        engaged = self.followed != before
        force: np.ndarray = self.stiffness * (q - self.followed) - self.knock * qd * engaged
        return force


class PoseStick(Term):
    """Sticks in one pose: a Gaussian well, whose slope is negative on its flanks."""

    width: np.ndarray
    place: np.ndarray
    depth: np.ndarray

    def force(self, q: np.ndarray, qd: np.ndarray) -> np.ndarray:
        x = (q - self.place) / self.width
        force: np.ndarray = -self.depth * x * np.exp(0.5 * (1 - x * x))
        return force


# -------------------- the robot's side


class RobotTerm:
    """A force on the robot in some trials of a batch."""

    def __init__(self, rows: np.ndarray, step_s: float, values: list[dict[str, Any]]):
        self.rows, self.step_s = rows, step_s
        for name in values[0]:
            setattr(self, name, np.array([v[name] for v in values], float))
        self.prepare()

    def prepare(self) -> None:
        """Set up the state."""

    def __call__(self, step: Step, joint_force: np.ndarray, body_force: np.ndarray) -> None:
        """See `physics.RobotEffect`."""
        raise NotImplementedError


class Tilt(RobotTerm):
    """Gravity leans: each body is pulled sideways by its weight times the tilt, which may sway."""

    sway: np.ndarray
    lean: np.ndarray
    phase: np.ndarray
    masses: np.ndarray
    frequency: np.ndarray

    def __call__(self, step: Step, joint_force: np.ndarray, body_force: np.ndarray) -> None:
        sway = 1 + self.sway * np.sin(2 * np.pi * self.frequency * step.time_s + self.phase)
        body_force[self.rows] += (9.81 * self.masses * sway[:, None])[:, :, None] * self.lean[:, None, :]


class Reaction(RobotTerm):
    """The base's controller answers the interaction force after a delay, smoothed: F = g F_int(t - delay)."""

    gain: np.ndarray
    filter: np.ndarray
    delay: np.ndarray

    def prepare(self) -> None:
        self.lags = np.maximum(np.round(self.delay / self.step_s).astype(int), 1)
        self.past = np.zeros((self.lags.max() + 1, len(self.rows), 2))
        self.smooth = np.zeros((len(self.rows), 2))
        self.count = 0

    def __call__(self, step: Step, joint_force: np.ndarray, body_force: np.ndarray) -> None:
        size = len(self.past)
        self.past[self.count % size] = step.force[self.rows, :2]
        late = self.past[(self.count - self.lags) % size, np.arange(len(self.rows))]
        self.count += 1
        a = np.where(self.filter > 0, np.exp(-self.step_s / np.maximum(self.filter, 1e-9)), 0.0)[:, None]
        self.smooth = a * self.smooth + (1 - a) * late
        joint_force[self.rows, :2] += self.gain[:, None] * self.smooth


class SeriesCompliance(RobotTerm):
    """The base yields behind its servo: part of the servo's spring relaxes (a hidden compliant joint)."""

    tau: np.ndarray
    branch: np.ndarray

    def prepare(self) -> None:
        self.held = np.zeros((len(self.rows), 3))

    def __call__(self, step: Step, joint_force: np.ndarray, body_force: np.ndarray) -> None:
        decay = np.exp(-self.step_s / self.tau)[:, None]
        self.held = (
            self.held * decay + self.branch * self.tau[:, None] * (1 - decay) * step.rates[self.rows, :3]
        )
        joint_force[self.rows, :3] -= self.held


class Push(RobotTerm):
    """Somebody or something pushes the base: sin^2 pulses, periodic or at given times."""

    direction: np.ndarray
    times: np.ndarray
    width: np.ndarray
    strength: np.ndarray

    def __call__(self, step: Step, joint_force: np.ndarray, body_force: np.ndarray) -> None:
        since = (step.time_s - self.times) / self.width[:, None]
        pulse = np.where((since > 0) & (since < 1), np.sin(np.pi * np.clip(since, 0, 1)) ** 2, 0.0)
        joint_force[self.rows, :2] += (pulse * self.strength).sum(axis=1)[:, None] * self.direction


class Hand(RobotTerm):
    """The person holds the arm now and then: a spring and damper from the pose at the grasp."""

    times: np.ndarray
    damper: np.ndarray
    spring: np.ndarray
    width: np.ndarray
    closed: np.ndarray

    def prepare(self) -> None:
        self.grasped = np.zeros((len(self.rows), 6))
        self.closed = np.zeros(len(self.rows), bool)

    def __call__(self, step: Step, joint_force: np.ndarray, body_force: np.ndarray) -> None:
        here = step.joints[self.rows]
        since = step.time_s - self.times
        hold = np.any((since > 0) & (since < self.width), axis=1)
        self.grasped[hold & ~self.closed] = here[hold & ~self.closed]
        self.closed = hold
        pull = -self.spring * (here - self.grasped) - self.damper * step.rates[self.rows]
        joint_force[self.rows] += pull * hold[:, None]


class Cogging(RobotTerm):
    """Wheels with preferred positions: a force periodic in the base's place."""

    strength: np.ndarray
    phase: np.ndarray
    pitch: np.ndarray

    def __call__(self, step: Step, joint_force: np.ndarray, body_force: np.ndarray) -> None:
        place = step.joints[self.rows, :2]
        joint_force[self.rows, :2] -= self.strength * np.sin(
            2 * np.pi * place / self.pitch[:, None] + self.phase
        )
