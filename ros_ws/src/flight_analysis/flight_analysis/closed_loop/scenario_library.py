# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Find the scenarios that ship with this package, give them a route, and save them."""

from collections.abc import Mapping, Sequence
from importlib.resources import files
from pathlib import Path
from types import MappingProxyType
from typing import Any

from flight_analysis.closed_loop.scenario import (
    SCHEMAS,
    Scenario,
    find_files,
    load_scenario,
    parse_scenario_sections,
    scenario_yaml,
)
from flight_core.arguments import FilePath
from flight_core.files import find_file, names_in, read_file, write_file, writing
from flight_core.parameters import ParameterError, require
from flight_core.scenario_file import (
    A_SCENARIO,
    has_general,
    join_parameters,
    parse_sections,
    section_names,
)
from flight_guidance.feasibility import speeds
from flight_guidance.routes.route_file import Waypoint

LIBRARY = Path(str(files("flight_analysis"))) / "scenarios"


def scenarios() -> list[str]:
    """List the names of the scenarios in LIBRARY.

    Returns:
        The names, sorted.

    Examples:
        >>> "osprey_servo" in rise_di.scenarios()
        True
    """
    return names_in(LIBRARY)


def find_scenario(
    name: FilePath | Scenario, duration: float | None = None, *, with_route: bool = True
) -> Scenario:
    """Find a scenario by its name in LIBRARY, or read it from its .yaml file.

    Args:
        name: Name in the library, path of a scenario file (.yaml), or a Scenario.
        duration: Duration of the flight, s. If None, the duration in the file stays.
        with_route: Whether guidance keeps the route and the program of targets of the file.

    Returns:
        The scenario, read and validated. If `name` is a Scenario, only its duration can change.

    Raises:
        ParameterError: No scenario has the name, or the file is invalid.

    Examples:
        >>> rise_di.find_scenario("osprey_servo", duration=2.0).flight.duration
        2.0
    """
    if isinstance(name, Scenario):
        scenario = name
    else:
        path = find_file(name, LIBRARY, "scenario", A_SCENARIO).absolute()
        scenario = load_scenario(path, with_route=with_route)
    return scenario if duration is None else scenario.vary(flight={"duration": duration})


def with_route(
    scenario: Scenario,
    waypoints: Sequence[Waypoint],
    fence: Mapping[str, Any] = MappingProxyType({}),
) -> Scenario:
    """Return the scenario with a route that guidance flies from the start.

    The new route replaces the scenario's own route and program of targets. `fence` has further
    parameters of guidance, such as the result of `read_fence_file`. Raises ParameterError if the
    route cannot be flown.
    """
    leg_speeds = speeds(waypoints, scenario.aircraft.channels().speed)
    route: dict[str, list[Any]] = {
        "north": [waypoint.north for waypoint in waypoints],
        "east": [waypoint.east for waypoint in waypoints],
        "altitude": [waypoint.altitude for waypoint in waypoints],
        "V": list(leg_speeds),
        "turns": [waypoint.turns for waypoint in waypoints],
        "wait": [waypoint.wait for waypoint in waypoints],
        "leave": [waypoint.departure for waypoint in waypoints],
        "left": [bool(waypoint.left) for waypoint in waypoints],
    }
    optional = {"turns", "wait", "left"}
    route = {key: values for key, values in route.items() if key not in optional or any(values)}
    if route["leave"] == route["altitude"]:
        del route["leave"]
    return scenario.vary(guidance={"route": route, "program": {}, **fence})


def as_flown(scenario: Scenario, run: Path, namespace: str = "") -> Scenario:
    """Return the scenario with a parameter file that the nodes in a namespace can read.

    The scenario keeps its own file if the nodes read the same values from it. If this file names
    recorded commands, or has sections for another namespace, such as /uav7/controller, a new file
    is written into the folder `run`. The new file has sections for any namespace. It holds the
    values of the recorded commands, so that the flight can be repeated without a second file.
    Raises ParameterError if the new file cannot be written.
    """
    if not scenario.reference_model.recorded and _is_for_nodes(scenario.path, namespace):
        return scenario
    return save_scenario(scenario, run / f"{scenario.name}.yaml")


def with_parameters(scenario: Scenario, path: Path, namespace: str) -> Scenario:
    """Return the scenario with the values of a ROS parameter file in place of its own.

    Sections of the file for nodes outside `namespace` are ignored. Raises ParameterError if a value
    is invalid. The message names the parameter file, because the scenario was valid before.
    """
    content = read_file(path, str(path), "a ROS parameter file")
    further = parse_sections(content, path, SCHEMAS, tuple(SCHEMAS), namespace, with_general=True)
    require(
        bool(further),
        str(path),
        f"sections for {', '.join(section_names(content, path)) or 'no node'}",
        f"a section for a node in {namespace or 'the root namespace'}, as {namespace}/controller",
    )
    find_files(further, path)
    sections = {}
    for name, changes in further.items():
        section = getattr(scenario, name)
        if section is not None:
            values = section.model_dump()
            join_parameters(values, changes)
            sections[name] = values
        elif name in parse_sections(content, path, SCHEMAS, tuple(SCHEMAS), namespace):
            sections[name] = changes
    try:
        return scenario.vary(**sections)
    except ParameterError as error:
        raise ParameterError(f"{path.name}: {error}") from None


def _is_for_nodes(path: Path, namespace: str) -> bool:
    """Return whether the nodes in a namespace read all values of a scenario file.

    Each section of the file must be for one of these nodes. If the file has a section for all
    nodes, the result is False. With such a file, rcl would put the overrides of a node into the
    section for all nodes, and the node's own section would then replace the overrides.
    """
    content = read_file(path, str(path), A_SCENARIO)
    if has_general(content, path):
        return False
    try:
        return parse_scenario_sections(content, path, namespace) == parse_scenario_sections(
            content, path
        )
    except ParameterError:
        return False


def save_scenario(scenario: Scenario, path: Path) -> Scenario:
    """Save a scenario as a new file, and return the scenario that is read from this file.

    Raises ParameterError if the file cannot be written.
    """
    with writing("", path):
        write_file(path, scenario_yaml(scenario))
    return load_scenario(path)
