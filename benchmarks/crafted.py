"""Memory and time of files that are crafted to cost much: at most 20 times the file, and 2 s per MB.

    python benchmarks/crafted.py [--only WORD] [--out table.csv]

Each case is read in a process of its own: memory is the growth of its largest resident size. Small files that unpack to
much are held to 100 MB and 1 s instead.
"""

from __future__ import annotations

import argparse
import csv
import io
import json
import os
import struct
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[1]
sys.path.insert(0, str(ROOT / "workflow"))

import numpy as np
from real2sim.configuration import read_yaml, validated
from real2sim.errors import InputError
from real2sim.recording.formats import detect, robot_log
from real2sim.recording.table import Recording
from real2sim.study.twin.checkpoint import UnusableCheckpoint, read_checkpoint
from real2sim.system.description import System, shipped
from real2sim.system.model_files import model_files

MOST_MEMORY, MOST_S_PER_MB = 20.0, 2.0
FLOOR_MB, FLOOR_S = 100.0, 1.0
MB = 1e6

Case = tuple[str, str, str, Callable[[Path, float], None], Callable[[Path], Any]]


# -------------------- text


def _text(head: str, row: Callable[[int], str], tail: str = "") -> Callable[[Path, float], None]:
    """A writer of a file of some MB: a head, rows by their numbers, a tail."""

    def write(path: Path, size: float) -> None:
        sample = len(row(1000))
        count = int(size * MB / max(sample, 1))
        path.write_text(head + "".join(row(i) for i in range(count)) + tail)

    return write


def _tsv_head(names: int, leading: bool = True) -> str:
    markers = [f"m{i}" for i in range(names)]
    columns = "\t".join(f"{m} {a}" for m in markers for a in "XYZ")
    line = f"Frame\tTime\t{columns}\n" if leading else ""
    return "NO_OF_FRAMES\t3\nFREQUENCY\t100\nMARKER_NAMES\t" + "\t".join(markers) + f"\n{line}"


def _wide_tsv(path: Path, size: float) -> None:
    count = int(size * MB / 40)
    names = [f"{i}" for i in range(count)]
    columns = "\t".join(f"{m} {a}" for m in names for a in "XYZ")
    row = "\t".join(["1"] * 3 * count)
    path.write_text("FREQUENCY\t100\nMARKER_NAMES\t" + "\t".join(names) + f"\n{columns}\n{row}\n{row}\n")


def _wide_mot(path: Path, size: float) -> None:
    count = int(size * MB / 9)
    names = "\t".join(f"{i}" for i in range(count))
    path.write_text(f"inDegrees=no\nendheader\ntime\t{names}\n" + "\t".join(["1"] * (count + 1)) + "\n")


def _wide_trc(path: Path, size: float) -> None:
    count = int(size * MB / 40)
    head = "PathFileType\t4\t(X/Y/Z)\ta\nDataRate\tUnits\n100\tm\nFrame#\tTime\t"
    names = "\t\t\t".join(f"{i}" for i in range(count))
    axes = "\t".join(f"{a}{i + 1}" for i in range(count) for a in "XYZ")
    path.write_text(f"{head}{names}\n\t\t{axes}\n1\t0\t" + "\t".join(["1"] * 3 * count) + "\n")


TRC_HEAD = "PathFileType\t4\t(X/Y/Z)\ta\nDataRate\tUnits\n100\tm\nFrame#\tTime\tA\n\t\tX1\tY1\tZ1\n"
MOT_HEAD = "inDegrees=no\nendheader\ntime\tpelvis_tilt\n"


def _wide_table(path: Path, size: float) -> None:
    count = int(size * MB / 8)
    path.write_text(
        "time_s," + ",".join(f"c{i}" for i in range(count)) + "\n" + ",".join(["1"] * (count + 1)) + "\n"
    )


def _emps() -> System:
    return System.from_yaml(shipped("emps") / "system.yaml")


def _recording(path: Path) -> Any:
    return Recording.read(_emps(), path)


def _config(path: Path) -> Any:
    return validated(read_yaml(path), "config", path)


def _text_cases() -> Iterator[Case]:
    narrow = "\t".join(["1"] * 300)
    yield (
        "TSV",
        "cells of one digit",
        "a.tsv",
        _text(_tsv_head(100), lambda i: f"{i + 1}\t{i / 100:.2f}\t{narrow}\n"),
        detect.read,
    )
    yield "TSV", "one marker", "a.tsv", _text(_tsv_head(1, False), lambda i: "1\t1\t1\n"), detect.read
    yield (
        "TSV",
        "one marker, a blank before the last number",
        "a.tsv",
        _text(_tsv_head(1, False), lambda i: "1\t1\t1\n", "1\t1\t x\n"),
        detect.read,
    )
    yield (
        "TSV",
        "cells of one digit, a word at the end",
        "a.tsv",
        _text(_tsv_head(100, False), lambda i: f"{narrow}\n", narrow[:-1] + "x\n"),
        detect.read,
    )
    yield (
        "TSV",
        "every second frame left out",
        "a.tsv",
        _text(_tsv_head(1), lambda i: f"{1 + 2 * i}\t{i / 50:.2f}\t1\t1\t1\n"),
        detect.read,
    )
    yield (
        "TSV",
        "three of four frames left out",
        "a.tsv",
        _text(_tsv_head(1), lambda i: f"{1 + 4 * i}\t{i / 25:.2f}\t1\t1\t1\n"),
        detect.read,
    )
    yield "TSV", "markers without number", "a.tsv", _wide_tsv, detect.read
    yield (
        "TSV",
        "a header key again and again",
        "a.tsv",
        _text("MARKER_NAMES\tA\n", lambda i: "KEY\n"),
        detect.read,
    )
    yield "TSV", "events", "a.tsv", _text("MARKER_NAMES\tA\n", lambda i: "EVENT\ta\t1\t1\n"), detect.read
    yield "TSV", "header keys", "a.tsv", _text("MARKER_NAMES\tA\n", lambda i: f"K{i}\n"), detect.read
    yield "TSV", "blank lines", "a.tsv", _text("MARKER_NAMES\tA\n1\t1\t1\n", lambda i: "\n"), detect.read
    yield "TRC", "one landmark", "a.trc", _text(TRC_HEAD, lambda i: f"{i + 1}\t{i}\t1\t1\t1\n"), detect.read
    yield "TRC", "landmarks without number", "a.trc", _wide_trc, detect.read
    yield (
        "TRC",
        "commas",
        "a.trc",
        _text(TRC_HEAD.replace("\t", ","), lambda i: f"{i + 1},{i},1,1,1\n"),
        detect.read,
    )
    yield "MOT", "one coordinate", "a.mot", _text(MOT_HEAD, lambda i: f"{i}\t1\n"), detect.read_markerless
    yield (
        "MOT",
        "one coordinate divided by blanks",
        "a.mot",
        _text(MOT_HEAD.replace("\t", " "), lambda i: f"{i} 1\n"),
        detect.read_markerless,
    )
    yield "MOT", "columns without number", "a.mot", _wide_mot, detect.read_markerless
    yield (
        "STO",
        "vectors",
        "a.sto",
        _text("DataType=Vec3\nendheader\ntime\tp\n", lambda i: f"{i}\t1,1,1\n"),
        detect.read,
    )
    yield (
        "CSV",
        "three columns",
        "a.csv",
        _text("time_s,motor_force_N,carriage_m\n", lambda i: f"{i},1,1\n"),
        _recording,
    )
    yield "CSV", "columns without number", "a.csv", _wide_table, _recording
    yield (
        "CSV",
        "words",
        "a.csv",
        _text("time_s,motor_force_N,carriage_m\n", lambda i: f"{i},x{i},y\n"),
        _recording,
    )
    yield "YAML", "a list", "a.yaml", _text("a: [", lambda i: "1,", "]\n"), _config
    yield "YAML", "keys", "a.yaml", _text("", lambda i: f"k{i}: 1\n"), _config
    yield "MJCF", "elements", "a.xml", _text("<mujoco>", lambda i: "<a/>", "</mujoco>"), model_files


# -------------------- binary


def _c3d(points: int, real: bool) -> Callable[[Path, float], None]:
    def write(path: Path, size: float) -> None:
        word = 4 if real else 2
        frames = min(max(int(size * MB / (4 * points * word)), 1), 65000)
        records = b""
        for number, name in ((1, b"POINT"),):
            records += struct.pack("bb", len(name), -number) + name + struct.pack("<h", 3) + b"\0"
        labels, part = bytes(points), 200 * 160
        values = {b"UNITS": (-1, [2], b"mm"), b"RATE": (4, [], struct.pack("<f", 100.0))}
        for i in range(max(points // part, 1)):
            name = b"LABELS" if not i else f"LABELS{i + 1}".encode()
            values[name] = (-1, [1, 200, 160], labels[:part].ljust(part, b"x"))
        for name, (kind, dimensions, data) in values.items():
            body = struct.pack("bB", kind, len(dimensions)) + bytes(dimensions) + data + b"\0"
            records += struct.pack("bb", len(name), 1) + name + struct.pack("<H", len(body) + 2) + body
        blocks = -(-(4 + len(records)) // 512)
        section = (bytes([1, 80, min(blocks, 255), 84]) + records).ljust(blocks * 512, b"\0")
        scale = -1.0 if real else 0.1
        words = (
            struct.pack("<5H", points, 0, 1, frames, 0)
            + struct.pack("<f2H", scale, 2 + blocks, 0)
            + struct.pack("<f", 100.0)
        )
        data = np.ones(frames * points * 4, "<f4" if real else "<i2").tobytes()
        path.write_bytes((bytes([2, 80]) + words).ljust(512, b"\0") + section + data)

    return write


def _mat(cells: bool) -> Callable[[Path, float], None]:
    def write(path: Path, size: float) -> None:
        import zlib

        def element(kind: int, data: bytes) -> bytes:
            return struct.pack("<II", kind, len(data)) + data.ljust(-(-len(data) // 8) * 8, b"\0")

        count = int(5 * size * MB / 8) - 20
        inside = struct.pack("<II", 14, 0) * count
        flags = element(6, struct.pack("<II", 1, 0))
        body = flags + element(5, struct.pack("<ii", 1, count)) + element(1, b"x") + inside
        packed = zlib.compress(element(14, body), 9)
        filler = np.random.default_rng(1).bytes(max(int(size * MB) - len(packed), 8))
        extra = element(
            15,
            zlib.compress(
                element(
                    14,
                    flags
                    + element(5, struct.pack("<ii", 1, len(filler)))
                    + element(1, b"y")
                    + element(2, filler),
                ),
                0,
            ),
        )
        head = b"MATLAB 5.0".ljust(124) + struct.pack("<H", 0x0100) + b"IM"
        path.write_bytes(head + struct.pack("<II", 15, len(packed)) + packed + extra)

    return write


def _parquet(rows: int, words: bool) -> Callable[[Path, float], None]:
    def write(path: Path, size: float) -> None:
        import pyarrow as pa
        import pyarrow.parquet as pq

        with_words = (
            pa.DictionaryArray.from_arrays(np.zeros(rows, np.int8), pa.array(["w" * 10_000]))
            if words
            else pa.array(np.zeros(rows))
        )
        table = pa.table(
            {"time_s": np.zeros(rows), "motor_force_N": np.zeros(rows), "carriage_m": with_words}
        )
        pq.write_table(table, path, compression="zstd")

    return write


def _npz(path: Path, size: float) -> None:
    np.savez_compressed(path, weights=np.zeros(int(size * MB * 120)))


# -------------------- logs


def _log(
    messages: Callable[[int], tuple[str, str, str, bytes, bytes]], unpacked: float = 1.0
) -> Callable[[Path, float], None]:
    """A writer of messages (topic, schema, encoding, definition, payload) whose chunks unpack to ``unpacked``."""

    def write(path: Path, size: float) -> None:
        from mcap.writer import CompressionType, IndexType, Writer

        kind = CompressionType.NONE if unpacked == 1 else CompressionType.ZSTD
        stream = io.BytesIO()
        writer = Writer(stream, chunk_size=1 << 22, compression=kind, index_types=IndexType.NONE)
        writer.start(profile="ros2")
        channels: dict[str, int] = {}
        total, i = 0, 0
        while total < size * unpacked * MB:
            topic, name, encoding, definition, payload = messages(i)
            if topic not in channels:
                kind_of_schema = "ros2msg" if encoding == "cdr" else "jsonschema"
                schema = writer.register_schema(name, kind_of_schema, definition)
                channels[topic] = writer.register_channel(topic, encoding, schema)
            writer.add_message(channels[topic], i, payload, i)
            total, i = total + len(payload) + 31, i + 1
        if (
            unpacked > 1
        ):  # bytes that do not pack, so that the file is as large as it may be for what it unpacks to
            filler = np.random.default_rng(1).bytes(max(int(size * MB) - len(stream.getvalue()), 1))
            writer.add_attachment(0, 0, "a", "b", filler)
        writer.finish()
        path.write_bytes(stream.getvalue())

    return write


def _definition(name: str) -> bytes:
    return robot_log._schema_text(name).encode()


def _state(names: list[str], values: int) -> bytes:
    strings = {"frame_id": [""], "name": names}
    return robot_log._compose(
        robot_log.JOINT_STATE, strings, {"position": values, "velocity": 0, "effort": 0}
    )


def _log_cases() -> Iterator[Case]:
    bool_type, state_type = robot_log.BOOL, robot_log.JOINT_STATE
    state = _definition(state_type)
    sync = ("/sync", bool_type, "cdr", _definition(bool_type), b"\0\1\0\0\1")
    empty = _state([], 0)

    def named(i: int) -> tuple[str, str, str, bytes, bytes]:
        return "/joint_states", state_type, "cdr", state, _state([f"j{i}"], 1)

    def sized(i: int) -> tuple[str, str, str, bytes, bytes]:
        return "/joint_states", state_type, "cdr", state, _state(["j"], i % 3000)

    def json_bool(i: int) -> tuple[str, str, str, bytes, bytes]:
        return "/sync", bool_type, "json", b"{}", b'{"data":true}'

    def json_state(i: int) -> tuple[str, str, str, bytes, bytes]:
        return "/joint_states", state_type, "json", b"{}", b'{"name":[],"position":[]}'

    def json_named(i: int) -> tuple[str, str, str, bytes, bytes]:
        return (
            "/joint_states",
            state_type,
            "json",
            b"{}",
            json.dumps({"name": [f"j{i}"], "position": [1]}).encode(),
        )

    def nested(i: int) -> tuple[str, str, str, bytes, bytes]:
        return "/sync", bool_type, "json", b"{}", b'{"data":[' + b"[]," * 1_400_000 + b"0]}"

    def defined(i: int) -> tuple[str, str, str, bytes, bytes]:
        text = _definition(bool_type) + b"".join(b"bool a%d\n" % k for k in range(100_000))
        return "/sync", bool_type, "cdr", text, b"\0\1\0\0" + bytes(100_001)

    for unpacked in (1.0, 19.0):
        word = "" if unpacked == 1 else ", packed 19 times"
        yield "MCAP", f"/sync in CDR{word}", "a.mcap", _log(lambda i: sync, unpacked), detect.read
        yield (
            "MCAP",
            f"empty joint states{word}",
            "a.mcap",
            _log(lambda i: ("/joint_states", state_type, "cdr", state, empty), unpacked),
            detect.read,
        )
        yield "MCAP", f"joint states of one name each{word}", "a.mcap", _log(named, unpacked), detect.read
        yield "MCAP", f"/sync in JSON{word}", "a.mcap", _log(json_bool, unpacked), detect.read
        yield "MCAP", f"joint states in JSON{word}", "a.mcap", _log(json_state, unpacked), detect.read
    yield "MCAP", "joint states of other sizes", "a.mcap", _log(sized), detect.read
    yield "MCAP", "joint states of one name each in JSON", "a.mcap", _log(json_named), detect.read
    yield "MCAP", "lists of lists in JSON", "a.mcap", _log(nested), detect.read
    yield "MCAP", "a definition of 1 MB", "a.mcap", _log(defined), detect.read
    yield "MCAP, system", "joint states of one name each", "a.mcap", _log(named), _arm_recording
    yield (
        "MCAP, system",
        "empty joint states, packed 19 times",
        "a.mcap",
        _log(lambda i: ("/j", state_type, "cdr", state, empty), 19.0),
        _arm_recording,
    )
    yield (
        "MCAP, system",
        "joint states in JSON, packed 19 times",
        "a.mcap",
        _log(json_state, 19.0),
        _arm_recording,
    )


def _arm_recording(path: Path) -> Any:
    content = {
        "name": "arm",
        "model": "drba.xml",
        "machine": {name: {} for name in robot_log.ARM_JOINTS},
        "interface": {"axes": {"x": {"joint": "arm_lift"}}},
        "drive": {"by": "path", "of": {"arm_lift": "arm_lift_m"}},
        "parameters": {"k": {"unit": "N/m", "bounds": [1, 2], "sets": "stiffness", "of": "x"}},
    }
    return Recording.read(System.from_dict(content, ROOT / "resources/robot/system.yaml"), path)


def _binary_cases() -> Iterator[Case]:
    yield "C3D", "one point of integers", "a.c3d", _c3d(10, False), detect.read
    yield "C3D", "points of floats", "a.c3d", _c3d(30, True), detect.read
    yield "C3D", "60 000 points of one name", "a.c3d", _c3d(60_000, False), detect.read
    yield "MAT", "empty arrays, packed 5 times", "a.mat", _mat(True), detect.read
    yield "Parquet", "ten million zeros", "a.parquet", _parquet(10_000_000, False), _recording
    yield "Parquet", "long words for numbers", "a.parquet", _parquet(200_000, True), _recording
    yield "checkpoint", "zeros", "a.npz", _npz, read_checkpoint


def cases() -> Iterator[Case]:
    """All cases: reader, kind, name of the file, what writes it with some MB, what reads it."""
    yield from _text_cases()
    yield from _binary_cases()
    yield from _log_cases()


# -------------------- measuring


def _resident_mb(key: str) -> float:
    return int(Path("/proc/self/status").read_text().split(f"{key}:")[1].split()[0]) / 1024


def measure(read: Callable[[Path], Any], path: Path, limit_s: float = 40.0) -> tuple[float, float, str]:
    """Growth of memory [MB], processor time [s] and outcome of reading a file in a process of its own."""
    receive, send = os.pipe()
    child = os.fork()
    if not child:
        import resource

        resource.setrlimit(resource.RLIMIT_CPU, (int(limit_s), int(limit_s)))
        Path("/proc/self/clear_refs").write_text("5")
        before, begin = _resident_mb("VmRSS"), time.process_time()
        try:
            result = read(path)
            outcome = "read"
            del result
        except InputError as error:
            outcome = f"refused ({error.code})"
        except UnusableCheckpoint:
            outcome = "refused"
        except BaseException as error:
            outcome = f"{type(error).__name__}: {error}"[:60]
        seconds = time.process_time() - begin
        os.write(send, json.dumps([_resident_mb("VmHWM") - before, seconds, outcome]).encode())
        os._exit(0)
    os.close(send)
    with os.fdopen(receive) as stream:
        text = stream.read()
    os.waitpid(child, 0)
    grown, seconds, outcome = (
        json.loads(text) if text else (float("nan"), limit_s, "ended by the limit or a crash")
    )
    return grown, seconds, outcome


def within(grown_mb: float, seconds: float, size_mb: float) -> bool:
    """Return whether a case keeps the bars."""
    return grown_mb <= max(MOST_MEMORY * size_mb, FLOOR_MB) and seconds <= max(
        MOST_S_PER_MB * size_mb, FLOOR_S
    )


def main() -> int:
    """Print the table; 1 where a case is above a bar."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--only", default="", help="cases whose reader or kind has this word")
    parser.add_argument("--size", type=float, default=5.0, help="MB of a file [5]")
    parser.add_argument("--out", type=Path)
    arguments = parser.parse_args()
    warm(Path(tempfile.mkdtemp()))
    rows, bad = [], 0
    print(f"{'reader':14} {'crafted kind':46} {'MB':>6} {'x size':>7} {'s/MB':>6}  outcome")
    with tempfile.TemporaryDirectory() as folder:
        for reader, kind, name, write, read in cases():
            if arguments.only.lower() not in f"{reader} {kind}".lower():
                continue
            path = Path(folder) / name
            write(path, arguments.size)
            size = path.stat().st_size / MB
            grown, seconds, outcome = measure(read, path)
            keeps = within(grown, seconds, size) and ("read" in outcome or "refused" in outcome)
            bad += not keeps
            rows.append([reader, kind, size, grown, grown / size, seconds, seconds / size, outcome])
            mark = "" if keeps else f"  <- {grown:.0f} MB, {seconds:.1f} s"
            print(
                f"{reader:14} {kind:46} {size:6.2f} {grown / size:7.1f} {seconds / size:6.2f}  {outcome}{mark}",
                flush=True,
            )
            path.unlink()
    if arguments.out:
        with arguments.out.open("w", newline="") as stream:
            csv.writer(stream).writerows(
                [["reader", "kind", "mb", "peak_mb", "peak_ratio", "s", "s_per_mb", "outcome"], *rows]
            )
    print(f"{len(rows)} cases, {bad} above a bar")
    return int(bad > 0)


def warm(folder: Path) -> None:
    """Load every library that a reader uses, which is not the file's cost."""
    import mcap_ros2.decoder  # noqa: F401
    import mujoco  # noqa: F401
    import zstandard  # noqa: F401

    table = folder / "warm.csv"
    table.write_text("time_s,motor_force_N,carriage_m\n" + "".join(f"{i / 100},1,1\n" for i in range(20)))
    _recording(table)
    (folder / "a.yaml").write_text("{}\n")
    _config(folder / "a.yaml")
    narrow = "\t".join(["1"] * 300)
    _text(_tsv_head(100, False), lambda i: f"{narrow}\n")(folder / "a.tsv", 0.1)
    detect.read(folder / "a.tsv")


if __name__ == "__main__":
    sys.exit(main())
