"""Which people and files the phantom will write. Light imports: the Snakefile calls this when parsed."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from real2sim.configuration import read_yaml, validated
from real2sim.errors import InputError
from real2sim.recording.subjects import Subject, TrialFiles
from real2sim.verification.phantom.levels import tightness_levels
from real2sim.verification.suite.plan import EFFECTS


def read_settings(source: Path) -> dict[str, Any]:
    """Return the checked settings of a phantom: config/phantom.yaml, or a file that ``extends`` another one.

    A file with the key ``extends``, a path from its own folder, says only what is different. Raises InputError.
    """
    own = read_yaml(source)
    if isinstance(own, dict) and "extends" in own:
        base = read_yaml(source.parent / str(own.pop("extends")))
        if not isinstance(base, dict) or "extends" in base:
            raise InputError(
                source,
                "extends",
                "a file that extends another one, or holds no settings",
                "a file with all settings, as config/phantom.yaml",
                "Name that file.",
            )
        own = _merged(base, own)
    settings = validated(own, "phantom", source)
    if settings["gap"]["enabled"]:
        _check_gap(settings, source)
    return settings


def _check_gap(settings: dict[str, Any], source: Path) -> None:
    """Raise InputError where a gap is asked for that cannot be made."""
    unknown = [name for name in settings["gap"]["prior"] if name not in EFFECTS]
    if unknown:
        raise InputError(
            source,
            "gap.prior",
            ", ".join(unknown),
            f"effects of the catalogue: {', '.join(EFFECTS)}",
            "Correct the name.",
        )
    if settings["trials"]["dynamic_trials"] < 2:
        raise InputError(
            source,
            "trials.dynamic_trials",
            f"{settings['trials']['dynamic_trials']} with gap.enabled: true",
            "two, one that is fitted and one that is predicted",
            "Plan two, or set gap.enabled: false.",
        )


def _merged(base: dict[str, Any], own: dict[str, Any]) -> dict[str, Any]:
    """Return settings in which those of ``own`` stand before those of ``base``, group by group."""
    out = dict(base)
    for key, value in own.items():
        both = isinstance(value, dict) and isinstance(base.get(key), dict)
        out[key] = _merged(base[key], value) if both else value
    return out


def trial_names(settings: dict[str, Any], subject: str) -> list[str]:
    """Trials of one person, in the order in which they are recorded."""
    levels, counts = tightness_levels(settings["cohort"][subject]), settings["trials"]
    sweep = [f"{kind}_T{level:02d}" for level in levels for kind in ("rotation", "translation")]
    numbered = [
        f"{kind}_{i + 1}"
        for kind in ("dynamic", "walk_normal", "walk_robot")
        for i in range(counts[f"{kind}_trials"])
    ]
    return ["neutral", *sweep, *numbered]


def has_log(trial: str) -> bool:
    """Return whether the robot takes part in a trial."""
    return not trial.startswith("walk_normal")


def planned_files(settings: dict[str, Any], root: Path, subject: str) -> list[Path]:
    """Every file that `write.write_subject` writes for one person, below ``root``."""
    folder = root / subject
    files = [folder / "subject.yaml"]
    for trial in trial_names(settings, subject):
        suffixes = (".tsv", ".mot", ".mcap") if has_log(trial) else (".tsv", ".mot")
        files += [folder / f"{trial}{suffix}" for suffix in suffixes]
    return files


def planned_subjects(config: dict[str, Any], root: Path) -> dict[str, Subject]:
    """People of the phantom as `real2sim.recording.subjects.discover` will find them below ``root``.

    ``config`` is config/phantom.yaml. The files need not exist yet.
    """
    return {name: _subject(config, root / name, name) for name in config["cohort"]}


def _subject(settings: dict[str, Any], folder: Path, name: str) -> Subject:
    person = settings["cohort"][name]
    trials = {
        trial: TrialFiles(
            markers=folder / f"{trial}.tsv",
            markerless=folder / f"{trial}.mot",
            log=folder / f"{trial}.mcap" if has_log(trial) else None,
        )
        for trial in trial_names(settings, name)
    }
    return Subject(
        id=name,
        cohort=person["cohort"],
        sex=person["sex"],
        age_years=person["age_years"],
        mass_kg=person["mass_kg"],
        height_m=person["height_m"],
        waist_m=person["waist_m"],
        tightness=dict(person["tightness"]),
        markers={},
        exclude={},
        trials=trials,
        folder=folder,
        phantom=True,
    )
