"""Batches of simulations whose steps are not timed."""

from __future__ import annotations

import mujoco
from mujoco.batch import Batch


def untimed_batch(model: mujoco.MjModel, nsim: int, threads: int, persistent: bool = False) -> Batch:
    """`mujoco.batch.Batch` of a model, stepped without MuJoCo's profiler.

    The Python bindings install a clock for the profiler, which each step reads time and again: a quarter of a step
    of the plant, a third and more of one of the robot alone (`benchmarks/engine.py`). Nothing here reads the profile.
    ``MjData.timer`` stays zero from then on in the whole process, and callbacks that others have set are taken away.
    """
    mujoco.mj_resetCallbacks()
    return Batch(model, nsim, threads, persistent)
