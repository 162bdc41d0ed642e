"""Raw exports to canonical tables on one clock and in one frame.

Inputs:  all raw files of one person.
Outputs: results/trials/<SUBJECT>/<TRIAL>/{markers,pose,joints,robot}.parquet and quality.json.
Steps:   read, fill short gaps, filter, synchronise, align, compute poses and interface coordinates.

One job per person, not per trial: starting Python costs more than reading a trial.
"""

for _name, _person in PEOPLE.items():

    rule:
        """All recordings of one person as canonical tables."""
        name:
            f"ingest_{_name}"
        input:
            raw=[str(_person.folder / "subject.yaml")]
            + [
                str(path)
                for files in _person.trials.values()
                for path in (files.markers, files.markerless, files.log)
                if path is not None
            ],
        output:
            canonical_tables([_name]),
        log:
            f"logs/ingest/{_name}.log",
        benchmark:
            f"logs/benchmarks/ingest/{_name}.tsv"
        conda:
            "../envs/real2sim.yaml"
        threads: 1
        resources:
            mem_mb=600,
            runtime=20,
        params:
            subject=_name,
            folder=lambda wildcards, input: Path(input.raw[0]).parent,
            out=lambda wildcards, output: Path(output[0]).parents[1],
            settings=settings_of("ingest"),
            code=code("ingest"),
        shell:
            "python -m real2sim ingest --subject {params.subject} --folder {params.folder:q} --raw {input.raw:q}"
            " --settings {params.settings:q} --out {params.out:q} 2>&1 | tee {log:q}"
