"""The diagnosed model as MJCF: plain MuJoCo loads it, and it moves as the model that was diagnosed."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import mujoco
import numpy as np
import pytest
from real2sim.diagnosis.answer import describe_model
from real2sim.diagnosis.refit import Hypothesis
from real2sim.effects import catalogue
from real2sim.effects.base import CHAIN, NATIVE, NEUTRAL, PLANNED
from real2sim.effects.catalogue import Placed
from real2sim.effects.planned import DrivenForce
from real2sim.effects.replay import EffectReplay
from real2sim.errors import InputError
from real2sim.study import diagnosis_model
from real2sim.study.diagnosis_model import effects_of, export_model, measured_law
from real2sim.system.export import baked, to_mjcf

from tests.unit.simulated_effects import LEVEL, SCALES, STRAP, replay
from tests.unit.test_coupling import PRIOR, ROBOT

# Effects that the strap can have
EFFECTS = tuple(effect for effect in catalogue.EFFECTS if effect.places(STRAP))

LOOSE = replace(SCALES, q=SCALES.q / 5)  # whatever has a threshold is beyond it


def named(name: str, form: str = "", place: int = 0) -> Placed:
    effect = next(e for e in EFFECTS if (e.name, e.form) == (name, form))
    return Placed(effect, effect.places(STRAP)[place], LOOSE)


def acting(placed: list[Placed], **how) -> tuple[EffectReplay, np.ndarray]:
    model = replay(placed, **how)
    # away from zero where an effect starts at nothing
    x = [p.starts()[-1:] if p.starts()[-1:].any() else p.bounds()[1][None] / 10 for p in placed]
    paths, _ = model.run_effects(PRIOR[None], x)
    return model, paths[0]


def in_plain_mujoco(file: Path, control: np.ndarray) -> np.ndarray:
    """Interface sites (nstep, 2, 3) of a file, from its keyframe."""
    model = mujoco.MjModel.from_xml_path(str(file))
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, model.key("start").id)
    adr = model.sensor("position_interface_left").adr[0]
    out = np.empty((len(control), 6))
    for i, u in enumerate(control):
        data.ctrl[:] = u
        mujoco.mj_step(model, data)
        out[i] = data.sensordata[adr : adr + 6]
    return out.reshape(-1, 2, 3)


PLANT = [e for e in EFFECTS if e.plant is not NEUTRAL or e.exported == NATIVE]


@pytest.mark.parametrize("effect", PLANT, ids=lambda e: f"{e.name}{e.form}")
def test_the_file_moves_as_the_model_in_process(effect, tmp_path):
    model, paths = acting([named(effect.name, effect.form)])
    plain = replay([]).run_effects(PRIOR[None], [])[0][0]
    assert np.abs(paths - plain).max() > 1e-5
    simulated = model.as_simulated()
    file = tmp_path / "model.xml"
    file.write_text(
        to_mjcf(
            baked(model, simulated),
            simulated,
            ["-- header --"],
            {"note": "the person's < & \" strap"},
            {"k_tx": 1 / 3},
        )
    )
    alone = in_plain_mujoco(file, simulated.control)
    np.testing.assert_allclose(alone[:: model.stride], paths, rtol=0, atol=1e-6)
    np.testing.assert_array_equal(model.sites()[:: model.stride], paths)
    loaded = mujoco.MjModel.from_xml_path(str(file))
    assert loaded.numeric("k_tx").data[0] == 1 / 3
    assert loaded.ntext == 1
    assert bytes(loaded.text_data).rstrip(b"\0").decode() == "the person's < & \" strap"
    assert "include" not in file.read_text()


@pytest.mark.parametrize("name", ["relaxation", "slack", "tilt"])
def test_the_file_of_a_robot_that_had_come_to_rest_moves_as_the_model_in_process(name, tmp_path):
    off = np.eye(3), LEVEL[1] + np.array([0.004, -0.003, 0.002])
    model, paths = acting([named(name)], settled=True, seen=off)
    simulated = model.as_simulated()
    file = tmp_path / "model.xml"
    file.write_text(to_mjcf(baked(model, simulated), simulated, [], {}, {}))
    alone = in_plain_mujoco(file, simulated.control)
    np.testing.assert_allclose(alone[:: model.stride], paths, rtol=0, atol=1e-6)
    assert np.abs(paths[15] - paths[0]).max() < 1e-3


@pytest.mark.parametrize(
    "effect", [e for e in EFFECTS if e.chains.observation], ids=lambda e: f"{e.name}{e.form}"
)
def test_a_person_seen_elsewhere_starts_there_in_the_file(effect, tmp_path):
    model, _ = acting([named(effect.name, effect.form)])
    simulated = model.as_simulated()
    file = tmp_path / "model.xml"
    file.write_text(to_mjcf(baked(model, simulated), simulated, [], {}, {}))
    there = model.sites()
    assert np.isfinite(there).all()
    # what markers show beside the joint centres is no part of a model
    np.testing.assert_allclose(in_plain_mujoco(file, simulated.control), there, rtol=0, atol=1e-6)


def test_several_effects_at_half_the_step_survive_too(tmp_path):
    placed = [named("lugre"), named("relaxation", place=1), named("slack", place=2), named("base_compliance")]
    model, paths = acting(placed)
    simulated = model.as_simulated()
    file = tmp_path / "model.xml"
    file.write_text(to_mjcf(baked(model, simulated), simulated, [], {}, {}))
    np.testing.assert_allclose(
        in_plain_mujoco(file, simulated.control)[:: model.stride], paths, rtol=0, atol=1e-6
    )


@pytest.mark.parametrize("law", ["slack", "one_sided", "joint_limit", "relaxation"])
def test_a_strap_that_rests_elsewhere_is_exported_with_its_other_laws(law, tmp_path):
    model, paths = acting([named("preload"), named(law)])
    simulated = model.as_simulated()
    file = tmp_path / "model.xml"
    file.write_text(to_mjcf(baked(model, simulated), simulated, [], {}, {}))
    alone = in_plain_mujoco(file, simulated.control)
    np.testing.assert_allclose(alone[:: model.stride], paths, rtol=0, atol=1e-6)


def test_a_robot_with_shapes_needs_no_file_of_theirs(tmp_path, monkeypatch):
    own = tmp_path / "own.xml"
    text = ROBOT.read_text()
    inertial = '<inertial pos="0 0 0" mass="3" diaginertia="0.03 0.03 0.03"/>'
    assert inertial in text
    own.write_text(text.replace(inertial, '<geom type="box" size="0.05 0.2 0.05" mass="3"/>'))
    monkeypatch.setattr("tests.unit.simulated_effects.ROBOT", own)
    model, paths = acting([named("slack")])
    simulated = model.as_simulated()
    file = tmp_path / "model.xml"
    file.write_text(to_mjcf(baked(model, simulated), simulated, [], {}, {}))
    assert mujoco.MjModel.from_xml_path(str(file)).ngeom == 0
    alone = in_plain_mujoco(file, simulated.control)
    np.testing.assert_allclose(alone[:: model.stride], paths, rtol=0, atol=1e-6)


def test_a_field_without_an_element_is_an_error():
    model, _ = acting([named("slack")])
    simulated = model.as_simulated()
    simulated.model.dof_solref[0, 0] = 0.5
    with pytest.raises(ValueError, match="dof_solref"):
        baked(model, simulated)


def test_a_text_that_gives_another_model_is_an_error():
    model, _ = acting([named("slack")])
    simulated = model.as_simulated()
    spec = baked(model, simulated)
    spec.joint("base_x").stiffness = [151.0, 0, 0]
    with pytest.raises(ValueError, match="jnt_stiffness"):
        to_mjcf(spec, simulated, [], {}, {})


def test_what_is_no_model_says_what_to_do_instead():
    for effect in EFFECTS:
        assert (effect.exported == NATIVE) == (not effect.remedy)
        assert (effect.exported == PLANNED) == isinstance(effect.plant, DrivenForce)
        chains = effect.chains.input, effect.chains.output, effect.chains.log
        chains += (effect.chains.observation and effect.chains.observation.of_markers,)
        assert (effect.exported == CHAIN) == any(chains)


def test_a_measured_law_is_planned_forces_of_the_file(tmp_path):
    time_s = np.arange(200) * 0.01
    forces = [5 * np.sin(3 * time_s), 0.2 * np.cos(2 * time_s)]
    family = {
        "family": "spline",
        "stage": "interface",
        "kind": "elastic",
        "axes": ["ty"],
        "depends_on": ["q_ty"],
    }
    answer = {
        "verdict": "unknown",
        "free_form": {
            "stage": "interface",
            "families": [family],
            "model": {
                "joints": ["strap_ty", "strap_rz"],
                "time_s": time_s.tolist(),
                "forces": [f.tolist() for f in forces],
                "parameters": {},
            },
        },
    }
    law = measured_law(answer, STRAP, SCALES)
    model = replay([law])
    paths = model.run_effects(PRIOR[None], [np.empty((1, 0))])[0][0]
    plain = replay([]).run_effects(PRIOR[None], [])[0][0]
    assert np.abs(paths - plain).max() > 1e-5
    simulated = model.as_simulated()
    file = tmp_path / "model.xml"
    file.write_text(to_mjcf(baked(model, simulated), simulated, [], {}, {}))
    alone = in_plain_mujoco(file, simulated.control)
    np.testing.assert_allclose(alone[:: model.stride], paths, rtol=0, atol=1e-6)
    # nothing of the kind where something was named, where nothing was measured or where no force was
    assert measured_law(answer | {"verdict": "slack"}, STRAP, SCALES) is None
    assert measured_law(answer | {"free_form": None}, STRAP, SCALES) is None
    moved = answer | {"free_form": answer["free_form"] | {"model": None}}
    assert measured_law(moved, STRAP, SCALES) is None


def test_a_set_of_effects_is_read_as_it_was_written():
    placed = (
        named("joint_limit", place=3),
        named("cross_coupling", "_viscous", place=4),
        named("marker_drift", "left"),
    )
    z = np.concatenate([np.log(PRIOR), *(p.starts()[0] + 0.01 for p in placed)])
    written = json.loads(json.dumps(describe_model(Hypothesis(placed, z, (1.0, 1.0)), LOOSE)))
    again, x = effects_of(written, STRAP, Path("diagnosis.json"))
    assert [p.key for p in again] == [p.key for p in placed]
    for p, q, values in zip(placed, again, x, strict=True):
        assert p.effect is q.effect
        assert p.where == q.where
        np.testing.assert_array_equal(p.values(values[None]), q.values(values[None]))
    np.testing.assert_array_equal(np.concatenate(x), z[12:])


@pytest.mark.parametrize("fitted", ["dynamic_1", "dynamic_2"])
def test_the_model_is_of_the_fitted_trial_wherever_it_stands(fitted, monkeypatch, tmp_path):
    asked = []

    def evidence(answer, trial, neutral, limits, robot):
        asked.append(trial.name)
        return SimpleNamespace(
            setup=SimpleNamespace(system=STRAP), scales=SCALES, replay=lambda effects, nsim: replay(effects)
        )

    monkeypatch.setattr(diagnosis_model, "diagnosed_evidence", evidence)
    parameters = {
        p.name: {"fitted": float(v), "with_effect": float(v), "base": float(v), "unit": p.unit}
        for p, v in zip(STRAP.parameters, PRIOR, strict=True)
    }
    answer = {
        "subject": "S01",
        "phantom": True,
        "train": [fitted],
        "robot_holds": "start pose",
        "settings": {},
        "verdict": "none",
        "verdict_set": ["none"],
        "free_form": None,
        "parameters": parameters,
        "model": describe_model(Hypothesis((), np.log(PRIOR), (1.0, 1.0)), SCALES),
    }
    diagnosis, notes, out = (tmp_path / name for name in ("diagnosis.json", "model.json", "model.xml"))
    diagnosis.write_text(json.dumps(answer))
    given = {
        "diagnosis": diagnosis,
        "neutral": tmp_path / "neutral",
        "robot": ROBOT,
        "out": out,
        "notes": notes,
    }
    given |= {"replay": tmp_path / "model_replay.csv"}
    trials = [tmp_path / "dynamic_1", tmp_path / "dynamic_2"]
    export_model(**given, trials=trials)
    assert asked == [fitted]
    assert json.loads(notes.read_text())["trial"] == fitted
    assert f"trial {fitted}" in out.read_text()
    others = [trial for trial in trials if trial.name != fitted]
    with pytest.raises(InputError, match=f"found: +{fitted}\n +expected: {others[0].name}"):
        export_model(**given, trials=others)
