"""A new person from the priors: `snakemake person_S07` makes what a simulation of them needs, and a page that tells it.

Inputs:  the person's own canonical tables, gates, sweeps, joint limits and step study; priors; the robot twin.
Outputs: results/refined/<SUBJECT>.json; results/people/<SUBJECT>/interface.{xml,json}, interface_replay.csv;
         results/people/<SUBJECT>.html.
Steps:   refine what the priors leave open on the person's dynamic trials, everything else stays at the point prior;
         robot, strap and pelvis as one MJCF; diagnosis where two dynamic trials were recorded; page.
         The page holds the diagnosed model too.
         A person without dynamic trials gets the point prior, and the page says so.
"""

VALIDATION = [name for name, person in PEOPLE.items() if person.cohort == "validation"]
# for `all`: everyone who was kept for validation
REFINED = [f"results/refined/{name}.json" for name in VALIDATION]
PEOPLE_PAGES = [f"results/people/{name}.html" for name in VALIDATION]

PRIORS = STUDY["refinement"]["priors"]
if PRIORS == "results/priors/priors.csv" and not CALIBRATION:
    PRIORS = f"{PUBLISHED}/table1_priors.csv"


rule people:
    """Pages of everyone who was kept for validation."""
    input:
        REFINED,
        PEOPLE_PAGES,
        expand("results/people/{subject}/interface.xml", subject=VALIDATION),


for _name in PEOPLE:

    rule:
        name:
            f"person_{_name}"
        input:
            f"results/people/{_name}.html",
            f"results/people/{_name}/interface.xml",


rule unknown_person:
    """Says who is known; anyone who is has a rule of their own."""
    input:
        no_such_person,
    output:
        "person_{unknown,[A-Za-z0-9]+}",


rule refine:
    """What the priors leave open, refined on one person's dynamic trials."""
    input:
        priors=PRIORS,
        poses=lambda wildcards: poses_of(wildcards.subject, "dynamic"),
        markers=lambda wildcards: markers_of(wildcards.subject, "dynamic"),
        neutral_pose="results/trials/{subject}/neutral/pose.parquet",
        neutral_markers="results/trials/{subject}/neutral/markers.parquet",
        neutral_quality="results/trials/{subject}/neutral/quality.json",
        gates=gates_of_refinement,
        limits=lambda wildcards: where_refined(wildcards, "limits"),
        step=lambda wildcards: where_refined(wildcards, "plant"),
        fits=full_calibration,
        robot=ROBOT,
        lock="environment-lock.txt",
    output:
        "results/refined/{subject}.json",
    log:
        "logs/refined/{subject}.log",
    benchmark:
        "logs/benchmarks/refined/{subject}.tsv"
    conda:
        "../envs/real2sim.yaml"
    threads: 1
    resources:
        mem_mb=800,
        runtime=10,
    params:
        known=lambda wildcards, input: given(limits=input.limits, step=input.step),
        in_priors=lambda wildcards: (
            "true" if PRIORS == "results/priors/priors.csv" and wildcards.subject in CALIBRATION else "false"
        ),
        settings=settings_of("identification", "identifiability", "ingest", "plant", "refinement", "robot"),
        robot=ROBOT_CONTENT,
        code=code("refine"),
    shell:
        "python -m real2sim refine --subject {wildcards.subject} --priors {input.priors:q} --poses {input.poses:q}"
        " --markers {input.markers:q} --neutral-pose {input.neutral_pose:q} --neutral-markers {input.neutral_markers:q}"
        " --neutral-quality {input.neutral_quality:q} --gates {input.gates:q} {params.known:q} --fits {input.fits:q}"
        " --robot {input.robot:q} --in-priors {params.in_priors} --settings {params.settings:q} --out {output:q} 2>&1"
        " | tee {log:q}"


rule person_interface:
    """Robot, strap and pelvis of one person as an MJCF, and a trial to check it with."""
    input:
        refined="results/refined/{subject}.json",
        poses=lambda wildcards: poses_of(wildcards.subject, "dynamic", "neutral"),
        markers=lambda wildcards: markers_of(wildcards.subject, "dynamic", "neutral"),
        limits=lambda wildcards: where_limits_are_known(wildcards, "limits"),
        step=lambda wildcards: where_refined(wildcards, "plant"),
        robot=ROBOT,
        lock="environment-lock.txt",
    output:
        model="results/people/{subject}/interface.xml",
        notes="results/people/{subject}/interface.json",
        replay="results/people/{subject}/interface_replay.csv",
    log:
        "logs/people/{subject}_interface.log",
    benchmark:
        "logs/benchmarks/people/{subject}_interface.tsv"
    conda:
        "../envs/real2sim.yaml"
    threads: 1
    resources:
        mem_mb=800,
        runtime=10,
    params:
        known=lambda wildcards, input: given(limits=input.limits, step=input.step),
        settings=FIT_SETTINGS,
        robot=ROBOT_CONTENT,
        code=code("person-interface"),
    shell:
        "python -m real2sim person-interface --refined {input.refined:q} --poses {input.poses:q}"
        " --markers {input.markers:q} {params.known:q} --robot {input.robot:q} --settings {params.settings:q}"
        " --out {output.model:q} --notes {output.notes:q} --replay {output.replay:q} 2>&1 | tee {log:q}"


rule person_page:
    """Everything about one person on one page."""
    input:
        person=lambda wildcards: str(PEOPLE[wildcards.subject].folder / "subject.yaml"),
        gates="results/quality/{subject}/gates.json",
        refined="results/refined/{subject}.json",
        interface="results/people/{subject}/interface.xml",
        notes="results/people/{subject}/interface.json",
        breakpoints=where_swept,
        limits=lambda wildcards: where_limits_are_known(wildcards, "limits"),
        step=lambda wildcards: where_refined(wildcards, "plant"),
        diagnosis=where_diagnosed,
        model=model_where_diagnosed,
    output:
        "results/people/{subject}.html",
    log:
        "logs/people/{subject}_page.log",
    benchmark:
        "logs/benchmarks/people/{subject}_page.tsv"
    conda:
        "../envs/real2sim.yaml"
    threads: 1
    resources:
        mem_mb=600,
        runtime=10,
    params:
        known=lambda wildcards, input: given(
            breakpoints=input.breakpoints,
            limits=input.limits,
            step=input.step,
            diagnosis=input.diagnosis,
            model=input.model,
        ),
        content=lambda wildcards: subject_content(wildcards.subject),
        code=code("person-page"),
    shell:
        "python -m real2sim person-page --person {input.person:q} --gates {input.gates:q} --refined {input.refined:q}"
        " --interface {input.interface:q} --notes {input.notes:q} {params.known:q} --out {output:q} 2>&1 | tee {log:q}"
