"""The one-axis systems: descriptions, closed forms of the generators, MuJoCo on the same input."""

from __future__ import annotations

import json
from pathlib import Path

import mujoco
import numpy as np
import pyarrow.parquet as pq
import pytest
from real2sim.errors import InputError
from real2sim.system.description import System, shipped
from real2sim.verification.systems import one_axis
from real2sim.verification.systems.emps_data import read_emps
from real2sim.verification.systems.recordings import TRIALS, OutputChain

MEASURED = Path("/work/shared/measured/emps")


def table_of(case: Path, trial: str) -> dict[str, np.ndarray]:
    table = pq.read_table(case / f"{trial}.parquet")
    return {name: table[name].to_numpy() for name in table.column_names}


@pytest.mark.parametrize("name", ["emps", "bouc_wen"])
def test_recordings_have_the_columns_of_the_description(name, tmp_path):
    system = System.from_yaml(shipped(name) / "system.yaml")
    simulate, effects = one_axis.SYSTEMS[name]
    case = simulate("sync_offset", effects["sync_offset"].typical, 3, tmp_path / name, duration_s=2.0)
    wanted = {"time_s", *system.drive.columns.values(), *(o.column for o in system.outputs)}
    for trial in TRIALS:
        table = table_of(case, trial)
        assert set(table) == wanted
        assert all(np.isfinite(column).all() for column in table.values())
        still = table["time_s"] < 0.5
        assert np.ptp(table["carriage_m"][still]) < 2e-4
    truth = json.loads((case / "sealed/truth.json").read_text())
    assert (truth["effect"], truth["parameters"]) == (
        "sync_offset",
        {"offset": effects["sync_offset"].typical},
    )


def test_same_seed_gives_the_same_case_and_unknown_effects_are_refused(tmp_path):
    first, second = (
        table_of(one_axis.simulate_bouc_wen(None, 0.0, 5, tmp_path / n, 1.5), "train") for n in "ab"
    )
    assert all(np.array_equal(first[name], second[name]) for name in first)
    with pytest.raises(ValueError, match="this system has"):
        one_axis.simulate_emps("slack", 1.0, 0, tmp_path)


def test_mujoco_moves_the_emps_as_the_generator_does(tmp_path):
    """The null recordings' force on the described model gives their position to 0.1 mm."""
    table = table_of(one_axis.simulate_emps(None, 0.0, 1, tmp_path, duration_s=5.0), "train")
    spec = mujoco.MjSpec.from_file(str(shipped("emps") / "emps.xml"))
    spec.option.timestep = 1e-4
    spec.joint("carriage").damping = [one_axis.EMPS["viscous"], 0, 0]
    model = spec.compile()
    data = mujoco.MjData(model)
    positions = []
    for force in table["motor_force_N"]:
        positions.append(data.qpos[0])
        data.qfrc_applied[0] = force + one_axis.EMPS["offset"]
        mujoco.mj_step(model, data, 10)
    assert np.abs(np.array(positions) - table["carriage_m"]).max() < 1e-4


def test_dry_friction_holds_the_carriage_exactly_below_its_force(monkeypatch):
    monkeypatch.setattr(one_axis, "EMPS_KP", 0.0)
    monkeypatch.setattr(one_axis, "EMPS_KV", 0.0)
    positions, _ = one_axis.run_emps(np.zeros(500), coulomb=3.2, quadratic=0.0)
    assert not positions.any()
    positions, _ = one_axis.run_emps(np.zeros(4000), coulomb=1.0, quadratic=0.0)
    # against dry and viscous friction the offset of the drive ends at a steady speed
    speed = (one_axis.EMPS["offset"] - 1.0) / one_axis.EMPS["viscous"]
    assert (positions[-1] - positions[-2]) * 1e3 == pytest.approx(speed, rel=1e-3)


def test_bouc_wen_force_obeys_its_differential_equation():
    """Against a fine Runge-Kutta integration of z' = a q' - b (g |q'| z + d q' |z|)."""
    b, g, d, a = one_axis.HYSTERESIS_B, one_axis.HYSTERESIS_G, one_axis.HYSTERESIS_D, 5e4
    t = np.arange(0, 0.25, 2e-5)
    q = 1e-3 * np.sin(2 * np.pi * 10 * t)
    rate = 1e-3 * 2 * np.pi * 10 * np.cos(2 * np.pi * 10 * np.arange(0, 0.25, 1e-5))
    expected, z, h = [0.0], 0.0, 2e-5
    for i in range(len(t) - 1):
        v0, v1, v2 = rate[2 * i], rate[2 * i + 1], rate[min(2 * i + 2, len(rate) - 1)]
        slope = lambda z, v: a * v - b * (g * abs(v) * z + d * v * abs(z))  # noqa: E731
        k1 = slope(z, v0)
        k2 = slope(z + h / 2 * k1, v1)
        k3 = slope(z + h / 2 * k2, v1)
        z += h / 6 * (k1 + 2 * k2 + 2 * k3 + slope(z + h * k3, v2))
        expected.append(z)
    found = one_axis.hysteretic_force(q, a)
    assert np.abs(found - expected).max() < 2e-3 * np.abs(expected).max()


def test_bouc_wen_laws_have_their_closed_forms():
    path = one_axis.impose_multisine(2.0, 6e-4, 1.0, 40.0, 0)
    q, v = path.position, path.rate
    assert np.abs(np.gradient(q, path.time_s) - v)[5:-5].max() < 1e-3 * np.abs(v).max()
    assert (
        np.abs(np.gradient(v, path.time_s) - path.acceleration)[5:-5].max()
        < 1e-3 * np.abs(path.acceleration).max()
    )
    linear = one_axis.bouc_wen_force(path, None, 0.0)
    k = one_axis.BOUC_WEN["stiffness"]

    def extra(effect: str, size: float) -> np.ndarray:
        return one_axis.bouc_wen_force(path, effect, size) - linear

    inside = np.abs(q) < 2e-4
    assert np.allclose(extra("slack", 2e-4)[inside], -k * q[inside])
    assert np.allclose(np.abs(extra("coulomb", 3.0)[v != 0]), 3.0)
    assert np.allclose(extra("stiffening", 2e9), 2e9 * q**3)
    assert np.allclose(extra("preload", 1e-4), -k * 1e-4)
    # a branch that relaxes slowly is a spring, one that relaxes at once a damper
    path_force = one_axis.relaxing_force(path, 1e4, 1e5)
    assert np.allclose(path_force, 1e4 * q, atol=1e-3)
    fast = one_axis.relaxing_force(path, 1e6, 1e-5)
    assert np.corrcoef(fast[1:], v[1:])[0, 1] > 0.999


def test_output_chain_is_late_drifts_and_filters_as_it_says():
    t = np.arange(0, 4, 1e-3)
    y = np.sin(2 * np.pi * 1.0 * t)
    assert np.array_equal(OutputChain().apply(t, y, t), y)
    late = OutputChain(offset=0.0105).apply(t, y, t)
    assert np.allclose(late[20:], np.sin(2 * np.pi * (t[20:] - 0.0105)), atol=1e-6)
    drifted = OutputChain(drift=1e-2).apply(t, y, t[:3900])
    assert np.allclose(drifted, np.sin(2 * np.pi * 1.01 * t[:3900]), atol=1e-6)
    filtered = OutputChain(cutoff=5.0).apply(t, y, t)[2000:]
    h = 1 / (1 + 1j / 5.0)
    assert np.allclose(filtered, np.abs(h) * np.sin(2 * np.pi * t[2000:] + np.angle(h)), atol=5e-3)


def test_reader_of_the_published_emps_records(tmp_path):
    (tmp_path / "no.mat").write_bytes(b"nothing")
    with pytest.raises(InputError):
        read_emps(tmp_path / "no.mat")
    if not MEASURED.is_dir():
        pytest.skip(f"no {MEASURED}: the published EMPS records are not on this machine")
    for name in ("DATA_EMPS.mat", "DATA_EMPS_PULSES.mat"):
        table = read_emps(MEASURED / name)
        assert {len(column) for column in table.values()} == {24841}
        assert table["time_s"][-1] == pytest.approx(24.84)
        assert 0.24 < np.ptp(table["carriage_m"]) < 0.25
        assert 120 < np.abs(table["motor_force_N"]).max() < 352
