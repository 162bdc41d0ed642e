"""How exact and how fast is the plant? Marker paths against the phantom's own physics, per time step.

    python benchmarks/plant.py --subject S01 --out plant.json

Same parameters, no noise, no effects. The noise floor of J is that of white marker noise (0.5 mm) after the 12 Hz
low-pass of the pipeline.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

ROOT = Path(__file__).parents[1]
sys.path.insert(0, str(ROOT / "workflow"))

from real2sim.configuration import validated
from real2sim.inference.cost import CostScales, TrialCost
from real2sim.inference.parameters import as_vector
from real2sim.signals import lowpass
from real2sim.system.plant import RestPose
from real2sim.system.replay import Replay, replay_check
from real2sim.verification.cohort.plan import read_settings
from real2sim.verification.cohort.write import simulate_subject
from real2sim.verification.phantom.exports import Trial
from real2sim.verification.phantom.person import Person

NOISE_M = 0.0005
SIMULATIONS = 11


def measured(trial: Trial, person: Person, config: dict[str, Any]) -> Iterator[dict[str, Any]]:
    """Yield error and speed of the plant's replay of a trial, per time step."""
    truth = trial.truth
    marked = np.stack([truth.left, truth.right], axis=1)
    cost = TrialCost(marked, 100, CostScales(0.041, 0.080))
    noise = NOISE_M * np.random.default_rng(1).standard_normal(marked.shape)
    smooth = lowpass(noise.reshape(len(noise), -1), 100, 12, 4).reshape(noise.shape)
    floor = float(cost((marked + smooth)[None]).total[0])
    for step in (0.001, 0.0025, 0.005, 0.01):
        replay = Replay(
            robot=ROOT / config["paths"]["robot"],
            robot_settings=config["robot"],
            plant_settings=config["plant"] | {"timestep_s": step},
            time_s=truth.time_s - truth.time_s[0],
            pelvis_rotation=truth.pelvis_rotation,
            pelvis_position=truth.pelvis_position,
            start_rotation=truth.interface_rotation[0],
            start_position=truth.interface_position[0],
            rest=RestPose(person.rest_rotation, person.rest_position),
            limits=None,
            nsim=SIMULATIONS,
        )
        start = time.perf_counter()
        paths, pelvis = replay.run_with_pelvis(np.tile(as_vector(person.parameters), (SIMULATIONS, 1)))
        elapsed = time.perf_counter() - start
        yield {
            "subject": person.name,
            "trial": trial.name,
            "timestep_s": step,
            "marker_rms_m": float(np.sqrt(np.mean(np.sum((paths[0] - marked) ** 2, axis=-1)))),
            "J": float(cost(paths).total[0]),
            "J_floor": floor,
            "replay": replay_check(replay, pelvis[0]),
            "evaluation_s": elapsed / SIMULATIONS,
            "steps_per_s": SIMULATIONS * replay.nstep / elapsed,
        }


def line(row: dict[str, Any]) -> str:
    """Return a row for the screen."""
    check = row["replay"]
    return (
        f"{row['trial']}  h {row['timestep_s'] * 1e3:4.1f} ms  markers {row['marker_rms_m'] * 1e3:.4f} mm RMS"
        f"  J {row['J']:.1e} = {100 * row['J'] / row['J_floor']:.4f} % of floor {row['J_floor']:.3f}"
        f"  replay {check['rms_m'] * 1e3:.4f} mm RMS, {check['max_m'] * 1e3:.4f} max,"
        f" {check['lag_s'] * 1e3:+.5f} ms  {row['evaluation_s'] * 1e3:.1f} ms/evaluation"
        f"  {row['steps_per_s'] / 1e3:.0f} k steps/s"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--subject", default="S01")
    parser.add_argument("--phantom-step", type=float, default=0.00025)
    parser.add_argument("--out", type=Path)
    options = parser.parse_args()
    config = validated({}, "config", Path("defaults"))
    phantom = read_settings(ROOT / "config" / "phantom.yaml")
    phantom["effects"]["enabled"] = phantom["measurement"]["enabled"] = False
    phantom["simulation"]["step_s"] = options.phantom_step
    phantom["trials"] |= {"walk_normal_trials": 1, "walk_robot_trials": 1}
    robot = ROOT / config["paths"]["robot"]
    done = simulate_subject(phantom, config["robot"], robot, options.subject)
    person, trials = done.person, done.trials
    rows = []
    for trial in trials:
        if trial.kind == "dynamic":
            for row in measured(trial, person, config):
                rows.append(row)
                print(line(row))
    if options.out:
        options.out.write_text(json.dumps(rows, indent=1) + "\n")


if __name__ == "__main__":
    main()
