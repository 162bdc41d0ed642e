"""Simulations of described systems: rates, starts in motion, weight, and springs that rest elsewhere than at zero."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np
import pandas as pd
import pytest
import yaml
from real2sim import Recording, System
from real2sim.api import _free_joints
from real2sim.configuration import validated
from real2sim.diagnosis.described_trial import DescribedTrial
from real2sim.effects.base import Placed, Scales
from real2sim.effects.catalogue import EFFECTS
from real2sim.effects.system_replay import SystemReplay
from real2sim.errors import InputError
from real2sim.system.description import shipped

DESCRIBED = validated({}, "config", Path("defaults"))["diagnosis"]["described"]
TIME = np.arange(600) / 100
TURN = 2 * np.pi * 1.0
SLIDE = """<mujoco><option gravity="0 0 0"/><worldbody><body name="mass">
  <joint name="slide" type="slide" axis="1 0 0" {rest}/><inertial pos="0 0 0" mass="1" diaginertia="1 1 1"/>
</body></worldbody></mujoco>"""


def slide(folder: Path, *, quantity: str = "position", rest: float = 0.0, step_s: float = 0.004) -> System:
    """A mass on a spring and a damper, driven by a force."""
    (folder / "slide.xml").write_text(SLIDE.format(rest=f'springref="{rest}"'))
    about = {
        "name": "slide",
        "model": "slide.xml",
        "interface": {"axes": {"x": {"joint": "slide"}}},
        "drive": {"by": "force", "of": {"slide": "push_N"}},
        "outputs": {"seen": {"joint": "slide", "quantity": quantity}},
        "parameters": {
            "k": {"unit": "N/m", "bounds": [1e-6, 100.0], "sets": "stiffness", "of": "x"},
            "d": {"unit": "Ns/m", "bounds": [1e-6, 10.0], "sets": "damping", "of": "x"},
        },
        "step_s": step_s,
    }
    return System.from_dict(about, folder / "system.yaml")


def simulated(
    system: System, push: np.ndarray, parameters: list[float], start: tuple[float, float], effect: str = ""
) -> np.ndarray:
    """What the system shows (n,) from a ``start`` in place and rate, with an effect that does nothing."""
    table = pd.DataFrame({"time_s": TIME, "push_N": push, "seen": np.sin(TURN * TIME)})
    trial = DescribedTrial(system, Recording.from_table(system, table), None, DESCRIBED)
    setup = replace(trial.setup(1), start={"slide": start[0]}, start_rate={"slide": start[1]})
    one, motion = np.ones(1), np.zeros((len(TIME), 1))
    context = trial._context(trial._measured(), motion, motion)
    context = replace(context, step_time_s=TIME[0] + setup.timestep * np.arange(len(setup.commands)))
    scales = Scales(one, one, one, one, one)
    placed = [Placed(e, e.places(system)[0], scales) for e in EFFECTS if e.label == effect]
    replay = SystemReplay(setup, placed, context, scales, 1)
    out, _ = replay.run_effects(np.array([parameters]), [p.at_rest()[None] for p in placed])
    return out[0, :, 0]


@pytest.mark.parametrize("step_s", [0.01, 0.0025])
def test_a_rate_is_that_of_its_sample(tmp_path, step_s):
    push = 10 * np.sin(TURN * TIME)
    system = slide(tmp_path, quantity="velocity", step_s=step_s)
    seen = simulated(system, push, [1e-6, 1e-6], (0.0, 0.0))
    rate = 10 / TURN * (1 - np.cos(TURN * TIME))
    slope = push - push.mean()
    late_s = -np.sum((seen - rate) * slope) / np.sum(slope**2)
    assert abs(late_s) < 0.02 * step_s


def test_a_start_in_motion_under_force_is_that_rate_and_no_more(tmp_path):
    push = 10 * np.cos(TURN * TIME)
    seen = simulated(slide(tmp_path), push, [1e-6, 1e-6], (0.0, 0.5))
    true = 0.5 * TIME + 10 / TURN**2 * (1 - np.cos(TURN * TIME))
    # a rate of half a step later would be 0.12 m farther at the end
    assert np.abs(seen - true).max() < 1e-3


@pytest.mark.parametrize(
    "effect", ["slack", "slack soft", "asymmetric_stiffness", "one_sided", "joint_limit"]
)
def test_laws_of_an_axis_are_about_the_place_where_its_spring_rests(tmp_path, effect):
    push, parameters = 0.5 * np.sin(TURN * TIME), [40.0, 2.0]
    assert effect in {e.label for e in EFFECTS}
    plain = simulated(slide(tmp_path, rest=0.1), push, parameters, (0.1, 0.0))
    assert np.abs(plain - 0.1).max() < 0.1, "it moves about its rest"
    np.testing.assert_allclose(
        simulated(slide(tmp_path, rest=0.1), push, parameters, (0.1, 0.0), effect), plain, atol=1e-6
    )


def test_a_path_that_begins_in_motion_is_followed_from_its_first_sample(tmp_path):
    (tmp_path / "slide.xml").write_text(SLIDE.format(rest=""))
    about = {
        "name": "slide",
        "model": "slide.xml",
        "interface": {"axes": {"x": {"joint": "slide"}}},
        "drive": {"by": "path", "of": {"slide": "at_m"}},
        "outputs": {"push_N": {"joint": "slide", "quantity": "force"}},
        "parameters": {"d": {"unit": "Ns/m", "bounds": [0.1, 1000.0], "sets": "damping", "of": "x"}},
        "step_s": 0.002,
    }
    system, damping = System.from_dict(about, tmp_path / "system.yaml"), 400.0
    place, rate = 0.02 * np.sin(TURN * TIME), 0.02 * TURN * np.cos(TURN * TIME)
    force = damping * rate - TURN**2 * place  # of a mass of 1 kg
    table = pd.DataFrame({"time_s": TIME, "at_m": place, "push_N": force})
    evidence = DescribedTrial(system, Recording.from_table(system, table), None, DESCRIBED).evidence()
    paths, _ = evidence.replay((), 1).run_effects(np.array([[damping]]), [])
    assert np.abs(paths[0, :, 0] - force).max() < 0.01 * np.abs(force).max()


@pytest.mark.parametrize(("gravity", "offset_n"), [("0 0 0", 0.0), ("0 0 -9.81", 0.0), ("0 0 0", 5.0)])
def test_a_machine_that_has_come_to_rest_stays_there_under_weight_and_constant_forces(
    tmp_path, gravity, offset_n
):
    source = shipped("cuff")
    text = (source / "cuff.xml").read_text()
    assert 'gravity="0 0 0"' in text
    (tmp_path / "cuff.xml").write_text(text.replace('gravity="0 0 0"', f'gravity="{gravity}"'))
    about = yaml.safe_load((source / "system.yaml").read_text())
    about["parameters"]["push"] = {
        "unit": "N",
        "bounds": [-20, 20],
        "sets": "offset",
        "of": "tx",
        "log": False,
    }
    system = System.from_dict(about, tmp_path / "system.yaml")
    trial = DescribedTrial(system, _standing(system, 1), _standing(system, 2), DESCRIBED)
    setup, one = replace(trial.setup(1), settled=True), np.ones(len(system.axes))
    motion = np.zeros((len(TIME), len(one)))
    context = trial._context(trial._measured(), motion, motion)
    replay = SystemReplay(setup, (), context, Scales(one, one, one, one, one), 1)
    paths, _ = replay.run_effects(np.array([[2000, 1500, 10, 20, 20, 0.5, offset_n]]), [])
    assert np.abs(paths[0] - paths[0, 0]).max() < 2e-5  # m


def _standing(system: System, seed: int) -> Recording:
    """Six seconds of a cuff that stands still, with the noise of a camera."""
    model = mujoco.MjModel.from_xml_path(str(system.model))
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    cuff = data.body("cuff").xpos
    places = {
        f"THI_{m}": cuff + by
        for m, by in zip("ABC", ([0.08, 0, 0.1], [0.08, 0, -0.1], [0.02, -0.07, 0]), strict=True)
    }
    places |= {f"CUF_{m}": data.site(f"cuff_{m.lower()}").xpos for m in "ABC"}
    rng, table = np.random.default_rng(seed), {"time_s": TIME}
    for name, place in places.items():
        for axis, value in zip("xyz", place, strict=True):
            table[f"{name}_{axis}_m"] = value + 1e-4 * rng.standard_normal(len(TIME))
    for joint in system.machine:
        table[f"{joint.name}_{system.joint_units[joint.name]}"] = 1e-5 * rng.standard_normal(len(TIME))
    return Recording.from_table(system, pd.DataFrame(table))


def test_a_joint_that_nothing_holds_is_told_and_a_force_on_one_without_a_path_is_refused(tmp_path):
    system = slide(tmp_path)
    assert not list(_free_joints(system))
    text = (tmp_path / "slide.xml").read_text()
    (tmp_path / "slide.xml").write_text(
        text.replace("<inertial", '<joint name="wheel" axis="0 0 1"/><inertial')
    )
    (finding,) = _free_joints(system)
    assert (finding.code, finding.place) == ("model_joints", "joint wheel")
    with pytest.raises(InputError, match=r"(?s)system\.yaml.*outputs\.seen.*follows no path"):
        slide(tmp_path, quantity="force")
