"""Skeletal model of a person with 27 degrees of freedom, from height, mass and sex.

Lengths are fractions of the height by Drillis & Contini (1966, as tabulated by Winter, Biomechanics and Motor Control
of Human Movement, table 4.1); masses, centres of mass and radii of gyration are those of de Leva, J Biomech 29 (1996)
1223, tables 4, for women and men; the hip joint centres lie as in the model of Rajagopal et al., IEEE Trans Biomed Eng
63 (2016) 2068. Joints carry Rajagopal's coordinate names and signs. The foot is rigid: its spheres stand for heel pad,
metatarsal heads and toes, with contact as soft as a shoe.

World: x forward, y left, z up. Zero pose: standing upright, arms hanging, palms in.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import mujoco
import numpy as np

from real2sim.configuration import read_yaml
from real2sim.files import write_text
from real2sim.recording.subjects import holds_synthetic

if TYPE_CHECKING:
    from real2sim.settings import TwinHumanContactSettings, TwinHumanSettings, TwinSettings

# Order of the 21 joints after the root, which is the order of `qpos[7:]` and `qvel[6:]` of the free person
JOINTS = (
    *(f"{name}_r" for name in ("hip_flexion", "hip_adduction", "hip_rotation", "knee_angle", "ankle_angle")),
    *(f"{name}_l" for name in ("hip_flexion", "hip_adduction", "hip_rotation", "knee_angle", "ankle_angle")),
    *("lumbar_extension", "lumbar_bending", "lumbar_rotation"),
    *(f"{name}_r" for name in ("arm_flex", "arm_add", "arm_rot", "elbow_flex")),
    *(f"{name}_l" for name in ("arm_flex", "arm_add", "arm_rot", "elbow_flex")),
)
# Legs and trunk: what a policy commands; the arms follow the reference
COMMANDED = JOINTS[:13]
# The same person seen in a mirror: where each joint's value goes, and the joints whose sign changes
MIRROR = np.array([*range(5, 10), *range(5), 10, 11, 12, *range(17, 21), *range(13, 17)])
MIRROR_SIGN = np.array([-1.0 if n in ("lumbar_bending", "lumbar_rotation") else 1.0 for n in JOINTS])

# Fractions of the height (Drillis & Contini)
LENGTHS = {
    "thigh": 0.245,
    "shank": 0.246,
    "ankle_height": 0.039,
    "foot": 0.152,
    "trunk": 0.288,
    "upper_arm": 0.186,
    "forearm": 0.146,
    "hand": 0.108,
    "shoulder_half_width": 0.129,
    "head": 0.130,
}
# de Leva: mass fraction, centre of mass from the proximal end and radii of gyration about the sagittal (x), transverse
# (y) and longitudinal (z) axis, as fractions of the segment's length
SEGMENTS = {
    "male": {
        "head": (0.0694, 0.5976, (0.362, 0.376, 0.312)),
        "trunk": (0.4346, 0.4486, (0.372, 0.347, 0.191)),
        "lower_trunk": (0.1117, 0.6115, (0.615, 0.551, 0.587)),
        "upper_arm": (0.0271, 0.5772, (0.285, 0.269, 0.158)),
        "forearm": (0.0162, 0.4574, (0.276, 0.265, 0.121)),
        "hand": (0.0061, 0.7900, (0.628, 0.513, 0.401)),
        "thigh": (0.1416, 0.4095, (0.329, 0.329, 0.149)),
        "shank": (0.0433, 0.4395, (0.251, 0.246, 0.102)),
        "foot": (0.0137, 0.4415, (0.257, 0.245, 0.124)),
    },
    "female": {
        "head": (0.0668, 0.5894, (0.330, 0.359, 0.318)),
        "trunk": (0.4257, 0.4151, (0.357, 0.339, 0.171)),
        "lower_trunk": (0.1247, 0.4920, (0.433, 0.402, 0.444)),
        "upper_arm": (0.0255, 0.5754, (0.278, 0.260, 0.148)),
        "forearm": (0.0138, 0.4559, (0.261, 0.257, 0.094)),
        "hand": (0.0056, 0.7474, (0.531, 0.454, 0.335)),
        "thigh": (0.1478, 0.3612, (0.369, 0.364, 0.162)),
        "shank": (0.0481, 0.4352, (0.267, 0.263, 0.092)),
        "foot": (0.0129, 0.4014, (0.299, 0.279, 0.139)),
    },
}
# Lower trunk (navel to hips) as a part of the trunk (de Leva, table 4: 145.7 of 531.9 mm, 181.5 of 529.3 mm)
LOWER_TRUNK_SHARE = {"male": 0.274, "female": 0.343}
# The rounded fractions of a whole person, which add up to 1 within 0.0002
_WHOLE = {
    sex: sum(
        (1 if name in ("head", "trunk") else 2) * v[0] for name, v in table.items() if name != "lower_trunk"
    )
    for sex, table in SEGMENTS.items()
}
# Rajagopal: mid-ASIS from mid-hip (forward, up) and half the distance of the hips, of a man of 1.70 m [m]
_HIP_TO_ASIS = np.array([0.0563 + 0.0095, 0.0, 0.0785 + 0.0181]) / 1.70
_HIP_HALF_WIDTH = 0.0773 / 1.70

# Ranges of Rajagopal's model (legs) and assumed ones [degrees]
RANGES = {
    "hip_flexion": (-30, 120),
    "hip_adduction": (-50, 30),
    "hip_rotation": (-40, 40),
    "knee_angle": (0, 120),
    "ankle_angle": (-40, 30),
    "lumbar_extension": (-60, 30),
    "lumbar_bending": (-30, 30),
    "lumbar_rotation": (-40, 40),
    "arm_flex": (-60, 120),
    "arm_add": (-100, 20),
    "arm_rot": (-60, 60),
    "elbow_flex": (0, 140),
}
# Position gain and torque limit of a person of 75 kg and 1.75 m [Nm/rad, Nm]; both grow with mass times height
GAINS = {
    "hip_flexion": (400, 200),
    "hip_adduction": (350, 180),
    "hip_rotation": (120, 80),
    "knee_angle": (400, 220),
    "ankle_angle": (350, 220),
    "lumbar_extension": (500, 200),
    "lumbar_bending": (500, 200),
    "lumbar_rotation": (250, 120),
    "arm_flex": (60, 60),
    "arm_add": (60, 60),
    "arm_rot": (30, 30),
    "elbow_flex": (40, 40),
}
_REFERENCE_SIZE = 75.0 * 1.75
_VELOCITY_GAIN_S = 1 / 25  # velocity gain per position gain

SPHERE_RADIUS = 0.022
# Contact spheres of a foot: name, place between heel (0) and toes (1), half width [m], height above the sole [m]
SPHERES = (("heel", 0.083, 0.020, 0.0), ("ball", 0.70, 0.032, 0.0), ("toe", 0.90, 0.022, 0.010))
ANKLE_FROM_HEEL = 0.25  # of the foot's length
FEET = ("r", "l")
FREE_DOFS = 27


@dataclass(frozen=True)
class Body:
    """Person who is modelled: height [m], mass [kg], sex (``male`` or ``female``)."""

    height_m: float
    mass_kg: float
    sex: str

    @property
    def strength(self) -> float:
        """Factor on gains and torque limits."""
        return self.mass_kg * self.height_m / _REFERENCE_SIZE

    @property
    def weight(self) -> float:
        """Weight [N]."""
        return self.mass_kg * 9.81

    def length(self, segment: str) -> float:
        """Length of a segment [m]."""
        return LENGTHS[segment] * self.height_m

    @property
    def mid_asis(self) -> np.ndarray:
        """Mid-ASIS in the pelvis body's frame (3,) [m], whose origin is the middle of the hips."""
        return _HIP_TO_ASIS * self.height_m

    @property
    def hip_height(self) -> float:
        """Height of the hips above the floor in the zero pose [m]."""
        return self.length("thigh") + self.length("shank") + self.length("ankle_height")


@dataclass(frozen=True)
class _Inertia:
    mass: float
    com: np.ndarray
    inertia: np.ndarray  # (3,) about the centre of mass


def _inertia(body: Body, segment: str, length: float, start: np.ndarray, along: np.ndarray) -> _Inertia:
    """Of one segment whose proximal end is at ``start`` and which extends ``along`` a unit axis."""
    fraction, com, gyration = SEGMENTS[body.sex][segment]
    x, y, z = (length * np.array(gyration)) ** 2
    # a foot's longitudinal axis is the model's x
    moments = np.array([z, y, x]) if abs(along[0]) > 0.5 else np.array([x, y, z])
    mass = fraction / _WHOLE[body.sex] * body.mass_kg
    return _Inertia(mass, start + com * length * along, mass * moments)


def _combined(parts: list[tuple[float, _Inertia]]) -> _Inertia:
    """Sum of parts with signs (+1, -1); off-diagonal terms vanish because all lie on one vertical line."""
    mass = sum(sign * p.mass for sign, p in parts)
    com = sum((sign * p.mass * p.com for sign, p in parts), np.zeros(3)) / mass
    total = np.zeros(3)
    for sign, p in parts:
        d = p.com - com
        total += sign * (p.inertia + p.mass * (d @ d - d**2))
    return _Inertia(mass, com, total)


def _set(body: mujoco.MjsBody, part: _Inertia) -> None:
    body.mass, body.ipos, body.inertia, body.explicitinertial = part.mass, part.com, part.inertia, True


_AXES = {
    "hip_flexion": (0, -1, 0),
    "hip_adduction": (1, 0, 0),
    "hip_rotation": (0, 0, 1),
    "knee_angle": (0, 1, 0),
    "ankle_angle": (0, -1, 0),
    "lumbar_extension": (0, -1, 0),
    "lumbar_bending": (1, 0, 0),
    "lumbar_rotation": (0, 0, 1),
    "arm_flex": (0, -1, 0),
    "arm_add": (1, 0, 0),
    "arm_rot": (0, 0, 1),
    "elbow_flex": (0, -1, 0),
}


def base_name(joint: str) -> str:
    """Name of a joint without its side."""
    return joint[:-2] if joint[-2:] in ("_r", "_l") else joint


def _add_joints(body: mujoco.MjsBody, names: list[str], degrees: bool, side: str = "") -> None:
    for name in names:
        axis = np.array(_AXES[name], float)
        if side == "l":
            axis *= [-1, 1, -1]  # adduction and inward rotation are mirrored
        low, high = RANGES[name] if degrees else np.radians(RANGES[name])
        body.add_joint(
            name=f"{name}_{side}" if side else name,
            type=mujoco.mjtJoint.mjJNT_HINGE,
            axis=axis,
            range=[low, high],
            limited=mujoco.mjtLimited.mjLIMITED_TRUE,
            armature=0.02,
            damping=[0.5, 0, 0],
        )


_DOWN, _UP, _FORWARD = np.array([0.0, 0, -1]), np.array([0.0, 0, 1]), np.array([1.0, 0, 0])
_SKIN = [0.80, 0.66, 0.56, 1.0]
_CLOTH = [0.30, 0.42, 0.60, 1.0]


def _capsule(
    body: mujoco.MjsBody, start: Iterable[float], end: Iterable[float], radius: float, rgba: list[float]
) -> None:
    body.add_geom(
        type=mujoco.mjtGeom.mjGEOM_CAPSULE,
        fromto=[*start, *end],
        size=[radius, 0, 0],
        contype=0,
        conaffinity=0,
        mass=0,
        rgba=rgba,
    )


def _leg(
    pelvis: mujoco.MjsBody, who: Body, side: str, contact: TwinHumanContactSettings, degrees: bool
) -> None:
    sign = -1 if side == "r" else 1
    h = who.height_m
    thigh = pelvis.add_body(name=f"thigh_{side}", pos=[0, sign * _HIP_HALF_WIDTH * h, 0])
    _add_joints(thigh, ["hip_flexion", "hip_adduction", "hip_rotation"], degrees, side)
    _set(thigh, _inertia(who, "thigh", who.length("thigh"), np.zeros(3), _DOWN))
    _capsule(thigh, (0, 0, 0), (0, 0, -who.length("thigh")), 0.04 * h, _CLOTH)
    shank = thigh.add_body(name=f"shank_{side}", pos=[0, 0, -who.length("thigh")])
    _add_joints(shank, ["knee_angle"], degrees, side)
    _set(shank, _inertia(who, "shank", who.length("shank"), np.zeros(3), _DOWN))
    _capsule(shank, (0, 0, 0), (0, 0, -who.length("shank")), 0.028 * h, _CLOTH)
    foot = shank.add_body(name=f"foot_{side}", pos=[0, 0, -who.length("shank")])
    _add_joints(foot, ["ankle_angle"], degrees, side)
    length, sole = who.length("foot"), -who.length("ankle_height")
    heel = np.array([-ANKLE_FROM_HEEL * length, 0, sole / 2])
    _set(foot, _inertia(who, "foot", length, heel, _FORWARD))
    _capsule(
        foot, heel + np.array([0.03, 0, -0.005]), heel + np.array([length - 0.03, 0, -0.012]), 0.02, _SKIN
    )
    for name, place, half_width, raised in SPHERES:
        x, z = (place - ANKLE_FROM_HEEL) * length, sole + raised
        foot.add_site(name=f"{name}_{side}", pos=[x, 0, z], size=[0.005])
        for k in (-1, 1):
            foot.add_geom(
                name=f"{name}_{side}_{'out' if k == sign else 'in'}",
                type=mujoco.mjtGeom.mjGEOM_SPHERE,
                size=[SPHERE_RADIUS, 0, 0],
                pos=[x, k * half_width, z + SPHERE_RADIUS],
                contype=0,
                conaffinity=1,
                mass=0,
                rgba=_SKIN,
                friction=[contact["friction"], 0.005, 0.0001],
                solref=contact["solref"],
                solimp=contact["solimp"],
                priority=1,
            )


def _arm(torso: mujoco.MjsBody, who: Body, side: str, shoulder: float, degrees: bool) -> None:
    sign = -1 if side == "r" else 1
    upper = torso.add_body(
        name=f"upper_arm_{side}", pos=[0, sign * who.length("shoulder_half_width"), shoulder]
    )
    _add_joints(upper, ["arm_flex", "arm_add", "arm_rot"], degrees, side)
    _set(upper, _inertia(who, "upper_arm", who.length("upper_arm"), np.zeros(3), _DOWN))
    _capsule(upper, (0, 0, 0), (0, 0, -who.length("upper_arm")), 0.024 * who.height_m, _CLOTH)
    lower = upper.add_body(name=f"forearm_{side}", pos=[0, 0, -who.length("upper_arm")])
    _add_joints(lower, ["elbow_flex"], degrees, side)
    length = who.length("forearm")
    hand = _inertia(who, "hand", who.length("hand") * 0.5, length * _DOWN, _DOWN)
    _set(lower, _combined([(1, _inertia(who, "forearm", length, np.zeros(3), _DOWN)), (1, hand)]))
    _capsule(lower, (0, 0, 0), (0, 0, -length - 0.5 * who.length("hand")), 0.018 * who.height_m, _SKIN)


def add_human(pelvis: mujoco.MjsBody, who: Body, contact: TwinHumanContactSettings, *, degrees: bool) -> None:
    """Build the person into a body that is the pelvis, its origin in the middle of the hips.

    ``contact`` has friction, solref and solimp of the soles; ``degrees`` is the unit of ranges in the description that
    the body belongs to (``spec.compiler.degree``). Actuators are added by `add_actuators`.
    """
    trunk = who.length("trunk")
    lower = LOWER_TRUNK_SHARE[who.sex] * trunk
    part = _inertia(who, "lower_trunk", lower, lower * _UP, _DOWN)
    _set(pelvis, part)
    _capsule(
        pelvis, (0, -0.05 * who.height_m, 0.02), (0, 0.05 * who.height_m, 0.02), 0.06 * who.height_m, _CLOTH
    )
    pelvis.add_site(name="human_root", size=[0.005])
    pelvis.add_site(name="mid_asis", pos=who.mid_asis, size=[0.005])
    for side in FEET:
        _leg(pelvis, who, side, contact, degrees)
    torso = pelvis.add_body(name="torso", pos=[0, 0, lower])
    _add_joints(torso, ["lumbar_extension", "lumbar_bending", "lumbar_rotation"], degrees)
    whole = _inertia(who, "trunk", trunk, trunk * _UP, _DOWN)
    head = _inertia(who, "head", who.length("head"), (trunk + 0.182 * who.height_m) * _UP, _DOWN)
    upper = _combined([(1, whole), (-1, part), (1, head)])
    _set(torso, _Inertia(upper.mass, upper.com - lower * _UP, upper.inertia))
    chest = trunk - lower
    _capsule(torso, (0, 0, 0.02), (0, 0, chest - 0.06), 0.075 * who.height_m, _CLOTH)
    torso.add_geom(
        type=mujoco.mjtGeom.mjGEOM_SPHERE,
        size=[0.06 * who.height_m, 0, 0],
        pos=[0, 0, chest + 0.11 * who.height_m],
        contype=0,
        conaffinity=0,
        mass=0,
        rgba=_SKIN,
    )
    for side in FEET:
        _arm(torso, who, side, chest, degrees)


def add_actuators(spec: mujoco.MjSpec, who: Body) -> None:
    """One position servo per joint, in the order of `JOINTS`; its damping is implicit in the integrator."""
    for joint in JOINTS:
        kp, limit = (who.strength * value for value in GAINS[base_name(joint)])
        kv = kp * _VELOCITY_GAIN_S
        spec.add_actuator(
            name=joint,
            trntype=mujoco.mjtTrn.mjTRN_JOINT,
            target=joint,
            gaintype=mujoco.mjtGain.mjGAIN_FIXED,
            gainprm=[kp] + [0] * 9,
            biastype=mujoco.mjtBias.mjBIAS_AFFINE,
            biasprm=[0, -kp, -kv] + [0] * 7,
            forcerange=[-limit, limit],
            forcelimited=mujoco.mjtLimited.mjLIMITED_TRUE,
        )


def servo_lead_s() -> float:
    """Velocity gain per position gain [s]: a servo's target leads by that much, so that damping does not lag."""
    return _VELOCITY_GAIN_S


def add_floor(spec: mujoco.MjSpec) -> None:
    """The ground plane z = 0, the only thing that feet touch, with friction that is alike in all directions.

    Under MuJoCo's cheaper pyramid of friction soft soles creep: a standing heel slips twice as fast.
    """
    spec.option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    spec.worldbody.add_geom(
        name="floor",
        type=mujoco.mjtGeom.mjGEOM_PLANE,
        size=[0, 0, 1],
        contype=1,
        conaffinity=0,
        rgba=[0.92, 0.92, 0.90, 1],
    )


def human_spec(who: Body, settings: TwinHumanSettings) -> mujoco.MjSpec:
    """Describe the free person on the floor; ``settings`` is the slice ``twin.human`` of the configuration."""
    spec = mujoco.MjSpec()
    spec.modelname = "human"
    spec.compiler.degree = False
    spec.option.timestep = settings["timestep_s"]
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    # five spheres under a foot are tried one by one in less time than a tree of them is searched (3 to 4 % of a step)
    spec.option.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_MIDPHASE)
    add_floor(spec)
    pelvis = spec.worldbody.add_body(name="pelvis", pos=[0, 0, who.hip_height])
    pelvis.add_freejoint(name="root")
    add_human(pelvis, who, settings["contact"], degrees=False)
    add_actuators(spec, who)
    return spec


def with_substeps(settings: TwinHumanSettings, substeps: int) -> TwinHumanSettings:
    """Return the slice ``twin.human`` with the control step divided into ``substeps`` simulation steps."""
    step = settings["timestep_s"] * settings["substeps"] / substeps
    return {**settings, "timestep_s": step, "substeps": substeps}


def pelvis_rotation(tilt: np.ndarray, lists: np.ndarray, rotation: np.ndarray) -> np.ndarray:
    """Orientation (..., 3, 3) of the pelvis in the world from Rajagopal's three angles [rad].

    Body-fixed Z-X-Y of OpenSim in axes with z up: R_y(-tilt) R_x(list) R_z(rotation).
    """
    ct, st = np.cos(-tilt), np.sin(-tilt)
    cl, sl = np.cos(lists), np.sin(lists)
    cr, sr = np.cos(rotation), np.sin(rotation)
    rows = [
        [ct * cr + st * sl * sr, -ct * sr + st * sl * cr, st * cl],
        [cl * sr, cl * cr, -sl],
        [-st * cr + ct * sl * sr, st * sr + ct * sl * cr, ct * cl],
    ]
    return np.stack([np.stack(r, axis=-1) for r in rows], axis=-2)


def qpos_of(coordinates: dict[str, float], who: Body) -> np.ndarray:
    """Position vector (28,) of the free person from Rajagopal coordinates [rad, m]; missing ones are 0.

    ``pelvis_tx, pelvis_ty, pelvis_tz`` place the middle of the hips in OpenSim's ground (x forward, y up, z right).
    """
    get = coordinates.get
    tilt, lists, rotation = (np.array(get(f"pelvis_{n}", 0.0)) for n in ("tilt", "list", "rotation"))
    matrix = pelvis_rotation(tilt, lists, rotation)
    quaternion = np.zeros(4)
    mujoco.mju_mat2Quat(quaternion, matrix.flatten())
    place = [get("pelvis_tx", 0.0), -get("pelvis_tz", 0.0), get("pelvis_ty", who.hip_height)]
    return np.array([*place, *quaternion, *(get(name, 0.0) for name in JOINTS)])


def body_of(person: Path) -> tuple[Body, bool]:
    """Return the person of a subject.yaml, and whether it, or a recording beside it, says that they are synthetic."""
    facts = read_yaml(person)
    who = Body(float(facts["height_m"]), float(facts["mass_kg"]), str(facts["sex"]))
    return who, bool(facts.get("phantom", False)) or holds_synthetic(person.parent)


def twin_human(*, person: Path, settings: TwinSettings, out: Path) -> None:
    """Write a person's model as MJCF; ``settings`` is the slice ``twin``, ``person`` a subject.yaml."""
    who, phantom = body_of(person)
    spec = human_spec(who, settings["human"])
    spec.compile()
    mark = "<!-- synthetic person of the phantom cohort -->\n" if phantom else ""
    write_text(out, mark + spec.to_xml())
