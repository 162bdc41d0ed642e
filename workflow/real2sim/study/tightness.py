"""Tightness sweep: allowable motion at each strap level, breakpoint, operating point (section III-A).

Signs follow the interface coordinates q (`geometry.interface_coordinates`): ``front`` and ``left`` are the positive
sides of t_x, t_y and r_z, ``back`` and ``right`` the negative ones, all counted from rest (q = 0).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from real2sim.artefacts import (
    finite_or_none,
    is_phantom,
    needs_people,
    number,
    read_json,
    read_table,
    write_json,
    write_table,
)
from real2sim.configuration import read_yaml
from real2sim.errors import InputError
from real2sim.recording.pose_table import read_pose
from real2sim.recording.subjects import parse_trial
from real2sim.study.statistics.piecewise import (
    PiecewiseFit,
    breakpoint_interval,
    breakpoint_interval_by_group,
    breakpoint_p_value,
    fit_piecewise,
)

if TYPE_CHECKING:
    from real2sim.settings import TightnessSettings

SIDES = {
    "dphi": ("dphi_left_deg", "dphi_right_deg"),
    "dx": ("dx_front_mm", "dx_back_mm"),
    "dy": ("dy_left_mm", "dy_right_mm"),
}
UNITS = {"dphi": "deg", "dx": "mm", "dy": "mm"}
_WORDS = {"dphi": "rotation", "dx": "forward and back", "dy": "left and right"}
SWEEP_COLUMNS = (
    "subject",
    "level_cm",
    "normalised_tightness",
    "dphi_left_deg",
    "dphi_right_deg",
    "dphi_deg",
    "dx_front_mm",
    "dx_back_mm",
    "dx_mm",
    "dy_left_mm",
    "dy_right_mm",
    "dy_mm",
    "n_samples_rotation",
    "masked_share_rotation",
    "n_samples_translation",
    "masked_share_translation",
    "phantom",
)
# Distinct levels of a person from which on a bend can be told from a straight line
_BEND = 3
METHOD = (
    "Two-segment regression on the sides pooled. Both sides are measured at every level, so slopes and "
    "breakpoint are those of the mean of the two sides; the test takes a level, not a side, as one "
    "observation."
)


def normalised_tightness(
    level_cm: np.ndarray, *, selected: float, tightest: float, loosest: float
) -> np.ndarray:
    """Return the normalised tightness (paper eq. 2): 0 at the selected level, positive where the strap is tighter.

    For levels [cm] of any shape. Holds for either sense of the scale: with remaining strap length, ``tightest`` is the
    smaller number.
    """
    return (np.asarray(level_cm, float) - selected) / ((tightest - loosest) / 2)


def _extremes(values: np.ndarray, scale: float) -> tuple[float, float]:
    return scale * float(np.nanmax(values)), -scale * float(np.nanmin(values))


def _coverage(values: np.ndarray, kind: str) -> dict[str, Any]:
    masked = float(np.mean(~np.isfinite(values)))
    return {f"n_samples_{kind}": len(values), f"masked_share_{kind}": masked}


def _rotation_row(q: dict[str, np.ndarray]) -> dict[str, Any]:
    left, right = _extremes(q["q_rz"], np.degrees(1.0))
    return {"dphi_left_deg": left, "dphi_right_deg": right, "dphi_deg": left + right} | _coverage(
        q["q_rz"], "rotation"
    )


def _translation_row(q: dict[str, np.ndarray]) -> dict[str, Any]:
    front, back = _extremes(q["q_tx"], 1000.0)
    left, right = _extremes(q["q_ty"], 1000.0)
    ranges = {"dx_front_mm": front, "dx_back_mm": back, "dx_mm": front + back}
    ranges |= {"dy_left_mm": left, "dy_right_mm": right, "dy_mm": left + right}
    return ranges | _coverage(q["q_tx"], "translation")


def _levels(subject_yaml: Path) -> dict[str, float]:
    """Tightest, loosest and selected level [cm] of a subject file."""
    content = read_yaml(subject_yaml) or {}
    try:
        levels = content["tightness"]
        return {
            "selected": float(levels["safe_comfortable_cm"]),
            "tightest": float(levels["tightest_cm"]),
            "loosest": float(levels["loosest_cm"]),
        }
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(
            subject_yaml,
            "tightness",
            str(content.get("tightness")),
            "loosest_cm, tightest_cm and safe_comfortable_cm",
            "Add the three levels in centimetres.",
        ) from error


def tightness_sweep(*, subject: str, poses: list[Path], subject_yaml: Path, out: Path) -> None:
    """Write the allowable motion of the pelvis in the strap, one row per strap level, loosest first.

    ``poses`` are the pose tables of the rotation and translation trials, in a folder named by the trial.
    Motion is the largest excursion about rest on each side [deg, mm] and their sum; rotation about z comes
    from the rotation trial, translation from the translation trial. A level with one trial missing leaves the
    other's cells empty.
    """
    measure = {"rotation": _rotation_row, "translation": _translation_row}
    scale = _levels(subject_yaml)
    rows: dict[int, dict[str, Any]] = {}
    for path in poses:
        kind, level = parse_trial(path.parent.name)
        if kind not in measure or level is None:
            raise InputError(
                path,
                "folder",
                kind,
                "a rotation_T or translation_T trial",
                "Give the tightness sweep its own trials.",
            )
        q, metadata = read_pose(path)
        row = rows.setdefault(level, {"subject": subject, "level_cm": level, "phantom": False})
        row["normalised_tightness"] = float(normalised_tightness(np.array(level), **scale))
        row["phantom"] |= bool(metadata.get("phantom", False))
        row |= measure[kind](q)
    write_table(out, SWEEP_COLUMNS, sorted(rows.values(), key=lambda r: r["normalised_tightness"]))


def side_means(rows: Sequence[Mapping[str, str]], quantity: str) -> tuple[np.ndarray, np.ndarray]:
    """Return normalised tightness (n,) and the mean of both sides (n,) [deg or mm] at the levels that have them."""
    x = np.array([number(r["normalised_tightness"]) for r in rows])
    y = np.array([[number(r[c]) for c in SIDES[quantity]] for r in rows]).reshape(-1, 2).mean(axis=1)
    measured = np.isfinite(y)
    return x[measured], y[measured]


def _regression(
    fit: PiecewiseFit, p_value: float, interval: tuple[float, float], settings: TightnessSettings
) -> dict[str, Any]:
    return {
        "status": "ok",
        "k1": fit.slope_1,
        "k2": fit.slope_2,
        "breakpoint": fit.breakpoint,
        "breakpoint_interval": list(interval),
        "value_at_breakpoint": fit.value_at_breakpoint,
        "sse": fit.sse,
        "sse_straight_line": fit.sse_line,
        "sup_f": finite_or_none(fit.f),
        "p_value": p_value,
        "exists": p_value < settings["alpha"],
    }


def _person_regression(
    rows: list[dict[str, str]], quantity: str, settings: TightnessSettings
) -> dict[str, Any]:
    x, y = side_means(rows, quantity)
    head = {"unit": UNITS[quantity], "n_levels": len(x)}
    if len(x) < settings["min_levels"]:
        return head | {"status": f"needs at least {settings['min_levels']} levels, have {len(x)}"}
    p_value = breakpoint_p_value(x, y, permutations=settings["permutations"], seed=settings["seed"])
    interval = breakpoint_interval(
        x, y, bootstrap=settings["bootstrap"], seed=settings["seed"], confidence=1 - settings["alpha"]
    )
    return head | _regression(fit_piecewise(x, y), p_value, interval, settings)


def _operating_point(
    dphi: dict[str, Any], scale: dict[str, float], rows: Sequence[Mapping[str, str]]
) -> dict[str, Any]:
    """Compare the selected level with the knee of the rotation range; levels are one step apart at best."""
    point: dict[str, Any] = {"selected_cm": scale["selected"], "agree": None}
    if dphi["status"] != "ok":
        return point | {"status": dphi["status"]}
    if not dphi["exists"]:
        return point | {"status": "no breakpoint in dphi to compare with"}
    half_range = (scale["tightest"] - scale["loosest"]) / 2
    offset = dphi["breakpoint"] * half_range
    step = float(np.min(np.diff(np.unique([number(r["level_cm"]) for r in rows]))))
    low, high = dphi["breakpoint_interval"]
    return point | {
        "status": "ok",
        "knee_cm": scale["selected"] + offset,
        "knee_normalised": dphi["breakpoint"],
        "difference_cm": offset,
        "level_step_cm": step,
        "selected_inside_interval": bool(low <= 0 <= high),
        "agree": bool(abs(offset) <= step),
    }


def doubt_direction(rows: Sequence[Mapping[str, str]]) -> str:
    """Return a warning where the allowed motion rises toward the tight end of a sweep, else "".

    A strap that is tighter allows less motion. The straight line of each quantity over normalised tightness has to rise
    in most of them, and the mean of their changes, each relative to its quantity's mean, too: a quantity that hardly
    depends on the strap rises or falls by noise.
    """
    changes = {}
    for quantity in SIDES:
        x, y = side_means(rows, quantity)
        if len(np.unique(x)) > 1 and y.mean() > 0:
            changes[quantity] = float(np.polyfit(x, y, 1)[0] * np.ptp(x) / y.mean())
    rising = [f"{_WORDS[name]} by {100 * change:.0f} %" for name, change in changes.items() if change > 0]
    if 2 * len(rising) <= len(changes) or sum(changes.values()) <= 0:
        return ""
    return (
        f"the motion that the strap allows rises toward tightest_cm ({', '.join(rising)}): loosest_cm and tightest_cm "
        "of subject.yaml are exchanged, or the trials have the levels of others"
    )


def tightness_breakpoints(
    *, subject: str, sweep: Path, subject_yaml: Path, settings: TightnessSettings, out: Path
) -> None:
    """Write the breakpoint regressions of one person and whether the knee of the rotation meets the selected level.

    Slopes are deg or mm of one side per unit of normalised tightness. ``settings`` is the config slice
    ``tightness``; the interval's confidence is 1 - alpha. Knee and selected level agree when they are at most
    one measured step apart. ``warning`` is that of `doubt_direction`, which is printed too.
    """
    rows = read_table(sweep, SWEEP_COLUMNS)
    scale = _levels(subject_yaml)
    warning = doubt_direction(rows)
    if warning:
        print(f"{rows[0]['subject']}: {warning}", flush=True)
    regressions = {quantity: _person_regression(rows, quantity, settings) for quantity in SIDES}
    write_json(
        out,
        {
            # a sweep without rows, of a person who was not swept, says neither
            "subject": subject,
            "phantom": is_phantom([*rows, read_yaml(subject_yaml)]),
            "method": METHOD,
            "regressions": regressions,
            "operating_point": _operating_point(regressions["dphi"], scale, rows),
            "warning": warning,
            "settings": settings,
        },
    )


def _pooled(
    tables: dict[str, list[dict[str, str]]], quantity: str, settings: TightnessSettings
) -> dict[str, Any]:
    """Return the regression over all persons: shared change of slope and breakpoint, a line for each person.

    Who was measured in a quantity at fewer than three levels cannot show a bend and is none of its people.
    """
    means = {s: side_means(rows, quantity) for s, rows in tables.items()}
    parts = {s: points for s, points in means.items() if len(np.unique(points[0])) >= _BEND}
    x, y = (np.concatenate([[], *(points[i] for points in parts.values())]) for i in (0, 1))
    groups = np.repeat(list(parts), [len(p[0]) for p in parts.values()])
    head = {"unit": UNITS[quantity], "n_points": len(x), "n_subjects": len(parts)}
    if len(np.unique(x)) < settings["min_levels"]:
        return head | {"status": f"needs at least {settings['min_levels']} levels, have {len(np.unique(x))}"}
    seed, confidence = settings["seed"], 1 - settings["alpha"]
    p_value = breakpoint_p_value(x, y, groups, permutations=settings["permutations"], seed=seed)
    interval_of = breakpoint_interval_by_group if len(parts) > 1 else breakpoint_interval
    interval = interval_of(x, y, groups, bootstrap=settings["bootstrap"], seed=seed, confidence=confidence)
    if not np.isfinite(interval).all():
        return head | {"status": "nobody was measured on both sides of a possible breakpoint"}
    return head | _regression(fit_piecewise(x, y, groups), p_value, interval, settings)


def _shared(persons: list[dict[str, Any]], quantity: str) -> dict[str, Any]:
    """Return in how many persons the breakpoint exists, where, and with which change of slope.

    ``n_subjects`` are those with levels enough for a regression of their own.
    """
    every = [(p["subject"], p["regressions"][quantity]) for p in persons]
    fits = [(s, r) for s, r in every if r["status"] == "ok"]
    found = [(s, r) for s, r in fits if r.get("exists")]
    places = [r["breakpoint"] for _, r in found]
    return {
        "n_subjects": len(fits),
        "n_with_breakpoint": len(found),
        "subjects_with_breakpoint": [s for s, _ in found],
        "breakpoints": places,
        "breakpoint_range": float(np.ptp(places)) if places else None,
        "same_sign_of_slope_change": len({r["k2"] > r["k1"] for _, r in found}) <= 1 if found else None,
        "steeper_below": sum(abs(r["k1"]) > abs(r["k2"]) for _, r in found),
    }


def tightness_cohort(
    *, sweeps: list[Path], breakpoints: list[Path], settings: TightnessSettings, out: Path
) -> None:
    """Write what all persons show together: pooled regressions, shared breakpoints, selected levels against the knee.

    The pooled interval resamples whole persons; with one person it resamples residuals and ``status`` says
    so.
    """
    tables = {}
    for path in sweeps:
        rows = read_table(path, SWEEP_COLUMNS)
        if rows:
            tables[rows[0]["subject"]] = rows
    tables = dict(sorted(tables.items()))
    persons = sorted(
        (read_json(p, ("subject", "regressions")) for p in breakpoints), key=lambda p: p["subject"]
    )
    points = {p["subject"]: p["operating_point"] for p in persons}
    write_json(
        out,
        {
            "status": "ok" if len(tables) > 1 else needs_people(2, len(tables)),
            "phantom": any(p["phantom"] for p in persons),
            "method": METHOD
            + " Pooled over persons: a straight line each, shared change of slope and breakpoint.",
            "subjects": list(tables),
            "pooled": {q: _pooled(tables, q, settings) for q in SIDES} if tables else {},
            "persons": {q: _shared(persons, q) for q in SIDES},
            "operating_points": points,
            "n_agree": sum(bool(p["agree"]) for p in points.values()),
            "settings": settings,
        },
    )
