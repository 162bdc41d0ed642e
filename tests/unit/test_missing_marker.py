"""A lost pelvis marker is put back where skin carried it, on made-up skin and on recordings of walking people."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from real2sim import geometry, signals
from real2sim.configuration import validated
from real2sim.recording import missing_marker
from real2sim.recording.formats.detect import read_markerless, read_markers
from scipy.spatial.transform import Rotation

SKIN = validated({}, "config", Path("defaults"))["ingest"]["skin"]
MODEL = np.array([[0.0, 0.13, 0.0], [0.0, -0.13, 0.0], [-0.17, 0.05, 0.02], [-0.17, -0.05, 0.02]])
REAL = Path(__file__).parents[3] / "shared" / "third_party"
NAMES = (("LASI", "RASI", "LPSI", "RPSI"), ("L_IAS", "R_IAS", "L_IPS", "R_IPS"))
RATE_HZ, GAP_S = 100.0, 0.44


def _worn(heading: float = 0.3, carried: float = 0.01, noise_m: float = 0.0, followed=(1.0, 1.0, 1.0)):
    """Markers (n, 4, 3) on skin that follows the pelvis by the angles ``followed``, which are sinusoids."""
    t, rng = np.arange(0, 20, 1 / RATE_HZ), np.random.default_rng(3)
    angles = np.stack([0.2 * np.sin(5 * t), 0.15 * np.sin(3.1 * t + 1), heading * np.sin(2 * t)], axis=1)
    rotation = Rotation.from_euler("ZYX", angles[:, ::-1]).as_matrix()
    skin = np.array(followed) * carried * rng.standard_normal((4, 3, 3))
    local = MODEL + np.einsum("na,kca->nkc", angles, skin)
    points = np.einsum("nij,nkj->nki", rotation, local) + np.array([1.0, 2.0, 1.0])
    return points + noise_m * rng.standard_normal(points.shape)


def _errors(points: np.ndarray, rate_hz: float, missing: int, skin) -> np.ndarray:
    """RMS errors [m] of a marker in gaps all over the trial, bridged to the edges of each."""
    n, width, model = len(points), round(GAP_S * rate_hz), _model(points)
    out = []
    for start in range(10, n - width - 10, max(width // 2, 1)):
        seen, gap = np.ones((n, 4), bool), slice(start, start + width)
        seen[gap, missing] = False
        lost = np.where(seen[:, :, None], points, np.nan)
        put = missing_marker.place(lost, seen, model, missing, skin)
        put[gap] += missing_marker.bridge(lost[:, missing] - put, gap)
        out.append(np.sqrt(np.mean(np.sum((put - points[:, missing])[gap] ** 2, axis=1))))
    return np.array(out)


def _model(points: np.ndarray) -> np.ndarray:
    rotation, origin = geometry.pelvis_frame(*np.moveaxis(points, 1, 0))
    return np.einsum("nji,nkj->nki", rotation, points - origin[:, None]).mean(axis=0)


def _rigid():
    """Skin that moves too little to be told of: what a rigid body leaves."""
    return SKIN | {"carried_m_per_rad": 1e-9, "carried_per_stretch": 1e-9}


@pytest.mark.parametrize("missing", range(4))
def test_skin_that_follows_the_pelvis_is_followed(missing):
    points = _worn(noise_m=2e-4)
    ours, rigid = (_errors(points, RATE_HZ, missing, skin) for skin in (SKIN, _rigid()))
    # what is left is noise of the other three, unfiltered here
    assert np.median(ours) < 0.6 * np.median(rigid)
    assert ours.max() < 2.5e-3


def test_a_rigid_body_is_put_back_exactly():
    points = _worn(carried=0.0)
    assert _errors(points, RATE_HZ, 0, SKIN).max() < 1e-9


def test_who_turns_round_takes_the_skin_along():
    """Three turns on the spot: they are no cause of anything, and what is one is still followed."""
    points = _worn(heading=6 * np.pi, noise_m=2e-4, followed=(1.0, 1.0, 0.0))
    ours, rigid = (_errors(points, RATE_HZ, 1, skin) for skin in (SKIN, _rigid()))
    assert np.median(ours) < 0.5 * np.median(rigid)


def test_a_marker_that_is_never_seen_is_that_of_a_rigid_body():
    points = _worn(carried=0.0)
    seen = np.ones((len(points), 4), bool)
    seen[:, 2] = False
    put = missing_marker.place(np.where(seen[:, :, None], points, np.nan), seen, MODEL, 2, SKIN)
    np.testing.assert_allclose(put, points[:, 2], atol=1e-9)
    seen[50, 0] = False
    assert np.isnan(missing_marker.place(points, seen, MODEL, 2, SKIN)[50]).all()


def _recorded(path: Path) -> tuple[np.ndarray, float]:
    """Pelvis markers (n, 4, 3) [m] of the longest stretch in which all are seen, filtered as ingest does, and rate."""
    if path.suffix == ".trc":
        landmarks = read_markerless(path)
        positions, time_s = landmarks.positions, landmarks.time_s
    else:
        recording = read_markers(path)
        positions, time_s = recording.positions, recording.time_s
    names = next(names for names in NAMES if set(names) <= positions.keys())
    points = np.stack([positions[name] for name in names], axis=1)
    rate_hz = float(1 / np.median(np.diff(time_s)))
    run = max(signals.segments(np.isfinite(points).all(axis=(1, 2))), key=lambda s: s.stop - s.start)
    return np.stack([signals.lowpass(p, rate_hz, 12, 4) for p in np.moveaxis(points[run], 1, 0)], 1), rate_hz


@pytest.mark.skipif(not REAL.is_dir(), reason=f"{REAL}: recordings by others, not in here")
@pytest.mark.parametrize(
    "file",
    [
        "qtm_c3d/cgm2_gait1_raw.c3d",
        "qtm_c3d/cgm2_gait2_fktest_raw.c3d",
        "qtm_c3d/ezc3d_Qualisys.c3d",
        "trc/mrrezaie_gait_1_marker.trc",
        "trc/opensim_nan_spaces.trc",
    ],
)
def test_markers_of_walking_people_are_put_back_nearer(file):
    """Skin of real people, in records of one to four seconds: three quarters of what a rigid body leaves, or less."""
    points, rate_hz = _recorded(REAL / file)
    ours, rigid = (
        np.array([np.median(_errors(points, rate_hz, missing, skin)) for missing in range(4)])
        for skin in (SKIN, _rigid())
    )
    assert (ours < rigid).all(), (1e3 * ours, 1e3 * rigid)
    assert np.mean(ours / rigid) < 0.75, (1e3 * ours, 1e3 * rigid)
