"""How well a policy walks by itself: accuracy, falls, pushes, floor force, saturation, warnings."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from real2sim.artefacts import finite_or_none
from real2sim.study.twin.env import WalkEnv
from real2sim.study.twin.gait import PHASES, SAGITTAL, Reference
from real2sim.study.twin.human import GAINS, JOINTS, Body, base_name
from real2sim.study.twin.policy import Policy

if TYPE_CHECKING:
    from real2sim.settings import TwinAcceptanceSettings, TwinEvaluationSettings, TwinSettings

PUSH_DIRECTIONS, PUSH_PHASES = 8, 16
Act = Callable[[np.ndarray], np.ndarray]
# Share of a servo's limit from which it counts as saturated
_SATURATED = 0.999


def plain(value: Any) -> Any:
    """Return the same nest of dicts and lists with None for every number that JSON cannot hold."""
    if isinstance(value, dict):
        return {key: plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [plain(item) for item in value]
    return finite_or_none(value) if isinstance(value, float) else value


def torque_limits(who: Body) -> np.ndarray:
    """Return the limit of each servo (21,) [Nm]."""
    return np.array([who.strength * GAINS[base_name(j)][1] for j in JOINTS])


def free_walk(env: WalkEnv, act: Act, *, seconds: float, settle_s: float) -> dict[str, Any]:
    """Walk every simulation of ``env`` from a noise-free start at phases spread over the cycle.

    The first ``settle_s`` are dropped. Angles are taken at every control step and sorted into `PHASES` bins of the
    clock; the floor's force and the servos' torque at every simulation step. A simulation that falls ends there.
    """
    n, steps, settle = env.nsim, round(seconds / env.control_s), round(settle_s / env.control_s)
    env.push_force = 0.0
    env.batch.warning[:] = 0
    env.reset(np.arange(n), 0.0, np.arange(n) / n)
    alive, out_at = np.ones(n, bool), np.full(n, np.inf)
    left_lane = np.zeros(n, bool)
    columns = [7 + JOINTS.index(f"{j}_{s}") for j in SAGITTAL for s in "rl"]
    sums, counts = np.zeros((PHASES, len(columns))), np.zeros(PHASES)
    limits = torque_limits(env.who) * _SATURATED
    saturated, samples = np.zeros(len(limits)), 0
    force = np.zeros((n, max(steps - settle, 1), env.substeps), np.float32)
    start_x = np.zeros(n)
    for k in range(steps):
        if k == settle:
            start_x = env._qpos[:, 0].copy()
        obs = env.observation()
        control = env.command(act(obs))
        record = env.batch.rollout(
            env.substeps,
            np.repeat(control[:, None], env.substeps, axis=1),
            record=("qfrc_constraint", "actuator_force"),
        )
        env.advance()
        gone = alive & env.fallen()
        left_lane |= alive & env.off_lane()
        out_at[gone] = k * env.control_s
        alive &= ~gone
        if k < settle:
            continue
        force[:, k - settle] = record["qfrc_constraint"][:, :, 2] / env.who.weight
        force[~alive, k - settle] = 0
        saturated += (np.abs(record["actuator_force"][alive]) >= limits).sum(axis=(0, 1))
        samples += int(alive.sum()) * env.substeps
        bins = np.round(env.phase[alive] * PHASES).astype(int) % PHASES
        np.add.at(sums, bins, env._qpos[alive][:, columns])
        np.add.at(counts, bins, 1)
    distance = float(np.sum((env._qpos[:, 0] - start_x)[alive]))
    time = float(alive.sum()) * (steps - settle) * env.control_s
    mean = sums / np.maximum(counts, 1)[:, None]
    return {
        "simulations": n,
        "seconds": seconds,
        "falls": int(np.isfinite(out_at).sum()),
        "lane_exits": int(left_lane.sum()),
        "speed_m_per_s": distance / time if time else None,
        "speed_error": distance / time / env.reference.speed - 1 if time else None,
        "joints": _accuracy(mean, counts, env.reference),
        "floor_force_peak_bw": _describe_peaks(_stride_peaks(force[alive], env)),
        "saturated_share": float((saturated / max(samples, 1)).max()),
        "saturated_joint": JOINTS[int(saturated.argmax())],
        "warnings": int(env.batch.warning.sum()),
    }


def _describe_peaks(peaks: np.ndarray) -> dict[str, float | None]:
    """Return mean, 95th percentile and largest of peak forces; None where there are none."""
    if not peaks.size:
        return dict.fromkeys(("mean_of_strides", "p95_of_strides", "largest"))
    return {
        "mean_of_strides": float(peaks.mean()),
        "p95_of_strides": float(np.percentile(peaks, 95)),
        "largest": float(peaks.max()),
    }


def _stride_peaks(force: np.ndarray, env: WalkEnv) -> np.ndarray:
    """Return the largest vertical floor force of each whole stride (walkers * strides,) [body weights]."""
    per_stride = max(round(env.reference.stride_s / env.control_s), 1)
    whole = force.shape[1] // per_stride
    if not whole or not len(force):
        return np.empty(0)
    return np.asarray(force[:, : whole * per_stride].reshape(len(force), whole, -1).max(axis=2).ravel())


def _accuracy(mean: np.ndarray, counts: np.ndarray, reference: Reference) -> dict[str, dict[str, float]]:
    """Return range of motion, peak, correlation and RMSE of each sagittal joint against the reference."""
    good = counts > 0
    out = {}
    half = PHASES // 2
    for i, joint in enumerate(SAGITTAL):
        right = np.degrees(mean[:, 2 * i])
        left = np.roll(np.degrees(mean[:, 2 * i + 1]), half)
        goal = np.degrees(reference.curve(f"{joint}_r"))
        if not good.all():
            out[joint] = dict.fromkeys(
                ("rom_deg", "rom_error_deg", "peak_error_deg", "r", "rmse_deg"), np.nan
            )
            continue
        curve = (right + left) / 2
        out[joint] = {
            "rom_deg": float(np.ptp(curve)),
            "rom_error_deg": float(np.ptp(curve) - np.ptp(goal)),
            "peak_error_deg": float(curve.max() - goal.max()),
            "r": float(np.corrcoef(curve, goal)[0, 1]),
            "rmse_deg": float(np.sqrt(np.mean((curve - goal) ** 2))),
        }
    return out


def accepted(walk: dict[str, Any], bars: TwinAcceptanceSettings) -> dict[str, bool]:
    """Return which bars a free walk meets; ``bars`` is the slice ``twin.acceptance`` of the configuration."""
    joints = walk["joints"]
    of_joint: Mapping[str, Any] = bars

    def within(key: str, bar: str) -> bool:
        return all(abs(joints[j][key]) <= of_joint[bar][j] for j in SAGITTAL)

    peak = walk["floor_force_peak_bw"]["mean_of_strides"]
    return {
        "falls": walk["falls"] == 0,
        "speed": walk["speed_error"] is not None and abs(walk["speed_error"]) <= bars["speed_error"],
        "rom": within("rom_error_deg", "rom_error_deg"),
        "peak": within("peak_error_deg", "peak_error_deg"),
        "r": all(joints[j]["r"] >= of_joint["r"][j] for j in SAGITTAL),
        "rmse": within("rmse_deg", "rmse_deg"),
        "floor_force": peak is not None and peak <= bars["floor_force_bw"],
        "saturation": walk["saturated_share"] <= bars["saturated_share"],
        "warnings": walk["warnings"] == 0,
    }


def walkers_at_speeds(settings: TwinEvaluationSettings) -> int:
    """Return how many people `speeds_of` looks at: ``walkers`` shared out between the speeds, at least one each."""
    return len(settings["shares"]) * max(settings["walkers"] // max(len(settings["shares"]), 1), 1)


def speeds_of(env: WalkEnv, act: Act, settings: TwinEvaluationSettings) -> list[dict[str, Any]]:
    """Walk at other speeds, ``shares`` of the slice ``twin.evaluation``; return how each is kept.

    ``env`` has `walkers_at_speeds` simulations. One entry per share: ``falls``, ``speed_m_per_s``, and
    ``speed_error``, relative to the speed that is meant; None where all fell.
    """
    shares, n = settings["shares"], env.nsim
    each = n // len(shares)
    steps, settle = (round(settings[name] / env.control_s) for name in ("walk_s", "settle_s"))
    env.push_force = 0.0
    env.walk_at(np.repeat(shares, each))
    env.reset(np.arange(n), 0.0, np.tile(np.arange(each) / each, len(shares)))
    alive, start_x = np.ones(n, bool), np.zeros(n)
    for k in range(steps):
        if k == settle:
            start_x = env._qpos[:, 0].copy()
        env.step(act(env.observation()))
        alive &= ~env.fallen()
    speed = (env._qpos[:, 0] - start_x) / ((steps - settle) * env.control_s)
    out = []
    for i, share in enumerate(shares):
        rows = slice(i * each, (i + 1) * each)
        up = speed[rows][alive[rows]]
        error = float(up.mean()) / (share * env.reference.speed) - 1 if len(up) else None
        out.append(
            {
                "share": share,
                "falls": each - len(up),
                "speed_m_per_s": float(up.mean()) if len(up) else None,
                "speed_error": error,
            }
        )
    return out


def keeps_speeds(speeds: list[dict[str, Any]], bars: TwinAcceptanceSettings) -> bool:
    """Return whether walks of `speeds_of` meet their bar: nobody falls, each speed as exact as the own one."""
    return all(
        row["falls"] == 0
        and row["speed_error"] is not None
        and abs(row["speed_error"]) <= bars["speed_error"]
        for row in speeds
    )


def pushed_walk(env: WalkEnv, act: Act, *, force_n: float, minutes: float, settle_s: float) -> dict[str, Any]:
    """Return the falls per minute under pushes of up to ``force_n`` [N] per horizontal axis, after settling.

    Whoever falls or leaves the lane starts again noise-free, with a settling time of its own that does not count.
    ``falls_per_minute`` is None where so many fall while settling that the minutes are not reached.
    """
    n, settle = env.nsim, round(settle_s / env.control_s)
    env.reset(np.arange(n), 0.0, np.arange(n) / n)
    falls = exits = early = 0
    counted = walked = 0.0
    # who never settles would never be counted: three times the minutes, settling included, are enough to say so
    while counted < minutes and walked < 3 * minutes:
        walked += n * env.control_s / 60
        env.push_force = force_n
        # nobody is pushed while settling
        env._push_next[env.age < settle] = np.maximum(env._push_next[env.age < settle], 2)
        _, gone = env.step(act(env.observation()))
        past = env.age > settle
        counted += float(past.sum()) * env.control_s / 60
        fell = env.fallen()
        falls += int((gone & fell & past).sum())
        early += int((gone & fell & ~past).sum())
        exits += int((gone & ~fell).sum())
        if gone.any():
            ids = np.flatnonzero(gone)
            env.reset(ids, 0.0)
    env.push_force = 0.0
    return {
        "force_n": force_n,
        "minutes": counted,
        "falls": falls,
        "falls_per_minute": falls / counted if counted >= minutes else None,
        "falls_while_settling": early,
        "lane_exits": exits,
    }


def withstands(pushed: dict[str, Any], bars: TwinAcceptanceSettings) -> bool:
    """Return whether a pushed walk meets its bar; never where its minutes were not reached."""
    rate = pushed["falls_per_minute"]
    return rate is not None and rate <= bars["falls_per_minute"]


def push_battery(
    env: WalkEnv, act: Act, *, force_n: float, lasts_s: float, settle_s: float, after_s: float
) -> dict[str, Any]:
    """Push once in each of 8 directions at each of 16 phases; return who still walks ``after_s`` later.

    ``env`` has 128 simulations. The push comes after ``settle_s`` of walking.
    """
    if env.nsim != PUSH_DIRECTIONS * PUSH_PHASES:
        raise ValueError(f"{env.nsim} simulations, {PUSH_DIRECTIONS * PUSH_PHASES} needed")
    ids = np.arange(env.nsim)
    angle = 2 * np.pi * (ids % PUSH_DIRECTIONS) / PUSH_DIRECTIONS
    env.push_force = 0.0
    strides = np.ceil(settle_s / env.reference.stride_s) * env.reference.stride_s
    env.reset(ids, 0.0, (ids // PUSH_DIRECTIONS) / PUSH_PHASES)
    begin = round(strides / env.control_s)
    lasts, after = round(lasts_s / env.control_s), round(after_s / env.control_s)
    alive, before = np.ones(env.nsim, bool), None
    for k in range(begin + lasts + after):
        if k == begin:
            before = alive.copy()
            env.impulse[:] = force_n * np.column_stack([np.cos(angle), np.sin(angle)])
        if k == begin + lasts:
            env.impulse[:] = 0.0
        env.step(act(env.observation()))
        alive &= ~env.fallen()
    standing = alive & (before if before is not None else True)
    return {
        "force_n": force_n,
        "lasts_s": lasts * env.control_s,
        "trials": env.nsim,
        "fell_before_the_push": int((~before).sum()) if before is not None else 0,
        "survived": int(standing.sum()),
        "survived_share": float(standing.mean()),
    }


def battery_of(env: WalkEnv, act: Act, settings: TwinEvaluationSettings) -> dict[str, Any]:
    """Run `push_battery` as the slice ``twin.evaluation`` asks for it."""
    return push_battery(
        env,
        act,
        force_n=settings["battery_n"],
        lasts_s=settings["battery_s"],
        settle_s=settings["settle_s"],
        after_s=settings["battery_after_s"],
    )


def environment(policy: Policy, settings: TwinSettings, *, nsim: int, threads: int, seed: int) -> WalkEnv:
    """Return the environment of a policy's own person and gait; ``settings`` is the slice ``twin``."""
    return WalkEnv(
        policy.body,
        settings["human"],
        policy.reference,
        settings["training"],
        nsim=nsim,
        threads=threads,
        seed=seed,
    )
