"""The paper's tables and claims: what contradicts itself is said, what is found here is judged by its criterion."""

from __future__ import annotations

import ast
import itertools
import re
from pathlib import Path

import numpy as np
import pytest
from real2sim.artefacts import number, read_json, read_table, write_json, write_table
from real2sim.errors import InputError
from real2sim.inference.parameters import parameter_column
from real2sim.pages.tables import PRIORS_COLUMNS
from real2sim.study.paper.claims import CONSISTENT, INCONSISTENT, NOT_COMPUTED, PRIVATE, SET, claims
from real2sim.study.paper.latex import escaped, latex_table, macro_name, macros
from real2sim.study.paper.tables import _priors_tex, paper_figures
from synthetic_study import (
    CLAIM_TABLES,
    PUBLISHED,
    claim_arguments,
    write_paper,
    write_refined,
    write_study,
    write_twin,
)

LIBRARY = Path(__file__).parents[2] / "workflow" / "real2sim"


@pytest.fixture(scope="module")
def study(tmp_path_factory):
    folder = tmp_path_factory.mktemp("study")
    return folder, write_study(folder)


def _judged(folder: Path, study: dict, out: Path, **changes) -> dict[str, dict[str, str]]:
    given = claim_arguments(folder, study) | {
        "out": out / "claims.csv",
        "out_tex": out / "claims.tex",
        "out_numbers": out / "numbers.tex",
    }
    claims(**given | changes)
    return {row["claim"]: row for row in read_table(given["out"])}


def _published(folder: Path, table: str, edit) -> list[Path]:
    """The published tables with one of them changed."""
    rows = read_table(PUBLISHED / f"{table}.csv")
    edit(rows)
    write_table(folder / f"{table}.csv", list(rows[0]), rows)
    return [folder / f"{n}.csv" if n == table else PUBLISHED / f"{n}.csv" for n in CLAIM_TABLES]


@pytest.fixture(scope="module")
def table(study, tmp_path_factory):
    twin = write_twin(tmp_path_factory.mktemp("twin"))
    out = tmp_path_factory.mktemp("out")
    return _judged(*study, out, gait=twin["gait"], interface=twin["interface"])


def test_every_claim_is_judged_with_a_reason_where_it_fails(table):
    assert list(table) == [row["claim"] for row in read_table(PUBLISHED / "claims.csv")]
    for row in table.values():
        assert row["verdict"]
        assert row["criterion"]
        if row["verdict"] in (INCONSISTENT, NOT_COMPUTED, PRIVATE):
            assert row["reason"], row["claim"]


def test_a_number_that_the_phantom_was_made_with_is_not_tested(table):
    made = {name for name, row in table.items() if row["verdict"] == SET}
    assert made - {"dof"} == {
        "n_calibration",
        "n_validation",
        "mass_mean",
        "height_mean",
        "waist_mean",
        "levels_fewest",
        "levels_most",
    }
    assert all(table[name]["reason"] for name in made)


def test_what_the_paper_contradicts_in_itself(table):
    wrong = {name for name, row in table.items() if row["verdict"] == INCONSISTENT}
    assert wrong == {
        "tight_cluster",
        "interval_in_bounds",
        "interval_percentiles",
        "damping_ratio",
        "refine_tested",
        "sigma_prior_best",
        "compresses_all",
        "bracketed_hip",
    }
    assert table["interval_in_bounds"]["reason"].startswith(
        "k_ty" if False else "d_tx, k_tz, k_ry, d_rz"
    ) or set(table["interval_in_bounds"]["reason"].split(":")[0].split(", ")) == {
        "d_tx",
        "k_tz",
        "k_ry",
        "d_rz",
    }
    assert "tx 3.2, rz 3.1" in table["damping_ratio"]["reason"]
    assert table["tight_cluster"]["reason"].startswith("k_tz")
    assert "ankle rises from 16.9 to 19.6" in table["compresses_all"]["reason"]
    assert {n for n, row in table.items() if row["verdict"] == CONSISTENT} == {
        "overhead_arithmetic",
        "gamma_arithmetic",
        "changes_arithmetic",
    }
    assert not any(table[name]["phantom"] == "true" for name in wrong)


@pytest.mark.parametrize(
    ("claim", "name", "change", "verdict"),
    [
        ("interval_in_bounds", "bounds", {"upper": "1e6", "lower": "1e-6"}, CONSISTENT),
        ("damping_ratio", "pelvis_inertia", {"value": "1000"}, CONSISTENT),
        ("interval_percentiles", "table1_priors", {"interval_low": "0.31"}, CONSISTENT),
        ("tight_cluster", "table1_priors", {"interval_low": "100", "interval_high": "200"}, CONSISTENT),
        ("gamma_arithmetic", "table2_interface", {"gamma": "0.500"}, INCONSISTENT),
        ("sigma_prior_best", "table2_interface", {"sigma_z_mm": "2.21"}, CONSISTENT),
        ("compresses_all", "table3_gait", {"rom_deg": "10.0"}, CONSISTENT),
        ("changes_arithmetic", "table3_gait", {"rom_deg": "10.0"}, INCONSISTENT),
        ("bracketed_hip", "table3_gait", {"rom_sd_deg": "0.1"}, CONSISTENT),
        ("overhead_arithmetic", "claims", {"published": "20"}, INCONSISTENT),
        ("refine_tested", "deployed", {"value": "5"}, CONSISTENT),
    ],
)
def test_a_check_of_the_paper_can_turn_out_the_other_way(study, tmp_path, claim, name, change, verdict):
    def edit(rows):
        for row in rows:
            if name != "claims" or row["claim"] == claim:
                row |= change

    published = _published(tmp_path, name, edit)
    assert _judged(*study, tmp_path / "out", published=published)[claim]["verdict"] == verdict


def test_a_cost_that_hangs_on_private_recordings_is_not_judged_on_the_phantom(table):
    for name in ("J_within", "J_cross"):
        assert table[name]["verdict"] in (PRIVATE, NOT_COMPUTED)
    assert table["overhead_highest"]["verdict"] == "reproduced on the phantom" or number(
        table["overhead_highest"]["here"]
    ) > number(table["overhead_highest"]["published"])


def test_real_people_are_judged_by_the_number_itself(tmp_path):
    given = write_study(tmp_path, phantom=False)
    costs = read_table(given["cross_trial"])
    mean = next(r for r in costs if r["subject"] == "S01") | {"subject": "mean", "J_within_mean_1": "1.3"}
    write_table(given["cross_trial"], list(costs[0]), [*costs, mean])
    found = _judged(tmp_path, given, tmp_path / "out")
    assert found["J_within"]["verdict"] == "reproduced"
    assert found["J_cross"]["verdict"] == "not reproduced"
    assert all(row["phantom"] == "false" for row in found.values())


@pytest.mark.parametrize("stage", ["sweeps", "tightness", "cross_trial", "loso"])
def test_claims_on_synthetic_people_say_so_before_anything_was_fitted(tmp_path, stage):
    given = claim_arguments(tmp_path, write_study(tmp_path, phantom=False))
    if stage == "tightness":
        write_json(given[stage], read_json(given[stage]) | {"phantom": True})
    else:
        path = given[stage][0] if stage == "sweeps" else given[stage]
        rows = read_table(path)
        write_table(path, list(rows[0]), [row | {"phantom": "true"} for row in rows])
    claims(**given)
    rows = {row["claim"]: row for row in read_table(given["out"])}
    assert rows["n_calibration"]["verdict"] == SET
    judged = {row["verdict"] for row in rows.values()}
    assert not {"reproduced", "not reproduced"} & judged
    assert rows["n_calibration"]["phantom"] == "true"


def test_the_bootstrap_is_judged_by_simulation(study, tmp_path):
    columns = ("method", "design", "icc", "n_people", "coverage")
    for low, verdict in ((0.7, "does not hold in simulation"), (0.94, "holds in simulation")):
        rows = [
            ("bootstrap", "restarts of trials", 0.0, 5, 0.95),
            ("bootstrap", "restarts of trials", 0.9, 5, low),
        ]
        rows += [
            ("bootstrap", "restarts of trials", 0.9, 50, 0.1),
            ("exact", "restarts of trials", 0.9, 5, 0.2),
        ]
        path = tmp_path / "coverage.csv"
        write_table(path, columns, [dict(zip(columns, row, strict=True)) for row in rows])
        found = _judged(*study, tmp_path, coverage=path)["bootstrap_coverage"]
        assert found["verdict"] == verdict
        assert number(found["here"]) == pytest.approx(100 * low)
        assert found["phantom"] == "false"


@pytest.mark.parametrize(
    ("ratio", "share", "fidelity", "cheap"),
    [(1.01, 0.2, "reproduced", "reproduced"), (1.05, 0.3, "not reproduced", "not reproduced")],
)
def test_refining_is_judged_beside_the_full_calibration(study, tmp_path, ratio, share, fidelity, cheap):
    refined = write_refined(tmp_path / "refined.json", ratio=ratio, share=share)
    found = _judged(*study, tmp_path, refined=[refined])
    assert found["refine_fidelity"]["verdict"] == f"{fidelity} on the phantom"
    assert found["refine_evaluations"]["verdict"] == f"{cheap} on the phantom"
    assert number(found["refine_fidelity"]["here"]) == pytest.approx(100 * (ratio - 1))
    assert found["refine_count"]["verdict"] == "not reproduced on the phantom"
    own = _judged(*study, tmp_path, refined=[write_refined(refined, in_priors=True)])
    assert own["refine_fidelity"]["verdict"] == NOT_COMPUTED, "somebody behind the priors is not unseen"


def test_what_beats_a_persons_own_fit_judges_nothing(study, tmp_path):
    """A search that stopped early is beaten by parameters from elsewhere: that is no sign that these carry over."""
    half = write_refined(tmp_path / "half.json", ratio=0.52)
    found = _judged(*study, tmp_path, refined=[half])["refine_fidelity"]
    assert found["verdict"] == NOT_COMPUTED
    assert "not converged" in found["reason"]
    assert "-48" in found["reason"]
    _, given = study
    for table, column, names in (
        ("cross_trial", "overhead_percent", ("overhead_mean", "overhead_highest")),
        ("loso", "overhead_J_percent", ("loso_J", "loso_rmse")),
    ):
        rows = read_table(given[table])
        changed = [row | {column: "-3" if row["subject"] == "S01" else row[column]} for row in rows]
        write_table(tmp_path / f"{table}.csv", list(rows[0]), changed)
        again = _judged(*study, tmp_path, **{table: tmp_path / f"{table}.csv"})
        assert {again[name]["verdict"] for name in names} == {NOT_COMPUTED}, table


def test_a_prior_may_have_a_smaller_rmse_than_the_fit_of_least_J(study, tmp_path):
    _, given = study
    rows = read_table(given["loso"])
    changed = [
        row | {"overhead_J_percent": "5", "overhead_rmse_percent": "-2" if row["subject"] == "S01" else "4"}
        for row in rows
    ]
    write_table(tmp_path / "loso.csv", list(rows[0]), changed)
    found = _judged(*study, tmp_path, loso=tmp_path / "loso.csv")["loso_rmse"]
    assert found["verdict"] == "reproduced on the phantom"


def test_a_count_of_refined_parameters_is_that_of_people_who_were_refined(study, tmp_path):
    path = write_refined(tmp_path / "refined.json")
    record = read_json(path)

    def count(**changed):
        write_json(path, record | changed)
        return _judged(*study, tmp_path, refined=[path])["refine_count"]

    assert number(count()["here"]) == 2
    assert number(count(also_free=["d_tx"])["here"]) == 1
    assert count(status="no dynamic trial: nothing to refine on")["verdict"] == NOT_COMPUTED
    _, given = study
    rows = read_table(given["icc"])
    write_table(tmp_path / "icc.csv", list(rows[0]), [row | {"class": ""} for row in rows])
    write_json(path, record)
    alone = _judged(*study, tmp_path, refined=[path], icc=tmp_path / "icc.csv")["refine_count"]
    assert alone["verdict"] == NOT_COMPUTED
    assert "Table I" in alone["reason"]


def test_claims_name_the_refused_trials_of_unseen_people(study, tmp_path):
    path = write_refined(tmp_path / "refined.json")
    write_json(path, read_json(path) | {"overridden_gates": {"S99/dynamic_1": ["spikes"]}})
    assert _judged(*study, tmp_path, refined=[path])["refine_fidelity"]["overridden"] == "S99/dynamic_1"


def test_table_i_in_latex_has_plain_numbers_and_the_configured_share():
    row = dict.fromkeys(PRIORS_COLUMNS, "") | {"parameter": "k_tx", "source": "this cohort"}
    row |= {"prior": "1724.6", "interval_low": "0.05", "interval_high": "12000", "confidence": "0.9"}
    tex = _priors_tex([row], phantom=False)
    assert "1720 & [0.05, 12000]" in tex
    assert r"central 90 \% of the fits" in tex


def test_a_knee_of_one_person_is_shared_with_nobody(study, table, tmp_path):
    knees = ("knee_rotation", "knee_x", "knee_y")
    assert all("on 32 levels of 4 people" in table[name]["reason"] for name in knees)
    _, given = study
    alone = read_json(given["tightness"])
    for pooled in alone["pooled"].values():
        pooled["n_subjects"] = 1
    write_json(tmp_path / "cohort.json", alone)
    found = _judged(*study, tmp_path, tightness=tmp_path / "cohort.json")
    for name in (*knees, "knee_at_selected"):
        assert found[name]["verdict"] == NOT_COMPUTED
        assert "needs at least 2 people, have 1" in found[name]["reason"]


@pytest.mark.parametrize(
    ("fits", "verdict"),
    [
        ([(15.0, "k_rz"), (15.1, "d_tx k_rz"), (15.2, "k_rz"), (60.0, "")], "reproduced"),
        ([(15.0, "k_rz"), (58.0, ""), (60.0, ""), (61.0, "d_rz")], "not reproduced"),
        ([(500.0, "k_rz")], "not reproduced"),
    ],
)
def test_k_rz_sits_on_its_lower_bound_where_most_fits_do(study, tmp_path, fits, verdict):
    folder, _ = study
    rows = read_table(folder / "fits.csv")
    column = parameter_column("k_rz")
    given = zip(rows, itertools.cycle(fits), strict=False)
    changed = [row | {column: str(value), "at_bound": bounds} for row, (value, bounds) in given]
    write_table(tmp_path / "fits.csv", [*rows[0]], changed)
    found = _judged(*study, tmp_path, fits=tmp_path / "fits.csv")["bound_k_rz"]
    assert found["verdict"].startswith(verdict)
    assert "on the lower bound" in found["reason"]


def test_gait_and_sway_are_judged_per_seed_at_the_compared_cap(study, table, tmp_path):
    assert table["hip_change"]["verdict"] == "reproduced on the phantom"
    assert number(table["hip_change"]["here"]) == -2
    assert "own walks change by -6" in table["hip_change"]["reason"]
    assert table["sway_order"]["verdict"] == "reproduced on the phantom"
    assert number(table["gamma_prior"]["here"]) == pytest.approx(np.mean([3 / 6, 3 / 7, 3 / 8]))
    assert "between 0.25 and 0.5" in table["gamma_value"]["reason"]
    assert table["hip_r"]["verdict"] == "not reproduced on the phantom"
    twin = write_twin(tmp_path / "twin")
    rows = read_table(twin["gait"])
    for row in rows:
        if row["condition"] == "prior" and row["seed"] == "2":
            row["rom_change_deg"] = "0.5"
    write_table(twin["gait"], list(rows[0]), rows)
    again = _judged(*study, tmp_path, gait=twin["gait"], interface=twin["interface"])
    assert again["hip_change"]["verdict"] == "not reproduced on the phantom"


def test_nobody_else_s_twin_is_taken_for_the_unseen_person_s(study, tmp_path):
    one, other = (write_twin(tmp_path / name, subject=name) for name in ("S99", "S01"))
    rows = [row | {"rom_change_deg": "3"} for row in read_table(other["gait"])]
    both = read_table(one["gait"])
    write_table(one["gait"], list(both[0]), [*rows, *both])
    found = _judged(*study, tmp_path / "out", gait=one["gait"], interface=one["interface"])
    assert found["hip_change"]["verdict"] == "reproduced on the phantom"
    assert number(found["hip_change"]["here"]) == -2


def _fall(twin: dict[str, Path], seeds: tuple[str, ...], condition: str = "prior") -> None:
    """Let every walker of a condition fall in some seeds, as `twin_table` writes it."""
    for name, kept in (("gait", ("rom_paper_deg",)), ("interface", ("gamma_paper",))):
        rows = read_table(twin[name])
        for row in rows:
            if row["condition"] == condition and row["seed"] in seeds and not row.get("robot_factor"):
                for key in list(row)[list(row).index("joint" if name == "gait" else "robot_factor") + 1 :]:
                    row[key] = row[key] if key in ("walkers", "phantom", *kept) else ""
                row |= {"survived": "0"} | ({"cycles": "0"} if name == "gait" else {})
        write_table(twin[name], list(rows[0]), rows)


def test_a_seed_in_which_everybody_fell_reproduces_nothing(study, tmp_path):
    twin = write_twin(tmp_path / "twin")
    # the seed that alone keeps hip_r from being reproduced
    _fall(twin, ("1",))
    found = _judged(*study, tmp_path / "out", gait=twin["gait"], interface=twin["interface"])
    for name in ("hip_change", "hip_r", "gamma_prior"):
        assert found[name]["verdict"] == "not reproduced on the phantom", name
        assert "In 1 of 3 seeds (seed 1) all walkers fell" in found[name]["reason"], name
    assert number(found["gamma_prior"]["here"]) == pytest.approx(np.mean([3 / 7, 3 / 8]))
    assert "In 1 of 3 seeds (seed 1) all walkers fell" in found["gamma_value"]["reason"]
    assert found["sway_order"]["verdict"] == "not reproduced on the phantom"
    assert "Holds in 2 of 3 seeds. In 1 of 3 seeds all walkers" in found["sway_order"]["reason"]
    assert (found["cycles"]["verdict"], number(found["cycles"]["here"])) == (
        "not reproduced on the phantom",
        0,
    )
    assert "In 2 of 12 walks" in found["cycles"]["reason"]
    assert "prior in seed 1 (study robot, fixed gait, cap 1.0). Of these walks 1" in found["cycles"]["reason"]


def test_where_everybody_fell_in_every_seed_the_claim_is_judged(study, tmp_path):
    twin = write_twin(tmp_path / "twin")
    _fall(twin, ("1", "2", "3"))
    found = _judged(*study, tmp_path / "out", gait=twin["gait"], interface=twin["interface"])
    for name in ("hip_change", "knee_change", "ankle_change", "hip_r", "gamma_prior", "gamma_value"):
        assert found[name]["verdict"] == "not reproduced on the phantom", name
        assert found[name]["here"] == "", name
        assert "In 3 of 3 seeds (seeds 1, 2, 3) all walkers fell" in found[name]["reason"], name


def test_a_seed_without_any_cloud_counts_among_the_seeds(study, tmp_path):
    twin = write_twin(tmp_path / "twin")
    for condition in ("walk_robot", "soft", "prior", "stiff"):
        _fall(twin, ("2",), condition)
    found = _judged(*study, tmp_path / "out", gait=twin["gait"], interface=twin["interface"])
    assert found["sway_order"]["verdict"] == "not reproduced on the phantom"
    assert "Holds in 2 of 3 seeds" in found["sway_order"]["reason"]


def test_tables_ii_and_iii_count_the_seeds_with_a_value_and_who_stayed_up(study, tmp_path):
    _, given = study
    twin = write_twin(tmp_path / "twin")
    _fall(twin, ("2", "3"))
    out = write_paper(tmp_path, given, twin)
    counts = ("seeds", "survived", "walkers")
    sway = {row["condition"]: row for row in read_table(out[2])}
    assert [sway["prior"][key] for key in counts] == ["1", "8", "24"]
    assert number(sway["prior"]["sigma_y_mm"]) == 6
    assert sway["prior"]["sigma_y_mm_seed_sd"] == ""
    assert [sway["soft"][key] for key in counts] == ["3", "24", "24"]
    assert [sway["walk_robot"][key] for key in counts] == ["", "", ""]
    gait = {(row["joint"], row["condition"]): row for row in read_table(out[4])}
    assert [gait["knee_angle", "prior"][key] for key in counts] == ["1", "8", "24"]
    assert [gait["knee_angle", "free"][key] for key in counts] == ["3", "", ""]
    assert "prior, simulated & 1 & 8/24 & 3.0 &" in out[3].read_text("utf-8")
    assert "knee & prior, simulated & 1 & 8/24 & 31.0 &" in out[5].read_text("utf-8")


def test_walks_of_a_synthetic_person_say_so_whatever_the_priors_rest_on(tmp_path):
    given = write_study(tmp_path, phantom=False)
    out = write_paper(tmp_path, given, write_twin(tmp_path / "twin"))
    for path in (out[2], out[4]):
        ours = [row for row in read_table(path) if row["seeds"]]
        assert {row["phantom"] for row in ours} == {"true"}, path.name
    assert all("phantom" in path.read_text("utf-8").lower() for path in (out[3], out[5]))
    assert "phantom" not in out[1].read_text("utf-8").lower(), "its priors are those of people"


def test_a_published_prior_is_not_printed_as_one_of_the_fits(tmp_path):
    write_study(tmp_path, people=1)
    rows = read_table(tmp_path / "paper" / "table1_priors.csv")
    assert {row["source"] for row in rows} == {"published (Table I)"}
    assert rows[0]["status"].startswith("needs at least")
    assert number(rows[0]["prior"]) == number(rows[0]["published_prior"])
    tex = (tmp_path / "paper" / "table1_priors.tex").read_text("utf-8")
    assert "k_tx & N/m & -- & -- & -- & 725 & [205, 2570] & common".replace("_", r"\_") in tex
    assert "Dash: no prior of the fits (needs at least 3 people, have 1)." in tex


def test_an_overhead_is_explained_by_the_ratio_to_noise_that_was_found(tmp_path):
    given = write_study(tmp_path)
    rows = read_table(given["loso"])
    write_table(given["loso"], list(rows[0]), [row | {"overhead_J_percent": "50"} for row in rows])
    costs = read_table(given["cross_trial"])
    mean = costs[0] | {"subject": "mean", "J_within_mean_1": "1.3"}
    write_table(given["cross_trial"], list(costs[0]), [*costs, mean | {"J_floor_1": "0.02"}])
    found = _judged(tmp_path, given, tmp_path / "out")["loso_J"]
    assert found["verdict"] == "not reproduced on the phantom"
    assert "whose J is 65 times that of noise alone" in found["reason"]
    assert "near the noise" not in found["reason"]
    write_table(given["cross_trial"], list(costs[0]), [*costs, mean | {"J_floor_1": ""}])
    without = _judged(tmp_path, given, tmp_path / "out")["loso_J"]["reason"]
    assert without.startswith("An overhead is a percentage of the own best fit; ")


def test_the_exact_interval_is_given_by_its_ends(study, tmp_path):
    _, given = study
    rows = read_table(given["icc"])
    for row in rows:
        row |= {"exact_low": "0.25", "exact_high": "0.75"}
    rows[3] |= {"exact_low": "0.125", "exact_high": "0.25"}
    path = tmp_path / "icc.csv"
    write_table(path, list(rows[0]), rows)
    reason = _judged(*study, tmp_path / "out", icc=path)["exact_common"]["reason"]
    narrow, wide = rows[3]["parameter"], rows[0]["parameter"]
    assert (
        f"widths between 0.125 ({narrow}, from 0.125 to 0.25) and 0.5 ({wide}, from 0.25 to 0.75)" in reason
    )
    assert "is wide" not in reason


def test_an_anisotropy_out_of_reach_is_not_put_on_private_data(study, tmp_path):
    twin = write_twin(tmp_path)
    rows = [row | {"gamma": "0.7"} for row in read_table(twin["interface"])]
    write_table(twin["interface"], list(rows[0]), rows)
    found = _judged(*study, tmp_path / "out", gait=twin["gait"], interface=twin["interface"])
    assert found["gamma_value"]["verdict"] == "not reproduced on the phantom"


def test_without_a_twin_or_enough_people_the_table_says_what_is_missing(tmp_path):
    given = write_study(tmp_path, people=1)
    found = _judged(tmp_path, given, tmp_path / "out")
    assert found["n_common"]["verdict"] == NOT_COMPUTED
    assert "needs at least" in found["n_common"]["reason"]
    for name in ("hip_change", "gamma_prior", "dof", "cycles"):
        assert found[name]["verdict"] == NOT_COMPUTED
        assert "twin" in found[name]["reason"]


def test_a_claim_without_a_judge_is_refused(study, tmp_path):
    published = _published(tmp_path, "claims", lambda rows: rows.append(rows[0] | {"claim": "new"}))
    with pytest.raises(InputError, match="new"):
        _judged(*study, tmp_path / "out", published=published)


def test_tables_hold_ours_beside_the_published_ones(study):
    folder, given = study
    sway = {row["condition"]: row for row in read_table(given["interface"])}
    assert list(sway) == ["walk_robot", "soft", "prior", "stiff"]
    assert number(sway["prior"]["sigma_y_mm"]) == 7
    assert number(sway["prior"]["sigma_y_mm_seed_sd"]) == 1
    assert sway["prior"]["published_gamma"] == "0.36"
    assert sway["walk_robot"]["seeds"] == sway["walk_robot"]["sigma_y_mm_seed_sd"] == "", (
        "it was measured once"
    )
    gait = {(row["joint"], row["condition"]): row for row in read_table(given["gait"])}
    assert number(gait["knee_angle", "prior"]["rom_deg"]) == 32
    assert number(gait["knee_angle", "prior"]["rom_change_deg"]) == -2, "at the compared cap alone"
    assert gait["knee_angle", "stiff"]["seeds"] == "0"
    assert number(gait["knee_angle", "stiff"]["published_rom_deg"]) == 62.2
    for name in ("table1_priors", "table2_interface", "table3_gait", "cross_trial", "claims"):
        tex = (folder / "paper" / f"{name}.tex").read_text()
        assert "No number here is the study's" in tex
        body = tex[tex.index(r"\midrule") : tex.index(r"\bottomrule")]
        columns = {line.count(" & ") for line in body.splitlines()[1:]}
        assert len(columns) == 1, name
        assert "nan" not in body
    numbers = (folder / "paper" / "numbers.tex").read_text()
    assert re.search(r"\\newcommand\{\\RtsNCommon\}\{\d+\}", numbers)
    assert not re.search(r"\\Rts\w*\d", numbers), "TeX has no digits in names"


def test_latex_of_awkward_text():
    assert escaped("50 % of a_b & {c} ± 1") == r"50 \% of a\_b \& \{c\} $\pm$ 1"
    assert macro_name("n_95th") == "NNineFiveth"
    assert macros({"loso_J": 12.3456}, phantom=False).endswith("\\newcommand{\\RtsLosoJ}{12.3}\n")
    tex = latex_table(["a", "b"], [["x", "1"]], caption="c", label="l", phantom=False)
    assert r"\begin{tabular}{lr}" in tex
    assert "phantom" not in tex.lower()


def test_figures_are_the_same_bytes_under_their_number(tmp_path):
    source = tmp_path / "a.png"
    source.write_bytes(b"picture")
    paper_figures(figures=[source], out=[tmp_path / "paper" / "figure3.png"])
    assert (tmp_path / "paper" / "figure3.png").read_bytes() == b"picture"


# Numbers that a page may hold in its own words: places in the paper, confidence, and what a method is called
_ALLOWED = re.compile(
    r"p\{0\.\d+\\linewidth\}|Fig\. \d|Table I+|eq\. \d|section [IVX]+-?[A-D]?(\.\d)?|95 %|ICC\(1,1\)|SHA-256"
    r"|first 16"
)


def _printed(path: Path) -> list[str]:
    """Words of a module that may end on a page: its strings, without docstrings, markup, styles and scripts."""
    tree = ast.parse(path.read_text(encoding="utf-8"))
    names = ("_STYLE", "_SCRIPT", "_COLOURS", "_RC", "RC", "_LIGHT", "_DARK")
    hidden = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Assign | ast.AnnAssign):
            targets = node.targets if isinstance(node, ast.Assign) else [node.target]
            if any(isinstance(t, ast.Name) and t.id in names for t in targets):
                hidden |= {id(child) for child in ast.walk(node)}
        if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant):
            hidden.add(id(node.value))
        if isinstance(node, ast.FormattedValue) and node.format_spec is not None:
            hidden |= {id(child) for child in ast.walk(node.format_spec)}
    return [
        node.value
        for node in ast.walk(tree)
        if isinstance(node, ast.Constant) and isinstance(node.value, str) and id(node) not in hidden
    ]


@pytest.mark.parametrize(
    "module",
    [
        "pages/person.py",
        "pages/report/page.py",
        *(f"pages/report/{part}.py" for part in ("parts", "top", "recordings", "identification", "priors")),
        *(f"pages/report/{part}.py" for part in ("diagnoses", "walking", "claims", "foot")),
        "pages/suite.py",
        "pages/diagnosis.py",
        "study/paper/claims.py",
        "study/paper/tables.py",
    ],
)
def test_no_number_on_a_page_is_typed_by_hand(module):
    typed = []
    for text in _printed(LIBRARY / module):
        words = re.sub(r"<[^>]*>|[a-z_]+=\"[^\"]*\"|#[0-9a-fA-F]{3,6}|\\[a-z]+", " ", _ALLOWED.sub(" ", text))
        typed += [
            (text, n)
            for n in re.findall(
                r"(?<![\w.-])\d+(?:\.\d+)?\s*(?:%|mm|deg|N|s|people|times|parameters|trials|levels|seeds)\b|\d+\.\d+",
                words,
            )
        ]
    assert not typed


def test_the_search_for_typed_numbers_finds_one(tmp_path):
    module = tmp_path / "page.py"
    module.write_text('"""Doc with 3.5."""\nX = f"the overhead is 14.5 % of {1:.3g}"\n')
    assert _printed(module) == ["the overhead is 14.5 % of "]
