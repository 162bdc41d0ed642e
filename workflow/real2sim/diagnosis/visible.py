"""What two records could have shown: the smallest size at which an effect would have been told from none.

An effect of some size is simulated beside the plain fit. What the plain plant would leave of it, its parameters fitted
anew on the tangent, is what the effect would earn; it is told where that is more than the decision asks of a law
against `none`, and lifts what is left above noise, with the scatter that noise gives it. That scatter is of simulated
noise, which may lie along what the effect changes more than white noise does. What is swallowed whole (by a start pose
that is free, by stiffness or damping) is invisible at any size.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from real2sim.diagnosis.decide import gain_of_a_law, reach
from real2sim.diagnosis.evidence import Evidence
from real2sim.diagnosis.refit import Hypothesis, JointResiduals, refit
from real2sim.diagnosis.search import Pair, Search
from real2sim.diagnosis.sensors import above, by_sensor, pooled
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
# Step [ln] of a plain parameter from which on the tangent is not believed; how often it is refitted then, and by how
# much beyond what the last refit promises
_BELIEVED, _REFITS, _BEYOND = 0.3, 8, 1.05
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
    return in_threads(pair.train.threads, lambda ladder: _entry(*ladder, trials), ladders)


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


@dataclass(frozen=True)
class _Left:
    """Leftovers of an effect beside the plain plant: chi-squared ``by_trial`` (2,), and its SD by noise, ``scatter``.

    ``shown`` is by how much chi-squared rises above what noise may leave: a sensor that is quieter than expected hides
    some. ``step`` is the longest step [as searched] that the plain parameters take.
    """

    by_trial: tuple[float, float]
    scatter: float
    shown: float
    step: float

    def sure(self, occam: float, trials: _Trials) -> float:
        """Return the share that it has in 95 % of records of what tells an effect from none."""
        noise = _ONE_SIDED_95 * self.scatter
        earned = (sum(self.by_trial) - noise) / (trials.gain + occam)
        return min(earned, (self.shown - noise) / trials.hidden) if trials.hidden > 0 else earned


class _Changed(JointResiduals):
    """Residuals of the plain plant, fitted to what an effect changes (n_r,) of its own at ``z`` (n,)."""

    def __init__(self, evidence: Evidence, system: System, z: np.ndarray, change: np.ndarray):
        super().__init__(evidence, (), system, coarse=True)
        self._shift = super().many(z[None])[0]
        self._shift[: len(change)] += change

    def many(self, z: np.ndarray) -> np.ndarray:
        """As of `JointResiduals`."""
        return np.asarray(super().many(z) - self._shift)


class _Trials:
    """Both trials at the plain fit: residuals, slopes by the system's parameters, room for those, and noise.

    ``gain`` is the deviance that a law has to earn, ``hidden`` what an effect has to add to chi-squared before the
    plain fit leaves so much that any is looked for.
    """

    def __init__(self, pair: Pair, plain: Hypothesis, options: DiagnosisSettings):
        self._search_options = options["search"]
        longest = self._search_options["longest_step"]
        self._pair, self._base = pair, plain.base
        self._items = (pair.train, pair.held_out)
        known = [JointResiduals(e, (), pair.system, coarse=True) for e in self._items]
        both = [k.with_jacobian(plain.base, np.arange(len(plain.base))) for k in known]
        self._residuals = [r[: e.rows] for (r, _), e in zip(both, self._items, strict=True)]
        self._fitted, held_out = (j for _, j in both)
        self._held_out = held_out[: pair.held_out.rows]
        self._normal = self._fitted.T @ self._fitted + 1e-9 * np.eye(len(plain.base))
        lower, upper = pair.system.bounds()
        self._lower = np.maximum(lower - plain.base, -longest)
        self._upper = np.minimum(upper - plain.base, longest)
        # other draws than those that whiten
        drawn = (pair.system.values(plain.base), (), options["noise_draws"], options["search"]["seed"] + 1)
        self._noise = [e.noise_of((), *drawn) for e in self._items]
        search, least = Search(pair, options["search"]), options["search"]["questionable_probability"]
        self._plain, self._expected = np.array(pooled(plain.by_sensor)), pooled(pair.samples_by_sensor)
        self._on_floor, self._above = search.on_floor, search.above(plain)
        self.gain = gain_of_a_law(options["calibration"])
        self.hidden = reach(sum(search.samples), least, options["calibration"]) - self._above

    def left(self, placed: Placed, x: np.ndarray) -> list[_Left | None]:
        """Return what the plain plant would leave of an effect of searched numbers (s, p), fitted on the tangent.

        None where MuJoCo gives up.
        """
        out: list[_Left | None] = []
        n = self._pair.train.rows
        for fitted, held_out in self._changes(placed, x):
            if not (np.isfinite(fitted).all() and np.isfinite(held_out).all()):
                out.append(None)
                continue
            # the effect is in the data, so that the plain plant lacks it
            slope = self._fitted[:n].T @ -fitted
            step = bounded_step(self._normal, slope, self._lower, self._upper)
            ways = self._fitted[:n] @ step - fitted, self._held_out @ step - held_out
            out.append(self._told(ways, step))
        return out

    def refitted(self, placed: Placed, x: np.ndarray) -> _Left | None:
        """Return the same of an effect of searched numbers (p,), with the plain plant's parameters refitted."""
        ((fitted, held_out),) = self._changes(placed, x[None])
        if not (np.isfinite(fitted).all() and np.isfinite(held_out).all()):
            return None
        problem = _Changed(self._pair.train, self._pair.system, self._base, fitted)
        own = self._search_options
        z, _ = refit(problem, self._base, iterations=own["iterations"], ftol=own["ftol"])
        there = JointResiduals(self._pair.held_out, (), self._pair.system, coarse=True).many(z[None])[0]
        other = there[: len(held_out)] - self._residuals[1] - held_out
        return self._told((problem.many(z[None])[0][: len(fitted)], other), z - self._base)

    def _changes(self, placed: Placed, x: np.ndarray) -> Iterator[tuple[np.ndarray, np.ndarray]]:
        """Yield what an effect of each searched numbers (s, p) changes of the residuals (n_r,) of both trials."""
        z = np.hstack([np.tile(self._base, (len(x), 1)), x])
        changes = []
        for evidence, here in zip(self._items, self._residuals, strict=True):
            problem = JointResiduals(evidence, (placed,), self._pair.system, coarse=True)
            changes.append(problem.many(z)[:, : evidence.rows] - here)
        yield from zip(*changes, strict=True)

    def _told(self, ways: tuple[np.ndarray, np.ndarray], step: np.ndarray) -> _Left:
        """Return what residuals (n_r,) of either trial amount to, after a ``step`` (n,) of the parameters."""
        by_trial = [
            by_sensor(way[None], e.sensors.values())[0] for way, e in zip(ways, self._items, strict=True)
        ]
        now = above(self._plain + sum(by_trial), self._expected, self._on_floor)
        fitted, held_out = (float(own.sum()) for own in by_trial)
        longest = float(np.abs(step).max(initial=0.0))
        return _Left((fitted, held_out), self._scatter(ways), now - self._above, longest)

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


def _entry(placed: Placed, index: int, x: np.ndarray, trials: _Trials) -> dict[str, Any]:
    left = trials.left(placed, x)
    fitted = np.array([np.nan if one is None else one.by_trial[0] for one in left])
    occam = _occam(placed, index, x, fitted)
    sure = np.array(
        [np.nan if one is None else one.sure(o, trials) for one, o in zip(left, occam, strict=True)]
    )
    sizes = np.array([placed.values(row[None])[0, index] for row in x])
    size = _crossed(sizes, sure, np.ones(len(x)))
    if size is not None:
        i = int(np.argmin(np.abs(np.log(np.abs(sizes / size)))))
        nearest = left[i]
        if nearest is None or nearest.step > _BELIEVED:
            size = _confirmed(placed, index, x[i], size, float(np.abs(sizes).max()), trials)
    parameter = placed.effect.parameters[index]
    rotational = bool(placed.where.axes) and placed.where.system.axes[placed.where.axes[0]].rotational
    return {
        "effect": placed.effect.name,
        "axes": placed.axes,
        "side": placed.where.side,
        "parameter": parameter.name,
        "from": size,
        "unit": parameter.unit_for(rotational=rotational),
    }


def _confirmed(
    placed: Placed, index: int, x: np.ndarray, size: float, largest: float, trials: _Trials
) -> float | None:
    """Return the size from which on an effect shows beside refitted parameters, which take long steps beside it.

    ``x`` (p,) are the searched numbers at another size. None where it does not show up to the ``largest``.
    """
    values = placed.values(x[None])
    for _ in range(_REFITS):
        values[0, index] = np.copysign(size, values[0, index])
        row = placed.searched(values)
        left = trials.refitted(placed, row[0])
        if left is None:
            return None
        share = left.sure(float(_occam(placed, index, row, np.array([left.by_trial[0]]))[0]), trials)
        if share >= 1:
            return size
        # what is left grows with the square of the size
        size *= _BEYOND * float(np.sqrt(1 / max(share, 0.25)))
        if size > largest:
            break
    return None


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
