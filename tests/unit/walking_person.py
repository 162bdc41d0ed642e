"""A person to walk in tests: the phantom's mean curves as a measured cycle, and the reference made of them once."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import numpy as np
import yaml
from real2sim.configuration import validated
from real2sim.study.twin.gait import PHASES, Reference, make_reference
from real2sim.study.twin.human import Body

ROOT = Path(__file__).parents[2]
WHO = Body(1.75, 75.0, "male")


def twin_settings() -> dict:
    """The slice ``twin`` with all defaults."""
    return validated({}, "config", Path("config"))["twin"]


def measured_curves() -> dict[str, np.ndarray]:
    """The phantom's normal walk at the phases of a reference [rad, m]."""
    gait = yaml.safe_load((ROOT / "config" / "phantom.yaml").read_text(encoding="utf-8"))["gait"]
    phase = np.arange(PHASES) / PHASES

    def wave(terms) -> np.ndarray:
        return sum(
            a * np.cos(2 * np.pi * k * phase) + b * np.sin(2 * np.pi * k * phase)
            for k, (a, b) in enumerate(terms, start=1)
        )

    out = {}
    for joint, name in (("hip", "hip_flexion"), ("knee", "knee_angle"), ("ankle", "ankle_angle")):
        raw = wave(gait["walk_normal"][joint]["terms"])
        rom = gait["walk_normal"]["range_of_motion_deg"][joint]
        out[name] = np.radians(gait["walk_normal"][joint]["mean"] + raw * rom / np.ptp(raw))
    out["hip_adduction"] = out["hip_rotation"] = np.zeros(PHASES)
    for name, terms in gait["pelvis"].items():
        scale = 1e-3 if name.startswith("t") and name != "tilt" else np.pi / 180
        out[f"pelvis_{name}"] = scale * wave(terms)
    return out


@cache
def reference() -> Reference:
    """A reference of `WHO` at 1.1 m/s and 100 steps/min."""
    settings = twin_settings()
    return make_reference(measured_curves(), 1.2, 1.1, WHO, settings["human"], settings["reference"])
