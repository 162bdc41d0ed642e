"""Reading of MJCF files with refusals that name the file, its code and what to do."""

from __future__ import annotations

import os
from pathlib import Path

import mujoco

from real2sim.errors import InputError
from real2sim.system.model_files import find_attachment_loop, model_files


def read_model(path: Path) -> mujoco.MjSpec:
    """Return the description in an MJCF; neither it nor a file that it pulls in may be a folder or a pipe.

    Raises
    ------
    InputError
        `no_file` naming the MJCF or the file that it pulls in, or `model` where MuJoCo does not read it.
    """
    path = Path(path)
    for file in model_files(path):
        if os.path.exists(file) and not os.path.isfile(file):
            # opening a pipe would wait for ever
            found = "a folder" if os.path.isdir(file) else "a pipe, socket or device"
            raise InputError(
                file, "", found, f"a file of the model {path.name}", "Put the file itself there.", "no_file"
            )
    if not os.path.exists(path):
        raise InputError(path, "", "no such file", "an MJCF", "Check the path.", "no_file")
    loop = find_attachment_loop(path)
    if loop is not None:
        found, remedy = (
            f"{loop} attaches itself, or is attached by what it attaches",
            "Remove the attachment.",
        )
        raise InputError(path, "asset, model", found, "models that attach others", remedy, "model")
    try:
        return mujoco.MjSpec.from_file(str(path))
    except (ValueError, OSError) as error:
        found = " ".join(str(error).split()) or "a file that MuJoCo does not read"
        raise InputError(path, "", found, "an MJCF that compiles", "Correct the file.", "model") from error


def without_drives(spec: mujoco.MjSpec) -> None:
    """Take away a model's own actuators, and the sensors and keyframes that may name them.

    What drives a joint stands in the recording, and controllers stand in the description or the configuration.
    """
    for element in [*spec.sensors, *spec.keys, *spec.actuators]:
        spec.delete(element)
