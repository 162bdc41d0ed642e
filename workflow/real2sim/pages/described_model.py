"""The diagnosed model of a described system as an MJCF that any MuJoCo loads."""

from __future__ import annotations

from pathlib import Path

import mujoco

from real2sim.diagnosis.answer import Diagnosis
from real2sim.effects.system_replay import SystemReplay
from real2sim.files import write_text
from real2sim.system.export import baked, to_mjcf


def write_model(path: Path, answer: Diagnosis) -> None:
    """Write the plant of the fitted recording with its parameters and the effects that were named.

    Where no name fits and a law was measured, its forces are planned ones.

    What is no part of a model (effects of the measurement, planned forces) is listed in the header with what to do.

    Raises
    ------
    ValueError
        Where a field of the model has no element of MJCF to be written to.
    """
    pair, fitted = answer.found.pair, answer.fits.law or answer.fitted
    replay = pair.train.replay(list(fitted.effects), 1)
    if not isinstance(replay, SystemReplay):
        raise ValueError("the strap's model is written by the workflow: snakemake --cores 2 diagnosis")
    values = pair.system.values(fitted.base)
    replay.run_effects(values[None], [x[None] for x in fitted.split()])
    simulated = replay.as_simulated()
    header = [
        f"{pair.system.name} as diagnosed: {', '.join(answer.verdict_set)}. MuJoCo {mujoco.__version__}. SI units.",
        *(f"{p.name} = {v:.6g} {p.unit}" for p, v in zip(pair.system.parameters, values, strict=True)),
    ]
    if answer.fits.law is not None:
        header.append(
            "Motors planned_*: the measured law, a force that depends on what free_form of the answer says"
        )
    for placed, x in zip(fitted.effects, fitted.split(), strict=True):
        if answer.fits.law is not None:
            continue
        named = ", ".join(f"{k} = {v:.6g} {u}" for k, (v, u) in placed.named(x).items())
        about = f"{placed.key}: {placed.effect.exported}; {placed.effect.equation}; {named}"
        header.append(f"{about}; instead: {placed.effect.remedy}" if placed.effect.remedy else about)
    numbers = {p.name: float(v) for p, v in zip(pair.system.parameters, values, strict=True)}
    write_text(path, to_mjcf(baked(replay, simulated), simulated, header, {}, numbers))
