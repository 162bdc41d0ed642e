"""What two records could have shown: the smallest size at which an effect would have been told from none.

An effect of some size is simulated beside the plain fit. What the plain plant would leave of it, its parameters fitted
anew on the tangent, is what the effect would earn; it is told where that is more than the decision asks of a law
against `none`, with the scatter that noise gives it. That scatter is of simulated noise, which may lie along what the
effect changes more than white noise does. What is swallowed whole (by a start pose that is free, by stiffness or
damping) is invisible at any size.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from real2sim.diagnosis.decide import gain_of_a_law
from real2sim.diagnosis.refit import Hypothesis, JointResiduals
from real2sim.diagnosis.search import Pair
from real2sim.effects.base import Scales
from real2sim.effects.catalogue import EFFECTS, Placed
from real2sim.inference.least_squares import bounded_step
from real2sim.parallel import in_threads
from real2sim.system.description import System

if TYPE_CHECKING:
    from real2sim.settings import DiagnosisSettings

# Sizes that are simulated, between the smallest and the largest that is searched
_SIZES = 14
# Smallest size of a parameter that may be nothing, as a share of the largest
_SMALLEST = 1e-3
# Standard deviations below which 5 % of a normal distribution lie
_ONE_SIDED_95 = 1.645


def could_have_shown(pair: Pair, plain: Hypothesis, options: DiagnosisSettings) -> list[dict[str, Any]]:
    """Return one entry per effect of ``diagnosis.report.visible``, place and parameter.

    ``from`` is the smallest size that would have been told from `none` in 95 % of such records [``unit``], None where
    none that is searched would. ``options`` is the slice ``diagnosis`` of the configuration.
    """
    wanted = options["report"]["visible"]
    trials = _Trials(pair, plain, options)
    first = {effect.name: effect for effect in reversed(EFFECTS)}
    effects = [first[name] for name in wanted if name in first]
    places = [Placed(e, where, pair.train.scales) for e in effects for where in e.places(pair.system)]
    ladders = [(placed, *ladder) for placed in places for ladder in _ladders(placed)]
    return in_threads(pair.train.threads, lambda ladder: _entry(*ladder, trials, options), ladders)


def of_size(statement: Mapping[str, Any], system: System, scales: Scales) -> tuple[Placed, np.ndarray]:
    """Return the effect of a statement of `could_have_shown`, with the searched numbers (p,) of the size it gives."""
    first = next(effect for effect in EFFECTS if effect.name == statement["effect"])
    for where in first.places(system):
        placed = Placed(first, where, scales)
        if (placed.axes, where.side) == (statement["axes"], statement["side"]):
            names = [parameter.name for parameter in first.parameters]
            i = names.index(statement["parameter"])
            x = (placed.starts()[0] if first.parameters[i].log else placed.at_rest()).copy()
            # one of its scale: 0 where the logarithm is searched
            x[i] = 0.0 if first.parameters[i].log else 1.0
            size = statement["from"] / float(placed.values(x[None])[0, i])
            x[i] = np.log(size) if first.parameters[i].log else size
            return placed, x
    raise ValueError(f"no place of {statement['effect']} is {statement['axes']} {statement['side']}")


def _ladders(placed: Placed) -> Iterator[tuple[int, np.ndarray]]:
    """Parameters that say how large an effect is, and searched numbers (s, p) with growing sizes of each."""
    lower, upper = placed.bounds()
    rest, start = placed.at_rest(), placed.starts()[0]
    for i, parameter in enumerate(placed.effect.parameters):
        if parameter.log and i == 0:
            x = np.tile(start, (_SIZES, 1))
            x[:, 0] = np.linspace(lower[0], upper[0], _SIZES)
            yield i, x
        elif not parameter.log and parameter.lower <= 0 and rest[i] == 0:
            x = np.tile(rest, (_SIZES, 1))
            x[:, i] = upper[i] * np.geomspace(_SMALLEST, 1, _SIZES)
            yield i, x
        if parameter.log:
            return


class _Trials:
    """Both trials at the plain fit: residuals, slopes by the system's parameters, room for those, and noise."""

    def __init__(self, pair: Pair, plain: Hypothesis, options: DiagnosisSettings):
        longest = options["search"]["longest_step"]
        self._pair, self._base = pair, plain.base
        items = (pair.train, pair.held_out)
        known = [JointResiduals(e, (), pair.system, coarse=True) for e in items]
        both = [k.with_jacobian(plain.base, np.arange(len(plain.base))) for k in known]
        self._residuals = [r[: e.rows] for (r, _), e in zip(both, items, strict=True)]
        self._fitted, held_out = (j for _, j in both)
        self._held_out = held_out[: pair.held_out.rows]
        self._normal = self._fitted.T @ self._fitted + 1e-9 * np.eye(len(plain.base))
        lower, upper = pair.system.bounds()
        self._lower = np.maximum(lower - plain.base, -longest)
        self._upper = np.minimum(upper - plain.base, longest)
        # other draws than those that whiten
        drawn = (pair.system.values(plain.base), (), options["noise_draws"], options["search"]["seed"] + 1)
        self._noise = [e.noise_of((), *drawn) for e in items]

    def earned(self, placed: Placed, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return what the plain plant would leave of an effect of searched numbers (s, p), and its SD by noise.

        The first (s, 2) is of both trials, the second (s,) of their sum.
        """
        z = np.hstack([np.tile(self._base, (len(x), 1)), x])
        changes = []
        for evidence, here in zip((self._pair.train, self._pair.held_out), self._residuals, strict=True):
            problem = JointResiduals(evidence, (placed,), self._pair.system, coarse=True)
            changes.append(problem.many(z)[:, : evidence.rows] - here)
        left, scatter = np.full((len(x), 2), np.nan), np.full(len(x), np.nan)
        n = self._pair.train.rows
        for k, (fitted, held_out) in enumerate(zip(*changes, strict=True)):
            if np.isfinite(fitted).all() and np.isfinite(held_out).all():
                # the effect is in the data, so that the plain plant lacks it
                slope = self._fitted[:n].T @ -fitted
                step = bounded_step(self._normal, slope, self._lower, self._upper)
                ways = self._fitted[:n] @ step - fitted, self._held_out @ step - held_out
                left[k] = [way @ way for way in ways]
                scatter[k] = self._scatter(ways)
        return left, scatter

    def _scatter(self, ways: Sequence[np.ndarray]) -> float:
        """Return the SD by noise of chi-squared that is left in the direction of residuals (n_r,) of either trial.

        Chi-squared with non-centrality L scatters by 2 sqrt(L) about what it has more, where noise is white: the least
        that is taken.
        """
        by_draws = 0.0
        # the trials are independent, though draws of the same number begin with the same random numbers
        for noise, way in zip(self._noise, ways, strict=True):
            along = noise @ way
            # a draw that MuJoCo gives up on says nothing
            along = along[np.isfinite(along)]
            by_draws += float(np.mean(along**2)) if len(along) else 0.0
        return 2 * float(np.sqrt(max(by_draws, sum(way @ way for way in ways))))


def _entry(
    placed: Placed, index: int, x: np.ndarray, trials: _Trials, options: DiagnosisSettings
) -> dict[str, Any]:
    left, scatter = trials.earned(placed, x)
    sure = left.sum(axis=1) - _ONE_SIDED_95 * scatter
    needed = gain_of_a_law(options["calibration"]) + _occam(placed, index, x, left[:, 0])
    sizes = np.array([placed.values(row[None])[0, index] for row in x])
    parameter = placed.effect.parameters[index]
    rotational = bool(placed.where.axes) and placed.where.system.axes[placed.where.axes[0]].rotational
    return {
        "effect": placed.effect.name,
        "axes": placed.axes,
        "side": placed.where.side,
        "parameter": parameter.name,
        "from": _crossed(sizes, sure, needed),
        "unit": parameter.unit_for(rotational=rotational),
    }


def _occam(placed: Placed, index: int, x: np.ndarray, earned: np.ndarray) -> np.ndarray:
    """Return the Occam terms (s,), see `JointResiduals.occam_of`.

    By the curvature of an effect that grows in proportion to its size and earns so much (s,) of the fitted trial; its
    other parameters are taken as known as well as that one.
    """
    parameter = placed.effect.parameters[index]
    lower, upper = placed.bounds()
    sd = placed.prior_sd()[index]
    prior = sd if np.isfinite(sd) else (upper - lower)[index] / np.sqrt(12)
    per = 1.0 if parameter.log else x[:, index]
    return np.asarray(len(placed.effect.parameters) * np.log1p(earned * (prior / per) ** 2))


def _crossed(sizes: np.ndarray, sure: np.ndarray, needed: np.ndarray) -> float | None:
    """Return the smallest of ``sizes`` (s,) from which on ``sure`` (s,) stays above ``needed`` (s,); None without one.

    Sizes between those simulated are interpolated by straight lines of logarithms. A size whose simulation failed
    (``sure`` is NaN) is passed over.
    """
    simulated = np.isfinite(sure)
    sizes, sure, needed = (values[simulated] for values in (np.abs(sizes), sure, needed))
    enough = sure >= needed
    if not enough.any():
        return None
    last_short = np.flatnonzero(~enough)
    before = last_short[last_short < np.flatnonzero(enough)[-1]]
    if not len(before):
        return float(sizes[0])
    i = int(before[-1])
    low, high = (np.log(max(sure[k], 1e-3)) - np.log(needed[k]) for k in (i, i + 1))
    share = -low / max(high - low, 1e-12)
    a, b = np.log(sizes[i]), np.log(sizes[i + 1])
    return float(np.exp(a + np.clip(share, 0, 1) * (b - a)))
