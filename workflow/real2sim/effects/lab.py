"""Segment and interface are measured in laboratory frames that differ by a turn or by a scale."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from real2sim.effects.base import (
    AtRest,
    Effect,
    EffectParameter,
    Fields,
    InterfaceImpedance,
    Mechanism,
    Where,
)
from real2sim.effects.chains import Chains, Context, Observation, Poses
from real2sim.effects.frames import TURNS, TurnedAxes, segment_at_rest


class TurnedLab(Observation):
    """The interface's markers are measured in a frame turned about the vertical, values (m, 1) [rad]."""

    def true_poses(self, values: np.ndarray, seen: Poses, context: Context, axes: tuple[int, ...]) -> Poses:
        """Turn back about the laboratory's origin, in the neutral trial as well."""
        back = Rotation.from_rotvec([0, 0, -values[0]]).as_matrix()
        pelvis, origin = context.neutral.rotation, context.neutral.position
        return Poses(
            back @ seen.rotation,
            back @ seen.position,
            pelvis.T @ back @ pelvis @ seen.rest_rotation,
            pelvis.T @ (back @ (origin + pelvis @ seen.rest_position) - origin),
            seen.heading + float(values[0]),
        )

    def observe(
        self, paths: np.ndarray, rotation: np.ndarray, values: np.ndarray, context: Context
    ) -> np.ndarray:
        """Turn about the laboratory's origin."""
        turn = Rotation.from_rotvec(values * np.array([0.0, 0.0, 1.0])).as_matrix()
        return np.asarray(np.einsum("mij,mnkj->mnki", turn, paths))


class TurnedBack(Mechanism):
    """All axes turned about the vertical against a turn of the segment's path, value (m, 1) [rad]."""

    def overwrites(self, where: Where) -> frozenset[str]:
        """As of `TurnedAxes`."""
        return TurnedAxes().overwrites(where)

    def set(self, fields: Fields, where: Where, impedance: InterfaceImpedance, values: np.ndarray) -> None:
        """The path carries the axes along with it; the interface hangs on the person all the same."""
        segment = where.system.segment
        assert segment is not None, "a system with a pose has a segment"
        vertical = segment_at_rest(fields.model, segment)[2]
        TurnedAxes().set(fields, where, impedance, -values * vertical)


def turned_motion(values: np.ndarray, context: Context) -> tuple[np.ndarray, np.ndarray]:
    """Return the path (n, 3, 3), (n, 3) of the segment in the interface's frame, of a yaw (1,) [rad]."""
    # The segment in the interface's frame, turned about the vertical through the lab's origin. The rest pose was taken
    # in two frames too: its share of the turn, at the place of the neutral trial, moves with the segment.
    turn = Rotation.from_rotvec([0, 0, -values[0]]).as_matrix()
    rest, where = context.neutral.rotation, context.neutral.position
    fixed = rest.T @ turn.T @ rest
    offset = rest.T @ turn.T @ (where - turn @ where)
    rotation = turn @ context.pelvis_rotation
    return rotation @ fixed, context.pelvis_position @ turn.T + rotation @ offset


def scaled_motion(values: np.ndarray, context: Context) -> tuple[np.ndarray, np.ndarray]:
    """Return the path (n, 3, 3), (n, 3) [m] of a segment that was measured too large by a share (1,).

    The rest pose was taken in the neutral trial, where the segment stood elsewhere than it was measured too.
    """
    true = 1 / (1 + values[0])
    at_rest = context.neutral.rotation.T @ context.neutral.position * (1 - true)
    return context.pelvis_rotation, context.pelvis_position * true + context.pelvis_rotation @ at_rest


EFFECTS = (
    Effect(
        "lab_yaw",
        "input",
        "pelvis and interface are seen in frames turned about the vertical",
        (EffectParameter("yaw", "rad", -0.35, 0.35, (0.03,)),),
        separating_trial="a static wand seen by both systems",
        at_rest=AtRest((0.0,)),
        confusable=TURNS,
        group="F",
        scope="whole",
        needs=frozenset({"pose", "six_axes"}),
        plant=TurnedBack(),
        chains=Chains(input=turned_motion, kinds=("turned segment",)),
        remedy=(
            "Turn the pelvis' markers of all trials by minus the yaw about the vertical through the lab's origin and"
            " ingest anew; the strap's axes of this model are turned with the path as it was recorded"
        ),
    ),
    Effect(
        "lab_yaw",
        "input",
        "pelvis and interface are seen in frames turned about the vertical; the robot's axes are the pelvis' frame's",
        (EffectParameter("yaw", "rad", -0.35, 0.35, (0.03,)),),
        separating_trial="a static wand seen by both systems",
        at_rest=AtRest((0.0,)),
        confusable=TURNS,
        group="F",
        scope="whole",
        needs=frozenset({"markers", "pose"}),
        chains=Chains(observation=TurnedLab(), kinds=("turned markers",)),
        form="interface",
        remedy=(
            "Turn the interface's markers of all trials by minus the yaw about the vertical through the lab's origin"
            " and ingest anew; start and rest pose of this model are those of the turned markers"
        ),
    ),
    Effect(
        "lab_yaw",
        "input",
        "the pelvis is seen in a lab of another scale than the interface and the robot",
        (EffectParameter("too_large", "1", -0.1, 0.1, (0.01,)),),
        separating_trial="a static wand seen by both systems",
        at_rest=AtRest((0.0,)),
        confusable=TURNS,
        group="F",
        scope="whole",
        needs=frozenset({"pose"}),
        chains=Chains(input=scaled_motion, kinds=("turned segment",)),
        form="scale",
        remedy="Divide the pelvis' markers of all trials by 1 + too_large about the lab's origin and ingest anew",
    ),
)
