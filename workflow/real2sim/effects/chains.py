"""What a trial was measured with: changes of the pelvis path and of marker paths, sights of the interface, forces.

Input chains map values and the trial's `Context` to another pelvis path, output chains simulated marker paths to what
the markers show. A `Sighting` sets the plant up otherwise. Planned forces are computed from what was measured.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.signal import butter, sosfilt
from scipy.spatial.transform import Rotation

from real2sim.geometry import interface_frame, mean_rotation, pelvis_frame


@dataclass
class Context:
    """What the chains and forces of a trial are computed from.

    ``time_s`` (n,) samples and ``step_time_s`` (nstep,) steps; ``pelvis_rotation`` (n, 3, 3), ``pelvis_position``
    (n, 3); ``interface_rotation`` (n, 3, 3) measured; ``start`` sample index up to which the person stands;
    ``robot_mass`` [kg]; ``measured`` (n, 2, 3) interface markers and ``spikes`` (n, 2) where they jump;
    ``coordinates`` and ``rates`` (n, 6) of the interface, measured; ``neutral_rotation`` (3, 3) and
    ``neutral_position`` (3,) of the pelvis in the neutral trial [m, world], where the rest pose was taken;
    ``pelvis_shape`` (4, 3) where the pelvis' markers are on it and ``rest_shape`` (2, 3) where those of the interface
    are to it at rest [m]; ``on_arm`` (3,) where the interface is on the robot's arm, whose roll and pitch it turns with
    [m]; ``held_out``: the trial is not the one that is fitted.
    """

    time_s: np.ndarray
    step_time_s: np.ndarray
    pelvis_rotation: np.ndarray
    pelvis_position: np.ndarray
    interface_rotation: np.ndarray
    start: int
    robot_mass: float
    measured: np.ndarray
    spikes: np.ndarray
    coordinates: np.ndarray
    rates: np.ndarray
    neutral_rotation: np.ndarray
    neutral_position: np.ndarray
    pelvis_shape: np.ndarray
    rest_shape: np.ndarray
    on_arm: np.ndarray
    held_out: bool = False


# ---------------------------------------------------------------- how the interface was seen


@dataclass(frozen=True)
class Sight:
    """What the plant is set up by: poses of the interface in the world at the start, and in the pelvis at rest.

    ``heading`` [rad] is how far the robot's log, laid on the interface's markers, is turned from the world.
    """

    rotation: np.ndarray
    position: np.ndarray
    rest_rotation: np.ndarray
    rest_position: np.ndarray
    heading: float = 0.0


class Sighting(Protocol):
    """An effect by which the interface is not where its markers are, or rests elsewhere than it was seen to.

    ``of_markers`` says whether it is about what the markers show, and no part of a model of the plant.
    """

    of_markers: bool

    def true(self, values: np.ndarray, seen: Sight, context: Context, axes: tuple[int, ...]) -> Sight:
        """What was the case, from what was seen, for values (p,) of an effect on ``axes`` of the interface."""

    def seen(
        self, paths: np.ndarray, rotation: np.ndarray, values: np.ndarray, context: Context
    ) -> np.ndarray:
        """Marker paths (m, n, 2, 3) for joint centres and rotation (m, n, 3, 3) of the interface, values (m, p)."""


class TurnedLab:
    """The interface's markers are seen in a lab turned about the vertical, values (m, 1) [rad]."""

    of_markers = True

    def true(self, values, seen, context, axes):
        """Turned back about the lab's origin, in the neutral trial as well."""
        back = Rotation.from_rotvec([0, 0, -values[0]]).as_matrix()
        pelvis, origin = context.neutral_rotation, context.neutral_position
        return Sight(
            back @ seen.rotation,
            back @ seen.position,
            pelvis.T @ back @ pelvis @ seen.rest_rotation,
            pelvis.T @ (back @ (origin + pelvis @ seen.rest_position) - origin),
            seen.heading + float(values[0]),
        )

    def seen(self, paths, rotation, values, context):
        """Turned about the lab's origin."""
        turn = Rotation.from_rotvec(values * np.array([0.0, 0.0, 1.0])).as_matrix()
        return np.einsum("mij,mnkj->mnki", turn, paths)


class OffCentre:
    """Markers that sit off the joint centres, fixed in the interface: values (m, 6) [m, interface], left and right."""

    of_markers = True

    def true(self, values, seen, context, axes):
        """Pose from the centres; of the neutral trial's, from its mean pelvis."""
        pelvis, origin = context.neutral_rotation, context.neutral_position
        half = _half(context)
        offsets = values.reshape(2, 3)
        rotation, position = _from_centres(seen.rotation, seen.position, half, offsets)
        rest = pelvis @ seen.rest_rotation, origin + pelvis @ seen.rest_position
        rest_rotation, rest_position = _from_centres(*rest, half, offsets)
        return Sight(
            rotation,
            position,
            pelvis.T @ rest_rotation,
            pelvis.T @ (rest_position - origin),
            _heading(seen, rotation),
        )

    def seen(self, paths, rotation, values, context):
        """Joint centres and their offsets."""
        return paths + np.einsum("mnij,mkj->mnki", rotation, values.reshape(-1, 2, 3))


class Retaped(OffCentre):
    """As `OffCentre`, since the neutral trial only: where the strap rests was seen rightly."""

    def true(self, values, seen, context, axes):
        """Pose at the start from the centres; rest pose as seen."""
        sight = super().true(values, seen, context, axes)
        return replace(sight, rest_rotation=seen.rest_rotation, rest_position=seen.rest_position)


class OnStrap:
    """Markers that sit on the strap, which goes a part of the way with the person: values (m, 3) are that part.

    By axis of the pelvis; 0 is a marker on the robot, 1 one that stays where the pelvis has it at rest.
    """

    of_markers = True

    def true(self, values, seen, context, axes):
        """Pose from where the markers would be on the robot; at rest they are where they were seen."""
        first = slice(0, context.start)
        pelvis, origin = mean_rotation(context.pelvis_rotation[first]), context.pelvis_position[first].mean(0)
        markers = markers_of(seen.rotation, seen.position, _half(context))
        # what is seen goes (1 - part) of the way that the robot goes
        way = ((markers - origin) @ pelvis - context.rest_shape) / (1 - values)
        left, right = origin + (context.rest_shape + way) @ pelvis.T
        rotation, position = interface_frame(left, right, seen.rotation[:, 2])
        return replace(seen, rotation=rotation, position=position, heading=_heading(seen, rotation))

    def seen(self, paths, rotation, values, context):
        """A part of the way from the robot to where the pelvis has the marker at rest."""
        pelvis, origin = context.pelvis_rotation, context.pelvis_position
        way = np.einsum("nji,mnkj->mnki", pelvis, paths - origin[None, :, None]) - context.rest_shape
        return paths - np.einsum("nij,mnkj->mnki", pelvis, values[:, None, None] * way)


class RestTurned:
    """The strap rests turned about one of its axes against the neutral trial, value (m, 1) [rad]."""

    of_markers = False

    def true(self, values, seen, context, axes):
        """Start as seen, rest pose turned about the pelvis' axis."""
        turn = Rotation.from_rotvec(values[0] * np.eye(3)[axes[0] - 3]).as_matrix()
        return replace(seen, rest_rotation=turn @ seen.rest_rotation)

    def seen(self, paths, rotation, values, context):
        """As they are."""
        return paths


class Elsewhere:
    """Interface and robot start elsewhere: values (m, 6) are displacement [m] and turn [rad] in world axes."""

    of_markers = False

    def true(self, values, seen, context, axes):
        """Moved and turned; the strap rests as seen."""
        turn = Rotation.from_rotvec(values[3:]).as_matrix()
        return replace(seen, rotation=turn @ seen.rotation, position=seen.position + values[:3])

    def seen(self, paths, rotation, values, context):
        """As they are."""
        return paths


def markers_of(rotation: np.ndarray, position: np.ndarray, half: float) -> np.ndarray:
    """Markers left and right (2, 3) [m] of an interface's pose (3, 3), (3,), ``half`` [m] from their middle."""
    return position + half * np.array([rotation[:, 1], -rotation[:, 1]])


def _half(context: Context) -> float:
    """Half of the distance [m] between the interface's markers while the person stands."""
    left, right = np.nanmean(context.measured[: context.start], axis=0)
    return float(np.linalg.norm(left - right)) / 2


def _heading(seen: Sight, true: np.ndarray) -> float:
    """How far [rad] a log that was laid on the markers is turned where the interface's rotation is ``true`` (3, 3)."""
    turned = seen.rotation @ true.T
    return seen.heading + float(np.arctan2(turned[1, 0], turned[0, 0]))


def _from_centres(
    rotation: np.ndarray, position: np.ndarray, half: float, offsets: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Pose of the interface from that of its markers, ``half`` [m] from their middle, with offsets (2, 3) [m]."""
    markers = markers_of(rotation, position, half)
    true = rotation
    # the offsets are known in the axes that are sought
    for _ in range(3):
        left, right = markers - offsets @ true.T
        true, centre = interface_frame(left, right, rotation[:, 2])
    return true, centre


# ---------------------------------------------------------------- input and output chain


def turned_motion(values, context):
    """Pelvis path (n, 3, 3), (n, 3) in the interface's frame, of a yaw (1,) [rad]."""
    # The pelvis in the interface's frame, turned about the vertical through the lab's origin. The rest pose was taken
    # in two frames too: what it holds of the turn at the place of the neutral trial goes with the pelvis.
    turn = Rotation.from_rotvec([0, 0, -values[0]]).as_matrix()
    rest, where = context.neutral_rotation, context.neutral_position
    fixed = rest.T @ turn.T @ rest
    offset = rest.T @ turn.T @ (where - turn @ where)
    rotation = turn @ context.pelvis_rotation
    return rotation @ fixed, context.pelvis_position @ turn.T + rotation @ offset


def scaled_motion(values, context):
    """Pelvis path (n, 3, 3), (n, 3) [m] seen too large by a share (1,) about the lab's origin.

    The rest pose was taken in the neutral trial, where the pelvis stood elsewhere than it was seen too.
    """
    true = 1 / (1 + values[0])
    at_rest = context.neutral_rotation.T @ context.neutral_position * (1 - true)
    return context.pelvis_rotation, context.pelvis_position * true + context.pelvis_rotation @ at_rest


def earlier_pelvis(values, context):
    """Pelvis path (n, 3, 3), (n, 3) of a pelvis that was late by a lag (1,) [s]."""
    # the measured pelvis is late: it was there already
    t = np.clip(context.time_s + values[0], context.time_s[0], context.time_s[-1])
    position = CubicSpline(context.time_s, context.pelvis_position)(t)
    vectors = Rotation.from_matrix(context.pelvis_rotation[0].T @ context.pelvis_rotation).as_rotvec()
    return (
        context.pelvis_rotation[0]
        @ Rotation.from_rotvec(CubicSpline(context.time_s, vectors)(t)).as_matrix(),
        position,
    )


def later_pelvis(values, context):
    """Pelvis path (n, 3, 3), (n, 3) of a pelvis that was early by an offset (1,) [s]."""
    return earlier_pelvis(-values, context)


# Rounds of Newton in which the bone's angles are found that its skin shows as the measured ones
_BONE_ROUNDS = 6


def soft_tissue(values, context):
    """Pelvis path (n, 3, 3), (n, 3) of the bone under the skin, values (18,)."""
    # skin moves over bone in proportion to how far the bone has turned: translation and rotation artefact
    start = context.pelvis_rotation[0]
    shift, turn = values[:9].reshape(3, 3), values[9:].reshape(3, 3)
    seen = Rotation.from_matrix(start.T @ context.pelvis_rotation)
    angles, slope = np.zeros((len(context.pelvis_rotation), 3)), np.eye(3) + turn
    for _ in range(_BONE_ROUNDS):
        beyond = (_from_cardan(angles).inv() * seen).as_rotvec() - angles @ turn.T
        angles = angles + np.linalg.solve(slope, beyond.T).T
    rotation = start @ _from_cardan(angles).as_matrix()
    return rotation, context.pelvis_position - np.einsum("nij,nj->ni", rotation, angles @ shift.T)


def wobbling_tissue(values, context):
    """Path of the bone under skin that also rings, values (20,): those of `soft_tissue`, a lag [s], a mobility [s^2].

    Skin on a spring and a damper follows the bone as a mass does: its own pose, plus its rate times the lag, plus its
    acceleration times the mobility (one over the square of its angular frequency) is where it would be without mass.
    """
    start = context.pelvis_rotation[0]
    turn = Rotation.from_matrix(start.T @ context.pelvis_rotation).as_rotvec()
    path = CubicSpline(context.time_s, np.hstack([context.pelvis_position, turn]))
    still = path(context.time_s[0], 1)
    bone = path(context.time_s) + values[18] * (path(context.time_s, 1) - still)
    bone += values[19] * path(context.time_s, 2)
    rotation = start @ Rotation.from_rotvec(bone[:, 3:]).as_matrix()
    return soft_tissue(values[:18], replace(context, pelvis_rotation=rotation, pelvis_position=bone[:, :3]))


def slides(time_s):
    """How long (n,) [s] a marker has slid, at a steady rate and at one that fades over a third of the trial."""
    t = time_s - time_s[0]
    fades = t[-1] / 3
    return t, fades * (1 - np.exp(-t / fades))


def sliding_marker(index: int):
    """Ways (n, 4, 3) [m, pelvis] of the pelvis' markers of which one (order of `PELVIS_MARKERS`) slides, values (6,).

    The first three are steady rates [m/s], the last three are rates at the start that fade over a third of the trial.
    """

    def ways(values, context):
        steady, fading = slides(context.time_s)
        out = np.zeros((len(steady), *context.pelvis_shape.shape))
        out[:, index] = steady[:, None] * values[:3] + fading[:, None] * values[3:]
        return out

    return ways


def under_skin(ways):
    """Input chain of markers that go ``ways`` (see `sliding_marker`) over the bone: the path of the bone."""

    def bone(values, context):
        rotation, position = context.pelvis_rotation, context.pelvis_position
        shape = context.pelvis_shape
        seen, true = (
            position[:, None] + np.einsum("nij,nkj->nki", rotation, on_bone)
            for on_bone in (np.tile(shape, (len(position), 1, 1)), shape - ways(values, context))
        )
        (r0, p0), (r1, p1) = (pelvis_frame(*np.moveaxis(markers, 1, 0)) for markers in (seen, true))
        return np.einsum("nij,nkj->nik", r1, r0) @ rotation, position + p1 - p0

    return bone


def _from_cardan(angles):
    """Rotations R_z R_y R_x of Cardan angles (n, 3) about x, y, z."""
    return Rotation.from_euler("ZYX", angles[:, ::-1])


def _at_times(paths, time_s, wanted):
    # paths (m, n, ...) at other times: what lies outside stays at the end
    clipped = np.clip(wanted, time_s[0], time_s[-1])
    out = np.empty_like(paths)
    for i in range(len(paths)):
        out[i] = CubicSpline(time_s, paths[i])(clipped[i])
    return out


def late_markers(paths, values, context):
    """Marker paths (m, n, 2, 3) later by offsets (m, 1) [s]."""
    return _at_times(paths, context.time_s, context.time_s[None] - values[:, :1])


def drifting_clock(paths, values, context):
    """Marker paths (m, n, 2, 3) on a clock that drifts by (m, 1)."""
    t = context.time_s - context.time_s[0]
    return _at_times(paths, context.time_s, context.time_s[0] + t[None] * (1 + values[:, :1]))


def _butterworth(paths, order, cutoff_hz, rate_hz):
    """Paths (n, ...) behind a causal low-pass that has stood at the first sample."""
    sos = butter(order, cutoff_hz, fs=rate_hz, output="sos")
    return paths[:1] + sosfilt(sos, paths - paths[:1], axis=0)


def _trailing_mean(paths, window_s, rate_hz):
    """Mean of paths (n, ...) over the last ``window_s``, which had stood at the first sample."""
    time_s = np.arange(len(paths)) / rate_hz
    moved = CubicSpline(time_s, paths - paths[:1]).antiderivative()
    return paths[:1] + (moved(time_s) - moved(np.maximum(time_s - window_s, 0.0))) / window_s


def _rate(context):
    return 1 / (context.time_s[1] - context.time_s[0])


def filtered_markers(order: int):
    """Output chain of a causal Butterworth low-pass of an order, values (m, 1) are its cut-offs [Hz]."""

    def filtered(paths, values, context):
        rows = zip(paths, values[:, 0], strict=True)
        return np.array([_butterworth(path, order, cutoff, _rate(context)) for path, cutoff in rows])

    return filtered


def lag_of_filter(order: int):
    """Lag (m,) [s] of such a filter to what is slow, of cut-offs (m, 1) [Hz]."""
    poles = np.pi * (2 * np.arange(1, order + 1) - 1) / (2 * order)
    return lambda values: np.sin(poles).sum() / (2 * np.pi * values[:, 0])


def averaged_markers(paths, values, context):
    """Marker paths (m, n, 2, 3) as means over trailing windows (m, 1) [s]."""
    rows = zip(paths, values[:, 0], strict=True)
    return np.array([_trailing_mean(path, window, _rate(context)) for path, window in rows])


def late_log(lag_of: Callable[[np.ndarray], np.ndarray]):
    """Chain of a robot log that was laid on filtered markers by motion: joints (m, n, 6) as late as they are.

    ``lag_of`` values (m, p) is their lag (m,) to what is slow [s].
    """

    def late(joints, values, context):
        return _at_times(joints, context.time_s, context.time_s[None] - lag_of(values)[:, None])

    return late


def drifting_marker(side: int):
    """Output chain of a ramp (m, 3) [m/s] in one interface marker: 0 left, 1 right."""

    def drift(paths, values, context):
        out = paths.copy()
        t = context.time_s - context.time_s[0]
        out[:, :, side] += t[None, :, None] * values[:, None, :]
        return out

    return drift


def without_spikes(paths, values, context):
    """Marker paths (m, n, 2, 3) with what was measured where it jumps."""
    # what is no marker says nothing about the model; a gap beside a jump has nothing to show instead
    out = paths.copy()
    jumps = context.spikes & np.isfinite(context.measured).all(axis=2)
    out[:, jumps] = context.measured[jumps]
    return out


# ---------------------------------------------------------------- forces on the base


def tilt(values, context, where, parameters):
    """Forces (m, steps, 2) [N] on the base of slopes (m, 2) [rad]."""
    force = 9.81 * context.robot_mass * values
    return np.repeat(force[:, None, :], len(context.step_time_s), axis=1)


def weight(values, context, where, parameters):
    """Forces (m, steps, 1) [N] on the lift of masses, the first of values (m, p) [kg]."""
    return np.repeat(-9.81 * values[:, :1, None], len(context.step_time_s), axis=1)


def moments(values, context, where, parameters):
    """Forces (m, steps, 3) [N, Nm] on lift, roll and pitch of parts, values (m, 6) of `OffCentreMass`."""
    mass, _, x, y, _, unbalanced = values.T
    # the arm turns about its own origin
    pull = 9.81 * np.stack([-unbalanced, -y - context.on_arm[1] * mass, x + context.on_arm[0] * mass], axis=1)
    return np.repeat(pull[:, None], len(context.step_time_s), axis=1)


def ratchet(values, context, where, parameters):
    """Forces (m, steps, 1) [N, Nm] on the strap joint of threshold and rate (m, 2)."""
    # the rest pose follows what is pulled beyond a threshold, at a rate, and never returns
    axis, dt = where.axes[0], context.time_s[1] - context.time_s[0]
    pulled = (where.side * context.coordinates[:, axis]).tolist()
    slipped = np.zeros((len(values), len(pulled)))
    # plain numbers: a step of arrays this short is all overhead
    for row, (threshold, rate) in zip(slipped, values.tolist(), strict=True):
        share, way, path = 1 - np.exp(-rate * dt), 0.0, []
        for here in pulled[1:]:
            beyond = here - way - threshold
            way += beyond * share if beyond > 0 else 0.0
            path.append(way)
        row[1:] = path
    force = where.side * parameters[:, axis, None] * slipped
    return np.stack([np.interp(context.step_time_s, context.time_s, row) for row in force])[:, :, None]


def wandering(values, context, where, parameters):
    """Forces (m, steps, 1) [N, Nm] on the strap joint of rates (m, 1) [m/s, rad/s]."""
    # the rest pose wanders at one rate from where the person starts to move
    return parameters[:, where.axes[0], None, None] * values[:, None, :] * _since_motion(context)[:, None]


def settling(values, context, where, parameters):
    """Forces (m, steps, 1) [N, Nm] on the strap joint, values (m, 2) are way [m, rad] and time constant [s]."""
    # the rest pose goes over to another from where the person starts to move
    gone = 1 - np.exp(-_since_motion(context) / values[:, 1:])
    return (parameters[:, where.axes[0], None] * values[:, :1] * gone)[..., None]


def _since_motion(context):
    """Time (steps,) [s] from where the person starts to move."""
    return np.maximum(context.step_time_s - context.time_s[context.start], 0.0)
