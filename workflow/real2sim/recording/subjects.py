"""The people of a study and their trials, as they lie in folders: ``<root>/<SUBJECT>/<TRIAL>.<kind>``.

Light imports only: the workflow calls this every time it is parsed.
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from real2sim.configuration import read_yaml, validated
from real2sim.errors import InputError

TRIAL_GRAMMAR = (
    "neutral, rotation_T<LEVEL>, translation_T<LEVEL> (LEVEL: two digits, cm), "
    "dynamic_<N>, walk_normal_<N> or walk_robot_<N> (N: 1, 2, ...)"
)
MARKER_SUFFIXES = (".tsv", ".c3d", ".mat")
MARKERLESS_SUFFIXES = (".mot", ".sto", ".trc")
LOG_SUFFIXES = (".mcap",)
SUBJECT_FILE = "subject.yaml"
# Stands in the head of each marker and markerless export that the phantom writes, wherever it is copied to
SYNTHETIC_NOTICE = "PHANTOM: synthetic data of the phantom cohort, no real person"
_HEAD_BYTES = 1024
_KINDS = {
    "marker export": MARKER_SUFFIXES,
    "markerless export": MARKERLESS_SUFFIXES,
    "robot log": LOG_SUFFIXES,
}
_KIND_OF = {suffix: kind for kind, suffixes in _KINDS.items() for suffix in suffixes}
_TRIAL = re.compile(
    r"(?P<neutral>neutral)"
    r"|(?P<swept>rotation|translation)_T(?P<level>\d\d)"
    r"|(?P<counted>dynamic|walk_normal|walk_robot)_(?P<number>[1-9]\d*)"
)
_SUBJECT_ID = re.compile(r"[A-Za-z0-9]+")
_FILE, _FOLDER = "a file", "a folder"
_SYSTEM_FILES = (
    "thumbs.db",
    "ehthumbs.db",
    "desktop.ini",
)  # what Windows puts into folders of its own accord
_NOT_TRIALS = ("README.md", "README.txt")  # may lie beside the subjects and in their folders


@dataclass(frozen=True)
class TrialFiles:
    """Raw files of one trial; a robot log is optional."""

    markers: Path
    markerless: Path
    log: Path | None = None


@dataclass(frozen=True)
class Subject:
    """One person: what `subject.yaml` says, and the trials that are not excluded.

    ``tightness`` has the keys loosest_cm, tightest_cm, safe_comfortable_cm; ``markers`` maps the lab's marker
    names to ours; ``exclude`` maps a trial that is left out to the reason.
    """

    id: str
    cohort: str
    sex: str
    age_years: float
    mass_kg: float
    height_m: float
    waist_m: float
    tightness: dict[str, int]
    markers: dict[str, str] = field(default_factory=dict)
    exclude: dict[str, str] = field(default_factory=dict)
    trials: dict[str, TrialFiles] = field(default_factory=dict)
    folder: Path = Path()
    phantom: bool = False

    @property
    def operating_point(self) -> tuple[str, str]:
        """Names of the rotation and the translation trial at T*, whether they were recorded or not."""
        level = int(self.tightness["safe_comfortable_cm"])
        return f"rotation_T{level:02d}", f"translation_T{level:02d}"

    @property
    def has_limits(self) -> bool:
        """Return whether both sweeps at T* were recorded, so that the joint limits are known."""
        return set(self.operating_point) <= set(self.trials)

    def trials_of(self, *kinds: str) -> list[str]:
        """Names of the trials of some kinds, ordered by kind and number."""
        keyed = [(parse_trial(name), name) for name in self.trials]
        chosen = [(kinds.index(kind), number or 0, name) for (kind, number), name in keyed if kind in kinds]
        return [name for _, _, name in sorted(chosen)]


def parse_trial(name: str) -> tuple[str, int | None]:
    """Kind of a trial and its tightness level [cm] or number; None for ``neutral``.

    Raises ValueError unless the name fits `TRIAL_GRAMMAR`.
    """
    match = _TRIAL.fullmatch(name)
    if not match:
        raise ValueError(f"{name!r} is none of: {TRIAL_GRAMMAR}")
    if match["swept"]:
        return match["swept"], int(match["level"])
    if match["counted"]:
        return match["counted"], int(match["number"])
    return "neutral", None


def discover(root: Path) -> dict[str, Subject]:
    """All subjects below ``root``, by id in alphabetical order; none if the folder is not there.

    Raises InputError for the first thing that does not fit. Only hidden files are left out in silence.
    """
    root = Path(root)
    if not root.is_dir():
        return {}
    subjects: dict[str, Subject] = {}
    declared: dict[str, str] = {}
    for name, kind in _entries(root):
        if name in _NOT_TRIALS:
            continue
        if kind != _FOLDER or not _SUBJECT_ID.fullmatch(name):
            what = f"a folder named {name!r}" if kind == _FOLDER else kind
            expected = "one folder per person, named by letters and digits (S01, ...)"
            raise InputError(root / name, "", what, expected, "rename it or move it elsewhere", "folder_name")
        values = subject_values(root / name)
        if values["id"] in declared:
            found_ = f"id {values['id']}, which {declared[values['id']]}/{SUBJECT_FILE} has already"
            remedy = "give each person an id, or remove the folder that is a copy"
            raise InputError(root / name / SUBJECT_FILE, "key id", found_, f"id {name}", remedy, "subject_id")
        declared[values["id"]] = name
        if values["id"] != name:
            found_ = f"id {values['id']} in a folder {name}"
            remedy = "correct the id, or rename the folder"
            raise InputError(root / name / SUBJECT_FILE, "key id", found_, f"id {name}", remedy, "subject_id")
        subjects[name] = _subject(root / name, values)
    return subjects


def read_subject(folder: Path) -> Subject:
    """One subject's folder, checked as `discover` does; a phantom where `subject.yaml` or a recording says so."""
    folder = Path(folder)
    person = _subject(folder, subject_values(folder))
    return replace(person, phantom=person.phantom or _any_synthetic(person.trials.values()))


def _any_synthetic(trials: Iterable[TrialFiles]) -> bool:
    """Return whether the head of some export of trials says that it is synthetic; unreadable files say nothing."""
    return any(_says_synthetic(path) for files in trials for path in (files.markers, files.markerless))


def holds_synthetic(folder: Path) -> bool:
    """Return whether the head of some file of a person's folder says that it is synthetic; nothing else is checked."""
    return any(_says_synthetic(path) for path in sorted(folder.iterdir()) if path.is_file())


def _says_synthetic(path: Path) -> bool:
    try:
        with path.open("rb") as stream:
            return SYNTHETIC_NOTICE.encode() in stream.read(_HEAD_BYTES)
    except OSError:
        return False


# -------------------- subject.yaml


def subject_values(folder: Path) -> dict[str, Any]:
    """Read a folder's `subject.yaml`, valid by its schema. Raises InputError naming file and key."""
    path = folder / SUBJECT_FILE
    if not os.path.lexists(path):
        expected = f"{SUBJECT_FILE} that says who this person is"
        raise InputError(
            folder, "", f"no {SUBJECT_FILE}", expected, f"add {path} (config/README.md)", "subject_file"
        )
    values = validated(read_yaml(path), "subject", path)
    _check_tightness(path, values["tightness"])
    return values


def _range_cm(tightness: dict[str, int]) -> tuple[int, int]:
    """Smallest and largest level: strap that remains at the buckle has its tightest level at the lower end."""
    ends = tightness["loosest_cm"], tightness["tightest_cm"]
    return min(ends), max(ends)


def _check_tightness(path: Path, tightness: dict[str, int]) -> None:
    own, (low, high) = tightness["safe_comfortable_cm"], _range_cm(tightness)
    if low == high:
        found = f"loosest_cm and tightest_cm both {low}"
        raise InputError(
            path, "key tightness", found, "two different levels", "correct the levels", "tightness"
        )
    if not low <= own <= high:
        expected = f"{low} to {high}"
        place = "key tightness.safe_comfortable_cm"
        raise InputError(
            path, place, f"{own}", expected, "correct safe_comfortable_cm or the range", "tightness"
        )


# -------------------- trials


def _subject(folder: Path, values: dict[str, Any]) -> Subject:
    exclude = {str(k): v for k, v in values["exclude"].items()}
    files = _files(folder)
    for name in exclude:
        if name not in files:
            expected = f"a trial that is there: {', '.join(sorted(files)) or 'none'}"
            remedy = "correct the name, or remove the line"
            raise InputError(folder / SUBJECT_FILE, "key exclude", name, expected, remedy, "excluded_trial")
    trials = {name: _trial(folder, name, kinds) for name, kinds in files.items() if name not in exclude}
    _check_levels(folder, list(trials), values["tightness"])
    _require(folder, trials, exclude, {"neutral": "the rest pose of the interface"})
    rest = {k: v for k, v in values.items() if k not in ("exclude", "markers")}
    return Subject(
        **rest, markers=_lab_names(folder, values["markers"]), exclude=exclude, trials=trials, folder=folder
    )


def _lab_names(folder: Path, given: dict[Any, str]) -> dict[str, str]:
    """The lab's marker names and ours for them; a number without quotes is the name that it is written like.

    Raises InputError for what YAML does not keep as it was written (on, no, 1.0).
    """
    for lab in given:
        if not isinstance(lab, str | int) or isinstance(lab, bool):
            remedy = "put the name in quotes"
            raise InputError(
                folder / SUBJECT_FILE,
                "key markers",
                f"{lab!r}, which is no text in YAML",
                "names",
                remedy,
                "names",
            )
    return {str(lab): ours for lab, ours in given.items()}


def _entries(folder: Path) -> list[tuple[str, str]]:
    """Names in a folder without hidden and system files, in order, and what each is; links count as their targets.

    Raises InputError where the folder cannot be listed.
    """
    try:
        with os.scandir(folder) as entries:
            return sorted((entry.name, _what(entry)) for entry in entries if not _is_hidden(entry.name))
    except OSError as error:
        found, remedy = error.strerror or str(error), "check the path and who may read it"
        raise InputError(folder, "", found, "a folder that can be listed", remedy, "unreadable") from error


def _is_hidden(name: str) -> bool:
    return name.startswith(".") or name.lower() in _SYSTEM_FILES


def _what(entry: os.DirEntry[str]) -> str:
    try:
        if entry.is_file():
            return _FILE
        if entry.is_dir():
            return _FOLDER
        return "a link that leads nowhere" if entry.is_symlink() else "a pipe, socket or device"
    except OSError as error:  # a link that leads to itself
        return f"a link that cannot be followed ({error.strerror or error})"


def _files(folder: Path) -> dict[str, dict[str, Path]]:
    """Files by trial and kind."""
    out: dict[str, dict[str, Path]] = {}
    for name, found_as in _entries(folder):
        if name == SUBJECT_FILE or name in _NOT_TRIALS:
            continue
        if found_as not in (_FILE, _FOLDER):
            remedy = "put the file itself there, or remove it"
            raise InputError(folder / name, "", found_as, "a file of a trial", remedy, "no_file")
        trial, suffix = os.path.splitext(name)
        kind = _KIND_OF.get(suffix.lower())
        if kind is not None and found_as == _FOLDER:
            remedy = "put the file itself there, or rename the folder"
            raise InputError(folder / name, "", _FOLDER, f"a {kind}", remedy, "no_file")
        if kind is None:
            expected = f"{SUBJECT_FILE} and trials as {', '.join(_KIND_OF)}"
            what, remedy = "an unknown kind of file", "move it elsewhere"
            if found_as == _FOLDER:
                what = _FOLDER
            elif _TRIAL.fullmatch(trial):
                remedy += "; a robot log is read as MCAP only: convert it, or leave it out (it is optional)"
            raise InputError(folder / name, "", what, expected, remedy, "file_kind")
        if kind == "marker export" and trial.endswith("_6D"):
            kind, trial = "6D export", trial.removesuffix("_6D")
        if not _TRIAL.fullmatch(trial):
            remedy = "rename the trial's files"
            raise InputError(folder / name, "", f"trial name {trial!r}", TRIAL_GRAMMAR, remedy, "trial_name")
        kinds = out.setdefault(trial, {})
        if kind in kinds:
            found = f"two {kind}s of {trial}: {kinds[kind].name} and {name}"
            raise InputError(
                folder / name, "", found, f"one {kind} per trial", "keep one of them", "two_files"
            )
        kinds[kind] = folder / name
    return out


def _trial(folder: Path, name: str, kinds: dict[str, Path]) -> TrialFiles:
    for kind in ("marker export", "markerless export"):
        if kind not in kinds:
            there = ", ".join(path.name for path in kinds.values())
            expected = f"a {kind} {name}{' or '.join(_KINDS[kind])}"
            remedy = f"add the file, or name the trial under exclude: in {SUBJECT_FILE}"
            raise InputError(folder / name, "", f"only {there}", expected, remedy, "partner_file")
    return TrialFiles(kinds["marker export"], kinds["markerless export"], kinds.get("robot log"))


def _check_levels(folder: Path, trials: list[str], tightness: dict[str, int]) -> None:
    low, high = _range_cm(tightness)
    for name in trials:
        kind, level = parse_trial(name)
        if kind in ("rotation", "translation") and level is not None and not low <= level <= high:
            found = f"tightness {level} cm"
            expected = f"{low} to {high} cm ({SUBJECT_FILE}, tightness)"
            raise InputError(
                folder / name, "", found, expected, "correct the trial's name or the range", "trial_level"
            )


def require_operating_point(person: Subject) -> None:
    """Raise InputError where a person lacks the sweeps at T*, without which the joint limits are not known."""
    needed = dict.fromkeys(person.operating_point, "the joint limits at T*")
    _require(person.folder, person.trials, person.exclude, needed)


def require_dynamic(person: Subject) -> None:
    """Raise InputError where a person has no dynamic trial, to which stiffness and damping are fitted."""
    if person.trials_of("dynamic"):
        return
    remedy = "add dynamic_1.tsv and dynamic_1.mot"
    if person.cohort == "calibration":
        remedy += f", or write cohort: validation in {SUBJECT_FILE}"
    raise _too_few_dynamic(person, "one at least, for stiffness and damping", remedy)


def require_pair(person: Subject) -> None:
    """Raise InputError where a person has not the two dynamic trials that a diagnosis needs."""
    if len(person.trials_of("dynamic")) < 2:
        expected = "two dynamic trials for a diagnosis: one to fit, one to judge on"
        remedy = (
            "add the marker and markerless export of another regime, dynamic_<number> (docs/diagnosis.md)"
        )
        raise _too_few_dynamic(person, expected, remedy)


def _too_few_dynamic(person: Subject, expected: str, remedy: str) -> InputError:
    left_out = [f"{name}: {why}" for name, why in person.exclude.items() if name.startswith("dynamic")]
    found = ", ".join(person.trials_of("dynamic")) or "no dynamic trial"
    found += f" (excluded: {'; '.join(left_out)})" if left_out else ""
    return InputError(person.folder, "", found, expected, remedy, "trial_missing")


def _require(
    folder: Path, trials: Mapping[str, TrialFiles], exclude: Mapping[str, str], needed: Mapping[str, str]
) -> None:
    for name, purpose in needed.items():
        if name not in trials:
            found = f"no trial {name}" + (f" (excluded: {exclude[name]})" if name in exclude else "")
            remedy = f"add {name}.tsv and {name}.mot"
            if name != "neutral":
                remedy += (
                    ", or correct safe_comfortable_cm;"
                    " `snakemake --cores 2 diagnosis` and `snakemake --cores 2 quality` go without"
                )
            raise InputError(folder, "", found, f"{name}, for {purpose}", remedy, "trial_missing")
