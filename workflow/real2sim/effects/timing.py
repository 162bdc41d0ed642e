"""Delays: late paths, late or drifting clocks, filters."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import scipy
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation

from real2sim.effects.base import AtRest, Effect, EffectParameter, hertz, seconds
from real2sim.effects.chains import Chains, Context, OutputChain

# Confusable effects
DELAYS = ("replay_lag", "sync_offset", "clock_drift", "filter_lag")


def earlier_pelvis(values: np.ndarray, context: Context) -> tuple[np.ndarray, np.ndarray]:
    """Return the path (n, 3, 3), (n, 3) of a segment that was measured late by a lag (1,) [s]."""
    # the measured segment is late: it was there already
    t = np.clip(context.time_s + values[0], context.time_s[0], context.time_s[-1])
    position = CubicSpline(context.time_s, context.pelvis_position)(t)
    vectors = Rotation.from_matrix(context.pelvis_rotation[0].T @ context.pelvis_rotation).as_rotvec()
    return (
        context.pelvis_rotation[0]
        @ Rotation.from_rotvec(CubicSpline(context.time_s, vectors)(t)).as_matrix(),
        position,
    )


def later_pelvis(values: np.ndarray, context: Context) -> tuple[np.ndarray, np.ndarray]:
    """Return the path (n, 3, 3), (n, 3) of a segment that was measured early by an offset (1,) [s]."""
    return earlier_pelvis(-values, context)


def _at_times(paths: np.ndarray, time_s: np.ndarray, wanted: np.ndarray) -> np.ndarray:
    # paths (m, n, ...) at other times: what lies outside stays at the end
    clipped = np.clip(wanted, time_s[0], time_s[-1])
    out = np.empty_like(paths)
    for i in range(len(paths)):
        out[i] = CubicSpline(time_s, paths[i])(clipped[i])
    return out


def late_markers(paths: np.ndarray, values: np.ndarray, context: Context) -> np.ndarray:
    """Return paths (m, n, ...) later by offsets (m, 1) [s]."""
    return _at_times(paths, context.time_s, context.time_s[None] - values[:, :1])


def drifting_clock(paths: np.ndarray, values: np.ndarray, context: Context) -> np.ndarray:
    """Return paths (m, n, ...) on a clock that drifts by (m, 1)."""
    t = context.time_s - context.time_s[0]
    return _at_times(paths, context.time_s, context.time_s[0] + t[None] * (1 + values[:, :1]))


def _butterworth(paths: np.ndarray, order: int, cutoff_hz: float, rate_hz: float) -> np.ndarray:
    """Return paths (n, ...) after a causal low-pass in equilibrium at the first sample."""
    sos = scipy.signal.butter(order, cutoff_hz, fs=rate_hz, output="sos")
    return np.asarray(paths[:1] + scipy.signal.sosfilt(sos, paths - paths[:1], axis=0))


def _trailing_mean(paths: np.ndarray, window_s: float, rate_hz: float) -> np.ndarray:
    """Return the mean of paths (n, ...) over the last ``window_s``, the first sample standing for what was before."""
    time_s = np.arange(len(paths)) / rate_hz
    moved = CubicSpline(time_s, paths - paths[:1]).antiderivative()
    swept = moved(time_s) - moved(np.maximum(time_s - window_s, 0.0))
    return np.asarray(paths[:1] + swept / window_s)


def _rate(context: Context) -> float:
    return float(1 / (context.time_s[1] - context.time_s[0]))


def filtered_markers(order: int) -> OutputChain:
    """Return the output chain of a causal Butterworth low-pass of an order, values (m, 1) are its cut-offs [Hz]."""

    def filtered(paths: np.ndarray, values: np.ndarray, context: Context) -> np.ndarray:
        rows = zip(paths, values[:, 0], strict=True)
        return np.array([_butterworth(path, order, cutoff, _rate(context)) for path, cutoff in rows])

    return filtered


def lag_of_filter(order: int) -> Callable[[np.ndarray], np.ndarray]:
    """Return the lag (m,) [s] of such a filter at low frequencies as a function of its cut-offs (m, 1) [Hz]."""
    poles = np.pi * (2 * np.arange(1, order + 1) - 1) / (2 * order)
    return lambda values: np.sin(poles).sum() / (2 * np.pi * values[:, 0])


def averaged_markers(paths: np.ndarray, values: np.ndarray, context: Context) -> np.ndarray:
    """Return paths (m, n, ...) as means over trailing windows (m, 1) [s]."""
    rows = zip(paths, values[:, 0], strict=True)
    return np.array([_trailing_mean(path, window, _rate(context)) for path, window in rows])


def late_log(lag_of: Callable[[np.ndarray], np.ndarray]) -> OutputChain:
    """Return the chain of a machine log that was aligned by motion to filtered markers: joints (m, n, j) as late.

    ``lag_of`` values (m, p) is their lag (m,) at low frequencies [s].
    """

    def late(joints: np.ndarray, values: np.ndarray, context: Context) -> np.ndarray:
        return _at_times(joints, context.time_s, context.time_s[None] - lag_of(values)[:, None])

    return late


def _first(values: np.ndarray) -> np.ndarray:
    return values[:, 0]


def _half(values: np.ndarray) -> np.ndarray:
    return values[:, 0] / 2


# Starts of a delay: one alone lies on the wrong side of a swing of the system where the delay is long beside it
_LATE = (0.01, 0.04)
_WINDOW = EffectParameter("window", "s", 0.02, 0.6, (0.08,), seconds, log=True)
_JERK = "one sharp jerk at the start and at the end, seen by all systems"
_HALF_OF_RATE = "a cut-off at half of the sampling rate"
_NO_FILTER = AtRest((49.9,), tolerance=2e-5, limit=_HALF_OF_RATE)
# at half of the sampling rate the lag of the log is still 3 ms
_NO_FILTER_OF_LOG = AtRest((49.9,), tolerance=3e-3, limit=_HALF_OF_RATE)
_NO_MEAN = AtRest((1e-5,), tolerance=1e-5, limit="a window of no length")

EFFECTS = (
    Effect(
        "replay_lag",
        "input",
        "the pelvis is late by tau",
        (EffectParameter("lag", "s", 0.0, 0.1, (0.01,), seconds),),
        separating_trial=_JERK,
        at_rest=AtRest((0.0,)),
        confusable=DELAYS,
        group="T",
        scope="whole",
        needs=frozenset({"pose"}),
        chains=Chains(input=earlier_pelvis, kinds=("late segment",)),
        remedy="Replay the pelvis earlier by the lag: what it shows at t happened at t - lag",
    ),
    Effect(
        "sync_offset",
        "output",
        "y(t - tau)",
        (EffectParameter("offset", "s", -0.25, 0.25, _LATE, seconds),),
        separating_trial=_JERK,
        at_rest=AtRest((0.0,)),
        confusable=DELAYS,
        group="T",
        scope="whole",
        chains=Chains(output=late_markers, kinds=("late markers",)),
        remedy="Shift the interface markers earlier by the offset before they are compared with the simulation",
    ),
    Effect(
        "sync_offset",
        "output",
        "y(t - tau), tau another one in each trial: recordings that were started by hand",
        (
            EffectParameter("offset", "s", -0.25, 0.25, (0.01,), seconds, trial="fitted"),
            EffectParameter("offset_held_out", "s", -0.25, 0.25, (0.01,), seconds, trial="held out"),
        ),
        separating_trial=_JERK,
        at_rest=AtRest((0.0, 0.0)),
        confusable=DELAYS,
        group="T",
        scope="whole",
        chains=Chains(output=late_markers, kinds=("late markers",)),
        form="each_trial",
        remedy="Shift the interface markers of each trial earlier by its own offset before they are compared",
    ),
    Effect(
        "sync_offset",
        "output",
        "y(t - tau), and the robot's log as late: the pelvis alone is early",
        (EffectParameter("offset", "s", 0.0, 0.15, (0.01,), seconds),),
        separating_trial=_JERK,
        at_rest=AtRest((0.0,)),
        confusable=DELAYS,
        group="T",
        scope="whole",
        needs=frozenset({"pose"}),
        chains=Chains(input=later_pelvis, kinds=("late segment",)),
        form="with_log",
        remedy="Replay the pelvis later by the offset, or shift interface markers and robot log earlier by it",
    ),
    Effect(
        "log_latency",
        "output",
        "the robot's log alone is late by tau",
        (EffectParameter("latency", "s", -0.1, 0.25, (0.02,), seconds),),
        separating_trial="a stop of the robot that markers on it and its log both show",
        at_rest=AtRest((0.0,)),
        scope="whole",
        needs=frozenset({"base"}),
        chains=Chains(log=late_log(_first)),
        remedy="Shift the robot's log earlier by the latency before it is compared with the simulation",
    ),
    Effect(
        "clock_drift",
        "output",
        "y((1 + eps) t)",
        (EffectParameter("drift", "1", -2.0, 2.0, (0.1,), lambda s, i: 0.01),),
        separating_trial=_JERK,
        at_rest=AtRest((0.0,)),
        confusable=DELAYS,
        scope="whole",
        chains=Chains(output=drifting_clock),
        remedy="Read the simulation at (1 + drift) t, t from the start, where the interface markers say t",
    ),
    *(
        Effect(
            "filter_lag",
            "output",
            f"y low-passed by a causal filter of {name} order",
            (EffectParameter("cutoff", "Hz", 0.5, 25.0, (6.0,), hertz, log=True),),
            separating_trial="fast content near the filter's cut-off",
            at_rest=_NO_FILTER,
            confusable=DELAYS,
            group="T",
            scope="whole",
            chains=Chains(output=filtered_markers(order), kinds=("late markers",)),
            form=form,
            remedy=(
                f"Pass the simulated interface markers through a causal Butterworth low-pass of {name} order"
                " with this cut-off, or export the markers without the filter"
            ),
        )
        for order, name, form in (
            (1, "first", "first_order"),
            (2, "second", ""),
            (4, "fourth", "fourth_order"),
        )
    ),
    Effect(
        "filter_lag",
        "output",
        "y as the mean of its last samples",
        (_WINDOW,),
        separating_trial="fast content near the filter's cut-off",
        at_rest=_NO_MEAN,
        confusable=DELAYS,
        group="T",
        scope="whole",
        chains=Chains(output=averaged_markers, kinds=("late markers",)),
        form="mean",
        remedy="Take the mean of the simulated interface markers over this window, or export the markers without it",
    ),
    *(
        Effect(
            "filter_lag",
            "output",
            f"y {name}, and the robot's log as late, for it was laid on such markers",
            (parameter,),
            separating_trial="fast content near the filter's cut-off",
            at_rest=rest,
            confusable=DELAYS,
            group="T",
            scope="whole",
            chains=Chains(output=chain, log=late_log(lag), kinds=("late markers",)),
            form=f"{form}with_log",
            remedy="Export the interface markers without the filter, and lay the robot's log on them anew",
        )
        for name, form, parameter, rest, chain, lag in (
            ("as the mean of its last samples", "mean_", _WINDOW, _NO_MEAN, averaged_markers, _half),
            *(
                (
                    f"low-passed by a causal filter of {name} order",
                    form,
                    EffectParameter("cutoff", "Hz", 0.5, 10.0, (6.0,), hertz, log=True),
                    _NO_FILTER_OF_LOG,
                    filtered_markers(order),
                    lag_of_filter(order),
                )
                for order, name, form in ((1, "first", "first_order_"), (2, "second", ""))
            ),
        )
    ),
)
