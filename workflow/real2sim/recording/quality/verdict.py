"""Verdicts of the gates: pass, warn, refuse; what holds a refused trial back from a fit, and the mark if overridden."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from real2sim.artefacts import read_json
from real2sim.errors import InputError

PASS, WARN, REFUSE = "pass", "warn", "refuse"
_RANK = {PASS: 0, WARN: 1, REFUSE: 2}


@dataclass(frozen=True)
class Gate:
    """One gate of one trial. ``value`` is None where there was nothing to measure; ``threshold`` [warn, refuse]."""

    gate: str
    verdict: str
    value: float | None
    unit: str
    threshold: list[float] | None
    message: str
    remedy: str
    interval: list[float] | None = None
    key: str = ""


def worst(verdicts: Iterable[str]) -> str:
    """The gravest of some verdicts; pass if there are none."""
    return max(verdicts, key=_RANK.__getitem__, default=PASS)


def by_size(value: float, threshold: list[float]) -> str:
    """Verdict of a figure by [warn, refuse]: upper limits, or lower limits where refuse is below warn."""
    warn, refuse = threshold
    sign = 1 if refuse >= warn else -1
    if sign * value >= sign * refuse:
        return REFUSE
    return WARN if sign * value >= sign * warn else PASS


def sized_gate(
    gate: str,
    value: float | None,
    unit: str,
    settings: Mapping[str, Any] | None,
    message: str,
    remedy: str,
    *,
    verdict: str | None = None,
    interval: list[float] | None = None,
    key: str = "",
) -> Gate:
    """Return a gate with its thresholds, judged by the size of ``value`` unless ``verdict`` says otherwise.

    ``settings`` is the slice ``quality`` of the configuration, None for a gate without thresholds; ``key`` is the
    gate's name there where it differs. Nothing measured (None, not finite) passes.
    """
    key = key or gate
    threshold = [float(settings[key]["warn"]), float(settings[key]["refuse"])] if settings else None
    if value is not None and not np.isfinite(value):
        value = None
    if verdict is None:
        verdict = PASS if value is None or threshold is None else by_size(value, threshold)
    return Gate(
        gate, verdict, value, unit, threshold, message, remedy, interval, f"quality.{key}" if settings else ""
    )


def require(gates: Sequence[Path], trial: str) -> dict[str, list[str]]:
    """Return the gates that refuse a fit's trials but are overridden in the configuration, by trial.

    Parameters
    ----------
    gates
        results/quality/<SUBJECT>/<TRIAL>.json of the fitted trial and of those that its fit rests on (neutral: rest
        pose; rotation and translation at T*: joint limits).
    trial
        Name of the fitted trial.

    Returns
    -------
    {"S01/dynamic_1": ["excitation"]}; empty if none refuses. Results carry it as ``overridden_gates``.

    Raises
    ------
    InputError
        With the gate's message and remedy if one of the trials is refused.
    """
    contents = {path: read_json(path, ("subject", "trial", "refused", "override")) for path in gates}
    for path, content in contents.items():
        if content["trial"] != path.stem:
            remedy = "Delete the file and run again."
            raise InputError(path, "key trial", str(content["trial"]), path.stem, remedy)
    if trial not in {path.stem for path in gates}:
        raise ValueError(f"no gates of {trial} in {', '.join(map(str, gates))}")
    out = {}
    for path, content in contents.items():
        if content["refused"] and content["override"] is None:
            raise _refusal(path, content)
        if content["refused"]:
            out[f"{content['subject']}/{content['trial']}"] = [gate["gate"] for gate in content["refused"]]
    return out


def held_back(gates: Sequence[Path]) -> dict[str, list[str]]:
    """Names of the gates that refuse trials and are not overridden: {"S01/dynamic_1": ["spikes"]}.

    For what goes on without a refused trial and says so, where `require` would stop. ``gates`` as there.
    """
    contents = [read_json(path, ("subject", "trial", "refused", "override")) for path in gates]
    return {
        f"{content['subject']}/{content['trial']}": [gate["gate"] for gate in content["refused"]]
        for content in contents
        if content["refused"] and content["override"] is None
    }


def refused_gates(gates: Sequence[Path]) -> dict[str, list[str]]:
    """Names of the gates that refuse trials, overridden or not: {"S01/dynamic_1": ["spikes"]}.

    For what explains a recording rather than rests on it. ``gates`` as in `require`.
    """
    contents = [read_json(path, ("subject", "trial", "refused")) for path in gates]
    return {
        f"{content['subject']}/{content['trial']}": [gate["gate"] for gate in content["refused"]]
        for content in contents
        if content["refused"]
    }


def _refusal(path: Path, content: dict[str, Any]) -> InputError:
    first, *others = content["refused"]
    more = f" (and {len(others)} more: {', '.join(g['gate'] for g in others)})" if others else ""
    remedy = (
        f"{first['remedy']} Or exclude the trial in subject.yaml, or accept it by name: "
        f'quality.override: {{"{content["subject"]}/{content["trial"]}": "<reason>"}}'
    )
    place, expected = f"gate {first['gate']}", "a trial that passes its gates"
    return InputError(path, place, first["message"] + more, expected, remedy)


def overridden_gates(records: Iterable[Mapping[str, Any]]) -> dict[str, list[str]]:
    """Union of ``overridden_gates`` of fits, or of what was made of fits: the mark of whatever rests on them."""
    found: dict[str, set[str]] = {}
    for record in records:
        for trial, gates in record.get("overridden_gates", {}).items():
            found.setdefault(trial, set()).update(gates)
    return {trial: sorted(found[trial]) for trial in sorted(found)}


def overridden_trials(records: Iterable[Mapping[str, Any]]) -> str:
    """The trials of `overridden_gates` as a table cell: ``S01/dynamic_1 S02/neutral``."""
    return " ".join(overridden_gates(records))
