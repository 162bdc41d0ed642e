"""The page of one person: whole, self-contained, honest about what is missing, and usable by everyone."""

from __future__ import annotations

import base64
import copy
import re
from pathlib import Path

import pytest
from real2sim.artefacts import write_json
from real2sim.inference.parameters import PARAMETERS, unit
from real2sim.pages.person import person_page
from test_pages import _diagnosis, _law, _Page
from test_report import WIDTHS

from tests.browser import AXE, browser, chromium, judged_by_axe

FREE = ("k_ty", "d_tx")
SUBJECT = """id: S07
cohort: validation
sex: female
age_years: 31
mass_kg: 64.0
height_m: 1.68
waist_m: 0.78
tightness: {loosest_cm: 6, tightest_cm: 14, safe_comfortable_cm: 10}
"""


def _trial(full: bool) -> dict:
    cost = {"J_position": 0.001, "J_velocity": 0.05, "rmse_position_m": 0.0014}
    values = dict.fromkeys(PARAMETERS, 40.0)
    verdicts = {
        "k_ty": {"verdict": "determined", "ci95": [39.0, 41.0]},
        "d_tx": {"verdict": "at bound", "ci95": [None, 44.0]},
    }
    more = {
        name: {"J": 0.05, "gain": 0.03, "value": 44.0, "contradicts_prior": name == "k_tz"}
        for name in PARAMETERS
        if name not in FREE
    }
    return {
        "prior": cost | {"J": 0.09},
        "refined": cost | {"J": 0.0612, "parameters": values, "evaluations": 96},
        "verdicts": verdicts,
        "beyond_ends": {"J": 0.06, "evaluations": 30, "parameters": {"d_tx": 99.0}},
        "if_also_free": more,
        "full": cost | {"J": 0.06, "evaluations_best_restart": 1210} if full else None,
        "against_full": {
            "J_ratio": 1.025,
            "evaluations_over_best_restart": 96 / 1210,
            "evaluations_over_all_restarts": 96 / 6050,
            "bar": {"J_ratio": 1.02, "evaluations_over_best_restart": 0.25},
            "met": False,
        }
        if full
        else None,
    }


def _refined(full: bool = True, **changes) -> dict:
    rows = {
        name: {
            "value": 41.0 if name in FREE else 40.0,
            "unit": unit(name),
            "prior": 40.0,
            "low": 20.0 if name in FREE else None,
            "high": 80.0 if name in FREE else None,
            "use": "refined inside the interval" if name in FREE else "fixed at the prior",
            "source": "refined" if name in FREE else "prior",
            "end": None,
        }
        for name in PARAMETERS
    }
    pair = {"train": "dynamic_1", "test": "dynamic_2", "J_cross": 0.07, "J_within": 0.0612}
    return {
        "subject": "S07",
        "phantom": True,
        "status": "ok",
        "overridden_gates": {},
        "refused_gates": {},
        "prior_rests_on_person": False,
        "priors_rest_on_refused": [],
        "free": list(FREE),
        "parameters": rows,
        "trials": {"dynamic_1": _trial(full), "dynamic_2": _trial(full)},
        "pooled": {
            "J": 0.0702,
            "evaluations": 180,
            "trials": {
                "dynamic_1": {"J": 0.0651, "rmse_position_m": 0.0015},
                "dynamic_2": {"J": 0.0753, "rmse_position_m": 0.0016},
            },
        },
        "cross_trial": {"refined": {"pairs": [pair]}},
        "noise_floor": {"J": 0.054, "ci95": [0.05, 0.057]},
        "provenance": {
            "inputs_sha256": {"results/priors/priors.csv": "ab" * 32},
            "python": "3.11.7",
            "packages": {"mujoco": "4.0.0"},
            "code_fingerprint": "0123456789abcdef",
        },
    } | changes


def _nothing(**changes) -> dict:
    """A person without dynamic trials."""
    rows = copy.deepcopy(_refined()["parameters"])
    for row in rows.values():
        row |= {"source": "prior", "value": row["prior"]}
    status = "no dynamic trial: nothing to refine on, the point prior stands"
    none = {"trials": {}, "pooled": None, "cross_trial": None, "noise_floor": None, "parameters": rows}
    return _refined(status=status, **none) | changes


def _page_of(
    folder: Path, refined: dict, *, whole: bool = True, diagnosis: dict | None = None, step: str = "ok"
) -> tuple[Path, _Page, str]:
    folder.mkdir(exist_ok=True)
    (folder / "subject.yaml").write_text(SUBJECT)
    (folder / "interface.xml").write_text("<mujoco/>\n")
    gate = {"gate": "spikes", "verdict": "warn", "message": "2 <spikes>", "remedy": "mend them"}
    finding = {"code": "facing", "message": "neutral.tsv: 40 deg to the <left>", "action": "used as stated"}
    trials = {"neutral": {"verdict": "warn", "override": None, "gates": [gate], "findings": [finding]}}
    write_json(folder / "gates.json", {"trials": trials})
    write_json(folder / "S07.json", refined)
    write_json(
        folder / "interface.json", {"trial": "dynamic_1", "timestep_s": 0.01, "replay_difference_m": 0.0}
    )
    some = {}
    if whole:
        point = {"selected_cm": 10, "knee_cm": 10.2, "agree": True, "status": "ok"}
        about = {
            "breakpoints": {"operating_point": point, "warning": "the ends are <exchanged>"},
            "limits": {
                "axes": ["tx", "ty", "tz", "rx", "ry", "rz"],
                "q_min": [-0.1] * 6,
                "q_max": [0.1] * 6,
            },
            "step": {"timestep_s": 0.01, "status": step},
            "diagnosis": diagnosis or _diagnosis(subject="S07"),
        }
        some["model"] = folder / "model.xml"
        some["model"].write_text("<mujoco model='with cause'/>\n")
        for name, content in about.items():
            some[name] = folder / f"{name}.json"
            write_json(some[name], content)
    out = folder / "S07.html"
    person_page(
        person=folder / "subject.yaml",
        gates=folder / "gates.json",
        refined=folder / "S07.json",
        interface=folder / "interface.xml",
        notes=folder / "interface.json",
        out=out,
        **some,
    )
    content = out.read_text(encoding="utf-8")
    page = _Page()
    page.feed(content)
    return out, page, content


def _rows(content: str, section: str) -> list[list[str]]:
    """Cells of the rows of the first table after a section's heading."""
    body = content[content.index(f'id="{section}"') :].split("<tbody>", 1)[1].split("</tbody>", 1)[0]
    return [re.findall(r"<t[hd][^>]*>(.*?)</t[hd]>", row) for row in body.split("</tr>") if "<t" in row]


@pytest.fixture(scope="module")
def whole(tmp_path_factory) -> tuple[Path, _Page, str]:
    return _page_of(tmp_path_factory.mktemp("person"), _refined())


def test_page_is_whole_and_loads_nothing(whole):
    _, page, content = whole
    assert page.open == []
    assert len(page.ids) == len(set(page.ids))
    assert all(r.startswith("data:") or r[1:] in page.ids for r in page.references)
    assert not re.search(r"https?:|@import|url\((?!#)|\bnan\b", re.sub(r"data:[^\"]+", "", content))
    assert page.headings.count(1) == 1
    assert page.wordless == 0
    sections = ("who", "quality", "tightness", "parameters", "cost", "diagnosis", "files", "provenance")
    assert set(sections) <= set(page.ids)


def test_everything_about_the_person_is_told(whole):
    _, page, _ = whole
    assert "2 of 12 parameters are refined on 2 dynamic trials together" in page.text
    assert "facing" in page.text
    assert "neutral.tsv: 40 deg to the <left>" in page.text
    assert "Check subject.yaml: the ends are <exchanged>." in page.text
    assert "2 <spikes>" in page.text
    assert "The knee of the sweep lies at 10.2 cm" in page.text
    assert "J is 2.5 % above a full calibration's with 7.9 % of the evaluations" in page.text
    assert "It misses the bar" in page.text
    assert "J would fall by 2.0 % (d_tx 99)" in page.text
    assert "Every trial speaks against the prior of k_tz. To refine such a parameter too" in page.text
    assert "Slack causes the gap" in page.text
    assert "rests on synthetic people" in page.text
    assert "\N{MINUS SIGN}100.0" in page.text, "limits in mm"


def test_costs_are_those_of_the_values_that_are_given(whole):
    _, page, content = whole
    # the values are refined on both trials together; each trial's own refinement has J 0.0612
    lead = "Mean J of these trials falls from 0.09 at the prior to 0.0702, 1.3 times what noise alone costs (0.054)"
    assert lead in page.text
    rows = {cells[0]: cells[1:] for cells in _rows(content, "cost")}
    assert rows["dynamic 1, refined on this trial alone"] == ["0.0612", "1.13", "1.4", "96"]
    assert rows["dynamic 1, refined on all trials together"] == ["0.0651", "1.21", "1.5", "90"]
    assert rows["dynamic 2, refined on all trials together"] == ["0.0753", "1.39", "1.6", "90"]
    assert rows["mean of the trials, refined on all trials together"] == [
        "0.0702",
        "1.3",
        "\N{EN DASH}",
        "180",
    ]


def test_costs_of_one_trial_are_its_own(tmp_path):
    _, page, _ = _page_of(
        tmp_path, _refined(trials={"dynamic_1": _trial(full=True)}, pooled=None, cross_trial=None)
    )
    assert "refined on 1 dynamic trial, the others" in page.text
    assert "J falls from 0.09 at the prior to 0.0612, 1.13 times what noise alone costs (0.054)" in page.text
    assert "together" not in page.text[: page.text.index("Who")]
    assert "dynamic 1, refined on" not in page.text


def test_a_status_keeps_its_names_and_a_smaller_J_is_below(tmp_path):
    missing = "no joint limits, as the sweeps at T* are missing: the point prior stands"
    _, page, _ = _page_of(tmp_path / "none", _nothing(status=missing), whole=False)
    assert "No joint limits, as the sweeps at T* are missing" in page.text[page.text.index("Cost J and") :]
    better = _refined()
    better["trials"]["dynamic_1"]["against_full"]["J_ratio"] = 0.711
    _, page, _ = _page_of(tmp_path / "better", better)
    assert "dynamic 1: J is 28.9 % below a full calibration's" in page.text


def test_a_step_that_was_set_by_hand_is_not_the_step_study_s(tmp_path):
    for status, said in (
        ("ok", "0.01 s, by the step study (ok)"),
        ("set by hand, no candidate passes", "0.01 s, set by hand, no candidate passes"),
    ):
        _, page, _ = _page_of(tmp_path, _refined(), step=status)
        assert said in page.text


def test_the_model_can_be_taken_away(whole):
    path, _, content = whole
    links = dict(re.findall(r'download="([^"]+)" href="data:[^;]+;base64,([^"]+)"', content))
    files = {"interface.xml": "interface.xml", "interface.json": "interface.json", "refined.json": "S07.json"}
    files["model.xml"] = "model.xml"
    assert {name: base64.b64decode(data) for name, data in links.items()} == {
        f"S07_{name}": (path.parent / file).read_bytes() for name, file in files.items()
    }


def test_values_of_an_incomplete_model_stand_beside_those_with_the_cause(whole):
    _, page, content = whole
    assert page.text.count("of the plain model, which the diagnosis finds incomplete: it lacks slack") == 2
    assert page.text.count("results/diagnosis/S07/model.xml") == 2, "above the table and above the files"
    head = re.findall(r"<th scope=\"col\"[^>]*>(.*?)</th>", content[content.index('id="parameters"') :])[:12]
    rows = {cells[0]: dict(zip(head, cells, strict=True)) for cells in _rows(content, "parameters")}
    assert rows["k_tx"]["With slack"] == "8000 <span class='small'>[7120, 8000]</span>"
    # the refined values carry no check mark
    assert rows["k_ty"]["Verdict (plain model)"] == "determined"


def _values(text: str) -> str:
    return text[text.index("Parameters") : text.index("Cost J and noise")]


def test_without_a_cause_the_refined_values_stand_for_themselves(tmp_path):
    _, page, content = _page_of(tmp_path, _refined(), diagnosis=_diagnosis("none", subject="S07"))
    assert "\N{CHECK MARK} determined" in _values(page.text)
    assert "incomplete" not in page.text
    assert "S07_model.xml" not in content


@pytest.mark.parametrize("measured", [False, True])
def test_an_unknown_cause_leaves_the_plain_model_incomplete_too(tmp_path, measured):
    law = _law() | {"model": {"parameters": {"k_tx": {"value": 731.0, "unit": "N/m"}}}}
    diagnosis = _diagnosis("unknown", subject="S07", free_form=law if measured else None)
    _, page, content = _page_of(tmp_path, _refined(), diagnosis=diagnosis)
    said = _values(page.text)
    assert "which the diagnosis finds incomplete: the cause is unknown (probability 92 %)" in said
    assert ("With measured law" in said) is measured
    assert ("731" in said) is measured
    assert ("S07_model.xml" in content) is measured
    assert ("There is no model with the cause." in said) is not measured
    assert "\N{CHECK MARK}" not in said


def test_a_person_without_dynamic_trials_has_a_page_that_says_so(tmp_path):
    _, page, content = _page_of(tmp_path, _nothing(phantom=False), whole=False)
    searched, source = ({row[i] for row in _rows(content, "parameters")} for i in (3, 5))
    assert (searched, source) == ({"\N{EN DASH}"}, {"prior"}), "nothing was searched"
    top = page.text[: page.text.index("Who")]
    assert "Nothing was refined: no dynamic trial" in top
    assert "All 12 parameters are the point prior." in top
    assert "synthetic" not in page.text
    assert "No joint limits" in page.text
    assert "A diagnosis needs two dynamic trials." in page.text
    assert page.wordless == 0


def test_what_is_in_doubt_is_said_at_the_top(tmp_path):
    refined = _refined(
        full=False,
        refused_gates={"S07/dynamic_3": ["spikes"]},
        overridden_gates={"S07/neutral": ["gaps"]},
        prior_rests_on_person=True,
        priors_rest_on_refused=["S01/dynamic_1"],
    )
    refined["parameters"]["k_ty"]["end"] = (
        "at the upper end of the interval: the interval does not hold this person"
    )
    _, page, _ = _page_of(tmp_path, refined)
    top = page.text[: page.text.index("Who")]
    assert "S07/dynamic_3 is refused by its gates (spikes) and left out." in top
    assert "(quality.override): S07/neutral." in top
    assert "The priors rest on trials that a gate refuses (quality.override): S01/dynamic_1." in top
    assert "own fits are among those behind the priors" in top
    assert "k_ty stands at the upper end of the interval: the interval does not hold this person." in top
    assert "No full calibration of this person is there to compare with." in page.text


def test_same_files_give_the_same_bytes(whole, tmp_path):
    assert _page_of(tmp_path, _refined())[2] == whole[2]


@pytest.fixture(scope="module")
def tab(tmp_path_factory):
    program = chromium()
    if program is None:
        pytest.skip("no Chromium: install Debian's package chromium, or name one by REAL2SIM_CHROMIUM")
    with browser(program, tmp_path_factory.mktemp("profile")) as page:
        yield page


@pytest.mark.parametrize("width", WIDTHS)
def test_page_fits_its_window_and_complains_of_nothing(tab, whole, width):
    tab.errors.clear()
    tab.open(whole[0], width)
    tab.run("document.querySelectorAll('details').forEach(d => { d.open = true })")
    assert tab.run("document.documentElement.scrollWidth <= innerWidth")
    assert tab.errors == []


def test_the_table_of_causes_needs_no_scrolling_on_a_narrow_screen(tab, whole):
    tab.open(whole[0], min(WIDTHS))
    around = "document.querySelector('section[aria-labelledby=diagnosis] .scroll')"
    assert tab.run(f"{around}.scrollWidth <= {around}.clientWidth")


@pytest.mark.skipif(not AXE, reason="REAL2SIM_AXE does not name axe.min.js: npm pack axe-core holds one")
@pytest.mark.parametrize("dark", [False, True])
@pytest.mark.parametrize("width", WIDTHS)
def test_no_rule_of_accessibility_is_broken(tab, whole, width, dark):
    tab.open(whole[0], width, dark=dark)
    tab.run("document.querySelectorAll('details').forEach(d => { d.open = true })")
    passes, violations = judged_by_axe(tab)
    assert violations == []
    assert passes > 10, "rules were looked at"
