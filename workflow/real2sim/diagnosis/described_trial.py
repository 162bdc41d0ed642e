"""From recordings of a described system to evidence: frames, drive, start, coordinates and noise levels."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

import mujoco
import numpy as np
from scipy.interpolate import BSpline, make_interp_spline, make_lsq_spline
from scipy.spatial.transform import Rotation

from real2sim import signals
from real2sim.diagnosis.site_check import check_sites
from real2sim.diagnosis.system_evidence import Measured, Simulated, SystemEvidence
from real2sim.effects.base import Scales
from real2sim.effects.chains import Context, MarkerShapes, NeutralPose, RobotMass
from real2sim.effects.system_replay import Setup
from real2sim.errors import InputError
from real2sim.geometry import mean_rotation, relative_pose, rotation_xyz
from real2sim.recording.levels import moving_sd, white_sd
from real2sim.recording.skin import skin_by_turn
from real2sim.recording.table import Recording, check_columns, log_columns, marker_columns
from real2sim.system.described_plant import DRIVEN_SITE, Anchor, load_model, plant_of, rests_of
from real2sim.system.description import BASE_JOINTS, FORCE, PATH, POSE, System
from real2sim.system.drive import PelvisDrive, pelvis_drive
from real2sim.system.kinematics import Sample, Solver, frame_markers, rigid_pose, segment_frame
from real2sim.system.plant import RestPose, compiled, mass_on_base
from real2sim.system.replay import servo_command

if TYPE_CHECKING:
    from real2sim.settings import DiagnosisDescribedSettings

# Order of the zero-phase low-pass of drive and coordinates
_ORDER = 4
# Degree of the spline that a driven joint follows: the drive needs its acceleration
_DEGREE = 5
_TINY = 1e-12
# Band and rate of a person's recording, at whose pace delays and filters are described [Hz]
_BAND_HZ, _RATE_HZ = 10.0, 100.0
# The body that a person's strap hangs on, in whose units masses are described [kg, kg m^2]
_STRAP_KG, _STRAP_KGM2 = 3.0, 0.03


@dataclass(frozen=True)
class Segment:
    """The driven segment of one recording: pose (n, 3, 3), (n, 3) [m, world] and its markers on it (k, 3) [m].

    ``by_turn`` is how these move on it as it turns, see `MarkerShapes`.
    """

    rotation: np.ndarray
    position: np.ndarray
    shape: np.ndarray
    by_turn: np.ndarray
    cutoff_hz: float


class DescribedTrial:
    """One recording of a described system, with the quiet one that noise and rest pose are measured in.

    Without a quiet recording, noise is measured in the recording itself and coordinates are zero as in the model.
    ``settings`` is the slice ``diagnosis.described`` of the configuration.
    """

    def __init__(
        self,
        system: System,
        recording: Recording,
        quiet: Recording | None,
        settings: DiagnosisDescribedSettings,
        threads: int = 1,
    ):
        self._system, self._recording, self._threads = system, recording, threads
        self._settings = settings
        self._quiet = quiet
        self._rate = recording.rate_hz
        self._cutoff = min(system.band_hz, 0.4 * self._rate)
        for given in (recording, quiet):
            if given is not None:
                check_columns(system, given)
        self._check_drive()
        self._levels = quiet if quiet is not None else recording
        self._logs = {j: _bridged(recording.columns[c]) for j, c in log_columns(system).items()}
        self._pose = system.drive.by == POSE
        self._start = self._start_samples()
        self._anchor = self._anchor_of() if self._pose else None
        self._segment = self._segment_of(recording) if self._pose else None
        self._plain, self._solver = self._model()
        self._position, self._rate_of = self._paths()

    def _check_drive(self) -> None:
        """Refuse gaps in what drives a recording that no line fills within its band."""
        recording, system = self._recording, self._system
        most = self._rate / (2 * self._cutoff)
        # a segment's further markers may be lost: its pose is computed without them
        of_pose = (
            (c for m in frame_markers(system) for c in marker_columns(m)) if system.drive.by == POSE else ()
        )
        for column in (*system.drive.columns.values(), *of_pose):
            for gap in signals.segments(~np.isfinite(recording.columns[column])):
                if gap.stop - gap.start > most:
                    raise InputError(
                        recording.name,
                        f"column {column}, from {recording.time_s[gap.start]:.4g} s",
                        f"no number for {(gap.stop - gap.start) / self._rate:.3g} s in what drives the simulation",
                        f"gaps of no more than half a period of {self._cutoff:.3g} Hz, {most / self._rate:.3g} s",
                        "Cut the recording there, or record it again.",
                        "drive_gap",
                    )

    def _check_length(self) -> None:
        """Refuse a recording that begins in motion and ends before that tells where it began."""
        samples, least = len(self._recording.time_s), self._start_window
        if samples < least:
            raise InputError(
                self._recording.name,
                "",
                f"{samples} samples ({samples / self._rate:.3g} s)",
                f"{least} samples and more, which tell where a recording starts that begins in motion",
                "Record longer, or begin with half a second of standing still.",
                "too_short",
            )

    @property
    def _start_window(self) -> int:
        """Samples at the beginning that tell where a recording starts that begins in motion."""
        return max(12, round(self._settings["still_s"] * self._rate))

    # ---------------------------------------------------------------- segment and interface

    def _sites(self) -> np.ndarray:
        """Places (k, 3) [m] of the interface's markers in the interface's body."""
        spec = load_model(self._system)
        model = spec.compile()
        body = model.body(self._system.body).id
        out = []
        for site in (self._system.markers.sites or {}).values():
            index = model.site(site)
            if model.site_bodyid[index.id] != body:
                raise InputError(
                    self._system.model,
                    f"site {site}",
                    f"on body {model.body(model.site_bodyid[index.id]).name}",
                    f"on body {self._system.body}, which the interface hangs on",
                    "Move the site.",
                )
            out.append(index.pos.copy())
        return np.array(out)

    def _interface_pose(self, recording: Recording) -> tuple[np.ndarray, np.ndarray]:
        places = self._sites()
        markers = recording.markers(self._system.markers.interface)
        flat = signals.bridged(markers.reshape(len(markers), -1)).reshape(markers.shape)
        return rigid_pose(places, flat)

    def _segment_pose(self, recording: Recording, markers: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        flat = signals.bridged(markers.reshape(len(markers), -1)).reshape(markers.shape)
        return segment_frame(self._system, flat)

    def _anchor_of(self) -> Anchor:
        places = self._sites()
        if self._system.rest != "quiet" or self._quiet is None:
            raise InputError(
                self._recording.name,
                "quiet",
                "no quiet recording",
                "a recording of standing still, in which the coordinates of the interface are zero",
                "Pass quiet=..., and set interface.rest to quiet.",
            )
        least, lasts = self._settings["least_quiet_s"], len(self._quiet.time_s) / self._quiet.rate_hz
        if lasts < least:
            raise InputError(
                self._quiet.name,
                "quiet",
                f"{lasts:.1f} s",
                f"at least {least:g} s of standing still",
                "Record longer.",
            )
        segment, interface = (
            np.nanmean(self._quiet.markers(names), axis=0)
            for names in (self._system.markers.segment, self._system.markers.interface)
        )
        logged = {j: float(np.nanmean(self._quiet.columns[c])) for j, c in log_columns(self._system).items()}
        check_sites(self._system, places, segment, interface, logged)
        rotation, position = self._relative(self._quiet)
        return Anchor(places.mean(axis=0), RestPose(mean_rotation(rotation), position.mean(axis=0)))

    def _relative(self, recording: Recording) -> tuple[np.ndarray, np.ndarray]:
        """Pose of the interface in the segment, (n, 3, 3) and (n, 3) [m]."""
        names = self._system.markers.segment
        segment = self._segment_pose(recording, recording.markers(names))
        return relative_pose(*segment, *self._interface_pose(recording))

    def _segment_of(self, recording: Recording) -> Segment:
        markers = recording.markers(self._system.markers.segment)
        rotation, position = self._segment_pose(recording, markers)
        seen = np.einsum("nji,nkj->nki", rotation, markers - position[:, None])
        shape = np.nanmean(seen, axis=0)
        smooth = self._smooth_pose(rotation, position)
        return Segment(*smooth, shape, skin_by_turn(smooth[0], seen, shape), self._cutoff)

    def _smooth_pose(self, rotation: np.ndarray, position: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        first = rotation[0]
        vectors = Rotation.from_matrix(first.T @ rotation).as_rotvec()
        smooth = self._lowpass(self._standing_still(np.hstack([position, vectors])))
        return first @ Rotation.from_rotvec(smooth[:, 3:]).as_matrix(), smooth[:, :3]

    def _standing_still(self, values: np.ndarray) -> np.ndarray:
        """Return what drives (n, c) at its mean for as long as nothing moves.

        A machine in static equilibrium keeps the noise of the first pose as an offset for the whole trial.
        """
        out = values.copy()
        if self._still:
            out[: self._start] = np.nanmean(values[: self._start], axis=0)
        return out

    def _lowpass(self, values: np.ndarray) -> np.ndarray:
        return signals.lowpass(signals.bridged(values), self._rate, self._cutoff, _ORDER)

    @property
    def _pace(self) -> float:
        """Times faster than a person's recording, whose band ends at 10 Hz and whose rate is 100 Hz.

        Both limit it: no filter can be seen whose cut-off lies above half of the rate.
        """
        return min(self._system.band_hz / _BAND_HZ, self._rate / _RATE_HZ)

    @property
    def _load(self) -> tuple[float, float]:
        """Mass and inertia of the interface's body, in those of a strap's."""
        if not self._system.body:
            return 1.0, 1.0
        body = self._plain.body(self._system.body)
        return float(body.mass[0]) / _STRAP_KG, float(body.inertia.mean()) / _STRAP_KGM2

    # ---------------------------------------------------------------- start and coordinates

    def _start_samples(self) -> int:
        """Samples until anything that is measured moves."""
        columns = np.column_stack(list(self._recording.columns.values()))
        first = max(3, round(self._settings["first_s"] * self._rate))
        before = np.nanmean(columns[:first], axis=0)
        sd = np.maximum(white_sd(columns), 1e-9)
        moved = (np.abs(columns - before) > self._settings["moved_sd"] * sd).any(axis=1)
        return max(first, int(np.argmax(moved)) if moved.any() else len(columns))

    def _model(self) -> tuple[mujoco.MjModel, Solver]:
        segment = self._segment
        frame = None if segment is None else RestPose(segment.rotation[0], segment.position[0])
        spec = plant_of(self._system, self._system.step_s, self._anchor, frame)
        model = compiled(spec, self._system.model)
        sites = tuple((self._system.markers.sites or {}).values()) if self._pose else ()
        return model, Solver(model, sites)

    def _paths(self) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray]]:
        """Positions (n,) and rates (n,) of joints that the recording tells, by joint, low-passed."""
        self._raw = dict(self._logs)
        for output in self._system.outputs:
            if output.quantity == "position":
                self._raw[output.joint] = _bridged(self._recording.columns[output.column])
        if self._system.drive.by == PATH:
            for joint, column in self._system.drive.columns.items():
                self._raw[joint] = _bridged(self._recording.columns[column])
        known = {j: self._lowpass(v[:, None])[:, 0] for j, v in self._raw.items()}
        if self._pose:
            known |= self._solved(known)
        rates = {j: np.gradient(v, self._recording.step_s) for j, v in known.items()}
        return known, rates

    def _solved(self, known: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
        """Positions (n,) of all joints of the plant, sample by sample."""
        model, segment = self._plain, self._segment
        assert segment is not None
        markers = self._recording.markers(self._system.markers.interface)
        smooth = self._lowpass(markers.reshape(len(markers), -1)).reshape(markers.shape)
        position, out = model.qpos0.copy(), []
        for i in range(len(self._recording.time_s)):
            logged = {j: float(v[i]) for j, v in known.items()}
            sample = Sample(logged, segment.rotation[i], segment.position[i], smooth[i])
            position = self._solver.solve(sample, position)
            out.append(position)
        path = np.array(out)
        return {model.joint(j).name: path[:, model.jnt_qposadr[j]] for j in range(model.njnt)}

    def _start_of(self) -> tuple[dict[str, float], dict[str, float]]:
        """Positions and rates of joints at the start: of a path, means while nothing moves, else of a cubic in time."""
        if self._still:
            first = slice(0, self._start)
            position = {j: float(v[first].mean()) for j, v in self._position.items()}
            rate = dict.fromkeys(self._rate_of, 0.0)
        else:
            weights = self._start_weights()
            n = weights.shape[1]
            at = {j: weights @ self._raw.get(j, v)[:n] for j, v in self._position.items()}
            position, rate = ({j: float(v[k]) for j, v in at.items()} for k in (0, 1))
        if self._pose:
            position = self._consistent(position)
        if self._system.drive.by == PATH:
            # what follows a path is on it from the first step, with its rate: a servo that has to catch up pushes
            columns, begin = self._system.drive.columns, self._recording.time_s[0]
            path = self._smooth_path(self._recording.stack(tuple(columns.values())))
            position |= dict(zip(columns, path(begin).tolist(), strict=True))
            rate |= dict(zip(columns, path(begin, 1).tolist(), strict=True))
        return position, rate

    @property
    def _still(self) -> bool:
        """Return whether the recording begins with standing still, long enough to tell where."""
        return self._start >= round(self._settings["still_s"] * self._rate)

    @property
    def _starts_in_equilibrium(self) -> bool:
        """True where the controllers balance the interface at the start, as they do where all stands still."""
        return self._pose and self._still and any(j.impedance is not None for j in self._system.machine)

    def _start_weights(self) -> np.ndarray:
        """Weights (2, n) of the first samples that give position and rate at the start, by a cubic in time."""
        self._check_length()
        n = self._start_window
        basis = np.vander(np.arange(n) / self._rate, 4, increasing=True)
        return np.linalg.pinv(basis)[:2]

    def _consistent(self, position: Mapping[str, float]) -> dict[str, float]:
        """Joint positions with the segment exactly where its path begins."""
        model, segment = self._plain, self._segment
        assert segment is not None
        start = model.qpos0.copy()
        for joint, value in position.items():
            start[model.joint(joint).qposadr[0]] = value
        first = slice(0, self._start)
        seen = self._recording.markers(self._system.markers.interface)
        markers = signals.bridged(seen.reshape(len(seen), -1)).reshape(seen.shape)[first].mean(axis=0)
        logged = {j: float(v[first].mean()) for j, v in self._logs.items()}
        solved = self._solver.solve(Sample(logged, segment.rotation[0], segment.position[0], markers), start)
        return {model.joint(j).name: float(solved[model.jnt_qposadr[j]]) for j in range(model.njnt)}

    def _along_axes(self, paths: Mapping[str, np.ndarray]) -> np.ndarray:
        n = len(self._recording.time_s)
        return np.column_stack([paths.get(a.joint, np.zeros(n)) for a in self._system.axes])

    # ---------------------------------------------------------------- drive

    def setup(self, parts: int) -> Setup:
        """Return what a simulation needs, its time step divided into some parts."""
        sample = self._recording.step_s
        stride = int(np.ceil(sample / self._system.step_s - 1e-9)) * parts
        h = sample / stride
        start, rate = self._start_of()
        commands, drive, acceleration = self._commands(h, stride, None)
        return Setup(
            self._system,
            h,
            stride,
            commands,
            start,
            rate,
            acceleration,
            drive,
            self._anchor,
            threads=self._threads,
        )

    def _commands(
        self, h: float, stride: int, noise: np.random.Generator | None
    ) -> tuple[np.ndarray, PelvisDrive | None, np.ndarray | None]:
        """Command (nstep, c) of the drive at the steps, with other noise where a generator is given."""
        if self._pose:
            drive = self._segment_drive(h, noise)
            return servo_command(drive), drive, None
        time_s = self._recording.time_s
        steps = time_s[0] + h * np.arange((len(time_s) - 1) * stride + 1)
        columns = self._recording.stack(tuple(self._system.drive.columns.values()))
        if noise is not None:
            columns = columns + self._drive_sd() * noise.standard_normal(columns.shape)
        if self._system.drive.by == FORCE:
            return self._forces(steps, h, columns), None, None
        path = self._smooth_path(columns)
        half = np.maximum(steps - h / 2, steps[0])
        command = path(steps) + 2 * h * path(half, 1) + 2 * h * h * path(steps, 2)
        return command, None, path(time_s, 2)

    def _smooth_path(self, columns: np.ndarray) -> BSpline:
        """Spline of degree 5 through columns (n, c) by least squares, its knots half a period of the cut-off apart.

        A low-pass reflects a record at its ends: of one that ends in motion it bends the acceleration there.
        """
        time_s, columns = self._recording.time_s, signals.bridged(self._standing_still(columns))
        spans = round((time_s[-1] - time_s[0]) * 2 * self._cutoff)
        if spans >= len(time_s) - _DEGREE:
            return make_interp_spline(time_s, columns, k=_DEGREE)
        inner = np.linspace(time_s[0], time_s[-1], max(spans, 1) + 1)
        knots = np.concatenate([[inner[0]] * _DEGREE, inner, [inner[-1]] * _DEGREE])
        return make_lsq_spline(time_s, columns, knots, k=_DEGREE)

    def _forces(self, steps: np.ndarray, h: float, columns: np.ndarray) -> np.ndarray:
        """Mean force (nstep, c) over a step about each of ``steps`` (nstep,) [s]: rates live half a step late."""
        time_s, columns = self._recording.time_s, signals.bridged(columns)
        if not self._system.drive.held:
            return signals.upsampled(columns, round(self._recording.step_s / h))[: len(steps)]
        edges = np.append(time_s, time_s[-1] + self._recording.step_s)
        out = []
        for column in columns.T:
            total = np.concatenate([[0.0], np.cumsum(column)]) * self._recording.step_s
            early, late = np.clip(steps - h / 2, edges[0], None), steps + h / 2
            out.append((np.interp(late, edges, total) - np.interp(early, edges, total)) / (late - early))
        return np.column_stack(out)

    def _segment_drive(self, h: float, noise: np.random.Generator | None) -> PelvisDrive:
        segment = self._segment
        assert segment is not None
        rotation, position = segment.rotation, segment.position
        if noise is not None:
            clean = position[:, None] + np.einsum("nij,kj->nki", rotation, segment.shape)
            shaken = clean + self._drive_sd() * noise.standard_normal(clean.shape)
            r0, p0 = segment_frame(self._system, clean)
            r1, p1 = segment_frame(self._system, shaken)
            rotation, position = self._smooth_pose(
                np.einsum("nij,nkj->nik", r1, r0) @ rotation, position + p1 - p0
            )
        frame = (segment.rotation[0], segment.position[0])
        return pelvis_drive(self._recording.time_s, rotation, position, h, frame)

    def _drive_sd(self) -> np.ndarray:
        """White noise SD of what drives: (k, 3) of the segment's markers [m], or (c,) of columns."""
        if self._pose:
            markers = self._levels.markers(self._system.markers.segment)
            return self._noise_sd(markers.reshape(len(markers), -1)).reshape(markers.shape[1:])
        columns = self._levels.stack(tuple(self._system.drive.columns.values()))
        # a command is known as it is: what is fast in it is no noise
        if self._quiet is None and self._system.drive.held:
            return np.zeros(columns.shape[1])
        return self._noise_sd(columns)

    def _noise_sd(self, levels: np.ndarray) -> np.ndarray:
        """White noise SD (c,) of channels (n, c) of the recording that noise is measured in."""
        if self._quiet is None:
            return moving_sd(levels, self._rate, self._cutoff)
        return white_sd(levels)

    def draw(self, seed: int, number: int, parts: int) -> tuple[np.ndarray, np.ndarray | None]:
        """Return the command (nstep, c) of a drive that was measured with other noise; of a path its acceleration too.

        That is (n, c) at the samples: what inertia makes of the noise of a path is seen where a force is measured.
        """
        setup = self.setup(parts)
        rng = np.random.default_rng([seed, number])
        command, _, acceleration = self._commands(setup.timestep, setup.stride, rng)
        return command, acceleration

    # ---------------------------------------------------------------- evidence

    def evidence(self) -> SystemEvidence:
        """Return the evidence of this trial, not whitened yet."""
        sd = self._drive_sd()
        base = self._recording.step_s / int(np.ceil(self._recording.step_s / self._system.step_s - 1e-9))
        cache: dict[tuple[int, int, int], tuple[np.ndarray, np.ndarray | None]] = {}

        def draw(seed: int, number: int, parts: int) -> tuple[np.ndarray, np.ndarray | None]:
            key = seed, number, parts
            if key not in cache:
                cache[key] = self.draw(seed, number, parts)
            return cache[key]

        setups: dict[int, Setup] = {}

        def setup(parts: int) -> Setup:
            if parts not in setups:
                setups[parts] = self.setup(parts)
            return setups[parts]

        shaken = bool((sd > _TINY).any())
        simulated = Simulated(self._system, setup, draw, shaken, base, self._threads)
        measured = self._measured()
        q, v = self._along_axes(self._position), self._along_axes(self._rate_of)
        q = q - rests_of(self._system, self._plain)
        ones = np.ones(len(self._system.axes))
        scales = Scales(_large(q), _large(v), ones, ones, ones, self._pace, *self._load)
        context = self._context(measured, q, v)
        return SystemEvidence(
            measured,
            simulated,
            context,
            scales,
            self._settings,
            self._starts_in_equilibrium,
            name=self._recording.name,
        )

    def _measured(self) -> Measured:
        system, recording = self._system, self._recording
        marker_names = system.markers.interface if self._pose else ()
        markers = recording.markers(marker_names).reshape(len(recording.time_s), -1) if marker_names else None
        outputs = recording.stack(tuple(o.column for o in system.outputs))
        observed = outputs if markers is None else np.hstack([markers, outputs])
        names = [f"{m}_{c}" for m in marker_names for c in "xyz"] + [o.column for o in system.outputs]
        logged = recording.stack(tuple(log_columns(system).values()))
        levels = self._levels
        quiet_markers = levels.markers(marker_names).reshape(len(levels.time_s), -1) if marker_names else None
        quiet_outputs = levels.stack(tuple(o.column for o in system.outputs))
        quiet = quiet_outputs if quiet_markers is None else np.hstack([quiet_markers, quiet_outputs])
        floor = np.array(
            [self._settings["marker_floor_m"]] * (3 * len(marker_names))
            + [max(o.trusted_to, _TINY) for o in system.outputs]
            + [j.trusted_to for j in system.machine if j.logged]
        )
        scatter = (
            *[None] * (3 * len(marker_names)),
            *(o.scatter for o in system.outputs),
            *(j.scatter for j in system.machine if j.logged),
        )
        observed_sd = self._noise_sd(quiet)
        logged_sd = self._noise_sd(levels.stack(tuple(log_columns(system).values())))
        return Measured(
            recording.time_s,
            observed,
            logged,
            (*names, *log_columns(system)),
            observed_sd,
            logged_sd,
            floor,
            scatter,
            *self._start_sd(observed_sd, logged_sd),
            self._rest_sd(),
            self._to_axes(observed.shape[1]),
            np.maximum(
                [0.0] * (3 * len(marker_names))
                + [o.zero_sd for o in system.outputs]
                + [0.0] * logged.shape[1],
                [0.0 if s is None else s.zero_sd for s in scatter],
            ),
        )

    def _start_sd(
        self, observed_sd: np.ndarray, logged_sd: np.ndarray
    ) -> tuple[dict[str, float], dict[str, float]]:
        """SD of where joints start [m, rad] and of their rates, by joint: of their own or the markers' noise."""
        weights = np.linalg.norm(self._start_weights(), axis=1)
        averaged = np.sqrt(max(min(self._start, 50), 1)) if self._still else 1 / weights[0]
        out = {j: float(s) / averaged for j, s in zip(log_columns(self._system), logged_sd, strict=True)}
        first = 3 * len(self._system.markers.interface) if self._pose else 0
        for i, output in enumerate(self._system.outputs):
            if output.quantity == "position":
                out[output.joint] = float(observed_sd[first + i]) / averaged
        if self._pose and first:
            span = float(np.linalg.norm(self._sites() - self._sites().mean(axis=0), axis=1).max())
            noise = float(observed_sd[:first].mean()) / averaged
            for axis in self._system.axes:
                out[axis.joint] = noise / span if axis.rotational else noise
        out = {j: max(s, 1e-7) for j, s in out.items()}
        if self._still:
            return out, {}
        # a cubic does not tell a rate that changes within the window: it is as good as unknown, and so is the place of
        # what swings there
        off = {j: self._off_the_cubic(j) for j in out}
        rates = {
            j: float(np.hypot(self._settings["rate_share"] * _large(self._rate_of[j]), off[j][1]))
            for j in out
        }
        return {j: float(np.hypot(s, off[j][0])) for j, s in out.items()}, rates

    def _off_the_cubic(self, joint: str) -> tuple[float, float]:
        """RMS of a joint's low-passed position [m, rad] and rate about the cubic that tells where it starts."""
        n = self._start_weights().shape[1]
        position = self._position[joint][:n]
        basis = np.vander(np.arange(n) / self._rate, 4, increasing=True)
        off = position - basis @ np.linalg.lstsq(basis, position, rcond=None)[0]
        return float(off.std()), float(np.gradient(off, self._recording.step_s).std())

    def _rest_sd(self) -> np.ndarray:
        """SD (axes,) [m, rad] of the rest pose, of the means of seconds of the quiet recording; 0 without one."""
        axes = len(self._system.axes)
        if not self._pose or self._quiet is None:
            return np.zeros(axes)
        quiet = DescribedTrial._coordinates_of(self, self._quiet)
        second = max(1, round(self._quiet.rate_hz))
        seconds = quiet[: len(quiet) // second * second].reshape(-1, second, axes).mean(axis=1)
        return np.asarray(seconds.std(axis=0, ddof=1) / np.sqrt(len(seconds)))

    def _coordinates_of(self, recording: Recording) -> np.ndarray:
        """Coordinates (n, axes) of the interface along its axes, to first order in small departures from rest."""
        rotation, position = self._relative(recording)
        anchor = self._anchor
        assert anchor is not None
        shift = position - anchor.rest.position
        turn = Rotation.from_matrix(rotation @ anchor.rest.rotation.T).as_rotvec()
        columns = []
        for axis in self._system.axes:
            direction = np.array(axis.direction) / np.linalg.norm(np.array(axis.direction))
            columns.append((turn if axis.rotational else shift) @ direction)
        return np.column_stack(columns)

    def _to_axes(self, channels: int) -> np.ndarray:
        """Map (n, axes, c) from errors of the observed channels to those of the interface's coordinates."""
        system, n = self._system, len(self._recording.time_s)
        out = np.zeros((n, len(system.axes), channels))
        first = 3 * len(system.markers.interface) if self._pose else 0
        for i, output in enumerate(system.outputs):
            if output.joint in system.axis_joints:
                out[:, system.axis_joints.index(output.joint), first + i] = 1
        if self._pose and first:
            inverse = np.linalg.pinv(self._marker_slopes())
            segment = self._segment
            assert segment is not None
            for marker in range(len(system.markers.interface)):
                own = slice(3 * marker, 3 * marker + 3)
                # errors of a marker in the world, turned into the segment's frame
                out[:, :, own] = np.einsum("ai,nji->naj", inverse[:, own], segment.rotation)
        return out

    def _marker_slopes(self) -> np.ndarray:
        """Slopes (3k, axes) of the interface's markers in the segment's frame by its coordinates, at the start."""
        model, data = self._plain, mujoco.MjData(self._plain)
        sites = [model.site(s).id for s in (self._system.markers.sites or {}).values()]
        driven = model.site(DRIVEN_SITE).id

        def seen(position: np.ndarray) -> np.ndarray:
            data.qpos[:] = position
            mujoco.mj_kinematics(model, data)
            rotation = data.site_xmat[driven].reshape(3, 3)
            return np.concatenate([rotation.T @ (data.site_xpos[s] - data.site_xpos[driven]) for s in sites])

        start, _ = self._start_of()
        at = model.qpos0.copy()
        for joint, value in start.items():
            at[model.joint(joint).qposadr[0]] = value
        here, columns = seen(at), []
        for axis in self._system.axes:
            moved = at.copy()
            moved[model.joint(axis.joint).qposadr[0]] += 1e-5
            columns.append((seen(moved) - here) / 1e-5)
        return np.column_stack(columns)

    def _context(self, measured: Measured, q: np.ndarray, v: np.ndarray) -> Context:
        n = len(self._recording.time_s)
        still = np.tile(np.eye(3), (n, 1, 1))
        segment = self._segment
        rotation = still if segment is None else segment.rotation
        position = np.zeros((n, 3)) if segment is None else segment.position
        shape = np.zeros((4, 3)) if segment is None else segment.shape
        by_turn = None if segment is None else segment.by_turn
        # without the segment, whose inertia stands in for a motion that nothing changes
        machine = load_model(self._system).compile()
        interface, yaw = still, BASE_JOINTS[2]
        if "base" in self._system.offers and yaw in self._position:
            # the arm hardly turns the interface against the base, whose turn is known
            turned = np.sign(machine.joint(yaw).axis[2]) * (self._position[yaw] - machine.joint(yaw).qpos0)
            interface = rotation_xyz(np.outer(turned, [0, 0, 1]))
        return Context(
            measured.time_s,
            measured.time_s,
            rotation,
            position,
            interface,
            self._start,
            RobotMass(*mass_on_base(machine)),
            measured.observed,
            np.zeros(measured.observed.shape, bool),
            q,
            v,
            NeutralPose(rotation[0], position[0]),
            MarkerShapes(shape, np.zeros((2, 3)), by_turn),
            np.zeros(3),
        )


def _bridged(column: np.ndarray) -> np.ndarray:
    """Return a column (n,) with unknown samples bridged by a straight line."""
    return signals.bridged(column[:, None])[:, 0]


def _large(values: np.ndarray) -> np.ndarray:
    """Large excursions: the 95th percentile of the size."""
    return np.asarray(np.maximum(np.percentile(np.abs(values), 95, axis=0), 1e-6))
