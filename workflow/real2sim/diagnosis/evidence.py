"""What a trial says about a simulation of it: residuals of markers and robot log, in units of their own noise.

A residual of a replay has two sources of noise: that of the interface markers, and that of the pelvis markers, which
moves the replayed pelvis and reaches the interface through strap and robot. The second is slow and common to markers
and robot log. Both are simulated from the noise of the markers, and the residuals are whitened by what comes out, per
band of frequency and over all channels at once. After that a sum of squares is a likelihood.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import pairwise, product
from pathlib import Path

import mujoco
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from scipy.fft import dct, idct
from scipy.linalg import block_diag
from scipy.signal import welch
from scipy.spatial.transform import Rotation
from scipy.stats import chi2
from scipy.stats import f as f_distribution

from real2sim import signals
from real2sim.artefacts import read_json
from real2sim.coupling.chains import Context, Elsewhere
from real2sim.coupling.drive import PelvisDrive, pelvis_drive
from real2sim.coupling.effects import EFFECTS, Effect, EffectParameter, Placed
from real2sim.coupling.mechanisms import Scales, Where
from real2sim.coupling.plant import (
    ROBOT_JOINTS,
    STRAP_JOINTS,
    JointLimits,
    impedances,
    load_robot,
)
from real2sim.coupling.superset import EffectReplay, InputBasis
from real2sim.diagnosis.jumps import (
    EDGE_S,
    MARKER_FLOOR_M,
    SPIKE_RESIDUAL_SD,
    around,
    spikes,
    without_ghosts,
)
from real2sim.diagnosis.skin import Skin, skin_of
from real2sim.diagnosis.start import at_first, moved_to_first
from real2sim.geometry import (
    AXES,
    INTERFACE_MARKERS,
    PELVIS_MARKERS,
    interface_frame,
    mean_rotation,
    pelvis_frame,
    rotation_matrix,
)
from real2sim.identification.cost import CostScales, TrialCost
from real2sim.identification.trial import Trial, load_limits, load_trial, replay_inputs
from real2sim.quality.markers import MARKERS, distances, stacked

# What a channel of the robot is never trusted beyond: base x y [m], yaw [rad], lift [m], roll and pitch [rad]. The
# plant's own error at its time step is smaller (benchmarks/plant.py), and encoders have play that standing hides.
ROBOT_FLOOR = np.array([5e-5, 5e-5, 1e-4, 5e-5, 1e-4, 1e-4])
# How late a log's stamps are beside what they say, SD [s], and how well the size of wheels is known, SD: one number a
# trial each (systematic errors of odometry: Borenstein & Feng, IEEE Trans. Robot. Autom. 12 (1996) 869)
LOG_LATENCY_S = 0.001
ODOMETRY_SCALE_SD = 0.005
# Above this the log's own motion is lost in its noise
LOG_CUTOFF_HZ = 5.0
# The pelvis path is never smoothed below this; noise is never taken as smaller than that
LOWEST_CUTOFF_HZ = 3.0
# Most parts of a time step while a cause is only searched for
COARSE = 2
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
# A strap that rests elsewhere along one axis, and a robot that starts elsewhere
_RESTS = [
    (effect, where)
    for effect in EFFECTS
    if effect.name == "preload" and not effect.form
    for where in effect.places()
]
_START = Effect(
    "start",
    "robot",
    "the robot stands elsewhere at the start than it was seen",
    tuple(EffectParameter(f"start_{axis}", "m|rad", -1.0, 1.0, (0.0,)) for axis in AXES),
    "start",
    "",
    scope="whole",
    sighting=Elsewhere(),
)
# How far the start is moved to learn what that does [m, rad]
_START_STEP = 1e-3
# Where the robot's controller holds: at the start pose (contract), or where that balances what pulls at the start
START_POSE, BALANCE = "start pose", "balance"
# Band edges [Hz] within which the noise is taken as equal
BANDS_HZ = (0.0, 0.15, 0.3, 0.6, 1.2, 2.4, 4.8, 10.0)


def robot_motion(path: Path, interface: np.ndarray, start: int) -> np.ndarray | None:
    """Logged robot joints (n, 6) relative to their mean over the first ``start`` samples, the base in world axes.

    The heading of the odometry is laid on that of the interface markers (n, 2, 3) while the person stands: later on the
    markers may drift, and the log must not follow. None where the trial has no log, or one that knows less than half.
    """
    table = pq.read_table(path)
    columns = np.column_stack([table[name].to_numpy() for name in ROBOT_JOINTS])
    known = np.isfinite(columns).all(axis=1)
    across = interface[:start, 0] - interface[:start, 1]
    turn = np.arctan2(-across[:, 0], across[:, 1]) - columns[:start, 2]
    if known.mean() < 0.5 or not np.isfinite(turn).any():
        return None
    turn = float(np.angle(np.nanmean(np.exp(1j * turn))))
    x, y = columns[:, 0].copy(), columns[:, 1].copy()
    columns[:, 0] = np.cos(turn) * x - np.sin(turn) * y
    columns[:, 1] = np.sin(turn) * x + np.cos(turn) * y
    columns[known, 2] = np.unwrap(columns[known, 2])
    return columns - np.nanmean(columns[:start], axis=0)


@dataclass
class Evidence:
    """A trial, its replay with room for effects, and the noise that its residuals are measured in.

    ``robot`` is what `robot_motion` returns; ``context`` and ``scales`` go to the effects; ``whiteners`` holds per
    band (w, c, c) matrices for c channels and ``noise`` (draws, n, c) the residuals behind them; ``cost`` is J of the
    paper; ``coordinates`` (n, 6) are measured. ``marker_sd``, ``colour`` and ``robot_sd`` are the noise of markers and
    robot log (`marker_noise`, `noise_colour`, `robot_noise`), ``rest_sd`` that of the rest pose and ``rests`` (6, n, c)
    what it does (`rest_uncertainty`); ``starts`` (6, n, c) is what a start pose does that is 1 m or rad off.
    ``let_go`` (6, 6) is what one SD of each robot joint at the start does to the start pose (`moved_to_first`)
    and ``skin`` what the pelvis' markers say of each other. ``jumped_s`` is for how long [s] pelvis markers jumped.
    ``hold_sd`` (2, 6) is how far beside the balance a robot at rest may hold and how fast it may move at the start, and
    ``holds`` what either does (`hold_uncertainty`).
    ``log_offset_sd_s`` is how well the log's clock is known; ``unknowns`` (k, n_r) are directions of unit length among
    the whitened residuals, and ``discounts`` (k,) the share of each that is put down to what nobody knows (`_unknown`).
    ``settled``: the robot's controller holds where it balances the strap at the start, see `EffectReplay`;
    ``held_out``: not the trial that is fitted; ``threads`` step its simulations, see `Replay`. What input chains and
    noise make of the pelvis' path is kept for the replays to come: ``bases``, ``draws`` as paths, ``commands`` of a
    time step; so are ``start_joints``.
    """

    trial: Trial
    robot: np.ndarray | None
    context: Context
    scales: Scales
    cost: TrialCost
    settings: dict
    robot_file: Path
    limits: JointLimits | None
    drives: dict[float, PelvisDrive]
    coordinates: np.ndarray
    marker_sd: dict[str, np.ndarray]
    colour: np.ndarray
    robot_sd: np.ndarray
    rest_sd: np.ndarray
    hold_sd: np.ndarray
    let_go: np.ndarray
    log_offset_sd_s: float
    pelvis_cutoff_hz: float
    skin: Skin | None = None
    jumped_s: dict[str, float] = field(default_factory=dict)
    whiteners: np.ndarray | None = None
    noise: np.ndarray | None = None
    start_joints: np.ndarray | None = None
    rests: np.ndarray | None = None
    starts: np.ndarray | None = None
    holds: np.ndarray | None = None
    unknowns: np.ndarray | None = None
    discounts: np.ndarray | None = None
    settled: bool = False
    held_out: bool = False
    threads: int = 1
    bases: dict[tuple[str, float, bytes], InputBasis] = field(default_factory=dict)
    draws: dict[tuple[int, int], tuple[np.ndarray, np.ndarray, np.ndarray]] = field(default_factory=dict)
    commands: dict[tuple[int, int, float], np.ndarray] = field(default_factory=dict)

    @property
    def channels(self) -> int:
        """Six of the markers, and six of the robot where it was logged."""
        return 6 if self.robot is None else 12

    @property
    def samples(self) -> int:
        """Number of whitened residuals."""
        return self._last(len(self.trial.time_s)) * self.channels

    def replay(self, effects: list, nsim: int, *, coarse: bool = False) -> EffectReplay:
        """A replay of this trial with effects, at a fraction of the time step where one of them needs it.

        ``coarse``: at half of the time step at least, which is less exact and costs less.
        """
        trial = self.trial
        parts = max([1, *(e.effect.substeps for e in effects)])
        h = float(self.settings["plant"]["timestep_s"]) / (min(parts, COARSE) if coarse else parts)
        if h not in self.drives:
            rotation, position = trial.pelvis_rotation, trial.pelvis_position
            self.drives[h] = pelvis_drive(trial.time_s, rotation, position, h)
        settings = self.settings | {"plant": self.settings["plant"] | {"timestep_s": h}}
        steps = trial.time_s[0] + h * np.arange(len(self.drives[h].position))
        replay = EffectReplay(
            effects=effects,
            context=replace(self.context, step_time_s=steps, held_out=self.held_out),
            scales=self.scales,
            **replay_inputs(trial, self.limits, self.robot_file, settings),
            nsim=nsim,
            drive=self.drives[h],
            bases=self.bases,
            settled=self.settled,
            start_joints=self.start_joints,
            threads=self.threads,
        )
        self.start_joints = replay.start_joints
        return replay

    def raw(self, paths: np.ndarray, joints: np.ndarray) -> np.ndarray:
        """Residuals (m, n, c) simulated minus measured, gaps bridged by straight lines."""
        error = paths.reshape(*paths.shape[:2], 6) - self.trial.interface.reshape(-1, 6)
        if self.robot is not None:
            error = np.concatenate([error, self._from_start(joints) - self.robot], axis=2)
        return self._without_gaps(error)

    def _from_start(self, joints: np.ndarray) -> np.ndarray:
        """Robot joints (m, n, c) relative to their mean while the person stands, as the log is taken."""
        return joints - joints[:, : self.context.start].mean(axis=1, keepdims=True)

    def _without_gaps(self, error: np.ndarray) -> np.ndarray:
        """Residuals (m, n, c) with straight lines where pelvis or channel is unknown, and a while after a gap."""
        known = self._measured
        sample = np.arange(error.shape[1])
        for c in np.flatnonzero(~known.all(axis=0)):
            good = known[:, c]
            for row in error:
                row[~good, c] = np.interp(sample[~good], sample[good], row[good, c])
        return error

    @cached_property
    def _measured(self) -> np.ndarray:
        """Where each channel counts, (n, c)."""
        known = np.isfinite(self.trial.interface.reshape(-1, 6))
        if self.robot is not None:
            known = np.hstack([known, np.isfinite(self.robot)])
        return known & self.trial.usable[:, None]

    def spectrum(self, error: np.ndarray) -> np.ndarray:
        """Cosine coefficients (m, f, c) of residuals (m, n, c) up to the last band's edge."""
        n = error.shape[1]
        return dct(error, axis=1, norm="ortho")[:, : self._last(n)]

    def _last(self, n: int) -> int:
        duration = n * float(self.trial.time_s[1] - self.trial.time_s[0])
        return min(n, int(2 * duration * BANDS_HZ[-1]))

    def band_of(self, n: int) -> np.ndarray:
        """Band index of each cosine coefficient of n samples."""
        duration = n * float(self.trial.time_s[1] - self.trial.time_s[0])
        frequency = np.arange(self._last(n)) / (2 * duration)
        return np.searchsorted(BANDS_HZ[1:-1], frequency, side="right")

    def j(self, paths: np.ndarray) -> np.ndarray:
        """J of the paper (m,) of simulated marker paths (m, n, 2, 3)."""
        return np.asarray(self.cost(paths).total)

    def whitened(self, paths: np.ndarray, joints: np.ndarray) -> np.ndarray:
        """Residuals (m, n_r) whose squares sum to chi-squared; NaN where a simulation failed."""
        return self.whiten(self.raw(paths, joints))

    def whiten(self, error: np.ndarray) -> np.ndarray:
        """As `whitened`, from residuals (m, n, c)."""
        assert self.unknowns is not None
        assert self.discounts is not None
        out = self._in_noise(error)
        return out - (out @ self.unknowns.T * self.discounts) @ self.unknowns

    def _in_noise(self, error: np.ndarray) -> np.ndarray:
        """Residuals (m, n_r) in units of what noise of markers and log leaves of them, from residuals (m, n, c)."""
        assert self.whiteners is not None
        coefficients = self.spectrum(error)
        band = self.band_of(error.shape[1])
        out = np.empty_like(coefficients)
        for b, matrix in enumerate(self.whiteners):
            out[:, band == b] = coefficients[:, band == b] @ matrix.T
        return out.reshape(len(error), -1)

    def standing(self, error: np.ndarray) -> np.ndarray:
        """Mean square (m,) of residuals (m, n, c) while the person stands, in units of what noise leaves there."""
        assert self.noise is not None
        first = slice(None, self.context.start)
        usual = np.mean(self.noise[:, first] ** 2, axis=(0, 1)) + self._floor**2
        return np.asarray(np.mean(error[:, first] ** 2 / usual, axis=(1, 2)))

    def mark_spikes(self, paths: np.ndarray) -> bool:
        """Mark where markers jump out of what simulated paths (n, 2, 3) leave of them; whether that is anything new.

        A motion hides jumps that its simulation does not make.
        """
        rate = 1 / float(self.trial.time_s[1] - self.trial.time_s[0])
        found = spikes(self.trial.interface - paths, rate, SPIKE_RESIDUAL_SD) | self.context.spikes
        new = bool((found & ~self.context.spikes).any())
        self.context = replace(self.context, spikes=found)
        return new

    def set_noise(self, parameters: np.ndarray, draws: int, seed: int) -> None:
        """Whiten by noise of the markers simulated through the plant with plain strap ``parameters`` (12,)."""
        n = len(self.trial.time_s)
        self.rests, self.starts, self.holds = self._elsewhere(parameters)
        error, unknown = self._noise(parameters, draws, seed)
        self.noise = error + unknown
        coefficients = self.spectrum(error)
        band = self.band_of(n)
        whiteners = []
        for b in range(len(BANDS_HZ) - 1):
            rows = coefficients[:, band == b].reshape(-1, self.channels)
            covariance = rows.T @ rows / max(len(rows), 1) + np.diag(self._floor**2)
            whiteners.append(np.linalg.inv(np.linalg.cholesky(covariance)))
        self.whiteners = np.array(whiteners)
        # noise and unknowns together are white after this: the inverse root of 1 + X' X
        _, sizes, self.unknowns = np.linalg.svd(
            self._in_noise(self._unknown(seed, draws)), full_matrices=False
        )
        self.discounts = 1 - 1 / np.sqrt(1 + sizes**2)

    @property
    def _floor(self) -> np.ndarray:
        """What each channel is never trusted beyond, (c,)."""
        return np.concatenate([np.full(6, MARKER_FLOOR_M), ROBOT_FLOOR])[: self.channels]

    def noise_through(
        self,
        effects: Sequence[Placed],
        parameters: np.ndarray,
        x: Sequence[np.ndarray],
        draws: int,
        seed: int,
    ) -> np.ndarray:
        """Chi-squared (draws,) that noise alone leaves where effects with searched numbers x (p,) each are the truth.

        Friction, stops and a robot that yields pass noise of the pelvis on otherwise than the plain plant.
        """
        error, unknown = self._noise(parameters, draws, seed, effects, x)
        return np.sum(self.whiten(error + unknown) ** 2, axis=1)

    def _noise(
        self,
        parameters: np.ndarray,
        draws: int,
        seed: int,
        effects: Sequence[Placed] = (),
        x: Sequence[np.ndarray] = (),
    ) -> tuple[np.ndarray, np.ndarray]:
        """Residuals (draws, n, c) of a perfect model: noise of markers, replayed pelvis and log; what nobody knows."""
        replay = self.replay(list(effects), draws + 1, coarse=True)
        self._shake(replay, draws, seed)
        markers = np.array([self._draw(seed, i)[2] for i in range(draws)])
        rng = np.random.default_rng([seed, draws])
        logged = self.robot_sd * rng.standard_normal((draws, len(self.trial.time_s), len(ROBOT_FLOOR)))
        error = self._apart(replay, parameters, draws, markers, self._from_start(logged), x)
        unknown = self._unknown(seed, draws)
        drawn = np.tensordot(rng.standard_normal((draws, len(unknown))), unknown, axes=1)
        return self._without_gaps(error), drawn

    def _unknown(self, seed: int, draws: int) -> np.ndarray:
        """What one SD of each constant that nobody knows does to the residuals (k, n, c).

        Where strap rests, robot starts and controller holds, when the log was written and how far the wheels roll: each
        is one number for the whole trial and no noise that comes and goes.
        """
        assert self.rests is not None
        assert self.starts is not None
        assert self.holds is not None
        markers = np.array([self._draw(seed, i)[2] for i in range(draws)])
        misjudged = self._misjudged(markers)
        covariance = misjudged.T @ misjudged / draws + self.let_go.T @ self.let_go
        values, axes = np.linalg.eigh(covariance)
        roots = np.sqrt(np.maximum(values, 0.0))[:, None] * axes.T
        started = np.tensordot(roots, self.starts, axes=1)
        parts = [self.rests, started, self.holds]
        if self.robot is not None:
            parts.append(self._log_unknown())
        return self._without_gaps(np.concatenate(parts))

    def _log_unknown(self) -> np.ndarray:
        """What a late log and wheels of another size, by one SD each, do to the residuals (3, n, c)."""
        assert self.robot is not None
        h = float(self.trial.time_s[1] - self.trial.time_s[0])
        path = signals.lowpass(signals.bridged(self.robot), 1 / h, LOG_CUTOFF_HZ, 4)
        out = np.zeros((3, len(path), self.channels))
        out[0, :, 6:] = np.hypot(self.log_offset_sd_s, LOG_LATENCY_S) * np.gradient(path, h, axis=0)
        out[1, :, 6:8] = ODOMETRY_SCALE_SD * path[:, :2]
        out[2, :, 8] = ODOMETRY_SCALE_SD * path[:, 2]
        return out

    def _misjudged(self, markers: np.ndarray) -> np.ndarray:
        """How far noise (draws, n, 2, 3) [m] of the markers moves and turns the start pose: (draws, 6) [m, rad]."""
        left, right = np.moveaxis(markers[:, : self.context.start].mean(axis=1), 1, 0)
        bar = np.diff(np.nanmean(self.trial.interface[: self.context.start], axis=0)[::-1], axis=0)[0]
        return np.hstack([(left + right) / 2, np.cross(bar, left - right) / (bar @ bar)])

    def _elsewhere(self, parameters: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """What a strap that rests, a robot that starts and a controller that holds elsewhere do to the residuals.

        (6, n, c) for a rest pose one SD off (`rest_uncertainty`), by axis; per metre and radian of a start pose; and
        for a hold one SD off (`hold_uncertainty`), by robot joint, none for a robot that is let go.
        """
        effects = [Placed(effect, where, self.scales) for effect, where in _RESTS]
        effects.append(Placed(_START, Where((), 0, "", _START.name), self.scales))
        off = block_diag(*map(np.diag, self.hold_sd)) if self.settled else np.empty((0, 12))
        m = 1 + 2 * 6 + len(off)
        x = [np.zeros((m, len(placed.effect.parameters))) for placed in effects]
        for i, placed in enumerate(effects[:6]):
            x[i][1 + i] = self.rest_sd[placed.where.axes[0]] / placed.values(np.ones((1, 1)))
        x[6][7:13] = _START_STEP * np.eye(6)
        replay = self.replay(effects, m, coarse=True)
        replay.hold_beside(*np.hsplit(np.concatenate([np.zeros((13, 12)), off]), 2))
        paths, joints = replay.run_effects(np.tile(parameters, (m, 1)), x)
        out = paths.reshape(m, -1, 6)
        if self.robot is not None:
            out = np.concatenate([out, self._from_start(joints)], axis=2)
        # a pose that MuJoCo gives up on is none that was
        moved = np.nan_to_num(out[1:] - out[:1])
        return moved[:6], moved[6:12] / _START_STEP, moved[12:]

    def shaken(self, draws: int, seed: int) -> Callable[[np.ndarray], np.ndarray]:
        """What noise of the replayed pelvis does to the residuals (draws, n, c), as a function of parameters (12,)."""
        replay = self.replay([], draws + 1)
        self._shake(replay, draws, seed)
        return lambda parameters: self._without_gaps(self._apart(replay, parameters, draws, 0.0, 0.0))

    def _filtered_noise(
        self, names: tuple[str, ...], colour: np.ndarray, cutoff_hz: float, rng: np.random.Generator
    ) -> np.ndarray:
        """Noise (n, m, 3) [m] of markers as the filter leaves it, ``colour`` (bands,) as of `noise_colour`."""
        settings, n = self.settings["ingest"], len(self.trial.time_s)
        white = rng.standard_normal((n, len(names), 3)) * np.array([self.marker_sd[m] for m in names])
        if (colour > 1).any():
            frequency = np.arange(n) * settings["rate_hz"] / (2 * n)
            louder = np.sqrt(colour[np.searchsorted(BANDS_HZ[1:-1], frequency, side="right")])
            white = idct(dct(white, axis=0, norm="ortho") * louder[:, None, None], axis=0, norm="ortho")
        rate, own = settings["rate_hz"], settings["cutoff_hz"]
        if cutoff_hz < own:
            return _from_standing(white, rate, cutoff_hz, self.context.start)
        return signals.lowpass(white.reshape(n, -1), rate, own, settings["filter_order"]).reshape(white.shape)

    def _draw(self, seed: int, i: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Pelvis path (n, 3, 3), (n, 3) with other noise and noise (n, 2, 3) of the interface markers [m]: draw i."""
        if (seed, i) not in self.draws:
            trial, rng = self.trial, np.random.default_rng([seed, i])
            clean = _rigid_markers(trial)
            r_clean, p_clean = pelvis_frame(*clean)
            noise = self._filtered_noise(PELVIS_MARKERS, self.colour[0], self.pelvis_cutoff_hz, rng)
            r, p = pelvis_frame(*(clean + np.moveaxis(noise, 1, 0)))
            turn = np.einsum("nij,nkj->nik", r, r_clean)
            rotation, position = turn @ trial.pelvis_rotation, trial.pelvis_position + p - p_clean
            own = self._filtered_noise(
                INTERFACE_MARKERS, self.colour[1], self.settings["ingest"]["cutoff_hz"], rng
            )
            self.draws[seed, i] = rotation, position, own
        return self.draws[seed, i]

    def _shake(self, replay: EffectReplay, draws: int, seed: int) -> None:
        """Give all simulations of a replay but the first a pelvis that was measured with other noise."""
        h = replay.model.opt.timestep
        for i in range(draws):
            key = seed, i, h
            if key not in self.commands:
                self.commands[key] = replay.command_for(*self._draw(seed, i)[:2])
            replay.set_command(i + 1, self.commands[key])

    def _apart(
        self,
        replay: EffectReplay,
        parameters: np.ndarray,
        draws: int,
        markers: np.ndarray | float,
        logged: np.ndarray | float,
        x: Sequence[np.ndarray] = (),
    ) -> np.ndarray:
        """Residuals (draws, n, c) of the shaken simulations against the first, less noise of the channels themselves.

        That is ``markers`` (draws, n, 2, 3) [m], and ``logged`` (draws, n, 6) of the robot's log [m, rad].
        """
        alike = [np.tile(part, (draws + 1, 1)) for part in (parameters, *x)]
        paths, joints = replay.run_effects(alike[0], alike[1:])
        error = (paths[1:] - paths[:1] - markers).reshape(draws, -1, 6)
        if self.robot is not None:
            error = np.concatenate([error, self._from_start(joints[1:] - joints[:1]) - logged], axis=2)
        return error


def _from_standing(values: np.ndarray, rate_hz: float, cutoff_hz: float, start: int) -> np.ndarray:
    """Low-passed series (n, ...) of somebody who stood still before it as on average in its first samples.

    A filter that knows no better takes the first sample as it is, with all its noise, and the simulation starts there:
    with markers of 3.4 mm the strap was 8 mm off at the start, and let the robot go there and come back.
    """
    before = np.repeat(values[:start].mean(axis=0)[None], round(rate_hz), axis=0)
    flat = np.concatenate([before, values]).reshape(len(before) + len(values), -1)
    return signals.lowpass(flat, rate_hz, cutoff_hz, 4)[len(before) :].reshape(values.shape)


def smoothed_pelvis(
    trial: Trial, sd: dict[str, np.ndarray], rate_hz: float, cutoff_hz: float, start: int
) -> tuple[Trial, float]:
    """The trial with its pelvis path low-passed to what stands out of the noise, and the cut-off [Hz].

    Noise of the replayed pelvis shakes loose what friction holds: a law with memory sees another motion than the
    person made. Above the cut-off none of the six pelvis coordinates has three times the power of its noise. The person
    stands still in the first ``start`` samples.
    """
    position, vectors = signals.bridged(trial.pelvis_position), _vectors(trial.pelvis_rotation)
    rigid = _rigid_markers(trial)
    rng = np.random.default_rng(0)
    white = np.stack([rng.standard_normal(rigid.shape[1:]) * sd[name] for name in PELVIS_MARKERS])
    clean, shaken = pelvis_frame(*rigid), pelvis_frame(*(rigid + white))
    turn = np.einsum("nji,njk->nik", clean[0], shaken[0])
    known = np.isfinite(turn).all(axis=(1, 2))
    noise = np.hstack([(shaken[1] - clean[1])[known], Rotation.from_matrix(turn[known]).as_rotvec()])
    power = dct(np.hstack([position, vectors]), axis=0, norm="ortho") ** 2
    frequency = np.arange(len(power)) * rate_hz / (2 * len(power))
    width = max(6, int(2 * len(power) / rate_hz))  # one hertz
    mean = np.stack([np.convolve(row, np.ones(width) / width, "same") for row in power.T], axis=1)
    loud = (mean > 3 * noise.var(axis=0)).any(axis=1) & (frequency < cutoff_hz)
    last = float(frequency[loud].max()) if loud.any() else LOWEST_CUTOFF_HZ
    chosen = float(np.clip(1.25 * last, LOWEST_CUTOFF_HZ, cutoff_hz))
    if chosen >= cutoff_hz:
        return trial, cutoff_hz
    lost = ~np.isfinite(trial.pelvis_position).all(axis=1)
    position = _from_standing(position, rate_hz, chosen, start)
    vectors = _from_standing(vectors, rate_hz, chosen, start)
    first = trial.pelvis_rotation[np.argmax(np.isfinite(trial.pelvis_rotation).all(axis=(1, 2)))]
    rotation = first @ Rotation.from_rotvec(vectors).as_matrix()
    position[lost], rotation[lost] = np.nan, np.nan
    return replace(trial, pelvis_position=position, pelvis_rotation=rotation), chosen


def _rigid_markers(trial: Trial) -> np.ndarray:
    """Pelvis markers (4, n, 3) [m, world] as a rigid body on the measured pose: there also where one was lost."""
    rotation, position = trial.pelvis_rotation, trial.pelvis_position
    seen = position[:, None] + np.einsum("nij,kj->nki", rotation, _pelvis_shape(trial))
    return np.moveaxis(seen, 1, 0)


def _pelvis_shape(trial: Trial) -> np.ndarray:
    """Where the pelvis' markers are on it on average, (4, 3) [m]."""
    rotation, away = trial.pelvis_rotation, trial.pelvis_markers - trial.pelvis_position[:, None]
    return np.asarray(np.nanmean(np.einsum("nji,nkj->nki", rotation, away), axis=0))


def load_evidence(
    *,
    folder: Path,
    neutral: Path,
    limits: Path | None,
    robot: Path,
    settings: dict,
    sd: dict[str, np.ndarray],
) -> Evidence:
    """Evidence of one trial from its canonical tables, not whitened yet.

    Parameters
    ----------
    folder, neutral
        results/trials/<SUBJECT>/<TRIAL> of the trial and of the neutral one.
    limits
        Joint limits of the person; None lets the strap's joints go anywhere.
    settings
        Slices ``identification``, ``plant``, ``robot`` and ``ingest``; ``plant.timestep_s`` is a number.
    sd
        Raw noise (3,) [m] of each marker, see `marker_noise`.
    """
    ident = settings["identification"]
    trial = load_trial(
        folder / "pose.parquet",
        folder / "markers.parquet",
        start_window_s=ident["start_window_s"],
        settle_s=ident["settle_after_gap_s"],
    )
    rate = settings["ingest"]["rate_hz"]
    trial = replace(trial, interface=_without_filled(trial.interface, folder / "markers.parquet", rate))
    start = max(2, int(np.sum(trial.time_s - trial.time_s[0] < ident["start_window_s"])))
    trial, jumped = without_ghosts(trial, rate, ident["settle_after_gap_s"])
    trial, cutoff = smoothed_pelvis(trial, sd, rate, settings["ingest"]["cutoff_hz"], start)
    measured = robot_motion(folder / "robot.parquet", trial.interface, start)
    colour = noise_colour(neutral / "markers.parquet", rate)
    log_sd = robot_noise(neutral / "robot.parquet", folder / "robot.parquet", rate)
    let_go = np.zeros((6, 6))
    if measured is not None:
        trial, let_go = moved_to_first(trial, robot, *at_first(measured, start, rate, log_sd))
    twin = load_robot(robot).compile()
    rotation, _ = interface_frame(trial.interface[:, 0], trial.interface[:, 1])
    q, qd = (measured_coordinates(folder / "pose.parquet", prefix) for prefix in ("q", "qd"))
    context = Context(
        trial.time_s,
        trial.time_s,
        bridged_rotation(trial.pelvis_rotation),
        signals.bridged(trial.pelvis_position),
        bridged_rotation(rotation),
        start,
        float(twin.body_mass.sum()),
        trial.interface,
        spikes(trial.interface, rate),
        signals.lowpass(q, rate, cutoff, 4),
        signals.lowpass(qd, rate, cutoff, 4),
        *_mean_pelvis(neutral),
        _pelvis_shape(trial),
        twin.body("interface").pos,
    )
    sigma = CostScales(ident["scales"]["position_m"], ident["scales"]["velocity_m_per_s"])
    cost = TrialCost(trial.interface, rate, sigma, trial.usable)
    known = None if limits is None else load_limits(limits)
    ones = np.ones(6)
    scales = Scales(_large(q), _large(qd), ones, ones, ones)
    skin = skin_of(trial.time_s, trial.pelvis_markers, context.pelvis_shape)
    standing = neutral / "pose.parquet"
    held = impedances(settings["robot"], "hold")
    hold = hold_uncertainty(standing, folder / "pose.parquet", start, rate, twin, held)
    of_poses = rest_uncertainty(standing, rate), hold
    of_channels = (sd, colour, log_sd, *of_poses)
    last = let_go, log_offset_sd(folder / "quality.json"), cutoff, skin, jumped
    return Evidence(
        trial, measured, context, scales, cost, settings, robot, known, {}, q, *of_channels, *last
    )


def log_offset_sd(quality: Path) -> float:
    """SD [s] of the robot log's clock against the markers', from quality.json; 0 for an edge that both have seen."""
    return float((read_json(quality).get("robot") or {}).get("offset_sd_s") or 0.0)


def _without_filled(interface: np.ndarray, markers: Path, rate_hz: float) -> np.ndarray:
    """Interface markers (n, 2, 3) [m], unknown where a short gap was filled and as far as a filter carries that.

    What fills a gap starts from noise at both ends, and with loud markers it was taken for a jump.
    """
    table = pq.read_table(markers)
    filled = np.column_stack([table[f"{name}_filled"].to_numpy() for name in INTERFACE_MARKERS])
    out = interface.copy()
    out[around(filled, rate_hz, EDGE_S)] = np.nan
    return out


def _mean_pelvis(neutral: Path) -> tuple[np.ndarray, np.ndarray]:
    """Mean pelvis rotation (3, 3) and position (3,) [m, world] of the neutral trial's tables."""
    table = pq.read_table(neutral / "pose.parquet")
    rotation = _rotations(table, "pelvis")
    position = np.column_stack([table[f"pelvis_{c}"].to_numpy() for c in "xyz"])
    known = np.isfinite(rotation).all(axis=(1, 2))
    return mean_rotation(rotation[known]), position[known].mean(axis=0)


def _rotations(table: pa.Table, body: str) -> np.ndarray:
    """Rotations (n, 3, 3) of a body in a table of poses."""
    return rotation_matrix(np.column_stack([table[f"{body}_q{c}"].to_numpy() for c in "wxyz"]))


def measured_coordinates(path: Path, prefix: str) -> np.ndarray:
    """Measured interface coordinates ("q") or rates ("qd") (n, 6) of pose.parquet, gaps bridged."""
    table = pq.read_table(path, columns=[f"{prefix}_{axis}" for axis in AXES])
    return signals.bridged(np.column_stack([column.to_numpy() for column in table.columns]))


def _large(values: np.ndarray) -> np.ndarray:
    """Large excursions (6,): the 95th percentile of the size."""
    return np.maximum(np.percentile(np.abs(values), 95, axis=0), 1e-6)


def adapted(evidence: Evidence, parameters: np.ndarray) -> Scales:
    """Scales of the effects (units of their parameters) for a plain fit (12,) of this trial."""
    replay = evidence.replay([], 1)
    model = replay.model
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    mass = np.zeros((model.nv, model.nv))
    mujoco.mj_fullM(model, data, mass)
    dofs = [model.joint(name).dofadr[0] for name in STRAP_JOINTS]
    inertia = 1 / np.diag(np.linalg.inv(mass))[dofs]
    old = evidence.scales
    return Scales(old.q, old.v, parameters[:6], parameters[6:], inertia)


def _vectors(rotation: np.ndarray) -> np.ndarray:
    """Rotation vectors (n, 3) from the first known of rotations (n, 3, 3), unknown ones bridged."""
    known = np.isfinite(rotation).all(axis=(1, 2))
    vectors = np.full((len(rotation), 3), np.nan)
    vectors[known] = Rotation.from_matrix(rotation[np.argmax(known)].T @ rotation[known]).as_rotvec()
    return signals.bridged(vectors)


def bridged_rotation(rotation: np.ndarray) -> np.ndarray:
    """Rotations (n, 3, 3) with unknown samples bridged along the rotation vector from the first known one."""
    first = rotation[np.argmax(np.isfinite(rotation).all(axis=(1, 2)))]
    return first @ Rotation.from_rotvec(_vectors(rotation)).as_matrix()


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
    path, second = _interface_path(standing), round(rate_hz)
    means = path[: len(path) // second * second].reshape(-1, second, 6).mean(axis=1)
    speed = np.sqrt(np.mean(np.diff(means, axis=0) ** 2, axis=0))
    acceleration = speed**2 / np.maximum(means.std(axis=0), 1e-9)
    data, mass = mujoco.MjData(robot), np.zeros((robot.nv, robot.nv))
    mujoco.mj_forward(robot, data)
    mujoco.mj_fullM(robot, data, mass)
    inertia = np.diag(mass)[[robot.joint(name).dofadr[0] for name in ROBOT_JOINTS]]
    stiffness, damping = (np.array([held[j][key] for j in ROBOT_JOINTS]) for key in ("stiffness", "damping"))
    first = np.polyfit(np.arange(start) / rate_hz, _interface_path(trial)[:start], 1)[0]
    beside = np.hypot(damping * speed, inertia * acceleration) / stiffness
    return np.array([beside, np.hypot(speed, first)])


def _interface_path(pose: Path) -> np.ndarray:
    """Place and small turns (n, 6) [m, rad] of the interface, in the order of the robot's joints, of pose.parquet."""
    table = pq.read_table(pose)
    place = signals.bridged(np.column_stack([table[f"interface_{c}"].to_numpy() for c in "xyz"]))
    turn = _vectors(_rotations(table, "interface"))
    return np.column_stack([place[:, :2], turn[:, 2], place[:, 2], turn[:, :2]])


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
