"""Joint angles and interface cloud of a person with and without the robot, measured and simulated (paper, V-C)."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.lines import Line2D
from matplotlib.patches import Ellipse

from real2sim.artefacts import read_json
from real2sim.geometry import AXES
from real2sim.pages import style
from real2sim.study.twin.adaptation import JOINT_NAMES

# of the ellipse of each condition; the prior's lies over the others and lets them show between its dashes
_LINES = {"prior": (0, (3, 1.5))}
CONDITIONS = {"soft": style.SKY, "prior": style.VERMILION, "stiff": style.PURPLE, "own": style.GREEN}
_WALKS = {"walk_normal": "no robot", "walk_robot": "with robot"}
_PHASE = np.linspace(0, 100, 101)


def _band(axes: Axes, entry: dict[str, Any], colour: str, label: str, dashed: bool = False) -> None:
    if not entry.get("cycles"):
        return
    mean, sd = np.array(entry["mean_deg"]), np.array(entry["sd_deg"])
    axes.fill_between(_PHASE, mean - sd, mean + sd, color=colour, alpha=0.15, linewidth=0)
    axes.plot(_PHASE, mean, color=colour, label=label, linestyle=(0, (4, 2)) if dashed else "-")


def _main_conditions(record: dict[str, Any]) -> list[dict[str, Any]]:
    """Return the conditions of the robot and the cap that are compared with the measurement."""
    plain = [c for c in record["conditions"] if not c["robot_factors"]]
    return [c for c in plain if c["robot"] == record["main_robot"] and c["main"]]


def _robot(record: dict[str, Any]) -> str:
    """Return which robot is drawn, and how fast it goes."""
    aware = "aware" if _main_conditions(record)[0]["aware"] else "fixed"
    return f"{record['main_robot']} robot at {record['main_cap']:.2g} of the walking speed, {aware} gait"


def _ellipse(axes: Axes, cloud: dict[str, Any], colour: str, label: str, line: Any = "-") -> float:
    """Draw a cloud's samples and its 95 % ellipse about the origin; returns the ellipse's reach [mm]."""
    if not cloud.get("trials"):
        return 0.0
    major, minor = cloud["ellipse"]["semi_axes_mm"]
    x, y = np.array(cloud["points_mm"]).T
    axes.plot(x, y, ".", color=colour, markersize=2.2, alpha=0.5, markeredgewidth=0, zorder=1)
    axes.add_patch(
        Ellipse(
            (0, 0),
            2 * major,
            2 * minor,
            angle=cloud["ellipse"]["angle_deg"],
            fill=False,
            edgecolor=colour,
            linestyle=line,
            linewidth=1.2 if line == "-" else 1.8,
            label=f"{label}, γ = {cloud['gamma']:.2f}",
            zorder=2 if line == "-" else 3,
        )
    )
    return float(major)


def _records(coupled: list[Path]) -> list[dict[str, Any]]:
    return [
        read_json(
            path, ("conditions", "measured", "free", "free_at_speeds", "main_cap", "main_robot", "phantom")
        )
        for path in coupled
    ]


def gait_figure(*, coupled: list[Path], out: list[Path]) -> None:
    """Measured and simulated joint angles over the gait cycle, and what the robot changes (paper, Fig. 6).

    ``coupled`` are a person's coupled.json, one per seed; the curves are the first seed's.
    """
    records = _records(coupled)
    first = records[0]
    with matplotlib.rc_context(style.RC):
        figure = style.new_figure(6.4, phantom=any(r["phantom"] for r in records))
        grid = figure.add_gridspec(4, 2, height_ratios=(1, 1, 1, 0.95))
        top = None
        for row, (joint, name) in enumerate(JOINT_NAMES.items()):
            real = figure.add_subplot(grid[row, 0], sharex=top)
            simulated = figure.add_subplot(grid[row, 1], sharex=real, sharey=real)
            top = top or real
            for kind, colour in (("walk_normal", style.BLACK), ("walk_robot", style.BLUE)):
                if kind in first["measured"]:
                    _band(real, first["measured"][kind][joint], colour, _WALKS[kind])
            _band(simulated, first["free"][joint], style.BLACK, "no robot")
            for condition in _main_conditions(first):
                _band(simulated, condition["joints"][joint], CONDITIONS[condition["name"]], condition["name"])
            for axes in (real, simulated):
                if not axes.lines:
                    style.say(axes, "no whole stride")
                elif row == 0:
                    # above the curves, where there is room for it
                    axes.set_ylim(top=axes.get_ylim()[1] + 16)
                    axes.legend(
                        ncols=1 if axes is real else 2, columnspacing=0.8, loc="upper center", borderaxespad=0
                    )
                if row == len(JOINT_NAMES) - 1:
                    axes.set_xlabel("gait cycle (%)")
            style.panel_letter(real, "ace"[row], f"{name}, measured")
            style.panel_letter(simulated, "bdf"[row], f"{name}, simulated")
            real.set_ylabel("angle (deg)")
        _changes(figure.add_subplot(grid[3, :]), records)
        style.save(figure, out)


def interface_figure(*, coupled: list[Path], out: list[Path]) -> None:
    """Draw where the interface midpoint goes relative to the pelvis, from above, with 95 % ellipses (paper, Fig. 5).

    ``coupled`` are a person's coupled.json, one per seed; the clouds are the first seed's.
    """
    records = _records(coupled)
    with matplotlib.rc_context(style.RC):
        figure = style.new_figure(3.6, phantom=any(r["phantom"] for r in records))
        _clouds(figure.add_subplot(), records)
        style.save(figure, out)


def _clouds(axes: Axes, records: list[dict[str, Any]]) -> None:
    record = records[0]
    reach = [_ellipse(axes, record["measured"]["cloud"], style.BLUE, "measured", "--")]
    for condition in _main_conditions(record):
        name = condition["name"]
        reach.append(_ellipse(axes, condition["cloud"], CONDITIONS[name], name, _LINES.get(name, "-")))
    limit = 1.15 * max([*reach, 1.0])
    axes.set(xlim=(-limit, limit), ylim=(-limit, limit), aspect="equal")
    axes.set_xlabel("forward (mm)")
    axes.set_ylabel("left (mm)")
    axes.legend(
        loc="lower center",
        bbox_to_anchor=(0.5, 1.0),
        ncols=2,
        title=f"95 % of the interface midpoint\n{_robot(record)}\nfirst of {len(records)} seeds",
    )


def _changes(axes: Axes, records: list[dict[str, Any]]) -> None:
    """Change of the range of motion by the robot, one point per seed."""
    names = [c["name"] for c in _main_conditions(records[0])]
    for row, joint in enumerate(JOINT_NAMES):
        for k, name in enumerate(names):
            values = []
            for record in records:
                entry = next(c for c in _main_conditions(record) if c["name"] == name)["joints"][joint]
                if entry.get("cycles") and record["free"][joint].get("cycles"):
                    values.append(entry["rom_deg"][0] - record["free"][joint]["rom_deg"][0])
            place = row + 0.2 * (k - (len(names) - 1) / 2)
            axes.plot(values, [place] * len(values), "o", color=CONDITIONS[name], markersize=2.5)
        walks = _measured_walks(records[0], joint)
        if walks:
            plain, assisted = walks
            change = assisted[joint]["rom_deg"][0] - plain[joint]["rom_deg"][0]
            axes.plot([change, change], [row - 0.4, row + 0.4], color=style.BLUE, linewidth=1.2)
    axes.axvline(0, color=style.GREY, linewidth=0.6, zorder=0)
    axes.set_yticks(range(len(JOINT_NAMES)), list(JOINT_NAMES.values()))
    axes.invert_yaxis()
    axes.set_xlabel(
        "change of range of motion by the robot (deg)\n"
        "point: a seed (curves: the first), line: measured\n" + _robot(records[0])
    )
    style.panel_letter(axes, "g")


def _measured_walks(record: dict[str, Any], joint: str) -> tuple[dict[str, Any], dict[str, Any]] | None:
    """Return the person's walks without and with the robot; None where one has no whole stride of the joint."""
    walks = [record["measured"].get(name, {}) for name in ("walk_normal", "walk_robot")]
    whole = all(walk.get(joint, {}).get("cycles") for walk in walks)
    return (walks[0], walks[1]) if whole else None


_MARKS = {"study": "o", "compliant": "s"}
_HARDLY_WALKING = -40  # change of speed beyond which a condition is counted and not drawn [%]


def speed_figure(*, coupled: list[Path], out: list[Path]) -> None:
    """Change of the ranges of motion of hip and knee against the change of speed, measured and simulated.

    ``coupled`` are a person's coupled.json, one per seed; every condition of every seed is a point, filled where the
    person takes up the speed that the robot allows.
    """
    records = _records(coupled)
    with matplotlib.rc_context(style.RC):
        figure = style.new_figure(3.7, phantom=any(r["phantom"] for r in records))
        both = figure.subplots(1, 2, sharex=True)
        drawn: set[str] = set()
        for axes, letter, (joint, name) in zip(both, "ab", list(JOINT_NAMES.items())[:2], strict=True):
            axes.set_xlabel("change of speed (%)")
            drawn |= _against_speed(axes, records, joint)
            style.panel_letter(axes, letter, name)
        both[0].set_ylabel("change of range of motion (deg)")
        handles = [
            Line2D([], [], color=c, marker="o", linestyle="", label=n)
            for n, c in CONDITIONS.items()
            if n in drawn
        ]
        handles += [
            Line2D([], [], color=style.BLACK, marker=m, mfc="none", linestyle="", label=f"{n} robot")
            for n, m in _MARKS.items()
        ]
        for face, label in ((style.BLACK, "aware gait"), ("none", "fixed gait")):
            handles.append(
                Line2D(
                    [], [], color=style.BLACK, marker="D", mfc=face, markersize=4, linestyle="", label=label
                )
            )
        handles.append(Line2D([], [], color=style.BLACK, linewidth=0.8, label="no robot, slower"))
        if "measured" in drawn:
            handles.append(
                Line2D([], [], color=style.BLUE, marker="*", markersize=9, linestyle="", label="measured")
            )
        figure.legend(handles=handles, loc="outside lower center", ncols=3)
        style.save(figure, out)


def _change(
    gait: dict[str, Any], angle: dict[str, Any], base: dict[str, Any], joint: str
) -> tuple[float, float]:
    """Return the change of speed [%] and of a joint's range of motion [deg] against a walk without a robot."""
    speed = 100 * (gait["speed_m_per_s"] / base["gait"]["speed_m_per_s"] - 1)
    return speed, angle["rom_deg"][0] - base[joint]["rom_deg"][0]


def _against_speed(axes: Axes, records: list[dict[str, Any]], joint: str) -> set[str]:
    """Draw every condition without factors, and the person's own change, for a joint; count who is hardly walking.

    Returns the names of the conditions that have a point, and ``measured`` where the person's own change has one.
    """
    beyond = fallen = 0
    drawn: set[str] = set()
    for record in records:
        free = record["free"]
        if not free["gait"] or not free[joint].get("cycles"):
            # a walker without a whole stride of its own leaves nothing to compare with
            fallen += 1
            continue
        for c in record["conditions"]:
            if c["robot_factors"] or not c["joints"][joint].get("cycles") or not c["gait"]:
                continue
            speed, change = _change(c["gait"], c["joints"][joint], free, joint)
            if speed < _HARDLY_WALKING:
                beyond += 1
                continue
            drawn.add(c["name"])
            colour, mark = CONDITIONS[c["name"]], _MARKS[c["robot"]]
            face = colour if c["aware"] else "none"
            axes.plot(speed, change, mark, color=colour, markersize=3.5, mfc=face, markeredgewidth=0.8)
        slower = [s for s in record["free_at_speeds"] if s["gait"] and s["joints"][joint].get("cycles")]
        line = [(0.0, 0.0)] + [_change(s["gait"], s["joints"][joint], free, joint) for s in slower]
        axes.plot(*np.array(sorted(line)).T, "-", color=style.BLACK, linewidth=0.8, zorder=1)
    walks = _measured_walks(records[0], joint)
    if walks:
        plain, assisted = walks
        drawn.add("measured")
        axes.plot(
            *_change(assisted["gait"], assisted[joint], plain, joint), "*", color=style.BLUE, markersize=9
        )
    axes.axhline(0, color=style.GREY, linewidth=0.6, zorder=0)
    axes.axvline(0, color=style.GREY, linewidth=0.6, zorder=0)
    if beyond:
        axes.set_xlabel(f"{axes.get_xlabel()}\n{beyond} beyond {_HARDLY_WALKING} %\nnot drawn")
    if fallen:
        axes.set_xlabel(f"{axes.get_xlabel()}\n{fallen} of {len(records)} seeds not drawn:\nno free walk")
    return drawn


def wrench_figure(*, coupled: list[Path], out: list[Path]) -> None:
    """Wrench of the strap on the interface over the gait cycle, measured (where it was logged) and simulated.

    ``coupled`` are a person's coupled.json, one per seed; the curves are the first seed's.
    """
    records = _records(coupled)
    first = records[0]
    with matplotlib.rc_context(style.RC):
        figure = style.new_figure(4.2, phantom=any(r["phantom"] for r in records))
        panels = figure.subplots(2, 3, sharex=True)
        for i, (axes, axis) in enumerate(zip(panels.flat, AXES, strict=True)):
            _wrench_curves(axes, first, axis)
            kind, direction = ("torque", "Nm") if axis[0] == "r" else ("force", "N")
            style.panel_letter(axes, "abcdef"[i], f"{kind} {axis[1]}")
            if i % 3 == 0:
                axes.set_ylabel(f"{kind} ({direction})")
            if i >= 3:
                axes.set_xlabel("gait cycle (%)")
        handles, labels = panels[0, 0].get_legend_handles_labels()
        if handles:
            figure.legend(handles, labels, loc="outside lower center", ncols=3, title=_robot(first))
        style.save(figure, out)


def _wrench_curves(axes: Axes, record: dict[str, Any], axis: str) -> None:
    """Draw one component of the wrench: measured, and of the conditions that are compared with it."""
    measured = record["measured"]["wrench"].get(axis)
    if measured:
        axes.plot(_PHASE, measured["curve"], color=style.BLUE, label="measured", linestyle=(0, (4, 2)))
    for condition in _main_conditions(record):
        found = condition["wrench"].get(axis)
        if found and condition["name"] in ("prior", "own"):
            axes.plot(_PHASE, found["curve"], color=CONDITIONS[condition["name"]], label=condition["name"])
    if not axes.lines:
        style.say(axes, "no stride")
