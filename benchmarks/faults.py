"""Injected faults on phantom trials: what the gates see, what they miss, how well clocks are estimated.

    python benchmarks/faults.py [--cases 200] [--people S01 S02 S03] [--clean-seeds 1 2 3]

Faults are injected into the recordings as the readers return them; the truth comes from the phantom's sealed files.
Prints, per kind of fault, the detected share with its Wilson interval; false alarms on clean trials, also of phantoms
of other seeds; errors of offset and drift beside the standard error that the data allow, and beside the Cramer-Rao
bound of the markerless clock (benchmarks/clock_bounds.py). The people are simulated first (10 s each).
"""

from __future__ import annotations

import argparse
import copy
import json
import os
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
ROOT = Path(__file__).parents[1]
sys.path[:0] = [str(ROOT / "workflow"), str(ROOT)]

import numpy as np
from real2sim.configuration import read_yaml, validated
from real2sim.recording.formats.detect import read_markerless
from real2sim.recording.formats.recordings import CoordinateRecording, MarkerRecording
from real2sim.recording.quality import markers
from real2sim.recording.quality.gates import judge, session_of
from real2sim.recording.quality.measure import Measured, RawTrial, find_exchanges, measure
from real2sim.recording.quality.stage import note_copies, raw_trial, signatures_of
from real2sim.recording.quality.verdict import Gate
from real2sim.recording.subjects import read_subject
from real2sim.verification.cohort.plan import planned_files
from real2sim.verification.cohort.write import write_subject
from scipy.spatial.transform import Rotation
from statsmodels.stats.proportion import proportion_confint

from benchmarks import clock_bounds

CONFIG = validated({}, "config", Path("defaults"))
MOVING = ("dynamic", "rotation", "translation", "walk_robot")
# a robot's drift is pooled over these: what a session has at least
SHARP = ("dynamic", "walk_robot")


@dataclass
class People:
    """One person: recordings, figures and truth."""

    name: str
    raw: dict[str, RawTrial]
    clocks: dict[str, dict[str, float]]
    reference: np.ndarray
    marker_sd_m: float
    measured: dict[str, Measured] = field(default_factory=dict)


@dataclass
class Case:
    """One injected fault and what came of it; errors in s and s/s with the standard error that was reported."""

    kind: str
    detected: bool
    detail: str
    offset: tuple[float, float] | None = None
    drift: tuple[float, float] | None = None
    exact: bool | None = None


def simulate(folder: Path, names: list[str], phantom: dict[str, Any]) -> None:
    """Write raw exports and sealed truth of some phantom people."""
    for name in names:
        write_subject(
            subject=name,
            settings=phantom,
            controllers=CONFIG["robot"],
            robot=ROOT / "resources" / "robot" / "drba.xml",
            out=planned_files(phantom, folder / "raw", name),
            truth=folder / "sealed" / f"{name}.json",
        )


def load(raw: Path, sealed: Path, name: str) -> People:
    person = read_subject(raw / name)
    trials = {
        trial: raw_trial(trial, files, person.markers, CONFIG["ingest"])
        for trial, files in person.trials.items()
    }
    truth = json.loads((sealed / f"{name}.json").read_text())
    clocks = {trial: truth["trials"][trial]["clocks"] for trial in trials}
    reference = markers.reference_distances(trials["neutral"].recording.positions)
    out = People(name, trials, clocks, reference, truth["marker_noise_sd_m"])
    out.measured = {trial: _measure(out, one) for trial, one in trials.items()}
    find_exchanges(trials, out.measured, reference, CONFIG["quality"], CONFIG["ingest"])
    note_copies(out.measured, signatures_of(trials, person.trials), CONFIG["quality"])
    return out


def _measure(person: People, trial: RawTrial) -> Measured:
    return measure(trial, person.reference, CONFIG["quality"], CONFIG["ingest"])


def verdicts(person: People, changed: dict[str, Measured], name: str) -> dict[str, Gate]:
    """Gates of one trial by name, after some trials of the person were replaced."""
    measured = person.measured | changed
    session = session_of(list(measured.values()))
    gates = judge(
        measured[name],
        session,
        CONFIG["quality"],
        CONFIG["ingest"],
        scales=CONFIG["identification"]["scales"],
    )
    return {gate.gate: gate for gate in gates}


def _trial(person: People, rng: np.random.Generator, kinds: tuple[str, ...] = MOVING) -> RawTrial:
    names = [name for name, trial in person.raw.items() if trial.kind in kinds]
    return person.raw[names[rng.integers(len(names))]]


def _with_positions(trial: RawTrial, positions: dict[str, np.ndarray]) -> RawTrial:
    return replace(trial, recording=replace(trial.recording, positions=positions))


def _judged(person: People, trial: RawTrial) -> tuple[Measured, dict[str, Gate]]:
    measured = _measure(person, trial)
    return measured, verdicts(person, {trial.name: measured}, trial.name)


def _seen(gates: dict[str, Gate], *names: str) -> bool:
    return any(gates[name].verdict != "pass" for name in names if name in gates)


# -------------------- clocks


def sync_robot(person: People, rng: np.random.Generator) -> Case:
    trial = _trial(person, rng)
    shift = rng.choice([-1, 1]) * 10 ** rng.uniform(np.log10(0.005), np.log10(0.2))
    assert trial.log is not None
    assert trial.log.sync_s is not None
    measured, gates = _judged(person, replace(trial, log=replace(trial.log, sync_s=trial.log.sync_s + shift)))
    fit = measured.robot.clock if measured.robot else None
    offset = None
    if fit is not None:
        offset = fit.offset_s - person.clocks[trial.name]["robot_start_s"], fit.offset_sd_s
    return Case("sync robot", _seen(gates, "robot_sync"), f"{trial.name} {1e3 * shift:+.1f} ms", offset)


def _markerless_truth(clock: dict[str, float], middle: float) -> float:
    start, rate = clock["markerless_start_s"], 1 + clock["markerless_drift"]
    return middle - (middle - start) * rate


def sync_markerless(person: People, rng: np.random.Generator) -> Case:
    trial = _trial(person, rng)
    shift = rng.choice([-1, 1]) * 10 ** rng.uniform(np.log10(0.005), np.log10(0.2))
    assert trial.coordinates is not None
    late = replace(trial.coordinates, time_s=trial.coordinates.time_s + shift)
    measured, _ = _judged(person, replace(trial, coordinates=late, log=None))
    fit = measured.markerless.clock if measured.markerless else None
    detail = f"{trial.name} {1e3 * shift:+.1f} ms"
    if fit is None:
        return Case("sync markerless", False, detail)
    error = fit.offset_s - (_markerless_truth(person.clocks[trial.name], fit.middle_s) - shift)
    # an offset of this system is always estimated and removed: seen means that the estimate followed the fault
    return Case("sync markerless", abs(error) < abs(shift) / 2, detail, (error, fit.offset_sd_s))


def drift_robot(person: People, rng: np.random.Generator) -> Case:
    ppm = rng.choice([-1, 1]) * 10 ** rng.uniform(1, np.log10(200))
    changed = {}
    for name, trial in person.raw.items():
        if trial.kind in SHARP and trial.log is not None:
            stretch, log = 1 + 1e-6 * ppm, trial.log
            late = replace(
                log, base_time_s=log.base_time_s * stretch, joint_time_s=log.joint_time_s * stretch
            )
            if log.sync_s is not None:
                late.sync_s = log.sync_s * stretch
            changed[name] = _measure(person, replace(trial, coordinates=None, log=late))
    only = replace_people(person, changed)
    pooled = session_of(list(changed.values())).robot_drift
    gates = verdicts(only, {}, next(iter(changed)))
    error = None if pooled is None else (pooled.value + 1e-6 * ppm, pooled.sd)
    return Case("drift robot", _seen(gates, "robot_drift"), f"{ppm:+.0f} ppm", drift=error)


def drift_markerless(person: People, rng: np.random.Generator) -> Case:
    ppm = rng.choice([-1, 1]) * 10 ** rng.uniform(1, np.log10(200))
    changed = {}
    for name, trial in person.raw.items():
        if trial.kind != "neutral" and trial.coordinates is not None:
            late = replace(trial.coordinates, time_s=trial.coordinates.time_s * (1 + 1e-6 * ppm))
            changed[name] = _measure(person, replace(trial, coordinates=late, log=None))
    pooled = session_of(list(changed.values())).markerless_drift
    gates = verdicts(replace_people(person, changed), {}, next(iter(changed)))
    own = next(iter(person.clocks.values()))["markerless_drift"]
    error = None if pooled is None else (pooled.value + 1e-6 * ppm + own, pooled.sd)
    return Case("drift markerless", _seen(gates, "markerless_drift"), f"{ppm:+.0f} ppm", drift=error)


def replace_people(person: People, measured: dict[str, Measured]) -> People:
    return replace(person, measured=measured)


# -------------------- markers


def swap(person: People, rng: np.random.Generator) -> Case:
    trial = _trial(person, rng)
    a, b = (markers.MARKERS[i] for i in rng.choice(len(markers.MARKERS), 2, replace=False))
    positions, n = dict(trial.recording.positions), len(trial.recording.time_s)
    length = round(100 * rng.uniform(0.1, 5))
    start = int(rng.integers(0, n - length))
    before = dict(positions)
    positions = markers.repaired(positions, [markers.Swap(a, b, start, start + length)])
    measured, gates = _judged(person, _with_positions(trial, positions))
    restored = markers.repaired(positions, measured.swaps)
    exact = all(np.array_equal(restored[k], before[k], equal_nan=True) for k in markers.MARKERS)
    return Case("swap", _seen(gates, "swaps", "rigid"), f"{trial.name} {a} {b} {length} frames", exact=exact)


def gap(person: People, rng: np.random.Generator) -> Case:
    trial = _trial(person, rng)
    name = markers.MARKERS[rng.integers(len(markers.MARKERS))]
    positions, n = dict(trial.recording.positions), len(trial.recording.time_s)
    length = round(100 * rng.uniform(1.0, 6))
    start = int(rng.integers(0, n - length))
    positions[name] = positions[name].copy()
    positions[name][start : start + length] = np.nan
    _, gates = _judged(person, _with_positions(trial, positions))
    return Case("gap", _seen(gates, "gaps", "completeness"), f"{trial.name} {name} {length} frames")


def outlier(person: People, rng: np.random.Generator) -> Case:
    trial = _trial(person, rng)
    name = markers.MARKERS[rng.integers(len(markers.MARKERS))]
    values = trial.recording.positions[name].copy()
    good = np.flatnonzero(np.isfinite(values[:, 0]))
    for _ in range(rng.integers(1, 6)):
        row = int(rng.choice(good[5:-5]))
        direction = rng.standard_normal(3)
        direction *= 10 ** rng.uniform(np.log10(0.015), np.log10(0.3)) / np.linalg.norm(direction)
        values[row : row + rng.integers(1, 4)] += direction
    _, gates = _judged(person, _with_positions(trial, trial.recording.positions | {name: values}))
    return Case("outlier", _seen(gates, "spikes"), f"{trial.name} {name}")


def rotated(person: People, rng: np.random.Generator) -> Case:
    trial = _trial(person, rng, (*MOVING, "walk_normal"))
    angle = np.radians(10 ** rng.uniform(0, 1))
    level = rng.uniform(0, 2 * np.pi)
    axis = np.array([0, 0, 1.0]) if rng.random() < 0.5 else np.array([np.cos(level), np.sin(level), 0])
    turn = Rotation.from_rotvec(angle * axis).as_matrix()
    positions = {name: values @ turn.T for name, values in trial.recording.positions.items()}
    _, gates = _judged(person, _with_positions(trial, positions))
    seen = _seen(gates, "frame_robot", "frame_markerless")
    return Case("rotated frame", seen, f"{trial.name} {np.degrees(angle):.1f} deg about {axis.round(1)}")


def units(person: People, rng: np.random.Generator) -> Case:
    trial = _trial(person, rng)
    if rng.random() < 0.7:
        factor = 1e-3 if rng.random() < 0.5 else 1e3
        positions = {name: factor * values for name, values in trial.recording.positions.items()}
        trial = _with_positions(trial, positions)
        detail = f"markers x {factor:g}"
    else:
        assert trial.coordinates is not None
        columns = {
            name: values * 1e3 if name.startswith("pelvis_t") and name[-1] in "xyz" else values
            for name, values in trial.coordinates.columns.items()
        }
        trial, detail = (
            replace(trial, coordinates=replace(trial.coordinates, columns=columns)),
            "coordinates in mm",
        )
    _, gates = _judged(person, trial)
    return Case("units", _seen(gates, "units", "markerless_residual"), f"{trial.name} {detail}")


def rate(person: People, rng: np.random.Generator) -> Case:
    trial = _trial(person, rng)
    recording = trial.recording
    wrong = float(rng.choice([50, 60, 90, 120, 125, 150, 200, 240, 250, 98, 99, 101, 102]))
    column = rng.random() < 0.3
    time_s = recording.time_s if column else np.arange(len(recording.time_s)) / wrong
    changed = MarkerRecording(time_s, wrong, recording.positions, recording.first_frame)
    _, gates = _judged(person, replace(trial, recording=changed))
    detail = f"{trial.name} {wrong:g} Hz, {'true' if column else 'no'} Time column"
    # a rate that is off by little is a clock that drifts by much: either gate names it
    return Case("wrong rate", _seen(gates, "rate", "robot_drift"), detail)


# -------------------- trials that are not what their name says


def stretched(person: People, rng: np.random.Generator) -> Case:
    trial = _trial(person, rng)
    factor = 1 + rng.choice([-1, 1]) * rng.uniform(0.02, 0.2)
    positions = {name: factor * values for name, values in trial.recording.positions.items()}
    _, gates = _judged(person, _with_positions(trial, positions))
    return Case("scale of the markers", _seen(gates, "scale"), f"{trial.name} x {factor:.3f}")


def restless(person: People, rng: np.random.Generator) -> Case:
    trial = person.raw["neutral"]
    frames = len(trial.recording.time_s)
    way = np.interp(np.arange(frames), np.sort(rng.uniform(0, frames - 1, 2)), [0.0, 1.0])[:, None]
    direction = rng.standard_normal(3) * [1, 1, 0.3]
    size = 10 ** rng.uniform(np.log10(0.04), np.log10(0.3))
    shift = size * direction / np.linalg.norm(direction)
    positions = {name: values + way * shift for name, values in trial.recording.positions.items()}
    _, gates = _judged(person, _with_positions(trial, positions))
    return Case("moving neutral", _seen(gates, "still"), f"{1e3 * size:.0f} mm")


def exchanged(person: People, rng: np.random.Generator) -> Case:
    trial = _trial(person, rng, ("dynamic",))
    other = person.raw[{"dynamic_1": "dynamic_2", "dynamic_2": "dynamic_1"}[trial.name]]
    robot = bool(rng.random() < 0.5)
    mixed = replace(trial, log=other.log) if robot else replace(trial, coordinates=other.coordinates)
    measured, raw = person.measured | {trial.name: _measure(person, mixed)}, person.raw | {trial.name: mixed}
    find_exchanges(raw, measured, person.reference, CONFIG["quality"], CONFIG["ingest"])
    gates = verdicts(replace_people(person, measured), {}, trial.name)
    gate = gates["robot_pair" if robot else "markerless_pair"]
    return Case(
        "file of another trial", gate.verdict == "refuse", f"{trial.name} {gate.gate}: {gate.message}"
    )


KINDS: tuple[Callable[[People, np.random.Generator], Case], ...] = (
    sync_robot,
    sync_markerless,
    drift_robot,
    drift_markerless,
    swap,
    gap,
    outlier,
    rotated,
    units,
    rate,
    stretched,
    restless,
    exchanged,
)


def run(people: list[People], cases: int, seed: int = 1) -> list[Case]:
    """``cases`` faults, the kinds in turn, people and trials at random."""
    out = []
    for i in range(cases):
        rng = np.random.default_rng([seed, i])
        out.append(KINDS[i % len(KINDS)](people[rng.integers(len(people))], rng))
    return out


def false_alarms(people: list[People]) -> tuple[list[str], int]:
    """Clean trials that some gate does not pass, and how many clean trials there are."""
    alarms, count = [], 0
    for person in people:
        for name in person.measured:
            count += 1
            bad = [gate for gate in verdicts(person, {}, name).values() if gate.verdict != "pass"]
            if bad:
                alarms.append(f"{person.name}/{name}: " + "; ".join(f"{g.gate}: {g.message}" for g in bad))
    return alarms, count


def clean_of_other_seeds(
    names: list[str], phantom: dict[str, Any], seeds: list[int]
) -> tuple[list[str], int, list[tuple[float, float]]]:
    """Alarms and count of clean trials of the same people drawn anew, ``seeds`` on; errors of the pooled drift."""
    alarms, count, drifts = [], 0, []
    for k in seeds:
        for name in names:
            with tempfile.TemporaryDirectory() as scratch:
                simulate(Path(scratch), [name], phantom | {"seed": phantom["seed"] + k})
                person = load(Path(scratch) / "raw", Path(scratch) / "sealed", name)
            some, more = false_alarms([person])
            pooled = session_of(list(person.measured.values())).markerless_drift
            if pooled is not None:
                own = next(iter(person.clocks.values()))["markerless_drift"]
                drifts.append((pooled.value + own, pooled.sd))
            alarms += [f"phantom seed +{k}: {alarm}" for alarm in some]
            count += more
    return alarms, count, drifts


# -------------------- what the clocks hold


@dataclass
class ClockError:
    """Errors of one clean trial's estimate [s, s/s] with the reported standard errors, and the bounds."""

    person: str
    kind: str
    error: tuple[float, float]
    sd: tuple[float, float]
    known: clock_bounds.Bound | None = None
    bound: clock_bounds.Bound | None = None


def clock_errors(people: list[People], phantom: dict[str, Any]) -> tuple[list[ClockError], list[ClockError]]:
    """Errors of the clean trials' robot and markerless clocks; the latter with its Cramer-Rao bounds."""
    robot, markerless = [], []
    noise = phantom["measurement"]["markerless_noise"]
    for person in people:
        with tempfile.TemporaryDirectory() as scratch:
            simulate(Path(scratch), [person.name], clock_bounds.noiseless(copy.deepcopy(phantom)))
            for name, m in person.measured.items():
                own = person.clocks[name]
                fit = m.robot.clock if m.robot else None
                if fit is not None and m.kind != "neutral":
                    error = fit.offset_s - fit.drift * fit.middle_s - own["robot_start_s"]
                    sd = float(np.hypot(fit.offset_sd_s, fit.drift_sd * fit.middle_s))
                    robot.append(ClockError(person.name, m.kind, (error, fit.drift), (sd, fit.drift_sd)))
                fit = m.markerless.clock if m.markerless else None
                if fit is None:
                    continue
                record = read_markerless(Path(scratch) / "raw" / person.name / f"{name}.mot")
                assert isinstance(record, CoordinateRecording)
                bounds = [
                    clock_bounds.bound(record, noise, person.marker_sd_m, known=k) for k in (True, False)
                ]
                error = fit.offset_s - _markerless_truth(own, fit.middle_s)
                drift = fit.drift + own["markerless_drift"]
                sds = fit.offset_sd_s, fit.drift_sd
                markerless.append(ClockError(person.name, m.kind, (error, drift), sds, *bounds))
    return robot, markerless


def _rms(values: list[float]) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


def report_clocks(robot: list[ClockError], markerless: list[ClockError], people: list[People]) -> None:
    """Print, per kind of trial and pooled per person, errors beside what an efficient estimate would have."""
    print("clocks of the clean trials: RMS error, median of the reported standard error, Cramer-Rao bounds")
    for system, errors in (("robot", robot), ("markerless", markerless)):
        for kind in dict.fromkeys(e.kind for e in errors):
            some = [e for e in errors if e.kind == kind]
            offset = 1e3 * _rms([e.error[0] for e in some]), 1e3 * np.median([e.sd[0] for e in some])
            drift = 1e6 * _rms([e.error[1] for e in some]), 1e6 * np.median([e.sd[1] for e in some])
            text = (
                f"{len(some)} trials, offset {offset[0]:.3g} ({offset[1]:.3g}) ms, "
                f"drift {drift[0]:.3g} ({drift[1]:.3g}) ppm"
            )
            for name, bounds in (
                ("geometry known", [e.known for e in some if e.known]),
                ("unknown", [e.bound for e in some if e.bound]),
            ):
                if bounds:
                    text += (
                        f"; bound, {name}: {1e3 * np.median([b.offset_s for b in bounds]):.2f} ms, "
                        f"{1e6 * np.median([b.drift for b in bounds]):.0f} ppm"
                    )
            print(f"  {system} {kind}: {text}")
        within = sum(abs(e.error[0]) <= 1e-3 for e in errors)
        print(f"  {system}: offset within 1 ms: {share(within, len(errors))}", end="")
        best = [clock_bounds.within(1e-3, e.bound.offset_s) for e in errors if e.bound]
        print(f"; an efficient estimate: {100 * np.mean(best):.1f} %" if best else "")
    certainty = CONFIG["quality"]["markerless_drift"]["pooled_certainty_sd"]
    for person in people:
        session = session_of(list(person.measured.values()))
        parts = []
        for system, pooled, own in (
            ("robot", session.robot_drift, 0.0),
            ("markerless", session.markerless_drift, next(iter(person.clocks.values()))["markerless_drift"]),
        ):
            if pooled is not None:
                parts.append(
                    f"{system} drift error {1e6 * (pooled.value + own):+.2f} ppm (sd {1e6 * pooled.sd:.2f})"
                )
        known = [e.known for e in markerless if e.person == person.name and e.known]
        least = clock_bounds.pooled(known)
        print(
            f"  {person.name} pooled: {'; '.join(parts)}; markerless bound {1e6 * least:.1f} ppm: within 5 ppm in "
            f"{100 * clock_bounds.within(5e-6, least):.0f} % at best, drifts of 10-200 ppm seen at {certainty:g} sd in "
            f"{100 * clock_bounds.power(least, certainty, 1e-5, 2e-4):.0f} % at best"
        )


def share(good: int, total: int) -> str:
    """Count, share and Wilson interval."""
    low, high = proportion_confint(good, total, method="wilson")
    return f"{good}/{total} = {100 * good / total:.1f} % [{100 * low:.1f}, {100 * high:.1f}]"


def _errors(found: list[tuple[float, float]], unit: float, bar: float, name: str) -> str:
    error, sd = np.array(found).T * unit
    covered = int((np.abs(error) < 1.96 * sd).sum())
    return (
        f"  RMS error {np.sqrt(np.mean(error**2)):.3g} {name}, largest {np.abs(error).max():.3g}; the data allow "
        f"{np.median(sd):.3g} (median standard error); inside the 95 % interval {share(covered, len(sd))}; "
        f"within {bar:g} {name}: {share(int((np.abs(error) <= bar).sum()), len(error))}"
    )


def report(cases: list[Case], alarms: list[str], clean: int) -> None:
    """Print everything."""
    for kind in dict.fromkeys(case.kind for case in cases):
        some = [case for case in cases if case.kind == kind]
        print(f"{kind}: detected {share(sum(c.detected for c in some), len(some))}")
        offsets, drifts = [c.offset for c in some if c.offset], [c.drift for c in some if c.drift]
        if offsets:
            print(_errors(offsets, 1e3, 1.0, "ms"))
        if drifts:
            print(_errors(drifts, 1e6, 5.0, "ppm"))
        exact = [c.exact for c in some if c.exact is not None]
        if exact:
            print(f"  labels restored exactly: {share(sum(exact), len(exact))}")
        for case in some:
            if not case.detected:
                print(f"  missed: {case.detail}")
    for name, some in (
        ("all", cases),
        ("all but drift of the markerless clock", [c for c in cases if c.kind != "drift markerless"]),
    ):
        if some:
            print(f"{name}: detected {share(sum(c.detected for c in some), len(some))} (bar 98 %)")
    print(f"clean trials with an alarm: {share(len(alarms), clean)} (bar 1 %)")
    for alarm in alarms:
        print(f"  {alarm}")


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--cases", type=int, default=200)
    parser.add_argument("--people", nargs="+", default=["S01", "S02", "S03"])
    parser.add_argument(
        "--clean-seeds", type=int, nargs="*", default=[], help="phantoms so many seeds on, clean only"
    )
    parser.add_argument("--seed", type=int, default=1, help="of the faults")
    options = parser.parse_args()
    start = time.monotonic()
    source = ROOT / "config" / "phantom.yaml"
    phantom = validated(read_yaml(source), "phantom", source)
    with tempfile.TemporaryDirectory() as scratch:
        simulate(Path(scratch), options.people, phantom)
        people = [load(Path(scratch) / "raw", Path(scratch) / "sealed", name) for name in options.people]
    alarms, clean = false_alarms(people)
    more, count, drifts = clean_of_other_seeds(options.people, phantom, options.clean_seeds)
    report(run(people, options.cases, options.seed), alarms + more, clean + count)
    if drifts:
        print(f"markerless drift pooled over {len(drifts)} clean sessions of other seeds:")
        print(_errors(drifts, 1e6, 5.0, "ppm"))
    report_clocks(*clock_errors(people, phantom), people)
    print(f"{time.monotonic() - start:.0f} s")


if __name__ == "__main__":
    main()
