"""One way to read a file: its format is told by its content, and its extension only compared."""

from __future__ import annotations

from collections.abc import Collection
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from real2sim.errors import InputError
from real2sim.recording.formats import c3d, mcap_file, opensim, qualisys, qualisys_mat, robot_log, trc
from real2sim.recording.formats.recordings import CoordinateRecording, Finding, MarkerRecording, RobotLog
from real2sim.recording.formats.text import refuse_utf_16

if TYPE_CHECKING:
    from real2sim.settings import IngestRobotLogStampsSettings

# By format: what it is called, its extensions, and what reads it.
FORMATS: dict[str, tuple[str, tuple[str, ...]]] = {
    "tsv": ("a QTM TSV export", (".tsv", ".txt")),
    "c3d": ("a C3D", (".c3d",)),
    "mat": ("a QTM MAT export", (".mat",)),
    "storage": ("an OpenSim .mot or .sto", (".mot", ".sto")),
    "trc": ("a .trc", (".trc",)),
    "mcap": ("an MCAP log", (".mcap",)),
}
_HEAD = 1 << 16
_REMEDY_LOG = "convert the log to MCAP, the only format that is read, or leave it out (it is optional)"
_QTM_KEYS = (
    b"NO_OF_FRAMES",
    b"NO_OF_SAMPLES",
    b"NO_OF_MARKERS",
    b"DATA_INCLUDED",
    b"MARKER_NAMES",
    b"FREQUENCY\t",
)


def detect(path: Path, expected: str = "", remedy: str = "") -> str:
    """Name of a file's format, a key of `FORMATS`. Raises InputError where its content is none of them."""
    path = Path(path)
    expected = expected or ", ".join(name for name, _ in FORMATS.values())
    remedy = remedy or "export the file again in one of these formats"
    try:
        if path.exists() and not path.is_file():
            # opening a pipe would wait for ever
            found = "a folder" if path.is_dir() else "a pipe, socket or device"
            raise InputError(path, "", found, expected, "put the file itself there", "no_file")
        with path.open("rb") as stream:
            head = stream.read(_HEAD)
    except OSError as error:
        raise InputError(path, "", f"{error.strerror or error}", expected, remedy, "unreadable") from error
    if not head.strip():
        raise InputError(path, "", "an empty file", expected, remedy, "empty")
    kind = _by_content(head)
    if kind is None:
        refuse_utf_16(path, head, expected)
        found = (
            "binary data of an unknown kind" if b"\0" in head else f"a file that starts with {head[:40]!r}"
        )
        raise InputError(path, "", found, expected, remedy, "unknown_format")
    return kind


def _by_content(head: bytes) -> str | None:
    if mcap_file.is_mcap(head):
        return "mcap"
    if qualisys_mat.is_mat(head):
        return "mat"
    if c3d.is_c3d(head):
        return "c3d"
    if b"\0" in head:
        return None
    text = head.removeprefix(b"\xef\xbb\xbf")
    lines = text.splitlines()
    if text.startswith(b"PathFileType"):
        return "trc"
    if any(line.startswith(_QTM_KEYS) for line in lines[:50]):
        return "tsv"
    lowered = [line.strip(b", \t").lower() for line in lines[:1000]]
    if b"endheader" in lowered or any(line.startswith(b"time") for line in lowered):
        return "storage"
    return None


def _detected(
    path: Path, wanted: tuple[str, ...], what: str, findings: list[Finding], remedy: str = ""
) -> str:
    """Format of a file that must be one of some, with a finding where its extension says another."""
    expected = f"{what} ({', '.join(FORMATS[key][0] for key in wanted)})"
    kind = detect(path, expected, remedy)
    name, suffixes = FORMATS[kind]
    if kind not in wanted:
        remedy = remedy or "export the file in one of these formats, or name it as what it is"
        if kind == "storage" and not _has_end_of_header(path):
            name = "a table of text, such as a CSV"
        raise InputError(path, "", name, expected, remedy, "wrong_kind")
    if path.suffix.lower() not in suffixes:
        message = f"{path.suffix or 'no extension'}, but the content is {name}"
        findings.append(Finding("extension", "warning", path.name, "", message, "read by its content"))
    return kind


def _has_end_of_header(path: Path) -> bool:
    """Return whether a text has the line that ends the header of a .mot or .sto: only by it is it surely one."""
    with path.open("rb") as stream:
        return b"endheader" in stream.read(_HEAD).lower()


def read_markers(path: Path) -> MarkerRecording:
    """Read the markers of a QTM export: TSV (3D), C3D or MAT. Raises InputError where it is none of them."""
    path = Path(path)
    findings: list[Finding] = []
    kind = _detected(path, ("tsv", "c3d", "mat"), "markers", findings)
    readers = {"tsv": qualisys.read_markers, "c3d": c3d.read_c3d, "mat": qualisys_mat.read_mat}
    recording = readers[kind](path)
    recording.findings[:0] = findings
    return recording


def read_markerless(
    path: Path, *, translations: Collection[str] = (), rotations: Collection[str] = ()
) -> CoordinateRecording | MarkerRecording:
    """Read a markerless export: coordinates (.mot, .sto) or landmarks (.trc). Raises InputError otherwise.

    ``translations`` and ``rotations`` name coordinates whose names do not tell what they are.
    """
    path = Path(path)
    findings: list[Finding] = []
    kind = _detected(path, ("storage", "trc"), "coordinates or landmarks", findings)
    recording: CoordinateRecording | MarkerRecording
    if kind == "storage":
        recording = opensim.read_coordinates(path, translations=translations, rotations=rotations)
    else:
        recording = trc.read_landmarks(path)
    recording.findings[:0] = findings
    return recording


def read_log(
    path: Path, stamps: IngestRobotLogStampsSettings | None = None, max_gap_s: float = np.inf
) -> RobotLog:
    """Read a robot log; ``stamps`` and ``max_gap_s`` as of `robot_log.read_log`.

    Raises InputError where the file is no MCAP or lacks the robot's topics.
    """
    path = Path(path)
    findings: list[Finding] = []
    _detected(path, ("mcap",), "a robot log", findings, _REMEDY_LOG)
    log = robot_log.read_log(path, stamps, max_gap_s)
    log.findings[:0] = findings
    return log


def read(path: Path) -> Any:
    """Read a file as whatever it is: markers, rigid bodies, an OpenSim table, landmarks or a robot log."""
    kind = detect(path)
    if kind == "tsv":
        bodies = qualisys.data_included(path) == "6D"
        return qualisys.read_bodies(path) if bodies else qualisys.read_markers(path)
    readers = {
        "c3d": c3d.read_c3d,
        "mat": qualisys_mat.read_mat,
        "storage": opensim.read_storage,
        "trc": trc.read_landmarks,
        "mcap": robot_log.read_log,
    }
    return readers[kind](path)
