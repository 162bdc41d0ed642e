"""Several models of one machine: evidence tells with which of them the recordings were made."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import real2sim as r2s
from real2sim.diagnosis import machines
from real2sim.diagnosis.decide import Decision
from real2sim.diagnosis.evidence import CONFIGURED
from real2sim.diagnosis.machines import Machine, probabilities, with_others
from real2sim.diagnosis.refit import Hypothesis
from real2sim.diagnosis.whitening import Bands, Whitening
from real2sim.effects.catalogue import EFFECT_NAMES
from real2sim.errors import InputError
from real2sim.study import diagnosis_model
from real2sim.study.diagnose import diagnose
from real2sim.system.description import System, shipped
from real2sim.verification.systems.one_axis import simulate_emps

from tests.unit.test_coupling import CONFIG, ROBOT


@pytest.fixture(scope="module")
def systems(tmp_path_factory) -> tuple[System, System]:
    """The shipped positioning system, and the same with a spring that no parameter stands for."""
    folder = tmp_path_factory.mktemp("sprung")
    for name in ("system.yaml", "emps.xml"):
        shutil.copy(shipped("emps") / name, folder / name)
    model = folder / "emps.xml"
    model.write_text(
        model.read_text().replace(
            'name="carriage" type="slide"', 'name="carriage" type="slide" stiffness="300"'
        )
    )
    return System.from_yaml(shipped("emps") / "system.yaml"), System.from_yaml(folder / "system.yaml")


@pytest.fixture(scope="module")
def recordings(systems, tmp_path_factory) -> dict[str, r2s.Recording]:
    folder = simulate_emps(None, 0.0, seed=2, out=tmp_path_factory.mktemp("emps"), duration_s=6.0)
    return {
        name: r2s.Recording.read(systems[0], folder / f"{name}.parquet")
        for name in ("quiet", "train", "held_out")
    }


def test_the_machine_that_was_recorded_is_found_and_nothing_else_is_named(systems, recordings, tmp_path):
    right, wrong = systems
    answer = r2s.diagnose(wrong, **recordings, others={"free": right}, progress=lambda text: None)
    machine = answer.answer.beyond.machine
    assert (machine["name"], answer.verdict) == ("free", "none")
    assert machine["probability"] > 0.9
    rows = {row["name"]: row for row in machine["compared"]}
    assert rows[CONFIGURED]["verdict"] is None, "it needs an effect that the other one does not"
    assert rows[CONFIGURED]["chi2_plain"]["held_out"] > 10 * rows["free"]["chi2_plain"]["held_out"]
    # the gap is that of the configured machine, and what closes it is the other one
    gap = answer.answer.gap
    assert gap["chi2_plain"] == list(rows[CONFIGURED]["chi2_plain"].values())
    assert sum(gap["chi2_best"]) < 1.1 * sum(gap["chi2_expected"])
    assert answer.where["stage"] == "robot"
    assert answer.answer.parameters["mass"]["with_effect"] == pytest.approx(95.1, rel=0.02)
    assert answer.answer.parameters["mass"]["base"] != pytest.approx(95.1, rel=0.02)
    answer.save(tmp_path / "diagnosis.json")


def test_the_configured_machine_stays_where_it_was_the_recorded_one(systems, recordings):
    right, wrong = systems
    answer = r2s.diagnose(right, **recordings, others={"sprung": wrong}, progress=lambda text: None)
    machine = answer.answer.beyond.machine
    assert (machine["name"], answer.verdict) == (CONFIGURED, "none")
    assert machine["probability"] > 0.9


def test_no_machine_is_compared_where_none_is_listed(monkeypatch):
    outcome = SimpleNamespace()
    monkeypatch.setattr(machines, "search_both_ways", lambda trials: outcome)
    assert machines.search_with({CONFIGURED: SimpleNamespace()}) == (outcome, [])
    assert machines.describe_machines([], CONFIG["diagnosis"]) is None


@pytest.mark.parametrize(
    ("further", "near", "searched"),
    [((), False, ["right"]), ((), True, ["right", "wrong"]), (("c",), False, ["right", "wrong"])],
)
def test_a_machine_that_needs_an_effect_is_searched_where_one_comes_near_or_more_trials_count(
    monkeypatch, further, near, searched
):
    asked = []

    def prepare(name, trials):
        return SimpleNamespace(
            trials=trials, deviance={"right": 0.0, "wrong": 9.0}[name], is_noise=name == "right"
        )

    def search(name, own):
        asked.append(name)
        return _machine(name, {"right": 2000.0, "wrong": 3000.0}[name], 1000)

    monkeypatch.setattr(machines, "_prepare", prepare)
    monkeypatch.setattr(machines, "_searched", search)
    monkeypatch.setattr(machines, "_explains_simply", lambda machine, options: machine.name == "right")
    tried = _machine("wrong", 1000.0 if near else 3000.0, 1500)
    monkeypatch.setattr(machines, "_with_one_effect", lambda name, own: tried)
    two = SimpleNamespace(further=further, options=CONFIG["diagnosis"])
    found = machines.search_machines({"wrong": two, "right": two})
    assert (asked, [m.name for m in found]) == (searched, ["right", "wrong"])


@pytest.mark.parametrize(
    ("named", "left", "simply"),
    [
        (None, 1000, True),  # no effect is needed
        (0, 1000, True),  # one explains everything
        (1, 1000, False),  # two do
        (0, 9000, False),  # one leaves much
        (None, 9000, False),
    ],
)
def test_a_machine_explains_simply_with_one_effect_or_none(monkeypatch, named, left, simply):
    search = SimpleNamespace(is_noise=lambda hypothesis: sum(hypothesis.chi2) < 2100)
    monkeypatch.setattr(machines, "Search", lambda pair, settings: search)
    machine = _machine("a", 2000.0, left)
    attribution = machine.searched.found.attribution
    attribution.hypotheses = [replace(machine.plain, effects=(None,) * n) for n in (1, 2)]
    found = SimpleNamespace(attribution=attribution, pair=machine.pair)
    searched = SimpleNamespace(found=found, decision=SimpleNamespace(chosen=named))
    options = CONFIG["diagnosis"]
    assert machines._explains_simply(replace(machine, outcome=searched), options) is simply
    assert not machines._explains_simply(replace(machine, outcome=None), options)


def _machine(name: str, deviance: float, chi2: float) -> Machine:
    plain = Hypothesis((), np.zeros(12), (chi2, chi2))
    found = SimpleNamespace(attribution=SimpleNamespace(plain=plain, hypotheses=[]))
    trial = SimpleNamespace(samples=1000, sensors={"markers": 12})
    pair = SimpleNamespace(
        train=trial, held_out=trial, samples_by_sensor=((1000,), (1000,)), on_floor=lambda sd: (False,)
    )
    return Machine(name, ("a", "b"), pair, plain, deviance, SimpleNamespace(found=found))


def test_machines_share_the_probability_by_their_evidence():
    options = CONFIG["diagnosis"]
    alike = probabilities([_machine("a", 2000, 1000), _machine("b", 2000, 1000)], options)
    assert alike == pytest.approx([0.5, 0.5])
    far = probabilities([_machine("a", 2000, 1000), _machine("b", 9000, 4500)], options)
    assert far[0] > 0.99
    # where even the best of them leaves much, the same difference says less
    neither = probabilities([_machine("a", 90_000, 45_000), _machine("b", 97_000, 48_500)], options)
    assert 0.5 < neither[0] < far[0]


def test_effects_that_are_named_together_are_not_confusable_where_machines_are_averaged():
    two = [_machine("a", 2000, 1000), _machine("b", 2010, 1000)]
    probabilities_ = dict.fromkeys((*EFFECT_NAMES, "none", "unknown"), 0.0)
    own = probabilities_ | {"tilt": 0.7, "slack": 0.3}
    two = [replace(m, outcome=SimpleNamespace(found=m.searched.found, decision=_decision(own))) for m in two]
    found = with_others(_decision(own), two, CONFIG["diagnosis"], ("tilt", "slack"))
    assert found.group == ("tilt",)
    assert found.probabilities == pytest.approx(own)
    assert with_others(_decision(own), two, CONFIG["diagnosis"], ("tilt",)).group == ("tilt", "slack")


def _decision(probabilities_: dict[str, float]) -> Decision:
    return Decision(probabilities_, np.ones(1), "tilt", ("tilt",), 0)


def test_the_determinant_is_that_of_the_covariance_that_whitens():
    rng = np.random.default_rng(0)
    bands = Bands((0.0, 2.0, 5.0), 100, 0.01)
    error, nuisance = rng.standard_normal((60, 100, 2)), rng.standard_normal((3, 100, 2))
    whitening = Whitening.of_noise(bands, error, 0 * error, nuisance, np.array([0.1, 0.1]))
    # residuals r of covariance C: r' C^-1 r is the sum of squares of what is whitened
    units = np.eye(bands.last * 2).reshape(-1, bands.last, 2)
    from scipy.fft import idct

    padded = np.zeros((len(units), 100, 2))
    padded[:, : bands.last] = units
    rows = whitening.apply(idct(padded, axis=1, norm="ortho"))
    assert whitening.log_determinant == pytest.approx(-2 * np.linalg.slogdet(rows)[1])


def test_the_name_of_the_configured_robot_is_taken(systems, recordings, tmp_path):
    with pytest.raises(InputError, match="a name that is taken"):
        r2s.diagnose(systems[0], **recordings, others={CONFIGURED: systems[1]}, progress=lambda text: None)
    nowhere = tmp_path / "dynamic_1"
    with pytest.raises(InputError, match="a name that is taken"):
        diagnose(
            subject="S01",
            train=nowhere,
            held_out=nowhere,
            neutral=nowhere,
            robot=Path(ROBOT),
            settings=CONFIG | {"plant": CONFIG["plant"] | {"timestep_s": 0.01}},
            out=tmp_path / "diagnosis.json",
            robots={machines.CONFIGURED: {"model": str(ROBOT), "robot": CONFIG["robot"]}},
        )


@pytest.mark.parametrize(
    ("machine", "used"),
    [
        (None, "robot.xml"),
        ({"name": CONFIGURED, "model": None}, "robot.xml"),
        ({"name": "study", "model": "other.xml"}, "other.xml"),
    ],
)
def test_the_diagnosed_model_has_the_robot_that_was_found(monkeypatch, tmp_path, machine, used):
    asked = {}

    def load(**given):
        asked.update(given)
        return SimpleNamespace(with_scales=lambda scales: None)

    monkeypatch.setattr(diagnosis_model, "load_evidence", load)
    monkeypatch.setattr(diagnosis_model.NoiseModel, "measure", lambda *given: None)
    scales = {"scales": {name: [1.0] for name in ("q", "v", "k", "d", "inertia")}}
    answer = {
        "settings": {"ingest": {}, "diagnosis": {"noise": {}}},
        "robot_holds": "balance",
        "model": scales,
    }
    trial = tmp_path / "dynamic_1"
    diagnosis_model.diagnosed_evidence(answer | {"machine": machine}, trial, trial, None, Path("robot.xml"))
    assert asked["robot"] == Path(used)
    assert asked["settings"] is answer["settings"]
    told = diagnosis_model._verdict({"verdict": "none", "machine": machine})
    assert told.startswith("none: no effect stands out of the noise")
    assert ("the robot is study (other.xml)" in told) is (used == "other.xml")
