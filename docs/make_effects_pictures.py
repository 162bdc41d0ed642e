"""Draw docs/images/effects/<name>.png: what each effect changes in a made-up motion of the strap.

python docs/make_effects_pictures.py [NAME ...]
"""

from __future__ import annotations

import sys
from io import BytesIO
from pathlib import Path

ROOT = Path(__file__).parents[1]
sys.path[:0] = [str(ROOT / "workflow"), str(ROOT)]

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
from PIL import Image
from real2sim.effects.catalogue import EFFECT_NAMES, EFFECTS, Placed
from real2sim.pages.style import BLUE, GREY

from tests.unit.simulated_effects import SCALES, STRAP, replay
from tests.unit.test_coupling import PRIOR

OUT = ROOT / "docs" / "images" / "effects"
SECONDS = 8.0
CHANNELS = [f"{side} marker, {axis} [mm]" for side in ("left", "right") for axis in "xyz"]
CHANNELS += [
    "robot x [mm]",
    "robot y [mm]",
    "robot yaw [deg]",
    "arm z [mm]",
    "arm roll [deg]",
    "arm pitch [deg]",
]
TO_SHOWN = np.array([1e3] * 6 + [1e3, 1e3, 180 / np.pi, 1e3, 180 / np.pi, 180 / np.pi])
# A gap smaller than this share of the channel's motion hardly shows: the effect's start is enlarged until it does
SHOWS = 0.15


def motion() -> np.ndarray:
    """Pelvis (n, 6) [m, rad]: half a second of standing, then every axis at a slow and a faster rate, then a hold."""
    t = np.arange(round(SECONDS * 100)) / 100
    moving = np.clip((t - 0.5) / 0.5, 0, 1) * np.clip((7.0 - t) / 0.5, 0, 1)
    hz = np.array([0.45, 0.4, 0.35, 0.4, 0.5, 0.3])
    size = np.array([0.06, 0.05, 0.02, 0.09, 0.08, 0.25])
    waves = np.sin(2 * np.pi * hz * t[:, None]) + 0.35 * np.sin(2 * np.pi * 3.1 * hz * t[:, None] + 1.0)
    # it does not come back to where it was: what creeps and slips shows in the hold
    return np.asarray(size * (moving[:, None] * waves + 0.8 * np.clip((t - 6.0) / 0.4, 0, 1)[:, None]))


def simulate(effects: list[Placed], x: list[np.ndarray]) -> np.ndarray:
    """Channels (n, 12) as they are shown."""
    paths, joints = replay(effects, motion=motion(), seconds=SECONDS).run_effects(PRIOR[None], x)
    out = np.concatenate([paths[0].reshape(len(paths[0]), 6), joints[0]], axis=1)
    return np.asarray((out - out[0]) * TO_SHOWN)


def with_effect(name: str, plain: np.ndarray) -> np.ndarray:
    """Channels with an effect, at the first size that shows."""
    effect = next(e for e in EFFECTS if e.name == name)
    if name == "outliers":
        out, rng = plain.copy(), np.random.default_rng(2)
        out[rng.choice(len(out), 12, replace=False), 0] += rng.choice([-1, 1], 12) * 60.0
        return out
    found = plain
    for where in effect.places(STRAP)[:3]:
        placed = Placed(effect, where, SCALES)
        lower, upper = placed.bounds()
        for size in (1.0, 2.0, 4.0, 8.0, 16.0, 32.0):
            start = placed.starts()[-1]
            grows = np.full(len(start), name in WHOLE) | (np.arange(len(start)) == 0)
            start = np.where(grows & (start == 0), 0.02 * (upper - lower), start)
            x = np.clip(np.where(grows, size * start, start), lower, upper)
            x = lower if name == "filter_lag" else x
            moved = simulate([placed], [x[None]])
            if np.isfinite(moved).all():
                found = moved
                if share(moved, plain).max() > SHOWS:
                    return found
    return found


# Effects whose numbers are alike, so that all of them grow together
WHOLE = (
    "soft_tissue",
    "marker_offset",
    "marker_drift",
    "misalignment",
    "tilt",
    "base_compliance",
    "added_mass",
)


def share(moved: np.ndarray, plain: np.ndarray) -> np.ndarray:
    """Change of each channel (12,) as a share of its motion."""
    return np.asarray(np.ptp(moved - plain, axis=0) / np.maximum(np.ptp(plain, axis=0), 5.0))


def draw(name: str, plain: np.ndarray) -> None:
    """Write the picture of an effect."""
    moved = with_effect(name, plain)
    channel = int(np.argmax(share(moved, plain)))
    time = np.arange(len(plain)) / 100
    figure, (axes, below) = plt.subplots(
        2, 1, figsize=(5.2, 2.5), layout="constrained", sharex=True, height_ratios=[3, 2]
    )
    axes.plot(time, plain[:, channel], color=GREY, lw=2.4, label="without")
    axes.plot(time, moved[:, channel], color=BLUE, lw=1.2, label=f"with {name}")
    unit = CHANNELS[channel].split()[-1]
    axes.set_ylabel(CHANNELS[channel].replace(", ", ",\n").replace(" [", "\n["), fontsize=8)
    axes.legend(frameon=False, fontsize=8, ncols=2, loc="lower left", bbox_to_anchor=(0, 1))
    below.plot(time, moved[:, channel] - plain[:, channel], color=BLUE, lw=1.2)
    below.axhline(0, color=GREY, lw=0.8)
    below.set_xlabel("time [s]", fontsize=8)
    below.set_ylabel(f"difference\n{unit}", fontsize=8)
    for one in (axes, below):
        one.spines[["top", "right"]].set_visible(False)
        one.tick_params(labelsize=8)
    OUT.mkdir(parents=True, exist_ok=True)
    drawn = BytesIO()
    figure.savefig(drawn, dpi=110)
    plt.close(figure)
    Image.open(drawn).convert("RGB").quantize(32).save(OUT / f"{name}.png", optimize=True)
    print(f"{name}: {CHANNELS[channel]}, {share(moved, plain)[channel]:.2f} of the motion")


if __name__ == "__main__":
    without = simulate([], [])
    for wanted in sys.argv[1:] or EFFECT_NAMES:
        draw(wanted, without)
