"""Do the 95 % intervals hold the truth in 95 % of cases? Phantom draws, one dynamic trial each.

    python benchmarks/coverage.py --draws 200 --rows coverage.jsonl --limit-s 450 --out coverage.json

Each draw has parameters of its own (log-normal about Table I, within the bounds), a motion of its own and white marker
noise of 0.2-0.5 mm on pelvis and interface. In every third draw the arm cannot pitch and the pelvis only translates, so
that k_ry and d_ry move no marker. (With turns of the pelvis they do, even where the arm cannot pitch: a turned strap
rolls the arm.) A parameter counts as flat if its true SD (noise-free Jacobian, Monte Carlo of the noise) is at least
1 ln-unit: it must be called "not determined".

Finished draws are kept in the file of rows, one JSON object a line. A run goes on where the last one stopped, ends
after ``--limit-s`` and reports on what there is. A draw depends on its number and the seed alone.
"""

from __future__ import annotations

import argparse
import copy
import json
import os
import sys
import time
from pathlib import Path

# two threads of BLAS beside another process cost a hundred times what they save
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np

ROOT = Path(__file__).parents[1]
sys.path.insert(0, str(ROOT / "workflow"))

from real2sim import geometry
from real2sim.artefacts import write_json
from real2sim.configuration import read_yaml, validated
from real2sim.files import write_text
from real2sim.inference.cost import CostScales, TrialCost
from real2sim.inference.identifiability import DETERMINED, NOT_DETERMINED, WEAK, central_jacobian
from real2sim.inference.least_squares import Residuals, search
from real2sim.inference.parameters import PARAMETERS, Bounds
from real2sim.recording.trial import Trial, TrialModel, replay_of
from real2sim.signals import lowpass
from real2sim.study.assessment import assess_model
from real2sim.system.plant import RestPose
from real2sim.verification.cohort.write import FREE
from real2sim.verification.cohort.write import _path_from_start as path_from_start
from real2sim.verification.phantom.person import draw_person
from real2sim.verification.phantom.physics import Robot, StrapLaw, robot_controller, simulate
from real2sim.verification.phantom.tasks import motion_of

FLAT_SD_LN = 1.0
NEUTRAL_S = 8.0


def robot_without_pitch(folder: Path) -> Path:
    """The robot twin with an arm too heavy to pitch by a microradian (with 10^4 kg m² it pitches by 0.1 rad)."""
    text = (ROOT / "resources" / "robot" / "drba.xml").read_text()
    joint = '<joint name="arm_pitch" type="hinge" axis="0 1 0"'
    assert joint in text
    path = folder / "without_pitch.xml"
    path.write_text(text.replace(joint, joint + ' armature="1e8"'))
    return path


NORMAL, FLAT = "normal", "without pitch and turns"
KINDS = (NORMAL, NORMAL, FLAT)


def translating(phantom: dict) -> dict:
    """The phantom's settings with a dynamic motion that does not turn the pelvis."""
    changed = copy.deepcopy(phantom)
    dynamic = changed["motions"]["dynamic"]
    for pose in [*dynamic["targets"], *(wave["pose"] for wave in dynamic["sway"])]:
        pose[3:] = [0, 0, 0]
    return changed


def draws(count: int, seed: int, bounds: Bounds, phantom: dict) -> np.ndarray:
    """Parameters (count, 12): log-normal about the prior with an SD of 0.4, two ln-steps inside the bounds."""
    prior = np.array([phantom["parameters"]["values"][name]["prior"] for name in PARAMETERS])
    low, high = np.log(bounds.lower) + 0.25, np.log(bounds.upper) - 0.25
    z = np.log(prior) + 0.4 * np.random.default_rng(seed).standard_normal((count, 12))
    return np.exp(np.clip(z, low, high))


def true_trials(
    robot: Path, phantom: dict, config: dict, parameters: np.ndarray, seeds: list[int]
) -> list[tuple[object, object]]:
    """Person and true paths of one dynamic trial per draw; ``parameters`` (n, 12), ``seeds`` one each."""
    plant = Robot(robot, phantom["simulation"]["step_s"])
    people, paths = [], []
    for seed in seeds:
        settings = phantom | {"seed": seed}
        name = list(phantom["cohort"])[seed % 6]
        person = draw_person(settings, name, float(plant.rest_middle(np.zeros(6))[1][2]))
        motion = motion_of(settings, person, "dynamic_1")
        pose = person.rest_rotation, person.rest_position
        paths.append(path_from_start(plant, motion, np.zeros(6), *pose, person.pivot, 0.6))
        people.append(person)
    n = len(parameters)
    law = StrapLaw(
        parameters[:, :6],
        parameters[:, 6:],
        np.tile(-FREE, (n, 1)),
        np.tile(FREE, (n, 1)),
        np.array(phantom["stops"]["stiffness"]),
        np.array(phantom["stops"]["damping"]),
        np.stack([p.rest_rotation for p in people]),
        np.stack([p.rest_position for p in people]),
        np.zeros((n, 3)),
    )
    hands = [robot_controller(phantom, config["robot"], "dynamic", np.zeros(6))] * n
    return list(zip(people, simulate(plant, paths, law, hands, 100.0), strict=True))


def measured_model(person, truth, noise_m: float, seed: int, robot: Path, config: dict) -> TrialModel:
    """The trial as the pipeline would see it: noise, low-pass, frames, rest pose from a noisy neutral."""
    rng = np.random.default_rng(seed)
    keep = slice(60, 3060)

    def smooth(paths: np.ndarray) -> np.ndarray:
        noisy = paths + noise_m * rng.standard_normal(paths.shape)
        return lowpass(noisy.reshape(len(noisy), -1), 100, 12, 4).reshape(noisy.shape)

    markers = {
        name: truth.pelvis_position + truth.pelvis_rotation @ person.markers[name]
        for name in geometry.PELVIS_MARKERS
    }
    pelvis = smooth(np.stack([markers[name] for name in geometry.PELVIS_MARKERS], axis=1))
    interface = smooth(np.stack([truth.left, truth.right], axis=1))
    r_p, p_p = geometry.pelvis_frame(*np.moveaxis(pelvis, 1, 0))
    r_i, p_i = geometry.interface_frame(interface[:, 0], interface[:, 1])
    error = noise_m / np.sqrt(NEUTRAL_S * 100)
    rest = RestPose(person.rest_rotation, person.rest_position + error * rng.standard_normal(3))
    start = slice(60, 110)
    trial = Trial(
        np.arange(3000) / 100,
        r_p[keep],
        p_p[keep],
        interface[keep],
        geometry.mean_rotation(r_i[start]),
        p_i[start].mean(axis=0),
        np.ones(3000, bool),
        rest,
        True,
        pelvis[keep],
    )
    replay = replay_of(trial, None, robot, config, nsim=13)
    scales = CostScales(0.041, 0.080)
    return TrialModel(trial, replay, TrialCost(trial.interface, 100, scales, trial.usable), None)


def true_sd(person, truth, parameters: np.ndarray, noise_m: float, robot: Path, config: dict) -> np.ndarray:
    """SD (12,) in ln-units that the noise of the interface markers gives, by the noise-free Jacobian."""
    model = measured_model(person, truth, 0.0, 1, robot, config)
    bounds = Bounds.from_config(config["identification"]["bounds"])
    problem = Residuals(lambda p: model.cost.residuals(model.replay.run(p)), bounds, 13)
    _, jacobian = central_jacobian(problem, np.log(parameters), 1e-3)
    rng = np.random.default_rng(2)
    shape = model.trial.interface.shape
    noises = []
    for _ in range(30):
        noise = lowpass(noise_m * rng.standard_normal((shape[0], 6)), 100, 12, 4).reshape(shape)
        noises.append(model.cost.residuals((model.trial.interface + noise)[None])[0])
    out = np.full(12, np.inf)
    for i in range(12):
        # what of a parameter's signature the other parameters cannot imitate
        others = np.delete(jacobian, i, axis=1)
        own = jacobian[:, i] - others @ np.linalg.lstsq(others, jacobian[:, i], rcond=1e-10)[0]
        if own @ own > 1e-14:
            out[i] = np.std([own @ noise for noise in noises]) / (own @ own)
    return out


def assessed(person, truth, parameters, noise_m: float, seed: int, robot: Path, config: dict) -> dict:
    """Fit and verdicts of one draw, beside its truth."""
    start = time.process_time()
    model = measured_model(person, truth, noise_m, seed, robot, config)
    bounds = Bounds.from_config(config["identification"]["bounds"])
    options = config["identification"]["least_squares"]
    fit = search(lambda p: model.cost.residuals(model.replay.run(p)), bounds, batch=13, seed=seed, **options)
    verdicts = assess_model(model, fit.parameters, bounds, np.full(4, noise_m), robot=robot, settings=config)
    used = time.process_time() - start
    sd = true_sd(person, truth, parameters, noise_m, robot, config)
    return {
        # JSON has no infinity
        "true_sd": dict(zip(PARAMETERS, np.minimum(sd, 1e6).tolist(), strict=True)),
        "noise_m": noise_m,
        "truth": dict(zip(PARAMETERS, parameters.tolist(), strict=True)),
        "fit": verdicts["parameters"],
        "J": verdicts["J"],
        "evaluations": fit.evaluations + verdicts["evaluations"],
        "cpu_s": used,
    }


def wilson(hits: int, n: int) -> tuple[float, float]:
    """95 % Wilson interval of a share."""
    if n == 0:
        return float("nan"), float("nan")
    z, p = 1.96, hits / n
    centre, half = p + z * z / (2 * n), z * np.sqrt(p * (1 - p) / n + z * z / (4 * n * n))
    return (centre - half) / (1 + z * z / n), (centre + half) / (1 + z * z / n)


def holds(row: dict, name: str) -> bool:
    """Return whether an interval holds the truth; a side without an end reaches to the bound."""
    low, high = row["fit"][name]["ci95"]
    return (low is None or low <= row["truth"][name]) and (high is None or row["truth"][name] <= high)


def share(hits: int, n: int) -> dict:
    """Hits, cases, their ratio and its 95 % interval."""
    return {"hits": hits, "of": n, "share": hits / n if n else None, "ci95": wilson(hits, n) if n else None}


def coverage_of(cases: list[tuple[dict, str]]) -> dict:
    """Share of the intervals of (row, parameter) that hold the truth, as `share` gives it."""
    return share(sum(holds(row, name) for row, name in cases), len(cases))


def _line(label: str, result: dict) -> str:
    if not result["of"]:
        return f"{label:34s}    0"
    low, high = result["ci95"]
    return (
        f"{label:34s} {result['hits']:4d} of {result['of']:4d} = {result['share']:.3f} ({low:.3f}-{high:.3f})"
    )


def report(rows: list[dict]) -> dict:
    """Print and return the shares: intervals that hold the truth, flat profiles that are told as such."""
    cases = [(row, name) for row in rows for name in PARAMETERS]
    sure = [(r, n) for r, n in cases if r["fit"][n]["verdict"] == DETERMINED]
    flat = [(r, n) for r, n in cases if r["true_sd"][n] >= FLAT_SD_LN]

    def told(chosen: list[tuple[dict, str]]) -> dict:
        return share(sum(r["fit"][n]["verdict"] == NOT_DETERMINED for r, n in chosen), len(chosen))

    out = {
        "draws": {kind: sum(row["kind"] == kind for row in rows) for kind in (NORMAL, FLAT)},
        "cpu_s": {
            kind: float(np.median([r["cpu_s"] for r in rows if r["kind"] == kind] or [0]))
            for kind in (NORMAL, FLAT)
        },
        "determined": coverage_of(sure),
        "determined_by_kind": {
            kind: coverage_of([c for c in sure if c[0]["kind"] == kind]) for kind in (NORMAL, FLAT)
        },
        "determined_by_parameter": {
            name: coverage_of([c for c in sure if c[1] == name]) for name in PARAMETERS
        },
        "weak": coverage_of([(r, n) for r, n in cases if r["fit"][n]["verdict"] == WEAK]),
        "flat_told": told(flat),
        "flat_told_by_parameter": {name: told([c for c in flat if c[1] == name]) for name in PARAMETERS},
        "flat_told_otherwise": sorted({r["fit"][n]["verdict"] for r, n in flat} - {NOT_DETERMINED}),
        "seen_called_not_determined": told([(r, n) for r, n in cases if r["true_sd"][n] < FLAT_SD_LN / 10]),
    }
    print(f"draws {out['draws']}, median CPU seconds each {out['cpu_s']}")
    print(_line("determined: interval holds truth", out["determined"]) + "   bar 0.92-0.98")
    for group in ("kind", "parameter"):
        for name, result in out[f"determined_by_{group}"].items():
            print("  " + _line(name, result))
    print(_line("weak: interval holds truth", out["weak"]))
    print(_line("flat profile: not determined", out["flat_told"]) + "   bar 0.90")
    for name, result in out["flat_told_by_parameter"].items():
        if result["of"]:
            print("  " + _line(name, result))
    if out["flat_told_otherwise"]:
        print(f"  the others: {', '.join(out['flat_told_otherwise'])}")
    print(_line("true SD < 0.1: not determined", out["seen_called_not_determined"]))
    return out


def finished(path: Path) -> dict[int, dict]:
    """Draws in a file of rows by number; a last line that a killed run left half is dropped."""
    rows = {}
    if path.exists():
        for line in path.read_text().splitlines():
            try:
                row = json.loads(line)
            except ValueError:
                continue
            rows[row["draw"]] = row
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--draws", type=int, default=200)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--chunk", type=int, default=12, help="draws whose truth is simulated together")
    parser.add_argument("--rows", type=Path, default=Path("coverage.jsonl"), help="finished draws")
    parser.add_argument("--limit-s", type=float, default=np.inf, help="begin no further draw after this time")
    parser.add_argument("--out", type=Path, help="the report as JSON")
    options = parser.parse_args()
    config = validated({}, "config", Path("defaults"))
    config["plant"]["timestep_s"] = 0.01
    source = ROOT / "config" / "phantom.yaml"
    phantom = copy.deepcopy(validated(read_yaml(source), "phantom", source))
    phantom["effects"]["enabled"] = phantom["measurement"]["enabled"] = False
    bounds = Bounds.from_config(config["identification"]["bounds"])
    parameters = draws(options.draws, options.seed, bounds, phantom)
    noise = np.random.default_rng(options.seed + 1).uniform(0.0002, 0.0005, options.draws)
    folder = options.rows.resolve().parent
    robots = {NORMAL: ROOT / config["paths"]["robot"], FLAT: robot_without_pitch(folder)}
    rows = finished(options.rows)
    # what a killed run left half must not run into the next row
    write_text(options.rows, "".join(json.dumps(row) + "\n" for row in rows.values()))
    start = time.monotonic()
    with options.rows.open("a") as stream:
        for chunk in np.array_split(np.arange(options.draws), -(-options.draws // options.chunk)):
            for kind in (NORMAL, FLAT):
                todo = [int(i) for i in chunk if KINDS[i % len(KINDS)] == kind and int(i) not in rows]
                if not todo or time.monotonic() - start > options.limit_s:
                    continue
                robot = robots[kind]
                seeds = [10_000 * options.seed + i for i in todo]
                trials = true_trials(
                    robot, translating(phantom) if kind == FLAT else phantom, config, parameters[todo], seeds
                )
                for i, (person, truth) in zip(todo, trials, strict=True):
                    if time.monotonic() - start > options.limit_s:
                        break
                    row = assessed(person, truth, parameters[i], noise[i], i, robot, config)
                    rows[i] = {"draw": i, "kind": kind} | row
                    stream.write(json.dumps(rows[i]) + "\n")
                    stream.flush()
            print(f"{len(rows)}/{options.draws} draws, {time.monotonic() - start:.0f} s", file=sys.stderr)
    result = report([rows[i] for i in sorted(rows)])
    if options.out:
        write_json(options.out, result)


if __name__ == "__main__":
    main()
