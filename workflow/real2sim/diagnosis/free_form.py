"""Laws that nobody listed: which family of forces or displacements explains the gap, and with which coefficients.

Every family is linear in its coefficients, so the simulation linearised along its motion (or one set of replays, where
it is not smooth) gives the slopes of the residuals of both trials by all basis functions. On that tangent a family has
a marginal likelihood in closed form, with the scale of its prior estimated (MacKay, Neural Comput. 4 (1992) 415). The
best few are refitted on the training trial together with the system's parameters, like any effect, and are compared by
their evidence on both trials.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from copy import copy
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING, Generic, TypeVar

import numpy as np

from real2sim.diagnosis.evidence import Evidence
from real2sim.diagnosis.law_equations import SCALES, Equations, Products, solved
from real2sim.diagnosis.refit import ENDLESS, Hypothesis, JointResiduals, following
from real2sim.diagnosis.search import FAILED, Pair, Search
from real2sim.effects import families
from real2sim.effects.base import AtRest, Effect, EffectParameter, InterfaceImpedance, Placed, Where
from real2sim.effects.chains import Context
from real2sim.effects.displacements import Displacement, displacements
from real2sim.effects.families import (
    FASTEST_HZ,
    Basis,
    Family,
    Range,
    Term,
    Variable,
    cosine,
    rhythm,
    with_rhythm,
)
from real2sim.effects.free_run import feed_back
from real2sim.effects.planned import FamilyForce
from real2sim.inference.least_squares import Tangent
from real2sim.memory import give_back
from real2sim.parallel import in_threads

if TYPE_CHECKING:
    from real2sim.settings import DiagnosisFreeFormSettings, DiagnosisSearchSettings

# Bounds of a coefficient, in units of a large force: the prior holds it long before
_BOUND = 100.0
# How often at most, and from which ratio on, that scale is widened after a refit
_RESCALINGS, _WIDER = 4, 1.5
# Histories in whose place rhythms are looked for; the slowest rhythm [Hz], and frequencies per turn more in a trial
_RHYTHMS = 4
_SLOWEST_HZ = 0.2
_PER_TURN = 4
# Basis functions that one replay has at a time
_CHUNK = 48

AnyFamily = Family | Displacement
_Made = TypeVar("_Made")


class _ByPath(Generic[_Made]):
    """Store of what is made of a path of the interface: of the trials' paths all, of any other path the latest."""

    def __init__(self, trials: Sequence[Context]):
        self._trials = trials
        self._of_trials: dict[tuple[int, int], _Made] = {}
        self._latest: tuple[np.ndarray, int, _Made] | None = None

    @property
    def everything(self) -> list[_Made]:
        """All entries, of whatever path."""
        latest = [] if self._latest is None else [self._latest[2]]
        return [*self._of_trials.values(), *latest]

    def get(self, context: Context, make: Callable[[], _Made]) -> _Made:
        """Return what is known of the path and the steps of a context, made where nothing is."""
        path, steps = context.coordinates, len(context.step_time_s)
        for i, trial in enumerate(self._trials):
            if trial.coordinates is path:
                if (i, steps) not in self._of_trials:
                    self._of_trials[i, steps] = make()
                return self._of_trials[i, steps]
        # another thread may put its own path there meanwhile
        latest = self._latest
        if latest is None or latest[0] is not path or latest[1] != steps:
            self._latest = latest = path, steps, make()
        return latest[2]


class Library:
    """The families of a pair of trials, with the ranges of variables that the training trial visited."""

    def __init__(self, pair: Pair, band_share: float):
        system, scales = pair.system, pair.train.scales
        self.system, self._scales, self._band = system, scales, band_share * system.band_hz
        self.contexts = (pair.train.context, pair.held_out.context)
        self._known = _ByPath[tuple[dict[str, Variable], dict[str, np.ndarray]]](self.contexts)
        self.template: dict[str, Variable] = {}
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
        forces = families.families(system, list(own), self.force, q, self.longest_s)
        self._take(forces, displacements(own["time"].scale, pair.train.context) if pose else [])

    @property
    def longest_s(self) -> float:
        """Duration [s] of the longer trial."""
        return max(float(families.passed_s(context)[-1]) for context in self.contexts)

    def _take(self, forces: Sequence[Family], moved: Sequence[Displacement]) -> None:
        """Hold these families, and their basis functions, each once per joint."""
        self.forces, self.displacements = list(forces), list(moved)
        self.terms = _terms_of(forces)
        self._joints = list(dict.fromkeys(t.joint for t in self.terms.values()))

    def variables(self, context: Context) -> dict[str, Variable]:
        """Return the variables of a trial, in the units of the fitted one."""
        return self._of(context)[0]

    def _of(self, context: Context) -> tuple[dict[str, Variable], dict[str, np.ndarray]]:
        """Variables of a trial, and what has been made of them by the name of the term."""
        scales = self._scales

        def made() -> tuple[dict[str, Variable], dict[str, np.ndarray]]:
            return families.variables(context, self.system, scales.q, scales.v, self._band, self.template), {}

        return self._known.get(context, made)

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

    def forget(self) -> None:
        """Give back the memory of signals: they are made again where they are asked for."""
        for _, made in self._known.everything:
            made.clear()

    @property
    def motors(self) -> Placed:
        """Motors of all joints that families act on, as an effect that does nothing."""
        first = {t.joint: t for t in reversed(self.terms.values())}
        return self.columns_effect([first[joint] for joint in self._joints])

    def forces_of_columns(self, terms: Sequence[Term], context: Context) -> np.ndarray:
        """Return forces (p, n, j) [N, Nm] at the samples by basis functions on the joints of `motors`."""
        out = np.zeros((len(terms), len(context.time_s), len(self._joints)))
        for i, (term, signal) in enumerate(zip(terms, self.signals(terms, context), strict=True)):
            out[i, :, self._joints.index(term.joint)] = signal * self.force[term.joint]
        return out

    def placed(self, family: AnyFamily, scale: float) -> Placed:
        """Return a family with a prior scale as an effect at its place."""
        if isinstance(family, Displacement):
            effect = family.effect([scale * w for w in family.weights], _BOUND)
        else:
            effect = self._forced(family, scale)
        return Placed(effect, Where(self.system, (), 0, "", _name_of(family)), self._scales)

    def _forced(self, family: Family, scale: float) -> Effect:
        rows = family.terms
        joints = tuple(dict.fromkeys(t.joint for row in rows for t in row))
        planned = _ByPath[np.ndarray](self.contexts)

        def plan(
            values: np.ndarray, context: Context, where: Where, impedance: InterfaceImpedance
        ) -> np.ndarray:
            def made() -> np.ndarray:
                out = np.zeros((len(rows), len(context.step_time_s), len(joints)))
                for i, row in enumerate(rows):
                    for term, force in zip(row, self.signals(row, context), strict=True):
                        steps = np.interp(context.step_time_s, context.time_s, force)
                        out[i, :, joints.index(term.joint)] += steps * self.force[term.joint]
                return out

            return np.asarray(np.tensordot(values, planned.get(context, made), axes=1))

        trials = ("fitted", "held out") if family.each_trial else ("",)
        coefficients = tuple(
            EffectParameter(
                f"c{i} {trial}".strip(),
                "1",
                -_BOUND,
                _BOUND,
                (0.0,),
                prior_sd=scale * row[0].weight,
                trial=trial,
            )
            for trial in trials
            for i, row in enumerate(rows)
        )
        return Effect(
            family.name,
            family.stage,
            "linear in its coefficients",
            coefficients,
            separating_trial="a wider range of what it depends on",
            at_rest=AtRest((0.0,) * len(coefficients)),
            scope="whole",
            plant=FamilyForce(plan, joints, feeds_back=family.feeds_back),
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

    def holds(self, family: AnyFamily) -> bool:
        """Return whether slopes by the coefficients of a family can be had at a base without a replay."""
        if isinstance(family, Displacement):
            return family in self.displacements
        return all((t.joint, t.name) in self.terms for row in family.terms for t in row)

    def only(self, forces: Sequence[Family]) -> Library:
        """Return the same library with some of its families of forces and no displacements."""
        out = copy(self)
        out._take(forces, [])
        return out

    def columns_effect(self, terms: Sequence[Term]) -> Placed:
        """Return basis functions side by side as one effect."""
        alike = [replace(t, weight=1.0) for t in terms]
        side_by_side = Family("columns", "interface", "", (), (), tuple((t,) for t in alike))
        effect = self._forced(side_by_side, 1.0)
        return Placed(effect, Where(self.system, (), 0, "", "columns"), self._scales)


class Responses:
    """Slopes of the residuals (r,) of a trial at a base, by basis functions and displacements.

    A simulation that is linear along its motion gives the slopes by many basis functions at once; where it is not
    smooth, or grows without bound, they are taken by replays.
    """

    def __init__(self, evidence: Evidence, library: Library, base: Hypothesis):
        self._evidence, self._library, self._base = evidence, library, base
        problem = following(evidence, base, library.system, coarse=True)
        self._residuals, self._own = problem.with_jacobian(base.z, np.arange(len(base.z)))
        self._replay = evidence.replay([*base.effects, library.motors], 1, coarse=True)
        still = np.zeros((1, len(library.motors.effect.parameters)))
        x = [*(part[None] for part in base.split()), still]
        paths, joints = self._replay.run_effects(library.system.values(base.base)[None], x)
        self._linear = self._replay.linearised()
        self._at = paths, joints, evidence.whitened(paths, joints)

    @property
    def base(self) -> tuple[np.ndarray, np.ndarray]:
        """Residuals (r,) of the trial, and their slopes (r, n) by the base's numbers."""
        n = self._evidence.rows
        return self._residuals[:n], self._own[:n]

    @property
    def priors(self) -> tuple[np.ndarray, np.ndarray]:
        """Residuals (k,) of the base's priors, and their slopes (k, n)."""
        n = self._evidence.rows
        return self._residuals[n:], self._own[n:]

    def by_placed(self, placed: Placed) -> np.ndarray:
        """Return slopes (r, p) by the parameters of an effect that does nothing at zero, by replays."""
        evidence, base = self._evidence, self._base
        joint = JointResiduals(evidence, (*base.effects, placed), self._library.system, coarse=True)
        own = len(placed.effect.parameters)
        at = np.concatenate([base.z, np.zeros(own)])
        there = np.concatenate([self._residuals, np.zeros(own)])
        if feed_back(base.effects):
            # a new family is planned from what was recorded, and so is the law of the base beside it
            there = joint.many(at[None])[0]
        return joint.jacobian(at, there, np.arange(len(base.z), len(at)))[: evidence.rows]

    @property
    def is_linear(self) -> bool:
        """True while slopes by basis functions are those of the linearised simulation."""
        return self._linear is not None

    def by(self, terms: Sequence[Term]) -> np.ndarray:
        """Return slopes (r, p) by basis functions."""
        parts = [terms[i : i + _CHUNK] for i in range(0, len(terms), _CHUNK)]
        return np.hstack([self._some(part) for part in parts])

    def _some(self, terms: Sequence[Term]) -> np.ndarray:
        if self._linear is not None:
            forces = self._library.forces_of_columns(terms, self._evidence.context)
            moved, turned = self._replay.response(self._linear, len(self._base.effects), forces)
            paths, joints, here = self._at
            found = self._evidence.whitened(paths + moved, joints + turned) - here
            if np.abs(found).max(initial=0.0) < ENDLESS:
                return np.asarray(found.T)
            # linearised steps that grow without bound (at a stiff law, say) do so for whatever drives them
            self._linear = None
        return self.by_placed(self._library.columns_effect(terms))


@dataclass(frozen=True)
class TrialSlopes:
    """Residuals (r,) of a trial at a base, and their slopes: by its numbers (r, n), and what families make of theirs.

    ``of_family`` are products with the slopes of a family by its name, ``displaced`` the slopes (r, p) of each
    displacement. The slopes by basis functions themselves are thousands, and made again for the few that are refitted.
    """

    responses: Responses
    residuals: np.ndarray
    base: np.ndarray
    of_family: dict[str, Products]
    displaced: dict[str, np.ndarray]

    def by(self, family: AnyFamily) -> np.ndarray:
        """Return the slopes (r, p) by the coefficients of a family."""
        if isinstance(family, Displacement):
            return self.displaced[family.name]
        own = _terms_of([family])
        return _summed(family, own, self.responses.by(list(own.values())))

    def products(self, family: AnyFamily) -> Products:
        """Return the products of the slopes by a family of the library."""
        if isinstance(family, Displacement):
            return Products.of(self.displaced[family.name], self.base, self.residuals)
        return self.of_family[_name_of(family)]


def _name_of(family: AnyFamily) -> str:
    # rhythms of two frequencies have one key
    return f"{family.key} {family.name}"


def _terms_of(forces: Sequence[Family]) -> dict[tuple[str, str], Term]:
    """Basis functions of families, each once per joint."""
    return {(t.joint, t.name): t for f in forces for row in f.terms for t in row}


def _summed(family: Family, terms: dict[tuple[str, str], Term], columns: np.ndarray) -> np.ndarray:
    """Slopes (r, p) by the coefficients of a family, from those (r, c) by basis functions."""
    index = {key: i for i, key in enumerate(terms)}
    rows = [[index[t.joint, t.name] for t in row] for row in family.terms]
    return np.stack([columns[:, row].sum(axis=1) for row in rows], axis=1)


@dataclass(frozen=True)
class Slopes:
    """Slopes of both trials at a base; ``prior_residuals`` (k,) and ``prior_base`` (k, n) are of the base's priors."""

    fitted: TrialSlopes
    held_out: TrialSlopes
    prior_residuals: np.ndarray
    prior_base: np.ndarray

    @property
    def trials(self) -> tuple[TrialSlopes, TrialSlopes]:
        """The fitted and the held-out one."""
        return self.fitted, self.held_out


def slopes(pair: Pair, library: Library, base: Hypothesis) -> Slopes:
    """Return the slopes of both trials at a hypothesis by basis functions and displacements."""
    fitted, held_out = in_threads(
        pair.train.threads,
        lambda evidence: _slopes_of(evidence, library, base),
        (pair.train, pair.held_out),
    )
    return Slopes(fitted, held_out, *fitted.responses.priors)


def _slopes_of(evidence: Evidence, library: Library, base: Hypothesis) -> TrialSlopes:
    """Slopes of a trial. Families of the same joints share basis functions: theirs are held at a time."""
    responses = Responses(evidence, library, base)
    residuals, own = responses.base
    while True:
        linear, of_family = responses.is_linear, {}
        for forces in _by_joints(library.forces):
            terms = _terms_of(forces)
            columns = responses.by(list(terms.values()))
            for family in forces:
                products = Products.of(_summed(family, terms, columns), own, residuals)
                of_family[_name_of(family)] = products
        # all are of one kind: what was linear before a family showed that it is not is made again
        if responses.is_linear == linear:
            break
    moved = {d.name: responses.by_placed(library.placed(d, 1.0)) for d in library.displacements}
    give_back()
    return TrialSlopes(responses, residuals, own, of_family, moved)


def _by_joints(forces: Sequence[Family]) -> list[list[Family]]:
    """Families in groups that act on the same joints; small groups are together as large as the largest."""
    groups: dict[frozenset[str], list[Family]] = {}
    for family in forces:
        groups.setdefault(frozenset(t.joint for row in family.terms for t in row), []).append(family)
    most = max((len(_terms_of(group)) for group in groups.values()), default=0)
    out: list[list[Family]] = []
    for group in groups.values():
        if out and len(_terms_of([*out[-1], *group])) <= most:
            out[-1] += group
        else:
            out.append(group)
    return out


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
    """Return every family by its gain in ln evidence on both trials, best first.

    Rhythms are looked for where a force or gain of a free history explains much.
    """
    tangent = _Tangent(known, *_room(library, base, longest))

    def screened(family: AnyFamily, products: _OfTrials, weights: np.ndarray) -> Screened:
        scale, gain = tangent.both.best_scale(products.both, weights)
        step, coefficients = tangent.fitted.solve(products.fitted, scale * weights)
        return Screened(family, scale, gain, coefficients, step)

    everything: list[AnyFamily] = [*library.forces, *library.displacements]
    out = [screened(family, *tangent.of_family(family)) for family in everything]
    free = [s for s in out if isinstance(s.family, Family) and s.family.each_trial]
    for parent in sorted(free, key=lambda s: -s.gain)[:_RHYTHMS]:
        out += [screened(*found) for found in _rhythms(parent.family, tangent, library)]
    return sorted(out, key=lambda s: -s.gain)


def smoothed(found: Screened, known: Slopes, library: Library, base: Hypothesis, longest: float) -> Screened:
    """Return a screened family with the prior scale at which its coefficients of the fitted trial predict best.

    The evidence lets a function be as rough as both trials together ask for. Where the fitted one does not determine
    that roughness, its best coefficients predict badly: a smaller scale, which the other trial chooses, is smoother.
    """
    if _is_history(found.family):
        return found
    tangent = _Tangent(known, *_room(library, base, longest))
    products, weights = tangent.of_family(found.family)
    best, least = found, np.inf
    for scale in SCALES[found.scale * (1 + 1e-9) >= SCALES][::-1]:
        step, coefficients = tangent.fitted.solve(products.fitted, scale * weights)
        cost = tangent.both.left(products.both, step, coefficients)
        if cost < least:
            best, least = replace(found, scale=float(scale), coefficients=coefficients, step=step), cost
    return best


@dataclass(frozen=True)
class _OfTrials:
    """Products of a family's slopes in the rows of the fitted trial, and in those of both."""

    fitted: Products
    both: Products

    @classmethod
    def made_of(cls, parts: Sequence[Products], *, each_trial: bool) -> _OfTrials:
        """Return those of the fitted and the held-out trial's, whose coefficients are the same or their own."""
        fitted, held_out = parts
        if each_trial:
            return cls(fitted.beside(held_out.nothing), fitted.beside(held_out))
        return cls(fitted, fitted.plus(held_out))


class _Tangent:
    """Equations of the fitted trial and of both, and products of families, trial by trial."""

    def __init__(self, known: Slopes, lower: np.ndarray, upper: np.ndarray):
        self.trials = known.trials
        base = np.vstack([known.fitted.base, known.prior_base])
        residuals = np.concatenate([known.fitted.residuals, known.prior_residuals])
        self.fitted = Equations(base, residuals, lower, upper)
        residuals = np.concatenate([residuals, known.held_out.residuals])
        self.both = Equations(np.vstack([base, known.held_out.base]), residuals, lower, upper)

    def of_family(self, family: AnyFamily) -> tuple[_OfTrials, np.ndarray]:
        """Return products of a family, and the weights (p,) of its coefficients' prior."""
        weights = _weights_of(family)
        parts = [trial.products(family) for trial in self.trials]
        each = isinstance(family, Family) and family.each_trial
        return _OfTrials.made_of(parts, each_trial=each), np.tile(weights, 2) if each else weights


def _weights_of(family: AnyFamily) -> np.ndarray:
    """Weights (p,) of the prior of a family's coefficients."""
    if isinstance(family, Displacement):
        return np.array(family.weights)
    return np.array([row[0].weight for row in family.terms])


def _rhythms(
    parent: AnyFamily, tangent: _Tangent, library: Library
) -> Iterator[tuple[Family, _OfTrials, np.ndarray]]:
    """Rhythms in place of a free history, their products and weights; a sine of time is a sum of its cosines."""
    assert isinstance(parent, Family)
    joint = parent.terms[0][0].joint
    first = len(parent.depends_on) - 1
    cosines = [Term(f"cos({k} pi time)", joint, cosine(k)) for k in range(first, first + len(parent.terms))]
    of_trial = [np.linalg.pinv(library.signals(cosines, context).T) for context in library.contexts]
    alone = [trial.products(parent) for trial in tangent.trials]
    for hz in np.arange(_SLOWEST_HZ, FASTEST_HZ - _SLOWEST_HZ, 1 / (_PER_TURN * library.longest_s)):
        family = with_rhythm(parent, float(hz))
        turns = [replace(row[0], basis=b) for row, b in zip(family.terms, _sines(float(hz)), strict=True)]
        parts = []
        for part, inverse, context in zip(alone, of_trial, library.contexts, strict=True):
            sines = np.array([t.basis(library.variables(context), library.ranges, 0.01) for t in turns])
            parts.append(part.mixed(inverse @ sines.T))
        yield family, _OfTrials.made_of(parts, each_trial=True), np.ones(4)


def _sines(hz: float) -> list[Basis]:
    return [rhythm(hz, shift) for shift in (0.0, 0.25)]


def _room(library: Library, base: Hypothesis, longest: float) -> tuple[np.ndarray, np.ndarray]:
    """Room of the base's parameters: to their bounds, and not further than the tangent is believed."""
    limits = [library.system.bounds(), *(placed.bounds() for placed in base.effects)]
    lower, upper = (np.concatenate(ends) for ends in zip(*limits, strict=True))
    return np.maximum(lower - base.z, -longest), np.minimum(upper - base.z, longest)


@dataclass(frozen=True)
class Law:
    """Families that were refitted together, with the gain of ln evidence over the plain plant on both trials.

    The last effects of the hypothesis are the families, those before them are named ones.
    """

    families: tuple[AnyFamily, ...]
    hypothesis: Hypothesis
    gain: float

    @property
    def is_history(self) -> bool:
        """Return whether its first family has a history of its own in each trial."""
        return _is_history(self.families[0])

    @property
    def is_free(self) -> bool:
        """Return whether its first family has any history, so that it predicts nothing."""
        return isinstance(self.families[0], Family) and self.families[0].is_free

    @property
    def first(self) -> int:
        """Index of the first family among the searched numbers of the hypothesis."""
        named = self.hypothesis.effects[: len(self.hypothesis.effects) - len(self.families)]
        return len(self.hypothesis.base) + sum(len(p.effect.parameters) for p in named)

    @property
    def parameters(self) -> int:
        """Number of coefficients."""
        return sum(len(x) for x in self.coefficients)

    @property
    def first_coefficients(self) -> np.ndarray:
        """Coefficients (p,) of the first family, those of the fitted trial where each trial has its own."""
        family, x = self.families[0], self.coefficients[0]
        return x[: len(family.terms)] if isinstance(family, Family) else x

    @property
    def coefficients(self) -> list[np.ndarray]:
        """Coefficients of each family, (p,)."""
        return self.hypothesis.split()[len(self.hypothesis.effects) - len(self.families) :]


def ln_evidence(pair: Pair, hypothesis: Hypothesis, longest: float) -> float:
    """Return the Laplace approximation of the ln marginal likelihood of both trials, but for what all have in common.

    A coefficient without a Gaussian prior is taken as likely anywhere within its bounds. Planned forces follow the
    motion of free runs.
    """
    z, everything = hypothesis.z, np.arange(len(hypothesis.z))
    train = following(pair.train, hypothesis, pair.system, coarse=True)
    held = following(pair.held_out, hypothesis, pair.system, coarse=True)
    r, jac = train.with_jacobian(z, everything)
    r_h, jac_h = held.with_jacobian(z, everything)
    m = pair.held_out.rows
    r, jac = np.concatenate([r, r_h[:m]]), np.vstack([jac, jac_h[:m]])
    a = jac.T @ jac
    a[np.diag_indices_from(a)] += 1e-9
    lower = np.maximum(train.lower - z, -longest)
    upper = np.minimum(train.upper - z, longest)
    _, left = solved(a, jac.T @ r, lower, upper, float(r @ r))
    n = len(hypothesis.base)
    sd, width = train.prior_sd[n:], (train.upper - train.lower)[n:]
    prior = np.where(np.isfinite(sd), -np.log(sd), 0.5 * np.log(2 * np.pi) - np.log(width))
    return float(-0.5 * left - 0.5 * np.linalg.slogdet(a)[1] + prior.sum())


@dataclass(frozen=True)
class _Trial:
    """Refits of families: trials, families, search, ln evidence of the plain plant, longest step [ln]."""

    pair: Pair
    library: Library
    search: Search
    origin: float
    longest: float
    progress: Callable[[str], None]

    def refitted(
        self,
        others: tuple[AnyFamily, ...],
        added: Screened,
        base: Hypothesis,
        known: Slopes | None = None,
    ) -> Law:
        """Return a screened family refitted beside those that a hypothesis holds.

        ``known`` are slopes at that hypothesis, which spare a refit its first Jacobian.
        """
        placed = self.library.placed(added.family, added.scale)
        effects, families_ = (*base.effects, placed), (*others, added.family)
        lower, upper = self.library.system.bounds()
        z = np.concatenate([base.z + added.step, np.clip(added.coefficients, -_BOUND, _BOUND)])
        z[: len(lower)] = np.clip(z[: len(lower)], lower, upper)
        tangent = None
        if known is not None and self.library.holds(added.family):
            tangent = self._tangent(known, added.family, placed, base)
        fitted = self.search.fit(effects, z, tangent=tangent)
        if max(fitted.chi2) >= FAILED:
            fitted = self.search.fit(effects, np.concatenate([base.z, np.zeros(len(added.coefficients))]))
        if max(fitted.chi2) >= FAILED:
            return Law(families_, fitted, -np.inf)
        law = Law(families_, fitted, ln_evidence(self.pair, fitted, self.longest) - self.origin)
        return self._rescaled(law, added)

    def _tangent(self, known: Slopes, family: AnyFamily, placed: Placed, base: Hypothesis) -> Tangent:
        """Tangent of the fitted trial at a hypothesis with a family that does nothing yet."""
        own, data, priors = placed.of_trial(held_out=False), known.fitted, known.prior_residuals
        columns = np.zeros((len(data.residuals), len(own)))
        columns[:, own] = data.by(family)
        count = len(own)
        jacobian = np.block(
            [
                [data.base, columns],
                [known.prior_base, np.zeros((len(priors), count))],
                [np.zeros((count, data.base.shape[1])), np.diag(1 / placed.prior_sd())],
            ]
        )
        residuals = np.concatenate([data.residuals, priors, np.zeros(count)])
        return Tangent(np.concatenate([base.z, np.zeros(count)]), residuals, jacobian)

    def _rescaled(self, law: Law, added: Screened) -> Law:
        """Return the law with a wider prior of its last family, as long as it asks for that and gains by it.

        The scale of the prior was estimated on the tangent. Where that was too flat it holds the coefficients back, and
        a law that could explain a gap leaves some of it.
        """
        scale, weights = added.scale, _weights_of(added.family)
        for _ in range(_RESCALINGS):
            own = law.coefficients[-1]
            asked = float(np.sqrt(np.mean((own / np.resize(weights, len(own))) ** 2)))
            if asked < _WIDER * scale:
                break
            scale = asked
            effects = (*law.hypothesis.effects[:-1], self.library.placed(added.family, scale))
            fitted = self.search.fit(effects, law.hypothesis.z)
            if max(fitted.chi2) >= FAILED or fitted.chi2[1] > law.hypothesis.chi2[1]:
                break
            gain = ln_evidence(self.pair, fitted, self.longest) - self.origin
            if gain <= law.gain:
                break
            law = Law(law.families, fitted, gain)
        return law

    def pruned(self, law: Law, price: float) -> Law:
        """Return a law without the families that gain less than ``price``, the one that is missed most first.

        What was found first may have stood for what came later.
        """
        while len(law.families) > 1:
            rest = in_threads(self.search.threads, partial(self._without, law), range(len(law.families)))
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


@dataclass(frozen=True)
class Measured:
    """Laws that were refitted without names, by their evidence, best first, and the families by what they promise."""

    laws: list[Law]
    screened: list[Screened]
    _trial: _Trial

    @property
    def library(self) -> Library:
        """The families that they are from."""
        return self._trial.library

    def on_top(self, named: Hypothesis, options: DiagnosisFreeFormSettings, share: float) -> Law | None:
        """Return the family that explains most of what a named set leaves of both trials.

        Tried are those on the axes of the set and the promising ones of the whole gap; the best are refitted together
        with the set; ``options`` is the slice ``diagnosis.free_form``, ``share`` as of `search.grow_share`. None where
        no family gains more evidence than the choice among them costs.
        """
        trial = self._trial
        axes = {axis for placed in named.effects for axis in placed.axes}
        good = {s.family.key for s in self.screened[: options["promising"]]}
        library = self.library.only([f for f in self.library.forces if axes & set(f.axes) or f.key in good])
        known = slopes(trial.pair, library, named)
        further = screen(known, library, named, trial.longest)
        alone = Law((), named, ln_evidence(trial.pair, named, trial.longest) - trial.origin)
        of_library = replace(trial, library=library)
        chosen = _diverse(further, options["most"])
        tried = in_threads(trial.search.threads, lambda s: of_library.refitted((), s, named, known), chosen)
        price = np.log(len(further)) if further else 0.0
        kept = [
            law
            for law in tried
            if law.gain - alone.gain > price and _explains_more(alone, law, trial.search, share)
        ]
        return max(kept, key=lambda law: law.gain, default=None)

    def beside(self, named: Hypothesis, law: Law) -> Law | None:
        """Return the families of a law refitted together with a named set; None where that cannot be simulated."""
        trial = self._trial
        effects = (*named.effects, *law.hypothesis.effects)
        fitted = trial.search.fit(effects, np.concatenate([named.z, np.zeros(law.parameters)]))
        if max(fitted.chi2) >= FAILED:
            return None
        return Law(law.families, fitted, ln_evidence(trial.pair, fitted, trial.longest) - trial.origin)


def measure(
    pair: Pair,
    plain: Hypothesis,
    start: np.ndarray,
    search: Search,
    options: DiagnosisFreeFormSettings,
    search_options: DiagnosisSearchSettings,
    progress: Callable[[str], None],
    reach: float = np.inf,
) -> Measured:
    """Return the laws that explain a gap without names.

    Parameters
    ----------
    start
        Parameters of the system (n,) [as searched] that the tangent is taken at: those of the named set that leaves
        least. The plain fit's are taken where no family promises to leave only noise there, and one promises more here.
    options, search_options
        Slices ``diagnosis.free_form`` and ``diagnosis.search`` of the configuration.
    reach
        Chi-squared of both trials: a family whose deviance on the tangent is larger is not refitted.
    """
    longest = search_options["longest_step"]
    library = Library(pair, options["band_share"])
    progress(
        f"{len(library.forces) + len(library.displacements)} families of laws without a name are screened"
    )
    known, screened, base = _best_screened(pair, library, (start, plain.base), search, longest)
    trial = _Trial(pair, library, search, ln_evidence(pair, plain, longest), longest, progress)
    alone = _alone(known, library, base, longest)
    within = [s for s in screened if alone - 2 * s.gain <= reach]
    chosen = [smoothed(s, known, library, base, longest) for s in _diverse(within, options["refits"])]
    # linearised simulations and signals of all families, that nothing below asks for
    del known
    library.forget()
    give_back()
    laws = in_threads(search.threads, lambda s: trial.refitted((), s, base), chosen)
    laws = sorted(laws, key=lambda law: -law.gain)
    for law in (law for law in laws[:3] if np.isfinite(law.gain)):
        progress(f"{_named(law)}: ln evidence +{law.gain:.0f}")
    laws = _grown_best(laws, screened, trial, options, search_options["grow_share"])
    if laws:
        laws[0] = trial.pruned(laws[0], float(np.log(len(screened))))
    return Measured(laws, screened, trial)


def _best_screened(
    pair: Pair, library: Library, starts: Sequence[np.ndarray], search: Search, longest: float
) -> tuple[Slopes, list[Screened], Hypothesis]:
    """Return slopes, screened families and base of the start (n,) at which a family that predicts promises most.

    One at which such a family promises to leave only noise is enough. Where the parameters are those beside effects
    that bear a part of the load (a spring of one side, a bristle), a tangent without these effects is far off.
    """
    found: list[tuple[float, list[Screened], Hypothesis]] = []
    known: Slopes | None = None
    for start in _distinct(starts):
        # slopes at two starts at a time would fill the memory
        del known
        base = Hypothesis((), start, (np.nan, np.nan))
        known = slopes(pair, library, base)
        screened = screen(known, library, base, longest)
        gain = max((s.gain for s in screened if not _is_history(s.family)), default=0.0)
        left = _alone(known, library, base, longest) - 2 * gain
        found.append((left if np.isfinite(left) else np.inf, screened, base))
        if search.is_expected(left):
            break
    _, screened, best = min(found, key=lambda one: one[0])
    if known is None or best is not found[-1][2]:
        known = slopes(pair, library, best)
    return known, screened, best


def _distinct(starts: Sequence[np.ndarray]) -> list[np.ndarray]:
    """Return starts (n,) each once, in their order."""
    return [z for i, z in enumerate(starts) if not any(np.array_equal(z, other) for other in starts[:i])]


def _alone(known: Slopes, library: Library, base: Hypothesis, longest: float) -> float:
    """Chi-squared of both trials that the tangent at a base leaves without a family."""
    return float(_Tangent(known, *_room(library, base, longest)).both.alone)


def _is_history(family: AnyFamily) -> bool:
    """Return whether a family is a history of its own in each trial, which predicts nothing."""
    return isinstance(family, Family) and family.each_trial


def _grown_best(
    laws: list[Law],
    screened: Sequence[Screened],
    trial: _Trial,
    options: DiagnosisFreeFormSettings,
    grow_share: float,
) -> list[Law]:
    """The laws with further families on top of the best; one that predicts goes before one of any history.

    A free history can stand for every law of its axis. What depends on something that was recorded says more, and is
    taken where it gains nearly as much once it has grown.
    """
    if not laws or not laws[0].is_free:
        return _grown(laws, screened, trial, options, grow_share)
    others = [law for law in laws if not law.is_free]
    predicting = [s for s in screened if not (isinstance(s.family, Family) and s.family.is_free)]
    grown = _grown(others, predicting, trial, options, grow_share)
    if grown and grown[0].gain > (1 - grow_share) * laws[0].gain:
        larger = [law for law in grown if all(law is not other for other in laws)]
        return [*larger, *laws] if larger else [grown[0], *(law for law in laws if law is not grown[0])]
    return laws


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
    price = np.log(len(screened))
    while laws and np.isfinite(laws[0].gain) and len(laws[0].families) < options["most"]:
        best = laws[0]
        if trial.search.is_noise(best.hypothesis):
            break
        promising = [s.family for s in screened[: options["promising"]] if isinstance(s.family, Family)]
        library = trial.library.only([f for f in promising if f not in best.families])
        known = slopes(trial.pair, library, best.hypothesis)
        held = {(f.key, f.name) for f in best.families}
        further = [
            s
            for s in screen(known, library, best.hypothesis, trial.longest)
            if (s.family.key, s.family.name) not in held
        ]
        chosen = [
            smoothed(s, known, library, best.hypothesis, trial.longest)
            for s in _diverse(further, options["most"])
        ]
        of_library = replace(trial, library=library)
        refitted = partial(of_library.refitted, best.families, base=best.hypothesis, known=known)
        tried = in_threads(trial.search.threads, refitted, chosen)
        tried = [
            law
            for law in tried
            if law.gain - best.gain > price and _explains_more(best, law, trial.search, grow_share)
        ]
        more = max(tried, key=lambda law: law.gain, default=None)
        if more is None:
            break
        left, now = (trial.search.beyond(law.hypothesis) for law in (best, more))
        if now > (1 - grow_share) * left:
            break
        laws = [more, *laws]
        trial.progress(f"{_named(more)}: ln evidence +{more.gain:.0f}")
    return laws


def _explains_more(smaller: Law, larger: Law, search: Search, share: float) -> bool:
    """Return whether a larger law leaves less of the trial that it was fitted to and of the other.

    A history of its own in each trial mends what another law predicts badly there: it has to take away a ``share`` of
    what stands above noise in each of them.
    """
    added = larger.families[-1]
    if isinstance(added, Family) and added.is_free:
        left, now = (search.above_by_trial(law.hypothesis) for law in (smaller, larger))
        return all(a > 0 and b < (1 - share) * a for a, b in zip(left, now, strict=True))
    return all(b < a for a, b in zip(smaller.hypothesis.chi2, larger.hypothesis.chi2, strict=True))
