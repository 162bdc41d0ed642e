"""Seeded damage to files: of bytes, and for text of cells, lines and numbers."""

import struct

ODD_NUMBERS = ("NaN", "inf", "-inf", "1e308", "-0", "0.000", "", "1,5", "1_0", "0x10", "--", "1e-320", "٣")
ODD_HEADERS = ("-1", "0", "99999999999", "nan", "inf", "", "yES", "6D", "Quaternion", "Vec3", "mm", "m", "x")
ODD_INTEGERS = (0, 1, 2, 127, 128, 255, 65535, 2**31 - 1, 2**31, 2**32 - 1)


def mutated(data, rng, *, text):
    """One to three random changes, mostly one."""
    kinds = BYTES + (TEXT if text else ())
    for _ in range((1, 1, 1, 2, 3)[rng.integers(5)]):
        data = kinds[rng.integers(len(kinds))](data, rng)
    return data


def shifted(data, rng):
    """A cell, a line end or a separator more or less somewhere in the table: everything after it shifts."""
    kinds = (delete_cell, duplicate_cell, insert_blank_cell, delete_separator, join_lines, cut_cells)
    return kinds[rng.integers(len(kinds))](data, rng)


def _place(data, rng):
    return int(rng.integers(max(len(data), 1)))


# -------------------- bytes


def flip_bytes(data, rng):
    out = bytearray(data)
    for _ in range(rng.integers(1, 9)):
        if out:
            out[_place(out, rng)] ^= int(rng.integers(1, 256))
    return bytes(out)


def odd_byte(data, rng):
    at = _place(data, rng)
    return data[:at] + rng.bytes(1) + data[at + 1 :]


def truncate(data, rng):
    return data[: _place(data, rng)]


def delete_slice(data, rng):
    at = _place(data, rng)
    return data[:at] + data[at + int(rng.integers(1, 64)) :]


def duplicate_slice(data, rng):
    at, n = _place(data, rng), int(rng.integers(1, 200))
    return data[: at + n] + data[at : at + n] + data[at + n :]


def insert_random(data, rng):
    at = _place(data, rng)
    return data[:at] + rng.bytes(int(rng.integers(1, 32))) + data[at:]


def odd_integer(data, rng):
    at, size = _place(data, rng), ("<H", "<I", "<Q", ">H")[rng.integers(4)]
    value = ODD_INTEGERS[rng.integers(len(ODD_INTEGERS))]
    width = struct.calcsize(size)
    return data[:at] + struct.pack(size, value % 256**width) + data[at + width :]


def odd_integer_in_header(data, rng):
    head = odd_integer(data[:1024], rng)[:1024]
    return head + data[len(head) :]


def swap_halves(data, rng):
    at = _place(data, rng)
    return data[at:] + data[:at]


BYTES = (
    flip_bytes,
    flip_bytes,
    odd_byte,
    truncate,
    delete_slice,
    duplicate_slice,
    insert_random,
    odd_integer,
    odd_integer_in_header,
    swap_halves,
)


# -------------------- text


def _lines(data):
    return data.decode("utf-8", errors="replace").splitlines(keepends=True)


def _joined(lines):
    return "".join(lines).encode()


def _row(lines, rng):
    """Number of a line of the table: most are."""
    return int(rng.integers(min(len(lines) - 1, 12), len(lines))) if lines else 0


def _edit_cells(data, rng, change):
    lines = _lines(data)
    if not lines:
        return data
    i = _row(lines, rng)
    body, end = lines[i].rstrip("\r\n"), lines[i][len(lines[i].rstrip("\r\n")) :]
    cells = body.split("\t")
    change(cells, int(rng.integers(len(cells))))
    lines[i] = "\t".join(cells) + end
    return _joined(lines)


def delete_cell(data, rng):
    return _edit_cells(data, rng, lambda cells, i: cells.pop(i))


def duplicate_cell(data, rng):
    return _edit_cells(data, rng, lambda cells, i: cells.insert(i, cells[i]))


def insert_blank_cell(data, rng):
    return _edit_cells(data, rng, lambda cells, i: cells.insert(i, ""))


def swap_cells(data, rng):
    def change(cells, i):
        j = int(rng.integers(len(cells)))
        cells[i], cells[j] = cells[j], cells[i]

    return _edit_cells(data, rng, change)


def odd_number(data, rng):
    def change(cells, i):
        cells[i] = ODD_NUMBERS[rng.integers(len(ODD_NUMBERS))]

    return _edit_cells(data, rng, change)


def delete_separator(data, rng):
    places = [i for i, byte in enumerate(data) if byte == 9]
    if not places:
        return data
    at = places[rng.integers(len(places))]
    return data[:at] + data[at + 1 :]


def join_lines(data, rng):
    lines = _lines(data)
    if len(lines) < 2:
        return data
    i = min(_row(lines, rng), len(lines) - 2)
    lines[i] = lines[i].rstrip("\r\n")
    return _joined(lines)


def cut_line(data, rng):
    lines = _lines(data)
    if not lines:
        return data
    i = _row(lines, rng)
    lines[i] = lines[i][: int(rng.integers(len(lines[i]) + 1))] + "\n"
    return _joined(lines)


def cut_cells(data, rng):
    def change(cells, i):
        del cells[i:]

    return _edit_cells(data, rng, change)


def delete_line(data, rng):
    lines = _lines(data)
    if lines:
        lines.pop(int(rng.integers(len(lines))))
    return _joined(lines)


def duplicate_line(data, rng):
    lines = _lines(data)
    if lines:
        i = int(rng.integers(len(lines)))
        lines.insert(i, lines[i])
    return _joined(lines)


def swap_lines(data, rng):
    lines = _lines(data)
    if lines:
        i, j = rng.integers(len(lines), size=2)
        lines[i], lines[j] = lines[j], lines[i]
    return _joined(lines)


def odd_header(data, rng):
    lines = _lines(data)
    if not lines:
        return data
    i = int(rng.integers(min(len(lines), 12)))
    separator = "=" if "=" in lines[i] else "\t"
    cells = lines[i].rstrip("\r\n").split(separator)
    cells[int(rng.integers(len(cells)))] = ODD_HEADERS[rng.integers(len(ODD_HEADERS))]
    lines[i] = separator.join(cells) + "\n"
    return _joined(lines)


TEXT = (
    delete_cell,
    duplicate_cell,
    insert_blank_cell,
    swap_cells,
    odd_number,
    odd_number,
    delete_separator,
    join_lines,
    cut_line,
    delete_line,
    duplicate_line,
    swap_lines,
    odd_header,
    odd_header,
)
