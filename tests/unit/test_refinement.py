"""A person from the priors: only what is open moves, ends are told, and the written interface moves as ours."""

from __future__ import annotations

import json
import shutil
from dataclasses import dataclass
from pathlib import Path

import mujoco
import numpy as np
import pytest
from real2sim.artefacts import number, read_table, write_json, write_table
from real2sim.configuration import validated
from real2sim.errors import InputError
from real2sim.inference.identifiability import AT_BOUND, assess
from real2sim.inference.parameters import PARAMETERS, Bounds, as_vector
from real2sim.study.interface import export_interface
from real2sim.study.refinement import (
    Search,
    against_full,
    beyond_ends,
    ends_reached,
    read_search,
    refine,
    refine_residuals,
    would_gain,
)
from real2sim.system.export import START_KEY
from recorded_trial import CONFIG, PUBLISHED, ROBOT, record

BOUNDS = Bounds(np.full(12, 1.0), np.full(12, 1000.0))
TRUTH = np.full(12, 40.0)
FREE = np.array([1, 4, 6])
N = 600
HOW = {"batch": 13, "iterations": 25, "ftol": 1e-10}
IDENTIFIABILITY = CONFIG["identifiability"]


def design(seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).standard_normal((N, 12)) / np.sqrt(N)


def linear(truth: np.ndarray = TRUTH, noise: float = 0.0):
    """Residuals A (ln p - ln p*) + noise, whose minimum is known."""
    scatter = noise * np.random.default_rng(1).standard_normal(N) / np.sqrt(N)
    return lambda parameters: np.log(parameters / truth) @ design().T + scatter


def search_of(prior: np.ndarray, low: float = 20.0, high: float = 80.0) -> Search:
    """The three of `FREE` inside [low, high], the others fixed."""
    bounds = Bounds(BOUNDS.lower.copy(), BOUNDS.upper.copy())
    bounds.lower[FREE], bounds.upper[FREE] = low, high
    return Search(prior, bounds, FREE, dict.fromkeys(PARAMETERS, ""))


def prior_of(**changed: float) -> np.ndarray:
    prior = TRUTH.copy()
    for name, value in changed.items():
        prior[PARAMETERS.index(name)] = value
    return prior


# -------------------- on residuals whose minimum is known


def test_truth_inside_the_intervals_is_found_and_the_rest_stays_to_the_last_bit():
    prior = prior_of(k_ty=30.1, k_ry=77.7, d_tx=25.3)
    refined = refine_residuals(linear(), search_of(prior), **HOW)
    np.testing.assert_allclose(refined.values[FREE], 40.0, rtol=1e-5)
    fixed = np.setdiff1d(np.arange(12), FREE)
    assert refined.values[fixed].tobytes() == prior[fixed].tobytes()
    assert refined.cost < 1e-10
    assert refined.history[0][1] == pytest.approx(np.sum(linear()(prior[None]) ** 2))
    assert ends_reached(refined.values, search_of(prior), BOUNDS, 0.02) == {}


def test_fixed_values_that_ln_and_exp_do_not_give_back_stay():
    prior = np.array([100 / 3 + i / 7 for i in range(12)])
    assert (np.exp(np.log(prior)) != prior).any()
    refined = refine_residuals(linear(), search_of(prior), **HOW)
    fixed = np.setdiff1d(np.arange(12), FREE)
    assert refined.values[fixed].tobytes() == prior[fixed].tobytes()


def test_truth_outside_an_interval_ends_at_its_end_and_is_said():
    truth = TRUTH.copy()
    truth[4] = 120.0
    search = search_of(prior_of())
    refined = refine_residuals(linear(truth), search, **HOW)
    assert refined.values[4] == pytest.approx(80.0, rel=1e-4)
    assert refined.values[4] <= 80.0
    said = ends_reached(refined.values, search, BOUNDS, 0.02)
    assert said == {"k_ry": "at the upper end of the interval: the interval does not hold this person"}
    further = beyond_ends(linear(truth), refined, search, BOUNDS, said, **HOW)
    assert further["parameters"] == {"k_ry": pytest.approx(120.0, rel=1e-4)}
    assert further["J"] < 1e-6 < refined.cost
    assert beyond_ends(linear(truth), refined, search, BOUNDS, {}, **HOW) is None


def test_an_end_that_is_the_bound_of_the_search_is_called_so():
    search = search_of(prior_of(), low=1.001)
    values = prior_of(k_ty=1.001)
    assert ends_reached(values, search, BOUNDS, 0.02) == {
        "k_ty": "at the lower bound of the search: the optimum may lie beyond it"
    }
    # a fixed parameter at a bound has no end
    assert ends_reached(prior_of(k_tx=1.0), search, BOUNDS, 0.02) == {}


def test_nothing_open_leaves_the_prior():
    search = search_of(prior_of(k_tx=55.5))
    fixed = Search(search.prior, search.bounds, np.array([], int), search.use)
    refined = refine_residuals(linear(), fixed, **HOW)
    assert refined.values.tobytes() == search.prior.tobytes()
    assert refined.evaluations == 1


def test_the_prior_that_is_wrong_is_named():
    truth = TRUTH.copy()
    truth[2] = 90.0
    residuals = linear(truth, noise=0.1)
    search = search_of(prior_of())
    refined = refine_residuals(residuals, search, **HOW)
    gained, evaluations = would_gain(
        residuals,
        np.arange(N),
        refined,
        search,
        BOUNDS,
        batch=13,
        lags=5,
        settings=IDENTIFIABILITY,
    )
    assert next(iter(gained)) == "k_tz"
    assert gained["k_tz"]["contradicts_prior"]
    assert gained["k_tz"]["value"] == pytest.approx(90.0, rel=0.05)
    assert set(gained) == set(PARAMETERS) - {PARAMETERS[i] for i in FREE}
    assert evaluations > 25
    # once it is free, noise alone would do as much as the others
    wider = Search(search.prior, search.bounds, np.array([1, 2, 4, 6]), search.use)
    again, _ = would_gain(
        residuals,
        np.arange(N),
        refine_residuals(residuals, wider, **HOW),
        wider,
        BOUNDS,
        batch=13,
        lags=5,
        settings=IDENTIFIABILITY,
    )
    assert sum(row["contradicts_prior"] for row in again.values()) <= 1


def test_verdicts_are_on_the_fitted_alone_and_know_the_others():
    noise = 0.01 * np.random.default_rng(3).standard_normal(N)
    a = np.random.default_rng(0).standard_normal((N, 12)) / np.sqrt(N)
    # the last column is all but the first free one: together they would be known badly
    a[:, 11] = a[:, 1] + 0.01 * a[:, 11]

    def residuals(parameters):
        return np.log(parameters / TRUTH) @ a.T + noise

    options = {"batch": 13, "rate_hz": 100.0, "settings": IDENTIFIABILITY}
    some = assess(residuals, TRUTH, np.arange(N), BOUNDS, fitted=FREE, **options)
    every = assess(residuals, TRUTH, np.arange(N), BOUNDS, **options)
    assert list(some["parameters"]) == [PARAMETERS[i] for i in FREE]
    assert some["parameters"]["k_ty"]["sd_ln"] < 0.1 * every["parameters"]["k_ty"]["sd_ln"]
    tight = Bounds(BOUNDS.lower.copy(), BOUNDS.upper.copy())
    tight.upper[1] = 30.0
    start = prior_of(k_ty=29.0)
    at_end = assess(residuals, start, np.arange(N), tight, fitted=FREE, **options)
    assert at_end["parameters"]["k_ty"]["verdict"] == AT_BOUND


def test_bars_are_met_together_or_not():
    full = {"J": 1.0, "evaluations_best_restart": 1000, "evaluations": 5000}
    assert against_full(1.02, 250, full)["met"]
    assert not against_full(1.021, 250, full)["met"]
    assert not against_full(1.0, 251, full)["met"]
    assert against_full(1.0, 250, full)["evaluations_over_all_restarts"] == 0.05


# -------------------- the table of priors


def table(path: Path, **changed: dict) -> Path:
    rows = [
        {"parameter": n, "prior": 40.0, "interval_low": 20.0, "interval_high": 80.0, "class": "common"}
        | changed.get(n, {})
        for n in PARAMETERS
    ]
    write_table(path, ["parameter", "prior", "interval_low", "interval_high", "class"], rows)
    return path


def test_classes_say_what_is_open_and_between_which_ends(tmp_path):
    wide = {"class": "uncertain", "interval_low": 0.5, "interval_high": 2000.0}
    path = table(tmp_path / "priors.csv", k_ty={"class": "uncertain"}, k_tz={"class": "distinct"}, d_tx=wide)
    search = read_search(path, BOUNDS, ["d_rz"])
    assert [PARAMETERS[i] for i in search.free] == ["k_ty", "k_tz", "d_tx", "d_rz"]
    ends = {PARAMETERS[i]: (search.bounds.lower[i], search.bounds.upper[i]) for i in search.free}
    assert ends == {"k_ty": (20, 80), "k_tz": (1, 1000), "d_tx": (1, 1000), "d_rz": (1, 1000)}
    assert search.use["k_tx"] == "fixed at the prior"
    assert search.use["d_rz"] == "free by refinement.also_free"


def test_the_next_person_is_looked_for_where_people_are_expected(tmp_path):
    rows = read_table(table(tmp_path / "spread.csv", k_ty={"class": "uncertain"}))
    wider = tmp_path / "priors.csv"
    more = {"prediction_low": "10.0", "prediction_high": "160.0"}
    write_table(wider, [*rows[0], *more], [row | more for row in rows])
    k_ty = PARAMETERS.index("k_ty")
    for interval, ends in (("prediction", (10, 160)), ("spread", (20, 80))):
        search = read_search(wider, BOUNDS, [], interval)
        assert (search.bounds.lower[k_ty], search.bounds.upper[k_ty]) == ends


def test_a_parameter_that_is_on_its_bound_for_everybody_stays_there(tmp_path):
    """k_rz of the paper: fits that end on a bound have no spread, and their mean may be beyond it by rounding."""
    k_ty = PARAMETERS.index("k_ty")
    for end, prior in ((1.0, 1.0 - 1e-14), (1000.0, 1000.0 + 1e-11)):
        alike = {
            "class": "uncertain",
            "prior": prior,
            "interval_low": end * (1 - 1e-12),
            "interval_high": end,
        }
        search = read_search(table(tmp_path / "priors.csv", k_ty=alike), BOUNDS, ["d_rz"])
        assert search.prior[k_ty] == end
        assert [PARAMETERS[i] for i in search.free] == ["d_rz"]
        assert search.use["k_ty"] == "fixed at the prior: the others' fits are alike"
        found = refine_residuals(linear(), search, **HOW)
        assert found.values[k_ty] == end


def test_a_narrow_interval_can_be_searched(tmp_path):
    narrow = {"class": "uncertain", "interval_low": 39.99, "interval_high": 40.01}
    search = read_search(table(tmp_path / "priors.csv", k_ty=narrow), BOUNDS, [])
    found = refine_residuals(linear(np.full(12, 55.0)), search, **HOW)
    assert found.values[PARAMETERS.index("k_ty")] == pytest.approx(40.01, rel=1e-5)


def test_the_published_table_serves_as_it_is():
    bounds = Bounds.from_config(CONFIG["identification"]["bounds"])
    search = read_search(PUBLISHED, bounds, [])
    assert [PARAMETERS[i] for i in search.free] == ["k_ty", "k_ry", "d_tx", "d_rx", "d_rz"]
    assert search.bounds.upper[PARAMETERS.index("d_tx")] == 1000
    assert search.bounds.lower[PARAMETERS.index("d_tx")] == 169


@pytest.mark.parametrize(
    ("changed", "said"),
    [
        ({"class": "odd"}, "class 'odd'"),
        ({"prior": 2000.0}, "prior 2000"),
        ({"prior": None}, "prior missing"),
        ({"class": "uncertain", "interval_low": 1100.0, "interval_high": 1200.0}, "interval"),
    ],
)
def test_a_table_that_cannot_be_used_is_refused(tmp_path, changed, said):
    with pytest.raises(InputError, match=said):
        read_search(table(tmp_path / "priors.csv", k_ty=changed), BOUNDS, [])


def test_also_free_takes_names_of_parameters_only():
    assert validated({"refinement": {"also_free": ["k_tz"]}}, "config", Path("c"))
    with pytest.raises(InputError, match="also_free"):
        validated({"refinement": {"also_free": ["k_up"]}}, "config", Path("c"))


# -------------------- a person of known parameters


@dataclass
class Recorded:
    """Files of a person with two dynamic trials, and the arguments of `refine`."""

    folder: Path
    truth: dict[str, float]
    arguments: dict


def gate(folder: Path, trial: str, *, refused: bool = False, override: str | None = None) -> Path:
    gates = [{"gate": "spikes", "message": "jumps", "remedy": "mend", "verdict": "refuse"}] if refused else []
    path = folder / "quality" / f"{trial}.json"
    write_json(path, {"subject": "S09", "trial": trial, "refused": gates, "override": override})
    return path


@pytest.fixture(scope="module")
def person(tmp_path_factory) -> Recorded:
    folder = tmp_path_factory.mktemp("person")
    one = record(folder, noise_m=0.0003)
    two = record(folder / "more", noise_m=0.0003, seed=2)
    for source, name in ((two, "dynamic_2"), (one, "neutral")):
        shutil.copytree(source.pose.parent, folder / name)
    quality = folder / "neutral" / "quality.json"
    quality.write_text(json.dumps(json.loads(one.neutral_quality.read_text()) | {"phantom": True}))
    truth = one.parameters
    # the published table about this person: common where it is true, open where it is not
    rows = read_table(PUBLISHED)
    for row in rows:
        own = truth[row["parameter"]]
        if row["class"] == "common":
            row["prior"] = repr(own)
        else:
            row |= {"interval_low": repr(own / 2), "interval_high": repr(own * 2), "prior": repr(own * 1.3)}
    write_table(folder / "priors.csv", list(rows[0]), rows)
    quick = {"bias_draws": 1, "bias_iterations": 1, "floor_bootstrap": 100}
    settings = {
        key: CONFIG[key]
        for key in ("identification", "identifiability", "ingest", "plant", "refinement", "robot")
    }
    settings["identifiability"] = settings["identifiability"] | quick
    dynamic = ("dynamic_1", "dynamic_2")
    arguments = {
        "subject": "S09",
        "priors": folder / "priors.csv",
        "poses": [folder / t / "pose.parquet" for t in dynamic],
        "markers": [folder / t / "markers.parquet" for t in dynamic],
        "neutral_pose": folder / "neutral" / "pose.parquet",
        "neutral_markers": folder / "neutral" / "markers.parquet",
        "neutral_quality": quality,
        "gates": [gate(folder, trial) for trial in ("neutral", *dynamic)],
        "robot": ROBOT,
        "settings": settings,
        "in_priors": False,
        "limits": one.limits,
        "step": one.step,
    }
    return Recorded(folder, truth, arguments)


@pytest.fixture(scope="module")
def refined(person) -> Path:
    fits = []
    for trial in ("dynamic_1", "dynamic_2"):
        for restart, factor in ((1, 1.1), (2, 1.0)):
            path = person.folder / "fits" / trial / f"restart-{restart}.json"
            parameters = {name: value * factor for name, value in person.truth.items()}
            about = {"trial": trial, "restart": restart, "method": "cma", "evaluations": 1000 + restart}
            write_json(path, about | {"parameters": parameters, "cost": {"J": factor}})
            fits.append(path)
    out = person.folder / "refined.json"
    refine(**person.arguments, fits=fits, out=out)
    return out


def test_a_person_is_refined_to_the_truth(person, refined):
    record_ = json.loads(refined.read_text())
    assert record_["status"] == "ok"
    assert record_["phantom"] is True
    assert record_["free"] == ["k_ty", "k_ry", "d_tx", "d_rx", "d_rz"]
    prior = {row["parameter"]: number(row["prior"]) for row in read_table(person.folder / "priors.csv")}
    for name, row in record_["parameters"].items():
        assert row["prior"] == prior[name]
        if name in record_["free"]:
            assert row["source"] == "refined"
        else:
            assert row["value"] == prior[name], "to the last bit"
    for name in ("k_ty", "d_tx", "d_rz"):
        assert record_["parameters"][name]["value"] == pytest.approx(person.truth[name], rel=0.05)
    for trial in record_["trials"].values():
        assert trial["refined"]["J"] < 0.7 * trial["prior"]["J"]
        assert trial["refined"]["J"] == pytest.approx(trial["refined"]["history"]["best"][-1], rel=1e-6)
        assert set(trial["verdicts"]) == set(record_["free"])
        assert set(trial["if_also_free"]) == set(PARAMETERS) - set(record_["free"])
        # the best restart is the truth itself
        assert trial["full"]["restart"] == 2
        assert trial["full"]["evaluations"] == 2003
        assert trial["against_full"]["met"]
        assert trial["refined"]["evaluations"] < 100
    assert set(record_["cross_trial"]) == {"refined", "full"}
    assert record_["pooled"]["J"] == pytest.approx(
        np.mean([row["J"] for row in record_["pooled"]["trials"].values()]), rel=1e-6
    )
    assert (
        record_["noise_floor"]["ci95"][0] <= record_["noise_floor"]["J"] <= record_["noise_floor"]["ci95"][1]
    )


def test_same_files_give_the_same_numbers_with_and_without_a_full_calibration(person, refined, tmp_path):
    refine(**person.arguments, out=tmp_path / "again.json")
    again, first = json.loads((tmp_path / "again.json").read_text()), json.loads(refined.read_text())
    assert set(again["cross_trial"]) == {"refined"}
    for trial in again["trials"].values():
        assert trial["full"] is None
        assert trial["against_full"] is None
    for record_ in (again, first):
        del record_["cross_trial"]
        for trial in record_["trials"].values():
            del trial["full"], trial["against_full"]
    assert again == first


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"poses": [], "markers": [], "limits": None, "step": None}, "no dynamic trial"),
        ({"limits": None, "step": None}, "no joint limits"),
    ],
)
def test_without_a_trial_or_limits_the_point_prior_stands(person, tmp_path, changes, said):
    refine(**person.arguments | changes, out=tmp_path / "refined.json")
    record_ = json.loads((tmp_path / "refined.json").read_text())
    assert record_["status"].startswith(said)
    assert record_["trials"] == {}
    assert all(
        row["value"] == row["prior"] and row["source"] == "prior" for row in record_["parameters"].values()
    )
    model = _interface(person, tmp_path / "refined.json", tmp_path, limits=None, step=None)
    assert json.loads((tmp_path / "interface.json").read_text())["trial"] == "neutral"
    assert model.numeric("k_ty").data[0] == record_["parameters"]["k_ty"]["prior"]
    assert model.opt.timestep == 0.001
    assert not model.jnt_limited.any()


def test_a_refused_trial_is_left_out_and_an_overridden_one_marked(person, tmp_path):
    gates = [
        gate(tmp_path, "neutral"),
        gate(tmp_path, "dynamic_1", refused=True),
        gate(tmp_path, "dynamic_2", refused=True, override="all the same"),
    ]
    refine(**person.arguments | {"gates": gates}, out=tmp_path / "refined.json")
    record_ = json.loads((tmp_path / "refined.json").read_text())
    assert list(record_["trials"]) == ["dynamic_2"]
    assert record_["refused_gates"] == {"S09/dynamic_1": ["spikes"]}
    assert record_["overridden_gates"] == {"S09/dynamic_2": ["spikes"]}
    assert record_["cross_trial"] is None
    assert record_["pooled"] is None
    gates[0] = gate(tmp_path, "neutral", refused=True)
    refine(**person.arguments | {"gates": gates}, out=tmp_path / "refined.json")
    record_ = json.loads((tmp_path / "refined.json").read_text())
    assert "S09/neutral: spikes" in record_["status"]
    assert record_["trials"] == {}


def test_where_the_published_table_stands_in_nobody_is_behind_the_priors(person, tmp_path):
    rows = read_table(person.folder / "priors.csv")
    nothing = {"poses": [], "markers": [], "limits": None, "step": None, "in_priors": True}
    for source, rests in (("published (Table I)", False), ("this cohort", True)):
        about = {"source": source, "overridden": "S01/dynamic_2"}
        write_table(tmp_path / "priors.csv", [*rows[0], *about], [row | about for row in rows])
        given = person.arguments | nothing | {"priors": tmp_path / "priors.csv"}
        refine(**given, out=tmp_path / "refined.json")
        record_ = json.loads((tmp_path / "refined.json").read_text())
        assert record_["prior_rests_on_person"] is rests
        assert record_["priors_rest_on_refused"] == (["S01/dynamic_2"] if rests else [])


# -------------------- the interface as a model


def _interface(person, refined: Path, folder: Path, **changes) -> mujoco.MjModel:
    names = ("dynamic_1", "dynamic_2", "neutral")
    export_interface(
        refined=refined,
        poses=[person.folder / t / "pose.parquet" for t in names],
        markers=[person.folder / t / "markers.parquet" for t in names],
        robot=ROBOT,
        settings=person.arguments["settings"],
        out=folder / "interface.xml",
        replay=folder / "interface_replay.csv",
        notes=folder / "interface.json",
        **{"limits": person.arguments["limits"], "step": person.arguments["step"]} | changes,
    )
    return mujoco.MjModel.from_xml_path(str(folder / "interface.xml"))


def test_the_interface_alone_moves_as_ours(person, refined, tmp_path):
    model = _interface(person, refined, tmp_path)
    content = json.loads(refined.read_text())["parameters"]
    values = as_vector({name: row["value"] for name, row in content.items()})
    for i, axis in enumerate(("tx", "ty", "tz", "rx", "ry", "rz")):
        joint = model.joint(f"strap_{axis}")
        assert joint.stiffness[0] == values[i]
        assert joint.damping[0] == values[6 + i]
        np.testing.assert_allclose(joint.range, [-1, 1])
        assert joint.qpos_spring[0] == 0
    assert model.body("pelvis").parentid[0] == model.body("interface").id
    rows = read_table(tmp_path / "interface_replay.csv")
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, model.key(START_KEY).id)
    sites = [f"{s}_{a}_m" for s in ("interface_left", "interface_right") for a in "xyz"]
    worst = 0.0
    for row in rows:
        data.ctrl[:] = [float(row[model.actuator(i).name]) for i in range(model.nu)]
        mujoco.mj_step(model, data)
        here = np.concatenate(
            [data.sensor(f"position_{s}").data for s in ("interface_left", "interface_right")]
        )
        worst = max(worst, np.abs(here - [float(row[c]) for c in sites]).max())
    assert len(rows) > 1000
    assert worst < 1e-9
    notes = json.loads((tmp_path / "interface.json").read_text())
    assert notes["replay_difference_m"] < 1e-9
    assert notes["trial"] == "dynamic_1"
    text = (tmp_path / "interface.xml").read_text()
    assert "PHANTOM" in text
    assert "k_ty" in text
    assert "<include" not in text
