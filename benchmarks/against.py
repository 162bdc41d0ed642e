"""Is this version faster than an earlier one? Both do the same jobs of the study in turns, and ratios are printed.

    python benchmarks/against.py COMMIT [--rounds 3] [--jobs import plan fit diagnose] [--out against.json]

Clones the commit and HEAD into a temporary folder, lets each write its own phantom and what the jobs need, and then
runs every job in turns: earlier, now, now, earlier. Told are processor seconds of the job itself, as Snakemake's
benchmark file says (of ``import`` and ``plan``, of the whole process), and the median ratio of the pairs with its
range: on a machine that does other things too, single times say little and ratios of neighbours say more.
"""

from __future__ import annotations

import argparse
import csv
import json
import os
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

ROOT = Path(__file__).parents[1]
# Rule and target of each job that Snakemake runs
JOBS = {
    "fit": ("fit", "results/fits/S01/dynamic_1/restart-1.json"),
    "diagnose": ("diagnose", "results/diagnosis/S01/diagnosis.json"),
}
# One thread a job, as in a run that has a job on each core
ENVIRONMENT = os.environ | {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}


def run(folder: Path, *command: str) -> float:
    """Return the processor seconds that a command takes in a checkout; ends the program where it fails."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    environment = ENVIRONMENT | {"PYTHONPATH": str(folder / "workflow")}
    done = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, check=False)
    if done.returncode:
        sys.exit(f"{folder.name}: {' '.join(command)}\n{done.stdout[-2000:]}{done.stderr[-4000:]}")
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def snakemake(folder: Path, *arguments: str) -> float:
    """As `run`, of Snakemake on one core."""
    return run(folder, sys.executable, "-m", "snakemake", "--cores", "1", *arguments)


def of_job(rule: str, target: str) -> Callable[[Path], float]:
    """Return what runs a rule once more in a checkout and returns its processor seconds."""

    def measured(folder: Path) -> float:
        started = time.time()
        snakemake(folder, "--forcerun", rule, "--", target)
        files = [p for p in (folder / "logs" / "benchmarks").rglob("*.tsv") if p.stat().st_mtime >= started]
        if len(files) != 1:
            sys.exit(f"{folder.name}: {target} ran {len(files)} jobs instead of one")
        with files[0].open() as stream:
            row = next(csv.DictReader(stream, delimiter="\t"))
        return float(row["cpu_time"])

    return measured


def cloned(commit: str, folder: Path) -> str:
    """Check a commit out into a folder and return its short name."""
    git = ("git", "-C", str(folder))
    subprocess.run(["git", "clone", "--quiet", "--shared", str(ROOT), str(folder)], check=True)
    found = subprocess.run([*git, "checkout", "--quiet", commit], capture_output=True, text=True, check=False)
    if found.returncode:
        sys.exit(f"{commit}: no commit of {ROOT}: {found.stderr.strip()}. `git log --oneline` lists them.")
    return subprocess.run(
        [*git, "rev-parse", "--short", "HEAD"], check=True, capture_output=True, text=True
    ).stdout.strip()


def compared(
    measure: Callable[[Path], float], earlier: Path, now: Path, rounds: int
) -> dict[str, list[float]]:
    """Return processor seconds (rounds,) of both, one after the other and in turns the other way round."""
    taken: dict[str, list[float]] = {"earlier": [], "now": []}
    for i in range(rounds):
        order = (("earlier", earlier), ("now", now))
        for name, folder in order if i % 2 == 0 else order[::-1]:
            taken[name].append(measure(folder))
    return taken


def main() -> None:
    """Print a line per job."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("commit", help="the earlier version")
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument(
        "--jobs", nargs="+", choices=["import", "plan", *JOBS], default=["import", "plan", *JOBS]
    )
    parser.add_argument("--out", type=Path, help="JSON for what was measured")
    options = parser.parse_args()
    measures: dict[str, Callable[[Path], float]] = {
        "import": lambda folder: run(folder, sys.executable, "-c", "import real2sim"),
        "plan": lambda folder: snakemake(folder, "--dry-run"),
    } | {name: of_job(*job) for name, job in JOBS.items()}
    with tempfile.TemporaryDirectory() as temporary:
        earlier, now = Path(temporary) / "earlier", Path(temporary) / "now"
        commits = {"earlier": cloned(options.commit, earlier), "now": cloned("HEAD", now)}
        targets = [JOBS[name][1] for name in options.jobs if name in JOBS]
        for folder in (earlier, now) if targets else ():
            print(f"{commits[folder.name]}: what the jobs need, and a first run of them", flush=True)
            snakemake(folder, "--", *targets)
        record = {"commits": commits, "cores": os.cpu_count(), "jobs": {}}
        for name in options.jobs:
            taken = compared(measures[name], earlier, now, options.rounds)
            ratios = np.array(taken["now"]) / np.array(taken["earlier"])
            print(
                f"{name}: {np.median(taken['now']):.2f} s of processor at {commits['now']},"
                f" {np.median(taken['earlier']):.2f} s at {commits['earlier']}: ratio {np.median(ratios):.2f}"
                f" ({ratios.min():.2f} to {ratios.max():.2f} in {len(ratios)} rounds)",
                flush=True,
            )
            record["jobs"][name] = taken | {"ratio": float(np.median(ratios))}
    if options.out:
        options.out.parent.mkdir(parents=True, exist_ok=True)
        options.out.write_text(json.dumps(record, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
