"""From recorded walks to a gait of the model: strikes, cycles, constrained least squares."""

from __future__ import annotations

import json

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from real2sim.errors import InputError
from real2sim.study.twin import gait
from real2sim.study.twin.gait import (
    PHASES,
    SAGITTAL,
    heel_strikes,
    measured_cycle,
    read_walk,
    settled,
    strides,
    whole_strides,
)
from real2sim.study.twin.human import JOINTS
from real2sim.study.twin.policy import load_reference, save_reference

from tests.unit.walking_person import WHO, measured_curves, reference

STRIDE, SPEED, RATE = 1.2, 1.1, 100.0


def _heel(time_s: np.ndarray, first: float) -> np.ndarray:
    """Place of a heel that strikes at first, first + STRIDE, ... and then stands for 60 % of the stride [m]."""
    phase = np.mod(time_s - first, STRIDE) / STRIDE
    count = np.round((time_s - first) / STRIDE - phase)
    s = np.clip((phase - 0.6) / 0.4, 0, 1)
    return SPEED * STRIDE * (count + s**2 * (3 - 2 * s))


def _tables(
    folder,
    heels: bool = True,
    duration: float = 9.0,
    drop: str = "",
    offset: float = 0.0,
    heading: float = 0.0,
    lost: tuple[float, float] = (0.0, 0.0),
    stands_s: float = 0.0,
):
    """Canonical tables of a walk with the right heel striking at 0.3 s + k strides, the left half a stride later."""
    time_s = np.arange(0, duration, 1 / RATE)
    quiet = round(stands_s * RATE)
    curves = measured_curves()
    phase = np.arange(PHASES + 1) / PHASES

    def at(name: str, shift: float) -> np.ndarray:
        closed = np.append(curves[name], curves[name][0])
        return np.interp(np.mod((time_s - 0.3) / STRIDE + shift, 1), phase, closed)

    columns = {"time_s": time_s}
    for name in gait.PELVIS:
        columns[name] = at(name, 0)
    columns["pelvis_tx"] = columns["pelvis_tx"] + SPEED * time_s
    x, z = columns["pelvis_tx"], columns["pelvis_tz"]
    columns["pelvis_tx"] = np.cos(heading) * x + np.sin(heading) * z
    columns["pelvis_tz"] = np.cos(heading) * z - np.sin(heading) * x
    columns["pelvis_rotation"] = np.angle(np.exp(1j * (columns["pelvis_rotation"] + heading)))
    for name in gait.LEG:
        columns[f"{name}_r"], columns[f"{name}_l"] = at(name, 0.0) + offset, at(name, 0.5)
    columns.pop(drop, None)
    pelvis_x = SPEED * time_s
    ones = np.zeros_like(time_s)
    pose = {"time_s": time_s, "pelvis_x": pelvis_x, "pelvis_y": ones, "pelvis_z": ones + 1}
    markers = {"time_s": time_s}
    if heels:
        for side, first in (("R", 0.3), ("L", 0.9)):
            # a standing heel is 0.25 m ahead of the pelvis when it lands
            markers |= {f"{side}HEE_x": _heel(time_s, first) + SPEED * first + 0.25, f"{side}HEE_y": ones}
        gone = (time_s >= lost[0]) & (time_s < lost[1])
        markers["RHEE_x"] = np.where(gone, np.nan, markers["RHEE_x"])
    folder.mkdir(parents=True)
    meta = {"real2sim": json.dumps({"subject": "S01", "trial": folder.name, "phantom": True})}
    for name, values in (("joints", columns), ("pose", pose), ("markers", markers)):
        table = {k: np.concatenate([np.full(quiet, v[0]), v]) for k, v in values.items()}
        table["time_s"] = np.arange(len(table["time_s"])) / RATE
        pq.write_table(pa.table(table).replace_schema_metadata(meta), folder / f"{name}.parquet")
    return folder


def test_strikes_are_where_the_heel_is_farthest_ahead():
    time_s = np.arange(0, 10, 0.01)
    ahead = 0.3 * np.cos(2 * np.pi * (time_s - 0.437) / 1.1)
    found = heel_strikes(time_s, ahead)
    np.testing.assert_allclose(found, 0.437 + 1.1 * np.arange(9), atol=1e-4)
    gap = ahead.copy()
    gap[100:130] = np.nan
    found = heel_strikes(time_s, gap)
    assert len(found) >= 7
    assert np.abs(np.mod(found - 0.437 + 0.55, 1.1) - 0.55).max() < 1e-3, "no edge of the gap is a strike"


def test_a_strike_waits_until_the_heel_stands():
    time_s = np.arange(0, 9, 0.01)
    heel = _heel(time_s, 0.3)
    peaks = heel_strikes(time_s, heel - SPEED * time_s)
    early = np.mod(peaks - 0.3, STRIDE) - STRIDE
    late = settled(time_s, heel, peaks, SPEED)
    error = np.mod(late - 0.3 + STRIDE / 2, STRIDE) - STRIDE / 2
    assert np.all(early < -0.03)
    assert np.all(np.abs(error) < 0.02)


def test_a_walk_by_heel_markers(tmp_path):
    walk = read_walk(_tables(tmp_path / "walk_normal_1"), WHO)
    assert walk.strikes_from == "heel markers"
    assert walk.phantom
    assert walk.speed == pytest.approx(SPEED, rel=1e-3)
    assert walk.stride_s == pytest.approx(STRIDE, abs=2e-3)
    error = np.mod(walk.strikes["r"] - 0.3 + STRIDE / 2, STRIDE) - STRIDE / 2
    assert np.abs(error).max() < 0.02


@pytest.mark.parametrize("lost", [(3.6, 4.1), (3.8, 4.0), (3.2, 4.6)])
def test_a_strike_that_was_not_seen_makes_no_long_stride(tmp_path, lost):
    """A heel marker is hidden where the right heel strikes (at 3.9 s), and the stride before and after with it."""
    walk = read_walk(_tables(tmp_path / "walk_normal_1", lost=lost), WHO)
    whole = read_walk(_tables(tmp_path / "walk_normal_2"), WHO)
    assert walk.stride_s == pytest.approx(STRIDE, abs=5e-3)
    assert walk.speed == pytest.approx(whole.speed, rel=2e-3)
    lasts = [b - a for a, b in whole_strides(walk.strikes["r"])]
    assert np.abs(np.array(lasts) - STRIDE).max() < 0.03
    assert len(lasts) < len(whole_strides(whole.strikes["r"]))
    told, all_told = (measured_cycle([w])[0] for w in (walk, whole))
    assert np.degrees(np.ptp(told["knee_angle"])) == pytest.approx(
        np.degrees(np.ptp(all_told["knee_angle"])), abs=0.3
    )


def test_a_long_stand_before_a_walk_changes_no_strike(tmp_path):
    at_once = read_walk(_tables(tmp_path / "walk_normal_1"), WHO)
    later = read_walk(_tables(tmp_path / "walk_normal_2", stands_s=15.0), WHO)
    np.testing.assert_allclose(later.strikes["r"] - 15.0, at_once.strikes["r"], atol=0.011)
    assert later.speed == pytest.approx(at_once.speed, rel=5e-3)


def test_a_strike_at_the_very_end_is_none():
    """The heel has not come to rest when the record ends: when it would have is not known."""
    time_s = np.arange(0, 6.29, 0.01)
    heel = _heel(time_s, 0.3)
    peaks = heel_strikes(time_s, heel - SPEED * time_s)
    assert peaks[-1] == pytest.approx(6.265, abs=0.01)
    late = settled(time_s, heel, peaks, SPEED)
    assert len(late) == len(peaks) - 1
    assert np.diff(late) == pytest.approx(STRIDE, abs=0.02)


def test_a_walk_without_heel_markers(tmp_path):
    walk = read_walk(_tables(tmp_path / "walk_normal_1", heels=False), WHO)
    assert walk.strikes_from == "hip and knee angles"
    assert walk.stride_s == pytest.approx(STRIDE, abs=5e-3)
    # the foot is farthest ahead within the last tenth of the swing
    error = np.mod(walk.strikes["r"] - 0.3 + STRIDE / 2, STRIDE) - STRIDE / 2
    assert np.abs(error).max() < 0.12


def test_the_mean_cycle_is_the_one_that_was_walked(tmp_path):
    walks = [read_walk(_tables(tmp_path / f"walk_normal_{i}"), WHO) for i in (1, 2)]
    measured, asymmetry = measured_cycle(walks)
    curves = measured_curves()
    for name in SAGITTAL:
        assert np.degrees(np.abs(measured[name] - curves[name]).max()) < 1.5
        assert asymmetry[name] < 0.5
    lame = read_walk(_tables(tmp_path / "walk_normal_3", offset=np.radians(4)), WHO)
    assert measured_cycle([lame])[1]["knee_angle"] == pytest.approx(4, abs=0.3)


def test_the_direction_of_the_walk_does_not_matter(tmp_path):
    straight, back = (
        measured_cycle([read_walk(_tables(tmp_path / f"walk_normal_{i}", heading=h), WHO)])[0]
        for i, h in ((1, 0.0), (2, np.radians(170)))
    )
    for name in gait.PELVIS:
        np.testing.assert_allclose(back[name], straight[name], atol=2e-3)


def test_strides_with_gaps_are_left_out():
    time_s = np.arange(0, 5, 0.01)
    values = np.sin(2 * np.pi * time_s)
    values[150:160] = np.nan
    assert strides(time_s, values, np.arange(5.0), 51).shape == (3, 51)


def test_errors_name_the_file_and_the_remedy(tmp_path):
    with pytest.raises(InputError, match="ankle_angle_l"):
        read_walk(_tables(tmp_path / "walk_normal_1", drop="ankle_angle_l"), WHO)
    with pytest.raises(InputError, match="at least two strides"):
        read_walk(_tables(tmp_path / "walk_normal_2", duration=2.5), WHO)


def test_knees_that_flex_to_the_negative_side_are_refused(tmp_path):
    folder = _tables(tmp_path / "walk_normal_1")
    joints = pq.read_table(folder / "joints.parquet")
    at = joints.column_names.index("knee_angle_l")
    negative = joints.set_column(at, "knee_angle_l", pa.array(-joints["knee_angle_l"].to_numpy()))
    pq.write_table(negative, folder / "joints.parquet")
    with pytest.raises(InputError, match="column knee_angle_l") as caught:
        read_walk(folder, WHO)
    assert caught.value.code == "knee_sign"
    assert "reverse the sign of knee_angle_l in" in caught.value.remedy


def test_reference_can_be_walked():
    report = reference().report
    assert report["slip_rms_m_per_s"] < 0.05
    assert report["sink_max_m"] < 0.003
    assert report["clearance_min_m"] > 0.008
    assert report["vertical_force_peak_bw"] < 1.35
    assert report["residuals"]["pressure"] < 0.2
    # what had to be changed is reported and is small in shape
    for joint in SAGITTAL:
        change = report["changed"][joint]
        assert change["shape_rms_deg"] < 4
        assert len(change["range_of_motion_deg"]) == 2
    assert abs(report["speed_m_per_s"]["reference"] / SPEED - 1) < 0.12


def test_reference_is_periodic_symmetric_and_consistent():
    r = reference()
    np.testing.assert_allclose(r.curve("knee_angle_r"), np.roll(r.curve("knee_angle_l"), PHASES // 2))
    q0, v0, _ = r.at(np.array([0.25]))
    step = 1e-3
    q1, _, _ = r.at(np.array([0.25 + step]))
    rate = (q1 - q0)[0] / (step * r.stride_s)
    # linear interpolation between the samples: rates agree within the curvature of a sample
    np.testing.assert_allclose(rate[7:], v0[0, 6:], atol=0.8)
    assert v0[0, 0] == pytest.approx(rate[0] + r.speed, abs=0.05)


def test_torques_are_those_of_walking_people():
    # peaks of normal walking: ankle 1.2-1.8, knee below 0.9, hip below 1.5 Nm/kg (Winter, chapter 5)
    r, mass = reference(), WHO.mass_kg
    peak = {j: np.abs(r.torque[:, i]).max() / mass for i, j in enumerate(JOINTS)}
    assert 1.0 < peak["ankle_angle_r"] < 2.3
    assert peak["knee_angle_r"] < 1.2
    assert peak["hip_flexion_r"] < 1.7
    assert peak["elbow_flex_r"] < 0.1


def test_a_reference_goes_through_a_file(tmp_path):
    r = reference()
    save_reference(tmp_path / "a.npz", r)
    save_reference(tmp_path / "b.npz", r)
    assert (tmp_path / "a.npz").read_bytes() == (tmp_path / "b.npz").read_bytes()
    back = load_reference(tmp_path / "a.npz")
    np.testing.assert_array_equal(back.qpos, r.qpos)
    assert back.speed == r.speed
    assert set(back.measured) == set(r.measured)
