"""The paper's tables with the plain model and with the diagnosed causes, and the fits that hold the causes."""

from __future__ import annotations

from itertools import permutations
from pathlib import Path

import numpy as np
import pytest
from real2sim.artefacts import number, read_table, write_json, write_table
from real2sim.effects.base import Placed
from real2sim.effects.catalogue import EFFECTS
from real2sim.errors import InputError
from real2sim.inference.parameters import PARAMETERS
from real2sim.study.explained import Causes
from real2sim.study.paper.with_effects import with_effects

from tests.unit.simulated_effects import SCALES, STRAP, replay
from tests.unit.test_coupling import PRIOR

TRIALS = ("dynamic_1", "dynamic_2")
PUBLISHED = Path(__file__).parents[2] / "resources" / "published"


def _answer(subject, verdict="soft_tissue"):
    return {"subject": subject, "verdict": verdict, "phantom": True}


def _priors(path, prior, of_class, source="this cohort"):
    columns = ("parameter", "unit", "prior", "interval_low", "interval_high", "class", "source", "status")
    status = "ok" if source == "this cohort" else "needs at least 3 people, have 2"
    rows = [[name, "N/m", prior, prior / 2, prior * 2, of_class, source, status] for name in PARAMETERS]
    write_table(path, columns, [dict(zip(columns, row, strict=True)) for row in rows])
    return path


def _icc(path, value, people=2, fits=20):
    row = {"icc": value, "n_subjects": people, "n_fits": fits}
    write_table(path, ("parameter", *row), [{"parameter": name} | row for name in PARAMETERS])
    return path


def _record(path, content):
    write_json(path, content | {"subject": path.stem, "phantom": True})
    return path


def _crossed(path, own, other, trials=TRIALS):
    pairs = [{"train": train, "test": test} for train, test in permutations(trials, 2)]
    means = {"J_within_mean": own, "J_cross_mean": other}
    return _record(path, {"overhead": other / own - 1, "pairs": pairs} | means)


def _left_out(path, best, prior, trials=TRIALS):
    of_trials = [{"trial": trial, "J_best": best, "J_prior": prior} for trial in trials]
    return _record(path, {"overhead_J": prior / best - 1, "trials": of_trials})


def _tables(folder, answers, *, crossed=_crossed, left_out=_left_out, fits=20, source="this cohort"):
    for name in ("diagnoses", "cross", "cross_explained", "loso", "loso_explained", "out"):
        (folder / name).mkdir(parents=True)
    ids = [answer["subject"] for answer in answers]
    for answer in answers:
        write_json(folder / "diagnoses" / f"{answer['subject']}.json", answer)
    out = [
        folder / "out" / f"{name}.{kind}" for name in ("table1_priors", "transfer") for kind in ("csv", "tex")
    ]
    with_effects(
        diagnoses=[folder / "diagnoses" / f"{name}.json" for name in ids],
        priors=[
            _priors(folder / "p.csv", 100.0, "common", source),
            _priors(folder / "q.csv", 125.0, "distinct", source),
        ],
        icc=[_icc(folder / "i.csv", 0.2, fits=fits), _icc(folder / "j.csv", "")],
        cross_trial=[crossed(folder / "cross" / f"{name}.json", 1.28, 1.46) for name in ids],
        cross_trial_explained=[crossed(folder / "cross_explained" / f"{n}.json", 0.02, 0.03) for n in ids],
        loso=[left_out(folder / "loso" / f"{name}.json", 1.28, 1.38) for name in ids],
        loso_explained=[_left_out(folder / "loso_explained" / f"{name}.json", 0.02, 0.12) for name in ids],
        published=[PUBLISHED / f"{name}.csv" for name in ("table1_priors", "cross_trial", "claims")],
        settings={"method": "cma"},
        out=out,
    )
    return {path.name: read_table(path) if path.suffix == ".csv" else path.read_text("utf-8") for path in out}


def test_table_i_has_both_models_and_the_published_numbers(tmp_path):
    made = _tables(tmp_path, [_answer("S01"), _answer("S02", "unknown")])
    rows, tex = made["table1_priors.csv"], made["table1_priors.tex"]
    first = rows[0]
    assert [row["parameter"] for row in rows] == list(PARAMETERS)
    assert (number(first["prior_plain"]), number(first["prior_with_effects"])) == (100, 125)
    assert number(first["change_percent"]) == pytest.approx(25)
    assert (first["class_plain"], first["class_with_effects"]) == ("common", "distinct")
    assert (first["icc_plain"], first["icc_with_effects"]) == ("0.2", "")
    assert (first["n_subjects"], first["n_with_a_cause"]) == ("2", "1")
    assert (first["published_prior"], first["published_class"]) == ("725", "common")
    assert first["phantom"] == "true"
    assert (first["search_plain"], first["search_with_effects"]) == ("CMA-ES", "least squares")
    assert "the plain one by CMA-ES, the one with causes by least squares" in tex
    assert "Phantom" in tex
    assert "100 [50, 200]" in tex


def test_a_published_prior_is_no_prior_of_a_model_and_does_not_change(tmp_path):
    made = _tables(tmp_path, [_answer("S01"), _answer("S02")], source="published (Table I)")
    first, tex = made["table1_priors.csv"][0], made["table1_priors.tex"]
    assert first["change_percent"] == ""
    assert (first["source_plain"], first["source_with_effects"]) == ("published (Table I)",) * 2
    assert first["status_plain"] == "needs at least 3 people, have 2"
    assert "100 [50, 200]" not in tex
    assert r"k\_tx & N/m & -- & 0.2 & -- & -- & -- & -- & 725 [205, 2570] & common" in tex
    assert "Dash: no prior of the fits (needs at least 3 people, have 2)." in tex


def test_transfer_says_what_the_parameters_cost_beside_the_overhead(tmp_path):
    made = _tables(tmp_path, [_answer("S01"), _answer("S02")])
    rows = {row["quantity"]: row for row in made["transfer.csv"]}
    assert number(rows["overhead_prior_of_others"]["plain"]) == pytest.approx(7.8125)
    assert number(rows["overhead_prior_of_others"]["with_effects"]) == pytest.approx(500)
    # the overhead differs by what the gap makes of J, the extra cost does not
    extra = rows["extra_prior_of_others"]
    assert number(extra["plain"]) == pytest.approx(number(extra["with_effects"])) == pytest.approx(0.1)
    assert rows["J_own"]["published"] == "1.28"
    assert rows["extra_other_trial"]["published"] == "0.18"
    assert rows["overhead_prior_of_others"]["published"] == "7.4"
    assert "500" in made["transfer.tex"]


def test_people_with_one_trial_leave_the_transfer_to_another_trial_empty(tmp_path):
    made = _tables(
        tmp_path,
        [_answer("S01")],
        crossed=lambda path, own, other: _record(path, {"status": "one", "pairs": []}),
    )
    rows = {row["quantity"]: row for row in made["transfer.csv"]}
    assert rows["J_own"]["plain"] == ""
    assert rows["J_own"]["n_subjects"] == "0"
    assert number(rows["J_prior_of_others"]["plain"]) == pytest.approx(1.38)


@pytest.mark.parametrize("of_other_trials", ["crossed", "left_out"])
def test_plain_results_with_a_third_trial_are_not_compared(tmp_path, of_other_trials):
    make = {"crossed": _crossed, "left_out": _left_out}[of_other_trials]

    def some(path, *costs):
        # the third trial is in the plain result alone
        return make(path, *costs, TRIALS if "explained" in path.parent.name else (*TRIALS, "dynamic_3"))

    with pytest.raises(
        InputError, match=r"S01: dynamic_1, dynamic_2, dynamic_3[\s\S]*expected: S01: dynamic_1, dynamic_2,"
    ):
        _tables(tmp_path, [_answer("S01"), _answer("S02", "none")], **{of_other_trials: some})


def test_plain_priors_of_more_fits_are_not_compared(tmp_path):
    with pytest.raises(InputError, match=r"n_fits = 30[\s\S]*n_fits = 20"):
        _tables(tmp_path, [_answer("S01"), _answer("S02", "none")], fits=30)


def test_causes_are_held_on_diagnosed_trials_alone():
    causes = Causes(Path(), {"train": ["dynamic_1"], "held_out": ["dynamic_2"]}, Path(), Path())
    with pytest.raises(InputError, match=r"dynamic_3[\s\S]*not diagnosed[\s\S]*dynamic_1 or dynamic_2"):
        causes.model(Path("results/trials/S01/dynamic_3"), Path("limits.json"), 1)


def test_a_replay_holds_its_effects_at_rest_until_told_otherwise():
    preload = next(e for e in EFFECTS if e.name == "preload" and not e.form)
    placed = Placed(preload, preload.places(STRAP)[1], SCALES)
    run, parameters = replay([placed]), np.stack([PRIOR, PRIOR])
    plain = replay([]).run(parameters)
    assert np.abs(run.run(parameters) - plain).max() < 1e-12
    run.hold([np.array([0.5])])
    held = run.run(parameters)
    np.testing.assert_array_equal(held, run.run_effects(parameters, [np.full((2, 1), 0.5)])[0])
    assert np.abs(held - plain).max() > 1e-3
