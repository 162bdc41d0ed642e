"""The diagnosis suite: synthetic people whose sim-to-real gap has a known, sealed cause.

Inputs:  the suite's configuration (config key `suite`), config/phantom.yaml, the robot twin.
Outputs: results/suite/<SUITE>/raw/<CASE>/*, results/suite/<SUITE>/sealed/<SHARD>.json (truth: only the score may read it).
Steps:   one job per shard draws, simulates and writes its cases. Nothing of the study asks for them.
"""

SUITE = suite_settings()
SUITE_SHARDS = [f"{shard:03d}" for shard in range(shards(SUITE))] if SUITE else []

for _shard in SUITE_SHARDS:

    rule:
        name:
            f"suite_cases_{_shard}"
        input:
            robot=ROBOT,
            lock="environment-lock.txt",
        output:
            raw=[
                directory(f"results/suite/{SUITE['name']}/raw/{case}")
                for case in case_names(SUITE, int(_shard))
            ],
            truth=f"results/suite/{SUITE['name']}/sealed/{_shard}.json",
        log:
            f"logs/suite/{SUITE['name']}/{_shard}.log",
        benchmark:
            f"logs/benchmarks/suite/{SUITE['name']}/{_shard}.tsv"
        conda:
            "../envs/real2sim.yaml"
        threads: 1
        resources:
            mem_mb=1200,
            runtime=30,
        params:
            shard=int(_shard),
            folder=lambda wildcards, output: Path(output.raw[0]).parent,
            suite=json.dumps(SUITE),
            settings=phantom_settings(),
            controllers=settings_of("robot"),
            code=code("suite-cases"),
        shell:
            "python -m real2sim suite-cases --suite {params.suite:q} --shard {params.shard}"
            " --settings {params.settings:q} --controllers {params.controllers:q} --robot {input.robot:q}"
            " --out {params.folder:q} --truth {output.truth:q} 2>&1 | tee {log:q}"


if SUITE:

    rule suite:
        """All cases of the diagnosis suite."""
        input:
            expand("results/suite/{suite}/sealed/{shard}.json", suite=SUITE["name"], shard=SUITE_SHARDS),
