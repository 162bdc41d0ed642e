"""Mistakes of a careless lab over recording sessions with known truth: how many are told, and told as what they are.

    python benchmarks/mistakes.py --raw FOLDER --rows FILE [--seeds 401 402 403] [--people S01 ...] [--cases 18]

Draws the people of config/phantom.yaml with other seeds into FOLDER (once; three levels of tightness, three walks with
the robot: 13 trials), and judges every clean session. Then one mistake a session is made on its files
(benchmarks/mistaken_files.py), the trials whose files changed are read again, and the session is judged by the code of
the rules: readers, ingest, gates, and gate `same` across the people of the study. A mistake counts as told if a gate
refuses or warns, or ingest refuses or reports a warning, where the clean session has none; and as named if one of these
gates or codes belongs to the mistake. Rows stand in FILE as JSON lines; a run goes on where another stopped.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import tempfile
import time
import zlib
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
ROOT = Path(__file__).parents[1]
sys.path[:0] = [str(ROOT / "workflow"), str(ROOT)]

import numpy as np
import yaml
from real2sim.configuration import read_yaml, validated
from real2sim.errors import InputError
from real2sim.recording.formats.detect import read_log
from real2sim.recording.ingest import ingest_trial, lab_to_world
from real2sim.recording.quality import markers, pairing, sameness, stage
from real2sim.recording.quality.gates import judge, session_of
from real2sim.recording.quality.measure import (
    File,
    Measured,
    RawTrial,
    Suspect,
    find_exchanges,
    lay_file,
    measure,
)
from real2sim.recording.subjects import Subject, read_subject

from benchmarks import faults
from benchmarks.faults import CONFIG, share
from benchmarks.mistaken_files import MISTAKES, Lab, Mistake

# the kinds in turn; kind 2 has the most ways
TURN = (2, 3, 4, 5, 8, 2)
_TIME_S = 1e-4  # times of a log that are right
Alarm = tuple[str, str, str]  # trial, gate or code, verdict or severity


@dataclass
class Session:
    """Clean session of one person, read and measured, with the alarms it has."""

    seed: int
    person: Subject
    trials: dict[str, RawTrial]
    measured: dict[str, Measured]
    signatures: dict[str, sameness.Signature]
    reference: np.ndarray
    neutral: Path
    alarms: set[Alarm]
    laid: dict[tuple[int, int], tuple[Any, ...]] = field(default_factory=dict)

    def lay(self, suspect: Suspect, file: File) -> pairing.Shared | None:
        """Lay a file on the markers of a trial as the gates do, once for the same two."""
        key = id(suspect.trial.recording), id(file)
        if key not in self.laid:
            # what is kept keeps its id
            self.laid[key] = lay_file(suspect, file), suspect.trial.recording, file
        shared: pairing.Shared | None = self.laid[key][0]
        return shared


def phantom_of(seed: int) -> dict[str, Any]:
    """Return the phantom ``seed`` on, with sessions short enough to judge hundreds."""
    source = ROOT / "config" / "phantom.yaml"
    phantom = validated(read_yaml(source), "phantom", source)
    for person in phantom["cohort"].values():
        best = person["tightness"]["safe_comfortable_cm"]
        person["tightness"] |= {"loosest_cm": best - 1, "tightest_cm": best + 1}
    phantom["trials"]["walk_robot_trials"] = 3
    return dict(phantom) | {"seed": phantom["seed"] + seed}


def draw(raw: Path, seeds: list[int], people: list[str]) -> None:
    """Write the raw files of all sessions that are not there."""
    for seed in seeds:
        for name in people:
            if not (raw / f"seed{seed}" / "sealed" / f"{name}.json").exists():
                faults.simulate(raw / f"seed{seed}", [name], phantom_of(seed))
                print(f"drawn: seed +{seed} {name}", flush=True)


# -------------------- judging, as the rules do


def _ingest(person: Subject, name: str, neutral: Path | None, out: Path) -> set[Alarm]:
    """Ingest one trial; return the codes of its warnings, or of its refusal."""
    try:
        quality = ingest_trial(
            subject=person.id,
            trial=name,
            files=person.trials[name],
            neutral=neutral,
            marker_names=person.markers,
            settings=CONFIG["ingest"],
            phantom=True,
            out=out,
        )
    except InputError as error:
        return {(name, error.code or "refused", "refuse")}
    return {(name, f["code"], f["severity"]) for f in quality["findings"] if f["severity"] != "info"}


def _gates(measured: dict[str, Measured]) -> set[Alarm]:
    """Return the alarms of the gates on a session."""
    session = session_of(list(measured.values()))
    scales = CONFIG["identification"]["scales"]
    return {
        (name, gate.gate, gate.verdict)
        for name, m in measured.items()
        for gate in judge(m, session, CONFIG["quality"], CONFIG["ingest"], scales=scales)
        if gate.verdict != "pass"
    }


def load(raw: Path, seed: int, name: str, scratch: Path) -> Session:
    """Read, measure and ingest a clean session."""
    person = read_subject(raw / f"seed{seed}" / "raw" / name)
    read = faults.load(person.folder.parent, raw / f"seed{seed}" / "sealed", name)
    neutral = scratch / "neutral"
    alarms = _gates(read.measured) | _ingest(person, "neutral", None, neutral)
    for trial in person.trials:
        if trial != "neutral":
            alarms |= _ingest(person, trial, neutral / "quality.json", scratch / "trial")
    signatures = stage.signatures_of(read.raw, person.trials)
    return Session(
        seed, person, read.raw, read.measured, signatures, read.reference, neutral / "quality.json", alarms
    )


def _unnoted(m: Measured, *, without_log: bool) -> Measured:
    """Return figures of a clean trial without the notes that a comparison of trials adds to them."""
    spacing = {k: v for k, v in m.spacing.items() if not (without_log and k == "robot log")}
    identity = replace(m.identity, exchanged={}, same=[])
    return replace(m, identity=identity, robot=None if without_log else m.robot, spacing=spacing)


def judge_session(clean: Session, folder: Path, mistake: Mistake, changed: list[str]) -> set[Alarm]:
    """Return the alarms of a session of which the files of some trials changed, less those of the clean one."""
    person, limits = read_subject(folder), CONFIG["quality"]
    no_logs = mistake.without_logs
    trials = {n: replace(t, log=None) if no_logs else t for n, t in clean.trials.items()}
    measured = {n: _unnoted(m, without_log=no_logs) for n, m in clean.measured.items()}
    signatures, alarms = dict(clean.signatures), set[Alarm]()
    for name in changed:
        for table in (trials, measured, signatures):
            del table[name]
        try:
            trial = stage.raw_trial(name, person.trials[name], person.markers, CONFIG["ingest"])
        except InputError as error:
            alarms.add((name, error.code or "refused", "refuse"))
            continue
        # of neutral as it is now, as in the rule
        standing = trial if name == "neutral" else None
        reference = markers.reference_distances(standing.recording.positions) if standing else clean.reference
        trials[name], measured[name] = trial, measure(trial, reference, limits, CONFIG["ingest"])
        signatures |= stage.signatures_of({name: trial}, person.trials)
        with tempfile.TemporaryDirectory() as scratch:
            neutral = None if name == "neutral" else clean.neutral
            alarms |= _ingest(person, name, neutral, Path(scratch))
    find_exchanges(trials, measured, clean.reference, limits, CONFIG["ingest"], clean.lay)
    pairs = [(a, b) for a in changed if a in signatures for b in signatures if b != a]
    for same in sameness.find_same(signatures, limits["same"], pairs):
        measured[same.first].identity.same.append(same)
    alarms |= _gates(measured) | _across_people(mistake, signatures)
    return alarms - clean.alarms


def _across_people(mistake: Mistake, signatures: dict[str, sameness.Signature]) -> set[Alarm]:
    """Compare the changed trials with the trial of the other person that was put in, as the table of gates does."""
    if mistake.donor is None:
        return set()
    other = read_subject(mistake.donor.parent)
    name = mistake.donor.name
    raw = {name: stage.raw_trial(name, other.trials[name], other.markers, CONFIG["ingest"])}
    theirs = stage.signatures_of(raw, other.trials)

    def packed(some: dict[str, sameness.Signature]) -> dict[str, Any]:
        return {n: {"signature": s.packed()} for n, s in some.items()}

    people = [
        {"subject": "own", "trials": packed(signatures)},
        {"subject": "other", "trials": packed(theirs)},
    ]
    try:
        stage._same_across_people(people, CONFIG["quality"])
    except InputError:
        return {(name, "same", "refuse")}
    return set()


# -------------------- one mistake


def make_case(raw: Path, clean: Session, number: int) -> dict[str, Any]:
    """Make mistake ``number`` of the whole run on the files of a session, and return the row of what came of it."""
    start = time.monotonic()
    kind, make = _choice(number)
    rng = np.random.default_rng([clean.seed, zlib.crc32(clean.person.id.encode()), number])
    home = raw / f"seed{clean.seed}" / "raw"
    with tempfile.TemporaryDirectory(dir=raw) as scratch:
        folder = Path(scratch) / clean.person.id
        folder.mkdir()
        for path in clean.person.folder.iterdir():
            os.link(path, folder / path.name)
        others = [p for p in sorted(home.iterdir()) if p.name != clean.person.id]
        mistake = make(Lab(folder, others, rng))
        # where all files changed alike, one trial that names the mistake is enough
        alarms = judge_session(
            clean, folder, mistake, mistake.changed[:1] if mistake.session else mistake.changed
        )
        if mistake.session and not mistake.right & {code for _, code, _ in alarms}:
            alarms = judge_session(clean, folder, mistake, mistake.changed)
        told = {code for _, code, _ in alarms}
        row = {
            "case": number,
            "seed": clean.seed,
            "person": clean.person.id,
            "kind": kind,
            "mistake": mistake.name,
            "detail": mistake.detail,
            "told": bool(told),
            "refused": any(verdict in ("refuse", "error") for *_, verdict in alarms),
            "named": bool(told & mistake.right),
            "alarms": sorted(alarms),
            "right_line": _line_is_right(folder, mistake) if "lab_axes" in told and mistake.session else None,
            "times_right": _times_are_right(clean, folder, mistake) if mistake.times_kept else None,
        }
    return row | {"seconds": round(time.monotonic() - start, 1)}


def _choice(number: int) -> tuple[int, Any]:
    """Return kind and function of a case: the kinds in turn, and the ways of each in turn."""
    kind = TURN[number % len(TURN)]
    nth = number // len(TURN) * TURN.count(kind) + TURN[: number % len(TURN)].count(kind)
    ways = MISTAKES[kind]
    return kind, ways[nth % len(ways)]


def _line_is_right(folder: Path, mistake: Mistake) -> bool:
    """Return whether the line that ingest tells the lab to write undoes the turn of its axes."""
    person = read_subject(folder)
    with tempfile.TemporaryDirectory() as scratch:
        try:
            _ingest_strictly(person, Path(scratch))
        except InputError as error:
            line = yaml.safe_load(error.remedy.partition("lab_to_world: ")[2])
            return bool(np.allclose(lab_to_world(line) @ mistake.axes, np.eye(3)))
    return False


def _ingest_strictly(person: Subject, out: Path) -> None:
    ingest_trial(
        subject=person.id,
        trial="neutral",
        files=person.trials["neutral"],
        neutral=None,
        marker_names={},
        settings=CONFIG["ingest"],
        phantom=True,
        out=out,
    )


def _times_are_right(clean: Session, folder: Path, mistake: Mistake) -> bool:
    """Return whether a log that arrived late is read with the times of the clean one, from its edge of /sync."""
    name = mistake.changed[0]
    log, own = read_log(folder / f"{name}.mcap"), clean.trials[name].log
    assert own is not None
    assert own.sync_s is not None
    assert log.sync_s is not None
    for ours, theirs in ((own.joint_time_s, log.joint_time_s), (own.base_time_s, log.base_time_s)):
        if len(ours) != len(theirs):
            return False
        if np.abs((ours - own.sync_s[0]) - (theirs - log.sync_s[0])).max() > _TIME_S:
            return False
    return True


# -------------------- the whole run


def run(raw: Path, rows: Path, seeds: list[int], people: list[str], cases: int) -> None:
    """Judge all sessions, clean and with ``cases`` mistakes each; append to ``rows`` what is not there."""
    wanted = {(seed, name) for seed in seeds for name in people}
    known = {
        (r["seed"], r["person"], r["case"]) for r in read_rows(rows) if (r["seed"], r["person"]) in wanted
    }
    total = len(seeds) * len(people) * (cases + 1)
    for at, (seed, name) in enumerate((s, p) for s in seeds for p in people):
        numbers = [-1, *range(at * cases, (at + 1) * cases)]
        left = [n for n in numbers if (seed, name, n) not in known]
        if not left:
            continue
        with tempfile.TemporaryDirectory() as scratch:
            clean = load(raw, seed, name, Path(scratch))
            for number in left:
                row = make_case(raw, clean, number) if number >= 0 else _clean_row(clean)
                with rows.open("a", encoding="utf-8") as stream:
                    stream.write(json.dumps(row) + "\n")
                known.add((seed, name, number))
                print(f"{len(known)}/{total} {_short(row)}", flush=True)


def _clean_row(clean: Session) -> dict[str, Any]:
    gates = sorted(a for a in clean.alarms if a[1] in stage.GATES)
    return {
        "case": -1,
        "seed": clean.seed,
        "person": clean.person.id,
        "trials": len(clean.trials),
        "alarms": gates,
        "refused": sorted(a for a in clean.alarms if a[2] == "refuse"),
    }


def _short(row: dict[str, Any]) -> str:
    if row["case"] < 0:
        return f"seed +{row['seed']} {row['person']} clean, alarms: {row['alarms']}"
    verdict = "named" if row["named"] else "TOLD AS ANOTHER" if row["told"] else "MISSED"
    return f"seed +{row['seed']} {row['person']} {row['mistake']} ({row['detail']}): {verdict}, {row['seconds']} s"


def read_rows(path: Path) -> list[dict[str, Any]]:
    """Return the rows of a run, oldest first."""
    if not path.exists():
        return []
    return [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines()]


def report(rows: list[dict[str, Any]]) -> None:
    """Print shares with Wilson intervals by kind and way, misses, and alarms of the clean sessions."""
    cases = [row for row in rows if row["case"] >= 0]

    def line(text: str, some: list[dict[str, Any]]) -> None:
        told, named = (share(sum(r[key] for r in some), len(some)) for key in ("told", "named"))
        print(f"{text}: told {told}; named {named}")

    for kind in sorted({row["kind"] for row in cases}):
        of_kind = [row for row in cases if row["kind"] == kind]
        line(f"kind {kind}", of_kind)
        for way in dict.fromkeys(row["mistake"] for row in of_kind):
            line(f"  {way}", [row for row in of_kind if row["mistake"] == way])
    if cases:
        line("all (bars: told 98 %, named 95 %)", cases)
        refused = share(sum(row["refused"] for row in cases), len(cases))
        print(f"refused, and not only warned of: {refused}")
    for key, text in (
        ("right_line", "the line that a refused lab is told undoes its axes"),
        ("times_right", "a stamped log that arrives late is read with the right times"),
    ):
        some = [row[key] for row in cases if row[key] is not None]
        if some:
            print(f"{text}: {share(sum(some), len(some))}")
    for row in cases:
        if not row["named"] or row["right_line"] is False or row["times_right"] is False:
            alarms = (
                ", ".join(sorted({f"{code} {verdict}" for _, code, verdict in row["alarms"]})) or "nothing"
            )
            print(f"  {_short(row)}; alarms: {alarms}")
    _report_clean([row for row in rows if row["case"] < 0])


def _report_clean(rows: list[dict[str, Any]]) -> None:
    count = sum(row["trials"] for row in rows)
    alarms = [(row, alarm) for row in rows for alarm in row["alarms"]]
    trials = {(row["seed"], row["person"], trial) for row, (trial, *_) in alarms}
    print(f"clean trials with an alarm of a gate: {share(len(trials), count)} (bar 1 %)")
    for row, alarm in alarms:
        print(f"  seed +{row['seed']} {row['person']}: {' '.join(alarm)}")


def main() -> None:
    """Draw, judge and report."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--raw", type=Path, required=True, help="folder of the drawn sessions")
    parser.add_argument("--rows", type=Path, required=True, help="JSON lines, a case each")
    parser.add_argument("--seeds", type=int, nargs="+", default=[401, 402, 403])
    parser.add_argument("--people", nargs="+", default=[f"S0{i}" for i in range(1, 7)])
    parser.add_argument("--cases", type=int, default=18, help="mistaken sessions of each clean one")
    options = parser.parse_args()
    draw(options.raw, options.seeds, options.people)
    run(options.raw, options.rows, options.seeds, options.people, options.cases)
    report(read_rows(options.rows))


if __name__ == "__main__":
    main()
