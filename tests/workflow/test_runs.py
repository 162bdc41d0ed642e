"""Whole runs of the miniature: same numbers whatever the cores, and after a kill."""

from __future__ import annotations

import csv
import hashlib
import json
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import psutil
import pytest

RESULTS = (
    "trials",
    "tightness",
    "limits",
    "plant",
    "fits",
    "identifiability",
    "noise_floor",
    "cross_trial",
    "shareability",
    "priors",
    "loso",
    "tables",
)

# What is made of fits, and says so where one of them was overridden
MARKED = (*RESULTS[RESULTS.index("fits") :], "refined")


def _digests(folder: Path) -> dict[str, str]:
    files = [path for name in RESULTS for path in (folder / "results" / name).rglob("*") if path.is_file()]
    assert len(files) > 50
    return {p.relative_to(folder).as_posix(): hashlib.sha256(p.read_bytes()).hexdigest() for p in files}


def _forget(study, names: tuple[str, ...]) -> list[str]:
    """Take results away and return their files, as targets to make them again."""
    folders = [study.folder / "results" / name for name in names]
    files = [path for folder in folders for path in folder.rglob("*") if path.is_file()]
    for folder in folders:
        shutil.rmtree(folder)
    return [path.relative_to(study.folder).as_posix() for path in files]


def test_figures_are_the_same_bytes_too(mini):
    before = {p.name: p.read_bytes() for p in (mini.folder / "results" / "figures").glob("*.*")}
    assert before
    mini.snakemake("--cores", "2", "--forcerun", "convergence_figure", "icc_figure", "loso_figure")
    after = {p.name: p.read_bytes() for p in (mini.folder / "results" / "figures").glob("*.*")}
    assert after == before


def test_everything_that_rests_on_the_phantom_says_so(mini):
    fit = json.loads((mini.folder / "results/fits/S01/dynamic_1/restart-1.json").read_text())
    assert fit["phantom"] is True
    page = (mini.folder / "results/report.html").read_text()
    assert "phantom" in page.lower()
    for name in ("loso/S01.json", "cross_trial/S01.json", "trials/S01/neutral/quality.json"):
        assert json.loads((mini.folder / "results" / name).read_text())["phantom"] is True, name
    assert "phantom" in (mini.folder / "results/priors/priors.csv").read_text().splitlines()[0]


def test_every_parameter_has_a_verdict_and_every_cost_its_floor(mini):
    with (mini.folder / "results/tables/identifiability.csv").open() as stream:
        rows = list(csv.DictReader(stream))
    assert len(rows) == 2 * 2 * 12
    assert {row["verdict"] for row in rows} <= {"determined", "weak", "not determined", "at bound"}
    assert all(row["reason"] for row in rows)
    assert all(row["next_trial"] for row in rows if row["verdict"] != "determined")
    with (mini.folder / "results/tables/cross_trial.csv").open() as stream:
        people = [row for row in csv.DictReader(stream) if row["subject"].startswith("S")]
    for row in people:
        assert 0 < float(row["J_floor_low_1"]) <= float(row["J_floor_1"]) <= float(row["J_floor_high_1"])
        assert float(row["J_within_mean_1"]) > 0.5 * float(row["J_floor_1"])


@pytest.mark.long
def test_least_squares_reaches_a_lower_cost_than_a_short_cmaes(mini):
    before = {p: json.loads(p.read_text()) for p in (mini.folder / "results/fits").rglob("*.json")}
    mini.configure(identification={"method": "least_squares"})
    mini.snakemake("--cores", "2", *[p.relative_to(mini.folder).as_posix() for p in before])
    for path, fit in before.items():
        after = json.loads(path.read_text())
        assert after["method"] == "least_squares"
        assert after["cost"]["J"] <= fit["cost"]["J"] * 1.001


@pytest.mark.parametrize("victim", [pytest.param("fit", marks=pytest.mark.long), "snakemake"])
def test_killed_and_started_again_ends_in_the_same_files_with_one_core_and_two(victim, mini_done, mini):
    # all that rests on fits after the one, with one core throughout; a few of them after the other
    cores, names = ("1", RESULTS[RESULTS.index("fits") :]) if victim == "fit" else ("2", ("fits", "priors"))
    files = _forget(mini, names)
    process = subprocess.Popen(
        [sys.executable, "-m", "snakemake", "--cores", "1", *files],
        cwd=mini.folder,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        start_new_session=True,
    )
    try:
        running = _wait_for_a_fit_after_the_first(process, mini.folder)
        finished = {p: p.stat().st_mtime_ns for p in (mini.folder / "results/fits").rglob("*.json")}
        assert finished
        if victim == "fit":
            running.kill()
            process.wait(timeout=300)
            assert process.returncode != 0
        else:
            os.killpg(process.pid, signal.SIGKILL)
            process.wait(timeout=60)
    finally:
        if process.poll() is None:
            os.killpg(process.pid, signal.SIGKILL)
    mini.snakemake("--unlock")
    mini.snakemake("--cores", cores, *files)
    for path, stamp in finished.items():
        assert path.stat().st_mtime_ns == stamp, f"{path} was finished and was fitted again"
    assert _digests(mini.folder) == _digests(mini_done.folder)


def _running_fit(process: subprocess.Popen, folder: Path) -> psutil.Process | None:
    for child in psutil.Process(process.pid).children(recursive=True):
        try:
            command = child.cmdline()
        except psutil.Error:
            continue
        if command[1:4] != ["-m", "real2sim", "fit"]:
            continue
        # one that has written its file is on its way out
        if not (folder / command[command.index("--out") + 1]).exists():
            return child
    return None


def _wait_for_a_fit_after_the_first(process: subprocess.Popen, folder: Path) -> psutil.Process:
    deadline = time.monotonic() + 300
    while time.monotonic() < deadline:
        assert process.poll() is None, "the run ended before it could be killed"
        done = list((folder / "results/fits").rglob("*.json"))
        running = _running_fit(process, folder)
        if done and running:
            return running
        time.sleep(0.05)
    raise AssertionError("no fit was seen running")


@pytest.mark.long
def test_one_person_alone_is_identified_and_told_what_is_missing(mini):
    alone = mini
    for name in ("S02", "S06"):
        shutil.rmtree(alone.folder / "resources" / "subjects" / name)
    alone.configure(statistics={"min_subjects": 3})
    alone.snakemake("--cores", "2")
    fits = list((alone.folder / "results/fits/S01").rglob("*.json"))
    assert len(fits) == 4
    icc = (alone.folder / "results/shareability/icc.csv").read_text()
    assert "needs at least 3 people, have 1" in icc
    loso = json.loads((alone.folder / "results/loso/S01.json").read_text())
    assert loso["status"] == "needs at least 3 people, have 1"
    assert loso["prior_source"] == "published"
    assert loso["prior"]["k_tx"] == 725
    assert "overhead_J" not in loso
    priors = (alone.folder / "results/priors/priors.csv").read_text()
    assert "published (Table I)" in priors
    assert "needs at least 3 people" in (alone.folder / "results/report.html").read_text()


def test_failing_person_is_named_last_and_the_others_go_on(mini, mini_raw):
    shutil.copytree(mini_raw / "S03", mini.folder / "resources" / "subjects" / "S03")
    raw = mini.folder / "resources" / "subjects" / "S03" / "dynamic_1.tsv"
    raw.write_bytes(b"")
    done = mini.snakemake("--cores", "2", check=False)
    assert done.returncode != 0
    end = "\n".join(done.stdout.splitlines()[-25:])
    assert "S03/dynamic_1.tsv" in end
    assert "remedy" in end
    assert "logs/ingest/S03.log" in end
    assert json.loads((mini.folder / "results/fits/S01/dynamic_1/restart-1.json").read_text())


def _spiked(raw: Path) -> None:
    """Twelve frames in which an interface marker jumps by 40 mm: what the gate on spikes refuses."""
    lines = raw.read_text().splitlines()
    first = next(i for i, line in enumerate(lines) if line.startswith("Frame")) + 100
    rows = [row for row in range(first, len(lines), 40) if lines[row].split("\t")[-1]][:12]
    assert len(rows) == 12
    for row in rows:
        *cells, last = lines[row].split("\t")
        lines[row] = "\t".join([*cells, f"{float(last) + 40:.3f}"])
    raw.write_text("\n".join(lines) + "\n")


@pytest.mark.long
def test_refused_trial_stops_and_once_overridden_marks_all_that_rests_on_it(mini):
    _spiked(mini.folder / "resources" / "subjects" / "S01" / "dynamic_1.tsv")
    shutil.rmtree(mini.folder / "results" / "fits" / "S01" / "dynamic_1")
    done = mini.snakemake("--cores", "2", check=False)
    assert done.returncode != 0
    end = "\n".join(done.stdout.splitlines()[-40:])
    assert "gate spikes" in end
    assert 'quality.override: {"S01/dynamic_1": "<reason>"}' in end
    assert not list((mini.folder / "results/fits/S01").glob("dynamic_1/*.json"))
    assert list((mini.folder / "results/fits/S01").glob("dynamic_2/*.json")), "the other trial is fitted"

    mini.configure(quality={"override": {"S01/dynamic_1": "one marker flickered"}})
    # figures carry no such words, and the report's are asked of it in its own tests
    texts = [p for n in (*MARKED, "paper", "people") for p in (mini.folder / "results" / n).rglob("*.*")]
    kinds = (".json", ".csv", ".html")
    mini.snakemake("--cores", "2", *[str(p.relative_to(mini.folder)) for p in texts if p.suffix in kinds])
    results = mini.folder / "results"
    files = [p for name in MARKED for p in (results / name).rglob("*") if p.suffix in (".json", ".csv")]
    marked = {p.relative_to(results).as_posix() for p in files if "S01/dynamic_1" in p.read_text()}
    clean = {p.relative_to(results).as_posix() for p in files} - marked
    # what rests on other fits alone: the person's other trial, and the other people's own files
    own = ("fits/S01/dynamic_2", "identifiability/S01/dynamic_2")
    own += tuple(f"{name}/{person}" for person in ("S02", "S06") for name in MARKED[:4])
    # simulated cohorts, which rest on nobody
    own += ("shareability/coverage.csv", "shareability/power.csv")
    assert all(name.startswith(own) for name in clean), clean
    assert not any(name.startswith(own) for name in marked)
    assert "loso/S02.json" in marked, "its prior is made of the other's fits"
    assert {"priors/priors.csv", "loso/loso.csv", "tables/cross_trial.csv", "tables/priors.csv"} <= marked
    assert "refined/S06.json" in marked, "its priors are"
    for name in ("paper/claims.csv", "paper/table1_priors.csv", "people/S06.html"):
        assert "S01/dynamic_1" in (results / name).read_text(), name
