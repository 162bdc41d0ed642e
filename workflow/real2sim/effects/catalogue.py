"""Effects that the plain plant leaves out, as declarative entries: what they are and how the simulation gets them.

Each entry of `EFFECTS` names an effect of the sim-to-real gap, its stage, equation, free parameters with units and
bounds, the effects it is confused with and the trial that would tell them apart. How it acts is one of a few mechanisms
(`coupling.mechanisms`), or a change of what goes in and comes out (`coupling.chains`). Adding an effect is one entry.

Parameters are searched without dimension: an SI value is the searched number times a scale that comes from the trial
(`Scales`), so that bounds and starts hold for millimetres and for radians.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from itertools import combinations

import numpy as np

from real2sim.effects import chains
from real2sim.effects.base import Mechanism, Scales, Where
from real2sim.effects.chains import Context, OffCentre, OnStrap, RestTurned, Retaped, Sighting, TurnedLab
from real2sim.effects.controller import Admittance, HoldIntegral, Reaction
from real2sim.effects.frames import Coupling, RestShift, TurnedAxes, TurnedBack, TurnedLaw
from real2sim.effects.friction import Bristles, DryFriction, SmoothFriction, UnevenFriction
from real2sim.effects.memory import BoucWen, Elastoplastic, FlowingMaxwell, Maxwell, TwoTimes
from real2sim.effects.planned import (
    AnsweringForce,
    HangingMass,
    LooseDamper,
    OffCentreMass,
    PlannedForce,
    StandingForce,
)
from real2sim.effects.robot import (
    Bending,
    InterfaceMass,
    RobotImpedance,
    RobotRelaxation,
    Rocking,
    SlackBeyondWheels,
    YieldBeyondWheels,
)
from real2sim.effects.springs import (
    EvenSpring,
    ExponentialSpring,
    GentleStop,
    GentleStops,
    OneSided,
    Polynomial,
    SoftDeadBand,
    SplitSpring,
    Stop,
)
from real2sim.geometry import AXES, PELVIS_MARKERS
from real2sim.system.plant import ROBOT_JOINTS

TRANSLATIONAL = AXES[:3]


@dataclass(frozen=True)
class EffectParameter:
    """One free parameter: searched between ``lower`` and ``upper`` (in units of ``scale``), from each of ``starts``.

    ``log`` searches the logarithm. ``scale`` maps scales and axis index to the SI value of 1; ``unit`` is the unit for
    a translation, with the one for a rotation after a bar where it differs. ``prior_sd`` (of the searched number)
    holds linear nuisance-like parameters near 0.
    """

    name: str
    unit: str
    lower: float
    upper: float
    starts: tuple[float, ...]
    scale: Callable[[Scales, int], float] = lambda scales, axis: 1.0
    log: bool = False
    prior_sd: float | None = None

    def unit_for(self, axis: str | None) -> str:
        """Unit for an axis of the interface; None where the effect has none."""
        both = self.unit.split("|")
        return both[-1] if axis is not None and axis not in TRANSLATIONAL else both[0]


@dataclass(frozen=True)
class Effect:
    """One entry of the catalogue; ``plant``, ``input_chain``, ``output_chain`` and ``sighting`` say how it acts.

    ``scope`` is "axis", "turn" (one of the rotations), "side" (axis and direction), "pair" (of axes) or "whole";
    ``forms`` names variants with other equations for the same name. ``input_chain`` maps values (p,) and context to a
    pelvis path; ``output_chain`` maps simulated paths (m, n, 2, 3), values (m, p) and context to paths; ``sighting``
    sets the plant up otherwise and says what its markers show; ``skin`` maps values (p,) and context to ways
    (n, 4, 3) [m, pelvis] of the pelvis' markers over the bone, which the markers themselves may contradict.
    ``remedy`` says what to do about an effect that cannot be part of a model: chains and planned forces have one.
    ``per_trial``: each trial has its own values; the first half of the parameters is the fitted trial's, the second
    half the held-out one's, and all that acts gets one half.
    """

    name: str
    stage: str
    equation: str
    parameters: tuple[EffectParameter, ...]
    group: str
    separating_trial: str
    scope: str = "axis"
    plant: Mechanism | None = None
    input_chain: Callable[[np.ndarray, Context], tuple[np.ndarray, np.ndarray]] | None = None
    output_chain: Callable[[np.ndarray, np.ndarray, Context], np.ndarray] | None = None
    log_chain: Callable[[np.ndarray, np.ndarray, Context], np.ndarray] | None = None
    sighting: Sighting | None = None
    skin: Callable[[np.ndarray, Context], np.ndarray] | None = None
    form: str = ""
    replaces_spring: bool = False
    substeps: int = 1
    remedy: str = ""
    per_trial: bool = False

    def places(self) -> list[Where]:
        """Everywhere that it can act."""
        if self.scope == "axis":
            return [Where((axis,), 0, self.form, self.name) for axis in range(6)]
        if self.scope == "turn":
            return [Where((axis,), 0, self.form, self.name) for axis in range(3, 6)]
        if self.scope == "side":
            return [Where((axis,), side, self.form, self.name) for axis in range(6) for side in (1, -1)]
        if self.scope == "pair":
            return [Where(pair, 0, self.form, self.name) for pair in combinations(range(6), 2)]
        return [Where((), 0, self.form, self.name)]


@dataclass(frozen=True)
class Placed:
    """An effect at a place, with what turns searched numbers into SI values."""

    effect: Effect
    where: Where
    scales: Scales = field(repr=False)

    @property
    def key(self) -> str:
        """Name of effect and place: ``slack ty``."""
        return f"{self.effect.name} {self.where.tag}".strip()

    @property
    def axes(self) -> list[str]:
        """Axes it acts on."""
        return [AXES[a] for a in self.where.axes]

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
        return np.where(log, np.exp(np.where(log, x, 0.0)), x) * self._scale()

    def of_trial(self, *, held_out: bool) -> np.ndarray:
        """Which of the parameters (p,) say something of the fitted trial, or of the held-out one."""
        p = len(self.effect.parameters)
        second = np.arange(p) >= p // 2
        return second == held_out if self.effect.per_trial else np.ones(p, bool)

    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """Bounds (p,) of the searched numbers."""
        pairs = [
            (np.log(p.lower), np.log(p.upper)) if p.log else (p.lower, p.upper)
            for p in self.effect.parameters
        ]
        lower, upper = np.array(pairs, dtype=float).reshape(-1, 2).T
        return lower, upper

    def starts(self) -> np.ndarray:
        """Starting points (s, p) of the searched numbers."""
        count = max((len(p.starts) for p in self.effect.parameters), default=1)
        rows = [
            [
                np.log(p.starts[min(i, len(p.starts) - 1)]) if p.log else p.starts[min(i, len(p.starts) - 1)]
                for p in self.effect.parameters
            ]
            for i in range(count)
        ]
        return np.array(rows, dtype=float)

    def weaker(self, x: np.ndarray) -> np.ndarray:
        """A quarter of the searched numbers (p,) that are no logarithms, inside the bounds."""
        log = np.array([p.log for p in self.effect.parameters], dtype=bool)
        return np.clip(np.where(log, x, x / 4), *self.bounds())

    def prior_sd(self) -> np.ndarray:
        """Prior SD (p,) of the searched numbers, infinite for none."""
        return np.array([p.prior_sd or np.inf for p in self.effect.parameters])

    def named(self, x: np.ndarray) -> dict[str, tuple[float, str]]:
        """SI values by name, with their units, of one set of searched numbers (p,)."""
        axis = AXES[self.where.axes[0]] if self.where.axes else None
        out = {}
        for parameter, value in zip(self.effect.parameters, self.values(x[None])[0], strict=True):
            place = f"_{self.where.tag}" if self.where.axes else ""
            unit = parameter.unit_for(axis)
            suffix = (
                "" if unit == "1" else "_" + unit.replace("/", "_per_").replace("^", "").replace(" ", "_")
            )
            out[f"{parameter.name}{place}{suffix}"] = (float(value), unit)
        return out


def _q(scales: Scales, axis: int) -> float:
    return float(scales.q[axis])


def _per_q(scales: Scales, axis: int) -> float:
    return float(1 / scales.q[axis])


def _force(scales: Scales, axis: int) -> float:
    return float(scales.force[axis])


def _k(scales: Scales, axis: int) -> float:
    return float(scales.k[axis])


def _d(scales: Scales, axis: int) -> float:
    return float(scales.d[axis])


def _half(values: np.ndarray) -> np.ndarray:
    return values[:, 0] / 2


def _linear(name: str, unit: str, sd: float, bound: float) -> EffectParameter:
    return EffectParameter(name, unit, -bound, bound, (0.0,), prior_sd=sd)


_LADDER = "one motion at three amplitudes, from smaller than the slack upward"
_WINDOW = EffectParameter("window", "s", 0.02, 0.6, (0.08,), log=True)
_SPEEDS = "the same amplitude at three speeds"
_HOLDS = "steps with holds of 5-10 s"
_JERK = "one sharp jerk at the start and at the end, seen by all systems"
_STAND = "quiet standing at three headings before and after"
_SLOPING_FLOOR = "Add to base_x and base_y a constant force: slope times 9.81 m/s2 times the robot's mass"
_SINGLE = "motions along one axis at a time"
_MASS = "the same motion with a plate of known mass on the interface"

# An axis that hardly slips is fitted as a stiff one, and friction beyond its force in the plain fit holds it
_FRICTION = EffectParameter("force", "N|Nm", 0.002, 15.0, (0.05, 0.3), _force, log=True)

_TURN = tuple(_linear(f"turn_{axis}", "rad", 0.2, 0.6) for axis in "xyz")

_SKIN = (
    *(_linear(f"shift_{a}_by_r{b}", "m/rad", 0.03, 0.3) for a in "xyz" for b in "xyz"),
    *(_linear(f"turn_{a}_by_r{b}", "rad/rad", 0.1, 1.5) for a in "xyz" for b in "xyz"),
)
_BONE = (
    "solve R = R0 R_z R_y R_x(v) exp(turn v) for the Cardan angles v, R its rotation and R0 that at the start (Newton,"
    " with the slope 1 + turn); the bone is turned by B = R0 R_z R_y R_x(v), and its position is the pelvis' less"
    " B (shift v)"
)

EFFECTS: tuple[Effect, ...] = (
    Effect(
        "slack",
        "interface",
        "F = k sgn(q) max(|q| - w, 0)",
        (EffectParameter("half_width", "m|rad", 0.01, 1.2, (0.15, 0.5), _q, log=True),),
        "A",
        _LADDER,
        plant=SplitSpring(lambda v, where: (-v[:, 0], v[:, 0], 1.0, 1.0)),
        replaces_spring=True,
    ),
    Effect(
        "slack",
        "interface",
        "F = k sgn(q) mean of max(|q| - w_i, 0), w_i = w (1 - s), w, w (1 + s): the load is taken up little by little",
        (
            EffectParameter("half_width", "m|rad", 0.02, 1.2, (0.3,), _q, log=True),
            EffectParameter("softness", "1", 0.1, 1.0, (0.5,)),
        ),
        "A",
        _LADDER,
        plant=SoftDeadBand(),
        form="_soft",
        replaces_spring=True,
    ),
    Effect(
        "slack",
        "interface",
        "as slack; inside, the strap does not damp either",
        (EffectParameter("half_width", "m|rad", 0.01, 1.2, (0.1, 0.4), _q, log=True),),
        "A",
        _LADDER,
        plant=LooseDamper(
            SplitSpring(lambda v, where: (-v[:, 0], v[:, 0], 1.0, 1.0)),
            lambda v, q, side: np.abs(q) > v,
            lambda v: np.zeros(len(v)),
        ),
        form="_undamped",
        remedy="Let the strap's joint damp only beyond half_width",
        replaces_spring=True,
    ),
    Effect(
        "one_sided",
        "interface",
        "F = k ((1 - s) q + s max(q - q0, 0)), or its mirror image: a share of the strap pulls to one side alone",
        (
            # from zero on it would be asymmetric_stiffness by another name
            EffectParameter("engages_at", "m|rad", 0.03, 0.5, (0.06,), _q),
            EffectParameter("share", "1", 0.05, 1.0, (0.5, 0.9)),
        ),
        "S",
        _LADDER,
        scope="side",
        plant=OneSided(),
        replaces_spring=True,
    ),
    Effect(
        "one_sided",
        "interface",
        "as one_sided; where that share of the strap is loose it does not damp either",
        (
            EffectParameter("engages_at", "m|rad", -0.05, 0.5, (0.03,), _q),
            EffectParameter("share", "1", 0.05, 1.0, (0.4, 0.8)),
        ),
        "S",
        _LADDER,
        scope="side",
        plant=LooseDamper(
            OneSided(),
            lambda v, q, side: 1 - v[:, 1:] * (side * q < v[:, :1]),
            lambda v: 1 - v[:, 1],
        ),
        form="_undamped",
        remedy="Scale the damping of the strap's joint by 1 - share while it is on the loose side",
        replaces_spring=True,
    ),
    Effect(
        "stiffening",
        "interface",
        "F = k q + c q^3",
        (
            EffectParameter(
                "cubic", "N/m3|Nm/rad3", 0.0, 30.0, (0.5, 3.0), lambda s, i: float(s.k[i] / s.q[i] ** 2)
            ),
        ),
        "A",
        _LADDER,
        plant=Polynomial("jnt_stiffnesspoly", 1),
    ),
    Effect(
        "stiffening",
        "interface",
        "F = k L ((1 - toe) sinh(|q| / L) + toe (exp(|q| / L) - 1)) sgn q",
        (
            EffectParameter("length", "m|rad", 0.12, 5.0, (0.4, 1.0), _q, log=True),
            EffectParameter("toe", "1", 0.0, 1.0, (0.3,)),
        ),
        "A",
        _LADDER,
        plant=ExponentialSpring(),
        form="_exponential",
    ),
    Effect(
        "asymmetric_stiffness",
        "interface",
        "F = k (1 + b sgn(q)) q",
        (
            # a side that carries a tenth of the other or less is loose: one_sided
            EffectParameter("asymmetry", "1", -0.8, 0.8, (-0.4, 0.4)),
        ),
        "asymmetric_stiffness",
        _LADDER,
        plant=SplitSpring(lambda v, where: (0.0 * v[:, 0], 0.0 * v[:, 0], 1 - v[:, 0], 1 + v[:, 0])),
        replaces_spring=True,
    ),
    Effect(
        "asymmetric_stiffness",
        "interface",
        "F = k q + b q^2, b q^2 along its tangent beyond a coordinate on either side",
        (
            EffectParameter(
                "quadratic", "N/m2|Nm/rad2", -0.6, 0.6, (-0.2, 0.2), lambda s, i: float(s.k[i] / s.q[i])
            ),
            EffectParameter("straight_beyond", "m|rad", 0.3, 4.0, (1.0,), _q, log=True),
        ),
        "asymmetric_stiffness",
        _LADDER,
        plant=EvenSpring(),
        form="_quadratic",
    ),
    Effect(
        "coulomb",
        "interface",
        "F = Fc sgn(qdot)",
        (_FRICTION,),
        "V",
        "slow ramps and reversals at several speeds",
        plant=DryFriction(),
    ),
    Effect(
        "coulomb",
        "interface",
        "F = Fc (1 + uneven sgn(qdot)) sgn(qdot)",
        (_FRICTION, EffectParameter("uneven", "1", -0.95, 0.95, (0.0,))),
        "V",
        "slow ramps and reversals at several speeds",
        plant=UnevenFriction(),
        form="_uneven",
    ),
    Effect(
        "coulomb",
        "interface",
        "F = Fc tanh(qdot / rate): friction that fades towards standstill",
        (
            _FRICTION,
            EffectParameter("rate", "m/s|rad/s", 0.003, 1.0, (0.05,), lambda s, i: float(s.v[i]), log=True),
        ),
        "V",
        "slow ramps and reversals at several speeds",
        plant=SmoothFriction(),
        substeps=4,
        form="_smooth",
    ),
    Effect(
        "lugre",
        "interface",
        "F = s0 z, zdot = v - s0 |v| z / (Fc + (Fs - Fc) exp(-(v/vs)^2))",
        (
            _FRICTION,
            EffectParameter("static_excess", "1", 0.05, 2.0, (0.5,)),
            EffectParameter("deflection", "m|rad", 0.005, 0.2, (0.03,), _q, log=True),
            EffectParameter(
                "stribeck_rate", "m/s|rad/s", 0.01, 1.0, (0.1,), lambda s, i: float(s.v[i]), log=True
            ),
        ),
        "lugre",
        "sub-millimetre reversals and a ladder of speeds",
        plant=Bristles(),
        substeps=4,
    ),
    Effect(
        "hysteresis",
        "interface",
        "springs beside the strap's own that yield one after the other (Maxwell slip)",
        (
            _FRICTION,
            EffectParameter("travel", "m|rad", 0.04, 2.0, (0.1, 0.5), _q, log=True),
        ),
        "hysteresis",
        "the same amplitude at 0.1, 1 and 4 Hz",
        plant=Elastoplastic(4),
    ),
    Effect(
        "hysteresis",
        "interface",
        "F = z, z' = k qdot - b |qdot| z - g qdot |z|, loading = b + g, dissipation = b (Bouc-Wen, exponent 1)",
        (
            EffectParameter("stiffness", "N/m|Nm/rad", 0.02, 50.0, (0.5, 0.6), _k, log=True),
            EffectParameter("loading", "1/m|1/rad", -1.5, 25.0, (10.0, 2.0), _per_q),
            EffectParameter("dissipation", "1/m|1/rad", 0.0, 12.5, (3.0, 0.6), _per_q),
        ),
        "hysteresis",
        "the same amplitude at 0.1, 1 and 4 Hz",
        plant=BoucWen(8),
        form="_bouc_wen",
        remedy=(
            "Take out the yielding springs of this effect, which stand for most of it, and add a force -z to the strap"
            " joint, z stepped with the rate qdot by the equation, from z = 0"
        ),
    ),
    Effect(
        "relaxation",
        "interface",
        "F1' = k1 qdot - F1 / tau beside the strap's own spring",
        (
            EffectParameter("stiffness", "N/m|Nm/rad", 0.02, 30.0, (0.5, 3.0), _k, log=True),
            EffectParameter("time_constant", "s", 0.03, 2.5, (0.4, 0.1), log=True),
        ),
        "V",
        _HOLDS,
        plant=Maxwell(),
    ),
    Effect(
        "relaxation",
        "interface",
        "as relaxation, with two time constants",
        (
            EffectParameter("stiffness", "N/m|Nm/rad", 0.02, 30.0, (0.5, 3.0), _k, log=True),
            EffectParameter("slower_share", "1", 0.05, 0.95, (0.5,)),
            EffectParameter("faster_time_constant", "s", 0.03, 0.6, (0.1,), log=True),
            EffectParameter("ratio", "1", 3.0, 40.0, (10.0,), log=True),
        ),
        "V",
        _HOLDS,
        plant=TwoTimes(),
        form="_two_times",
    ),
    Effect(
        "relaxation",
        "interface",
        "F1 = k1 e, e' = qdot - r sinh(e / length), r = 2 length / (time_constant sinh 2): an Eyring dashpot",
        (
            # stiffer and shorter it would be friction by another name
            EffectParameter("stiffness", "N/m|Nm/rad", 0.02, 8.0, (0.5, 3.0), _k, log=True),
            EffectParameter("time_constant", "s", 0.03, 2.5, (0.4, 0.1), log=True),
            EffectParameter("length", "m|rad", 0.12, 3.0, (0.3,), _q, log=True),
        ),
        "V",
        _HOLDS,
        plant=FlowingMaxwell(),
        form="_flow",
        remedy=(
            "Add to the strap's joint the force of a linear branch of this stiffness and time constant less that of the"
            " equation, both along its coordinate (the branch itself is in the model)"
        ),
    ),
    Effect(
        "creep",
        "interface",
        "as relaxation, with a time constant of many seconds",
        (
            EffectParameter("stiffness", "N/m|Nm/rad", 0.02, 10.0, (0.5,), _k, log=True),
            EffectParameter("time_constant", "s", 2.5, 60.0, (6.0,), log=True),
        ),
        "creep",
        "reload after a rest",
        plant=Maxwell(),
    ),
    Effect(
        "creep",
        "interface",
        "as relaxation, by the logarithm of time: four branches, each four times as slow as the one before",
        (
            EffectParameter("stiffness", "N/m|Nm/rad", 0.02, 10.0, (0.5,), _k, log=True),
            EffectParameter("shortest_time_constant", "s", 0.3, 5.0, (1.0,), log=True),
        ),
        "creep",
        "reload after a rest",
        plant=Maxwell(4, 4.0),
        form="_log_time",
    ),
    Effect(
        "migration",
        "interface",
        "F = k (q - r), r' = c max(q - r - w, 0): beyond a threshold the rest pose follows, and stays",
        (
            EffectParameter("threshold", "m|rad", 0.02, 1.3, (0.6, 0.25), _q, log=True),
            EffectParameter("rate", "1/s", 0.02, 50.0, (1.0, 1.0), log=True),
        ),
        "Dft",
        _STAND,
        scope="side",
        plant=PlannedForce(chains.ratchet),
        remedy=(
            "Add a force k r to the strap joint on its side, k its stiffness: r follows q - threshold at the rate"
            " while the strap is beyond it, and never returns"
        ),
    ),
    Effect(
        "migration",
        "interface",
        "F = k (q - c t): the rest pose wanders at one rate from where the person starts to move",
        (EffectParameter("rate", "m/s|rad/s", -0.3, 0.3, (-0.03, 0.03), _q),),
        "Dft",
        _STAND,
        plant=PlannedForce(chains.wandering),
        form="_steady",
        remedy="Add a force k rate t to the strap joint, k its stiffness, t from where the person starts to move",
    ),
    Effect(
        "migration",
        "interface",
        "F = k (q - a (1 - exp(-t / tau))): the rest pose goes over to another from where the person starts to move",
        (
            EffectParameter("way", "m|rad", -1.0, 1.0, (-0.2, 0.2), _q),
            EffectParameter("time_constant", "s", 0.5, 10.0, (3.0,), log=True),
        ),
        "Dft",
        _STAND,
        plant=PlannedForce(chains.settling),
        form="_settling",
        remedy=(
            "Add a force k way (1 - exp(-t / time_constant)) to the strap joint, k its stiffness, t from where the"
            " person starts to move"
        ),
    ),
    Effect(
        "cross_coupling",
        "interface",
        "F_i = K_ij q_j, F_j = K_ij q_i",
        (EffectParameter("stiffness", "SI", -0.9, 0.9, (-0.15, 0.15), _k),),
        "F",
        _SINGLE,
        scope="pair",
        plant=Coupling("tendon_stiffness"),
        form="_elastic",
    ),
    Effect(
        "cross_coupling",
        "interface",
        "F_i = D_ij qdot_j, F_j = D_ij qdot_i",
        (EffectParameter("damping", "SI", -0.9, 0.9, (-0.15, 0.15), _d),),
        "F",
        _SINGLE,
        scope="pair",
        plant=Coupling("tendon_damping"),
        form="_viscous",
    ),
    Effect(
        "misalignment",
        "interface",
        "interface axes turned by a rotation vector",
        _TURN,
        "F",
        _SINGLE,
        scope="whole",
        plant=TurnedAxes(),
    ),
    Effect(
        "misalignment",
        "interface",
        "F = R K R' q + R D R' qdot: stiffness and damping turned by a rotation vector, the coordinates as they are",
        _TURN,
        "F",
        _SINGLE,
        scope="whole",
        plant=TurnedLaw(),
        form="law",
    ),
    Effect(
        "preload",
        "interface",
        "F = k (q - q0)",
        (EffectParameter("rest_shift", "m|rad", -2.0, 2.0, (-0.2, 0.2), _q),),
        "S",
        _STAND,
        plant=RestShift(),
    ),
    Effect(
        "preload",
        "interface",
        "the strap rests turned about an axis, and its other axes turn with it",
        (EffectParameter("rest_turn", "rad", -2.0, 2.0, (-0.2, 0.2), _q),),
        "S",
        _STAND,
        scope="turn",
        sighting=RestTurned(),
        form="_turned",
    ),
    Effect(
        "joint_limit",
        "interface",
        "a stop inside the range that the limits allow: a spring and a damper that only push",
        (
            EffectParameter("place", "m|rad", 0.3, 1.2, (0.6, 0.85), _q, log=True),
            EffectParameter("stiffness", "N/m|Nm/rad", 1.0, 5000.0, (8.0,), _k, log=True),
            EffectParameter("damping_ratio", "1", 0.0, 1.0, (0.1,)),
        ),
        "A",
        "a slow ramp into the stop",
        scope="side",
        plant=Stop(),
    ),
    Effect(
        "joint_limit",
        "interface",
        "F = k q + c (q - place)^2 beyond a place, or its mirror image: a stop that begins gently",
        (
            EffectParameter("place", "m|rad", 0.05, 1.2, (0.4,), _q, log=True),
            EffectParameter(
                "curvature",
                "N/m2|Nm/rad2",
                0.5,
                2000.0,
                (10.0,),
                lambda s, i: float(s.k[i] / s.q[i]),
                log=True,
            ),
        ),
        "A",
        "a slow ramp into the stop",
        scope="side",
        plant=GentleStop(),
        form="_gentle",
    ),
    Effect(
        "joint_limit",
        "interface",
        "F = k q + c (|q| - clearance)^3 sgn(q) beyond the clearance: stops on both sides that begin gently",
        (
            EffectParameter("clearance", "m|rad", 0.05, 1.0, (0.4,), _q, log=True),
            EffectParameter(
                "cubic",
                "N/m3|Nm/rad3",
                0.5,
                5000.0,
                (10.0,),
                lambda s, i: float(s.k[i] / s.q[i] ** 2),
                log=True,
            ),
        ),
        "A",
        "a slow ramp into the stop",
        plant=GentleStops(),
        form="_clearance",
    ),
    Effect(
        "quadratic_damping",
        "interface",
        "F = d qdot + d2 qdot |qdot|",
        (
            EffectParameter(
                "quadratic", "Ns2/m2|Nms2/rad2", 0.0, 30.0, (0.5, 3.0), lambda s, i: float(s.d[i] / s.v[i])
            ),
        ),
        "V",
        _SPEEDS,
        plant=Polynomial("dof_dampingpoly", 0),
    ),
    Effect(
        "added_mass",
        "robot",
        "the interface is heavier than the twin's",
        (
            EffectParameter("mass", "kg", -2.0, 40.0, (2.0,)),
            EffectParameter("inertia", "kgm2", -0.02, 2.0, (0.02,)),
        ),
        "M",
        _MASS,
        scope="whole",
        plant=InterfaceMass(),
    ),
    Effect(
        "added_mass",
        "robot",
        "the interface is heavier than the twin's, and its weight hangs from the arm, in the neutral trial as well",
        (
            EffectParameter("mass", "kg", -2.0, 40.0, (2.0,)),
            EffectParameter("inertia", "kgm2", -0.02, 2.0, (0.02,)),
        ),
        "M",
        _MASS,
        scope="whole",
        plant=HangingMass(chains.weight, ROBOT_JOINTS[3:4]),
        form="hanging",
        remedy="Push the arm's lift down by 9.81 m/s2 times the mass, which is part of this model",
    ),
    Effect(
        "added_mass",
        "robot",
        "a part sits on the interface off its centre, in the neutral trial as well: the lift balances some of its"
        " weight, nothing its moments",
        (
            EffectParameter("mass", "kg", -2.0, 40.0, (2.0,)),
            EffectParameter("inertia", "kgm2", -0.02, 2.0, (0.02,)),
            *(EffectParameter(f"moment_{c}", "kgm", -3.0, 3.0, (0.0,)) for c in "xyz"),
            EffectParameter("unbalanced", "kg", -2.0, 40.0, (0.0,)),
        ),
        "M",
        _MASS,
        scope="whole",
        plant=OffCentreMass(chains.moments, ROBOT_JOINTS[3:]),
        form="off_centre",
        remedy=(
            "Push the arm's lift down by 9.81 m/s2 times the unbalanced mass, and turn its roll and pitch by 9.81 m/s2"
            " times the mass' moments about the arm"
        ),
    ),
    Effect(
        "base_compliance",
        "robot",
        "the base yields other than configured",
        tuple(
            EffectParameter(f"ln_{what}_{axis}", "1", -3.0, 3.0, (-0.3,), prior_sd=1.0)
            for axis in ("x", "y", "yaw")
            for what in ("stiffness", "damping")
        ),
        "M",
        "the robot's own log, brakes on against brakes off",
        scope="whole",
        plant=RobotImpedance(ROBOT_JOINTS[:3]),
    ),
    Effect(
        "base_compliance",
        "robot",
        "the base yields behind its servo: springs and dampers in series beside the configured impedance",
        (
            *(
                EffectParameter(f"ln_series_stiffness_{axis}", "1", -5.0, 4.0, (-1.0,), prior_sd=2.0)
                for axis in ("x", "y", "yaw")
            ),
            EffectParameter("time_constant", "s", 0.03, 5.0, (0.3,), log=True),
        ),
        "M",
        "the robot's own log, brakes on against brakes off",
        scope="whole",
        plant=RobotRelaxation(ROBOT_JOINTS[:3]),
        form="series",
    ),
    Effect(
        "base_compliance",
        "robot",
        "the base yields beyond its wheels, unseen by their odometry: a spring in series with the configured impedance",
        tuple(
            EffectParameter(f"ln_stiffness_{axis}", "1", -2.0, 4.0, (1.0,), prior_sd=2.0)
            for axis in ("x", "y", "yaw")
        ),
        "M",
        "the robot's own log, brakes on against brakes off",
        scope="whole",
        plant=YieldBeyondWheels(ROBOT_JOINTS[:3]),
        form="beyond_wheels",
    ),
    Effect(
        "base_compliance",
        "robot",
        "the base has play beyond its wheels, unseen by their odometry: a spring with a dead band in series",
        (
            *(
                EffectParameter(f"ln_stiffness_{axis}", "1", -1.0, 6.0, (3.0,), prior_sd=3.0)
                for axis in ("x", "y", "yaw")
            ),
            *(
                EffectParameter(f"half_play_{axis}", "m", 2e-4, 0.05, (0.003,), log=True)
                for axis in ("x", "y")
            ),
            EffectParameter("half_play_yaw", "rad", 2e-4, 0.1, (0.006,), log=True),
        ),
        "M",
        "the robot's own log, brakes on against brakes off",
        scope="whole",
        plant=SlackBeyondWheels(ROBOT_JOINTS[:3]),
        form="play",
    ),
    Effect(
        "base_compliance",
        "robot",
        "the robot rocks in roll and pitch on its suspension, unseen by its log: springs and dampers at the floor",
        (
            *(
                EffectParameter(f"{axis}_stiffness", "Nm/rad", 50.0, 50_000.0, (600.0,), log=True)
                for axis in ("roll", "pitch")
            ),
            EffectParameter("time_constant", "s", 0.005, 1.0, (0.1,), log=True),
            EffectParameter("inertia", "kg m2", 0.1, 50.0, (3.0,), log=True),
        ),
        "M",
        "the robot's own log, brakes on against brakes off",
        scope="whole",
        plant=Rocking(),
        form="rocking",
    ),
    Effect(
        "base_compliance",
        "robot",
        "the column that carries the arm bends along x and y, unseen by the log: springs and dampers below the arm",
        (
            *(
                EffectParameter(f"column_stiffness_{axis}", "N/m", 100.0, 100_000.0, (3_000.0,), log=True)
                for axis in ("x", "y")
            ),
            EffectParameter("time_constant", "s", 0.002, 1.0, (0.03,), log=True),
        ),
        "M",
        "the robot's own log, brakes on against brakes off",
        scope="whole",
        plant=Bending(),
        form="column",
    ),
    Effect(
        "controller_reaction",
        "robot",
        "F_base = g y, T y' = F_interaction(t - delay) - y",
        (
            EffectParameter("gain", "1", -1.5, 4.0, (-0.3, 0.3)),
            EffectParameter("delay", "s", 0.0, 0.5, (0.1, 0.02)),
            EffectParameter("smoothing", "s", 0.0, 0.5, (0.0, 0.1)),
        ),
        "controller_reaction",
        "the same motion with the controller off",
        scope="whole",
        plant=AnsweringForce(Reaction, ROBOT_JOINTS[:2]),
        remedy=(
            "Add to base_x and base_y the gain times the strap's horizontal force on the interface, delayed and passed"
            " through a low-pass of first order with the smoothing as time constant"
        ),
    ),
    Effect(
        "controller_reaction",
        "robot",
        "F_base = g y + r I, T y' = F_interaction - y, I' = y - I / leak, g and r along x and y: an admittance",
        (
            *(EffectParameter(f"gain_{axis}", "1", -1.5, 4.0, (0.3,)) for axis in "xy"),
            *(EffectParameter(f"integral_gain_{axis}", "1/s", -3.0, 6.0, (0.3,)) for axis in "xy"),
            EffectParameter("leak", "s", 0.3, 20.0, (2.0,), log=True),
            EffectParameter("smoothing", "s", 0.0, 0.5, (0.05,)),
        ),
        "controller_reaction",
        "the same motion with the controller off",
        scope="whole",
        plant=AnsweringForce(Admittance, ROBOT_JOINTS[:2]),
        form="integral",
        remedy=(
            "Add to base_x and base_y the strap's horizontal force on the interface, passed through a low-pass of first"
            " order with the smoothing as time constant, times the gain, and its leaky integral (less what it was at"
            " the start) times the integral gain"
        ),
    ),
    Effect(
        "controller_reaction",
        "robot",
        "F' = -r x on each joint of the base, x from its start, held within a limit: the integral term of the hold",
        (
            *(EffectParameter(f"rate_{axis}", "N/m/s", -300.0, 2000.0, (60.0,)) for axis in "xy"),
            EffectParameter("rate_yaw", "Nm/rad/s", -60.0, 400.0, (12.0,)),
            *(EffectParameter(f"limit_{axis}", "N", 1.0, 500.0, (30.0,), log=True) for axis in "xy"),
            EffectParameter("limit_yaw", "Nm", 0.2, 100.0, (6.0,), log=True),
        ),
        "controller_reaction",
        "the same motion with the controller off",
        scope="whole",
        plant=AnsweringForce(HoldIntegral, ROBOT_JOINTS[:3]),
        form="hold_integral",
        remedy=(
            "Take from each joint of the base its rate times the integral of where it is from its start, held within"
            " its limit"
        ),
    ),
    Effect(
        "tilt",
        "robot",
        "gravity has a component along the floor",
        tuple(EffectParameter(f"slope_{axis}", "rad", -0.1, 0.1, (0.003,)) for axis in "xy"),
        "S",
        "turning in place",
        scope="whole",
        plant=PlannedForce(chains.tilt, ROBOT_JOINTS[:2]),
        remedy=_SLOPING_FLOOR,
    ),
    Effect(
        "tilt",
        "robot",
        "gravity has a component along the floor, and had it in the neutral trial, where it stretched the strap",
        tuple(EffectParameter(f"slope_{axis}", "rad", -0.1, 0.1, (0.003,)) for axis in "xy"),
        "S",
        "turning in place",
        scope="whole",
        plant=StandingForce(chains.tilt, ROBOT_JOINTS[:2]),
        form="always",
        remedy=_SLOPING_FLOOR,
    ),
    Effect(
        "soft_tissue",
        "input",
        "pelvis markers move over the bone in proportion to its Cardan angles (x, y, z of R_z R_y R_x) from the start",
        _SKIN,
        "V",
        "a marker cluster beside the pelvis markers, quiet standing and a passive pull",
        scope="whole",
        input_chain=chains.soft_tissue,
        remedy=f"Correct the pelvis before it is replayed: {_BONE}",
    ),
    Effect(
        "soft_tissue",
        "input",
        "pelvis markers move over the bone in proportion to its Cardan angles, and follow it as masses on springs do",
        (
            *_SKIN,
            _linear("lag", "s", 0.01, 0.1),
            # skin rings at 1 to 4 Hz: what would ring faster is what the low-pass takes from the path
            EffectParameter("mobility", "s2", 0.0016, 0.025, (0.004,)),
        ),
        "V",
        "a marker cluster beside the pelvis markers, quiet standing and a passive pull",
        scope="whole",
        input_chain=chains.wobbling_tissue,
        remedy=(
            "Correct the pelvis before it is replayed: add to its pose the lag times its rate and the mobility times"
            f" its acceleration, and then: {_BONE}"
        ),
        form="wobble",
    ),
    Effect(
        "lab_yaw",
        "input",
        "pelvis and interface are seen in frames turned about the vertical",
        (EffectParameter("yaw", "rad", -0.35, 0.35, (0.03,)),),
        "F",
        "a static wand seen by both systems",
        scope="whole",
        plant=TurnedBack(),
        input_chain=chains.turned_motion,
        remedy="Turn the pelvis' markers of all trials by minus the yaw about the vertical through the lab's origin and"
        " ingest anew; the strap's axes of this model are turned with the path as it was recorded",
    ),
    Effect(
        "lab_yaw",
        "input",
        "pelvis and interface are seen in frames turned about the vertical; the robot's axes are the pelvis' frame's",
        (EffectParameter("yaw", "rad", -0.35, 0.35, (0.03,)),),
        "F",
        "a static wand seen by both systems",
        scope="whole",
        sighting=TurnedLab(),
        form="interface",
        remedy="Turn the interface's markers of all trials by minus the yaw about the vertical through the lab's origin"
        " and ingest anew; start and rest pose of this model are those of the turned markers",
    ),
    Effect(
        "lab_yaw",
        "input",
        "the pelvis is seen in a lab of another scale than the interface and the robot",
        (EffectParameter("too_large", "1", -0.1, 0.1, (0.01,)),),
        "F",
        "a static wand seen by both systems",
        scope="whole",
        input_chain=chains.scaled_motion,
        form="scale",
        remedy="Divide the pelvis' markers of all trials by 1 + too_large about the lab's origin and ingest anew",
    ),
    Effect(
        "replay_lag",
        "input",
        "the pelvis is late by tau",
        # one that is early is no replay's fault: sync_offset
        (EffectParameter("lag", "s", 0.0, 0.1, (0.01,)),),
        "T",
        _JERK,
        scope="whole",
        input_chain=chains.earlier_pelvis,
        remedy="Replay the pelvis earlier by the lag: what it shows at t happened at t - lag",
    ),
    Effect(
        "sync_offset",
        "output",
        "y(t - tau)",
        (EffectParameter("offset", "s", -0.25, 0.25, (0.01,)),),
        "T",
        _JERK,
        scope="whole",
        output_chain=chains.late_markers,
        remedy="Shift the interface markers earlier by the offset before they are compared with the simulation",
    ),
    Effect(
        "sync_offset",
        "output",
        "y(t - tau), tau another one in each trial: recordings that were started by hand",
        tuple(EffectParameter(name, "s", -0.25, 0.25, (0.01,)) for name in ("offset", "offset_held_out")),
        "T",
        _JERK,
        scope="whole",
        output_chain=chains.late_markers,
        form="each_trial",
        per_trial=True,
        remedy="Shift the interface markers of each trial earlier by its own offset before they are compared",
    ),
    Effect(
        "sync_offset",
        "output",
        "y(t - tau), and the robot's log as late: the pelvis alone is early",
        (EffectParameter("offset", "s", 0.0, 0.15, (0.01,)),),
        "T",
        _JERK,
        scope="whole",
        input_chain=chains.later_pelvis,
        form="with_log",
        remedy="Replay the pelvis later by the offset, or shift interface markers and robot log earlier by it",
    ),
    Effect(
        "clock_drift",
        "output",
        "y((1 + eps) t)",
        (EffectParameter("drift", "1", -2.0, 2.0, (0.1,), lambda s, i: 0.01),),
        "clock_drift",
        _JERK,
        scope="whole",
        output_chain=chains.drifting_clock,
        remedy="Read the simulation at (1 + drift) t, t from the start, where the interface markers say t",
    ),
    *(
        Effect(
            "filter_lag",
            "output",
            f"y low-passed by a causal filter of {name} order",
            # near the upper end it is a delay by another name to what a person does: both stand in the answer
            (EffectParameter("cutoff", "Hz", 0.5, 25.0, (6.0,), log=True),),
            "T",
            "fast content near the filter's cut-off",
            scope="whole",
            form=form,
            output_chain=chains.filtered_markers(order),
            remedy=(
                f"Pass the simulated interface markers through a causal Butterworth low-pass of {name} order with this"
                " cut-off, or export the markers without the filter"
            ),
        )
        for order, name, form in (
            (1, "first", "first_order"),
            (2, "second", ""),
            (4, "fourth", "fourth_order"),
        )
    ),
    Effect(
        "filter_lag",
        "output",
        "y as the mean of its last samples",
        (_WINDOW,),
        "T",
        "fast content near the filter's cut-off",
        scope="whole",
        form="mean",
        output_chain=chains.averaged_markers,
        remedy="Take the mean of the simulated interface markers over this window, or export the markers without it",
    ),
    *(
        Effect(
            "filter_lag",
            "output",
            f"y {name}, and the robot's log as late, for it was laid on such markers",
            (parameter,),
            "T",
            "fast content near the filter's cut-off",
            scope="whole",
            form=f"{form}with_log",
            output_chain=chain,
            log_chain=chains.late_log(lag),
            remedy="Export the interface markers without the filter, and lay the robot's log on them anew",
        )
        for name, form, parameter, chain, lag in (
            ("as the mean of its last samples", "mean_", _WINDOW, chains.averaged_markers, _half),
            *(
                (
                    f"low-passed by a causal filter of {name} order",
                    form,
                    EffectParameter("cutoff", "Hz", 0.5, 10.0, (6.0,), log=True),
                    chains.filtered_markers(order),
                    chains.lag_of_filter(order),
                )
                for order, name, form in ((1, "first", "first_order_"), (2, "second", ""))
            ),
        )
    ),
    Effect(
        "marker_offset",
        "output",
        "a marker sits off the joint centre, fixed in the interface",
        tuple(_linear(f"{side}_{c}", "m", 0.03, 0.15) for side in ("left", "right") for c in "xyz"),
        "S",
        "static poses at several headings",
        scope="whole",
        sighting=OffCentre(),
        remedy=(
            "Take from each interface marker its offset, turned with the interface, and ingest anew. Start and rest"
            " pose of this model are the true ones; its sites are the joint centres, not the markers"
        ),
    ),
    Effect(
        "marker_offset",
        "output",
        "a marker was taped anew after the neutral trial, off where it was, fixed in the interface",
        tuple(_linear(f"{side}_{c}", "m", 0.03, 0.15) for side in ("left", "right") for c in "xyz"),
        "S",
        "static poses at several headings",
        scope="whole",
        sighting=Retaped(),
        form="retaped",
        remedy=(
            "Take from each interface marker its offset, turned with the interface, in all trials but neutral, and"
            " ingest anew. The start pose of this model is the true one; its sites are where the markers were in it"
        ),
    ),
    Effect(
        "marker_offset",
        "output",
        "the interface's markers sit on the strap and go a part of the way with the person",
        tuple(EffectParameter(f"part_{c}", "1", -0.2, 0.9, (0.1,)) for c in "xyz"),
        "S",
        "static poses at several headings",
        scope="whole",
        sighting=OnStrap(),
        form="on_strap",
        remedy=(
            "Tape the markers to the robot's side of the interface. Start of this model is where the robot truly was;"
            " its sites go all the way with the robot"
        ),
    ),
    *(
        Effect(
            "marker_drift",
            "output",
            f"a ramp in the {side} interface marker",
            tuple(_linear(f"{side}_{c}", "m/s", 0.005, 0.05) for c in "xyz"),
            "Dft",
            "distance between markers at the start and at the end",
            scope="whole",
            output_chain=chains.drifting_marker(index),
            remedy="Take from the interface marker the ramp: its rate times the time from the start",
            form=f"{side}",
        )
        for index, side in enumerate(("left", "right"))
    ),
    *(
        Effect(
            "marker_drift",
            "input",
            f"the pelvis marker {marker} slides: steadily, and at a rate that fades over a third of the trial",
            tuple(_linear(f"{kind}_{c}", "m/s", 0.002, 0.02) for kind in ("steady", "fading") for c in "xyz"),
            "Dft",
            "distance between markers at the start and at the end",
            scope="whole",
            input_chain=chains.under_skin(chains.sliding_marker(index)),
            skin=chains.sliding_marker(index),
            remedy=f"Ingest the pelvis anew without {marker}, or with its way over the bone taken from it",
            form=marker.lower(),
        )
        for index, marker in enumerate(PELVIS_MARKERS)
    ),
    Effect(
        "outliers",
        "output",
        "isolated samples of a marker are not the marker",
        (),
        "outliers",
        "the same trial, labelled again",
        scope="whole",
        output_chain=chains.without_spikes,
        remedy="Label the jumping interface markers again, or leave those samples out",
    ),
)

EFFECT_NAMES = tuple(dict.fromkeys(effect.name for effect in EFFECTS))
# Effects by ambiguity group: those that a first-order pass predicts to look alike (design, effects.md)
GROUPS = {
    group: tuple(dict.fromkeys(effect.name for effect in EFFECTS if effect.group == group))
    for group in dict.fromkeys(effect.group for effect in EFFECTS)
}
