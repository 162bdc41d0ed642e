"""The paper's identification with the diagnosed causes in the model: the same cost J, the effects of the answer held.

What of the paper's conclusions rests on a model without these effects shows where both are compared: stiffness and
damping are fitted to each trial with the causes in the replay, and then shared, transferred and tested like the plain
ones.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from real2sim.artefacts import read_json, write_json
from real2sim.errors import InputError
from real2sim.inference.parameters import Bounds
from real2sim.provenance import fingerprint, provenance
from real2sim.recording.quality.verdict import require
from real2sim.recording.trial import TrialModel
from real2sim.study.diagnosis_model import diagnosed_evidence, diagnosed_robot, effects_of
from real2sim.study.fit import BATCH, outcome, progress_of, restart_seed, search

if TYPE_CHECKING:
    from real2sim.settings import IdentificationSettings

METHOD = "least_squares"
_PACKAGES = ["mujoco", "numpy", "scipy"]
_READ = ("train", "held_out", "robot_holds", "model", "settings")


@dataclass(frozen=True)
class Causes:
    """Diagnosed causes of one person: the answer (contents of the file ``diagnosis``), to be put into replays.

    ``neutral``: folder of canonical tables of the neutral trial; ``robot``: MJCF of the robot twin.
    """

    diagnosis: Path
    answer: Mapping[str, Any]
    neutral: Path
    robot: Path

    @classmethod
    def read(cls, diagnosis: Path, neutral: Path, robot: Path) -> Causes:
        """Read diagnosis.json. Raises InputError where it is broken."""
        return cls(diagnosis, read_json(diagnosis, _READ), neutral, robot)

    @property
    def names(self) -> list[str]:
        """Effects of the diagnosed model: none where the verdict is `none` or `unknown`."""
        return [entry["effect"] for entry in self.answer["model"]["effects"]]

    def model(self, trial: Path, limits: Path, nsim: int) -> TrialModel:
        """Return a dynamic trial with the causes in its replays of at most ``nsim`` simulations.

        ``trial`` is a folder of canonical tables, prepared as the diagnosis prepares it; ``limits`` are the person's.

        Raises
        ------
        InputError
            For a trial that the diagnosis neither fitted nor held out: nothing says how an effect acts there that acts
            on each trial in its own way.
        """
        fitted, held_out = self.answer["train"], self.answer["held_out"]
        if trial.name not in (*fitted, *held_out):
            expected = " or ".join((*fitted, *held_out))
            raise InputError(
                trial, "", "a trial that was not diagnosed", expected, "Fit one of those that were."
            )
        evidence = diagnosed_evidence(self.answer, trial, self.neutral, limits, self.robot)
        if trial.name in held_out:
            evidence = evidence.as_held_out()
        effects, x = effects_of(self.answer["model"], evidence.setup.system, self.diagnosis)
        replay = evidence.replay(effects, nsim)
        replay.hold(x)
        return TrialModel(evidence.trial, replay, evidence.cost, evidence.setup.limits)


def fit_with_effects(
    *,
    subject: str,
    trial: Path,
    restarts: list[int],
    diagnosis: Path,
    neutral: Path,
    limits: Path,
    robot: Path,
    settings: IdentificationSettings,
    out: list[Path],
    gates: list[Path] | None = None,
) -> None:
    """Identify the 12 interface parameters of one trial with the diagnosed causes in the model.

    From the starts of the plain fits, by the same cost J, by least squares.

    Parameters
    ----------
    trial, neutral
        Folders of canonical tables.
    restarts
        Numbers of the restarts.
    diagnosis
        diagnosis.json of the person, whose own settings make the replay.
    settings
        Slice ``identification`` of the configuration.
    gates
        As of `fit_trial`.
    out
        JSON of each restart, as `fit_trial` writes it, with ``causes``.

    Raises
    ------
    InputError
        Where a gate refuses the trial, or it was not diagnosed.
    """
    causes = Causes.read(diagnosis, neutral, robot)
    overridden = {} if gates is None else require(gates, trial.name)
    ident = settings.copy()
    ident["method"] = METHOD
    bounds = Bounds.from_config(ident["bounds"])
    model = causes.model(trial, limits, BATCH)
    label = f"{subject} {trial.name} with {', '.join(causes.names) or 'no cause'}"
    seeds = [restart_seed(ident["seed"], subject, trial.name, restart) for restart in restarts]
    results = search(model, bounds, ident, seeds, progress_of(label, ident, len(restarts)))
    used = diagnosed_robot(causes.answer, robot)
    source = provenance([diagnosis, limits, used], _PACKAGES, fingerprint(__name__))
    about = {"schema": 1, "subject": subject, "trial": trial.name, "restart": None, "method": ident["method"]}
    about |= {
        "phantom": model.trial.phantom,
        "overridden_gates": overridden,
        "causes": causes.answer["verdict_set"],
    }
    for path, restart, seed, result in zip(out, restarts, seeds, results, strict=True):
        found = {"restart": restart} | outcome(model, result, bounds, ident) | {"seed": seed}
        write_json(path, about | found | {"settings": {"identification": ident}, "provenance": source})
