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

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final, Literal, NotRequired, TypedDict

import numpy as np
from scipy.special import ndtri

from real2sim.inference.least_squares import Residuals, minimise
from real2sim.inference.parameters import PARAMETERS, Bounds

Verdict = Literal["determined", "weak", "not determined", "at bound"]
DETERMINED: Final = "determined"
WEAK: Final = "weak"
NOT_DETERMINED: Final = "not determined"
AT_BOUND: Final = "at bound"

# Movement that excites each axis: a spring needs slow deflections of the interface, a damper fast ones
_TRIAL = {
    "tx": "antero-posterior leaning",
    "ty": "lateral leaning",
    "tz": "small squats",
    "rx": "side bending of the pelvis (hip hiking)",
    "ry": "pelvic tilting, with the arm's pitch logged and a third marker on the interface",
    "rz": "turning of the pelvis",
}


# Within which of its standard deviations 95 % of a normal distribution lie
NORMAL_95 = float(ndtri(0.975))
# Of the information in a direction at least this share is left, however much of it the noise of the input explains: the
# noise is known to a few per cent only
LEAST_SHARE = 0.05
# Of the variance that white residuals would give
LEAST_OF_WHITE = 0.1
# Of a step towards the corrected fit, and when it is small enough to stop: ln-units, standard deviations
LARGEST_STEP, SMALL_STEP_SD = 1.0, 0.2
# Up to so many thresholds a profile is taken for a parabola
PARABOLA = 4.0


class Options(TypedDict):
    """Slice ``identifiability`` of the configuration; config/README.md says what each key does."""

    determined_sd_ln: float
    weak_sd_ln: float
    at_bound_ln: float
    autocorrelation_s: float
    step_ln: float
    iterations: int
    profile_iterations: int
    floor_block_s: float
    floor_bootstrap: int
    bias_draws: int
    bias_iterations: int
    bias_step_ln: float
    seed: int


class Judgement(TypedDict):
    """Verdict on a parameter, its reason, and the trial that would determine it (None where it is determined)."""

    verdict: Verdict
    reason: str
    next_trial: str | None


class AssessedParameter(Judgement):
    """A fitted parameter: value and 95 % interval [SI; None: open end], SD and bias in ln-units.

    SD and bias are None at a bound, and where they cannot be computed.
    """

    value: float
    sd_ln: float | None
    bias_ln: float | None
    ci95: list[float | None]


class FlatDirection(TypedDict):
    """A product of parameters, {name: exponent}, that a fit leaves open, and its SD in ln-units."""

    sd_ln: float
    combination: dict[str, float]


class Assessment(TypedDict):
    """Parameters that a fit determines; see `assess`. ``input_noise_m`` (4,): noise of the pelvis markers, if known."""

    J: float
    parameters: dict[str, AssessedParameter]
    flat_directions: list[FlatDirection]
    evaluations: int
    refined_by: float
    jacobian: np.ndarray
    input_noise_m: NotRequired[list[float] | None]


@dataclass(frozen=True)
class NoiseTerms:
    """Contribution of input noise to J: ``score`` (12,), half its gradient, and ``curvature`` (12, 12)."""

    score: np.ndarray
    curvature: np.ndarray


@dataclass(frozen=True)
class Information:
    """Information at one point in ln-parameters.

    ``score`` (12,) half the gradient of the corrected cost, ``information`` H (12, 12) less the
    noise's, ``covariance`` (12, 12; NaN rows for parameters left out) and ``inflation`` (12,): by how much J, whose
    curvature holds that of the noise too, rises along its profile within a standard deviation.
    """

    score: np.ndarray
    information: np.ndarray
    covariance: np.ndarray
    inflation: np.ndarray

    def sd(self) -> np.ndarray:
        """Return the standard deviations (12,) in ln-units, NaN where a parameter is left out."""
        return np.sqrt(np.diag(self.covariance))


def central_jacobian(residuals: Residuals, z: np.ndarray, step: float) -> tuple[np.ndarray, np.ndarray]:
    """Return residuals (n_r,) and Jacobian (n_r, 12) at z (12,) by central differences, one-sided at a bound.

    NaN where a simulation beside the point fails.
    """
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
    return np.asarray(total)


def per_sample(values: np.ndarray, sample: np.ndarray) -> np.ndarray:
    """Sum the rows of values (n_r, k) that belong to the same sample, (n, k)."""
    out = np.zeros((int(sample.max()) + 1, values.shape[1]))
    np.add.at(out, sample, values)
    return out


def less_noise(information: np.ndarray, curvature: np.ndarray) -> np.ndarray:
    """Return the information (12, 12) without what the noise of the input contributes, positive definite."""
    # a parameter that moves nothing has a share of nothing
    whole = information + 1e-13 * np.trace(information) * np.eye(len(information))
    lower = np.linalg.cholesky(whole)
    half = np.linalg.solve(lower, curvature)
    share, directions = np.linalg.eigh(np.linalg.solve(lower, half.T))
    spread = lower @ directions
    return np.asarray((spread * np.clip(1 - share, LEAST_SHARE, 1.0)) @ spread.T)


def information(
    residual: np.ndarray,
    jacobian: np.ndarray,
    sample: np.ndarray,
    free: np.ndarray,
    *,
    lags: int,
    noise: NoiseTerms | None = None,
) -> Information:
    """Return information and covariance at a point, from its residuals (n_r,) and their Jacobian (n_r, 12).

    ``sample`` (n_r,) is the sample index of each residual; ``free`` lists the parameters that are not at a bound;
    ``lags`` is the range of autocorrelation that is taken into account [samples]; ``noise`` is that of the input there.
    """
    scores = per_sample(jacobian * residual[:, None], sample)
    total, with_noise = scores.sum(axis=0), jacobian.T @ jacobian
    full = with_noise
    if noise is not None:
        total = total - noise.score
        # without a Jacobian nothing is known, and there is nothing to take the noise from
        known = np.isfinite(full).all() and np.isfinite(noise.curvature).all()
        full = less_noise(full, noise.curvature) if known else np.full_like(full, np.nan)
    # a parameter that moves nothing must end with an infinite variance, not with the zero of a pseudo-inverse
    full, with_noise = (m + 1e-13 * np.trace(m) * np.eye(12) for m in (full, with_noise))
    inner, of_profile = (np.linalg.inv(m[np.ix_(free, free)]) for m in (full, with_noise))
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
    inflation[free] = np.diag(sandwich) / np.diag(of_profile)
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
    """Return the minimum of the cost less what noise of the input adds to it, by Newton steps from a fit z (12,).

    Only the parameters listed in ``free`` move, all where it is None; none where the simulation beside a point fails.
    Returns ln-parameters (12,) and the noise's terms at the last point that was looked at.
    """
    moving = np.arange(12) if free is None else free
    point = z
    for _ in range(iterations):
        terms = noise(point)
        residual, jacobian = central_jacobian(residuals, point, step)
        info = information(residual, jacobian, sample, moving, lags=lags, noise=terms)
        move = _newton_step(info, point, residuals, moving)
        if not np.isfinite(move).all():
            break
        point = np.clip(point + move, residuals.lower, residuals.upper)
        if np.all(np.abs(move[moving]) <= SMALL_STEP_SD * info.sd()[moving]):
            break
    return point, terms


def _newton_step(info: Information, z: np.ndarray, residuals: Residuals, moving: np.ndarray) -> np.ndarray:
    """Return the Newton step (12,) of the parameters ``moving``; those that it would push through their bound stay."""
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
    """Return where J, refitted over the other parameters in ``free``, has risen by ``threshold`` on one side of a fit.

    ``z`` (12,) is the fit in ln-parameters, ``free`` (k,) indices. The first refit is where a parabola with this ``sd``
    (ln-units) ends; from there outwards in growing steps until J has risen. Returns the ln-value, or None if J has not
    risen at the bound, or where a refit cannot be simulated: the end is not known then.
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
        if not np.isfinite(rise):
            return None
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


def flat_directions(covariance: np.ndarray, free: np.ndarray, *, sd: float) -> list[FlatDirection]:
    """Return the directions in ln-space along which the fit is free by more than ``sd``, small exponents left out.

    ``covariance`` (12, 12) is that of the ln-parameters, ``free`` (k,) are the indices of those that were fitted. Empty
    where the covariance could not be computed.
    """
    out: list[FlatDirection] = []
    own = covariance[np.ix_(free, free)]
    if not np.isfinite(own).all():
        return out
    values, vectors = np.linalg.eigh(own)
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
    """Return both ends (ln-units) of one parameter's 95 % interval by the profile of J."""
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
    settings: Options,
    noise: Callable[[np.ndarray], NoiseTerms] | None = None,
    fitted: np.ndarray | None = None,
) -> Assessment:
    """Return a verdict on each parameter of a fit.

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
        Maps z (12,) to what the noise of the input adds there. Its bias is taken off the intervals, not off the fit.
    fitted
        Indices of the parameters that were fitted, all by default; the others are taken for known and have no verdict.

    Returns
    -------
    Assessment
        ``parameters`` holds the fitted ones; ``refined_by`` is the largest change in ln-units by the refinement,
        ``jacobian`` (n_r, 12) that of the residuals at the refined fit, ``evaluations`` the number of replays.
    """
    problem = Residuals(residuals, bounds, batch)
    start = np.log(parameters)
    everything = np.arange(12) if fitted is None else fitted
    lags = round(settings["autocorrelation_s"] * rate_hz)
    fit = _locate(problem, start, everything, sample, lags, noise, settings)
    rows = {
        PARAMETERS[i]: _assess_parameter(problem, fit, i, everything, settings) for i in everything.tolist()
    }
    return {
        "J": fit.cost,
        "parameters": rows,
        "flat_directions": flat_directions(fit.inner.covariance, fit.free, sd=settings["weak_sd_ln"]),
        "evaluations": problem.evaluations,
        "refined_by": float(np.abs(fit.z - start).max()),
        "jacobian": fit.jacobian,
    }


@dataclass(frozen=True)
class _Located:
    """A refined fit, its corrected point, and the information there.

    ``z`` (12,) [ln], its ``cost`` J and ``jacobian`` (n_r, 12); ``point`` (12,) [ln] without the bias by noise of the
    input; ``whole`` information with every fitted parameter free, ``inner`` with those ``free`` (k,) that are not
    ``bound`` (12,).
    """

    z: np.ndarray
    cost: float
    jacobian: np.ndarray
    point: np.ndarray
    whole: Information
    inner: Information
    free: np.ndarray
    bound: np.ndarray

    @property
    def bias(self) -> np.ndarray:
        """Return how far (12,) [ln-units] noise of the input moves the fit."""
        return np.asarray(self.z - self.point)


def _locate(
    problem: Residuals,
    start: np.ndarray,
    fitted: np.ndarray,
    sample: np.ndarray,
    lags: int,
    noise: Callable[[np.ndarray], NoiseTerms] | None,
    options: Options,
) -> _Located:
    """Refine a fit (12,) [ln] and compute the information at its corrected point."""
    step = options["step_ln"]
    z, cost, _, _ = minimise(problem, start, fitted, iterations=options["iterations"], ftol=1e-8)
    residual, jacobian = central_jacobian(problem, z, step)
    own_jacobian = jacobian
    point, terms = z, None
    if noise is not None:
        iterations = options["bias_iterations"]
        point, terms = corrected_fit(
            problem, z, sample, noise, step=step, lags=lags, iterations=iterations, free=fitted
        )
        residual, jacobian = central_jacobian(problem, point, step)
    whole = information(residual, jacobian, sample, fitted, lags=lags, noise=terms)
    near = options["at_bound_ln"]
    at_bound = (z - problem.lower < near) | (problem.upper - z < near)
    # at its bound a parameter is known, but for what cannot be known at all
    bound = at_bound & (whole.sd() <= options["weak_sd_ln"])
    free = fitted[~bound[fitted]]
    inner = information(residual, jacobian, sample, free, lags=lags, noise=terms) if bound.any() else whole
    return _Located(z, cost, own_jacobian, point, whole, inner, free, bound)


def _assess_parameter(
    problem: Residuals, fit: _Located, index: int, fitted: np.ndarray, options: Options
) -> AssessedParameter:
    """Return value, interval and verdict of one parameter; a wide interval comes from the profile of J."""
    bound = bool(fit.bound[index])
    known = fit.whole if bound else fit.inner
    sd, bias = float(known.sd()[index]), float(fit.bias[index])
    ends: list[float | None] = [float(fit.point[index] + side * NORMAL_95 * sd) for side in (-1, 1)]
    if not np.isfinite([sd, bias]).all():
        ends = [None, None]
    elif sd > options["weak_sd_ln"]:
        # no profile: J would rise by the noise of the input alone
        lower, upper = problem.lower[index], problem.upper[index]
        ends = [end if end is not None and lower <= end <= upper else None for end in ends]
    elif bound or sd > options["determined_sd_ln"]:
        iterations = options["profile_iterations"]
        sides = _profile(problem, fit.z, fit.cost, index, known, iterations, fitted)
        ends = [None if end is None else end - bias for end in sides]
    value = float(fit.z[index])
    return {
        "value": float(np.exp(fit.z[index])),
        "sd_ln": None if bound or not np.isfinite(sd) else sd,
        "bias_ln": None if bound or not np.isfinite(bias) else bias,
        "ci95": [None if end is None else float(np.exp(end)) for end in ends],
        **_judge(PARAMETERS[index], value, ends, sd, bias, bound, options),
    }


def interval_verdict(
    sd_ln: float, bias_ln: float, *, too_wide: bool, at_bound: bool, determined_sd_ln: float
) -> Verdict:
    """Return the verdict on a parameter, from what its 95 % interval shows.

    Parameters
    ----------
    sd_ln, bias_ln
        Standard deviation, and shift of the fit by noise of the input [ln-units]. A parameter of which either is not
        finite is not determined.
    too_wide
        Whether the interval has an open end or is wider than ``identifiability.weak_sd_ln`` admits.
    at_bound
        Whether the fit stands at a bound of the search.
    determined_sd_ln
        Largest SD, and largest bias, of a parameter that is determined. The noise is an estimate from quiet standing:
        no large correction is trusted to it.
    """
    if too_wide or not (math.isfinite(sd_ln) and math.isfinite(bias_ln)):
        return NOT_DETERMINED
    if at_bound:
        return AT_BOUND
    return WEAK if sd_ln > determined_sd_ln or abs(bias_ln) > determined_sd_ln else DETERMINED


def _why_too_wide(
    z: float, ends: list[float | None], bias: float, at_bound: bool, options: Options
) -> str | None:
    """Return why an interval (two ends in ln-units, None: open) determines nothing; None where it is narrow enough."""
    low, high = ends
    largest = NORMAL_95 * options["weak_sd_ln"]
    if low is None and high is None:
        return "J rises towards neither bound, as far as it can be simulated: every value there fits as well"
    if at_bound:
        reach = max(abs(end - z + bias) for end in ends if end is not None)
        return (
            f"from its bound J does not rise within a factor of {np.exp(reach):.2f}"
            if reach > largest
            else None
        )
    if low is None or high is None:
        side = "lower" if low is None else "upper"
        return f"J does not rise towards the {side} bound, as far as it can be simulated"
    return _within_factor((high - low) / 2) if (high - low) / 2 > largest else None


def _within_factor(half_width: float) -> str:
    return f"95 % interval within a factor of {np.exp(half_width):.2f}"


def _judge(
    name: str,
    z: float,
    ends: list[float | None],
    sd: float,
    bias: float,
    at_bound: bool,
    options: Options,
) -> Judgement:
    """Return the verdict on a parameter with its reason and advice, from a fit z and interval ends in ln-units."""
    determined_sd = options["determined_sd_ln"]
    too_wide = _why_too_wide(z, ends, bias, at_bound, options)
    if not (math.isfinite(sd) and math.isfinite(bias)):
        too_wide = "its standard deviation cannot be computed: the simulation beside the fit fails"
    verdict = interval_verdict(
        sd, bias, too_wide=too_wide is not None, at_bound=at_bound, determined_sd_ln=determined_sd
    )
    low, high = ends
    half_width = math.inf if low is None or high is None else (high - low) / 2
    if too_wide is not None:
        reason = too_wide
    elif verdict == AT_BOUND:
        reason = "the search ended at its bound: the optimum may lie beyond it"
    elif verdict == WEAK and not sd > determined_sd:
        reason = f"noise of the pelvis markers alone moves it by a factor of {np.exp(abs(bias)):.2f}"
    else:
        reason = _within_factor(half_width)
    return {
        "verdict": verdict,
        "reason": reason,
        "next_trial": None if verdict == DETERMINED else _advice(name),
    }
