"""Quiet standing shows the lab's axes and the markers' sides: mistakes end with the line that mends them."""

import itertools
import json
import re
from pathlib import Path

import mujoco
import numpy as np
import pytest
import yaml
from handmade_person import PELVIS, SETTINGS, SIDES, SUBJECT, change_markers, write_person
from real2sim import geometry
from real2sim.errors import InputError
from real2sim.recording.ingest import ingest_subject, lab_to_world
from real2sim.recording.standing import check_standing
from real2sim.system.plant import load_robot
from scipy.spatial.transform import Rotation

ROBOT = Path(__file__).parents[2] / "resources" / "robot" / "drba.xml"
DEFAULT = SETTINGS["lab_to_world"]


def all_axes():
    """Every right-handed `lab_to_world`: 24 of them."""
    for order in itertools.permutations("xyz"):
        for signs in itertools.product("+-", repeat=3):
            axes = {world: sign + lab for world, sign, lab in zip("xyz", signs, order, strict=True)}
            try:
                lab_to_world(axes)
            except InputError:
                continue
            yield axes


def standing(axes, *, tilt_deg=0.0, names=None, heading_deg=0.0):
    """Markers (50, 3) [m] by name in a lab with some axes; ``names`` maps a marker to what it is labelled."""
    rng = np.random.default_rng(3)
    turn = Rotation.from_euler("zy", [heading_deg, tilt_deg], degrees=True).as_matrix()
    out = {}
    for name, local in (PELVIS | SIDES).items():
        world = turn @ local + [0.3, -0.2, 0.95] + 1e-4 * rng.standard_normal((50, 3))
        out[(names or {}).get(name, name)] = world @ lab_to_world(axes)
    return out


def check(positions, stated):
    rotation = lab_to_world(stated)
    world = {name: values @ rotation.T for name, values in positions.items()}
    pelvis = geometry.pelvis_frame(*(world[name] for name in geometry.PELVIS_MARKERS))
    across = world["IF_L"] - world["IF_R"]
    return check_standing(Path("neutral.tsv"), stated, rotation, pelvis, across, SETTINGS["facing_deg"])


def line_of(text):
    """The `lab_to_world` of a message."""
    return yaml.safe_load(re.search(r"lab_to_world: (\{.*\})", text).group(1))


@pytest.mark.parametrize("tilt", [-30, 0, 30])
@pytest.mark.parametrize("axes", list(all_axes()), ids=lambda axes: "".join(axes.values()))
def test_the_line_of_the_message_is_the_labs(axes, tilt):
    positions = standing(axes, tilt_deg=tilt)
    if axes["z"] == "+z":
        message = check(positions, DEFAULT)
        assert bool(message) == (axes != DEFAULT)
    else:
        with pytest.raises(InputError) as caught:
            check(positions, DEFAULT)
        assert caught.value.code == "lab_axes"
        assert f"the lab's {axes['z']} axis (pelvis at 0.95 m)" in caught.value.found
        message = caught.value.remedy
    if message:
        assert line_of(message) == axes
    assert not check(positions, axes)


@pytest.mark.parametrize("heading", [-12, 12])
def test_who_stands_askew_faces_forward(heading):
    assert not check(standing(DEFAULT, heading_deg=heading), DEFAULT)


@pytest.mark.parametrize(("heading", "side"), [(-40, "right"), (20, "left")])
def test_a_frame_that_is_turned_by_less_than_half_a_quarter_is_reported(heading, side):
    message = check(standing(DEFAULT, heading_deg=heading), DEFAULT)
    assert f"faces {abs(heading)} deg to the {side}" in message
    assert "calibrate Qualisys again" in message
    # no names of axes mend it
    assert "lab_to_world" not in message


def test_a_frame_that_is_turned_by_more_has_its_line_and_what_is_left():
    message = check(standing(DEFAULT, heading_deg=60), DEFAULT)
    assert line_of(message) == {"x": "+y", "y": "-x", "z": "+z"}
    assert "also calibrate" in message
    assert "calibrate" not in check(standing(DEFAULT, heading_deg=95), DEFAULT)


def exchanged(*pairs):
    return {a: b for first, second in pairs for a, b in ((first, second), (second, first))}


@pytest.mark.parametrize(
    ("names", "place"),
    [
        (exchanged(("ASIS_L", "ASIS_R"), ("PSIS_L", "PSIS_R")), "ASIS_L"),
        (exchanged(("ASIS_L", "PSIS_L"), ("ASIS_R", "PSIS_R")), "ASIS_L"),
        (exchanged(("ASIS_L", "ASIS_R"), ("PSIS_L", "PSIS_R"), ("IF_L", "IF_R")), "ASIS_L"),
        (exchanged(("IF_L", "IF_R")), "IF_L, IF_R"),
    ],
)
def test_exchanged_sides_are_refused(names, place):
    with pytest.raises(InputError) as caught:
        check(standing(DEFAULT, names=names), DEFAULT)
    assert caught.value.code == "sides"
    assert place in caught.value.place


# -------------------- the whole way


@pytest.fixture
def person(tmp_path):
    folder = write_person(tmp_path / "S01", ("neutral", "dynamic_1"))

    def run(settings=SETTINGS):
        ingest_subject(subject="S01", folder=folder, settings=settings, raw=[], out=tmp_path / "out")
        return json.loads((tmp_path / "out" / "neutral" / "quality.json").read_text())

    return folder, run


def test_a_lab_with_y_up_and_no_robot_log_is_refused_with_its_line(person):
    folder, run = person
    axes = {"x": "+z", "y": "+x", "z": "+y"}
    for name in ("neutral", "dynamic_1"):
        change_markers(
            folder / f"{name}.tsv", lambda p: {key: values @ lab_to_world(axes) for key, values in p.items()}
        )
        (folder / f"{name}.mcap").unlink()
    with pytest.raises(InputError, match=r'lab_to_world: \{x: "\+z", y: "\+x", z: "\+y"\}') as caught:
        run()
    assert caught.value.path.name == "neutral.tsv"
    run(SETTINGS | {"lab_to_world": axes})


def test_a_person_who_faces_sideways_is_reported(person, capsys):
    folder, run = person
    axes = {"x": "+y", "y": "-x", "z": "+z"}
    for name in ("neutral", "dynamic_1"):
        change_markers(
            folder / f"{name}.tsv", lambda p: {key: values @ lab_to_world(axes) for key, values in p.items()}
        )
    [finding] = [f for f in run()["findings"] if f["code"] == "facing"]
    assert line_of(finding["message"]) == axes
    assert f"  facing: neutral.tsv: {finding['message']}; used as stated" in capsys.readouterr().out
    assert "facing" not in [f["code"] for f in run(SETTINGS | {"lab_to_world": axes})["findings"]]


def test_a_marker_name_that_no_recording_has_is_refused(person):
    folder, run = person
    (folder / "subject.yaml").write_text(SUBJECT + "markers: {LHEEL: LHEE, ASIS_L: ASIS_L}\n")
    with pytest.raises(InputError, match="LHEEL, which no marker or landmark") as caught:
        run()
    assert caught.value.code == "marker_source"
    assert caught.value.path.name == "subject.yaml"

    def named(positions):
        return positions | {"LHEEL": positions["ASIS_L"] - [0, 0, 0.9]}

    change_markers(folder / "dynamic_1.tsv", named)
    assert run()["names_absent"] == ["LHEEL"]


# -------------------- the robot's sites


def moved(tmp_path, **changes):
    text = ROBOT.read_text()
    for side, place in changes.items():
        text = re.sub(rf'(name="interface_{side}" pos=)"[^"]*"', rf'\1"{place}"', text)
    path = tmp_path / "robot.xml"
    path.write_text(text)
    return path


@pytest.mark.parametrize(
    ("left", "right"),
    [("0 -0.17 0", "0 0.17 0"), ("0.17 0 0", "-0.17 0 0"), ("0 0.1 0", "0 0.1 0"), ("0 0 0.2", "0 -0.1 0")],
)
def test_exchanged_sites_of_a_robot_are_refused(tmp_path, left, right):
    path = moved(tmp_path, left=left, right=right)
    with pytest.raises(InputError, match="sites interface_left, interface_right") as caught:
        load_robot(path)
    assert caught.value.code == "site_sides"
    assert "Exchange the names" in caught.value.remedy


def test_sites_that_are_a_little_off_are_read(tmp_path):
    assert isinstance(
        load_robot(moved(tmp_path, left="0.02 0.17 0.01", right="0 -0.16 0")).compile(), mujoco.MjModel
    )
