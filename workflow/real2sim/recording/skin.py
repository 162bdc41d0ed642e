"""What markers of one body say of each other: whether a marker has slid as far as an effect would have it slide.

Whatever the body does, four markers on it keep their places against each other but for their noise, and for skin that
moves. An effect that moves one of them is held to what these six numbers show. They speak against it and not for it: a
marker that slides a little is no reason for a gap.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from real2sim.geometry import cardan_angles, pelvis_frame, turn_products
from real2sim.signals import steady_and_fading

if TYPE_CHECKING:
    from real2sim.settings import DiagnosisSkinSettings


@dataclass(frozen=True)
class Skin:
    """Slow ways of the pelvis' markers against each other in a trial of n samples.

    ``spans`` (k, n) takes the mean over each span where all markers are seen; ``against`` (12, 6) takes displacements
    of the four markers in the pelvis to what no motion of a rigid body makes; ``trends`` (2, k) fits what a marker does
    that slides steadily or ever slower, beside a constant, so that their noise is one; ``seen`` (12,) are the trends
    of the trial and ``weights`` (6,) [1/m] bring a prediction to their units.
    """

    spans: np.ndarray
    against: np.ndarray
    trends: np.ndarray
    weights: np.ndarray
    seen: np.ndarray

    def departures(self, ways: np.ndarray) -> np.ndarray:
        """Residuals of displacements (n, 4, 3) [m, pelvis] that are said to have been, in units of their noise."""
        means = self.spans @ ways.reshape(len(ways), 12)
        return np.asarray((self.trends @ means @ self.against * self.weights).ravel() - self.seen)

    def against_it(self, ways: np.ndarray) -> float:
        """Return the cost of displacements (n, 4, 3) [m, pelvis] that the markers do not show; 0 where they do."""
        off = self.departures(ways)
        return max(float(off @ off - self.seen @ self.seen), 0.0)


def skin_of(
    time_s: np.ndarray, markers: np.ndarray, shape: np.ndarray, options: DiagnosisSkinSettings
) -> Skin | None:
    """Return what pelvis markers (n, 4, 3) [m, world] say, given where they are on the pelvis, ``shape`` (4, 3) [m].

    ``options`` is the slice ``diagnosis.skin`` of the configuration. None where too little of the trial shows all four.
    """
    seen = np.isfinite(markers).all(axis=(1, 2))
    span = np.floor((time_s - time_s[0]) / options["span_s"]).astype(int)
    spans = np.array([(span == i) & seen for i in range(span[-1] + 1)], dtype=float)
    spans = spans[spans.sum(axis=1) >= 0.5 * np.bincount(span)]
    if len(spans) < options["fewest_spans"]:
        return None
    spans /= spans.sum(axis=1, keepdims=True)
    off = on_pelvis(markers) - shape
    off[~seen] = 0.0
    against = _against_rigid(shape)
    means = spans @ off.reshape(len(off), 12) @ against
    laws = spans @ np.column_stack([np.ones(len(time_s)), *steady_and_fading(time_s)])
    normal = np.linalg.inv(laws.T @ laws)
    fit = normal @ laws.T
    left = means - laws @ (fit @ means)
    variance = np.sum(left**2, axis=0) / (len(spans) - laws.shape[1])
    # one number's scatter over a few spans may be small by chance
    sd = np.sqrt(np.maximum(np.maximum(variance, variance.mean()), options["smallest_sd_m"] ** 2))
    whiten = np.linalg.inv(np.linalg.cholesky(normal[1:, 1:]))
    slow = whiten @ fit[1:]
    return Skin(spans, against, slow, 1 / sd, (slow @ means / sd).ravel())


def skin_by_turn(path: np.ndarray, seen: np.ndarray, shape: np.ndarray) -> np.ndarray:
    """Return how a segment's markers move on it as it turns (10, k, 3): the least-squares fit in `turn_products`.

    ``path`` (n, 3, 3) is its rotation, whose Cardan angles count from the first sample; ``seen`` (n, k, 3) [m] where
    its markers are on it, NaN where they are lost; ``shape`` (k, 3) [m] their mean places, which the fit is beside.
    """
    off = seen - shape
    known = np.isfinite(off).all(axis=(1, 2))
    products = turn_products(cardan_angles(path[0].T @ path))[known]
    fitted, *_ = np.linalg.lstsq(products, off[known].reshape(len(products), -1), rcond=None)
    return np.asarray(fitted.reshape(-1, *shape.shape))


def on_pelvis(markers: np.ndarray) -> np.ndarray:
    """Return the pelvis' markers (n, 4, 3) [m, world] in the frame that they show, (n, 4, 3) [m]."""
    rotation, position = pelvis_frame(*np.moveaxis(markers, 1, 0))
    return np.asarray(np.einsum("nji,nkj->nki", rotation, markers - position[:, None]))


def _against_rigid(shape: np.ndarray) -> np.ndarray:
    """Orthonormal basis (12, 6) of what displaces four markers at ``shape`` (4, 3) and is no motion of a rigid body."""
    turns = np.stack([np.cross(axis, shape).ravel() for axis in np.eye(3)], axis=1)
    rigid = np.hstack([np.tile(np.eye(3), (4, 1)), turns])
    basis, _ = np.linalg.qr(rigid, mode="complete")
    return np.asarray(basis[:, 6:])
