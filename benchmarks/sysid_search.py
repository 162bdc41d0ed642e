"""One trial, model and residual in `mujoco.sysid` and in this project; engine.py runs it in an environment of its own.

    python sysid_search.py trial.pickle report.json

Needs numpy, scipy and mujoco[sysid]; one thread each.
"""

from __future__ import annotations

import json
import pickle
import sys
import time
from pathlib import Path
from types import SimpleNamespace

import mujoco
import numpy as np
from mujoco import sysid
from real2sim.inference import least_squares
from real2sim.inference.cost import CostScales, TrialCost
from real2sim.inference.parameters import PARAMETERS, Bounds
from real2sim.system.plant import STRAP_JOINTS, JointLimits, RestPose
from real2sim.system.replay import Replay
from welded import WeldedReplay

BATCH = 13


def setter(joint: str, kind: str, armature: float | None, timestep: float):
    """Write one ln-parameter into the plant as its replay does; ``armature`` None for a plant without centred steps."""

    def write(spec: mujoco.MjSpec, parameter: sysid.Parameter) -> None:
        value = float(np.exp(parameter.value[0]))
        if kind == "k":
            spec.joint(joint).stiffness = [value, 0, 0]
        else:
            spec.joint(joint).damping = [value, 0, 0]
            if armature is not None:
                spec.joint(joint).armature = armature - value * timestep / 2

    return write


def sysid_problem(replay: Replay | WeldedReplay, cost: TrialCost, bounds: Bounds, start: np.ndarray):
    """Parameters and residual function of `mujoco.sysid` for a trial in one of the plants."""
    model, h = replay.model, replay.model.opt.timestep
    parameters = sysid.ParameterDict()
    for i, name in enumerate(PARAMETERS):
        joint = STRAP_JOINTS[i % 6]
        armature = None
        if isinstance(replay, Replay):
            armature = float(model.dof_armature[model.joint(joint).dofadr[0]])
        parameters.add(
            sysid.Parameter(
                name,
                np.log(start[i]),
                np.log(bounds.lower[i]),
                np.log(bounds.upper[i]),
                modifier=setter(joint, name[0], armature, h),
            )
        )
    times = h * np.arange(replay.nstep + 1)
    # it leaves the last control out
    control = np.vstack([replay._control[0], replay._control[0, -1:]])
    mapping = sysid.TimeSeries.compute_all_sensor_mapping(model)
    sequences = sysid.ModelSequences(
        "plant",
        replay.spec,
        "trial",
        sysid.create_initial_state(model, *replay._start_state),
        sysid.TimeSeries(times, control),
        sysid.TimeSeries(times, np.zeros((len(times), model.nsensordata)), mapping),
    )

    def residual(params, predicted, measured, model, return_pred_all, **_):
        sites = predicted.data[:: replay.stride, :6].reshape(1, -1, 2, 3)
        # what comes third is only compared with the second by name
        return cost.residuals(sites)[0], predicted, predicted

    function = sysid.build_residual_fn(
        models_sequences=[sequences], modify_residual=residual, n_threads=1, resample_true=False
    )
    return parameters, function


def rate(function, points: np.ndarray, repeats: int) -> float:
    """Evaluations per second, the best of some repeats."""
    best = 0.0
    for _ in range(repeats):
        start = time.perf_counter()
        function(points)
        best = max(best, len(points) / (time.perf_counter() - start))
    return best


def welded(
    content: dict, given: dict, cost: TrialCost, bounds: Bounds, points: np.ndarray, own: float
) -> dict:
    """Evaluations per second of `mujoco.sysid` in the welded plant, at the largest step that is as exact or at 2 ms."""
    step = content["welded_step_s"]
    plant = given["plant_settings"] | {"timestep_s": step}
    fine = Replay(**given | {"plant_settings": plant, "nsim": 1})
    trial = SimpleNamespace(
        time_s=given["time_s"],
        pelvis_rotation=given["pelvis_rotation"],
        pelvis_position=given["pelvis_position"],
        rest=given["rest"],
    )
    replay = WeldedReplay(
        SimpleNamespace(trial=trial, limits=given["limits"]),
        fine,
        given["robot"],
        {"robot": given["robot_settings"], "plant": plant},
        nsim=1,
        solref_s=2 * step,
    )
    parameters, function = sysid_problem(replay, cost, bounds, np.exp(points[0]))
    speed = rate(lambda z: function(z.T, parameters.copy()), points, 3)
    return {"timestep_s": step, "evaluations_per_s": speed, "ratio": own / speed}


def main() -> None:
    source, out = map(Path, sys.argv[1:])
    content = pickle.loads(source.read_bytes())
    given = content["replay"] | {
        "robot": Path(content["replay"]["robot"]),
        "rest": RestPose(*content["replay"]["rest"]),
        "limits": JointLimits(*content["replay"]["limits"]),
        "nsim": BATCH,
    }
    replay = Replay(**given)
    cost = TrialCost(
        content["measured"], content["rate_hz"], CostScales(*content["scales"]), content["usable"]
    )
    bounds = Bounds(*content["bounds"])

    def own(parameters: np.ndarray) -> np.ndarray:
        return cost.residuals(replay.run(parameters))

    rng = np.random.default_rng(1)
    points = np.array([bounds.log_uniform(rng) for _ in range(BATCH)])
    start = np.exp(points[int(np.argmin(np.sum(own(np.exp(points)) ** 2, axis=1)))])
    parameters, function = sysid_problem(replay, cost, bounds, start)
    done = 0

    def counted(x: np.ndarray, params, **options):
        nonlocal done
        done += 1 if x.ndim == 1 else x.shape[1]
        return function(x, params, **options)

    theirs = np.asarray(function(points.T, parameters.copy())[0][0]).reshape(-1, BATCH).T
    difference = np.abs(theirs - own(np.exp(points))).max(axis=1)
    rates = {"own": 0.0, "sysid": 0.0}
    for _ in range(3):
        # in turns: the machine may be shared
        rates["own"] = max(rates["own"], rate(lambda z: own(np.exp(z)), points, 3))
        rates["sysid"] = max(rates["sysid"], rate(lambda z: function(z.T, parameters.copy()), points, 3))

    began = time.perf_counter()
    found, _ = sysid.optimize(parameters, counted, optimizer="mujoco", verbose=False, max_iters=25)
    seconds = time.perf_counter() - began
    best = np.exp(found.as_vector())
    problem = least_squares.Residuals(own, bounds, BATCH)
    began = time.perf_counter()
    options = content["least_squares"]
    _, own_cost, _, _ = least_squares.minimise(
        problem, np.log(start), np.arange(12), iterations=options["iterations"], ftol=options["ftol"]
    )
    own_seconds = time.perf_counter() - began
    report = {
        "welded": welded(content, given, cost, bounds, points[:3], rates["own"]),
        "differences_of_residuals": sorted(difference.tolist()),
        "evaluations_per_s": rates,
        "ratio": rates["own"] / rates["sysid"],
        "search": {
            "own": {"J": own_cost, "evaluations": problem.evaluations, "seconds": own_seconds},
            "sysid": {"J": float(np.sum(own(best[None])[0] ** 2)), "evaluations": done, "seconds": seconds},
        },
    }
    out.write_text(json.dumps(report, indent=1) + "\n")


if __name__ == "__main__":
    main()
