# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Find message definitions for MCAP and rosbag2, in the installed packages or in rosbags.

The module needs no ROS at run time.
"""

import json
import os
import sys
from functools import cache
from pathlib import Path
from typing import NamedTuple

from flight_core.parameters import ParameterError


class MessageDefinition(NamedTuple):
    """A message type as stored in a log."""

    name: str  # "sensor_msgs/msg/JointState"
    text: str  # its definition, and the definitions of all referenced types
    type_hash: str  # "RIHS01_..."


@cache
def definition(name: str) -> MessageDefinition:
    """Return the definition of a message type, by its name "pkg/msg/Type".

    The text begins with the main definition. For each referenced type, a line of 80 "=", a line
    "MSG: pkg/Type" and the definition of this type follow (MCAP registry, schema encoding ros2msg).
    The hash by REP 2016 comes from the JSON of the package. For the common types of ROS 2 Jazzy,
    rosbags has the same fields and the same hash, but no comments. Raises ParameterError if neither
    an installed package nor rosbags has the type.
    """
    try:
        description = json.loads(read_definition(name, "json"))
    except ParameterError:
        from flight_log.named_vectors import typestore  # noqa: PLC0415 - loads rosbags, which a recorder lacks

        store = typestore()
        if name not in store.fielddefs:
            raise
        return MessageDefinition(
            name, store.generate_msgdef(name, ros_version=2)[0], store.hash_rihs01(name)
        )
    parts = [read_definition(name, "msg")]
    for referenced in description["type_description_msg"]["referenced_type_descriptions"]:
        package, _, kind = referenced["type_name"].partition("/msg/")
        parts.append(
            f"{'=' * 80}\nMSG: {package}/{kind}\n{read_definition(referenced['type_name'], 'msg')}"
        )
    hashes = {entry["type_name"]: entry["hash_string"] for entry in description["type_hashes"]}
    return MessageDefinition(name, "\n".join(parts), hashes[name])


def read_definition(name: str, suffix: str) -> str:
    """Read the definition file of "pkg/msg/Type" or "pkg/srv/Type" that has the given suffix.

    Raises ParameterError if no installed package has the file.
    """
    package, section, kind = name.split("/")
    # The wheels install into the prefix of the interpreter and do not set AMENT_PREFIX_PATH.
    prefixes = [
        *filter(None, os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep)),
        sys.prefix,
    ]
    for prefix in prefixes:
        path = Path(prefix) / "share" / package / section / f"{kind}.{suffix}"
        if path.is_file():
            return path.read_text(encoding="utf-8")
    raise ParameterError(
        f"{name}: no {kind}.{suffix} in {', '.join(prefixes)}; install the package {package}"
    )
