"""The file from which an interrupted training continues: arrays and JSON in one .npz; reading it runs no code."""

from __future__ import annotations

import json
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from real2sim.files import replacing

_NUMBERS = "about_json"


class UnusableCheckpoint(ValueError):
    """A file that no training can continue from; the message says why in a few words."""


def write_checkpoint(path: Path, arrays: Mapping[str, np.ndarray], about: Mapping[str, Any]) -> None:
    """Write named arrays of any shape as they are and ``about`` as JSON, in which numbers keep all their digits."""
    text = np.frombuffer(json.dumps(about).encode(), np.uint8)
    with replacing(path) as temporary, temporary.open("wb") as stream:
        np.savez(stream, allow_pickle=False, **{**arrays, _NUMBERS: text})


def read_checkpoint(path: Path) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """Return arrays of any shape by name and ``about`` of a checkpoint.

    Raises FileNotFoundError where there is none, and UnusableCheckpoint where the file is damaged or of another kind.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            if any(member.compress_type != zipfile.ZIP_STORED for member in archive.infolist()):
                raise UnusableCheckpoint("compressed, which no training writes")
        with path.open("rb") as file, np.load(file, allow_pickle=False) as stream:
            arrays = {name: stream[name] for name in stream.files}
        about = json.loads(arrays.pop(_NUMBERS).tobytes())
    except (FileNotFoundError, UnusableCheckpoint):
        raise
    except Exception as error:  # zip, numpy and JSON each have their own kinds
        raise UnusableCheckpoint(f"damaged, or of an older version ({type(error).__name__})") from error
    if not isinstance(about, dict):
        raise UnusableCheckpoint("damaged, or of an older version (no JSON object)")
    return arrays, about


def check_shapes(arrays: Mapping[str, np.ndarray], wanted: Mapping[str, np.ndarray]) -> None:
    """Raise UnusableCheckpoint unless all wanted arrays, of any shape, are there with their shapes and types."""
    for name, like in wanted.items():
        found = arrays.get(name)
        if found is None or found.shape != like.shape or found.dtype != like.dtype:
            raise UnusableCheckpoint(f"its {name} does not fit the training")
