"""The files that an MJCF pulls in: included parts, meshes, height fields, textures, skins and attached models."""

from __future__ import annotations

import os
import re
import xml.etree.ElementTree as ET
from pathlib import Path

# Attributes of the elements below <asset> that name a file, and the attribute of <compiler> with their folder
_FOLDERS = {"mesh": "meshdir", "hfield": "meshdir", "skin": "meshdir", "texture": "texturedir"}
_TAG = re.compile(r"<(\w++)([^<>]*+)>")
_ATTRIBUTE = re.compile(r"(?<!\w)(\w++)\s*+=\s*+(?:\"([^\"]*)\"|'([^']*)')")
_SIDES = ("right", "left", "up", "down", "front", "back")


def model_files(model: Path) -> tuple[Path, ...]:
    """Return the MJCF and every file that it pulls in, however far, each once and in order of appearance.

    Files that are not there, and parts that are not XML, are listed as well: MuJoCo says what is wrong with them.
    """
    found: dict[str, Path] = {}
    _collect(Path(model), Path(model).parent, {}, found)
    return tuple(found.values())


def _collect(part: Path, home: Path, folders: dict[str, str], found: dict[str, Path]) -> None:
    """Add a part of the model whose main file is in ``home``; ``folders`` are those of the parts before it."""
    if not _add(part, found):
        return
    root = _root(part)
    if root is None:
        return
    included = [home / e.get("file", "") for e in root.iter("include") if e.get("file")]
    own = dict(folders)
    for compiler in root.iter("compiler"):
        own |= {
            key: compiler.get(key, "") for key in ("assetdir", "meshdir", "texturedir") if compiler.get(key)
        }
    for file in included:
        _collect(file, home, own, found)
        # a part may hold the compiler's folders for the whole model
        own = _folders_of(file) | own
    for element in root.iter():
        for name in _files_of(element):
            if element.tag == "model":
                attached = home / name
                _collect(attached, attached.parent, {}, found)
            elif element.tag in _FOLDERS:
                folder = home / own.get(_FOLDERS[element.tag], own.get("assetdir", ""))
                # with strippath only the last part of the name counts
                bare = folder / Path(name).name
                # names that no file can have are not there for os.path, and an error for Path
                stripped = os.path.exists(bare) and not os.path.exists(folder / name)
                _add(bare if stripped else folder / name, found)


def _add(file: Path, found: dict[str, Path]) -> bool:
    """Add a file; return False where it is there, also by another way: a model may attach itself as ../a/m.xml."""
    name = os.path.realpath(file)
    if name in found:
        return False
    found[name] = file
    return True


def find_attachment_loop(model: Path) -> Path | None:
    """Return a model that attaches itself, also by way of others, None where none does: MuJoCo crashes on it."""
    return _loop(Path(model), (), set())


def _loop(model: Path, above: tuple[str, ...], cleared: set[str]) -> Path | None:
    own = os.path.realpath(model)
    if own in above:
        return model
    if own not in cleared:
        for name in _attached(model):
            found = _loop(model.parent / name, (*above, own), cleared)
            if found is not None:
                return found
        cleared.add(own)
    return None


def _attached(model: Path) -> list[str]:
    """Return the names of the models that an MJCF attaches, itself or in parts that it includes."""
    names, parts, seen = [], [model], set()
    while parts:
        part = parts.pop()
        root = _root(part) if os.path.realpath(part) not in seen else None
        seen.add(os.path.realpath(part))
        if root is not None:
            names += [e.get("file", "") for e in root.iter("model") if e.get("file")]
            parts += [model.parent / e.get("file", "") for e in root.iter("include") if e.get("file")]
    return names


def _root(part: Path) -> ET.Element | None:
    """Return the root of an XML file, None where it is none; a pipe is not opened, which would wait for ever."""
    if not os.path.isfile(part):
        return None
    try:
        return ET.parse(part).getroot()
    except OSError:
        return None
    except (ET.ParseError, LookupError, ValueError):  # the last two of encodings that Python lacks
        return _by_tags(part)


def _by_tags(part: Path) -> ET.Element:
    """Return the tags and attributes of a file that is no sound XML, one beside the other.

    MuJoCo reads some of them all the same: those with -- in a comment, or with a wrong encoding in their first line.
    """
    root = ET.Element("mujoco")
    pieces = part.read_bytes().decode(errors="replace").split("<!--")
    text = "".join([pieces[0], *(piece.partition("-->")[2] for piece in pieces[1:])])
    for tag, attributes in _TAG.findall(text):
        values = {name: double or single for name, double, single in _ATTRIBUTE.findall(attributes)}
        ET.SubElement(root, tag, values)
    return root


def _folders_of(part: Path) -> dict[str, str]:
    root = _root(part)
    if root is None:
        return {}
    return {
        key: compiler.get(key, "")
        for compiler in root.iter("compiler")
        for key in ("assetdir", "meshdir", "texturedir")
        if compiler.get(key)
    }


def _files_of(element: ET.Element) -> list[str]:
    names = [element.get("file"), *(element.get(f"file{side}") for side in _SIDES)]
    return [name for name in names if name]
