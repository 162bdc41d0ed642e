"""Does the line find what the phantom put in? Raw exports to best fit, against the sealed truth.

    python benchmarks/recovery.py --noise-mm 0 0.5 --out recovery.json

For each noise level: people are written with effects and all measurement faults off but white marker noise, then
ingested, their limits taken, and each chosen trial fitted at the configured budget. Prints ln(fit / truth) of the best
restart per parameter and its RMS over all but k_ry and d_ry, which two markers on the y axis do not determine.
"""

from __future__ import annotations

import argparse
import copy
import json
import os
import sys
import tempfile
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

# two threads of BLAS beside another process cost a hundred times what they save
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np

ROOT = Path(__file__).parents[1]
sys.path.insert(0, str(ROOT / "workflow"))

from real2sim.configuration import read_yaml, validated
from real2sim.inference.parameters import PARAMETERS, as_vector
from real2sim.recording.ingest import ingest_subject
from real2sim.study.fit import best_of, fit_trial
from real2sim.study.limits import joint_limits
from real2sim.study.step_study import step_study
from real2sim.verification.cohort.plan import planned_files
from real2sim.verification.cohort.write import write_subject

UNOBSERVED = ("k_ry", "d_ry")
KEPT = [i for i, name in enumerate(PARAMETERS) if name not in UNOBSERVED]


def phantom_settings(noise_mm: float) -> dict:
    """config/phantom.yaml with effects off and, of the measurement, white marker noise alone."""
    source = ROOT / "config" / "phantom.yaml"
    settings = copy.deepcopy(validated(read_yaml(source), "phantom", source))
    settings["effects"]["enabled"] = False
    settings["trials"] |= {"walk_normal_trials": 1, "walk_robot_trials": 1}
    measurement = settings["measurement"]
    for part in measurement.values():
        if isinstance(part, dict):
            part["enabled"] = False
    measurement["enabled"] = noise_mm > 0
    measurement["marker_noise"] |= {"enabled": True, "low_m": noise_mm / 1e3, "high_m": noise_mm / 1e3}
    return settings


def prepare(folder: Path, subject: str, noise_mm: float, config: dict) -> None:
    """Write one person's raw exports, canonical tables and joint limits below ``folder``."""
    settings = phantom_settings(noise_mm)
    raw = planned_files(settings, folder / "raw", subject)
    write_subject(
        subject=subject,
        settings=settings,
        controllers=config["robot"],
        robot=ROOT / config["paths"]["robot"],
        out=raw,
        truth=folder / "sealed" / f"{subject}.json",
    )
    ingest_subject(
        subject=subject,
        folder=folder / "raw" / subject,
        settings=config["ingest"],
        raw=raw,
        out=folder / "trials" / subject,
    )
    trials = folder / "trials" / subject
    level = settings["cohort"][subject]["tightness"]["safe_comfortable_cm"]
    joint_limits(
        subject=subject,
        rotation=trials / f"rotation_T{level:02d}" / "pose.parquet",
        translation=trials / f"translation_T{level:02d}" / "pose.parquet",
        neutral=trials / "neutral" / "pose.parquet",
        out=folder / "limits" / f"{subject}.json",
    )

    step_study(
        subject=subject,
        pose=trials / "dynamic_1" / "pose.parquet",
        markers=trials / "dynamic_1" / "markers.parquet",
        limits=folder / "limits" / f"{subject}.json",
        robot=ROOT / config["paths"]["robot"],
        published=ROOT / config["paths"]["published"] / "table1_priors.csv",
        settings=config,
        out=folder / "plant" / f"{subject}.json",
    )


def _fit(job: tuple[Path, str, str, dict]) -> list[dict]:
    folder, subject, trial, config = job
    restarts = list(range(1, config["identification"]["restarts"] + 1))
    out = [folder / "fits" / subject / trial / f"restart-{restart}.json" for restart in restarts]
    fit_trial(
        subject=subject,
        trial=trial,
        restarts=restarts,
        pose=folder / "trials" / subject / trial / "pose.parquet",
        markers=folder / "trials" / subject / trial / "markers.parquet",
        limits=folder / "limits" / f"{subject}.json",
        step=folder / "plant" / f"{subject}.json",
        robot=ROOT / config["paths"]["robot"],
        settings={key: config[key] for key in ("identification", "plant", "robot")},
        out=out,
    )
    return [json.loads(path.read_text()) for path in out]


def recover(
    folder: Path, subjects: list[str], trials: list[str], noise_mm: float, config: dict, workers: int
) -> list[dict]:
    """One row per person and trial: ln-errors of the best restart, their RMS, cost and replay error."""
    with ProcessPoolExecutor(workers) as pool:
        n = len(subjects)
        list(pool.map(prepare, [folder] * n, subjects, [noise_mm] * n, [config] * n))
        jobs = [(folder, s, t, config) for s in subjects for t in trials]
        fits = [fit for own in pool.map(_fit, jobs) for fit in own]
    rows = []
    for subject in subjects:
        sealed = json.loads((folder / "sealed" / f"{subject}.json").read_text())
        truth = as_vector({name: sealed["parameters"][name]["value"] for name in PARAMETERS})
        for trial in trials:
            best = best_of([f for f in fits if (f["subject"], f["trial"]) == (subject, trial)])
            error = np.log(as_vector(best["parameters"]) / truth)
            rows.append(
                {
                    "subject": subject,
                    "trial": trial,
                    "noise_mm": noise_mm,
                    "J": best["cost"]["J"],
                    "rms_ln_error": float(np.sqrt(np.mean(error[KEPT] ** 2))),
                    "ln_error": dict(zip(PARAMETERS, np.round(error, 4).tolist(), strict=True)),
                    "replay": best["replay"],
                }
            )
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--noise-mm", type=float, nargs="+", default=[0.0, 0.5])
    parser.add_argument("--subjects", nargs="+", default=["S01", "S02", "S03", "S04", "S05"])
    parser.add_argument("--trials", nargs="+", default=["dynamic_1"])
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--out", type=Path)
    options = parser.parse_args()
    source = ROOT / "config" / "config.yaml"
    config = validated(read_yaml(source), "config", source)
    rows: list[dict] = []
    for noise_mm in options.noise_mm:
        with tempfile.TemporaryDirectory() as folder:
            rows += recover(Path(folder), options.subjects, options.trials, noise_mm, config, options.workers)
        done = [row for row in rows if row["noise_mm"] == noise_mm]
        for row in done:
            worst = max(KEPT, key=lambda i: abs(row["ln_error"][PARAMETERS[i]]))
            print(
                f"noise {noise_mm} mm  {row['subject']} {row['trial']}  J {row['J']:.3g}"
                f"  RMS ln-error {row['rms_ln_error']:.4f}"
                f"  (worst {PARAMETERS[worst]} {row['ln_error'][PARAMETERS[worst]]:+.3f},"
                f" k_ry {row['ln_error']['k_ry']:+.3f}, d_ry {row['ln_error']['d_ry']:+.3f})"
                f"  replay {row['replay']['rms_m'] * 1e3:.4f} mm {row['replay']['lag_s'] * 1e3:+.5f} ms"
            )
        pooled = float(np.sqrt(np.mean([row["rms_ln_error"] ** 2 for row in done])))
        print(f"noise {noise_mm} mm  all  RMS ln-error {pooled:.4f}")
    if options.out:
        options.out.write_text(json.dumps(rows, indent=1) + "\n")


if __name__ == "__main__":
    main()
