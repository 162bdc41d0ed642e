"""Tests that the files of a trial belong together: motion that two systems share, files that fit another trial."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation
from scipy.stats import norm
from scipy.stats import t as student

from real2sim import signals
from real2sim.recording import alignment
from real2sim.recording.quality import clocks


@dataclass(frozen=True)
class Shared:
    """Motion of a trial and what two systems do not share of it, both RMS [m]; an angle counts by a lever.

    ``by_second`` (k, 2) has each second of the markers' time and the mean square of the residual [m^2].
    """

    motion_m: float
    residual_m: float
    by_second: np.ndarray

    @property
    def apart(self) -> float:
        """Residual over motion [1]: 0 where the systems saw the same, about 1 where they have nothing in common."""
        return self.residual_m / max(self.motion_m, 1e-9)


@dataclass(frozen=True)
class Exchanged:
    """Trial whose file fits better than a trial's own: residuals of both [m], standard errors of the difference."""

    trial: str
    own_m: float
    other_m: float
    certainty: float


def detrended_rms(time_s: np.ndarray, values: np.ndarray) -> float:
    """Return the RMS of ``values`` (n, k) per row about a straight line in time; rows with NaN are left out."""
    good = signals.known(values)
    if good.sum() < 3:
        return 0.0
    t = time_s[good] - time_s[good].mean()
    line = np.polynomial.polynomial.polyfit(t, values[good], 1)
    left = values[good] - np.polynomial.polynomial.polyval(t, line).T
    return float(np.sqrt(np.mean(np.sum(left**2, axis=1))))


def robot_shared(fit: clocks.ClockFit | None, time_s: np.ndarray, points: np.ndarray) -> Shared | None:
    """Return what robot and interface markers ``points`` (n, 6) [m] share, RMS per axis."""
    if fit is None:
        return None
    motion = detrended_rms(time_s, points) / np.sqrt(points.shape[1])
    return Shared(float(motion), fit.residual_m, fit.by_second)


def markerless_shared(
    ours: alignment.PelvisPath,
    other: alignment.PelvisPath,
    space: alignment.SpaceFit,
    offset_s: float,
    lever_m: float,
) -> Shared | None:
    """Return what the two pelvises share.

    ``offset_s`` is added to the markerless time to get ours; ``lever_m`` [m/rad] weighs rotations against positions.
    """
    good = np.isfinite(ours.rotation).all(axis=(1, 2)) & signals.known(ours.position)
    t = ours.time_s - offset_s
    rows = np.flatnonzero(good & (t >= other.time_s[0]) & (t <= other.time_s[-1]))
    if len(rows) < 3:
        return None
    p = CubicSpline(other.time_s, other.position)(t[rows])
    flat = CubicSpline(other.time_s, other.rotation.reshape(-1, 9))(t[rows])
    r = Rotation.from_matrix(flat.reshape(-1, 3, 3)).as_matrix()
    p = (p + r @ space.lever) @ space.rotation.T + space.translation
    turn = Rotation.from_matrix(space.rotation @ r @ space.body @ np.swapaxes(ours.rotation[rows], 1, 2))
    residual = np.hstack([p - ours.position[rows], lever_m * turn.as_rotvec()])
    mean = Rotation.from_matrix(ours.rotation[rows]).mean().inv()
    angles = (Rotation.from_matrix(ours.rotation[rows]) * mean).as_rotvec()
    motion = detrended_rms(ours.time_s[rows], np.hstack([ours.position[rows], lever_m * angles]))
    by_second = clocks.mean_squares(ours.time_s[rows], residual)
    return Shared(motion, float(np.sqrt(np.mean(np.sum(residual**2, axis=1)))), by_second)


def compare_residuals(own: Shared, other: Shared, least_s: float) -> float:
    """Return how much better ``other`` fits than ``own``, in standard errors of a normal distribution.

    Mean logarithm of the ratio of the two mean squares, second by second (Vuong's test of two models that do not
    contain one another, Econometrica 57 (1989) 307), by Student's t. Negative where the trial's own file fits better;
    0 where less than ``least_s`` [s] are in common.
    """
    both, i, j = np.intersect1d(own.by_second[:, 0], other.by_second[:, 0], return_indices=True)
    if len(both) < least_s:
        return 0.0
    with np.errstate(divide="ignore", invalid="ignore"):
        gain = np.log(own.by_second[i, 1] / other.by_second[j, 1])
    gain = gain[np.isfinite(gain)]
    if len(gain) < least_s:
        return 0.0
    t = float(gain.mean() / max(gain.std(ddof=1) / np.sqrt(len(gain)), 1e-12))
    tail = student.sf(abs(t), len(gain) - 1)
    return float(np.sign(t) * norm.isf(max(float(tail), 1e-300)))


def find_better(
    own: Shared, others: Iterable[str], fit: Callable[[str], Shared | None], least_s: float
) -> dict[str, Exchanged]:
    """Return the other trials whose file leaves a smaller residual on a trial's markers than its own, by name.

    Parameters
    ----------
    fit
        Lays the file of a trial, by its name, on the markers.
    least_s
        Seconds in common from which two files are compared [s].
    """
    out = {}
    for name in others:
        shared = fit(name)
        if shared is not None and shared.residual_m < own.residual_m:
            certainty = compare_residuals(own, shared, least_s)
            out[name] = Exchanged(name, own.residual_m, shared.residual_m, certainty)
    return out


def choose_exchanges(
    better: Mapping[str, Mapping[str, Exchanged]], certainty_sd: float
) -> dict[str, Exchanged]:
    """Return, by trial, the other trial whose file certainly fits better; of several the one that fits best.

    Two trials whose files fit each other's markers better are one hypothesis, an exchange, with independent evidence
    from both: their standard errors are pooled (Stouffer). ``better`` is what `find_better` found, by trial.
    """
    out = {}
    for name, others in better.items():
        certain = []
        for other, found in others.items():
            mutual = better.get(other, {}).get(name)
            pooled = (found.certainty + mutual.certainty) / np.sqrt(2) if mutual is not None else 0.0
            certainty = max(found.certainty, float(pooled))
            if certainty >= certainty_sd:
                certain.append(replace(found, certainty=certainty))
        if certain:
            out[name] = min(certain, key=lambda found: found.other_m)
    return out
