"""Tables and truth of a simulated case, and what a measurement does to a signal."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from scipy.interpolate import make_interp_spline
from scipy.signal import butter, sosfilt, sosfilt_zi

TRIALS = ("quiet", "train", "held_out")
SEALED = "sealed"


@dataclass(frozen=True)
class Size:
    """Typical size of an injected effect, its unit, and the parameter that it is."""

    parameter: str
    typical: float
    unit: str


@dataclass(frozen=True)
class OutputChain:
    """Changes of a measured signal between the machine and the table.

    ``offset`` [s]: the signal is late; ``drift``: its clock shows (1 + drift) t at time t; ``cutoff`` [Hz]: it went
    through a causal first-order low-pass. 0 switches each of them off.
    """

    offset: float = 0.0
    drift: float = 0.0
    cutoff: float = 0.0

    @classmethod
    def of(cls, effect: str | None, size: float) -> OutputChain:
        """Chain of an effect; the identity where the effect is none of the output chain."""
        names = {"sync_offset": "offset", "clock_drift": "drift", "filter_lag": "cutoff"}
        return cls(**{names[effect]: size}) if effect in names else cls()

    def apply(self, time_s: np.ndarray, values: np.ndarray, out_s: np.ndarray) -> np.ndarray:
        """Return the signal (m, ...) at the samples ``out_s`` (m,) [s] from its true values (n, ...) at ``time_s``.

        ``time_s`` is a uniform grid, much finer than the content of the signal; the signal is constant before it.
        """
        if self.cutoff:
            rate = (len(time_s) - 1) / (time_s[-1] - time_s[0])
            sos = butter(1, self.cutoff, fs=rate, output="sos")
            start = np.multiply.outer(sosfilt_zi(sos), values[0])
            values = sosfilt(sos, values, axis=0, zi=start)[0]
        source_s = np.clip((1 + self.drift) * out_s - self.offset, time_s[0], time_s[-1])
        if np.array_equal(source_s, time_s):
            return values
        delayed: np.ndarray = make_interp_spline(time_s, values, k=3)(source_s)
        return delayed


def write_case(out: Path, tables: Mapping[str, Mapping[str, np.ndarray]], truth: Mapping[str, Any]) -> Path:
    """Write one Parquet table per recording and the truth in a folder of its own; return ``out``.

    ``tables`` maps the names in `TRIALS` to columns (n,) of one length.
    """
    out.mkdir(parents=True, exist_ok=True)
    for name in TRIALS:
        pq.write_table(pa.table(dict(tables[name])), out / f"{name}.parquet")
    sealed = out / SEALED
    sealed.mkdir(exist_ok=True)
    text = json.dumps(dict(truth), indent=1, sort_keys=True)
    (sealed / "truth.json").write_text(text + "\n", encoding="utf-8")
    return out


def check_effect(effect: str | None, effects: Mapping[str, Size]) -> None:
    """Raise ValueError where a generator cannot inject an effect."""
    if effect is not None and effect not in effects:
        raise ValueError(f"effect {effect}: this system has {', '.join(effects)}")


def describe_effect(effect: str | None, size: float, effects: Mapping[str, Size]) -> dict[str, Any]:
    """Return the part of a truth that says which effect was injected."""
    if effect is None:
        return {"effect": None, "parameters": {}}
    entry = effects[effect]
    return {"effect": effect, "parameters": {entry.parameter: size}, "unit": entry.unit}


def raise_gradually(time_s: np.ndarray, begin_s: float, rise_s: float) -> np.ndarray:
    """Return a factor (n,), 0 before ``begin_s`` and 1 after ``rise_s`` more, with three continuous derivatives."""
    x = np.clip((time_s - begin_s) / rise_s, 0, 1)
    return x**4 * (35 - 84 * x + 70 * x**2 - 20 * x**3)
