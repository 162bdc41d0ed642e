"""Free-form families: laws of which only the place and the variables are said, and not the equation.

A family is a force on one or two joints (or a displacement of what is measured) that is linear in its coefficients,
each the factor of a basis function of some variables. It is an `Effect` like a named one: it is screened, refitted and
judged by the same code. Its coefficients have a Gaussian prior about nothing, whose scale is estimated from the data.

Beyond the range of a variable that the fitted trial visited, basis functions of one variable go on straight and
products keep their value at the edge: a polynomial that is let go there explodes.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import combinations, permutations
from itertools import product as product_of

import numpy as np
from numpy.polynomial import legendre
from scipy.spatial.transform import Rotation

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
# Orders of the polynomials of one variable: of an axis' own coordinate, and of anything else, alone or as a gain; a
# prior that falls with the order makes rough ones rare
OWN_ORDERS = (0, 2, 3, 4, 5, 6, 8)
ORDERS = (1, 2, 3, 4, 5, 6)
# Highest order of a common potential of several coordinates; what is of one alone is a polynomial of `ALONE` orders
HIGHEST = 5
ALONE = (2, 3, 4, 5)
# Fastest change of a force or gain of which nothing is known but that it is slow, and of a rhythm [Hz]
FASTEST_HZ = 3.2
# Joints of a base, each with the place that it moves along
DRIVEN = (("base_x", "place_x"), ("base_y", "place_y"), ("base_yaw", "heading"))
# Wave lengths [m] of forces that repeat along the way of a base: each tenth from tread and cogging to a wheel's turn
PITCHES_M = tuple(0.008 * 1.1**k for k in range(44))
POSTURE = ("pelvis_tilt", "pelvis_list", "pelvis_heading", "pelvis_height", "pelvis_speed")
PLACE = ("place_x", "place_y", "heading")
# Rates of a place
RATES = {"place_x": "speed_x", "place_y": "speed_y", "heading": "heading_rate"}


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
        """Return values of any shape, in the variable's own unit, with those beyond the range at its edge."""
        return np.asarray(np.clip(values, self.low, self.high))


def variables(
    context: Context,
    system: System,
    q_scale: np.ndarray,
    v_scale: np.ndarray,
    band_hz: float,
    fitted: Mapping[str, Variable] | None = None,
) -> dict[str, Variable]:
    """Return the variables of a trial that a force may depend on, below ``band_hz`` [Hz]: what is faster is noise.

    ``q_scale``, ``v_scale`` (axes,) are large excursions and rates [m, rad; m/s, rad/s]. ``fitted`` are the variables
    of the trial that is fitted, whose units any other trial takes: a coefficient is one number for all of them.
    """
    rate = float(1 / (context.time_s[1] - context.time_s[0]))

    def smooth(values: np.ndarray) -> np.ndarray:
        return np.asarray(signals.lowpass(values, rate, band_hz, 2))

    def of_size(name: str, unit: str, values: np.ndarray, own: float) -> Variable:
        scale = own if fitted is None or name not in fitted else fitted[name].scale
        return Variable(name, unit, scale, values / scale)

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
        moved = smooth(signals.derivative(out[name].values * out[name].scale, rate))
        out[RATES[name]] = of_size(RATES[name], f"{out[name].unit}/s", moved, _large(moved))
    if "place_x" in out:
        for i, axis in enumerate(system.axes):
            moved = smooth(_accelerations(context, rate)[:, i])
            name = f"acceleration_{axis.name}"
            out[name] = of_size(name, "rad/s2" if axis.rotational else "m/s2", moved, _large(moved))
    passed = passed_s(context)
    out["time"] = of_size("time", "s", passed, float(passed[-1]))
    return out


def passed_s(context: Context) -> np.ndarray:
    """Return the time (n,) [s] since the start of a trial, 0 before."""
    return np.asarray(np.maximum(context.time_s - context.time_s[context.start], 0.0))


def _large(values: np.ndarray) -> float:
    return max(float(np.percentile(np.abs(values), 95)), 1e-9)


def _middle(context: Context) -> np.ndarray:
    """Middle (n, 3) [m] of the interface's two markers, of a system without such a pair the place of the segment."""
    if context.measured.ndim == 3:
        return signals.bridged(context.measured.mean(axis=1))
    return context.pelvis_position


def _accelerations(context: Context, rate: float) -> np.ndarray:
    """Accelerations (n, 6) of the interface along and about the axes of the segment [m/s2, rad/s2]."""
    middle = _middle(context)
    turned = Rotation.from_matrix(context.interface_rotation[0].T @ context.interface_rotation).as_rotvec()
    turned = turned @ context.interface_rotation[0].T
    twice = signals.derivative(signals.derivative(np.hstack([middle, turned]), rate), rate)
    along = [np.einsum("nij,ni->nj", context.pelvis_rotation, part) for part in np.hsplit(twice, 2)]
    return np.hstack(along)


def _places(context: Context, rate: float) -> dict[str, np.ndarray]:
    """Posture of the segment and place of the interface, (n,) each [rad, m, m/s]."""
    r, p = context.pelvis_rotation, context.pelvis_position
    if not np.ptp(p, axis=0).any() and not np.ptp(r, axis=0).any():
        return {}
    forward = r[:, :2, 0] / np.maximum(np.linalg.norm(r[:, :2, 0], axis=1, keepdims=True), 1e-9)
    speed = np.einsum("ni,ni->n", forward, signals.derivative(p[:, :2], rate))
    middle = _middle(context)
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


def from_rest(name: str, order: int) -> Basis:
    """Return the polynomial of a rate less its value at rest: a damping has no force there."""
    whole = polynomial(name, order)

    def basis(of: Mapping[str, Variable], ranges: Mapping[str, Range], step_s: float) -> np.ndarray:
        still = {name: replace(of[name], values=np.zeros(1))}
        return whole(of, ranges, step_s) - whole(still, ranges, step_s)

    return basis


def modulated(name: str, order: int, by: str, *, squared: bool = False) -> Basis:
    """Return a Legendre polynomial of one variable times another variable, or times its square with its sign."""
    gain = polynomial(name, order)

    def basis(of: Mapping[str, Variable], ranges: Mapping[str, Range], step_s: float) -> np.ndarray:
        x = ranges[by].clip(of[by].values)
        return np.asarray(gain(of, ranges, step_s) * (x * np.abs(x) if squared else x))

    return basis


def cosine(half_turns: int, by: str = "") -> Basis:
    """Return a cosine of half turns over the trial, alone or times a variable."""

    def basis(of: Mapping[str, Variable], ranges: Mapping[str, Range], step_s: float) -> np.ndarray:
        time = of["time"].values
        wave = np.asarray(np.cos(np.pi * half_turns * time / time[-1]))
        return wave * of[by].values if by else wave

    return basis


def rhythm(hz: float, shift: float, by: str = "") -> Basis:
    """Return a sine of time of a frequency and a shift [1] of its turn, alone or times a variable."""

    def basis(of: Mapping[str, Variable], ranges: Mapping[str, Range], step_s: float) -> np.ndarray:
        wave = np.sin(2 * np.pi * (hz * of["time"].values * of["time"].scale + shift))
        return wave * of[by].values if by else wave

    return basis


def step(name: str, sharpness: float) -> Basis:
    """Return a rounded sign of a rate."""
    return lambda of, ranges, step_s: np.tanh(of[name].values / sharpness)


def product(powers: Mapping[str, int], sizes: Sequence[str] = ()) -> Basis:
    """Return a product of powers and absolute values (``sizes``) of variables, each kept at the edge of its range."""

    def basis(of: Mapping[str, Variable], ranges: Mapping[str, Range], step_s: float) -> np.ndarray:
        parts = [ranges[name].clip(of[name].values) ** exponent for name, exponent in powers.items()]
        parts += [np.abs(ranges[name].clip(of[name].values)) for name in sizes]
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


# -------------------- families


@dataclass(frozen=True)
class Term:
    """One basis function on one joint: force per unit of the joint's large force [1].

    The ``name`` says function and variables: terms of one name are one function of time, whatever joint they drive.
    ``weight`` is the prior SD of its coefficient beside the others of the family: rough functions are rarer.
    ``powers`` are those of the variables where the force grows with them: they give the coefficient's unit.
    """

    name: str
    joint: str
    basis: Basis
    weight: float = 1.0
    factor: float = 1.0
    powers: tuple[tuple[str, int], ...] = ()


@dataclass(frozen=True)
class Family:
    """A law of which only the place and the variables are said.

    ``terms`` hold, per coefficient, the basis functions that it multiplies: one, or one per joint for a potential.
    ``each_trial``: every trial has coefficients of its own, since what drives the force was not recorded.
    """

    name: str
    stage: str
    kind: str
    axes: tuple[str, ...]
    depends_on: tuple[str, ...]
    terms: tuple[tuple[Term, ...], ...] = field(repr=False)
    each_trial: bool = False

    @property
    def is_free(self) -> bool:
        """Return whether it has any history: it can stand for every law of its axis, and predicts nothing."""
        return self.each_trial and self.kind != "rhythm"

    @property
    def feeds_back(self) -> bool:
        """Return whether it depends on the motion of what it moves: on more than time and the driven segment."""
        return any(name not in (*POSTURE, "time") for name in self.depends_on)

    @property
    def key(self) -> str:
        """Name in progress lines and tables."""
        of = f" of {', '.join(self.depends_on)}" if self.depends_on else ""
        return f"{self.kind.removesuffix(' force')} force along {', '.join(self.axes)}{of}"


def families(
    system: System,
    known: Sequence[str],
    force_of: Mapping[str, float],
    q_of: Mapping[str, float],
    longest_s: float,
) -> list[Family]:
    """Return all families of forces of a system.

    Parameters
    ----------
    known
        Names of the variables of the trials.
    force_of, q_of
        Large force [N, Nm] and large excursion [m, rad] by joint: units of a potential.
    longest_s
        Length of the longest trial [s], of which a history of `FASTEST_HZ` takes that many cosines.
    """
    waves = range(int(np.ceil(2 * FASTEST_HZ * longest_s)) + 1)
    axes = [axis for axis in system.axes if f"q_{axis.name}" in known]
    out: list[Family] = []
    for axis in axes:
        out += _own(axis.name, axis.joint)
        out += _of_time("interface", axis.name, axis.joint, waves, (f"q_{axis.name}", f"v_{axis.name}"))
        out += _modulated(axis.name, axis.joint, [n for n in (*POSTURE, *PLACE) if n in known])
    for several in (*combinations(axes, 2), *combinations(axes, 3)):
        units = tuple((force_of[x.joint], q_of[x.joint]) for x in several)
        names, joints = (tuple(getattr(x, key) for x in several) for key in ("name", "joint"))
        out.append(_potential(names, joints, units))
    for a, b in permutations(axes, 2):
        out += _coupled(a.name, a.joint, b.name)
    if all(f"acceleration_{axis.name}" in known for axis in axes) and len(axes) == 6:
        out.append(_inertial([(axis.name, axis.joint) for axis in axes]))
    moved = [(j, n) for j, n in DRIVEN if n in known and j in system.machine_joints]
    for joint, name in moved:
        out += _machine(joint, name)
        out += _of_time("robot", joint, joint, waves)
    return [*out, *_periodic([(j, n) for j, n in moved if n != "heading"])]


def moved_joints(system: System) -> dict[str, str]:
    """Return the units [m or rad] of the joints of a base by name, none for a machine without one."""
    return {joint: _UNITS[place][0] for joint, place in DRIVEN if joint in system.machine_joints}


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


def times(
    joint: str, powers: Mapping[str, int], sizes: Sequence[str] = (), weight: float = 1.0, factor: float = 1.0
) -> Term:
    """Return a product of powers of variables and of ``sizes`` (absolute values) on a joint."""
    label = [name if k == 1 else f"{name}^{k}" for name, k in powers.items() if k]
    label += [f"|{name}|" for name in sizes]
    total = {name: k for name, k in powers.items() if k}
    for name in sizes:
        total[name] = total.get(name, 0) + 1
    return Term(" ".join(label), joint, product(powers, sizes), weight, factor, tuple(total.items()))


def _one(terms: Sequence[Term]) -> tuple[tuple[Term, ...], ...]:
    return tuple((term,) for term in terms)


def _own(axis: str, joint: str) -> Iterator[Family]:
    """Families of an axis' own coordinate and rate."""
    q, v = f"q_{axis}", f"v_{axis}"
    elastic = [_legendre(q, joint, k) for k in OWN_ORDERS]
    yield Family("elastic", "interface", "elastic", (axis,), (q,), _one(elastic))
    lossy = _losses(v, joint)
    yield Family("dissipative", "interface", "dissipative", (axis,), (v,), _one(lossy))
    both = [*lossy, *_gains(q, joint, v), times(joint, {q: 1}, [v], 0.5)]
    both += [
        Term(f"P{k}({q}) {v} |{v}|", joint, modulated(q, k, v, squared=True), _smooth(k)) for k in (1, 2, 3)
    ]
    yield Family("damping by coordinate", "interface", "damping by coordinate", (axis,), (q, v), _one(both))
    yield from _with_history("interface", axis, joint, q)


def _gains(name: str, joint: str, by: str) -> list[Term]:
    """Return a function of one variable times another variable."""
    return [Term(f"P{k}({name}) {by}", joint, modulated(name, k, by), _smooth(k)) for k in ORDERS]


def _smooth(order: int) -> float:
    """Prior SD of a coefficient of an order: each has the same slope at the edge, from where it goes straight on."""
    return 2 / (order * (order + 1)) if order else 1.0


def _legendre(name: str, joint: str, order: int) -> Term:
    label = f"P{order}({name})" if order else "constant"
    return Term(label, joint, polynomial(name, order), _smooth(order))


def _losses(v: str, joint: str) -> list[Term]:
    """Return functions of a rate, none of which has a force at rest: signs from sharp to round, and polynomials."""
    signs = [Term(f"tanh({v} / {s:g} of a large one)", joint, step(v, s)) for s in SHARPNESS]
    smooth = [Term(f"P{k}({v}) - P{k}(0)", joint, from_rest(v, k), _smooth(k)) for k in ORDERS]
    return [*signs, times(joint, {v: 1}, [v]), *smooth]


def _with_history(stage: str, axis: str, joint: str, q: str) -> Iterator[Family]:
    """Families of what a coordinate was before, and of time."""
    slow = [Term(f"{q} relaxing in {t:g} s", joint, relaxed(q, t), powers=((q, 1),)) for t in TIMES_S]
    yield Family("memory", stage, "memory", (axis,), (f"history of {q}",), _one(slow))
    play = [Term(f"{q} slipping at {w:g} of half its range", joint, stopped(q, w)) for w in WIDTHS]
    yield Family("hysteresis", stage, "hysteresis", (axis,), (f"history of {q}",), _one(play))
    drift = [_legendre("time", joint, k) for k in ORDERS]
    yield Family("drift", stage, "slow change", (axis,), ("time",), _one(drift))
    if stage == "interface":
        v = f"v_{axis}"
        gain = [*_gains("time", joint, q), *_gains("time", joint, v)]
        yield Family("gain in time", stage, "slow change", (axis,), ("time", q), _one(gain))


def _modulated(axis: str, joint: str, names: Sequence[str]) -> Iterator[Family]:
    """Families of posture or place, alone or as a gain of stiffness and damping."""
    q, v = f"q_{axis}", f"v_{axis}"
    for name in names:
        kind = "posture" if name in POSTURE else "place"
        alone = [_legendre(name, joint, k) for k in ORDERS]
        yield Family(kind, "interface", kind, (axis,), (name,), _one(alone))
        gain = [*_gains(name, joint, q), *_gains(name, joint, v)]
        yield Family(f"gain by {kind}", "interface", kind, (axis,), (name, q), _one(gain))


def _potential(
    axes: tuple[str, ...], joints: tuple[str, ...], units: tuple[tuple[float, float], ...]
) -> Family:
    """All forces derive from one potential of two or three coordinates.

    Of three, only what depends on all of them: a potential of two is a family of its own, which may join.
    """
    names = tuple(f"q_{axis}" for axis in axes)
    energy = float(np.prod([f * x for f, x in units]) ** (1 / len(units)))
    factor = [energy / (f * x) for f, x in units]
    terms: list[tuple[Term, ...]] = []
    for powers in _powers(len(axes)):
        row = []
        for i, joint in enumerate(joints):
            slope = {
                name: power - (k == i) for k, (name, power) in enumerate(zip(names, powers, strict=True))
            }
            row.append(times(joint, slope, (), 1 / (sum(powers) - 1), powers[i] * factor[i]))
        terms.append(tuple(row))
    if len(axes) == 2:
        for name, joint in zip(names, joints, strict=True):
            terms += [(_legendre(name, joint, k),) for k in ALONE]
    return Family("elastic coupling", "interface", "elastic coupling", axes, names, tuple(terms))


def _powers(coordinates: int) -> list[tuple[int, ...]]:
    """Powers of coordinates that a potential depends on together, up to its `HIGHEST` order."""
    every = product_of(range(1, HIGHEST), repeat=coordinates)
    return sorted((p for p in every if sum(p) <= HIGHEST), key=lambda p: (sum(p), [-k for k in p]))


def _inertial(axes: Sequence[tuple[str, str]]) -> Family:
    """Forces and moments of a mass on the interface, along and about each axis."""
    names = tuple(f"acceleration_{name}" for name, _ in axes)
    terms = [times(joint, {name: 1}) for name, (_, joint) in zip(names, axes, strict=True)]
    return Family("inertial", "robot", "inertial", tuple(n for n, _ in axes), names, _one(terms))


def _coupled(axis: str, joint: str, other: str) -> Iterator[Family]:
    """Families of another axis' coordinate or rate, without a potential."""
    q, v, qo, vo = f"q_{axis}", f"v_{axis}", f"q_{other}", f"v_{other}"
    elastic = [_legendre(qo, joint, k) for k in ORDERS]
    yield Family("from a coordinate", "interface", "coupling", (axis,), (qo,), _one(elastic))
    yield Family("from a rate", "interface", "coupling", (axis,), (vo,), _one(_losses(vo, joint)))
    gain = _gains(qo, joint, v)
    yield Family("damping by another coordinate", "interface", "coupling", (axis,), (qo, v), _one(gain))
    swept = [times(joint, {q: 1, vo: 1}), times(joint, {q: 2, vo: 1}, weight=0.5), times(joint, {v: 1}, [vo])]
    yield Family("by another rate", "interface", "coupling", (axis,), (q, vo), _one(swept))


def _of_time(
    stage: str, axis: str, joint: str, waves: Sequence[int], gained: Sequence[str] = ()
) -> Iterator[Family]:
    """Families of a force from outside, or of a gain of some variables, of any slow history, another in every trial."""
    alone = [Term(f"cos({k} pi time)" if k else "constant", joint, cosine(k)) for k in waves]
    yield Family("external force", stage, "external force", (axis,), ("time",), _one(alone), each_trial=True)
    for by in gained:
        # a constant gain is stiffness or damping
        gain = [Term(f"cos({k} pi time) {by}", joint, cosine(k, by)) for k in waves if k]
        yield Family(
            "gain by history", stage, "slow change", (axis,), ("time", by), _one(gain), each_trial=True
        )


def with_rhythm(of: Family, hz: float) -> Family:
    """Return the force or gain of a frequency, and of any phase in each trial, in place of a free history."""
    joint, by = of.terms[0][0].joint, of.depends_on[1] if len(of.depends_on) > 1 else ""
    waves = (("sin", 0.0), ("cos", 0.25))
    terms = [Term(f"{wave}({hz:.3f} Hz) {by}".strip(), joint, rhythm(hz, shift, by)) for wave, shift in waves]
    return Family(
        f"rhythm of {hz:.3f} Hz", of.stage, "rhythm", of.axes, of.depends_on, _one(terms), each_trial=True
    )


def _machine(joint: str, name: str) -> Iterator[Family]:
    """Families of forces on a joint of the machine."""
    place = [_legendre(name, joint, k) for k in (0, *ORDERS)]
    yield Family("machine place", "robot", "place", (joint,), (name,), _one(place))
    rate = RATES[name]
    yield Family("machine dissipative", "robot", "dissipative", (joint,), (rate,), _one(_losses(rate, joint)))
    yield from _with_history("robot", joint, joint, name)
