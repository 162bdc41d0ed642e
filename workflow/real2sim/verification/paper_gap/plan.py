"""Which cohorts are compared with the paper. Light imports: the Snakefile reads this."""

from __future__ import annotations

from real2sim.verification.suite.plan import EFFECTS

NOTHING, STUDY_ROBOT = "nothing", "study_robot"
# nothing unmodelled; each effect of the catalogue; recordings with the study's robot, analysed with the assumed one
CAUSES = (NOTHING, *EFFECTS, STUDY_ROBOT)
TRIALS = ("neutral", "dynamic_1", "dynamic_2")
