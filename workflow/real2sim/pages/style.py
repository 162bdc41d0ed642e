"""One look for all figures: sizes, colours, the phantom's label, and saving without dates."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import matplotlib

matplotlib.use("Agg")

from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, NullLocator

from real2sim.files import replacing

COLUMN_WIDTH_IN = 3.5
# A figure tells so many people apart; more are drawn as one cloud, or chosen from
NAMED_PEOPLE = 12
PNG_DPI = 200
PHANTOM_LABEL = "phantom cohort (synthetic)"

# Okabe & Ito (2008): told apart with any of the common colour vision deficiencies.
BLACK, ORANGE, SKY, GREEN = "#000000", "#E69F00", "#56B4E9", "#009E73"
YELLOW, BLUE, VERMILION, PURPLE = "#F0E442", "#0072B2", "#D55E00", "#CC79A7"
GREY = "#8C8C8C"
PERSON_COLOURS = (BLUE, VERMILION, GREEN, PURPLE, ORANGE, SKY, BLACK)
# one of many people
CLOUD: Any = {
    "color": BLUE,
    "marker": ".",
    "markersize": 1.5,
    "markeredgewidth": 0,
    "linewidth": 0.3,
    "alpha": 0.3,
}
PERSON_MARKERS = ("o", "s", "^", "D", "v", "P", "X")
CLASS_COLOURS = {"common": GREEN, "uncertain": ORANGE, "distinct": PURPLE}

RC: Any = {
    "font.family": "DejaVu Sans",
    "font.size": 7.5,
    "axes.titlesize": 8,
    "axes.labelsize": 7.5,
    "xtick.labelsize": 7,
    "ytick.labelsize": 7,
    "legend.fontsize": 7,
    "axes.linewidth": 0.6,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "xtick.major.width": 0.6,
    "ytick.major.width": 0.6,
    "lines.linewidth": 1.0,
    "lines.markersize": 3.0,
    "legend.frameon": False,
    "legend.handlelength": 1.4,
    "figure.dpi": PNG_DPI,
    "savefig.dpi": PNG_DPI,
    "pdf.fonttype": 42,
    # text of an SVG stays text, which a page sets in its own colour
    "svg.fonttype": "none",
    "svg.hashsalt": "real2sim",
}


SVG_METADATA = {"Date": None, "Creator": None, "Format": None, "Type": None}


def new_figure(
    height_in: float,
    *,
    phantom: bool,
    width_in: float = COLUMN_WIDTH_IN,
    overridden: Iterable[str] = (),
    note: str = "",
) -> Figure:
    """A figure at print size, labelled above its panels where its data are the phantom's.

    ``overridden`` are trials that it rests on although a gate refuses them: named there too. ``note`` says what else
    has to be known, as that not everybody is shown.
    """
    figure = Figure(figsize=(width_in, height_in), layout="constrained")
    labels = [PHANTOM_LABEL] if phantom else []
    labels += [note] if note else []
    named = sorted(set(overridden))
    if named:
        more = f" and {len(named) - 2} more" if len(named) > 2 else ""
        labels.append(f"rests on refused trials: {', '.join(named[:2])}{more}")
    if labels:
        figure.suptitle("\n".join(labels), fontsize=7.5, color=VERMILION, fontweight="bold")
    return figure


def person_style(index: int) -> dict[str, Any]:
    """Colour and marker of the index-th person, both varied so that neither is needed alone.

    When all colours are used up the markers move on by one, so that no pair comes twice among the first 49 people.
    """
    rounds, colour = divmod(index, len(PERSON_COLOURS))
    return {
        "color": PERSON_COLOURS[colour],
        "marker": PERSON_MARKERS[(index + rounds) % len(PERSON_MARKERS)],
    }


def panel_letter(axes: Axes, letter: str, title: str = "") -> None:
    """Write ``(a) title`` at the upper left of a panel."""
    axes.set_title(f"({letter}) {title}".rstrip(), loc="left")


def say(axes: Axes, text: str) -> None:
    """An empty panel that states why it is empty."""
    axes.set_axis_off()
    axes.text(0.5, 0.5, text, ha="center", va="center", transform=axes.transAxes, wrap=True)


def math_name(parameter: str) -> str:
    """Parameter as set in print: ``k_tx`` becomes k with subscript tx."""
    return rf"${parameter[0]}_{{{parameter[2:]}}}$"


def log_axis(axis: Axis, low: float, high: float) -> None:
    """Logarithmic ticks with plain numbers, dense enough to read values that span [low, high]."""
    span = high / low
    tiers = (
        (2.0, (1.0, 1.1, 1.2, 1.3, 1.4, 1.5, 1.6, 1.8, 2.0, 2.5, 3.0, 4.0, 5.0, 6.0, 7.0, 8.0, 9.0)),
        (10.0, (1.0, 1.5, 2.0, 3.0, 5.0, 7.0)),
        (300.0, (1.0, 2.0, 5.0)),
    )
    subs = next((ticks for limit, ticks in tiers if span <= limit), (1.0,))
    axis.set_major_locator(LogLocator(subs=subs))
    axis.set_minor_locator(NullLocator())
    axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))


def signed(value: float, digits: int) -> str:
    """A number with a typographic minus, and none on a rounded zero."""
    text = f"{value:.{digits}f}"
    return text.removeprefix("-") if float(text) == 0 else text.replace("-", "\N{MINUS SIGN}")


def save_clip(frames: Sequence[Any], out: Path, frame_s: float) -> None:
    """Write palette pictures (PIL) as a GIF that repeats, ``frame_s`` seconds each."""
    with replacing(out) as temporary:
        frames[0].save(
            temporary,
            format="GIF",
            save_all=True,
            append_images=frames[1:],
            duration=round(1000 * frame_s),
            loop=0,
            optimize=True,
        )


def save(figure: Figure, out: Iterable[Path]) -> None:
    """Write the figure once per path (.png, .pdf or .svg), byte for byte the same for the same data."""
    metadata: dict[str, dict[str, Any]] = {
        ".png": {"Software": None},
        ".pdf": {"CreationDate": None, "Producer": None, "Creator": None},
        ".svg": SVG_METADATA,
    }
    with matplotlib.rc_context(RC):
        for path in out:
            with replacing(path) as temporary:
                figure.savefig(temporary, format=path.suffix[1:], metadata=metadata[path.suffix])
