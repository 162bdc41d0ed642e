"""The one exception a user is meant to read."""

from __future__ import annotations

from pathlib import Path


class InputError(Exception):
    """Something that a person gave us cannot be used as it is.

    Parameters
    ----------
    path
        The file (or folder) that is at fault.
    place
        Where in it: a line, a column, a key, a time span. Empty if the whole file.
    found
        What is there.
    expected
        What should be there.
    remedy
        What to do about it, as one imperative sentence.
    code
        Name of the refusal in docs/quality-codes.md; empty where there is none.
    """

    def __init__(self, path: Path | str, place: str, found: str, expected: str, remedy: str, code: str = ""):
        self.path, self.place = Path(path), place
        self.found, self.expected, self.remedy, self.code = found, expected, remedy, code
        where = f"{path}, {place}" if place else f"{path}"
        last = f"\n  code:     {code} (docs/quality-codes.md)" if code else ""
        super().__init__(f"{where}\n  found:    {found}\n  expected: {expected}\n  remedy:   {remedy}{last}")

    def __reduce__(self) -> tuple[type[InputError], tuple[Path, str, str, str, str, str]]:
        return (InputError, (self.path, self.place, self.found, self.expected, self.remedy, self.code))
