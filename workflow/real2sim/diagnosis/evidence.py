"""What the search asks of a trial: a replay with room for effects, and residuals in units of their own noise.

Evidence is immutable: what is learnt of a trial (its noise, jumping markers) makes new evidence of it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, Protocol, Self

import numpy as np

from real2sim.effects.base import Scales
from real2sim.effects.catalogue import Placed
from real2sim.effects.chains import Context
from real2sim.recording.skin import Skin
from real2sim.system.linear import ForceResponse

# Initial-state hypotheses: the machine is released at the start pose, or in static equilibrium with the interface
START_POSE, BALANCE = "start pose", "balance"
# Name of the machine that a study is configured with, beside those that it is compared with
CONFIGURED = "configured"


class Simulation(Protocol):
    """Many simulations of one trial with some effects, in one call.

    ``planned_from`` is the context that the planned forces of the last free run were computed from, or that
    `plan_from` asked for.
    """

    planned_from: Context

    def run_effects(self, parameters: np.ndarray, x: Sequence[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
        """Simulate parameters (m, p) with searched numbers (m, q) of each effect.

        Returns what is observed (m, n, ...) and the machine's joints (m, n, j); NaN where a simulation failed.
        """

    def run_freely(self, parameters: np.ndarray, x: Sequence[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
        """As `run_effects` of one point (1, p), planned forces following the simulated motion: see `FreeRuns`."""

    def plan_from(self, motion: np.ndarray) -> None:
        """Plan forces from another motion (n, axes) of the interface than the recorded one from now on."""

    def linearised(self) -> ForceResponse | None:
        """Return the last call's first simulation as a linear system; None where forces do not act linearly."""

    @property
    def linearisation_cost(self) -> int:
        """Simulations that take as long as `linearised`."""

    def response(
        self, linear: ForceResponse, effect: int, forces: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return how forces (p, n, j) of an effect's motors at the samples change what `run_effects` returned first."""


class Cost(Protocol):
    """A plain cost of what is observed, beside the whitened residuals: for the strap, J of the paper."""

    def residuals(self, simulated: np.ndarray) -> np.ndarray:
        """Return residuals (m, n_r) whose sum of squares is the cost."""

    def sample_of_residual(self) -> np.ndarray:
        """Return the sample index (n_r,) of each residual."""


class Evidence(Protocol):
    """One trial, as the search and the judgement see it."""

    @property
    def name(self) -> str:
        """Name of the recording, for messages."""

    @property
    def rows(self) -> int:
        """Number of whitened residuals."""

    @property
    def samples_by_sensor(self) -> tuple[int, ...]:
        """Whitened residuals that count, by sensor: fewer than there are by what missing samples take away."""

    @property
    def samples(self) -> int:
        """Their number: the expectation of chi-squared."""

    @property
    def sensors(self) -> dict[str, int]:
        """Number of channels of each sensor by name, in the order of the channels: what is observed, what is logged.

        The same sensors in every trial of a system; one that was not recorded has no channels.
        """

    @property
    def noise_by_sensor(self) -> tuple[float, ...]:
        """Mean chi-squared of simulated noise by sensor: less than the residuals where a floor exceeds the noise."""

    @property
    def held_out(self) -> bool:
        """Return whether this is not the trial that is fitted."""

    @property
    def settled(self) -> bool:
        """Return whether the machine is in static equilibrium with the interface at the start."""

    @property
    def scales(self) -> Scales:
        """Units of the effects' parameters."""

    @property
    def context(self) -> Context:
        """Measurements that effects are computed from."""

    @property
    def skin(self) -> Skin | None:
        """Model of the segment's markers by each other; None where they do not determine one."""

    @property
    def threads(self) -> int:
        """Threads that may work at a time."""

    @property
    def noise(self) -> np.ndarray:
        """Simulated residuals (draws, n, c) of a perfect model."""

    @property
    def log_determinant(self) -> float:
        """Logarithm of the determinant of the noise covariance: with it, chi-squared is a likelihood."""

    @property
    def cost(self) -> Cost:
        """The plain cost."""

    def replay(self, effects: Sequence[Placed], nsim: int, *, coarse: bool = False) -> Simulation:
        """Return a simulation with effects; ``coarse`` where half of the time step is exact enough."""

    def raw(self, paths: np.ndarray, joints: np.ndarray) -> np.ndarray:
        """Return residuals (m, n, c), simulated minus measured."""

    def j(self, paths: np.ndarray) -> np.ndarray:
        """Return the plain cost (m,) of what was simulated."""

    def whiten(self, error: np.ndarray) -> np.ndarray:
        """Return residuals (m, n_r) whose squares sum to chi-squared, of residuals (m, n, c)."""

    def whitened(self, paths: np.ndarray, joints: np.ndarray) -> np.ndarray:
        """Return residuals (m, n_r) whose squares sum to chi-squared; NaN where a simulation failed."""

    def standing(self, error: np.ndarray) -> np.ndarray:
        """Return the mean square (m,) of residuals (m, n, c) before anything moves, in units of its noise."""

    def noise_of(
        self,
        effects: Sequence[Placed],
        parameters: np.ndarray,
        x: Sequence[np.ndarray],
        draws: int,
        seed: int,
    ) -> np.ndarray:
        """Return whitened residuals (draws, n_r) of noise alone where effects with numbers x (p,) each are true."""

    def shaken(self, draws: int, seed: int) -> Callable[[np.ndarray], np.ndarray] | None:
        """Return the residuals (draws, n, c) by noise of the drive, as a function of parameters (p,).

        None where simulations are driven by the most probable motion and not by what was measured: that bends no fit.
        """

    @property
    def rate_hz(self) -> float:
        """Sample rate."""

    @property
    def noise_source(self) -> str:
        """Source of the noise floor, in words."""

    @property
    def plain_samples(self) -> float:
        """Number of measurements that the plain cost takes as independent."""

    def floor_draws(self) -> np.ndarray:
        """Return the plain cost (draws,) of noise alone."""

    def residual_sd(self) -> dict[str, float]:
        """Return the RMS of what noise alone leaves of each observed channel, in its unit."""

    def axis_shares(self, paths: np.ndarray) -> dict[str, float]:
        """Return the share of the gap by coordinate of the interface, of simulated observations (n, ...)."""

    def locate(self, paths: np.ndarray, explained: np.ndarray | None) -> dict[str, Any]:
        """Return how the gap of simulated observations (n, ...) is spread over channels, time, frequency and regime.

        ``explained`` are the observations with the effect that was named, None where none was.
        """

    def traces(self, plain: np.ndarray, with_effect: np.ndarray) -> dict[str, np.ndarray]:
        """Return columns (n,) of a table: time [s], and observations (n, ...) measured, plain and with effect."""

    def as_held_out(self) -> Self:
        """Return the same trial as the one that is not fitted."""

    def as_settled(self) -> Self:
        """Return the same trial of a machine that starts in static equilibrium."""

    def with_scales(self, scales: Scales) -> Self:
        """Return the same trial with other units of the effects' parameters."""

    def adapted(self, parameters: np.ndarray) -> Self:
        """Return the same trial with the effects' parameters in units of a plain fit (p,) of it."""

    def with_noise(self, parameters: np.ndarray, draws: int, seed: int) -> Self:
        """Return the same trial, whitened by noise simulated at parameters (p,)."""

    def with_spikes(self, paths: np.ndarray) -> Self:
        """Return evidence that marks jumps of observations out of simulated ones (n, ...); self where none is new."""
