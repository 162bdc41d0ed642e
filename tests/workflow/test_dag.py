"""The DAG of a clean clone, and the seal on the phantom's truth."""

from __future__ import annotations

import re
import subprocess
import sys

import pytest
import yaml


def _jobs(project, *targets: str) -> list[dict[str, str]]:
    """Rule, inputs, outputs and command of every job that a dry run plans."""
    text = project.snakemake("-n", "-p", "--cores", "1", *targets, "--quiet", "progress").stdout
    jobs = []
    for block in re.split(r"\n(?=(?:local)?rule )", text)[1:]:
        job = {"rule": re.match(r"(?:local)?rule (\w+):", block)[1], "input": "", "output": "", "command": ""}
        for key in ("input", "output"):
            found = re.search(rf"^    {key}: (.*)$", block, re.M)
            job[key] = found[1] if found else ""
        command = re.search(r"^Shell command: (.*)$", block, re.M)
        job["command"] = command[1] if command else ""
        jobs.append(job)
    return jobs


def test_dry_run_of_a_clean_clone(shipped):
    # how long it takes is measured by benchmarks/workflow.py
    planned = shipped.planned()
    assert planned["fit"] == 12
    assert planned["all"] == 1


def test_no_rule_reads_the_sealed_truth(project):
    jobs = _jobs(project)
    writers = {job["rule"] for job in jobs if "results/phantom/sealed/" in job["output"]}
    assert len(writers) == 6
    assert all(rule.startswith("phantom_") for rule in writers)
    assert [job["rule"] for job in jobs if "sealed" in job["input"]] == []
    commands = [job["command"] for job in jobs if job["rule"] not in writers]
    assert sum("python -m real2sim" in command for command in commands) > 60
    assert not any("sealed" in command for command in commands)


def test_everyone_is_diagnosed_and_the_tables_stand_twice(shipped):
    planned = shipped.planned()
    assert (planned["diagnose"], planned["fit_with_effects"], planned["with_effects"]) == (6, 10, 1)
    unseen = shipped.planned("--config", "diagnosed=unseen")
    assert unseen["diagnose"] == 1
    assert "with_effects" not in unseen


def _compared(project, *options: str) -> dict[str, list[str]]:
    """Plain results that the tables with causes are compared with, and all jobs that are planned, by option or rule."""
    jobs = _jobs(project, "results/paper/with_effects/transfer.csv", *options)
    out = {}
    for job in jobs:
        out.setdefault(job["rule"], []).append(job["command"])
    (command,) = out["with_effects"]
    for option in ("priors", "icc", "cross-trial", "loso"):
        out[option] = re.search(rf" --{option} (.*?) --", command)[1].split()
    return out


def test_the_plain_side_of_the_tables_with_causes_is_the_studys_where_both_rest_on_the_same(project):
    found = _compared(project)
    assert found["priors"][0] == "results/priors/priors.csv"
    assert found["icc"][0] == "results/shareability/icc.csv"
    assert found["loso"] == [f"results/loso/S0{i}.json" for i in range(1, 6)]
    assert not any(name.endswith("_plain_side") for name in found)


def test_third_trials_are_left_out_of_the_plain_side_of_the_tables_with_causes(project):
    project.edit("config/phantom.yaml", "dynamic_trials: 2", "dynamic_trials: 3")
    found = _compared(project)
    assert found["priors"][0] == "results/with_effects/plain/priors/priors.csv"
    assert found["icc"][0] == "results/with_effects/plain/shareability/icc.csv"
    assert found["cross-trial"] == [f"results/with_effects/plain/cross_trial/S0{i}.json" for i in range(1, 6)]
    for rule in ("shareability", "cross_trial", "loso"):
        commands = found[f"{rule}_plain_side"]
        assert all("dynamic_2" in command for command in commands)
        assert not any("dynamic_3" in command or "dynamic_{1,2,3}" in command for command in commands)


def test_people_without_a_diagnosis_are_left_out_of_the_plain_side_of_the_tables_with_causes(project):
    for name in ("S01", "S02", "S03"):
        answer = project.folder / "results" / "diagnosis" / name / "diagnosis.json"
        answer.parent.mkdir(parents=True)
        answer.write_text("{}")
    found = _compared(project, "--config", "diagnosed=unseen")
    assert found["loso"] == [f"results/with_effects/plain/loso/S0{i}.json" for i in (1, 2, 3)]
    (shared,) = found["shareability_plain_side"]
    assert "S03" in shared
    assert not any(name in shared for name in ("S04", "S05", "S06"))
    assert len(found["loso_plain_side"]) == 3
    assert len(found["shareability_with_effects"]) == 1


def test_robots_that_may_have_held_the_strap_are_inputs_of_the_diagnosis_alone(project):
    listed = 'diagnosis={"robots": {"study": "config/study-robot.yaml"}}'
    jobs = _jobs(project, "--config", listed)
    model = "resources/robot/study_planar.xml"
    assert {job["rule"] for job in jobs if model in job["input"]} == {"diagnose"}
    asked = [job["command"] for job in jobs if job["rule"] == "diagnose"]
    assert all(f'"study": {{"model": "{model}", "robot": {{"hold"' in command for command in asked)
    missing = 'diagnosis={"robots": {"study": "config/nowhere.yaml"}}'
    done = project.snakemake("-n", "--cores", "1", "--config", missing, check=False)
    assert done.returncode != 0
    assert "config/nowhere.yaml" in done.stdout
    assert "no such file" in done.stdout


@pytest.mark.parametrize("settings", ["gap", "gap-published"])
def test_people_with_a_sealed_gap_are_written_and_analysed_without_it(project, settings):
    jobs = _jobs(project, "--configfile", f"config/{settings}.yaml")
    assert [job["rule"] for job in jobs].count("diagnose") == 6
    told = [job["command"] for job in jobs if '"gap": {"enabled": true' in job["command"]]
    assert len(told) == 6
    assert not any("sealed" in job["input"] for job in jobs)


def test_motion_is_a_file_per_fitted_trial_and_apart_from_the_study(shipped):
    assert "motion_file" not in shipped.planned()
    # two trials each of five calibration people and of the validation person whose refinement is compared
    assert shipped.planned("motion")["motion_file"] == 12
    without = shipped.planned("motion", "--config", 'refinement={"compare": "never"}')
    assert without["motion_file"] == 10


def test_suite_of_cases_is_apart_from_the_study(project, shipped):
    assert not any(rule.startswith("suite") for rule in shipped.planned())
    kinds = ("suite_cases", "suite_diagnose")
    rules = {f"{kind}_{shard}" for kind in kinds for shard in ("000", "001")} | {
        "score_diagnosis",
        "suite_page",
        "suite",
    }
    assert set(shipped.planned("suite")) == rules
    (project.folder / "config" / "suite-ci.yaml").unlink()
    assert project.planned()["all"] == 1


def test_only_the_score_opens_the_seal_of_a_suite(project):
    jobs = _jobs(project, "suite")
    writers = {job["rule"] for job in jobs if "/sealed/" in job["output"]}
    assert writers == {"suite_cases_000", "suite_cases_001"}
    assert {job["rule"] for job in jobs if "/sealed/" in job["input"]} == {"score_diagnosis"}
    told = {job["rule"] for job in jobs if "sealed" in job["command"]}
    assert told == writers | {"score_diagnosis"}


def test_nothing_but_the_phantom_stage_imports_the_phantom(project):
    library = project.folder / "workflow" / "real2sim"
    importers = [
        path.relative_to(library).as_posix()
        for path in library.rglob("*.py")
        if "verification" not in path.relative_to(library).parts
        and any(
            line.lstrip().startswith(("from real2sim.verification", "import real2sim.verification"))
            for line in path.read_text().splitlines()
        )
    ]
    assert importers == []


def test_phantom_shares_no_code_with_the_identification(project):
    rooms = project.folder / "workflow" / "real2sim" / "verification"
    files = [path for name in ("phantom", "cohort") for path in (rooms / name).rglob("*.py")]
    assert len(files) > 10
    for path in files:
        text = path.read_text()
        for room in (
            "system.plant",
            "system.drive",
            "system.replay",
            "system.description",
            "effects",
            "inference",
            "diagnosis",
            "geometry",
            "study",
            "signals",
            "recording.alignment",
            "recording.ingest",
        ):
            assert f"real2sim.{room}" not in text, f"{path.name} imports {room}"


def test_lint_is_clean(project):
    done = project.snakemake("--lint", check=False)
    assert done.returncode == 0, done.stdout


def test_snakefmt_is_clean(project):
    files = ["Snakefile", *map(str, sorted((project.folder / "workflow" / "rules").glob("*.smk")))]
    done = subprocess.run(
        [sys.executable, "-m", "snakefmt", "--check", "-l", "110", *files],
        cwd=project.folder,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr


def test_zero_people_of_a_cohort_is_refused_with_the_remedy(project):
    done = project.snakemake("-n", "--cores", "1", "--config", "cohort=real", check=False)
    assert done.returncode != 0
    assert "resources/subjects" in done.stdout
    assert "at least one person to calibrate on" in done.stdout
    assert "Traceback" not in done.stdout


@pytest.mark.parametrize(
    ("changed", "place", "found"),
    [
        (
            {"paths": {"robot": "resources/robot/none.xml"}},
            "paths.robot",
            "nothing at resources/robot/none.xml",
        ),
        (
            {"paths": {"published": "resources/elsewhere"}},
            "paths.published",
            "nothing at resources/elsewhere",
        ),
        (
            {"refinement": {"priors": "resources/elsewhere/priors.csv"}},
            "refinement.priors",
            "nothing at resources/elsewhere/priors.csv",
        ),
        # a disk that is not mounted must not end in the phantom's study
        ({"paths": {"subjects": "/mnt/lab/people"}}, "paths.subjects", "nothing at /mnt/lab/people"),
        # Snakemake would take it for a wildcard
        ({"paths": {"subjects": "/mnt/lab {1}/people"}}, "paths.subjects", "/mnt/lab {1}/people"),
        (
            {"quality": {"override": {"S99/dynamic_1": "pilot"}}},
            "quality.override.S99/dynamic_1",
            "no such trial",
        ),
        (
            {"quality": {"override": {"S01/dynamic_9": "pilot"}}},
            "quality.override.S01/dynamic_9",
            "no such trial",
        ),
        ({"identification": {"bounds": {"k_tx": [8000, 150]}}}, "identification.bounds.k_tx", "[8000, 150]"),
        ({"plant": {"timestep_s": 0.003}}, "plant.timestep_s", "0.003 s"),
        ({"statistics": {"common_below": 0.9}}, "statistics.common_below", "[0.9, 0.75]"),
    ],
)
def test_what_contradicts_itself_or_leads_nowhere_is_refused_before_any_job(project, changed, place, found):
    project.configure(**changed)
    done = project.snakemake("-n", "--cores", "1", check=False)
    assert done.returncode != 0
    assert place in done.stdout
    assert f"found:    {found}" in done.stdout


def test_a_number_on_the_command_line_is_told_to_come_in_a_file(project):
    done = project.snakemake("-n", "--cores", "1", "--config", 'identification={"restarts": 3}', check=False)
    assert done.returncode != 0
    assert "but in a file by --configfile" in done.stdout


def test_a_time_step_on_the_command_line_is_told_what_is_allowed(project):
    done = project.snakemake("-n", "--cores", "1", "--config", 'plant={"timestep_s":0.003}', check=False)
    assert done.returncode != 0
    assert "(auto or a number above 0 up to 0.01)" in done.stdout
    assert "but in a file by --configfile" in done.stdout


def test_settings_of_a_suite_that_are_not_there_are_named(project):
    lost = "suite=config/nope.yaml"
    done = project.snakemake("-n", "--cores", "1", "suite", "--config", lost, check=False)
    assert done.returncode != 0
    assert "nothing at config/nope.yaml" in done.stdout
    assert "config/suite-ci.yaml" in done.stdout


def test_unknown_key_is_refused_before_any_job(project):
    project.configure(identification={"evaluatons": 3})
    done = project.snakemake("-n", "--cores", "1", check=False)
    assert done.returncode != 0
    assert "Did you mean 'evaluations'?" in done.stdout


def test_misnamed_trial_is_refused_before_any_job(project):
    folder = project.folder / "resources" / "subjects" / "S09"
    folder.mkdir()
    (folder / "subject.yaml").write_text(
        "id: S09\ncohort: calibration\nsex: male\nage_years: 30\nmass_kg: 80\nheight_m: 1.8\nwaist_m: 0.9\n"
        "tightness: {loosest_cm: 3, tightest_cm: 12, safe_comfortable_cm: 8}\n"
    )
    (folder / "dynamic-1.tsv").write_text("")
    done = project.snakemake("-n", "--cores", "1", check=False)
    assert done.returncode != 0
    assert "dynamic-1.tsv" in done.stdout
    assert "remedy" in done.stdout


def test_the_groups_of_the_cluster_profile_can_be_planned(project):
    """Whatever the executor, Snakemake refuses a group that waits for itself by way of a rule outside it."""
    groups = yaml.safe_load((project.folder / "profiles" / "slurm" / "config.yaml").read_text())["groups"]
    rules = set((project.snakemake("--list-rules", "--quiet", "all").stdout).split())
    assert set(groups) <= rules
    pairs = [f"{rule}={group}" for rule, group in groups.items()]
    project.snakemake("-n", "--cores", "1", "--quiet", "all", "--groups", *pairs)


def test_a_fit_is_told_its_threads(project):
    target = "results/fits/S01/dynamic_1/restart-1.json"
    for threads, options in ((1, ()), (2, ("--set-threads", "fit=2"))):
        # the project's profile does not print commands
        text = project.snakemake(
            target, "-n", "-p", "--cores", "2", "--workflow-profile", "none", *options
        ).stdout
        assert re.findall(r"--threads (\d+)", text) == [str(threads)]


def _add_person(project, name: str, *trials: str) -> None:
    folder = project.folder / "resources" / "subjects" / name
    folder.mkdir()
    (folder / "subject.yaml").write_text(
        f"id: {name}\ncohort: calibration\nsex: male\nage_years: 30\nmass_kg: 80\nheight_m: 1.8\nwaist_m: 0.9\n"
        "tightness: {loosest_cm: 3, tightest_cm: 12, safe_comfortable_cm: 8}\n"
    )
    for trial in trials:
        for suffix in (".tsv", ".mot", ".mcap"):
            (folder / f"{trial}{suffix}").write_text("")


def test_targets_that_nobody_has_the_trials_for_are_refused(project):
    _add_person(project, "S08", "neutral", "dynamic_1")
    for target, found in (
        ("diagnosis", "S08: one dynamic trial, and it takes two"),
        ("motion", "S08: no rotation_T08 and translation_T08"),
        ("twin", "S08: twin.cohort is validation"),
    ):
        done = project.snakemake("-n", "--cores", "1", target, check=False)
        assert done.returncode != 0
        assert f"nobody it can be made for ({found}" in done.stdout
    # the rest of the study goes without a diagnosis
    assert "nobody it can be made for" not in project.snakemake("-n", "--cores", "1", check=False).stdout


def test_a_report_of_nothing_says_what_to_do(project):
    done = project.snakemake("--report", "study.html", check=False)
    assert done.returncode != 0
    assert "without --report first; or name a target that was run" in done.stdout


def test_who_is_left_out_of_a_target_is_told(project):
    _add_person(project, "S08", "neutral", "dynamic_1")
    _add_person(project, "S09", "neutral", "dynamic_1", "dynamic_2")
    text = project.snakemake("-n", "--cores", "1", "diagnosis").stdout
    assert text.count("diagnosis: left out are S08: one dynamic trial, and it takes two.") == 1


def test_person_without_sweeps_is_diagnosed_but_not_identified(project):
    _add_person(project, "S09", "neutral", "dynamic_1", "dynamic_2")
    planned = project.planned("diagnosis")
    assert planned["diagnose"] == 1
    assert not {"joint_limits", "step_study", "fit"} & set(planned)
    done = project.snakemake("-n", "--cores", "1", check=False)
    assert done.returncode != 0
    assert "no trial rotation_T08" in done.stdout
    assert "`snakemake --cores 2 diagnosis` and `snakemake --cores 2 quality` go without" in done.stdout
