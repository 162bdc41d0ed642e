"""Laws that nobody listed: families of forces, their prior, and what is measured where no name is asked for."""

from __future__ import annotations

import itertools
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from real2sim.configuration import validated
from real2sim.diagnosis.described_trial import DescribedTrial
from real2sim.diagnosis.free_form import (
    Library,
    _alone,
    _best_screened,
    _Trial,
    measure,
    screen,
    slopes,
)
from real2sim.diagnosis.law import describe
from real2sim.diagnosis.law_equations import Products
from real2sim.diagnosis.refit import Hypothesis, JointResiduals
from real2sim.diagnosis.search import FAILED, Search
from real2sim.diagnosis.trials import Trials
from real2sim.effects.chains import Context, MarkerShapes, NeutralPose, RobotMass
from real2sim.effects.families import (
    POSTURE,
    RATES,
    Range,
    Variable,
    cosine,
    families,
    polynomial,
    product,
    relaxed,
    stopped,
    variables,
    with_rhythm,
)
from real2sim.effects.system_replay import SystemReplay
from real2sim.recording.table import Recording
from real2sim.system.description import shipped_system
from real2sim.verification.systems import one_axis

CONFIG = validated({}, "config", Path("defaults"))["diagnosis"]
SEARCH, FREE = CONFIG["search"], CONFIG["free_form"]
RANGES = {"q_ty": Range(-2.0, 1.0)}


def _variable(values):
    return {"q_ty": Variable("q_ty", "m", 0.01, np.asarray(values, float))}


def _moving_base(seconds: float, size: float) -> Context:
    """A base that swings at half a hertz beside a person who stands, from one second on."""
    time_s = np.arange(round(seconds * 100)) / 100
    still, n = np.zeros((len(time_s), 6)), len(time_s)
    swing = size * np.sin(np.pi * np.maximum(time_s - 1.0, 0))[:, None] * [1.0, 0.5, 0.0]
    upright = np.tile(np.eye(3), (n, 1, 1))
    measured = np.repeat(swing[:, None], 2, axis=1)
    shapes = MarkerShapes(np.zeros((4, 3)), np.zeros((2, 3)))
    neutral = NeutralPose(np.eye(3), np.zeros(3))
    seen = np.ones((n, 2), bool)
    return Context(
        time_s,
        time_s,
        upright,
        swing,
        upright,
        100,
        RobotMass(100.0, np.zeros(2)),
        measured,
        seen,
        still,
        still,
        neutral,
        shapes,
        np.zeros(3),
    )


def test_a_coefficient_is_one_number_for_trials_of_any_length_and_speed():
    system, ones = shipped_system("strap"), np.ones(6)
    fitted = variables(_moving_base(12.0, 0.1), system, ones, ones, 5.0)
    other = variables(_moving_base(20.0, 0.2), system, ones, ones, 5.0, fitted)
    for name, faster in (("speed_x", 2.0), ("speed_y", 2.0), ("acceleration_tx", 2.0), ("time", 1.0)):
        both = fitted[name].values, other[name].values
        assert fitted[name].scale == other[name].scale
        # the same seconds of both trials, away from the end of the filter
        np.testing.assert_allclose(
            both[1][200:900], faster * both[0][200:900], rtol=0.02, atol=0.02, err_msg=name
        )
    ranges = {name: Range(float(v.values.min()), float(v.values.max())) for name, v in fitted.items()}
    drift = [polynomial("time", 1)(of, ranges, 0.01)[700] for of in (fitted, other)]
    assert drift[1] == pytest.approx(drift[0])
    # a history of which nothing is known has coefficients of its own in each trial, and fills it
    assert cosine(1)(other, ranges, 0.01)[-1] == pytest.approx(-1)


@pytest.mark.parametrize("order", [2, 3, 6, 8])
def test_polynomials_go_on_straight_beyond_the_range_that_was_visited(order):
    x = np.linspace(1.0, 4.0, 31)
    values = polynomial("q_ty", order)(_variable(x), RANGES, 0.01)
    np.testing.assert_allclose(np.diff(values, 2), 0, atol=1e-9)
    inside = polynomial("q_ty", order)(_variable(np.linspace(-2, 1, 31)), RANGES, 0.01)
    assert np.abs(inside).max() == pytest.approx(1)


def test_products_keep_their_value_beyond_the_range():
    values = product({"q_ty": 3})(_variable([1.0, 2.0, 9.0]), RANGES, 0.01)
    np.testing.assert_allclose(values, 1.0)


def test_a_relaxation_forgets_and_a_slip_does_not():
    path = np.concatenate([np.zeros(10), np.ones(990)])
    assert relaxed("q_ty", 0.5)(_variable(path), RANGES, 0.01)[-1] == pytest.approx(0, abs=1e-6)
    assert stopped("q_ty", 0.2)(_variable(path), RANGES, 0.01)[-1] == pytest.approx(1)


def _all_families(samples):
    """Families of the strap, with all their variables at random in ``samples``."""
    system, rng = shipped_system("strap"), np.random.default_rng(3)
    names = [f"{x}_{axis.name}" for axis in system.axes for x in "qv"]
    names += ["place_x", "place_y", "heading", *POSTURE, *RATES.values(), "time"]
    names += [f"acceleration_{axis.name}" for axis in system.axes]
    of = {n: Variable(n, "m", 0.1, rng.standard_normal(samples)) for n in names}
    ones = dict.fromkeys([*(axis.joint for axis in system.axes), "base_x", "base_y", "base_yaw"], 1.0)
    return families(system, names, ones, ones, 12.0), of


def test_a_damping_has_no_force_at_rest():
    """A constant force is a preload, however much of a range of rates lies on one side of rest."""
    found, of = _all_families(3)
    still = {n: replace(x, values=np.zeros(3)) for n, x in of.items()}
    uneven = {n: Range(-2.0, 1.0) for n in of}
    lossy = [f for f in found if f.name in ("dissipative", "machine dissipative", "from a rate")]
    assert {f.name for f in lossy} == {"dissipative", "machine dissipative", "from a rate"}
    for term in itertools.chain(*(row for family in lossy for row in family.terms)):
        np.testing.assert_allclose(term.basis(still, uneven, 0.01), 0, atol=1e-12, err_msg=term.name)


def test_terms_of_one_name_are_one_function():
    """What a term makes of a trial is kept by its name: a name without its variable took the first axis for all."""
    found, of = _all_families(50)
    wide = {n: Range(-2.0, 2.0) for n in of}
    values = {}
    terms = [t for f in found for row in f.terms for t in row]
    assert len(terms) > 1000
    for term in terms:
        force = term.basis(of, wide, 0.01)
        np.testing.assert_array_equal(values.setdefault(term.name, force), force, term.name)
    functions = {force.tobytes() for force in values.values()}
    assert len(functions) == len(values)


@pytest.mark.parametrize(("coordinates", "families_of_them"), [(2, 15), (3, 20)])
def test_all_forces_of_an_elastic_coupling_derive_from_one_potential(coordinates, families_of_them):
    system = shipped_system("strap")
    names = [f"{x}_{axis.name}" for axis in system.axes for x in "qv"]
    force = {axis.joint: 10.0 + i for i, axis in enumerate(system.axes)}
    large = {axis.joint: 0.01 * (i + 1) for i, axis in enumerate(system.axes)}
    found = [f for f in families(system, names, force, large, 12.0) if f.kind == "elastic coupling"]
    found = [f for f in found if len(f.axes) == coordinates]
    assert len(found) == families_of_them
    joint_of = {axis.name: axis.joint for axis in system.axes}
    wide = {f"q_{x}": Range(-9.0, 9.0) for x in found[0].axes}
    here = dict(zip(found[0].axes, (0.4, 0.7, -0.5), strict=False))

    def force_along(axis, row, **moved):
        at = here | moved
        of = {f"q_{x}": Variable(f"q_{x}", "m", 1.0, np.array([q])) for x, q in at.items()}
        joint = joint_of[axis]
        return sum(force[joint] * t.factor * t.basis(of, wide, 0.01)[0] for t in row if t.joint == joint)

    step = 1e-5
    coupled = [row for row in found[0].terms if len(row) > 1]
    assert all(len(row) == coordinates for row in coupled)
    for row in coupled:
        for a, b in itertools.combinations(here, 2):
            # d F_a / d q_b = d F_b / d q_a, in metres and not in units of a large excursion
            by_b = force_along(a, row, **{b: here[b] + step}) - force_along(a, row)
            by_a = force_along(b, row, **{a: here[a] + step}) - force_along(b, row)
            by_b, by_a = by_b / large[joint_of[b]], by_a / large[joint_of[a]]
            assert by_b == pytest.approx(by_a, rel=1e-3, abs=1e-6)


@pytest.fixture(scope="module")
def stiff(tmp_path_factory):
    """Two records of an oscillator with a cubic spring of 2e9 N/m3 beside its own, and its plain fit."""
    folder = tmp_path_factory.mktemp("oscillator")
    one_axis.simulate_bouc_wen("stiffening", 2e9, 71, folder, 3.0)
    system = shipped_system("bouc_wen")
    records = {n: Recording.read(system, folder / f"{n}.parquet") for n in ("train", "held_out", "quiet")}

    def load(name, settled):
        evidence = DescribedTrial(system, records[name], records["quiet"], CONFIG["described"]).evidence()
        return evidence.as_settled() if settled else evidence

    trials = Trials("train", "held_out", system, load, CONFIG, lambda text: None)
    pair, z = trials.prepare()
    search = Search(pair, SEARCH)
    return pair, search, search.fit((), z, final=True)


def test_a_cubic_spring_is_measured_without_its_name(stiff):
    pair, search, plain = stiff
    measured = measure(pair, plain, plain.base, search, FREE, SEARCH, lambda text: None)
    laws = measured.laws
    about = describe(pair, laws[0], laws[1:], measured.library, CONFIG)
    assert (about["stage"], about["kind"]) == ("interface", "elastic")
    assert about["axes"] == [pair.system.axes[0].name]
    assert about["depends_on"] == [f"q_{pair.system.axes[0].name}"]
    samples = pair.held_out.samples
    # the held-out record goes beyond the range of the other, where the law goes on straight
    assert laws[0].hypothesis.chi2[1] - samples < 0.05 * (plain.chi2[1] - samples)
    curve = about["curve"]
    grid, mean = np.array(curve["grid"]), np.array(curve["mean"])
    force = -2e9 * grid**3
    line = np.column_stack([np.ones_like(grid), grid])
    true = force - line @ np.linalg.lstsq(line, force, rcond=None)[0]
    assert np.abs(mean - true).max() < 0.1 * np.abs(true).max()
    assert curve["quantity_unit"] == "N"
    cubic = next(row for row in about["equation"] if row["term"].endswith("^3"))
    assert cubic["value"] == pytest.approx(-2e9, rel=0.1)
    assert cubic["unit"] == "N per m^3"


def test_a_tangent_is_taken_where_a_law_promises_most(stiff):
    """Beside a named spring that bears most of the load, the interface's own stiffness is a fraction of itself."""
    pair, search, plain = stiff
    library, longest = Library(pair, FREE["band_share"]), SEARCH["longest_step"]
    softer = plain.base.copy()
    softer[pair.system.stiffness_of_axis[0]] -= np.log(20)
    _, screened, base = _best_screened(pair, library, (softer, plain.base), search, longest)
    np.testing.assert_array_equal(base.z, plain.base)
    gain = max(s.gain for s in screened if s.family.kind == "elastic")
    left = _alone(slopes(pair, library, base), library, base, longest) - 2 * gain
    assert left < 0.2 * sum(plain.chi2)


def test_a_law_is_known_the_less_the_more_it_leaves(stiff):
    """Of either trial; a law that leaves noise alone is known as well as noise allows."""
    pair, search, plain = stiff
    law = measure(pair, plain, plain.base, search, FREE, SEARCH, lambda text: None).laws[0]
    n, m = pair.train.samples, pair.held_out.samples
    width = []
    for chi2 in ((n, 0.5 * m), (n, 9.0 * m), (4.0 * n, m)):
        left = replace(law, hypothesis=replace(law.hypothesis, chi2=chi2))
        curve = describe(pair, left, [], Library(pair, FREE["band_share"]), CONFIG)["curve"]
        width.append(np.array(curve["high"]) - curve["low"])
    np.testing.assert_allclose(width[1], 3 * width[0], rtol=1e-9)
    np.testing.assert_allclose(width[2], 2 * width[0], rtol=1e-9)


def test_a_coefficient_may_drive_one_of_several_joints(stiff):
    """As those of a force that repeats along the way of a base: two along x, two along y."""
    pair, _, _ = stiff
    library, context = Library(pair, FREE["band_share"]), pair.train.context
    assert library.signals([], context).sum(axis=0).shape == context.time_s.shape


def _of_residuals(trial, library, residuals):
    """The slopes of a trial with other residuals."""
    products = {name: Products.of(trial.by(f), trial.base, residuals) for name, f in _named(library)}
    return replace(trial, residuals=residuals, of_family=products)


def _named(library):
    return [(f"{f.key} {f.name}", f) for f in library.forces]


def test_products_are_those_of_each_familys_own_slopes(stiff):
    pair, _, plain = stiff
    library = Library(pair, FREE["band_share"])
    assert len(dict(_named(library))) == len(library.forces)
    for trial in slopes(pair, library, Hypothesis((), plain.base, plain.chi2)).trials:
        again = _of_residuals(trial, library, trial.residuals)
        for name, products in trial.of_family.items():
            for field in ("across", "own", "slope"):
                expected = getattr(again.of_family[name], field)
                scale = np.abs(expected).max() + 1e-12
                np.testing.assert_allclose(getattr(products, field) / scale, expected / scale, atol=1e-9)


def test_slopes_are_made_again_by_replays_where_the_linearised_simulation_grows(stiff, monkeypatch):
    pair, _, plain = stiff
    library = Library(pair, FREE["band_share"])
    base = Hypothesis((), plain.base, plain.chi2)
    smooth = slopes(pair, library, base).fitted
    assert smooth.responses.is_linear
    # only what the last group makes is seen to grow
    asked, response = [], SystemReplay.response
    monkeypatch.setattr(SystemReplay, "response", lambda *args: asked.append(None) or response(*args))
    slopes(pair, library, base)
    last = len(asked) // 2
    asked.clear()

    def growing(self, *arguments):
        asked.append(None)
        moved, turned = response(self, *arguments)
        return (np.full_like(moved, np.inf) if len(asked) == last else moved), turned

    monkeypatch.setattr(SystemReplay, "response", growing)
    replayed = slopes(pair, library, base).fitted
    assert not replayed.responses.is_linear
    assert replayed.of_family.keys() == smooth.of_family.keys()
    for name, products in replayed.of_family.items():
        expected = smooth.of_family[name].slope
        np.testing.assert_allclose(products.slope, expected, atol=2e-2 * np.abs(expected).max() + 1e-6)


def test_the_scale_of_the_prior_is_small_where_there_is_nothing_to_explain(stiff):
    pair, _, plain = stiff
    library = Library(pair, FREE["band_share"])
    known = slopes(pair, library, Hypothesis((), plain.base, plain.chi2))
    rng = np.random.default_rng(1)
    silent = [_of_residuals(t, library, rng.standard_normal(len(t.residuals))) for t in known.trials]
    quiet = replace(known, fitted=silent[0], held_out=silent[1])
    found = screen(quiet, library, plain, SEARCH["longest_step"])
    assert max(s.gain for s in found) < np.log(len(found)) + 3
    loud = screen(known, library, plain, SEARCH["longest_step"])
    assert loud[0].gain > 100


def test_rhythms_of_two_frequencies_act_together(stiff):
    pair, search, plain = stiff
    library = Library(pair, FREE["band_share"])
    history = next(f for f in library.forces if f.is_free and len(f.depends_on) == 1)
    both = tuple(library.placed(with_rhythm(history, hz), 0.1) for hz in (0.5, 1.5))
    z = np.concatenate([plain.base, np.zeros(8)])
    together = search.fit(both, z)
    assert max(together.chi2) < FAILED
    assert len({placed.where.element for placed in both}) == 2


def test_slopes_of_the_screening_are_the_tangent_of_a_refit(stiff):
    pair, search, plain = stiff
    library = Library(pair, FREE["band_share"])
    base = Hypothesis((), plain.base, plain.chi2)
    known = slopes(pair, library, base)
    trial = _Trial(pair, library, search, 0.0, 1.0, lambda text: None)
    own = next(f for f in library.forces if f.kind == "elastic")
    history = next(f for f in library.forces if f.is_free and len(f.depends_on) == 1)
    for family in (own, history):
        placed = library.placed(family, 0.3)
        assert library.holds(family)
        found = trial._tangent(known, family, placed, base)
        joint = JointResiduals(pair.train, (placed,), pair.system, coarse=True)
        r, jacobian = joint.with_jacobian(found.z, np.arange(len(found.z)))
        np.testing.assert_allclose(found.residuals, r, atol=1e-6 * np.abs(r).max())
        assert np.abs(found.jacobian - jacobian).max() < 2e-3 * np.abs(jacobian).max()
    assert not library.holds(with_rhythm(history, 0.5))


def test_laws_out_of_reach_are_not_refitted(stiff):
    pair, search, plain = stiff
    told = []
    measured = measure(pair, plain, plain.base, search, FREE, SEARCH, told.append, reach=0.0)
    assert measured.laws == []
    assert measured.screened
    assert len(told) == 1
