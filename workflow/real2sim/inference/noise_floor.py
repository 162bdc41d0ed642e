"""How much of J is measurement noise: the cost of a replay in which nothing but noise happens."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from real2sim.artefacts import read_json, write_json
from real2sim.inference.parameters import as_vector
from real2sim.provenance import fingerprint
from real2sim.recording.quality.verdict import overridden_gates
from real2sim.recording.trial import TrialModel, trial_model, with_step
from real2sim.study.fit import best_of


def block_bootstrap_mean(
    values: np.ndarray, block: int, samples: int, confidence: float, seed: int
) -> tuple[float, float]:
    """Percentile interval of the mean of a correlated series (n,), by moving blocks.

    Source: Kuensch, Annals of Statistics 17 (1989) 1217. ``block`` is their length in samples, at most n / 2.
    """
    n = len(values)
    block = max(1, min(block, n // 2))
    starts = np.random.default_rng(seed).integers(0, n - block + 1, (samples, -(-n // block)))
    cumulated = np.concatenate([[0.0], np.cumsum(values)])
    means = (cumulated[starts + block] - cumulated[starts]).mean(axis=1) / block
    tail = (1 - confidence) / 2
    low, high = np.quantile(means, [tail, 1 - tail])
    return float(low), float(high)


def floor_of(model: TrialModel, parameters: np.ndarray, options: dict) -> dict[str, Any]:
    """Cost of a quiet trial replayed with parameters (12,): ``J``, its terms and ``ci95`` by a block bootstrap.

    ``options`` is the slice ``identifiability`` of the configuration.
    """
    paths = model.replay.run(parameters[None])
    residual, terms = model.cost.residuals(paths)[0], model.cost(paths)
    energy = np.bincount(model.cost.sample_of_residual(), weights=residual**2)
    used = energy > 0
    rate = 1 / float(model.trial.time_s[1] - model.trial.time_s[0])
    low, high = block_bootstrap_mean(
        energy[used] * used.sum(),
        round(options["floor_block_s"] * rate),
        options["floor_bootstrap"],
        0.95,
        options["seed"],
    )
    return {
        "J": float(terms.total[0]),
        "J_position": float(terms.position[0]),
        "J_velocity": float(terms.velocity[0]),
        "ci95": [low, high],
    }


def noise_floor(
    *,
    subject: str,
    fits: list[Path],
    pose: Path,
    markers: Path,
    limits: Path,
    step: Path,
    robot: Path,
    settings: dict,
    out: Path,
) -> None:
    """Cost of the person's neutral trial, replayed with the best fit.

    The person stands, so the interface markers and the replayed pelvis carry noise, gaps, a little sway and no motion:
    what the cost finds there it finds in every trial of that day. ``fits`` are all fits of the person; ``pose`` and
    ``markers`` those of ``neutral``. ``repeats`` gives the spread of J over the person's dynamic trials beside it.

    The file has ``J``, its terms, ``ci95`` by a block bootstrap, and per trial the best J over the floor.
    """
    records = [read_json(path, ("trial", "restart", "parameters", "cost")) for path in fits]
    settings = with_step(settings, step)
    model = trial_model(pose=pose, markers=markers, limits=limits, robot=robot, settings=settings, nsim=1)
    floor = floor_of(model, as_vector(best_of(records)["parameters"]), settings["identifiability"])
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
