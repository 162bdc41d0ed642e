"""Does the diagnosis hold at other rates and cut-offs than 100 Hz and 12 Hz? Phantom people without and with an effect.

    python benchmarks/rates.py --raw raw --rows rates.jsonl [--seed 9303] [--full]

The same people are recorded by cameras of 50 to 300 Hz, each sample with the same noise, ingested at several cut-offs
and rates of the common clock, and fitted with the plain plant. Without an effect, chi-squared over its expectation is
1 on both trials, and the marker noise that is measured is the one that was put in. ``--full`` also runs whole
diagnoses at corners of the grid: without an effect the verdict has to be `none`, with one that effect.

Raw exports that are there are kept, and so are finished rows: a run goes on where the last one stopped.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import json
import os
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

for _threads in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
    os.environ.setdefault(_threads, "1")

import numpy as np

ROOT = Path(__file__).parents[1]
sys.path.insert(0, str(ROOT / "workflow"))

from real2sim.artefacts import read_json
from real2sim.configuration import read_yaml, validated
from real2sim.diagnosis.refit import JointResiduals
from real2sim.recording.ingest import ingest_subject
from real2sim.study.diagnose import strap_trials, time_step
from real2sim.verification.answers import HELD_OUT, NEUTRAL, TRAIN, diagnose_cases
from real2sim.verification.suite.write import write_cases

ROBOT = ROOT / "resources" / "robot" / "drba.xml"
CASES = {"null": 4, "in_library": 2}
EFFECTS = ["slack", "coulomb"]
RATES_HZ, CUTOFFS_HZ = (50, 100, 150, 200, 300), (6, 8, 12, 20)
# Rate of the cameras, rate of the common clock
PAIRS = ((50, 50), (100, 100), (200, 200), (300, 300), (150, 100), (300, 100), (50, 200), (300, 50))
# Cameras, clock, cut-off of the diagnoses in full, of the first case that is a null and of the one with an effect
CORNERS = ((50, 50, 6), (300, 300, 6), (100, 100, 6), (50, 50, 20), (300, 100, 8), (100, 100, 20))
EFFECT_CORNERS = ((100, 100, 6), (100, 100, 20))
SLICES = ("ingest", "identification", "identifiability", "plant", "robot", "diagnosis")


def write_people(raw: Path, seed: int) -> dict[str, dict[str, Any]]:
    """Write the raw exports ``<raw>/<RATE>/<CASE>`` that are missing; return the truth of each case."""
    suite = validated({"name": "rates", "seed": seed, "cases": CASES, "effects": EFFECTS}, "suite", raw)
    robot = validated({}, "config", raw)["robot"]
    for rate in RATES_HZ:
        phantom = read_yaml(ROOT / "config" / "phantom.yaml")
        phantom["rates"]["markers_hz"] = rate
        truth = raw / f"sealed-{rate}.json"
        if not truth.exists():
            write_cases(
                suite=suite,
                shard=0,
                settings=phantom,
                controllers=robot,
                robot=ROBOT,
                out=raw / str(rate),
                truth=truth,
            )
    return {case["id"]: case for case in read_json(raw / f"sealed-{RATES_HZ[0]}.json")["cases"]}


def settings_for(clock_hz: float, cutoff_hz: float) -> dict[str, Any]:
    """Return the configuration of a diagnosis at a rate of the common clock and a cut-off."""
    own = validated({"ingest": {"rate_hz": clock_hz, "cutoff_hz": cutoff_hz}}, "config", Path("rates"))
    return {name: own[name] for name in SLICES}


def fit_plain(folder: Path, clock_hz: float, cutoff_hz: float, noise_m: float) -> dict[str, Any]:
    """Fit the plain plant to raw exports; return chi-squared over its expectation and the noise over the true one."""
    settings = settings_for(clock_hz, cutoff_hz)
    settings["plant"] = settings["plant"] | {"timestep_s": time_step(settings, None)}
    with tempfile.TemporaryDirectory() as tables, contextlib.redirect_stdout(io.StringIO()):
        out = Path(tables)
        raw = sorted(path for path in folder.iterdir() if path.name != "subject.yaml")
        ingest_subject(subject=folder.name, folder=folder, settings=settings["ingest"], raw=raw, out=out)
        trials = {"train": out / TRAIN, "held_out": out / HELD_OUT, "neutral": out / NEUTRAL}
        pair, z = strap_trials(
            **trials, limits=None, robot=ROBOT, settings=settings, progress=lambda text: None
        ).prepare()
    ratios = []
    for evidence in (pair.train, pair.held_out):
        error = JointResiduals(evidence, (), pair.system).raw(z)
        ratios.append(float(np.sum(evidence.whiten(error) ** 2) / evidence.samples))
    variances = [sd**2 for sd in pair.train.levels.noise_model.marker_sd.values()]
    return {
        "ratios": ratios,
        "samples": pair.train.samples,
        "noise": float(np.sqrt(np.mean(variances)) / noise_m),
    }


def diagnose_in_full(folder: Path, clock_hz: float, cutoff_hz: float) -> dict[str, Any]:
    """Diagnose raw exports; return verdict and probabilities."""
    with tempfile.TemporaryDirectory() as work, contextlib.redirect_stderr(io.StringIO()):
        settings, out = settings_for(clock_hz, cutoff_hz), Path(work)
        diagnose_cases(cases=[folder], robot=ROBOT, settings=settings, work=out, out=out / "answers.json")
        answer = read_json(out / folder.name / "diagnosis.json")
    probabilities = answer["probabilities"]
    return {"verdict": answer["verdict_set"] or [answer["verdict"]], "none": probabilities["none"]} | {
        "probability": probabilities[answer["verdict"]]
    }


class Rows:
    """Finished rows, one JSON object a line, by their key."""

    def __init__(self, path: Path):
        self._path = path
        lines = path.read_text().splitlines() if path.exists() else []
        self._done = {tuple(row["key"]): row for row in map(json.loads, lines)}

    def get(self, key: tuple, make: Any) -> dict[str, Any]:
        """Return the row of a key, made and kept where it is missing."""
        if key not in self._done:
            begun = time.process_time()
            row = {"key": list(key)} | make()
            row["cpu_s"] = time.process_time() - begun
            with self._path.open("a") as file:
                file.write(json.dumps(row) + "\n")
            self._done[key] = row
        return self._done[key]


def report_plain(rows: Rows, raw: Path, people: dict[str, dict[str, Any]], most: int) -> None:
    """Fit the nulls over the grid and print a line per camera, clock and cut-off."""
    nulls = [name for name, truth in people.items() if truth["stratum"] == "null"][:most]
    print(
        "cameras  clock  cut-off   chi-squared over its expectation (mean, largest of trials)   SD of noise over true"
    )
    for cameras, clock in PAIRS:
        for cutoff in CUTOFFS_HZ:
            done = []
            for name in nulls:
                truth_m = people[name]["noise_m"] * np.sqrt(clock / cameras)
                folder = raw / str(cameras) / name
                key = ("plain", cameras, clock, cutoff, name)
                done.append(
                    rows.get(key, lambda f=folder, c=clock, h=cutoff, m=truth_m: fit_plain(f, c, h, m))
                )
            ratios = np.array([row["ratios"] for row in done])
            noise = np.array([row["noise"] for row in done])
            print(
                f"{cameras:7d} {clock:6d} {cutoff:8d}   {ratios.mean():.3f}  {ratios.max():.3f}"
                f"      {noise.min():.3f} to {noise.max():.3f}",
                flush=True,
            )


def report_full(rows: Rows, raw: Path, people: dict[str, dict[str, Any]]) -> None:
    """Diagnose corners of the grid and print verdict and probabilities."""
    nulls = [name for name, truth in people.items() if truth["stratum"] == "null"]
    known = [name for name, truth in people.items() if truth["stratum"] == "in_library"]
    # every null in turn, every effect at both ends
    plan = [(nulls[i % len(nulls)], *corner) for i, corner in enumerate(CORNERS)]
    plan += [(name, *corner) for name in known for corner in EFFECT_CORNERS]
    print("case   true          cameras  clock  cut-off   verdict, probability, probability of none")
    for name, cameras, clock, cutoff in plan:
        true = ", ".join(effect["effect"] for effect in people[name]["effects"]) or "none"
        key, folder = ("full", cameras, clock, cutoff, name), raw / str(cameras) / name
        row = rows.get(key, lambda f=folder, c=clock, h=cutoff: diagnose_in_full(f, c, h))
        said = ", ".join(map(str, row["verdict"]))
        print(
            f"{name}  {true:12s} {cameras:8d} {clock:6d} {cutoff:8d}   {said}  {row['probability']:.3f}"
            f"  {row['none']:.3f}",
            flush=True,
        )


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--raw", type=Path, required=True, help="folder of the raw exports, written if missing"
    )
    parser.add_argument("--rows", type=Path, required=True, help="file of finished rows")
    parser.add_argument("--seed", type=int, default=9303)
    parser.add_argument("--nulls", type=int, default=2, help="nulls that the grid is fitted to")
    parser.add_argument(
        "--full", action="store_true", help="also whole diagnoses (a minute each, 300 Hz three)"
    )
    options = parser.parse_args()
    people = write_people(options.raw, options.seed)
    rows = Rows(options.rows)
    report_plain(rows, options.raw, people, options.nulls)
    if options.full:
        report_full(rows, options.raw, people)


if __name__ == "__main__":
    main()
