"""A miniature study: the real Snakefile on a few small people, run once and copied for each test."""

from __future__ import annotations

import fcntl
import os
import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import pytest
import yaml
from real2sim.provenance import LIBRARY, CodeMemory

from tests.plain_environment import ROOT, plain_environment

# two workers with two threads of BLAS each cost a hundred times what they save; before any test imports numpy
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
TREE = ("Snakefile", "workflow", "config", "resources", "profiles", "environment-lock.txt")
_IGNORE = shutil.ignore_patterns("__pycache__", "*.pyc", ".snakemake")
# The search of a diagnosis with fewer refits, also of pairs
SHORT_SEARCH = {"refits": 8, "refits_close": 1, "pair_refits": 1, "pair_screens": 0, "most_effects": 2}
# Files that take minutes, the longest first. Workers are given files in this order (pyproject.toml), so that none of
# them is left with a long one when all others have ended.
LONG_FILES = (
    "workflow/test_reruns.py",
    "workflow/test_runs.py",
    "workflow/test_diagnosis_rules.py",
    "workflow/test_tutorial.py",
    "workflow/test_person_rules.py",
    "workflow/test_dag.py",
    "workflow/test_documented_commands.py",
    "workflow/test_statistics_rules.py",
    "unit/test_described_systems.py",
    "unit/test_wheel.py",
    "unit/test_examples.py",
    "unit/test_library_page.py",
    "unit/test_identity_gates.py",
    "unit/test_phantom_gap.py",
    "unit/test_machines_compared.py",
    "unit/test_crafted_files.py",
    "fuzz/test_fuzz.py",
    "unit/test_gates.py",
    "unit/test_twin_training.py",
    "unit/test_paper_gap.py",
)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Move the files that take long to the front."""
    place = {ROOT / "tests" / name: i for i, name in enumerate(LONG_FILES)}
    items.sort(key=lambda item: place.get(item.path, len(place)))


@dataclass
class Study:
    """A working copy of the project in a folder of its own."""

    folder: Path

    def snakemake(
        self,
        *arguments: str,
        check: bool = True,
        timeout: float = 2400,
        variables: dict[str, str] | None = None,
    ) -> subprocess.CompletedProcess:
        """Run snakemake there, with further variables; the output of both streams is in ``stdout``."""
        # with its byte code kept, each of the many jobs does not compile the library again
        dropped = ("PYTHONPATH", "PYTHONDONTWRITEBYTECODE", "SNAKEMAKE")
        environment = {k: v for k, v in os.environ.items() if not k.startswith(dropped)} | (variables or {})
        done = subprocess.run(
            [sys.executable, "-m", "snakemake", *arguments],
            cwd=self.folder,
            env=environment,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            timeout=timeout,
            check=False,
        )
        if check and done.returncode != 0:
            raise AssertionError(
                f"snakemake {' '.join(arguments)} ended with {done.returncode}:\n{done.stdout}"
            )
        return done

    def planned(self, *arguments: str) -> dict[str, int]:
        """Jobs per rule that a dry run plans; empty if there is nothing to do."""
        text = self.snakemake("-n", "--cores", "2", *arguments, "--quiet", "rules").stdout
        text = self.snakemake("-n", "--cores", "2", *arguments).stdout if "job" not in text else text
        stats = re.search(r"Job stats:\n(.*?)\n\n", text, re.S)
        if stats is None:
            assert "Nothing to be done" in text, text
            return {}
        rows = [line.split() for line in stats[1].splitlines()[2:]]
        return {row[0]: int(row[1]) for row in rows if row[0] != "total"}

    def copy(self, folder: Path) -> Study:
        """Copy of everything, times of the files included."""
        shutil.copytree(self.folder, folder, symlinks=True)
        return Study(folder)

    def edit(self, file: str, old: str, new: str) -> None:
        """Replace text that must occur in a file."""
        path = self.folder / file
        text = path.read_text(encoding="utf-8")
        assert old in text, f"{old!r} is not in {file}"
        path.write_text(text.replace(old, new, 1), encoding="utf-8")

    def configure(self, **slices: dict) -> None:
        """Change keys of config/config.yaml."""
        path = self.folder / "config" / "config.yaml"
        content = yaml.safe_load(path.read_text(encoding="utf-8"))
        for name, value in slices.items():
            content[name] = content[name] | value if isinstance(value, dict) else value
        path.write_text(yaml.safe_dump(content, sort_keys=False), encoding="utf-8")


def clean_study(folder: Path) -> Study:
    """The project's tracked tree in a new folder, without results."""
    folder.mkdir(parents=True)
    for name in TREE:
        source = ROOT / name
        if source.is_dir():
            shutil.copytree(source, folder / name, ignore=_IGNORE)
        else:
            shutil.copy2(source, folder / name)
    (folder / ".snakemake" / "real2sim").mkdir(parents=True)
    (folder / ".snakemake" / "real2sim" / "code.json").write_text(_code_memory())
    return Study(folder)


@cache
def _code_memory() -> str:
    """What a first start of Snakemake remembers of the code: seconds for each of the many copies of the project."""
    code = CodeMemory()
    for path in sorted(LIBRARY.rglob("*.py")):
        code.of(path)
    with tempfile.TemporaryDirectory() as folder:
        code.save(Path(folder) / "code.json")
        return (Path(folder) / "code.json").read_text()


@pytest.fixture
def project(tmp_path) -> Study:
    """A clean copy of the project as it is shipped."""
    return clean_study(tmp_path / "project")


class Plans:
    """The project as it is shipped, to be planned and not to be changed: each plan is made once."""

    def __init__(self, study: Study):
        self._study = study
        self._known: dict[tuple[str, ...], dict[str, int]] = {}

    def planned(self, *arguments: str) -> dict[str, int]:
        """Jobs per rule, as of `Study.planned`."""
        if arguments not in self._known:
            self._known[arguments] = self._study.planned(*arguments)
        return self._known[arguments]


@pytest.fixture(scope="session")
def shipped(tmp_path_factory) -> Plans:
    """Plans of the project as it is shipped."""
    return Plans(clean_study(tmp_path_factory.mktemp("shipped") / "project"))


def miniature(folder: Path) -> Study:
    """The project with the miniature's people and budget."""
    study = clean_study(folder)
    path = folder / "config" / "phantom.yaml"
    phantom = yaml.safe_load(path.read_text(encoding="utf-8"))
    people = {name: phantom["cohort"][name] for name in ("S01", "S02", "S03", "S06")}
    for person in people.values():
        person["tightness"] = {"loosest_cm": 8, "tightest_cm": 12, "safe_comfortable_cm": 10}
    phantom["cohort"] = people
    phantom["trials"] |= {"sweep_s": 6.0, "dynamic_s": 8.0, "walk_s": 3.0, "walk_robot_trials": 1}
    phantom["trials"] |= {"neutral_s": 5.0}
    path.write_text(yaml.safe_dump(phantom, sort_keys=False), encoding="utf-8")
    study.configure(
        identification={"restarts": 2, "evaluations": 44},
        tightness={"bootstrap": 100, "permutations": 100},
        statistics={
            "bootstrap": 100,
            "min_subjects": 2,
            "study": {"draws": 20, "bootstrap": 50, "people": [5], "power_people": [5, 10]},
        },
        twin={"cohort": "none"},
        diagnosed="unseen",
    )
    return study


def _once(tmp_path_factory, name: str, make: Callable[[Path], None]) -> Path:
    """Folder that the first worker to ask fills and the others wait for."""
    base = tmp_path_factory.getbasetemp()
    # each worker of pytest-xdist has a folder of its own, and all of them are in one
    base = base.parent if "PYTEST_XDIST_WORKER" in os.environ else base
    with (base / f"{name}.lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not (base / f"{name}.done").exists():
            shutil.rmtree(base / name, ignore_errors=True)
            make(base / name)
            (base / f"{name}.done").touch()
    return base / name


def _write_raw(folder: Path) -> None:
    study = miniature(folder)
    people = yaml.safe_load((folder / "config" / "phantom.yaml").read_text())["cohort"]
    study.snakemake("--cores", "2", *[f"results/phantom/sealed/{name}.json" for name in people])
    # with one dynamic trial the person kept for validation is refined, but not diagnosed: that has tests of its own
    with (folder / "results" / "phantom" / "raw" / "S06" / "subject.yaml").open("a") as stream:
        stream.write("exclude: {dynamic_2: left out to be quick}\n")


@pytest.fixture(scope="session")
def _mini_raw(tmp_path_factory) -> Path:
    """Raw exports of the miniature's phantom people."""
    return _once(tmp_path_factory, "raw", _write_raw) / "results" / "phantom" / "raw"


@pytest.fixture(scope="session")
def mini_done(_mini_raw, tmp_path_factory) -> Study:
    """The miniature as a study of people in resources/subjects, run to its end with two cores."""

    def run(folder: Path) -> None:
        study = miniature(folder)
        for name in ("S01", "S02", "S06"):
            shutil.copytree(_mini_raw / name, folder / "resources" / "subjects" / name)
        # as somebody runs it who has environment-lock.txt alone
        study.snakemake("--cores", "2", variables=plain_environment(folder.with_name("plain")))

    return Study(_once(tmp_path_factory, "done", run))


@pytest.fixture
def mini(mini_done, tmp_path) -> Study:
    """A finished miniature study of its own, free to be changed."""
    return mini_done.copy(tmp_path / "mini")


@pytest.fixture
def mini_raw(_mini_raw) -> Path:
    """Folder with the raw exports of the miniature's people S01, S02, S03 and S06."""
    return _mini_raw
