"""OpenSim motion files: tables as .mot or .sto, generalised coordinates among them.

Header lines up to ``endheader`` (``key=value``, or SIMM's ``key value``), a row of column names, then one row
per time; cells are numbers, or Vec3, Quaternion, SpatialVec with commas. Rotations are in degrees where the
header says ``inDegrees=yes`` and in radians otherwise; translations are always metres.
https://opensimconfluence.atlassian.net/wiki/spaces/OpenSim/pages/53089996
"""

from __future__ import annotations

import re
from collections.abc import Collection
from pathlib import Path

import numpy as np

from real2sim.errors import InputError
from real2sim.files import write_text
from real2sim.recording.formats.recordings import CoordinateRecording, Finding, Length, StorageRecording
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

PELVIS_COORDINATES = ("pelvis_tilt", "pelvis_list", "pelvis_rotation", "pelvis_tx", "pelvis_ty", "pelvis_tz")
_TRANSLATION = re.compile(r"(^|_)t[xyz](_|$)")
# Words by which OpenSim's models name rotations: Rajagopal, gait2392, gait10dof, MoBL, full-body spines
_ROTATION = re.compile(
    r"(^|_)(tilt|list|rot|rotation|flex|flexion|ext|extension|add|adduction|abd|abduction|angle|bend|bending|inversion"
    r"|eversion|pro|sup|pronation|supination|dev|deviation|elv|elevation|prot|protraction|retraction|obliquity|yaw"
    r"|pitch|roll|fe|lb|ar|beta)(_|$)",
    re.IGNORECASE,
)


def is_translation(name: str) -> bool:
    """Return whether a coordinate is a translation [m] by OpenSim's naming (``pelvis_tx``, ``knee_tx_r``)."""
    return bool(_TRANSLATION.search(name))


def is_rotation(name: str) -> bool:
    """Return whether a coordinate is a rotation by the words of OpenSim's models (``hip_flexion_r``)."""
    return not is_translation(name) and bool(_ROTATION.search(name))


def write_coordinates(path: Path, recording: CoordinateRecording, *, name: str = "Coordinates") -> None:
    """Write coordinates [rad, m] as OpenSim's inverse kinematics does: version 1, degrees, 8 decimals."""
    names = list(recording.columns)
    columns = [
        np.asarray(values, float) if is_translation(key) else np.degrees(np.asarray(values, float))
        for key, values in recording.columns.items()
    ]
    table = np.column_stack([recording.time_s, *columns])
    head = [
        name,
        "version=1",
        f"nRows={len(table)}",
        f"nColumns={table.shape[1]}",
        "inDegrees=yes",
        "",
        "Units are S.I. units (second, meters, Newtons, ...)",
        "Angles are in degrees.",
        "",
        "endheader",
        "\t".join(["time", *names]),
    ]
    row = "\t".join(["%16.8f"] * table.shape[1])
    text = "\n".join([*head, *(row % tuple(values) for values in table.tolist())]) + "\n"
    write_text(path, text)


# -------------------- reading

_EXPORT_MOT = "export the coordinates from OpenSim (inverse kinematics) as .mot, angles in degrees"
_AGAIN = "the file may be cut off: export it again"
_WHAT = "an OpenSim .mot or .sto"
_FORCES = re.compile(r"force|moment|torque", re.IGNORECASE)
_STATE = re.compile(r"^/.*/([^/]+)/value$")
_MUSCLE_STATE = re.compile(r"\.[A-Za-z_]+$")  # soleus_r.activation, as states files of OpenSim 3 have it
_SIMM = re.compile(r"(datacolumns|datarows|otherdata|name|range|indegrees)\s+(\S.*)", re.IGNORECASE)
_BENT_RAD = np.radians(20)  # no knee extends so far beyond straight
_IMPOSSIBLE_RAD = 4 * np.pi  # no joint, and no person turning on the spot in a trial, gets there
_ELEMENTS = {"double": 1, "float": 1, "vec3": 3, "unitvec3": 3, "quaternion": 4, "vec6": 6, "spatialvec": 6}


def read_coordinates(
    path: Path, *, translations: Collection[str] = (), rotations: Collection[str] = ()
) -> CoordinateRecording:
    """Read an OpenSim .mot or .sto of coordinates, on its own clock; rotations [rad], translations [m].

    ``translations`` and ``rotations`` name coordinates whose names do not tell what they are. Counts declared in the
    header are checked, never trusted. Raises InputError, with the line, where the file holds no coordinates, or
    leaves open whether its angles are degrees or radians.
    """
    path = Path(path)
    storage = read_storage(path)
    findings = storage.findings
    if not len(storage.time_s) or not storage.columns:
        found = "column names and no data"
        raise InputError(path, "", found, "one row per time", _EXPORT_MOT, "no_data")
    columns = _coordinates(path, storage, findings)
    lengths = {
        name for name in columns if (is_translation(name) or name in translations) and name not in rotations
    }
    unknown = [n for n in columns if n not in lengths and n not in rotations and not is_rotation(n)]
    angles = {name: values for name, values in columns.items() if name not in lengths}
    in_degrees = _in_degrees(path, storage, angles, findings)
    if in_degrees:
        columns |= {name: np.radians(values) for name, values in angles.items()}
    if unknown:
        message = f"{', '.join(unknown)}: rotations or translations? Their names do not tell"
        severity, action = "info", "nothing is converted"
        if in_degrees:
            severity, action = "warning", "taken as rotations in degrees"
        findings.append(Finding("coordinate_kind", severity, path.name, "", message, action))
    _check_knee(path, columns, findings)
    declared = storage.header.get("nrows", storage.header.get("datarows", ""))
    length = Length.of(declared, len(storage.time_s))
    return CoordinateRecording(storage.time_s, columns, findings, in_degrees, unknown, length)


def read_storage(path: Path) -> StorageRecording:
    """Read any OpenSim table (.mot, .sto) as it is written, without a change of units.

    Raises InputError, with the line, where a row does not have the cells that the names say.
    """
    path = Path(path)
    findings: list[Finding] = []
    lines = divide_by_tabs(path, read_lines(path, _WHAT, _EXPORT_MOT), "time", findings)
    at = _names_line(path, lines, findings)
    head = lines[:at]
    header = _keys(head)
    elements = _elements(path, header)
    names = _names(path, lines, at)
    time_column = next(i for i, name in enumerate(names) if name.lower() == "time")
    rows = lines.filled(at + 1)
    table = _table(path, lines, rows, len(names), time_column, elements)
    _check_counts(path, header, len(rows), len(names), findings)
    table = _without_repeated_end(path, table, time_column, rows, findings)
    time_s = table[:, time_column, 0].copy()
    increasing(path, time_s, "time", rows, time_column)
    columns = {name: table[:, i].copy() for i, name in enumerate(names) if i != time_column}
    text = [line for line in head if line.strip() and line.strip().lower() != "endheader"]
    return StorageRecording(time_s, columns, header, text, findings)


def _names_line(path: Path, lines: Lines, findings: list[Finding]) -> int:
    """Number of the line of column names: the first after endheader, or the one that starts with time."""
    end = next((i for i, line in enumerate(lines[:1000]) if line.strip().lower() == "endheader"), None)
    if end is not None:
        return next((i for i in range(end + 1, len(lines)) if lines[i].strip()), end + 1)
    starts = (stripped(cells_of(line))[:1] for line in lines[:1000])
    named = next((i for i, cell in enumerate(starts) if cell and cell[0].lower() == "time"), None)
    if named is None:
        found = f"no line 'endheader' (line 1: {lines[0][:60]!r})"
        raise InputError(path, "", found, f"the header of {_WHAT}", _EXPORT_MOT, "header")
    message = "no line endheader"
    action = "the row that starts with time is taken as names"
    findings.append(Finding("header_absent", "warning", path.name, f"line {named + 1}", message, action))
    return named


def _keys(lines: list[str]) -> dict[str, str]:
    """Values by lower-case key, of ``key=value`` lines and of a SIMM header."""
    out = {}
    for line in lines:
        simm = _SIMM.fullmatch(line.strip())
        if "=" in line:
            key, value = line.split("=", 1)
            out[key.strip().lower()] = value.strip()
        elif simm:
            out.setdefault(simm[1].lower(), simm[2].strip())
    return out


def _elements(path: Path, header: dict[str, str]) -> int:
    data_type = header.get("datatype", "double")
    count = _ELEMENTS.get(data_type.lower())
    if count is None:
        expected = ", ".join(_ELEMENTS)
        raise InputError(path, "DataType", data_type, expected, _EXPORT_MOT, "data_type")
    return count


def _names(path: Path, lines: Lines, at: int) -> list[str]:
    names = stripped(cells_of(lines[at])) if at < len(lines) else []
    if "time" not in [name.lower() for name in names]:
        found = repr(names[0]) if names else "nothing after endheader"
        expected = "a row of column names that starts with time"
        raise InputError(path, f"line {at + 1}", found, expected, _EXPORT_MOT, "columns")
    check_number_of_names(path, f"line {at + 1}", names, _EXPORT_MOT)
    twice = repeated(names)
    if twice or not all(names):
        found = f"twice: {', '.join(twice)}" if twice else "a column without a name"
        raise InputError(path, f"line {at + 1}", found, "one name per column", _EXPORT_MOT, "names")
    return names


def _table(
    path: Path, lines: Lines, rows: np.ndarray, width: int, time_column: int, elements: int
) -> np.ndarray:
    """Numbers (n, width, elements); the time fills the first element of its column."""
    if elements == 1:
        expected = "as in the row of names"
        return read_table(path, lines, rows, width, expected, blank=False)[:, :, None]
    flat = []
    for i in rows:
        cells = stripped(cells_of(lines[i].replace(", ", ",")))
        counts = [1 if c == time_column else cell.count(",") + 1 for c, cell in enumerate(cells)]
        expected_counts = [1 if c == time_column else elements for c in range(width)]
        if counts != expected_counts:
            found, expected = (
                f"{len(cells)} cells of {counts} numbers",
                f"{width} cells of {elements} numbers",
            )
            raise InputError(path, f"line {i + 1}", found, expected, _AGAIN, "row_cells")
        flat.append(re.sub(r"[~\[\]]", "", "\t".join(cells)).replace(",", "\t"))
    numbers = read_table(
        path, flat, np.arange(len(flat)), (width - 1) * elements + 1, f"{elements} in each", blank=False
    )
    out = np.full((len(rows), width, elements), np.nan)
    starts = np.cumsum([0] + [1 if c == time_column else elements for c in range(width)])
    for c in range(width):
        span = numbers[:, starts[c] : starts[c + 1]]
        out[:, c, : span.shape[1]] = span
    return out


def _without_repeated_end(
    path: Path, table: np.ndarray, time_column: int, rows: np.ndarray, findings: list[Finding]
) -> np.ndarray:
    """Return the table without a last row that repeats the time of the row before, as RRA, CMC and forward write it."""
    time_s = table[:, time_column, 0]
    if len(time_s) < 3 or time_s[-1] != time_s[-2]:
        return table
    same = np.array_equal(table[-1], table[-2], equal_nan=True)
    message = f"time {time_s[-1]:g} in the last two rows, " + ("the same values" if same else "other values")
    severity, place = "info" if same else "warning", f"line {rows[-1] + 1}"
    findings.append(Finding("time_repeated", severity, path.name, place, message, "the last row is left out"))
    return table[:-1]


def _check_counts(
    path: Path, header: dict[str, str], rows: int, columns: int, findings: list[Finding]
) -> None:
    for key, there in (("nrows", rows), ("ncolumns", columns), ("datarows", rows), ("datacolumns", columns)):
        if key in header and header[key] != str(there):
            message = f"{header[key]} declared, {there} there"
            findings.append(Finding("count", "warning", path.name, key, message, "the data are used"))


def _coordinates(path: Path, storage: StorageRecording, findings: list[Finding]) -> dict[str, np.ndarray]:
    """Columns by coordinate; of state paths (``/jointset/.../knee_angle_r/value``) the coordinates only."""
    names = list(storage.columns)
    elements = storage.columns[names[0]].shape[1]
    if elements != 1:
        found = f"DataType={storage.header['datatype']}"
        raise InputError(path, "DataType", found, "coordinates (double)", _EXPORT_MOT, "wrong_kind")
    _check_quantity(path, storage)
    columns: dict[str, np.ndarray] = {}
    others = 0
    for name, values in storage.columns.items():
        state = _STATE.match(name)
        speed = name.endswith("_u") and name.removesuffix("_u") in storage.columns
        if speed or (name.startswith("/") and not state) or _MUSCLE_STATE.search(name):
            others += 1
            continue
        own = state[1] if state else name
        if own in columns:
            remedy = "name the coordinates apart"
            raise InputError(path, f"column {name}", f"two columns {own}", "one", remedy, "names")
        columns[own] = values[:, 0].copy()
    if others:
        message = f"{others} columns of speeds or other states"
        findings.append(Finding("other_states", "info", path.name, "", message, "left out"))
    if not columns:
        found, expected = f"states without a coordinate ({names[0]}, ...)", "coordinates (pelvis_tilt, ...)"
        raise InputError(path, "", found, expected, _EXPORT_MOT, "wrong_kind")
    return columns


def _check_quantity(path: Path, storage: StorageRecording) -> None:
    """Refuse tables of forces, speeds or accelerations; states may lie beside coordinates (``/forceset/...``)."""
    title = storage.header_lines[0].strip().lower() if storage.header_lines else ""
    plain = [name for name in storage.columns if not name.startswith("/")]
    forces = any(_FORCES.search(name) for name in plain)
    if forces and not any(name.endswith("pelvis_tilt") for name in plain):
        found = f"forces ({plain[0]}, ...)"
    elif title in ("speeds", "accelerations"):
        found = f"{title} ({storage.header_lines[0].strip()!r} in line 1)"
    else:
        return
    raise InputError(path, "", found, "coordinates (pelvis_tilt, ...)", _EXPORT_MOT, "wrong_kind")


def _in_degrees(
    path: Path, storage: StorageRecording, angles: dict[str, np.ndarray], findings: list[Finding]
) -> bool:
    """Return whether the rotations are in degrees by the header, and check radians against what they can be."""
    stated = storage.header.get("indegrees", "").lower()
    written = any(line.strip().lower().startswith("angles are in degrees") for line in storage.header_lines)
    if stated[:1] in ("y", "t", "1") or (not stated and written):
        return True
    rotations = list(angles.values())
    largest = float(np.nanmax(np.abs(rotations))) if rotations and np.isfinite(rotations).any() else 0.0
    if not stated:
        if largest > _IMPOSSIBLE_RAD:
            found = f"no inDegrees line, and values up to {largest:.4g} that cannot be radians"
            expected, remedy = "inDegrees=yes or inDegrees=no", "add the line that is true"
            raise InputError(path, "header", found, expected, remedy, "units_ambiguous")
        action = "taken as radians (OpenSim's rule)"
        findings.append(Finding("units_absent", "warning", path.name, "header", "no inDegrees line", action))
    elif stated[:1] not in ("n", "f", "0"):
        expected, remedy = "yes or no", "write the line that is true"
        raise InputError(path, "inDegrees", stated, expected, remedy, "units_ambiguous")
    elif largest > _IMPOSSIBLE_RAD or written:
        message = f"inDegrees={stated}, yet " + (
            "the text says degrees" if written else f"values up to {largest:.4g}"
        )
        action = "taken as radians as stated"
        findings.append(Finding("units_doubtful", "warning", path.name, "header", message, action))
    return False


def flexes_negative(angle: np.ndarray) -> bool:
    """Return whether a knee angle (n,) [rad] counts flexion negative, as gait2392, gait2354 and gait10dof have it."""
    known = angle[np.isfinite(angle)]
    if not len(known):
        return False
    low, high = float(known.min()), float(known.max())
    return low < -_BENT_RAD and -low > 2 * high


def _check_knee(path: Path, columns: dict[str, np.ndarray], findings: list[Finding]) -> None:
    """Report knees that flex to the negative side: gait2392, gait2354 and gait10dof, unlike Rajagopal."""
    for name in ("knee_angle_r", "knee_angle_l"):
        values = columns.get(name)
        if values is not None and flexes_negative(values):
            low, high = np.nanmin(values), np.nanmax(values)
            span = f"{np.degrees(low):.0f} to {np.degrees(high):.0f} deg"
            message = f"{span}: flexion negative, as in gait2392; Rajagopal has it positive"
            findings.append(Finding("knee_sign", "warning", path.name, name, message, "left as it is"))
