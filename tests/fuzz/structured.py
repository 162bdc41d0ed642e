"""Seeded damage to YAML, XML, JSON, CSV and ROS 2 definitions that keeps most of their structure."""

import re

from tests.fuzz import mutate

ODD_YAML = (
    ".nan", ".inf", "-1", "0", "1e400", "9" * 400, "null", "''", "[]", "{}", "[1, 2]", "{a: 1}", "true", "off",
    "2026-13-45", "2026-01-02", "1:30:00", "0x10", "0o7", "1_000", "!!binary aGk=", "!!python/none x", "&a [*a]",
    "*b", "'27", "\"\\0\"", "\"\\ud800\"", "!!set {a, b}", "!!omap [a: 1]", "~", "? a", "<<", "=", "S01", "a: b",
)  # fmt: skip
ODD_TEXT = (
    "", "-1", "0", "nan", "1e308", "inf", "x" * 5000, "../..", "/", "/dev/null", "/dev/zero", ".", "robot.xml", "\\0",
    "true", "1 2 3 4 5 6 7", "mesh.stl", "a/../a/robot.xml", "é", "&#0;", "&x;", "hinge", "free", "auto",
)  # fmt: skip
ODD_JSON = (
    "null", "true", "-0", "1e999", "NaN", "Infinity", "9" * 400, "[]", "{}", '""', '"\\ud800"', "[[1]]", '{"x": 1}',
    "-1", "4294967296", "1e-320",
)  # fmt: skip
ODD_DEFINITIONS = (
    "float64[]", "string", "wstring", "float64[36]", "float64[<=3]", "uint8[1000000000]", "bool[0]", "Header header",
    "a/B c", "int8 A=1", "=", "# x", "string<=5", "float32 x 1.5", "time", "char[]", "MSG: a/B", "=" * 80, "byte\t",
)  # fmt: skip
_YAML_VALUE = re.compile(r"(?<=: )[^\n{\[]+|(?<=[\[,{])[^\n,\[\]{}]+")
_XML_VALUE = re.compile(r"(?<=\")[^\"\n]*(?=\")")
_XML_TAG = re.compile(r"<[^>]*>")
_JSON_VALUE = re.compile(r"-?\d+\.?\d*(?:[eE][+-]?\d+)?|\"[^\"]*\"|true|false|null")
_WORD = re.compile(r"[^\s]+")


def _replaced(text, rng, pattern, others):
    """A text in which one match of a pattern is another text, or that of another match."""
    found = list(re.finditer(pattern, text))
    if not found:
        return text
    match = found[rng.integers(len(found))]
    chosen = others[rng.integers(len(others))] if rng.random() < 0.7 else found[rng.integers(len(found))][0]
    return text[: match.start()] + chosen + text[match.end() :]


def _without(text, rng, pattern):
    found = list(re.finditer(pattern, text))
    if not found:
        return text
    match = found[rng.integers(len(found))]
    return text[: match.start()] + text[match.end() :]


def _mostly(change):
    """One to three changes of text, in three of four cases; else damage of bytes or lines."""

    def mutated(data, rng):
        if rng.random() < 0.25:
            return mutate.mutated(data, rng, text=True)
        text = data.decode("utf-8", errors="replace")
        for _ in range((1, 1, 2, 3)[rng.integers(4)]):
            text = change(text, rng)
        return text.encode("utf-8", errors="replace")

    return mutated


@_mostly
def yaml_text(text, rng):
    kind = rng.integers(6)
    if kind == 0:  # indent, which moves keys to another level
        lines = text.split("\n")
        i = int(rng.integers(len(lines)))
        lines[i] = ("  " + lines[i], lines[i].lstrip(), "- " + lines[i], "\t" + lines[i])[rng.integers(4)]
        return "\n".join(lines)
    if kind == 1:
        return mutate.TEXT[rng.integers(len(mutate.TEXT))](text.encode(), rng).decode(errors="replace")
    return _replaced(text, rng, _YAML_VALUE, ODD_YAML)


@_mostly
def xml_text(text, rng):
    kind = rng.integers(8)
    if kind == 0:
        return _without(text, rng, _XML_TAG)
    if kind == 1:
        names = ("UTF-16", "utf-7", "shift_jis", "none-such", "ascii", "rot13", "big5")
        return f'<?xml version="1.0" encoding="{names[rng.integers(len(names))]}"?>\n{text}'
    if kind == 2:
        parts = (
            '<include file="part.xml"/>', '<include file="robot.xml"/>', '<include file="/dev/zero"/>',
            '<asset><mesh file="a.stl"/></asset>', f'<asset><mesh file="{"b" * 5000}"/></asset>',
            '<asset><model name="m" file="robot.xml"/></asset>', '<compiler meshdir="x" strippath="true"/>',
        )  # fmt: skip
        return _replaced(text, rng, _XML_TAG, parts)
    return _replaced(text, rng, _XML_VALUE, ODD_TEXT)


@_mostly
def json_text(text, rng):
    kind = rng.integers(6)
    if kind == 0:
        return _without(text, rng, r'"\w+": ')
    if kind == 1:
        return _replaced(text, rng, r"(?<=\")\w+(?=\":)", ("sec", "header", "x", "", "name"))
    return _replaced(text, rng, _JSON_VALUE, ODD_JSON)


@_mostly
def definition_text(text, rng):
    if rng.random() < 0.5:
        return _replaced(text, rng, _WORD, ODD_DEFINITIONS)
    return _replaced(text, rng, r"[^\n]+", ODD_DEFINITIONS)


def csv_text(data, rng):
    """As a table with tabs: commas divide the cells."""
    return mutate.mutated(data.replace(b",", b"\t"), rng, text=True).replace(b"\t", b",")
