"""A refused trial stops before its fit; overridden by name it is fitted, and all that rests on the fit says so."""

from __future__ import annotations

from functools import partial
from pathlib import Path

import pytest
from real2sim.artefacts import read_json, read_table
from real2sim.configuration import read_yaml, validated
from real2sim.errors import InputError
from real2sim.pages.fits import convergence_figure
from real2sim.pages.style import new_figure
from real2sim.pages.tables import cross_trial_table, priors_table
from real2sim.recording.ingest import ingest_subject
from real2sim.recording.quality.stage import quality_subject
from real2sim.recording.quality.verdict import overridden_gates, overridden_trials, require
from real2sim.study.assessment import assessment, assessment_table
from real2sim.study.fit import fit_trial
from real2sim.study.limits import joint_limits
from real2sim.study.noise_floor import noise_floor
from real2sim.study.statistics.loso import loso_table
from real2sim.study.statistics.shareability import priors, shareability
from real2sim.study.transfer import cross_trial, loso_subject

from benchmarks import faults

CONFIG = validated({}, "config", Path("defaults"))
CONFIG["identification"] |= {"evaluations": 22, "restarts": 1}
CONFIG["statistics"] |= {"bootstrap": 50, "min_subjects": 3}
ROBOT = faults.ROOT / CONFIG["paths"]["robot"]
PUBLISHED = faults.ROOT / CONFIG["paths"]["published"]
TRIALS = ("dynamic_1", "dynamic_2")
RESTS_ON = ("neutral", "rotation_T10", "translation_T10")
MARK = {"S01/dynamic_1": ["excitation"]}


@pytest.fixture(scope="module")
def study(tmp_path_factory):
    """One short phantom person: raw exports, tables, joint limits and a fixed time step."""
    source = faults.ROOT / "config" / "phantom.yaml"
    phantom = validated(read_yaml(source), "phantom", source)
    phantom["cohort"] = {"S01": phantom["cohort"]["S01"]}
    phantom["cohort"]["S01"]["tightness"] = {"loosest_cm": 10, "tightest_cm": 11, "safe_comfortable_cm": 10}
    phantom["trials"] |= {"dynamic_s": 8.0, "walk_s": 3.0, "walk_robot_trials": 1, "neutral_s": 5.0}
    root = tmp_path_factory.mktemp("study")
    faults.simulate(root, ["S01"], phantom)
    raw, trials = root / "raw" / "S01", root / "trials"
    ingest_subject(subject="S01", folder=raw, settings=CONFIG["ingest"], raw=[], out=trials)
    poses = {name: trials / name / "pose.parquet" for name in RESTS_ON}
    joint_limits(
        subject="S01",
        rotation=poses["rotation_T10"],
        translation=poses["translation_T10"],
        neutral=poses["neutral"],
        out=root / "limits.json",
    )
    (root / "step.json").write_text('{"timestep_s": 0.01}')
    return root


def _gates(study: Path, out: Path, refused: str, override: dict[str, str]) -> list[Path]:
    """Gates of the person, with thresholds that refuse ``refused``: dynamic trials or the neutral one."""
    excitation = CONFIG["quality"]["excitation"] | {"warn": 100.0, "refuse": 99.0}
    strict = {"dynamic": {"excitation": excitation}, "neutral": {"noise": {"warn": 0.0, "refuse": 0.0}}}
    quality_subject(
        subject="S01",
        folder=study / "raw" / "S01",
        settings={
            "quality": CONFIG["quality"] | strict[refused] | {"override": override},
            "ingest": CONFIG["ingest"],
            "scales": CONFIG["identification"]["scales"],
            "start_window_s": CONFIG["identification"]["start_window_s"],
            "start_known_share": CONFIG["identification"]["start_known_share"],
        },
        raw=[],
        out=out,
    )
    return [out / f"{name}.json" for name in RESTS_ON]


def _slices(*names: str) -> dict:
    return {name: CONFIG[name] for name in names}


def _fit(study: Path, trial: str, gates: list[Path], out: Path) -> None:
    fit_trial(
        subject="S01",
        trial=trial,
        restarts=[1],
        pose=study / "trials" / trial / "pose.parquet",
        markers=study / "trials" / trial / "markers.parquet",
        limits=study / "limits.json",
        step=study / "step.json",
        gates=gates,
        robot=ROBOT,
        settings=_slices("identification", "plant", "robot"),
        out=[out],
    )


def test_refused_trial_stops_and_says_how_to_go_on(study, tmp_path):
    rests_on = _gates(study, tmp_path, "dynamic", {"S01/dynamic_1": "pilot"})
    with pytest.raises(InputError, match="gate excitation") as error:
        _fit(study, "dynamic_2", [tmp_path / "dynamic_2.json", *rests_on], tmp_path / "fit.json")
    assert 'quality.override: {"S01/dynamic_2": "<reason>"}' in error.value.remedy
    assert not (tmp_path / "fit.json").exists()


def test_fit_is_held_back_by_the_trials_it_rests_on_too(study, tmp_path):
    rests_on = _gates(study, tmp_path / "a", "neutral", {})
    with pytest.raises(InputError, match="gate noise") as error:
        _fit(study, "dynamic_1", [tmp_path / "a" / "dynamic_1.json", *rests_on], tmp_path / "fit.json")
    assert "S01/neutral" in error.value.remedy
    rests_on = _gates(study, tmp_path / "b", "neutral", {"S01/neutral": "old cameras"})
    mark = require([tmp_path / "b" / "dynamic_1.json", *rests_on], "dynamic_1")
    assert mark == {"S01/neutral": ["noise"]}


def test_mark_of_an_overridden_fit_is_in_every_result(study, tmp_path):
    override = {"S01/dynamic_1": "pilot", "S01/dynamic_2": "pilot"}
    rests_on = _gates(study, tmp_path / "gates", "dynamic", override)
    accepted = tmp_path / "gates" / "dynamic_2.json"
    accepted.write_text(accepted.read_text().replace('"refused": [', '"refused": [], "was": ['))
    fits = {trial: tmp_path / trial / "restart-1.json" for trial in TRIALS}
    for trial, out in fits.items():
        _fit(study, trial, [tmp_path / "gates" / f"{trial}.json", *rests_on], out)
    assert read_json(fits["dynamic_1"])["overridden_gates"] == MARK
    assert read_json(fits["dynamic_2"])["overridden_gates"] == {}

    everything = list(fits.values())
    tables = {name: tmp_path / f"{name}.csv" for name in ("fits", "icc", "priors", "loso")}
    out = {name: tmp_path / f"{name}.json" for name in ("assessment", "floor", "cross", "loso")}
    about = {"subject": "S01", "limits": study / "limits.json", "step": study / "step.json", "robot": ROBOT}
    of_trial = [study / "trials" / trial for trial in TRIALS]
    poses, markers = ([t / f"{n}.parquet" for t in of_trial] for n in ("pose", "markers"))
    neutral = study / "trials" / "neutral"
    slices = partial(_slices, "identification", "plant", "robot")
    assessment(
        **about,
        trial="dynamic_1",
        fits=[fits["dynamic_1"]],
        pose=poses[0],
        markers=markers[0],
        neutral_quality=neutral / "quality.json",
        settings=slices() | _slices("identifiability", "ingest"),
        out=out["assessment"],
    )
    noise_floor(
        **about,
        fits=everything,
        pose=neutral / "pose.parquet",
        markers=neutral / "markers.parquet",
        settings=slices() | _slices("identifiability"),
        out=out["floor"],
    )
    cross_trial(**about, fits=everything, poses=poses, markers=markers, settings=slices(), out=out["cross"])
    shareability(
        fits=everything, settings=CONFIG["statistics"], out_fits=tables["fits"], out_icc=tables["icc"]
    )
    loso_subject(
        **about,
        fits=everything,
        cohort=tables["fits"],
        poses=poses,
        markers=markers,
        published=PUBLISHED / "table1_priors.csv",
        settings=slices() | _slices("statistics"),
        out=out["loso"],
    )
    for path in out.values():
        assert read_json(path)["overridden_gates"] == MARK, path.name

    inputs = {"fits": tables["fits"], "icc": tables["icc"], "published": PUBLISHED / "table1_priors.csv"}
    priors(**inputs, settings=CONFIG["statistics"], out=tables["priors"])
    loso_table(loso=[out["loso"]], settings=CONFIG["statistics"], out=tables["loso"])
    shown = {name: tmp_path / f"{name}.csv" for name in ("table", "verdicts", "cross_trial")}
    priors_table(priors=tables["priors"], published=PUBLISHED / "table1_priors.csv", out=shown["table"])
    assessment_table(assessments=[out["assessment"]], out=shown["verdicts"])
    cross_trial_table(
        cross_trial=[out["cross"]],
        floors=[out["floor"]],
        published=PUBLISHED / "cross_trial.csv",
        out=shown["cross_trial"],
    )
    for path in (*tables.values(), *shown.values()):
        cells = [row["overridden"] for row in read_table(path)]
        ours = {
            "fits": ["S01/dynamic_1", ""],  # the other trial's fit is unmarked
            "cross_trial": ["S01/dynamic_1", "S01/dynamic_1", ""],  # the paper's mean is unmarked
        }
        assert cells == ours.get(path.stem, ["S01/dynamic_1"] * len(cells)), path.name

    convergence_figure(fits=everything, floors=[out["floor"]], out=[tmp_path / "convergence.pdf"])


def test_marks_are_united_and_named():
    records = [{"overridden_gates": {"S02/neutral": ["noise"]}}, {}, {"overridden_gates": MARK}]
    records.append({"overridden_gates": {"S02/neutral": ["gaps"]}})
    assert overridden_gates(records) == MARK | {"S02/neutral": ["gaps", "noise"]}
    assert overridden_trials(records) == "S01/dynamic_1 S02/neutral"
    title = new_figure(2.0, phantom=False, overridden=overridden_gates(records)).get_suptitle()
    assert title == "rests on refused trials: S01/dynamic_1, S02/neutral"
