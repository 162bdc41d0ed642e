"""Whether the interval of an effect's parameter holds the truth, where truth and answer state the same quantity."""

from __future__ import annotations

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


def held_sizes(row: Row) -> list[bool]:
    """Return whether each interval of a quantity that an equation of the catalogue shares with the truth holds it.

    Of the effects of one case that were named, in the form that they were made with and on the axes that they act on.
    """
    out = []
    for effect in row["case"]["effects"]:
        if effect["form"] != effect["effect"]:
            # another equation: its numbers mean something else
            continue
        cause = next((c for c in row["answer"]["causes"] if c["effect"] == effect["effect"]), None)
        if cause is not None and row["answer"]["verdict"] in row["names"]:
            for key, value in effect["parameters"].items():
                entry = _told(effect["effect"], key, effect["axes"], cause["parameters"])
                if entry is not None and "ci95" in entry:
                    low, high = entry["ci95"]
                    out.append(bool(low <= value <= high))
    return out


def _told(effect: str, key: str, axes: list[str], parameters: Row) -> Row | None:
    """Return what the answer says of a quantity of the truth; None where it says nothing of it, or in another form."""
    axis = next((a for a in axes if f"_{a}_" in f"{key}_"), None)
    quantity = key.split(f"_{axis}_")[0] if axis else key.rsplit("_", 1)[0]
    name = SAME.get(effect, {}).get(quantity)
    if name is None:
        return None
    for told, entry in parameters.items():
        rest = told.removeprefix(name)
        place = rest.strip("_").split("_")
        on_axis = axis in place if axis else len(place) == 1
        if rest != told and on_axis and not {"soft", "scaled", "two"} & set(place):
            return dict(entry)
    return None
