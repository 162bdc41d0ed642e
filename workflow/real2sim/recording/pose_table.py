"""Interface coordinates of a trial, as its pose table holds them."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq

from real2sim.errors import InputError


def read_pose(path: Path) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """Read columns (n,) ``time_s`` [s] and ``q_*`` [m, rad] of a pose table, and its metadata of the trial.

    Raises InputError where interface coordinates are missing or wholly masked.
    """
    table = pq.read_table(path)
    metadata = json.loads((table.schema.metadata or {}).get(b"real2sim", b"{}"))
    names = [n for n in table.column_names if n == "time_s" or n.startswith("q_")]
    columns = {n: table[n].to_numpy(zero_copy_only=False).astype(float) for n in names}
    for name in ("time_s", "q_tx", "q_ty", "q_rz"):
        if name not in columns or not np.isfinite(columns[name]).any():
            raise InputError(
                path,
                f"column {name}",
                "no finite value",
                "pelvis and interface markers in this trial",
                "Export IF_L and IF_R with the trial, or name it under exclude in subject.yaml.",
            )
    return columns, metadata
