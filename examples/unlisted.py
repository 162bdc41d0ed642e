"""Measure a law whose name is not in the catalogue: a spring that stiffens, without any elastic law to name it by.

python examples/unlisted.py [--duration SECONDS] [--out FOLDER]
"""

import argparse
from pathlib import Path

import real2sim as r2s
from real2sim.pages.law import law_sentence
from real2sim.system.description import shipped_system
from real2sim.verification.systems import one_axis

ELASTIC = ["slack", "one_sided", "stiffening", "asymmetric_stiffness", "joint_limit"]
# Cubic stiffness of the simulated spring [N/m3]
CUBIC = 2e9
parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
parser.add_argument("--duration", type=float, default=3.0, help="of a recording [s]")
parser.add_argument("--out", type=Path, default=Path("results/examples/unlisted"))


def main(arguments: list[str] | None = None) -> r2s.Diagnosis:
    """Diagnose two simulated recordings of a carriage on a spring; print and draw the law, write its model."""
    options = parser.parse_args(arguments)
    options.out.mkdir(parents=True, exist_ok=True)
    system = shipped_system("bouc_wen")
    folder = one_axis.simulate_bouc_wen("stiffening", CUBIC, 71, options.out, options.duration)
    quiet, train, held_out = (
        r2s.Recording.read(system, folder / f"{trial}.parquet") for trial in ("quiet", "train", "held_out")
    )
    answer = r2s.diagnose(
        system,
        train=train,
        held_out=held_out,
        quiet=quiet,
        settings={"diagnosis": {"left_out": ELASTIC}},
    )
    print(answer.verdict, f"{answer.probabilities[answer.verdict]:.3f}")
    if answer.free_form is not None:
        print(law_sentence(answer.free_form))
        for row in answer.free_form["equation"]:
            low, high = row["ci95"]
            print(f"{row['term']}: {row['value']:.4g} ({low:.4g} to {high:.4g}) {row['unit']}")
        answer.plot_law(options.out / "law.png")
        answer.export_model(options.out / "model.xml")
    answer.save(options.out / "diagnosis.json")
    return answer


if __name__ == "__main__":
    main()
