"""Batches of simulations whose steps are not timed, and which say nothing of those that diverge."""

from __future__ import annotations

import re
import sys
from functools import cache

import mujoco
from mujoco.batch import Batch

# What MuJoCo says of a simulation with values that it does not bear
_UNBEARABLE = ("simulation is unstable", "Inertia matrix is too close to singular")
# Warnings that this process has shown
_SAID: set[str] = set()


def untimed_batch(model: mujoco.MjModel, nsim: int, threads: int, persistent: bool = False) -> Batch:
    """Return a `mujoco.batch.Batch` of a model, stepped without MuJoCo's profiler.

    The Python bindings install a clock for the profiler, which each step reads time and again: a quarter of a step
    of the plant, a third and more of one of the robot alone (`benchmarks/engine.py`). Nothing here reads the profile.
    ``MjData.timer`` stays zero from the first batch on in the whole process, and callbacks that others set before it
    are taken away. A search tries values that no simulation bears, and what diverged is NaN to it: MuJoCo's line on
    each of them, on the screen and in a MUJOCO_LOG.TXT wherever the user happens to be, is not written. Other warnings
    go to stderr.

    The constraints of a model of one kinematic tree are not divided into islands: there is one at most, and looking for
    it takes 7 % of a step of the walking person (`benchmarks/islands.py`). The results are the same bits.
    """
    if model.ntree == 1:
        model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_ISLAND)
    _silence()
    return Batch(model, nsim, threads, persistent)


@cache
def _silence() -> None:
    """Take the clock away and ask for warnings, once: other threads may be within a simulation later on."""
    mujoco.mj_resetCallbacks()
    mujoco.set_mju_user_warning(_warn)


def _warn(text: str) -> None:
    # places and times differ from one to the next
    kind = re.sub(r"-?\d[\d.e+-]*", "", text)
    if kind in _SAID or any(said in text for said in _UNBEARABLE):
        return
    _SAID.add(kind)
    print(f"MuJoCo: {text} (said once; more of the same are not shown)", file=sys.stderr, flush=True)
