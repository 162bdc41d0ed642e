"""What every search returns."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np


@dataclass
class SearchResult:
    """Outcome of a search: best parameters (12,), its cost, history per generation and why it stopped."""

    parameters: np.ndarray
    cost: float
    evaluations: int
    start: np.ndarray
    history: dict[str, list[float]] = field(default_factory=dict)
    stop: dict[str, float] = field(default_factory=dict)
