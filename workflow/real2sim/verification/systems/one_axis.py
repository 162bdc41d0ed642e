"""Recordings of two one-axis benchmarks of nonlinearbenchmark.org, written as equations: EMPS and Bouc-Wen.

EMPS is an electromechanical positioning system in its control loop: the motor force drives it, its position is
measured. Bouc-Wen is a mass on a hysteretic spring: its path is imposed, the force that this takes is measured.

Sources: A. Janot, M. Gautier, M. Brunot, "Data set and reference models of EMPS", Workshop on Nonlinear System
Identification Benchmarks, Eindhoven 2019; J.P. Noël, M. Schoukens, "Hysteretic benchmark with a dynamic
nonlinearity", Workshop on Nonlinear System Identification Benchmarks, Brussels 2016.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from real2sim.verification.systems.recordings import (
    OutputChain,
    Size,
    check_effect,
    describe_effect,
    raise_gradually,
    write_case,
)

_OUTPUT_EFFECTS = {
    "sync_offset": Size("offset", 0.010, "s"),
    "clock_drift": Size("drift", 2e-3, "1"),
    "filter_lag": Size("cutoff", 8.0, "Hz"),
}

# -------------------- EMPS: M q'' = F - Fv q' - Fc sgn(q') + offset; F from a cascade of two gains at 1 kHz

EMPS = {"mass": 95.1089, "viscous": 203.5034, "offset": 3.1648}
EMPS_GAIN_N_PER_V, EMPS_KP, EMPS_KV, EMPS_LIMIT_V = 35.15, 160.18, 243.45, 10.0
EMPS_RATE_HZ, EMPS_NOISE_M, EMPS_INNER_STEPS = 1000.0, 2e-5, 20
EMPS_EFFECTS = {
    "coulomb": Size("force", 20.3935, "N"),
    "quadratic_damping": Size("quadratic", 600.0, "Ns2/m2"),
    **_OUTPUT_EFFECTS,
}


def plan_trapezoids(
    duration_s: float, targets: Sequence[float], speed: float, acceleration: float, still_s: float = 0.6
) -> np.ndarray:
    """Return reference positions (n,) [m] at 1 kHz: still, then from target to target with rests between.

    ``speed`` [m/s] and ``acceleration`` [m/s^2] are the bounds of the motion.
    """
    h, steps = 1 / EMPS_RATE_HZ, round(duration_s * EMPS_RATE_HZ)
    q = v = 0.0
    out, goal, rest = np.zeros(steps), 0, 0
    for i in range(round(still_s * EMPS_RATE_HZ), steps):
        left = targets[goal % len(targets)] - q
        wanted = np.sign(left) * min(speed, np.sqrt(2 * acceleration * abs(left)))
        v += np.clip(wanted - v, -acceleration * h, acceleration * h)
        q += v * h
        if abs(left) < 5e-4:
            rest += 1
            if rest > 150:
                goal, rest = goal + 1, 0
        out[i] = q
    return out


def run_emps(reference: np.ndarray, coulomb: float, quadratic: float) -> tuple[np.ndarray, np.ndarray]:
    """Return positions (n,) [m] and motor forces (n,) [N], held for a millisecond each, of the controlled carriage.

    Dry friction of ``coulomb`` [N] sticks and slips exactly: within a step of 50 us it takes at most what stops the
    mass.
    """
    m, viscous, offset = EMPS["mass"], EMPS["viscous"], EMPS["offset"]
    h = 1 / EMPS_RATE_HZ / EMPS_INNER_STEPS
    q = v = 0.0
    positions, forces = np.empty(len(reference)), np.empty(len(reference))
    for i, goal in enumerate(reference.tolist()):
        positions[i] = q
        volt = EMPS_KV * (EMPS_KP * (goal - q) - v)
        force = EMPS_GAIN_N_PER_V * min(max(volt, -EMPS_LIMIT_V), EMPS_LIMIT_V)
        forces[i] = force
        for _ in range(EMPS_INNER_STEPS):
            inertia = m + h * (viscous + quadratic * abs(v))
            free = (m * v + h * (force + offset)) / inertia
            most = h * coulomb / inertia
            new = max(free - most, 0.0) + min(free + most, 0.0)
            q += h * (v + new) / 2
            v = new
    return positions, forces


def simulate_emps(effect: str | None, size: float, seed: int, out: Path, duration_s: float = 12.0) -> Path:
    """Write the recordings of an EMPS with an effect of `EMPS_EFFECTS` or with none; return ``out``.

    Columns: time_s, motor_force_N (held from each sample to the next), carriage_m. Without ``coulomb`` the carriage
    has no dry friction. ``duration_s`` is that of train and held_out.
    """
    check_effect(effect, EMPS_EFFECTS)
    chain = OutputChain.of(effect, size)
    coulomb = size if effect == "coulomb" else 0.0
    quadratic = size if effect == "quadratic_damping" else 0.0
    references = {
        "quiet": np.zeros(round(min(8.0, duration_s) * EMPS_RATE_HZ)),
        "train": plan_trapezoids(duration_s, (0.2, 0.0, 0.1, 0.0), 0.10, 0.4),
        "held_out": plan_trapezoids(duration_s, (0.12, 0.04, 0.08, 0.0), 0.16, 1.0),
    }
    tables = {}
    for i, (name, reference) in enumerate(references.items()):
        rng = np.random.default_rng([seed, i])
        positions, forces = run_emps(reference, coulomb, quadratic)
        time_s = np.arange(len(reference)) / EMPS_RATE_HZ
        seen = chain.apply(time_s, positions, time_s)
        noise = EMPS_NOISE_M * rng.standard_normal(len(time_s))
        tables[name] = {"time_s": time_s, "motor_force_N": forces, "carriage_m": seen + noise}
    truth = {
        "system": "emps",
        "seed": seed,
        "values": EMPS,
        "start": "equilibrium",
        **describe_effect(effect, size, EMPS_EFFECTS),
    }
    return write_case(out, tables, truth)


# -------------------- Bouc-Wen: F = m y'' + c y' + k y + z, z' = a y' - b (g |y'| z + d y' |z|)

BOUC_WEN = {"mass": 2.0, "damping": 10.0, "stiffness": 5e4}
# b [1/m], g and d of the benchmark; its a is 5e4 N/m, the typical size here
HYSTERESIS_B, HYSTERESIS_G, HYSTERESIS_D = 1e3, 0.8, -1.1
BOUC_WEN_RATE_HZ, BOUC_WEN_PATH_NOISE_M, BOUC_WEN_FORCE_NOISE_N = 750.0, 2e-8, 0.2
_FINE = 8  # evaluations of the imposed path per sample
BOUC_WEN_EFFECTS = {
    "hysteresis": Size("stiffness", 5e4, "N/m"),
    "slack": Size("half_width", 2e-4, "m"),
    "coulomb": Size("force", 3.0, "N"),
    "stiffening": Size("cubic", 2e9, "N/m3"),
    "preload": Size("rest_shift", 5e-4, "m"),
    "relaxation": Size("stiffness", 2e4, "N/m"),
    "quadratic_damping": Size("quadratic", 40.0, "Ns2/m2"),
    "added_mass": Size("mass", 0.3, "kg"),
    "sync_offset": Size("offset", 2e-3, "s"),
    "clock_drift": Size("drift", 2e-4, "1"),
    "filter_lag": Size("cutoff", 150.0, "Hz"),
}
RELAXATION_TIME_S = 0.05


@dataclass(frozen=True)
class ImposedPath:
    """A path (n,) [m] at times ``time_s`` (n,) [s], with its exact rate [m/s] and acceleration [m/s^2]."""

    time_s: np.ndarray
    position: np.ndarray
    rate: np.ndarray
    acceleration: np.ndarray


def impose_multisine(
    duration_s: float, rms_m: float, low_hz: float, high_hz: float, seed: int
) -> ImposedPath:
    """Return a random-phase multisine of flat spectrum that rises from standstill between 0.6 and 1.1 s.

    An RMS of 0 gives a mass that stands still.
    """
    time_s = np.arange(round(duration_s * BOUC_WEN_RATE_HZ) * _FINE) / (BOUC_WEN_RATE_HZ * _FINE)
    lines = np.arange(low_hz, high_hz + 0.25, 0.5)
    phases = np.random.default_rng(seed).uniform(0, 2 * np.pi, len(lines))
    w = 2 * np.pi * lines
    turns = np.outer(time_s, w) + phases
    amplitude = rms_m * np.sqrt(2 / len(lines))
    sine = amplitude * np.stack([np.sin(turns).sum(axis=1), np.cos(turns) @ w, -np.sin(turns) @ w**2], axis=0)
    # the envelope and its derivatives, of its polynomial
    x, rise = np.clip((time_s - 0.6) / 0.5, 0, 1), 0.5
    e = raise_gradually(time_s, 0.6, rise)
    e1 = 140 * x**3 * (1 - x) ** 3 / rise
    e2 = 420 * x**2 * (1 - x) ** 2 * (1 - 2 * x) / rise**2
    return ImposedPath(
        time_s,
        e * sine[0],
        e1 * sine[0] + e * sine[1],
        e2 * sine[0] + 2 * e1 * sine[1] + e * sine[2],
    )


def hysteretic_force(position: np.ndarray, stiffness: float) -> np.ndarray:
    """Return the Bouc-Wen force z (n,) [N] along a path (n,) [m], exact for paths that are monotone between samples."""
    out, z = np.zeros(len(position)), 0.0
    for i, dy in enumerate(np.diff(position).tolist()):
        left = dy
        for _ in range(2 if dy else 0):  # z may change its sign once within a step
            rate = HYSTERESIS_B * (
                HYSTERESIS_G * np.sign(left) + HYSTERESIS_D * (np.sign(z) or np.sign(left))
            )
            # dz/dy = stiffness - rate z
            grown = stiffness / rate + (z - stiffness / rate) * np.exp(-rate * left)
            if z * grown >= 0:
                z = grown
                break
            left -= np.log((rate * z - stiffness) / -stiffness) / rate
            z = 0.0
        out[i + 1] = z
    return out


def relaxing_force(path: ImposedPath, stiffness: float, time_constant_s: float) -> np.ndarray:
    """Return the force (n,) [N] of a Maxwell branch along a path, exact for a steady rate within each step."""
    out, held = np.zeros(len(path.position)), 0.0
    h = path.time_s[1] - path.time_s[0]
    decay = np.exp(-h / time_constant_s)
    gain = stiffness * time_constant_s * (1 - decay) / h
    for i, dy in enumerate(np.diff(path.position).tolist()):
        held = held * decay + gain * dy
        out[i + 1] = held
    return out


def bouc_wen_force(path: ImposedPath, effect: str | None, size: float) -> np.ndarray:
    """Return the force (n,) [N] that imposing the path takes, with one effect or none."""
    q, v = path.position, path.rate
    force = BOUC_WEN["mass"] * path.acceleration + BOUC_WEN["damping"] * v + BOUC_WEN["stiffness"] * q
    if effect == "hysteresis":
        force = force + hysteretic_force(q, size)
    elif effect == "slack":
        force = force - BOUC_WEN["stiffness"] * np.clip(q, -size, size)
    elif effect == "coulomb":
        force = force + size * np.sign(v)
    elif effect == "stiffening":
        force = force + size * q**3
    elif effect == "preload":
        force = force - BOUC_WEN["stiffness"] * size
    elif effect == "relaxation":
        force = force + relaxing_force(path, size, RELAXATION_TIME_S)
    elif effect == "quadratic_damping":
        force = force + size * np.abs(v) * v
    elif effect == "added_mass":
        force = force + size * path.acceleration
    return force


def simulate_bouc_wen(effect: str | None, size: float, seed: int, out: Path, duration_s: float = 6.0) -> Path:
    """Write the recordings of a Bouc-Wen system with an effect of `BOUC_WEN_EFFECTS` or with none; return ``out``.

    Columns: time_s, carriage_m (the imposed path), load_cell_N. Without ``hysteresis`` the spring is linear.
    """
    check_effect(effect, BOUC_WEN_EFFECTS)
    chain = OutputChain.of(effect, size)
    paths = {
        "quiet": impose_multisine(min(8.0, duration_s), 0.0, 1.0, 40.0, seed),
        "train": impose_multisine(duration_s, 6e-4, 1.0, 40.0, 1000 + seed),
        "held_out": impose_multisine(duration_s, 9e-4, 1.0, 25.0, 2000 + seed),
    }
    tables = {}
    for i, (name, path) in enumerate(paths.items()):
        rng = np.random.default_rng([seed, i])
        time_s = path.time_s[::_FINE]
        force = chain.apply(path.time_s, bouc_wen_force(path, effect, size), time_s)
        n = len(time_s)
        tables[name] = {
            "time_s": time_s,
            "carriage_m": path.position[::_FINE] + BOUC_WEN_PATH_NOISE_M * rng.standard_normal(n),
            "load_cell_N": force + BOUC_WEN_FORCE_NOISE_N * rng.standard_normal(n),
        }
    truth = {
        "system": "bouc_wen",
        "seed": seed,
        "values": BOUC_WEN,
        "start": "equilibrium",
        **describe_effect(effect, size, BOUC_WEN_EFFECTS),
    }
    if effect == "relaxation":
        truth["parameters"]["time_constant"] = RELAXATION_TIME_S
    return write_case(out, tables, truth)


SYSTEMS = {"emps": (simulate_emps, EMPS_EFFECTS), "bouc_wen": (simulate_bouc_wen, BOUC_WEN_EFFECTS)}
