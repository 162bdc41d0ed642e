"""Who takes part, which trials they have, and what every rule needs.

Inputs:  the configuration, resources/subjects or config/phantom.yaml.
Outputs: none.
Steps:   check the configuration; find the people; name their trials; fingerprint the code of each stage.
"""

import json
import os
import sys
import time
from pathlib import Path

from snakemake.exceptions import WorkflowError

LIBRARY_ROOT = str(Path(workflow.basedir) / "workflow")
sys.path.insert(0, LIBRARY_ROOT)
# jobs find the library, and the interpreter that runs Snakemake: no environment has to be activated
os.environ.update(
    PYTHONPATH=LIBRARY_ROOT,
    PATH=os.pathsep.join([str(Path(sys.executable).parent), os.environ.get("PATH", "")]),
)

from real2sim.__main__ import FAILED, module_of
from real2sim.configuration import read_yaml, validated
from real2sim.errors import InputError
from real2sim.identification.parameters import PARAMETERS
from real2sim.phantom.plan import planned_files, planned_subjects
from real2sim.phantom.suite.plan import case_names, shards
from real2sim.provenance import fingerprint
from real2sim.subjects import discover

TABLES = ["markers.parquet", "pose.parquet", "joints.parquet", "robot.parquet", "quality.json"]


def load_study(raw_config):
    """Checked configuration, people by id, and the phantom's settings (None with real data)."""
    sources = ", ".join(map(str, workflow.configfiles)) or "config"
    study = validated(raw_config, "config", sources)
    people = {} if study["cohort"] == "phantom" else discover(Path(study["paths"]["subjects"]))
    phantom = None
    if study["cohort"] == "phantom" or (study["cohort"] == "auto" and not people):
        source = Path(study["paths"]["phantom"])
        phantom = validated(read_yaml(source), "phantom", source)
        people = planned_subjects(phantom, Path("results/phantom/raw"))
    if not any(person.cohort == "calibration" for person in people.values()):
        raise InputError(
            study["paths"]["subjects"],
            "",
            f"{len(people)} people, none with `cohort: calibration` in subject.yaml",
            "at least one person to calibrate on",
            "Add a person (config/README.md), or set `cohort: auto` to run the phantom.",
        )
    return study, people, phantom


def suite_settings():
    """Checked configuration of the diagnosis suite; None where there is none, which no study needs."""
    source = Path(STUDY["suite"])
    if not (source.exists() and Path(STUDY["paths"]["phantom"]).exists()):
        return None
    return validated(read_yaml(source), "suite", source)


def phantom_settings():
    """Checked settings of the phantom as JSON, also where real people take part."""
    source = Path(STUDY["paths"]["phantom"])
    return json.dumps(validated(read_yaml(source), "phantom", source))


try:
    STUDY, PEOPLE, PHANTOM = load_study(config)
except InputError as error:
    raise WorkflowError(f"\n{error}") from None

CALIBRATION = [name for name, person in PEOPLE.items() if person.cohort == "calibration"]
RESTARTS = range(1, STUDY["identification"]["restarts"] + 1)
ROBOT = STUDY["paths"]["robot"]
PUBLISHED = STUDY["paths"]["published"]
FIT_SETTINGS = json.dumps({key: STUDY[key] for key in ("identification", "plant", "robot")})
DIAGNOSIS_SETTINGS = json.dumps(
    {key: STUDY[key] for key in ("ingest", "identification", "plant", "robot", "diagnosis")}
)


wildcard_constraints:
    subject="[A-Za-z0-9]+",
    trial="[a-z]+(_[a-zA-Z0-9]+)*",
    restart=r"\d+",


STARTED = time.time()


onerror:
    # in the last lines of the run, what failed, why, and where its log is
    for path in sorted(Path("logs").rglob("*.log")):
        if path.stat().st_mtime >= STARTED:
            text = path.read_text(encoding="utf-8", errors="replace")
            if FAILED in text:
                print(f"\n{text[text.rindex(FAILED):].strip()}\n  log:      {path}", file=sys.stderr)
    print("\nFinished files are kept: the same command goes on from here.", file=sys.stderr)


def code(command):
    """Fingerprint of the code that a command runs, as a param: Snakemake does not see imported modules."""
    return fingerprint(module_of(command))


def settings_of(*slices):
    """The named slices of the configuration as JSON: one slice bare, several by name."""
    if len(slices) == 1:
        return json.dumps(STUDY[slices[0]])
    return json.dumps({name: STUDY[name] for name in slices})


def canonical_tables(people=None):
    """Canonical tables of all trials of some people (all by default)."""
    return [
        f"results/trials/{name}/{trial}/{table}"
        for name in (PEOPLE if people is None else people)
        for trial in PEOPLE[name].trials
        for table in TABLES
    ]


def poses_of(subject, *kinds):
    """pose.parquet of a person's trials of some kinds."""
    return [f"results/trials/{subject}/{trial}/pose.parquet" for trial in PEOPLE[subject].trials_of(*kinds)]


def markers_of(subject, *kinds):
    """markers.parquet of a person's trials of some kinds, in the order of `poses_of`."""
    return [str(Path(path).with_name("markers.parquet")) for path in poses_of(subject, *kinds)]


def fits_of(subjects):
    """All fit files of some people."""
    return [
        f"results/fits/{name}/{trial}/restart-{restart}.json"
        for name in subjects
        for trial in PEOPLE[name].trials_of("dynamic")
        for restart in RESTARTS
    ]


def gates_of_fit(wildcards):
    """Verdicts on a fitted trial and on those that its fit rests on: rest pose and joint limits."""
    level = int(PEOPLE[wildcards.subject].tightness["safe_comfortable_cm"])
    trials = [wildcards.trial, "neutral", f"rotation_T{level:02d}", f"translation_T{level:02d}"]
    return [f"results/quality/{wildcards.subject}/{trial}.json" for trial in trials]


def operating_point(wildcards, kind):
    """pose.parquet of the rotation or translation trial at the person's T*."""
    level = int(PEOPLE[wildcards.subject].tightness["safe_comfortable_cm"])
    return f"results/trials/{wildcards.subject}/{kind}_T{level:02d}/pose.parquet"


def folders_of(subject, kind):
    """Folders of canonical tables of a person's trials of a kind."""
    return [str(Path(path).parent) for path in poses_of(subject, kind)]


def walk_tables(subject, *kinds):
    """Tables of walking trials that the twin reads."""
    return [
        str(Path(path).with_name(f"{table}.parquet"))
        for path in poses_of(subject, *kinds)
        for table in ("joints", "pose", "markers", "robot")
    ]


def twin_settings(*names):
    """The named parts of the slice `twin` as JSON: a job reruns where its own part changes."""
    return json.dumps({name: STUDY["twin"][name] for name in names})
