"""What an effect is, where it acts, what its numbers are measured in, and how it gets into a simulation.

An `Effect` is one entry of the catalogue. A `Mechanism` compiles it into the plant; `real2sim.effects.chains` changes
what goes into a simulation and what comes out. Nothing here names a joint, an axis or a body: they come from the
`System` that a place carries.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from itertools import combinations
from typing import Any, Protocol

import mujoco
import numpy as np

from real2sim.effects.chains import NO_CHAINS, Chains, Context
from real2sim.system.description import System

# End of a dead band that is never reached [m, rad]
FAR = 10.0

# What an exported model holds of an effect
NATIVE, PLANNED, CHAIN = "in the model", "planned force, not in the model", "not a model"


@dataclass(frozen=True)
class Scales:
    """Units of the effects' parameters for one person, one entry per axis of the interface.

    ``q``, ``v`` (n,) are large excursions and rates [m, rad; m/s, rad/s], ``k``, ``d`` (n,) stiffness and damping of
    the plain fit, ``inertia`` (n,) the inertia of the machine against each axis [kg, kg m^2]. ``pace`` is how many
    times faster the system moves than a person in a strap, whose band ends at 10 Hz: delays and filters are searched
    in seconds divided, and hertz multiplied, by it. ``load`` and ``load_inertia`` are how many times heavier its
    interface's body is than a strap's, of 3 kg and 0.03 kg m^2: masses and inertias are searched in units of them.
    """

    q: np.ndarray
    v: np.ndarray
    k: np.ndarray
    d: np.ndarray
    inertia: np.ndarray
    pace: float = 1.0
    load: float = 1.0
    load_inertia: float = 1.0

    @property
    def force(self) -> np.ndarray:
        """Force of the plain interface in a large excursion (n,) [N, Nm]."""
        return np.asarray(self.k * self.q + self.d * self.v)


@dataclass(frozen=True)
class InterfaceImpedance:
    """Stiffness ``k`` and damping ``d`` of the plain interface in m simulations, (m, n) each for n axes [SI]."""

    k: np.ndarray
    d: np.ndarray


@dataclass(frozen=True)
class Where:
    """Place of an effect: axis indices of a system, a side (+1, -1, 0 for none), a variant, and the effect's name.

    ``machine_joint`` is the joint of the machine that an effect of the machine acts on, empty for none.
    """

    system: System = field(repr=False, compare=False)
    axes: tuple[int, ...] = ()
    side: int = 0
    variant: str = ""
    owner: str = ""
    machine_joint: str = ""

    @property
    def axis_names(self) -> list[str]:
        """Names of the axes."""
        return [self.system.axes[a].name for a in self.axes]

    @property
    def tag(self) -> str:
        """Suffix for the names of what is built there."""
        side = {1: "_upper", -1: "_lower", 0: ""}[self.side]
        return self.machine_joint + "_".join(self.axis_names) + side + self.variant

    @property
    def element(self) -> str:
        """Ending of the names of elements in the model: no two effects share them."""
        return f"{self.owner}_{self.tag}"

    @property
    def axis(self) -> int:
        """Index of the first axis, of an effect that acts on one."""
        return self.axes[0]

    def joint(self, axis: int | None = None) -> str:
        """Name of the joint of an axis of the interface, by default of the first axis of this place."""
        return self.system.axes[self.axis if axis is None else axis].joint


class Fields:
    """Fields of the plant's batch, expanded per simulation when they are first asked for."""

    def __init__(
        self, batch: mujoco.batch.Batch, model: mujoco.MjModel, m: int, scales: Scales, system: System
    ):
        self._batch, self.model, self.m, self.scales, self.system = batch, model, m, scales, system

    def __getitem__(self, name: str) -> np.ndarray:
        return np.asarray(self._batch.expand(name)[: self.m])

    def joint(self, axis: int) -> int:
        """Joint index of an axis of the interface."""
        return int(self.model.joint(self.system.axes[axis].joint).id)

    def dof(self, axis: int) -> int:
        """Degree of freedom of an axis of the interface."""
        return int(self.model.joint(self.system.axes[axis].joint).dofadr[0])

    def tendon(self, name: str) -> int:
        """Index of a tendon."""
        return int(self.model.tendon(name).id)

    def stiffest(self, axis: int) -> float:
        """Largest stiffness of an axis at which the time step is stable."""
        return float(0.5 * self.scales.inertia[axis] / self.model.opt.timestep**2)

    def hardest(self, axis: int) -> float:
        """Largest damping of an axis at which the time step is stable, outside of MuJoCo's implicit damping."""
        return float(0.5 * self.scales.inertia[axis] / self.model.opt.timestep)


class Law(Protocol):
    """Force of a controller on the machine in some simulations side by side, from values, `before` and the step.

    ``hears`` is "interface", its force on the machine along world x and y, or "base", the displacement of the
    base from its start along x, y and about z. ``before`` (m, j) [N, world | m, rad] is the input until the trial
    began.
    """

    hears: str
    delay: np.ndarray

    def __init__(self, values: np.ndarray, before: np.ndarray, step_s: float): ...

    def force(self, heard: np.ndarray, *, keep: bool) -> np.ndarray:
        """Return forces (m, w, j) [N, Nm] of the next w steps in which the input is ``heard`` (m, w, j).

        With ``keep`` the next call goes on from there.
        """


class Mechanism:
    """Part of an effect that is compiled into the plant and set per simulation; every default does nothing.

    This is the whole interface: a replay asks a mechanism for these attributes and methods and for no class.

    Attributes
    ----------
    order
        Mechanisms are set in this order, those of equal order as the hypothesis lists them.
    substeps
        Parts into which the time step has to be divided.
    replaces_spring
        The spring of the axis is replaced: no two such effects on one axis.
    planned
        Part of the force is fed in as a control, so that an exported model lacks it.
    control_is_force
        Its controls are forces, which a robot in equilibrium balances; not those that gate a damper.
    sticks
        A constraint of MuJoCo holds the joint (dry friction), which does not see the inertia of implicit dampers.
    weighed
        MuJoCo has to know the inertia against a constraint of this mechanism (a stop) before the run.
    moves_rest
        The rest pose of an axis is changed.
    acts_in_neutral
        The force has acted in the neutral trial too, where the rest pose was taken.
    law
        Class of the controller law that answers, between windows of the run, what the interface does.
    linear
        All it does is a planned force that is linear in the values and depends on measurements alone.
    feeds_back
        The planned force depends on the interface's motion: in a free run (`FreeRuns`) it follows the simulated one.
    kinds
        Kinds of the free-form families (`real2sim.effects.families`) that its force is a special case of; empty where
        no family holds it.
    """

    order: int = 0
    substeps: int = 1
    replaces_spring: bool = False
    planned: bool = False
    control_is_force: bool = True
    sticks: bool = False
    weighed: bool = False
    moves_rest: bool = False
    acts_in_neutral: bool = False
    law: type[Law] | None = None
    linear: bool = False
    feeds_back: bool = False
    kinds: tuple[str, ...] = ()

    def build(self, spec: mujoco.MjSpec, where: Where) -> None:
        """Add elements to the plant."""

    def set(self, fields: Fields, where: Where, impedance: InterfaceImpedance, values: np.ndarray) -> None:
        """Write values (m, p) [SI], and what follows from the interface's impedance, into the fields."""

    def overwrites(self, where: Where) -> frozenset[str]:
        """Return what of the plant it writes as a whole: two that share one would undo each other, and exclude it."""
        return frozenset()

    def columns(self, model: mujoco.MjModel, where: Where) -> np.ndarray:
        """Return the columns of the control that this mechanism commands, (j,)."""
        return np.empty(0, int)

    def force(
        self, values: np.ndarray, context: Context, where: Where, impedance: InterfaceImpedance
    ) -> np.ndarray | None:
        """Return planned controls (m, steps, j) of its columns, computed from measurements; None for none."""
        return None

    def before_run(
        self, fields: Fields, where: Where, impedance: InterfaceImpedance, values: np.ndarray
    ) -> None:
        """Write what depends on other effects and on values (m, p) [SI]: called with all set, before the first step."""

    def logged(self, where: Where) -> dict[str, str]:
        """Return the joints that the log shows instead of joints of the machine, by name."""
        return {}

    def relax(self, fields: Fields, where: Where, position: np.ndarray) -> None:
        """Move hidden joints to where they exert no force at joint positions (m, nq), which are changed in place."""


# Of an effect that leaves the plant as it is
NEUTRAL = Mechanism()


@dataclass(frozen=True)
class EffectParameter:
    """One free parameter: searched between ``lower`` and ``upper`` (in units of ``scale``), from each of ``starts``.

    ``log`` searches the logarithm. ``scale`` maps scales and axis index to the SI value of 1; ``unit`` is the unit for
    a translation, with the one for a rotation after a bar where it differs. ``prior_sd`` (of the searched number)
    holds linear nuisance-like parameters near 0. ``trial`` is "fitted" or "held out" for a number that belongs to one
    trial alone.
    """

    name: str
    unit: str
    lower: float
    upper: float
    starts: tuple[float, ...]
    scale: Callable[[Scales, int], float] = lambda scales, axis: 1.0
    log: bool = False
    prior_sd: float | None = None
    trial: str = ""

    def unit_for(self, *, rotational: bool) -> str:
        """Unit for an axis of the interface."""
        return self.unit.split("|")[-1 if rotational else 0]

    def searched(self, value: float) -> float:
        """Searched number of a value in units of ``scale``."""
        return float(np.log(value)) if self.log else value


@dataclass(frozen=True)
class AtRest:
    """Values of the parameters, in units of their scales, at which the effect does nothing.

    ``tolerance`` [m, rad] is how far the simulation may then be from the plain plant. Where the effect vanishes only in
    a limit outside the bounds, ``limit`` says which.
    """

    values: tuple[float, ...]
    tolerance: float = 1e-9
    limit: str = ""


@dataclass(frozen=True)
class Effect:
    """One entry of the catalogue; ``plant`` and ``chains`` say how it acts.

    Parameters
    ----------
    name, form
        Effects of one name are one answer; forms are variants with other equations.
    stage
        "input" (markers of the segment), "interface", "robot" or "output" (interface markers).
    equation, parameters
        The law, and its free numbers.
    separating_trial
        The trial that tells it from the effects it is mistaken for.
    at_rest
        Where it does nothing.
    confusable
        Names of effects that take its place in a fit, its own where its forms do; the relation is symmetric.
    group
        Label under which the suite's score counts effects as one answer; its name by default.
    scope
        "axis", "turn" (one of the rotations), "side" (axis and direction), "pair" (of axes), "joint" (of the machine,
        with a controller) or "whole".
    needs
        What a system must offer (`System.offers`) for the effect to make sense there.
    remedy
        What to do about an effect that cannot be part of a model: chains and planned forces have one.
    indistinguishable
        It fits a law that the catalogue does not hold as often as itself.
    """

    name: str
    stage: str
    equation: str
    parameters: tuple[EffectParameter, ...]
    separating_trial: str
    at_rest: AtRest
    confusable: tuple[str, ...] = ()
    group: str = ""
    scope: str = "axis"
    needs: frozenset[str] = frozenset()
    plant: Mechanism = NEUTRAL
    chains: Chains = NO_CHAINS
    form: str = ""
    remedy: str = ""
    indistinguishable: bool = False

    def __post_init__(self) -> None:
        if not self.group:
            object.__setattr__(self, "group", self.name)

    @property
    def label(self) -> str:
        """Name and form, which together are unique: ``slack soft``."""
        return f"{self.name} {self.form.strip('_')}".strip()

    @property
    def only_seen(self) -> bool:
        """Return whether simulations go as without it: it changes nothing but what the sensors show of them."""
        return self.plant is NEUTRAL and self.chains.input is None and self.chains.observation is None

    @property
    def exported(self) -> str:
        """Return what an exported model holds of it: `NATIVE`, `PLANNED` or `CHAIN`."""
        if self.chains.of_measurement:
            return CHAIN
        return PLANNED if self.plant.planned else NATIVE

    @property
    def kinds(self) -> tuple[str, ...]:
        """Kinds or names of the free-form families that it is a special case of; empty where no family holds it."""
        return self.plant.kinds + self.chains.kinds

    def fits(self, system: System) -> bool:
        """Return whether a system offers what the effect needs."""
        return self.needs <= system.offers

    def places(self, system: System) -> list[Where]:
        """Return all places where it can act in a system; none where the system lacks what it needs."""
        if not self.fits(system):
            return []
        axes = range(len(system.axes))
        if self.scope == "turn":
            return [self.place(system, (axis,)) for axis in axes if system.axes[axis].rotational]
        if self.scope == "side":
            return [self.place(system, (axis,), side) for axis in axes for side in (1, -1)]
        if self.scope == "joint":
            held = [joint.name for joint in system.machine if joint.impedance is not None]
            return [replace(self.place(system), machine_joint=name) for name in held]
        if self.scope == "pair":
            return [self.place(system, pair) for pair in combinations(axes, 2)]
        return (
            [self.place(system, (axis,)) for axis in axes] if self.scope == "axis" else [self.place(system)]
        )

    def place(self, system: System, axes: tuple[int, ...] = (), side: int = 0) -> Where:
        """Return one place of this effect."""
        return Where(system, axes, side, self.form, self.name)


@dataclass(frozen=True)
class Placed:
    """An effect at a place, with the scales that make searched numbers SI values."""

    effect: Effect
    where: Where
    scales: Scales = field(repr=False)

    @property
    def key(self) -> str:
        """Name of effect and place: ``slack ty``."""
        return f"{self.effect.name} {self.where.tag}".strip()

    @property
    def axes(self) -> list[str]:
        """Names of the axes it acts on."""
        return self.where.axis_names

    def _scale(self) -> np.ndarray:
        axis = self.where.axes[0] if self.where.axes else 0
        if len(self.where.axes) == 2:
            a, b = self.where.axes
            return np.array(
                [
                    np.sqrt(abs(p.scale(self.scales, a) * p.scale(self.scales, b)))
                    for p in self.effect.parameters
                ]
            )
        return np.array([p.scale(self.scales, axis) for p in self.effect.parameters])

    def values(self, x: np.ndarray) -> np.ndarray:
        """SI values (m, p) of searched numbers (m, p)."""
        log = np.array([p.log for p in self.effect.parameters], dtype=bool)
        return np.asarray(np.where(log, np.exp(np.where(log, x, 0.0)), x) * self._scale())

    def searched(self, values: np.ndarray) -> np.ndarray:
        """Searched numbers (m, p) of SI values (m, p), the inverse of `values`."""
        log = np.array([p.log for p in self.effect.parameters], dtype=bool)
        units = values / self._scale()
        return np.asarray(np.where(log, np.log(np.where(log, units, 1.0)), units))

    def of_trial(self, *, held_out: bool) -> np.ndarray:
        """Return which of the parameters (p,) belong to the fitted trial, or to the held-out one."""
        here = ("", "held out" if held_out else "fitted")
        return np.array([p.trial in here for p in self.effect.parameters], dtype=bool)

    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """Bounds (p,) of the searched numbers."""
        pairs = [(p.searched(p.lower), p.searched(p.upper)) for p in self.effect.parameters]
        lower, upper = np.array(pairs, dtype=float).reshape(-1, 2).T
        return lower, upper

    def starts(self) -> np.ndarray:
        """Starting points (s, p) of the searched numbers."""
        count = max((len(p.starts) for p in self.effect.parameters), default=1)
        rows = [
            [p.searched(p.starts[min(i, len(p.starts) - 1)]) for p in self.effect.parameters]
            for i in range(count)
        ]
        return np.array(rows, dtype=float)

    def at_rest(self) -> np.ndarray:
        """Searched numbers (p,) at which the effect does nothing."""
        values = self.effect.at_rest.values
        return np.array([p.searched(v) for p, v in zip(self.effect.parameters, values, strict=True)])

    def weaker(self, x: np.ndarray) -> np.ndarray:
        """Return searched numbers (p,) of a weaker effect, inside the bounds.

        A quarter of those that are no logarithms. A logarithm of an effect on an axis goes half of the way to the bound
        beyond which the effect does nothing. Others stay: filters that do next to nothing are all alike.
        """
        log = np.array([p.log for p in self.effect.parameters], dtype=bool)
        rest, (lower, upper) = self.at_rest(), self.bounds()
        vanishes = log & ((rest <= lower) | (rest >= upper)) & bool(self.where.axes)
        smaller = np.where(vanishes, (x + np.clip(rest, lower, upper)) / 2, np.where(log, x, x / 4))
        return np.clip(smaller, lower, upper)

    def prior_sd(self) -> np.ndarray:
        """Prior SD (p,) of the searched numbers, infinite for none."""
        return np.array([p.prior_sd or np.inf for p in self.effect.parameters])

    def named(self, x: np.ndarray) -> dict[str, tuple[float, str]]:
        """SI values by name, with their units, of one set of searched numbers (p,)."""
        rotational = bool(self.where.axes) and self.where.system.axes[self.where.axis].rotational
        out = {}
        for parameter, value in zip(self.effect.parameters, self.values(x[None])[0], strict=True):
            place = f"_{self.where.tag}" if self.where.axes else ""
            unit = parameter.unit_for(rotational=rotational)
            suffix = (
                "" if unit == "1" else "_" + unit.replace("/", "_per_").replace("^", "").replace(" ", "_")
            )
            out[f"{parameter.name}{place}{suffix}"] = (float(value), unit)
        return out


def seconds(scales: Scales, axis: int) -> float:
    """Return the unit of a time: one second at the pace of a person [s]."""
    return 1 / scales.pace


def hertz(scales: Scales, axis: int) -> float:
    """Return the unit of a frequency: one hertz at the pace of a person [Hz]."""
    return scales.pace


def loads(scales: Scales, axis: int) -> float:
    """Return the unit of masses in kilograms: 1 of a person's strap."""
    return scales.load


def load_inertias(scales: Scales, axis: int) -> float:
    """Return the unit of inertias in kg m^2: 1 of a person's strap."""
    return scales.load_inertia


def excursion(scales: Scales, axis: int) -> float:
    """Scale of lengths: a large excursion of the axis."""
    return float(scales.q[axis])


def per_excursion(scales: Scales, axis: int) -> float:
    """Scale of inverse lengths."""
    return float(1 / scales.q[axis])


def rate(scales: Scales, axis: int) -> float:
    """Scale of rates: a large rate of the axis."""
    return float(scales.v[axis])


def interface_force(scales: Scales, axis: int) -> float:
    """Scale of forces: that of the plain interface in a large excursion."""
    return float(scales.force[axis])


def stiffness(scales: Scales, axis: int) -> float:
    """Scale of stiffness: that of the plain fit."""
    return float(scales.k[axis])


def damping(scales: Scales, axis: int) -> float:
    """Scale of damping: that of the plain fit."""
    return float(scales.d[axis])


def quadratic_stiffness(scales: Scales, axis: int) -> float:
    """Scale of a force by the square of an excursion."""
    return float(scales.k[axis] / scales.q[axis])


def cubic_stiffness(scales: Scales, axis: int) -> float:
    """Scale of a force by the cube of an excursion."""
    return float(scales.k[axis] / scales.q[axis] ** 2)


def quadratic_damping(scales: Scales, axis: int) -> float:
    """Scale of a force by the square of a rate."""
    return float(scales.d[axis] / scales.v[axis])


def near_zero(name: str, unit: str, sd: float, bound: float) -> EffectParameter:
    """Return a parameter that is held near zero by a prior of this SD, between minus and plus ``bound``."""
    return EffectParameter(name, unit, -bound, bound, (0.0,), prior_sd=sd)


def add_tendon(spec: mujoco.MjSpec, name: str, joints: dict[str, float], **attributes: Any) -> None:
    """Add a fixed tendon over joints with coefficients to the plant; ``attributes`` are MuJoCo's."""
    tendon = spec.add_tendon(name=name, **attributes)
    for joint, coefficient in joints.items():
        tendon.wrap_joint(joint, coefficient)


def add_branch(spec: mujoco.MjSpec, name: str, joint: str) -> None:
    """Add a spring and a damper in series on a joint, at rest where that is zero."""
    body = spec.worldbody.add_body(
        name=name, mass=1e-6, inertia=[1e-9] * 3, explicitinertial=True, gravcomp=1
    )
    body.add_joint(name=name, type=mujoco.mjtJoint.mjJNT_SLIDE, axis=[1, 0, 0], damping=[1, 0, 0])
    add_tendon(spec, name, {joint: 1.0, name: -1.0}, stiffness=[1, 0, 0], springlength=[0, 0])


def set_branch(fields: Fields, name: str, stiffness: np.ndarray, time_constant: np.ndarray) -> None:
    """Write values (m,) of a branch. The slide needs no inertia: its damping is implicit."""
    fields["tendon_stiffness"][:, fields.tendon(name)] = stiffness
    fields["dof_damping"][:, int(fields.model.joint(name).dofadr[0])] = stiffness * time_constant
