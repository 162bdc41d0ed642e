"""Damage files and read them: each is read or refused, within a second, in little memory.

    python -m tests.fuzz.run COUNT FOLDER

Run in a process of its own, so that a crash of a library is seen as one. Prints a summary as JSON; the input at
work lies in FOLDER/input while it is being read.
"""

import json
import sys
import time
import traceback
from collections import Counter
from pathlib import Path

import numpy as np
from real2sim.errors import InputError
from real2sim.recording.formats import detect, text
from real2sim.recording.formats.recordings import MarkerRecording

from tests.fuzz import mutate, seeds

SECONDS = 1.0
READERS = (detect.read, detect.read_markers, detect.read_markerless, detect.read_log)


def check(recording):
    """What must hold for anything that was read."""
    for name in ("time_s", "base_time_s", "joint_time_s"):
        time_s = getattr(recording, name, None)
        if time_s is not None:
            assert np.isfinite(time_s).all(), name
            assert (np.diff(time_s) >= 0).all(), name
    for values in getattr(recording, "positions", {}).values():
        assert values.shape == (len(recording.time_s), 3)
        known = np.isfinite(values)
        assert (known.all(axis=1) == known.any(axis=1)).all(), "half a point"
        assert not np.isinf(values).any()
    for rotation in getattr(recording, "rotations", {}).values():
        known = np.isfinite(rotation).all(axis=(1, 2))
        assert np.allclose(np.linalg.det(rotation[known]), 1, atol=1e-2)
    for values in getattr(recording, "base", {}).values():
        assert np.isfinite(values).all()
    for finding in recording.findings:
        assert finding.code
        assert finding.message


def check_bands(recording):
    """No number of one marker under the name of another."""
    assert isinstance(recording, MarkerRecording)
    for name, values in recording.positions.items():
        low, high = seeds.band_of(name)
        known = values[np.isfinite(values)]
        assert ((known >= low) & (known <= high)).all(), f"{name} holds another marker's number"


class Campaign:
    """One run; ``failures`` are (seed file, mutation number, what)."""

    def __init__(self, folder):
        self.folder = folder
        self.codes, self.slowest, self.read = Counter(), 0.0, 0
        self.failures = []

    def attempt(self, source, data, number, readers, check_one):
        path = self.folder / f"input{source.suffix}"
        path.write_bytes(data)
        for reader in readers:
            outcomes = []
            # Tables by the slow and by the fast parser: what one refuses the other must.
            for text._LARGE in (10**9, 0) if source.suffix in seeds.TEXT_SUFFIXES else (10**9,):
                begin = time.process_time()
                outcomes.append(self._outcome(source, number, reader, path, check_one))
                took = time.process_time() - begin
                self.slowest = max(self.slowest, took)
                if took > SECONDS:
                    self.failures.append((source.name, number, f"{reader.__name__} took {took:.1f} s"))
            if outcomes[0] != outcomes[-1]:
                self.failures.append((source.name, number, f"slow and fast differ: {outcomes}"[:900]))

    def _outcome(self, source, number, reader, path, check_one):
        """What comes of one input, in a form that can be compared: a code, or the bytes of all numbers."""
        try:
            recording = reader(path)
            check_one(recording)
        except InputError as error:
            self.codes[error.code] += 1
            if not error.code or not error.remedy:
                self.failures.append((source.name, number, f"refusal without code or remedy: {error}"))
            return error.code
        except Exception:
            self.failures.append((source.name, number, traceback.format_exc()[-1500:]))
            return "failure"
        self.read += 1
        tables = {**getattr(recording, "positions", {}), **getattr(recording, "columns", {})}
        return {name: (np.asarray(values) + 0.0).tobytes() for name, values in tables.items()}


def peak_mb():
    """Largest memory of this process; getrusage would count that of its parent."""
    status = Path("/proc/self/status").read_text()
    return int(status.split("VmHWM:")[1].split()[0]) / 1024


def _warm(folder):
    return seeds.banded_seeds(folder / "warm")[-1]


def main(count, folder):
    campaign = Campaign(folder)
    text._LARGE = 0
    detect.read(_warm(folder))  # the first use of a library loads it, which is not the input's time
    paths = seeds.write_seeds(folder / "seeds")
    banded = seeds.banded_seeds(folder / "banded")
    raw = {path: path.read_bytes() for path in paths + banded}
    for number in range(count):
        rng = np.random.default_rng([7, number])
        if number % 4 == 0:
            source = banded[rng.integers(len(banded))]
            campaign.attempt(source, mutate.shifted(raw[source], rng), number, (detect.read,), check_bands)
            continue
        source = paths[rng.integers(len(paths))]
        data = mutate.mutated(raw[source], rng, text=source.suffix in seeds.TEXT_SUFFIXES)
        # What a folder's file is read by, and the reading of whatever it is.
        reader = {".c3d": 1, ".mat": 1, ".tsv": 1, ".txt": 1, ".mcap": 3}.get(source.suffix, 2)
        campaign.attempt(source, data, number, (detect.read, READERS[reader]), check)
    summary = {
        "inputs": count,
        "seeds": len(paths),
        "read": campaign.read,
        "refused": campaign.codes.total(),
        "codes": dict(campaign.codes.most_common()),
        "slowest_s": campaign.slowest,
        "peak_mb": peak_mb(),
        "failures": campaign.failures[:20],
        "failure_count": len(campaign.failures),
    }
    print(json.dumps(summary))


if __name__ == "__main__":
    main(int(sys.argv[1]), Path(sys.argv[2]))
