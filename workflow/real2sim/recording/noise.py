"""Measurement noise of a recording, from quiet standing: markers, robot log, rest pose, controller set-point."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise, product
from pathlib import Path
from typing import TYPE_CHECKING

import mujoco
import numpy as np
import pyarrow.parquet as pq
from scipy.fft import dct, idct
from scipy.signal import welch
from scipy.stats import chi2
from scipy.stats import f as f_distribution

from real2sim import signals
from real2sim.errors import InputError
from real2sim.geometry import AXES, INTERFACE_MARKERS, PELVIS_MARKERS
from real2sim.recording.quality.markers import MARKERS, distances, stacked
from real2sim.recording.tables import interface_path, measured_coordinates
from real2sim.system.plant import ROBOT_JOINTS

if TYPE_CHECKING:
    from real2sim.settings import DiagnosisNoiseSettings, IngestSettings

# Grid of the search for slow noise: power relative to the white noise at low frequencies, corner above which the power
# falls, exponent of the fall, and the most components
_SLOW_POWERS = np.geomspace(0.3, 3000, 30)
_SLOW_CORNERS_HZ = np.geomspace(0.05, 3.0, 20)
_SLOW_FALLS, _MOST_COMPONENTS = (2, 8), 2
# A component has three numbers: power, corner, exponent
_COMPONENT_FREEDOM = 3


@dataclass(frozen=True)
class LowPass:
    """The zero-phase Butterworth low-pass of the ingest (`signals.lowpass`) at the rate of the common clock."""

    rate_hz: float
    cutoff_hz: float
    order: int

    @property
    def _corner(self) -> float:
        """Corner of either pass in the prewarped frequency."""
        warped = np.tan(np.pi * self.cutoff_hz / self.rate_hz)
        return float(warped * (np.sqrt(2) - 1) ** (-1 / self.order))

    def power(self, frequency: np.ndarray) -> np.ndarray:
        """Return the share of the power (f,) that both passes leave at frequencies (f,) [Hz]."""
        if self.cutoff_hz >= self.rate_hz / 2:
            return np.ones(len(frequency))
        ratio = np.tan(np.pi * np.minimum(frequency / self.rate_hz, 0.4999)) / self._corner
        return np.asarray((1 + ratio**self.order) ** -2.0)

    def passes_up_to(self, share: float) -> float:
        """Return the frequency [Hz] up to which a share of the power passes."""
        if self.cutoff_hz >= self.rate_hz / 2:
            return self.rate_hz / 2
        warped = self._corner * (share**-0.5 - 1) ** (1 / self.order)
        return float(np.arctan(warped) * self.rate_hz / np.pi)

    def apply(self, values: np.ndarray) -> np.ndarray:
        """Return series (n, ...) as the filter leaves them."""
        flat = values.reshape(len(values), -1)
        return signals.lowpass(flat, self.rate_hz, self.cutoff_hz, self.order).reshape(values.shape)


@dataclass(frozen=True)
class Bands:
    """Frequencies in which the noise of a recording is measured and its residuals are whitened.

    Attributes
    ----------
    low_pass
        The filter that the ingest applies to markers.
    standing_hz, log_standing_hz
        Band (low, high) in which quiet standing shows the white noise of markers, and of the robot log.
    log_moving_hz
        Bands in which a moving person hardly moves the robot: the quieter one shows the noise of its log.
    edges_hz
        Edges, from 0, of the bands within which the noise is whitened as equally loud; the last one is the highest
        frequency of a residual that counts. None is where the low-pass leaves little: what is divided by almost nothing
        is no information.
    options
        Slice ``diagnosis.noise`` of the configuration.
    """

    low_pass: LowPass
    standing_hz: tuple[float, float]
    log_standing_hz: tuple[float, float]
    log_moving_hz: tuple[tuple[float, float], ...]
    edges_hz: tuple[float, ...]
    options: DiagnosisNoiseSettings

    @classmethod
    def from_settings(cls, ingest: IngestSettings, options: DiagnosisNoiseSettings) -> Bands:
        """Return the bands for the slices ``ingest`` and ``diagnosis.noise`` of the configuration.

        Raises InputError where cut-off and rate leave none.
        """
        low_pass = LowPass(float(ingest["rate_hz"]), float(ingest["cutoff_hz"]), ingest["filter_order"])
        fastest = low_pass.rate_hz / options["samples_per_period"]
        low, high = map(float, options["standing_hz"])
        *inner, last = map(float, options["edges_hz"])
        last = min(last, low_pass.cutoff_hz / options["cutoff_margin"])
        bands = cls(
            low_pass,
            (low, min(high, low_pass.passes_up_to(options["least_passed"]))),
            (low, min(high, fastest)),
            tuple((float(a), float(b)) for a, b in options["log_moving_hz"] if b <= fastest),
            (0.0, *(edge for edge in inner if last >= options["narrowest_band"] * edge), last),
            options,
        )
        _check_rate(bands)
        _check_cutoff(bands)
        return bands

    @property
    def rate_hz(self) -> float:
        """Rate of the common clock [Hz]."""
        return self.low_pass.rate_hz

    def response(self, frequency: np.ndarray) -> np.ndarray:
        """Return the share of the power (f,) of noise that the low-pass leaves at frequencies (f,) [Hz].

        Where that is at least the option ``passes``, the filter is taken as passing all.
        """
        share = self.low_pass.power(frequency)
        return np.where(share >= self.options["passes"], 1.0, share)

    @property
    def is_filtered(self) -> bool:
        """Return whether the low-pass takes a part of the noise where it is measured."""
        return bool((self.response(np.array(self.standing_hz)) < 1).any())

    @property
    def floor(self) -> np.ndarray:
        """Least SD (12,) of the markers' [m] and the robot log's channels [m, rad], at the rate of the clock.

        Scaled so that the power per hertz is the same at any rate.
        """
        options = self.options
        floor = np.concatenate([np.full(6, options["marker_floor_m"]), options["robot_floor"]])
        return np.asarray(floor * np.sqrt(self.rate_hz / options["floor_rate_hz"]))

    def freedom(self, duration_s: float) -> float:
        """Return the degrees of freedom of a variance that the markers of so long a trial show while standing."""
        return 2 * duration_s * (self.standing_hz[1] - self.standing_hz[0])

    def coefficients(self, samples: int, duration_s: float) -> int:
        """Return how many cosine coefficients of a residual count."""
        return min(samples, int(2 * duration_s * self.edges_hz[-1]))

    def band_of(self, frequency: np.ndarray) -> np.ndarray:
        """Return band indices (n,) of frequencies (n,) [Hz]; those above the last edge belong to the last band."""
        return np.searchsorted(self.edges_hz[1:-1], frequency, side="right")

    def white_variance(
        self, series: np.ndarray, band_hz: tuple[float, float], *, filtered: bool
    ) -> np.ndarray:
        """Return the variance (k,) of white noise that has the power of a series (n, k) within a band.

        With ``filtered``, of the white noise before the low-pass of the ingest. Welch's windows keep what is slower
        from leaking upward.
        """
        window = min(len(series), round(self.options["window_s"] * self.rate_hz))
        frequency, power = welch(series, self.rate_hz, nperseg=window, axis=0, detrend="linear")
        inside = (frequency > band_hz[0]) & (frequency < band_hz[1])
        power = power[inside]
        if filtered:
            power = power / self.response(frequency[inside])[:, None]
        return np.asarray(power.mean(axis=0) * self.rate_hz / 2)


@dataclass(frozen=True)
class NoiseModel:
    """Noise of the markers as the neutral trial shows it, and how it reaches a filtered recording.

    ``marker_sd`` (3,) [m] per marker is the SD of its white noise before the low-pass, at the rate of the common clock;
    ``colour`` (2, bands) is the power of the noise in each band relative to the white noise, 1 or more, of the pelvis
    and of the interface markers.
    """

    bands: Bands
    marker_sd: dict[str, np.ndarray]
    colour: np.ndarray

    @classmethod
    def measure(cls, neutral: Path, ingest: IngestSettings, options: DiagnosisNoiseSettings) -> NoiseModel:
        """Return the model of the neutral trial in folder ``neutral`` (results/trials/<SUBJECT>/neutral).

        ``ingest`` and ``options`` are the slices ``ingest`` and ``diagnosis.noise`` of the configuration.
        """
        bands, markers = Bands.from_settings(ingest, options), neutral / "markers.parquet"
        _check_length(markers, bands)
        return cls(bands, marker_noise(markers, bands), noise_colour(markers, bands))

    def filtered(self, names: tuple[str, ...], samples: int, rng: np.random.Generator) -> np.ndarray:
        """Draw noise (n, m, 3) [m] of markers of one body as the low-pass of the ingest leaves it."""
        return self.bands.low_pass.apply(self.unfiltered(names, samples, rng))

    def unfiltered(self, names: tuple[str, ...], samples: int, rng: np.random.Generator) -> np.ndarray:
        """Draw noise (n, m, 3) [m] of markers of one body as the cameras make it."""
        colour = self.colour[1 if set(names) <= set(INTERFACE_MARKERS) else 0]
        white = rng.standard_normal((samples, len(names), 3)) * np.array([self.marker_sd[m] for m in names])
        if (colour > 1).any():
            frequency = np.arange(samples) * self.bands.rate_hz / (2 * samples)
            louder = np.sqrt(colour[self.bands.band_of(frequency)])
            white = idct(dct(white, axis=0, norm="ortho") * louder[:, None, None], axis=0, norm="ortho")
        return np.asarray(white)


def _check_rate(bands: Bands) -> None:
    """Refuse a common clock that is too slow for the cut-off."""
    rate, cutoff, least = bands.rate_hz, bands.low_pass.cutoff_hz, bands.options["samples_per_period"]
    if rate < least * cutoff:
        raise InputError(
            "the configuration",
            "key ingest.rate_hz",
            f"a common clock of {rate:g} Hz for a cut-off of {cutoff:g} Hz (ingest.cutoff_hz)",
            f"at least {least:g} samples in a period of the cut-off",
            f"Raise ingest.rate_hz to {cutoff * least:g} Hz, or lower the cut-off.",
            "noise_rate",
        )


def _check_cutoff(bands: Bands) -> None:
    """Refuse a cut-off below which hardly more than the motion itself is left."""
    cutoff, least = bands.low_pass.cutoff_hz, bands.options["least_highest_hz"]
    if bands.edges_hz[-1] < least:
        raise InputError(
            "the configuration",
            "key ingest.cutoff_hz",
            f"{cutoff:g} Hz, so that residuals count up to {bands.edges_hz[-1]:.3g} Hz alone",
            f"at least {least * bands.options['cutoff_margin']:g} Hz, so that they count up to {least:g} Hz",
            "Raise ingest.cutoff_hz.",
            "noise_cutoff",
        )


def _check_length(markers: Path, bands: Bands) -> None:
    """Refuse a neutral trial that is too short to measure the noise of its markers."""
    duration, least = pq.read_metadata(markers).num_rows / bands.rate_hz, bands.options["least_freedom"]
    if bands.freedom(duration) < least:
        low, high = bands.standing_hz
        raise InputError(
            markers,
            "",
            f"{duration:.1f} s of quiet standing, whose noise is read between {low:g} and {high:.3g} Hz at a cut-off of"
            f" {bands.low_pass.cutoff_hz:g} Hz (ingest.cutoff_hz)",
            f"at least {least / bands.freedom(1.0):.1f} s",
            "Record neutral for longer, or raise ingest.cutoff_hz.",
            "noise_neutral",
        )


def marker_noise(markers: Path, bands: Bands) -> dict[str, np.ndarray]:
    """Return the SD (3,) [m] per marker of the white noise that quiet standing shows in ``bands.standing_hz``.

    Below that band the person sways. ``markers`` is markers.parquet of the neutral trial. Some seconds of a band tell a
    variance to a fifth, so each is shrunk towards the mean of all, the more, the less they differ beyond that.
    """
    table = pq.read_table(markers)
    names = (*PELVIS_MARKERS, *INTERFACE_MARKERS)
    smallest = bands.options["smallest_m"]
    variance = np.empty((len(names), 3))
    for i, name in enumerate(names):
        path = signals.bridged(np.column_stack([table[f"{name}_{c}"].to_numpy() for c in "xyz"]))
        seen = bands.white_variance(path, bands.standing_hz, filtered=True)
        variance[i] = np.maximum(seen, smallest**2)
    known = drawn_together(variance, bands.freedom(len(table) / bands.rate_hz))
    return {name: np.sqrt(row) for name, row in zip(names, known, strict=True)}


def noise_colour(markers: Path, bands: Bands) -> np.ndarray:
    """Return the power of the noise in each whitening band relative to `marker_noise`'s, 1 or more: (2, bands).

    Of the pelvis and of the interface markers. Markers on a standing body keep their distances, whatever it does; only
    their noise changes them. White noise and up to two components of slow noise are fitted to the spectra by Whittle's
    likelihood, because some seconds hold few periods of the slow bands. A component has constant power below a corner;
    above, it falls with the square of the frequency (an Ornstein-Uhlenbeck process) or far faster (behind a filter). It
    is accepted only where chance would hardly make it. Both bodies have the same noise unless they show otherwise: the
    one distance on the interface tells little. ``markers`` is markers.parquet of the neutral trial.
    """
    table = pq.read_table(markers)
    places = {m: np.column_stack([table[f"{m}_{c}"].to_numpy() for c in "xyz"]) for m in MARKERS}
    lengths = distances(stacked(places))
    frequency = np.arange(len(lengths)) * bands.rate_hz / (2 * len(lengths))
    search = _SlowSearch(bands, frequency)
    powers = [search.power(lengths[:, body]) for body in (slice(-1), slice(-1, None))]
    together, apart = search.fit(np.hstack(powers)), [search.fit(power) for power in powers]
    more = max(sum(len(noise.components) for noise in apart) - len(together.components), 1)
    differ = together.deviance - sum(noise.deviance for noise in apart) > more * search.sure
    return np.array([noise.colour(bands) for noise in (apart if differ else [together] * 2)])


# Power relative to the white noise, corner [Hz] and exponent of a component of slow noise
_Component = tuple[float, float, int]


@dataclass(frozen=True)
class _SlowNoise:
    """Fit of slow noise beside white noise: its components, none where chance would make as much, and the ``deviance``.

    That is minus twice Whittle's log-likelihood, but for a constant.
    """

    deviance: float
    components: tuple[_Component, ...]

    def colour(self, bands: Bands) -> np.ndarray:
        """Return the power in each band relative to that where the white noise is measured, 1 or more."""

        def mean(low_hz: float, high_hz: float) -> float:
            return float(_shape(self.components, np.linspace(low_hz, high_hz)).mean())

        of_bands = [mean(low, high) for low, high in pairwise(bands.edges_hz)]
        return np.maximum(np.array(of_bands) / mean(*bands.standing_hz), 1.0)


def _shape(components: Sequence[_Component], frequency: np.ndarray) -> np.ndarray:
    """Return the power (f,) of white noise and components of slow noise, relative to the white noise."""
    shape = np.ones_like(frequency)
    for loud, corner, falls in components:
        shape += loud / (1 + (frequency / corner) ** falls)
    return shape


@dataclass(frozen=True)
class _SlowSearch:
    """Search for slow noise in series whose cosine coefficients are at ``frequency`` [Hz]."""

    bands: Bands
    frequency: np.ndarray

    @property
    def sure(self) -> float:
        """Reduction of the deviance from which a component is accepted."""
        return float(chi2.ppf(self.bands.options["slow_certainty"], _COMPONENT_FREEDOM))

    @property
    def heard(self) -> np.ndarray:
        """Return the frequencies that show the noise."""
        return (self.frequency > 0) & (self.frequency < self.bands.standing_hz[1])

    def power(self, series: np.ndarray) -> np.ndarray:
        """Return the power (f, k) of independent combinations of series (n, j) that tell something, where `heard`.

        Two distances that share a marker share its noise. Markers in one plane make a combination that noise hardly
        moves, a marker that is never seen none at all.
        """
        (low, high), options = self.bands.standing_hz, self.bands.options
        seen = signals.bridged(series[:, np.isfinite(series).any(axis=0)])
        coefficients = dct(seen - seen.mean(axis=0), axis=0, norm="ortho")
        fast = coefficients[(self.frequency > low) & (self.frequency < high)]
        variance, combinations = np.linalg.eigh(fast.T @ fast / len(fast))
        least = max(options["least_telling"] * variance.max(initial=0.0), options["smallest_m"] ** 2)
        return np.asarray((coefficients[self.heard] @ combinations[:, variance > least]) ** 2)

    def fit(self, power: np.ndarray) -> _SlowNoise:
        """Return the likeliest slow noise of spectra (f, k) that each have a level of their own."""
        every = list(product(_SLOW_POWERS, _SLOW_CORNERS_HZ, _SLOW_FALLS))
        frequency = self.frequency[self.heard]
        passed = self.bands.response(frequency)

        def deviance(components: Sequence[_Component]) -> float:
            shape = (_shape(components, frequency) * passed)[:, None]
            return float(len(shape) * np.log(np.mean(power / shape, axis=0)).sum()) + float(
                power.shape[1] * np.log(shape).sum()
            )

        def likeliest(others: tuple[_Component, ...]) -> _SlowNoise:
            return min(
                (_SlowNoise(deviance((*others, p)), (*others, p)) for p in every), key=lambda n: n.deviance
            )

        best = _SlowNoise(deviance(()), ())
        while len(best.components) < _MOST_COMPONENTS:
            more = likeliest(best.components)
            # what stood alone made up for what has come beside it
            for _ in best.components:
                more = likeliest(more.components[1:])
            if best.deviance - more.deviance < self.sure:
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
    """Return the SD (2, 6), by joint, of a controller's set-point beside the balance [m, rad] and of initial rates.

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
    pull = np.hypot(damping * speed, inertia * acceleration)
    # a joint that no spring holds has no set-point
    beside = np.divide(pull, stiffness, out=np.zeros_like(pull), where=stiffness > 0)
    return np.array([beside, np.hypot(speed, first)])


def robot_noise(neutral: Path, trial: Path, bands: Bands) -> np.ndarray:
    """Return the SD (6,) of the white noise of the robot's log [m, rad], zero without a log.

    As quiet standing shows it in ``bands.log_standing_hz``, or the trial itself in the quieter of ``log_moving_hz``,
    where hardly anybody moves, if that is more than chance would make of it: wheels that turn are not read as well as
    wheels that stand. Both are robot.parquet.
    """
    variance, freedom = np.zeros(len(ROBOT_JOINTS)), 0.0
    for path, own_bands in ((neutral, (bands.log_standing_hz,)), (trial, bands.log_moving_hz)):
        if not own_bands:
            continue
        table = pq.read_table(path)
        columns = np.column_stack([table[name].to_numpy() for name in ROBOT_JOINTS])
        if np.isfinite(columns).all(axis=1).mean() < 0.5:
            continue
        path_at = signals.bridged(columns)
        own = np.min([bands.white_variance(path_at, band, filtered=False) for band in own_bands], axis=0)
        own_freedom = 2 * len(table) / bands.rate_hz * (own_bands[0][1] - own_bands[0][0])
        chance = (
            f_distribution.ppf(bands.options["louder_certainty"], own_freedom, freedom) if freedom else 0.0
        )
        variance = np.where(own > chance * variance, own, variance)
        freedom = own_freedom
    return np.sqrt(variance)


def drawn_together(variance: np.ndarray, freedom: float) -> np.ndarray:
    """Return variances, each estimated with ``freedom`` degrees of freedom, shrunk to their common mean.

    An array of any shape (James & Stein 1961). In logarithms, whose sampling variance 2 / freedom is known. What the
    estimates scatter beyond it is real.
    """
    log = np.log(variance)
    chance = 2 / freedom
    # the mean of a logarithm is a little below the logarithm of the mean
    mean = log.mean() + chance / 2
    real = max(float(log.var(ddof=1)) - chance, 0.0)
    return np.asarray(np.exp(mean + real / (real + chance) * (log - log.mean())))
