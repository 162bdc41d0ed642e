"""From a true trial to what is recorded of it, and from a recording to what an analysis would replay and compare."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.signal import butter, sosfiltfilt
from scipy.spatial.transform import Rotation

from real2sim.verification.phantom.motions import pelvis_path
from real2sim.verification.phantom.person import Person
from real2sim.verification.phantom.physics import PelvisPath

SIGMA_P, SIGMA_V = 0.041, 0.080  # scales of J (paper, eq. 3): m, m/s
CUTOFF_HZ = 12.0  # of the analysis (config.yaml, ingest.cutoff_hz)

Markers = dict[str, np.ndarray]


@dataclass
class Recording:
    """A trial before noise: functions of the recording's time t (n,), which effects wrap.

    ``interface`` gives the joint centres left, right (n, 2, 3) [m], ``axes`` the interface's rotation (n, 3,
    3), ``pelvis`` the four pelvis markers; ``name`` of the trial, ``duration_s`` of its record, ``start_s``
    when the motion begins.
    """

    name: str
    duration_s: float
    start_s: float
    interface: Callable[[np.ndarray], np.ndarray]
    axes: Callable[[np.ndarray], np.ndarray]
    pelvis: Callable[[np.ndarray], Markers]

    @property
    def dynamic(self) -> bool:
        """Return whether this is one of the dynamic trials."""
        return self.name != "neutral"


def pelvis_markers(person: Person, path: PelvisPath) -> Callable[[np.ndarray], Markers]:
    """Return the four markers (n, 3) [m] of a pelvis by time (n,) [s]; before the first sample it stands still."""

    def at(t: np.ndarray) -> Markers:
        rotation, position = path(np.maximum(t, 0.0))[:2]
        return {name: position + rotation @ place for name, place in person.markers.items()}

    return at


def sampled(time_s: np.ndarray, values: np.ndarray) -> Callable[[np.ndarray], np.ndarray]:
    """Return the cubic spline through values (n, ...) at times (n,) [s] as a function of times (m,) [s], (m, ...).

    Held at both ends; NaN where the simulation was unstable.
    """
    if not np.isfinite(values).all():
        return lambda t: np.full((len(t), *values.shape[1:]), np.nan)
    spline = CubicSpline(time_s, values)
    return lambda t: spline(np.clip(t, time_s[0], time_s[-1]))


def pelvis_pose(markers: Markers) -> tuple[np.ndarray, np.ndarray]:
    """Return rotation (n, 3, 3) and origin (n, 3) [m] of the pelvis: x forward, y left, between the ASIS markers."""
    origin = (markers["ASIS_L"] + markers["ASIS_R"]) / 2
    back = (markers["PSIS_L"] + markers["PSIS_R"]) / 2
    y = markers["ASIS_L"] - markers["ASIS_R"]
    y = y / np.linalg.norm(y, axis=-1, keepdims=True)
    z = np.cross(origin - back, y)
    z = z / np.linalg.norm(z, axis=-1, keepdims=True)
    return np.stack([np.cross(y, z), y, z], axis=-1), origin


def interface_pose(centres: np.ndarray, up: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rotation (3, 3) and midpoint (3,) of the interface from its joint centres (2, 3) and the arm's up axis."""
    y = centres[0] - centres[1]
    y = y / np.linalg.norm(y)
    x = np.cross(y, up)
    x = x / np.linalg.norm(x)
    return np.column_stack([x, y, np.cross(x, y)]), centres.mean(axis=0)


@dataclass
class _Spline:
    """A motion through sampled poses, a `motions.PelvisMotion`."""

    curve: CubicSpline
    duration_s: float

    def __call__(self, t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        inside = np.clip(t, self.curve.x[0], self.curve.x[-1])
        moving = (t <= self.curve.x[-1])[:, None]
        return self.curve(inside), self.curve(inside, 1) * moving


def replayed_path(markers: Markers, rate_hz: float) -> PelvisPath:
    """The path that an analysis would replay: pose of sampled markers, low-passed, as a spline."""
    smooth = {name: low_pass(values, rate_hz) for name, values in markers.items()}
    rotation, position = pelvis_pose(smooth)
    angles = Rotation.from_matrix(rotation @ rotation[0].T).as_euler("ZYX")[:, ::-1]
    pose = np.hstack([position - position[0], np.unwrap(angles, axis=0)])
    time_s = np.arange(len(pose)) / rate_hz
    motion = _Spline(CubicSpline(time_s, pose), len(pose) / rate_hz)
    return pelvis_path(motion, 0.0, rotation[0], position[0], np.zeros(3), 0.0)


def low_pass(values: np.ndarray, rate_hz: float, cutoff_hz: float = CUTOFF_HZ) -> np.ndarray:
    """Return values (n, ...) after a zero-phase fourth-order low-pass along axis 0, -3 dB at the cut-off in all."""
    corrected = np.tan(np.pi * cutoff_hz / rate_hz) / (np.sqrt(2) - 1) ** 0.25
    sos = butter(2, 2 / np.pi * np.arctan(corrected), output="sos")
    filtered: np.ndarray = sosfiltfilt(sos, values, axis=0)
    return filtered


def residual(difference: np.ndarray, rate_hz: float) -> np.ndarray:
    """Vector whose sum of squares is J of a difference of joint centres (m, 2, 3) [m]."""
    e = low_pass(difference, rate_hz)
    v = (e[2:] - e[:-2]) * rate_hz / 2
    m = len(e)
    return np.concatenate(
        [e.ravel() / (SIGMA_P * np.sqrt(2 * m)), v.ravel() / (SIGMA_V * np.sqrt(2 * (m - 2)))]
    )
