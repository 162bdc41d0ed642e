"""Every file that others wrote reads to the values an independent reader found, or is refused by its code.

What is expected follows from expected.json and from what the file is, never from its name.
"""

import json
import re
from collections import Counter
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from readings import codes, refusal
from real2sim.recording.formats import detect, mcap_file, qualisys, robot_log
from real2sim.recording.formats.opensim import is_translation

FOLDER = Path(__file__).parents[3] / "shared" / "third_party"
EXPECTED = json.loads((FOLDER / "expected.json").read_text()) if FOLDER.is_dir() else {}
pytestmark = pytest.mark.skipif(
    not FOLDER.is_dir(), reason=f"no third-party files at {FOLDER}: they are not part of the repository"
)


def files(*kinds):
    paths = [path for kind in kinds for path in sorted((FOLDER / kind).glob("*")) if path.suffix != ".json"]
    return [pytest.param(path, id=f"{path.parent.name}/{path.name}") for path in paths]


def values_of(path):
    return EXPECTED[f"{path.parent.name}/{path.name}"]


def close(values, expected, scale=1.0):
    """Equal to what the independent reader found; null is missing."""
    wanted = np.array([np.nan if v is None else v for v in expected], float)
    np.testing.assert_allclose(np.asarray(values) * scale, wanted, rtol=0, atol=1e-9)


def test_all_files_are_covered():
    kinds = {path.name for path in FOLDER.iterdir() if path.is_dir()}
    covered = files("qtm_tsv", "qtm_c3d", "qtm_mat", "trc", "opensim_mot_sto", "walking_ref", "mcap")
    conformance = files("mcap_conformance")
    assert kinds == {Path(p.id).parts[0] for p in covered + conformance}
    assert {p.id for p in covered} == set(EXPECTED)
    print(f"third-party files: {len(covered)} + {len(conformance)} of the MCAP conformance set")


# -------------------- Qualisys


@pytest.mark.parametrize("path", files("qtm_tsv"))
def test_qualisys_tsv(path):
    expected = values_of(path)
    assert detect.detect(path) == "tsv"
    kind = expected["data_included"]
    if kind == "3D":
        read = qualisys.read_markers(path)
        assert read.findings == []
        check_markers(read, expected)
        assert refusal(qualisys.read_bodies, path).code == "wrong_kind"
    elif kind == "6D":
        check_bodies(qualisys.read_bodies(path), expected)
        assert refusal(detect.read_markers, path).code == "wrong_kind"
    else:
        assert refusal(detect.read_markers, path).code == "wrong_kind"
        assert refusal(detect.read, path).code == "wrong_kind"
        return
    read = detect.read(path)
    assert read.rate_hz == expected["rate"]
    assert len(read.time_s) == expected["rows"]
    if expected["has_frame_time_columns"]:
        assert read.first_frame == expected["first_frame"]
        close(read.time_s[[0, -1]], [expected["first_time"], expected["last_time"]])
    else:
        close(read.time_s[[0, -1]], [0, (expected["rows"] - 1) / expected["rate"]])


def check_markers(read, expected):
    names = list(read.positions)
    assert names == expected["markers"]
    for name, key in ((names[0], "first_marker"), (names[-1], "last_marker")):
        close(read.positions[name][0], expected[f"{key}_first_frame"], 1000)
        close(read.positions[name][-1], expected[f"{key}_last_frame"], 1000)
    table = np.concatenate(list(read.positions.values()))
    assert 1000 * np.nanmean(table) == pytest.approx(expected["mean_all"], abs=1e-8)
    missing = {name: int(np.isnan(v[:, 0]).sum()) for name, v in read.positions.items()}
    assert {name: n for name, n in missing.items() if n} == expected["missing_marker_frames"]


def check_bodies(read, expected):
    assert list(read.positions) == expected["bodies"]
    for row, key in ((0, "first_row_per_body"), (-1, "last_row_per_body")):
        for body, cells in expected[key].items():
            close(read.positions[body][row], cells[:3], 1000)
            named = dict(zip(expected["angle_order"], cells[3:6], strict=True))
            assert list(read.angles_rad[body]) == expected["angle_order"]
            for name, angle in named.items():
                close(read.angles_rad[body][name][row], [angle], 180 / np.pi)
            close(read.residual_m[body][row], [cells[6]], 1000)
            close(read.rotations[body][row].T.ravel(), cells[7:])  # column-major
    lost = {body: int(np.isnan(v[:, 0]).sum()) for body, v in read.positions.items()}
    assert lost == expected["lost_frames_residual_lt0"]


@pytest.mark.parametrize("path", files("qtm_c3d"))
def test_c3d(path):
    expected = values_of(path)
    read = detect.read_markers(path)
    names = list(read.positions)
    assert names == expected["labels"][: expected["points"]]
    assert (len(names), len(read.time_s)) == (expected["points"], expected["frames"])
    assert read.rate_hz == expected["rate"]
    assert read.first_frame == expected["header"]["first"]
    assert read.time_s[0] == pytest.approx((expected["header"]["first"] - 1) / expected["rate"])
    scale = {"mm": 1000, "m": 1}[expected["units"][0]]
    close(read.positions[names[0]][0], expected["m0_first_frame"], scale)
    close(read.positions[names[0]][-1], expected["m0_last_frame"], scale)
    close(read.positions[names[-1]][-1], expected["m_last_last_frame"], scale)
    if "m0_first_valid" in expected:
        close(
            read.positions[names[0]][expected["m0_first_valid"]["frame_index"]],
            expected["m0_first_valid"]["xyz"],
            scale,
        )
    missing = sum(int(np.isnan(v[:, 0]).sum()) for v in read.positions.values())
    assert missing == expected["missing_total"]
    events = expected.get("events", {"labels": [], "times_s": []})
    assert [event.label for event in read.events] == events["labels"]
    np.testing.assert_allclose([event.time_s for event in read.events], events["times_s"], atol=1e-6)


@pytest.mark.parametrize("path", files("qtm_c3d"))
def test_c3d_like_ezc3d(path):
    ezc3d = pytest.importorskip("ezc3d")
    read = detect.read_markers(path)
    data = ezc3d.c3d(str(path))["data"]
    table = np.stack(list(read.positions.values()), axis=1) * 1000
    np.testing.assert_allclose(table, data["points"][:3].transpose(2, 1, 0), rtol=0, atol=1e-9)
    missing = data["meta_points"]["residuals"][0].T < 0
    np.testing.assert_array_equal(np.isnan(table[:, :, 0]), missing)


@pytest.mark.parametrize("path", files("qtm_mat"))
def test_mat(path):
    expected = values_of(path)
    read = detect.read_markers(path)
    names = list(read.positions)
    assert names == expected["markers"]
    assert len(read.time_s) == expected["Frames"]
    assert (read.rate_hz, read.first_frame) == (expected["FrameRate"], expected["StartFrame"])
    for name, row, key in (
        (names[0], 0, "m0_first"),
        (names[0], -1, "m0_last"),
        (names[-1], -1, "mlast_last"),
    ):
        close(read.positions[name][row], expected[key][:3], 1000)
        close(read.residual_m[name][row], expected[key][3:], 1000)
    assert sum(int(np.isnan(v).sum()) for v in read.positions.values()) == expected["nan"]
    assert ("not_measured" in codes(read)) == (set(expected["type_codes"]) != {"1"})


# -------------------- OpenSim


@pytest.mark.parametrize("path", files("trc"))
def test_trc(path):
    expected = values_of(path)
    read = detect.read_markerless(path)
    names = list(read.positions)
    assert len(names) == expected["labels"]
    assert names[: len(expected["label_first"])] == expected["label_first"]
    assert names[-1:] == expected["label_last"]
    assert len(read.time_s) == expected["rows"]
    assert read.first_frame == int(expected["frame_first_last"][0])
    close(read.time_s[[0, -1]], expected["time_first_last"])
    scale = {"mm": 1000, "m": 1}[expected["header"]["Units"].strip()]
    close(read.positions[names[0]][0], expected["m0_first"], scale)
    close(read.positions[names[0]][-1], expected["m0_last"], scale)
    close(read.positions[names[-1]][-1], expected["mlast_last"], scale)
    missing = sum(int(np.isnan(v[:, 0]).sum()) for v in read.positions.values())
    assert missing == expected["missing_triplets"]
    assert sum(np.isfinite(v).any() for v in read.positions.values()) == expected["markers_with_data"]
    wrong = [
        key
        for key, there in (("NumFrames", expected["rows"]), ("NumMarkers", expected["labels"]))
        if expected["header"][key].strip() != str(there)
    ]
    assert codes(read).count("count") == len(wrong)


@pytest.mark.parametrize("path", files("opensim_mot_sto", "walking_ref"))
def test_opensim_tables(path):
    expected = values_of(path)
    if "labels" not in expected:  # an XML file that lies beside the others
        assert refusal(detect.read, path).code == "unknown_format"
        return
    read = detect.read(path)
    assert ["time", *read.columns] == expected["labels"]
    assert len(read.time_s) == expected["rows"]
    if expected["rows"]:
        close(read.time_s[[0, -1]], expected["time"])
        for row, key in ((0, "first_row"), (-1, "last_row")):
            for label, value in list(zip(expected["labels"], expected[key], strict=False))[1:]:
                wanted = [float(v) for v in value.split(",")] if isinstance(value, str) else [value]
                close(read.columns[label][row], wanted)
    declared = {
        key: re.search(rf"{key}=(\d+)", "\n".join(expected["header"])) for key in ("nRows", "nColumns")
    }
    there = {"nRows": expected["rows"], "nColumns": expected["n_labels"]}
    wrong = [key for key, match in declared.items() if match and int(match[1]) != there[key]]
    assert codes(read).count("count") == len(wrong)


@pytest.mark.parametrize("path", files("opensim_mot_sto", "walking_ref"))
def test_opensim_coordinates(path):
    expected = values_of(path)
    first = [str(v) for v in expected.get("first_row", [])]
    if "labels" not in expected:
        assert refusal(detect.read_markerless, path).code == "unknown_format"
    elif not expected["rows"]:
        assert refusal(detect.read_markerless, path).code == "no_data"
    elif any("," in v for v in first) or any("force" in label for label in expected["labels"]):
        assert refusal(detect.read_markerless, path).code == "wrong_kind"
    elif not expected.get("inDegrees") and max(abs(float(v)) for v in first[1:]) > 4 * np.pi:
        assert refusal(detect.read_markerless, path).code == "units_ambiguous"
    else:
        check_coordinates(detect.read_markerless(path), expected)


def check_coordinates(read, expected):
    degrees = str(expected["inDegrees"]).lower().startswith("y")
    names = {
        label.split("/")[-2] if label.endswith("/value") else label: label for label in expected["labels"]
    }
    for name, numbers in expected.get("coord_first_last_min_max", {}).items():
        scale = np.pi / 180 if degrees and not is_translation(name) else 1.0
        values = read.columns[name] / scale
        np.testing.assert_allclose(
            [values[0], values[-1], values.min(), values.max()], numbers, atol=6e-6, rtol=0
        )
    for name, values in read.columns.items():
        index = expected["labels"].index(names[name])
        if index < len(expected["first_row"]):
            scale = np.pi / 180 if degrees and not is_translation(name) else 1.0
            assert values[0] == pytest.approx(expected["first_row"][index] * scale, abs=1e-12)
    knees = [n for n in ("knee_angle_r", "knee_angle_l") if n in expected.get("coord_first_last_min_max", {})]
    scale = 1.0 if degrees else 180 / np.pi
    bent = [
        low * scale < -20
        for low, high in (expected["coord_first_last_min_max"][n][2:] for n in knees)
        if abs(low) > high
    ]
    assert ("knee_sign" in codes(read)) == any(bent)
    assert ("units_absent" in codes(read)) == (expected["inDegrees"] is None)


# -------------------- MCAP


@pytest.mark.parametrize("path", files("mcap"))
def test_mcap(path):
    expected = values_of(path)
    contents = mcap_file.Contents()
    messages = list(mcap_file.read_messages(path, contents))
    assert len(messages) == expected["messages"]
    assert (contents.profile, contents.library) == (expected["profile"], expected["library"])
    assert contents.backwards == expected["steps_back_in_time"]
    times = [m.log_time for m in messages]
    assert [min(times, default=None), max(times, default=None)] == expected["log_time"]
    assert sum(m.publish_time != m.log_time for m in messages) == expected["publish_ne_log"]
    counts = Counter(m.channel.id for m in messages)
    there = [
        {
            "id": c.id,
            "topic": c.topic,
            "encoding": c.message_encoding,
            "schema": c.schema_name or None,
            "schema_encoding": c.schema_encoding or None,
            "n": counts[c.id],
        }
        for c in contents.channels.values()
    ]
    wanted = [{**c, "schema": c["schema"] or None} for c in expected["channels"]]
    assert sorted(there, key=lambda c: c["id"]) == sorted(wanted, key=lambda c: c["id"])
    for topic, samples in expected["decoded_first_last"].items():
        of_topic = sorted((m for m in messages if m.channel.topic == topic), key=lambda m: m.log_time)
        for sample, message in zip(samples, (of_topic[0], of_topic[-1]), strict=True):
            check_message(message, sample)


def check_message(message, sample):
    """The decoded value as the independent decoder wrote it down, cut after some hundred characters."""
    assert message.log_time == sample["log_time"]
    value = sample["value"]
    if value is not None and value.startswith("DECODE ERROR"):
        with pytest.raises(mcap_file.Undecodable) as error:
            mcap_file.decoder(message.channel)(message.data)
        assert error.value.code == ("schema" if "Definition" in value else "payload")
        return
    decode, data = mcap_file.decoder, message.data
    if message.channel.message_encoding not in ("cdr", "json", "protobuf"):
        with pytest.raises(mcap_file.Undecodable) as error:
            decode(message.channel)(data)
        assert error.value.code == "encoding"  # one that nobody can decode without its program
        return
    decoded = decode(message.channel)(data)
    if value is None:
        return
    if message.channel.message_encoding == "json":
        text = message.data.decode()
        assert squeezed(text)[: len(squeezed(value)) - 3] == squeezed(value)[:-3]
        assert json.loads(text) == decoded
    else:
        text = str(decoded)
        assert squeezed(text)[: len(squeezed(value)) - 3] == squeezed(value)[:-3]


def squeezed(text):
    return re.sub(r"\s+", "", text)


@pytest.mark.parametrize("path", files("mcap", "mcap_conformance"))
def test_other_logs_are_refused_as_the_robots(path):
    code = refusal(robot_log.read_log, path).code
    assert code in ("topic_missing", "no_data", "field_missing", "encoding", "message_type")


@pytest.mark.parametrize("path", files("mcap_conformance"))
def test_mcap_conformance(path):
    records = json.loads(path.with_suffix(".json").read_text())["records"]
    wanted, channels, schemas = [], {}, {}
    for record in records:
        fields = dict(record["fields"])
        if record["type"] == "Schema":
            schemas[fields["id"]] = fields
        elif record["type"] == "Channel":
            channels[fields["id"]] = fields
        elif record["type"] == "Message":
            wanted.append(fields)
    contents = mcap_file.Contents()
    messages = list(mcap_file.read_messages(path, contents))
    assert contents.findings == []
    assert len(messages) == len(wanted)
    for message, fields in zip(messages, wanted, strict=True):
        channel = channels[fields["channel_id"]]
        schema = schemas.get(channel["schema_id"], {"name": "", "encoding": "", "data": []})
        assert message.data == bytes(map(int, fields["data"]))
        assert (message.sequence, message.log_time, message.publish_time) == tuple(
            int(fields[key]) for key in ("sequence", "log_time", "publish_time")
        )
        assert message.channel == mcap_file.Channel(
            int(fields["channel_id"]),
            channel["topic"],
            channel["message_encoding"],
            int(channel["schema_id"]),
            schema["name"],
            schema["encoding"],
            bytes(map(int, schema["data"])),
        )
        with pytest.raises(mcap_file.Undecodable) as error:
            mcap_file.decoder(message.channel)(message.data)
        assert error.value.code == "encoding"
    assert contents.backwards == sum(int(b["log_time"]) < int(a["log_time"]) for a, b in pairwise(wanted))


# -------------------- a file of one kind in another's place


@pytest.mark.parametrize(
    "path", files("qtm_tsv", "qtm_c3d", "qtm_mat", "trc", "opensim_mot_sto", "mcap", "mcap_conformance")
)
def test_a_file_in_the_place_of_another_kind_is_refused(path):
    kind = detect.detect(path)
    readers = {
        detect.read_markers: ("tsv", "c3d", "mat"),
        detect.read_markerless: ("storage", "trc"),
        detect.read_log: ("mcap",),
    }
    for reader, kinds in readers.items():
        if kind not in kinds:
            assert refusal(reader, path).code == "wrong_kind"
