"""Motion that can be watched in Foxglove: `snakemake motion` writes one file per fitted trial.

Inputs:  canonical tables and fits of the dynamic trials, joint limits, step study, the robot twin.
Outputs: results/motion/<SUBJECT>/<TRIAL>.mcap; results/motion/<SUBJECT>/clip.gif.
Steps:   replay the best fit of a trial once more and write it beside what was measured; a short clip per person. Nothing of
         the study asks for them.
"""

WATCHED = [
    name
    for name, person in PEOPLE.items()
    if person.has_limits and person.trials_of("dynamic") and is_fitted(name)
]


rule motion:
    """All fitted trials, and a clip per person."""
    input:
        someone_takes_part(
            "motion",
            WATCHED,
            {name: why_not_watched(name) for name in PEOPLE if name not in WATCHED},
            "It needs a dynamic trial and the sweeps at T* (config/README.md).",
        ),
        [
            f"results/motion/{name}/{trial}.mcap"
            for name in WATCHED
            for trial in PEOPLE[name].trials_of("dynamic")
        ],
        expand("results/motion/{subject}/clip.gif", subject=WATCHED),


rule motion_file:
    """Measured and simulated interface, pelvis, robot, strap forces and residuals of one trial."""
    input:
        fits=expand("results/fits/{{subject}}/{{trial}}/restart-{restart}.json", restart=RESTARTS),
        pose="results/trials/{subject}/{trial}/pose.parquet",
        markers="results/trials/{subject}/{trial}/markers.parquet",
        robot_log="results/trials/{subject}/{trial}/robot.parquet",
        limits="results/limits/{subject}.json",
        step="results/plant/{subject}.json",
        robot=ROBOT,
    output:
        "results/motion/{subject}/{trial}.mcap",
    log:
        "logs/motion/{subject}/{trial}.log",
    benchmark:
        "logs/benchmarks/motion/{subject}/{trial}.tsv"
    conda:
        "../envs/real2sim.yaml"
    threads: 1
    resources:
        mem_mb=600,
        runtime=10,
    params:
        settings=FIT_SETTINGS,
        robot=ROBOT_CONTENT,
        code=code("motion"),
    shell:
        "python -m real2sim motion --subject {wildcards.subject} --trial {wildcards.trial} --fits {input.fits:q}"
        " --pose {input.pose:q} --markers {input.markers:q} --robot-log {input.robot_log:q} --limits {input.limits:q}"
        " --step {input.step:q} --robot {input.robot:q} --settings {params.settings:q} --out {output:q} 2>&1"
        " | tee {log:q}"


rule motion_clip:
    """Some seconds of a person's first dynamic trial, measured and simulated, as a picture that moves."""
    input:
        fits=lambda wildcards: [
            f"results/fits/{wildcards.subject}/{PEOPLE[wildcards.subject].trials_of('dynamic')[0]}/restart-{restart}.json"
            for restart in RESTARTS
        ],
        pose=lambda wildcards: poses_of(wildcards.subject, "dynamic")[0],
        markers=lambda wildcards: markers_of(wildcards.subject, "dynamic")[0],
        limits="results/limits/{subject}.json",
        step="results/plant/{subject}.json",
        robot=ROBOT,
    output:
        report("results/motion/{subject}/clip.gif", caption="../report/clip.rst", category="Identification"),
    log:
        "logs/motion/{subject}/clip.log",
    benchmark:
        "logs/benchmarks/motion/{subject}/clip.tsv"
    conda:
        "../envs/real2sim.yaml"
    threads: 1
    resources:
        mem_mb=600,
        runtime=10,
    params:
        settings=FIT_SETTINGS,
        robot=ROBOT_CONTENT,
        code=code("motion-clip"),
    shell:
        "python -m real2sim motion-clip --fits {input.fits:q} --pose {input.pose:q} --markers {input.markers:q}"
        " --limits {input.limits:q} --step {input.step:q} --robot {input.robot:q} --settings {params.settings:q}"
        " --out {output:q} 2>&1 | tee {log:q}"
