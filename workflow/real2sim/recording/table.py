"""Recordings of a described system: one table with named columns and units, from CSV, Parquet or MCAP."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from real2sim.errors import InputError
from real2sim.recording.formats.mcap_file import Undecodable, decoder, read_messages
from real2sim.system.description import POSE, System

TIME = "time_s"
# Largest departure of an interval between samples from their mean, as a share of it
UNEVEN = 0.01


@dataclass(frozen=True)
class Recording:
    """One trial: ``columns`` (n,) by name [SI] at ``time_s`` (n,), evenly spaced [s]; NaN where a marker was lost."""

    name: str
    time_s: np.ndarray
    columns: Mapping[str, np.ndarray]

    @classmethod
    def read(cls, system: System, path: Path | str) -> Recording:
        """Read a table (.parquet, .csv) or joint states (.mcap) that hold what a system names.

        Raises
        ------
        InputError
            Naming the file and the column, where one is missing, not a number, or the times are not even.
        """
        path = Path(path)
        return cls.from_table(system, _read_table(path, system), path.stem, path)

    @classmethod
    def from_table(
        cls, system: System, table: pd.DataFrame, name: str = "recording", source: Path | str = ""
    ) -> Recording:
        """Check a table against the columns that a system names, as `read`; other columns are left out."""
        source = Path(source or name)
        wanted = required_columns(system)
        missing = [column for column in (TIME, *wanted) if column not in table.columns]
        if missing:
            raise InputError(
                source,
                f"column {', '.join(missing)}",
                f"columns {', '.join(map(str, table.columns))}",
                f"the columns of system {system.name}: {', '.join((TIME, *wanted))}",
                "Rename or add the columns; units stand in the names.",
            )
        columns = {c: _numbers(table[c], source) for c in (TIME, *wanted)}
        time_s = columns.pop(TIME)
        _check_time(time_s, source)
        return cls(name, time_s, columns)

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


def log_columns(system: System) -> dict[str, str]:
    """Return the column of each logged joint of the machine, by joint: ``<joint>_m`` or ``<joint>_rad``."""
    units = system.joint_units
    return {joint.name: f"{joint.name}_{units[joint.name]}" for joint in system.machine if joint.logged}


def _numbers(column: pd.Series, source: Path) -> np.ndarray:
    try:
        return column.to_numpy(dtype=float)
    except (TypeError, ValueError) as error:
        raise InputError(
            source,
            f"column {column.name}",
            str(error),
            "numbers, empty where nothing was seen",
            "Correct it.",
        ) from error


def _check_time(time_s: np.ndarray, source: Path) -> None:
    steps = np.diff(time_s)
    if len(time_s) < 10 or not np.isfinite(time_s).all():
        raise InputError(
            source,
            TIME,
            f"{len(time_s)} samples, not all finite",
            "ten and more, all finite",
            "Export it anew.",
        )
    if np.abs(steps - steps.mean()).max() > UNEVEN * steps.mean() or steps.mean() <= 0:
        row = int(np.argmax(np.abs(steps - steps.mean()))) + 1
        raise InputError(
            source,
            f"{TIME}, row {row + 1}",
            f"an interval of {steps[row - 1]:.6g} s where the mean is {steps.mean():.6g} s",
            "evenly spaced times",
            "Resample the recording on one clock.",
        )


def _read_table(path: Path, system: System) -> pd.DataFrame:
    """Rows of a table or of the joint states of a log."""
    suffix = path.suffix.lower()
    if suffix not in (".parquet", ".csv", ".mcap"):
        raise InputError(
            path, "", f"a file {suffix}", "a table .parquet or .csv, or a log .mcap", "Export it as one."
        )
    if not path.is_file():
        raise InputError(path, "", "no such file", "a recording", "Check the path.")
    if suffix == ".mcap":
        return _joint_states(path, system)
    try:
        return pd.read_parquet(path) if suffix == ".parquet" else pd.read_csv(path)
    except (ValueError, OSError) as error:
        raise InputError(path, "", str(error), "a table", "Export it anew.") from error


def _joint_states(path: Path, system: System) -> pd.DataFrame:
    """Joint positions ``<joint>_m`` or ``_rad`` and efforts ``<joint>_N`` or ``_Nm`` of a log, on one even clock.

    Times are those of the messages' headers. Each topic of sensor_msgs/JointState is read.
    """
    units = system.joint_units
    rows: dict[str, list[tuple[float, float]]] = {}
    for message in read_messages(path):
        if not message.channel.schema_name.endswith("JointState"):
            continue
        try:
            state = decoder(message.channel)(message.data)
        except Undecodable as error:
            raise InputError(
                path, message.channel.topic, str(error), "joint states", "Record it anew."
            ) from error
        at = _stamp_s(state, message.log_time)
        for quantity, forces in (("position", False), ("effort", True)):
            for joint, value in zip(_field(state, "name"), _field(state, quantity), strict=False):
                if joint in units:
                    unit = units[joint]
                    unit = ("N" if unit == "m" else "Nm") if forces else unit
                    rows.setdefault(f"{joint}_{unit}", []).append((at, float(value)))
    if not rows:
        raise InputError(
            path, "", "no joint states of this system", f"joints {', '.join(units)}", "Name the joints so."
        )
    return _on_one_clock(rows)


def _field(message: Any, name: str) -> Any:
    return message.get(name, ()) if isinstance(message, dict) else getattr(message, name, ())


def _stamp_s(message: Any, log_time: int) -> float:
    """Time of a message's header [s], or of the log where the header has none."""
    stamp = _field(_field(message, "header"), "stamp")
    sec, nanosec = _field(stamp, "sec"), _field(stamp, "nanosec")
    return float(sec) + float(nanosec) * 1e-9 if sec or nanosec else log_time * 1e-9


def _on_one_clock(rows: dict[str, list[tuple[float, float]]]) -> pd.DataFrame:
    """Columns interpolated at the mean rate of the fastest one, over the time that all of them cover."""
    series = {name: np.array(sorted(values)) for name, values in rows.items()}
    first = max(s[0, 0] for s in series.values())
    last = min(s[-1, 0] for s in series.values())
    step = min(float(np.median(np.diff(s[:, 0]))) for s in series.values())
    time_s = first + step * np.arange(max(int((last - first) / step) + 1, 0))
    columns = {name: np.interp(time_s, s[:, 0], s[:, 1]) for name, s in series.items()}
    return pd.DataFrame({TIME: time_s - first} | columns)
