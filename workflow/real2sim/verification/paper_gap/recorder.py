"""A synthetic person whose recordings hold one effect, of any size."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from real2sim.verification.cohort.gap import trials_with
from real2sim.verification.cohort.write import Simulated, prepared
from real2sim.verification.paper_gap.plan import TRIALS
from real2sim.verification.phantom.person import stream
from real2sim.verification.phantom.physics import Robot, robot_controller
from real2sim.verification.suite.forms import FORMS
from real2sim.verification.suite.plan import Case
from real2sim.verification.suite.synthetic import (
    Applied,
    Cause,
    Synthetic,
    World,
    about_of,
    cause_truth,
    describe,
)


class Recorder:
    """Recordings of one person with one effect, drawn once, of any size.

    Parameters
    ----------
    effect
        Name of the suite's form.
    subject, settings, controllers, robot
        Name of the person, checked settings of the phantom, the robot's controllers and its MJCF.
    """

    def __init__(
        self, effect: str, subject: str, settings: dict[str, Any], controllers: dict[str, Any], robot: Path
    ):
        steps = (settings["gap"]["step_s"], settings["simulation"]["step_s"])
        self._coarse, self._fine = (Robot(robot, step) for step in steps)
        self._plain = plain = prepared(settings, self._coarse, subject, TRIALS)
        self._cause = Cause(FORMS[effect], effect)
        self._p = Synthetic(
            Case(subject, "gap", (), None),
            plain.person,
            settings,
            {t.name: t.motion for t in plain.trials},
            {t.name: t.path for t in plain.trials},
            plain.starts,
            {t: robot_controller(settings, controllers, "dynamic", plain.starts[t]) for t in TRIALS},
            None,
            (1.0, 1.0),
            [self._cause],
        )
        self._stops = settings["stops"]
        describe(World({}, settings, self._coarse, self._fine), [self._p])
        self._rng = stream(settings, subject, "gap", effect)

    @property
    def most_severe(self) -> float:
        """Return the largest size at which the effect's equation means anything."""
        return self._cause.form.most_severe

    def draw(self) -> None:
        """Draw anew where the effect sits, its signs and its shape."""
        self._cause.draw = self._cause.form.draw(self._rng, about_of(self._p))

    def record(self, sizes: Sequence[float], *, fine: bool = False) -> list[Simulated | None]:
        """Return the trials once per size of the effect, by a coarse or a fine time step; None where unstable."""
        robot = self._fine if fine else self._coarse
        held = trials_with(
            robot, self._stops, self._p, [self._applied(size) for size in sizes], self._plain.trials
        )
        return [None if trials is None else replace(self._plain, trials=trials) for trials in held]

    def _applied(self, size: float) -> Applied:
        form = self._cause.form
        return [(form, form.values(self._cause.draw, size, about_of(self._p)))]

    def truth(self, size: float) -> dict[str, Any]:
        """Return what is sealed of the effect at a size."""
        self._cause.severity = size
        return cause_truth(self._p, self._cause)
