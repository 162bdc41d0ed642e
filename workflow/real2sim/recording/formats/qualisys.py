"""Qualisys Track Manager: marker trajectories (3D) and rigid bodies (6D) as TSV.

Layout after https://docs.qualisys.com/qtm/content/processing_measurement/motion_data_tsv.htm and real exports
of 2010 to 2026: ``KEY<tab>value`` lines, an optional row of column names, one row per frame. The unit is
never written; it is the millimetre.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from real2sim.errors import InputError
from real2sim.files import write_text
from real2sim.recording.formats.recordings import BodyRecording, Event, Finding, Length, MarkerRecording
from real2sim.recording.formats.text import (
    Lines,
    cells_of,
    check_number_of_names,
    increasing,
    read_lines,
    read_table,
    repeated,
    stripped,
)

MM_PER_M = 1000.0
_EXPORT_3D = "in QTM choose File > Export > To TSV with the data type 3D (not 6D, not forces)"


def write_markers(
    path: Path,
    recording: MarkerRecording,
    *,
    description: str = "--",
    timestamp: str = "2026-01-01, 00:00:00.000\t0.0",
) -> None:
    """Write marker trajectories as QTM writes them since 2022: mm, 3 decimals, CRLF, Frame and Time columns.

    Missing samples are written ``NaN``. The lab frame of ``recording`` is kept.
    """
    names = list(recording.positions)
    frames = len(recording.time_s)
    head = [
        f"NO_OF_FRAMES\t{frames}",
        "NO_OF_CAMERAS\t12",
        f"NO_OF_MARKERS\t{len(names)}",
        f"FREQUENCY\t{recording.rate_hz:g}",
        "NO_OF_ANALOG\t0",
        "ANALOG_FREQUENCY\t0",
        f"DESCRIPTION\t{description}",
        f"TIME_STAMP\t{timestamp}",
        "DATA_INCLUDED\t3D",
        "\t".join(["MARKER_NAMES", *names]),
        "\t".join(["TRAJECTORY_TYPES", *(["Measured"] * len(names))]),
        # QTM ends this row, and only this one, with a tab.
        "\t".join(["Frame", "Time", *(f"{name} {axis}" for name in names for axis in "XYZ"), ""]),
    ]
    table = np.hstack([np.asarray(recording.positions[name], float).reshape(frames, 3) for name in names])
    row = "%d\t%.5f\t" + "\t".join(["%.3f"] * table.shape[1])
    first = recording.first_frame
    body = [
        row % (first + i, time, *values)
        for i, (time, values) in enumerate(
            zip(recording.time_s.tolist(), (table * MM_PER_M).tolist(), strict=True)
        )
    ]
    text = "\r\n".join(head) + "\r\n" + "\r\n".join(body).replace("nan", "NaN") + "\r\n"
    write_text(path, text)


# -------------------- reading

_KEY = re.compile(r"[A-Z][A-Z0-9_]+")
_RATE_TOLERANCE = 0.005  # Time has 5 decimals: at 300 Hz one step rounds by 0.15 %
_LEADING = {"frame": "frame", "sample": "frame", "time": "time"}
_ORTHONORMAL = 1e-3  # Rot has 5 decimals
_LONGEST_HEADER = 10_000  # lines, of which each event is one
_MOST_LEFT_OUT = 4  # times as many frames as rows, from which on the numbers are taken for wrong
_BODY_CELLS = 16  # X Y Z, three angles, Residual, Rot[0..8]
_AGAIN = "export the trial again"


def read_markers(path: Path) -> MarkerRecording:
    """Read a QTM 3D TSV export of any generation; positions [m] in the lab frame of the export.

    ``time_s`` is the file's Time column, or (frame - 1) / rate without one; without a Frame column the first frame is
    that of its time. Frames that a cropped or filtered
    export leaves out, ``NaN``, blank cells and 0.000 triples are missing samples (NaN). Raises
    InputError, with the line, where the file is not such an export or contradicts itself.
    """
    path = Path(path)
    lines = read_lines(path, "a QTM TSV export", _EXPORT_3D)
    findings: list[Finding] = []
    header, events, at = _header(path, lines, "3D", findings)
    markers = _names(path, header, "MARKER_NAMES", "NO_OF_MARKERS", findings)
    leading, at = _column_row(path, lines, at, markers)
    rows = _rows(path, lines, at)
    if leading is None:
        leading = _unnamed_leading(lines, rows, 3 * len(markers))
    expected = f"3 for each of {len(markers)} markers"
    table = read_table(path, lines, rows, len(leading) + 3 * len(markers), expected)
    _check_count(path, header, len(rows), findings)
    frames, time_s, rate = _clock(path, header, leading, table, rows)
    positions = _positions(path, table[:, len(leading) :], markers, findings)
    time_s, positions = _fill_frames(path, frames, time_s, positions, findings)
    length = Length.of(header.get("NO_OF_FRAMES", [""])[0], len(rows))
    return MarkerRecording(time_s, rate, positions, int(frames[0]), findings, events, length=length)


def data_included(path: Path) -> str:
    """Return the content of a QTM TSV by its own header: ``3D``, ``6D``, ``Force``, ...; 3D where nothing is said."""
    lines = read_lines(Path(path), "a QTM TSV export", _EXPORT_3D)
    for line in lines[:200]:
        cells = line.split("\t")
        if cells[0].strip() == "DATA_INCLUDED":
            return " ".join(stripped(cells[1:]))
    return "3D"


def finding(
    code: str, severity: str, path: Path, place: str, message: str, action: str = "the data are used"
) -> Finding:
    """A finding about a file."""
    return Finding(code, severity, path.name, place, message, action)


def _header(
    path: Path, lines: Lines, kind: str, findings: list[Finding]
) -> tuple[dict[str, list[str]], list[Event], int]:
    """Keys, events and the number of the line after the header of an export of one kind."""
    header: dict[str, list[str]] = {}
    events: list[Event] = []
    at = 0
    while at < len(lines):
        if at > _LONGEST_HEADER:
            found = f"a header of more than {_LONGEST_HEADER} lines"
            raise InputError(path, f"line {at + 1}", found, "the header of an export", _EXPORT_3D, "header")
        cells = lines[at].split("\t")
        key = cells[0].rstrip()
        if lines[at].strip() and not _KEY.fullmatch(key):
            break
        if key == "EVENT":
            events.extend(_event(path, at, cells, findings))
        elif key:
            values = [cell.strip() for cell in cells[1:]] or [""]
            if key in header:
                _check_repeated(path, at, key, stripped(header[key]), stripped(values), findings)
            header[key] = values
        at += 1
    names = "MARKER_NAMES" if kind == "3D" else "BODY_NAMES"
    included = " ".join(stripped(header.get("DATA_INCLUDED", [""])))
    if included and included != kind:
        raise InputError(path, "DATA_INCLUDED", included, kind, _EXPORT_3D, "wrong_kind")
    if names not in header:
        found = f"line 1: {lines[0][:60]!r}" if not header else f"keys {', '.join(list(header)[:12])}"
        expected = "the header of a QTM TSV export"
        raise InputError(path, "", f"no {names} line ({found})", expected, _EXPORT_3D, "header")
    return header, events, at


def _check_repeated(
    path: Path, at: int, key: str, first: list[str], again: list[str], findings: list[Finding]
) -> None:
    """Report a header key that stands twice; refuse it where its two values differ."""
    if first != again:
        found = f"{key} twice: {' '.join(first)[:60]!r}, then {' '.join(again)[:60]!r}"
        remedy = "export the trial again, or remove the line that is wrong"
        raise InputError(path, f"line {at + 1}", found, "each key once", remedy, "header_repeated")
    message = f"{key} twice with the same value"
    findings.append(
        finding("header_repeated", "warning", path, f"line {at + 1}", message, "the value is used")
    )


def _event(path: Path, at: int, cells: list[str], findings: list[Finding]) -> list[Event]:
    """An EVENT line: label, frame, time [s]."""
    words = [cell.strip() for cell in cells[1:]]
    findings.append(
        finding("event", "info", path, f"line {at + 1}", " ".join(words).strip(), "kept as event")
    )
    try:
        return [Event(float(words[2]), words[0])]
    except (IndexError, ValueError):
        return []


def _names(
    path: Path, header: dict[str, list[str]], key: str, count: str, findings: list[Finding]
) -> list[str]:
    """Markers or bodies, each once."""
    names = stripped(header[key])
    check_number_of_names(path, key, names, _EXPORT_3D)
    twice = repeated(names)
    if twice or not names or not all(names):
        found = f"twice: {', '.join(twice)}" if twice else "a marker without a name"
        remedy = "label the trajectories in QTM"
        raise InputError(path, key, found, "one name per marker", remedy, "names")
    declared = header.get(count, [""])[0]
    if declared and declared != str(len(names)):
        message = f"{declared} declared, {len(names)} named"
        findings.append(finding("count", "warning", path, count, message))
    return names


def _check_count(path: Path, header: dict[str, list[str]], rows: int, findings: list[Finding]) -> None:
    declared = header.get("NO_OF_FRAMES", [""])[0]
    if declared and declared != str(rows):
        message = f"{declared} declared, {rows} there"
        findings.append(finding("count", "warning", path, "NO_OF_FRAMES", message))


def _rows(path: Path, lines: Lines, at: int) -> np.ndarray:
    """Numbers of the data lines, which must follow each other."""
    rows = at + np.flatnonzero(np.diff(lines.starts[at:]) > 1)
    if not any(lines[int(i)].strip() for i in rows):
        raise InputError(path, "", "a header and no frames", "one row per frame", _EXPORT_3D, "no_data")
    gaps = rows[:-1][np.diff(rows) != 1]
    if len(gaps):
        found, remedy = "an empty line between frames", _AGAIN
        raise InputError(path, f"line {gaps[0] + 2}", found, "one row per frame", remedy, "row_cells")
    return rows


def _leading(cells: list[str]) -> list[str]:
    """Frame and Time columns at the start of the row of names."""
    known = [cell.lower() for cell in cells[:2] if cell.lower() in _LEADING]
    return [_LEADING[name] for name in known]


def _column_row(path: Path, lines: Lines, at: int, markers: list[str]) -> tuple[list[str] | None, int]:
    """Leading columns (Frame, Time) by the column row, or None where there is none; the first data line."""
    cells = [cell.strip() for cell in lines[at].split("\t")] if at < len(lines) else []
    expected = [f"{name} {axis}" for name in markers for axis in "XYZ"]
    leading = _leading(cells)
    if not leading and cells[:1] != expected[:1]:
        return None, at
    names = stripped(cells[len(leading) :])
    if names != expected:
        wrong = next((i for i, (a, b) in enumerate(zip(names, expected, strict=False)) if a != b), len(names))
        wrong = min(wrong, len(expected))
        found = repr(names[wrong]) if wrong < len(names) else f"only {len(names)} coordinate columns"
        wanted = repr(expected[wrong]) if wrong < len(expected) else f"no more than {len(expected)} columns"
        place = f"line {at + 1}, column {len(leading) + wrong + 1}"
        raise InputError(path, place, found, f"{wanted} (order of MARKER_NAMES)", _AGAIN, "columns")
    return leading, at + 1


def _unnamed_leading(lines: Lines, rows: np.ndarray, width: int) -> list[str]:
    """Return whether Frame and Time are there, by the number of cells: without a row of names nothing else tells."""
    values, times = np.unique(lines.tabs(rows) + 1, return_counts=True)
    more = int(values[np.argmax(times)]) - width
    ends_blank = all(not lines[i].rsplit("\t", 1)[-1].strip() for i in rows)
    return ["frame", "time"] if more - ends_blank == 2 else []


def _clock(
    path: Path, header: dict[str, list[str]], leading: list[str], table: np.ndarray, rows: np.ndarray
) -> tuple[np.ndarray, np.ndarray, float]:
    """Frame numbers, times [s] and rate [Hz]."""
    for column, name in enumerate(leading):
        increasing(path, table[:, column], name, rows, column)
    text = header.get("FREQUENCY", [""])[0]
    try:
        rate = float(text)
    except ValueError:
        rate = np.nan  # EXT: an external timebase
    frames = table[:, leading.index("frame")] if "frame" in leading else np.arange(1.0, len(table) + 1)
    if (frames != np.rint(frames)).any() or np.abs(frames).max() > 2**31:
        raise InputError(path, "column Frame", "fractions", "whole frame numbers", _EXPORT_3D, "frame_number")
    if "time" not in leading:
        if not 0 < rate < np.inf:
            remedy = "export with the Time column, or with the frequency in the header"
            raise InputError(path, "FREQUENCY", text or "nothing", "the rate in Hz", remedy, "rate")
        return frames.astype(int), (frames - 1) / rate, rate
    time_s = table[:, leading.index("time")]
    span = time_s[-1] - time_s[0]
    measured = (frames[-1] - frames[0]) / span if len(time_s) > 1 else rate
    if not rate > 0:
        rate = float(measured)
    if not abs(measured / rate - 1) <= _RATE_TOLERANCE + 2e-5 / max(span, 1e-9):
        found = f"{rate:g} Hz in the header, {measured:.4g} Hz by the Time column"
        remedy = "export again, or correct the rate in the header"
        raise InputError(path, "FREQUENCY", found, "one rate", remedy, "rate")
    _check_steps(path, frames, time_s, rate, rows, leading.index("time"))
    if "frame" not in leading:
        frames += _frames_before(path, float(time_s[0]), rate)
    return frames.astype(int), time_s.copy(), rate


def _frames_before(path: Path, start_s: float, rate: float) -> float:
    """Return how many frames an export without a Frame column leaves out before its first row, by its time [s]."""
    before = round(start_s * rate)
    if abs(before) > 2**31:
        found = f"a first frame at {start_s:.6g} s, and no Frame column"
        expected = "times from the start of the recording"
        remedy = "export with the Frame column"
        raise InputError(path, "column Time", found, expected, remedy, "frame_number")
    return float(before)


def _check_steps(
    path: Path, frames: np.ndarray, time_s: np.ndarray, rate: float, rows: np.ndarray, column: int
) -> None:
    """Frame and Time must tell the same, row by row: half a frame apart, one of them is wrong."""
    first = (frames - frames[0]) / rate
    off = np.abs((time_s - time_s[0]) - first) * rate
    # An external clock may run up to the tolerance off the nominal rate.
    wrong = np.flatnonzero(off > 0.5 + _RATE_TOLERANCE * first * rate + 2e-5 * rate)
    if len(wrong):
        i = int(wrong[0])
        found = f"frame {frames[i]:.0f} at {time_s[i]:g} s"
        place = f"line {rows[i] + 1}, column {column + 1}"
        expected = f"{time_s[0] + first[i]:.5f} s at {rate:g} Hz"
        raise InputError(path, place, found, expected, _AGAIN, "frame_time")


def _positions(
    path: Path, table: np.ndarray, markers: list[str], findings: list[Finding]
) -> dict[str, np.ndarray]:
    """Positions (n, 3) [m] by marker; an incomplete or all-zero triple is a missing sample."""
    table /= MM_PER_M  # in place, and positions are views of it: each copy takes as much memory as a file of one digit
    triples = table.reshape(len(table), len(markers), 3)
    return known_positions(path, triples, markers, findings)


def known_positions(
    path: Path, triples: np.ndarray, markers: list[str], findings: list[Finding]
) -> dict[str, np.ndarray]:
    """Positions by marker of (n, markers, 3): an incomplete triple is missing; so is (0, 0, 0), reported."""
    x, y, z = np.moveaxis(triples, 2, 0)  # all() along an axis of three is slow
    zero = (x == 0) & (y == 0) & (z == 0)
    blank = np.isnan(x), np.isnan(y), np.isnan(z)
    any_blank = blank[0] | blank[1] | blank[2]
    partly = any_blank & ~(blank[0] & blank[1] & blank[2])
    triples[zero | any_blank] = np.nan
    for name, count, some in zip(markers, zero.sum(axis=0), partly.sum(axis=0), strict=True):
        if count:
            message = f"{count} samples at exactly (0, 0, 0)"
            findings.append(finding("zero_triple", "warning", path, name, message, "taken as missing"))
        if some:
            message = f"{some} samples with one or two of three coordinates"
            findings.append(finding("partial_triple", "warning", path, name, message, "taken as missing"))
    return {name: triples[:, i] for i, name in enumerate(markers)}


def _fill_frames(
    path: Path,
    frames: np.ndarray,
    time_s: np.ndarray,
    positions: dict[str, np.ndarray],
    findings: list[Finding],
) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """Insert a row of missing samples for each frame number that the export leaves out."""
    total = int(frames[-1] - frames[0]) + 1
    if total == len(frames):
        return time_s, positions
    if total > _MOST_LEFT_OUT * len(frames):
        found = f"{len(frames)} frames numbered {frames[0]} to {frames[-1]}"
        expected = "consecutive frame numbers"
        raise InputError(path, "column Frame", found, expected, _AGAIN, "frame_number")
    rows = frames - frames[0]
    message = f"{total - len(frames)} frame numbers left out"
    findings.append(
        finding("frames_missing", "warning", path, "column Frame", message, "taken as missing samples")
    )
    out = {}
    for name, values in positions.items():
        out[name] = np.full((total, *values.shape[1:]), np.nan)
        out[name][rows] = values
    return np.interp(np.arange(total), rows, time_s), out


# -------------------- rigid bodies


def read_bodies(path: Path) -> BodyRecording:
    """Read a QTM 6D TSV export; poses [m] in the lab frame of the export, from Rot[] by columns.

    The meaning of the angle columns depends on the export's settings: they are kept by their names [rad] and
    not used. A body with Residual -1 is lost (NaN). Raises InputError as `read_markers` does.
    """
    path = Path(path)
    lines = read_lines(path, "a QTM TSV export", _EXPORT_3D)
    findings: list[Finding] = []
    header, _, at = _header(path, lines, "6D", findings)
    bodies = _names(path, header, "BODY_NAMES", "NO_OF_BODIES", findings)
    leading, columns = _body_columns(path, lines, at, bodies)
    rows = _rows(path, lines, at + 1)
    table, blocks = _body_table(path, lines, rows, leading, len(bodies))
    _check_count(path, header, len(rows), findings)
    frames, time_s, rate = _clock(path, header, leading, table, rows)
    values = {body: table[:, block] for body, block in zip(bodies, blocks, strict=True)}
    time_s, values = _fill_frames(path, frames, time_s, values, findings)
    positions, rotations, residuals, angles = {}, {}, {}, {}
    for body, block in values.items():
        pose = _pose(path, body, dict(zip(columns, block.T, strict=True)), columns, findings)
        positions[body], rotations[body], residuals[body], angles[body] = pose
    return BodyRecording(time_s, rate, positions, rotations, residuals, angles, int(frames[0]), findings)


def _body_columns(path: Path, lines: Lines, at: int, bodies: list[str]) -> tuple[list[str], list[str]]:
    """Leading columns and the names of one body's cells; the row lists one body or all of them."""
    cells = [cell.strip() for cell in cells_of(lines[at])] if at < len(lines) else []
    leading = _leading(cells)
    names = [cell for cell in cells[len(leading) :] if cell]
    blocks = [names[i : i + _BODY_CELLS] for i in range(0, len(names), _BODY_CELLS)]
    own = [[_own_name(cell, body) for cell in block] for block, body in zip(blocks, bodies, strict=False)]
    fixed = ["X", "Y", "Z", "Residual", *(f"Rot[{i}]" for i in range(9))]
    good = len(blocks) in (1, len(bodies)) and all(block == own[0] for block in own)
    if not good or not own or len(own[0]) != _BODY_CELLS or own[0][:3] + own[0][6:] != fixed:
        expected = "X Y Z, three angles, Residual, Rot[0] to Rot[8] of one body or of all, in the order of BODY_NAMES"
        raise InputError(path, f"line {at + 1}", f"{', '.join(names)[:120]}", expected, _AGAIN, "columns")
    return leading, own[0]


def _own_name(cell: str, body: str) -> str:
    """Column name without the body's, which newer exports put on the first column only."""
    return cell.removeprefix(f"{body} ").strip() if cell.startswith(f"{body} ") else cell


def _body_table(
    path: Path, lines: Lines, rows: np.ndarray, leading: list[str], count: int
) -> tuple[np.ndarray, list[slice]]:
    """All numbers, and where each body's lie: bodies may be divided by a blank cell."""
    cells = lines[rows[0]].split("\t")[len(leading) :]
    step = _BODY_CELLS + (len(cells) > _BODY_CELLS and not cells[_BODY_CELLS].strip())
    width = len(leading) + count * step - (step > _BODY_CELLS)
    table = read_table(path, lines, rows, width, f"{_BODY_CELLS} for each of {count} bodies")
    starts = [len(leading) + i * step for i in range(count)]
    between = [start - 1 for start in starts[1:] if step > _BODY_CELLS]
    full = np.argwhere(~np.isnan(table[:, between]))
    if len(full):
        place = f"line {rows[full[0][0]] + 1}, column {between[full[0][1]] + 1}"
        raise InputError(path, place, "a number", "the blank cell between two bodies", _AGAIN, "row_cells")
    return table, [slice(start, start + _BODY_CELLS) for start in starts]


def _pose(
    path: Path, body: str, cells: dict[str, np.ndarray], columns: list[str], findings: list[Finding]
) -> tuple[np.ndarray, np.ndarray, np.ndarray, dict[str, np.ndarray]]:
    """Position [m], rotation, residual [m] and angles [rad] of one body."""
    table = np.column_stack([cells[name] for name in columns])
    lost = ~(cells["Residual"] >= 0) | np.isnan(table).any(axis=1)
    by_column = np.stack([cells[f"Rot[{i}]"] for i in range(9)], axis=1).reshape(-1, 3, 3)
    rotation = by_column.transpose(0, 2, 1).copy()
    rotation[lost] = np.nan
    with np.errstate(all="ignore"):  # a lost body is NaN, a damaged number may be anything
        error = np.abs(rotation @ rotation.transpose(0, 2, 1) - np.eye(3)).max(axis=(1, 2))
        wrong = ~lost & ~((error < _ORTHONORMAL) & (np.linalg.det(rotation) > 0))
    if wrong.any():
        message = f"{wrong.sum()} samples whose Rot[] is no rotation, the first in row {np.argmax(wrong) + 1}"
        findings.append(finding("rotation", "warning", path, body, message, "taken as missing"))
    if lost.any():
        message = f"{lost.sum()} samples without the body (Residual -1)"
        findings.append(finding("body_lost", "info", path, body, message, "taken as missing"))
    gone = lost | wrong
    position = np.column_stack([cells[axis] for axis in "XYZ"]) / MM_PER_M
    residual = cells["Residual"] / MM_PER_M
    position[gone], rotation[gone], residual[gone] = np.nan, np.nan, np.nan
    angles = {name: np.where(gone, np.nan, np.radians(cells[name])) for name in columns[3:6]}
    return position, rotation, residual, angles
