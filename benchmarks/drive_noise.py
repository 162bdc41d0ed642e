"""How far does noise of the replayed pelvis bend a fit, and what does an effect gain by passing on less of it?

    python benchmarks/drive_noise.py results/suite/SUITE [--library ../other/workflow]

Of the people without a cause of a suite that was answered: ln(fit / truth) of the diagnosis' plain fit by parameter,
chi-squared at the true parameters and of the fit, and what the effects that filter the path take from it. Prints a row
per person and the medians. ``--library`` names another checkout's ``workflow``, to compare two versions.
"""

from __future__ import annotations

import argparse
import os
import sys
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np

ROOT = Path(__file__).parents[1]
# Effects under which the pelvis moves less, or more slowly, than its markers
FILTERS = ("soft_tissue", "filter_lag", "added_mass")


def gain_of(search, plain, places, name: str) -> float:
    """Chi-squared of both trials that the best place and form of an effect takes from the plain fit, 0 for none."""
    screened = search.screen(plain, [p for p in places if p.effect.name == name])
    fits = [search.fit_screened(s) for s in screened[:3]]
    return max([0.0, *(sum(plain.chi2) - sum(h.chi2) for h in fits)])


def row_of(case: Path, truth: dict, settings: dict, robot: Path) -> dict:
    """Errors, chi-squared and gains of one person."""
    from real2sim.diagnosis.refit import JointResiduals
    from real2sim.diagnosis.search import Search
    from real2sim.study.diagnose import strap_trials

    trials = strap_trials(
        train=case / "dynamic_1",
        held_out=case / "dynamic_2",
        neutral=case / "neutral",
        limits=None,
        robot=robot,
        settings=settings,
        progress=lambda text: None,
    )
    pair, start = trials.prepare()
    search = Search(pair, settings["diagnosis"]["search"])
    plain = search.fit((), start, final=True)
    z = np.log([truth["parameters"][p.name]["value"] for p in pair.system.parameters])
    at_truth = [sum(JointResiduals(e, (), pair.system).judged(z)[0]) for e in (pair.train, pair.held_out)]
    places = trials.placed(pair)
    return {
        "error": plain.z - z,
        "truth": sum(at_truth),
        "fit": sum(plain.chi2),
        "expected": sum(search.samples),
        "gains": [gain_of(search, plain, places, name) for name in FILTERS],
    }


def main() -> None:
    """Print a row per person without a cause, and medians."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("suite", type=Path)
    parser.add_argument("--library", type=Path, default=ROOT / "workflow")
    options = parser.parse_args()
    sys.path.insert(0, str(options.library))
    from real2sim.artefacts import read_json
    from real2sim.configuration import validated

    now = validated({}, "config", Path("defaults"))
    robot, rows = options.library.parent / "resources" / "robot" / "drba.xml", []
    for sealed in sorted((options.suite / "sealed").glob("*.json")):
        for truth in read_json(sealed, ("cases",))["cases"]:
            case = options.suite / "cases" / truth["id"]
            if truth["effects"] or not (case / "diagnosis.json").exists():
                continue
            # as the suite was run, but for what this version reads the path with
            settings = read_json(case / "diagnosis.json", ("settings",))["settings"]
            settings["diagnosis"]["pelvis"] = now["diagnosis"]["pelvis"]
            row = row_of(case, truth, settings, robot)
            rows.append(row)
            gains = " ".join(f"{name} {gain:.0f}" for name, gain in zip(FILTERS, row["gains"], strict=True))
            print(
                f"{truth['id']} {1e3 * truth['noise_m']:.2f} mm: ln(fit / truth) {np.round(row['error'], 2)}, "
                f"chi-squared {row['truth']:.0f} at the truth, {row['fit']:.0f} of the fit, of {row['expected']}; "
                f"gains {gains}",
                flush=True,
            )
    size = np.abs([row["error"] for row in rows])
    print(f"{len(rows)} people; median |ln error| by parameter {np.round(np.median(size, axis=0), 3)}")
    print(
        f"RMS ln error of all {np.sqrt(np.mean(size**2)):.3f}, of the damping {np.sqrt(np.mean(size[:, 6:] ** 2)):.3f}"
    )
    better = [row["truth"] - row["fit"] for row in rows]
    print(
        f"chi-squared that the fit takes from the truth: median {np.median(better):.0f}, largest {max(better):.0f}"
    )
    largest = np.max([row["gains"] for row in rows], axis=0)
    print("largest gains: " + ", ".join(f"{n} {g:.0f}" for n, g in zip(FILTERS, largest, strict=True)))


if __name__ == "__main__":
    main()
