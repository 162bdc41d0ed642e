"""`snakemake person_<ID>`: planned for everyone, refused with the known names for anyone else, run on the miniature."""

from __future__ import annotations

import json

import mujoco
import pytest

_SUBJECT = (
    "id: {name}\ncohort: {cohort}\nsex: male\nage_years: 30\nmass_kg: 80\nheight_m: 1.8\nwaist_m: 0.9\n"
    "tightness: {{loosest_cm: 3, tightest_cm: 12, safe_comfortable_cm: 8}}\n"
)


def _add(project, name: str, cohort: str, trials: tuple[str, ...]) -> None:
    """A person whose files are empty: enough for a plan."""
    folder = project.folder / "resources" / "subjects" / name
    folder.mkdir()
    (folder / "subject.yaml").write_text(_SUBJECT.format(name=name, cohort=cohort))
    for trial in trials:
        for suffix in (".tsv", ".mot", ".mcap"):
            (folder / f"{trial}{suffix}").write_text("")


SWEPT = ("neutral", "rotation_T08", "translation_T08")


def test_a_person_is_planned_with_a_full_calibration_of_theirs_only_to_compare(project, shipped):
    planned = shipped.planned("person_S06")
    assert planned["fit"] == 12, (
        "the cohort's, behind the priors, and the first unseen person's to compare with"
    )
    for rule in ("refine", "person_interface", "person_page", "diagnose", "person_S06"):
        assert planned[rule] == 1
    assert not {"report_page", "assessment", "noise_floor", "loso", "cross_trial"} & set(planned)
    project.configure(refinement={"compare": "never"})
    assert project.planned("person_S06")["fit"] == 10
    assert project.planned("people")["person_page"] == 1


def test_other_priors_need_no_cohort(project):
    project.configure(refinement={"priors": "resources/published/table1_priors.csv", "compare": "never"})
    planned = project.planned("person_S06")
    assert not {"fit", "priors", "shareability"} & set(planned)
    assert planned["ingest_S06"] == 1
    assert "ingest_S01" not in planned


def test_a_lab_with_nobody_to_calibrate_uses_the_published_priors(project):
    _add(project, "P01", "validation", (*SWEPT, "dynamic_1"))
    project.configure(refinement={"compare": "never"})
    planned = project.planned("person_P01")
    assert not {"fit", "priors", "diagnose"} & set(planned)
    assert planned["refine"] == planned["step_study"] == planned["joint_limits"] == 1
    done = project.snakemake("-n", "--cores", "1", check=False)
    assert done.returncode != 0
    assert "at least one person to calibrate on" in done.stdout
    assert "snakemake --cores 2 person_P01" in done.stdout


def test_a_diagnosis_of_one_trial_is_refused_with_the_remedy(project):
    _add(project, "P01", "validation", (*SWEPT, "dynamic_1"))
    done = project.snakemake("-n", "--cores", "1", "results/diagnosis/P01/diagnosis.html", check=False)
    assert done.returncode != 0
    assert "found:    dynamic_1\n" in done.stdout
    assert "two dynamic trials for a diagnosis" in done.stdout


def test_a_person_without_dynamic_trials_or_sweeps_still_has_a_page(project):
    _add(project, "P01", "validation", SWEPT)
    planned = project.planned("person_P01")
    assert planned["joint_limits"] == planned["refine"] == planned["person_page"] == 1
    assert not {"step_study", "diagnose", "fit"} & set(planned)
    _add(project, "P02", "validation", ("neutral", "dynamic_1"))
    planned = project.planned("person_P02")
    assert planned["refine"] == planned["person_page"] == 1
    assert not {"step_study", "joint_limits", "tightness", "fit"} & set(planned)


def test_an_unknown_person_is_told_who_is_known(project):
    done = project.snakemake("-n", "--cores", "1", "person_S99", check=False)
    assert done.returncode != 0
    assert "no person S99" in done.stdout
    assert "one of S01, S02, S03, S04, S05, S06" in done.stdout
    assert "remedy" in done.stdout


def test_a_person_of_the_miniature_is_made_once(mini):
    # one dynamic trial: the diagnosis, which needs two, has a test of its own
    results = mini.folder / "results"
    refined = json.loads((results / "refined" / "S06.json").read_text())
    assert refined["status"] == "ok"
    assert list(refined["trials"]) == ["dynamic_1"]
    assert refined["phantom"] is True
    assert refined["prior_rests_on_person"] is False
    trial = refined["trials"]["dynamic_1"]
    assert trial["refined"]["J"] <= trial["prior"]["J"]
    assert trial["full"]["restarts"] == 2
    assert trial["against_full"]["J_ratio"] == pytest.approx(trial["refined"]["J"] / trial["full"]["J"])
    model = mujoco.MjModel.from_xml_path(str(results / "people" / "S06" / "interface.xml"))
    assert model.numeric("k_tx").data[0] == refined["parameters"]["k_tx"]["value"]
    assert all(model.joint(f"strap_{axis}").limited[0] for axis in ("tx", "ty", "tz", "rx", "ry", "rz"))
    page = (results / "people" / "S06.html").read_text()
    assert "Interface of S06" in page
    assert "synthetic people" in page
    assert not list(mini.folder.rglob("*sealed*"))
    assert not list(mini.folder.glob("person_*"))
    assert mini.planned("person_S06") == {}
    mini.configure(refinement={"also_free": ["d_ry"]})
    assert {"refine", "person_page"} <= set(mini.planned("person_S06"))
    assert "fit" not in mini.planned("person_S06")
