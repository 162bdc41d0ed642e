"""Time of a step with MuJoCo's islands and midphase, without islands, and without either; are the results equal?

python benchmarks/islands.py [--repeats 30]

A walking person on the floor, whose model is one kinematic tree: 64 people, six steps in turn with each setting.
Islands divide the constraints; the midphase searches the spheres of a foot as a tree. Prints the median of each, of
its ratio to the first, and the largest difference of a coordinate from there.
"""

from __future__ import annotations

import argparse
import copy
import os
import sys
import time
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
ROOT = Path(__file__).parents[1]
sys.path[:0] = [str(ROOT / "workflow"), str(ROOT / "benchmarks")]

import mujoco
import numpy as np
from mujoco.batch import Batch
from real2sim.configuration import read_yaml, validated
from real2sim.study.twin.env import ACTIONS, WalkEnv
from twin import BODIES, reference_of

ISLAND = int(mujoco.mjtDisableBit.mjDSBL_ISLAND)
MIDPHASE = int(mujoco.mjtDisableBit.mjDSBL_MIDPHASE)
SETTINGS = {"with both": 0, "no islands": ISLAND, "neither": ISLAND | MIDPHASE}
PEOPLE = 64


def batch_of(model: mujoco.MjModel, env: WalkEnv, without: int) -> Batch:
    """People at the start of a walk, the same with every setting."""
    own = copy.copy(model)
    own.opt.disableflags = int(own.opt.disableflags) & ~(ISLAND | MIDPHASE) | without
    batch = Batch(own, PEOPLE, 1, False)
    batch.bind("qpos")[:], batch.bind("qvel")[:] = env.batch.bind("qpos"), env.batch.bind("qvel")
    return batch


def main() -> None:
    """Print the times and the difference."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--repeats", type=int, default=30)
    args = parser.parse_args()
    config = ROOT / "config"
    study = validated(read_yaml(config / "config.yaml"), "config", config / "config.yaml")
    phantom = read_yaml(config / "phantom.yaml")
    who, twin = BODIES[1.75], study["twin"]
    reference = reference_of(who, study, phantom)
    # it gives the commands, and has taken MuJoCo's clock away
    env = WalkEnv(who, twin["human"], reference, twin["training"], nsim=PEOPLE, threads=1, seed=1)
    env.reset(np.arange(PEOPLE))
    batches = [batch_of(env.model, env, without) for without in SETTINGS.values()]
    spent = np.empty((args.repeats, len(batches)))
    for row in spent:
        command = env.command(np.zeros((PEOPLE, ACTIONS)))
        for i, batch in enumerate(batches):
            batch.bind("ctrl")[:] = command
            start = time.process_time()
            batch.step(nstep=env.substeps)
            row[i] = time.process_time() - start
        env.advance()
    per_step = 1e6 * np.median(spent, axis=0) / (PEOPLE * env.substeps)
    ratio = np.median(spent / spent[:, :1], axis=0)
    for name, batch, time_us, share in zip(SETTINGS, batches, per_step, ratio, strict=True):
        off = np.abs(batches[0].bind("qpos") - batch.bind("qpos")).max()
        print(
            f"{name:12} {time_us:6.1f} us a step, ratio {share:.3f}, differs by at most {off:g}", flush=True
        )


if __name__ == "__main__":
    main()
