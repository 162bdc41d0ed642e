"""Which effect explains the gap: screening on the tangent, joint refits on one trial, judgement on the other.

Refitting the 12 parameters swallows most of the gap of many effects, so an effect is judged by a joint refit (12 + its
own parameters) and by what it predicts for a trial of another regime, never by the plain residual.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import combinations
from typing import TypeVar

import numpy as np
from scipy.linalg import block_diag
from scipy.stats import qmc

from real2sim.coupling.effects import EFFECTS, Placed
from real2sim.coupling.mechanisms import Scales, TwoTimes
from real2sim.diagnosis.decide import further_price, is_out_of_reach
from real2sim.diagnosis.evidence import Evidence
from real2sim.diagnosis.refit import BATCH, Hypothesis, JointResiduals, refit
from real2sim.identification import least_squares
from real2sim.identification.least_squares import Tangent
from real2sim.identification.parameters import Bounds

T = TypeVar("T")

# A refit on the way keeps its Jacobian while it foretells a step to this share; what the verdict rests on does not
KEEP = 0.3
# Chi-squared of a set of effects that MuJoCo gives up on
FAILED = 1e12
# Refits that say what is next best where no cause could earn its place
QUIET_REFITS = 4
# Where an effect leaves nothing but noise, others that promise to leave so much more chi-squared are not refitted
OUT_OF_REACH = 2000.0
# The same where it leaves less than this share of the gap, and others promise to leave so many times as much
NEARLY_ALL, FAR_BEHIND = 0.05, 10.0
# Starts tried, weaker and weaker, where MuJoCo gives up
WEAKENINGS = 3
# Strengths beyond an effect's own starts that are tried by their cost alone
STRENGTHS = 5
# A law of so many constants has more than one valley
MANY = 3
# ln-range about a fitted constant in which that of another law is drawn
NEAR = 1.0
# Effects that take each other's place in a fit
RIVALS = (
    ("slack", "one_sided", "stiffening", "asymmetric_stiffness", "joint_limit"),
    ("coulomb", "lugre", "hysteresis", "relaxation", "creep", "quadratic_damping"),
    ("cross_coupling", "misalignment", "lab_yaw"),
    ("preload", "tilt", "marker_offset"),
    ("migration", "marker_drift", "creep"),
    ("added_mass", "base_compliance", "controller_reaction"),
    ("replay_lag", "sync_offset", "clock_drift", "filter_lag"),
)
# A late clock, a late path and a filter leave as little as each other: what explains everything may be any of them
TIMING = RIVALS[-1]
# Longest step in ln or searched numbers that the screening believes
LONGEST_STEP = 1.5


@dataclass
class Pair:
    """Training and held-out trial of one person, whitened, with common scales.

    ``exchanged``: the trial that was to be fitted shows no gap and the other does, so that they changed places.
    """

    train: Evidence
    held_out: Evidence
    bounds: Bounds
    exchanged: bool = False

    @property
    def shown(self) -> Evidence:
        """The trial that shows the gap: the held-out one, but where they changed places."""
        return self.train if self.exchanged else self.held_out


@dataclass
class Screened:
    """A hypothesis before its refit: predicted cost on the training trial and where to start.

    ``tangent`` is what it was predicted with: residuals (n_r,) and Jacobian (n_r, 12 + p) at (12 + p,), the columns of
    the strap and of effects fitted before being those without it.
    """

    effects: tuple[Placed, ...]
    predicted: float
    start: np.ndarray
    tangent: Tangent


@dataclass
class Attribution:
    """What the search found: the plain fit, every refitted hypothesis, best first, and the whole screening.

    ``samples`` are the numbers of whitened residuals of the two trials.
    """

    plain: Hypothesis
    hypotheses: list[Hypothesis]
    screened: list[tuple[str, float]]
    samples: tuple[int, int]
    evaluations: int = 0
    stages: dict[str, float] = field(default_factory=dict)


def candidates(scales: Scales, names: Iterable[str] | None = None) -> list[Placed]:
    """Every effect of the catalogue (or those named) at every place."""
    wanted = None if names is None else set(names)
    return [
        Placed(effect, where, scales)
        for effect in EFFECTS
        if wanted is None or effect.name in wanted
        for where in effect.places()
    ]


def plain_fit(evidence: Evidence, bounds: Bounds, start: np.ndarray, settings: dict) -> np.ndarray:
    """ln-parameters (12,) of the plain plant by J of the paper: from ``start`` and from log-uniform points."""
    replay = evidence.replay([], BATCH)

    def residuals(parameters: np.ndarray) -> np.ndarray:
        return evidence.cost.residuals(replay.run_effects(parameters, [])[0])

    problem = least_squares.Residuals(residuals, bounds, BATCH)
    rng = np.random.default_rng(settings["seed"])
    points = np.array([start, *(bounds.log_uniform(rng) for _ in range(settings["screen"]))])
    costs = problem.costs(points)
    best, lowest = points[0], np.inf
    for point in points[np.argsort(costs)[:2]]:
        z, cost, _, _ = least_squares.minimise(
            problem, point, np.arange(12), iterations=settings["iterations"], ftol=1e-4, keep=KEEP
        )
        if cost < lowest:
            best, lowest = z, cost
    return best


def _conflict(effects: Sequence[Placed]) -> bool:
    """Two effects cannot both stand for the spring of one axis, nor two forms of one law for what it does there."""
    taken = [axis for placed in effects if placed.effect.replaces_spring for axis in placed.where.axes]
    laws = [(p.effect.name, p.where.axes, p.where.side) for p in effects if len(p.where.axes) == 1]
    return len(taken) != len(set(taken)) or len(laws) != len(set(laws))


def is_makeshift(effects: Sequence[Placed], *, leaves_noise: bool) -> bool:
    """Whether effects that leave nothing but noise, or more, stand for a cause that the catalogue does not hold.

    Fast and slow relaxation of one axis are what few branches make of a continuous spectrum, as fractional damping has;
    so are two time constants, but where these leave nothing they are all there is to know.
    """
    if not leaves_noise and any(isinstance(p.effect.plant, TwoTimes) for p in effects):
        return True
    branches = [(p.effect.name, p.where.axes) for p in effects if p.effect.name in ("relaxation", "creep")]
    return any(("creep", axes) in branches for name, axes in branches if name == "relaxation")


class Search:
    """Screening and refits on one pair of trials."""

    def __init__(self, pair: Pair, settings: dict, progress: Callable[[str], None] | None = None):
        self.pair, self._settings = pair, settings
        self._progress = progress or (lambda text: None)
        self.evaluations = 0
        self._noise: dict[tuple[str, bytes], tuple[float, float]] = {}
        self._screened_from: Tangent | None = None

    def fit(
        self,
        effects: Sequence[Placed],
        start: np.ndarray,
        final: bool = False,
        tangent: Tangent | None = None,
    ) -> Hypothesis:
        """Refit on the training trial and evaluate on the held-out one; ``final`` goes on until it has converged.

        ``tangent``, where one was taken near the start, spares the first Jacobian as far as it foretells the start.
        """
        residuals = self._residuals(effects, coarse=not final)
        kind = "final_" if final else ""
        iterations, ftol = (self._settings[f"{kind}{key}"] for key in ("iterations", "ftol"))
        z, _ = refit(
            residuals, start, iterations=iterations, ftol=ftol, keep=0.0 if final else KEEP, known=tangent
        )
        held_out = JointResiduals(self.pair.held_out, effects, self.pair.bounds, coarse=not final)
        if len(held_out.free):
            z, _ = refit(held_out, z, iterations=iterations, ftol=ftol)
        judged = np.array([residuals.judged(z), held_out.judged(z)])
        # what cannot be simulated explains nothing
        judged = np.where(np.isfinite(judged), judged, FAILED)
        count = residuals.evaluations + held_out.evaluations
        self.evaluations += count
        (train, j_train), (other, j_other) = judged.tolist()
        return Hypothesis(tuple(effects), z, (train, other), (j_train, j_other), count, final)

    def _residuals(self, effects: Sequence[Placed], *, coarse: bool = True) -> JointResiduals:
        """Those of the training trial; what is only searched with does not need the finest time step."""
        return JointResiduals(self.pair.train, effects, self.pair.bounds, coarse=coarse)

    @property
    def samples(self) -> tuple[int, int]:
        """Whitened residuals of the two trials."""
        return self.pair.train.samples, self.pair.held_out.samples

    def excess(self, hypothesis: Hypothesis) -> float:
        """What a hypothesis leaves beyond noise, in SD of what noise leaves.

        Where that stands out, the noise is simulated through the hypothesis itself, which may pass on more of it.
        """
        left, mean = sum(hypothesis.chi2), float(sum(self.samples))
        sd = np.sqrt(2 * mean)
        if left - mean < self._settings["pair_excess_sigma"] * sd or not hypothesis.effects:
            return float((left - mean) / sd)
        key = hypothesis.key, hypothesis.z.tobytes()
        if key not in self._noise:
            parameters, x = np.exp(hypothesis.z[:12]), hypothesis.split()
            settled = (hypothesis.effects, parameters, x, BATCH - 1, self._settings["seed"])
            draws = self.pair.train.noise_through(*settled) + self.pair.held_out.noise_through(*settled)
            self.evaluations += 2 * BATCH
            known = np.isfinite(draws).all()
            self._noise[key] = (draws.mean(), draws.std()) if known else (mean, sd)
        seen_mean, seen_sd = self._noise[key]
        return float((left - max(mean, seen_mean)) / max(sd, seen_sd))

    def is_noise(self, hypothesis: Hypothesis) -> bool:
        """Whether a hypothesis leaves nothing that a further effect has to explain."""
        return self.excess(hypothesis) < self._settings["pair_excess_sigma"]

    def fit_screened(self, screened: Screened) -> Hypothesis:
        """Refit from where the tangent points to, or from where it was taken if the simulation does not bear that.

        Once more where even the start without the strap's old parameters is better than what came out.
        """
        fitted = self.fit(screened.effects, screened.start, tangent=screened.tangent)
        origin = screened.tangent.z
        if fitted.chi2[0] >= FAILED:
            fitted = self.fit(screened.effects, origin)
        own = len(screened.effects[-1].effect.parameters)
        return self.afresh(screened.effects, origin[: len(origin) - own], fitted)

    def afresh(self, effects: tuple[Placed, ...], base: np.ndarray, fitted: Hypothesis) -> Hypothesis:
        """Refit with the last effect from its best fresh start, where that alone is better than ``fitted``."""
        z, cost = self.fresh(effects, base)
        if not cost < fitted.chi2[0]:
            return fitted
        again = self.fit(effects, z)
        return again if again.chi2[0] < fitted.chi2[0] else fitted

    def fresh(self, effects: tuple[Placed, ...], base: np.ndarray) -> tuple[np.ndarray, float]:
        """Best start of the last effect beside ``base`` by its cost alone, and that cost.

        What a fit without the effect made of it stands in stiffness and damping of its axis, at their bounds for strong
        friction, and no tangent leads out of there. So these are tried from the middle of their range too.
        """
        z = _fresh_starts(effects[-1], base, *self._middle)
        costs = self._residuals(effects).costs(z)
        self.evaluations += len(z)
        costs = np.where(np.isfinite(costs), costs, FAILED)
        best = int(np.argmin(costs))
        return z[best], float(costs[best])

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
                about = near[parameter.name] + np.array([-1, 1]) * NEAR
                lower[i], upper[i] = np.clip(about, lower[i], upper[i])
        points = qmc.Sobol(len(lower), seed=self._settings["seed"]).random(count)
        z = np.hstack([np.tile(base, (count, 1)), lower + points * (upper - lower)])
        costs = self._residuals(effects).costs(z)
        self.evaluations += len(z)
        costs = np.where(np.isfinite(costs), costs, FAILED)
        order = np.argsort(costs, kind="stable")
        return z[order], costs[order]

    @property
    def _middle(self) -> tuple[np.ndarray, np.ndarray]:
        """Middles (6,) of the ranges of ln-stiffness and ln-damping."""
        middle = (np.log(self.pair.bounds.lower) + np.log(self.pair.bounds.upper)) / 2
        return middle[:6], middle[6:]

    def bearable(self, effects: tuple[Placed, ...], base: np.ndarray, x: np.ndarray) -> np.ndarray:
        """``base`` with the start ``x`` (p,) of the last effect, weakened until the simulation bears it.

        A spring that softens is a spring that lets go where the strap of ``base`` is softer than the plain one.
        """
        residuals = self._residuals(effects)
        z = np.concatenate([base, x])
        for weaker in _weakened(effects[-1], x):
            z = np.concatenate([base, weaker])
            if np.isfinite(residuals.costs(z[None])[0]):
                break
        self.evaluations += residuals.evaluations
        return z

    def mark_spikes(self, best: Hypothesis) -> bool:
        """Look for jumps of the markers in what a hypothesis leaves of both trials; whether there are new ones."""
        new = [
            evidence.mark_spikes(JointResiduals(evidence, best.effects, self.pair.bounds).paths(best.z))
            for evidence in (self.pair.train, self.pair.held_out)
        ]
        return any(new)

    def screen(self, base: Hypothesis, places: Sequence[Placed]) -> list[Screened]:
        """Predicted cost of adding each place to a fitted hypothesis, best first."""
        problem = self._residuals(base.effects)
        here = Tangent(base.z, *problem.with_jacobian(base.z, np.arange(len(base.z))))
        self._screened_from = here
        out = []
        for placed in places:
            effects = (*base.effects, placed)
            if _conflict(effects):
                continue
            found = self._screen_one(effects, here)
            if found is not None:
                out.append(found)
        self.evaluations += problem.evaluations
        return sorted(out, key=lambda s: s.predicted)

    def _screen_one(self, effects: tuple[Placed, ...], here: Tangent) -> Screened | None:
        """Predicted cost of the last effect beside the others, on the tangent at the best of its starts."""
        placed = effects[-1]
        residuals = self._residuals(effects)
        lower, upper = residuals.lower, residuals.upper
        own = np.arange(len(here.z), len(lower))
        tangents: list[Tangent] = []
        for starts in _weakened(placed, placed.starts()):
            z = np.hstack([np.tile(here.z, (len(starts), 1)), starts])
            at = residuals.many(z)
            # prior rows of the base's own effects stand before those of the new one
            base = np.pad(here.residuals, (0, at.shape[1] - len(here.residuals)))
            rows = np.pad(here.jacobian, ((0, at.shape[1] - len(here.residuals)), (0, 0)))
            logarithmic = any(parameter.log for parameter in placed.effect.parameters)
            slopes = None if logarithmic else _parabola(starts, at, base)
            for i in np.flatnonzero(np.isfinite(at).all(axis=1)):
                columns = residuals.jacobian(z[i], at[i], own) if slopes is None else slopes[i]
                tangents.append(Tangent(z[i], at[i], np.hstack([rows, columns])))
            if tangents:
                break
        self.evaluations += residuals.evaluations
        steps = [_bounded_step(tangent, lower, upper) for tangent in tangents]
        found = [
            Screened(effects, cost, t.z + step, t) for t, (step, cost) in zip(tangents, steps, strict=True)
        ]
        return min(found, key=lambda s: s.predicted, default=None)

    def pairs(self, screened: Sequence[Screened], most: int) -> list[Screened]:
        """Predicted cost of pairs among single effects of the last screening, best first, ``most`` of them."""
        here = self._screened_from
        assert here is not None, "pairs are made of what was screened"
        out = []
        for a, b in combinations(screened, 2):
            effects = (a.effects[-1], b.effects[-1])
            if effects[0].key == effects[1].key or _conflict(effects):
                continue
            tangent = _together(here, a.tangent, b.tangent)
            limits = [placed.bounds() for placed in effects]
            lower = np.concatenate([np.log(self.pair.bounds.lower), *(low for low, _ in limits)])
            upper = np.concatenate([np.log(self.pair.bounds.upper), *(high for _, high in limits)])
            step, cost = _bounded_step(tangent, lower, upper)
            out.append(Screened(effects, cost, tangent.z + step, tangent))
            out = sorted(out, key=lambda s: s.predicted)[:most]
        return out


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


def _together(here: Tangent, one: Tangent, other: Tangent) -> Tangent:
    """Tangent of two effects at once, from those of each beside ``here``: what they change adds up."""
    rows, columns = here.jacobian.shape
    both = (one, other)
    changed = here.residuals + sum(t.residuals[:rows] - here.residuals for t in both)
    # prior rows of one effect do not see the other
    own = block_diag(*(t.jacobian[rows:, columns:] for t in both))
    top = np.hstack([here.jacobian, *(t.jacobian[:rows, columns:] for t in both)])
    bottom = np.hstack([np.zeros((len(own), columns)), own])
    return Tangent(
        np.concatenate([here.z, *(t.z[columns:] for t in both)]),
        np.concatenate([changed, *(t.residuals[rows:] for t in both)]),
        np.vstack([top, bottom]),
    )


def _weakened(placed: Placed, x: np.ndarray) -> Iterator[np.ndarray]:
    """A start (p,) of an effect, or several (s, p), then weaker and weaker ones."""
    for _ in range(WEAKENINGS):
        yield x
        x = placed.weaker(x)


def _fresh_starts(placed: Placed, base: np.ndarray, stiffness: np.ndarray, damping: np.ndarray) -> np.ndarray:
    """Starts (s, n) of an effect beside ``base``: its own and on up to its bound, the strap's axis old and new."""
    starts, (_, upper) = placed.starts(), placed.bounds()
    strengths = [starts]
    if placed.effect.parameters and placed.effect.parameters[0].log:
        ladder = np.tile(starts[0], (STRENGTHS, 1))
        ladder[:, 0] = np.linspace(starts[:, 0].max(), upper[0], STRENGTHS + 1)[1:]
        strengths.append(ladder)
    x = np.concatenate(strengths)
    straps = [base[:12]]
    if len(placed.where.axes) == 1:
        axis = placed.where.axes[0]
        softer, freed = base[:12].copy(), base[:12].copy()
        softer[6 + axis] = freed[6 + axis] = damping[axis]
        freed[axis] = stiffness[axis]
        straps += [softer, freed]
    return np.array([np.concatenate([strap, base[12:], own]) for strap in straps for own in x])


def _bounded_step(tangent: Tangent, lower: np.ndarray, upper: np.ndarray) -> tuple[np.ndarray, float]:
    """Gauss-Newton step, held inside the bounds and to a length that a tangent may claim, and the cost it predicts."""
    z, r, jacobian = tangent.z, tangent.residuals, tangent.jacobian
    normal, slope = jacobian.T @ jacobian, jacobian.T @ r
    normal[np.diag_indices_from(normal)] *= 1 + 1e-6
    normal[np.diag_indices_from(normal)] += 1e-9
    lower = np.maximum(lower - z, -LONGEST_STEP)
    upper = np.minimum(upper - z, LONGEST_STEP)
    free, step = np.ones(len(z), bool), np.zeros(len(z))
    # what meets a bound stays there and is made good by the others
    for _ in range(4):
        part = np.ix_(free, free)
        step[free] = -np.linalg.solve(normal[part], slope[free] + normal[np.ix_(free, ~free)] @ step[~free])
        outside = free & ((step < lower) | (step > upper))
        step = np.clip(step, lower, upper)
        if not outside.any():
            break
        free &= ~outside
    cost = float(r @ r + 2 * slope @ step + step @ normal @ step)
    return step, cost


def attribute(
    pair: Pair,
    start: np.ndarray,
    settings: dict,
    progress: Callable[[str], None],
    places: Sequence[Placed] | None = None,
    calibration: Mapping[str, float] | None = None,
) -> Attribution:
    """Plain fit, then every effect alone, then pairs where one alone leaves more than noise.

    ``start`` (12,) are ln-parameters; ``settings`` is the slice ``diagnosis.search`` of the configuration; ``places``
    are the effects to try, everything everywhere by default. With ``calibration`` (``diagnosis.calibration``), no other
    effect is looked for where less is left than the decision asks of one: only more axes of the same.
    """
    search = Search(pair, settings)
    plain = search.fit((), start, final=True)
    count = search.samples
    progress(f"plain fit: chi-squared {plain.chi2[0]:.0f} of {count[0]}, held out {plain.chi2[1]:.0f}")
    everything = candidates(pair.train.scales) if places is None else list(places)
    singles = search.screen(plain, everything)
    listed = [(s.effects[-1].key, s.predicted) for s in singles]
    progress(f"screened {len(listed)} hypotheses")
    quiet = calibration is not None and is_out_of_reach(plain.chi2, count, calibration)
    hypotheses = _alone(search, _shortlist(singles, settings), plain, settings, quiet=quiet)
    hypotheses = _other_forms(search, hypotheses, singles, plain)
    if not quiet:
        hypotheses = _other_laws(search, hypotheses, everything, settings)
        hypotheses = _redrawn(search, hypotheses, everything, settings)
    hypotheses[0] = _converged(search, plain, hypotheses[0], settings)
    excess = search.excess(hypotheses[0])
    progress(f"{hypotheses[0].key} leaves {excess:.1f} sigma")
    if excess > settings["pair_excess_sigma"]:
        left = sum(hypotheses[0].chi2) - sum(count)
        others = calibration is None or left > further_price(plain.chi2, count, calibration)
        more, promising = _pairs(search, plain, singles, hypotheses, everything, settings, others=others)
        # where no second effect earns its share, nothing of the catalogue comes near what lies beneath
        near = bool(more) and _earned(search, hypotheses[0], more[0]) >= settings["grow_share"]
        hypotheses += more
        if near:
            hypotheses += _swapped(search, hypotheses, everything, settings)
            grown = _grow(search, hypotheses, promising, everything, settings, progress)
            hypotheses += grown
            if min(sum(h.chi2) for h in hypotheses) in {sum(h.chi2) for h in grown}:
                hypotheses += _swapped(search, hypotheses, everything, settings)
            hypotheses += _swapped_together(search, hypotheses, everything)
        hypotheses = _best_of_each(hypotheses + _pruned(search, hypotheses))
    hypotheses = _without_spikes(search, plain, hypotheses, everything)
    return Attribution(plain, hypotheses, listed, count, search.evaluations)


def _converged(search: Search, plain: Hypothesis, best: Hypothesis, settings: dict) -> Hypothesis:
    """The best single effect refitted to the end, where it takes away nearly all of the gap and yet leaves some.

    What a refit that was cut short leaves, or the coarse time step of the search, is no second cause.
    """
    left, gap = (sum(h.chi2) - sum(search.samples) for h in (best, plain))
    if search.is_noise(best) or left > settings["grow_share"] * gap:
        return best
    again = search.fit(best.effects, best.z, final=True)
    return again if again.chi2[0] <= best.chi2[0] else best


def _earned(search: Search, smaller: Hypothesis, larger: Hypothesis) -> float:
    """Share of what a set leaves beyond its noise that a larger one takes away."""
    left = sum(smaller.chi2) - sum(search.samples)
    return (sum(smaller.chi2) - sum(larger.chi2)) / left


def _without_spikes(
    search: Search, plain: Hypothesis, found: list[Hypothesis], everything: Sequence[Placed]
) -> list[Hypothesis]:
    """The hypotheses, with `outliers` judged by the jumps in what the best of them leaves, alone and beside others."""
    outliers = [placed for placed in everything if placed.effect.name == "outliers"]
    best = min([plain, *found], key=lambda h: sum(h.chi2))
    if not outliers or not search.mark_spikes(best):
        return found
    kept = [h for h in found if "outliers" not in h.names]
    # what was added for the sake of the jumps is not needed beside them: the best set of every size is tried
    sized = _first_of_each(sorted(kept, key=lambda h: sum(h.chi2)), lambda h: str(len(h.effects)))
    bases = [*(h for h in sized if len(h.effects) <= len(best.effects)), plain]
    more = [search.fit((*h.effects, *outliers), h.z) for h in bases]
    # what a set gains by being fitted on is not what the jumps explain: it is fitted on without them too
    first = min(more, key=lambda h: sum(h.chi2))
    if len(first.effects) > len(outliers):
        more.append(search.fit(first.effects[: -len(outliers)], first.z))
    return sorted(_best_of_each([*kept, *more]), key=lambda h: sum(h.chi2))


def _alone(
    search: Search, shortlist: Sequence[Screened], plain: Hypothesis, settings: dict, *, quiet: bool
) -> list[Hypothesis]:
    """Refits of single effects, best first; those that cannot be the answer any more are left out.

    Rivals of an effect that explains everything are tried whatever they promise: they are what it is mistaken for.
    Where the plain fit is ``quiet``, no cause could earn its place: a few refits say what is next best.
    """
    if quiet:
        shortlist = shortlist[:QUIET_REFITS]
    found: list[Hypothesis] = []
    for screened in shortlist:
        best = min(found, key=lambda h: sum(h.chi2), default=plain)
        rival = any(_alike(placed, screened.effects[-1]) for placed in best.effects)
        if len(found) >= settings["pair_rivals"] and not rival and _behind(search, screened, best, plain):
            continue
        found.append(_single(search, screened, plain))
    return sorted(_beside_best(search, found), key=lambda h: sum(h.chi2))


def _behind(search: Search, screened: Screened, best: Hypothesis, plain: Hypothesis) -> bool:
    """Whether an effect promises so little beside a single one that explains all or nearly all that it is no answer."""
    n = search.samples[0]
    left, gap = (sum(h.chi2) - sum(search.samples) for h in (best, plain))
    if search.is_noise(best):
        return screened.predicted > best.chi2[0] + OUT_OF_REACH
    return left < NEARLY_ALL * gap and screened.predicted - n > FAR_BEHIND * (best.chi2[0] - n) + OUT_OF_REACH


def _beside_best(search: Search, found: list[Hypothesis]) -> list[Hypothesis]:
    """Single effects; where the best explains everything, its rivals in its place start from its strap too.

    What holds another as a special case (a law of friction with more constants) cannot be worse than it.
    """
    best = min(found, key=lambda h: sum(h.chi2))
    if not search.is_noise(best):
        return found
    return [
        search.afresh(h.effects, best.z[:12], h)
        if h is not best and _rivals(best.effects[0], h.effects[0])
        else h
        for h in found
    ]


def _other_forms(
    search: Search, found: list[Hypothesis], screened: Sequence[Screened], plain: Hypothesis
) -> list[Hypothesis]:
    """Single effects, and where one of no axis explains everything, all forms of those that it is mistaken for.

    What the tangent makes of a lag is alike for all of them; two filters differ by what is beyond their parabola.
    """
    best = found[0]
    if best.effects[0].where.axes or not search.is_noise(best):
        return found
    known = {_keys(h.effects) for h in found}
    rest = [
        s
        for s in screened
        if _keys(s.effects) not in known
        and not s.effects[0].where.axes
        and _alike(best.effects[0], s.effects[0])
    ]
    return sorted([*found, *(_single(search, s, plain) for s in rest)], key=lambda h: sum(h.chi2))


def _other_laws(
    search: Search, found: list[Hypothesis], places: Sequence[Placed], settings: dict
) -> list[Hypothesis]:
    """Single effects, and on the axis of the best the laws it is mistaken for that the tangent promised nothing of.

    Dry friction that never slips has no slope to be found by, and did not stand beside the relaxation it looks like.
    """
    best = found[0]
    if len(best.effects[0].where.axes) != 1:
        return found
    known = {_keys(h.effects) for h in found}
    rivals = [p for p in places if _rivals(best.effects[0], p) and _same_place(best.effects[0], p)]
    starts = [((p,), *search.fresh((p,), best.z[:12])) for p in rivals if _keys((p,)) not in known]
    starts = sorted(starts, key=lambda start: start[2])[: settings["swap_refits"]]
    tried = [search.fit(effects, z) for effects, z, _ in starts]
    return sorted([*found, *tried], key=lambda h: sum(h.chi2))


def _redrawn(
    search: Search, found: list[Hypothesis], places: Sequence[Placed], settings: dict
) -> list[Hypothesis]:
    """Single effects, and on the axis of the best its law and rivals of many constants, refitted from drawn starts.

    A law of friction with a slope, a travel and a fall has more than one valley, and a few starts may miss the deepest.
    """
    best = found[0]
    if len(best.effects[0].where.axes) != 1 or not settings["redraws"]:
        return found
    laws = [
        p
        for p in places
        if len(p.effect.parameters) >= MANY
        and _rivals(best.effects[0], p)
        and _same_place(best.effects[0], p)
    ]
    out = list(found)
    for law in laws:
        starts, _ = search.drawn((law,), best.z[:12], _named(best, 0), settings["redraws"])
        out += [search.fit((law,), z) for z in starts[: settings["redraw_refits"]]]
    return sorted(_best_of_each(out), key=lambda h: sum(h.chi2))


def _has_many_constants(law: Placed) -> bool:
    """Whether a law of one axis has so many constants that a few starts may miss the best of them."""
    return len(law.effect.parameters) >= MANY and len(law.where.axes) == 1


def _named(hypothesis: Hypothesis, member: int) -> dict[str, float]:
    """Searched numbers of a member of a hypothesis, by name."""
    names = (parameter.name for parameter in hypothesis.effects[member].effect.parameters)
    return dict(zip(names, hypothesis.split()[member].tolist(), strict=True))


def _single(search: Search, screened: Screened, plain: Hypothesis) -> Hypothesis:
    """Refit of one effect; where it ends worse than the plain plant, again from the plain fit and all its starts."""
    fitted = search.fit_screened(screened)
    if fitted.chi2[0] <= plain.chi2[0] * (1 + 1e-3):
        return fitted
    starts = screened.effects[-1].starts()
    again = [search.fit(screened.effects, search.bearable(screened.effects, plain.z, x)) for x in starts]
    return min([fitted, *again], key=lambda h: h.chi2[0])


def _shortlist(screened: Sequence[Screened], settings: dict) -> list[Screened]:
    """The best places of every effect that promises anything, up to a number of refits."""
    taken: dict[str, int] = {}
    first: list[Screened] = []
    rest: list[Screened] = []
    for s in screened:
        name = s.effects[-1].effect.name
        taken[name] = taken.get(name, 0) + 1
        (first if taken[name] == 1 else rest).append(s)
    chosen = first[: settings["refits"]]
    best = screened[0].predicted
    close = [s for s in rest if s.predicted < best * settings["close_factor"]]
    return chosen + close[: settings["refits_close"]]


def _pairs(
    search: Search,
    plain: Hypothesis,
    singles: Sequence[Screened],
    found: Sequence[Hypothesis],
    everything: Sequence[Placed],
    settings: dict,
    *,
    others: bool,
) -> tuple[list[Hypothesis], list[Placed]]:
    """Second effects on top of the best single ones, and pairs that the tangent alone promises, best first.

    Also the places that promise most on top of the best single one, with every effect among them. Without ``others``
    only the single effects themselves on further axes.
    """
    pool = singles[: settings["pair_pool"]] if others else []
    options = search.pairs(pool, settings["pair_refits"])
    # an effect that promised nothing beside the whole gap may be all that is left once the other is there
    screens: list[list[Screened]] = []
    singly = _first_of_each(found, lambda h: h.names[0])
    for single in singly[: settings["pair_screens"]] if others else []:
        screens.append(search.screen(single, _without(everything, single)))
        options += screens[-1][: settings["pair_refits"]]
    promising = [*found[0].effects, *_promising(screens[0] if screens else singles, settings["pair_pool"])]
    if not others:
        promising = [p for p in everything if p.effect.name == found[0].names[0]]
    # an effect that acts on one axis is likely to act on another, however little that promises while it is alone
    for single in singly[: settings["spread_refits"]]:
        options += search.screen(single, _elsewhere(single, [s.effects[-1] for s in singles]))[:1]
    out: list[Hypothesis] = []
    seen = set()
    for option in sorted(options, key=lambda s: s.predicted):
        key = _keys(option.effects)
        # once a pair leaves nothing but noise, a few rivals are enough
        done = len(out) >= settings["pair_rivals"] and search.is_noise(min(out, key=lambda h: sum(h.chi2)))
        if key not in seen and not done:
            seen.add(key)
            out.append(search.fit_screened(option))
    return sorted(out, key=lambda h: sum(h.chi2)), promising


def _promising(screened: Sequence[Screened], most: int) -> list[Placed]:
    """The first ``most`` places of a screening, and the best place of every effect."""
    places = [s.effects[-1] for s in screened]
    first = _first_of_each(places, lambda placed: placed.effect.name)
    return list({placed.key: placed for placed in (*places[:most], *first)}.values())


def _without(places: Sequence[Placed], hypothesis: Hypothesis) -> list[Placed]:
    """The places that a hypothesis does not hold yet."""
    taken = _keys(hypothesis.effects)
    return [placed for placed in places if placed.key not in taken]


def _first_of_each(items: Sequence[T], name: Callable[[T], str]) -> list[T]:
    """The first of the items of every name, in their order."""
    first: dict[str, T] = {}
    for item in items:
        first.setdefault(name(item), item)
    return list(first.values())


def _elsewhere(hypothesis: Hypothesis, places: Iterable[Placed]) -> list[Placed]:
    """Places of a hypothesis' effects on axes that they do not act on yet, in the same form."""
    taken: dict[int, set[int]] = {}
    for member in hypothesis.effects:
        taken.setdefault(id(member.effect), set()).update(member.where.axes)
    return [p for p in places if taken.get(id(p.effect)) and taken[id(p.effect)].isdisjoint(p.where.axes)]


def _keys(effects: Sequence[Placed]) -> frozenset[str]:
    """What makes two sets the same: effects and places, in any order."""
    return frozenset(placed.key for placed in effects)


def _best_of_each(found: Sequence[Hypothesis]) -> list[Hypothesis]:
    """One hypothesis of every set of effects and places, in the order of ``found``: the best on both trials."""
    best: dict[frozenset[str], Hypothesis] = {}
    for h in found:
        key = _keys(h.effects)
        if key not in best or sum(h.chi2) < sum(best[key].chi2):
            best[key] = h
    return list(best.values())


def _swapped(
    search: Search, found: Sequence[Hypothesis], places: Sequence[Placed], settings: dict
) -> list[Hypothesis]:
    """The best set with each member replaced by its rivals in the same place, as long as more than noise is left.

    A member that was found first may hold the place of another: friction is half of a hysteresis, and the other way.
    Timing effects are tried for each other however little is left.
    """
    best = min(found, key=lambda h: sum(h.chi2))
    out: list[Hypothesis] = []
    for member in best.effects:
        taken = not any(placed is member for placed in best.effects)
        if taken or (search.is_noise(best) and member.effect.name not in TIMING):
            continue
        kept = [i for i, placed in enumerate(best.effects) if placed is not member]
        near = _named(best, next(i for i, placed in enumerate(best.effects) if placed is member))
        others = tuple(best.effects[i] for i in kept)
        parts = best.split()
        base = np.concatenate([best.z[:12], *(parts[i] for i in kept)])
        rivals = [(*others, rival) for rival in _without(places, best) if _rivals(member, rival)]
        rivals = [effects for effects in rivals if not _conflict(effects)]
        starts = [search.fresh(effects, base) for effects in rivals]
        for i, effects in enumerate(rivals):
            if _has_many_constants(effects[-1]) and settings["redraws"]:
                drawn, costs = search.drawn(effects, base, near, settings["redraws"])
                starts[i] = min(starts[i], (drawn[0], float(costs[0])), key=lambda start: start[1])
        order = sorted(range(len(rivals)), key=lambda i: starts[i][1])[: settings["swap_refits"]]
        tried = [search.fit(rivals[i], starts[i][0]) for i in order]
        out += tried
        best = min([best, *tried], key=lambda h: sum(h.chi2))
    return out


def _swapped_together(
    search: Search, found: Sequence[Hypothesis], places: Sequence[Placed]
) -> list[Hypothesis]:
    """The best set, where its members are effects of single axes that are mistaken for each other, as one effect.

    Each effect that they are mistaken for stands in for all of them: alone on one axis it leaves what the other does,
    and nothing shows that it would do better on both. So also where the set leaves nothing but noise.
    """
    best = min(found, key=lambda h: sum(h.chi2))
    first = best.effects[0]
    of_axes = all(len(p.where.axes) == 1 and _alike(first, p) for p in best.effects)
    if len(best.effects) < 2 or not of_axes:
        return []
    known = {_keys(h.effects) for h in found}
    starts = []
    alike = [p for p in places if _alike(first, p)]
    for law in dict.fromkeys(p.effect for p in alike):
        rivals = [p for m in best.effects for p in alike if p.effect is law and _same_place(p, m)]
        if len(rivals) < len(best.effects) or _keys(rivals) in known or _conflict(rivals):
            continue
        starts.append(_one_by_one(search, best, rivals))
    # friction that never slips has no slope to be started on: every effect is refitted, from its best form
    starts = _first_of_each(sorted(starts, key=lambda start: start[2]), lambda start: start[0][0].effect.name)
    return [search.fit(effects, z) for effects, z, _ in starts]


def _one_by_one(
    search: Search, best: Hypothesis, rivals: Sequence[Placed]
) -> tuple[tuple[Placed, ...], np.ndarray, float]:
    """The members of a set replaced by rivals, the others in place meanwhile: effects, start and its cost."""
    effects, parts, strap, cost = list(best.effects), best.split(), best.z[:12], np.inf
    for rival in rivals:
        effects, parts = [*effects[1:], rival], parts[1:]
        z, cost = search.fresh(tuple(effects), np.concatenate([strap, *parts]))
        strap = z[:12]
        parts = [*parts, z[12 + sum(map(len, parts)) :]]
    return tuple(effects), np.concatenate([strap, *parts]), cost


def _same_place(one: Placed, other: Placed) -> bool:
    """Whether two places are the same axes and side."""
    return (one.where.axes, one.where.side) == (other.where.axes, other.where.side)


def _rivals(one: Placed, other: Placed) -> bool:
    """Whether another place is on the same axis, or on all, and of an effect that is mistaken for this one."""
    return _alike(one, other) and other.where.axes in (one.where.axes, ())


def _alike(one: Placed, other: Placed) -> bool:
    """Whether one effect is mistaken for the other."""
    return any(one.effect.name in names and other.effect.name in names for names in RIVALS)


def _pruned(search: Search, found: Sequence[Hypothesis]) -> list[Hypothesis]:
    """The best set with each of its members left out, from the set's values; so on with the best of those.

    What was added first may have stood for what came later; and an effect that stuck alone (dry friction has hardly a
    slope before it slips) may do alone what it does in company.
    """
    best = min(found, key=lambda h: sum(h.chi2))
    out: list[Hypothesis] = []
    while len(best.effects) > 1:
        parts, smaller = best.split(), []
        for left_out in range(len(best.effects)):
            keep = [i for i in range(len(best.effects)) if i != left_out]
            effects = tuple(best.effects[i] for i in keep)
            smaller.append(search.fit(effects, np.concatenate([best.z[:12], *(parts[i] for i in keep)])))
        out += smaller
        best = min(smaller, key=lambda h: sum(h.chi2))
    return out


def finished(pair: Pair, hypothesis: Hypothesis, settings: dict) -> Hypothesis:
    """A hypothesis refitted until it converged; the old one where that did not help the training trial."""
    if hypothesis.converged:
        return hypothesis
    search = Search(pair, settings)
    if not search.is_noise(hypothesis):
        # the last digit of what leaves far more than noise is worth no hundred Jacobians
        rough = {f"final_{key}": settings[key] for key in ("iterations", "ftol")}
        search = Search(pair, settings | rough)
    again = search.fit(hypothesis.effects, hypothesis.z, final=True)
    return again if again.chi2[0] <= hypothesis.chi2[0] else hypothesis


def _grow(
    search: Search,
    found: Sequence[Hypothesis],
    promising: Sequence[Placed],
    everything: Sequence[Placed],
    settings: dict,
    progress: Callable[[str], None],
) -> list[Hypothesis]:
    """Third and further effects (or axes of one) on top of the best set, while each earns much of what is left.

    Tried are those that were promising beside the first effect, and more axes of those that the set holds.
    """
    best = min(found, key=lambda h: sum(h.chi2))
    out: list[Hypothesis] = []
    while len(best.effects) < settings["most_effects"]:
        if search.is_noise(best):
            break
        places = {p.key: p for p in (*promising, *_elsewhere(best, everything))}
        options = search.screen(best, _without(list(places.values()), best))[: settings["pair_refits"]]
        more = [search.fit_screened(option) for option in options]
        out += more
        grown = min([best, *more], key=lambda h: sum(h.chi2))
        if _earned(search, best, grown) < settings["grow_share"]:
            break
        best = grown
        progress(f"{best.key} leaves {search.excess(best):.1f} sigma")
    return out
