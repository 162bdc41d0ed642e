"""From a person's walk to a gait that their model can walk: strikes, mean cycle, constrained least squares.

A measured mean cycle is not a motion of the model: markers slide on skin, zeros of joint angles depend on the marker
model, segments have other lengths. Played back, the feet slip and sink. The reference is the nearest gait (weighted
least squares over Fourier terms of all coordinates and over the speed) whose feet stand still in stance and clear
the floor in swing, and whose root needs no force that the floor cannot give: the centre of pressure, from inverse
dynamics of the model, stays under the feet. What had to be changed is part of the result.

The reference is symmetric: the left leg does what the right one did half a stride ago. The asymmetry that is averaged
away is reported.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any

import mujoco
import numpy as np
import scipy
from scipy.optimize import least_squares

from real2sim.errors import InputError
from real2sim.recording.formats.opensim import flexes_negative
from real2sim.study.twin.human import FEET, JOINTS, Body, human_spec, pelvis_rotation

if TYPE_CHECKING:
    from real2sim.settings import (
        TwinHumanSettings,
        TwinReferenceSettings,
        TwinReferenceSpeedsSettings,
        TwinReferenceWeightsSettings,
    )

PHASES = 48  # samples of a reference cycle
LEG = ("hip_flexion", "hip_adduction", "hip_rotation", "knee_angle", "ankle_angle")
PELVIS = ("pelvis_tilt", "pelvis_list", "pelvis_rotation", "pelvis_tx", "pelvis_ty", "pelvis_tz")
SAGITTAL = ("hip_flexion", "knee_angle", "ankle_angle")
# Speeds of a reference that are nearer than this are the same [share of the own speed]
_LEAST_APART = 0.01
_STEADY = 0.92  # share of the fastest stride's speed from which a stride counts as steady
_LANDS_S = 0.15  # how long after being farthest ahead a heel has come to rest [s]
_LONGEST = 1.5  # of the median stride: what lasts longer holds a strike that was not seen


# -------------------- strikes and mean cycles


def heel_strikes(time_s: np.ndarray, heel_ahead: np.ndarray, stride_hint_s: float = 1.1) -> np.ndarray:
    """Times of heel strike: where the heel is farthest ahead of the pelvis (Zeni et al., Gait Posture 27 (2008) 710).

    ``heel_ahead`` (n,) is the heel's distance ahead of the pelvis [m] along the path; NaN where unknown. The edge of
    what is unknown is no strike. Peaks are interpolated by a parabola.
    """
    rate = 1 / float(time_s[1] - time_s[0])
    filled = np.where(np.isfinite(heel_ahead), heel_ahead, -np.inf)
    finite = filled[np.isfinite(filled)]
    if not len(finite):
        return np.empty(0)
    span = float(np.ptp(finite))
    peaks, _ = scipy.signal.find_peaks(
        filled, distance=max(1, int(0.6 * stride_hint_s * rate)), height=float(finite.min()) + 0.7 * span
    )
    out = []
    for i in peaks:
        left, middle, right = filled[i - 1 : i + 2]
        if not np.isfinite([left, right]).all():
            continue
        bend = left - 2 * middle + right
        shift = 0.5 * (left - right) / bend if bend < 0 else 0.0
        out.append(time_s[i] + shift / rate)
    return np.array(out)


def settled(time_s: np.ndarray, heel_along: np.ndarray, peaks: np.ndarray, speed: float) -> np.ndarray:
    """Strikes (k,) [s] put off to where the heel has come to rest: below a tenth of ``speed``, at most 0.15 s later.

    The heel is farthest ahead shortly before it lands, the sooner the softer it lands. ``heel_along`` (n,) is the
    heel's place along the path [m]. A strike is left out where the record ends before its heel rests.
    """
    velocity = np.gradient(heel_along, time_s)
    out = []
    for peak in peaks:
        window = np.flatnonzero((time_s >= peak) & (time_s <= peak + _LANDS_S))
        slow = window[velocity[window] < 0.1 * speed]
        if len(slow) or peak + _LANDS_S <= time_s[-1]:
            out.append(time_s[slow[0]] if len(slow) else peak)
    return np.array(out)


def whole_strides(strikes: np.ndarray) -> list[tuple[float, float]]:
    """Return start and end [s] of the strides between strikes (s,) [s], none where a strike was not seen.

    That is where a stride would last more than one and a half times as long as the median one.
    """
    lasts = np.diff(strikes)
    usual = _LONGEST * np.median(lasts) if len(lasts) else 0.0
    return [(float(a), float(b)) for a, b in pairwise(strikes) if b - a <= usual]


def walking_speed(time_s: np.ndarray, along: np.ndarray) -> float:
    """Return the usual speed [m/s] of a walk along its path (n,) [m], however long it stands before and after."""
    speed = np.gradient(along, time_s)
    return float(np.nanmedian(speed[speed >= 0.5 * np.nanpercentile(speed, 90)]))


def foot_ahead(joints: Mapping[str, np.ndarray], side: str, thigh: float, shank: float) -> np.ndarray:
    """Ankle's distance ahead of the hip (n,) [m] from sagittal angles: strikes without heel markers."""
    thigh_angle = joints[f"hip_flexion_{side}"] + joints["pelvis_tilt"]
    shank_angle = thigh_angle - joints[f"knee_angle_{side}"]
    return np.asarray(thigh * np.sin(thigh_angle) + shank * np.sin(shank_angle))


@dataclass
class Walk:
    """One walking trial: synchronised coordinates [rad, m], heel strikes of both feet [s], and speed [m/s]."""

    time_s: np.ndarray
    joints: dict[str, np.ndarray]
    strikes: dict[str, np.ndarray]
    speed: float
    strikes_from: str
    phantom: bool

    @property
    def stride_s(self) -> float:
        """Mean stride time [s]."""
        return float(np.mean([b - a for s in self.strikes.values() for a, b in whole_strides(s)]))


def read_walk(folder: Path, body: Body) -> Walk:
    """Read a walking trial's canonical tables and find its strides.

    Strikes come from heel markers where they are, else from the sagittal angles. Strides slower than 92 % of the
    fastest (starting, stopping) are left out.

    Raises
    ------
    InputError
        Where the trial has no coordinates of legs and pelvis, knees that flex to the negative side, or fewer than two
        whole strides.
    """
    import json

    import pyarrow.parquet as pq

    path = Path(folder) / "joints.parquet"
    table = pq.read_table(path)
    phantom = bool(json.loads(table.schema.metadata[b"real2sim"]).get("phantom", False))
    joints = {name: table[name].to_numpy() for name in table.column_names}
    needed = [*PELVIS, *(f"{name}_{side}" for name in SAGITTAL for side in FEET)]
    missing = [name for name in needed if name not in joints or not np.isfinite(joints[name]).any()]
    if missing:
        raise InputError(
            path,
            f"column {', '.join(missing[:4])}",
            "absent, or without a number",
            "joint angles of a full-body model (Rajagopal names)",
            "Export coordinates (.mot or .sto) for the walking trials; landmarks alone do not train a twin.",
        )
    _check_knees(path, joints)
    time_s = joints.pop("time_s")
    _head_forward(joints)
    pose = pq.read_table(Path(folder) / "pose.parquet")
    pelvis = np.column_stack([pose[f"pelvis_{c}"].to_numpy() for c in "xy"])
    direction, along = _path(pelvis)
    markers = pq.read_table(Path(folder) / "markers.parquet")
    strikes, source = {}, "heel markers"
    for side in FEET:
        name = f"{side.upper()}HEE"
        if f"{name}_x" in markers.column_names:
            heel = np.column_stack([markers[f"{name}_{c}"].to_numpy() for c in "xy"])
            peaks = heel_strikes(time_s, (heel - pelvis) @ direction)
            strikes[side] = settled(time_s, heel @ direction, peaks, walking_speed(time_s, along))
        else:
            source = "hip and knee angles"
            ahead = foot_ahead(joints, side, body.length("thigh"), body.length("shank"))
            strikes[side] = heel_strikes(time_s, ahead)
    strikes, speed = _steady(time_s, along, strikes)
    if any(len(whole_strides(s)) < 2 for s in strikes.values()):
        found = ", ".join(f"{side}: {len(whole_strides(s))}" for side, s in strikes.items())
        raise InputError(
            path,
            "",
            f"whole steady strides {found}",
            "at least two strides of either foot at a steady speed",
            "Record a longer walk, or exclude the trial in subject.yaml.",
        )
    return Walk(time_s, joints, strikes, speed, source, phantom)


def _check_knees(path: Path, joints: Mapping[str, np.ndarray]) -> None:
    """Refuse knees whose flexion is negative: the model's knees flex to the positive side and stop at straight legs."""
    wrong = [name for name in (f"knee_angle_{side}" for side in FEET) if flexes_negative(joints[name])]
    if wrong:
        least = float(np.degrees(min(np.nanmin(joints[name]) for name in wrong)))
        found = f"flexion down to {least:.0f} deg: negative, as in gait2392, gait2354 and gait10dof"
        remedy = (
            f"Export {path.parent.name} again with the Rajagopal model, or reverse the sign of {' and '.join(wrong)} "
            "in its .mot or .sto."
        )
        expected = "knee flexion positive, as the Rajagopal model has it"
        raise InputError(path, f"column {', '.join(wrong)}", found, expected, remedy, "knee_sign")


def _head_forward(joints: dict[str, np.ndarray]) -> None:
    """Turn the pelvis coordinates, in place, so that the walk leads along the X of OpenSim."""
    x, y = joints["pelvis_tx"], -joints["pelvis_tz"]
    direction, along = _path(np.column_stack([x, y]))
    lateral = y * direction[0] - x * direction[1]
    joints["pelvis_tx"], joints["pelvis_tz"] = along, -lateral
    heading = np.arctan2(direction[1], direction[0])
    turned = joints["pelvis_rotation"] - heading
    joints["pelvis_rotation"] = np.arctan2(np.sin(turned), np.cos(turned))


def _path(pelvis: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Unit direction (2,) of a straight walk and distance along it (n,)."""
    good = np.isfinite(pelvis).all(axis=1)
    first, last = pelvis[good][0], pelvis[good][-1]
    direction = (last - first) / max(float(np.linalg.norm(last - first)), 1e-9)
    return direction, (pelvis - first) @ direction


def _steady(
    time_s: np.ndarray, along: np.ndarray, strikes: dict[str, np.ndarray]
) -> tuple[dict[str, np.ndarray], float]:
    """Strikes within the steady stretch of the walk, and the mean speed over whole strides [m/s]."""
    good = np.isfinite(along)

    def speed(stride: tuple[float, float]) -> float:
        start, end = np.interp(stride, time_s[good], along[good])
        return float((end - start) / (stride[1] - stride[0]))

    found = {side: [(speed(of), *of) for of in whole_strides(s)] for side, s in strikes.items()}
    least = _STEADY * max((v for of in found.values() for v, *_ in of), default=np.nan)
    steady = {side: [stride for stride in of if stride[0] > least] for side, of in found.items()}
    kept = [v for of in steady.values() for v, *_ in of]
    if not kept:
        return strikes, np.nan
    within = {
        side: (s >= of[0][1]) & (s <= of[-1][2]) if (of := steady[side]) else np.zeros(len(s), bool)
        for side, s in strikes.items()
    }
    return {side: s[within[side]] for side, s in strikes.items()}, float(np.mean(kept))


def strides(time_s: np.ndarray, values: np.ndarray, strikes: np.ndarray, phases: int = 101) -> np.ndarray:
    """Return each stride of a signal (n,) resampled to 0-100 %, (k, phases); strides with a gap are left out.

    ``time_s`` (n,) and ``strikes`` (s,) [s], of which `whole_strides` are taken.
    """
    out = []
    for start, end in whole_strides(strikes):
        at = np.linspace(start, end, phases)
        row = np.interp(at, time_s, values)
        if np.isfinite(row).all():
            out.append(row)
    return np.array(out).reshape(-1, phases)


def pooled_strides(walks: list[Walk], name: str, side: str, strike_side: str | None = None) -> np.ndarray:
    """All strides (n, 101) of one coordinate over the trials; ``side`` is appended unless the name has none."""
    column = f"{name}_{side}" if f"{name}_{side}" in walks[0].joints else name
    return np.concatenate(
        [strides(w.time_s, w.joints[column], w.strikes[strike_side or side]) for w in walks]
    )


# -------------------- the reference


@dataclass(frozen=True)
class Speeds:
    """The same person's gait at k other speeds, in rising order.

    ``shares`` (k,) of the own speed, which is among them; ``table`` (k, PHASES, 76): positions, velocities and torques
    as in `Reference`; ``stride_s`` (k,).
    """

    shares: np.ndarray
    table: np.ndarray
    stride_s: np.ndarray


@dataclass
class Reference:
    """A periodic gait of the model, at `PHASES` phases from right heel strike.

    ``qpos`` (PHASES, 28) without the progress v t, ``qvel`` (PHASES, 27) with it; ``torque`` (PHASES, 21) [Nm] are the
    joint torques that the motion needs; ``stride_s``, ``speed`` [m/s]. ``speeds`` holds the gait at other speeds,
    where it was made.
    ``measured`` are the mean curves that it was fitted to, by coordinate (PHASES,) [rad, m].
    """

    qpos: np.ndarray
    qvel: np.ndarray
    torque: np.ndarray
    stride_s: float
    speed: float
    measured: dict[str, np.ndarray] = field(default_factory=dict)
    report: dict[str, Any] = field(default_factory=dict)
    speeds: Speeds | None = None

    def __post_init__(self) -> None:
        self._table = np.hstack([self.qpos, self.qvel, self.torque])

    def at(
        self, phase: np.ndarray, share: np.ndarray | float = 1.0
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Positions (m, 28), velocities (m, 27), torques (m, 21) at phases (m,), linearly between samples.

        ``share`` of the own speed, 1 or (m,): linearly between the speeds that are known, and no further.
        """
        x = np.mod(phase, 1.0) * PHASES
        i = x.astype(int) % PHASES
        w = (x - np.floor(x))[:, None]
        if self.speeds is None or np.ndim(share) == 0:
            row = (1 - w) * self._table[i] + w * self._table[(i + 1) % PHASES]
        else:
            table, low, part = self._between(np.asarray(share))
            row = np.zeros((len(x), table.shape[2]))
            for j, weight in ((low, 1 - part), (low + 1, part)):
                row += weight[:, None] * ((1 - w) * table[j, i] + w * table[j, (i + 1) % PHASES])
        qpos = row[:, :28]
        qpos[:, 3:7] /= np.linalg.norm(qpos[:, 3:7], axis=1, keepdims=True)
        return qpos, row[:, 28:55], row[:, 55:]

    def _between(self, share: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the table of all speeds, the index (m,) of the one below ``share`` and how far it is to the next."""
        assert self.speeds is not None
        known = self.speeds.shares
        place = np.interp(share, known, np.arange(len(known)))
        low = np.minimum(place.astype(int), len(known) - 2)
        return self.speeds.table, low, place - low

    def stride_at(self, share: np.ndarray | float) -> np.ndarray | float:
        """Return stride times (m,) [s] at shares (m,) of the own speed; one time for one share or one known speed."""
        if self.speeds is None or np.ndim(share) == 0:
            return self.stride_s
        return np.asarray(np.interp(share, self.speeds.shares, self.speeds.stride_s))

    def speed_at(self, share: np.ndarray | float) -> np.ndarray | float:
        """Return speeds (m,) [m/s] at shares (m,) of the own, within the known; the own for one share or one known."""
        if self.speeds is None or np.ndim(share) == 0:
            return self.speed
        return self.speed * np.clip(share, self.speeds.shares[0], self.speeds.shares[-1])

    def height_at(self, share: np.ndarray | float) -> np.ndarray | float:
        """Return mean heights (m,) of the pelvis [m] at shares (m,) of the own speed; as of `stride_at`."""
        if self.speeds is None or np.ndim(share) == 0:
            return float(self.qpos[:, 2].mean())
        return np.asarray(np.interp(share, self.speeds.shares, self.speeds.table[:, :, 2].mean(axis=1)))

    def curve(self, joint: str) -> np.ndarray:
        """One joint over the cycle (PHASES,) [rad]."""
        return self.qpos[:, 7 + JOINTS.index(joint)]


# Harmonics of each coordinate; the pelvis' vertical, forward and tilt motion repeats every step (even ones), its
# lateral motion, list and rotation change sign (odd ones)
_HARMONICS: dict[str, tuple[int, ...]] = {
    "hip_flexion": (1, 2, 3, 4, 5, 6),
    "knee_angle": (1, 2, 3, 4, 5, 6),
    "ankle_angle": (1, 2, 3, 4, 5, 6),
    "hip_adduction": (1, 2, 3),
    "hip_rotation": (1, 2, 3),
    "pelvis_tilt": (2, 4),
    "pelvis_list": (1, 3, 5),
    "pelvis_rotation": (1, 3, 5),
    "pelvis_tx": (2, 4),
    "pelvis_ty": (2, 4),
    "pelvis_tz": (1, 3, 5),
}
_WITH_MEAN = (*LEG, "pelvis_tilt", "pelvis_ty")


class _Coefficients:
    """Layout of the Fourier terms in one vector; the last number is the speed [m/s]."""

    def __init__(self) -> None:
        self.phase = np.arange(PHASES) / PHASES
        self.slices, self.bases, start = {}, {}, 0
        for name, harmonics in _HARMONICS.items():
            columns = [np.ones(PHASES)] if name in _WITH_MEAN else []
            for k in harmonics:
                columns += [np.cos(2 * np.pi * k * self.phase), np.sin(2 * np.pi * k * self.phase)]
            self.bases[name] = np.column_stack(columns)
            self.slices[name] = slice(start, start + len(columns))
            start += len(columns)
        self.size = start + 1

    def of(self, curves: Mapping[str, np.ndarray], speed: float) -> np.ndarray:
        """Least-squares terms of curves (PHASES,)."""
        x = np.zeros(self.size)
        for name, basis in self.bases.items():
            x[self.slices[name]] = np.linalg.lstsq(basis, curves[name], rcond=None)[0]
        x[-1] = speed
        return x

    def curves(self, x: np.ndarray) -> dict[str, np.ndarray]:
        """Curves (PHASES,) of a vector of terms."""
        return {name: basis @ x[self.slices[name]] for name, basis in self.bases.items()}


def _spectral(values: np.ndarray, period: float) -> np.ndarray:
    """Time derivative of periodic samples (PHASES, ...)."""
    k = np.fft.rfftfreq(PHASES, 1 / PHASES) * 2j * np.pi / period
    k[-1] = 0
    shape = (-1,) + (1,) * (values.ndim - 1)
    return np.fft.irfft(np.fft.rfft(values, axis=0) * k.reshape(shape), PHASES, axis=0)


class _Motion:
    """Full motion of the model from leg and pelvis curves: positions, velocities, accelerations, floor wrench."""

    def __init__(
        self, body: Body, human: TwinHumanSettings, upper: Mapping[str, np.ndarray], stride_s: float
    ):
        spec = human_spec(body, human)
        spec.option.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONTACT
        self.model = spec.compile()
        self.data = mujoco.MjData(self.model)
        self.body, self.period = body, stride_s
        self._upper = upper
        self.sites = [self.model.site(f"{name}_r").id for name in ("heel", "ball", "toe")]

    def states(
        self, curves: Mapping[str, np.ndarray], speed: float
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """``qpos`` (PHASES, 28) without progress, ``qvel`` and ``qacc`` (PHASES, 27)."""
        half = PHASES // 2
        qpos = np.zeros((PHASES, 28))
        qpos[:, 0], qpos[:, 1], qpos[:, 2] = curves["pelvis_tx"], -curves["pelvis_tz"], curves["pelvis_ty"]
        matrix = pelvis_rotation(*(curves[f"pelvis_{n}"] for n in ("tilt", "list", "rotation")))
        qpos[:, 3:7] = _quaternions(matrix)
        for i, name in enumerate(JOINTS):
            base = name[:-2]
            if base in LEG:
                qpos[:, 7 + i] = curves[base] if name.endswith("_r") else np.roll(curves[base], half)
            elif name.startswith("lumbar"):
                # the trunk stays upright: it turns against the pelvis
                source = {"extension": "tilt", "bending": "list", "rotation": "rotation"}[name[7:]]
                qpos[:, 7 + i] = -curves[f"pelvis_{source}"]
            else:
                qpos[:, 7 + i] = self._upper[name]
        rate = _spectral(qpos, self.period)
        qvel = np.zeros((PHASES, 27))
        qvel[:, :3], qvel[:, 6:] = rate[:, :3], rate[:, 7:]
        qvel[:, 0] += speed
        qvel[:, 3:6] = 2 * _conjugate_product(qpos[:, 3:7], rate[:, 3:7])
        return qpos, qvel, _spectral(qvel, self.period)

    def contact(
        self, qpos: np.ndarray, qvel: np.ndarray, qacc: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Right foot's points (PHASES, 3, 3) [m], floor force (PHASES, 3) [N], centre of pressure (PHASES, 2) [m]."""
        model, data = self.model, self.data
        points = np.empty((PHASES, 3, 3))
        force, torque = np.empty((PHASES, 3)), np.empty((PHASES, 3))
        for i in range(PHASES):
            data.qpos[:], data.qvel[:], data.qacc[:] = qpos[i], qvel[i], qacc[i]
            mujoco.mj_inverse(model, data)
            points[i] = data.site_xpos[self.sites]
            force[i] = data.qfrc_inverse[:3]
            torque[i] = data.xmat[1].reshape(3, 3) @ data.qfrc_inverse[3:6]
        lift = np.maximum(force[:, 2], 0.2 * self.body.weight)
        x = qpos[:, 0] - (torque[:, 1] + qpos[:, 2] * force[:, 0]) / lift
        y = qpos[:, 1] + (torque[:, 0] - qpos[:, 2] * force[:, 1]) / lift
        return points, force, np.column_stack([x, y])

    def torques(self, qpos: np.ndarray, qvel: np.ndarray, qacc: np.ndarray) -> np.ndarray:
        """Joint torques (PHASES, 21) [Nm] with the floor's force where it acts, split between the feet by its place."""
        model, data, half = self.model, self.data, PHASES // 2
        points, force, pressure = self.contact(qpos, qvel, qacc)
        feet = {"r": points, "l": np.roll(points, half, axis=0) * [1, -1, 1]}
        out = np.empty((PHASES, 21))
        jacobian = np.zeros((3, model.nv))
        for i in range(PHASES):
            data.qpos[:], data.qvel[:], data.qacc[:] = qpos[i], qvel[i], qacc[i]
            mujoco.mj_inverse(model, data)
            torque = data.qfrc_inverse.copy()
            ahead, behind = ("r", "l") if i < half else ("l", "r")
            rear_toe, front_heel = feet[behind][i, 2, 0], feet[ahead][i, 0, 0]
            share = 1.0
            if i % half < 0.2 * PHASES:
                # both feet carry while the pressure moves from the rear toes to the leading heel
                way = (pressure[i, 0] - rear_toe) / max(front_heel - rear_toe, 1e-3)
                share = float(np.clip(way, 0, 1))
            for side, part in ((ahead, share), (behind, 1 - share)):
                heel, ball, toe = feet[side][i]
                place = np.array([np.clip(pressure[i, 0], heel[0], toe[0]), ball[1], 0.0])
                mujoco.mj_jac(model, data, jacobian, None, place, model.body(f"foot_{side}").id)
                torque -= jacobian.T @ (part * force[i])
            out[i] = torque[6:]
        return out


def _quaternions(matrix: np.ndarray) -> np.ndarray:
    """Quaternions (n, 4) of rotations near the identity."""
    w = 0.5 * np.sqrt(1 + np.trace(matrix, axis1=1, axis2=2))
    x = (matrix[:, 2, 1] - matrix[:, 1, 2]) / (4 * w)
    y = (matrix[:, 0, 2] - matrix[:, 2, 0]) / (4 * w)
    z = (matrix[:, 1, 0] - matrix[:, 0, 1]) / (4 * w)
    return np.column_stack([w, x, y, z])


def _conjugate_product(q: np.ndarray, r: np.ndarray) -> np.ndarray:
    """Vector part of q* r, (n, 3)."""
    vector, other = q[:, 1:], r[:, 1:]
    return np.asarray(q[:, :1] * other - r[:, :1] * vector - np.cross(vector, other))


def _upper_body(settings: TwinReferenceSettings) -> dict[str, np.ndarray]:
    """Arm curves (PHASES,) [rad]: an assumed swing in antiphase to the legs, small in mass and in effect."""
    phase = np.arange(PHASES) / PHASES
    out = {}
    for side, shift in (("r", 0.5), ("l", 0.0)):
        swing = np.cos(2 * np.pi * (phase - shift - settings["arm_swing_phase"]))
        out[f"arm_flex_{side}"] = np.radians(settings["arm_swing_deg"]) * swing
        out[f"arm_add_{side}"] = np.full(PHASES, np.radians(-settings["arm_abduction_deg"]))
        out[f"arm_rot_{side}"] = np.zeros(PHASES)
        out[f"elbow_flex_{side}"] = np.full(PHASES, np.radians(settings["elbow_deg"]))
    return out


def _smooth_between(phase: np.ndarray, start: float, end: float, edge: float) -> np.ndarray:
    """1 between two phases, 0 elsewhere, with edges."""
    x = np.mod(phase - start, 1.0)
    length = np.mod(end - start, 1.0)
    return np.asarray(np.clip(np.minimum(x / edge + 1e-9, (length - x) / edge), 0, 1))


@dataclass
class _Problem:
    """Residuals of the constrained least squares."""

    motion: _Motion
    coefficients: _Coefficients
    start: np.ndarray
    settings: TwinReferenceSettings

    def __post_init__(self) -> None:
        s, phase = self.settings, self.coefficients.phase
        self.stance = s["stance"]
        roll = s["rollover"]
        # which part of the foot is on the floor: heel from the strike, ball from flat foot, toes to the end
        self.heel = _smooth_between(phase, 0.0, roll["heel_off"], 0.04)
        self.ball = _smooth_between(phase, roll["foot_flat"], roll["ball_off"], 0.04)
        self.toe = _smooth_between(phase, roll["ball_off"] - 0.04, self.stance - 0.01, 0.03)
        swing = np.mod(phase - self.stance, 1.0) / (1 - self.stance)
        self.swing = np.where(phase > self.stance, np.sin(np.pi * np.clip(swing, 0, 1)) ** 2, 0.0)

    def parts(self, x: np.ndarray) -> dict[str, np.ndarray]:
        """Residuals by name; each is 1 where it is off by its scale."""
        c, s = self.coefficients, self.settings
        curves = c.curves(x)
        qpos, qvel, qacc = self.motion.states(curves, x[-1])
        points, force, pressure = self.motion.contact(qpos, qvel, qacc)
        period, weight = self.motion.period, self.motion.body.weight
        velocity = _spectral(points, period)
        velocity[..., 0] += x[-1]
        contact = np.stack([self.heel, self.ball, self.toe], axis=1)
        # stance: no slip, on the floor
        slip = contact[..., None] * velocity / s["slip_m_per_s"]
        height = contact * points[..., 2] / s["height_m"]
        sink = np.minimum(points[..., 2] + 0.002, 0) / s["height_m"]
        clear = s["clearance_m"] * self.swing[:, None] - points[..., 2]
        clearance = np.maximum(clear, 0) / s["height_m"]
        landing = np.maximum(-velocity[-4:, 0, 2] - s["landing_m_per_s"], 0) / 0.05
        return {
            "data": self._data(x),
            "slip": slip.ravel(),
            "height": height.ravel(),
            "sink": sink.ravel(),
            "clearance": clearance.ravel(),
            "landing": landing,
            "pressure": self._pressure(points, pressure).ravel(),
            "force": np.concatenate(
                [
                    np.maximum(force[:, 2] / weight - s["peak_bw"], 0) / 0.05,
                    np.minimum(force[:, 2] / weight - 0.6, 0) / 0.05,
                    np.maximum(np.hypot(force[:, 0], force[:, 1]) / np.maximum(force[:, 2], 1) - 0.35, 0)
                    / 0.05,
                ]
            ),
        }

    def _data(self, x: np.ndarray) -> np.ndarray:
        """Departure from the measured terms; a constant offset of an angle costs less than a change of shape."""
        c, s = self.coefficients, self.settings["weights"]
        out = []
        for name, basis in c.bases.items():
            delta = x[c.slices[name]] - self.start[c.slices[name]]
            mean = name in _WITH_MEAN
            shape = basis[:, 1:] @ delta[1:] if mean else basis @ delta
            scale = (
                s["translation_m"]
                if name.startswith("pelvis_t") and name != "pelvis_tilt"
                else s["shape_rad"]
            )
            if name in ("hip_adduction", "hip_rotation"):
                scale *= 2
            out.append(shape / (scale * np.sqrt(PHASES)))
            if mean:
                offset = s["height_m"] if name == "pelvis_ty" else s["offset_rad"]
                if name == "pelvis_tilt":
                    offset /= 3
                out.append(delta[:1] / offset)
        out.append(np.array([(x[-1] - self.start[-1]) / s["speed_m_per_s"]]))
        return np.asarray(s["data"] * np.concatenate(out))

    def _pressure(self, points: np.ndarray, pressure: np.ndarray) -> np.ndarray:
        """Return the distance (PHASES, 2) of the centre of pressure outside the standing feet, in scales."""
        half = PHASES // 2
        s, phase = self.settings, self.coefficients.phase
        right_y = points[:, 1, 1]
        left = np.roll(points, half, axis=0)
        heel_r, toe_r = points[:, 0, 0], points[:, 2, 0]
        heel_l, toe_l = left[:, 0, 0], left[:, 2, 0]
        down_r = phase < self.stance
        down_l = np.mod(phase + 0.5, 1.0) < self.stance
        low = np.where(down_r & down_l, np.minimum(heel_r, heel_l), np.where(down_r, heel_r, heel_l))
        high = np.where(down_r & down_l, np.maximum(toe_r, toe_l), np.where(down_r, toe_r, toe_l))
        left_y = -np.roll(right_y, half)
        y_low = np.where(down_r, right_y, left_y) - 0.03
        y_high = np.where(down_l, left_y, right_y) + 0.03
        scale = s["pressure_m"]
        over_x = np.maximum(pressure[:, 0] - high, 0) + np.minimum(pressure[:, 0] - low, 0)
        over_y = np.maximum(pressure[:, 1] - y_high, 0) + np.minimum(pressure[:, 1] - y_low, 0)
        return np.asarray(np.stack([over_x, over_y]) / scale)

    def residuals(self, x: np.ndarray) -> np.ndarray:
        """All residuals in one vector, constraints by their weight."""
        return np.concatenate(
            [v if n == "data" else v / np.sqrt(PHASES) * 3 for n, v in self.parts(x).items()]
        )


def measured_cycle(walks: list[Walk]) -> tuple[dict[str, np.ndarray], dict[str, float]]:
    """Return the symmetric mean cycle (PHASES,) [rad, m] by coordinate, and the asymmetry averaged away [degrees].

    Translations of the pelvis are relative to their mean, the vertical one to the floor of its own system.
    """
    at = np.linspace(0, 100, PHASES + 1)[:-1]
    grid = np.arange(101)

    def mean(rows: np.ndarray) -> np.ndarray:
        curve = rows.mean(axis=0)
        # a mean of strides does not quite close: the gap is spread over the cycle
        curve = curve - np.linspace(-0.5, 0.5, 101) * (curve[-1] - curve[0])
        return np.asarray(np.interp(at, grid, curve))

    out: dict[str, np.ndarray] = {}
    asymmetry: dict[str, float] = {}
    for name in LEG:
        if f"{name}_r" not in walks[0].joints:
            out[name] = np.zeros(PHASES)
            continue
        right, left = (mean(pooled_strides(walks, name, side)) for side in FEET)
        out[name] = (right + left) / 2
        asymmetry[name] = float(np.degrees(np.sqrt(np.mean((right - left) ** 2))))
    for name in PELVIS:
        own, other = (mean(pooled_strides(walks, name, side)) for side in FEET)
        odd = name in ("pelvis_list", "pelvis_rotation", "pelvis_tz")
        sign = -1 if odd else 1
        both = (own + sign * other) / 2
        out[name] = both - both.mean() if name in ("pelvis_tx", "pelvis_tz") or odd else both
    return out, asymmetry


def make_reference(
    measured: dict[str, np.ndarray],
    stride_s: float,
    speed: float,
    body: Body,
    human: TwinHumanSettings,
    settings: TwinReferenceSettings,
    progress: Callable[[str], None] = lambda text: None,
) -> Reference:
    """Nearest gait of the model to measured curves (PHASES,) that can be walked; see the module.

    ``human`` and ``settings`` are the slices ``twin.human`` and ``twin.reference`` of the configuration.
    ``report`` of the result says what had to be changed, in degrees, and how well the constraints hold.
    """
    coefficients = _Coefficients()
    start_curves = dict(measured)
    # the model's own height: measured heights are those of another skeleton
    start_curves["pelvis_ty"] = measured["pelvis_ty"] - measured["pelvis_ty"].mean() + 0.975 * body.hip_height
    start = coefficients.of(start_curves, speed)
    motion = _Motion(body, human, _upper_body(settings), stride_s)
    problem = _Problem(motion, coefficients, start, settings)
    guess = start.copy()
    half_width = settings["step_half_width_m"]
    guess[coefficients.slices["hip_adduction"]][0] = np.arcsin(
        np.clip((0.0454 * body.height_m - half_width) / (0.5 * body.height_m), -0.2, 0.2)
    )
    guess[coefficients.slices["pelvis_tz"]] *= 0.7
    result = least_squares(
        problem.residuals, guess, method="trf", max_nfev=settings["iterations"], x_scale="jac"
    )
    x = result.x
    progress(f"reference: cost {result.cost:.2f} after {result.nfev} evaluations, speed {x[-1]:.3f} m/s")
    curves = coefficients.curves(x)
    qpos, qvel, qacc = motion.states(curves, x[-1])
    torque = motion.torques(qpos, qvel, qacc)
    report = _report(problem, x, measured, curves, speed)
    return Reference(qpos, qvel, torque, stride_s, float(x[-1]), measured, report)


def scaled_curves(
    measured: Mapping[str, np.ndarray], step_ratio: float, settings: TwinReferenceSpeedsSettings
) -> dict[str, np.ndarray]:
    """Return curves (PHASES,) for steps that are shorter or longer by a ratio, about their means.

    Hips, forward sway and rotation of the pelvis go with the step, its vertical sway with the square, as an arc of
    legs does; knees and ankles with the powers of ``twin.reference.speeds``.
    """
    powers = {"hip_flexion": 1.0, "pelvis_tx": 1.0, "pelvis_rotation": 1.0, "pelvis_ty": 2.0}
    powers |= {"knee_angle": settings["knee_exponent"], "ankle_angle": settings["ankle_exponent"]}
    return {
        name: curve.mean() + (curve - curve.mean()) * step_ratio ** powers.get(name, 0.0)
        for name, curve in measured.items()
    }


def with_speeds(
    reference: Reference,
    body: Body,
    human: TwinHumanSettings,
    settings: TwinReferenceSettings,
    cadence_exponent: float,
    progress: Callable[[str], None] = lambda text: None,
) -> Reference:
    """Return the reference with the same person's gait at ``twin.reference.speeds`` beside it.

    Cadence goes with the power ``cadence_exponent`` of speed and steps with the rest; curves are `scaled_curves` of the
    measured ones, made walkable like the first. A speed is known by what came out, not by what was asked for.
    """
    rows = [(1.0, reference)]
    weights: TwinReferenceWeightsSettings = {
        **settings["weights"],
        "speed_m_per_s": settings["speeds"]["speed_m_per_s"],
    }
    firm: TwinReferenceSettings = {**settings, "weights": weights}
    for share in settings["speeds"]["shares"]:
        curves = scaled_curves(reference.measured, share ** (1 - cadence_exponent), settings["speeds"])
        stride, speed = reference.stride_s * share**-cadence_exponent, reference.speed * share
        progress(f"reference at {100 * share:.0f} % of the speed")
        made = make_reference(curves, stride, speed, body, human, firm, progress)
        rows.append((made.speed / reference.speed, made))
    rows.sort(key=lambda row: row[0])
    shares, made_of = zip(*rows, strict=True)
    if np.any(np.diff(shares) < _LEAST_APART):
        found = f"gaits at {np.round(shares, 3).tolist()} of the own speed"
        expected, remedy = f"speeds {_LEAST_APART:g} apart and more", "Leave one out; 1 is always among them."
        raise InputError(Path("config"), "twin.reference.speeds.shares", found, expected, remedy)
    table = np.stack([np.hstack([r.qpos, r.qvel, r.torque]) for r in made_of])
    speeds = Speeds(np.array(shares), table, np.array([r.stride_s for r in made_of]))
    report = {**reference.report, "speeds": [_speed_report(share, r) for share, r in rows]}
    return replace(reference, speeds=speeds, report=report)


def _speed_report(share: float, reference: Reference) -> dict[str, Any]:
    """Return how a person walks at a share of their speed: stride, ranges of motion, slip."""
    return {
        "share": share,
        "speed_m_per_s": reference.speed,
        "stride_s": reference.stride_s,
        "range_of_motion_deg": {
            joint: float(np.ptp(np.degrees(reference.curve(f"{joint}_r")))) for joint in SAGITTAL
        },
        "slip_rms_m_per_s": reference.report["slip_rms_m_per_s"],
    }


def _report(
    problem: _Problem,
    x: np.ndarray,
    measured: Mapping[str, np.ndarray],
    curves: Mapping[str, np.ndarray],
    speed: float,
) -> dict[str, Any]:
    """Return what had to be changed of the measured gait, and how well the solution x holds the constraints."""
    motion = problem.motion
    qpos, qvel, qacc = motion.states(curves, x[-1])
    points, force, _ = motion.contact(qpos, qvel, qacc)
    velocity = _spectral(points, motion.period)
    velocity[..., 0] += x[-1]
    stance = np.stack([problem.heel, problem.ball, problem.toe], axis=1) > 0.99
    swing = problem.swing > 0.5
    changes = {}
    for name in (*LEG, "pelvis_tilt", "pelvis_list", "pelvis_rotation"):
        delta = np.degrees(curves[name] - measured[name])
        changes[name] = {
            "offset_deg": float(delta.mean()),
            "shape_rms_deg": float(delta.std()),
            "range_of_motion_deg": [float(np.ptp(np.degrees(v))) for v in (measured[name], curves[name])],
        }
    return {
        "changed": changes,
        "speed_m_per_s": {"measured": speed, "reference": float(x[-1])},
        "stride_s": motion.period,
        "slip_rms_m_per_s": float(np.sqrt(np.mean(velocity[stance] ** 2))),
        "sink_max_m": float(-points[..., 2].min()),
        "clearance_min_m": float(points[swing][..., 2].min()),
        "vertical_force_peak_bw": float(force[:, 2].max() / motion.body.weight),
        "residuals": {name: float(np.sqrt(np.mean(v**2))) for name, v in problem.parts(x).items()},
    }
