"""What one fit determines, and what it does not: curvature, autocorrelation, profiles and a verdict per parameter.

At the optimum the Jacobian G (n_r, 12) of the weighted residuals r by the ln-parameters gives the information
H = GᵀG of a cost J = rᵀr. Residuals of a filtered, simulated trial are correlated in time, so the covariance is the
sandwich H⁻¹ S H⁻¹ with S the long-run covariance of the scores G_tᵀ r_t (Newey & West 1987, Bartlett kernel). The same
ratio of sandwich to naive variance calibrates the threshold of the profile of J (Kent 1982), so that curvature and
profile speak of the same 95 %.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy import stats

from real2sim.identification.least_squares import Residuals, minimise
from real2sim.identification.parameters import PARAMETERS, Bounds

DETERMINED, WEAK, NOT_DETERMINED, AT_BOUND = "determined", "weak", "not determined", "at bound"

# What would tell: springs are seen when the robot can be held off slowly, dampers when it is moved fast
_TRIAL = {
    "tx": "antero-posterior leaning",
    "ty": "lateral leaning",
    "tz": "small squats",
    "rx": "side bending of the pelvis (hip hiking)",
    "ry": "pelvic tilting, with the arm's pitch logged and a third marker on the interface",
    "rz": "turning of the pelvis",
}


@dataclass(frozen=True)
class Information:
    """Information of one fit in ln-parameters.

    ``jacobian`` (n_r, 12), ``information`` H (12, 12), ``covariance`` (12, 12; NaN rows for parameters left out) and
    ``inflation`` (12,), the ratio of sandwich to naive variance times the cost per degree of freedom it replaces.
    """

    jacobian: np.ndarray
    information: np.ndarray
    covariance: np.ndarray
    inflation: np.ndarray


def central_jacobian(residuals: Residuals, z: np.ndarray, step: float) -> np.ndarray:
    """Jacobian (n_r, 12) of the residuals at ln-parameters z (12,) by central differences, one-sided at a bound."""
    up, down = np.minimum(z + step, residuals.upper), np.maximum(z - step, residuals.lower)
    points = np.tile(z, (24, 1))
    points[np.arange(12), np.arange(12)] = up
    points[np.arange(12, 24), np.arange(12)] = down
    out = residuals.many(points)
    return ((out[:12] - out[12:]) / (up - down)[:, None]).T


def long_run_covariance(scores: np.ndarray, lags: int) -> np.ndarray:
    """Sum of a series' autocovariances up to some lags with Bartlett weights, (k, k), for scores (n, k).

    Source: Newey & West, Econometrica 55 (1987) 703.
    """
    total = scores.T @ scores
    for lag in range(1, lags + 1):
        cross = scores[lag:].T @ scores[:-lag]
        total += (1 - lag / (lags + 1)) * (cross + cross.T)
    return total


def information(
    residuals: Residuals,
    z: np.ndarray,
    sample: np.ndarray,
    free: np.ndarray,
    *,
    step: float,
    lags: int,
) -> Information:
    """Information and covariance of a fit at ln-parameters z (12,).

    ``sample`` (n_r,) is the sample index of each residual; ``free`` lists the parameters that are not at a bound;
    ``lags`` is the range of autocorrelation that is taken into account [samples].
    """
    jacobian = central_jacobian(residuals, z, step)
    residual = residuals.many(z[None])[0]
    full = jacobian.T @ jacobian
    n = int(sample.max()) + 1
    scores = np.zeros((n, 12))
    np.add.at(scores, sample, jacobian * residual[:, None])
    part = full[np.ix_(free, free)]
    # a parameter that moves nothing must end with an infinite variance, not with the zero of a pseudo-inverse
    inner = np.linalg.inv(part + 1e-13 * np.trace(part) * np.eye(len(free)))
    meat = long_run_covariance(scores[:, free], lags)
    # each parameter takes up one effective sample; blocks of the kernel's width are the effective samples
    used = int(np.any(scores != 0, axis=1).sum())
    blocks = max(used / (lags + 1), len(free) + 2)
    sandwich = inner @ meat @ inner * blocks / (blocks - len(free))
    white = float(residual @ residual) / (len(residual) - len(free)) * inner
    # where correlated residuals claim to know more than white ones would, they are not believed
    sandwich += np.diag(np.maximum(np.diag(white) - np.diag(sandwich), 0.0))
    covariance = np.full((12, 12), np.nan)
    covariance[np.ix_(free, free)] = sandwich
    inflation = np.full(12, np.nan)
    inflation[free] = np.diag(sandwich) / np.diag(inner)
    return Information(jacobian, full, covariance, inflation)


def profile_end(
    residuals: Residuals,
    z: np.ndarray,
    cost: float,
    index: int,
    direction: int,
    *,
    sd: float,
    threshold: float,
    iterations: int,
) -> float | None:
    """Where J, refitted over the other parameters, has risen by ``threshold`` on one side of a fit.

    Asks at the bound first: a flat side is known after one refit. Otherwise walks outwards in growing steps, the
    first of them ``sd`` (ln-units, at most a half), and interpolates. Returns the ln-value, or None if J has not
    risen at the bound.
    """
    others = np.delete(np.arange(12), index)
    bound = float((residuals.lower if direction < 0 else residuals.upper)[index])

    def refitted(start: np.ndarray, value: float) -> tuple[np.ndarray, float]:
        moved = start.copy()
        moved[index] = value
        best, found, _, _ = minimise(residuals, moved, others, iterations=iterations, ftol=1e-4)
        return best, found

    at_bound, found = refitted(z, bound)
    if found - cost <= threshold:
        return None
    here, last, start, stride = float(z[index]), cost, z, min(max(sd, 0.05), 0.5)
    while True:
        there = here + direction * stride
        if (bound - there) * direction <= 0:
            there = bound
        else:
            start, found = refitted(start, there)
        rise = (found if there != bound else refitted(at_bound, bound)[1]) - cost
        if rise > threshold:
            # J is near a parabola: interpolate its root
            inner, outer = np.sqrt(max(last - cost, 0.0)), np.sqrt(rise)
            return here + (there - here) * float((np.sqrt(threshold) - inner) / max(outer - inner, 1e-12))
        here, last, stride = there, found, 1.5 * stride


def flat_directions(covariance: np.ndarray, free: np.ndarray, *, sd: float) -> list[dict]:
    """Directions in ln-space along which the fit is free by more than ``sd``, as products of parameters.

    Each has its ``sd_ln`` and ``combination``: {parameter: exponent}, small exponents left out.
    """
    values, vectors = np.linalg.eigh(covariance[np.ix_(free, free)])
    out = []
    for value, vector in zip(values[::-1], vectors.T[::-1], strict=True):
        if value < sd**2:
            break
        vector = vector * np.sign(vector[np.argmax(np.abs(vector))])
        parts = {PARAMETERS[free[i]]: round(float(v), 2) for i, v in enumerate(vector) if abs(v) >= 0.2}
        out.append({"sd_ln": float(np.sqrt(value)), "combination": parts})
    return out


def _advice(name: str) -> str:
    how = "slowly, with holds of several seconds" if name[0] == "k" else "fast, at 1.5 Hz and above"
    return f"a dynamic trial with more {_TRIAL[name[2:]]}, {how}"


def assess(
    residuals: Callable[[np.ndarray], np.ndarray],
    parameters: np.ndarray,
    sample: np.ndarray,
    bounds: Bounds,
    *,
    batch: int,
    rate_hz: float,
    settings: dict,
    bias: Callable[[np.ndarray, np.ndarray, np.ndarray], np.ndarray] | None = None,
) -> dict:
    """Verdict on each parameter of a fit.

    Parameters
    ----------
    residuals
        Maps parameters (m, 12) to weighted residuals (m, n_r) whose sum of squares is J.
    parameters
        The fit (12,) [SI]. It is first refined by least squares, so that the scores add up to zero.
    sample
        (n_r,) sample index of each residual.
    bounds, batch, rate_hz
        Search bounds, replays per call, sample rate [Hz].
    settings
        Slice ``identifiability`` of the configuration.
    bias
        Maps z (12,), H (12, 12) and the free parameters to the bias of the fit in ln-units (12,), which is taken
        off the intervals.

    Returns
    -------
    dict
        Per parameter ``value``, ``ci95`` [SI], ``sd_ln``, ``bias_ln``, ``verdict``, ``reason``, ``next_trial``; ``J``,
        ``flat_directions``, ``evaluations``, ``refined_by`` (largest change in ln-units by the refinement) and the
        ``jacobian`` (n_r, 12).
    """
    problem = Residuals(residuals, bounds, batch)
    start = np.log(parameters)
    everything = np.arange(12)
    z, cost, _, _ = minimise(problem, start, everything, iterations=settings["iterations"], ftol=1e-8)
    near = settings["at_bound_ln"]
    bound = (z - problem.lower < near) | (problem.upper - z < near)
    free = np.flatnonzero(~bound)
    lags = round(settings["autocorrelation_s"] * rate_hz)
    info = information(problem, z, sample, free, step=settings["step_ln"], lags=lags)
    shift = np.zeros(12)
    if bias is not None:
        # the bias belongs to the corrected point, which the first estimate of it gives
        shift = bias(z, info.information, free)
        shift = bias(np.clip(z - shift, problem.lower, problem.upper), info.information, free)
    # a parameter at its bound has no place in the covariance, but its profile still has a threshold
    whole = (
        info
        if not bound.any()
        else information(problem, z, sample, everything, step=settings["step_ln"], lags=lags)
    )
    quantile = float(stats.norm.ppf(0.975))
    rows = {}
    for i, name in enumerate(PARAMETERS):
        sd = float(np.sqrt((whole if bound[i] else info).covariance[i, i]))
        ends: list[float | None] = [z[i] - quantile * sd, z[i] + quantile * sd]
        if bound[i] or sd > settings["determined_sd_ln"]:
            inflation = (whole if bound[i] else info).inflation[i]
            ends = [
                profile_end(
                    problem,
                    z,
                    cost,
                    i,
                    direction,
                    sd=sd,
                    threshold=quantile**2 * inflation,
                    iterations=settings["profile_iterations"],
                )
                for direction in (-1, 1)
            ]
        rows[name] = {
            "value": float(np.exp(z[i])),
            "sd_ln": None if bound[i] else sd,
            "bias_ln": None if bound[i] else float(shift[i]),
            "ci95": [None if e is None else float(np.exp(e - shift[i])) for e in ends],
            **_verdict(name, ends, sd, float(shift[i]), bool(bound[i]), settings),
        }
    return {
        "J": cost,
        "parameters": rows,
        "flat_directions": flat_directions(info.covariance, free, sd=settings["weak_sd_ln"]),
        "evaluations": problem.evaluations,
        "refined_by": float(np.abs(z - start).max()),
        "jacobian": info.jacobian,
    }


def _verdict(
    name: str, ends: list[float | None], sd: float, bias: float, at_bound: bool, settings: dict
) -> dict[str, str | None]:
    low, high = ends
    advice = _advice(name)
    if low is None and high is None:
        reason = "J rises towards neither bound: every admissible value fits as well"
        return {"verdict": NOT_DETERMINED, "reason": reason, "next_trial": advice}
    if at_bound:
        reason = "the search ended at its bound: the optimum may lie beyond it"
        return {"verdict": AT_BOUND, "reason": reason, "next_trial": advice}
    if low is None or high is None:
        side = "lower" if low is None else "upper"
        reason = f"J does not rise towards the {side} bound: every value there fits as well"
        return {"verdict": NOT_DETERMINED, "reason": reason, "next_trial": advice}
    half = (high - low) / 2
    factor = f"95 % interval within a factor of {np.exp(half):.2f}"
    if half > 1.96 * settings["weak_sd_ln"]:
        return {"verdict": NOT_DETERMINED, "reason": factor, "next_trial": advice}
    if sd > settings["determined_sd_ln"]:
        return {"verdict": WEAK, "reason": factor, "next_trial": advice}
    if abs(bias) > settings["determined_sd_ln"]:
        # the correction is of first order: it is not trusted beyond what counts as small
        reason = f"noise of the pelvis markers alone moves it by a factor of {np.exp(abs(bias)):.2f}"
        return {"verdict": WEAK, "reason": reason, "next_trial": advice}
    return {"verdict": DETERMINED, "reason": factor, "next_trial": None}
