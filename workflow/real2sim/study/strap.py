"""The pelvic strap on the study's robot twin, as a described system with a study's own model, impedances and bounds."""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING

from real2sim.system.description import System, shipped
from real2sim.system.plant import impedances

if TYPE_CHECKING:
    from real2sim.settings import Settings


@cache
def _described() -> System:
    return System.from_yaml(shipped("strap") / "system.yaml")


def strap_system(robot: Path, settings: Settings) -> System:
    """Return the strap with the robot's MJCF and the settings of a study.

    ``settings`` has the slices ``robot`` (impedances) and ``identification`` (bounds).
    """
    held = impedances(settings["robot"], "hold")
    return _described().with_model(robot, held, settings["identification"]["bounds"])
