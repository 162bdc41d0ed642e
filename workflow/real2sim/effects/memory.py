"""Straps that remember: springs that yield, branches that relax."""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache

import mujoco
import numpy as np
from scipy.interpolate import CubicSpline

from real2sim.effects.base import Fields, Where, add_branch, add_tendon, set_branch
from real2sim.effects.planned import PlannedForce
from real2sim.system.plant import STRAP_JOINTS


class Elastoplastic:
    """Springs in parallel that yield one after the other: values are yield force and yield travel, (m, 2).

    Equal springs whose travels are quantiles of an exponential law: together they approach the force as
    1 - exp(-x / travel), as the Bouc-Wen law of exponent 1 does, with the memory of reversals that Masing described.
    """

    def __init__(self, elements: int):
        self.travels = -np.log(1 - (np.arange(elements) + 0.5) / elements)

    def _names(self, where: Where) -> list[str]:
        return [f"yield{i}_{where.element}" for i in range(len(self.travels))]

    def build(self, spec, where):
        """One yielding tendon per element."""
        for name in self._names(where):
            _yielding_tendon(spec, name, where)

    def set(self, fields, where, parameters, values):
        """Stiffness so that they yield at the force; never stiffer than the time step bears."""
        stiffness = values[:, 0] / values[:, 1] / self.travels.sum() * len(self.travels)
        share = np.minimum(stiffness, fields.stiffest(where.axes[0])) / len(self.travels)
        for name, travel in zip(self._names(where), self.travels, strict=True):
            index = fields.tendon(name)
            fields["tendon_stiffness"][:, index] = share
            fields["tendon_springyield"][:, index] = (
                travel * values[:, 1] * stiffness / (share * len(self.travels))
            )

    def along(self, q: np.ndarray, values: np.ndarray) -> np.ndarray:
        """Force (m, n) of the springs along a coordinate (n,) that they rest at the origin of."""
        slips = self.travels * values[:, 1:]
        stiffness = values[:, :1, None] / values[:, 1:, None] / self.travels.sum()
        stretch = np.empty((len(q), *slips.shape))
        stretch[0] = np.clip(q[0], -slips, slips)
        # np.clip costs several times what it does here
        for last, now, way in zip(stretch[:-1], stretch[1:], np.diff(q), strict=True):
            np.add(last, way, out=now)
            np.minimum(now, slips, out=now)
            np.maximum(now, -slips, out=now)
        return np.asarray((stiffness * np.moveaxis(stretch, 0, 1)).sum(axis=2))


def _yielding_tendon(spec: mujoco.MjSpec, name: str, where: Where) -> None:
    joint = {STRAP_JOINTS[where.axes[0]]: 1.0}
    add_tendon(spec, name, joint, stiffness=[1, 0, 0], springlength=[0, 0], springyield=0.01)


class Maxwell:
    """Springs and dampers in series beside a joint's own: values are stiffness and shortest time constant, (m, 2).

    ``branches`` of equal stiffness, which adds up to the value, have time constants that grow by ``ratio``: together
    they relax with the logarithm of time. The point between spring and damper of each is a hidden slide in the world,
    tied to the strap joint by a tendon.
    """

    def __init__(self, branches: int = 1, ratio: float = 1.0):
        self._ratios = ratio ** np.arange(branches)

    def _names(self, where: Where) -> list[str]:
        return [f"maxwell{i or ''}_{where.element}" for i in range(len(self._ratios))]

    def build(self, spec, where):
        """Hidden slide and tendon of each branch."""
        for name in self._names(where):
            add_branch(spec, name, STRAP_JOINTS[where.axes[0]])

    def set(self, fields, where, parameters, values):
        """Stiffness and damping."""
        for name, ratio in zip(self._names(where), self._ratios, strict=True):
            set_branch(fields, name, values[:, 0] / len(self._ratios), values[:, 1] * ratio)

    def relax(self, fields: Fields, where: Where, position: np.ndarray) -> None:
        """Let no branch pull at joint positions (m, nq), which are changed in place."""
        strap = fields.model.joint(STRAP_JOINTS[where.axes[0]]).qposadr[0]
        for name in self._names(where):
            own = fields.model.joint(name).qposadr[0]
            position[:, own] = position[:, strap] - fields["tendon_lengthspring"][:, fields.tendon(name), 0]


class TwoTimes(Maxwell):
    """Two such branches, values (m, 4): stiffness of both, share of the slower, time constant of the faster, ratio."""

    def __init__(self):
        super().__init__(2)

    def set(self, fields, where, parameters, values):
        """Stiffness and damping."""
        stiffness, slow, fast, ratio = values.T
        for name, part, time in zip(self._names(where), (1 - slow, slow), (fast, fast * ratio), strict=True):
            set_branch(fields, name, part * stiffness, time)


class BoucWen(PlannedForce):
    """Bouc-Wen of exponent 1, values (m, 3) are stiffness, loading and dissipation of `bouc_wen`.

    MuJoCo has no such element. Yielding springs with the same loading curve stand for most of it and answer to the
    simulated motion; what the law differs from them is planned along the measured coordinate. Were all of it planned, a
    stiff element would make a force of that coordinate's noise, and hold nothing in the simulation.
    """

    def __init__(self, elements: int):
        super().__init__(self._difference)
        self._springs = Elastoplastic(elements)
        # beside other effects the same law is asked for again and again while those are tried
        self._planned = lru_cache(maxsize=256)(self._plan)

    def build(self, spec, where):
        """Yielding tendons and a motor."""
        self._springs.build(spec, where)
        super().build(spec, where)

    def set(self, fields, where, parameters, values):
        """Springs of the law's stiffness that yield along its loading curve."""
        self._springs.set(fields, where, parameters, self._yielding(values))

    def _yielding(self, values: np.ndarray) -> np.ndarray:
        # force and travel of those springs; a slope that does not fall makes springs that never yield
        travel = 1 / np.maximum(values[:, 1], 1e-3)
        return np.stack([values[:, 0] * travel * self._springs.travels.mean(), travel], axis=1)

    def _difference(self, values, context, where, parameters):
        q = CubicSpline(context.time_s, context.coordinates[:, where.axes[0]])(context.step_time_s)
        path = q.tobytes()
        return np.array([self._planned(tuple(row), path) for row in values.tolist()])[:, :, None]

    def _plan(self, row: tuple[float, ...], path: bytes) -> np.ndarray:
        values, q = np.array([row]), np.frombuffer(path)
        return (self._springs.along(q, self._yielding(values)) - bouc_wen(values, q))[0]


class FlowingMaxwell(PlannedForce):
    """A spring in series with a dashpot that flows the easier the more it carries, values (m, 3) of `eyring`.

    MuJoCo has no such dashpot. A linear one of the same time constant answers to the simulated motion; what the law
    differs from it is planned along the measured coordinate.
    """

    def __init__(self):
        super().__init__(self._difference)
        self._linear = Maxwell()

    def build(self, spec, where):
        """Hidden slide, tendon and motor."""
        self._linear.build(spec, where)
        super().build(spec, where)

    def set(self, fields, where, parameters, values):
        """The linear branch."""
        self._linear.set(fields, where, parameters, values)

    def relax(self, fields: Fields, where: Where, position: np.ndarray) -> None:
        """As of `Maxwell`."""
        self._linear.relax(fields, where, position)

    @staticmethod
    def _difference(values, context, where, parameters):
        q = CubicSpline(context.time_s, context.coordinates[:, where.axes[0]])(context.step_time_s)
        step = context.step_time_s[1] - context.step_time_s[0]
        return (maxwell(values[:, :2], q, step) - eyring(values, q, step))[:, :, None]


def maxwell(values: np.ndarray, q: np.ndarray, step_s: float) -> np.ndarray:
    """Force (m, n) of a spring and a linear dashpot in series, values (m, 2) are stiffness and time constant.

    Along a coordinate (n,) that they rest at the start of.
    """
    stiffness, time = values.T
    fades = np.exp(-step_s / time)
    return stiffness[:, None] * _stretched(q, lambda e: e * fades, len(values))


# Stretch in lengths at which a flowing dashpot is as fast as the linear one of its time constant
_AS_LINEAR = 2.0


def eyring(values: np.ndarray, q: np.ndarray, step_s: float) -> np.ndarray:
    """Force (m, n) of a spring and an Eyring dashpot in series along a coordinate (n,) that they rest at the start of.

    Stiffness, time constant of a stretch of two lengths, and length l, values (m, 3). The stretch e follows
    e' = q' - r sinh(e / l). Between steps tanh(e / 2 l) fades as exp(-r t / l), whatever the step. Source: Eyring,
    J. Chem. Phys. 4 (1936) 283.
    """
    stiffness, time, length = values.T
    fades = np.exp(-step_s * _AS_LINEAR / np.sinh(_AS_LINEAR) / time)
    both = 2 * length
    return stiffness[:, None] * _stretched(
        q, lambda e: both * np.arctanh(np.tanh(e / both) * fades), len(values)
    )


def _stretched(q: np.ndarray, flown: Callable[[np.ndarray], np.ndarray], count: int) -> np.ndarray:
    """Stretches (count, n) of springs along a coordinate (n,): ``flown`` is what a step leaves of them, (count,)."""
    stretch = np.zeros((len(q), count))
    for last, now, way in zip(stretch[:-1], stretch[1:], np.diff(q), strict=True):
        now[:] = flown(last + way)
    return stretch.T


def bouc_wen(values: np.ndarray, q: np.ndarray) -> np.ndarray:
    """Force z (m, n) of stiffness k, loading b + g and dissipation b, values (m, 3), along a coordinate (n,).

    z' = k v - b |v| z - g v |z|: k - (b + g) |z| is its slope while it is loaded, k + (b - g) |z| while it is relieved;
    it takes energy for b > 0. Source: Wen, J. Eng. Mech. Div. 102 (1976) 249, exponent 1.
    """
    way = np.diff(q)
    z = np.zeros((len(values), len(q)))
    for row, (stiffness, loading, dissipation) in zip(z, values, strict=True):
        # linear in z while the signs last, loaded or relieved: each step is exact for its increment
        rate = np.array([loading, 2 * dissipation - loading])[:, None] * np.abs(way)
        small = np.abs(rate) < 1e-9
        gain = np.where(small, 1.0, -np.expm1(-rate) / np.where(small, 1.0, rate))
        added, kept = (stiffness * way * gain).tolist(), np.exp(-rate).tolist()
        force, path = 0.0, []
        # plain numbers: a step of arrays this short is all overhead
        for push, k0, k1, a0, a1 in zip((stiffness * way).tolist(), *kept, *added, strict=True):
            force = force * k0 + a0 if push * force >= 0 else force * k1 + a1
            path.append(force)
        row[1:] = path
    return z
