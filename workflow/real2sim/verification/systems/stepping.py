"""Time stepping of a machine in minimal coordinates, held by a segment whose motion is prescribed.

The step is a leapfrog of second order: positions at whole steps, rates at half steps, damping by the trapezoidal rule.
Dry friction is an impulse that is bounded and opposes the rate at the end of the step (Moreau), so that it sticks and
slips exactly.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from real2sim.verification.systems.interface_law import InterfaceLaw
from real2sim.verification.systems.rigid_tree import Motion

_SWEEPS, _CONVERGED = 100, 1e-7


@dataclass
class State:
    """A mechanism at one step, b simulations of n machine joints, x minimal and k interface coordinates.

    ``motion`` at joints ``y`` (b, n); ``reduction`` (b, n, x): joint rates per minimal rate, ``carried`` (b, n):
    joint rates that the segment imposes, ``reduction_bias`` (b, n): joint accelerations at zero minimal accelerations;
    interface coordinates ``q`` (b, k), their rates per minimal rate ``interface`` (b, k, x), and those that the segment
    imposes, ``interface_carried`` (b, k).
    """

    y: np.ndarray
    motion: Motion
    reduction: np.ndarray
    carried: np.ndarray
    reduction_bias: np.ndarray
    q: np.ndarray
    interface: np.ndarray
    interface_carried: np.ndarray


class Mechanism(Protocol):
    """A machine whose minimal coordinates x (b, x) and the segment's pose at a step determine everything."""

    def state(self, step: int, x: np.ndarray, rate: np.ndarray) -> State:
        """Return the state at a step; ``rate`` (b, x) is that of x."""


@dataclass
class Servo:
    """Springs to ``goal`` (b, n) and dampers on the machine's joints; dry friction within ``friction`` (n,)."""

    stiffness: np.ndarray
    damping: np.ndarray
    friction: np.ndarray
    goal: np.ndarray


@dataclass
class Trace:
    """Machine joints ``y`` (s, b, n), interface coordinates ``q`` (s, b, k), poses of the end at every stored step."""

    y: np.ndarray
    q: np.ndarray
    rotation: np.ndarray
    origin: np.ndarray


def rest(mechanism: Mechanism, servo: Servo, law: InterfaceLaw, x: np.ndarray) -> np.ndarray:
    """Return the minimal coordinates (b, x) of static equilibrium at step 0, from a start nearby (Newton)."""
    still = np.zeros_like(x)

    def force(at: np.ndarray) -> np.ndarray:
        s = mechanism.state(0, at, still)
        joints = servo.stiffness * (servo.goal - s.y)
        return _transposed(s.reduction, joints) + _transposed(s.interface, law.static_force(s.q))

    for _ in range(12):
        now, step = force(x), 1e-6
        slope = np.stack([(force(x + step * e) - now) / step for e in np.eye(x.shape[1])], axis=2)
        # coordinates without any spring stay where they are
        move = np.einsum("bij,bj->bi", np.linalg.pinv(slope, rcond=1e-7), now)
        x = x - move
        if np.abs(move).max() < 1e-11:
            break
    return x


def _transposed(matrix: np.ndarray, vector: np.ndarray) -> np.ndarray:
    return np.matmul(matrix.swapaxes(1, 2), vector[:, :, None])[:, :, 0]


def _times(matrix: np.ndarray, vector: np.ndarray) -> np.ndarray:
    return np.matmul(matrix, vector[:, :, None])[:, :, 0]


def run(
    mechanism: Mechanism,
    servo: Servo,
    law: InterfaceLaw,
    x: np.ndarray,
    steps: int,
    step_s: float,
    every: int,
    body: int,
) -> Trace:
    """Step from rest at x (b, x) and store every ``every``-th step; ``body`` is the index of the end."""
    half = np.zeros_like(x)
    before = np.zeros_like(x)
    friction = Friction(servo.friction, law)
    ys, qs, rotations, origins = [], [], [], []
    for k in range(steps):
        rate = 1.5 * half - 0.5 * before
        s = mechanism.state(k, x, rate)
        if k % every == 0:
            ys.append(s.y)
            qs.append(s.q)
            rotations.append(s.motion.rotation[:, body])
            origins.append(s.motion.origin[:, body])
        before = half
        half = next_rate(s, servo, law, half, rate, step_s, friction)
        x = x + step_s * half
    return Trace(*(np.array(part) for part in (ys, qs, rotations, origins)))


def next_rate(s, servo, law, half, rate, step_s, friction) -> np.ndarray:
    """Return the minimal rates (b, x) half a step later."""
    h = step_s
    inertia = np.matmul(s.reduction.swapaxes(1, 2), np.matmul(s.motion.inertia, s.reduction))
    on_interface = law.damping_at(_times(s.interface, rate) + s.interface_carried)
    joints = servo.stiffness * (servo.goal - s.y) - servo.damping * s.carried
    joints = joints - s.motion.bias - _times(s.motion.inertia, s.reduction_bias)
    contact = law.elastic_force(s.q) - on_interface * s.interface_carried
    force = _transposed(s.reduction, joints) + _transposed(s.interface, contact)
    damping = np.matmul(s.reduction.swapaxes(1, 2) * servo.damping, s.reduction)
    damping += np.matmul(s.interface.swapaxes(1, 2) * on_interface[:, None], s.interface)
    implicit = inertia + h / 2 * damping
    impulse = _times(inertia - h / 2 * damping, half) + h * force
    return friction.solve(s, implicit, impulse, h)


class Friction:
    """Impulses of dry friction, warm-started from the step before."""

    def __init__(self, joints: np.ndarray, law: InterfaceLaw):
        self._joints = np.flatnonzero(joints)
        self._bounds = [float(b) for b in joints[self._joints]]
        self._axis = law.axis if law.friction_bound else None
        if self._axis is not None:
            self._bounds.append(law.friction_bound)
        self._impulses: list[list[float]] | None = None

    def solve(self, s: State, implicit: np.ndarray, impulse: np.ndarray, h: float) -> np.ndarray:
        """Return rates (b, x) with ``implicit`` rates = impulse + friction, friction within its bounds."""
        if not self._bounds:
            return np.linalg.solve(implicit, impulse[:, :, None])[:, :, 0]
        rows, carried = s.reduction[:, self._joints], s.carried[:, self._joints]
        if self._axis is not None:
            rows = np.concatenate([rows, s.interface[:, self._axis : self._axis + 1]], axis=1)
            carried = np.concatenate([carried, s.interface_carried[:, self._axis : self._axis + 1]], axis=1)
        solved = np.linalg.solve(implicit, np.concatenate([impulse[:, :, None], rows.swapaxes(1, 2)], axis=2))
        free, response = solved[:, :, 0], solved[:, :, 1:]
        slip = (_times(rows, free) + carried).tolist()
        mobility = np.matmul(rows, response).tolist()
        if self._impulses is None:
            self._impulses = [[0.0] * len(self._bounds) for _ in slip]
        for i in range(len(slip)):
            _bound(mobility[i], slip[i], [h * b for b in self._bounds], self._impulses[i])
        return free + _times(response, np.array(self._impulses))


def _bound(
    mobility: list[list[float]], slip: list[float], bounds: list[float], impulses: list[float]
) -> None:
    """Solve the bounded impulses in place: each opposes its slip or stops it (Gauss-Seidel)."""
    size = range(len(bounds))
    for _ in range(_SWEEPS):
        worst = 0.0
        for i in size:
            row = mobility[i]
            now = slip[i]
            for j in size:
                now += row[j] * impulses[j]
            new = impulses[i] - now / row[i]
            new = min(max(new, -bounds[i]), bounds[i])
            worst = max(worst, abs(new - impulses[i]) / bounds[i])
            impulses[i] = new
        if worst < _CONVERGED:
            break
