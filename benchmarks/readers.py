"""Speed and memory of the readers, on files made here.

    python benchmarks/readers.py [FOLDER]

A 10-minute TSV of 40 markers at 100 Hz to Parquet (bar: 2 s), and robot logs of 1 GB (bar: 300 MB of memory):
one with camera images beside the robot's topics, one of the robot's topics alone. Needs 2 GB of disk.
"""

import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

ROOT = Path(__file__).parents[1]
sys.path.insert(0, str(ROOT / "workflow"))

from real2sim.recording.formats import robot_log
from real2sim.recording.formats.qualisys import write_markers
from real2sim.recording.formats.recordings import MarkerRecording, RobotLog

BYTES = 1 << 30
_TSV = """
import sys, time
import numpy as np, pyarrow, pyarrow.parquet
from pathlib import Path
begin = time.perf_counter()
from real2sim.recording.formats.detect import read_markers
recording = read_markers(Path(sys.argv[1]))
columns = {"time_s": recording.time_s}
for name, values in recording.positions.items():
    columns |= {f"{name}_{axis}": np.ascontiguousarray(values[:, i]) for i, axis in enumerate("xyz")}
arrays = [pyarrow.Array.from_buffers(pyarrow.float64(), len(v), [None, pyarrow.py_buffer(v)]) for v in columns.values()]
table = pyarrow.Table.from_arrays(arrays, names=list(columns))
pyarrow.parquet.write_table(table, sys.argv[2], compression="zstd")
print(time.perf_counter() - begin)
"""
_LOG = """
import sys, time
from pathlib import Path
begin = time.perf_counter()
from real2sim.recording.formats.detect import read_log
log = read_log(Path(sys.argv[1]))
status = Path("/proc/self/status").read_text()
peak = int(status.split("VmHWM:")[1].split()[0]) / 1024  # ru_maxrss would count the parent's
print(time.perf_counter() - begin, peak, len(log.base_time_s))
"""


def run(code, *arguments):
    environment = os.environ | {"PYTHONPATH": str(ROOT / "workflow")}
    command = [sys.executable, "-c", code, *map(str, arguments)]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=True)
    return [float(word) for word in done.stdout.split()]


def markers(path, minutes=10, count=40):
    n = minutes * 6000
    rng = np.random.default_rng(1)
    positions = {f"M{i}": np.cumsum(rng.normal(0, 1e-3, (n, 3)), axis=0) for i in range(count)}
    write_markers(path, MarkerRecording(np.arange(n) / 100, 100.0, positions))


def log(path, *, images):
    """A log of about 1 GB, written piece by piece: 100 Hz topics, and 200 kB images at 30 Hz or none."""
    from mcap.writer import CompressionType, Writer

    rng = np.random.default_rng(2)
    image = rng.bytes(200_000)
    with path.open("wb") as stream:
        writer = Writer(stream, compression=CompressionType.NONE)
        writer.start(profile="ros2")
        channels = {}
        minute = 0
        while stream.tell() < BYTES:
            t = np.arange(6000) / 100
            base = {name: rng.normal(size=6000) for name in robot_log.BASE_COLUMNS}
            joints = {name: rng.normal(size=(6000, 2)) for name in robot_log.ARM_JOINTS}
            topics = robot_log._messages(RobotLog(10**18 + minute * 60 * 10**9, t, base, t, joints))
            minute += 1
            for topic, (stamps, payloads) in topics.items():
                if topic not in channels:
                    kind = robot_log.TOPICS[topic]
                    text = robot_log._schema_text(kind).encode()
                    channels[topic] = writer.register_channel(
                        topic, "cdr", writer.register_schema(kind, "ros2msg", text)
                    )
                for stamp, payload in zip(stamps.tolist(), payloads, strict=True):
                    writer.add_message(channels[topic], stamp, payload, stamp)
            for i in range(1800 if images else 0):
                if "/image" not in channels:
                    channels["/image"] = writer.register_channel("/image", "raw", 0)
                stamp = int(stamps[0]) + i * 33_000_000
                writer.add_message(channels["/image"], stamp, image, stamp)
        writer.finish()


def main(folder):
    path = folder / "a.tsv"
    markers(path)
    times = [run(_TSV, path, folder / "a.parquet")[0] for _ in range(3)]
    print(
        f"TSV, 10 min, 40 markers, 100 Hz, {path.stat().st_size / 1e6:.0f} MB: to Parquet in {min(times):.2f} s"
    )
    path.unlink()
    for images in (True, False):
        path = folder / "a.mcap"
        begin = time.perf_counter()
        log(path, images=images)
        made = time.perf_counter() - begin
        took, peak, rows = run(_LOG, path)
        what = "with images" if images else "robot's topics only"
        size = path.stat().st_size / 1e9
        print(
            f"MCAP, {size:.2f} GB, {what}: {rows:.0f} rows in {took:.0f} s, {peak:.0f} MB (made in {made:.0f} s)"
        )
        path.unlink()


if __name__ == "__main__":
    if len(sys.argv) > 1:
        main(Path(sys.argv[1]))
    else:
        with tempfile.TemporaryDirectory() as name:
            main(Path(name))
