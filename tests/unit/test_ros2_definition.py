"""ROS 2 definitions and the size of their messages, against an independent writer; crafted ones end quickly."""

import ast
import io
import time
from pathlib import Path

import pytest
from mcap_ros2.writer import Writer
from real2sim.recording.formats.mcap_file import Channel, Undecodable, decoder, read_messages
from real2sim.recording.formats.ros2_definition import parse_definition, stripped_text

LIBRARY = Path(__file__).parents[2] / "workflow" / "real2sim"
ALL = """# every kind of field
uint8 LIMIT=5   # a constant
string<=20 label "none=no"
string title
bool on
int16[3] three
float64[] many
uint8[<=4] bytes
string[] names
geometry_msgs/Point[2] ends
Inner[] inner
Empty nothing
builtin_interfaces/Time stamp
float32 last 1.5
================================================================================
MSG: geometry_msgs/Point
float64 x
float64 y
================================================================================
MSG: test_msgs/Inner
int8 a
int64 b
===
MSG: test_msgs/Empty
"""
VALUES = {
    "label": "ab",
    "title": "",
    "on": True,
    "three": [1, 2, 3],
    "many": [0.5] * 3,
    "bytes": [1, 2],
    "names": ["a", "bcd", ""],
    "ends": [{"x": 1.0, "y": 2.0}, {"x": 3.0, "y": 4.0}],
    "inner": [{"a": 1, "b": 2}, {"a": 3, "b": 4}],
    "stamp": {"sec": 1, "nanosec": 2},
    "last": 2.5,
}


def payload_of(tmp_path, definition, values, name="test_msgs/msg/All"):
    """The message as mcap-ros2-support encodes it."""
    stream = io.BytesIO()
    writer = Writer(stream)
    writer.write_message("/t", writer.register_msgdef(name, definition), values, 1)
    writer.finish()
    (tmp_path / "a.mcap").write_bytes(stream.getvalue())
    [message] = read_messages(tmp_path / "a.mcap")
    return message.data


def channel(definition, name="test_msgs/msg/All"):
    return Channel(1, "/t", "cdr", 1, name, "ros2msg", definition.encode())


@pytest.mark.parametrize("many", [[], [0.5], [0.5] * 40])
@pytest.mark.parametrize("names", [[], ["a"], ["abc", "defgh"]])
@pytest.mark.parametrize("inner", [[], [{"a": 1, "b": 2}]])
def test_the_size_is_that_of_the_writer(tmp_path, many, names, inner):
    values = VALUES | {"many": many, "names": names, "inner": inner}
    definition = ALL.replace(' "none=no"', "")
    payload = payload_of(tmp_path, definition, values)
    assert parse_definition("test_msgs/msg/All", definition).end(payload) == len(payload)
    decoded = decoder(channel(definition))(payload)
    assert decoded.label == "ab"
    assert list(decoded.many) == many
    assert [(i.a, i.b) for i in decoded.inner] == [(i["a"], i["b"]) for i in inner]
    assert decoded.last == 2.5


def test_bytes_too_many_and_too_few_are_refused(tmp_path):
    definition = ALL.replace(' "none=no"', "")
    payload = payload_of(tmp_path, definition, VALUES)
    decode = decoder(channel(definition))
    decode(payload + bytes(3))
    for wrong in (payload + bytes(4), payload[:-1], payload[:20], payload[:4], b"\0\0" + payload[2:], b""):
        with pytest.raises(Undecodable):
            decode(wrong)


def test_constants_defaults_and_comments_do_not_change_the_message():
    bare = stripped_text(parse_definition("test_msgs/msg/All", ALL.replace(' "none=no"', "")))
    assert "LIMIT" not in bare
    assert "1.5" not in bare
    assert "#" not in bare
    assert stripped_text(parse_definition("test_msgs/msg/All", bare)) == bare


NESTED = "".join(
    f"===\nMSG: a/B{i}\nB{i + 1} x\nC{i + 1} y\n===\nMSG: a/C{i}\nB{i + 1} x\nC{i + 1} y\n" for i in range(30)
)


@pytest.mark.parametrize(
    ("definition", "payload"),
    [
        pytest.param("uint8 " + "A" * 60 + "_=1\nuint8 x\n", bytes(4), id="a constant's name"),
        pytest.param("string[] x\n", b"\xff\xff\xff\x7f", id="two thousand million strings"),
        pytest.param("B[] x\n===\nMSG: a/B\n", b"\xff\xff\xff\x7f", id="two thousand million messages"),
        pytest.param("float64[1000000000] x\n", bytes(8), id="a long array"),
        pytest.param(
            "B[60000] x\n===\nMSG: a/B\nC[60000] y\n===\nMSG: a/C\n", bytes(8), id="arrays of arrays"
        ),
        pytest.param("A x\n", bytes(8), id="a message inside of itself"),
        pytest.param("B x\n", bytes(8), id="a type that is not there"),
        pytest.param(
            "B0 x\n" + NESTED + "===\nMSG: a/B30\nbool z\n===\nMSG: a/C30\nbool z\n", bytes(8), id="many ways"
        ),
        pytest.param("uint8\n", bytes(8), id="a type alone"),
        pytest.param("wstring x\n", bytes(8), id="wide text"),
    ],
)
def test_crafted_definitions_and_counts_are_refused_quickly(definition, payload):
    start = time.process_time()
    with pytest.raises(Undecodable):
        decoder(channel(definition, "a/msg/A"))(b"\x00\x01\x00\x00" + payload + bytes(20))
    assert time.process_time() - start < 1


def test_the_library_imports_no_private_module_and_nothing_that_runs_code_when_read():
    for path in sorted(LIBRARY.rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text())):
            modules = [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
            if isinstance(node, ast.ImportFrom):
                modules = [str(node.module)]
            for module in modules:
                private = [part for part in module.split(".") if part.startswith("_") and part[:2] != "__"]
                assert not private, f"{path}: {module}"
                assert module.split(".")[0] not in ("pickle", "marshal", "shelve", "dill"), (
                    f"{path}: {module}"
                )
