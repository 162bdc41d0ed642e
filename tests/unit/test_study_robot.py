"""The study's robot in a coupled walk: each fact of resources/systems/drba that the walk rests on."""

from __future__ import annotations

from pathlib import Path

import mujoco
import numpy as np
import pytest
from real2sim.configuration import validated
from real2sim.errors import InputError
from real2sim.geometry import rotation_xyz
from real2sim.study.twin.coupled import standing_interface
from real2sim.study.twin.study_robot import StudyRobot, wheel_speeds
from real2sim.system.batches import untimed_batch
from real2sim.system.plant import STRAP_JOINTS, RestPose

from tests.unit.walking_person import ROOT, WHO

MODEL = ROOT / "resources" / "systems" / "drba" / "drba.xml"
STUDY = validated({}, "config", Path("config"))
LAW = STUDY["twin"]["study_robot"]
REST = RestPose(rotation_xyz(np.radians([1.0, -9.0, 0.5])), np.array([-0.075, 0.004, -0.032]))
STAND = standing_interface(WHO, REST)
TIMESTEP = 0.004


class Alone:
    """Robots without a person: the body behind the strap weighs nothing."""

    def __init__(self, cap: np.ndarray, strap: float = 0.0):
        self.robot = StudyRobot(MODEL, LAW)
        spec = self.robot.describe({**STUDY["plant"], "timestep_s": TIMESTEP}, REST, None, STAND)
        pelvis = spec.body("pelvis")
        pelvis.mass, pelvis.inertia, pelvis.ipos = 1e-3, [1e-6] * 3, [0, 0, 0]
        spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
        spec.option.disableflags |= mujoco.mjtDisableBit.mjDSBL_GRAVITY
        for name in STRAP_JOINTS:
            spec.joint(name).stiffness = [10.0, 0, 0]
            spec.joint(name).damping = [1.0, 0, 0]
        self.model = spec.compile()
        self.batch = untimed_batch(self.model, len(cap), 1)
        self.robot.bind(self.model, self.batch, cap)
        self.robot.start(0.0)
        self.places = np.array([self.model.joint(j).qposadr[0] for j in self.robot.joints])
        self.batch.bind("qpos")[:, self.places] = self.robot.standing()

    def data(self, row: int = 0) -> mujoco.MjData:
        data = mujoco.MjData(self.model)
        data.qpos[:] = self.batch.bind("qpos")[row]
        mujoco.mj_forward(self.model, data)
        return data

    def interface(self, row: int = 0) -> np.ndarray:
        data = self.data(row)
        return np.asarray((data.site("interface_left").xpos + data.site("interface_right").xpos) / 2)

    def steps(
        self, commands: np.ndarray, seconds: float, force: np.ndarray | None = None, body: str = "base"
    ):
        """Run with constant commands (n, 3) and a wrench (6,) on a body."""
        count = round(seconds / TIMESTEP)
        if force is not None:
            self.batch.bind("xfrc_applied")[:, self.model.body(body).id] = force
        control = np.zeros((len(commands), self.model.nu))
        control[:, [self.model.actuator(n).id for n in self.robot.commands]] = commands
        self.batch.rollout(count, np.repeat(control[:, None], count, axis=1))


def test_masses_track_and_wheels_are_the_sources():
    alone = Alone(np.ones(1))
    strapped = 1e-3
    assert alone.model.body_subtreemass[alone.model.body("base").id] - strapped == pytest.approx(
        151.96, abs=0.01
    )
    assert alone.robot.track == pytest.approx(0.628)
    assert alone.robot.radius == pytest.approx(0.16)


@pytest.mark.parametrize("cap", [0.2, 0.5, 0.85, 0.99])
def test_the_arm_starts_where_the_law_asks_for_the_cap(cap):
    alone = Alone(np.array([cap]))
    np.testing.assert_allclose(alone.interface(), STAND[1], atol=1e-9)
    distance, bearing, yaw = alone.robot.interface(alone.robot.standing()[:, 3:6])
    assert (bearing[0], yaw[0]) == pytest.approx((0, 0), abs=1e-9)
    assert 3.54 * (distance[0] - 0.22) == pytest.approx(cap, abs=2e-3)
    # both chains end on the interface: the loop is closed
    assert np.abs(alone.data().efc_pos[:6]).max() < 1e-9


def test_nobody_starts_beyond_the_reach_of_the_arm():
    alone = Alone(np.array([1.3]))
    distance, *_ = alone.robot.interface(alone.robot.standing()[:, 3:6])
    assert distance[0] == pytest.approx(LAW["reach_m"])
    links = [np.linalg.norm(link) for link in alone.robot._links["left"][:2]]
    assert links == pytest.approx([0.250, 0.263], abs=1e-4)
    # reach with the hinges 0.0205 m inside the interface's own: sqrt(0.513^2 - 0.0205^2)
    assert LAW["reach_m"] < np.sqrt(sum(links) ** 2 - 0.0205**2) == pytest.approx(0.5126, abs=1e-3)


def test_the_interface_is_free_in_the_plane_and_rigid_out_of_it():
    alone = Alone(np.array([0.5]))
    data = alone.data()
    jac_p, jac_r = np.zeros((3, alone.model.nv)), np.zeros((3, alone.model.nv))
    mujoco.mj_jacBody(alone.model, data, jac_p, jac_r, alone.model.body("interface").id)
    hinges = [alone.model.joint(f"arm_left_{i}").dofadr[0] for i in (1, 2, 3)]
    arm = np.vstack([jac_p, jac_r])[:, hinges]
    assert np.linalg.matrix_rank(arm[[0, 1, 5]], tol=1e-6) == 3
    assert np.abs(arm[[2, 3, 4]]).max() < 1e-12


def test_the_base_drives_and_turns_but_hardly_slides():
    alone = Alone(np.array([0.5]))
    alone.steps(np.zeros((1, 3)), 1.0, np.array([0, 100.0, 0, 0, 0, 0]))
    base = alone.batch.bind("qpos")[0, alone.places[:3]]
    # the tyres creep by 1 mm/s under 100 N
    assert abs(base[1] - STAND[1][1]) < 2e-3
    driven = Alone(np.array([0.5]))
    driven.steps(np.array([[0.5, 0.5, 0.0]]), 2.0)
    assert driven.batch.bind("qvel")[0, 0] == pytest.approx(0.5, rel=0.02)
    turned = Alone(np.array([0.5]))
    turned.steps(np.array([[-0.1, 0.1, 0.0]]), 2.0)
    rate = turned.batch.bind("qvel")[0, 2]
    assert rate == pytest.approx(0.2 / 0.628, rel=0.05)


def test_a_base_that_has_turned_drives_along_its_own_heading():
    alone = Alone(np.array([0.5]))
    alone.batch.bind("qpos")[:, alone.places[2]] = 0.5
    before = alone.batch.bind("qpos")[0, alone.places[:2]].copy()
    alone.steps(np.array([[0.4, 0.4, 0.0]]), 2.0)
    way = alone.batch.bind("qpos")[0, alone.places[:2]] - before
    heading = alone.batch.bind("qpos")[0, alone.places[2]]
    assert np.arctan2(way[1], way[0]) == pytest.approx(0.5, abs=0.1)
    assert abs(heading - 0.5) < 0.1


def test_speed_against_distance_is_the_laws():
    distance = np.array([0.1, 0.22, 0.34, 0.46, 0.5])
    none, cap = np.zeros(5), np.full(5, 0.85)
    speeds = wheel_speeds(distance, none, none, cap, LAW, 0.628)
    np.testing.assert_allclose(speeds[:, 0], [0, 0, 0.425, 0.85, 0.85], atol=1e-9)
    np.testing.assert_allclose(speeds[:, 0], speeds[:, 1])
    # below 12 degrees it goes straight
    bent = wheel_speeds(distance, none + np.radians(11.9), none, cap, LAW, 0.628)
    np.testing.assert_allclose(bent, speeds)


def test_it_turns_to_where_the_interface_is_and_faces():
    one, none = np.array([0.35]), np.zeros(1)
    cap = np.array([0.85])
    left, right = wheel_speeds(one, none + np.radians(30), none, cap, LAW, 0.628)[0]
    a = np.radians(30)
    arc = 0.35 * a / np.sin(a)
    v = 0.85 / 0.24 * (arc - 0.22)
    assert (left + right) / 2 == pytest.approx(v)
    assert right - left == pytest.approx(2 * 0.31 * v * 2 * np.sin(a) / 0.35 * 0.314)
    straight = 0.85 / 0.24 * (0.35 - 0.22)
    for degrees, share in ((1.9, 0), (21, 0.5), (40, 1), (60, 1), (-40, -1)):
        left, right = wheel_speeds(one, none, none + np.radians(degrees), cap, LAW, 0.628)[0]
        assert (left + right) / 2 == pytest.approx(straight)
        assert (right - left) / 2 == pytest.approx(0.7 * 0.4 * share, abs=1e-9)


def test_the_closed_loop_settles_at_the_speed_of_its_distance():
    # a hand holds the interface 0.34 m ahead of the arm base, wherever that is: 0.425 m/s
    alone = Alone(np.array([0.85]))
    robot, model = alone.robot, alone.model
    distance = 0.34
    arm = np.hstack([robot._bend(side, np.array([distance])) for side in ("left", "right")])
    for _ in range(80):
        alone.batch.bind("qpos")[:, alone.places[3:]] = arm
        alone.batch.forward()
        command = robot.command(None, 6 * TIMESTEP)
        alone.steps(command, 6 * TIMESTEP)
    assert alone.batch.bind("qvel")[0, 0] == pytest.approx(0.425, rel=0.03)
    assert model.nu == 3


def test_every_constant_can_be_multiplied():
    alone = Alone(np.full(2, 0.6))
    mass, friction = alone.batch.expand("body_mass").copy(), alone.batch.expand("dof_frictionloss").copy()
    for constant in alone.robot.constants:
        alone.robot.multiply(slice(1, 2), constant, 3.0)
    changed = alone.batch.expand("body_mass") / np.where(mass == 0, 1, mass)
    link = alone.model.body("fore_left").id
    assert changed[1, link] == 3
    assert changed[0, link] == 1
    hinge = alone.model.joint("arm_left_1").dofadr[0]
    assert alone.batch.expand("dof_frictionloss")[1, hinge] == 3 * friction[1, hinge]
    # a steeper law asks for the same speed at a shorter distance
    distance, *_ = alone.robot.interface(alone.robot.standing()[:, 3:6])
    assert distance[0] - 0.22 == pytest.approx(3 * (distance[1] - 0.22))


def test_another_model_is_refused(tmp_path):
    path = tmp_path / "other.xml"
    path.write_text(
        "<mujoco><worldbody><body name='base'>"
        "<inertial pos='0 0 0' mass='1' diaginertia='1 1 1'/>"
        "</body></worldbody></mujoco>"
    )
    with pytest.raises(InputError, match="no body"):
        StudyRobot(path, LAW).describe(STUDY["plant"], REST, None, STAND)
