"""Warnings met while the files of a trial were read, in the few lines that logs, tables and pages have room for."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import asdict
from typing import Any

from real2sim.recording.formats.recordings import Finding


def warnings_by_code(findings: Iterable[Finding | Mapping[str, Any]]) -> list[dict[str, str]]:
    """Return one entry per code of the findings that are no mere information, in the order in which they were met.

    An entry has ``code``, ``message`` (file, place and text of the first finding of the code, and how many more there
    are) and ``action`` (what was done). A marker with thirty gaps is one line.
    """
    found: dict[str, list[Mapping[str, Any]]] = {}
    for finding in findings:
        about = asdict(finding) if isinstance(finding, Finding) else finding
        if about["severity"] != "info":
            found.setdefault(about["code"], []).append(about)
    return [_entry(code, alike) for code, alike in found.items()]


def _entry(code: str, alike: list[Mapping[str, Any]]) -> dict[str, str]:
    first = alike[0]
    where = f"{first['file']}, {first['place']}" if first["place"] else first["file"]
    more = f" (and {len(alike) - 1} more of this kind)" if len(alike) > 1 else ""
    return {"code": code, "message": f"{where}: {first['message']}{more}", "action": first["action"]}
