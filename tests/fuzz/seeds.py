"""Small valid files of every format: by our writers, by others' libraries, by hand, and by third parties."""

import json
from pathlib import Path

import numpy as np
from real2sim.recording.formats.opensim import PELVIS_COORDINATES, write_coordinates
from real2sim.recording.formats.qualisys import write_markers
from real2sim.recording.formats.recordings import CoordinateRecording, MarkerRecording, RobotLog
from real2sim.recording.formats.robot_log import ARM_JOINTS, BASE_COLUMNS, write_log

THIRD_PARTY = Path(__file__).parents[3] / "shared" / "third_party"
TEXT_SUFFIXES = (".tsv", ".txt", ".mot", ".sto", ".trc")
LARGEST = 120_000  # bytes of a third-party seed: mutating and reading must stay quick
BAND = 10.0  # [m]: marker i lies between BAND * i and BAND * (i + 1)


def banded(n=12, count=5):
    """Markers whose every coordinate tells whose it is."""
    rng = np.random.default_rng(1)
    return {f"M {i}": BAND * (i + rng.uniform(0.1, 0.9, (n, 3))).round(5) for i in range(count)}


def band_of(name):
    i = int(name.split()[-1])
    return BAND * i, BAND * (i + 1)


def write_seeds(folder, *, third_party=True):
    """Write all seeds; returns their paths."""
    folder.mkdir(parents=True, exist_ok=True)
    _qualisys(folder)
    _opensim(folder)
    _logs(folder)
    _binary(folder)
    paths = sorted(folder.iterdir())
    if third_party and THIRD_PARTY.is_dir():
        others = [p for p in sorted(THIRD_PARTY.glob("*/*")) if p.suffix not in (".json", ".xml")]
        conformance = [p for p in others if p.parent.name == "mcap_conformance"]
        few = [p for p in others if p.parent.name != "mcap_conformance" and p.stat().st_size < LARGEST]
        paths += few + conformance[::20]
    return paths


def banded_seeds(folder):
    """TSV of three generations and TRC with banded markers; some markers are missing at the end of rows."""
    folder.mkdir(parents=True, exist_ok=True)
    positions = banded()
    for name, gap in (("full", []), ("gaps", [2, 3, 7])):
        held = {k: v.copy() for k, v in positions.items()}
        held["M 4"][gap] = np.nan
        recording = MarkerRecording(np.arange(12) / 100, 100.0, held)
        path = folder / f"{name}.tsv"
        write_markers(path, recording)
        text = path.read_text()
        (folder / f"{name}-blank.tsv").write_text(text.replace("NaN", ""))
        lines = text.replace("NaN", "").splitlines()
        data = ["\t".join(line.split("\t")[2:]) for line in lines[12:]]
        (folder / f"{name}-2010.tsv").write_text("\n".join([*lines[:10], *data]) + "\n")
        trailing = [line + "\t" for line in lines[12:]]
        (folder / f"{name}-tab.tsv").write_text("\n".join([*lines[:12], *trailing]) + "\n")
        (folder / f"{name}.trc").write_text(trc_text(held))
    return sorted(folder.iterdir())


def trc_text(positions, unit="mm", rate=100):
    names, n = list(positions), len(next(iter(positions.values())))
    head = [
        "PathFileType\t4\t(X/Y/Z)\ta.trc",
        "DataRate\tCameraRate\tNumFrames\tNumMarkers\tUnits\tOrigDataRate\tOrigDataStartFrame\tOrigNumFrames",
        f"{rate}\t{rate}\t{n}\t{len(names)}\t{unit}\t{rate}\t1\t{n}",
        "Frame#\tTime\t" + "\t\t\t".join(names),
        "\t\t" + "\t".join(f"{a}{i + 1}" for i in range(len(names)) for a in "XYZ"),
    ]
    table = np.hstack(list(positions.values())) * 1000
    rows = [
        "\t".join(
            [
                str(i + 1),
                f"{i / rate:.{2 if rate == 100 else 6}f}",
                *("" if np.isnan(v) else f"{v:.3f}" for v in row),
            ]
        )
        for i, row in enumerate(table)
    ]
    return "\n".join([*head, *rows]) + "\n"


def _qualisys(folder):
    banded_seeds(folder)
    head = "NO_OF_FRAMES\t8\nNO_OF_BODIES\t2\nFREQUENCY\t100\nDATA_INCLUDED\t6D\nBODY_NAMES\tA\tB b\n"
    cells = " X\t Y\t Z\t Roll\t Pitch\t Yaw\t Residual\t" + "\t".join(f" Rot[{i}]" for i in range(9))
    good = "1.0\t2.0\t3.0\t0.0\t0.0\t0.0\t0.2\t1.0\t0.0\t0.0\t0.0\t1.0\t0.0\t0.0\t0.0\t1.0\t"
    lost = "\t".join(["0.0"] * 6 + ["-1.00000"] + ["0.0"] * 9) + "\t"
    rows = [good + "\t" + (lost if i == 3 else good) for i in range(8)]
    (folder / "bodies_6D.tsv").write_text(head + cells + "\n" + "\n".join(rows) + "\n")


def _opensim(folder):
    t = np.arange(20) / 50
    names = (*PELVIS_COORDINATES, "knee_angle_r")
    columns = {name: np.sin(t + i) for i, name in enumerate(names)}
    write_coordinates(folder / "a.mot", CoordinateRecording(t, columns))
    values = "\n".join(f"{i / 10:.1f}\t0.{i},0.2,0.3\t1,2,{i}" for i in range(8))
    (folder / "vec3.sto").write_text(f"DataType=Vec3\nversion=3\nendheader\ntime\tp\tq\n{values}\n")
    values = "\n".join(f"{i / 10:.1f} {i} {2 * i}" for i in range(8))
    head = "name a\ndatacolumns 3\ndatarows 8\nrange 0 0.7\nendheader\n"
    (folder / "simm.mot").write_text(f"{head}time q1 q2\n{values}\n")


def robot_log(n=60):
    t = np.arange(n) / 100
    rng = np.random.default_rng(2)
    base = {name: rng.normal(size=n) for name in BASE_COLUMNS}
    joints = {name: rng.normal(size=(n, 2)) for name in ARM_JOINTS}
    return RobotLog(10**18, t, base, t, joints, t, rng.normal(size=(n, 6)), np.array([0.1]))


def json_messages(log):
    """Messages of a log as (topic, time [ns], object)."""
    for i, t in enumerate(log.base_time_s):
        b = {k: float(v[i]) for k, v in log.base.items()}
        turn = {"x": 0.0, "y": 0.0, "z": np.sin(b["yaw"] / 2), "w": np.cos(b["yaw"] / 2)}
        pose = {"position": {"x": b["x"], "y": b["y"], "z": 0.0}, "orientation": turn}
        angular = {"x": 0.0, "y": 0.0, "z": b["wz"]}
        twist = {"linear": {"x": b["vx"], "y": b["vy"], "z": 0.0}, "angular": angular}
        stamp = log.start_ns + round(t * 1e9)
        yield "/odom", stamp, {"pose": {"pose": pose}, "twist": {"twist": twist}}
        columns = [log.joints[name][i].tolist() for name in ARM_JOINTS]
        position, velocity = map(list, zip(*columns, strict=True))
        state = {"name": list(ARM_JOINTS), "position": position, "velocity": velocity}
        yield "/joint_states", stamp, state


def write_json_log(path, log, compression="ZSTD"):
    from mcap.writer import CompressionType, Writer

    with path.open("wb") as stream:
        writer = Writer(stream, compression=CompressionType[compression])
        writer.start()
        schema = writer.register_schema("any", "jsonschema", b"{}")
        channels = {}
        for topic, stamp, message in json_messages(log):
            if topic not in channels:
                channels[topic] = writer.register_channel(topic, "json", schema)
            data = json.dumps(message).encode()
            writer.add_message(channels[topic], stamp, data, stamp)
        writer.finish()


def unchecked(source, target, **options):
    """The same log without checksums, so that damage reaches the messages."""
    from mcap.reader import make_reader
    from mcap.writer import Writer

    with source.open("rb") as read, target.open("wb") as write:
        writer = Writer(write, enable_crcs=False, **options)
        writer.start(profile="ros2")
        schemas, channels = {}, {}
        for schema, channel, message in make_reader(read).iter_messages():
            if schema.id not in schemas:
                schemas[schema.id] = writer.register_schema(schema.name, schema.encoding, schema.data)
            if channel.id not in channels:
                channels[channel.id] = writer.register_channel(
                    channel.topic, channel.message_encoding, schemas[schema.id]
                )
            writer.add_message(channels[channel.id], message.log_time, message.data, message.publish_time)
        writer.finish()


def _logs(folder):
    from mcap.writer import CompressionType

    log = robot_log(n=30)
    write_log(folder / "cdr.mcap", log)
    write_json_log(folder / "json.mcap", log)
    for name in ("cdr", "json"):
        for compression in ("NONE", "LZ4"):
            target = folder / f"{name}-{compression.lower()}.mcap"
            unchecked(folder / f"{name}.mcap", target, compression=CompressionType[compression])
        unchecked(folder / f"{name}.mcap", folder / f"{name}-flat.mcap", use_chunking=False)


def _binary(folder):
    write_c3d(folder / "a.c3d", banded(n=6))
    write_mat(folder / "a.mat", banded(n=6))
    write_mat(folder / "b.mat", banded(n=6), do_compression=True)


def write_c3d(path, positions, rate=100.0, missing=((2, 1),)):
    """By ezc3d; ``missing`` lists (frame, point)."""
    import ezc3d

    file = ezc3d.c3d()
    values = np.stack(list(positions.values()), axis=1).transpose(2, 1, 0) * 1000
    points = np.concatenate([values, np.ones((1, *values.shape[1:]))])
    for frame, point in missing:
        points[:, point, frame] = np.nan
    file["parameters"]["POINT"]["RATE"]["value"] = [rate]
    file["parameters"]["POINT"]["UNITS"]["value"] = ["mm"]
    file["parameters"]["POINT"]["LABELS"]["value"] = list(positions)
    file["data"]["points"] = points
    file.write(str(path))


def write_mat(path, positions, rate=100.0, **options):
    import scipy.io

    values = np.stack(list(positions.values()), axis=0).transpose(0, 2, 1) * 1000
    data = np.concatenate([values, np.full((len(values), 1, values.shape[2]), 0.5)], axis=1)
    labels = np.array(list(positions), dtype=object)
    labeled = {"Count": float(len(labels)), "Labels": labels, "Data": data}
    content = {
        "StartFrame": 1.0,
        "Frames": float(values.shape[2]),
        "FrameRate": rate,
        "Trajectories": {"Labeled": labeled},
    }
    scipy.io.savemat(path, {"trial": content}, oned_as="row", **options)
