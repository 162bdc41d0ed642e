"""What the text formats share: lines of a file, and tables of numbers that never shift a cell."""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Iterable, Sequence
from pathlib import Path
from typing import Any, overload

import numpy as np

from real2sim.errors import InputError
from real2sim.recording.formats.recordings import Finding

_HEAD = 1000  # lines within which the row of names is looked for
_MOST_NAMES = 10_000  # markers or coordinates of a file
_LARGE = 20_000  # cells from which on the fast parser pays
_FEED, _BLANK = b"\n "
_ASCII = 127
_AGAIN = "the file may be cut off or edited: export it again"


class Lines(Sequence[str]):
    """Lines of a text file between the line feeds of its bytes ``raw`` (UTF-8); each is decoded where it is used.

    A list of texts takes ten times the memory of a file with short lines.
    """

    def __init__(self, raw: bytes):
        self.raw = raw
        feeds = np.flatnonzero(np.frombuffer(raw, np.uint8) == _FEED)
        # four bytes a line: a file of blank lines has one byte for each
        self.starts = np.empty(len(feeds) + 2, np.uint32 if len(raw) < 1 << 32 - 1 else np.uint64)
        self.starts[0], self.starts[-1] = 0, len(raw) + 1
        np.add(feeds, 1, out=self.starts[1:-1], casting="unsafe")

    def __len__(self) -> int:
        return len(self.starts) - 1

    @overload
    def __getitem__(self, index: int) -> str: ...

    @overload
    def __getitem__(self, index: slice) -> list[str]: ...

    def __getitem__(self, index: int | slice) -> str | list[str]:
        if isinstance(index, slice):
            return [self[i] for i in range(*index.indices(len(self)))]
        if index < 0:
            index += len(self)
        if not 0 <= index < len(self):
            raise IndexError(index)
        return self.raw[self.starts[index] : self.starts[index + 1] - 1].decode()

    def filled(self, first: int) -> np.ndarray:
        """Return the indices (k,) of the lines from ``first`` on that have more than blanks."""
        rows = first + np.flatnonzero(np.diff(self.starts[first:]) > 1)
        starts = np.frombuffer(self.raw, np.uint8)[self.starts[rows]]
        doubtful = np.flatnonzero((starts <= _BLANK) | (starts > _ASCII))
        kept = np.ones(len(rows), bool)
        kept[doubtful] = [bool(self[rows[k]].strip()) for k in doubtful]
        return np.asarray(rows[kept])

    def tabs(self, rows: np.ndarray) -> np.ndarray:
        """Return how many tabs (k,) the lines ``rows`` (k,) have."""
        raw, starts = self.raw, self.starts
        return np.fromiter(
            (raw.count(b"\t", starts[i], starts[i + 1] - 1) for i in rows), np.int32, len(rows)
        )


def check_number_of_names(path: Path, place: str, names: Collection[str], remedy: str) -> None:
    """Refuse more names than any recording has: each makes arrays that take hundreds of bytes."""
    if len(names) > _MOST_NAMES:
        found, expected = f"{len(names)} names", f"no more than {_MOST_NAMES}"
        raise InputError(path, place, found, expected, remedy, "columns")


def repeated(names: Iterable[str]) -> list[str]:
    """Return the names that stand more than once, in order."""
    return sorted(name for name, count in Counter(names).items() if count > 1)


def read_lines(path: Path, expected: str, remedy: str) -> Lines:
    """Lines of a text file, whatever its line ends; UTF-8 with or without mark, else Windows-1252.

    Raises InputError where the file cannot be opened, is empty, is binary or is text in UTF-16.
    """
    raw = read_bytes(path, expected, remedy)
    refuse_utf_16(path, raw, expected)
    if b"\0" in raw:
        raise InputError(path, "", "binary data", f"{expected} (text)", remedy, "binary")
    if b"\r" in raw:  # on bytes, which is five times as fast
        raw = raw.replace(b"\r\n", b"\n").replace(b"\r", b"\n")
    raw = raw.removeprefix(b"\xef\xbb\xbf")
    try:
        raw.decode()
    except UnicodeDecodeError:
        raw = raw.decode("cp1252", errors="replace").encode()
    return Lines(raw)


def divide_by_tabs(path: Path, lines: Lines, first: str, findings: list[Finding]) -> Lines:
    """Return the lines with tabs between cells, where commas divide the row of names, whose first cell is ``first``.

    Commas count as dividers by the row of names alone, so that a decimal comma is never taken for one.
    """
    start = f"{first},"
    at = next((i for i, line in enumerate(lines[:_HEAD]) if line.strip().lower().startswith(start)), None)
    if at is None or "\t" in lines[at]:
        return lines
    message = "commas divide the cells"
    findings.append(
        Finding("commas", "info", path.name, f"line {at + 1}", message, "read as if they were tabs")
    )
    return Lines(lines.raw.replace(b",", b"\t"))


def refuse_utf_16(path: Path, head: bytes, expected: str) -> None:
    """Refuse a file that begins with the mark of UTF-16, which spreadsheets write where Unicode text is asked for."""
    if head.startswith((b"\xff\xfe", b"\xfe\xff")):
        remedy = "export it again, or save the text as UTF-8"
        raise InputError(path, "", "text in UTF-16", f"{expected}, as text in UTF-8", remedy, "utf_16")


def read_bytes(path: Path, expected: str, remedy: str) -> bytes:
    """Contents of a file. Raises InputError where it cannot be opened or is empty."""
    try:
        raw = path.read_bytes()
    except OSError as error:
        raise InputError(path, "", f"{error.strerror or error}", expected, remedy, "unreadable") from error
    if not raw[:4096].strip() and not raw.strip():
        raise InputError(path, "", "an empty file", expected, remedy, "empty")
    return raw


def stripped(cells: list[str]) -> list[str]:
    """Cells without blanks around them and without empty ones at the end."""
    cells = [cell.strip() for cell in cells]
    while cells and not cells[-1]:
        cells.pop()
    return cells


def cells_of(line: str) -> list[str]:
    """Cells of a line: between tabs, or between blanks where there is no tab."""
    return line.split("\t") if "\t" in line else line.split()


def number(path: Path, line: int, column: int, cell: str, *, blank: bool) -> float:
    """One cell, NaN where it is blank and may be. Raises InputError with the place (both counted from 0)."""
    text = cell.strip()
    if not text and blank:
        return np.nan
    try:
        if "_" in text or not text.isascii():  # Python reads 1_000 and Arabic digits, no export writes them
            raise ValueError
        return float(text)
    except ValueError:
        remedy = "export with a decimal point" if "," in cell else _AGAIN
        place = f"line {line + 1}, column {column + 1}"
        raise InputError(path, place, repr(cell), "a number", remedy, "not_a_number") from None


def read_table(
    path: Path, lines: Sequence[str], rows: np.ndarray, width: int, expected: str, *, blank: bool = True
) -> np.ndarray:
    """Numbers (n, width) of the lines ``rows``; NaN where a cell is blank.

    All rows must have the same number of cells, ``width`` or more with only blanks beyond: a row with a cell
    too few or too many cannot be put right by cutting its end. Only the last row may lack the tab that ends the
    others. Raises InputError with the line.
    """
    if not len(rows):
        return np.empty((0, width))
    tab_counts = _tab_counts(lines, rows)
    tabs = bool(tab_counts.any())
    counts = tab_counts + 1 if tabs else np.array([len(lines[i].split()) for i in rows])
    if tabs and _lacks_only_the_last_tab(lines, rows, counts, width):
        lines = _with_last_tab(lines, rows)
        counts[-1] += 1
    values, times = np.unique(counts, return_counts=True)
    usual = int(values[len(times) - 1 - np.argmax(times[::-1])])  # the larger of two that are as many
    wrong = np.flatnonzero((counts != usual) | (counts < width))
    if len(wrong):
        count = int(counts[wrong[0]])
        found = f"{count} cells" + (f", {usual} in most rows" if count != usual else "")
        wanted = f"{usual} cells as in most rows" if count == width else f"{width} cells ({expected})"
        raise InputError(path, f"line {rows[wrong[0]] + 1}", found, wanted, _AGAIN, "row_cells")
    table = _fast(lines, rows, usual, blank) if tabs and len(rows) * usual > _LARGE else None
    if table is None:
        table = np.empty((len(rows), usual))
        for k, i in enumerate(rows):  # row by row: numbers as Python has them take sixteen times their text
            cells = lines[i].split("\t") if tabs else lines[i].split()
            table[k] = [
                number(path, int(i), c, cell, blank=blank or c >= width) for c, cell in enumerate(cells)
            ]
    beyond = np.argwhere(~np.isnan(table[:, width:])) if usual > width else np.empty((0, 2), int)
    if len(beyond):
        i, found = rows[beyond[0][0]], f"{usual} cells with numbers in all of them"
        raise InputError(path, f"line {i + 1}", found, f"{width} cells ({expected})", _AGAIN, "row_cells")
    infinite = np.argwhere(np.isinf(table)) if np.isinf(table).any() else np.empty((0, 2), int)
    if len(infinite):
        place = f"line {rows[infinite[0][0]] + 1}, column {infinite[0][1] + 1}"
        raise InputError(path, place, "an infinite value", "a number", _AGAIN, "not_finite")
    return table[:, :width]


def _tab_counts(lines: Sequence[str], rows: np.ndarray) -> np.ndarray:
    if isinstance(lines, Lines):
        return lines.tabs(rows)
    return np.array([lines[i].count("\t") for i in rows])


def _lacks_only_the_last_tab(lines: Sequence[str], rows: np.ndarray, counts: np.ndarray, width: int) -> bool:
    """Return whether a tab ends every row but the last, and the last row is whole.

    A file that breaks off within its last number looks alike: the last row is whole if a line feed follows it, or
    if its last number has as many decimals as the one above.
    """
    if len(rows) < 2 or (counts[:-1] != counts[-1] + 1).any() or counts[-1] < width:
        return False
    if any(not lines[i].endswith("\t") for i in rows[:-1]) or lines[rows[-1]].endswith("\t"):
        return False
    above, last = (lines[i].rstrip("\t").rpartition("\t")[2].strip() for i in rows[-2:])
    return bool(rows[-1] + 1 < len(lines) or ("." in last and _decimals(last) == _decimals(above)))


def _with_last_tab(lines: Sequence[str], rows: np.ndarray) -> Sequence[str]:
    """Return the lines up to the last row, and that row with a tab at its end."""
    if isinstance(lines, Lines):
        return Lines(lines.raw[: lines.starts[rows[-1] + 1] - 1] + b"\t")
    return [*lines[: rows[-1]], lines[rows[-1]] + "\t"]


def _decimals(cell: str) -> int:
    return len(cell.partition(".")[2])


def _fast(lines: Sequence[str], rows: np.ndarray, width: int, blank: bool) -> np.ndarray | None:
    """The same by Arrow; None where anything is out of the ordinary, so that the slow way can name it."""
    import pyarrow
    from pyarrow import csv

    text = _body(lines, rows)
    names = [str(i) for i in range(width)]
    convert = csv.ConvertOptions(
        column_types={name: pyarrow.float64() for name in names},
        null_values=["", "NaN", "nan", "NAN"],
        strings_can_be_null=False,
    )
    parse = csv.ParseOptions(delimiter="\t", quote_char=False, ignore_empty_lines=True)
    # threads read pieces ahead, as many as the machine is slow, and hold them all
    read = csv.ReadOptions(column_names=names, block_size=1 << 20, use_threads=False)
    out, at = np.empty((len(rows), width)), 0
    try:
        # piece by piece: the whole table twice takes more memory than the bar for a file of one digit a cell
        for batch in csv.open_csv(pyarrow.BufferReader(text), read, parse, convert):
            nulls = not blank and any(column.null_count for column in batch.columns)
            if nulls or at + batch.num_rows > len(rows):
                return None
            out[at : at + batch.num_rows] = np.stack([_numbers(column) for column in batch.columns]).T
            at += batch.num_rows
    except (pyarrow.ArrowException, UnicodeDecodeError):
        return None
    return out if at == len(rows) else None


def _numbers(column: Any) -> np.ndarray:
    """An Arrow array by its buffers, null as NaN: to_numpy() would import pandas, which takes a second."""
    valid, data = column.buffers()
    span = slice(column.offset, column.offset + len(column))
    values = np.frombuffer(data, float)[span]
    if not column.null_count:
        return values
    known = np.unpackbits(np.frombuffer(valid, np.uint8), bitorder="little")[span]
    return np.where(known, values, np.nan)


def _body(lines: Sequence[str], rows: np.ndarray) -> bytes | memoryview:
    """The bytes of some lines; without a copy where no other line with anything in it lies between or after them."""
    if isinstance(lines, Lines):
        lengths = np.diff(lines.starts[rows[0] :])
        if np.count_nonzero(lengths > 1) == np.count_nonzero(lengths[rows - rows[0]] > 1):
            return memoryview(lines.raw)[lines.starts[rows[0]] :]
    return "\n".join(map(lines.__getitem__, rows)).encode()


def increasing(path: Path, values: np.ndarray, name: str, rows: np.ndarray, column: int) -> None:
    """Raise InputError unless a column (n,) on lines ``rows`` (n,) increases row by row and starts with a number."""
    wrong = np.flatnonzero(~(np.diff(values) > 0))
    if not len(values) or (not len(wrong) and np.isfinite(values[0])):
        return
    i = int(wrong[0]) + 1 if len(wrong) else 0
    found = f"{name} {values[i]:g}" + (f" after {values[i - 1]:g}" if i else "")
    remedy = "export the trial again; do not join or sort exports by hand"
    place = f"line {rows[i] + 1}, column {column + 1}"
    raise InputError(path, place, found, f"{name} increasing row by row", remedy, "time_order")
