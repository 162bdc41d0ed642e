"""Odd columns of a described system's recordings: clipped, coarse, slow, or driven at another scale."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import real2sim as r2s
from real2sim.configuration import validated
from real2sim.recording.channels import channel_findings, drive_scales, units_in_doubt
from real2sim.system.description import shipped

SETTINGS = validated({}, "config", Path("defaults"))["diagnosis"]["described"]["channels"]
SYSTEM = r2s.System.from_yaml(shipped("emps") / "system.yaml")
RATE = 1000.0
TIME = np.arange(4000) / RATE


def _position(seed: int = 1, faster: float = 1.0) -> np.ndarray:
    noise = np.random.default_rng(seed).standard_normal(len(TIME))
    return 0.1 * np.sin(2 * np.pi * faster * TIME) * np.sin(np.pi * TIME / 4) + 1e-6 * noise


def _codes(values: np.ndarray, rate_hz: float = RATE, system: r2s.System = SYSTEM) -> list[str]:
    found = channel_findings(system, "lap", rate_hz, {"position_m": values}, SETTINGS)
    return [f.code for f in found]


def test_a_sound_channel_is_not_odd():
    assert _codes(_position()) == []
    # standing still at zero before and after
    assert _codes(np.clip(TIME - 1, 0, 2)) == []
    # but not on the way
    assert _codes(np.clip(3 * np.sin(3 * TIME), -1, 1)) == ["channel_clipped"]
    assert _codes(np.zeros(100)) == []
    assert _codes(np.full(100, np.nan)) == []


@pytest.mark.parametrize(
    ("change", "code"),
    [
        (lambda x: np.clip(x, -0.06, 0.06), "channel_clipped"),
        (lambda x: np.round(x, 2), "channel_coarse"),
    ],
)
def test_clipped_and_coarse_channels_are_named(change, code):
    assert code in _codes(change(_position()))


def test_a_rate_below_the_band_is_named():
    slow = replace(SYSTEM, band_hz=450.0)
    assert _codes(_position(), system=slow) == ["rate_below_band"]
    assert _codes(_position(), rate_hz=1.0) == ["rate_below_band"]


def _driven(position: np.ndarray, scale: float = 1.0) -> tuple[float, dict[str, np.ndarray]]:
    rate = np.gradient(position) * RATE
    force = 95 * np.gradient(rate) * RATE + 200 * rate + 20 * np.tanh(rate / 1e-3)
    (output,) = SYSTEM.outputs
    (drive,) = SYSTEM.drive.columns.values()
    return RATE, {output.column: position, drive: scale * force}


@pytest.mark.parametrize(("scale", "odd"), [(1.0, False), (1.2, False), (1 / 35, True), (2.0, True)])
def test_a_drive_of_another_scale_is_named_and_friction_is_none(scale, odd):
    smooth = 0.1 * np.sin(2 * np.pi * TIME) * np.sin(np.pi * TIME / 4)
    other = 0.07 * np.sin(2 * np.pi * 1.4 * TIME) * np.sin(np.pi * TIME / 4)
    found = list(drive_scales(SYSTEM, {"first": _driven(smooth), "second": _driven(other, scale)}, 1.5))
    assert [f.code for f in found] == (["drive_scale"] if odd else [])
    if odd:
        assert found[0].file == "second"


def test_an_empty_cell_of_a_drive_is_no_other_scale_and_a_drive_of_zeros_is():
    smooth = 0.1 * np.sin(2 * np.pi * TIME) * np.sin(np.pi * TIME / 4)
    (drive,) = SYSTEM.drive.columns.values()
    rate, broken = _driven(smooth)
    broken[drive][700] = np.nan
    assert not list(drive_scales(SYSTEM, {"first": _driven(smooth), "second": (rate, broken)}, 1.5))
    (found,) = drive_scales(SYSTEM, {"first": _driven(smooth), "second": _driven(smooth, 0.0)}, 1.5)
    assert "asks for inf times" in found.message


@pytest.mark.parametrize(
    ("values", "place"), [((30.2, 21.0), "mass, d_x"), ((95.0, 20.0), None), ((95.0, 203.0), None)]
)
def test_a_drive_in_volts_is_doubted_by_what_all_of_its_parameters_become(values, place):
    plain = dict(zip(("mass", "d_x"), values, strict=True)) | {"offset": 0.1}
    found = list(units_in_doubt(SYSTEM, plain, "lap", SETTINGS["bound_share"]))
    assert [f.place for f in found] == ([place] if place else [])
