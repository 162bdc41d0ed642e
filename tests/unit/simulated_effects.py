"""A replay of a made-up motion with any effects, and what the tests of effects and diagnosis measure in."""

from __future__ import annotations

import mujoco
import numpy as np
from real2sim.effects.base import Scales
from real2sim.effects.catalogue import EFFECTS, Placed
from real2sim.effects.chains import Context, MarkerShapes, NeutralPose, RobotMass, markers_of
from real2sim.effects.replay import EffectReplay
from real2sim.study.strap import strap_system
from real2sim.system.description import System
from real2sim.system.plant import RestPose, load_robot, mass_on_base

from tests.unit.test_coupling import CONFIG, PRIOR, REST, ROBOT, rotation_xyz, smooth_motion

SCALES = Scales(
    np.array([0.05, 0.04, 0.02, 0.08, 0.1, 0.25]),
    np.array([0.12, 0.15, 0.16, 0.45, 0.44, 0.78]),
    PRIOR[:6],
    PRIOR[6:],
    np.array([65.0, 35.0, 7.0, 0.24, 0.22, 4.0]),
)
STRAP = strap_system(ROBOT, CONFIG)


def about(parameters: np.ndarray) -> System:
    """The strap with bounds a factor of three about parameters (12,)."""
    bounds = {n: (v / 3, 3 * v) for n, v in zip(STRAP.parameter_names, parameters, strict=True)}
    return STRAP.with_model(ROBOT, bounds=bounds)


# Interface markers are so far from their middle [m]
HALF = 0.17
Pose = tuple[np.ndarray, np.ndarray]
# Pelvis markers on the pelvis [m]
PELVIS_SHAPE = np.array([[0.0, 0.12, 0.0], [0.0, -0.12, 0.0], [-0.16, 0.05, 0.0], [-0.16, -0.05, 0.0]])
LEVEL = np.eye(3), np.array([0.0, 0.0, 0.95])


def replay(
    effects: list[Placed],
    nsim: int = 1,
    seconds: float = 3.0,
    seen: Pose = LEVEL,
    half: float = HALF,
    rest: RestPose = REST,
    noise: np.ndarray | float = 0.0,
    neutral_at: np.ndarray | float = 0.0,
    step: float = 0.01,
    settled: bool = False,
    motion: np.ndarray | None = None,
) -> EffectReplay:
    """Replay of a smooth motion, or of ``motion`` (n, 6) of the pelvis at 100 Hz.

    ``seen`` is where the interface's markers, ``half`` [m] from their middle, put it at first; ``noise`` (n, 6) is
    added to its measured coordinates; ``neutral_at`` (3,) [m] is where the neutral trial was taken, from here; ``step``
    [s] is the plant's.
    """
    offset = smooth_motion(seconds) if motion is None else motion
    time = np.arange(len(offset)) / 100
    rotation = rotation_xyz(offset[:, 3:])
    position = np.array([0.0, 0.0, 0.95]) - REST.position + offset[:, :3]
    across = half * np.array([seen[0][:, 1], -seen[0][:, 1]])
    still = np.tile(seen[1] + across, (len(time), 1, 1))
    context = Context(
        time,
        time,
        rotation,
        position,
        rotation,
        10,
        RobotMass(*mass_on_base(load_robot(ROBOT).compile(), "interface")),
        still,
        np.zeros((len(time), 2), bool),
        -offset + noise,
        np.gradient(-offset, 0.01, axis=0),
        NeutralPose(np.eye(3), position[0] + neutral_at),
        MarkerShapes(PELVIS_SHAPE, markers_of(rest.rotation, rest.position, half)),
        np.array([0.12, 0.0, 0.0]),
    )
    return EffectReplay(
        effects=effects,
        context=context,
        scales=SCALES,
        robot=ROBOT,
        robot_settings=CONFIG["robot"],
        plant_settings=CONFIG["plant"] | {"timestep_s": step},
        time_s=time,
        pelvis_rotation=rotation,
        pelvis_position=position,
        start_rotation=seen[0],
        start_position=seen[1],
        rest=rest,
        limits=None,
        nsim=nsim,
        settled=settled,
    )


def pelvis_at_start() -> Pose:
    """Pelvis of the motion's first sample, which the context takes for that of the neutral trial."""
    return np.eye(3), replay([])._context.neutral.position


def placed_whole(name: str, form: str = "") -> Placed:
    effect = next(e for e in EFFECTS if e.name == name and e.form == form)
    return Placed(effect, effect.places(STRAP)[0], SCALES)


def undriven(model: EffectReplay) -> mujoco.MjModel:
    """Model of the last call, its pelvis let go: the servo would pull it from where a test puts it."""
    plant = model.as_simulated().model
    plant.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_ACTUATION)
    return plant


def at_rest_on(model: EffectReplay, name: str, q: float) -> float:
    """Force [N, Nm] of springs and stops on a strap joint at a coordinate, in the model of the last call."""
    plant = undriven(model)
    data = mujoco.MjData(plant)
    joint = plant.joint(name)
    data.qpos[joint.qposadr[0]] = q
    mujoco.mj_forward(plant, data)
    return data.qfrc_spring[joint.dofadr[0]] + data.qfrc_constraint[joint.dofadr[0]]
