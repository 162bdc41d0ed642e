"""Configuration, command line and fingerprints."""

from __future__ import annotations

import copy
import logging
import shutil
import subprocess
import time
from pathlib import Path
from types import SimpleNamespace

import pytest
from real2sim import __main__ as cli
from real2sim import provenance
from real2sim.artefacts import read_table
from real2sim.configuration import read_yaml, validated
from real2sim.errors import InputError
from real2sim.failures import FAILED, FailedJobs, failures
from real2sim.inference.parameters import PARAMETERS
from real2sim.shell import braced

ROOT = Path(__file__).parents[2]


def test_shipped_config_is_the_schemas_defaults():
    source = ROOT / "config" / "config.yaml"
    assert validated(read_yaml(source), "config", source) == validated({}, "config", Path("none"))


def test_bounds_are_the_papers():
    bounds = validated({}, "config", Path("none"))["identification"]["bounds"]
    rows = read_table(ROOT / "resources" / "published" / "bounds.csv", ("parameter", "lower", "upper"))
    assert {r["parameter"]: [float(r["lower"]), float(r["upper"])] for r in rows} == {
        name: list(map(float, bounds[name])) for name in PARAMETERS
    }


def test_unknown_key_names_file_place_and_the_nearest_key():
    with pytest.raises(InputError) as caught:
        validated({"identification": {"evaluatons": 5}}, "config", Path("config/mine.yaml"))
    message = str(caught.value)
    assert "config/mine.yaml, identification" in message
    assert "Did you mean 'evaluations'?" in message


def test_wrong_type_names_the_key_and_what_it_means():
    with pytest.raises(InputError, match=r"plant\.timestep_s(.|\n)*Time step"):
        validated({"plant": {"timestep_s": "fast"}}, "config", Path("c.yaml"))


def numbers(value, place=()):
    """Places of all numbers of a configuration."""
    if isinstance(value, dict):
        for key, inner in value.items():
            yield from numbers(inner, (*place, key))
    elif isinstance(value, list):
        for i, inner in enumerate(value):
            yield from numbers(inner, (*place, i))
    elif isinstance(value, int | float) and not isinstance(value, bool):
        yield place


@pytest.mark.parametrize("value", [float("nan"), float("inf"), -float("inf")])
def test_a_number_that_is_none_is_refused_wherever_it_stands(value):
    whole = validated({}, "config", Path("none"))
    places = list(numbers(whole))
    assert len(places) > 300
    for place in places[:: 1 if value != value else 17]:
        changed = copy.deepcopy(whole)
        part = changed
        for key in place[:-1]:
            part = part[key]
        part[place[-1]] = value
        with pytest.raises(InputError) as caught:
            validated(changed, "config", Path("c.yaml"))
        assert str(place[-1]) in caught.value.place


@pytest.mark.parametrize(("rate", "cutoff"), [(100, 50), (100, 60), (20, 12)])
def test_a_cut_off_that_switches_the_low_pass_off_is_refused(rate, cutoff):
    with pytest.raises(InputError, match=r"ingest\.cutoff_hz(.|\n)*less than half of ingest\.rate_hz"):
        validated({"ingest": {"rate_hz": rate, "cutoff_hz": cutoff}}, "config", Path("c.yaml"))


def test_every_key_of_the_schemas_is_described():
    def walk(schema, place):
        for key, sub in schema.get("properties", {}).items():
            assert sub.get("description"), f"{place}.{key} has no description"
            if sub.get("type") == "object":
                assert sub.get("additionalProperties") is not None, f"{place}.{key} takes anything"
            walk(sub, f"{place}.{key}")

    for path in sorted((ROOT / "workflow" / "real2sim" / "schemas").glob("*.yaml")):
        walk(read_yaml(path), path.name)


def test_every_command_can_be_loaded_and_explains_itself(capsys):
    for command in cli.COMMANDS:
        with pytest.raises(SystemExit) as stop:
            cli.main([command, "--help"])
        assert stop.value.code == 0
    assert "--settings" in capsys.readouterr().out


def test_bad_input_ends_with_the_message_and_code_2(tmp_path, capsys):
    code = cli.main(
        [
            "loso-table",
            "--loso",
            str(tmp_path / "absent.json"),
            "--settings",
            "{}",
            "--out",
            str(tmp_path / "o"),
        ]
    )
    assert code == 2
    text = capsys.readouterr().err
    assert "absent.json" in text
    assert "remedy" in text


def test_unknown_command_lists_the_known_ones(capsys):
    assert cli.main(["fitt"]) == 2
    assert "cross-trial" in capsys.readouterr().err


@pytest.fixture
def library(tmp_path, monkeypatch):
    copied = tmp_path / "real2sim"
    shutil.copytree(ROOT / "workflow" / "real2sim", copied, ignore=shutil.ignore_patterns("__pycache__"))
    monkeypatch.setattr(provenance, "LIBRARY", copied)
    yield copied
    _forget()


def _forget():
    provenance._tree.cache_clear()
    provenance.fingerprint.cache_clear()


def _edited(library, file, old, new, module):
    _forget()
    before = provenance.fingerprint(module)
    path = library / file
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new, 1))
    _forget()
    return before != provenance.fingerprint(module)


FIT = "real2sim.study.fit"


@pytest.mark.parametrize(
    ("file", "old", "new", "module", "changes"),
    [
        ("inference/cost.py", "1e6", "2e6", FIT, True),
        ("system/plant.py", "PELVIS_MASS = 1e6", "PELVIS_MASS = 2e6", FIT, True),
        ("geometry.py", "/ 2\n", "/ 2.5\n", FIT, True),
        ("inference/cost.py", '"""Cost', '"""The cost', FIT, False),
        (
            "inference/cost.py",
            "self._half_rate = rate_hz / 2",
            "self._half_rate = rate_hz / 2  # x",
            FIT,
            False,
        ),
        ("pages/style.py", "#0072B2", "#0072B3", FIT, False),
        ("pages/style.py", "#0072B2", "#0072B3", "real2sim.pages.fits", True),
        ("study/transfer.py", "< 2", "< 3", FIT, False),
    ],
)
def test_fingerprint_follows_code_and_nothing_else(library, file, old, new, module, changes):
    assert _edited(library, file, old, new, module) is changes


def test_braced_paths_are_the_paths_and_fit_a_shell():
    paths = [
        f"results/fits/S{person:04d}/{trial}/restart-{restart}.json"
        for person in range(1, 1001)
        for trial in ("dynamic_1", "dynamic_2")
        for restart in range(1, 6)
    ]
    short = braced(paths)
    assert len(short) < 10_000 < 131_072 < len(" ".join(paths))
    uneven = [*paths[:25], "results/fits/S0001/dynamic_3/restart-1.json", "results/other.json"]
    for given in (paths, uneven, paths[:1], []):
        done = subprocess.run(
            ["bash", "-c", f"printf '%s\\n' {braced(given)}"], capture_output=True, text=True, check=True
        )
        assert sorted(done.stdout.split()) == sorted(given)
    with pytest.raises(ValueError, match="a b"):
        braced(["results/a b.json"])


def _record(event: str, **about) -> logging.LogRecord:
    return logging.makeLogRecord({"levelno": logging.ERROR, "event": SimpleNamespace(name=event)} | about)


def test_last_lines_name_what_failed_and_its_log(tmp_path):
    logs = tmp_path / "logs"
    for name, text in (
        (
            "fits/S01.log",
            f"step 1\n{FAILED} 'fit': old\nagain\n{FAILED} 'fit': raw.tsv: empty\n  remedy: record",
        ),
        ("fits/S02.log", "evaluation 12"),
        ("limits/S03.log", "fine"),
    ):
        (logs / name).parent.mkdir(parents=True, exist_ok=True)
        (logs / name).write_text(text)
    heard = FailedJobs()
    hint = " (check log file(s) for error details)"
    group = [{"jobid": i, "rule_name": "loso", "log": [f"loso/{i}.log{hint}"]} for i in (8, 9)]
    for record in (
        _record("JOB_ERROR", jobid=3, rule_name="fit", rule_msg=None, log=[f"{logs}/fits/S02.log{hint}"]),
        _record(
            "JOB_ERROR", jobid=4, rule_name="fit", rule_msg="x", log=[f"{logs}/fits/S01.log{hint}", "s.log"]
        ),
        _record("GROUP_ERROR", groupid="g", job_error_info=group, aux_logs=["slurm/7.log"]),
        _record("JOB_ERROR", jobid=8, rule_name="loso", rule_msg=None, log=["loso/8.log"]),
        _record("JOB_ERROR", jobid=5, rule_name="limits", rule_msg="status NODE_FAIL", log=["l.log"]),
        _record("PROGRESS"),
    ):
        heard.handle(record)
    ended = "ended without a word of its own (killed, out of memory or time?)"
    assert failures(logs, 0.0, heard.jobs) == [
        f"{FAILED} 'fit': raw.tsv: empty\n  remedy: record\n  log:      {logs}/fits/S01.log",
        f"fit: {ended}\n  log:      {logs}/fits/S02.log",
        f"loso: {ended}\n  log:      slurm/7.log\n  log:      loso/8.log\n  log:      loso/9.log",
        f"limits: {ended}\n  found:    status NODE_FAIL\n  log:      l.log",
    ]
    assert failures(logs, time.time() + 60) == []
