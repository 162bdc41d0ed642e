"""Free-form families: laws of which only the place and the variables are said, and not the equation.

A family is a force on one or two joints (or a displacement of what is measured) that is linear in its coefficients,
each the factor of a basis function of some variables. It is an `Effect` like a named one: it is screened, refitted and
judged by the same code. Its coefficients have a Gaussian prior about nothing, whose scale is estimated from the data.

Beyond the range of a variable that the fitted trial visited, basis functions of one variable go on straight and
products keep their value at the edge: a polynomial that is let go there explodes.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import combinations, permutations

import numpy as np
from numpy.polynomial import legendre

from real2sim import signals
from real2sim.effects.chains import Context
from real2sim.system.description import System

# Time constants [s] of the relaxations that a memory is made of, and widths of the play operators of a hysteresis, as
# shares of half the range that was visited: log-spaced over what a trial can show
TIMES_S = (0.05, 0.15, 0.5, 1.5, 5.0, 15.0)
WIDTHS = (0.05, 0.1, 0.2, 0.4, 0.8)
# Rates at which the steps of a friction are rounded, as shares of a large rate
SHARPNESS = (0.03, 0.1, 0.3, 1.0)
# One unit of the variables that are no coordinate of the interface [rad, m, m/s]
_UNITS = {
    "pelvis_tilt": ("rad", 0.1),
    "pelvis_list": ("rad", 0.1),
    "pelvis_heading": ("rad", 0.3),
    "pelvis_height": ("m", 0.02),
    "pelvis_speed": ("m/s", 0.3),
    "place_x": ("m", 0.2),
    "place_y": ("m", 0.2),
    "heading": ("rad", 0.2),
}
# Joints of a base, each with the place that it moves along
DRIVEN = (("base_x", "place_x"), ("base_y", "place_y"), ("base_yaw", "heading"))
# Wave lengths [m] of forces that repeat along the way of a base: each tenth from tread and cogging to a wheel's turn
PITCHES_M = tuple(0.008 * 1.1**k for k in range(44))
POSTURE = ("pelvis_tilt", "pelvis_list", "pelvis_heading", "pelvis_height", "pelvis_speed")
PLACE = ("place_x", "place_y", "heading")


@dataclass(frozen=True)
class Variable:
    """One variable of a trial: ``values`` (n,) in units of ``scale`` [SI per unit], its name and SI unit."""

    name: str
    unit: str
    scale: float
    values: np.ndarray


@dataclass(frozen=True)
class Range:
    """Values of a variable that the fitted trial visited, in the variable's own unit."""

    low: float
    high: float

    @property
    def middle(self) -> float:
        """Middle of the range."""
        return (self.low + self.high) / 2

    @property
    def half(self) -> float:
        """Half its width."""
        return max((self.high - self.low) / 2, 1e-9)

    def clip(self, values: np.ndarray) -> np.ndarray:
        """Return values that stay at the edge of the range."""
        return np.asarray(np.clip(values, self.low, self.high))


def variables(
    context: Context, system: System, q_scale: np.ndarray, v_scale: np.ndarray, band_hz: float
) -> dict[str, Variable]:
    """Return the variables of a trial that a force may depend on, below ``band_hz`` [Hz]: what is faster is noise.

    ``q_scale``, ``v_scale`` (axes,) are large excursions and rates [m, rad; m/s, rad/s].
    """
    rate = float(1 / (context.time_s[1] - context.time_s[0]))

    def smooth(values: np.ndarray) -> np.ndarray:
        return np.asarray(signals.lowpass(values, rate, band_hz, 2))

    out: dict[str, Variable] = {}
    for i, axis in enumerate(system.axes):
        unit = "rad" if axis.rotational else "m"
        for prefix, values, scales, per in (
            ("q", context.coordinates, q_scale, ""),
            ("v", context.rates, v_scale, "/s"),
        ):
            name = f"{prefix}_{axis.name}"
            out[name] = Variable(name, unit + per, float(scales[i]), smooth(values[:, i]) / scales[i])
    for name, values in _places(context, rate).items():
        unit, scale = _UNITS[name]
        out[name] = Variable(name, unit, scale, smooth(values - values[: context.start].mean()) / scale)
    for name in [n for n in PLACE if n in out]:
        moved = smooth(signals.derivative(out[name].values, rate))
        large = max(float(np.percentile(np.abs(moved), 95)), 1e-9)
        unit, scale = out[name].unit, out[name].scale
        out[f"rate of {name}"] = Variable(f"rate of {name}", f"{unit}/s", scale * large, moved / large)
    passed = np.maximum(context.time_s - context.time_s[context.start], 0.0)
    out["time"] = Variable("time", "s", float(passed[-1]), passed / passed[-1])
    return out


def _places(context: Context, rate: float) -> dict[str, np.ndarray]:
    """Posture of the segment and place of the interface, (n,) each [rad, m, m/s]."""
    r, p = context.pelvis_rotation, context.pelvis_position
    if not np.ptp(p, axis=0).any() and not np.ptp(r, axis=0).any():
        return {}
    forward = r[:, :2, 0] / np.maximum(np.linalg.norm(r[:, :2, 0], axis=1, keepdims=True), 1e-9)
    speed = np.einsum("ni,ni->n", forward, signals.derivative(p[:, :2], rate))
    middle = signals.bridged(context.measured.mean(axis=1)) if context.measured.ndim == 3 else p
    bar = context.interface_rotation
    return {
        "pelvis_tilt": np.arcsin(np.clip(-r[:, 2, 0], -1, 1)),
        "pelvis_list": np.arctan2(r[:, 2, 1], r[:, 2, 2]),
        "pelvis_heading": np.unwrap(np.arctan2(r[:, 1, 0], r[:, 0, 0])),
        "pelvis_height": p[:, 2],
        "pelvis_speed": speed,
        "place_x": middle[:, 0],
        "place_y": middle[:, 1],
        "heading": np.unwrap(np.arctan2(bar[:, 1, 0], bar[:, 0, 0])),
    }


# -------------------- basis functions

Signals = Mapping[str, np.ndarray]
Basis = Callable[[Mapping[str, Variable], Mapping[str, Range], float], np.ndarray]


def polynomial(name: str, order: int) -> Basis:
    """Return the Legendre polynomial of a variable over its range, straight beyond."""
    series = np.eye(order + 1)[order]
    slope = legendre.legder(series) if order else np.zeros(1)

    def basis(of: Mapping[str, Variable], ranges: Mapping[str, Range], step_s: float) -> np.ndarray:
        x = (of[name].values - ranges[name].middle) / ranges[name].half
        inside = np.clip(x, -1, 1)
        return np.asarray(legendre.legval(inside, series) + legendre.legval(inside, slope) * (x - inside))

    return basis


def step(name: str, sharpness: float) -> Basis:
    """Return a rounded sign of a rate."""
    return lambda of, ranges, step_s: np.tanh(of[name].values / sharpness)


def product(*powers: tuple[str, float]) -> Basis:
    """Return a product of powers of variables, each kept at the edge of its range; a power of 0.5 is the size."""

    def basis(of: Mapping[str, Variable], ranges: Mapping[str, Range], step_s: float) -> np.ndarray:
        parts = []
        for name, exponent in powers:
            x = ranges[name].clip(of[name].values)
            parts.append(np.abs(x) if exponent == 0.5 else x**exponent)
        return np.asarray(np.prod(parts, axis=0))

    return basis


def relaxed(name: str, time_s: float) -> Basis:
    """Return a variable less what a low-pass of a time constant makes of it, from rest."""

    def basis(of: Mapping[str, Variable], ranges: Mapping[str, Range], step_s: float) -> np.ndarray:
        x = of[name].values
        keep, low, out = float(np.exp(-step_s / time_s)), float(x[0]), np.empty_like(x)
        for i, value in enumerate(x.tolist()):
            low = keep * low + (1 - keep) * value
            out[i] = value - low
        return out

    return basis


def stopped(name: str, share: float) -> Basis:
    """Return the stretch of a spring that slips at a share of half the range: a variable less its play operator."""

    def basis(of: Mapping[str, Variable], ranges: Mapping[str, Range], step_s: float) -> np.ndarray:
        x, width = of[name].values, share * ranges[name].half
        stretch, out = 0.0, np.empty_like(x)
        for i, way in enumerate(np.diff(x, prepend=x[0]).tolist()):
            stretch = min(max(stretch + way, -width), width)
            out[i] = stretch
        return out / width

    return basis


def wave_of(name: str, length: float, shift: float) -> Basis:
    """Return a sine of a place of a wave length [m] and a shift [1] of it."""

    def basis(of: Mapping[str, Variable], ranges: Mapping[str, Range], step_s: float) -> np.ndarray:
        return np.asarray(np.sin(2 * np.pi * (of[name].values * of[name].scale / length + shift)))

    return basis


def hat(index: int, count: int) -> Basis:
    """Return a triangle about one of ``count`` evenly spaced times of a trial."""

    def basis(of: Mapping[str, Variable], ranges: Mapping[str, Range], step_s: float) -> np.ndarray:
        n = len(of["time"].values)
        return np.asarray(np.maximum(1 - np.abs(np.linspace(0, count - 1, n) - index), 0.0))

    return basis


# -------------------- families


@dataclass(frozen=True)
class Term:
    """One basis function on one joint: force per unit of the joint's large force [1].

    ``weight`` is the prior SD of its coefficient beside the others of the family: rough functions are rarer.
    ``powers`` are those of the variables where the term is their product: they give the coefficient's unit.
    """

    name: str
    joint: str
    basis: Basis
    weight: float = 1.0
    factor: float = 1.0
    powers: tuple[tuple[str, float], ...] = ()


@dataclass(frozen=True)
class Family:
    """A law of which only the place and the variables are said.

    ``terms`` hold, per coefficient, the basis functions that it multiplies: one, or one per joint for a potential.
    """

    name: str
    stage: str
    kind: str
    axes: tuple[str, ...]
    depends_on: tuple[str, ...]
    terms: tuple[tuple[Term, ...], ...] = field(repr=False)

    @property
    def key(self) -> str:
        """What it is called in progress lines and tables."""
        of = f" of {', '.join(self.depends_on)}" if self.depends_on else ""
        return f"{self.kind} force along {', '.join(self.axes)}{of}"


def families(
    system: System, known: Sequence[str], force_of: Mapping[str, float], q_of: Mapping[str, float]
) -> list[Family]:
    """Return all families of forces of a system.

    Parameters
    ----------
    known
        Names of the variables of the trials.
    force_of, q_of
        Large force [N, Nm] and large excursion [m, rad] by joint: units of a potential.
    """
    axes = [axis for axis in system.axes if f"q_{axis.name}" in known]
    out: list[Family] = []
    for axis in axes:
        out += _own(axis.name, axis.joint)
        out += _modulated(axis.name, axis.joint, [n for n in (*POSTURE, *PLACE) if n in known])
    for a, b in combinations(axes, 2):
        units = tuple((force_of[x.joint], q_of[x.joint]) for x in (a, b))
        out.append(_potential((a.name, b.name), (a.joint, b.joint), units))
    for a, b in permutations(axes, 2):
        out += _coupled(a.name, a.joint, b.name)
    moved = [(j, n) for j, n in DRIVEN if n in known and j in system.machine_joints]
    for joint, name in moved:
        out += _machine(joint, name)
    return [*out, *_periodic([(j, n) for j, n in moved if n != "heading"])]


def _periodic(moved: Sequence[tuple[str, str]]) -> Iterator[Family]:
    """Families of forces that repeat along the way of the base, as wheels do, at one length each."""
    if not moved:
        return
    for length in PITCHES_M:
        terms = [
            Term(f"{wave}({name} / {1e3 * length:.1f} mm)", joint, wave_of(name, length, shift))
            for joint, name in moved
            for wave, shift in (("sin", 0.0), ("cos", 0.25))
        ]
        names = tuple(name for _, name in moved)
        yield Family(
            f"periodic {1e3 * length:.1f} mm",
            "robot",
            "rhythm",
            tuple(j for j, _ in moved),
            names,
            _one(terms),
        )


def external(joint: str, count: int, stage: str, of_trial: str) -> Family:
    """Return a force history of its own on a joint: a hat every so many of ``count`` parts of a trial.

    It says nothing of another trial: its coefficients belong to ``of_trial`` alone.
    """
    hats = [Term(f"{of_trial} hat {i} of {count}", joint, hat(i, count)) for i in range(count)]
    return Family("external", stage, "external force", (joint,), ("time",), _one(hats))


def power(name: str, joint: str, exponent: float) -> Term:
    """Return a power of one variable on a joint."""
    label = name if exponent == 1 else f"{name}^{exponent:g}"
    return Term(label, joint, product((name, exponent)), powers=((name, exponent),))


def _one(terms: Sequence[Term]) -> tuple[tuple[Term, ...], ...]:
    return tuple((term,) for term in terms)


def _own(axis: str, joint: str) -> Iterator[Family]:
    """Families of an axis' own coordinate and rate."""
    q, v = f"q_{axis}", f"v_{axis}"
    elastic = [Term(f"P{k}({q})", joint, polynomial(q, k), 1 / max(k - 1, 1)) for k in (0, 2, 3, 4, 5, 6, 8)]
    yield Family("elastic", "interface", "elastic", (axis,), (q,), _one(elastic))
    lossy = [Term(f"tanh({v}/{s:g})", joint, step(v, s)) for s in SHARPNESS]
    lossy += [
        Term(f"|{v}|{v}", joint, product((v, 1), (v, 0.5))),
        Term(f"{v}^3", joint, product((v, 3)), 0.5),
    ]
    yield Family("dissipative", "interface", "dissipative", (axis,), (v,), _one(lossy))
    both = [Term(f"{q}^{i} {v}", joint, product((q, i), (v, 1)), 1 / i) for i in (1, 2, 3, 4)]
    both += [Term(f"{q} |{v}|", joint, product((q, 1), (v, 0.5)), 0.5)]
    yield Family("damping by coordinate", "interface", "damping by coordinate", (axis,), (q, v), _one(both))
    yield from _with_history("interface", axis, joint, q)


def _with_history(stage: str, axis: str, joint: str, q: str) -> Iterator[Family]:
    """Families of what a coordinate was before, and of time."""
    slow = [Term(f"relaxation {t:g} s", joint, relaxed(q, t)) for t in TIMES_S]
    yield Family("memory", stage, "memory", (axis,), (f"history of {q}",), _one(slow))
    play = [Term(f"slip {w:g}", joint, stopped(q, w)) for w in WIDTHS]
    yield Family("hysteresis", stage, "hysteresis", (axis,), (f"history of {q}",), _one(play))
    drift = [Term(f"time^{k}", joint, product(("time", k)), 1 / k) for k in (1, 2, 3, 4)]
    yield Family("drift", stage, "slow change", (axis,), ("time",), _one(drift))
    if stage == "interface":
        v = f"v_{axis}"
        gain = [
            Term(f"time^{k} {x}", joint, product(("time", k), (x, 1)), 1 / k)
            for x in (q, v)
            for k in (1, 2, 3)
        ]
        yield Family("gain in time", stage, "slow change", (axis,), ("time", q), _one(gain))


def _modulated(axis: str, joint: str, names: Sequence[str]) -> Iterator[Family]:
    """Families of posture or place, alone or as a gain of stiffness and damping."""
    q, v = f"q_{axis}", f"v_{axis}"
    for name in names:
        kind = "posture" if name in POSTURE else "place"
        alone = [Term(f"P{k}({name})", joint, polynomial(name, k), 1 / k) for k in (1, 2, 3, 4)]
        yield Family(kind, "interface", kind, (axis,), (name,), _one(alone))
        gain = [
            Term(f"{name}^{k} {x}", joint, product((name, k), (x, 1)), 1 / k)
            for x in (q, v)
            for k in (1, 2, 3)
        ]
        yield Family(f"gain by {kind}", "interface", kind, (axis,), (name, q), _one(gain))


def _potential(
    axes: tuple[str, str], joints: tuple[str, str], units: tuple[tuple[float, float], ...]
) -> Family:
    """Both forces derive from one potential of two coordinates."""
    a, b = (f"q_{axis}" for axis in axes)
    energy = float(np.sqrt(np.prod([f * x for f, x in units])))
    factor = [energy / (f * x) for f, x in units]
    terms = []
    for i, j in ((1, 1), (2, 1), (1, 2), (3, 1), (2, 2), (1, 3)):
        name, weight = f"V {a}^{i} {b}^{j}", 1 / (i + j - 1)
        terms.append(
            (
                Term(name, joints[0], product((a, i - 1), (b, j)), weight, i * factor[0]),
                Term(name, joints[1], product((a, i), (b, j - 1)), weight, j * factor[1]),
            )
        )
    return Family("elastic coupling", "interface", "elastic coupling", axes, (a, b), tuple(terms))


def _coupled(axis: str, joint: str, other: str) -> Iterator[Family]:
    """Families of another axis' coordinate or rate, without a potential."""
    q, v, qo, vo = f"q_{axis}", f"v_{axis}", f"q_{other}", f"v_{other}"
    elastic = [Term(f"P{k}({qo})", joint, polynomial(qo, k), 1 / k) for k in (1, 2, 3, 4)]
    yield Family("from a coordinate", "interface", "coupling", (axis,), (qo,), _one(elastic))
    lossy = [Term(vo, joint, product((vo, 1))), Term(f"|{vo}|{vo}", joint, product((vo, 1), (vo, 0.5)), 0.5)]
    lossy += [Term(f"tanh({vo}/0.1)", joint, step(vo, 0.1))]
    yield Family("from a rate", "interface", "coupling", (axis,), (vo,), _one(lossy))
    gain = [Term(f"{qo}^{k} {v}", joint, product((qo, k), (v, 1)), 1 / k) for k in (1, 2, 3)]
    yield Family("damping by another coordinate", "interface", "coupling", (axis,), (qo, v), _one(gain))
    swept = [Term(f"{x} {vo}", joint, product((x, 1), (vo, 1))) for x in (q,)]
    swept += [
        Term(f"{q}^2 {vo}", joint, product((q, 2), (vo, 1)), 0.5),
        Term(f"|{vo}| {v}", joint, product((vo, 0.5), (v, 1))),
    ]
    yield Family("by another rate", "interface", "coupling", (axis,), (q, vo), _one(swept))


def _machine(joint: str, name: str) -> Iterator[Family]:
    """Families of forces on a joint of the machine."""
    place = [Term(f"P{k}({name})", joint, polynomial(name, k), 1 / max(k, 1)) for k in (0, 1, 2, 3, 4, 5, 6)]
    yield Family("machine elastic", "robot", "elastic", (joint,), (name,), _one(place))
    rate = f"rate of {name}"
    lossy = [Term(f"tanh({rate}/{s:g})", joint, step(rate, s)) for s in SHARPNESS]
    lossy += [
        Term(rate, joint, product((rate, 1))),
        Term(f"|{rate}| {rate}", joint, product((rate, 1), (rate, 0.5))),
    ]
    yield Family("machine dissipative", "robot", "dissipative", (joint,), (rate,), _one(lossy))
    yield from _with_history("robot", joint, joint, name)
