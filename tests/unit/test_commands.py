"""Every command of the library: its options follow from the annotations of the function that it calls."""

from __future__ import annotations

from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from real2sim import __main__ as command_line
from real2sim.__main__ import COMMANDS, main


@pytest.mark.parametrize("command", sorted(COMMANDS))
def test_options_of_a_command_can_be_told(command, capsys):
    with pytest.raises(SystemExit) as ended:
        main([command, "--help"])
    assert ended.value.code == 0
    assert "--" in capsys.readouterr().out


def test_a_file_that_is_not_there_is_refused_by_its_name_and_option(tmp_path, capsys, monkeypatch):
    def stage(*, traces: list[Path], out: Path) -> None:
        """Read every file."""
        for path in traces:
            pq.read_table(path)

    there, lost = tmp_path / "there.parquet", tmp_path / "lost.parquet"
    pq.write_table(pa.table({"time_s": [0.0]}), there)
    monkeypatch.setattr(command_line, "_load", lambda command: stage)
    assert main(["diagnose", "--traces", str(there), str(lost), "--out", str(tmp_path / "o")]) == 2
    told = capsys.readouterr().err
    assert f"{lost}\n  found:    nothing there\n  expected: what --traces takes" in told
    assert "Traceback" not in told


def test_a_file_that_a_stage_looks_for_itself_is_a_fault_of_ours(tmp_path, capsys, monkeypatch):
    def stage(*, out: Path) -> None:
        """Look for a file that nobody gave."""
        (tmp_path / "own.json").read_text()

    monkeypatch.setattr(command_line, "_load", lambda command: stage)
    assert main(["diagnose", "--out", str(tmp_path / "o")]) == 1
    assert "Traceback" in capsys.readouterr().err
