"""Noise of markers, log and rest pose as it is measured, and what the diagnosis counts as noise."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from real2sim.configuration import validated
from real2sim.diagnosis.sensors import by_sensor
from real2sim.geometry import AXES
from real2sim.recording.missing_marker import PutBack
from real2sim.recording.noise import Bands, drawn_together, noise_colour, rest_uncertainty, robot_noise
from real2sim.study.strap_evidence import Drawn, Elsewheres, StrapEvidence
from real2sim.system.plant import ROBOT_JOINTS
from scipy.signal import butter, lfilter, sosfiltfilt

STUDY = validated({}, "config", Path("defaults"))
BANDS = Bands.from_settings(STUDY["ingest"], STUDY["diagnosis"]["noise"])


def test_noise_of_markers_that_are_alike_is_drawn_together_and_of_unlike_ones_is_not():
    rng = np.random.default_rng(1)
    freedom = 48.0
    alike = 0.5e-3**2 * rng.chisquare(freedom, 18) / freedom
    known = drawn_together(alike, freedom)
    assert np.abs(np.log(known / 0.5e-3**2)).max() < 0.1
    assert np.abs(np.log(alike / 0.5e-3**2)).max() > 0.3
    unlike = alike * np.repeat([1.0, 100.0], 9)
    assert np.abs(np.log(drawn_together(unlike, freedom) / unlike)).max() < 0.05


def _log(path: Path, noise: np.ndarray) -> Path:
    """robot.parquet of a robot that stands still, with noise (n, 6)."""
    pq.write_table(pa.table(dict(zip(ROBOT_JOINTS, noise.T, strict=True))), path)
    return path


def test_a_rest_pose_is_as_uncertain_as_the_person_sways(tmp_path):
    rng = np.random.default_rng(4)
    sway = np.repeat(1e-3 * rng.standard_normal((9, 6)), 100, axis=0)
    q = sway + 1e-4 * rng.standard_normal((900, 6))
    pq.write_table(pa.table({f"q_{a}": q[:, i] for i, a in enumerate(AXES)}), tmp_path / "pose.parquet")
    seconds = sway[::100]
    expected = seconds.std(axis=0, ddof=1) / 3
    np.testing.assert_allclose(rest_uncertainty(tmp_path / "pose.parquet", 100), expected, rtol=0.1)


def test_what_is_left_while_standing_is_told_in_units_of_noise():
    rng = np.random.default_rng(0)
    sd = np.array([1e-3, 2e-4])
    noise = sd * rng.standard_normal((64, 100, 2))
    seen = SimpleNamespace(noise=noise, context=SimpleNamespace(start=40), _floor=np.zeros(2))
    error = np.stack(
        [noise[0], 3 * sd + 0 * noise[0], np.where(np.arange(100)[:, None] < 40, 0, 1.0) + 0 * sd]
    )
    got = StrapEvidence.standing(seen, error)
    assert got[0] == pytest.approx(1, abs=0.5)
    assert got[1] == pytest.approx(9, rel=0.1)
    assert got[2] == 0


def test_noise_of_the_robots_log_is_what_it_shows_while_all_stand(tmp_path):
    """A log of 0.4 mm and 0.6 mrad passed for a gap of 25 SD in every trial when encoders were taken as exact."""
    rng = np.random.default_rng(1)
    sd = np.array([4e-4, 3e-4, 6e-4, 1e-4, 5e-4, 2e-4])
    still = _log(tmp_path / "neutral.parquet", sd * rng.standard_normal((800, 6)))
    motion = np.sin(2 * np.pi * 0.5 * np.arange(1500) / 100)[:, None]
    moved = _log(tmp_path / "moved.parquet", 0.1 * motion + sd * rng.standard_normal((1500, 6)))
    none = _log(tmp_path / "none.parquet", np.full((800, 6), np.nan))
    np.testing.assert_allclose(robot_noise(still, none, BANDS), sd, rtol=0.25)
    np.testing.assert_allclose(robot_noise(none, moved, BANDS), sd, rtol=0.25)
    assert not robot_noise(none, none, BANDS).any()


def test_wheels_that_turn_may_be_read_worse_than_wheels_that_stand(tmp_path):
    """Odometry of 0.36 mm beside 0.22 mm in quiet standing left 500 more than noise in a stranger's null."""
    rng = np.random.default_rng(2)
    sd = np.array([4e-4, 3e-4, 6e-4, 1e-4, 5e-4, 2e-4])
    still = _log(tmp_path / "neutral.parquet", sd * rng.standard_normal((800, 6)))
    motion = np.sin(2 * np.pi * 0.5 * np.arange(1500) / 100)[:, None]
    louder = np.array([2.0, 1.0, 1.0, 1.0, 2.0, 1.0])
    moved = _log(tmp_path / "moved.parquet", 0.1 * motion + louder * sd * rng.standard_normal((1500, 6)))
    np.testing.assert_allclose(robot_noise(still, moved, BANDS), louder * sd, rtol=0.25)
    # what shakes at 8 Hz alone is motion
    shaking = 1e-3 * np.sin(2 * np.pi * 8 * np.arange(1500) / 100)[:, None]
    shaken = _log(tmp_path / "shaken.parquet", shaking + sd * rng.standard_normal((1500, 6)))
    np.testing.assert_allclose(robot_noise(still, shaken, BANDS), sd, rtol=0.25)


@dataclass(frozen=True)
class _Logged(StrapEvidence):
    """Evidence of 12 s with white noise of 1 mm and mrad in all channels, of which nothing is simulated."""

    given: np.ndarray | None = None
    driven: np.ndarray | None = None

    def replay(self, effects, nsim, *, coarse=False):
        return None

    def _shake(self, replay, draws, seed):
        pass

    def _draw(self, seed, i):
        rng = np.random.default_rng([seed, i])
        noise = 1e-3 * rng.standard_normal((len(self.robot), 2, 3))
        return Drawn((None, None), 1e-3 * rng.standard_normal((3, 6)), noise)

    def _misjudged(self, markers):
        return np.zeros((len(markers), 6))

    def _elsewhere(self, parameters):
        none = np.zeros((0, len(self.robot), 12))
        starts, pelvis = (np.zeros((k, len(self.robot), 12)) for k in (6, 18))
        return Elsewheres(self.given, starts, pelvis if self.driven is None else self.driven, none, none)

    def _apart(self, replay, parameters, draws, markers, logged, x=()):
        return -np.concatenate([markers.reshape(draws, -1, 6), logged], axis=2)


def _logged(
    log: np.ndarray,
    offset_sd_s: float = 0.0,
    rests: np.ndarray | None = None,
    interface: np.ndarray | None = None,
    driven: np.ndarray | None = None,
) -> StrapEvidence:
    """Such evidence with a log (n, 6), once its noise is simulated.

    ``rests`` (k, n, 12) and ``driven`` (18, n, 12) are those of `Elsewheres`, the latter for errors of 1 mm and mrad.
    """
    n = len(log)
    seen = np.zeros((n, 2, 3)) if interface is None else interface
    trial = SimpleNamespace(time_s=np.arange(n) / 100, interface=seen, usable=np.ones(n, bool))
    recorded = SimpleNamespace(trial=trial, robot=log, context=SimpleNamespace(start=50))
    model = SimpleNamespace(bands=BANDS)
    levels = SimpleNamespace(
        noise_model=model, robot_sd=np.full(6, 1e-3), let_go=np.zeros((6, 6)), log_offset_sd_s=offset_sd_s
    )
    given = np.zeros((0, n, 12)) if rests is None else rests
    setup = SimpleNamespace(settings=validated({}, "config", Path("defaults")))
    return _Logged(recorded, levels, None, setup, given=given, driven=driven).with_noise(np.ones(12), 31, 1)


def _sway(n: int = 1200) -> np.ndarray:
    return 0.03 * np.sin(2 * np.pi * 0.4 * np.arange(n) / 100)[:, None] * np.ones(6)


@pytest.mark.parametrize(
    ("late_s", "scale", "sure_s", "left"),
    [
        (0.006, 0.0, 0.006, 1.0),  # a log on another clock, laid on the markers' motion to 6 ms
        (0.006, 0.0, 0.0, 36.0),  # an edge that both have seen: such a log is late indeed
        (0.0, 0.005, 0.0, 2.0),  # wheels of another size, and further apart
        (0.0, 0.05, 0.0, 200.0),  # no wheel is as much of another size
    ],
)
def test_what_nobody_knows_of_a_log_is_no_gap(late_s, scale, sure_s, left):
    """A log 5 ms late and wheels half a percent too large made a stranger's null `unknown`: 4716, 4184 of 2880."""
    truth = _sway()
    seen = _logged(truth, sure_s)
    rng = np.random.default_rng(5)
    noise = 1e-3 * rng.standard_normal((20, len(truth), 12))
    assert (seen.whiten(noise) ** 2).sum(axis=1).mean() == pytest.approx(seen.samples, rel=0.05)
    error = np.zeros((1, len(truth), 12))
    error[..., 6:] += late_s * np.gradient(truth, 0.01, axis=0)
    error[..., 6:9] += scale * truth[:, :3]
    assert (seen.whiten(error) ** 2).sum() == pytest.approx(left, rel=0.15)


def test_a_constant_that_nobody_knows_costs_what_one_number_does():
    """Noise that comes and goes as a rest pose would is taken for what it is; only the pose itself is let off."""
    rests = np.zeros((1, 1200, 12))
    rests[0, :, 0] = 0.02
    seen, sure = _logged(_sway(), rests=rests), _logged(_sway())
    slow = np.zeros((2, 1200, 12))
    slow[0, :, 0] = 0.02
    slow[1, :, 0] = 0.02 * np.cos(np.pi * np.arange(0.5, 1200) / 1200)
    constant, wave = (seen.whiten(slow) ** 2).sum(axis=1)
    assert constant == pytest.approx(1.0, abs=0.1)
    assert wave == pytest.approx((sure.whiten(slow[1:]) ** 2).sum(), rel=0.05)
    # drawn through an effect, what nobody knows counts as it does here
    left = by_sensor(seen.noise_of([], np.ones(12), [], 31, 1), seen.sensors.values())
    assert left.sum(axis=1).mean() == pytest.approx(seen.samples, rel=0.03)
    assert left.mean(axis=0) == pytest.approx(seen.samples / 2, rel=0.05), "of markers and of the log"
    assert sum(seen.noise_by_sensor) == pytest.approx(seen.samples, rel=0.03)


def test_a_pelvis_beside_its_path_counts_as_few_numbers_however_much_it_moves():
    """A pose that is wrong by one SD at the start lets the robot go: 20 mm that ring down are hundreds of residuals."""
    time_s = np.arange(1200) / 100
    ringing = np.zeros((18, 1200, 12))
    ringing[6, :, 0] = 20.0 * np.exp(-time_s) * np.cos(2 * np.pi * 2 * time_s)
    seen, sure = _logged(_sway(), driven=ringing), _logged(_sway())
    by_one_sd = 1e-3 * ringing[6:7]
    assert (sure.whiten(by_one_sd) ** 2).sum() > 1000
    assert (seen.whiten(by_one_sd) ** 2).sum() < 2
    # the same on another channel is no such error
    assert (seen.whiten(np.roll(by_one_sd, 1, axis=2)) ** 2).sum() > 1000


def test_a_marker_that_is_lost_for_a_while_leaves_no_more_than_noise():
    """Straight lines from one noisy sample to another are slow, and were 2 to 5 standard deviations of a trial."""
    truth, lost = _sway(), np.zeros((1200, 2, 3))
    truth -= truth[:50].mean(axis=0)
    for start in (150, 400, 800):
        lost[start : start + 50, 0] = np.nan
    seen, whole = _logged(truth, interface=lost), _logged(truth)
    assert whole.samples == whole.rows == seen.rows
    assert seen.samples_by_sensor[1] == pytest.approx(whole.samples_by_sensor[1], abs=1)
    # 3 gaps of 0.5 s, three coordinates, 20 numbers a second, and what their edges take
    taken = whole.samples_by_sensor[0] - seen.samples_by_sensor[0]
    assert 90 < taken < 90 + 9 * 5
    noise = 1e-3 * np.random.default_rng(5).standard_normal((200, 1200, 12))
    paths, joints = noise[:, :, :6].reshape(200, 1200, 2, 3), noise[:, :, 6:] + truth
    left = (seen.whitened(paths, joints) ** 2).sum(axis=1)
    assert left.mean() == pytest.approx(seen.samples, rel=0.03)
    assert left.std() == pytest.approx(np.sqrt(2 * seen.samples), rel=0.25)


def test_what_was_missed_of_a_marker_moves_the_pelvis_in_the_gap_alone():
    n, gap = 300, slice(100, 150)
    trial = SimpleNamespace(
        pelvis_rotation=np.tile(np.eye(3), (n, 1, 1)),
        pelvis_position=np.zeros((n, 3)),
        pelvis_markers=np.tile(np.array(list(_BODIES.values())[:4]) - [0, 0, 1.0], (n, 1, 1)),
    )
    seen = StrapEvidence(SimpleNamespace(trial=trial), None, None, None)
    moved = PutBack(1, gap, np.full((3, 3), 1e-3)).missed(n)
    assert moved.shape == (9, n, 4, 3)
    for displaced in moved:
        rotation, position = seen._pelvis_by(displaced)
        still = np.delete(np.arange(n), np.arange(n)[gap])
        np.testing.assert_allclose(rotation[still], trial.pelvis_rotation[still], atol=1e-12)
        np.testing.assert_allclose(position[still], 0, atol=1e-12)
        assert max(np.abs(rotation - np.eye(3)).max(), np.abs(position).max()) > 1e-4
    np.testing.assert_allclose(np.sqrt(np.mean(moved[0, gap, 1, 0] ** 2)), 1e-3, rtol=0.02)


_BODIES = {
    "ASIS_L": (0.1, 0.12, 1.0),
    "ASIS_R": (0.1, -0.12, 1.0),
    "PSIS_L": (-0.08, 0.05, 1.01),
    "PSIS_R": (-0.08, -0.05, 1.01),
    "IF_L": (0.0, 0.15, 0.95),
    "IF_R": (0.0, -0.15, 0.95),
}


def _standing(
    path: Path,
    slow_m: dict[str, float],
    seed: int,
    lost: str = "",
    bodies: dict[str, tuple[float, ...]] = _BODIES,
    white_m: float = 3e-4,
) -> np.ndarray:
    """`noise_colour` of 8 s of quiet standing with white noise, and of some markers with slow noise beside it [m]."""
    rng, n, rate = np.random.default_rng(seed), 800, 100
    sway = 0.01 * np.sin(2 * np.pi * 0.3 * np.arange(n) / rate)[:, None]
    columns, keep = {}, np.exp(-1 / rate / 0.35)
    for name, place in bodies.items():
        marker = np.array(place) + sway + white_m * rng.standard_normal((n, 3))
        # Ornstein-Uhlenbeck, forgets in 0.35 s
        drive = slow_m.get(name, 0.0) * rng.standard_normal((n, 3))
        marker += lfilter([np.sqrt(1 - keep**2)], [1, -keep], drive, axis=0)
        columns |= {f"{name}_{c}": np.nan * n if name == lost else marker[:, i] for i, c in enumerate("xyz")}
    pq.write_table(pa.table({k: np.broadcast_to(v, n) for k, v in columns.items()}), path)
    return noise_colour(path, BANDS)


@pytest.mark.parametrize("seed", range(5))
def test_markers_whose_noise_is_slow_are_told_from_white_ones_by_the_bodies_they_sit_on(tmp_path, seed):
    """By the interface alone, noise of half the white noise was missed: two nulls of nine were unknown."""
    path = tmp_path / "markers.parquet"
    assert np.all(_standing(path, {}, seed) == 1)
    slow = _standing(path, dict.fromkeys(_BODIES, 1.5e-4), seed)
    # 2 x 0.35 s / 0.01 s of the share of the variance
    louder = 1 + 2 * 35 * 0.25
    assert slow.shape == (2, len(BANDS.edges_hz) - 1)
    assert np.all(np.diff(slow) <= 0)
    np.testing.assert_allclose(slow[:, -1], 1)
    np.testing.assert_allclose(slow[0], slow[1])
    assert louder / 3 < slow[0, 0] < louder * 3


def test_noise_that_falls_steeply_is_seen_up_to_where_it_falls(tmp_path):
    """A stranger's, 0.45 mm below 0.35 Hz and 0.3 mm below 2 Hz: one gentle slope missed nine tenths at 2 Hz."""
    rng, n, rate = np.random.default_rng(4), 1200, 100.0
    path, columns = tmp_path / "markers.parquet", {}
    for name, place in _BODIES.items():
        marker = np.array(place) + 1.5e-4 * rng.standard_normal((n, 3))
        for level, corner in ((4.5e-4, 0.35), (3e-4, 2.0)):
            sos = butter(4, corner, fs=rate, output="sos")
            slow = sosfiltfilt(sos, rng.standard_normal((n + 4000, 3)), axis=0)[2000:-2000]
            marker += level * slow / slow.std(axis=0)
        columns |= {f"{name}_{c}": marker[:, i] for i, c in enumerate("xyz")}
    pq.write_table(pa.table(columns), path)
    colour = noise_colour(path, BANDS)[0]
    # power per hertz against that of the white noise
    plateau, floor = 3e-4**2 / 2.0, 1.5e-4**2 / (rate / 2)
    assert 0.3 < colour[3] / (plateau / floor) < 3
    assert colour[0] > 3 * colour[3]
    assert colour[-1] == 1


def test_pelvis_and_interface_have_noise_of_their_own_where_they_show_it(tmp_path):
    """A belly that breathes moves its markers, and not those on the plate."""
    path = tmp_path / "markers.parquet"
    skin = _standing(path, {name: 1e-3 for name in _BODIES if "SIS" in name}, 3)
    assert skin[0, 0] > 50
    np.testing.assert_array_equal(skin[1], 1)


def test_markers_in_one_plane_tell_of_the_noise_as_others_do(tmp_path):
    """Six distances of four markers in a plane hear five of their motions; the sixth is a square of noise."""
    path, slow = tmp_path / "markers.parquet", dict.fromkeys(_BODIES, 1.5e-4)
    flat = {name: (x, y, 1.0) for name, (x, y, _) in _BODIES.items()}
    for seed in range(5):
        assert np.all(_standing(path, {}, seed, bodies=flat) == 1)
        assert _standing(path, slow, seed, bodies=flat)[0, 0] > 5


def test_markers_without_noise_have_none_of_any_colour(tmp_path):
    assert np.all(_standing(tmp_path / "markers.parquet", {}, 1, white_m=0.0) == 1)


def test_a_marker_that_was_never_seen_tells_nothing_of_the_noise(tmp_path):
    colour = _standing(tmp_path / "markers.parquet", dict.fromkeys(_BODIES, 4e-4), 4, lost="PSIS_L")
    assert np.all(colour[:, 0] > 5)
