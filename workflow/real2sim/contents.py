"""Fingerprints of the contents of files, whatever their dates: a file that was exchanged or restored has another."""

from __future__ import annotations

import json
import stat
import sys
import time
from collections.abc import Iterable
from hashlib import sha256 as _sha256
from pathlib import Path

from real2sim.files import write_text
from real2sim.provenance import sha256

# A file changed less than this ago may change once more within the resolution of its dates [s]
_SETTLED_S = 2.0
# How often a long reading says how far it is [s]
_TOLD_EVERY_S = 5.0


class Contents:
    """Fingerprints of files. Each is read once and again only where the system says that it is another one.

    ``memory`` is a JSON file of what was read: inode, size, time of change and hash by path. The time of change is set
    by the system whenever a file is written, renamed or given another date, and by nobody else.
    """

    def __init__(self, memory: Path):
        self._memory = memory
        self._known = _read(memory)
        self._new = False
        self._told = time.monotonic()

    def of(self, paths: Iterable[Path | str]) -> str:
        """Return one fingerprint of the names and contents of files; a file that is not there counts by its name."""
        rows = [f"{Path(path).as_posix()} {self._one(Path(path))}" for path in paths]
        return _sha256("\n".join(sorted(rows)).encode()).hexdigest()[:16]

    def _one(self, path: Path) -> str:
        try:
            status = path.stat()
        except OSError:
            return "missing"
        if not stat.S_ISREG(status.st_mode):
            # reading a pipe would wait for ever
            return "no file"
        state = [status.st_ino, status.st_size, status.st_mtime_ns, status.st_ctime_ns]
        name = path.as_posix()
        known = self._known.get(name)
        if known is not None and known[0] == state:
            return known[1]
        self._tell(path)
        try:
            content = sha256(path)
        except OSError:
            # whoever reads it will say what is wrong with it
            return "unreadable"
        if time.time() - status.st_ctime > _SETTLED_S:
            self._known[name], self._new = (state, content), True
        return content

    def _tell(self, path: Path) -> None:
        now = time.monotonic()
        if now - self._told > _TOLD_EVERY_S:
            self._told = now
            print(f"reading raw files once for their contents: {path}", file=sys.stderr, flush=True)

    def save(self) -> None:
        """Write the memory where something was read; a folder that cannot be written costs time and nothing else."""
        if not self._new:
            return
        try:
            write_text(self._memory, json.dumps(self._known))
        except OSError:
            return
        self._new = False


def _read(memory: Path) -> dict[str, tuple[list[int], str]]:
    try:
        known = json.loads(memory.read_text(encoding="utf-8"))
        return {
            str(name): ([int(n) for n in state], str(content)) for name, (state, content) in known.items()
        }
    except (OSError, ValueError, AttributeError, TypeError):
        return {}
