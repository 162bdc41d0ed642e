"""The files that an MJCF pulls in: included parts, meshes, height fields, textures, skins and attached models."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from pathlib import Path

# Attributes of the elements below <asset> that name a file, and the attribute of <compiler> with their folder
_FOLDERS = {"mesh": "meshdir", "hfield": "meshdir", "skin": "meshdir", "texture": "texturedir"}
_SIDES = ("right", "left", "up", "down", "front", "back")


def model_files(model: Path) -> tuple[Path, ...]:
    """Return the MJCF and every file that it pulls in, however far, each once and in order of appearance.

    Files that are not there, and parts that are not XML, are listed as well: MuJoCo says what is wrong with them.
    """
    found: dict[Path, None] = {}
    _collect(Path(model), Path(model).parent, {}, found)
    return tuple(found)


def _collect(part: Path, home: Path, folders: dict[str, str], found: dict[Path, None]) -> None:
    """Add a part of the model whose main file is in ``home``; ``folders`` are those of the parts before it."""
    if part in found:
        return
    found[part] = None
    try:
        root = ET.parse(part).getroot()
    except (OSError, ET.ParseError):
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
                found[bare if bare.exists() and not (folder / name).exists() else folder / name] = None


def _folders_of(part: Path) -> dict[str, str]:
    try:
        root = ET.parse(part).getroot()
    except (OSError, ET.ParseError):
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
