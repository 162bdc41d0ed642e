"""Effects beside each other: none undoes what another does, and no call changes what the next one finds."""

from __future__ import annotations

import numpy as np
import pytest
from real2sim.diagnosis.search import conflict
from real2sim.effects.base import Placed
from real2sim.effects.catalogue import EFFECTS

from tests.unit.simulated_effects import LEVEL, SCALES, STRAP, placed_whole, replay
from tests.unit.test_coupling import PRIOR


def _on(axis: str, name: str, form: str = "") -> Placed:
    effect = next(e for e in EFFECTS if e.name == name and e.form == form)
    where = next(w for w in effect.places(STRAP) if w.axis_names == [axis])
    return Placed(effect, where, SCALES)


def _start(placed: Placed) -> np.ndarray:
    return placed.starts()[:1]


@pytest.mark.parametrize(
    "other",
    [
        _on("ty", "relaxation"),
        _on("ty", "relaxation", "_two_times"),
        _on("ty", "relaxation", "_flow"),
        _on("ty", "creep"),
        placed_whole("base_compliance", "series"),
        placed_whole("base_compliance", "beyond_wheels"),
        placed_whole("base_compliance", "play"),
    ],
    ids=lambda placed: placed.effect.label,
)
@pytest.mark.parametrize("form", ["", "_uneven"])
def test_friction_of_almost_nothing_changes_nothing_beside_a_law_with_a_hidden_joint(other, form):
    friction = _on("tx", "coulomb", form)
    alone, joints = replay([other]).run_effects(PRIOR[None], [_start(other)])
    both, their_joints = replay([friction, other]).run_effects(
        PRIOR[None], [friction.at_rest()[None], _start(other)]
    )
    np.testing.assert_allclose(both, alone, rtol=0, atol=1e-9)
    np.testing.assert_allclose(their_joints, joints, rtol=0, atol=1e-9)


def test_no_call_of_a_robot_at_rest_changes_what_the_next_one_finds():
    pose = np.eye(3), LEVEL[1] + [0.03, 0.01, -0.02]
    for effect in EFFECTS:
        if effect.fits(STRAP) and effect.scope != "joint":
            placed = Placed(effect, effect.places(STRAP)[0], SCALES)
            model = replay([placed], seen=pose, settled=True, seconds=1.0)
            x, stiffer = _start(placed), PRIOR * 1.5
            first = model.run_effects(PRIOR[None], [x])[0]
            model.run_effects(stiffer[None], [placed.starts()[-1:]])
            np.testing.assert_array_equal(model.run_effects(PRIOR[None], [x])[0], first, err_msg=placed.key)


@pytest.mark.parametrize("name", ["slack", "one_sided"])
def test_the_gain_of_a_damper_is_no_force_that_a_robot_at_rest_balances(name):
    stretch = np.array([0.02, 0.0, 0.0])
    pose, coordinates = (np.eye(3), LEVEL[1] + stretch), np.tile([*stretch, 0.0, 0.0, 0.0], (100, 1))
    moved = {}
    for form in ("", "_undamped"):
        effect = next(e for e in EFFECTS if e.name == name and e.form == form)
        placed = Placed(effect, effect.places(STRAP)[0], SCALES)
        model = replay([placed], seen=pose, settled=True, motion=np.zeros((100, 6)), noise=coordinates)
        paths = model.run_effects(
            PRIOR[None], [placed.at_rest()[None] if name == "slack" else placed.bounds()[0][None]]
        )[0]
        moved[form] = float(np.abs(paths[0] - paths[0, 0]).max())
    # a strap that is hardly ever loose is damped nearly everywhere
    assert moved["_undamped"] == pytest.approx(moved[""], abs=5e-4)


@pytest.mark.parametrize(
    ("a", "b", "excluded"),
    [
        (("misalignment", ""), ("lab_yaw", ""), True),
        (("added_mass", ""), ("added_mass", "hanging"), True),
        (("base_compliance", ""), ("base_compliance", "beyond_wheels"), True),
        (("base_compliance", "play"), ("base_compliance", "beyond_wheels"), True),
        (("base_compliance", ""), ("base_compliance", "series"), False),
        (("misalignment", ""), ("added_mass", ""), False),
    ],
)
def test_effects_that_would_undo_each_other_exclude_each_other(a, b, excluded):
    assert conflict([placed_whole(*a), placed_whole(*b)]) is excluded
