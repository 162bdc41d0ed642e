"""Fingerprints of what files hold, and the files that an MJCF pulls in."""

from __future__ import annotations

import json
import os
import time
from pathlib import Path

import mujoco
from real2sim import contents
from real2sim.contents import Contents
from real2sim.system.model_files import model_files


def old(path: Path, seconds: float = 100.0) -> Path:
    then = time.time() - seconds
    os.utime(path, (then, then))
    return path


def test_content_counts_and_the_date_does_not(tmp_path):
    file = tmp_path / "a.tsv"
    file.write_text("one")
    first = Contents(tmp_path / "memory.json").of([file])
    old(file)
    assert Contents(tmp_path / "memory.json").of([file]) == first
    file.write_text("two")
    old(file)
    assert Contents(tmp_path / "memory.json").of([file]) != first


def test_exchanged_names_are_another_content(tmp_path):
    a, b = tmp_path / "a", tmp_path / "b"
    a.write_text("one")
    b.write_text("two")
    before = Contents(tmp_path / "memory.json").of([a, b])
    a.rename(tmp_path / "c")
    b.rename(a)
    (tmp_path / "c").rename(b)
    assert Contents(tmp_path / "memory.json").of([a, b]) != before


def test_file_is_read_once(tmp_path, monkeypatch):
    file, memory = tmp_path / "a", tmp_path / "memory.json"
    file.write_text("one")
    monkeypatch.setattr(contents, "_SETTLED_S", -1.0)
    first = Contents(memory)
    told = first.of([file])
    first.save()
    monkeypatch.setattr(contents, "sha256", lambda path: 1 / 0)
    assert Contents(memory).of([file]) == told


def test_file_that_was_just_written_is_not_remembered(tmp_path):
    """It may change once more within the resolution of its dates."""
    file, memory = tmp_path / "a", tmp_path / "memory.json"
    file.write_text("one")
    read = Contents(memory)
    read.of([file])
    read.save()
    assert not memory.exists()


def test_memory_that_is_damaged_is_none(tmp_path):
    memory = tmp_path / "memory.json"
    for text in ("", "[]", "{", json.dumps({"a": 1}), json.dumps({"a": [["x"], "y"]})):
        memory.write_text(text)
        assert Contents(memory).of([tmp_path / "nothing"])


def test_pipe_is_not_waited_for(tmp_path):
    pipe = tmp_path / "dynamic_1.tsv"
    os.mkfifo(pipe)
    missing = Contents(tmp_path / "memory.json").of([tmp_path / "dynamic_2.tsv"])
    assert Contents(tmp_path / "memory.json").of([pipe]) != missing


def _robot(folder: Path) -> Path:
    """Write a robot of an include, which holds the folder of the meshes, a mesh and an attached model."""
    for name in ("parts", "meshes", "tool"):
        (folder / name).mkdir()
    corner = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"
    (folder / "meshes" / "base.obj").write_text(corner)
    (folder / "parts" / "common.xml").write_text(
        '<mujocoinclude><compiler meshdir="meshes"/><asset><mesh name="base" file="base.obj"/></asset></mujocoinclude>'
    )
    (folder / "tool" / "tool.xml").write_text('<mujoco><worldbody><body name="tip"/></worldbody></mujoco>')
    robot = folder / "robot.xml"
    robot.write_text(
        '<mujoco><include file="parts/common.xml"/><asset><model name="tool" file="tool/tool.xml"/></asset>'
        '<worldbody><geom type="mesh" mesh="base"/><body><attach model="tool" body="tip" prefix="t"/></body>'
        "</worldbody></mujoco>"
    )
    return robot


def test_everything_that_a_model_pulls_in_is_found(tmp_path):
    robot = _robot(tmp_path)
    assert mujoco.MjModel.from_xml_path(str(robot)).nmesh == 1
    names = {path.relative_to(tmp_path).as_posix() for path in model_files(robot)}
    assert names == {"robot.xml", "parts/common.xml", "meshes/base.obj", "tool/tool.xml"}


def test_changed_mesh_is_another_robot(tmp_path):
    robot = _robot(tmp_path)
    before = Contents(tmp_path / "memory.json").of(model_files(robot))
    mesh = tmp_path / "meshes" / "base.obj"
    mesh.write_text(mesh.read_text().replace("v 1 0 0", "v 2 0 0"))
    assert Contents(tmp_path / "memory.json").of(model_files(robot)) != before


def test_model_that_is_no_xml_or_includes_itself_ends(tmp_path):
    broken = tmp_path / "broken.xml"
    broken.write_text("<mujoco")
    assert model_files(broken) == (broken,)
    loop = tmp_path / "loop.xml"
    loop.write_text('<mujoco><include file="loop.xml"/></mujoco>')
    assert model_files(loop) == (loop,)
