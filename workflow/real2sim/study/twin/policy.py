"""A trained policy as a file: weights and reference in an .npz, what it rests on in a JSON beside it."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from real2sim.errors import InputError
from real2sim.files import replacing
from real2sim.study.twin.env import ACTIONS, OBSERVATIONS
from real2sim.study.twin.gait import Reference, Speeds
from real2sim.study.twin.human import Body
from real2sim.study.twin.ppo import Layers, Normaliser, flat, forward, layers_of


@dataclass
class Policy:
    """Deterministic policy: normalised observation in, action out; with the gait and the body it was trained for."""

    actor: Layers
    mean: np.ndarray
    variance: np.ndarray
    reference: Reference
    body: Body

    def __post_init__(self) -> None:
        self._normaliser = Normaliser(self.mean, self.variance)

    def __call__(self, obs: np.ndarray) -> np.ndarray:
        """Actions (m, 13) for observations (m, OBSERVATIONS)."""
        return forward(self.actor, self._normaliser(obs))[-1].astype(float)


def save_reference(path: Path, reference: Reference) -> None:
    """Write a reference as .npz."""
    measured = {f"measured_{k}": v for k, v in reference.measured.items()}
    _write(path, _reference_arrays(reference) | measured)


def _write(path: Path, arrays: dict[str, np.ndarray]) -> None:
    with replacing(path) as temporary, temporary.open("wb") as stream:
        np.savez(stream, allow_pickle=False, **arrays)


def _reference_arrays(reference: Reference) -> dict[str, np.ndarray]:
    return {
        "qpos": reference.qpos,
        "qvel": reference.qvel,
        "torque": reference.torque,
        "stride_s": np.array(reference.stride_s),
        "speed": np.array(reference.speed),
        **_speeds_arrays(reference.speeds),
    }


def _speeds_arrays(speeds: Speeds | None) -> dict[str, np.ndarray]:
    if speeds is None:
        return {}
    # single precision: a tenth of a micrometre, and half the file
    table = speeds.table.astype(np.float32)
    return {"speeds_shares": speeds.shares, "speeds_table": table, "speeds_stride_s": speeds.stride_s}


def _reference(arrays: dict[str, np.ndarray]) -> Reference:
    measured = {k.removeprefix("measured_"): arrays[k] for k in arrays if k.startswith("measured_")}
    return Reference(
        arrays["qpos"],
        arrays["qvel"],
        arrays["torque"],
        float(arrays["stride_s"]),
        float(arrays["speed"]),
        measured,
        speeds=_speeds(arrays),
    )


def _speeds(arrays: dict[str, np.ndarray]) -> Speeds | None:
    if "speeds_shares" not in arrays:
        return None
    table = arrays["speeds_table"].astype(float)
    return Speeds(arrays["speeds_shares"], table, arrays["speeds_stride_s"])


def load_reference(path: Path) -> Reference:
    """Read what `save_reference` wrote."""
    with np.load(path, allow_pickle=False) as arrays:
        return _reference(dict(arrays))


def save_policy(path: Path, policy: Policy) -> None:
    """Write a policy as .npz, weights in single precision, the same bytes for the same policy."""
    weights: dict[str, np.ndarray] = {
        f"actor_{i}": a.astype(np.float32) for i, a in enumerate(flat(policy.actor))
    }
    who = policy.body
    _write(
        path,
        {
            **weights,
            "mean": policy.mean,
            "variance": policy.variance,
            "body": np.array([who.height_m, who.mass_kg]),
            "sex": np.array(who.sex),
            **_reference_arrays(policy.reference),
        },
    )


def load_policy(path: Path) -> Policy:
    """Read a policy; raises InputError where the file is none, or one for other observations."""
    try:
        with np.load(path, allow_pickle=False) as stream:
            arrays = dict(stream)
        count = sum(name.startswith("actor_") for name in arrays)
        actor = layers_of([arrays[f"actor_{i}"] for i in range(count)])
        body = Body(float(arrays["body"][0]), float(arrays["body"][1]), str(arrays["sex"]))
        policy = Policy(actor, arrays["mean"], arrays["variance"], _reference(arrays), body)
    except (OSError, ValueError, KeyError) as error:
        raise InputError(
            path, "", str(error), "a policy of `real2sim twin-train`", "Delete the file and run again."
        ) from error
    if actor[0][0].shape[0] != OBSERVATIONS or actor[-1][0].shape[1] != ACTIONS:
        raise InputError(
            path,
            "",
            f"{actor[0][0].shape[0]} observations, {actor[-1][0].shape[1]} actions",
            f"{OBSERVATIONS} and {ACTIONS}",
            "Train the policy again with this version.",
        )
    return policy
