"""The study's configuration: defaults filled in and checked, with errors that name file and key."""

from __future__ import annotations

import datetime
import difflib
import math
import sys
from collections.abc import Iterator, Mapping
from functools import cache
from pathlib import Path
from typing import Any, cast

import jsonschema

from real2sim.errors import InputError
from real2sim.yaml_text import YamlRefusal, parse_yaml

SCHEMAS = Path(__file__).parent / "schemas"
# Page that has the keys of the study's configuration, and of subject.yaml
_STUDY_PAGE = "config/README.md"


def read_yaml(path: Path) -> Any:
    """Read a YAML file; raises InputError where it is missing, no file, not YAML, or has a key twice."""
    try:
        if path.exists() and not path.is_file():
            # opening a pipe would wait for ever
            what = "a folder" if path.is_dir() else "a pipe, socket or device"
            raise InputError(path, "", what, "a YAML file", "Put the file in its place.", "no_file")
        return parse_yaml(path.read_text(encoding="utf-8"))
    except FileNotFoundError as error:
        raise InputError(path, "", "no such file", "a YAML file", "Check the path.", "no_file") from error
    except OSError as error:
        found, remedy = error.strerror or str(error), "Check the path and who may read it."
        raise InputError(path, "", found, "a YAML file", remedy, "unreadable") from error
    except UnicodeDecodeError as error:
        found, remedy = "bytes that are not UTF-8", "Save it as UTF-8."
        raise InputError(path, "", found, "YAML text", remedy, "yaml") from error
    except YamlRefusal as error:
        place = f"line {error.line}" if error.line else ""
        raise InputError(path, place, error.found, error.expected, error.remedy, "yaml") from error


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


def _explain(
    error: jsonschema.ValidationError, schema: dict[str, Any], source: Path, page: str
) -> InputError:
    """Return what is wrong with a value; ``page`` of the documentation has the keys."""
    place = ".".join(str(part) for part in error.absolute_path) or "top level"
    # A schema may also be a bare true or false, and jsonschema's types say so; ours are all mappings.
    failed = cast("dict[str, Any]", error.schema)
    if error.validator == "additionalProperties":
        known = failed["properties"]
        unknown = sorted(map(str, set(cast("dict[str, Any]", error.instance)) - set(known)))
        near = difflib.get_close_matches(unknown[0], list(known) or list(_keys(schema)), 1)
        remedy = f"Did you mean '{near[0]}'?" if near else f"Remove it, or see {page} for the keys."
        return InputError(
            source,
            place,
            f"unknown key {', '.join(map(repr, unknown))}",
            f"one of {', '.join(known)}",
            remedy,
            "key_unknown",
        )
    if error.validator == "required":
        expected = f"keys {', '.join(cast('list[str]', error.validator_value))}"
        return InputError(source, place, error.message, expected, "Add the key.", "key_missing")
    message = _shortened(error.message)
    expected = str(failed.get("description", "a value that the schema allows"))
    remedy = f"Correct the value; {page} has the keys."
    if error.validator == "type":
        remedy = _retyped(error.instance, str(error.validator_value), page) or remedy
    if error.validator == "anyOf":
        options = cast("list[dict[str, Any]]", error.validator_value)
        message = f"{error.instance!r}"
        expected += f" ({' or '.join(map(_option, options))})"
        advice = (_retyped(error.instance, str(option.get("type", "")), page) for option in options)
        remedy = next(filter(None, advice), remedy)
    return InputError(source, place, message, expected, remedy, "value")


def _option(schema: dict[str, Any]) -> str:
    """Return what one of several schemas of a value allows, in words."""
    if "const" in schema:
        return str(schema["const"])
    ends = {"exclusiveMinimum": "above", "minimum": "from", "exclusiveMaximum": "below", "maximum": "up to"}
    bounds = [f"{word} {schema[key]:g}" for key, word in ends.items() if key in schema]
    return " ".join([f"a {schema['type']}", *bounds])


def _retyped(value: Any, wanted: str, page: str) -> str:
    """Return what to do about a value that YAML reads as another type than the wanted one; empty for no advice."""
    if wanted in ("number", "integer") and isinstance(value, str) and _is_number(value):
        text = value.lower()
        if "e" in text and not ("." in text and ("e+" in text or "e-" in text)):
            return f"YAML reads {value} as text: write it with a point and a sign, as in 1.0e+1."
        given = " A number cannot be given by --config, but in a file by --configfile."
        return "Write it without quotes." + given * (page == _STUDY_PAGE)
    if wanted == "string" and isinstance(value, (bool, int, float, datetime.date)):
        return f"Put it in quotes: YAML reads {value} as a number, a truth value or a date."
    return ""


def _is_number(text: str) -> bool:
    try:
        return math.isfinite(float(text))
    except ValueError:
        return False


def _shortened(text: str) -> str:
    """Return a message of at most 300 characters: it may quote a whole document."""
    return text if len(text) <= 300 else f"{text[:200]} ... {text[-80:]}"


def _not_finite(value: Any, place: tuple[str, ...] = ()) -> Iterator[tuple[str, Any]]:
    """Yield place and value of each number that is NaN, infinite or beyond a double: no schema refuses them."""
    if isinstance(value, dict):
        for key, inner in value.items():
            yield from _not_finite(inner, (*place, str(key)))
    elif isinstance(value, list | tuple):
        for i, inner in enumerate(value):
            yield from _not_finite(inner, (*place, str(i)))
    elif isinstance(value, float) and not math.isfinite(value):
        yield ".".join(place) or "top level", value
    elif isinstance(value, int) and abs(value) > sys.float_info.max:
        yield ".".join(place) or "top level", f"an integer of {value.bit_length()} bits"


def _check_finite(value: Any, schema: dict[str, Any], source: Path) -> None:
    for place, found in _not_finite(value):
        about: Any = schema
        for key in place.split("."):
            about = (about.get("properties") or {}).get(key, {}) if isinstance(about, dict) else {}
        expected = (
            f"a finite number ({about['description']})" if "description" in about else "a finite number"
        )
        raise InputError(
            source, place, f"{found}", expected, "Write the number, or remove the line.", "not_finite"
        )


def _no_text(value: Any, place: tuple[str, ...] = ()) -> Iterator[str]:
    """Yield the place of each text with a null byte or half a character, which no path and no table can hold."""
    if isinstance(value, dict):
        for key, inner in value.items():
            yield from _no_text(key, (*place, "a key"))
            yield from _no_text(inner, (*place, str(key)))
    elif isinstance(value, list | tuple):
        for i, inner in enumerate(value):
            yield from _no_text(inner, (*place, str(i)))
    elif isinstance(value, str) and ("\0" in value or any("\ud800" <= c <= "\udfff" for c in value)):
        yield ".".join(place) or "top level"


def _check_texts(value: Any, source: Path) -> None:
    for place in _no_text(value):
        found, expected = "a null byte or half a character", "text"
        raise InputError(source, ascii(place)[1:-1], found, expected, "Write the text anew.", "value")


def _check_low_pass(content: dict[str, Any], source: Path) -> None:
    """Refuse a low-pass that the common clock cannot hold: at half its rate and above nothing is filtered."""
    cutoff, rate = content["ingest"]["cutoff_hz"], content["ingest"]["rate_hz"]
    if cutoff >= rate / 2:
        found = f"a cut-off of {cutoff:g} Hz with ingest.rate_hz at {rate:g} Hz"
        expected = f"less than half of ingest.rate_hz ({rate / 2:g} Hz)"
        remedy = "Lower ingest.cutoff_hz, or raise ingest.rate_hz."
        raise InputError(source, "ingest.cutoff_hz", found, expected, remedy, "value")


def _check_order(content: Mapping[str, Any], source: Path | str) -> None:
    """Refuse intervals whose ends are exchanged or equal, and a time step that does not divide the sample interval."""
    intervals = {
        f"identification.bounds.{name}": ends for name, ends in content["identification"]["bounds"].items()
    }
    intervals["ingest.units.marker_extent_m"] = content["ingest"]["units"]["marker_extent_m"]
    limits = content["statistics"]
    intervals["statistics.common_below and distinct_from"] = [
        limits["common_below"],
        limits["distinct_from"],
    ]
    for place, (low, high) in intervals.items():
        if not low < high:
            found, expected = f"[{low:g}, {high:g}]", "the lower number first, and two that differ"
            raise InputError(source, place, found, expected, "Exchange or correct them.", "value")
    step, rate = content["plant"]["timestep_s"], content["ingest"]["rate_hz"]
    if step != "auto" and abs(1 / (rate * step) - round(1 / (rate * step))) > 1e-6:
        expected = (
            f"the sample interval of {1 / rate:g} s (ingest.rate_hz) divided by a whole number, or auto"
        )
        remedy = f"Write {1 / (rate * max(1, math.ceil(1 / (rate * step) - 1e-9))):.12g}, or auto."
        raise InputError(source, "plant.timestep_s", f"{step:g} s", expected, remedy, "value")


def check_lab_axes(axes: Mapping[str, Any], source: Path | str) -> None:
    """Raise InputError naming ``source`` unless ``ingest.lab_to_world`` is a right-handed set of three lab axes."""
    named = [str(axes.get(axis, "")) for axis in "xyz"]
    order = "".join(name[1:] if name.startswith(("+", "-")) else "?" for name in named)
    even = order in ("xyz", "yzx", "zxy")
    if not even and order not in ("xzy", "yxz", "zyx"):
        found = "not three different axes of the lab"
    elif even == (sum(name[0] == "-" for name in named) % 2 == 0):
        return
    else:
        found = "a left-handed set of axes"
    shown = ", ".join(f"{axis}: {name}" for axis, name in zip("xyz", named, strict=True))
    expected = "three different lab axes with signs, right-handed, e.g. {x: +x, y: +y, z: +z}"
    remedy = "Correct which lab axis points forward (x), left (y) and up (z) (docs/how-to/markers.md)."
    raise InputError(source, "ingest.lab_to_world", f"{{{shown}}}: {found}", expected, remedy, "lab_axes")


def validated(content: Any, schema_name: str, source: Path) -> dict[str, Any]:
    """Fill in defaults and check against ``schemas/<schema_name>.schema.yaml``.

    Raises
    ------
    InputError
        Naming ``source``, the key, and for an unknown key the nearest known one. Numbers that are NaN or infinite
        are refused everywhere.
    """
    validator = _validator(schema_name)
    schema = cast("dict[str, Any]", validator.schema)
    filled: dict[str, Any] = _with_defaults(schema, {} if content is None else content)
    errors = sorted(validator.iter_errors(filled), key=lambda e: len(e.absolute_path))
    if errors:
        pages = {"system": "docs/library.md", "suite": "docs/validation.md"}
        raise _explain(errors[0], schema, source, pages.get(schema_name, _STUDY_PAGE))
    _check_finite(filled, schema, source)
    _check_texts(filled, source)
    if schema_name == "config":
        _check_low_pass(filled, source)
        _check_order(filled, source)
        check_lab_axes(filled["ingest"]["lab_to_world"], source)
    return filled
