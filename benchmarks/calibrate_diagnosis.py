"""Fit the constants of the judgement (config: diagnosis.calibration) to development cases.

    snakemake --cores 2 suite --config suite=config/suite-judgement.yaml
    python benchmarks/calibrate_diagnosis.py results/suite/judgement

Maximises the mean log-probability of the truth (a proper score, so that the probabilities are calibrated) with a weak
pull to the present constants. A false alarm weighs as much as `--null-weight` other mistakes. Cross-validated over
folds of cases, so that the printed gain is one that new cases would see. The sets of effects are those that were
refitted when the suite was answered; only the judgement is done again. Suites that are scored are refused: what has
been tuned on is no longer withheld.
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
from real2sim.diagnosis.decide import NONE, UNKNOWN, Candidate, Decision, decide
from real2sim.diagnosis.sensors import pooled
from real2sim.effects.catalogue import EFFECTS
from real2sim.verification.score_laws import AS_MUCH, STRATA, accepted
from scipy.optimize import minimize

ROOT = Path(__file__).resolve().parents[1]
DEVELOPMENT = ("judgement", "development", "freeformdevelopment")
# Constants that are fitted, all searched as ln; the others are chosen
FITTED = (
    "overdispersion",
    "inexact_ways",
    "cause_log_odds",
    "further_log_odds",
    "even_share",
    "share_power",
    "unlisted_odds",
)
PULL_SD = 1.0
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

    @property
    def as_good(self) -> list[int]:
        """Sets of listed effects that are as good as a law which was left out or drawn."""
        expected, plain = sum(self.samples), sum(self.plain.chi2)
        most = plain - AS_MUCH * (plain - expected)
        return [
            i
            for i, c in enumerate(self.candidates)
            if set(c.names) & accepted(self.case) and sum(c.chi2) <= most
        ]

    def probability(self, decision: Decision) -> float:
        """Probability that a decision gives the truth."""
        stratum, p = self.case["stratum"], decision.probabilities
        if stratum.startswith("null"):
            return p[NONE]
        if stratum in STRATA:
            return min(p[UNKNOWN] + float(decision.sets[self.as_good].sum()), 1.0)
        if stratum == "out_of_library":
            return p[UNKNOWN]
        wanted = set(self.names)
        if len(wanted) == 1:
            return p[self.names[0]]
        sets = zip(self.candidates, decision.sets, strict=False)
        return float(sum(s for c, s in sets if set(c.names) == wanted))

    def right(self, decision: Decision) -> tuple[bool, str]:
        """Return whether the verdict is the truth (or of its family), and the verdict."""
        stratum, said = self.case["stratum"], decision.verdict
        if decision.chosen is not None:
            said = " + ".join(sorted(self.candidates[decision.chosen].names))
        if stratum in STRATA:
            return said == UNKNOWN or decision.chosen in self.as_good, said
        if stratum == "out_of_library":
            return said == UNKNOWN, said
        if stratum == "mixture":
            return said == " + ".join(sorted(set(self.names))), said
        return decision.verdict == (self.names or (NONE,))[0], said


def _sensors(left: list[list[float]], gap: dict[str, Any]) -> tuple[tuple[float, float, bool], ...]:
    """Sensors of a candidate, see there, of chi-squared by trial and sensor."""
    about = gap["by_sensor"]
    return tuple(zip(pooled(left), pooled(about["chi2_expected"]), about["on_floor"], strict=True))


def _candidate(row: dict[str, Any], gap: dict[str, Any], together: bool) -> Candidate:
    sensors = () if together else _sensors(row["chi2_by_sensor"], gap)
    row = row | (row["both_trials"] or {})
    if not row["effects"]:
        if "handicap" not in row:
            sys.exit("A law in `considered` has no `handicap`: answered by older code. Run the suite again.")
        occam = row["occam"] + row["handicap"]
        return Candidate(tuple(row["places"]), tuple(row["chi2"]), occam, unlisted=True, sensors=sensors)
    places = tuple(tuple(key for key in row["places"] if key.split()[0] == name) for name in row["effects"])
    ambiguous = any(
        key.split()[0] == name and key.endswith(form) for key in row["places"] for name, form in _AMBIGUOUS
    )
    return Candidate(
        tuple(row["effects"]),
        tuple(row["chi2"]),
        row["occam"],
        ambiguous=ambiguous,
        places=places,
        sensors=sensors,
    )


_AMBIGUOUS = [(effect.name, effect.form) for effect in EFFECTS if effect.indistinguishable]


def examples(folder: Path, together: bool = False) -> list[Example]:
    """Cases of a suite that has been answered; ``together``: all sensors are taken as one."""
    known = {yaml.safe_load(path.read_text())["name"]: path for path in (ROOT / "config").glob("suite*.yaml")}
    if folder.name not in DEVELOPMENT and folder.name in known:
        sys.exit(f"{folder}: {known[folder.name].name} is a suite that is scored. Calibrate on another one.")
    sealed = {
        c["id"]: c for path in sorted((folder / "sealed").glob("*.json")) for c in read_json(path)["cases"]
    }
    out = []
    for path in sorted((folder / "cases").glob("*/diagnosis.json")):
        answer = read_json(path, ("considered", "gap"))
        gap = answer["gap"]
        for key in ("by_sensor", "both_trials"):
            if key not in gap:
                sys.exit(f"{path}: expected gap.{key}. It was answered by older code: run the suite again.")
        sets = [_candidate(row, gap, together) for row in answer["considered"]]
        sensors = () if together else _sensors(gap["by_sensor"]["chi2_plain"], gap)
        told = gap["both_trials"] or {"chi2": gap["chi2_plain"], "occam": 0.0}
        plain = Candidate((), tuple(told["chi2"]), told["occam"], sensors=sensors)
        out.append(Example(sealed[answer["subject"]], plain, sets, tuple(gap["chi2_expected"])))
    return out


def judged(row: Example, constants: dict[str, float]) -> Decision:
    """Decide a case anew."""
    return decide(row.plain, row.candidates, row.samples, constants)


def loss(
    x: np.ndarray, rows: list[Example], null_weight: float, start: np.ndarray, present: dict[str, float]
) -> float:
    """Mean of minus ln of the truth's probability, weighted, and the pull to the start."""
    constants = present | dict(zip(FITTED, map(float, np.exp(x)), strict=True))
    weights = np.array([null_weight if r.case["stratum"].startswith("null") else 1.0 for r in rows])
    terms = -np.log(np.maximum([r.probability(judged(r, constants)) for r in rows], LEAST))
    pull = 0.5 * np.sum(((x - start) / PULL_SD) ** 2)
    return float((weights @ terms + pull) / weights.sum())


def fit(rows: list[Example], start: np.ndarray, null_weight: float, present: dict[str, float]) -> np.ndarray:
    """Constants by Powell's method from the present ones: the loss has kinks where the best candidate changes."""
    options = {"maxiter": 40, "xtol": 1e-2, "ftol": 1e-4}
    about = (rows, null_weight, start, present)
    return np.asarray(minimize(loss, start, about, method="Powell", options=options).x)


def table(rows: list[Example], constants: dict[str, float]) -> dict[str, str]:
    """Verdicts that are right, and those that are wrong though surer than 0.9, by stratum and visibility."""
    counts: dict[str, list[tuple[bool, bool]]] = {}
    for row in rows:
        rho = row.case["visibility"]["target"] if row.case["stratum"] == "in_library" else None
        decision = judged(row, constants)
        good = row.right(decision)[0]
        sure = max(decision.probabilities.values()) > 0.9
        counts.setdefault(row.case["stratum"] + (f" {rho}" if rho else ""), []).append(
            (good, sure and not good)
        )
    return {
        key: f"{sum(g for g, _ in v)}/{len(v)}, wrong and sure {sum(w for _, w in v)}"
        for key, v in sorted(counts.items())
    }


def main() -> None:
    """Fit, cross-validate, print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("suites", nargs="+", type=Path, help="results/suite/<NAME> of development suites")
    parser.add_argument("--null-weight", type=float, default=3.0)
    parser.add_argument("--folds", type=int, default=4)
    parser.add_argument("--keep", action="store_true", help="only show the present constants")
    parser.add_argument("--together", action="store_true", help="take all sensors as one, for comparison")
    parser.add_argument("--wrong", action="store_true", help="list the cases that are wrong")
    args = parser.parse_args()
    rows = [row for folder in args.suites for row in examples(folder, args.together)]
    config = yaml.safe_load((ROOT / "config/config.yaml").read_text())
    present = config["diagnosis"]["calibration"]
    start = np.log([present[key] for key in FITTED])
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
        x = fit(rows, start, args.null_weight, present)
        constants = present | dict(zip(FITTED, map(float, np.exp(x)), strict=True))
        print(json.dumps({k: float(f"{v:.3g}") for k, v in constants.items()}, indent=1))
        print(json.dumps(table(rows, constants), indent=1))
    if args.wrong:
        for row in rows:
            decision = judged(row, constants)
            good, verdict = row.right(decision)
            if not good:
                forms = [e.get("form") for e in row.case["effects"]]
                print(
                    row.case["id"],
                    row.case["stratum"],
                    forms,
                    row.case["visibility"]["target"],
                    "->",
                    verdict,
                    f"{decision.probabilities[decision.verdict]:.2f}",
                )


if __name__ == "__main__":
    main()
