"""Examination of a policy, coupled walks and their tables, as the workflow runs them."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pyarrow.parquet as pq

from real2sim.artefacts import number, read_json, read_table, write_json, write_table
from real2sim.errors import InputError
from real2sim.geometry import AXES
from real2sim.inference.parameters import PARAMETERS, as_dict, as_vector
from real2sim.provenance import fingerprint, provenance, sha256
from real2sim.recording.ingest import WRENCH
from real2sim.recording.pose_table import read_pose
from real2sim.recording.trial import load_limits
from real2sim.study.twin import adaptation
from real2sim.study.twin.coupled import (
    Condition,
    CoupledWalk,
    FreeWalk,
    Recording,
    height_of_interface,
    strap_vectors,
)
from real2sim.study.twin.evaluate import (
    PUSH_DIRECTIONS,
    PUSH_PHASES,
    accepted,
    battery_of,
    environment,
    free_walk,
    keeps_speeds,
    plain,
    pushed_walk,
    speeds_of,
    walkers_at_speeds,
    withstands,
)
from real2sim.study.twin.gait import SAGITTAL, Walk
from real2sim.study.twin.human import Body
from real2sim.study.twin.policy import Policy, load_policy
from real2sim.study.twin.reference import PACKAGES, read_walks
from real2sim.study.twin.robots import CompliantRobot, WalkingRobot
from real2sim.study.twin.study_robot import StudyRobot
from real2sim.system.plant import JointLimits, RestPose

if TYPE_CHECKING:
    from real2sim.settings import IngestSettings, Settings, TwinCoupledSettings, TwinSettings

# Normalised strides (k, 101) [degrees] by sagittal joint
Cycles = dict[str, np.ndarray]
# Rest pose, joint limits, and mean vertical stretch while walking [m]
Interface = tuple[RestPose, JointLimits | None, float]


def examined(learnt: Policy, settings: TwinSettings, threads: int) -> dict[str, Any]:
    """Examine a policy as a free walker; return what it does and the bars met. ``settings`` is the slice ``twin``."""
    e, bars = settings["evaluation"], settings["acceptance"]
    env = environment(learnt, settings, nsim=e["walkers"], threads=threads, seed=0)
    walk = free_walk(env, learnt, seconds=e["walk_s"], settle_s=e["settle_s"])
    crowd = environment(learnt, settings, nsim=PUSH_DIRECTIONS * PUSH_PHASES, threads=threads, seed=1)
    pushes = [
        pushed_walk(crowd, learnt, force_n=f, minutes=e["push_minutes"], settle_s=e["settle_s"])
        for f in e["push_n"]
    ]
    battery = battery_of(crowd, learnt, e)
    met = accepted(walk, bars)
    met["pushes"] = withstands(pushes[0], bars)
    met["battery"] = battery["survived_share"] >= bars["battery_share"]
    found = {"met": met, "walk": plain(walk), "pushes": plain(pushes), "battery": battery, "bars": bars}
    if learnt.reference.speeds is not None and e["shares"]:
        env = environment(learnt, settings, nsim=walkers_at_speeds(e), threads=threads, seed=0)
        found["speeds"] = speeds_of(env, learnt, e)
        met["speeds"] = keeps_speeds(found["speeds"], bars)
    return found


def twin_evaluate(*, policy: Path, record: Path, settings: TwinSettings, out: Path, threads: int = 1) -> None:
    """Examine a policy against every bar of a free walker; ``settings`` is the slice ``twin``."""
    found = examined(load_policy(policy), settings, threads)
    about = read_json(record, ("phantom", "seed"))
    write_json(
        out,
        {"phantom": about["phantom"], "seed": about["seed"]} | found | {"policy_sha256": sha256(policy)},
    )


def best_fit(fits: list[Path]) -> np.ndarray | None:
    """Return a person's own parameters (12,): geometric mean over trials of the best restarts; None without fits."""
    by_trial: dict[str, dict[str, Any]] = {}
    for path in fits:
        fit = read_json(path, ("trial", "cost", "parameters"))
        known = by_trial.get(fit["trial"])
        if known is None or fit["cost"]["J"] < known["cost"]["J"]:
            by_trial[fit["trial"]] = fit
    if not by_trial:
        return None
    rows = [as_vector(fit["parameters"]) for fit in by_trial.values()]
    return np.asarray(np.exp(np.mean(np.log(rows), axis=0)))


def read_prior(path: Path) -> np.ndarray:
    """Read the prior (12,) of priors.csv or of the published table."""
    rows = {row["parameter"]: number(row["prior"]) for row in read_table(path, ("parameter", "prior"))}
    return np.array([rows[name] for name in PARAMETERS])


def read_paper(gait: Path, interface: Path) -> dict[str, Any]:
    """Read the paper's figures by condition: ``angles`` [deg] by joint (Table III), ``cloud`` [mm] (Table II)."""
    angles: dict[str, dict[str, dict[str, float]]] = {}
    columns = ("rom_deg", "rom_sd_deg", "peak_deg")
    for row in read_table(gait, ("joint", "condition", *columns)):
        angles.setdefault(row["joint"], {})[row["condition"]] = {name: number(row[name]) for name in columns}
    spread = ("sigma_x_mm", "sigma_y_mm", "sigma_z_mm", "gamma")
    rows = read_table(interface, ("condition", *spread))
    return {
        "angles": angles,
        "cloud": {row["condition"]: {name: number(row[name]) for name in spread} for row in rows},
    }


@dataclass(frozen=True)
class Measured:
    """A person's own walks, by kind, their joint cycles, and the logged wrench over strides (k, 101, 6).

    ``rest`` (3, 3) is the interface's rotation in the pelvis frame while standing.
    """

    walks: dict[str, list[Walk]]
    cycles: dict[str, Cycles]
    wrench: np.ndarray
    rest: np.ndarray

    @classmethod
    def read(cls, normal: list[Path], assisted: list[Path], who: Body, rest: np.ndarray) -> Measured:
        """Read the folders of the walk_normal and walk_robot trials; ``rest`` (3, 3) as in the class."""
        walks = {"walk_normal": read_walks(normal, who), "walk_robot": read_walks(assisted, who)}
        cycles = {name: adaptation.measured_cycles(found) for name, found in walks.items() if found}
        logged = [_logged_wrench(folder) for folder in assisted]
        return cls(walks, cycles, adaptation.measured_wrench_cycles(walks["walk_robot"], logged), rest)

    @property
    def phantom(self) -> bool:
        """True where any of the walks is a synthetic person's."""
        return any(walk.phantom for found in self.walks.values() for walk in found)

    def describe(self, assisted: list[Path], filters: IngestSettings) -> dict[str, Any]:
        """Return joints, gait, cloud and wrench of the measured walks; ``filters`` is the slice ``ingest``."""
        described = {name: adaptation.describe(cycles) for name, cycles in self.cycles.items()}
        for name, found in described.items():
            found["gait"] = adaptation.measured_gait(self.walks[name])
        cloud = _measured_cloud(assisted, filters)
        return {**described, "cloud": cloud, "wrench": adaptation.wrench_of(self.wrench)}


def walking_robots(twin: TwinSettings, compliant: Path, study: Path) -> list[WalkingRobot]:
    """Return the robots of ``twin.coupled.robots`` in their order, from the MJCF of each."""
    made: dict[str, WalkingRobot] = {
        "compliant": CompliantRobot(compliant, twin["follow"]),
        "study": StudyRobot(study, twin["study_robot"]),
    }
    return [made[name] for name in twin["coupled"]["robots"]]


def conditions_of(
    prior: np.ndarray,
    own: np.ndarray | None,
    coupled: TwinCoupledSettings,
    robot: WalkingRobot,
    main_cap: float,
) -> list[Condition]:
    """Return every coupling to simulate: four interfaces at each cap, the robot's constants under the prior.

    ``prior`` and ``own`` are strap parameters (12,) [SI].
    """
    straps = strap_vectors({name: coupled[name] for name in ("soft", "stiff")})
    straps = {"soft": straps["soft"], "prior": prior, "stiff": straps["stiff"]}
    if own is not None:
        straps["own"] = own
    caps = sorted({main_cap, *map(float, coupled["speed_caps"])})
    gaits = [gait == "aware" for gait in coupled["gaits"]]
    out = [
        Condition(name, v, cap, (), aware) for aware in gaits for name, v in straps.items() for cap in caps
    ]
    factors = coupled["study_sensitivity" if robot.name == "study" else "sensitivity"]
    for constant in robot.constants:
        for factor in factors:
            out.append(Condition("prior", prior, main_cap, ((constant, float(factor)),), gaits[0]))
    return out


def cap_to_compare(assisted: list[Walk], own_speed: float, coupled: TwinCoupledSettings) -> tuple[float, str]:
    """Return the speed cap that is compared with the measurement, as a share of ``own_speed`` [m/s], and its source."""
    if coupled["cap_from"] == "own" and assisted:
        speed = float(np.mean([walk.speed for walk in assisted]))
        return round(speed / own_speed, 4), "own walks with the robot"
    return float(coupled["main_cap"]), "twin.coupled.main_cap"


def twin_coupled(
    *,
    policy: Path,
    record: Path,
    priors: Path,
    fits: list[Path],
    limits: Path,
    neutral: Path,
    normal: list[Path],
    assisted: list[Path],
    robot: Path,
    study_robot: Path,
    published_gait: Path,
    published_interface: Path,
    settings: Settings,
    out: Path,
    threads: int = 1,
) -> None:
    """Walk with the robot under every interface and compare with the person's own walks.

    Parameters
    ----------
    policy, record
        Of `twin_train`.
    priors, fits, limits
        Prior table, the person's fits (none for a person who was not fitted), joint limits.
    neutral, normal, assisted
        pose.parquet of the neutral trial, folders of the walk_normal and walk_robot trials.
    robot, study_robot
        MJCF of the compliant robot and of the study's.
    published_gait, published_interface
        The paper's Tables III and II, to stand beside the figures found here.
    settings
        Slices ``twin``, ``plant`` and ``ingest``.
    """
    twin, learnt = settings["twin"], load_walker(policy, settings["twin"]["coupled"])
    prior, own = read_prior(priors), best_fit(fits)
    interface = _interface_of(neutral, limits, assisted)
    person = Measured.read(normal, assisted, learnt.body, interface[0].rotation)
    cap, source = cap_to_compare(person.walks["walk_robot"], learnt.reference.speed, twin["coupled"])
    free = walk_free(learnt, twin, cap, threads)
    height = height_walked(free, cap, learnt.body, interface[0])
    conditions: list[dict[str, Any]] = []
    for machine in walking_robots(twin, robot, study_robot):
        asked = conditions_of(prior, own, twin["coupled"], machine, cap)
        recording = _walk(learnt, asked, machine, interface, height, settings, threads)
        conditions += _compare(recording, asked, machine, cap, person, settings)
    sources = [policy, priors, limits, neutral, robot, study_robot, *fits]
    content = {
        **_about(record, person, priors, fits),
        "parameters": {"prior": as_dict(prior), "own": None if own is None else as_dict(own)},
        **_settings_of(twin, learnt.reference.speed, cap, source),
        **_free(free, height, person),
        "conditions": conditions,
        "measured": person.describe(assisted, settings["ingest"]),
        "paper": read_paper(published_gait, published_interface),
        "policy_sha256": sha256(policy),
        "provenance": provenance(sources, PACKAGES, fingerprint(__name__)),
    }
    write_json(out, plain(content))


def _about(record: Path, person: Measured, priors: Path, fits: list[Path]) -> dict[str, Any]:
    """Return the policy's seed, and whether anything that is compared rests on synthetic people.

    That is policy, walks, priors or fits; published priors do not.
    """
    about = read_json(record, ("phantom", "seed"))
    found = [row.get("phantom") == "true" for row in read_table(priors, ("parameter", "prior"))]
    found += [bool(read_json(path).get("phantom", False)) for path in fits]
    return {"phantom": about["phantom"] or person.phantom or any(found), "seed": about["seed"]}


def load_walker(path: Path, coupled: TwinCoupledSettings) -> Policy:
    """Read a policy for coupled walks; ``coupled`` is the slice ``twin.coupled``.

    Raises
    ------
    InputError
        Where an aware person is asked for and the policy knows one speed alone.
    """
    policy = load_policy(path)
    if "aware" in coupled["gaits"] and policy.reference.speeds is None:
        found, expected = "a policy that knows one speed alone", "other speeds, for an aware gait"
        remedy = "Set twin.reference.speeds.shares and train again, or twin.coupled.gaits: [fixed]."
        raise InputError(path, "twin.coupled.gaits", found, expected, remedy)
    return policy


def _settings_of(twin: TwinSettings, own_speed: float, cap: float, source: str) -> dict[str, Any]:
    """Return the settings of the robots, and which robot and cap are compared with the measurement."""
    return {
        "own_speed_m_per_s": own_speed,
        "main_cap": cap,
        "main_cap_from": source,
        "follow": twin["follow"],
        "study_robot": twin["study_robot"],
        "cadence_exponent": twin["coupled"]["cadence_exponent"],
        "main_robot": twin["coupled"]["robots"][0],
    }


def _interface_of(neutral: Path, limits: Path, assisted: list[Path]) -> Interface:
    """Return rest pose, joint limits and vertical stretch while walking [m] of a person's interface."""
    rest = read_pose(neutral)[1]["rest"]
    pose = RestPose(np.array(rest["rotation"]), np.array(rest["position"]))
    return pose, load_limits(limits), vertical_stretch(assisted)


def vertical_stretch(assisted: list[Path]) -> float:
    """Return the mean q_tz [m] of the steady part of walk_robot trials, of their folders; 0 without any."""
    heights = [read_pose(folder / "pose.parquet")[0]["q_tz"][_steady_rows(folder)] for folder in assisted]
    known = np.concatenate([h[np.isfinite(h)] for h in heights]) if heights else np.zeros(0)
    return float(known.mean()) if len(known) else 0.0


def _walk(
    learnt: Policy,
    conditions: list[Condition],
    robot: WalkingRobot,
    interface: Interface,
    height_m: float | None,
    settings: Settings,
    threads: int,
) -> Recording:
    """Walk with a robot under every condition; ``height_m`` as of `CoupledWalk`."""
    twin = settings["twin"]
    walk = CoupledWalk(
        learnt,
        twin=twin,
        plant=settings["plant"],
        robot=robot,
        rest=interface[0],
        limits=interface[1],
        conditions=conditions,
        walkers=twin["coupled"]["walkers"],
        height_m=height_m,
        stretch_m=interface[2],
        threads=threads,
    )
    return walk.run(twin["coupled"]["walk_s"])


@dataclass(frozen=True)
class FreeWalks:
    """Walks without a robot, as many ``walkers`` at each of ``shares`` of the own speed, one after the other.

    They have settled after ``settle_s`` [s].
    """

    shares: list[float]
    walkers: int
    recording: Recording
    settle_s: float

    def at(self, index: int) -> Recording:
        """Return the walkers of one of the shares."""
        return self.recording.of(np.arange(index * self.walkers, (index + 1) * self.walkers))


def walk_free(learnt: Policy, twin: TwinSettings, main_cap: float, threads: int) -> FreeWalks:
    """Walk without a robot at the own speed, and as slow as the robot's caps where the policy knows other speeds.

    ``twin`` is the slice of the configuration, ``main_cap`` a share of the own speed.
    """
    coupled = twin["coupled"]
    caps = sorted({main_cap, *map(float, coupled["speed_caps"])} - {1.0})
    shares = [1.0, *(caps if learnt.reference.speeds is not None else [])]
    walk = FreeWalk(learnt, twin=twin, walkers=coupled["walkers"], threads=threads, shares=shares)
    return FreeWalks(shares, coupled["walkers"], walk.run(coupled["walk_s"]), coupled["settle_s"])


def height_walked(free: FreeWalks, main_cap: float, who: Body, rest: RestPose) -> float | None:
    """Return the mean height [m] over the floor of an unloaded interface while walking, where an arm is set up for it.

    That of the walk without a robot at the speed that is compared, ``main_cap`` of the own one, or at the own speed
    where the policy knows no other. A policy does not walk at the very height of its reference. None where all fell.
    """
    part = free.at(free.shares.index(main_cap) if main_cap in free.shares else 0)
    part = part.of(np.flatnonzero(part.alive))
    return height_of_interface(part, who, rest, free.settle_s) if len(part.alive) else None


def _free(free: FreeWalks, height_m: float | None, person: Measured) -> dict[str, Any]:
    """Return ``free`` and ``free_at_speeds`` of the file: walks without a robot, also as slow as its caps.

    ``height_of_interface_m`` beside them is where the robots' arms are set up (`height_walked`).
    """
    joints, gaits, upright = [], [], []
    for k in range(len(free.shares)):
        part = free.at(k)
        beside = person.cycles.get("walk_robot" if k else "walk_normal")
        upright.append({"walkers": free.walkers, "survived": int(part.alive.sum())})
        part = part.of(np.flatnonzero(part.alive))
        joints.append(adaptation.describe(adaptation.cycles_of(part, free.settle_s), beside))
        gaits.append(adaptation.gait_of(part, free.settle_s))
    rows = zip(free.shares[1:], joints[1:], gaits[1:], upright[1:], strict=True)
    return {
        "free": {**joints[0], "gait": gaits[0], **upright[0]},
        "free_at_speeds": [{"share": s, "joints": j, "gait": g, **n} for s, j, g, n in rows],
        "height_of_interface_m": height_m,
    }


def _compare(
    recording: Recording,
    conditions: list[Condition],
    robot: WalkingRobot,
    main_cap: float,
    person: Measured,
    settings: Settings,
) -> list[dict[str, Any]]:
    """Return what the walkers of each condition did, beside the person's own walks with the robot."""
    coupled, filters = settings["twin"]["coupled"], settings["ingest"]
    settle, walkers = coupled["settle_s"], coupled["walkers"]
    rows = []
    for k, condition in enumerate(conditions):
        part = recording.of(np.arange(k * walkers, (k + 1) * walkers))
        found = _condition(part, condition, settle, person, filters)
        main = condition.cap == main_cap and condition.aware == (coupled["gaits"][0] == "aware")
        rows.append({**found, "robot": robot.name, "aware": condition.aware, "main": main})
    return rows


def _condition(
    part: Recording,
    condition: Condition,
    settle_s: float,
    person: Measured,
    filters: IngestSettings,
) -> dict[str, Any]:
    """Return what the walkers of one condition did after settling; ``filters`` is the slice ``ingest``."""
    after = part.time_s >= settle_s
    rate = 1 / float(part.time_s[1] - part.time_s[0])
    q = part.interface[:, after]
    lasting = part.alive
    upright = part.of(np.flatnonzero(lasting))
    cycles = adaptation.cycles_of(upright, settle_s)
    wrench = adaptation.wrench_cycles(upright, adaptation.on_interface(upright, person.rest), settle_s)
    return {
        "name": condition.name,
        "cap": condition.cap,
        "robot_factors": dict(condition.factors),
        "walkers": len(lasting),
        "survived": int(lasting.sum()),
        "survived_s": part.survived_s.tolist(),
        "gait": adaptation.gait_of(upright, settle_s),
        "joints": adaptation.describe(cycles, person.cycles.get("walk_robot")),
        "cloud": adaptation.cloud(q[lasting], rate, filters["cutoff_hz"], filters["filter_order"]),
        "wrench": adaptation.wrench_of(wrench, person.wrench),
    }


def _measured_cloud(assisted: list[Path], filters: IngestSettings) -> dict[str, Any]:
    """Return the cloud of the steady part of the measured walks with the robot."""
    trials = []
    for folder in assisted:
        columns, _ = read_pose(folder / "pose.parquet")
        q = np.column_stack([columns[f"q_{axis}"] for axis in AXES])
        trials.append(q[_steady_rows(folder)])
    if not trials:
        return {"trials": 0}
    return adaptation.cloud(trials, filters["rate_hz"], filters["cutoff_hz"], filters["filter_order"])


def _steady_rows(folder: Path) -> np.ndarray:
    """Return the samples of a walk at 85 % of its usual speed or more."""
    table = pq.read_table(folder / "pose.parquet", columns=["time_s", "pelvis_x", "pelvis_y"])
    time_s, x, y = (table[name].to_numpy() for name in table.column_names)
    known = np.isfinite(x)
    window = 1.2  # about a stride, so that the pelvis' own motion averages out [s]
    half = round(window / 2 / float(time_s[1] - time_s[0]))
    x, y = np.interp(time_s, time_s[known], x[known]), np.interp(time_s, time_s[known], y[known])
    speed = np.zeros(len(x))
    speed[half:-half] = np.hypot(x[2 * half :] - x[: -2 * half], y[2 * half :] - y[: -2 * half]) / window
    return np.flatnonzero(speed >= 0.85 * np.percentile(speed, 90))


def _logged_wrench(folder: Path) -> tuple[np.ndarray, np.ndarray] | None:
    """Return time (n,) [s] and wrench (n, 6) on the interface of a trial's log, None where it has none."""
    table = pq.read_table(folder / "robot.parquet")
    if not all(name in table.column_names for name in WRENCH):
        return None
    return table["time_s"].to_numpy(), np.column_stack([table[name].to_numpy() for name in WRENCH])


# Straps that are compared with each other
_PAIRS = (("soft", "prior"), ("stiff", "prior"), ("stiff", "soft"), ("own", "prior"))

# First columns of a row of a walk
_PLACE = ("subject", "seed", "condition", "robot", "aware", "cap", "main")
GAIT_COLUMNS = (
    *_PLACE,
    "joint",
    "cycles",
    "rom_deg",
    "rom_sd_deg",
    "rom_change_deg",
    "peak_deg",
    "r_walk_robot",
    "rom_paper_deg",
    "survived",
    "walkers",
    "phantom",
)
CLOUD_COLUMNS = (
    *_PLACE,
    "robot_factor",
    "sigma_x_mm",
    "sigma_y_mm",
    "sigma_z_mm",
    "gamma",
    "ellipse_area_mm2",
    "gamma_paper",
    "survived",
    "walkers",
    "phantom",
)
WALK_COLUMNS = (
    *_PLACE,
    "speed_m_per_s",
    "stride_m",
    "cadence_per_min",
    "stride_speed_m_per_s",
    "stance_slip_m_per_s",
    "heel_stands_share",
    "pelvis_rotation_deg",
    "robot_speed_m_per_s",
    "survived",
    "walkers",
    "phantom",
)
FORCE_COLUMNS = (
    *_PLACE,
    "axis",
    "unit",
    "strides",
    "rms",
    "mean",
    "peak",
    "rms_ratio",
    "r",
    "phase_percent",
    "phantom",
)
STRAP_COLUMNS = (
    "subject",
    "robot",
    "aware",
    "cap",
    "joint",
    "strap",
    "against",
    "seeds",
    "difference_deg",
    "seed_sd_deg",
    "told_apart",
    "phantom",
)
BAR_COLUMNS = ("subject", "seed", "bar", "value", "limit", "met", "phantom")


def twin_table(
    *,
    evaluations: list[Path],
    coupled: list[Path],
    out_bars: Path,
    out_gait: Path,
    out_cloud: Path,
    out_walks: Path,
    out_wrench: Path,
    out_straps: Path,
) -> None:
    """Write bars of every policy; joints, gait, interface cloud and wrench of every condition; straps told apart.

    The folder of a file names the person, ``<SUBJECT>/seed-<N>/…``.
    """
    bars = [
        row for path in evaluations for row in bar_rows(path.parent.parent.name, read_json(path, ("walk",)))
    ]
    write_table(out_bars, BAR_COLUMNS, bars)
    records = [(path.parent.parent.name, read_json(path, ("conditions", "measured"))) for path in coupled]
    gait = [row for name, r in records for row in gait_rows(name, r)]
    write_table(out_gait, GAIT_COLUMNS, gait)
    write_table(out_straps, STRAP_COLUMNS, strap_rows(gait))
    write_table(out_cloud, CLOUD_COLUMNS, [row for name, r in records for row in cloud_rows(name, r)])
    write_table(out_walks, WALK_COLUMNS, [row for name, r in records for row in walk_rows(name, r)])
    write_table(out_wrench, FORCE_COLUMNS, [row for name, r in records for row in wrench_rows(name, r)])


def bar_rows(subject: str, e: dict[str, Any]) -> list[dict[str, Any]]:
    """Return one row per bar of an examination: figure, limit, met."""
    walk, bars, met = e["walk"], e["bars"], e["met"]
    figures: list[tuple[str, Any, Any, bool]] = [
        ("falls", walk["falls"], 0, met["falls"]),
        ("speed_error", walk["speed_error"], bars["speed_error"], met["speed"]),
    ]
    for row in e.get("speeds", ()):
        error, limit = row["speed_error"], bars["speed_error"]
        name = f"speed_error_at_{100 * row['share']:.0f}_percent"
        figures.append((name, error, limit, error is not None and abs(error) <= limit))
        figures.append((f"falls_at_{100 * row['share']:.0f}_percent", row["falls"], 0, row["falls"] == 0))
    for key, bar in (("rom_error_deg", "rom"), ("peak_error_deg", "peak"), ("r", "r"), ("rmse_deg", "rmse")):
        for joint in SAGITTAL:
            value, limit = walk["joints"][joint][key], bars[key][joint]
            good = value is not None and (value >= limit if bar == "r" else abs(value) <= limit)
            figures.append((f"{key}_{joint}", value, limit, good))
    peak = walk["floor_force_peak_bw"]["mean_of_strides"]
    figures += [
        ("floor_force_peak_bw", peak, bars["floor_force_bw"], met["floor_force"]),
        ("saturated_share", walk["saturated_share"], bars["saturated_share"], met["saturation"]),
        ("warnings", walk["warnings"], 0, met["warnings"]),
        (
            f"falls_per_minute_{e['pushes'][0]['force_n']:g}_N",
            e["pushes"][0]["falls_per_minute"],
            bars["falls_per_minute"],
            met["pushes"],
        ),
        ("battery_survived_share", e["battery"]["survived_share"], bars["battery_share"], met["battery"]),
    ]
    return [
        {
            "subject": subject,
            "seed": e["seed"],
            "bar": n,
            "value": v,
            "limit": limit,
            "met": ok,
            "phantom": e["phantom"],
        }
        for n, v, limit, ok in figures
    ]


def _cases(r: dict[str, Any]) -> Iterator[tuple[dict[str, Any], dict[str, Any]]]:
    """Yield the first columns of a row and what is known, of free, measured and coupled walks without factors."""
    first = {
        "seed": r["seed"],
        "phantom": r["phantom"],
        "robot": "",
        "aware": None,
        "cap": None,
        "main": True,
    }
    free = {"joints": r["free"], "gait": r["free"]["gait"]}
    yield {**first, "condition": "free", **_upright(r["free"])}, free
    for slower in r["free_at_speeds"]:
        own = {"condition": "free_at_cap", "cap": slower["share"], "aware": True, "main": False}
        yield {**first, **own, **_upright(slower)}, slower
    for name in ("walk_normal", "walk_robot"):
        if name in r["measured"]:
            known = r["measured"][name]
            wrench = r["measured"]["wrench"] if name == "walk_robot" else {}
            yield {**first, "condition": name}, {"joints": known, "gait": known["gait"], "wrench": wrench}
    for c in r["conditions"]:
        if not c["robot_factors"]:
            yield {**first, **_columns_of(c, r)}, c


def _upright(walk: dict[str, Any]) -> dict[str, Any]:
    """Return how many walkers there were and how many stayed up, as far as a file says so."""
    return {name: walk.get(name) for name in ("survived", "walkers")}


def _columns_of(c: dict[str, Any], r: dict[str, Any]) -> dict[str, Any]:
    """Return the columns that say which condition a row is of."""
    return {
        "condition": c["name"],
        "robot": c["robot"],
        "aware": c["aware"],
        "cap": c["cap"],
        "main": c["main"] and c["robot"] == r["main_robot"],
        "survived": c["survived"],
        "walkers": c["walkers"],
    }


def walk_rows(subject: str, r: dict[str, Any]) -> list[dict[str, Any]]:
    """Return one row per condition: speed, stride, cadence, slip and pelvis rotation; free, coupled and measured."""
    return [
        {"subject": subject, "survived": None, "walkers": None, **first, **known["gait"]}
        for first, known in _cases(r)
    ]


def strap_rows(gait: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return one row per pair of straps: do they change a range of motion differently, by more than seeds differ?

    ``gait`` are the rows of `gait_rows` of all seeds. Straps are told apart where their difference is larger than its
    SD over the seeds and has one sign in all of two seeds or more.
    """
    changes: dict[tuple[Any, ...], dict[Any, float]] = {}
    for row in gait:
        if row["robot"] and row["rom_change_deg"] is not None:
            key = tuple(row[name] for name in ("subject", "robot", "aware", "cap", "joint", "phantom"))
            changes.setdefault((*key, row["condition"]), {})[row["seed"]] = row["rom_change_deg"]
    out = []
    for (*place, strap), by_seed in changes.items():
        for against in ("soft", "prior", "stiff"):
            other = changes.get((*place, against), {})
            seeds = sorted(set(by_seed) & set(other))
            if against == strap or not seeds or (strap, against) not in _PAIRS:
                continue
            off = np.array([by_seed[seed] - other[seed] for seed in seeds])
            sd = float(off.std(ddof=1)) if len(off) > 1 else None
            apart = sd is not None and abs(off.mean()) > sd and bool(np.all(np.sign(off) == np.sign(off[0])))
            subject, robot, aware, cap, joint, phantom = place
            out.append(
                {
                    "subject": subject,
                    "robot": robot,
                    "aware": aware,
                    "cap": cap,
                    "joint": joint,
                    "strap": strap,
                    "against": against,
                    "seeds": len(seeds),
                    "difference_deg": float(off.mean()),
                    "seed_sd_deg": sd,
                    "told_apart": apart,
                    "phantom": phantom,
                }
            )
    return out


def wrench_rows(subject: str, r: dict[str, Any]) -> list[dict[str, Any]]:
    """Return one row per condition and axis: the strap's wrench on the interface, simulated and measured."""
    rows = []
    for first, known in _cases(r):
        for axis, found in known.get("wrench", {}).items():
            figures = {key: value for key, value in found.items() if key != "curve"}
            unit = "N" if axis.startswith("t") else "Nm"
            rows.append({"subject": subject, **first, "axis": axis, "unit": unit, **figures})
    return rows


def gait_rows(subject: str, r: dict[str, Any]) -> list[dict[str, Any]]:
    """Return one row per condition and joint: free, coupled and measured.

    A condition in which all walkers fell or took no whole stride has rows with 0 cycles and no angles.
    """
    rows = []
    for first, known in _cases(r):
        name = first["condition"]
        coupled = first["cap"] is not None
        base = r["measured"].get("walk_normal") if name in r["measured"] else r["free"] if coupled else None
        for joint in SAGITTAL:
            j = known["joints"][joint]
            rom, rom_sd = j.get("rom_deg", (None, None))
            change = None
            if rom is not None and base is not None and base[joint]["cycles"]:
                change = rom - base[joint]["rom_deg"][0]
            rows.append(
                {
                    "subject": subject,
                    "survived": None,
                    "walkers": None,
                    **first,
                    "joint": joint,
                    "cycles": j["cycles"],
                    "rom_deg": rom,
                    "rom_sd_deg": rom_sd,
                    "rom_change_deg": change,
                    "peak_deg": j["peak_deg"][0] if j["cycles"] else None,
                    "r_walk_robot": j.get("r") if coupled else None,
                    "rom_paper_deg": r["paper"]["angles"].get(joint, {}).get(name, {}).get("rom_deg"),
                }
            )
    return rows


def cloud_rows(subject: str, r: dict[str, Any]) -> list[dict[str, Any]]:
    """Return one row per condition and for the measured walks: spread of the interface about the pelvis."""
    measured = {"condition": "walk_robot", "robot": "", "aware": None, "cap": None, "main": True}
    cases = [({**measured, "survived": None, "walkers": None}, "", r["measured"]["cloud"])]
    for c in r["conditions"]:
        factor = " ".join(f"{constant} x{value:g}" for constant, value in c["robot_factors"].items())
        cases.append((_columns_of(c, r), factor, c["cloud"]))
    rows = []
    for first, factor, cloud in cases:
        sigma = cloud.get("sigma_mm", [None] * 3)
        rows.append(
            {
                "subject": subject,
                "seed": r["seed"],
                **first,
                "robot_factor": factor,
                **dict(zip(("sigma_x_mm", "sigma_y_mm", "sigma_z_mm"), sigma, strict=True)),
                "gamma": cloud.get("gamma"),
                "ellipse_area_mm2": cloud.get("ellipse", {}).get("area_mm2"),
                "gamma_paper": r["paper"]["cloud"].get(first["condition"], {}).get("gamma"),
                "phantom": r["phantom"],
            }
        )
    return rows
