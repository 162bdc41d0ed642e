"""The paper's tables and figures by their numbers: ours beside the published ones."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from real2sim.artefacts import number, read_table, write_table
from real2sim.files import replacing, write_text
from real2sim.study.paper.latex import latex_table
from real2sim.study.statistics.shareability import is_published
from real2sim.study.twin.adaptation import JOINT_NAMES

Row = dict[str, str]

SIGMAS = ("sigma_x_mm", "sigma_y_mm", "sigma_z_mm", "gamma")
# Walkers that stayed up, and all walkers, summed over the seeds
_WALKERS = ("survived", "walkers")
INTERFACE_COLUMNS = (
    "condition",
    "seeds",
    *_WALKERS,
    *(part for key in SIGMAS for part in (key, f"{key}_seed_sd", f"published_{key}")),
    "published_place",
    "phantom",
)
ANGLES = ("rom_deg", "rom_sd_deg", "peak_deg")
GAIT_COLUMNS = (
    "joint",
    "condition",
    "seeds",
    *_WALKERS,
    *(part for key in ANGLES for part in (key, f"{key}_seed_sd", f"published_{key}")),
    "rom_change_deg",
    "rom_change_deg_seed_sd",
    "r_walk_robot",
    "published_place",
    "phantom",
)
CONDITIONS = {
    "walk_normal": "no robot, measured",
    "walk_robot": "with robot, measured",
    "free": "no robot, simulated",
    "soft": "soft, simulated",
    "prior": "prior, simulated",
    "own": "own parameters, simulated",
    "stiff": "stiff, simulated",
}
MEASURED = ("walk_normal", "walk_robot")
_DASH = "\N{EN DASH}"
# Caption of the columns seeds and survived
ABOUT_COUNTS = (
    "Seeds: those in which a walker stayed up. Survived: walkers that stayed up, of all walkers of all seeds; the "
    "values are theirs."
)


def _over_seeds(rows: Sequence[Row], key: str) -> tuple[float, float]:
    """Mean and SD over the seeds, NaN where there are none.

    What was measured stands beside every seed and has no spread over them.
    """
    values = np.array([number(row[key]) for row in rows])
    values = values[np.isfinite(values)]
    if not len(values):
        return math.nan, math.nan
    simulated = len(values) > 1 and rows[0]["condition"] not in MEASURED
    return float(values.mean()), float(values.std(ddof=1)) if simulated else math.nan


def _averages(rows: Sequence[Row], keys: Sequence[str], published: Row | None) -> dict[str, Any]:
    """Return mean and SD over the seeds of each key, the published values, and how many seeds and walkers these are of.

    ``seeds`` counts the seeds that have a value; seeds in which all walkers fell count in ``survived`` and ``walkers``.
    """
    measured = bool(rows) and rows[0]["condition"] in MEASURED
    valued = {row["seed"] for row in rows if any(math.isfinite(number(row[key])) for key in keys)}
    out: dict[str, Any] = {"seeds": None if measured else len(valued)}
    for name in _WALKERS:
        out[name] = sum(int(row[name]) for row in rows) if rows and all(row[name] for row in rows) else None
    for key in keys:
        out[key], out[f"{key}_seed_sd"] = _over_seeds(rows, key)
        out[f"published_{key}"] = number(published[key]) if published else math.nan
    out["published_place"] = published["place"] if published else None
    return out


def _compared(rows: Iterable[Row], subject: str) -> list[Row]:
    """Return a person's rows of the robot and cap that are compared with the measurement, and those without a robot."""
    return [r for r in rows if r["subject"] == subject and r["main"] == "true"]


def interface_rows(rows: Sequence[Row], published: Sequence[Row], phantom: bool) -> list[dict[str, Any]]:
    """Table II: spread of the interface by condition, mean over seeds."""
    theirs = {row["condition"]: row for row in published}
    plain = [row for row in rows if not row["robot_factor"]]
    out = []
    for name in CONDITIONS:
        mine = [row for row in plain if row["condition"] == name]
        if mine or name in theirs:
            averages = _averages(mine, SIGMAS, theirs.get(name))
            out.append({"condition": name, "phantom": phantom} | averages)
    return out


def gait_rows(rows: Sequence[Row], published: Sequence[Row], phantom: bool) -> list[dict[str, Any]]:
    """Table III: range of motion and peak by joint and condition, mean over seeds."""
    theirs = {(row["joint"], row["condition"]): row for row in published}
    out = []
    for joint in JOINT_NAMES:
        for name in CONDITIONS:
            mine = [row for row in rows if (row["joint"], row["condition"]) == (joint, name)]
            if mine or (joint, name) in theirs:
                row = {"joint": joint, "condition": name, "phantom": phantom}
                row |= _averages(mine, ANGLES, theirs.get((joint, name)))
                row["rom_change_deg"], row["rom_change_deg_seed_sd"] = _over_seeds(mine, "rom_change_deg")
                row["r_walk_robot"], _ = _over_seeds(mine, "r_walk_robot")
                out.append(row)
    return out


def _text(value: Any, decimals: int = 1) -> str:
    """A number for print; a dash where there is none."""
    value = number(value) if isinstance(value, str) else value
    return f"{value:.{decimals}f}" if value is not None and math.isfinite(value) else _DASH


def short(value: str | float) -> str:
    """Return a number with three digits and without an exponent; a dash for none."""
    parsed = number(value) if isinstance(value, str) else value
    if not math.isfinite(parsed):
        return _DASH
    text = f"{parsed:.3g}"
    return f"{float(text):.0f}" if "e+" in text else text


def _counts(row: dict[str, Any]) -> list[str]:
    """Cells of the seeds with a value and of the walkers that stayed up; a dash where nothing was simulated."""
    known = row["walkers"] is not None
    return [
        _DASH if row["seeds"] is None else str(row["seeds"]),
        f"{row['survived']}/{row['walkers']}" if known else _DASH,
    ]


def _with_sd(row: dict[str, Any], key: str) -> str:
    spread = row[f"{key}_seed_sd"]
    return _text(row[key]) + (f" ± {_text(spread)}" if math.isfinite(spread) else "")


def paper_tables(
    *,
    priors: Path,
    cross_trial: Path,
    published: list[Path],
    out: list[Path],
    subject: str = "",
    gait: Path | None = None,
    interface: Path | None = None,
) -> None:
    """Tables I, II and III and the cross-trial costs, as CSV and LaTeX.

    Parameters
    ----------
    priors, cross_trial
        Of `figures.tables`: our numbers beside the published ones.
    published
        table2_interface.csv and table3_gait.csv of resources/published.
    subject, gait, interface
        The person whose twin stands in Tables II and III, and the tables of `twin.stage`; without them the tables hold
        what the paper prints and nothing of ours.
    out
        table1_priors, table2_interface, table3_gait and cross_trial, each .csv and .tex.
    """
    files = {path.name: path for path in out}
    theirs = {path.stem: read_table(path, ("condition", "place")) for path in published}
    prior_rows = read_table(priors, ("parameter", "source", "status", "phantom"))
    phantom = any(row["phantom"] == "true" for row in prior_rows)
    walked = _compared(read_table(gait), subject) if gait else []
    clouds = _compared(read_table(interface), subject) if interface else []
    walks = phantom or any(row["phantom"] == "true" for row in (*walked, *clouds))
    table2 = interface_rows(clouds, theirs["table2_interface"], walks)
    table3 = gait_rows(walked, theirs["table3_gait"], walks)
    costs = read_table(cross_trial, ("subject", "status"))

    write_table(files["table1_priors.csv"], list(prior_rows[0]), prior_rows)
    write_table(files["table2_interface.csv"], INTERFACE_COLUMNS, table2)
    write_table(files["table3_gait.csv"], GAIT_COLUMNS, table3)
    write_table(files["cross_trial.csv"], list(costs[0]), costs)
    for name, text in {
        "table1_priors.tex": _priors_tex(prior_rows, phantom),
        "table2_interface.tex": _interface_tex(table2, subject, walks),
        "table3_gait.tex": _gait_tex(table3, subject, walks),
        "cross_trial.tex": _cross_trial_tex(costs, phantom),
    }.items():
        write_text(files[name], text)


def missing_priors(statuses: Iterable[str]) -> str:
    """Return the sentence of a caption on the dashes in place of priors of the fits; ``statuses`` are the reasons."""
    return f"Dash: no prior of the fits ({'; '.join(dict.fromkeys(statuses))})."


def percent_of_fits(rows: Iterable[Mapping[str, Any]]) -> str:
    """Return which share of the fits the intervals of a table of priors hold, as ``95 %``; the paper's if none says."""
    said = next((row["confidence"] for row in rows if row.get("confidence")), "")
    return f"{100 * number(said):g} %" if said else "95 %"


def _prior_cells(row: Row, who: str) -> list[str]:
    """Prior, interval and class, of the fits or, with ``who`` = published_, of the paper."""
    ends = (short(row[f"{who}interval_{end}"]) for end in ("low", "high"))
    return [short(row[f"{who}prior"]), f"[{', '.join(ends)}]", row[f"{who}class"]]


def _priors_tex(rows: Sequence[Row], phantom: bool) -> str:
    printed, missing = [], []
    for row in rows:
        ours = _prior_cells(row, "")
        if is_published(row["source"]):
            ours = [_DASH] * len(ours)
            missing.append(row["status"])
        printed.append([row["parameter"], row["unit"], *ours, *_prior_cells(row, "published_")])
    share = percent_of_fits(rows)
    caption = f"Priors: geometric mean and central {share} of the fits, beside the published ones (Table I)."
    return latex_table(
        ["Parameter", "Unit", "Prior", "Interval", "Class", "Published", "Interval", "Class"],
        printed,
        caption=f"{caption} {missing_priors(missing)}" if missing else caption,
        label="tab:priors",
        columns="llrllrll",
        phantom=phantom,
    )


def _interface_tex(rows: Sequence[dict[str, Any]], subject: str, phantom: bool) -> str:
    head = ["Condition", "Seeds", "Survived"]
    for name in ("x", "y", "z"):
        head += [f"σ {name} (mm)", "published"]
    printed = [
        [CONDITIONS[row["condition"]], *_counts(row)]
        + [text for key in SIGMAS[:3] for text in (_with_sd(row, key), _text(row[f"published_{key}"], 2))]
        + [_text(row["gamma"], 2), _text(row["published_gamma"], 3)]
        for row in rows
    ]
    return latex_table(
        [*head, "γ", "published"],
        printed,
        caption=f"Spread of the interface about the pelvis{_of(subject)}, mean and SD over seeds, beside the published "
        f"one (Table II). {ABOUT_COUNTS}",
        label="tab:interface",
        phantom=phantom,
    )


def _gait_tex(rows: Sequence[dict[str, Any]], subject: str, phantom: bool) -> str:
    printed = [
        [
            JOINT_NAMES[row["joint"]],
            CONDITIONS[row["condition"]],
            *_counts(row),
            _with_sd(row, "rom_deg"),
            _text(row["published_rom_deg"]),
            _with_sd(row, "peak_deg"),
            _text(row["published_peak_deg"]),
        ]
        for row in rows
    ]
    return latex_table(
        ["Joint", "Condition", "Seeds", "Survived", "RoM (deg)", "published", "Peak (deg)", "published"],
        printed,
        caption=f"Range of motion and peak angle{_of(subject)}, mean and SD over seeds, beside the published ones "
        f"(Table III). {ABOUT_COUNTS}",
        label="tab:gait",
        columns="llrrrrrr",
        phantom=phantom,
    )


def _of(subject: str) -> str:
    return f" of {subject}" if subject else ""


def _cross_trial_tex(rows: Sequence[Row], phantom: bool) -> str:
    keys = ("J_within_mean_1", "J_cross_mean_1", "J_floor_1", "overhead_percent")
    return latex_table(
        ["Person", "J within", "J cross", "J of noise", "Overhead (%)"],
        [[row["subject"], *(short(row[key]) for key in keys)] for row in rows],
        caption="Cost of the best fit on its own trial and on the other one (section V-B).",
        label="tab:cross-trial",
        phantom=phantom,
    )


def paper_figures(*, figures: list[Path], out: list[Path]) -> None:
    """Copy figures to their numbers in the paper, in the order given."""
    for source, target in zip(figures, out, strict=True):
        with replacing(target) as temporary:
            temporary.write_bytes(source.read_bytes())
