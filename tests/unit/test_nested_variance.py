"""Restarts in trials in people: components against the likelihood, the interval over trials, classes with verdicts."""

import numpy as np
import pytest
from real2sim.artefacts import number, read_table, write_table
from real2sim.inference.parameters import PARAMETERS
from real2sim.study.statistics import icc, nested
from real2sim.study.statistics.classes import (
    BOUND,
    CLASS_COLUMNS,
    FLAT,
    OWN,
    SEARCH,
    SHARED,
    UNTOLD,
    Evidence,
    classes,
    verdict,
)
from real2sim.study.statistics.shareability import shareability
from synthetic_results import write_fits
from test_statistics import SETTINGS


def _data(rng, people, trials, restarts, sds):
    person = np.repeat(np.arange(people), trials * restarts)
    trial = np.repeat(np.arange(people * trials), restarts)
    values = sds[0] * rng.normal(size=people)[person] + sds[1] * rng.normal(size=people * trials)[trial]
    return values + sds[2] * rng.normal(size=len(person)), person, trial


def test_components_are_the_known_ones_in_a_large_cohort():
    values, person, trial = _data(np.random.default_rng(0), 600, 4, 5, (0.5, 0.2, 0.1))
    found = nested.components(values, person, trial)
    assert np.sqrt([found.person, found.trial, found.restart]) == pytest.approx([0.5, 0.2, 0.1], rel=0.06)
    assert found.icc == pytest.approx(0.25 / 0.30, abs=0.02)
    assert (found.method, found.notes) == ("closed form", ())


@pytest.mark.parametrize(
    "sds", [(0.5, 0.2, 0.1), (0.0, 0.2, 0.1), (0.5, 0.0, 0.1), (0.0, 0.0, 0.1), (0.5, 0.2, 0.001)]
)
def test_closed_form_is_the_maximum_of_mixedlms_restricted_likelihood(sds):
    values, person, trial = _data(np.random.default_rng(4), 5, 2, 5, sds)
    exact = nested.closed_form(values, person, trial)
    found, converged = nested.mixed_model_reml(values, person, trial, exact[::-1] + 0.01)
    assert converged
    np.testing.assert_allclose(np.sqrt(found), np.sqrt(exact), atol=2e-3 * np.sqrt(exact.sum()))


def test_closed_form_is_the_anova_where_no_variance_is_negative():
    values, person, trial = _data(np.random.default_rng(1), 8, 2, 3, (0.6, 0.3, 0.1))
    found = nested.closed_form(values, person, trial)
    means = np.array([values[trial == t].mean() for t in range(16)])
    two_level = icc.one_way_anova(means[:, None], np.repeat(np.arange(8), 2))
    between, within = icc.variance_components(two_level)
    assert found[0] == pytest.approx(between[0])
    assert found[1] + found[2] / 3 == pytest.approx(within[0])


def test_unequal_numbers_of_trials_and_restarts_go_to_mixedlm():
    values, person, trial = _data(np.random.default_rng(2), 40, 3, 4, (0.5, 0.3, 0.1))
    keep = np.random.default_rng(3).random(len(values)) < 0.7
    found = nested.components(values[keep], person[keep], trial[keep])
    assert found.method == "MixedLM"
    assert np.sqrt([found.person, found.trial, found.restart]) == pytest.approx([0.5, 0.3, 0.1], rel=0.25)
    no_people = nested.components((values - 0.5)[keep] * 0 + values[keep][::-1], person[keep], trial[keep])
    assert no_people.method == "MixedLM"


def test_boundary_and_equal_restarts_are_said():
    rng = np.random.default_rng(5)
    person, trial = np.repeat(np.arange(4), 6), np.repeat(np.arange(8), 3)
    swing = np.tile([1.0, -1.0], 4)[trial] + 0.01 * rng.normal(size=24)
    found = nested.components(swing, person, trial)
    assert found.person == 0.0
    assert found.notes == ("no variance between people: REML on its boundary",)
    equal = nested.components(rng.normal(size=8)[trial], person, trial)
    assert equal.restart == 0.0
    assert "restarts of a trial are equal" in equal.notes
    people_only = nested.components(np.arange(4.0)[person], person, trial)
    assert (people_only.icc, people_only.trial) == (1.0, 0.0)
    nothing = nested.components(np.full(24, 3.0), person, trial)
    assert np.isnan(nothing.icc)
    assert nothing.notes == ("no variance: all fits are equal",)
    single = nested.components(rng.normal(size=8), np.repeat(np.arange(4), 2), np.arange(8))
    assert np.isnan(single.restart)
    assert single.notes[0].startswith("one restart per trial")
    with pytest.raises(ValueError, match="two people and a second trial"):
        nested.components(np.arange(6.0), np.repeat(np.arange(3), 2), np.repeat(np.arange(3), 2))


def test_trials_of_two_people_with_one_name_are_two_trials():
    values, person, trial = _data(np.random.default_rng(6), 5, 2, 5, (0.5, 0.2, 0.1))
    assert nested.components(values, person, trial % 2) == nested.components(values, person, trial)


def test_effective_fits_count_trials_where_restarts_agree_and_fits_where_trials_do():
    person, trial = np.repeat(np.arange(5), 10), np.repeat(np.arange(10), 5)
    for variances, expected in (((0.2, 1.0, 0.0), 10), ((0.2, 0.0, 1.0), 50), ((0.2, 1.0, 1.0), 50 / 3)):
        found = nested.Components(*variances, "closed form")
        assert nested.effective_fits(found, person, trial) == pytest.approx(expected)


def _nested(folder, **options):
    tables = {"out_fits": folder / "fits.csv", "out_icc": folder / "icc.csv"}
    shareability(fits=write_fits(folder / "fits", **options), settings=SETTINGS, **tables)
    out = folder / "nested.csv"
    nested.nested_variance(fits=tables["out_fits"], icc=tables["out_icc"], settings=SETTINGS, out=out)
    return tables, out, read_table(out)


def test_interval_counts_trials_and_takes_the_best_restart(tmp_path):
    tables, _, rows = _nested(tmp_path, subjects=5)
    fits = read_table(tables["out_fits"])
    best = nested.best_restarts(fits)
    assert len(best) == 10
    for row in best:
        same = [f for f in fits if (f["subject"], f["trial"]) == (row["subject"], row["trial"])]
        assert number(row["J"]) == min(number(f["J"]) for f in same)
    logs = nested.log_parameters(best)
    low, high = icc.exact_interval(icc.one_way_anova(logs, np.repeat(np.arange(5), 2)))
    found = np.array([[number(row["trials_low"]), number(row["trials_high"])] for row in rows])
    np.testing.assert_allclose(found, np.column_stack([low, high]))
    by_fits = read_table(tables["out_icc"])
    assert [row["fits_low"] for row in rows] == [row["exact_low"] for row in by_fits]
    width = [number(r["trials_high"]) - number(r["trials_low"]) for r in rows]
    narrow = [number(r["exact_high"]) - number(r["exact_low"]) for r in by_fits]
    assert np.mean(width) > np.mean(narrow)
    assert {row["n_trials"] for row in rows} == {"10"}
    assert all(10 <= number(row["effective_fits"]) <= 50 for row in rows)


def test_too_few_people_or_trials_leave_a_status_and_no_numbers(tmp_path):
    tables, _, rows = _nested(tmp_path / "one", subjects=1)
    assert {row["status"] for row in rows} == {"needs at least 3 people, have 1"}
    assert {row["icc_reml"] + row["trials_low"] + row["fits_low"] + row["class"] for row in rows} == {""}
    tables, _, _ = _nested(tmp_path / "four", subjects=4)
    records = [row for row in read_table(tables["out_fits"]) if row["trial"] == "dynamic_1"]
    write_table(tables["out_fits"], list(records[0]), records)
    out = tmp_path / "single.csv"
    nested.nested_variance(fits=tables["out_fits"], icc=tables["out_icc"], settings=SETTINGS, out=out)
    assert {row["status"] for row in read_table(out)} == {
        "needs at least 2 trials of one person, have 1 each"
    }


SURE = {"determined": 0.9, "weak": 0.1, "not determined": 0.0, "at bound": 0.0}
OPEN = {"determined": 0.2, "weak": 0.1, "not determined": 0.7, "at bound": 0.0}
STUCK = {"determined": 0.1, "weak": 0.0, "not determined": 0.0, "at bound": 0.9}
UNSURE = {"determined": 0.3, "weak": 0.7, "not determined": 0.0, "at bound": 0.0}
C, D, U = "common", "distinct", "uncertain"


TIGHT, LOOSE = (0.3, 0.05, 0.02), (0.3, 0.05, 0.4)


@pytest.mark.parametrize(
    ("paper", "exact", "trials", "shares", "at_bound", "sd", "expected"),
    [
        (C, C, C, SURE, 0.0, TIGHT, SHARED),
        (C, C, C, SURE, 0.0, LOOSE, SEARCH),
        (C, U, U, SURE, 0.0, LOOSE, SEARCH),
        (C, U, U, SURE, 0.0, TIGHT, UNTOLD),
        (C, C, C, SURE, 0.0, (0.3, 0.5, 0.4), SHARED),
        (C, C, C, SURE, 0.0, (0.3, 0.01, 0.05), SHARED),
        (C, C, C, SURE, 0.0, (0.3, 0.1, np.nan), SHARED),
        (U, U, U, SURE, 0.0, LOOSE, UNTOLD),
        (C, D, D, SURE, 0.0, LOOSE, OWN),
        (D, D, D, SURE, 0.0, TIGHT, OWN),
        (U, D, D, UNSURE, 0.0, TIGHT, OWN),
        (C, C, C, OPEN, 0.0, TIGHT, FLAT),
        (C, U, U, UNSURE, 0.0, TIGHT, FLAT),
        (U, U, U, OPEN, 0.0, TIGHT, UNTOLD),
        (D, D, D, OPEN, 0.0, TIGHT, UNTOLD),
        (C, C, C, STUCK, 0.0, TIGHT, BOUND),
        (C, U, U, SURE, 0.6, TIGHT, BOUND),
        (D, D, D, STUCK, 0.9, TIGHT, UNTOLD),
    ],
)
def test_verdict_by_its_rules(paper, exact, trials, shares, at_bound, sd, expected):
    evidence = Evidence(
        paper=paper,
        exact=exact,
        nested=trials,
        shares=shares,
        fits_at_bound=at_bound,
        sd=sd,
        interval="0.10 to 0.45",
    )
    said, why = verdict(evidence)
    assert said == expected
    assert why


def _identifiability(path, told, trials=10):
    rows = [
        {"subject": f"S{i // 2}", "trial": f"dynamic_{i % 2 + 1}", "parameter": name, "verdict": what}
        for name, what in told.items()
        for i in range(trials)
    ]
    write_table(path, ("subject", "trial", "parameter", "verdict"), rows)
    return path


def test_classes_join_the_tables(tmp_path):
    tables, out, _ = _nested(tmp_path, subjects=5)
    told = dict.fromkeys(PARAMETERS, "determined") | {
        PARAMETERS[1]: "not determined",
        PARAMETERS[3]: "at bound",
    }
    target = tmp_path / "classes.csv"
    seen = _identifiability(tmp_path / "identifiability.csv", told)
    classes(icc=tables["out_icc"], nested=out, identifiability=seen, out=target)
    rows = {row["parameter"]: row for row in read_table(target, CLASS_COLUMNS)}
    assert rows[PARAMETERS[1]]["verdict"] == FLAT
    assert rows[PARAMETERS[3]]["verdict"] == BOUND
    assert rows[PARAMETERS[1]]["share_not_determined"] == "1.0"
    assert rows[PARAMETERS[0]]["share_determined"] == "1.0"
    assert {row["phantom"] for row in rows.values()} == {"true"}
    assert {row["class"] for row in list(rows.values())[1::2]} == {"common"}


def test_classes_of_too_few_people_cannot_be_told(tmp_path):
    tables, out, _ = _nested(tmp_path, subjects=1)
    target = tmp_path / "classes.csv"
    seen = _identifiability(tmp_path / "i.csv", dict.fromkeys(PARAMETERS, "determined"), trials=2)
    classes(icc=tables["out_icc"], nested=out, identifiability=seen, out=target)
    rows = read_table(target)
    assert {(row["verdict"], row["status"]) for row in rows} == {(UNTOLD, "needs at least 3 people, have 1")}
