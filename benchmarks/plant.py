"""How exact and how fast is the plant? Marker paths against the phantom's own physics, per time step.

    python benchmarks/plant.py --subject S01 --out plant.json

Same parameters, no noise, no effects. The noise floor of J is that of white marker noise (0.5 mm) after the 12 Hz
low-pass of the pipeline.
"""

from __future__ import annotations

import argparse
import copy
import json
import sys
import time
from pathlib import Path

import numpy as np

ROOT = Path(__file__).parents[1]
sys.path.insert(0, str(ROOT / "workflow"))

from real2sim.configuration import read_yaml, validated
from real2sim.inference.cost import CostScales, TrialCost
from real2sim.inference.parameters import as_vector
from real2sim.signals import lowpass
from real2sim.system.plant import RestPose
from real2sim.system.replay import Replay, replay_check
from real2sim.verification.phantom.cohort import simulate_subject

NOISE_M = 0.0005


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--subject", default="S01")
    parser.add_argument("--phantom-step", type=float, default=0.00025)
    parser.add_argument("--out", type=Path)
    options = parser.parse_args()
    config = validated({}, "config", Path("defaults"))
    source = ROOT / "config" / "phantom.yaml"
    phantom = copy.deepcopy(validated(read_yaml(source), "phantom", source))
    phantom["effects"]["enabled"] = phantom["measurement"]["enabled"] = False
    phantom["simulation"]["step_s"] = options.phantom_step
    phantom["trials"] |= {"walk_normal_trials": 1, "walk_robot_trials": 1}
    robot = ROOT / config["paths"]["robot"]
    person, trials, _, _ = simulate_subject(phantom, config["robot"], robot, options.subject)
    rows = []
    for trial in trials:
        if not trial.name.startswith("dynamic"):
            continue
        truth = trial.truth
        measured = np.stack([truth.left, truth.right], axis=1)
        scales = CostScales(0.041, 0.080)
        cost = TrialCost(measured, 100, scales)
        noise = NOISE_M * np.random.default_rng(1).standard_normal(measured.shape)
        smooth = lowpass(noise.reshape(len(noise), -1), 100, 12, 4).reshape(noise.shape)
        floor = float(cost((measured + smooth)[None]).total[0])
        for step in (0.001, 0.0025, 0.005, 0.01):
            replay = Replay(
                robot=robot,
                robot_settings=config["robot"],
                plant_settings=config["plant"] | {"timestep_s": step},
                time_s=truth.time_s - truth.time_s[0],
                pelvis_rotation=truth.pelvis_rotation,
                pelvis_position=truth.pelvis_position,
                start_rotation=truth.interface_rotation[0],
                start_position=truth.interface_position[0],
                rest=RestPose(person.rest_rotation, person.rest_position),
                limits=None,
                nsim=11,
            )
            parameters = np.tile(as_vector(person.parameters), (11, 1))
            start = time.perf_counter()
            paths, pelvis = replay.run_with_pelvis(parameters)
            elapsed = time.perf_counter() - start
            error = paths[0] - measured
            check = replay_check(replay, pelvis[0])
            rows.append(
                {
                    "subject": options.subject,
                    "trial": trial.name,
                    "timestep_s": step,
                    "marker_rms_m": float(np.sqrt(np.mean(np.sum(error**2, axis=-1)))),
                    "J": float(cost(paths).total[0]),
                    "J_floor": floor,
                    "replay": check,
                    "evaluation_s": elapsed / 11,
                    "steps_per_s": 11 * replay.nstep / elapsed,
                }
            )
            row = rows[-1]
            print(
                f"{trial.name}  h {step * 1e3:4.1f} ms  markers {row['marker_rms_m'] * 1e3:.4f} mm RMS"
                f"  J {row['J']:.1e} = {100 * row['J'] / floor:.4f} % of floor {floor:.3f}"
                f"  replay {check['rms_m'] * 1e3:.4f} mm RMS, {check['max_m'] * 1e3:.4f} max,"
                f" {check['lag_s'] * 1e3:+.5f} ms  {row['evaluation_s'] * 1e3:.1f} ms/evaluation"
                f"  {row['steps_per_s'] / 1e3:.0f} k steps/s"
            )
    if options.out:
        options.out.write_text(json.dumps(rows, indent=1) + "\n")


if __name__ == "__main__":
    main()
