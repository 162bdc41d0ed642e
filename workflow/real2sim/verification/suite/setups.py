"""One simulation as a record of plain values, and many of them as one batch of the phantom's physics."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from real2sim.verification.phantom.physics import (
    Controller,
    PelvisPath,
    Robot,
    TruePaths,
    simulate,
    simulate_centres,
)
from real2sim.verification.suite.laws import EffectLaw, RobotTerm, Term
from real2sim.verification.suite.random_laws import PlaceGain, Watch

FREE = np.full(6, np.inf)

_TermClass = type[Term] | type[RobotTerm]
_Kind = tuple[_TermClass, tuple[tuple[int, ...], ...]]  # class of a term and shapes of its parameters
_Member = tuple[int, dict[str, Any]]  # row of a trial in the batch and a term's parameters there


@dataclass
class Setup:
    """Everything that one trial's simulation takes [SI].

    ``terms`` are (class of the term, its parameters); ``added`` (4,) mass and inertia carried by the
    interface.
    """

    path: PelvisPath
    rest_rotation: np.ndarray
    rest_position: np.ndarray
    stiffness: np.ndarray
    damping: np.ndarray
    controller: Controller
    lower: np.ndarray = field(default_factory=lambda: -FREE)
    upper: np.ndarray = field(default_factory=FREE.copy)
    added: np.ndarray = field(default_factory=lambda: np.zeros(4))
    terms: list[tuple[_TermClass, dict[str, Any]]] = field(default_factory=list)

    def copy(self) -> Setup:
        """A copy whose lists and controller can be changed."""
        return replace(self, terms=list(self.terms), controller=replace(self.controller))


def _batch(robot: Robot, setups: list[Setup], stops: dict[str, Any]) -> dict[str, Any]:
    groups: dict[_Kind, list[_Member]] = {}
    for row, setup in enumerate(setups):
        for kind, values in setup.terms:
            # parameters of one term have one shape in a batch
            key = (kind, tuple(np.shape(v) for v in values.values()))
            groups.setdefault(key, []).append((row, values))
    made = [
        kind(np.array([row for row, _ in members]), robot.step_s, [values for _, values in members])
        for kind, members in _one_per_row(groups)
    ]
    n = len(setups)
    law = EffectLaw(
        stiffness=np.array([s.stiffness for s in setups]),
        damping=np.array([s.damping for s in setups]),
        lower=np.array([s.lower for s in setups]),
        upper=np.array([s.upper for s in setups]),
        stop_stiffness=np.array(stops["stiffness"]),
        stop_damping=np.array(stops["damping"]),
        rest_rotation=np.array([s.rest_rotation for s in setups]),
        rest_position=np.array([s.rest_position for s in setups]),
        migration=np.zeros((n, 3)),
        terms=[term for term in made if isinstance(term, Term)],
    )
    watching = [term for term in made if isinstance(term, PlaceGain)]
    added = np.array([s.added for s in setups])
    return {
        "robot": robot,
        "paths": [s.path for s in setups],
        "law": law,
        "controllers": [s.controller for s in setups],
        "effects": [term for term in made if isinstance(term, RobotTerm)]
        + ([Watch(watching)] if watching else []),
        "added_mass": added if added.any() else None,
    }


def _one_per_row(groups: dict[_Kind, list[_Member]]) -> Iterator[tuple[_TermClass, list[_Member]]]:
    # a trial with two terms of one kind needs two terms: rows of a term are all different
    for (kind, _), members in groups.items():
        rest = members
        while rest:
            now = list({row: (row, values) for row, values in reversed(rest)}.values())
            rest = [member for member in rest if not any(member[1] is values for _, values in now)]
            yield kind, now


def run(robot: Robot, setups: list[Setup], stops: dict[str, Any], rate_hz: float) -> list[TruePaths]:
    """True paths of every setup, in the order given."""
    out: list[TruePaths | None] = [None] * len(setups)
    for rows in _by_duration(setups):
        batch = _batch(robot, [setups[i] for i in rows], stops)
        for i, paths in zip(rows, simulate(rate_hz=rate_hz, **batch), strict=True):
            out[i] = paths
    return [paths for paths in out if paths is not None]


def run_centres(
    robot: Robot, setups: list[Setup], stops: dict[str, Any], rate_hz: float, most: int = 640
) -> list[np.ndarray]:
    """Joint centres (m, 2, 3) [m] of every setup, in the order given, at most ``most`` in one batch."""
    out: list[np.ndarray] = [np.empty(0)] * len(setups)
    for rows in _by_duration(setups):
        for start in range(0, len(rows), most):
            some = rows[start : start + most]
            batch = _batch(robot, [setups[i] for i in some], stops)
            for i, centres in zip(some, simulate_centres(rate_hz=rate_hz, **batch), strict=True):
                out[i] = centres
    return out


def _by_duration(setups: list[Setup]) -> list[list[int]]:
    groups: dict[float, list[int]] = {}
    for i, setup in enumerate(setups):
        groups.setdefault(setup.path.duration_s, []).append(i)
    return list(groups.values())
