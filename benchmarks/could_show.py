"""Are the statements "would have been seen from this size" of an answer `none` true?

    snakemake --cores 2 suite --config suite=config/suite-ci.yaml
    python benchmarks/could_show.py results/suite/ci --each 5 --out results/could_show.json

For people without a cause, takes some of their statements at random, adds what an effect of just that size changes in a
simulation to both of their dynamic trials, noise and all, and diagnoses them anew. A statement holds for 95 of 100
records, so 90 to 98 % of the effects should be found: named, or at least not `none`. The effects are those of the
catalogue, simulated by the diagnosis' own model: this measures the statement, not the diagnosis of other physics.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from real2sim.artefacts import read_json, write_json
from real2sim.configuration import read_yaml, validated
from real2sim.diagnosis.decide import NONE
from real2sim.diagnosis.refit import Hypothesis
from real2sim.diagnosis.search import Search
from real2sim.diagnosis.trials import Trials, search_both_ways
from real2sim.diagnosis.visible import could_have_shown, of_size
from real2sim.recording.ingest import ingest_subject
from real2sim.study.diagnose import strap_trials, time_step
from real2sim.study.strap_imagined import injected

ROOT = Path(__file__).resolve().parents[1]


def trials_of(folder: Path, tables: Path, robot: Path) -> Trials:
    """Return the two dynamic trials of raw exports."""
    config = ROOT / "config/config.yaml"
    settings = validated(read_yaml(config), "config", config)
    raw = sorted(p for p in folder.iterdir() if p.name != "subject.yaml")
    ingest_subject(subject=folder.name, folder=folder, settings=settings["ingest"], raw=raw, out=tables)
    settings |= {"plant": settings["plant"] | {"timestep_s": time_step(settings, None)}}
    return strap_trials(
        train=tables / "dynamic_1",
        held_out=tables / "dynamic_2",
        neutral=tables / "neutral",
        limits=None,
        robot=robot,
        settings=settings,
        progress=lambda text: None,
    )


def drawn(statements: list[dict[str, Any]], count: int, rng: np.random.Generator) -> list[dict[str, Any]]:
    """Draw statements that give a size, as many of every effect as there can be."""
    given = [s for s in statements if s["from"] is not None]
    order = rng.permutation(len(given))
    rank: dict[str, int] = {}
    keyed = []
    for i in order:
        name = given[i]["effect"]
        rank[name] = rank.get(name, 0) + 1
        keyed.append((rank[name], int(i)))
    return [given[i] for _, i in sorted(keyed, key=lambda row: row[0])[:count]]


def with_effect(trials: Trials, statement: dict[str, Any], plain: Hypothesis, scales: Any) -> Trials:
    """Return the trials with an effect of the size that a statement gives."""
    placed, x = of_size(statement, trials.system, scales)
    parameters = trials.system.values(plain.base)
    load: Callable[[str, bool], Any] = trials.load
    return replace(trials, load=lambda name, settled: injected(load(name, settled), placed, x, parameters))


def main() -> None:
    """Inject, diagnose, count."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("suite", type=Path, help="results/suite/<NAME>")
    parser.add_argument("--each", type=int, default=5, help="statements a person")
    parser.add_argument("--people", type=int, default=20)
    parser.add_argument("--skip", type=int, default=0, help="people that are left out, from the first")
    parser.add_argument("--robot", type=Path, default=ROOT / "resources/robot/drba.xml")
    parser.add_argument("--out", type=Path)
    args = parser.parse_args()
    sealed = [c for path in sorted((args.suite / "sealed").glob("*.json")) for c in read_json(path)["cases"]]
    people = [c["id"] for c in sealed if c["stratum"] == "null"][args.skip :][: args.people]
    rows: list[dict[str, Any]] = []
    for number, subject in enumerate(people):
        with TemporaryDirectory() as tables:
            trials = trials_of(args.suite / "raw" / subject, Path(tables), args.robot)
            pair, z = trials.prepare()
            plain = Search(pair, trials.options["search"]).fit((), z, final=True)
            statements = could_have_shown(pair, plain, trials.options)
            for statement in drawn(statements, args.each, np.random.default_rng(number + args.skip)):
                outcome = search_both_ways(with_effect(trials, statement, plain, pair.train.scales))
                decision = outcome.decision
                row = statement | {
                    "subject": subject,
                    "verdict": decision.verdict,
                    "group": list(decision.group),
                    "p_none": decision.probabilities[NONE],
                    "chi2_plain": list(outcome.found.attribution.plain.chi2),
                }
                rows.append(row)
                print(json.dumps(row), flush=True)
    found = [row["verdict"] != NONE for row in rows]
    named = [row["effect"] in row["group"] for row in rows]
    print(f"found {sum(found)} of {len(rows)}, in the group named {sum(named)}")
    if args.out is not None:
        write_json(args.out, {"rows": rows})


if __name__ == "__main__":
    main()
