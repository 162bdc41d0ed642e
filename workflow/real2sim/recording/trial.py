"""A dynamic trial as the identification sees it: measured paths, masks, start pose and cost."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pyarrow.parquet as pq

from real2sim.artefacts import read_json
from real2sim.errors import InputError
from real2sim.geometry import INTERFACE_MARKERS, PELVIS_MARKERS, mean_rotation, rotation_matrix
from real2sim.inference.cost import CostScales, TrialCost
from real2sim.recording.start_window import EXPECTED, REMEDY, find_start_problem
from real2sim.system.plant import JointLimits, RestPose
from real2sim.system.replay import Replay

if TYPE_CHECKING:
    from real2sim.settings import IdentificationSettings, Settings


@dataclass(frozen=True)
class Trial:
    """Measured paths of one trial on the common clock.

    ``time_s`` (n,), ``pelvis_rotation`` (n, 3, 3) and ``pelvis_position`` (n, 3) [m, world], ``interface``
    (n, 2, 3) markers left, right [m, world], ``start_rotation`` (3, 3) and ``start_position`` (3,) of the
    interface, all NaN where masked; ``usable`` (n,) marks samples that count in the cost; ``pelvis_markers``
    (n, 4, 3) are the filtered markers behind the pelvis pose [m, world].
    """

    time_s: np.ndarray
    pelvis_rotation: np.ndarray
    pelvis_position: np.ndarray
    interface: np.ndarray
    start_rotation: np.ndarray
    start_position: np.ndarray
    usable: np.ndarray
    rest: RestPose
    phantom: bool
    pelvis_markers: np.ndarray


def load_trial(pose: Path, markers: Path, settings: IdentificationSettings) -> Trial:
    """Read a trial's canonical tables.

    Parameters
    ----------
    pose, markers
        The trial's pose.parquet and markers.parquet, as `ingest.ingest_trial` writes them.
    settings
        Slice ``identification`` of the configuration: ``start_window_s``, over which the start pose is averaged,
        ``start_known_share``, and ``settle_after_gap_s``, for which the cost stays masked after a gap of the pelvis:
        what was bridged has to die away.

    Raises
    ------
    InputError
        Where the start is masked, so that the robot's start pose is unknown.
    """
    table = pq.read_table(pose)
    meta = json.loads(table.schema.metadata[b"real2sim"])
    columns = {name: table[name].to_numpy() for name in table.column_names}
    raw = pq.read_table(markers)
    time_s = columns["time_s"]

    def stack(body: str, parts: str) -> np.ndarray:
        return np.column_stack([columns[f"{body}_{part}"] for part in parts.split()])

    pelvis_rotation = rotation_matrix(stack("pelvis", "qw qx qy qz"))

    def paths(names: tuple[str, ...]) -> np.ndarray:
        return np.stack([np.column_stack([raw[f"{m}_{c}"].to_numpy() for c in "xyz"]) for m in names], axis=1)

    interface, start_window_s = paths(INTERFACE_MARKERS), settings["start_window_s"]
    window = time_s - time_s[0] < start_window_s
    quat, position = stack("interface", "qw qx qy qz"), stack("interface", "x y z")
    measured = np.isfinite(quat).all(axis=1) & np.isfinite(position).all(axis=1)
    pelvis_measured = np.isfinite(pelvis_rotation).all(axis=(1, 2))
    _, wrong = find_start_problem(
        time_s, measured, pelvis_measured, start_window_s, settings["start_known_share"]
    )
    if wrong:
        raise InputError(pose, f"first {start_window_s} s", wrong, EXPECTED, REMEDY)
    quat, position = quat[window & measured], position[window & measured]
    return Trial(
        time_s,
        pelvis_rotation,
        stack("pelvis", "x y z"),
        interface,
        mean_rotation(rotation_matrix(quat)),
        position.mean(axis=0),
        usable(pelvis_measured, 1 / (time_s[1] - time_s[0]), settings["settle_after_gap_s"]),
        RestPose(np.array(meta["rest"]["rotation"]), np.array(meta["rest"]["position"])),
        bool(meta.get("phantom", False)),
        paths(PELVIS_MARKERS),
    )


def usable(measured: np.ndarray, rate_hz: float, settle_s: float) -> np.ndarray:
    """Samples (n,) that count in the cost where the pelvis is ``measured``, a while after each gap left out [s]."""
    out = measured.copy()
    for end in np.flatnonzero(~measured[:-1] & measured[1:]) + 1:
        out[end : end + round(settle_s * rate_hz)] = False
    return out


def load_limits(path: Path) -> JointLimits:
    """Read joint limits written by `real2sim.study.limits`."""
    content = read_json(path, ("q_min", "q_max"))
    return JointLimits(np.array(content["q_min"], float), np.array(content["q_max"], float))


def with_step(settings: Settings, step: Path) -> Settings:
    """Settings whose ``plant.timestep_s`` is the one that a person's step study chose."""
    chosen = read_json(step, ("timestep_s",))["timestep_s"]
    return {**settings, "plant": {**settings["plant"], "timestep_s": chosen}}


@dataclass
class TrialModel:
    """A trial bound to its plant: parameters in, cost out."""

    trial: Trial
    replay: Replay
    cost: TrialCost
    limits: JointLimits | None

    def costs(self, parameters: np.ndarray) -> np.ndarray:
        """J (m,) of parameters (m, 12), as many at once as the replay holds."""
        n = self.replay.nsim
        parts = [parameters[i : i + n] for i in range(0, len(parameters), n)]
        return np.concatenate([self.cost(self.replay.run(part)).total for part in parts])


def replay_inputs(
    trial: Trial, limits: JointLimits | None, robot: Path, settings: Settings
) -> dict[str, Any]:
    """Return the arguments of a trial for any `Replay`; ``settings`` has the slices ``plant`` and ``robot``."""
    return {
        "robot": robot,
        "robot_settings": settings["robot"],
        "plant_settings": settings["plant"],
        "time_s": trial.time_s,
        "pelvis_rotation": trial.pelvis_rotation,
        "pelvis_position": trial.pelvis_position,
        "start_rotation": trial.start_rotation,
        "start_position": trial.start_position,
        "rest": trial.rest,
        "limits": limits,
    }


def replay_of(
    trial: Trial,
    limits: JointLimits | None,
    robot: Path,
    settings: Settings,
    *,
    nsim: int,
    scale: dict[str, float] | None = None,
    threads: int = 1,
) -> Replay:
    """Replay of a trial, see `replay_inputs`; the rest is as in `Replay`."""
    return Replay(**replay_inputs(trial, limits, robot, settings), nsim=nsim, scale=scale, threads=threads)


def trial_model(
    *,
    pose: Path,
    markers: Path,
    limits: Path,
    robot: Path,
    settings: Settings,
    nsim: int,
    threads: int = 1,
) -> TrialModel:
    """Prepare a trial for replays of at most ``nsim`` simulations a call, on ``threads`` threads.

    ``settings`` has the slices ``identification``, ``plant`` and ``robot``.
    """
    ident = settings["identification"]
    trial = load_trial(pose, markers, ident)
    joint_limits = load_limits(limits)
    try:
        replay = replay_of(trial, joint_limits, robot, settings, nsim=nsim, threads=threads)
    except ValueError as error:
        raise InputError(
            pose, "", str(error), "a trial that the plant can replay", "See docs/troubleshooting.md."
        ) from error
    scales = CostScales(ident["scales"]["position_m"], ident["scales"]["velocity_m_per_s"])
    rate = 1 / float(trial.time_s[1] - trial.time_s[0])
    cost = TrialCost(trial.interface, rate, scales, trial.usable)
    return TrialModel(trial, replay, cost, joint_limits)
