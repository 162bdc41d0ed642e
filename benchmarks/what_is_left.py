"""Compare what a diagnosis leaves of each channel with what noise alone leaves, where floors make that less than one.

python benchmarks/what_is_left.py [--results results] SUBJECT [SUBJECT ...]

Mean square of the whitened residuals, by trial: of the diagnosed model, and of noise that is simulated through the
plant with the same stiffness and damping.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import numpy as np

ROOT = Path(__file__).parents[1]
sys.path.insert(0, str(ROOT / "workflow"))

from real2sim.artefacts import read_json
from real2sim.geometry import INTERFACE_MARKERS
from real2sim.study.diagnosis_model import diagnosed_evidence, effects_of
from real2sim.study.strap_evidence import StrapEvidence
from real2sim.system.plant import ROBOT_JOINTS

CHANNELS = (*(f"{m}_{c}" for m in INTERFACE_MARKERS for c in "xyz"), *ROBOT_JOINTS)


def squares(evidence: StrapEvidence, whitened: np.ndarray) -> np.ndarray:
    """Mean square (c,) by channel of whitened residuals (m, n_r)."""
    return np.asarray(np.mean(whitened.reshape(-1, evidence.channels) ** 2, axis=0))


def left_of(subject: str, results: Path, trial: str) -> tuple[np.ndarray, np.ndarray]:
    """Mean square (c,) by channel of what the diagnosed model leaves, and of what noise leaves."""
    file = results / "diagnosis" / subject / "diagnosis.json"
    answer = read_json(file, ("train", "held_out", "robot_holds", "model", "parameters", "settings"))
    tables, robot = results / "trials" / subject, ROOT / "resources" / "robot" / "drba.xml"
    limits = results / "limits" / f"{subject}.json"
    evidence = diagnosed_evidence(answer, tables / trial, tables / "neutral", limits, robot)
    if trial in answer["held_out"]:
        evidence = evidence.as_held_out()
    effects, x = effects_of(answer["model"], evidence.setup.system, file)
    names = [p.name for p in evidence.setup.system.parameters]
    fitted = np.array([answer["parameters"][name]["fitted"] for name in names])
    options = answer["settings"]["diagnosis"]
    evidence = evidence.with_noise(fitted, options["noise_draws"], options["search"]["seed"])
    paths, joints = evidence.replay(effects, 1).run_effects(fitted[None], [np.atleast_2d(own) for own in x])
    left, noise = evidence.whitened(paths, joints), evidence.whiten(evidence.noise)
    return squares(evidence, left), squares(evidence, noise)


def main() -> None:
    """Print a table per person and trial."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("subjects", nargs="+", metavar="SUBJECT")
    parser.add_argument("--results", type=Path, default=Path("results"))
    args = parser.parse_args()
    print(" ".join(["subject trial     of   ", *(f"{name:>8}" for name in CHANNELS), " markers    robot"]))
    for subject in args.subjects:
        answer = read_json(args.results / "diagnosis" / subject / "diagnosis.json", ("train", "held_out"))
        for trial in (*answer["train"], *answer["held_out"]):
            for what, row in zip(("answer", "noise"), left_of(subject, args.results, trial), strict=True):
                both = [row[:6].mean(), *([row[6:].mean()] if len(row) > 6 else [])]
                cells = " ".join(f"{value:8.2f}" for value in (*row, *both))
                print(f"{subject:7} {trial:9} {what:6} {cells}", flush=True)


if __name__ == "__main__":
    main()
