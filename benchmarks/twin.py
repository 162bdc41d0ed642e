"""Bars of the human twin, per body and seed: free walk, pushes, floor force, coupled walks, training time.

    python benchmarks/twin.py                      three seeds of 1.75 m 75 kg, one of 1.55 m 50 kg and of 1.90 m 110 kg
    python benchmarks/twin.py --quick              a training of a minute: shows that it runs, passes nothing
    python benchmarks/twin.py --bodies 1.75 --seeds 1 --folder results/benchmarks/twin

The gait is the phantom's walk_normal (config/phantom.yaml), the interface its rest pose and stops, the prior the
published one. Policies of the same settings are used again from --folder. Exit code 1: a bar is missed.
About 3 to 8 minutes of processor time per training and 2 per examination.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import sys
import time
from pathlib import Path

for variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
    os.environ.setdefault(variable, "1")
ROOT = Path(__file__).parents[1]
sys.path.insert(0, str(ROOT / "workflow"))
PUBLISHED = ROOT / "resources" / "published"

import numpy as np
from real2sim.artefacts import read_json, write_json
from real2sim.configuration import read_yaml, validated
from real2sim.geometry import rotation_xyz
from real2sim.study.twin import adaptation
from real2sim.study.twin.coupled import Condition, CoupledWalk, Recording
from real2sim.study.twin.evaluate import plain
from real2sim.study.twin.gait import PHASES, SAGITTAL, Reference, make_reference, with_speeds
from real2sim.study.twin.human import Body
from real2sim.study.twin.policy import Policy, load_policy, save_policy
from real2sim.study.twin.stage import (
    bar_rows,
    conditions_of,
    examined,
    height_walked,
    read_paper,
    read_prior,
    walk_free,
    walking_robots,
)
from real2sim.study.twin.train import Trainer, train
from real2sim.system.plant import JointLimits, RestPose

BODIES = {1.55: Body(1.55, 50.0, "female"), 1.75: Body(1.75, 75.0, "male"), 1.90: Body(1.90, 110.0, "male")}
STRIDE_S, SPEED_OF_175 = 1.2, 1.10
SIZE_LIMIT, TIME_LIMIT_S, SURVIVAL = 200_000, 900.0, 0.95
# Largest RMS slip of a standing heel [m/s]; difference between stride times cadence and speed [1]
SLIP, STRIDE_OFF = 0.05, 0.02


def measured_curves(phantom: dict) -> dict[str, np.ndarray]:
    """The phantom's mean cycle of normal walking [rad, m]."""
    gait, phase = phantom["gait"], np.arange(PHASES) / PHASES

    def wave(terms: list) -> np.ndarray:
        turns = [2 * np.pi * k * phase for k in range(1, len(terms) + 1)]
        return np.sum([a * np.cos(t) + b * np.sin(t) for t, (a, b) in zip(turns, terms, strict=True)], axis=0)

    out = {"hip_adduction": np.zeros(PHASES), "hip_rotation": np.zeros(PHASES)}
    for joint, name in (("hip", "hip_flexion"), ("knee", "knee_angle"), ("ankle", "ankle_angle")):
        curve, rom = gait["walk_normal"][joint], gait["walk_normal"]["range_of_motion_deg"][joint]
        raw = wave(curve["terms"])
        out[name] = np.radians(curve["mean"] + raw * rom / np.ptp(raw))
    for name, terms in gait["pelvis"].items():
        out[f"pelvis_{name}"] = wave(terms) * (1e-3 if name in ("tx", "ty", "tz") else np.pi / 180)
    return out


def reference_of(who: Body, study: dict, phantom: dict) -> Reference:
    """Gait of a body at the phantom's cadence, speed by the length of the legs."""
    speed = SPEED_OF_175 * who.height_m / 1.75
    settings = study["twin"]
    made = make_reference(
        measured_curves(phantom), STRIDE_S, speed, who, settings["human"], settings["reference"]
    )
    # the phantom keeps its cadence
    return with_speeds(made, who, settings["human"], settings["reference"], 0.0)


def trained(
    who: Body, seed: int, study: dict, phantom: dict, folder: Path, threads: int
) -> tuple[Policy, dict]:
    """Policy and how its training went; from the folder if it is there."""
    name = f"{who.height_m:.2f}-{seed}"
    policy, record = folder / f"{name}.npz", folder / f"{name}.json"
    parts = {part: study["twin"][part] for part in ("human", "reference", "training")}
    made_with = hashlib.sha256(json.dumps(parts, sort_keys=True).encode()).hexdigest()
    if not (policy.exists() and record.exists() and read_json(record).get("settings_sha256") == made_with):
        trainer = Trainer(who, reference_of(who, study, phantom), study["twin"], seed=seed, threads=threads)
        wall, cpu = time.monotonic(), time.process_time()
        ended = train(trainer, checkpoint=folder / f"{name}.checkpoint.npz", key=name + made_with)
        chosen_steps, best = trainer.chosen()
        save_policy(policy, best)
        write_json(
            record,
            {
                "settings_sha256": made_with,
                "ended": ended,
                "steps": trainer.steps,
                "policy_steps": chosen_steps,
                "wall_s": time.monotonic() - wall,
                "processor_s": time.process_time() - cpu,
                "bytes": policy.stat().st_size,
                "evaluations": plain(trainer.evaluations),
            },
        )
        (folder / f"{name}.checkpoint.npz").unlink(missing_ok=True)
    return load_policy(policy), read_json(record)


def free_walker(policy: Policy, seed: int, study: dict, threads: int) -> list[dict]:
    """Rows of bars of a free walker, as the workflow writes them."""
    found = examined(policy, study["twin"], threads)
    for p in found["pushes"][1:]:
        print(f"    (not a bar) {p['force_n']:g} N: {p['falls']} falls in {p['minutes']:.0f} minutes")
    largest = found["walk"]["floor_force_peak_bw"]["largest"]
    shown = "unknown, nobody walks" if largest is None else f"{largest:.2f} BW"
    print(f"    (not a bar) largest floor force of any stride {shown}")
    return bar_rows("", found | {"seed": seed, "phantom": True})


def interface(phantom: dict) -> tuple[RestPose, JointLimits]:
    """Rest pose and stops of the phantom's mean person."""
    person, stops = phantom["person"], np.array(phantom["stops"]["range"])
    # as recorded on the phantom: 33 mm below mid-ASIS
    rest = RestPose(
        rotation_xyz(np.radians([0.0, -person["rest_tilt_deg"], 0.0])),
        np.array([*person["rest_position_m"], -0.033]),
    )
    return rest, JointLimits(-stops, stops)


def coupled(policy: Policy, study: dict, phantom: dict, threads: int) -> list[dict]:
    """Figures of every condition of a coupled walk, with every robot."""
    twin, ingest = study["twin"], study["ingest"]
    c = twin["coupled"]
    rest, limits = interface(phantom)
    prior = read_prior(PUBLISHED / "table1_priors.csv")
    free = walk_free(policy, twin, c["main_cap"], threads)
    alone = adaptation.describe(adaptation.cycles_of(free.at(0), c["settle_s"]))
    height = height_walked(free, c["main_cap"], policy.body, rest)
    out = []
    for robot in walking_robots(
        twin, ROOT / "resources" / "robot" / "drba.xml", ROOT / twin["study_robot"]["model"]
    ):
        conditions = conditions_of(prior, None, c, robot, c["main_cap"])
        walk = CoupledWalk(
            policy,
            twin=twin,
            plant=study["plant"],
            robot=robot,
            rest=rest,
            limits=limits,
            conditions=conditions,
            walkers=c["walkers"],
            height_m=height,
            threads=threads,
        )
        recording = walk.run(c["walk_s"])
        for k, condition in enumerate(conditions):
            part = recording.of(np.arange(k * c["walkers"], (k + 1) * c["walkers"]))
            out.append({"robot": robot.name, **figures_of(part, condition, alone, c["settle_s"], ingest)})
    return out


def figures_of(part: Recording, condition: Condition, alone: dict, settle_s: float, ingest: dict) -> dict:
    """Figures of the walkers of one condition; ``alone`` are the joints of the free walk."""
    lasting = part.of(np.flatnonzero(part.alive))
    about = adaptation.describe(adaptation.cycles_of(lasting, settle_s))
    q = lasting.interface[:, lasting.time_s >= settle_s]
    rate = 1 / float(part.time_s[1] - part.time_s[0])
    return {
        "name": condition.name,
        "cap": condition.cap,
        "aware": condition.aware,
        "factors": dict(condition.factors),
        "survived": float(part.alive.mean()),
        "cycles": about["hip_flexion"]["cycles"],
        "gait": adaptation.gait_of(lasting, settle_s),
        "change": {
            j: about[j]["rom_deg"][0] - alone[j]["rom_deg"][0] if about[j]["cycles"] else None
            for j in SAGITTAL
        },
        "cloud": adaptation.cloud(q, rate, ingest["cutoff_hz"], ingest["filter_order"]),
    }


def _shown(slip: float | None) -> str:
    return "-" if slip is None else f"{slip:.3f}"


def show_coupled(rows: list[dict], main_cap: float) -> list[tuple[str, object, object, bool]]:
    """Print every condition; returns the bars: survival, sign at the hip, order of the clouds."""
    for r in rows:
        cloud, factor = r["cloud"], " ".join(f"{a} x{f:g}" for a, f in r["factors"].items())
        spread = (
            "sigma " + "/".join(f"{v:.1f}" for v in cloud["sigma_mm"]) + f" mm, gamma {cloud['gamma']:.3f}"
            if cloud["trials"]
            else "no walker lasted"
        )
        change = "/".join("-" if v is None else f"{v:+.1f}" for v in r["change"].values())
        gait = "no stride"
        if g := r["gait"]:
            gait = (
                f"{g['speed_m_per_s']:.3f} m/s, stride {g['stride_m']:.3f} m, {g['cadence_per_min']:.0f}/min, "
                f"slip {_shown(g['stance_slip_m_per_s'])} m/s"
            )
        print(
            f"    {r['robot']:9s} {'aware' if r['aware'] else 'fixed'} {r['name']:6s} cap {r['cap']:.2f} {factor:16s}"
            f" survived {100 * r['survived']:3.0f} %, {r['cycles']:3d} cycles, {gait},"
            f" change of RoM {change} deg, {spread}"
        )
    paper = read_paper(PUBLISHED / "table3_gait.csv", PUBLISHED / "table2_interface.csv")
    angles = [paper["angles"][joint] for joint in SAGITTAL]
    change = "/".join(f"{a['prior']['rom_deg'] - a['free']['rom_deg']:+.1f}" for a in angles)
    gamma = ", ".join(f"{name} {cloud['gamma']}" for name, cloud in paper["cloud"].items())
    print(f"    paper: prior {change} deg; gamma {gamma}")
    plain_rows = [r for r in rows if not r["factors"]]
    bars: list[tuple[str, object, object, bool]] = []
    for r in plain_rows:
        where = f"{r['robot']} {'aware' if r['aware'] else 'fixed'} {r['name']} cap {r['cap']:g}"
        bars.append((f"survived {where}", r["survived"], SURVIVAL, r["survived"] >= SURVIVAL))
        if g := r["gait"]:
            slip, off = g["stance_slip_m_per_s"], g["stride_speed_m_per_s"] / g["speed_m_per_s"] - 1
            bars.append((f"stance slip [m/s] {where}", slip, SLIP, slip is not None and slip <= SLIP))
            bars.append((f"stride x cadence against speed {where}", off, STRIDE_OFF, abs(off) <= STRIDE_OFF))
        if r["name"] == "prior" and r["cap"] <= 0.95:
            hip = r["change"]["hip_flexion"]
            bars.append((f"hip RoM change {where}", hip, 0, hip is not None and hip < 0))
    for robot, aware in dict.fromkeys((r["robot"], r["aware"]) for r in plain_rows):
        here = [r for r in plain_rows if (r["robot"], r["aware"], r["cap"]) == (robot, aware, main_cap)]
        area = {r["name"]: r["cloud"].get("ellipse", {}).get("area_mm2", np.nan) for r in here}
        ordered = bool(area["soft"] > area["prior"] > area["stiff"])
        text = " > ".join(f"{name} {value:.0f}" for name, value in area.items())
        bars.append(
            (f"{robot} {'aware' if aware else 'fixed'} 95 % ellipse [mm2] {text}", ordered, True, ordered)
        )
    return bars


def main() -> int:
    """Print every bar; 1 where one is missed."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--bodies", type=float, nargs="*", default=[1.75, 1.55, 1.90])
    parser.add_argument(
        "--seeds", type=int, nargs="*", help="of each body (default 1 2 3 of 1.75 m, 1 of the others)"
    )
    parser.add_argument("--folder", type=Path, default=ROOT / "results" / "benchmarks" / "twin")
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--quick", action="store_true")
    options = parser.parse_args()
    study = validated(read_yaml(ROOT / "config" / "config.yaml"), "config", Path("config/config.yaml"))
    phantom = validated(read_yaml(ROOT / "config" / "phantom.yaml"), "phantom", Path("config/phantom.yaml"))
    if options.quick:
        study["twin"]["training"]["steps"] = 60_000
        study["twin"]["evaluation"] |= {"push_minutes": 1, "push_n": [100]}
        study["twin"]["coupled"] |= {
            "walkers": 2,
            "walk_s": 6,
            "settle_s": 2,
            "sensitivity": [],
            "study_sensitivity": [],
        }
        options.folder = options.folder / "quick"
    missed = 0
    for height in options.bodies:
        who = BODIES[height]
        for seed in options.seeds or ([1, 2, 3] if height == 1.75 and not options.quick else [1]):
            policy, record = trained(who, seed, study, phantom, options.folder, options.threads)
            print(
                f"\n{who.height_m} m {who.mass_kg:g} kg {who.sex}, seed {seed}: {record['steps']} steps, ended: "
                f"{record['ended']}, {record['wall_s']:.0f} s, {record['processor_s']:.0f} s of processor "
                "(phantom's gait)"
            )
            bars = [
                ("training [s]", record["processor_s"], TIME_LIMIT_S, record["processor_s"] <= TIME_LIMIT_S),
                ("artifact [bytes]", record["bytes"], SIZE_LIMIT, record["bytes"] <= SIZE_LIMIT),
            ]
            bars += [
                (r["bar"], r["value"], r["limit"], r["met"])
                for r in free_walker(policy, seed, study, options.threads)
            ]
            bars += show_coupled(
                coupled(policy, study, phantom, options.threads), study["twin"]["coupled"]["main_cap"]
            )
            for name, value, limit, ok in bars:
                shown = f"{value:.3f}" if isinstance(value, float) else value
                print(f"  {'ok    ' if ok else 'MISSED'} {name}: {shown} (bar {limit})")
                missed += not ok
    print(f"\n{missed} bars missed")
    return int(missed > 0)


if __name__ == "__main__":
    sys.exit(main())
