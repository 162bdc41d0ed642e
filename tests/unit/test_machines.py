"""Measured machines: files are checked, records read, small amplitudes of the Silverbox have no cause."""

from __future__ import annotations

import importlib
import sys
from pathlib import Path

import pytest
from real2sim.errors import InputError

HERE = Path(__file__).parents[2]
MEASURED = HERE.parent / "shared" / "measured"
MACHINES = HERE / "examples" / "machines"


@pytest.fixture(name="machine", scope="module")
def _machine():
    sys.path.insert(0, str(MACHINES))
    try:
        yield importlib.import_module("machine")
    finally:
        sys.path.remove(str(MACHINES))


@pytest.fixture(name="data", scope="module")
def _data():
    if not MEASURED.is_dir():
        pytest.skip(f"no measured data: {MEASURED} is missing")
    return MEASURED


def test_every_machine_names_its_files_and_where_they_are_from(machine, tmp_path):
    assert machine.MACHINES == ("emps", "mr_damper", "silverbox")
    for name in machine.MACHINES:
        one = machine.Machine.load(name, tmp_path)
        assert all(len(digest) == 64 for digest in one.content["files"].values())
        for question in one.content["questions"].values():
            assert {question["train"], question["held_out"]} <= one.content["records"].keys()
        with pytest.raises(InputError, match="Put the file there"):
            one.file(next(iter(one.content["files"])))
        assert "Licence" in one.origin


def test_another_file_of_the_name_is_refused(machine, tmp_path):
    (tmp_path / "SNLS80mV.csv").write_text("V1,V2\n0,0\n", encoding="utf-8")
    with pytest.raises(InputError, match="SHA-256"):
        machine.Machine.load("silverbox", tmp_path).file("SNLS80mV.csv")


def test_a_damper_file_that_is_none_is_refused(machine, tmp_path):
    readers = importlib.import_module("readers")
    (tmp_path / "ensaio1.1.mat").write_bytes(b"no MATLAB file")
    with pytest.raises(InputError, match="Ts, dist and forc"):
        readers.mr_damper(tmp_path / "ensaio1.1.mat")


def test_records_are_read_and_their_repeats_tell_the_noise(machine, data):
    damper = machine.Machine.load("mr_damper", data)
    record = damper.recording("cycles_0")
    assert record.rate_hz == pytest.approx(100.0)
    assert len(record.time_s) == 900
    assert 2 < damper.trusting("voltage_0").outputs[0].scatter.sd < 8  # N, of a force that swings by 270 N
    carriage = machine.Machine.load("emps", data)
    assert carriage.recording("two_laps").rate_hz == pytest.approx(200.0)
    # laps differ by 0.34 N; their paths explain a third of it, and of the rest a half is their means
    assert carriage.trusting("friction").outputs[0].scatter.sd == pytest.approx(0.16, abs=0.02)
    assert carriage.trusting("friction").outputs[0].scatter.zero_sd == pytest.approx(0.16, abs=0.02)


def test_small_amplitudes_of_the_silverbox_have_no_cause(machine, data):
    answer = machine.Machine.load("silverbox", data).ask("small")
    assert answer.verdict == "none"
    assert answer.probabilities["none"] > 0.9


def test_the_command_says_where_the_files_come_from(machine, capsys):
    command = importlib.import_module("diagnose")
    assert command.main(["--where"]).empty
    assert "silverbox: SNLS80mV.csv" in capsys.readouterr().out


def test_a_question_that_no_machine_has_is_refused_by_name(machine, tmp_path):
    command = importlib.import_module("diagnose")
    given = [str(tmp_path), "--machine", "silverbox", "--question", "large", "--question", "multisine"]
    with pytest.raises(InputError, match=r"(?s)multisine.*large \(silverbox\), small"):
        command.main(given)
