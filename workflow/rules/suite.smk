"""The diagnosis suite: synthetic people whose sim-to-real gap has a known, sealed cause.

Inputs:  the suite's configuration (config key `suite`), config/phantom.yaml, the robot twin.
Outputs: results/suite/<SUITE>/raw/<CASE>/*, results/suite/<SUITE>/sealed/<SHARD>.json (truth: only the score may read
         it), results/suite/<SUITE>/cases/<CASE>/diagnosis.json, answers/<SHARD>.json and score.json.
         How long it will take is said before anything runs.
Steps:   one job per shard draws, simulates and writes its cases, one answers them; the score opens the seal. Nothing of
         the study asks for them.
"""

# Targets are not known to a Snakefile that is being read, but what was typed is
_ASKED = any(word == "suite" or word.startswith("results/suite") for word in sys.argv[1:])
SUITE = suite_settings(_ASKED)
SUITE_SHARDS = [f"{shard:03d}" for shard in range(shards(SUITE))] if SUITE else []

if SUITE and _ASKED and workflow.is_main_process:
    _cores = workflow.resource_settings.cores or 1
    print(expected_time(SUITE, Path("results/suite"), _cores), file=sys.stderr, flush=True)

for _shard in SUITE_SHARDS:

    rule:
        """Raw exports of some people whose gap has a known cause, and the sealed truth."""
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
            robot=ROBOT_CONTENT,
            code=code("suite-cases"),
        shell:
            "python -m real2sim suite-cases --suite {params.suite:q} --shard {params.shard}"
            " --settings {params.settings:q} --controllers {params.controllers:q} --robot {input.robot:q}"
            " --out {params.folder:q} --truth {output.truth:q} 2>&1 | tee {log:q}"

    rule:
        """Answers to some cases, without a look at the truth."""
        name:
            f"suite_diagnose_{_shard}"
        input:
            cases=[f"results/suite/{SUITE['name']}/raw/{case}" for case in case_names(SUITE, int(_shard))],
            robot=ROBOT,
            lock="environment-lock.txt",
        output:
            f"results/suite/{SUITE['name']}/answers/{_shard}.json",
        log:
            f"logs/suite/{SUITE['name']}/diagnose_{_shard}.log",
        benchmark:
            f"logs/benchmarks/suite/{SUITE['name']}/diagnose_{_shard}.tsv"
        conda:
            "../envs/real2sim.yaml"
        threads: 1
        resources:
            mem_mb=1200,
            runtime=60,
        params:
            work=f"results/suite/{SUITE['name']}/cases",
            settings=DIAGNOSIS_SETTINGS,
            left_out=json.dumps(left_out(SUITE, int(_shard))),
            robot=ROBOT_CONTENT,
            code=code("suite-diagnose"),
        shell:
            "python -m real2sim suite-diagnose --cases {input.cases:q} --robot {input.robot:q}"
            " --settings {params.settings:q} --left-out {params.left_out:q} --work {params.work:q} --out {output:q} 2>&1 | tee {log:q}"


if SUITE:

    rule score_diagnosis:
        """Answers against the truth: the only rule that opens the seal."""
        input:
            answers=expand(
                "results/suite/{suite}/answers/{shard}.json", suite=SUITE["name"], shard=SUITE_SHARDS
            ),
            truths=expand(
                "results/suite/{suite}/sealed/{shard}.json", suite=SUITE["name"], shard=SUITE_SHARDS
            ),
        output:
            f"results/suite/{SUITE['name']}/score.json",
        log:
            f"logs/suite/{SUITE['name']}/score.log",
        benchmark:
            f"logs/benchmarks/suite/{SUITE['name']}/score.tsv"
        conda:
            "../envs/real2sim.yaml"
        threads: 1
        resources:
            mem_mb=600,
            runtime=10,
        params:
            suite=SUITE["name"],
            code=code("suite-score"),
        shell:
            "python -m real2sim suite-score --answers {input.answers:q} --truths {input.truths:q}"
            " --suite {params.suite} --out {output:q} 2>&1 | tee {log:q}"

    rule suite_page:
        """The score as a page."""
        input:
            f"results/suite/{SUITE['name']}/score.json",
        output:
            f"results/suite/{SUITE['name']}/score.html",
        log:
            f"logs/suite/{SUITE['name']}/page.log",
        benchmark:
            f"logs/benchmarks/suite/{SUITE['name']}/page.tsv"
        conda:
            "../envs/real2sim.yaml"
        threads: 1
        resources:
            mem_mb=600,
            runtime=10,
        params:
            code=code("suite-page"),
        shell:
            "python -m real2sim suite-page --score {input:q} --out {output:q} 2>&1 | tee {log:q}"

    rule suite:
        """Cases, answers and score of the diagnosis suite."""
        input:
            f"results/suite/{SUITE['name']}/score.html",
