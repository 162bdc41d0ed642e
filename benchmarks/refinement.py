"""Is a refinement inside the priors' intervals as good as a full calibration? Everyone of a finished study, left out.

    python benchmarks/refinement.py --results results --out refinement.json

For each person of the calibration cohort the priors and classes of the others are made anew, what they leave open is
refined on each dynamic trial, and J, evaluations and seconds are compared with the person's own fits of the study.
Where J is more than 2 % above, it is looked for whether the ends of intervals are the cause (J beyond the ends reached)
or fixed priors: those are then freed one by one, each time the one that gains most. Reads no truth.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import tempfile
import time
from pathlib import Path

# two threads of BLAS beside another process cost a hundred times what they save
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np

ROOT = Path(__file__).parents[1]
sys.path.insert(0, str(ROOT / "workflow"))

from real2sim.configuration import read_yaml, validated
from real2sim.inference.parameters import Bounds
from real2sim.recording.trial import trial_model, with_step
from real2sim.study.fit import BATCH, best_of
from real2sim.study.refinement import (
    J_BAR,
    Search,
    against_full,
    beyond_ends,
    ends_reached,
    opened,
    read_search,
    refine_residuals,
    would_gain,
)
from real2sim.study.statistics.shareability import priors, shareability


def search_of_others(fits: list[Path], subject: str, config: dict, bounds: Bounds) -> Search:
    """What the priors of everyone but one leave open."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        tables = {key: folder / f"{key}.csv" for key in ("fits", "icc", "priors")}
        others = [path for path in fits if path.parts[-3] != subject]
        shareability(
            fits=others, settings=config["statistics"], out_fits=tables["fits"], out_icc=tables["icc"]
        )
        priors(
            fits=tables["fits"],
            icc=tables["icc"],
            published=ROOT / config["paths"]["published"] / "table1_priors.csv",
            settings=config["statistics"],
            out=tables["priors"],
        )
        return read_search(tables["priors"], bounds, [], config["refinement"]["interval"])


def judged(folder: Path, subject: str, trial: str, search: Search, config: dict, bounds: Bounds) -> dict:
    """One trial: refined against its own fits."""
    tables = folder / "trials" / subject / trial
    settings = with_step(config, folder / "plant" / f"{subject}.json")
    model = trial_model(
        pose=tables / "pose.parquet",
        markers=tables / "markers.parquet",
        limits=folder / "limits" / f"{subject}.json",
        robot=ROOT / config["paths"]["robot"],
        settings=settings,
        nsim=BATCH,
    )
    fits = [
        json.loads(path.read_text()) for path in sorted((folder / "fits" / subject / trial).glob("*.json"))
    ]
    best = best_of(fits)
    full = {
        "J": best["cost"]["J"],
        "evaluations_best_restart": best["evaluations"],
        "evaluations": sum(fit["evaluations"] for fit in fits),
    }

    def residuals(parameters: np.ndarray) -> np.ndarray:
        return model.cost.residuals(model.replay.run(parameters))

    options = config["identification"]["least_squares"]
    how = {"batch": BATCH, "iterations": options["iterations"], "ftol": options["ftol"]}
    begin = time.perf_counter()
    refined = refine_residuals(residuals, search, **how)
    seconds = time.perf_counter() - begin
    tolerance = config["identification"]["at_bound_ln"]
    row = {
        "subject": subject,
        "trial": trial,
        "open": len(search.free),
        "J_prior": float(model.costs(search.prior[None])[0]),
        "J_refined": refined.cost,
        "J_full": full["J"],
        "evaluations": refined.evaluations,
        "seconds": seconds,
        **against_full(refined.cost, refined.evaluations, full),
        "ends": ends_reached(refined.values, search, bounds, tolerance),
        "blame": [],
    }
    lags = round(
        config["identifiability"]["autocorrelation_s"] / float(model.trial.time_s[1] - model.trial.time_s[0])
    )
    further = beyond_ends(residuals, refined, search, bounds, row["ends"], **how)
    row["J_ratio_beyond_ends"] = row["J_ratio"] if further is None else further["J"] / full["J"]
    ratio = row["J_ratio_beyond_ends"]
    while ratio > J_BAR and len(search.free) < 12:
        gained, _ = would_gain(
            residuals,
            model.cost.sample_of_residual(),
            refined,
            search,
            bounds,
            batch=BATCH,
            lags=lags,
            settings=config["identifiability"],
        )
        name, about = next(iter(gained.items()))
        search = opened(search, bounds, [name])
        refined = refine_residuals(residuals, search, start=refined.values, **how)
        ratio = refined.cost / full["J"]
        row["blame"].append({"parameter": name, "value": about["value"], "J_ratio_once_free": ratio})
    return row


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--results", type=Path, default=Path("results"))
    parser.add_argument("--config", type=Path, default=ROOT / "config" / "config.yaml")
    parser.add_argument(
        "--interval", choices=("prediction", "spread"), help="that of the configuration by default"
    )
    parser.add_argument("--people", nargs="*", help="all that have fits by default")
    parser.add_argument("--out", type=Path)
    given = parser.parse_args()
    config = validated(read_yaml(given.config), "config", given.config)
    if given.interval:
        config["refinement"]["interval"] = given.interval
    bounds = Bounds.from_config(config["identification"]["bounds"])
    cohort = sorted(
        {row.split(",")[0] for row in (given.results / "shareability/fits.csv").read_text().split()[1:]}
    )
    fits = [path for name in cohort for path in sorted((given.results / "fits" / name).rglob("*.json"))]
    rows = []
    folders = sorted((given.results / "fits").iterdir())
    for folder in (f for f in folders if not given.people or f.name in given.people):
        for trial in sorted(path.name for path in folder.iterdir()):
            search = search_of_others(fits, folder.name, config, bounds)
            row = judged(given.results, folder.name, trial, search, config, bounds)
            rows.append(row)
            print(
                f"{folder.name} {trial}: {row['open']} open, J {row['J_prior']:.4g} at the prior,"
                f" {row['J_refined']:.4g} refined, {row['J_full']:.4g} full (ratio {row['J_ratio']:.4f},"
                f" {row['J_ratio_beyond_ends']:.4f} beyond the ends reached); {row['evaluations']} evaluations"
                f" ({row['evaluations_over_best_restart']:.1%} of one restart), {row['seconds']:.1f} s;"
                f" {'met' if row['met'] else 'MISSED'}; ends {sorted(row['ends'])};"
                f" blame {[b['parameter'] for b in row['blame']]}",
                flush=True,
            )
    met = sum(row["met"] for row in rows)
    print(
        f"{met} of {len(rows)} trials meet the bar; worst J ratio {max(row['J_ratio'] for row in rows):.4f}"
    )
    if given.out:
        given.out.write_text(json.dumps(rows, indent=1))
    return 0 if met == len(rows) else 1


if __name__ == "__main__":
    sys.exit(main())
