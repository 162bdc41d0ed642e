"""Who takes part, which trials they have, and what every rule needs.

Inputs:  the configuration, resources/subjects or config/phantom.yaml.
Outputs: none.
Steps:   check the configuration; find the people; name their trials; fingerprint the code of each stage.
"""

import atexit
import functools
import gc
import json
import os
import sys
import time
from pathlib import Path

from snakemake.exceptions import WorkflowError
from snakemake.logging import logger

# a DAG has no cycles worth looking for, and of a thousand people every search takes seconds
gc.disable()

LIBRARY_ROOT = str(Path(workflow.basedir) / "workflow")
sys.path.insert(0, LIBRARY_ROOT)
# jobs find the library, and the interpreter that runs Snakemake: no environment has to be activated
os.environ.update(
    PYTHONPATH=LIBRARY_ROOT,
    PATH=os.pathsep.join([str(Path(sys.executable).parent), os.environ.get("PATH", "")]),
)

from real2sim.__main__ import module_of
from real2sim.configuration import read_yaml, validated
from real2sim.contents import Contents
from real2sim.errors import InputError
from real2sim.failures import FailedJobs, failures
from real2sim.shell import braced
from real2sim.inference.parameters import PARAMETERS
from real2sim.verification.paper_gap.plan import CAUSES, STUDY_ROBOT
from real2sim.verification.cohort.plan import planned_files, planned_subjects, read_settings
from real2sim.verification.suite.plan import case_names, expected_time, left_out, shards
from real2sim.provenance import CODE, CODE_FILE, fingerprint
from real2sim.recording.subjects import discover, require_dynamic, require_operating_point, require_pair
from real2sim.system.model_files import model_files

# those that later stages ask for come first: Snakemake looks for who makes a file from the front
TABLES = ["pose.parquet", "markers.parquet", "quality.json", "joints.parquet", "robot.parquet"]


def load_study(raw_config):
    """Checked configuration, people by id, and the phantom's settings (None with real data)."""
    sources = ", ".join(map(str, workflow.configfiles)) or "config"
    for source in workflow.configfiles:
        # Snakemake has read them already and keeps the last of a key that stands twice
        if Path(source).suffix in (".yaml", ".yml"):
            read_yaml(Path(source))
    study = validated(raw_config, "config", sources)
    check_braces(study, sources)
    if study["cohort"] != "phantom":
        check_path(study, sources, "subjects", Path.is_dir, "the folder of the people's folders")
    people = {} if study["cohort"] == "phantom" else discover(Path(study["paths"]["subjects"]))
    phantom = None
    if study["cohort"] == "phantom" or (study["cohort"] == "auto" and not people):
        phantom = read_settings(Path(study["paths"]["phantom"]))
        people = planned_subjects(phantom, Path("results/phantom/raw"))
    if not people:
        raise nobody_to_calibrate(study, people)
    check_path(study, sources, "robot", Path.is_file, "the MJCF of the robot (docs/how-to/robot.md)")
    check_path(study, sources, "published", Path.is_dir, "the folder of the paper's tables")
    # what lies below results/ may not have been made yet
    if not Path(study["refinement"]["priors"]).is_relative_to("results"):
        check_path(study, sources, "priors", Path.is_file, "a table of priors", part="refinement")
    check_overrides(study["quality"]["override"], people, sources)
    return study, people, phantom


def check_braces(study, sources):
    """Raise InputError where a folder has a brace in its name: Snakemake takes that for the place of a wildcard."""
    places = {"the folder of the project": str(Path(workflow.basedir))} | {
        f"paths.{key}": str(path) for key, path in study["paths"].items()
    }
    for place, path in places.items():
        if "{" in path or "}" in path:
            source = path if place.startswith("the") else sources
            expected = "names without { and }, which Snakemake takes for a wildcard"
            raise InputError(source, place, path, expected, "Rename or move the folder.")


def check_path(study, sources, key, is_there, what, part="paths"):
    """Raise InputError where a path of a part of the configuration leads nowhere.

    Rules that need it would only miss an input, results of before would stand, and without a folder of people the
    phantom would take their place.
    """
    path = study[part][key]
    if is_there(Path(path)):
        return
    remedy = "Correct the path, or leave the key out for the default"
    if key == "subjects":
        remedy = "Correct the path or make the folder; give `--config cohort=phantom` to run the phantom"
    raise InputError(
        sources,
        f"{part}.{key}",
        f"nothing at {path}",
        f"{what}, relative to the folder in which Snakemake runs",
        f"{remedy}.",
        "no_file",
    )


def check_overrides(overrides, people, sources):
    """Raise InputError where an overridden trial is nobody's: found before any job, as a wrong `exclude` is."""
    known = {f"{name}/{trial}" for name, person in people.items() for trial in person.trials}
    for key in overrides:
        if key not in known:
            person = key.partition("/")[0]
            trials = ", ".join(people[person].trials) if person in people else f"people {', '.join(people)}"
            raise InputError(
                sources,
                f"quality.override.{key}",
                "no such trial",
                f"<SUBJECT>/<TRIAL> of a trial that is there: {trials}",
                "Correct the name, or remove it.",
                "trial_name",
            )


def nobody_to_calibrate(study, people):
    """The error for a study of nobody, or for priors of a cohort that has none to calibrate."""
    phantom = "give `--config cohort=phantom` to run the phantom"
    found, remedy = "nobody", f"Add a person (config/README.md), or {phantom}."
    if people:
        count = f"{len(people)} people" if len(people) > 1 else "1 person"
        found = f"{count}, none with `cohort: calibration` in subject.yaml"
        remedy = (
            "Write `cohort: calibration` in one subject.yaml; or ask for one person by name, for whom the published"
            f" priors stand in (`snakemake --cores 2 person_{next(iter(people))}`); or {phantom}."
        )
    return InputError(study["paths"]["subjects"], "", found, "at least one person to calibrate on", remedy)


def suite_settings(asked):
    """Checked configuration of the diagnosis suite; None where there is none, which no study needs that asks for none."""
    source = Path(STUDY["suite"])
    for key, path in (("suite", source), ("paths.phantom", Path(STUDY["paths"]["phantom"]))):
        if not path.is_file():
            if not asked:
                return None
            there = ", ".join(sorted(str(other) for other in source.parent.glob("suite*.yaml")))
            expected = "a file of settings" + (f", such as {there}" if key == "suite" and there else "")
            error = InputError("config", key, f"nothing at {path}", expected, "Correct the path.", "no_file")
            raise WorkflowError(f"\n{error}")
    return validated(read_yaml(source), "suite", source)


def phantom_settings():
    """Checked settings of the phantom as JSON, also where real people take part."""
    return json.dumps(read_settings(Path(STUDY["paths"]["phantom"])))


class People(dict):
    """People of the study by id; a name that nobody bears ends the planning with what to do."""

    def __missing__(self, name):
        raise WorkflowError(
            f"\n{name}"
            f"\n  found:    no person {name} in {STUDY['paths']['subjects']}"
            f"\n  expected: one of {', '.join(self)}"
            f"\n  remedy:   add the person's folder (docs/how-to/new-person.md), or correct the name"
        )


try:
    STUDY, PEOPLE, PHANTOM = load_study(config)
except InputError as error:
    raise WorkflowError(f"\n{error}") from None
PEOPLE = People(PEOPLE)

CALIBRATION = [name for name, person in PEOPLE.items() if person.cohort == "calibration"]
# people whom twin.cohort asks for, and those of them with walks without a robot, from which a simulated twin learns
TWIN_COHORT = [name for name, person in PEOPLE.items() if STUDY["twin"]["cohort"] in ("all", person.cohort)]
TWINS = [name for name in TWIN_COHORT if PEOPLE[name].trials_of("walk_normal")]
# priority of what stands at the head of the longest chains of jobs: a twin's recordings, gait and trainings, and the
# fits, whose priors its walks with the robot wait for
LONGEST = 1
RESTARTS = range(1, STUDY["identification"]["restarts"] + 1)
ROBOT = STUDY["paths"]["robot"]
PUBLISHED = STUDY["paths"]["published"]
# Snakemake goes by dates, which a renamed, restored or unpacked file keeps: inputs of the lab count by their contents
CONTENTS = Contents(Path(".snakemake") / "real2sim" / "contents.json")
atexit.register(CONTENTS.save)
# parsing the whole library for its fingerprints takes seconds: only what changed is parsed again
CODE.load(CODE_FILE)
atexit.register(CODE.save, CODE_FILE)
ROBOT_CONTENT = CONTENTS.of(model_files(Path(ROBOT)))
FIT_SETTINGS = json.dumps({key: STUDY[key] for key in ("identification", "plant", "robot")})
DIAGNOSIS_SETTINGS = json.dumps(
    {
        key: STUDY[key]
        for key in ("ingest", "identification", "identifiability", "plant", "robot", "diagnosis")
    }
)


wildcard_constraints:
    subject="[A-Za-z0-9]+",
    trial="[a-z]+(_[a-zA-Z0-9]+)*",
    restart=r"\d+",
    cause="[a-z_]+",


STARTED = time.time()
FAILED_JOBS = FailedJobs()
logger.addHandler(FAILED_JOBS)


onerror:
    # in the last lines of the run, what failed, why, and where its log is
    for failure in failures(Path("logs"), STARTED, FAILED_JOBS.jobs):
        print(f"\n{failure}", file=sys.stderr)
    print("\nFinished files are kept: the same command goes on from here.", file=sys.stderr)


def forget_rule_functions():
    """Take what Snakemake leaves of each rule out of the globals.

    The rules keep it themselves, but Snakemake copies all globals for every command that it formats: with two rules per
    person, four tenths of the plan of a thousand people.
    """
    for name in [each.name for each in workflow.rules]:
        workflow.globals.pop(f"__{name}", None)


def explain_report():
    """Say what to do where a report is asked for of results that are not there: Snakemake names the first file alone."""
    asked = any(argument.partition("=")[0] == "--report" for argument in sys.argv)
    if asked and not Path("results/report.html").exists():
        logger.warning(
            "results/report.html is not there: --report bundles the results of a finished run. Give the same command"
            " without --report first; or name a target that was run: snakemake quality --report quality.html"
        )


def code(command):
    """Fingerprint of the code that a command runs, as a param: Snakemake does not see imported modules."""
    return fingerprint(module_of(command))


# parts of a slice with one reader each, so that a change of them repeats nothing else
PARTS = {"statistics": ("regression", "study")}


def settings_of(*slices, part=None):
    """The named slices of the configuration as JSON: one slice bare, several by name; without PARTS but the one named."""
    chosen = {
        name: (
            {key: value for key, value in STUDY[name].items() if key == part or key not in PARTS[name]}
            if name in PARTS
            else STUDY[name]
        )
        for name in slices
    }
    return json.dumps(chosen if len(slices) > 1 else chosen[slices[0]])


def protocols():
    """People by what they recorded: (ending of a rule's name, trials, pattern of their names).

    What a rule writes has to be known before anyone is looked at, so those who have the same trials share one; whoever
    has trials that nobody else has gets one of their own. A rule per person would do as well, but of a thousand people
    that takes a fifth of the plan.
    """
    alike = {}
    for name, person in PEOPLE.items():
        alike.setdefault(tuple(person.trials), []).append(name)
    shared = [names for names in alike.values() if len(names) > 1]
    # nobody's name has an underscore
    endings = {names[0]: f"_shared_{i}" if i else "" for i, names in enumerate(shared)}
    return [
        (endings.get(names[0], f"_{names[0]}"), list(trials), "|".join(names))
        for trials, names in alike.items()
    ]


def before_twin(names):
    """Return the priority of a job of these people: what a training waits for is begun first."""
    return LONGEST if set(names) & set(TWINS) else 0


def raw_files(wildcards):
    """subject.yaml, which stands first, and every raw export of a person."""
    person = PEOPLE[wildcards.subject]
    recordings = (
        path for files in person.trials.values() for path in (files.markers, files.markerless, files.log)
    )
    return [str(person.folder / "subject.yaml"), *(str(path) for path in recordings if path is not None)]


def raw_content(wildcards):
    """Fingerprint of what `raw_files` hold, as a param; those of the phantom are made by a rule and count as its outputs."""
    return CONTENTS.of(raw_files(wildcards)) if PHANTOM is None else ""


def subject_content(*names):
    """Fingerprint of what people's subject.yaml hold, as a param; see `raw_content`."""
    if PHANTOM is not None:
        return ""
    return CONTENTS.of(PEOPLE[name].folder / "subject.yaml" for name in names)


def poses_of(subject, *kinds):
    """pose.parquet of a person's trials of some kinds."""
    return [f"results/trials/{subject}/{trial}/pose.parquet" for trial in PEOPLE[subject].trials_of(*kinds)]


def markers_of(subject, *kinds):
    """markers.parquet of a person's trials of some kinds, in the order of `poses_of`."""
    return [str(Path(path).with_name("markers.parquet")) for path in poses_of(subject, *kinds)]


def first_dynamic(wildcards):
    """Pose and markers of a person's first dynamic trial, which has to be there."""
    try:
        require_dynamic(PEOPLE[wildcards.subject])
    except InputError as error:
        raise WorkflowError(f"\n{error}") from None
    return {
        "pose": poses_of(wildcards.subject, "dynamic")[0],
        "markers": markers_of(wildcards.subject, "dynamic")[0],
    }


def everyone_can_be_calibrated(wildcards):
    """Nothing, where the calibration cohort has someone, and everyone in it the trials that a fit needs.

    It is asked for targets: a rule whose input functions refuse is not planned where its results are there already,
    and Snakemake goes on with those.
    """
    fits_of_cohort(wildcards)
    for name in CALIBRATION:
        asked_for(lambda person=PEOPLE[name]: require_dynamic(person))
        asked_for(lambda person=PEOPLE[name]: require_operating_point(person))
    return []


def diagnosed_trials(wildcards):
    """pose.parquet of the dynamic trials of a person who has the two that a diagnosis needs."""
    asked_for(lambda: require_pair(PEOPLE[wildcards.subject]))
    return poses_of(wildcards.subject, "dynamic")


def fits_of(subjects):
    """All fit files of some people."""
    return [
        f"results/fits/{name}/{trial}/restart-{restart}.json"
        for name in subjects
        for trial in PEOPLE[name].trials_of("dynamic")
        for restart in RESTARTS
    ]


def fits_of_cohort(wildcards):
    """All fits of the calibration cohort, which has to have someone."""
    if not CALIBRATION:
        raise WorkflowError(f"\n{nobody_to_calibrate(STUDY, PEOPLE)}")
    return fits_of(CALIBRATION)


def gates_of_fit(wildcards):
    """Verdicts on a fitted trial and on those that its fit rests on: rest pose and joint limits."""
    trials = [wildcards.trial, "neutral", *PEOPLE[wildcards.subject].operating_point]
    return [f"results/quality/{wildcards.subject}/{trial}.json" for trial in trials]


def operating_point(wildcards, kind):
    """pose.parquet of the rotation or translation trial at the person's T*."""
    person = PEOPLE[wildcards.subject]
    try:
        require_operating_point(person)
    except InputError as error:
        raise WorkflowError(f"\n{error}") from None
    trial = person.operating_point[kind == "translation"]
    return f"results/trials/{wildcards.subject}/{trial}/pose.parquet"


def where_limits_are_known(wildcards, stage):
    """results/<stage>/<SUBJECT>.json where the sweeps at T* were recorded, else nothing: a diagnosis goes without."""
    return f"results/{stage}/{wildcards.subject}.json" if PEOPLE[wildcards.subject].has_limits else []


def is_fitted(subject):
    """Whether all dynamic trials of a person are fitted in full: for the priors, or to compare a refinement with."""
    whom = STUDY["refinement"]["compare"]
    return subject in CALIBRATION or whom == "always" or (whom == "first" and subject in VALIDATION[:1])


def full_calibration(wildcards):
    """All fits of a person where a refinement is compared with them."""
    return fits_of([wildcards.subject]) if is_fitted(wildcards.subject) else []


def where_refined(wildcards, stage):
    """results/<stage>/<SUBJECT>.json where a dynamic trial can be replayed within limits, else nothing."""
    return where_limits_are_known(wildcards, stage) if PEOPLE[wildcards.subject].trials_of("dynamic") else []


def gates_of_refinement(wildcards):
    """Verdicts on all dynamic trials and on those that a fit rests on."""
    person = PEOPLE[wildcards.subject]
    point = person.operating_point if person.has_limits else ()
    trials = ["neutral", *point, *person.trials_of("dynamic")]
    return [f"results/quality/{wildcards.subject}/{trial}.json" for trial in trials]


def where_swept(wildcards):
    """Breakpoints of a person who was swept, else nothing."""
    swept = PEOPLE[wildcards.subject].trials_of("rotation", "translation")
    return f"results/tightness/{wildcards.subject}/breakpoints.json" if swept else []


def where_diagnosed(wildcards):
    """diagnosis.json of a person with two dynamic trials, else nothing."""
    return f"results/diagnosis/{wildcards.subject}/diagnosis.json" if wildcards.subject in DIAGNOSED else []


def model_where_diagnosed(wildcards):
    """model.xml of a person with two dynamic trials, else nothing."""
    return f"results/diagnosis/{wildcards.subject}/model.xml" if wildcards.subject in DIAGNOSED else []


def explained_poses(subject):
    """pose.parquet of a person's two diagnosed trials."""
    return poses_of(subject, "dynamic")[:2]


def explained_fits(subject, folder="results/with_effects/fits"):
    """Fits of a person's two diagnosed trials: those with the causes in the model, or those of another folder."""
    return [
        f"{folder}/{subject}/{Path(pose).parent.name}/restart-{restart}.json"
        for pose in explained_poses(subject)
        for restart in RESTARTS
    ]


def plain_side(path):
    """Plain result to compare with one that has the causes: of the same people and of the same trials.

    That is the study's own, unless the study also holds calibration people who were not diagnosed, or third trials.
    """
    same_people = EXPLAINED == CALIBRATION
    same_trials = all(poses_of(name, "dynamic") == explained_poses(name) for name in EXPLAINED)
    return path if same_people and same_trials else path.replace("results/", "results/with_effects/plain/", 1)


def causes_of(wildcards, input):
    """Options that put diagnosed causes into the replays of a command, where its rule is given a diagnosis."""
    if not input.get("diagnosis"):
        return []
    return given(diagnosis=input.diagnosis, neutral=Path(input.neutral).parent)


def given(**options):
    """Options of a command for those inputs that there are."""
    return [part for name, path in options.items() if path for part in (f"--{name}", path)]


def given_all(name, paths):
    """Option of a command that takes any number of paths, where there is one."""
    return [f"--{name}", *paths] if paths else []


PAPER_GAP_TABLES = ["table1_priors", "cross_trial", "loso", "bounds", "claims", "pelvis_inertia"]


def asked_for(make):
    """What a setting that only some targets need gives; what is wrong with it ends the planning of those alone."""
    try:
        return make()
    except InputError as error:
        raise WorkflowError(f"\n{error}") from None


def someone_takes_part(target, chosen, left_out, remedy):
    """Input function of a target: it says who is left out and why, and ends the planning where nobody remains.

    ``left_out`` holds the reason by the person's name. Snakemake asks more than once, and is answered once.
    """
    told = []

    def nothing(wildcards):
        reasons = [f"{name}: {why}" for name, why in left_out.items()]
        if not chosen:
            found = "; ".join(reasons) or "nobody of the study"
            error = InputError(
                STUDY["paths"]["subjects"],
                f"target {target}",
                f"nobody it can be made for ({found})",
                "one person at least",
                remedy,
                "trial_missing",
            )
            raise WorkflowError(f"\n{error}")
        if reasons and not told:
            told.append(target)
            logger.warning(f"{target}: left out are {'; '.join(reasons)}. {remedy}")
        return []

    return nothing


def why_not_watched(name):
    """Why a person has no motion to watch."""
    if not PEOPLE[name].trials_of("dynamic"):
        return "no dynamic trial"
    if not PEOPLE[name].has_limits:
        return f"no {' and '.join(PEOPLE[name].operating_point)}, which give the joint limits"
    return "dynamic trials that are not fitted in full (refinement.compare)"


def without_twin():
    """Who gets no twin and why, by name; whom the setting leaves out is told where nobody else remains."""
    return {
        name: "no walk_normal trial" if name in TWIN_COHORT else f"twin.cohort is {STUDY['twin']['cohort']}"
        for name in PEOPLE
        if name not in TWINS and (name in TWIN_COHORT or not TWINS)
    }


@functools.cache
def paper_gap_phantom():
    """Checked settings of the phantom that cohorts with one cause are made of."""
    return asked_for(lambda: read_settings(Path(STUDY["paper_gap"]["phantom"])))


def people_of_paper_gap(wildcards):
    """Folders of the calibration people of a cohort with one cause."""
    cohort = paper_gap_phantom()["cohort"]
    names = [name for name, facts in cohort.items() if facts["cohort"] == "calibration"]
    return [f"results/paper_gap/people/{wildcards.cause}/{name}" for name in names]


def recorded_with(cause):
    """MJCF and controllers, as JSON, of the robot that holds the strap in the recordings of a cohort with one cause."""
    if cause != STUDY_ROBOT:
        return ROBOT, settings_of("robot")
    other = robot_of(Path(STUDY["paper_gap"]["study_robot"]))
    return other["model"], json.dumps(other["robot"])


def robot_of(source):
    """MJCF and controllers of the robot that a configuration of the study names."""
    other = asked_for(lambda: validated(read_yaml(source), "config", source))
    return {"model": other["paths"]["robot"], "robot": other["robot"]}


@functools.cache
def other_robots():
    """Robots, by name, that may have held the strap beside the configured one."""
    return {name: robot_of(Path(source)) for name, source in STUDY["diagnosis"]["robots"].items()}


def models_of_other_robots(wildcards):
    """Files of the models of the other robots."""
    return [other["model"] for other in other_robots().values()]


@functools.cache
def content_of_robots():
    """Content of the models of the configured robot and of the others."""
    others = (Path(other["model"]) for other in other_robots().values())
    return CONTENTS.of(
        [*model_files(Path(ROBOT)), *(path for model in others for path in model_files(model))]
    )


def no_such_person(wildcards):
    """The error for a name that nobody bears."""
    return PEOPLE[wildcards.unknown]


def folders_of(subject, kind):
    """Folders of canonical tables of a person's trials of a kind."""
    return [str(Path(path).parent) for path in poses_of(subject, kind)]


def further_of(subject):
    """Option of the command for a person's third and further dynamic trials; nothing where there are two."""
    folders = folders_of(subject, "dynamic")[2:]
    return ["--further", *folders] if folders else []


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
