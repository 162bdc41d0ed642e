"""Damaged files of every format; REAL2SIM_FUZZ sets how many (2000 here, 20000 each night)."""

import json
import os
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[2]
COUNT = int(os.environ.get("REAL2SIM_FUZZ", "2000"))


def test_damaged_files_are_read_or_refused(tmp_path):
    environment = os.environ | {"PYTHONPATH": os.pathsep.join([str(ROOT / "workflow"), str(ROOT)])}
    command = [sys.executable, "-W", "error", "-m", "tests.fuzz.run", str(COUNT), str(tmp_path)]
    done = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, f"input left in {tmp_path}: {done.stderr[-2000:]}"
    summary = json.loads(done.stdout.splitlines()[-1])
    print(summary)
    assert summary["failures"] == []
    assert summary["inputs"] == COUNT
    assert (
        min(summary["read"], summary["refused"]) > COUNT / 10
    )  # damage that is always or never refused shows nothing
    assert summary["peak_mb"] < 500
