"""Which effect explains the gap: single effects, pairs and larger sets, from screening to joint refits.

What takes part is refitted on one trial and judged by both (`search`); what an answer makes of it is for `decide`.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable, Iterable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, TypeVar

import numpy as np

from real2sim.diagnosis.decide import further_price, is_out_of_reach
from real2sim.diagnosis.evidence import Evidence
from real2sim.diagnosis.refit import Hypothesis, JointResiduals, PlainResiduals
from real2sim.diagnosis.search import FAILED, Pair, Screened, Search, conflict
from real2sim.effects.base import Placed, Scales
from real2sim.effects.catalogue import EFFECT_NAMES, EFFECTS, are_confusable
from real2sim.errors import InputError
from real2sim.inference import least_squares
from real2sim.parallel import in_threads
from real2sim.system.description import System

if TYPE_CHECKING:
    from real2sim.settings import DiagnosisCalibrationSettings, DiagnosisSearchSettings

T = TypeVar("T")


@dataclass
class Attribution:
    """Result of a search: the plain fit, every refitted hypothesis, best first, and the whole screening.

    ``samples`` are the numbers of whitened residuals of the two trials; ``pair`` holds them with what the search
    learnt of them (jumping markers).
    """

    plain: Hypothesis
    hypotheses: list[Hypothesis]
    screened: list[tuple[str, float]]
    samples: tuple[int, int]
    pair: Pair
    evaluations: int = 0


def candidates(system: System, scales: Scales, names: Iterable[str] | None = None) -> list[Placed]:
    """Return every effect of the catalogue (or those named) at every place of a system."""
    wanted = None if names is None else set(names)
    return [
        Placed(effect, where, scales)
        for effect in EFFECTS
        if wanted is None or effect.name in wanted
        for where in effect.places(system)
    ]


def without_names(places: Iterable[Placed], left_out: Iterable[str]) -> list[Placed]:
    """Return the placed effects but those of some names, every form of each.

    Raises
    ------
    InputError
        For a name that the catalogue does not have.
    """
    names = set(left_out)
    unlisted = sorted(names - set(EFFECT_NAMES))
    if unlisted:
        raise InputError(
            "diagnosis.left_out",
            "",
            f"no effect {', '.join(unlisted)}",
            f"names of the catalogue: {', '.join(EFFECT_NAMES)}",
            "Correct the name.",
        )
    return [placed for placed in places if placed.effect.name not in names]


def plain_fit(
    evidence: Evidence, system: System, start: np.ndarray, settings: DiagnosisSearchSettings
) -> np.ndarray:
    """Return searched parameters (n,) of the plain plant by the plain cost, from ``start`` and from drawn points.

    Raises
    ------
    InputError
        Naming the recording, where it can be simulated from none of them.
    """
    rng = np.random.default_rng(settings["seed"])
    drawn = [rng.uniform(*system.bounds()) for _ in range(settings["screen"])]

    def from_each(points: Sequence[np.ndarray], iterations: int) -> list[tuple[np.ndarray, float]]:
        return in_threads(
            evidence.threads,
            lambda point: _plainly(PlainResiduals(evidence, system), point, settings, iterations),
            points,
        )

    # a start of low cost need not lead to a low one: of a resonance, far too much damping is nearer than another pitch
    first = sorted(from_each([start, *drawn], settings["first_iterations"]), key=lambda found: found[1])
    finished = from_each([z for z, _ in first[:2]], settings["iterations"])
    z, cost = min(finished, key=lambda found: found[1])
    if not np.isfinite(cost):
        raise _unsimulated(evidence, system)
    return z


def check_simulated(pair: Pair, plain: Hypothesis) -> None:
    """Refuse a pair of which the plain fit cannot be simulated: nothing can be said of its parameters or of effects.

    Raises
    ------
    InputError
        Naming the recording whose simulation fails.
    """
    if plain.chi2[0] < FAILED:
        return
    for evidence in (pair.train, pair.held_out):
        if not np.isfinite(JointResiduals(evidence, (), pair.system).costs(plain.z[None])[0]):
            raise _unsimulated(evidence, pair.system)


def _unsimulated(evidence: Evidence, system: System) -> InputError:
    return InputError(
        evidence.name,
        "",
        f"a recording on which the simulation of {system.name} fails at the parameters of the plain fit",
        "a simulation that ends, with finite positions, for some parameters within their bounds",
        "Check the driving columns for jumps and wrong units, then the bounds of the parameters and the time step.",
        "not_simulated",
    )


def _plainly(
    problem: PlainResiduals, point: np.ndarray, settings: DiagnosisSearchSettings, iterations: int
) -> tuple[np.ndarray, float]:
    """Return searched parameters (n,) and their plain cost after some iterations from a point."""
    if not np.isfinite(problem.costs(point[None])[0]):
        return point, np.inf
    z, cost, _, _ = least_squares.minimise(
        problem,
        point,
        np.arange(len(point)),
        iterations=iterations,
        ftol=1e-4,
        keep=settings["keep_jacobian"],
    )
    return np.asarray(z), float(cost)


def is_ambiguous(effects: Sequence[Placed]) -> bool:
    """Return whether one of the effects fits a law that the catalogue does not hold as often as itself.

    Two time constants fit a continuous spectrum of them within seconds.
    """
    return any(p.effect.indistinguishable for p in effects)


def attribute(
    pair: Pair,
    start: np.ndarray,
    settings: DiagnosisSearchSettings,
    progress: Callable[[str], None],
    places: Sequence[Placed] | None = None,
    calibration: DiagnosisCalibrationSettings | None = None,
    complete: Hypothesis | None = None,
) -> Attribution:
    """Plain fit, then every effect alone, then pairs where one alone leaves more than noise.

    ``start`` (12,) are ln-parameters; ``settings`` is the slice ``diagnosis.search`` of the configuration; ``places``
    are the effects to try, everything everywhere by default. With ``calibration`` (``diagnosis.calibration``), no other
    effect is looked for where less is left than the decision asks of one: only more axes of the same.
    ``complete`` is a set that leaves nothing but noise under another initial state: only its neighbours are tried.
    Without an effect that can be tried, there are no hypotheses beside the plain fit.

    Raises
    ------
    InputError
        Naming the recording, where the plain fit cannot be simulated.
    """
    search = Search(pair, settings)
    plain = search.plain = search.fit((), start, final=True)
    check_simulated(pair, plain)
    count = search.samples
    progress(f"plain fit: chi-squared {plain.chi2[0]:.0f} of {count[0]}, held out {plain.chi2[1]:.0f}")
    everything = candidates(pair.system, pair.train.scales) if places is None else list(places)
    if complete is not None:
        hypotheses = _neighbours(search, plain, complete, everything, settings)
        hypotheses = _without_spikes(search, plain, hypotheses, everything)
        return Attribution(plain, hypotheses, [], count, search.pair, search.evaluations)
    least = settings["questionable_probability"]
    quiet = calibration is not None and is_out_of_reach(search.above(plain), sum(count), least, calibration)
    singles = search.screen(plain, everything, weaken=not quiet)
    listed = [(s.effects[-1].key, s.predicted) for s in singles]
    progress(f"screened {len(listed)} hypotheses")
    hypotheses = _alone(search, _shortlist(singles, settings), plain, settings, quiet=quiet)
    if hypotheses:
        if not quiet:
            hypotheses = _other_forms(search, hypotheses, singles, plain)
            hypotheses = _other_laws(search, hypotheses, everything, settings)
            hypotheses = _redrawn(search, hypotheses, everything, settings)
        hypotheses = _with_best_converged(search, plain, hypotheses, settings)
        excess = search.excess(hypotheses[0])
        progress(f"{hypotheses[0].key} leaves {excess:.1f} sigma")
        if excess > settings["pair_excess_sigma"]:
            others = calibration is None or search.beyond(hypotheses[0]) > further_price(calibration)
            hypotheses = _several(
                search, plain, singles, hypotheses, everything, settings, progress, others=others
            )
    hypotheses = _without_spikes(search, plain, hypotheses, everything)
    return Attribution(plain, hypotheses, listed, count, search.pair, search.evaluations)


def _several(
    search: Search,
    plain: Hypothesis,
    singles: Sequence[Screened],
    found: list[Hypothesis],
    everything: Sequence[Placed],
    settings: DiagnosisSearchSettings,
    progress: Callable[[str], None],
    *,
    others: bool,
) -> list[Hypothesis]:
    """Return the single effects ``found`` (best first) with pairs and larger sets; ``others``: see `_pairs`."""
    more, promising = _pairs(search, plain, singles, found, everything, settings, others=others)
    # where no second effect earns its share, nothing of the catalogue comes near what lies beneath
    near = bool(more) and _earned(search, found[0], more[0]) >= settings["grow_share"]
    out = [*found, *more]
    if near:
        out += _swapped(search, out, everything, settings)
        grown = _grow(search, out, promising, everything, settings, progress)
        out += grown
        best = search.least(out)
        if any(h is best for h in grown):
            out += _swapped(search, out, everything, settings)
        out += _swapped_together(search, out, everything)
        out += _paired_anew(search, plain, out, everything, settings)
    return _best_of_each([*out, *_plainer(search, plain, out, everything), *_pruned(search, out)])


def _neighbours(
    search: Search,
    plain: Hypothesis,
    complete: Hypothesis,
    places: Sequence[Placed],
    settings: DiagnosisSearchSettings,
) -> list[Hypothesis]:
    """A set that is ``complete`` under another initial state, without each effect, and with another in its place.

    An initial state does what one static effect does: a robot that hangs in balance looks like one that is let go on a
    tilted floor. So what explains as much with no more effects differs from the complete set by one of them.
    """
    own = {placed.key: placed for placed in places}
    effects = tuple(own[placed.key] for placed in complete.effects)
    # the units of the numbers are those of the plain fit, which is another one under another state
    parts = [
        new.searched(old.values(x[None]))[0]
        for new, old, x in zip(effects, complete.effects, complete.split(), strict=True)
    ]
    out = [search.fit(effects, np.concatenate([complete.base, *parts]))]
    taken = _keys(effects)
    for member in range(len(effects)):
        keep = [i for i in range(len(effects)) if i != member]
        smaller = plain
        if keep:
            z = np.concatenate([out[0].base, *(parts[i] for i in keep)])
            smaller = search.fit(tuple(effects[i] for i in keep), z)
            out.append(smaller)
        axes = effects[member].where.axes
        rivals = [
            p
            for p in places
            if p.key not in taken and _alike(effects[member], p) and (not axes or _rivals(effects[member], p))
        ]
        out += search.refits_beside(smaller, rivals, settings["swap_refits"])
    return search.best_first(_best_of_each(out))


def _with_best_converged(
    search: Search, plain: Hypothesis, found: list[Hypothesis], settings: DiagnosisSearchSettings
) -> list[Hypothesis]:
    """Single effects, the best one refitted to the end, and where it leaves something its rivals in its place too.

    Of two laws of friction that were both cut short, the one that was further on would be taken for the other.
    """
    best = _converged(search, plain, found[0], settings)
    first, out = best.effects[0], [best]
    known = set(best.names)
    for h in found[1:]:
        rival = not search.is_noise(best) and _rivals(first, h.effects[0]) and _in_place(first, h.effects[0])
        if rival and not known & set(h.names):
            known |= set(h.names)
            out.append(_converged(search, plain, h, settings))
        else:
            out.append(h)
    return search.best_first(out)


def _converged(
    search: Search, plain: Hypothesis, best: Hypothesis, settings: DiagnosisSearchSettings
) -> Hypothesis:
    """The best single effect refitted to the end, where it takes away nearly all of the gap and yet leaves some.

    What a refit that was cut short leaves, or the coarse time step of the search, is no second cause.
    """
    left, gap = (search.beyond(h) for h in (best, plain))
    if search.is_noise(best) or left > settings["grow_share"] * gap:
        return best
    again = search.fit(best.effects, best.z, final=True)
    return again if again.chi2[0] <= best.chi2[0] else best


def _earned(search: Search, smaller: Hypothesis, larger: Hypothesis) -> float:
    """Share of what a set leaves beyond its noise that a larger one takes away."""
    left = search.beyond(smaller)
    return (sum(smaller.chi2) - sum(larger.chi2)) / left


def _without_spikes(
    search: Search, plain: Hypothesis, found: list[Hypothesis], everything: Sequence[Placed]
) -> list[Hypothesis]:
    """The hypotheses, with `outliers` judged by the jumps in what the best of them leaves, alone and beside others."""
    outliers = [placed for placed in everything if placed.effect.name == "outliers"]
    best = search.least([plain, *found])
    if not outliers or not search.mark_spikes(best):
        return found
    kept = [h for h in found if "outliers" not in h.names]
    # what was added for the sake of the jumps is not needed beside them: the best set of every size is tried
    sized = _first_of_each(search.best_first(kept), lambda h: str(len(h.effects)))
    bases = [*(h for h in sized if len(h.effects) <= len(best.effects)), plain]
    more = in_threads(search.threads, lambda h: search.fit((*h.effects, *outliers), h.z), bases)
    # what a set gains by being fitted on is not what the jumps explain: it is fitted on without them too
    first = search.least(more)
    if len(first.effects) > len(outliers):
        more.append(search.fit(first.effects[: -len(outliers)], first.z))
    return search.best_first(_best_of_each([*kept, *more]))


def _alone(
    search: Search,
    shortlist: Sequence[Screened],
    plain: Hypothesis,
    settings: DiagnosisSearchSettings,
    *,
    quiet: bool,
) -> list[Hypothesis]:
    """Refits of single effects, best first; those that cannot be the answer any more are left out.

    Rivals of an effect that explains everything are tried whatever they promise: they are what it is mistaken for.
    Where the plain fit is ``quiet``, no cause could earn its place: a few refits say what is next best. Empty where
    nothing is on the shortlist.
    """
    if quiet:
        shortlist = shortlist[: settings["quiet_refits"]]
    # the first are fitted in any case
    first = settings["pair_rivals"]
    found = in_threads(search.threads, lambda one: _single(search, one, plain), shortlist[:first])
    for screened in shortlist[first:]:
        best = search.least(found)
        rival = any(_alike(placed, screened.effects[-1]) for placed in best.effects)
        if not rival and _behind(search, screened, best, plain, settings):
            continue
        found.append(_single(search, screened, plain))
    if not found:
        return []
    return search.best_first(_beside_best(search, found))


def _behind(
    search: Search, screened: Screened, best: Hypothesis, plain: Hypothesis, settings: DiagnosisSearchSettings
) -> bool:
    """Return whether an effect promises too little beside a single one that explains nearly all to be an answer."""
    n = search.samples[0]
    left, gap = (search.beyond(h) for h in (best, plain))
    if search.is_noise(best):
        return bool(screened.predicted > best.chi2[0] + settings["out_of_reach"])
    far = settings["far_behind"] * search.above_by_trial(best)[0] + settings["out_of_reach"]
    return bool(left < settings["nearly_all"] * gap and screened.predicted - n > far)


def _beside_best(search: Search, found: list[Hypothesis]) -> list[Hypothesis]:
    """Single effects; where the best explains everything, its rivals in its place start from its strap too.

    What holds another as a special case (a law of friction with more constants) cannot be worse than it.
    """
    best = search.least(found)
    if not search.is_noise(best):
        return found

    def again(h: Hypothesis) -> Hypothesis:
        rival = h is not best and _rivals(best.effects[0], h.effects[0])
        return search.refit_fresh(h.effects, best.base, h) if rival else h

    return in_threads(search.threads, again, found)


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
    more = in_threads(search.threads, lambda s: _single(search, s, plain), rest)
    return search.best_first([*found, *more])


def _other_laws(
    search: Search, found: list[Hypothesis], places: Sequence[Placed], settings: DiagnosisSearchSettings
) -> list[Hypothesis]:
    """Single effects, and on the axis of the best the laws it is mistaken for that the tangent promised nothing of.

    Dry friction that never slips has no slope to be found by, and did not stand beside the relaxation it looks like.
    Where the best leaves something, constants of its law that they share start from what it found.
    """
    best = found[0]
    if len(best.effects[0].where.axes) != 1:
        return found
    known = {_keys(h.effects) for h in found}
    rivals = [p for p in places if _rivals(best.effects[0], p) and _in_place(best.effects[0], p)]
    near = None if search.is_noise(best) else _named(best, 0)
    laws = [p for p in rivals if _keys((p,)) not in known]
    starts = in_threads(search.threads, lambda p: ((p,), *search.fresh((p,), best.base, near)), laws)
    starts = sorted(starts, key=lambda start: start[2])[: settings["swap_refits"]]
    tried = in_threads(search.threads, lambda start: search.fit(start[0], start[1]), starts)
    return search.best_first([*found, *tried])


def _redrawn(
    search: Search, found: list[Hypothesis], places: Sequence[Placed], settings: DiagnosisSearchSettings
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
        if _has_many_constants(p, settings["many_constants"])
        and _rivals(best.effects[0], p)
        and _in_place(best.effects[0], p)
    ]
    from_where: list[tuple[Placed, np.ndarray]] = []
    for law in laws:
        starts, _ = search.drawn((law,), best.base, _named(best, 0), settings["redraws"])
        from_where += [(law, z) for z in starts[: settings["redraw_refits"]]]
    tried = in_threads(search.threads, lambda one: search.fit((one[0],), one[1]), from_where)
    return search.best_first(_best_of_each([*found, *tried]))


def _has_many_constants(law: Placed, many: int) -> bool:
    """Return whether a law of one axis has so ``many`` constants that a few starts may miss the best of them."""
    return len(law.effect.parameters) >= many and len(law.where.axes) == 1


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


def _shortlist(screened: Sequence[Screened], settings: DiagnosisSearchSettings) -> list[Screened]:
    """Return the best places of every effect that promises anything, up to a number of refits."""
    if not screened:
        return []
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
    settings: DiagnosisSearchSettings,
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
        beside = _without(everything, single)
        screens.append(search.screen(single, beside, likely=settings["pair_pool"]))
        options += screens[-1][: settings["pair_refits"]]
    promising = [*found[0].effects, *_promising(screens[0] if screens else singles, settings["pair_pool"])]
    if not others:
        promising = [p for p in everything if p.effect.name == found[0].names[0]]
    # an effect that acts on one axis is likely to act on another, however little that promises while it is alone
    for single in singly[: settings["spread_refits"]]:
        options += search.screen(single, _elsewhere(single, [s.effects[-1] for s in singles]))[:1]
    unlike = _first_of_each(sorted(options, key=lambda s: s.predicted), lambda s: _keys(s.effects))
    # once a pair leaves nothing but noise, a few rivals are enough
    few = settings["pair_rivals"]
    out = in_threads(search.threads, search.fit_screened, unlike[:few])
    for option in unlike[few:]:
        if search.is_noise(search.least(out)):
            break
        out.append(search.fit_screened(option))
    return search.best_first(out), promising


def _promising(screened: Sequence[Screened], most: int) -> list[Placed]:
    """The first ``most`` places of a screening, and the best place of every effect."""
    places = [s.effects[-1] for s in screened]
    first = _first_of_each(places, lambda placed: placed.effect.name)
    return list({placed.key: placed for placed in (*places[:most], *first)}.values())


def _without(places: Sequence[Placed], hypothesis: Hypothesis) -> list[Placed]:
    """The places that a hypothesis does not hold yet."""
    taken = _keys(hypothesis.effects)
    return [placed for placed in places if placed.key not in taken]


def _first_of_each(items: Sequence[T], name: Callable[[T], Hashable]) -> list[T]:
    """The first of the items of every name, in their order."""
    first: dict[Hashable, T] = {}
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
    """Return the identity of a set: effects and places, in any order."""
    return frozenset(placed.key for placed in effects)


def _best_of_each(found: Sequence[Hypothesis]) -> list[Hypothesis]:
    """One hypothesis of every set of effects and places, in the order of ``found``: the best on both trials."""
    best: dict[frozenset[str], Hypothesis] = {}
    for h in found:
        key = _keys(h.effects)
        if key not in best or sum(h.left) < sum(best[key].left):
            best[key] = h
    return list(best.values())


def _swapped(
    search: Search, found: Sequence[Hypothesis], places: Sequence[Placed], settings: DiagnosisSearchSettings
) -> list[Hypothesis]:
    """The best set with each member replaced by its rivals in the same place, also where it leaves only noise.

    A member that was found first may hold the place of another: friction is half of a hysteresis, and the other way.
    Rivals of a name that the set holds elsewhere are refitted too, however their starts compare.
    """
    best = search.least(found)
    out: list[Hypothesis] = []
    for member in best.effects:
        if not any(placed is member for placed in best.effects):
            continue
        kept = [i for i, placed in enumerate(best.effects) if placed is not member]
        near = _named(best, next(i for i, placed in enumerate(best.effects) if placed is member))
        others = tuple(best.effects[i] for i in kept)
        parts = best.split()
        base = np.concatenate([best.base, *(parts[i] for i in kept)])
        rivals = [(*others, rival) for rival in _without(places, best) if _rivals(member, rival)]
        rivals = [effects for effects in rivals if not conflict(effects)]
        starts = in_threads(search.threads, partial(search.fresh, base=base), rivals)
        for i, effects in enumerate(rivals):
            if _has_many_constants(effects[-1], settings["many_constants"]) and settings["redraws"]:
                drawn, costs = search.drawn(effects, base, near, settings["redraws"])
                starts[i] = min(starts[i], (drawn[0], float(costs[0])), key=lambda start: start[1])
        known = {placed.effect.name for placed in others}
        order = _worth_refits(rivals, [cost for _, cost in starts], known, settings["swap_refits"])
        chosen = [(rivals[i], starts[i][0]) for i in order]
        tried = in_threads(search.threads, lambda one: search.fit(*one), chosen)
        out += tried
        best = search.least([best, *tried])
    return out


def _worth_refits(
    sets: Sequence[tuple[Placed, ...]], costs: Sequence[float], known: set[str], most: int
) -> list[int]:
    """Indices of the ``most`` sets that start best, and of the best start of every ``known`` name of a last member.

    A name that a set holds on another axis adds no cause to it; and friction that always holds starts badly.
    """
    order = sorted(range(len(sets)), key=lambda i: costs[i])
    names = [effects[-1].effect.name for effects in sets]
    held = _first_of_each([i for i in order if names[i] in known], lambda i: names[i])
    return list(dict.fromkeys((*order[:most], *held)))


def _swapped_together(
    search: Search, found: Sequence[Hypothesis], places: Sequence[Placed]
) -> list[Hypothesis]:
    """The best set, where its members are effects of single axes that are mistaken for each other, as one effect.

    Each effect that they are mistaken for stands in for all of them: alone on one axis it leaves what the other does,
    and nothing shows that it would do better on both. So also where the set leaves nothing but noise.
    """
    best = search.least(found)
    first = best.effects[0]
    of_axes = all(len(p.where.axes) == 1 and _alike(first, p) for p in best.effects)
    if len(best.effects) < 2 or not of_axes:
        return []
    known = {_keys(h.effects) for h in found}
    starts = []
    alike = [p for p in places if _alike(first, p)]
    for law in dict.fromkeys(p.effect for p in alike):
        rivals = [p for m in best.effects for p in alike if p.effect is law and _same_place(p, m)]
        if len(rivals) < len(best.effects) or _keys(rivals) in known or conflict(rivals):
            continue
        starts.append(_one_by_one(search, best, rivals))
    # friction that never slips has no slope to be started on: every effect is refitted, from its best form
    starts = _first_of_each(sorted(starts, key=lambda start: start[2]), lambda start: start[0][0].effect.name)
    return in_threads(search.threads, lambda start: search.fit(start[0], start[1]), starts)


def _paired_anew(
    search: Search,
    plain: Hypothesis,
    found: Sequence[Hypothesis],
    places: Sequence[Placed],
    settings: DiagnosisSearchSettings,
) -> list[Hypothesis]:
    """The best set with its members along one axis replaced by other pairs of laws there.

    Laws along one axis stand in for each other, and what is best alone need not be one of the best two. So each law of
    the axis is fitted beside what the set has elsewhere, every other one is screened beside it, and those pairs that
    promise most are refitted.
    """
    best = search.least(found)
    fitted = {_keys(h.effects): h for h in found}
    out: list[Hypothesis] = []
    along = [p.where.axes for p in best.effects if len(p.where.axes) == 1]
    for axes in dict.fromkeys(axes for axes in along if along.count(axes) > 1):
        kept = [i for i, placed in enumerate(best.effects) if placed.where.axes != axes]
        effects, z = _with_members(best, kept)
        smaller = plain if not kept else fitted.get(_keys(effects)) or search.fit(effects, z)
        laws = [p for p in places if p.where.axes == axes]
        firsts = _first_of_each(search.screen(smaller, laws), lambda s: s.effects[-1].effect.name)
        known = [fitted.get(_keys(s.effects)) for s in firsts]
        new = in_threads(
            search.threads,
            search.fit_screened,
            [s for s, h in zip(firsts, known, strict=True) if h is None],
        )
        singles = [*(h for h in known if h is not None), *new]
        options = [s for single in singles for s in search.screen(single, _without(laws, single))]
        options = [s for s in options if _keys(s.effects) not in fitted]
        unlike = _first_of_each(sorted(options, key=lambda s: s.predicted), lambda s: _keys(s.effects))
        out += new
        out += in_threads(search.threads, search.fit_screened, unlike[: settings["pair_refits"]])
    return out


def _one_by_one(
    search: Search, best: Hypothesis, rivals: Sequence[Placed]
) -> tuple[tuple[Placed, ...], np.ndarray, float]:
    """The members of a set replaced by rivals, the others in place meanwhile: effects, start and its cost."""
    effects, parts, base, cost = list(best.effects), best.split(), best.base, np.inf
    for rival in rivals:
        effects, parts = [*effects[1:], rival], parts[1:]
        z, cost = search.fresh(tuple(effects), np.concatenate([base, *parts]))
        n = len(base)
        base = z[:n]
        parts = [*parts, z[n + sum(map(len, parts)) :]]
    return tuple(effects), np.concatenate([base, *parts]), cost


def _same_place(one: Placed, other: Placed) -> bool:
    """Return whether two places are the same axes and side."""
    return (one.where.axes, one.where.side) == (other.where.axes, other.where.side)


def _in_place(one: Placed, other: Placed) -> bool:
    """Return whether two places are the same axes, and the same side where both effects have one."""
    sides = {one.where.side, other.where.side}
    return one.where.axes == other.where.axes and (len(sides) == 1 or 0 in sides)


def _rivals(one: Placed, other: Placed) -> bool:
    """Return whether another place is on the same axis, or on all, and of an effect that is mistaken for this one."""
    return _alike(one, other) and other.where.axes in (one.where.axes, ())


def _alike(one: Placed, other: Placed) -> bool:
    """Return whether one effect is mistaken for the other."""
    return are_confusable(one.effect.name, other.effect.name)


def _without_member(hypothesis: Hypothesis, member: int) -> tuple[tuple[Placed, ...], np.ndarray]:
    """Effects of a set but for one of them, and the searched numbers (n + p,) that these have in the set."""
    return _with_members(hypothesis, [i for i in range(len(hypothesis.effects)) if i != member])


def _with_members(hypothesis: Hypothesis, keep: Sequence[int]) -> tuple[tuple[Placed, ...], np.ndarray]:
    """Effects of a set by their indices, and the searched numbers (n + p,) that these have in the set."""
    parts = hypothesis.split()
    z = np.concatenate([hypothesis.base, *(parts[i] for i in keep)])
    return tuple(hypothesis.effects[i] for i in keep), z


def _pruned(search: Search, found: Sequence[Hypothesis]) -> list[Hypothesis]:
    """The best set with each of its members left out, from the set's values; so on with the best of those.

    What was added first may have stood for what came later; and an effect that stuck alone (dry friction has hardly a
    slope before it slips) may do alone what it does in company.
    """
    best = search.least(found)
    out: list[Hypothesis] = []
    while len(best.effects) > 1:
        parts = [_without_member(best, member) for member in range(len(best.effects))]
        smaller = in_threads(search.threads, lambda part: search.fit(*part), parts)
        out += smaller
        best = search.least(smaller)
    return out


def _plainer(
    search: Search, plain: Hypothesis, found: Sequence[Hypothesis], everything: Sequence[Placed]
) -> list[Hypothesis]:
    """The best set with plainer forms of the members that fit unlisted laws as often as their own.

    Such a form costs its set a share of the probability: a form of fewer numbers that does as well bears no such doubt.
    """
    best = search.least(found)
    out: list[Hypothesis] = []
    for member, placed in enumerate(best.effects):
        if not placed.effect.indistinguishable:
            continue
        plainer = [
            p
            for p in everything
            if p.effect.name == placed.effect.name
            and not p.effect.indistinguishable
            and _same_place(placed, p)
        ]
        smaller = search.fit(*_without_member(best, member)) if len(best.effects) > 1 else plain
        out += search.refits_beside(smaller, plainer, len(plainer))
    return out


def missing_parts(
    pair: Pair, hypothesis: Hypothesis, known: Sequence[Hypothesis], settings: DiagnosisSearchSettings
) -> list[Hypothesis]:
    """Refits of a set without each of its names, of those that are not ``known``: they tell what an effect earns.

    An effect on two axes is left out on both.
    """
    if len(hypothesis.names) < 2:
        return []
    search, fitted = Search(pair, settings), {_keys(h.effects) for h in known}
    parts = []
    for name in hypothesis.names:
        kept = [i for i, placed in enumerate(hypothesis.effects) if placed.effect.name != name]
        effects, z = _with_members(hypothesis, kept)
        if _keys(effects) not in fitted:
            parts.append((effects, z))
    return in_threads(search.threads, lambda part: search.fit(*part), parts)


def finished(pair: Pair, hypothesis: Hypothesis, settings: DiagnosisSearchSettings) -> Hypothesis:
    """A hypothesis refitted until it converged; the old one where that did not help the training trial."""
    if hypothesis.converged:
        return hypothesis
    search = Search(pair, settings)
    if not search.is_noise(hypothesis):
        # the last digit of what leaves far more than noise is worth no hundred Jacobians
        rough = settings.copy()
        rough["final_iterations"], rough["final_ftol"] = settings["iterations"], settings["ftol"]
        search = Search(pair, rough)
    again = search.fit(hypothesis.effects, hypothesis.z, final=True)
    return again if again.chi2[0] <= hypothesis.chi2[0] else hypothesis


def _grow(
    search: Search,
    found: Sequence[Hypothesis],
    promising: Sequence[Placed],
    everything: Sequence[Placed],
    settings: DiagnosisSearchSettings,
    progress: Callable[[str], None],
) -> list[Hypothesis]:
    """Third and further effects (or axes of one) on top of the best set, while each earns much of what is left.

    Tried are those that were promising beside the first effect, and more axes of those that the set holds.
    """
    best = search.least(found)
    out: list[Hypothesis] = []
    while len(best.effects) < settings["most_effects"]:
        if search.is_noise(best):
            break
        places = {p.key: p for p in (*promising, *_elsewhere(best, everything))}
        options = search.screen(best, _without(list(places.values()), best))[: settings["pair_refits"]]
        more = in_threads(search.threads, search.fit_screened, options)
        out += more
        grown = search.least([best, *more])
        if _earned(search, best, grown) < settings["grow_share"]:
            break
        best = grown
        progress(f"{best.key} leaves {search.excess(best):.1f} sigma")
    return out
