"""Power laws of the parameters in the body: recovered where there are people enough, refused where not."""

import json

import numpy as np
import pytest
import yaml
from real2sim.artefacts import number, read_table
from real2sim.errors import InputError
from real2sim.inference.parameters import PARAMETERS
from real2sim.study.statistics.anthropometrics import anthropometrics, power_law, variance_inflation
from real2sim.study.statistics.shareability import shareability
from synthetic_results import CENTRE
from test_statistics import SETTINGS

PREDICTORS = ["mass_kg", "height_m", "waist_m"]
REGRESSION = {
    "confidence": 0.95,
    "regression": {"predictors": PREDICTORS, "people_per_predictor": 10},
}
EXPONENTS = {"k_tx": (1.0, 0.0, 0.0), "d_rz": (0.0, 2.0, -1.5)}


def _cohort(folder, people, seed=0, noise=0.05, **same):
    """Fits and subject.yaml of people whose k_tx and d_rz follow their body; the other parameters do not."""
    rng = np.random.default_rng(seed)
    fits, subjects = [], []
    for i in range(people):
        body = {
            "mass_kg": float(70 * np.exp(0.15 * rng.normal())),
            "height_m": float(1.72 * np.exp(0.05 * rng.normal())),
            "waist_m": float(0.90 * np.exp(0.12 * rng.normal())),
        } | same
        name = f"S{i + 1:03d}"
        path = folder / name / "subject.yaml"
        path.parent.mkdir(parents=True)
        levels = {"loosest_cm": 5, "tightest_cm": 12, "safe_comfortable_cm": 9}
        about = {"id": name, "cohort": "calibration", "sex": "other", "age_years": 30, "tightness": levels}
        path.write_text(yaml.safe_dump(about | body))
        subjects.append(path)
        ln = np.log([body["mass_kg"] / 70, body["height_m"] / 1.72, body["waist_m"] / 0.90])
        own = np.array([np.dot(EXPONENTS.get(p, (0, 0, 0)), ln) for p in PARAMETERS])
        for trial in ("dynamic_1", "dynamic_2"):
            values = CENTRE * np.exp(own + noise * rng.normal(size=12))
            fit = {
                "subject": name,
                "trial": trial,
                "restart": 1,
                "parameters": dict(zip(PARAMETERS, values.tolist(), strict=True)),
                "cost": {"J": 1.2, "rmse_position_m": 0.03},
                "at_bound": [],
                "phantom": True,
            }
            fits.append(folder / f"{name}-{trial}.json")
            fits[-1].write_text(json.dumps(fit))
    table = folder / "fits.csv"
    shareability(fits=fits, settings=SETTINGS, out_fits=table, out_icc=folder / "icc.csv")
    return table, subjects


def _regressed(folder, people, settings=REGRESSION, **options):
    table, subjects = _cohort(folder, people, **options)
    out = folder / "anthropometrics.csv"
    anthropometrics(fits=table, subjects=subjects, settings=settings, out=out)
    return read_table(out)


def test_known_exponents_are_recovered_inside_their_intervals(tmp_path):
    # six wide intervals: all hold the truth in 994 of 1000 cohorts
    rows = _regressed(tmp_path, 40, REGRESSION | {"confidence": 0.999})
    assert len(rows) == 36
    found = {(r["parameter"], r["predictor"]): r for r in rows}
    for name, exponents in EXPONENTS.items():
        for predictor, true in zip(PREDICTORS, exponents, strict=True):
            row = found[name, predictor]
            assert number(row["exponent_low"]) < true < number(row["exponent_high"])
            assert number(row["exponent_high"]) - number(row["exponent_low"]) < 2.0
    assert number(found["k_tx", "mass_kg"]["p_holm"]) < 1e-6
    assert number(found["k_tx", "mass_kg"]["at_average"]) == pytest.approx(CENTRE[0], rel=0.1)
    null = [number(r["p_holm"]) for r in rows if r["parameter"] not in EXPONENTS]
    assert min(null) > 0.05
    assert {row["phantom"] for row in rows} == {"true"}
    assert {row["n_needed"] for row in rows} == {"30"}


def test_five_people_are_refused_with_how_many_it_takes(tmp_path):
    rows = _regressed(tmp_path, 5)
    assert {row["status"] for row in rows} == {"needs at least 30 people, have 5: 3 predictors"}
    assert {row["exponent"] + row["p_value"] + row["at_average"] for row in rows} == {""}


def test_fewer_predictors_need_fewer_people(tmp_path):
    settings = REGRESSION | {"regression": {"predictors": ["mass_kg"], "people_per_predictor": 10}}
    rows = _regressed(tmp_path / "a", 12, settings)
    assert [row["predictor"] for row in rows] == ["mass_kg"] * 12
    assert number(rows[0]["exponent"]) == pytest.approx(1.0, abs=0.3)
    assert "needs at least 10 people, have 9: 1 predictor" in {
        row["status"] for row in _regressed(tmp_path / "b", 9, settings)
    }


def test_a_measure_that_all_share_and_a_parameter_on_its_bound_are_said(tmp_path):
    rows = _regressed(tmp_path / "a", 30, height_m=1.72)
    assert {row["status"] for row in rows} == {"height_m is the same for everybody"}
    rows = _regressed(tmp_path / "b", 30, noise=0.0)
    assert {r["status"] for r in rows if r["parameter"] == "k_ty"} == {"no variance: all people are equal"}
    exact = [number(r["exponent"]) for r in rows if r["parameter"] == "d_rz"]
    assert exact == pytest.approx(EXPONENTS["d_rz"], abs=1e-6)


def test_predictors_that_fix_each_other_have_no_variance_inflation_to_speak_of():
    x = np.random.default_rng(0).normal(size=(50, 2))
    assert variance_inflation(x) == pytest.approx([1.0, 1.0], abs=0.2)
    assert np.isinf(variance_inflation(np.column_stack([x, x.sum(axis=1)]))).all()


def test_intervals_cover_the_exponent():
    rng, hits = np.random.default_rng(1), 0
    for _ in range(400):
        x = 0.1 * rng.normal(size=(30, 2))
        law = power_law(1.0 + x @ [0.5, -1.0] + 0.1 * rng.normal(size=30), x, 0.95)
        hits += int(np.sum((law.low <= [0.5, -1.0]) & (law.high >= [0.5, -1.0])))
    assert 0.925 < hits / 800 < 0.975


def test_a_person_without_subject_file_is_named(tmp_path):
    table, subjects = _cohort(tmp_path, 4)
    with pytest.raises(InputError, match="S001"):
        anthropometrics(fits=table, subjects=subjects[1:], settings=REGRESSION, out=tmp_path / "out.csv")
