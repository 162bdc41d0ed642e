"""Do the 95 % intervals hold the truth in 95 % of cases? Phantom draws, one dynamic trial each.

    python benchmarks/coverage.py --draws 200 --out coverage.json

Each draw has parameters of its own (log-normal about Table I, within the bounds), a motion of its own and white marker
noise of 0.2-0.5 mm on pelvis and interface. In half of the draws the arm cannot pitch and the pelvis only translates,
so that k_ry and d_ry move no marker. (With turns of the pelvis they do, even where the arm cannot pitch: a turned strap
rolls the arm.) A parameter counts as flat if its true SD (noise-free Jacobian, Monte Carlo of the noise) is at least
1 ln-unit: it must be called "not determined".
"""

from __future__ import annotations

import argparse
import copy
import json
import sys
import time
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

import numpy as np

ROOT = Path(__file__).parents[1]
sys.path.insert(0, str(ROOT / "workflow"))

from real2sim import geometry
from real2sim.configuration import read_yaml, validated
from real2sim.coupling.plant import RestPose
from real2sim.identification.assessment import assess_model
from real2sim.identification.cost import CostScales, TrialCost
from real2sim.identification.identifiability import DETERMINED, NOT_DETERMINED, central_jacobian
from real2sim.identification.least_squares import Residuals, search
from real2sim.identification.parameters import PARAMETERS, Bounds
from real2sim.identification.trial import Trial, TrialModel, replay_of
from real2sim.phantom.cohort import FREE, robot_controller
from real2sim.phantom.cohort import _path_from_start as path_from_start
from real2sim.phantom.person import draw_person
from real2sim.phantom.physics import Robot, StrapLaw, simulate
from real2sim.phantom.tasks import motion_of
from real2sim.signals import lowpass

FLAT_SD_LN = 1.0
NEUTRAL_S = 8.0


def robot_without_pitch(folder: Path) -> Path:
    """The robot twin with an arm too heavy to pitch."""
    text = (ROOT / "resources" / "robot" / "drba.xml").read_text()
    joint = '<joint name="arm_pitch" type="hinge" axis="0 1 0"'
    assert joint in text
    path = folder / "without_pitch.xml"
    path.write_text(text.replace(joint, joint + ' armature="10000"'))
    return path


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
    robot: Path, phantom: dict, config: dict, parameters: np.ndarray, seed: int
) -> list[tuple[object, object]]:
    """Person and true paths of one dynamic trial per draw."""
    plant = Robot(robot, phantom["simulation"]["step_s"])
    people, paths = [], []
    for i in range(len(parameters)):
        settings = phantom | {"seed": seed + i}
        name = list(phantom["cohort"])[i % 6]
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
    jacobian = central_jacobian(problem, np.log(parameters), 1e-3)
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


def _one(job) -> dict:
    person, truth, parameters, noise_m, seed, robot, config, without_pitch = job
    model = measured_model(person, truth, noise_m, seed, robot, config)
    bounds = Bounds.from_config(config["identification"]["bounds"])
    options = config["identification"]["least_squares"]
    fit = search(lambda p: model.cost.residuals(model.replay.run(p)), bounds, batch=13, seed=seed, **options)
    verdicts = assess_model(model, fit.parameters, bounds, np.full(4, noise_m), robot=robot, settings=config)
    return {
        "without_pitch": without_pitch,
        "true_sd": dict(
            zip(PARAMETERS, true_sd(person, truth, parameters, noise_m, robot, config).tolist(), strict=True)
        ),
        "noise_m": noise_m,
        "truth": dict(zip(PARAMETERS, parameters.tolist(), strict=True)),
        "fit": verdicts["parameters"],
        "J": verdicts["J"],
    }


def wilson(hits: int, n: int) -> tuple[float, float]:
    """95 % Wilson interval of a share."""
    if n == 0:
        return float("nan"), float("nan")
    z, p = 1.96, hits / n
    centre, half = p + z * z / (2 * n), z * np.sqrt(p * (1 - p) / n + z * z / (4 * n * n))
    return (centre - half) / (1 + z * z / n), (centre + half) / (1 + z * z / n)


def report(rows: list[dict]) -> None:
    print(
        f"{'parameter':9s} {'determined':>10s} {'covered':>8s} {'share':>7s}   95 % Wilson     not determined"
    )
    total = [0, 0]
    for name in PARAMETERS:
        sure = [r for r in rows if r["fit"][name]["verdict"] == DETERMINED]
        hits = sum(r["fit"][name]["ci95"][0] <= r["truth"][name] <= r["fit"][name]["ci95"][1] for r in sure)
        total[0] += hits
        total[1] += len(sure)
        low, high = wilson(hits, len(sure))
        lost = sum(r["fit"][name]["verdict"] == NOT_DETERMINED for r in rows)
        share = hits / len(sure) if sure else float("nan")
        print(f"{name:9s} {len(sure):10d} {hits:8d} {share:7.3f}   {low:.3f}-{high:.3f}   {lost:10d}")
    low, high = wilson(*total)
    print(f"all       {total[1]:10d} {total[0]:8d} {total[0] / max(total[1], 1):7.3f}   {low:.3f}-{high:.3f}")
    flat = [
        r["fit"][name]["verdict"] for r in rows for name in PARAMETERS if r["true_sd"][name] >= FLAT_SD_LN
    ]
    hits = sum(v == NOT_DETERMINED for v in flat)
    low, high = wilson(hits, len(flat))
    print(f"flat profiles called not determined: {hits} of {len(flat)} ({low:.3f}-{high:.3f})")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--draws", type=int, default=200)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--out", type=Path, default=Path("coverage.json"))
    options = parser.parse_args()
    config = validated({}, "config", Path("defaults"))
    config["plant"]["timestep_s"] = 0.01
    source = ROOT / "config" / "phantom.yaml"
    phantom = copy.deepcopy(validated(read_yaml(source), "phantom", source))
    phantom["effects"]["enabled"] = phantom["measurement"]["enabled"] = False
    bounds = Bounds.from_config(config["identification"]["bounds"])
    parameters = draws(options.draws, options.seed, bounds, phantom)
    noise = np.random.default_rng(options.seed + 1).uniform(0.0002, 0.0005, options.draws)
    robots = [ROOT / config["paths"]["robot"], robot_without_pitch(options.out.resolve().parent)]
    rows: list[dict] = []
    start = time.monotonic()
    with ProcessPoolExecutor(options.workers) as pool:
        for without_pitch, robot in enumerate(robots):
            chosen = np.arange(without_pitch, options.draws, 2)
            for chunk in np.array_split(chosen, max(len(chosen) // 20, 1)):
                seed = 10_000 * options.seed + int(chunk[0])
                trials = true_trials(
                    robot,
                    translating(phantom) if without_pitch else phantom,
                    config,
                    parameters[chunk],
                    seed,
                )
                jobs = [
                    (person, truth, parameters[i], noise[i], int(i), robot, config, bool(without_pitch))
                    for i, (person, truth) in zip(chunk, trials, strict=True)
                ]
                rows += pool.map(_one, jobs)
                print(f"{len(rows)}/{options.draws} draws, {time.monotonic() - start:.0f} s", file=sys.stderr)
                options.out.write_text(json.dumps(rows) + "\n")
    report(rows)


if __name__ == "__main__":
    main()
