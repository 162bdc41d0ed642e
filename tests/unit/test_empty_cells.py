"""Empty cells of a described system's recording are bridged; one that cannot be simulated is refused by its name."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import real2sim as r2s
from real2sim.configuration import validated
from real2sim.diagnosis.described_trial import DescribedTrial
from real2sim.errors import InputError
from real2sim.recording.table import log_columns, marker_columns
from real2sim.system.description import shipped
from real2sim.verification.systems import cuff, one_axis

SETTINGS = validated({}, "config", Path("defaults"))["diagnosis"]["described"]


@pytest.fixture(scope="module")
def emps(tmp_path_factory) -> tuple[r2s.System, pd.DataFrame]:
    """A carriage that a held force drives, and a recording of it that begins in motion."""
    folder = one_axis.simulate_emps(None, 0.0, seed=3, out=tmp_path_factory.mktemp("emps"), duration_s=2.0)
    return r2s.System.from_yaml(shipped("emps") / "system.yaml"), pd.read_parquet(folder / "train.parquet")


def _trial(system: r2s.System, table: pd.DataFrame, quiet: r2s.Recording | None = None) -> DescribedTrial:
    settings = SETTINGS | {"least_quiet_s": 1.0}
    return DescribedTrial(system, r2s.Recording.from_table(system, table, "train"), quiet, settings)


def test_a_force_that_is_held_is_bridged_over_an_empty_cell(emps):
    system, table = emps
    broken = table.copy()
    broken.loc[700, "motor_force_N"] = np.nan
    whole, bridged = (_trial(system, t).setup(1).commands for t in (table, broken))
    moved = np.abs(bridged - whole)
    assert np.isfinite(bridged).all()
    assert moved.max() < 0.2 * np.ptp(whole)
    # nothing but the steps about that millisecond changes
    assert np.count_nonzero(moved > 1e-6 * np.ptp(whole)) <= 3


def test_a_recording_that_begins_in_motion_starts_finite_with_an_empty_cell(emps):
    system, table = emps
    moving = table.iloc[800:].reset_index(drop=True)
    broken = moving.copy()
    broken.loc[5, "carriage_m"] = np.nan
    whole, bridged = (_trial(system, t).setup(1) for t in (moving, broken))
    assert bridged.start["carriage"] == pytest.approx(whole.start["carriage"], abs=1e-5)
    assert bridged.start_rate["carriage"] == pytest.approx(whole.start_rate["carriage"], rel=0.01)


def test_the_path_of_a_short_recording_is_bridged(tmp_path):
    """Its spline goes through every sample: of so few, none can be spared."""
    one_axis.simulate_bouc_wen(None, 0.0, 1, tmp_path, 2.0)
    system = r2s.System.from_yaml(shipped("bouc_wen") / "system.yaml")
    table = pd.read_parquet(tmp_path / "train.parquet").iloc[700:860:8].reset_index(drop=True)
    broken = table.copy()
    broken.loc[15, "carriage_m"] = np.nan
    paths = []
    for each in (table, broken):
        trial = _trial(system, each)
        columns = trial._recording.stack(("carriage_m",))
        paths.append(trial._smooth_path(columns)(trial._recording.time_s))
    between = table["carriage_m"].to_numpy()[[14, 16]].mean()
    assert paths[0][:, 0] == pytest.approx(table["carriage_m"])
    assert np.delete(paths[1], 15) == pytest.approx(np.delete(paths[0], 15))
    assert paths[1][15, 0] == pytest.approx(between)


def test_a_marker_that_is_lost_at_the_start_leaves_the_start_pose_finite(tmp_path):
    cuff.simulate(None, 0.0, 1, tmp_path, duration_s=1.2)
    system = r2s.System.from_yaml(shipped("cuff") / "system.yaml")
    quiet = r2s.Recording.read(system, tmp_path / "quiet.parquet")
    table = pd.read_parquet(tmp_path / "train.parquet")
    broken = table.copy()
    broken.loc[3:6, list(marker_columns(system.markers.interface[0]))] = np.nan
    broken.loc[4, list(log_columns(system).values())[:1]] = np.nan
    whole, bridged = (_trial(system, t, quiet).setup(1) for t in (table, broken))
    assert bridged.start == pytest.approx(whole.start, abs=2e-3)


def test_a_recording_that_cannot_be_simulated_is_refused_and_not_called_determined(emps):
    system, table = emps
    broken = table.copy()
    broken.loc[700:720, "motor_force_N"] = 1e100
    sound, failing = (
        r2s.Recording.from_table(system, t, name) for t, name in ((table, "slow"), (broken, "fast"))
    )
    with pytest.raises(InputError, match=r"(?s)^fast\n.*not_simulated"):
        r2s.identify(system, failing)
    for pair in ({"train": failing, "held_out": sound}, {"train": sound, "held_out": failing}):
        with pytest.raises(InputError, match=r"(?s)^fast\n.*not_simulated"):
            r2s.diagnose(system, **pair, progress=lambda text: None)


@pytest.mark.parametrize("column", ["carriage_m", "motor_force_N"])
def test_a_column_without_any_number_is_refused_by_its_name(emps, column):
    system, table = emps
    with pytest.raises(InputError, match=rf"(?s)^slow, column {column}\n.*no number.*not_a_number"):
        r2s.Recording.from_table(system, table.assign(**{column: np.nan}), "slow")
