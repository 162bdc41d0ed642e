"""Free-form displacements of what is measured: markers of the interface and the path of the driven segment.

As the families of forces, each is linear in coefficients with a Gaussian prior: lags and filters of any order by the
derivatives of a path, drift by powers of time, markers on a body that turns by its orientation, markers on a strap that
is stretched by where the interface is against the segment.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from typing import ClassVar

import numpy as np
import scipy
from numpy.polynomial import legendre
from scipy.spatial.transform import Rotation

from real2sim import signals
from real2sim.effects.base import AtRest, Effect, EffectParameter
from real2sim.effects.chains import Chains, Context
from real2sim.effects.families import passed_s

# One unit of a coefficient: a lag of 10 ms and what its square and cube are, a displacement of 5 mm, a turn of 0.02 rad
_LAG_S = 0.01
_WAY_M = 0.005
_TURN_RAD = 0.02
_ANGLE_RAD = 0.1
_BAND_HZ = 6.0
# Coordinates of the interface that its two markers show, and how many functions of one there are
DEFLECTIONS = ("tx", "ty", "tz", "rx", "rz")
_ORDERS = 8
# Times [s] after which what trails behind a turn has followed
_TIMES_S = (0.15, 0.5, 1.5)


@dataclass(frozen=True)
class Displacement:
    """A family of displacements: names of its coefficients, their prior SD beside each other, and its chains."""

    name: str
    stage: str
    depends_on: tuple[str, ...]
    terms: tuple[str, ...]
    weights: tuple[float, ...]
    chains: Chains

    kind: ClassVar = "measurement"
    axes: ClassVar[tuple[str, ...]] = ()

    @property
    def key(self) -> str:
        """Name in progress lines and tables."""
        what = "interface markers" if self.stage == "output" else "segment's path"
        return f"displacement of the {what} by {', '.join(self.depends_on)}"

    def effect(self, sd: Sequence[float], bound: float) -> Effect:
        """Return the effect with prior SD of its coefficients."""
        return Effect(
            self.name,
            self.stage,
            "linear in its coefficients",
            tuple(
                EffectParameter(name, "1", -bound, bound, (0.0,), prior_sd=s)
                for name, s in zip(self.terms, sd, strict=True)
            ),
            separating_trial="the two systems recorded together on a rigid body",
            at_rest=AtRest((0.0,) * len(self.terms)),
            scope="whole",
            chains=self.chains,
        )


_LAGS = ("lag", "lag^2", "lag^3")
_WAY = tuple(f"{a} time^{k}" for k in (1, 2, 3) for a in "xyz")
_SLOW = (1.0,) * 3 + (0.5,) * 3 + (0.33,) * 3
_TURNED = tuple(f"{a} {n}" for n in ("tilt", "list", "heading") for a in "xyz")
_TURNS = ("pelvis_tilt", "pelvis_list", "pelvis_heading")
_TRAILS = _TURNED + tuple(f"{term} relaxing in {t:g} s" for t in _TIMES_S for term in _TURNED)
_TRAILING_OF = tuple(f"history of {turn}" for turn in _TURNS)


def displacements(long_s: float, fitted: Context) -> list[Displacement]:
    """Return all families of displacements of a system whose segment has a pose and whose interface has markers.

    ``long_s`` is one unit of the time [s] by which they drift, the same in all trials; ``fitted`` the trial that is
    fitted, whose ranges of the interface's coordinates markers may be displaced by.
    """
    return [*_of_markers(long_s), *_of_deflected_markers(fitted), *_of_segment(long_s)]


def deflected_by(axis: str) -> str:
    """Return the name of the family of markers that one coordinate of the interface displaces."""
    return f"markers by {axis}"


def _of_markers(long_s: float) -> Iterator[Displacement]:
    # each marker by itself: one may slide and the other not
    sides = ("left", "right")
    single = tuple(f"{marker} {term}" for term in ("x", "y", "z", *_TURNED) for marker in sides)
    apart = tuple(f"{marker} {term}" for term in _WAY for marker in sides)
    slow = tuple(w for w in _SLOW for _ in sides)
    alike, trails = (1.0,) * len(single), (1.0,) * len(_TRAILS)
    for name, depends_on, terms, weights, chain in (
        ("late markers", ("rate",), _LAGS, (1.0,) * 3, _late_markers),
        ("drifting markers", ("time",), apart, slow, partial(_drifting_markers, long_s)),
        ("turned markers", _TURNS, single, alike, _turned_markers),
        ("trailing markers", _TRAILING_OF, _TRAILS, trails, _trailing_markers),
    ):
        yield Displacement(name, "output", depends_on, terms, weights, Chains(output=chain))


def _of_deflected_markers(fitted: Context) -> Iterator[Displacement]:
    visited = deflections(fitted.measured[None], fitted)[0]
    # rough functions are rarer
    weights = tuple(1 / max(k, 1) for k in range(_ORDERS + 1) for _ in range(6))
    for i, axis in enumerate(DEFLECTIONS):
        terms = tuple(
            f"{marker} {a} P{k}({axis})"
            for k in range(_ORDERS + 1)
            for a in "xyz"
            for marker in ("left", "right")
        )
        reach = float(np.nanmin(visited[:, i])), float(np.nanmax(visited[:, i]))
        chain = partial(_deflected_markers, i, reach)
        yield Displacement(deflected_by(axis), "output", (f"q_{axis}",), terms, weights, Chains(output=chain))


def _of_segment(long_s: float) -> Iterator[Displacement]:
    # a segment is displaced and turned, the turns after the displacements
    way, turned = (terms + tuple(f"r{term}" for term in terms) for terms in (_WAY, _TURNED))
    alike, trails = (1.0,) * len(turned), (1.0,) * len(_TRAILS)
    for name, depends_on, terms, weights, chain in (
        ("late segment", ("rate",), _LAGS[:2], (1.0,) * 2, _late_segment),
        ("drifting segment", ("time",), way, _SLOW * 2, partial(_drifting_segment, long_s)),
        ("turned segment", _TURNS, turned, alike, _turned_segment),
        ("trailing segment", _TRAILING_OF, _TRAILS, trails, _trailing_segment),
    ):
        yield Displacement(name, "input", depends_on, terms, weights, Chains(input=chain))


def _rate(context: Context) -> float:
    return float(1 / (context.time_s[1] - context.time_s[0]))


def _derivatives(path: np.ndarray, rate_hz: float, order: int) -> list[np.ndarray]:
    """Return derivatives (n, k) of a path (n, k) in units of a lag, its square and so on, below 6 Hz."""
    out, now = [], signals.lowpass(path, rate_hz, _BAND_HZ, 2)
    for _ in range(order):
        now = _LAG_S * signals.derivative(now, rate_hz)
        out.append(now)
    return out


def _late_markers(paths: np.ndarray, values: np.ndarray, context: Context) -> np.ndarray:
    out = paths.copy()
    for k, path in enumerate(paths):
        parts = _derivatives(path.reshape(len(path), -1), _rate(context), values.shape[1])
        for value, part in zip(values[k], parts, strict=True):
            out[k] -= value * part.reshape(path.shape)
    return out


def _drifting_markers(long_s: float, paths: np.ndarray, values: np.ndarray, context: Context) -> np.ndarray:
    powers = (passed_s(context)[:, None] / long_s) ** np.arange(1, 4)
    return _moved(paths, powers, values, context)


def _angles(context: Context) -> np.ndarray:
    """Return tilt, list and heading (n, 3) of the segment against standing, in units of 0.1 rad."""
    standing = Rotation.from_matrix(context.pelvis_rotation[: context.start]).mean()
    turned = (standing.inv() * Rotation.from_matrix(context.pelvis_rotation)).as_rotvec()
    tilt_list_heading = turned[:, [1, 0, 2]]
    return np.asarray(signals.lowpass(tilt_list_heading, _rate(context), _BAND_HZ, 2) / _ANGLE_RAD)


def _turned_markers(paths: np.ndarray, values: np.ndarray, context: Context) -> np.ndarray:
    angles = np.column_stack([np.ones(len(context.time_s)), _angles(context)])
    return _moved(paths, angles, values, context)


def deflections(paths: np.ndarray, context: Context) -> np.ndarray:
    """Return coordinates (m, n, 5) of the interface, `DEFLECTIONS` [m, rad], that marker paths (m, n, 2, 3) [m] show.

    Angles are those of small turns.
    """
    origin, rest = context.pelvis_position[:, None], context.shapes.interface
    way = np.einsum("nji,mnkj->mnki", context.pelvis_rotation, paths - origin) - rest
    apart = (way[:, :, 0] - way[:, :, 1]) / np.linalg.norm(rest[0] - rest[1])
    return np.concatenate([way.mean(axis=2), apart[..., 2:], -apart[..., :1]], axis=2)


def _deflected_markers(
    axis: int, reach: tuple[float, float], paths: np.ndarray, values: np.ndarray, context: Context
) -> np.ndarray:
    low, high = reach
    # by where the simulation has the interface: what was recorded there holds the displacement that is looked for
    q = deflections(paths, context)[..., axis]
    inside = np.clip((2 * q - low - high) / max(high - low, 1e-9), -1, 1)
    way = np.einsum(
        "mnk,mkcj->mnjc", legendre.legvander(inside, _ORDERS), values.reshape(len(values), -1, 3, 2)
    )
    return np.asarray(paths + _WAY_M * np.einsum("nic,mnjc->mnji", context.interface_rotation, way))


def _trails(context: Context) -> np.ndarray:
    """Return tilt, list and heading, and by time what of them has not yet been followed, (n, 12) [0.1 rad]."""
    angles, step_s = _angles(context), 1 / _rate(context)
    out = [angles]
    for time_s in _TIMES_S:
        keep = float(np.exp(-step_s / time_s))
        followed = scipy.signal.lfilter([1 - keep], [1, -keep], angles, axis=0, zi=keep * angles[:1])[0]
        out.append(angles - followed)
    return np.hstack(out)


def _trailing_markers(paths: np.ndarray, values: np.ndarray, context: Context) -> np.ndarray:
    way = np.einsum("nk,mkc->mnc", _trails(context), values.reshape(len(values), -1, 3))
    turned = np.einsum("nic,mnc->mni", context.interface_rotation, way)
    return np.asarray(paths + _WAY_M * turned[:, :, None])


def _trailing_segment(values: np.ndarray, context: Context) -> tuple[np.ndarray, np.ndarray]:
    return _displaced(context, _WAY_M * _trails(context) @ values.reshape(-1, 3))


def _moved(paths: np.ndarray, signals_of: np.ndarray, values: np.ndarray, context: Context) -> np.ndarray:
    """Return marker paths (m, n, 2, 3) displaced along the interface's axes, each by its own sum of signals (n, k)."""
    way = np.einsum("nk,mkcj->mnjc", signals_of, values.reshape(len(values), -1, 3, 2))
    return np.asarray(paths + _WAY_M * np.einsum("nic,mnjc->mnji", context.interface_rotation, way))


def _displaced(
    context: Context, way: np.ndarray, turn: np.ndarray | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """Return the segment's path displaced by ways (n, 3) [m] and turns (n, 3) [rad] along its own axes."""
    rotation, position = context.pelvis_rotation, context.pelvis_position
    moved = position + np.einsum("nij,nj->ni", rotation, way)
    return (rotation if turn is None else rotation @ Rotation.from_rotvec(turn).as_matrix()), moved


def _late_segment(values: np.ndarray, context: Context) -> tuple[np.ndarray, np.ndarray]:
    rate, rotation = _rate(context), context.pelvis_rotation
    turned = (Rotation.from_matrix(rotation[0]).inv() * Rotation.from_matrix(rotation)).as_rotvec()
    both = np.hstack([context.pelvis_position, turned])
    moved = both - np.tensordot(values, np.array(_derivatives(both, rate, len(values))), axes=1)
    return rotation[0] @ Rotation.from_rotvec(moved[:, 3:]).as_matrix(), moved[:, :3]


def _drifting_segment(long_s: float, values: np.ndarray, context: Context) -> tuple[np.ndarray, np.ndarray]:
    powers = (passed_s(context)[:, None] / long_s) ** np.arange(1, 4)
    way, turn = values.reshape(2, 3, 3)
    return _displaced(context, _WAY_M * powers @ way, _TURN_RAD * powers @ turn)


def _turned_segment(values: np.ndarray, context: Context) -> tuple[np.ndarray, np.ndarray]:
    angles = _angles(context)
    way, turn = values.reshape(2, 3, 3)
    return _displaced(context, _WAY_M * angles @ way, _TURN_RAD * angles @ turn)
