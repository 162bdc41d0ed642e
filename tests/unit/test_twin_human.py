"""The skeletal model: masses, signs of the joints, a pose worked out by hand."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest
import yaml
from real2sim.recording.subjects import SYNTHETIC_NOTICE
from real2sim.study.twin.human import (
    COMMANDED,
    FREE_DOFS,
    JOINTS,
    MIRROR,
    MIRROR_SIGN,
    SPHERE_RADIUS,
    Body,
    add_floor,
    body_of,
    human_spec,
    qpos_of,
    twin_human,
)

from tests.unit.walking_person import twin_settings

PEOPLE = [Body(1.55, 50, "female"), Body(1.75, 75, "male"), Body(1.90, 110, "male")]


def _posed(who: Body, **degrees: float) -> tuple[mujoco.MjModel, mujoco.MjData]:
    model = human_spec(who, twin_settings()["human"]).compile()
    data = mujoco.MjData(model)
    data.qpos[:] = qpos_of({k: v if "_t" in k[-3:] else np.radians(v) for k, v in degrees.items()}, who)
    mujoco.mj_forward(model, data)
    return model, data


@pytest.mark.parametrize("who", PEOPLE, ids=lambda w: f"{w.height_m}m")
def test_model_has_the_degrees_of_freedom_and_mass_of_the_person(who):
    model, data = _posed(who)
    assert model.nv == FREE_DOFS == 27
    assert [model.joint(i).name for i in range(1, model.njnt)] == list(JOINTS)
    assert [model.actuator(i).name for i in range(model.nu)] == list(JOINTS)
    assert model.body_subtreemass[1] == pytest.approx(who.mass_kg, rel=1e-9)
    # centre of mass of standing people at 54-58 % of the height (Winter, section 4)
    assert 0.53 < data.subtree_com[1][2] / who.height_m < 0.58
    assert abs(data.subtree_com[1][1]) < 1e-9
    # inertia about the vertical and the lateral axis of standing adults: 0.7-2.5 and 6-18 kg m^2, by m h^2
    size = who.mass_kg * who.height_m**2
    inertia = np.zeros(3)
    for i in range(1, model.nbody):
        d = data.xipos[i] - data.subtree_com[1]
        r = data.ximat[i].reshape(3, 3)
        inertia += np.diag(r @ np.diag(model.body_inertia[i]) @ r.T) + model.body_mass[i] * (d @ d - d**2)
    assert 0.045 < inertia[1] / size < 0.07
    assert 0.003 < inertia[2] / size < 0.010


def test_soles_of_the_zero_pose_are_on_the_floor():
    for who in PEOPLE:
        model, data = _posed(who)
        for place in ("heel", "ball"):
            for side in "rl":
                assert data.site(f"{place}_{side}").xpos[2] == pytest.approx(0, abs=1e-9)
        lowest = min(data.geom_xpos[i][2] for i in range(model.ngeom) if model.geom_conaffinity[i])
        assert lowest == pytest.approx(SPHERE_RADIUS, abs=1e-9)


def test_a_pose_worked_out_by_hand():
    # hip 30 degrees of flexion, knee 60, ankle 10 of dorsiflexion: thigh 30 degrees forward of vertical, shank
    # 30 behind it, foot's toes 20 below horizontal
    who = PEOPLE[1]
    thigh, shank = 0.245 * 1.75, 0.246 * 1.75
    _, data = _posed(who, hip_flexion_r=30, knee_angle_r=60, ankle_angle_r=10)
    hip = data.body("thigh_r").xpos
    knee = hip + thigh * np.array([np.sin(np.pi / 6), 0, -np.cos(np.pi / 6)])
    ankle = knee + shank * np.array([-np.sin(np.pi / 6), 0, -np.cos(np.pi / 6)])
    np.testing.assert_allclose(data.body("shank_r").xpos, knee, atol=1e-12)
    np.testing.assert_allclose(data.body("foot_r").xpos, ankle, atol=1e-12)
    foot = data.body("foot_r").xmat.reshape(3, 3)[:, 0]
    np.testing.assert_allclose(foot, [np.cos(np.pi / 9), 0, -np.sin(np.pi / 9)], atol=1e-12)


@pytest.mark.parametrize(
    ("coordinate", "body", "direction"),
    [
        ("hip_flexion_r", "foot_r", [1, 0, 0]),  # forward
        ("hip_flexion_l", "foot_l", [1, 0, 0]),
        ("hip_adduction_r", "foot_r", [0, 1, 0]),  # right leg to the left
        ("hip_adduction_l", "foot_l", [0, -1, 0]),
        ("knee_angle_l", "foot_l", [-1, 0, 0]),  # shank backward
        ("lumbar_extension", "upper_arm_r", [-1, 0, 0]),  # trunk backward
        ("lumbar_bending", "upper_arm_r", [0, -1, 0]),  # trunk to the right
        ("arm_flex_l", "forearm_l", [1, 0, 0]),
    ],
)
def test_signs_of_rajagopal(coordinate, body, direction):
    who = PEOPLE[1]
    _, rest = _posed(who)
    _, moved = _posed(who, **{coordinate: 10})
    step = moved.body(body).xpos - rest.body(body).xpos
    assert step @ np.array(direction) > 0.75 * np.linalg.norm(step)
    assert np.linalg.norm(step) > 0.02


@pytest.mark.parametrize(
    ("coordinate", "axis", "sign"),
    [("hip_rotation_r", 1, 1), ("hip_rotation_l", 1, -1), ("ankle_angle_r", 2, 1)],
)
def test_toes_turn_inward_and_up(coordinate, axis, sign):
    _, moved = _posed(PEOPLE[1], **{coordinate: 10})
    toes = moved.body(f"foot_{coordinate[-1]}").xmat.reshape(3, 3)[:, 0]
    assert sign * toes[axis] > 0.15


def test_pelvis_angles_are_those_of_rajagopal():
    # +tilt: front up; +list: right side down; +rotation: turn to the left; z of OpenSim is the right
    def axes(name: str) -> np.ndarray:
        _, data = _posed(PEOPLE[1], **{name: 10})
        return data.body("pelvis").xmat.reshape(3, 3)

    assert axes("pelvis_tilt")[2, 0] > 0.1
    assert axes("pelvis_list")[2, 1] > 0.1
    assert axes("pelvis_rotation")[1, 0] > 0.1
    _, data = _posed(PEOPLE[1], pelvis_tz=0.2)
    assert data.body("pelvis").xpos[1] == pytest.approx(-0.2)


def test_the_mirror_image_of_a_pose():
    who, rng = PEOPLE[1], np.random.default_rng(1)
    model, data = _posed(who)
    low, high = model.jnt_range[1:, 0], model.jnt_range[1:, 1]
    angles = rng.uniform(0.3 * low, 0.3 * high)
    places = {}
    for name, q in (("own", angles), ("mirror", (angles * MIRROR_SIGN)[MIRROR])):
        data.qpos[7:] = q
        mujoco.mj_kinematics(model, data)
        places[name] = {model.body(i).name: data.xpos[i].copy() for i in range(1, model.nbody)}
    for name, place in places["own"].items():
        other = f"{name[:-1]}{'l' if name.endswith('r') else 'r'}" if name[-2:] in ("_r", "_l") else name
        np.testing.assert_allclose(places["mirror"][other], place * [1, -1, 1], atol=1e-12)
    assert list(COMMANDED) == list(JOINTS[:13])


def test_joint_ranges_are_radians():
    model, _ = _posed(PEOPLE[1])
    np.testing.assert_allclose(model.joint("knee_angle_r").range, [0, 2 * np.pi / 3])
    np.testing.assert_allclose(model.joint("hip_flexion_l").range, np.radians([-30, 120]))


def _drop_peak(contact: dict, step_s: float = 0.001) -> float:
    who = PEOPLE[1]
    settings = twin_settings()["human"] | {"contact": contact, "timestep_s": step_s}
    model = human_spec(who, settings).compile()
    data = mujoco.MjData(model)
    data.qpos[:] = qpos_of({}, who)
    data.qpos[2] += 0.02
    peak = 0.0
    for _ in range(round(0.4 / step_s)):
        mujoco.mj_step(model, data)
        peak = max(peak, data.qfrc_constraint[2] / who.weight)
    return peak


def test_soles_do_not_hit_like_stones():
    # stiff-legged from 2 cm, against MuJoCo's own contact
    soft = twin_settings()["human"]["contact"]
    stone = soft | {"solref": [0.02, 1.0], "solimp": [0.9, 0.95, 0.001, 0.5, 2.0]}
    assert _drop_peak(soft) < 0.75 * _drop_peak(stone)
    assert _drop_peak(soft) < 4.5
    # the step of the walkers exaggerates the hardest blow that a sole takes by less than a tenth
    assert _drop_peak(soft, twin_settings()["human"]["timestep_s"]) < 1.1 * _drop_peak(soft)


def test_mjcf_of_a_subject_file(tmp_path):
    person = tmp_path / "subject.yaml"
    person.write_text(yaml.safe_dump({"height_m": 1.7, "mass_kg": 66.0, "sex": "female", "phantom": True}))
    twin_human(person=person, settings=twin_settings(), out=tmp_path / "human.xml")
    model = mujoco.MjModel.from_xml_path(str(tmp_path / "human.xml"))
    assert model.nv == 27
    assert model.body_subtreemass[1] == pytest.approx(66.0, rel=1e-5)
    assert "phantom" in (tmp_path / "human.xml").read_text()


def test_whose_recordings_are_synthetic_is_a_phantom_whatever_subject_yaml_says(tmp_path):
    """A record of one's own beside the phantom's exports must not make measured people of them."""
    person = tmp_path / "subject.yaml"
    person.write_text(yaml.safe_dump({"height_m": 1.7, "mass_kg": 66.0, "sex": "female"}))
    (tmp_path / "walk_normal_1.tsv").write_text("NO_OF_FRAMES\t100\n")
    assert not body_of(person)[1]
    (tmp_path / "walk_normal_1.tsv").write_text(f"NO_OF_FRAMES\t100\nDESCRIPTION\t{SYNTHETIC_NOTICE}\n")
    assert body_of(person)[1]


def _creep(cone: mujoco.mjtCone | None = None) -> float:
    """Speed [m/s] of a sole that carries 15 kg and is pushed along the floor by 0.3 of that weight."""
    contact = twin_settings()["human"]["contact"]
    spec = mujoco.MjSpec()
    spec.option.timestep = 0.004
    add_floor(spec)
    if cone is not None:
        spec.option.cone = cone
    sole = spec.worldbody.add_body(name="sole", pos=[0, 0, SPHERE_RADIUS])
    for axis in ([1, 0, 0], [0, 0, 1]):
        sole.add_joint(type=mujoco.mjtJoint.mjJNT_SLIDE, axis=axis)
    friction = [contact["friction"], 0.005, 0.0001]
    soft = {"solref": contact["solref"], "solimp": contact["solimp"], "priority": 1}
    sole.add_geom(
        type=mujoco.mjtGeom.mjGEOM_SPHERE,
        size=[SPHERE_RADIUS, 0, 0],
        mass=15,
        contype=0,
        conaffinity=1,
        friction=friction,
        **soft,
    )
    model = spec.compile()
    data = mujoco.MjData(model)
    data.xfrc_applied[1, 0] = 0.3 * 15 * 9.81
    mujoco.mj_step(model, data, nstep=500)
    return float(data.qvel[0])


def test_a_sole_creeps_half_as_much_as_under_a_pyramid_of_friction():
    assert 0 < _creep() < 0.55 * _creep(mujoco.mjtCone.mjCONE_PYRAMIDAL)
