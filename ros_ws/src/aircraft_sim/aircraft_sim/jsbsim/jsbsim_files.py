# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Collect the files of a foreign model of JSBSim, and refuse what such a model may not do.

A foreign model is one that the package jsbsim does not contain. Its files are found as JSBSim finds
files, and JSBSim loads only a copy of them. Sources: JSBSim 1.3, FGModelLoader.cpp (a name without
".xml" gets it), FindFullPathName of FGModel, FGFCS and FGPropulsion (the folders),
FGFDMExec::LoadModel (input and output), FGPropagate.cpp and FGLinearization.cpp (properties that
write a file), sg_path.cxx (a backslash is a slash).
"""

import io
import zipfile
from collections.abc import Iterator, Mapping
from itertools import chain
from pathlib import Path, PurePosixPath
from types import MappingProxyType
from typing import NamedTuple
from xml.etree import ElementTree
from xml.parsers import expat
from xml.sax.saxutils import quoteattr

from aircraft_sim.jsbsim.jsbsim_aircraft import SUFFIX, root_of
from flight_core.files import open_nonblocking
from flight_core.parameters import ParameterError, require

# Sections of a model that open a socket or write a file. Inside of other sections these elements
# name properties.
LEFT_OUT = ("input", "output")
CHILD = "child"  # section that names another model, which JSBSim does not support yet
# Properties of simulation/ to which JSBSim responds by writing a file.
WRITERS = ("do_linearization", "write-state-file")

ENGINE_FOLDERS = ("Engines", "engines", "Engine", "engine")
FOLDERS: Mapping[str, tuple[str, ...]] = MappingProxyType(
    {"engine": ENGINE_FOLDERS, "thruster": ENGINE_FOLDERS, "system": ("", "Systems", "systems")}
)
"""Folders beside the model in which JSBSim looks for the file of an element; "" is the folder of
the model itself."""
ROOT_FOLDERS: Mapping[str, str] = MappingProxyType(
    {"engine": "engine", "thruster": "engine", "system": "systems"}
)
"""Folder of the root in which JSBSim looks for the file of an element if it is in none of FOLDERS.
"""
SECTIONS = frozenset(
    {
        "metrics",
        "mass_balance",
        "ground_reactions",
        "external_reactions",
        "buoyant_forces",
        "propulsion",
        "autopilot",
    }
    | {"flight_control", "aerodynamics", "planet"}
)
"""Further elements for which JSBSim reads the file in their attribute `file`. In any other element,
this attribute has no effect."""


# largest size of a file; the largest of JSBSim's files has a third of a megabyte
MOST_BYTES = 16 << 20


class ModelFiles(NamedTuple):
    """A model and all files that it names, laid out as a root folder of JSBSim."""

    model: str  # path of the model in the root
    # Content by path. aircraft/NAME/ has the files beside the model, engine/ and systems/ have the
    # others.
    members: Mapping[str, bytes]
    left_out: tuple[str, ...]  # sections that are not loaded, such as <output name="x.csv">

    def write(self, root: Path) -> Path:
        """Write the files below `root`, and return the path of the model in this folder."""
        for name, content in self.members.items():
            path = root / name
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(content)
        return root / self.model

    def archive(self) -> bytes:
        """Return a zip file of the root; the same files always give the same bytes.

        If it is unpacked to FOLDER, the airframe jsbsim:FOLDER/aircraft/NAME flies as the original
        model.
        """
        content = io.BytesIO()
        with zipfile.ZipFile(content, "w", zipfile.ZIP_DEFLATED) as archive:
            for name, member in self.members.items():
                archive.writestr(zipfile.ZipInfo(name), member, zipfile.ZIP_DEFLATED)
        return content.getvalue()


class _Place(NamedTuple):
    """A file for JSBSim: its path in the new root, and its original path."""

    member: str
    path: Path


def model_files(model: Path) -> ModelFiles:
    """Collect the files of a model that does not come from the package jsbsim.

    Raises ParameterError if a file is missing or cut short, or lies outside of the model's folder
    and of the model's root, also by way of a link, and if the model has a child model or a property
    that writes a file.
    """
    first = _Place(f"aircraft/{model.stem}/{model.name}", model)
    members: dict[str, bytes] = {}
    left_out: tuple[str, ...] = ()
    waiting = [first]
    missing = dict[str, str]()
    while waiting:
        place = waiting.pop()
        if place.member in members:
            continue
        content = _content(place.path)
        tree = _parsed(content, place.path)
        _require_no_writer(tree, place.path)
        if place == first:
            left_out = _leave_out(tree, model)
            if left_out:
                content = ElementTree.tostring(tree, encoding="utf-8", xml_declaration=True)
        members[place.member] = content
        for element in tree.iter():
            if (name := element.get("file")) and (
                element.tag in ROOT_FOLDERS or element.tag in SECTIONS
            ):
                source = next(_places(model, element.tag, _relative(name, place.path)), None)
                waiting += [] if source is None else [source]
                missing |= {name: element.tag} if source is None else {}
    if missing:
        raise _missing_files(model, missing)
    return ModelFiles(first.member, dict(sorted(members.items())), left_out)


def _places(model: Path, element: str, name: str) -> Iterator[_Place]:
    """Yield the files called `name` in the folders of an element, in the order of JSBSim.

    Raises ParameterError if such a file is a link that leaves its folder.
    """
    root = root_of(model)
    folders = [
        (f"aircraft/{model.stem}/{folder}", model.parent, folder)
        for folder in FOLDERS.get(element, ("",))
    ]
    if (root_folder := ROOT_FOLDERS.get(element)) is not None:
        folders.append((root_folder, root, root_folder))
    for member, base, folder in folders:
        path = base / folder / name
        if path.is_file():
            inside = path.resolve().is_relative_to(base.resolve())
            require(
                inside,
                str(model),
                f"the file {name}, a link to {path.resolve()}",
                f"a file below {base}",
            )
            yield _Place(f"{member}/{name}".replace("//", "/"), path)


def _relative(name: str, path: Path) -> str:
    """Return the relative path of a named file, with its suffix.

    Raises ParameterError if the path leaves the folder.
    """
    plain = PurePosixPath(name.replace("\\", "/"))
    inside = not plain.is_absolute() and ".." not in plain.parts
    require(
        inside, str(path), f"the file {name!r}", "one below the folder of the model, without .."
    )
    return str(plain).removesuffix(SUFFIX) + SUFFIX


def _missing_files(model: Path, missing: Mapping[str, str]) -> ParameterError:
    """Return the error for missing files of a model.

    `missing` has the names of the files, each with the element of the model that names it. The
    error is about the first file, and about the others that are searched in the same folders.
    """
    element = next(iter(missing.values()))
    names = sorted(
        {
            name.removesuffix(SUFFIX)
            for name, tag in missing.items()
            if FOLDERS.get(tag) == FOLDERS.get(element)
        }
    )
    folders = [str(model.parent / FOLDERS.get(element, ("",))[0])]
    if (root_folder := ROOT_FOLDERS.get(element)) is not None:
        folders.append(str(root_of(model) / root_folder))
    files = ", ".join(name + SUFFIX for name in names)
    return ParameterError(f"{model}: found no file {files}, expected it in {' or '.join(folders)}")


def _content(path: Path) -> bytes:
    try:
        with open_nonblocking(path) as stream:
            content = stream.read(MOST_BYTES + 1)
    except OSError as error:
        raise ParameterError(
            f"{path}: cannot be read ({error.strerror}), expected a file of a model"
        ) from None
    require(
        len(content) <= MOST_BYTES, str(path), f"more than {MOST_BYTES} bytes", "a file of a model"
    )
    return content


def _parsed(content: bytes, path: Path) -> ElementTree.Element:
    """Parse XML as JSBSim reads it, which means that names have no namespaces.

    Raises ParameterError if the text is not well formed.
    """
    builder = ElementTree.TreeBuilder()
    parser = expat.ParserCreate()
    parser.buffer_text = True
    parser.StartElementHandler = builder.start
    parser.EndElementHandler = builder.end
    parser.CharacterDataHandler = builder.data
    try:
        parser.Parse(content, True)
    except expat.ExpatError as error:
        raise ParameterError(f"{path}: found XML with {error}, expected a whole file") from None
    return builder.close()


def _leave_out(tree: ElementTree.Element, model: Path) -> tuple[str, ...]:
    """Remove the sections in LEFT_OUT from a model, and return the start tags of those removed.

    Raises ParameterError for a child model.
    """
    require(
        tree.find(CHILD) is None,
        str(model),
        "a child model",
        "none: JSBSim does not support it yet",
    )
    sections = [section for section in tree if section.tag in LEFT_OUT]
    for section in sections:
        tree.remove(section)
    return tuple(map(_start_tag, sections))


def _start_tag(element: ElementTree.Element) -> str:
    attributes = [f"{key}={quoteattr(text)}" for key, text in element.items()]
    return f"<{' '.join([element.tag, *attributes])}>"


def _require_no_writer(tree: ElementTree.Element, path: Path) -> None:
    """Check that a file does not contain the name of a property by which JSBSim writes a file.

    Raises ParameterError if it does.
    """
    attributes = chain.from_iterable(element.attrib.values() for element in tree.iter())
    text = "".join([*tree.itertext(), *attributes])
    for name in WRITERS:
        require(
            name not in text,
            str(path),
            f"the property simulation/{name}, which writes a file",
            "a model without it",
        )
