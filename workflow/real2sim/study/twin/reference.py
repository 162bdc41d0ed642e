"""Reference gait of a person as a stage of the workflow."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from real2sim.artefacts import write_json
from real2sim.provenance import fingerprint, provenance
from real2sim.study.twin.gait import (
    Walk,
    make_reference,
    measured_cycle,
    read_walk,
    whole_strides,
    with_speeds,
)
from real2sim.study.twin.human import Body, body_of
from real2sim.study.twin.policy import save_reference

if TYPE_CHECKING:
    from real2sim.settings import TwinReferenceSpeedsSettings, TwinSettings

# Difference of ln speed below which walks say nothing about how cadence goes with speed
_LEAST_SLOWER = 0.05
PACKAGES = ["mujoco", "numpy", "scipy"]


def _say(text: str) -> None:
    print(text, file=sys.stderr, flush=True)


def read_walks(folders: list[Path], who: Body) -> list[Walk]:
    """Walks in the folders of trials."""
    return [read_walk(folder, who) for folder in folders]


def cadence_exponent(
    normal: list[Walk], assisted: list[Walk], settings: TwinReferenceSpeedsSettings
) -> float:
    """Return the power of speed that a person's cadence goes with, from their own walks where there are both kinds.

    ``settings`` is the slice ``twin.reference.speeds``. Cadence and speed of the walks with the robot are used, none of
    their angles. Walks at nearly one speed say nothing: the published power is taken.
    """
    if settings["cadence_from"] == "published" or not assisted:
        return settings["cadence_exponent"]
    speeds, strides = (
        [float(np.mean([getattr(w, name) for w in walks])) for walks in (assisted, normal)]
        for name in ("speed", "stride_s")
    )
    slower = np.log(speeds[0] / speeds[1])
    if abs(slower) < _LEAST_SLOWER:
        return settings["cadence_exponent"]
    return float(np.clip(-np.log(strides[0] / strides[1]) / slower, 0.0, 1.0))


def twin_reference(
    *,
    person: Path,
    walks: list[Path],
    settings: TwinSettings,
    out: Path,
    report: Path,
    assisted: list[Path] | None = None,
) -> None:
    """Reference gait of a person from the folders of their walk_normal trials; what had to be changed, in degrees.

    ``settings`` is the slice ``twin``; ``out`` the gait (.npz), ``report`` a JSON. ``assisted`` are the folders of the
    walk_robot trials, for the cadence at other speeds.
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
        _say,
    )
    others = settings["reference"]["speeds"]
    exponent = cadence_exponent(trials, read_walks(assisted or [], who), others)
    if others["shares"]:
        reference = with_speeds(reference, who, settings["human"], settings["reference"], exponent, _say)
    save_reference(out, reference)
    tables = [folder / f"{t}.parquet" for folder in walks for t in ("joints", "pose", "markers")]
    write_json(
        report,
        {
            "phantom": phantom or any(w.phantom for w in trials),
            "trials": [folder.name for folder in walks],
            "strikes_from": sorted({w.strikes_from for w in trials}),
            "strides": {side: sum(len(whole_strides(w.strikes[side])) for w in trials) for side in "rl"},
            "asymmetry_rms_deg": asymmetry,
            "cadence_exponent": exponent,
            **reference.report,
            "provenance": provenance([person, *tables], PACKAGES, fingerprint(__name__)),
        },
    )
