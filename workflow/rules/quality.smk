"""Gates before anything is fitted: what the raw recordings are worth. `snakemake quality` fits nothing.

Inputs:  all raw files of one person.
Outputs: results/quality/<SUBJECT>/gates.json, <TRIAL>.json and gates.png; results/quality/quality.csv.
Steps:   figures of every trial; what the trials say together; verdicts; picture; table of the cohort.
"""

GATE_SETTINGS = json.dumps(
    {
        "quality": STUDY["quality"],
        "ingest": STUDY["ingest"],
        "scales": STUDY["identification"]["scales"],
        "start_window_s": STUDY["identification"]["start_window_s"],
        "start_known_share": STUDY["identification"]["start_known_share"],
    }
)


rule quality:
    """The table and one picture per person."""
    input:
        "results/quality/quality.csv",
        expand("results/quality/{subject}/gates.png", subject=PEOPLE),


for _suffix, _trials, _names in protocols():

    rule:
        """Verdict of every gate on each recording of one person."""
        name:
            f"gates{_suffix}"
        input:
            raw=raw_files,
        output:
            gates="results/quality/{subject}/gates.json",
            trials=[f"results/quality/{{subject}}/{trial}.json" for trial in _trials],
        log:
            "logs/quality/{subject}.log",
        benchmark:
            "logs/benchmarks/quality/{subject}.tsv"
        wildcard_constraints:
            subject=_names,
        conda:
            "../envs/real2sim.yaml"
        threads: 1
        resources:
            mem_mb=800,
            runtime=20,
        params:
            folder=lambda wildcards, input: Path(input.raw[0]).parent,
            out=lambda wildcards, output: Path(output.gates).parent,
            settings=GATE_SETTINGS,
            content=raw_content,
            code=code("quality-subject"),
        shell:
            "python -m real2sim quality-subject --subject {wildcards.subject} --folder {params.folder:q} --raw {input.raw:q}"
            " --settings {params.settings:q} --out {params.out:q} 2>&1 | tee {log:q}"


rule quality_figure:
    """Trials against gates of one person."""
    input:
        gates="results/quality/{subject}/gates.json",
    output:
        report(
            "results/quality/{subject}/gates.png",
            caption="../report/gates.rst",
            category="Quality of the recordings",
            labels={"person": "{subject}"},
        ),
    log:
        "logs/quality/{subject}_figure.log",
    benchmark:
        "logs/benchmarks/quality/{subject}_figure.tsv"
    conda:
        "../envs/real2sim.yaml"
    threads: 1
    resources:
        mem_mb=600,
        runtime=10,
    params:
        code=code("quality-figure"),
    shell:
        "python -m real2sim quality-figure --gates {input.gates:q} --out {output:q} 2>&1 | tee {log:q}"


rule quality_table:
    """All gates of all people."""
    input:
        gates=expand("results/quality/{subject}/gates.json", subject=PEOPLE),
    output:
        "results/quality/quality.csv",
    log:
        "logs/quality/table.log",
    benchmark:
        "logs/benchmarks/quality/table.tsv"
    conda:
        "../envs/real2sim.yaml"
    threads: 1
    resources:
        mem_mb=600,
        runtime=10,
    params:
        settings=settings_of("quality"),
        code=code("quality-table"),
    shell:
        "python -m real2sim quality-table --gates {input.gates:q} --settings {params.settings:q} --out {output:q} 2>&1 | tee {log:q}"
