"""Are the described systems diagnosed? Records with and without an effect, written by physics that shares no code.

    python benchmarks/systems.py --raw raw --rows systems.jsonl [--system cuff drba emps]

For each system two records without an effect and at least six with one effect each, at the interface, in the machine
and in the recording; the robot's are half as long and searched with fewer refits. Printed per case: the true effect,
what is likeliest with its probability, and chi-squared over its expectation on the held-out record, without the effect
and with it.

Records that are there are kept, and so are finished rows: a run goes on where the last one stopped.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

for _threads in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
    os.environ.setdefault(_threads, "1")

ROOT = Path(__file__).parents[1]
sys.path.insert(0, str(ROOT / "workflow"))

import real2sim
from real2sim.system.description import shipped_system
from real2sim.verification.systems import cuff, drba, one_axis

SIMULATE: dict[str, Callable[..., Any]] = {
    "cuff": cuff.simulate,
    "drba": drba.simulate,
    "emps": one_axis.simulate_emps,
}
# Effect (None: without), size in the unit of the generator, seed, interface coordinate where the effect has one
CASES: dict[str, tuple[tuple[str | None, float, int, str | None], ...]] = {
    "cuff": (
        (None, 0.0, 301, None),
        (None, 0.0, 302, None),
        ("slack", 0.004, 303, "tz"),
        ("coulomb", 8.0, 304, "tx"),
        ("stiffening", 2e8, 305, "tx"),
        ("quadratic_damping", 1e4, 306, "tx"),
        ("machine_impedance", 0.4, 337, None),
        ("sync_offset", 0.010, 308, None),
        ("clock_drift", 2e-3, 309, None),
    ),
    "emps": (
        (None, 0.0, 311, None),
        (None, 0.0, 312, None),
        ("coulomb", 20.4, 313, None),
        ("coulomb", 5.0, 314, None),
        ("quadratic_damping", 600.0, 315, None),
        ("sync_offset", 0.010, 316, None),
        ("clock_drift", 2e-3, 317, None),
        ("filter_lag", 8.0, 318, None),
    ),
    "drba": (
        (None, 0.0, 521, None),
        (None, 0.0, 522, None),
        ("slack", 0.006, 323, "ty"),
        ("coulomb", 8.0, 324, "tx"),
        ("stiffening", 3e6, 325, "tx"),
        ("added_mass", 4.0, 326, None),
        ("machine_impedance", 0.8, 327, None),
        ("sync_offset", 0.010, 328, None),
    ),
}


# Length of a record [s], and search settings other than the default: a replay of the robot's closed loop in steps of
# 1 ms takes five times as long as one of the cuff
DURATION_S = {"cuff": 12.0, "emps": 12.0, "drba": 6.0}
SEARCH: dict[str, dict[str, int]] = {
    "drba": {"refits": 8, "refits_close": 1, "pair_refits": 1, "pair_screens": 0, "most_effects": 2}
}
# What the catalogue calls an effect of the generators that has another name there
NAMES = {"machine_impedance": "base_compliance"}


def run_case(
    name: str, effect: str | None, size: float, seed: int, axis: str | None, raw: Path
) -> dict[str, Any]:
    """Write the records of a case where they are missing, diagnose them; return verdict, probabilities, gap."""
    folder = raw / f"{name}-{effect}-{seed}"
    if not (folder / "held_out.parquet").exists():
        options = {"axis": axis} if axis else {}
        SIMULATE[name](effect, size, seed, folder, duration_s=DURATION_S[name], **options)
    system = shipped_system(name)
    train, held_out, quiet = (
        real2sim.Recording.read(system, folder / f"{record}.parquet")
        for record in ("train", "held_out", "quiet")
    )
    begun = time.process_time()
    settings = {"diagnosis": {"search": SEARCH.get(name, {})}}
    found = real2sim.diagnose(system, train=train, held_out=held_out, quiet=quiet, settings=settings)
    gap = found.answer.gap
    return {
        "verdict": found.answer.verdict_set or [found.verdict],
        "group": list(found.answer.ambiguity_group),
        "probabilities": {k: p for k, p in found.probabilities.items() if p > 0.01},
        "parameters": [cause.parameters for cause in found.answer.causes],
        "ratio_plain": gap["chi2_plain"][1] / gap["chi2_expected"][1],
        "ratio_best": gap["chi2_best"][1] / gap["chi2_expected"][1],
        "cpu_s": time.process_time() - begun,
    }


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--raw", type=Path, required=True, help="folder of the records, written if missing")
    parser.add_argument("--rows", type=Path, required=True, help="file of finished rows")
    parser.add_argument("--system", nargs="+", choices=tuple(CASES), default=tuple(CASES))
    options = parser.parse_args()
    lines = options.rows.read_text().splitlines() if options.rows.exists() else []
    done = {tuple(row["key"]): row for row in map(json.loads, lines)}
    right = among = total = 0
    print(
        "system  true effect          likeliest (probability)              chi-squared / expectation, plain and best"
    )
    for name in options.system:
        for effect, size, seed, axis in CASES[name]:
            key = (name, effect, size, seed, axis)
            if key not in done:
                done[key] = {"key": key} | run_case(name, effect, size, seed, axis, options.raw)
                with options.rows.open("a") as file:
                    file.write(json.dumps(done[key]) + "\n")
            row, true = done[key], NAMES.get(effect or "none", effect or "none")
            total, right = total + 1, right + (true in row["verdict"])
            among += true in (*row["verdict"], *row["group"])
            sure = sorted(row["probabilities"].items(), key=lambda item: -item[1])[:2]
            shown = ", ".join(f"{name} {p:.3f}" for name, p in sure if p > 0.05)
            print(
                f"{name:7s} {true:20s} {shown:42s} {row['ratio_plain']:12.2f} {row['ratio_best']:10.2f}"
                f"   {row['cpu_s']:6.0f} s",
                flush=True,
            )
    print(f"the true effect is the verdict in {right} of {total} cases, in its group in {among}")


if __name__ == "__main__":
    main()
