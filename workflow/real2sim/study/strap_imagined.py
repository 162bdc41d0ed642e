"""Trials that nobody has recorded yet: motions that a person could make in the strap, simulated with the plain plant.

An imagined trial begins like the recorded one, with the same robot, strap and noise, and goes on with another motion of
the pelvis. What hypotheses make of it says how far it would part them.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import mujoco
import numpy as np
from scipy.spatial.transform import Rotation

from real2sim import signals
from real2sim.effects.base import Placed
from real2sim.geometry import AXES, interface_coordinates, relative_pose
from real2sim.inference.cost import CostScales, TrialCost
from real2sim.recording.pelvis import pelvis_shape
from real2sim.study.strap_evidence import ReplayCache, StrapEvidence
from real2sim.system.plant import ROBOT_JOINTS, load_robot

# Rates of a sway [Hz], one after the other, and of the sway whose amplitude grows
_RATES_HZ = (0.25, 0.5, 1.0)
_RATE_HZ = 0.5
# Amplitudes as shares of what the person showed along the axis: between them it grows
_AMPLITUDES = (0.3, 1.5)
# How long a displacement is held, and how long the way there takes [s]
_HOLD_S, _WAY_S = 3.0, 0.5
# Two rhythms that do not meet again within a trial [Hz]
_TWO_RATES_HZ = (0.4, 0.65)
# Least amplitude of a motion [m, rad]: what a person can make on purpose
_LEAST = np.array([0.01, 0.01, 0.01, 0.03, 0.03, 0.03])
_WORDS = {
    "tx": "forward",
    "ty": "sideways",
    "tz": "up and down",
    "rx": "in roll",
    "ry": "in pitch",
    "rz": "in turns",
}


@dataclass(frozen=True)
class Motion:
    """A motion of the pelvis (n, 6) [m, rad] in its frame at the start, and how to tell a person to make it."""

    words: str
    path: np.ndarray


def motions(evidence: StrapEvidence, axes: Sequence[str]) -> Iterator[Motion]:
    """Yield motions along some axes of the interface that a person could make, no larger than 1.5 times what they did.

    Sways at three rates, sways that grow, displacements that are held, and pairs of axes at two rhythms.
    """
    time_s = evidence.trial.time_s - evidence.trial.time_s[0]
    begins = float(time_s[evidence.context.start])
    t = np.maximum(time_s - begins, 0.0)
    fade = np.clip(t / _WAY_S, 0, 1)
    size = np.maximum(np.percentile(np.abs(_moved(evidence)), 95, axis=0), _LEAST)
    along = [AXES.index(axis) for axis in axes]

    def single(i: int, wave: np.ndarray) -> np.ndarray:
        out = np.zeros((len(t), 6))
        out[:, i] = size[i] * fade * wave
        return out

    for i in along:
        how, amount = _WORDS[AXES[i]], _amount(i, size[i])
        parts = np.minimum((t / t[-1] * len(_RATES_HZ)).astype(int), len(_RATES_HZ) - 1)
        phase = 2 * np.pi * np.cumsum(np.array(_RATES_HZ)[parts]) * float(time_s[1])
        rates = ", ".join(f"{hz:g}" for hz in _RATES_HZ)
        yield Motion(
            f"sway {how} by {amount} at {rates} Hz, a third of the trial each", single(i, np.sin(phase))
        )
        first, last = _AMPLITUDES
        grows = first + (last - first) * t / t[-1]
        about = f"{_amount(i, first * size[i])} to {_amount(i, last * size[i])}"
        wave = grows * np.sin(2 * np.pi * _RATE_HZ * t)
        yield Motion(f"sway {how} at {_RATE_HZ:g} Hz and grow from {about}", single(i, wave))
        yield Motion(
            f"move {how} by {amount} within {_WAY_S:g} s, hold for {_HOLD_S:g} s, come back, and so to the other side",
            single(i, _held(t)),
        )
    for a, b in pairwise(along):
        both = single(a, np.sin(2 * np.pi * _TWO_RATES_HZ[0] * t))
        both += single(b, np.sin(2 * np.pi * _TWO_RATES_HZ[1] * t))
        told = [
            f"{_WORDS[AXES[i]]} by {_amount(i, size[i])} at {hz:g} Hz"
            for i, hz in zip((a, b), _TWO_RATES_HZ, strict=True)
        ]
        yield Motion(f"sway {' and at the same time '.join(told)}", both)


def imagined_trials(
    evidence: StrapEvidence, axes: Sequence[str], parameters: np.ndarray
) -> Iterator[tuple[str, StrapEvidence]]:
    """Yield trials with motions along some axes, in words and as `imagined` of a strap with parameters (12,) [SI]."""
    for motion in motions(evidence, axes):
        yield motion.words, imagined(evidence, motion, parameters)


def _amount(axis: int, size: float) -> str:
    return f"{1e3 * size:.0f} mm" if axis < 3 else f"{np.degrees(size):.0f} deg"


def _held(t: np.ndarray) -> np.ndarray:
    """One side, back, the other side, back, each held."""
    corners = np.arange(0, t[-1] + 4 * (_HOLD_S + _WAY_S), _HOLD_S + _WAY_S)
    levels = np.array([(0, 1, 0, -1)[k % 4] for k in range(1, len(corners) + 1)], float)
    before = np.concatenate([[0.0], levels[:-1]])
    k = np.minimum((t / (_HOLD_S + _WAY_S)).astype(int), len(corners) - 1)
    share = np.clip((t - corners[k]) / _WAY_S, 0, 1)
    smooth = share * share * (3 - 2 * share)
    return np.asarray(before[k] + (levels[k] - before[k]) * smooth)


def _moved(evidence: StrapEvidence) -> np.ndarray:
    """Motion (n, 6) [m, rad] of the pelvis in its frame at the start, about its mean."""
    c = evidence.context
    reference = c.pelvis_rotation[0]
    way = (c.pelvis_position - c.pelvis_position[0]) @ reference
    turn = Rotation.from_matrix(reference.T @ c.pelvis_rotation).as_rotvec()
    both = np.hstack([way, turn])
    return np.asarray(both - both.mean(axis=0))


def imagined(evidence: StrapEvidence, motion: Motion, parameters: np.ndarray) -> StrapEvidence:
    """Return the trial with another motion, as it would be measured of the plain strap.

    ``parameters`` (12,) are those of the strap; nothing is noisy.
    """
    c, own = evidence.context, evidence.trial
    r0, p0 = c.pelvis_rotation[0], c.pelvis_position[0]
    rotation = r0 @ Rotation.from_rotvec(motion.path[:, 3:]).as_matrix()
    position = p0 + motion.path[:, :3] @ r0.T
    everywhere = np.ones(len(own.time_s), bool)
    trial = replace(own, pelvis_rotation=rotation, pelvis_position=position, usable=everywhere)
    shape = pelvis_shape(own)
    trial = replace(trial, pelvis_markers=position[:, None] + np.einsum("nij,kj->nki", rotation, shape))
    context = replace(c, pelvis_rotation=rotation, pelvis_position=position, spikes=np.zeros_like(c.spikes))
    recorded = replace(evidence.recorded, trial=trial, context=context, skin=None, jumped_s={})
    bare = replace(evidence, recorded=recorded, cache=ReplayCache())
    replay = bare.replay([], 1)
    paths, joints = replay.run_effects(parameters[None], [])
    assert replay.start_joints is not None
    logged = None if bare.robot is None else joints[0] - joints[0, : c.start].mean(axis=0)
    return _measured_as(bare, paths[0], replay.start_joints + joints[0], logged)


def injected(evidence: StrapEvidence, placed: Placed, x: np.ndarray, parameters: np.ndarray) -> StrapEvidence:
    """Return a recorded trial as if an effect had acted in it.

    What the effect with searched numbers x (p,) changes in a simulation with parameters (12,) of the strap is added to
    what was measured, noise and all.
    """
    with_it, without = evidence.replay([placed], 1), evidence.replay([], 1)
    paths, joints = (both[0] for both in with_it.run_effects(parameters[None], [x[None]]))
    plain_paths, plain_joints = (both[0] for both in without.run_effects(parameters[None], []))
    assert with_it.start_joints is not None
    assert without.start_joints is not None
    c, own, robot = evidence.context, evidence.trial, evidence.robot
    seen = _interface_rotation(evidence, with_it.start_joints + joints)
    plain_seen = _interface_rotation(evidence, without.start_joints + plain_joints)
    more = _coordinates(evidence, seen, paths) - _coordinates(evidence, plain_seen, plain_paths)
    measured, turned = own.interface + paths - plain_paths, joints - plain_joints
    context = replace(
        c,
        interface_rotation=seen @ plain_seen.transpose(0, 2, 1) @ c.interface_rotation,
        measured=c.measured + paths - plain_paths,
        coordinates=c.coordinates + more,
        rates=c.rates + signals.derivative(more, evidence.rate_hz),
    )
    recorded = replace(
        evidence.recorded,
        trial=replace(own, interface=measured),
        context=context,
        coordinates=evidence.recorded.coordinates + more,
        cost=_cost(evidence, measured),
        robot=None if robot is None else robot + turned - turned[: c.start].mean(axis=0),
    )
    return replace(evidence, recorded=recorded, cache=ReplayCache())


def _coordinates(evidence: StrapEvidence, seen: np.ndarray, paths: np.ndarray) -> np.ndarray:
    """Coordinates (n, 6) [m, rad] of an interface with rotations (n, 3, 3) and markers (n, 2, 3)."""
    c, rest = evidence.context, evidence.trial.rest
    relative = relative_pose(c.pelvis_rotation, c.pelvis_position, seen, paths.mean(axis=1))
    return interface_coordinates(*relative, rest.rotation, rest.position)


def _cost(evidence: StrapEvidence, paths: np.ndarray) -> TrialCost:
    ident = evidence.setup.settings["identification"]["scales"]
    scales = CostScales(ident["position_m"], ident["velocity_m_per_s"])
    return TrialCost(paths, evidence.rate_hz, scales, evidence.trial.usable)


def _measured_as(
    evidence: StrapEvidence, paths: np.ndarray, joints: np.ndarray, logged: np.ndarray | None
) -> StrapEvidence:
    """Return the trial with other interface markers (n, 2, 3) and robot log (n, 6), measured at joints (n, 6)."""
    seen = _interface_rotation(evidence, joints)
    q = _coordinates(evidence, seen, paths)
    context = replace(
        evidence.context,
        interface_rotation=seen,
        measured=paths,
        coordinates=q,
        rates=signals.derivative(q, evidence.rate_hz),
    )
    recorded = replace(
        evidence.recorded,
        trial=replace(evidence.trial, interface=paths),
        context=context,
        coordinates=q,
        cost=_cost(evidence, paths),
        robot=logged,
    )
    return replace(evidence, recorded=recorded, cache=ReplayCache())


def _interface_rotation(evidence: StrapEvidence, joints: np.ndarray) -> np.ndarray:
    """Rotation (n, 3, 3) of the interface at joints (n, 6) of the robot."""
    model = load_robot(evidence.setup.system.model).compile()
    data = mujoco.MjData(model)
    address = [model.joint(name).qposadr[0] for name in ROBOT_JOINTS]
    rotation, body = np.empty((len(joints), 3, 3)), model.body("interface").id
    for i, row in enumerate(joints):
        data.qpos[address] = row
        mujoco.mj_kinematics(model, data)
        rotation[i] = data.xmat[body].reshape(3, 3)
    return rotation
