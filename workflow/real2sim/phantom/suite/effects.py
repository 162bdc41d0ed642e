"""The causes of a gap: how each is drawn, how its severity grows, and what it changes in a trial.

A form is one equation of one effect. Its severity is a number in (0, 1], 1 being the largest magnitude that is
published or that the trial can carry; `severity.py` solves for the one that makes the gap asked for.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, ClassVar

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.signal import butter, sosfilt, sosfilt_zi
from scipy.spatial.transform import Rotation

from real2sim.phantom.physics import AXES
from real2sim.phantom.suite import laws
from real2sim.phantom.suite.measurement import Recording
from real2sim.phantom.suite.setups import Setup

# Which axes an interface effect sits on: mostly one, the translations a little more often
_AXIS_WEIGHT = np.array([0.2, 0.2, 0.2, 0.14, 0.12, 0.14])
_TWO_AXES = 0.25
# Stuck elements are as stiff as this circular frequency of what they hold: fast against 12 Hz, slow against a step
_STICK_RAD_S = 150.0


@dataclass(frozen=True)
class Context:
    """What a draw may know of the person and of the trials without the effect, per axis (6,) [SI].

    ``reach`` and ``speed`` are the largest \\|q\\| and \\|qdot\\| of the training trial, ``mobility`` the
    inertia that the strap feels along each axis, ``masses`` (3,) of base, arm, interface;
    ``body_stiffness``, ``body_damping`` (6,) of the robot's controllers.
    """

    stiffness: np.ndarray
    damping: np.ndarray
    reach: np.ndarray
    speed: np.ndarray
    mobility: np.ndarray
    masses: np.ndarray
    noise_m: float
    duration_s: float
    start_s: float


@dataclass
class Draw:
    """One draw of a form: the axes it sits on and what does not depend on the severity."""

    axes: np.ndarray = field(default_factory=lambda: np.zeros(6, bool))
    values: dict[str, Any] = field(default_factory=dict)


class Form:
    """Base of all forms. ``stage``: input, interface, robot or output; ``family``: effect of the library.

    ``moves_truth``: the interface moves otherwise; ``moves_model``: an analysis starts from, or replays,
    something else than the truth; ``units``: quantity → unit of its translational and rotational axes, or one
    unit.
    """

    effect: ClassVar[str]
    form: ClassVar[str]
    stage: ClassVar[str]
    family: ClassVar[str | None] = None
    regime: ClassVar[str | None] = None
    moves_truth: ClassVar[bool] = True
    moves_model: ClassVar[bool] = False
    units: ClassVar[dict[str, tuple[str, str] | str]] = {}

    def draw(self, rng: np.random.Generator, about: Context) -> Draw:
        """Draw what does not depend on the severity."""
        return Draw()

    def values(self, draw: Draw, severity: float, about: Context) -> dict[str, Any]:
        """Quantities of the equation [SI]: (6,) per axis, or scalars and short lists."""
        raise NotImplementedError

    def change(self, setup: Setup, values: dict[str, Any], trial: str, about: Context) -> None:
        """Put the effect into a simulation."""

    def record(self, recording: Recording, values: dict[str, Any], about: Context) -> None:
        """Put the effect into what is recorded."""

    def truth(self, draw: Draw, values: dict[str, Any]) -> dict[str, Any]:
        """Parameters as they are sealed, the unit in their name."""
        out: dict[str, Any] = {}
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


class StrapForm(Form):
    """An effect of the interface law on one or two axes."""

    stage = "interface"

    def draw(self, rng, about):
        return Draw(_axes(rng), self.fixed(rng, about))

    def fixed(self, rng: np.random.Generator, about: Context) -> dict[str, Any]:
        """Draw the shape parameters."""
        return {}


# -------------------- interface: springs


@register
class Slack(StrapForm):
    """Dead band, at most 30 mm and 10 degrees, within the reach."""

    effect = form = "slack"
    regime = "small amplitude"
    units: ClassVar = {"half_width": _LENGTH}
    term: ClassVar[type[laws.Term]] = laws.Slack

    def values(self, draw, severity, about):
        most = np.minimum(_limit(0.030, np.radians(10)), 0.9 * about.reach)
        return {"half_width": draw.axes * severity * most}

    def change(self, setup, values, trial, about):
        setup.terms.append((self.term, {"half_width": values["half_width"], "stiffness": about.stiffness}))


@register
class SmoothSlack(Slack):
    """Slack that is left gradually."""

    form = "slack_tanh"
    family = "slack"
    term = laws.SmoothSlack


@register
class Coulomb(StrapForm):
    """Dry friction of the strap, at most 60 N and 4 Nm."""

    effect = form = "coulomb"
    regime = "reversals"
    units: ClassVar = {"friction": _FORCE}

    def values(self, draw, severity, about):
        most = np.minimum(_limit(60.0, 4.0), about.stiffness * about.reach + about.damping * about.speed)
        return {"friction": draw.axes * severity * most}

    def change(self, setup, values, trial, about):
        f = values["friction"]
        setup.terms.append((laws.Stick, {"upper": f, "lower": f, "spring": _stick(about)}))


def _stick(about: Context) -> np.ndarray:
    return about.mobility * _STICK_RAD_S**2


# -------------------- robot


@register
class AddedMass(Form):
    """Mass and inertia carried by the interface, at most 6 kg on a radius of about 0.15 m."""

    effect = form = "added_mass"
    stage = "robot"
    regime = "fast"
    units: ClassVar = {"mass": "kg", "inertia": "kgm2"}

    def draw(self, rng, about):
        return Draw(np.zeros(6, bool), {"radius": rng.uniform(0.10, 0.18), "flat": rng.uniform(0.5, 1.0, 3)})

    def values(self, draw, severity, about):
        mass = 6.0 * severity
        return {"mass": mass, "inertia": mass * draw.values["radius"] ** 2 * draw.values["flat"]}

    def change(self, setup, values, trial, about):
        setup.added = setup.added + np.array([values["mass"], *values["inertia"]])


# -------------------- output chain


def _shift(recording: Recording, lag: Callable[[np.ndarray], np.ndarray]) -> None:
    centres, axes = recording.interface, recording.axes
    recording.interface = lambda t: centres(lag(t))
    recording.axes = lambda t: axes(lag(t))


@register
class SyncOffset(Form):
    """Interface markers late (positive) or early against the pelvis markers, at most 60 ms."""

    effect = form = "sync_offset"
    stage = "output"
    regime = "fast"
    moves_truth = False
    units: ClassVar = {"offset": "s"}

    def draw(self, rng, about):
        return Draw(values={"sign": rng.choice([-1.0, 1.0])})

    def values(self, draw, severity, about):
        return {"offset": 0.060 * severity * draw.values["sign"]}

    def record(self, recording, values, about):
        _shift(recording, lambda t: t - values["offset"])


__all__ = ["FORMS", "Context", "CubicSpline", "Draw", "Form", "Rotation", "butter", "sosfilt", "sosfilt_zi"]
