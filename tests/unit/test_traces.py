"""A fast recording is drawn where its gap is largest, a slow one as a whole."""

from __future__ import annotations

import numpy as np
import pytest
from real2sim.pages.traces import plot_traces

TIME_S = np.arange(4000) / 600.0


@pytest.mark.parametrize(("hz", "swings"), [(70.0, 40), (2.0, 13)])
def test_swings_can_be_told_apart(hz, swings):
    measured = np.sin(2 * np.pi * hz * TIME_S)
    plain = np.where(TIME_S > 5, 0.5, 1.0) * measured
    figure = plot_traces({"time_s": TIME_S, "measured_x_m": measured, "plain_x_m": plain}, "fast")
    time_s = figure.axes[0].lines[0].get_xdata()
    assert (time_s[-1] - time_s[0]) * hz == pytest.approx(swings, rel=0.05)
    cut = len(time_s) < len(TIME_S)
    assert cut == (hz > 10)
    assert ("gap is largest" in figure.axes[0].get_xlabel()) == cut
    if cut:
        assert time_s[0] > 4.9
