"""The paper by its numbers: tables, figures and claims beside what is published.

Inputs:  figures and tables of the stages, resources/published.
Outputs: results/paper/figure*.{png,pdf}, table*.{csv,tex}, cross_trial.{csv,tex}, claims.{csv,tex}, numbers.tex.
Steps:   figures to their numbers; tables with the published figures beside ours; every claim judged.
         Tables II and III and figures 5 and 6 are of the first person who is kept for validation and walks.
"""

PAPER_FIGURES = {
    "figure3_tightness": "results/figures/tightness",
    "figure4_convergence": "results/figures/convergence",
    "figure4_icc": "results/figures/icc",
    "figure4_loso": "results/figures/loso",
}
# the paper's unseen person: the first who was kept for validation and walks
WALKER = next((name for name in TWINS if name in VALIDATION), "")
if WALKER:
    PAPER_FIGURES["figure5_interface"] = f"results/twin/{WALKER}/interface"
    PAPER_FIGURES["figure6_gait"] = f"results/twin/{WALKER}/gait"
PAPER_TABLES = ["table1_priors", "table2_interface", "table3_gait", "cross_trial"]
TWIN_TABLES = {name: f"results/twin/{name}.csv" if TWINS else [] for name in ("gait", "interface", "bars")}


rule paper_figures:
    """Figures under their numbers in the paper."""
    input:
        [f"{path}.{kind}" for path in PAPER_FIGURES.values() for kind in ("png", "pdf")],
    output:
        [f"results/paper/{name}.{kind}" for name in PAPER_FIGURES for kind in ("png", "pdf")],
    log:
        "logs/paper/figures.log",
    benchmark:
        "logs/benchmarks/paper/figures.tsv"
    conda:
        "../envs/real2sim.yaml"
    threads: 1
    resources:
        mem_mb=600,
        runtime=10,
    params:
        code=code("paper-figures"),
    shell:
        "python -m real2sim paper-figures --figures {input:q} --out {output:q} 2>&1 | tee {log:q}"


rule paper_tables:
    """Tables I, II and III and the cross-trial costs, ours beside the published ones."""
    input:
        priors="results/tables/priors.csv",
        cross_trial="results/tables/cross_trial.csv",
        published=[f"{PUBLISHED}/table2_interface.csv", f"{PUBLISHED}/table3_gait.csv"],
        gait=TWIN_TABLES["gait"],
        interface=TWIN_TABLES["interface"],
    output:
        [f"results/paper/{name}.{kind}" for name in PAPER_TABLES for kind in ("csv", "tex")],
    log:
        "logs/paper/tables.log",
    benchmark:
        "logs/benchmarks/paper/tables.tsv"
    conda:
        "../envs/real2sim.yaml"
    threads: 1
    resources:
        mem_mb=600,
        runtime=10,
    params:
        twin=lambda wildcards, input: (
            given(subject=WALKER, gait=input.gait, interface=input.interface) if WALKER else []
        ),
        code=code("paper-tables"),
    shell:
        "python -m real2sim paper-tables --priors {input.priors:q} --cross-trial {input.cross_trial:q}"
        " --published {input.published:q} {params.twin:q} --out {output:q} 2>&1 | tee {log:q}"


rule claims:
    """Each quantitative claim of the paper, the value here, and the verdict."""
    input:
        published=[
            f"{PUBLISHED}/{name}.csv"
            for name in (
                "claims",
                "bounds",
                "table1_priors",
                "table2_interface",
                "table3_gait",
                "pelvis_inertia",
                "deployed",
            )
        ],
        people=[str(person.folder / "subject.yaml") for person in PEOPLE.values()],
        sweeps=expand("results/tightness/{subject}/sweep.csv", subject=PEOPLE),
        tightness="results/tightness/cohort.json",
        fits="results/shareability/fits.csv",
        cross_trial="results/tables/cross_trial.csv",
        icc="results/shareability/icc.csv",
        loso="results/loso/loso.csv",
        coverage="results/shareability/coverage.csv",
        refined=REFINED,
        gait=TWIN_TABLES["gait"],
        interface=TWIN_TABLES["interface"],
        human=f"results/twin/{WALKER}/human.xml" if WALKER else [],
    output:
        table=report(
            "results/paper/claims.csv", caption="../report/claims.rst", category="The paper's claims"
        ),
        tex="results/paper/claims.tex",
        numbers="results/paper/numbers.tex",
    log:
        "logs/paper/claims.log",
    benchmark:
        "logs/benchmarks/paper/claims.tsv"
    conda:
        "../envs/real2sim.yaml"
    threads: 1
    resources:
        mem_mb=600,
        runtime=10,
    params:
        people=[str(person.folder) for person in PEOPLE.values()],
        twin=lambda wildcards, input: (
            given(subject=WALKER, gait=input.gait, interface=input.interface, human=input.human)
            if WALKER
            else []
        ),
        content=subject_content(*PEOPLE),
        code=code("claims"),
    shell:
        "python -m real2sim claims --published {input.published:q} --people {params.people:q} --sweeps {input.sweeps:q}"
        " --tightness {input.tightness:q} --fits {input.fits:q} --cross-trial {input.cross_trial:q} --icc {input.icc:q}"
        " --loso {input.loso:q} --coverage {input.coverage:q} --refined {input.refined:q} {params.twin:q} --out {output.table:q}"
        " --out-tex {output.tex:q} --out-numbers {output.numbers:q} 2>&1 | tee {log:q}"
