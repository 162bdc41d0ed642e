"""Recordings of a described system: one table with named columns and units, from CSV, Parquet or MCAP."""

from __future__ import annotations

import csv
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from functools import cache, cached_property
from itertools import islice
from pathlib import Path

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq

from real2sim.configuration import validated
from real2sim.errors import InputError
from real2sim.recording.formats.joint_states import read_joint_states
from real2sim.recording.formats.recordings import Finding
from real2sim.recording.formats.text import check_number_of_names, repeated
from real2sim.recording.levels import scatter_of_pair, scatter_of_repeats
from real2sim.signals import Scatter
from real2sim.system.description import POSE, System

TIME = "time_s"
# Largest departure of an interval between samples from their mean, as a share of it
UNEVEN = 0.01
# Samples that a recording has at least
_FEWEST = 10
# Larger numbers are none that an instrument shows
_ASTRONOMIC = 1e100
# Intervals between the messages of a joint from which on nothing is known of what lies between, in usual ones
_HOLE = 4.0
# Samples on the even clock, as a multiple of the messages of a joint
_MOST_SAMPLES = 4
# Columns of a table may take so many times the file's size, or so many bytes if that is more
_MOST_UNPACKED, _SMALL = 5, 1 << 24


@dataclass(frozen=True)
class Recording:
    """One trial: ``columns`` (n,) by name [SI] at ``time_s`` (n,), evenly spaced [s]; NaN where a marker was lost.

    ``findings`` lists what was odd in the file and what was done about it (docs/quality-codes.md); ``driving`` are the
    columns of what drives the system's joints.
    """

    name: str
    time_s: np.ndarray
    columns: Mapping[str, np.ndarray]
    findings: tuple[Finding, ...] = ()
    driving: tuple[str, ...] = ()

    @classmethod
    def read(cls, system: System, path: Path | str) -> Recording:
        """Read a table (.parquet, .csv) or joint states (.mcap) that hold what a system names.

        Raises
        ------
        InputError
            Naming the file and the column, where one is missing, not a number, or the times are not even.
        """
        path = Path(path)
        table, findings = _read_table(path, system)
        return replace(cls.from_table(system, table, path.stem, path), findings=tuple(findings))

    @classmethod
    def from_table(
        cls, system: System, table: pd.DataFrame, name: str = "recording", source: Path | str = ""
    ) -> Recording:
        """Check a table against the columns that a system names, as `read`; other columns are left out."""
        source = Path(source or name)
        wanted = required_columns(system)
        missing = [column for column in (TIME, *wanted) if column not in table.columns]
        if missing:
            remedy = "Rename or add the columns; units stand in the names."
            raise _columns_missing(source, missing, table.columns, system, remedy)
        columns = {c: _numbers(table[c], source) for c in (TIME, *wanted)}
        time_s = columns.pop(TIME)
        _check_time(time_s, source)
        return cls(name, time_s, columns, driving=tuple(system.drive.columns.values()))

    @cached_property
    def step_s(self) -> float:
        """Interval between samples [s]."""
        return float((self.time_s[-1] - self.time_s[0]) / (len(self.time_s) - 1))

    @property
    def rate_hz(self) -> float:
        """Sample rate [Hz]."""
        return 1 / self.step_s

    def stack(self, names: tuple[str, ...]) -> np.ndarray:
        """Return columns (n, k) side by side."""
        return np.column_stack([self.columns[n] for n in names]) if names else np.empty((len(self.time_s), 0))

    def scatter_of_repeats(
        self, period_s: float, from_s: float = 0.0, to_s: float | None = None
    ) -> dict[str, Scatter]:
        """Return the noise of every column from repeat to repeat of a motion, about the mean of its repeats.

        What two laps or cycles under the same command do not share is noise, whatever the model, but for what the
        measured drive explains of it. `System.trusting` takes it as the level below which no residual is trusted, and
        the zeros of the repeats as zeros that differ from recording to recording.

        Parameters
        ----------
        period_s
            Length of one repeat [s], to 3 %; it is refined to what repeats best.
        from_s, to_s
            Part of the recording in which the motion repeats, by the recording's clock [s]; to its end by default.

        Raises
        ------
        InputError
            Where that part holds fewer than two repeats, or repeats of fewer than 8 samples.
        """
        last = self.time_s[-1] if to_s is None else to_s
        within = (self.time_s >= from_s) & (self.time_s <= last)
        values = np.column_stack([column[within] for column in self.columns.values()])
        try:
            scatter, _, _ = scatter_of_repeats(values, period_s / self.step_s, driven=self._driven)
        except ValueError as error:
            raise InputError(
                self.name,
                f"{from_s:g} s to {last:g} s",
                str(error),
                f"two repeats of {period_s:g} s and more, of 8 samples and more",
                "Give the part of the recording in which the motion repeats, and its period.",
                "value",
            ) from error
        return dict(zip(self.columns, scatter, strict=True))

    def scatter_to(self, other: Recording) -> dict[str, Scatter]:
        """Return the noise of every column between two recordings under the same command, as `scatter_of_repeats`.

        Raises
        ------
        InputError
            Where they share only a few samples.
        """
        one, two = (np.column_stack([r.columns[name] for name in self.columns]) for r in (self, other))
        try:
            scatter = scatter_of_pair(one, two, self._driven)
        except ValueError as error:
            raise InputError(
                other.name, "", str(error), f"as many samples as {self.name}", "Give a longer part.", "value"
            ) from error
        return dict(zip(self.columns, scatter, strict=True))

    @property
    def _driven(self) -> tuple[int, ...]:
        return tuple(i for i, name in enumerate(self.columns) if name in self.driving)

    def markers(self, names: tuple[str, ...]) -> np.ndarray:
        """Return marker paths (n, k, 3) [m, world]."""
        return np.stack([self.stack(marker_columns(name)) for name in names], axis=1)


def marker_columns(name: str) -> tuple[str, ...]:
    """Return the columns of a marker: ``<name>_x_m``, ``_y_m``, ``_z_m``."""
    return tuple(f"{name}_{letter}_m" for letter in "xyz")


def required_columns(system: System) -> tuple[str, ...]:
    """Return the columns that a recording of a system must have, beside time_s."""
    names: list[str] = list(system.drive.columns.values())
    if system.drive.by == POSE:
        for marker in (*system.markers.segment, *system.markers.interface):
            names += marker_columns(marker)
    names += [output.column for output in system.outputs]
    names += log_columns(system).values()
    return tuple(dict.fromkeys(names))


def check_columns(system: System, recording: Recording) -> None:
    """Refuse a recording that lacks columns of a system, as one that was read for another, or that measures nothing.

    Raises
    ------
    InputError
        Naming the recording and the columns.
    """
    if not (system.outputs or system.markers.sites or log_columns(system)):
        raise InputError(
            system.name,
            "outputs",
            "nothing that is measured beside the drive",
            "an output, markers of the interface, or a logged joint of the machine",
            "Name in the description of the system what the recordings hold.",
            "value",
        )
    missing = [column for column in required_columns(system) if column not in recording.columns]
    if missing:
        remedy = "Read it with this system: Recording.read(system, path)."
        raise _columns_missing(recording.name, missing, (TIME, *recording.columns), system, remedy)


def _columns_missing(
    source: Path | str, missing: Iterable[str], there: Iterable[str], system: System, remedy: str
) -> InputError:
    """Return the error for columns that a system names and a table has not."""
    return InputError(
        source,
        f"column {', '.join(missing)}",
        f"columns {', '.join(map(str, islice(there, 50)))}",
        f"the columns of system {system.name}: {', '.join((TIME, *required_columns(system)))}",
        remedy,
        "column_missing",
    )


def log_columns(system: System) -> dict[str, str]:
    """Return the column of each logged joint of the machine, by joint: ``<joint>_m`` or ``<joint>_rad``."""
    units = system.joint_units
    return {joint.name: f"{joint.name}_{units[joint.name]}" for joint in system.machine if joint.logged}


def _numbers(column: pd.Series, source: Path) -> np.ndarray:
    try:
        # pandas reads True as 1, and numpy 1_000 as 1000: no export means either
        if column.dtype == bool:
            raise ValueError(f"{column.iloc[0]} and the like")
        text = not pd.api.types.is_numeric_dtype(column)
        numbers = (pd.to_numeric(column) if text else column).to_numpy(dtype=float)
    except (TypeError, ValueError) as error:
        raise InputError(
            source,
            f"column {column.name}",
            str(error),
            "numbers, empty where nothing was measured (but in what drives the system)",
            "Correct it.",
            "not_a_number",
        ) from error
    far = np.flatnonzero(np.isinf(numbers) | (np.abs(numbers) > _ASTRONOMIC))
    if len(far):
        place = f"column {column.name}, sample {far[0] + 1}"
        found, expected = f"{numbers[far[0]]:g}", "a number that an instrument shows, or nothing"
        raise InputError(source, place, found, expected, "Leave the cell empty, or correct it.", "not_finite")
    if len(numbers) and not np.isfinite(numbers).any():
        raise InputError(
            source,
            f"column {column.name}",
            "no number in the whole column",
            "a measurement, empty only where nothing was seen",
            "Record it, or take what it measures out of the description of the system.",
            "not_a_number",
        )
    return np.asarray(numbers)


def _check_time(time_s: np.ndarray, source: Path) -> None:
    steps = np.diff(time_s)
    unknown = int((~np.isfinite(time_s)).sum())
    if len(time_s) < _FEWEST or unknown:
        found = f"{len(time_s)} samples" + (f", {unknown} of them without a time" if unknown else "")
        code = "time_uneven" if unknown else "too_short"
        expected = f"{_FEWEST} samples and more, each with a time"
        raise InputError(source, TIME, found, expected, "Export it anew.", code)
    if (steps <= 0).any():
        row = int(np.argmax(steps <= 0)) + 1
        found = f"{time_s[row]:.6g} s after {time_s[row - 1]:.6g} s"
        remedy = "Sort the rows by time, and do not join recordings."
        raise InputError(source, f"{TIME}, row {row + 1}", found, "times that increase", remedy, "time_order")
    if np.abs(steps - steps.mean()).max() > UNEVEN * steps.mean():
        row = int(np.argmax(np.abs(steps - steps.mean()))) + 1
        raise InputError(
            source,
            f"{TIME}, row {row + 1}",
            f"an interval of {steps[row - 1]:.6g} s where the mean is {steps.mean():.6g} s",
            "evenly spaced times",
            "Resample the recording on one clock.",
            "time_uneven",
        )


def _read_table(path: Path, system: System) -> tuple[pd.DataFrame, list[Finding]]:
    """Rows of a table or of the joint states of a log, and findings."""
    suffix = path.suffix.lower()
    if suffix not in (".parquet", ".csv", ".mcap"):
        found, expected = f"a file {suffix}", "a table .parquet or .csv, or a log .mcap"
        raise InputError(path, "", found, expected, "Export it as one.", "unknown_format")
    if not path.is_file():
        found = "no file" if path.exists() else "no such file"
        raise InputError(path, "", found, "a recording", "Check the path.", "no_file")
    if suffix == ".mcap":
        return _joint_states(path, system)
    try:
        names = _read_names(path)
        wanted = [name for name in (TIME, *required_columns(system)) if name in names]
        if twice := repeated(name for name in names if name in wanted):
            found, remedy = f"{', '.join(twice)} more than once", "Name each column once."
            raise InputError(path, "names of the columns", found, "each name once", remedy, "names")
        if len(wanted) < 1 + len(required_columns(system)):
            return pd.DataFrame(columns=names), []
        if suffix == ".parquet":
            _check_parquet(path, wanted)
            # by pandas' own metadata a column may be an index, and no column of the table
            return pq.read_table(path, columns=wanted).to_pandas(ignore_metadata=True), []
        _check_cells(path, len(names))
        return pd.read_csv(path, usecols=wanted, encoding="utf-8-sig"), []
    except InputError:
        raise
    except Exception as error:  # Arrow and pandas raise many kinds, by what is damaged
        found = " ".join(str(error).split())[:300] or type(error).__name__
        raise InputError(path, "", found, "a table", "Export it anew.", "damaged") from error


def _read_names(path: Path) -> list[str]:
    """Names of the columns of a table."""
    if path.suffix.lower() == ".parquet":
        return list(pq.read_schema(path).names)
    with path.open(encoding="utf-8-sig", newline="") as stream:
        names = next(csv.reader(stream), [])
    if not names:
        raise InputError(path, "", "an empty file", "a table", "Export it anew.", "empty")
    check_number_of_names(path, "line 1", names, "Export the columns that the system names.")
    return names


def _check_cells(path: Path, cells: int) -> None:
    """Refuse a row of a CSV with a cell too few or too many: pandas shifts its columns, or drops what is too much."""
    with path.open(encoding="utf-8-sig", newline="") as stream:
        rows = csv.reader(stream)
        next(rows, None)
        for row in rows:
            if row and len(row) != cells:
                raise InputError(
                    path,
                    f"line {rows.line_num}",
                    f"{len(row)} cells",
                    f"{cells} cells, as many as names",
                    "Export it anew, without names of rows (R: row.names = FALSE) and without commas in cells.",
                    "row_cells",
                )


def _check_parquet(path: Path, wanted: list[str]) -> None:
    """Refuse columns that are no numbers, and small files of many rows, before anything is unpacked."""
    file = pq.ParquetFile(path)
    for name in wanted:
        kind = file.schema_arrow.field(name).type
        if not (pa.types.is_floating(kind) or pa.types.is_integer(kind)):
            expected = "numbers, empty where nothing was seen"
            raise InputError(path, f"column {name}", f"{kind}", expected, "Correct it.", "not_a_number")
    size = 8 * len(wanted) * file.metadata.num_rows
    if size > max(_MOST_UNPACKED * path.stat().st_size, _SMALL):
        found = f"{file.metadata.num_rows} rows in a file of {path.stat().st_size} bytes"
        expected = f"columns that unpack to no more than {_MOST_UNPACKED} times the file"
        raise InputError(path, "", found, expected, "Export it as .csv, or with fewer rows.", "too_large")


def _joint_states(path: Path, system: System) -> tuple[pd.DataFrame, list[Finding]]:
    """Joint positions ``<joint>_m`` or ``_rad`` and efforts ``<joint>_N`` or ``_Nm`` of a log, on one even clock."""
    units = system.joint_units
    states, findings = read_joint_states(path, units)
    series = {}
    for (joint, quantity), values in states.items():
        unit = units[joint]
        if quantity == "effort":
            unit = "N" if unit == "m" else "Nm"
        series[f"{joint}_{unit}"] = values
    if not series:
        found, expected = "no joint states of this system", f"joints {', '.join(units)}"
        raise InputError(path, "", found, expected, "Name the joints so.", "joint_missing")
    # a joint that nothing reads must not cut the time that all columns cover
    wanted = {name: series[name] for name in required_columns(system) if name in series}
    if len(wanted) < len(required_columns(system)):
        # whoever reads the table says which column is missing, and which are there
        return pd.DataFrame(columns=[TIME, *series]), findings
    return _on_one_clock(path, wanted), [*findings, *_find_cut(path, wanted)]


def _find_cut(path: Path, series: Mapping[str, tuple[np.ndarray, np.ndarray]]) -> list[Finding]:
    """Return a warning where the time that all columns cover is too small a share of the log."""
    spans = {name: (time_s[0], time_s[-1]) for name, (time_s, _) in series.items()}
    starts, ends = zip(*spans.values(), strict=True)
    whole, common = max(ends) - min(starts), min(ends) - max(starts)
    if common >= _least_complete() * whole:
        return []
    place = f"column {min(spans, key=lambda name: spans[name][1] - spans[name][0])}"
    message = f"all columns are known together for {common:.4g} s of {whole:.4g} s"
    action = "cut to that time; record the joint over the whole trial, or leave it out of the description"
    return [Finding("log_cut", "warning", path.name, place, message, action)]


@cache
def _least_complete() -> float:
    """Return ``ingest.min_complete`` of a configuration that sets nothing."""
    return float(validated({}, "config", Path("defaults"))["ingest"]["min_complete"])


def _on_one_clock(path: Path, series: dict[str, tuple[np.ndarray, np.ndarray]]) -> pd.DataFrame:
    """Columns interpolated at the mean rate of the fastest one, over the time that all of them cover; NaN in holes."""
    first = max(time_s[0] for time_s, _ in series.values())
    last = min(time_s[-1] for time_s, _ in series.values())
    step = min((float(np.median(np.diff(t))) if len(t) > 1 else 0.0) for t, _ in series.values())
    longest = max(len(time_s) for time_s, _ in series.values())
    samples = (last - first) / step + 1 if step > 0 else 0.0
    if not 1 <= samples <= _MOST_SAMPLES * longest:
        found = f"{longest} messages over {last - first:.6g} s, most of them {step:.6g} s apart"
        expected, remedy = "joint states at one rate", "Record it anew."
        raise InputError(path, "times of the messages", found, expected, remedy, "time_uneven")
    time_s = first + step * np.arange(int(samples + 1e-6))
    columns = {name: _between_messages(time_s, t, values) for name, (t, values) in series.items()}
    return pd.DataFrame({TIME: time_s - first} | columns)


def _between_messages(time_s: np.ndarray, sent_s: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Return values (n,) at times (m,) [s] from messages at times (n,) [s]; NaN where messages are missing."""
    out = np.asarray(np.interp(time_s, sent_s, values))
    apart = np.diff(sent_s)
    if len(apart):
        after = np.clip(np.searchsorted(sent_s, time_s, side="left"), 1, len(apart))
        within = (time_s > sent_s[after - 1]) & (time_s < sent_s[after])
        out[within & (apart[after - 1] > _HOLE * np.median(apart))] = np.nan
    return out
