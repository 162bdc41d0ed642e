"""The interface of one person as an MJCF that any MuJoCo loads: robot, strap and a pelvis that follows its path."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import mujoco
import numpy as np

from real2sim.artefacts import read_json, write_json
from real2sim.errors import InputError
from real2sim.files import write_text
from real2sim.inference.parameters import PARAMETERS, as_vector
from real2sim.provenance import Provenance, fingerprint, provenance
from real2sim.recording.trial import load_limits, load_trial, replay_of, with_step
from real2sim.system.export import HOW_IT_IS_DRIVEN, START_KEY, baked, replayed, to_mjcf, write_replay
from real2sim.system.plant import STRAP_JOINTS, JointLimits, RestPose
from real2sim.system.replay import Replay, Simulated

if TYPE_CHECKING:
    from real2sim.settings import PlantSettings, Settings

_PACKAGES = ["mujoco", "numpy", "scipy"]
_NOTICE = "PHANTOM: made from synthetic data. It describes no person."
# The file is compared field by field before it is written; what is left is rounding that 6000 steps carry on
REPLAY_BAR_M = 1e-9


def export_interface(
    *,
    refined: Path,
    poses: list[Path],
    markers: list[Path],
    robot: Path,
    settings: Settings,
    out: Path,
    replay: Path,
    notes: Path,
    limits: Path | None = None,
    step: Path | None = None,
) -> None:
    """Write the interface of one person with their refined parameters, and a trial to check it with.

    Parameters
    ----------
    refined
        results/refined/<SUBJECT>.json.
    poses, markers
        Tables of the dynamic trials and of ``neutral``, in one order. The robot holds the start pose, and the pelvis
        follows the path, of the first trial that was refined, or of ``neutral`` where none was.
    settings
        Slices ``identification``, ``plant`` and ``robot``.
    limits, step
        Joint limits and step study of the person. Without limits the strap's joints have none; without a study the
        smallest candidate is the time step.
    out, replay, notes
        MJCF; CSV with the controls of the trial at the model's steps and where the interface sites then are [m, world];
        JSON that says what is in them and how far a replay of the written file is from ours [m].

    Raises
    ------
    InputError
        Where the written file, loaded by plain MuJoCo, does not move as the model in process within 1e-9 m.
    """
    person = read_json(refined, ("subject", "status", "parameters", "phantom", "trials"))
    name = next(iter(person["trials"]), "neutral")
    pose, measured = next(pair for pair in zip(poses, markers, strict=True) if pair[0].parent.name == name)
    chosen = with_step(settings, step) if step else _with_own_step(settings)
    trial = load_trial(pose, measured, settings["identification"])
    own_limits = load_limits(limits) if limits else None
    model = replay_of(trial, own_limits, robot, chosen, nsim=1)
    values = as_vector({name: p["value"] for name, p in person["parameters"].items()})
    model.run(values[None])
    simulated = model.as_simulated()
    used = [path for path in (refined, pose, robot, limits, step) if path is not None]
    sources = provenance(used, _PACKAGES, fingerprint(__name__))
    header = _header(person, pose.parent.name, replay.name, own_limits is not None)
    numbers = {name: float(value) for name, value in zip(PARAMETERS, values, strict=True)}
    text = to_mjcf(baked(model, simulated), simulated, header, _texts(person, sources), numbers)
    difference = _check_replay(out, text, model, simulated)
    write_text(out, text)
    write_replay(replay, model, simulated)
    about = {"trial": pose.parent.name, "timestep_s": simulated.model.opt.timestep}
    checked = {"replay_difference_m": difference, "provenance": sources}
    write_json(notes, _notes(person, about, own_limits, trial.rest) | checked)


def _check_replay(out: Path, text: str, model: Replay, simulated: Simulated) -> float:
    """Return how far [m] the written text moves from the model in process; raise InputError above `REPLAY_BAR_M`."""
    difference = float(np.abs(replayed(text, simulated.control) - model.sites()).max())
    if not difference <= REPLAY_BAR_M:
        raise InputError(
            out,
            "interface sites",
            f"{difference:.2g} m from the model in process",
            f"at most {REPLAY_BAR_M:g} m",
            "Report it with the robot twin: the export does not hold one of its elements.",
        )
    return difference


def _notes(
    person: dict[str, Any], about: dict[str, Any], limits: JointLimits | None, rest: RestPose
) -> dict[str, Any]:
    """Return what the notes say of the person, of the trial (``about``) and of the interface."""
    return (
        {"schema": 1, "subject": person["subject"], "phantom": person["phantom"], "status": person["status"]}
        | about
        | {
            "joints": list(STRAP_JOINTS),
            "limits": None
            if limits is None
            else {"lower": limits.lower.tolist(), "upper": limits.upper.tolist()},
            "rest": {"rotation": rest.rotation.tolist(), "position_m": rest.position.tolist()},
            "parameters": {
                name: {key: p[key] for key in ("value", "unit", "source")}
                for name, p in person["parameters"].items()
            },
        }
    )


def _with_own_step(settings: Settings) -> Settings:
    """Return the settings with the time step of `_own_step`."""
    plant = settings["plant"]
    return {**settings, "plant": {**plant, "timestep_s": _own_step(plant)}}


def _own_step(plant: PlantSettings) -> float:
    """Return the time step [s] where no trial was there to study it: as configured, or the smallest candidate."""
    if plant["timestep_s"] == "auto":
        return float(min(plant["study"]["candidates_s"]))
    return float(plant["timestep_s"])


def _header(person: dict[str, Any], trial: str, replay: str, limited: bool) -> list[str]:
    rows = [
        f"{name} = {p['value']:.6g} {p['unit']} ({p['source']}{'; ' + p['end'] if p['end'] else ''})"
        for name, p in person["parameters"].items()
    ]
    joints = "joints strap_tx to strap_rz are the coordinates q, 0 at the rest pose"
    return [
        *([_NOTICE] if person["phantom"] else []),
        f"Robot and interface of {person['subject']}: pHRI Real2Sim on MuJoCo {mujoco.__version__}.",
        f"Refinement: {person['status']}.",
        f"Between body interface (robot) and body pelvis (person) the strap: {joints};",
        "their range is what the sweeps at T* allowed."
        if limited
        else "without limits, as no sweeps at T* were recorded.",
        "Units: SI (m, rad, kg, s, N, Nm). Parameters of the interface, relative as long as no force was measured:",
        *(f"  {row}" for row in rows),
        f"Start pose and rest of the robot's controller: trial {trial}, keyframe {START_KEY}.",
        *HOW_IT_IS_DRIVEN,
        f"{replay} holds these controls for that trial, and where the sites are then.",
    ]


def _texts(person: dict[str, Any], sources: Provenance) -> dict[str, str]:
    parameters = person["parameters"]
    texts = {
        "subject": person["subject"],
        "status": person["status"],
        "units": "; ".join(f"{name}: {p['unit']}" for name, p in parameters.items()),
        "sources": "; ".join(f"{name}: {p['source']}" for name, p in parameters.items()),
        "versions": f"mujoco {mujoco.__version__}, code {sources['code_fingerprint']}",
    }
    return texts | ({"phantom": _NOTICE} if person["phantom"] else {})
