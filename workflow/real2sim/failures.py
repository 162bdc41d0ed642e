"""The last lines of a run that failed: what failed, why, and where its log is."""

from __future__ import annotations

import re
from pathlib import Path

# By this line a stage says in its log why it ended
FAILED = "error in stage"

_BLOCK = re.compile(
    r"^Error in (?P<kind>rule|group) (?P<name>\S+?):\n(?P<about>(?:[ \t]+.*\n?)*)", re.MULTILINE
)
_LOG = re.compile(r"^\s*log: (?P<path>[^\s(]+)", re.MULTILINE)
_MESSAGE = re.compile(r"^\s*message: (?P<text>.+?)(?: For further error details.*)?$", re.MULTILINE)


def failures(logs: Path, since: float, record: str = "") -> list[str]:
    """What went wrong since a time [s since the epoch], one text each with the path of its log.

    First what stages say in their logs below ``logs``; then jobs that ``record``, Snakemake's own log, says failed and
    whose log holds no such word: killed from outside, out of memory or time, or ended with their node.
    """
    said: dict[str, str] = {}
    for path in sorted(logs.rglob("*.log")):
        if path.stat().st_mtime >= since:
            text = path.read_text(encoding="utf-8", errors="replace")
            if FAILED in text:
                said[path.as_posix()] = text[text.rindex(FAILED) :].strip()
    out = [f"{text}\n  log:      {path}" for path, text in said.items()]
    for block in _BLOCK.finditer(record):
        paths = [match["path"].rstrip(",") for match in _LOG.finditer(block["about"])]
        if not any(path in said for path in paths):
            told = _MESSAGE.search(block["about"])
            why = told["text"].strip() if told and told["text"] != "None" else ""
            out.append(
                f"{block['kind']} {block['name']} ended without a word of its own (killed, out of memory or time?)"
                + (f"\n  found:    {why}" if why else "")
                + "".join(f"\n  log:      {path}" for path in paths)
            )
    return list(dict.fromkeys(out))
