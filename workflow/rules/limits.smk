"""Joint limits of the interface (paper, section III-B, first stage).

Inputs:  pose.parquet of neutral, and of rotation and translation at T*.
Outputs: results/limits/<SUBJECT>.json.
Steps:   smallest and largest value of each interface coordinate.
"""


rule joint_limits:
    """q_min and q_max of one person."""
    input:
        rotation=lambda wildcards: operating_point(wildcards, "rotation"),
        translation=lambda wildcards: operating_point(wildcards, "translation"),
        neutral="results/trials/{subject}/neutral/pose.parquet",
    output:
        "results/limits/{subject}.json",
    log:
        "logs/limits/{subject}.log",
    benchmark:
        "logs/benchmarks/limits/{subject}.tsv"
    conda:
        "../envs/real2sim.yaml"
    threads: 1
    resources:
        mem_mb=600,
        runtime=10,
    params:
        code=code("joint-limits"),
    shell:
        "python -m real2sim joint-limits --subject {wildcards.subject} --rotation {input.rotation:q}"
        " --translation {input.translation:q} --neutral {input.neutral:q} --out {output:q} 2>&1 | tee {log:q}"
