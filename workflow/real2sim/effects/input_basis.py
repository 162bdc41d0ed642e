"""What an input chain does to the command of the driven segment: interpolated where that is exact enough."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

# Values at which the chain of one parameter is asked for its answer: 10 ms of a lag within 0.1 s lie between two
NODES = 21
# How far a path by interpolation may be from the chain's own [m, RMS], turns at a lever of `_LEVER` [m]: a tenth of the
# noise of quiet markers
_APART, _LEVER = 2e-5, 0.2
# Points whose changes are kept, and cells that the range of a parameter is checked in
_KEPT, _CELLS = 48, 80

# Change of the command (nstep, 6) [m, rad] and of pose and rate at the start (12,) for values (p,)
Answer = Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]


@dataclass(frozen=True)
class InputBasis:
    """Changes of the pelvis command (b, nstep, 6) and of pelvis and rate at the start (b, 12) by an input chain.

    With ``nodes`` (b,) those are the changes at these evenly spaced values of its one parameter, else slopes and
    curvatures of its parameters.
    """

    commands: np.ndarray
    starts: np.ndarray
    nodes: np.ndarray | None = None

    @classmethod
    def of(cls, answer: Answer, low: np.ndarray, high: np.ndarray, steps: np.ndarray) -> InputBasis:
        """Return the changes of a chain up to the bounds ``low`` and ``high`` (p,) of its parameters.

        One parameter is interpolated through the chain's own answers; of several, each has a parabola through
        ``steps`` (p,) either way: a lever arm of metres makes the square count.
        """
        if len(low) == 1:
            nodes = np.linspace(low[0], high[0], NODES)
            commands, starts = zip(*(answer(node[None]) for node in nodes), strict=True)
            return cls(np.array(commands), np.array(starts), nodes)
        both = [(answer(step), answer(-step)) for step in np.diag(steps)]
        parts = []
        for k in range(2):
            up, down = (np.array([pair[way][k] for pair in both]) for way in (0, 1))
            scale = steps.reshape(-1, *[1] * (up.ndim - 1))
            parts.append(np.concatenate([(up - down) / (2 * scale), (up + down) / (2 * scale**2)]))
        return cls(*parts)

    def weights(self, values: np.ndarray) -> np.ndarray:
        """Shares (m, b) of the changes for values (m, p)."""
        if self.nodes is None:
            return np.hstack([values, values**2])
        # cubic through the four nodes about a value: a path that ends has no smooth continuation to fit a global one to
        step = self.nodes[1] - self.nodes[0]
        place = (values[:, 0] - self.nodes[0]) / step
        first = np.clip(np.floor(place).astype(int) - 1, 0, len(self.nodes) - 4)
        t = (place - first)[:, None]
        out = np.zeros((len(values), len(self.nodes)))
        for k in range(4):
            others = np.delete(np.arange(4), k)
            out[np.arange(len(values)), first + k] = np.prod((t - others) / (k - others), axis=1)
        return out


class InputChain:
    """An input chain's answers and their basis, which all replays of one trial and time step share."""

    def __init__(self, answer: Answer, low: np.ndarray, high: np.ndarray, steps: np.ndarray):
        self.basis = InputBasis.of(answer, low, high, steps)
        self.cell = np.maximum(high - low, 1e-12) / _CELLS
        # the system's columns of a Jacobian, and every other hypothesis, ask for one point again and again
        self._answer, self._asked = answer, lru_cache(_KEPT)(self._ask)

    def own(self, row: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the chain's own change of the command (nstep, 6) and of the start (12,) for values (p,).

        The start is NaN where nothing can be driven so, as of a simulation that MuJoCo gives up on.
        """
        return self._asked(np.ascontiguousarray(row, float).tobytes())

    def _ask(self, row: bytes) -> tuple[np.ndarray, np.ndarray]:
        try:
            return self._answer(np.frombuffer(row))
        except (ValueError, np.linalg.LinAlgError):
            # a segment that turns farther than it can be driven, or no segment at all
            return np.zeros(self.basis.commands.shape[1:]), np.full(self.basis.starts.shape[1], np.nan)


class InputChanges:
    """Changes of the pelvis command by an input chain for any values: by its basis, or by the chain itself.

    Parabolas know nothing of what two parameters do together, nor of cubes. Where they are too far from the chain's
    own answer, that is asked for from then on.
    """

    def __init__(self, chain: InputChain):
        self.chain = chain
        self._exactly = False
        self._checked: set[bytes] = set()

    def starts(self, values: np.ndarray) -> np.ndarray:
        """Return the changes (m, 12) of pelvis and rate at the start for values (m, p)."""
        if self._is_exact_at(values):
            return np.array([self.chain.own(row)[1] for row in values])
        basis = self.chain.basis
        return np.asarray(basis.weights(values) @ basis.starts)

    def commands(self, values: np.ndarray) -> np.ndarray:
        """Return the changes (m, nstep, 6) of the command for values (m, p)."""
        if self._is_exact_at(values):
            return np.array([self.chain.own(row)[0] for row in values])
        basis = self.chain.basis
        return np.asarray(np.tensordot(basis.weights(values), basis.commands, axes=1))

    def _is_exact_at(self, values: np.ndarray) -> bool:
        """Return whether the chain is asked itself: where its basis is too far off at the first point of some call."""
        basis = self.chain.basis
        if self._exactly or basis.nodes is not None:
            return self._exactly
        cell = np.round(values[0] / self.chain.cell).tobytes()
        if cell not in self._checked:
            self._checked.add(cell)
            told = np.tensordot(basis.weights(values[:1]), basis.commands, axes=1)[0]
            off = self.chain.own(values[0])[0] - told
            off[:, 3:] *= _LEVER
            self._exactly = not np.sqrt(np.mean(off**2)) < _APART
        return self._exactly
