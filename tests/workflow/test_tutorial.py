"""The tutorial's commands, run as they are written by someone who has a clean clone and environment-lock.txt alone.

The budget in config/quick.yaml and the phantom's trials are the miniature's, so that it takes a minute.
"""

from __future__ import annotations

import os
import re
import subprocess
from pathlib import Path

import pytest
import yaml

from tests.conftest import ROOT, miniature
from tests.plain_environment import plain_environment

COMMANDS = re.findall(
    r"^```sh\n(.+?)^```", (ROOT / "docs" / "tutorial.md").read_text(encoding="utf-8"), re.S | re.M
)


def _shell(command: str, folder: Path) -> str:
    done = subprocess.run(
        ["bash", "-euo", "pipefail", "-c", command],
        cwd=folder,
        env=os.environ | plain_environment(folder.parent / "plain"),
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        timeout=2400,
        check=False,
    )
    assert done.returncode == 0, f"{command}\n{done.stdout}"
    return done.stdout


@pytest.fixture(scope="module")
def told(tmp_path_factory) -> tuple[Path, list[str]]:
    """Where the commands were run, and what each of them but the last said."""
    study = miniature(tmp_path_factory.mktemp("tutorial") / "project")
    quick = {"identification": {"restarts": 1, "evaluations": 44}, "statistics": {"bootstrap": 100}}
    quick |= {"tightness": {"bootstrap": 100, "permutations": 100}}
    (study.folder / "config" / "quick.yaml").write_text(yaml.safe_dump(quick), encoding="utf-8")
    assert COMMANDS[-1].startswith("rm -r")
    return study.folder, [_shell(command, study.folder) for command in COMMANDS[:-1]]


@pytest.mark.long
def test_the_tutorial_ends_where_it_says(told):
    folder, said = told
    assert "dynamic_1.mcap" in said[0]
    assert "fit" in said[3]
    assert "Nothing to be done" in said[-1]
    for name in (
        "results/quality/P01/gates.png",
        "results/quality/quality.csv",
        "results/motion/P01/dynamic_1.mcap",
    ):
        assert (folder / name).exists(), name
    page = (folder / "results" / "report.html").read_text(encoding="utf-8")
    assert "P01" in page
    assert "rests on synthetic people" in page, "the files are the phantom's, and say so"
    assert "needs at least 2 people, have 1" in page
    assert not (folder / "results" / "fits" / "S01").exists(), "the phantom steps aside"


@pytest.mark.long
def test_the_person_can_be_taken_out_again(told):
    folder, _ = told
    _shell(COMMANDS[-1], folder)
    assert not (folder / "resources" / "subjects" / "P01").exists()
    assert [p for name in ("results", "logs") for p in (folder / name).rglob("*P01*")] == []


def test_taking_a_person_out_leaves_the_others(tmp_path):
    gone = ["fits/P01/dynamic_1/restart-1.json", "limits/P01.json", "people/P01.html"]
    kept = [
        "fits/P010/dynamic_1/restart-1.json",
        "limits/P02.json",
        "quality/quality.csv",
        "fits/XP01/a.json",
    ]
    for name in (*gone, *kept):
        (tmp_path / "results" / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / "results" / name).write_text("")
    for path in (tmp_path / "resources" / "subjects" / "P01", tmp_path / "logs" / "quality"):
        path.mkdir(parents=True)
    (tmp_path / "logs" / "quality" / "P01_figure.log").write_text("")
    subprocess.run(["bash", "-euo", "pipefail", "-c", COMMANDS[-1]], cwd=tmp_path, check=True)
    left = {
        p.relative_to(tmp_path / "results").as_posix()
        for p in (tmp_path / "results").rglob("*")
        if p.is_file()
    }
    assert left == set(kept)
    assert list((tmp_path / "logs").rglob("P01*")) == []


def test_links_of_the_guides_lead_somewhere():
    pages = [
        ROOT / "docs" / "tutorial.md",
        *(ROOT / "docs").glob("how-to/*.md"),
        ROOT / "docs" / "cluster.md",
    ]
    assert len(pages) >= 6
    for page in [*pages, ROOT / "docs" / "motion.md"]:
        for target in re.findall(r"\]\(([^)#]+?)(?:#[^)]*)?\)", page.read_text(encoding="utf-8")):
            if "://" not in target:
                assert (page.parent / target).exists(), f"{page.name} links to {target}"
