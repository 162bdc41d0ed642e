"""What people share: ICC, priors and their test on the one left out (paper, section III-C).

Inputs:  all fits of the calibration cohort.
Outputs: results/shareability/{fits,icc,nested,classes,coverage,power}.csv, results/priors/{priors,anthropometrics}.csv,
         results/loso/<SUBJECT>.json, loso.csv.
Steps:   ICC with cluster bootstrap; three-way mapping; priors; leave-one-subject-out replays; restarts in trials in people;
         classes beside what was determined; what the intervals are worth, on simulated cohorts; regression on the body.
"""

SHARE_TABLES = [
    "results/shareability/nested.csv",
    "results/shareability/classes.csv",
    "results/shareability/coverage.csv",
    "results/shareability/power.csv",
    "results/priors/anthropometrics.csv",
    "results/figures/coverage.png",
]


rule shareability:
    """ICC(1,1) of each parameter with intervals and class."""
    input:
        fits=fits_of_cohort,
    output:
        fits="results/shareability/fits.csv",
        icc="results/shareability/icc.csv",
    log:
        "logs/shareability.log",
    benchmark:
        "logs/benchmarks/shareability.tsv"
    conda:
        "../envs/real2sim.yaml"
    threads: 1
    resources:
        mem_mb=600,
        runtime=10,
    params:
        fits=lambda wildcards, input: braced(input.fits),
        settings=settings_of("statistics"),
        code=code("shareability"),
    shell:
        "python -m real2sim shareability --fits {params.fits} --settings {params.settings:q}"
        " --out-fits {output.fits:q} --out-icc {output.icc:q} 2>&1 | tee {log:q}"


rule priors:
    """Prior and search range of each parameter."""
    input:
        fits="results/shareability/fits.csv",
        icc="results/shareability/icc.csv",
        published=f"{PUBLISHED}/table1_priors.csv",
    output:
        "results/priors/priors.csv",
    log:
        "logs/priors.log",
    benchmark:
        "logs/benchmarks/priors.tsv"
    conda:
        "../envs/real2sim.yaml"
    threads: 1
    resources:
        mem_mb=600,
        runtime=10,
    params:
        settings=settings_of("statistics"),
        code=code("priors"),
    shell:
        "python -m real2sim priors --fits {input.fits:q} --icc {input.icc:q} --published {input.published:q}"
        " --settings {params.settings:q} --out {output:q} 2>&1 | tee {log:q}"


rule loso:
    """The prior of the others, deployed on one person."""
    input:
        fits=lambda wildcards: fits_of([wildcards.subject]),
        cohort="results/shareability/fits.csv",
        poses=lambda wildcards: poses_of(wildcards.subject, "dynamic"),
        markers=lambda wildcards: markers_of(wildcards.subject, "dynamic"),
        limits="results/limits/{subject}.json",
        step="results/plant/{subject}.json",
        robot=ROBOT,
        published=f"{PUBLISHED}/table1_priors.csv",
    output:
        "results/loso/{subject}.json",
    log:
        "logs/loso/{subject}.log",
    benchmark:
        "logs/benchmarks/loso/{subject}.tsv"
    conda:
        "../envs/real2sim.yaml"
    threads: 1
    resources:
        mem_mb=600,
        runtime=10,
    params:
        settings=settings_of("identification", "plant", "robot", "statistics"),
        robot=ROBOT_CONTENT,
        causes=causes_of,
        code=code("loso"),
    shell:
        "python -m real2sim loso --subject {wildcards.subject} --fits {input.fits:q} --cohort {input.cohort:q}"
        " --poses {input.poses:q} --markers {input.markers:q} --limits {input.limits:q}"
        " --step {input.step:q} --robot {input.robot:q} --published {input.published:q} --settings {params.settings:q}"
        " {params.causes:q} --out {output:q} 2>&1 | tee {log:q}"


rule loso_table:
    """LOSO overhead per person and on average."""
    input:
        loso=expand("results/loso/{subject}.json", subject=CALIBRATION),
    output:
        "results/loso/loso.csv",
    log:
        "logs/loso/table.log",
    benchmark:
        "logs/benchmarks/loso/table.tsv"
    conda:
        "../envs/real2sim.yaml"
    threads: 1
    resources:
        mem_mb=600,
        runtime=10,
    params:
        settings=settings_of("statistics"),
        code=code("loso-table"),
    shell:
        "python -m real2sim loso-table --loso {input.loso:q} --settings {params.settings:q} --out {output:q} 2>&1 | tee {log:q}"


rule nested_variance:
    """Variance of people, trials and restarts, and the class by an interval that counts trials."""
    input:
        fits="results/shareability/fits.csv",
        icc="results/shareability/icc.csv",
    output:
        "results/shareability/nested.csv",
    log:
        "logs/nested_variance.log",
    benchmark:
        "logs/benchmarks/nested_variance.tsv"
    conda:
        "../envs/real2sim.yaml"
    threads: 1
    resources:
        mem_mb=600,
        runtime=10,
    params:
        settings=settings_of("statistics"),
        code=code("nested-variance"),
    shell:
        "python -m real2sim nested-variance --fits {input.fits:q} --icc {input.icc:q} --settings {params.settings:q}"
        " --out {output:q} 2>&1 | tee {log:q}"


rule classes:
    """The class of each parameter by three intervals, beside how often it was determined, and a verdict."""
    input:
        icc="results/shareability/icc.csv",
        nested="results/shareability/nested.csv",
        identifiability="results/tables/identifiability.csv",
    output:
        report(
            "results/shareability/classes.csv",
            caption="../report/classes.rst",
            category="Shared between people",
        ),
    log:
        "logs/classes.log",
    benchmark:
        "logs/benchmarks/classes.tsv"
    conda:
        "../envs/real2sim.yaml"
    threads: 1
    resources:
        mem_mb=600,
        runtime=10,
    params:
        code=code("classes"),
    shell:
        "python -m real2sim classes --icc {input.icc:q} --nested {input.nested:q}"
        " --identifiability {input.identifiability:q} --out {output:q} 2>&1 | tee {log:q}"


rule coverage_study:
    """What each interval of an ICC covers, and how many people a class needs, on simulated cohorts."""
    output:
        coverage="results/shareability/coverage.csv",
        power="results/shareability/power.csv",
    log:
        "logs/coverage_study.log",
    benchmark:
        "logs/benchmarks/coverage_study.tsv"
    conda:
        "../envs/real2sim.yaml"
    threads: 1
    resources:
        mem_mb=600,
        runtime=10,
    params:
        settings=json.dumps(
            {
                key: STUDY["statistics"][key]
                for key in ("study", "confidence", "common_below", "distinct_from")
            }
        ),
        code=code("coverage-study"),
    shell:
        "python -m real2sim coverage-study --settings {params.settings:q} --out-coverage {output.coverage:q}"
        " --out-power {output.power:q} 2>&1 | tee {log:q}"


rule anthropometrics:
    """Power laws of the parameters in mass, height and waist, where there are people enough."""
    input:
        fits="results/shareability/fits.csv",
        subjects=[str(PEOPLE[name].folder / "subject.yaml") for name in CALIBRATION],
    output:
        "results/priors/anthropometrics.csv",
    log:
        "logs/anthropometrics.log",
    benchmark:
        "logs/benchmarks/anthropometrics.tsv"
    conda:
        "../envs/real2sim.yaml"
    threads: 1
    resources:
        mem_mb=600,
        runtime=10,
    params:
        settings=settings_of("statistics", part="regression"),
        content=subject_content(*CALIBRATION),
        code=code("anthropometrics"),
    shell:
        "python -m real2sim anthropometrics --fits {input.fits:q} --subjects {input.subjects:q}"
        " --settings {params.settings:q} --out {output:q} 2>&1 | tee {log:q}"
