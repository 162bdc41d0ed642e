"""Put a pelvis marker back that was taken out of a recording, as a rigid body and where skin carried it.

python benchmarks/lost_marker.py FILE [FILE ...]

Of each TSV, C3D or TRC with four pelvis markers: gaps of 0.44 s all over the longest stretch in which all are seen, and
the median RMS error of each marker in them [mm].
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1] / "workflow"))

from real2sim import signals
from real2sim.configuration import validated
from real2sim.recording import alignment, missing_marker
from real2sim.recording.formats.detect import read_markerless, read_markers

# Left and right at the front, left and right at the back
NAMES = (
    ("ASIS_L", "ASIS_R", "PSIS_L", "PSIS_R"),
    ("LASI", "RASI", "LPSI", "RPSI"),
    ("L_IAS", "R_IAS", "L_IPS", "R_IPS"),
    ("L.ASIS", "R.ASIS", "L.PSIS", "R.PSIS"),
)
GAP_S, CUTOFF_HZ, ORDER = 0.44, 12.0, 4
SKIN = validated({}, "config", Path("defaults"))["ingest"]["skin"]


def recorded(path: Path) -> tuple[np.ndarray, float]:
    """Pelvis markers (n, 4, 3) [m] of the longest stretch in which all are seen, filtered as ingest does, and rate."""
    recording = read_markerless(path) if path.suffix == ".trc" else read_markers(path)
    names = next(names for names in NAMES if set(names) <= recording.positions.keys())
    points = np.stack([recording.positions[name] for name in names], axis=1)
    rate_hz = float(1 / np.median(np.diff(recording.time_s)))
    seen = signals.segments(np.isfinite(points).all(axis=(1, 2)))
    run = max(seen, key=lambda s: s.stop - s.start)
    filtered = signals.lowpass(points[run].reshape(-1, 12), rate_hz, CUTOFF_HZ, ORDER)
    return filtered.reshape(-1, 4, 3), rate_hz


def errors(points: np.ndarray, rate_hz: float, missing: int) -> np.ndarray:
    """RMS errors (g, 2) [m] of a marker in each gap: as a rigid body bridged to the gap's edges, and with skin."""
    n, width, model = len(points), round(GAP_S * rate_hz), missing_marker.places_in_pelvis(points)
    _, rigid = alignment.rebuild_point(points, model, missing)
    out = []
    for start in range(10, n - width - 10, max(width // 2, 1)):
        gap, seen = slice(start, start + width), np.ones((n, 4), bool)
        seen[gap, missing] = False
        lost = np.where(seen[:, :, None], points, np.nan)
        put = missing_marker.put_back(lost, seen, model, missing, [gap], SKIN)[gap]
        as_before = rigid[gap] + missing_marker.bridge(lost[:, missing] - rigid, gap)
        off = (path - points[gap, missing] for path in (as_before, put))
        out.append([float(np.sqrt(np.mean(np.sum(o**2, axis=1)))) for o in off])
    return np.array(out)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("files", nargs="+", type=Path)
    print("file, marker: gaps, rigid body [mm], with skin [mm]")
    for path in parser.parse_args().files:
        points, rate_hz = recorded(path)
        for missing, name in enumerate(NAMES[0]):
            of_gaps = errors(points, rate_hz, missing)
            rigid, skin = 1e3 * np.median(of_gaps, axis=0)
            print(f"{path.name}, {name}: {len(of_gaps)}, {rigid:.1f}, {skin:.1f}", flush=True)


if __name__ == "__main__":
    main()
