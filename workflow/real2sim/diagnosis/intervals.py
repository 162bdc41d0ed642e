"""How well the parameters of a fit and the values of its effects are known: verdicts and 95 % intervals."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from real2sim.diagnosis.corrected import Correction, corrected
from real2sim.diagnosis.refit import Hypothesis, JointResiduals, following
from real2sim.diagnosis.search import Pair, Search
from real2sim.effects.catalogue import Placed
from real2sim.inference.identifiability import interval_verdict

if TYPE_CHECKING:
    from real2sim.settings import Settings


@dataclass(frozen=True)
class Known:
    """Knowledge of one parameter: value less its bias by noise of the drive [SI], interval, bias, verdict."""

    unbiased: float
    ci95: tuple[float, float]
    bias_ln: float
    verdict: str


def parameter_verdicts(pair: Pair, hypothesis: Hypothesis, samples: int, settings: Settings) -> list[Known]:
    """Return what a fit says of each parameter of the system, as the identification does.

    ``unbiased`` is the fitted value, less its bias by noise of the drive (``bias_ln``) where that is more than its SD
    and the rest is known. The interval, cut at the search's bounds, is about the point without the bias. What the fit
    leaves beyond noise, of ``samples`` residuals of the fitted trial, widens it. A parameter whose SD cannot be
    computed is not determined, and its interval is the range of the search. ``settings`` are the slices ``diagnosis``
    and ``identifiability``.
    """
    options, limits = settings["diagnosis"], settings["identifiability"]
    point, covariance = corrected(pair, hypothesis, Correction.from_options(options["search"]))
    n = len(hypothesis.base)
    excess = 1 + max(Search(pair, options["search"]).above_by_trial(hypothesis)[0], 0.0) / samples
    sd = np.hypot(np.sqrt(_variances(covariance)[:n] * excess), options["report"]["plant_sd_ln"])
    bias = hypothesis.base - point[:n]
    lower, upper = pair.system.bounds()
    out = []
    for i in range(n):
        value, s, b = hypothesis.z[i], sd[i], bias[i]
        ends = np.clip([value - b - 1.96 * s, value - b + 1.96 * s], lower[i], upper[i])
        told = abs(b) > s and s < limits["weak_sd_ln"]
        unbiased = np.clip(value - b, lower[i], upper[i]) if told else value
        near = limits["at_bound_ln"]
        verdict = interval_verdict(
            float(s),
            float(b),
            too_wide=bool(s > limits["weak_sd_ln"]),
            at_bound=bool(value - lower[i] < near or upper[i] - value < near),
            determined_sd_ln=limits["determined_sd_ln"],
        )
        si = np.exp if pair.system.parameters[i].log else np.asarray
        low, high = si(ends)
        out.append(Known(float(si(unbiased)), (float(low), float(high)), float(b), verdict))
    return out


def effect_intervals(pair: Pair, hypothesis: Hypothesis, placed: Placed) -> list[tuple[float, float]]:
    """Return 95 % intervals [SI] of an effect's parameters, from the curvature at the joint optimum."""
    covariance = covariance_of(pair, hypothesis)
    first = len(hypothesis.base)
    for other in hypothesis.effects:
        if other is placed:
            break
        first += len(other.effect.parameters)
    own = slice(first, first + len(placed.effect.parameters))
    sd = np.sqrt(_variances(covariance)[own])
    x = hypothesis.z[own]
    lower, upper = placed.bounds()
    low = placed.values(np.clip(x - 1.96 * sd, lower, upper)[None])[0]
    high = placed.values(np.clip(x + 1.96 * sd, lower, upper)[None])[0]
    return [(float(min(a, b)), float(max(a, b))) for a, b in zip(low, high, strict=True)]


def _variances(covariance: np.ndarray) -> np.ndarray:
    """Return the diagonal (n,) of a covariance (n, n), infinite where it is negative or not finite."""
    variance = np.diag(covariance)
    return np.where(np.isfinite(variance) & (variance >= 0), variance, np.inf)


def covariance_of(pair: Pair, hypothesis: Hypothesis) -> np.ndarray:
    """Return the covariance (n + p, n + p) of the searched numbers, from the curvature at the joint optimum."""
    problem = following(pair.train, hypothesis, pair.system)
    _, jacobian = problem.with_jacobian(hypothesis.z, np.arange(len(hypothesis.z)))
    normal = jacobian.T @ jacobian
    elsewhere = JointResiduals(pair.held_out, hypothesis.effects, pair.system)
    if len(elsewhere.free):
        _, own = elsewhere.with_jacobian(hypothesis.z, elsewhere.free)
        normal[np.ix_(elsewhere.free, elsewhere.free)] += own.T @ own
    normal[np.diag_indices_from(normal)] += 1e-9
    return np.asarray(np.linalg.inv(normal))
