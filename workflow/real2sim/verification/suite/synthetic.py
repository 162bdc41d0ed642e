"""One synthetic person before any effect: trials, tangents of the twelve parameters, noise floors."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import mujoco
import numpy as np

from real2sim.verification.phantom import exports
from real2sim.verification.phantom.motions import Motion
from real2sim.verification.phantom.person import PARAMETER_NAMES, Person
from real2sim.verification.phantom.physics import AXES, Controller, PelvisPath, Robot, TruePaths
from real2sim.verification.suite.effects import Context, Draw, Form
from real2sim.verification.suite.measurement import pelvis_markers, replayed_path
from real2sim.verification.suite.plan import EFFECTS, Case, stream
from real2sim.verification.suite.random_forms import posture
from real2sim.verification.suite.setups import Setup, run, run_centres
from real2sim.verification.suite.severity import HELD_OUT, TRAIN, Refit, Search, perturbed, refit_of

RATE_HZ = 100.0
_NOISY = 3  # replays with noise, for the floor

# Effects with the quantities of their equations
Applied = list[tuple[Form, dict[str, Any]]]


@dataclass
class Cause:
    """One effect of a case: its form, the draw of it, the severity found, and the gap it makes alone.

    ``left`` holds, per severity, the residual on the held-out trial that the refitted base leaves.
    """

    form: Form
    name: str
    draw: Draw = field(default_factory=Draw)
    severity: float = 0.0
    rho: float = 0.0
    moved: np.ndarray = field(default_factory=lambda: np.zeros(12))
    search: Search | None = None
    candidates: list[Draw] = field(default_factory=list)
    left: dict[float, np.ndarray] = field(default_factory=dict)


@dataclass
class Synthetic:
    """A case with its person and its trials without any effect."""

    case: Case
    person: Person
    settings: dict[str, Any]
    motions: dict[str, Motion]
    paths: dict[str, PelvisPath]
    starts: dict[str, np.ndarray]
    controllers: dict[str, Controller]
    smooth_hz: float | None
    regime: tuple[float, float]
    causes: list[Cause]
    base: dict[str, TruePaths] = field(default_factory=dict)
    about: Context | None = None
    refit: Refit | None = None
    rho: float | None = None
    left: np.ndarray | None = None

    @property
    def target(self) -> float:
        """The visibility asked for."""
        if self.case.target is None:
            raise ValueError(f"{self.case.id} has no effect")
        return self.case.target


@dataclass
class World:
    """Configuration, and the robot with a coarse and a fine time step, that all cases share."""

    suite: dict[str, Any]
    settings: dict[str, Any]
    coarse: Robot
    fine: Robot

    @property
    def stops(self) -> dict[str, Any]:
        """Stiffness and damping of the strap's stops, as in the settings."""
        stops: dict[str, Any] = self.settings["stops"]
        return stops


def setup_of(p: Synthetic, trial: str) -> Setup:
    """Return the simulation of a trial without effects."""
    person = p.person
    return Setup(
        p.paths[trial],
        person.rest_rotation,
        person.rest_position,
        person.stiffness,
        person.damping,
        p.controllers[trial],
    )


# -------------------- base trials, tangents, floors


def describe(world: World, people: list[Synthetic]) -> None:
    """Trials without effects, and what the draws of the effects may know of them."""
    setups = [setup_of(p, trial) for p in people for trial in (TRAIN, HELD_OUT)]
    done = iter(run(world.coarse, setups, world.stops, RATE_HZ))
    for p in people:
        p.base = {trial: next(done) for trial in (TRAIN, HELD_OUT)}
        base = p.base[TRAIN]
        q, qd = base.q, base.qd
        p.about = Context(
            p.person.stiffness,
            p.person.damping,
            q.min(axis=0),
            q.max(axis=0),
            np.abs(q).max(axis=0),
            np.abs(qd).max(axis=0),
            _mobility(world.coarse, p.person),
            world.coarse.masses,
            p.settings["trials"]["dynamic_s"],
            p.settings["trials"]["quiet_s"],
            np.abs(base.joints - base.joints[0]).max(axis=0),
            np.abs(base.joint_rates).max(axis=0),
            np.abs(posture(base.pelvis_rotation, base.pelvis_position)).max(axis=0),
        )


def _mobility(robot: Robot, person: Person) -> np.ndarray:
    """Inertia (6,) that the strap feels along each axis at the start pose [kg, kg m^2]."""
    model, data = robot.model, mujoco.MjData(robot.model)
    mujoco.mj_forward(model, data)
    jac_p, jac_r = np.zeros((3, model.nv)), np.zeros((3, model.nv))
    mujoco.mj_jacSite(model, data, jac_p, jac_r, model.site("phantom_middle").id)
    mass = np.zeros((model.nv, model.nv))
    mujoco.mj_fullM(model, data, mass)
    pelvis = data.body("interface").xmat.reshape(3, 3) @ person.rest_rotation.T
    j = np.vstack([pelvis.T @ jac_p, pelvis.T @ jac_r])
    inertia: np.ndarray = 1 / np.einsum("ij,jk,ik->i", j, np.linalg.inv(mass), j)
    return inertia


def linearise(world: World, people: list[Synthetic]) -> None:
    """Tangents of the twelve parameters and noise floors of every case."""
    setups = []
    for p in people:
        for trial in (TRAIN, HELD_OUT):
            plain = setup_of(p, trial)
            setups += [replace(plain, path=_noisy_path(world, p, trial, k)) for k in range(_NOISY)]
            for stiffness, damping in perturbed(p.person.stiffness, p.person.damping):
                setups.append(replace(plain, stiffness=stiffness, damping=damping))
    done = iter(run_centres(world.coarse, setups, world.stops, RATE_HZ))
    for p in people:
        centres = {}
        for trial in (TRAIN, HELD_OUT):
            n = samples_of(p)
            base = np.stack([p.base[trial].left, p.base[trial].right], axis=1)[:n]
            noisy = [next(done)[:n] for _ in range(_NOISY)]
            centres[trial] = {"base": base, "noisy": noisy, "tangent": [next(done)[:n] for _ in range(12)]}
        rng = stream(world.suite, p.case.id, "floor")
        p.refit = refit_of(centres, partial(noise_of, p, rng), RATE_HZ, _room(world, p.person))


def noise_of(p: Synthetic, rng: np.random.Generator, shape: tuple[int, ...]) -> np.ndarray:
    """Return noise [m] of marker coordinates of some ``shape`` (n, ...), as the export shows it."""
    noise = p.person.marker_noise(rng, shape, RATE_HZ)
    return noise if p.smooth_hz is None else exports.smoothed(noise, RATE_HZ, p.smooth_hz)


def _room(world: World, person: Person) -> tuple[np.ndarray, np.ndarray]:
    """Return the distances of the ln parameters from the search bounds, down and up."""
    rows = [world.suite["parameters"]["values"][name] for name in PARAMETER_NAMES]
    true = np.log(np.concatenate([person.stiffness, person.damping]))
    return np.log([r["low"] for r in rows]) - true, np.log([r["high"] for r in rows]) - true


def samples_of(p: Synthetic) -> int:
    """Return the number of samples of a dynamic trial."""
    return round(float(p.settings["trials"]["dynamic_s"]) * RATE_HZ)


def _noisy_path(world: World, p: Synthetic, trial: str, index: int) -> PelvisPath:
    t = np.arange(samples_of(p)) / RATE_HZ
    markers = pelvis_markers(p.person, p.paths[trial])(t)
    rng = stream(world.suite, p.case.id, trial, f"floor {index}")
    noisy = {name: values + noise_of(p, rng, values.shape) for name, values in markers.items()}
    return as_long(replayed_path(noisy, RATE_HZ), p.paths[trial])


def as_long(path: PelvisPath, other: PelvisPath) -> PelvisPath:
    """Return a path that lasts as long as another one."""
    return PelvisPath(path.evaluate, other.duration_s)


def about_of(p: Synthetic) -> Context:
    """Return what draws of effects may know of a person; after `describe`."""
    assert p.about is not None
    return p.about


def applied(p: Synthetic) -> Applied:
    """Return the causes of a person with their quantities."""
    return [(c.form, c.form.values(c.draw, c.severity, about_of(p))) for c in p.causes]


def cause_truth(p: Synthetic, cause: Cause) -> dict[str, Any]:
    """Return what is sealed of an effect; its severity is in sizes of the largest that is published or carried."""
    form = cause.form
    return {
        "effect": form.effect,
        "family": form.family or (form.effect if form.effect in EFFECTS else None),
        "axes": [axis for axis, on in zip(AXES, cause.draw.axes, strict=True) if on],
        "stage": form.stage,
        "form": form.form,
        "parameters": form.truth(cause.draw, form.values(cause.draw, cause.severity, about_of(p))),
        "regime": form.regime,
        "severity": cause.severity,
    }
