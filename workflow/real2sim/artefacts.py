"""The small text files that stages hand to each other: JSON and CSV."""

from __future__ import annotations

import csv
import io
import json
import math
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from real2sim.errors import InputError
from real2sim.files import write_text


def write_json(path: Path, content: Mapping[str, Any]) -> None:
    """Write a JSON file; NaN is refused (write None where there is no number)."""
    write_text(path, json.dumps(content, indent=1, allow_nan=False, ensure_ascii=False) + "\n")


def read_json(path: Path, required: Iterable[str] = ()) -> dict[str, Any]:
    """Read a JSON object; raises InputError where it is broken or a required key is missing."""
    try:
        content: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise InputError(
            path, "", str(error), "a readable JSON file", "Delete the file and run again."
        ) from error
    missing = [key for key in required if key not in content]
    if missing:
        found = ", ".join(map(str, content)) if isinstance(content, dict) else type(content).__name__
        raise InputError(path, "top level", found, ", ".join(missing), "Delete the file and run again.")
    return content


def finite_or_none(value: float) -> float | None:
    """Return the number, or None (JSON null) where it is NaN or infinite."""
    return float(value) if math.isfinite(value) else None


def _cell(value: Any) -> str:
    if value is None:
        return ""
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, float):
        return repr(float(value)) if math.isfinite(value) else ""
    return str(value)


def write_table(path: Path, columns: Sequence[str], rows: Iterable[Mapping[str, Any]]) -> None:
    """Write a CSV with the given columns; NaN and None become empty cells, floats keep all digits."""
    stream = io.StringIO(newline="")
    writer = csv.writer(stream, lineterminator="\n")
    writer.writerow(columns)
    for row in rows:
        writer.writerow([_cell(row.get(column)) for column in columns])
    write_text(path, stream.getvalue())


def read_table(path: Path, required: Iterable[str] = ()) -> list[dict[str, str]]:
    """Read a CSV as a list of rows of text; raises InputError where a required column is missing."""
    with path.open(encoding="utf-8", newline="") as stream:
        reader = csv.DictReader(stream)
        rows = list(reader)
        columns = list(reader.fieldnames or [])
    missing = [column for column in required if column not in columns]
    if missing:
        raise InputError(
            path,
            "header",
            ", ".join(columns) or "nothing",
            ", ".join(missing),
            "Restore the file from the repository, or delete it if a stage of the pipeline wrote it.",
        )
    return rows


def is_phantom(rows: Iterable[Mapping[str, Any]]) -> bool:
    """Return whether any of these rows of tables, or contents of JSON files, rests on synthetic people."""
    return any(row.get("phantom") in (True, "true") for row in rows)


def number(text: str) -> float:
    """Return the number in a CSV cell, NaN if the cell is empty."""
    return float(text) if text else math.nan


def needs_people(minimum: int, have: int) -> str:
    """Return the status text of a result that cannot be had from so few people."""
    return f"needs at least {minimum} people, have {have}"
