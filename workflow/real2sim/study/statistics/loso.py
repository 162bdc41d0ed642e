"""Leave-one-subject-out: the prior of the others, and what it costs the one left out (paper eq. 7)."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from real2sim.artefacts import needs_people, read_json, write_table
from real2sim.inference.parameters import PARAMETERS
from real2sim.recording.quality.verdict import overridden_trials
from real2sim.study.statistics.shareability import parameter_matrix, point_prior

if TYPE_CHECKING:
    from real2sim.settings import StatisticsSettings

LOSO_COLUMNS = (
    "subject",
    "status",
    "J_best",
    "J_prior",
    "overhead_J_percent",
    "rmse_best_m",
    "rmse_prior_m",
    "overhead_rmse_percent",
    "n_trials",
    "overridden",
    "phantom",
)


def leave_one_out_prior(fits: Sequence[dict[str, Any]], subject: str) -> dict[str, float]:
    """Geometric mean of each parameter over the fits of everyone but ``subject``, SI units.

    ``fits`` are fit records (`shareability.read_fits`). Raises ValueError if nobody is left.
    """
    others = [fit for fit in fits if fit["subject"] != subject]
    if not others:
        raise ValueError(f"no fits of anyone but {subject}")
    return dict(zip(PARAMETERS, point_prior(parameter_matrix(others)).tolist(), strict=True))


def overhead(with_prior: float, best: float) -> float:
    """Relative increase over the subject's own best fit (paper eq. 7); 0.05 is 5 %."""
    return (with_prior - best) / best


def _row(record: dict[str, Any]) -> dict[str, Any]:
    row: dict[str, Any] = {"subject": record["subject"], "phantom": record.get("phantom", False)}
    row["overridden"] = overridden_trials([record])
    if "overhead_J" not in record:
        return row | {"status": record["status"]}
    trials = record["trials"]
    means = {
        key: float(np.mean([t[key] for t in trials]))
        for key in ("J_best", "J_prior", "rmse_best_m", "rmse_prior_m")
    }
    percent = {f"overhead_{m}_percent": 100.0 * record[f"overhead_{m}"] for m in ("J", "rmse")}
    return row | {"status": "ok", "n_trials": len(trials)} | means | percent


def loso_table(*, loso: list[Path], settings: StatisticsSettings, out: Path) -> None:
    """Collect the leave-one-subject-out files: one row per person and, with enough people, their mean.

    ``settings`` is the config slice ``statistics``. Costs J have no unit; RMSE in metres.
    """
    records = [read_json(path, ("subject",)) for path in loso]
    rows = [_row(record) for record in records]
    rows.sort(key=lambda row: row["subject"])
    done = [row for row in rows if row["status"] == "ok"]
    mean: dict[str, Any] = {"subject": "mean", "phantom": any(row["phantom"] for row in rows)}
    mean["overridden"] = overridden_trials(records)
    if len(rows) < settings["min_subjects"]:
        mean["status"] = needs_people(settings["min_subjects"], len(rows))
    elif len(done) < len(rows):
        mean["status"] = f"only {len(done)} of {len(rows)} people have a result"
    else:
        mean["status"] = "ok"
        for key in LOSO_COLUMNS[2:8]:
            mean[key] = float(np.mean([row[key] for row in done]))
    write_table(out, LOSO_COLUMNS, [*rows, mean])
