# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Read the items of a MAVLink mission in order of flight (MAVLink guide, MAV_CMD, MAV_FRAME)."""

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

from flight_core.parameters import require
from flight_guidance.routes.route_places import Above, HomePlace, Place, Places

FRAMES = {0: Above.SEA, 5: Above.SEA, 3: Above.HOME, 6: Above.HOME}  # MAV_FRAME
TERRAIN = (10, 11)
# values of MAV_CMD, and of SPEED_TYPE (AIRSPEED)
WAYPOINT = 16
LAND = 21
SPLINE = 82
JUMP = 177
CHANGE_SPEED = 178
AIRSPEED = 0
UNLIMITED, TURNS, TIME, TO_ALTITUDE = LOITERS = 17, 18, 19, 31  # NAV_LOITER_...
COMMANDS = {
    17: "NAV_LOITER_UNLIM",
    18: "NAV_LOITER_TURNS",
    19: "NAV_LOITER_TIME",
    31: "NAV_LOITER_TO_ALT",
    20: "NAV_RETURN_TO_LAUNCH",
    21: "NAV_LAND",
    22: "NAV_TAKEOFF",
    84: "NAV_VTOL_TAKEOFF",
    85: "NAV_VTOL_LAND",
    16: "NAV_WAYPOINT",
    82: "NAV_SPLINE_WAYPOINT",
    93: "NAV_DELAY",
    178: "DO_CHANGE_SPEED",
    177: "DO_JUMP",
    189: "DO_LAND_START",
    206: "DO_SET_CAM_TRIGG_DIST",
    201: "DO_SET_ROI",
    183: "DO_SET_SERVO",
    179: "DO_SET_HOME",
    601: "DO_JUMP_TAG",
    34: "DO_ORBIT",
    35: "DO_FIGURE_EIGHT",
    36: "NAV_ARC_WAYPOINT",
    94: "NAV_PAYLOAD_PLACE",
    5000: "NAV_FENCE_RETURN_POINT",
    5001: "NAV_FENCE_POLYGON_VERTEX_INCLUSION",
    5100: "NAV_RALLY_POINT",
    5002: "NAV_FENCE_POLYGON_VERTEX_EXCLUSION",
    5003: "NAV_FENCE_CIRCLE_INCLUSION",
    5004: "NAV_FENCE_CIRCLE_EXCLUSION",
}
MEANINGS = {
    82: "NAV_SPLINE_WAYPOINT is flown as a corner with a fillet, and not as a spline",
    179: "heights above the home stay above the first home, and not above the home of DO_SET_HOME",
    601: "DO_JUMP_TAG repeats items, which are flown once here",
}
# Commands after which an autopilot flies no further item: endless loiter, return and landings.
LAST = (UNLIMITED, 20, LAND, 85)
OTHER_WAYS = (34, 35, 36, 94)  # other ways to a place, which are no line and no loiter


@dataclass(frozen=True, kw_only=True)
class Item:
    """An item of a mission."""

    name: str  # name with number, such as "NAV_LAND (item 5)"
    frame: int
    command: int
    params: Sequence[Any]  # its seven parameters
    number: Any  # number by which a DO_JUMP names the item
    goes_on: bool = True  # autocontinue; if false, an autopilot waits for the pilot after the item


def named(command: int, number: int) -> str:
    """Return the name of a command, with the number of its item.

    If the command is not in COMMANDS, pymavlink gives its name.
    """
    name = COMMANDS.get(command, f"MAV_CMD {command}")
    if command not in COMMANDS:
        with suppress(ModuleNotFoundError):
            from pymavlink.dialects.v20 import ardupilotmega  # noqa: PLC0415 - an optional dependency

            enum_entry = ardupilotmega.enums["MAV_CMD"].get(command)
            if enum_entry is not None:
                name = f"{enum_entry.name.removeprefix('MAV_CMD_')} ({command})"
    return f"{name} (item {number})"


MOST_ITEMS = 20_000


def _in_order(key: str, items: Sequence[Item]) -> list[int]:
    """Return the positions of the items in the order of flight, up to the first command in LAST.

    Jumps are followed. A DO_JUMP states how often it jumps to its item; a negative number means for
    ever. An endless jump back ends the order. Raises ParameterError for a jump to no item, for a
    loop inside a loop, which PX4 starts again but ArduPilot does not, and for more than MOST_ITEMS
    steps.
    """
    places = {items[k].number: k for k in reversed(range(len(items)))}
    repetitions: dict[int, float] = {}  # remaining repetitions of each jump
    order: list[int] = []
    k = steps = 0
    while k < len(items) and not (order and items[order[-1]].command in LAST):
        place = k
        item = items[place]
        k += 1
        steps += 1
        require(
            steps <= MOST_ITEMS,
            key,
            f"more than {MOST_ITEMS} items by the repetitions of {item.name}",
            "fewer",
        )
        if item.command != JUMP:
            order.append(place)
            continue
        target = item.params[0]
        count = -0.5 if item.params[1] is None else float(item.params[1])
        if not count:
            continue
        require(
            target in places and count.is_integer(),
            key,
            f"{item.name} to {target}",
            "a jump to an item, a whole number of times",
        )
        if count < 0.0 and places[target] <= place:
            break
        remaining = repetitions.get(place, count)
        require(
            count < 0.0 or remaining >= 0.0,
            key,
            f"{item.name}, a loop inside of a loop",
            "loops one after the other",
        )
        repetitions[place] = remaining - 1.0 if count > 0.0 else count
        order.append(place)
        k = places[target] if remaining else k
    return order


def mission_route(
    key: str, items: Sequence[Item], home: HomePlace | None, notes: Sequence[str] = ()
) -> Places:
    """Return the waypoints and loiters of a mission in the order of flight.

    The notes name the items that are not flown.
    """
    places: list[Place] = []
    route_items: set[int] = set()
    circles: list[str] = []  # circles whose radius the mission gives
    speed: Any = None
    for k in _in_order(key, items):
        item = items[k]
        require(item.command not in OTHER_WAYS, key, item.name, "waypoints and loiters")
        before = places[-1] if places and item.command in LOITERS else None
        if item.command in (WAYPOINT, SPLINE, *LOITERS) and (any(item.params[4:6]) or before):
            loiter = {
                TURNS: {"turns": item.params[0]},
                TIME: {"wait": item.params[0]},
                TO_ALTITUDE: {"climbs": True},
            }
            place = _mission_place(key, item, speed, before)._replace(
                **loiter.get(item.command, {})
            )
            # In MAVLink a negative radius means counter-clockwise, and 0 the default radius.
            radius = item.params[1 if item.command == TO_ALTITUDE else 2]
            if item.command in LOITERS and radius:
                place = place._replace(left=radius < 0.0)
                circles.append(f"{abs(radius):g} m of {item.name}")
            places.append(place)
        elif (
            item.command == CHANGE_SPEED
            and item.params[0] == AIRSPEED
            and (item.params[1] or 0) > 0
        ):
            speed = item.params[1]
        elif item.command != JUMP:
            continue
        route_items.add(k)
    # The notes name all items that are not flown, or not flown as in the mission.
    skipped_names = [_skipped_name(item) for k, item in enumerate(items) if k not in route_items]
    sentences = [f"not flown: {', '.join(dict.fromkeys(skipped_names))}"] * bool(skipped_names)
    sentences += [
        sentence
        for command, sentence in MEANINGS.items()
        if any(item.command == command for item in items)
    ]
    waits = [item.name for k, item in enumerate(items) if k in route_items and not item.goes_on]
    sentences += [f"flown on without autocontinue: {', '.join(dict.fromkeys(waits))}"] * bool(waits)
    circle_note = "circles have the radius of the route"
    sentences += [f"{circle_note}, in place of {', '.join(dict.fromkeys(circles))}"] * bool(circles)
    return Places(places, (*notes, *sentences), home)


def _skipped_name(item: Item) -> str:
    """Return the name of an item that is not flown, with a remark if its position is 0, 0."""
    is_place = item.command in (WAYPOINT, SPLINE, *LOITERS)
    nowhere = is_place and not any(item.params[4:6])
    return f"{item.name}, at latitude and longitude 0" if nowhere else item.name


def _mission_place(key: str, item: Item, speed: Any, before: Place | None) -> Place:
    """Return where an item of a mission is; a loiter without a position is at `before`."""
    latitude, longitude, altitude = item.params[4:7]
    if not (latitude or longitude) and before is not None:
        latitude = before.latitude
        longitude = before.longitude
        if not altitude:
            return before._replace(turns=0.0, wait=0.0, climbs=False, left=None, speed=speed)
    frame_text = f"the frame {item.frame}{', above the ground' if item.frame in TERRAIN else ''}"
    expected = "0 or 3: above the sea or the home, for the height of the ground is not known"
    require(item.frame in FRAMES, f"{key}: {item.name}", frame_text, expected)
    return Place(
        key="route",
        latitude=latitude,
        longitude=longitude,
        altitude=altitude,
        speed=speed,
        above=FRAMES[item.frame],
    )
