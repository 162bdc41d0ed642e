"""The statistics beside the paper's, from the real Snakefile: what runs, and what a changed setting repeats."""

import csv

TABLES = {
    "results/shareability/nested.csv": 12,
    "results/shareability/classes.csv": 12,
    "results/shareability/coverage.csv": 42,
    "results/shareability/power.csv": 24,
    "results/priors/anthropometrics.csv": 36,
}
TARGETS = [*TABLES, "results/figures/coverage.png"]


def test_tables_are_written_and_a_setting_repeats_only_its_rule(mini):
    mini.snakemake("--cores", "1", *TARGETS)
    for name, expected in TABLES.items():
        with (mini.folder / name).open() as stream:
            rows = list(csv.DictReader(stream))
        assert len(rows) == expected, name
        assert {row.get("phantom", "true") for row in rows} == {"true"}
    assert (mini.folder / "results/figures/coverage.svg").exists()
    study = {"draws": 30, "bootstrap": 50, "people": [5], "power_people": [5, 10]}
    mini.configure(statistics={"study": study})
    assert set(mini.planned(*TARGETS, "results/loso/loso.csv")) == {"coverage_study", "coverage_figure"}
    mini.snakemake("--cores", "1", *TARGETS)
    mini.configure(statistics={"regression": {"predictors": ["mass_kg"], "people_per_predictor": 5}})
    assert set(mini.planned(*TARGETS, "results/loso/loso.csv")) == {"anthropometrics"}
