"""Fit the constants of the diagnosis' probabilities (config: diagnosis.calibration) to development cases.

    snakemake --cores 2 suite --config suite=config/suite-development.yaml
    python benchmarks/calibrate_diagnosis.py results/suite/development

Maximises the mean log-probability of the truth (a proper score, so that the probabilities are calibrated) with a weak
pull to the present constants. A false alarm weighs as much as `--null-weight` other mistakes. Cross-validated over
folds of cases, so that the printed gain is one that new cases would see. Suites that are scored are refused: their
names are in config/suite*.yaml, and what has been tuned on is no longer withheld.
"""

from __future__ import annotations

import argparse
import json
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from real2sim.artefacts import read_json
from real2sim.diagnosis.decide import Candidate, decide, logits
from scipy.optimize import minimize

ROOT = Path(__file__).resolve().parents[1]
# Constants that scale (searched as ln) and those that shift
SCALES = (
    "temperature",
    "temperature_per_excess",
    "train_weight",
    "per_parameter",
    "second_effect",
    "second_effect_share",
    "isolated",
    "none_gain",
    "none_temperature",
    "unknown_unexplained",
    "unknown_scatter",
)
SHIFTS = ("none", "unknown")
PULL_SD = {"scale": 1.0, "shift": 3.0}
# Probability that no truth falls below: one hopeless case must not decide the constants
LEAST = 1e-3


@dataclass
class Example:
    """One case: what the decision saw, and what is true."""

    case: dict[str, Any]
    plain: Candidate
    candidates: list[Candidate]
    samples: tuple[int, int]

    @property
    def names(self) -> tuple[str, ...]:
        """Effects or families of the truth."""
        return tuple(effect.get("family") or effect["effect"] for effect in self.case["effects"])

    def probability(self, constants: dict[str, float]) -> float:
        """Probability that the decision gives the truth."""
        z = logits(self.plain, self.candidates, self.samples, constants)
        p = np.exp(z - z.max())
        p /= p.sum()
        stratum = self.case["stratum"]
        if stratum.startswith("null"):
            return float(p[-2])
        if stratum == "out_of_library":
            return float(p[-1])
        wanted = set(self.names)
        return float(sum(s for c, s in zip(self.candidates, p, strict=False) if set(c.names) == wanted))


def examples(folder: Path) -> list[Example]:
    """Cases of a suite that has been answered."""
    known = {yaml.safe_load(path.read_text())["name"]: path for path in (ROOT / "config").glob("suite*.yaml")}
    if folder.name != "development" and folder.name in known:
        sys.exit(f"{folder}: {known[folder.name].name} is a suite that is scored. Calibrate on another one.")
    sealed = {
        c["id"]: c for path in sorted((folder / "sealed").glob("*.json")) for c in read_json(path)["cases"]
    }
    out = []
    for path in sorted((folder / "cases").glob("*/diagnosis.json")):
        answer = read_json(path, ("considered", "gap"))
        rows = [
            Candidate(tuple(r["effects"]), r["parameters"], tuple(r["chi2"])) for r in answer["considered"]
        ]
        gap = answer["gap"]
        out.append(
            Example(
                sealed[answer["subject"]],
                Candidate((), 0, tuple(gap["chi2_plain"])),
                rows,
                tuple(gap["chi2_expected"]),
            )
        )
    return out


def pack(constants: dict[str, float]) -> np.ndarray:
    """Searched numbers of the constants."""
    return np.array([np.log(max(constants[k], 1e-6)) for k in SCALES] + [constants[k] for k in SHIFTS])


def unpack(x: np.ndarray, present: dict[str, float]) -> dict[str, float]:
    """Constants of the searched numbers, and the ``present`` ones that are chosen and not fitted."""
    values = [*np.exp(x[: len(SCALES)]), *x[len(SCALES) :]]
    return present | dict(zip((*SCALES, *SHIFTS), map(float, values), strict=True))


def loss(
    x: np.ndarray, rows: list[Example], null_weight: float, start: np.ndarray, present: dict[str, float]
) -> float:
    """Mean of minus ln of the truth's probability, weighted, and the pull to the start."""
    constants = unpack(x, present)
    weights = np.array([null_weight if r.case["stratum"].startswith("null") else 1.0 for r in rows])
    terms = -np.log(np.maximum([r.probability(constants) for r in rows], LEAST))
    sd = np.array([PULL_SD["scale"]] * len(SCALES) + [PULL_SD["shift"]] * len(SHIFTS))
    pull = 0.5 * np.sum(((x - start) / sd) ** 2)
    return float((weights @ terms + pull) / weights.sum())


def fit(rows: list[Example], start: np.ndarray, null_weight: float, present: dict[str, float]) -> np.ndarray:
    """Constants by Powell's method from the present ones: the loss has kinks where the best candidate changes."""
    options = {"maxiter": 40, "xtol": 1e-2, "ftol": 1e-4}
    about = (rows, null_weight, start, present)
    return np.asarray(minimize(loss, start, about, method="Powell", options=options).x)


def right(row: Example, constants: dict[str, float]) -> tuple[bool, str]:
    """Whether the verdict is the truth (or of its family), and the verdict."""
    d = decide(row.plain, row.candidates, row.samples, constants)
    stratum = row.case["stratum"]
    if stratum.startswith("null"):
        return d.verdict == "none", d.verdict
    if stratum == "out_of_library":
        return d.verdict == "unknown", d.verdict
    chosen = " + ".join(sorted(row.candidates[d.chosen].names)) if d.chosen is not None else d.verdict
    if stratum == "mixture":
        return chosen == " + ".join(sorted(set(row.names))), chosen
    return d.verdict == row.names[0], chosen


def table(rows: list[Example], constants: dict[str, float]) -> dict[str, str]:
    """Verdicts that are right, by stratum and visibility."""
    counts: dict[str, list[bool]] = {}
    for row in rows:
        rho = row.case["visibility"]["target"] if row.case["stratum"] == "in_library" else None
        counts.setdefault(row.case["stratum"] + (f" {rho}" if rho else ""), []).append(
            right(row, constants)[0]
        )
    return {key: f"{sum(v)}/{len(v)}" for key, v in sorted(counts.items())}


def main() -> None:
    """Fit, cross-validate, print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("suites", nargs="+", type=Path, help="results/suite/<NAME> of development suites")
    parser.add_argument("--null-weight", type=float, default=3.0)
    parser.add_argument("--folds", type=int, default=4)
    parser.add_argument("--keep", action="store_true", help="only show the present constants")
    parser.add_argument("--wrong", action="store_true", help="list the cases that are wrong")
    args = parser.parse_args()
    rows = [row for folder in args.suites for row in examples(folder)]
    config = yaml.safe_load((ROOT / "config/config.yaml").read_text())
    present = config["diagnosis"]["calibration"]
    start = pack(present)
    print(f"{len(rows)} cases, loss {loss(start, rows, args.null_weight, start, present):.4f}")
    print(json.dumps(table(rows, present), indent=1))
    constants = present
    if not args.keep:
        order = np.random.default_rng(1).permutation(len(rows))
        held = []
        for fold in np.array_split(order, args.folds):
            inside = [rows[i] for i in order if i not in set(fold)]
            x = fit(inside, start, args.null_weight, present)
            outside = [rows[i] for i in fold]
            held.append([loss(v, outside, args.null_weight, v, present) for v in (start, x)])
        print(f"cross-validated loss: {np.mean(held, axis=0)[0]:.4f} -> {np.mean(held, axis=0)[1]:.4f}")
        constants = unpack(fit(rows, start, args.null_weight, present), present)
        print(json.dumps({k: float(f"{v:.3g}") for k, v in constants.items()}, indent=1))
        print(json.dumps(table(rows, constants), indent=1))
    if args.wrong:
        for row in rows:
            good, verdict = right(row, constants)
            if not good:
                forms = [e.get("form") for e in row.case["effects"]]
                print(
                    row.case["id"],
                    row.case["stratum"],
                    forms,
                    row.case["visibility"]["target"],
                    "->",
                    verdict,
                )


if __name__ == "__main__":
    main()
