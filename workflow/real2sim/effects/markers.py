"""Markers that sit off their place, slide, or jump."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from real2sim.effects.base import AtRest, Effect, EffectParameter, near_zero
from real2sim.effects.chains import (
    Chains,
    Context,
    Displacement,
    InputChain,
    Observation,
    OutputChain,
    Poses,
    markers_of,
)
from real2sim.effects.displacements import DEFLECTIONS, deflected_by
from real2sim.effects.frames import RESTS
from real2sim.effects.migration import DRIFTS
from real2sim.geometry import PELVIS_MARKERS, interface_frame, mean_rotation, pelvis_frame
from real2sim.signals import steady_and_fading


class OffCentre(Observation):
    """Markers that sit off the joint centres, fixed in the interface: values (m, 6) [m, interface], left and right."""

    def true_poses(self, values: np.ndarray, seen: Poses, context: Context, axes: tuple[int, ...]) -> Poses:
        """Find the poses from the centres; that of the neutral trial from its mean pelvis."""
        pelvis, origin = context.neutral.rotation, context.neutral.position
        half = _half(context)
        offsets = values.reshape(2, 3)
        rotation, position = _from_centres(seen.rotation, seen.position, half, offsets)
        rest = pelvis @ seen.rest_rotation, origin + pelvis @ seen.rest_position
        rest_rotation, rest_position = _from_centres(*rest, half, offsets)
        return Poses(
            rotation,
            position,
            pelvis.T @ rest_rotation,
            pelvis.T @ (rest_position - origin),
            _heading(seen, rotation),
        )

    def observe(
        self, paths: np.ndarray, rotation: np.ndarray, values: np.ndarray, context: Context
    ) -> np.ndarray:
        """Add the offsets to the joint centres."""
        return np.asarray(paths + np.einsum("mnij,mkj->mnki", rotation, values.reshape(-1, 2, 3)))


class Retaped(OffCentre):
    """As `OffCentre`, since the neutral trial only: the rest pose was observed rightly."""

    def true_poses(self, values: np.ndarray, seen: Poses, context: Context, axes: tuple[int, ...]) -> Poses:
        """Find the pose at the start from the centres; the rest pose is as observed."""
        poses = super().true_poses(values, seen, context, axes)
        return replace(poses, rest_rotation=seen.rest_rotation, rest_position=seen.rest_position)


class OnStrap(Observation):
    """Markers that sit on the strap and move a part of the way with the person: values (m, 3) are that part.

    By axis of the pelvis; 0 is a marker on the robot, 1 one that stays where the pelvis has it at rest.
    """

    def true_poses(self, values: np.ndarray, seen: Poses, context: Context, axes: tuple[int, ...]) -> Poses:
        """Find the pose at the start from where the markers would be on the robot; at rest they are as observed."""
        first = slice(0, context.start)
        pelvis, origin = mean_rotation(context.pelvis_rotation[first]), context.pelvis_position[first].mean(0)
        markers = markers_of(seen.rotation, seen.position, _half(context))
        # the markers move (1 - part) of the way of the robot
        way = ((markers - origin) @ pelvis - context.shapes.interface) / (1 - values)
        left, right = origin + (context.shapes.interface + way) @ pelvis.T
        rotation, position = interface_frame(left, right, seen.rotation[:, 2])
        return replace(seen, rotation=rotation, position=position, heading=_heading(seen, rotation))

    def observe(
        self, paths: np.ndarray, rotation: np.ndarray, values: np.ndarray, context: Context
    ) -> np.ndarray:
        """Move the markers a part of the way from the robot to where the pelvis has them at rest."""
        pelvis, origin = context.pelvis_rotation, context.pelvis_position
        way = np.einsum("nji,mnkj->mnki", pelvis, paths - origin[None, :, None]) - context.shapes.interface
        return np.asarray(paths - np.einsum("nij,mnkj->mnki", pelvis, values[:, None, None] * way))


def _half(context: Context) -> float:
    """Return half of the distance [m] between the interface's markers while the person stands."""
    left, right = np.nanmean(context.measured[: context.start], axis=0)
    return float(np.linalg.norm(left - right)) / 2


def _heading(seen: Poses, true: np.ndarray) -> float:
    """Return the heading [rad] of a log aligned to markers where the interface's rotation is ``true`` (3, 3)."""
    turned = seen.rotation @ true.T
    return seen.heading + float(np.arctan2(turned[1, 0], turned[0, 0]))


def _from_centres(
    rotation: np.ndarray, position: np.ndarray, half: float, offsets: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return the pose of the interface from that of markers ``half`` [m] from their middle, with offsets (2, 3) [m]."""
    markers = markers_of(rotation, position, half)
    true = rotation
    # the offsets are given in the axes that are to be found: iterate
    for _ in range(3):
        left, right = markers - offsets @ true.T
        true, centre = interface_frame(left, right, rotation[:, 2])
    return true, centre


def sliding_marker(index: int) -> Displacement:
    """Return the displacements (n, 4, 3) [m, pelvis] of the pelvis markers of which one slides, for values (6,).

    ``index`` counts `PELVIS_MARKERS`. The first three values are steady rates [m/s], the last three rates at the start
    that fade over a third of the trial.
    """

    def displacement(values: np.ndarray, context: Context) -> np.ndarray:
        steady, fading = steady_and_fading(context.time_s)
        out = np.zeros((len(steady), *context.shapes.segment.shape))
        out[:, index] = steady[:, None] * values[:3] + fading[:, None] * values[3:]
        return out

    return displacement


def under_skin(displacement: Displacement) -> InputChain:
    """Return the input chain of pelvis markers with a displacement (see `sliding_marker`): the path of the bone."""

    def bone(values: np.ndarray, context: Context) -> tuple[np.ndarray, np.ndarray]:
        rotation, position = context.pelvis_rotation, context.pelvis_position
        shape = context.shapes.segment
        seen, true = (
            position[:, None] + np.einsum("nij,nkj->nki", rotation, on_bone)
            for on_bone in (np.tile(shape, (len(position), 1, 1)), shape - displacement(values, context))
        )
        (r0, p0), (r1, p1) = (pelvis_frame(*np.moveaxis(markers, 1, 0)) for markers in (seen, true))
        return np.einsum("nij,nkj->nik", r1, r0) @ rotation, position + p1 - p0

    return bone


def drifting_marker(side: int) -> OutputChain:
    """Return the output chain of a ramp (m, 3) [m/s] in one interface marker: 0 left, 1 right."""

    def drift(paths: np.ndarray, values: np.ndarray, context: Context) -> np.ndarray:
        out = paths.copy()
        t = context.time_s - context.time_s[0]
        # of a described system the observations (m, n, c) begin with its markers, coordinate by coordinate
        marker = out[:, :, side] if out.ndim == 4 else out[:, :, 3 * side : 3 * side + 3]
        marker += t[None, :, None] * values[:, None, :]
        return out

    return drift


def without_spikes(paths: np.ndarray, values: np.ndarray, context: Context) -> np.ndarray:
    """Return marker paths (m, n, k, 3) with the measurement where it jumps."""
    # a jump is no evidence about the model; a gap beside it has no measurement to show instead
    out = paths.copy()
    seen = np.isfinite(context.measured).reshape(*context.spikes.shape, -1).all(axis=-1)
    jumps = context.spikes & seen
    out[:, jumps] = context.measured[jumps]
    return out


EFFECTS = (
    Effect(
        "marker_offset",
        "output",
        "a marker sits off the joint centre, fixed in the interface",
        tuple(near_zero(f"{side}_{c}", "m", 0.03, 0.15) for side in ("left", "right") for c in "xyz"),
        separating_trial="static poses at several headings",
        at_rest=AtRest((0.0,) * 6),
        confusable=RESTS,
        group="S",
        scope="whole",
        needs=frozenset({"bar", "pose"}),
        chains=Chains(observation=OffCentre(), kinds=("turned markers",)),
        remedy=(
            "Take from each interface marker its offset, turned with the interface, and ingest anew. Start and rest"
            " pose of this model are the true ones; its sites are the joint centres, not the markers"
        ),
    ),
    Effect(
        "marker_offset",
        "output",
        "a marker was taped anew after the neutral trial, off where it was, fixed in the interface",
        tuple(near_zero(f"{side}_{c}", "m", 0.03, 0.15) for side in ("left", "right") for c in "xyz"),
        separating_trial="static poses at several headings",
        at_rest=AtRest((0.0,) * 6),
        confusable=RESTS,
        group="S",
        scope="whole",
        needs=frozenset({"bar", "pose"}),
        chains=Chains(observation=Retaped(), kinds=("turned markers",)),
        form="retaped",
        remedy=(
            "Take from each interface marker its offset, turned with the interface, in all trials but neutral, and"
            " ingest anew. The start pose of this model is the true one; its sites are where the markers were in it"
        ),
    ),
    Effect(
        "marker_offset",
        "output",
        "the interface's markers sit on the strap and go a part of the way with the person",
        tuple(EffectParameter(f"part_{c}", "1", -0.2, 0.9, (0.1,)) for c in "xyz"),
        separating_trial="static poses at several headings",
        at_rest=AtRest((0.0, 0.0, 0.0)),
        confusable=RESTS,
        group="S",
        scope="whole",
        needs=frozenset({"bar", "pose"}),
        chains=Chains(observation=OnStrap(), kinds=("turned markers", *map(deflected_by, DEFLECTIONS))),
        form="on_strap",
        remedy=(
            "Tape the markers to the robot's side of the interface. Start of this model is where the robot truly was;"
            " its sites go all the way with the robot"
        ),
    ),
    *(
        Effect(
            "marker_drift",
            "output",
            f"a ramp in the {side} interface marker",
            tuple(near_zero(f"{side}_{c}", "m/s", 0.005, 0.05) for c in "xyz"),
            separating_trial="distance between markers at the start and at the end",
            at_rest=AtRest((0.0,) * 3),
            confusable=DRIFTS,
            group="Dft",
            scope="whole",
            needs=frozenset({"bar"}),
            chains=Chains(output=drifting_marker(index), kinds=("drifting markers",)),
            form=f"{side}",
            remedy="Take from the interface marker the ramp: its rate times the time from the start",
        )
        for index, side in enumerate(("left", "right"))
    ),
    *(
        Effect(
            "marker_drift",
            "input",
            f"the pelvis marker {marker} slides: steadily, and at a rate that fades over a third of the trial",
            tuple(
                near_zero(f"{kind}_{c}", "m/s", 0.002, 0.02) for kind in ("steady", "fading") for c in "xyz"
            ),
            separating_trial="distance between markers at the start and at the end",
            at_rest=AtRest((0.0,) * 6),
            confusable=DRIFTS,
            group="Dft",
            scope="whole",
            needs=frozenset({"pelvis_markers", "pose"}),
            chains=Chains(
                input=under_skin(sliding_marker(index)),
                displacement=sliding_marker(index),
                kinds=("drifting segment",),
            ),
            form=marker.lower(),
            remedy=f"Ingest the pelvis anew without {marker}, or with its way over the bone taken from it",
        )
        for index, marker in enumerate(PELVIS_MARKERS)
    ),
    Effect(
        "outliers",
        "output",
        "isolated samples of a marker are not the marker",
        (),
        separating_trial="the same trial, labelled again",
        at_rest=AtRest(()),
        scope="whole",
        chains=Chains(output=without_spikes),
        remedy="Label the jumping interface markers again, or leave those samples out",
    ),
)
