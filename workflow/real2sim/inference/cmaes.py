"""CMA-ES on ln-parameters (paper, section III-B and the footnotes of IV-A)."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from real2sim.inference.parameters import Bounds
from real2sim.inference.result import SearchResult


class Run:
    """One CMA-ES search from one log-uniform start, asked for a generation at a time.

    Its random numbers are its own, so that runs may take turns and give what each would alone.
    """

    def __init__(
        self,
        bounds: Bounds,
        *,
        population: int,
        sigma0: float,
        evaluations: int,
        tolfun: float,
        diagonal_iterations: int,
        seed: int,
    ):
        with warnings.catch_warnings():
            # pycma warns at import where moarchiving, which is not used here, is not installed
            warnings.simplefilter("ignore")
            import cma

        self._start = bounds.log_uniform(np.random.default_rng(seed))
        self._randn = np.random.RandomState(seed).randn
        self._strategy = cma.CMAEvolutionStrategy(
            self._start,
            sigma0,
            {
                "bounds": [np.log(bounds.lower), np.log(bounds.upper)],
                "popsize": population,
                "maxfevals": evaluations,
                "tolfun": tolfun,
                "CMA_diagonal": diagonal_iterations,
                "randn": self._randn,
                "seed": float("nan"),
                "verbose": -9,
                "verb_log": 0,
                "verb_disp": 0,
            },
        )
        self._history: dict[str, list[float]] = {
            "evaluations": [],
            "best": [],
            "generation_best": [],
            "sigma": [],
        }
        self._best, self._best_z = np.inf, self._start
        self._points: list[np.ndarray] = []

    @property
    def done(self) -> bool:
        """Whether the search has ended."""
        return bool(self._strategy.stop())

    @property
    def evaluations(self) -> int:
        """Evaluations so far."""
        return int(self._strategy.countevals)

    @property
    def best(self) -> float:
        """Lowest cost so far."""
        return self._best

    def ask(self) -> np.ndarray:
        """Parameters (population, 12) of the next generation."""
        # pycma 4.5 forgets the option when it goes from the diagonal to the full covariance
        self._strategy.sm.randn = self._randn
        self._points = self._strategy.ask()
        return np.asarray(np.exp(np.array(self._points)))

    def tell(self, values: np.ndarray) -> None:
        """Costs (population,) of what `ask` gave."""
        self._strategy.tell(self._points, values.tolist())
        i = int(np.argmin(values))
        if values[i] < self._best:
            self._best, self._best_z = float(values[i]), np.array(self._points[i])
        self._history["evaluations"].append(self.evaluations)
        self._history["best"].append(self._best)
        self._history["generation_best"].append(float(values[i]))
        self._history["sigma"].append(float(self._strategy.sigma))

    def result(self) -> SearchResult:
        """What the search found."""
        stop = {key: _plain(value) for key, value in self._strategy.stop().items()}
        return SearchResult(
            np.exp(self._best_z), self._best, self.evaluations, np.exp(self._start), self._history, stop
        )


def search(
    cost: Callable[[np.ndarray], np.ndarray],
    bounds: Bounds,
    *,
    population: int,
    sigma0: float,
    evaluations: int,
    tolfun: float,
    diagonal_iterations: int,
    seeds: Sequence[int],
    progress: Callable[[int, float], None] | None = None,
) -> list[SearchResult]:
    """Minimise a cost by CMA-ES from one log-uniform start per seed, generation by generation side by side.

    Parameters
    ----------
    cost
        Maps parameters (m, 12) to costs (m,): the generations of all searches that go on, in one call.
    population, sigma0, evaluations, tolfun
        lambda, initial step in ln-units, budget and tolerance of the paper, of each search.
    diagonal_iterations
        Generations in which only the diagonal of the covariance is learnt (pycma's ``CMA_diagonal``).
    seeds
        Of start and search: same seed, same result, whatever else is searched beside it.
    progress
        Called with the evaluations done in all searches and the best cost after each round.
    """
    runs = [
        Run(
            bounds,
            population=population,
            sigma0=sigma0,
            evaluations=evaluations,
            tolfun=tolfun,
            diagonal_iterations=diagonal_iterations,
            seed=seed,
        )
        for seed in seeds
    ]
    while going := [run for run in runs if not run.done]:
        values = cost(np.concatenate([run.ask() for run in going]))
        for run, own in zip(going, np.split(values, len(going)), strict=True):
            run.tell(own)
        if progress is not None:
            progress(sum(run.evaluations for run in runs), min(run.best for run in runs))
    return [run.result() for run in runs]


def _plain(value: Any) -> float:
    """Return a termination figure of pycma as a number, NaN where it is none."""
    try:
        return float(value)
    except (TypeError, ValueError):
        return float("nan")
