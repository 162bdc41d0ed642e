"""Cost in closed form, search on functions whose minimum is known, and the masks of a trial."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from real2sim.configuration import validated
from real2sim.errors import InputError
from real2sim.geometry import INTERFACE_MARKERS, PELVIS_MARKERS, quaternion, rotation_xyz
from real2sim.inference import least_squares
from real2sim.inference.cmaes import search
from real2sim.inference.cost import FAILED_COST, CostScales, TrialCost
from real2sim.inference.parameters import PARAMETERS, Bounds, as_dict, as_vector, unit
from real2sim.recording.trial import load_trial
from real2sim.study.fit import best_of, progress_of, restart_seed
from scipy.optimize import lsq_linear

SCALES = CostScales(0.041, 0.080)
BOUNDS = Bounds(np.full(12, 1.0), np.full(12, 1000.0))

START = {"start_window_s": 0.5, "start_known_share": 0.5, "settle_after_gap_s": 1.0}


def test_constant_offset_costs_position_alone():
    measured = np.random.default_rng(0).normal(size=(50, 2, 3))
    offset = np.array([0.003, -0.004, 0.012])
    terms = TrialCost(measured, 100, SCALES)(measured[None] + offset)
    assert terms.position[0] == pytest.approx(0.013**2 / 0.041**2)
    assert terms.velocity[0] == pytest.approx(0, abs=1e-20)
    assert terms.rmse_position[0] == pytest.approx(0.013)


def test_growing_offset_costs_its_speed():
    measured = np.zeros((101, 2, 3))
    drift = np.zeros((1, 101, 2, 3))
    drift[0, :, 0, 1] = 0.02 * np.arange(101) / 100
    terms = TrialCost(measured, 100, SCALES)(drift)
    assert terms.velocity[0] == pytest.approx(0.02**2 / 0.08**2 / 2)


def test_masked_samples_do_not_count():
    measured = np.zeros((100, 2, 3))
    measured[40:60, 1] = np.nan
    usable = np.ones(100, bool)
    usable[:10] = False
    cost = TrialCost(measured, 100, SCALES, usable)
    assert cost.samples == 90 + 70
    simulated = np.zeros((1, 100, 2, 3))
    simulated[0, :10] = simulated[0, 40:60, 1] = 5.0
    assert cost(simulated).position[0] == 0
    # where a masked sample starts, the neighbours' velocity is not measured either
    assert cost(simulated).velocity[0] == 0


def test_failed_simulation_costs_much_and_is_finite():
    cost = TrialCost(np.zeros((20, 2, 3)), 100, SCALES)
    simulated = np.zeros((2, 20, 2, 3))
    simulated[1] = np.nan
    total = cost(simulated).total
    assert total[0] == 0
    assert total[1] == pytest.approx(FAILED_COST)


def test_no_usable_sample_is_an_error():
    with pytest.raises(ValueError, match="usable"):
        TrialCost(np.full((20, 2, 3), np.nan), 100, SCALES)


def _bowl(parameters: np.ndarray) -> np.ndarray:
    weights = np.logspace(0, -2, 12)
    return np.sum(weights * (np.log(parameters) - np.log(50.0)) ** 2, axis=1)


def _search(**changes):
    options = {
        "population": 11,
        "sigma0": 1.22,
        "evaluations": 1200,
        "tolfun": 1e-6,
        "diagonal_iterations": 80,
        "seeds": [3],
    }
    return search(_bowl, BOUNDS, **(options | changes))[0]


def test_search_finds_the_minimum_within_the_budget():
    result = _search()
    assert np.abs(np.log(result.parameters / 50)).max() < 0.02
    assert result.evaluations <= 1210
    assert result.cost == pytest.approx(_bowl(result.parameters[None])[0])


def test_search_history_is_complete_and_never_rises():
    history = _search(evaluations=220).history
    assert history["evaluations"] == [11 * (i + 1) for i in range(len(history["best"]))]
    # pycma stops after the generation that exceeds the budget
    assert 220 <= history["evaluations"][-1] <= 231
    assert np.all(np.diff(history["best"]) <= 0)
    assert len(history["sigma"]) == len(history["best"]) == len(history["generation_best"])


def test_search_is_reproducible_by_seed_alone():
    one, two, other = _search(evaluations=110), _search(evaluations=110), _search(evaluations=110, seeds=[4])
    assert np.array_equal(one.parameters, two.parameters)
    assert one.history == two.history
    assert not np.array_equal(one.start, other.start)


def test_searches_side_by_side_are_those_that_run_alone():
    options = {
        "population": 11,
        "sigma0": 1.22,
        "evaluations": 330,
        "tolfun": 1e-6,
        "diagonal_iterations": 10,
    }
    together = search(_bowl, BOUNDS, seeds=[3, 4, 5], **options)
    for seed, result in zip((3, 4, 5), together, strict=True):
        alone = search(_bowl, BOUNDS, seeds=[seed], **options)[0]
        assert np.array_equal(alone.parameters, result.parameters)
        assert alone.history == result.history


def test_search_stays_within_bounds():
    tight = Bounds(np.full(12, 60.0), np.full(12, 70.0))
    result = search(
        _bowl,
        tight,
        population=11,
        sigma0=0.5,
        evaluations=2000,
        tolfun=1e-12,
        diagonal_iterations=0,
        seeds=[1],
    )[0]
    assert (result.parameters >= tight.lower * (1 - 1e-9)).all()
    assert set(tight.at_bound(result.parameters, 0.02)) == set(PARAMETERS)


@pytest.mark.parametrize("collinear", [0.0, 0.99], ids=["own ways", "nearly one way"])
@pytest.mark.parametrize("room", [10.0, 0.3, 0.03], ids=["far bounds", "some bounds", "near bounds"])
def test_a_bounded_step_leaves_least_of_all_steps_inside(collinear, room):
    rng = np.random.default_rng(4)
    for _ in range(20):
        slopes = rng.normal(size=(60, 8)) * 10.0 ** rng.uniform(-1, 3, size=8)
        slopes[:, 1:] = (1 - collinear) * slopes[:, 1:] + collinear * slopes[:, :1]
        residuals = rng.normal(size=60) + slopes @ rng.normal(size=8)
        # a parameter at its bound, one that does not move at all, and one without bounds
        lower, upper = -room * rng.uniform(0, 1, size=8), room * rng.uniform(0, 1, size=8)
        lower[0], lower[1], upper[1], lower[2], upper[2] = 0.0, 0.0, 0.0, -np.inf, np.inf
        step = least_squares.bounded_step(slopes.T @ slopes, slopes.T @ residuals, lower, upper)
        assert (step >= lower).all()
        assert (step <= upper).all()
        free = upper > lower
        best = lsq_linear(slopes[:, free], -residuals, (lower[free], upper[free]), method="bvls")
        left = np.sum((residuals + slopes @ step) ** 2)
        assert left == pytest.approx(2 * best.cost, rel=1e-6)
        assert left <= np.sum(residuals**2), "no step at all is inside too"


def test_restart_seeds_differ_by_person_trial_and_restart():
    names = [(s, t, r) for s in ("S01", "S02") for t in ("dynamic_1", "dynamic_2") for r in range(1, 6)]
    assert len({restart_seed(1, *name) for name in names}) == len(names)
    assert restart_seed(1, "S01", "dynamic_1", 1) == restart_seed(1, "S01", "dynamic_1", 1)


def test_parameters_have_names_units_and_order():
    assert PARAMETERS[0] == "k_tx"
    assert PARAMETERS[-1] == "d_rz"
    assert [unit(n) for n in ("k_ty", "k_rx", "d_tz", "d_ry")] == ["N/m", "Nm/rad", "Ns/m", "Nms/rad"]
    values = np.arange(12.0)
    assert np.array_equal(as_vector(as_dict(values)), values)


def test_best_of_takes_the_lowest_cost_and_the_first_of_equals():
    fits = [{"cost": {"J": j}, "restart": r} for j, r in ((0.3, 1), (0.1, 3), (0.1, 2))]
    assert best_of(fits)["restart"] == 2


def _tables(folder, pelvis_gap=slice(0, 0), interface_gap=slice(0, 0)):
    n = 400
    t = np.arange(n) / 100
    rotation = rotation_xyz(np.tile([0.0, 0.1, 0.0], (n, 1)))
    columns = {"time_s": t}
    for body, place, gap in (
        ("pelvis", [0.1, 0, 1.0], pelvis_gap),
        ("interface", [0, 0, 0.95], interface_gap),
    ):
        q, p = quaternion(rotation), np.tile(np.array(place, float), (n, 1))
        q[gap], p[gap] = np.nan, np.nan
        columns |= {f"{body}_{c}": p[:, i] for i, c in enumerate("xyz")}
        columns |= {f"{body}_q{c}": q[:, i] for i, c in enumerate("wxyz")}
    meta = {"rest": {"rotation": np.eye(3).tolist(), "position": [0.0, 0.0, 0.0]}, "phantom": True}
    table = pa.table(columns).replace_schema_metadata({"real2sim": json.dumps(meta)})
    pq.write_table(table, folder / "pose.parquet")
    names = (*PELVIS_MARKERS, *INTERFACE_MARKERS)
    markers = {"time_s": t} | {f"{m}_{c}": np.zeros(n) for m in names for c in "xyz"}
    pq.write_table(pa.table(markers), folder / "markers.parquet")
    return folder / "pose.parquet", folder / "markers.parquet"


def test_trial_masks_gaps_of_the_pelvis_and_the_time_to_settle(tmp_path):
    trial = load_trial(*_tables(tmp_path, pelvis_gap=slice(100, 140)), START)
    assert trial.usable[:100].all()
    assert not trial.usable[100:240].any()
    assert trial.usable[240:].all()
    assert trial.phantom
    assert np.allclose(trial.start_position, [0, 0, 0.95])


def test_trial_without_a_measured_start_is_refused(tmp_path):
    with pytest.raises(InputError, match=r"pose\.parquet(.|\n)*first 0\.5 s"):
        load_trial(*_tables(tmp_path, interface_gap=slice(0, 45)), START)


def test_a_search_that_fails_at_every_screened_point_has_a_history_of_numbers():
    bounds = Bounds(np.full(12, 0.5), np.full(12, 2.0))
    calls = []

    def residuals(parameters):
        calls.append(len(parameters))
        out = np.log(parameters)
        return out if len(calls) > 1 else np.full_like(out, np.nan)

    options = {"batch": 13, "screen": 13, "iterations": 25, "ftol": 1e-6, "seed": 1}
    found = least_squares.search(residuals, bounds, **options)
    assert found.cost < 1e-6
    assert np.isfinite(found.history["best"]).all()
    assert len(found.history["best"]) == len(found.history["evaluations"]) > 0
    nothing = least_squares.search(lambda p: np.full((len(p), 12), np.nan), bounds, **options)
    assert not np.isfinite(nothing.cost)


@pytest.mark.parametrize(
    ("method", "said"),
    [("cma", "S01: 50/200 evaluations, J 1.5"), ("least_squares", "S01: 50 evaluations, J 1.5")],
)
def test_progress_counts_up_to_a_number_only_where_that_is_known(capsys, method, said):
    ident = validated({"identification": {"method": method, "evaluations": 100}}, "config", Path("mine.yaml"))
    progress = progress_of("S01", ident["identification"], 2)
    progress._last -= 60
    progress(50, 1.5)
    written = capsys.readouterr().err
    assert written.startswith(said)
    assert ("s left" in written) == (method == "cma")
