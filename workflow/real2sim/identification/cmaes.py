"""CMA-ES on ln-parameters (paper, section III-B and the footnotes of IV-A)."""

from __future__ import annotations

import warnings
from collections.abc import Callable

import numpy as np

from real2sim.identification.parameters import Bounds
from real2sim.identification.result import SearchResult


def search(
    cost: Callable[[np.ndarray], np.ndarray],
    bounds: Bounds,
    *,
    population: int,
    sigma0: float,
    evaluations: int,
    tolfun: float,
    diagonal_iterations: int,
    seed: int,
    progress: Callable[[int, float], None] | None = None,
) -> SearchResult:
    """Minimise a cost by CMA-ES from one log-uniform start.

    Parameters
    ----------
    cost
        Maps parameters (population, 12) to costs (population,): a whole generation in one call.
    population, sigma0, evaluations, tolfun
        lambda, initial step in ln-units, budget and tolerance of the paper.
    diagonal_iterations
        Generations in which only the diagonal of the covariance is learnt (pycma's ``CMA_diagonal``).
    seed
        Of start and search: same seed, same result.
    progress
        Called with the evaluations done and the best cost after each generation.
    """
    with warnings.catch_warnings():
        # pycma warns at import where moarchiving, which is not used here, is not installed
        warnings.simplefilter("ignore")
        import cma

    start = bounds.log_uniform(np.random.default_rng(seed))
    lower, upper = np.log(bounds.lower), np.log(bounds.upper)
    strategy = cma.CMAEvolutionStrategy(
        start,
        sigma0,
        {
            "bounds": [lower, upper],
            "popsize": population,
            "maxfevals": evaluations,
            "tolfun": tolfun,
            "CMA_diagonal": diagonal_iterations,
            # pycma takes 0 as "from the clock"
            "seed": seed % (2**32 - 1) + 1,
            "verbose": -9,
            "verb_log": 0,
            "verb_disp": 0,
        },
    )
    history: dict[str, list[float]] = {"evaluations": [], "best": [], "generation_best": [], "sigma": []}
    best, best_z = np.inf, start
    while not strategy.stop():
        points = strategy.ask()
        values = cost(np.exp(np.array(points)))
        strategy.tell(points, values.tolist())
        i = int(np.argmin(values))
        if values[i] < best:
            best, best_z = float(values[i]), np.array(points[i])
        history["evaluations"].append(int(strategy.countevals))
        history["best"].append(best)
        history["generation_best"].append(float(values[i]))
        history["sigma"].append(float(strategy.sigma))
        if progress is not None:
            progress(int(strategy.countevals), best)
    stop = {key: _plain(value) for key, value in strategy.stop().items()}
    return SearchResult(np.exp(best_z), best, int(strategy.countevals), np.exp(start), history, stop)


def _plain(value: object) -> float:
    try:
        return float(value)  # type: ignore[arg-type]
    except (TypeError, ValueError):
        return float("nan")
