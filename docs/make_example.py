"""Bring the numbers of the worked example of docs/diagnosis-json.md up to date.

python docs/make_example.py results/diagnosis/S05/diagnosis.json

The example keeps its layout and what it leaves out. Where the answer has other words or other keys than the example,
the script says which and changes nothing.
"""

from __future__ import annotations

import json
import re
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

PAGE = Path(__file__).parent / "diagnosis-json.md"
_BLOCK = re.compile(r"(?<=```text\n)\{\n.*?\n\}(?=\n```)", re.DOTALL)
_TOKEN = re.compile(r'"(?:[^"\\]|\\.)*"|-?\d+(?:\.\d+)?(?:[eE][-+]?\d+)?')
_DIGITS = 5


def numbers(shown: Any, told: Any, place: str) -> Iterator[float]:
    """Yield the answer's numbers in the order in which the example shows them.

    Raises
    ------
    ValueError
        Naming the place where the answer has something else than the example.
    """
    if isinstance(shown, dict):
        for key, value in shown.items():
            if key != "...":
                yield from numbers(value, told[key], f"{place}.{key}")
    elif isinstance(shown, list):
        for i, value in enumerate(v for v in shown if not str(v).startswith("... ")):
            yield from numbers(value, told[i], f"{place}[{i}]")
    elif isinstance(shown, int | float) and not isinstance(shown, bool):
        yield told
    elif shown != told and not str(shown).endswith("..."):
        raise ValueError(f"{place}: {told!r}, and {shown!r} in the example")


def updated(block: str, told: dict[str, Any]) -> str:
    """Return the example with the numbers of an answer."""
    values = numbers(json.loads(block), told, "answer")

    def number(token: re.Match[str]) -> str:
        if token[0].startswith('"'):
            return token[0]
        value = next(values)
        return json.dumps(value if isinstance(value, int) else float(f"{value:.{_DIGITS}g}"))

    return _TOKEN.sub(number, block)


def main() -> None:
    """Rewrite the page."""
    told = json.loads(Path(sys.argv[1]).read_text(encoding="utf-8"))
    page = PAGE.read_text(encoding="utf-8")
    PAGE.write_text(_BLOCK.sub(lambda block: updated(block[0], told), page), encoding="utf-8")


if __name__ == "__main__":
    main()
