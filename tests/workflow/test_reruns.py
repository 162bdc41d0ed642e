"""What runs again and what does not: the complaint that users of workflows make most."""

from __future__ import annotations

import json
import os
import random
import re
import shutil
import time

import pytest

AGGREGATION = {
    "shareability",
    "priors",
    "loso",
    "loso_table",
    "tightness_cohort",
    "report_page",
    "tightness_figure",
    "convergence_figure",
    "icc_figure",
    "loso_figure",
    "gap_figure",
    "priors_table",
    "cross_trial_table",
    "identifiability_table",
    "quality_table",
    "nested_variance",
    "classes",
    "anthropometrics",
    "refine",
    "person_interface",
    "person_page",
    "paper_tables",
    "paper_figures",
    "claims",
    "all",
}


def test_second_run_has_nothing_to_do(mini):
    assert mini.planned() == {}


def test_touched_clone_fits_nothing(mini):
    files = [path for path in mini.folder.rglob("*") if path.is_file() and ".snakemake" not in path.parts]
    random.Random(1).shuffle(files)
    now = time.time()
    for i, path in enumerate(files):
        os.utime(path, (now + i * 1e-3, now + i * 1e-3))
    expensive = ("step_study", "fit", "assessment", "cross_trial", "ingest", "joint_limits")
    assert not [rule for rule in mini.planned() if rule.startswith(expensive)]


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("# velocity by central differences", "# a comment\n        # velocity by central differences"),
        ('"""Cost of a replay against the measured', '"""A docstring, cost of a replay against the measured'),
    ],
)
def test_comment_or_docstring_in_the_library_runs_nothing(mini, old, new):
    mini.edit("workflow/real2sim/inference/cost.py", old, new)
    assert mini.planned() == {}


def test_changed_constant_in_the_cost_runs_all_fits_and_what_follows(mini):
    mini.edit("workflow/real2sim/inference/cost.py", "FAILED_COST = 1e6", "FAILED_COST = 2e6")
    planned = mini.planned()
    assert planned["fit"] == 2 * 2 + 1, "and that of the person kept for validation"
    assert planned["cross_trial"] == 2
    assert not [r for r in planned if r.startswith(("ingest", "joint_limits")) or r == "tightness"]
    assert set(planned) <= AGGREGATION | {"step_study", "fit", "assessment", "noise_floor", "cross_trial"}


def test_changed_setting_of_the_search_runs_all_fits(mini):
    mini.configure(identification={"sigma0": 1.0})
    assert mini.planned()["fit"] == 2 * 2 + 1


def test_changed_colour_runs_only_figures(mini):
    mini.edit("workflow/real2sim/pages/style.py", "#0072B2", "#0072B3")
    planned = mini.planned()
    assert planned
    assert all("figure" in rule or rule in ("report_page", "person_page", "all") for rule in planned), planned


def test_new_person_runs_only_their_jobs_and_the_aggregation(mini, mini_raw):
    shutil.copytree(mini_raw / "S03", mini.folder / "resources" / "subjects" / "S03")
    planned = mini.planned()
    assert planned["fit"] == 2
    assert planned["cross_trial"] == 1
    assert planned["joint_limits"] == 1
    assert planned["tightness"] == 1
    # who recorded the same trials shares a rule
    assert planned["ingest"] == planned["gates"] == 1
    own = {
        "step_study",
        "fit",
        "assessment",
        "noise_floor",
        "cross_trial",
        "joint_limits",
        "tightness",
        "ingest",
        "gates",
        "quality_figure",
    }
    assert set(planned) <= AGGREGATION | own, planned


def test_changed_raw_trial_fits_that_person_only(mini):
    raw = mini.folder / "resources" / "subjects" / "S01" / "dynamic_1.tsv"
    text = raw.read_text()
    raw.write_text(text.replace("DESCRIPTION\t", "DESCRIPTION\tedited ", 1))
    planned = mini.planned()
    assert sum(jobs for rule, jobs in planned.items() if rule.startswith("ingest")) == 1
    listed = mini.snakemake("-n", "--cores", "1", "--quiet", "progress").stdout
    assert "logs/ingest/S01.log" in listed
    assert "logs/ingest/S02.log" not in listed
    assert planned["fit"] == 2, "the person's own two trials and nobody else's"


@pytest.mark.parametrize(
    ("gone", "told"),
    [
        ("rotation_T*", "no trial rotation_T"),
        ("dynamic_*", "no dynamic trial"),
    ],
)
def test_recordings_that_are_gone_are_missed_though_results_of_them_are_there(mini, gone, told):
    for file in (mini.folder / "resources" / "subjects" / "S01").glob(gone):
        file.unlink()
    done = mini.snakemake("-n", "--cores", "1", check=False)
    assert done.returncode != 0
    assert told in done.stdout
    assert "trial_missing" in done.stdout


def test_a_finished_study_with_nobody_left_to_calibrate_is_refused(mini):
    for file in (mini.folder / "resources" / "subjects").glob("*/subject.yaml"):
        file.write_text(file.read_text().replace("cohort: calibration", "cohort: validation"))
    done = mini.snakemake("-n", "--cores", "1", check=False)
    assert done.returncode != 0
    assert "at least one person to calibrate on" in done.stdout


def test_trials_that_changed_their_names_are_read_and_fitted_again(mini):
    """Renamed files keep their dates, so nothing is newer than its results."""
    folder = mini.folder / "resources" / "subjects" / "S01"
    for first in folder.glob("dynamic_1.*"):
        second, aside = first.with_name(first.name.replace("_1", "_2")), first.with_suffix(".aside")
        first.rename(aside)
        second.rename(first)
        aside.rename(second)
    planned = mini.planned()
    assert sum(jobs for rule, jobs in planned.items() if rule.startswith("ingest")) == 1
    assert sum(jobs for rule, jobs in planned.items() if rule.startswith("gates")) == 1
    assert planned["fit"] == 2


@pytest.mark.parametrize("file", ["dynamic_1.tsv", "subject.yaml"])
def test_file_that_was_put_in_place_with_an_old_date_counts(mini, file):
    path = mini.folder / "resources" / "subjects" / "S01" / file
    before = path.stat()
    path.write_bytes(path.read_bytes().rstrip() + b"\n\n")
    os.utime(path, ns=(before.st_atime_ns, before.st_mtime_ns))
    planned = mini.planned()
    assert sum(jobs for rule, jobs in planned.items() if rule.startswith("ingest")) == 1
    assert planned["tightness"] == 1


def test_part_that_a_robot_includes_is_an_input(mini):
    robot = mini.folder / "resources" / "robot" / "drba.xml"
    text = robot.read_text()
    compiler = re.search(r"<compiler[^>]*/>", text)[0]
    part = robot.with_name("compiler.xml")
    part.write_text(f"<mujocoinclude>{compiler}</mujocoinclude>")
    robot.write_text(text.replace(compiler, '<include file="compiler.xml"/>'))
    target = "results/plant/S01.json"
    mini.snakemake("--cores", "1", target)
    assert mini.planned(target) == {}
    before = part.stat()
    part.write_text(part.read_text().replace("<compiler", "<!-- edited --><compiler"))
    os.utime(part, ns=(before.st_atime_ns, before.st_mtime_ns))
    assert mini.planned(target)["step_study"] == 1


@pytest.mark.long
def test_gates_that_end_in_the_same_verdicts_fit_nothing(mini):
    verdicts = {
        path: path.read_bytes()
        for path in (mini.folder / "results" / "quality").rglob("*.json")
        if path.name != "gates.json"
    }
    stamps = {path: path.stat().st_mtime_ns for path in verdicts}
    assert mini.folder / "results/quality/S01/dynamic_1.json" in verdicts
    # another threshold moves gates.json; the verdicts that fits read stay as they are
    mini.configure(quality={"gaps": {"warn": 1.1, "refuse": 5.0}})
    before = (mini.folder / "results/quality/S01/gates.json").read_bytes()
    mini.snakemake("--cores", "2", *[path.relative_to(mini.folder).as_posix() for path in verdicts])
    assert (mini.folder / "results/quality/S01/gates.json").read_bytes() != before
    assert all(path.stat().st_mtime_ns != stamp for path, stamp in stamps.items()), "they were written anew"
    assert all(path.read_bytes() == content for path, content in verdicts.items())
    assert not {"fit", "step_study", "assessment", "cross_trial"} & set(mini.planned())


def test_gates_that_end_in_another_verdict_fit_that_trial_again(mini):
    verdict = mini.folder / "results/quality/S01/dynamic_1.json"
    content = json.loads(verdict.read_text())
    verdict.write_text(json.dumps(content | {"warned": [*content["warned"], "edited"]}))
    assert mini.planned()["fit"] == 1
