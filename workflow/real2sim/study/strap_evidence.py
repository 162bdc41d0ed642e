"""What a trial says about a simulation of it: residuals of markers and robot log, in units of their own noise.

A residual of a replay has two sources of noise: that of the interface markers, and that of the pelvis markers, which
moves the replayed pelvis and reaches the interface through strap and robot. The second is slow and common to markers
and robot log. Both are simulated from the noise of the markers, and the residuals are whitened by what comes out, per
band of frequency and over all channels at once. After that a sum of squares is a likelihood.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any

import mujoco
import numpy as np
from scipy.linalg import block_diag

from real2sim import signals
from real2sim.diagnosis.whitening import Bands, Whitening, without_gaps
from real2sim.effects.base import AtRest, Effect, EffectParameter, Placed, Scales
from real2sim.effects.catalogue import EFFECTS
from real2sim.effects.chains import Chains, Context, Elsewhere
from real2sim.effects.input_basis import InputChain
from real2sim.effects.replay import EffectReplay
from real2sim.geometry import AXES, INTERFACE_MARKERS, pelvis_frame
from real2sim.inference.cost import TrialCost
from real2sim.recording.jumps import JumpRule, spikes
from real2sim.recording.missing_marker import PutBack
from real2sim.recording.noise import NoiseModel
from real2sim.recording.pelvis import PathFilter, path_noise, path_of, rigid_markers, with_path
from real2sim.recording.skin import Skin
from real2sim.recording.trial import Trial, replay_inputs
from real2sim.study import strap_localise
from real2sim.system.description import System
from real2sim.system.drive import PelvisDrive, pelvis_drive
from real2sim.system.plant import STRAP_JOINTS, JointLimits

if TYPE_CHECKING:
    from real2sim.settings import Settings

# Most parts of a time step while a cause is only searched for
COARSE = 2
# A rest pose that differs along one axis, and a start pose that differs from the observed one
_REST = next(effect for effect in EFFECTS if effect.name == "preload" and not effect.form)
_START = Effect(
    "start",
    "robot",
    "the start pose of the robot differs from the observed one",
    tuple(EffectParameter(f"start_{axis}", "m|rad", -1.0, 1.0, (0.0,)) for axis in AXES),
    separating_trial="",
    at_rest=AtRest((0.0,) * len(AXES)),
    scope="whole",
    chains=Chains(observation=Elsewhere()),
)
# How far the start is moved to learn what that does [m, rad]
_START_STEP = 1e-3


@dataclass(frozen=True)
class Recorded:
    """Measurements of one trial.

    ``robot`` (n, 6) is what `robot_motion` returns, None without a log; ``context`` goes to the effects; ``cost`` is J
    of the paper; ``coordinates`` (n, 6) of the interface [m, rad]; ``skin`` is what the pelvis' markers show of each
    other; ``jumped_s`` for how long [s] pelvis markers jumped; ``path`` is the filter that made the most probable path
    of the pelvis; ``put_back`` are gaps of pelvis markers that were lost or jumped; ``crossed`` are sides of joint
    limits that it is beyond (`without_crossed`).
    """

    trial: Trial
    robot: np.ndarray | None
    context: Context
    cost: TrialCost
    coordinates: np.ndarray
    path: PathFilter
    skin: Skin | None = None
    jumped_s: Mapping[str, float] = field(default_factory=dict)
    put_back: tuple[PutBack, ...] = ()
    crossed: tuple[str, ...] = ()


@dataclass(frozen=True)
class NoiseLevels:
    """Standard deviations of what is measured, as quiet standing and the trial's start show them.

    ``noise_model`` and ``robot_sd`` of markers and robot log (`NoiseModel`, `robot_noise`);
    ``rest_sd`` (6,) of the rest pose (`rest_uncertainty`); ``hold_sd`` (2, 6) of where a robot at rest holds and how
    fast it moves at the start (`hold_uncertainty`); ``let_go`` (6, 6) what one SD of each robot joint at the start does
    to the start pose (`moved_to_first`); ``log_offset_sd_s`` of the log's clock [s].
    """

    noise_model: NoiseModel
    robot_sd: np.ndarray
    rest_sd: np.ndarray
    hold_sd: np.ndarray
    let_go: np.ndarray
    log_offset_sd_s: float


@dataclass(frozen=True)
class Elsewheres:
    """Change of the residuals by per-trial nuisance parameters.

    ``rests`` (6, n, c) by a rest pose one SD off, axis by axis; ``starts`` (6, n, c) per metre and radian of a start
    pose; ``pelvis`` (18, n, c) per metre and radian of a pelvis that was beside its measured path, by `_beside`;
    ``holds`` (k, n, c) by a controller that holds one SD beside equilibrium, none for a robot that is let go;
    ``put_back`` (k, n, c) by what was missed of pelvis markers that were lost.
    """

    rests: np.ndarray
    starts: np.ndarray
    pelvis: np.ndarray
    holds: np.ndarray
    put_back: np.ndarray


@dataclass(frozen=True)
class PlantSetup:
    """Ingredients of a trial's replay: system, settings, joint limits, threads of a simulation."""

    system: System
    settings: Settings
    limits: JointLimits | None
    threads: int = 1


@dataclass(frozen=True)
class Drawn:
    """One draw of the noise of all markers.

    ``pelvis`` is a path, (n, 3, 3) and (n, 3) [m], measured with other noise, and ``markers`` (n, 2, 3) [m] noise of
    the interface's. What of the path's noise is beside it throughout, at its start and its end, ``beside`` (3, 6)
    [m, rad], is told apart and not in ``pelvis``: each of these numbers moves many residuals together, and noise that
    is whitened frequency by frequency would be taken for as many measurements.
    """

    pelvis: tuple[np.ndarray, np.ndarray]
    beside: np.ndarray
    markers: np.ndarray


@dataclass
class ReplayCache:
    """Cache of what replays of one trial have computed; it changes no result.

    ``bases`` of input chains; ``draws`` of noise as pelvis paths; ``commands`` of those paths at a time step;
    ``drives`` by time step; ``start_joints`` (6,) of the robot.
    """

    drives: dict[float, PelvisDrive] = field(default_factory=dict)
    bases: dict[tuple[str, float, bytes], InputChain] = field(default_factory=dict)
    draws: dict[tuple[int, int], Drawn] = field(default_factory=dict)
    commands: dict[tuple[int, int, float], np.ndarray] = field(default_factory=dict)
    start_joints: np.ndarray | None = None


@dataclass(frozen=True)
class StrapEvidence:
    """One trial of a person in the strap, its replay with room for effects, and the noise of its residuals.

    ``settled``: the robot is in static equilibrium with the strap at the start, see `EffectReplay`; ``held_out``: not
    the trial that is fitted. ``elsewhere`` and ``whitening`` are None until `with_noise` has simulated the noise.
    ``name`` is the folder of the trial's tables.
    """

    recorded: Recorded
    levels: NoiseLevels
    scales: Scales
    setup: PlantSetup
    settled: bool = False
    held_out: bool = False
    elsewhere: Elsewheres | None = None
    whitening: Whitening | None = None
    cache: ReplayCache = field(default_factory=ReplayCache, repr=False)
    name: str = ""

    @property
    def trial(self) -> Trial:
        """Measured paths of the trial."""
        return self.recorded.trial

    @property
    def robot(self) -> np.ndarray | None:
        """Logged robot joints (n, 6) relative to their mean while the person stands [m, rad]; None without a log."""
        return self.recorded.robot

    @property
    def context(self) -> Context:
        """Measurements that effects are computed from."""
        return self.recorded.context

    @property
    def cost(self) -> TrialCost:
        """J of the paper."""
        return self.recorded.cost

    @cached_property
    def noise_by_sensor(self) -> tuple[float, ...]:
        """Mean chi-squared of simulated noise by sensor."""
        return self._whitening.of_noise_by_sensor(self.sensors.values())

    @property
    def threads(self) -> int:
        """As of `Evidence`."""
        return self.setup.threads

    @property
    def noise(self) -> np.ndarray:
        """Simulated residuals (draws, n, c) of a perfect model [m, rad]."""
        return self._whitening.noise

    @property
    def log_determinant(self) -> float:
        """Logarithm of the determinant of the residuals' covariance by noise."""
        return self._whitening.log_determinant

    @property
    def _whitening(self) -> Whitening:
        if self.whitening is None:
            raise ValueError("the noise of this trial has not been simulated: call with_noise first")
        return self.whitening

    @property
    def bands(self) -> Bands:
        """Bands of frequency within which the noise is taken as equal."""
        time_s = self.trial.time_s
        return Bands(self.levels.noise_model.bands.edges_hz, len(time_s), float(time_s[1] - time_s[0]))

    @property
    def channels(self) -> int:
        """Six of the markers, and six of the robot where it was logged."""
        return 6 if self.robot is None else 12

    @property
    def rows(self) -> int:
        """Number of whitened residuals."""
        return self.bands.last * self.channels

    @cached_property
    def samples_by_sensor(self) -> tuple[int, ...]:
        """Whitened residuals that count, by sensor."""
        return self._whitening.counts_by_sensor(self.sensors.values())

    @property
    def samples(self) -> int:
        """Their number."""
        return sum(self.samples_by_sensor)

    @property
    def sensors(self) -> dict[str, int]:
        """Number of channels of the markers and of the robot's log, 0 without one."""
        return {"markers": 6, "robot log": self.channels - 6}

    def replay(self, effects: Sequence[Placed], nsim: int, *, coarse: bool = False) -> EffectReplay:
        """A replay of this trial with effects, at a fraction of the time step where one of them needs it.

        ``coarse``: at half of the time step at least, which is less exact and costs less.
        """
        trial = self.trial
        parts = max([1, *(e.effect.plant.substeps for e in effects)])
        h = float(self.setup.settings["plant"]["timestep_s"]) / (min(parts, COARSE) if coarse else parts)
        if h not in self.cache.drives:
            rotation, position = trial.pelvis_rotation, trial.pelvis_position
            self.cache.drives[h] = pelvis_drive(trial.time_s, rotation, position, h)
        settings = self.setup.settings | {"plant": self.setup.settings["plant"] | {"timestep_s": h}}
        steps = trial.time_s[0] + h * np.arange(len(self.cache.drives[h].position))
        replay = EffectReplay(
            effects=effects,
            context=replace(self.context, step_time_s=steps, held_out=self.held_out),
            scales=self.scales,
            system=self.setup.system,
            **replay_inputs(trial, self.setup.limits, self.setup.system.model, settings),
            nsim=nsim,
            drive=self.cache.drives[h],
            bases=self.cache.bases,
            settled=self.settled,
            start_joints=self.cache.start_joints,
            threads=self.setup.threads,
        )
        self.cache.start_joints = replay.start_joints
        return replay

    def as_held_out(self) -> StrapEvidence:
        """The same trial as the one that is not fitted."""
        return replace(self, held_out=True)

    def as_settled(self) -> StrapEvidence:
        """The same trial of a robot in static equilibrium with the strap."""
        return replace(self, settled=True)

    def with_scales(self, scales: Scales) -> StrapEvidence:
        """The same trial with other units of the effects' parameters."""
        return replace(self, scales=scales)

    @property
    def skin(self) -> Skin | None:
        """Model of the pelvis' markers by each other."""
        return self.recorded.skin

    @property
    def rate_hz(self) -> float:
        """Sample rate."""
        return 1 / float(self.trial.time_s[1] - self.trial.time_s[0])

    @property
    def plain_samples(self) -> float:
        """Six coordinates of two markers, of which each sample of J counts one marker."""
        return 6 * self.cost.samples / 2

    @property
    def noise_source(self) -> str:
        """Source of the noise floor, in words."""
        return "marker noise of the level in neutral, simulated through the plant"

    def floor_draws(self) -> np.ndarray:
        """J (draws,) of noise alone."""
        noise = self.noise[:, :, :6]
        return np.asarray(self.cost.energy(noise.reshape(*noise.shape[:2], 2, 3)))

    def residual_sd(self) -> dict[str, float]:
        """RMS [m] over draws and samples of what noise alone leaves, by interface marker and world axis."""
        rms = np.sqrt(np.mean(self.noise[:, :, :6] ** 2, axis=(0, 1)))
        names = [f"{marker}_{axis}" for marker in INTERFACE_MARKERS for axis in "xyz"]
        return {name: float(value) for name, value in zip(names, rms, strict=True)}

    def axis_shares(self, paths: np.ndarray) -> dict[str, float]:
        """Share of the gap by coordinate of the interface, of simulated markers (n, 2, 3) [m]."""
        return strap_localise.axis_shares(self._gap(paths))

    def locate(self, paths: np.ndarray, explained: np.ndarray | None) -> dict[str, Any]:
        """Split J of simulated markers (n, 2, 3) [m] by side, term, time, frequency and regime."""
        return strap_localise.where(self._gap(paths), explained)

    def _gap(self, paths: np.ndarray) -> strap_localise.Gap:
        c = self.context
        return strap_localise.Gap(
            self.trial.time_s,
            self.trial.interface,
            paths,
            self.noise[:, :, :6],
            self.cost,
            self.scales,
            self.recorded.coordinates,
            c.rates,
            c.pelvis_rotation,
        )

    def traces(self, plain: np.ndarray, with_effect: np.ndarray) -> dict[str, np.ndarray]:
        """Return columns (n,): time [s], and marker paths (n, 2, 3) [m, world] measured, plain and with effect."""
        columns = {"time_s": self.trial.time_s}
        paths = {"measured": self.trial.interface, "plain": plain, "with_effect": with_effect}
        for kind, path in paths.items():
            for m, marker in enumerate(INTERFACE_MARKERS):
                columns |= {f"{kind}_{marker}_{c}": path[:, m, i] for i, c in enumerate("xyz")}
        return columns

    def adapted(self, parameters: np.ndarray) -> StrapEvidence:
        """The same trial with the effects' parameters in units of a plain fit (12,) of it."""
        model = self.replay([], 1).model
        data = mujoco.MjData(model)
        mujoco.mj_forward(model, data)
        mass = np.zeros((model.nv, model.nv))
        mujoco.mj_fullM(model, data, mass)
        dofs = [model.joint(name).dofadr[0] for name in STRAP_JOINTS]
        inertia = 1 / np.diag(np.linalg.inv(mass))[dofs]
        scales = Scales(self.scales.q, self.scales.v, parameters[:6], parameters[6:], inertia)
        return replace(self, scales=scales)

    def raw(self, paths: np.ndarray, joints: np.ndarray) -> np.ndarray:
        """Residuals (m, n, c) simulated minus measured; what stands in gaps counts for nothing (`Whitening`)."""
        error = paths.reshape(*paths.shape[:2], 6) - self.trial.interface.reshape(-1, 6)
        if self.robot is not None:
            error = np.concatenate([error, self._from_start(joints) - self.robot], axis=2)
        return self._without_gaps(error)

    def _from_start(self, joints: np.ndarray) -> np.ndarray:
        """Robot joints (m, n, c) relative to their mean while the person stands, as the log is taken."""
        return np.asarray(joints - joints[:, : self.context.start].mean(axis=1, keepdims=True))

    def _without_gaps(self, error: np.ndarray) -> np.ndarray:
        """Residuals (m, n, c) with straight lines where pelvis or channel is unknown, and a while after a gap."""
        return without_gaps(error, self._measured)

    @cached_property
    def _measured(self) -> np.ndarray:
        """Mask (n, c) of the samples that count, by channel."""
        known = np.isfinite(self.trial.interface.reshape(-1, 6))
        if self.robot is not None:
            known = np.hstack([known, np.isfinite(self.robot)])
        return np.asarray(known & self.trial.usable[:, None])

    def j(self, paths: np.ndarray) -> np.ndarray:
        """J of the paper (m,) of simulated marker paths (m, n, 2, 3)."""
        return np.asarray(self.cost(paths).total)

    def whitened(self, paths: np.ndarray, joints: np.ndarray) -> np.ndarray:
        """Residuals (m, n_r) whose squares sum to chi-squared; NaN where a simulation failed."""
        return self.whiten(self.raw(paths, joints))

    def whiten(self, error: np.ndarray) -> np.ndarray:
        """As `whitened`, from residuals (m, n, c)."""
        return self._whitening.apply(error)

    def standing(self, error: np.ndarray) -> np.ndarray:
        """Mean square (m,) of residuals (m, n, c) while the person stands, in units of what noise leaves there."""
        first = slice(None, self.context.start)
        usual = np.mean(self.noise[:, first] ** 2, axis=(0, 1)) + self._floor**2
        return np.asarray(np.mean(error[:, first] ** 2 / usual, axis=(1, 2)))

    def with_spikes(self, paths: np.ndarray) -> StrapEvidence:
        """Mark where markers jump out of what simulated paths (n, 2, 3) [m] leave of them; self where none is new.

        A motion hides jumps that its simulation does not make.
        """
        rate = 1 / float(self.trial.time_s[1] - self.trial.time_s[0])
        options, known = self.setup.settings["diagnosis"]["jumps"], self.context.spikes
        rule = JumpRule(rate, self.setup.settings["ingest"]["cutoff_hz"], options)
        found = spikes(self.trial.interface - paths, rule, options["residual_sd"], paths) | known
        if not (found & ~known).any():
            return self
        context = replace(self.context, spikes=found)
        return replace(self, recorded=replace(self.recorded, context=context))

    def with_noise(self, parameters: np.ndarray, draws: int, seed: int) -> StrapEvidence:
        """Whiten by noise of the markers simulated through the plant with plain strap ``parameters`` (12,)."""
        known = replace(self, elsewhere=self._elsewhere(parameters))
        error, drawn = known._noise(parameters, draws, seed)
        nuisance = known._nuisance(seed, draws)
        whitening = Whitening.of_noise(self.bands, error, drawn, nuisance, self._floor, known=self._measured)
        return replace(known, whitening=whitening)

    @property
    def _floor(self) -> np.ndarray:
        """Lower limits (c,) of each channel's noise."""
        return self.levels.noise_model.bands.floor[: self.channels]

    def noise_of(
        self,
        effects: Sequence[Placed],
        parameters: np.ndarray,
        x: Sequence[np.ndarray],
        draws: int,
        seed: int,
    ) -> np.ndarray:
        """Whitened residuals (draws, n_r) of noise alone where effects with searched numbers x (p,) each are the truth.

        Friction, stops and a robot that yields pass noise of the pelvis on otherwise than the plain plant.
        """
        error, drawn = self._noise(parameters, draws, seed, effects, x)
        return self.whiten(error + drawn)

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
        markers = np.array([self._draw(seed, i).markers for i in range(draws)])
        rng = np.random.default_rng([seed, draws])
        logged = self.levels.robot_sd * rng.standard_normal(
            (draws, len(self.trial.time_s), len(self.levels.robot_sd))
        )
        error = self._apart(replay, parameters, draws, markers, self._from_start(logged), x)
        nuisance = self._nuisance(seed, draws)
        drawn = np.tensordot(rng.standard_normal((draws, len(nuisance))), nuisance, axes=1)
        return error, drawn

    def _nuisance(self, seed: int, draws: int) -> np.ndarray:
        """Return the change of the residuals (k, n, c) by one SD of each per-trial nuisance parameter.

        Where the strap rests, the robot starts and its controller holds, where the pelvis is beside its measured path,
        when the log was written and how far the wheels roll: each is one number for the whole trial and no noise that
        comes and goes.
        """
        if self.elsewhere is None:
            raise ValueError("the noise of this trial has not been simulated: call with_noise first")
        markers = np.array([self._draw(seed, i).markers for i in range(draws)])
        misjudged = self._misjudged(markers)
        covariance = misjudged.T @ misjudged / draws + self.levels.let_go.T @ self.levels.let_go
        started = np.tensordot(_roots(covariance), self.elsewhere.starts, axes=1)
        beside = np.array([self._draw(seed, i).beside.ravel() for i in range(draws)])
        driven = np.tensordot(_roots(beside.T @ beside / draws), self.elsewhere.pelvis, axes=1)
        parts = [self.elsewhere.rests, started, driven, self.elsewhere.holds, self.elsewhere.put_back]
        if self.robot is not None:
            parts.append(self._log_unknown())
        return np.concatenate(parts)

    def _log_unknown(self) -> np.ndarray:
        """Return the change of the residuals (3, n, c) by one SD of the log's delay and of the wheels' size each.

        Systematic errors of odometry: Borenstein & Feng, IEEE Trans. Robot. Autom. 12 (1996) 869.
        """
        assert self.robot is not None
        known = self.setup.settings["diagnosis"]["nuisance"]
        late, scale = known["log_latency_sd_s"], known["odometry_scale_sd"]
        h = float(self.trial.time_s[1] - self.trial.time_s[0])
        path = signals.lowpass(signals.bridged(self.robot), 1 / h, known["log_cutoff_hz"], 4)
        out = np.zeros((3, len(path), self.channels))
        out[0, :, 6:] = np.hypot(self.levels.log_offset_sd_s, late) * np.gradient(path, h, axis=0)
        out[1, :, 6:8] = scale * path[:, :2]
        out[2, :, 8] = scale * path[:, 2]
        return out

    def _misjudged(self, markers: np.ndarray) -> np.ndarray:
        """Return the errors (draws, 6) [m, rad] of the start pose by noise (draws, n, 2, 3) [m] of the markers."""
        left, right = np.moveaxis(markers[:, : self.context.start].mean(axis=1), 1, 0)
        bar = np.diff(np.nanmean(self.trial.interface[: self.context.start], axis=0)[::-1], axis=0)[0]
        return np.hstack([(left + right) / 2, np.cross(bar, left - right) / (bar @ bar)])

    def _elsewhere(self, parameters: np.ndarray) -> Elsewheres:
        """Simulate residuals of a strap that rests, a robot that starts and a controller that holds elsewhere.

        (6, n, c) for a rest pose one SD off (`rest_uncertainty`), by axis; per metre and radian of a start pose; and
        for a hold one SD off (`hold_uncertainty`), by robot joint, none for a robot that is let go.
        """
        effects = [Placed(_REST, where, self.scales) for where in _REST.places(self.setup.system)]
        effects.append(Placed(_START, _START.place(self.setup.system), self.scales))
        off = block_diag(*map(np.diag, self.levels.hold_sd)) if self.settled else np.empty((0, 12))
        m = 1 + 2 * 6 + len(off)
        x = [np.zeros((m, len(placed.effect.parameters))) for placed in effects]
        for i, placed in enumerate(effects[:6]):
            x[i][1 + i] = self.levels.rest_sd[placed.where.axes[0]] / placed.values(np.ones((1, 1)))
        x[6][7:13] = _START_STEP * np.eye(6)
        replay = self.replay(effects, m, coarse=True)
        replay.hold_beside(*np.hsplit(np.concatenate([np.zeros((13, 12)), off]), 2))
        paths, joints = replay.run_effects(np.tile(parameters, (m, 1)), x)
        out = paths.reshape(m, -1, 6)
        if self.robot is not None:
            out = np.concatenate([out, self._from_start(joints)], axis=2)
        # a pose that MuJoCo gives up on is none that was
        moved = np.nan_to_num(out[1:] - out[:1])
        starts, holds = moved[6:12] / _START_STEP, moved[12:]
        driven, put_back = self._by_other_paths(parameters)
        return Elsewheres(moved[:6], starts, driven, holds, put_back)

    def _by_other_paths(self, parameters: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the change of the residuals by pelvis paths other than the measured one.

        (18, n, c) per metre and radian beside it, and (k, n, c) by one SD of what was missed of pelvis markers put
        back.
        """
        n, gaps, measured = len(self.trial.time_s), self.recorded.put_back, path_of(self.trial)
        steps = [np.outer(shape, step) for shape in self._beside for step in _START_STEP * np.eye(6)]
        beside = [with_path(self.trial, measured + step) for step in steps]
        missed = np.concatenate([np.empty((0, n, 4, 3)), *(gap.missed(n) for gap in gaps)])
        paths = [(trial.pelvis_rotation, trial.pelvis_position) for trial in beside]
        paths += [self._pelvis_by(displaced) for displaced in missed]
        replay = self.replay([], len(paths) + 1, coarse=True)
        for i, path in enumerate(paths):
            replay.set_command(i + 1, replay.command_for(*path))
        moved = np.nan_to_num(self._apart(replay, parameters, len(paths), 0.0, 0.0))
        return moved[: len(steps)] / _START_STEP, moved[len(steps) :]

    def shaken(self, draws: int, seed: int) -> None:
        """None: a replay is driven by the most probable path, and what is left of the person's bends no fit."""

    def _draw(self, seed: int, i: int) -> Drawn:
        """Draw ``i`` of the noise of all markers."""
        if (seed, i) not in self.cache.draws:
            rng = np.random.default_rng([seed, i])
            left = self.recorded.path.left(path_noise(self.trial, self.levels.noise_model, rng), rng)
            beside = np.linalg.lstsq(self._beside.T, left, rcond=None)[0]
            drawn = with_path(self.trial, path_of(self.trial) + left - self._beside.T @ beside)
            pelvis = drawn.pelvis_rotation, drawn.pelvis_position
            own = self.levels.noise_model.filtered(INTERFACE_MARKERS, len(self.trial.time_s), rng)
            self.cache.draws[seed, i] = Drawn(pelvis, beside, own)
        return self.cache.draws[seed, i]

    @property
    def _beside(self) -> np.ndarray:
        """Shapes (3, n) of how a pelvis may be beside its measured path: throughout, at the start and at the end.

        At its ends a path is known from one side alone. An error of the start lets the robot go from where it did not
        stand, and one of either end is in residuals of all frequencies. Both last as long as the start is averaged.
        """
        sample = np.arange(len(self.trial.time_s)) / self.context.start
        return np.array([np.ones(len(sample)), np.exp(-sample), np.exp(sample - sample[-1])])

    def _pelvis_by(self, moved: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Pelvis path (n, 3, 3), (n, 3) [m] with its markers displaced by (n, 4, 3) [m]."""
        trial, clean = self.trial, rigid_markers(self.trial)
        r_clean, p_clean = pelvis_frame(*clean)
        r, p = pelvis_frame(*(clean + np.moveaxis(moved, 1, 0)))
        turn = np.einsum("nij,nkj->nik", r, r_clean)
        return turn @ trial.pelvis_rotation, trial.pelvis_position + p - p_clean

    def _shake(self, replay: EffectReplay, draws: int, seed: int) -> None:
        """Give all simulations of a replay but the first a pelvis that was measured with other noise."""
        h = replay.model.opt.timestep
        for i in range(draws):
            key = seed, i, h
            if key not in self.cache.commands:
                self.cache.commands[key] = replay.command_for(*self._draw(seed, i).pelvis)
            replay.set_command(i + 1, self.cache.commands[key])

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
        return np.asarray(error)


def _roots(covariance: np.ndarray) -> np.ndarray:
    """Return rows (k, k) whose outer products add up to a covariance (k, k)."""
    values, axes = np.linalg.eigh(covariance)
    return np.asarray(np.sqrt(np.maximum(values, 0.0))[:, None] * axes.T)
