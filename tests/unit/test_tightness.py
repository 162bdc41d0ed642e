"""Normalised tightness, the sweep table, the knee and the operating point, joint limits."""

import json

import numpy as np
import pytest
from real2sim.artefacts import number, read_table, write_table
from real2sim.errors import InputError
from real2sim.study.limits import joint_limits
from real2sim.study.tightness import (
    normalised_tightness,
    tightness_breakpoints,
    tightness_cohort,
    tightness_sweep,
)
from synthetic_results import write_pose, write_subject_yaml, write_sweep_poses

SETTINGS = {"bootstrap": 300, "permutations": 499, "seed": 1, "alpha": 0.05, "min_levels": 6}


@pytest.mark.parametrize(("loosest", "tightest", "selected"), [(5, 13, 9), (13, 5, 9), (4, 12, 9)])
def test_normalised_tightness_is_zero_at_the_selected_level_and_grows_with_tightness(
    loosest, tightest, selected
):
    scale = {"loosest": loosest, "tightest": tightest, "selected": selected}
    ends = normalised_tightness(np.array([loosest, selected, tightest]), **scale)
    assert ends[1] == 0
    assert ends[0] < 0 < ends[2]
    assert ends[2] - ends[0] == 2


def _person(folder, subject, *, levels=range(5, 14), selected=9, noise=0.3, seed=0, flip=False):
    """Sweep and breakpoints of one person; ``flip`` writes the levels as remaining strap length."""
    own = folder / subject
    poses = write_sweep_poses(own, list(levels), selected, noise=noise, seed=seed)
    ends = {"loosest": min(levels), "tightest": max(levels), "selected": selected}
    if flip:
        for path in poses:
            kind, level = path.parent.name.split("_T")
            path.parent.rename(own / f"{kind}-T{20 - int(level):02d}")
        for folder_ in list(own.glob("*-T*")):
            folder_.rename(own / folder_.name.replace("-", "_"))
        poses = list(own.glob("*/pose.parquet"))
        ends = {key: 20 - value for key, value in ends.items()}
    subject_yaml = write_subject_yaml(own / "subject.yaml", **ends)
    sweep, breakpoints = own / "sweep.csv", own / "breakpoints.json"
    tightness_sweep(subject=subject, poses=poses, subject_yaml=subject_yaml, out=sweep)
    tightness_breakpoints(
        subject=subject, sweep=sweep, subject_yaml=subject_yaml, settings=SETTINGS, out=breakpoints
    )
    return sweep, breakpoints


def test_sweep_holds_the_ranges_of_each_level(tmp_path):
    rows = read_table(_person(tmp_path, "S01", noise=0.0)[0])
    assert [r["level_cm"] for r in rows] == [str(level) for level in range(5, 14)]
    assert [number(rows[i]["normalised_tightness"]) for i in (0, 4, 8)] == [-1.0, 0.0, 1.0]
    assert number(rows[4]["dphi_left_deg"]) == pytest.approx(8.0, rel=1e-4)
    assert number(rows[0]["dphi_deg"]) == pytest.approx(2 * (8 + 4 * 2.7), rel=1e-4)
    assert number(rows[0]["dx_mm"]) == pytest.approx(2 * 32.5, rel=1e-4)
    assert rows[0]["phantom"] == "true"


def test_knee_of_the_rotation_meets_the_selected_level(tmp_path):
    result = json.loads(_person(tmp_path, "S01", noise=0.0)[1].read_text())
    dphi = result["regressions"]["dphi"]
    assert [dphi["k1"], dphi["k2"]] == pytest.approx([-2.7 * 4, -0.2 * 4], abs=1e-3)
    assert dphi["exists"]
    assert result["operating_point"]["agree"]
    assert result["operating_point"]["difference_cm"] == pytest.approx(0.0, abs=1e-3)
    assert not result["regressions"]["dx"]["exists"]


def test_remaining_strap_length_gives_the_same_answer(tmp_path):
    drawn = json.loads(_person(tmp_path / "a", "S01")[1].read_text())
    remaining = json.loads(_person(tmp_path / "b", "S01", flip=True)[1].read_text())
    assert remaining["regressions"] == drawn["regressions"]
    assert remaining["operating_point"]["knee_cm"] == pytest.approx(20 - drawn["operating_point"]["knee_cm"])


def test_levels_whose_ends_are_exchanged_are_warned_about(tmp_path, capsys):
    for levels in (range(5, 14), (9, 11)):
        sweep, breakpoints = _person(tmp_path / str(len(levels)), "S01", levels=levels)
        assert json.loads(breakpoints.read_text())["warning"] == ""
        assert capsys.readouterr().out == ""
        ends = {"loosest": max(levels), "tightest": min(levels), "selected": 9}
        subject_yaml = write_subject_yaml(sweep.parent / "subject.yaml", **ends)
        poses = list(sweep.parent.glob("*/pose.parquet"))
        tightness_sweep(subject="S01", poses=poses, subject_yaml=subject_yaml, out=sweep)
        tightness_breakpoints(
            subject="S01", sweep=sweep, subject_yaml=subject_yaml, settings=SETTINGS, out=breakpoints
        )
        warning = json.loads(breakpoints.read_text())["warning"]
        assert "loosest_cm and tightest_cm of subject.yaml are exchanged" in warning
        assert "rotation by" in warning
        assert f"S01: {warning}" in capsys.readouterr().out


def test_too_few_levels_give_a_reason_and_no_number(tmp_path):
    result = json.loads(_person(tmp_path, "S01", levels=range(7, 12))[1].read_text())
    assert result["regressions"]["dphi"] == {
        "unit": "deg",
        "n_levels": 5,
        "status": "needs at least 6 levels, have 5",
    }
    assert result["operating_point"]["agree"] is None


def test_cohort_shares_the_knee_in_rotation_only(tmp_path):
    persons = [_person(tmp_path, f"S{s:02d}", selected=8 + s % 3, seed=s) for s in range(1, 6)]
    out = tmp_path / "cohort.json"
    sweeps, breakpoints = zip(*persons, strict=True)
    tightness_cohort(sweeps=list(sweeps), breakpoints=list(breakpoints), settings=SETTINGS, out=out)
    cohort = json.loads(out.read_text())
    low, high = cohort["pooled"]["dphi"]["breakpoint_interval"]
    assert low <= 0.05
    assert high >= -0.05
    assert cohort["persons"]["dphi"]["n_with_breakpoint"] == 5
    assert cohort["n_agree"] == 5
    assert not cohort["pooled"]["dx"]["exists"]
    tightness_cohort(sweeps=[sweeps[0]], breakpoints=[breakpoints[0]], settings=SETTINGS, out=out)
    assert json.loads(out.read_text())["status"] == "needs at least 2 people, have 1"


def test_who_has_no_rotation_counts_for_nothing_in_the_pooled_rotation(tmp_path):
    (own, own_knee), (other, other_knee) = (_person(tmp_path, f"S{s:02d}", seed=s) for s in (1, 2))
    rows = read_table(other)
    for row in rows:
        row.update({name: "" for name in row if name.startswith("dphi")})
    write_table(other, list(rows[0]), rows)
    out = tmp_path / "cohort.json"
    tightness_cohort(sweeps=[own, other], breakpoints=[own_knee, other_knee], settings=SETTINGS, out=out)
    pooled = json.loads(out.read_text())["pooled"]
    alone = json.loads(own_knee.read_text())["regressions"]["dphi"]
    assert (pooled["dphi"]["n_subjects"], pooled["dx"]["n_subjects"]) == (1, 2)
    assert pooled["dphi"]["breakpoint_interval"] == alone["breakpoint_interval"]
    for path in (own, other):
        rows = read_table(path)
        write_table(path, list(rows[0]), [row | {n: "" for n in row if n.startswith("dphi")} for row in rows])
    tightness_cohort(sweeps=[own, other], breakpoints=[own_knee, other_knee], settings=SETTINGS, out=out)
    assert "needs at least" in json.loads(out.read_text())["pooled"]["dphi"]["status"]


def test_people_who_were_not_swept_keep_their_names_and_are_not_counted(tmp_path):
    sweep, breakpoints = _person(tmp_path, "S01")
    sweeps, persons = [sweep], [breakpoints]
    for name in ("S06", "S07"):
        yaml = write_subject_yaml(tmp_path / name / "subject.yaml", loosest=4, tightest=12, selected=9)
        yaml.write_text(yaml.read_text() + "phantom: true\n")
        sweeps.append(tmp_path / name / "sweep.csv")
        persons.append(tmp_path / name / "breakpoints.json")
        tightness_sweep(subject=name, poses=[], subject_yaml=yaml, out=sweeps[-1])
        tightness_breakpoints(
            subject=name, sweep=sweeps[-1], subject_yaml=yaml, settings=SETTINGS, out=persons[-1]
        )
        record = json.loads(persons[-1].read_text())
        assert (record["subject"], record["phantom"]) == (name, True)
    out = tmp_path / "cohort.json"
    tightness_cohort(sweeps=sweeps, breakpoints=persons, settings=SETTINGS, out=out)
    cohort = json.loads(out.read_text())
    assert list(cohort["operating_points"]) == ["S01", "S06", "S07"]
    assert cohort["persons"]["dphi"]["n_subjects"] == 1


def test_masked_trial_is_refused(tmp_path):
    path = write_pose(tmp_path / "rotation_T09" / "pose.parquet", {"rz": np.full(50, np.nan)})
    subject_yaml = write_subject_yaml(tmp_path / "subject.yaml", loosest=5, tightest=13, selected=9)
    with pytest.raises(InputError, match="q_rz"):
        tightness_sweep(
            subject="S01",
            poses=[path],
            subject_yaml=subject_yaml,
            out=tmp_path / "sweep.csv",
        )


def _limits(folder):
    swing = np.sin(np.linspace(0, 2 * np.pi, 401))
    rotation = write_pose(folder / "rotation_T09" / "pose.parquet", {"rz": 0.2 * swing, "tx": 0.01 * swing})
    tx = np.where(np.arange(401) == 300, np.nan, 0.03 * swing)
    translation = write_pose(folder / "translation_T09" / "pose.parquet", {"tx": tx, "ty": 0.05 * swing})
    neutral = write_pose(folder / "neutral" / "pose.parquet", {"tx": 0.001 * swing})
    paths = {"rotation": rotation, "translation": translation, "neutral": neutral}
    joint_limits(subject="S01", out=folder / "S01.json", **paths)
    return json.loads((folder / "S01.json").read_text())


def test_joint_limits_are_the_extremes_over_both_trials(tmp_path):
    limits = _limits(tmp_path)
    assert limits["q_max"] == pytest.approx([0.03, 0.05, 0, 0, 0, 0.2])
    assert limits["q_min"] == pytest.approx([-0.03, -0.05, 0, 0, 0, -0.2], abs=1e-5)
    assert limits["recorded"]["tx"]["max_at"] == {"trial": "translation_T09", "time_s": 1.0}
    assert limits["recorded"]["tx"]["neutral_range"] == pytest.approx([-0.001, 0.001])
    assert limits["phantom"] is True
    assert "not observable" in limits["notes"][0]


def test_limits_of_an_axis_without_any_value_name_file_axis_and_remedy(tmp_path):
    lost = {"rz": np.linspace(-0.1, 0.1, 50), "rx": np.full(50, np.nan)}
    paths = {
        kind: write_pose(tmp_path / name / "pose.parquet", lost)
        for kind, name in (("rotation", "rotation_T09"), ("translation", "translation_T09"))
    }
    neutral = write_pose(tmp_path / "neutral" / "pose.parquet", {"tx": np.zeros(50)})
    with pytest.raises(InputError) as error:
        joint_limits(subject="S01", neutral=neutral, out=tmp_path / "S01.json", **paths)
    for part in ("rotation_T09/pose.parquet", "q_rx", "translation_T09/pose.parquet", "exclude"):
        assert part in str(error.value)


def test_limits_that_leave_rest_outside_are_refused(tmp_path):
    write = {"tx": np.full(10, 0.02), "ty": np.zeros(10), "rz": np.zeros(10)}
    paths = {
        name: write_pose(tmp_path / folder / "pose.parquet", write)
        for name, folder in (("rotation", "rotation_T09"), ("translation", "translation_T09"))
    }
    neutral = write_pose(tmp_path / "neutral" / "pose.parquet", {"tx": np.zeros(10)})
    with pytest.raises(InputError, match="holds rest"):
        joint_limits(subject="S01", neutral=neutral, out=tmp_path / "S01.json", **paths)
