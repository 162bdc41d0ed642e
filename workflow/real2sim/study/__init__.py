"""The paper: tightness, joint limits, identification of a cohort, statistics, priors, digital twin, tables, claims."""
