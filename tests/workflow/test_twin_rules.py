"""The twin's rules: apart from the study, one training per person and seed, every cohort and seed configurable."""

from __future__ import annotations


def test_twin_is_a_target_of_its_own(project):
    assert not any(rule.startswith("twin") for rule in project.planned())
    planned = project.planned("twin")
    assert planned["twin_train"] == planned["twin_evaluate"] == planned["twin_coupled"] == 3
    assert planned["twin_reference"] == planned["twin_human"] == planned["twin_figure"] == 1
    assert planned["twin_table"] == 1


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
