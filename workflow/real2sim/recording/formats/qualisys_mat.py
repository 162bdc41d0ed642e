"""Qualisys Track Manager: marker trajectories as MAT (MATLAB 5 structs).

One struct named after the file: ``StartFrame``, ``Frames``, ``FrameRate``, ``Trajectories.Labeled`` with
``Labels``, ``Data`` (marker x 4 x frame: x, y, z [mm], residual) and ``Type`` (marker x frame).
"""

from __future__ import annotations

import struct
import zlib
from pathlib import Path
from typing import Any

import numpy as np

from real2sim.errors import InputError
from real2sim.recording.formats.c3d import unique_names
from real2sim.recording.formats.mat5 import variables
from real2sim.recording.formats.qualisys import MM_PER_M, finding, known_positions
from real2sim.recording.formats.recordings import Event, Finding, Length, MarkerRecording
from real2sim.recording.formats.text import read_bytes

_EXPORT = "in QTM choose File > Export > To MAT, or To TSV with the data type 3D"
_FAR_M = 1e6
_HDF5 = b"\x89HDF\r\n\x1a\n"
# Codes of Type (QTM manual, MAT export): 0 missing, 1 measured, 2 gap-filled, 3 virtual, 4 edited
_MISSING, _MEASURED = 0, 1


def is_mat(raw: bytes) -> bool:
    """Return whether a file is a MATLAB 5 file, or the HDF5 file that MATLAB 7.3 writes."""
    return raw[126:128] in (b"IM", b"MI") or raw.startswith(_HDF5) or raw[512:520] == _HDF5


def read_mat(path: Path) -> MarkerRecording:
    """Read the labelled trajectories of a QTM MAT export; positions and residuals [m], NaN where missing.

    Raises InputError where the file is damaged or holds no labelled trajectories.
    """
    path = Path(path)
    raw = read_bytes(path, "a QTM MAT export", _EXPORT)
    if raw.startswith(_HDF5) or raw[512:520] == _HDF5:
        remedy = "save it again in MATLAB with -v7, or export it from QTM"
        raise InputError(path, "", "a MATLAB 7.3 file (HDF5)", "a MATLAB 5 file", remedy, "mat_version")
    if not is_mat(raw):
        raise InputError(path, "", f"a file that starts with {raw[:8]!r}", "a MAT", _EXPORT, "header")
    try:
        content = variables(raw)
    except (ValueError, struct.error, zlib.error) as error:
        expected = "a complete MAT"
        raise InputError(path, "", f"a damaged file ({error})", expected, _EXPORT, "damaged") from error
    recordings = [v for v in content.values() if isinstance(v, dict) and "Trajectories" in v]
    if len(recordings) != 1:
        found = f"variables {', '.join(content) or 'none'}, of which {len(recordings)} have Trajectories"
        raise InputError(path, "", found, "one QTM recording", _EXPORT, "wrong_kind")
    return _recording(path, recordings[0])


def _field(path: Path, value: Any, *names: str) -> Any:
    for name in names:
        if not isinstance(value, dict) or name not in value:
            fields = ", ".join(value) if isinstance(value, dict) else "no struct"
            raise InputError(path, ".".join(names), fields, name, _EXPORT, "field_missing")
        value = value[name]
    return value


def _number(path: Path, value: Any, name: str) -> float:
    number = _field(path, value, name)
    if not isinstance(number, np.ndarray) or number.size != 1 or not np.isfinite(number).all():
        raise InputError(path, name, f"{number!r}"[:100], "one number", _EXPORT, "damaged")
    return float(number.reshape(()))


def _recording(path: Path, root: dict[str, Any]) -> MarkerRecording:
    findings: list[Finding] = []
    labeled = _field(path, root, "Trajectories", "Labeled")
    labels, data = _field(path, labeled, "Labels"), _field(path, labeled, "Data")
    if isinstance(labels, str):
        labels = [labels]
    shaped = isinstance(data, np.ndarray) and isinstance(labels, list) and labels
    if not shaped or (*data.shape, 1)[:2] != (len(labels), 4) or data.ndim > 3 or not data.size:
        found = f"{len(labels) if isinstance(labels, list) else 0} labels and Data {np.shape(data)}"
        expected = "Data of marker x 4 x frame"
        raise InputError(path, "Trajectories.Labeled", found, expected, _EXPORT, "columns")
    blocks = data.reshape(len(labels), 4, -1).astype(float) / MM_PER_M
    frames = blocks.shape[2]
    rate, start = _number(path, root, "FrameRate"), _number(path, root, "StartFrame")
    if not 0 < rate < 1e6 or start != round(start) or abs(start) > 2**31:
        found = f"FrameRate {rate:g}, StartFrame {start:g}"
        raise InputError(path, "", found, "a rate, and a whole frame number", _EXPORT, "rate")
    length = _check_frames(path, root, frames, findings)
    names = unique_names(path, [str(label).strip() for label in labels], "Labels", findings)
    missing = _types(path, labeled, (len(labels), frames), findings) == _MISSING
    blocks.transpose(0, 2, 1)[missing] = np.nan
    if np.isinf(blocks).any() or np.abs(np.nan_to_num(blocks[:, :3])).max() > _FAR_M:
        found = "values that are infinite, or astronomic"
        raise InputError(path, "Data", found, "positions", _EXPORT, "not_finite")
    positions = known_positions(path, blocks[:, :3].transpose(2, 0, 1).copy(), names, findings)
    residuals = {name: blocks[i, 3].copy() for i, name in enumerate(names)}
    time_s = (start - 1 + np.arange(frames)) / rate
    events = _events(path, root, findings)
    return MarkerRecording(time_s, rate, positions, int(start), findings, events, residuals, length)


def _check_frames(path: Path, root: dict[str, Any], frames: int, findings: list[Finding]) -> Length | None:
    """Return the length of the recording, None where no number of frames is declared; report a wrong one."""
    if "Frames" not in root:
        return None
    declared = _number(path, root, "Frames")
    if declared != frames:
        message = f"{declared:g} declared, {frames} there"
        findings.append(finding("count", "warning", path, "Frames", message))
    return Length(int(declared), frames)


def _types(path: Path, labeled: Any, shape: tuple[int, int], findings: list[Finding]) -> np.ndarray:
    """Type codes (marker, frame), measured where there are none; what QTM filled or moved is reported."""
    codes = labeled.get("Type")
    if not isinstance(codes, np.ndarray) or codes.size != shape[0] * shape[1]:
        return np.full(shape, _MEASURED)
    codes = codes.reshape(shape)
    made = int(((codes != _MISSING) & (codes != _MEASURED)).sum())
    if made:
        message = f"{made} samples that were filled, virtual or edited in QTM"
        findings.append(finding("not_measured", "info", path, "Type", message, "used as exported"))
    return codes


def _events(path: Path, root: dict[str, Any], findings: list[Finding]) -> list[Event]:
    """Events with their times on the clock of the recording."""
    entries = root.get("Events", [])
    events = []
    for entry in [entries] if isinstance(entries, dict) else entries if isinstance(entries, list) else []:
        time = entry.get("Time") if isinstance(entry, dict) else None
        if isinstance(time, np.ndarray) and time.size == 1:
            events.append(Event(float(time.reshape(())), str(entry.get("Label", ""))))
    if events:
        message = ", ".join(f"{event.label} at {event.time_s:.3f} s" for event in events[:12])
        findings.append(finding("event", "info", path, "Events", message, "kept as event"))
    return events
