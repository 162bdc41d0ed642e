"""Are the sealed causes of a cohort with a study-like gap found, and what are K and D worth with them in the model?

    snakemake --cores 2 --configfile config/gap.yaml -- diagnosis
    python benchmarks/gap_cohort.py results [--out results/benchmarks]

Compares every diagnosis.json with the sealed truth of its phantom person. *Named*: the answer's effects are the sealed
ones; *in the group*: each sealed one is named or among those that the answer says cannot be told from it. *Closed* is
the share of J above its noise floor that the named effects take away on the trial that was not fitted. *Cut* is the RMS
error of ln K and ln D with the plain model over that with the named effects; the error of those that the answer calls
determined stands beside it.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from real2sim.artefacts import read_json


def row(person: str, answer: dict[str, Any], truth: dict[str, Any]) -> dict[str, Any]:
    """Return what an answer is worth, of one person."""
    sealed = {cause["effect"] for cause in truth["gap"]["causes"]}
    named = set(answer["verdict_set"])
    gap, numbers = answer["gap"], answer["parameters"]
    true = np.array([truth["parameters"][name]["value"] for name in numbers])
    off = {
        key: np.log(np.array([n[key] for n in numbers.values()]) / true) for key in ("base", "with_effect")
    }
    errors = [float(np.sqrt(np.mean(off[key] ** 2))) for key in off]
    sure = np.array([n["verdict"] == "determined" for n in numbers.values()])
    plain, floor, left = gap["J_base"], gap["J_floor"], gap["J_with_effect"]
    return {
        "person": person,
        "sealed": " + ".join(sorted(sealed)),
        "answer": " + ".join(sorted(named)),
        "probability": answer["probabilities"][answer["verdict"]],
        "named": named == sealed,
        "in_group": sealed <= named | set(answer["ambiguity_group"]),
        "one_of_them": bool(sealed & named),
        "J_plain": plain,
        "J_floor": floor,
        "J_with_effects": left,
        "closed": (plain - left) / (plain - floor),
        "misfit": bool(answer["misfit"] and answer["misfit"]["marked"]),
        "ln_error_plain": errors[0],
        "ln_error_with_effects": errors[1],
        "cut": errors[0] / errors[1],
        "determined": int(sure.sum()),
        "ln_error_determined": float(np.sqrt(np.mean(off["with_effect"][sure] ** 2)))
        if sure.any()
        else np.nan,
    }


def main() -> None:
    """Print a row per person and the cohort's figures."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("results", type=Path, nargs="+", help="results folders of one or several cohorts")
    parser.add_argument("--out", type=Path, default=Path("results/benchmarks"))
    options = parser.parse_args()
    rows = []
    for results in options.results:
        for path in sorted(results.glob("diagnosis/*/diagnosis.json")):
            person = path.parent.name
            truth = read_json(results / "phantom" / "sealed" / f"{person}.json")
            rows.append(row(person, read_json(path), truth))
    table = pd.DataFrame(rows)
    options.out.mkdir(parents=True, exist_ok=True)
    table.to_csv(options.out / "gap_cohort.csv", index=False)
    with pd.option_context("display.width", 250, "display.max_columns", 20):
        print(table.round(3).to_string(index=False))
    n = len(table)
    within = table["J_plain"].between(0.9, 1.6).sum()
    print(f"J of the plain fit within 0.9 to 1.6: {within} of {n}")
    print(
        f"sealed causes named: {table['named'].sum()} of {n}; named or in the group: {table['in_group'].sum()} of {n}"
    )
    print(f"one of them named: {table['one_of_them'].sum()} of {n}")
    print(f"gap closed on the held-out trial, median: {100 * table['closed'].median():.0f} %")
    print(f"error of ln K and ln D cut by (median): {table['cut'].median():.2f}")


if __name__ == "__main__":
    main()
