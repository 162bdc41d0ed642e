"""Diagnose a thigh cuff on a hip-knee orthosis, with slack of 4 mm along the thigh.

python examples/cuff.py [--effect EFFECT | --effect none] [--duration SECONDS] [--out FOLDER]
"""

import argparse
from pathlib import Path

import real2sim as r2s
from real2sim.system.description import shipped
from real2sim.verification.systems import cuff

parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
parser.add_argument("--effect", choices=[*cuff.EFFECTS, "none"], default="slack")
parser.add_argument("--duration", type=float, default=12.0, help="of a recording [s]")
parser.add_argument("--out", type=Path, default=Path("results/examples/cuff"))


def main(arguments: list[str] | None = None) -> r2s.Diagnosis:
    """Simulate three recordings, diagnose them, and write diagnosis.json, traces.png and model.xml."""
    options = parser.parse_args(arguments)
    effect = None if options.effect == "none" else options.effect
    size = cuff.EFFECTS[effect].typical if effect else 0.0
    folder = cuff.simulate(effect, size, 1, options.out, axis="tz", duration_s=options.duration)
    system = r2s.System.from_yaml(shipped("cuff") / "system.yaml")
    quiet, train, held_out = (
        r2s.Recording.read(system, folder / f"{trial}.parquet") for trial in ("quiet", "train", "held_out")
    )
    answer = r2s.diagnose(system, train=train, held_out=held_out, quiet=quiet)
    print(answer.verdict, f"{answer.probabilities[answer.verdict]:.3f}", answer.table().to_string(), sep="\n")
    answer.save(options.out / "diagnosis.json")
    answer.plot(options.out / "traces.png")
    answer.export_model(options.out / "model.xml")
    return answer


if __name__ == "__main__":
    main()
