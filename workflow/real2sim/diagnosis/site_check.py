"""Check that the interface's markers sit at the sites that a description names, not at each other's."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import combinations

import mujoco
import numpy as np

from real2sim.errors import InputError
from real2sim.geometry import relative_pose
from real2sim.system.described_plant import Anchor, plant_of
from real2sim.system.description import System
from real2sim.system.kinematics import Sample, Solver, rigid_pose, segment_frame
from real2sim.system.plant import RestPose

# Distance of markers from their sites, as a share of the sites' spread, from which on exchanges are tried; and the
# share of it that an exchange must leave to be taken for the reason
_FAR, _MUCH_NEARER = 0.2, 0.25


def check_sites(
    system: System,
    places: np.ndarray,
    segment: np.ndarray,
    interface: np.ndarray,
    logged: Mapping[str, float],
) -> None:
    """Refuse a description in which two sites of the interface are exchanged.

    Parameters
    ----------
    places
        Where the sites are on the interface's body (k, 3) [m], in the order of the interface's markers.
    segment, interface
        Markers (j, 3) and (k, 3) of a person at rest [m, world]; interface markers that were not seen are NaN.
    logged
        Positions of the logged joints at the same time [m, rad].

    Raises InputError (`site_sides`) where the machine as logged has its sites far from the markers, and the exchange of
    two of them brings them there. A machine of which too little is logged fits either way, and is not refused.
    """
    if not (np.isfinite(segment).all() and np.isfinite(interface).all()):
        return
    spread = float(np.sqrt(((places - places.mean(axis=0)) ** 2).sum(axis=1).mean()))
    names = list((system.markers.sites or {}).values())
    misfit = _misfit(system, places, names, segment, interface, logged)
    if misfit <= _FAR * spread:
        return
    pairs = list(combinations(range(len(names)), 2))
    after = [_misfit(system, *_exchanged(places, names, *pair), segment, interface, logged) for pair in pairs]
    best = int(np.argmin(after))
    if after[best] > _MUCH_NEARER * misfit:
        return
    first, second = (names[i] for i in pairs[best])
    distances = f"{1000 * misfit:.0f} mm from their sites at rest, {1000 * after[best]:.0f} mm"
    found = f"markers {distances} with the two exchanged"
    markers = ", ".join(f"{marker}: {site}" for marker, site in (system.markers.sites or {}).items())
    expected = f"each marker at its site ({markers})"
    remedy = "Exchange the two under markers.interface.sites, or their names in the MJCF."
    raise InputError(system.model, f"sites {first}, {second}", found, expected, remedy, "site_sides")


def _exchanged(places: np.ndarray, names: list[str], first: int, second: int) -> tuple[np.ndarray, list[str]]:
    order = np.arange(len(names))
    order[[first, second]] = second, first
    return places[order], [names[i] for i in order]


def _misfit(
    system: System,
    places: np.ndarray,
    sites: list[str],
    segment: np.ndarray,
    interface: np.ndarray,
    logged: Mapping[str, float],
) -> float:
    """Return the RMS distance [m] of markers from their sites, the machine posed by segment, markers and log."""
    rotation, position = segment_frame(system, segment[None])
    relative = relative_pose(rotation, position, *rigid_pose(places, interface[None]))
    anchor = Anchor(places.mean(axis=0), RestPose(relative[0][0], relative[1][0]))
    model = plant_of(system, system.step_s, anchor, RestPose(rotation[0], position[0])).compile()
    data = mujoco.MjData(model)
    sample = Sample(dict(logged), rotation[0], position[0], interface)
    data.qpos[:] = Solver(model, sites).solve(sample, model.qpos0.copy())
    mujoco.mj_kinematics(model, data)
    away = np.array([data.site(name).xpos for name in sites]) - interface
    return float(np.sqrt((away**2).sum(axis=1).mean()))
