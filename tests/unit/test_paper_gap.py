"""Which gap would have made the paper's numbers: sizes, cohorts, distances, ranks, and what the report says of them."""

from __future__ import annotations

import copy
import math
from pathlib import Path

import mujoco
import numpy as np
import pytest
from real2sim.artefacts import read_json, read_table, write_json
from real2sim.configuration import validated
from real2sim.errors import InputError
from real2sim.inference.parameters import PARAMETERS
from real2sim.pages.page import document
from real2sim.pages.paper_gap import paper_gap_figure, told
from real2sim.verification.cohort import plan as phantom_plan
from real2sim.verification.paper_gap import people, ranking, summary
from real2sim.verification.paper_gap.cohort import cohort_with_cause
from real2sim.verification.paper_gap.plan import CAUSES, STUDY_ROBOT

ROOT = Path(__file__).parents[2]
PUBLISHED = ROOT / "resources" / "published"
ROBOT = ROOT / "resources" / "robot" / "drba.xml"
TOLERANCE_LN = 0.02


@pytest.fixture
def settings():
    return validated({"paper_gap": {"resamples": 40, "class_resamples": 200}}, "config", Path("defaults"))


@pytest.fixture(scope="module")
def paper():
    return summary.Published.read(PUBLISHED, TOLERANCE_LN)


def test_the_paper_has_each_number_that_a_cohort_has(paper):
    assert set(paper.values) == set(summary.NUMBERS)
    assert paper.values["overhead_mean"] == pytest.approx(math.log(1.145))
    assert paper.values["prior_k_tx"] == pytest.approx(math.log(725))
    assert paper.values["k_rz_at_bound"] == 1
    # forwards 3.2 and about the vertical 3.1, where the bounds are said to keep them below 1.5
    assert paper.values["damping_ratios"] == 2
    # half of a 95 % interval is 1.96 SD
    assert paper.values["sd_k_tx"] == pytest.approx(math.log(2570 / 205) / 2 / 1.959964)


def _person(name, centre, rng, overhead=0.145, j=1.28):
    """A person whose fits scatter about their own centre, itself 0.1 from the cohort's (in ln)."""
    own = np.log(centre) + 0.1 * rng.standard_normal(12)
    fits = []
    for trial in ("dynamic_1", "dynamic_2"):
        for restart in range(1, 6):
            values = np.exp(own + 0.02 * rng.standard_normal(12))
            named = dict(zip(PARAMETERS, values.tolist(), strict=True))
            fits.append({"trial": trial, "restart": restart, "parameters": named, "at_bound": [], "J": j})
    return {
        "subject": name,
        "fits": fits,
        "J_within": j,
        "J_cross": j * (1 + overhead),
        "J_prior": 1.1 * j,
        "overhead_cross": overhead,
        "overhead_loso_J": 0.074,
        "overhead_loso_rmse": 0.065,
    }


def _cohort(path, cause, seed, factor=1.0, size=2.0, **person):
    priors = {row["parameter"]: float(row["prior"]) for row in read_table(PUBLISHED / "table1_priors.csv")}
    centre = factor * np.array([priors[name] for name in PARAMETERS])
    rng = np.random.default_rng(seed)
    made = [_person(f"S0{i + 1}", centre, rng, **person) for i in range(5)]
    sealed = {p["subject"]: {"effect": cause, "severity": size} for p in made}
    write_json(
        path, {"schema": 1, "cause": cause, "phantom": True, "status": "ok", "sealed": sealed, "people": made}
    )
    return path


def test_numbers_of_a_cohort_are_those_that_it_was_made_with(settings, paper, tmp_path):
    made = read_json(_cohort(tmp_path / "c.json", "tilt", 1, factor=2.0, overhead=0.3))["people"]
    numbers = dict(zip(summary.NUMBERS, summary.numbers_of(made, paper, settings), strict=True))
    assert numbers["overhead_mean"] == pytest.approx(math.log(1.3))
    assert numbers["prior_k_tx"] == pytest.approx(math.log(2 * 725), abs=0.15)
    assert numbers["k_rz_at_bound"] == 0
    assert 0.03 < numbers["sd_k_ty"] < 0.25
    assert 0 <= numbers["same_classes"] <= 12


def test_a_distance_is_zero_at_the_paper_and_counts_each_group_once(paper):
    goal = np.array([paper.values[name] for name in summary.NUMBERS])
    usual = np.ones(len(goal))
    off = goal.copy()
    off[summary.NUMBERS.index("same_classes")] -= 3.0
    found = ranking.distances(np.array([goal, off]), goal, usual)
    np.testing.assert_allclose(found[0], 0.0)
    groups = list(summary.GROUPS)
    assert found[1, 2 + groups.index("classes")] == pytest.approx(3.0)
    assert found[1, 0] == pytest.approx(3.0 / len(groups))
    assert found[1, 1] == pytest.approx(3.0 / (len(groups) - len(summary.HANGING)))


def test_a_number_that_all_miss_alike_does_not_drown_the_others():
    values = np.array([[9.0, 0.0, 5.0], [9.1, 0.0, 6.0], [9.2, 1.0, 5.0]])
    usual = ranking.usual_misses(values, np.array([1.0, 0.0, 5.0]))
    np.testing.assert_allclose(usual, [8.1, 1 / 3, 1 / 3])
    assert math.isnan(ranking.usual_misses(values[:1], values[0])[0])


@pytest.fixture
def ranked(settings, tmp_path):
    cohorts = [
        _cohort(tmp_path / "tilt.json", "tilt", 1),
        _cohort(tmp_path / "slack.json", "slack", 2, factor=9.0, overhead=1.9),
        _cohort(tmp_path / "creep.json", "creep", 3, factor=0.1, overhead=2.6),
        _cohort(tmp_path / "nothing.json", "nothing", 4, j=0.02),
    ]
    write_json(
        tmp_path / "outliers.json",
        {"cause": "outliers", "status": "S01: spikes: 40 % of the samples", "sealed": {"S01": {}}},
    )
    out, table = tmp_path / "causes.json", tmp_path / "causes.csv"
    ranking.rank_causes(
        cohorts=[*cohorts, tmp_path / "outliers.json"],
        published=PUBLISHED,
        settings=settings,
        out=out,
        table=table,
    )
    return out, table


def test_the_cohort_that_is_like_the_paper_comes_first(ranked):
    record = read_json(ranked[0])
    rows = {row["cause"]: row for row in record["causes"]}
    assert record["causes"][0]["cause"] == "tilt"
    assert rows["tilt"]["rank"] == 1
    assert rows["tilt"]["not_told_apart"]
    assert rows["tilt"]["distance_low"] <= rows["tilt"]["distance"] * 1.5
    assert not rows["slack"]["not_told_apart"]
    # a cohort whose fits do not cost the paper's J has no rank, nor has one that could not be analysed
    assert "rank" not in rows["nothing"]
    assert rows["nothing"]["status"].startswith("J 0.02")
    assert "rank" not in rows["outliers"]
    assert "spikes" in rows["outliers"]["status"]
    assert sum(row.get("nearest_share", 0) for row in record["causes"]) == pytest.approx(1.0)
    assert [row["cause"] for row in read_table(ranked[1])][:3] == [r["cause"] for r in record["causes"]][:3]


def test_cohorts_that_all_cost_too_little_have_no_rank(settings, tmp_path):
    cohort = _cohort(tmp_path / "nothing.json", "nothing", 4, j=0.02)
    out = tmp_path / "causes.json"
    given = {"published": PUBLISHED, "settings": settings, "table": tmp_path / "causes.csv"}
    ranking.rank_causes(cohorts=[cohort], out=out, **given)
    record = read_json(out) | {"commit": "abc1234", "date": "2026-11-26"}
    assert "rank" not in record["causes"][0]
    assert "No cohort costs this J" in told(record, "")
    write_json(out, record)
    paper_gap_figure(record=out, out=[tmp_path / "f.svg"])
    assert "no cohort costs the paper" in (tmp_path / "f.svg").read_text()
    write_json(cohort, {"cause": "nothing", "status": "needs 3 people, has 1", "sealed": {}})
    ranking.rank_causes(cohorts=[cohort], out=out, **given)
    assert read_json(out)["causes"][0]["status"] == "needs 3 people, has 1"


def test_the_report_names_the_nearest_and_those_that_cannot_leave_this_j(ranked, tmp_path):
    record = read_json(ranked[0]) | {"commit": "abc1234", "date": "2026-11-26"}
    text = told(record, "<figure></figure>")
    document("T", [text], phantom=True)
    assert "They are tilt (2)." in text
    assert "1 other effects cannot leave this J" in text
    assert "nothing unmodelled" in text
    assert "commit abc1234" in text
    write_json(tmp_path / "record.json", record)
    paper_gap_figure(record=tmp_path / "record.json", out=[tmp_path / "f.svg"])
    assert "tilt" in (tmp_path / "f.svg").read_text()


# -------------------- how large an effect is


class _Recorder:
    """An effect whose fits cost ``factor`` of the draw times the square of the size; unstable beyond a size."""

    most_severe = math.inf

    def __init__(self, factors, stable=math.inf):
        self._factors, self._stable, self.drawn = iter(factors), stable, 0

    def draw(self):
        self.factor = next(self._factors)
        self.drawn += 1

    def record(self, sizes, *, fine=False):
        return [None if size > self._stable else (self.factor, size) for size in sizes]


class _Analysis:
    def __init__(self, settings):
        self.settings, self.fitted = settings, 0
        self.recorded_robot = ROBOT

    def fit(self, simulated, out, restarts):
        factor, size = simulated
        self.fitted += 1
        if factor < 0:
            raise InputError(Path("x.tsv"), "spikes", "too many", "fewer", "Record again.")
        return factor * size**2


def test_a_size_is_found_between_those_that_are_tried(settings):
    recorder, analysis = _Recorder([0.3]), _Analysis(settings)
    size = people._size_for(1.28, recorder, analysis)
    assert size == pytest.approx(math.sqrt(1.28 / 0.3), rel=1e-6)
    # not all sizes had to be fitted
    assert analysis.fitted < people._SIZES


def test_another_draw_is_taken_where_the_first_cannot(settings):
    recorder = _Recorder([0.001, 0.3])
    size = people._size_for(1.28, recorder, _Analysis(settings))
    assert recorder.drawn == 2
    assert size == pytest.approx(math.sqrt(1.28 / 0.3), rel=1e-6)


def test_where_no_draw_can_the_costliest_is_taken(settings):
    recorder = _Recorder([0.001, 0.002, 0.0005])
    assert people._size_for(1.28, recorder, _Analysis(settings)) == settings["paper_gap"]["largest"]


def test_sizes_that_cannot_be_simulated_or_analysed_are_passed_over(settings):
    recorder = _Recorder([0.3] * 3, stable=2.5)
    size = people._size_for(1.28, recorder, _Analysis(settings))
    assert size == 2.0
    with pytest.raises(InputError, match="no recording"):
        people._size_for(1.28, _Recorder([-1.0] * 3), _Analysis(settings))


def test_a_size_that_only_a_coarse_simulation_bears_is_halved(settings, tmp_path):
    recorder, analysis = _Recorder([0.02], stable=2.5), _Analysis(settings)
    recorder.draw()
    assert people._record_and_fit(1.28, 8.0, recorder, analysis, tmp_path) == 2.0
    # a correction that is unstable is not made
    recorder = _Recorder([0.25], stable=2.2)
    recorder.draw()
    assert people._record_and_fit(1.28, 2.0, recorder, analysis, tmp_path) == 2.0
    # what cannot be simulated at any size is said
    recorder = _Recorder([0.25], stable=0.01)
    recorder.draw()
    with pytest.raises(InputError, match="no stable simulation"):
        people._record_and_fit(1.28, 8.0, recorder, analysis, tmp_path)


# -------------------- people


def test_a_motion_is_as_wide_as_asked_and_the_settings_stay():
    phantom = phantom_plan.read_settings(ROOT / "config" / "phantom-paper-gap.yaml")
    before = copy.deepcopy(phantom)
    half = people.with_motion(phantom, 0.5)["motions"]["dynamic"]
    assert phantom == before
    assert half["targets"][0][0] == 0.5 * before["motions"]["dynamic"]["targets"][0][0]
    assert half["durations_s"] == before["motions"]["dynamic"]["durations_s"]


def test_the_analysis_knows_where_the_strap_is_fixed(tmp_path):
    recorded = ROOT / "resources" / "robot" / "study_planar.xml"
    people.as_wide_as(recorded, ROBOT, tmp_path / "robot.xml")
    places = {}
    for path in (recorded, tmp_path / "robot.xml"):
        model = mujoco.MjModel.from_xml_path(str(path))
        data = mujoco.MjData(model)
        mujoco.mj_forward(model, data)
        left, right = (data.site(f"interface_{side}").xpos.copy() for side in ("left", "right"))
        places[path.name] = (left - right, left[2])
    (wide, height), (own, own_height) = places.values()
    np.testing.assert_allclose(own, wide, atol=1e-9)
    assert own_height == pytest.approx(height, abs=1e-9)
    # it still moves like the assumed robot
    assert mujoco.MjModel.from_xml_path(str(tmp_path / "robot.xml")).body("base").mass == 91


@pytest.fixture(scope="module")
def cohort(tmp_path_factory):
    """Two people recorded with the study's robot, short, and their cohort."""
    work = tmp_path_factory.mktemp("paper_gap")
    small = {"restarts": 2, "resamples": 20, "class_resamples": 100}
    settings = validated({"paper_gap": small, "statistics": {"min_subjects": 2}}, "config", Path("defaults"))
    phantom = phantom_plan.read_settings(ROOT / "config" / "phantom-paper-gap.yaml")
    phantom["trials"] |= {"dynamic_s": 6.0, "neutral_s": 4.5}
    phantom["simulation"]["step_s"] = 0.002
    other = validated(
        {"paths": {"robot": "resources/robot/study_planar.xml"}, "robot": _study_controllers()},
        "config",
        Path("defaults"),
    )
    folders = [work / name for name in ("S01", "S02")]
    for folder in folders:
        people.person_with_cause(
            cause=STUDY_ROBOT,
            subject=folder.name,
            phantom=phantom,
            recorded_robot=ROOT / other["paths"]["robot"],
            recorded_controllers=other["robot"],
            robot=ROBOT,
            published=PUBLISHED / "cross_trial.csv",
            settings=settings,
            out=folder,
        )
    out = work / "cohort.json"
    cohort_with_cause(
        cause=STUDY_ROBOT,
        people=folders,
        robot=ROBOT,
        published=PUBLISHED / "table1_priors.csv",
        settings=settings,
        out=out,
    )
    return folders, read_json(out)


def _study_controllers():
    from real2sim.configuration import read_yaml

    return read_yaml(ROOT / "config" / "study-robot.yaml")["robot"]


def test_a_cohort_goes_through_the_papers_own_statistics(cohort):
    folders, content = cohort
    assert content["status"] == "ok"
    assert [p["subject"] for p in content["people"]] == ["S01", "S02"]
    first = content["people"][0]
    assert len(first["fits"]) == 4
    best = [min(f["J"] for f in first["fits"] if f["trial"] == t) for t in ("dynamic_1", "dynamic_2")]
    assert first["J_within"] == pytest.approx(np.mean(best), rel=1e-6)
    assert first["J_cross"] >= first["J_within"]
    person = read_json(folders[0] / "person.json")
    assert person["sealed"]["motion_share"] > 0
    assert (folders[0] / "robot.xml").exists()


def test_every_cause_of_the_catalogue_is_compared():
    from real2sim.verification.suite.plan import EFFECTS

    assert set(EFFECTS) < set(CAUSES)
    assert len(CAUSES) == len(EFFECTS) + 2
