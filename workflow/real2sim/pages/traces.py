"""Traces of a recording and of simulations of it, channel by channel."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure

from real2sim.pages import style

KINDS = {
    "measured": ("measured", style.BLACK, "-"),
    "plain": ("simulated", style.BLUE, "--"),
    "with_effect": ("with the effect", style.ORANGE, ":"),
}
MOST_CHANNELS = 8
# Swings that can be told apart side by side; of a recording with more, the part with the largest gap is drawn
MOST_SWINGS = 40


def plot_traces(columns: Mapping[str, np.ndarray], title: str, path: Path | str | None = None) -> Figure:
    """Draw channels over time, measured and simulated; return the figure.

    Parameters
    ----------
    columns
        time_s and ``<kind>_<channel>`` (n,), kind one of `KINDS`; units stand in the channels' names. The channels that
        move most are drawn.
    path
        Where the figure is written, PNG or PDF; None for nowhere.
    """
    channels = [name.removeprefix("measured_") for name in columns if name.startswith("measured_")]
    moved = sorted(channels, key=lambda c: -float(np.nanstd(columns[f"measured_{c}"])))[:MOST_CHANNELS]
    shown = [c for c in channels if c in moved]
    part, whole = _readable(columns, moved[0]), len(columns["time_s"])
    columns = {name: values[part] for name, values in columns.items()}
    figure, axes = plt.subplots(
        len(shown), 1, sharex=True, squeeze=False, figsize=(7.0, 1.2 + 1.3 * len(shown)), layout="constrained"
    )
    for row, channel in zip(axes[:, 0], shown, strict=True):
        for kind, (label, colour, line) in KINDS.items():
            values = columns.get(f"{kind}_{channel}")
            if values is not None:
                row.plot(columns["time_s"], values, line, color=colour, lw=1.2, label=label)
        row.set_ylabel(_label(channel), fontsize=8)
        row.tick_params(labelsize=8)
        row.ticklabel_format(axis="y", scilimits=(-3, 4))
        row.yaxis.get_offset_text().set_fontsize(8)
    cut = len(columns["time_s"]) < whole
    axes[-1, 0].set_xlabel("time [s]" + (", where the gap is largest" if cut else ""), fontsize=8)
    handles, labels = axes[0, 0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=3, fontsize=8, frameon=False)
    axes[0, 0].set_title(title, fontsize=9, loc="left")
    if path is not None:
        figure.savefig(path, dpi=150)
        plt.close(figure)
    return figure


def _readable(columns: Mapping[str, np.ndarray], channel: str) -> slice:
    """Return the samples to draw: all, or as many swings as can be told apart, where the gap is largest."""
    measured = columns[f"measured_{channel}"]
    crossings = int(np.count_nonzero(np.diff(measured > np.nanmean(measured))))
    if crossings <= 2 * MOST_SWINGS:
        return slice(None)
    count = max(2, len(measured) * 2 * MOST_SWINGS // crossings)
    apart = np.nan_to_num(columns.get(f"plain_{channel}", measured) - measured) ** 2
    total = np.concatenate([[0.0], np.cumsum(apart)])
    first = int(np.argmax(total[count:] - total[:-count]))
    return slice(first, first + count)


def _label(channel: str) -> str:
    """Return a channel's name with its unit in brackets; coordinates of markers are metres."""
    name, _, last = channel.rpartition("_")
    if last in "xyz":
        return f"{name} {last} [m]"
    return f"{name.replace('_', ' ')} [{last}]" if name else channel
