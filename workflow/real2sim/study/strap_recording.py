"""Evidence of a trial in the strap, read from canonical tables."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from real2sim import signals
from real2sim.effects.base import FAR, Scales
from real2sim.effects.chains import Context, MarkerShapes, NeutralPose, RobotMass, markers_of
from real2sim.geometry import AXES, interface_frame
from real2sim.inference.cost import CostScales, TrialCost
from real2sim.recording import missing_marker
from real2sim.recording.jumps import JumpRule, spikes, without_ghosts
from real2sim.recording.missing_marker import PutBack
from real2sim.recording.noise import NoiseModel, hold_uncertainty, rest_uncertainty, robot_noise
from real2sim.recording.pelvis import PathRule, most_probable_pelvis, pelvis_shape
from real2sim.recording.skin import on_pelvis, skin_by_turn, skin_of
from real2sim.recording.start import at_first, moved_to_first
from real2sim.recording.tables import (
    bridged_rotation,
    log_offset_sd,
    mean_pelvis,
    measured_coordinates,
    robot_motion,
    without_filled,
)
from real2sim.recording.trial import Trial, load_limits, load_trial
from real2sim.study.strap import strap_system
from real2sim.study.strap_evidence import NoiseLevels, PlantSetup, Recorded, StrapEvidence
from real2sim.system.plant import JointLimits, impedances, load_robot, mass_on_base

if TYPE_CHECKING:
    from real2sim.settings import IngestSkinSettings, Settings


def load_evidence(
    *,
    folder: Path,
    neutral: Path,
    limits: Path | None,
    robot: Path,
    settings: Settings,
    noise: NoiseModel,
    settled: bool = False,
    threads: int = 1,
) -> StrapEvidence:
    """Read the evidence of one trial from its canonical tables, not whitened yet.

    Parameters
    ----------
    folder, neutral
        results/trials/<SUBJECT>/<TRIAL> of the trial and of the neutral one.
    limits
        Joint limits of the person; None lets the strap's joints go anywhere.
    settings
        Slices ``identification``, ``plant``, ``robot``, ``ingest`` and ``diagnosis``; ``plant.timestep_s`` is a number.
    noise
        Of the markers, from the neutral trial.
    settled, threads
        See `StrapEvidence`, `PlantSetup`.
    """
    rate = settings["ingest"]["rate_hz"]
    log_sd = robot_noise(neutral / "robot.parquet", folder / "robot.parquet", noise.bands)
    recorded, qd, let_go = _read(folder, neutral, robot, settings, noise, log_sd)
    start = recorded.context.start
    held = impedances(settings["robot"], "hold")
    twin = load_robot(robot).compile()
    standing = neutral / "pose.parquet"
    levels = NoiseLevels(
        noise,
        log_sd,
        rest_uncertainty(standing, rate),
        hold_uncertainty(standing, folder / "pose.parquet", start, rate, twin, held),
        let_go,
        log_offset_sd(folder / "quality.json"),
    )
    ones = np.ones(6)
    scales = Scales(_large(recorded.coordinates), _large(qd), ones, ones, ones)
    known = None if limits is None else load_limits(limits)
    if known is not None:
        known, crossed = without_crossed(
            known, recorded.coordinates, settings["diagnosis"]["crossed_limit_share"]
        )
        recorded = replace(recorded, crossed=crossed)
    setup = PlantSetup(strap_system(robot, settings), settings, known, threads)
    return StrapEvidence(recorded, levels, scales, setup, settled, name=folder.as_posix())


def _read(
    folder: Path,
    neutral: Path,
    robot: Path,
    settings: Settings,
    noise: NoiseModel,
    log_sd: np.ndarray,
) -> tuple[Recorded, np.ndarray, np.ndarray]:
    """Read the measurements, rates (n, 6) of the interface, and the uncertainty (6, 6) of the start pose by the log."""
    ident, rate = settings["identification"], settings["ingest"]["rate_hz"]
    trial = load_trial(folder / "pose.parquet", folder / "markers.parquet", ident)
    options = settings["diagnosis"]
    rule = JumpRule(rate, settings["ingest"]["cutoff_hz"], options["jumps"])
    trial = replace(trial, interface=without_filled(trial.interface, folder / "markers.parquet", rule))
    start = max(2, int(np.sum(trial.time_s - trial.time_s[0] < ident["start_window_s"])))
    seen = trial.pelvis_markers
    trial, jumped = without_ghosts(trial, rule, settings["ingest"]["skin"], ident["settle_after_gap_s"])
    put_back = _put_back(trial, seen, settings["ingest"]["skin"])
    reading = PathRule(**options["pelvis"])
    trial, path = most_probable_pelvis(trial, noise, start, reading)
    measured = robot_motion(folder / "robot.parquet", trial.interface, start)
    let_go = np.zeros((6, 6))
    if measured is not None:
        trial, let_go = moved_to_first(
            trial, robot, *at_first(measured, start, rate, log_sd, options["start"])
        )
    q, qd = (measured_coordinates(folder / "pose.parquet", prefix) for prefix in ("q", "qd"))
    cutoff = path.cutoff_hz(reading.lowest_cutoff_hz, settings["ingest"]["cutoff_hz"])
    context = _context(
        trial, neutral, robot, start, rule, *(signals.lowpass(x, rate, cutoff, 4) for x in (q, qd))
    )
    sigma = CostScales(ident["scales"]["position_m"], ident["scales"]["velocity_m_per_s"])
    cost = TrialCost(trial.interface, rate, sigma, trial.usable)
    skin = skin_of(trial.time_s, trial.pelvis_markers, context.shapes.segment, options["skin"])
    return Recorded(trial, measured, context, cost, q, path, skin, jumped, put_back), qd, let_go


def _put_back(trial: Trial, before: np.ndarray, skin: IngestSkinSettings) -> tuple[PutBack, ...]:
    """Return the gaps of pelvis markers of a trial with a pelvis that one of them was put back in, and how well.

    ``before`` (n, 4, 3) [m] are the markers as they came: unknown where they were lost, and elsewhere than those of the
    trial where they were not believed.
    """
    seen = np.isfinite(before).all(axis=2) & (before == trial.pelvis_markers).all(axis=2)
    one = np.isfinite(trial.pelvis_position).all(axis=1) & ((~seen).sum(axis=1) == 1)
    return tuple(
        missing_marker.error_of_put_back(before, seen, marker, gap, skin)
        for marker in range(seen.shape[1])
        for gap in signals.segments(one & ~seen[:, marker])
    )


def _context(
    trial: Trial,
    neutral: Path,
    robot: Path,
    start: int,
    rule: JumpRule,
    coordinates: np.ndarray,
    rates: np.ndarray,
) -> Context:
    """Return the measurements that effects are computed from; ``start`` samples while the person stands."""
    twin = load_robot(robot).compile()
    rotation, _ = interface_frame(trial.interface[:, 0], trial.interface[:, 1])
    pelvis, shape = bridged_rotation(trial.pelvis_rotation), pelvis_shape(trial)
    return Context(
        trial.time_s,
        trial.time_s,
        pelvis,
        signals.bridged(trial.pelvis_position),
        bridged_rotation(rotation),
        start,
        RobotMass(*mass_on_base(twin, "interface")),
        trial.interface,
        spikes(trial.interface, rule),
        coordinates,
        rates,
        NeutralPose(*mean_pelvis(neutral)),
        MarkerShapes(shape, _rest_shape(trial), skin_by_turn(pelvis, on_pelvis(trial.pelvis_markers), shape)),
        twin.body("interface").pos,
    )


def without_crossed(limits: JointLimits, q: np.ndarray, most: float) -> tuple[JointLimits, tuple[str, ...]]:
    """Return joint limits without the sides that a recording is beyond, and those sides ("tz lower", ...).

    Sweeps show how far a strap was moved, not how far it goes. A recording that stays beyond such a limit was made
    where that limit is not, because the strap moved after the sweeps, say. Held back there, a simulation would be
    pinned to a stop that nobody touched.

    Parameters
    ----------
    limits
        Joint limits of the person [m, rad].
    q
        Recorded coordinates of the interface (n, 6) [m, rad].
    most
        Largest share of samples beyond a limit that holds.
    """
    lower, upper = limits.lower.copy(), limits.upper.copy()
    crossed = []
    for side, of_side, beyond in (("lower", lower, q < lower), ("upper", upper, q > upper)):
        where = beyond.mean(axis=0) > most
        crossed += [f"{AXES[i]} {side}" for i in np.flatnonzero(where)]
        of_side[where] = -FAR if side == "lower" else FAR
    return JointLimits(lower, upper), tuple(crossed)


def _large(values: np.ndarray) -> np.ndarray:
    """Large excursions (6,): the 95th percentile of the size."""
    return np.asarray(np.maximum(np.percentile(np.abs(values), 95, axis=0), 1e-6))


def _rest_shape(trial: Trial) -> np.ndarray:
    """Return the interface's markers in the pelvis frame at rest, (2, 3) [m]."""
    half = float(np.nanmean(np.linalg.norm(trial.interface[:, 0] - trial.interface[:, 1], axis=1))) / 2
    return markers_of(trial.rest.rotation, trial.rest.position, half)
