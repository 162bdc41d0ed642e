"""Which robot held the strap: people recorded with one of two robots, diagnosed with both and with the wrong one.

python benchmarks/which_robot.py OUT [--people S01 S02] [--without-log] [--alone]

Synthetic people (config/phantom-paper-gap.yaml) are recorded with the robot of the configuration and with the study's
(config/study-robot.yaml), also 15 % heavier than its model, without any effect. Each is diagnosed as a study is that is
configured with the assumed robot and lists the study's. ``--alone``: also without the list, as if nobody had thought of
it. Finished diagnoses in the folder OUT are kept.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import json
import sys
import time
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import mujoco
import numpy as np
from real2sim.artefacts import write_json
from real2sim.configuration import read_yaml, validated
from real2sim.diagnosis.stated import answer_probability
from real2sim.files import write_text
from real2sim.recording.ingest import ingest_subject
from real2sim.study.diagnose import diagnose
from real2sim.verification.cohort.plan import read_settings
from real2sim.verification.cohort.write import simulate_subject, write_trials
from real2sim.verification.paper_gap.people import as_wide_as
from real2sim.verification.paper_gap.plan import TRIALS

ROOT = Path(__file__).parents[1]
ASSUMED, STUDY, HEAVIER = "assumed", "study", "study heavier"
# The model of the study's robot is of 2025: what stands in the lab may differ by as much [1]
HEAVIER_BY = 1.15


def _config(name: str) -> dict[str, Any]:
    source = ROOT / "config" / name
    return validated(read_yaml(source), "config", source)


def _record(person: str, robot: Path, controllers: dict[str, Any], out: Path, *, log: bool) -> None:
    """Write canonical tables and the true joint limits of a person recorded with a robot."""
    phantom, config = read_settings(ROOT / "config/phantom-paper-gap.yaml"), _config("config.yaml")
    simulated = simulate_subject(phantom, controllers, robot, person, TRIALS)
    with TemporaryDirectory() as raw:
        folder = Path(raw) / person
        write_trials(folder, phantom, robot, simulated)
        if not log:
            for path in folder.glob("*.mcap"):
                path.unlink()
        files = [path for path in folder.iterdir() if path.name != "subject.yaml"]
        with contextlib.redirect_stdout(io.StringIO()):
            ingest_subject(
                subject=person,
                folder=folder,
                settings=config["ingest"],
                raw=sorted(files),
                out=out / "trials",
            )
    lower, upper = simulated.person.stops[simulated.person.operating_level]
    limits = {"schema": 1, "phantom": True, "q_min": lower.tolist(), "q_max": upper.tolist()}
    write_json(out / "limits.json", limits)


def _diagnosed(person: str, folder: Path, robot: Path, robots: dict[str, Any], out: Path) -> dict[str, Any]:
    """Return the contents of diagnosis.json, of a study that is configured with the assumed robot."""
    config = _config("config.yaml")
    slices = ("ingest", "identification", "identifiability", "plant", "robot", "diagnosis")
    settings = {name: config[name] for name in slices}
    settings["plant"] = settings["plant"] | {"timestep_s": 0.01}
    if not out.exists():
        begun = time.process_time()
        tables = folder / "trials"
        diagnose(
            subject=person,
            train=tables / "dynamic_1",
            held_out=tables / "dynamic_2",
            neutral=tables / "neutral",
            robot=robot,
            settings=settings,
            limits=folder / "limits.json",
            robots=robots,
            out=out,
        )
        write_json(out.with_suffix(".seconds.json"), {"seconds": time.process_time() - begun})
    return json.loads(out.read_text()) | json.loads(out.with_suffix(".seconds.json").read_text())


def _row(recorded: str, listed: bool, d: dict[str, Any]) -> str:
    machine, gap = d["machine"], d["gap"]
    found = "-" if machine is None else f"{machine['name']} {machine['probability']:.3f}"
    names = " + ".join(d["verdict_set"])
    left = sum(gap["chi2_best"]) / sum(gap["chi2_expected"])
    cells = [
        d["subject"], recorded, "both" if listed else "assumed", found, f"{names} {answer_probability(d):.2f}",
        ", ".join(f"{gap[key]:.3f}" for key in ("J_base", "J_with_effect", "J_floor")),
        f"{sum(gap['chi2_plain']) / sum(gap['chi2_expected']):.1f}, {left:.2f}", f"{d['seconds']:.0f}",
    ]  # fmt: skip
    return f"| {' | '.join(cells)} |"


def _heavier(model: Path, out: Path) -> Path:
    """Write a robot whose masses, inertias and armatures are `HEAVIER_BY` times those of another one."""
    spec = mujoco.MjSpec.from_file(str(model))
    for body in spec.bodies:
        body.mass, body.inertia = HEAVIER_BY * body.mass, HEAVIER_BY * np.array(body.inertia)
    for joint in spec.joints:
        joint.armature = HEAVIER_BY * joint.armature
    spec.compile()
    write_text(out, spec.to_xml())
    return out


def _known(recorded: Path, same: str, models: dict[str, Path], folder: Path) -> dict[str, Path]:
    """Return what a study knows of each robot: as it is described, the strap fixed where markers show it to be.

    ``same`` is the robot that was recorded, or one that holds the strap in the same place.
    """
    known = dict(models)
    for name, model in models.items():
        if name != same:
            known[name] = folder / f"{name}.xml"
            as_wide_as(recorded, model, known[name])
    return known


def _rows(person: str, given: argparse.Namespace, robots: dict[str, tuple[Path, dict[str, Any]]]) -> None:
    """Record, diagnose and print a person with each robot."""
    models = {name: model for name, (model, _) in robots.items()}
    for recorded in (ASSUMED, STUDY, HEAVIER):
        folder = given.out / f"{recorded}{'_without_log' if given.without_log else ''}" / person
        same = STUDY if recorded == HEAVIER else recorded
        model, controllers = robots[same]
        if recorded == HEAVIER:
            model = _heavier(model, folder / "recorded.xml")
        if not (folder / "limits.json").exists():
            _record(person, model, controllers, folder, log=not given.without_log)
        known = _known(model, same, models, folder)
        other = {STUDY: {"model": str(known[STUDY]), "robot": robots[STUDY][1]}}
        for listed in (True, False) if given.alone and recorded == STUDY else (True,):
            out = folder / f"{'both' if listed else 'alone'}.json"
            d = _diagnosed(person, folder, known[ASSUMED], other if listed else {}, out)
            print(_row(recorded, listed, d), flush=True)
            print(file=sys.stderr)


def main() -> None:
    """Record, diagnose, print a table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("out", type=Path)
    parser.add_argument("--people", nargs="*", default=["S01", "S02", "S03", "S04", "S05"])
    parser.add_argument("--without-log", action="store_true")
    parser.add_argument("--alone", action="store_true")
    given = parser.parse_args()
    robots = {}
    for name, source in ((ASSUMED, "config.yaml"), (STUDY, "study-robot.yaml")):
        config = _config(source)
        robots[name] = (ROOT / config["paths"]["robot"], config["robot"])
    print(
        "| person | recorded with | listed | found | answer | J plain, with, floor | chi2 plain, with | s |"
    )
    print("|---|---|---|---|---|---|---|---|", flush=True)
    for person in given.people:
        _rows(person, given, robots)


if __name__ == "__main__":
    main()
