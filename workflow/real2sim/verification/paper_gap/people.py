"""One person of a cohort with one cause: recorded, ingested and fitted as a person of the study is."""

from __future__ import annotations

import contextlib
import copy
import io
import math
import sys
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any

import mujoco
import numpy as np

from real2sim.artefacts import number, read_json, read_table, write_json
from real2sim.errors import InputError
from real2sim.files import write_text
from real2sim.recording.ingest import ingest_subject
from real2sim.study.fit import fit_trial
from real2sim.verification.cohort.write import Simulated, simulate_subject, write_trials
from real2sim.verification.paper_gap.plan import STUDY_ROBOT, TRIALS
from real2sim.verification.paper_gap.recorder import Recorder
from real2sim.verification.suite.plan import EFFECTS

if TYPE_CHECKING:
    from real2sim.settings import Settings

LIMITS, STEP, PERSON, ROBOT = "limits.json", "step.json", "person.json", "robot.xml"
DYNAMIC = TRIALS[1:]
# Sizes that are tried side by side, each half of the one above
_SIZES = 6
# J grows with about this power of the size of an effect, and of a motion
_POWER = 2.0
_TRIES = 3
# Share of the J wanted below which no size between two that cost so little costs enough
_FAR = 0.25
# ln of J: nearer to what is wanted, a size is taken; a last correction is made beyond
_NEAR_LN = 0.1


def restart_files(folder: Path, trial: str, restarts: int) -> list[Path]:
    """Return the files of the fits of a trial below a person's folder."""
    return [folder / "fits" / trial / f"restart-{i + 1}.json" for i in range(restarts)]


def known_robot(folder: Path, robot: Path) -> Path:
    """Return the robot that the analysis of a person knows: one of their own, or that of everyone."""
    return folder / ROBOT if (folder / ROBOT).exists() else robot


def as_wide_as(recorded: Path, robot: Path, out: Path) -> None:
    """Write a robot whose strap is fixed where that of another one is: what markers show of a robot before it moves."""
    spec, other = mujoco.MjSpec.from_file(str(robot)), mujoco.MjSpec.from_file(str(recorded))
    for name in ("interface_left", "interface_right"):
        spec.site(name).pos = other.site(name).pos
    own, wanted = (sum(s.body(name).pos[2] for name in ("base", "arm", "interface")) for s in (spec, other))
    spec.body("arm").pos[2] += wanted - own
    spec.compile()
    write_text(out, spec.to_xml())


def published_j(source: Path) -> float:
    """Return the paper's J of a fit to its own trial, of cross_trial.csv."""
    rows = {row["quantity"]: number(row["value"]) for row in read_table(source, ("quantity", "value"))}
    return rows["J_within_mean"]


def person_with_cause(
    *,
    cause: str,
    subject: str,
    phantom: dict[str, Any],
    recorded_robot: Path,
    recorded_controllers: dict[str, Any],
    robot: Path,
    published: Path,
    settings: Settings,
    out: Path,
) -> None:
    """Record a synthetic person whose gap has one cause, and identify both dynamic trials with the plain model.

    Parameters
    ----------
    cause
        One of `plan.CAUSES`.
    phantom
        Checked settings of the phantom that the person is of.
    recorded_robot, recorded_controllers
        MJCF and controllers of the robot that holds the strap in the recordings.
    robot
        MJCF of the robot that the analysis knows.
    published
        cross_trial.csv of the paper: its J is what the plain fits have to cost, on average of both trials.
    settings
        Slices ``ingest``, ``identification``, ``plant``, ``robot`` and ``paper_gap`` of the configuration; ``method``
        and ``restarts`` of the last one stand before those of ``identification``.
    out
        Folder: ``trials``, ``fits``, limits.json (the strap's true range: nobody sweeps here), step.json, and
        person.json with the sealed cause, or with the reason why the recordings cannot be analysed. The study's
        robot has no size: how wide the person moves is chosen so that the fits cost that J. The analysis knows where
        the strap is fixed to it (robot.xml), and not how it moves.
    """
    if cause == STUDY_ROBOT:
        as_wide_as(recorded_robot, robot, out / ROBOT)
    analysis = Analysis(phantom, recorded_robot, known_robot(out, robot), settings)
    about = {"schema": 1, "phantom": True, "cause": cause, "subject": subject}
    recorded = _Recorded(phantom, recorded_controllers, recorded_robot, subject)
    wanted = published_j(published)
    try:
        if cause in EFFECTS:
            recorder = Recorder(cause, subject, phantom, recorded_controllers, recorded_robot)
            size = _size_for(wanted, recorder, analysis)
            sealed = recorder.truth(_record_and_fit(wanted, size, recorder, analysis, out))
        else:
            sealed = _without_effect(wanted, recorded, analysis, out, tuned=cause == STUDY_ROBOT)
    except InputError as error:
        # a cause may be so large that no recording with it would be analysed: that is an answer about the cause
        reason = f"{error.place or error.path.name}: {error.found}"
        write_json(out / PERSON, about | {"status": reason, "sealed": {}})
    else:
        write_json(out / PERSON, about | {"status": "ok", "sealed": sealed})


@dataclass(frozen=True)
class _Recorded:
    """A person without an effect, before the recording: settings of the phantom, controllers and MJCF of the robot."""

    phantom: dict[str, Any]
    controllers: dict[str, Any]
    robot: Path
    subject: str

    def simulate(self, motion: float) -> Simulated:
        """Return the trials, the dynamic motion ``motion`` times as wide."""
        settings = with_motion(self.phantom, motion)
        return simulate_subject(settings, self.controllers, self.robot, self.subject, TRIALS)


def _without_effect(
    wanted: float,
    recorded: _Recorded,
    analysis: Analysis,
    out: Path,
    *,
    tuned: bool,
) -> dict[str, Any]:
    """Record and fit a person without an effect; where ``tuned``, moving so widely that the fits cost ``wanted``."""
    share, restarts = 1.0, analysis.settings["paper_gap"]["restarts"]
    for tried in range(1, _TRIES + 1):
        j = analysis.fit(recorded.simulate(share), out, restarts)
        print(f"  motion {share:.3g}: J {j:.3g}", file=sys.stderr, flush=True)
        off = math.log(wanted / j)
        if not tuned or abs(off) < _NEAR_LN or tried == _TRIES:
            break
        share *= math.exp(off / _POWER)
    return {"motion_share": share}


def with_motion(phantom: dict[str, Any], share: float) -> dict[str, Any]:
    """Return settings of a phantom whose dynamic motion is ``share`` times as wide."""
    settings = copy.deepcopy(phantom)
    task = settings["motions"]["dynamic"]
    task["targets"] = [[share * value for value in pose] for pose in task["targets"]]
    for sway in task["sway"]:
        sway["pose"] = [share * value for value in sway["pose"]]
    return settings


@dataclass(frozen=True)
class Analysis:
    """The way from recordings to fits: the study's own steps, without a look at the cause."""

    phantom: dict[str, Any]
    recorded_robot: Path
    robot: Path
    settings: Settings

    def fit(self, simulated: Simulated, out: Path, restarts: int) -> float:
        """Write raw exports, canonical tables and fits of both dynamic trials; return the mean of their best J."""
        person, options = simulated.person, self.settings["paper_gap"]
        with TemporaryDirectory() as raw:
            folder = Path(raw) / person.name
            write_trials(folder, self.phantom, self.recorded_robot, simulated)
            files = sorted(path for path in folder.iterdir() if path.name != "subject.yaml")
            with contextlib.redirect_stdout(io.StringIO()):
                ingest_subject(
                    subject=person.name,
                    folder=folder,
                    settings=self.settings["ingest"],
                    raw=files,
                    out=out / "trials",
                )
        lower, upper = person.stops[person.operating_level]
        limits = {"schema": 1, "phantom": True, "q_min": lower.tolist(), "q_max": upper.tolist()}
        write_json(out / LIMITS, limits)
        try:
            return self._fit_trials(person.name, out, restarts, options["timestep_s"])
        except InputError:
            # a jerky pelvis asks for a finer step, as the study's own step study would choose
            return self._fit_trials(person.name, out, restarts, options["timestep_s"] / 2)

    def _fit_trials(self, subject: str, out: Path, restarts: int, step_s: float) -> float:
        write_json(out / STEP, {"schema": 1, "timestep_s": step_s})
        return float(np.mean([self._fit_trial(subject, trial, out, restarts) for trial in DYNAMIC]))

    def _fit_trial(self, subject: str, trial: str, out: Path, restarts: int) -> float:
        tables, files = out / "trials" / trial, restart_files(out, trial, restarts)
        identification = self.settings["identification"].copy()
        identification["method"] = self.settings["paper_gap"]["method"]
        identification["restarts"] = restarts
        fit_trial(
            subject=subject,
            trial=trial,
            restarts=[i + 1 for i in range(restarts)],
            pose=tables / "pose.parquet",
            markers=tables / "markers.parquet",
            limits=out / LIMITS,
            step=out / STEP,
            robot=self.robot,
            settings={**self.settings, "identification": identification},
            out=files,
        )
        return min(float(read_json(path)["cost"]["J"]) for path in files)


def _size_for(wanted: float, recorder: Recorder, analysis: Analysis) -> float:
    """Return the size at which a plain fit costs ``wanted``, of the first draw that can.

    Where none can, the size of the costliest fit. By coarse simulations, one restart, between sizes that are half as
    large as the next.
    """
    options = analysis.settings["paper_gap"]
    sizes = min(options["largest"], recorder.most_severe) * 0.5 ** np.arange(_SIZES)[::-1]
    best = (0.0, float(sizes[0]))
    for _ in range(options["draws"]):
        recorder.draw()
        cost = _Costs(sizes, recorder.record(sizes.tolist()), analysis)
        low = _bracket(wanted, cost, sizes)
        if low is not None:
            return _between(wanted, sizes, low, cost)
        reached = [(j, float(sizes[i])) for i, j in cost.known.items() if math.isfinite(j)]
        best = max([*reached, best])
    if best[0] == 0.0:
        raise InputError(
            analysis.recorded_robot,
            "recordings",
            "no recording with this effect that can be simulated and analysed",
            "one",
            "Lower paper_gap.largest.",
        )
    return best[1]


@dataclass(frozen=True)
class _Costs:
    """J of a plain fit by the index of the size, each fitted when it is first asked for.

    Infinite where there is none, because nothing could be simulated or analysed.
    """

    sizes: np.ndarray
    recorded: list[Simulated | None]
    analysis: Analysis
    known: dict[int, float] = field(default_factory=dict)

    def __call__(self, i: int) -> float:
        if i not in self.known:
            self.known[i] = self._fitted(self.recorded[i])
            print(f"  size {self.sizes[i]:.3g}: J {self.known[i]:.3g}", file=sys.stderr, flush=True)
        return self.known[i]

    def _fitted(self, simulated: Simulated | None) -> float:
        if simulated is None:
            return math.inf
        with TemporaryDirectory() as work:
            try:
                return self.analysis.fit(simulated, Path(work), 1)
            except InputError:
                return math.inf


def _bracket(wanted: float, cost: Callable[[int], float], sizes: np.ndarray) -> int | None:
    """Return i where ``wanted`` lies between the costs of sizes i and i + 1; None where it does not.

    The search begins at the size that is nearest to 1. Where that and the largest cost far too little, no other is
    tried.
    """
    i, last = int(np.argmin(np.abs(np.log(sizes)))), len(sizes) - 1
    if max(cost(i), cost(last)) < _FAR * wanted:
        return None
    while i > 0 and cost(i) > wanted:
        i -= 1
    while i < last and cost(i + 1) < wanted:
        i += 1
    inside = i < last and cost(i) <= wanted <= cost(i + 1)
    return i if inside and math.isfinite(cost(i + 1)) else None


def _between(wanted: float, sizes: np.ndarray, low: int, cost: Callable[[int], float]) -> float:
    """Return the size between ``low`` and the next one, by a power law."""
    power = math.log(cost(low + 1) / cost(low)) / math.log(sizes[low + 1] / sizes[low])
    return float(sizes[low] * (wanted / cost(low)) ** (1 / power))


def _record_and_fit(wanted: float, size: float, recorder: Recorder, analysis: Analysis, out: Path) -> float:
    """Write a person's tables and fits by a fine simulation, once more where J is off; return the size.

    Where the fine simulation is unstable the size is halved: the recordings then cost less than ``wanted``.
    """
    restarts = analysis.settings["paper_gap"]["restarts"]
    for _ in range(_SIZES):
        j = _fine(size, recorder, analysis, out, restarts)
        if math.isfinite(j):
            break
        size /= 2
    else:
        raise InputError(out, f"size {size:.3g}", "no stable simulation", "one", "Lower paper_gap.largest.")
    off = math.log(wanted / j)
    largest = min(analysis.settings["paper_gap"]["largest"], recorder.most_severe)
    if abs(off) < _NEAR_LN or j < _FAR * wanted or (off > 0 and size >= largest):
        return size
    again = min(size * math.exp(off / _POWER), largest)
    if math.isfinite(_fine(again, recorder, analysis, out, restarts)):
        return again
    return size


def _fine(size: float, recorder: Recorder, analysis: Analysis, out: Path, restarts: int) -> float:
    """Return J of the fits to recordings by a fine simulation; infinite, and nothing written, where it is unstable."""
    simulated = recorder.record([size], fine=True)[0]
    j = math.inf if simulated is None else analysis.fit(simulated, out, restarts)
    print(f"  size {size:.3g}, fine: J {j:.3g}", file=sys.stderr, flush=True)
    return j
