"""Markers that jump for some frames."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from real2sim import signals
from real2sim.configuration import validated
from real2sim.geometry import PELVIS_MARKERS, pelvis_frame
from real2sim.recording.jumps import JumpRule, ghosts, spikes, without_ghosts
from real2sim.signals import lowpass
from scipy.spatial.transform import Rotation

from tests.unit.simulated_effects import PELVIS_SHAPE, placed_whole, replay
from tests.unit.test_coupling import PRIOR

RATE, SETTLE_S = 100.0, 0.5
OPTIONS = validated({}, "config", Path("defaults"))["diagnosis"]["jumps"]
SKIN = validated({}, "config", Path("defaults"))["ingest"]["skin"]
RULE = JumpRule(RATE, 12.0, OPTIONS)
RESIDUAL_SD = OPTIONS["residual_sd"]
TIME = np.arange(1200) / RATE
SHAPE = PELVIS_SHAPE - pelvis_frame(*PELVIS_SHAPE)[1]


@dataclass(frozen=True)
class Seen:
    pelvis_rotation: np.ndarray
    pelvis_position: np.ndarray
    pelvis_markers: np.ndarray
    usable: np.ndarray


def body() -> np.ndarray:
    """Markers (n, 4, 3) of somebody who turns, sways, and steps hard at 6 s; the skin of one slides with the turn."""
    turn = Rotation.from_euler(
        "ZYX", 0.3 * np.sin(np.outer(TIME, [4.0, 5.1, 3.3])) + [1.0, 0.1, 0.0]
    ).as_matrix()
    place = 0.1 * np.cos(np.outer(TIME, [3.7, 4.3, 2.9]))
    place[:, 2] += 0.02 * np.exp(-(((TIME - 6.0) / 0.05) ** 2))
    slides = np.zeros((len(TIME), 4, 3))
    slides[:, 1, 0] = 0.005 * np.sin(4.0 * TIME)
    return place[:, None] + np.einsum("nij,nkj->nki", turn, SHAPE + slides)


def filtered(markers: np.ndarray, seed: int = 0) -> np.ndarray:
    """As the ingest leaves them: noise of 0.4 mm, and a low-pass at 10 Hz."""
    noisy = markers + 4e-4 * np.random.default_rng(seed).standard_normal(markers.shape)
    return signals.lowpass(noisy.reshape(len(markers), 12), RATE, 10.0, 4).reshape(markers.shape)


def seen(markers: np.ndarray) -> Seen:
    return Seen(*pelvis_frame(*np.moveaxis(markers, 1, 0)), markers, np.ones(len(markers), bool))


def test_a_body_that_moves_and_skin_that_slides_are_no_jumps():
    for seed in range(20):
        assert not ghosts(filtered(body(), seed), RULE).any()
    trial = seen(filtered(body()))
    same, jumped = without_ghosts(trial, RULE, SKIN, SETTLE_S)
    assert same is trial
    assert jumped == {}


@pytest.mark.parametrize("marker", range(4))
@pytest.mark.parametrize("axis", range(3))
def test_a_ghost_is_put_where_its_marker_was_to_the_others(marker, axis):
    """15 mm for four frames, in the plane of the four or out of it: the pose is as good as without."""
    jumped = body()
    jumped[300:304, marker, axis] += 0.015
    clean, trial = seen(filtered(body())), seen(filtered(jumped))
    found = ghosts(trial.pelvis_markers, RULE)
    assert found[300:304, marker].all()
    assert not np.delete(found, marker, axis=1).any()
    assert not found[:280].any()
    assert not found[330:].any()
    mended, jumped = without_ghosts(trial, RULE, SKIN, SETTLE_S)
    assert list(jumped) == [PELVIS_MARKERS[marker]]
    assert 0.2 < jumped[PELVIS_MARKERS[marker]] < 0.5
    # noise of the three that are left; a PSIS that jumps forward turns nothing
    for name, noise in (("pelvis_rotation", 2e-3), ("pelvis_position", 5e-4)):
        wrong, left = (np.abs(getattr(t, name) - getattr(clean, name)).max() for t in (trial, mended))
        assert left <= max(0.3 * wrong, noise)
    assert mended.usable.all()


def test_a_simulation_that_jumps_is_no_marker_that_jumps():
    """A stop that is simulated too hard kicks the path, and what it leaves of the recording."""
    recorded = filtered(body())[:, :2]
    simulated = recorded + 1e-4 * np.random.default_rng(1).standard_normal(recorded.shape)
    simulated[500:503, :, 2] += 0.002
    assert spikes(recorded - simulated, RULE, RESIDUAL_SD)[500:503].all()
    assert not spikes(recorded - simulated, RULE, RESIDUAL_SD, simulated).any()
    recorded[700:703, 0, 1] += 0.01
    found = spikes(recorded - simulated, RULE, RESIDUAL_SD, simulated)
    assert found[700:703, 0].all()
    assert not found[:, 1].any()


def test_the_pelvis_is_unknown_where_two_markers_are_ghosts():
    jumped = body()
    jumped[500:503, 0] += 0.02
    jumped[502:505, 3] -= 0.02
    mended, lasts = without_ghosts(seen(filtered(jumped)), RULE, SKIN, SETTLE_S)
    # two at once make the others doubtful too
    assert {"ASIS_L", "PSIS_R"} <= set(lasts)
    lost = ~np.isfinite(mended.pelvis_position).all(axis=1)
    assert lost[500:505].all()
    assert lost.sum() < 40
    assert not mended.usable[lost].any()
    after = np.flatnonzero(lost)[-1] + 1
    assert not mended.usable[after : after + round(SETTLE_S * RATE)].any()
    assert mended.usable[after + round(SETTLE_S * RATE) + 1 :].all()


def test_a_jump_shows_in_what_a_fit_leaves_though_the_motion_hides_it():
    rng = np.random.default_rng(3)
    noise = lowpass(2e-3 * rng.standard_normal((1200, 6)), 100, 10.0, 4).reshape(1200, 2, 3)
    assert not spikes(noise, RULE, RESIDUAL_SD).any()
    jump = np.zeros((1200, 6))
    jump[600, 2] = 0.03
    jump = lowpass(jump, 100, 10.0, 4).reshape(1200, 2, 3)
    found = spikes(noise + jump, RULE, RESIDUAL_SD)
    assert found[600, 0]
    assert not found[:580].any()
    assert not found[:, 1].any()
    t = np.arange(1200) / 100
    motion = 0.01 * np.sin(2 * np.pi * 5 * t)[:, None, None] * np.ones((1, 2, 3))
    assert not spikes(motion + noise + jump, RULE).any()


def test_noise_of_a_path_that_begins_or_ends_is_no_jump():
    """A filter has one side only there: a null with two gaps was called outliers (0.66)."""
    rng = np.random.default_rng(3)
    whole = np.concatenate([np.arange(0, 580), np.arange(620, 1200)])
    noise = np.full((1200, 6), np.nan)
    noise[whole] = 2e-4 * rng.standard_normal((len(whole), 6))
    # as loud again as anywhere else
    for first in (0, 579, 620, 1199):
        noise[first] = 2e-3
    assert not spikes(noise.reshape(1200, 2, 3), RULE, RESIDUAL_SD).any()
    noise[300] = 2e-3
    assert spikes(noise.reshape(1200, 2, 3), RULE, RESIDUAL_SD)[300].all()


def test_a_gap_beside_a_jump_stays_what_was_simulated():
    model = replay([placed_whole("outliers"), placed_whole("clock_drift")])
    model._context.spikes[100:120, 0] = True
    model._context.measured[110:115, 0] = np.nan
    paths, _ = model.run_effects(PRIOR[None], [np.zeros((1, 0)), np.array([[0.001]])])
    assert np.isfinite(paths).all()
