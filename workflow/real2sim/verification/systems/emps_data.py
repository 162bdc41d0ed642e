"""Reader for the published measurements of the EMPS benchmark (DATA_EMPS.mat, DATA_EMPS_PULSES.mat).

Source: A. Janot, M. Gautier, M. Brunot, "Data set and reference models of EMPS", Workshop on Nonlinear System
Identification Benchmarks, Eindhoven 2019, nonlinearbenchmark.org. The data come without a licence and are not part of
this project.
"""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np

from real2sim.errors import InputError
from real2sim.recording.formats import mat5

_NEEDED = ("t", "qm", "vir", "gtau")


def read_emps(path: Path) -> dict[str, np.ndarray]:
    """Return the columns of a published record as resources/systems/emps names them.

    time_s [s], motor_force_N [N] (motor voltage times drive gain) and carriage_m [m], each (24841,) at 1 kHz. The
    carriage moves from the first sample on. The voltage of the validation record holds its force pulses already: a
    regression of that force on acceleration, velocity, sign of velocity and pulses_N gives the pulses a factor of
    0.001.

    Raises
    ------
    InputError
        Where the file is not a record of the benchmark.
    """
    try:
        content = mat5.variables(Path(path).read_bytes())
        t, q, volt, gain = (np.ravel(np.asarray(content[name], float)) for name in _NEEDED)
    except (OSError, ValueError, KeyError, TypeError, struct.error) as error:
        raise InputError(
            path, "", str(error), f"a MATLAB 5 file with {', '.join(_NEEDED)}", "Give a record of EMPS."
        ) from error
    return {"time_s": t, "motor_force_N": gain[0] * volt, "carriage_m": q}
