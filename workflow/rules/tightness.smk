"""Tightness: allowable motion at each level, its breakpoint and the operating point (paper, section III-A).

Inputs:  pose.parquet of the rotation and translation trials.
Outputs: results/tightness/<SUBJECT>/{sweep.csv,breakpoints.json}, results/tightness/cohort.json.
Steps:   ranges per level; two-segment regression with a test that the breakpoint exists; cohort.
"""


rule tightness:
    """Allowable rotation and translation at each tightness level of one person, its breakpoints, the operating point."""
    input:
        poses=lambda wildcards: poses_of(wildcards.subject, "rotation", "translation"),
        subject=lambda wildcards: str(PEOPLE[wildcards.subject].folder / "subject.yaml"),
    output:
        sweep="results/tightness/{subject}/sweep.csv",
        breakpoints="results/tightness/{subject}/breakpoints.json",
    log:
        "logs/tightness/{subject}.log",
    benchmark:
        "logs/benchmarks/tightness/{subject}.tsv"
    conda:
        "../envs/real2sim.yaml"
    threads: 1
    resources:
        mem_mb=600,
        runtime=10,
    params:
        settings=settings_of("tightness"),
        content=lambda wildcards: subject_content(wildcards.subject),
        code=[code("tightness-sweep"), code("tightness-breakpoints")],
    shell:
        "(python -m real2sim tightness-sweep --subject {wildcards.subject} --poses {input.poses:q}"
        " --subject-yaml {input.subject:q} --out {output.sweep:q}"
        " && python -m real2sim tightness-breakpoints --subject {wildcards.subject} --sweep {output.sweep:q}"
        " --subject-yaml {input.subject:q} --settings {params.settings:q} --out {output.breakpoints:q})"
        " 2>&1 | tee {log:q}"


rule tightness_cohort:
    """Pooled regressions and operating points of all people."""
    input:
        sweeps=expand("results/tightness/{subject}/sweep.csv", subject=PEOPLE),
        breakpoints=expand("results/tightness/{subject}/breakpoints.json", subject=PEOPLE),
    output:
        "results/tightness/cohort.json",
    log:
        "logs/tightness/cohort.log",
    benchmark:
        "logs/benchmarks/tightness/cohort.tsv"
    conda:
        "../envs/real2sim.yaml"
    threads: 1
    resources:
        mem_mb=600,
        runtime=10,
    params:
        settings=settings_of("tightness"),
        code=code("tightness-cohort"),
    shell:
        "python -m real2sim tightness-cohort --sweeps {input.sweeps:q} --breakpoints {input.breakpoints:q}"
        " --settings {params.settings:q} --out {output:q} 2>&1 | tee {log:q}"
