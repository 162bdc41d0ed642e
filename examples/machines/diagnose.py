"""Diagnose measured machines from their published files, and compare with what others published.

python examples/machines/diagnose.py FOLDER [--machine NAME] [--question NAME] [--jobs N] [--out FOLDER]
python examples/machines/diagnose.py --where
"""

from __future__ import annotations

import argparse
import os
import sys
import time
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor, as_completed
from pathlib import Path
from typing import Any

import pandas as pd
import real2sim as r2s
from machine import MACHINES, Machine, closed
from real2sim.pages.law import law_sentence, misfit_sentence

parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
parser.add_argument("data", type=Path, nargs="?", help="folder with the published files, anywhere below it")
parser.add_argument("--machine", choices=MACHINES, action="append", help="only this one; may be given again")
parser.add_argument("--question", action="append", help="only this one; may be given again")
parser.add_argument("--where", action="store_true", help="say where the files come from, and stop")
parser.add_argument("--jobs", type=int, default=min(2, os.cpu_count() or 1), help="questions at a time")
parser.add_argument("--out", type=Path, default=Path("results/machines"))


def rows(machine: Machine, question: str, answer: r2s.Diagnosis, seconds: float) -> Iterator[dict[str, Any]]:
    """Yield the rows of the table: the answer, then each published number beside its estimate."""
    told = answer.answer
    left = told.beyond.misfit
    about = law_sentence(answer.free_form) if answer.free_form is not None else ""
    if left is not None and left["marked"]:
        about = misfit_sentence(left)
    base = {"machine": machine.name, "question": question, "answer": " + ".join(told.verdict_set)}
    yield base | {
        "quantity": "probability",
        "estimate": told.probabilities[told.verdict],
        "closed_held_out": closed(answer),
        "left": about,
        "seconds": seconds,
    }
    numbers: dict[str, Any] = {k: v | {"value": v["with_effect"]} for k, v in told.parameters.items()}
    for cause in told.causes:
        if cause.effect in told.verdict_set:
            numbers |= cause.parameters
    published = {
        p["parameter"]: p for p in machine.content["questions"][question]["published"] if "value" in p
    }
    for name, number in numbers.items():
        known = next((p for key, p in published.items() if name == key or name.startswith(f"{key}_")), None)
        low, high = number.get("ci95") or (None, None)
        yield base | {
            "quantity": name,
            "estimate": number["value"],
            "low": low,
            "high": high,
            "unit": number["unit"],
            "published": None if known is None else known["value"],
        }


def ask(name: str, data: Path, question: str, out: Path) -> list[dict[str, Any]]:
    """Diagnose one question and write its files; returns its rows of the table."""
    begun, machine = time.monotonic(), Machine.load(name, data)
    answer = machine.ask(question)
    folder = out / name / question
    folder.mkdir(parents=True, exist_ok=True)
    answer.save(folder / "diagnosis.json")
    answer.plot(folder / "traces.png")
    answer.export_model(folder / "model.xml")
    if answer.free_form is not None and answer.free_form["curve"] is not None:
        answer.plot_law(folder / "law.png")
    return list(rows(machine, question, answer, time.monotonic() - begun))


def check_questions(options: argparse.Namespace) -> None:
    """Raise InputError for a question that none of the machines asked for has."""
    names = options.machine or MACHINES
    known = {q: name for name in names for q in Machine.load(name, Path()).content["questions"]}
    unknown = [q for q in options.question or () if q not in known]
    if unknown:
        listed = ", ".join(f"{q} ({name})" for q, name in known.items())
        raise r2s.InputError("--question", "", ", ".join(unknown), listed, "Name one of them.")


def asked(options: argparse.Namespace) -> Iterator[tuple[str, str]]:
    """Yield machine and question of everything that is to be asked; files are checked first."""
    for name in options.machine or MACHINES:
        machine = Machine.load(name, options.data)
        for file in machine.content["files"]:
            machine.file(file)
        for question in machine.content["questions"]:
            if not options.question or question in options.question:
                yield name, question


def main(arguments: list[str] | None = None) -> pd.DataFrame:
    """Ask everything, write answers, figures and the table; return the table."""
    options = parser.parse_args(arguments)
    if options.where or options.data is None:
        for name in MACHINES:
            machine = Machine.load(name, Path())
            print(f"{name}: {', '.join(machine.content['files'])}\n  {machine.origin}")
        return pd.DataFrame()
    check_questions(options)
    questions, table = list(asked(options)), {}
    with ProcessPoolExecutor(options.jobs) as pool:
        jobs = {pool.submit(ask, m, options.data, q, options.out): (m, q) for m, q in questions}
        for done in as_completed(jobs):
            table[jobs[done]] = done.result()
            print(f"{len(table)}/{len(jobs)}: {' '.join(jobs[done])}", file=sys.stderr, flush=True)
    # in the order in which they were asked, whichever was ready first
    out = pd.DataFrame([row for key in questions for row in table[key]])
    options.out.mkdir(parents=True, exist_ok=True)
    out.to_csv(options.out / "table.csv", index=False)
    print(out[out["quantity"] == "probability"].drop(columns=["quantity", "left"]).to_string(index=False))
    return out


if __name__ == "__main__":
    try:
        main()
    except r2s.InputError as error:
        sys.exit(str(error))
