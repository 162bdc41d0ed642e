"""Raw exports to canonical tables on one clock and in one frame.

Inputs:  all raw files of one person.
Outputs: results/trials/<SUBJECT>/<TRIAL>/{markers,pose,joints,robot}.parquet and quality.json.
Steps:   read, fill short gaps, filter, synchronise, align, compute poses and interface coordinates.

One job per person, not per trial: starting Python costs more than reading a trial.
"""

for _suffix, _trials, _names in protocols():

    rule:
        """All recordings of one person as canonical tables."""
        name:
            f"ingest{_suffix}"
        input:
            raw=raw_files,
        output:
            [f"results/trials/{{subject}}/{trial}/{table}" for table in TABLES for trial in _trials],
        log:
            "logs/ingest/{subject}.log",
        benchmark:
            "logs/benchmarks/ingest/{subject}.tsv"
        wildcard_constraints:
            subject=_names,
        priority: before_twin(_names.split("|"))
        conda:
            "../envs/real2sim.yaml"
        threads: 1
        resources:
            mem_mb=600,
            runtime=20,
        params:
            folder=lambda wildcards, input: Path(input.raw[0]).parent,
            out=lambda wildcards, output: Path(output[0]).parents[1],
            settings=settings_of("ingest"),
            content=raw_content,
            code=code("ingest"),
        shell:
            "python -m real2sim ingest --subject {wildcards.subject} --folder {params.folder:q} --raw {input.raw:q}"
            " --settings {params.settings:q} --out {params.out:q} 2>&1 | tee {log:q}"
