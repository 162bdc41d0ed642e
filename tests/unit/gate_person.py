"""A simulated person whose raw files the gates are tested on, and the settings of the gates."""

from __future__ import annotations

from pathlib import Path

from real2sim.configuration import read_yaml, validated

from benchmarks import faults

CONFIG = validated({}, "config", Path("defaults"))
SETTINGS = {
    "quality": CONFIG["quality"],
    "ingest": CONFIG["ingest"],
    "scales": CONFIG["identification"]["scales"],
    "start_window_s": CONFIG["identification"]["start_window_s"],
    "start_known_share": CONFIG["identification"]["start_known_share"],
}


def simulate_person(root: Path, dynamic_s: float) -> Path:
    """Write raw files and truth of S01 with 11 short trials, dynamic ones of ``dynamic_s`` [s]; return ``root``."""
    source = faults.ROOT / "config" / "phantom.yaml"
    phantom = validated(read_yaml(source), "phantom", source)
    phantom["cohort"] = {"S01": phantom["cohort"]["S01"]}
    phantom["cohort"]["S01"]["tightness"] = {"loosest_cm": 9, "tightest_cm": 11, "safe_comfortable_cm": 10}
    phantom["trials"] |= {"dynamic_s": dynamic_s, "walk_s": 6.0, "walk_robot_trials": 1, "neutral_s": 5.0}
    faults.simulate(root, ["S01"], phantom)
    return root
