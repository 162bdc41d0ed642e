"""Diagnosis of the cases of one shard of a suite: ingest, gates left out, answer; the truth is nowhere in sight."""

from __future__ import annotations

import contextlib
import hashlib
import io
import json
import sys
import time
import traceback
from pathlib import Path
from typing import TYPE_CHECKING

from real2sim.artefacts import read_json, write_json
from real2sim.errors import InputError
from real2sim.provenance import fingerprint, sha256
from real2sim.recording.ingest import ingest_subject
from real2sim.study.diagnose import diagnose

if TYPE_CHECKING:
    from real2sim.settings import Settings

TRAIN, HELD_OUT, NEUTRAL = "dynamic_1", "dynamic_2", "neutral"


def diagnose_cases(
    *,
    cases: list[Path],
    robot: Path,
    settings: Settings,
    work: Path,
    out: Path,
    left_out: dict[str, list[str]] | None = None,
) -> None:
    """Answer every case of a shard.

    Parameters
    ----------
    cases
        Folders of raw exports, one person each.
    settings
        Slices ``ingest``, ``identification``, ``plant``, ``robot`` and ``diagnosis`` of the configuration.
    work
        Where canonical tables and the answer of each case go: <work>/<CASE>/. An answer that is there, from the same
        recordings, settings and code, is kept, so that an interrupted shard goes on.
    out
        JSON with the list of answers, and of the cases that failed, each with its error: one broken case does not take
        the others along, and the score says that it is missing.
    left_out
        By case: names that the catalogue is without (``diagnosis.left_out``), which shorten it and are used for nothing
        else.
    """
    answers, failed, begun, done = [], [], time.monotonic(), 0
    for index, folder in enumerate(cases):
        target = work / folder.name / "diagnosis.json"
        seconds = target.with_name("seconds.json")
        own = _without(settings, (left_out or {}).get(folder.name, []))
        key = _key(folder, robot, own)
        if not (target.exists() and seconds.exists() and read_json(seconds).get("key") == key):
            start = time.monotonic()
            try:
                _answer(folder, robot, own, target)
            except Exception as error:  # whatever it is, it is this case's alone
                traceback.print_exc()
                failed.append({"case": folder.name, "error": f"{type(error).__name__}: {error}"})
                continue
            write_json(seconds, {"seconds": time.monotonic() - start, "key": key})
            done += 1
        answers.append(str(target))
        # answers that were kept took no time and say nothing of the others
        left = (time.monotonic() - begun) / max(done, 1) * (len(cases) - index - 1)
        print(f"{index + 1}/{len(cases)} cases, about {left:.0f} s left", file=sys.stderr, flush=True)
    write_json(out, {"schema": 1, "answers": answers, "failed": failed})


def _without(settings: Settings, names: list[str]) -> Settings:
    """Return the settings with some names left out of the catalogue."""
    return settings | {"diagnosis": settings["diagnosis"] | {"left_out": names}} if names else settings


def _key(folder: Path, robot: Path, settings: Settings) -> str:
    """Return a key of what an answer rests on: recordings, robot, settings and code."""
    files = [robot, *sorted(path for path in folder.iterdir() if path.is_file())]
    parts = [fingerprint(__name__), json.dumps(settings, sort_keys=True)]
    return hashlib.sha256("\n".join([*parts, *map(sha256, files)]).encode()).hexdigest()


def _answer(folder: Path, robot: Path, settings: Settings, target: Path) -> None:
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
