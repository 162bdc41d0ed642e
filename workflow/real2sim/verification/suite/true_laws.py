"""What the sealed truth says of the law behind a gap: where it acts, on what it depends, its kind and its curve.

The score compares the free-form answer of a diagnosis with it (`verification.score_laws`).
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from real2sim.verification.phantom.physics import AXES, Step
from real2sim.verification.suite.laws import RobotTerm, Term
from real2sim.verification.suite.setups import Setup

JOINTS = ("base_x", "base_y", "base_yaw", "arm_lift", "arm_roll", "arm_pitch")
# Variable of a robot joint by its index: place and speed of the base
PLACES, SPEEDS = ("place_x", "place_y"), ("speed_x", "speed_y")
_POINTS = 201
# Percentiles between which a variable counts as visited: beyond are a few samples that no fit can use
_VISITED = (2.5, 97.5)


@dataclass(frozen=True)
class TrueLaw:
    """One law as the score needs it.

    ``axes``: strap axes or robot joints that it acts on; ``kinds`` and ``depends_on``: answers that are right, of the
    second each a set of variables; ``curves``: (variable, axis or joint) of each force that is a function of that
    variable alone; ``kin``: effects of the catalogue whose law may be as good.
    """

    stage: str
    axes: tuple[str, ...]
    kinds: tuple[str, ...]
    depends_on: tuple[tuple[str, ...], ...]
    curves: tuple[tuple[str, str], ...] = ()
    kin: tuple[str, ...] = ()

    def to_dict(self) -> dict[str, Any]:
        """The law as it is sealed."""
        return asdict(self)


def _each(prefix: str, axes: list[str]) -> tuple[tuple[str, ...], ...]:
    # a law of its own on each axis: naming one of them is right
    return tuple((f"{prefix}{axis}",) for axis in axes)


# Kinds of the effects of the catalogue, and what each axis' law depends on: q, v, history of q
_ELASTIC = ("slack", "one_sided", "stiffening", "asymmetric_stiffness", "joint_limit")
_BY_RATE = ("coulomb", "quadratic_damping")
_MEMORY = ("relaxation", "creep")
_MEASURED = ("soft_tissue", "lab_yaw", "marker_offset", "marker_drift", "outliers")
_TIMING = ("replay_lag", "sync_offset", "clock_drift", "filter_lag")
_OF_TIME = ("clock_drift", "marker_drift")
_TURNS = tuple(f"pelvis_{angle}" for angle in ("tilt", "list", "heading"))


def library_law(effect: str, stage: str, axes: list[str]) -> TrueLaw:
    """Return the law of an effect of the catalogue; empty kinds and variables where there is nothing to name."""
    place = (stage, tuple(axes))
    if effect in _ELASTIC:
        # a stop has its force by its softness, which nothing in the motion shows
        curves = () if effect == "joint_limit" else tuple((f"q_{axis}", axis) for axis in axes)
        return TrueLaw(*place, ("elastic",), _each("q_", axes), curves)
    if effect in _BY_RATE:
        # dry friction sticks with an elastic deflection, so that its force is no function of the rate
        curves = () if effect == "coulomb" else tuple((f"v_{axis}", axis) for axis in axes)
        kinds = ("dissipative", "hysteresis") if effect == "coulomb" else ("dissipative",)
        sets = _each("v_", axes) + (_each("history of q_", axes) if effect == "coulomb" else ())
        return TrueLaw(*place, kinds, sets, curves)
    if effect == "lugre":
        sets = _each("v_", axes) + _each("history of q_", axes)
        return TrueLaw(*place, ("dissipative", "hysteresis"), sets)
    if effect == "hysteresis":
        return TrueLaw(*place, ("hysteresis",), _each("history of q_", axes))
    if effect in _MEMORY:
        kinds = ("memory", "slow change") if effect == "creep" else ("memory",)
        return TrueLaw(*place, kinds, _each("history of q_", axes))
    if effect == "migration":
        return TrueLaw(
            *place, ("memory", "hysteresis", "slow change"), (*_each("history of q_", axes), ("time",))
        )
    if effect in ("cross_coupling", "misalignment"):
        both = tuple(
            tuple(f"{v}_{axis}" for axis in pair) for v in "qv" for pair in (axes[:2], axes[2:]) if pair
        )
        return TrueLaw(*place, ("elastic coupling", "coupling"), both)
    if effect in _TIMING or effect in _MEASURED:
        sets = (("time",),) if effect in _OF_TIME else ()
        sets = tuple((turn,) for turn in _TURNS) if effect in ("soft_tissue", "lab_yaw") else sets
        return TrueLaw(*place, ("measurement",), sets)
    return TrueLaw(*place, (), ())


def curve_of(variable: str, along: str, setup: Setup, visited: np.ndarray) -> dict[str, Any]:
    """Return the force of laws without memory along an axis or joint over a variable, as the simulation has it.

    ``setup`` holds the laws' terms, ``visited`` (n,) the values of the variable in the dynamic trials [SI]. ``force``
    is that of the laws, ``total`` with the strap's own stiffness or damping where they act on the same axis.
    """
    grid = np.linspace(visited.min(), visited.max(), _POINTS)
    force = (_on_joint if along in JOINTS else _on_axis)(variable, along, setup, grid)
    linear = 0.0
    if variable[2:] == along:
        axis = AXES.index(along)
        linear = float((setup.stiffness if variable.startswith("q_") else setup.damping)[axis])
    return {
        "variable": variable,
        "along": along,
        "grid": grid.tolist(),
        "force": force.tolist(),
        "total": (force - linear * grid).tolist(),
        "visited": np.percentile(visited, _VISITED).tolist(),
    }


def _on_axis(variable: str, along: str, setup: Setup, grid: np.ndarray) -> np.ndarray:
    # one step of each term at every value
    state = np.zeros((2, len(grid), 6))
    state["qv".index(variable[0]), :, AXES.index(variable[2:])] = grid
    total = np.zeros(len(grid))
    for kind, values in setup.terms:
        if issubclass(kind, Term):
            term = kind(np.arange(len(grid)), 1e-3, [values] * len(grid))
            total += term.force(*state)[:, AXES.index(along)]
    return total


def _on_joint(variable: str, along: str, setup: Setup, grid: np.ndarray) -> np.ndarray:
    joint, n = JOINTS.index(along), len(grid)
    places, rates, force = np.tile(setup.controller.start, (n, 1)), np.zeros((n, 6)), np.zeros((n, 6))
    if variable in SPEEDS:
        rates[:, joint] = grid
    else:
        places[:, joint] += grid
    for kind, values in setup.terms:
        if issubclass(kind, RobotTerm):
            step = Step(0.0, places, rates, np.zeros((n, 3)), np.zeros((n, 3)))
            kind(np.arange(n), 1e-3, [values] * n)(step, force, np.zeros((n, 3, 3)))
    on_joint: np.ndarray = force[:, joint]
    return on_joint
