"""docs/quality-codes.md lists every code that the library can write, and no other."""

import ast
import re
from pathlib import Path

ROOT = Path(__file__).parents[2]
# Callables that take a code, and where it stands among their arguments.
PLACES = {
    "InputError": 5,
    "Finding": 0,
    "finding": 0,
    "note": 0,
    "_note": 0,
    "_refuse": 2,
    "Undecodable": 1,
}
SEVERITIES = {"info", "warning", "error", "refused"}


def name_of(node):
    return node.attr if isinstance(node, ast.Attribute) else getattr(node, "id", "")


def codes_in(tree):
    for node in ast.walk(tree):
        if isinstance(node, ast.Call) and name_of(node.func) in PLACES:
            place = PLACES[name_of(node.func)]
            given = [k.value for k in node.keywords if k.arg == "code"] + node.args[place : place + 1]
            yield from (value.value for value in given if isinstance(value, ast.Constant) and value.value)


def in_the_library():
    trees = [ast.parse(path.read_text()) for path in sorted((ROOT / "workflow/real2sim").rglob("*.py"))]
    return {code for tree in trees for code in codes_in(tree)} | {"payload"}  # Undecodable's own


def in_the_docs():
    text = (ROOT / "docs" / "quality-codes.md").read_text()
    return re.findall(r"^\| `([a-z0-9_]+)` \| ([a-z, ]+) \| (.+) \| (.+) \|$", text, re.MULTILINE)


def test_every_code_is_documented_once():
    listed = [row[0] for row in in_the_docs()]
    assert sorted(set(listed)) == sorted(listed)
    missing = in_the_library() - set(listed)
    assert not missing, f"add to docs/quality-codes.md: {', '.join(sorted(missing))}"
    gone = set(listed) - in_the_library()
    assert not gone, f"no longer in the library: {', '.join(sorted(gone))}"


def test_every_code_has_a_severity_a_meaning_and_a_remedy():
    for code, severity, meaning, action in in_the_docs():
        assert set(severity.split(", ")) <= SEVERITIES, code
        assert len(meaning) > 10, code
        assert len(action) > 3, code
