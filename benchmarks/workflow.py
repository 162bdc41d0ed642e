"""How long does the whole line take, how much memory does a job need, and how do both grow with the people?

    python benchmarks/workflow.py --configfile config/quick.yaml
    python benchmarks/workflow.py
    python benchmarks/workflow.py --people 5 10 20 --out scaling.json
    python benchmarks/workflow.py --dry-run 100 300 1000

Clones the tree into a fresh folder, times the dry run and the run on 2 cores, and reads time and peak memory of each
job from Snakemake's own benchmark files. With ``--people`` the phantom's cohort is enlarged to each number, with short
trials and a small budget: doubling the people must double the time and leave the memory of a job as it is. Numbers that
``--out`` already has are not run again. With ``--dry-run`` so many people with empty recordings are planned, not run:
jobs, time and memory of the plan (bar: 60 s and 2 GB for 1000 people). What running it would take: docs/cluster.md.
"""

from __future__ import annotations

import argparse
import csv
import itertools
import json
import os
import re
import resource
import shutil
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

import yaml

ROOT = Path(__file__).parents[1]
TREE = ("Snakefile", "workflow", "config", "resources", "profiles", "environment-lock.txt")
# A trial long enough to be fitted, a sweep with as many levels as a breakpoint needs, and few evaluations
SHORT_TRIALS = {"dynamic_s": 8.0, "walk_s": 3.0, "walk_robot_trials": 1, "neutral_s": 5.0}
SHORT_SWEEP = {"loosest_cm": 8, "tightest_cm": 13, "safe_comfortable_cm": 10}
SMALL_BUDGET = {
    "cohort": "phantom",
    "identification": {"restarts": 1, "evaluations": 44},
    "tightness": {"bootstrap": 100, "permutations": 100},
    "statistics": {"bootstrap": 500},
    "twin": {"cohort": "none"},
}


def clone(folder: Path) -> None:
    """Copy the tracked tree without results."""
    folder.mkdir(parents=True, exist_ok=True)
    for name in TREE:
        source = ROOT / name
        if source.is_dir():
            shutil.copytree(source, folder / name, ignore=shutil.ignore_patterns("__pycache__"))
        else:
            shutil.copy2(source, folder / name)


def enlarge(folder: Path, people: int) -> Path:
    """Give the clone a cohort of so many people and return the configuration of a small budget."""
    path = folder / "config" / "phantom.yaml"
    phantom = yaml.safe_load(path.read_text(encoding="utf-8"))
    known = list(phantom["cohort"].values())
    phantom["cohort"] = {
        f"S{i + 1:02d}": known[i % len(known)] | {"cohort": "calibration", "tightness": SHORT_SWEEP}
        for i in range(people)
    }
    phantom["trials"] |= SHORT_TRIALS
    path.write_text(yaml.safe_dump(phantom, sort_keys=False), encoding="utf-8")
    budget = folder / "config" / "small.yaml"
    budget.write_text(yaml.safe_dump(SMALL_BUDGET), encoding="utf-8")
    return budget


def enrol(folder: Path, people: int) -> Path:
    """Give the clone so many people with all trials but nothing in them, and return a configuration of one restart."""
    sweep = range(SHORT_SWEEP["loosest_cm"], SHORT_SWEEP["tightest_cm"] + 1)
    trials = ["neutral", *(f"{kind}_T{level:02d}" for kind in ("rotation", "translation") for level in sweep)]
    trials += ["dynamic_1", "dynamic_2", "walk_normal_1", *(f"walk_robot_{i}" for i in range(1, 6))]
    about = {"cohort": "calibration", "sex": "female", "age_years": 31, "mass_kg": 64.0, "height_m": 1.68}
    for i in range(people):
        person = folder / "resources" / "subjects" / f"S{i + 1:04d}"
        person.mkdir()
        content = {"id": person.name, **about, "waist_m": 0.78, "tightness": SHORT_SWEEP}
        (person / "subject.yaml").write_text(yaml.safe_dump(content), encoding="utf-8")
        for trial in trials:
            for kind in ("tsv", "mot", "mcap"):
                (person / f"{trial}.{kind}").touch()
    budget = folder / "config" / "small.yaml"
    budget.write_text(yaml.safe_dump(SMALL_BUDGET | {"cohort": "real"}), encoding="utf-8")
    return budget


def plan(people: int) -> None:
    """Print what planning so many people takes."""
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary) / "clone"
        clone(folder)
        command = [sys.executable, "-m", "snakemake", "-n", "--configfile", str(enrol(folder, people))]
        before = resource.getrusage(resource.RUSAGE_CHILDREN)
        start = time.monotonic()
        done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
        wall = time.monotonic() - start
    if done.returncode:
        sys.exit(done.stdout[-4000:] + done.stderr[-4000:])
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    cpu = used.ru_utime + used.ru_stime - before.ru_utime - before.ru_stime
    jobs = re.findall(r"^total\s+(\d+)", done.stdout, re.M)[-1]
    print(
        f"{people} people: {jobs} jobs, {wall:.0f} s on the clock, {cpu:.0f} s of processor, at most"
        f" {used.ru_maxrss / 1024:.0f} MB; load {os.getloadavg()[0]:.1f} on {os.cpu_count()} cores",
        flush=True,
    )


def timed(folder: Path, *arguments: str) -> float:
    """Seconds that snakemake takes in a folder; ends the program where it fails."""
    start = time.monotonic()
    command = [sys.executable, "-m", "snakemake", *arguments]
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
    if done.returncode:
        sys.exit(done.stdout[-4000:] + done.stderr[-4000:])
    return time.monotonic() - start


@dataclass(frozen=True)
class Job:
    """What a job took: seconds on the clock and of the processor, and the peak of its memory [MB]."""

    seconds: float
    cpu_s: float
    peak_mb: float


def jobs_of(folder: Path) -> dict[str, list[Job]]:
    """Jobs of a run by stage."""
    jobs: dict[str, list[Job]] = {}
    for path in sorted((folder / "logs" / "benchmarks").rglob("*.tsv")):
        stage = path.relative_to(folder / "logs" / "benchmarks").parts[0].removesuffix(".tsv")
        with path.open() as stream:
            for row in csv.DictReader(stream, delimiter="\t"):
                # a job that is over at once is not sampled
                rss, cpu = (
                    float(row[key]) if row[key] not in ("-", "NA") else 0.0 for key in ("max_rss", "cpu_time")
                )
                jobs.setdefault(stage, []).append(Job(float(row["s"]), cpu, rss))
    return jobs


def print_jobs(stages: dict[str, list[Job]]) -> None:
    """Table of a run's stages."""
    print(f"{'stage':16s} {'jobs':>5s} {'seconds':>9s} {'longest':>9s} {'peak MB':>9s}")
    for stage, jobs in stages.items():
        print(
            f"{stage:16s} {len(jobs):5d} {sum(job.seconds for job in jobs):9.1f}"
            f" {max(job.seconds for job in jobs):9.1f} {max(job.peak_mb for job in jobs):9.0f}"
        )


def scale(people: int, cores: int) -> dict:
    """Time of a run with so many people, and jobs, seconds and peak MB by stage."""
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary) / "clone"
        clone(folder)
        extra = ["--configfile", str(enlarge(folder, people))]
        parse = timed(folder, "-n", "--quiet", "all", *extra)
        whole = timed(folder, "--cores", str(cores), *extra)
        jobs = jobs_of(folder)
    return {
        "people": people,
        "dry_run_s": parse,
        "wall_s": whole,
        "cpu_s": sum(job.cpu_s for own in jobs.values() for job in own),
        "load_average": os.getloadavg()[1],
        "stages": {
            stage: {
                "jobs": len(own),
                "cpu_s": sum(job.cpu_s for job in own),
                "peak_mb": max(job.peak_mb for job in own),
            }
            for stage, own in jobs.items()
        },
    }


def report_scaling(runs: dict[str, dict]) -> None:
    """Table over the numbers of people, and the ratios at each doubling."""
    rows = [runs[key] for key in sorted(runs, key=int)]
    print(f"{'people':>8s} {'wall s':>8s} {'CPU s':>8s} {'per person':>10s} {'dry run s':>9s} {'load':>5s}")
    for row in rows:
        print(
            f"{row['people']:8d} {row['wall_s']:8.0f} {row['cpu_s']:8.0f} {row['cpu_s'] / row['people']:10.1f}"
            f" {row['dry_run_s']:9.1f} {row['load_average']:5.1f}"
        )
    for stage in rows[-1]["stages"]:
        own = [row["stages"][stage]["peak_mb"] for row in rows if stage in row["stages"]]
        print(f"peak MB of a job of {stage:16s} {'  '.join(f'{mb:6.0f}' for mb in own)}")
    for less, more in itertools.pairwise(rows):
        people = more["people"] / less["people"]
        grown = max(
            (more["stages"][s]["peak_mb"] / less["stages"][s]["peak_mb"], s)
            for s in less["stages"]
            if s in more["stages"] and less["stages"][s]["peak_mb"] > 0
        )
        print(
            f"{less['people']} to {more['people']} people: {people:.1f} times the people,"
            f" {more['wall_s'] / less['wall_s']:.2f} times the time on the clock,"
            f" {more['cpu_s'] / less['cpu_s']:.2f} times the processor time of the jobs; memory of a job at most"
            f" {grown[0]:.2f} times ({grown[1]})"
        )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--configfile", type=Path)
    parser.add_argument("--cores", type=int, default=2)
    parser.add_argument("--folder", type=Path, help="keep the clone here")
    parser.add_argument("--people", type=int, nargs="+", help="sizes of the cohort")
    parser.add_argument(
        "--dry-run", type=int, nargs="+", metavar="PEOPLE", help="plan so many people, ascending"
    )
    parser.add_argument("--out", type=Path, help="JSON of the runs with --people")
    options = parser.parse_args()
    if options.dry_run:
        for people in sorted(options.dry_run):
            plan(people)
        return
    if options.people:
        runs = json.loads(options.out.read_text()) if options.out and options.out.exists() else {}
        for people in options.people:
            if str(people) not in runs:
                runs[str(people)] = scale(people, options.cores)
                if options.out:
                    options.out.write_text(json.dumps(runs, indent=1) + "\n")
        report_scaling(runs)
        return
    temporary = Path(tempfile.mkdtemp())
    folder = options.folder or temporary / "clone"
    clone(folder)
    extra = ["--configfile", str(options.configfile)] if options.configfile else []
    print(f"dry run of a clean clone: {timed(folder, '-n', '--quiet', 'all', *extra):.1f} s")
    whole = timed(folder, "--cores", str(options.cores), *extra)
    print(f"whole line on {options.cores} cores: {whole / 60:.1f} min")
    print_jobs(jobs_of(folder))
    shutil.rmtree(temporary)


if __name__ == "__main__":
    main()
