"""Screening, refits and what is tried after what: the search for a cause."""

from __future__ import annotations

from dataclasses import replace
from threading import Lock
from types import SimpleNamespace
from typing import ClassVar

import numpy as np
import pytest
from real2sim.diagnosis import attribute as attribution_module
from real2sim.diagnosis.answer import _baselines
from real2sim.diagnosis.attribute import (
    _alone,
    _best_of_each,
    _first_of_each,
    _neighbours,
    _other_forms,
    _other_laws,
    _paired_anew,
    _pairs,
    _plainer,
    _promising,
    _pruned,
    _redrawn,
    _single,
    _swapped,
    _swapped_together,
    _without_spikes,
    attribute,
    check_simulated,
)
from real2sim.diagnosis.decide import NONE, UNKNOWN, Candidate, decide, next_trial
from real2sim.diagnosis.refit import NO_RANGE, FitToBoth, Hypothesis
from real2sim.diagnosis.search import (
    FAILED,
    Beside,
    Pair,
    Screened,
    Search,
    _carried,
    _carried_starts,
    _fresh_starts,
    _parabola,
    _strengths_between,
    _weakest_of_best,
)
from real2sim.effects import catalogue
from real2sim.effects.catalogue import Placed
from real2sim.errors import InputError
from real2sim.inference.least_squares import STEP, Tangent

from tests.unit.simulated_effects import SCALES, STRAP, about, placed_whole
from tests.unit.test_coupling import CONFIG, PRIOR

# Effects that the strap can have
EFFECTS = tuple(effect for effect in catalogue.EFFECTS if effect.places(STRAP))


def _tangent(z):
    return Beside(z, np.zeros(1), np.zeros((1, 0)), np.zeros((1, len(z))))


def _stands(pair, hypothesis, **how):
    """Numbers that are fitted to both trials leave what those of the first leave."""
    return FitToBoth(hypothesis.z, hypothesis.by_sensor, hypothesis.occam), 1


class _Stuck(Search):
    """A search whose fits end well only where they start at a force of 0.3, and badly elsewhere; 9 is unbearable."""

    samples = (2880, 2880)
    samples_by_sensor = ((2880,), (2880,))
    on_floor = (False,)
    threads, _counting = 1, Lock()

    def __init__(self, start: float = 0.01, cost: float = FAILED):
        self.asked = []
        self.start, self.cost = start, cost

    def fresh(self, effects, base):
        return np.append(base, np.log(self.start)), self.cost

    def fit(self, effects, start, final=False, tangent=None):
        self.asked.append(start[12:])
        good = np.isclose(start[12:], np.log(0.3)).all()
        if (start[12:] == 9).any():
            return Hypothesis(tuple(effects), start, (FAILED, FAILED))
        return Hypothesis(tuple(effects), start, (100.0, 100.0) if good else (3000.0, 3000.0))

    def bearable(self, effects, base, x):
        return np.concatenate([base, x])

    def is_open(self, hypothesis):
        return False

    def is_noise(self, hypothesis):
        return sum(hypothesis.chi2) < 6000


def test_an_effect_that_ends_worse_than_none_is_tried_from_all_its_starts():
    effect = next(e for e in EFFECTS if e.name == "coulomb")
    placed = Placed(effect, effect.places(STRAP)[0], SCALES)
    plain = Hypothesis((), np.zeros(12), (2000.0, 2000.0))
    stuck = np.concatenate([plain.z, [np.log(0.01)]])
    screened = Screened((placed,), 500.0, stuck, _tangent(stuck))
    search = _Stuck()
    assert _single(search, screened, plain).chi2 == (100.0, 100.0)
    assert len(search.asked) == 2 + len(placed.starts()), "from where the tangent was taken too"


def test_a_refit_that_cannot_be_simulated_begins_again_where_its_tangent_was_taken():
    effect = next(e for e in EFFECTS if e.name == "coulomb")
    placed = Placed(effect, effect.places(STRAP)[0], SCALES)
    far, near = np.append(np.zeros(12), 9.0), np.append(np.zeros(12), np.log(0.3))
    screened = Screened((placed,), 500.0, far, _tangent(near))
    assert _Stuck().fit_screened(screened).chi2 == (100.0, 100.0)


@pytest.mark.parametrize(("cost", "left"), [(2500.0, 100.0), (3500.0, 3000.0)])
def test_a_start_that_is_better_than_what_a_refit_came_to_is_gone_on_from(cost, left):
    effect = next(e for e in EFFECTS if e.name == "coulomb")
    stuck = np.append(np.zeros(12), np.log(0.01))
    screened = Screened((Placed(effect, effect.places(STRAP)[0], SCALES),), 500.0, stuck, _tangent(stuck))
    assert _Stuck(0.3, cost).fit_screened(screened).chi2 == (left, left)


def test_fresh_starts_take_the_strap_of_the_axis_from_the_middle_of_its_range_too():
    effect = next(e for e in EFFECTS if e.name == "coulomb")
    placed = Placed(effect, effect.places(STRAP)[1], SCALES)
    base = np.arange(14.0)
    middle = np.mean(STRAP.bounds(), axis=0)
    z = _fresh_starts(placed, base, STRAP, CONFIG["diagnosis"]["search"]["strengths"])
    assert {(row[1], row[7]) for row in z} == {(1.0, 7.0), (1.0, middle[7]), (middle[1], middle[7])}
    elsewhere = [i for i in range(14) if i not in (1, 7)]
    assert (z[:, elsewhere] == base[elsewhere]).all()
    _, upper = placed.bounds()
    assert z[:, -1].max() == pytest.approx(upper[0])
    assert set(placed.starts()[:, 0]) <= set(z[:, -1])


def test_strengths_are_tried_between_the_best_and_its_neighbours():
    effect = next(e for e in EFFECTS if e.name == "coulomb" and not e.form)
    placed = Placed(effect, effect.places(STRAP)[1], SCALES)
    strap = [np.zeros(12), np.full(12, 0.5)]
    z = np.array([np.append(base, x) for base in strap for x in (0.0, 1.0, 2.0, 3.0, 4.0)])
    costs = np.array([90.0, 80.0, 70.0, 60.0, 60.0, 90.0, 50.0, 20.0, 20.001, 20.0])
    # what holds always costs the same at any strength: the weakest of these is where something changes
    between = _strengths_between(placed, z, costs, 3)
    assert (between[:, :12] == 0.5).all()
    assert between[:, 12] == pytest.approx([1.75, 1.5, 1.25, 2.25, 2.5, 2.75])
    costs[5] = 1.0
    assert _strengths_between(placed, z, costs, 1)[:, 12] == pytest.approx([0.5])
    assert len(_strengths_between(placed, z, np.full(10, FAILED), 3)) == 0
    # a preload has a sign and is nothing at zero: its tangent leads to every size of it
    preload = next(e for e in EFFECTS if e.name == "preload" and not e.form)
    assert len(_strengths_between(Placed(preload, preload.places(STRAP)[1], SCALES), z, costs, 3)) == 0


def test_of_starts_that_cost_the_same_the_weakest_is_the_best():
    z = np.array([np.append(np.zeros(12), x) for x in (1.0, 2.0, 3.0)])
    costs = np.array([90.0, 20.001, 20.0])
    by_form = {(e.name, e.form): e for e in EFFECTS}

    def best(name, form=""):
        effect = by_form[name, form]
        z_own = np.hstack([z, np.zeros((3, len(effect.parameters) - 1))])
        return _weakest_of_best(Placed(effect, effect.places(STRAP)[0], SCALES), z_own, costs)

    assert best("coulomb") == 1
    # longer is weaker where a spring stiffens
    assert best("stiffening", "_exponential") == 2
    # nothing is weaker among filters, and a preload has no strength but a size: the least cost decides
    assert best("filter_lag") == best("preload") == 2


def test_a_member_of_the_best_set_gives_way_to_its_rival_in_the_same_place():
    places = {(e.name, e.form): Placed(e, e.places(STRAP)[0], SCALES) for e in EFFECTS}
    tilt, friction, damping = (places[name, ""] for name in ("tilt", "coulomb", "quadratic_damping"))
    z = np.concatenate([np.zeros(12), [0.0, 0.0], [1.0]])
    found = [Hypothesis((tilt, damping), z, (20_000.0, 20_000.0))]
    settings = CONFIG["diagnosis"]["search"]
    search = _Stuck(0.3, 2500.0)
    search.fit = lambda effects, start: Hypothesis(
        tuple(effects), start, (2800.0, 2800.0) if effects[-1] is friction else (9000.0, 9000.0)
    )
    tried = _swapped(search, found, [tilt, friction, damping, places["slack", ""]], settings)
    assert [h.key for h in tried] == [f"{tilt.key} + {friction.key}"]
    # what leaves nothing but noise need not be what leaves least
    quiet = [Hypothesis((tilt, damping), z, (2880.0, 2880.0))]
    tried = _swapped(search, quiet, [tilt, friction, damping, places["slack", ""]], settings)
    assert [h.key for h in tried] == [f"{tilt.key} + {friction.key}"]
    late, smooth = (places[name, ""] for name in ("sync_offset", "filter_lag"))
    start = np.concatenate([np.zeros(12), [0.0, 0.0], smooth.starts()[0]])
    timed = [Hypothesis((tilt, smooth), start, (2880.0, 2880.0))]
    tried = _swapped(search, timed, [tilt, late, smooth, friction], settings)
    assert [h.key for h in tried] == [f"{tilt.key} + {late.key}"]


def test_a_name_that_the_set_holds_elsewhere_is_tried_however_badly_it_starts():
    """Friction that always holds is alike at any strength, and starts worse than a creep in its place."""
    of_axis = {
        (e.name, w.axes): Placed(e, w, SCALES)
        for e in EFFECTS
        if not e.form
        for w in e.places(STRAP)
        if w.axes
    }
    along_y, along_z = of_axis["coulomb", (1,)], of_axis["coulomb", (2,)]
    crept = of_axis["creep", (2,)]
    others = [of_axis[name, (2,)] for name in ("lugre", "hysteresis", "relaxation")]
    settings = CONFIG["diagnosis"]["search"] | {"redraws": 0, "swap_refits": 2}
    search = _Stuck()
    search.fresh = lambda effects, base: (
        np.concatenate([base, effects[-1].starts()[0]]),
        9000.0 if effects[-1] is along_z else 3000.0,
    )
    search.fit = lambda effects, start: Hypothesis(tuple(effects), start, (2880.0, 2880.0))
    z = np.concatenate([np.zeros(12), along_y.starts()[0], crept.starts()[0]])
    found = [Hypothesis((along_y, crept), z, (2870.0, 2870.0))]
    keys = {h.key for h in _swapped(search, found, [along_y, along_z, crept, *others], settings)}
    assert f"{along_y.key} + {along_z.key}" in keys
    # along another axis alone there is no such reason
    lonely = [Hypothesis((crept,), np.concatenate([np.zeros(12), crept.starts()[0]]), (2870.0, 2870.0))]
    assert along_z.key not in {h.key for h in _swapped(search, lonely, [along_z, *others], settings)}


def test_two_laws_of_one_axis_give_way_to_two_others():
    """Neither of the true two is in the best set, and one of them alone leaves more than each that is."""
    places = {(e.name, e.form): Placed(e, e.places(STRAP)[0], SCALES) for e in EFFECTS}
    wrong = tuple(places[name, ""] for name in ("stiffening", "hysteresis"))
    true = tuple(places[name, ""] for name in ("slack", "coulomb"))
    other = Placed(wrong[0].effect, wrong[0].effect.places(STRAP)[1], SCALES)

    def keys(effects):
        return {p.key for p in effects}

    def fitted(effects, left):
        z = np.concatenate([np.zeros(12), *(p.starts()[0] for p in effects)])
        return Hypothesis(tuple(effects), z, (left, left))

    class Screening(_Stuck):
        def screen(self, base, laws, *, weaken=True):
            out = []
            for law in laws:
                effects = (*base.effects, law)
                promise = 100.0 if keys(true) <= keys(effects) else 5000.0
                z = np.concatenate([base.z, law.starts()[0]])
                out.append(Screened(effects, promise, z, _tangent(z)))
            return sorted(out, key=lambda s: s.predicted)

        def fit_screened(self, screened):
            return fitted(screened.effects, 2880.0 if keys(true) <= keys(screened.effects) else 8000.0)

        def fit(self, effects, start, final=False, tangent=None):
            return fitted(effects, 9000.0)

    found = [fitted(wrong, 3000.0), *(fitted((p,), 6000.0) for p in wrong)]
    laws, settings = [*wrong, *true, other], CONFIG["diagnosis"]["search"]
    tried = _paired_anew(Screening(), fitted((), 20_000.0), found, laws, settings)
    assert keys(min(tried, key=lambda h: sum(h.chi2)).effects) == keys(true)
    # beside what the set has elsewhere
    found = [fitted((other, *wrong), 3000.0)]
    tried = _paired_anew(Screening(), fitted((), 20_000.0), found, laws, settings)
    assert keys(min(tried, key=lambda h: sum(h.chi2)).effects) == keys((other, *true))
    apart = [fitted((wrong[0], other), 3000.0)]
    assert _paired_anew(Screening(), fitted((), 20_000.0), apart, laws, settings) == []


def test_what_a_hypothesis_leaves_is_measured_by_the_noise_that_it_lets_through(monkeypatch):
    friction = placed_whole("coulomb")

    class Trial:
        samples, samples_by_sensor, noise_by_sensor, threads = 2880, (2880,), (2880.0,), 1
        sensors: ClassVar = {"markers": 1}

        def noise_of(self, effects, parameters, x, draws, seed):
            assert [p.key for p in effects] == [friction.key]
            return np.sqrt(np.linspace(5000.0, 7000.0, draws))[:, None]

    search = Search(Pair(Trial(), Trial(), about(PRIOR)), CONFIG["diagnosis"]["search"])
    found = Hypothesis((friction,), np.zeros(13), (6000.0, 6000.0))
    monkeypatch.setattr("real2sim.diagnosis.search.fit_both", _stands)
    assert abs(search.excess(found)) < 0.1
    assert search.is_noise(found)
    # what numbers leave that are fitted to both trials counts, not what those of the first leave
    further = replace(found, chi2=(6000.0, 8000.0), z=np.full(13, 0.5))
    told = FitToBoth(further.z, ((6000.0,), (6000.0,)), 0.0)
    monkeypatch.setattr("real2sim.diagnosis.search.fit_both", lambda *given, **how: (told, 1))
    assert abs(search.excess(further)) < 0.1
    monkeypatch.setattr("real2sim.diagnosis.search.fit_both", _stands)
    further.both = None
    assert search.excess(replace(further, z=np.full(13, 0.6))) > 1
    # the plain plant is measured by the noise that whitens, and so is what leaves no more than that
    plain = Hypothesis((), np.zeros(12), (6000.0, 6000.0))
    assert search.excess(plain) == pytest.approx((12_000 - 5760) / np.sqrt(2 * 5760))
    assert not search.is_noise(plain)
    calm = Hypothesis((friction,), np.ones(13), (2900.0, 2900.0))
    assert search.excess(calm) == pytest.approx(40 / np.sqrt(2 * 5760))


def test_noise_that_one_trial_passes_on_hides_nothing_of_the_other(monkeypatch):
    friction = placed_whole("coulomb")

    def trial(mean, sd):
        draws = np.random.default_rng(3).normal(mean, sd, 31)
        return SimpleNamespace(
            samples=2880,
            samples_by_sensor=(2880,),
            noise_by_sensor=(2880.0,),
            threads=1,
            sensors={"markers": 1},
            noise_of=lambda *given: np.sqrt(draws)[:, None],
        )

    monkeypatch.setattr("real2sim.diagnosis.search.fit_both", _stands)
    search = Search(
        Pair(trial(4500.0, 900.0), trial(2880.0, 76.0), about(PRIOR)), CONFIG["diagnosis"]["search"]
    )
    found = Hypothesis((friction,), np.zeros(13), (5000.0, 5000.0))
    fitted, held_out = search.excess_of_trials(found)
    assert fitted < 1
    assert held_out > 20
    assert not search.is_noise(found)


def test_constants_of_one_name_start_where_another_law_found_them():
    """Dry friction of the EMPS starts from the force of the smooth law; what that does not have, from its own start."""
    law = next(e for e in EFFECTS if e.name == "lugre")
    placed = Placed(law, law.places(STRAP)[1], SCALES)
    base, force = np.linspace(0, 1, 12), np.log(0.4)
    z = _carried_starts(placed, base, {"force": force, "rate": -5.0})
    assert np.array_equal(z[:, :12], np.tile(base, (len(z), 1)))
    names = [parameter.name for parameter in law.parameters]
    column = 12 + names.index("force")
    assert np.allclose(z[:, column], force)
    others = np.delete(z[:, 12:], names.index("force"), axis=1)
    assert np.array_equal(others, np.delete(placed.starts(), names.index("force"), axis=1))
    beyond = _carried_starts(placed, base, {"force": 99.0})
    assert np.allclose(beyond[:, column], placed.bounds()[1][names.index("force")])


def test_every_parameter_of_an_effect_is_free():
    for effect in EFFECTS:
        lower, upper = Placed(effect, effect.places(STRAP)[0], SCALES).bounds()
        # a range of a few steps of the finite differences would be no search either
        assert np.all(upper - lower > 100 * max(NO_RANGE, STEP)), effect.name


def test_outliers_are_judged_alone_and_beside_the_best_by_jumps_that_are_new():
    places = {e.name: Placed(e, e.places(STRAP)[0], SCALES) for e in EFFECTS}
    slack, outliers = places["slack"], places["outliers"]
    plain = Hypothesis((), np.zeros(12), (9000.0, 9000.0))
    found = [
        Hypothesis((slack,), np.zeros(13), (4000.0, 4000.0)),
        Hypothesis((outliers,), np.zeros(12), (8900.0, 8900.0)),
    ]
    search = _Stuck()
    left = {True: (2900.0, 2900.0), False: (3900.0, 3900.0)}
    search.fit = lambda effects, start: Hypothesis(tuple(effects), start, left[outliers in effects])
    search.mark_spikes = lambda best: best is found[0]
    more = _without_spikes(search, plain, found, list(places.values()))
    assert [h.names for h in more] == [("slack", "outliers"), ("outliers",), ("slack",)]
    assert all(h is not found[1] for h in more), "judged by the old jumps"
    search.mark_spikes = lambda best: False
    assert _without_spikes(search, plain, found, list(places.values())) is found


def test_what_stood_for_jumps_is_left_out_beside_them():
    places = {e.name: Placed(e, e.places(STRAP)[0], SCALES) for e in EFFECTS}
    slack, tilt = places["slack"], places["tilt"]
    plain = Hypothesis((), np.zeros(12), (9000.0, 9000.0))
    found = [
        Hypothesis((slack, tilt), np.zeros(15), (3800.0, 3900.0)),
        Hypothesis((slack,), np.zeros(13), (4000.0, 4000.0)),
        Hypothesis((tilt,), np.zeros(14), (8000.0, 8000.0)),
    ]
    search = _Stuck()
    search.fit = lambda effects, start: Hypothesis(tuple(effects), start, (2900.0, 2900.0))
    search.mark_spikes = lambda best: best is found[0]
    more = _without_spikes(search, plain, found, list(places.values()))
    tried = {h.names for h in more} - {h.names for h in found}
    assert tried == {("slack", "tilt", "outliers"), ("slack", "outliers"), ("outliers",)}


def test_what_a_longer_fit_gains_is_not_put_down_to_jumps():
    places = {e.name: Placed(e, e.places(STRAP)[0], SCALES) for e in EFFECTS}
    slack = places["slack"]
    plain = Hypothesis((), np.zeros(12), (9000.0, 9000.0))
    cut_short = Hypothesis((slack,), np.zeros(13), (3200.0, 3300.0))
    search = _Stuck()
    # wherever a fit of the slack goes on it comes to 2900; jumps add nothing
    search.fit = lambda effects, start: Hypothesis(tuple(effects), start + 1, (2900.0, 2900.0))
    search.mark_spikes = lambda best: True
    more = _without_spikes(search, plain, [cut_short], list(places.values()))
    alone = next(h for h in more if h.names == ("slack",))
    assert alone.chi2 == (2900.0, 2900.0)


class _Counting(_Stuck):
    """A search that notes what it refits; `excess` of the plain fit is given."""

    def __init__(self, plain_excess: float):
        super().__init__()
        self.plain_excess, self.refitted = plain_excess, []

    def excess(self, hypothesis):
        return self.plain_excess

    def fit_screened(self, screened):
        self.refitted.append(screened.effects[-1].effect.name)
        left = 2880.0 if screened.effects[-1].effect.name == "coulomb" else 80_000.0
        return Hypothesis(screened.effects, screened.start, (left, left))


def _promise(placed: Placed, predicted: float) -> Screened:
    start = np.concatenate([np.zeros(12), placed.starts()[0]])
    return Screened((placed,), predicted, start, _tangent(start))


def test_where_there_is_no_gap_a_few_refits_are_enough():
    settings = CONFIG["diagnosis"]["search"]
    plain = Hypothesis((), np.zeros(12), (2800.0, 2800.0))
    shortlist = [_promise(Placed(e, e.places(STRAP)[0], SCALES), 2700.0) for e in EFFECTS[:9]]
    for quiet, refits in ((True, settings["quiet_refits"]), (False, len(shortlist))):
        assert len(_alone(_Counting(1.5), shortlist, plain, settings, quiet=quiet)) == refits


def test_what_cannot_be_the_answer_any_more_is_not_refitted_but_rivals_are():
    settings = CONFIG["diagnosis"]["search"]
    plain = Hypothesis((), np.zeros(12), (90_000.0, 90_000.0))
    places = {e.name: Placed(e, e.places(STRAP)[0], SCALES) for e in EFFECTS if not e.form}
    first = ["coulomb", "tilt", "slack", "stiffening", "added_mass"]
    assert len(first) == settings["pair_rivals"]
    search = _Counting(100.0)
    far = [_promise(places[name], 2880 + settings["out_of_reach"] + 100) for name in ("preload", "lugre")]
    near = [_promise(places["sync_offset"], 3500.0)]
    _alone(
        search,
        [*(_promise(places[name], 2000.0) for name in first), *far, *near],
        plain,
        settings,
        quiet=False,
    )
    assert search.refitted == [*first, "lugre", "sync_offset"]


def test_all_filters_are_tried_where_a_late_clock_explains_everything():
    plain = Hypothesis((), np.zeros(12), (90_000.0, 90_000.0))
    whole = [Placed(e, e.places(STRAP)[0], SCALES) for e in EFFECTS if e.scope == "whole"]
    late = next(p for p in whole if p.effect.name == "sync_offset")
    first = Hypothesis((late,), np.zeros(13), (2500.0, 2500.0))
    search = _Counting(1.0)
    found = _other_forms(search, [first], [_promise(p, 80_000.0) for p in whole], plain)
    assert {n for h in found for n in h.names} == {"sync_offset", "replay_lag", "filter_lag", "clock_drift"}
    assert search.refitted.count("filter_lag") == sum(e.name == "filter_lag" for e in EFFECTS)
    some = replace(first, chi2=(9000.0, 9000.0))
    assert _other_forms(search, [some], [_promise(p, 80_000.0) for p in whole], plain) == [some]


@pytest.mark.parametrize(("left", "skipped"), [(5000.0, True), (12_000.0, False)])
def test_what_explains_nearly_all_needs_no_refit_of_what_promises_a_tenth_of_it(left, skipped):
    """Left of a gap of 180 000: 4 240, or 18 240 and so a tenth; the other promises to leave 40 000 of 90 000."""
    settings = CONFIG["diagnosis"]["search"]
    n = 2880.0
    plain = Hypothesis((), np.zeros(12), (90_000.0 + n, 90_000.0 + n))
    places = {e.name: Placed(e, e.places(STRAP)[0], SCALES) for e in EFFECTS if not e.form}
    first = ["coulomb", "tilt", "slack", "stiffening", "added_mass"]

    class Leaves(_Counting):
        def fit_screened(self, screened):
            fitted = super().fit_screened(screened)
            coulomb = fitted.names == ("coulomb",)
            return replace(fitted, chi2=(left, left)) if coulomb else fitted

    search = Leaves(100.0)
    shortlist = [_promise(places[name], 3000.0) for name in first]
    shortlist += [_promise(places["preload"], 40_000.0), _promise(places["lugre"], 40_000.0)]
    _alone(search, shortlist, plain, settings, quiet=False)
    assert search.refitted == [*first, *([] if skipped else ["preload"]), "lugre"]


@pytest.mark.parametrize("others", [True, False])
def test_where_less_is_left_than_a_second_cause_costs_only_axes_of_the_same_are_tried(others):
    settings = CONFIG["diagnosis"]["search"]
    everything = [Placed(e, where, SCALES) for e in EFFECTS if not e.form for where in e.places(STRAP)]
    coulomb, tilt = (
        Hypothesis((next(p for p in everything if p.effect.name == name),), np.zeros(13), (left, left))
        for name, left in (("coulomb", 4000.0), ("tilt", 9000.0))
    )
    pooled = []

    class Axes(_Counting):
        def pairs(self, screened, most):
            pooled.extend(screened)
            return []

        def screen(self, base, places, weaken=True, likely=None):
            return [replace(_promise(p, 3000.0), effects=(*base.effects, p)) for p in places]

    search = Axes(100.0)
    singles = [_promise(p, 3000.0) for p in everything]
    plain = Hypothesis((), np.zeros(12), (90_000.0, 90_000.0))
    _, promising = _pairs(search, plain, singles, [coulomb, tilt], everything, settings, others=others)
    names = {p.effect.name for p in promising}
    if others:
        assert len(pooled) == settings["pair_pool"]
        assert names == {p.effect.name for p in everything}
    else:
        assert not pooled
        assert search.refitted == ["coulomb"]
        assert names == {"coulomb"}


def test_one_law_takes_the_place_of_another_on_all_its_axes_at_once():
    everything = [Placed(e, where, SCALES) for e in EFFECTS for where in e.places(STRAP)]
    pair = tuple(
        next(p for p in everything if p.effect.name == "relaxation" and p.where.axes == (axis,))
        for axis in (1, 2)
    )

    class Costs(_Stuck):
        def fresh(self, effects, base, near=None):
            start = effects[-1].starts()[0]
            friction = all(p.effect.name == "coulomb" for p in effects)
            return np.concatenate([base, start]), 100.0 if friction else 5000.0

        def fit(self, effects, start, final=False, tangent=None):
            assert len(start) == 12 + sum(len(p.effect.parameters) for p in effects)
            return Hypothesis(tuple(effects), start, (2880.0, 2880.0))

    found = Hypothesis(pair, np.zeros(16), (2880.0, 2880.0))
    tried = _swapped_together(Costs(), [found], everything)
    assert tried[0].key == "coulomb ty + coulomb tz"
    # one of every effect that they are mistaken for, whatever its start promises
    assert sorted(h.names[0] for h in tried) == sorted({h.names[0] for h in tried})
    assert {h.names[0] for h in tried} >= {"coulomb", "lugre", "hysteresis", "creep"}
    alone = Hypothesis(pair[:1], np.zeros(14), (2880.0, 2880.0))
    assert _swapped_together(Costs(), [alone], everything) == []


def test_laws_that_the_tangent_promises_nothing_of_are_tried_on_the_axis_of_the_best():
    everything = [Placed(e, where, SCALES) for e in EFFECTS for where in e.places(STRAP)]
    law = next(p for p in everything if p.key == "relaxation ty")

    class Costs(_Stuck):
        def fresh(self, effects, base, near=None):
            assert [p.where.axes for p in effects] == [(1,)]
            assert effects[0].key not in ("relaxation ty", "creep ty")
            return np.append(base, effects[0].starts()[0]), 100.0 if effects[0].key == "coulomb ty" else 900.0

        def fit(self, effects, start, final=False, tangent=None):
            left = 2880.0 if effects[0].key == "coulomb ty" else 4000.0
            return Hypothesis(tuple(effects), start, (left, left))

    creep = next(p for p in everything if p.key == "creep ty")
    known = [Hypothesis((p,), np.zeros(14), (3500.0, 3500.0)) for p in (law, creep)]
    settings = CONFIG["diagnosis"]["search"]
    found = _other_laws(Costs(), known, everything, settings)
    assert found[0].key == "coulomb ty"
    assert len(found) == len(known) + settings["swap_refits"]
    of_all = [Hypothesis((placed_whole("tilt"),), np.zeros(14), (3500.0, 3500.0))]
    assert _other_laws(Costs(), of_all, everything, settings) == of_all


@pytest.mark.parametrize(
    ("best", "rival"), [("asymmetric_stiffness", "one_sided"), ("one_sided", "asymmetric_stiffness")]
)
def test_a_law_of_one_side_is_a_rival_of_a_law_without_sides(best, rival):
    """A strap that is loose on one side from the middle on is one that is softer there."""
    everything = [Placed(e, where, SCALES) for e in EFFECTS for where in e.places(STRAP)]
    tried = set()

    class Costs(_Stuck):
        def fresh(self, effects, base, near=None):
            tried.add((effects[0].effect.name, effects[0].where.side))
            return np.append(base, effects[0].starts()[0]), 100.0

        def fit(self, effects, start, final=False, tangent=None):
            return Hypothesis(tuple(effects), start, (2880.0, 2880.0))

    named = next(p for p in everything if p.effect.name == best and p.axes == ["ty"])
    _other_laws(
        Costs(),
        [Hypothesis((named,), np.zeros(14), (3500.0, 3500.0))],
        everything,
        CONFIG["diagnosis"]["search"],
    )
    sides = {side for name, side in tried if name == rival}
    assert sides == ({-1, 1} if rival == "one_sided" else {0})
    # of laws that have sides, the same side only
    assert {side for _, side in tried} <= {0, named.where.side} or named.where.side == 0


def test_laws_of_many_constants_are_tried_from_drawn_starts_on_the_axis_of_the_best():
    """LuGre friction of one person was `hysteresis`: its own valley was 1 500 lower than where its one start led."""
    everything = [Placed(e, where, SCALES) for e in EFFECTS for where in e.places(STRAP)]
    hysteresis = next(p for p in everything if p.key == "hysteresis ty")
    known = [Hypothesis((hysteresis,), np.append(PRIOR, np.log([0.3, 0.5])), (2600.0, 2800.0))]
    drawn = []

    class Draws(_Stuck):
        pair = SimpleNamespace(train=None)
        _settings = CONFIG["diagnosis"]["search"]
        evaluations = 0

        def _residuals(self, effects, coarse=True):
            (law,) = effects

            def costs(z):
                drawn.append((law.key, z))
                valley = np.abs(z[:, 13] - 1.5) if law.key == "lugre ty" else np.ones(len(z))
                return np.where(z[:, 12] > np.log(0.5), np.nan, valley)

            return SimpleNamespace(costs=costs)

        def fit(self, effects, start, final=False, tangent=None):
            self.asked.append((effects[0].key, start))
            left = 2300.0 if effects[0].key == "lugre ty" else 4000.0
            return Hypothesis(tuple(effects), start, (left, left))

    search, settings = Draws(), CONFIG["diagnosis"]["search"]
    found = _redrawn(search, known, everything, settings)
    assert found[0].key == "lugre ty"
    laws = [key for key, _ in drawn]
    assert {"lugre ty", "hysteresis ty_bouc_wen"} <= set(laws)
    assert "hysteresis ty" not in laws
    assert all(len(z) == settings["redraws"] for _, z in drawn)
    of_lugre = dict(drawn)["lugre ty"]
    # beside the strap of the best, its force about the fitted one, the rest within their bounds
    np.testing.assert_array_equal(of_lugre[:, :12], np.tile(PRIOR, (len(of_lugre), 1)))
    assert np.abs(of_lugre[:, 12] - np.log(0.3)).max() <= 1
    lower, upper = next(p for p in everything if p.key == "lugre ty").bounds()
    assert (of_lugre[:, 12:] >= lower).all()
    assert (of_lugre[:, 12:] <= upper).all()
    # those that leave least are refitted, and none that cannot be simulated
    refitted = [z for key, z in search.asked if key == "lugre ty"]
    assert len(refitted) == settings["redraw_refits"]
    bearable = of_lugre[of_lugre[:, 12] <= np.log(0.5)]
    assert abs(refitted[0][13] - 1.5) == np.abs(bearable[:, 13] - 1.5).min()
    of_all = [Hypothesis((placed_whole("tilt"),), np.zeros(14), (3500.0, 3500.0))]
    assert _redrawn(search, of_all, everything, settings) == of_all
    assert _redrawn(search, known, everything, settings | {"redraws": 0}) == known


def test_a_rival_in_its_place_starts_from_the_strap_of_the_best():
    settings = CONFIG["diagnosis"]["search"]
    places = {e.name: Placed(e, e.places(STRAP)[0], SCALES) for e in EFFECTS if not e.form}
    asked = []

    class Beside(_Counting):
        def refit_fresh(self, effects, base, fitted):
            asked.append((effects[-1].effect.name, base[0]))
            return Hypothesis(effects, fitted.z, (2850.0, 2850.0))

    strap = np.full(12, 3.0)
    coulomb = _promise(places["coulomb"], 2000.0)
    coulomb.start[:12] = strap
    shortlist = [coulomb, _promise(places["lugre"], 2100.0), _promise(places["tilt"], 2100.0)]
    plain = Hypothesis((), np.zeros(12), (90_000.0, 90_000.0))
    found = _alone(Beside(100.0), shortlist, plain, settings, quiet=False)
    assert asked == [("lugre", 3.0)]
    assert found[0].names == ("lugre",)


def test_a_weaker_start_stays_inside_the_bounds_and_goes_to_where_the_effect_vanishes():
    quadratic = next(e for e in EFFECTS if e.form == "_quadratic")
    even = Placed(quadratic, quadratic.places(STRAP)[0], SCALES)
    assert even.weaker(np.array([-0.4, 0.5])) == pytest.approx([-0.1, 0.5])
    lugre = next(e for e in EFFECTS if e.name == "lugre")
    placed = Placed(lugre, lugre.places(STRAP)[0], SCALES)
    start = placed.starts()[0]
    # half of the way of a force's logarithm to its least; constants of the law stay
    least = np.log(lugre.parameters[0].lower)
    assert placed.weaker(start) == pytest.approx([(start[0] + least) / 2, 0.125, start[2], start[3]])
    assert placed.weaker(np.array([0.0, 0.06, -3.0, -3.0]))[1] == pytest.approx(0.05)
    # a spring that stiffens does nothing where its length is endless
    stiffening = next(e for e in EFFECTS if e.form == "_exponential")
    spring = Placed(stiffening, stiffening.places(STRAP)[0], SCALES)
    most = np.log(stiffening.parameters[0].upper)
    assert spring.weaker(np.array([0.0, 0.4])) == pytest.approx([most / 2, 0.1])
    # filters that do next to nothing are all alike
    low_pass = placed_whole("filter_lag")
    assert low_pass.weaker(low_pass.starts()) == pytest.approx(low_pass.starts())


def test_opposite_starts_of_one_parameter_tell_its_slopes():
    base, line, bend = np.arange(5.0), np.full(5, 3.0), np.linspace(-1, 1, 5)
    starts = np.array([[-0.2], [0.2]])
    at = np.array([base + line * x + bend * x**2 for x in starts[:, 0]])
    for x, slopes in zip(starts[:, 0], _parabola(starts, at, base), strict=True):
        assert slopes[:, 0] == pytest.approx(line + 2 * bend * x)
    assert _parabola(np.array([[0.05], [0.3]]), at, base) is None
    assert _parabola(np.array([[0.0], [0.0]]), at, base) is None
    assert _parabola(starts, np.where([[True], [False]], at, np.nan), base) is None


def test_two_tangents_add_up_and_keep_the_prior_rows_of_each():
    here = Tangent(np.zeros(12), np.ones(20), np.arange(240.0).reshape(20, 12))
    one = Beside(np.append(here.z, 1.0), np.full(20, 3.0), np.full((20, 1), 5.0), here.jacobian)
    with_prior = np.append(np.full(20, 7.0), 4.0)[:, None]
    other = Beside(np.append(here.z, 2.0), np.append(np.full(20, 0.5), 8.0), with_prior, here.jacobian)
    both = _carried(here, other, one.whole)
    assert both.z[12:].tolist() == [1.0, 2.0]
    assert both.residuals.tolist() == [2.5] * 20 + [8.0]
    assert (both.jacobian[:20, :12] == here.jacobian).all()
    assert both.jacobian[0, 12:].tolist() == [5.0, 7.0]
    assert both.jacobian[20].tolist() == [0.0] * 13 + [4.0]


def test_an_effect_changes_beside_others_what_it_changes_beside_none():
    plain = Tangent(np.zeros(12), np.ones(20), np.zeros((20, 12)))
    alone = Beside(
        np.append(plain.z, 2.0), np.append(np.full(20, 1.5), 8.0), np.full((21, 1), 7.0), plain.jacobian
    )
    # another effect with a prior row of its own is there already
    here = Tangent(np.full(13, 0.1), np.append(np.full(20, 0.25), 3.0), np.arange(273.0).reshape(21, 13))
    carried = _carried(plain, alone, here)
    assert carried.z.tolist() == [0.1] * 13 + [2.0]
    assert carried.residuals.tolist() == [0.75] * 20 + [3.0, 8.0]
    assert carried.columns[:, 0].tolist() == [7.0] * 20 + [0.0, 7.0]
    assert (carried.jacobian[:21, :13] == here.jacobian).all()
    assert carried.jacobian[21, :13].tolist() == [0.0] * 13


def test_beside_another_effect_those_are_screened_that_promise_most_and_the_best_of_each_name():
    coulomb, preload = (next(e for e in EFFECTS if e.name == name) for name in ("coulomb", "preload"))
    places = [Placed(e, w, SCALES) for e in (coulomb, preload) for w in e.places(STRAP)[:3]]
    unscreened = placed_whole("tilt")
    base = placed_whole("replay_lag")
    search = Search(Pair(None, None, STRAP), CONFIG["diagnosis"]["search"])
    lower, upper = STRAP.bounds()
    nothing, middle = np.zeros((4, len(lower))), (lower + upper) / 2
    search._plain = Tangent(middle, np.ones(4), nothing)
    # a place that promises more leaves less of the first residual
    for i, placed in enumerate(places):
        own = len(placed.effect.parameters)
        left = np.array([0.1 * (i + 1), 1.0, 1.0, 1.0])
        at = np.concatenate([middle, np.zeros(own)])
        search._alone[placed.key] = Beside(at, left, np.zeros((4, own)), nothing)
    beside = np.zeros((4, len(middle) + 1))
    here = Tangent(np.append(middle, 0.0), np.ones(4), beside)
    sets = [(base, placed) for placed in (*places, unscreened)]
    kept = [effects[-1].key for effects in search._likely(sets, here, 3)]
    # in the order of the places: what is not known counts as one of the three best
    assert kept == [*(p.key for p in places[:2]), places[3].key, unscreened.key]
    # before the plain plant was screened nothing is known
    search._plain = None
    assert search._likely(sets, here, 1) == sets


def _screened(effects, predicted=1.0):
    return Screened(tuple(effects), predicted, np.zeros(12), _tangent(np.zeros(12)))


def test_every_effect_stays_in_the_running_for_a_second_cause():
    coulomb = next(e for e in EFFECTS if e.name == "coulomb")
    lag = next(e for e in EFFECTS if e.name == "replay_lag")
    places = [Placed(coulomb, w, SCALES) for w in coulomb.places(STRAP)] + [
        Placed(lag, lag.places(STRAP)[0], SCALES)
    ]
    kept = _promising([_screened([p]) for p in places], 2)
    assert [p.key for p in kept] == ["coulomb tx", "coulomb ty", "replay_lag"]


def test_the_best_hypothesis_of_each_effect_comes_in_the_order_of_the_best():
    places = {e.name: e.places(STRAP) for e in EFFECTS if e.name in ("coulomb", "preload") and not e.form}
    by_name = {name: next(e for e in EFFECTS if e.name == name) for name in places}

    def single(name, axis):
        return Hypothesis((Placed(by_name[name], places[name][axis], SCALES),), np.zeros(13), (1.0, 1.0))

    found = [single("coulomb", 0), single("preload", 1), single("coulomb", 2)]
    assert [h.key for h in _first_of_each(found, lambda h: h.names[0])] == ["coulomb tx", "preload ty"]


def test_plainer_forms_are_tried_of_a_law_that_fits_unlisted_ones_too():
    """Two time constants cost a set its certainty, which one may do without."""

    class Fits(_Stuck):
        def screen(self, smaller, places):
            assert [p.effect.name for p in smaller.effects] == ["stiffening"]
            return [SimpleNamespace(effects=(*smaller.effects, place)) for place in places]

        def fit_screened(self, screened):
            return SimpleNamespace(effects=screened.effects)

    def on_tx(name, form=""):
        effect = next(e for e in EFFECTS if e.name == name and e.form == form)
        return Placed(effect, next(w for w in effect.places(STRAP) if w.axis_names == ["tx"]), SCALES)

    flexible, stiffening = on_tx("relaxation", "_two_times"), on_tx("stiffening")
    everything = [Placed(e, where, SCALES) for e in EFFECTS for where in e.places(STRAP)]
    z = np.concatenate([np.zeros(12), flexible.starts()[0], stiffening.starts()[0]])
    best = Hypothesis((flexible, stiffening), z, (5000.0, 5000.0))
    tried = _plainer(Fits(), None, [best], everything)
    assert {h.effects[1].key for h in tried} == {on_tx("relaxation").key, on_tx("relaxation", "_flow").key}
    plain = Hypothesis((stiffening,), np.concatenate([np.zeros(12), stiffening.starts()[0]]), (1.0, 1.0))
    assert _plainer(Fits(), None, [plain], everything) == []


def test_a_set_is_pruned_down_to_single_effects():
    names = ("coulomb", "preload", "tilt")
    places = [Placed(e, e.places(STRAP)[0], SCALES) for e in EFFECTS if e.name in names and not e.form]
    values = [np.full(len(p.effect.parameters), np.log(0.3)) for p in places]
    three = Hypothesis(tuple(places), np.concatenate([np.zeros(12), *values]), (90.0, 90.0))
    sizes = [len(h.effects) for h in _pruned(_Stuck(), [three])]
    assert sizes == [2, 2, 2, 1, 1]


def test_members_of_the_best_set_are_tried_alone_from_where_they_stand_in_it():
    places = [
        Placed(e, e.places(STRAP)[0], SCALES)
        for e in EFFECTS
        if e.name in ("coulomb", "preload") and not e.form
    ]
    z = np.zeros(12)
    pair = Hypothesis(tuple(places), np.concatenate([z, [np.log(0.3), 0.1]]), (90.0, 90.0))
    alone = Hypothesis((places[0],), np.concatenate([z, [0.0]]), (3000.0, 3000.0))
    found = _best_of_each([alone, pair, *_pruned(_Stuck(), [alone, pair])])
    assert [h.key for h in found] == ["coulomb tx", "coulomb tx + preload tx", "preload tx"]
    assert found[0].chi2 == (100.0, 100.0), "from the pair's force, no longer stuck"


def test_a_fit_whose_slopes_cannot_be_simulated_explains_nothing(monkeypatch):
    """An evidence without bound made probabilities of all answers not a number, and a null a named cause."""
    fake = SimpleNamespace(
        last=np.ones((1, 1)),
        free=np.arange(0),
        evaluations=0,
        occam_of=lambda z, slopes: -np.inf,
        judged=lambda z: ((1.0,), 1.0),
    )
    monkeypatch.setattr("real2sim.diagnosis.search.refit", lambda residuals, start, **options: (start, 0.0))
    monkeypatch.setattr("real2sim.diagnosis.search.JointResiduals", lambda *given, **options: fake)
    search = Search(Pair(None, None, STRAP), CONFIG["diagnosis"]["search"])
    fitted = search.fit((), np.zeros(12))
    assert fitted.chi2 == (FAILED, FAILED)
    assert fitted.occam == 0.0


def test_slopes_are_asked_for_at_the_start_that_the_base_brings_lowest():
    search = Search(Pair(None, None, STRAP), CONFIG["diagnosis"]["search"])
    here = Tangent(np.zeros(2), np.zeros(3), np.eye(3)[:, :2])
    # the first start leaves more than the second, but all of it in what the base can change
    at, z = np.array([[0.5, -0.4, 0.1], [0.0, 0.0, 0.3]]), np.zeros((2, 3))
    chosen = [
        search._promising_start(z, at, here, np.full(3, -room), np.full(3, room)) for room in (1.0, 0.1)
    ]
    assert chosen == [0, 1]


@pytest.mark.parametrize(("name", "rounds"), [("coulomb", 3), ("stiffening", 3), ("coulomb", 1)])
def test_weaker_starts_are_tried_where_the_tangent_predicts_a_loss(name, rounds):
    """A dead band an eleventh of the one that its search began at was visible, and not found."""
    effect = next(e for e in EFFECTS if (e.name, e.form) == (name, ""))
    placed = Placed(effect, effect.places(STRAP)[0], SCALES)
    asked = []

    def too_much(z):
        asked.append(z[:, -1].tolist())
        return np.full((len(z), 1), 10.0)

    residuals = SimpleNamespace(
        many=too_much,
        jacobian=lambda z, r, free: np.zeros((1, 1)),
        evaluations=0,
        lower=np.full(13, -5.0),
        upper=np.full(13, 5.0),
    )
    search = Search(Pair(None, None, STRAP), CONFIG["diagnosis"]["search"])
    search._residuals = lambda effects: residuals
    search._screen_one((placed,), Tangent(np.zeros(12), np.ones(1), np.zeros((1, 12))), rounds)
    assert len(asked) == rounds
    assert len({tuple(starts) for starts in asked}) == rounds


def test_numbers_of_an_effect_and_its_values_are_inverse():
    rng = np.random.default_rng(3)
    for effect in EFFECTS:
        for where in effect.places(STRAP)[:1]:
            placed = Placed(effect, where, SCALES)
            x = rng.uniform(*placed.bounds(), size=(2, len(effect.parameters)))
            np.testing.assert_allclose(placed.searched(placed.values(x)), x, rtol=1e-12, atol=1e-12)


class _Listed(Search):
    """A search that notes what it fits and screens."""

    threads = 1

    def __init__(self):
        self.fitted, self.screened = [], []

    def is_open(self, hypothesis):
        return False

    def fit(self, effects, start, final=False, tangent=None):
        self.fitted.append((" + ".join(p.key for p in effects), start[12:].tolist()))
        return Hypothesis(tuple(effects), start, (100.0, 100.0))

    def screen(self, base, places, weaken=True, likely=None):
        self.screened.append((base.key, {p.effect.name for p in places}, {p.where.axes for p in places}))
        return [_screened([*base.effects, place]) for place in places]

    def fit_screened(self, screened):
        return Hypothesis(screened.effects, np.zeros(40), (200.0, 200.0))


def test_neighbours_of_a_complete_set_lack_one_effect_or_hold_another_in_its_place():
    def places(scales):
        return [Placed(e, w, scales) for e in EFFECTS for w in e.places(STRAP)]

    def named(scales):
        by_key = {p.key: p for p in places(scales)}
        return by_key["tilt"], by_key["coulomb ty"]

    twice = replace(SCALES, k=2 * SCALES.k)
    complete = Hypothesis(named(SCALES), np.append(np.zeros(12), [0.02, 0.01, np.log(0.3)]), (1.0, 1.0))
    search, plain = _Listed(), Hypothesis((), np.zeros(12), (9e6, 9e6))
    found = _neighbours(search, plain, complete, places(twice), CONFIG["diagnosis"]["search"])
    keys = [key for key, _ in search.fitted]
    assert keys == ["tilt + coulomb ty", "coulomb ty", "tilt"]
    # the same force is a smaller part of that of a large excursion where the strap is twice as stiff
    share = 0.3 * SCALES.force[1] / twice.force[1]
    assert share < 0.2
    assert search.fitted[0][1] == pytest.approx([0.02, 0.01, np.log(share)])
    (_, rests, anywhere), (_, losses, at) = search.screened
    assert "preload" in rests
    assert len(anywhere) > 6
    assert {"relaxation", "lugre"} <= losses
    assert at == {(1,)}
    assert [h.key for h in found[:3]] == keys
    assert len(found) == 3 + 2 * CONFIG["diagnosis"]["search"]["swap_refits"]


def test_beside_a_set_that_cannot_be_simulated_places_begin_at_their_own_starts():
    """A tangent at what cannot be simulated is not a number, and neither was the start of a refit."""

    class Borne(_Listed):
        def fresh(self, effects, base):
            borne = effects[-1].effect.name == "coulomb"
            return np.append(base, 7.0), 50.0 if borne else FAILED

    by_key = {p.key: p for p in (Placed(e, w, SCALES) for e in EFFECTS for w in e.places(STRAP))}
    base = Hypothesis((by_key["tilt"],), np.zeros(14), (FAILED, FAILED))
    places = [by_key["preload ty"], by_key["coulomb ty"], by_key["coulomb tx"]]
    search = Borne()
    found = search.refits_beside(base, places, 5)
    assert [h.key for h in found] == ["tilt + coulomb ty", "tilt + coulomb tx"]
    assert not search.screened
    assert len(search.refits_beside(base, places, 1)) == 1
    search.refits_beside(replace(base, chi2=(9.0, 9.0)), places, 5)
    assert len(search.screened) == 1


def test_a_tangent_that_is_not_a_number_promises_nothing():
    effect = next(e for e in EFFECTS if e.name == "preload")
    placed = Placed(effect, effect.places(STRAP)[0], SCALES)
    rows = SimpleNamespace(
        lower=np.full(13, -9.0),
        upper=np.full(13, 9.0),
        evaluations=0,
        many=lambda z: np.ones((len(z), 3)),
        jacobian=lambda z, r, own: np.full((3, 1), np.nan),
    )
    search = _Listed()
    search._settings, search._counting = CONFIG["diagnosis"]["search"], Lock()
    search.evaluations, search._residuals = 0, lambda effects: rows
    here = Tangent(np.zeros(12), np.full(3, np.nan), np.full((3, 12), np.nan))
    assert search._screen_one((placed,), here, 3) is None


def test_a_sensor_that_was_not_recorded_is_not_the_loudest():
    """The markers leave less than expected, and the robot log that is not there leaves exactly nothing."""
    search = Search.__new__(Search)
    trial = SimpleNamespace(sensors={"markers": 6, "robot log": 0}, samples=3600)
    search.pair = SimpleNamespace(train=trial, held_out=trial, samples_by_sensor=((3600, 0), (3600, 0)))
    draws = np.column_stack([np.random.default_rng(0).normal(3600, 85, 15), np.zeros(15)])
    search._noise_of = lambda hypothesis: (draws, draws)
    search.left_of_both = lambda hypothesis: hypothesis.by_sensor
    quiet = Hypothesis((), np.zeros(12), (3500.0, 3500.0), sensors=((3500.0, 0.0), (3500.0, 0.0)))
    assert search.loudest_sensor(quiet) == "markers"


@pytest.mark.parametrize("places", [[], ["a place of an effect that cannot be simulated"]])
@pytest.mark.parametrize(("left", "verdict"), [((2880.0, 2880.0), NONE), ((9e4, 9e4), UNKNOWN)])
def test_without_an_effect_to_try_the_answer_is_none_or_unknown(monkeypatch, places, left, verdict):
    """Every effect is left out, or the simulation fails with each of them."""

    class Nothing(_Stuck):
        evaluations, pair = 0, None

        def __init__(self, pair, settings):
            super().__init__()

        def fit(self, effects, start, final=False, tangent=None):
            return Hypothesis(tuple(effects), start, left)

        def screen(self, base, places, weaken=True, likely=None):
            return []

        def above(self, hypothesis):
            return sum(hypothesis.chi2) - 5760

    monkeypatch.setattr(attribution_module, "Search", Nothing)
    monkeypatch.setattr(attribution_module, "_without_spikes", lambda search, plain, found, everything: found)
    options = CONFIG["diagnosis"]
    found = attribute(
        None, np.zeros(12), options["search"], lambda text: None, places, options["calibration"]
    )
    assert (found.hypotheses, found.screened) == ([], [])
    decision = decide(Candidate((), found.plain.chi2), [], found.samples, options["calibration"])
    assert (decision.verdict, decision.chosen) == (verdict, None)
    likely = options["calibration"]["ambiguity_probability"]
    wanted = next_trial(decision, options["report"]["next_trial_certain"], likely)
    assert (wanted is None) == (verdict == NONE)
    assert _baselines(found) == {}


def test_a_plain_fit_that_cannot_be_simulated_is_refused_by_the_recordings_name(monkeypatch):
    class Failing:
        def __init__(self, evidence, effects, system):
            self._cost = evidence.cost

        def costs(self, z):
            return np.array([self._cost])

    monkeypatch.setattr(attribution_module, "JointResiduals", Failing)
    slow, fast = (SimpleNamespace(name=n, cost=c) for n, c in (("slow", 5.0), ("fast", np.inf)))
    pair = Pair(slow, fast, SimpleNamespace(name="exo"))
    failed = Hypothesis((), np.zeros(3), (FAILED, FAILED))
    with pytest.raises(InputError, match=r"(?s)^fast\n.*simulation of exo fails.*not_simulated"):
        check_simulated(pair, failed)
    check_simulated(pair, replace(failed, chi2=(100.0, 100.0)))
    # noise so small that a gross misfit leaves as much: that is a misfit, and no failure
    check_simulated(Pair(slow, slow, pair.system), failed)


class _Told(Search):
    """A search of two trials, of which numbers that are fitted to both leave what ``told`` says, by key."""

    threads, samples, samples_by_sensor, on_floor = 1, (100, 100), ((100,), (100,)), (False,)

    def __init__(self, told):
        self._settings, self._told, self.asked = CONFIG["diagnosis"]["search"], told, []
        self.plain = None

    def left_of_both(self, hypothesis):
        self.asked.append(hypothesis.z[0])
        left = self._told[hypothesis.z[0]]
        hypothesis.both = FitToBoth(hypothesis.z, ((left[0],), (left[1],)), 0.0)
        return hypothesis.both.by_sensor


def _leaving(number: float, *left: float) -> Hypothesis:
    return Hypothesis((), np.array([number]), left)


def test_what_could_leave_least_of_both_trials_is_fitted_to_both():
    """The first trial left a number of the true law open; the law that predicts better explains the first less well."""
    true, wrong, hopeless = _leaving(1, 110, 9000), _leaving(2, 900, 1000), _leaving(3, 5000, 5000)
    search = _Told({1: (120.0, 105.0), 2: (950.0, 700.0)})
    assert search.least([wrong, true, hopeless]) is true
    assert search.asked == [1, 2]
    assert search.best_first([hopeless, wrong, true])[0] is true
    assert true.left == (120, 105)
    # how much is unexplained is asked of what the fit to the first trial predicts
    assert true.chi2 == (110, 9000)
    assert search.above(true) == pytest.approx(8910)


def test_a_rival_within_reach_of_the_best_is_fitted_to_both_too():
    best, near, far = _leaving(1, 100, 100), _leaving(2, 150, 900), _leaving(3, 400, 900)
    search = _Told({2: (160.0, 110.0)})
    assert search.fit_rivals_to_both([best, near, far], lambda h: 100.0) is best
    assert search.asked == [2]
    assert near.deviance == 270


def test_what_leaves_only_noise_or_is_not_simulated_is_not_fitted_again():
    quiet, failed = _leaving(1, 900, 120), _leaving(2, FAILED, FAILED)
    search = _Told({})
    assert search.least([quiet, failed]) is quiet
    assert search.asked == []


def test_a_law_is_not_expected_to_explain_more_of_the_held_out_trial_than_of_the_fitted_one():
    best, half, true = _leaving(1, 2000, 2000), _leaving(2, 3000, 9000), _leaving(3, 1100, 9000)
    search = _Told({3: (1200.0, 700.0)})
    # twice as much is left of the second trial: half of the gap there is 5 900 beyond noise
    search.plain = _leaving(0, 10_000, 20_000)
    assert search.least([best, half, true]) is true
    assert search.asked == [3]
