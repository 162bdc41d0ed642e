"""The catalogue of effects: its entries are whole, it takes those of other packages, and its table is current."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from dataclasses import replace
from importlib.metadata import Distribution, EntryPoint
from pathlib import Path

import mujoco
import numpy as np
import pytest
from real2sim.effects import (
    AtRest,
    Chains,
    Effect,
    EffectParameter,
    Fields,
    InterfaceImpedance,
    Mechanism,
    Placed,
    Scales,
    StandingForce,
)
from real2sim.effects.base import NEUTRAL
from real2sim.effects.catalogue import (
    EFFECT_NAMES,
    GROUPS,
    OFFERS,
    SHIPPED,
    are_confusable,
    check,
    collect,
)
from real2sim.effects.replay import by_axis
from real2sim.errors import InputError
from real2sim.system.batches import untimed_batch
from real2sim.system.description import System, shipped_system
from real2sim.verification.suite.plan import EFFECTS as SUITE_EFFECTS

ROOT = Path(__file__).parents[2]
STRAP = shipped_system("strap")


def law(**changed) -> Effect:
    """Return a valid entry, or one with something wrong."""
    return replace(
        Effect(
            "bumpy",
            "interface",
            "F = k q + c q^3",
            (EffectParameter("cubic", "N/m3|Nm/rad3", 0.0, 1.0, (0.5,)),),
            separating_trial="one motion at three amplitudes",
            at_rest=AtRest((0.0,)),
            plant=StandingForce(lambda *_: np.zeros((1, 1, 1))),
        ),
        **changed,
    )


def test_the_suite_is_made_of_the_shipped_effects():
    # the suite asks for gaps of J, which does not see the robot's log
    names = dict.fromkeys(effect.name for effect in SHIPPED)
    assert tuple(name for name in names if name != "log_latency") == SUITE_EFFECTS


def test_the_relation_of_confusable_effects_is_symmetric_in_the_entries():
    listed = {(effect.name, other) for effect in SHIPPED for other in effect.confusable}
    assert listed == {(b, a) for a, b in listed}
    assert all(are_confusable(a, b) for a, b in listed)
    assert not are_confusable("slack", "tilt")
    # all forms of an effect list the same
    assert len({(effect.name, effect.confusable) for effect in SHIPPED}) == len(EFFECT_NAMES)
    assert len({(effect.name, effect.group) for effect in SHIPPED}) == len(EFFECT_NAMES)
    assert sorted(name for group in GROUPS.values() for name in group) == sorted(EFFECT_NAMES)


def test_a_system_offers_what_effects_may_need():
    systems = [STRAP, *(shipped_system(name) for name in ("cuff", "drba"))]
    assert all(system.offers <= OFFERS for system in systems)
    assert all(any(effect.places(system) for system in systems) for effect in SHIPPED)
    elsewhere = {effect.label for effect in SHIPPED if not effect.places(STRAP)}
    assert elsewhere == {"base_compliance joint", "base_compliance passive"}


@pytest.mark.parametrize(
    ("changed", "told"),
    [
        ({"at_rest": AtRest(())}, "at_rest has 0 values for 1 parameters"),
        ({"at_rest": AtRest((-1.0,))}, "at_rest of cubic is outside"),
        ({"parameters": (EffectParameter("cubic", "", 0.0, 1.0, (0.5,)),)}, "cubic has no unit"),
        ({"parameters": (EffectParameter("cubic", "1", 0.0, 1.0, (2.0,)),)}, "starts of cubic are outside"),
        ({"parameters": (EffectParameter("cubic", "1", 0.0, 1.0, (0.5,), log=True),)}, "are no range"),
        ({"needs": frozenset({"wings"})}, "needs wings"),
        ({"confusable": ("slakc",)}, "confusable with slakc"),
        ({"stage": "anywhere"}, "stage 'anywhere'"),
        ({"scope": "nowhere"}, "scope 'nowhere'"),
        ({"equation": ""}, "equation"),
        ({"plant": NEUTRAL}, "does nothing"),
        ({"plant": StandingForce}, "an instance of a subclass of Mechanism"),
        (
            {"parameters": EffectParameter("cubic", "1", 0.0, 1.0, (0.5,))},
            "one parameter takes a comma after it",
        ),
        ({"parameters": (EffectParameter("cubic", "1", 0.0, 1.0, 0.5),)}, "starts of cubic is 0.5"),
        ({"parameters": ("cubic",)}, "expected an EffectParameter"),
        ({"needs": "force"}, "needs is 'force', expected a set of texts"),
        ({"at_rest": 0.0}, "at_rest is 0.0, expected an AtRest"),
    ],
)
def test_an_entry_that_is_not_whole_is_refused(changed, told):
    check([law()], SHIPPED)
    with pytest.raises(InputError, match="bumpy") as refused:
        check([law(**changed)], SHIPPED, "bumpy-effects")
    assert told in str(refused.value)
    assert "bumpy-effects" in str(refused.value)


def test_no_two_entries_have_the_same_name_and_form():
    with pytest.raises(InputError, match="taken by another entry"):
        check([law(), law()], SHIPPED)
    with pytest.raises(InputError, match="taken by another entry"):
        check([law(name="slack", form="_soft")], SHIPPED)
    check([law(), law(form="_other")], SHIPPED)


class Installed(Distribution):
    """A package with a name and nothing else."""

    def read_text(self, filename):
        return "Name: bumpy-effects\n" if filename == "METADATA" else None

    def locate_file(self, path):
        return Path(path)


NOT_AN_EFFECT = "slack"
ONE = law()
MANY = [law(form="_one"), law(form="_two")]
BROKEN = law(stage="anywhere")


@pytest.mark.parametrize(
    ("value", "told"),
    [
        ("no_such_module:EFFECT", "ModuleNotFoundError"),
        (f"{__name__}:NO_SUCH_NAME", "AttributeError"),
        (f"{__name__}:NOT_AN_EFFECT", "'slack'"),
        (f"{__name__}:BROKEN", "stage 'anywhere'"),
    ],
)
def test_a_broken_package_is_named_with_what_is_wrong(value, told):
    entry = EntryPoint("bumpy", value, "real2sim.effects")._for(Installed())
    with pytest.raises(InputError) as refused:
        collect([entry], SHIPPED)
    assert "bumpy-effects" in str(refused.value)
    assert told in str(refused.value)


def test_an_entry_point_is_an_effect_or_several():
    entries = [
        EntryPoint(name.lower(), f"{__name__}:{name}", "real2sim.effects")._for(Installed())
        for name in ("ONE", "MANY")
    ]
    assert [effect.form for effect in collect(entries, SHIPPED)] == ["_one", "_two", ""]


# the example of the page
PLUGIN = (
    (ROOT / "docs" / "how-to" / "effect.md")
    .read_text(encoding="utf-8")
    .split("```")[1]
    .removeprefix("python")
)
QUESTIONS = """
import json, sys
import numpy as np
sys.path.insert(0, "docs")
import make_effects_reference
from real2sim.diagnosis.attribute import candidates
from real2sim.diagnosis.refit import Hypothesis
from real2sim.diagnosis.search import Pair, Search
from real2sim.effects.catalogue import EFFECT_NAMES, are_confusable
from tests.unit.simulated_effects import SCALES, STRAP, about, replay
from tests.unit.test_coupling import CONFIG, PRIOR
from tests.unit.test_effects import Recorded

places = candidates(STRAP, SCALES, ["cubic_damping"])
plain = replay([]).run_effects(PRIOR[None], [])[0]
rest = [replay([p]).run_effects(PRIOR[None], [p.at_rest()[None]])[0] for p in places]
pair = Pair(Recorded(0.05, held_out=False), Recorded(0.05, held_out=True), about(PRIOR))
search = Search(pair, CONFIG["diagnosis"]["search"])
screened = search.screen(Hypothesis((), np.log(PRIOR), (1.0, 1.0)), places)
print(json.dumps({
    "last": EFFECT_NAMES[-1],
    "confusable": are_confusable("quadratic_damping", "cubic_damping"),
    "places": len(places),
    "away": max(float(np.abs(paths - plain).max()) for paths in rest),
    "screened": len(screened),
    "row": "cubic_damping" in make_effects_reference.reference(),
}))
"""


def test_a_package_of_one_file_adds_an_effect_and_nothing_else_is_edited(tmp_path):
    (tmp_path / "bumpy.py").write_text(PLUGIN)
    (tmp_path / "bumpy-1.0.dist-info").mkdir()
    (tmp_path / "bumpy-1.0.dist-info" / "METADATA").write_text(
        "Metadata-Version: 2.1\nName: bumpy\nVersion: 1.0\n"
    )
    (tmp_path / "bumpy-1.0.dist-info" / "entry_points.txt").write_text(
        "[real2sim.effects]\nbumpy = bumpy:EFFECT\n"
    )
    path = os.pathsep.join([str(tmp_path), str(ROOT / "workflow"), str(ROOT)])
    done = subprocess.run(
        [sys.executable, "-c", QUESTIONS],
        cwd=ROOT,
        env=os.environ | {"PYTHONPATH": path},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    told = json.loads(done.stdout)
    assert told.pop("away") <= 1e-9
    assert told == {"last": "cubic_damping", "confusable": True, "places": 6, "screened": 6, "row": True}


def test_the_table_of_effects_is_current():
    done = subprocess.run(
        [sys.executable, ROOT / "docs" / "make_effects_reference.py", "--check"], check=False
    )
    assert done.returncode == 0, "run: python docs/make_effects_reference.py"


# ---------------------------------------------------------------- systems of other axes

ONE_AXIS = """
<mujoco>
  <option timestep="0.002" integrator="Euler" gravity="0 0 0"/>
  <worldbody>
    <body name="forearm"><inertial pos="0 0 0" mass="2" diaginertia="0.1 0.1 0.1"/>
      <joint name="elbow" type="hinge" axis="0 1 0" stiffness="40" damping="1.5"/>
    </body>
  </worldbody>
  <actuator><motor joint="elbow"/></actuator>
</mujoco>
"""


def one_axis(**parameters) -> System:
    """Return a system of one hinge with a stiffness parameter, or others."""
    stiffness = {"unit": "Nm/rad", "bounds": [1, 100], "sets": "stiffness", "of": "flexion"}
    return System.from_dict(
        {
            "name": "elbow",
            "model": "elbow.xml",
            "interface": {"axes": {"flexion": {"joint": "elbow", "type": "hinge"}}, "body": "forearm"},
            "drive": {"by": "force", "of": {"elbow": "torque"}},
            "parameters": {"k": stiffness} | parameters,
        }
    )


def swing(placed: Placed | None, x: np.ndarray | None, system: System) -> np.ndarray:
    """Return the coordinate (n,) of a swing under a torque, with an effect of the plant at searched numbers (p,)."""
    spec = mujoco.MjSpec.from_string(ONE_AXIS)
    plant, where = (
        (placed.effect.plant, placed.where) if placed else (NEUTRAL, Effect.place(law(), system, (0,)))
    )
    plant.build(spec, where)
    model = spec.compile()
    batch = untimed_batch(model, 1, 1)
    fields = Fields(batch, model, 1, SCALES, system)
    impedance = InterfaceImpedance(np.array([[40.0]]), np.array([[1.5]]))
    steps = 500
    t = 0.002 * np.arange(steps)
    context = Recording(t)
    control = np.zeros((1, steps, model.nu))
    control[0, :, 0] = 4 * np.sin(6 * t)
    if placed is not None and x is not None:
        values = placed.values(x[None])
        plant.set(fields, where, impedance, values)
        plant.before_run(fields, where, impedance, values)
        force = plant.force(values, context, where, impedance)
        if force is not None:
            control[:, :, plant.columns(model, where)] += force
    return batch.rollout(steps, control, record=("qpos",))["qpos"][0, :, 0]


class Recording:
    """What planned forces are computed from, of one coordinate."""

    start = 10

    def __init__(self, time_s: np.ndarray):
        self.time_s = self.step_time_s = time_s
        self.coordinates = 0.1 * np.sin(6 * time_s)[:, None]


SCALES = Scales(*(np.array([value]) for value in (0.08, 0.4, 40.0, 1.5, 0.1)))
OF_ONE_AXIS = [
    effect
    for effect in SHIPPED
    if not effect.needs and effect.plant is not NEUTRAL and effect.scope in ("axis", "side")
]


@pytest.mark.parametrize("effect", OF_ONE_AXIS, ids=lambda e: e.label)
def test_a_law_of_one_axis_works_in_a_system_of_any_axis(effect):
    system = one_axis()
    plain = swing(None, None, system)
    for where in effect.places(system):
        placed = Placed(effect, where, SCALES)
        assert placed.key.startswith(f"{effect.name} flexion")
        assert all(
            "rad" in unit or unit in ("1", "s", "1/s", "Nm")
            for _, unit in placed.named(placed.at_rest()).values()
        )
        away = np.abs(swing(placed, placed.at_rest(), system) - plain).max()
        assert away <= max(effect.at_rest.tolerance, 1e-9), placed.key
        acting = [np.abs(swing(placed, x, system) - plain).max() for x in placed.starts()]
        assert max(acting) > 1e-5, placed.key


def test_an_effect_has_places_only_where_a_system_offers_what_it_needs():
    system = one_axis()
    assert system.offers == {"force", "interface_body"}
    names = {effect.name for effect in SHIPPED if effect.places(system)}
    assert {"slack", "coulomb", "added_mass", "preload", "sync_offset", "filter_lag", "outliers"} <= names
    assert not names & {"base_compliance", "tilt", "lab_yaw", "misalignment", "soft_tissue", "marker_drift"}
    couplings = [effect for effect in SHIPPED if effect.scope == "pair"]
    assert couplings
    assert not any(effect.places(system) for effect in couplings)


def test_mass_is_added_to_the_body_that_the_interface_hangs_on():
    system = one_axis()
    effect = next(e for e in SHIPPED if e.name == "added_mass" and not e.form)
    model = mujoco.MjModel.from_xml_string(ONE_AXIS)
    batch = untimed_batch(model, 1, 1)
    fields = Fields(batch, model, 1, SCALES, system)
    impedance = InterfaceImpedance(np.ones((1, 1)), np.ones((1, 1)))
    effect.plant.set(fields, effect.place(system), impedance, np.array([[0.5, 0.02]]))
    body = model.body("forearm").id
    assert fields["body_mass"][0, body] == 2.5
    np.testing.assert_allclose(fields["body_inertia"][0, body], 0.12)


def test_an_axis_without_a_parameter_has_the_models_own_value():
    parameters = np.array([[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]])
    own = np.array([7.0, 8.0])
    np.testing.assert_array_equal(by_axis(parameters, {0: 1}, own), [[2.0, 8.0], [5.0, 8.0]])
    np.testing.assert_array_equal(by_axis(parameters, {}, own), [[7.0, 8.0], [7.0, 8.0]])
    side_by_side = by_axis(parameters, {0: 1, 1: 2}, own)
    np.testing.assert_array_equal(side_by_side, parameters[:, 1:])
    assert np.shares_memory(side_by_side, parameters)


@pytest.mark.parametrize(
    "effect",
    [e for e in SHIPPED if e.chains.output and not e.needs and e.parameters],
    ids=lambda e: e.label,
)
@pytest.mark.parametrize("shape", [(2, 3), (5, 3), (4,)])
def test_chains_along_time_take_paths_of_any_shape(effect, shape):
    context = Recording(0.01 * np.arange(200))
    paths = np.cumsum(np.random.default_rng(0).standard_normal((2, 200, *shape)), axis=1)
    placed = Placed(effect, effect.place(STRAP), SCALES)
    values = placed.values(placed.starts()[[0, 0]])[:, placed.of_trial(held_out=False)]
    chain = effect.chains.output
    out = chain(paths, values, context)
    assert out.shape == paths.shape
    np.testing.assert_allclose(chain(paths[..., :1], values, context), out[..., :1], atol=1e-12)


def test_a_neutral_mechanism_leaves_the_plant_as_it_is():
    plain = mujoco.MjSpec.from_string(ONE_AXIS)
    where = law().place(one_axis(), (0,))
    Mechanism().build(plain, where)
    assert plain.to_xml() == mujoco.MjSpec.from_string(ONE_AXIS).to_xml()
    assert NEUTRAL.force(np.zeros((1, 1)), Recording(np.zeros(3)), where, None) is None
    assert Chains().empty


def test_every_effect_has_plain_words_and_a_picture_on_its_page():
    page = (ROOT / "docs" / "effects.md").read_text(encoding="utf-8")
    sys.path.insert(0, str(ROOT / "docs"))
    from make_effects_reference import IMAGES, MEANING

    assert set(MEANING) == set(EFFECT_NAMES)
    for name in EFFECT_NAMES:
        assert f"\n## {name}\n\n{MEANING[name]}\n" in page
        assert (IMAGES / f"{name}.png").exists(), f"run: python docs/make_effects_pictures.py {name}"
        assert f"(images/effects/{name}.png)" in page
