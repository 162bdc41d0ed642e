"""Validation on an unseen person: Tables II and III, and bars of the simulated walkers."""

from __future__ import annotations

import statistics
from collections.abc import Sequence
from html import escape

from real2sim.artefacts import number
from real2sim.pages.page import paragraph, rounded, section, table
from real2sim.pages.report.parts import DASH, downloads, figure, rows_of, value_cell, words
from real2sim.pages.report.study import Row, Study
from real2sim.study.paper.tables import ABOUT_COUNTS


def validation_section(study: Study) -> str:
    """Tables II and III, and whether the twins are worth comparing."""
    walking = study.walking
    return section(
        "validation",
        "Validation on an unseen person",
        _cloud(study),
        _bars(study),
        f'<div class="grid">{figure(study, "interface")}{figure(study, "gait")}</div>',
        f'<div class="grid">{figure(study, "speed")}{figure(study, "wrench")}</div>',
        _interface_table(study),
        _gait_table(study),
        downloads(
            walking.interface,
            walking.gait,
            *(found for found in (walking.bars, walking.clouds) if found and found.rows),
        ),
    )


def _with_sd(row: Row, key: str) -> str:
    spread = row[f"{key}_seed_sd"]
    return value_cell(row[key]) + (f" <span class='small'>± {value_cell(spread, 2)}</span>" if spread else "")


def _counts_of(row: Row) -> list[str]:
    """Cells of the seeds with a value and of the walkers that stayed up; a dash where nothing was simulated."""
    return [row["seeds"] or DASH, f"{row['survived']} of {row['walkers']}" if row["walkers"] else DASH]


def _interface_table(study: Study) -> str:
    rows = [
        [
            escape(words(row["condition"])),
            *_counts_of(row),
            *(_with_sd(row, f"sigma_{axis}_mm") for axis in "xyz"),
            _with_sd(row, "gamma"),
            *(value_cell(row[f"published_sigma_{axis}_mm"]) for axis in "xyz"),
            value_cell(row["published_gamma"]),
        ]
        for row in study.walking.interface.rows
    ]
    spreads = [f"\N{GREEK SMALL LETTER SIGMA} {axis} [mm]" for axis in "xyz"]
    gamma = "\N{GREEK SMALL LETTER GAMMA}"
    head = [
        "Condition",
        "Seeds",
        "Survived",
        *spreads,
        gamma,
        *(f"Published {name}" for name in (*spreads, gamma)),
    ]
    return table(
        head,
        rows,
        caption="Spread of the interface midpoint about the pelvis while walking with the robot, mean and SD over "
        f"seeds. {ABOUT_COUNTS} Paper: Table II.",
        numeric=range(1, len(head)),
    )


def _gait_table(study: Study) -> str:
    rows = [
        [
            escape(f"{words(row['joint'])}, {words(row['condition'])}"),
            *_counts_of(row),
            _with_sd(row, "rom_deg"),
            _with_sd(row, "rom_change_deg"),
            _with_sd(row, "peak_deg"),
            value_cell(row["r_walk_robot"]),
            value_cell(row["published_rom_deg"]),
            value_cell(row["published_peak_deg"]),
        ]
        for row in study.walking.gait.rows
    ]
    return table(
        [
            "Joint, condition",
            "Seeds",
            "Survived",
            "Range [deg]",
            "Change [deg]",
            "Peak [deg]",
            "r",
            "Published range [deg]",
            "Published peak [deg]",
        ],
        rows,
        caption="Range of motion, its change by the robot, peak angle, and correlation with the person's own walk with "
        f"the robot; mean and SD over seeds. {ABOUT_COUNTS} Paper: Table III.",
        numeric=range(1, 9),
    )


def _cloud(study: Study) -> str:
    """Return whether the interface cloud under the prior is as measured, by robot; empty without a walker."""
    table2 = {row["condition"]: row for row in study.walking.interface.rows}
    rows = _walker_rows(study)
    first = next((row for row in rows if row["condition"] == "prior" and row["main"] == "true"), None)
    if first is None or not table2["walk_robot"]["gamma"]:
        return ""
    measured = number(table2["walk_robot"]["gamma"])
    compared = rows_of(rows, condition="prior", aware=first["aware"], cap=first["cap"], robot_factor="")
    said = [
        _cloud_with(robot, [row["gamma"] for row in rows_of(compared, robot=robot)], measured)
        for robot in dict.fromkeys([first["robot"], *(row["robot"] for row in compared)])
    ]
    published = value_cell(table2["prior"]["published_gamma"])
    return paragraph(
        f"Interface cloud under the prior, by \N{GREEK SMALL LETTER GAMMA} (its spread forward over its spread to the "
        f"side): measured {rounded(measured)}, published {published}. {' '.join(said)}",
        "lead",
    )


def _walker_rows(study: Study) -> list[Row]:
    """Return the clouds of the first person kept for validation who has any: the person of Table II."""
    clouds = study.walking.clouds.rows if study.walking.clouds else []
    kept = (name for name, cohort in study.people.items() if cohort == "validation")
    return next((own for name in kept if (own := rows_of(clouds, subject=name))), [])


def _cloud_with(robot: str, texts: Sequence[str], measured: float) -> str:
    """Return a sentence on the cloud with one robot; ``texts`` are the ratios by seed, empty where all fell."""
    values = [number(text) for text in texts if text]
    if not values:
        return f"With the {robot} robot no walker stayed up."
    same_side = all((value < 1) is (measured < 1) for value in values)
    within = min(values) <= measured <= max(values)
    verdict = (
        "not reproduced"
        if not same_side
        else "reproduced"
        if within
        else "reproduced in its direction and not in its size"
    )
    lost = f"; in {len(texts) - len(values)} more all walkers fell" if len(values) < len(texts) else ""
    return (
        f"With the {robot} robot it is {verdict}: {rounded(statistics.fmean(values))} (mean of {len(values)} seeds, "
        f"{rounded(min(values))} to {rounded(max(values))}{lost})."
    )


def _bars(study: Study) -> str:
    """Is the simulated walker one to believe: its bars, missed ones by name."""
    bars = study.walking.bars.rows if study.walking.bars else []
    if not bars:
        return paragraph("No twin was trained for this study: the tables hold what the paper prints.")
    missed = rows_of(bars, met="false")
    count = f"{len(bars) - len(missed)} of {len(bars)} bars of the simulated walkers are met."
    if not missed:
        return paragraph(count)
    rows = [
        [
            escape(f"{row['subject']}, seed {row['seed']}"),
            escape(words(row["bar"])),
            value_cell(row["value"]),
            value_cell(row["limit"]),
        ]
        for row in missed
    ]
    return paragraph(f"{count} What a walker that misses a bar does with the robot is worth less.") + table(
        ["Walker", "Bar missed", "Value", "Limit"], rows, caption="Bars missed", numeric=(2, 3)
    )
