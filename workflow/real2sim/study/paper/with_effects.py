"""Table I twice: the parameters of the strap with the plain model, and with the diagnosed causes in it.

What of the paper's Table I survives once the gap of each person is explained? Both columns come from the diagnoses: one
value per person and parameter, fitted to the same trial, so that they differ by the causes alone.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from real2sim.artefacts import number, read_json, read_table, write_table
from real2sim.diagnosis.decide import NONE, UNKNOWN
from real2sim.files import write_text
from real2sim.inference.parameters import PARAMETERS, unit
from real2sim.study.paper.latex import latex_table

_MODELS = {"plain": "base", "with_effects": "with_effect"}
COLUMNS = (
    "parameter",
    "unit",
    "n_subjects",
    "n_with_a_cause",
    *(f"{what}_{model}" for model in _MODELS for what in ("prior", "spread_low", "spread_high")),
    "change_percent",
    "published_prior",
    "published_interval_low",
    "published_interval_high",
    "phantom",
)
# Quantile of the normal law that holds the central 95 %
_CENTRAL = 1.96


def prior_rows(
    diagnoses: Sequence[Mapping[str, Any]], published: Mapping[str, Mapping[str, str]]
) -> list[dict[str, Any]]:
    """Return a row per parameter: geometric mean of the people and central 95 % of them, with each model.

    The spread is that of a log-normal law through the people's values; NaN of fewer than two people. ``diagnoses`` are
    contents of diagnosis.json, ``published`` rows of resources/published/table1_priors.csv by parameter.
    """
    caused = sum(d["verdict"] not in (NONE, UNKNOWN) for d in diagnoses)
    out = []
    for name in PARAMETERS:
        row: dict[str, Any] = {"parameter": name, "unit": unit(name), "n_subjects": len(diagnoses)}
        row["n_with_a_cause"] = caused
        for model, key in _MODELS.items():
            ln = np.log([d["parameters"][name][key] for d in diagnoses])
            middle, sd = float(ln.mean()), float(ln.std(ddof=1)) if len(ln) > 1 else math.nan
            row[f"prior_{model}"] = math.exp(middle)
            row[f"spread_low_{model}"] = math.exp(middle - _CENTRAL * sd)
            row[f"spread_high_{model}"] = math.exp(middle + _CENTRAL * sd)
        row["change_percent"] = 100 * (row["prior_with_effects"] / row["prior_plain"] - 1)
        theirs = published[name]
        row["published_prior"] = number(theirs["prior"])
        for end in ("low", "high"):
            row[f"published_interval_{end}"] = number(theirs[f"interval_{end}"])
        row["phantom"] = any(d["phantom"] for d in diagnoses)
        out.append(row)
    return out


def with_effects(*, diagnoses: list[Path], published: Path, out: list[Path]) -> None:
    """Write Table I with the plain model and with the diagnosed causes.

    Parameters
    ----------
    diagnoses
        diagnosis.json of the calibration people.
    published
        table1_priors.csv of resources/published.
    out
        The table, .csv and .tex.
    """
    theirs = {row["parameter"]: row for row in read_table(published, ("parameter", "prior"))}
    rows = prior_rows([read_json(path) for path in diagnoses], theirs)
    files = {path.suffix: path for path in out}
    write_table(files[".csv"], COLUMNS, rows)
    write_text(files[".tex"], _tex(rows))


def _tex(rows: Sequence[dict[str, Any]]) -> str:
    printed = []
    for row in rows:
        cells = [row["parameter"], row["unit"]]
        for model in _MODELS:
            cells += [
                _short(row[f"prior_{model}"]),
                _range(row, f"spread_low_{model}", f"spread_high_{model}"),
            ]
        cells += [f"{row['change_percent']:+.0f}", _short(row["published_prior"])]
        cells.append(_range(row, "published_interval_low", "published_interval_high"))
        printed.append(cells)
    first = rows[0]
    return latex_table(
        [
            "Parameter",
            "Unit",
            "Plain",
            "Spread",
            "With causes",
            "Spread",
            "Change, %",
            "Published",
            "Interval",
        ],
        printed,
        caption=(
            f"Parameters of {first['n_subjects']} people (geometric mean, central 95 %) with the plain model and with "
            f"the diagnosed causes in it, of {first['n_with_a_cause']} of them, beside the published ones (Table I)."
        ),
        label="tab:priors-with-effects",
        columns="llrlrlrrl",
        phantom=bool(first["phantom"]),
    )


def _short(value: float) -> str:
    """Three digits, without an exponent."""
    if not math.isfinite(value):
        return "\N{EN DASH}"
    text = f"{value:.3g}"
    return f"{float(text):.0f}" if "e+" in text else text


def _range(row: Mapping[str, Any], low: str, high: str) -> str:
    return f"[{_short(row[low])}, {_short(row[high])}]"
