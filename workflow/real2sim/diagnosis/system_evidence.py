"""Evidence of one trial of a described system: its residuals in units of their own noise."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import pairwise
from typing import TYPE_CHECKING, Any

import mujoco
import numpy as np
from scipy.fft import dct
from scipy.ndimage import label

from real2sim import signals
from real2sim.diagnosis.channel_cost import ChannelCost
from real2sim.diagnosis.whitening import Bands, Whitening, without_gaps
from real2sim.effects.base import Placed, Scales
from real2sim.effects.catalogue import EFFECTS
from real2sim.effects.chains import Context
from real2sim.effects.system_replay import Setup, SystemReplay, substeps
from real2sim.errors import InputError
from real2sim.recording.skin import Skin
from real2sim.signals import Scatter
from real2sim.system.description import System

if TYPE_CHECKING:
    from real2sim.settings import DiagnosisDescribedSettings

# Spans of time that a gap is told by
_TIME_SPANS = 6


@dataclass(frozen=True)
class Measured:
    """Observations (n, c) and logs (n, j) of a trial, with their names, white noise SD and floors.

    ``drive_draw`` maps a random generator to a command (nstep, c) of the drive as measured with other noise, None where
    the drive has no noise. ``start_sd`` and ``start_rate_sd`` map joints to the SD of their position [m, rad] and rate
    at the start, ``rest_sd`` (axes,) is that of the rest pose. ``to_axes`` (n, axes, c) maps errors of observations to
    those of the interface's coordinates. ``zero_sd`` (c + j,): SD of each channel's zero from recording to recording.
    ``scatter`` is the noise of each channel from repeat to repeat, None where it was not measured.
    """

    time_s: np.ndarray
    observed: np.ndarray
    logged: np.ndarray
    names: tuple[str, ...]
    observed_sd: np.ndarray
    logged_sd: np.ndarray
    floor: np.ndarray
    scatter: tuple[Scatter | None, ...]
    start_sd: Mapping[str, float]
    start_rate_sd: Mapping[str, float]
    rest_sd: np.ndarray
    to_axes: np.ndarray
    zero_sd: np.ndarray

    @property
    def sd(self) -> np.ndarray:
        """White noise SD (c + j,) of all channels."""
        return np.concatenate([self.observed_sd, self.logged_sd])

    @property
    def repeated(self) -> np.ndarray:
        """SD (c + j,) of noise from repeat to repeat without that of the zeros, 0 where it was not measured."""
        return np.array([0.0 if s is None else s.sd for s in self.scatter])


MakeSetup = Callable[[int], Setup]
Draw = Callable[[int, int, int], tuple[np.ndarray, np.ndarray | None]]


@dataclass(frozen=True)
class Simulated:
    """Simulation of a trial: ``setup`` by the number of parts of a time step, and ``draw`` of a shaken drive.

    ``draw`` maps (seed, number, parts) to a command (nstep, c) and, of a path, its acceleration (n, c); ``shaken`` is
    whether the drive has noise at all; ``threads`` may work at a time.
    """

    system: System
    setup: MakeSetup
    draw: Draw
    shaken: bool
    base_step_s: float
    threads: int = 1


@dataclass(frozen=True)
class SystemEvidence:
    """One trial of a described system, see `Evidence`; ``settings`` is the slice ``diagnosis.described``.

    ``name`` is that of the recording.
    """

    measured: Measured
    simulated: Simulated
    context: Context
    scales: Scales
    settings: DiagnosisDescribedSettings
    settled: bool = False
    held_out: bool = False
    whitening: Whitening | None = None
    cache: dict[Any, np.ndarray] = field(default_factory=dict, repr=False)
    name: str = ""

    @cached_property
    def cost(self) -> ChannelCost:
        """Mean square of the residuals of the observations, in units of how much each varies."""
        return ChannelCost(self.measured.observed)

    @property
    def system(self) -> System:
        """The described system."""
        return self.simulated.system

    @property
    def channels(self) -> int:
        """Observed and logged channels."""
        return int(self.measured.observed.shape[1] + self.measured.logged.shape[1])

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
        """Number of observed and of logged channels, which may be 0."""
        return {"outputs": self.measured.observed.shape[1], "log": self.measured.logged.shape[1]}

    @property
    def skin(self) -> Skin | None:
        """None: markers of a described system are taken as fixed to their bodies."""
        return None

    @property
    def rate_hz(self) -> float:
        """Sample rate."""
        return 1 / float(self.measured.time_s[1] - self.measured.time_s[0])

    @property
    def bands(self) -> Bands:
        """Bands of frequency within which the noise is taken as equal."""
        top = min(self.system.band_hz, 0.4 * self.rate_hz)
        return Bands(
            tuple(top * e for e in (0.0, *self.settings["band_shares"])),
            len(self.measured.time_s),
            1 / self.rate_hz,
        )

    @cached_property
    def noise_by_sensor(self) -> tuple[float, ...]:
        """Mean chi-squared of simulated noise by sensor."""
        return self._whitening.of_noise_by_sensor(self.sensors.values())

    @property
    def threads(self) -> int:
        """As of `Evidence`."""
        return self.simulated.threads

    @property
    def noise(self) -> np.ndarray:
        """Simulated residuals (draws, n, c) of a perfect model."""
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

    def replay(self, effects: Sequence[Placed], nsim: int, *, coarse: bool = False) -> SystemReplay:
        """Return a simulation of this trial with effects; ``coarse`` makes no difference."""
        return self._replay(effects, nsim, substeps(effects, self.simulated.base_step_s))

    def changed_by_half_the_step(self, parameters: np.ndarray, parts: int = 1) -> np.ndarray:
        """Return the change of the whitened residuals (n_r,) at parameters (p,) by halving a step in ``parts``."""
        here, finer = (
            self.whitened(*self._replay((), 1, n).run_effects(parameters[None], []))[0]
            for n in (parts, 2 * parts)
        )
        return np.asarray(finer - here)

    def _replay(self, effects: Sequence[Placed], nsim: int, parts: int) -> SystemReplay:
        """Return a simulation whose time step is divided into parts."""
        setup = replace(self.simulated.setup(parts), settled=self.settled)
        steps = self.measured.time_s[0] + setup.timestep * np.arange(len(setup.commands))
        context = replace(self.context, step_time_s=steps, held_out=self.held_out)
        return SystemReplay(setup, effects, context, self.scales, nsim)

    def raw(self, paths: np.ndarray, joints: np.ndarray) -> np.ndarray:
        """Residuals (m, n, c), simulated minus measured; what stands in gaps counts for nothing (`Whitening`)."""
        error = np.concatenate([paths - self.measured.observed, joints - self.measured.logged], axis=2)
        return without_gaps(error, self._known)

    @property
    def _known(self) -> np.ndarray:
        """Mask (n, c) of the samples that were measured, by channel."""
        return np.asarray(np.isfinite(np.hstack([self.measured.observed, self.measured.logged])))

    def j(self, paths: np.ndarray) -> np.ndarray:
        """Plain cost (m,) of simulated observations (m, n, c)."""
        return self.cost(paths)

    def whiten(self, error: np.ndarray) -> np.ndarray:
        """Residuals (m, n_r) whose squares sum to chi-squared, of residuals (m, n, c)."""
        return self._whitening.apply(error)

    def whitened(self, paths: np.ndarray, joints: np.ndarray) -> np.ndarray:
        """Residuals (m, n_r) whose squares sum to chi-squared; NaN where a simulation failed."""
        return self.whiten(self.raw(paths, joints))

    def standing(self, error: np.ndarray) -> np.ndarray:
        """Mean square (m,) of residuals (m, n, c) before anything moves, in units of its noise."""
        first = slice(None, self.context.start)
        usual = np.mean(self.noise[:, first] ** 2, axis=(0, 1)) + self.measured.floor**2
        usual = np.maximum(usual, self.measured.repeated**2)
        return np.asarray(np.mean(error[:, first] ** 2 / usual, axis=(1, 2)))

    def as_held_out(self) -> SystemEvidence:
        """The same trial as the one that is not fitted."""
        return replace(self, held_out=True)

    def as_settled(self) -> SystemEvidence:
        """The same trial of a machine that starts in static equilibrium."""
        return replace(self, settled=True)

    def with_scales(self, scales: Scales) -> SystemEvidence:
        """The same trial with other units of the effects' parameters."""
        return replace(self, scales=scales)

    def adapted(self, parameters: np.ndarray) -> SystemEvidence:
        """The same trial with the effects' parameters in units of a plain fit (p,) of it."""
        replay = self.replay([], 1)
        impedance = replay._impedance(parameters[None])
        model = replay.model
        data = mujoco.MjData(model)
        data.qpos[:] = replay._start[0]
        mujoco.mj_forward(model, data)
        mass = np.zeros((model.nv, model.nv))
        mujoco.mj_fullM(model, data, mass)
        dofs = [model.joint(name).dofadr[0] for name in self.system.axis_joints]
        inertia = 1 / np.diag(np.linalg.inv(mass))[dofs]
        force = self._typical_force(replay)
        k = np.maximum(impedance.k[0], force / self.scales.q)
        d = np.maximum(impedance.d[0], 0.05 * k * self.scales.q / self.scales.v)
        return replace(self, scales=replace(self.scales, k=k, d=d, inertia=inertia))

    def _typical_force(self, replay: SystemReplay) -> np.ndarray:
        """Large force (axes,) on each axis, imposed or measured where the motion is imposed; 0 where there is none."""
        system = self.system
        forces: dict[str, np.ndarray] = {}
        if system.drive.by == "force":
            forces = dict(zip(system.drive.columns, replay._commands[0].T, strict=True))
        for output, seen in zip(system.outputs[::-1], self.measured.observed.T[::-1], strict=False):
            if output.quantity == "force":
                forces[output.joint] = seen[np.isfinite(seen)]
        own = [np.abs(forces.get(joint, np.zeros(1))) for joint in system.axis_joints]
        return np.array([np.percentile(force, 95) for force in own])

    def with_noise(self, parameters: np.ndarray, draws: int, seed: int) -> SystemEvidence:
        """The same trial, whitened by noise simulated at parameters (p,)."""
        nuisance = self._nuisance(parameters)
        error = self._noise((), parameters, (), draws, seed)
        rng = np.random.default_rng([seed, draws])
        drawn = np.tensordot(rng.standard_normal((draws, len(nuisance))), nuisance, axes=1)
        whitening = Whitening.of_noise(
            self.bands, error, drawn, nuisance, self.measured.floor, self.measured.repeated, self._known
        )
        out = replace(self, whitening=whitening, cache={**self.cache, "nuisance": nuisance})
        if not out.samples:
            known = np.isfinite(np.hstack([self.measured.observed, self.measured.logged])).mean()
            raise InputError(
                self.name,
                "",
                f"{100 * known:.3g} % of what was measured is known: no residual is left that noise does not fill",
                "outputs that are known for most of the recording",
                "Record it again.",
                "no_data",
            )
        return out

    def noise_of(
        self,
        effects: Sequence[Placed],
        parameters: np.ndarray,
        x: Sequence[np.ndarray],
        draws: int,
        seed: int,
    ) -> np.ndarray:
        """Whitened residuals (draws, n_r) of noise alone where effects with searched numbers x (p,) are the truth."""
        error = self._noise(effects, parameters, x, draws, seed)
        nuisance = self.cache["nuisance"]
        rng = np.random.default_rng([seed, draws])
        drawn = np.tensordot(rng.standard_normal((draws, len(nuisance))), nuisance, axes=1)
        return self.whiten(error + drawn)

    def shaken(self, draws: int, seed: int) -> Callable[[np.ndarray], np.ndarray]:
        """Residuals (draws, n, c) by noise of the drive, as a function of parameters (p,)."""
        replay = self._shaken_replay((), draws, seed)
        return lambda parameters: self._apart(replay, parameters, (), draws)

    def _shaken_replay(self, effects: Sequence[Placed], draws: int, seed: int) -> SystemReplay:
        replay = self.replay(effects, draws + 1)
        if self.simulated.shaken:
            parts = substeps(effects, self.simulated.base_step_s)
            for i in range(draws):
                replay.set_command(i + 1, *self.simulated.draw(seed, i, parts))
        return replay

    def _apart(
        self, replay: SystemReplay, parameters: np.ndarray, x: Sequence[np.ndarray], draws: int
    ) -> np.ndarray:
        alike = [np.tile(part, (draws + 1, 1)) for part in (parameters, *x)]
        paths, joints = replay.run_effects(alike[0], alike[1:])
        return np.concatenate([paths[1:] - paths[:1], joints[1:] - joints[:1]], axis=2)

    def _noise(
        self,
        effects: Sequence[Placed],
        parameters: np.ndarray,
        x: Sequence[np.ndarray],
        draws: int,
        seed: int,
    ) -> np.ndarray:
        """Residuals (draws, n, c) of a perfect model by noise of drive and channels."""
        rng = np.random.default_rng([seed, draws, 1])
        own = self.measured.sd * rng.standard_normal((draws, len(self.measured.time_s), self.channels))
        if not self.simulated.shaken:
            return -own
        replay = self._shaken_replay(effects, draws, seed)
        return self._apart(replay, parameters, x, draws) - own

    def _nuisance(self, parameters: np.ndarray) -> np.ndarray:
        """Change of the residuals (k, n, c) by one SD of each per-trial nuisance parameter: start, rest pose, zeros."""
        rest = next(e for e in EFFECTS if e.name == "preload" and not e.form)
        places = [w for w in rest.places(self.system) if self.measured.rest_sd[w.axis] > 0]
        effects = [Placed(rest, where, self.scales) for where in places]
        starts = [(j, sd, False) for j, sd in self.measured.start_sd.items()]
        starts += [(j, sd, True) for j, sd in self.measured.start_rate_sd.items()]
        m = 1 + len(places) + len(starts)
        replay = self.replay(effects, m)
        x = [np.zeros((m, 1)) for _ in effects]
        for i, placed in enumerate(effects):
            x[i][1 + i] = self.measured.rest_sd[placed.where.axis] / placed.values(np.ones((1, 1)))
        for i, (joint, sd, rate) in enumerate(starts):
            replay.shift_start(1 + len(places) + i, joint, sd, rate=rate)
        paths, joints = replay.run_effects(np.tile(parameters, (m, 1)), x)
        both = np.concatenate([paths, joints], axis=2)
        return np.concatenate([np.nan_to_num(both[1:] - both[:1]), self._moved_zeros()])

    def _moved_zeros(self) -> np.ndarray:
        """Change of the residuals (k, n, c) by one SD of the zero of each channel that has none of its own."""
        zero_sd = self.measured.zero_sd
        moved = np.flatnonzero(zero_sd)
        out = np.zeros((len(moved), len(self.measured.time_s), self.channels))
        out[np.arange(len(moved)), :, moved] = zero_sd[moved, None]
        return out

    def with_spikes(self, paths: np.ndarray) -> SystemEvidence:
        """The same trial with samples marked where observations jump out of simulated ones (n, c); self for none."""
        found = self._jumps(paths - self.measured.observed) | self.context.spikes
        if not (found & ~self.context.spikes).any():
            return self
        return replace(self, context=replace(self.context, spikes=found))

    def _jumps(self, error: np.ndarray) -> np.ndarray:
        """Return where residuals (n, c) stand out, in stretches that hold something faster than the system moves."""
        whole = signals.bridged(error)
        fast = whole - signals.lowpass(whole, self.rate_hz, min(self.system.band_hz, 0.4 * self.rate_hz), 4)
        out, sudden = (self._stands_out(values) & np.isfinite(error) for values in (whole, fast))
        for c in range(error.shape[1]):
            stretch, _ = label(out[:, c])
            out[:, c] = np.isin(stretch, np.unique(stretch[sudden[:, c] & out[:, c]])) & out[:, c]
        return np.asarray(out)

    def _stands_out(self, values: np.ndarray) -> np.ndarray:
        usual = np.median(np.abs(values - np.median(values, axis=0)), axis=0) / 0.6745
        limit = self.settings["spike_sd"] * np.hypot(usual, self.measured.observed_sd)
        return np.asarray(np.abs(values) > limit)

    @property
    def noise_source(self) -> str:
        """Source of the noise floor, in words."""
        return "white noise of the channels, simulated through the plant"

    @property
    def plain_samples(self) -> float:
        """Every sample of every observed channel."""
        return float(self.measured.observed.size)

    def floor_draws(self) -> np.ndarray:
        """Plain cost (draws,) of noise alone."""
        c = self.measured.observed.shape[1]
        return self.cost.energy(self.noise[:, :, :c])

    def residual_sd(self) -> dict[str, float]:
        """RMS of what noise alone leaves of each channel, in its unit."""
        rms = np.sqrt(np.mean(self.noise**2, axis=(0, 1)))
        return {name: float(value) for name, value in zip(self.measured.names, rms, strict=True)}

    def axis_shares(self, paths: np.ndarray) -> dict[str, float]:
        """Share of the gap by coordinate of the interface, of simulated observations (n, c)."""
        c = self.measured.observed.shape[1]
        to_axes = self.measured.to_axes

        def coordinates(error: np.ndarray) -> np.ndarray:
            return np.asarray(np.einsum("...tc,tac->...ta", error, to_axes))

        error = np.nan_to_num(paths - self.measured.observed)
        floor = np.mean(coordinates(self.noise[:, :, :c]) ** 2, axis=(0, 1))
        excess = np.mean(coordinates(error) ** 2, axis=0) / np.maximum(floor, 1e-30) - 1
        return _shares(dict(zip(self.system.axis_names, excess.tolist(), strict=True)))

    def locate(self, paths: np.ndarray, explained: np.ndarray | None) -> dict[str, Any]:
        """Spread of the gap of simulated observations (n, c) over channels, time, frequency and regime."""
        c = self.measured.observed.shape[1]
        error = np.nan_to_num(paths - self.measured.observed) / self.cost.scale
        noise = self.noise[:, :, :c] / self.cost.scale
        excess = error**2 - np.mean(noise**2, axis=0)
        spans = np.array_split(excess.sum(axis=1), _TIME_SPANS)
        time = self.measured.time_s
        ends = np.linspace(time[0], time[-1], _TIME_SPANS + 1)
        times = _shares({str(i): float(s.sum()) for i, s in enumerate(spans)})
        channels = dict(zip(self.measured.names[:c], excess.sum(axis=0).tolist(), strict=True))
        changed = excess.sum(axis=1)
        if explained is not None:
            changed = np.sum(((paths - explained) / self.cost.scale) ** 2, axis=1)
        return {
            "channels": _shares(channels),
            "times": [
                {"from_s": float(a), "to_s": float(b), "share": share}
                for a, b, share in zip(ends[:-1], ends[1:], times.values(), strict=True)
            ],
            "bands_hz": self._bands_of(error, noise),
            "regimes": self._regimes(changed),
        }

    def _bands_of(self, error: np.ndarray, noise: np.ndarray) -> list[dict[str, Any]]:
        power = np.sum(dct(error, axis=0, norm="ortho") ** 2, axis=1)
        floor = np.mean(np.sum(dct(noise, axis=1, norm="ortho") ** 2, axis=2), axis=0)
        hz = np.arange(len(power)) * self.rate_hz / (2 * len(power))
        edges = self.bands.edges
        sums = {}
        for low, high in pairwise(edges):
            inside = (hz >= low) & (hz < high)
            sums[f"{low:g}"] = float(np.sum(power[inside] - floor[inside]))
        shares = _shares(sums).values()
        return [
            {"from_hz": low, "to_hz": high, "share": share}
            for (low, high), share in zip(pairwise(edges), shares, strict=True)
        ]

    def _regimes(self, energy: np.ndarray) -> list[dict[str, Any]]:
        """Share of the gap by amplitude and speed of the interface's motion, largest first."""
        amplitude = np.linalg.norm(self.context.coordinates / self.scales.q, axis=1)
        speed = np.linalg.norm(self.context.rates / self.scales.v, axis=1)
        large, fast = amplitude > np.median(amplitude), speed > np.median(speed)
        sums = {
            f"{'large' if a else 'small'} amplitude, {'fast' if s else 'slow'}": float(
                energy[(large == a) & (fast == s)].sum()
            )
            for a in (True, False)
            for s in (True, False)
        }
        return [
            {"bin": name, "share": share}
            for name, share in sorted(_shares(sums).items(), key=lambda item: -item[1])
        ]

    def traces(self, plain: np.ndarray, with_effect: np.ndarray) -> dict[str, np.ndarray]:
        """Return columns (n,): time [s], and observations (n, c) measured, plain and with effect."""
        columns = {"time_s": self.measured.time_s}
        kinds = {"measured": self.measured.observed, "plain": plain, "with_effect": with_effect}
        for kind, values in kinds.items():
            for i, name in enumerate(self.measured.names[: values.shape[1]]):
                columns[f"{kind}_{name}"] = values[:, i]
        return columns


def _shares(values: Mapping[str, float]) -> dict[str, float]:
    """Positive parts, normalised to 1; all 0 where nothing stands out of the noise."""
    positive = {key: max(value, 0.0) for key, value in values.items()}
    total = sum(positive.values())
    return {key: (v / total if total > 0 else 0.0) for key, v in positive.items()}
