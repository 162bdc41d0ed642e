"""What one fit determines, and what it does not: curvature, autocorrelation, profiles and a verdict per parameter.

At the optimum the Jacobian G (n_r, 12) of the weighted residuals r by the ln-parameters gives the information
H = GᵀG of a cost J = rᵀr. Residuals of a filtered, simulated trial are correlated in time, so the covariance is the
sandwich H⁻¹ S H⁻¹ with S the long-run covariance of the scores G_tᵀ r_t (Newey & West 1987, Bartlett kernel). The same
ratio of sandwich to naive variance calibrates the threshold of the profile of J (Kent 1982), so that curvature and
profile speak of the same 95 %.

The input of a replay, the pelvis, is itself measured. Its noise moves the plant, and what it moves costs: J(z) has the
expectation of the true cost plus E(z), the energy of the plant's response to noise, whose slope pulls a fit aside and
whose curvature passes for information. Both are taken off (corrected score, Nakamura 1990; Carroll et al. 2006,
chapter 7): intervals belong to the minimum of J - E, and H loses what E contributes to it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy import stats

from real2sim.inference.least_squares import Residuals, minimise
from real2sim.inference.parameters import PARAMETERS, Bounds

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


# Within which of its standard deviations 95 % of a normal distribution lie
NORMAL_95 = float(stats.norm.ppf(0.975))
# Of the information in a direction at least this share is left, however much of it the noise of the input explains: the
# noise is known to a few per cent only
LEAST_SHARE = 0.05
# Of the variance that white residuals would give
LEAST_OF_WHITE = 0.1
# Of a step towards the corrected fit, and when it is small enough to stop: ln-units, standard deviations
LARGEST_STEP, SMALL_STEP_SD = 1.0, 0.2
# Up to so many thresholds a profile is taken for a parabola
PARABOLA = 4.0


@dataclass(frozen=True)
class NoiseTerms:
    """What noise of the input adds to J: ``score`` (12,), half its gradient, and ``curvature`` (12, 12)."""

    score: np.ndarray
    curvature: np.ndarray


@dataclass(frozen=True)
class Information:
    """Information at one point in ln-parameters.

    ``score`` (12,) half the gradient of the corrected cost, ``information`` H (12, 12) less the
    noise's, ``covariance`` (12, 12; NaN rows for parameters left out) and ``inflation`` (12,), the ratio of sandwich to
    naive variance times the cost per degree of freedom it replaces.
    """

    score: np.ndarray
    information: np.ndarray
    covariance: np.ndarray
    inflation: np.ndarray

    def sd(self) -> np.ndarray:
        """Standard deviations (12,) in ln-units, NaN where a parameter is left out."""
        return np.sqrt(np.diag(self.covariance))


def central_jacobian(residuals: Residuals, z: np.ndarray, step: float) -> tuple[np.ndarray, np.ndarray]:
    """Residuals (n_r,) and Jacobian (n_r, 12) at ln-parameters z (12,) by central differences, one-sided at a bound."""
    up, down = np.minimum(z + step, residuals.upper), np.maximum(z - step, residuals.lower)
    points = np.tile(z, (25, 1))
    points[np.arange(12), np.arange(12)] = up
    points[np.arange(12, 24), np.arange(12)] = down
    out = residuals.many(points)
    return out[24], ((out[:12] - out[12:24]) / (up - down)[:, None]).T


def long_run_covariance(scores: np.ndarray, lags: int) -> np.ndarray:
    """Sum of a series' autocovariances up to some lags with Bartlett weights, (k, k), for scores (n, k).

    Source: Newey & West, Econometrica 55 (1987) 703.
    """
    total = scores.T @ scores
    for lag in range(1, lags + 1):
        cross = scores[lag:].T @ scores[:-lag]
        total += (1 - lag / (lags + 1)) * (cross + cross.T)
    return total


def per_sample(values: np.ndarray, sample: np.ndarray) -> np.ndarray:
    """Sum the rows of values (n_r, k) that belong to the same sample, (n, k)."""
    out = np.zeros((int(sample.max()) + 1, values.shape[1]))
    np.add.at(out, sample, values)
    return out


def less_noise(information: np.ndarray, curvature: np.ndarray) -> np.ndarray:
    """Information (12, 12) without what the noise of the input contributes, positive definite."""
    # a parameter that moves nothing has a share of nothing
    whole = information + 1e-13 * np.trace(information) * np.eye(len(information))
    lower = np.linalg.cholesky(whole)
    half = np.linalg.solve(lower, curvature)
    share, directions = np.linalg.eigh(np.linalg.solve(lower, half.T))
    spread = lower @ directions
    return (spread * np.clip(1 - share, LEAST_SHARE, 1.0)) @ spread.T


def information(
    residual: np.ndarray,
    jacobian: np.ndarray,
    sample: np.ndarray,
    free: np.ndarray,
    *,
    lags: int,
    noise: NoiseTerms | None = None,
) -> Information:
    """Information and covariance at a point, from its residuals (n_r,) and their Jacobian (n_r, 12).

    ``sample`` (n_r,) is the sample index of each residual; ``free`` lists the parameters that are not at a bound;
    ``lags`` is the range of autocorrelation that is taken into account [samples]; ``noise`` is that of the input there.
    """
    scores = per_sample(jacobian * residual[:, None], sample)
    total, full = scores.sum(axis=0), jacobian.T @ jacobian
    if noise is not None:
        total, full = total - noise.score, less_noise(full, noise.curvature)
    # a parameter that moves nothing must end with an infinite variance, not with the zero of a pseudo-inverse
    full = full + 1e-13 * np.trace(full) * np.eye(12)
    inner = np.linalg.inv(full[np.ix_(free, free)])
    # the score of a fit is zero, that of a corrected one is the noise's: only the scatter counts
    used = np.any(scores != 0, axis=1)
    centred = np.where(used[:, None], scores - scores[used].mean(axis=0), 0.0)
    meat = long_run_covariance(centred[:, free], lags)
    # each parameter takes up one effective sample, of which Bartlett's kernel sees 3 n / (2 lags) (Priestley 1981, 6.2)
    effective = max(1.5 * used.sum() / (lags + 1), len(free) + 2)
    sandwich = inner @ meat @ inner * effective / (effective - len(free))
    # a slow signature is known better than white residuals would let it be, but not out of all proportion, and one that
    # is zero has no scores to scatter
    white = LEAST_OF_WHITE * float(residual @ residual) / len(residual) * np.diag(inner)
    sandwich += np.diag(np.maximum(white - np.diag(sandwich), 0.0))
    covariance = np.full((12, 12), np.nan)
    covariance[np.ix_(free, free)] = sandwich
    inflation = np.full(12, np.nan)
    inflation[free] = np.diag(sandwich) / np.diag(inner)
    return Information(total, full, covariance, inflation)


def corrected_fit(
    residuals: Residuals,
    z: np.ndarray,
    sample: np.ndarray,
    noise: Callable[[np.ndarray], NoiseTerms],
    *,
    step: float,
    lags: int,
    iterations: int,
    free: np.ndarray | None = None,
) -> tuple[np.ndarray, NoiseTerms]:
    """Minimum of the cost less what the noise of the input adds to it, by Newton steps from a fit z (12,).

    Only the parameters listed in ``free`` move, all where it is None. Returns ln-parameters (12,) and the noise's terms
    at the last point that was looked at.
    """
    moving = np.arange(12) if free is None else free
    point = z
    for _ in range(iterations):
        terms = noise(point)
        residual, jacobian = central_jacobian(residuals, point, step)
        info = information(residual, jacobian, sample, moving, lags=lags, noise=terms)
        move = _newton_step(info, point, residuals, moving)
        point = np.clip(point + move, residuals.lower, residuals.upper)
        if np.all(np.abs(move[moving]) <= SMALL_STEP_SD * info.sd()[moving]):
            break
    return point, terms


def _newton_step(info: Information, z: np.ndarray, residuals: Residuals, moving: np.ndarray) -> np.ndarray:
    """Step (12,) of those ``moving`` down the corrected cost; those that it would push through their bound stay."""
    free = np.isin(np.arange(12), moving)
    move = np.zeros(12)
    for _ in range(3):
        move[:] = 0.0
        move[free] = -np.linalg.solve(info.information[np.ix_(free, free)], info.score[free])
        stuck = free & (((z <= residuals.lower) & (move < 0)) | ((z >= residuals.upper) & (move > 0)))
        if not stuck.any():
            break
        free &= ~stuck
    return np.clip(move, -LARGEST_STEP, LARGEST_STEP)


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
    free: np.ndarray | None = None,
) -> float | None:
    """Where J, refitted over the others of the parameters in ``free``, has risen by ``threshold`` on one side of a fit.

    The first refit is where a parabola with this ``sd`` (ln-units) ends; from there outwards in growing steps until J
    has risen. Returns the ln-value, or None if J has not risen at the bound.
    """
    others = np.setdiff1d(np.arange(12) if free is None else free, [index])
    bound = float((residuals.lower if direction < 0 else residuals.upper)[index])
    start, inner, low = z, float(z[index]), 0.0
    stride = float(np.clip(NORMAL_95 * sd, 0.05, 1.0))
    outer: tuple[float, float] | None = None

    def root(outer: tuple[float, float]) -> float:
        # J is near a parabola, its root nearly linear
        there, high = outer
        return inner + (there - inner) * float((np.sqrt(threshold) - low) / max(high - low, 1e-12))

    while True:
        there = inner + direction * stride if outer is None else root(outer)
        there = bound if (bound - there) * direction <= 0 else there
        moved = start.copy()
        moved[index] = there
        best, found, _, _ = minimise(residuals, moved, others, iterations=iterations, ftol=1e-4)
        rise = found - cost
        if rise > threshold:
            trusted = outer is not None or rise < PARABOLA * threshold
            outer = there, np.sqrt(rise)
            if trusted:
                return root(outer)
        elif there == bound:
            return None
        else:
            start, inner, low, stride = best, there, np.sqrt(max(rise, 0.0)), 2 * stride
            if outer is not None:
                return root(outer)


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


def _profile(
    problem: Residuals,
    z: np.ndarray,
    cost: float,
    index: int,
    known: Information,
    iterations: int,
    free: np.ndarray,
) -> list[float | None]:
    """Both ends (ln-units) of one parameter's 95 % interval by the profile of J."""
    sd, threshold = float(known.sd()[index]), NORMAL_95**2 * float(known.inflation[index])
    return [
        profile_end(
            problem, z, cost, index, side, sd=sd, threshold=threshold, iterations=iterations, free=free
        )
        for side in (-1, 1)
    ]


def assess(
    residuals: Callable[[np.ndarray], np.ndarray],
    parameters: np.ndarray,
    sample: np.ndarray,
    bounds: Bounds,
    *,
    batch: int,
    rate_hz: float,
    settings: dict,
    noise: Callable[[np.ndarray], NoiseTerms] | None = None,
    fitted: np.ndarray | None = None,
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
    noise
        Maps z (12,) to what the noise of the input adds there. The bias that it causes is taken off the intervals, not
        off the fit.
    fitted
        Indices of the parameters that were fitted, all by default; the others are taken for known and have no verdict.

    Returns
    -------
    dict
        Per fitted parameter ``value``, ``ci95`` [SI], ``sd_ln``, ``bias_ln``, ``verdict``, ``reason``, ``next_trial``;
        ``J``, ``flat_directions``, ``evaluations``, ``refined_by`` (largest change in ln-units by the refinement) and
        the ``jacobian`` (n_r, 12).
    """
    problem = Residuals(residuals, bounds, batch)
    start = np.log(parameters)
    everything = np.arange(12) if fitted is None else fitted
    z, cost, _, _ = minimise(problem, start, everything, iterations=settings["iterations"], ftol=1e-8)
    lags = round(settings["autocorrelation_s"] * rate_hz)
    residual, jacobian = central_jacobian(problem, z, settings["step_ln"])
    own_jacobian = jacobian
    point, terms = z, None
    if noise is not None:
        point, terms = corrected_fit(
            problem,
            z,
            sample,
            noise,
            step=settings["step_ln"],
            lags=lags,
            iterations=settings["bias_iterations"],
            free=everything,
        )
        residual, jacobian = central_jacobian(problem, point, settings["step_ln"])
    shift = z - point
    whole = information(residual, jacobian, sample, everything, lags=lags, noise=terms)
    near = settings["at_bound_ln"]
    at_bound = (z - problem.lower < near) | (problem.upper - z < near)
    # at its bound a parameter is known, but for what cannot be known at all
    bound = at_bound & (whole.sd() <= settings["weak_sd_ln"])
    free = everything[~bound[everything]]
    info = information(residual, jacobian, sample, free, lags=lags, noise=terms) if bound.any() else whole
    rows = {}
    for i in everything.tolist():
        name = PARAMETERS[i]
        known = whole if bound[i] else info
        sd = float(known.sd()[i])
        ends: list[float | None] = [float(point[i] + side * NORMAL_95 * sd) for side in (-1, 1)]
        if sd > settings["weak_sd_ln"]:
            # no profile: J would rise by the noise of the input alone
            ends = [
                end if end is not None and problem.lower[i] <= end <= problem.upper[i] else None
                for end in ends
            ]
        elif bound[i] or sd > settings["determined_sd_ln"]:
            sides = _profile(problem, z, cost, i, known, settings["profile_iterations"], everything)
            ends = [None if end is None else end - float(shift[i]) for end in sides]
        rows[name] = {
            "value": float(np.exp(z[i])),
            "sd_ln": None if bound[i] else sd,
            "bias_ln": None if bound[i] else float(shift[i]),
            "ci95": [None if end is None else float(np.exp(end)) for end in ends],
            **_verdict(name, float(z[i]), ends, sd, float(shift[i]), bool(bound[i]), settings),
        }
    return {
        "J": cost,
        "parameters": rows,
        "flat_directions": flat_directions(info.covariance, free, sd=settings["weak_sd_ln"]),
        "evaluations": problem.evaluations,
        "refined_by": float(np.abs(z - start).max()),
        "jacobian": own_jacobian,
    }


def _verdict(
    name: str,
    z: float,
    ends: list[float | None],
    sd: float,
    bias: float,
    at_bound: bool,
    settings: dict,
) -> dict[str, str | None]:
    low, high = ends
    advice = _advice(name)
    if low is None and high is None:
        reason = "J rises towards neither bound: every admissible value fits as well"
        return {"verdict": NOT_DETERMINED, "reason": reason, "next_trial": advice}
    if at_bound:
        reach = max(abs(end - z + bias) for end in ends if end is not None)
        if reach > NORMAL_95 * settings["weak_sd_ln"]:
            reason = f"from its bound J does not rise within a factor of {np.exp(reach):.2f}"
            return {"verdict": NOT_DETERMINED, "reason": reason, "next_trial": advice}
        reason = "the search ended at its bound: the optimum may lie beyond it"
        return {"verdict": AT_BOUND, "reason": reason, "next_trial": advice}
    if low is None or high is None:
        side = "lower" if low is None else "upper"
        reason = f"J does not rise towards the {side} bound: every value there fits as well"
        return {"verdict": NOT_DETERMINED, "reason": reason, "next_trial": advice}
    half = (high - low) / 2
    factor = f"95 % interval within a factor of {np.exp(half):.2f}"
    if half > NORMAL_95 * settings["weak_sd_ln"]:
        return {"verdict": NOT_DETERMINED, "reason": factor, "next_trial": advice}
    if sd > settings["determined_sd_ln"]:
        return {"verdict": WEAK, "reason": factor, "next_trial": advice}
    if abs(bias) > settings["determined_sd_ln"]:
        # the noise is an estimate from the neutral trial: no large correction is trusted to it
        reason = f"noise of the pelvis markers alone moves it by a factor of {np.exp(abs(bias)):.2f}"
        return {"verdict": WEAK, "reason": reason, "next_trial": advice}
    return {"verdict": DETERMINED, "reason": factor, "next_trial": None}
