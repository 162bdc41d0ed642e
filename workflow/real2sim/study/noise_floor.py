"""The noise floor of a person's J, from their neutral trial."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from real2sim.artefacts import read_json, write_json
from real2sim.inference.identifiability import Options
from real2sim.inference.noise_floor import Floor, floor_of
from real2sim.inference.parameters import as_vector
from real2sim.provenance import fingerprint
from real2sim.recording.quality.verdict import overridden_gates
from real2sim.recording.trial import TrialModel, trial_model, with_step
from real2sim.study.fit import best_of

if TYPE_CHECKING:
    from real2sim.settings import Settings


def floor_of_trial(model: TrialModel, parameters: np.ndarray, options: Options) -> Floor:
    """Return the noise floor of J from a quiet trial, replayed with parameters (12,) [SI].

    ``options`` is the slice ``identifiability`` of the configuration.
    """
    rate = 1 / float(model.trial.time_s[1] - model.trial.time_s[0])
    return floor_of(model.cost, model.replay.run(parameters[None]), rate, options)


def noise_floor(
    *,
    subject: str,
    fits: list[Path],
    pose: Path,
    markers: Path,
    limits: Path,
    step: Path,
    robot: Path,
    settings: Settings,
    out: Path,
) -> None:
    """Write the cost of the person's neutral trial, replayed with the best fit.

    The person stands, so the interface markers and the replayed pelvis carry noise, gaps, a little sway and no motion:
    what the cost finds there it finds in every trial of that day. ``fits`` are all fits of the person; ``pose`` and
    ``markers`` those of ``neutral``. ``repeats`` gives the spread of J over the person's dynamic trials beside it.

    The file has ``J``, its terms, ``ci95`` by a block bootstrap, and per trial the best J over the floor.
    """
    records = [read_json(path, ("trial", "restart", "parameters", "cost")) for path in fits]
    settings = with_step(settings, step)
    model = trial_model(pose=pose, markers=markers, limits=limits, robot=robot, settings=settings, nsim=1)
    floor = floor_of_trial(model, as_vector(best_of(records)["parameters"]), settings["identifiability"])
    trials = {
        trial: best_of([r for r in records if r["trial"] == trial])["cost"]["J"]
        for trial in sorted({r["trial"] for r in records})
    }
    write_json(
        out,
        {
            "schema": 1,
            "subject": subject,
            "source": "neutral",
            "phantom": model.trial.phantom,
            "overridden_gates": overridden_gates(records),
            **floor,
            "repeats": {"J": trials, "over_floor": {trial: j / floor["J"] for trial, j in trials.items()}},
            "provenance": {"code_fingerprint": fingerprint(__name__)},
        },
    )
