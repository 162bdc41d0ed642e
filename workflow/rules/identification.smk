"""Identification of the 12 interface parameters, what it is worth, and its transfer to the other trial (III-B, V-B).

Inputs:  canonical tables of the dynamic trials, joint limits, the robot twin.
Outputs: results/plant/<SUBJECT>.json, results/fits/<SUBJECT>/<TRIAL>/restart-<N>.json,
         results/identifiability/<SUBJECT>/<TRIAL>.json, results/noise_floor/<SUBJECT>.json,
         results/cross_trial/<SUBJECT>.json.
Steps:   choose the time step; one job per trial, whose restarts are simulated in one batch and kept in a file each;
         verdict per parameter; noise floor of J; cross-trial replay.
"""


rule step_study:
    """The largest time step that a fine reference cannot tell apart, on a person's first dynamic trial."""
    input:
        unpack(first_dynamic),
        limits="results/limits/{subject}.json",
        robot=ROBOT,
        published=f"{PUBLISHED}/table1_priors.csv",
        lock="environment-lock.txt",
    output:
        "results/plant/{subject}.json",
    log:
        "logs/plant/{subject}.log",
    benchmark:
        "logs/benchmarks/plant/{subject}.tsv"
    conda:
        "../envs/real2sim.yaml"
    threads: 1
    resources:
        mem_mb=600,
        runtime=10,
    params:
        settings=FIT_SETTINGS,
        robot=ROBOT_CONTENT,
        code=code("step-study"),
    shell:
        "python -m real2sim step-study --subject {wildcards.subject} --pose {input.pose:q}"
        " --markers {input.markers:q} --limits {input.limits:q} --robot {input.robot:q}"
        " --published {input.published:q} --settings {params.settings:q} --out {output:q} 2>&1 | tee {log:q}"


rule fit:
    """All CMA-ES restarts on one dynamic trial."""
    input:
        pose="results/trials/{subject}/{trial}/pose.parquet",
        markers="results/trials/{subject}/{trial}/markers.parquet",
        limits="results/limits/{subject}.json",
        step="results/plant/{subject}.json",
        gates=gates_of_fit,
        robot=ROBOT,
        lock="environment-lock.txt",
    output:
        expand("results/fits/{{subject}}/{{trial}}/restart-{restart}.json", restart=RESTARTS),
    log:
        "logs/fits/{subject}/{trial}.log",
    benchmark:
        "logs/benchmarks/fits/{subject}/{trial}.tsv"
    priority: LONGEST
    conda:
        "../envs/real2sim.yaml"
    threads: 1
    resources:
        mem_mb=600,
        runtime=30,
    params:
        restarts=list(RESTARTS),
        settings=FIT_SETTINGS,
        robot=ROBOT_CONTENT,
        code=code("fit"),
    shell:
        "python -m real2sim fit --subject {wildcards.subject} --trial {wildcards.trial} --restarts {params.restarts}"
        " --pose {input.pose:q} --markers {input.markers:q} --limits {input.limits:q} --step {input.step:q}"
        " --gates {input.gates:q} --robot {input.robot:q} --settings {params.settings:q} --threads {threads}"
        " --out {output:q} 2>&1 | tee {log:q}"


rule assessment:
    """What the best restart of a trial determines: verdict per parameter, and what hangs on the robot's constants."""
    input:
        fits=expand("results/fits/{{subject}}/{{trial}}/restart-{restart}.json", restart=RESTARTS),
        pose="results/trials/{subject}/{trial}/pose.parquet",
        markers="results/trials/{subject}/{trial}/markers.parquet",
        neutral="results/trials/{subject}/neutral/quality.json",
        limits="results/limits/{subject}.json",
        step="results/plant/{subject}.json",
        robot=ROBOT,
    output:
        "results/identifiability/{subject}/{trial}.json",
    log:
        "logs/identifiability/{subject}/{trial}.log",
    benchmark:
        "logs/benchmarks/identifiability/{subject}/{trial}.tsv"
    conda:
        "../envs/real2sim.yaml"
    threads: 1
    resources:
        mem_mb=600,
        runtime=10,
    params:
        settings=settings_of("identification", "identifiability", "plant", "robot", "ingest"),
        robot=ROBOT_CONTENT,
        code=code("assessment"),
    shell:
        "python -m real2sim assessment --subject {wildcards.subject} --trial {wildcards.trial}"
        " --fits {input.fits:q} --pose {input.pose:q} --markers {input.markers:q}"
        " --neutral-quality {input.neutral:q} --limits {input.limits:q} --step {input.step:q}"
        " --robot {input.robot:q} --settings {params.settings:q} --out {output:q} 2>&1 | tee {log:q}"


rule noise_floor:
    """How much of J is measurement noise, from the person's neutral trial."""
    input:
        fits=lambda wildcards: fits_of([wildcards.subject]),
        pose="results/trials/{subject}/neutral/pose.parquet",
        markers="results/trials/{subject}/neutral/markers.parquet",
        limits="results/limits/{subject}.json",
        step="results/plant/{subject}.json",
        robot=ROBOT,
    output:
        "results/noise_floor/{subject}.json",
    log:
        "logs/noise_floor/{subject}.log",
    benchmark:
        "logs/benchmarks/noise_floor/{subject}.tsv"
    conda:
        "../envs/real2sim.yaml"
    threads: 1
    resources:
        mem_mb=600,
        runtime=10,
    params:
        settings=settings_of("identification", "identifiability", "plant", "robot"),
        robot=ROBOT_CONTENT,
        code=code("noise-floor"),
    shell:
        "python -m real2sim noise-floor --subject {wildcards.subject} --fits {input.fits:q} --pose {input.pose:q}"
        " --markers {input.markers:q} --limits {input.limits:q} --step {input.step:q} --robot {input.robot:q}"
        " --settings {params.settings:q} --out {output:q} 2>&1 | tee {log:q}"


rule cross_trial:
    """Each trial's best fit, simulated on the person's other trials."""
    input:
        fits=lambda wildcards: fits_of([wildcards.subject]),
        poses=lambda wildcards: poses_of(wildcards.subject, "dynamic"),
        markers=lambda wildcards: markers_of(wildcards.subject, "dynamic"),
        limits="results/limits/{subject}.json",
        step="results/plant/{subject}.json",
        robot=ROBOT,
    output:
        "results/cross_trial/{subject}.json",
    log:
        "logs/cross_trial/{subject}.log",
    benchmark:
        "logs/benchmarks/cross_trial/{subject}.tsv"
    conda:
        "../envs/real2sim.yaml"
    threads: 1
    resources:
        mem_mb=600,
        runtime=10,
    params:
        settings=FIT_SETTINGS,
        robot=ROBOT_CONTENT,
        causes=causes_of,
        code=code("cross-trial"),
    shell:
        "python -m real2sim cross-trial --subject {wildcards.subject} --fits {input.fits:q} --poses {input.poses:q}"
        " --markers {input.markers:q} --limits {input.limits:q} --step {input.step:q} --robot {input.robot:q}"
        " {params.causes:q} --settings {params.settings:q} --out {output:q} 2>&1 | tee {log:q}"
