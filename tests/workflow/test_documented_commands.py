"""Every snakemake command that a page shows can be planned, in a clean clone with environment-lock.txt alone."""

from __future__ import annotations

import os
import re
import subprocess
from pathlib import Path

import pytest

from tests.conftest import ROOT, clean_study
from tests.plain_environment import plain_environment

PAGES = [ROOT / "README.md", ROOT / "config" / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
# Files and people of the reader, that a clean clone does not have
READERS_OWN = ("config/mine.yaml", "my.yaml", "S07", "<")
# The tutorial's own test runs these, in the order of the page
RUN_ELSEWHERE = ROOT / "docs" / "tutorial.md"


def commands() -> list[str]:
    """Return the commands of all pages, each once, comments and formatting removed."""
    found: dict[str, None] = {}
    for page in PAGES:
        if page == RUN_ELSEWHERE:
            continue
        text = page.read_text(encoding="utf-8")
        lines = re.findall(r"^(?: {4})?(snakemake --cores [^\n]+)$", text, re.M)
        for command in (*lines, *re.findall(r"`(snakemake --cores [^`\n]+)`", text)):
            plain = command.split("  #")[0].strip()
            if not any(own in plain for own in READERS_OWN):
                found[plain] = None
    return list(found)


@pytest.fixture(scope="module")
def clone(tmp_path_factory) -> tuple[Path, dict[str, str]]:
    folder = tmp_path_factory.mktemp("documented")
    return clean_study(folder / "project").folder, os.environ | plain_environment(folder / "plain")


def test_pages_show_the_commands_that_people_need():
    shown = commands()
    assert len(shown) >= 10
    for target in ("diagnosis", "motion", "twin", "quality", "person_S06", "suite"):
        assert any(re.search(rf" {target}\b", command) for command in shown), target


@pytest.mark.parametrize("command", commands())
def test_a_documented_command_can_be_planned(clone, command):
    folder, variables = clone
    done = subprocess.run(
        ["bash", "-euo", "pipefail", "-c", command.replace("snakemake ", "snakemake -n --quiet all ", 1)],
        cwd=folder,
        env=variables,
        capture_output=True,
        text=True,
        timeout=300,
        check=False,
    )
    assert done.returncode == 0, f"{command}\n{done.stdout}{done.stderr}"


def test_the_readmes_bundle_of_the_report_is_made(mini, tmp_path):
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    command = next(c for c in re.findall(r"`(snakemake --report [^`]+)`", readme))
    mini.snakemake(*command.split()[1:], variables=plain_environment(tmp_path / "plain"))
    bundle = (mini.folder / command.split()[-1]).read_text(encoding="utf-8")
    assert "report.html" in bundle
    assert "priors" in bundle


@pytest.mark.parametrize(
    "target", ["results/diagnosis/S99/diagnosis.json", "results/fits/S99/dynamic_1/restart-1.json"]
)
def test_a_file_of_nobody_is_refused_in_plain_words(clone, target):
    folder, variables = clone
    command = ["snakemake", "-n", "--cores", "2", target]
    done = subprocess.run(
        command, cwd=folder, env=variables, capture_output=True, text=True, timeout=300, check=False
    )
    assert done.returncode != 0
    said = done.stdout + done.stderr
    assert "no person S99 in resources/subjects" in said
    assert "expected: one of S01" in said
