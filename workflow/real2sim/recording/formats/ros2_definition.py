"""ROS 2 message definitions as an MCAP stores them (ros2msg), and how many bytes of CDR a message takes.

A definition is walked over a payload without decoding it: counts that the payload cannot hold are refused before
anything is allocated for them, and bytes that the definition does not account for are seen.
https://docs.ros.org/en/rolling/Concepts/Basic/About-Interfaces.html, https://www.omg.org/spec/DDSI-RTPS (CDR)
"""

from __future__ import annotations

import re
import struct
from dataclasses import dataclass

_SIZES = {
    **dict.fromkeys(("bool", "byte", "char", "int8", "uint8"), 1),
    **dict.fromkeys(("int16", "uint16"), 2),
    **dict.fromkeys(("int32", "uint32", "float32"), 4),
    **dict.fromkeys(("int64", "uint64", "float64"), 8),
}
_TIME = ("builtin_interfaces/Time", "builtin_interfaces/Duration")
_TYPE = re.compile(r"(?P<base>[A-Za-z][\w/]*)(<=\d+)?(?P<array>\[(?P<bound><=)?(?P<count>\d*)\])?")
_HEAD = 4  # bytes before the message, from which its fields are aligned
_SEQUENCE = -1


@dataclass(frozen=True)
class Field:
    """One field: its type (primitive, ``string`` or ``package/Name``), and how many: None for one that is no array."""

    type: str
    name: str
    count: int | None


@dataclass(frozen=True)
class Definition:
    """A message type with all types inside of it, by ``package/Name``; ``root`` is its own name."""

    root: str
    types: dict[str, list[Field]]

    def end(self, payload: bytes) -> int:
        """Return the number of bytes that the message takes from the payload's start.

        Raises ValueError where the payload ends before the message does.
        """
        end = _Walk(self.types, payload).message(self.root, _HEAD)
        if end > len(payload):
            raise ValueError("it breaks off")
        return end


def parse_definition(name: str, text: str) -> Definition:
    """Return the types of a stored definition, in which lines of ``=`` divide the types.

    Raises ValueError for a line that is no field or constant, a type that is not there, or one inside of itself.
    """
    types: dict[str, list[Field]] = {
        key: [Field("uint32", n, None) for n in ("sec", "nanosec")] for key in _TIME
    }
    whole = name
    for part in re.split(r"^={3,}[ \t\r]*$", text, flags=re.MULTILINE):
        lines = [line.partition("#")[0].replace("\t", " ").strip() for line in part.splitlines()]
        lines = [line for line in lines if line]
        if lines and lines[0].startswith("MSG:"):
            whole, lines = lines[0].removeprefix("MSG:").strip(), lines[1:]
        package = whole.split("/")[0]
        types[_short(whole)] = [_field(line, package) for line in lines if not _is_constant(line)]
    definition = Definition(_short(name), types)
    _check_types(definition.root, types, (), set())
    return definition


def stripped_text(definition: Definition) -> str:
    """Return the definition as text again, without the constants, defaults and comments that no payload holds."""
    order = [definition.root, *(key for key in definition.types if key != definition.root)]
    parts = []
    for key in order:
        head = [] if key == definition.root else [f"MSG: {key}"]
        parts.append("\n".join([*head, *(f"{_type_text(f)} {f.name}" for f in definition.types[key])]))
    return f"\n{'=' * 80}\n".join(parts)


def _type_text(field: Field) -> str:
    if field.count is None:
        return field.type
    return f"{field.type}[{'' if field.count == _SEQUENCE else field.count}]"


def _short(name: str) -> str:
    """Return ``package/Name`` of a name that may have ``msg`` in between."""
    parts = name.split("/")
    return f"{parts[0]}/{parts[-1]}"


def _is_constant(line: str) -> bool:
    return "=" in line.partition(" ")[2]


def _field(line: str, package: str) -> Field:
    kind, _, rest = line.partition(" ")
    match, names = _TYPE.fullmatch(kind), rest.split(maxsplit=1)
    if match is None or not names:
        raise ValueError(f"no field: {line[:60]!r}")
    base, count = match["base"], None
    if base not in _SIZES and base not in ("string", "wstring"):
        base = _short(base) if "/" in base else f"{package}/{base}"
    if match["array"]:
        count = int(match["count"]) if match["count"] and not match["bound"] else _SEQUENCE
    if count == 0:
        raise ValueError(f"an array of no elements: {line[:60]!r}")
    return Field(base, names[0], count)


def _check_types(name: str, types: dict[str, list[Field]], above: tuple[str, ...], checked: set[str]) -> None:
    if name in above:
        raise ValueError(f"{name} inside of itself")
    if name not in types:
        raise ValueError(f"Message definition not found: {name}")
    for inner in sorted({f.type for f in types[name] if "/" in f.type} - checked):
        _check_types(inner, types, (*above, name), checked)
    checked.add(name)


class _Walk:
    """A walk over one payload; every method takes an offset and returns the one after."""

    def __init__(self, types: dict[str, list[Field]], payload: bytes):
        self._types, self._payload = types, payload

    def message(self, name: str, at: int) -> int:
        fields = self._types[name]
        if not fields:
            # an empty message has one byte, because IDL knows none without a member
            return at + 1
        for field in fields:
            at = self._field(field, at)
            if at > len(self._payload):
                raise ValueError(f"it breaks off in {field.name[:60]}")
        return at

    def _field(self, field: Field, at: int) -> int:
        if field.count is None:
            return self._one(field, at)
        count = field.count
        if count == _SEQUENCE:
            count, at = self._length(at)
        if field.type in _SIZES:
            size = _SIZES[field.type]
            return _aligned(at, size) + count * size if count else at
        for _ in range(count):
            at = self._one(field, at)
            if at > len(self._payload):
                raise ValueError(f"{count} {field.name[:60]} in {len(self._payload)} bytes")
        return at

    def _one(self, field: Field, at: int) -> int:
        if field.type in _SIZES:
            return _aligned(at, _SIZES[field.type]) + _SIZES[field.type]
        if field.type == "string":
            length, at = self._length(at)
            return at + length
        if field.type == "wstring":
            raise ValueError(f"{field.name[:60]} is a wstring, which is not read")
        return self.message(field.type, at)

    def _length(self, at: int) -> tuple[int, int]:
        """Return a count of elements or bytes, and the offset after it."""
        at = _aligned(at, 4)
        try:
            (count,) = struct.unpack_from("<I", self._payload, at)
        except struct.error:
            raise ValueError("it breaks off") from None
        return count, at + 4


def _aligned(at: int, size: int) -> int:
    return at + (_HEAD - at) % size
