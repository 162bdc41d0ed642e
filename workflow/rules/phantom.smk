"""The phantom cohort: synthetic people written as raw exports. Runs only where there are no real people.

Inputs:  config/phantom.yaml, the robot twin.
Outputs: results/phantom/raw/<SUBJECT>/*, results/phantom/sealed/<SUBJECT>.json (truth: no analysis may read it).
Steps:   one job per person simulates and writes all trials.
"""

if PHANTOM is not None:
    for _name in PEOPLE:

        rule:
            """One synthetic person as raw exports, and the sealed truth."""
            name:
                f"phantom_{_name}"
            input:
                robot=ROBOT,
                lock="environment-lock.txt",
            output:
                raw=[str(path) for path in planned_files(PHANTOM, Path("results/phantom/raw"), _name)],
                truth=f"results/phantom/sealed/{_name}.json",
            log:
                f"logs/phantom/{_name}.log",
            benchmark:
                f"logs/benchmarks/phantom/{_name}.tsv"
            priority: before_twin([_name])
            conda:
                "../envs/real2sim.yaml"
            threads: 1
            resources:
                mem_mb=600,
                runtime=20,
            params:
                subject=_name,
                settings=json.dumps(PHANTOM),
                controllers=settings_of("robot"),
                robot=ROBOT_CONTENT,
                code=code("phantom"),
            shell:
                "python -m real2sim phantom --subject {params.subject} --settings {params.settings:q}"
                " --controllers {params.controllers:q} --robot {input.robot:q}"
                " --out {output.raw:q} --truth {output.truth:q} 2>&1 | tee {log:q}"
