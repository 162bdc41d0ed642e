"""Which of several machines held the interface: the trials are simulated with each, and evidence tells.

The dynamics of the machine are assumed before anything is fitted, and no effect of the catalogue stands for all of
them. Where a lab has more than one model of its machine, each is a hypothesis like an effect: what its answer leaves,
and how many effects that answer needs.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np

from real2sim.diagnosis.attribute import finished
from real2sim.diagnosis.decide import Decision, averaged, further_price, log_likelihood
from real2sim.diagnosis.evidence import BALANCE, CONFIGURED
from real2sim.diagnosis.refit import Hypothesis
from real2sim.diagnosis.search import Pair, Search
from real2sim.diagnosis.trials import Outcome, Trials, in_common, search_both_ways
from real2sim.errors import InputError

if TYPE_CHECKING:
    from real2sim.settings import DiagnosisSettings

T = TypeVar("T")


@dataclass(frozen=True)
class Machine:
    """A machine that may have held the interface: its plain fit, and the search for a cause with it.

    ``trials`` are the names of the fitted and of the held-out one, ``pair`` and ``plain`` in their order.
    ``deviance`` is minus twice the logarithm of the evidence of its answer. ``outcome`` is None where only single
    effects were tried: with another machine one effect or none leaves noise alone.
    """

    name: str
    trials: tuple[str, str]
    pair: Pair
    plain: Hypothesis
    deviance: float
    outcome: Outcome | None = None

    @property
    def samples(self) -> tuple[int, int]:
        """Whitened residuals of the two trials: chi-squared that noise alone leaves."""
        return self.pair.train.samples, self.pair.held_out.samples

    @property
    def searched(self) -> Outcome:
        """Result of its search, which the likeliest machine always has."""
        if self.outcome is None:
            raise ValueError(f"{self.name} was not searched")
        return self.outcome

    def left(self, options: DiagnosisSettings) -> float:
        """Return chi-squared beyond its expectation that the best set of effects leaves; ``options`` as of `Trials`."""
        found, search = self.searched.found.attribution, Search(self.pair, options["search"])
        return min(search.beyond(h) for h in (found.plain, *found.hypotheses))


@dataclass(frozen=True)
class _Prepared:
    """Two trials with one machine before the search: whitened, the plain fit, and whether it leaves noise alone."""

    trials: Trials
    pair: Pair
    plain: Hypothesis
    is_noise: bool

    @property
    def common(self) -> float:
        """Terms of the deviance that all answers with this machine have in common."""
        return in_common(self.plain, (self.pair.train, self.pair.held_out))

    @property
    def deviance(self) -> float:
        """Minus twice the logarithm of the evidence of the plain fit."""
        return sum(self.plain.chi2) + self.common


def beside_configured(own: T, others: Mapping[str, T], source: str) -> dict[str, T]:
    """Return what is configured and others, by name, that first. Raises InputError where another has its name."""
    if CONFIGURED in others:
        expected = "a name of yours: that one is what the study is configured with"
        raise InputError(source, CONFIGURED, "a name that is taken", expected, "Rename it.")
    return {CONFIGURED: own, **others}


def search_with(machines: Mapping[str, Trials]) -> tuple[Outcome, list[Machine]]:
    """Return what is found with the likeliest machine, and all that were compared; none where only one is given."""
    if len(machines) == 1:
        return search_both_ways(*machines.values()), []
    compared = search_machines(machines)
    return compared[0].searched, compared


def search_machines(machines: Mapping[str, Trials]) -> list[Machine]:
    """Search for the cause with each machine, the likeliest first.

    ``machines`` are the same trials with each machine, by its name. The search begins with the machine whose plain fit
    has most evidence. Where that explains the trials with one effect or none, a machine that needs more of them loses
    by what they cost: with another whose plain fit leaves more than noise only single effects are tried, and
    everything where one of them comes near.
    """
    prepared = {name: _prepare(name, trials) for name, trials in machines.items()}
    order = sorted(prepared, key=lambda name: prepared[name].deviance)
    out: list[Machine] = []
    for name in order:
        own = prepared[name]
        options = own.trials.options
        simplest = next((m for m in out if _explains_simply(m, options)), None)
        # further trials count in the evidence of a search alone
        if simplest is not None and not own.is_noise and not own.trials.further:
            tried = _with_one_effect(name, own)
            share = probabilities([simplest, tried], options)[1]
            if share < options["calibration"]["ambiguity_probability"]:
                out.append(tried)
                continue
        out.append(_searched(name, own))
    return sorted(out, key=lambda m: m.deviance)


def _prepare(name: str, trials: Trials) -> _Prepared:
    options = trials.options
    pair, z = trials.prepare(settled=options["robot_holds"] == BALANCE)
    search = Search(pair, options["search"])
    plain = search.fit((), z, final=True)
    is_noise = search.is_noise(plain)
    if not is_noise and options["robot_holds"] == "auto":
        # one that came to rest against the interface before the record began may need no effect either
        at_rest = replace(pair, train=pair.train.as_settled(), held_out=pair.held_out.as_settled())
        settled = Search(at_rest, options["search"])
        is_noise = settled.is_noise(settled.fit((), plain.z))
    left, expected = sum(plain.chi2), sum(search.samples)
    trials.progress(f"{name}: the plain fit leaves chi-squared {left:.0f} of {expected}")
    return _Prepared(replace(trials, prepared=(pair, z)), pair, plain, is_noise)


def _searched(name: str, own: _Prepared) -> Machine:
    options = own.trials.options
    outcome = search_both_ways(own.trials)
    found = outcome.found
    pair, plain = found.pair, found.attribution.plain
    names = own.trials.train, own.trials.held_out
    if pair.exchanged or outcome.the_other_way:
        names = names[::-1]
    return Machine(name, names, pair, plain, found.cost(options), outcome)


def _with_one_effect(name: str, own: _Prepared) -> Machine:
    """Return a machine at what the most promising single effects make of it, refitted as where there is no cause."""
    options, pair = own.trials.options, own.pair
    search = Search(pair, options["search"])
    promising = search.screen(own.plain, own.trials.placed(pair))[: options["search"]["quiet_refits"]]
    fitted = [search.fit_screened(screened) for screened in promising]
    left = sum(own.plain.chi2)
    if fitted:
        nearest = min(fitted, key=lambda h: sum(h.chi2) + h.occam)
        # the other machine's answer has converged too
        h = finished(pair, nearest, options["search"])
        price = h.occam - own.plain.occam + further_price(options["calibration"])
        left = min(left, sum(h.chi2) + price)
    own.trials.progress(
        f"{name}: deviance {left:.0f} with the best single effect, and another machine needs no more than one"
    )
    names = own.trials.train, own.trials.held_out
    return Machine(name, names, pair, own.plain, left + own.common)


def _explains_simply(machine: Machine, options: DiagnosisSettings) -> bool:
    """Return whether a machine leaves noise alone with the one effect that its answer names, or without any."""
    if machine.outcome is None:
        return False
    found, named = machine.outcome.found, machine.outcome.decision.chosen
    best = found.attribution.plain if named is None else found.attribution.hypotheses[named]
    return len(best.effects) <= 1 and Search(found.pair, options["search"]).is_noise(best)


def probabilities(machines: Sequence[Machine], options: DiagnosisSettings) -> list[float]:
    """Return the probability of each machine, equal before the trials; ``options``: slice ``diagnosis``."""
    best = min(m.deviance for m in machines)
    left = min(m.left(options) for m in machines if m.outcome is not None)
    calibration = options["calibration"]
    rows = np.array([log_likelihood(m.deviance - best, left, calibration) for m in machines])
    p = np.exp(rows - rows.max())
    return [float(x) for x in p / p.sum()]


def with_others(
    decision: Decision, machines: Sequence[Machine], options: DiagnosisSettings, named: Sequence[str]
) -> Decision:
    """Return the decision with the first machine, its probabilities averaged with those of the others searched.

    The verdict stays that of the likeliest machine, as do the effects that are ``named`` together.
    """
    shares = probabilities(machines, options)
    total, least = shares[0], options["calibration"]["ambiguity_probability"]
    for machine, share in zip(machines[1:], shares[1:], strict=True):
        if machine.outcome is not None:
            total += share
            decision = averaged(decision, machine.outcome.decision, share / total, least, named)
    return decision


def configured(machines: Sequence[Machine]) -> Machine | None:
    """Return the configured machine where another one is likelier, None where it is the likeliest or the only one."""
    if not machines or machines[0].name == CONFIGURED:
        return None
    return next(m for m in machines if m.name == CONFIGURED)


def describe_machines(machines: Sequence[Machine], options: DiagnosisSettings) -> dict[str, Any] | None:
    """Return the entry ``machine`` of diagnosis.json: the likeliest one, and each that was compared; None for none."""
    if not machines:
        return None
    shares = probabilities(machines, options)
    rows = [_row(machine, share) for machine, share in zip(machines, shares, strict=True)]
    return {"name": machines[0].name, "probability": shares[0], "compared": rows}


def _row(machine: Machine, probability: float) -> dict[str, Any]:
    outcome, names = machine.outcome, machine.trials
    return {
        "name": machine.name,
        "probability": probability,
        "deviance": machine.deviance,
        "chi2_plain": dict(zip(names, machine.plain.chi2, strict=True)),
        "chi2_expected": dict(zip(names, machine.samples, strict=True)),
        "J_plain": dict(zip(names, machine.plain.j, strict=True)),
        "verdict": None if outcome is None else outcome.decision.verdict,
    }
