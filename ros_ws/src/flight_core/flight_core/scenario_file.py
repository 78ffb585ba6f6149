# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Read scenario files without ROS, by rcl's rules for ROS parameter files.

/**/controller:
  ros__parameters:
    rate: 100.0    # Hz

A scenario file has a section for each node. rcl joins the sections that match the full name of a
node, in the order of the file, so that a later value replaces an earlier one. In the name of a
section, `**` stands for any number of names, and `*` for one. From a section for all nodes, a node
takes only the parameters that it knows.
"""

import difflib
import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from flight_core.files import limited, parse_yaml
from flight_core.parameters import Config, ParameterError, one_of, require

Sections = dict[str, dict[str, Any]]

A_SCENARIO = "a scenario file"

PARAMETERS = "ros__parameters"
SIM_TIME = "use_sim_time"
ROS_PARAMETERS = (SIM_TIME, "start_type_description_service", "qos_overrides")
"""Parameters that ROS gives every node."""

WILDCARDS: Mapping[str, str] = {"**": "(/[^/]+)*", "*": "/[^/]+"}
# similarity from which on an unknown section, such as recoder, is taken as a misspelt name of a
# missing section
MISTYPED = 0.8


def parse_sections(
    content: bytes,
    path: Path,
    schemas: Mapping[str, type[Config]],
    optional: tuple[str, ...] = (),
    namespace: str | None = None,
    *,
    with_general: bool = False,
) -> Sections:
    """Return the sections of a scenario file by node, as in {"controller": {"rate": 100.0, ...}}.

    Sections of nodes that are not among `schemas` are left out. A section in `optional` can be
    absent or an empty mapping, and then has only defaults. Parameters of ROS itself are left out,
    but if a node follows /clock, `use_sim_time` of the section `flight` becomes true. `namespace`
    is the namespace of the nodes, "" for the root. If it is None, any namespace is accepted. If
    `with_general` is set, a node without a section gets one from the parameters for all nodes.

    Raises ParameterError with the path if the content is no scenario file or too long, has a
    duplicate key, lacks a section, or names nodes of two namespaces while `namespace` is None.
    """
    found = _all_sections(content, path)
    expected = [name for name in schemas if name not in optional]
    sections: Sections = {}
    is_simulated = False
    for name, schema in schemas.items():
        matching = [pattern for pattern in found if _is_for(pattern, name, namespace)]
        own = [pattern for pattern in matching if _is_of(pattern, name)]
        if namespace is None:
            _require_one_namespace(own, name, path)
        if not own and not (with_general and matching):
            _require_not_mistyped(found, name, schemas, path)
            require(
                name in optional,
                f"{path.name}: {name}",
                "no such section",
                f"one for each of {', '.join(expected)}",
            )
            continue
        everything: dict[str, Any] = {}
        for pattern in matching:
            join_parameters(everything, found[pattern])
        known = schema.keys_beside(everything)
        values: dict[str, Any] = {}
        for pattern in matching:
            given = found[pattern]
            if pattern not in own:
                given = {key: value for key, value in given.items() if key in known}
            join_parameters(values, given)
        for key in ROS_PARAMETERS:
            if key not in schema.model_fields:
                values.pop(key, None)
        require(
            bool(values) or name in optional,
            f"{path.name}: {name}",
            f"no parameters under {PARAMETERS}",
            "a mapping of them there, as in every ROS parameter file",
        )
        is_simulated |= everything.get(SIM_TIME) is True
        sections[name] = values
    if is_simulated and "flight" in sections:
        sections["flight"][SIM_TIME] = True
    return sections


def is_given_to_node(content: bytes, path: Path, name: str, key: str, namespace: str) -> bool:
    """Return whether a section for the node `name` has the parameter `key`.

    Sections for all nodes are left out. Raises ParameterError if the content is no ROS parameter
    file.
    """
    return any(
        _is_of(pattern, name) and _is_for(pattern, name, namespace) and key in values
        for pattern, values in _all_sections(content, path).items()
    )


def is_given_to_all(content: bytes, path: Path, key: str) -> bool:
    """Return whether a file gives the parameter `key` to all nodes.

    Raises as `is_given_to_node` does.
    """
    return any(
        pattern.rpartition("/")[2] in WILDCARDS and key in values
        for pattern, values in _all_sections(content, path).items()
    )


def section_names(content: bytes, path: Path) -> list[str]:
    """Return the full names of the nodes that have a section, in order.

    Raises as `is_given_to_node` does.
    """
    return list(_all_sections(content, path))


def has_general(content: bytes, path: Path) -> bool:
    """Return whether there is a section for all nodes. Raises as `is_given_to_node` does."""
    return any(pattern.rpartition("/")[2] in WILDCARDS for pattern in _all_sections(content, path))


def _all_sections(content: bytes, path: Path) -> dict[str, dict[Any, Any]]:
    """Read the parameters in a file by the full names of nodes, in order."""
    tree = parse_yaml(limited(content, str(path), A_SCENARIO), str(path), A_SCENARIO)
    require(isinstance(tree, dict), str(path), f"{type(tree).__name__}", "a mapping with sections")
    return {
        pattern: _nested(values)
        for top, section in tree.items()
        for pattern, values in _node_sections(top, section, path)
    }


def _node_sections(
    top: object, section: object, path: Path, namespace: str = ""
) -> Iterator[tuple[str, Mapping[Any, Any]]]:
    """Yield the full names of nodes and their parameters. Namespaces can be nested."""
    pattern = f"{namespace}/{str(top).strip('/')}"
    parts: Mapping[Any, Any] = section if isinstance(section, dict) else {}
    values = parts.get(PARAMETERS)
    is_section = isinstance(values, dict) and len(parts) == 1
    is_namespace = PARAMETERS not in parts and all(map(_is_mapping, parts.values()))
    require(
        is_section or (bool(parts) and is_namespace),
        f"{path.name}: {pattern.removeprefix('/**/').removeprefix('/').partition('/')[0]}",
        f"no parameters under {PARAMETERS}",
        "a mapping of them there, as in every ROS parameter file",
    )
    if isinstance(values, dict):
        yield pattern, values
        return
    for key, part in parts.items():
        yield from _node_sections(key, part, path, pattern)


def _is_mapping(value: object) -> bool:
    return isinstance(value, dict)


def _is_for(pattern: str, name: str, namespace: str | None) -> bool:
    """Return whether a section is for a node, in any namespace if `namespace` is None."""
    *_, last = pattern.split("/")
    if namespace is None:
        return last == name or last in WILDCARDS
    words = pattern.split("/")[1:]
    regex = "".join(WILDCARDS.get(word, f"/{re.escape(word)}") for word in words)
    return re.fullmatch(regex, f"/{namespace.strip('/')}/{name}".replace("//", "/")) is not None


def _is_of(pattern: str, name: str) -> bool:
    return pattern.rpartition("/")[2] == name


def _require_one_namespace(own: list[str], name: str, path: Path) -> None:
    places = [pattern.rpartition("/")[0] for pattern in own if "*" not in pattern]
    spaces = list(dict.fromkeys(place for place in places if place))
    require(
        len(spaces) < 2,
        f"{path.name}: {name}",
        f"sections in {' and in '.join(spaces)}",
        "sections in one namespace",
    )


def _require_not_mistyped(
    found: Mapping[str, object], name: str, schemas: Mapping[str, object], path: Path
) -> None:
    """Raise ParameterError if an unknown section has nearly the name of a missing section."""
    foreign = [pattern.rpartition("/")[2] for pattern in found]
    foreign = [other for other in foreign if other not in schemas]
    near = difflib.get_close_matches(name, foreign, n=1, cutoff=MISTYPED)
    if near:
        raise ParameterError(
            f"{path.name}: {near[0]}: found a section, expected {one_of(list(schemas), near[0])}"
        )


def _nested(values: Mapping[Any, Any]) -> dict[Any, Any]:
    """Return the parameters with nested groups in place of dotted names."""
    tree: dict[Any, Any] = {}
    for key, value in values.items():
        name, dot, rest = key.partition(".") if isinstance(key, str) else (key, "", "")
        inner = {rest: value} if dot and rest and name else value
        outer = name if dot and rest and name else key
        join_parameters(tree, {outer: _nested(inner) if isinstance(inner, Mapping) else inner})
    return tree


def join_parameters(values: dict[Any, Any], further: Mapping[Any, Any]) -> None:
    """Merge further parameters into `values`, where they replace parameters of the same name."""
    for key, value in further.items():
        before = values.get(key)
        if isinstance(before, dict) and isinstance(value, Mapping):
            join_parameters(before, value)
        else:
            values[key] = _copy(value)


def _copy(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {key: _copy(item) for key, item in value.items()}
    return value
