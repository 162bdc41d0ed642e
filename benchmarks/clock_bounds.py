"""Cramer-Rao bounds of the markerless clock: what offset and drift the phantom's own noise leaves knowable.

The markerless record is y(t) = x(t) + n(t) in six pelvis coordinates, x known from a phantom written without noise, n
Gaussian with the covariance of the phantom's own filter (3 mm, 0.6 deg, 6 Hz), plus the noise of the Qualisys markers
that x is compared with. An unbiased estimate of a shift and a drift of t has no smaller variance than the inverse of
their Fisher information (Kay, Estimation Theory, 1993, section 3.9). Marker noise is entered as low as four markers
allow, so the bound errs on the low side; without it the record above 6 Hz, where the filter leaves no markerless noise,
would seem to hold a clock.
"""

from __future__ import annotations

import copy
from collections.abc import Iterable
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
from real2sim.recording.formats.recordings import CoordinateRecording
from scipy.interpolate import CubicSpline
from scipy.linalg import cholesky, solve_triangular
from scipy.signal import butter, sosfiltfilt
from scipy.stats import norm

COORDINATES = ("pelvis_tx", "pelvis_ty", "pelvis_tz", "pelvis_tilt", "pelvis_list", "pelvis_rotation")
# four markers on a pelvis determine its place to sd / 2 and its angles to sd / 0.25 m at best
_PLACE, _LEVER_M = 0.5, 0.25


@dataclass(frozen=True)
class Bound:
    """Least standard errors of a trial: of the offset at the middle [s] and of the drift [s/s]."""

    offset_s: float
    drift: float


def noiseless(settings: dict[str, Any]) -> dict[str, Any]:
    """The phantom's settings without noise and gaps; motions, clocks and frames stay as they are."""
    out = copy.deepcopy(settings)
    for item in ("marker_noise", "gaps", "markerless_noise"):
        out["measurement"][item]["enabled"] = False
    return out


@cache
def _filtered(samples: int, rate_hz: float, cutoff_hz: float) -> np.ndarray:
    """Covariance (n, n) of the phantom's coloured noise of unit variance."""
    low_pass = butter(2, cutoff_hz, fs=rate_hz, output="sos")
    response = sosfiltfilt(low_pass, np.eye(samples), axis=0)
    covariance = response @ response.T
    return covariance / np.mean(np.diag(covariance))


def bound(record: CoordinateRecording, noise: dict[str, float], marker_sd_m: float, *, known: bool) -> Bound:
    """Bound of one trial from its noiseless coordinates.

    ``noise`` is the phantom's measurement.markerless_noise. With ``known`` nothing but the clock is unknown;
    otherwise each coordinate also has an unknown constant and an unknown linear part in the angles (soft tissue,
    geometry of the model), as `quality.clocks` assumes.
    """
    t = record.time_s
    rate = 1 / float(np.median(np.diff(t)))
    x = np.column_stack([record.columns[name] for name in COORDINATES])
    speed = CubicSpline(t, x)(t, 1)
    middle = float(t.mean())
    angles = x[:, 3:] - x[:, 3:].mean(axis=0)
    features = np.column_stack([np.ones(len(t)), angles])
    coloured = _filtered(len(t), rate, noise["cutoff_hz"])
    # noise of markers at 100 Hz, as it appears in a band of ``rate``
    marker = marker_sd_m * np.sqrt(rate / 100)
    information = np.zeros((2, 2))
    for kind, sd, floor in (
        (slice(0, 3), noise["position_m"], marker * _PLACE),
        (slice(3, 6), np.radians(noise["angle_deg"]), marker / _LEVER_M),
    ):
        root = cholesky(sd**2 * coloured + floor**2 * np.eye(len(t)), lower=True, check_finite=False)
        for v in speed[:, kind].T:
            design = solve_triangular(root, np.column_stack([v, v * (t - middle)]), lower=True)
            if not known:
                basis, _ = np.linalg.qr(solve_triangular(root, features, lower=True))
                design = design - basis @ (basis.T @ design)
            information += design.T @ design
    offset, drift = np.sqrt(np.diag(np.linalg.inv(information)))
    return Bound(float(offset), float(drift))


def pooled(bounds: Iterable[Bound]) -> float:
    """Least standard error [s/s] of one drift from several trials."""
    return float(sum(b.drift**-2 for b in bounds) ** -0.5)


def within(limit: float, sd: float) -> float:
    """Share of errors below ``limit`` that an efficient estimate has."""
    return float(2 * norm.cdf(limit / sd) - 1)


def power(sd: float, certainty_sd: float, low: float, high: float) -> float:
    """Share of drifts, log-uniform between ``low`` and ``high``, that a two-sided test sees."""
    drift = np.geomspace(low, high, 2001)
    seen = norm.sf(certainty_sd - drift / sd) + norm.cdf(-certainty_sd - drift / sd)
    return float(seen.mean())
