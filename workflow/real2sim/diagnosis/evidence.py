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
from pathlib import Path

import mujoco
import numpy as np
from scipy.fft import dct
from scipy.linalg import block_diag
from scipy.spatial.transform import Rotation

from real2sim import signals
from real2sim.effects.base import Scales, Where
from real2sim.effects.catalogue import EFFECTS, Effect, EffectParameter, Placed
from real2sim.effects.chains import Context, Elsewhere, markers_of
from real2sim.geometry import AXES, INTERFACE_MARKERS, PELVIS_MARKERS, interface_frame, pelvis_frame
from real2sim.inference.cost import CostScales, TrialCost
from real2sim.recording.jumps import JumpRule, spikes, without_ghosts
from real2sim.recording.noise import NoiseModel, hold_uncertainty, rest_uncertainty, robot_noise
from real2sim.recording.skin import Skin, skin_of
from real2sim.recording.start import at_first, moved_to_first
from real2sim.recording.tables import (
    bridged_rotation,
    log_offset_sd,
    mean_pelvis,
    measured_coordinates,
    robot_motion,
    rotation_vectors,
    without_filled,
)
from real2sim.recording.trial import Trial, load_limits, load_trial, replay_inputs
from real2sim.system.drive import PelvisDrive, pelvis_drive
from real2sim.system.effect_replay import EffectReplay, InputBasis
from real2sim.system.plant import STRAP_JOINTS, JointLimits, impedances, load_robot

# How late a log's stamps are beside what they say, SD [s], and how well the size of wheels is known, SD: one number a
# trial each (systematic errors of odometry: Borenstein & Feng, IEEE Trans. Robot. Autom. 12 (1996) 869)
LOG_LATENCY_S = 0.001
ODOMETRY_SCALE_SD = 0.005
# Above this the log's own motion is lost in its noise
LOG_CUTOFF_HZ = 5.0
# The pelvis path is never smoothed below this
LOWEST_CUTOFF_HZ = 3.0
# Most parts of a time step while a cause is only searched for
COARSE = 2
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


@dataclass
class Evidence:
    """A trial, its replay with room for effects, and the noise that its residuals are measured in.

    ``robot`` is what `robot_motion` returns; ``context`` and ``scales`` go to the effects; ``whiteners`` holds per
    band (w, c, c) matrices for c channels and ``noise`` (draws, n, c) the residuals behind them; ``cost`` is J of the
    paper; ``coordinates`` (n, 6) are measured. ``noise_model`` and ``robot_sd`` are the noise of markers and robot log
    (`NoiseModel`, `robot_noise`), ``rest_sd`` that of the rest pose and ``rests`` (6, n, c) what it does
    (`rest_uncertainty`); ``starts`` (6, n, c) is what a start pose does that is 1 m or rad off.
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
    noise_model: NoiseModel
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
        return self.noise_model.bands.coefficients(n, duration)

    def band_of(self, n: int) -> np.ndarray:
        """Band index of each cosine coefficient of n samples."""
        duration = n * float(self.trial.time_s[1] - self.trial.time_s[0])
        frequency = np.arange(self._last(n)) / (2 * duration)
        return self.noise_model.bands.band_of(frequency)

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
        options = self.settings["diagnosis"]["jumps"]
        rule = JumpRule(rate, self.settings["ingest"]["cutoff_hz"], options)
        found = spikes(self.trial.interface - paths, rule, options["residual_sd"]) | self.context.spikes
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
        for b in range(len(self.noise_model.bands.edges_hz) - 1):
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
        return self.noise_model.bands.floor[: self.channels]

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
        logged = self.robot_sd * rng.standard_normal((draws, len(self.trial.time_s), len(self.robot_sd)))
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

    def _draw(self, seed: int, i: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Pelvis path (n, 3, 3), (n, 3) with other noise and noise (n, 2, 3) of the interface markers [m]: draw i."""
        if (seed, i) not in self.draws:
            trial, rng = self.trial, np.random.default_rng([seed, i])
            clean = _rigid_markers(trial)
            r_clean, p_clean = pelvis_frame(*clean)
            noise = self._pelvis_noise(rng)
            r, p = pelvis_frame(*(clean + np.moveaxis(noise, 1, 0)))
            turn = np.einsum("nij,nkj->nik", r, r_clean)
            rotation, position = turn @ trial.pelvis_rotation, trial.pelvis_position + p - p_clean
            own = self.noise_model.filtered(INTERFACE_MARKERS, len(trial.time_s), rng)
            self.draws[seed, i] = rotation, position, own
        return self.draws[seed, i]

    def _pelvis_noise(self, rng: np.random.Generator) -> np.ndarray:
        """Draw noise (n, 4, 3) [m] of the pelvis markers as the filters of the pelvis path leave it."""
        model, n = self.noise_model, len(self.trial.time_s)
        rate, cutoff = model.bands.rate_hz, self.pelvis_cutoff_hz
        if cutoff >= model.bands.low_pass.cutoff_hz:
            return model.filtered(PELVIS_MARKERS, n, rng)
        is_filtered = model.bands.is_filtered
        noise = (model.filtered if is_filtered else model.unfiltered)(PELVIS_MARKERS, n, rng)
        return _from_standing(noise, rate, cutoff, self.context.start)

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
    position, vectors = signals.bridged(trial.pelvis_position), rotation_vectors(trial.pelvis_rotation)
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


def _rest_shape(trial: Trial) -> np.ndarray:
    """Where the interface's markers are to the pelvis at rest, (2, 3) [m]."""
    half = float(np.nanmean(np.linalg.norm(trial.interface[:, 0] - trial.interface[:, 1], axis=1))) / 2
    return markers_of(trial.rest.rotation, trial.rest.position, half)


def load_evidence(
    *,
    folder: Path,
    neutral: Path,
    limits: Path | None,
    robot: Path,
    settings: dict,
    noise: NoiseModel,
) -> Evidence:
    """Evidence of one trial from its canonical tables, not whitened yet.

    Parameters
    ----------
    folder, neutral
        results/trials/<SUBJECT>/<TRIAL> of the trial and of the neutral one.
    limits
        Joint limits of the person; None lets the strap's joints go anywhere.
    settings
        Slices ``identification``, ``plant``, ``robot``, ``ingest`` and ``diagnosis``; ``plant.timestep_s`` is a number.
    noise
        Of the markers, from the neutral trial.
    """
    ident = settings["identification"]
    trial = load_trial(
        folder / "pose.parquet",
        folder / "markers.parquet",
        start_window_s=ident["start_window_s"],
        settle_s=ident["settle_after_gap_s"],
    )
    rate, options = settings["ingest"]["rate_hz"], settings["diagnosis"]
    rule = JumpRule(rate, settings["ingest"]["cutoff_hz"], options["jumps"])
    trial = replace(trial, interface=without_filled(trial.interface, folder / "markers.parquet", rule))
    start = max(2, int(np.sum(trial.time_s - trial.time_s[0] < ident["start_window_s"])))
    trial, jumped = without_ghosts(trial, rule, ident["settle_after_gap_s"])
    trial, cutoff = smoothed_pelvis(trial, noise.marker_sd, rate, settings["ingest"]["cutoff_hz"], start)
    measured = robot_motion(folder / "robot.parquet", trial.interface, start)
    log_sd = robot_noise(neutral / "robot.parquet", folder / "robot.parquet", noise.bands)
    let_go = np.zeros((6, 6))
    if measured is not None:
        trial, let_go = moved_to_first(
            trial, robot, *at_first(measured, start, rate, log_sd, options["start"])
        )
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
        spikes(trial.interface, rule),
        signals.lowpass(q, rate, cutoff, 4),
        signals.lowpass(qd, rate, cutoff, 4),
        *mean_pelvis(neutral),
        _pelvis_shape(trial),
        _rest_shape(trial),
        twin.body("interface").pos,
    )
    sigma = CostScales(ident["scales"]["position_m"], ident["scales"]["velocity_m_per_s"])
    cost = TrialCost(trial.interface, rate, sigma, trial.usable)
    known = None if limits is None else load_limits(limits)
    ones = np.ones(6)
    scales = Scales(_large(q), _large(qd), ones, ones, ones)
    skin = skin_of(trial.time_s, trial.pelvis_markers, context.pelvis_shape, options["skin"])
    standing = neutral / "pose.parquet"
    held = impedances(settings["robot"], "hold")
    hold = hold_uncertainty(standing, folder / "pose.parquet", start, rate, twin, held)
    of_noise = noise, log_sd, rest_uncertainty(standing, rate), hold, let_go
    last = log_offset_sd(folder / "quality.json"), cutoff, skin, jumped
    return Evidence(trial, measured, context, scales, cost, settings, robot, known, {}, q, *of_noise, *last)


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
