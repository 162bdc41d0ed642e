"""Readers of the published files: each gives one table with the columns that the machine's system.yaml names."""

from __future__ import annotations

import struct
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pandas as pd
from real2sim.errors import InputError
from real2sim.recording.formats import mat5
from real2sim.verification.systems.emps_data import read_emps

# Sample rate of the Silverbox [Hz]: 10 MHz divided by 2^14
SILVERBOX_HZ = 1e7 / 2**14


def emps(path: Path) -> pd.DataFrame:
    """Return time_s, motor_force_N and carriage_m of DATA_EMPS.mat or DATA_EMPS_PULSES.mat."""
    return pd.DataFrame(read_emps(path))


def silverbox(path: Path) -> pd.DataFrame:
    """Return time_s, input_N (1 N for 1 V) and output_m (1 mm for 1 V) of SNLS80mV.csv."""
    table = pd.read_csv(path, usecols=["V1", "V2"])
    time_s = np.arange(len(table)) / SILVERBOX_HZ
    return pd.DataFrame({"time_s": time_s, "input_N": table["V1"], "output_m": 1e-3 * table["V2"]})


def mr_damper(path: Path) -> pd.DataFrame:
    """Return time_s, table_m and damper_force_N of a file ensaio*.mat (displacement in mm there).

    Raises
    ------
    InputError
        Where the file is not one of them.
    """
    try:
        content = mat5.variables(path.read_bytes())
        step, dist, force = (np.ravel(np.asarray(content[k], float)) for k in ("Ts", "dist", "forc"))
    except (OSError, ValueError, KeyError, TypeError, struct.error) as error:
        expected = "a MATLAB 5 file with Ts, dist and forc"
        raise InputError(path, "", str(error), expected, "Give a file of the damper's data.") from error
    time_s = step[0] * np.arange(len(dist))
    return pd.DataFrame({"time_s": time_s, "table_m": 1e-3 * dist, "damper_force_N": force})


READERS: dict[str, Callable[[Path], pd.DataFrame]] = {
    "emps": emps,
    "silverbox": silverbox,
    "mr_damper": mr_damper,
}
