"""Laws with memory: springs that yield, branches that relax."""

from __future__ import annotations

from functools import lru_cache
from math import atanh, tanh

import mujoco
import numpy as np
import scipy
from scipy.interpolate import CubicSpline

from real2sim.effects.base import (
    AtRest,
    Effect,
    EffectParameter,
    Fields,
    InterfaceImpedance,
    Mechanism,
    Where,
    add_branch,
    add_tendon,
    excursion,
    per_excursion,
    seconds,
    set_branch,
    stiffness,
)
from real2sim.effects.chains import Context
from real2sim.effects.friction import FRICTION, LOSSES
from real2sim.effects.planned import DrivenForce


class Elastoplastic(Mechanism):
    """Springs in parallel that yield one after the other: values are yield force and yield travel, (m, 2).

    Equal springs whose travels are quantiles of an exponential law: together they approach the force as
    1 - exp(-x / travel), as the Bouc-Wen law of exponent 1 does, with Masing's memory of reversals.
    """

    kinds = ("hysteresis",)

    def __init__(self, elements: int):
        self.travels = -np.log(1 - (np.arange(elements) + 0.5) / elements)

    def _names(self, where: Where) -> list[str]:
        return [f"yield{i}_{where.element}" for i in range(len(self.travels))]

    def build(self, spec: mujoco.MjSpec, where: Where) -> None:
        """Add one yielding tendon per element."""
        for name in self._names(where):
            _yielding_tendon(spec, name, where)

    def set(self, fields: Fields, where: Where, impedance: InterfaceImpedance, values: np.ndarray) -> None:
        """Write the stiffness at which they yield at the force, limited to what the time step allows."""
        stiffness = values[:, 0] / values[:, 1] / self.travels.sum() * len(self.travels)
        share = np.minimum(stiffness, fields.stiffest(where.axis)) / len(self.travels)
        for name, travel in zip(self._names(where), self.travels, strict=True):
            index = fields.tendon(name)
            fields["tendon_stiffness"][:, index] = share
            fields["tendon_springyield"][:, index] = (
                travel * values[:, 1] * stiffness / (share * len(self.travels))
            )

    def along(self, q: np.ndarray, values: np.ndarray) -> np.ndarray:
        """Return the force (m, n) of the springs along a coordinate (n,), at rest at its origin."""
        slips = self.travels * values[:, 1:]
        stiffness = values[:, 0] / values[:, 1] / self.travels.sum()
        ways = np.diff(q).tolist()
        out = np.empty((len(values), len(q)))
        for row, own, each in zip(out, stiffness, slips.tolist(), strict=True):
            row[:] = own * np.sum([_slipped(float(q[0]), ways, slip) for slip in each], axis=0)
        return out


def _slipped(first: float, ways: list[float], slip: float) -> list[float]:
    """Stretches (n,) of a spring that yields at ``slip``, along ``ways`` (n - 1,) of its end from ``first``.

    Plain numbers: a step of arrays this short is all overhead.
    """
    stretch = min(max(first, -slip), slip)
    path = [stretch]
    for way in ways:
        stretch += way
        if stretch > slip:
            stretch = slip
        elif stretch < -slip:
            stretch = -slip
        path.append(stretch)
    return path


def _yielding_tendon(spec: mujoco.MjSpec, name: str, where: Where) -> None:
    joint = {where.joint(): 1.0}
    add_tendon(spec, name, joint, stiffness=[1, 0, 0], springlength=[0, 0], springyield=0.01)


class Maxwell(Mechanism):
    """Springs and dampers in series beside a joint's own: values are stiffness and shortest time constant, (m, 2).

    ``branches`` of equal stiffness, which adds up to the value, have time constants that grow by ``ratio``: together
    they relax with the logarithm of time. The point between spring and damper of each is a hidden slide in the world,
    tied to the joint by a tendon.
    """

    kinds = ("memory", "slow change")

    def __init__(self, branches: int = 1, ratio: float = 1.0):
        self._ratios = ratio ** np.arange(branches)

    def _names(self, where: Where) -> list[str]:
        return [f"maxwell{i or ''}_{where.element}" for i in range(len(self._ratios))]

    def build(self, spec: mujoco.MjSpec, where: Where) -> None:
        """Add hidden slide and tendon of each branch."""
        for name in self._names(where):
            add_branch(spec, name, where.joint())

    def set(self, fields: Fields, where: Where, impedance: InterfaceImpedance, values: np.ndarray) -> None:
        """Write stiffness and damping."""
        for name, ratio in zip(self._names(where), self._ratios, strict=True):
            set_branch(fields, name, values[:, 0] / len(self._ratios), values[:, 1] * ratio)

    def relax(self, fields: Fields, where: Where, position: np.ndarray) -> None:
        """Move the hidden slides to where no branch pulls at joint positions (m, nq)."""
        coordinate = fields.model.joint(where.joint()).qposadr[0]
        for name in self._names(where):
            own = fields.model.joint(name).qposadr[0]
            rest = fields["tendon_lengthspring"][:, fields.tendon(name), 0]
            position[:, own] = position[:, coordinate] - rest


class TwoTimes(Maxwell):
    """Two such branches, values (m, 4): stiffness of both, share of the slower, time constant of the faster, ratio."""

    def __init__(self) -> None:
        super().__init__(2)

    def set(self, fields: Fields, where: Where, impedance: InterfaceImpedance, values: np.ndarray) -> None:
        """Write stiffness and damping."""
        stiffness, slow, fast, ratio = values.T
        for name, part, time in zip(self._names(where), (1 - slow, slow), (fast, fast * ratio), strict=True):
            set_branch(fields, name, part * stiffness, time)


class BoucWen(DrivenForce):
    """Bouc-Wen of exponent 1, values (m, 3) are stiffness, loading and dissipation of `bouc_wen`.

    MuJoCo has no such element. Yielding springs with the same loading curve stand for most of it and follow the
    simulated motion; the difference of the law from them is planned along the measured coordinate. If all of it were
    planned, a stiff element would turn that coordinate's noise into force, and hold nothing in the simulation.
    """

    kinds = ("hysteresis",)

    def __init__(self, elements: int):
        super().__init__()
        self._springs = Elastoplastic(elements)
        # while other effects are tried beside it, the same law is evaluated again and again
        self._planned = lru_cache(maxsize=256)(self._plan)

    def build(self, spec: mujoco.MjSpec, where: Where) -> None:
        """Add yielding tendons and a motor."""
        self._springs.build(spec, where)
        super().build(spec, where)

    def set(self, fields: Fields, where: Where, impedance: InterfaceImpedance, values: np.ndarray) -> None:
        """Write springs of the law's stiffness that yield along its loading curve."""
        self._springs.set(fields, where, impedance, self._yielding(values))

    def _yielding(self, values: np.ndarray) -> np.ndarray:
        # force and travel of those springs; a slope that does not fall makes springs that never yield
        travel = 1 / np.maximum(values[:, 1], 1e-3)
        return np.stack([values[:, 0] * travel * self._springs.travels.mean(), travel], axis=1)

    def force(
        self, values: np.ndarray, context: Context, where: Where, impedance: InterfaceImpedance
    ) -> np.ndarray:
        """Return the difference of the law from its springs along the measured coordinate."""
        q = CubicSpline(context.time_s, context.coordinates[:, where.axis])(context.step_time_s)
        path = q.tobytes()
        return np.array([self._planned(tuple(row), path) for row in values.tolist()])[:, :, None]

    def _plan(self, row: tuple[float, ...], path: bytes) -> np.ndarray:
        values, q = np.array([row]), np.frombuffer(path)
        return np.asarray((self._springs.along(q, self._yielding(values)) - bouc_wen(values, q))[0])


class FlowingMaxwell(DrivenForce):
    """A spring in series with an Eyring dashpot, whose rate grows faster than its force, values (m, 3) of `eyring`.

    MuJoCo has no such dashpot. A linear one of the same time constant follows the simulated motion; the difference of
    the law from it is planned along the measured coordinate.
    """

    kinds = ("memory",)

    def __init__(self) -> None:
        super().__init__()
        self._linear = Maxwell()

    def build(self, spec: mujoco.MjSpec, where: Where) -> None:
        """Add hidden slide, tendon and motor."""
        self._linear.build(spec, where)
        super().build(spec, where)

    def set(self, fields: Fields, where: Where, impedance: InterfaceImpedance, values: np.ndarray) -> None:
        """Write the linear branch."""
        self._linear.set(fields, where, impedance, values)

    def relax(self, fields: Fields, where: Where, position: np.ndarray) -> None:
        """Move the hidden slide of the linear branch."""
        self._linear.relax(fields, where, position)

    def force(
        self, values: np.ndarray, context: Context, where: Where, impedance: InterfaceImpedance
    ) -> np.ndarray:
        """Return the difference of the law from its linear branch along the measured coordinate."""
        q = CubicSpline(context.time_s, context.coordinates[:, where.axis])(context.step_time_s)
        step = context.step_time_s[1] - context.step_time_s[0]
        return np.asarray((maxwell(values[:, :2], q, step) - eyring(values, q, step))[:, :, None])


def maxwell(values: np.ndarray, q: np.ndarray, step_s: float) -> np.ndarray:
    """Force (m, n) of a spring and a linear dashpot in series, values (m, 2) are stiffness and time constant.

    Along a coordinate (n,) that they rest at the start of.
    """
    ways = np.diff(q)
    out = np.zeros((len(values), len(q)))
    for row, (spring, time) in zip(out, values, strict=True):
        kept = float(np.exp(-step_s / time))
        row[1:] = spring * scipy.signal.lfilter([kept], [1, -kept], ways)
    return out


# Stretch in lengths at which a flowing dashpot is as fast as the linear one of its time constant
_AS_LINEAR = 2.0


def eyring(values: np.ndarray, q: np.ndarray, step_s: float) -> np.ndarray:
    """Force (m, n) of a spring and an Eyring dashpot in series along a coordinate (n,) that they rest at the start of.

    Stiffness, time constant of a stretch of two lengths, and length l, values (m, 3). The stretch e follows
    e' = q' - r sinh(e / l). Between steps tanh(e / 2 l) fades as exp(-r t / l), whatever the step. Source: Eyring,
    J. Chem. Phys. 4 (1936) 283.
    """
    ways = np.diff(q).tolist()
    out = np.zeros((len(values), len(q)))
    for row, (spring, time, length) in zip(out, values, strict=True):
        fades = float(np.exp(-step_s * _AS_LINEAR / np.sinh(_AS_LINEAR) / time))
        row[:] = spring * np.array(_flown(ways, fades, 2 * float(length)))
    return out


def _flown(ways: list[float], fades: float, both: float) -> list[float]:
    """Stretches (n,) of the spring of `eyring` along ``ways`` (n - 1,) of its end; ``both`` is two lengths.

    Plain numbers, as of `_slipped`.
    """
    stretch, path = 0.0, [0.0]
    for way in ways:
        stretch = both * atanh(tanh((stretch + way) / both) * fades)
        path.append(stretch)
    return path


def bouc_wen(values: np.ndarray, q: np.ndarray) -> np.ndarray:
    """Force z (m, n) of stiffness k, loading b + g and dissipation b, values (m, 3), along a coordinate (n,).

    z' = k v - b |v| z - g v |z|: k - (b + g) |z| is its slope while it is loaded, k + (b - g) |z| while it is relieved;
    it takes energy for b > 0. Source: Wen, J. Eng. Mech. Div. 102 (1976) 249, exponent 1.
    """
    way = np.diff(q)
    z = np.zeros((len(values), len(q)))
    for row, (slope, loading, dissipation) in zip(z, values, strict=True):
        # linear in z while the signs last, loaded or relieved: each step is exact for its increment
        rate = np.array([loading, 2 * dissipation - loading])[:, None] * np.abs(way)
        small = np.abs(rate) < 1e-9
        gain = np.where(small, 1.0, -np.expm1(-rate) / np.where(small, 1.0, rate))
        added, kept = (slope * way * gain).tolist(), np.exp(-rate).tolist()
        force, path = 0.0, []
        # plain numbers: a step of arrays this short is all overhead
        for push, k0, k1, a0, a1 in zip((slope * way).tolist(), *kept, *added, strict=True):
            force = force * k0 + a0 if push * force >= 0 else force * k1 + a1
            path.append(force)
        row[1:] = path
    return z


_HOLDS = "steps with holds of 5-10 s"

EFFECTS = (
    Effect(
        "hysteresis",
        "interface",
        "springs beside the strap's own that yield one after the other (Maxwell slip)",
        (
            FRICTION,
            EffectParameter("travel", "m|rad", 0.04, 2.0, (0.1, 0.5), excursion, log=True),
        ),
        separating_trial="the same amplitude at 0.1, 1 and 4 Hz",
        at_rest=AtRest((1e-9, 0.5), limit="no force"),
        confusable=LOSSES,
        plant=Elastoplastic(4),
    ),
    Effect(
        "hysteresis",
        "interface",
        "F = z, z' = k qdot - b |qdot| z - g qdot |z|, loading = b + g, dissipation = b (Bouc-Wen, exponent 1)",
        (
            EffectParameter("stiffness", "N/m|Nm/rad", 0.02, 50.0, (0.5, 0.6), stiffness, log=True),
            EffectParameter("loading", "1/m|1/rad", -1.5, 25.0, (10.0, 2.0), per_excursion),
            EffectParameter("dissipation", "1/m|1/rad", 0.0, 12.5, (3.0, 0.6), per_excursion),
        ),
        separating_trial="the same amplitude at 0.1, 1 and 4 Hz",
        at_rest=AtRest((1e-9, 2.0, 0.6), limit="no stiffness"),
        confusable=LOSSES,
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
            EffectParameter("stiffness", "N/m|Nm/rad", 0.02, 30.0, (0.5, 3.0), stiffness, log=True),
            EffectParameter("time_constant", "s", 0.03, 2.5, (0.4, 0.1), seconds, log=True),
        ),
        separating_trial=_HOLDS,
        at_rest=AtRest((1e-9, 0.4), limit="no stiffness"),
        confusable=LOSSES,
        group="V",
        plant=Maxwell(),
    ),
    Effect(
        "relaxation",
        "interface",
        "as relaxation, with two time constants",
        (
            EffectParameter("stiffness", "N/m|Nm/rad", 0.02, 30.0, (0.5, 3.0), stiffness, log=True),
            EffectParameter("slower_share", "1", 0.05, 0.95, (0.5,)),
            EffectParameter("faster_time_constant", "s", 0.03, 0.6, (0.1,), seconds, log=True),
            EffectParameter("ratio", "1", 3.0, 40.0, (10.0,), log=True),
        ),
        separating_trial=_HOLDS,
        at_rest=AtRest((1e-9, 0.5, 0.1, 10.0), limit="no stiffness"),
        confusable=LOSSES,
        group="V",
        plant=TwoTimes(),
        form="_two_times",
        indistinguishable=True,
    ),
    Effect(
        "relaxation",
        "interface",
        "F1 = k1 e, e' = qdot - r sinh(e / length), r = 2 length / (time_constant sinh 2): an Eyring dashpot",
        (
            # stiffer and shorter it would be friction by another name
            EffectParameter("stiffness", "N/m|Nm/rad", 0.02, 8.0, (0.5, 3.0), stiffness, log=True),
            EffectParameter("time_constant", "s", 0.03, 2.5, (0.4, 0.1), seconds, log=True),
            EffectParameter("length", "m|rad", 0.12, 3.0, (0.3,), excursion, log=True),
        ),
        separating_trial=_HOLDS,
        at_rest=AtRest((1e-9, 0.4, 0.3), limit="no stiffness"),
        confusable=LOSSES,
        group="V",
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
            EffectParameter("stiffness", "N/m|Nm/rad", 0.02, 10.0, (0.5,), stiffness, log=True),
            EffectParameter("time_constant", "s", 2.5, 60.0, (6.0,), log=True),
        ),
        separating_trial="reload after a rest",
        at_rest=AtRest((1e-9, 6.0), limit="no stiffness"),
        confusable=(*LOSSES, "migration", "marker_drift"),
        plant=Maxwell(),
    ),
    Effect(
        "creep",
        "interface",
        "as relaxation, by the logarithm of time: four branches, each four times as slow as the one before",
        (
            EffectParameter("stiffness", "N/m|Nm/rad", 0.02, 10.0, (0.5,), stiffness, log=True),
            EffectParameter("shortest_time_constant", "s", 0.3, 5.0, (1.0,), log=True),
        ),
        separating_trial="reload after a rest",
        at_rest=AtRest((1e-9, 1.0), limit="no stiffness"),
        confusable=(*LOSSES, "migration", "marker_drift"),
        plant=Maxwell(4, 4.0),
        form="_log_time",
    ),
)
