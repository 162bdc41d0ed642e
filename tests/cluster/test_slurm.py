"""The miniature on a real SLURM of two nodes: same bytes, a node that dies, a job that fails.

Runs where REAL2SIM_SLURM names a script that starts such a cluster on this machine (`slurm-lo start`), and the
interpreter has snakemake-executor-plugin-slurm. It takes about a quarter of an hour.
"""

from __future__ import annotations

import importlib.util
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

from tests.conftest import Study
from tests.workflow.test_runs import RESULTS, _digests

STARTER = os.environ.get("REAL2SIM_SLURM", "")
PLUGIN = importlib.util.find_spec("snakemake_executor_plugin_slurm") is not None
STATE = Path(os.environ.get("SLURM_LO", Path(os.environ.get("TMPDIR", "/tmp")) / "slurm-lo"))

pytestmark = [
    pytest.mark.skipif(not STARTER, reason="REAL2SIM_SLURM does not name a script that starts a SLURM"),
    pytest.mark.skipif(not PLUGIN, reason="snakemake-executor-plugin-slurm is not installed here"),
]


def _ask(*command: str) -> str:
    return subprocess.run(command, capture_output=True, text=True, check=True).stdout


@pytest.fixture
def cluster():
    """Two nodes, up before and after."""
    subprocess.run([STARTER, "start"], check=True)
    yield
    subprocess.run(["scancel", "-u", _ask("id", "-un").strip()], check=False)
    subprocess.run([STARTER, "start"], check=True)


def _unfitted(done: Study, folder: Path) -> Study:
    """The finished miniature, but its fits and what is made of them."""
    study = done.copy(folder)
    (study.folder / "results" / "report.html").unlink()
    for name in (*RESULTS[RESULTS.index("fits") :], "figures"):
        shutil.rmtree(study.folder / "results" / name)
    return study


def _start(study: Study, *targets: str) -> subprocess.Popen:
    command = [
        "timeout",
        "-s",
        "INT",
        "-k",
        "30",
        "1500",
        sys.executable,
        "-m",
        "snakemake",
        "--profile",
        "profiles/slurm",
    ]
    with (study.folder / "run.log").open("w") as stream:
        return subprocess.Popen(
            [*command, *targets], cwd=study.folder, stdout=stream, stderr=subprocess.STDOUT
        )


def _kill_node(node: str) -> int:
    """End a node's daemon, its steps and all that they run, as a loss of power does; how many processes that were."""
    jobs = set(_ask("squeue", "-h", "-w", node, "-o", "%i").split())
    victims = [psutil.Process(int((STATE / "run" / f"slurmd-{node}.pid").read_text()))]
    for process in psutil.process_iter(["cmdline", "environ"]):
        environment, command = process.info["environ"] or {}, " ".join(process.info["cmdline"] or [])
        inside = environment.get("SLURM_JOB_ID") in jobs and process.pid != os.getpid()
        if inside or any(command.startswith(f"slurmstepd: [{job}.") for job in jobs):
            victims.append(process)
    for victim in victims:
        victim.send_signal(signal.SIGKILL)
    return len(victims)


def test_results_are_the_same_bytes_as_locally(cluster, mini_done, tmp_path):
    study = _unfitted(mini_done, tmp_path / "study")
    run = _start(study)
    assert run.wait() == 0, (study.folder / "run.log").read_text()[-3000:]
    assert _digests(study.folder) == _digests(mini_done.folder)
    assert "submitted with SLURM jobid" in (study.folder / "run.log").read_text()


def test_run_outlives_a_node_and_ends_in_the_same_bytes(cluster, mini_done, tmp_path):
    study = mini_done.copy(tmp_path / "study")
    fits = {p: p.read_bytes() for p in (study.folder / "results" / "fits").rglob("*.json")}
    for path in fits:
        path.unlink()
    run = _start(study, *(str(path.relative_to(study.folder)) for path in fits))
    deadline = time.monotonic() + 300
    while "n2" not in _ask("squeue", "-h", "-t", "R", "-o", "%N"):
        assert time.monotonic() < deadline, "nothing ran on n2"
        time.sleep(0.5)
    time.sleep(5)
    lost = _kill_node("n2")
    assert lost > 2, "there was something to kill"
    assert run.wait() == 0, (study.folder / "run.log").read_text()[-3000:]
    assert {path: path.read_bytes() for path in fits} == fits


def test_failing_job_is_named_in_the_last_lines_with_its_log(cluster, mini_done, tmp_path):
    study = mini_done.copy(tmp_path / "study")
    fit = study.folder / "results" / "fits" / "S01" / "dynamic_1"
    shutil.rmtree(fit)
    gates = study.folder / "results" / "quality" / "S01" / "dynamic_1.json"
    content = json.loads(gates.read_text())
    gate = {"gate": "gaps", "message": "a gap of 9 s", "remedy": "Record the trial again."}
    gates.write_text(json.dumps(content | {"refused": [gate]}))
    other = "results/motion/S01/dynamic_2.mcap"
    run = _start(study, "results/fits/S01/dynamic_1/restart-1.json", other)
    assert run.wait() != 0
    end = "\n".join((study.folder / "run.log").read_text().splitlines()[-15:])
    assert "a gap of 9 s" in end
    assert "Record the trial again." in end
    assert "logs/fits/S01/dynamic_1" in end
    assert (study.folder / other).exists(), "the others go on"
