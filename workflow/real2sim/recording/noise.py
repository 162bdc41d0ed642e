"""How loud the noise of a recording is, as a person who stands shows it: markers, robot log, rest pose, hold."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise, product
from pathlib import Path

import mujoco
import numpy as np
import pyarrow.parquet as pq
from scipy.fft import dct
from scipy.signal import welch
from scipy.stats import chi2
from scipy.stats import f as f_distribution

from real2sim import signals
from real2sim.geometry import AXES, INTERFACE_MARKERS, PELVIS_MARKERS
from real2sim.recording.quality.markers import MARKERS, distances, stacked
from real2sim.recording.tables import interface_path, measured_coordinates
from real2sim.system.plant import ROBOT_JOINTS

# Noise is never taken as smaller than this
SMALLEST_NOISE_M = 2e-5
# Where standing still shows the markers' noise
NOISE_BAND_HZ = (3.0, 7.0)
# Deviance by which noise that looks slower than white is taken as such (three numbers and a probability of 0.9999), and
# the slow noise that is tried: power against the white one's at low frequencies, the corner above which it falls, by
# which power of the frequency, and how many parts of it
_SURE = float(chi2.ppf(0.9999, 3))
# Share of the loudest combination's variance that another has at least, to tell of the noise
LEAST_TELLING = 0.01
_SLOW_POWERS = np.geomspace(0.3, 3000, 30)
_SLOW_CORNERS_HZ = np.geomspace(0.05, 3.0, 20)
_SLOW_FALLS, _MOST_PARTS = (2, 8), 2
# Where a moving person hardly moves, and how sure it has to be that a log is louder there than that of standing
QUIET_BANDS_HZ = ((7.0, 10.0), (10.0, 14.0))
_LOUDER = 0.99
# Band edges [Hz] within which the noise is taken as equal
BANDS_HZ = (0.0, 0.15, 0.3, 0.6, 1.2, 2.4, 4.8, 10.0)


def marker_noise(markers: Path, rate_hz: float) -> dict[str, np.ndarray]:
    """SD (3,) [m] per marker of the white noise that quiet standing shows between 3 and 7 Hz.

    Below, the person sways; above, nobody knows who has filtered the export already. ``markers`` is markers.parquet
    of the neutral trial. Welch's windows keep the sway from leaking upward. Some seconds of a band tell a variance to a
    fifth, so each is drawn to the mean of all, the more, the less they differ beyond that.
    """
    table = pq.read_table(markers)
    names = (*PELVIS_MARKERS, *INTERFACE_MARKERS)
    variance = np.empty((len(names), 3))
    for i, name in enumerate(names):
        path = signals.bridged(np.column_stack([table[f"{name}_{c}"].to_numpy() for c in "xyz"]))
        variance[i] = np.maximum(_white_variance(path, rate_hz, NOISE_BAND_HZ), SMALLEST_NOISE_M**2)
    duration = len(table) / rate_hz
    known = drawn_together(variance, 2 * duration * (NOISE_BAND_HZ[1] - NOISE_BAND_HZ[0]))
    return {name: np.sqrt(row) for name, row in zip(names, known, strict=True)}


def _white_variance(series: np.ndarray, rate_hz: float, band_hz: tuple[float, float]) -> np.ndarray:
    """Variance (k,) of white noise as loud as a series (n, k) is within a band; Welch's windows hold what is slower."""
    frequency, power = welch(series, rate_hz, nperseg=min(len(series), 256), axis=0, detrend="linear")
    inside = (frequency > band_hz[0]) & (frequency < band_hz[1])
    return np.asarray(power[inside].mean(axis=0) * rate_hz / 2)


def noise_colour(markers: Path, rate_hz: float) -> np.ndarray:
    """How much more power noise has in each band of BANDS_HZ than where `marker_noise` looks, 1 or more: (2, bands).

    Of the pelvis' and of the interface's markers. Markers of a body that stands keep their distances, whatever it does;
    only their noise changes them. White noise and up to two parts of slow noise are fitted to the spectra by Whittle's
    likelihood, for some seconds hold few periods of the slow bands. A part is as loud below a corner; above, it falls
    with the square of the frequency (an Ornstein-Uhlenbeck process) or far faster (behind a filter). It is believed
    only where chance would hardly make it. Both bodies have the same noise unless they show otherwise: the one distance
    on the interface tells little. ``markers`` is markers.parquet of the neutral trial.
    """
    table = pq.read_table(markers)
    places = {m: np.column_stack([table[f"{m}_{c}"].to_numpy() for c in "xyz"]) for m in MARKERS}
    lengths = distances(stacked(places))
    frequency = np.arange(len(lengths)) * rate_hz / (2 * len(lengths))
    powers = [_power(lengths[:, body], frequency) for body in (slice(-1), slice(-1, None))]
    slow = frequency[_heard(frequency)]
    together, apart = _slow_noise(np.hstack(powers), slow), [_slow_noise(power, slow) for power in powers]
    more = max(sum(len(noise.parts) for noise in apart) - len(together.parts), 1)
    differ = together.deviance - sum(noise.deviance for noise in apart) > more * _SURE
    return np.array([noise.colour() for noise in (apart if differ else [together] * 2)])


def _heard(frequency: np.ndarray) -> np.ndarray:
    """Which frequencies [Hz] tell of the noise."""
    return (frequency > 0) & (frequency < NOISE_BAND_HZ[1])


def _power(series: np.ndarray, frequency: np.ndarray) -> np.ndarray:
    """Power (f, k) of independent combinations of series (n, j) where `_heard`, those that tell something.

    Two distances that share a marker share its noise. Markers in one plane make a combination that noise hardly moves,
    a marker that is never seen none at all.
    """
    seen = signals.bridged(series[:, np.isfinite(series).any(axis=0)])
    coefficients = dct(seen - seen.mean(axis=0), axis=0, norm="ortho")
    fast = coefficients[(frequency > NOISE_BAND_HZ[0]) & (frequency < NOISE_BAND_HZ[1])]
    variance, combinations = np.linalg.eigh(fast.T @ fast / len(fast))
    telling = variance > max(LEAST_TELLING * variance.max(initial=0.0), SMALLEST_NOISE_M**2)
    return np.asarray((coefficients[_heard(frequency)] @ combinations[:, telling]) ** 2)


# Power against the white noise's, corner [Hz] and the power of the frequency by which a part of slow noise falls
_Part = tuple[float, float, int]


@dataclass(frozen=True)
class _SlowNoise:
    """Fit of slow noise beside white noise: its parts, none where chance would make as much, and the ``deviance``.

    That is minus twice Whittle's log-likelihood, but for a constant.
    """

    deviance: float
    parts: tuple[_Part, ...]

    def colour(self) -> np.ndarray:
        """Of `noise_colour`, for one body."""

        def mean(low_hz: float, high_hz: float) -> float:
            return float(_shape(self.parts, np.linspace(low_hz, high_hz)).mean())

        of_bands = [mean(low, high) for low, high in pairwise(BANDS_HZ)]
        return np.maximum(np.array(of_bands) / mean(*NOISE_BAND_HZ), 1.0)


def _shape(parts: Sequence[_Part], frequency: np.ndarray) -> np.ndarray:
    shape = np.ones_like(frequency)
    for loud, corner, falls in parts:
        shape += loud / (1 + (frequency / corner) ** falls)
    return shape


def _slow_noise(power: np.ndarray, frequency: np.ndarray) -> _SlowNoise:
    """Likeliest slow noise of spectra (f, k) that each have a level of their own, part by part."""
    every = list(product(_SLOW_POWERS, _SLOW_CORNERS_HZ, _SLOW_FALLS))

    def deviance(parts: Sequence[_Part]) -> float:
        shape = _shape(parts, frequency)[:, None]
        return float(len(shape) * np.log(np.mean(power / shape, axis=0)).sum()) + float(
            power.shape[1] * np.log(shape).sum()
        )

    def likeliest(others: tuple[_Part, ...]) -> _SlowNoise:
        return min(
            (_SlowNoise(deviance((*others, p)), (*others, p)) for p in every), key=lambda n: n.deviance
        )

    best = _SlowNoise(deviance(()), ())
    while len(best.parts) < _MOST_PARTS:
        more = likeliest(best.parts)
        # what stood alone made up for what has come beside it
        for _ in best.parts:
            more = likeliest(more.parts[1:])
        if best.deviance - more.deviance < _SURE:
            break
        best = more
    return best


def rest_uncertainty(pose: Path, rate_hz: float) -> np.ndarray:
    """SD (6,) [m, rad] of the rest pose of the interface: the mean of its coordinates over a person who sways.

    Means of seconds are taken as independent of each other. ``pose`` is pose.parquet of the neutral trial.
    """
    q, second = measured_coordinates(pose, "q"), round(rate_hz)
    seconds = q[: len(q) // second * second].reshape(-1, second, len(AXES)).mean(axis=1)
    return np.asarray(seconds.std(axis=0, ddof=1) / np.sqrt(len(seconds)))


def hold_uncertainty(
    standing: Path,
    trial: Path,
    start: int,
    rate_hz: float,
    robot: mujoco.MjModel,
    held: dict[str, dict[str, float]],
) -> np.ndarray:
    """How far [m, rad] beside the balance a controller may hold and how fast the robot may move: SD (2, 6) by joint.

    A person who sways pulls at a robot that has come to rest, and its damping and inertia take a part of the pull: it
    is never quite in balance, and never quite at rest. By how much the interface moves from second to second of
    ``standing`` (pose.parquet of the neutral trial); its rate also as the first ``start`` samples of ``trial``'s
    pose.parquet show it. ``held`` as from `impedances`.
    """
    path, second = interface_path(standing), round(rate_hz)
    means = path[: len(path) // second * second].reshape(-1, second, 6).mean(axis=1)
    speed = np.sqrt(np.mean(np.diff(means, axis=0) ** 2, axis=0))
    acceleration = speed**2 / np.maximum(means.std(axis=0), 1e-9)
    data, mass = mujoco.MjData(robot), np.zeros((robot.nv, robot.nv))
    mujoco.mj_forward(robot, data)
    mujoco.mj_fullM(robot, data, mass)
    inertia = np.diag(mass)[[robot.joint(name).dofadr[0] for name in ROBOT_JOINTS]]
    stiffness, damping = (np.array([held[j][key] for j in ROBOT_JOINTS]) for key in ("stiffness", "damping"))
    first = np.polyfit(np.arange(start) / rate_hz, interface_path(trial)[:start], 1)[0]
    beside = np.hypot(damping * speed, inertia * acceleration) / stiffness
    return np.array([beside, np.hypot(speed, first)])


def robot_noise(neutral: Path, trial: Path, rate_hz: float) -> np.ndarray:
    """SD (6,) of the white noise of the robot's log [m, rad]: as quiet standing shows it between 3 and 7 Hz.

    Or as the trial itself does where hardly anybody moves, in the quieter of two bands, where that is more than chance
    would make of it: wheels that turn are not read as well as wheels that stand. Both are robot.parquet. Zero without
    either.
    """
    variance, freedom = np.zeros(len(ROBOT_JOINTS)), 0.0
    for path, bands in ((neutral, [NOISE_BAND_HZ]), (trial, QUIET_BANDS_HZ)):
        table = pq.read_table(path)
        columns = np.column_stack([table[name].to_numpy() for name in ROBOT_JOINTS])
        if np.isfinite(columns).all(axis=1).mean() < 0.5:
            continue
        path_at = signals.bridged(columns)
        own = np.min([_white_variance(path_at, rate_hz, band) for band in bands], axis=0)
        own_freedom = 2 * len(table) / rate_hz * (bands[0][1] - bands[0][0])
        chance = f_distribution.ppf(_LOUDER, own_freedom, freedom) if freedom else 0.0
        variance = np.where(own > chance * variance, own, variance)
        freedom = own_freedom
    return np.sqrt(variance)


def drawn_together(variance: np.ndarray, freedom: float) -> np.ndarray:
    """Variances, each estimated with ``freedom`` degrees of freedom, drawn to their common mean (James & Stein 1961).

    In logarithms, whose sampling variance 2 / freedom is known. What the estimates scatter beyond it is real.
    """
    log = np.log(variance)
    chance = 2 / freedom
    # the mean of a logarithm is a little below the logarithm of the mean
    mean = log.mean() + chance / 2
    real = max(float(log.var(ddof=1)) - chance, 0.0)
    return np.asarray(np.exp(mean + real / (real + chance) * (log - log.mean())))
