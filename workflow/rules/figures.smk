"""Figures, tables and the page that holds them: from files only, so a changed colour re-fits nothing.

Inputs:  sweeps, fits, ICC, priors, LOSO and cross-trial files; tables and claims of the paper.
Outputs: results/figures/*.{png,pdf,svg}, results/tables/*.csv, results/report.html.
Steps:   one rule per figure or table.
"""

FIGURES = ["gap", "tightness", "convergence", "icc", "coverage", "loso"]
# Which gap would have made the paper's numbers, computed before (benchmarks/ship_paper_gap.py)
PAPER_GAP_RECORD = [path for path in ["resources/paper_gap/causes.json"] if Path(path).exists()]
FIGURES += ["paper_gap"] if PAPER_GAP_RECORD else []


rule gap_figure:
    """How far everyone's plain and diagnosed model are off the trial that shows the gap, beside noise."""
    input:
        diagnoses=expand("results/diagnosis/{subject}/diagnosis.json", subject=REPORTED),
    output:
        multiext("results/figures/gap", ".pdf", ".svg"),
        report("results/figures/gap.png", caption="../report/gap.rst", category="Diagnosis"),
    log:
        "logs/figures/gap_figure.log",
    benchmark:
        "logs/benchmarks/figures/gap_figure.tsv"
    conda:
        "../envs/real2sim.yaml"
    threads: 1
    resources:
        mem_mb=600,
        runtime=10,
    params:
        code=code("gap-figure"),
    shell:
        "python -m real2sim gap-figure --diagnoses {input.diagnoses:q} --out {output:q} 2>&1 | tee {log:q}"


rule paper_gap_figure:
    """How far the cohort of each cause lies from the paper's numbers."""
    input:
        record="resources/paper_gap/causes.json",
    output:
        multiext("results/figures/paper_gap", ".pdf", ".svg"),
        report("results/figures/paper_gap.png", caption="../report/paper_gap.rst", category="Paper"),
    log:
        "logs/figures/paper_gap_figure.log",
    benchmark:
        "logs/benchmarks/figures/paper_gap_figure.tsv"
    conda:
        "../envs/real2sim.yaml"
    threads: 1
    resources:
        mem_mb=600,
        runtime=10,
    params:
        code=code("paper-gap-figure"),
    shell:
        "python -m real2sim paper-gap-figure --record {input.record:q} --out {output:q} 2>&1 | tee {log:q}"


rule tightness_figure:
    """Allowable motion against normalised tightness (paper, Fig. 3)."""
    input:
        sweeps=expand("results/tightness/{subject}/sweep.csv", subject=PEOPLE),
        cohort="results/tightness/cohort.json",
    output:
        multiext("results/figures/tightness", ".pdf", ".svg"),
        report("results/figures/tightness.png", caption="../report/tightness.rst", category="Tightness"),
    log:
        "logs/figures/tightness_figure.log",
    benchmark:
        "logs/benchmarks/figures/tightness_figure.tsv"
    conda:
        "../envs/real2sim.yaml"
    threads: 1
    resources:
        mem_mb=600,
        runtime=10,
    params:
        code=code("tightness-figure"),
    shell:
        "python -m real2sim tightness-figure --sweeps {input.sweeps:q} --cohort {input.cohort:q} --out {output:q} 2>&1 | tee {log:q}"


rule convergence_figure:
    """Cost against evaluations per person (paper, Fig. 4 top)."""
    input:
        fits=fits_of(CALIBRATION),
        floors=expand("results/noise_floor/{subject}.json", subject=CALIBRATION),
    output:
        multiext("results/figures/convergence", ".pdf", ".svg"),
        report(
            "results/figures/convergence.png", caption="../report/convergence.rst", category="Identification"
        ),
    log:
        "logs/figures/convergence_figure.log",
    benchmark:
        "logs/benchmarks/figures/convergence_figure.tsv"
    conda:
        "../envs/real2sim.yaml"
    threads: 1
    resources:
        mem_mb=600,
        runtime=10,
    params:
        fits=lambda wildcards, input: braced(input.fits),
        code=code("convergence-figure"),
    shell:
        "python -m real2sim convergence-figure --fits {params.fits} --floors {input.floors:q} --out {output:q} 2>&1 | tee {log:q}"


rule icc_figure:
    """ICC with intervals, and the parameters' distributions (paper, Fig. 4 middle)."""
    input:
        fits="results/shareability/fits.csv",
        icc="results/shareability/icc.csv",
    output:
        multiext("results/figures/icc", ".pdf", ".svg"),
        report("results/figures/icc.png", caption="../report/icc.rst", category="Shared between people"),
    log:
        "logs/figures/icc_figure.log",
    benchmark:
        "logs/benchmarks/figures/icc_figure.tsv"
    conda:
        "../envs/real2sim.yaml"
    threads: 1
    resources:
        mem_mb=600,
        runtime=10,
    params:
        code=code("icc-figure"),
    shell:
        "python -m real2sim icc-figure --fits {input.fits:q} --icc {input.icc:q} --out {output:q} 2>&1 | tee {log:q}"


rule coverage_figure:
    """What the intervals of an ICC cover, and how many people a class needs."""
    input:
        coverage="results/shareability/coverage.csv",
        power="results/shareability/power.csv",
    output:
        multiext("results/figures/coverage", ".pdf", ".svg"),
        report(
            "results/figures/coverage.png",
            caption="../report/coverage.rst",
            category="Shared between people",
        ),
    log:
        "logs/figures/coverage_figure.log",
    benchmark:
        "logs/benchmarks/figures/coverage_figure.tsv"
    conda:
        "../envs/real2sim.yaml"
    threads: 1
    resources:
        mem_mb=600,
        runtime=10,
    params:
        code=code("coverage-figure"),
    shell:
        "python -m real2sim coverage-figure --coverage {input.coverage:q} --power {input.power:q} --out {output:q} 2>&1 | tee {log:q}"


rule loso_figure:
    """LOSO overhead per person (paper, Fig. 4 bottom)."""
    input:
        loso="results/loso/loso.csv",
    output:
        multiext("results/figures/loso", ".pdf", ".svg"),
        report("results/figures/loso.png", caption="../report/loso.rst", category="Shared between people"),
    log:
        "logs/figures/loso_figure.log",
    benchmark:
        "logs/benchmarks/figures/loso_figure.tsv"
    conda:
        "../envs/real2sim.yaml"
    threads: 1
    resources:
        mem_mb=600,
        runtime=10,
    params:
        code=code("loso-figure"),
    shell:
        "python -m real2sim loso-figure --loso {input.loso:q} --out {output:q} 2>&1 | tee {log:q}"


rule priors_table:
    """Priors beside the published ones (paper, Table I)."""
    input:
        priors="results/priors/priors.csv",
        published=f"{PUBLISHED}/table1_priors.csv",
    output:
        report("results/tables/priors.csv", caption="../report/priors.rst", category="Shared between people"),
    log:
        "logs/figures/priors_table.log",
    benchmark:
        "logs/benchmarks/figures/priors_table.tsv"
    conda:
        "../envs/real2sim.yaml"
    threads: 1
    resources:
        mem_mb=600,
        runtime=10,
    params:
        code=code("priors-table"),
    shell:
        "python -m real2sim priors-table --priors {input.priors:q} --published {input.published:q} --out {output:q} 2>&1 | tee {log:q}"


rule cross_trial_table:
    """Cross-trial cost per person beside the published one (paper, section V-B)."""
    input:
        cross_trial=expand("results/cross_trial/{subject}.json", subject=CALIBRATION),
        floors=expand("results/noise_floor/{subject}.json", subject=CALIBRATION),
        published=f"{PUBLISHED}/cross_trial.csv",
    output:
        report(
            "results/tables/cross_trial.csv", caption="../report/cross_trial.rst", category="Identification"
        ),
    log:
        "logs/figures/cross_trial_table.log",
    benchmark:
        "logs/benchmarks/figures/cross_trial_table.tsv"
    conda:
        "../envs/real2sim.yaml"
    threads: 1
    resources:
        mem_mb=600,
        runtime=10,
    params:
        code=code("cross-trial-table"),
    shell:
        "python -m real2sim cross-trial-table --cross-trial {input.cross_trial:q} --floors {input.floors:q} --published {input.published:q} --out {output:q} 2>&1 | tee {log:q}"


rule identifiability_table:
    """Verdict on each parameter of each trial."""
    input:
        assessments=[
            f"results/identifiability/{name}/{trial}.json"
            for name in CALIBRATION
            for trial in PEOPLE[name].trials_of("dynamic")
        ],
    output:
        report(
            "results/tables/identifiability.csv",
            caption="../report/identifiability.rst",
            category="Identification",
        ),
    log:
        "logs/figures/identifiability_table.log",
    benchmark:
        "logs/benchmarks/figures/identifiability_table.tsv"
    conda:
        "../envs/real2sim.yaml"
    threads: 1
    resources:
        mem_mb=600,
        runtime=10,
    params:
        assessments=lambda wildcards, input: braced(input.assessments),
        code=code("assessment-table"),
    shell:
        "python -m real2sim assessment-table --assessments {params.assessments} --out {output:q} 2>&1"
        " | tee {log:q}"


rule report_page:
    """The study on one page that needs no other file."""
    input:
        figures=expand("results/figures/{name}.svg", name=FIGURES)
        + expand(
            "results/twin/{subject}/{name}.svg",
            subject=[WALKER] if WALKER else [],
            name=["interface", "gait", "speed", "wrench"],
        ),
        quality="results/quality/quality.csv",
        tightness="results/tightness/cohort.json",
        breakpoints=expand("results/tightness/{subject}/breakpoints.json", subject=PEOPLE),
        cross_trial="results/tables/cross_trial.csv",
        identifiability="results/tables/identifiability.csv",
        icc="results/shareability/icc.csv",
        classes="results/shareability/classes.csv",
        priors="results/tables/priors.csv",
        anthropometrics="results/priors/anthropometrics.csv",
        loso="results/loso/loso.csv",
        interface="results/paper/table2_interface.csv",
        gait="results/paper/table3_gait.csv",
        claims="results/paper/claims.csv",
        bars=TWIN_TABLES["bars"],
        clouds=TWIN_TABLES["interface"],
        refined=REFINED,
        fits=fits_of(CALIBRATION),
        diagnoses=expand("results/diagnosis/{subject}/diagnosis.json", subject=REPORTED),
        explained=(
            [
                *[
                    f"results/paper/with_effects/{table}.csv"
                    for table in ("table1_priors", "transfer", "claims")
                ],
                plain_side("results/paper/claims.csv"),
            ]
            if len(EXPLAINED) > 1
            else []
        ),
        validation=VALIDATION_RECORDS,
        paper_gap=PAPER_GAP_RECORD,
    output:
        "results/report.html",
    log:
        "logs/figures/report_page.log",
    benchmark:
        "logs/benchmarks/figures/report_page.tsv"
    conda:
        "../envs/real2sim.yaml"
    threads: 1
    resources:
        mem_mb=800,
        runtime=10,
    params:
        people=json.dumps({name: person.cohort for name, person in PEOPLE.items()}),
        title="Real2Sim calibration of the pelvis-strap interface",
        fits=lambda wildcards, input: braced(input.fits),
        bars=lambda wildcards, input: given(bars=input.bars, clouds=input.clouds),
        validation=lambda wildcards, input: given_all("validation", input.validation),
        explained=lambda wildcards, input: given_all("explained", input.explained),
        paper_gap=lambda wildcards, input: given(**{"paper-gap": input.paper_gap}),
        code=code("report-page"),
    shell:
        "python -m real2sim report-page --people {params.people:q} --figures {input.figures:q} --quality {input.quality:q}"
        " --tightness {input.tightness:q} --breakpoints {input.breakpoints:q} --cross-trial {input.cross_trial:q}"
        " --identifiability {input.identifiability:q} --icc {input.icc:q} --classes {input.classes:q}"
        " --priors {input.priors:q} --anthropometrics {input.anthropometrics:q} --loso {input.loso:q}"
        " --interface {input.interface:q} --gait {input.gait:q} --claims {input.claims:q} {params.bars:q} --refined {input.refined:q}"
        " --fits {params.fits} --diagnoses {input.diagnoses:q} {params.validation:q} {params.explained:q} {params.paper_gap:q} --title {params.title:q} --out {output:q} 2>&1 | tee {log:q}"
