"""A clip of a fitted trial: measured and simulated interface at the pelvis, from above and from the side."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from real2sim.artefacts import read_json
from real2sim.errors import InputError
from real2sim.inference.parameters import as_vector
from real2sim.pages import style
from real2sim.recording.trial import Trial, TrialModel, trial_model, with_step
from real2sim.study.fit import best_of

if TYPE_CHECKING:
    from real2sim.settings import Settings

if TYPE_CHECKING:
    from PIL import Image

FRAMES_PER_S = 12
SIZE_IN, DPI = (5.2, 3.6), 100
# ASIS_L, ASIS_R, PSIS_R, PSIS_L: once around the pelvis, in the order of Trial.pelvis_markers (L, R, L, R)
_OUTLINE = (0, 1, 3, 2, 0)


def motion_clip(
    *,
    fits: list[Path],
    pose: Path,
    markers: Path,
    limits: Path,
    step: Path,
    robot: Path,
    settings: Settings,
    out: Path,
    seconds: float = 8.0,
) -> None:
    """Draw a trial under its best fit as an animated GIF; no graphics driver is needed.

    Parameters
    ----------
    fits, pose, markers, limits, step, robot, settings
        As in `motion.export.export_motion`.
    seconds
        Length [s], from the middle of the trial, where the motion is.

    Raises
    ------
    InputError
        Where nothing of the trial can be shown.
    """
    fit = best_of([read_json(path, ("subject", "trial", "parameters", "cost")) for path in fits])
    model = trial_model(
        pose=pose, markers=markers, limits=limits, robot=robot, settings=with_step(settings, step), nsim=1
    )
    simulated = model.replay.run(as_vector(fit["parameters"])[None])[0]
    shown = _samples(model, seconds)
    if not len(shown):
        raise InputError(
            pose,
            "",
            "no sample where pelvis and interface are known",
            "a trial with markers",
            "See quality.json.",
        )
    frames = _frames(model, simulated, shown, fit)
    style.save_clip(frames, out, 1 / FRAMES_PER_S)


def _samples(model: TrialModel, seconds: float) -> np.ndarray:
    """Samples to show: evenly spaced, from the middle of the trial, where everything is known."""
    time = model.trial.time_s
    middle = (time[0] + time[-1]) / 2
    moments = np.arange(middle - seconds / 2, middle + seconds / 2, 1 / FRAMES_PER_S)
    moments = moments[(moments >= time[0]) & (moments <= time[-1])]
    index = np.unique(np.searchsorted(time, moments).clip(0, len(time) - 1))
    known = np.isfinite(model.trial.interface).all(axis=(1, 2)) & np.isfinite(model.trial.pelvis_markers).all(
        axis=(1, 2)
    )
    shown: np.ndarray = index[known[index]]
    return shown


@dataclass(frozen=True)
class _View:
    """One direction to look from: axes of the world that are drawn, and the lines that move."""

    axes: tuple[int, int]
    pelvis: Line2D
    measured: Line2D
    simulated: Line2D

    def show(self, outline: np.ndarray, measured: np.ndarray, simulated: np.ndarray) -> None:
        """Move the lines to the outline of the pelvis (5, 3) and the interface markers (2, 3) [m]."""
        for line, points in (
            (self.pelvis, outline),
            (self.measured, measured),
            (self.simulated, simulated),
        ):
            line.set_data(points[:, self.axes[0]], points[:, self.axes[1]])


class _Canvas(Protocol):
    def draw(self) -> None: ...

    def buffer_rgba(self) -> memoryview: ...


def _frames(
    model: TrialModel, simulated: np.ndarray, shown: np.ndarray, fit: dict[str, Any]
) -> list[Image.Image]:
    """Frames as palette pictures."""
    from PIL import Image

    trial = model.trial
    with matplotlib.rc_context(style.RC):
        figure = Figure(figsize=SIZE_IN, dpi=DPI, layout="constrained")
        canvas: _Canvas = FigureCanvasAgg(figure)
        grid = figure.add_gridspec(2, 2, height_ratios=(2.2, 1))
        label = f"{fit['subject']}, {fit['trial'].replace('_', ' ')}, J = {fit['cost']['J']:.3g}"
        figure.suptitle(
            f"{style.PHANTOM_LABEL}: {label}" if trial.phantom else label,
            color=style.VERMILION if trial.phantom else style.BLACK,
            fontsize=8,
        )
        everything = np.concatenate(
            [trial.pelvis_markers[shown], trial.interface[shown], simulated[shown]], axis=1
        )
        views = [
            _draw_view(figure.add_subplot(grid[0, column]), title, axes, everything)
            for column, (title, axes) in enumerate((("from above", (0, 1)), ("from the right", (0, 2))))
        ]
        now = _draw_error(figure.add_subplot(grid[1, :]), trial, simulated, shown)
        first = views[0]
        figure.legend(
            handles=[first.pelvis, first.measured, first.simulated], loc="outside lower center", ncols=3
        )
        frames = []
        for sample in shown:
            outline = trial.pelvis_markers[sample][list(_OUTLINE)]
            for view in views:
                view.show(outline, trial.interface[sample], simulated[sample])
            now.set_xdata([trial.time_s[sample]] * 2)
            canvas.draw()
            picture = Image.fromarray(np.asarray(canvas.buffer_rgba())[..., :3].copy())
            frames.append(picture.quantize(32, dither=Image.Dither.NONE))
    return frames


def _draw_view(axes: Axes, title: str, drawn: tuple[int, int], everything: np.ndarray) -> _View:
    """Prepare a view of two axes of the world, wide enough for all points (n, k, 3) [m]."""
    names = ("forward (m)", "left (m)", "up (m)")
    i, j = drawn
    axes.set(title=title, xlabel=names[i], ylabel=names[j], aspect="equal")
    for k, setter in ((i, axes.set_xlim), (j, axes.set_ylim)):
        low, high = everything[..., k].min(), everything[..., k].max()
        setter(low - 0.05, high + 0.05)
    look: tuple[dict[str, Any], ...] = (
        {"color": style.GREY, "linewidth": 1.6, "label": "pelvis"},
        {"color": style.BLUE, "marker": "o", "linewidth": 1.4, "label": "interface, measured"},
        {
            "color": style.VERMILION,
            "marker": "x",
            "linewidth": 1.0,
            "linestyle": "--",
            "label": "simulated",
        },
    )
    return _View(drawn, *(axes.plot([], [], **options)[0] for options in look))


def _draw_error(axes: Axes, trial: Trial, simulated: np.ndarray, shown: np.ndarray) -> Line2D:
    """Draw how far the simulated markers are from the measured ones, and return the line that marks the moment."""
    time = trial.time_s[shown]
    error = 1e3 * np.linalg.norm(simulated[shown] - trial.interface[shown], axis=2)
    for side, colour, name in ((0, style.BLUE, "left"), (1, style.ORANGE, "right")):
        axes.plot(time, error[:, side], color=colour, label=name)
    now = axes.axvline(time[0], color=style.BLACK, linewidth=0.8)
    axes.set(xlabel="time (s)", ylabel="error (mm)", ylim=(0, 1.4 * error.max()))
    axes.legend(ncols=2, loc="upper right")
    return now
