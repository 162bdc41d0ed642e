"""ICC against published tables, bootstrap, classes, priors, leave-one-out, piecewise regression."""

import csv
import json
from pathlib import Path

import numpy as np
import pytest
from real2sim.artefacts import number, read_table, write_json, write_table
from real2sim.errors import InputError
from real2sim.inference.parameters import PARAMETERS, parameter_column, unit
from real2sim.study.statistics import icc
from real2sim.study.statistics.loso import leave_one_out_prior, loso_table, overhead
from real2sim.study.statistics.piecewise import (
    breakpoint_interval,
    breakpoint_interval_by_group,
    breakpoint_p_value,
    fit_piecewise,
)
from real2sim.study.statistics.shareability import (
    classify,
    prediction_interval,
    priors,
    read_fits,
    shareability,
)
from synthetic_results import CENTRE, write_fits, write_loso

SETTINGS = {
    "bootstrap": 2000,
    "seed": 1,
    "confidence": 0.95,
    "common_below": 0.50,
    "distinct_from": 0.75,
    "min_subjects": 3,
}
PUBLISHED = Path(__file__).parents[2] / "resources" / "published"
SHROUT_FLEISS = [[9, 2, 5, 8], [6, 1, 3, 2], [8, 4, 6, 8], [7, 1, 2, 6], [10, 5, 6, 9], [6, 2, 4, 7]]
WINE = np.transpose(
    [[1, 1, 3, 6, 6, 7, 8, 9], [2, 3, 8, 4, 5, 5, 7, 9], [0, 3, 1, 3, 5, 6, 7, 9], [1, 2, 4, 3, 6, 2, 9, 8]]
)


def _long(table):
    table = np.asarray(table, float)
    return table.reshape(-1, 1), np.repeat(np.arange(len(table)), table.shape[1])


@pytest.mark.parametrize(
    ("table", "estimate", "low", "high"),
    [(SHROUT_FLEISS, 0.16574, -0.13293, 0.72256), (WINE, 0.727521, 0.43377, 0.92670)],
    ids=["Shrout & Fleiss 1979", "wine"],
)
def test_icc_and_exact_interval_match_the_published_tables(table, estimate, low, high):
    anova = icc.one_way_anova(*_long(table))
    assert icc.icc_untruncated(anova)[0] == pytest.approx(estimate, abs=1e-5)
    found_low, found_high = icc.exact_interval(anova)
    assert [found_low[0], found_high[0]] == pytest.approx([low, high], abs=1e-5)


def test_mean_squares_of_shrout_and_fleiss():
    anova = icc.one_way_anova(*_long(SHROUT_FLEISS))
    assert [anova.ms_between[0], anova.ms_within[0]] == pytest.approx([11.2417, 6.2639], abs=1e-4)
    between, within = icc.variance_components(anova)
    assert between / (between + within) == pytest.approx(icc.icc_untruncated(anova))


def test_bootstrap_is_reproducible_by_seed_and_depends_on_it():
    values, subjects = _long(WINE)
    runs = [icc.cluster_bootstrap(values, subjects, resamples=500, seed=s) for s in (1, 1, 2)]
    assert (runs[0].low, runs[0].high) == (runs[1].low, runs[1].high)
    assert runs[0].low != runs[2].low


def test_bootstrap_equals_a_plain_loop_over_resampled_tables():
    values, subjects = np.random.default_rng(3).normal(size=(12, 2)), np.repeat(np.arange(4), 3)
    draws = np.random.default_rng(7).multinomial(4, np.full(4, 0.25), size=200)
    looped = []
    for draw in draws[~(draws == 4).any(axis=1)]:
        chosen = np.repeat(np.arange(4), draw)
        rows = np.concatenate([values[subjects == s] for s in chosen])
        looped.append(icc.icc_truncated(icc.one_way_anova(rows, np.repeat(np.arange(4), 3))))
    found = icc.cluster_bootstrap(values, subjects, resamples=200, seed=7)
    np.testing.assert_allclose(found.low, np.quantile(looped, 0.025, axis=0), atol=1e-12)
    np.testing.assert_allclose(found.high, np.quantile(looped, 0.975, axis=0), atol=1e-12)
    assert found.one_subject == int((draws == 4).any(axis=1).sum()) > 0


def test_two_people_have_no_bootstrap_interval():
    values = np.random.default_rng(1).normal(size=(10, 1))
    found = icc.cluster_bootstrap(values, np.repeat(["S01", "S02"], 5), resamples=200, seed=0)
    assert np.isnan([found.low[0], found.high[0]]).all()
    assert classify(found.low[0], found.high[0], common_below=0.5, distinct_from=0.75) == "uncertain"


def test_parameter_without_variance_has_no_icc_and_distinct_people_have_one():
    subjects = np.repeat(np.arange(3), 4)
    values = np.column_stack([np.full(12, np.log(15.0)), subjects.astype(float)])
    anova = icc.one_way_anova(values, subjects)
    assert np.isnan(icc.icc_untruncated(anova)[0])
    assert icc.icc_untruncated(anova)[1] == 1.0
    low, high = icc.exact_interval(anova)
    assert (low[1], high[1]) == (1.0, 1.0)
    found = icc.cluster_bootstrap(values, subjects, resamples=100, seed=0)
    assert np.isnan(found.low[0])
    assert found.undefined[0] == 100 - found.one_subject
    assert found.low[1] == 1.0
    assert classify(found.low[0], found.high[0], common_below=0.5, distinct_from=0.75) == "uncertain"


def test_unequal_numbers_of_fits_use_the_effective_group_size():
    subjects = np.array([0, 0, 0, 1, 1, 2])
    anova = icc.one_way_anova(np.arange(6.0)[:, None], subjects)
    assert anova.group_size == pytest.approx((6 - 14 / 6) / 2)


def test_exact_interval_covers_the_true_icc():
    rng = np.random.default_rng(0)
    subjects = np.repeat(np.arange(5), 10)
    values = 0.7 * rng.normal(size=(5, 2000))[subjects] + 0.8 * rng.normal(size=(50, 2000))
    low, high = icc.exact_interval(icc.one_way_anova(values, subjects))
    hits = np.mean((low <= 0.49 / 1.13) & (high >= 0.49 / 1.13))
    assert 0.935 < hits < 0.965


@pytest.mark.parametrize(
    ("low", "high", "expected"),
    [(0.0, 0.499, "common"), (0.0, 0.50, "uncertain"), (0.75, 1.0, "distinct"), (0.74, 1.0, "uncertain")],
)
def test_three_way_mapping_at_its_edges(low, high, expected):
    assert classify(low, high, common_below=0.50, distinct_from=0.75) == expected


def _share(folder, subjects, **options):
    fits = write_fits(folder / "fits", subjects, **options)
    out = {"out_fits": folder / "fits.csv", "out_icc": folder / "icc.csv"}
    shareability(fits=fits, settings=SETTINGS, **out)
    target = folder / "priors.csv"
    published = PUBLISHED / "table1_priors.csv"
    priors(fits=out["out_fits"], icc=out["out_icc"], published=published, settings=SETTINGS, out=target)
    return fits, read_table(out["out_icc"]), read_table(target)


def test_priors_are_geometric_mean_and_empirical_percentiles(tmp_path):
    fits, icc_rows, rows = _share(tmp_path, 5)
    values = np.array([json.loads(p.read_text())["parameters"]["k_tx"] for p in fits])
    assert number(rows[0]["prior"]) == pytest.approx(np.exp(np.mean(np.log(values))))
    low, high = np.percentile(values, [2.5, 97.5])
    assert [number(rows[0][f"interval_{e}"]) for e in ("low", "high")] == pytest.approx([low, high])
    assert {r["class"] for r in rows[1::2]} == {"common"}
    assert "common" not in {r["class"] for r in rows[::2]}
    assert icc_rows[5]["share_at_bound"] == "0.2"
    assert {r["phantom"] for r in rows} == {"true"}


def test_order_of_the_fit_files_does_not_matter(tmp_path):
    fits = write_fits(tmp_path / "fits", 3)
    for name, order in (("a", fits), ("b", fits[::-1])):
        out = {"out_fits": tmp_path / f"fits-{name}.csv", "out_icc": tmp_path / f"icc-{name}.csv"}
        shareability(fits=order, settings=SETTINGS, **out)
    assert (tmp_path / "icc-a.csv").read_bytes() == (tmp_path / "icc-b.csv").read_bytes()
    assert (tmp_path / "fits-a.csv").read_bytes() == (tmp_path / "fits-b.csv").read_bytes()


def test_the_next_person_lies_where_students_interval_says():
    # two people with two fits each, ln-means 0 and 2: SD sqrt(2), t(1) = 12.706, sqrt(1 + 1/2)
    values = np.exp(np.array([[-1.0], [1.0], [1.0], [3.0]]))
    low, high = prediction_interval(values, ["a", "a", "b", "b"], 0.95)
    reach = 12.7062 * np.sqrt(2) * np.sqrt(1.5)
    np.testing.assert_allclose(np.log([low[0], high[0]]), [1 - reach, 1 + reach], rtol=1e-5)
    assert np.isnan(prediction_interval(values[:2], ["a", "a"], 0.95)).all()
    # of many cohorts of five it holds the next person in 95 % of cases
    rng = np.random.default_rng(1)
    held = 0
    for _ in range(2000):
        person = rng.standard_normal(6)
        fits = np.exp(np.repeat(person[:5], 2) + 0.01 * rng.standard_normal(10))[:, None]
        low, high = prediction_interval(fits, [*np.repeat(list("abcde"), 2)], 0.95)
        held += low[0] <= np.exp(person[5]) <= high[0]
    assert 0.935 < held / 2000 < 0.965


def test_one_person_gets_the_published_priors_and_no_icc(tmp_path):
    _, icc_rows, rows = _share(tmp_path, 1, phantom=False)
    assert {r["status"] for r in icc_rows} == {"needs at least 3 people, have 1"}
    assert {r["icc"] + r["bootstrap_low"] + r["exact_high"] for r in icc_rows} == {""}
    assert [number(r["prior"]) for r in rows] == CENTRE.tolist()
    assert {r["source"] for r in rows} == {"published (Table I)"}


def test_fits_of_phantom_and_real_people_do_not_mix(tmp_path):
    paths = write_fits(tmp_path / "a", 1) + write_fits(tmp_path / "b", 1, phantom=False)
    with pytest.raises(InputError, match="the fit"):
        read_fits(paths)
    fit = json.loads(paths[-1].read_text())
    paths[-1].write_text(json.dumps(fit | {"subject": "S09"}))
    with pytest.raises(InputError, match="phantom"):
        read_fits([paths[0], paths[-1]])


def test_leave_one_out_prior_leaves_the_person_out(tmp_path):
    fits = read_fits(write_fits(tmp_path, 3))
    prior = leave_one_out_prior(fits, "S02")
    others = [f["parameters"]["d_rz"] for f in fits if f["subject"] != "S02"]
    assert prior["d_rz"] == pytest.approx(np.exp(np.mean(np.log(others))))
    with pytest.raises(ValueError, match="no fits"):
        leave_one_out_prior([f for f in fits if f["subject"] == "S02"], "S02")
    assert overhead(1.46, 1.28) == pytest.approx(0.140625)


def test_loso_table_has_the_mean_or_says_whom_it_needs(tmp_path):
    loso_table(loso=write_loso(tmp_path / "many", 4), settings=SETTINGS, out=tmp_path / "a.csv")
    mean = read_table(tmp_path / "a.csv")[-1]
    assert number(mean["overhead_J_percent"]) == pytest.approx(2.0)
    alone = tmp_path / "S01.json"
    write_json(alone, {"subject": "S01", "status": "needs at least 3 people, have 1", "phantom": False})
    loso_table(loso=[alone], settings=SETTINGS, out=tmp_path / "b.csv")
    rows = read_table(tmp_path / "b.csv")
    assert [r["status"] for r in rows] == ["needs at least 3 people, have 1"] * 2
    assert rows[-1]["overhead_J_percent"] == ""


def test_published_tables_agree_with_the_parameters():
    for name in ("table1_priors.csv", "bounds.csv"):
        rows = read_table(PUBLISHED / name, ("parameter", "unit", "place"))
        assert [(r["parameter"], r["unit"]) for r in rows] == [(p, unit(p)) for p in PARAMETERS]
    for path in PUBLISHED.glob("*.csv"):
        assert all(row["place"] for row in read_table(path, ("place",)))


def test_tables_keep_every_digit_and_leave_nan_empty(tmp_path):
    path = tmp_path / "t.csv"
    write_table(path, ["a", "b", "c"], [{"a": 0.1 + 0.2, "b": float("nan"), "c": True}])
    with path.open(newline="") as stream:
        assert list(csv.reader(stream)) == [["a", "b", "c"], ["0.30000000000000004", "", "true"]]
    with pytest.raises(InputError, match="header"):
        read_table(path, ["d"])
    with pytest.raises(ValueError, match="JSON"):
        write_json(tmp_path / "t.json", {"a": float("nan")})
    assert parameter_column("d_ry") == "d_ry_Nms_per_rad"


LEVELS = np.linspace(-1.2, 0.8, 9)


def _knee(x):
    return 12.0 + np.where(x < 0.1, -8.0, -1.5) * (x - 0.1)


def test_piecewise_recovers_exact_data():
    fit = fit_piecewise(LEVELS, _knee(LEVELS))
    found = [fit.breakpoint, fit.slope_1, fit.slope_2, fit.value_at_breakpoint]
    assert found == pytest.approx([0.1, -8.0, -1.5, 12.0], abs=1e-6)
    assert fit.sse < 1e-12
    np.testing.assert_allclose(fit.predict(LEVELS), _knee(LEVELS), atol=1e-6)


def test_piecewise_with_a_line_for_each_person():
    x, person = np.tile(LEVELS, 3), np.repeat(np.arange(3), len(LEVELS))
    fit = fit_piecewise(x, _knee(x) + 5.0 * person + (person - 1) * (x - 0.1), person)
    assert [fit.breakpoint, fit.slope_1, fit.slope_2] == pytest.approx([0.1, -8.0, -1.5], abs=1e-6)
    assert fit.value_at_breakpoint == pytest.approx(17.0, abs=1e-6)
    # who was measured at one level has no slope, and says nothing of the others'
    alone = fit_piecewise(np.append(x, 0.0), np.append(_knee(x), 99.0), np.append(person, 3))
    assert [alone.breakpoint, alone.slope_1, alone.slope_2] == pytest.approx([0.1, -8.0, -1.5], abs=1e-6)


def test_people_with_different_slopes_have_no_breakpoint_together():
    """With one slope for all, a fifth of such cohorts had one."""
    rng, found = np.random.default_rng(11), []
    x, person = np.tile(LEVELS, 8), np.repeat(np.arange(8), len(LEVELS))
    # each person's levels lie elsewhere, as normalised tightness puts them
    x = x + np.repeat(rng.uniform(-0.4, 0.4, 8), len(LEVELS))
    for seed in range(200):
        y = np.repeat(rng.normal(-4, 2, 8), len(LEVELS)) * x + rng.normal(size=len(x))
        found.append(breakpoint_p_value(x, y, person, permutations=199, seed=seed) <= 0.05)
    assert np.mean(found) < 0.1


def test_resamples_of_people_who_cannot_show_a_bend_are_left_out():
    """Of two people with sweeps and three at one level, some resamples hold the latter alone."""
    x = np.concatenate([np.tile(LEVELS, 2), np.zeros(3)])
    person = np.concatenate([np.repeat([0, 1], len(LEVELS)), [2, 3, 4]])
    y = _knee(x) + 0.3 * np.random.default_rng(3).normal(size=len(x))
    low, high = breakpoint_interval_by_group(x, y, person, bootstrap=400, seed=1, confidence=0.95)
    assert LEVELS[1] < low <= 0.1 <= high
    none = breakpoint_interval_by_group(
        LEVELS, LEVELS, np.arange(len(LEVELS)), bootstrap=20, seed=1, confidence=0.95
    )
    assert np.isnan(none).all()


def test_a_straight_line_has_no_breakpoint_and_few_levels_are_refused():
    assert breakpoint_p_value(LEVELS, 3 - 2 * LEVELS, permutations=99, seed=0) == 1.0
    with pytest.raises(ValueError, match="five distinct levels"):
        fit_piecewise(LEVELS[:4], LEVELS[:4])


@pytest.mark.parametrize("people", [1, 5])
def test_breakpoint_test_keeps_its_level_on_straight_lines(people):
    rng, x = np.random.default_rng(people), np.tile(LEVELS, people)
    groups = np.repeat(np.arange(people), len(LEVELS))
    noisy = 3 * groups - 2 * x + rng.normal(size=(800, len(x)))
    p = [breakpoint_p_value(x, y, groups, permutations=199, seed=i) for i, y in enumerate(noisy)]
    assert 0.03 < np.mean(np.array(p) <= 0.05) < 0.075


def test_breakpoint_test_finds_a_clear_knee_and_its_interval_holds_it():
    rng, found, held = np.random.default_rng(0), [], []
    for seed in range(60):
        y = _knee(LEVELS) + 0.4 * rng.normal(size=len(LEVELS))
        found.append(breakpoint_p_value(LEVELS, y, permutations=199, seed=seed) <= 0.05)
        low, high = breakpoint_interval(LEVELS, y, bootstrap=300, seed=seed, confidence=0.95)
        held.append(low <= 0.1 <= high)
    assert np.mean(found) > 0.9
    assert np.mean(held) > 0.8


def test_breakpoint_results_are_reproducible_by_seed():
    x, person = np.tile(LEVELS, 4), np.repeat(np.arange(4), len(LEVELS))
    y = _knee(x) + np.random.default_rng(5).normal(size=len(x))
    options = {"bootstrap": 200, "confidence": 0.95}
    for function in (breakpoint_interval, breakpoint_interval_by_group):
        assert function(x, y, person, seed=3, **options) == function(x, y, person, seed=3, **options)
    p = [breakpoint_p_value(x, y, person, permutations=200, seed=4) for _ in range(2)]
    assert p[0] == p[1]


def test_interval_by_group_equals_a_refit_of_the_resampled_people():
    x, person = np.tile(LEVELS, 3), np.repeat(np.arange(3), len(LEVELS))
    y = _knee(x) + np.random.default_rng(2).normal(size=len(x))
    draws = np.random.default_rng(9).multinomial(3, np.full(3, 1 / 3), size=20)
    refits = []
    for draw in draws:
        rows = np.concatenate([np.flatnonzero(person == p) for p in np.repeat(np.arange(3), draw)])
        refits.append(fit_piecewise(x[rows], y[rows], np.repeat(np.arange(3), len(LEVELS))).breakpoint)
    found = breakpoint_interval_by_group(x, y, person, bootstrap=20, seed=9, confidence=0.9)
    assert found == pytest.approx(np.quantile(refits, [0.05, 0.95]), abs=np.ptp(LEVELS) / 300)
