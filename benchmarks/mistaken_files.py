"""Mistakes of a careless lab, made on the raw files of one recording session; benchmarks/mistakes.py judges them.

Each function of `MISTAKES` changes some files of a `Lab` and returns the `Mistake`: which trials it touched, and the
gates and codes that belong to it. Sizes are those that move an identified stiffness by 5 % or more where the file
enters a fit: see the constants.
"""

from __future__ import annotations

import re
import shutil
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from mcap.reader import make_reader
from mcap.writer import Writer
from real2sim import signals
from real2sim.geometry import INTERFACE_MARKERS, PELVIS_MARKERS
from real2sim.recording.formats import qualisys, robot_log
from real2sim.recording.formats.opensim import read_coordinates, write_coordinates
from real2sim.recording.formats.recordings import MarkerRecording
from scipy.signal import butter, filtfilt, lfilter
from scipy.spatial.transform import Rotation

# Issue 30: markers x 0.9 give k_rx 24.0 for 32.5, 2.6 % a per cent; 5 % is reached at 1.9 %
SCALE = (0.02, 0.2)
# The rest pose is the mean of neutral: a lean by 30 mm moves it by about 15 mm, of some 60 mm of motion
LEAN_M, TURN_DEG = (0.03, 0.15), (6.0, 25.0)
LATE_S = (0.02, 0.1)
MOVING = ("dynamic", "rotation", "translation", "walk_robot")
PAIR = {"robot_pair", "robot_residual", "markerless_pair", "markerless_residual"}


@dataclass
class Lab:
    """Folder of one person's raw files, in which a mistake is made, and those of the other people of the study."""

    folder: Path
    others: list[Path]
    rng: np.random.Generator

    def trials(self, kinds: tuple[str, ...]) -> list[str]:
        """Names of the trials of some kinds."""
        return [p.stem for p in sorted(self.folder.glob("*.tsv")) if p.stem.startswith(kinds)]

    def draw(self, kinds: tuple[str, ...], count: int = 1) -> list[str]:
        """Names of different trials at random."""
        return [str(x) for x in self.rng.choice(self.trials(kinds), count, replace=False)]

    def draw_pair(self) -> tuple[str, str]:
        """Two trials of one kind at random."""
        kind = str(self.rng.choice([kind for kind in MOVING if len(self.trials((kind,))) > 1]))
        first, second = self.draw((kind,), 2)
        return first, second

    def log_uniform(self, span: tuple[float, float]) -> float:
        """A size at random, evenly by its logarithm."""
        return float(np.exp(self.rng.uniform(*np.log(span))))


@dataclass
class Mistake:
    """One mistake: trials whose files changed, gates and codes that name it, and what else is known of it.

    ``session`` says that the files of all trials changed alike, so that one trial can name it; ``donor`` is the
    trial of another person that was put in; ``without_logs`` that the session's robot logs were removed; ``axes`` is
    the rotation (3, 3) from the stated to the true lab axes; ``times_kept`` that the log's times are still right.
    """

    name: str
    detail: str
    changed: list[str]
    right: set[str]
    session: bool = False
    donor: Path | None = None
    without_logs: bool = False
    axes: np.ndarray | None = None
    times_kept: bool = False


def _change_markers(path: Path, change: Callable[[MarkerRecording], MarkerRecording]) -> None:
    """Export a marker file again after a change."""
    changed = change(qualisys.read_markers(path))
    frames = len(next(iter(changed.positions.values())))
    time_s = (changed.first_frame - 1 + np.arange(frames)) / changed.rate_hz
    qualisys.write_markers(path, replace(changed, time_s=time_s))


def _move(path: Path, change: Callable[[str, np.ndarray], np.ndarray]) -> None:
    """Change the positions (n, 3) [m] of each marker of a file."""
    _change_markers(
        path, lambda r: replace(r, positions={name: change(name, v) for name, v in r.positions.items()})
    )


def _copy(source: Path, target: Path) -> None:
    """Copy a file over another, which may be a hard link."""
    target.unlink(missing_ok=True)
    shutil.copy(source, target)


def _exchange(a: Path, b: Path) -> None:
    aside = a.with_name("aside")
    a.rename(aside)
    b.rename(a)
    aside.rename(b)


# -------------------- kind 2: trials that are not what they say


def moving_neutral(lab: Lab) -> Mistake:
    """Let the person lean, turn or walk off while `neutral` is recorded."""
    rng, path = lab.rng, lab.folder / "neutral.tsv"
    frames = len(qualisys.read_markers(path).time_s)
    ends = np.sort(rng.uniform(0, frames - 1, 2))
    way = np.interp(np.arange(frames), ends, [0.0, 1.0])[:, None]
    heading = rng.uniform(0, 2 * np.pi)
    direction = np.array([np.cos(heading), np.sin(heading), 0.0])
    how = str(rng.choice(["leans", "turns", "walks off"]))
    if how == "turns":
        degrees = lab.log_uniform(TURN_DEG) * rng.choice([-1, 1])
        pelvis = qualisys.read_markers(path).positions
        centre = np.nanmean(np.concatenate([pelvis[name] for name in PELVIS_MARKERS]), axis=0)
        turns = Rotation.from_rotvec(np.radians(degrees) * way * [0.0, 0.0, 1.0])
        _move(path, lambda name, v: turns.apply(v - centre) + centre if name in PELVIS_MARKERS else v)
        return Mistake("moving neutral", f"turns by {degrees:.0f} deg", ["neutral"], {"still"})
    size = lab.log_uniform(LEAN_M)
    who = PELVIS_MARKERS if how == "leans" else (*PELVIS_MARKERS, *INTERFACE_MARKERS)
    _move(path, lambda name, v: v + size * way * direction if name in who else v)
    return Mistake("moving neutral", f"{how} by {1e3 * size:.0f} mm", ["neutral"], {"still"})


def _copy_trial(source: Path, target: Path) -> None:
    """Copy all files of a trial; the arguments are paths without suffix."""
    for suffix in (".tsv", ".mot", ".mcap"):
        if source.with_suffix(suffix).exists():
            _copy(source.with_suffix(suffix), target.with_suffix(suffix))


def copied(lab: Lab) -> Mistake:
    """Copy a trial under another name of its kind, all files or the markers alone."""
    first, second = lab.draw_pair()
    if lab.rng.random() < 0.5:
        _copy_trial(lab.folder / first, lab.folder / second)
        return Mistake("copy", f"{first} as {second}, all files", [second], {"same"})
    _copy(lab.folder / f"{first}.tsv", lab.folder / f"{second}.tsv")
    return Mistake("copy", f"{first} as {second}, markers", [second], {"same"})


def export_again(path: Path, rng: np.random.Generator) -> None:
    """Write markerless file and log of a trial (a path without suffix) again, so that no byte of a hash stays."""
    mot, mcap = path.with_suffix(".mot"), path.with_suffix(".mcap")
    coordinates = read_coordinates(mot)
    write_coordinates(mot, replace(coordinates, time_s=coordinates.time_s + rng.uniform(0.01, 0.05)))
    if mcap.exists():
        log = robot_log.read_log(mcap)
        robot_log.write_log(mcap, replace(log, start_ns=log.start_ns + 10**9))


def _filtered(values: np.ndarray, how: str, rate_hz: float) -> np.ndarray:
    """Return positions (n, 3) after a filter; gaps stay."""
    good, rows = signals.known(values), np.arange(len(values))
    closed = np.column_stack([np.interp(rows, rows[good], column[good]) for column in values.T])
    kind, order, cutoff = how.split()
    gains = butter(int(order), float(cutoff) / (rate_hz / 2))
    start = closed[0]
    smooth = (
        filtfilt(*gains, closed, axis=0) if kind == "zero-phase" else lfilter(*gains, closed - start, axis=0)
    )
    smooth = smooth if kind == "zero-phase" else smooth + start
    return np.where(good[:, None], smooth, np.nan)


def _near_copy(recording: MarkerRecording, rng: np.random.Generator) -> tuple[MarkerRecording, str]:
    """Return a recording after one or two of a lab's changes, and what they were."""
    frames, rate, told = len(recording.time_s), recording.rate_hz, []
    steps = [str(x) for x in rng.choice(["crop", "place", "origin", "round", "filter"], 2, replace=False)]
    steps = steps[: int(rng.integers(1, 3))]
    positions, first = recording.positions, recording.first_frame
    if "filter" in steps:
        cutoff, order = rng.choice([6, 8, 10, 12, 15]), rng.choice([1, 2, 4])
        how = f"{rng.choice(['zero-phase', 'causal'])} {order} {cutoff}"
        positions = {name: _filtered(values, how, rate) for name, values in positions.items()}
        told.append(f"filter {how} Hz")
    if "place" in steps:
        turn = Rotation.from_euler("z", rng.uniform(-40, 40), degrees=True)
        shift = rng.uniform(-0.3, 0.3, 3) * [1, 1, 0.1]
        positions = {name: turn.apply(values) + shift for name, values in positions.items()}
        told.append("in another place")
    if "crop" in steps:
        start, stop = rng.uniform(0, 0.3) * frames, (1 - rng.uniform(0, 0.3)) * frames
        rows = slice(round(start), round(stop))
        positions = {name: values[rows] for name, values in positions.items()}
        first += rows.start
        told.append(f"frames {rows.start} to {rows.stop} of {frames}")
    if "origin" in steps:
        first = int(rng.integers(2, 400))
        told.append(f"from frame {first}")
    if "round" in steps:
        positions = {name: np.round(values, 3) for name, values in positions.items()}
        told.append("in whole mm")
    return replace(recording, positions=positions, first_frame=first), ", ".join(told)


def nearly_copied(lab: Lab) -> Mistake:
    """Copy a trial under another name after a change; all its files are exported again."""
    first, second = lab.draw_pair()
    told = []

    def change(recording: MarkerRecording) -> MarkerRecording:
        out, what = _near_copy(recording, lab.rng)
        told.append(what)
        return out

    _copy_trial(lab.folder / first, lab.folder / second)
    _change_markers(lab.folder / f"{second}.tsv", change)
    export_again(lab.folder / second, lab.rng)
    return Mistake("near copy", f"{first} as {second}: {told[0]}", [second], {"same"})


def of_another_person(lab: Lab) -> Mistake:
    """Put in a trial of another person of the study: all files or the markers alone, as they are or changed."""
    rng = lab.rng
    (name,) = lab.draw(("dynamic", "walk_robot", "neutral"))
    donor = lab.others[int(rng.integers(len(lab.others)))] / name
    whole, again = bool(rng.random() < 0.5), bool(rng.random() < 0.5)
    if whole:
        _copy_trial(donor, lab.folder / name)
    else:
        _copy(donor.with_suffix(".tsv"), lab.folder / f"{name}.tsv")
    if again:
        _change_markers(lab.folder / f"{name}.tsv", lambda r: _near_copy(r, rng)[0])
        if whole:
            export_again(lab.folder / name, rng)
    detail = (
        f"{name} of {donor.parent.name}, {'all files' if whole else 'markers'}{', changed' if again else ''}"
    )
    return Mistake("another person", detail, [name], {"same", "rigid", *PAIR}, donor=donor)


def _other_file(lab: Lab, suffix: str, kind: str, right: set[str]) -> Mistake:
    """Exchange the files of two moving trials, or put in the other's, exported again."""
    first, second = lab.draw(MOVING, 2)
    a, b = lab.folder / f"{first}{suffix}", lab.folder / f"{second}{suffix}"
    if lab.rng.random() < 0.5:
        _exchange(a, b)
        return Mistake(kind, f"{first} and {second} exchanged", [first, second], right)
    _copy(b, a)
    if lab.rng.random() < 0.5:
        export_again(lab.folder / first, lab.rng)
    return Mistake(kind, f"that of {second} as {first}", [first], {"same", *right})


def markerless_of_another_trial(lab: Lab) -> Mistake:
    """Put the markerless file of another trial in place."""
    right = {"markerless_pair", "markerless_residual"}
    return _other_file(lab, ".mot", "markerless of another trial", right)


def log_of_another_trial(lab: Lab) -> Mistake:
    """Put the robot log of another trial in place."""
    return _other_file(lab, ".mcap", "robot log of another trial", {"robot_pair", "robot_residual"})


def cut_off(lab: Lab) -> Mistake:
    """Cut a marker or markerless file at the end of a line."""
    (name,) = lab.draw((*MOVING, "walk_normal", "neutral"))
    suffix = str(lab.rng.choice([".tsv", ".tsv", ".mot"]))
    path = lab.folder / f"{name}{suffix}"
    lines = path.read_bytes().splitlines(keepends=True)
    keep = round(len(lines) * lab.rng.uniform(0.3, 0.95))
    path.unlink()
    path.write_bytes(b"".join(lines[:keep]))
    return Mistake("cut off", f"{path.name}, {keep} of {len(lines)} lines", [name], {"length", "count"})


# -------------------- kind 3: scale


def scaled(lab: Lab) -> Mistake:
    """Scale all markers of one trial, or of the session: a wand of another length."""
    factor = 1 + lab.log_uniform(SCALE) * lab.rng.choice([-1, 1])
    all_of_them = bool(lab.rng.random() < 0.3)
    names = lab.trials((*MOVING, "neutral")) if all_of_them else lab.draw(MOVING)
    names.sort(key=lambda name: not name.startswith("dynamic"))
    for name in names:
        _move(lab.folder / f"{name}.tsv", lambda _, values: factor * values)
    where = "session" if all_of_them else names[0]
    return Mistake("scale", f"{where} x {factor:.3f}", names, {"scale"}, session=all_of_them)


# -------------------- kind 4: units of the markerless file


def _rewrite_mot(path: Path, columns: Callable[[str, np.ndarray], np.ndarray], header: str = "") -> None:
    """Change the columns of a .mot as they stand in the file, and its inDegrees line."""
    lines = path.read_text().splitlines()
    at = lines.index("endheader") + 1
    names = lines[at].split("\t")
    table = np.array([[float(x) for x in line.split("\t")] for line in lines[at + 1 :]])
    for i, name in enumerate(names[1:], start=1):
        table[:, i] = columns(name, table[:, i])
    head = [header if header and line.startswith("inDegrees") else line for line in lines[: at + 1]]
    if header.endswith("no"):
        head = [line for line in head if "degrees" not in line.lower() or line.startswith("inDegrees")]
    rows = ["\t".join(f"{x:.8f}" for x in row) for row in table.tolist()]
    path.unlink()
    path.write_text("\n".join([*head, *rows]) + "\n")


def _is_length(name: str) -> bool:
    return bool(re.search(r"_t[xyz]$", name))


def radians_as_degrees(lab: Lab) -> Mistake:
    """Write radians, of all joints or of the pelvis, under inDegrees=yes."""
    (name,) = lab.draw((*MOVING, "walk_normal"))
    pelvis = bool(lab.rng.random() < 0.3)

    def change(column: str, values: np.ndarray) -> np.ndarray:
        turned = not _is_length(column) and (column.startswith("pelvis") or not pelvis)
        return np.radians(values) if turned else values

    _rewrite_mot(lab.folder / f"{name}.mot", change)
    what = "pelvis in radians" if pelvis else "radians"
    return Mistake("radians as degrees", f"{name}, {what}", [name], {"units_contradicted"})


def degrees_as_radians(lab: Lab) -> Mistake:
    """Leave degrees in the table under inDegrees=no."""
    (name,) = lab.draw((*MOVING, "walk_normal"))
    _rewrite_mot(lab.folder / f"{name}.mot", lambda _, values: values, "inDegrees=no")
    right = {"units_contradicted", "units_doubtful", "units_ambiguous"}
    return Mistake("degrees as radians", name, [name], right)


def millimetres(lab: Lab) -> Mistake:
    """Write the translations of the markerless file in millimetres."""
    (name,) = lab.draw((*MOVING, "walk_normal"))
    _rewrite_mot(lab.folder / f"{name}.mot", lambda c, values: 1e3 * values if _is_length(c) else values)
    return Mistake("translations in mm", name, [name], {"units_contradicted", "markerless_residual", "scale"})


def unnamed_translation(lab: Lab) -> Mistake:
    """Name a translation so that nothing says it is one; it is written in metres beside angles in degrees."""
    (name,) = lab.draw((*MOVING, "walk_normal"))
    path = lab.folder / f"{name}.mot"
    own = str(lab.rng.choice(["lumbar_shift", "scapula_glide_r", "seat_height", "knee_slide_l"]))
    lines = path.read_text().splitlines()
    at = lines.index("endheader") + 1
    lines[at] += f"\t{own}"
    values = 0.4 + 0.02 * np.sin(np.arange(len(lines) - at - 1) / 20)
    lines[at + 1 :] = [f"{line}\t{x:.8f}" for line, x in zip(lines[at + 1 :], values, strict=True)]
    columns = len(lines[at].split("\t"))
    lines = [f"nColumns={columns}" if line.startswith("nColumns") else line for line in lines]
    path.unlink()
    path.write_text("\n".join(lines) + "\n")
    return Mistake("translation of unknown name", f"{name}, {own}", [name], {"coordinate_kind"})


# -------------------- kind 5: times of the robot log


def write_late(path: Path, delays: dict[str, np.ndarray | float], *, stamped: bool) -> None:
    """Log the messages of some topics later [s]; stamps stay right, or are 0 on all topics."""
    with path.open("rb") as stream:
        messages = [(s, c.topic, m.log_time, m.data) for s, c, m in make_reader(stream).iter_messages()]
    counts: dict[str, int] = {}
    late = []
    for schema, topic, at, data in messages:
        i = counts[topic] = counts.get(topic, -1) + 1
        delay = delays.get(topic, 0.0)
        own = float(delay[i]) if isinstance(delay, np.ndarray) else delay
        # a stamp stands behind the four bytes of the encapsulation; /sync has none
        data = data if stamped or topic == "/sync" else data[:4] + bytes(8) + data[12:]
        late.append((at + round(1e9 * own), topic, schema, data))
    path.unlink()
    with path.open("wb") as stream:
        writer, channels = Writer(stream), {}
        writer.start(profile="ros2", library="mistakes")
        for at, topic, schema, data in sorted(late, key=lambda message: message[:2]):
            if topic not in channels:
                own_schema = writer.register_schema(schema.name, schema.encoding, schema.data)
                channels[topic] = writer.register_channel(topic, "cdr", own_schema)
            writer.add_message(channels[topic], at, data, at)
        writer.finish()


def _delay(lab: Lab, count: int = 10_000) -> tuple[np.ndarray | float, str]:
    size = lab.log_uniform(LATE_S)
    if lab.rng.random() < 0.5:
        return size, f"{1e3 * size:.0f} ms late"
    varying = lab.rng.uniform(0, 2 * size, count)
    return varying, f"0 to {2e3 * size:.0f} ms late"


def late_with_stamps(lab: Lab) -> Mistake:
    """Log one topic late; its stamps are right."""
    (name,) = lab.draw(MOVING)
    topic = str(lab.rng.choice(["/joint_states", "/joint_states", "/odom"]))
    delay, text = _delay(lab)
    write_late(lab.folder / f"{name}.mcap", {topic: delay}, stamped=True)
    right = {"stamp_delay"}
    return Mistake("late, stamped", f"{name} {topic} {text}", [name], right, times_kept=True)


def late_without_stamps(lab: Lab) -> Mistake:
    """Log base and joints late beside /sync, without stamps."""
    (name,) = lab.draw(MOVING)
    size = lab.log_uniform(LATE_S)
    write_late(lab.folder / f"{name}.mcap", {"/joint_states": size, "/odom": size}, stamped=False)
    return Mistake("late, no stamps", f"{name} {1e3 * size:.0f} ms late", [name], {"robot_sync"})


def joints_late_without_stamps(lab: Lab) -> Mistake:
    """Log the joints late, and the base and /sync in time, without stamps."""
    (name,) = lab.draw(("dynamic", "translation", "walk_robot"))
    size = lab.log_uniform(LATE_S)
    write_late(lab.folder / f"{name}.mcap", {"/joint_states": size}, stamped=False)
    right = {"robot_sync", "robot_residual", "robot_pair"}
    return Mistake("joints late, no stamps", f"{name} {1e3 * size:.0f} ms late", [name], right)


# -------------------- kind 8: axes of the lab


def _axes(rng: np.random.Generator) -> tuple[np.ndarray, str]:
    """Return a rotation (3, 3) from world to lab axes, and the lab axis that points up."""
    up = str(rng.choice(["y", "y", "x", "z"]))
    world = np.roll(np.eye(3), "xyz".index(up) - 2, axis=0)  # rows: lab axes in the world
    quarter = int(rng.integers(1, 4) if up == "z" else rng.integers(0, 4))
    level = np.rint(Rotation.from_euler("z", 90 * quarter, degrees=True).as_matrix())
    return np.asarray(world @ level), f"{up} up, turned by {90 * quarter} deg"


def other_axes(lab: Lab) -> Mistake:
    """Export the session, or one trial, in other lab axes than stated, with or without robot logs."""
    axes, text = _axes(lab.rng)
    session, no_logs = bool(lab.rng.random() < 0.6), bool(lab.rng.random() < 0.5)
    kinds = (*MOVING, "walk_normal")
    names = ["neutral", *lab.trials(kinds)] if session else lab.draw(kinds)
    for name in names:
        _move(lab.folder / f"{name}.tsv", lambda _, values: values @ axes.T)
    if no_logs:
        for path in lab.folder.glob("*.mcap"):
            path.unlink()
    right = {"lab_axes", "facing"} if session else {"frame_robot", "frame_markerless", "lab_axes"}
    where = f"{'session' if session else names[0]}{', no log' if no_logs else ''}"
    return Mistake(
        "other axes",
        f"{where}: {text}",
        names,
        right,
        session=session,
        without_logs=no_logs,
        axes=axes if session else None,
    )


# By the kind's number in issue 30: what is injected in turn
MISTAKES: dict[int, tuple[Callable[[Lab], Mistake], ...]] = {
    2: (
        nearly_copied,
        moving_neutral,
        of_another_person,
        markerless_of_another_trial,
        copied,
        log_of_another_trial,
        cut_off,
        nearly_copied,
    ),
    3: (scaled,),
    4: (radians_as_degrees, degrees_as_radians, millimetres, unnamed_translation),
    5: (late_with_stamps, joints_late_without_stamps, late_without_stamps),
    8: (other_axes,),
}
