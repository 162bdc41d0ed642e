"""Freed memory goes back to the system, where the C library would keep it.

Replays take and free arrays of many sizes, and glibc keeps what lies between those that live on: a diagnosis that needs
90 MB at a time held half a GB. On other systems nothing is done.
"""

from __future__ import annotations

import ctypes
import mmap
import sys
from collections.abc import Callable
from functools import cache
from pathlib import Path

# Growth of resident memory after which it is asked again [MB]: asking takes some milliseconds
_GROWTH_MB = 48.0
_PAGE_MB = mmap.PAGESIZE / 2**20
_STATUS = Path("/proc/self/statm")

_least_mb = 0.0


@cache
def _trim() -> Callable[[int], int] | None:
    """The function malloc_trim of glibc, where this system has it."""
    if not sys.platform.startswith("linux") or not _STATUS.exists():
        return None
    return getattr(ctypes.CDLL(None), "malloc_trim", None)


def resident_mb() -> float:
    """Return the resident memory of this process [MB], 0 where the system does not tell."""
    try:
        return int(_STATUS.read_text().split()[1]) * _PAGE_MB
    except (OSError, IndexError, ValueError):
        return 0.0


def give_back() -> None:
    """Give freed memory back once the process has grown by some since it was last done."""
    global _least_mb
    trim = _trim()
    if trim is None or resident_mb() < _least_mb + _GROWTH_MB:
        return
    trim(0)
    _least_mb = resident_mb()
