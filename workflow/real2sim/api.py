"""The public calls: identify a described system from a recording, and diagnose the gap of its simulation.

system = System.from_yaml("exo.yaml")
slow, fast, still = (Recording.read(system, p) for p in ("slow.csv", "fast.csv", "still.csv"))
fit = identify(system, slow, quiet=still)
answer = diagnose(system, train=slow, held_out=fast, quiet=still)
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import numpy as np
import pandas as pd

from real2sim.artefacts import write_json
from real2sim.configuration import validated
from real2sim.diagnosis.answer import Diagnosis as Answer
from real2sim.diagnosis.answer import answer
from real2sim.diagnosis.attribute import candidates, check_simulated, plain_fit
from real2sim.diagnosis.described_trial import DescribedTrial
from real2sim.diagnosis.evidence import Evidence
from real2sim.diagnosis.intervals import Known, parameter_verdicts, precision_by_fit
from real2sim.diagnosis.machines import beside_configured, search_with
from real2sim.diagnosis.refit import Hypothesis
from real2sim.diagnosis.search import Pair, Search
from real2sim.diagnosis.step_check import fine_enough, step_findings
from real2sim.diagnosis.system_evidence import SystemEvidence
from real2sim.diagnosis.trials import Trials
from real2sim.effects.base import Effect, Placed
from real2sim.effects.catalogue import EFFECTS
from real2sim.effects.system_replay import supports
from real2sim.errors import InputError
from real2sim.recording.channels import channel_findings, drive_scales, units_in_doubt
from real2sim.recording.formats.recordings import Finding
from real2sim.recording.table import Recording, check_columns
from real2sim.system.described_plant import load_model, own_actuators
from real2sim.system.description import System

if TYPE_CHECKING:
    from real2sim.settings import Settings

_SLICES = ("diagnosis", "identifiability")


@dataclass(frozen=True)
class Fit:
    """Parameters of a system that fit one recording.

    ``known`` maps each parameter's name to its value, interval, bias and verdict; ``chi2`` is what the fit leaves and
    ``samples`` what noise alone would leave. ``findings`` lists what was odd in recording and model
    (docs/quality-codes.md).
    """

    system: System
    recording: str
    values: Mapping[str, float]
    known: Mapping[str, Known]
    chi2: float
    samples: int
    traces: Mapping[str, np.ndarray]
    findings: tuple[Finding, ...] = ()

    @property
    def verdicts(self) -> dict[str, str]:
        """Verdict on each parameter: determined, weak, not determined or at bound."""
        return {name: known.verdict for name, known in self.known.items()}

    def __str__(self) -> str:
        """Return what was fitted as plain text."""
        from real2sim.pages.answer_text import parameter_lines

        units = {p.name: p.unit for p in self.system.parameters}
        rows = {
            name: {"value": self.values[name], "unit": units[name], "ci95": k.ci95, "verdict": k.verdict}
            for name, k in self.known.items()
        }
        left = f"left: {self.chi2 / self.samples:.3g} times what noise alone leaves"
        return "\n".join([f"{self.system.name}, fitted to {self.recording}, {left}", *parameter_lines(rows)])

    def table(self) -> pd.DataFrame:
        """Return one row per parameter: value, unit, 95 % interval, verdict."""
        rows = [
            {
                "parameter": p.name,
                "value": self.values[p.name],
                "unit": p.unit,
                "low": self.known[p.name].ci95[0],
                "high": self.known[p.name].ci95[1],
                "verdict": self.known[p.name].verdict,
            }
            for p in self.system.parameters
        ]
        return pd.DataFrame(rows)

    def save(self, path: Path | str) -> None:
        """Write the fit as JSON."""
        rows = {
            name: {"value": self.values[name], "ci95": list(k.ci95), "verdict": k.verdict}
            for name, k in self.known.items()
        }
        write_json(
            Path(path),
            {
                "schema": 1,
                "system": self.system.name,
                "recording": self.recording,
                "parameters": rows,
                "chi2": self.chi2,
                "chi2_expected": self.samples,
                "findings": [asdict(f) for f in self.findings],
            },
        )

    def plot(self, path: Path | str | None = None) -> Any:
        """Draw measured and simulated observations over time; return the figure, written where ``path`` is given."""
        from real2sim.pages.traces import plot_traces

        return plot_traces(self.traces, f"{self.system.name}, {self.recording}", path)


@dataclass(frozen=True)
class Diagnosis:
    """Answer: where the gap of a system's simulation lies, which effect causes it, how far it shrinks.

    ``answer`` holds what stands in diagnosis.json: ``answer.causes``, ``answer.gap``, ``answer.parameters``,
    ``answer.next_trial`` and so on; the commonest are attributes here too. ``findings`` lists what was odd in
    recordings and model (docs/quality-codes.md).
    """

    system: System
    answer: Answer
    findings: tuple[Finding, ...] = ()

    @property
    def verdict(self) -> str:
        """Name of an effect, ``none`` or ``unknown``."""
        return self.answer.verdict

    @property
    def probabilities(self) -> dict[str, float]:
        """Probability of every effect, of ``none`` and of ``unknown``."""
        return self.answer.probabilities

    @property
    def where(self) -> dict[str, Any]:
        """Place of the gap: stage, axes, channels, time, frequency, regime."""
        return self.answer.where

    def __str__(self) -> str:
        """Return the answer as plain text: verdict, what is left, causes with numbers, what to record next."""
        from real2sim.pages.answer_text import answer_text

        return answer_text(self.system.name, self._content(), self._recordings)

    @property
    def _recordings(self) -> tuple[str, str]:
        """Names of the recording that effects were fitted to, and of the held-out one."""
        pair = self.answer.found.pair
        return pair.train.name, pair.held_out.name

    def _content(self) -> dict[str, Any]:
        return self.answer.to_dict() | {"findings": [asdict(f) for f in self.findings]}

    def table(self) -> pd.DataFrame:
        """Return one row per cause with some probability: effect, axes, probability, share of the gap closed.

        ``together_with`` are the effects that it was fitted beside: the share is that of all of them. Parameters have
        columns of their own, with the ends of their 95 % intervals (``_low``, ``_high``) where they were computed.
        """
        return pd.DataFrame(
            [
                {
                    "effect": c.effect,
                    "axes": " ".join(c.axes),
                    "probability": c.probability,
                    "together_with": " ".join(c.beside),
                    "gap_closed": c.gap_closed,
                    **_values(c.parameters),
                }
                for c in self.answer.causes
            ]
        )

    def save(self, path: Path | str) -> None:
        """Write diagnosis.json."""
        about = {"schema": 1, "subject": self.system.name}
        about |= dict(zip(("train", "held_out"), self._recordings, strict=True))
        write_json(Path(path), about | self._content())

    def plot(self, path: Path | str | None = None) -> Any:
        """Draw observations measured, plain and with the effect; return the figure, written where ``path`` is given."""
        from real2sim.pages.traces import plot_traces

        title = f"{self.system.name}: {', '.join(self.answer.verdict_set)}"
        return plot_traces(self.answer.traces(), title, path)

    @property
    def free_form(self) -> dict[str, Any] | None:
        """The measured law where no name fits, as in diagnosis.json."""
        return self.answer.beyond.free_form

    def plot_law(self, path: Path | str | None = None) -> Any:
        """Draw the curve of the measured law with its band; return the figure, written where ``path`` is given.

        Raises
        ------
        ValueError
            Where no law was measured, or one that is no function of one variable.
        """
        from real2sim.pages.law import law_figure
        from real2sim.pages.page import page_style

        curve = None if self.free_form is None else self.free_form["curve"]
        if curve is None:
            raise ValueError(
                f"{self.system.name}: no measured law of one variable; see free_form of the answer"
            )
        with page_style():
            figure = law_figure(curve, phantom=False)
            if path is not None:
                figure.savefig(path, dpi=200)
        return figure

    def export_model(self, path: Path | str) -> None:
        """Write the diagnosed model of the fitted recording as an MJCF, parameters and effects in it.

        Raises
        ------
        ValueError
            Where a field of the model has no element of MJCF to be written to.
        """
        from real2sim.pages.described_model import write_model

        write_model(Path(path), self.answer)


def _values(parameters: Mapping[str, Mapping[str, Any]]) -> dict[str, float]:
    """Values of an effect's parameters by name, each followed by the ends of its interval where it has one."""
    out: dict[str, float] = {}
    for name, entry in parameters.items():
        out[name] = entry["value"]
        if "ci95" in entry:
            out[f"{name}_low"], out[f"{name}_high"] = entry["ci95"]
    return out


def identify(
    system: System,
    recording: Recording,
    quiet: Recording | None = None,
    settings: Mapping[str, Any] | None = None,
    *,
    threads: int = 1,
) -> Fit:
    """Fit the parameters of a system to one recording.

    Parameters
    ----------
    quiet
        A recording of standing still: noise and, where ``interface.rest`` is quiet, the rest pose are measured in it.
    settings
        Overrides of the configuration's slices ``diagnosis`` and ``identifiability``.

    Raises
    ------
    InputError
        Where recording and description do not fit together, the simulation of the plain fit fails, or ``settings`` has
        other slices.
    """
    options = _settings(settings)
    search = options["diagnosis"]["search"]
    odd = [
        *(f for r in (recording, quiet) if r is not None for f in r.findings),
        *_odd_models([system]),
        *_odd_channels(system, {recording.name: recording}, options),
    ]
    described, (pair, z) = system, _whitened(system, recording, quiet, options, threads)
    system = fine_enough(pair, z, options["diagnosis"])
    if system != described:
        pair, z = _whitened(system, recording, quiet, options, threads)
    evidence = pair.train
    fitted = Search(pair, search).fit((), z, final=True)
    check_simulated(pair, fitted)
    precision = precision_by_fit(pair, fitted, evidence.samples, options["diagnosis"])
    known = parameter_verdicts(pair, fitted, precision.wider, options)
    values = dict(zip(system.parameter_names, map(float, system.values(fitted.base)), strict=True))
    channels = options["diagnosis"]["described"]["channels"]
    steps = step_findings(pair, fitted.base, described, options["diagnosis"])
    return Fit(
        system,
        recording.name,
        values,
        dict(zip(system.parameter_names, known, strict=True)),
        fitted.chi2[0],
        evidence.samples,
        _traces(evidence, pair, fitted),
        (*odd, *units_in_doubt(system, values, recording.name, channels["bound_share"]), *steps),
    )


def _whitened(
    system: System, recording: Recording, quiet: Recording | None, options: Settings, threads: int
) -> tuple[Pair, np.ndarray]:
    """Return a recording as both trials of a pair, whitened by noise simulated at its plain fit (p,), and that fit."""
    search, draws = options["diagnosis"]["search"], options["diagnosis"]["noise_draws"]
    evidence = _evidence(system, recording, quiet, options, threads)
    lower, upper = system.bounds()
    z = plain_fit(evidence, system, (lower + upper) / 2, search)
    evidence = evidence.adapted(system.values(z)).with_noise(system.values(z), draws, search["seed"])
    return Pair(evidence, evidence.as_held_out(), system), z


def _traces(evidence: Evidence, pair: Pair, fitted: Hypothesis) -> dict[str, np.ndarray]:
    from real2sim.diagnosis.answer import simulate

    path = simulate(evidence, pair, fitted)
    columns = evidence.traces(path, path)
    return {k: v for k, v in columns.items() if not k.startswith("with_effect")}


def diagnose(
    system: System,
    *,
    train: Recording,
    held_out: Recording,
    quiet: Recording | None = None,
    further: Sequence[Recording] = (),
    others: Mapping[str, System] | None = None,
    settings: Mapping[str, Any] | None = None,
    progress: Callable[[str], None] | None = None,
    threads: int = 1,
) -> Diagnosis:
    """Find which unmodelled effect causes the gap between a system's simulation and its recordings.

    Effects are fitted to ``train`` and judged on ``held_out``, a recording of another regime, and on ``further`` ones,
    such as the trial that an answer proposed; ``quiet`` and ``settings`` as of `identify`. ``others`` are other models
    of the machine, by a name of yours, which read the same columns: evidence tells which of all was recorded, and the
    answer is that with the likeliest. ``progress`` is called with a line now and then, by default it goes to stderr.
    ``threads`` simulate and try effects side by side; the answer is the same with any number of them.

    Raises
    ------
    InputError
        Where recordings and description do not fit together, the simulation of the plain fit fails, another model has
        the name ``configured``, or ``settings`` has other slices.
    """
    options, given = _settings(settings), (train, held_out, *further)
    recordings = _by_name(given)
    tell = progress or (lambda text: print(f"{system.name}: {text}", file=sys.stderr, flush=True))
    systems = beside_configured(system, others or {}, "others")
    findings = [f for r in (*given, quiet) if r is not None for f in r.findings]
    findings += [*_odd_models(systems.values()), *_odd_channels(system, recordings, options)]
    _tell_findings(findings, tell)
    trials_of = partial(
        _trials,
        recordings=recordings,
        quiet=quiet,
        options=options,
        tell=tell,
        pair=(train.name, held_out.name),
        further=tuple(r.name for r in further),
        threads=threads,
    )
    outcome, machines = search_with({name: _finely(each, trials_of) for name, each in systems.items()})
    if machines:
        system = systems[machines[0].name]
    found, channels = outcome.found, options["diagnosis"]["described"]["channels"]
    plain = found.attribution.plain.base
    values = dict(zip(system.parameter_names, system.values(plain), strict=True))
    doubts = list(units_in_doubt(system, values, train.name, channels["bound_share"]))
    doubts += step_findings(found.pair, plain, system, options["diagnosis"])
    _tell_findings(doubts, tell)
    return Diagnosis(
        found.pair.system, answer(outcome, options, tell, machines=machines), (*findings, *doubts)
    )


def _by_name(given: Sequence[Recording]) -> dict[str, Recording]:
    """Return recordings by name; refuses a name that two of them have."""
    names = [r.name for r in given]
    for name in names:
        if names.count(name) > 1:
            raise InputError(
                name, "", "the same name for two recordings", "a name for each", "Rename one of them."
            )
    return dict(zip(names, given, strict=True))


def _finely(system: System, trials_of: Callable[[System], Trials]) -> Trials:
    """Return the trials of a system with the time step that its recordings ask for (`fine_enough`)."""
    trials = trials_of(system)
    pair, z = trials.prepare()
    fine = fine_enough(pair, z, trials.options)
    if fine != system:
        trials.progress(f"the time step is halved to {fine.step_s:.4g} s: its error would look like a cause")
        return trials_of(fine)
    return replace(trials, prepared=(pair, z))


def _trials(
    system: System,
    recordings: Mapping[str, Recording],
    quiet: Recording | None,
    options: Settings,
    tell: Callable[[str], None],
    pair: tuple[str, str],
    further: tuple[str, ...],
    threads: int,
) -> Trials:
    """Return the fitted, the held-out and further recordings, by name, of one system."""
    loaded = {n: _evidence(system, r, quiet, options, threads) for n, r in recordings.items()}

    def load(name: str, settled: bool) -> Evidence:
        return loaded[name].as_settled() if settled else loaded[name]

    def places(pair: Pair) -> list[Placed]:
        return [p for p in candidates(system, pair.train.scales) if supports(p)]

    return Trials(*pair, system, load, options["diagnosis"], tell, places, further)


def _tell_findings(findings: Sequence[Finding], tell: Callable[[str], None]) -> None:
    for finding in findings:
        tell(f"{finding.severity}: {finding.file}, {finding.place}: {finding.message}. {finding.action}")


def _odd_models(systems: Iterable[System]) -> Iterator[Finding]:
    """Yield what is odd about the models of systems."""
    for system in systems:
        yield from _own_actuators(system)
        yield from _free_joints(system)


def _own_actuators(system: System) -> Iterator[Finding]:
    """Yield that the model of a system has actuators of its own, where it has."""
    if own := own_actuators(system):
        message, action = "the model has actuators of its own", "Left out: the recording drives the joints."
        yield Finding(
            "model_actuators", "info", system.model.name, f"actuator {', '.join(own)}", message, action
        )


def _free_joints(system: System) -> Iterator[Finding]:
    """Yield that joints of the model move freely, without a word in the description, where some do."""
    named = {*system.machine_joints, *system.axis_joints, *system.drive.columns}
    if free := [
        j.name or f"number {i + 1}" for i, j in enumerate(load_model(system).joints) if j.name not in named
    ]:
        yield Finding(
            "model_joints",
            "warning",
            system.model.name,
            f"joint {', '.join(free)}",
            "neither driven, nor of the machine or the interface: it moves freely",
            "Used as it is. Name it under drive.of or machine, or leave it out of the model.",
        )


def _odd_channels(
    system: System, recordings: Mapping[str, Recording], options: Settings
) -> Iterator[Finding]:
    """Yield what is odd about the columns of recordings, alone and beside each other."""
    for recording in recordings.values():
        check_columns(system, recording)
    settings = options["diagnosis"]["described"]["channels"]
    driven = set(system.drive.columns.values())
    for name, r in recordings.items():
        measured = {c: v for c, v in r.columns.items() if c not in driven}
        yield from channel_findings(system, name, r.rate_hz, measured, settings)
    columns = {name: (r.rate_hz, r.columns) for name, r in recordings.items()}
    yield from drive_scales(system, columns, settings["most_scale"])


def catalogue(system: System | None = None) -> tuple[Effect, ...]:
    """Return the effects that a diagnosis knows, those of other packages among them; of a system, those that fit it."""
    return tuple(effect for effect in EFFECTS if system is None or effect.fits(system))


def _evidence(
    system: System, recording: Recording, quiet: Recording | None, options: Settings, threads: int
) -> SystemEvidence:
    return DescribedTrial(system, recording, quiet, options["diagnosis"]["described"], threads).evidence()


def _settings(given: Mapping[str, Any] | None) -> Settings:
    if others := sorted(str(name) for name in given or () if name not in _SLICES):
        raise InputError(
            "settings",
            "top level",
            f"key {', '.join(map(repr, others))}",
            f"the slices {' and '.join(_SLICES)}, which are all that a described system reads",
            "Remove the others, or give them to the workflow (--configfile).",
            "key_unknown",
        )
    checked = validated(dict(given or {}), "config", Path("settings"))
    return cast("Settings", {name: checked[name] for name in _SLICES})
