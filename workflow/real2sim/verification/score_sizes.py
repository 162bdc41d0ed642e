"""Whether the interval of an effect's parameter holds the truth, where truth and answer state the same quantity."""

from __future__ import annotations

from real2sim.effects.catalogue import EFFECTS
from real2sim.verification.claims import Row

# Quantities that the phantom's equation and that of the catalogue share: effect, name in the truth, name in the answer.
# Not those that the equations share in the limit only, as the stiffness of a side that pulls alone
SAME = {
    "added_mass": {"mass": "mass"},
    "clock_drift": {"rate": "drift"},
    "coulomb": {"friction": "force"},
    "filter_lag": {"cutoff": "cutoff"},
    "joint_limit": {"limit": "place"},
    "lab_yaw": {"yaw": "yaw"},
    "lugre": {"coulomb": "force"},
    "migration": {"threshold": "threshold", "slip_rate": "rate"},
    "preload": {"shift": "rest"},
    "quadratic_damping": {"coefficient": "quadratic"},
    "replay_lag": {"lag": "lag"},
    "slack": {"half_width": "half_width"},
    "stiffening": {"cubic": "cubic"},
    "sync_offset": {"offset": "offset"},
}


# Forms whose equation is that of the truth: the first of each effect, the turn of a rest pose beside its shift, and the
# lab frame that turns the interface with the pelvis
_FORMS = ("", "_turned", "interface")


def held_sizes(row: Row) -> list[bool]:
    """Return whether each interval of a quantity that an equation of the catalogue shares with the truth holds it.

    Of the effects of one case that were made by that equation, named, and answered by that equation.
    """
    if row["answer"]["verdict"] not in row["names"]:
        return []
    causes = {cause["effect"]: cause for cause in row["answer"]["causes"]}
    told = []
    for effect in row["case"]["effects"]:
        name = effect["effect"]
        cause = causes.get(name)
        if effect["form"] == name and cause is not None and _is_by_first_form(cause):
            for key, value in effect["parameters"].items():
                entry = _told(name, key, effect["axes"], cause["parameters"])
                told.append((value, entry.get("ci95")))
    return [bool(ends[0] <= value <= ends[1]) for value, ends in told if ends]


def _is_by_first_form(cause: Row) -> bool:
    shared = {e.equation for e in EFFECTS if e.name == cause["effect"] and e.form in _FORMS}
    return cause["equation"] in shared


def _told(effect: str, key: str, axes: list[str], parameters: Row) -> Row:
    """Return what the answer says of a quantity of the truth, empty where that is nothing."""
    axis = next((a for a in axes if f"_{a}_" in key), None)
    quantity = key.split(f"_{axis}_")[0] if axis else key.rsplit("_", 1)[0]
    name = SAME.get(effect, {}).get(quantity)
    if name is None:
        return {}
    return next(
        (e for k, e in parameters.items() if k.startswith(name) and (axis is None or f"_{axis}_" in k)), {}
    )
