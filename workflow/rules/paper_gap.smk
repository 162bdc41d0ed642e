"""Which unmodelled effect would have made the paper's numbers? `snakemake paper_gap`; the study does not ask for it.

Inputs:  the phantom's settings (config key `paper_gap`), the robot twin, the study's robot, the paper's tables.
Outputs: results/paper_gap/people/<CAUSE>/<SUBJECT>/ (tables and fits), cohorts/<CAUSE>.json, causes.json, causes.csv.
Steps:   one job per cause and person records the person and fits both dynamic trials; one per cause puts its people
         through the paper's statistics; one compares all cohorts with what the paper prints.
"""


rule paper_gap_person:
    """One person whose gap has one cause: recorded, ingested, both dynamic trials identified with the plain model."""
    input:
        robot=ROBOT,
        recorded=lambda wildcards: recorded_with(wildcards.cause)[0],
        published=f"{PUBLISHED}/cross_trial.csv",
        lock="environment-lock.txt",
    output:
        directory("results/paper_gap/people/{cause}/{subject}"),
    log:
        "logs/paper_gap/people/{cause}/{subject}.log",
    benchmark:
        "logs/benchmarks/paper_gap/people/{cause}/{subject}.tsv"
    conda:
        "../envs/real2sim.yaml"
    threads: 1
    resources:
        mem_mb=1200,
        runtime=30,
    params:
        phantom=lambda wildcards: json.dumps(paper_gap_phantom()),
        controllers=lambda wildcards: recorded_with(wildcards.cause)[1],
        settings=settings_of("ingest", "identification", "plant", "robot", "paper_gap"),
        robot=ROBOT_CONTENT,
        code=code("paper-gap-person"),
    shell:
        "python -m real2sim paper-gap-person --cause {wildcards.cause} --subject {wildcards.subject}"
        " --phantom {params.phantom:q} --recorded-robot {input.recorded:q}"
        " --recorded-controllers {params.controllers:q} --robot {input.robot:q} --published {input.published:q}"
        " --settings {params.settings:q} --out {output:q} 2>&1 | tee {log:q}"


rule paper_gap_cohort:
    """What the paper reports of its cohort, for a cohort whose people all have one cause."""
    input:
        people=people_of_paper_gap,
        robot=ROBOT,
        published=f"{PUBLISHED}/table1_priors.csv",
    output:
        "results/paper_gap/cohorts/{cause}.json",
    log:
        "logs/paper_gap/cohorts/{cause}.log",
    benchmark:
        "logs/benchmarks/paper_gap/cohorts/{cause}.tsv"
    conda:
        "../envs/real2sim.yaml"
    threads: 1
    resources:
        mem_mb=600,
        runtime=10,
    params:
        settings=settings_of("identification", "plant", "robot", "statistics", "paper_gap"),
        robot=ROBOT_CONTENT,
        code=code("paper-gap-cohort"),
    shell:
        "python -m real2sim paper-gap-cohort --cause {wildcards.cause} --people {input.people:q} --robot {input.robot:q}"
        " --published {input.published:q} --settings {params.settings:q} --out {output:q} 2>&1 | tee {log:q}"


rule paper_gap_causes:
    """Causes by how near their cohorts come to what the paper prints, and which of them that cannot tell apart."""
    input:
        cohorts=expand("results/paper_gap/cohorts/{cause}.json", cause=CAUSES),
        published=[f"{PUBLISHED}/{name}.csv" for name in PAPER_GAP_TABLES],
    output:
        record="results/paper_gap/causes.json",
        table="results/paper_gap/causes.csv",
    log:
        "logs/paper_gap/causes.log",
    benchmark:
        "logs/benchmarks/paper_gap/causes.tsv"
    conda:
        "../envs/real2sim.yaml"
    threads: 1
    resources:
        mem_mb=600,
        runtime=10,
    params:
        published=lambda wildcards, input: Path(input.published[0]).parent,
        settings=settings_of("identification", "statistics", "paper_gap"),
        code=code("paper-gap-causes"),
    shell:
        "python -m real2sim paper-gap-causes --cohorts {input.cohorts:q} --published {params.published:q}"
        " --settings {params.settings:q} --out {output.record:q} --table {output.table:q} 2>&1 | tee {log:q}"


rule paper_gap:
    """Which unmodelled effect would have made the paper's numbers?"""
    input:
        rules.paper_gap_causes.output,
