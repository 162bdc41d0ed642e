"""Track Row Column files: positions of markers or landmarks (.trc), as OpenSim, OpenCap and others write them.

Line 1 ``PathFileType``, lines 2 and 3 keys and values, line 4 ``Frame# Time`` and the names, each over three
columns, line 5 ``X1 Y1 Z1 ...``, then one row per frame.
https://opensimconfluence.atlassian.net/wiki/spaces/OpenSim/pages/53089985
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from real2sim.errors import InputError
from real2sim.recording.formats.qualisys import finding, known_positions
from real2sim.recording.formats.recordings import Finding, Length, MarkerRecording
from real2sim.recording.formats.text import (
    Lines,
    cells_of,
    check_number_of_names,
    divide_by_tabs,
    increasing,
    read_lines,
    read_table,
    repeated,
    stripped,
)

UNITS_PER_M = {"m": 1.0, "meters": 1.0, "cm": 100.0, "mm": 1000.0, "millimeters": 1000.0}
_EXPORT = "export the landmarks again as .trc"
_AXIS = re.compile(r"[XYZ]\d+")
_RATE_TOLERANCE = 0.02  # time has as few as three decimals


def read_landmarks(path: Path) -> MarkerRecording:
    """Read a .trc; positions [m] in the file's frame (OpenSim: X forward, Y up, Z right).

    Blank cells and NaN are missing samples; declared counts are checked, never trusted. Raises InputError
    where the file is no .trc or where names and numbers cannot be laid on each other.
    """
    path = Path(path)
    findings: list[Finding] = []
    lines = divide_by_tabs(path, read_lines(path, "a .trc", _EXPORT), "frame#", findings)
    at, header = _header(path, lines)
    names, first = _names(path, lines, at)
    rows = lines.filled(first)
    if not len(rows):
        raise InputError(path, "", "a header and no frames", "one row per frame", _EXPORT, "no_data")
    table = read_table(path, lines, rows, 2 + 3 * len(names), f"3 for each of {len(names)} names")
    _check_counts(path, header, len(rows), len(names), findings)
    frames, time_s = table[:, 0], table[:, 1]
    increasing(path, frames, "Frame#", rows, 0)
    increasing(path, time_s, "Time", rows, 1)
    if (frames != np.rint(frames)).any() or np.abs(frames).max() > 2**31:
        expected = "whole frame numbers"
        raise InputError(path, "column Frame#", "fractions", expected, _EXPORT, "frame_number")
    rate = _rate(path, header, frames, time_s, findings)
    scale = _scale(path, header)
    positions = _positions(path, table, scale, names, findings)
    length = Length.of(header.get("numframes", ""), len(rows))
    return MarkerRecording(time_s.copy(), rate, positions, int(frames[0]), findings, length=length)


def _positions(
    path: Path, table: np.ndarray, scale: float, names: list[str], findings: list[Finding]
) -> dict[str, np.ndarray]:
    """Positions [m] as views of the table, which is scaled in place: copies take more memory than the file."""
    triples = table[:, 2:].reshape(len(table), len(names), 3)
    triples /= scale
    return known_positions(path, triples, names, findings)


def _header(path: Path, lines: Lines) -> tuple[int, dict[str, str]]:
    """Number of the line of names, and the values of lines 2 and 3 by lower-case key."""
    at = next((i for i, line in enumerate(lines[:50]) if line.split()[:1] == ["Frame#"]), None)
    if at is None or not lines[0].startswith("PathFileType"):
        found = f"line 1: {lines[0][:60]!r}" + ("" if at is not None else ", no line Frame# Time ...")
        raise InputError(path, "", found, "the header of a .trc", _EXPORT, "header")
    keys, values = (lines[i].split() if i < at else [] for i in (1, 2))
    if len(keys) != len(values):
        found = f"{len(keys)} keys, {len(values)} values"
        raise InputError(path, "line 3", found, "one value for each key of line 2", _EXPORT, "header")
    return at, {key.lower(): value for key, value in zip(keys, values, strict=True)}


def _names(path: Path, lines: Lines, at: int) -> tuple[list[str], int]:
    """Names in order and the number of the line after X1 Y1 Z1 ...

    The row of names leaves two cells after each; the row of axes must number them all.
    """
    cells = stripped(cells_of(lines[at]))[2:]
    names = [cell for cell in cells if cell]
    check_number_of_names(path, f"line {at + 1}", names, _EXPORT)
    spaced = len(cells) != len(names)
    if spaced and [i for i, cell in enumerate(cells) if cell] != list(range(0, 3 * len(names), 3)):
        expected = "a name over every third column"
        raise InputError(path, f"line {at + 1}", "names out of place", expected, _EXPORT, "columns")
    axes = stripped(lines[at + 1].split()) if at + 1 < len(lines) else []
    wanted = [f"{axis}{i + 1}" for i in range(len(names)) for axis in "XYZ"]
    if axes != wanted and [axis[:1] for axis in axes] != ["X", "Y", "Z"] * len(names):
        found = f"{len(axes)} axes for {len(names)} names"
        expected = f"{', '.join(wanted[:3])}, ..."
        raise InputError(path, f"line {at + 2}", found, expected, _EXPORT, "columns")
    twice = repeated(names)
    if twice or not names:
        found = f"twice: {', '.join(twice)}" if twice else "no name"
        raise InputError(path, f"line {at + 1}", found, "one name per landmark", _EXPORT, "names")
    return names, at + 2


def _check_counts(path: Path, header: dict[str, str], rows: int, names: int, findings: list[Finding]) -> None:
    for key, there in (("numframes", rows), ("nummarkers", names)):
        if key in header and header[key] != str(there):
            message = f"{header[key]} declared, {there} there"
            findings.append(finding("count", "warning", path, key, message))


def _rate(
    path: Path, header: dict[str, str], frames: np.ndarray, time_s: np.ndarray, findings: list[Finding]
) -> float:
    """Rate [Hz] of the header, checked against the time column; by the time column without it."""
    try:
        rate = float(header.get("datarate", ""))
    except ValueError:
        rate = np.nan
    span = time_s[-1] - time_s[0]
    measured = float((frames[-1] - frames[0]) / span) if len(time_s) > 1 else rate
    if not 0 < rate < np.inf:
        rate = measured
    if not 0 < rate < np.inf:
        remedy = "write the rate into the header"
        raise InputError(path, "DataRate", "no rate", "the rate in Hz", remedy, "rate")
    if abs(measured / rate - 1) > _RATE_TOLERANCE + 2e-3 / max(span, 1e-9):
        message = f"{rate:g} Hz in the header, {measured:.4g} Hz by frames and time"
        findings.append(
            finding("rate_differs", "warning", path, "DataRate", message, "the time column is used")
        )
        rate = measured
    return rate


def _scale(path: Path, header: dict[str, str]) -> float:
    unit = header.get("units", "")
    if unit.lower() not in UNITS_PER_M:
        expected = ", ".join(UNITS_PER_M)
        remedy = "write the unit into line 3"
        raise InputError(path, "Units", repr(unit) if unit else "nothing", expected, remedy, "units")
    return UNITS_PER_M[unit.lower()]
