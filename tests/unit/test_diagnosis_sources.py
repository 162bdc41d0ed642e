"""Provenance of diagnosis.json: every file that changes the answer is recorded by its SHA-256."""

from __future__ import annotations

from real2sim.provenance import sha256
from real2sim.study.diagnose import _sources


def test_neutral_and_the_quality_of_the_trials_are_among_the_inputs(tmp_path):
    """The marker noise is measured in neutral, and quality.json tells how exactly the robot log is synchronised."""
    folders = [tmp_path / name for name in ("dynamic_1", "dynamic_2", "neutral")]
    for folder in folders:
        folder.mkdir()
        for name in ("pose.parquet", "markers.parquet", "robot.parquet", "quality.json"):
            (folder / name).write_text(f"{folder.name} {name}")
    robot = tmp_path / "robot.xml"
    robot.write_text("robot")
    hashes = _sources(folders[:2], folders[2], [robot])["inputs_sha256"]
    read = [path for path in tmp_path.rglob("*.*") if path != folders[2] / "quality.json"]
    assert hashes == {path.as_posix(): sha256(path) for path in read}
