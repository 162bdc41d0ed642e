"""ICC(1,1) by one-way ANOVA moments, with the exact F interval and the cluster bootstrap.

The model is ln theta[s, r] = mu + b[s] + eps[s, r] (paper eqs. 4-5). Every function works on several
parameters at once: columns of ``values`` (n, p). Subjects may have different numbers of fits; the ANOVA's
effective group size n0 = (n - sum n_s^2 / n) / (N - 1) then stands for R, and the F interval is approximate.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import fdtri


@dataclass(frozen=True)
class Anova:
    """One-way random-effects ANOVA of p parameters: mean squares (p,), group size n0, N subjects, n fits."""

    ms_between: np.ndarray
    ms_within: np.ndarray
    group_size: float
    n_subjects: int
    n_fits: int


@dataclass(frozen=True)
class BootstrapInterval:
    """Percentile interval (p,), and how many resamples gave no ICC.

    ``one_subject`` counts resamples that drew the same subject N times: they hold no between-subject
    variance and are left out. ``undefined`` (p,) counts the others in which both mean squares vanish.
    """

    low: np.ndarray
    high: np.ndarray
    resamples: int
    one_subject: int
    undefined: np.ndarray


@dataclass(frozen=True)
class _Clusters:
    """Sufficient statistics per subject: fits (k,), means (k, p), within sums of squares (k, p)."""

    size: np.ndarray
    mean: np.ndarray
    ss_within: np.ndarray
    zero: np.ndarray


def _clusters(values: np.ndarray, subjects: np.ndarray) -> _Clusters:
    values = np.asarray(values, float)
    labels, index = np.unique(np.asarray(subjects), return_inverse=True)
    # Below this a sum of squares is rounding, not variance (all fits of a parameter on its bound).
    zero = len(values) * (1e-10 * np.maximum(1.0, np.abs(values).max(axis=0))) ** 2
    centred = values - values.mean(axis=0)
    size = np.bincount(index).astype(float)
    mean = np.stack([centred[index == k].mean(axis=0) for k in range(len(labels))])
    deviation = (centred - mean[index]) ** 2
    ss = np.stack([deviation[index == k].sum(axis=0) for k in range(len(labels))])
    return _Clusters(size, mean, ss, zero)


def _mean_squares(c: _Clusters, draws: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """MSB, MSW (b, p) and n0 (b, 1) when subject k is drawn ``draws[b, k]`` times."""
    k = draws.sum(axis=1)[:, None]
    n = (draws @ c.size)[:, None]
    sums = draws @ (c.size[:, None] * c.mean)
    ss_between = draws @ (c.size[:, None] * c.mean**2) - sums**2 / n
    ss_within = draws @ c.ss_within
    ss_between = np.where(ss_between > c.zero, ss_between, 0.0)
    ss_within = np.where(ss_within > c.zero, ss_within, 0.0)
    group_size = (n - (draws @ c.size**2)[:, None] / n) / (k - 1)
    return ss_between / (k - 1), ss_within / (n - k), group_size


def _icc(ms_between: np.ndarray, ms_within: np.ndarray, group_size: np.ndarray | float) -> np.ndarray:
    denominator = ms_between + (group_size - 1) * ms_within
    defined = denominator > 0
    ratio = (ms_between - ms_within) / np.where(defined, denominator, 1.0)
    return np.where(defined, ratio, np.nan)


def one_way_anova(values: np.ndarray, subjects: np.ndarray) -> Anova:
    """One-way ANOVA of ``values`` (n, p) grouped by ``subjects`` (n,).

    Raises ValueError with fewer than two subjects or without a subject that has two fits.
    """
    c = _clusters(values, subjects)
    k, n = len(c.size), int(c.size.sum())
    if k < 2 or n <= k:
        raise ValueError(f"a one-way ANOVA needs two groups and a repeated measurement; got {k} and {n}")
    between, within, group_size = _mean_squares(c, np.ones((1, k)))
    return Anova(between[0], within[0], float(group_size[0, 0]), k, n)


def icc_untruncated(anova: Anova) -> np.ndarray:
    """ICC(1,1) (p,) before truncation: negative where MSW > MSB, NaN without any variance.

    Shrout & Fleiss (1979), case 1.
    """
    return _icc(anova.ms_between, anova.ms_within, anova.group_size)


def icc_truncated(anova: Anova) -> np.ndarray:
    """ICC(1,1) (p,) as the paper reports it: max(0, estimate)."""
    return np.asarray(np.maximum(icc_untruncated(anova), 0.0))


def variance_components(anova: Anova) -> tuple[np.ndarray, np.ndarray]:
    """Moment estimates (sigma_B^2, sigma_W^2), each (p,), the former truncated at zero."""
    between = np.maximum((anova.ms_between - anova.ms_within) / anova.group_size, 0.0)
    return between, anova.ms_within


def exact_interval(anova: Anova, confidence: float = 0.95) -> tuple[np.ndarray, np.ndarray]:
    """Exact F interval of ICC(1,1), not truncated, (p,) each; exact when every subject has R fits.

    Shrout & Fleiss (1979): (F' - 1) / (F' + R - 1) at F' = F / F_upper and F * F_upper'.
    """
    df_b, df_w = anova.n_subjects - 1, anova.n_fits - anova.n_subjects
    upper = (1 + confidence) / 2
    # Divided through by F so that MSW = 0 (F infinite) gives the limit, [1, 1].
    b, w, r = anova.ms_between, anova.ms_within, anova.group_size
    f_low, f_high = fdtri(df_b, df_w, upper), 1 / fdtri(df_w, df_b, upper)
    return _icc(b, w * f_low, r), _icc(b, w * f_high, r)


def cluster_bootstrap(
    values: np.ndarray, subjects: np.ndarray, *, resamples: int, seed: int, confidence: float = 0.95
) -> BootstrapInterval:
    """Percentile interval of the truncated ICC when whole subjects are resampled with all their fits.

    One resample is the same draw of subjects for every parameter. ``values`` (n, p), ``subjects`` (n,). NaN with two
    subjects: every resample that has both is the cohort itself, and an interval without width would look certain.
    """
    c = _clusters(values, subjects)
    k = len(c.size)
    draws = np.random.default_rng(seed).multinomial(k, np.full(k, 1 / k), size=resamples).astype(float)
    single = (draws == k).any(axis=1)
    estimates = np.maximum(_icc(*_mean_squares(c, draws[~single])), 0.0)
    undefined = np.isnan(estimates).sum(axis=0)
    tails = [(1 - confidence) / 2, (1 + confidence) / 2]
    low, high = np.full(estimates.shape[1], np.nan), np.full(estimates.shape[1], np.nan)
    for j in np.flatnonzero(undefined < len(estimates)) if k > 2 else ():
        column = estimates[:, j]
        low[j], high[j] = np.quantile(column[np.isfinite(column)], tails)
    return BootstrapInterval(low, high, resamples, int(single.sum()), undefined)
