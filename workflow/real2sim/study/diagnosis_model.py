"""The diagnosed model as an MJCF that any MuJoCo loads, and in words what of the diagnosis is no part of a model."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from real2sim.artefacts import read_json, write_json
from real2sim.diagnosis.evidence import BALANCE
from real2sim.effects.base import NATIVE, AtRest, Effect, InterfaceImpedance, Placed, Scales, Where
from real2sim.effects.catalogue import EFFECTS
from real2sim.effects.chains import Context
from real2sim.effects.planned import PlannedForce
from real2sim.errors import InputError
from real2sim.files import write_text
from real2sim.inference.parameters import PARAMETERS
from real2sim.provenance import Provenance, fingerprint, provenance
from real2sim.recording.noise import NoiseModel
from real2sim.study.strap_evidence import StrapEvidence
from real2sim.study.strap_recording import load_evidence
from real2sim.system.description import System
from real2sim.system.export import HOW_IT_IS_DRIVEN, START_KEY, baked, to_mjcf, write_replay

# Entries of diagnosis.json that are read
_READ = (
    "subject",
    "phantom",
    "train",
    "verdict",
    "verdict_set",
    "parameters",
    "model",
    "free_form",
    "robot_holds",
    "settings",
)
_PACKAGES = ["mujoco", "numpy", "scipy"]
_LAW = "measured_law"
_HOW_TO_DRIVE = (
    "motors planned_* drive the trial that was fitted from model_replay.csv; for another one compute their force from"
    " free_form of diagnosis.json: interpolate curve.total over curve.grid, or evaluate equation"
)
_NOTICE = "PHANTOM: made from synthetic data. It describes no person."


def _scales(written: Mapping[str, list[float]]) -> Scales:
    """Return the units of the effects' parameters that an answer was written with."""
    q, v, k, d, inertia = (np.array(written[name]) for name in ("q", "v", "k", "d", "inertia"))
    return Scales(q, v, k, d, inertia)


def effects_of(model: dict[str, Any], system: System, source: Path) -> tuple[list[Placed], list[np.ndarray]]:
    """Effects at their places and their searched numbers (p,), from the entry ``model`` of diagnosis.json.

    Raises
    ------
    InputError
        Where the catalogue has no such effect (any more).
    """
    scales = _scales(model["scales"])
    placed, x = [], []
    for entry in model["effects"]:
        where = tuple(system.axis_names.index(axis) for axis in entry["axes"])
        found = [e for e in EFFECTS if (e.name, e.form) == (entry["effect"], entry["form"])]
        if not found or len(found[0].parameters) != len(entry["searched"]):
            raise InputError(
                source,
                "model.effects",
                f"{entry['effect']}{entry['form']} with {len(entry['searched'])} parameters",
                "an effect of the catalogue (docs/effects.md)",
                "Run the diagnosis again.",
            )
        effect = found[0]
        placed.append(Placed(effect, effect.place(system, where, entry["side"]), scales))
        x.append(np.array(entry["searched"], float))
    return placed, x


def diagnosed_robot(answer: Mapping[str, Any], configured: Path) -> Path:
    """Return the MJCF of the robot that an answer rests on: the configured one, unless another one was found."""
    machine = answer.get("machine")
    return configured if machine is None or machine["model"] is None else Path(machine["model"])


def diagnosed_evidence(
    answer: Mapping[str, Any], trial: Path, neutral: Path, limits: Path | None, robot: Path
) -> StrapEvidence:
    """Return a trial as the diagnosis saw it when it gave its answer (contents of diagnosis.json), not whitened.

    ``trial`` and ``neutral`` are folders of canonical tables, ``limits`` the person's joint limits, ``robot`` the MJCF
    of the configured robot twin (`diagnosed_robot`).
    """
    settings = answer["settings"]
    evidence = load_evidence(
        folder=trial,
        neutral=neutral,
        limits=limits,
        robot=diagnosed_robot(answer, robot),
        settings=settings,
        noise=NoiseModel.measure(neutral, settings["ingest"], settings["diagnosis"]["noise"]),
        settled=answer["robot_holds"] == BALANCE,
    )
    return evidence.with_scales(_scales(answer["model"]["scales"]))


def measured_law(answer: dict[str, Any], system: System, scales: Scales) -> Placed | None:
    """Return the law of an answer `unknown` as planned forces of the fitted trial; None where none was measured."""
    free_form = answer["free_form"]
    if answer["verdict"] != "unknown" or free_form is None or free_form["model"] is None:
        return None
    own = free_form["model"]
    time_s, forces = np.array(own["time_s"]), np.array(own["forces"])

    def plan(values: np.ndarray, context: Context, where: Where, impedance: InterfaceImpedance) -> np.ndarray:
        steps = np.array([np.interp(context.step_time_s, time_s, force) for force in forces])
        return np.broadcast_to(steps.T, (len(values), *steps.T.shape))

    effect = Effect(
        _LAW,
        free_form["stage"],
        "; ".join(_told(f) for f in free_form["families"]),
        (),
        separating_trial="a wider range of what it depends on",
        at_rest=AtRest(()),
        scope="whole",
        plant=PlannedForce(plan, tuple(own["joints"])),
        remedy=_HOW_TO_DRIVE,
    )
    return Placed(effect, Where(system, (), 0, "law", "measured"), scales)


def _told(family: dict[str, Any]) -> str:
    at = f" along {', '.join(family['axes'])}" if family["axes"] else ""
    return f"{family['kind']}{at} of {', '.join(family['depends_on'])}"


def _with_law(answer: dict[str, Any]) -> dict[str, Any]:
    """The answer with the values of ``parameters`` that were fitted beside the measured law."""
    fitted = answer["free_form"]["model"]["parameters"]
    parameters = {
        name: p | {"fitted": fitted[name]["value"], "with_effect": fitted[name]["value"]}
        for name, p in answer["parameters"].items()
    }
    return answer | {"parameters": parameters}


def _fitted_trial(answer: Mapping[str, Any], trials: Sequence[Path], source: Path) -> Path:
    """Return the folder of the trial that the effects were fitted to. Raises InputError where it is none of them."""
    by_name = {folder.name: folder for folder in trials}
    (name,) = answer["train"]
    if name not in by_name:
        expected = " or ".join(by_name)
        raise InputError(
            source, "train", name, expected, "Give the folders of the two trials that were diagnosed."
        )
    return by_name[name]


def export_model(
    *,
    diagnosis: Path,
    trials: list[Path],
    neutral: Path,
    robot: Path,
    out: Path,
    notes: Path,
    replay: Path,
    limits: Path | None = None,
) -> None:
    """Write the diagnosed model of one person: MJCF, what is no part of it, and a trial to check it with.

    Parameters
    ----------
    diagnosis
        diagnosis.json.
    trials
        Folders of canonical tables of the two trials that were diagnosed, in any order. The model is that of the fitted
        one, which the answer names: the second one where the trials changed places.
    neutral
        Folder of canonical tables of the neutral trial.
    limits
        Joint limits of the person, where they exist.
    out
        model.xml: robot and interface with the corrected parameters and the effects, alone in its file.
    notes
        model.json: verdict, parameters, each effect with its status (in the model or not) and what to do about it.
    replay
        CSV of the fitted trial at the model's steps: controls by actuator, and where the interface sites then are
        [m, world].

    Raises
    ------
    InputError
        Where the fitted trial is none of ``trials``.
    """
    answer = read_json(diagnosis, _READ)
    fitted = _fitted_trial(answer, trials, diagnosis)
    evidence = diagnosed_evidence(answer, fitted, neutral, limits, robot)
    effects, x = effects_of(answer["model"], evidence.setup.system, diagnosis)
    law = measured_law(answer, evidence.setup.system, evidence.scales)
    if law is not None:
        effects, x, answer = [law], [np.empty(0)], _with_law(answer)
    parameters = np.array([answer["parameters"][name]["fitted"] for name in PARAMETERS])
    model = evidence.replay(effects, 1)
    model.run_effects(parameters[None], [part[None] for part in x])
    simulated = model.as_simulated()
    about = [_about(placed, part) for placed, part in zip(effects, x, strict=True)]
    used = diagnosed_robot(answer, robot)
    sources = provenance([diagnosis, used, *([limits] if limits else [])], _PACKAGES, fingerprint(__name__))
    header, texts = _header(answer, about, fitted.name, replay.name), _texts(answer, about, sources)
    numbers = {name: float(value) for name, value in zip(PARAMETERS, parameters, strict=True)}
    text = to_mjcf(baked(model, simulated), simulated, header, texts, numbers)
    write_text(out, text)
    write_json(notes, _notes(answer, about, fitted.name) | {"provenance": sources})
    write_replay(replay, model, simulated)


def _about(placed: Placed, x: np.ndarray) -> dict[str, Any]:
    effect = placed.effect
    return {
        "effect": effect.name,
        "form": effect.form.strip("_"),
        "status": effect.exported,
        "axes": placed.axes,
        "side": placed.where.side,
        "equation": effect.equation,
        "parameters": {k: {"value": v, "unit": u} for k, (v, u) in placed.named(x).items()},
        "remedy": effect.remedy or None,
    }


def _verdict(answer: dict[str, Any]) -> str:
    machine = answer.get("machine")
    if machine is None or machine["model"] is None:
        return _named(answer)
    return f"{_named(answer)}; the robot is {machine['name']} ({machine['model']}) and not the configured one"


def _named(answer: dict[str, Any]) -> str:
    if answer["verdict"] == "none":
        return "none: no effect stands out of the noise; this is the plain plant with the plain fit"
    if answer["verdict"] == "unknown" and (answer["free_form"] or {}).get("model"):
        return (
            "unknown: no effect of the catalogue explains the gap; this is the plant with the law that was measured,"
            " its forces on motors planned_*"
        )
    if answer["verdict"] == "unknown":
        return (
            "unknown: there is a gap that no effect of the catalogue explains; this is the plain plant with the plain"
            " fit, and it does not close the gap"
        )
    names = " with ".join(answer["verdict_set"])
    return f"{names} (probability of {answer['verdict']} {answer['probabilities'][answer['verdict']]:.2f})"


def _value(name: str, about: dict[str, Any]) -> str:
    unit = "" if about["unit"] == "1" else f" {about['unit']}"
    return f"{name} = {about['value']!r}{unit}"


def _line(about: dict[str, Any]) -> str:
    values = ", ".join(_value(k, v) for k, v in about["parameters"].items())
    place = " ".join(about["axes"]) + {1: " upper", -1: " lower", 0: ""}[about["side"]]
    parts = [about["status"], f"equation: {about['equation']}", f"parameters: {values or 'none'}"]
    if place:
        parts.insert(1, f"at {place}")
    if about["remedy"]:
        parts.append(f"instead: {about['remedy']}")
    return "; ".join(parts)


def _header(answer: dict[str, Any], about: Sequence[dict[str, Any]], trial: str, replay: str) -> list[str]:
    rows = [
        f"{name} = {p['fitted']:.6g} {p['unit']} (plain fit {p['base']:.6g})"
        for name, p in answer["parameters"].items()
    ]
    return [
        *([_NOTICE] if answer["phantom"] else []),
        f"Robot and interface of {answer['subject']} as diagnosed: pHRI Real2Sim on MuJoCo {mujoco.__version__}.",
        f"Verdict: {_verdict(answer)}.",
        "Units: SI (m, rad, kg, s, N, Nm). Parameters of the interface, relative as long as no force was measured:",
        *(f"  {row}" for row in rows),
        "Effects:" if about else "Effects: none.",
        *(f"  {a['effect']}: {_line(a)}" for a in about),
        f"Start pose and rest of the robot's controller: trial {trial}, keyframe {START_KEY}.",
        *HOW_IT_IS_DRIVEN,
        f"{replay} holds these controls for one trial (planned_*: planned forces), and where the sites are then.",
    ]


def _texts(answer: dict[str, Any], about: Sequence[dict[str, Any]], sources: Provenance) -> dict[str, str]:
    texts = {
        "subject": answer["subject"],
        "verdict": _verdict(answer),
        "units": "; ".join(f"{name}: {p['unit']}" for name, p in answer["parameters"].items()),
        "versions": f"mujoco {mujoco.__version__}, code {sources['code_fingerprint']}",
    }
    if answer["phantom"]:
        texts["phantom"] = _NOTICE
    return texts | {f"effect_{i + 1}_{a['effect']}": _line(a) for i, a in enumerate(about)}


def _notes(answer: dict[str, Any], about: Sequence[dict[str, Any]], trial: str) -> dict[str, Any]:
    left = [a for a in about if a["status"] != NATIVE]
    return {
        "schema": 1,
        "subject": answer["subject"],
        "phantom": answer["phantom"],
        "verdict": answer["verdict"],
        "meaning": _verdict(answer),
        "trial": trial,
        "complete": not left and answer["verdict"] != "unknown",
        "effects": list(about),
        "to_do": [f"{a['effect']}: {a['remedy']}" for a in left],
        "parameters": {
            name: {
                "value": p["fitted"],
                "unbiased": p["with_effect"],
                "plain": p["base"],
                "unit": p["unit"],
            }
            for name, p in answer["parameters"].items()
        },
    }
