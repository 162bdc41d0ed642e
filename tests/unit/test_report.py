"""The report of a study: whole, valid, self-contained, and usable in a browser without a network."""

from __future__ import annotations

import base64
import json
import re
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path

import pytest
from real2sim.artefacts import read_json, read_table, write_json, write_table
from real2sim.pages.front import front
from real2sim.pages.report.foot import _search
from real2sim.pages.report.page import report_page
from real2sim.pages.report.parts import FIGURES
from real2sim.pages.validation import RECORD_KEYS, SINGLE, SURE, SURE_SINGLE, claim_words, target_words
from real2sim.study.paper.claims import SET
from real2sim.study.paper.with_effects import PRIOR_COLUMNS, TRANSFER_COLUMNS
from synthetic_study import REMEDY, write_refined, write_study
from test_pages import _diagnosis, _Page

from tests.browser import AXE, browser, chromium, judged_by_axe

WIDTHS = (400, 1400)


def _report(folder: Path, diagnosed: bool = True, **changes) -> tuple[Path, dict]:
    arguments = write_study(folder, **changes)
    diagnoses = []
    if diagnosed:
        diagnoses = [folder / "diagnosis.json"]
        write_json(diagnoses[0], _diagnosis())
    out = folder / "report.html"
    report_page(**arguments, title="Study <one> & all", out=out, diagnoses=diagnoses)
    return out, arguments


@pytest.fixture(scope="module")
def report(tmp_path_factory) -> tuple[Path, dict]:
    return _report(tmp_path_factory.mktemp("report"))


def _parsed(path: Path) -> tuple[_Page, str]:
    content = path.read_text(encoding="utf-8")
    page = _Page()
    page.feed(content)
    return page, content


def test_page_is_whole_and_loads_nothing(report):
    page, content = _parsed(report[0])
    assert page.open == []
    assert len(page.ids) == len(set(page.ids))
    assert all(r.startswith("data:") or r[1:] in page.ids for r in page.references)
    assert all(r in page.ids for r in re.findall(r"url\(#([^)]+)\)", content))
    assert not re.search(r"https?:|@import|url\((?!#)|\bnan\b", re.sub(r"data:[^\"]+", "", content))
    assert page.headings[0] == 1
    assert page.headings.count(1) == 1
    assert page.wordless == 0
    assert "1 warning from reading the files" in page.text
    assert "the person faces 40 deg to the <left>" in page.text
    assert "Study <one> & all" in page.text
    # a character that was escaped twice would be read as its code
    assert not re.search(r"&(#?\w+);", page.text)


def test_every_part_of_the_study_is_told(report):
    page, _ = _parsed(report[0])
    for heading in (
        "cohort",
        "quality",
        "tightness",
        "identification",
        "priors",
        "validation",
        "diagnosis",
        "claims",
        "paper-gap",
        "provenance",
    ):
        assert heading in page.ids
    assert (
        "4 people are calibrated and 1 kept for validation; of 15 trials 5 are warned about and 5 refused"
        in page.text
    )
    assert "3 times what noise alone costs" in page.text
    assert "24 of 96 values are determined" in page.text
    assert REMEDY in page.text
    assert "a dynamic trial with holds" in page.text
    assert "0123456789abcdef" in page.text
    assert "Slack causes the gap" in page.text
    assert "1.28" in page.text, "the paper's own cost"
    assert all(about.split(".")[0] in page.text for _, about in FIGURES.values())
    assert "5 of 6 bars of the simulated walkers are met" in page.text
    assert "S99, seed 1" in page.text
    assert "24 of 24" in page.text, "walkers that stayed up"
    assert "cannot be told" in page.text
    assert "only k_ty, d_tx are refined" in page.text
    assert "1.0 %" in page.text, "refined above full"
    assert "Regression on mass kg, height m, waist m: needs at least 30 people, have 4" in page.text
    assert "inconsistent within the paper" in page.text


def test_every_table_and_figure_can_be_taken_away(report):
    path, given = report
    content = path.read_text(encoding="utf-8")
    links = dict(re.findall(r'download="([^"]+)" href="data:[^;]+;base64,([^"]+)"', content))
    files = {
        p.name: p
        for name, p in given.items()
        if name not in ("tightness", "people") and not isinstance(p, list)
    }
    files |= {p.name: p for p in given["figures"]}
    assert {name: base64.b64decode(data) for name, data in links.items()} == {
        name: file.read_bytes() for name, file in files.items()
    }


def test_a_section_stands_where_what_it_tells_of_exists(tmp_path):
    page, content = _parsed(_report(tmp_path, diagnosed=False)[0])
    assert "diagnosis" not in page.ids
    assert "Diagnosis" not in content


def _with_causes(folder: Path, given: dict, *, same_trials: str | None = None) -> tuple[_Page, str]:
    """Report of a study whose first claim is 17.5 with the causes, and ``same_trials`` by the plain fits beside it."""
    tables = [folder / "table1_priors.csv", folder / "transfer.csv", folder / "claims.csv"]
    searches = {"search_plain": "CMA-ES", "search_with_effects": "least squares"}
    priors = {"parameter": "k_tx", "n_subjects": "5", "n_with_a_cause": "4"}
    priors |= {"source_with_effects": "published (Table I)", "status_with_effects": "needs more people"}
    write_table(tables[0], PRIOR_COLUMNS, [dict.fromkeys(PRIOR_COLUMNS, "2.5") | priors | searches])
    moved = {"says": "J of a fit on its own trial", "published": ""}
    write_table(tables[1], TRANSFER_COLUMNS, [dict.fromkeys(TRANSFER_COLUMNS, "0.5") | moved | searches])
    claims = read_table(given["claims"])
    columns = tuple(claims[0])
    assert claims[0]["here"] not in ("17.5", same_trials)
    changed = claims[0] | {"here": "17.5", "verdict": "reproduced only so"}
    write_table(tables[2], columns, [changed, *claims[1:]])
    plain = folder / "plain.csv"
    write_table(plain, columns, [claims[0] | ({"here": same_trials} if same_trials else {}), *claims[1:]])
    out = folder / "report.html"
    report_page(**given, title="Explained", out=out, explained=[*tables, plain])
    return _parsed(out)


def test_claims_of_suites_are_named_in_plain_words():
    records = [read_json(path) for path in sorted(Path("resources/validation").glob("*.json"))]
    names = {row["claim"] for record in records for row in record["claims"]}
    words = {name: claim_words(name) for name in names}
    assert len(names) > 50
    assert len(set(words.values())) == len(names)
    inside = ("rho", "top-", "in library", "mixture", "exact set", "random law", "left out", "K, D", "null")
    assert not [text for text in words.values() if any(label in text for label in inside)]
    assert not [
        t for record in records for row in record["claims"] if "rho" in (t := target_words(row["target"]))
    ]


@pytest.mark.parametrize(
    ("spreads", "verdict"),
    [
        ((4.0, 7.0), "reproduced in its direction and not in its size"),
        ((4.0, 10.0), "reproduced"),
        ((12.0, 4.0), "not reproduced"),
    ],
)
def test_the_lead_says_whether_the_cloud_is_reproduced_with_each_robot(report, tmp_path, spreads, verdict):
    """Under the prior the ratios of the seeds are 3 over 6, 7 and 8: 0.375 to 0.5; another robot is wider forward."""
    measured = dict(zip(("sigma_x_mm", "sigma_y_mm"), spreads, strict=True)) | {
        "gamma": spreads[0] / spreads[1]
    }
    table2 = read_table(report[1]["interface"])
    measured_row = next(row for row in table2 if row["condition"] == "walk_robot")
    measured_row |= {key: str(value) for key, value in measured.items()}
    write_table(tmp_path / "table2.csv", list(table2[0]), table2)
    rows = read_table(report[1]["clouds"])
    other = [
        row | {"robot": "compliant", "main": "false", "gamma": "" if row["seed"] == "1" else "2.5"}
        for row in rows
        if row["condition"] == "prior"
    ]
    write_table(tmp_path / "clouds.csv", list(rows[0]), [*rows, *other])
    out = tmp_path / "report.html"
    changed = {"interface": tmp_path / "table2.csv", "clouds": tmp_path / "clouds.csv"}
    report_page(**report[1] | changed, title="Study", out=out)
    text = _parsed(out)[0].text
    assert f"With the study robot it is {verdict}: 0.435 (mean of 3 seeds, 0.375 to 0.5)." in text
    side = "not reproduced" if spreads[0] < spreads[1] else "reproduced in its direction and not in its size"
    assert (
        f"With the compliant robot it is {side}: 2.5 (mean of 2 seeds, 2.5 to 2.5; in 1 more all walkers fell)."
        in text
    )


def test_claims_say_their_criterion_and_what_was_put_in(report, tmp_path):
    rows = read_table(report[1]["claims"])
    rows[0] |= {"verdict": "reproduced", "criterion": "as many people are kept"}
    rows[1] |= {"here": "0.0005", "unit": "p-value"}
    write_table(tmp_path / "claims.csv", list(rows[0]), rows)
    out = tmp_path / "report.html"
    report_page(**report[1] | {"claims": tmp_path / "claims.csv"}, title="Study", out=out)
    page, content = _parsed(out)
    made = sum(row["verdict"] == SET for row in rows)
    assert made >= 6
    assert f"{len(rows) - made} claims are tested" in page.text
    assert f"{made} more are not tested" in page.text
    assert "Criterion: as many people are kept" in page.text
    assert '<td class="number">p = 0.0005</td>' in content


def test_tables_with_the_causes_stand_beside_the_plain_ones(report, tmp_path):
    page, _ = _with_causes(tmp_path, report[1])
    assert page.text.count("reproduced only so") == 1
    assert page.text.count("17.5") == 1
    assert "The same with the diagnosed causes in the model" in page.text
    assert "4 of 5 calibration people have a diagnosed cause" in page.text
    assert "the plain one by CMA-ES, the one with causes by least squares" in page.text
    assert "Same trials" not in page.text
    assert "Dash: no prior of the fits (needs more people)." in page.text
    assert "transfer.csv" in page.text


def test_what_costs_less_than_a_fit_says_that_its_search_has_not_converged(report, tmp_path):
    assert "Searches have not converged" not in _parsed(report[0])[0].text
    rows = read_table(report[1]["loso"])
    rows[0]["overhead_J_percent"] = "-8.1"
    write_table(tmp_path / "loso.csv", list(rows[0]), rows)
    out = tmp_path / "report.html"
    report_page(**report[1] | {"loso": tmp_path / "loso.csv"}, title="Study", out=out)
    text = _parsed(out)[0].text
    assert f"{rows[0]['subject']} (prior of the others \N{MINUS SIGN}8.1 %)" in text
    half = write_refined(tmp_path / "refined.json", ratio=0.52)
    report_page(**report[1] | {"refined": [half]}, title="Study", out=out)
    assert "S99 (dynamic_1 from the priors \N{MINUS SIGN}48 %)" in _parsed(out)[0].text


def test_verdicts_on_other_values_than_the_fits_say_so(report, tmp_path):
    _, given = report
    assert "the search ended early" not in _parsed(report[0])[1]
    rows = read_table(given["identifiability"])
    for row in rows:
        if (row["subject"], row["trial"]) == ("S02", "dynamic_1"):
            row["fitted"] = str(1.2 * float(row["value"]))
        elif row["verdict"] != "determined":
            row["fitted"] = str(2 * float(row["value"]))
    write_table(tmp_path / "identifiability.csv", list(rows[0]), rows)
    changed = given | {"identifiability": tmp_path / "identifiability.csv"}
    report_page(**changed, title="Far", out=tmp_path / "far.html", diagnoses=[])
    page, _ = _parsed(tmp_path / "far.html")
    assert "In 1 of 8 trials (S02 dynamic 1) they moved" in page.text
    assert "identification.evaluations" in page.text


def test_tables_name_the_configured_share_and_what_was_not_regressed(report, tmp_path):
    _, given = report
    assert "95 % spread" in _parsed(report[0])[0].text
    changes = {}
    for name, of_ok in (("priors", {}), ("anthropometrics", {"status": "ok", "exponent": "0.5"})):
        rows = [row | {"confidence": "0.9"} | of_ok for row in read_table(given[name])]
        if of_ok:
            rows[0] |= {"status": "no variance: all people are equal", "exponent": ""}
        changes[name] = tmp_path / f"{name}.csv"
        write_table(changes[name], list(rows[0]), rows)
    report_page(**given | changes, title="", out=tmp_path / "x.html", diagnoses=[])
    page, _ = _parsed(tmp_path / "x.html")
    for said in ("90 % spread", "Next person (90 %)", "90 % interval"):
        assert said in page.text
    assert "No regression of k_tx: no variance: all people are equal." in page.text


def test_the_foot_names_the_search_that_was_made():
    own = {"screen": 13, "iterations": 25, "ftol": 1e-6}
    ident = {"restarts": 5, "evaluations": 1200, "seed": 1, "least_squares": own}
    settings = {"identification": ident, "plant": {"timestep_s": 0.01}}
    said = {method: _search({"method": method, "settings": settings}) for method in ("cma", "least_squares")}
    assert said["cma"] == "cma, 5 restarts of 1200 evaluations, seed 1, time step 0.01 s"
    assert "5 restarts of at most 25 iterations from the best of 13 starts" in said["least_squares"]
    assert "1200" not in said["least_squares"]


def test_no_answer_is_given_where_no_regression_was_made(report, tmp_path):
    _, given = report
    record = read_json(given["tightness"])
    record["pooled"]["dx"] = {"unit": "mm", "n_subjects": 0, "status": "needs at least 6 levels, have 0"}
    write_json(tmp_path / "cohort.json", record)
    report_page(
        **given | {"tightness": tmp_path / "cohort.json"}, title="", out=tmp_path / "x.html", diagnoses=[]
    )
    assert "needs at least 6 levels, have 0</td><td>\N{EN DASH}<" in (tmp_path / "x.html").read_text()


def test_intervals_of_a_model_that_lacks_something_say_so(report, tmp_path):
    said = "These intervals hold for a model that lacks nothing"
    assert said in _parsed(report[0])[0].text
    write_json(tmp_path / "diagnosis.json", _diagnosis("none"))
    out = tmp_path / "report.html"
    report_page(**report[1], title="Study", out=out, diagnoses=[tmp_path / "diagnosis.json"])
    assert said not in _parsed(out)[0].text


def test_claims_by_the_plain_fits_of_fewer_trials_have_a_column(report, tmp_path):
    page, content = _with_causes(tmp_path, report[1], same_trials="913")
    assert content.count('<td class="number">913</td>') == 1
    assert "Same trials: the value, where it differs from Here" in page.text
    assert "With causes: the value, where it differs from Same trials" in page.text


def test_of_many_people_the_page_tells_of_all_together(report, tmp_path, monkeypatch):
    path, given = report
    for module in ("parts", "identification", "diagnoses"):
        monkeypatch.setattr(f"real2sim.pages.report.{module}.MANY_PEOPLE", 2)
    monkeypatch.setattr("real2sim.pages.report.foot.MANY_FILES", 2)
    out = tmp_path / "report.html"
    write_json(tmp_path / "diagnosis.json", _diagnosis())
    diagnoses = [tmp_path / "diagnosis.json"] * 3
    report_page(**given, title="Many", out=out, diagnoses=diagnoses)
    page, content = _parsed(out)
    assert page.open == []
    assert page.text.count("5 people, one by one") == 6
    assert "The verdicts on 4 people one by one stand in the table below" in page.text
    assert "Parameters of S01" not in page.text
    assert "The answers for 3 people, and how many have each: slack (3)" in page.text
    assert "The first 2 of them:" in page.text
    assert "each fit file names its own" in page.text
    assert len(content) < len(path.read_text(encoding="utf-8"))


def test_of_one_person_the_page_tells_no_median(report, tmp_path):
    out = tmp_path / "report.html"
    write_json(tmp_path / "diagnosis.json", _diagnosis())
    report_page(**report[1], title="One", out=out, diagnoses=[tmp_path / "diagnosis.json"])
    text = _parsed(out)[0].text
    assert "The answer for the one person who was diagnosed: slack. What was found" in text
    assert "above noise." in text


def _record(path: Path, seed: int, share: float) -> Path:
    claim = {"claim": "top-1, rho = 0.05", "value": share, "n": 40, "wilson95": [share - 0.1, share + 0.05]}
    other = {"claim": "expected calibration error", "value": 0.033, "n": 40, "wilson95": None}
    claims = [claim | {"target": ">= 80 %", "met": True}, other | {"target": "<= 0.04", "met": True}]
    about = {
        "suite": "standard",
        "seed": seed,
        "rests_on": "phantom: synthetic",
        "cases": 120,
        "planned": 240,
    }
    about |= {"commit": "abc1234", "note": "Stopped for time.", "date": f"2026-11-{seed}"}
    write_json(path, about | {"claims": claims})
    return path


def test_answers_stand_beside_how_often_such_answers_are_right(tmp_path):
    arguments = write_study(tmp_path)
    answer = tmp_path / "diagnosis.json"
    write_json(answer, _diagnosis())
    records = [_record(tmp_path / "old.json", 10, 0.5), _record(tmp_path / "new.json", 20, 0.9)]
    out = tmp_path / "report.html"
    report_page(**arguments, title="S", out=out, diagnoses=[answer], validation=records)
    page, _ = _parsed(out)
    assert page.open == []
    assert "one cause, visibility 0.05: named first" in page.text
    first = page.text.index("Suite standard, seed 20: 120 of 240 cases answered. Stopped for time.")
    assert "Code of commit abc1234, 2026-11-20" in page.text[first : first + 250]
    assert first < page.text.index("An earlier one: suite standard, seed 10")
    assert "80 % to 95 %" in page.text
    assert "None of them is a recording of a person" in page.text
    # another suite of a later day does not stand for it
    other = read_json(records[1]) | {"suite": "freeform", "date": "2026-11-30"}
    other["claims"] = [other["claims"][0] | {"claim": "random law: unknown, or an equal law"}]
    write_json(tmp_path / "other.json", other)
    report_page(
        **arguments, title="S", out=out, diagnoses=[answer], validation=[*records, tmp_path / "other.json"]
    )
    page, _ = _parsed(out)
    assert "a law that nobody listed: unknown, or a cause that closes as much" in page.text
    assert "one cause, visibility 0.05: named first" in page.text
    assert page.text.count("An earlier one") == 1


def _stages(text):
    """People of each stage on the front, by its name."""
    items = re.findall(
        r"<li(?: class=\"here\")?><span>(.*?)</span>.*?(?:<strong>|\"small\">)([^<]*)</[a-z]*></li>", text
    )
    return dict(items)


def test_the_front_answers_the_question_of_the_study():
    first, second = _diagnosis(), _diagnosis()
    second |= {"subject": "S02", "next_trial": "sway in pitch"}
    claims = [
        {"claim": "every answer surer than 90 %: right", "value": 0.92, "n": 38, "wilson95": [0.79, 0.97]},
        {"claim": "false alarm on null", "value": None, "n": 0},
    ]
    old = {"date": "2026-01-01", "suite": "a", "claims": [claims[0] | {"value": 0.1}]}
    before = {"date": "2026-11-26 08:59", "suite": "b", "claims": [claims[0] | {"value": 0.5}]}
    fresh = {"date": "2026-11-26 10:05", "suite": "b", "claims": claims}
    later = {"date": "2026-11-27", "suite": "c", "claims": [{"claim": "other", "value": 1.0, "n": 3}]}
    text = front([first, second], [before, old, fresh, later])
    assert "slack: everyone (92 %)." in text
    assert _stages(text) == {
        "input chain": "nobody",
        "interface law": "everyone",
        "robot side": "nobody",
        "output chain": "nobody",
    }
    elsewhere = second | {"where": second["where"] | {"stage": "robot"}}
    assert _stages(front([first, elsewhere], []))["robot side"] == "S02"
    counted = "whatever the cause (right: exactly the cause, of two both): 92 % [79 %, 97 %] of 38 right (2026-11-26)"
    assert counted in text
    assert "largest suite" not in text, "of as many cases: the later one counts"
    assert "given one" not in text
    assert "S02: sway in pitch." in text
    assert front([], []) == ""
    nothing = front([first], [later])
    assert "synthetic people" not in nothing
    assert "<ul></ul>" not in nothing
    nobody = _diagnosis() | {"verdict": "none", "verdict_set": ["none"], "next_trial": None}
    nobody["probabilities"] = {"none": 1.0}
    assert "Nowhere that these recordings show." in front([nobody], [])
    assert "Nothing more" in front([nobody], [])


def test_the_front_puts_the_largest_suite_beside_the_latest():
    def suite(date, share, n, claim="left out: a wrong name surer than 90 %"):
        row = {"claim": claim, "value": share, "n": n, "wilson95": [share, share + 0.1]}
        return {"date": date, "suite": "a", "claims": [row]}

    records = [
        suite("2026-11-28 09:05", 0.2, 32),
        suite("2026-11-30 01:57", 0.0, 10),
        suite("2026-11-29", 0.1, 31),
    ]
    text = front([_diagnosis()], records)
    assert "a name of the same group that closes as much counts as right" in text
    latest = "0 % [0 %, 10 %] of 10 answers a wrong name surer than 90 % (2026-11-30)"
    assert f"{latest}; largest suite, of 2026-11-28: 20 % [20 %, 30 %] of 32<" in text
    single = suite("2026-11-29", 0.9, 54, SURE_SINGLE)
    only = f"{SINGLE}: 90 % [90 %, 100 %] of 54 right"
    assert only in front([_diagnosis()], [*records, single])
    assert only not in front([_diagnosis()], [single, suite("2026-11-30", 0.8, 48, SURE)])


def test_the_front_says_which_trial_shows_the_gap():
    first = _diagnosis()
    fitted = _diagnosis(subject="S02", shown_on=["dynamic_1"])
    assert "On the trial that was not fitted the misfit falls from 8 to 1.2" in front([first], [])
    alone = front([fitted], [])
    assert "On the fitted trial, which alone shows the gap, the misfit falls from 9 to 1.1" in alone
    assert "not fitted" not in alone
    said = "On the trial that was not fitted (S02: on the fitted one, which alone shows the gap) the misfit falls"
    assert said in front([first, fitted], [])


def test_the_front_counts_people_whose_answer_closes_nothing():
    first, nothing = _diagnosis(), _diagnosis(subject="S02")
    nothing["gap"] = nothing["gap"] | {"chi2_best": nothing["gap"]["chi2_plain"]}
    text = front([first, nothing], [])
    assert "(medians of 2)" in text
    assert "for S02 0 %" in text
    assert "the misfit goes from 8 to 8" in front([nothing], [])


def test_a_scored_suite_becomes_a_record_that_the_report_reads():
    path = Path(__file__).parents[2] / "benchmarks" / "ship_validation.py"
    ship = spec_from_file_location("ship_validation", path)
    module = module_from_spec(ship)
    ship.loader.exec_module(module)
    score = {"cases": 40, "failed": [{"case": "C0001", "error": "x"}], "targets": [{"claim": "a"}]}
    made = module.record(
        score, {"name": "ci", "seed": 7, "cases": {"null": 8, "mixture": 32}}, "abc1234", "2026-11-26"
    )
    assert set(RECORD_KEYS) <= set(made)
    assert made["failed"] == ["C0001"]
    assert made["planned"] == 40


@pytest.mark.parametrize("phantom", [True, False])
def test_page_says_that_the_data_are_synthetic_only_where_they_are(tmp_path, phantom):
    page, _ = _parsed(_report(tmp_path, phantom=phantom, diagnosed=False)[0])
    assert ("rests on synthetic people" in page.text) is phantom


def test_page_of_synthetic_people_without_fits_says_so(tmp_path):
    given = write_study(tmp_path, phantom=False)
    answers, out = [tmp_path / "diagnosis.json"], tmp_path / "report.html"
    refined = [tmp_path / "refined_phantom.json"]
    write_json(refined[0], read_json(given["refined"][0]) | {"phantom": True})
    for phantom, changes in ((False, {}), (True, {}), (True, {"refined": refined})):
        write_json(answers[0], _diagnosis(phantom=phantom and not changes))
        report_page(**given | {"fits": []} | changes, title="S", out=out, diagnoses=answers)
        assert ("rests on synthetic people" in _parsed(out)[0].text) is phantom
    other = write_study(tmp_path / "other")
    report_page(**other | {"fits": []}, title="S", out=out)
    assert "rests on synthetic people" in _parsed(out)[0].text


def test_what_is_missing_or_overridden_is_said_at_the_top(tmp_path):
    page, _ = _parsed(_report(tmp_path, people=1, overridden="S01/dynamic_1", diagnosed=False)[0])
    top = page.text[: page.text.index("The cohort")]
    assert "Shareability: needs at least 3 people, have 1." in top
    assert "a gate refuses it (quality.override): S01/dynamic_1." in top


def test_a_refused_trial_of_an_unseen_person_is_said_at_the_top(report, tmp_path):
    _, given = report
    record = read_json(given["refined"][0]) | {"overridden_gates": {"S99/dynamic_1": ["spikes"]}}
    write_json(tmp_path / "refined.json", record)
    report_page(
        **given | {"refined": [tmp_path / "refined.json"]},
        title="",
        out=tmp_path / "x.html",
        diagnoses=[],
    )
    page, _ = _parsed(tmp_path / "x.html")
    assert (
        "Refined although a gate refuses it (quality.override): S99/dynamic_1. What is said of that person"
        in page.text
    )


def test_same_results_give_the_same_bytes(report, tmp_path):
    path, given = report
    again = tmp_path / "report.html"
    diagnoses = [path.with_name("diagnosis.json")]
    report_page(**given, title="Study <one> & all", out=again, diagnoses=diagnoses)
    assert again.read_bytes() == path.read_bytes()


# -------------------- in a browser


@pytest.fixture(scope="module")
def tab(tmp_path_factory):
    program = chromium()
    if program is None:
        pytest.skip("no Chromium: install Debian's package chromium, or name one by REAL2SIM_CHROMIUM")
    with browser(program, tmp_path_factory.mktemp("profile")) as page:
        yield page


@pytest.fixture
def shown(tab, report):
    """The report opened anew, and no complaint when the test is over."""
    tab.errors.clear()
    tab.open(report[0], 1400)
    yield tab
    assert tab.errors == []


def _open_all(tab) -> None:
    tab.run("document.querySelectorAll('details').forEach(d => { d.open = true })")


def test_an_error_of_a_page_is_noticed(tab, tmp_path):
    page = tmp_path / "bad.html"
    page.write_text("<p>x</p><img src='missing.png'><script>console.error('boo'); nothing()</script>")
    tab.errors.clear()
    tab.open(page, 400)
    assert any("boo" in e for e in tab.errors)
    assert any("Uncaught" in e for e in tab.errors)
    assert any("ERR_FILE_NOT_FOUND" in e for e in tab.errors)


@pytest.mark.parametrize("width", WIDTHS)
def test_every_link_leads_somewhere_offline(shown, report, width):
    shown.open(report[0], width)
    links = shown.run("[...document.links].map(a => a.getAttribute('href'))")
    assert len(links) > 10
    for i, href in enumerate(links):
        if href.startswith("data:"):
            size = shown.run(f"fetch(document.links[{i}].href).then(r => r.blob()).then(b => b.size)")
            assert size > 20
        else:
            shown.run(f"document.links[{i}].click()")
            top = shown.run(f"document.querySelector({json.dumps(href)}).getBoundingClientRect().top")
            assert -1 <= top < 900, href
    assert shown.run("document.documentElement.scrollWidth <= innerWidth"), (
        "the page itself does not scroll sideways"
    )


@pytest.mark.skipif(not AXE, reason="REAL2SIM_AXE does not name axe.min.js: npm pack axe-core holds one")
@pytest.mark.parametrize("dark", [False, True])
@pytest.mark.parametrize("width", WIDTHS)
def test_no_rule_of_accessibility_is_broken(shown, report, width, dark):
    shown.open(report[0], width, dark=dark)
    _open_all(shown)
    passes, violations = judged_by_axe(shown)
    assert violations == []
    assert passes > 10, "rules were looked at"
    shown.run("document.querySelector('table').style.color = '#999'; document.body.style.background = '#aaa'")
    assert judged_by_axe(shown)[1], "and would have complained"


def test_figure_is_enlarged_and_put_back_by_keyboard(shown):
    shown.run("document.querySelector('button.enlarge').focus()")
    shown.key("Enter", 13)
    state = "[document.querySelector('dialog').open, document.activeElement.textContent, "
    state += "document.querySelectorAll('dialog svg').length]"
    assert shown.run(state) == [True, "Close", 1]
    width = "document.querySelector('dialog svg').getBoundingClientRect().width"
    before = shown.run(width)
    assert before > 1000
    shown.run("document.querySelector('dialog [aria-label=Larger]').click()")
    assert shown.run(width) == pytest.approx(1.5 * before, rel=0.02)
    shown.key("Escape", 27)
    # a dialog tells that it was closed a moment later
    shown.run("new Promise((done) => setTimeout(done, 500))")
    assert shown.run(state) == [False, "Enlarge", 0]
    assert shown.run("[...document.querySelectorAll('figure')].every(f => f.querySelector('svg'))")


def test_folded_parts_are_printed(shown, tmp_path):
    assert shown.run("[...document.querySelectorAll('details')].some(d => !d.open)")
    shown.pdf(tmp_path / "report.pdf")
    assert (tmp_path / "report.pdf").read_bytes().startswith(b"%PDF")
    assert shown.run("[...document.querySelectorAll('details')].every(d => d.open)")
