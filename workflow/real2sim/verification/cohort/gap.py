"""The sealed gap of a phantom: unmodelled effects in the neutral and dynamic trials, as large as a study's gap.

Which effects a person has is drawn from the prior of config/phantom.yaml; their sizes are those at which the plain
model, refitted, leaves the cost J that was drawn too. The effects are those of the diagnosis suite, with their own
physics: nothing here is shared with what an analysis simulates.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from real2sim.verification.phantom.exports import Trial
from real2sim.verification.phantom.motions import Motion
from real2sim.verification.phantom.person import Person, stream
from real2sim.verification.phantom.physics import Controller, PelvisPath, Robot
from real2sim.verification.suite.effects import Draw
from real2sim.verification.suite.forms import FORMS
from real2sim.verification.suite.gaps import gaps, record_of, run_keys, with_effects
from real2sim.verification.suite.measurement import Recording
from real2sim.verification.suite.plan import Case
from real2sim.verification.suite.synthetic import (
    Applied,
    Cause,
    Synthetic,
    World,
    about_of,
    applied,
    cause_truth,
    describe,
    linearise,
)

# Ratio of sizes that are tried side by side
_STEP = 1.5


def _markers(recording: Recording, t: np.ndarray) -> dict[str, np.ndarray]:
    """All markers (m, 3) [m] of a recording at times (m,) [s]."""
    centres = recording.interface(t)
    return recording.pelvis(t) | {"IF_L": centres[:, 0].copy(), "IF_R": centres[:, 1].copy()}


def _size_at(wanted: float, sizes: np.ndarray, costs: np.ndarray) -> float:
    """Return the size that makes a cost, between those tried (k,), or the one whose cost comes nearest."""
    for i in range(len(sizes) - 1):
        low, high = costs[i], costs[i + 1]
        if 0 < low <= wanted <= high:
            share = np.log(wanted / low) / np.log(high / low)
            return float(sizes[i] * (sizes[i + 1] / sizes[i]) ** share)
    return float(sizes[int(np.argmin(np.abs(np.log(np.maximum(costs, 1e-9) / wanted))))])


def trials_with(
    robot: Robot, stops: dict[str, Any], p: Synthetic, effects: Sequence[Applied], trials: Sequence[Trial]
) -> list[list[Trial] | None]:
    """Return a person's trials once per set of effects, with the strap's stops; None where they are unstable.

    All are simulated side by side with ``robot``; ``p`` after `describe`.
    """
    setups = {}
    lower, upper = p.person.stops[p.person.operating_level]
    for i, some in enumerate(effects):
        for trial in trials:
            setup = with_effects(p, trial.name, some)
            setup.lower, setup.upper = np.maximum(setup.lower, lower), np.minimum(setup.upper, upper)
            setups[i, trial.name] = setup
    done = run_keys(robot, stops, setups)
    out: list[list[Trial] | None] = []
    for i, some in enumerate(effects):
        held = []
        for trial in trials:
            path, true = setups[i, trial.name].path, done[i, trial.name]
            if np.isfinite(true.left).all():
                shown = partial(_markers, record_of(p, trial.name, path, true, some))
                held.append(replace(trial, path=path, truth=true, shown=shown))
        out.append(held if len(held) == len(trials) else None)
    return out


class Gap:
    """Effects of one person, and their trials with them.

    Parameters
    ----------
    settings
        config/phantom.yaml with ``gap.enabled``.
    robot
        MJCF of the robot.
    person
        The synthetic person.
    motions, paths, starts, controllers
        Of the neutral and the dynamic trials, by name; ``starts`` are robot joints (6,) at t = 0.
    """

    def __init__(
        self,
        settings: dict[str, Any],
        robot: Path,
        person: Person,
        *,
        motions: dict[str, Motion],
        paths: dict[str, PelvisPath],
        starts: dict[str, np.ndarray],
        controllers: dict[str, Controller],
    ):
        self._options, self._settings, self._person = settings["gap"], settings, person
        coarse, fine = (Robot(robot, s) for s in (self._options["step_s"], settings["simulation"]["step_s"]))
        about = {
            "seed": settings["seed"],
            "parameters": settings["parameters"],
            "severity": {"refits": self._options["refits"]},
        }
        self._world = World(about, settings, coarse, fine)
        case = Case(person.name, "gap", (), None)
        self._p = Synthetic(
            case, person, settings, motions, paths, starts, controllers, None, (1.0, 1.0), self._causes()
        )
        describe(self._world, [self._p])
        linearise(self._world, [self._p])
        rng = stream(settings, person.name, "gap", "J")
        self._wanted = float(rng.uniform(*self._options["j"]))
        self._choose()
        self._fit_sizes()

    def _causes(self) -> list[Cause]:
        """Draw one or two effects, not twice the same."""
        rng = stream(self._settings, self._person.name, "gap", "causes")
        names = sorted(self._options["prior"])
        weight = np.array([self._options["prior"][name] for name in names], float)
        count = 2 if rng.random() < self._options["two_share"] else 1
        chosen = rng.choice(len(names), count, replace=False, p=weight / weight.sum())
        return [Cause(FORMS[names[i]], names[i]) for i in chosen]

    def _choose(self) -> None:
        """Take the first draw of each effect that can make its share of the gap, else the one that comes nearest."""
        share = self._wanted / len(self._p.causes)
        rngs = [stream(self._settings, self._person.name, "gap", cause.name) for cause in self._p.causes]
        largest = dict.fromkeys(range(len(rngs)), -np.inf)
        # draw by draw: most effects make their share with the first
        for _ in range(self._options["draws"]):
            unable = [i for i, reached in largest.items() if reached < share]
            if not unable:
                break
            drawn = {i: self._p.causes[i].form.draw(rngs[i], about_of(self._p)) for i in unable}
            sizes = {i: self._sizes(self._largest(self._p.causes[i], drawn[i])) for i in unable}
            tried = [(self._p.causes[i], drawn[i], size) for i in unable for size in sizes[i]]
            costs = self._costs([self._of([one]) for one in tried]).reshape(len(unable), -1)
            for i, reached in zip(unable, costs, strict=True):
                if reached.max() > largest[i]:
                    largest[i] = float(reached.max())
                    self._p.causes[i].draw = drawn[i]
                    self._p.causes[i].severity = _size_at(share, sizes[i], reached)

    def _largest(self, cause: Cause, draw: Draw) -> float:
        """Return the largest size of a drawn effect that the settings, its equation and the strap's stops allow."""
        stops = self._person.stops[self._person.operating_level]
        return min(float(self._options["largest"]), cause.form.largest(draw, about_of(self._p), stops))

    def _sizes(self, largest: float) -> np.ndarray:
        """Sizes (k,) that are tried at once, each half as large again as the one before."""
        return largest * _STEP ** -np.arange(self._options["sizes"], dtype=float)[::-1]

    def _fit_sizes(self) -> None:
        """Scale all effects together until the plain fit leaves the cost that was drawn."""
        own = [(cause.severity, self._largest(cause, cause.draw)) for cause in self._p.causes]
        factors = self._sizes(_STEP ** (self._options["sizes"] // 2))
        for _ in range(2):
            tried = [[min(factor * size, largest) for size, largest in own] for factor in factors]
            costs = self._costs(
                [
                    self._of([(c, c.draw, s) for c, s in zip(self._p.causes, sizes, strict=True)])
                    for sizes in tried
                ]
            )
            best = int(np.argmin(np.abs(np.log(np.maximum(costs, 1e-9) / self._wanted))))
            self.j = float(costs[best])
            for cause, size in zip(self._p.causes, tried[best], strict=True):
                cause.severity = size
            near = _size_at(self._wanted, factors, costs)
            factors = near * np.geomspace(0.9, 1.1, len(factors))

    def _of(self, effects: Sequence[tuple[Cause, Draw, float]]) -> Applied:
        return [(c.form, c.form.values(draw, size, about_of(self._p))) for c, draw, size in effects]

    def _costs(self, effects: list[Applied]) -> np.ndarray:
        """J (k,) that the refitted plain model leaves of the first dynamic trial; 0 where nothing can be simulated."""
        fits = gaps(self._world, [self._p] * len(effects), effects)
        return np.array([float(fit.train @ fit.train) if fit.usable else 0.0 for fit in fits])

    def put_into(self, trials: Sequence[Trial]) -> None:
        """Give neutral and dynamic trials their paths with the effects, and what is recorded of them before noise."""
        told = [trial for trial in trials if trial.name in self._p.motions]
        held = trials_with(self._world.fine, self._world.stops, self._p, [applied(self._p)], told)[0]
        if held is None:
            raise RuntimeError(f"{self._person.name}: the simulation with the sealed gap is unstable")
        for own, other in zip(told, held, strict=True):
            own.path, own.truth, own.shown = other.path, other.truth, other.shown

    def truth(self) -> dict[str, Any]:
        """Return what is sealed: effects with their quantities and sizes, and J of the plain fit without noise."""
        causes = [cause_truth(self._p, cause) for cause in self._p.causes]
        return {"causes": causes, "j_wanted": self._wanted, "j_of_the_plain_fit": self.j}
