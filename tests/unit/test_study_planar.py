"""The study's robot as a strap feels it: resources/robot/study_planar.xml is the five-bar in its home position."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest
import yaml

from tests.unit.walking_person import ROOT

FIVE_BAR = ROOT / "resources" / "systems" / "drba" / "drba.xml"
PLANAR = ROOT / "resources" / "robot" / "study_planar.xml"
HINGES = [f"arm_{side}_{i}" for side in ("left", "right") for i in (1, 2, 3)]


def _middle(data: mujoco.MjData) -> np.ndarray:
    return np.asarray((data.site("interface_left").xpos + data.site("interface_right").xpos) / 2)


def _mass(model: mujoco.MjModel, data: mujoco.MjData, joints: list[str]) -> np.ndarray:
    mass = np.zeros((model.nv, model.nv))
    mujoco.mj_fullM(model, data, mass)
    dofs = [model.joint(j).dofadr[0] for j in joints]
    return mass[np.ix_(dofs, dofs)]


def _five_bar() -> tuple[np.ndarray, np.ndarray]:
    """Inertia and damping (3, 3) that x, y and yaw of the interface feel while the base is held."""
    model = mujoco.MjModel.from_xml_path(str(FIVE_BAR))
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    rates = np.zeros((6, 3))
    jac_p, jac_r = np.zeros((3, model.nv)), np.zeros((3, model.nv))
    for k, body in enumerate(("interface", "to_interface_right")):
        mujoco.mj_jac(model, data, jac_p, jac_r, _middle(data), model.body(body).id)
        dofs = [model.joint(j).dofadr[0] for j in HINGES[3 * k : 3 * k + 3]]
        rates[3 * k : 3 * k + 3] = np.linalg.inv(np.vstack([jac_p[:2], jac_r[2:]])[:, dofs])
    damping = np.diag([float(np.ravel(model.joint(j).damping)[0]) for j in HINGES])
    return rates.T @ _mass(model, data, HINGES) @ rates, rates.T @ damping @ rates


def test_inertia_and_damping_are_those_of_the_five_bar():
    inertia, damping = _five_bar()
    model = mujoco.MjModel.from_xml_path(str(PLANAR))
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    ours = _mass(model, data, ["base_x", "base_y", "base_yaw"])
    np.testing.assert_allclose(ours, inertia, rtol=0.01, atol=0.01)
    hold = yaml.safe_load((ROOT / "config" / "study-robot.yaml").read_text(encoding="utf-8"))["robot"]["hold"]
    assert [hold[a]["damping"] for a in ("x", "y", "yaw")] == pytest.approx(np.diag(damping), rel=0.01)


def test_a_strap_does_not_lift_or_tilt_it():
    arm = yaml.safe_load((ROOT / "config" / "study-robot.yaml").read_text(encoding="utf-8"))["robot"]["arm"]
    # 100 N and 10 Nm
    assert 100 / arm["lift"]["stiffness"] <= 1e-4
    assert 10 / arm["roll"]["stiffness"] <= 1e-4
    assert 10 / arm["pitch"]["stiffness"] <= 1e-4
