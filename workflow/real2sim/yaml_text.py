"""YAML as plain values, refusing what a parser would accept in silence or choke on.

A key that stands twice keeps its last value in PyYAML, aliases of aliases multiply, and deep nesting overflows the
stack of its C parser. All three are refused with the line.
"""

from __future__ import annotations

from collections.abc import Hashable
from typing import Any

import yaml

# The parser of libyaml is ten times as fast as that in Python, and part of every PyYAML that pip installs
_LOADER: Any = getattr(yaml, "CSafeLoader", yaml.SafeLoader)
_DEEPEST = 40  # levels of nesting; the study's configuration has six
_LARGEST = 50_000  # values of a document; each takes half a kilobyte
_MOST_VALUES = 20_000  # values of a document with aliases, each alias counted as what it stands for


class YamlRefusal(ValueError):
    """A document that is not used; ``line`` counts from 1 and is 0 where the whole document is meant."""

    def __init__(self, line: int, found: str, expected: str, remedy: str):
        super().__init__(found)
        self.line, self.found, self.expected, self.remedy = line, found, expected, remedy


def parse_yaml(text: str) -> Any:
    """Return the values of one YAML document, None where it is empty.

    Raises YamlRefusal where it is no YAML, has a key twice, is nested too deeply, or grows by its aliases.
    """
    try:
        _check_depth(text)
        loader = _LOADER(text)
        try:
            node = loader.get_single_node()
            if node is None:
                return None
            _count_values(loader, node, {})
            return loader.construct_document(node)
        finally:
            loader.dispose()
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        found = " ".join(str(getattr(error, "problem", None) or error).split())
        raise YamlRefusal(mark.line + 1 if mark else 0, found, "valid YAML", "Mend the syntax.") from error
    except (ValueError, OverflowError) as error:
        if isinstance(error, YamlRefusal):
            raise
        # a date such as 2026-13-45, or a number that Python does not read
        found, remedy = f"a value that cannot be read: {error}", "Correct the value, or put it in quotes."
        raise YamlRefusal(0, found, "valid YAML", remedy) from error


def _check_depth(text: str) -> None:
    """Refuse deep nesting and large documents by the parser's events: they come without recursion or a tree."""
    depth = values = 0
    expected = "keys and values as the documentation has them"
    for event in yaml.parse(text, Loader=_LOADER):
        values += isinstance(event, yaml.NodeEvent)
        if values > _LARGEST:
            found, remedy = f"more than {_LARGEST} values", "Check that it is the file that is meant."
            raise YamlRefusal(0, found, expected, remedy)
        if isinstance(event, yaml.CollectionStartEvent):
            depth += 1
            if depth > _DEEPEST:
                mark, found = event.start_mark, f"values nested more than {_DEEPEST} deep"
                raise YamlRefusal(mark.line + 1 if mark else 0, found, expected, "Remove the nesting.")
        elif isinstance(event, yaml.CollectionEndEvent):
            depth -= 1


def _count_values(loader: Any, node: Any, counted: dict[int, int]) -> int:
    """Return how many values a node stands for; refuse a key that stands twice, and aliases that multiply."""
    known = counted.get(id(node))
    line = node.start_mark.line + 1
    if known == 0:
        found = "an alias inside of what it stands for"
        raise YamlRefusal(line, found, "values written out", "Write the values out instead of the alias.")
    if known is not None:
        return known
    counted[id(node)] = 0
    total = 1
    if isinstance(node, yaml.MappingNode):
        _check_keys(loader, node)
        total += sum(_count_values(loader, part, counted) for pair in node.value for part in pair)
    elif isinstance(node, yaml.SequenceNode):
        total += sum(_count_values(loader, part, counted) for part in node.value)
    if total > _MOST_VALUES and len(counted) < total:
        found = f"aliases (*name) that stand for more than {_MOST_VALUES} values"
        raise YamlRefusal(line, found, "values written out", "Write the values out instead of the alias.")
    counted[id(node)] = total
    return total


def _check_keys(loader: Any, node: Any) -> None:
    """Refuse a mapping in which a key stands twice; merged keys (``<<``) may be overridden."""
    first: dict[Any, int] = {}
    for key, _ in node.value:
        if not isinstance(key, yaml.ScalarNode) or key.tag == "tag:yaml.org,2002:merge":
            continue
        name, line = loader.construct_object(key), key.start_mark.line + 1
        if not isinstance(name, Hashable):
            found = f"a key that is a {type(name).__name__}"
            raise YamlRefusal(line, found, "keys that are text", "Write the key as text.")
        if name in first:
            found = f"key '{key.value}' twice, first in line {first[name]}"
            raise YamlRefusal(
                line, found, "each key once", "Keep the line that is true and remove the other."
            )
        first[name] = line
