"""A clip of the coupled walk, rendered without a screen by EGL or OSMesa."""

from __future__ import annotations

import importlib
import os
from pathlib import Path
from typing import TYPE_CHECKING, Any

import mujoco
import numpy as np
from mujoco.rendering.classic import gl_context

from real2sim.errors import InputError
from real2sim.pages.style import PHANTOM_LABEL, save_clip
from real2sim.recording.pose_table import read_pose
from real2sim.recording.trial import load_limits
from real2sim.study.twin.coupled import Condition, CoupledWalk
from real2sim.study.twin.reference import read_walks
from real2sim.study.twin.robots import WalkingRobot
from real2sim.study.twin.stage import (
    cap_to_compare,
    load_walker,
    read_prior,
    vertical_stretch,
    walking_robots,
)
from real2sim.system.plant import RestPose

if TYPE_CHECKING:
    from real2sim.settings import Settings

SIZE = (400, 300)  # of a frame [pixels]
FRAMES_PER_S = 14


def dress(spec: mujoco.MjSpec, robot: Path) -> None:
    """Give the robot back the shapes that the plant drops, and the floor a pattern that shows motion."""
    shown = mujoco.MjSpec.from_file(str(robot))
    for body in shown.bodies:
        if body.name == "world":
            continue
        for geom in body.geoms:
            drawn = spec.body(body.name).add_geom(
                type=geom.type,
                size=geom.size,
                pos=geom.pos,
                quat=geom.quat,
                fromto=geom.fromto,
                rgba=geom.rgba,
                mass=0,
                contype=0,
                conaffinity=0,
            )
            # an orientation that the file gives in another way than by a quaternion
            drawn.alt.type, drawn.alt.zaxis = geom.alt.type, geom.alt.zaxis
    spec.add_texture(
        name="grid",
        type=mujoco.mjtTexture.mjTEXTURE_2D,
        builtin=mujoco.mjtBuiltin.mjBUILTIN_CHECKER,
        rgb1=[0.90, 0.91, 0.92],
        rgb2=[0.78, 0.80, 0.83],
        width=300,
        height=300,
    )
    textures = [""] * mujoco.mjtTextureRole.mjNTEXROLE
    textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = "grid"
    spec.add_texture(
        name="sky",
        type=mujoco.mjtTexture.mjTEXTURE_SKYBOX,
        builtin=mujoco.mjtBuiltin.mjBUILTIN_FLAT,
        rgb1=[0.97, 0.97, 0.98],
        rgb2=[0.97, 0.97, 0.98],
        width=64,
        height=64,
    )
    spec.add_material(name="grid", textures=textures, texrepeat=[2, 2], texuniform=True)
    floor = spec.geom("floor")
    floor.material, floor.rgba = "grid", [1, 1, 1, 1]
    spec.visual.headlight.ambient = [0.45, 0.45, 0.45]
    # it goes along with the person: beyond its surroundings a light casts no shadow
    spec.body("pelvis").add_light(
        pos=[0, -2, 3],
        dir=[0, 0.4, -1],
        type=mujoco.mjtLightType.mjLIGHT_DIRECTIONAL,
        mode=mujoco.mjtCamLight.mjCAMLIGHT_TRACK,
    )


class _ShownWalk(CoupledWalk):
    """A coupled walk that a camera sees."""

    def _dress(self, spec: mujoco.MjSpec, robot: WalkingRobot) -> None:
        dress(spec, robot.path)


def _renderer(model: mujoco.MjModel, backend: str, out: Path) -> Any:
    # MuJoCo picks its backend when it is imported, and would fail there without a word to a reader
    os.environ["MUJOCO_GL"] = backend
    try:
        importlib.reload(gl_context)
        return mujoco.Renderer(model, SIZE[1], SIZE[0])
    except Exception as error:  # every backend fails in a way of its own
        raise InputError(
            out,
            "",
            f"no OpenGL to render with by {backend} ({type(error).__name__}: {error})",
            "EGL (a graphics driver or Mesa) or OSMesa",
            "Install libegl1 or libosmesa6 and set MUJOCO_GL to egl or osmesa; nothing else needs the clip.",
        ) from error


def twin_clip(
    *,
    policy: Path,
    priors: Path,
    limits: Path,
    neutral: Path,
    robot: Path,
    study_robot: Path,
    assisted: list[Path],
    settings: Settings,
    out: Path,
    backend: str = "egl",
    seconds: float = 6.0,
) -> None:
    """Render a walk with the first robot of ``twin.coupled.robots`` under the prior as an animated GIF.

    ``settings`` has the slices ``twin`` and ``plant``, ``backend`` is egl or osmesa; the other inputs are those of
    `twin_coupled`. Raises InputError where nothing can render.
    """
    from PIL import Image, ImageDraw

    twin = settings["twin"]
    learnt = load_walker(policy, twin["coupled"])
    walks = read_walks(assisted, learnt.body)
    cap, _ = cap_to_compare(walks, learnt.reference.speed, twin["coupled"])
    pose, about = read_pose(neutral)
    del pose
    rest = about["rest"]
    walk = _ShownWalk(
        learnt,
        twin=twin,
        plant=settings["plant"],
        robot=walking_robots(twin, robot, study_robot)[0],
        rest=RestPose(np.array(rest["rotation"]), np.array(rest["position"])),
        limits=load_limits(limits),
        conditions=[Condition("prior", read_prior(priors), cap, (), twin["coupled"]["gaits"][0] == "aware")],
        walkers=1,
        stretch_m=vertical_stretch(assisted),
    )
    states: list[np.ndarray] = []
    walk.run(seconds, watch=lambda qpos: states.append(qpos[0].copy()))
    model, data = walk.model, mujoco.MjData(walk.model)
    renderer = _renderer(model, backend, out)
    camera = mujoco.MjvCamera()
    camera.distance, camera.azimuth, camera.elevation = 3.4, 115, -12
    root, frames = model.site("human_root").id, []
    step = max(1, round(1 / FRAMES_PER_S / walk.control_s))
    for qpos in states[::step]:
        data.qpos[:] = qpos
        mujoco.mj_forward(model, data)
        camera.lookat[:] = [data.site_xpos[root][0] - 0.25, 0, 0.85]
        renderer.update_scene(data, camera)
        frame = Image.fromarray(renderer.render())
        if about.get("phantom"):
            ImageDraw.Draw(frame).text((8, 6), PHANTOM_LABEL, fill=(190, 60, 0))
        frames.append(frame.quantize(32, dither=Image.Dither.NONE))
    renderer.close()
    save_clip(frames, out, step * walk.control_s)
