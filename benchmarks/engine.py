"""How close is the search to the simulator's limit, and what does least squares save?

    python benchmarks/engine.py --results results --out engine.json

Needs a finished run (its fits are the reference). Prints and stores: steps per second inside CMA-ES against a bare
`Batch` loop on the same model; two threads against one; time per evaluation of this version; evaluations that least
squares needs to reach the best CMA-ES cost, over every trial and start.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from pathlib import Path

import numpy as np

ROOT = Path(__file__).parents[1]
sys.path.insert(0, str(ROOT / "workflow"))

from mujoco.batch import Batch
from real2sim.configuration import read_yaml, validated
from real2sim.identification import cmaes, least_squares
from real2sim.identification.fit import BATCH, restart_seed
from real2sim.identification.parameters import Bounds
from real2sim.identification.trial import TrialModel, trial_model, with_step


def load(results: Path, subject: str, trial: str, config: dict, nsim: int) -> TrialModel:
    settings = with_step(config, results / "plant" / f"{subject}.json")
    folder = results / "trials" / subject / trial
    return trial_model(
        pose=folder / "pose.parquet",
        markers=folder / "markers.parquet",
        limits=results / "limits" / f"{subject}.json",
        robot=ROOT / config["paths"]["robot"],
        settings=settings,
        nsim=nsim,
    )


def bare_rate(model: TrialModel, nsim: int, threads: int, repeats: int) -> float:
    """Steps per second of `Batch.rollout` alone: same model, same controls, nothing else."""
    replay = model.replay
    batch = Batch(replay.model, nsim, threads)
    control = np.ascontiguousarray(np.broadcast_to(replay._control[0], (nsim, *replay._control[0].shape)))
    record = {"sensordata": np.empty((nsim, replay.nstep, replay.model.nsensordata))}
    best = 0.0
    for _ in range(repeats):
        batch.reset()
        start = time.perf_counter()
        batch.rollout(replay.nstep, control, record=("sensordata",), out=record)
        best = max(best, nsim * replay.nstep / (time.perf_counter() - start))
    return best


def search_rate(model: TrialModel, bounds: Bounds, ident: dict, evaluations: int, seed: int) -> float:
    """Steps per second of a whole CMA-ES run: sampling, replay, cost and update."""
    start = time.perf_counter()
    result = cmaes.search(
        lambda p: model.cost(model.replay.run(p)).total,
        bounds,
        population=ident["population"],
        sigma0=ident["sigma0"],
        evaluations=evaluations,
        tolfun=0.0,
        diagonal_iterations=ident["diagonal_iterations"],
        seed=seed,
    )
    return result.evaluations * model.replay.nstep / (time.perf_counter() - start)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--results", type=Path, default=Path("results"))
    parser.add_argument("--out", type=Path)
    parser.add_argument("--starts", type=int, default=5)
    options = parser.parse_args()
    source = ROOT / "config" / "config.yaml"
    config = validated(read_yaml(source), "config", source)
    ident = config["identification"]
    bounds = Bounds.from_config(ident["bounds"])
    fits = [json.loads(p.read_text()) for p in sorted((options.results / "fits").rglob("*.json"))]
    trials = sorted({(fit["subject"], fit["trial"]) for fit in fits})
    report: dict = {}

    subject, trial = trials[0]
    model = load(options.results, subject, trial, config, ident["population"])
    # an import and a warm-up cost nothing per evaluation
    search_rate(model, bounds, ident, 22, 1)
    pairs = []
    for seed in range(5):
        # compared within seconds of each other: the machine is shared
        bare = bare_rate(model, ident["population"], 1, 3)
        pairs.append((bare, search_rate(model, bounds, ident, 110, seed)))
    report["search_over_bare"] = float(np.median([inside / bare for bare, inside in pairs]))
    report["bare_steps_per_s"] = max(bare for bare, _ in pairs)
    print(f"bare Batch loop      {report['bare_steps_per_s'] / 1e3:.0f} k steps/s on one thread")
    print(
        f"inside CMA-ES        {report['search_over_bare']:.3f} of it (median of 5; generations of a real search)"
    )
    one, two = (max(bare_rate(model, 22, threads, 5) for _ in range(3)) for threads in (1, 2))
    report["two_threads_over_one"] = two / one
    print(f"two threads          {two / one / 2:.3f} of twice one thread (Batch of 22)")
    report["evaluation_s"] = model.replay.nstep / report["bare_steps_per_s"]
    print(
        f"one evaluation       {report['evaluation_s'] * 1e3:.1f} ms for {model.trial.time_s[-1]:.0f} s of trial"
    )

    rows = []
    for subject, trial in trials:
        model = load(options.results, subject, trial, config, BATCH)
        own = [fit for fit in fits if (fit["subject"], fit["trial"]) == (subject, trial)]
        reference = min(fit["cost"]["J"] for fit in own)
        for start in range(1, options.starts + 1):
            result = least_squares.search(
                lambda p, m=model: m.cost.residuals(m.replay.run(p)),
                bounds,
                batch=BATCH,
                seed=restart_seed(ident["seed"], subject, trial, start),
                **ident["least_squares"],
            )
            budget = float(np.median([fit["evaluations"] for fit in own]))
            rows.append(
                {
                    "subject": subject,
                    "trial": trial,
                    "start": start,
                    "J_over_cma": result.cost / reference - 1,
                    "evaluations": result.evaluations,
                    "fewer": budget / result.evaluations,
                }
            )
    hits = [row["J_over_cma"] <= 1e-3 and row["fewer"] >= 5 for row in rows]
    report["least_squares"] = {"starts": len(rows), "within_0.1_percent_at_a_fifth": sum(hits), "rows": rows}
    print(
        f"least squares        {sum(hits)} of {len(rows)} starts within 0.1 % of the best CMA-ES cost with >= 5 times"
        f" fewer evaluations (median {np.median([row['evaluations'] for row in rows]):.0f}, worst excess"
        f" {max(row['J_over_cma'] for row in rows):+.2%})"
    )
    if options.out:
        options.out.write_text(json.dumps(report, indent=1) + "\n")


if __name__ == "__main__":
    main()
