"""Laws that nobody listed: which family of forces or displacements explains the gap, and with which coefficients.

Every family is linear in its coefficients, so one set of replays gives the slopes of the residuals of both trials by
all basis functions of all families. On that tangent a family has a marginal likelihood in closed form, with the scale
of its prior estimated (MacKay, Neural Comput. 4 (1992) 415). The best few are refitted on the training trial together
with the system's parameters, like any effect, and are compared by their evidence on both trials.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from copy import copy
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from real2sim.diagnosis.evidence import Evidence
from real2sim.diagnosis.refit import Hypothesis, JointResiduals
from real2sim.diagnosis.search import FAILED, Pair, Search
from real2sim.effects import families
from real2sim.effects.base import AtRest, Effect, EffectParameter, InterfaceImpedance, Placed, Where
from real2sim.effects.chains import Context
from real2sim.effects.displacements import Displacement, displacements
from real2sim.effects.families import Family, Range, Term, Variable
from real2sim.effects.planned import PlannedForce
from real2sim.inference.least_squares import bounded_step

if TYPE_CHECKING:
    from real2sim.settings import DiagnosisFreeFormSettings, DiagnosisSearchSettings

# Bounds of a coefficient, in units of a large force: the prior holds it long before
_BOUND = 100.0
# Prior scales that are tried, in units of a large force of the joint
_SCALES = np.exp(np.linspace(-7.0, 1.5, 18))
# Basis functions that one replay has at a time
_CHUNK = 64

AnyFamily = Family | Displacement


class Library:
    """The families of a pair of trials, with the ranges of variables that the training trial visited."""

    def __init__(self, pair: Pair, band_share: float):
        system, scales = pair.system, pair.train.scales
        self.system, self._scales, self._band = system, scales, band_share * system.band_hz
        self._known: dict[int, tuple[np.ndarray, dict[str, Variable], dict[str, np.ndarray]]] = {}
        own = self.variables(pair.train.context)
        self.template = own
        self.ranges = {n: Range(float(v.values.min()), float(v.values.max())) for n, v in own.items()}
        self.force = {axis.joint: float(scales.force[i]) for i, axis in enumerate(system.axes)}
        q = {axis.joint: float(scales.q[i]) for i, axis in enumerate(system.axes)}
        for joint in families.moved_joints(system):
            # the base feels what the interface's translations (turns) do
            alike = [self.force[a.joint] for a in system.axes if a.rotational == self.is_turn(joint)]
            self.force[joint] = float(np.mean(alike)) if alike else 1.0
        # markers on a bar, and an interface whose rotation they show
        pose = {"pose", "bar", "base"} <= system.offers
        self._take(families.families(system, list(own), self.force, q), displacements() if pose else [])

    def _take(self, forces: Sequence[Family], moved: Sequence[Displacement]) -> None:
        """Hold these families, and their basis functions, each once per joint."""
        self.forces, self.displacements = list(forces), list(moved)
        terms = {(t.joint, t.name): t for f in forces for row in f.terms for t in row}
        self.columns = list(terms.values())
        self.index = {key: i for i, key in enumerate(terms)}

    def variables(self, context: Context) -> dict[str, Variable]:
        """Return the variables of a trial."""
        return self._of(context)[0]

    def _of(self, context: Context) -> tuple[dict[str, Variable], dict[str, np.ndarray]]:
        """Variables of a trial, and what has been made of them by the name of the term."""
        path = context.coordinates
        if id(path) not in self._known:
            made = families.variables(context, self.system, self._scales.q, self._scales.v, self._band)
            # the path is held too, or another one could take its place in memory
            self._known[id(path)] = path, made, {}
        return self._known[id(path)][1:]

    def signals(self, terms: Iterable[Term], context: Context) -> np.ndarray:
        """Return forces (p, n) of basis functions at the samples, in units of their joint's large force."""
        own, made = self._of(context)
        step_s = float(context.time_s[1] - context.time_s[0])
        out = []
        for term in terms:
            if term.name not in made:
                made[term.name] = term.basis(own, self.ranges, step_s)
            out.append(made[term.name] * term.factor)
        return np.array(out).reshape(len(out), len(context.time_s))

    def placed(self, family: AnyFamily, scale: float) -> Placed:
        """Return a family with a prior scale as an effect at its place."""
        if isinstance(family, Displacement):
            effect = family.effect([scale * w for w in family.weights], _BOUND)
        else:
            sd = [scale * row[0].weight for row in family.terms]
            effect = self._forced(family.name, family.stage, family.terms, sd)
        return Placed(effect, Where(self.system, (), 0, "", family.key), self._scales)

    def _forced(self, name: str, stage: str, rows: Sequence[Sequence[Term]], sd: Sequence[float]) -> Effect:
        joints = tuple(dict.fromkeys(t.joint for row in rows for t in row))
        planned: dict[tuple[int, int], np.ndarray] = {}

        def plan(
            values: np.ndarray, context: Context, where: Where, impedance: InterfaceImpedance
        ) -> np.ndarray:
            key = id(context.coordinates), len(context.step_time_s)
            if key not in planned:
                out = np.zeros((len(rows), len(context.step_time_s), len(joints)))
                for i, row in enumerate(rows):
                    for term, force in zip(row, self.signals(row, context), strict=True):
                        steps = np.interp(context.step_time_s, context.time_s, force)
                        out[i, :, joints.index(term.joint)] += steps * self.force[term.joint]
                planned[key] = out
            return np.asarray(np.tensordot(values, planned[key], axes=1))

        return Effect(
            name,
            stage,
            "linear in its coefficients",
            tuple(
                EffectParameter(f"c{i}", "1", -_BOUND, _BOUND, (0.0,), prior_sd=s) for i, s in enumerate(sd)
            ),
            separating_trial="a wider range of what it depends on",
            at_rest=AtRest((0.0,) * len(rows)),
            scope="whole",
            plant=PlannedForce(plan, joints),
        )

    def is_turn(self, joint: str) -> bool:
        """Return whether a joint is a hinge."""
        by_axis = {axis.joint: axis.rotational for axis in self.system.axes}
        return by_axis[joint] if joint in by_axis else families.moved_joints(self.system)[joint] == "rad"

    def unit_of(self, term: Term) -> tuple[float, str]:
        """Return the SI value and unit of one unit of a term's coefficient."""
        scale, unit = self.force[term.joint], "Nm" if self.is_turn(term.joint) else "N"
        for name, exponent in term.powers:
            variable = self.template[name]
            scale /= variable.scale**exponent
            per = f"({variable.unit})" if "/" in variable.unit and exponent != 1 else variable.unit
            unit += f" per {per}" + (f"^{exponent}" if exponent != 1 else "")
        return scale * term.factor, unit

    def only(self, forces: Sequence[Family]) -> Library:
        """Return the same library with some of its families of forces and no displacements."""
        out = copy(self)
        out._take(forces, [])
        return out

    def columns_effect(self, terms: Sequence[Term]) -> Placed:
        """Return basis functions side by side as one effect."""
        effect = self._forced("columns", "interface", [[t] for t in terms], [1.0] * len(terms))
        return Placed(effect, Where(self.system, (), 0, "", "columns"), self._scales)


@dataclass(frozen=True)
class Slopes:
    """Residuals of both trials at a base and their slopes: ``base`` (r, n) with prior rows, ``columns`` (r, c).

    Rows are those of the training trial, prior rows of the base, then those of the held-out trial; ``train`` of them
    are of training trial and prior.
    """

    residuals: np.ndarray
    base: np.ndarray
    columns: np.ndarray
    train: int
    displaced: dict[str, np.ndarray]


def slopes(pair: Pair, library: Library, base: Hypothesis) -> Slopes:
    """Return the slopes of both trials at a hypothesis by basis functions and displacements."""
    parts = [_slopes_of(e, library, base) for e in (pair.train, pair.held_out)]
    (r, jac, columns, moved), (r_h, jac_h, columns_h, moved_h) = parts
    n, m = pair.train.samples, pair.held_out.samples
    priors = len(r) - n

    def both(a: np.ndarray, b: np.ndarray) -> np.ndarray:
        return np.concatenate([a, np.zeros((priors, a.shape[1])), b])

    return Slopes(
        np.concatenate([r, r_h[:m]]),
        np.vstack([jac, jac_h[:m]]),
        both(columns, columns_h),
        len(r),
        {name: both(moved[name], moved_h[name]) for name in moved},
    )


def _slopes_of(
    evidence: Evidence, library: Library, base: Hypothesis
) -> tuple[np.ndarray, np.ndarray, np.ndarray, dict[str, np.ndarray]]:
    problem = JointResiduals(evidence, base.effects, library.system, coarse=True)
    r, jac = problem.with_jacobian(base.z, np.arange(len(base.z)))
    n = evidence.samples

    def by(placed: Placed) -> np.ndarray:
        joint = JointResiduals(evidence, (*base.effects, placed), library.system, coarse=True)
        own = len(placed.effect.parameters)
        at = np.concatenate([base.z, np.zeros(own)])
        there = np.concatenate([r, np.zeros(own)])
        return joint.jacobian(at, there, np.arange(len(base.z), len(at)))[:n]

    terms = library.columns
    columns = [by(library.columns_effect(terms[i : i + _CHUNK])) for i in range(0, len(terms), _CHUNK)]
    moved = {d.name: by(library.placed(d, 1.0)) for d in library.displacements}
    return r, jac, np.hstack(columns) if columns else np.zeros((n, 0)), moved


@dataclass(frozen=True)
class Screened:
    """A family on the tangent: prior scale, gain in ln evidence over the base, and coefficients by the training trial.

    ``step`` is how far the base moves with it.
    """

    family: AnyFamily
    scale: float
    gain: float
    coefficients: np.ndarray
    step: np.ndarray


def screen(known: Slopes, library: Library, base: Hypothesis, longest: float) -> list[Screened]:
    """Return every family by its gain in ln evidence on both trials, best first."""
    lower, upper = _room(library, base, longest)
    whole = _Equations(known, slice(None), lower, upper)
    fitted = _Equations(known, slice(known.train), lower, upper)
    out = []
    everything: list[AnyFamily] = [*library.forces, *library.displacements]
    for family in everything:
        columns, weights = _columns_of(family, known, library)
        scale, gain = whole.best_scale(columns, weights)
        step, coefficients = fitted.solve(columns, scale * weights)
        out.append(Screened(family, scale, gain, coefficients, step))
    return sorted(out, key=lambda s: -s.gain)


def _columns_of(family: AnyFamily, known: Slopes, library: Library) -> tuple[np.ndarray, np.ndarray]:
    """Slopes (r, p) by a family's coefficients, and the weights (p,) of their prior."""
    if isinstance(family, Displacement):
        return known.displaced[family.name], np.array(family.weights)
    rows = [[library.index[t.joint, t.name] for t in row] for row in family.terms]
    columns = np.stack([known.columns[:, row].sum(axis=1) for row in rows], axis=1)
    return columns, np.array([row[0].weight for row in family.terms])


def _room(library: Library, base: Hypothesis, longest: float) -> tuple[np.ndarray, np.ndarray]:
    """Room of the base's parameters: to their bounds, and not further than the tangent is believed."""
    limits = [library.system.bounds(), *(placed.bounds() for placed in base.effects)]
    lower, upper = (np.concatenate(ends) for ends in zip(*limits, strict=True))
    return np.maximum(lower - base.z, -longest), np.minimum(upper - base.z, longest)


def _solved(
    a: np.ndarray, b: np.ndarray, lower: np.ndarray, upper: np.ndarray, square: float
) -> tuple[np.ndarray, float]:
    """Return the step inside the bounds of normal equations ``a`` (n, n), ``b`` (n,), and the square that it leaves."""
    step = bounded_step(a, b, lower, upper)
    return step, float(square + 2 * b @ step + step @ a @ step)


class _Equations:
    """Least squares in the base's parameters and the coefficients of one family, for some rows of the slopes."""

    def __init__(self, known: Slopes, rows: slice, lower: np.ndarray, upper: np.ndarray):
        self._rows, self._lower, self._upper = rows, lower, upper
        self._base, self._r = known.base[rows], known.residuals[rows]
        self._a = self._base.T @ self._base
        self._a[np.diag_indices_from(self._a)] += 1e-9
        self._b = self._base.T @ self._r
        self._square = float(self._r @ self._r)
        self._alone = _solved(self._a, self._b, lower, upper, self._square)[1]
        self._log_det = float(np.linalg.slogdet(self._a)[1])

    def _with(self, columns: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return normal matrix and slope of base and family, without a prior of the coefficients."""
        f = columns[self._rows]
        across = self._base.T @ f
        a = np.block([[self._a, across], [across.T, f.T @ f]])
        return a, np.concatenate([self._b, f.T @ self._r])

    def _held(self, a: np.ndarray, b: np.ndarray, sd: np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
        """Return normal matrix, step and what is left with coefficients of prior ``sd`` (p,)."""
        n, far = len(self._lower), np.full(len(sd), np.inf)
        held = a.copy()
        held[range(n, len(a)), range(n, len(a))] += 1 / sd**2
        lower, upper = np.concatenate([self._lower, -far]), np.concatenate([self._upper, far])
        return held, *_solved(held, b, lower, upper, self._square)

    def solve(self, columns: np.ndarray, sd: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the step of the base (n,) and the coefficients (p,)."""
        _, step, _ = self._held(*self._with(columns), sd)
        n = len(self._lower)
        return step[:n], step[n:]

    def best_scale(self, columns: np.ndarray, weights: np.ndarray) -> tuple[float, float]:
        """Return the prior scale of the largest evidence, and the gain in ln evidence over the base alone."""
        normal, best = self._with(columns), (float(_SCALES[0]), -np.inf)
        for scale in _SCALES:
            sd = scale * weights
            held, _, left = self._held(*normal, sd)
            occam = np.linalg.slogdet(held)[1] - self._log_det + 2 * np.sum(np.log(sd))
            gain = 0.5 * (self._alone - left - occam)
            if gain > best[1]:
                best = float(scale), float(gain)
        return best


@dataclass(frozen=True)
class Law:
    """Families that were refitted together, with the gain of ln evidence over the plain plant on both trials."""

    families: tuple[AnyFamily, ...]
    hypothesis: Hypothesis
    gain: float


def ln_evidence(pair: Pair, hypothesis: Hypothesis, longest: float) -> float:
    """Return the Laplace approximation of the ln marginal likelihood of both trials, but for what all have in common.

    A coefficient without a Gaussian prior is taken as likely anywhere within its bounds.
    """
    system, effects = pair.system, hypothesis.effects
    z, everything = hypothesis.z, np.arange(len(hypothesis.z))
    train = JointResiduals(pair.train, effects, system, coarse=True)
    held = JointResiduals(pair.held_out, effects, system, coarse=True)
    r, jac = train.with_jacobian(z, everything)
    r_h, jac_h = held.with_jacobian(z, everything)
    m = pair.held_out.samples
    r, jac = np.concatenate([r, r_h[:m]]), np.vstack([jac, jac_h[:m]])
    a = jac.T @ jac
    a[np.diag_indices_from(a)] += 1e-9
    lower = np.maximum(train.lower - z, -longest)
    upper = np.minimum(train.upper - z, longest)
    _, left = _solved(a, jac.T @ r, lower, upper, float(r @ r))
    n = len(hypothesis.base)
    sd, width = train.prior_sd[n:], (train.upper - train.lower)[n:]
    prior = np.where(np.isfinite(sd), -np.log(sd), 0.5 * np.log(2 * np.pi) - np.log(width))
    return float(-0.5 * left - 0.5 * np.linalg.slogdet(a)[1] + prior.sum())


@dataclass(frozen=True)
class _Trial:
    """What refits of families need: trials, families, search, ln evidence of the plain plant, longest step [ln]."""

    pair: Pair
    library: Library
    search: Search
    origin: float
    longest: float
    progress: Callable[[str], None]

    def refitted(self, others: tuple[AnyFamily, ...], added: Screened, base: Hypothesis) -> Law:
        """Return a screened family refitted beside those that a hypothesis holds."""
        placed = self.library.placed(added.family, added.scale)
        effects, families_ = (*base.effects, placed), (*others, added.family)
        lower, upper = self.library.system.bounds()
        z = np.concatenate([base.z + added.step, np.clip(added.coefficients, -_BOUND, _BOUND)])
        z[: len(lower)] = np.clip(z[: len(lower)], lower, upper)
        fitted = self.search.fit(effects, z)
        if max(fitted.chi2) >= FAILED:
            fitted = self.search.fit(effects, np.concatenate([base.z, np.zeros(len(added.coefficients))]))
        if max(fitted.chi2) >= FAILED:
            return Law(families_, fitted, -np.inf)
        return Law(families_, fitted, ln_evidence(self.pair, fitted, self.longest) - self.origin)

    def pruned(self, law: Law, price: float) -> Law:
        """Return a law without the families that gain less than ``price``, the one that is missed most first.

        What was found first may have stood for what came later.
        """
        while len(law.families) > 1:
            rest = [self._without(law, i) for i in range(len(law.families))]
            lost = [law.gain - other.gain for other in rest]
            least = int(np.argmin(lost))
            if lost[least] >= price:
                return _ordered(law, np.argsort(lost)[::-1].tolist())
            law = rest[least]
        return law

    def _without(self, law: Law, index: int) -> Law:
        parts, h = law.hypothesis.split(), law.hypothesis
        keep = [i for i in range(len(law.families)) if i != index]
        z = np.concatenate([h.base, *(parts[i] for i in keep)])
        fitted = self.search.fit(tuple(h.effects[i] for i in keep), z)
        gain = -np.inf
        if max(fitted.chi2) < FAILED:
            gain = ln_evidence(self.pair, fitted, self.longest) - self.origin
        return Law(tuple(law.families[i] for i in keep), fitted, gain)


def _ordered(law: Law, order: Sequence[int]) -> Law:
    """The same law with its families in another order."""
    h, parts = law.hypothesis, law.hypothesis.split()
    z = np.concatenate([h.base, *(parts[i] for i in order)])
    moved = replace(h, effects=tuple(h.effects[i] for i in order), z=z)
    return Law(tuple(law.families[i] for i in order), moved, law.gain)


def measure(
    pair: Pair,
    plain: Hypothesis,
    start: np.ndarray,
    search: Search,
    options: DiagnosisFreeFormSettings,
    search_options: DiagnosisSearchSettings,
    progress: Callable[[str], None],
) -> tuple[list[Law], Library]:
    """Return the laws that were refitted, by their evidence, best first, and the families they are from.

    Parameters
    ----------
    start
        Parameters of the system (n,) [as searched] that the tangent is taken at: those of the named set that leaves
        least, which are nearer to the truth than those of the plain fit.
    options, search_options
        Slices ``diagnosis.free_form`` and ``diagnosis.search`` of the configuration.
    """
    longest = search_options["longest_step"]
    library = Library(pair, options["band_share"])
    base = Hypothesis((), start, (np.nan, np.nan))
    progress(f"no name fits: {len(library.forces) + len(library.displacements)} families are screened")
    known = slopes(pair, library, base)
    screened = screen(known, library, base, longest)
    trial = _Trial(pair, library, search, ln_evidence(pair, plain, longest), longest, progress)
    laws = [trial.refitted((), s, base) for s in _diverse(screened, options["refits"])]
    laws = sorted(laws, key=lambda law: -law.gain)
    for law in laws[:3]:
        progress(f"{_named(law)}: ln evidence +{law.gain:.0f}")
    laws = _grown(laws, screened, trial, options, search_options["grow_share"])
    return ([trial.pruned(laws[0], float(np.log(len(screened)))), *laws[1:]] if laws else laws), library


def _named(law: Law) -> str:
    return " + ".join(f.key for f in law.families)


def _diverse(screened: Sequence[Screened], most: int) -> list[Screened]:
    """The best of each kind on each axis, ``most`` in all."""
    first: dict[tuple[str, str, tuple[str, ...]], Screened] = {}
    for s in screened:
        first.setdefault((s.family.stage, s.family.kind, s.family.axes), s)
    return list(first.values())[:most]


def _grown(
    laws: list[Law],
    screened: Sequence[Screened],
    trial: _Trial,
    options: DiagnosisFreeFormSettings,
    grow_share: float,
) -> list[Law]:
    """The laws, and further families on top of the best one while each explains much of what both trials leave."""
    price, count = np.log(len(screened)), sum(trial.search.samples)
    while laws and np.isfinite(laws[0].gain) and len(laws[0].families) < options["most"]:
        best = laws[0]
        if trial.search.is_noise(best.hypothesis):
            break
        promising = [s.family for s in screened[: options["promising"]] if isinstance(s.family, Family)]
        library = trial.library.only([f for f in promising if f not in best.families])
        known = slopes(trial.pair, library, best.hypothesis)
        further = screen(known, library, best.hypothesis, trial.longest)
        tried = [
            trial.refitted(best.families, s, best.hypothesis) for s in _diverse(further, options["most"])
        ]
        tried = [law for law in tried if law.gain - best.gain > price and _both_better(best, law)]
        more = max(tried, key=lambda law: law.gain, default=None)
        if more is None:
            break
        left, now = (sum(law.hypothesis.chi2) - count for law in (best, more))
        if now > (1 - grow_share) * left:
            break
        laws = [more, *laws]
        trial.progress(f"{_named(more)}: ln evidence +{more.gain:.0f}")
    return laws


def _both_better(smaller: Law, larger: Law) -> bool:
    """Whether a larger law leaves less of the trial that it was fitted to and of the other."""
    return all(b < a for a, b in zip(smaller.hypothesis.chi2, larger.hypothesis.chi2, strict=True))
