"""Columns of a described system's recording that cannot be what they are taken for: clipped, coarse, slow, rescaled."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING

import numpy as np

from real2sim import signals
from real2sim.recording.formats.recordings import Finding
from real2sim.system.description import System

if TYPE_CHECKING:
    from real2sim.settings import DiagnosisDescribedChannelsSettings


def channel_findings(
    system: System,
    name: str,
    rate_hz: float,
    measured: Mapping[str, np.ndarray],
    settings: DiagnosisDescribedChannelsSettings,
) -> Iterator[Finding]:
    """Yield what is odd about the measured columns (n,) of a recording.

    ``settings`` is the slice ``diagnosis.described.channels`` of the configuration.
    """
    if rate_hz < settings["samples_per_period"] * system.band_hz:
        yield Finding(
            "rate_below_band",
            "warning",
            name,
            "time_s",
            f"{rate_hz:.4g} Hz, where the system is said to move up to {system.band_hz:g} Hz (band_hz)",
            "Used as it is. Record faster, or lower band_hz; times in other units than seconds read like this.",
        )
    for column, values in measured.items():
        known = values[np.isfinite(values)]
        if len(known) < 2 or not np.ptp(known):
            continue
        share, stretches = _clipped(known)
        if share >= settings["clipped_share"] and stretches >= settings["clipped_stretches"]:
            yield Finding(
                "channel_clipped",
                "warning",
                name,
                column,
                f"{100 * share:.1f} % of the samples lie exactly at {known.min():.6g} or {known.max():.6g}, in "
                f"{stretches} stretches: the channel or its amplifier saturates",
                "Used as it is: the diagnosis takes the flat parts for motion. Record with a larger range.",
            )
        step = _resolution(known)
        if np.ptp(known) < settings["least_levels"] * step:
            yield Finding(
                "channel_coarse",
                "warning",
                name,
                column,
                f"values are {step:.4g} apart, a {np.ptp(known) / step:.0f}th of their range",
                "Used as it is: steps are no white noise. Record at a finer resolution.",
            )


def _clipped(values: np.ndarray) -> tuple[float, int]:
    """Return the share of samples in stretches of three and more at an extreme value, and how many stretches.

    A stretch at the beginning or at the end may be a machine that stands still.
    """
    count, stretches = 0, 0
    for extreme in (values.min(), values.max()):
        at = np.concatenate([[False], values == extreme, [False]])
        begin, end = (
            np.flatnonzero(np.diff(at.astype(int)) == 1),
            np.flatnonzero(np.diff(at.astype(int)) == -1),
        )
        lengths = (end - begin)[(begin > 0) & (end < len(values))]
        count += int(lengths[lengths >= 3].sum())
        stretches += int((lengths >= 3).sum())
    return count / len(values), stretches


def _resolution(values: np.ndarray) -> float:
    """Return the smallest step between neighbouring values that occur, beyond rounding."""
    steps = np.diff(np.unique(values))
    steps = steps[steps > 1e-9 * np.ptp(values)]
    return float(np.percentile(steps, 5)) if len(steps) else 0.0


def drive_scales(
    system: System, recordings: Mapping[str, tuple[float, Mapping[str, np.ndarray]]], most: float
) -> Iterator[Finding]:
    """Yield recordings whose driving force needs another scale than that of the first one.

    A force along a joint whose position is an output is compared with what the motion asks for by a linear law
    (inertia, damping, stiffness, offset), learnt from the first recording. ``recordings`` maps a name to its rate [Hz]
    and columns (n,); ``most`` is the largest factor that a nonlinear system is believed to show.
    """
    if system.drive.by != "force":
        return
    outputs = {o.joint: o.column for o in system.outputs if o.quantity == "position"}
    for joint, column in system.drive.columns.items():
        if joint not in outputs:
            continue
        terms = {
            n: _motion(columns[outputs[joint]], rate, system.band_hz)
            for n, (rate, columns) in recordings.items()
        }
        force = {n: signals.bridged(columns[column][:, None])[:, 0] for n, (_, columns) in recordings.items()}
        first = next(iter(recordings))
        law = np.linalg.lstsq(terms[first], force[first], rcond=None)[0]
        for name in list(recordings)[1:]:
            asked = terms[name] @ law
            scale = float(asked @ force[name] / (asked @ asked)) if asked.any() else 1.0
            if not 1 / most <= scale <= most:
                times = 1 / scale if scale else float("inf")
                yield Finding(
                    "drive_scale",
                    "warning",
                    name,
                    column,
                    f"by the linear law of {first} the motion asks for {times:.3g} times the force of this column",
                    "Used as it is. Check unit and gain of both recordings: one drive scale has to hold in all.",
                )


def units_in_doubt(system: System, values: Mapping[str, float], name: str, near: float) -> Iterator[Finding]:
    """Yield a doubt about units where all that a force is made of stands at one end of what was thought possible.

    ``values`` are the parameters of the plain fit to the recording ``name``. Masses, stiffness and damping are a force
    over a motion: where each of two and more is within a share ``near`` of its range of the same bound, the force or
    the motion came in another unit.
    """
    scaled = [p for p in system.parameters if p.log and p.sets in ("mass", "stiffness", "damping")]
    span = [np.log(p.upper / p.lower) for p in scaled]
    above = np.array([np.log(values[p.name] / p.lower) / s for p, s in zip(scaled, span, strict=True)])
    for end, at_end in (("lower", above < near), ("upper", above > 1 - near)):
        if len(scaled) >= 2 and at_end.all():
            limits = ", ".join(f"{p.name} at {values[p.name]:.4g} {p.unit}" for p in scaled)
            yield Finding(
                "units_in_doubt",
                "warning",
                name,
                ", ".join(p.name for p in scaled),
                f"all that scales with the force stands at its {end} bound ({limits})",
                "Used as it is. Is a force in N, a motion in m or rad? A drive's voltage or current needs its gain.",
            )


def _motion(position: np.ndarray, rate_hz: float, band_hz: float) -> np.ndarray:
    """Return acceleration, rate, position and one (n, 4) of a position below the band."""
    smooth = signals.lowpass(signals.bridged(position[:, None]), rate_hz, min(band_hz, 0.4 * rate_hz), 4)[
        :, 0
    ]
    rate = np.gradient(smooth) * rate_hz
    return np.column_stack([np.gradient(rate) * rate_hz, rate, smooth, np.ones(len(smooth))])
