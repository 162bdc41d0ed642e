"""The human digital twin: a simulated person learns to walk, then walks with the robot. `snakemake twin` answers.

Inputs:  subject.yaml, canonical tables of neutral, walk_normal and walk_robot, joint limits, fits and priors, robot twin.
Outputs: results/twin/<SUBJECT>/human.xml, reference.{npz,json}; seed-<N>/policy.{npz,json}, evaluation.json,
         coupled.json; {gait,interface,speed,wrench}.{png,pdf,svg}; results/twin/{bars,gait,interface,walks,wrench,straps}.csv.
Steps:   model from height, mass and sex; a gait that it can walk; one policy per seed; bars; coupled walks under every
         interface; tables and figures. A person without a walk_normal trial has no gait to learn and is left out.
"""

SEEDS = STUDY["twin"]["seeds"]


wildcard_constraints:
    seed=r"\d+",


rule twin:
    """Bars, gait and interface of every twin, and a figure per person."""
    input:
        someone_takes_part(
            "twin",
            TWINS,
            without_twin(),
            "Record walk_normal_1 (docs/twin.md), or set twin.cohort.",
        ),
        "results/twin/bars.csv",
        expand("results/twin/{subject}/human.xml", subject=TWINS),
        expand(
            "results/twin/{subject}/{figure}.png",
            subject=TWINS,
            figure=["gait", "interface", "speed", "wrench"],
        ),


rule twin_human:
    """Skeletal model of a person as MJCF."""
    input:
        person=lambda wildcards: str(PEOPLE[wildcards.subject].folder / "subject.yaml"),
        lock="environment-lock.txt",
    output:
        "results/twin/{subject}/human.xml",
    log:
        "logs/twin/{subject}/human.log",
    benchmark:
        "logs/benchmarks/twin/{subject}/human.tsv"
    conda:
        "../envs/real2sim.yaml"
    threads: 1
    resources:
        mem_mb=600,
        runtime=10,
    params:
        settings=twin_settings("human"),
        content=lambda wildcards: subject_content(wildcards.subject),
        code=code("twin-human"),
    shell:
        "python -m real2sim twin-human --person {input.person:q} --settings {params.settings:q} --out {output:q}"
        " 2>&1 | tee {log:q}"


rule twin_reference:
    """From the walk_normal trials to a gait that the model can walk, and what had to be changed."""
    input:
        person=lambda wildcards: str(PEOPLE[wildcards.subject].folder / "subject.yaml"),
        tables=lambda wildcards: walk_tables(wildcards.subject, "walk_normal", "walk_robot"),
        lock="environment-lock.txt",
    output:
        gait="results/twin/{subject}/reference.npz",
        report="results/twin/{subject}/reference.json",
    log:
        "logs/twin/{subject}/reference.log",
    benchmark:
        "logs/benchmarks/twin/{subject}/reference.tsv"
    priority: LONGEST
    conda:
        "../envs/real2sim.yaml"
    threads: 1
    resources:
        mem_mb=600,
        runtime=10,
    params:
        walks=lambda wildcards: folders_of(wildcards.subject, "walk_normal"),
        assisted=lambda wildcards: given_all("assisted", folders_of(wildcards.subject, "walk_robot")),
        settings=twin_settings("human", "reference"),
        content=lambda wildcards: subject_content(wildcards.subject),
        code=code("twin-reference"),
    shell:
        "python -m real2sim twin-reference --person {input.person:q} --walks {params.walks:q} {params.assisted:q}"
        " --settings {params.settings:q} --out {output.gait:q} --report {output.report:q} 2>&1 | tee {log:q}"


rule twin_train:
    """One policy by reinforcement learning; an interrupted training goes on from its checkpoint."""
    input:
        person=lambda wildcards: str(PEOPLE[wildcards.subject].folder / "subject.yaml"),
        gait="results/twin/{subject}/reference.npz",
        lock="environment-lock.txt",
    output:
        policy="results/twin/{subject}/seed-{seed}/policy.npz",
        record="results/twin/{subject}/seed-{seed}/policy.json",
    log:
        "logs/twin/{subject}/seed-{seed}/train.log",
    benchmark:
        "logs/benchmarks/twin/{subject}/seed-{seed}/train.tsv"
    priority: LONGEST
    conda:
        "../envs/real2sim.yaml"
    threads: 1
    resources:
        mem_mb=600,
        runtime=40,
    params:
        checkpoint="results/twin/{subject}/seed-{seed}/checkpoint.npz",
        settings=twin_settings("human", "training", "evaluation", "acceptance"),
        content=lambda wildcards: subject_content(wildcards.subject),
        code=code("twin-train"),
    shell:
        "python -m real2sim twin-train --person {input.person:q} --reference {input.gait:q} --seed {wildcards.seed}"
        " --settings {params.settings:q} --out {output.policy:q} --record {output.record:q}"
        " --checkpoint {params.checkpoint:q} --threads {threads} 2>&1 | tee {log:q}"


rule twin_evaluate:
    """A policy against every bar of a free walker."""
    input:
        policy="results/twin/{subject}/seed-{seed}/policy.npz",
        record="results/twin/{subject}/seed-{seed}/policy.json",
    output:
        "results/twin/{subject}/seed-{seed}/evaluation.json",
    log:
        "logs/twin/{subject}/seed-{seed}/evaluate.log",
    benchmark:
        "logs/benchmarks/twin/{subject}/seed-{seed}/evaluate.tsv"
    conda:
        "../envs/real2sim.yaml"
    threads: 1
    resources:
        mem_mb=600,
        runtime=20,
    params:
        settings=twin_settings("human", "training", "evaluation", "acceptance"),
        code=code("twin-evaluate"),
    shell:
        "python -m real2sim twin-evaluate --policy {input.policy:q} --record {input.record:q}"
        " --settings {params.settings:q} --out {output:q} --threads {threads} 2>&1 | tee {log:q}"


rule twin_coupled:
    """A policy walks with the robot under every interface, compared with the person's own walks."""
    input:
        policy="results/twin/{subject}/seed-{seed}/policy.npz",
        record="results/twin/{subject}/seed-{seed}/policy.json",
        priors="results/priors/priors.csv",
        fits=full_calibration,
        limits="results/limits/{subject}.json",
        neutral="results/trials/{subject}/neutral/pose.parquet",
        tables=lambda wildcards: walk_tables(wildcards.subject, "walk_normal", "walk_robot"),
        robot=ROBOT,
        study_robot=STUDY["twin"]["study_robot"]["model"],
        gait=f"{PUBLISHED}/table3_gait.csv",
        interface=f"{PUBLISHED}/table2_interface.csv",
    output:
        "results/twin/{subject}/seed-{seed}/coupled.json",
    log:
        "logs/twin/{subject}/seed-{seed}/coupled.log",
    benchmark:
        "logs/benchmarks/twin/{subject}/seed-{seed}/coupled.tsv"
    conda:
        "../envs/real2sim.yaml"
    threads: 1
    resources:
        mem_mb=1500,
        runtime=20,
    params:
        normal=lambda wildcards: folders_of(wildcards.subject, "walk_normal"),
        assisted=lambda wildcards: folders_of(wildcards.subject, "walk_robot"),
        settings=settings_of("twin", "plant", "ingest"),
        robot=ROBOT_CONTENT,
        code=code("twin-coupled"),
    shell:
        "python -m real2sim twin-coupled --policy {input.policy:q} --record {input.record:q} --priors {input.priors:q}"
        " --fits {input.fits:q} --limits {input.limits:q} --neutral {input.neutral:q} --normal {params.normal:q}"
        " --assisted {params.assisted:q} --robot {input.robot:q} --study-robot {input.study_robot:q} --published-gait {input.gait:q}"
        " --published-interface {input.interface:q} --settings {params.settings:q} --out {output:q}"
        " --threads {threads} 2>&1 | tee {log:q}"


rule twin_table:
    """Bars, gait and interface of all twins."""
    input:
        evaluations=expand("results/twin/{subject}/seed-{seed}/evaluation.json", subject=TWINS, seed=SEEDS),
        coupled=expand("results/twin/{subject}/seed-{seed}/coupled.json", subject=TWINS, seed=SEEDS),
    output:
        bars="results/twin/bars.csv",
        gait="results/twin/gait.csv",
        cloud="results/twin/interface.csv",
        walks="results/twin/walks.csv",
        wrench="results/twin/wrench.csv",
        straps="results/twin/straps.csv",
    log:
        "logs/twin/table.log",
    benchmark:
        "logs/benchmarks/twin/table.tsv"
    conda:
        "../envs/real2sim.yaml"
    threads: 1
    resources:
        mem_mb=600,
        runtime=10,
    params:
        code=code("twin-table"),
    shell:
        "python -m real2sim twin-table --evaluations {input.evaluations:q} --coupled {input.coupled:q}"
        " --out-bars {output.bars:q} --out-gait {output.gait:q} --out-cloud {output.cloud:q}"
        " --out-walks {output.walks:q} --out-wrench {output.wrench:q}"
        " --out-straps {output.straps:q} 2>&1 | tee {log:q}"


rule gait_figure:
    """Joint angles over the gait cycle, measured and simulated (paper, Fig. 6)."""
    input:
        coupled=expand("results/twin/{{subject}}/seed-{seed}/coupled.json", seed=SEEDS),
    output:
        multiext("results/twin/{subject}/gait", ".pdf", ".svg"),
        report("results/twin/{subject}/gait.png", caption="../report/gait.rst", category="Validation"),
    log:
        "logs/twin/{subject}/gait_figure.log",
    benchmark:
        "logs/benchmarks/twin/{subject}/gait_figure.tsv"
    conda:
        "../envs/real2sim.yaml"
    threads: 1
    resources:
        mem_mb=600,
        runtime=10,
    params:
        code=code("gait-figure"),
    shell:
        "python -m real2sim gait-figure --coupled {input.coupled:q} --out {output:q} 2>&1 | tee {log:q}"


rule interface_figure:
    """Interface midpoint relative to the pelvis from above, measured and simulated (paper, Fig. 5)."""
    input:
        coupled=expand("results/twin/{{subject}}/seed-{seed}/coupled.json", seed=SEEDS),
    output:
        multiext("results/twin/{subject}/interface", ".pdf", ".svg"),
        report(
            "results/twin/{subject}/interface.png", caption="../report/interface.rst", category="Validation"
        ),
    log:
        "logs/twin/{subject}/interface_figure.log",
    benchmark:
        "logs/benchmarks/twin/{subject}/interface_figure.tsv"
    conda:
        "../envs/real2sim.yaml"
    threads: 1
    resources:
        mem_mb=600,
        runtime=10,
    params:
        code=code("interface-figure"),
    shell:
        "python -m real2sim interface-figure --coupled {input.coupled:q} --out {output:q} 2>&1 | tee {log:q}"


rule speed_figure:
    """Ranges of motion of hip and knee against speed, measured and simulated."""
    input:
        coupled=expand("results/twin/{{subject}}/seed-{seed}/coupled.json", seed=SEEDS),
    output:
        multiext("results/twin/{subject}/speed", ".pdf", ".svg"),
        report("results/twin/{subject}/speed.png", caption="../report/speed.rst", category="Validation"),
    log:
        "logs/twin/{subject}/speed_figure.log",
    benchmark:
        "logs/benchmarks/twin/{subject}/speed_figure.tsv"
    conda:
        "../envs/real2sim.yaml"
    threads: 1
    resources:
        mem_mb=600,
        runtime=10,
    params:
        code=code("speed-figure"),
    shell:
        "python -m real2sim speed-figure --coupled {input.coupled:q} --out {output:q} 2>&1 | tee {log:q}"


rule wrench_figure:
    """Wrench of the strap on the interface over the gait cycle, measured and simulated."""
    input:
        coupled=expand("results/twin/{{subject}}/seed-{seed}/coupled.json", seed=SEEDS),
    output:
        multiext("results/twin/{subject}/wrench", ".pdf", ".svg"),
        report("results/twin/{subject}/wrench.png", caption="../report/wrench.rst", category="Validation"),
    log:
        "logs/twin/{subject}/wrench_figure.log",
    benchmark:
        "logs/benchmarks/twin/{subject}/wrench_figure.tsv"
    conda:
        "../envs/real2sim.yaml"
    threads: 1
    resources:
        mem_mb=600,
        runtime=10,
    params:
        code=code("wrench-figure"),
    shell:
        "python -m real2sim wrench-figure --coupled {input.coupled:q} --out {output:q} 2>&1 | tee {log:q}"


rule twin_clip:
    """A rendered walk with the robot under the prior; needs EGL or OSMesa (MUJOCO_GL) and is asked for by name."""
    input:
        policy=f"results/twin/{{subject}}/seed-{SEEDS[0]}/policy.npz",
        priors="results/priors/priors.csv",
        limits="results/limits/{subject}.json",
        neutral="results/trials/{subject}/neutral/pose.parquet",
        robot=ROBOT,
        study_robot=STUDY["twin"]["study_robot"]["model"],
        tables=lambda wildcards: walk_tables(wildcards.subject, "walk_robot"),
    output:
        "results/twin/{subject}/twin.gif",
    log:
        "logs/twin/{subject}/clip.log",
    benchmark:
        "logs/benchmarks/twin/{subject}/clip.tsv"
    conda:
        "../envs/real2sim.yaml"
    threads: 1
    resources:
        mem_mb=1500,
        runtime=10,
    params:
        assisted=lambda wildcards: folders_of(wildcards.subject, "walk_robot"),
        settings=settings_of("twin", "plant"),
        robot=ROBOT_CONTENT,
        code=code("twin-clip"),
    shell:
        "env -u MUJOCO_GL python -m real2sim twin-clip --backend ${{MUJOCO_GL:-egl}} --policy {input.policy:q} --priors {input.priors:q}"
        " --limits {input.limits:q} --neutral {input.neutral:q} --robot {input.robot:q} --study-robot {input.study_robot:q}"
        " --assisted {params.assisted:q} --settings {params.settings:q}"
        " --out {output:q} 2>&1 | tee {log:q}"
