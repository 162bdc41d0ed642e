"""Diagnosis of the cases of one shard of a suite: ingest, gates left out, answer; the truth is nowhere in sight."""

from __future__ import annotations

import contextlib
import io
import sys
import time
from pathlib import Path

from real2sim.artefacts import write_json
from real2sim.diagnosis.stage import diagnose
from real2sim.errors import InputError
from real2sim.ingest import ingest_subject

TRAIN, HELD_OUT, NEUTRAL = "dynamic_1", "dynamic_2", "neutral"


def diagnose_cases(*, cases: list[Path], robot: Path, settings: dict, work: Path, out: Path) -> None:
    """Answer every case of a shard.

    Parameters
    ----------
    cases
        Folders of raw exports, one person each.
    settings
        Slices ``ingest``, ``identification``, ``plant``, ``robot`` and ``diagnosis`` of the configuration.
    work
        Where canonical tables and the answer of each case go: <work>/<CASE>/; an answer that is there is kept, so that
        an interrupted shard goes on.
    out
        JSON with the list of answers.
    """
    answers, begun = [], time.monotonic()
    for index, folder in enumerate(cases):
        target = work / folder.name / "diagnosis.json"
        seconds = target.with_name("seconds.json")
        if not target.exists():
            start = time.monotonic()
            _answer(folder, robot, settings, target)
            write_json(seconds, {"seconds": time.monotonic() - start})
        answers.append(str(target))
        spent = (time.monotonic() - begun) / (index + 1)
        left = spent * (len(cases) - index - 1)
        print(f"{index + 1}/{len(cases)} cases, about {left:.0f} s left", file=sys.stderr, flush=True)
    write_json(out, {"schema": 1, "answers": answers})


def _answer(folder: Path, robot: Path, settings: dict, target: Path) -> None:
    tables = target.parent
    raw = sorted(path for path in folder.iterdir() if path.name != "subject.yaml")
    with contextlib.redirect_stdout(io.StringIO()):
        ingest_subject(
            subject=folder.name,
            folder=folder,
            settings=settings["ingest"],
            raw=raw,
            out=tables,
        )
    missing = [name for name in (TRAIN, HELD_OUT, NEUTRAL) if not (tables / name).exists()]
    if missing:
        expected = f"{NEUTRAL}, {TRAIN} and {HELD_OUT}"
        raise InputError(
            folder, "", f"no trial {', '.join(missing)}", expected, "Record it.", "trial_missing"
        )
    diagnose(
        subject=folder.name,
        train=tables / TRAIN,
        held_out=tables / HELD_OUT,
        neutral=tables / NEUTRAL,
        robot=robot,
        settings=settings,
        out=target,
    )
