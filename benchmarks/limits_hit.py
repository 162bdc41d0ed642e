"""How long does a step take, and how exact is a replay whose motion lies on joint limits?

    python benchmarks/limits_hit.py --trial results/trials/S01/dynamic_1

Prints the processor time of a step of the plant without limits and of the replay with limits out of reach. Then the
error of the markers against a step of 0.25 ms, for limits far inside the motion. Another version is measured with its
own code: `git worktree add`.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

ROOT = Path(__file__).parents[1]
sys.path.insert(0, str(ROOT / "workflow"))

from real2sim.artefacts import write_json
from real2sim.configuration import read_yaml, validated
from real2sim.inference.parameters import Bounds
from real2sim.recording.trial import TrialModel, trial_model
from real2sim.study.step_study import parameter_draws
from real2sim.system.replay import Replay

# Limits of slides [m] and hinges [rad]: out of reach, and far inside the motion
FAR, INSIDE = (1.0, 3.0), ((0.02, 0.1), (0.04, 0.2))
STEPS_S, FINE_S = (0.01, 0.005, 0.0025), 0.00025
DRAWS, ROUNDS = 8, 5


def replayed(trial: Path, settings: dict[str, Any], limit: tuple[float, float], step_s: float) -> TrialModel:
    """Return the trial with symmetric limits, replayed in steps of ``step_s``."""
    reach = [limit[0]] * 3 + [limit[1]] * 3
    with tempfile.TemporaryDirectory() as folder:
        limits = Path(folder) / "limits.json"
        write_json(limits, {"q_min": [-x for x in reach], "q_max": reach})
        return trial_model(
            pose=trial / "pose.parquet",
            markers=trial / "markers.parquet",
            limits=limits,
            robot=ROOT / "resources/robot/drba.xml",
            settings=settings | {"plant": settings["plant"] | {"timestep_s": step_s}},
            nsim=DRAWS,
        )


def microseconds(replay: Replay, parameters: np.ndarray) -> float:
    """Return the processor time of one step, the least of some rounds."""
    least = np.inf
    for _ in range(ROUNDS):
        begun = time.process_time()
        replay.run(parameters)
        least = min(least, time.process_time() - begun)
    return float(least / len(parameters) / replay.nstep * 1e6)


def without_limits(replay: Replay) -> Replay:
    """Return the replay with its limits taken away, as of a person without sweeps."""
    model = replay.model
    model.jnt_limited[:] = False
    if hasattr(replay, "_may_be_constrained") and not replay._may_be_constrained():
        model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONSTRAINT)
    replay._make_batch(1)
    return replay


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--trial", type=Path, required=True, help="folder of canonical tables")
    trial: Path = parser.parse_args().trial
    config = ROOT / "config/config.yaml"
    settings = validated(read_yaml(config), "config", config)
    bounds = Bounds.from_config(settings["identification"]["bounds"])
    parameters = parameter_draws(ROOT / "resources/published/table1_priors.csv", bounds, DRAWS, 1)
    replay = replayed(trial, settings, FAR, STEPS_S[0]).replay
    print(f"limits out of reach: {microseconds(replay, parameters):.2f} us a step")
    print(f"no limits: {microseconds(without_limits(replay), parameters):.2f} us a step")
    for limit in INSIDE:
        paths = {h: replayed(trial, settings, limit, h).replay.run(parameters) for h in (FINE_S, *STEPS_S)}
        for h in STEPS_S:
            apart = np.sum((paths[h] - paths[FINE_S]) ** 2, axis=-1)
            error = 1e3 * np.sqrt(apart.mean(axis=(1, 2)))
            where = f"limits {limit[0]} m, {limit[1]} rad, step {1e3 * h:g} ms"
            print(f"{where}: markers off by {np.median(error):.3f} mm RMS, at most {error.max():.3f}")


if __name__ == "__main__":
    main()
