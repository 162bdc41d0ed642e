"""Does the trial that an answer proposes make the right answer surer?

    snakemake --cores 2 suite --config suite=config/suite-judgement.yaml
    python benchmarks/next_trial.py results/suite/judgement --config config/suite-judgement.yaml

For people whose answer was `unknown` or split, the phantom makes the proposed motion (same person, same cause, new
noise), the trial is written and read like the others, and the diagnosis is asked again with all three. Counted is the
probability of the right answer: that of the true effects, and of `unknown` where the catalogue does not hold the cause.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterator
from itertools import permutations
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from real2sim.artefacts import read_json, write_json
from real2sim.configuration import read_yaml, validated
from real2sim.diagnosis.decide import NONE, UNKNOWN
from real2sim.geometry import AXES
from real2sim.recording.ingest import ingest_subject
from real2sim.study.diagnose import diagnose, strap_trials, time_step
from real2sim.study.strap_imagined import motions
from real2sim.verification.phantom.motions import SampledMotion
from real2sim.verification.score_laws import STRATA
from real2sim.verification.suite.plan import case_names
from real2sim.verification.suite.write import FURTHER, HELD_OUT, TRAIN, write_with_further

ROOT = Path(__file__).resolve().parents[1]
ROBOT = ROOT / "resources/robot/drba.xml"
# An answer below this probability is split
SURE = 0.9


def right(case: dict[str, Any], answer: dict[str, Any]) -> float:
    """Probability of the right answer."""
    p = answer["probabilities"]
    if case["stratum"] in (*STRATA, "out_of_library"):
        return float(p[UNKNOWN])
    names = {effect.get("family") or effect["effect"] for effect in case["effects"]}
    return float(sum(p[name] for name in names)) if names else float(p[NONE])


def ingested(folder: Path, out: Path, settings: dict[str, Any]) -> Path:
    """Return the folder of canonical tables of raw exports."""
    raw = sorted(p for p in folder.iterdir() if p.name != "subject.yaml")
    ingest_subject(subject=folder.name, folder=folder, settings=settings["ingest"], raw=raw, out=out)
    return out


def proposed_motion(tables: Path, train: str, words: str, settings: dict[str, Any]) -> np.ndarray:
    """Return the motion (n, 6) of the pelvis that an answer told in words."""
    settings = settings | {"plant": settings["plant"] | {"timestep_s": time_step(settings, None)}}
    other = HELD_OUT if train == TRAIN else TRAIN
    trials = strap_trials(
        train=tables / train,
        held_out=tables / other,
        neutral=tables / "neutral",
        limits=None,
        robot=ROBOT,
        settings=settings,
        progress=lambda text: None,
    )
    evidence = trials.load(train, False)
    for axes in permutations(AXES, 2):
        for motion in motions(evidence, axes):
            if motion.words == words:
                return motion.path
    raise ValueError(f"no motion is called: {words}")


def chosen(suite: Path) -> Iterator[tuple[int, dict[str, Any], dict[str, Any]]]:
    """Yield shard, sealed truth and answer of every case whose answer is unknown or split and has a proposal."""
    for path in sorted((suite / "sealed").glob("*.json")):
        sealed = read_json(path)
        for case in sealed["cases"]:
            file = suite / "cases" / case["id"] / "diagnosis.json"
            answer = read_json(file) if file.exists() else {}
            if not answer.get("proposed_trial"):
                continue
            if answer["verdict"] == UNKNOWN or max(answer["probabilities"].values()) < SURE:
                yield sealed["shard"], case, answer


def recorded(suite: dict[str, Any], shard: int, paths: dict[str, np.ndarray], out: Path) -> None:
    """Write a shard's people anew, with the further trial of some."""
    config = ROOT / "config/config.yaml"
    write_with_further(
        suite=suite,
        shard=shard,
        settings=read_yaml(ROOT / "config/phantom.yaml"),
        controllers=validated(read_yaml(config), "config", config)["robot"],
        robot=ROBOT,
        out=out,
        truth=out / "sealed.json",
        further={name: SampledMotion(len(path) / 100.0, path=path) for name, path in paths.items()},
    )


def main() -> None:
    """Propose, record, ask again, count."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("suite", type=Path, help="results/suite/<NAME>")
    parser.add_argument("--config", type=Path, required=True, help="configuration of that suite")
    parser.add_argument("--most", type=int, default=1000, help="cases")
    parser.add_argument("--out", type=Path)
    args = parser.parse_args()
    suite = validated(read_yaml(args.config), "suite", args.config)
    by_shard: dict[int, list[tuple[dict[str, Any], dict[str, Any]]]] = {}
    for shard, case, answer in list(chosen(args.suite))[: args.most]:
        by_shard.setdefault(shard, []).append((case, answer))
    rows = [row for shard, cases in by_shard.items() for row in asked(suite, args.suite, shard, cases)]
    surer = sum(row["after"] > row["before"] for row in rows)
    print(f"surer {surer} of {len(rows)}")
    if args.out is not None:
        write_json(args.out, {"rows": rows})


def asked(
    suite: dict[str, Any], folder: Path, shard: int, cases: list[tuple[dict[str, Any], dict[str, Any]]]
) -> Iterator[dict[str, Any]]:
    """Yield the probability of the right answer before and after the proposed trial, of cases of one shard."""
    with TemporaryDirectory() as place:
        work, paths = Path(place), {}
        for case, answer in cases:
            name, settings = case["id"], answer["settings"]
            tables = ingested(folder / "raw" / name, work / "before" / name, settings)
            words = answer["proposed_trial"]["motion"]
            paths[name] = proposed_motion(tables, answer["train"][0], words, settings)
        assert set(paths) <= set(case_names(suite, shard))
        recorded(suite, shard, paths, work / "raw")
        for case, answer in cases:
            name, settings = case["id"], answer["settings"]
            tables = ingested(work / "raw" / name, work / "after" / name, settings)
            diagnose(
                subject=name,
                train=tables / TRAIN,
                held_out=tables / HELD_OUT,
                further=[tables / FURTHER],
                neutral=tables / "neutral",
                robot=ROBOT,
                settings=settings,
                out=tables / "diagnosis.json",
            )
            after = read_json(tables / "diagnosis.json")
            row = {
                "case": name,
                "stratum": case["stratum"],
                "truth": [e.get("form") or e["effect"] for e in case["effects"]],
                "motion": answer["proposed_trial"]["motion"],
                "difference_sd": answer["proposed_trial"]["difference_sd"],
                "verdict": [answer["verdict"], after["verdict"]],
                "before": right(case, answer),
                "after": right(case, after),
            }
            print(json.dumps(row), flush=True)
            yield row


if __name__ == "__main__":
    main()
