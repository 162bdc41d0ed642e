"""What a fit is worth: verdicts, the bias of a noisy input, and what hangs on the robot's assumed constants."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import TYPE_CHECKING, cast

import numpy as np

from real2sim.artefacts import read_json, write_json, write_table
from real2sim.geometry import PELVIS_MARKERS, pelvis_frame
from real2sim.inference.identifiability import AT_BOUND, Assessment, NoiseTerms, assess
from real2sim.inference.parameters import PARAMETERS, Bounds, as_vector, unit
from real2sim.provenance import fingerprint
from real2sim.recording.quality.verdict import overridden_gates, overridden_trials
from real2sim.recording.trial import Trial, TrialModel, replay_of, trial_model, with_step
from real2sim.signals import lowpass, white_sd_at
from real2sim.study.fit import best_of
from real2sim.system.plant import INERTIAL_CONSTANTS
from real2sim.system.replay import Replay

if TYPE_CHECKING:
    from real2sim.settings import IngestSettings, RobotSettings, Settings

# Slice ``robot`` of the configuration: group of joints, axis, stiffness and damping
Controllers = dict[str, dict[str, dict[str, float]]]


def with_pelvis_noise(
    trial: Trial, noise_m: np.ndarray, settings: IngestSettings, rng: np.random.Generator
) -> Trial:
    """Return a trial whose pelvis markers carry more noise: white, through the pipeline's own low-pass.

    ``noise_m`` (4,) [m] is its SD at the rate of the trial.
    """
    rate = 1 / float(trial.time_s[1] - trial.time_s[0])
    white = noise_m[:, None] * rng.standard_normal(trial.pelvis_markers.shape)
    smooth = lowpass(white.reshape(len(white), -1), rate, settings["cutoff_hz"], settings["filter_order"])
    noisy = trial.pelvis_markers + smooth.reshape(white.shape)
    r_0, p_0 = pelvis_frame(*np.moveaxis(trial.pelvis_markers, 1, 0))
    r_1, p_1 = pelvis_frame(*np.moveaxis(noisy, 1, 0))
    turn = np.nan_to_num(r_1 @ np.swapaxes(r_0, 1, 2), nan=0.0)
    turn[~np.isfinite(r_0).all(axis=(1, 2))] = np.eye(3)
    shift = np.nan_to_num(p_1 - p_0, nan=0.0)
    return dataclasses.replace(
        trial,
        pelvis_rotation=turn @ trial.pelvis_rotation,
        pelvis_position=trial.pelvis_position + shift,
    )


class InputNoise:
    """Simulated contribution of noise of the replayed pelvis to the cost of a trial.

    Parameters
    ----------
    model
        The trial.
    noise_m
        (4,) SD [m] of the white noise of the pelvis markers before the low-pass, at the rate of the trial.
    robot, settings
        MJCF and the slices ``identifiability``, ``ingest``, ``plant`` and ``robot`` of the configuration.
    """

    def __init__(self, model: TrialModel, noise_m: np.ndarray, *, robot: Path, settings: Settings):
        options = settings["identifiability"]
        rng = np.random.default_rng(options["seed"])
        trials = [
            with_pelvis_noise(model.trial, noise_m, settings["ingest"], rng)
            for _ in range(options["bias_draws"])
        ]
        self._model, self._step = model, options["bias_step_ln"]
        nsim = model.replay.nsim
        self._noisy = [replay_of(trial, model.limits, robot, settings, nsim=nsim) for trial in trials]

    def _residuals(self, replay: Replay, points: np.ndarray) -> np.ndarray:
        parts = [np.exp(points[i : i + replay.nsim]) for i in range(0, len(points), replay.nsim)]
        return np.concatenate([self._model.cost.residuals(replay.run(part)) for part in parts])

    def __call__(self, z: np.ndarray) -> NoiseTerms:
        """Return the terms at ln-parameters z (12,): means over the draws of the noise."""
        points = np.vstack([z, z + self._step * np.eye(12)])
        clean = self._residuals(self._model.replay, points)
        score, curvature = np.zeros(12), np.zeros((12, 12))
        for replay in self._noisy:
            response = self._residuals(replay, points) - clean
            change = ((response[1:] - response[0]) / self._step).T
            score += change.T @ response[0]
            curvature += change.T @ change
        return NoiseTerms(score / len(self._noisy), curvature / len(self._noisy))


def robot_sensitivity(
    model: TrialModel,
    parameters: np.ndarray,
    jacobian: np.ndarray,
    free: np.ndarray,
    *,
    robot: Path,
    settings: Settings,
) -> dict[str, dict[str, float]]:
    """Return how far each parameter moves, in per cent, if an assumed constant of the robot is 10 % larger.

    ``parameters`` (12,) [SI], ``jacobian`` (n_r, 12) of residuals by ln-parameters, ``free`` (k,) indices. To first
    order: -(GᵀG)^-1 Gᵀ dr, with dr the central difference of the residuals over the constant. Constants are the
    controllers' stiffness and damping and the inertias of the twin. Parameters at a bound are left out, and those
    beside whose fit the simulation fails.
    """
    free = free[np.isfinite(jacobian[:, free]).all(axis=0)]
    gain = np.linalg.pinv(jacobian[:, free], rcond=1e-8)
    controllers: Controllers = dict(cast(Controllers, settings["robot"]))
    constants = [
        (f"{group}.{axis}.{kind}", group, axis, kind)
        for group, axes in controllers.items()
        for axis in axes
        for kind in ("stiffness", "damping")
    ]
    out: dict[str, dict[str, float]] = {}

    def residual(changed: Controllers, scale: dict[str, float] | None) -> np.ndarray:
        replay = replay_of(
            model.trial,
            model.limits,
            robot,
            {**settings, "robot": cast("RobotSettings", changed)},
            nsim=1,
            scale=scale,
        )
        return np.asarray(model.cost.residuals(replay.run(parameters[None]))[0])

    def changed_controller(group: str, axis: str, kind: str, factor: float) -> Controllers:
        own = controllers[group]
        one = own[axis] | {kind: own[axis][kind] * factor}
        return controllers | {group: own | {axis: one}}

    def moved(up: np.ndarray, down: np.ndarray) -> dict[str, float]:
        change = -gain @ (up - down) / 2
        return {PARAMETERS[i]: round(100 * float(np.expm1(c)), 3) for i, c in zip(free, change, strict=True)}

    for name, group, axis, kind in constants:
        up, down = (residual(changed_controller(group, axis, kind, f), None) for f in (1.1, 1 / 1.1))
        out[name] = moved(up, down)
    for name in INERTIAL_CONSTANTS:
        up, down = (residual(controllers, {name: f}) for f in (1.1, 1 / 1.1))
        out[name] = moved(up, down)
    return out


def assess_model(
    model: TrialModel,
    parameters: np.ndarray,
    bounds: Bounds,
    noise_m: np.ndarray | None,
    *,
    robot: Path,
    settings: Settings,
    fitted: np.ndarray | None = None,
) -> Assessment:
    """Return verdicts on a fit (12,) of a trial, with intervals corrected for the noise of the input.

    ``settings`` has the slices ``identification``, ``identifiability``, ``plant``, ``robot`` and ``ingest``;
    ``fitted`` lists the indices of the parameters that were fitted, all by default;
    ``noise_m`` (4,) is the SD of the pelvis markers' white noise [m], None if it is not known.
    """
    rate = 1 / float(model.trial.time_s[1] - model.trial.time_s[0])
    result = assess(
        lambda p: model.cost.residuals(model.replay.run(p)),
        parameters,
        model.cost.sample_of_residual(),
        bounds,
        batch=model.replay.nsim,
        rate_hz=rate,
        settings=settings["identifiability"],
        noise=None if noise_m is None else InputNoise(model, noise_m, robot=robot, settings=settings),
        fitted=fitted,
    )
    result["input_noise_m"] = None if noise_m is None else noise_m.tolist()
    return result


def pelvis_marker_noise(quality: Path, rate_hz: float) -> np.ndarray | None:
    """Return the SD (4,) [m] at ``rate_hz`` of the pelvis markers' white noise, None if one is not known.

    ``quality`` is a trial's quality.json. The ingest estimates the noise by second differences of the raw export, at
    the rate of the cameras and before the low-pass. The diagnosis uses `recording.noise.marker_noise` instead: the
    power of the filtered markers between 3 and 7 Hz, which holds also where the lab's own software has filtered the
    export.
    """
    known = read_json(quality, ("markers", "markers_rate_hz"))
    axes = [known["markers"].get(name, {}).get("noise_sd_m") for name in PELVIS_MARKERS]
    if any(sd is None or None in sd for sd in axes):
        return None
    raw = np.asarray(np.sqrt(np.mean(np.square(axes), axis=1)))
    return white_sd_at(raw, known["markers_rate_hz"], rate_hz)


def assessment(
    *,
    subject: str,
    trial: str,
    fits: list[Path],
    pose: Path,
    markers: Path,
    neutral_quality: Path,
    limits: Path,
    step: Path,
    robot: Path,
    settings: Settings,
    out: Path,
) -> None:
    """Assess the best restart of one trial and write what it determines.

    ``fits`` are the trial's restarts, ``neutral_quality`` the quality.json of the person's neutral trial, from which
    the noise of the pelvis markers is taken, ``step`` the person's step study.
    """
    records = [read_json(path, ("restart", "parameters", "cost")) for path in fits]
    best = best_of(records)
    settings = with_step(settings, step)
    model = trial_model(pose=pose, markers=markers, limits=limits, robot=robot, settings=settings, nsim=13)
    noise_m = pelvis_marker_noise(neutral_quality, settings["ingest"]["rate_hz"])
    bounds = Bounds.from_config(settings["identification"]["bounds"])
    result = assess_model(
        model, as_vector(best["parameters"]), bounds, noise_m, robot=robot, settings=settings
    )
    jacobian = result["jacobian"]
    free = [i for i, name in enumerate(PARAMETERS) if result["parameters"][name]["verdict"] != AT_BOUND]
    refined = np.array([result["parameters"][name]["value"] for name in PARAMETERS])
    write_json(
        out,
        {
            "schema": 1,
            "subject": subject,
            "trial": trial,
            "restart": best["restart"],
            # the verdicts are on this point after least squares: how far that is from the fit must stay known
            "fitted": best["parameters"],
            "phantom": model.trial.phantom,
            "overridden_gates": overridden_gates(records),
            **{key: value for key, value in result.items() if key != "jacobian"},
            "robot_sensitivity_percent_per_10_percent": robot_sensitivity(
                model, refined, jacobian, np.array(free), robot=robot, settings=settings
            ),
            "settings": settings["identifiability"],
            "provenance": {"code_fingerprint": fingerprint(__name__)},
        },
    )


TABLE_COLUMNS = (
    "subject",
    "trial",
    "parameter",
    "unit",
    "value",
    "fitted",
    "ci95_low",
    "ci95_high",
    "sd_ln",
    "bias_ln",
    "verdict",
    "reason",
    "next_trial",
    "most_sensitive_to",
    "change_percent_per_10_percent",
    "overridden",
    "phantom",
)


def assessment_table(*, assessments: list[Path], out: Path) -> None:
    """Write one row per person, trial and parameter: value, interval, verdict, reason and what would help [SI].

    ``value`` is the assessed one, after least squares from the best fit; ``fitted`` is that of the best fit itself.
    """
    rows = []
    for path in assessments:
        record = read_json(
            path, ("subject", "trial", "fitted", "parameters", "robot_sensitivity_percent_per_10_percent")
        )
        sensitivity = record["robot_sensitivity_percent_per_10_percent"]
        for name in PARAMETERS:
            row = record["parameters"][name]
            low, high = row["ci95"]
            known = {constant: moved[name] for constant, moved in sensitivity.items() if name in moved}
            constant = max(known, key=lambda c: abs(known[c])) if known else None
            rows.append(
                {
                    "subject": record["subject"],
                    "trial": record["trial"],
                    "parameter": name,
                    "unit": unit(name),
                    "fitted": record["fitted"][name],
                    "ci95_low": low,
                    "ci95_high": high,
                    "most_sensitive_to": constant,
                    "change_percent_per_10_percent": known.get(constant) if constant else None,
                    "overridden": overridden_trials([record]),
                    "phantom": record["phantom"],
                    **{
                        key: row[key]
                        for key in ("value", "sd_ln", "bias_ln", "verdict", "reason", "next_trial")
                    },
                }
            )
    write_table(out, TABLE_COLUMNS, rows)
