"""Systems that somebody else describes: forces along a path, models with drives of their own, and what is refused."""

from __future__ import annotations

from dataclasses import replace

import mujoco
import numpy as np
import pandas as pd
import pytest
import real2sim as r2s
from real2sim.diagnosis.described_trial import DescribedTrial
from real2sim.errors import InputError
from real2sim.system.description import System
from real2sim.system.lone_joint import lone_joint

from tests.unit.test_coupling import CONFIG

DESCRIBED = CONFIG["diagnosis"]["described"]
T = np.arange(1200) / 200


def path():
    """Position, rate and acceleration (n,) of a path of three sinusoids below 2 Hz."""
    w, phase = 2 * np.pi * np.array([0.31, 0.83, 1.7]), np.array([0.3, 1.0, 2.2])
    arc = np.outer(T, w) + phase
    return tuple(0.1 * (w**k * np.sin(arc + k * np.pi / 2)).sum(axis=1) for k in range(3))


def system(folder, joint, *, by, parameters=None, **changed):
    """Describe one joint whose MJCF is ``joint``, driven by path or force."""
    (folder / "own.xml").write_text(joint, encoding="utf-8")
    hinge = 'type="hinge"' in joint
    unit, force = ("rad", "Nm") if hinge else ("m", "N")
    moved, pushed = f"swing_{unit}", f"push_{force}"
    content = {
        "name": "own",
        "model": "own.xml",
        "step_s": 0.001,
        "interface": {"axes": {"swing": {"type": "hinge" if hinge else "slide"}}},
        "drive": {"by": by, "of": {"swing": moved if by == "path" else pushed}},
        "outputs": {pushed: {"joint": "swing", "quantity": "force"}}
        if by == "path"
        else {moved: {"joint": "swing"}},
        "parameters": parameters
        or {
            "k": {"unit": f"{force}/{unit}", "bounds": [2, 200], "sets": "stiffness", "of": "swing"},
            "d": {"unit": f"{force}s/{unit}", "bounds": [0.05, 10], "sets": "damping", "of": "swing"},
        },
    }
    return System.from_dict(content | changed, folder / "own.yaml")


def recording(own, force, position, seed=1, noise=(1e-5, 0.02)):
    rng = np.random.default_rng(seed)
    moved, pushed = (
        next(c for c in (*own.drive.columns.values(), own.outputs[0].column) if c[:4] == k)
        for k in ("swin", "push")
    )
    table = {
        "time_s": T,
        moved: position + noise[0] * rng.standard_normal(len(T)),
        pushed: force + noise[1] * rng.standard_normal(len(T)),
    }
    return r2s.Recording.from_table(own, pd.DataFrame(table), f"trial {seed}")


PENDULUM = """<mujoco><worldbody><body name="arm" pos="0 0 1"><joint name="swing" type="hinge" axis="0 1 0"
  armature="0.05"/><inertial pos="0 0 -0.3" mass="1.5" diaginertia="0.02 0.03 0.01"/><body name="hand" pos="0 0 -0.6">
  <inertial pos="0 0 0" mass="0.4" diaginertia="0.001 0.001 0.001"/></body></body></worldbody></mujoco>"""


def test_torque_of_a_pendulum_along_its_path_has_all_its_inertia_and_weight(tmp_path):
    own = system(tmp_path, PENDULUM, by="path")
    q, v, a = path()
    # two weights, the lower one welded on, and a rotor; by the laws of a pendulum
    inertia = 0.05 + 0.03 + 1.5 * 0.3**2 + 0.001 + 0.4 * 0.6**2
    weight = 9.81 * (1.5 * 0.3 + 0.4 * 0.6) * np.sin(q)
    torque = inertia * a + 0.6 * v + 20 * q + weight
    fit = r2s.identify(own, recording(own, torque, q, noise=(0.0, 0.02)))
    assert fit.values["k"] == pytest.approx(20, rel=0.01)
    assert fit.values["d"] == pytest.approx(0.6, rel=0.01)
    assert fit.chi2 < 1.5 * fit.samples


def test_noise_of_a_path_is_seen_in_the_force_by_the_inertia_that_it_shakes(tmp_path):
    slide = """<mujoco><option gravity="0 0 0"/><worldbody><body name="cart"><joint name="swing" type="slide"
      axis="1 0 0"/><inertial pos="0 0 0" mass="{}" diaginertia="1 1 1"/></body></worldbody></mujoco>"""
    left = {}
    for mass in (0.01, 10.0):
        own = system(tmp_path, slide.format(mass), by="path")
        q, v, a = path()
        given = recording(own, mass * a + 0.6 * v + 20 * q, q)
        trial = DescribedTrial(own, given, None, DESCRIBED)
        (_, one), (_, other) = trial.draw(1, 0, 1), trial.draw(1, 1, 1)
        assert one.shape == (len(T), 1)
        draws = trial.evidence().with_noise(np.array([20.0, 0.6]), 15, 1).noise
        left[mass] = draws[:, 100:-100, 0].std()
        # the acceleration of white noise of the path below 10 Hz: its spectrum grows as the square of the frequency
        expected = 1e-5 * np.sqrt(2 * 10 / 200) * (2 * np.pi * 10) ** 2 / np.sqrt(5)
        assert (other - one)[100:-100].std() / np.sqrt(2) == pytest.approx(expected, rel=0.3)
    assert left[0.01] == pytest.approx(0.02, rel=0.1)
    assert left[10.0] > 2 * left[0.01]


def test_inertia_along_a_lone_joint_is_that_of_mujoco(tmp_path):
    text = """<mujoco><worldbody><body name="a" pos="1 0 0" euler="10 20 30"><joint name="swing" type="{}"
      axis="0.3 1 -0.2" pos="0.1 0 0.2" armature="0.07"/><inertial pos="0.2 0.1 0" mass="2" diaginertia="0.1 0.2 0.25"/>
      <body name="b" pos="0 0.5 0" euler="40 0 70"><inertial pos="0 0 0.3" mass="1" diaginertia="0.3 0.1 0.25"/></body>
      </body><body name="c"><joint name="other"/><geom size="0.1"/></body></worldbody></mujoco>"""
    for kind in ("hinge", "slide"):
        model = mujoco.MjModel.from_xml_string(text.format(kind))
        data = mujoco.MjData(model)
        mujoco.mj_forward(model, data)
        whole = np.zeros((model.nv, model.nv))
        mujoco.mj_fullM(model, data, whole)
        joint = lone_joint(model, "swing", 0.07, tmp_path / "a.xml")
        found = joint.inertia(model.body_mass[None], model.body_inertia[None])
        assert found == pytest.approx([whole[0, 0]], rel=1e-9)


@pytest.mark.parametrize(("joint", "told"), [("name='wrist'", "wrist"), ("", "joint number 2")])
def test_a_force_along_a_chain_of_joints_is_refused(tmp_path, joint, told):
    hand = '<body name="hand" pos="0 0 -0.6">'
    own = system(tmp_path, PENDULUM.replace(hand, f"{hand}<joint {joint}/>"), by="path")
    q, _, _ = path()
    with pytest.raises(InputError, match=f"{told} on the same chain"):
        r2s.identify(own, recording(own, q, q))


def test_what_moves_elsewhere_is_no_part_of_a_force(tmp_path):
    """A loose ball in the same model, whose joint has no name."""
    ball = '<body pos="3 0 0"><freejoint/><geom size="0.1"/></body></worldbody>'
    own = system(tmp_path, PENDULUM.replace("</worldbody>", ball), by="path")
    q, v, a = path()
    inertia = 0.05 + 0.03 + 1.5 * 0.3**2 + 0.001 + 0.4 * 0.6**2
    torque = inertia * a + 0.6 * v + 20 * q + 9.81 * (1.5 * 0.3 + 0.4 * 0.6) * np.sin(q)
    fit = r2s.identify(own, recording(own, torque, q, noise=(0.0, 0.02)))
    assert fit.values["k"] == pytest.approx(20, rel=0.01)


FORCED = """<mujoco><worldbody><body name="arm"><joint name="swing" type="hinge" axis="0 0 1"/><inertial pos="0 0 0"
  mass="1" diaginertia="0.02 0.02 0.02"/></body></worldbody>{}</mujoco>"""
DRIVES = """<actuator><position name="servo" joint="swing" kp="500"/><motor name="geared" joint="swing" gear="50"/>
  </actuator><sensor><jointpos joint="swing"/><actuatorfrc actuator="servo"/></sensor>
  <keyframe><key ctrl="1 1"/></keyframe>"""


def swing(own):
    """A hinge of I = 0.02, k = 20, d = 0.6 under a torque that starts from rest, by a fine integration."""
    torque = np.where(T > 1, 2 * np.sin(2 * np.pi * 0.7 * (T - 1)) + np.sin(2 * np.pi * 1.9 * (T - 1)), 0.0)
    fine, q, v, out = 20, 0.0, 0.0, []
    for i in range(len(T)):
        out.append(q)
        for j in range(fine):
            now = torque[i] + (torque[min(i + 1, len(T) - 1)] - torque[i]) * j / fine
            v += (now - 20 * q - 0.6 * v) / 0.02 * 0.005 / fine
            q += v * 0.005 / fine
    return recording(own, torque, np.array(out), noise=(2e-4, 0.0))


def test_drives_of_the_model_are_left_out_and_said(tmp_path):
    own = system(tmp_path, FORCED.format(DRIVES), by="force")
    fit = r2s.identify(own, swing(own))
    assert fit.values["k"] == pytest.approx(20, rel=0.02)
    first, *rows = str(fit).split("\n")
    assert first.startswith(f"{own.name}, fitted to {fit.recording}, left: ")
    assert [row.split()[0] for row in rows] == ["k", "d"]
    assert all(row.endswith("determined") for row in rows)
    assert fit.values["d"] == pytest.approx(0.6, rel=0.02)
    assert [(f.code, f.place) for f in fit.findings] == [("model_actuators", "actuator servo, geared")]


def k_of(**changed):
    return {"unit": "Nm/rad", "bounds": [2, 200], "sets": "stiffness", "of": "swing"} | changed


@pytest.mark.parametrize(
    ("changed", "told"),
    [
        ({"interface": {"axes": {"swing": {}}}}, "a hinge, and type: slide in the description"),
        ({"interface": {"axes": {"swing": {"type": "hinge"}}, "rest": "quiet"}}, "a drive by force"),
        ({"parameters": {"k": k_of(), "k2": k_of()}}, "a second parameter that sets the stiffness of swing"),
        ({"parameters": {"m": k_of(sets="mass", of="foot")}}, "no body foot"),
        ({"parameters": {"k": k_of(unit="Nmm/deg")}}, "Nm/rad, the unit of the stiffness of swing"),
        ({"parameters": {"d": k_of(sets="damping")}}, "Nms/rad, the unit of the damping of swing"),
        ({"parameters": {"k": k_of(bounds=[2, "1e1"])}}, "YAML reads 1e1 as text"),
        ({"parameters": {"k": k_of(bounds=[2])}}, "docs/library.md has the keys"),
        ({"parameters": {"k": k_of(bounds=[2, "200"])}}, "Write it without quotes."),
        ({"outputs": {}}, "nothing that is measured"),
    ],
)
def test_descriptions_that_contradict_their_model_are_refused(tmp_path, changed, told):
    def described():
        own = system(tmp_path, FORCED.format(""), by="force", **changed)
        columns = {"time_s": T, "push_Nm": T, "swing_rad": T}
        DescribedTrial(own, r2s.Recording.from_table(own, pd.DataFrame(columns)), None, DESCRIBED)

    with pytest.raises(InputError) as refused:
        described()
    assert told in str(refused.value)


@pytest.mark.parametrize(
    ("change", "code", "told"),
    [
        (
            lambda t: t.assign(push_Nm=t.push_Nm.where((t.time_s < 2) | (t.time_s > 2.3))),
            "drive_gap",
            "from 2 s",
        ),
        (lambda t: t[:50], "too_short", "50 samples (0.25 s)"),
        (lambda t: t[:7], "too_short", "7 samples"),
        (lambda t: t[::-1], "time_order", "times that increase"),
        (lambda t: t.assign(time_s=t.time_s.where(t.time_s != 3)), "time_uneven", "1 of them without a time"),
    ],
)
def test_recordings_that_cannot_drive_a_system_are_refused(tmp_path, change, code, told):
    own = system(tmp_path, FORCED.format(""), by="force")
    table = pd.DataFrame({"time_s": T, "push_Nm": np.sin(T), "swing_rad": np.sin(T)})
    with pytest.raises(InputError) as refused:
        DescribedTrial(own, r2s.Recording.from_table(own, change(table)), None, DESCRIBED).evidence()
    assert refused.value.code == code
    assert told in str(refused.value)


def test_short_gaps_of_a_drive_are_bridged(tmp_path):
    own = system(tmp_path, FORCED.format(""), by="force")
    table = pd.DataFrame({"time_s": T, "push_Nm": np.sin(T), "swing_rad": np.sin(T)})
    table.loc[500:508, "push_Nm"] = np.nan
    DescribedTrial(own, r2s.Recording.from_table(own, table), None, DESCRIBED)


@pytest.mark.parametrize(
    "settings", [{"plant": {"timestep_s": 0.001}}, {"ingest": {}, "diagnosis": {}}, {"odd": 1}]
)
def test_slices_of_the_configuration_that_a_call_does_not_read_are_refused(tmp_path, settings):
    own = system(tmp_path, FORCED.format(""), by="force")
    given = swing(own)
    for call in (
        lambda: r2s.identify(own, given, settings=settings),
        lambda: r2s.diagnose(own, train=given, held_out=given, settings=settings),
    ):
        with pytest.raises(InputError) as refused:
            call()
        assert refused.value.code == "key_unknown"
        assert f"'{next(iter(settings))}'" in str(refused.value)
        assert "diagnosis and identifiability" in str(refused.value)


def test_a_recording_of_another_system_is_refused_by_its_columns(tmp_path):
    own = system(tmp_path, FORCED.format(""), by="force")
    given = swing(own)
    slide = FORCED.format("").replace('type="hinge"', 'type="slide"')
    other = system(tmp_path, slide, by="force")
    with pytest.raises(InputError, match="column push_N, swing_m"):
        r2s.identify(other, given)


def test_a_recording_of_which_next_to_nothing_is_known_is_refused(tmp_path):
    own = system(tmp_path, FORCED.format(""), by="force")
    whole = swing(own)
    known = np.where(np.arange(len(T)) < 12, whole.columns["swing_rad"], np.nan)
    given = replace(whole, columns={**whole.columns, "swing_rad": known})
    with pytest.raises(InputError, match="no residual is left"):
        r2s.identify(own, given)
