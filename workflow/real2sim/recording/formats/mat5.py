"""MATLAB 5 files (v6 and v7): variables as plain Python, every size checked before it is used.

scipy.io reads the same files, but crashes the process on damaged ones. Objects, functions and sparse arrays,
which no export of trajectories holds, are None.
https://www.mathworks.com/help/pdf_doc/matlab/matfile_format.pdf
"""

from __future__ import annotations

import struct
import zlib
from typing import Any

import numpy as np

_HEADER = 128
# Compressed variables may take so many times the file's size, or so many bytes if that is more: positions reach 2 times
_MOST_UNPACKED, _SMALL = 5, 1 << 24
_DEPTH = 16
_MOST_ARRAYS = 100_000  # in a cell or struct; each takes a hundred bytes and more
_MATRIX, _COMPRESSED = 14, 15
_NUMBERS = {
    1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 9: "f8", 12: "i8", 13: "u8",
}  # fmt: skip
_TEXT = {1: "latin-1", 2: "latin-1", 16: "utf-8", 4: "utf-16", 17: "utf-16", 18: "utf-32"}
_CELL, _STRUCT, _CHAR = 1, 2, 4
_NUMERIC = range(6, 16)


def variables(raw: bytes) -> dict[str, Any]:
    """Variables by name: struct as dict (a list of them if not 1 x 1), cell as list, char as str, else array.

    Raises ValueError or struct.error where the bytes are not what they say.
    """
    order = "<" if raw[126:128] == b"IM" else ">"
    out: dict[str, Any] = {}
    left = max(_MOST_UNPACKED * len(raw), _SMALL)
    data, at = memoryview(raw)[_HEADER:], 0
    while at + 8 <= len(data):
        kind, body, at = _element(data, at, order)
        if kind == _COMPRESSED:
            inflate = zlib.decompressobj()
            whole = memoryview(inflate.decompress(body, max(left, 1)))
            left -= len(whole)
            if inflate.unconsumed_tail and left <= 0:
                raise ValueError(
                    f"variables that unpack to more than {_MOST_UNPACKED} times the file: save with -v6"
                )
            if inflate.unconsumed_tail or not inflate.eof:
                raise ValueError("a variable that does not decompress")
            kind, body, _ = _element(whole, 0, order)
        if kind != _MATRIX:
            raise ValueError(f"an element of type {kind} where a variable should be")
        name, value = _matrix(body, order, 0)
        out[name] = value
    return out


def _element(data: memoryview, at: int, order: str) -> tuple[int, memoryview, int]:
    """Type and bytes of the element at ``at``, and where the next one starts."""
    kind, size = struct.unpack_from(f"{order}II", data, at)
    if kind >> 16:  # small: size and type share four bytes, the data the next four
        if kind >> 16 > 4:
            raise ValueError("a small element of more than four bytes")
        return kind & 0xFFFF, data[at + 4 : at + 4 + (kind >> 16)], at + 8
    body = data[at + 8 : at + 8 + size]
    if len(body) < size:
        raise ValueError(f"an element of {size} bytes where {len(body)} are left")
    return kind, body, at + 8 + (size if kind == _COMPRESSED else -(-size // 8) * 8)


def _matrix(body: memoryview, order: str, depth: int) -> tuple[str, Any]:
    """Name and value of one array."""
    if not len(body):
        return "", np.empty((0, 0))
    if depth > _DEPTH:
        raise ValueError("arrays nested too deeply")
    _, flags, at = _element(body, 0, order)
    _, sizes, at = _element(body, at, order)
    _, name, at = _element(body, at, order)
    kind = struct.unpack_from(f"{order}I", flags)[0] & 0xFF
    shape = struct.unpack(f"{order}{len(sizes) // 4}i", sizes[: len(sizes) // 4 * 4])
    count = 1
    for n in shape:
        count *= n
    if not 2 <= len(shape) <= 8 or min(shape) < 0 or count > len(body):
        raise ValueError(f"an array of shape {shape} in {len(body)} bytes")
    text = bytes(name).decode("latin-1")
    if kind in _NUMERIC or kind == _CHAR:
        element, data, _ = _element(body, at, order)
        return text, _text(element, data) if kind == _CHAR else _array(element, data, shape, order)
    if kind == _CELL:
        return text, _arrays(body, at, count, order, depth)[0]
    if kind == _STRUCT:
        return text, _struct(body, at, count, order, depth)
    return text, None


def _array(element: int, data: memoryview, shape: tuple[int, ...], order: str) -> np.ndarray:
    if element not in _NUMBERS:
        raise ValueError(f"numbers of type {element}")
    values = np.frombuffer(data, f"{order}{_NUMBERS[element]}")
    return values.reshape(shape, order="F")  # ValueError where they are not as many


def _text(element: int, data: memoryview) -> str:
    if element not in _TEXT:
        raise ValueError(f"text of type {element}")
    return bytes(data).decode(_TEXT[element], errors="replace")


def _arrays(body: memoryview, at: int, count: int, order: str, depth: int) -> tuple[list[Any], int]:
    """The next ``count`` arrays, and where they end."""
    if 8 * count > len(body) - at:
        raise ValueError(f"{count} arrays in {len(body) - at} bytes")
    if count > _MOST_ARRAYS:
        raise ValueError(f"{count} arrays in one, no more than {_MOST_ARRAYS} are read")
    out = []
    for _ in range(count):
        kind, data, at = _element(body, at, order)
        if kind != _MATRIX:
            raise ValueError(f"an element of type {kind} where an array should be")
        out.append(_matrix(data, order, depth + 1)[1])
    return out, at


def _struct(body: memoryview, at: int, count: int, order: str, depth: int) -> Any:
    _, length, at = _element(body, at, order)
    (width,) = struct.unpack_from(f"{order}i", length)
    _, names, at = _element(body, at, order)
    if not 0 < width <= 256 or len(names) % width:
        raise ValueError(f"field names of {width} bytes in {len(names)}")
    raw = bytes(names)
    fields = [raw[i : i + width].split(b"\0")[0].decode("latin-1") for i in range(0, len(raw), width)]
    values, _ = _arrays(body, at, count * len(fields), order, depth)
    rows = [
        dict(zip(fields, values[i * len(fields) : (i + 1) * len(fields)], strict=True)) for i in range(count)
    ]
    return rows[0] if count == 1 else rows
