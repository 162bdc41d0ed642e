"""A dynamic trial of known parameters as canonical files: simulated by the phantom's own physics, then measured."""

from __future__ import annotations

import copy
import json
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from real2sim import geometry
from real2sim.configuration import read_yaml, validated
from real2sim.signals import lowpass
from real2sim.verification.cohort.write import simulate_trial
from real2sim.verification.phantom.person import PARAMETER_NAMES, draw_person
from real2sim.verification.phantom.tasks import motion_of

ROOT = Path(__file__).parents[2]
ROBOT = ROOT / "resources" / "robot" / "drba.xml"
PUBLISHED = ROOT / "resources" / "published" / "table1_priors.csv"
CONFIG = validated({}, "config", Path("defaults"))
SECONDS = 12.0


@dataclass(frozen=True)
class RecordedTrial:
    """Files of a trial, and what is true of it."""

    pose: Path
    markers: Path
    limits: Path
    neutral_quality: Path
    step: Path
    parameters: dict[str, float]


@cache
def _truth():
    source = ROOT / "config" / "phantom.yaml"
    settings = copy.deepcopy(validated(read_yaml(source), "phantom", source))
    settings["effects"]["enabled"] = settings["measurement"]["enabled"] = False
    settings["trials"]["dynamic_s"] = SECONDS
    person = draw_person(settings, "S02", 0.95)
    paths = simulate_trial(
        robot=ROBOT,
        settings=settings,
        controllers=CONFIG["robot"],
        parameters=person.parameters,
        motion=motion_of(settings, person, "dynamic_1"),
        rest_rotation=person.rest_rotation,
        rest_position=person.rest_position,
    )
    return person, paths


def record(folder: Path, noise_m: float = 0.0, seed: int = 1, step_s: float = 0.01) -> RecordedTrial:
    """Write the trial's tables with white marker noise of an SD [m], limits, the neutral's quality and a step."""
    person, truth = _truth()
    rng = np.random.default_rng(seed)
    names = (*geometry.PELVIS_MARKERS, *geometry.INTERFACE_MARKERS)
    true = [
        truth.pelvis_position + truth.pelvis_rotation @ person.markers[name]
        for name in geometry.PELVIS_MARKERS
    ]
    paths = np.stack([*true, truth.left, truth.right], axis=1)
    noise = noise_m * rng.standard_normal(paths.shape)
    paths = paths + lowpass(noise.reshape(len(noise), -1), 100, 12, 4).reshape(noise.shape)
    markers = dict(zip(names, np.moveaxis(paths, 1, 0), strict=True))
    r_p, p_p = geometry.pelvis_frame(*(markers[name] for name in geometry.PELVIS_MARKERS))
    r_i, p_i = geometry.interface_frame(markers["IF_L"], markers["IF_R"])
    time_s = truth.time_s - truth.time_s[0]
    columns = {"time_s": time_s}
    for body, rotation, position in (("pelvis", r_p, p_p), ("interface", r_i, p_i)):
        columns |= {f"{body}_{c}": position[:, i] for i, c in enumerate("xyz")}
        columns |= {f"{body}_q{c}": geometry.quaternion(rotation)[:, i] for i, c in enumerate("wxyz")}
    rest = {"rotation": person.rest_rotation.tolist(), "position": person.rest_position.tolist()}
    meta = json.dumps({"rest": rest, "phantom": True})
    folder = folder / "dynamic_1"
    folder.mkdir(parents=True, exist_ok=True)
    trial = RecordedTrial(
        folder / "pose.parquet",
        folder / "markers.parquet",
        folder / "limits.json",
        folder / "neutral.json",
        folder / "step.json",
        {name: person.parameters[name] for name in PARAMETER_NAMES},
    )
    pq.write_table(pa.table(columns).replace_schema_metadata({"real2sim": meta}), trial.pose)
    wide = {f"{name}_{c}": path[:, i] for name, path in markers.items() for i, c in enumerate("xyz")}
    pq.write_table(pa.table({"time_s": time_s} | wide), trial.markers)
    trial.limits.write_text(json.dumps({"q_min": [-1.0] * 6, "q_max": [1.0] * 6}))
    quality = {name: {"noise_sd_m": [noise_m] * 3} for name in geometry.PELVIS_MARKERS}
    trial.neutral_quality.write_text(json.dumps({"markers": quality, "markers_rate_hz": 100}))
    trial.step.write_text(json.dumps({"timestep_s": step_s}))
    return trial
