"""Least squares and verdicts on residuals whose answer is known in closed form."""

from __future__ import annotations

import numpy as np
import pytest
from real2sim.configuration import validated
from real2sim.inference.identifiability import (
    AT_BOUND,
    DETERMINED,
    NORMAL_95,
    NOT_DETERMINED,
    WEAK,
    NoiseTerms,
    _judge,
    assess,
    interval_verdict,
    long_run_covariance,
    profile_end,
)
from real2sim.inference.least_squares import Residuals, Tangent, minimise, search
from real2sim.inference.noise_floor import block_bootstrap_mean
from real2sim.inference.parameters import PARAMETERS, Bounds

BOUNDS = Bounds(np.full(12, 1.0), np.full(12, 1000.0))
TRUTH = np.full(12, np.log(40.0))
SETTINGS = validated({}, "config", __file__)["identifiability"]
N = 3000


def linear(columns: np.ndarray, noise: np.ndarray):
    """Residuals A (z - z*) + noise of parameters exp(z): A is (n, 12)."""
    return lambda parameters: (np.log(parameters) - TRUTH) @ columns.T + noise


def design(strength: np.ndarray, seed: int = 0) -> np.ndarray:
    a = np.random.default_rng(seed).standard_normal((N, 12))
    return a / np.linalg.norm(a, axis=0) * strength


def correlated(rho: float, sd: float, seed: int) -> np.ndarray:
    white = np.random.default_rng(seed).standard_normal(N) * sd * np.sqrt(1 - rho**2)
    out = np.zeros(N)
    for i in range(1, N):
        out[i] = rho * out[i - 1] + white[i]
    return out


def test_search_reaches_the_minimum_in_a_few_dozen_evaluations():
    columns = design(np.logspace(0, -2, 12))
    noise = 1e-3 * np.random.default_rng(1).standard_normal(N)
    result = search(linear(columns, noise), BOUNDS, batch=13, screen=13, iterations=25, ftol=1e-8, seed=2)
    exact = TRUTH - np.linalg.lstsq(columns, noise, rcond=None)[0]
    assert np.allclose(np.log(result.parameters), exact, atol=1e-4)
    assert result.evaluations < 240
    assert np.all(np.diff(result.history["best"]) <= 0)
    assert result.history["evaluations"][-1] == result.evaluations


def test_search_is_reproducible_and_stays_within_bounds():
    columns, tight = design(np.ones(12)), Bounds(np.full(12, 60.0), np.full(12, 90.0))
    options = {"batch": 13, "screen": 13, "iterations": 25, "ftol": 1e-8, "seed": 5}
    one, two = (search(linear(columns, np.zeros(N)), tight, **options) for _ in range(2))
    assert np.array_equal(one.parameters, two.parameters)
    assert np.allclose(one.parameters, 60.0, rtol=1e-3)


def test_search_walks_around_a_simulation_that_fails():
    columns = design(np.ones(12))

    def residuals(parameters):
        out = linear(columns, np.zeros(N))(parameters)
        out[parameters[:, 0] > 300] = np.nan
        return out

    result = search(residuals, BOUNDS, batch=13, screen=39, iterations=50, ftol=1e-10, seed=3)
    assert np.allclose(np.log(result.parameters), TRUTH, atol=1e-3)


def test_fixed_parameters_do_not_move():
    problem = Residuals(linear(design(np.ones(12)), np.zeros(N)), BOUNDS, 13)
    start = TRUTH + 1.0
    z, cost, _, _ = minimise(problem, start, np.arange(1, 12), iterations=20, ftol=1e-10)
    assert z[0] == start[0]
    assert cost == pytest.approx(1.0, rel=0.2)


def test_a_tangent_taken_before_spares_jacobians_while_it_foretells_steps():
    columns = design(np.ones(12))
    problem = Residuals(linear(columns, np.zeros(N)), BOUNDS, 13)
    start = TRUTH + 0.3
    r, jacobian = problem.with_jacobian(start, np.arange(12))
    options = {"iterations": 20, "ftol": 1e-8, "keep": 0.3}
    counts = []
    for known in (None, Tangent(start + 1e-3, *problem.with_jacobian(start + 1e-3, np.arange(12)))):
        before = problem.evaluations
        z, _, _, _ = minimise(problem, start, np.arange(12), known=known, **options)
        assert np.allclose(z, TRUTH, atol=1e-3)
        counts.append(problem.evaluations - before)
    assert counts[1] == counts[0] - 12
    # one that predicts the wrong way is not believed
    wrong = Tangent(start + 1e-3, r, -jacobian)
    before = problem.evaluations
    minimise(problem, start, np.arange(12), known=wrong, **options)
    assert problem.evaluations - before == counts[0]


def test_long_run_variance_of_an_autoregression_is_the_textbooks():
    rho, sd, total = 0.8, 1.0, 0.0
    for seed in range(40):
        total += long_run_covariance(correlated(rho, sd, seed)[:, None], 60)[0, 0] / N / 40
    # variance times (1 + rho) / (1 - rho), less the Bartlett kernel's bias
    assert total == pytest.approx(sd**2 * (1 + rho) / (1 - rho), rel=0.15)


def test_profile_of_a_parabola_ends_where_it_should():
    problem = Residuals(linear(design(np.ones(12)), np.zeros(N)), BOUNDS, 13)
    end = profile_end(problem, TRUTH, 0.0, 3, 1, sd=0.3, threshold=1.0, iterations=10)
    gram = design(np.ones(12)).T @ design(np.ones(12))
    assert end - TRUTH[3] == pytest.approx(np.sqrt(np.linalg.inv(gram)[3, 3]), rel=0.02)


def verdicts(strength: np.ndarray, noise: np.ndarray, start=None) -> dict:
    columns = design(strength)
    exact = TRUTH - np.linalg.lstsq(columns + 1e-12, noise, rcond=None)[0]
    where = np.exp(np.clip(exact, np.log(1.0), np.log(1000.0))) if start is None else start
    return assess(
        linear(columns, noise), where, np.arange(N), BOUNDS, batch=13, rate_hz=100, settings=SETTINGS
    )["parameters"]


def test_verdicts_follow_what_the_data_say():
    strength = np.ones(12)
    strength[4], strength[7], strength[10] = 0.0, 0.06, 0.012
    noise = 0.012 * np.random.default_rng(4).standard_normal(N)
    # an SD of 0.012 / strength ln-units each
    start = np.exp(TRUTH.copy())
    rows = verdicts(strength, noise, start)
    assert rows["k_ry"]["verdict"] == NOT_DETERMINED
    assert rows["k_ry"]["ci95"] == [None, None]
    assert "as well" in rows["k_ry"]["reason"]
    assert "tilting" in rows["k_ry"]["next_trial"]
    assert rows[PARAMETERS[7]]["verdict"] == WEAK
    assert rows[PARAMETERS[10]]["verdict"] == NOT_DETERMINED
    assert rows["k_tx"]["verdict"] == DETERMINED
    assert rows["k_tx"]["next_trial"] is None


def test_parameter_at_its_bound_is_called_so():
    columns = design(np.ones(12))

    def residuals(parameters):
        beyond = TRUTH.copy()
        beyond[2] = np.log(2000.0)
        return (np.log(parameters) - beyond) @ columns.T + noise

    noise = 0.01 * np.random.default_rng(6).standard_normal(N)
    start = np.exp(TRUTH)
    start[2] = 999.0
    rows = assess(residuals, start, np.arange(N), BOUNDS, batch=13, rate_hz=100, settings=SETTINGS)[
        "parameters"
    ]
    assert rows["k_tz"]["verdict"] == AT_BOUND
    assert rows["k_tx"]["verdict"] == DETERMINED


@pytest.mark.parametrize("rho", [0.0, 0.9])
def test_intervals_cover_the_truth_whatever_the_autocorrelation(rho):
    # signatures as smooth as the residuals: there the naive interval is too short by sqrt((1 + r^2) / (1 - r^2))
    smooth = np.column_stack([correlated(rho, 1.0, 100 + i) for i in range(12)])
    smooth *= 1.0 / np.linalg.norm(smooth, axis=0)
    hits = trials = 0
    for seed in range(25):
        noise = correlated(rho, 0.02, seed)
        exact = TRUTH - np.linalg.lstsq(smooth, noise, rcond=None)[0]
        rows = assess(
            linear(smooth, noise),
            np.exp(exact),
            np.arange(N),
            BOUNDS,
            batch=13,
            rate_hz=100,
            settings=SETTINGS,
        )["parameters"]
        for row in rows.values():
            low, high = row["ci95"]
            hits += low <= 40.0 <= high
            trials += 1
    assert 0.90 <= hits / trials <= 0.99


def test_bias_is_taken_off_the_interval_and_doubted_when_large():
    noise = 0.01 * np.random.default_rng(8).standard_normal(N)
    columns = design(np.ones(12))
    exact = np.exp(TRUTH - np.linalg.lstsq(columns, noise, rcond=None)[0])
    shift = np.zeros(12)
    shift[0], shift[1] = 0.05, 0.3
    # the slope of what noise adds that pulls a quadratic's minimum by so much
    pull = -columns.T @ columns @ shift
    rows = assess(
        linear(columns, noise),
        exact,
        np.arange(N),
        BOUNDS,
        batch=13,
        rate_hz=100,
        settings=SETTINGS,
        noise=lambda z: NoiseTerms(pull, np.zeros((12, 12))),
    )["parameters"]
    middle = np.sqrt(rows["k_tx"]["ci95"][0] * rows["k_tx"]["ci95"][1])
    assert middle == pytest.approx(rows["k_tx"]["value"] * np.exp(-0.05), rel=1e-3)
    assert rows["k_tx"]["verdict"] == DETERMINED
    assert rows["k_ty"]["verdict"] == WEAK
    assert "noise of the pelvis" in rows["k_ty"]["reason"]


def test_noisy_input_is_told_from_information():
    # y = theta x + e, but x is measured as w = x + u: least squares is pulled down by sd_u^2 / (sd_x^2 + sd_u^2)
    sd_u, sd_e, per = 0.3, 0.1, N // 12
    hits = naive = cases = 0
    for seed in range(20):
        rng = np.random.default_rng(seed)
        x, u = rng.standard_normal((12, per)), sd_u * rng.standard_normal((12, per))
        w, y = x + u, 40.0 * x + 40.0 * sd_e * rng.standard_normal((12, per))

        def residuals(parameters, w=w, y=y):
            # the parameters' samples take turns
            return (parameters[:, :, None] * w - y).transpose(0, 2, 1).reshape(len(parameters), -1)

        def noise(z):
            energy = np.exp(2 * z) * per * sd_u**2
            return NoiseTerms(energy, np.diag(energy))

        fit = np.sum(w * y, axis=1) / np.sum(w * w, axis=1)
        options = {"batch": 13, "rate_hz": 100, "settings": SETTINGS}
        told = assess(residuals, fit, np.arange(len(w.ravel())), BOUNDS, noise=noise, **options)
        blind = assess(residuals, fit, np.arange(len(w.ravel())), BOUNDS, **options)
        for name in PARAMETERS:
            low, high = told["parameters"][name]["ci95"]
            hits += low <= 40.0 <= high
            low, high = blind["parameters"][name]["ci95"]
            naive += low <= 40.0 <= high
            cases += 1
    assert 0.90 <= hits / cases <= 0.99
    assert naive / cases < 0.5


def test_information_that_is_all_noise_determines_nothing():
    columns = design(np.ones(12))
    curvature = np.zeros((12, 12))
    # everything that the third parameter moves, the noise of the input moves
    curvature[2, 2] = (columns.T @ columns)[2, 2]
    noise = 0.01 * np.random.default_rng(9).standard_normal(N)
    exact = np.exp(TRUTH - np.linalg.lstsq(columns, noise, rcond=None)[0])
    options = {"batch": 13, "rate_hz": 100, "settings": SETTINGS}
    fit = linear(columns, noise)
    blind = assess(fit, exact, np.arange(N), BOUNDS, **options)["parameters"]
    told = assess(
        fit, exact, np.arange(N), BOUNDS, noise=lambda z: NoiseTerms(np.zeros(12), curvature), **options
    )["parameters"]
    assert blind["k_tz"]["verdict"] == DETERMINED
    assert told["k_tz"]["sd_ln"] > 10 * blind["k_tz"]["sd_ln"]
    assert told["k_tz"]["verdict"] in (WEAK, NOT_DETERMINED)
    assert told["k_tx"]["sd_ln"] == pytest.approx(blind["k_tx"]["sd_ln"], rel=0.1)


def test_parameter_that_is_flat_up_to_its_bound_is_not_determined():
    strength = np.ones(12)
    strength[2] = 0.004
    columns = design(strength)
    noise = 0.01 * np.random.default_rng(6).standard_normal(N)
    beyond = TRUTH.copy()
    beyond[2] = np.log(1e6)
    start = np.exp(TRUTH)
    start[2] = 999.0
    row = assess(
        lambda p: (np.log(p) - beyond) @ columns.T + noise,
        start,
        np.arange(N),
        BOUNDS,
        batch=13,
        rate_hz=100,
        settings=SETTINGS,
    )["parameters"]["k_tz"]
    assert row["value"] == pytest.approx(1000.0, rel=0.02)
    assert row["verdict"] == NOT_DETERMINED
    assert row["ci95"][1] is None


def test_far_reach_from_the_bound_is_not_determined_and_a_short_one_is_at_bound():
    def told(reach):
        ends = [None, np.log(reach)]
        return _judge("k_tz", 0.0, ends, 0.3, 0.0, True, SETTINGS)["verdict"]

    assert told(1.5) == AT_BOUND
    assert told(5.0) == NOT_DETERMINED


def test_profile_of_a_jagged_cost_ends():
    # refits that stop in one of many steps must not send the walk on for ever
    def residuals(parameters):
        z = np.log(parameters) - TRUTH
        jump = 0.5 * np.floor(3 * np.abs(z[:, 3:4])) * (np.sin(40 * z[:, 3:4]) > 0)
        return np.hstack([z, jump])

    problem = Residuals(residuals, BOUNDS, 13)
    end = profile_end(problem, TRUTH, 0.0, 3, 1, sd=0.3, threshold=0.5, iterations=4)
    assert end is None or TRUTH[3] < end <= problem.upper[3]
    assert problem.evaluations < 1500


def test_block_bootstrap_covers_the_mean_of_a_correlated_series():
    hits = 0
    for seed in range(60):
        low, high = block_bootstrap_mean(correlated(0.9, 1.0, seed), 100, 400, 0.95, seed)
        hits += low <= 0.0 <= high
    assert 0.85 <= hits / 60 <= 1.0
    assert block_bootstrap_mean(np.ones(50), 10, 100, 0.95, 1) == (1.0, 1.0)


def test_block_bootstrap_is_reproducible_by_seed():
    series = correlated(0.5, 1.0, 3)
    assert block_bootstrap_mean(series, 50, 200, 0.95, 7) == block_bootstrap_mean(series, 50, 200, 0.95, 7)


def test_jacobian_goes_round_a_simulation_that_fails():
    matrix = design(np.ones(12))
    line = linear(matrix, np.zeros(N))
    middle = (BOUNDS.lower * BOUNDS.upper) ** 0.5

    def fails_above(parameters):
        out = line(parameters)
        out[parameters[:, 3] > middle[3] * (1 + 1e-6)] = np.nan
        out[np.abs(parameters[:, 5] / middle[5] - 1) > 1e-6] = np.nan
        return out

    z = np.log(middle)
    whole = Residuals(line, BOUNDS, 13).with_jacobian(z, np.arange(12))[1]
    jacobian = Residuals(fails_above, BOUNDS, 13).with_jacobian(z, np.arange(12))[1]
    assert np.array_equal(jacobian[:, 5], np.zeros(N))
    rest = np.delete(np.arange(12), 5)
    np.testing.assert_allclose(jacobian[:, rest], whole[:, rest], rtol=1e-3, atol=1e-9)


def test_a_parameter_whose_sd_cannot_be_computed_is_not_determined():
    limits = {"too_wide": False, "at_bound": False, "determined_sd_ln": 0.1}
    assert interval_verdict(0.05, 0.0, **limits) == DETERMINED
    assert interval_verdict(np.nan, 0.0, **limits) == NOT_DETERMINED
    assert interval_verdict(0.05, np.nan, **limits) == NOT_DETERMINED
    assert interval_verdict(np.inf, 0.0, **limits) == NOT_DETERMINED


@pytest.mark.parametrize("of_input", [None, lambda z: NoiseTerms(np.zeros(12), 1e-3 * np.eye(12))])
def test_a_fit_beside_which_the_simulation_fails_determines_nothing(of_input):
    columns, noise = design(np.ones(12)), 1e-3 * np.random.default_rng(1).standard_normal(N)
    line = linear(columns, noise)
    best = TRUTH - np.linalg.lstsq(columns, noise, rcond=None)[0]

    def fails_above(parameters):
        out = line(parameters)
        out[np.log(parameters[:, 3]) > best[3] + SETTINGS["step_ln"] / 2] = np.nan
        return out

    options = {"batch": 13, "rate_hz": 100, "settings": SETTINGS, "noise": of_input}
    found = assess(fails_above, np.exp(best), np.arange(N), BOUNDS, **options)
    row = found["parameters"][PARAMETERS[3]]
    assert row["verdict"] == NOT_DETERMINED
    assert (row["ci95"], row["sd_ln"]) == ([None, None], None)
    assert "cannot be computed" in row["reason"]
    assert found["flat_directions"] == []


def test_a_weak_interval_is_as_wide_as_its_sd_where_noise_of_the_input_bends_the_cost():
    """Half of the curvature of J is what noise of the input makes of it."""
    weak, sd = 5e-3, 1e-3
    columns = design(np.r_[weak, np.ones(11)])
    residuals = linear(columns, sd * np.random.default_rng(4).standard_normal(N))
    best = TRUTH - np.linalg.lstsq(columns, residuals(np.exp(TRUTH)[None])[0], rcond=None)[0]
    curvature = np.zeros((12, 12))
    curvature[0, 0] = weak**2 / 2
    options = {"batch": 13, "rate_hz": 100, "settings": SETTINGS}
    found = assess(
        residuals,
        np.exp(best),
        np.arange(N),
        BOUNDS,
        **options,
        noise=lambda z: NoiseTerms(np.zeros(12), curvature),
    )
    row = found["parameters"][PARAMETERS[0]]
    assert row["verdict"] == WEAK
    half = np.log(row["ci95"][1] / row["ci95"][0]) / 2
    assert half == pytest.approx(1.96 * row["sd_ln"], rel=0.02)


@pytest.mark.parametrize("reach", [0.01, 0.7, 1.0])
def test_a_profile_that_meets_a_failing_simulation_has_an_open_end(reach):
    """The simulation fails from a ``reach`` of the interval's half width on."""
    columns = design(np.ones(12))
    sd = np.sqrt(np.linalg.inv(columns.T @ columns)[3, 3])
    line = linear(columns, np.zeros(N))

    def fails_above(parameters):
        out = line(parameters)
        out[np.log(parameters[:, 3]) > TRUTH[3] + reach * NORMAL_95 * sd] = np.nan
        return out

    problem = Residuals(fails_above, BOUNDS, 13)
    options = {"sd": 1.05 * sd, "threshold": NORMAL_95**2, "iterations": 10}
    assert profile_end(problem, TRUTH, 0.0, 3, 1, **options) is None
    below = profile_end(problem, TRUTH, 0.0, 3, -1, **options)
    assert below == pytest.approx(TRUTH[3] - NORMAL_95 * sd, rel=0.02)
