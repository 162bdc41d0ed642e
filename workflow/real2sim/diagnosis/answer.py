"""The answer to a diagnosis: where the gap lies, which effect causes it, how far it shrinks, what to record next."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from real2sim.diagnosis.attribute import Attribution
from real2sim.diagnosis.decide import (
    NONE,
    UNKNOWN,
    Decision,
    averaged,
    next_trial,
    share_of_other,
    shares_of,
)
from real2sim.diagnosis.evidence import Evidence
from real2sim.diagnosis.free_form import Law, Measured, measure
from real2sim.diagnosis.intervals import Precision, effect_intervals, parameter_verdicts, precision_by_fit
from real2sim.diagnosis.kin import is_kin_of
from real2sim.diagnosis.law import describe
from real2sim.diagnosis.layers import layered
from real2sim.diagnosis.machines import Machine, configured, describe_machines, with_others
from real2sim.diagnosis.misfit import CompetingLaw, Misfit, chosen, misfit_of, told_apart, with_law
from real2sim.diagnosis.next_trial import Imagine, axes_of, propose, rivals_of, told
from real2sim.diagnosis.refit import Hypothesis, run_freely
from real2sim.diagnosis.search import Pair, Search
from real2sim.diagnosis.trials import Found, Outcome, conclude
from real2sim.diagnosis.visible import could_have_shown
from real2sim.effects.base import Scales
from real2sim.effects.catalogue import EFFECTS, Placed
from real2sim.inference.noise_floor import block_bootstrap_mean

if TYPE_CHECKING:
    from real2sim.settings import DiagnosisReportSettings, DiagnosisSettings, Settings

_SCALES = ("q", "v", "k", "d", "inertia")


@dataclass(frozen=True)
class Cause:
    """An effect with some probability: where it acts, its parameters with intervals, what it closes.

    ``axes`` and ``parameters`` are those of all places where its set has it; ``parameters`` maps a name to value, unit
    and, where it has one, ``ci95``. ``stage`` is that of its first place. ``closed`` holds the share of the
    closable gap that it closes on the trial that shows the gap, with a block-bootstrap interval (None where the plain
    cost shows no gap; empty where it was not simulated). ``robot_holds`` is
    set where its values are those of the other initial state.
    """

    effect: str
    probability: float
    axes: list[str]
    stage: str
    equation: str
    beside: list[str]
    group: str
    parameters: dict[str, dict[str, Any]]
    j_held_out: float | None = None
    closed: dict[str, Any] = field(default_factory=dict)
    robot_holds: str | None = None

    @property
    def gap_closed(self) -> float | None:
        """Share of the closable gap that it closes."""
        return self.closed.get("gap_closed")

    def to_dict(self) -> dict[str, Any]:
        """Return the entry of ``causes`` in diagnosis.json."""
        out: dict[str, Any] = {
            "effect": self.effect,
            "probability": self.probability,
            "axes": self.axes,
            "stage": self.stage,
            "equation": self.equation,
            "with": self.beside,
            "group": self.group,
            "parameters": self.parameters,
        }
        if self.j_held_out is not None:
            out["J_held_out"] = self.j_held_out
        out |= self.closed
        if self.robot_holds is not None:
            out["robot_holds"] = self.robot_holds
        return out


@dataclass(frozen=True)
class Fits:
    """Everything that was fitted to two trials, and the fit that an answer rests on.

    ``plain_path`` (n, ...) is what the plain plant makes of the observations of the trial that shows the gap.
    ``law`` is the fit with the measured law, where no name fits and one was measured.
    """

    found: Found
    fitted: Hypothesis
    plain_path: np.ndarray = field(repr=False)
    law: Hypothesis | None = None


@dataclass(frozen=True)
class Beyond:
    """Sections of diagnosis.json that go beyond names, each None where it does not apply.

    ``free_form`` is the measured law where no name fits, ``misfit`` what a named cause leaves, ``could_show`` from
    which size effects would have been seen where there is `none`, ``proposed_trial`` what parts the leading hypotheses,
    ``machine`` which machine held the interface, of several.
    """

    free_form: dict[str, Any] | None = None
    misfit: dict[str, Any] | None = None
    could_show: list[dict[str, Any]] | None = None
    proposed_trial: dict[str, Any] | None = None
    machine: dict[str, Any] | None = None


@dataclass(frozen=True)
class Diagnosis:
    """Answer: where the gap lies, which unmodelled effect causes it, how far it shrinks.

    ``verdict`` is an effect's name, ``none`` or ``unknown``; ``probabilities`` over all effects and both add up to 1.
    ``where``, ``gap``, ``noise_floor``, ``considered``, ``baselines``, ``parameters`` and ``otherwise`` are sections of
    diagnosis.json. ``fits`` are those behind the answer.
    """

    verdict: str
    verdict_set: list[str]
    probabilities: dict[str, float]
    ambiguity_group: list[str]
    causes: list[Cause]
    where: dict[str, Any]
    gap: dict[str, Any]
    noise_floor: dict[str, Any]
    parameters: dict[str, dict[str, Any]]
    considered: list[dict[str, Any]]
    baselines: dict[str, str]
    next_trial: str | None
    otherwise: dict[str, Any] | None
    fits: Fits
    beyond: Beyond = Beyond()

    @property
    def found(self) -> Found:
        """Trials and everything that was fitted to them."""
        return self.fits.found

    @property
    def fitted(self) -> Hypothesis:
        """The fit that the answer rests on."""
        return self.fits.fitted

    def traces(self) -> dict[str, np.ndarray]:
        """Return columns (n,) of the trial that shows the gap: time [s]; measured, plain, with effect or law."""
        pair, explained = self.found.pair, self.fits.law or self.fitted
        return pair.shown.traces(self.fits.plain_path, simulate(pair.shown, pair, explained))

    def to_dict(self) -> dict[str, Any]:
        """Return what diagnosis.json says of the answer."""
        return {
            "robot_holds": self.found.initial_state,
            "otherwise": self.otherwise,
            "machine": self.beyond.machine,
            "free_form": self.beyond.free_form,
            "misfit": self.beyond.misfit,
            "could_show": self.beyond.could_show,
            "proposed_trial": self.beyond.proposed_trial,
            "noise_floor": self.noise_floor,
            "gap": self.gap,
            "where": self.where,
            "causes": [cause.to_dict() for cause in self.causes],
            "considered": self.considered,
            "probabilities": self.probabilities,
            "verdict": self.verdict,
            "verdict_set": self.verdict_set,
            "ambiguity_group": self.ambiguity_group,
            "next_trial": self.next_trial,
            "baselines": self.baselines,
            "parameters": self.parameters,
            "model": describe_model(self.fitted, self.found.pair.train.scales),
        }


def describe_model(hypothesis: Hypothesis, scales: Scales) -> dict[str, Any]:
    """Return everything that makes a fitted set of effects again: the entry ``model`` of diagnosis.json."""
    return {
        "effects": [
            {
                "effect": placed.effect.name,
                "form": placed.effect.form,
                "axes": placed.axes,
                "side": placed.where.side,
                "searched": x.tolist(),
                "parameters": {k: {"value": v, "unit": u} for k, (v, u) in placed.named(x).items()},
            }
            for placed, x in zip(hypothesis.effects, hypothesis.split(), strict=True)
        ],
        "scales": {name: getattr(scales, name).tolist() for name in _SCALES},
    }


def answer(
    outcome: Outcome,
    settings: Settings,
    progress: Callable[[str], None] = lambda text: None,
    imagine: Imagine | None = None,
    machines: Sequence[Machine] = (),
) -> Diagnosis:
    """Turn what was found into an answer; ``settings``: slices ``diagnosis`` and ``identifiability``.

    Where the verdict is `unknown`, the law is measured that explains the gap, if one does. ``progress`` is told;
    ``imagine`` gives trials that could be recorded next. ``machines`` are those that the likeliest one, with which the
    outcome was found, was compared with; it stands first.
    """
    options, found, own, other = settings["diagnosis"], outcome.found, outcome.decision, outcome.other
    own, misfit, measured = _checked(found, own, options, progress)
    decision, share, otherwise, reverse = own, 0.0, None, False
    named = () if own.chosen is None else found.attribution.hypotheses[own.chosen].names
    if other is not None:
        under_other, share = _under_other(outcome, other, options, progress)
        fitted_second = found.pair.exchanged or outcome.the_other_way
        reverse = other.pair.exchanged != fitted_second
        otherwise = _otherwise(other, under_other, reverse=reverse)
        if share:
            least = options["calibration"]["ambiguity_probability"]
            decision = averaged(own, under_other, share, least, named)
    if machines:
        decision = with_others(decision, machines, options, named)
    if otherwise is not None and other is not None:
        # averaging over machines scales the probabilities under both states
        scale = share / (1 - share) * _kept(decision, own) if share else 0.0
        otherwise["named_probability"] = scale * _probability_of(named, other.attribution, under_other)
    progress(f"verdict {decision.verdict}")
    account = _Account(found, decision, settings, _configured(machines, found.pair), measured)
    result = account.diagnosis(otherwise)
    if misfit is not None and misfit.rival is not None:
        rival = _rival(found.attribution, misfit.rival, found.pair.exchanged, _kept(decision, own))
        result.considered.append(rival)
    result = account.with_more(result, misfit, measured, progress, imagine)
    result = replace(result, beyond=replace(result.beyond, machine=describe_machines(machines, options)))
    if not share or other is None:
        return result
    theirs = _Account(other, under_other, settings, reverse=reverse).causes()
    likelier = {
        n: share * p > (1 - share) * own.probabilities[n] for n, p in under_other.probabilities.items()
    }
    # what is not probable enough for intervals keeps the values that it has
    least = options["report"]["interval_probability"]
    likelier = {n: more and decision.probabilities[n] >= least for n, more in likelier.items()}
    causes = _of_both_states(result.causes, theirs, likelier, decision.probabilities, other.initial_state)
    return replace(result, causes=causes)


def _under_other(
    outcome: Outcome, other: Found, options: DiagnosisSettings, progress: Callable[[str], None]
) -> tuple[Decision, float]:
    """Return the decision under the other initial state, and that state's probability.

    Laws without a name compete there too where that probability matters. It is 0 where the trials were exchanged.
    """
    found, decision = outcome.found, conclude(other, options)
    if outcome.the_other_way:
        return decision, 0.0
    left = min(found.left(options), other.left(options))
    share = share_of_other((found.cost(options), other.cost(options)), left, options["calibration"])
    if share >= options["search"]["questionable_probability"]:
        decision, _, _ = _checked(other, decision, options, progress)
    return decision, share


def _checked(
    found: Found, decision: Decision, options: DiagnosisSettings, progress: Callable[[str], None]
) -> tuple[Decision, Misfit | None, Measured | None]:
    """Return the decision once laws without a name compete where more than noise is left.

    First with the named set, then with sets that have such a law on top.
    """
    misfit = None
    if decision.chosen is not None:
        misfit = misfit_of(found, chosen(found.attribution, decision), options, progress)
        measured = misfit.measured
    elif decision.verdict == UNKNOWN:
        measured = _measured(found, options, progress)
    else:
        return decision, None, None
    if measured is not None:
        attribution, laws = found.attribution, [law.hypothesis for law in measured.laws]
        found.fit_rivals_to_both([attribution.plain, *attribution.hypotheses, *laws], options)
    if misfit is not None:
        decision, misfit = told_apart(misfit, found, decision, options)
    if measured is None:
        return decision, misfit, None
    unknown = decision.probabilities[UNKNOWN]
    decision, layers = layered(found, decision, measured, options, progress)
    if misfit is not None and misfit.rival is not None and unknown > 0:
        # what sets win back with a law on top they win from every law that competes without one
        kept = decision.probabilities[UNKNOWN] / unknown
        misfit = replace(misfit, rival=replace(misfit.rival, probability=kept * misfit.rival.probability))
    if decision.chosen is not None:
        misfit = with_law(misfit, layers, found, decision, options)
    return decision, misfit, measured


def _measured(found: Found, options: DiagnosisSettings, progress: Callable[[str], None]) -> Measured:
    """Measure laws without a name, from the parameters of the named set that leaves least."""
    search, plain = Search(found.pair, options["search"]), found.attribution.plain
    start, free, searched = _nearest(found.attribution).base, options["free_form"], options["search"]
    return measure(found.pair, plain, start, search, free, searched, progress)


def _nearest(attribution: Attribution) -> Hypothesis:
    """The named set, or the plain plant, that leaves least."""
    return min([attribution.plain, *attribution.hypotheses], key=lambda h: sum(h.chi2))


def _of_both_states(
    causes: list[Cause],
    theirs: list[Cause],
    likelier: dict[str, bool],
    probabilities: dict[str, float],
    state: str,
) -> list[Cause]:
    """Report each cause with the parameter values of the initial-state hypothesis that contributes most of it.

    ``theirs`` are those of the other state, named ``state``; ``likelier`` whether that contributes more, and enough to
    be reported. A tilt of a machine that is released has other values than one of a machine in equilibrium, in which it
    hardly shows.
    """
    taken = {
        c.effect: replace(c, probability=probabilities[c.effect], robot_holds=state)
        for c in theirs
        if likelier[c.effect]
    }
    kept = [c for c in causes if c.effect not in taken]
    return sorted([*kept, *taken.values()], key=lambda c: -c.probability)


def _otherwise(found: Found, decision: Decision, *, reverse: bool) -> dict[str, Any]:
    """Return the answer under the other initial-state hypothesis, with its pairs of trials in reverse where asked."""
    attribution = found.attribution
    pairs = {"chi2_best": chosen(attribution, decision).chi2, "chi2_expected": attribution.samples}
    return {
        "robot_holds": found.initial_state,
        "verdict": decision.verdict,
        "verdict_set": _verdict_set(attribution, decision),
        "probability": decision.probabilities[decision.verdict],
    } | {key: list(pair[::-1] if reverse else pair) for key, pair in pairs.items()}


def _kept(decision: Decision, own: Decision) -> float:
    """Return by what averaging over initial states and machines scales the probability of every set; 1 without one."""
    before = float(own.sets.sum())
    return float(decision.sets.sum()) / before if before else 1.0


def _probability_of(names: Sequence[str], attribution: Attribution, decision: Decision) -> float:
    """Return the probability under one initial state that these effects act and no others; 0 for no effects."""
    each = zip(attribution.hypotheses, decision.sets, strict=True)
    return float(sum(p for h, p in each if names and set(h.names) == set(names)))


def _verdict_set(attribution: Attribution, decision: Decision) -> list[str]:
    """Effects of the set that the verdict rests on, or `none` or `unknown`."""
    return list(chosen(attribution, decision).names) or [decision.verdict]


def _configured(machines: Sequence[Machine], pair: Pair) -> Machine | None:
    """Return the configured machine where another one is likelier, with its trials in the order of that one's ``pair``.

    The trials may have changed places with one machine and not with the other.
    """
    machine = configured(machines)
    if machine is None:
        return None
    own, plain = machine.pair, machine.plain
    if machine.trials != machines[0].trials:
        own = replace(own, train=own.held_out, held_out=own.train)
        plain = replace(plain, chi2=plain.chi2[::-1], j=plain.j[::-1], sensors=plain.sensors[::-1])
    own = replace(own, exchanged=pair.exchanged)
    return replace(machine, trials=machines[0].trials, pair=own, plain=plain)


def simulate(evidence: Evidence, pair: Pair, hypothesis: Hypothesis) -> np.ndarray:
    """Return what a hypothesis makes of a trial's observations, (n, ...)."""
    replay = evidence.replay(list(hypothesis.effects), 1)
    parameters, x = pair.system.values(hypothesis.base)[None], [own[None] for own in hypothesis.split()]
    return np.asarray(run_freely(replay, hypothesis.effects, parameters, x)[0][0])


class _Account:
    """Account of one search and its decision; ``reverse``: its fitted trial is the held-out one of the answer."""

    def __init__(
        self,
        found: Found,
        decision: Decision,
        settings: Settings,
        before: Machine | None = None,
        measured: Measured | None = None,
        *,
        reverse: bool = False,
    ):
        # the gap is that of the machine that the study is configured with
        self._before, self._before_pair, self._machine = found.attribution.plain, found.pair, before
        if before is not None:
            self._before, self._before_pair = before.plain, before.pair
        self._found, self._decision, self._settings = found, decision, settings
        self._report: DiagnosisReportSettings = settings["diagnosis"]["report"]
        self._pair, self._attribution = found.pair, found.attribution
        self._held_out = found.pair.train if reverse else found.pair.held_out
        self._measured = measured if decision.verdict == UNKNOWN else None
        self._law = None if self._measured is None else self._shown(self._measured)
        # what is named, and what explains most: a law without a name is none of the model's effects
        self._named = chosen(found.attribution, decision)
        self._best = self._named if self._law is None else self._law.hypothesis
        shown = found.pair.shown
        self._plain_path = simulate(self._before_pair.shown, self._before_pair, self._before)
        self._precisions: dict[tuple[str, bytes], Precision] = {}
        self._floor_draws = shown.floor_draws()
        self._floor = float(self._floor_draws.mean())

    def diagnosis(self, otherwise: dict[str, Any] | None) -> Diagnosis:
        """Everything together."""
        attribution, decision = self._attribution, self._decision
        named = decision.chosen is not None
        baselines = _baselines(attribution) | _independent_noise(self._pair.train, attribution)
        return Diagnosis(
            decision.verdict,
            _verdict_set(attribution, decision),
            decision.probabilities,
            list(decision.group),
            self.causes(),
            self._where(),
            self._gap(),
            self._noise_floor(),
            self._parameters(named),
            _considered(attribution, decision, self._pair.exchanged),
            baselines,
            next_trial(
                decision,
                self._report["next_trial_certain"],
                self._settings["diagnosis"]["calibration"]["ambiguity_probability"],
            ),
            otherwise,
            Fits(
                self._found,
                self._named,
                self._plain_path,
                None if self._law is None else self._law.hypothesis,
            ),
        )

    def _further(self) -> list[dict[str, Any]]:
        """Return chi-squared of plain plant and answer for each further trial, numbers moved as far as is known."""
        if not self._found.further:
            return []
        options = self._settings["diagnosis"]
        # with further trials every machine was searched
        of_plain = self._found if self._machine is None else self._machine.searched.found
        plain = of_plain.predict_further(of_plain.attribution.plain, options)
        best = self._found.predict_further(self._best, options)
        return [
            {"chi2_plain": a.chi2, "chi2_best": b.chi2, "chi2_expected": evidence.samples}
            for a, b, evidence in zip(plain, best, self._found.further, strict=True)
        ]

    def _noise_floor(self) -> dict[str, Any]:
        return {
            "J": self._floor,
            "ci95": [float(q) for q in np.quantile(self._floor_draws, [0.025, 0.975])],
            "source": self._pair.shown.noise_source,
            "residual_sd_m": self._pair.shown.residual_sd(),
        }

    def _gap(self) -> dict[str, Any]:
        shown = self._pair.shown
        base = float(shown.j(self._plain_path[None])[0])
        best_path = simulate(shown, self._pair, self._best)
        return {
            "J_base": base,
            "J_floor": self._floor,
            "visibility": (base - self._floor) / self._floor,
            "J_with_effect": float(shown.j(best_path[None])[0]),
            "chi2_plain": list(self._before.chi2),
            "chi2_best": list(self._best.chi2),
            "chi2_expected": list(self._attribution.samples),
            "by_sensor": {
                "sensors": list(self._pair.train.sensors),
                "on_floor": list(
                    self._pair.on_floor(self._settings["diagnosis"]["search"]["pair_excess_sigma"])
                ),
                "chi2_plain": [list(left) for left in self._before.by_sensor],
                "chi2_best": [list(left) for left in self._best.by_sensor],
                "chi2_expected": [list(count) for count in self._pair.samples_by_sensor],
            },
            "both_trials": _of_both_trials(self._attribution.plain, self._attribution),
            "further": self._further(),
        }

    def _where(self) -> dict[str, Any]:
        shown, about = self._pair.shown, self._about_law
        is_explained = self._best is not self._before
        explained = simulate(shown, self._pair, self._best) if is_explained else None
        stages = _stages(self._attribution, self._decision)
        if self._law is not None and self._measured is not None:
            stages = self._with_laws(stages, self._measured)
        axes = [axis for p in self._named.effects for axis in p.axes]
        axes += [] if about is None else [axis for family in about["families"] for axis in family["axes"]]
        measured = shown.axis_shares(self._plain_path)
        return {
            "stage": self._stage(stages) if about is None else about["stage"],
            "stages": stages,
            "axes": _on_axes(axes, measured, self._report["axis_share"]),
        } | shown.locate(self._plain_path, explained)

    def _with_laws(self, stages: Mapping[str, float], measured: Measured) -> dict[str, float]:
        """Return the probability of each stage where `unknown` is shared out between measured laws, by evidence.

        ``stages`` are those of the names.
        """
        out = dict(stages)
        for law, share in zip(measured.laws, self._shares_of(measured.laws), strict=True):
            out[law.families[0].stage] += self._decision.probabilities[UNKNOWN] * share
        return out

    def _against_the_name(self, measured: Measured) -> list[Law]:
        """Return the measured laws that are not what is named with another equation."""
        share = self._settings["diagnosis"]["free_form"]["main_share"]
        if self._decision.chosen is None:
            return list(measured.laws)
        library, pair = measured.library, self._pair
        return [law for law in measured.laws if not is_kin_of(law, self._named, library, pair, share)]

    def _shares_of(self, laws: Sequence[Law]) -> list[float]:
        """Return the share of each measured law in the probability of `unknown`, by evidence."""
        if not laws:
            return []
        options = self._settings["diagnosis"]
        told = [
            self._found.candidate(law.hypothesis, options, [family.key for family in law.families])
            for law in laws
        ]
        return list(shares_of(told, self._found.samples, options["calibration"]).tolist())

    def _stage(self, stages: Mapping[str, float]) -> str:
        """Return the stage of the named effect, else the one with the likeliest effects.

        That of the machine where another one explains the gap.
        """
        placed = [p for p in self._named.effects if p.effect.name == self._decision.verdict]
        if placed:
            return placed[0].effect.stage
        if self._before is not self._attribution.plain and self._decision.verdict == NONE:
            return "robot"
        return max(stages, key=lambda s: stages[s])

    def _parameters(self, named: bool) -> dict[str, dict[str, Any]]:
        system = self._pair.system
        wider = self._precision(self._named).wider
        known = parameter_verdicts(self._pair, self._named, wider, self._settings)
        # another machine may come with other parameters
        base = dict(zip(system.parameter_names, system.values(self._attribution.plain.base), strict=True))
        other = self._before_pair.system
        base |= dict(zip(other.parameter_names, other.values(self._before.base), strict=True))
        fitted = system.values(self._named.base)
        return {
            p.name: {
                "base": float(base[p.name]),
                "with_effect": float(k.unbiased if named else b),
                "fitted": float(b),
                "unit": p.unit,
                "ci95": list(k.ci95),
                "bias_ln": k.bias_ln,
                "verdict": k.verdict,
            }
            for p, b, k in zip(system.parameters, fitted, known, strict=True)
        }

    def causes(self) -> list[Cause]:
        """Return effects with some probability, likeliest first, each as in the likeliest set that holds it.

        Effects of the named set are always among them. What has hardly any probability gets no intervals.
        """
        least, most = self._report["interval_probability"], self._report["detailed_causes"]
        best: dict[str, Hypothesis] = {}
        for index in np.argsort(-self._decision.sets):
            hypothesis = self._attribution.hypotheses[index]
            for name in hypothesis.names:
                best.setdefault(name, hypothesis)
        out: list[Cause] = []
        for rank, name in enumerate(sorted(best, key=lambda n: -self._decision.probabilities[n])):
            told = self._decision.probabilities[name] >= least
            detailed = rank < most or name in self._named.names
            if told or detailed:
                out.append(self._cause(best[name], name, detailed=detailed, told=told))
        return out

    def _precision(self, hypothesis: Hypothesis) -> Precision:
        """As `precision_by_fit`, once per hypothesis."""
        key = hypothesis.key, hypothesis.z.tobytes()
        if key not in self._precisions:
            samples, options = self._attribution.samples[0], self._settings["diagnosis"]
            self._precisions[key] = precision_by_fit(self._pair, hypothesis, samples, options)
        return self._precisions[key]

    def _cause(self, hypothesis: Hypothesis, name: str, *, detailed: bool, told: bool) -> Cause:
        pair, members = self._pair, _members(hypothesis, name)
        first = members[0][0].effect
        cause = Cause(
            name,
            self._decision.probabilities[name],
            list(dict.fromkeys(axis for placed, _ in members for axis in placed.axes)),
            first.stage,
            "; ".join(dict.fromkeys(placed.effect.equation for placed, _ in members)),
            [n for n in hypothesis.names if n != name],
            first.group,
            {key: entry for _, parameters in members for key, entry in parameters.items()},
        )
        if not detailed:
            return cause
        path = simulate(self._held_out, pair, hypothesis)
        shown_path = path if pair.shown is self._held_out else simulate(pair.shown, pair, hypothesis)
        if told:
            options = self._settings["diagnosis"]
            intervals = effect_intervals(hypothesis, self._precision(hypothesis), options)
            of = {placed.key: own for placed, own in zip(hypothesis.effects, intervals, strict=True)}
            for placed, parameters in members:
                for entry, ends in zip(parameters.values(), of[placed.key], strict=True):
                    entry["ci95"] = list(ends)
        j = float(self._held_out.j(path[None])[0])
        return replace(cause, j_held_out=j, closed=self._closed(shown_path))

    def with_more(
        self,
        result: Diagnosis,
        misfit: Misfit | None,
        measured: Measured | None,
        progress: Callable[[str], None],
        imagine: Imagine | None,
    ) -> Diagnosis:
        """Return the answer with what it says beyond names.

        The law of an unknown cause, what a named one leaves (``misfit``), what `none` would have shown, and the trial
        that parts the leading hypotheses.
        """
        decision, options = self._decision, self._settings["diagnosis"]
        if decision.verdict == NONE:
            progress("none: from which size would effects have been seen?")
            seen = could_have_shown(self._pair, self._attribution.plain, options)
            return replace(result, beyond=Beyond(could_show=seen))
        beyond = Beyond()
        if self._about_law is not None:
            beyond = Beyond(free_form=self._about_law)
        elif misfit is not None:
            beyond = Beyond(misfit=misfit.to_dict(self._found))
        if result.next_trial is None or imagine is None:
            return replace(result, beyond=beyond)
        progress("the next trial: what would part the leading hypotheses?")
        laws = [] if measured is None else self._against_the_name(measured)
        rivals = rivals_of(self._attribution, decision, laws, self._shares_of(laws))
        shares = self._pair.shown.axis_shares(self._plain_path)
        axes = axes_of(rivals, self._pair, shares, self._report["next_trial_axes"])
        proposal = propose(self._pair, rivals, axes, options["search"]["longest_step"], imagine)
        if proposal is None:
            return replace(result, beyond=beyond)
        return replace(result, beyond=replace(beyond, proposed_trial=proposal), next_trial=told(proposal))

    def _shown(self, measured: Measured) -> Law | None:
        """The first law that closes enough of the gap on the held-out trial; None where none does."""
        least = self._settings["diagnosis"]["free_form"]["least_closed"]
        return next((law for law in measured.laws if self._share(law.hypothesis) >= least), None)

    @cached_property
    def _about_law(self) -> dict[str, Any] | None:
        """Account of the law that is shown, as in diagnosis.json; None where none is."""
        if self._law is None or self._measured is None:
            return None
        pair, law, nearest = self._pair, self._law, _nearest(self._attribution)
        closed = self._closed(simulate(pair.shown, pair, law.hypothesis))
        others = [other for other in self._measured.laws if other is not law]
        options = self._settings["diagnosis"]
        about = describe(pair, law, others, self._measured.library, options)
        about |= closed | {"chi2": list(law.hypothesis.chi2), "chi2_closed": self._share(law.hypothesis)}
        about["nearest"] = None
        if nearest.names:
            path = simulate(pair.shown, pair, nearest)
            name = " + ".join(nearest.names)
            about["nearest"] = {"effect": name, "chi2": list(nearest.chi2)} | self._closed(path)
        return about

    def _share(self, hypothesis: Hypothesis) -> float:
        """Share of what chi-squared of the held-out trial has above its expectation that a hypothesis takes away."""
        search = Search(self._pair, self._settings["diagnosis"]["search"])
        before, now = (search.above_by_trial(h)[1] for h in (self._attribution.plain, hypothesis))
        return (before - now) / max(before, float(np.sqrt(2 * self._attribution.samples[1])))

    def _closed(self, path: np.ndarray) -> dict[str, Any]:
        """Share of the closable gap on the trial that shows it, with a block-bootstrap interval."""
        evidence = self._pair.shown
        both = np.stack([self._plain_path, path])
        base, j = (float(cost) for cost in evidence.j(both))
        rows, sample = evidence.cost.residuals(both), evidence.cost.sample_of_residual()
        saved = np.bincount(sample, weights=rows[0] ** 2 - rows[1] ** 2)
        low, high = block_bootstrap_mean(saved * len(saved), round(evidence.rate_hz), 500, 0.95, 1)
        gap = base - self._floor
        if gap < self._report["smallest_gap"] * self._floor:
            # J cannot see the gap, though the whitened residuals may: a share of nothing is no number
            return {"gap_closed": None, "gap_closed_ci95": None}
        return {"gap_closed": (base - j) / gap, "gap_closed_ci95": [low / gap, high / gap]}


def _members(hypothesis: Hypothesis, name: str) -> list[tuple[Placed, dict[str, dict[str, Any]]]]:
    """Return the effects of one name in a set, each with its parameters: ``value`` and ``unit`` by name.

    The names differ between the effects: where they say no place, that place or the form is put before the unit.
    """
    own = [
        (placed, placed.named(x))
        for placed, x in zip(hypothesis.effects, hypothesis.split(), strict=True)
        if placed.effect.name == name
    ]
    count = Counter(key for _, named in own for key in named)
    out: list[tuple[Placed, dict[str, dict[str, Any]]]] = []
    for placed, named in own:
        tag = placed.where.tag.strip("_")
        entries = {}
        for parameter, (key, (value, unit)) in zip(placed.effect.parameters, named.items(), strict=True):
            shared = count[key] > 1 and tag
            unique = f"{parameter.name}_{tag}{key.removeprefix(parameter.name)}" if shared else key
            entries[unique] = {"value": value, "unit": unit}
        out.append((placed, entries))
    return out


def _stages(attribution: Attribution, decision: Decision) -> dict[str, float]:
    """Probability of each stage: of its effects, each where its likeliest form and place act.

    A marker that slides may be one of the pelvis, which goes in, or one of the interface, which comes out.
    """
    acts = {effect.name: effect.stage for effect in EFFECTS}
    for index in np.argsort(decision.sets):
        acts |= {p.effect.name: p.effect.stage for p in attribution.hypotheses[index].effects}
    stages = dict.fromkeys((effect.stage for effect in EFFECTS), 0.0)
    for name, stage in acts.items():
        stages[stage] += decision.probabilities[name]
    return stages


def _considered(attribution: Attribution, decision: Decision, exchanged: bool) -> list[dict[str, Any]]:
    """Every set of effects that was refitted, places and all, and what it leaves of chi-squared on both trials.

    J is that of the trial that shows the gap; ``occam`` is what the marginal likelihood adds to chi-squared.
    """
    return [
        {"effects": list(h.names), "places": [placed.key for placed in h.effects]}
        | _left_by(h, attribution, exchanged)
        | {"probability": float(probability)}
        for h, probability in zip(attribution.hypotheses, decision.sets, strict=True)
    ]


def _left_by(h: Hypothesis, attribution: Attribution, exchanged: bool) -> dict[str, Any]:
    return {
        "parameters": h.own,
        "chi2": list(h.chi2),
        "chi2_by_sensor": [list(left) for left in h.by_sensor],
        "J": h.j[0 if exchanged else 1],
        "occam": h.occam - attribution.plain.occam,
        "both_trials": _of_both_trials(h, attribution),
    }


def _of_both_trials(h: Hypothesis, attribution: Attribution) -> dict[str, Any] | None:
    """Return what numbers fitted to both trials leave, by which sets compete; None where that was not asked."""
    if h.both is None:
        return None
    return {"chi2": list(h.left), "occam": h.both.occam - attribution.plain.occam}


def _rival(attribution: Attribution, rival: CompetingLaw, exchanged: bool, kept: float) -> dict[str, Any]:
    """Return the measured law that competed with the names, as an entry of ``considered`` without effects.

    ``kept`` is the factor by which averaging over initial states and machines scales the probability of every set.
    """
    return (
        {"effects": [], "places": [family.key for family in rival.law.families]}
        | _left_by(rival.law.hypothesis, attribution, exchanged)
        | {"handicap": rival.handicap, "probability": kept * rival.probability}
    )


def _baselines(attribution: Attribution) -> dict[str, str]:
    """Return the verdicts of simpler rules on the same fits, single effects only."""
    single = [h for h in attribution.hypotheses if len(h.effects) == 1]
    if not single:
        return {}
    plain, n = attribution.plain, attribution.samples[0]

    def least(score: Callable[[Hypothesis], float]) -> str:
        best = min([plain, *single], key=score)
        return best.names[0] if best.names else NONE

    return {
        "training fit": least(lambda h: h.chi2[0]),
        "AIC": least(lambda h: h.chi2[0] + 2 * h.own),
        "BIC": least(lambda h: h.chi2[0] + np.log(n) * h.own),
        "held out, no gate": least(lambda h: h.chi2[1]),
    }


def _independent_noise(evidence: Evidence, attribution: Attribution) -> dict[str, str]:
    """Return the verdicts of rules that take every sample of J of the training trial for independent."""
    fits = [attribution.plain, *(h for h in attribution.hypotheses if len(h.effects) == 1)]
    j = np.array([h.j[0] for h in fits])
    free = np.array([len(h.z) for h in fits])
    n = evidence.plain_samples
    scores = {
        "training J": j,
        "AIC, independent noise": n * np.log(j) + 2 * free,
        "BIC, independent noise": n * np.log(j) + np.log(n) * free,
    }
    names = [h.names[0] if h.names else NONE for h in fits]
    return {rule: names[int(np.nanargmin(score))] for rule, score in scores.items()}


def _on_axes(cause: Sequence[str], measured: dict[str, float], added: float) -> dict[str, float]:
    """Return the axes of a cause where it has some, weighted by the measured share plus ``added``; else that share."""
    if not set(cause) & set(measured):
        return measured
    weights = {axis: (1.0 if axis in cause else 0.0) * (share + added) for axis, share in measured.items()}
    total = sum(weights.values())
    return {axis: weight / total for axis, weight in weights.items()}
