"""Which of two trials is fitted, and under which initial state of the machine the search is believed.

The first trial is fitted and the second is predicted, unless the second alone shows a gap, or nothing that is fitted to
the first explains it. A machine may have been released at its start pose or have come to rest against the interface
before the record began: where the second explains much, it is searched too.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import numpy as np

from real2sim.diagnosis.attribute import (
    Attribution,
    attribute,
    candidates,
    finished,
    is_ambiguous,
    missing_parts,
    plain_fit,
    without_names,
)
from real2sim.diagnosis.decide import (
    NONE,
    UNKNOWN,
    Candidate,
    Decision,
    cost_of_answer,
    decide,
    difference_for,
    is_out_of_reach,
)
from real2sim.diagnosis.evidence import BALANCE, START_POSE, Evidence
from real2sim.diagnosis.further import predict_further
from real2sim.diagnosis.predicted import Predicted
from real2sim.diagnosis.refit import Hypothesis, JointResiduals
from real2sim.diagnosis.search import Pair, Search, samples_by_sensor
from real2sim.diagnosis.sensors import above, pooled
from real2sim.effects.catalogue import Placed
from real2sim.errors import InputError
from real2sim.parallel import in_threads
from real2sim.system.description import System

if TYPE_CHECKING:
    from real2sim.settings import DiagnosisSettings


@dataclass(frozen=True)
class Trials:
    """Two trials of one system, by name, before anything is known of their noise.

    ``load`` maps a trial's name and an initial-state hypothesis (True: in static equilibrium) to its evidence;
    ``options`` is the slice ``diagnosis`` of the configuration; ``progress`` is told what is going on; ``places`` are
    the effects to try, None for everything everywhere; ``further`` are more trials that fits have to predict.
    ``prepared`` is what `prepare` has returned before, so that it is not done twice.
    """

    train: str
    held_out: str
    system: System
    load: Callable[[str, bool], Evidence]
    options: DiagnosisSettings
    progress: Callable[[str], None]
    places: Callable[[Pair], list[Placed]] | None = None
    further: tuple[str, ...] = ()
    prepared: tuple[Pair, np.ndarray] | None = field(default=None, repr=False)

    @property
    def exchanged(self) -> Trials:
        """The same two trials, the second fitted and the first predicted."""
        return replace(self, train=self.held_out, held_out=self.train, prepared=None)

    def prepare(self, *, settled: bool = False) -> tuple[Pair, np.ndarray]:
        """Return evidence of both trials, whitened, and the plain fit (n,) of the fitted one.

        The noise is simulated at a fit of the plain cost, and once more at the fit that it whitens.
        """
        if self.prepared is not None and self.prepared[0].train.settled == settled:
            return self.prepared
        search, draws = self.options["search"], self.options["noise_draws"]
        lower, upper = self.system.bounds()
        train = self.load(self.train, settled)
        other = self.load(self.held_out, settled).as_held_out()
        z = plain_fit(train, self.system, (lower + upper) / 2, search)
        train = train.adapted(self.system.values(z))
        pair = Pair(train, other.with_scales(train.scales), self.system)
        pair = _with_noise(pair, self.system.values(z), draws, search["seed"])
        # the plain cost is blind where noise is loud: what it makes of a stiff axis passes noise on otherwise
        z = Search(pair, search).fit((), z).z
        return _with_noise(pair, self.system.values(z), draws, search["seed"]), z

    def placed(self, pair: Pair) -> list[Placed]:
        """Return the effects to try at their places, without those that are left out."""
        places = candidates(pair.system, pair.train.scales) if self.places is None else self.places(pair)
        return without_names(places, self.options["left_out"])

    def attribute(self, pair: Pair, z: np.ndarray, complete: Hypothesis | None = None) -> Found:
        """Search for the cause from the plain fit ``z`` (n,); ``complete``: see `attribute`."""
        options, places = self.options, self.placed(pair)
        search, calibration = options["search"], options["calibration"]
        found = attribute(pair, z, search, self.progress, places, calibration, complete)
        pair = replace(found.pair, exchanged=pair.exchanged)
        return Found(pair, found, self._further(pair, found))

    def _further(self, pair: Pair, found: Attribution) -> tuple[Evidence, ...]:
        """Evidence of further trials, whitened as the two are, with what jumps out of the best set marked."""
        if not self.further:
            return ()
        draws, seed = self.options["noise_draws"], self.options["search"]["seed"]
        best = min([found.plain, *found.hypotheses], key=lambda h: sum(h.chi2))
        parameters = pair.system.values(found.plain.base)
        out = []
        for name in self.further:
            evidence = self.load(name, pair.train.settled).as_held_out().with_scales(pair.train.scales)
            evidence = evidence.with_noise(parameters, draws, seed)
            paths = JointResiduals(evidence, best.effects, pair.system).paths(best.z)
            out.append(evidence.with_spikes(paths))
        return tuple(out)


def in_common(plain: Hypothesis, evidence: Sequence[Evidence]) -> float:
    """Return Occam's term of the system's parameters and the log-determinants of the noise of all trials.

    All answers under one initial state and with one machine have them in common. Each of these passes on the noise of
    the recordings in its own way, and chi-squared alone would favour the one whose noise is the largest.
    """
    return plain.occam + float(sum(e.log_determinant for e in evidence))


@dataclass(frozen=True)
class Found:
    """Two trials, what the search found of them, and further trials that it has to predict."""

    pair: Pair
    attribution: Attribution
    further: tuple[Evidence, ...] = ()
    _predictions: dict[tuple[str, bytes], list[Predicted]] = field(default_factory=dict, repr=False)

    @property
    def samples(self) -> tuple[int, ...]:
        """Whitened residuals of all trials."""
        return (*self.attribution.samples, *(evidence.samples for evidence in self.further))

    @property
    def samples_by_sensor(self) -> tuple[tuple[int, ...], ...]:
        """The same by sensor, trial by trial."""
        return (*self.pair.samples_by_sensor, *samples_by_sensor(self.further))

    def predict_further(self, hypothesis: Hypothesis, options: DiagnosisSettings) -> list[Predicted]:
        """Return what a hypothesis leaves of the further trials; ``options``: slice ``diagnosis``."""
        z = hypothesis.competing.z
        key = hypothesis.key, z.tobytes()
        if self.further and key not in self._predictions:
            longest = options["search"]["longest_step"]
            told = replace(hypothesis, z=z)
            self._predictions[key] = predict_further(self.pair, told, self.further, longest)
        return self._predictions.get(key, [])

    def candidate(
        self, hypothesis: Hypothesis, options: DiagnosisSettings, law: Sequence[str] = ()
    ) -> Candidate:
        """Return a hypothesis as the decision sees it; ``law`` are the keys of families without a name."""
        more = self.predict_further(hypothesis, options)
        occam = hypothesis.competing.occam - self.attribution.plain.occam + sum(f.occam for f in more)
        chi2 = (*hypothesis.left, *(f.chi2 for f in more))
        own = (*hypothesis.by_sensor, *(f.by_sensor for f in more))
        on_floor = self.pair.on_floor(options["search"]["pair_excess_sigma"])
        sensors = tuple(zip(pooled(own), pooled(self.samples_by_sensor), on_floor, strict=True))
        if law:
            return Candidate(tuple(law), chi2, occam, unlisted=True, sensors=sensors)
        effects, names = hypothesis.effects, hypothesis.names
        places = tuple(tuple(p.key for p in effects if p.effect.name == name) for name in names)
        return Candidate(names, chi2, occam, ambiguous=is_ambiguous(effects), places=places, sensors=sensors)

    def fit_rivals_to_both(self, hypotheses: Sequence[Hypothesis], options: DiagnosisSettings) -> None:
        """Refit those hypotheses to both trials that could then be as likely as an answer's group asks.

        ``options`` is the slice ``diagnosis`` of the configuration.
        """
        c, search = options["calibration"], Search(self.pair, options["search"])
        search.plain = self.attribution.plain
        log_odds = -float(np.log(c["ambiguity_probability"]))
        search.fit_rivals_to_both(hypotheses, lambda best: difference_for(log_odds, c, search.beyond(best)))

    @property
    def initial_state(self) -> str:
        """The initial-state hypothesis that it was searched under."""
        return BALANCE if self.pair.train.settled else START_POSE

    def cost(self, options: DiagnosisSettings) -> float:
        """Return the deviance of the answer, the price of its laws, and what all answers here have in common.

        With another initial state or machine these are other ones (`in_common`).
        """
        sets = candidates_of(self, options)
        evidence = (self.pair.train, self.pair.held_out, *self.further)
        common = in_common(self.attribution.plain, evidence)
        return cost_of_answer(*sets, self.samples, options["calibration"]) + common

    def left(self, options: DiagnosisSettings) -> float:
        """Return the chi-squared beyond the noise allowance that the best set leaves, or the plain plant."""
        plain, sets = candidates_of(self, options)
        share = options["calibration"]["noise_share"]
        return min(x.beyond(self.samples, share) for x in (plain, *sets))


@dataclass(frozen=True)
class Outcome:
    """Result of the searches: what was found and decided, and what was found under the other initial state.

    ``the_other_way``: nothing that was fitted to the first trial explains the second, and something that is fitted to
    the second explains the first.
    """

    found: Found
    decision: Decision
    other: Found | None
    the_other_way: bool


def _with_noise(pair: Pair, parameters: np.ndarray, draws: int, seed: int) -> Pair:
    both = (pair.train, pair.held_out)
    train, held_out = in_threads(
        pair.train.threads, lambda evidence: evidence.with_noise(parameters, draws, seed), both
    )
    return replace(pair, train=train, held_out=held_out)


def looks_settled(pair: Pair, plain: Hypothesis, options: DiagnosisSettings) -> bool:
    """Return whether a machine in equilibrium explains much of what one that is released leaves.

    Of all that it leaves, or before it moves. A machine that was held at its start pose in the first sample is
    released there by an interface that pulls; one that came to rest before holds where that balances the interface.
    No record says which. ``plain`` is the fit of a machine that is released; a cause may do the same as the pull
    that it leaves unexplained.
    """
    items = (pair.train, pair.held_out)
    search = Search(pair, options["search"])
    at_rest = replace(pair, **{n: getattr(pair, n).as_settled() for n in ("train", "held_out")})

    def unexplained(h: Hypothesis, of: Pair) -> tuple[float, float]:
        raw = [(e, JointResiduals(e, (), of.system).raw(h.z)) for e in (of.train, of.held_out)]
        return search.beyond(h), float(np.mean([e.standing(r) for e, r in raw])) - 1

    drawn = np.mean([e.standing(e.noise) for e in items], axis=0) - 1
    noise = (options["search"]["pair_excess_sigma"] * np.sqrt(2 * sum(search.samples)), drawn.max())
    released = unexplained(plain, pair)
    if all(left < most for left, most in zip(released, noise, strict=True)):
        return False
    settled = unexplained(Search(at_rest, options["search"]).fit((), plain.z), at_rest)
    return any(
        left > most and then < (1 - options["search"]["equilibrium_share"]) * left
        for left, then, most in zip(released, settled, noise, strict=True)
    )


def search_pair(trials: Trials, *, settled: bool = False, complete: Hypothesis | None = None) -> Found:
    """Search for the cause; the trials change places where `is_shown_by_held_out_alone`.

    ``complete``: see `attribute`.
    """
    pair, z = trials.prepare(settled=settled)
    if is_shown_by_held_out_alone(pair, z, trials.options):
        trials.progress(
            f"{trials.train} shows no gap and {trials.held_out} does: effects are fitted on the latter"
        )
        pair, z = trials.exchanged.prepare(settled=settled)
        pair = replace(pair, exchanged=True)
    return trials.attribute(pair, z, complete)


def search_initial_states(trials: Trials) -> tuple[Found, Found | None]:
    """As `search_pair`, for a machine that is released, and once more for one in equilibrium where it `looks_settled`.

    First what leaves less for its price once it has converged, then the other, where both were searched. Where a lab
    knows how its machine was held (``diagnosis.robot_holds``) that alone is searched.
    """
    options = trials.options
    if options["robot_holds"] == BALANCE:
        return search_pair(trials, settled=True), None
    released = search_pair(trials)
    if options["robot_holds"] == START_POSE or not looks_settled(
        released.pair, released.attribution.plain, options
    ):
        return released, None
    complete = _complete(released, options)
    how = "searched once more for that"
    if complete is not None:
        how = f"{complete.key} and its neighbours are tried there"
    trials.progress(f"the robot may have been at rest against the strap: {how}")
    settled = _if_simulated(lambda: search_pair(trials, settled=True, complete=complete), trials)
    if settled is None:
        return released, None
    # a refit that was cut short has not left what it would: which state is likelier is asked of what has converged
    for found in (settled, released):
        conclude(found, options)
    return (settled, released) if settled.cost(options) < released.cost(options) else (released, settled)


def _if_simulated(search: Callable[[], Found], trials: Trials) -> Found | None:
    """Return what a second search finds; None where its plain fit cannot be simulated, so that the first one stands."""
    try:
        return search()
    except InputError as error:
        if error.code != "not_simulated":
            raise
        trials.progress(f"not searched so: {error.found}")
        return None


def _complete(found: Found, options: DiagnosisSettings) -> Hypothesis | None:
    """The set of effects that leaves nothing but noise of both trials; None where none does."""
    sets = found.attribution.hypotheses
    best = min(sets, key=lambda h: sum(h.chi2), default=None)
    return best if best is not None and Search(found.pair, options["search"]).is_noise(best) else None


def search_both_ways(trials: Trials) -> Outcome:
    """As `search_initial_states`, with the trials exchanged where nothing fitted to the first explains the second.

    A stop that the first hardly reaches is shown by the second alone. Where nothing explains the first trial itself,
    nothing that is fitted to the second would.
    """
    found, other = search_initial_states(trials)
    decision = conclude(found, trials.options)
    if decision.verdict != UNKNOWN or found.pair.exchanged or not explains_fitted(found, trials.options):
        return Outcome(found, decision, other, False)
    trials.progress(
        f"nothing fitted to {trials.train} explains {trials.held_out}: searched once more the other way"
    )
    settled = found.pair.train.settled
    again = _if_simulated(lambda: trials.attribute(*trials.exchanged.prepare(settled=settled)), trials)
    second = None if again is None else conclude(again, trials.options)
    if again is None or second is None or second.chosen is None:
        return Outcome(found, decision, other, False)
    return Outcome(again, second, other, True)


def explains_fitted(found: Found, options: DiagnosisSettings) -> bool:
    """Return whether some set leaves so little of the trial that it was fitted to that `unknown` is less likely."""
    attribution, c = found.attribution, options["calibration"]
    n, plain = found.pair.samples_by_sensor[0], attribution.plain
    on_floor = found.pair.on_floor(options["search"]["pair_excess_sigma"])
    best = min(above(h.by_sensor[0], n, on_floor, c["noise_share"]) for h in (plain, *attribution.hypotheses))
    return bool(best <= c["even_share"] * max(above(plain.by_sensor[0], n, on_floor), 0.0))


def is_shown_by_held_out_alone(pair: Pair, z: np.ndarray, options: DiagnosisSettings) -> bool:
    """Return whether the plain fit (n,) leaves only noise of the fitted trial, and of the other enough to explain.

    A stop, say, that only the second trial reaches: what is fitted to the first learns nothing of it.
    """
    left = [JointResiduals(e, (), pair.system).judged(z)[0] for e in (pair.train, pair.held_out)]
    samples, sd = pair.samples_by_sensor, options["search"]["pair_excess_sigma"]
    on_floor = pair.on_floor(sd)
    quiet = above(left[0], samples[0], on_floor) < sd * np.sqrt(2 * sum(samples[0]))
    least, count = options["search"]["questionable_probability"], sum(map(sum, samples))
    plain = above(pooled(left), pooled(samples), on_floor)
    return bool(quiet and not is_out_of_reach(plain, count, least, options["calibration"]))


def candidates_of(found: Found, options: DiagnosisSettings) -> tuple[Candidate, list[Candidate]]:
    """Return the plain plant and every refitted set as the decision sees them; ``options``: slice ``diagnosis``."""
    attribution = found.attribution
    return found.candidate(attribution.plain, options), [
        found.candidate(h, options) for h in attribution.hypotheses
    ]


def _to_converge(
    decision: Decision, sets: Sequence[Candidate], converged: set[int], options: DiagnosisSettings
) -> int | None:
    """Index of the set that has to converge before the decision stands: the named one, then those that could be.

    A set that was cut short is not told from one that was not: the likeliest set of every answer that would be in the
    group (``ambiguity_probability``) converges too. None where all have.
    """
    # what leaves far too much does not become the answer by its last percent
    if decision.verdict == NONE or decision.probabilities[UNKNOWN] > options["search"]["certain_unknown"]:
        return None
    order = np.argsort(-decision.sets, kind="stable").tolist()
    named = order[:1] if decision.chosen is None else [decision.chosen]
    least, answers = options["calibration"]["ambiguity_probability"], set()
    for i in (*named, *(i for i in order if decision.sets[i] > least)):
        if sets[i].answer not in answers and i not in converged:
            return int(i)
        answers.add(sets[i].answer)
    return None


def conclude(found: Found, options: DiagnosisSettings) -> Decision:
    """Return the decision, once the sets that it rests on have converged; changes those hypotheses in place.

    Without each of its effects the named set has been refitted too.
    """
    pair, attribution = found.pair, found.attribution
    converged = {i for i, h in enumerate(attribution.hypotheses) if h.converged}
    refits = 0
    while True:
        found.fit_rivals_to_both([attribution.plain, *attribution.hypotheses], options)
        plain, sets = candidates_of(found, options)
        decision = decide(plain, sets, found.samples, options["calibration"])
        open_set = _to_converge(decision, sets, converged, options)
        if open_set is None or refits == options["search"]["final_refits"]:
            fitted = attribution.hypotheses
            if decision.chosen is None:
                return decision
            parts = missing_parts(pair, fitted[decision.chosen], fitted, options["search"])
            if not parts:
                return decision
            fitted.extend(parts)
            continue
        converged.add(open_set)
        refits += 1
        hypothesis = attribution.hypotheses[open_set]
        attribution.hypotheses[open_set] = finished(pair, hypothesis, options["search"])
