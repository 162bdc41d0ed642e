"""Is the time step of a described system fine enough for what its recording determines?"""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING, cast

import numpy as np

from real2sim.diagnosis.intervals import least_sd
from real2sim.diagnosis.refit import Hypothesis, JointResiduals
from real2sim.diagnosis.search import Pair, Search
from real2sim.recording.formats.recordings import Finding

if TYPE_CHECKING:
    from real2sim.diagnosis.system_evidence import SystemEvidence
    from real2sim.settings import DiagnosisSettings


def step_findings(pair: Pair, plain: Hypothesis, settings: DiagnosisSettings) -> Iterator[Finding]:
    """Yield a warning where half the time step would move a parameter of the plain fit by more than its interval bears.

    ``pair`` holds recordings of a described system, ``settings`` is the slice ``diagnosis``. The move is that of one
    Gauss-Newton step, in units of the SD that the parameter's interval is made of (`parameter_verdicts`).
    """
    evidence, system, z = cast("SystemEvidence", pair.train), pair.system, plain.base
    excess = 1 + max(Search(pair, settings["search"]).above_by_trial(plain)[0], 0.0) / evidence.samples
    most_sd, least = settings["described"]["channels"]["step_sd"], least_sd(system, z, settings["report"])
    problem = JointResiduals(evidence, (), system)
    free = problem.free
    _, jacobian = problem.with_jacobian(z, free)
    changed = evidence.changed_by_half_the_step(system.values(z))
    rows = jacobian[: len(changed)]
    if not (len(free) and np.isfinite(changed).all() and np.isfinite(rows).all()):
        return
    # in units of their SD; those that the recording does not determine have none to speak of
    scale = np.maximum(np.linalg.norm(rows, axis=0), 1e-12)
    curvature = (rows / scale).T @ (rows / scale)
    covariance = np.linalg.pinv(curvature, rcond=1e-8)
    sd = np.hypot(np.sqrt(np.diag(covariance) * excess) / scale, least[free])
    moved = covariance @ (rows / scale).T @ changed / scale / sd
    worst = int(np.argmax(np.abs(moved)))
    if abs(moved[worst]) > most_sd:
        step = evidence.simulated.base_step_s
        yield Finding(
            "step_coarse",
            "warning",
            evidence.name,
            system.parameter_names[free[worst]],
            f"half the time step ({step / 2:.4g} s) would move it by {abs(moved[worst]):.2g} standard deviations",
            "Used as it is: intervals do not know of that. Lower step_s of the system.",
        )
