"""Reference gait of a person as a stage of the workflow."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from real2sim.artefacts import write_json
from real2sim.provenance import fingerprint, provenance
from real2sim.study.twin.gait import Walk, make_reference, measured_cycle, read_walk
from real2sim.study.twin.human import Body, body_of
from real2sim.study.twin.policy import save_reference

if TYPE_CHECKING:
    from real2sim.settings import TwinSettings

PACKAGES = ["mujoco", "numpy", "scipy"]


def read_walks(folders: list[Path], who: Body) -> list[Walk]:
    """Walks in the folders of trials."""
    return [read_walk(folder, who) for folder in folders]


def twin_reference(
    *, person: Path, walks: list[Path], settings: TwinSettings, out: Path, report: Path
) -> None:
    """Reference gait of a person from the folders of their walk_normal trials; what had to be changed, in degrees.

    ``settings`` is the slice ``twin``; ``out`` the gait (.npz), ``report`` a JSON.
    """
    who, phantom = body_of(person)
    trials = read_walks(walks, who)
    measured, asymmetry = measured_cycle(trials)
    stride = float(np.mean([w.stride_s for w in trials]))
    speed = float(np.mean([w.speed for w in trials]))
    reference = make_reference(
        measured,
        stride,
        speed,
        who,
        settings["human"],
        settings["reference"],
        lambda text: print(text, file=sys.stderr, flush=True),
    )
    save_reference(out, reference)
    tables = [folder / f"{t}.parquet" for folder in walks for t in ("joints", "pose", "markers")]
    write_json(
        report,
        {
            "phantom": phantom or any(w.phantom for w in trials),
            "trials": [folder.name for folder in walks],
            "strikes_from": sorted({w.strikes_from for w in trials}),
            "strides": {side: sum(len(w.strikes[side]) - 1 for w in trials) for side in "rl"},
            "asymmetry_rms_deg": asymmetry,
            **reference.report,
            "provenance": provenance([person, *tables], PACKAGES, fingerprint(__name__)),
        },
    )
