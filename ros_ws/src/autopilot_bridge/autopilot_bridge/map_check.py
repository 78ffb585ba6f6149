# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Check which rows of a channel map are right for a release of an autopilot.

A row is right if the message definition has the field of the row, with the components that the
row's function needs. For PX4, the topic must also have the version of the definition. If the text
`source` of a condition names constants of the message, their values must be among `one_of` of the
condition.
"""

import re
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

from rosbags.interfaces import Nodetype
from rosbags.typesys import TypesysError, get_types_from_msg

from autopilot_bridge import mavlink_link
from autopilot_bridge.channel_map import QUATERNION, STEP, versioned_topic
from autopilot_bridge.map_rows import MAVLINK
from autopilot_bridge.params import ChannelMap, UsedField
from flight_core.files import read_file
from flight_core.installation import require_package
from flight_core.outcome import Refusal
from flight_core.parameters import ParameterError, require
from flight_log.message_definitions import definition, read_definition
from flight_log.named_vectors import typestore

Types = Mapping[str, tuple[Any, Any]]
"""Constants (name, type, value) and fields (name, type) by the full name of a message, as rosbags
has them."""

PACKAGE = re.compile(rb"<name>\s*(\w+)\s*</name>")  # name in a package.xml (REP 149)
CONSTANT = re.compile(r"\b[A-Z][A-Z0-9]*_[A-Z0-9_]+\b")
# The line that ends the request in the definition of a service.
REQUEST_END = re.compile(r"^---\s*$", re.MULTILINE)
VERSION = "MESSAGE_VERSION"  # the constant in definitions of PX4


class CheckedRow(NamedTuple):
    """The result of checking a field that a row of a map reads or sets.

    `faults` has an entry for each release: why the row is wrong, or None if it is right.
    """

    key: str
    topic: str
    field: str
    faults: tuple[Refusal | None, ...]


def definitions_below(folder: Path, kinds: Iterable[str]) -> Types:
    """Return the definitions of the message types `kinds`, read from packages below a folder.

    The result also has all types that the `kinds` contain. Types that no package has are left out.
    Raises ParameterError if there is no folder, no package with a folder `msg` below it, or a
    definition that cannot be read.
    """
    expected = (
        "a folder with the sources of a message package: package.xml, msg/*.msg, and srv/*.srv for "
        "services"
    )
    require(folder.is_dir(), "--definitions", f"{folder}, which is no folder", expected)
    packages = {}
    for path in sorted(folder.rglob("package.xml")):
        if (match := PACKAGE.search(read_file(path, str(path), "a package.xml"))) and (
            path.parent / "msg"
        ).is_dir():
            packages[match[1].decode()] = path.parent
    require(bool(packages), "--definitions", f"{folder} without a message package", expected)
    types: dict[str, tuple[Any, Any]] = {}
    waiting = list(kinds)
    while waiting:
        kind = waiting.pop()
        package, section, name = kind.split("/")
        path = packages.get(package, folder) / section / f"{name}.{section}"
        if kind in types or package not in packages or not path.is_file():
            continue
        types |= _parsed(
            read_file(path, str(path), "a message definition").decode(errors="replace"), kind
        )
        waiting += [
            _element(field)[1] for _, field in types[kind][1] if _element(field)[0] is Nodetype.NAME
        ]
    return types


def installed_definitions(kinds: Iterable[str]) -> Types:
    """Return the definitions of the message types `kinds`, as they are installed.

    The result also has all types that the `kinds` contain. The definitions come from the installed
    message packages and, for MAVLink, from pymavlink. Types that are not installed are left out.
    Raises ParameterError for a type of MAVLink if pymavlink is not installed.
    """
    types: dict[str, tuple[Any, Any]] = {}
    for kind in kinds:
        if kind.startswith(f"{MAVLINK}/"):
            require_package("pymavlink")
        try:
            if kind.startswith(f"{MAVLINK}/"):
                fields = mavlink_link.mavlink_type(kind.rpartition("/")[2]).fields
                types[kind] = [], [(name, (Nodetype.BASE, ("float64", 0))) for name in fields]
            elif "/srv/" in kind:
                types |= _parsed(read_definition(kind, "srv"), kind)
            else:
                types |= _parsed(definition(kind).text, kind)
        except ParameterError:
            continue
    return types


def check_map(channel_map: ChannelMap, releases: Iterable[Types]) -> list[CheckedRow]:
    """Check each field that a map uses against the message definitions of several releases.

    A definition that states no version has version 0.
    """
    releases = list(releases)
    rows = []
    for used in channel_map.used_fields():
        faults = []
        for types in releases:
            fault = _fault(types, used)
            faults.append(fault or _constant_fault(types, channel_map, used.key, used.type))
        rows.append(
            CheckedRow(key=used.key, topic=used.topic, field=used.path, faults=tuple(faults))
        )
    return rows


def is_known(types: Types, kind: str) -> bool:
    """Return whether a message is defined in `types` or in ROS 2 Jazzy."""
    return kind in types or kind in typestore().fielddefs


def _parsed(text: str, kind: str) -> Types:
    """Return the types in the text of a definition. For a service, this is only the request."""
    try:
        if "/srv/" in kind:
            (request,) = get_types_from_msg(REQUEST_END.split(text)[0], kind).values()
            return {kind: request}
        return get_types_from_msg(text, kind)
    except (TypesysError, ValueError, LookupError) as error:
        raise ParameterError(
            f"{kind}: found a definition that cannot be read ({error}), expected one of ROS 2"
        ) from None


def _element(field: Any) -> tuple[Nodetype, Any]:
    """Return the type of a field. For an array, this is the type of its elements."""
    node, content = field
    return content[0] if node in {Nodetype.ARRAY, Nodetype.SEQUENCE} else (node, content)


def _fault(types: Types, used: UsedField) -> Refusal | None:
    definitions = {**typestore().fielddefs, **types}
    kind, topic, components = used.type, used.topic, used.components
    if not is_known(types, kind):
        return Refusal(f"no {kind}")
    version = next((value for name, _, value in definitions[kind][0] if name == VERSION), 0)
    if (expected := versioned_topic(topic, version)) != topic:
        return Refusal(f"{topic}: version {version}, whose topic is {expected}")
    member_kind = kind
    field = (Nodetype.NAME, kind)
    for step in used.path.split("."):
        match = STEP.fullmatch(step)
        fields = dict(definitions[member_kind][1]) if member_kind in definitions else {}
        if match is None or match[1] not in fields:
            return Refusal(f"no {step}")
        node, content = fields[match[1]]
        if match[2] is not None and node is Nodetype.ARRAY and int(match[2]) >= content[1]:
            return Refusal(f"{match[1]} has only {content[1]} elements")
        element = _element((node, content))
        field = (node, content) if match[2] is None else element
        member_kind = element[1] if element[0] is Nodetype.NAME else ""
    if components is None or _has_components(definitions, field, components):
        return None
    return Refusal(f"{used.path}: no {', '.join(components) or 'number'}")


def _has_components(definitions: Types, field: Any, components: str) -> bool:
    """Return whether a field has the given components, as members or in an array.

    If `components` is "", the result says whether the field is a number.
    """
    node, content = field
    if node is Nodetype.NAME:
        return (
            bool(components)
            and content in definitions
            and {*components} <= {name for name, _ in definitions[content][1]}
        )
    if node is Nodetype.BASE:
        return not components and content[0] != "string"
    return bool(components) and (
        node is Nodetype.SEQUENCE or components != QUATERNION or content[1] == len(QUATERNION)
    )


def _constant_fault(types: Types, channel_map: ChannelMap, key: str, kind: str) -> Refusal | None:
    section, _, name = key.partition(".")
    row = channel_map.conditions.get(name) if section == "conditions" else None
    if row is None or not row.one_of or kind not in types:
        return None
    values = {constant: value for constant, _, value in types[kind][0]}
    constants = [constant for constant in CONSTANT.findall(row.source) if constant in values]
    wrong = [
        f"{constant} = {values[constant]}"
        for constant in constants
        if values[constant] not in row.one_of
    ]
    return Refusal(f"{', '.join(wrong)}, which one_of lacks") if wrong else None
