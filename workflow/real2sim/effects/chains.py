"""Changes of what goes into a simulation and of what comes out, and the trial data that they are computed from.

An input chain maps values and the trial's `Context` to another path of the driven segment, an output chain simulated
paths to what the sensors show. An `Observation` sets the plant up otherwise than the markers say. Mechanisms of the
plant compute planned forces from the same `Context`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from real2sim.geometry import turn_products


@dataclass(frozen=True)
class NeutralPose:
    """Pose of the driven segment in the neutral trial, where the rest pose was taken: (3, 3) and (3,) [m, world]."""

    rotation: np.ndarray
    position: np.ndarray


@dataclass(frozen=True)
class MarkerShapes:
    """Markers on the driven segment: ``segment`` (k, 3) its own, ``interface`` (2, 3) at rest [m].

    ``by_turn`` (10, k, 3) is what they show of skin that moves between them: how far they are from ``segment`` at the
    start, per Cardan angle of the segment from the start [m/rad], and per product of two of these [m/rad^2], in the
    order of `turn_products`. None for markers on a rigid body.
    """

    segment: np.ndarray
    interface: np.ndarray
    by_turn: np.ndarray | None = None

    def places(self, angles: np.ndarray) -> np.ndarray:
        """Return where the segment's markers are seen on it (n, k, 3) [m] at Cardan angles (n, 3) [rad]."""
        if self.by_turn is None:
            return np.broadcast_to(self.segment, (len(angles), *self.segment.shape))
        moved = np.einsum("np,pki->nki", turn_products(angles), self.by_turn)
        return np.asarray(self.segment + moved)


@dataclass(frozen=True)
class RobotMass:
    """Masses that gravity pulls where the floor slopes: ``mass`` [kg] of the robot and ``moment`` (2,) [kg m].

    The moment is the mass of what turns with the base times the horizontal place of its centre, from the axis that it
    turns about, in the interface's heading.
    """

    mass: float
    moment: np.ndarray


@dataclass(frozen=True)
class Context:
    """Measurements of a trial that chains and planned forces are computed from.

    ``time_s`` (n,) samples and ``step_time_s`` (nstep,) steps; ``pelvis_rotation`` (n, 3, 3), ``pelvis_position``
    (n, 3) of the driven segment; ``interface_rotation`` (n, 3, 3) measured; ``start`` sample index up to which the
    person stands; ``robot`` its mass; ``measured`` (n, 2, 3) interface markers and ``spikes`` (n, 2) where they jump;
    ``coordinates`` and ``rates`` (n, axes) of the interface, measured; ``neutral`` pose of the segment;
    ``shapes`` of the markers on it; ``on_arm`` (3,) position of the interface on the robot's arm, with
    whose roll and pitch it turns [m]; ``held_out``: the trial is not the one that is fitted.
    """

    time_s: np.ndarray
    step_time_s: np.ndarray
    pelvis_rotation: np.ndarray
    pelvis_position: np.ndarray
    interface_rotation: np.ndarray
    start: int
    robot: RobotMass
    measured: np.ndarray
    spikes: np.ndarray
    coordinates: np.ndarray
    rates: np.ndarray
    neutral: NeutralPose
    shapes: MarkerShapes
    on_arm: np.ndarray
    held_out: bool = False


@dataclass(frozen=True)
class Poses:
    """Poses of the interface that set the plant up: in the world at the start, and in the segment at rest.

    ``heading`` [rad] is the turn of the robot's log, which is aligned to the interface's markers, against the world.
    """

    rotation: np.ndarray
    position: np.ndarray
    rest_rotation: np.ndarray
    rest_position: np.ndarray
    heading: float = 0.0


class Observation:
    """An observation model: how the poses that were observed differ from the true ones; the base class observes both.

    ``of_markers``: it is about what the markers show, and no part of a model of the plant.
    """

    of_markers = True

    def true_poses(self, values: np.ndarray, seen: Poses, context: Context, axes: tuple[int, ...]) -> Poses:
        """Return the true poses for the observed ones and values (p,) of an effect on ``axes`` of the interface."""
        return seen

    def observe(
        self, paths: np.ndarray, rotation: np.ndarray, values: np.ndarray, context: Context
    ) -> np.ndarray:
        """Return marker paths (m, n, k, 3) for their sites' paths and rotation (m, n, 3, 3) of the interface.

        ``values`` are (m, p).
        """
        return paths


InputChain = Callable[[np.ndarray, Context], tuple[np.ndarray, np.ndarray]]
OutputChain = Callable[[np.ndarray, np.ndarray, Context], np.ndarray]
Displacement = Callable[[np.ndarray, Context], np.ndarray]


@dataclass(frozen=True)
class Chains:
    """Changes of the measurements by an effect.

    ``input`` maps values (p,) and context to a path of the segment (n, 3, 3), (n, 3); ``output`` maps simulated paths
    (m, n, ...), values (m, p) and context to paths; ``log`` does so with the machine's joints (m, n, j);
    ``observation`` sets the plant up otherwise; ``displacement`` maps values (p,) and context to displacements
    (n, 4, 3) [m, pelvis] of the pelvis markers over the bone, which the markers themselves may contradict.
    ``kinds`` are names of the free-form families (`real2sim.effects.displacements`) that it is a special case of.
    """

    input: InputChain | None = None
    output: OutputChain | None = None
    log: OutputChain | None = None
    observation: Observation | None = None
    displacement: Displacement | None = None
    kinds: tuple[str, ...] = ()

    @property
    def of_measurement(self) -> bool:
        """Return whether the effect is one of the measurement, and no part of a model of the plant."""
        return bool(
            self.input
            or self.output
            or self.log
            or (self.observation is not None and self.observation.of_markers)
        )

    @property
    def empty(self) -> bool:
        """Return whether the measurements are left as they are."""
        return self == NO_CHAINS


NO_CHAINS = Chains()


class Elsewhere(Observation):
    """Interface and robot start elsewhere: values (m, 6) are displacement [m] and turn [rad] in world axes."""

    of_markers = False

    def true_poses(self, values: np.ndarray, seen: Poses, context: Context, axes: tuple[int, ...]) -> Poses:
        """Move and turn the start; the rest pose is as observed."""
        turn = Rotation.from_rotvec(values[3:]).as_matrix()
        return replace(seen, rotation=turn @ seen.rotation, position=seen.position + values[:3])


def markers_of(rotation: np.ndarray, position: np.ndarray, half: float) -> np.ndarray:
    """Markers left and right (2, 3) [m] of an interface's pose (3, 3), (3,), ``half`` [m] from their middle."""
    return position + half * np.array([rotation[:, 1], -rotation[:, 1]])
