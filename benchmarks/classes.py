"""Are parameters classed as they are? A finished phantom study against its sealed truth.

    python benchmarks/classes.py results --out classes.json

Truly "shared": all people of the cohort have the same true value; truly "own": they differ. A class is right where it
says common (shared) and they are, or distinct (person's own) and they are not; where it says neither, it is untold. The
paper's class, those of the exact intervals over fits and over trials, and the verdict of classes.csv are scored. Power:
the probability that the exact interval over trials tells a parameter of this true spread, at the study's people, trials
and scatter between trials, if that scatter were the only error. Runs in a second.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import numpy as np

ROOT = Path(__file__).parents[1]
sys.path.insert(0, str(ROOT / "workflow"))

from real2sim.artefacts import finite_or_none, number, read_json, read_table, write_json
from real2sim.inference.parameters import PARAMETERS
from real2sim.study.statistics.classes import OWN, SHARED
from real2sim.study.statistics.study import POWER, exact_class_shares

# what each method must say of a parameter that is shared, and of one that is not
SAYS = {
    "class": ("common", "distinct"),
    "class_by_exact_interval": ("common", "distinct"),
    "class_by_nested_interval": ("common", "distinct"),
    "verdict": (SHARED, OWN),
}
SAME_LN = 1e-9


def truth(folder: Path, people: list[str]) -> np.ndarray:
    """Ln of the true parameters, (people, 12), from the sealed files."""
    rows = []
    for name in people:
        sealed = read_json(folder / "phantom" / "sealed" / f"{name}.json", ("parameters",))["parameters"]
        rows.append([np.log(sealed[p]["value"]) for p in PARAMETERS])
    return np.array(rows)


def zones(row: dict[str, str]) -> dict[str, float]:
    """Settings of the classes as a table of the study holds them."""
    return {key: number(row[key]) for key in ("common_below", "distinct_from", "confidence")}


def power(true_sd: float, nested: dict[str, str]) -> float:
    """Probability that the interval over trials says what is true, at the study's people and trials."""
    people = int(nested["n_subjects"])
    repeats = round(int(nested["n_trials"]) / people)
    restart = number(nested["sd_restart_ln"])
    within = number(nested["sd_trial_ln"]) ** 2 + (0.0 if np.isnan(restart) else restart**2)
    icc = true_sd**2 / (true_sd**2 + within) if true_sd > 0 else 0.0
    shares = exact_class_shares(icc, people, repeats, zones(nested))
    return shares["common" if true_sd == 0 else "distinct"]


def outcome(said: str, shared: bool, words: tuple[str, str]) -> str:
    """Right, wrong or untold."""
    if said not in words:
        return "untold"
    return "right" if (said == words[0]) == shared else "wrong"


def scored(folder: Path) -> list[dict]:
    """One row per parameter: its true spread, estimated components, what each method says, and how it fares."""
    nested = {r["parameter"]: r for r in read_table(folder / "shareability" / "nested.csv", ("class",))}
    classes = {r["parameter"]: r for r in read_table(folder / "shareability" / "classes.csv", tuple(SAYS))}
    people = sorted(
        {row["subject"] for row in read_table(folder / "shareability" / "fits.csv", ("subject",))}
    )
    known = truth(folder, people)
    rows = []
    for j, name in enumerate(PARAMETERS):
        spread = float(known[:, j].std(ddof=1))
        spread = 0.0 if spread < SAME_LN else spread
        said = {method: classes[name][method] for method in SAYS}
        rows.append(
            {
                "parameter": name,
                "truth": "own" if spread else "shared",
                "true_sd_ln": spread,
                "sd_person_ln": finite_or_none(number(nested[name]["sd_person_ln"])),
                "sd_trial_ln": finite_or_none(number(nested[name]["sd_trial_ln"])),
                "sd_restart_ln": finite_or_none(number(nested[name]["sd_restart_ln"])),
                "power": finite_or_none(power(spread, nested[name])),
                "said": said,
                "outcome": {
                    method: outcome(said[method], not spread, words) for method, words in SAYS.items()
                },
            }
        )
    return rows


def report(rows: list[dict]) -> dict:
    """Print and return how many are right, wrong and untold by each method, and where power allows."""
    print("parameter truth  true SD  people  trials restart  power  paper / exact / trials -> verdict")
    for row in rows:
        sds = [row[key] for key in ("true_sd_ln", "sd_person_ln", "sd_trial_ln", "sd_restart_ln", "power")]
        cells = " ".join(f"{'-' if sd is None else format(sd, '.3f'):>7s}" for sd in sds)
        said = [row["said"][method] or "-" for method in SAYS]
        print(f"{row['parameter']:9s} {row['truth']:6s} {cells}  {' / '.join(said[:3])} -> {said[3]}")
    able = [row for row in rows if row["power"] is not None and row["power"] >= POWER]
    out: dict = {"parameters": rows, "with_power": [row["parameter"] for row in able], "score": {}}
    for method in SAYS:
        of = {}
        for label, chosen in (("all", rows), ("with_power", able)):
            of[label] = {
                what: [row["parameter"] for row in chosen if row["outcome"][method] == what]
                for what in ("right", "wrong", "untold")
            }
        out["score"][method] = of
        print(f"\n{method}")
        for label, counts in of.items():
            total = sum(map(len, counts.values()))
            told = ", ".join(f"{len(names)} {what}" for what, names in counts.items())
            print(f"  {label:10s} of {total}: {told}; wrong: {' '.join(counts['wrong']) or 'none'}")
    short = [row["parameter"] for row in rows if row not in able]
    print(
        f"\ncannot be told with {100 * POWER:.0f} % probability at these numbers: {' '.join(short) or 'none'}"
    )
    return out


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("results", type=Path, help="results folder of a finished phantom study")
    parser.add_argument("--out", type=Path, help="the report as JSON")
    options = parser.parse_args()
    result = report(scored(options.results))
    if options.out:
        write_json(options.out, result)


if __name__ == "__main__":
    main()
