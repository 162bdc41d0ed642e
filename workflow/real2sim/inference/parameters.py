"""The twelve interface parameters as named objects with bounds and units."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from real2sim.geometry import AXES

STIFFNESS = tuple(f"k_{axis}" for axis in AXES)
DAMPING = tuple(f"d_{axis}" for axis in AXES)
PARAMETERS = STIFFNESS + DAMPING

_UNITS = {"kt": "N/m", "kr": "Nm/rad", "dt": "Ns/m", "dr": "Nms/rad"}


def unit(name: str) -> str:
    """Return the unit of a parameter by its name."""
    return _UNITS[name[0] + name[2]]


def parameter_column(name: str) -> str:
    """Return the column name of a parameter in a wide table, with its unit: ``k_tx_N_per_m``."""
    return f"{name}_{unit(name).replace('/', '_per_')}"


@dataclass(frozen=True)
class Bounds:
    """Admissible interval of each parameter, in the order of `PARAMETERS`: lower, upper (12,)."""

    lower: np.ndarray
    upper: np.ndarray

    @classmethod
    def from_config(cls, bounds: Mapping[str, Any]) -> Bounds:
        """Read ``{name: [lower, upper]}``; KeyError names a missing parameter."""
        table = np.array([bounds[name] for name in PARAMETERS], dtype=float)
        return cls(table[:, 0], table[:, 1])

    def log_uniform(self, rng: np.random.Generator) -> np.ndarray:
        """Draw ln-parameters (12,) uniformly between the logarithms of the bounds."""
        return np.asarray(rng.uniform(np.log(self.lower), np.log(self.upper)))

    def at_bound(self, values: np.ndarray, tolerance: float) -> list[str]:
        """Return the names of the parameters (12,) whose logarithm lies within ``tolerance`` of a bound's."""
        z = np.log(values)
        near = (z - np.log(self.lower) < tolerance) | (np.log(self.upper) - z < tolerance)
        return [name for name, hit in zip(PARAMETERS, near, strict=True) if hit]


def as_dict(values: np.ndarray) -> dict[str, float]:
    """Name the parameters of a vector (12,)."""
    return {name: float(value) for name, value in zip(PARAMETERS, values, strict=True)}


def as_vector(values: dict[str, float]) -> np.ndarray:
    """Order named parameters into a vector (12,)."""
    return np.array([values[name] for name in PARAMETERS], dtype=float)
