"""How long may a simulation step of the twin be? One trained policy, examined with several steps.

    snakemake --cores 2 twin
    python benchmarks/twin_step.py results/twin/S06/seed-2/policy.npz [--substeps 12 6 3 2]

The control step stays as it is (24 ms as shipped) and is divided into so many simulation steps, and into those of
config/config.yaml. Prints per step: speed, ranges of motion of hip, knee and ankle, floor force, single pushes that
were stood, and the processor time of the walk as a ratio to that with the configured steps.
"""

from __future__ import annotations

import argparse
import os
import time
from pathlib import Path

for variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
    os.environ.setdefault(variable, "1")

import pandas as pd
from real2sim.configuration import read_yaml, validated
from real2sim.study.twin.evaluate import PUSH_DIRECTIONS, PUSH_PHASES, battery_of, environment, free_walk
from real2sim.study.twin.human import with_substeps
from real2sim.study.twin.policy import Policy, load_policy

ROOT = Path(__file__).parents[1]


def row(policy: Policy, twin: dict, substeps: int) -> dict[str, float]:
    """Return what the examination of a policy says with the control step divided into ``substeps``."""
    settings = twin | {"human": with_substeps(twin["human"], substeps)}
    e = twin["evaluation"]
    start = time.process_time()
    env = environment(policy, settings, nsim=e["walkers"], threads=1, seed=0)
    walk = free_walk(env, policy, seconds=e["walk_s"], settle_s=e["settle_s"])
    spent = time.process_time() - start
    crowd = environment(policy, settings, nsim=PUSH_DIRECTIONS * PUSH_PHASES, threads=1, seed=1)
    return {
        "step_ms": 1e3 * settings["human"]["timestep_s"],
        "falls": walk["falls"],
        "speed_m_per_s": walk["speed_m_per_s"],
        **{f"{name}_rom_deg": joint["rom_deg"] for name, joint in walk["joints"].items()},
        "floor_force_bw": walk["floor_force_peak_bw"]["mean_of_strides"],
        "pushes_stood": battery_of(crowd, policy, e)["survived"],
        "processor_s": spent,
    }


def main() -> None:
    """Print a row per step."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("policy", type=Path)
    parser.add_argument("--substeps", type=int, nargs="+", default=[12, 6, 3, 2])
    args = parser.parse_args()
    config = ROOT / "config" / "config.yaml"
    twin = dict(validated(read_yaml(config), "config", config)["twin"])
    own, policy = twin["human"]["substeps"], load_policy(args.policy)
    rows = {n: row(policy, twin, n) for n in sorted({own, *args.substeps}, reverse=True)}
    table = pd.DataFrame(rows.values())
    table["processor_ratio"] = table.pop("processor_s") / rows[own]["processor_s"]
    print(table.round(3).to_string(index=False))


if __name__ == "__main__":
    main()
