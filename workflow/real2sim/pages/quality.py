"""One picture per person: which trial passes which gate, and the figures that matter most; warnings of files."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
from html import escape
from pathlib import Path
from typing import Any

import matplotlib
from matplotlib.patches import Rectangle

from real2sim.artefacts import read_json
from real2sim.pages import style
from real2sim.pages.page import folded, table

_FACES = {"pass": "#CFE8F7", "warn": style.ORANGE, "refuse": style.VERMILION}
_INK = {"pass": "#1a1a1a", "warn": "#1a1a1a", "refuse": "#ffffff"}
_ROW_IN, _COLUMN_IN, _LEFT_IN, _TOP_IN, _LINE_IN = 0.17, 0.25, 1.5, 1.35, 0.155
_LINE_CHARACTERS = 112  # what fits into the width at the size of the text


def quality_figure(*, gates: Path, out: list[Path]) -> None:
    """Matrix of trials and gates by verdict (P, W, R; a dash where nothing could be measured), with key figures."""
    content = read_json(gates, ("subject", "phantom", "order", "session", "trials"))
    trials, columns = content["trials"], content["order"]
    with matplotlib.rc_context(style.RC):
        lines = [part for line in _key_figures(content) for part in textwrap.wrap(line, _LINE_CHARACTERS)]
        bottom = 0.2 + _LINE_IN * len(lines)
        width = _LEFT_IN + _COLUMN_IN * len(columns) + 0.45
        height = _TOP_IN + _ROW_IN * len(trials) + bottom
        figure = style.new_figure(height, phantom=False, width_in=width)
        figure.set_layout_engine("none")
        box = (
            _LEFT_IN / width,
            bottom / height,
            _COLUMN_IN * len(columns) / width,
            _ROW_IN * len(trials) / height,
        )
        axes = figure.add_axes(box)
        for row, about in enumerate(trials.values()):
            _row(axes, row, columns, about)
        axes.set_xlim(0, len(columns))
        axes.set_ylim(len(trials), 0)
        axes.set_yticks([i + 0.5 for i in range(len(trials))], [_label(*item) for item in trials.items()])
        names = [name.replace("_", " ") for name in columns]
        axes.set_xticks(
            [i + 0.5 for i in range(len(columns))], names, rotation=60, ha="left", rotation_mode="anchor"
        )
        axes.xaxis.tick_top()
        axes.tick_params(length=0)
        for spine in axes.spines.values():
            spine.set_visible(False)
        counts = {v: sum(t["verdict"] == v for t in trials.values()) for v in ("pass", "warn", "refuse")}
        title = f"{content['subject']}: {counts['pass']} trials pass, {counts['warn']} warn, {counts['refuse']} refused"
        figure.text(0.01, 1 - 0.06 / height, title, va="top", fontsize=9, fontweight="bold")
        if content["phantom"]:
            label = style.PHANTOM_LABEL
            figure.text(0.01, 1 - 0.26 / height, label, va="top", color=style.VERMILION, fontweight="bold")
        figure.text(0.01, (bottom - 0.1) / height, "\n".join(lines), va="top", linespacing=1.4)
        style.save(figure, out)


def _label(name: str, about: dict[str, Any]) -> str:
    return f"{name} (overridden)" if about["override"] is not None and about["verdict"] == "refuse" else name


def _row(axes: Any, row: int, columns: list[str], about: dict[str, Any]) -> None:
    found = {gate["gate"]: gate for gate in about["gates"]}
    for column, name in enumerate(columns):
        gate = found.get(name)
        if gate is None:
            continue
        verdict = gate["verdict"]
        unknown = verdict == "pass" and gate["value"] is None and name not in ("readable", "same")
        face = "#F2F2F2" if unknown else _FACES[verdict]
        axes.add_patch(Rectangle((column, row), 1, 1, facecolor=face, edgecolor="white", linewidth=1))
        letter = "\N{EN DASH}" if unknown else verdict[0].upper()
        weight = "bold" if verdict != "pass" else "normal"
        axes.text(
            column + 0.5,
            row + 0.53,
            letter,
            ha="center",
            va="center",
            color=_INK[verdict],
            fontsize=6.5,
            weight=weight,
        )


def _key_figures(content: dict[str, Any]) -> list[str]:
    """P, W, R explained; drifts; noise; the first refused or warned gates in words."""
    lines = ["P pass   W warn   R refuse   \N{EN DASH} nothing to measure by   blank: does not apply"]
    drifts = []
    for system in ("robot", "markerless"):
        pooled = content["session"][f"{system}_drift"]
        if pooled is not None:
            low, high = pooled["ci95_ppm"]
            drifts.append(
                f"{system} clock {style.signed(pooled['ppm'], 1)} ppm "
                f"[{style.signed(low, 1)}, {style.signed(high, 1)}] over {pooled['pooled_over_trials']} trials"
            )
    lines += [f"Drift (95 %): {drift}" for drift in drifts]
    gates = [gate for about in content["trials"].values() for gate in about["gates"]]
    noise = [gate for gate in gates if gate["gate"] == "noise" and gate["value"] is not None]
    lines += [f"Noise floor: {gate['message']}" for gate in noise[:1]]
    graver = sorted((g for g in gates if g["verdict"] != "pass"), key=lambda g: g["verdict"] != "refuse")
    for gate in graver[:4]:
        text = f"{gate['verdict'].capitalize()}: {gate['trial']}, {gate['gate']}: {gate['message']}"
        lines.append(text if len(text) <= 2 * _LINE_CHARACTERS else text[: 2 * _LINE_CHARACTERS - 3] + "...")
    if len(graver) > 4:
        lines.append(f"and {len(graver) - 4} more: quality.csv")
    codes = [finding["code"] for about in content["trials"].values() for finding in about["findings"]]
    if codes:
        listed = ", ".join(sorted(set(codes)))
        lines.append(f"Warnings that reading the files gave: {listed} (quality.csv says where)")
    return lines


def warnings_of_files(found: Sequence[tuple[str, str, str, str]]) -> str:
    """Return markup of the warnings that reading the files gave: trial, code, message and action of each."""
    if not found:
        return ""
    caption = (
        "Every warning that reading the files gave, one line per trial and code. No verdict depends on them: what was "
        "done stands beside each"
    )
    rows = [[escape(cell) for cell in row] for row in found]
    detail = table(["Trial", "Code", "What was found", "What was done"], rows, caption=caption)
    word = "warning" if len(found) == 1 else "warnings"
    return folded(f"{len(found)} {word} from reading the files", detail, unfolded=len(found) <= 12)
