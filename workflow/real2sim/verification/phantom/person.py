"""One synthetic person: strap parameters, rest pose of the interface, slack ranges, markers."""

from __future__ import annotations

import zlib
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.signal import lfilter
from scipy.spatial.transform import Rotation

from real2sim.verification.phantom.levels import tightness_levels
from real2sim.verification.phantom.physics import AXES

PARAMETER_NAMES = tuple(f"{kind}_{axis}" for kind in "kd" for axis in AXES)
UNITS = dict(zip(PARAMETER_NAMES, ["N/m"] * 3 + ["Nm/rad"] * 3 + ["Ns/m"] * 3 + ["Nms/rad"] * 3, strict=True))


def stream(settings: dict[str, Any], *names: str) -> np.random.Generator:
    """Random numbers of one purpose, independent of every other and of the order of the draws."""
    return np.random.default_rng([settings["seed"], *(zlib.crc32(name.encode()) for name in names)])


def active(settings: dict[str, Any], group: str, name: str) -> bool:
    """Return whether an item of ``effects`` or ``measurement`` is switched on."""
    return bool(settings[group]["enabled"] and settings[group][name]["enabled"])


@dataclass
class Person:
    """True values of a person [SI].

    ``parameters`` k_tx … d_rz; ``rest_rotation`` (3, 3) and ``rest_position`` (3,) of the interface in the
    pelvis; ``stops`` maps a level [cm] to (lower (6,), upper (6,)); ``markers`` (3,) in pelvis axes;
    ``pivot`` (3,) the turning point of the pelvis; ``soft_tissue`` marker → (3, 3) [m/rad] displacement per
    roll, pitch, yaw. ``marker_noise_m`` is the SD of the markers' white noise, ``slow_noise`` that of the slow noise
    beside it as a share of that, and ``slow_noise_s`` the time over which slow noise forgets.
    """

    name: str
    facts: dict[str, Any]
    parameters: dict[str, float]
    rest_rotation: np.ndarray
    rest_position: np.ndarray
    stops: dict[int, tuple[np.ndarray, np.ndarray]]
    markers: dict[str, np.ndarray]
    pivot: np.ndarray
    soft_tissue: dict[str, np.ndarray]
    marker_noise_m: float
    slow_noise: float = 0.0
    slow_noise_s: float = 0.35

    @property
    def operating_level(self) -> int:
        """The safe and comfortable level [cm]."""
        return int(self.facts["tightness"]["safe_comfortable_cm"])

    @property
    def stiffness(self) -> np.ndarray:
        """k_tx … k_rz, (6,)."""
        return np.array([self.parameters[n] for n in PARAMETER_NAMES[:6]])

    @property
    def damping(self) -> np.ndarray:
        """d_tx … d_rz, (6,)."""
        return np.array([self.parameters[n] for n in PARAMETER_NAMES[6:]])

    def marker_noise(self, rng: np.random.Generator, shape: tuple[int, ...], rate_hz: float) -> np.ndarray:
        """Noise [m] of marker coordinates (n, ...): white, and slow (an Ornstein-Uhlenbeck process) beside it."""
        noise = rng.standard_normal(shape)
        if self.slow_noise:
            keep = np.exp(-1 / (rate_hz * self.slow_noise_s))
            slow = np.sqrt(1 - keep**2) * rng.standard_normal(shape)
            slow[0] /= np.sqrt(1 - keep**2)
            noise += self.slow_noise * lfilter([1.0], [1.0, -keep], slow, axis=0)
        return self.marker_noise_m * noise


def draw_person(settings: dict[str, Any], name: str, interface_height: float) -> Person:
    """Draw a person by the seed; ``interface_height`` [m] of the robot's interface at the start pose."""
    facts = settings["cohort"][name]
    body = settings["person"]
    scale = facts["height_m"] / 1.75  # the reference geometry is that of an adult of 1.75 m
    rotation, position = _rest_pose(settings, name, interface_height)
    low, high = (settings["measurement"]["marker_noise"][key] for key in ("low_m", "high_m"))
    noise = stream(settings, name, "noise").uniform(low, high)
    return Person(
        name=name,
        facts=facts,
        parameters=draw_parameters(settings, name),
        rest_rotation=rotation,
        rest_position=position,
        stops=draw_stops(settings, name),
        markers=_pelvis_markers(settings, name, scale),
        pivot=np.array(body["pivot_m"]) * scale,
        soft_tissue=_soft_tissue(settings, name),
        marker_noise_m=noise if active(settings, "measurement", "marker_noise") else 0.0,
    )


def draw_parameters(settings: dict[str, Any], name: str) -> dict[str, float]:
    """Log-normal about the prior, truncated to the search bounds less a margin."""
    margin, out = settings["parameters"]["margin"], {}
    for parameter in PARAMETER_NAMES:
        p = settings["parameters"]["values"][parameter]
        rng = stream(settings, name, parameter)
        value = p["prior"] * np.exp(p["log_sd"] * rng.standard_normal())
        while p["log_sd"] and not p["low"] * margin <= value <= p["high"] / margin:
            value = p["prior"] * np.exp(p["log_sd"] * rng.standard_normal())
        out[parameter] = float(value)
    return out


def _rest_pose(settings: dict[str, Any], name: str, height: float) -> tuple[np.ndarray, np.ndarray]:
    body, rng = settings["person"], stream(settings, name, "rest")
    tilt = body["rest_tilt_deg"] + body["rest_tilt_sd_deg"] * rng.standard_normal()
    roll, yaw = body["rest_turn_sd_deg"] * rng.standard_normal(2)
    # the pelvis frame leans forward, because its x axis runs from the PSIS down to the ASIS
    pelvis = Rotation.from_euler("ZYX", [yaw, tilt, roll], degrees=True)
    asis_height = body["asis_height_ratio"] * settings["cohort"][name]["height_m"]
    xy = np.array(body["rest_position_m"]) + np.array(body["rest_position_sd_m"]) * rng.standard_normal(2)
    from_asis = np.array([xy[0], xy[1], height - asis_height])
    return pelvis.inv().as_matrix(), pelvis.inv().apply(from_asis)


def draw_stops(settings: dict[str, Any], name: str) -> dict[int, tuple[np.ndarray, np.ndarray]]:
    """Return the slack range per level [cm], lower and upper ends (6,) [m, rad].

    Yaw falls to a knee at T*, flat beyond; x and y follow a trend of their own.
    """
    law, rng = settings["stops"], stream(settings, name, "stops")
    levels, knee = (
        tightness_levels(settings["cohort"][name]),
        settings["cohort"][name]["tightness"]["safe_comfortable_cm"],
    )
    sides = 1 + law["side_difference"] * rng.uniform(-1, 1, size=(2, 6))
    trend = law["translation_trend"] * rng.uniform(-1, 1, size=2)
    scatter = rng.standard_normal((len(levels), 2, 3)) * active(settings, "effects", "stop_scatter")
    out = {}
    for level, noise in zip(levels, scatter, strict=True):
        bounds = sides * np.array(law["range"])
        slope = law["yaw_slope_deg_per_cm"] if level < knee else law["yaw_plateau_deg_per_cm"]
        bounds[:, 5] += np.radians(slope * (knee - level))
        if level != knee:
            bounds[:, :2] *= 1 + trend * (level - knee) + law["translation_scatter"] * noise[:, :2]
            bounds[:, 5] += np.radians(law["yaw_scatter_deg"]) * noise[:, 2]
        out[level] = (-bounds[0], bounds[1])
    return out


def _pelvis_markers(settings: dict[str, Any], name: str, scale: float) -> dict[str, np.ndarray]:
    body, rng = settings["person"], stream(settings, name, "markers")
    asis, psis, depth = (
        scale * body[key] for key in ("asis_half_width_m", "psis_half_width_m", "pelvis_depth_m")
    )
    # a PSIS pair a little askew keeps the frame's definition: its midpoint has z = 0
    skew = 0.004 * rng.standard_normal(2)
    return {
        "ASIS_L": np.array([0.0, asis, 0.0]),
        "ASIS_R": np.array([0.0, -asis, 0.0]),
        "PSIS_L": np.array([-depth, psis + skew[0], skew[1]]),
        "PSIS_R": np.array([-depth, -psis + skew[0], -skew[1]]),
    }


def _soft_tissue(settings: dict[str, Any], name: str) -> dict[str, np.ndarray]:
    rng = stream(settings, name, "soft tissue")
    sd = settings["effects"]["soft_tissue"]["sd_m_per_rad"] * active(settings, "effects", "soft_tissue")
    return {marker: sd * rng.standard_normal((3, 3)) for marker in ("ASIS_L", "ASIS_R", "PSIS_L", "PSIS_R")}
