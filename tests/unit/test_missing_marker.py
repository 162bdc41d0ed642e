"""A lost pelvis marker is put back where skin carried it, on made-up skin and on recordings of walking people."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from real2sim.recording import missing_marker
from scipy.spatial.transform import Rotation

from benchmarks import lost_marker

MODEL = np.array([[0.0, 0.13, 0.0], [0.0, -0.13, 0.0], [-0.17, 0.05, 0.02], [-0.17, -0.05, 0.02]])
REAL = Path(__file__).parents[3] / "shared" / "third_party"
RATE_HZ = 100.0


def _worn(heading: float = 0.3, carried: float = 0.01, noise_m: float = 0.0, followed=(1.0, 1.0, 1.0)):
    """Markers (n, 4, 3) on skin that follows the pelvis by the angles ``followed``, which are sinusoids."""
    t, rng = np.arange(0, 20, 1 / RATE_HZ), np.random.default_rng(3)
    angles = np.stack([0.2 * np.sin(5 * t), 0.15 * np.sin(3.1 * t + 1), heading * np.sin(2 * t)], axis=1)
    rotation = Rotation.from_euler("ZYX", angles[:, ::-1]).as_matrix()
    skin = np.array(followed) * carried * rng.standard_normal((4, 3, 3))
    local = MODEL + np.einsum("na,kca->nkc", angles, skin)
    points = np.einsum("nij,nkj->nki", rotation, local) + np.array([1.0, 2.0, 1.0])
    return points + noise_m * rng.standard_normal(points.shape)


@pytest.mark.parametrize("missing", range(4))
def test_skin_that_follows_the_pelvis_is_followed(missing):
    rigid, ours = lost_marker.errors(_worn(noise_m=2e-4), RATE_HZ, missing).T
    # what is left is noise of the other three, unfiltered here
    assert np.median(ours) < 0.6 * np.median(rigid)
    assert ours.max() < 2.5e-3


def test_a_rigid_body_is_put_back_exactly():
    assert lost_marker.errors(_worn(carried=0.0), RATE_HZ, 0).max() < 1e-9


def test_who_turns_round_takes_the_skin_along():
    """Three turns on the spot: they are no cause of anything, and what is one is still followed."""
    points = _worn(heading=6 * np.pi, noise_m=2e-4, followed=(1.0, 1.0, 0.0))
    rigid, ours = lost_marker.errors(points, RATE_HZ, 1).T
    assert np.median(ours) < 0.5 * np.median(rigid)


def test_a_marker_that_is_never_seen_is_that_of_a_rigid_body():
    points = _worn(carried=0.0)
    seen, whole = np.ones((len(points), 4), bool), [slice(0, len(points))]
    seen[:, 2], seen[50, 0] = False, False
    put = missing_marker.put_back(points, seen, MODEL, 2, whole, lost_marker.SKIN)
    assert np.flatnonzero(np.isnan(put).any(axis=1)).tolist() == [50]
    np.testing.assert_allclose(np.delete(put, 50, axis=0), np.delete(points[:, 2], 50, axis=0), atol=1e-9)


@pytest.mark.parametrize("samples", [30, 60])
def test_how_well_a_marker_is_put_back_is_measured_in_gaps_that_are_made(samples):
    points = _worn(noise_m=2e-4)
    # skin that follows nothing else: no other marker tells of it
    points[:, 2] += 2e-3 * np.sin(np.arange(len(points)) / 15)[:, None]
    gap = slice(700, 700 + samples)
    seen = np.ones((len(points), 4), bool)
    seen[gap, 2] = False
    known = missing_marker.error_of_put_back(
        np.where(seen[:, :, None], points, np.nan), seen, 2, gap, lost_marker.SKIN
    )
    # gaps of that length all over the trial, none of which were made
    missed = []
    for start in range(120, 1800, 97):
        there, own = np.ones_like(seen), slice(start, start + samples)
        there[own, 2] = False
        back = missing_marker.put_back(points, there, MODEL, 2, [own], lost_marker.SKIN)
        missed.append(missing_marker.shapes(samples) @ (back[own] - points[own, 2]) / samples)
    np.testing.assert_allclose(known.sd, np.sqrt(np.mean(np.square(missed), axis=0)), rtol=0.6)
    assert known.sd[0].min() > known.sd[2].max()


def test_nothing_tells_how_well_a_marker_is_known_that_is_never_seen():
    points = _worn()
    seen = np.ones((len(points), 4), bool)
    seen[:, 1] = False
    whole = slice(0, len(points))
    assert not missing_marker.error_of_put_back(points, seen, 1, whole, lost_marker.SKIN).sd.any()
    # one that is lost for longer than it is seen is told by shorter gaps
    seen[:400, 1] = True
    assert missing_marker.error_of_put_back(
        points, seen, 1, slice(400, len(points)), lost_marker.SKIN
    ).sd.any()


@pytest.mark.skipif(not REAL.is_dir(), reason=f"{REAL}: recordings by others, not in here")
@pytest.mark.parametrize(
    "file",
    [
        "qtm_c3d/cgm2_gait1_raw.c3d",
        "qtm_c3d/cgm2_gait2_fktest_raw.c3d",
        "qtm_c3d/ezc3d_Qualisys.c3d",
        "trc/models_rajagopal_walk.trc",
        "trc/mrrezaie_gait_1_marker.trc",
        "trc/opensim_nan_spaces.trc",
    ],
)
def test_markers_of_walking_people_are_put_back_nearer(file):
    """Skin of real people, in records of one to four seconds: three quarters of what a rigid body leaves, or less."""
    points, rate_hz = lost_marker.recorded(REAL / file)
    medians = np.array([np.median(lost_marker.errors(points, rate_hz, i), axis=0) for i in range(4)])
    rigid, ours = 1e3 * medians.T
    assert (ours < rigid).all(), (ours, rigid)
    assert np.mean(ours / rigid) < 0.75, (ours, rigid)
