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
    second each a set of variables; ``variable``: the one that the curve of its force along ``along`` is over, None
    where there is no such curve; ``kin``: effects of the catalogue whose law may be as good.
    """

    stage: str
    axes: tuple[str, ...]
    kinds: tuple[str, ...]
    depends_on: tuple[tuple[str, ...], ...]
    variable: str | None = None
    along: str | None = None
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
        curve = (f"q_{axes[0]}", axes[0]) if len(axes) == 1 and effect != "joint_limit" else (None, None)
        return TrueLaw(*place, ("elastic",), _each("q_", axes), *curve)
    if effect in _BY_RATE:
        curve = (f"v_{axes[0]}", axes[0]) if len(axes) == 1 and effect != "coulomb" else (None, None)
        kinds = ("dissipative", "hysteresis") if effect == "coulomb" else ("dissipative",)
        sets = _each("v_", axes) + (_each("history of q_", axes) if effect == "coulomb" else ())
        return TrueLaw(*place, kinds, sets, *curve)
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


def curve_of(law: TrueLaw, setup: Setup, visited: np.ndarray) -> dict[str, Any] | None:
    """Return the law's force over its variable, as the simulation has it, or None where the law has no such curve.

    ``setup`` holds the law's terms alone, ``visited`` (n,) the values of the variable in the dynamic trials [SI].
    ``curve`` is the law itself, ``total`` with the strap's own stiffness or damping where it acts on the same axis.
    """
    if law.variable is None or law.along is None:
        return None
    grid = np.linspace(visited.min(), visited.max(), _POINTS)
    force = (_on_joint if law.along in JOINTS else _on_axis)(law, setup, grid)
    linear = 0.0
    if law.variable[2:] == law.along:
        axis = AXES.index(law.along)
        linear = float((setup.stiffness if law.variable.startswith("q_") else setup.damping)[axis])
    return {
        "variable": law.variable,
        "along": law.along,
        "grid": grid.tolist(),
        "force": force.tolist(),
        "total": (force - linear * grid).tolist(),
        "visited": np.percentile(visited, _VISITED).tolist(),
    }


def _on_axis(law: TrueLaw, setup: Setup, grid: np.ndarray) -> np.ndarray:
    # laws without memory: one step of the term at every value
    assert law.variable is not None
    assert law.along is not None
    state = np.zeros((2, len(grid), 6))
    state["qv".index(law.variable[0]), :, AXES.index(law.variable[2:])] = grid
    total = np.zeros(len(grid))
    for kind, values in setup.terms:
        if issubclass(kind, Term):
            term = kind(np.arange(len(grid)), 1e-3, [values] * len(grid))
            total += term.force(*state)[:, AXES.index(law.along)]
    return total


def _on_joint(law: TrueLaw, setup: Setup, grid: np.ndarray) -> np.ndarray:
    assert law.variable is not None
    assert law.along is not None
    joint, n = JOINTS.index(law.along), len(grid)
    places, rates, force = np.tile(setup.controller.start, (n, 1)), np.zeros((n, 6)), np.zeros((n, 6))
    if law.variable in SPEEDS:
        rates[:, joint] = grid
    else:
        places[:, joint] += grid
    for kind, values in setup.terms:
        if issubclass(kind, RobotTerm):
            step = Step(0.0, places, rates, np.zeros((n, 3)), np.zeros((n, 3)))
            kind(np.arange(n), 1e-3, [values] * n)(step, force, np.zeros((n, 3, 3)))
    along: np.ndarray = force[:, joint]
    return along
