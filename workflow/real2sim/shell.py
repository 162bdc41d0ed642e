"""Command lines of the rules."""

from __future__ import annotations

import re
from collections.abc import Iterable


def braced(paths: Iterable[str]) -> str:
    """Return paths as brace expressions of bash, which expand to them in their order where they are a product.

    A command of a shell may be 128 KB long: the fits of a thousand people by name are four times that. Raises
    ValueError where a name holds anything but letters, digits and ``._-``.
    """
    rows = [tuple(path.split("/")) for path in dict.fromkeys(paths)]
    unsafe = [name for row in rows for name in row if not re.fullmatch(r"[\w.-]+", name)]
    if unsafe:
        raise ValueError(f"{unsafe[0]!r} cannot stand in a brace expression")
    for place in reversed(range(max(map(len, rows), default=0))):
        groups: dict[tuple[str, ...], list[str]] = {}
        for row in rows:
            if place < len(row):
                groups.setdefault((*row[:place], "", *row[place + 1 :]), []).append(row[place])
            else:
                groups.setdefault(row, [])
        rows = [
            (*row[:place], _alternatives(names), *row[place + 1 :]) if names else row
            for row, names in groups.items()
        ]
    return " ".join("/".join(row) for row in rows)


def _alternatives(names: list[str]) -> str:
    return names[0] if len(names) == 1 else f"{{{','.join(names)}}}"
