"""Diagnose an arm of two hinges with dry friction in the elbow."""

import json
import sys
from pathlib import Path

import mujoco
import numpy as np
import pandas as pd
import real2sim as r2s

# description begins
Path("arm.xml").write_text("""<mujoco>
  <option gravity="0 0 0"/>
  <worldbody>
    <body name="upper">
      <inertial pos="0.15 0 0" mass="2" diaginertia="0.02 0.02 0.02"/>
      <joint name="shoulder" axis="0 0 1"/>
      <body name="fore" pos="0.3 0 0">
        <inertial pos="0.12 0 0" mass="1.2" diaginertia="0.01 0.01 0.01"/>
        <joint name="elbow" axis="0 0 1"/>
      </body>
    </body>
  </worldbody>
</mujoco>""")
SYSTEM = r2s.System.from_dict(
    {
        "name": "two_hinges",
        "step_s": 0.001,
        "model": "arm.xml",
        "interface": {"axes": {"shoulder": {"type": "hinge"}, "elbow": {"type": "hinge"}}},
        "drive": {"by": "force", "of": {"shoulder": "shoulder_Nm", "elbow": "elbow_Nm"}},
        "outputs": {"shoulder_rad": {"joint": "shoulder"}, "elbow_rad": {"joint": "elbow"}},
        "parameters": {
            "k_shoulder": {"unit": "Nm/rad", "bounds": [2, 200], "sets": "stiffness", "of": "shoulder"},
            "d_shoulder": {"unit": "Nms/rad", "bounds": [0.05, 5], "sets": "damping", "of": "shoulder"},
            "k_elbow": {"unit": "Nm/rad", "bounds": [1, 100], "sets": "stiffness", "of": "elbow"},
            "d_elbow": {"unit": "Nms/rad", "bounds": [0.02, 2], "sets": "damping", "of": "elbow"},
        },
    }
)
# description ends

SETTINGS = {
    "diagnosis": {"search": {"refits": 6, "refits_close": 1, "iterations": 20, "pair_excess_sigma": 1e9}}
}
TRUE = {"shoulder": (20.0, 0.5), "elbow": (10.0, 0.2)}
DURATION_S, FINE_S, SAMPLE_S, NOISE_RAD = 6.0, 2e-4, 0.01, 2e-4


def record(name: str, amplitude: float, hz: tuple[float, ...], friction: float, seed: int) -> r2s.Recording:
    """Simulate the arm with plain MuJoCo: torques in, angles out, white noise on the angles."""
    spec = mujoco.MjSpec.from_file("arm.xml")
    spec.option.timestep, spec.option.integrator = FINE_S, mujoco.mjtIntegrator.mjINT_RK4
    for joint, (stiffness, damping) in TRUE.items():
        spec.joint(joint).stiffness, spec.joint(joint).damping = [stiffness, 0, 0], [damping, 0, 0]
        spec.add_actuator(name=joint, trntype=mujoco.mjtTrn.mjTRN_JOINT, target=joint).set_to_motor()
    elbow = spec.joint("elbow")
    elbow.frictionloss, elbow.solref_friction = friction, [2 * FINE_S, 1]  # as hard as dry friction
    elbow.solimp_friction = [0.9999, 0.9999, 0.001, 0.5, 2]
    model = spec.compile()
    data, rng = mujoco.MjData(model), np.random.default_rng(seed)
    phases, rows = rng.uniform(0, 2 * np.pi, (2, len(hz))), []

    def torque(t: float) -> np.ndarray:
        rise = np.sin(np.pi / 2 * np.clip((t - 0.5) / 0.5, 0, 1)) ** 2
        return rise * amplitude * np.sin(2 * np.pi * np.array(hz) * t + phases).sum(axis=1)

    for step in range(round(DURATION_S / FINE_S)):
        if step % round(SAMPLE_S / FINE_S) == 0:
            angles = data.qpos + NOISE_RAD * rng.standard_normal(2)
            rows.append((data.time, *torque(data.time), *angles))
        data.ctrl[:] = torque(data.time + FINE_S / 2)  # the mean over the step
        mujoco.mj_step(model, data)
    table = pd.DataFrame(rows, columns=["time_s", "shoulder_Nm", "elbow_Nm", "shoulder_rad", "elbow_rad"])
    return r2s.Recording.from_table(SYSTEM, table, name)


friction = 0.6
train = record("train", 1.0, (0.4, 0.7, 1.1), friction, 1)
held_out = record("held_out", 1.4, (0.5, 1.3), friction, 2)
quiet = record("quiet", 0.0, (1.0,), friction, 3)
answer = r2s.diagnose(SYSTEM, train=train, held_out=held_out, quiet=quiet, settings=SETTINGS)
json.dump([answer.verdict, answer.probabilities[answer.verdict]], sys.stdout)
