"""Imitation environment: many people walk after one reference on `mujoco.batch`.

A control step is a few simulation steps. Each joint has a position servo whose target is the reference, led by the
servo's lag and by the torque that the reference needs, plus the policy's correction for legs and trunk. What the
policy sees and does is mirrored in the second half of the cycle: it only ever knows a right stance, and so it walks
symmetrically.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import mujoco
import numpy as np

from real2sim.study.twin.gait import Reference
from real2sim.study.twin.human import (
    COMMANDED,
    FEET,
    GAINS,
    JOINTS,
    MIRROR,
    MIRROR_SIGN,
    Body,
    base_name,
    human_spec,
    servo_lead_s,
)
from real2sim.system.batches import untimed_batch

if TYPE_CHECKING:
    from real2sim.settings import (
        TwinHumanSettings,
        TwinTrainingHoldSettings,
        TwinTrainingHoldStopsSettings,
        TwinTrainingSettings,
        TwinTrainingSpeedsSettings,
    )

ACTIONS = len(COMMANDED)
OBSERVATIONS = 16 + 2 * ACTIONS
_MIRROR = MIRROR[:ACTIONS]
_SIGN = MIRROR_SIGN[:ACTIONS]
# sin and cos of the phase; root: vz error, vx error, vy error, z error, roll, pitch, angular velocity, yaw, y error;
# share of the own speed
_ROOT_SIGN = np.array([1.0, 1, 1, 1, 1, 1, -1, 1, -1, 1, -1, 1, -1, -1, -1, 1])
# Largest correction of a servo's target [rad]
_SCALE = {
    "hip_flexion": 0.35,
    "hip_adduction": 0.30,
    "hip_rotation": 0.20,
    "knee_angle": 0.35,
    "ankle_angle": 0.35,
    "lumbar_extension": 0.20,
    "lumbar_bending": 0.20,
    "lumbar_rotation": 0.15,
}
# Speed over the floor from which a heel that slips faster costs no more [m/s]
_FAST_SLIP = 0.25
# How far a speed may be off the one that is meant before more costs no more [m/s]: pushes that last have their way
_FAR_OFF = 0.25
# Weight of a joint in the imitation reward
_WEIGHT = {"hip_flexion": 3.0, "knee_angle": 1.0, "ankle_angle": 2.0}


def action_scale() -> np.ndarray:
    """Change of each commanded joint's target per unit of action (13,) [rad]."""
    return np.array([_SCALE[base_name(j)] for j in COMMANDED])


def gains(who: Body) -> np.ndarray:
    """Position gain of each servo (21,) [Nm/rad]."""
    return np.array([who.strength * GAINS[base_name(j)][0] for j in JOINTS])


def servo_target(
    reference: Reference,
    phase: np.ndarray,
    control_s: float,
    kp: np.ndarray,
    correction: np.ndarray,
    cadence: np.ndarray | float = 1.0,
    share: np.ndarray | float = 1.0,
) -> np.ndarray:
    """Targets (m, 21) [rad] held over a control step that starts at ``phase`` (m,).

    The reference half a step ahead, its velocity times the servo's lead, the torque it needs per gain, and the
    policy's ``correction`` (m, 13) [rad] of legs and trunk. ``cadence`` is the clock's own speed, ``share`` the
    reference's speed as a share of the person's own, 1 or (m,) both.
    """
    ahead = 0.5 * cadence * control_s / reference.stride_at(share)
    qpos, qvel, torque = reference.at(phase + ahead, share)
    target = qpos[:, 7:] + servo_lead_s() * np.reshape(cadence, (-1, 1)) * qvel[:, 6:] + torque / kp
    target[:, :ACTIONS] += correction
    return np.asarray(target)


def add_heel_sensors(spec: mujoco.MjSpec) -> None:
    """Add sensors of each heel's place and velocity in the world, right before left: 3 columns each."""
    kinds, site = mujoco.mjtSensor, mujoco.mjtObj.mjOBJ_SITE
    for side in FEET:
        for name, kind in (("place", kinds.mjSENS_FRAMEPOS), ("velocity", kinds.mjSENS_FRAMELINVEL)):
            spec.add_sensor(name=f"heel_{name}_{side}", type=kind, objtype=site, objname=f"heel_{side}")


def slip_sq(sensors: np.ndarray) -> np.ndarray:
    """Mean square speed over the floor of heels that stand on it, both feet added up (n,) [m2/s2].

    ``sensors`` (n, steps, 12) of `add_heel_sensors`. A heel stands where it is at or below the floor's level.
    """
    heels = sensors.reshape(*sensors.shape[:-1], 2, 6)
    stands, speed_sq = heels[..., 2] <= 0.0, np.sum(heels[..., 3:5] ** 2, axis=-1)
    return np.asarray(np.where(stands, speed_sq, 0.0).sum(axis=-1).mean(axis=-1))


@dataclass
class RootState:
    """The pelvis: position, velocity (m, 3) [world], rotation (m, 3, 3), angular velocity (m, 3) [own axes]."""

    position: np.ndarray
    velocity: np.ndarray
    rotation: np.ndarray
    spin: np.ndarray

    @property
    def yaw(self) -> np.ndarray:
        """Heading (m,) [rad]."""
        return np.asarray(np.arctan2(self.rotation[:, 1, 0], self.rotation[:, 0, 0]))

    @property
    def tilt_sq(self) -> np.ndarray:
        """Squared sine of the pelvis' inclination (m,)."""
        return np.asarray(self.rotation[:, 2, 0] ** 2 + self.rotation[:, 2, 1] ** 2)


def rotations(quaternion: np.ndarray) -> np.ndarray:
    """Rotations (m, 3, 3) of unit quaternions (m, 4), w first."""
    w, x, y, z = quaternion.T
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.stack([np.stack(r, axis=-1) for r in rows], axis=-2)


def observe(
    reference: Reference,
    phase: np.ndarray,
    root: RootState,
    q: np.ndarray,
    qd: np.ndarray,
    lane_y: np.ndarray,
    cadence: np.ndarray | float = 1.0,
    share: np.ndarray | float = 1.0,
) -> tuple[np.ndarray, np.ndarray]:
    """Return what the policy sees (m, OBSERVATIONS), mirrored in the second half of the cycle, and where it was (m,).

    ``q``, ``qd`` (m, 21) joint angles and rates; ``lane_y`` (m,) [m] where the person means to walk; ``cadence`` is
    the clock's own speed, ``share`` the speed that the person means to walk at as a share of their own, 1 or (m,) both.
    """
    ref_q, ref_v, _ = reference.at(phase, share)
    ref_v = ref_v * np.reshape(cadence, (-1, 1))
    turn = 2 * np.pi * phase
    mirrored = np.mod(phase, 1.0) >= 0.5
    yaw = root.yaw
    y_error = np.clip(root.position[:, 1] - lane_y - ref_q[:, 1], -0.3, 0.3)
    head = np.column_stack(
        [
            np.sin(turn),
            np.cos(turn),
            np.sin(2 * turn),
            np.cos(2 * turn),
            root.velocity[:, 2] - ref_v[:, 2],
            root.velocity[:, 0] - ref_v[:, 0],
            root.velocity[:, 1] - ref_v[:, 1],
            root.position[:, 2] - ref_q[:, 2],
            root.rotation[:, 2, 1],
            root.rotation[:, 2, 0],
            root.spin,
            yaw,
            y_error,
            np.broadcast_to(share, len(phase)),
        ]
    )
    joints = q[:, :ACTIONS] - ref_q[:, 7 : 7 + ACTIONS]
    rates = qd[:, :ACTIONS] - ref_v[:, 6 : 6 + ACTIONS]
    flip = mirrored[:, None]
    head = np.where(flip, head * _ROOT_SIGN, head)
    # the mirrored clock starts again at the left strike
    head[:, :2] = np.where(flip, -head[:, :2], head[:, :2])
    joints = np.where(flip, (joints * _SIGN)[:, _MIRROR], joints)
    rates = np.where(flip, (rates * _SIGN)[:, _MIRROR], rates)
    return np.hstack([head, joints, 0.1 * rates]), mirrored


def correction_of(action: np.ndarray, mirrored: np.ndarray) -> np.ndarray:
    """Change of the servo targets (m, 13) [rad] by actions (m, 13), mirrored back where the observation was."""
    back = (action * _SIGN)[:, _MIRROR]
    return np.asarray(np.where(mirrored[:, None], back, action) * action_scale())


class Stops:
    """A robot behind a strap that does nothing before its stops, for some simulations of a `WalkEnv`.

    Along the path the robot keeps its distance below a speed; sideways and about the vertical it yields like a spring
    beside a damper. Forces are renewed at every control step, which their stiffness has to bear.

    Parameters
    ----------
    rows
        Simulations (k,) that hang in such a strap.
    speed
        Highest of their robots (k,) [m/s].
    settings
        Slice ``twin.training.hold.stops``.
    control_s
        Control step [s].
    """

    def __init__(
        self, rows: np.ndarray, speed: np.ndarray, settings: TwinTrainingHoldStopsSettings, control_s: float
    ):
        self.rows, self._speed, self._control_s = rows, speed, control_s
        self._play = np.array([settings["along_m"], settings["lateral_m"], np.radians(settings["yaw_deg"])])
        axes = [settings["robot"][name] for name in ("lateral", "yaw")]
        self._spring = np.array([a["stiffness"] for a in axes])
        self._damper = np.array([a["damping"] for a in axes])
        self._stiffness = np.array([settings["stiffness"]] * 2 + [settings["yaw_stiffness"]])
        self._damping, self._gain = settings["damping"], settings["distance_gain_per_s"]
        self._cap = settings["force_cap_n"]
        # along, lateral [m], yaw [rad] of the robot's end of the strap
        self.robot = np.zeros((len(rows), 3))

    def reset(self, ids: np.ndarray, qpos: np.ndarray) -> None:
        """Let simulations ``ids`` (n,), in rising order, start at ``qpos`` (n, 28) amid the strap's play."""
        which, where = np.isin(self.rows, ids), np.searchsorted(ids, self.rows)
        self.robot[which] = 0.0
        self.robot[which, 0] = qpos[where[which], 0]

    def force(self, root: RootState) -> np.ndarray:
        """Forward and lateral force and yaw torque (k, 3) on the pelvis [N, Nm] over the next control step."""
        r, dt = self.rows, self._control_s
        pose, along = np.column_stack([root.position[r, :2], root.yaw[r]]), root.velocity[r, 0]
        # it follows the person and keeps the distance, as fast as it may
        speed = np.clip(along + self._gain * (pose[:, 0] - self.robot[:, 0]), 0.0, self._speed)
        self.robot[:, 0] += speed * dt
        stretch = pose - self.robot
        beyond = stretch - np.clip(stretch, -self._play, self._play)
        force = -self._stiffness * beyond
        force[:, 0] -= np.where(beyond[:, 0] != 0, self._damping * (along - speed), 0.0)
        # a stop only pushes back
        force[:, 0] = np.where(force[:, 0] * beyond[:, 0] < 0, force[:, 0], 0.0)
        force = np.clip(force, -self._cap, self._cap)
        self.robot[:, 1:] += (-force[:, 1:] - self._spring * self.robot[:, 1:]) / self._damper * dt
        return force


class WalkEnv:
    """``nsim`` people walking after a reference; arrays in, arrays out.

    Parameters
    ----------
    who, human, reference
        The person, the slice ``twin.human``, and the gait to follow.
    settings
        Slice ``twin.training`` of the configuration.
    nsim, threads, seed
        Simulations, threads that step them (results are the same bits with any number), and seed.
    """

    def __init__(
        self,
        who: Body,
        human: TwinHumanSettings,
        reference: Reference,
        settings: TwinTrainingSettings,
        *,
        nsim: int,
        threads: int,
        seed: int,
    ):
        self.who, self.reference, self.settings = who, reference, settings
        spec = human_spec(who, human)
        add_heel_sensors(spec)
        self.model = spec.compile()
        self.batch = untimed_batch(self.model, nsim, threads)
        self.nsim = nsim
        self.substeps = int(human["substeps"])
        self.control_s = self.substeps * self.model.opt.timestep
        self.kp = gains(who)
        self.rng = np.random.default_rng(seed)
        self._qpos, self._qvel = (self.batch.bind(n) for n in ("qpos", "qvel"))
        self._warm, self._push = self.batch.bind("qacc_warmstart"), self.batch.bind("xfrc_applied")
        self._floor_force = np.zeros(nsim)  # see `floor_force_bw` [N]
        self._slip_sq = np.zeros(nsim)  # of the last control step, see `slip_sq`
        self.off_speed = np.zeros(nsim)  # speed less the one that is meant, over about a stride [m/s]
        self._fixed_shares: np.ndarray | None = None
        self.phase = np.zeros(nsim)
        self.age = np.zeros(nsim, int)
        self.lane_y = np.zeros(nsim)
        self._last = np.zeros((nsim, ACTIONS))
        self.push_force = 0.0
        self._drag = np.zeros(nsim)
        self._spring = np.zeros((nsim, 4))  # lateral, vertical [N/m], roll, pitch [Nm/rad]
        self.stops: Stops | None = None
        self.sustained = False  # whether some pushes last, as a robot's drag does
        self.impulse = np.zeros((nsim, 2))  # push on each pelvis now, forward and to the left [N]
        self._push_left = np.zeros(nsim, int)
        self._push_next = np.zeros(nsim, int)
        self._weights = np.array([_WEIGHT.get(base_name(j), 0.7) for j in COMMANDED])
        self._height = float(reference.height_at(1.0))
        self._strap_height = np.full(nsim, self._height)  # of the pelvis, where vertical springs rest [m]
        self.mirrored = np.zeros(nsim, bool)
        # speed that each means to walk at, as a share of their own, and where it goes to; alike for all without `vary`
        self.share, self.share_goal = np.ones(nsim), np.ones(nsim)
        self._speeds: TwinTrainingSpeedsSettings | None = None
        self._held_share = np.full(nsim, np.nan)

    def hold(self, settings: TwinTrainingHoldSettings) -> None:
        """Hold the pelvis of a share of the simulations as a strap and a robot would: springs, dampers, a slower speed.

        ``settings`` is ``twin.training.hold``; its values are the largest, drawn once per simulation. The damper along
        the path pulls toward a speed within ``speed`` (shares of the person's own); of those held, a share is only
        towed by it. The others have springs and an inertia in yaw as well. Springs rest in the lane, upright, at the
        mean height of the gait at the held speed, at which the arms of coupled walks stand: whoever walks slower takes
        shorter steps and is higher. Another share of the simulations hangs in a strap that does nothing before its
        stops (`Stops`).
        """
        rng, n = self.rng, self.nsim
        drawn = rng.uniform(size=n)
        held = drawn < settings["share"]
        whole = held & (rng.uniform(size=n) >= settings["towed"])
        damping, armature = self.batch.expand("dof_damping"), self.batch.expand("dof_armature")
        most: Mapping[str, Any] = settings["damping"]
        for dof, name in enumerate(("along", "lateral", "vertical", "roll", "pitch", "yaw")):
            some = held if name == "along" else whole
            damping[:, dof] = np.where(some, rng.uniform(0, most[name], n), 0.0)
        # a strap is no stiffer on a heavy person, but lifts a light one by more of their weight
        stiffest: Mapping[str, Any] = settings["stiffness"]
        light = min(1.0, self.who.mass_kg / 75)
        for axis, name in enumerate(("lateral", "vertical", "roll", "pitch")):
            self._spring[:, axis] = np.where(whole, light * rng.uniform(0, stiffest[name], n), 0.0)
        armature[:, 5] = np.where(whole, rng.uniform(0, settings["yaw_inertia"], n), 0.0)
        # a damper about a moving frame is a damper about the world and a constant force
        speed = self.reference.speed * self._between(settings["speed"], n)
        self._drag = damping[:, 0] * speed
        self._held_share[held] = speed[held] / self.reference.speed
        self._strap_height[held] = self.reference.height_at(self._held_share[held])
        loose = ~held & (drawn < settings["share"] + settings["stops"]["share"])
        if loose.any():
            self._held_share[loose] = speed[loose] / self.reference.speed
            self.stops = Stops(np.flatnonzero(loose), speed[loose], settings["stops"], self.control_s)

    def vary(self, settings: TwinTrainingSpeedsSettings) -> None:
        """Let everybody mean to walk at a speed of their own; ``settings`` is ``twin.training.speeds``.

        Call it after `hold`: whoever is held knows the speed of what holds them in a share of the episodes.
        """
        if self.reference.speeds is None:
            raise ValueError("the reference knows one speed alone")
        known = self.reference.speeds.shares
        low, high = settings["range"]
        self._speeds = {**settings, "range": [max(low, float(known[0])), min(high, float(known[-1]))]}

    def walk_at(self, shares: np.ndarray) -> None:
        """Let everybody mean to walk at shares (nsim,) of the own speed from the next start on."""
        if self.reference.speeds is None:
            raise ValueError("the reference knows one speed alone")
        self._fixed_shares = shares

    def _draw_speeds(self, ids: np.ndarray) -> None:
        """Draw the speed at the start of an episode and the one that it goes over to."""
        if self._fixed_shares is not None:
            self.share[ids] = self.share_goal[ids] = self._fixed_shares[ids]
            return
        if self._speeds is None:
            return
        s, n, rng = self._speeds, len(ids), self.rng
        drawn = np.where(rng.uniform(size=n) < s["own"], 1.0, self._between(s["range"], n))
        held = self._held_share[ids] * self._between(s["lead"], n)
        knows = self._held[ids] & (rng.uniform(size=n) < s["held_knows"])
        drawn = np.where(knows, held, drawn)
        self.share[ids] = np.clip(drawn, s["range"][0], s["range"][1])
        other = (rng.uniform(size=n) < s["changes"]) & ~knows
        self.share_goal[ids] = np.where(other, self._between(s["range"], n), self.share[ids])

    @property
    def _held(self) -> np.ndarray:
        """Mask (nsim,) of pelvises that something holds: nobody there walks as fast as they mean to."""
        return np.asarray(np.isfinite(self._held_share))

    @property
    def _now(self) -> np.ndarray | float:
        """Shares (nsim,), or 1 where everybody walks at the own speed."""
        return 1.0 if self._speeds is None and self._fixed_shares is None else self.share

    def reset(self, ids: np.ndarray, noise: float = 1.0, phase: np.ndarray | None = None) -> None:
        """Start simulations ``ids`` (n,) at phases (n,) of the reference, random without one, with or without noise."""
        n, rng = len(ids), self.rng
        self.phase[ids] = rng.uniform(0, 1, n) if phase is None else phase
        self._draw_speeds(ids)
        now = self._now if np.ndim(self._now) == 0 else self.share[ids]
        qpos, qvel, _ = self.reference.at(self.phase[ids], now)
        qpos, qvel = qpos.copy(), qvel.copy()
        if noise:
            qpos[:, 7:] += noise * 0.03 * rng.standard_normal((n, qpos.shape[1] - 7))
            qvel[:, 6:] += noise * 0.15 * rng.standard_normal((n, qvel.shape[1] - 6))
            qvel[:, :2] += noise * 0.06 * rng.standard_normal((n, 2))
            qvel[:, 3:6] += noise * 0.08 * rng.standard_normal((n, 3))
        qpos[:, 2] += 0.002
        self._qpos[ids], self._qvel[ids], self._warm[ids] = qpos, qvel, 0.0
        self.impulse[ids] = 0.0
        if self.stops is not None:
            self.stops.reset(ids, qpos)
        self.lane_y[ids] = 0.0
        self._last[ids] = 0.0
        self.off_speed[ids] = 0.0
        self.age[ids] = 0
        self._push_left[ids] = 0
        self._push_next[ids] = self._pause(n)

    def _pause(self, n: int) -> np.ndarray:
        return np.asarray((self._between(self.settings["push"]["every_s"], n) / self.control_s).astype(int))

    def _between(self, limits: list[float], n: int) -> np.ndarray:
        return self.rng.uniform(limits[0], limits[1], n)

    def root(self) -> RootState:
        """State of the pelvis now."""
        return RootState(
            self._qpos[:, :3], self._qvel[:, :3], rotations(self._qpos[:, 3:7]), self._qvel[:, 3:6]
        )

    def observation(self) -> np.ndarray:
        """Return what the policy sees now (nsim, OBSERVATIONS)."""
        obs, self.mirrored = observe(
            self.reference,
            self.phase,
            self.root(),
            self._qpos[:, 7:],
            self._qvel[:, 6:],
            self.lane_y,
            share=self._now,
        )
        return obs

    def _schedule_pushes(self) -> None:
        self._push_next -= 1
        self._push_left -= 1
        self.impulse[self._push_left == 0] = 0.0
        begin = np.flatnonzero(self._push_next <= 0)
        if len(begin):
            push = self.settings["push"]
            force = self.rng.uniform(-self.push_force, self.push_force, (len(begin), 2))
            seconds = self._between(push["lasts_s"], len(begin))
            if self.sustained:
                long = self.rng.uniform(size=len(begin)) < push["sustained"]["share"]
                # what a light person can lean against for seconds is less
                lasting = push["sustained"]["force_n"] * self.who.mass_kg / 75
                force[long] *= min(1.0, lasting / max(push["force_n"], 1e-9))
                seconds = np.where(long, self._between(push["sustained"]["lasts_s"], len(begin)), seconds)
            lasts = np.maximum((seconds / self.control_s).round().astype(int), 1)
            self.impulse[begin] = force
            self._push_left[begin] = lasts
            self._push_next[begin] = lasts + self._pause(len(begin))

    def _apply_forces(self) -> None:
        """Write drag, springs, pushes and stops into the simulations."""
        on_pelvis, root = self._push[:, 1], self.root()
        on_pelvis[:] = 0.0
        on_pelvis[:, :2] = self.impulse
        on_pelvis[:, 0] += self._drag
        turn = root.rotation
        away = np.column_stack(
            [
                root.position[:, 1] - self.lane_y,
                root.position[:, 2] - self._strap_height,
                turn[:, 2, 1],
                -turn[:, 2, 0],
            ]
        )
        on_pelvis[:, 1:5] -= self._spring * away
        if self.stops is not None:
            force = self.stops.force(root)
            on_pelvis[self.stops.rows, :2] += force[:, :2]
            on_pelvis[self.stops.rows, 5] += force[:, 2]

    def command(self, action: np.ndarray) -> np.ndarray:
        """Servo targets (nsim, 21) [rad] for actions (nsim, 13)."""
        correction = correction_of(np.clip(action, -1.5, 1.5), self.mirrored)
        return servo_target(self.reference, self.phase, self.control_s, self.kp, correction, share=self._now)

    def step(self, action: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Act for a control step; returns reward (nsim,) and whether each fell or left its lane (nsim,)."""
        if self.push_force:
            self._schedule_pushes()
        self._apply_forces()
        control = np.repeat(self.command(action)[:, None], self.substeps, axis=1)
        record = self.batch.rollout(self.substeps, control, record=("qfrc_constraint", "sensordata"))
        self._slip_sq = slip_sq(record["sensordata"])
        self._floor_force = record["qfrc_constraint"][:, :, 2].max(axis=1)
        self.advance()
        reward = self._reward(action)
        self._last = action.copy()
        fallen = self.fallen() | self.off_lane()
        return np.where(fallen, reward - 1.0, reward), fallen

    def advance(self) -> None:
        """Let a control step pass: clock, age, and the speed that goes over to another."""
        self.phase = np.mod(self.phase + self.control_s / self.reference.stride_at(self._now), 1.0)
        self.age += 1
        if self._speeds is not None:
            most = self._speeds["rate_per_s"] * self.control_s
            self.share += np.clip(self.share_goal - self.share, -most, most)

    def fallen(self) -> np.ndarray:
        """Return who lies or hangs (nsim,): pelvis below three quarters of its height, or tilted beyond 33 degrees."""
        root = self.root()
        z, finite = root.position[:, 2], np.isfinite(self._qpos).all(axis=1)
        return np.asarray(~finite | (z < 0.75 * self._height) | (root.tilt_sq > 0.3))

    def off_lane(self) -> np.ndarray:
        """Return who has turned by more than 1 rad or strayed by more than 1.5 m (nsim,)."""
        root = self.root()
        return np.asarray((np.abs(root.yaw) > 1.0) | (np.abs(root.position[:, 1] - self.lane_y) > 1.5))

    def floor_force_bw(self) -> np.ndarray:
        """Largest vertical force of the floor in the simulation steps of the last control step (nsim,) [body weights].

        A strike lasts for few of them, and an examination looks at each: a walker that is judged by one step of every
        control step can strike between those unpunished.
        """
        return self._floor_force / self.who.weight

    def _reward(self, action: np.ndarray) -> np.ndarray:
        w = self.settings["reward"]
        ref_q, ref_v, _ = self.reference.at(self.phase, self._now)
        root = self.root()
        dq = self._qpos[:, 7 : 7 + ACTIONS] - ref_q[:, 7 : 7 + ACTIONS]
        dqd = self._qvel[:, 6 : 6 + ACTIONS] - ref_v[:, 6 : 6 + ACTIONS]
        dv = root.velocity[:, :2] - ref_v[:, :2]
        # within a stride a person's speed is not that of the reference: what lasts is what counts
        self.off_speed += (dv[:, 0] - self.off_speed) * self.control_s / self.reference.stride_s
        y = np.clip(root.position[:, 1] - self.lane_y - ref_q[:, 1], -0.4, 0.4)
        posture = np.exp(
            -60 * (root.position[:, 2] - ref_q[:, 2]) ** 2 - 12 * root.tilt_sq - 6 * root.yaw**2 - 4 * y**2
        )
        motion = np.exp(-6 * np.sum(dv**2, axis=1) - 0.15 * np.sum(root.spin**2, axis=1))
        landing = np.maximum(self.floor_force_bw() - w["force_from_bw"], 0) ** 2
        reward: np.ndarray = (
            w["pose"] * np.exp(-w["pose_sharpness"] * (dq**2 @ self._weights))
            + 0.1 * np.exp(-0.03 * np.sum(dqd**2, axis=1))
            + 0.25 * posture
            + 0.25 * motion
            - 0.004 * np.sum(action**2, axis=1)
            - 0.006 * np.sum((action - self._last) ** 2, axis=1)
            - w["force"] * np.minimum(landing, 4.0)
            - w["slip"] * np.minimum(self._slip_sq, _FAST_SLIP**2)
            - w["speed"] * np.where(self._held, 0.0, np.minimum(self.off_speed**2, _FAR_OFF**2))
        )
        return reward
