"""A suite that was stopped goes on where it was, and says beforehand how long it takes."""

from __future__ import annotations

from pathlib import Path

import pytest
import yaml
from real2sim.artefacts import read_json, write_json
from real2sim.configuration import validated
from real2sim.verification import answers as answers
from real2sim.verification.suite import plan

ROOT = Path(__file__).parents[2]
ROBOT = ROOT / "resources/robot/drba.xml"


@pytest.fixture
def shard(tmp_path, monkeypatch):
    """Three raw cases and a stand-in for the diagnosis, which counts what it is asked."""
    cases = [tmp_path / "raw" / f"C000{i}" for i in range(3)]
    for case in cases:
        case.mkdir(parents=True)
        (case / "dynamic_1.tsv").write_text(case.name)
    asked: list[str] = []

    def answer(folder, robot, settings, target):
        asked.append(folder.name)
        if settings.get("fails_at") == folder.name:
            raise KeyboardInterrupt
        if settings.get("breaks_at") == folder.name:
            raise ValueError("no such luck")
        write_json(target, {"subject": folder.name})

    monkeypatch.setattr(answers, "_answer", answer)

    def run(**settings):
        asked.clear()
        out = tmp_path / "answers.json"
        answers.diagnose_cases(cases=cases, robot=ROBOT, settings=settings, work=tmp_path / "cases", out=out)
        written = read_json(out)
        assert len(written["answers"]) + len(written["failed"]) == 3
        return list(asked)

    return cases, asked, run


def test_an_interrupted_shard_goes_on(shard, tmp_path):
    _, asked, run = shard
    with pytest.raises(KeyboardInterrupt):
        run(fails_at="C0002")
    assert asked == ["C0000", "C0001", "C0002"]
    (tmp_path / "cases/C0002").mkdir(exist_ok=True)
    with pytest.raises(KeyboardInterrupt):
        run(fails_at="C0002")
    assert asked == ["C0002"]


def test_answers_to_other_recordings_or_settings_are_given_anew(shard):
    cases, _, run = shard
    assert run() == ["C0000", "C0001", "C0002"]
    assert run() == []
    (cases[1] / "dynamic_1.tsv").write_text("another recording")
    assert run() == ["C0001"]
    assert run(noise_draws=3) == ["C0000", "C0001", "C0002"]


def test_a_case_that_breaks_takes_no_other_along_and_is_asked_again(shard, tmp_path):
    _, _, run = shard
    assert run(breaks_at="C0001") == ["C0000", "C0001", "C0002"]
    written = read_json(tmp_path / "answers.json")
    assert [Path(name).parent.name for name in written["answers"]] == ["C0000", "C0002"]
    assert written["failed"] == [{"case": "C0001", "error": "ValueError: no such luck"}]
    (tmp_path / "cases/C0001").mkdir(exist_ok=True)
    assert run(breaks_at="C0001") == ["C0001"]


def test_expected_time_is_cases_times_seconds_over_cores(tmp_path):
    source = ROOT / "config/suite-ci.yaml"
    suite = validated(yaml.safe_load(source.read_text()), "suite", source)
    blind = plan.expected_time(suite, tmp_path, 1)
    assert "40 cases" in blind
    assert f"about {round(40 * (plan.ANSWER_S + plan.WRITE_S) / 60)} min" in blind
    done = plan.case_names(suite, 0)
    for name in done:
        write_json(tmp_path / "ci/cases" / name / "seconds.json", {"seconds": 25.0})
    write_json(tmp_path / "ci/sealed/000.json", {"cases": []})
    text = plan.expected_time(suite, tmp_path, 2)
    left = 40 - len(done)
    assert f"{len(done)} answered already" in text
    assert f"measured on {len(done)} cases here" in text
    assert f"about {-(-left * 30 // 120):.0f} min left" in text
