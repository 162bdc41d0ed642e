"""The stages: gates of one person, and the table of the cohort."""

from __future__ import annotations

import tempfile
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypedDict

import numpy as np

from real2sim.artefacts import read_json, write_json, write_table
from real2sim.errors import InputError
from real2sim.geometry import AXES
from real2sim.provenance import sha256
from real2sim.recording import start_window
from real2sim.recording.findings import warnings_by_code
from real2sim.recording.formats.detect import read_log, read_markerless, read_markers
from real2sim.recording.formats.recordings import CoordinateRecording
from real2sim.recording.ingest import ingest_trial, lab_to_world
from real2sim.recording.landmarks import name_landmarks
from real2sim.recording.pose_table import read_pose
from real2sim.recording.quality import clocks, markers, sameness
from real2sim.recording.quality.gates import GATES, Session, judge, session_of
from real2sim.recording.quality.identity import same_gate
from real2sim.recording.quality.measure import Measured, RawTrial, find_exchanges, measure
from real2sim.recording.quality.verdict import PASS, REFUSE, WARN, Gate, worst
from real2sim.recording.subjects import Subject, TrialFiles, parse_trial, read_subject

if TYPE_CHECKING:
    from real2sim.settings import IngestSettings, QualitySettings

COLUMNS = (
    "subject",
    "trial",
    "source",
    "gate",
    "verdict",
    "value",
    "unit",
    "interval_low",
    "interval_high",
    "warn",
    "refuse",
    "key",
    "message",
    "remedy",
    "overridden",
    "phantom",
)


class GateSettings(TypedDict):
    """Settings of the gates of a person: slices of the configuration, scales of the cost, start of a trial (s; 1)."""

    quality: QualitySettings
    ingest: IngestSettings
    scales: dict[str, float]
    start_window_s: float
    start_known_share: float


def raw_trial(
    name: str, files: TrialFiles, marker_names: Mapping[str, str], settings: IngestSettings
) -> RawTrial:
    """Raw recordings of a trial with our marker names in the world; ``settings`` is the slice ``ingest``."""
    recording = read_markers(files.markers)
    rotation = lab_to_world(settings["lab_to_world"])
    named = {marker_names.get(lab, lab): values for lab, values in recording.positions.items()}
    labelled = {marker: named[marker] @ rotation.T for marker in markers.MARKERS if marker in named}
    world = markers.without_unseen(labelled, markers.needed(parse_trial(name)[0]))
    frozen = markers.find_frozen(world, **settings["frozen"], jump_m=settings["max_marker_jump_m"])
    world = markers.without_frozen(world, frozen)
    if not world:
        found = f"markers {', '.join(named) or 'none'}"
        remedy = "label them in QTM, or say which of the lab's names they are under markers: in subject.yaml"
        raise InputError(files.markers, "MARKER_NAMES", found, ", ".join(markers.MARKERS), remedy)
    markerless = read_markerless(files.markerless)
    coordinates, landmarks = (
        (markerless, None) if isinstance(markerless, CoordinateRecording) else (None, markerless)
    )
    if landmarks is not None:
        points = name_landmarks(files.markerless, landmarks, marker_names, settings["max_gap_s"])
        landmarks = replace(landmarks, positions=points)
    log = None
    if files.log is not None:
        log = read_log(files.log, settings["robot_log"]["stamps"], settings["max_gap_s"])
    used = replace(recording, positions=world, findings=[], events=[], residual_m={})
    return RawTrial(name, used, coordinates, log, landmarks)


def _is_too_short(error: InputError | None) -> bool:
    """Return whether a trial is refused for being so short that no figure of it can be measured."""
    return error is not None and error.code in ("too_short", "log_too_short")


def _unreadable(error: InputError) -> Gate:
    where = f"{error.path.name}, {error.place}" if error.place else error.path.name
    message = f"{where}: {error.found}; expected {error.expected}"
    return Gate("readable", REFUSE, None, "", None, message, error.remedy)


def _readable() -> Gate:
    return Gate("readable", PASS, None, "", None, "all files of the trial can be read and used", "")


@dataclass
class _Ingested:
    """Trials as the fits will see them: interface coordinates (n, 6), gate of the start, refusals, warnings."""

    q: dict[str, np.ndarray]
    refused: dict[str, InputError]
    warnings: dict[str, list[dict[str, str]]]
    start: dict[str, Gate]


def _tables(
    person: Subject, settings: IngestSettings, raw: Mapping[str, RawTrial], start: tuple[float, float]
) -> _Ingested:
    """Read each trial as ingest does; its tables are thrown away."""
    out = _Ingested({}, {}, {}, {})
    with tempfile.TemporaryDirectory() as scratch:
        neutral = Path(scratch) / "neutral" / "quality.json"
        for name in sorted(person.trials, key=lambda trial: (trial != "neutral", trial)):
            target = Path(scratch) / name
            if name != "neutral" and not neutral.exists():
                continue
            try:
                quality = ingest_trial(
                    subject=person.id,
                    trial=name,
                    files=person.trials[name],
                    neutral=None if name == "neutral" else neutral,
                    marker_names=person.markers,
                    settings=settings,
                    phantom=person.phantom,
                    out=target,
                    log=raw[name].log if name in raw else None,
                )
            except InputError as error:
                out.refused[name] = error
                continue
            out.warnings[name] = warnings_by_code(quality["findings"])
            if parse_trial(name)[0] not in ("dynamic", "rotation", "translation"):
                continue
            try:
                columns, _ = read_pose(target / "pose.parquet")
            except InputError as error:
                # the table is gone when somebody reads the verdict: the recording is what can be looked at
                about = error.place, error.found, error.expected, error.remedy, error.code
                out.refused[name] = InputError(person.trials[name].markers, *about)
                continue
            out.q[name] = np.column_stack([columns[f"q_{axis}"] for axis in AXES])
            if parse_trial(name)[0] == "dynamic":
                out.start[name] = _start_gate(target / "pose.parquet", *start)
    return out


def _start_gate(pose: Path, start_window_s: float, known_share: float) -> Gate:
    """Return the gate that a replay needs: pelvis and interface known while the person stands at the start."""
    share, wrong = start_window.check_pose_table(pose, start_window_s, known_share)
    message = f"first {start_window_s:g} s: " + (wrong or f"interface known in {100 * share:.0f} %")
    verdict, remedy = (REFUSE, start_window.REMEDY) if wrong else (PASS, "")
    return Gate("start", verdict, share, "1", None, message, remedy, None, "identification.start_known_share")


def _joint_limits(person: Subject, q: dict[str, np.ndarray]) -> tuple[np.ndarray, np.ndarray] | None:
    names = person.operating_point
    if not set(names) <= set(q):
        return None
    both = np.concatenate([q[name] for name in names])
    if not np.isfinite(both).any(axis=0).all():
        return None
    return np.nanmin(both, axis=0), np.nanmax(both, axis=0)


def quality_subject(
    *, subject: str, folder: Path, settings: GateSettings, raw: list[Path], out: Path
) -> None:
    """Write the verdicts of the gates on all trials of one person, from the raw files; nothing is fitted.

    Parameters
    ----------
    settings
        Slices ``quality`` and ``ingest`` of the configuration, ``scales`` of the cost, ``start_window_s`` and
        ``start_known_share``, by name.
    raw
        The person's files as the workflow saw them.
    out
        Folder for gates.json (all figures) and <TRIAL>.json (verdict of one trial: what a fit depends on).

    Raises InputError where the configuration overrides a trial that is not there.
    """
    person = read_subject(folder)
    limits, ingest = settings["quality"], settings["ingest"]
    overrides = _overrides(person, limits["override"])
    recorded, unreadable = _read_all(person, ingest)
    start = settings["start_window_s"], settings["start_known_share"]
    ingested = _tables(person, ingest, recorded, start)
    q, refused = ingested.q, ingested.refused
    whole = {name: trial for name, trial in recorded.items() if not _is_too_short(refused.get(name))}
    measured, signatures = _measure_all(person, whole, limits, ingest)
    session = session_of(list(measured.values()))
    bounds = _joint_limits(person, q)
    trials: dict[str, dict[str, Any]] = {}
    for name in sorted(person.trials, key=_order):
        error = unreadable.get(name, refused.get(name))
        gates = [_unreadable(error) if error is not None else _readable()]
        if name in measured:
            scales, own = settings["scales"], q.get(name)
            gates += judge(measured[name], session, limits, ingest, scales=scales, q=own, limits=bounds)
        gates += [ingested.start[name]] if name in ingested.start else []
        about = {"schema": 1, "subject": subject, "trial": name, "phantom": person.phantom}
        warnings = ingested.warnings.get(name, [])
        verdict = _write_verdict(out / f"{name}.json", about, gates, overrides.get(name), warnings)
        trials[name] = {
            "verdict": verdict,
            "override": overrides.get(name),
            "gates": [{"gate": g.gate, "trial": name} | asdict(g) for g in gates],
            "findings": warnings,
            "signature": signatures[name].packed() if name in signatures else None,
        }
    write_json(
        out / "gates.json",
        {
            "schema": 1,
            "subject": subject,
            "phantom": person.phantom,
            "order": list(GATES),
            "session": _session(session),
            "trials": trials,
            "excluded": person.exclude,
            "settings": settings,
        },
    )


def _write_verdict(
    path: Path, about: dict[str, Any], gates: list[Gate], override: str | None, warnings: list[dict[str, str]]
) -> str:
    """Write and print the verdict of one trial, and return it; ``warnings`` of its files are printed alone."""
    verdict = worst(gate.verdict for gate in gates)
    # only what a fit depends on: the figures of gates.json move when another trial is added
    stopped = [
        {"gate": g.gate, "message": g.message, "remedy": g.remedy} for g in gates if g.verdict == REFUSE
    ]
    warned = [g.gate for g in gates if g.verdict == WARN]
    write_json(path, about | {"verdict": verdict, "refused": stopped, "warned": warned, "override": override})
    print(
        f"{about['subject']} {about['trial']}: {verdict}"
        + "".join(f"\n  {s['gate']}: {s['message']}" for s in stopped)
        + "".join(f"\n  {w['code']}: {w['message']}; {w['action']}" for w in warnings),
        flush=True,
    )
    return verdict


def _order(name: str) -> tuple[int, str]:
    kinds = ("neutral", "dynamic", "rotation", "translation", "walk_normal", "walk_robot")
    return kinds.index(parse_trial(name)[0]), name


def _overrides(person: Subject, override: dict[str, str]) -> dict[str, str]:
    out = {}
    for key, reason in override.items():
        name, _, trial = key.partition("/")
        if name != person.id:
            continue
        if trial not in person.trials:
            expected = f"a trial of {name}: {', '.join(person.trials)}"
            raise InputError(
                "the configuration", "key quality.override", key, expected, "Correct the name, or remove it."
            )
        out[trial] = reason
    return out


def _read_all(person: Subject, ingest: IngestSettings) -> tuple[dict[str, RawTrial], dict[str, InputError]]:
    """All trials of a person that can be read, and why the others cannot."""
    trials: dict[str, RawTrial] = {}
    unreadable: dict[str, InputError] = {}
    for name, files in person.trials.items():
        try:
            trials[name] = raw_trial(name, files, person.markers, ingest)
        except InputError as error:
            unreadable[name] = error
    return trials, unreadable


def _measure_all(
    person: Subject, trials: dict[str, RawTrial], limits: QualitySettings, ingest: IngestSettings
) -> tuple[dict[str, Measured], dict[str, sameness.Signature]]:
    """Figures and signatures of the trials of a person."""
    standing = trials.get("neutral") or next(iter(trials.values()), None)
    if standing is None:
        return {}, {}
    reference = markers.reference_distances(standing.recording.positions)
    measured = {name: measure(trial, reference, limits, ingest) for name, trial in trials.items()}
    find_exchanges(trials, measured, reference, limits, ingest)
    signatures = signatures_of(trials, person.trials)
    note_copies(measured, signatures, limits)
    return measured, signatures


def signatures_of(
    trials: Mapping[str, RawTrial], files: Mapping[str, TrialFiles]
) -> dict[str, sameness.Signature]:
    """Return the signature of each trial, by its recordings and the hashes of its files."""
    out = {}
    for name, trial in trials.items():
        own = files[name]
        by_kind = {"markers": own.markers, "markerless": own.markerless, "robot log": own.log}
        hashes = {kind: sha256(path) for kind, path in by_kind.items() if path is not None}
        out[name] = sameness.signature(trial.recording.positions, trial.recording.rate_hz, hashes)
    return out


def note_copies(
    measured: Mapping[str, Measured], signatures: Mapping[str, sameness.Signature], settings: QualitySettings
) -> None:
    """Note, in both of ``measured``, trials of one person that are the same recording."""
    for same in sameness.find_same(signatures, settings["same"]):
        for name in (same.first, same.second):
            measured[name].identity.same.append(same)


def _session(session: Session) -> dict[str, Any]:
    def drift(pooled: clocks.Pooled | None) -> dict[str, Any] | None:
        if pooled is None:
            return None
        half = clocks.NORMAL_95 * pooled.sd
        span = [1e6 * (pooled.value - half), 1e6 * (pooled.value + half)]
        return {"ppm": 1e6 * pooled.value, "ci95_ppm": span, "pooled_over_trials": pooled.trials}

    return {
        "robot_drift": drift(session.robot_drift),
        "markerless_drift": drift(session.markerless_drift),
        "noise_sd_m": {name: sd for name, sd in session.noise_m.items() if np.isfinite(sd)},
    }


def quality_table(*, gates: list[Path], settings: QualitySettings, out: Path) -> None:
    """One row per person, trial and gate, or code of a warning; ``settings`` is the slice ``quality``.

    The column ``source`` is ``gate``, or ``finding`` where the row is a warning that reading the files gave: ``gate``
    then holds its code (docs/quality-codes.md) and ``remedy`` what was done. No verdict of a trial depends on those.

    Raises InputError where the configuration overrides a person that is not there, or where trials of two people are
    the same recording and neither is overridden.
    """
    people = [read_json(path, ("subject", "trials", "phantom")) for path in gates]
    known = {content["subject"] for content in people}
    for key in settings["override"]:
        if key.partition("/")[0] not in known:
            expected = f"<SUBJECT>/<TRIAL> of one of {', '.join(sorted(known))}"
            raise InputError(
                "the configuration", "key quality.override", key, expected, "Correct the name, or remove it."
            )
    shared = _same_across_people(people, settings)
    rows = []
    for content in people:
        for trial, about in content["trials"].items():
            name = f"{content['subject']}/{trial}"
            found = [shared[name] if g["gate"] == "same" and name in shared else g for g in about["gates"]]
            about_trial = {"subject": content["subject"], "trial": trial, "phantom": content["phantom"]}
            rows += [
                _table_row(gate, overridden=about["override"] is not None) | about_trial for gate in found
            ]
            rows += [_finding_row(finding) | about_trial for finding in about.get("findings", [])]
    write_table(out, COLUMNS, rows)


def _table_row(gate: dict[str, Any], *, overridden: bool) -> dict[str, Any]:
    low, high = gate["interval"] or (None, None)
    warn, refuse = gate["threshold"] or (None, None)
    return gate | {
        "source": "gate",
        "interval_low": low,
        "interval_high": high,
        "warn": warn,
        "refuse": refuse,
        "overridden": gate["verdict"] == REFUSE and overridden,
    }


def _finding_row(finding: dict[str, str]) -> dict[str, Any]:
    """Row of a warning that reading the files gave."""
    return {
        "source": "finding",
        "gate": finding["code"],
        "verdict": WARN,
        "message": finding["message"],
        "remedy": finding["action"],
        "overridden": False,
    }


def _same_across_people(people: list[dict[str, Any]], settings: QualitySettings) -> dict[str, dict[str, Any]]:
    """Gate ``same`` of overridden trials that are the same recording as one of another person, by <SUBJECT>/<TRIAL>.

    Raises InputError, with all pairs, where neither of two such trials is overridden.
    """
    signatures = {
        f"{content['subject']}/{trial}": sameness.Signature.unpacked(about["signature"])
        for content in people
        for trial, about in content["trials"].items()
        if about.get("signature") is not None
    }
    close = sameness.near(signatures, settings["same"]["shape_m"])
    pairs = [(a, b) for a, b in close if a.partition("/")[0] != b.partition("/")[0]]
    found = sameness.find_same(signatures, settings["same"], pairs)
    accepted = set(settings["override"])
    wrong = [f"{s.first} and {s.second}" for s in found if not {s.first, s.second} & accepted]
    if wrong:
        subject, _, trial = wrong[0].rpartition(" ")[2].partition("/")
        listed = "; ".join(wrong[:8]) + (f"; and {len(wrong) - 8} more" if len(wrong) > 8 else "")
        remedy = (
            "Put the right export in place, or exclude one of each two in subject.yaml, or accept it by name: "
            f'quality.override: {{"{subject}/{trial}": "<reason>"}}'
        )
        raise InputError(
            f"results/quality/{subject}/gates.json",
            f"trial {trial}, gate same",
            f"trials of two people that are the same recording: {listed}",
            "a recording of its own for each trial",
            remedy,
        )
    out = {}
    for same in found:
        for name, other in ((same.first, same.second), (same.second, same.first)):
            if name in accepted:
                out[name] = asdict(same_gate(other, same.ratio, same.file))
    return out
