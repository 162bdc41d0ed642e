"""Simulate and record the three trials of a system that is driven by the pose of a segment, with one effect."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from real2sim.system.description import MachineJoint, System
from real2sim.verification.systems.interface_law import RELAXATION_TIME_S, InterfaceLaw
from real2sim.verification.systems.recordings import (
    TRIALS,
    OutputChain,
    Size,
    check_effect,
    describe_effect,
    write_case,
)
from real2sim.verification.systems.rigid_tree import Tree
from real2sim.verification.systems.segment_path import Excitation, SegmentPath, segment_path
from real2sim.verification.systems.stepping import Servo, Trace, rest, run

STEP_S, STORED_EVERY, RATE_HZ = 1e-3, 2, 100.0
QUIET_S = 8.0
MARKER_NOISE_M, SLIDE_NOISE_M, HINGE_NOISE_RAD = 3e-4, 3e-5, 5e-5
# Radius of gyration of an added mass [m]
ADDED_RADIUS_M = 0.05
_SPREAD = 0.4  # SD of the logarithm of a person's interface parameters, cut at two SD


@dataclass
class Setup:
    """A pose-driven system: description, tree, mechanism, true interface (stiffness, damping), paths and markers.

    The effect machine_impedance acts on ``changed_joints`` by a factor of exp(size): on the stiffness of a controlled
    joint, on the damping of a passive one.
    """

    system: System
    tree: Tree
    mechanism: Callable[[Tree, SegmentPath], Any]
    interface: tuple[np.ndarray, np.ndarray]
    excitations: Mapping[str, Excitation]
    home: np.ndarray
    markers: Mapping[str, np.ndarray]
    effects: Mapping[str, Size]
    changed_joints: tuple[str, ...]


def draw_interface(stiffness: np.ndarray, damping: np.ndarray, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Return stiffness and damping (k,) of a person, log-normal about the given ones (k,), in their units."""
    rng = np.random.default_rng([seed, 99])
    factors = np.exp(_SPREAD * np.clip(rng.standard_normal((2, len(stiffness))), -2, 2))
    return stiffness * factors[0], damping * factors[1]


def servo_of(system: System, tree: Tree, factors: Mapping[str, float]) -> Servo:
    """Return the controllers of the machine, with all goals zero.

    ``factors`` multiply the stiffness of controlled joints and the damping of passive ones, by name.
    """
    given: dict[str, MachineJoint] = {joint.name: joint for joint in system.machine}
    joints = tree.description.joints
    stiffness, damping = np.zeros(len(joints)), tree.damping.copy()
    for i, joint in enumerate(joints):
        impedance = given[joint.name].impedance
        factor = factors.get(joint.name, 1.0)
        if impedance is None:
            damping[i] *= factor
        else:
            stiffness[i], damping[i] = impedance.stiffness * factor, impedance.damping
    return Servo(stiffness, damping, tree.friction, np.zeros(len(joints)))


def trace_trials(
    setup: Setup, effect: str | None, size: float, seed: int, axis: str, duration_s: float
) -> tuple[Trace, SegmentPath]:
    """Return the true motion of all trials in one batch, and the segment's path; both start in static equilibrium.

    The controllers' goals are where the machine stands when the interface coordinates are zero.
    """
    excitations = [setup.excitations[name] for name in TRIALS]
    lengths = [min(QUIET_S, duration_s), duration_s, duration_s]
    path = segment_path(STEP_S, duration_s, excitations, setup.home, seed, lengths)
    if effect == "added_mass":
        setup.tree.add_mass(setup.system.body, size, size * ADDED_RADIUS_M**2)
    factor = float(np.exp(size)) if effect == "machine_impedance" else 1.0
    servo = servo_of(setup.system, setup.tree, dict.fromkeys(setup.changed_joints, factor))
    mechanism = setup.mechanism(setup.tree, path)
    x = mechanism.start()
    servo.goal = mechanism.joints_at(0, x)
    law = InterfaceLaw(*setup.interface, STEP_S, effect, mechanism.names.index(axis), size)
    if effect == "preload":
        # it came after the quiet recording, in which the interface rests where its coordinates are zero
        law.size = np.array([0.0, size, size])
        x = rest(mechanism, servo, law, x)
    steps = round(duration_s / STEP_S) + 1
    return run(mechanism, servo, law, x, steps, STEP_S, STORED_EVERY, setup.tree.end), path


def simulate(
    setup: Setup, effect: str | None, size: float, seed: int, out: Path, axis: str, duration_s: float
) -> Path:
    """Write the case of one effect; return ``out``."""
    check_effect(effect, setup.effects)
    trace, path = trace_trials(setup, effect, size, seed, axis, duration_s)
    chain = OutputChain.of(effect, size)
    tables = {}
    for i, name in enumerate(TRIALS):
        length = min(QUIET_S, duration_s) if name == "quiet" else duration_s
        rng = np.random.default_rng([seed, 7, i])
        tables[name] = _table(setup, trace, path, i, length, chain, rng)
    names = [axis_.name for axis_ in setup.system.axes]
    truth = {
        "system": setup.system.name,
        "seed": seed,
        "axis": axis if effect is not None else None,
        "start": "equilibrium",
        "values": {
            f"{letter}_{name}": float(value)
            for letter, values in zip("kd", setup.interface, strict=True)
            for name, value in zip(names, values, strict=True)
        },
        **describe_effect(effect, size, setup.effects),
    }
    if effect == "relaxation":
        truth["parameters"]["time_constant"] = RELAXATION_TIME_S
    if effect == "added_mass":
        truth["parameters"]["inertia"] = size * ADDED_RADIUS_M**2
    if effect == "machine_impedance":
        truth["joints"] = list(setup.changed_joints)
    return write_case(out, tables, truth)


def _table(
    setup: Setup,
    trace: Trace,
    path: SegmentPath,
    trial: int,
    duration_s: float,
    chain: OutputChain,
    rng: np.random.Generator,
) -> dict[str, np.ndarray]:
    """Return the columns of one recording, sampled and with noise."""
    fine_s = np.arange(len(trace.y)) * STEP_S * STORED_EVERY
    time_s = np.arange(round(duration_s * RATE_HZ)) / RATE_HZ
    every = round(1 / RATE_HZ / STEP_S / STORED_EVERY)
    sampled, count = slice(None, None, every), len(time_s)
    columns = {"time_s": time_s}
    at = slice(None, None, every * STORED_EVERY)
    rotation, position = path.rotation[at, trial][:count], path.position[at, trial][:count]
    seen = {name: position + rotation @ place for name, place in setup.markers.items()}
    sites = setup.tree.description.sites
    for name, site in (setup.system.markers.sites or {}).items():
        true = trace.origin[:, trial] + trace.rotation[:, trial] @ sites[site][1]
        seen[name] = chain.apply(fine_s, true, time_s)
    for name, values in seen.items():
        noisy = values + MARKER_NOISE_M * rng.standard_normal(values.shape)
        columns |= {f"{name}_{letter}_m": noisy[:, i] for i, letter in enumerate("xyz")}
    for i, joint in enumerate(setup.tree.description.joints):
        unit, noise = ("rad", HINGE_NOISE_RAD) if joint.hinge else ("m", SLIDE_NOISE_M)
        logged = trace.y[sampled, trial, i][:count]
        columns[f"{joint.name}_{unit}"] = logged + noise * rng.standard_normal(count)
    return columns
