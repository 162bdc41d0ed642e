"""Tightness sweep of all persons (paper Fig. 3)."""

from __future__ import annotations

from collections.abc import Sized
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes

from real2sim.artefacts import number, read_json, read_table
from real2sim.pages import style

X_LABEL = r"normalised tightness $\tilde{T}$ (1)"


def _series(rows: list[dict[str, str]], column: str) -> tuple[np.ndarray, np.ndarray]:
    x = np.array([number(r["normalised_tightness"]) for r in rows])
    return x, np.array([number(r[column]) for r in rows])


def _looks(tables: Sized) -> list[dict[str, Any]]:
    """Return the looks of each person: told apart, or as one of many."""
    if len(tables) > style.NAMED_PEOPLE:
        return [style.CLOUD] * len(tables)
    return [style.person_style(index) for index in range(len(tables))]


def _selected(axes: Axes) -> None:
    axes.axvline(0.0, color=style.BLACK, linewidth=0.8, linestyle=(0, (4, 2)), zorder=0)


def _range_panel(axes: Axes, tables: dict[str, list[dict[str, str]]], column: str) -> None:
    for look, (subject, rows) in zip(_looks(tables), tables.items(), strict=True):
        axes.plot(*_series(rows, column), label=subject, **({"linewidth": 0.8} | look))
    _selected(axes)
    axes.set_xlabel(r"$\tilde{T}$ (1)")
    axes.set_ylim(0, 1.08 * max(axes.dataLim.y1, 1.0))


def _rotation_panel(axes: Axes, tables: dict[str, list[dict[str, str]]], pooled: dict[str, Any]) -> None:
    for look, (subject, rows) in zip(_looks(tables), tables.items(), strict=True):
        for side, filled in (("left", True), ("right", False)):
            axes.plot(
                *_series(rows, f"dphi_{side}_deg"),
                **({"markeredgewidth": 0.7} | look),
                linestyle="none",
                label=subject if filled else None,
                fillstyle="full" if filled else "none",
            )
    _selected(axes)
    axes.set_xlabel(X_LABEL)
    axes.set_ylabel(r"$\Delta\phi$ of one side (deg)")
    axes.set_ylim(bottom=0)
    if pooled.get("status") != "ok":
        axes.set_xlabel(f"{X_LABEL}\nno pooled regression: {pooled.get('status', 'no data')}")
        return
    _knee(axes, tables, pooled)


def _knee(axes: Axes, tables: dict[str, list[dict[str, str]]], pooled: dict[str, Any]) -> None:
    """Both fitted segments with their slopes, and the breakpoint's interval along the x axis."""
    every = np.concatenate([_series(rows, "dphi_deg")[0] for rows in tables.values()])
    knee, value = pooled["breakpoint"], pooled["value_at_breakpoint"]
    interval = pooled["breakpoint_interval"]
    for key, end in (("k1", every.min()), ("k2", every.max())):
        ends = [value, value + pooled[key] * (end - knee)]
        axes.plot([knee, end], ends, color=style.GREY, linewidth=2.2, zorder=1)
    axes.axvspan(*interval, color=style.GREY, alpha=0.25, linewidth=0, zorder=-1)
    slopes = (rf"$k_{n}$ = {style.signed(pooled[f'k{n}'], 1)}" for n in (1, 2))
    place = (style.signed(v, 2) for v in (knee, *interval))
    axes.set_title(
        f"{',  '.join(slopes)} deg per unit\n"
        + r"knee at $\tilde{{T}}$ = {} [{}, {}], ".format(*place)
        + f"p = {pooled['p_value']:.2g}",
        loc="right",
        fontsize=7,
    )


def tightness_figure(*, sweeps: list[Path], cohort: Path, out: list[Path]) -> None:
    """Draw ranges against normalised tightness: dx, dy [mm] above, dphi of a side [deg] and knee below.

    ``sweeps`` are the persons' sweep tables, ``cohort`` the file of `tightness.tightness_cohort`.
    """
    tables = {rows[0]["subject"]: rows for rows in map(read_table, sweeps) if rows}
    tables = dict(sorted(tables.items()))
    pooled = read_json(cohort, ("pooled", "phantom"))
    with matplotlib.rc_context(style.RC):
        figure = style.new_figure(4.6, phantom=pooled["phantom"])
        grid = figure.add_gridspec(2, 2, height_ratios=(1, 1.35))
        for letter, column, cell in (("a", "dx_mm", grid[0, 0]), ("b", "dy_mm", grid[0, 1])):
            axes = figure.add_subplot(cell)
            _range_panel(axes, tables, column)
            axes.set_ylabel(rf"$\Delta {column[1]}$ (mm)")
            style.panel_letter(axes, letter)
        axes = figure.add_subplot(grid[1, :])
        _rotation_panel(axes, tables, pooled["pooled"].get("dphi", {}))
        style.panel_letter(axes, "c")
        handles, labels = axes.get_legend_handles_labels()
        if len(tables) > style.NAMED_PEOPLE:
            handles, labels = handles[:1], [f"each of {len(tables)} people"]
        figure.legend(
            handles,
            labels,
            loc="outside lower center",
            ncols=max(1, min(len(labels), 6)),
            title="filled: left, open: right; dashed: selected level T*",
            title_fontsize=7,
        )
        style.save(figure, out)
