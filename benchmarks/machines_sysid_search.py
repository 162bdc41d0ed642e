"""Fit one measured machine by `mujoco.sysid`; machines_sysid.py runs it in an environment of its own.

    python machines_sysid_search.py task.pickle report.json

Needs numpy, scipy and mujoco[sysid]; one thread.
"""

from __future__ import annotations

import json
import pickle
import sys
import time
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from mujoco import sysid

DRIVE = "drive"
# Time constant of dry friction [s]
HARD_S = 1e-4


def writer(parameter: dict[str, Any], joint: str):
    """Return what writes one parameter into the model's description; ``log`` ones are searched as logarithms."""

    def write(spec: mujoco.MjSpec, searched: sysid.Parameter) -> None:
        value = float(searched.value[0])
        value = float(np.exp(value)) if parameter["log"] else value
        axis, kind = spec.joint(joint), parameter["sets"]
        if kind == "mass":
            spec.body(parameter["of"]).mass = value
        elif kind == "damping":
            axis.damping = [value, 0, 0]
        elif kind == "stiffness":
            axis.stiffness = [value, *axis.stiffness[1:]]
        elif kind == "cubic":
            axis.stiffness = [axis.stiffness[0], 0, value]
        elif kind == "frictionloss":
            axis.frictionloss = value
            # as hard as steps allow: with its default softness friction creeps like a damper
            axis.solref_friction, axis.solimp_friction = [HARD_S, 1], [0.999, 0.999, 0.001, 0.5, 2]
        elif kind == "offset":
            spec.actuator(DRIVE).biasprm = [value] + [0] * 9
        else:
            raise ValueError(f"{kind}: no such field")

    return write


def parameters_of(task: dict[str, Any]) -> sysid.ParameterDict:
    """Return the searched parameters, each starting in the middle of its bounds as a diagnosis' plain fit does."""
    out = sysid.ParameterDict()
    for p in task["parameters"]:
        low, high = np.log(p["bounds"]) if p["log"] else p["bounds"]
        out.add(sysid.Parameter(p["name"], (low + high) / 2, low, high, modifier=writer(p, task["joint"])))
    return out


def described(task: dict[str, Any], step_s: float) -> mujoco.MjSpec:
    """Return the machine's MJCF with a motor on its joint, whose bias is the constant force, and its sensor."""
    spec = mujoco.MjSpec.from_file(task["model"])
    spec.option.timestep = step_s
    spec.add_actuator(
        name=DRIVE,
        trntype=mujoco.mjtTrn.mjTRN_JOINT,
        target=task["joint"],
        gainprm=[1] + [0] * 9,
        biastype=mujoco.mjtBias.mjBIAS_AFFINE,
    )
    spec.add_sensor(
        name="position",
        type=mujoco.mjtSensor.mjSENS_JOINTPOS,
        objtype=mujoco.mjtObj.mjOBJ_JOINT,
        objname=task["joint"],
    )
    return spec


def along_path(record: dict[str, Any]):
    """Return a rollout that gives the force which the measured path takes, sample by sample."""

    def force(model: mujoco.MjModel) -> np.ndarray:
        data, out = mujoco.MjData(model), np.empty(len(record["time_s"]))
        for i, (q, v, a) in enumerate(
            zip(record["position"], record["rate"], record["acceleration"], strict=True)
        ):
            data.qpos[0], data.qvel[0], data.qacc[0] = q, v, a
            mujoco.mj_inverse(model, data)
            out[i] = data.qfrc_inverse[0] - model.actuator_biasprm[0, 0]
        return out

    def rollout(models, initial_states, control_signal, rollout_signal_mapping, **_):
        times = record["time_s"]
        return [
            sysid.SystemTrajectory(
                model,
                control,
                sysid.TimeSeries(times, force(model)[:, None], rollout_signal_mapping),
                start,
                # its rows begin with the time
                sysid.TimeSeries(times, np.column_stack([times, np.zeros((len(times), 2))])),
            )
            for model, control, start in zip(models, control_signal, initial_states, strict=True)
        ]

    return rollout


def residual_of(task: dict[str, Any], record: dict[str, Any]):
    """Return the function that gives simulated minus measured output of a record, over the output's SD."""
    driven = record["force"] is not None
    spec = described(task, record["step_s"] if driven else HARD_S)
    model = spec.compile()
    steps = len(record["force"]) if driven else len(record["time_s"])
    step_s = record["step_s"] if driven else record["time_s"][1] - record["time_s"][0]
    # the last control is left out
    control = np.append(record["force"], record["force"][-1])[:, None] if driven else np.zeros((steps, 1))
    times = step_s * np.arange(len(control))
    start = [np.array([record["start"][i]]) for i in (0, 1)]
    sequences = sysid.ModelSequences(
        task["name"],
        spec,
        "record",
        sysid.create_initial_state(model, *start),
        sysid.TimeSeries(times, control),
        sysid.TimeSeries(
            times, np.zeros((len(times), 1)), sysid.TimeSeries.compute_all_sensor_mapping(model)
        ),
    )
    measured = record["output"]

    def compare(params, predicted, told, model, return_pred_all, **_):
        stride = record["stride"] if driven else 1
        seen = predicted.data[::stride, 0][: len(measured)]
        # what comes third is only compared with the second by name
        return (seen - measured) / measured.std(), predicted, predicted

    extra = {} if driven else {"custom_rollout": along_path(record)}
    return sysid.build_residual_fn(
        models_sequences=[sequences], modify_residual=compare, n_threads=1, resample_true=False, **extra
    )


def main() -> None:
    source, out = map(Path, sys.argv[1:])
    task = pickle.loads(source.read_bytes())
    parameters = parameters_of(task)
    train, held_out = (residual_of(task, record) for record in task["records"])
    began = time.perf_counter()
    found, _ = sysid.optimize(parameters, train, optimizer="mujoco", verbose=False, max_iters=100)
    seconds = time.perf_counter() - began
    left = np.asarray(held_out(found.as_vector(), found)[0][0]).ravel()
    names = [p["name"] for p in task["parameters"]]
    values = [
        float(np.exp(x)) if p["log"] else float(x)
        for p, x in zip(task["parameters"], found.as_vector(), strict=True)
    ]
    report = {
        "values": dict(zip(names, values, strict=True)),
        "seconds": seconds,
        "held_out_rms": float(np.sqrt(np.mean(left**2)) * task["records"][1]["output"].std()),
    }
    out.write_text(json.dumps(report, indent=1) + "\n")


if __name__ == "__main__":
    main()
