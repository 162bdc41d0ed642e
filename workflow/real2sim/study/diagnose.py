"""Diagnosis of one person in the strap: canonical tables of three trials in, diagnosis.json out."""

from __future__ import annotations

import math
import sys
from collections.abc import Callable, Mapping, Sequence
from functools import cache, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pyarrow as pa
import pyarrow.parquet as pq

from real2sim.artefacts import read_json, write_json
from real2sim.diagnosis.answer import Diagnosis, answer
from real2sim.diagnosis.evidence import CONFIGURED
from real2sim.diagnosis.machines import beside_configured, search_with
from real2sim.diagnosis.trials import Trials
from real2sim.provenance import Provenance, fingerprint, provenance
from real2sim.recording.noise import NoiseModel
from real2sim.recording.quality.verdict import refused_gates
from real2sim.study.strap import strap_system
from real2sim.study.strap_evidence import StrapEvidence
from real2sim.study.strap_imagined import imagined_trials
from real2sim.study.strap_recording import load_evidence

if TYPE_CHECKING:
    from real2sim.settings import Settings

_PACKAGES = ["mujoco", "numpy", "scipy"]


def time_step(settings: Settings, step: Path | None) -> float:
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


def strap_trials(
    *,
    train: Path,
    held_out: Path,
    neutral: Path,
    limits: Path | None,
    robot: Path,
    settings: Settings,
    progress: Callable[[str], None],
    further: Sequence[Path] = (),
    threads: int = 1,
) -> Trials:
    """Return two trials of one person and further ones, by the names of their folders of canonical tables.

    ``settings`` as of `diagnose`, with a number for ``plant.timestep_s``; ``threads``: see `PlantSetup`.
    """
    folders = {folder.name: folder for folder in (train, held_out, *further)}

    @cache
    def noise() -> NoiseModel:
        return NoiseModel.measure(neutral, settings["ingest"], settings["diagnosis"]["noise"])

    def load(trial: str, settled: bool) -> StrapEvidence:
        return load_evidence(
            folder=folders[trial],
            neutral=neutral,
            limits=limits,
            robot=robot,
            settings=settings,
            noise=noise(),
            settled=settled,
            threads=threads,
        )

    system = strap_system(robot, settings)
    more = tuple(folder.name for folder in further)
    return Trials(train.name, held_out.name, system, load, settings["diagnosis"], progress, further=more)


def _print(subject: str, text: str) -> None:
    print(f"{subject}: {text}", file=sys.stderr, flush=True)


def diagnose(
    *,
    subject: str,
    train: Path,
    held_out: Path,
    neutral: Path,
    robot: Path,
    settings: Settings,
    out: Path,
    further: list[Path] | None = None,
    limits: Path | None = None,
    step: Path | None = None,
    gates: list[Path] | None = None,
    traces: Path | None = None,
    robots: dict[str, Any] | None = None,
    threads: int = 1,
) -> None:
    """Find where the gap lies, which effect causes it and how far it shrinks; write diagnosis.json.

    Parameters
    ----------
    train, held_out, neutral
        Folders of canonical tables of three trials: results/trials/<SUBJECT>/<TRIAL>.
    settings
        Configuration slices ``identification``, ``identifiability``, ``plant``, ``robot``, ``ingest``, ``diagnosis``.
    further
        Folders of more dynamic trials, which fits to the first two have to predict: the one that an answer proposed.
    limits, step
        Joint limits and step study of the person, where they exist.
    gates
        Verdicts on the trials (results/quality/<SUBJECT>/<TRIAL>.json). What they refuse is named in the answer.
    traces
        Table (Parquet) of the trial that shows the gap: time, and markers by axis measured, plain and with effect.
    robots
        Others that may have held the strap, by name: ``model``, an MJCF, and ``robot``, a slice of the configuration.
    threads
        That simulate. The answer is the same bits with any number.
    """
    progress = partial(_print, subject)
    settings = settings | {"plant": settings["plant"] | {"timestep_s": time_step(settings, step)}}
    with_robot = partial(
        strap_trials,
        train=train,
        held_out=held_out,
        neutral=neutral,
        limits=limits,
        further=further or (),
        threads=threads,
        progress=progress,
    )
    models, of_robot = _by_robot(robot, robots or {}, settings)
    trials = {name: with_robot(robot=models[name], settings=of_robot[name]) for name in models}
    result, the_other_way = _answered(trials, of_robot, progress)
    _write_traces(traces, result)
    about = _about(subject, train, held_out, result, the_other_way=the_other_way)
    about |= {"further": [f.name for f in further or []], "refused_gates": refused_gates(gates or [])}
    told = result.to_dict() | _about_robot(result, models, of_robot)
    others = [path for path in (limits, step, *(gates or []), *models.values()) if path is not None]
    sources = _sources([train, held_out, *(further or [])], neutral, others)
    write_json(out, about | told | {"provenance": sources})


def _answered(
    trials: Mapping[str, Trials], of_robot: Mapping[str, Settings], progress: Callable[[str], None]
) -> tuple[Diagnosis, bool]:
    """Return the answer with the likeliest of some robots, by name, and `Outcome.the_other_way` of its search."""
    outcome, machines = search_with(trials)
    settings = of_robot[machines[0].name if machines else CONFIGURED]
    return answer(outcome, settings, progress, imagined_trials, machines), outcome.the_other_way


def _about_robot(
    result: Diagnosis, models: Mapping[str, Path], of_robot: Mapping[str, Settings]
) -> dict[str, Any]:
    """Return the entries ``machine``, with the file of the likeliest robot, and ``settings`` of diagnosis.json."""
    told = result.beyond.machine
    if told is None:
        return {"settings": of_robot[CONFIGURED]}
    name = told["name"]
    model = None if name == CONFIGURED else str(models[name])
    return {"machine": told | {"model": model}, "settings": of_robot[name]}


def _by_robot(
    robot: Path, robots: Mapping[str, Any], settings: Settings
) -> tuple[dict[str, Path], dict[str, Settings]]:
    """Return the MJCF of each robot by name, and the settings of a diagnosis with it; the configured one first."""
    models = beside_configured(
        robot, {n: Path(other["model"]) for n, other in robots.items()}, "diagnosis.robots"
    )
    changed: dict[str, Settings] = {n: settings | {"robot": other["robot"]} for n, other in robots.items()}
    return models, {CONFIGURED: settings, **changed}


def _sources(trials: Sequence[Path], neutral: Path, others: Sequence[Path]) -> Provenance:
    """Return the files that an answer was made from, and by which code.

    ``trials`` and ``neutral`` are folders of canonical tables; quality.json of the dynamic ones tells how exactly the
    robot log is synchronised.
    """
    tables = [f / f"{table}.parquet" for f in (*trials, neutral) for table in ("pose", "markers", "robot")]
    quality = [folder / "quality.json" for folder in trials]
    return provenance([*tables, *quality, *others], _PACKAGES, fingerprint(__name__))


def _write_traces(path: Path | None, result: Diagnosis) -> None:
    if path is None:
        return
    path.parent.mkdir(parents=True, exist_ok=True)
    pq.write_table(pa.table(result.traces()), path, compression="zstd")


def _about(
    subject: str, train: Path, held_out: Path, result: Diagnosis, *, the_other_way: bool
) -> dict[str, Any]:
    """Return the entries of diagnosis.json about the recordings."""
    pair = result.found.pair
    if pair.exchanged or the_other_way:
        train, held_out = held_out, train
    by_folder = ((train, pair.train), (held_out, pair.held_out))
    recorded = {folder.name: e.recorded for folder, e in by_folder if isinstance(e, StrapEvidence)}
    return {
        "schema": 1,
        "subject": subject,
        "phantom": any(r.trial.phantom for r in recorded.values()),
        "train": [train.name],
        "held_out": [held_out.name],
        "shown_on": [train.name if pair.exchanged else held_out.name],
        "fitted_the_other_way": the_other_way,
        "pelvis_markers_jumped_s": {name: dict(r.jumped_s) for name, r in recorded.items() if r.jumped_s},
        "limits_crossed": {name: list(r.crossed) for name, r in recorded.items() if r.crossed},
    }
