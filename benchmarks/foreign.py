"""Is a cause named in a system that is not ours? The Bouc-Wen and EMPS benchmarks of nonlinearbenchmark.org.

    python benchmarks/foreign.py --out foreign.json

Both are written here as equations, from their published descriptions and constants, with integrators of their own, and
diagnosed by the machinery of `snakemake diagnosis`: the same catalogue entries, screening, joint refits, held-out trial
and decision. A system of one axis is driven by a force, so its plant is one slide with the strap's spring, and effects
that need a robot, a pelvis or a second axis stay out. Each system is diagnosed twice, with its nonlinearity and with it
switched off; prints a table.

Sources: J.P. Noël, M. Schoukens, "Hysteretic benchmark with a dynamic nonlinearity", Workshop on Nonlinear System
Identification Benchmarks, Brussels 2016; A. Janot, M. Gautier, M. Brunot, "Data set and reference models of EMPS",
Workshop on Nonlinear System Identification Benchmarks, Eindhoven 2019.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

# two threads of BLAS beside another process cost a hundred times what they save
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import mujoco
import numpy as np
from mujoco.batch import Batch
from scipy.fft import dct
from scipy.interpolate import make_interp_spline
from scipy.signal.windows import tukey

ROOT = Path(__file__).parents[1]
sys.path.insert(0, str(ROOT / "workflow"))

from real2sim import signals
from real2sim.configuration import validated
from real2sim.diagnosis.attribute import attribute
from real2sim.diagnosis.decide import Decision, decide
from real2sim.diagnosis.refit import JointResiduals, refit
from real2sim.diagnosis.search import Pair
from real2sim.diagnosis.stage import candidates_of
from real2sim.effects.base import Fields, InterfaceImpedance, Placed, Scales
from real2sim.effects.catalogue import EFFECTS
from real2sim.effects.chains import Context
from real2sim.inference.parameters import PARAMETERS, Bounds
from real2sim.system.description import shipped_system
from real2sim.system.plant import servo_gains

# A slide that is moved along a path: its mass [kg], what its ends are not trusted for [samples], its band [Hz]
IMMENSE, EDGE, BAND_HZ = 1e7, 12, (3.0, 120.0)
# Effects of the whole system that make sense without a robot, a pelvis and a second axis
_WHOLE = ("added_mass", "sync_offset", "clock_drift", "filter_lag")
# Whose axis tx the one axis is
_STRAP = shipped_system("strap")
_K, _D = PARAMETERS.index("k_tx"), PARAMETERS.index("d_tx")


@dataclass
class Record:
    """One trial of a one-axis system.

    ``time_s`` (n,) of the measured positions (n,) [m]; ``force`` [N] maps times (m,) and a step [s] to the mean force
    around each time; ``noise_m`` SD of the positions.
    """

    time_s: np.ndarray
    position: np.ndarray
    force: Callable[[np.ndarray, float], np.ndarray]
    noise_m: float


@dataclass
class System:
    """A benchmark: its two trials, known mass [kg], bounds of stiffness and damping, step [s], right answers.

    ``moved``: the plant is moved along the measured path and gives a force, else it is given the force and moves.
    """

    name: str
    train: Record
    held_out: Record
    mass: float
    stiffness: tuple[float, float]
    damping: tuple[float, float]
    step_s: float
    cutoff_hz: float
    right: tuple[str, ...]
    moved: bool = False


class OneAxisReplay:
    """A mass on one slide, with the strap's spring and damper along tx and some effects; see `EffectReplay`."""

    def __init__(self, evidence: OneAxisEvidence, effects: Sequence[Placed], nsim: int):
        self.effects, self._evidence = tuple(effects), evidence
        h = evidence.step_s / max([1, *(placed.effect.plant.substeps for placed in effects)])
        record = evidence.record
        self._stride = round((record.time_s[1] - record.time_s[0]) / h)
        steps = (len(record.time_s) - 1) * self._stride + 1
        time_s = record.time_s[0] + h * np.arange(steps)
        self.model = self._plant(h)
        self._batch = Batch(self.model, nsim, 1)
        self._context = evidence.context(time_s)
        self._control = np.zeros((nsim, steps, self.model.nu))
        self._control[:, :, 0] = record.force(time_s, h)
        self._joint = self.model.joint("strap_tx").id
        self._inertia = np.ones(self.model.nv)

    def _plant(self, h: float) -> mujoco.MjModel:
        spec = mujoco.MjSpec()
        spec.option.timestep, spec.option.integrator = h, mujoco.mjtIntegrator.mjINT_EULER
        spec.option.disableflags |= mujoco.mjtDisableBit.mjDSBL_GRAVITY | mujoco.mjtDisableBit.mjDSBL_CONTACT
        body = spec.worldbody.add_body(
            name="interface", mass=self._evidence.mass, inertia=[1, 1, 1], explicitinertial=True
        )
        body.add_joint(name="strap_tx", type=mujoco.mjtJoint.mjJNT_SLIDE, axis=[1, 0, 0])
        self._drive(spec)
        spec.add_sensor(
            type=mujoco.mjtSensor.mjSENS_JOINTPOS, objtype=mujoco.mjtObj.mjOBJ_JOINT, objname="strap_tx"
        )
        for placed in self.effects:
            placed.effect.plant.build(spec, placed.where)
        return spec.compile()

    def _drive(self, spec: mujoco.MjSpec) -> None:
        """The first actuator, which makes it move."""
        spec.add_actuator(name="force", trntype=mujoco.mjtTrn.mjTRN_JOINT, target="strap_tx").set_to_motor()

    def run_effects(self, parameters: np.ndarray, x: Sequence[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
        """Positions (m, n, 2, 3) [m] along x of both markers, for strap parameters (m, 12) and searched numbers."""
        m, h = len(parameters), self.model.opt.timestep
        fields = Fields(self._batch, self.model, m, self._evidence.scales, _STRAP)
        impedance = InterfaceImpedance(parameters[:, :6], parameters[:, 6:])
        dof = fields.dof(0)
        fields["jnt_stiffness"][:, self._joint] = parameters[:, _K]
        fields["dof_damping"][:, dof] = parameters[:, _D]
        # centred steps, as the plant of the interface has them (coupling/plant.py)
        fields["dof_armature"][:, dof] = -parameters[:, _D] * h / 2
        fields["body_mass"][:] = self.model.body_mass
        self._damping = parameters[:, _D]
        values = [placed.values(part) for placed, part in zip(self.effects, x, strict=True)]
        self._control[:m, :, 1:] = 0
        for placed, value in zip(self.effects, values, strict=True):
            plant = placed.effect.plant
            plant.set(fields, placed.where, impedance, value)
            force = plant.force(value, self._context, placed.where, impedance)
            if force is not None:
                self._control[:m, :, plant.columns(self.model, placed.where)] += force
        # MuJoCo takes the inertia of a lone slide as it was compiled
        body = self.model.body("interface").id
        fields["dof_M0"][:, dof] = fields["body_mass"][:, body] + fields["dof_armature"][:, dof]
        paths = np.zeros((m, len(self._context.time_s), 2, 3))
        paths[:, :, :, 0] = self._roll(m)[:, :, None]
        for placed, value in zip(self.effects, values, strict=True):
            if placed.effect.chains.output is not None and np.isfinite(paths).all():
                paths = placed.effect.chains.output(paths, value, self._context)
        return paths, np.zeros((m, paths.shape[1], 0))

    def _roll(self, m: int) -> np.ndarray:
        """What is compared with the measurement (m, n)."""
        return self._rollout(m, (0.0, 0.0), ("sensordata",))["sensordata"][:, :: self._stride, 0]

    def _rollout(self, m: int, start: tuple[float, float], record: tuple[str, ...]) -> dict[str, np.ndarray]:
        batch, ids = self._batch, np.arange(m)
        batch.reset(ids, stage=mujoco.mjtStage.mjSTAGE_NONE)
        batch.bind("qpos")[:m], batch.bind("qvel")[:m] = 0, 0
        batch.bind("qpos")[:m, self._joint], batch.bind("qvel")[:m, self._joint] = start
        out = batch.rollout(
            self._control.shape[1], self._control[:m], record=record, ids=None if m == batch.nsim else ids
        )
        failed = batch.warning[:m].any(axis=tuple(range(1, batch.warning.ndim)))
        for values in out.values():
            values[failed] = np.nan
        return out


class MovedReplay(OneAxisReplay):
    """The same slide moved along the measured path; what comes out is the force that it takes, [N] along x.

    A driven resonance forgets nothing: its replay is far from the measurement before a search has begun. The force for
    a motion is as near as the law is. The path is imposed as the pelvis' is (coupling/plant.py): an immense mass on a
    servo with feed-forward.
    """

    def __init__(self, evidence: OneAxisEvidence, effects: Sequence[Placed], nsim: int):
        super().__init__(evidence, effects, nsim)
        h, record = self.model.opt.timestep, evidence.record
        path = make_interp_spline(record.time_s, record.position, k=5)
        t = record.time_s[0] + h * np.arange(self._control.shape[1])
        command = path(t) + 2 * h * path(np.maximum(t - h / 2, t[0]), 1) + 2 * h * h * path(t, 2)
        self._control[:, :, 0] = command
        self._start = float(path(t[0])), float(path(t[0], 1))
        self._acceleration = path(record.time_s, 2)
        self._inertial = evidence.mass * self._acceleration

    def _drive(self, spec: mujoco.MjSpec) -> None:
        h = spec.option.timestep
        spec.body("interface").mass = IMMENSE
        kp, kd = (IMMENSE * gain for gain in servo_gains(h))
        actuator = spec.add_actuator(name="path", trntype=mujoco.mjtTrn.mjTRN_JOINT, target="strap_tx")
        actuator.gainprm = [kp] + [0] * 9
        actuator.biastype = mujoco.mjtBias.mjBIAS_AFFINE
        actuator.biasprm = [0, -kp, -kd] + [0] * 7

    def _roll(self, m: int) -> np.ndarray:
        out = self._rollout(m, self._start, ("qfrc_passive", "qfrc_constraint", "actuator_force"))
        dof = int(self.model.joint("strap_tx").dofadr[0])
        force = out["qfrc_passive"][:, :, dof] + out["qfrc_constraint"][:, :, dof]
        force = force + out["actuator_force"][:, :, 1:].sum(axis=2)
        # the rate of a step is that of half a step before
        late = self._damping[:, None] * self.model.opt.timestep / 2 * self._acceleration
        return self._inertial - force[:, :: self._stride] + late


class OneAxisEvidence:
    """What `JointResiduals` asks of evidence, of a one-axis trial whose noise is white."""

    held_out = False

    def __init__(self, system: System, record: Record):
        self.record, self.mass, self.step_s = record, system.mass, system.step_s
        self._rate = rate = 1 / (record.time_s[1] - record.time_s[0])
        self._moved, self._force = system.moved, record.force(record.time_s, system.step_s)
        n = len(record.time_s) - 2 * EDGE
        hz = np.arange(n) * rate / (2 * n)
        self._taper = tukey(n, 0.5) / np.sqrt(np.mean(tukey(n, 0.5) ** 2))
        self._band, self._sd = (hz > BAND_HZ[0]) & (hz < BAND_HZ[1]), np.ones(n)
        self._q = signals.lowpass(record.position[:, None], rate, system.cutoff_hz, 4)[:, 0]
        self._v = np.gradient(self._q, record.time_s)
        ones = np.ones(6)
        self.scales = Scales(ones * _large(self._q), ones * _large(self._v), ones, ones, ones * system.mass)

    def replay(self, effects: list[Placed], nsim: int, *, coarse: bool = False) -> OneAxisReplay:
        """A replay of this trial with effects; its step is that of the system, ``coarse`` or not."""
        return (MovedReplay if self._moved else OneAxisReplay)(self, effects, nsim)

    def noise_through(
        self,
        effects: Sequence[Placed],
        parameters: np.ndarray,
        x: Sequence[np.ndarray],
        draws: int,
        seed: int,
    ) -> np.ndarray:
        """Chi-squared (draws,) that noise leaves: here it goes by no plant, whatever the effects."""
        return np.full(draws, float(self.samples))

    @property
    def samples(self) -> int:
        """Number of whitened residuals."""
        return len(self.record.position) if not self._moved else int(self._band.sum())

    def j(self, paths: np.ndarray) -> np.ndarray:
        """Mean square (m,) of the plain residuals, in place of J."""
        return np.mean((paths[:, :, 0, 0] - self.record.position) ** 2, axis=1)

    def whitened(self, paths: np.ndarray, joints: np.ndarray) -> np.ndarray:
        """Residuals (m, n_r) whose squares sum to chi-squared."""
        if not self._moved:
            return (paths[:, :, 0, 0] - self.record.position) / self.record.noise_m
        # tapered: the noise of a force grows with the square of the frequency and would leak downward
        error = (paths[:, EDGE:-EDGE, 0, 0] - self._force[EDGE:-EDGE]) * self._taper
        return (dct(error, axis=1, norm="ortho") / self._sd)[:, self._band]

    def set_noise(self, stiffness: float, damping: float) -> None:
        """Weigh frequencies by what noise of the path does to the force of a plain plant [N/m, Ns/m]."""
        n = len(self.record.time_s) - 2 * EDGE
        w = np.pi * np.arange(n) / n * self._rate
        dynamic = np.abs(stiffness - self.mass * w**2 + 1j * w * damping)
        # near the resonance forces cancel in the plain plant alone: no frequency is trusted more than a tenth of k
        self._sd = self.record.noise_m * np.hypot(dynamic, 0.1 * stiffness)

    def context(self, step_time_s: np.ndarray) -> Context:
        """What chains and planned forces are computed from."""
        n = len(self.record.time_s)
        still, along = np.tile(np.eye(3), (n, 1, 1)), np.zeros((n, 6))
        markers = np.zeros((n, 2, 3))
        markers[:, :, 0] = self.record.position[:, None]
        q, v = along.copy(), along.copy()
        q[:, 0], v[:, 0] = self._q, self._v
        return Context(
            self.record.time_s,
            step_time_s,
            still,
            along[:, :3],
            still,
            2,
            self.mass,
            markers,
            np.zeros((n, 2), bool),
            q,
            v,
            np.eye(3),
            np.zeros(3),
            np.zeros((4, 3)),
            np.zeros((2, 3)),
            np.zeros(3),
        )


def _large(values: np.ndarray) -> float:
    return float(np.percentile(np.abs(values), 95))


def places(scales: Scales, moved: bool = False) -> list[Placed]:
    """Entries of the catalogue that a system of one axis can have."""
    return [
        Placed(effect, where, scales)
        for effect in EFFECTS
        for where in effect.places(_STRAP)
        if where.axes == (0,) or (effect.name in _WHOLE and not (moved and effect.name == "added_mass"))
        if not effect.plant.planned or where.axes == (0,)
    ]


def diagnosed(system: System, settings: dict, progress: Callable[[str], None]) -> tuple[Decision, Any, Any]:
    """Decision, attribution and plain fit of a system."""
    train, held_out = OneAxisEvidence(system, system.train), OneAxisEvidence(system, system.held_out)
    one = np.ones(12)
    lower, upper = one.copy(), one.copy()
    (lower[_K], upper[_K]), (lower[_D], upper[_D]) = system.stiffness, system.damping
    bounds = Bounds(lower, upper)
    middle = np.sqrt(lower * upper)
    for evidence in (train, held_out):
        evidence.set_noise(middle[_K], middle[_D])
    z = _plain(train, bounds)
    for evidence in (train, held_out):
        evidence.set_noise(*np.exp(z[[_K, _D]]))
    z = _plain(train, bounds)
    # a spring that is hardly there is no measure of forces: the force that moves the mass is
    force = _large(system.train.force(system.train.time_s, system.step_s))
    k = max(float(np.exp(z[_K])), force / train.scales.q[0])
    scales = Scales(
        train.scales.q, train.scales.v, one[:6] * k, one[:6] * np.exp(z[_D]), train.scales.inertia
    )
    train.scales = held_out.scales = scales
    held_out.held_out = True
    pair = Pair(train, held_out, bounds)
    found = attribute(pair, z, settings["search"], progress, places(scales, system.moved))
    plain, sets = candidates_of(found, settings)
    return decide(plain, sets, found.samples, settings["calibration"]), found, z


def _plain(evidence: OneAxisEvidence, bounds: Bounds) -> np.ndarray:
    """ln-parameters (12,) of the best of some plain fits: a resonance has many local optima."""
    problem = JointResiduals(evidence, (), bounds)
    lower, upper = np.log(bounds.lower), np.log(bounds.upper)
    starts = np.tile((lower + upper) / 2, (64, 1))
    starts[:, _K] = np.repeat(np.linspace(lower[_K], upper[_K], 16), 4)
    starts[:, _D] = np.tile(np.linspace(lower[_D], upper[_D], 6)[1:-1], 16)
    costs = np.sum(problem.many(starts) ** 2, axis=1)
    fits = [
        refit(problem, starts[i], iterations=30, ftol=1e-6)
        for i in np.argsort(np.nan_to_num(costs, nan=1e300))[:3]
    ]
    return min(fits, key=lambda fit: fit[1])[0]


# -------------------- Bouc-Wen: m y'' + c y' + k y + z = u, z' = a y' - b (g |y'| |z|^(n-1) z + d y' |z|^n), n = 1

BOUC_WEN = {"m": 2.0, "c": 10.0, "k": 5e4, "a": 5e4, "b": 1e3, "g": 0.8, "d": -1.1}
BOUC_WEN_RATE_HZ, BOUC_WEN_NOISE_M = 750.0, 8e-6
_FINE = 40  # integrator steps per sample, 30 kHz


def multisine(
    rms: float, low_hz: float, high_hz: float, samples: int, seed: int
) -> Callable[[np.ndarray], np.ndarray]:
    """Random-phase multisine [N] of flat amplitude, one period of ``samples`` at 750 Hz."""
    period = samples / BOUC_WEN_RATE_HZ
    lines = np.arange(np.ceil(low_hz * period), np.floor(high_hz * period) + 1)
    phases = np.random.default_rng(seed).uniform(0, 2 * np.pi, len(lines))
    amplitude = rms * np.sqrt(2 / len(lines))

    def force(t: np.ndarray) -> np.ndarray:
        out = np.zeros_like(t)
        for line, phase in zip(lines, phases, strict=True):
            out += np.cos(2 * np.pi * line / period * t + phase)
        return amplitude * out

    return force


def sweep(
    amplitude: float, low_hz: float, high_hz: float, duration_s: float
) -> Callable[[np.ndarray], np.ndarray]:
    """Linear sine sweep [N]."""
    rate = (high_hz - low_hz) / duration_s
    return lambda t: amplitude * np.sin(2 * np.pi * (low_hz * t + rate * t * t / 2))


def bouc_wen(force: Callable[[np.ndarray], np.ndarray], samples: int, hysteretic: bool, seed: int) -> Record:
    """The benchmark's system from rest, by Runge-Kutta of fourth order at 30 kHz, and noise on the output."""
    p = BOUC_WEN
    h = 1 / (BOUC_WEN_RATE_HZ * _FINE)
    u = force(np.arange(2 * samples * _FINE + 2) * h / 2)
    a, b = (p["a"], p["b"]) if hysteretic else (0.0, 0.0)

    def slope(y: float, v: float, z: float, f: float) -> tuple[float, float, float]:
        zd = a * v - b * (p["g"] * abs(v) * z + p["d"] * v * abs(z))
        return v, (f - p["c"] * v - p["k"] * y - z) / p["m"], zd

    y = v = z = 0.0
    out = np.empty(samples)
    for i in range(samples * _FINE):
        if i % _FINE == 0:
            out[i // _FINE] = y
        f0, f1, f2 = u[2 * i], u[2 * i + 1], u[2 * i + 2]
        k1 = slope(y, v, z, f0)
        k2 = slope(y + h / 2 * k1[0], v + h / 2 * k1[1], z + h / 2 * k1[2], f1)
        k3 = slope(y + h / 2 * k2[0], v + h / 2 * k2[1], z + h / 2 * k2[2], f1)
        k4 = slope(y + h * k3[0], v + h * k3[1], z + h * k3[2], f2)
        y, v, z = (
            s + h / 6 * (w[0] + 2 * w[1] + 2 * w[2] + w[3])
            for s, w in zip((y, v, z), zip(k1, k2, k3, k4, strict=True), strict=True)
        )
    noise = BOUC_WEN_NOISE_M * np.random.default_rng(seed).standard_normal(samples)
    time_s = np.arange(samples) / BOUC_WEN_RATE_HZ
    return Record(time_s, out + noise, lambda t, step: force(t), BOUC_WEN_NOISE_M)


def bouc_wen_system(hysteretic: bool, samples: int = 1024, seed: int = 1) -> System:
    """Training on the benchmark's multisine (5-150 Hz, 50 N RMS), held out a sine sweep (20-50 Hz, 40 N)."""
    duration = samples / BOUC_WEN_RATE_HZ
    return System(
        "Bouc-Wen" if hysteretic else "Bouc-Wen, alpha = beta = 0",
        bouc_wen(multisine(50.0, 5.0, 150.0, samples, seed), samples, hysteretic, seed + 100),
        bouc_wen(sweep(40.0, 20.0, 50.0, duration), samples, hysteretic, seed + 200),
        BOUC_WEN["m"],
        (1e4, 4e5),
        (0.5, 500.0),
        1 / (4 * BOUC_WEN_RATE_HZ),
        200.0,
        ("hysteresis",) if hysteretic else ("none",),
        moved=True,
    )


# -------------------- EMPS: M q'' = gtau u - Fv q' - Fc sgn(q') - offset, u from a cascade of two gains at 1 kHz

EMPS = {"M": 95.1089, "Fv": 203.5034, "Fc": 20.3935, "offset": -3.1648}
EMPS_GTAU, EMPS_KP, EMPS_KV, EMPS_LIMIT_V = 35.15, 160.18, 243.45, 10.0
EMPS_CONTROL_S, EMPS_SAMPLE_S, EMPS_NOISE_M = 1e-3, 1e-2, 5e-5


def trapezoids(duration_s: float, targets: Sequence[float], speed: float, acceleration: float) -> np.ndarray:
    """Reference positions (n,) [m] at 1 kHz: from target to target with bounded speed and acceleration, with rests."""
    steps = round(duration_s / EMPS_CONTROL_S)
    q = v = 0.0
    out, goal, rest = np.empty(steps), 0, 0
    for i in range(steps):
        left = targets[goal % len(targets)] - q
        wanted = np.sign(left) * min(speed, np.sqrt(2 * acceleration * abs(left)))
        v += np.clip(wanted - v, -acceleration * EMPS_CONTROL_S, acceleration * EMPS_CONTROL_S)
        q += v * EMPS_CONTROL_S
        if abs(left) < 5e-4:
            rest += 1
            if rest > 150:
                goal, rest = goal + 1, 0
        out[i] = q
    return out


def emps(reference: np.ndarray, friction: bool, seed: int) -> Record:
    """The benchmark's system in its loop: exact sticking and slipping at 20 kHz, the drive's voltage held for 1 ms."""
    p, inner = EMPS, 20
    h = EMPS_CONTROL_S / inner
    fc = p["Fc"] if friction else 0.0
    q = v = 0.0
    positions, voltage = np.empty(len(reference)), np.empty(len(reference))
    for i, goal in enumerate(reference):
        positions[i] = q
        u = float(np.clip(EMPS_KV * (EMPS_KP * (goal - q) - v), -EMPS_LIMIT_V, EMPS_LIMIT_V))
        voltage[i] = u
        for _ in range(inner):
            # implicit in the friction: it takes at most what stops the mass within the step
            free = (v + h * (EMPS_GTAU * u - p["offset"]) / p["M"]) / (1 + h * p["Fv"] / p["M"])
            most = h * fc / p["M"] / (1 + h * p["Fv"] / p["M"])
            new = float(np.sign(free) * max(abs(free) - most, 0.0))
            q += h * (v + new) / 2
            v = new
    every = round(EMPS_SAMPLE_S / EMPS_CONTROL_S)
    noise = EMPS_NOISE_M * np.random.default_rng(seed).standard_normal(len(positions[::every]))
    total = np.concatenate([[0.0], np.cumsum(EMPS_GTAU * voltage - p["offset"])]) * EMPS_CONTROL_S
    edges = np.arange(len(total)) * EMPS_CONTROL_S

    def force(t: np.ndarray, step: float) -> np.ndarray:
        # the mean over a step about each time: the voltage jumps every millisecond
        ends = [np.clip(t + side * step / 2, 0, edges[-1]) for side in (-1, 1)]
        low, high = (np.interp(e, edges, total) for e in ends)
        return (high - low) / step

    time_s = np.arange(len(positions[::every])) * EMPS_SAMPLE_S
    return Record(time_s, positions[::every] + noise, force, EMPS_NOISE_M)


def emps_system(friction: bool, duration_s: float = 12.0, seed: int = 1) -> System:
    """Training on slow strokes of 0.2 m, held out on faster and shorter ones; the offset of the drive is known."""
    slow = trapezoids(duration_s, (0.2, 0.0, 0.1, 0.0), 0.10, 0.4)
    fast = trapezoids(duration_s, (0.12, 0.04, 0.08, 0.0), 0.16, 1.0)
    return System(
        "EMPS" if friction else "EMPS, Fc = 0",
        emps(slow, friction, seed + 300),
        emps(fast, friction, seed + 400),
        EMPS["M"],
        (1e-2, 1e3),
        (20.0, 2000.0),
        2e-3,
        8.0,
        ("coulomb", "lugre") if friction else ("none",),
    )


# -------------------- the answers


def row_of(system: System, settings: dict, progress: Callable[[str], None]) -> dict[str, Any]:
    """One row of the table: verdict, probability, what the plain plant and the named set leave."""
    begun = time.process_time()
    decision, found, z = diagnosed(system, settings, progress)
    best = found.plain if decision.chosen is None else found.hypotheses[decision.chosen]
    ranked = sorted(decision.probabilities.items(), key=lambda item: -item[1])[:3]
    return {
        "system": system.name,
        "expected": list(system.right),
        "verdict": decision.verdict,
        "right": decision.verdict in system.right,
        "ambiguity_group": list(decision.group),
        "set": best.key,
        "probabilities": {name: p for name, p in ranked if p > 1e-3},
        "chi2_plain": list(found.plain.chi2),
        "chi2": list(best.chi2),
        "samples": list(found.samples),
        "k_plain": float(np.exp(z[_K])),
        "d_plain": float(np.exp(z[_D])),
        "k": float(np.exp(best.z[_K])),
        "d": float(np.exp(best.z[_D])),
        "parameters": {
            name: value
            for placed, x in zip(best.effects, best.split(), strict=True)
            for name, (value, _) in placed.named(x).items()
        },
        "runners_up": [
            [h.key, *map(float, h.chi2)] for h in sorted(found.hypotheses, key=lambda h: sum(h.chi2))[:6]
        ],
        "cpu_s": time.process_time() - begun,
    }


def main() -> int:
    """Diagnose both systems, with and without their nonlinearity."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--out", type=Path)
    parser.add_argument("--systems", nargs="*", default=["bouc-wen", "emps"])
    options = parser.parse_args()
    settings = validated({}, "config", Path("defaults"))["diagnosis"]
    makers = {"bouc-wen": bouc_wen_system, "emps": emps_system}
    rows = []
    for name in options.systems:
        for active in (True, False):
            system = makers[name](active)
            rows.append(
                row_of(system, settings, lambda text: print(f"  {text}", file=sys.stderr, flush=True))
            )
            print(json.dumps(rows[-1]["runners_up"]), file=sys.stderr)
    print(f"{'system':28} {'verdict':12} {'P':>5}  {'chi2/n plain':>16}  {'chi2/n best':>16}  right")
    for r in rows:
        n = r["samples"]
        plain, best = (
            [f"{c / m:.2f}" for c, m in zip(r[key], n, strict=True)] for key in ("chi2_plain", "chi2")
        )
        p = r["probabilities"].get(r["verdict"], 0.0)
        print(
            f"{r['system']:28} {r['verdict']:12} {p:5.2f}  {' '.join(plain):>16}  {' '.join(best):>16}  {r['right']}"
        )
        print(f"    {r['set'] or 'plain plant'}; {r['cpu_s']:.0f} s CPU")
    if options.out:
        options.out.write_text(json.dumps({"rows": rows}, indent=1) + "\n")
    return 0 if all(r["right"] for r in rows) else 1


if __name__ == "__main__":
    sys.exit(main())
