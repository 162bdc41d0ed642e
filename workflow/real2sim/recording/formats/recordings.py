"""What every reader returns: small structures in SI units, raw in frame and clock."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np


@dataclass(frozen=True)
class Finding:
    """An anomaly met while reading or processing a file.

    ``severity`` is ``info``, ``warning`` or ``error``; ``place`` says where in the file; ``action`` says
    what was done about it.
    """

    code: str
    severity: str
    file: str
    place: str
    message: str
    action: str


@dataclass(frozen=True)
class Length:
    """Rows of a file: ``declared`` in its header and ``found`` below it."""

    declared: int
    found: int

    @classmethod
    def of(cls, declared: str, found: int) -> Length | None:
        """Return the length of a file by the text of its header; None where that is no count."""
        text = declared.strip()
        return cls(int(text), found) if text.isascii() and text.isdigit() and len(text) < 10 else None


@dataclass(frozen=True)
class Event:
    """A mark that the operator set, on the clock [s] of the original recording."""

    time_s: float
    label: str


@dataclass
class MarkerRecording:
    """Marker trajectories in the lab frame of the export.

    ``time_s`` (n,) is the exporter's own clock [s]; ``positions`` maps a marker name to (n, 3) [m], NaN where
    the marker is missing; ``rate_hz`` is the declared rate; ``first_frame`` the exporter's number of row 0.
    ``residual_m`` maps a marker name to (n,) [m] where the format carries residuals; ``length`` is None where the
    header declares no number of frames.
    """

    time_s: np.ndarray
    rate_hz: float
    positions: dict[str, np.ndarray]
    first_frame: int = 1
    findings: list[Finding] = field(default_factory=list)
    events: list[Event] = field(default_factory=list)
    residual_m: dict[str, np.ndarray] = field(default_factory=dict)
    length: Length | None = None


@dataclass
class BodyRecording:
    """Rigid bodies in the lab frame of the export.

    By body name: ``positions`` (n, 3) [m], ``rotations`` (n, 3, 3) from body to lab, ``residual_m`` (n,);
    NaN where the body is lost. ``angles_rad`` maps a body to the export's own angles by their names.
    """

    time_s: np.ndarray
    rate_hz: float
    positions: dict[str, np.ndarray]
    rotations: dict[str, np.ndarray]
    residual_m: dict[str, np.ndarray]
    angles_rad: dict[str, dict[str, np.ndarray]]
    first_frame: int = 1
    findings: list[Finding] = field(default_factory=list)


@dataclass
class StorageRecording:
    """An OpenSim table in the units it is written in: ``columns`` maps a name to (n, elements).

    Elements are 1, or 3 (Vec3), 4 (Quaternion w x y z), 6 (SpatialVec). ``header`` has lower-case keys.
    """

    time_s: np.ndarray
    columns: dict[str, np.ndarray]
    header: dict[str, str]
    header_lines: list[str]
    findings: list[Finding] = field(default_factory=list)


@dataclass
class CoordinateRecording:
    """OpenSim coordinates on their own clock: ``columns`` maps a name to (n,) [rad or m].

    ``in_degrees`` says that the file has degrees; ``unknown`` are the columns whose name does not tell whether they
    are rotations, which they are taken for, or translations. ``length`` is None where the header declares no number of
    rows.
    """

    time_s: np.ndarray
    columns: dict[str, np.ndarray]
    findings: list[Finding] = field(default_factory=list)
    in_degrees: bool = False
    unknown: list[str] = field(default_factory=list)
    length: Length | None = None


@dataclass(frozen=True)
class StampDelay:
    """Delay of the messages of a topic, from their stamps to the log [s].

    ``median_s`` is log time less stamp, ``beyond_clock_s`` that less the offset of the stamps' clock from log time,
    ``spread_s`` what the delays vary from the 5th to the 95th percentile. ``other_clock`` says that the stamps come
    from a clock of another epoch than log time.
    """

    median_s: float
    beyond_clock_s: float
    spread_s: float
    other_clock: bool


@dataclass
class RobotLog:
    """A robot's log on the robot's clock [s since the log's first message].

    Times are those of the stamps, laid on log time; log time where messages have none (`formats.stamps`).
    ``delays`` maps a topic with stamps to how late it was logged.

    ``base`` has columns ``x y yaw`` [m, m, rad] in the odometry frame and ``vx vy wz`` [m/s, m/s, rad/s] in
    the base frame; ``joints`` maps a joint name to (n, 2) position and velocity [m or rad, per s]; ``wrench``
    is (n, 6) force and torque [N, Nm] or None; ``sync_s`` are the times of rising edges of ``/sync``.
    """

    start_ns: int
    base_time_s: np.ndarray
    base: dict[str, np.ndarray]
    joint_time_s: np.ndarray
    joints: dict[str, np.ndarray]
    wrench_time_s: np.ndarray | None = None
    wrench: np.ndarray | None = None
    sync_s: np.ndarray | None = None
    findings: list[Finding] = field(default_factory=list)
    delays: dict[str, StampDelay] = field(default_factory=dict)
