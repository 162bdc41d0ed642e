"""The measured machines beside `mujoco.sysid`: error on the held-out record and time, in one table.

    python benchmarks/machines_sysid.py FOLDER [--environment DIR] [--out results/benchmarks] [--machine NAME]

Same MJCF, records, parameters, bounds and start for both. `mujoco.sysid` fits a model that it is given: once the plain
one, and once with the published cause told by hand (`frictionloss` of the joint, or a cubic term of its stiffness).
`real2sim.diagnose` gets the plain one and finds the cause. Its times are of one process; they include what
`mujoco.sysid` does not do: which cause, how sure, intervals, a check on the held-out record. Needs the package
registry, unless DIR is an environment with mujoco[sysid].
"""

from __future__ import annotations

import argparse
import importlib
import json
import os
import pickle
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np
import pandas as pd
import real2sim as r2s
from engine import sysid_environment
from real2sim.configuration import validated
from real2sim.diagnosis.answer import simulate
from real2sim.diagnosis.described_trial import DescribedTrial
from real2sim.system.description import FORCE

sys.path.insert(0, str(Path(__file__).parents[1] / "examples" / "machines"))
machine = importlib.import_module("machine")

# Question of each machine, and the published cause as a field of MJCF: its name, bounds [SI] and whether it is searched
# as a logarithm
QUESTIONS: dict[str, tuple[str, dict[str, Any]]] = {
    "emps": (
        "friction",
        {"name": "friction", "sets": "frictionloss", "bounds": (0.1, 1000.0), "log": True},
    ),
    "silverbox": ("large", {"name": "cubic", "sets": "cubic", "bounds": (1e6, 1e12), "log": True}),
    "mr_damper": (
        "voltage_0",
        {"name": "friction", "sets": "frictionloss", "bounds": (0.1, 1000.0), "log": True},
    ),
}


def record_of(one: Any, name: str, settings: dict[str, Any]) -> dict[str, Any]:
    """Return a record as numbers: what drives the joint, where it starts and what was measured."""
    trial = DescribedTrial(one.system, one.recording(name), None, settings, 1)
    setup, recording = trial.setup(1), one.recording(name)
    joint, column = next(iter(one.system.drive.columns.items()))
    out = {
        "time_s": recording.time_s,
        "step_s": setup.timestep,
        "stride": setup.stride,
        "start": (setup.start[joint], setup.start_rate[joint]),
        "output": recording.columns[one.system.outputs[0].column],
        "force": setup.commands[:, 0] if one.system.drive.by == FORCE else None,
    }
    if one.system.drive.by != FORCE:
        path = trial._smooth_path(recording.stack((column,)))
        for key, order in (("position", 0), ("rate", 1), ("acceleration", 2)):
            out[key] = path(recording.time_s, order)[:, 0]
    return out


def by_sysid(
    python: Path, one: Any, question: str, extra: list[dict[str, Any]], settings: dict[str, Any]
) -> dict:
    """Fit the plain model, or that with the ``extra`` parameters, by `mujoco.sysid`."""
    asked = one.content["questions"][question]
    joint = next(iter(one.system.drive.columns))
    task = {
        "name": one.name,
        "model": str(one.system.model),
        "joint": joint,
        "parameters": [
            {"name": p.name, "sets": p.sets, "of": p.of, "bounds": (p.lower, p.upper), "log": p.log}
            for p in one.system.parameters
        ]
        + extra,
        "records": [record_of(one, asked[part], settings) for part in ("train", "held_out")],
    }
    with tempfile.TemporaryDirectory() as folder:
        source, out = Path(folder) / "task.pickle", Path(folder) / "report.json"
        source.write_bytes(pickle.dumps(task))
        script = Path(__file__).with_name("machines_sysid_search.py")
        environment = {k: v for k, v in os.environ.items() if k != "PYTHONPATH"} | {"OMP_NUM_THREADS": "1"}
        command = [str(python), str(script), str(source), str(out)]
        # its optimiser tells every iteration
        subprocess.run(command, env=environment, stdout=subprocess.DEVNULL, check=True)
        return dict(json.loads(out.read_text()))


def held_out_rms(answer: r2s.Diagnosis) -> tuple[float, float]:
    """RMS [unit of the output] on the held-out record that the plain fit and the answer leave."""
    pair = answer.answer.found.pair
    evidence = pair.train if pair.exchanged else pair.held_out
    seen = evidence.measured.observed
    both = (
        simulate(evidence, pair, h) for h in (answer.answer.found.attribution.plain, answer.answer.fitted)
    )
    plain, best = (float(np.sqrt(np.nanmean((path - seen) ** 2))) for path in both)
    return plain, best


def rows(name: str, data: Path, python: Path) -> Iterator[dict[str, Any]]:
    """Yield the rows of one machine: who fitted which model, what is left of the held-out record, how long it took."""
    question, cause = QUESTIONS[name]
    one = machine.Machine.load(name, data)
    default = validated({}, "config", Path("settings"))["diagnosis"]["described"]
    unit = one.system.outputs[0].column.rsplit("_", 1)[-1]
    scale, unit = (1e3, "mm") if unit == "m" else (1.0, unit)
    for model, extra in (("plain", []), ("cause told by hand", [cause])):
        found = by_sysid(python, one, question, extra, default)
        yield {
            "machine": name,
            "by": "mujoco.sysid",
            "model": model,
            "held_out_rms": found["held_out_rms"] * scale,
            "unit": unit,
            "seconds": found["seconds"],
            "values": " ".join(f"{k}={v:.5g}" for k, v in found["values"].items()),
        }
    began = time.perf_counter()
    fit = r2s.identify(one.trusting(question), one.recording(one.content["questions"][question]["train"]))
    seconds = time.perf_counter() - began
    began = time.perf_counter()
    answer = one.ask(question)
    asked_s = time.perf_counter() - began
    plain, best = held_out_rms(answer)
    told = {k: v["with_effect"] for k, v in answer.answer.parameters.items()}
    for cause_found in answer.answer.causes:
        if cause_found.effect in answer.answer.verdict_set:
            told |= {k: v["value"] for k, v in cause_found.parameters.items()}
    for by, model, rms, duration, values in (
        ("real2sim.identify", "plain", plain, seconds, fit.values),
        ("real2sim.diagnose", "found: " + " + ".join(answer.answer.verdict_set), best, asked_s, told),
    ):
        yield {
            "machine": name,
            "by": by,
            "model": model,
            "held_out_rms": rms * scale,
            "unit": unit,
            "seconds": duration,
            "values": " ".join(f"{k}={v:.5g}" for k, v in values.items()),
        }


def main() -> None:
    """Fit all machines both ways, print and write the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("data", type=Path, help="folder with the published files, anywhere below it")
    parser.add_argument("--environment", type=Path, help="keep the environment of mujoco.sysid here")
    parser.add_argument("--out", type=Path, default=Path("results/benchmarks"))
    parser.add_argument("--machine", choices=QUESTIONS, action="append", help="only this one")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        python = sysid_environment(options.environment or Path(folder) / "environment")
        if isinstance(python, str):
            sys.exit(f"mujoco.sysid is not to be had: {python}")
        table = pd.DataFrame(
            [
                row
                for name in options.machine or QUESTIONS
                for row in rows(name, options.data, python.absolute())
            ]
        )
    options.out.mkdir(parents=True, exist_ok=True)
    table.to_csv(options.out / "machines_sysid.csv", index=False)
    print(table.to_string(index=False, float_format=lambda x: f"{x:.4g}"))


if __name__ == "__main__":
    main()
