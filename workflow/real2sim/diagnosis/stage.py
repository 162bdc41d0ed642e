"""Diagnosis of one person: two trials of different regimes in, one answer out (design: diagnosis.json)."""

from __future__ import annotations

import math
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from real2sim.artefacts import read_json, write_json
from real2sim.diagnosis.attribute import (
    Attribution,
    attribute,
    finished,
    is_doubtful,
    is_makeshift,
    plain_fit,
)
from real2sim.diagnosis.corrected import corrected
from real2sim.diagnosis.decide import (
    NONE,
    UNKNOWN,
    Candidate,
    Decision,
    averaged,
    cost_of_answer,
    decide,
    is_out_of_reach,
    next_trial,
    share_of_other,
)
from real2sim.diagnosis.evidence import BALANCE, START_POSE, Evidence, adapted, load_evidence
from real2sim.diagnosis.export import described
from real2sim.diagnosis.localise import axis_shares, where
from real2sim.diagnosis.refit import Hypothesis, JointResiduals
from real2sim.diagnosis.search import Pair, Search
from real2sim.effects.catalogue import EFFECTS
from real2sim.geometry import AXES, INTERFACE_MARKERS
from real2sim.inference.identifiability import AT_BOUND, DETERMINED, NOT_DETERMINED, WEAK
from real2sim.inference.noise_floor import block_bootstrap_mean
from real2sim.inference.parameters import PARAMETERS, Bounds, unit
from real2sim.provenance import fingerprint, provenance
from real2sim.recording.noise import NoiseModel
from real2sim.recording.quality.verdict import refused_gates

# Share of the floor below which J shows no gap that could be closed
SMALLEST_GAP = 0.02
# No ln-parameter is known better than this (SD): a plant with the step of the diagnosis errs as much, measured on the
# phantom, whose integrator is another (docs/diagnosis.md)
PLANT_SD_LN = 0.005
# Probability of `unknown` from which no set of effects is fitted any further
CERTAIN = 0.99
# Probability from which the parameters of a cause have intervals
TOLD = 0.005
# Share of what stands out of the noise that a robot at rest has to explain to be searched for
HOLD_SHARE = 0.25
# Two trials, and what the search found of them
Found = tuple[Pair, Attribution]
_PACKAGES = ["mujoco", "numpy", "scipy"]


def _time_step(settings: dict, step: Path | None) -> float:
    """Return the time step [s] of the person's step study, of the configuration, or the largest that suits the clock.

    That is the study's largest candidate, or where it does not divide the sample interval, the largest step below it
    that does.
    """
    if step is not None:
        return float(read_json(step, ("timestep_s",))["timestep_s"])
    configured = settings["plant"]["timestep_s"]
    if configured != "auto":
        return float(configured)
    largest, sample = max(settings["plant"]["study"]["candidates_s"]), 1 / settings["ingest"]["rate_hz"]
    parts = math.ceil(sample / largest - 1e-9)
    return float(largest) if math.isclose(parts * largest, sample) else sample / parts


def prepare(
    *,
    train: Path,
    held_out: Path,
    neutral: Path,
    limits: Path | None,
    robot: Path,
    settings: dict,
    settled: bool = False,
    threads: int = 1,
) -> tuple[Pair, np.ndarray]:
    """Evidence of both trials, whitened, and the plain fit (12,) of the training trial in ln-parameters.

    The noise is simulated at a fit of J, and once more at the fit that it whitens. ``train``, ``held_out`` and
    ``neutral`` are folders of canonical tables; ``settled``, ``threads``: see `Evidence`.
    """
    bounds = Bounds.from_config(settings["identification"]["bounds"])
    options = settings["diagnosis"]
    folders = (train, held_out)
    noise = NoiseModel.measure(neutral, settings["ingest"], options["noise"])
    evidence = [
        load_evidence(folder=f, neutral=neutral, limits=limits, robot=robot, settings=settings, noise=noise)
        for f in folders
    ]
    for item in evidence:
        item.settled, item.threads = settled, threads
    evidence[1].held_out = True
    middle = (np.log(bounds.lower) + np.log(bounds.upper)) / 2
    z = plain_fit(evidence[0], bounds, middle, options["search"])
    scales = adapted(evidence[0], np.exp(z))
    pair = Pair(evidence[0], evidence[1], bounds)
    for item in evidence:
        item.scales = scales
        item.set_noise(np.exp(z), options["noise_draws"], options["search"]["seed"])
    # J is blind where noise is loud: what it makes of a stiff axis shakes otherwise than what the noise is then seen by
    z = Search(pair, options["search"]).fit((), z).z
    for item in evidence:
        item.set_noise(np.exp(z), options["noise_draws"], options["search"]["seed"])
    return pair, z


def looks_settled(pair: Pair, plain: Hypothesis, options: dict) -> bool:
    """Whether a robot at rest explains much of what one that is let go leaves: of all, or while the person stands.

    A robot that was held at its start pose in the first sample is let go there by a strap that pulls; one that came to
    rest before holds where that balances the strap. No record says which. ``plain`` is the fit of a robot that is let
    go; a cause may do the same as the pull that it leaves unexplained.
    """
    items = (pair.train, pair.held_out)
    search = Search(pair, options["search"])

    def unexplained(h: Hypothesis) -> tuple[float, float]:
        standing = [e.standing(JointResiduals(e, (), pair.bounds).raw(h.z)) for e in items]
        return sum(h.chi2) - sum(search.samples), float(np.mean(standing)) - 1

    drawn = np.mean([e.standing(e.noise) for e in items if e.noise is not None], axis=0) - 1
    noise = (options["search"]["pair_excess_sigma"] * np.sqrt(2 * sum(search.samples)), drawn.max())
    let_go = unexplained(plain)
    if all(left < most for left, most in zip(let_go, noise, strict=True)):
        return False
    for item in items:
        item.settled = True
    at_rest = unexplained(search.fit((), plain.z))
    for item in items:
        item.settled = False
    return any(
        left > most and then < (1 - HOLD_SHARE) * left
        for left, then, most in zip(let_go, at_rest, noise, strict=True)
    )


def searched(
    *, train: Path, held_out: Path, options: dict, progress: Callable[[str], None], **known: Any
) -> Found:
    """What the search finds of two trials, which change places where `is_shown_by_held_out_alone`.

    ``options`` is the slice ``diagnosis``, ``known`` are further arguments of `prepare`.
    """
    pair, z = prepare(train=train, held_out=held_out, **known)
    if is_shown_by_held_out_alone(pair, z, options):
        progress(f"{train.name} shows no gap and {held_out.name} does: effects are fitted on the latter")
        pair, z = prepare(train=held_out, held_out=train, **known)
        pair = replace(pair, exchanged=True)
    return pair, attribute(pair, z, options["search"], progress, calibration=options["calibration"])


def searched_as_held(
    *, options: dict, progress: Callable[[str], None], **known: Any
) -> tuple[Found, Found | None]:
    """As `searched`, for a robot that is let go, and once more for one at rest where it `looks_settled`.

    First what leaves less for its price, then the other, where both were searched. Where a lab knows how its robot was
    held (``diagnosis.robot_holds``) that alone is searched. Arguments as of `searched`.
    """
    if options["robot_holds"] == BALANCE:
        return searched(options=options, progress=progress, settled=True, **known), None
    let_go = searched(options=options, progress=progress, **known)
    if options["robot_holds"] == START_POSE or not looks_settled(let_go[0], let_go[1].plain, options):
        return let_go, None
    progress("the robot may have been at rest against the strap: searched once more for that")
    at_rest = searched(options=options, progress=progress, settled=True, **known)
    return (at_rest, let_go) if _cost(at_rest, options) < _cost(let_go, options) else (let_go, at_rest)


def _cost(found: Found, options: dict) -> float:
    """What the answer to a search leaves, for its price."""
    sets = candidates_of(found[1], options["search"])
    return cost_of_answer(*sets, found[1].samples, options["calibration"])


def decided(
    *, train: Path, held_out: Path, options: dict, progress: Callable[[str], None], **known: Any
) -> tuple[Found, Decision, Found | None, bool]:
    """What was found, the decision, what was found for the other hold, and whether the trials changed places for it.

    They do where nothing that was fitted to the training trial explains the other, and something that is fitted to the
    other explains the training trial: a stop that the first hardly reaches is told by the second alone. Arguments as of
    `searched_as_held`.
    """
    found, other = searched_as_held(
        train=train, held_out=held_out, options=options, progress=progress, **known
    )
    decision = _decided(*found, options)
    pair = found[0]
    if decision.verdict != UNKNOWN or pair.exchanged:
        return found, decision, other, False
    progress(f"nothing fitted to {train.name} explains {held_out.name}: searched once more the other way")
    pair, z = prepare(train=held_out, held_out=train, settled=pair.train.settled, **known)
    again = (
        pair,
        attribute(pair, z, options["search"], progress, calibration=options["calibration"]),
    )
    second = _decided(*again, options)
    if second.chosen is None:
        return found, decision, other, False
    return again, second, other, True


def _otherwise(found: Found, decision: Decision) -> dict[str, Any]:
    """What the answer would be if the robot's controller held otherwise."""
    pair, attribution = found
    return {
        "robot_holds": _hold(pair),
        "verdict": decision.verdict,
        "verdict_set": _named(attribution, decision),
        "probability": decision.probabilities[decision.verdict],
        "chi2_best": list(_chosen(attribution, decision).chi2),
        "chi2_expected": list(attribution.samples),
    }


def is_shown_by_held_out_alone(pair: Pair, z: np.ndarray, options: dict) -> bool:
    """Whether the plain fit (12,) leaves nothing but noise of the training trial, and of the other enough to explain.

    A stop, say, that only the second trial reaches: what is fitted to the first learns nothing of it.
    """
    left = [JointResiduals(e, (), pair.bounds).judged(z)[0] for e in (pair.train, pair.held_out)]
    samples = (pair.train.samples, pair.held_out.samples)
    noise = samples[0] + options["search"]["pair_excess_sigma"] * np.sqrt(2 * samples[0])
    quiet = left[0] < noise
    return bool(quiet and not is_out_of_reach((left[1], left[0]), samples[::-1], options["calibration"]))


def candidates_of(attribution: Attribution, search: dict) -> tuple[Candidate, list[Candidate]]:
    """The plain plant and every refitted set as the decision sees them; ``search``: slice ``diagnosis.search``."""
    samples = sum(attribution.samples)
    noise = samples + search["pair_excess_sigma"] * np.sqrt(2 * samples)
    return Candidate((), 0, attribution.plain.chi2), [
        Candidate(
            h.names,
            len(h.z) - 12,
            h.chi2,
            is_makeshift(h.effects, leaves_noise=sum(h.chi2) < noise),
            is_doubtful(h.effects),
        )
        for h in attribution.hypotheses
    ]


def diagnose(
    *,
    subject: str,
    train: Path,
    held_out: Path,
    neutral: Path,
    robot: Path,
    settings: dict,
    out: Path,
    limits: Path | None = None,
    step: Path | None = None,
    gates: list[Path] | None = None,
    traces: Path | None = None,
    threads: int = 1,
) -> None:
    """Where the gap lies, which effect causes it, how far it shrinks; written as diagnosis.json.

    Parameters
    ----------
    train, held_out, neutral
        Folders of canonical tables of three trials: results/trials/<SUBJECT>/<TRIAL>.
    settings
        Slices ``identification``, ``identifiability``, ``plant``, ``robot``, ``ingest`` and ``diagnosis`` of the
        configuration.
    limits, step
        Joint limits and step study of the person, where they exist.
    gates
        Verdicts on the trials (results/quality/<SUBJECT>/<TRIAL>.json). What they refuse is named in the answer.
    traces
        Table (Parquet) of the trial that shows the gap: time and, per interface marker and axis, measured, plain and
        with effect.
    threads
        That simulate. The answer is the same bits with any number.

    Where the trials look as if the robot had been at rest (`looks_settled`), that is searched too, and the answer taken
    that leaves less for its price. Where the answer would be `unknown`, the trials change places (`decided`).
    """

    def progress(text: str) -> None:
        print(f"{subject}: {text}", file=sys.stderr, flush=True)

    settings = settings | {"plant": settings["plant"] | {"timestep_s": _time_step(settings, step)}}
    options = settings["diagnosis"]
    (pair, attribution), decision, other, the_other_way = decided(
        train=train,
        held_out=held_out,
        neutral=neutral,
        limits=limits,
        robot=robot,
        settings=settings,
        threads=threads,
        options=options,
        progress=progress,
    )
    if pair.exchanged or the_other_way:
        train, held_out = held_out, train
    progress(f"verdict {decision.verdict}")
    otherwise, share, own = None, 0.0, decision
    if other is not None:
        under_other = _decided(*other, options)
        otherwise = _otherwise(other, under_other)
        if not the_other_way:
            costs = _cost((pair, attribution), options), _cost(other, options)
            share = share_of_other(costs, options["calibration"]["none_temperature"])
            decision = averaged(own, under_other, share)
    known = strap_verdicts(pair, _chosen(attribution, decision), attribution.samples[0], settings)
    if traces is not None:
        _write_traces(traces, pair.shown, attribution, decision)
    answer = _answer(pair, attribution, decision, known)
    if share and other is not None:
        theirs = _causes_of(other, under_other)
        likelier = {
            n: share * p > (1 - share) * own.probabilities[n] for n, p in under_other.probabilities.items()
        }
        answer["causes"] = _of_both_holds(
            answer["causes"], theirs, likelier, decision.probabilities, _hold(other[0])
        )
    phantom = pair.train.trial.phantom or pair.held_out.trial.phantom
    used = [
        folder / f"{table}.parquet" for folder in (train, held_out) for table in ("pose", "markers", "robot")
    ]
    write_json(
        out,
        {
            "schema": 1,
            "subject": subject,
            "phantom": phantom,
            "refused_gates": refused_gates(gates or []),
            "train": [train.name],
            "held_out": [held_out.name],
            "shown_on": [train.name if pair.exchanged else held_out.name],
            "fitted_the_other_way": the_other_way,
            "robot_holds": _hold(pair),
            "otherwise": otherwise,
            "pelvis_markers_jumped_s": {
                folder.name: item.jumped_s
                for folder, item in ((train, pair.train), (held_out, pair.held_out))
                if item.jumped_s
            },
        }
        | answer
        | {
            "model": described(_chosen(attribution, decision), pair.train.scales),
            "settings": settings,
            "provenance": provenance(
                [*used, *([limits] if limits else []), robot], _PACKAGES, fingerprint(__name__)
            ),
        },
    )


def _causes_of(found: Found, decision: Decision) -> list[dict[str, Any]]:
    """Causes of a decision, with what each closes of the gap that its own hold leaves."""
    pair, attribution = found
    plain = _paths(pair.shown, attribution.plain)
    return _causes(pair, attribution, decision, plain, float(_floor_draws(pair.shown).mean()))


def _of_both_holds(
    causes: list[dict[str, Any]],
    theirs: list[dict[str, Any]],
    likelier: dict[str, bool],
    probabilities: dict[str, float],
    hold: str,
) -> list[dict[str, Any]]:
    """Causes, each as the hold has it that most of its probability comes from; ``theirs`` say so by ``robot_holds``.

    ``likelier``: whether that is the other one, ``hold``. A tilt of a robot that is let go has other values than the
    one of a robot at rest, in which it hardly shows.
    """
    taken = {
        c["effect"]: c | {"probability": probabilities[c["effect"]], "robot_holds": hold}
        for c in theirs
        if likelier[c["effect"]] and probabilities[c["effect"]] >= TOLD
    }
    kept = [c for c in causes if c["effect"] not in taken]
    return sorted([*kept, *taken.values()], key=lambda c: -c["probability"])


def _floor_draws(shown: Evidence) -> np.ndarray:
    """J (draws,) of noise alone on a trial."""
    assert shown.noise is not None
    noise = shown.noise[:, :, :6]
    return np.asarray(shown.cost.energy(noise.reshape(*noise.shape[:2], 2, 3)))


def _hold(pair: Pair) -> str:
    """Where the robot's controller holds."""
    return BALANCE if pair.train.settled else START_POSE


def _decided(pair: Pair, attribution: Attribution, options: dict) -> Decision:
    """The decision, once the sets that it rests on have converged. Changes those hypotheses in place."""
    converged: set[int] = set()
    while True:
        plain, sets = candidates_of(attribution, options["search"])
        decision = decide(plain, sets, attribution.samples, options["calibration"])
        likeliest = decision.chosen
        if likeliest is None:
            likeliest = int(np.argmax(decision.sets)) if len(sets) else -1
        # what leaves far too much does not become the answer by its last percent
        far = decision.probabilities[UNKNOWN] > CERTAIN
        known = decision.verdict == NONE or far or likeliest in converged | {-1}
        if known or len(converged) == options["search"]["final_refits"]:
            return decision
        converged.add(likeliest)
        hypothesis = attribution.hypotheses[likeliest]
        attribution.hypotheses[likeliest] = finished(pair, hypothesis, options["search"])


def _named(attribution: Attribution, decision: Decision) -> list[str]:
    """Effects of the set that the verdict rests on, or `none` or `unknown`."""
    return list(_chosen(attribution, decision).names) or [decision.verdict]


def _chosen(attribution: Attribution, decision: Decision) -> Hypothesis:
    return attribution.plain if decision.chosen is None else attribution.hypotheses[decision.chosen]


def _write_traces(out: Path, evidence: Evidence, attribution: Attribution, decision: Decision) -> None:
    """Measured and simulated interface markers of the held-out trial [m, world]."""
    best = _chosen(attribution, decision)
    paths = {
        "measured": evidence.trial.interface,
        "plain": _paths(evidence, attribution.plain),
        "with_effect": _paths(evidence, best),
    }
    columns = {"time_s": evidence.trial.time_s}
    for kind, path in paths.items():
        for m, marker in enumerate(INTERFACE_MARKERS):
            columns |= {f"{kind}_{marker}_{c}": path[:, m, i] for i, c in enumerate("xyz")}
    out.parent.mkdir(parents=True, exist_ok=True)
    pq.write_table(pa.table(columns), out, compression="zstd")


def _answer(
    pair: Pair, attribution: Attribution, decision: Decision, known: list[dict[str, Any]]
) -> dict[str, Any]:
    shown = pair.shown
    plain = attribution.plain
    best = attribution.hypotheses[decision.chosen] if decision.chosen is not None else plain
    paths = {key: _paths(shown, h) for key, h in (("plain", plain), ("best", best))}
    assert shown.noise is not None
    noise = shown.noise[:, :, :6]
    draws = _floor_draws(shown)
    floor = float(draws.mean())
    base = float(shown.cost(paths["plain"][None]).total[0])
    ranked = _causes(pair, attribution, decision, paths["plain"], floor)
    stages = _stages(attribution, decision)
    return {
        "noise_floor": {
            "J": floor,
            "ci95": [float(q) for q in np.quantile(draws, [0.025, 0.975])],
            "source": "marker noise of the trials, simulated through the plant",
            "residual_sd_m": _residual_sd(noise),
        },
        "gap": {
            "J_base": base,
            "J_floor": floor,
            "visibility": (base - floor) / floor,
            "J_with_effect": float(shown.cost(paths["best"][None]).total[0]),
            "chi2_plain": list(plain.chi2),
            "chi2_best": list(best.chi2),
            "chi2_expected": list(attribution.samples),
        },
        "where": {
            "stage": max(stages, key=lambda s: stages[s]),
            "stages": stages,
            "axes": _axes(best, axis_shares(shown, paths["plain"], noise)),
        }
        | where(shown, paths["plain"], noise, None if decision.chosen is None else paths["best"]),
        "causes": ranked,
        "considered": _considered(attribution, decision, pair.exchanged),
        "probabilities": decision.probabilities,
        "verdict": decision.verdict,
        "verdict_set": _named(attribution, decision),
        "ambiguity_group": list(decision.group),
        "next_trial": next_trial(decision),
        "baselines": _baselines(attribution) | _independent_noise(pair.train, attribution),
        "parameters": {
            name: _parameter(name, a, b, verdict, decision.chosen is not None)
            for name, a, b, verdict in zip(
                PARAMETERS, np.exp(plain.z[:12]), np.exp(best.z[:12]), known, strict=True
            )
        },
    }


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


def _parameter(name: str, base: float, fitted: float, known: dict[str, Any], named: bool) -> dict[str, Any]:
    """A strap parameter without the effects and with those named; ``fitted`` is what the model was run with."""
    value = known["unbiased"] if named else fitted
    rest = {key: known[key] for key in known if key != "unbiased"}
    return {
        "base": float(base),
        "with_effect": float(value),
        "fitted": float(fitted),
        "unit": unit(name),
    } | rest


def _considered(attribution: Attribution, decision: Decision, exchanged: bool) -> list[dict[str, Any]]:
    """Every set of effects that was refitted, places and all, and what it leaves of chi-squared on both trials.

    J is that of the trial that shows the gap.
    """
    return [
        {
            "effects": list(h.names),
            "places": [placed.key for placed in h.effects],
            "parameters": len(h.z) - 12,
            "chi2": list(h.chi2),
            "J": h.j[0 if exchanged else 1],
            "probability": float(probability),
        }
        for h, probability in zip(attribution.hypotheses, decision.sets, strict=True)
    ]


def _baselines(attribution: Attribution) -> dict[str, str]:
    """What simpler rules would say of the same fits, single effects only."""
    single = [h for h in attribution.hypotheses if len(h.effects) == 1]
    if not single:
        return {}
    plain, n = attribution.plain, attribution.samples[0]

    def least(score: Callable[[Hypothesis], float]) -> str:
        best = min([plain, *single], key=score)
        return best.names[0] if best.names else NONE

    return {
        "training fit": least(lambda h: h.chi2[0]),
        "AIC": least(lambda h: h.chi2[0] + 2 * (len(h.z) - 12)),
        "BIC": least(lambda h: h.chi2[0] + np.log(n) * (len(h.z) - 12)),
        "held out, no gate": least(lambda h: h.chi2[1]),
    }


def _independent_noise(evidence: Evidence, attribution: Attribution) -> dict[str, str]:
    """What rules say that take every sample of J for a measurement of its own, from the training trial."""
    fits = [attribution.plain, *(h for h in attribution.hypotheses if len(h.effects) == 1)]
    j = np.array([h.j[0] for h in fits])
    free = np.array([len(h.z) for h in fits])
    n = 6 * evidence.cost.samples / 2
    scores = {
        "training J": j,
        "AIC, independent noise": n * np.log(j) + 2 * free,
        "BIC, independent noise": n * np.log(j) + np.log(n) * free,
    }
    names = [h.names[0] if h.names else NONE for h in fits]
    return {rule: names[int(np.nanargmin(score))] for rule, score in scores.items()}


def _paths(evidence: Evidence, hypothesis: Hypothesis) -> np.ndarray:
    """Simulated interface markers (n, 2, 3) of a hypothesis."""
    replay = evidence.replay(list(hypothesis.effects), 1)
    return replay.run_effects(np.exp(hypothesis.z[None, :12]), [x[None] for x in hypothesis.split()])[0][0]


def _residual_sd(noise: np.ndarray) -> dict[str, float]:
    """RMS [m] over draws and samples of what noise (draws, n, 6) alone leaves, by interface marker and world axis."""
    rms = np.sqrt(np.mean(noise**2, axis=(0, 1)))
    names = [f"{marker}_{axis}" for marker in INTERFACE_MARKERS for axis in "xyz"]
    return {name: float(value) for name, value in zip(names, rms, strict=True)}


def _axes(best: Hypothesis, measured: dict[str, float]) -> dict[str, float]:
    """Axes of the cause where it has some, weighed by what is measured; what is measured where it has none."""
    named = [axis for placed in best.effects for axis in placed.axes]
    if not named:
        return measured
    weights = {axis: (1.0 if axis in named else 0.0) * (measured[axis] + 0.05) for axis in AXES}
    total = sum(weights.values())
    return {axis: weight / total for axis, weight in weights.items()}


def _causes(
    pair: Pair, attribution: Attribution, decision: Decision, plain: np.ndarray, floor: float
) -> list[dict[str, Any]]:
    """Every effect with some probability: its best set, what it closes, its parameters with intervals.

    ``plain`` (n, 2, 3) [m] is the trial that shows the gap, without effects. What has hardly any probability gets no
    intervals.
    """
    out: list[dict[str, Any]] = []
    seen: set[str] = set()
    best_first = np.argsort(-decision.sets)
    for index in best_first:
        hypothesis = attribution.hypotheses[index]
        for placed, x in zip(hypothesis.effects, hypothesis.split(), strict=True):
            name = placed.effect.name
            told = decision.probabilities[name] >= TOLD
            if name in seen or (not told and len(out) >= 3):
                continue
            seen.add(name)
            entry = {
                "effect": name,
                "probability": decision.probabilities[name],
                "axes": placed.axes,
                "stage": placed.effect.stage,
                "equation": placed.effect.equation,
                "with": [n for n in hypothesis.names if n != name],
                "group": placed.effect.group,
                "parameters": {k: {"value": v, "unit": u} for k, (v, u) in placed.named(x).items()},
            }
            if len(out) < 3:
                path = _paths(pair.held_out, hypothesis)
                entry["J_held_out"] = float(pair.held_out.cost(path[None]).total[0])
                entry |= _closed(
                    pair.shown, plain, _paths(pair.shown, hypothesis) if pair.exchanged else path, floor
                )
            if told and len(out) < 3:
                _add_intervals(pair, hypothesis, placed, entry["parameters"])
            out.append(entry)
    return out


def _closed(evidence: Evidence, plain: np.ndarray, path: np.ndarray, floor: float) -> dict[str, Any]:
    """Share of the closable gap on a trial, with a block-bootstrap interval, of paths (n, 2, 3) [m]."""
    costs = evidence.cost(np.stack([plain, path])).total
    base, j = float(costs[0]), float(costs[1])
    rows = evidence.cost.residuals(np.stack([plain, path]))
    sample = evidence.cost.sample_of_residual()
    saved = np.bincount(sample, weights=rows[0] ** 2 - rows[1] ** 2)
    rate = round(1 / float(evidence.trial.time_s[1] - evidence.trial.time_s[0]))
    low, high = block_bootstrap_mean(saved * len(saved), rate, 500, 0.95, 1)
    gap = base - floor
    if gap < SMALLEST_GAP * floor:
        # J cannot see the gap, though the whitened residuals may: a share of nothing is no number
        return {"gap_closed": None, "gap_closed_ci95": None}
    return {"gap_closed": (base - j) / gap, "gap_closed_ci95": [low / gap, high / gap]}


def _covariance(pair: Pair, hypothesis: Hypothesis) -> np.ndarray:
    """Covariance (12 + p, 12 + p) of ln-parameters and searched numbers, from the curvature at the joint optimum."""
    problem = JointResiduals(pair.train, hypothesis.effects, pair.bounds)
    _, jacobian = problem.with_jacobian(hypothesis.z, np.arange(len(hypothesis.z)))
    normal = jacobian.T @ jacobian
    elsewhere = JointResiduals(pair.held_out, hypothesis.effects, pair.bounds)
    if len(elsewhere.free):
        _, own = elsewhere.with_jacobian(hypothesis.z, elsewhere.free)
        normal[np.ix_(elsewhere.free, elsewhere.free)] += own.T @ own
    normal[np.diag_indices_from(normal)] += 1e-9
    return np.asarray(np.linalg.inv(normal))


def strap_verdicts(pair: Pair, hypothesis: Hypothesis, samples: int, settings: dict) -> list[dict[str, Any]]:
    """``unbiased``, ``ci95``, ``bias_ln`` and ``verdict`` of each strap parameter of a fit, as in the identification.

    ``unbiased`` is the fitted value, without its bias by noise of the pelvis (``bias_ln``) where that is more than its
    SD and the rest is known. The interval, cut at the search's bounds, is about the point without the bias. What the
    fit leaves beyond noise (chi-squared over ``samples``) widens it. ``settings`` are the
    slices ``diagnosis`` and ``identifiability``.
    """
    options, limits = settings["diagnosis"]["search"], settings["identifiability"]
    point, covariance = corrected(
        pair,
        hypothesis,
        draws=options["corrected_draws"],
        iterations=options["corrected_iterations"],
        seed=options["seed"],
    )
    excess = max(hypothesis.chi2[0] / samples, 1.0)
    sd = np.hypot(np.sqrt(np.diag(covariance)[:12] * excess), PLANT_SD_LN)
    bias = hypothesis.z[:12] - point[:12]
    lower, upper = np.log(pair.bounds.lower), np.log(pair.bounds.upper)
    near = limits["at_bound_ln"]
    out = []
    for value, s, b, low, high in zip(hypothesis.z[:12], sd, bias, lower, upper, strict=True):
        if s > limits["weak_sd_ln"]:
            verdict = NOT_DETERMINED
        elif value - low < near or high - value < near:
            verdict = AT_BOUND
        else:
            verdict = WEAK if max(s, abs(b)) > limits["determined_sd_ln"] else DETERMINED
        ends = np.clip([value - b - 1.96 * s, value - b + 1.96 * s], low, high)
        told = abs(b) > s and s < limits["weak_sd_ln"]
        unbiased = np.clip(value - b, low, high) if told else value
        out.append(
            {
                "unbiased": float(np.exp(unbiased)),
                "ci95": [float(x) for x in np.exp(ends)],
                "bias_ln": float(b),
                "verdict": verdict,
            }
        )
    return out


def _add_intervals(pair: Pair, hypothesis: Hypothesis, placed: Any, named: dict[str, dict[str, Any]]) -> None:
    """95 % intervals of an effect's parameters from the curvature at the joint optimum, cut at the search's bounds."""
    covariance = _covariance(pair, hypothesis)
    first = 12
    for other in hypothesis.effects:
        if other is placed:
            break
        first += len(other.effect.parameters)
    own = slice(first, first + len(placed.effect.parameters))
    sd = np.sqrt(np.diag(covariance)[own])
    x = hypothesis.z[own]
    lower, upper = placed.bounds()
    low = placed.values(np.clip(x - 1.96 * sd, lower, upper)[None])[0]
    high = placed.values(np.clip(x + 1.96 * sd, lower, upper)[None])[0]
    for entry, a, b in zip(named.values(), low, high, strict=True):
        entry["ci95"] = [float(min(a, b)), float(max(a, b))]
