"""The result files of a whole study with known content, for tests of its report."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from real2sim.artefacts import read_json, write_json, write_table
from real2sim.inference.parameters import PARAMETERS, unit
from real2sim.pages.fits import convergence_figure, icc_figure, loso_figure
from real2sim.pages.report.parts import FIGURES
from real2sim.pages.tables import CROSS_TRIAL_COLUMNS, priors_table
from real2sim.pages.tightness import tightness_figure
from real2sim.recording.quality.stage import COLUMNS as QUALITY_COLUMNS
from real2sim.study.assessment import TABLE_COLUMNS
from real2sim.study.paper.claims import claims
from real2sim.study.paper.tables import SIGMAS, paper_tables
from real2sim.study.statistics.anthropometrics import anthropometrics
from real2sim.study.statistics.classes import classes
from real2sim.study.statistics.loso import loso_table
from real2sim.study.statistics.nested import nested_variance
from real2sim.study.statistics.shareability import priors, shareability
from real2sim.study.tightness import tightness_breakpoints, tightness_cohort, tightness_sweep
from real2sim.study.twin.gait import SAGITTAL as JOINTS
from real2sim.study.twin.stage import BAR_COLUMNS, CLOUD_COLUMNS, GAIT_COLUMNS
from synthetic_results import write_fits, write_loso, write_subject_yaml, write_sweep_poses

STATISTICS = {
    "bootstrap": 200,
    "seed": 1,
    "confidence": 0.95,
    "common_below": 0.50,
    "distinct_from": 0.75,
    "min_subjects": 3,
    "regression": {"predictors": ["mass_kg", "height_m", "waist_m"], "people_per_predictor": 10},
}
TIGHTNESS = {"bootstrap": 100, "permutations": 99, "seed": 1, "alpha": 0.05, "min_levels": 6}
PAPER_TABLES = ("table1_priors", "table2_interface", "table3_gait", "cross_trial")
PUBLISHED = Path(__file__).parents[2] / "resources" / "published"
CLAIM_TABLES = (
    "claims",
    "bounds",
    "table1_priors",
    "table2_interface",
    "table3_gait",
    "pelvis_inertia",
    "deployed",
)
VERDICTS = ("determined", "weak", "not determined", "at bound")
# Walkers of a condition that all stay up
STOOD = {"survived": 8, "walkers": 8}
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


def _tightness(folder: Path, people: list[str], phantom: bool) -> tuple[Path, list[Path], Path]:
    sweeps, breakpoints = [], []
    for name in people:
        yaml = write_subject_yaml(folder / name / "subject.yaml", loosest=5, tightest=12, selected=9)
        poses = write_sweep_poses(folder / name, list(range(5, 13)), 9, noise=0.3, phantom=phantom)
        sweeps.append(folder / name / "sweep.csv")
        breakpoints.append(folder / name / "breakpoints.json")
        tightness_sweep(subject=name, poses=poses, subject_yaml=yaml, out=sweeps[-1])
        tightness_breakpoints(
            subject=name, sweep=sweeps[-1], subject_yaml=yaml, settings=TIGHTNESS, out=breakpoints[-1]
        )
    cohort = folder / "cohort.json"
    tightness_cohort(sweeps=sweeps, breakpoints=breakpoints, settings=TIGHTNESS, out=cohort)
    figure = folder / "tightness.svg"
    tightness_figure(sweeps=sweeps, cohort=cohort, out=[figure])
    return cohort, breakpoints, figure


def _gates(path: Path, people: list[str], phantom: bool) -> Path:
    about = {"gate": "gaps", "unit": "s", "key": "quality.gaps", "remedy": REMEDY, "phantom": phantom}
    about |= {"source": "gate"}
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
    rows += [
        {
            "subject": people[0],
            "trial": "neutral",
            "source": "finding",
            "gate": "facing",
            "verdict": "warn",
            "message": "neutral.tsv: the person faces 40 deg to the <left>",
            "remedy": "used as stated",
            "overridden": False,
            "phantom": phantom,
        }
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
            "fitted": 101.0 + i,
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


def write_twin(
    folder: Path, *, seeds: int = 3, subject: str = "S99", phantom: bool = True
) -> dict[str, Path]:
    """Tables of the twins of a person: bars, gait and interface, one row per seed and condition."""
    gait, cloud, bars = [], [], []
    for seed in range(1, seeds + 1):
        about = {"subject": subject, "seed": seed, "phantom": phantom}
        bars += [
            about | {"bar": "falls", "value": 0, "limit": 0, "met": True},
            about | {"bar": "rmse_deg_knee_angle", "value": 3.5, "limit": 3, "met": seed > 1},
        ]
        for name, cap, change in (
            ("free", None, None),
            ("walk_robot", None, -6.0),
            ("prior", 0.9, -2.0),
            ("prior", 1.0, 5.0),
        ):
            for joint in JOINTS:
                row = {"condition": name, "cap": cap, "joint": joint, "cycles": 20 + seed, "rom_sd_deg": 0.5}
                row |= {"robot": "study" if cap else "", "main": cap != 1.0} | (STOOD if cap else {})
                row |= {"rom_deg": 30.0 + seed, "rom_change_deg": change, "peak_deg": 15.0}
                gait.append(about | row | ({"r_walk_robot": 0.9 + 0.02 * seed} if cap else {}))
        for name, cap, sigma, factor in (
            ("walk_robot", None, (4.0, 10.0, 4.0), ""),
            ("soft", 0.9, (15.0, 22.0, 2.0), ""),
            ("prior", 0.9, (3.0, 5.0 + seed, 2.0), ""),
            ("prior", 0.9, (3.0, 12.0, 2.0), "lateral x0.1"),
            ("stiff", 0.9, (1.0, 1.0, 3.0), ""),
        ):
            sway = dict(zip(SIGMAS, (*sigma, sigma[0] / sigma[1]), strict=True))
            place = {"robot": "study" if cap else "", "main": True, "robot_factor": factor}
            place |= STOOD if cap else {}
            cloud.append(about | {"condition": name, "cap": cap} | place | sway)
    tables = {name: folder / f"{name}.csv" for name in ("bars", "gait", "interface")}
    write_table(tables["bars"], BAR_COLUMNS, bars)
    write_table(tables["gait"], GAIT_COLUMNS, gait)
    write_table(tables["interface"], CLOUD_COLUMNS, cloud)
    return tables


def write_paper(folder: Path, given: dict[str, Any], twin: dict[str, Path]) -> list[Path]:
    """Write the paper's tables into a folder and return them, each as CSV and LaTeX, in the order of `PAPER_TABLES`."""
    out = [folder / f"{name}.{kind}" for name in PAPER_TABLES for kind in ("csv", "tex")]
    paper_tables(
        priors=given["priors"],
        cross_trial=given["cross_trial"],
        published=[PUBLISHED / "table2_interface.csv", PUBLISHED / "table3_gait.csv"],
        out=out,
        subject="S99",
        gait=twin["gait"],
        interface=twin["interface"],
    )
    return out


def _paper(folder: Path, given: dict[str, Any], phantom: bool) -> dict[str, Path]:
    twin = write_twin(folder / "twin", phantom=phantom)
    out = write_paper(folder / "paper", given, twin)
    return {"interface": out[2], "gait": out[4], "bars": twin["bars"], "clouds": twin["interface"]}


def write_refined(path: Path, *, ratio: float = 1.01, share: float = 0.2, in_priors: bool = False) -> Path:
    """Refinement of an unseen person on one trial beside a full calibration."""
    against = {
        "J_ratio": ratio,
        "evaluations_over_best_restart": share,
        "evaluations_over_all_restarts": share / 5,
        "bar": {"J_ratio": 1.02, "evaluations_over_best_restart": 0.25},
        "met": ratio <= 1.02 and share <= 0.25,
    }
    trial = {
        "prior": {"J": 0.08},
        "refined": {"J": 0.03 * ratio, "evaluations": round(1200 * share)},
        "full": {"J": 0.03},
        "against_full": against,
    }
    record = {"subject": "S99", "status": "ok", "free": ["k_ty", "d_tx"], "also_free": []}
    write_json(path, record | {"prior_rests_on_person": in_priors, "trials": {"dynamic_1": trial}})
    return path


def claim_arguments(folder: Path, study: dict[str, Any]) -> dict[str, Any]:
    """Arguments of `claims` for a study of `write_study`, but those of its twin."""
    people = sorted({path.parent for path in (folder / "tightness").glob("*/subject.yaml")})
    return {
        "published": [PUBLISHED / f"{name}.csv" for name in CLAIM_TABLES],
        "people": people,
        "sweeps": [path / "sweep.csv" for path in people],
        "tightness": study["tightness"],
        "fits": folder / "fits.csv",
        "cross_trial": study["cross_trial"],
        "icc": study["icc"],
        "loso": study["loso"],
        "subject": "S99",
        "out": folder / "paper" / "claims.csv",
        "out_tex": folder / "paper" / "claims.tex",
        "out_numbers": folder / "paper" / "numbers.tex",
    }


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
    loso = write_loso(folder / "loso", people, phantom=phantom) if people > 2 else []
    loso_table(loso=loso, settings=STATISTICS, out=t["loso"])
    figures = {name: folder / f"{name}.svg" for name in ("icc", "loso", "convergence")}
    icc_figure(fits=t["fits"], icc=t["icc"], out=[figures["icc"]])
    loso_figure(loso=t["loso"], out=[figures["loso"]])
    convergence_figure(fits=fits, floors=[], out=[figures["convergence"]])
    cohort, breakpoints, tightness = _tightness(folder / "tightness", names, phantom)
    # drawn by other stages: any drawing stands for them
    for name in sorted(FIGURES.keys() - {"tightness", *figures}):
        figures[name] = folder / f"{name}.svg"
        figures[name].write_bytes(figures["loso"].read_bytes())
    verdicts = _verdicts(folder / "identifiability.csv", names, overridden)
    t |= {name: folder / f"{name}.csv" for name in ("nested", "classes", "anthropometrics")}
    nested_variance(fits=t["fits"], icc=t["icc"], settings=STATISTICS, out=t["nested"])
    classes(icc=t["icc"], nested=t["nested"], identifiability=verdicts, out=t["classes"])
    anthropometrics(
        fits=t["fits"],
        subjects=[folder / "tightness" / name / "subject.yaml" for name in names],
        settings=STATISTICS,
        out=t["anthropometrics"],
    )
    study: dict[str, Any] = {
        "people": dict.fromkeys(names, "calibration") | {"S99": "validation"},
        "figures": [tightness, *figures.values()],
        "quality": _gates(folder / "quality.csv", [*names, "S99"], phantom),
        "tightness": cohort,
        "breakpoints": breakpoints,
        "cross_trial": _cross_trial(folder / "cross_trial.csv", names),
        "identifiability": verdicts,
        "icc": t["icc"],
        "classes": t["classes"],
        "anthropometrics": t["anthropometrics"],
        "priors": shown,
        "loso": t["loso"],
        "fits": fits,
    }
    study |= _paper(folder, study, phantom)
    given = claim_arguments(folder, study)
    claims(**given)
    record = Path(__file__).parents[2] / "resources" / "paper_gap" / "causes.json"
    study |= {"claims": given["out"], "refined": [write_refined(folder / "refined.json")]}
    return study | {"paper_gap": record}
