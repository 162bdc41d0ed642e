"""The diagnosis on measured records with something withheld: nulls, known effects injected, causes left out.

    python benchmarks/machines.py nulls|injected|left_out FOLDER [--out results/benchmarks] [--jobs 2] [--cases N]

`nulls`: windows of the Silverbox up to 20 mV against each other, where nothing but a linear oscillator is to be seen.
`injected`: the same windows with a known effect in what was measured, at three sizes. `left_out`: each question of
examples/machines without the names of its published cause. Prints a row per case and the share that is right.
"""

from __future__ import annotations

import argparse
import importlib
import itertools
import sys
import tempfile
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pandas as pd
import real2sim as r2s
from real2sim import signals

sys.path.insert(0, str(Path(__file__).parents[1] / "examples" / "machines"))
machine = importlib.import_module("machine")

# Windows of the Silverbox: start [samples] in arrow_begins and arrow_again, whose output stays below 20 mV
WINDOW, STARTS = 1000, (0, 250, 500, 750, 1000)
RECORDS = ("arrow_begins", "arrow_again")
OUTPUT, INPUT = "output_m", "input_N"
# Derivatives of the output are taken below a band [Hz]; rate at which injected friction has three quarters of its force
BAND_HZ, RUBBING_RATE = 200.0, 1e-4
# Names that are the published cause in another form
KIN = {
    "emps": ("coulomb", "lugre", "hysteresis"),
    "mr_damper": ("coulomb", "lugre", "hysteresis", "relaxation"),
    "silverbox": ("stiffening", "asymmetric_stiffness", "joint_limit", "slack", "one_sided"),
}


def late(table: pd.DataFrame, seconds: float) -> pd.DataFrame:
    """Return the table with an output that comes later."""
    return _moved(table, table["time_s"] - seconds)


def drifting(table: pd.DataFrame, ppm: float) -> pd.DataFrame:
    """Return the table with an output whose clock runs faster by parts per million."""
    return _moved(table, table["time_s"] * (1 + 1e-6 * ppm))


def jumping(table: pd.DataFrame, share: float) -> pd.DataFrame:
    """Return the table with a share of the output's samples that jump by five of its SD."""
    out, rng = table.copy(), np.random.default_rng(0)
    hit = rng.choice(len(out), max(1, round(share * len(out))), replace=False)
    values = out[OUTPUT].to_numpy().copy()
    values[hit] += rng.choice([-5.0, 5.0], len(hit)) * values.std()
    return out.assign(**{OUTPUT: values})


def filtered(table: pd.DataFrame, cutoff_hz: float) -> pd.DataFrame:
    """Return the table with an output behind a low-pass of first order."""
    values = table[OUTPUT].to_numpy()
    step = float(table["time_s"][1] - table["time_s"][0])
    frequency = np.fft.rfftfreq(4 * len(values), step)
    spectrum = np.fft.rfft(values - values.mean(), 4 * len(values)) / (1 + 1j * frequency / cutoff_hz)
    return table.assign(**{OUTPUT: np.fft.irfft(spectrum)[: len(values)] + values.mean()})


def wandering(table: pd.DataFrame, share: float) -> pd.DataFrame:
    """Return the table with an output that drifts, to a share of its largest value at the end."""
    return table.assign(**{OUTPUT: table[OUTPUT] + _per_second(table, share) * table["time_s"]})


def _per_second(table: pd.DataFrame, share: float) -> float:
    return share * float(np.abs(table[OUTPUT] - table[OUTPUT].mean()).max() / table["time_s"].iloc[-1])


def rubbing(table: pd.DataFrame, newton: float) -> pd.DataFrame:
    """Return the table of a machine that has dry friction more: the same motion takes so much more force [N]."""
    return table.assign(**{INPUT: table[INPUT] + newton * np.tanh(_derivative(table, 1) / RUBBING_RATE)})


def heavier(table: pd.DataFrame, kilogram: float) -> pd.DataFrame:
    """Return the table of a machine that is heavier: the same motion takes so much more force [kg]."""
    return table.assign(**{INPUT: table[INPUT] + kilogram * _derivative(table, 2)})


def _derivative(table: pd.DataFrame, order: int) -> np.ndarray:
    """Return a derivative (n,) of the output, below the band of the machine."""
    values, step = table[OUTPUT].to_numpy(), float(table["time_s"][1] - table["time_s"][0])
    smooth = signals.lowpass(values[:, None], 1 / step, BAND_HZ, 4)[:, 0]
    fine = signals.upsampled(smooth[:, None], 16)[:, 0]
    for _ in range(order):
        fine = np.gradient(fine, step / 16)
    return fine[::16]


def _moved(table: pd.DataFrame, at: pd.Series) -> pd.DataFrame:
    time_s, values = table["time_s"].to_numpy(), table[OUTPUT].to_numpy()
    fine = signals.upsampled(values[:, None], 16)[:, 0]
    return table.assign(**{OUTPUT: np.interp(at, np.linspace(time_s[0], time_s[-1], len(fine)), fine)})


@dataclass(frozen=True)
class Effect:
    """A known effect in what was measured: names that are right, how it is injected, and three sizes.

    ``parameter`` is the constant of the cause that has the size, times ``unit``; empty where none has.
    ``known_mass``: the description has a mass that is known, not fitted, or a heavier machine would show no gap.
    """

    names: tuple[str, ...]
    inject: Callable[[pd.DataFrame, float], pd.DataFrame]
    sizes: tuple[float, float, float]
    parameter: str = ""
    unit: float = 1.0
    known_mass: bool = False


EFFECTS = {
    "delay": Effect(("sync_offset",), late, (5e-4, 2e-3, 5e-3), "offset"),
    "clock_drift": Effect(("clock_drift",), drifting, (500.0, 2000.0, 5000.0), "drift", 1e-6),
    "outliers": Effect(("outliers",), jumping, (0.003, 0.01, 0.03)),
    "filter": Effect(("filter_lag",), filtered, (400.0, 150.0, 60.0), "cutoff"),
    # the input's RMS is 1.4 mN, the mass 5.3 g, the drift a share of the largest output (its slow noise: 0.1)
    "friction": Effect(("coulomb", "lugre", "hysteresis"), rubbing, (1e-4, 3e-4, 6e-4), "force"),
    "mass": Effect(("added_mass",), heavier, (5e-5, 2.5e-4, 1e-3), "mass", known_mass=True),
    "drift": Effect(("migration", "creep", "marker_drift"), wandering, (0.1, 0.3, 1.0)),
}


def windows(data: Path) -> dict[str, pd.DataFrame]:
    """Return the windows of the Silverbox by name."""
    box = machine.Machine.load("silverbox", data)
    out = {}
    for record, start in itertools.product(RECORDS, STARTS):
        table = box.table(record).iloc[start : start + WINDOW].reset_index(drop=True)
        out[f"{record}_{start}"] = table.assign(time_s=table["time_s"] - table["time_s"][0])
    return out


def pairs(names: list[str]) -> list[tuple[str, str]]:
    """Return ordered pairs of windows that do not overlap."""
    out = []
    for a, b in itertools.permutations(names, 2):
        (record, start), (other, again) = (name.rsplit("_", 1) for name in (a, b))
        if record != other or abs(int(start) - int(again)) >= WINDOW:
            out.append((a, b))
    return out


def on_silverbox(data: Path, pair: tuple[str, str], effect: str, size: float) -> dict[str, object]:
    """Diagnose a pair of windows, with an effect in both where one is named."""
    box, table = machine.Machine.load("silverbox", data), windows(data)
    system, recordings = box.trusting("small"), []
    if effect and EFFECTS[effect].known_mass:
        system = weighed(system, box)
    for name in pair:
        told = table[name] if not effect else EFFECTS[effect].inject(table[name], size)
        recordings.append(r2s.Recording.from_table(system, told, name))
    answer = r2s.diagnose(system, train=recordings[0], held_out=recordings[1], progress=lambda text: None)
    right = ("none",) if not effect else EFFECTS[effect].names
    return {
        "case": " ".join((*pair, effect, f"{size:g}" if effect else "")),
        "answer": " + ".join(answer.answer.verdict_set),
        "probability": round(answer.probabilities[answer.verdict], 3),
        "right": any(name in right for name in answer.answer.verdict_set),
        "size_off": size_off(answer, EFFECTS[effect], size) if effect else None,
    }


def weighed(system: r2s.System, box: Any) -> r2s.System:
    """Return the description of a machine whose mass is known: what a fit of the whole undisturbed record gives."""
    mass = r2s.identify(system, box.recording("arrow_begins")).values["mass"]
    # a file for good: processes that end would take a temporary one along
    model = Path(tempfile.gettempdir()) / f"silverbox_{mass:.9f}.xml"
    spec = mujoco.MjSpec.from_file(str(system.model))
    spec.body(system.body).mass = mass
    spec.compile()
    model.write_text(spec.to_xml(), encoding="utf-8")
    known = tuple(p for p in system.parameters if p.name != "mass")
    return replace(system.with_model(model), parameters=known)


def size_off(answer: r2s.Diagnosis, effect: Effect, size: float) -> float | None:
    """Return how far the size of the injected effect is off, as a share; None where its cause is not in the answer."""
    for cause in answer.answer.causes:
        for name, value in cause.parameters.items():
            if cause.effect in effect.names and name.split(" ")[0].startswith(effect.parameter or "-"):
                return round(value["value"] / (size * effect.unit) - 1, 3)
    return None


def without_its_name(data: Path, name: str, question: str) -> dict[str, object]:
    """Diagnose a question of a machine without the names of its published cause."""
    left_out = [e.name for e in r2s.catalogue() if e.name in KIN[name]]
    one = machine.Machine.load(name, data)
    answer = one.ask(question, {"diagnosis": {"left_out": sorted(set(left_out))}})
    law = answer.free_form or {}
    return {
        "case": f"{name} {question}",
        "answer": " + ".join(answer.answer.verdict_set),
        "probability": round(answer.probabilities[answer.verdict], 3),
        "right": answer.verdict == "unknown",
        "law": f"{law.get('stage')}, {law.get('kind')} of {', '.join(law.get('depends_on', []))}",
        "closed": law.get("chi2_closed"),
    }


def jobs_of(options: argparse.Namespace) -> list[tuple[Callable[..., dict[str, object]], tuple[object, ...]]]:
    """Return what is to be run: function and arguments of each case."""
    if options.what == "left_out":
        return [
            (without_its_name, (options.data, name, question))
            for name, question in (("emps", "friction"), ("silverbox", "large"), ("mr_damper", "voltage_0"))
        ]
    all_pairs = pairs(list(windows(options.data)))
    if options.what == "nulls":
        return [(on_silverbox, (options.data, pair, "", 0.0)) for pair in all_pairs]
    # a few pairs for each effect and size
    every = max(1, len(all_pairs) // 3)
    return [
        (on_silverbox, (options.data, pair, effect, size))
        for effect, one in EFFECTS.items()
        if not options.effect or effect in options.effect
        for size in one.sizes
        for pair in all_pairs[::every][:3]
    ]


def main() -> None:
    """Run the cases, print and write their rows."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("what", choices=("nulls", "injected", "left_out"))
    parser.add_argument("data", type=Path)
    parser.add_argument("--out", type=Path, default=Path("results/benchmarks"))
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--cases", type=int, help="only the first so many")
    parser.add_argument("--effect", choices=EFFECTS, action="append", help="only this one injected")
    options = parser.parse_args()
    rows = []
    with ProcessPoolExecutor(options.jobs) as pool:
        futures = [pool.submit(function, *given) for function, given in jobs_of(options)[: options.cases]]
        for i, future in enumerate(futures):
            rows.append(future.result())
            print(f"{i + 1}/{len(futures)}", rows[-1], flush=True)
    table = pd.DataFrame(rows)
    options.out.mkdir(parents=True, exist_ok=True)
    table.to_csv(options.out / f"machines_{options.what}.csv", index=False)
    print(f"right: {int(table['right'].sum())} of {len(table)} ({100 * table['right'].mean():.1f} %)")
    if options.what == "injected":
        sized = table["size_off"].dropna()
        print(
            f"size within 20 %: {int((sized.abs() <= 0.2).sum())} of {len(sized)} that are named and have one"
        )


if __name__ == "__main__":
    main()
