"""Which unmodelled effect causes the sim-to-real gap of a person. `snakemake diagnosis` answers for everyone who can be.

Inputs:  canonical tables of neutral and of two dynamic trials and their gates, the robot twin; joint limits and step
         study where the sweeps at T* were recorded.
Outputs: results/diagnosis/<SUBJECT>/diagnosis.json, traces.parquet, diagnosis.html, model.xml, model.json,
         model_replay.csv; results/diagnosis/diagnosis.csv.
Steps:   fit the first dynamic trial, with and without every effect of the catalogue; judge on the second, and on every
         further one (the trial that an answer proposed); the diagnosed model as MJCF; page; table.
         A person with one dynamic trial has none to be judged on and is left out. A trial that a gate refuses is
         diagnosed all the same (what the gate saw may be the cause), and the answer names the gate.
"""

DIAGNOSED = [name for name, person in PEOPLE.items() if len(person.trials_of("dynamic")) >= 2]
# Whom the report tells of: everyone, or the unseen people and those who were asked for
REPORTED = [
    name
    for name in DIAGNOSED
    if STUDY["diagnosed"] == "everyone"
    or PEOPLE[name].cohort == "validation"
    or Path(f"results/diagnosis/{name}/diagnosis.json").exists()
]
# Calibration people among them: the paper's tables are made once more with their causes
EXPLAINED = [name for name in CALIBRATION if name in REPORTED]
# How often such answers are right, by scored suites (benchmarks/ship_validation.py)
VALIDATION_RECORDS = sorted(str(path) for path in Path("resources/validation").glob("*.json"))
# People at a time are faster than threads for one; where there are fewer people than cores, the rest of them helps
DIAGNOSIS_THREADS = max(1, min(4, (workflow.resource_settings.cores or 1) // max(1, len(DIAGNOSED))))

DIAGNOSES = [
    "results/diagnosis/diagnosis.csv",
    *(f"results/diagnosis/{name}/{file}" for name in DIAGNOSED for file in ("diagnosis.html", "model.xml")),
]


rule diagnosis:
    """The answer for everyone with two dynamic trials, and the table of all."""
    input:
        DIAGNOSES,
        someone_takes_part(
            "diagnosis",
            DIAGNOSED,
            {
                name: f"{'one' if person.trials_of('dynamic') else 'no'} dynamic trial, and it takes two"
                for name, person in PEOPLE.items()
                if name not in DIAGNOSED
            },
            "Record dynamic_1 and dynamic_2, another regime (docs/diagnosis.md).",
        ),


rule diagnose:
    """Where the gap lies, which effect causes it and how far it shrinks, for one person."""
    input:
        train=lambda wildcards: diagnosed_trials(wildcards)[0],
        held_out=lambda wildcards: diagnosed_trials(wildcards)[1],
        further=lambda wildcards: diagnosed_trials(wildcards)[2:],
        neutral="results/trials/{subject}/neutral/markers.parquet",
        gates=lambda wildcards: [
            f"results/quality/{wildcards.subject}/{trial}.json"
            for trial in ("neutral", *PEOPLE[wildcards.subject].trials_of("dynamic"))
        ],
        limits=lambda wildcards: where_limits_are_known(wildcards, "limits"),
        step=lambda wildcards: where_limits_are_known(wildcards, "plant"),
        robot=ROBOT,
        robots=models_of_other_robots,
        lock="environment-lock.txt",
    output:
        answer="results/diagnosis/{subject}/diagnosis.json",
        traces="results/diagnosis/{subject}/traces.parquet",
    log:
        "logs/diagnosis/{subject}.log",
    benchmark:
        "logs/benchmarks/diagnosis/{subject}.tsv"
    conda:
        "../envs/real2sim.yaml"
    threads: DIAGNOSIS_THREADS
    resources:
        mem_mb=1800,  # two trials of 30 s take 0.7 GB, and up to 1.3 GB beside friction or in steps of 1 ms
        runtime=30,
    params:
        train=lambda wildcards, input: Path(input.train).parent,
        held_out=lambda wildcards, input: Path(input.held_out).parent,
        further=lambda wildcards: further_of(wildcards.subject),
        neutral=lambda wildcards, input: Path(input.neutral).parent,
        known=lambda wildcards, input: given(limits=input.limits, step=input.step),
        settings=DIAGNOSIS_SETTINGS,
        robots=lambda wildcards: json.dumps(other_robots()),
        robot=lambda wildcards: content_of_robots(),
        code=code("diagnose"),
    shell:
        "python -m real2sim diagnose --subject {wildcards.subject} --train {params.train:q}"
        " --held-out {params.held_out:q} {params.further:q} --neutral {params.neutral:q} --gates {input.gates:q} {params.known:q}"
        " --robot {input.robot:q} --robots {params.robots:q} --settings {params.settings:q} --out {output.answer:q}"
        " --traces {output.traces:q} --threads {threads}"
        " 2>&1 | tee {log:q}"


rule diagnosis_model:
    """The diagnosed model as an MJCF for the next simulation, and what of the diagnosis is no part of it."""
    input:
        answer="results/diagnosis/{subject}/diagnosis.json",
        trials=lambda wildcards: explained_poses(wildcards.subject),
        neutral="results/trials/{subject}/neutral/markers.parquet",
        limits=lambda wildcards: where_limits_are_known(wildcards, "limits"),
        robot=ROBOT,
        lock="environment-lock.txt",
    output:
        model="results/diagnosis/{subject}/model.xml",
        notes="results/diagnosis/{subject}/model.json",
        replay="results/diagnosis/{subject}/model_replay.csv",
    log:
        "logs/diagnosis/{subject}_model.log",
    benchmark:
        "logs/benchmarks/diagnosis/{subject}_model.tsv"
    conda:
        "../envs/real2sim.yaml"
    threads: 1
    resources:
        mem_mb=800,
        runtime=10,
    params:
        trials=lambda wildcards, input: [Path(pose).parent for pose in input.trials],
        neutral=lambda wildcards, input: Path(input.neutral).parent,
        known=lambda wildcards, input: given(limits=input.limits),
        robot=ROBOT_CONTENT,
        code=code("diagnosis-model"),
    shell:
        "python -m real2sim diagnosis-model --diagnosis {input.answer:q} --trials {params.trials:q}"
        " --neutral {params.neutral:q} {params.known:q} --robot {input.robot:q} --out {output.model:q}"
        " --notes {output.notes:q} --replay {output.replay:q} 2>&1 | tee {log:q}"


rule diagnosis_page:
    """One page per person: where, which, how far, and the next trial."""
    input:
        answer="results/diagnosis/{subject}/diagnosis.json",
        traces="results/diagnosis/{subject}/traces.parquet",
        # the page links to it
        model="results/diagnosis/{subject}/model.xml",
    output:
        "results/diagnosis/{subject}/diagnosis.html",
    log:
        "logs/diagnosis/{subject}_page.log",
    benchmark:
        "logs/benchmarks/diagnosis/{subject}_page.tsv"
    conda:
        "../envs/real2sim.yaml"
    threads: 1
    resources:
        mem_mb=600,
        runtime=10,
    params:
        code=code("diagnosis-page"),
    shell:
        "python -m real2sim diagnosis-page --diagnosis {input.answer:q} --traces {input.traces:q} --out {output:q} 2>&1"
        " | tee {log:q}"


rule diagnosis_table:
    """All answers of the cohort."""
    input:
        answers=expand("results/diagnosis/{subject}/diagnosis.json", subject=DIAGNOSED),
    output:
        "results/diagnosis/diagnosis.csv",
    log:
        "logs/diagnosis/table.log",
    benchmark:
        "logs/benchmarks/diagnosis/table.tsv"
    conda:
        "../envs/real2sim.yaml"
    threads: 1
    resources:
        mem_mb=600,
        runtime=10,
    params:
        code=code("diagnosis-table"),
    shell:
        "python -m real2sim diagnosis-table --diagnoses {input.answers:q} --out {output:q} 2>&1 | tee {log:q}"
