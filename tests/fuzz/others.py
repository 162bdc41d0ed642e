"""What else is read: YAML, models, recordings of described systems, checkpoints, definitions and payloads of logs.

A target has seeds (bytes), a way to damage them, and a call that reads one; only its own refusals may come of it.
"""

import contextlib
import io
import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from real2sim.configuration import read_yaml, validated
from real2sim.recording.formats import robot_log
from real2sim.recording.formats.mcap_file import Channel, Undecodable, decoder, read_messages
from real2sim.recording.formats.ros2_definition import parse_definition
from real2sim.recording.subjects import discover
from real2sim.recording.table import Recording, required_columns
from real2sim.study.twin.checkpoint import UnusableCheckpoint, read_checkpoint, write_checkpoint
from real2sim.system.description import System, shipped
from real2sim.system.model_files import model_files
from real2sim.system.plant import load_robot

from tests.fuzz import mutate, seeds, structured
from tests.unit import handmade_person

ROOT = Path(__file__).parents[2]
SUBJECT = f"""{handmade_person.SUBJECT}markers: {{LASI: ASIS_L, RASI: ASIS_R}}
exclude: {{dynamic_1: sensor fell off}}
"""


@dataclass(frozen=True)
class Target:
    """``read`` takes the path of a damaged file; ``refusals`` beside InputError are its own exceptions."""

    name: str
    file: str
    seeds: tuple[bytes, ...]
    damage: Callable
    read: Callable
    refusals: tuple[type[Exception], ...] = ()


def plain_bytes(data, rng):
    return mutate.mutated(data, rng, text=False)


def targets(folder):
    """All targets; their files lie in folders of their own below ``folder``."""
    return (
        _subject(folder),
        _configuration(),
        _system(folder),
        _model(folder),
        *_tables(folder),
        *_system_logs(folder),
        _checkpoint(folder),
        _definition(),
        *_payloads(folder),
    )


# -------------------- YAML and models


def _subject(folder):
    person = folder / "subject" / "S01"
    person.mkdir(parents=True)
    for name in ("neutral.tsv", "neutral.mot", "dynamic_1.tsv", "dynamic_1.mot"):
        (person / name).touch()
    text = SUBJECT.encode()
    return Target(
        "subject",
        "subject/S01/subject.yaml",
        (text, text.replace(b"\n", b"\r\n")),
        structured.yaml_text,
        lambda path: discover(path.parents[1]),
    )


def _configuration():
    files = (ROOT / "config" / "config.yaml", ROOT / "config" / "phantom.yaml")
    texts = (
        *(file.read_bytes() for file in files if file.exists()),
        b"ingest: {rate_hz: 100, cutoff_hz: 12}\n",
    )
    return Target(
        "config",
        "config.yaml",
        texts,
        structured.yaml_text,
        lambda path: validated(read_yaml(path), "config", path),
    )


def _system(folder):
    names = ("cuff", "drba", "emps", "strap")
    texts = tuple((shipped(name) / "system.yaml").read_bytes() for name in names)
    return Target("system", "system.yaml", texts, structured.yaml_text, System.from_yaml)


def _model(folder):
    (folder / "part.xml").write_text('<mujoco><worldbody><body name="part"/></worldbody></mujoco>')
    files = (ROOT / "resources/robot/drba.xml", *(shipped(n) / f"{n}.xml" for n in ("cuff", "emps")))
    one = b'<mujoco><include file="part.xml"/><asset><mesh file="a.stl"/></asset><worldbody/></mujoco>'

    def read(path):
        model_files(path)
        load_robot(path)

    texts = (*(file.read_bytes() for file in files), one)
    return Target("model", "robot.xml", texts, structured.xml_text, read)


# -------------------- recordings of described systems


def _check_table(recording):
    n = len(recording.time_s)
    assert n >= 10
    assert (np.diff(recording.time_s) > 0).all()
    assert all(values.shape == (n,) for values in recording.columns.values())
    return recording


def _tables(folder):
    import pandas as pd

    system = System.from_yaml(shipped("emps") / "system.yaml")
    n = 30
    time_s = np.arange(n) / 100
    table = pd.DataFrame(
        {"time_s": time_s} | {c: np.sin(time_s + i) for i, c in enumerate(required_columns(system))}
    )
    parquet = []
    for options in (
        {"compression": None},
        {"compression": "zstd"},
        {"use_dictionary": False, "compression": None},
    ):
        stream = io.BytesIO()
        table.to_parquet(stream, **options)
        parquet.append(stream.getvalue())
    texts = (table.to_csv(index=False).encode(), table.to_csv(index=False, lineterminator="\r\n").encode())

    def read(path):
        _check_table(Recording.read(system, path))

    return (
        Target("csv", "a.csv", texts, structured.csv_text, read),
        Target("parquet", "a.parquet", tuple(parquet), plain_bytes, read),
    )


def _system_logs(folder):
    """Joint states of a log, read by a system that logs them all."""
    system = System.from_dict(
        {
            "name": "arm",
            "model": "drba.xml",
            "machine": {name: {} for name in robot_log.ARM_JOINTS},
            "interface": {"axes": {"x": {"joint": "arm_lift"}}},
            "drive": {"by": "path", "of": {"arm_lift": "arm_lift_m"}},
            "parameters": {"k": {"unit": "N/m", "bounds": [1, 2], "sets": "stiffness", "of": "x"}},
        },
        ROOT / "resources/robot/system.yaml",
    )
    seeds._logs(folder)
    files = [folder / name for name in ("cdr-flat.mcap", "json-flat.mcap", "cdr-none.mcap")]

    def read(path):
        _check_table(Recording.read(system, path))

    messages = [
        ("/joint_states", stamp, json.dumps(message | {"effort": [1.0] * 3}).encode())
        for topic, stamp, message in seeds.json_messages(seeds.robot_log(n=20))
        if topic == "/joint_states"
    ]

    def damage(data, rng):
        number = int(rng.integers(len(messages)))
        topic, stamp, payload = messages[number]
        changed = (topic, stamp, structured.json_text(payload, rng))
        rest = [*messages[:number], changed, *messages[number + 1 :]]
        return _json_file(rest, "sensor_msgs/msg/JointState")

    return (
        Target("system log", "a.mcap", tuple(f.read_bytes() for f in files), plain_bytes, read),
        Target("system log, json", "a.mcap", (b"",), damage, read),
    )


def _checkpoint(folder):
    path = folder / "checkpoint.npz"
    arrays = {"weights": np.arange(12.0).reshape(3, 4), "steps": np.arange(5)}
    write_checkpoint(path, arrays, {"key": "a", "steps": 3, "rate": 0.1})
    return Target(
        "checkpoint", "a.npz", (path.read_bytes(),), plain_bytes, read_checkpoint,
        (UnusableCheckpoint, FileNotFoundError),
    )  # fmt: skip


# -------------------- definitions and payloads of logs


def _definition():
    types = sorted(set(robot_log.TOPICS.values()))
    texts = tuple(f"{name}\n{robot_log._schema_text(name)}".encode() for name in types)

    def read(path):
        name, _, text = path.read_bytes().decode(errors="replace").partition("\n")
        channel = Channel(1, "/a", "cdr", 1, name, "ros2msg", text.encode(errors="replace"))
        for size in (0, 4, 60, 400):
            payload = b"\0\1\0\0" + bytes(size)
            with contextlib.suppress(ValueError):
                parse_definition(name, text).end(payload)
            with contextlib.suppress(Undecodable):
                decoder(channel)(payload)

    return Target("definition", "a.msg", texts, structured.definition_text, read)


def _payloads(folder):
    """Logs one of whose payloads, in JSON or CDR, is damaged while the file around it is sound."""
    log = seeds.robot_log(n=4)
    messages = [
        (topic, stamp, json.dumps(message).encode()) for topic, stamp, message in seeds.json_messages(log)
    ]
    by_cdr = [(m.channel, m.log_time, m.data) for m in read_messages(folder / "cdr.mcap")][:12]

    def read(path):
        robot_log.read_log(path)

    def json_log(number):
        def damage(data, rng):
            topic, stamp, payload = messages[number]
            changed = structured.json_text(payload, rng)
            return _json_file([*messages[:number], (topic, stamp, changed), *messages[number + 1 :]])

        return damage

    def any_json(data, rng):
        return json_log(int(rng.integers(len(messages))))(data, rng)

    def any_cdr(data, rng):
        number = int(rng.integers(len(by_cdr)))
        channel, stamp, payload = by_cdr[number]
        rest = [*by_cdr[:number], (channel, stamp, plain_bytes(payload, rng)), *by_cdr[number + 1 :]]
        return _cdr_file(rest)

    return (
        Target("json payload", "a.mcap", (b"",), any_json, read),
        Target("cdr payload", "a.mcap", (b"",), any_cdr, read),
    )


def _json_file(messages, schema_name="any"):
    from mcap.writer import Writer

    stream = io.BytesIO()
    writer = Writer(stream, enable_crcs=False, use_chunking=False)
    writer.start()
    schema = writer.register_schema(schema_name, "jsonschema", b"{}")
    channels = {}
    for topic, stamp, payload in messages:
        if topic not in channels:
            channels[topic] = writer.register_channel(topic, "json", schema)
        writer.add_message(channels[topic], stamp, payload, stamp)
    writer.finish()
    return stream.getvalue()


def _cdr_file(messages):
    from mcap.writer import Writer

    stream = io.BytesIO()
    writer = Writer(stream, enable_crcs=False, use_chunking=False)
    writer.start(profile="ros2")
    channels = {}
    for channel, stamp, payload in messages:
        if channel.id not in channels:
            schema = writer.register_schema(channel.schema_name, channel.schema_encoding, channel.schema_data)
            channels[channel.id] = writer.register_channel(channel.topic, channel.message_encoding, schema)
        writer.add_message(channels[channel.id], stamp, payload, stamp)
    writer.finish()
    return stream.getvalue()
