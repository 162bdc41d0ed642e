"""Fingerprints of code, and the memory that spares parsing it."""

from __future__ import annotations

import json

import pytest
from real2sim import provenance
from real2sim.provenance import LIBRARY, CodeMemory, fingerprint

CODE = "from real2sim.files import write_text\n\n\ndef twice(x):\n    return 2 * x\n"


@pytest.fixture
def module(tmp_path):
    path = tmp_path / "module.py"
    path.write_text(CODE)
    return path


@pytest.mark.parametrize(
    "text",
    [
        CODE.replace("    return", "    # a comment\n    return"),
        CODE.replace("2 * x", "2*x"),
        CODE + "\n\nif TYPE_CHECKING:\n    import numpy\n",
    ],
)
def test_what_does_not_run_leaves_the_hash(module, text):
    before = CodeMemory().of(module)
    module.write_text(text)
    assert CodeMemory().of(module) == before == (before[0], [("real2sim.files", "write_text")])


def test_a_changed_docstring_leaves_the_hash(module):
    module.write_text('"""One."""\n')
    before = CodeMemory().of(module)
    module.write_text('"""Two."""\n')
    assert CodeMemory().of(module) == before


def test_a_changed_constant_changes_the_hash_whatever_is_remembered(module, tmp_path):
    memory = tmp_path / "memory" / "code.json"
    first = CodeMemory()
    before = first.of(module)
    first.save(memory)
    assert memory.exists()
    module.write_text(CODE.replace("2", "3"))
    second = CodeMemory()
    second.load(memory)
    assert second.of(module) != before


def test_what_is_remembered_is_not_parsed_again(module, tmp_path, monkeypatch):
    memory = tmp_path / "code.json"
    first = CodeMemory()
    before = first.of(module)
    first.save(memory)
    monkeypatch.setattr(provenance, "_parsed", lambda _: pytest.fail("parsed again"))
    second = CodeMemory()
    second.load(memory)
    assert second.of(module) == before
    second.save(tmp_path / "unchanged.json")
    assert not (tmp_path / "unchanged.json").exists()


@pytest.mark.parametrize("text", ["", "{", "[]", '{"made_by": "another Python", "texts": {}}'])
def test_a_memory_that_says_nothing_costs_only_time(module, tmp_path, text):
    memory = tmp_path / "code.json"
    memory.write_text(text)
    code = CodeMemory()
    code.load(memory)
    assert code.of(module) == CodeMemory().of(module)
    code.save(memory)
    assert list(json.loads(memory.read_text())["texts"].values())


def test_a_fingerprint_follows_what_is_imported():
    assert fingerprint("real2sim.study.diagnose") != fingerprint("real2sim.study.noise_floor")
    with pytest.raises(ModuleNotFoundError, match=LIBRARY.name):
        fingerprint("real2sim.nowhere")
