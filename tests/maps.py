# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Provide channel maps by name, from the library of the bridge and from examples/maps."""

from pathlib import Path

from tests.conftest import REPOSITORY

from autopilot_bridge.params import LIBRARY, ChannelMap, load_map

EXAMPLE_MAPS = REPOSITORY / "examples" / "maps"
MAP_FILES: dict[str, Path] = {
    path.stem: path for folder in (LIBRARY, EXAMPLE_MAPS) for path in sorted(folder.glob("*.yaml"))
}


def named_map(name: str) -> ChannelMap:
    """Return the map with a name, from the library or from the examples."""
    return load_map(str(MAP_FILES[name]))
