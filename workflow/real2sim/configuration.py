"""The study's configuration: defaults filled in and checked, with errors that name file and key."""

from __future__ import annotations

import difflib
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any, cast

import jsonschema
import yaml

from real2sim.errors import InputError

SCHEMAS = Path(__file__).parent / "schemas"


def read_yaml(path: Path) -> Any:
    """Read a YAML file; raises InputError where it is missing or not YAML."""
    try:
        return yaml.load(
            path.read_text(encoding="utf-8"), Loader=getattr(yaml, "CSafeLoader", yaml.SafeLoader)
        )
    except FileNotFoundError as error:
        raise InputError(path, "", "no such file", "a YAML file", "Check the path.") from error
    except UnicodeDecodeError as error:
        raise InputError(path, "", "bytes that are not UTF-8", "YAML text", "Save it as UTF-8.") from error
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        place = f"line {mark.line + 1}" if mark else ""
        found = str(getattr(error, "problem", None) or error)
        raise InputError(path, place, found, "valid YAML", "Mend the syntax.") from error


@cache
def _validator(schema_name: str) -> jsonschema.Draft202012Validator:
    return jsonschema.Draft202012Validator(read_yaml(SCHEMAS / f"{schema_name}.schema.yaml"))


def _with_defaults(schema: dict[str, Any], value: Any) -> Any:
    """Copy ``value`` with the schema's defaults filled in, at every depth."""
    if schema.get("type") == "object" and isinstance(value, dict):
        properties = schema.get("properties", {})
        filled = dict(value)
        for key, sub in properties.items():
            if key not in filled and "default" in sub:
                filled[key] = sub["default"]
            elif key not in filled and sub.get("type") == "object":
                filled[key] = {}
            if key in filled:
                filled[key] = _with_defaults(sub, filled[key])
        named = schema.get("additionalProperties")
        if isinstance(named, dict):
            for key in filled.keys() - properties.keys():
                filled[key] = _with_defaults(named, filled[key])
        return filled
    return value


def _keys(schema: dict[str, Any]) -> Iterator[str]:
    for key, sub in schema.get("properties", {}).items():
        yield key
        yield from _keys(sub)


def _explain(error: jsonschema.ValidationError, schema: dict[str, Any], source: Path) -> InputError:
    place = ".".join(str(part) for part in error.absolute_path) or "top level"
    # A schema may also be a bare true or false, and jsonschema's types say so; ours are all mappings.
    failed = cast("dict[str, Any]", error.schema)
    if error.validator == "additionalProperties":
        known = failed["properties"]
        unknown = sorted(map(str, set(cast("dict[str, Any]", error.instance)) - set(known)))
        near = difflib.get_close_matches(unknown[0], list(known) or list(_keys(schema)), 1)
        remedy = f"Did you mean '{near[0]}'?" if near else "Remove it, or see config/README.md for the keys."
        return InputError(
            source,
            place,
            f"unknown key {', '.join(map(repr, unknown))}",
            f"one of {', '.join(known)}",
            remedy,
        )
    if error.validator == "required":
        expected = f"keys {', '.join(cast('list[str]', error.validator_value))}"
        return InputError(source, place, error.message, expected, "Add the key.")
    expected = str(failed.get("description", error.message))
    return InputError(
        source, place, error.message, expected, "Correct the value; config/README.md has the keys."
    )


def validated(content: Any, schema_name: str, source: Path) -> dict[str, Any]:
    """Fill in defaults and check against ``schemas/<schema_name>.schema.yaml``.

    Raises
    ------
    InputError
        Naming ``source``, the key, and for an unknown key the nearest known one.
    """
    validator = _validator(schema_name)
    schema = cast("dict[str, Any]", validator.schema)
    filled: dict[str, Any] = _with_defaults(schema, {} if content is None else content)
    errors = sorted(validator.iter_errors(filled), key=lambda e: len(e.absolute_path))
    if errors:
        raise _explain(errors[0], schema, source)
    return filled
