"""Forms of the stratum `random_law`: causes that no catalogue lists, each a draw of shape, axis and sign.

Importing this module enters them in `effects.FORMS`. Each states its `TrueLaw` for the sealed truth.
"""

from __future__ import annotations

import zlib
from collections.abc import Callable
from typing import Any, ClassVar

import numpy as np
from numpy.random import Generator
from scipy.signal import lfilter
from scipy.spatial.transform import Rotation

from real2sim.geometry import interface_coordinates, relative_pose
from real2sim.verification.phantom.physics import AXES
from real2sim.verification.suite import random_laws as laws
from real2sim.verification.suite.effects import (
    Context,
    Draw,
    Form,
    Values,
    axis_weights,
    displace,
    register,
    strongest,
)
from real2sim.verification.suite.laws import Prony
from real2sim.verification.suite.measurement import Markers, Recording, pelvis_pose, sampled
from real2sim.verification.suite.random_functions import (
    Function,
    band_limited,
    box,
    curved,
    draw_function,
    evaluate,
    gradient,
    hessian,
    scale,
)
from real2sim.verification.suite.setups import Setup
from real2sim.verification.suite.true_laws import JOINTS, PLACES, SPEEDS, TrueLaw

# Posture of the pelvis against the start of the trial, in the order of `Context.posture`
POSTURES = ("tilt", "list", "heading", "height")
_RATE_HZ = 500.0  # of the histories that displaced markers follow
_BRANCHES = 8

Sampled = Callable[[np.ndarray], np.ndarray]


def posture(rotation: np.ndarray, position: np.ndarray) -> np.ndarray:
    """Return tilt, list, heading [rad] and height [m] (n, 4) of a pelvis (n, 3, 3), (n, 3) against its first sample."""
    angles = Rotation.from_matrix(rotation[0].T @ rotation).as_euler("ZYX")
    return np.column_stack([angles[:, 1], angles[:, 2], angles[:, 0], position[:, 2] - position[0, 2]])


def _pick(rng: Generator, count: int) -> np.ndarray:
    """Different axes by index, translations a little more often than rotations."""
    weights = axis_weights()
    return rng.choice(6, size=count, replace=False, p=weights / weights.sum())


def _mark(*axes: int) -> np.ndarray:
    chosen = np.zeros(6, bool)
    chosen[list(axes)] = True
    return chosen


def _fade(t: np.ndarray, start_s: float) -> np.ndarray:
    """From 0 to 1 within a second after the motion begins: the trial starts in balance."""
    s = np.clip(t - start_s, 0.0, 1.0)
    faded: np.ndarray = s * s * (3 - 2 * s)
    return faded


def _lifted(function: Function, points: np.ndarray) -> tuple[Function, float]:
    """Return the function scaled to a range of 1 over the points (k, d), and its least value there."""
    values = evaluate(function, points)
    factor = 1 / max(float(np.ptp(values)), 1e-3)
    return scale(function, factor), float(values.min()) * factor


class RandomForm(Form):
    """An unlisted law. ``kinds`` of it, ``kin``: effects of the catalogue whose law may be as good."""

    stage = "interface"
    kinds: ClassVar[tuple[str, ...]] = ()
    kin: ClassVar[tuple[str, ...]] = ()

    def law(self, draw: Draw) -> TrueLaw:
        """The law as the truth states it."""
        raise NotImplementedError

    def truth(self, draw: Draw, values: Values) -> Values:
        return {name: np.asarray(value).tolist() for name, value in values.items()}

    def on_axes(self, axes: Any, depends_on: tuple[str, ...], variable: str | None = None) -> TrueLaw:
        """Law that acts on strap axes, by index; with a curve over ``variable`` where it is given."""
        names = tuple(AXES[i] for i in axes)
        curves = () if variable is None else ((variable, names[0]),)
        return TrueLaw(self.stage, names, self.kinds, (depends_on,), curves, self.kin)

    def on_joint(self, joint: int, depends_on: tuple[str, ...], variable: str | None = None) -> TrueLaw:
        """Law that acts on a joint of the robot, by index."""
        curves = () if variable is None else ((variable, JOINTS[joint]),)
        return TrueLaw(self.stage, (JOINTS[joint],), self.kinds, (depends_on,), curves, self.kin)


# -------------------- interface: springs


@register
class RandomElastic(RandomForm):
    """Potential of one coordinate: the total stiffness falls by 90 % or the force becomes fourfold at most."""

    effect = form = "random_elastic"
    kinds: ClassVar[tuple[str, ...]] = ("elastic",)
    kin: ClassVar[tuple[str, ...]] = (
        "slack",
        "one_sided",
        "stiffening",
        "asymmetric_stiffness",
        "joint_limit",
    )
    dimensions: ClassVar[tuple[int, ...]] = (1,)

    def draw(self, rng: Generator, about: Context) -> Draw:
        count = int(rng.choice(self.dimensions))
        which = _pick(rng, count)
        function = draw_function(rng, count, padded=3)
        padded = np.concatenate([which, np.zeros(3 - count, int)])
        return Draw(_mark(*which), {"which": padded, "count": count, **function})

    def values(self, draw: Draw, severity: float, about: Context) -> Values:
        which, count = draw.values["which"], draw.values["count"]
        function = {name: draw.values[name] for name in ("frequency", "phase", "amplitude")}
        reach = about.reach[which]
        own = np.sqrt(about.stiffness[which] * reach**2)[:count]  # root of twice the strap's own energy
        points = box(count, 3)
        bend = hessian(function, points)[:, :count, :count] / own / own[:, None]
        softest = float(np.linalg.eigvalsh(bend).min())
        slope = gradient(function, points)[:, :count] - gradient(function, np.zeros(3))[:count]
        strongest_pull = float(np.abs(slope / own**2).max())
        energy = min(0.9 / max(-softest, 1e-6), 3.0 / max(strongest_pull, 1e-6))
        return {"which": which, "scale": reach, "energy": severity * energy, **function}

    def change(self, setup: Setup, values: Values, trial: str, about: Context) -> None:
        setup.terms.append((laws.Potential, dict(values)))

    def law(self, draw: Draw) -> TrueLaw:
        which = draw.values["which"][: draw.values["count"]]
        depends_on = tuple(f"q_{AXES[i]}" for i in which)
        return self.on_axes(which, depends_on, depends_on[0] if len(which) == 1 else None)


@register
class RandomElasticCoupling(RandomElastic):
    """Potential of two or three coordinates, which no sum of single ones is."""

    effect = form = "random_elastic_coupling"
    kinds: ClassVar[tuple[str, ...]] = ("elastic coupling",)
    kin: ClassVar[tuple[str, ...]] = ("cross_coupling", "misalignment")
    dimensions = (2, 2, 3)


@register
class RandomCoupling(RandomForm):
    """Force on one axis from another's coordinate or rate, or from its own coordinate times the other's rate."""

    effect = form = "random_coupling"
    kinds: ClassVar[tuple[str, ...]] = ("coupling",)
    kin: ClassVar[tuple[str, ...]] = ("cross_coupling", "misalignment")

    def draw(self, rng: Generator, about: Context) -> Draw:
        axis, source = _pick(rng, 2)
        kind = str(rng.choice(["coordinate", "rate", "product"]))
        fixed = {"axis": axis, "source": source, "sign": rng.choice([-1.0, 1.0]), "of": kind}
        return Draw(_mark(axis), fixed | curved(rng))

    def values(self, draw: Draw, severity: float, about: Context) -> Values:
        d = draw.values
        axis, source = d["axis"], d["source"]
        if d["of"] == "product":
            most = about.stiffness[axis] / about.speed[source]
            return {"axis": axis, "source": source, "coefficient": d["sign"] * severity * most}
        rate = d["of"] == "rate"
        return {
            "axis": axis,
            "source": source,
            "of_rate": float(rate),
            "scale": (about.speed if rate else about.reach)[source],
            "strength": severity * 1.5 * about.stiffness[axis] * about.reach[axis],
            **{name: d[name] for name in ("frequency", "phase", "amplitude")},
        }

    def change(self, setup: Setup, values: Values, trial: str, about: Context) -> None:
        setup.terms.append((laws.Product if "coefficient" in values else laws.Cross, dict(values)))

    def law(self, draw: Draw) -> TrueLaw:
        own, other = AXES[draw.values["axis"]], AXES[draw.values["source"]]
        if draw.values["of"] == "product":
            return self.on_axes([draw.values["axis"]], (f"q_{own}", f"v_{other}"))
        variable = f"{'v' if draw.values['of'] == 'rate' else 'q'}_{other}"
        return self.on_axes([draw.values["axis"]], (variable,), variable)


# -------------------- interface: dissipation


@register
class RandomDissipation(RandomForm):
    """Damping that is a random function of rate, at most eight times the linear one and never negative."""

    effect = form = "random_dissipation"
    kinds: ClassVar[tuple[str, ...]] = ("dissipative",)
    kin: ClassVar[tuple[str, ...]] = ("coulomb", "lugre", "quadratic_damping")

    def draw(self, rng: Generator, about: Context) -> Draw:
        axis = int(_pick(rng, 1)[0])
        return Draw(_mark(axis), {"axis": axis, **self.shape(rng)})

    def shape(self, rng: Generator) -> Values:
        """Draw the function of coordinate and rate, and its least value over the visited range."""
        function = draw_function(rng, 1, (0.25, 0.8))
        function["frequency"] = np.hstack([np.zeros_like(function["frequency"]), function["frequency"]])
        lifted, least = _lifted(function, box(1, 2)[:, ::-1])
        return {**lifted, "least": least}

    def values(self, draw: Draw, severity: float, about: Context) -> Values:
        axis = draw.values["axis"]
        most = min(8 * about.damping[axis], 150 * about.mobility[axis])
        place = {"reach": about.reach[axis], "speed": about.speed[axis]}
        return {**draw.values, **place, "damping": severity * most}

    def change(self, setup: Setup, values: Values, trial: str, about: Context) -> None:
        setup.terms.append((laws.Drag, dict(values)))

    def law(self, draw: Draw) -> TrueLaw:
        variable = f"v_{AXES[draw.values['axis']]}"
        return self.on_axes([draw.values["axis"]], (variable,), variable)


@register
class RandomDampingByCoordinate(RandomDissipation):
    """Damping that is a random function of coordinate, or of coordinate and rate."""

    effect = form = "random_damping_by_coordinate"
    kinds: ClassVar[tuple[str, ...]] = ("damping by coordinate",)
    kin: ClassVar[tuple[str, ...]] = ("quadratic_damping",)

    def shape(self, rng: Generator) -> Values:
        dimensions = int(rng.integers(1, 3))
        lifted, least = _lifted(draw_function(rng, dimensions, padded=2), box(dimensions, 2))
        return {**lifted, "least": least}

    def law(self, draw: Draw) -> TrueLaw:
        axis = AXES[draw.values["axis"]]
        return self.on_axes([draw.values["axis"]], (f"q_{axis}", f"v_{axis}"))


@register
class RandomMemory(RandomForm):
    """Two to five relaxations at random times, now and then of negative sign, or a fractional derivative.

    Together with the strap they stay passive: no frequency sees negative damping, none less than a fifth of the
    stiffness.
    """

    effect = form = "random_memory"
    kinds: ClassVar[tuple[str, ...]] = ("memory",)
    kin: ClassVar[tuple[str, ...]] = ("relaxation", "creep")

    def draw(self, rng: Generator, about: Context) -> Draw:
        axis = int(_pick(rng, 1)[0])
        share, tau = np.zeros(_BRANCHES), np.ones(_BRANCHES)
        if rng.random() < 0.3:
            tau = np.geomspace(0.02, 5.0, _BRANCHES)
            share = tau ** -rng.uniform(0.2, 0.8)
        else:
            count = int(rng.integers(2, 6))
            tau[:count] = np.exp(rng.uniform(np.log(0.05), np.log(8.0), count))
            share[:count] = rng.uniform(0.2, 1.0, count) * np.where(rng.random(count) < 0.2, -1, 1)
            share[0] = abs(share[0])
        return Draw(_mark(axis), {"axis": axis, "tau": tau, "share": share / np.abs(share).sum()})

    def values(self, draw: Draw, severity: float, about: Context) -> Values:
        axis, tau = draw.values["axis"], draw.values["tau"]
        branch = 6 * severity * about.stiffness[axis] * draw.values["share"]
        branch = passive_branches(branch, tau, float(about.stiffness[axis]), float(about.damping[axis]))
        return {"branch": np.outer(np.arange(6) == axis, branch), "tau": tau}

    def change(self, setup: Setup, values: Values, trial: str, about: Context) -> None:
        setup.terms.append((Prony, dict(values)))

    def law(self, draw: Draw) -> TrueLaw:
        return self.on_axes([draw.values["axis"]], (f"history of q_{AXES[draw.values['axis']]}",))


def passive_branches(branch: np.ndarray, tau: np.ndarray, stiffness: float, damping: float) -> np.ndarray:
    """Return the branches (m,) with the negative ones small enough for a passive strap."""
    w = np.geomspace(1e-3, 1e3, 400)[:, None] * tau
    up, down = np.maximum(branch, 0.0), np.maximum(-branch, 0.0)
    kept = 1.0
    for each, own in ((tau / (1 + w * w), damping), (w * w / (1 + w * w), 0.8 * stiffness)):
        taken = each @ down
        kept = min(kept, float(np.min((own + each @ up) / np.maximum(taken, 1e-12))))
    out: np.ndarray = up - min(kept, 1.0) * down
    return out


@register
class RandomHysteresis(RandomForm):
    """Parallel springs that slip at random thresholds between 3 and 100 % of the reach: rate-independent."""

    effect = form = "random_hysteresis"
    kinds: ClassVar[tuple[str, ...]] = ("hysteresis",)
    kin: ClassVar[tuple[str, ...]] = ("hysteresis", "coulomb", "lugre")

    def draw(self, rng: Generator, about: Context) -> Draw:
        axis = int(_pick(rng, 1)[0])
        travel = np.exp(rng.uniform(np.log(0.03), np.log(1.0), _BRANCHES))
        return Draw(
            _mark(axis), {"axis": axis, "travel": travel, "share": rng.dirichlet(np.full(_BRANCHES, 0.5))}
        )

    def values(self, draw: Draw, severity: float, about: Context) -> Values:
        d, axis = draw.values, draw.values["axis"]
        threshold = severity * strongest(about)[axis] * d["share"]
        spring = threshold / (d["travel"] * about.reach[axis])
        on = np.arange(6) == axis
        return {"spring": np.outer(on, spring), "threshold": np.outer(on, threshold)}

    def change(self, setup: Setup, values: Values, trial: str, about: Context) -> None:
        setup.terms.append((laws.Plays, dict(values)))

    def law(self, draw: Draw) -> TrueLaw:
        return self.on_axes([draw.values["axis"]], (f"history of q_{AXES[draw.values['axis']]}",))


# -------------------- interface: gains and histories


def _gained(rng: Generator) -> tuple[str, float]:
    """Draw what a gain acts on, and the largest: stiffness becomes fourfold, damping sevenfold at most."""
    return ("q", 3.0) if rng.random() < 0.65 else ("v", 6.0)


class _Gain(RandomForm):
    # gain of stiffness or damping of one axis in some variable; never less than the linear law
    def draw(self, rng: Generator, about: Context) -> Draw:
        axis = int(_pick(rng, 1)[0])
        of, most = _gained(rng)
        function, least = _lifted(draw_function(rng, 1, (0.4, 1.3)), box(1, 1))
        fixed = {"axis": axis, "of": of, "most": most, "least": least, "variable": self.variable(rng, about)}
        return Draw(_mark(axis), {**fixed, **function})

    def variable(self, rng: Generator, about: Context) -> int:
        """Index of the variable that the gain follows."""
        return 0

    def values(self, draw: Draw, severity: float, about: Context) -> Values:
        d, axis = draw.values, draw.values["axis"]
        own = {
            "stiffness": about.stiffness[axis] * (d["of"] == "q"),
            "damping": about.damping[axis] * (d["of"] == "v"),
        }
        return {**d, **own, "most": d["most"] * severity}

    def scheduled(self, setup: Setup, values: Values, s: np.ndarray, push: np.ndarray | None = None) -> None:
        """Add the law with the gain at scaled arguments s (n,), one per time of the table."""
        gain = values["most"] * np.maximum(evaluate(values, s[:, None]) - values["least"], 0.0)
        own = {key: values[key] for key in ("axis", "stiffness", "damping")}
        setup.terms.append((laws.Scheduled, own | {"push": np.zeros_like(s), "gain": gain}))

    def depends(self, draw: Draw, variable: str) -> TrueLaw:
        """Law that depends on a variable and on coordinate or rate of the axis."""
        own = f"{draw.values['of']}_{AXES[draw.values['axis']]}"
        return self.on_axes([draw.values["axis"]], (own, variable))


@register
class RandomGainTime(_Gain):
    """Stiffness or damping that changes slowly through a trial, the same way in each."""

    effect = form = "random_gain_time"
    kinds: ClassVar[tuple[str, ...]] = ("slow change",)

    def change(self, setup: Setup, values: Values, trial: str, about: Context) -> None:
        t = laws.table_times(setup.path.duration_s)
        self.scheduled(setup, values, 2 * t / about.duration_s - 1)

    def law(self, draw: Draw) -> TrueLaw:
        return self.depends(draw, "time")


@register
class RandomGainPosture(_Gain):
    """Stiffness or damping that depends on the pelvis' tilt, list, heading or height."""

    effect = form = "random_gain_posture"
    kinds: ClassVar[tuple[str, ...]] = ("posture",)

    def variable(self, rng: Generator, about: Context) -> int:
        return int(rng.integers(4))

    def change(self, setup: Setup, values: Values, trial: str, about: Context) -> None:
        rotation, position = setup.path(laws.table_times(setup.path.duration_s))[:2]
        i = values["variable"]
        self.scheduled(setup, values, posture(rotation, position)[:, i] / about.posture[i])

    def law(self, draw: Draw) -> TrueLaw:
        return self.depends(draw, f"pelvis_{POSTURES[draw.values['variable']]}")


@register
class RandomGainPlace(_Gain):
    """Stiffness or damping of the strap that depends on where the robot's base is."""

    effect = form = "random_gain_place"
    kinds: ClassVar[tuple[str, ...]] = ("place",)

    def variable(self, rng: Generator, about: Context) -> int:
        return int(rng.integers(2))

    def change(self, setup: Setup, values: Values, trial: str, about: Context) -> None:
        joint = values["variable"]
        place = {"joint": joint, "start": setup.controller.start[joint], "scale": about.place[joint]}
        names = ("axis", "stiffness", "damping", "most", "least", "frequency", "phase", "amplitude")
        setup.terms.append((laws.PlaceGain, place | {name: values[name] for name in names}))

    def law(self, draw: Draw) -> TrueLaw:
        return self.depends(draw, PLACES[draw.values["variable"]])


@register
class RandomRhythm(RandomForm):
    """A sinusoid of 0.2 to 3 Hz: as a force on one axis, or as a gain of its stiffness or damping."""

    effect = form = "random_rhythm"
    kinds: ClassVar[tuple[str, ...]] = ("rhythm",)

    def draw(self, rng: Generator, about: Context) -> Draw:
        axis = int(_pick(rng, 1)[0])
        hz = float(np.exp(rng.uniform(*np.log([0.2, 3.0]))))
        of = str(rng.choice(["force", "q", "v"], p=[0.5, 0.3, 0.2]))
        return Draw(_mark(axis), {"axis": axis, "hz": hz, "of": of, "seed": int(rng.integers(2**31))})

    def values(self, draw: Draw, severity: float, about: Context) -> Values:
        axis, of = draw.values["axis"], draw.values["of"]
        most = float(strongest(about)[axis]) if of == "force" else {"q": 0.8, "v": 2.0}[of]
        return {**draw.values, "size": severity * most}

    def change(self, setup: Setup, values: Values, trial: str, about: Context) -> None:
        t, axis, of = laws.table_times(setup.path.duration_s), values["axis"], values["of"]
        phase = _trial_rng(values["seed"], trial).uniform(0, 2 * np.pi)
        wave = values["size"] * np.sin(2 * np.pi * values["hz"] * t + phase)
        # damping grows from what it is, stiffness swings about it
        wave += values["size"] if of == "v" else 0.0
        push = wave * _fade(t, about.start_s) * (of == "force" and trial != "neutral")
        own = {"stiffness": about.stiffness[axis] * (of == "q"), "damping": about.damping[axis] * (of == "v")}
        table = {"axis": axis, "push": push, "gain": wave * (of != "force")}
        setup.terms.append((laws.Scheduled, table | own))

    def law(self, draw: Draw) -> TrueLaw:
        of, axis = draw.values["of"], draw.values["axis"]
        own = () if of == "force" else (f"{of}_{AXES[axis]}",)
        return self.on_axes([axis], (*own, "time"))


def _trial_rng(seed: int, trial: str) -> Generator:
    return np.random.default_rng([seed, zlib.crc32(trial.encode())])


@register
class RandomForceStrap(RandomForm):
    """Force on one axis of the strap with a random history below 2 Hz, another in each trial."""

    effect = form = "random_force_strap"
    kinds: ClassVar[tuple[str, ...]] = ("external force",)

    def draw(self, rng: Generator, about: Context) -> Draw:
        axis = int(_pick(rng, 1)[0])
        return Draw(_mark(axis), {"axis": axis, "seed": int(rng.integers(2**31))})

    def values(self, draw: Draw, severity: float, about: Context) -> Values:
        return {**draw.values, "size": 0.6 * severity * strongest(about)[draw.values["axis"]]}

    def change(self, setup: Setup, values: Values, trial: str, about: Context) -> None:
        if trial != "neutral":
            push = _external(setup, values, trial, about)
            nothing = {"gain": np.zeros_like(push), "stiffness": 0.0, "damping": 0.0}
            setup.terms.append((laws.Scheduled, {"axis": values["axis"], "push": push} | nothing))

    def law(self, draw: Draw) -> TrueLaw:
        return self.on_axes([draw.values["axis"]], ("time",))


def _external(setup: Setup, values: Values, trial: str, about: Context) -> np.ndarray:
    """History of an external force [N, Nm] of standard deviation ``size``, at the times of a table."""
    t = laws.table_times(setup.path.duration_s)
    history = band_limited(_trial_rng(values["seed"], trial), t, 0.1, 2.0)
    force: np.ndarray = values["size"] * history * _fade(t, about.start_s)
    return force


# -------------------- robot


class _BaseForm(RandomForm):
    # a law on one slide of the base
    stage = "robot"

    def draw(self, rng: Generator, about: Context) -> Draw:
        return Draw(values={"joint": int(rng.integers(2)), **self.shape(rng)})

    def shape(self, rng: Generator) -> Values:
        """Draw what does not depend on the joint."""
        raise NotImplementedError


@register
class RandomForceBase(_BaseForm):
    """Force on the base with a random history below 2 Hz, another in each trial: 40 N (SD) at most."""

    effect = form = "random_force_base"
    kinds: ClassVar[tuple[str, ...]] = ("external force",)

    def shape(self, rng: Generator) -> Values:
        return {"seed": int(rng.integers(2**31))}

    def values(self, draw: Draw, severity: float, about: Context) -> Values:
        return {**draw.values, "size": 40.0 * severity}

    def change(self, setup: Setup, values: Values, trial: str, about: Context) -> None:
        if trial != "neutral":
            push = _external(setup, values, trial, about)
            setup.terms.append((laws.ScheduledPush, {"joint": values["joint"], "push": push}))

    def law(self, draw: Draw) -> TrueLaw:
        return self.on_joint(draw.values["joint"], ("time",))


@register
class RandomBasePlace(_BaseForm):
    """Force on the base by its place, up to 80 N off a straight line: a floor that is not level, a cable."""

    effect = form = "random_base_place"
    kinds: ClassVar[tuple[str, ...]] = ("place",)
    kin: ClassVar[tuple[str, ...]] = ("base_compliance",)

    def shape(self, rng: Generator) -> Values:
        return dict(curved(rng))

    def values(self, draw: Draw, severity: float, about: Context) -> Values:
        scaled = {"scale": about.place[draw.values["joint"]], "strength": 80.0 * severity}
        return {**draw.values, **scaled}

    def change(self, setup: Setup, values: Values, trial: str, about: Context) -> None:
        start = {"start": setup.controller.start[values["joint"]]}
        setup.terms.append((laws.PlaceForce, {**values, **start}))

    def law(self, draw: Draw) -> TrueLaw:
        variable = PLACES[draw.values["joint"]]
        return self.on_joint(draw.values["joint"], (variable,), variable)


@register
class RandomBaseSpeed(_BaseForm):
    """Dissipation of the base that is a random function of its speed, up to 2 kN s/m and never negative."""

    effect = form = "random_base_speed"
    kinds: ClassVar[tuple[str, ...]] = ("dissipative",)
    kin: ClassVar[tuple[str, ...]] = ("base_compliance",)

    def shape(self, rng: Generator) -> Values:
        lifted, least = _lifted(draw_function(rng, 1, (0.25, 0.8)), box(1, 1))
        return {**lifted, "least": least}

    def values(self, draw: Draw, severity: float, about: Context) -> Values:
        scaled = {"scale": about.place_rate[draw.values["joint"]], "damping": 2000.0 * severity}
        return {**draw.values, **scaled}

    def change(self, setup: Setup, values: Values, trial: str, about: Context) -> None:
        setup.terms.append((laws.SpeedForce, dict(values)))

    def law(self, draw: Draw) -> TrueLaw:
        variable = SPEEDS[draw.values["joint"]]
        return self.on_joint(draw.values["joint"], (variable,), variable)


# -------------------- measurement


class _Displacement(RandomForm):
    # markers of one body displaced together, in the axes of that body, by a function of one variable
    moves_truth = False
    kinds: ClassVar[tuple[str, ...]] = ("measurement",)
    body: ClassVar[str]

    def draw(self, rng: Generator, about: Context) -> Draw:
        way = rng.standard_normal(3)
        fixed = {
            "of": str(rng.choice(["orientation", "history", "time"], p=[0.45, 0.3, 0.25])),
            "turn": int(rng.integers(3)),
            "way": way / np.linalg.norm(way),
            "tau": float(np.exp(rng.uniform(*np.log([0.1, 1.0])))),
        }
        return Draw(values=fixed | curved(rng))

    def values(self, draw: Draw, severity: float, about: Context) -> Values:
        return {**draw.values, "size": 0.05 * severity}

    def shift(self, values: Values, t: np.ndarray, rotation: np.ndarray, about: Context) -> np.ndarray:
        """Displacement (n, 3) [m] in the body's axes, at times t (n,) of a body (n, 3, 3) since the trial began."""
        if values["of"] == "time":
            s = np.clip((t - about.start_s) / (about.duration_s - about.start_s), 0.0, 1.0)
        else:
            angle = posture(rotation, np.zeros((len(t), 3)))[:, values["turn"]]
            if values["of"] == "history":
                a = np.exp(-1 / (_RATE_HZ * values["tau"]))
                angle = lfilter([1 - a], [1, -a], angle)
            s = angle / about.posture[values["turn"]]
        size = values["size"] * (evaluate(values, s[:, None]) - evaluate(values, np.zeros(1)))
        moved: np.ndarray = size[:, None] * values["way"]
        return moved

    def law(self, draw: Draw) -> TrueLaw:
        turn = f"{self.body}_{POSTURES[draw.values['turn']]}"
        variable = {"time": "time", "orientation": turn, "history": f"history of {turn}"}[draw.values["of"]]
        return TrueLaw(self.stage, (), self.kinds, ((variable,),), kin=self.kin)

    def applies(self, recording: Recording, values: Values) -> bool:
        """Return whether the trial shows the law: what follows time alone begins with a dynamic trial."""
        return recording.dynamic or values["of"] != "time"


def _grid(recording: Recording) -> np.ndarray:
    return np.arange(0.0, recording.duration_s + 0.2, 1 / _RATE_HZ)


@register
class RandomPelvisMarkers(_Displacement):
    """Pelvis markers displaced as a rigid set, up to 50 mm off a straight line."""

    effect = form = "random_pelvis_markers"
    stage = "input"
    moves_model = True
    kin: ClassVar[tuple[str, ...]] = ("soft_tissue", "lab_yaw", "replay_lag")
    body = "pelvis"

    def record(self, recording: Recording, values: Values, about: Context) -> None:
        if not self.applies(recording, values):
            return
        clean, grid = recording.pelvis, _grid(recording)
        shift = sampled(grid, self.shift(values, grid, pelvis_pose(clean(grid))[0], about))

        def moved(t: np.ndarray) -> Markers:
            markers = clean(t)
            away = np.einsum("nij,nj->ni", pelvis_pose(markers)[0], shift(t))
            return {name: place + away for name, place in markers.items()}

        recording.pelvis = moved


@register
class RandomInterfaceMarkers(_Displacement):
    """Interface markers displaced as a rigid set, up to 50 mm off a straight line."""

    effect = form = "random_interface_markers"
    stage = "output"
    kin: ClassVar[tuple[str, ...]] = ("marker_offset", "marker_drift", "filter_lag", "sync_offset")
    body = "interface"

    def record(self, recording: Recording, values: Values, about: Context) -> None:
        if not self.applies(recording, values):
            return
        axes, grid = recording.axes, _grid(recording)
        shift = sampled(grid, self.shift(values, grid, axes(grid), about))
        for side in range(2):
            displace(recording, side, lambda t: np.einsum("nij,nj->ni", axes(t), shift(t)))


@register
class RandomDeflectedMarkers(RandomForm):
    """Each interface marker displaced its own way by one coordinate of the interface, up to 50 mm off a straight line.

    Markers on a strap that stretches, or that the person's body hides in part.
    """

    effect = form = "random_deflected_markers"
    stage = "output"
    moves_truth = False
    kinds: ClassVar[tuple[str, ...]] = ("measurement",)
    kin: ClassVar[tuple[str, ...]] = ("marker_offset",)

    def draw(self, rng: Generator, about: Context) -> Draw:
        # two markers do not show a turn about the line between them
        ways = rng.standard_normal((2, 3))
        fixed = {"axis": int(rng.choice([0, 1, 2, 3, 5])), "ways": ways / np.linalg.norm(ways, axis=1).max()}
        return Draw(values=fixed | curved(rng))

    def values(self, draw: Draw, severity: float, about: Context) -> Values:
        return {**draw.values, "size": 0.05 * severity}

    def law(self, draw: Draw) -> TrueLaw:
        return TrueLaw(self.stage, (), self.kinds, ((f"q_{AXES[draw.values['axis']]}",),), kin=self.kin)

    def record(self, recording: Recording, values: Values, about: Context) -> None:
        axes, grid = recording.axes, _grid(recording)
        middle = recording.interface(grid).mean(axis=1)
        rotation, position = relative_pose(*pelvis_pose(recording.pelvis(grid)), axes(grid), middle)
        q = interface_coordinates(rotation, position, rotation[0], position[0])
        s = q[:, values["axis"], None] / about.reach[values["axis"]]
        shift = values["size"] * (evaluate(values, s) - evaluate(values, np.zeros(1)))[:, None]
        for side, way in enumerate(values["ways"]):
            displace(recording, side, _along(axes, sampled(grid, shift * way)))


def _along(axes: Sampled, moved: Sampled) -> Sampled:
    """Return displacements (n, 3) [m, world] at times (n,), of those in axes that turn."""
    return lambda t: np.einsum("nij,nj->ni", axes(t), moved(t))
