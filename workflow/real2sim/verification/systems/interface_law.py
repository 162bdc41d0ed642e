"""Force law of an interface with at most one effect on one coordinate, by equations of its own."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

RELAXATION_TIME_S = 0.4


@dataclass
class InterfaceLaw:
    """Force -(K q + D q') and an effect on the coordinate ``axis``, for b simulations at once.

    ``stiffness``, ``damping`` (k,) [N/m, Nm/rad; Ns/m, Nms/rad]; ``size`` may differ between simulations, (b,).
    `elastic_force` has a state where the effect is
    ``relaxation``: it is called once per step of ``step_s``. Friction is not part of it, but is given by
    `friction_bound`, because it belongs to the step.
    """

    stiffness: np.ndarray
    damping: np.ndarray
    step_s: float
    effect: str | None = None
    axis: int = 0
    size: float | np.ndarray = 0.0
    _held: np.ndarray | float = 0.0
    _last: np.ndarray | None = field(default=None)

    def static_force(self, q: np.ndarray) -> np.ndarray:
        """Return the force (b, k) on the machine at rest at q (b, k), without memory."""
        force = -self.stiffness * q
        x = q[:, self.axis]
        k = self.stiffness[self.axis]
        if self.effect == "slack":
            force[:, self.axis] = -k * (x - np.clip(x, -self.size, self.size))
        elif self.effect == "stiffening":
            force[:, self.axis] -= self.size * x**3
        elif self.effect == "preload":
            force[:, self.axis] += k * self.size
        return force

    def elastic_force(self, q: np.ndarray) -> np.ndarray:
        """Return the force (b, k) of what does not damp, at the next step."""
        force = self.static_force(q)
        if self.effect == "relaxation":
            x = q[:, self.axis]
            travel = np.zeros_like(x) if self._last is None else x - self._last
            self._last = x
            decay = np.exp(-self.step_s / RELAXATION_TIME_S)
            gain = self.size * RELAXATION_TIME_S * (1 - decay) / self.step_s
            self._held = self._held * decay + gain * travel
            force[:, self.axis] -= self._held
        return force

    def damping_at(self, rate: np.ndarray) -> np.ndarray:
        """Return the damping (b, k) that times the rate (b, k) is the force against it."""
        out = np.broadcast_to(self.damping, rate.shape).copy()
        if self.effect == "quadratic_damping":
            out[:, self.axis] += self.size * np.abs(rate[:, self.axis])
        return out

    @property
    def friction_bound(self) -> float:
        """Largest dry friction [N, Nm] along ``axis``."""
        return float(self.size) if self.effect == "coulomb" else 0.0
