"""Joint refits: the system's parameters together with the free parameters of added effects."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from real2sim.diagnosis.evidence import Evidence, Simulation
from real2sim.diagnosis.sensors import by_sensor
from real2sim.effects.base import InterfaceImpedance
from real2sim.effects.catalogue import Placed
from real2sim.effects.chains import Context
from real2sim.effects.free_run import feed_back
from real2sim.inference import least_squares
from real2sim.recording.skin import Skin
from real2sim.system.description import System

BATCH = 16
# Coefficients of planned forces whose responses are held at a time
_COLUMNS = 48
# A coordinate whose bounds are no further apart than this is held
NO_RANGE = 1e-4
# Slope [SD of noise per large force of a joint] that no stable simulation has: a large force moves by a large excursion
ENDLESS = 1e9


@dataclass(frozen=True)
class FitToBoth:
    """Numbers ``z`` (n + p,) that are fitted to both trials, and chi-squared that they leave by sensor, trial by trial.

    ``occam``: what Laplace's approximation of the marginal likelihood of both trials adds to chi-squared.
    """

    z: np.ndarray
    by_sensor: tuple[tuple[float, ...], ...]
    occam: float


@dataclass
class Hypothesis:
    """Effects with fitted values: searched numbers ``z`` (n + p,) of n parameters and of the effects, and chi-squared.

    ``chi2`` and ``j`` (J of the paper) are those of training and held-out trial; ``evaluations`` counts replays;
    ``converged``: it was refitted to the end. ``occam``: what Laplace's approximation of the marginal likelihood of the
    training trial adds to chi-squared (`occam_of`). ``sensors`` are ``chi2`` by sensor, trial by trial, where there is
    more than one. ``motions`` are those (n, axes) of the interface in the free runs of both trials, where planned
    forces follow them. ``both`` is what it leaves with numbers that are fitted to both trials, where that was asked.
    """

    effects: tuple[Placed, ...]
    z: np.ndarray
    chi2: tuple[float, float]
    j: tuple[float, float] = (np.nan, np.nan)
    evaluations: int = 0
    converged: bool = False
    occam: float = 0.0
    sensors: tuple[tuple[float, ...], ...] = ()
    motions: tuple[np.ndarray, ...] = ()
    both: FitToBoth | None = None

    @property
    def competing(self) -> FitToBoth:
        """The fit by which it competes with others: that to both trials, where that was asked."""
        return self.both or FitToBoth(self.z, self.by_sensor, self.occam)

    @property
    def left(self) -> tuple[float, float]:
        """Chi-squared of each trial that the competing fit leaves."""
        train, held_out = (sum(left) for left in self.competing.by_sensor)
        return train, held_out

    @property
    def deviance(self) -> float:
        """Minus twice the logarithm of the evidence, but for what all hypotheses have in common."""
        return sum(self.left) + self.competing.occam

    @property
    def by_sensor(self) -> tuple[tuple[float, ...], ...]:
        """Chi-squared by sensor, trial by trial."""
        return self.sensors or tuple((left,) for left in self.chi2)

    @property
    def own(self) -> int:
        """Number p of searched numbers that belong to the effects."""
        return sum(len(placed.effect.parameters) for placed in self.effects)

    @property
    def base(self) -> np.ndarray:
        """Searched numbers (n,) of the system's parameters."""
        return self.z[: len(self.z) - self.own]

    @property
    def key(self) -> str:
        """Effects and places; empty for the plain plant."""
        return " + ".join(placed.key for placed in self.effects)

    @property
    def names(self) -> tuple[str, ...]:
        """Effect names, each once: an effect on two axes is one effect."""
        return tuple(dict.fromkeys(placed.effect.name for placed in self.effects))

    def split(self) -> list[np.ndarray]:
        """Searched numbers (p,) of each effect."""
        return split(self.effects, self.z[None, len(self.z) - self.own :], squeeze=True)


def split(effects: Sequence[Placed], x: np.ndarray, squeeze: bool = False) -> list[np.ndarray]:
    """Searched numbers (m, p) of all effects, effect by effect."""
    ends = np.cumsum([len(placed.effect.parameters) for placed in effects])
    parts = np.split(x, ends[:-1], axis=1) if len(effects) else []
    return [part[0] for part in parts] if squeeze else parts


def run_freely(
    replay: Simulation, effects: Sequence[Placed], parameters: np.ndarray, x: Sequence[np.ndarray]
) -> tuple[np.ndarray, np.ndarray]:
    """As `Simulation.run_effects` of one point (1, n), in a free run where a planned force asks for one."""
    return (replay.run_freely if feed_back(effects) else replay.run_effects)(parameters, x)


class PlainResiduals(least_squares.Residuals):
    """Residuals of the plain cost of a trial in the system's searched parameters."""

    def __init__(self, evidence: Evidence, system: System):
        self._cost, self._system = evidence.cost, system
        self._replay = evidence.replay([], BATCH)
        self.lower, self.upper = system.bounds()
        self.evaluations = 0

    def many(self, z: np.ndarray) -> np.ndarray:
        """Residuals (m, n_r) of points (m, n)."""
        self.evaluations += len(z)
        return np.concatenate([self._some(z[i : i + BATCH]) for i in range(0, len(z), BATCH)])

    def _some(self, z: np.ndarray) -> np.ndarray:
        return self._cost.residuals(self._replay.run_effects(self._system.values(z), [])[0])


class JointResiduals(least_squares.Residuals):
    """Whitened residuals of a trial in searched parameters and numbers of the effects, and rows of their priors.

    ``coarse``: see `Evidence.replay`. ``free`` are the coordinates that are fitted on this trial: not those whose
    bounds coincide, and of the held-out one those alone that say nothing of the other.
    """

    def __init__(
        self, evidence: Evidence, effects: Sequence[Placed], system: System, *, coarse: bool = False
    ):
        self.effects, self._evidence, self._system = tuple(effects), evidence, system
        self._replay = evidence.replay(list(effects), BATCH, coarse=coarse)
        own_lower, own_upper = system.bounds()
        self._n = n = len(own_lower)
        pairs = [placed.bounds() for placed in effects]
        self.lower = np.concatenate([own_lower, *(low for low, _ in pairs)])
        self.upper = np.concatenate([own_upper, *(high for _, high in pairs)])
        middle, spread = _base_prior(own_lower, own_upper)
        self.prior_mean = np.concatenate([middle, np.zeros(len(self.lower) - n)])
        self.prior_sd = np.concatenate([spread, *(placed.prior_sd() for placed in effects)])
        fitted = np.concatenate([np.ones(n, bool), *(p.of_trial(held_out=False) for p in effects)])
        here = ~fitted if evidence.held_out else fitted
        self.free = np.flatnonzero(here & (self.upper - self.lower > NO_RANGE))
        acting = [p.of_trial(held_out=evidence.held_out) for p in effects]
        self._acting = np.concatenate([np.ones(n, bool), *acting])
        self.evaluations = 0
        self.last: np.ndarray | None = None
        # what forces are planned from, where that is not what was recorded
        self._context: Context | None = None
        # point and result of the last free run
        self._free_run: tuple[bytes, tuple[np.ndarray, np.ndarray]] = b"", (np.empty(0), np.empty(0))

    def many(self, z: np.ndarray) -> np.ndarray:
        """Residuals (m, n_r) of points (m, n + p)."""
        self.evaluations += len(z)
        return np.concatenate([self._some(z[i : i + BATCH]) for i in range(0, len(z), BATCH)])

    def _run(self, z: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return self._replay.run_effects(*self._numbers(z))

    def _numbers(self, z: np.ndarray) -> tuple[np.ndarray, list[np.ndarray]]:
        """Parameters (m, n) [SI] of the system and searched numbers (m, p) of each effect of points (m, n + p)."""
        return self._system.values(z[:, : self._n]), split(self.effects, z[:, self._n :])

    def _some(self, z: np.ndarray) -> np.ndarray:
        return np.hstack([self._evidence.whitened(*self._run(z)), self._beside_data(z)])

    def _beside_data(self, z: np.ndarray) -> np.ndarray:
        """Rows (m, r) that no simulation is needed for: those of the priors, and ways of the pelvis' markers."""
        rows = [self._prior(z, slice(self._n))]
        # effect by effect: what is added to a set adds its rows at the end
        for placed, own, x in zip(
            self.effects, self._places, split(self.effects, z[:, self._n :]), strict=True
        ):
            rows.append(self._prior(z, own))
            skin, ways = self._ways(placed, x)
            if skin is not None:
                rows.append(np.array([skin.departures(way) for way in ways]))
        return np.hstack(rows)

    def with_jacobian(self, z: np.ndarray, free: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """As of `least_squares.Residuals`."""
        if not self._worth_linearising(free):
            return super().with_jacobian(z, free)
        r = self.many(z[None])[0]
        return r, self.jacobian(z, r, free)

    def jacobian(self, z: np.ndarray, r: np.ndarray, free: np.ndarray) -> np.ndarray:
        """As of `least_squares.Residuals`; by coefficients of planned forces from the linearised simulation.

        The last one is kept in ``last``.
        """
        self.last = self._slopes_by(z, r, free)
        return self.last

    def _slopes_by(self, z: np.ndarray, r: np.ndarray, free: np.ndarray) -> np.ndarray:
        forces = self._is_force()[free]
        by_forces = self._by_forces(z, free[forces]) if self._worth_linearising(free) else None
        if by_forces is None:
            return super().jacobian(z, r, free)
        out = np.empty((len(r), len(free)))
        out[:, forces] = by_forces
        out[:, ~forces] = super().jacobian(z, r, free[~forces])
        return out

    def occam_of(self, z: np.ndarray, jacobian: np.ndarray, free: np.ndarray | None = None) -> float:
        """Return what the marginal likelihood adds to chi-squared, by a Jacobian (n_r, k) in the coordinates ``free``.

        Twice the negative logarithm of the share of the prior that the data leave, and the squared distance from the
        prior's mean (Laplace's approximation; MacKay, Neural Comput. 4 (1992) 415). A coordinate without a prior has a
        uniform one between its bounds; one that the data do not determine costs nothing.
        """
        free = self.free if free is None else free
        uniform = ~np.isfinite(self.prior_sd[free])
        sd = prior_widths(self.prior_sd, self.lower, self.upper)[free]
        curvature = jacobian.T @ jacobian
        curvature[np.diag_indices_from(curvature)] += np.where(uniform, 1 / sd**2, 0.0)
        _, log_volume = np.linalg.slogdet(curvature * np.outer(sd, sd))
        away = ((z - self.prior_mean)[free] / sd)[~uniform]
        return float(log_volume + away @ away)

    def _is_force(self) -> np.ndarray:
        """Return a mask (n + p,) of the coefficients that a planned force is linear in."""
        out = np.zeros(len(self.lower), bool)
        for placed, own in zip(self.effects, self._places, strict=True):
            out[own] = placed.effect.plant.linear
        return out

    def _worth_linearising(self, free: np.ndarray) -> bool:
        """Return whether coordinates (k,) hold more coefficients of planned forces than a linearisation costs."""
        asked = self._is_force() & self._acting
        return bool(asked[free].sum() > self._replay.linearisation_cost)

    def _by_forces(self, z: np.ndarray, columns: np.ndarray) -> np.ndarray | None:
        """Slopes (n_r, k) by coefficients of planned forces; None where the simulation is not linear in forces.

        None too where its linearised steps grow without bound.
        """
        paths, joints = self._run(z[None])
        linear = self._replay.linearised()
        if linear is None:
            return None
        here, evidence = self._evidence.whitened(paths, joints), self._evidence
        context = self._context or evidence.context
        context = replace(context, step_time_s=context.time_s, held_out=evidence.held_out)
        impedance = InterfaceImpedance(np.empty((0, 0)), np.empty((0, 0)))
        data = np.zeros((here.shape[1], len(z)))
        for i, (placed, own) in enumerate(zip(self.effects, self._places, strict=True)):
            acts = np.flatnonzero(placed.of_trial(held_out=evidence.held_out)) + own.start
            if placed.effect.plant.linear and np.isin(acts, columns).any():
                unit = np.eye(len(acts))
                # a free history has hundreds of coefficients, whose simulated paths would fill the memory
                for some in np.split(np.arange(len(acts)), np.arange(_COLUMNS, len(acts), _COLUMNS)):
                    force = placed.effect.plant.force(unit[some], context, placed.where, impedance)
                    assert force is not None
                    moved, turned = self._replay.response(linear, i, force)
                    data[:, acts[some]] = (evidence.whitened(paths + moved, joints + turned) - here).T
        if not np.abs(data).max(initial=0.0) < ENDLESS:
            return None
        beside = self._beside_data(np.vstack([z, z + np.eye(len(z))[columns]]))
        return np.vstack([data[:, columns], (beside[1:] - beside[0]).T])

    def _prior(self, z: np.ndarray, part: slice) -> np.ndarray:
        """Rows (m, r) of those coordinates in a part that are held near something."""
        held = np.isfinite(self.prior_sd[part])
        return np.asarray((z - self.prior_mean)[:, part][:, held] / self.prior_sd[part][held])

    @property
    def _places(self) -> list[slice]:
        """Slices of each effect's numbers in a point."""
        ends = self._n + np.cumsum([0, *(len(placed.effect.parameters) for placed in self.effects)])
        return [slice(a, b) for a, b in pairwise(ends)]

    def _ways(self, placed: Placed, x: np.ndarray) -> tuple[Skin | None, list[np.ndarray]]:
        """Return the skin model and an effect's displacements of the pelvis' markers, one per row of numbers (m, p).

        None and no ways where the effect moves none, or the trial says nothing of them.
        """
        ways = placed.effect.chains.displacement
        if ways is None or self._evidence.skin is None:
            return None, []
        return self._evidence.skin, [ways(values, self._evidence.context) for values in placed.values(x)]

    def paths(self, z: np.ndarray) -> np.ndarray:
        """Simulated interface markers (n, 2, 3) [m, world] at a point (n + p,)."""
        return np.asarray(self._run(z[None])[0][0])

    def freely(self, z: np.ndarray) -> np.ndarray:
        """Whitened residuals (r,) of the data at a point (n + p,) in a free run."""
        return np.asarray(self._evidence.whitened(*self._run_freely(z))[0])

    def _run_freely(self, z: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        if self._free_run[0] != z.tobytes():
            self._free_run = z.tobytes(), run_freely(self._replay, self.effects, *self._numbers(z[None]))
        return self._free_run[1]

    def cost_freely(self, z: np.ndarray) -> float:
        """Sum of squares of all residuals, those of the priors too, at a point (n + p,) in a free run."""
        left = np.concatenate([self.freely(z), self._beside_data(z[None])[0]])
        cost = float(left @ left)
        return cost if np.isfinite(cost) else np.inf

    def follow(self, z: np.ndarray) -> None:
        """Plan forces from the motion of the free run at a point (n + p,) from now on.

        Nothing changes where no force depends on the motion of the interface, or no free run is found.
        """
        if feed_back(self.effects) and np.isfinite(self._run_freely(z)[0]).all():
            self.plan_from(self._replay.planned_from.coordinates)

    def plan_from(self, motion: np.ndarray) -> None:
        """Plan forces that depend on the interface's motion from another one (n, axes) than the recorded one."""
        self._replay.plan_from(motion)
        self._context = self._replay.planned_from

    @property
    def motion(self) -> np.ndarray:
        """Motion (n, axes) of the interface in the last free run, or the one that forces are planned from."""
        return self._replay.planned_from.coordinates

    def raw(self, z: np.ndarray) -> np.ndarray:
        """Residuals (1, n, c) before they are whitened, at a point (n + p,)."""
        return self._evidence.raw(*self._run(z[None]))

    def judged(self, z: np.ndarray) -> tuple[tuple[float, ...], float]:
        """Sum of squares of the data's residuals alone by sensor, and J, at a point (n + p,).

        Ways of the pelvis' markers that these do not show count as residuals of the first sensor, the markers. The
        simulation is a free run.
        """
        self.evaluations += 1
        paths, joints = self._run_freely(z)
        left = by_sensor(self._evidence.whitened(paths, joints), self._evidence.sensors.values())[0]
        for placed, x in zip(self.effects, split(self.effects, z[None, self._n :]), strict=True):
            skin, ways = self._ways(placed, x)
            if skin is not None:
                left[0] += skin.against_it(ways[0])
        return tuple(left.tolist()), float(self._evidence.j(paths)[0])


def following(
    evidence: Evidence, hypothesis: Hypothesis, system: System, *, coarse: bool = False, known: bool = True
) -> JointResiduals:
    """Return residuals of a hypothesis whose planned forces follow the motion of its free run.

    ``known``: the evidence is one of the two trials of the fit, whose motions the hypothesis holds.
    """
    problem = JointResiduals(evidence, hypothesis.effects, system, coarse=coarse)
    if known and hypothesis.motions:
        problem.plan_from(hypothesis.motions[int(evidence.held_out)])
    else:
        problem.follow(hypothesis.z)
    return problem


def _base_prior(lower: np.ndarray, upper: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Mean and SD (n,) of the system's searched parameters before any data: the search bounds are its two sigma.

    It is nothing beside a trial that moves an axis; a parameter that the trial says nothing about stays in the middle
    instead of wandering to wherever the noise pushes it.
    """
    return (lower + upper) / 2, np.maximum((upper - lower) / 4, 1e-3)


def refit(
    residuals: JointResiduals,
    start: np.ndarray,
    *,
    iterations: int,
    ftol: float,
    keep: float = 0.0,
    known: least_squares.Tangent | None = None,
) -> tuple[np.ndarray, float]:
    """Best point (n + p,) from a start and its cost, all coordinates free that are fitted on this trial.

    ``keep``, ``known``: see `least_squares.minimise`.
    """
    z, cost, _, _ = least_squares.minimise(
        residuals, start, residuals.free, iterations=iterations, ftol=ftol, keep=keep, known=known
    )
    return z, cost


def refit_freely(residuals: JointResiduals, start: np.ndarray, *, iterations: int, ftol: float) -> np.ndarray:
    """Best point (n + p,) in free runs, from one that was fitted to forces planned from the recorded motion.

    Forces are planned from the motion of the free run, and all numbers take a step, ``iterations`` times at most and as
    long as the next free run leaves less by a share ``ftol``. That motion has not been told what was recorded: it is
    the instrument with which coefficients beside a gap are not bent by it (instrumental variables: Soderstrom & Stoica,
    Automatica 17 (1981) 101).
    """
    best, least = start, residuals.cost_freely(start)
    for _ in range(iterations if np.isfinite(least) else 0):
        residuals.follow(best)
        # where it is and one step
        z, _ = refit(residuals, best, iterations=2, ftol=ftol)
        cost = residuals.cost_freely(z)
        if not cost < least:
            break
        gain, best, least = 1 - cost / least, z, cost
        if gain < ftol:
            break
    return best


def prior_widths(prior_sd: np.ndarray, lower: np.ndarray, upper: np.ndarray) -> np.ndarray:
    """Return the SD (n,) of each prior: ``prior_sd`` (n,), or that of a uniform one where it is infinite.

    ``lower`` and ``upper`` (n,) are the bounds of the uniform one.
    """
    return np.where(np.isfinite(prior_sd), prior_sd, (upper - lower) / np.sqrt(12))
