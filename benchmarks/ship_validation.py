"""Write a scored suite as a record that the report shows beside its answers: how often such an answer is right.

    python benchmarks/ship_validation.py results/suite/standard/score.json --config config/suite-standard.yaml

Writes resources/validation/<suite>-<seed>.json: what was asked, what came out, by which commit and when. Refuses a
score whose checkout has changed files, because its commit would not say which code gave the answers. Afterwards run
docs/make_validation_tables.py, which writes the tables of the documents.
"""

from __future__ import annotations

import argparse
import datetime
import subprocess
import sys
from pathlib import Path
from typing import Any

from real2sim.artefacts import read_json, write_json
from real2sim.configuration import read_yaml

ROOT = Path(__file__).parents[1]


def record(
    score: dict[str, Any], suite: dict[str, Any], commit: str, date: str, note: str = ""
) -> dict[str, Any]:
    """Return the record of a score: a suite's name, seed and cases, and every claim with its interval and target.

    ``note`` says what a reader has to know beside it: cases that were not answered, say.
    """
    return {
        "schema": 1,
        "suite": suite["name"],
        "seed": suite["seed"],
        "rests_on": "phantom: synthetic people whose causes were sealed until the answers were scored",
        "cases": score["cases"],
        "planned": sum(suite["cases"].values()),
        "failed": [row["case"] for row in score["failed"]],
        "commit": commit,
        "date": date,
        "note": note,
        "claims": score["targets"],
    }


def git(folder: Path, *command: str) -> str:
    """Return what a git command prints in a folder."""
    done = subprocess.run(["git", "-C", folder, *command], check=True, capture_output=True, text=True)
    return done.stdout.strip()


def main() -> None:
    """Write the record of one score."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("score", type=Path)
    parser.add_argument("--config", type=Path, required=True, help="of the suite: its name and seed")
    parser.add_argument("--note", default="", help="what a reader has to know beside it")
    parser.add_argument("--out", type=Path, default=ROOT / "resources" / "validation")
    options = parser.parse_args()
    folder = options.score.resolve().parent
    if changed := git(folder, "status", "--porcelain", "--untracked-files=no"):
        sys.exit(f"{options.score}: the checkout has changed files:\n{changed}\nScore a clean clone.")
    score = read_json(options.score, ("cases", "failed", "targets"))
    suite = read_yaml(options.config)
    # to the minute: of two suites of one day, the report has to know which one is the later
    scored = datetime.datetime.fromtimestamp(options.score.stat().st_mtime)
    date = scored.isoformat(" ", "minutes")
    made = record(score, suite, git(folder, "rev-parse", "--short", "HEAD"), date, options.note)
    path = options.out / f"{suite['name']}-{suite['seed']}.json"
    write_json(path, made)
    print(path)


if __name__ == "__main__":
    main()
