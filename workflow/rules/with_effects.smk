"""The identification, what people share, and its transfer once more, with the diagnosed causes in the model.

Inputs:  results/diagnosis/<SUBJECT>/diagnosis.json of the calibration people whose diagnosis is part of the main job, and
         what their plain fits are made from.
Outputs: results/with_effects/: fits/<SUBJECT>/<TRIAL>/restart-<N>.json, fits.csv, icc.csv, priors.csv,
         cross_trial/<SUBJECT>.json, cross_trial.csv, loso/<SUBJECT>.json, loso.csv;
         results/with_effects/plain/: the plain results of these people and trials, by the names that they have in
         results/, where the study holds other calibration people or third trials besides;
         results/paper/with_effects/{table1_priors,transfer,claims}.{csv,tex}, numbers.tex.
Steps:   fit the two diagnosed trials with the causes held; ICC, priors, cross-trial and leave-one-out replays by the
         same commands as without them; the same of the plain fits of these people and trials; both beside each other.
"""


rule fit_with_effects:
    """All restarts on one dynamic trial, with the diagnosed causes in the model."""
    input:
        pose="results/trials/{subject}/{trial}/pose.parquet",
        neutral="results/trials/{subject}/neutral/markers.parquet",
        diagnosis="results/diagnosis/{subject}/diagnosis.json",
        limits="results/limits/{subject}.json",
        gates=gates_of_fit,
        robot=ROBOT,
        lock="environment-lock.txt",
    output:
        expand("results/with_effects/fits/{{subject}}/{{trial}}/restart-{restart}.json", restart=RESTARTS),
    log:
        "logs/with_effects/fits/{subject}/{trial}.log",
    benchmark:
        "logs/benchmarks/with_effects/fits/{subject}/{trial}.tsv"
    conda:
        "../envs/real2sim.yaml"
    threads: 1
    resources:
        mem_mb=600,
        runtime=30,
    params:
        trial=lambda wildcards, input: Path(input.pose).parent,
        causes=causes_of,
        restarts=list(RESTARTS),
        settings=settings_of("identification"),
        robot=ROBOT_CONTENT,
        code=code("fit-with-effects"),
    shell:
        "python -m real2sim fit-with-effects --subject {wildcards.subject} --trial {params.trial:q}"
        " --restarts {params.restarts} {params.causes:q} --limits {input.limits:q} --gates {input.gates:q}"
        " --robot {input.robot:q} --settings {params.settings:q} --out {output:q} 2>&1 | tee {log:q}"


use rule shareability as shareability_with_effects with:
    """ICC(1,1) of each parameter once the causes are in the model, with intervals and class."""
    input:
        fits=[path for subject in EXPLAINED for path in explained_fits(subject)],
    output:
        fits="results/with_effects/fits.csv",
        icc="results/with_effects/icc.csv",
    log:
        "logs/with_effects/shareability.log",
    benchmark:
        "logs/benchmarks/with_effects/shareability.tsv"


use rule priors as priors_with_effects with:
    """Prior and search range of each parameter once the causes are in the model."""
    input:
        fits="results/with_effects/fits.csv",
        icc="results/with_effects/icc.csv",
        published=f"{PUBLISHED}/table1_priors.csv",
    output:
        "results/with_effects/priors.csv",
    log:
        "logs/with_effects/priors.log",
    benchmark:
        "logs/benchmarks/with_effects/priors.tsv"


use rule cross_trial as cross_trial_with_effects with:
    """Each trial's best fit with the causes, simulated with them on the person's other trial."""
    input:
        fits=lambda wildcards: explained_fits(wildcards.subject),
        poses=lambda wildcards: explained_poses(wildcards.subject),
        markers=lambda wildcards: markers_of(wildcards.subject, "dynamic")[:2],
        neutral="results/trials/{subject}/neutral/markers.parquet",
        diagnosis="results/diagnosis/{subject}/diagnosis.json",
        limits="results/limits/{subject}.json",
        step="results/plant/{subject}.json",
        robot=ROBOT,
    output:
        "results/with_effects/cross_trial/{subject}.json",
    log:
        "logs/with_effects/cross_trial/{subject}.log",
    benchmark:
        "logs/benchmarks/with_effects/cross_trial/{subject}.tsv"


use rule loso as loso_with_effects with:
    """The prior of the others with their causes, deployed on one person with that person's."""
    input:
        fits=lambda wildcards: explained_fits(wildcards.subject),
        cohort="results/with_effects/fits.csv",
        poses=lambda wildcards: explained_poses(wildcards.subject),
        markers=lambda wildcards: markers_of(wildcards.subject, "dynamic")[:2],
        neutral="results/trials/{subject}/neutral/markers.parquet",
        diagnosis="results/diagnosis/{subject}/diagnosis.json",
        limits="results/limits/{subject}.json",
        step="results/plant/{subject}.json",
        robot=ROBOT,
        published=f"{PUBLISHED}/table1_priors.csv",
    output:
        "results/with_effects/loso/{subject}.json",
    log:
        "logs/with_effects/loso/{subject}.log",
    benchmark:
        "logs/benchmarks/with_effects/loso/{subject}.tsv"


rule with_effects:
    """Table I, and what the parameters cost on another trial and another person, with the plain model and with the causes."""
    input:
        diagnoses=expand("results/diagnosis/{subject}/diagnosis.json", subject=EXPLAINED),
        priors=[plain_side("results/priors/priors.csv"), "results/with_effects/priors.csv"],
        icc=[plain_side("results/shareability/icc.csv"), "results/with_effects/icc.csv"],
        cross_trial=expand(plain_side("results/cross_trial/{subject}.json"), subject=EXPLAINED),
        cross_trial_explained=expand("results/with_effects/cross_trial/{subject}.json", subject=EXPLAINED),
        loso=expand(plain_side("results/loso/{subject}.json"), subject=EXPLAINED),
        loso_explained=expand("results/with_effects/loso/{subject}.json", subject=EXPLAINED),
        published=[f"{PUBLISHED}/{name}.csv" for name in ("table1_priors", "cross_trial", "claims")],
    output:
        expand(
            "results/paper/with_effects/{table}.{kind}",
            table=["table1_priors", "transfer"],
            kind=["csv", "tex"],
        ),
    log:
        "logs/paper/with_effects.log",
    benchmark:
        "logs/benchmarks/paper/with_effects.tsv"
    conda:
        "../envs/real2sim.yaml"
    threads: 1
    resources:
        mem_mb=600,
        runtime=10,
    params:
        settings=settings_of("identification"),
        code=code("with-effects"),
    shell:
        "python -m real2sim with-effects --diagnoses {input.diagnoses:q} --priors {input.priors:q} --icc {input.icc:q}"
        " --cross-trial {input.cross_trial:q} --cross-trial-explained {input.cross_trial_explained:q}"
        " --loso {input.loso:q} --loso-explained {input.loso_explained:q} --published {input.published:q}"
        " --settings {params.settings:q} --out {output:q} 2>&1 | tee {log:q}"


use rule cross_trial_table as cross_trial_table_with_effects with:
    """Cross-trial cost per person with the causes, beside the published one."""
    input:
        cross_trial=expand("results/with_effects/cross_trial/{subject}.json", subject=EXPLAINED),
        floors=expand("results/noise_floor/{subject}.json", subject=EXPLAINED),
        published=f"{PUBLISHED}/cross_trial.csv",
    output:
        "results/with_effects/cross_trial.csv",
    log:
        "logs/with_effects/cross_trial_table.log",
    benchmark:
        "logs/benchmarks/with_effects/cross_trial_table.tsv"


use rule loso_table as loso_table_with_effects with:
    """LOSO overhead per person and on average, with the causes."""
    input:
        loso=expand("results/with_effects/loso/{subject}.json", subject=EXPLAINED),
    output:
        "results/with_effects/loso.csv",
    log:
        "logs/with_effects/loso_table.log",
    benchmark:
        "logs/benchmarks/with_effects/loso_table.tsv"


use rule claims as claims_with_effects with:
    """Each quantitative claim of the paper, its value with the causes in the model, and the verdict."""
    input:
        published=rules.claims.input.published,
        people=rules.claims.input.people,
        sweeps=rules.claims.input.sweeps,
        tightness=rules.claims.input.tightness,
        fits="results/with_effects/fits.csv",
        cross_trial="results/with_effects/cross_trial.csv",
        icc="results/with_effects/icc.csv",
        loso="results/with_effects/loso.csv",
        coverage=rules.claims.input.coverage,
        refined=rules.claims.input.refined,
        gait=rules.claims.input.gait,
        interface=rules.claims.input.interface,
        human=rules.claims.input.human,
    output:
        table="results/paper/with_effects/claims.csv",
        tex="results/paper/with_effects/claims.tex",
        numbers="results/paper/with_effects/numbers.tex",
    log:
        "logs/with_effects/claims.log",
    benchmark:
        "logs/benchmarks/with_effects/claims.tsv"


use rule shareability as shareability_plain_side with:
    """ICC(1,1) of each parameter by the plain fits of the diagnosed people and trials alone."""
    input:
        fits=[path for subject in EXPLAINED for path in explained_fits(subject, "results/fits")],
    output:
        fits="results/with_effects/plain/shareability/fits.csv",
        icc="results/with_effects/plain/shareability/icc.csv",
    log:
        "logs/with_effects/plain/shareability.log",
    benchmark:
        "logs/benchmarks/with_effects/plain/shareability.tsv"


use rule priors as priors_plain_side with:
    """Prior and search range of each parameter by the plain fits of the diagnosed people and trials alone."""
    input:
        fits="results/with_effects/plain/shareability/fits.csv",
        icc="results/with_effects/plain/shareability/icc.csv",
        published=f"{PUBLISHED}/table1_priors.csv",
    output:
        "results/with_effects/plain/priors/priors.csv",
    log:
        "logs/with_effects/plain/priors.log",
    benchmark:
        "logs/benchmarks/with_effects/plain/priors.tsv"


use rule cross_trial as cross_trial_plain_side with:
    """Best plain fit of each of the two diagnosed trials, simulated on the other one."""
    input:
        fits=lambda wildcards: explained_fits(wildcards.subject, "results/fits"),
        poses=lambda wildcards: explained_poses(wildcards.subject),
        markers=lambda wildcards: markers_of(wildcards.subject, "dynamic")[:2],
        limits="results/limits/{subject}.json",
        step="results/plant/{subject}.json",
        robot=ROBOT,
    output:
        "results/with_effects/plain/cross_trial/{subject}.json",
    log:
        "logs/with_effects/plain/cross_trial/{subject}.log",
    benchmark:
        "logs/benchmarks/with_effects/plain/cross_trial/{subject}.tsv"


use rule loso as loso_plain_side with:
    """Prior by the plain fits of the other diagnosed people, deployed on one person's two diagnosed trials."""
    input:
        fits=lambda wildcards: explained_fits(wildcards.subject, "results/fits"),
        cohort="results/with_effects/plain/shareability/fits.csv",
        poses=lambda wildcards: explained_poses(wildcards.subject),
        markers=lambda wildcards: markers_of(wildcards.subject, "dynamic")[:2],
        limits="results/limits/{subject}.json",
        step="results/plant/{subject}.json",
        robot=ROBOT,
        published=f"{PUBLISHED}/table1_priors.csv",
    output:
        "results/with_effects/plain/loso/{subject}.json",
    log:
        "logs/with_effects/plain/loso/{subject}.log",
    benchmark:
        "logs/benchmarks/with_effects/plain/loso/{subject}.tsv"


use rule cross_trial_table as cross_trial_table_plain_side with:
    """Cross-trial cost of the plain fits per diagnosed person, beside the published one."""
    input:
        cross_trial=expand("results/with_effects/plain/cross_trial/{subject}.json", subject=EXPLAINED),
        floors=expand("results/noise_floor/{subject}.json", subject=EXPLAINED),
        published=f"{PUBLISHED}/cross_trial.csv",
    output:
        "results/with_effects/plain/tables/cross_trial.csv",
    log:
        "logs/with_effects/plain/cross_trial_table.log",
    benchmark:
        "logs/benchmarks/with_effects/plain/cross_trial_table.tsv"


use rule loso_table as loso_table_plain_side with:
    """LOSO overhead of the plain fits per diagnosed person and on average."""
    input:
        loso=expand("results/with_effects/plain/loso/{subject}.json", subject=EXPLAINED),
    output:
        "results/with_effects/plain/loso/loso.csv",
    log:
        "logs/with_effects/plain/loso_table.log",
    benchmark:
        "logs/benchmarks/with_effects/plain/loso_table.tsv"


use rule claims as claims_plain_side with:
    """Each quantitative claim of the paper, its value by the plain fits of the diagnosed people and trials alone."""
    input:
        published=rules.claims.input.published,
        people=rules.claims.input.people,
        sweeps=rules.claims.input.sweeps,
        tightness=rules.claims.input.tightness,
        fits="results/with_effects/plain/shareability/fits.csv",
        cross_trial="results/with_effects/plain/tables/cross_trial.csv",
        icc="results/with_effects/plain/shareability/icc.csv",
        loso="results/with_effects/plain/loso/loso.csv",
        coverage=rules.claims.input.coverage,
        refined=rules.claims.input.refined,
        gait=rules.claims.input.gait,
        interface=rules.claims.input.interface,
        human=rules.claims.input.human,
    output:
        table="results/with_effects/plain/paper/claims.csv",
        tex="results/with_effects/plain/paper/claims.tex",
        numbers="results/with_effects/plain/paper/numbers.tex",
    log:
        "logs/with_effects/plain/claims.log",
    benchmark:
        "logs/benchmarks/with_effects/plain/claims.tsv"
