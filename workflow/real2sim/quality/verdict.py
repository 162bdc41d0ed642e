"""Verdicts of the gates: pass, warn, refuse; and the check that holds a refused trial back from a fit."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

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


def require(gates: Path, trial: str) -> list[str]:
    """Names of the gates that refuse a trial but are overridden in the configuration; empty if none refuses.

    ``gates`` is results/quality/<SUBJECT>/<TRIAL>.json. Raises InputError with the gate's message and remedy if
    the trial is refused.
    """
    content: dict[str, Any] = read_json(gates, ("subject", "trial", "refused", "override"))
    if content["trial"] != trial:
        remedy = "Delete the file and run again."
        raise InputError(gates, "key trial", str(content["trial"]), trial, remedy)
    refused = content["refused"]
    if content["override"] is not None or not refused:
        return [gate["gate"] for gate in refused]
    first = refused[0]
    name = f"{content['subject']}/{trial}"
    more = (
        f" (and {len(refused) - 1} more: {', '.join(g['gate'] for g in refused[1:])})" if refused[1:] else ""
    )
    remedy = (
        f"{first['remedy']} Or exclude the trial in subject.yaml, or accept it by name: "
        f'quality.override: {{"{name}": "<reason>"}}'
    )
    raise InputError(
        gates, f"gate {first['gate']}", first["message"] + more, "a trial that passes its gates", remedy
    )
