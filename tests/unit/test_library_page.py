"""The lines of docs/library.md run as they are printed."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest
import real2sim

ROOT = Path(__file__).parents[2]


@pytest.fixture
def code() -> str:
    page = (ROOT / "docs" / "library.md").read_text(encoding="utf-8")
    (found,) = re.findall(r"```python\n(.*?)```", page, re.S)
    return found


def test_the_example_of_the_page_is_short_and_asks_for_what_the_library_has(code):
    assert len(code.strip().splitlines()) <= 25
    compile(code, "docs/library.md", "exec")
    (short,) = re.findall(r"^import real2sim as (\w+)$", code, re.M)
    names = set(re.findall(rf"\b{short}\.(\w+)", code))
    assert names
    assert names <= set(real2sim.__all__)


@pytest.mark.long
def test_the_example_of_the_page_names_the_cause(code, tmp_path):
    script = tmp_path / "example.py"
    script.write_text(code, encoding="utf-8")
    done = subprocess.run(
        [sys.executable, script],
        cwd=tmp_path,
        env={"PYTHONPATH": str(ROOT / "workflow"), "PATH": "", "MPLBACKEND": "Agg", "OMP_NUM_THREADS": "1"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr[-2000:]
    verdict, probability = re.search(r"^(\w+) ([01]\.\d+)$", done.stdout, re.M).groups()
    assert verdict == "coulomb"
    assert float(probability) > 0.9
