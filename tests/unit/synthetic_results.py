"""Small result files with known statistics, for tests of what reads them."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from real2sim.geometry import AXES
from real2sim.inference.parameters import PARAMETERS

CENTRE = np.array([725, 2120, 3850, 39.2, 122, 15.2, 588, 133, 70.8, 1.26, 2.2, 7.21])


def write_fits(
    folder: Path, subjects: int, *, phantom: bool = True, seed: int = 0, restarts: int = 5
) -> list[Path]:
    """Fits of some people on two trials; even parameters vary between people, odd ones within them."""
    rng = np.random.default_rng(seed)
    between, within = np.where(np.arange(12) % 2, 0.02, 0.6), np.where(np.arange(12) % 2, 0.4, 0.1)
    paths = []
    for s in range(subjects):
        person = between * rng.normal(size=12)
        for trial in ("dynamic_1", "dynamic_2"):
            for restart in range(restarts):
                values = CENTRE * np.exp(person + within * rng.normal(size=12))
                evaluations = np.arange(11, 1201, 11)
                best = 1.2 + 0.1 * rng.random() + 8 * np.exp(-evaluations / (80 + 60 * rng.random()))
                fit = {
                    "subject": f"S{s + 1:02d}",
                    "trial": trial,
                    "restart": restart,
                    "parameters": dict(zip(PARAMETERS, values.tolist(), strict=True)),
                    "cost": {"J": best[-1], "J_position": 0.6, "J_velocity": 0.6, "rmse_position_m": 0.03},
                    "at_bound": ["k_rz"] if restart == 0 else [],
                    "history": {"evaluations": evaluations.tolist(), "best": best.tolist(), "sigma": []},
                    "stop": {},
                    "phantom": phantom,
                }
                path = folder / f"S{s + 1:02d}" / trial / f"restart-{restart}.json"
                path.parent.mkdir(parents=True, exist_ok=True)
                path.write_text(json.dumps(fit))
                paths.append(path)
    return paths


def write_loso(folder: Path, subjects: int, *, phantom: bool = True) -> list[Path]:
    """Leave-one-out files with an overhead of -1, 1, 3, ... % in J and half of it in RMSE."""
    paths = []
    for s in range(subjects):
        over = 0.02 * s - 0.01
        trial = {
            "trial": "dynamic_1",
            "J_best": 1.0,
            "J_prior": 1 + over,
            "rmse_best_m": 0.02,
            "rmse_prior_m": 0.02,
        }
        record = {"subject": f"S{s + 1:02d}", "phantom": phantom, "prior": {}, "trials": [trial, trial]}
        path = folder / f"S{s + 1:02d}.json"
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(json.dumps(record | {"overhead_J": over, "overhead_rmse": over / 2}))
        paths.append(path)
    return paths


def write_pose(path: Path, q: dict[str, np.ndarray], *, phantom: bool = True) -> Path:
    """A pose table with the given q columns on a 100 Hz clock; the axes not given stay at rest."""
    n = len(next(iter(q.values())))
    columns = {"time_s": np.arange(n) / 100} | {f"q_{a}": q.get(a, np.zeros(n)) for a in AXES}
    table = pa.table(columns).replace_schema_metadata(
        {b"real2sim": json.dumps({"phantom": phantom}).encode()}
    )
    path.parent.mkdir(parents=True, exist_ok=True)
    pq.write_table(table, path)
    return path


def write_sweep_poses(
    folder: Path,
    levels: list[int],
    selected: int,
    *,
    noise: float = 0.0,
    seed: int = 0,
    phantom: bool = True,
) -> list[Path]:
    """Rotation and translation trials: rotation has its knee at ``selected``, translation has none."""
    rng, phase = np.random.default_rng(seed), np.linspace(0, 4 * np.pi, 1201)
    paths = []
    for level in levels:
        below = max(selected - level, 0)
        left, right = np.radians(8 + 2.5 * below + 0.2 * (selected - level) + noise * rng.normal(size=2))
        swing = np.sin(phase)
        rz = np.where(swing > 0, left, right) * swing
        rotation = folder / f"rotation_T{level:02d}" / "pose.parquet"
        paths.append(write_pose(rotation, {"rz": rz}, phantom=phantom))
        reach = (40 - 1.5 * level + 2 * noise * rng.normal(size=2)) / 1000
        shift = {"tx": reach[0] * swing, "ty": 1.5 * reach[1] * swing}
        translation = folder / f"translation_T{level:02d}" / "pose.parquet"
        paths.append(write_pose(translation, shift, phantom=phantom))
    return paths


def write_subject_yaml(path: Path, *, loosest: int, tightest: int, selected: int) -> Path:
    """A subject file of somebody in the calibration cohort, with the tightness levels given."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(
        f"id: {path.parent.name}\ncohort: calibration\nsex: female\nage_years: 30\nmass_kg: 70\nheight_m: 1.7\n"
        f"waist_m: 0.8\ntightness: {{loosest_cm: {loosest}, tightest_cm: {tightest}, "
        f"safe_comfortable_cm: {selected}}}\n"
    )
    return path
