"""A simulated plant as an MJCF of its own: what a batch holds as fields is written into elements, to the last digit.

MuJoCo's writer keeps six digits. Numbers are written anew with all of them, and the text is loaded again and compared
with what was simulated, field by field: what the format cannot hold is an error, never an omission.
"""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Protocol

import mujoco
import numpy as np

from real2sim.artefacts import write_table
from real2sim.system.plant import INTERFACE_SITES
from real2sim.system.replay import Replay, Simulated

# Relative difference that a number may have after it was written and read; angles are turned to radians and back
_SAME = 1e-12
START_KEY = "start"
# Writes fields of a compiled model into the description, of one joint (by its index) or of the whole model
WriteJoint = Callable[[mujoco.MjsJoint, mujoco.MjModel, int], None]
WriteModel = Callable[[mujoco.MjSpec, mujoco.MjModel], None]


def _joint(spec: mujoco.MjSpec, model: mujoco.MjModel, index: int) -> mujoco.MjsJoint:
    return spec.joint(model.joint(index).name)


def _rest(joint: mujoco.MjsJoint, model: mujoco.MjModel, index: int) -> None:
    joint.springref = model.qpos_spring[model.jnt_qposadr[index]]


def _per_joint(write: WriteJoint) -> WriteModel:
    def all_joints(spec: mujoco.MjSpec, model: mujoco.MjModel) -> None:
        for index in range(model.njnt):
            write(_joint(spec, model, index), model, index)

    return all_joints


def _spring(joint: mujoco.MjsJoint, model: mujoco.MjModel, index: int) -> None:
    joint.stiffness = [model.jnt_stiffness[index], *model.jnt_stiffnesspoly[index]]


def _damper(joint: mujoco.MjsJoint, model: mujoco.MjModel, index: int) -> None:
    dof = model.jnt_dofadr[index]
    joint.damping = [model.dof_damping[dof], *model.dof_dampingpoly[dof]]


def _of_dof(name: str) -> WriteJoint:
    def write(joint: mujoco.MjsJoint, model: mujoco.MjModel, index: int) -> None:
        setattr(joint, name, getattr(model, f"dof_{name}")[model.jnt_dofadr[index]])

    return write


def _anchor(joint: mujoco.MjsJoint, model: mujoco.MjModel, index: int) -> None:
    joint.pos = model.jnt_pos[index]


def _axis(joint: mujoco.MjsJoint, model: mujoco.MjModel, index: int) -> None:
    joint.axis = model.jnt_axis[index]


def _tendons(spec: mujoco.MjSpec, model: mujoco.MjModel) -> None:
    for index in range(model.ntendon):
        tendon = spec.tendon(model.tendon(index).name)
        tendon.stiffness = [model.tendon_stiffness[index], *model.tendon_stiffnesspoly[index]]
        tendon.damping = [model.tendon_damping[index], *model.tendon_dampingpoly[index]]
        tendon.springlength = model.tendon_lengthspring[index]
        tendon.springyield = model.tendon_springyield[index]
        tendon.range = model.tendon_range[index]
        tendon.solref_limit = model.tendon_solref_lim[index]


def _bodies(spec: mujoco.MjSpec, model: mujoco.MjModel) -> None:
    for index in range(1, model.nbody):
        body = spec.body(model.body(index).name)
        body.explicitinertial = True
        body.mass, body.inertia = model.body_mass[index], model.body_inertia[index]
        body.ipos, body.iquat = model.body_ipos[index], model.body_iquat[index]


def _turns(spec: mujoco.MjSpec, model: mujoco.MjModel) -> None:
    for index in range(1, model.nbody):
        spec.body(model.body(index).name).quat = model.body_quat[index]


def _sites(spec: mujoco.MjSpec, model: mujoco.MjModel) -> None:
    for index in range(model.nsite):
        spec.site(model.site(index).name).pos = model.site_pos[index]


def _actuators(spec: mujoco.MjSpec, model: mujoco.MjModel) -> None:
    for index in range(model.nu):
        actuator = spec.actuator(model.actuator(index).name)
        for name in ("gainprm", "biasprm", "dynprm"):
            setattr(actuator, name, getattr(model, f"actuator_{name}")[index])
        if model.actuator_forcelimited[index]:
            actuator.forcerange = model.actuator_forcerange[index]


# Fields of a compiled model that effects and strap parameters change, and what writes them into the description
_WRITERS: dict[str, WriteModel] = {
    "jnt_stiffness": _per_joint(_spring),
    "jnt_stiffnesspoly": _per_joint(_spring),
    "jnt_axis": _per_joint(_axis),
    "jnt_pos": _per_joint(_anchor),
    "qpos_spring": _per_joint(_rest),
    "dof_damping": _per_joint(_damper),
    "dof_dampingpoly": _per_joint(_damper),
    "dof_armature": _per_joint(_of_dof("armature")),
    "dof_frictionloss": _per_joint(_of_dof("frictionloss")),
    **dict.fromkeys(
        (
            "tendon_stiffness",
            "tendon_stiffnesspoly",
            "tendon_damping",
            "tendon_lengthspring",
            "tendon_springyield",
            "tendon_range",
            "tendon_solref_lim",
        ),
        _tendons,
    ),
    **dict.fromkeys(("body_mass", "body_inertia", "body_ipos"), _bodies),
    "body_quat": _turns,
    "site_pos": _sites,
    **dict.fromkeys(
        ("actuator_gainprm", "actuator_biasprm", "actuator_dynprm", "actuator_forcerange"), _actuators
    ),
}
# What the compiler makes of other fields, at the reference pose: it is made again when the text is loaded
_DERIVED = (
    "body_sameframe",
    "body_subtreemass",
    "body_invweight0",
    "dof_invweight0",
    "dof_M0",
    "dof_length",
    "tendon_invweight0",
    "actuator_acc0",
    "actuator_length0",
    "stat",
)

# What an export adds, and what it leaves out because nothing touches
_ADDED = ("key_", "text_", "numeric_", "name_")
_SHAPES = (
    *("geom_", "bvh_", "body_bvh", "body_geom", "body_contype", "body_conaffinity"),
    *("mesh_", "hfield_", "tex_", "mat_", "skin_", "path"),
)


def _fields(model: mujoco.MjModel) -> dict[str, np.ndarray]:
    """Return the numbers of a compiled model that tell one from another."""
    out = {}
    for name in dir(model):
        if name.startswith("_") or name in ("names", "names_map", "paths", "text_data") or name in _DERIVED:
            continue
        value = getattr(model, name)
        if isinstance(value, np.ndarray) and value.dtype.kind in "fiub" and value.size:
            out[name] = np.array(value)
    return out


def _differing(one: mujoco.MjModel, other: mujoco.MjModel, tolerance: float) -> list[str]:
    a, b = _fields(one), _fields(other)
    return [
        name
        for name in sorted(a.keys() | b.keys())
        if name not in a
        or name not in b
        or a[name].shape != b[name].shape
        or not np.allclose(a[name], b[name], rtol=tolerance, atol=1e-15, equal_nan=True)
    ]


class Described(Protocol):
    """A replay with the description and the compiled model of its plant."""

    spec: mujoco.MjSpec
    model: mujoco.MjModel


def baked(replay: Described, simulated: Simulated) -> mujoco.MjSpec:
    """Return the replay's description with the values of a simulation in its elements, and a keyframe ``start``.

    Raises
    ------
    ValueError
        Where a changed field has no element to be written to.
    """
    spec, model = replay.spec.copy(), simulated.model
    changed = _differing(replay.model, model, 0.0)
    unknown = [name for name in changed if name not in _WRITERS]
    if unknown:
        raise ValueError(f"no element of MJCF is known for {', '.join(unknown)}")
    for write in dict.fromkeys(_WRITERS[name] for name in changed):
        write(spec, model)
    if any(len(body.geoms) for body in spec.bodies):
        _bodies(spec, model)
        _without_shapes(spec)
    spec.add_key(name=START_KEY, qpos=simulated.position, qvel=simulated.velocity, ctrl=simulated.control[0])
    return spec


def _without_shapes(spec: mujoco.MjSpec) -> None:
    """Take away what would need files beside the model: nothing touches, and the inertia is written down."""
    for kind in ("geoms", "meshes", "textures", "materials", "hfields", "skins"):
        for element in list(getattr(spec, kind)):
            spec.delete(element)


def to_mjcf(
    spec: mujoco.MjSpec,
    simulated: Simulated,
    header: Iterable[str],
    texts: Mapping[str, str],
    numbers: Mapping[str, float],
) -> str:
    """Return the MJCF text of a baked description, checked to load as the model that was simulated.

    Parameters
    ----------
    header
        Lines of the comment at the top.
    texts, numbers
        Entries of <custom>, by name.

    Raises
    ------
    ValueError
        Where the text does not give the same model.
    """
    spec = spec.copy()
    for name, text in texts.items():
        spec.add_text(name=name, data=text)
    for name, value in numbers.items():
        spec.add_numeric(name=name, data=[value])
    spec.compile()
    root = ET.fromstring(spec.to_xml())
    _exact(root, spec)
    for name, value in numbers.items():
        _set(root.find(f"custom/numeric[@name='{name}']"), "data", [value])
    for element in root.iterfind("custom/text"):
        # the writer has two ways to write a text, and the reader understands one of them
        element.set("data", texts.get(element.get("name", ""), element.get("data", "")))
        element.text = None
    ET.indent(root)
    comment = "\n".join(f"  {line}".replace("--", "-") for line in header)
    text = f"<!--\n{comment}\n-->\n{ET.tostring(root, encoding='unicode')}\n"
    again = mujoco.MjModel.from_xml_string(text)
    lost = [f for f in _differing(again, simulated.model, _SAME) if not f.startswith(_ADDED + _SHAPES)]
    if lost:
        raise ValueError(f"MJCF loses {', '.join(lost)}")
    return text


def _set(element: ET.Element | None, name: str, values: Iterable[float]) -> None:
    if element is not None:
        element.set(name, " ".join(repr(float(v)) for v in np.atleast_1d(np.asarray(values, float))))


def _exact(root: ET.Element, spec: mujoco.MjSpec) -> None:
    """Write the numbers of named elements anew, with all their digits."""
    _set(root.find("option"), "timestep", [spec.option.timestep])
    for element in root.iter("body"):
        body = spec.body(element.get("name"))
        if body is None:
            continue
        _set(element, "pos", body.pos)
        _set(element, "quat", body.quat)
        if body.explicitinertial:
            _inertial(element, body)
    for element in root.iter("site"):
        site = spec.site(element.get("name"))
        if site is not None:
            _set(element, "pos", site.pos)
            _set(element, "quat", site.quat)
    for element in root.iterfind(".//body/joint"):
        joint = spec.joint(element.get("name"))
        if joint is not None:
            for name in ("stiffness", "damping", "armature", "springref", "frictionloss", "axis", "pos"):
                _set(element, name, getattr(joint, name))
            if element.get("range") is not None:
                _set(element, "range", joint.range)
            for name, own in (("solreflimit", "solref_limit"), ("solimplimit", "solimp_limit")):
                _set(element, name, getattr(joint, own))
            _set(element, "solreffriction", joint.solref_friction)
            _set(element, "solimpfriction", joint.solimp_friction)
    for element in root.iterfind("tendon/fixed"):
        tendon = spec.tendon(element.get("name"))
        for name in ("stiffness", "damping", "springlength", "springyield"):
            _set(element, name, getattr(tendon, name))
        if element.get("range") is not None:
            _set(element, "range", tendon.range)
            _set(element, "solreflimit", tendon.solref_limit)
            _set(element, "solimplimit", tendon.solimp_limit)
    for element in root.iterfind("actuator/general"):
        actuator = spec.actuator(element.get("name"))
        for name in ("gainprm", "biasprm", "dynprm"):
            _set(element, name, getattr(actuator, name))
        if element.get("forcerange") is not None:
            _set(element, "forcerange", actuator.forcerange)
    for element in root.iterfind("keyframe/key"):
        key = spec.key(element.get("name"))
        for name in ("qpos", "qvel", "ctrl"):
            _set(element, name, getattr(key, name))


def _inertial(element: ET.Element, body: mujoco.MjsBody) -> None:
    # the writer leaves out inertias that it takes for none
    found = element.find("inertial")
    inertial = ET.Element("inertial") if found is None else found
    if found is None:
        element.insert(0, inertial)
    inertial.attrib.pop("fullinertia", None)
    # a place that was never given is the body's origin
    _set(inertial, "pos", np.nan_to_num(body.ipos))
    _set(inertial, "quat", body.iquat)
    _set(inertial, "mass", [body.mass])
    _set(inertial, "diaginertia", body.inertia)


# What whoever loads a model has to know of how it is driven and stepped
HOW_IT_IS_DRIVEN = (
    "Shapes are left out: nothing touches.",
    "The pelvis follows actuators pelvis_tx to pelvis_rz: position relative to site pelvis_reference (m, rotation",
    "vector), plus 2 h velocity, plus 2 h^2 acceleration, velocities taken h/2 earlier (h: the time step). Damped",
    "joints carry armature -damping h / 2, which centres the step (+damping h / 2 beside dry friction, where implicit",
    "damping is off): keep h, or change both.",
)


def write_replay(out: Path, replay: Replay, simulated: Simulated) -> None:
    """Write a CSV of the last simulation: controls by actuator and interface sites [m, world] at every step."""
    model = simulated.model
    driven = [model.actuator(i).name for i in range(model.nu)]
    sites = [f"{site}_{axis}_m" for site in INTERFACE_SITES for axis in "xyz"]
    paths = replay.sites()
    time = np.arange(len(paths)) * model.opt.timestep
    write_table(
        out,
        ["time_s", *driven, *sites],
        (
            dict(zip(["time_s", *driven, *sites], map(float, (t, *u, *p)), strict=True))
            for t, u, p in zip(time, simulated.control, paths.reshape(len(paths), 6), strict=True)
        ),
    )


def replayed(text: str, control: np.ndarray) -> np.ndarray:
    """Return the interface sites (nstep, 2, 3) [m, world] of an MJCF text in plain MuJoCo, from its keyframe.

    ``control`` (nstep, nu) is the command of each step.
    """
    model = mujoco.MjModel.from_xml_string(text)
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, model.key(START_KEY).id)
    columns = [model.sensor(f"position_{site}").adr[0] + i for site in INTERFACE_SITES for i in range(3)]
    out = np.empty((len(control), 6))
    for i, command in enumerate(control):
        data.ctrl[:] = command
        mujoco.mj_step(model, data)
        out[i] = data.sensordata[columns]
    return out.reshape(-1, 2, 3)
