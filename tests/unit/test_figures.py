"""Figures are written, the same bytes for the same data."""

import pytest
from matplotlib.figure import Figure
from real2sim.artefacts import number, read_json, read_table, write_json
from real2sim.diagnosis.stated import answer_probability
from real2sim.pages.diagnosis import answer_words, chi2_closed, chi2_per_residual
from real2sim.pages.fits import _icc_panel, convergence_figure, icc_figure, loso_figure
from real2sim.pages.gap import gap_figure
from real2sim.pages.style import NAMED_PEOPLE, PHANTOM_LABEL, new_figure, person_style, signed
from real2sim.pages.tables import cross_trial_table, priors_table
from real2sim.pages.tightness import tightness_figure
from real2sim.study.statistics.loso import loso_table
from real2sim.study.statistics.shareability import priors, shareability
from real2sim.study.tightness import tightness_breakpoints, tightness_cohort, tightness_sweep
from synthetic_results import write_fits, write_loso, write_subject_yaml, write_sweep_poses
from synthetic_study import PUBLISHED, STATISTICS, TIGHTNESS


def _results(folder, people, phantom=True):
    fits = write_fits(folder / "fits", people, phantom=phantom, restarts=2)
    tables = {name: folder / f"{name}.csv" for name in ("fits", "icc", "priors", "loso")}
    shareability(fits=fits, settings=STATISTICS, out_fits=tables["fits"], out_icc=tables["icc"])
    published = PUBLISHED / "table1_priors.csv"
    inputs = {"fits": tables["fits"], "icc": tables["icc"], "published": published}
    priors(settings=STATISTICS, out=tables["priors"], **inputs)
    loso = write_loso(folder / "loso", people) if people > 2 else []
    loso_table(loso=loso, settings=STATISTICS, out=tables["loso"])
    return fits, tables


@pytest.mark.parametrize("people", [4, 1])
def test_figures_of_the_fits_are_written_and_deterministic(tmp_path, people):
    fits, tables = _results(tmp_path, people)
    runs = []
    for run in ("a", "b"):
        out = {
            n: [tmp_path / run / f"{n}.{e}" for e in ("png", "pdf", "svg")]
            for n in ("icc", "loso", "convergence")
        }
        icc_figure(fits=tables["fits"], icc=tables["icc"], out=out["icc"])
        loso_figure(loso=tables["loso"], out=out["loso"])
        convergence_figure(fits=fits[:4], floors=[], out=out["convergence"])
        runs.append([path.read_bytes() for paths in out.values() for path in paths])
    assert runs[0] == runs[1]
    assert all(b"CreationDate" not in content for content in runs[0])


def test_of_many_people_a_figure_shows_a_few_or_all_as_one_cloud(tmp_path, monkeypatch):
    monkeypatch.setattr("real2sim.pages.style.NAMED_PEOPLE", 3)
    fits, tables = _results(tmp_path, 5)
    apart = read_json(fits[-1])
    write_json(fits[-1], apart | {"cost": apart["cost"] | {"J": 10 * apart["cost"]["J"]}})
    out = [tmp_path / "figure.svg"]
    convergence_figure(fits=fits, floors=[], out=out)
    text = out[0].read_text()
    assert "3 of 5 people" in text
    assert apart["subject"] in text, "whose restarts end farthest apart"
    assert sum(f"S{i:02d}, dynamic_1" in text for i in range(1, 6)) == 3
    icc_figure(fits=tables["fits"], icc=tables["icc"], out=out)
    assert "S01" not in out[0].read_text()
    loso_figure(loso=tables["loso"], out=out)
    assert "of 5 people" in out[0].read_text()


def _answers(folder, marked=(), **verdicts):
    out = []
    for name, verdict in verdicts.items():
        named = verdict not in ("none", "unknown")
        plain = 0.04 if verdict == "none" else 1.2
        chi2 = {"chi2_plain": [0, 1e5 * plain], "chi2_best": [0, 4e3 if named else 1e5 * plain]}
        gap = chi2 | {"chi2_expected": [4e3, 4e3]}
        out.append(folder / f"{name}.json")
        trials = {"train": ["dynamic_1"], "held_out": ["dynamic_2"], "shown_on": ["dynamic_2"]}
        answer = {"subject": name, "verdict": verdict, "verdict_set": [verdict], "phantom": True}
        answer |= {"misfit": {"marked": name in marked} if named else None}
        write_json(out[-1], answer | trials | {"probabilities": {verdict: 0.97}, "gap": gap})
    return out


def test_gap_is_that_of_the_trial_which_shows_it_and_a_set_has_one_probability():
    answer = {
        "verdict": "slack",
        "verdict_set": ["slack", "coulomb"],
        "probabilities": {"slack": 0.5, "coulomb": 0.45, "unknown": 0.05},
        "considered": [{"effects": ["coulomb", "slack"], "probability": 0.95}],
        "gap": {"chi2_plain": [900, 300], "chi2_best": [200, 150], "chi2_expected": [100, 100]},
        "train": ["dynamic_2"],
        "held_out": ["dynamic_1"],
    }
    assert chi2_per_residual(answer | {"shown_on": ["dynamic_2"]}) == (9, 2)
    assert chi2_per_residual(answer) == (3, 1.5)
    assert chi2_closed(answer) == pytest.approx(0.75)
    assert answer_words(answer) == "slack + coulomb"
    assert answer_probability(answer) == pytest.approx(0.95)
    better = answer | {"gap": answer["gap"] | {"chi2_best": [50, 50]}}
    assert chi2_closed(better) == 1, "better than noise is no more than all"
    assert chi2_closed(answer | {"verdict": "unknown"}) is None
    assert chi2_per_residual(answer | {"gap": {}}) is None


def test_a_sensor_on_its_floor_hides_nothing_of_the_gap_of_another():
    answer = {
        "verdict": "slack",
        "train": ["dynamic_1"],
        "held_out": ["dynamic_2"],
        "shown_on": ["dynamic_2"],
    }
    gap = {"chi2_plain": [0, 1010], "chi2_best": [0, 100], "chi2_expected": [100, 100]}
    parts = {"on_floor": [False, True], "chi2_expected": [[50, 50], [50, 50]]}
    parts |= {"chi2_plain": [[0, 0], [1000, 10]], "chi2_best": [[0, 0], [90, 10]]}
    assert chi2_per_residual(answer | {"gap": gap | {"by_sensor": parts}}) == (10.5, 1.4)
    parts["on_floor"] = [False, False]
    assert chi2_per_residual(answer | {"gap": gap | {"by_sensor": parts}}) == (10.1, 1)


def test_figure_of_the_gaps_names_everyone_and_the_answer(tmp_path, monkeypatch):
    answers, out = _answers(tmp_path, S01="soft_tissue", S02="none", S03="unknown"), [tmp_path / "gap.svg"]
    gap_figure(diagnoses=answers, out=out)
    text = out[0].read_text()
    assert all(
        part in text for part in ("S01", "soft tissue (97 %)", "none (97 %)", "unknown (97 %)", PHANTOM_LABEL)
    )
    # of many, those with the largest gaps
    monkeypatch.setattr("real2sim.pages.style.NAMED_PEOPLE", 2)
    gap_figure(diagnoses=answers, out=out)
    assert "S02" not in out[0].read_text()
    mark = "misfit mark"
    assert mark not in out[0].read_text()
    gap_figure(diagnoses=_answers(tmp_path, marked=["S02"], S01="soft_tissue", S02="slack"), out=out)
    assert mark in out[0].read_text()
    assert "misfit of the held-out trial" in out[0].read_text()
    assert "of the fitted trial" not in out[0].read_text()
    other = read_json(answers[0])
    gap = {key: pair[::-1] for key, pair in other["gap"].items()}
    write_json(answers[0], other | {"shown_on": other["train"], "gap": gap})
    gap_figure(diagnoses=answers[:1], out=out)
    assert "of the fitted trial, which alone shows the gap" in out[0].read_text()
    gap_figure(diagnoses=[], out=out)
    assert "nobody was diagnosed" in out[0].read_text()


def test_no_two_named_people_look_alike():
    looks = [tuple(person_style(index).values()) for index in range(NAMED_PEOPLE)]
    assert len(set(looks)) == NAMED_PEOPLE


def test_every_icc_lies_inside_its_panel(tmp_path):
    _, tables = _results(tmp_path, 4)
    rows = read_table(tables["icc"])
    for lowest, limit in ((-0.05, -0.15), (-0.6, -0.65)):
        rows[0] |= {"icc_untruncated": str(lowest), "exact_low": str(lowest)}
        axes = Figure().subplots()
        _icc_panel(axes, rows[:1])
        assert axes.get_xlim()[0] == pytest.approx(limit)


def test_tightness_figure_is_written(tmp_path):
    poses = write_sweep_poses(tmp_path / "S01", list(range(5, 13)), 9, noise=0.3)
    subject_yaml = write_subject_yaml(tmp_path / "subject.yaml", loosest=5, tightest=12, selected=9)
    sweep, breakpoints, cohort = (tmp_path / n for n in ("sweep.csv", "breakpoints.json", "cohort.json"))
    tightness_sweep(subject="S01", poses=poses, subject_yaml=subject_yaml, out=sweep)
    tightness_breakpoints(
        subject="S01", sweep=sweep, subject_yaml=subject_yaml, settings=TIGHTNESS, out=breakpoints
    )
    tightness_cohort(sweeps=[sweep], breakpoints=[breakpoints], settings=TIGHTNESS, out=cohort)
    out = [tmp_path / "tightness.png", tmp_path / "tightness.pdf"]
    tightness_figure(sweeps=[sweep], cohort=cohort, out=out)
    assert all(path.stat().st_size > 5000 for path in out)


def test_phantom_label_follows_the_data():
    assert new_figure(2.0, phantom=True).get_suptitle() == PHANTOM_LABEL
    assert new_figure(2.0, phantom=False).get_suptitle() == ""
    assert [signed(-0.001, 1), signed(-1.26, 1)] == ["0.0", "\N{MINUS SIGN}1.3"]


def test_priors_table_compares_ours_and_leaves_the_published_alone(tmp_path):
    for people, compared in ((4, True), (1, False)):
        _, tables = _results(tmp_path / str(people), people)
        out = tmp_path / f"{people}.csv"
        priors_table(priors=tables["priors"], published=PUBLISHED / "table1_priors.csv", out=out)
        row = read_table(out)[0]
        assert row["published_prior"] == "725"
        assert bool(row["ratio_to_published_1"]) is compared
        if compared:
            assert number(row["ratio_to_published_1"]) == pytest.approx(number(row["prior"]) / 725)


def test_cross_trial_table_has_persons_mean_and_paper(tmp_path):
    paths = []
    for s, cross in enumerate((1.2, 1.4)):
        path = tmp_path / f"S0{s + 1}.json"
        costs = {"J_within_mean": 1.0, "J_cross_mean": cross, "overhead": cross - 1}
        write_json(path, {"subject": path.stem, "phantom": True, "pairs": [{}, {}]} | costs)
        paths.append(path)
    out = tmp_path / "cross.csv"
    cross_trial_table(cross_trial=paths, floors=[], published=PUBLISHED / "cross_trial.csv", out=out)
    rows = {row["subject"]: row for row in read_table(out)}
    assert number(rows["mean"]["overhead_percent"]) == pytest.approx(30.0)
    assert rows["paper"]["overhead_percent"] == "14.5"
    assert rows["paper"]["phantom"] == "false"


def test_cross_trial_table_says_that_nobody_has_two_dynamic_trials(tmp_path):
    paths = [tmp_path / f"S0{i}.json" for i in (1, 2, 3)]
    for path in paths:
        status = "needs at least 2 dynamic trials, has 1"
        write_json(path, {"subject": path.stem, "phantom": False, "status": status, "pairs": []})
    out = tmp_path / "cross.csv"
    cross_trial_table(cross_trial=paths, floors=[], published=PUBLISHED / "cross_trial.csv", out=out)
    rows = {row["subject"]: row for row in read_table(out)}
    assert rows["mean"]["status"] == "needs two dynamic trials of a person, and nobody has them"


def test_results_never_hold_nan(tmp_path):
    _, tables = _results(tmp_path, 1)
    for path in tables.values():
        cells = path.read_text().lower().replace("\n", ",").split(",")
        assert not {"nan", "inf", "-inf"} & set(cells)
