"""Folders as a careless lab drops them in: each is read, or refused with code, file, place, expectation and remedy.

One row per kind: what is done to a person who is fine otherwise, the code of the refusal ("works" where there is none),
the file that the message names, and what it says of the place.
"""

from __future__ import annotations

import os
import re
import shutil
from dataclasses import dataclass, replace

import numpy as np
import pytest
from handmade_person import SETTINGS, SUBJECT, change_markers, log_of, write_person
from real2sim.artefacts import read_json
from real2sim.errors import InputError
from real2sim.recording.formats.opensim import write_coordinates
from real2sim.recording.formats.robot_log import write_log
from real2sim.recording.ingest import ingest_subject
from real2sim.recording.subjects import discover

WORKS = "works"
TSV, MOT, LOG, YAML = "dynamic_1.tsv", "dynamic_1.mot", "dynamic_1.mcap", "subject.yaml"
REMEDY_WORDS = 3


@dataclass(frozen=True)
class Row:
    """``make`` takes the folder of the person; ``file``, ``place`` and ``found`` are parts of what the refusal says.

    ``finding`` is a code that the quality.json of a trial must have where the folder is read.
    """

    name: str
    make: object
    code: str
    file: str = ""
    place: str = ""
    found: str = ""
    finding: str = ""


# -------------------- what is done to a folder


def add(name, content=b"x"):
    return lambda person: (person / name).write_bytes(content)


def drop(*names):
    def make(person):
        for name in names:
            (person / name).unlink()

    return make


def rename(old, new):
    return lambda person: (person / old).rename(person / new)


def copy(old, new):
    return lambda person: shutil.copy(person / old, person / new)


def beside(name, content=b"x"):
    """A file beside the people."""
    return lambda person: (person.parent / name).write_bytes(content)


def instead(name, make):
    """What is no file in the place of one."""

    def put(person):
        (person / name).unlink(missing_ok=True)
        make(person / name)

    return put


def folder(path):
    path.mkdir()


def loop(path):
    path.symlink_to(path)


def dead_link(path):
    path.symlink_to(path.with_name("nowhere"))


def pipe(path):
    os.mkfifo(path)


def changed(name, change):
    """A file whose bytes are changed."""

    def make(person):
        path = person / name
        path.write_bytes(change(path.read_bytes()))

    return make


def replaced(name, old, new):
    """A file in which one text is another."""

    def change(data):
        assert old.encode() in data, old
        return data.replace(old.encode(), new.encode())

    return changed(name, change)


def content(name, data):
    return changed(name, lambda _: data)


def yaml_with(**values):
    """subject.yaml with other values of keys, None for a line that is left out."""

    def make(person):
        lines = SUBJECT.splitlines()
        for key, value in values.items():
            lines = [line for line in lines if not line.startswith(f"{key}:")]
            if value is not None:
                lines.append(f"{key}: {value}")
        (person / YAML).write_text("\n".join(lines) + "\n")

    return make


def markers(change, *names):
    def make(person):
        for name in names or (TSV,):
            change_markers(person / name, change)

    return make


def renamed_markers(names):
    return lambda positions: {names.get(key, key): values for key, values in positions.items()}


def scaled(factor):
    return lambda positions: {key: values * factor for key, values in positions.items()}


def cells(change):
    """The table of the marker export with each cell changed."""

    def make(data):
        head, _, table = data.partition(b"Frame\t")
        return head + b"Frame\t" + change(table)

    return changed(TSV, make)


def rows(change):
    def make(data):
        lines = data.split(b"\r\n")
        return b"\r\n".join(lines[:12] + change(lines[12:-1]) + [b""])

    return changed(TSV, make)


def moved_into(name):
    """All files one folder deeper, as a zip unpacks into a folder of its own name."""

    def make(person):
        deeper = person / name
        files = list(person.iterdir())
        deeper.mkdir()
        for file in files:
            file.rename(deeper / file.name)

    return make


def log_with(**changes):
    return lambda person: write_log(
        person / LOG, replace(log_of(True), **{k: v() for k, v in changes.items()})
    )


def other_joints():
    return {f"joint_{i}": values for i, values in enumerate(log_of(True).joints.values())}


def lost_joints():
    return {name: np.full_like(values, np.nan) for name, values in log_of(True).joints.items()}


def in_degrees_without_saying_so(person):
    path = person / MOT
    path.write_text(re.sub("inDegrees=yes\n|Angles are in degrees.\n", "", path.read_text()))


def y_up(positions):
    return {name: values[:, [0, 2, 1]] * [1, 1, -1] for name, values in positions.items()}


def hole(positions):
    positions["IF_L"][300:780] = np.nan
    return positions


def in_the_origin(positions):
    positions["PSIS_R"][200:900] = 0.0
    return positions


def other_coordinates(person):
    from real2sim.recording.formats.opensim import read_coordinates

    recording = read_coordinates(person / MOT)
    write_coordinates(
        person / MOT, replace(recording, columns={"knee_angle_r": recording.columns["knee_angle_r"]})
    )


def copied_person(name):
    return lambda person: shutil.copytree(person, person.with_name(name))


def linked_person(person):
    elsewhere = person.parents[1] / "archive"
    person.rename(elsewhere)
    person.symlink_to(elsewhere)


def linked_file(person):
    elsewhere = person.parents[1] / "raw.tsv"
    (person / TSV).rename(elsewhere)
    (person / TSV).symlink_to(elsewhere)


def no_latin(text):
    return text.replace(b"DESCRIPTION\t--", "DESCRIPTION\tGünther, Übung".encode("cp1252"))


BOMB = "a0: &a0 [x, x, x, x, x, x, x, x, x]\n" + "".join(
    f"a{i}: &a{i} [{', '.join([f'*a{i - 1}'] * 9)}]\n" for i in range(1, 12)
)
HTML = b"<!DOCTYPE html>\n<html><head><title>Sign in</title></head><body>Please log in</body></html>\n"
FORCES = (
    b"name forces\ninDegrees=yes\nendheader\ntime\tground_force_vx\tground_force_px\n0\t1\t2\n0.1\t1\t2\n"
)

NAMES = (
    Row("a typing error", rename(TSV, "dinamic_1.tsv"), "trial_name", "dinamic_1.tsv"),
    Row("trial number 0", rename(TSV, "dynamic_0.tsv"), "trial_name", "dynamic_0.tsv"),
    Row("trial number with a zero before it", rename(TSV, "dynamic_01.tsv"), "trial_name", "dynamic_01.tsv"),
    Row("trial without a number", rename(TSV, "dynamic.tsv"), "trial_name", "dynamic.tsv"),
    Row("trial in capitals", rename(TSV, "Dynamic_1.tsv"), "trial_name", "Dynamic_1.tsv"),
    Row("a blank in the name", rename(TSV, "dynamic 1.tsv"), "trial_name", "dynamic 1.tsv"),
    Row("a hyphen in the name", rename(TSV, "dynamic-1.tsv"), "trial_name", "dynamic-1.tsv"),
    Row("a level of one digit", copy(TSV, "rotation_T8.tsv"), "trial_name", "rotation_T8.tsv"),
    Row("a level without its T", copy(TSV, "rotation_08.tsv"), "trial_name", "rotation_08.tsv"),
    Row("a second download", copy(TSV, "dynamic_1 (1).tsv"), "trial_name", "dynamic_1 (1).tsv"),
    Row("a copy by the file manager", copy(TSV, "dynamic_1 - Kopie.tsv"), "trial_name", "Kopie"),
    Row("a numbered neutral", rename("neutral.tsv", "neutral_1.tsv"), "trial_name", "neutral_1.tsv"),
    Row("a letter with an accent", rename(TSV, "dynamic_1é.tsv"), "trial_name", "dynamic_1"),
    Row("a name that is no text", rename(TSV, os.fsdecode(b"dynamic_\xff.tsv")), "trial_name", "dynamic_"),
    Row("capitals in the extension", rename(TSV, "dynamic_1.TSV"), WORKS),
    Row("capitals in all extensions", rename(LOG, "dynamic_1.MCAP"), WORKS),
    Row("an extension hidden by Windows", rename(TSV, "dynamic_1.tsv.txt"), "file_kind", "dynamic_1.tsv.txt"),
    Row("no extension", rename(TSV, "dynamic_1"), "file_kind", "S01/dynamic_1"),
    Row("a spreadsheet", add("dynamic_1.xlsx"), "file_kind", "dynamic_1.xlsx"),
    Row("QTM's own format", add("dynamic_1.qtm"), "file_kind", "dynamic_1.qtm"),
    Row("a bag of ROS 1", add("dynamic_1.bag"), "file_kind", "dynamic_1.bag"),
    Row("a bag of ROS 2 in SQLite", add("dynamic_1.db3"), "file_kind", "dynamic_1.db3"),
    Row("a video", add("dynamic_1.mp4"), "file_kind", "dynamic_1.mp4"),
    Row("a zip left packed", add("S01.zip", b"PK\3\4"), "file_kind", "S01.zip"),
    Row("a packed file", rename(TSV, "dynamic_1.tsv.gz"), "file_kind", "dynamic_1.tsv.gz"),
    Row("half a download", rename(TSV, "dynamic_1.tsv.part"), "file_kind", "dynamic_1.tsv.part"),
    Row("a lock file of an editor", add("~$notes.docx"), "file_kind", "~$notes.docx"),
    Row("an editor's copy of before", copy(YAML, "subject.yaml~"), "file_kind", "subject.yaml~"),
    Row("notes", add("notes.txt"), "file_kind", "notes.txt"),
    Row(
        "a folder of a zip of a Mac",
        lambda person: (person / "__MACOSX").mkdir(),
        "file_kind",
        "__MACOSX",
        found="a folder",
    ),
    Row(
        "a folder per session",
        lambda person: (person / "session1").mkdir(),
        "file_kind",
        "session1",
        found="a folder",
    ),
    Row("Thumbs.db", add("Thumbs.db"), WORKS),
    Row("desktop.ini", add("desktop.ini"), WORKS),
    Row(".DS_Store", add(".DS_Store"), WORKS),
    Row("a Mac's resource fork", add("._dynamic_1.tsv"), WORKS),
    Row("a README", add("README.md"), WORKS),
    Row("bodies beside the markers", add("dynamic_1_6D.tsv"), WORKS),
)
PEOPLE = (
    Row("a list of people", beside("people.xlsx"), "folder_name", "people.xlsx"),
    Row("a person left packed", beside("S02.zip"), "folder_name", "S02.zip"),
    Row("Thumbs.db beside the people", beside("Thumbs.db"), WORKS),
    Row("a README beside the people", beside("README.txt"), WORKS),
    Row("a person with a blank", copied_person("S 02"), "folder_name", "S 02"),
    Row("a person with an underscore", copied_person("S_02"), "folder_name", "S_02"),
    Row("a person with an umlaut", copied_person("Günther"), "folder_name", "nther"),
    Row("a person copied by the file manager", copied_person("S01 - Kopie"), "folder_name", "Kopie"),
    Row("a person copied under another name", copied_person("S02"), "subject_id", "S02/subject.yaml", "id"),
    Row("a person copied in small letters", copied_person("s01"), "subject_id", "s01/subject.yaml", "id"),
    Row("an empty folder", lambda person: (person.parent / "S02").mkdir(), "subject_file", "S02"),
    Row("files one folder deeper", moved_into("S01"), "subject_file", "S01"),
    Row(
        "a person that is a link to nowhere",
        lambda person: dead_link(person.parent / "S02"),
        "folder_name",
        "S02",
    ),
    Row(
        "a person that is a link to itself", lambda person: loop(person.parent / "S02"), "folder_name", "S02"
    ),
    Row("a person that is a pipe", lambda person: pipe(person.parent / "S02"), "folder_name", "S02"),
    Row("a person that is a link", linked_person, WORKS),
)
FILES = (
    Row("no neutral", drop("neutral.tsv", "neutral.mot", "neutral.mcap"), "trial_missing", "S01"),
    Row("an excluded neutral", yaml_with(exclude="{neutral: sneezed}"), "trial_missing", "S01"),
    Row("an excluded trial", yaml_with(exclude="{dynamic_1: fell asleep}"), WORKS),
    Row(
        "an excluded trial that is not there",
        yaml_with(exclude="{dynamic_7: fell}"),
        "excluded_trial",
        YAML,
        "exclude",
    ),
    Row("no markerless export", drop(MOT), "partner_file", "S01/dynamic_1"),
    Row("no marker export", drop(TSV), "partner_file", "S01/dynamic_1"),
    Row("a log alone", drop(TSV, MOT), "partner_file", "S01/dynamic_1"),
    Row("no log", drop(LOG), WORKS, finding="no_robot_log"),
    Row("a trial in two formats", copy(TSV, "dynamic_1.c3d"), "two_files", "dynamic_1"),
    Row("coordinates in two formats", copy(MOT, "dynamic_1.sto"), "two_files", "dynamic_1"),
    Row("a file twice, in capitals", copy(TSV, "dynamic_1.TSV"), "two_files", "dynamic_1"),
    Row("a level outside the person's range", copy(TSV, "rotation_T12.tsv"), "partner_file", "rotation_T12"),
    Row("a folder named like a file", instead(TSV, folder), "no_file", TSV),
    Row("a link to nowhere", instead(TSV, dead_link), "no_file", TSV),
    Row("a link to itself", instead(MOT, loop), "no_file", MOT),
    Row("a pipe", instead(LOG, pipe), "no_file", LOG),
    Row("a folder as subject.yaml", instead(YAML, folder), "no_file", YAML),
    Row("a pipe as subject.yaml", instead(YAML, pipe), "no_file", YAML),
    Row("a link to nowhere as subject.yaml", instead(YAML, dead_link), "no_file", YAML),
    Row("a link to itself as subject.yaml", instead(YAML, loop), "unreadable", YAML),
    Row("a link to a file", linked_file, WORKS),
)
CONTENTS = (
    Row("an empty marker export", content(TSV, b""), "empty", TSV),
    Row("an empty markerless export", content(MOT, b""), "empty", MOT),
    Row("an empty log", content(LOG, b""), "empty", LOG),
    Row("blank lines alone", content(TSV, b" \r\n\t\r\n"), "empty", TSV),
    Row("zeros of a copy that broke off", changed(TSV, lambda d: bytes(len(d))), "unknown_format", TSV),
    Row("zeros in the second half", changed(TSV, lambda d: d[:30000] + bytes(30000)), "unknown_format", TSV),
    Row("half a marker export", changed(TSV, lambda d: d[: len(d) // 2]), "row_cells", TSV, "line"),
    Row("half a markerless export", changed(MOT, lambda d: d[: len(d) // 2 + 3]), "row_cells", MOT, "line"),
    Row("half a log", changed(LOG, lambda d: d[: len(d) // 2]), "truncated", LOG, "byte"),
    Row(
        "a log with a flipped bit",
        changed(LOG, lambda d: d[:5000] + bytes([d[5000] ^ 1]) + d[5001:]),
        "checksum",
        LOG,
        "byte",
    ),
    Row("UTF-16", changed(TSV, lambda d: d.decode().encode("utf-16")), "utf_16", TSV),
    Row("a byte-order mark", changed(TSV, lambda d: b"\xef\xbb\xbf" + d), WORKS),
    Row("line feeds", changed(TSV, lambda d: d.replace(b"\r\n", b"\n")), WORKS),
    Row("carriage returns", changed(TSV, lambda d: d.replace(b"\r\n", b"\r")), WORKS),
    Row("carriage returns in coordinates", changed(MOT, lambda d: d.replace(b"\n", b"\r\n")), WORKS),
    Row("Windows' letters", changed(TSV, no_latin), WORKS),
    Row("blank lines at the end", changed(TSV, lambda d: d + b"\r\n\r\n"), WORKS),
    Row("a blank line between rows", rows(lambda r: [*r[:50], b"", *r[50:]]), "row_cells", TSV, "line 63"),
    Row("commas for tabs", changed(TSV, lambda d: d.replace(b"\t", b",")), "header", TSV),
    Row("semicolons for tabs", changed(TSV, lambda d: d.replace(b"\t", b";")), "header", TSV),
    Row("coordinates with commas", changed(MOT, lambda d: d.replace(b"\t", b",")), WORKS, finding="commas"),
    Row("decimal commas", cells(lambda t: t.replace(b".", b",")), "not_a_number", TSV, "line 13, column 2"),
    Row(
        "decimal commas in coordinates",
        changed(MOT, lambda d: re.sub(rb"(\d)\.(\d)", rb"\1,\2", d)),
        "not_a_number",
        MOT,
        "line 12",
    ),
    Row(
        "thousands divided by commas",
        cells(lambda t: t.replace(b"\t1", b"\t1,0")),
        "not_a_number",
        TSV,
        "line",
    ),
    Row(
        "words for missing numbers",
        rows(lambda r: [*r[:9], re.sub(rb"\t[^\t]*$", b"\tmissing", r[9]), *r[10:]]),
        "not_a_number",
        TSV,
        "line 22",
    ),
    Row(
        "quoted cells",
        changed(
            TSV,
            lambda d: b"\r\n".join(
                b"\t".join(b'"' + c + b'"' for c in line.split(b"\t")) for line in d.split(b"\r\n")
            ),
        ),
        "unknown_format",
        TSV,
    ),
    Row("two exports joined", rows(lambda r: r + r), "time_order", TSV, "line 1213"),
    Row(
        "rows sorted by the last column",
        rows(lambda r: sorted(r, key=lambda x: x.split(b"\t")[-1])),
        "time_order",
        TSV,
        "line",
    ),
    Row("a column deleted", rows(lambda r: [x.rpartition(b"\t")[0] for x in r]), "row_cells", TSV, "line 13"),
    Row(
        "a header line twice",
        replaced(TSV, "FREQUENCY\t100", "FREQUENCY\t100\r\nFREQUENCY\t120"),
        "header_repeated",
        TSV,
        "line",
    ),
    Row(
        "another rate in the header",
        replaced(TSV, "FREQUENCY\t100", "FREQUENCY\t200"),
        "rate",
        TSV,
        "FREQUENCY",
    ),
    Row("a header deleted", changed(TSV, lambda d: d[d.index(b"Frame\t") :]), "unknown_format", TSV),
    Row("a header without data", rows(lambda r: []), "no_data", TSV),
    Row(
        "forces in the place of markers",
        replaced(TSV, "DATA_INCLUDED\t3D", "DATA_INCLUDED\tForce"),
        "wrong_kind",
        TSV,
        "DATA_INCLUDED",
    ),
    Row("forces in the place of coordinates", content(MOT, FORCES), "wrong_kind", MOT),
    Row(
        "markers in the place of coordinates",
        lambda person: shutil.copy(person / TSV, person / MOT),
        "wrong_kind",
        MOT,
    ),
    Row(
        "coordinates in the place of a log",
        lambda person: shutil.copy(person / MOT, person / LOG),
        "wrong_kind",
        LOG,
    ),
    Row("a page to log in", content(TSV, HTML), "unknown_format", TSV),
    Row("a zip named as a log", content(LOG, b"PK\3\4" + bytes(60)), "unknown_format", LOG),
    Row(
        "a pointer of Git LFS",
        content(LOG, b"version https://git-lfs.github.com/spec/v1\noid sha256:0\nsize 1\n"),
        "unknown_format",
        LOG,
    ),
    Row("degrees without saying so", in_degrees_without_saying_so, "units_ambiguous", MOT, "header"),
    Row("no pelvis among the coordinates", other_coordinates, "column_missing", MOT),
    Row("a log of another robot", log_with(joints=other_joints), "joint_missing", LOG, "joint_states"),
    Row("a log of lost joints", log_with(joints=lost_joints), "not_finite", LOG, "joint_states"),
)
MARKERS = (
    Row("metres", markers(scaled(1e-3)), "extent", TSV),
    Row("micrometres", markers(scaled(1e3)), "extent", TSV),
    Row(
        "a marker missing",
        markers(lambda p: {k: v for k, v in p.items() if k != "IF_L"}),
        "marker_missing",
        TSV,
        "IF_L",
    ),
    Row(
        "the lab's own names",
        markers(renamed_markers({"ASIS_L": "LASI"}), "neutral.tsv"),
        "marker_missing",
        "neutral.tsv",
        "ASIS_L",
    ),
    Row(
        "names in small letters",
        markers(renamed_markers({"ASIS_L": "asis_l"})),
        "marker_missing",
        TSV,
        "ASIS_L",
    ),
    Row(
        "a mapped name that is nowhere", yaml_with(markers="{LASI: ASIS_L}"), "marker_source", YAML, "markers"
    ),
    Row(
        "two names for one marker", yaml_with(markers="{IF_L: IF_R}"), "names", "neutral.tsv", "MARKER_NAMES"
    ),
    Row(
        "a marker that stands twice",
        replaced(TSV, "ASIS_L\tASIS_R", "ASIS_L\tASIS_L"),
        "names",
        TSV,
        "MARKER_NAMES",
    ),
    Row(
        "an unnamed marker",
        replaced(TSV, "MARKER_NAMES\tASIS_L\t", "MARKER_NAMES\t\t"),
        "names",
        TSV,
        "MARKER_NAMES",
    ),
    Row(
        "left and right exchanged",
        markers(
            renamed_markers({"ASIS_L": "ASIS_R", "ASIS_R": "ASIS_L", "PSIS_L": "PSIS_R", "PSIS_R": "PSIS_L"}),
            "neutral.tsv",
            TSV,
        ),
        "sides",
        "neutral.tsv",
    ),
    Row(
        "the interface's markers exchanged",
        markers(renamed_markers({"IF_L": "IF_R", "IF_R": "IF_L"}), "neutral.tsv", TSV),
        WORKS,
        finding="marker_swap",
    ),
    Row("a lab with y up", markers(y_up, "neutral.tsv", TSV), "lab_axes", "neutral.tsv"),
    Row("a marker away for long", markers(hole), "incomplete", TSV, "IF_L"),
    Row("a marker in the origin for long", markers(in_the_origin), "incomplete", TSV, "PSIS_R"),
    Row("a trial of five frames", rows(lambda r: r[:5]), "too_short", TSV),
)
DESCRIPTIONS = (
    Row("subject.yml", rename(YAML, "subject.yml"), "subject_file", "S01"),
    Row("Subject.yaml", rename(YAML, "Subject.yaml"), "subject_file", "S01"),
    Row("subject.yaml.txt", rename(YAML, "subject.yaml.txt"), "subject_file", "S01"),
    Row("no subject.yaml", drop(YAML), "subject_file", "S01"),
    Row("an empty subject.yaml", content(YAML, b""), "key_missing", YAML),
    Row("comments alone", content(YAML, b"# to do\n"), "key_missing", YAML),
    Row("tabs before keys", replaced(YAML, "sex:", "\tsex:"), "yaml", YAML, "line"),
    Row("a bracket left open", content(YAML, b"id: [\n"), "yaml", YAML, "line"),
    Row("two documents", changed(YAML, lambda d: d + b"---\n" + d), "yaml", YAML),
    Row("subject.yaml in UTF-16", changed(YAML, lambda d: d.decode().encode("utf-16")), "yaml", YAML),
    Row("subject.yaml in Windows' letters", changed(YAML, lambda d: b"# G\xfcnther\n" + d), "yaml", YAML),
    Row("subject.yaml with a byte-order mark", changed(YAML, lambda d: b"\xef\xbb\xbf" + d), WORKS),
    Row("subject.yaml of Windows", changed(YAML, lambda d: d.replace(b"\n", b"\r\n")), WORKS),
    Row("a key twice", changed(YAML, lambda d: d + b"mass_kg: 70\n"), "yaml", YAML, "line 10"),
    Row("aliases of aliases", content(YAML, BOMB.encode()), "yaml", YAML, "line"),
    Row("nesting", content(YAML, b"a: " + b"[" * 5000), "yaml", YAML, "line"),
    Row("an unknown key", yaml_with(weight_kg="60"), "key_unknown", YAML),
    Row("a key with a typing error", yaml_with(mass_kg=None, mass_Kg="60"), "key_unknown", YAML),
    Row("no mass", yaml_with(mass_kg=None), "key_missing", YAML),
    Row("a mass of nothing", yaml_with(mass_kg=""), "value", YAML, "mass_kg"),
    Row("a mass in grams", yaml_with(mass_kg="60500"), "value", YAML, "mass_kg"),
    Row("a mass with a decimal comma", yaml_with(mass_kg="60,5"), "value", YAML, "mass_kg"),
    Row("a mass with its unit", yaml_with(mass_kg="60 kg"), "value", YAML, "mass_kg"),
    Row("a mass in quotes", yaml_with(mass_kg="'60.5'"), "value", YAML, "mass_kg"),
    Row("a mass that is NaN", yaml_with(mass_kg=".nan"), "not_finite", YAML, "mass_kg"),
    Row("a height in centimetres", yaml_with(height_m="166"), "value", YAML, "height_m"),
    Row("a waist in centimetres", yaml_with(waist_m="74"), "value", YAML, "waist_m"),
    Row("an age in months", yaml_with(age_years="324"), "value", YAML, "age_years"),
    Row("an age of yes", yaml_with(age_years="yes"), "value", YAML, "age_years"),
    Row("a sex by its letter", yaml_with(sex="F"), "value", YAML, "sex"),
    Row("a cohort in capitals", yaml_with(cohort="Calibration"), "value", YAML, "cohort"),
    Row("an id that is a number", yaml_with(id="1"), "value", YAML, "id"),
    Row("an id that is a date", yaml_with(id="2026-01-02"), "value", YAML, "id"),
    Row("an id with a blank", yaml_with(id="S 01"), "value", YAML, "id"),
    Row("an id in small letters", yaml_with(id="s01"), "subject_id", YAML, "id"),
    Row("an id of somebody else", yaml_with(id="S07"), "subject_id", YAML, "id"),
    Row("a template that was not filled in", yaml_with(height_m="TODO"), "value", YAML, "height_m"),
    Row("one level for all", yaml_with(tightness="8"), "value", YAML, "tightness"),
    Row(
        "no level of one's own",
        yaml_with(tightness="{loosest_cm: 3, tightest_cm: 11}"),
        "key_missing",
        YAML,
        "tightness",
    ),
    Row(
        "levels in millimetres",
        yaml_with(tightness="{loosest_cm: 30, tightest_cm: 110, safe_comfortable_cm: 80}"),
        "value",
        YAML,
        "tightness",
    ),
    Row(
        "half a centimetre",
        yaml_with(tightness="{loosest_cm: 3, tightest_cm: 11, safe_comfortable_cm: 8.5}"),
        "value",
        YAML,
        "tightness",
    ),
    Row(
        "equal levels",
        yaml_with(tightness="{loosest_cm: 8, tightest_cm: 8, safe_comfortable_cm: 8}"),
        "tightness",
        YAML,
        "tightness",
    ),
    Row(
        "an own level out of range",
        yaml_with(tightness="{loosest_cm: 3, tightest_cm: 11, safe_comfortable_cm: 15}"),
        "tightness",
        YAML,
        "safe_comfortable_cm",
    ),
    Row("a list of people", content(YAML, b"- id: S01\n- id: S02\n"), "value", YAML),
    Row("a text", content(YAML, b"subject one, female\n"), "value", YAML),
    Row("a marker that is not ours", yaml_with(markers="{LASI: LASIS}"), "value", YAML, "markers"),
    Row("a list of markers", yaml_with(markers="[LASI, RASI]"), "value", YAML, "markers"),
    Row("an exclusion without a reason", yaml_with(exclude="{dynamic_1: ''}"), "value", YAML, "exclude"),
    Row("an exclusion that is a list", yaml_with(exclude="[dynamic_1]"), "value", YAML, "exclude"),
)
TABLE = (*NAMES, *PEOPLE, *FILES, *CONTENTS, *MARKERS, *DESCRIPTIONS)


@pytest.fixture(scope="module")
def sound(tmp_path_factory):
    """A study of one person that nothing is wrong with."""
    root = tmp_path_factory.mktemp("sound")
    write_person(root / "subjects" / "S01", ("neutral", "dynamic_1"))
    return root


def run(root):
    """What the workflow does with raw files: people, then one ingest job each."""
    for name, person in discover(root / "subjects").items():
        ingest_subject(
            subject=name, folder=person.folder, settings=SETTINGS, raw=[], out=root / "trials" / name
        )


def check_message(error, root, row):
    """The code, and the four parts that tell somebody what to do: file, place, expectation, remedy."""
    text = str(error)
    assert error.code == row.code, text
    assert f"code:     {row.code} (docs/quality-codes.md)" in text
    assert error.path.is_relative_to(root), text
    assert row.file in str(error.path), text
    assert row.place in error.place, text
    assert text.splitlines()[0] == (f"{error.path}, {error.place}" if error.place else f"{error.path}")
    assert error.found
    assert row.found in error.found, text
    assert error.expected
    assert error.found != error.expected
    assert len(error.remedy.split()) >= REMEDY_WORDS or error.remedy in (
        "Correct it.",
        "Add the key.",
        "Mend the syntax.",
    ), text
    assert all(part in text for part in (error.found, error.expected, error.remedy))
    assert len(text) < 2000


def test_the_table_is_long_enough_and_names_each_kind_once():
    names = [row.name for row in TABLE]
    assert len(set(names)) >= 80


@pytest.mark.parametrize("row", TABLE, ids=[f"{row.name} -> {row.code}" for row in TABLE])
def test_a_hostile_folder_is_read_or_refused(sound, tmp_path, row):
    root = tmp_path / "study"
    shutil.copytree(sound, root)
    row.make(root / "subjects" / "S01")
    if row.code == WORKS:
        run(root)
        found = [read_json(path)["findings"] for path in (root / "trials").rglob("quality.json")]
        assert found
        assert not row.finding or row.finding in {finding["code"] for one in found for finding in one}
        return
    with pytest.raises(InputError) as caught:
        run(root)
    check_message(caught.value, root, row)


@pytest.mark.skipif(os.geteuid() == 0, reason="root reads every file")
@pytest.mark.parametrize("name", [TSV, MOT, LOG, YAML])
def test_a_file_that_may_not_be_read(sound, tmp_path, name):
    root = tmp_path / "study"
    shutil.copytree(sound, root)
    (root / "subjects" / "S01" / name).chmod(0)
    with pytest.raises(InputError) as caught:
        run(root)
    check_message(caught.value, root, Row("", None, "unreadable", name))
