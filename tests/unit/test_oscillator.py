"""A resonant machine of five grams: its plain fit finds the resonance, and it is heavier than its model or is not."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import real2sim as r2s
from real2sim import signals
from scipy.signal import lsim

MACHINE = Path(__file__).parents[2] / "examples" / "machines" / "silverbox"
MASS, STIFFNESS, DAMPING = 0.005, 1000.0, 0.2
RATE_HZ, NOISE_M = 610.0, 3e-8


def _recording(system: r2s.System, mass: float, seed: int) -> r2s.Recording:
    rng = np.random.default_rng(seed)
    time_s = np.arange(800) / RATE_HZ
    force = 1e-3 * signals.lowpass(rng.standard_normal((len(time_s), 1)), RATE_HZ, 150.0, 4)[:, 0]
    # between the samples, the force has no more than its band
    fine = signals.upsampled(force[:, None], 50)[:, 0]
    at = np.linspace(0, time_s[-1], len(fine))
    _, motion, _ = lsim(([1.0], [mass, DAMPING, STIFFNESS]), fine, at)
    seen = motion[::50] + NOISE_M * rng.standard_normal(len(time_s))
    table = pd.DataFrame({"time_s": time_s, "input_N": force, "output_m": seen})
    return r2s.Recording.from_table(system, table, f"record_{seed}")


@pytest.fixture(scope="module")
def system() -> r2s.System:
    """Return the described oscillator, its mass known."""
    described = r2s.System.from_yaml(MACHINE / "system.yaml")
    return replace(described, parameters=tuple(p for p in described.parameters if p.name != "mass"))


def test_plain_fit_finds_the_resonance_from_starts_of_which_the_nearest_is_overdamped(system):
    fit = r2s.identify(system, _recording(system, MASS, 1))
    assert fit.values["k_x"] == pytest.approx(STIFFNESS, rel=0.01)
    assert fit.values["d_x"] == pytest.approx(DAMPING, rel=0.05)


@pytest.mark.parametrize(("step_s", "halved"), [(5e-4, True), (1e-4, False)])
def test_a_step_that_would_move_the_fit_is_halved_until_it_does_not(system, step_s, halved):
    fit = r2s.identify(replace(system, step_s=step_s), _recording(system, MASS, 1))
    codes = {finding.code for finding in fit.findings}
    assert ("step_refined" in codes) is halved
    assert (fit.system.step_s < step_s) is halved
    assert "step_coarse" not in codes
    assert fit.values["d_x"] == pytest.approx(DAMPING, rel=0.002)


def test_a_step_that_may_not_be_halved_far_enough_is_told(system):
    few = {"diagnosis": {"described": {"channels": {"most_step_parts": 2}}}}
    fit = r2s.identify(replace(system, step_s=1e-3), _recording(system, MASS, 1), settings=few)
    assert {"step_refined", "step_coarse"} <= {finding.code for finding in fit.findings}
    assert abs(fit.values["d_x"] / DAMPING - 1) > 0.002


@pytest.mark.parametrize(("heavier", "verdict"), [(1.0, "none"), (1.1, "added_mass")])
def test_half_a_gram_too_much_is_found_and_none_is_not(system, heavier, verdict):
    train, held_out = (_recording(system, heavier * MASS, seed) for seed in (1, 2))
    answer = r2s.diagnose(system, train=train, held_out=held_out, progress=lambda text: None)
    assert answer.verdict == verdict, answer.table().to_string()
    assert answer.probabilities[verdict] > 0.9
    if verdict != "none":
        (mass,) = (v["value"] for k, v in answer.answer.causes[0].parameters.items() if k.startswith("mass"))
        assert mass == pytest.approx((heavier - 1) * MASS, rel=0.1)
        first = answer.table().iloc[0]
        assert first["effect"] == "added_mass"
        assert first["mass_kg_low"] < mass < first["mass_kg_high"]
        assert first["together_with"] == ""
        again = r2s.diagnose(system, train=train, held_out=held_out, progress=lambda text: None, threads=2)
        assert again.answer.to_dict() == answer.answer.to_dict()
