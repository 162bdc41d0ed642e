"""pHRI Real2Sim: raw exports -> joint limits -> identification -> priors -> LOSO -> figures.

    snakemake --cores 2                                    the whole study at the paper's budget
    snakemake --cores 2 --configfile config/quick.yaml     the same line in minutes
    snakemake --cores 2 diagnosis                          which unmodelled effect causes the gap of each person
    snakemake --cores 2 suite --config suite=config/suite-ci.yaml   how often the diagnosis is right, on sealed cases
    snakemake --cores 2 paper_gap                          which unmodelled effect would have made the paper's numbers
    snakemake --cores 2 person_S06                         one person from the priors: refined interface, MJCF, page
    snakemake --cores 2 motion                             every fitted trial as a file to watch in Foxglove
    snakemake --cores 2 twin                               does the identified interface make a simulated person adapt
    snakemake --cores 2 quality                            what the recordings are worth, without fitting anything

What the settings mean: config/README.md. One file per stage, in the order of the DAG: workflow/rules/.
"""

from snakemake.utils import min_version

min_version("9.0")


configfile: "config/config.yaml"


report: "workflow/report/study.rst"


include: "workflow/rules/common.smk"
include: "workflow/rules/phantom.smk"
include: "workflow/rules/ingest.smk"
include: "workflow/rules/quality.smk"
include: "workflow/rules/tightness.smk"
include: "workflow/rules/limits.smk"
include: "workflow/rules/identification.smk"
include: "workflow/rules/shareability.smk"
include: "workflow/rules/diagnosis.smk"
include: "workflow/rules/people.smk"
include: "workflow/rules/motion.smk"
include: "workflow/rules/twin.smk"
include: "workflow/rules/paper.smk"
include: "workflow/rules/figures.smk"
include: "workflow/rules/with_effects.smk"
include: "workflow/rules/suite.smk"
include: "workflow/rules/paper_gap.smk"


forget_rule_functions()
explain_report()


rule all:
    """Everything: tables, figures and the page that holds them."""
    default_target: True
    input:
        everyone_can_be_calibrated,
        "results/report.html",
        rules.paper_figures.output,
        rules.paper_tables.output,
        rules.claims.output,
        SHARE_TABLES,
        DIAGNOSES if STUDY["diagnosed"] == "everyone" else [],
        [rules.with_effects.output, rules.claims_with_effects.output] if len(EXPLAINED) > 1 else [],
        PEOPLE_PAGES,
        expand("results/people/{subject}/interface.xml", subject=VALIDATION),
        "results/tightness/cohort.json",
        "results/quality/quality.csv",
        expand("results/quality/{subject}/gates.png", subject=PEOPLE),
        expand("results/trials/{subject}/neutral/quality.json", subject=PEOPLE),
