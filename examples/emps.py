"""Diagnose the positioning system EMPS: simulated with dry friction, or from the published measurement.

python examples/emps.py [--measured DATA_EMPS.mat] [--duration SECONDS] [--out FOLDER]
"""

import argparse
from pathlib import Path

import pandas as pd
import real2sim as r2s
from real2sim.system.description import shipped
from real2sim.verification.systems import emps_data, one_axis

parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
parser.add_argument("--measured", type=Path, help="DATA_EMPS.mat of nonlinearbenchmark.org")
parser.add_argument("--duration", type=float, default=6.0, help="of a recording [s]")
parser.add_argument("--out", type=Path, default=Path("results/examples/emps"))


def main(arguments: list[str] | None = None) -> r2s.Diagnosis:
    """Diagnose two recordings and write diagnosis.json, traces.png and model.xml."""
    options = parser.parse_args(arguments)
    options.out.mkdir(parents=True, exist_ok=True)
    # a published record begins in motion: driven by its force, errors of the start would add up
    name = "by_path.yaml" if options.measured else "system.yaml"
    system = r2s.System.from_yaml(shipped("emps") / name)
    if options.measured:  # the first seconds are fitted, the next ones predicted
        table, quiet = pd.DataFrame(emps_data.read_emps(options.measured)), None
        n = round(options.duration * one_axis.EMPS_RATE_HZ)
        parts = {f"part_{i}": table[i * n : (i + 1) * n].reset_index(drop=True) for i in (0, 1)}
        train, held_out = (r2s.Recording.from_table(system, part, name) for name, part in parts.items())
    else:
        folder = one_axis.simulate_emps("coulomb", 20.4, 1, options.out, options.duration)
        trials = ("quiet", "train", "held_out")
        quiet, train, held_out = (r2s.Recording.read(system, folder / f"{t}.parquet") for t in trials)
    answer = r2s.diagnose(system, train=train, held_out=held_out, quiet=quiet)
    print(answer.verdict, f"{answer.probabilities[answer.verdict]:.3f}", answer.table().to_string(), sep="\n")
    answer.save(options.out / "diagnosis.json")
    answer.plot(options.out / "traces.png")
    answer.export_model(options.out / "model.xml")
    return answer


if __name__ == "__main__":
    main()
