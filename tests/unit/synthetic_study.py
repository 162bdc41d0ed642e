"""The result files of a whole study with known content, for tests of its report."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from real2sim.artefacts import read_json, write_json, write_table
from real2sim.figures.fits import convergence_figure, icc_figure, loso_figure
from real2sim.figures.tables import CROSS_TRIAL_COLUMNS, priors_table
from real2sim.figures.tightness import tightness_figure
from real2sim.identification.assessment import TABLE_COLUMNS
from real2sim.identification.parameters import PARAMETERS, unit
from real2sim.quality.stage import COLUMNS as QUALITY_COLUMNS
from real2sim.statistics.loso import loso_table
from real2sim.statistics.shareability import priors, shareability
from real2sim.tightness import tightness_breakpoints, tightness_cohort, tightness_sweep
from synthetic_results import write_fits, write_loso, write_subject_yaml, write_sweep_poses

STATISTICS = {
    "bootstrap": 200,
    "seed": 1,
    "confidence": 0.95,
    "common_below": 0.50,
    "distinct_from": 0.75,
    "min_subjects": 3,
}
TIGHTNESS = {"bootstrap": 100, "permutations": 99, "seed": 1, "alpha": 0.05, "min_levels": 6}
PUBLISHED = Path(__file__).parents[2] / "resources" / "published"
VERDICTS = ("determined", "weak", "not determined", "at bound")
REMEDY = "Fill the gaps in QTM & record <again>."


def _fits(folder: Path, people: int, phantom: bool) -> list[Path]:
    paths = write_fits(folder / "fits", people, phantom=phantom, restarts=2)
    ident = {"restarts": 2, "evaluations": 1200, "seed": 1}
    for path in paths:
        about = {
            "method": "cma",
            "settings": {"identification": ident, "plant": {"timestep_s": 0.01}},
            "provenance": {
                "inputs_sha256": {f"results/trials/{path.parts[-3]}/pose.parquet": "ab" * 32},
                "python": "3.11.7",
                "packages": {"mujoco": "4.0.0"},
                "code_fingerprint": "0123456789abcdef",
            },
        }
        write_json(path, read_json(path) | about)
    return paths


def _tightness(folder: Path, people: list[str]) -> tuple[Path, list[Path], Path]:
    sweeps, breakpoints = [], []
    for name in people:
        yaml = write_subject_yaml(folder / name / "subject.yaml", loosest=5, tightest=12, selected=9)
        poses = write_sweep_poses(folder / name, list(range(5, 13)), 9, noise=0.3)
        sweeps.append(folder / name / "sweep.csv")
        breakpoints.append(folder / name / "breakpoints.json")
        tightness_sweep(subject=name, poses=poses, subject_yaml=yaml, out=sweeps[-1])
        tightness_breakpoints(sweep=sweeps[-1], subject_yaml=yaml, settings=TIGHTNESS, out=breakpoints[-1])
    cohort = folder / "cohort.json"
    tightness_cohort(sweeps=sweeps, breakpoints=breakpoints, settings=TIGHTNESS, out=cohort)
    figure = folder / "tightness.svg"
    tightness_figure(sweeps=sweeps, cohort=cohort, out=[figure])
    return cohort, breakpoints, figure


def _gates(path: Path, people: list[str]) -> Path:
    about = {"gate": "gaps", "unit": "s", "key": "quality.gaps", "remedy": REMEDY, "phantom": True}
    rows = [
        {
            "subject": name,
            "trial": trial,
            "verdict": verdict,
            "message": f"a gap of {i} s",
            "overridden": i == 2,
        }
        | about
        for name in people
        for i, (trial, verdict) in enumerate(
            (("neutral", "pass"), ("dynamic_1", "warn"), ("dynamic_2", "refuse")), start=0
        )
    ]
    write_table(path, QUALITY_COLUMNS, rows)
    return path


def _verdicts(path: Path, people: list[str], overridden: str) -> Path:
    rows = [
        {
            "subject": name,
            "trial": trial,
            "parameter": parameter,
            "unit": unit(parameter),
            "value": 100.0 + i,
            "ci95_low": 90.0 + i,
            "ci95_high": None if i % 4 == 3 else 120.0 + i,
            "verdict": VERDICTS[i % 4],
            "reason": "J is flat",
            "next_trial": "" if i % 4 == 0 else "a dynamic trial with holds",
            "overridden": overridden,
        }
        for name in people
        for trial in ("dynamic_1", "dynamic_2")
        for i, parameter in enumerate(PARAMETERS)
    ]
    write_table(path, TABLE_COLUMNS, rows)
    return path


def _cross_trial(path: Path, people: list[str]) -> Path:
    row = {
        "status": "ok",
        "J_within_mean_1": 0.06,
        "J_cross_mean_1": 0.07,
        "overhead_percent": 16.7,
        "n_pairs": 2,
    }
    floor = {"J_floor_1": 0.02, "J_floor_low_1": 0.018, "J_floor_high_1": 0.023}
    paper = {"subject": "paper", "status": "published", "J_within_mean_1": 1.28, "overhead_percent": 14.5}
    write_table(path, CROSS_TRIAL_COLUMNS, [*({"subject": n} | row | floor for n in people), paper])
    return path


def write_study(
    folder: Path, people: int = 4, *, phantom: bool = True, overridden: str = ""
) -> dict[str, Any]:
    """Write a study of some people and return the arguments of `report_page` but ``out`` and ``title``."""
    names = [f"S{i + 1:02d}" for i in range(people)]
    fits = _fits(folder, people, phantom)
    t = {name: folder / f"{name}.csv" for name in ("fits", "icc", "priors", "loso")}
    shareability(fits=fits, settings=STATISTICS, out_fits=t["fits"], out_icc=t["icc"])
    published = PUBLISHED / "table1_priors.csv"
    priors(fits=t["fits"], icc=t["icc"], published=published, settings=STATISTICS, out=t["priors"])
    shown = folder / "tables" / "priors.csv"
    priors_table(priors=t["priors"], published=published, out=shown)
    loso_table(
        loso=write_loso(folder / "loso", people) if people > 2 else [], settings=STATISTICS, out=t["loso"]
    )
    figures = {name: folder / f"{name}.svg" for name in ("icc", "loso", "convergence")}
    icc_figure(fits=t["fits"], icc=t["icc"], out=[figures["icc"]])
    loso_figure(loso=t["loso"], out=[figures["loso"]])
    convergence_figure(fits=fits, floors=[], out=[figures["convergence"]])
    cohort, breakpoints, tightness = _tightness(folder / "tightness", names)
    return {
        "people": dict.fromkeys(names, "calibration") | {"S99": "validation"},
        "figures": [tightness, *figures.values()],
        "quality": _gates(folder / "quality.csv", [*names, "S99"]),
        "tightness": cohort,
        "breakpoints": breakpoints,
        "cross_trial": _cross_trial(folder / "cross_trial.csv", names),
        "identifiability": _verdicts(folder / "identifiability.csv", names, overridden),
        "icc": t["icc"],
        "priors": shown,
        "loso": t["loso"],
        "fits": fits,
    }
