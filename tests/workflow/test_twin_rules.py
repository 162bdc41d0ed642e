"""The twin's rules: the validation person's in the study, one training per person and seed, all configurable."""

from __future__ import annotations


def test_the_study_validates_on_a_twin_of_the_person_kept_for_it(shipped):
    planned = shipped.planned()
    assert planned["twin_train"] == planned["twin_evaluate"] == planned["twin_coupled"] == 3
    assert planned["twin_reference"] == planned["twin_human"] == 1
    assert planned["gait_figure"] == planned["interface_figure"] == planned["twin_table"] == 1


def test_a_study_without_reinforcement_learning(project):
    project.configure(twin={"cohort": "none"})
    planned = project.planned()
    assert not any(rule.startswith("twin") for rule in planned)
    assert planned["claims"] == planned["paper_tables"] == planned["report_page"] == 1


def test_everyone_gets_a_twin_where_asked_for(project):
    project.configure(twin={"cohort": "all", "seeds": [4, 5]})
    planned = project.planned("twin")
    assert planned["twin_train"] == 12
    assert planned["twin_reference"] == 6


def test_no_twin_reads_the_sealed_truth(project):
    text = project.snakemake("-n", "-p", "--cores", "1", "twin", "--quiet", "progress").stdout
    commands = [line for line in text.splitlines() if "real2sim twin-" in line]
    assert len(commands) >= 12
    assert not any("sealed" in command for command in commands)
