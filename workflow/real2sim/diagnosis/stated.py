"""The answer that diagnosis.json states: its robot and its probability."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from real2sim.diagnosis.evidence import CONFIGURED


def other_robot(content: Mapping[str, Any]) -> str | None:
    """Return the robot that diagnosis.json finds in the place of the configured one; None where it finds none."""
    machine = content.get("machine")
    return None if machine is None or machine["name"] == CONFIGURED else str(machine["name"])


def answer_probability(content: Mapping[str, Any]) -> float:
    """Return the probability of the answer of diagnosis.json: of a set, that these effects act and no others.

    A single effect, ``none`` and ``unknown`` have their entry in ``probabilities``. Effects that are named beside
    another robot have the probability that they act with that robot.
    """
    names, robot = content.get("verdict_set") or [content["verdict"]], other_robot(content)
    if len(names) > 1 or (robot is not None and names[0] not in ("none", "unknown")):
        # forms and places of the set together; each entry counts for the likelier initial state and its robot alone
        same = [row["probability"] for row in content["considered"] if set(row["effects"]) == set(names)]
        under_other = float((content.get("otherwise") or {}).get("named_probability", 0.0))
        probability = float(sum(p or 0.0 for p in same)) + under_other
    else:
        probability = float(content["probabilities"][content["verdict"]])
    # averaging over robots leaves out those that were not searched to the end
    return probability if robot is None else min(probability, float(content["machine"]["probability"]))
