"""Freed memory is given back."""

from __future__ import annotations

import sys

import numpy as np
import pytest
from real2sim import memory


@pytest.mark.skipif(memory._trim() is None, reason="malloc_trim is of glibc")
def test_freed_memory_goes_back_to_the_system():
    # between arrays that live on, the allocator keeps what is freed; below its mmap threshold of 128 kB at the start
    arrays = [np.ones(12_000) for _ in range(2_000)]
    kept = arrays[::20]
    before = memory.resident_mb()
    del arrays
    memory._least_mb = 0.0
    memory.give_back()
    assert memory.resident_mb() < before - 100
    assert sum(array.sum() for array in kept) == 12_000 * len(kept)


def test_nothing_is_asked_before_the_process_has_grown(monkeypatch):
    asked = []
    monkeypatch.setattr(memory, "_trim", lambda: asked.append)
    monkeypatch.setattr(memory, "_least_mb", memory.resident_mb())
    memory.give_back()
    assert not asked
    monkeypatch.setattr(memory, "_least_mb", -memory._GROWTH_MB)
    memory.give_back()
    assert asked == [0]


def test_a_system_that_does_not_tell_is_left_alone(monkeypatch, tmp_path):
    monkeypatch.setattr(memory, "_STATUS", tmp_path / "nowhere")
    monkeypatch.setattr(sys, "platform", "darwin")
    memory._trim.cache_clear()
    assert memory.resident_mb() == 0.0
    memory.give_back()
    monkeypatch.undo()
    memory._trim.cache_clear()
