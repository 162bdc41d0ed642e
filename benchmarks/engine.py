"""How close is the engine to the simulator's limit, and how does it compare?

    python benchmarks/engine.py --results results --out engine.json
    python benchmarks/engine.py --results results --parts search threads

Needs a finished run: its tables, and for the last part its fits. The parts:

search         steps per second inside CMA-ES against a bare `Batch` loop on the same model
threads        two threads against one; only right on an idle machine, which is looked at and said
profiler       steps without the clock that MuJoCo's bindings install, against steps with it
welded         cost of a trial at the accuracy bar against the first version, a loop closed by a weld (welded.py)
sysid          `mujoco.sysid` on the same trial, model and residual, in an environment made for it
least_squares  evaluations to the best cost of CMA-ES, over every trial and start

Each prints a line and its bar; all go to one JSON.
"""

from __future__ import annotations

import argparse
import json
import os
import pickle
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

# two threads of BLAS beside another process cost a hundred times what they save
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import mujoco
import numpy as np

ROOT = Path(__file__).parents[1]
sys.path.insert(0, str(ROOT / "workflow"))

from mujoco.batch import Batch
from real2sim.artefacts import write_json
from real2sim.configuration import read_yaml, validated
from real2sim.inference import cmaes, least_squares
from real2sim.inference.parameters import Bounds
from real2sim.recording.trial import TrialModel, trial_model, with_step
from real2sim.study.fit import BATCH, restart_seed
from real2sim.study.step_study import parameter_draws
from real2sim.system.plant import load_robot
from welded import WeldedReplay

# Two processes of other people's on two cores leave nothing to measure
BUSY_LOAD = 0.3


@dataclass
class Study:
    """A finished run: its folder, its configuration and what it identified."""

    results: Path
    config: dict

    @property
    def bounds(self) -> Bounds:
        """Search bounds."""
        return Bounds.from_config(self.config["identification"]["bounds"])

    @property
    def robot(self) -> Path:
        """MJCF of the robot twin."""
        return ROOT / self.config["paths"]["robot"]

    def trials(self) -> list[tuple[str, str]]:
        """(person, dynamic trial) of all people with a step study."""
        return [
            (plan.stem, folder.name)
            for plan in sorted((self.results / "plant").glob("*.json"))
            for folder in sorted((self.results / "trials" / plan.stem).glob("dynamic_*"))
        ]

    def load(self, subject: str, trial: str, nsim: int, step_s: float | None = None) -> TrialModel:
        """A trial bound to its plant, at the study's time step or another one."""
        settings = with_step(self.config, self.results / "plant" / f"{subject}.json")
        if step_s is not None:
            settings = settings | {"plant": settings["plant"] | {"timestep_s": step_s}}
        folder = self.results / "trials" / subject / trial
        return trial_model(
            pose=folder / "pose.parquet",
            markers=folder / "markers.parquet",
            limits=self.results / "limits" / f"{subject}.json",
            robot=self.robot,
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
    """Steps per second of all restarts of a CMA-ES run in one batch: sampling, replay, cost and update."""
    start = time.perf_counter()
    results = cmaes.search(
        model.costs,
        bounds,
        population=ident["population"],
        sigma0=ident["sigma0"],
        evaluations=evaluations,
        tolfun=0.0,
        diagonal_iterations=ident["diagonal_iterations"],
        seeds=[seed + 1000 * i for i in range(ident["restarts"])],
    )
    return sum(result.evaluations for result in results) * model.replay.nstep / (time.perf_counter() - start)


def load_now() -> float:
    """Processes that ran in the last seconds, without this one, by /proc/loadavg's running count."""
    samples = []
    for _ in range(10):
        samples.append(int(Path("/proc/loadavg").read_text().split()[3].split("/")[0]) - 1)
        time.sleep(0.2)
    return float(np.mean(samples))


def search(study: Study) -> dict:
    """Steps per second inside CMA-ES over those of the bare loop."""
    ident = study.config["identification"]
    nsim = ident["population"] * ident["restarts"]
    model = study.load(*study.trials()[0], nsim)
    # an import and a warm-up cost nothing per evaluation
    search_rate(model, study.bounds, ident, 22, 1)
    pairs = []
    for seed in range(5):
        # compared within seconds of each other: the machine may be shared
        bare = bare_rate(model, nsim, 1, 3)
        pairs.append((bare, search_rate(model, study.bounds, ident, 110, seed)))
    ratio = float(np.median([inside / bare for bare, inside in pairs]))
    rate = max(bare for bare, _ in pairs)
    evaluation = model.replay.nstep / rate
    print(f"bare Batch loop      {rate / 1e3:.0f} k steps/s on one thread")
    print(f"one evaluation       {evaluation * 1e3:.1f} ms for {model.trial.time_s[-1]:.0f} s of trial")
    print(f"inside CMA-ES        {ratio:.3f} of the bare loop (median of 5; bar 0.90)")
    return {"ratio": ratio, "bare_steps_per_s": rate, "evaluation_s": evaluation, "passes": ratio >= 0.90}


def threads(study: Study) -> dict:
    """Two threads over twice one, in turns."""
    model = study.load(*study.trials()[0], 22)
    others, average = load_now(), os.getloadavg()
    pairs = [(bare_rate(model, 22, 1, 2), bare_rate(model, 22, 2, 2)) for _ in range(7)]
    scaling = float(np.median([two / one / 2 for one, two in pairs]))
    best = max(two for _, two in pairs) / max(one for one, _ in pairs) / 2
    busy = others > BUSY_LOAD
    print(
        f"two threads          {scaling:.3f} of twice one (median of 7 pairs; best over best {best:.3f}; bar 0.95)"
    )
    said = "the machine was BUSY: this is no measurement" if busy else "the machine was idle"
    print(f"                     {said}: {others:.1f} other running processes, load {average[0]:.2f}")
    return {
        "scaling": scaling,
        "best_over_best": best,
        "other_processes": others,
        "load_average": list(average),
        "busy": busy,
        "passes": None if busy else scaling >= 0.95,
    }


def profiler(study: Study) -> dict:
    """Time of a step without MuJoCo's profiler over that with it, in turns, of the plant and of the robot alone."""
    plant = study.load(*study.trials()[0], 16)
    robot = load_robot(study.robot).compile()
    alone = Batch(robot, 16, 1)
    rates: dict[str, Callable[[], float]] = {
        "plant": lambda: bare_rate(plant, 16, 1, 1),
        "robot": lambda: 1 / timed(lambda _: alone.rollout(2000), np.empty(16), 1),
    }
    out = {}
    for name, rate in rates.items():
        pairs = []
        for _ in range(7):
            mujoco.set_mjcb_time(None)  # the bindings' own clock
            with_clock = rate()
            mujoco.mj_resetCallbacks()
            pairs.append(with_clock / rate())
        out[name] = float(np.median(pairs))
        print(f"profiler off, {name:6s} {out[name]:.2f} of the time of a step (median of 7 pairs)")
    return out


def timed(run: Callable[[np.ndarray], np.ndarray], parameters: np.ndarray, repeats: int) -> float:
    """Seconds per replay, the best of some repeats."""
    best = np.inf
    for _ in range(repeats):
        start = time.perf_counter()
        run(parameters)
        best = min(best, (time.perf_counter() - start) / len(parameters))
    return best


def welded(study: Study) -> dict:
    """Errors and cost of a trial by both plants, and the ratio of cost where each meets the accuracy bar."""
    options = study.config["plant"]["study"]
    subject, trial = study.trials()[0]
    published = ROOT / study.config["paths"]["published"] / "table1_priors.csv"
    parameters = parameter_draws(published, study.bounds, options["draws"], options["seed"])
    n = len(parameters)
    fine = study.load(subject, trial, n, options["reference_s"])
    reference = fine.replay.run(parameters)
    reference_cost = fine.cost(reference).total
    del fine
    rows = []

    def add(plant: str, step: float, model: TrialModel, run, repeats: int) -> None:
        paths = run(parameters)
        error = np.sqrt(np.mean(np.sum((paths - reference) ** 2, axis=-1), axis=(1, 2)))
        relative = np.abs(model.cost(paths).total / reference_cost - 1)
        row = {
            "plant": plant,
            "timestep_s": step,
            "marker_rms_m": float(error.max()),
            "J_relative": float(relative.max()),
            "evaluation_s": timed(run, parameters, repeats),
        }
        row["at_bar"] = (
            row["marker_rms_m"] < options["marker_rms_m"] and row["J_relative"] < options["J_relative"]
        )
        rows.append(row)
        print(
            f"{plant:20s} {step * 1e3:5.2f} ms  markers {row['marker_rms_m'] * 1e3:.4f} mm RMS"
            f"  J {row['J_relative']:.3%}  {row['evaluation_s'] * 1e3:6.1f} ms/trial"
            + ("  at the bar" if row["at_bar"] else "")
        )

    for step in (0.01, 0.005, 0.002):
        own = study.load(subject, trial, n, step)
        add("loop-free", step, own, own.replay.run, 3)
    for step in (0.002, 0.001, 0.0005, 0.00025):
        own = study.load(subject, trial, n, step)
        for solref in (2 * step, 0.02):
            # the stiffest weld that a step allows, and MuJoCo's default time constant
            weld = WeldedReplay(own, own.replay, study.robot, study.config, nsim=n, solref_s=solref)
            add(f"weld, solref {solref * 1e3:g} ms", step, own, weld.run, 3 if step == 0.002 else 1)
    print(f"(worst of {n} draws from the published intervals, against {options['reference_s'] * 1e3} ms)")

    def cheapest(name: str) -> float | None:
        costs = [r["evaluation_s"] for r in rows if r["plant"].startswith(name) and r["at_bar"]]
        return min(costs) if costs else None

    own_cost, weld_cost = cheapest("loop-free"), cheapest("weld")
    first = min(r["evaluation_s"] for r in rows if r["plant"].startswith("weld") and r["timestep_s"] == 0.002)
    report: dict = {"rows": rows, "at_2_ms": first / own_cost if own_cost else None}
    report["at_the_bar"] = weld_cost / own_cost if own_cost and weld_cost else None
    at_bar = (
        f"{report['at_the_bar']:.1f} times" if report["at_the_bar"] else "no step of the weld meets the bar"
    )
    print(
        f"cost at the bar      {at_bar}; its 2 ms, bar or not, {report['at_2_ms'] or np.nan:.1f} times (bar 2)"
    )
    report["passes"] = bool(own_cost and first / own_cost >= 2)
    return report


def weld_step(report: dict) -> float:
    """Largest step of the welded plant at the accuracy bar, by an earlier part of the report; 2 ms without one."""
    rows = report.get("welded", {}).get("rows", [])
    return max(
        (r["timestep_s"] for r in rows if r["plant"].startswith("weld") and r["at_bar"]), default=0.002
    )


def sysid_environment(folder: Path) -> Path | str:
    """Interpreter of an environment with mujoco[sysid], or why there is none."""
    import mujoco

    python = folder / "bin" / "python"
    if not python.exists():
        steps = (
            [sys.executable, "-m", "venv", str(folder)],
            [str(python), "-m", "pip", "install", "--quiet", f"mujoco[sysid]=={mujoco.__version__}"],
        )
        for step in steps:
            done = subprocess.run(step, capture_output=True, text=True, check=False)
            if done.returncode:
                return f"`{' '.join(step[1:])}` ended with {done.returncode}: {done.stderr.strip()[-300:]}"
    return python


def sysid(study: Study, environment: Path | None, weld_step_s: float) -> dict:
    """Evaluations per second and optimum of `mujoco.sysid` and of this project; ``weld_step_s`` of the welded plant."""
    subject, trial = study.trials()[0]
    model = study.load(subject, trial, BATCH)
    ident, own = study.config["identification"], model.trial
    content = {
        "replay": {
            "robot": str(study.robot),
            "robot_settings": study.config["robot"],
            "plant_settings": study.config["plant"] | {"timestep_s": model.replay.model.opt.timestep},
            "time_s": own.time_s,
            "pelvis_rotation": own.pelvis_rotation,
            "pelvis_position": own.pelvis_position,
            "start_rotation": own.start_rotation,
            "start_position": own.start_position,
            "rest": (own.rest.rotation, own.rest.position),
            "limits": (model.limits.lower, model.limits.upper) if model.limits else None,
        },
        "measured": own.interface,
        "usable": own.usable,
        "rate_hz": 1 / float(own.time_s[1] - own.time_s[0]),
        "scales": (ident["scales"]["position_m"], ident["scales"]["velocity_m_per_s"]),
        "bounds": (study.bounds.lower, study.bounds.upper),
        "least_squares": ident["least_squares"],
        "welded_step_s": weld_step_s,
    }
    with tempfile.TemporaryDirectory() as folder:
        python = sysid_environment(environment or Path(folder) / "environment")
        if isinstance(python, str):
            print(f"mujoco.sysid         not measured: {python}")
            return {"error": python, "passes": None}
        source, out = Path(folder) / "trial.pickle", Path(folder) / "report.json"
        source.write_bytes(pickle.dumps(content))
        paths = os.environ | {
            "PYTHONPATH": str(ROOT / "workflow"),
            "OMP_NUM_THREADS": "1",
            "OPENBLAS_NUM_THREADS": "1",
        }
        script = Path(__file__).with_name("sysid_search.py")
        done = subprocess.run(
            [str(python), str(script), str(source), str(out)],
            env=paths,
            capture_output=True,
            text=True,
            check=False,
        )
        if done.returncode:
            print(f"mujoco.sysid         not measured: {done.stderr.strip()[-600:]}")
            return {"error": done.stderr[-2000:], "passes": None}
        report = json.loads(out.read_text())
    rates, found = report["evaluations_per_s"], report["search"]
    apart = report["differences_of_residuals"]
    print(
        f"mujoco.sysid         residuals differ by {np.median(apart):.0e}"
        f" (worst of {len(apart)} points {apart[-1]:.0e}: a recompiled plant has softer or harder joint limits)"
    )
    print(
        f"                     {rates['own']:.1f} evaluations/s here, {rates['sysid']:.1f} there:"
        f" {report['ratio']:.2f} times (bar 5)"
    )
    weld = report["welded"]
    print(
        f"                     {weld['evaluations_per_s']:.2f} there in the welded plant at"
        f" {weld['timestep_s'] * 1e3:g} ms, without this project's plant: {weld['ratio']:.1f} times"
    )
    for name, row in found.items():
        per_s = row["evaluations"] / row["seconds"]
        print(
            f"                     search, {name:5s}  J {row['J']:.6g}  {row['evaluations']} evaluations"
            f"  {row['seconds']:.1f} s  {per_s:.1f} evaluations/s"
        )
    report["passes"] = report["ratio"] >= 5 and found["own"]["J"] <= found["sysid"]["J"] * 1.001
    return report


def least_squares_starts(study: Study, starts: int) -> dict:
    """Least squares from many starts against the best restart of CMA-ES."""
    ident = study.config["identification"]
    fits = [json.loads(p.read_text()) for p in sorted((study.results / "fits").rglob("*.json"))]
    rows = []
    for subject, trial in study.trials():
        own = [f for f in fits if (f["subject"], f["trial"], f["method"]) == (subject, trial, "cma")]
        if not own:
            continue
        model = study.load(subject, trial, BATCH)
        reference = min(fit["cost"]["J"] for fit in own)
        budget = float(np.median([fit["evaluations"] for fit in own]))
        for start in range(1, starts + 1):
            result = least_squares.search(
                lambda p, m=model: m.cost.residuals(m.replay.run(p)),
                study.bounds,
                batch=BATCH,
                seed=restart_seed(ident["seed"], subject, trial, start),
                **ident["least_squares"],
            )
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
    if not rows:
        print("least squares        not measured: the run has no fit by CMA-ES")
        return {"passes": None}
    hits = [row["J_over_cma"] <= 1e-3 and row["fewer"] >= 5 for row in rows]
    near = sum(row["J_over_cma"] <= 1e-3 for row in rows)
    print(
        f"least squares        {sum(hits)} of {len(rows)} starts within 0.1 % of the best CMA-ES cost with >= 5 times"
        f" fewer evaluations (bar 95 %; {near} within 0.1 %, median {np.median([r['evaluations'] for r in rows]):.0f}"
        f" evaluations, worst excess {max(r['J_over_cma'] for r in rows):+.2%})"
    )
    return {"starts": len(rows), "hits": sum(hits), "rows": rows, "passes": sum(hits) >= 0.95 * len(rows)}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--results", type=Path, default=Path("results"))
    parser.add_argument(
        "--out", type=Path, help="report as JSON; parts that it has and are not run again stay"
    )
    parser.add_argument("--starts", type=int, default=5, help="of least squares per trial")
    parser.add_argument("--environment", type=Path, help="keep the environment of mujoco.sysid here")
    parts = ("search", "threads", "profiler", "welded", "sysid", "least_squares")
    parser.add_argument("--parts", nargs="+", choices=parts, default=parts)
    options = parser.parse_args()
    source = ROOT / "config" / "config.yaml"
    study = Study(options.results, validated(read_yaml(source), "config", source))
    if not study.trials():
        sys.exit(f"{options.results}: no plant/*.json with dynamic trials; run the workflow first")
    report = json.loads(options.out.read_text()) if options.out and options.out.exists() else {}
    run: dict[str, Callable[[], dict]] = {
        "search": lambda: search(study),
        "threads": lambda: threads(study),
        "profiler": lambda: profiler(study),
        "welded": lambda: welded(study),
        "sysid": lambda: sysid(study, options.environment, weld_step(report)),
        "least_squares": lambda: least_squares_starts(study, options.starts),
    }
    for part in options.parts:
        report[part] = run[part]()
        if options.out:
            write_json(options.out, report)


if __name__ == "__main__":
    main()
