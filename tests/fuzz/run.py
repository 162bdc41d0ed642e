"""Damage files and read them: each is read or refused, within a second, in little memory.

    PYTHONPATH=workflow python -m tests.fuzz.run COUNT FOLDER [--first NUMBER] [--seed SEED]

Run in a process of its own, so that a crash of a library is seen as one. Prints a summary as JSON; the input at
work lies in FOLDER/input (or in FOLDER/others) while it is being read. Input NUMBER of a SEED is always the same, so
that a campaign can be cut into chunks. A reader that takes half a minute ends the process with its traceback.
"""

import argparse
import faulthandler
import json
import time
import traceback
from collections import Counter
from pathlib import Path

import numpy as np
from real2sim.errors import InputError
from real2sim.recording.formats import detect, text
from real2sim.recording.formats.recordings import MarkerRecording

from tests.fuzz import mutate, others, seeds

SECONDS = 1.0
HANG_S = 30.0
MOST_MB = 500
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
        self.failures, self.peak_mb = [], 0.0
        self.inputs, self.read_of = Counter(), Counter()

    def attempt_other(self, target, data, number):
        """Read one input of `others`; files of several parts have their own folders."""
        path = self.folder / "others" / target.file
        path.write_bytes(data)
        self.inputs[target.name] += 1
        begin = time.process_time()
        try:
            target.read(path)
        except InputError as error:
            self.codes[error.code] += 1
            if not (error.code and error.remedy and error.found and error.expected):
                self._fail(target.name, number, f"refusal that lacks a part: {error}")
        except target.refusals as error:
            self.codes[type(error).__name__] += 1
        except Exception:
            self._fail(target.name, number, traceback.format_exc()[-1500:])
        else:
            self.read += 1
            self.read_of[target.name] += 1
        self._check_cost(target.name, number, target.name, time.process_time() - begin)

    def _fail(self, source, number, what):
        self.failures.append((source, number, what))

    def _check_cost(self, source, number, reader, took):
        """Note an input that took too long or too much memory; a hang ends the process by faulthandler."""
        self.slowest = max(self.slowest, took)
        if took > SECONDS:
            self._fail(source, number, f"{reader} took {took:.1f} s")
        peak = peak_mb()
        self.peak_mb = max(self.peak_mb, peak)
        if peak > MOST_MB:
            self._fail(source, number, f"{reader} took {peak:.0f} MB")
            forget_peak()

    def attempt(self, source, data, number, readers, check_one):
        path = self.folder / f"input{source.suffix}"
        path.write_bytes(data)
        self.inputs[source.suffix] += 1
        for reader in readers:
            outcomes = []
            # Tables by the slow and by the fast parser: what one refuses the other must.
            for text._LARGE in (10**9, 0) if source.suffix in seeds.TEXT_SUFFIXES else (10**9,):
                begin = time.process_time()
                outcomes.append(self._outcome(source, number, reader, path, check_one))
                took = time.process_time() - begin
                self._check_cost(source.name, number, reader.__name__, took)
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


def forget_peak():
    """Let the largest memory of this process count from now on (Linux)."""
    try:
        Path("/proc/self/clear_refs").write_text("5")
    except OSError:
        return


def _warm(folder):
    return seeds.banded_seeds(folder / "warm")[-1]


def _file_input(campaign, number, rng, paths, banded, raw):
    """One damaged file of a person's folder."""
    if number % 4 == 0:
        source = banded[rng.integers(len(banded))]
        campaign.attempt(source, mutate.shifted(raw[source], rng), number, (detect.read,), check_bands)
        return
    source = paths[rng.integers(len(paths))]
    data = mutate.mutated(raw[source], rng, text=source.suffix in seeds.TEXT_SUFFIXES)
    # What a folder's file is read by, and the reading of whatever it is.
    reader = {".c3d": 1, ".mat": 1, ".tsv": 1, ".txt": 1, ".mcap": 3}.get(source.suffix, 2)
    campaign.attempt(source, data, number, (detect.read, READERS[reader]), check)


def main(count, folder, first=0, seed=7):
    campaign = Campaign(folder)
    text._LARGE = 0
    detect.read(_warm(folder))  # the first use of a library loads it, which is not the input's time
    paths = seeds.write_seeds(folder / "seeds")
    banded = seeds.banded_seeds(folder / "banded")
    raw = {path: path.read_bytes() for path in paths + banded}
    (folder / "others").mkdir(parents=True)
    targets = others.targets(folder / "others")
    for target in targets:  # as sound as the seeds are, each must be read; and its libraries are loaded
        (folder / "others" / target.file).write_bytes(target.seeds[0])
        if target.seeds[0]:
            target.read(folder / "others" / target.file)
    forget_peak()
    for number in range(first, first + count):
        rng = np.random.default_rng([seed, number])
        faulthandler.dump_traceback_later(HANG_S, exit=True)
        if number % 5 < 3:
            _file_input(campaign, number // 5 * 3 + number % 5, rng, paths, banded, raw)
        else:
            target = targets[rng.integers(len(targets))]
            data = target.seeds[rng.integers(len(target.seeds))]
            campaign.attempt_other(target, target.damage(data, rng), number)
    faulthandler.cancel_dump_traceback_later()
    summary = {
        "inputs": count,
        "first": first,
        "seed": seed,
        "seeds": len(paths) + sum(len(target.seeds) for target in targets),
        "read": campaign.read,
        "refused": campaign.codes.total(),
        "codes": dict(campaign.codes.most_common()),
        "inputs_of": dict(campaign.inputs.most_common()),
        "read_of": dict(campaign.read_of.most_common()),
        "slowest_s": campaign.slowest,
        "peak_mb": campaign.peak_mb,
        "failures": campaign.failures[:20],
        "failure_count": len(campaign.failures),
    }
    print(json.dumps(summary))


if __name__ == "__main__":
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("count", type=int)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--seed", type=int, default=7)
    arguments = parser.parse_args()
    main(arguments.count, arguments.folder, arguments.first, arguments.seed)
