"""A pelvis marker that is lost for long, put back from the other three.

The four are no rigid body: skin carries each of them along as the pelvis turns and as the skin stretches. How far is
read from the frames of the same trial in which all four are seen, as intercorrelations of markers are (Gløersen and
Federolf 2016, doi:10.1371/journal.pone.0152616).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from scipy.spatial.transform import Rotation

from real2sim import signals
from real2sim.geometry import mean_rotation, pelvis_frame
from real2sim.recording import alignment

if TYPE_CHECKING:
    from real2sim.settings import IngestSkinSettings


# Shapes of what is missed in a gap, and gaps that are made to learn how large they are
_SHAPES, _MADE = 3, 20


@dataclass(frozen=True)
class PutBack:
    """A gap of a pelvis marker, by its number, that was put back, and SD (k, 3) [m, world] of `shapes` missed in it."""

    marker: int
    gap: slice
    sd: np.ndarray

    def missed(self, samples: int) -> np.ndarray:
        """Return displacements (3k, n, 4, 3) [m] of the pelvis markers by one SD of each shape and direction.

        ``samples`` is n, of the whole trial.
        """
        each = shapes(self.gap.stop - self.gap.start)
        out = np.zeros((len(each), 3, samples, 4, 3))
        for direction in range(3):
            out[:, direction, self.gap, self.marker, direction] = self.sd[:, direction, None] * each
        return out.reshape(-1, samples, 4, 3)


def shapes(length: int) -> np.ndarray:
    """Return half-sines (k, length) of RMS 1 over a gap: nothing is missed at its edges, where it is joined."""
    way = np.arange(1, length + 1) / (length + 1)
    return np.asarray(np.sqrt(2) * np.sin(np.pi * np.arange(1, _SHAPES + 1)[:, None] * way))


def error_of_put_back(
    points: np.ndarray, seen: np.ndarray, missing: int, gap: slice, skin: IngestSkinSettings
) -> PutBack:
    """Return how well a marker is known that `put_back` brings back in a gap of a trial.

    It is what `put_back` misses in gaps of this length that are made where all four markers are seen, or of half of the
    longest such stretch where that is shorter. Where they are never seen together nothing tells, and the
    marker is taken as known: the SD are 0.
    ``points`` (n, 4, 3) [m], ``seen`` (n, 4) and ``skin`` as of `put_back`.
    """
    runs = signals.segments(np.asarray(seen.all(axis=1)))
    longest = max((run.stop - run.start for run in runs), default=0)
    length = min(gap.stop - gap.start, longest // 2)
    starts = [start for run in runs for start in range(run.start + 1, run.stop - length)] if length else []
    if not starts:
        return PutBack(missing, gap, np.zeros((_SHAPES, 3)))
    model = places_in_pelvis(np.where(seen[:, :, None], points, np.nan))
    chosen = np.unique(np.linspace(0, len(starts) - 1, _MADE).round().astype(int))
    sizes = []
    for start in (starts[i] for i in chosen):
        made, there = slice(start, start + length), seen.copy()
        there[made, missing] = False
        filled = put_back(points, there, model, missing, [made], skin)
        sizes.append(shapes(length) @ (filled[made] - points[made, missing]) / length)
    return PutBack(missing, gap, np.sqrt(np.mean(np.square(sizes), axis=0)))


def places_in_pelvis(points: np.ndarray) -> np.ndarray:
    """Return the mean places (4, 3) of the pelvis markers (n, 4, 3) in the pelvis [m], where all four are seen."""
    rotation, origin = pelvis_frame(*np.moveaxis(points, 1, 0))
    local = np.einsum("nji,nkj->nki", rotation, points - origin[:, None])
    return np.asarray(local[np.isfinite(local).all(axis=(1, 2))].mean(axis=0))


def put_back(
    points: np.ndarray,
    seen: np.ndarray,
    model: np.ndarray,
    missing: int,
    gaps: Sequence[slice],
    skin: IngestSkinSettings,
) -> np.ndarray:
    """Return the path (n, 3) [m] of the marker ``missing`` with its gaps filled from the other three.

    ``points`` (n, 4, 3) [m] are in the world with z up, ``seen`` (n, 4) where they were measured, and ``model`` (4, 3)
    [m] their places in the pelvis at rest; ``skin`` is the slice ``ingest.skin`` of the configuration. A gap is NaN
    where the other three are not all seen. Without a frame in which all four are, they are taken for a rigid body.
    """
    out = np.where(seen[:, missing, None], points[:, missing], np.nan)
    there = _place(points, seen, model, missing, skin)
    offset = out - there
    for gap in gaps:
        out[gap] = there[gap] + bridge(offset, gap)
    return out


def _place(
    points: np.ndarray, seen: np.ndarray, model: np.ndarray, missing: int, skin: IngestSkinSettings
) -> np.ndarray:
    """Return where the marker is by the other three (n, 3), as of `put_back` but for what is missed at the edges."""
    others = [i for i in range(points.shape[1]) if i != missing]
    known = seen[:, others].all(axis=1)
    out = np.full((len(points), 3), np.nan)
    rotation, rigid = alignment.rebuild_point(points[known], model, missing)
    out[known] = rigid
    both = seen[known, missing]
    if both.any():
        causes = _causes(rotation, points[known][:, others], skin["most_twist_rad"])
        way = np.einsum("nji,nj->ni", rotation[both], points[known, missing][both] - rigid[both])
        prior = [np.inf, *[skin["carried_m_per_rad"]] * 3, *[skin["carried_per_stretch"]] * 3]
        carried = causes @ _fitted(causes[both], way, np.array(prior))
        out[known] += np.einsum("nij,nj->ni", rotation, carried)
    return out


def bridge(offset: np.ndarray, gap: slice) -> np.ndarray:
    """Return what to add to a marker in a gap (k, 3): measured minus put back (n, 3) at its edges, linear between.

    What carries the skin along is not all known; without this the pose would jump where the marker is lost and found.
    """
    edges = {}
    for at, near in (
        (gap.start, slice(max(gap.start - 5, 0), gap.start)),
        (gap.stop, slice(gap.stop, gap.stop + 5)),
    ):
        good = signals.known(offset[near])
        if good.any():
            edges[at] = offset[near][good].mean(axis=0)
    if not edges:
        return np.zeros((gap.stop - gap.start, 3))
    k = np.arange(gap.start, gap.stop)
    return np.column_stack([np.interp(k, list(edges), [e[c] for e in edges.values()]) for c in range(3)])


def _causes(rotation: np.ndarray, others: np.ndarray, most_twist_rad: float) -> np.ndarray:
    """Return what carries skin along, (n, 7): a constant, the pelvis' turn [rad], the stretch between the others [m].

    Skin follows the pelvis against the legs. Who turns round takes the legs along: beyond a twist the heading is left
    out.
    """
    heading = np.unwrap(np.arctan2(rotation[:, 1, 0], rotation[:, 0, 0]))
    if np.ptp(heading) > most_twist_rad:
        rotation = Rotation.from_euler("z", -heading[:, None]).as_matrix() @ rotation
    turn = Rotation.from_matrix(mean_rotation(rotation).T @ rotation).as_rotvec()
    apart = np.linalg.norm(others - np.roll(others, 1, axis=1), axis=2)
    return np.column_stack([np.ones(len(turn)), turn, apart - apart.mean(axis=0)])


def _fitted(causes: np.ndarray, way: np.ndarray, prior_sd: np.ndarray) -> np.ndarray:
    """Return coefficients (k, 3) of a linear fit with a Gaussian prior of SD (k,), at the noise of the fit without."""
    free = np.linalg.lstsq(causes, way, rcond=None)[0]
    noise = float(np.sqrt(np.mean((way - causes @ free) ** 2)))
    rows, nothing = np.diag(noise / prior_sd), np.zeros((len(prior_sd), way.shape[1]))
    return np.asarray(np.linalg.lstsq(np.vstack([causes, rows]), np.vstack([way, nothing]), rcond=None)[0])
