"""The linearised simulation: forces of planned motors have the slopes that replays have."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from real2sim.configuration import validated
from real2sim.diagnosis import free_form
from real2sim.diagnosis.described_trial import DescribedTrial
from real2sim.diagnosis.free_form import Library
from real2sim.diagnosis.next_trial import Rival, propose
from real2sim.diagnosis.refit import Hypothesis, JointResiduals
from real2sim.diagnosis.trials import Trials
from real2sim.effects.base import Placed
from real2sim.effects.catalogue import EFFECTS
from real2sim.effects.system_replay import SystemReplay
from real2sim.recording.table import Recording
from real2sim.system.description import System, shipped, shipped_system
from real2sim.system.linear import Linearised, PrescribedMotion
from real2sim.verification.systems import one_axis

CONFIG = validated({}, "config", Path("defaults"))["diagnosis"]


def _records(system, folder):
    """Two records of the positioning system, whitened, and its plain fit."""
    records = {n: Recording.read(system, folder / f"{n}.parquet") for n in ("train", "held_out", "quiet")}

    def load(name, settled):
        evidence = DescribedTrial(system, records[name], records["quiet"], CONFIG["described"]).evidence()
        return evidence.as_settled() if settled else evidence

    return Trials("train", "held_out", system, load, CONFIG, lambda text: None).prepare()


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Records of a positioning system with dry friction."""
    return one_axis.simulate_emps("coulomb", 20.4, 1, tmp_path_factory.mktemp("emps"), 4.0)


@pytest.fixture(scope="module")
def pair(folder):
    """The system as its force drives it."""
    return _records(shipped_system("emps"), folder)


@pytest.fixture(scope="module")
def along_a_path(folder):
    """The same carriage moved along its measured path, whose force is seen."""
    return _records(System.from_yaml(shipped("emps") / "by_path.yaml"), folder)


def _by_terms(evidence, library, base):
    """Slopes (r, p) of the residuals by the basis functions of the library's forces, as the screening has them."""
    terms = free_form._terms_of(library.forces)
    return free_form._slopes_of(evidence, library, base).responses.by(list(terms.values()))


def test_slopes_by_forces_are_those_of_replays(pair, monkeypatch):
    both, z = pair
    library = Library(both, 1.0)
    base = Hypothesis((), z, (np.nan, np.nan))
    linear = _by_terms(both.train, library, base)
    monkeypatch.setattr(SystemReplay, "linearised", lambda self: None)
    monkeypatch.setattr(JointResiduals, "_by_forces", lambda *_: None)
    replayed = _by_terms(both.train, library, base)
    apart = np.linalg.norm(linear - replayed, axis=0) / np.linalg.norm(replayed, axis=0)
    assert np.median(apart) < 0.01
    assert apart.max() < 0.1
    assert np.linalg.norm(replayed, axis=0).min() > 0


def test_slopes_on_top_of_a_law_are_those_of_replays(pair, monkeypatch):
    both, z = pair
    library = Library(both, 1.0)
    law, other = (next(f for f in library.forces if f.kind == kind) for kind in ("dissipative", "elastic"))
    placed, few = library.placed(law, 0.1), library.only([other])
    problem = JointResiduals(both.train, (placed,), both.system, coarse=True)
    at = np.concatenate([z, np.full(len(law.terms), -0.05)])
    base = Hypothesis((placed,), at, (np.nan, np.nan))
    # planned from what was recorded, the law leaves something else
    assert np.abs(problem.freely(at) - problem.many(at[None])[0][: both.train.rows]).max() > 0.1
    linear = _by_terms(both.train, few, base)
    monkeypatch.setattr(SystemReplay, "linearised", lambda self: None)
    monkeypatch.setattr(JointResiduals, "_by_forces", lambda *_: None)
    replayed = _by_terms(both.train, few, base)
    apart = np.linalg.norm(linear - replayed, axis=0) / np.linalg.norm(replayed, axis=0)
    assert apart.max() < 0.1


@pytest.mark.parametrize("grown", [np.inf, np.nan, 1e30])
def test_linearised_steps_that_grow_without_bound_are_not_used(pair, monkeypatch, grown):
    both, z = pair
    family = next(f for f in Library(both, 1.0).forces if f.kind == "dissipative")
    few = Library(both, 1.0).only([family])
    base = Hypothesis((), z, (np.nan, np.nan))
    monkeypatch.setattr(
        Linearised, "sensors", lambda self, forces, columns: np.full((len(forces), 1, 1), grown)
    )
    slopes = _by_terms(both.train, few, base)
    assert slopes.shape[1] == len(free_form._terms_of(few.forces))
    assert np.abs(slopes).max() < 1e9


def test_jacobian_by_coefficients_is_that_of_differences(pair, monkeypatch):
    both, z = pair
    library = Library(both, 1.0)
    family = next(f for f in library.forces if f.kind == "dissipative")
    problem = JointResiduals(both.train, (library.placed(family, 0.1),), both.system, coarse=True)
    at = np.concatenate([z, np.zeros(len(family.terms))])
    free = np.arange(len(at))
    r, fast = problem.with_jacobian(at, free)
    monkeypatch.setattr(JointResiduals, "_by_forces", lambda *_: None)
    slow = problem.jacobian(at, r, free)
    own = slice(len(z), None)
    np.testing.assert_allclose(fast[:, : len(z)], slow[:, : len(z)])
    np.testing.assert_allclose(fast[:, own], slow[:, own], atol=0.02 * np.abs(slow[:, own]).max())


def test_the_motion_that_parts_two_hypotheses_most_is_proposed(pair):
    """The carriage with dry friction and one with its square of the rate, in records that are there already."""
    both, z = pair
    hypotheses = []
    for name in ("coulomb", "quadratic_damping"):
        effect = next(e for e in EFFECTS if e.name == name)
        placed = Placed(effect, effect.places(both.system)[0], both.train.scales)
        hypotheses.append(Rival(name, Hypothesis((placed,), np.append(z, placed.starts()[0]), (1.0, 1.0))))
    known = [("the first again", both.train), ("the second again", both.held_out)]
    found = propose(both, hypotheses, ["x"], 1.5, lambda evidence, axes, parameters: known)
    assert found["rivals"] == ["coulomb", "quadratic_damping"]
    assert found["motion"] == found["tried"][0]["motion"]
    assert len(found["tried"]) == 2
    assert (
        found["difference_sd"] == found["tried"][0]["difference_sd"] > found["tried"][1]["difference_sd"] > 0
    )
    assert found["now_sd"] > 0
    # one alone has nothing to be told from
    assert propose(both, hypotheses[:1], ["x"], 1.5, lambda *about: known) is None


def _beside_a_late_output(both, library):
    """A law whose force is planned, beside an effect that only the sensors show: a delay of the measured output."""
    late = next(e for e in EFFECTS if e.name == "sync_offset" and not e.form)
    assert late.only_seen
    family = next(f for f in library.forces if f.kind == "dissipative")
    placed = Placed(late, late.place(both.system), both.train.scales)
    return placed, library.placed(family, 0.1)


def test_slopes_by_forces_are_seen_through_output_chains(pair, monkeypatch):
    both, z = pair
    effects = _beside_a_late_output(both, Library(both, 1.0))
    problem = JointResiduals(both.train, effects, both.system, coarse=True)
    x = np.concatenate([effects[0].starts()[0], np.full(len(effects[1].effect.parameters), 0.01)])
    at = np.concatenate([z, x])
    r, fast = problem.with_jacobian(at, np.arange(len(at)))
    with monkeypatch.context() as patch:
        patch.setattr(JointResiduals, "_by_forces", lambda *_: None)
        slow = problem.jacobian(at, r, np.arange(len(at)))
    own = slice(len(at) - len(effects[1].effect.parameters), None)
    np.testing.assert_allclose(fast[:, own], slow[:, own], atol=0.02 * np.abs(slow[:, own]).max())


def test_what_only_sensors_show_shares_one_simulation(pair, monkeypatch):
    both, z = pair
    late, _ = _beside_a_late_output(both, Library(both, 1.0))
    problem = JointResiduals(both.train, (late,), both.system, coarse=True)
    moved = late.starts()[0] * np.linspace(0.5, 1.5, 5)[:, None]
    points = np.hstack([np.tile(z, (5, 1)), moved])
    simulated = []
    original = SystemReplay._simulate
    monkeypatch.setattr(
        SystemReplay,
        "_simulate",
        lambda self, parameters, *rest: (
            simulated.append(len(parameters)) or original(self, parameters, *rest)
        ),
    )
    together = problem.many(points)
    assert simulated == [1]
    one_by_one = np.concatenate([problem.many(point[None]) for point in points])
    np.testing.assert_allclose(together, one_by_one, rtol=1e-9, atol=1e-9)
    assert np.ptp(together, axis=0).max() > 0
    # another stiffness is another simulation, whatever the sensors show
    simulated.clear()
    points[1:, 0] += 0.1
    problem.many(points)
    assert simulated == [2]


def test_a_force_beside_a_prescribed_path_changes_what_holds_the_path_and_nothing_else(
    along_a_path, monkeypatch
):
    """Even where something sticks: no simulation is needed for a slope, and it is exact."""
    both, z = along_a_path
    library = Library(both, 1.0)
    bristles = next(e for e in EFFECTS if e.name == "lugre")
    sticks = Placed(bristles, bristles.places(both.system)[0], both.train.scales)
    base = Hypothesis((sticks,), np.concatenate([z, sticks.starts()[0]]), (np.nan, np.nan))
    family = next(f for f in library.forces if f.kind == "dissipative")
    problem = JointResiduals(both.train, (sticks, library.placed(family, 0.1)), both.system, coarse=True)
    at = np.concatenate([base.z, np.full(len(family.terms), 0.01)])
    free = np.arange(len(at))
    assert isinstance(problem._replay.linearised(), PrescribedMotion)
    fast, columns = (
        problem.with_jacobian(at, free)[1],
        _by_terms(both.train, library, base),
    )
    monkeypatch.setattr(SystemReplay, "linearised", lambda self: None)
    monkeypatch.setattr(JointResiduals, "_by_forces", lambda *_: None)
    slow = problem.with_jacobian(at, free)[1]
    np.testing.assert_allclose(fast, slow, atol=1e-5 * np.abs(slow).max())
    replayed = _by_terms(both.train, library, base)
    np.testing.assert_allclose(columns, replayed, atol=1e-5 * np.abs(replayed).max())
