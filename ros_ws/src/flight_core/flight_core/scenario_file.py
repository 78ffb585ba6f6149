# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Scenario files: a ROS parameter file with a section per node, read without ROS.

/**/controller:
  ros__parameters:
    rate: 100.0    # Hz
"""

from pathlib import Path
from typing import Any

from flight_core.files import limited, parse_yaml
from flight_core.parameters import require

Sections = dict[str, dict[str, Any]]

A_SCENARIO = "a scenario file"


def parse_sections(
    content: bytes, path: Path, expected: tuple[str, ...], optional: tuple[str, ...] = ()
) -> Sections:
    """Sections of a scenario file by node name, e.g. {"controller": {"rate": 100.0, ...}}.

    A section in `optional` may be absent, or an empty mapping: every parameter by default. Raises
    ParameterError with the path for content that is no scenario file or too long, has a duplicate
    key, or lacks or adds a section.
    """
    tree = parse_yaml(limited(content, str(path), A_SCENARIO), str(path), A_SCENARIO)
    require(
        isinstance(tree, dict),
        str(path),
        f"{type(tree).__name__}",
        f"a mapping with {', '.join(expected)}",
    )
    sections: Sections = {}
    for key, section in tree.items():
        name = str(key).removeprefix("/**/").removeprefix("/")
        known = (*expected, *optional)
        require(name in known, f"{path.name}: {name}", "a section", f"only {', '.join(known)}")
        values = section.get("ros__parameters") if isinstance(section, dict) else None
        require(
            isinstance(values, dict)
            and (bool(values) or name in optional)
            and set(section) == {"ros__parameters"},
            f"{path.name}: {name}",
            "no parameters under ros__parameters",
            "a mapping of them there, as in every ROS parameter file",
        )
        sections[name] = dict(values or {})
    for name in expected:
        require(
            name in sections,
            f"{path.name}: {name}",
            "no such section",
            f"one for each of {', '.join(expected)}",
        )
    return sections
