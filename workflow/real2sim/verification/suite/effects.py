"""The causes of a gap: how each is drawn, how its severity grows, and what it changes in a trial.

A form is one equation of one effect. Its severity is a number in (0, 1], 1 being the largest magnitude that is
published or that the trial can carry; `severity.py` solves for the one that makes the gap asked for.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, ClassVar

import numpy as np
from scipy.signal import butter, sosfilt, sosfilt_zi
from scipy.spatial.transform import Rotation

from real2sim.verification.phantom.physics import AXES, PelvisPath, Poses
from real2sim.verification.suite import laws
from real2sim.verification.suite.measurement import Markers, Recording, pelvis_pose, sampled
from real2sim.verification.suite.setups import Setup

# Quantities of an effect's equation by name: numbers, arrays per axis (6,), or words
Values = dict[str, Any]

# Which axes an interface effect sits on: mostly one, the translations a little more often
_AXIS_WEIGHT = np.array([0.2, 0.2, 0.2, 0.14, 0.12, 0.14])
_TWO_AXES = 0.25
# Stuck elements are as stiff as this circular frequency of what they hold: fast against 12 Hz, slow against a step
_STICK_RAD_S = 150.0


@dataclass(frozen=True)
class Context:
    """Facts of the person and of the trials without the effect that a draw may use, per axis (6,) [SI].

    ``lower``, ``upper`` are the extremes of q in the training trial, ``reach`` and ``speed`` the largest
    absolute values of q and its rate; ``mobility`` is the inertia that the strap feels along each axis,
    ``masses`` (3,) those of base, arm, interface; motion begins at ``start_s``. ``place``, ``place_rate`` (6,) are
    the largest absolute values of the robot's joints from their start and of their rates, ``posture`` (4,) those of the
    pelvis' tilt, list, heading [rad] and height [m].
    """

    stiffness: np.ndarray
    damping: np.ndarray
    lower: np.ndarray
    upper: np.ndarray
    reach: np.ndarray
    speed: np.ndarray
    mobility: np.ndarray
    masses: np.ndarray
    duration_s: float
    start_s: float
    place: np.ndarray
    place_rate: np.ndarray
    posture: np.ndarray


@dataclass
class Draw:
    """One draw of a form: the axes it sits on and what does not depend on the severity."""

    axes: np.ndarray = field(default_factory=lambda: np.zeros(6, bool))
    values: Values = field(default_factory=dict)


class Form:
    """Base of all forms. ``stage``: input, interface, robot or output; ``family``: effect of the library.

    ``moves_truth``: the interface moves otherwise; ``moves_model``: an analysis starts from, or replays,
    something else than the truth; ``units``: quantity → unit of its translational and rotational axes, or one
    unit; ``most_severe``: beyond this severity the equation means nothing, such as a spring that pushes away.
    """

    effect: ClassVar[str]
    form: ClassVar[str]
    stage: ClassVar[str]
    family: ClassVar[str | None] = None
    regime: ClassVar[str | None] = None
    moves_truth: ClassVar[bool] = True
    moves_model: ClassVar[bool] = False
    units: ClassVar[dict[str, tuple[str, str] | str]] = {}
    # whether the training trial has to go further than the held-out one, else only the latter shows the effect
    within_training: ClassVar[bool] = False
    most_severe: ClassVar[float] = np.inf

    def draw(self, rng: np.random.Generator, about: Context) -> Draw:
        """Draw what does not depend on the severity."""
        return Draw()

    def values(self, draw: Draw, severity: float, about: Context) -> Values:
        """Quantities of the equation [SI]: (6,) per axis, or scalars and short lists."""
        raise NotImplementedError

    def largest(self, draw: Draw, about: Context, stops: tuple[np.ndarray, np.ndarray]) -> float:
        """Return the largest severity of a draw in a strap with stops (lower (6,), upper (6,)) [m, rad]."""
        return self.most_severe

    def change(self, setup: Setup, values: Values, trial: str, about: Context) -> None:
        """Put the effect into a simulation."""

    def record(self, recording: Recording, values: Values, about: Context) -> None:
        """Put the effect into what is recorded."""

    def truth(self, draw: Draw, values: Values) -> Values:
        """Parameters as they are sealed, the unit in their name."""
        out: Values = {}
        for name, unit in self.units.items():
            value = values[name]
            if isinstance(unit, tuple):
                for i in np.flatnonzero(draw.axes):
                    out[f"{name}_{AXES[i]}_{unit[int(i >= 3)]}"] = float(value[i])
            elif np.ndim(value):
                out[f"{name}_{unit}" if unit else name] = np.asarray(value).tolist()
            else:
                out[f"{name}_{unit}" if unit else name] = value if isinstance(value, str) else float(value)
        return out


FORMS: dict[str, Form] = {}


def register(kind: type[Form]) -> type[Form]:
    """Enter a form under its effect's name, or effect/form where the effect has one already."""
    name = kind.form if kind.family is not None else kind.effect
    if name in FORMS:
        raise ValueError(f"two forms {name}")
    FORMS[name] = kind()
    return kind


def axis_weights() -> np.ndarray:
    """Relative frequency (6,) with which an effect sits on each axis."""
    return _AXIS_WEIGHT.copy()


def _axes(rng: np.random.Generator, both: bool = False) -> np.ndarray:
    # two axes are of one kind, so that one severity serves both
    first = rng.choice(6, p=_AXIS_WEIGHT / _AXIS_WEIGHT.sum())
    chosen = np.zeros(6, bool)
    chosen[first] = True
    if both or rng.random() < _TWO_AXES:
        others = [i for i in range(6) if i // 3 == first // 3 and i != first]
        chosen[rng.choice(others)] = True
    return chosen


def _limit(translation: float, rotation: float) -> np.ndarray:
    return np.array([translation] * 3 + [rotation] * 3)


_FORCE = ("N", "Nm")
_LENGTH = ("m", "rad")
_STIFFNESS = ("N/m", "Nm/rad")
_DAMPING = ("Ns/m", "Nms/rad")


class StrapForm(Form):
    """An effect of the interface law on one or two axes."""

    stage = "interface"

    def draw(self, rng: np.random.Generator, about: Context) -> Draw:
        return Draw(_axes(rng), self.fixed(rng, about))

    def fixed(self, rng: np.random.Generator, about: Context) -> Values:
        """Draw the shape parameters."""
        return {}


def _stick(about: Context) -> np.ndarray:
    """Spring (6,) of elements that stick [N/m, Nm/rad]."""
    return about.mobility * _STICK_RAD_S**2


def strongest(about: Context) -> np.ndarray:
    """Largest friction (6,): 60 N and 4 Nm, and no more than the strap's own force, else nothing ever slips."""
    most: np.ndarray = np.minimum(
        _limit(60.0, 4.0), about.stiffness * about.reach + about.damping * about.speed
    )
    return most


# -------------------- interface: springs


@register
class Slack(StrapForm):
    """Dead band, at most 30 mm and 10 degrees, within the reach."""

    effect = form = "slack"
    regime = "small amplitude"
    units: ClassVar = {"half_width": _LENGTH}
    term: ClassVar[type[laws.Term]] = laws.Slack

    def values(self, draw: Draw, severity: float, about: Context) -> Values:
        most = np.minimum(_limit(0.030, np.radians(10)), 0.9 * about.reach)
        return {"half_width": draw.axes * severity * most}

    def change(self, setup: Setup, values: Values, trial: str, about: Context) -> None:
        setup.terms.append((self.term, {"half_width": values["half_width"], "stiffness": about.stiffness}))


@register
class SmoothSlack(Slack):
    """Slack that is left gradually."""

    form = "slack_tanh"
    family = "slack"
    term = laws.SmoothSlack


@register
class OneSided(StrapForm):
    """A share of the spring, up to all of it, pulls to one side alone."""

    effect = form = "one_sided"
    most_severe = 1.0
    units: ClassVar = {"one_sided_stiffness": _STIFFNESS, "onset": _LENGTH, "side": ""}

    def fixed(self, rng: np.random.Generator, about: Context) -> Values:
        return {"side": rng.choice([-1.0, 1.0]), "onset": rng.uniform(0, 0.15)}

    def values(self, draw: Draw, severity: float, about: Context) -> Values:
        return {
            "one_sided_stiffness": draw.axes * severity * about.stiffness,
            "onset": draw.axes * draw.values["onset"] * about.reach,
            "side": draw.values["side"],
        }

    def change(self, setup: Setup, values: Values, trial: str, about: Context) -> None:
        share = {"share": np.ones(6), "stiffness": values["one_sided_stiffness"]}
        side = np.full(6, values["side"])
        setup.terms.append((laws.OneSided, share | {"side": side, "onset": values["onset"]}))


@register
class SoftOneSided(OneSided):
    """One-sided strap whose onset is rounded."""

    form = "one_sided_soft"
    family = "one_sided"

    def change(self, setup: Setup, values: Values, trial: str, about: Context) -> None:
        share = {"share": np.ones(6), "stiffness": values["one_sided_stiffness"]}
        side = np.full(6, values["side"])
        setup.terms.append((laws.SoftOneSided, share | {"side": side, "rounding": 0.25 * about.reach}))


@register
class Stiffening(StrapForm):
    """Cubic spring, up to four times the linear force at the reach."""

    effect = form = "stiffening"
    regime = "large amplitude"
    units: ClassVar = {"cubic": ("N/m3", "Nm/rad3")}

    def values(self, draw: Draw, severity: float, about: Context) -> Values:
        return {"cubic": draw.axes * severity * 4 * about.stiffness / about.reach**2}

    def change(self, setup: Setup, values: Values, trial: str, about: Context) -> None:
        setup.terms.append((laws.Cubic, {"cubic": values["cubic"]}))


@register
class ExponentialStiffening(StrapForm):
    """Exponential spring (Schiebl 2025), stiffening over a length down to a third of the reach."""

    effect = "stiffening"
    form = "stiffening_exponential"
    family = "stiffening"
    regime = "large amplitude"
    units: ClassVar = {"length": _LENGTH}

    def values(self, draw: Draw, severity: float, about: Context) -> Values:
        return {"length": np.where(draw.axes, about.reach / (3 * severity), 1e6)}

    def change(self, setup: Setup, values: Values, trial: str, about: Context) -> None:
        setup.terms.append((laws.Exponential, {"length": values["length"], "stiffness": about.stiffness}))


@register
class AsymmetricStiffness(StrapForm):
    """Even part b q^2, up to 45 % of the stiffness at the reach."""

    effect = form = "asymmetric_stiffness"
    most_severe = 1.1
    units: ClassVar = {"quadratic": ("N/m2", "Nm/rad2")}

    def fixed(self, rng: np.random.Generator, about: Context) -> Values:
        return {"sign": rng.choice([-1.0, 1.0])}

    def values(self, draw: Draw, severity: float, about: Context) -> Values:
        slope = 0.45 * severity * draw.values["sign"]
        return {"quadratic": draw.axes * slope * about.stiffness / about.reach}

    def change(self, setup: Setup, values: Values, trial: str, about: Context) -> None:
        setup.terms.append((laws.Quadratic, {"quadratic": values["quadratic"], "range": about.reach}))


@register
class TwoSlopes(StrapForm):
    """Another slope on each side, up to 60 % from the mean."""

    effect = "asymmetric_stiffness"
    form = "asymmetric_two_slopes"
    family = "asymmetric_stiffness"
    units: ClassVar = {"asymmetry": ("1", "1")}

    def fixed(self, rng: np.random.Generator, about: Context) -> Values:
        return {"sign": rng.choice([-1.0, 1.0])}

    def values(self, draw: Draw, severity: float, about: Context) -> Values:
        return {"asymmetry": draw.axes * 0.6 * severity * draw.values["sign"]}

    def change(self, setup: Setup, values: Values, trial: str, about: Context) -> None:
        setup.terms.append((laws.TwoSlopes, {"asymmetry": values["asymmetry"], "stiffness": about.stiffness}))


class _Coupling(StrapForm):
    # full matrices between axes
    def change(self, setup: Setup, values: Values, trial: str, about: Context) -> None:
        setup.terms.append((laws.Matrix, {"stiffness": values["stiffness"], "damping": values["damping"]}))

    def truth(self, draw: Draw, values: Values) -> Values:
        scalars = super().truth(draw, values)
        entries = {}
        for name, units in (("stiffness", _STIFFNESS), ("damping", _DAMPING)):
            for i, j in zip(*np.nonzero(np.triu(values[name])), strict=True):
                unit = units[int(i >= 3)]
                entries[f"{name}_{AXES[i]}_{AXES[j]}_{unit}"] = float(values[name][i, j])
        return scalars | entries


@register
class CrossCoupling(_Coupling):
    """Off-diagonal stiffness (or damping) between two axes of a kind, up to 0.7 of their geometric mean."""

    effect = form = "cross_coupling"
    most_severe = 1.4

    def draw(self, rng: np.random.Generator, about: Context) -> Draw:
        axes = _axes(rng, both=True)
        return Draw(axes, {"sign": rng.choice([-1.0, 1.0]), "damping": bool(rng.random() < 0.3)})

    def values(self, draw: Draw, severity: float, about: Context) -> Values:
        i, j = np.flatnonzero(draw.axes)
        of = about.damping if draw.values["damping"] else about.stiffness
        matrix = np.zeros((6, 6))
        matrix[i, j] = matrix[j, i] = 0.7 * severity * draw.values["sign"] * np.sqrt(of[i] * of[j])
        none = np.zeros((6, 6))
        pair = (none, matrix) if draw.values["damping"] else (matrix, none)
        return dict(zip(("stiffness", "damping"), pair, strict=True))


@register
class Misalignment(_Coupling):
    """Interface axes turned against the pelvis by up to 20 degrees about one of them."""

    effect = form = "misalignment"
    units: ClassVar = {"angle": "rad", "about_axis": ""}

    def draw(self, rng: np.random.Generator, about: Context) -> Draw:
        turn = int(rng.integers(3))
        others = [i for i in range(3) if i != turn]
        chosen = np.zeros(6, bool)
        chosen[others] = True
        chosen[[3 + i for i in others]] = True
        return Draw(chosen, {"turn": turn, "sign": rng.choice([-1.0, 1.0])})

    def values(self, draw: Draw, severity: float, about: Context) -> Values:
        angle = np.radians(20) * severity * draw.values["sign"]
        turned = np.kron(np.eye(2), Rotation.from_rotvec(angle * np.eye(3)[draw.values["turn"]]).as_matrix())
        parts = {
            name: turned @ np.diag(of) @ turned.T - np.diag(of)
            for name, of in (("stiffness", about.stiffness), ("damping", about.damping))
        }
        return parts | {"angle": angle, "about_axis": "xyz"[draw.values["turn"]]}

    def truth(self, draw: Draw, values: Values) -> Values:
        return Form.truth(self, draw, values)


@register
class Preload(StrapForm):
    """The strap rests elsewhere in the dynamic trials than in neutral: up to 25 mm and 6 degrees."""

    effect = form = "preload"
    moves_model = True
    units: ClassVar = {"shift": _LENGTH}

    def fixed(self, rng: np.random.Generator, about: Context) -> Values:
        return {"sign": rng.choice([-1.0, 1.0], 6)}

    def values(self, draw: Draw, severity: float, about: Context) -> Values:
        return {"shift": draw.axes * severity * draw.values["sign"] * _limit(0.025, np.radians(6))}

    def largest(self, draw: Draw, about: Context, stops: tuple[np.ndarray, np.ndarray]) -> float:
        # the motion about the shifted rest keeps off the stops
        shift, (lower, upper) = self.values(draw, 1.0, about)["shift"], stops
        room = np.where(shift > 0, np.maximum(upper - about.upper, 0.0), np.minimum(lower - about.lower, 0.0))
        return float(np.min(room[shift != 0] / shift[shift != 0]))

    def change(self, setup: Setup, values: Values, trial: str, about: Context) -> None:
        if trial != "neutral":
            _rest_elsewhere(setup, values["shift"])


def _rest_elsewhere(setup: Setup, shift: np.ndarray) -> None:
    # the strap's rest pose moves by q = shift, and the pelvis starts where the strap is at rest
    turn = Rotation.from_euler("XYZ", shift[3:]).as_matrix()
    rotation, position = turn @ setup.rest_rotation, setup.rest_position + shift[:3]
    setup.path = _moved(setup, rotation, position)
    setup.rest_rotation, setup.rest_position = rotation, position


def _moved(setup: Setup, rotation: np.ndarray, position: np.ndarray) -> PelvisPath:
    """Path of the pelvis about another start: the one that sees the interface at (rotation, position)."""
    r0, p0 = (x[0] for x in setup.path(np.zeros(1))[:2])
    r_i, p_i = r0 @ setup.rest_rotation, p0 + r0 @ setup.rest_position
    r1 = r_i @ rotation.T
    p1 = p_i - r1 @ position
    turn = r0.T @ r1
    path, lever = setup.path, p1 - p0

    def evaluate(t: np.ndarray) -> Poses:
        r, p, v, w = path(t)
        return r @ turn, p + lever, v, w

    return PelvisPath(evaluate, path.duration_s)


@register
class JointLimit(StrapForm):
    """A stop that the analysis does not know, inside the range of the training trial, down to 40 % of it."""

    effect = form = "joint_limit"
    most_severe = 1.6
    within_training = True
    regime = "large amplitude"
    units: ClassVar = {"limit": _LENGTH, "side": ""}

    def fixed(self, rng: np.random.Generator, about: Context) -> Values:
        return {"side": rng.choice([-1.0, 1.0])}

    def values(self, draw: Draw, severity: float, about: Context) -> Values:
        side = draw.values["side"]
        reach = about.upper if side > 0 else -about.lower
        return {"limit": np.where(draw.axes, reach * (1 - 0.6 * severity), np.inf), "side": side}

    def change(self, setup: Setup, values: Values, trial: str, about: Context) -> None:
        if values["side"] > 0:
            setup.upper = np.minimum(setup.upper, values["limit"])
        else:
            setup.lower = np.maximum(setup.lower, -values["limit"])


@register
class SoftStop(JointLimit):
    """A stop that begins gently: a force that grows with the square of what is beyond."""

    form = "joint_limit_soft"
    family = "joint_limit"
    units: ClassVar = {"limit": _LENGTH, "side": "", "curvature": ("N/m2", "Nm/rad2")}

    def values(self, draw: Draw, severity: float, about: Context) -> Values:
        hard = super().values(draw, severity, about)
        return hard | {"curvature": draw.axes * 60 * about.stiffness / about.reach}

    def change(self, setup: Setup, values: Values, trial: str, about: Context) -> None:
        limit = np.where(np.isfinite(values["limit"]), values["limit"], 1e6)
        side = np.full(6, values["side"])
        setup.terms.append((laws.SoftStop, {"limit": limit, "side": side, "curvature": values["curvature"]}))


# -------------------- interface: dissipation


@register
class Coulomb(StrapForm):
    """Dry friction of the strap."""

    effect = form = "coulomb"
    regime = "reversals"
    units: ClassVar = {"friction": _FORCE}

    def values(self, draw: Draw, severity: float, about: Context) -> Values:
        return {"friction": draw.axes * severity * strongest(about)}

    def change(self, setup: Setup, values: Values, trial: str, about: Context) -> None:
        f = values["friction"]
        setup.terms.append((laws.Stick, {"upper": f, "lower": f, "spring": _stick(about)}))


@register
class AsymmetricCoulomb(Coulomb):
    """Dry friction that differs by direction."""

    form = "coulomb_asymmetric"
    family = "coulomb"
    units: ClassVar = {"friction": _FORCE, "friction_back": _FORCE}

    def fixed(self, rng: np.random.Generator, about: Context) -> Values:
        return {"back": rng.uniform(0.4, 0.8)}

    def values(self, draw: Draw, severity: float, about: Context) -> Values:
        f = draw.axes * severity * strongest(about)
        return {"friction": f, "friction_back": draw.values["back"] * f}

    def change(self, setup: Setup, values: Values, trial: str, about: Context) -> None:
        ends = {"upper": values["friction"], "lower": values["friction_back"]}
        setup.terms.append((laws.Stick, ends | {"spring": _stick(about)}))


@register
class LuGre(StrapForm):
    """LuGre friction: static above Coulomb friction, and a springy pre-sliding."""

    effect = form = "lugre"
    regime = "reversals"
    units: ClassVar = {
        "coulomb": _FORCE,
        "static": _FORCE,
        "stribeck": ("m/s", "rad/s"),
        "bristle": _STIFFNESS,
    }

    def fixed(self, rng: np.random.Generator, about: Context) -> Values:
        return {
            "ratio": rng.uniform(1.4, 2.2),
            "stribeck": rng.uniform(0.03, 0.10),
            "travel": rng.uniform(0.01, 0.04),
        }

    def values(self, draw: Draw, severity: float, about: Context) -> Values:
        drawn = draw.values
        coulomb = draw.axes * severity * strongest(about) / drawn["ratio"]
        bristle = coulomb / (drawn["travel"] * about.reach)
        return {
            "coulomb": coulomb,
            "static": drawn["ratio"] * coulomb,
            "stribeck": drawn["stribeck"] * about.speed,
            "bristle": np.minimum(np.where(draw.axes, bristle, 1.0), _stick(about)),
        }

    def change(self, setup: Setup, values: Values, trial: str, about: Context) -> None:
        names = {"coulomb": "coulomb", "static": "static", "stribeck": "stribeck", "spring": "bristle"}
        setup.terms.append((laws.LuGre, {name: values[key] for name, key in names.items()}))


@register
class Stribeck(LuGre):
    """Stribeck friction, which falls steeply and sticks almost rigidly."""

    form = "lugre_stribeck"
    family = "lugre"

    def values(self, draw: Draw, severity: float, about: Context) -> Values:
        values = super().values(draw, severity, about)
        return values | {"bristle": _stick(about), "stribeck": 0.3 * values["stribeck"]}


@register
class Hysteresis(StrapForm):
    """Bouc-Wen hysteresis, yielding over 10 to 40 % of the reach."""

    effect = form = "hysteresis"
    units: ClassVar = {"strength": _FORCE, "yield_travel": _LENGTH, "shape": ""}
    term: ClassVar[type[laws.Term]] = laws.BoucWen

    def fixed(self, rng: np.random.Generator, about: Context) -> Values:
        return {"travel": rng.uniform(0.10, 0.40), "shape": rng.uniform(0.5, 0.8)}

    def values(self, draw: Draw, severity: float, about: Context) -> Values:
        return {
            "strength": draw.axes * severity * strongest(about),
            "yield_travel": draw.values["travel"] * about.reach,
            "shape": draw.values["shape"],
        }

    def change(self, setup: Setup, values: Values, trial: str, about: Context) -> None:
        setup.terms.append((self.term, dict(values)))


@register
class Iwan(Hysteresis):
    """Maxwell slip of eight elements."""

    form = "hysteresis_iwan"
    family = "hysteresis"
    units: ClassVar = {"strength": _FORCE, "yield_travel": _LENGTH}
    term = laws.Iwan


@register
class Relaxation(StrapForm):
    """Standard linear solid: a branch of up to 1.5 times the stiffness that relaxes in 0.08 to 0.9 s."""

    effect = form = "relaxation"
    units: ClassVar = {"branch": _STIFFNESS, "tau": "s"}
    times: ClassVar[tuple[float, float]] = (0.08, 0.9)

    def fixed(self, rng: np.random.Generator, about: Context) -> Values:
        return {"tau": float(np.exp(rng.uniform(*np.log(self.times))))}

    def values(self, draw: Draw, severity: float, about: Context) -> Values:
        return {"branch": draw.axes * 1.5 * severity * about.stiffness, "tau": draw.values["tau"]}

    def change(self, setup: Setup, values: Values, trial: str, about: Context) -> None:
        setup.terms.append((laws.Maxwell, dict(values)))


@register
class TwoTimeConstants(StrapForm):
    """Relaxation with two time constants."""

    effect = "relaxation"
    form = "relaxation_two_times"
    family = "relaxation"
    units: ClassVar = {"branch": _STIFFNESS, "tau": "s"}

    def fixed(self, rng: np.random.Generator, about: Context) -> Values:
        return {"tau": np.array([rng.uniform(0.06, 0.15), rng.uniform(0.5, 1.2)])}

    def values(self, draw: Draw, severity: float, about: Context) -> Values:
        return {"branch": draw.axes * 1.2 * severity * about.stiffness, "tau": draw.values["tau"]}

    def change(self, setup: Setup, values: Values, trial: str, about: Context) -> None:
        branch = np.repeat(values["branch"][:, None] / 2, 2, axis=1)
        setup.terms.append((laws.Prony, {"branch": branch, "tau": values["tau"]}))


@register
class Creep(Relaxation):
    """The strap gives way slowly under load: a branch that relaxes in 4 to 15 s."""

    effect = form = "creep"
    regime = "holds"
    times = (4.0, 15.0)


@register
class LogCreep(StrapForm):
    """Creep in logarithmic time: four branches, one per half decade."""

    effect = "creep"
    form = "creep_log_time"
    family = "creep"
    regime = "holds"
    units: ClassVar = {"branch": _STIFFNESS, "tau": "s"}

    def values(self, draw: Draw, severity: float, about: Context) -> Values:
        return {
            "branch": draw.axes * 1.5 * severity * about.stiffness,
            "tau": np.array([1.0, 3.2, 10.0, 32.0]),
        }

    def change(self, setup: Setup, values: Values, trial: str, about: Context) -> None:
        branch = np.repeat(values["branch"][:, None] / 4, 4, axis=1)
        setup.terms.append((laws.Prony, {"branch": branch, "tau": values["tau"]}))


@register
class Migration(StrapForm):
    """The strap slips while it is stretched beyond 25 to 55 % of the reach, and stays there."""

    effect = form = "migration"
    regime = "after large amplitude"
    units: ClassVar = {"slip_rate": ("1/s", "1/s"), "threshold": _LENGTH, "side": ""}

    def fixed(self, rng: np.random.Generator, about: Context) -> Values:
        return {"side": rng.choice([-1.0, 1.0]), "threshold": rng.uniform(0.25, 0.55)}

    def values(self, draw: Draw, severity: float, about: Context) -> Values:
        return {
            "slip_rate": draw.axes * 8 * severity,
            "threshold": np.where(draw.axes, draw.values["threshold"] * about.reach, 1e6),
            "side": draw.values["side"],
        }

    def change(self, setup: Setup, values: Values, trial: str, about: Context) -> None:
        if trial == "neutral":
            return
        numbers = {"rate": values["slip_rate"], "threshold": values["threshold"]}
        side = {"side": np.full(6, values["side"]), "stiffness": about.stiffness}
        setup.terms.append((laws.Ratchet, numbers | side))


@register
class SteadyMigration(StrapForm):
    """The strap wanders steadily, whatever the motion: up to 25 mm and 8 degrees in a trial."""

    effect = "migration"
    form = "migration_steady"
    family = "migration"
    regime = "late"
    units: ClassVar = {"rate": ("m/s", "rad/s")}

    def fixed(self, rng: np.random.Generator, about: Context) -> Values:
        return {"sign": rng.choice([-1.0, 1.0])}

    def values(self, draw: Draw, severity: float, about: Context) -> Values:
        most = _limit(0.025, np.radians(8)) / about.duration_s
        return {"rate": draw.axes * severity * draw.values["sign"] * most}

    def change(self, setup: Setup, values: Values, trial: str, about: Context) -> None:
        if trial != "neutral":
            wander = {"rate": values["rate"], "onset": about.start_s, "stiffness": about.stiffness}
            setup.terms.append((laws.Wander, wander))


@register
class QuadraticDamping(StrapForm):
    """d2 v|v|, up to four times the linear damping at the largest speed."""

    effect = form = "quadratic_damping"
    regime = "fast"
    exponent: ClassVar[float] = 2.0
    units: ClassVar = {"coefficient": ("Ns2/m2", "Nms2/rad2")}

    def values(self, draw: Draw, severity: float, about: Context) -> Values:
        most = 4 * about.damping * about.speed ** (1 - self.exponent)
        return {"coefficient": draw.axes * severity * most}

    def change(self, setup: Setup, values: Values, trial: str, about: Context) -> None:
        term = {"coefficient": values["coefficient"], "exponent": self.exponent}
        setup.terms.append((laws.PowerDamping, term))


@register
class PowerDamping(QuadraticDamping):
    """Damping with the power 1.5 of the speed."""

    form = "damping_power"
    family = "quadratic_damping"
    exponent = 1.5
    units: ClassVar = {"coefficient": ("N(s/m)^1.5", "Nm(s/rad)^1.5")}


# -------------------- robot


@register
class AddedMass(Form):
    """Mass and inertia carried by the interface, at most 8 kg on a radius of about 0.15 m."""

    effect = form = "added_mass"
    stage = "robot"
    regime = "fast"
    units: ClassVar = {"mass": "kg", "inertia": "kgm2"}

    def draw(self, rng: np.random.Generator, about: Context) -> Draw:
        return Draw(values={"radius": rng.uniform(0.10, 0.18), "flat": rng.uniform(0.5, 1.0, 3)})

    def values(self, draw: Draw, severity: float, about: Context) -> Values:
        mass = 8.0 * severity
        return {"mass": mass, "inertia": mass * draw.values["radius"] ** 2 * draw.values["flat"]}

    def change(self, setup: Setup, values: Values, trial: str, about: Context) -> None:
        setup.added = setup.added + np.array([values["mass"], *values["inertia"]])


@register
class BaseCompliance(Form):
    """The base holds with another stiffness and damping than configured, by up to a factor of 6."""

    effect = form = "base_compliance"
    stage = "robot"
    most_severe = 2.0  # a base 36 times as stiff is rigid to a strap, one 36 times as soft lets it go
    units: ClassVar = {"stiffness_factor": "", "damping_factor": ""}

    def draw(self, rng: np.random.Generator, about: Context) -> Draw:
        return Draw(values={"stiffness": rng.uniform(-1, 1, 3), "damping": rng.uniform(-1, 1, 3)})

    def values(self, draw: Draw, severity: float, about: Context) -> Values:
        return {
            f"{name}_factor": np.exp(np.log(6) * severity * draw.values[name])
            for name in ("stiffness", "damping")
        }

    def change(self, setup: Setup, values: Values, trial: str, about: Context) -> None:
        for name in ("stiffness", "damping"):
            changed = getattr(setup.controller, name).copy()
            changed[:3] *= values[f"{name}_factor"]
            setattr(setup.controller, name, changed)


@register
class SeriesCompliance(Form):
    """A hidden compliant joint behind the base: a branch of the servo that relaxes."""

    effect = "base_compliance"
    form = "base_compliance_series"
    stage = "robot"
    family = "base_compliance"
    units: ClassVar = {"branch": "", "tau": "s"}

    def draw(self, rng: np.random.Generator, about: Context) -> Draw:
        return Draw(values={"tau": rng.uniform(0.1, 0.6), "share": rng.uniform(0.5, 1.0, 3)})

    def values(self, draw: Draw, severity: float, about: Context) -> Values:
        most = 8 * np.array([150.0, 300.0, 60.0])
        return {"branch": severity * most * draw.values["share"], "tau": draw.values["tau"]}

    def change(self, setup: Setup, values: Values, trial: str, about: Context) -> None:
        setup.terms.append((laws.SeriesCompliance, dict(values)))


@register
class ControllerReaction(Form):
    """The base reacts to the interaction force after 50 to 250 ms, by up to 0.9 of it."""

    effect = form = "controller_reaction"
    stage = "robot"
    units: ClassVar = {"gain": "", "delay": "s"}

    def draw(self, rng: np.random.Generator, about: Context) -> Draw:
        return Draw(values={"delay": rng.uniform(0.05, 0.25), "sign": rng.choice([-1.0, 1.0], p=[0.3, 0.7])})

    def values(self, draw: Draw, severity: float, about: Context) -> Values:
        return {
            "gain": 0.9 * severity * draw.values["sign"],
            "delay": draw.values["delay"],
            "filter": 0.0,
        }

    def change(self, setup: Setup, values: Values, trial: str, about: Context) -> None:
        setup.terms.append((laws.Reaction, dict(values)))


@register
class SmoothReaction(ControllerReaction):
    """As controller_reaction, through a low-pass instead of a delay."""

    form = "controller_reaction_smoothed"
    family = "controller_reaction"
    units: ClassVar = {"gain": "", "filter": "s"}

    def values(self, draw: Draw, severity: float, about: Context) -> Values:
        values = super().values(draw, severity, about)
        return values | {"filter": values["delay"], "delay": 0.0}


@register
class Tilt(Form):
    """Gravity leans by up to 2.5 degrees in the dynamic trials; the start is in balance with it."""

    effect = form = "tilt"
    stage = "robot"
    moves_model = True
    units: ClassVar = {"angle": "rad", "direction": "rad", "sway": ""}

    def draw(self, rng: np.random.Generator, about: Context) -> Draw:
        return Draw(
            values={
                "direction": rng.uniform(-np.pi, np.pi),
                "sway": 0.0,
                "frequency": rng.uniform(0.1, 0.3),
                "phase": rng.uniform(0, 2 * np.pi),
            }
        )

    def values(self, draw: Draw, severity: float, about: Context) -> Values:
        # no more than stretches the strap by 30 mm at the start
        held = 0.030 * about.stiffness[:2].min() / (9.81 * about.masses.sum())
        return {"angle": min(np.radians(2.5), held) * severity, **draw.values}

    def change(self, setup: Setup, values: Values, trial: str, about: Context) -> None:
        if trial == "neutral":
            return
        lean = np.sin(values["angle"]) * np.array(
            [np.cos(values["direction"]), np.sin(values["direction"]), 0.0]
        )
        sway = {key: values[key] for key in ("sway", "frequency", "phase")}
        setup.terms.append((laws.Tilt, {"lean": lean, "masses": about.masses} | sway))
        # the strap holds the robot against its weight while everybody stands still
        pelvis = setup.path(np.zeros(1))[0][0]
        stretch = np.zeros(6)
        stretch[:3] = 9.81 * about.masses.sum() * (pelvis.T @ lean) / setup.stiffness[:3]
        setup.path = _moved(setup, setup.rest_rotation, setup.rest_position + stretch[:3])


@register
class SwayingTilt(Tilt):
    """Tilt that sways slowly by half of itself."""

    form = "tilt_swaying"
    family = "tilt"
    units: ClassVar = {"angle": "rad", "direction": "rad", "sway": "", "frequency": "Hz"}

    def draw(self, rng: np.random.Generator, about: Context) -> Draw:
        draw = super().draw(rng, about)
        draw.values["sway"] = 0.5
        return draw


# -------------------- input chain


class InputForm(Form):
    """An effect on the pelvis markers: the truth stays, the replay is led astray."""

    stage = "input"
    moves_truth = False
    moves_model = True


@register
class SoftTissue(InputForm):
    """Pelvis markers slide on the skin in proportion to the pelvis' turning, up to 60 mm per radian (SD)."""

    effect = form = "soft_tissue"
    units: ClassVar = {"scale": "m/rad"}
    wobble: ClassVar[float] = 0.0

    def draw(self, rng: np.random.Generator, about: Context) -> Draw:
        return Draw(
            values={
                "pattern": rng.standard_normal((4, 3, 3)),
                "wobble_hz": rng.uniform(5, 9),
                "wobble_damping": rng.uniform(0.1, 0.3),
            }
        )

    def values(self, draw: Draw, severity: float, about: Context) -> Values:
        return {"scale": 0.060 * severity, **draw.values}

    def record(self, recording: Recording, values: Values, about: Context) -> None:
        clean = recording.pelvis
        # what the markers follow, on a grid that carries a wobble
        grid = np.arange(-1.0, recording.duration_s + 0.2, 0.002)
        first = pelvis_pose(clean(np.zeros(1)))[0][0]
        turned = pelvis_pose(clean(grid))[0] @ first.T
        drive = Rotation.from_matrix(turned).as_euler("ZYX")[:, ::-1]
        if self.wobble:
            drive = _resonant(drive, values["wobble_hz"], values["wobble_damping"], 500.0)
        follow = sampled(grid, drive)

        def moved(t: np.ndarray) -> Markers:
            markers, angles = clean(t), follow(t)
            rotation = pelvis_pose(markers)[0]
            return {
                name: place + np.einsum("nij,nj->ni", rotation, values["scale"] * angles @ pattern.T)
                for (name, place), pattern in zip(markers.items(), values["pattern"], strict=True)
            }

        recording.pelvis = moved

    def truth(self, draw: Draw, values: Values) -> Values:
        return super().truth(draw, values) | {"pattern": values["pattern"].tolist()}


@register
class WobblingTissue(SoftTissue):
    """Soft tissue that rings: the skin follows as a mass on a spring."""

    form = "soft_tissue_wobble"
    family = "soft_tissue"
    units: ClassVar = {"scale": "m/rad", "wobble_hz": "", "wobble_damping": ""}
    wobble = 1.0


def _resonant(values: np.ndarray, hz: float, damping: float, rate_hz: float) -> np.ndarray:
    """Response of a mass on a spring to the motion (n, k) of what it sits on."""
    from scipy.signal import bilinear, lfilter

    w = 2 * np.pi * hz
    b, a = bilinear([2 * damping * w, w * w], [1, 2 * damping * w, w * w], rate_hz)
    response: np.ndarray = lfilter(b, a, values - values[0], axis=0) + values[0]
    return response


@register
class ReplayLag(InputForm):
    """Pelvis markers late by up to 60 ms."""

    effect = form = "replay_lag"
    regime = "fast"
    units: ClassVar = {"lag": "s"}

    def values(self, draw: Draw, severity: float, about: Context) -> Values:
        return {"lag": 0.060 * severity}

    def record(self, recording: Recording, values: Values, about: Context) -> None:
        clean = recording.pelvis
        recording.pelvis = lambda t: clean(t - values["lag"])


@register
class LabYaw(Form):
    """Interface markers in a lab frame turned about the vertical by up to 6 degrees, in every trial."""

    effect = form = "lab_yaw"
    stage = "input"
    moves_truth = False
    moves_model = True
    units: ClassVar = {"yaw": "rad"}

    def draw(self, rng: np.random.Generator, about: Context) -> Draw:
        return Draw(values={"sign": rng.choice([-1.0, 1.0])})

    def values(self, draw: Draw, severity: float, about: Context) -> Values:
        return {"yaw": np.radians(6) * severity * draw.values["sign"]}

    def record(self, recording: Recording, values: Values, about: Context) -> None:
        turn = Rotation.from_euler("z", values["yaw"]).as_matrix()
        centres, axes = recording.interface, recording.axes
        recording.interface = lambda t: centres(t) @ turn.T
        recording.axes = lambda t: turn @ axes(t)


# -------------------- output chain


class OutputForm(Form):
    """An effect on the interface markers: neither truth nor replay change."""

    stage = "output"
    moves_truth = False


def _retime(recording: Recording, clock: Callable[[np.ndarray], np.ndarray]) -> None:
    centres, axes = recording.interface, recording.axes
    recording.interface = lambda t: centres(clock(t))
    recording.axes = lambda t: axes(clock(t))


def displace(recording: Recording, side: int, shift: Callable[[np.ndarray], np.ndarray]) -> None:
    """Move one interface marker (0 left, 1 right) by a function of time (n,) -> (n, 3) [m]."""
    centres = recording.interface

    def moved(t: np.ndarray) -> np.ndarray:
        out = np.array(centres(t))
        out[:, side] += shift(t)
        return out

    recording.interface = moved


@register
class SyncOffset(OutputForm):
    """Interface markers late (positive) or early against the pelvis markers, at most 60 ms."""

    effect = form = "sync_offset"
    regime = "fast"
    units: ClassVar = {"offset": "s"}

    def draw(self, rng: np.random.Generator, about: Context) -> Draw:
        return Draw(values={"sign": rng.choice([-1.0, 1.0])})

    def values(self, draw: Draw, severity: float, about: Context) -> Values:
        return {"offset": 0.060 * severity * draw.values["sign"]}

    def record(self, recording: Recording, values: Values, about: Context) -> None:
        _retime(recording, lambda t: t - values["offset"])


@register
class ClockDrift(OutputForm):
    """Interface markers on a clock that runs (1 + eps) times as fast, eps at most 1 %."""

    effect = form = "clock_drift"
    regime = "late"
    units: ClassVar = {"rate": ""}

    def draw(self, rng: np.random.Generator, about: Context) -> Draw:
        return Draw(values={"sign": rng.choice([-1.0, 1.0])})

    def values(self, draw: Draw, severity: float, about: Context) -> Values:
        return {"rate": 0.01 * severity * draw.values["sign"]}

    def record(self, recording: Recording, values: Values, about: Context) -> None:
        _retime(recording, lambda t: (1 + values["rate"]) * t)


@register
class FilterLag(OutputForm):
    """Interface markers through a causal low-pass of first order, cut off as low as 2.5 Hz."""

    effect = form = "filter_lag"
    regime = "fast"
    order: ClassVar[int] = 1
    units: ClassVar = {"cutoff": "Hz"}

    def values(self, draw: Draw, severity: float, about: Context) -> Values:
        return {"cutoff": 2.5 / severity}

    def record(self, recording: Recording, values: Values, about: Context) -> None:
        rate = 1000.0
        grid = np.arange(0.0, recording.duration_s + 0.2, 1 / rate)
        flat = recording.interface(grid).reshape(len(grid), 6)
        sos = butter(self.order, min(values["cutoff"], 400.0), fs=rate, output="sos")
        start = sosfilt_zi(sos)[:, :, None] * flat[0]
        late = sosfilt(sos, flat, axis=0, zi=start)[0]
        recording.interface = sampled(grid, late.reshape(-1, 2, 3))


@register
class SteepFilter(FilterLag):
    """Causal Butterworth low-pass of fourth order."""

    form = "filter_lag_fourth_order"
    family = "filter_lag"
    order = 4

    def values(self, draw: Draw, severity: float, about: Context) -> Values:
        return {"cutoff": 5.0 / severity}


@register
class MarkerOffset(OutputForm):
    """One interface marker off its joint centre by up to 25 mm, fixed in the interface."""

    effect = form = "marker_offset"
    moves_model = True
    units: ClassVar = {"offset": "m", "marker": ""}

    def draw(self, rng: np.random.Generator, about: Context) -> Draw:
        way = rng.standard_normal(3)
        return Draw(values={"side": int(rng.integers(2)), "way": way / np.linalg.norm(way)})

    def values(self, draw: Draw, severity: float, about: Context) -> Values:
        side = draw.values["side"]
        return {
            "offset": 0.025 * severity * draw.values["way"],
            "marker": ("IF_L", "IF_R")[side],
            "side": side,
        }

    def record(self, recording: Recording, values: Values, about: Context) -> None:
        axes = recording.axes
        displace(recording, values["side"], lambda t: axes(t) @ values["offset"])


@register
class MarkerDrift(OutputForm):
    """One interface marker drifts through the dynamic trials, by up to 30 mm at their end."""

    effect = form = "marker_drift"
    regime = "late"
    units: ClassVar = {"rate": "m/s", "marker": ""}

    def draw(self, rng: np.random.Generator, about: Context) -> Draw:
        way = rng.standard_normal(3)
        return Draw(values={"side": int(rng.integers(2)), "way": way / np.linalg.norm(way)})

    def values(self, draw: Draw, severity: float, about: Context) -> Values:
        side = draw.values["side"]
        rate = 0.030 * severity / about.duration_s * draw.values["way"]
        return {"rate": rate, "marker": ("IF_L", "IF_R")[side], "side": side}

    def record(self, recording: Recording, values: Values, about: Context) -> None:
        if recording.dynamic:
            displace(recording, values["side"], lambda t: np.maximum(t, 0.0)[:, None] * values["rate"])


@register
class Outliers(OutputForm):
    """Isolated spikes and short jumps of the interface markers in the dynamic trials, up to 80 mm."""

    effect = form = "outliers"
    units: ClassVar = {"height": "m", "count": ""}

    def draw(self, rng: np.random.Generator, about: Context) -> Draw:
        return Draw(values={"count": int(rng.integers(6, 19)), "seed": int(rng.integers(2**31))})

    def values(self, draw: Draw, severity: float, about: Context) -> Values:
        return {"height": 0.080 * severity, **draw.values}

    def record(self, recording: Recording, values: Values, about: Context) -> None:
        if not recording.dynamic:
            return
        rng = np.random.default_rng([values["seed"], len(recording.name), ord(recording.name[-1])])
        for _ in range(values["count"]):
            at = rng.uniform(recording.start_s, recording.duration_s - 0.3)
            length = rng.choice([0.01, 0.01, 0.01, 0.02, 0.05])
            way = rng.standard_normal(3)
            way *= values["height"] * rng.uniform(0.6, 1.0) / np.linalg.norm(way)
            displace(recording, int(rng.integers(2)), _pulse(at, length, way))


def _pulse(at: float, length: float, way: np.ndarray) -> Callable[[np.ndarray], np.ndarray]:
    return lambda t: ((t >= at) & (t < at + length))[:, None] * way


# -------------------- outside the library


@register
class ExternalPush(Form):
    """Something pushes the base once a second or so: sin^2 pulses of up to 80 N."""

    effect = form = "external_push"
    stage = "robot"
    units: ClassVar = {"force": "N", "period": "s", "direction": "rad"}

    def draw(self, rng: np.random.Generator, about: Context) -> Draw:
        return Draw(
            values={
                "period": rng.uniform(0.9, 2.2),
                "direction": rng.uniform(-np.pi, np.pi),
                "width": rng.uniform(0.25, 0.5),
                "first": rng.uniform(0.0, 0.8),
            }
        )

    def values(self, draw: Draw, severity: float, about: Context) -> Values:
        return {"force": 80.0 * severity, **draw.values}

    def change(self, setup: Setup, values: Values, trial: str, about: Context) -> None:
        if trial == "neutral":
            return
        times = about.start_s + values["first"] + values["period"] * np.arange(12)
        way = np.array([np.cos(values["direction"]), np.sin(values["direction"])])
        push = {"times": times, "strength": np.full(12, values["force"])}
        setup.terms.append((laws.Push, push | {"width": values["width"], "direction": way}))


@register
class HandOnRobot(Form):
    """The person takes hold of the arm now and then: a spring of up to 6 kN/m about the pose at the grasp."""

    effect = form = "hand_on_robot"
    stage = "robot"
    units: ClassVar = {"stiffness": "N/m"}

    def draw(self, rng: np.random.Generator, about: Context) -> Draw:
        gaps = rng.uniform(1.2, 2.8, 8)
        return Draw(values={"times": about.start_s + np.cumsum(gaps), "width": rng.uniform(0.4, 0.9)})

    def values(self, draw: Draw, severity: float, about: Context) -> Values:
        return {"stiffness": 6000.0 * severity, **draw.values}

    def change(self, setup: Setup, values: Values, trial: str, about: Context) -> None:
        if trial == "neutral":
            return
        lever = np.array([1.0, 1.0, 0.3, 1.0, 0.05, 0.05])
        held = {"spring": values["stiffness"] * lever, "damper": 0.01 * values["stiffness"] * lever}
        setup.terms.append(
            (laws.Hand, {"times": values["times"], "width": np.full(8, values["width"])} | held)
        )


@register
class WheelCogging(Form):
    """Wheels with preferred positions, 10 to 40 mm apart: up to 60 N."""

    effect = form = "wheel_cogging"
    stage = "robot"
    units: ClassVar = {"force": "N", "pitch": "m"}

    def draw(self, rng: np.random.Generator, about: Context) -> Draw:
        return Draw(values={"pitch": rng.uniform(0.010, 0.040), "phase": rng.uniform(0, 2 * np.pi, 2)})

    def values(self, draw: Draw, severity: float, about: Context) -> Values:
        return {"force": 60.0 * severity, **draw.values}

    def change(self, setup: Setup, values: Values, trial: str, about: Context) -> None:
        if trial == "neutral":
            return
        at_start = 2 * np.pi * setup.controller.start[:2] / values["pitch"]
        # the trial starts in a rest position of the wheels
        cogs = {"strength": np.full(2, values["force"]), "pitch": values["pitch"], "phase": -at_start}
        setup.terms.append((laws.Cogging, cogs))


@register
class FractionalDamping(StrapForm):
    """Damping that falls with frequency (a half derivative), as six branches over two decades."""

    effect = form = "fractional_damping"
    units: ClassVar = {"branch": _STIFFNESS}

    def values(self, draw: Draw, severity: float, about: Context) -> Values:
        return {"branch": draw.axes * 3 * severity * about.stiffness}

    def change(self, setup: Setup, values: Values, trial: str, about: Context) -> None:
        tau = np.geomspace(0.02, 2.0, 6)
        share = tau**-0.5 / np.sum(tau**-0.5)
        setup.terms.append((laws.Prony, {"branch": values["branch"][:, None] * share, "tau": tau}))


@register
class BacklashImpact(StrapForm):
    """Play that follows the strap and knocks at its ends, up to 20 mm and 7 degrees."""

    effect = form = "backlash_impact"
    units: ClassVar = {"half_width": _LENGTH}

    def values(self, draw: Draw, severity: float, about: Context) -> Values:
        most = np.minimum(_limit(0.020, np.radians(7)), 0.6 * about.reach)
        return {"half_width": draw.axes * severity * most}

    def change(self, setup: Setup, values: Values, trial: str, about: Context) -> None:
        on = values["half_width"] > 0
        knock = on * 1.5 * np.sqrt(about.stiffness * about.mobility)
        play = {"half_width": values["half_width"], "stiffness": on * about.stiffness}
        setup.terms.append((laws.Backlash, play | {"knock": np.minimum(knock, 2 * about.damping)}))


@register
class PoseStick(StrapForm):
    """The strap catches in one pose, with a negative slope on the way out."""

    effect = form = "pose_stick"
    units: ClassVar = {"depth": _FORCE, "place": _LENGTH, "width": _LENGTH}

    def fixed(self, rng: np.random.Generator, about: Context) -> Values:
        return {"place": rng.choice([-1, 1]) * rng.uniform(0.3, 0.6), "width": rng.uniform(0.08, 0.15)}

    def values(self, draw: Draw, severity: float, about: Context) -> Values:
        return {
            "depth": draw.axes * severity * strongest(about),
            "place": draw.values["place"] * about.reach,
            "width": draw.values["width"] * about.reach,
        }

    def change(self, setup: Setup, values: Values, trial: str, about: Context) -> None:
        setup.terms.append((laws.PoseStick, dict(values)))


@register
class MarkerCrosstalk(OutputForm):
    """The left interface marker follows the right one by up to 60 %, about the place it has at the start."""

    effect = form = "marker_crosstalk"
    units: ClassVar = {"share": "", "marker": ""}

    def draw(self, rng: np.random.Generator, about: Context) -> Draw:
        return Draw(values={"side": int(rng.integers(2)), "way": rng.permutation(np.eye(3))})

    def values(self, draw: Draw, severity: float, about: Context) -> Values:
        side = draw.values["side"]
        return {
            "share": 0.6 * severity,
            "marker": ("IF_L", "IF_R")[side],
            "side": side,
            "way": draw.values["way"],
        }

    def record(self, recording: Recording, values: Values, about: Context) -> None:
        centres, side = recording.interface, values["side"]
        rest = centres(np.zeros(1))[0]

        def mixed(t: np.ndarray) -> np.ndarray:
            out = np.array(centres(t))
            # axes are mixed up, too, else this were a yaw of the pair
            other = (out[:, 1 - side] - rest[1 - side]) @ values["way"]
            own = out[:, side] - rest[side]
            out[:, side] = rest[side] + (1 - values["share"]) * own + values["share"] * other
            return out

        recording.interface = mixed
