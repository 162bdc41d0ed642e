"""C3D files (c3d.org): point trajectories with residuals, as QTM and others export them.

Read by our own code, every offset checked: on damaged headers ezc3d crashes the process or asks for tens of
gigabytes. On whole files both give the same numbers (tests/unit/test_third_party.py).
https://www.c3d.org/docs/C3D_User_Guide.pdf
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from real2sim.errors import InputError
from real2sim.recording.formats.qualisys import finding, known_positions
from real2sim.recording.formats.recordings import Event, Finding, MarkerRecording
from real2sim.recording.formats.text import read_bytes, repeated
from real2sim.recording.formats.trc import UNITS_PER_M

_EXPORT = "export the trial again as C3D, or as TSV (3D)"
_BLOCK = 512
_FAR_M = 1e6
_FASTEST_HZ = 1e6
_SINGLE = 1e-5  # the file's floats have single precision
_PROCESSORS = {84: "<", 85: "<", 86: ">"}  # Intel, DEC (whose integers are Intel's), MIPS
_SIZES = {-1: 1, 1: 1, 2: 2, 4: 4}

_PADDING = " \t\r\n\0"  # of strings: blanks by the standard, null bytes by OptiTrack and Motion Analysis

_Groups = dict[str, dict[str, tuple[int, tuple[int, ...], bytes]]]  # group, name: type, dimensions, data


def is_c3d(raw: bytes) -> bool:
    """Return whether a file starts as a C3D does: the block of the parameters, then 0x50."""
    return len(raw) > 1 and raw[1] == 0x50 and 2 <= raw[0] < 64


def read_c3d(path: Path) -> MarkerRecording:
    """Read the points of a C3D; positions and residuals [m], NaN where the residual is negative.

    Frames keep the numbers of the original recording, and times and events its clock: frame 1 is time 0.
    Raises InputError where the file is damaged, has no points, does not say its unit or rate, or where header and
    parameters contradict each other.
    """
    path = Path(path)
    raw = read_bytes(path, "a C3D", _EXPORT)
    if not is_c3d(raw):
        raise InputError(path, "", f"a file that starts with {raw[:4]!r}", "a C3D", _EXPORT, "header")
    findings: list[Finding] = []
    try:
        groups = _parameters(raw)
        extent = _extent(path, raw, groups)
        _check_layout(path, groups, extent, findings)
        values, residual = _data(raw, groups, extent)
    except (ValueError, struct.error, IndexError, KeyError) as error:
        expected = "a complete C3D"
        raise InputError(path, "", f"a damaged header ({error})", expected, _EXPORT, "damaged") from error
    _check_residuals(path, groups, values, residual, findings)
    return _recording(path, groups, values, residual, extent, findings)


# -------------------- layout


def _parameters(raw: bytes) -> _Groups:
    """Parameters by group and name: type, dimensions, data. Raises ValueError where they leave their section."""
    start = (raw[0] - 1) * _BLOCK
    blocks, processor = raw[start + 2], raw[start + 3]
    if processor not in _PROCESSORS:
        raise ValueError(f"processor type {processor}")
    order = _PROCESSORS[processor]
    end = min(len(raw), start + max(blocks, 1) * _BLOCK)
    at, names, found = start + 4, {}, []
    while at + 2 <= end and raw[at]:
        length = abs(struct.unpack_from("b", raw, at)[0])
        (group,) = struct.unpack_from("b", raw, at + 1)
        link = at + 2 + length
        (offset,) = struct.unpack_from(f"{order}h", raw, link)
        name = raw[at + 2 : link].decode("latin-1").strip().upper()
        if group < 0:
            names[-group] = name
        elif group > 0:
            found.append((group, name, _parameter(raw, link + 2, end)))
        if offset == 0:
            break
        if offset < 0 or link + offset > end:
            raise ValueError(f"parameter {name} points out of its section")
        at = link + offset
    out: _Groups = {}
    for group, name, value in found:
        out.setdefault(names.get(group, ""), {})[name] = value
    out[""] = out.get("", {}) | {"ORDER": (processor, (), order.encode())}
    return out


def _parameter(raw: bytes, at: int, end: int) -> tuple[int, tuple[int, ...], bytes]:
    (kind,) = struct.unpack_from("b", raw, at)
    if kind not in _SIZES or raw[at + 1] > 7:
        raise ValueError(f"parameter of type {kind} with {raw[at + 1]} dimensions")
    count = raw[at + 1]
    dimensions = tuple(raw[at + 2 : at + 2 + count])
    size = _SIZES[kind] * int(np.prod(dimensions, dtype=np.int64))
    data = raw[at + 2 + count : at + 2 + count + size]
    if len(data) < size or at + 2 + count + size > end:
        raise ValueError("parameter longer than its section")
    return kind, dimensions, data


def _floats(groups: _Groups, group: str, name: str) -> np.ndarray:
    """Numbers of a parameter, of whichever processor; empty where it is not there."""
    _, _, order = groups[""]["ORDER"]
    kind, _, data = groups.get(group, {}).get(name, (1, (), b""))
    if kind == 4:
        return _real(groups, data)
    return np.frombuffer(data, order.decode() + {-1: "u1", 1: "u1", 2: "i2"}[kind]).astype(float)


def _real(groups: _Groups, data: bytes) -> np.ndarray:
    """Floats of whichever processor: DEC's have their halves swapped and four times the value."""
    processor, _, order = groups[""]["ORDER"]
    with np.errstate(invalid="ignore"):  # what is no number is found later, and named
        if processor == 85:
            swapped = np.frombuffer(data, "<u2").reshape(-1, 2)[:, ::-1].tobytes()
            return np.frombuffer(swapped, "<f4").astype(float) / 4
        return np.frombuffer(data, f"{order.decode()}f4").astype(float)


def _texts(groups: _Groups, group: str, name: str) -> list[str]:
    """Strings of a parameter, and of its continuations NAME2, NAME3, ..."""
    out: list[str] = []
    for part in (name, *(f"{name}{i}" for i in range(2, 20))):
        kind, dimensions, data = groups.get(group, {}).get(part, (-1, (), b""))
        if kind != -1 or not dimensions:
            continue
        width = max(dimensions[0], 1)
        out += [data[i : i + width].decode("latin-1").strip(_PADDING) for i in range(0, len(data), width)]
    return out


@dataclass(frozen=True)
class _Extent:
    """Layout of the data by the header.

    Points and analog words per frame, first frame, frames, offset [bytes], scale (< 0: floats), rate [Hz], analog
    samples of a channel per frame, and bytes of the file from the offset on.
    """

    points: int
    analogs: int
    first: int
    frames: int
    offset: int
    scale: float
    rate: float
    samples: int
    size_there: int

    def fits(self, analogs: int) -> bool:
        """Return whether a number of analog words per frame leaves less than one block of the file over."""
        size = (4 if self.scale < 0 else 2) * (4 * self.points + analogs) * self.frames
        return 0 <= self.size_there - size < _BLOCK


def _extent(path: Path, raw: bytes, groups: _Groups) -> _Extent:
    """Extent of the data by the header; the file must hold them."""
    order = groups[""]["ORDER"][2].decode()
    points, analogs, first, last = struct.unpack_from(f"{order}4H", raw, 2)
    used = _number(groups, "POINT", "USED")
    if not points and used in (None, 0):
        found = f"no points, {analogs} analog samples per frame"
        remedy = "export the trial with its 3D trajectories"
        raise InputError(path, "header", found, "the trajectories of markers", remedy, "no_data")
    if used is not None and used != points:
        raise _contradiction(path, "POINT:USED", f"{used:g} points, {points} in the header")
    (block,) = struct.unpack_from(f"{order}H", raw, 16)
    scale, rate = _real(groups, raw[12:16] + raw[20:24]).tolist()
    (samples,) = struct.unpack_from(f"{order}H", raw, 18)
    frames = _long_frames(groups, first, last - first + 1) if last == 65535 else last - first + 1
    size = (4 if scale < 0 else 2) * (4 * points + analogs)
    there = (len(raw) - (block - 1) * _BLOCK) // size if size else 0
    if block < 2 or not points or not 0 < frames <= there or not np.isfinite(scale) or not scale:
        raise ValueError(
            f"{points} points and {frames} frames declared, {there} frames there, scale {scale:g}"
        )
    offset = (block - 1) * _BLOCK
    return _Extent(points, analogs, first, frames, offset, scale, rate, samples, len(raw) - offset)


def _number(groups: _Groups, group: str, name: str) -> float | None:
    """Return the number of a parameter that holds one, None where it is not there or not finite."""
    values = _floats(groups, group, name)
    return float(values[0]) if len(values) and np.isfinite(values[0]) else None


def _contradiction(path: Path, place: str, found: str) -> InputError:
    expected = "the same in header and parameters: positions cannot be told from other numbers otherwise"
    return InputError(path, place, found, expected, _EXPORT, "c3d_contradiction")


def _check_layout(path: Path, groups: _Groups, extent: _Extent, findings: list[Finding]) -> None:
    """Refuse parameters that lay out the data otherwise than the header, which would shift or scale positions."""
    scale = _number(groups, "POINT", "SCALE")
    found = f"scale {scale or 0:g}, {extent.scale:g} in the header"
    other_type = scale and (scale < 0) != (extent.scale < 0) and not extent.fits(extent.analogs)
    integers = extent.scale > 0  # floats are not scaled
    if scale and (
        other_type or (integers and not np.isclose(abs(scale), extent.scale, rtol=_SINGLE, atol=0))
    ):
        raise _contradiction(path, "POINT:SCALE", found)
    start = _number(groups, "POINT", "DATA_START")
    if start and int(start) % 65536 != extent.offset // _BLOCK + 1:
        message = f"data from block {start:g}, {extent.offset // _BLOCK + 1} in the header"
        findings.append(finding("count", "warning", path, "POINT:DATA_START", message, "the header is used"))
    frames = _number(groups, "POINT", "FRAMES")
    if frames and int(frames) % 65536 not in (extent.frames % 65536, 65535):
        message = f"{int(frames) % 65536} frames declared, {extent.frames} by the header"
        findings.append(finding("count", "warning", path, "POINT:FRAMES", message, "the header is used"))
    channels = _number(groups, "ANALOG", "USED")
    if channels is None or channels * extent.samples == extent.analogs:
        return
    message = (
        f"{channels:g} channels of {extent.samples} samples, {extent.analogs} words per frame in the header"
    )
    if not extent.fits(extent.analogs) or extent.fits(int(channels * extent.samples)):
        raise _contradiction(path, "ANALOG:USED", message)
    action = "the header is used: it fits the size of the file"
    findings.append(finding("count", "warning", path, "ANALOG:USED", message, action))


def _long_frames(groups: _Groups, first: int, frames: int) -> int:
    """Frames of a recording beyond 65535, of which the header cannot tell the last."""
    long = _floats(groups, "POINT", "LONG_FRAMES")
    if len(long) and long[0] > 0:
        return int(long[0])
    words = _floats(groups, "TRIAL", "ACTUAL_END_FIELD")
    if len(words) == 2:
        return int(words[0] % 65536 + 65536 * (words[1] % 65536)) - first + 1
    return frames


# -------------------- values


def _data(raw: bytes, groups: _Groups, extent: _Extent) -> tuple[np.ndarray, np.ndarray]:
    """Positions (frames, points, 3) and residuals (frames, points) in the file's unit; residual -1: missing."""
    words, real = 4 * extent.points + extent.analogs, extent.scale < 0
    data = raw[extent.offset : extent.offset + (4 if real else 2) * words * extent.frames]
    order = groups[""]["ORDER"][2].decode()
    flat = _real(groups, data) if real else np.frombuffer(data, f"{order}i2")
    table = flat.reshape(extent.frames, words)[:, : 4 * extent.points].astype(float)
    table = table.reshape(extent.frames, extent.points, 4)
    fourth = table[:, :, 3]
    # The fourth word: negative for a missing point, else cameras in the high byte, residual in the low one.
    missing = ~((fourth >= 0) & (fourth < 65536))
    residual = np.where(missing, 0, fourth).astype(int) % 256 * abs(extent.scale)
    return table[:, :, :3] * (1.0 if real else extent.scale), np.where(missing, -1.0, residual)


def _check_residuals(
    path: Path, groups: _Groups, values: np.ndarray, residual: np.ndarray, findings: list[Finding]
) -> None:
    """Report points whose residual says missing in every frame though they have positions; refuse all of them."""
    never = np.asarray((residual < 0).all(axis=0))
    with_positions = never & (np.isfinite(values) & (values != 0)).all(axis=2).any(axis=0)
    if never.all():
        found = f"residual words that say missing in all frames of all {len(never)} points"
        if with_positions.any():
            found += f", {int(with_positions.sum())} of which have positions"
        raise InputError(path, "", found, "a residual of 0 or more where seen", _EXPORT, "no_data")
    if with_positions.any():
        labels = _texts(groups, "POINT", "LABELS")
        names = [labels[i] if i < len(labels) else f"#{i + 1}" for i in np.flatnonzero(with_positions)]
        message = f"the residual says missing in all frames, though there are positions: {', '.join(names)}"
        findings.append(finding("residual_missing", "warning", path, "", message, "taken as missing"))


def _rate(path: Path, groups: _Groups, extent: _Extent, findings: list[Finding]) -> float:
    """Return the rate [Hz] of POINT:RATE, which must be the header's; the header's where the parameter is missing."""
    stated, header = _number(groups, "POINT", "RATE"), extent.rate
    known: list[float] = [rate for rate in (stated, header) if rate is not None and 0 < rate < _FASTEST_HZ]
    if not known:
        found = f"{stated or 0:g} Hz, {header:g} Hz in the header"
        raise InputError(path, "POINT:RATE", found, "the rate in Hz", _EXPORT, "rate")
    # Some headers round the rate to a whole number.
    if len(known) == 2 and known[1] != round(known[0]) and abs(known[1] / known[0] - 1) > _SINGLE:
        found, remedy = (
            f"{known[0]:g} Hz, {known[1]:g} Hz in the header",
            "export again, or correct the wrong one",
        )
        raise InputError(path, "POINT:RATE", found, "the same in both", remedy, "rate")
    if stated is None or stated not in known:
        message = f"no rate, {header:g} Hz in the header"
        findings.append(finding("rate_header", "info", path, "POINT:RATE", message, "the header is used"))
    return known[0]


def _recording(
    path: Path,
    groups: _Groups,
    values: np.ndarray,
    residual: np.ndarray,
    extent: _Extent,
    findings: list[Finding],
) -> MarkerRecording:
    names = _labels(path, groups, values.shape[1], findings)
    rate = _rate(path, groups, extent, findings)
    unit = (_texts(groups, "POINT", "UNITS") or [""])[0]
    if unit.lower() not in UNITS_PER_M:
        expected = ", ".join(UNITS_PER_M)
        raise InputError(path, "POINT:UNITS", repr(unit) if unit else "nothing", expected, _EXPORT, "units")
    scale = UNITS_PER_M[unit.lower()]
    # The coordinates of a missing point are 0 in the file and mean nothing; some write NaN.
    values = np.where((residual < 0)[:, :, None], np.nan, values / scale)
    if np.isinf(values).any() or np.abs(np.nan_to_num(values)).max() > _FAR_M:
        found = "values that are infinite, or astronomic"
        raise InputError(path, "", found, "positions", _EXPORT, "not_finite")
    positions = known_positions(path, values, names, findings)
    residuals = np.where((residual < 0) | np.isnan(values).any(axis=2), np.nan, residual / scale)
    time_s = (extent.first - 1 + np.arange(len(values))) / rate
    by_name = {name: residuals[:, i].copy() for i, name in enumerate(names)}
    events = _events(path, groups, findings)
    return MarkerRecording(time_s, rate, positions, extent.first, findings, events, by_name)


def _labels(path: Path, groups: _Groups, points: int, findings: list[Finding]) -> list[str]:
    """Names of the points; repeated and empty ones are numbered, so that none is taken for another."""
    labels = _texts(groups, "POINT", "LABELS")
    if len(labels) != points:
        message = f"{len(labels)} labels for {points} points"
        findings.append(finding("count", "warning", path, "POINT:LABELS", message, "the first are used"))
    return unique_names(path, [*labels[:points], *[""] * (points - len(labels))], "POINT:LABELS", findings)


def unique_names(path: Path, labels: list[str], place: str, findings: list[Finding]) -> list[str]:
    """Labels, each once: all that are repeated or empty get their position, and are reported."""
    odd = sorted({*repeated(labels), *([""] if "" in labels else [])})
    if odd:
        message = f"repeated or empty: {', '.join(label or '(empty)' for label in odd[:50])}"
        findings.append(finding("names_repeated", "warning", path, place, message, "numbered by position"))
    wrong = set(odd)
    return [f"{label} #{i + 1}".strip() if label in wrong else label for i, label in enumerate(labels)]


def _events(path: Path, groups: _Groups, findings: list[Finding]) -> list[Event]:
    """Events on the clock of the original recording: EVENT:TIMES is minutes and seconds."""
    labels, contexts = _texts(groups, "EVENT", "LABELS"), _texts(groups, "EVENT", "CONTEXTS")
    times = _floats(groups, "EVENT", "TIMES")
    used = int(np.append(_floats(groups, "EVENT", "USED"), 0)[0])
    if not used:
        return []
    if len(times) != 2 * used or len(labels) < used:
        message = f"{used} declared, {len(times) / 2:g} times and {len(labels)} labels"
        findings.append(finding("event", "warning", path, "EVENT", message, "left out"))
        return []
    seconds = times.reshape(-1, 2) @ [60.0, 1.0]
    who = contexts if len(contexts) >= used else [""] * used
    names = [f"{c} {label}".strip() for c, label in zip(who, labels, strict=False)]
    events = [Event(float(t), name) for t, name in zip(seconds, names, strict=False)]
    message = ", ".join(f"{event.label} at {event.time_s:.3f} s" for event in events[:12])
    findings.append(finding("event", "info", path, "EVENT", message, "kept as event"))
    return events
