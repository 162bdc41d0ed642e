"""How well the parameters of a fit and the values of its effects are known: verdicts and 95 % intervals."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from real2sim.diagnosis.corrected import Correction, corrected
from real2sim.diagnosis.refit import Hypothesis, JointResiduals, following
from real2sim.diagnosis.search import Pair, Search
from real2sim.inference.identifiability import interval_verdict

if TYPE_CHECKING:
    from real2sim.settings import DiagnosisReportSettings, DiagnosisSettings, Settings
    from real2sim.system.description import System


@dataclass(frozen=True)
class Known:
    """Knowledge of one parameter: value less its bias by noise of the drive [SI], interval, bias, verdict.

    ``bias_ln`` is in ln-units, of a parameter that is no logarithm in those of `unit_of`.
    """

    unbiased: float
    ci95: tuple[float, float]
    bias_ln: float
    verdict: str


@dataclass(frozen=True)
class Precision:
    """Knowledge of a hypothesis' searched numbers.

    ``covariance`` (n + p, n + p) by the curvature at the joint optimum; ``wider`` (n + p,), at least 1, are factors on
    its SDs.
    """

    covariance: np.ndarray
    wider: np.ndarray

    @property
    def widened(self) -> np.ndarray:
        """Return the covariance (n + p, n + p) with the factors in it."""
        return self.covariance * np.outer(self.wider, self.wider)


def parameter_verdicts(
    pair: Pair, hypothesis: Hypothesis, wider: np.ndarray, settings: Settings
) -> list[Known]:
    """Return what a fit says of each parameter of the system, as the identification does.

    ``unbiased`` is the fitted value, less its bias by noise of the drive (``bias_ln``) where that is more than its SD
    and the rest is known. The interval, cut at the search's bounds, is about the point without the bias; its SD by the
    curvature is multiplied by ``wider`` (n + p,) of a `Precision`. A parameter whose SD cannot be computed is not
    determined, and its interval is the range of the search. ``settings`` are the slices ``diagnosis`` and
    ``identifiability``.
    """
    options, limits = settings["diagnosis"], settings["identifiability"]
    point, covariance = corrected(pair, hypothesis, Correction.from_options(options["search"]))
    n = len(hypothesis.base)
    least = least_sd(pair.system, hypothesis.base, options["report"])
    sd = np.hypot((np.sqrt(_variances(covariance)) * wider)[:n], least)
    bias, unit = hypothesis.base - point[:n], unit_of(pair.system, hypothesis.base, options["report"])
    lower, upper = pair.system.bounds()
    out = []
    for i in range(n):
        value, s, b = hypothesis.z[i], sd[i], bias[i]
        ends = np.clip([value - b - 1.96 * s, value - b + 1.96 * s], lower[i], upper[i])
        relative = s / unit[i]
        told = abs(b) > s and relative < limits["weak_sd_ln"]
        unbiased = np.clip(value - b, lower[i], upper[i]) if told else value
        near = limits["at_bound_ln"] * unit[i]
        verdict = interval_verdict(
            float(relative),
            float(b / unit[i]),
            too_wide=bool(relative > limits["weak_sd_ln"]),
            at_bound=bool(value - lower[i] < near or upper[i] - value < near),
            determined_sd_ln=limits["determined_sd_ln"],
        )
        si = np.exp if pair.system.parameters[i].log else np.asarray
        low, high = si(ends)
        out.append(Known(float(si(unbiased)), (float(low), float(high)), float(b / unit[i]), verdict))
    return out


def unit_of(system: System, z: np.ndarray, options: DiagnosisReportSettings) -> np.ndarray:
    """Return what an SD of each parameter (n,) is judged in, so that the verdict is the same in any unit.

    1 of a logarithm. Of a parameter that is none and may be zero: its size, or a share of the range of the search where
    it is smaller. ``options`` is the slice ``diagnosis.report``.
    """
    lower, upper = system.bounds()
    size = np.maximum(np.abs(z), options["least_size_share"] * (upper - lower))
    return np.where([p.log for p in system.parameters], 1.0, size)


def least_sd(system: System, z: np.ndarray, options: DiagnosisReportSettings) -> np.ndarray:
    """Return the least SD (n,) of each parameter, for what the plant itself does not know: a share of its value."""
    return np.asarray(options["plant_sd_ln"] * np.where([p.log for p in system.parameters], 1.0, np.abs(z)))


def effect_intervals(
    hypothesis: Hypothesis, precision: Precision, options: DiagnosisSettings
) -> list[list[tuple[float, float]]]:
    """Return 95 % intervals [SI] of the parameters of each effect."""
    every = np.sqrt(_variances(precision.covariance)) * precision.wider
    first, out = len(hypothesis.base), []
    for placed, x in zip(hypothesis.effects, hypothesis.split(), strict=True):
        # of a searched number that is no logarithm, a share of its size is what a share is of the value
        logarithm = np.array([p.log for p in placed.effect.parameters], bool)
        least = options["report"]["plant_sd_ln"] * np.where(logarithm, 1.0, np.abs(x))
        away = 1.96 * np.hypot(every[first : first + len(x)], least)
        low, high = (placed.values(np.clip(x + d, *placed.bounds())[None])[0] for d in (-away, away))
        out.append([(float(min(a, b)), float(max(a, b))) for a, b in zip(low, high, strict=True)])
        first += len(x)
    return out


def _variances(covariance: np.ndarray) -> np.ndarray:
    """Return the diagonal (n,) of a covariance (n, n), infinite where it is negative or not finite."""
    variance = np.diag(covariance)
    return np.where(np.isfinite(variance) & (variance >= 0), variance, np.inf)


def precision_by_fit(
    pair: Pair, hypothesis: Hypothesis, samples: int, options: DiagnosisSettings
) -> Precision:
    """As `precision_by_noise`, widened by what the fit leaves beyond noise, of ``samples`` residuals of its trial."""
    by_noise = precision_by_noise(pair, hypothesis, options)
    above = Search(pair, options["search"]).above_by_trial(hypothesis)[0]
    return replace(by_noise, wider=by_noise.wider * np.sqrt(1 + max(above, 0.0) / samples))


def precision_by_noise(pair: Pair, hypothesis: Hypothesis, options: DiagnosisSettings) -> Precision:
    """Return how well searched numbers are known by the curvature, and by the scatter of fits of simulated noise.

    Noise is whitened band by band. What moves the residuals of many frequencies together, as an error of the start
    does, is then taken for as many measurements, and the curvature for more than is known. Noise is simulated through
    the hypothesis, drawn anew and not as what whitens it, and each draw moves the optimum by its Gauss-Newton step: the
    sandwich of White (Econometrica 50 (1982) 1).
    """
    jacobian, covariance = _curvature(pair, hypothesis)
    noise = pair.train.noise_of(
        hypothesis.effects,
        pair.system.values(hypothesis.base),
        hypothesis.split(),
        options["noise_draws"],
        options["search"]["seed"] + 1,
    )
    # a draw that MuJoCo gives up on says nothing
    noise = noise[np.isfinite(noise).all(axis=1)]
    data = jacobian[: noise.shape[1]]
    moved = noise @ data @ covariance
    # prior rows and the other trial are as uncertain as the curvature says
    rest = covariance - covariance @ data.T @ data @ covariance
    variance = (moved**2).sum(axis=0) / max(len(noise), 1) + np.maximum(np.diag(rest), 0.0)
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = variance / np.diag(covariance)
    wider = np.sqrt(np.where(np.isfinite(ratio), np.maximum(ratio, 1.0), 1.0))
    return Precision(covariance, wider)


def _curvature(pair: Pair, hypothesis: Hypothesis) -> tuple[np.ndarray, np.ndarray]:
    """Return the Jacobian (n_r, n + p) on the fitted trial and the covariance (n + p, n + p) of both trials."""
    problem = following(pair.train, hypothesis, pair.system)
    _, jacobian = problem.with_jacobian(hypothesis.z, np.arange(len(hypothesis.z)))
    normal = jacobian.T @ jacobian
    elsewhere = JointResiduals(pair.held_out, hypothesis.effects, pair.system)
    if len(elsewhere.free):
        _, own = elsewhere.with_jacobian(hypothesis.z, elsewhere.free)
        normal[np.ix_(elsewhere.free, elsewhere.free)] += own.T @ own
    normal[np.diag_indices_from(normal)] += 1e-9
    return jacobian, np.asarray(np.linalg.inv(normal))
