"""Screening on the tangent and joint refits of one pair of trials: what the attribution searches with.

Refitting the system's parameters absorbs most of the gap of many effects, so an effect is judged by a joint refit
(those and its own parameters) on the training trial and by what it leaves of the held-out one: as that fit predicts it,
or with numbers that are fitted to both, where that matters for which of two is the better (`both_trials`).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import combinations
from threading import Lock
from typing import TYPE_CHECKING

import numpy as np
import scipy

from real2sim.diagnosis.both_trials import fit_both
from real2sim.diagnosis.evidence import Evidence
from real2sim.diagnosis.refit import BATCH, Hypothesis, JointResiduals, refit, refit_freely
from real2sim.diagnosis.sensors import above, are_on_floor, by_sensor, pooled
from real2sim.effects.catalogue import Placed
from real2sim.effects.free_run import feed_back
from real2sim.inference.least_squares import Tangent, bounded_step
from real2sim.memory import give_back
from real2sim.parallel import in_threads
from real2sim.system.description import System

if TYPE_CHECKING:
    from real2sim.settings import DiagnosisSearchSettings

# Chi-squared of a set of effects that MuJoCo gives up on
FAILED = 1e12
# Hypotheses that are refitted to both trials before it is asked again which of them could be the best
_AT_A_TIME = 2


def failed(sensors: int) -> tuple[float, ...]:
    """Return chi-squared by sensor of what cannot be simulated."""
    return (FAILED / sensors,) * sensors


def samples_by_sensor(items: Sequence[Evidence]) -> tuple[tuple[int, ...], ...]:
    """Return the numbers of whitened residuals that count, by sensor, trial by trial."""
    return tuple(e.samples_by_sensor for e in items)


@dataclass(frozen=True)
class Pair:
    """Training and held-out trial of one system, whitened, with common scales.

    ``exchanged``: the trial that was to be fitted shows no gap and the other does, so that they changed places.
    """

    train: Evidence
    held_out: Evidence
    system: System
    exchanged: bool = False

    @property
    def shown(self) -> Evidence:
        """The trial that shows the gap: the held-out one, but where they changed places."""
        return self.train if self.exchanged else self.held_out

    @property
    def samples_by_sensor(self) -> tuple[tuple[int, ...], ...]:
        """Whitened residuals that count, by sensor, trial by trial."""
        return samples_by_sensor((self.train, self.held_out))

    def on_floor(self, sd: float) -> tuple[bool, ...]:
        """Return of each sensor whether it is on its floor: see `are_on_floor`."""
        noise = pooled([self.train.noise_by_sensor, self.held_out.noise_by_sensor])
        return are_on_floor(noise, pooled(self.samples_by_sensor), sd)


@dataclass(frozen=True)
class Beside:
    """Tangent of an effect beside others: at ``z`` (n + p,), with ``residuals`` (n_r,) and its ``columns`` (n_r, p).

    ``jacobian_before`` (n_b, n), of fewer prior rows, is that of the others. It is shared: of hundreds of hypotheses,
    copies of it would fill the memory.
    """

    z: np.ndarray
    residuals: np.ndarray
    columns: np.ndarray
    jacobian_before: np.ndarray

    @property
    def jacobian(self) -> np.ndarray:
        """The Jacobian (n_r, n + p)."""
        more = len(self.residuals) - len(self.jacobian_before)
        return np.hstack([np.pad(self.jacobian_before, ((0, more), (0, 0))), self.columns])

    @property
    def whole(self) -> Tangent:
        """The same with a Jacobian of its own."""
        return Tangent(self.z, self.residuals, self.jacobian)


@dataclass
class Screened:
    """A hypothesis before its refit: predicted cost on the training trial and where to start.

    ``tangent`` is what it was predicted with: residuals (n_r,) and Jacobian (n_r, n + p) at (n + p,), the columns of
    the strap and of effects fitted before being those without it.
    """

    effects: tuple[Placed, ...]
    predicted: float
    start: np.ndarray
    tangent: Beside


def conflict(effects: Sequence[Placed]) -> bool:
    """Return whether effects exclude each other.

    Two cannot both stand for the spring of one axis, nor two forms of one law for what it does there, nor write the
    same of the plant.
    """
    written = [what for placed in effects for what in placed.effect.plant.overwrites(placed.where)]
    if len(written) != len(set(written)):
        return True
    taken = [axis for placed in effects if placed.effect.plant.replaces_spring for axis in placed.where.axes]
    laws = [(p.effect.name, p.where.axes, p.where.side) for p in effects if len(p.where.axes) == 1]
    return len(taken) != len(set(taken)) or len(laws) != len(set(laws))


class Search:
    """Screening and refits on one pair of trials."""

    def __init__(
        self, pair: Pair, settings: DiagnosisSearchSettings, progress: Callable[[str], None] | None = None
    ):
        self.pair, self._settings = pair, settings
        self._progress = progress or (lambda text: None)
        self.evaluations = 0
        self._counting = Lock()
        self._noise: dict[tuple[str, bytes], tuple[np.ndarray, np.ndarray]] = {}
        # the plain fit, once there is one
        self.plain: Hypothesis | None = None
        self._screened_from: Tangent | None = None
        # what was screened beside the plain plant: its tangent there, and those of each effect by its key
        self._plain: Tangent | None = None
        self._alone: dict[str, Beside] = {}

    @property
    def threads(self) -> int:
        """Hypotheses that are tried at a time."""
        return self.pair.train.threads

    def _count(self, evaluations: int) -> None:
        """Add to ``evaluations``, which several threads do."""
        with self._counting:
            self.evaluations += evaluations

    def fit(
        self,
        effects: Sequence[Placed],
        start: np.ndarray,
        final: bool = False,
        tangent: Tangent | None = None,
    ) -> Hypothesis:
        """Refit on the training trial and evaluate on the held-out one; ``final`` goes on until it has converged.

        ``start`` (n + p,) holds searched numbers of the system's n parameters and the effects' p. ``tangent``, where
        one was taken near the start, spares the first Jacobian as far as it predicts the start.
        """
        residuals = self._residuals(effects, coarse=not final)
        own = self._settings
        iterations, ftol, keep = own["iterations"], own["ftol"], own["keep_jacobian"]
        if final:
            # what the verdict rests on takes a new Jacobian at every step
            iterations, ftol, keep = own["final_iterations"], own["final_ftol"], 0.0
        z, _ = refit(residuals, start, iterations=iterations, ftol=ftol, keep=keep, known=tangent)
        follows = feed_back(effects)
        if follows:
            z = refit_freely(residuals, z, iterations=iterations, ftol=ftol)
        slopes = residuals.last
        if slopes is None and tangent is not None:
            slopes = tangent.jacobian[:, residuals.free]
        occam = 0.0 if slopes is None else residuals.occam_of(z, slopes)
        held_out = JointResiduals(self.pair.held_out, effects, self.pair.system, coarse=not final)
        if len(held_out.free):
            z, _ = refit(held_out, z, iterations=iterations, ftol=ftol)
            # what the other trial has of its own pays there for what it could have been
            occam += 0.0 if held_out.last is None else held_out.occam_of(z, held_out.last)
        judged = [residuals.judged(z), held_out.judged(z)]
        # what cannot be simulated, itself or near by, explains nothing
        simulated = np.isfinite(occam) and all(np.isfinite([*left, j]).all() for left, j in judged)
        if not simulated:
            judged = [(failed(len(left)), FAILED) for left, _ in judged]
            occam = 0.0
        count = residuals.evaluations + held_out.evaluations
        self._count(count)
        (train, j_train), (other, j_other) = judged
        left = sum(train), sum(other)
        give_back()
        motions = (residuals.motion, held_out.motion) if follows and simulated else ()
        return Hypothesis(
            tuple(effects), z, left, (j_train, j_other), count, final, occam, (train, other), motions
        )

    def _residuals(self, effects: Sequence[Placed], *, coarse: bool = True) -> JointResiduals:
        """Those of the training trial; what is only searched with does not need the finest time step."""
        return JointResiduals(self.pair.train, effects, self.pair.system, coarse=coarse)

    @property
    def samples(self) -> tuple[int, int]:
        """Whitened residuals of the two trials that count."""
        return self.pair.train.samples, self.pair.held_out.samples

    @property
    def samples_by_sensor(self) -> tuple[tuple[int, ...], ...]:
        """The same by sensor, trial by trial."""
        return self.pair.samples_by_sensor

    @property
    def on_floor(self) -> tuple[bool, ...]:
        """Of each sensor whether it is on its floor."""
        return self.pair.on_floor(self._settings["pair_excess_sigma"])

    def is_expected(self, left: float) -> bool:
        """Return whether chi-squared of both trials is no more than noise leaves: of a sensor on its floor, less."""
        noise = pooled([self.pair.train.noise_by_sensor, self.pair.held_out.noise_by_sensor])
        each = zip(noise, pooled(self.samples_by_sensor), self.on_floor, strict=True)
        count = sum(quiet if floor else n for quiet, n, floor in each)
        return bool(left < count + self._settings["pair_excess_sigma"] * np.sqrt(2 * max(count, 1.0)))

    def above(self, hypothesis: Hypothesis) -> float:
        """Return chi-squared of both trials less its expectation; a sensor on its floor is granted that.

        What the fit to the first trial leaves: how much is unexplained is asked of what it predicts.
        """
        return above(pooled(hypothesis.by_sensor), pooled(self.samples_by_sensor), self.on_floor)

    def above_by_trial(self, hypothesis: Hypothesis) -> tuple[float, float]:
        """Return the same of the fitted and of the held-out trial."""
        each = zip(hypothesis.by_sensor, self.samples_by_sensor, strict=True)
        train, held_out = (above(left, expected, self.on_floor) for left, expected in each)
        return train, held_out

    def beyond(self, hypothesis: Hypothesis) -> float:
        """Return chi-squared of both trials beyond its expectation, as `above` but at least 0."""
        return max(self.above(hypothesis), 0.0)

    def excess(self, hypothesis: Hypothesis) -> float:
        """Return what a hypothesis leaves beyond noise, in SD of what noise leaves.

        Where that stands out, the noise is simulated through the hypothesis itself, which may pass on more of it, and
        what counts is left by numbers that are fitted to both trials. Each trial counts in units of its own scatter
        (Stouffer's sum): one that passes on much noise hides nothing of the other.
        """
        expected = pooled(self.samples_by_sensor)
        out = _excess(pooled(hypothesis.competing.by_sensor), expected, self.on_floor, None)
        if out < self._settings["pair_excess_sigma"] or not hypothesis.effects:
            return out
        return sum(self.excess_of_trials(hypothesis)) / float(np.sqrt(2))

    def left_of_both(self, hypothesis: Hypothesis) -> tuple[tuple[float, ...], ...]:
        """Chi-squared by sensor, trial by trial, with numbers that are fitted to both: asked once, and kept."""
        if hypothesis.both is None:
            own = self._settings
            both, count = fit_both(
                self.pair,
                hypothesis,
                iterations=own["iterations"],
                ftol=own["ftol"],
                keep=own["keep_jacobian"],
            )
            self._count(count)
            hypothesis.both = both
            give_back()
        return hypothesis.both.by_sensor

    def is_open(self, hypothesis: Hypothesis) -> bool:
        """Return whether numbers that are fitted to both trials may leave less: the held-out one is not all noise.

        Not where that was asked, and not of what cannot be simulated.
        """
        if hypothesis.both is not None or max(hypothesis.chi2) >= FAILED:
            return False
        sd = np.sqrt(2 * max(self.samples[1], 1.0))
        return bool(self.above_by_trial(hypothesis)[1] > self._settings["pair_excess_sigma"] * sd)

    def fit_rivals_to_both(
        self, found: Sequence[Hypothesis], reach: Callable[[Hypothesis], float], *, priced: bool = True
    ) -> Hypothesis:
        """Refit to both trials what could then be the best hypothesis, and return the one of least deviance.

        Refitted are those that would come within ``reach`` of the best one if they left as little of the held-out
        trial as of the fitted one (`_could_gain`). ``priced``: by deviance, else by chi-squared alone.
        """

        def cost(h: Hypothesis) -> float:
            return h.deviance if priced else sum(h.left)

        while True:
            best = min(found, key=cost)
            most = cost(best) + reach(best)
            gains = {i: self._could_gain(h) for i, h in enumerate(found) if self.is_open(h)}
            could = {i: cost(found[i]) - gain for i, gain in gains.items() if gain > 0}
            asked = sorted((i for i in could if could[i] <= most), key=lambda i: could[i])
            if not asked:
                return best
            # as many at a time whatever the number of threads, so that the answer does not depend on it
            in_threads(self.threads, self.left_of_both, [found[i] for i in asked[:_AT_A_TIME]])

    def _could_gain(self, hypothesis: Hypothesis) -> float:
        """Return how much less is left of the held-out trial if its share is that of the fitted trial.

        Shares of what the plain plant leaves beyond noise; where that is not known, only noise is left.
        """
        train, held_out = self.above_by_trial(hypothesis)
        plain = (0.0, 0.0) if self.plain is None else self.above_by_trial(self.plain)
        ratio = max(plain[1], 0.0) / plain[0] if plain[0] > 0 else 0.0
        return max(held_out - max(train, 0.0) * ratio, 0.0)

    def least(self, found: Sequence[Hypothesis]) -> Hypothesis:
        """Return the hypothesis that leaves least of both trials: see `fit_rivals_to_both`."""
        return self.fit_rivals_to_both(found, lambda best: 0.0, priced=False)

    def best_first(self, found: Sequence[Hypothesis]) -> list[Hypothesis]:
        """Return hypotheses by what they leave of both trials, `least` first."""
        if found:
            self.least(found)
        return sorted(found, key=lambda h: sum(h.left))

    def excess_of_trials(self, hypothesis: Hypothesis) -> tuple[float, float]:
        """The same of the fitted and of the held-out trial, by noise that is simulated through the hypothesis."""
        left = self.left_of_both(hypothesis)
        each = zip(left, self.samples_by_sensor, self._noise_of(hypothesis), strict=True)
        train, held_out = (_excess(left, expected, self.on_floor, draws) for left, expected, draws in each)
        return train, held_out

    def loudest_sensor(self, hypothesis: Hypothesis) -> str:
        """Return the name of the sensor whose `excess` is the largest, of those that were recorded."""
        left, expected = pooled(self.left_of_both(hypothesis)), pooled(self.samples_by_sensor)
        train, held_out = self._noise_of(hypothesis)
        each = zip(self.pair.train.sensors, left, expected, (train + held_out).T, strict=True)
        excess = {name: _excess([a], [n], [False], draws[:, None]) for name, a, n, draws in each if n > 0}
        return max(excess, key=lambda name: excess[name])

    def _noise_of(self, hypothesis: Hypothesis) -> tuple[np.ndarray, np.ndarray]:
        """Chi-squared (draws, sensors) of noise alone of both trials where the hypothesis is the truth."""
        key = hypothesis.key, hypothesis.z.tobytes()
        if key not in self._noise:
            parameters, x = self.pair.system.values(hypothesis.base), hypothesis.split()
            settled = (hypothesis.effects, parameters, x, BATCH - 1, self._settings["seed"])
            trials = (self.pair.train, self.pair.held_out)
            train, held_out = in_threads(
                self.threads,
                lambda trial: by_sensor(trial.noise_of(*settled), trial.sensors.values()),
                trials,
            )
            self._count(2 * BATCH)
            self._noise[key] = train, held_out
        return self._noise[key]

    def is_noise(self, hypothesis: Hypothesis) -> bool:
        """Return whether a hypothesis leaves nothing that a further effect has to explain."""
        return bool(self.excess(hypothesis) < self._settings["pair_excess_sigma"])

    def fit_screened(self, screened: Screened) -> Hypothesis:
        """Refit from where the tangent points to, and from where it was taken if that was better than what came out.

        Once more where even the start without the strap's old parameters is better than what came out.
        """
        fitted = self.fit(screened.effects, screened.start, tangent=screened.tangent.whole)
        origin = screened.tangent.z
        if fitted.chi2[0] > float(np.sum(screened.tangent.residuals**2)):
            again = self.fit(screened.effects, origin)
            fitted = again if again.chi2[0] < fitted.chi2[0] else fitted
        own = len(screened.effects[-1].effect.parameters)
        return self.refit_fresh(screened.effects, origin[: len(origin) - own], fitted)

    def refit_fresh(self, effects: tuple[Placed, ...], base: np.ndarray, fitted: Hypothesis) -> Hypothesis:
        """Refit with the last effect from its best fresh start, where that alone is better than ``fitted``.

        Of an effect that has no axis, already where it is better than the fit without the effect. ``base`` (n,) is as
        in `fresh`.
        """
        z, cost = self.fresh(effects, base)
        if not (cost < fitted.chi2[0] or self._is_worth_a_fit(effects, cost, fitted)):
            return fitted
        again = self.fit(effects, z)
        return again if again.chi2[0] < fitted.chi2[0] else fitted

    def _is_worth_a_fit(self, effects: tuple[Placed, ...], cost: float, fitted: Hypothesis) -> bool:
        """Return whether a start that costs more than ``fitted`` may yet end lower.

        What acts everywhere, a delay say, has bent every parameter: a start better than without it is worth a fit.
        """
        if effects[-1].where.axes or self._screened_from is None:
            return False
        if not cost < float(np.sum(self._screened_from.residuals**2)):
            return False
        # asked last: noise is simulated for it
        return not self.is_noise(fitted)

    def fresh(
        self, effects: tuple[Placed, ...], base: np.ndarray, near: Mapping[str, float] | None = None
    ) -> tuple[np.ndarray, float]:
        """Return the best start (n + p,) of the last effect beside ``base`` (n,) by its cost alone, and that cost.

        What a fit without the effect made of it stands in stiffness and damping of its axis, at their bounds for strong
        friction, and no tangent leads out of there. So these are tried from the middle of their range too. Constants of
        a name in ``near`` are also tried at the searched number there. ``base`` holds the searched numbers of the
        system and of the effects before the last one, which has p.
        """
        law, residuals = effects[-1], self._residuals(effects)
        z = _fresh_starts(law, base, self.pair.system, self._settings["strengths"])
        costs = self._costs(residuals, z)
        # friction near the force that the strap carries slides or holds from move to move: its valleys are narrow
        between = _strengths_between(law, z, costs, self._settings["strengths_between"])
        more = _carried_starts(law, base, near) if near else z[:0]
        z = np.vstack([z, between, more])
        costs = np.concatenate([costs, self._costs(residuals, z[len(costs) :])])
        best = _weakest_of_best(law, z, costs)
        return z[best], float(costs[best])

    def _costs(self, residuals: JointResiduals, z: np.ndarray) -> np.ndarray:
        """Return the costs (s,) of starts (s, n), of those that cannot be simulated the largest there is."""
        costs = residuals.costs(z) if len(z) else np.empty(0)
        self._count(len(z))
        return np.where(np.isfinite(costs), costs, FAILED)

    def drawn(
        self, effects: tuple[Placed, ...], base: np.ndarray, near: Mapping[str, float], count: int
    ) -> tuple[np.ndarray, np.ndarray]:
        """``count`` drawn starts (s, n) of the last effect beside ``base``, best first, and their costs (s,).

        Constants of a name in ``near`` are drawn about the searched number there, the others within their bounds.
        """
        law = effects[-1]
        lower, upper = law.bounds()
        for i, parameter in enumerate(law.effect.parameters):
            if parameter.log and parameter.name in near:
                about = near[parameter.name] + np.array([-1, 1]) * self._settings["redraw_range_ln"]
                lower[i], upper[i] = np.clip(about, lower[i], upper[i])
        points = scipy.stats.qmc.Sobol(len(lower), seed=self._settings["seed"]).random(count)
        z = np.hstack([np.tile(base, (count, 1)), lower + points * (upper - lower)])
        costs = self._costs(self._residuals(effects), z)
        order = np.argsort(costs, kind="stable")
        return z[order], costs[order]

    def bearable(self, effects: tuple[Placed, ...], base: np.ndarray, x: np.ndarray) -> np.ndarray:
        """``base`` with the start ``x`` (p,) of the last effect, weakened until the simulation bears it.

        A spring that softens is a spring that lets go where the strap of ``base`` is softer than the plain one.
        """
        residuals = self._residuals(effects)
        z = np.concatenate([base, x])
        for weaker in _weakened(effects[-1], x, self._settings["weakenings"]):
            z = np.concatenate([base, weaker])
            if np.isfinite(residuals.costs(z[None])[0]):
                break
        self._count(residuals.evaluations)
        return z

    def mark_spikes(self, best: Hypothesis) -> bool:
        """Look for jumps of the markers in what a hypothesis leaves of both trials; whether there are new ones.

        Where there are, `pair` is another one from then on.
        """
        before = self.pair
        train, held_out = (
            evidence.with_spikes(JointResiduals(evidence, best.effects, before.system).paths(best.z))
            for evidence in (before.train, before.held_out)
        )
        self.pair = replace(before, train=train, held_out=held_out)
        return train is not before.train or held_out is not before.held_out

    def screen(
        self, base: Hypothesis, places: Sequence[Placed], *, weaken: bool = True, likely: int | None = None
    ) -> list[Screened]:
        """Predicted cost of adding each place to a fitted hypothesis, best first; ``weaken``: weaker starts too.

        With ``likely`` those places are screened that `_likely` expects the most of.
        """
        problem = self._residuals(base.effects)
        here = Tangent(base.z, *problem.with_jacobian(base.z, np.arange(len(base.z))))
        self._screened_from = here
        self._count(problem.evaluations)
        sets = [(*base.effects, placed) for placed in places]
        sets = [effects for effects in sets if not conflict(effects)]
        if likely is not None:
            sets = self._likely(sets, here, likely)
        rounds = self._settings["weakenings"] if weaken else 1
        found = in_threads(self.threads, lambda effects: self._screen_one(effects, here, rounds), sets)
        out = sorted((one for one in found if one is not None), key=lambda s: s.predicted)
        if not base.effects and self._plain is None:
            self._plain, self._alone = here, {s.effects[-1].key: s.tangent for s in out}
        return out

    def _likely(
        self, sets: Sequence[tuple[Placed, ...]], here: Tangent, most: int
    ) -> list[tuple[Placed, ...]]:
        """The ``most`` sets whose last effect promises most beside the others, the best of each name among them.

        What an effect does beside the others is taken to be what it did beside the plain plant, which no replay is
        asked for. An effect that was not screened there is kept.
        """
        if self._plain is None:
            return list(sets)
        promised: list[tuple[float, tuple[Placed, ...]]] = []
        for effects in sets:
            alone = self._alone.get(effects[-1].key)
            cost = -np.inf
            if alone is not None:
                tangent = _carried(self._plain, alone, here)
                cost = _bounded_step(tangent, *self._bounds(effects), self._settings["longest_step"])[1]
            promised.append((cost, effects))
        promised.sort(key=lambda one: one[0])
        first: dict[str, tuple[Placed, ...]] = {}
        for _, effects in promised:
            first.setdefault(effects[-1].effect.name, effects)
        kept = {effects[-1].key for effects in (*(e for _, e in promised[:most]), *first.values())}
        return [effects for effects in sets if effects[-1].key in kept]

    def _bounds(self, effects: Sequence[Placed]) -> tuple[np.ndarray, np.ndarray]:
        """Return the lower and upper bounds (n + p,) of the system's searched numbers and those of effects."""
        each = [self.pair.system.bounds(), *(placed.bounds() for placed in effects)]
        lower, upper = (np.concatenate(ends) for ends in zip(*each, strict=True))
        return lower, upper

    def refits_beside(self, base: Hypothesis, places: Sequence[Placed], most: int) -> list[Hypothesis]:
        """Refits of the ``most`` places that promise most beside a fitted hypothesis.

        A base that cannot be simulated has no tangent: there the places begin at the best of their own starts.
        """
        if base.chi2[0] < FAILED:
            return in_threads(self.threads, self.fit_screened, self.screen(base, places)[:most])
        sets = [effects for effects in ((*base.effects, p) for p in places) if not conflict(effects)]
        starts = in_threads(self.threads, partial(self.fresh, base=base.z), sets)
        order = sorted(range(len(sets)), key=lambda i: starts[i][1])[:most]
        borne = [(sets[i], starts[i][0]) for i in order if starts[i][1] < FAILED]
        return in_threads(self.threads, lambda one: self.fit(*one), borne)

    def _screen_one(self, effects: tuple[Placed, ...], here: Tangent, rounds: int) -> Screened | None:
        """Predicted cost of the last effect beside the others, on the tangent at the best of its starts.

        Weaker starts are tried, ``rounds`` in all, as long as the tangent predicts more than is left without it.
        """
        placed = effects[-1]
        residuals = self._residuals(effects)
        lower, upper = residuals.lower, residuals.upper
        own = np.arange(len(here.z), len(lower))
        found: list[Screened] = []
        nothing = float(np.sum(here.residuals**2))
        for starts in _weakened(placed, placed.starts(), rounds):
            z = np.hstack([np.tile(here.z, (len(starts), 1)), starts])
            at = residuals.many(z)
            # prior rows of the base's own effects stand before those of the new one
            base = np.pad(here.residuals, (0, at.shape[1] - len(here.residuals)))
            logarithmic = any(parameter.log for parameter in placed.effect.parameters)
            slopes = None if logarithmic else _parabola(starts, at, base)
            usable = np.flatnonzero(np.isfinite(at).all(axis=1))
            if slopes is None and len(usable) > 1:
                # the slopes of one start are asked for: of the one that promises most by the base's slopes alone
                usable = usable[[self._promising_start(z[usable], at[usable], here, lower, upper)]]
            for i in usable:
                columns = residuals.jacobian(z[i], at[i], own) if slopes is None else slopes[i]
                tangent = Beside(z[i], at[i], columns, here.jacobian)
                step, cost = _bounded_step(tangent, lower, upper, self._settings["longest_step"])
                if np.isfinite(cost):
                    found.append(Screened(effects, cost, tangent.z + step, tangent))
            # a tangent that predicts more than the fit without the effect leaves was taken too far off
            if min((s.predicted for s in found), default=np.inf) <= nothing:
                break
        self._count(residuals.evaluations)
        return min(found, key=lambda s: s.predicted, default=None)

    def _promising_start(
        self, z: np.ndarray, at: np.ndarray, here: Tangent, lower: np.ndarray, upper: np.ndarray
    ) -> int:
        """Index of the start among points ``z`` (s, n + p) that the base alone brings lowest, by its slopes ``here``.

        ``at`` (s, n_r) are the residuals at those points, ``lower`` and ``upper`` (n + p,) the bounds.
        """
        n, longest = len(here.z), self._settings["longest_step"]
        nothing = np.empty((at.shape[1], 0))
        costs = [
            _bounded_step(Beside(point[:n], row, nothing, here.jacobian), lower[:n], upper[:n], longest)[1]
            for point, row in zip(z, at, strict=True)
        ]
        return int(np.argmin(costs))

    def pairs(self, screened: Sequence[Screened], most: int) -> list[Screened]:
        """Predicted cost of pairs among single effects of the last screening, best first, ``most`` of them."""
        here = self._screened_from
        assert here is not None, "pairs are made of what was screened"
        out = []
        for a, b in combinations(screened, 2):
            effects = (a.effects[-1], b.effects[-1])
            if effects[0].key == effects[1].key or conflict(effects):
                continue
            tangent = _carried(here, b.tangent, a.tangent.whole)
            step, cost = _bounded_step(tangent, *self._bounds(effects), self._settings["longest_step"])
            out.append(Screened(effects, cost, tangent.z + step, tangent))
            out = sorted(out, key=lambda s: s.predicted)[:most]
        return out


def _excess(
    left: Sequence[float], expected: Sequence[float], on_floor: Sequence[bool], draws: np.ndarray | None
) -> float:
    """Return chi-squared (s,) beyond noise, in SD of what noise leaves: as expected, or as drawn where that is more.

    ``draws`` (draws, s) are of noise alone.
    """
    total = float(sum(expected))
    # a sensor that was not recorded leaves nothing, and nothing is expected of it
    more, sd = above(left, expected, on_floor), float(np.sqrt(2 * max(total, 1.0)))
    if draws is None or not np.isfinite(draws).all():
        return more / sd
    drawn = np.array([above(row, expected, on_floor) for row in draws])
    return float((more - max(0.0, drawn.mean())) / max(sd, drawn.std()))


def _parabola(starts: np.ndarray, at: np.ndarray, base: np.ndarray) -> list[np.ndarray] | None:
    """Slopes (n_r, 1) of residuals ``at`` (2, n_r) two opposite starts (2, 1) of one parameter that is nothing at zero.

    They are those of the parabola through both and ``base`` (n_r,), which a law that is linear in its parameter hardly
    leaves: no replay is asked for them. None for other starts, or where one cannot be simulated.
    """
    opposite = starts.shape == (2, 1) and starts[0, 0] == -starts[1, 0] != 0
    if not opposite or not np.isfinite(at).all():
        return None
    odd = (at[1] - at[0]) / (starts[1, 0] - starts[0, 0])
    even = ((at[0] + at[1]) / 2 - base) / starts[0, 0] ** 2
    return [(odd + 2 * even * x)[:, None] for x in starts[:, 0]]


def _carried(plain: Tangent, alone: Beside, here: Tangent) -> Beside:
    """Tangent of an effect beside others at ``here``, that changes there what it changes ``alone`` beside ``plain``."""
    rows, own = len(plain.residuals), len(plain.z)
    # rows of the others' priors stand between
    between = len(here.residuals) - rows
    changed = np.pad(alone.residuals[:rows] - plain.residuals, (0, between))
    columns = np.vstack([np.pad(alone.columns[:rows], ((0, between), (0, 0))), alone.columns[rows:]])
    residuals = np.concatenate([here.residuals + changed, alone.residuals[rows:]])
    return Beside(np.concatenate([here.z, alone.z[own:]]), residuals, columns, here.jacobian)


def _weakened(placed: Placed, x: np.ndarray, count: int) -> Iterator[np.ndarray]:
    """Yield a start (p,) of an effect, or several (s, p), then weaker and weaker ones, ``count`` in all.

    Starts of an effect that has nothing to be weakened come once.
    """
    for _ in range(count):
        yield x
        weaker = placed.weaker(x)
        if np.array_equal(weaker, x):
            return
        x = weaker


def _fresh_starts(placed: Placed, base: np.ndarray, system: System, strengths: int) -> np.ndarray:
    """Starts (s, n) of an effect beside ``base``: its own and on up to its bound, the axis' parameters old and new.

    ``strengths`` of the effect are tried between its strongest start and its bound.
    New are the middles of their ranges: first the damping alone, then stiffness and damping; of an effect without an
    axis, all of the system's parameters.
    """
    starts, (_, upper) = placed.starts(), placed.bounds()
    x = starts
    if placed.effect.parameters and placed.effect.parameters[0].log:
        ladder = np.tile(starts[0], (strengths, 1))
        ladder[:, 0] = np.linspace(starts[:, 0].max(), upper[0], strengths + 1)[1:]
        x = np.concatenate([starts, ladder])
    lower_base, upper_base = system.bounds()
    middle = (lower_base + upper_base) / 2
    bases = [base]
    if len(placed.where.axes) == 1:
        axis = placed.where.axes[0]
        softer, freed = base.copy(), base.copy()
        for index in _of_axis(system.damping_of_axis, axis):
            softer[index] = freed[index] = middle[index]
        for index in _of_axis(system.stiffness_of_axis, axis):
            freed[index] = middle[index]
        bases += [softer, freed]
    elif not placed.where.axes:
        bases.append(np.concatenate([middle, base[len(middle) :]]))
    return np.array([np.concatenate([one, own]) for one in bases for own in x])


# Starts whose costs differ by less than this share are alike
_ALIKE = 1e-3


def _weakest_of_best(placed: Placed, z: np.ndarray, costs: np.ndarray) -> int:
    """Index of the best of the starts ``z`` (r, n): friction that always holds is alike at any strength, the weakest.

    ``costs`` (r,) are theirs; only starts of an effect whose first constant is a strength have a weakest.
    """
    own, best = len(placed.effect.parameters), int(np.argmin(costs))
    if not own or not placed.effect.parameters[0].log:
        return best
    alike = np.flatnonzero(costs <= costs[best] * (1 + _ALIKE))
    # a spring that stiffens is the weaker the longer it stays a spring, and a filter has no weaker one
    start = placed.starts()[-1]
    way = placed.weaker(start)[0] - start[0]
    return int(alike[np.argmax(way * z[alike, -own])]) if way else best


def _strengths_between(placed: Placed, z: np.ndarray, costs: np.ndarray, count: int) -> np.ndarray:
    """Starts (s, n) of an effect at strengths between the best of ``z`` (r, n) and the next weaker and stronger there.

    ``count`` on either side, where its first constant is one of strength.
    """
    own, best = len(placed.effect.parameters), _weakest_of_best(placed, z, costs)
    if not own or not placed.effect.parameters[0].log or costs[best] >= FAILED:
        return z[:0]
    others = np.delete(z[best], z.shape[1] - own)
    beside = np.sort(z[(np.delete(z, z.shape[1] - own, axis=1) == others).all(axis=1), -own])
    here = z[best, -own]
    ends = [*beside[beside < here][-1:], *beside[beside > here][:1]]
    out = np.tile(z[best], (count * len(ends), 1))
    out[:, -own] = [x for end in ends for x in np.linspace(here, end, count + 2)[1:-1]]
    return out


def _carried_starts(placed: Placed, base: np.ndarray, near: Mapping[str, float]) -> np.ndarray:
    """Starts (s, n) of an effect beside ``base``, constants of a name in ``near`` at the searched number there."""
    x, (lower, upper) = placed.starts().copy(), placed.bounds()
    for i, parameter in enumerate(placed.effect.parameters):
        if parameter.name in near:
            x[:, i] = np.clip(near[parameter.name], lower[i], upper[i])
    return np.hstack([np.tile(base, (len(x), 1)), x])


def _of_axis(index: Mapping[int, int], axis: int) -> list[int]:
    return [index[axis]] if axis in index else []


def _bounded_step(
    tangent: Beside, lower: np.ndarray, upper: np.ndarray, longest: float
) -> tuple[np.ndarray, float]:
    """Return the Gauss-Newton step inside the bounds, ``longest`` a coordinate, and the cost that it predicts."""
    z, r, jacobian = tangent.z, tangent.residuals, tangent.jacobian
    normal, slope = jacobian.T @ jacobian, jacobian.T @ r
    normal[np.diag_indices_from(normal)] *= 1 + 1e-6
    normal[np.diag_indices_from(normal)] += 1e-9
    lower = np.maximum(lower - z, -longest)
    upper = np.minimum(upper - z, longest)
    step = bounded_step(normal, slope, lower, upper)
    cost = float(r @ r + 2 * slope @ step + step @ normal @ step)
    return step, cost
