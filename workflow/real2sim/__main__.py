"""Command line of the stages: ``python -m real2sim <command> --option value``.

Options are the keyword arguments of the stage's function; their annotations say how they are read.
"""

from __future__ import annotations

import argparse
import importlib
import inspect
import json
import os
import sys
import traceback
import types
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NoReturn, get_args, get_origin, get_type_hints, is_typeddict

from real2sim import settings

COMMANDS = {
    "phantom": "real2sim.verification.cohort.write:write_subject",
    "suite-cases": "real2sim.verification.suite.write:write_cases",
    "ingest": "real2sim.recording.ingest:ingest_subject",
    "quality-subject": "real2sim.recording.quality.stage:quality_subject",
    "quality-table": "real2sim.recording.quality.stage:quality_table",
    "quality-figure": "real2sim.pages.quality:quality_figure",
    "tightness-sweep": "real2sim.study.tightness:tightness_sweep",
    "tightness-breakpoints": "real2sim.study.tightness:tightness_breakpoints",
    "tightness-cohort": "real2sim.study.tightness:tightness_cohort",
    "joint-limits": "real2sim.study.limits:joint_limits",
    "step-study": "real2sim.study.step_study:step_study",
    "fit": "real2sim.study.fit:fit_trial",
    "fit-with-effects": "real2sim.study.explained:fit_with_effects",
    "assessment": "real2sim.study.assessment:assessment",
    "assessment-table": "real2sim.study.assessment:assessment_table",
    "noise-floor": "real2sim.study.noise_floor:noise_floor",
    "cross-trial": "real2sim.study.transfer:cross_trial",
    "loso": "real2sim.study.transfer:loso_subject",
    "loso-table": "real2sim.study.statistics.loso:loso_table",
    "refine": "real2sim.study.refinement:refine",
    "person-interface": "real2sim.study.interface:export_interface",
    "shareability": "real2sim.study.statistics.shareability:shareability",
    "priors": "real2sim.study.statistics.shareability:priors",
    "nested-variance": "real2sim.study.statistics.nested:nested_variance",
    "classes": "real2sim.study.statistics.classes:classes",
    "anthropometrics": "real2sim.study.statistics.anthropometrics:anthropometrics",
    "coverage-study": "real2sim.study.statistics.study:coverage_study",
    "diagnose": "real2sim.study.diagnose:diagnose",
    "diagnosis-model": "real2sim.study.diagnosis_model:export_model",
    "motion": "real2sim.pages.motion.export:export_motion",
    "motion-clip": "real2sim.pages.motion_clip:motion_clip",
    "suite-diagnose": "real2sim.verification.answers:diagnose_cases",
    "suite-score": "real2sim.verification.score:score_diagnosis",
    "paper-gap-person": "real2sim.verification.paper_gap.people:person_with_cause",
    "paper-gap-cohort": "real2sim.verification.paper_gap.cohort:cohort_with_cause",
    "paper-gap-causes": "real2sim.verification.paper_gap.ranking:rank_causes",
    "twin-human": "real2sim.study.twin.human:twin_human",
    "twin-reference": "real2sim.study.twin.reference:twin_reference",
    "twin-train": "real2sim.study.twin.train:twin_train",
    "twin-evaluate": "real2sim.study.twin.stage:twin_evaluate",
    "twin-coupled": "real2sim.study.twin.stage:twin_coupled",
    "twin-table": "real2sim.study.twin.stage:twin_table",
    "twin-clip": "real2sim.pages.twin_clip:twin_clip",
    "gait-figure": "real2sim.pages.twin:gait_figure",
    "interface-figure": "real2sim.pages.twin:interface_figure",
    "speed-figure": "real2sim.pages.twin:speed_figure",
    "wrench-figure": "real2sim.pages.twin:wrench_figure",
    "paper-tables": "real2sim.study.paper.tables:paper_tables",
    "with-effects": "real2sim.study.paper.with_effects:with_effects",
    "paper-figures": "real2sim.study.paper.tables:paper_figures",
    "claims": "real2sim.study.paper.claims:claims",
    "paper-gap-figure": "real2sim.pages.paper_gap:paper_gap_figure",
    "tightness-figure": "real2sim.pages.tightness:tightness_figure",
    "convergence-figure": "real2sim.pages.fits:convergence_figure",
    "icc-figure": "real2sim.pages.fits:icc_figure",
    "coverage-figure": "real2sim.pages.coverage:coverage_figure",
    "gap-figure": "real2sim.pages.gap:gap_figure",
    "loso-figure": "real2sim.pages.fits:loso_figure",
    "priors-table": "real2sim.pages.tables:priors_table",
    "cross-trial-table": "real2sim.pages.tables:cross_trial_table",
    "diagnosis-page": "real2sim.pages.diagnosis:diagnosis_page",
    "diagnosis-table": "real2sim.pages.diagnosis:diagnosis_table",
    "suite-page": "real2sim.pages.suite:suite_page",
    "person-page": "real2sim.pages.person:person_page",
    "report-page": "real2sim.pages.report.page:report_page",
}


def module_of(command: str) -> str:
    """Return the library module that a command runs."""
    return COMMANDS[command].split(":")[0]


def _load(command: str) -> Callable[..., None]:
    module, name = COMMANDS[command].split(":")
    function: Callable[..., None] = getattr(importlib.import_module(module), name)
    return function


def _json(text: str) -> Any:
    try:
        return json.loads(text)
    except ValueError as error:
        raise argparse.ArgumentTypeError(f"not JSON: {error}") from error


def _flag(text: str) -> bool:
    if text not in ("true", "false"):
        raise argparse.ArgumentTypeError("true or false")
    return text == "true"


def _add(parser: argparse.ArgumentParser, name: str, annotation: Any, required: bool) -> None:
    option: dict[str, Any] = {"dest": name, "required": required}
    if get_origin(annotation) is types.UnionType:
        annotation = next(a for a in get_args(annotation) if a is not type(None))
    if get_origin(annotation) is list:
        option |= {"nargs": "*", "type": get_args(annotation)[0]}
    elif get_origin(annotation) is dict or annotation is dict or is_typeddict(annotation):
        option["type"] = _json
    elif annotation is bool:
        option["type"] = _flag
    else:
        option["type"] = annotation
    parser.add_argument(f"--{name.replace('_', '-')}", **option)


def _parse(command: str, function: Callable[..., None], arguments: Sequence[str]) -> dict[str, Any]:
    summary = (inspect.getdoc(function) or "").split("\n\n")[0]
    parser = argparse.ArgumentParser(
        prog=f"python -m real2sim {command}", description=summary, allow_abbrev=False
    )
    # types of the configuration's slices, which modules import for the type checker alone
    hints = get_type_hints(function, localns=vars(settings))
    defaults = inspect.signature(function).parameters
    for name, parameter in defaults.items():
        _add(parser, name, hints[name], parameter.default is inspect.Parameter.empty)
    given = vars(parser.parse_args(arguments))
    return {
        name: value
        for name, value in given.items()
        if value is not None or defaults[name].default is inspect.Parameter.empty
    }


def _missing(given: dict[str, Any], error: FileNotFoundError) -> Exception:
    """Return the refusal of a path that was given and is not there; the error itself where none of them is."""
    from real2sim.errors import InputError

    named = {str(error.filename), *map(str, error.args)}
    for name, value in given.items():
        for path in value if isinstance(value, list) else [value]:
            if isinstance(path, Path) and str(path) in named and not path.exists():
                expected = f"what --{name.replace('_', '-')} takes: a file or folder that is there"
                remedy = "Correct the path, or let Snakemake make the file: it runs the stage that writes it."
                return InputError(path, "", "nothing there", expected, remedy)
    return error


def main(arguments: Sequence[str]) -> int:
    """Run one stage; exit code 2 for bad input, whose message names the file and the remedy."""
    # one job uses the threads it was given: linear algebra libraries would take every core
    for variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
        os.environ.setdefault(variable, "1")
    if not arguments or arguments[0] not in COMMANDS:
        print(f"usage: python -m real2sim <command> ...\ncommands: {', '.join(COMMANDS)}", file=sys.stderr)
        return 2
    from real2sim.errors import InputError
    from real2sim.failures import FAILED
    from real2sim.provenance import CODE, CODE_FILE

    # the code's fingerprint is part of a result: the rules have read the library before
    CODE.load(CODE_FILE)
    command, *rest = arguments
    function = _load(command)
    try:
        given = _parse(command, function, rest)
        try:
            function(**given)
        except FileNotFoundError as error:
            raise _missing(given, error) from error
    except InputError as error:
        print(f"\n{FAILED} '{command}': {error}\n", file=sys.stderr)
        return 2
    except Exception as error:
        traceback.print_exc()
        print(f"\n{FAILED} '{command}': {type(error).__name__}: {error}\n", file=sys.stderr)
        return 1
    return 0


def entry() -> NoReturn:
    """Run the console script ``real2sim`` and end the process with the stage's exit code."""
    sys.exit(main(sys.argv[1:]))


if __name__ == "__main__":
    entry()
