# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Test that the refusal of a route names a value with which it can be flown, and that it can."""

import math
import re
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest
from tests.conftest import REPOSITORY, refusing

from flight_analysis.closed_loop.scenario_library import find_scenario, with_route
from flight_core.parameters import ParameterError
from flight_guidance.feasibility import Performance, flyable, speeds
from flight_guidance.routes.route_file import Waypoint, read_route
from flight_guidance.steering.path import Arc, Line, Route, along, route_outline

CAN = Performance(
    speed=40.0, stall_speed=25.0, bank=math.radians(30.0), roll_rate=0.45, climb=2.5, sink=4.0,
    wind=10.0
)  # fmt: skip
CORNER = (Waypoint(0, 0, 1000), Waypoint(3000, 0, 1050), Waypoint(3000, 3000, 1000))
RADIUS, PERIOD = 580.0, 14.0  # m: (40 + 10)^2 / (g tan(24 deg)) = 572.6; s
# The last line touches the last orbit, so that the corner turns by less than 90 deg.
STRAIGHT = 3000.0 - RADIUS * math.tan((math.pi / 2.0 - math.asin(RADIUS / 3000.0)) / 2.0)


def refusal(
    waypoints: tuple[Waypoint, ...], radius: float = RADIUS, period: float = PERIOD, **can: Any
) -> str:
    with pytest.raises(ParameterError) as error:
        flyable(waypoints, radius, period, CAN._replace(**can))
    return str(error.value)


def number(sentence: str) -> float:
    """Return the number that a sentence says is sufficient."""
    result = re.search(r"at (?:least|most) ([\d.]+)", sentence)
    assert result
    return float(result[1])


def test_route_within_all_limits_gives_legs() -> None:
    first, fillet, second, orbit = flyable(CORNER, RADIUS, PERIOD, CAN).legs
    assert (type(first), type(fillet), type(second), type(orbit)) == (Line, Arc, Line, Arc)
    assert first.end == pytest.approx((STRAIGHT, 0.0))


def test_a_speed_lasts_until_the_next_one() -> None:
    route = (Waypoint(0, 0, 0), Waypoint(1, 0, 0, 45.0), Waypoint(2, 0, 0), Waypoint(3, 0, 0, 35.0))
    assert speeds(route, 40.0) == (40.0, 45.0, 45.0, 35.0)


def test_radius_too_small_for_wind_refused() -> None:
    sentence = refusal(CORNER, radius=400.0)
    assert (
        sentence
        == "guidance.radius: found 400 m, expected at least 573 m at this speed, wind and bank"
    )
    assert flyable(CORNER, number(sentence), PERIOD, CAN)
    assert flyable(CORNER, 400.0, PERIOD, CAN._replace(wind=0.0))  # 40^2 / (g tan(24 deg)) = 366


def test_a_period_below_the_rule_is_refused() -> None:
    sentence = refusal(CORNER, roll_rate=0.15)  # 9.3 * 30 deg / 0.15 = 32.46
    assert (
        sentence
        == "guidance.period: found 14 s, expected at least 32.5 s at this speed, bank and roll rate"
    )
    assert flyable(CORNER, RADIUS, number(sentence), CAN._replace(roll_rate=0.15))


def test_a_speed_below_the_floor_is_refused() -> None:
    slow = (*CORNER[:2], CORNER[2]._replace(speed=28.0))
    sentence = refusal(slow)  # 1.15 * 25 = 28.75
    assert sentence == "route[2].V: found 28 m/s, expected at least 28.8 m/s, the speed floor"
    assert flyable((*CORNER[:2], CORNER[2]._replace(speed=number(sentence))), RADIUS, PERIOD, CAN)


@pytest.mark.parametrize("altitude, side, rate", [(1300.0, "above", 2.5), (700.0, "below", 4.0)])
def test_altitude_beyond_climb_flown_on_circles(altitude: float, side: str, rate: float) -> None:
    """A climb is flown before the leg, and a descent after it.

    So the aircraft stays above what the higher waypoint should avoid.
    """
    route = (
        CORNER[0],
        CORNER[1]._replace(altitude=altitude),
        CORNER[2]._replace(altitude=altitude),
    )
    flown = flyable(route, RADIUS, PERIOD, CAN)
    legs = flown.legs
    (note,) = flown.notes
    reach = math.floor(rate * STRAIGHT / 50.0)  # the straight part, with the wind from behind
    assert note.startswith(
        f"route[1]: 300 m {side} the waypoint before, flown on circles round the waypoint"
    )
    assert note.endswith(f"takes {reach} m")
    circles = [leg for leg in legs[:-1] if isinstance(leg, Arc) and leg.loiter]
    assert [circle.centre for circle in circles] == [route[0 if altitude > 1000.0 else 1].point]
    assert [waypoint.departure for waypoint in flown.waypoints[:2]] == [
        max(altitude, 1000.0),
        altitude,
    ]
    # A scenario writes each waypoint so.
    named = tuple(waypoint._replace(leave=waypoint.altitude) for waypoint in route)
    assert flyable(named, RADIUS, PERIOD, CAN).legs == legs
    within = tuple(
        waypoint._replace(altitude=1000.0 + math.copysign(reach, altitude - 1000.0) * (k > 0))
        for k, waypoint in enumerate(route)
    )
    assert flyable(within, RADIUS, PERIOD, CAN).notes == ()


def test_waypoint_of_short_leg_left_out_where_route_passes_near() -> None:
    """Two corners are 300 m apart, and the one nearer to the line of its neighbours is left out.

    The note has the distance.
    """
    near = (
        Waypoint(0, 0, 0),
        Waypoint(4000, 0, 0),
        Waypoint(4200, 200, 0),
        Waypoint(4200, 4000, 0),
    )
    flown = flyable(near, RADIUS, PERIOD, CAN)
    legs = flown.legs
    (note,) = flown.notes
    assert len(flown.waypoints) == 3
    match = re.search(r"route\[(\d)\]: corner cut, (\d+) m from the waypoint", note)
    assert match
    point = near[int(match[1])].point
    # The drawing leaves out the last orbit.
    drawn = route_outline(Route(legs, (0.0,) * len(legs), (40.0,) * len(legs)))[:-38]
    between = [
        along(*ends, k / 500)
        for ends in pairwise([place[:2] for place in drawn])
        for k in range(501)
    ]
    nearest = min(math.dist(place, point) for place in between)
    assert float(match[2]) == pytest.approx(nearest, abs=2.0)
    far = (Waypoint(0, 0, 0), Waypoint(4000, 0, 0), Waypoint(4000, 600, 0), Waypoint(0, 600, 0))
    assert "route[2]: found 600 m from the waypoint before" in refusal(far)


def test_routes_of_tutorial_are_as_shown(tmp_path: Path) -> None:
    """The triangle of the tutorial is planned.

    The short route is refused with the sentence on the page.
    """
    page = (REPOSITORY / "docs" / "fly-a-route.md").read_text()
    guidance = find_scenario("osprey_route").guidance
    assert guidance is not None
    blocks = re.findall(r"^```yaml\n(.*?)^```$", page, re.MULTILINE | re.DOTALL)
    triangle = tmp_path / "triangle.yaml"
    short = tmp_path / "short.yaml"
    for path, block in zip((triangle, short), blocks, strict=True):
        path.write_text(block)
    assert len(guidance.plan(read_route(triangle)).legs) == 6  # three lines, two fillets, an orbit
    with pytest.raises(ParameterError) as error:
        guidance.plan(read_route(short))
    assert f"error: guidance.{error.value}\n" in page


def test_route_file_replaces_program_of_targets() -> None:
    turns = find_scenario("osprey_route").vary(
        guidance={"program": {"heading": {"start": [2.0], "value": [1.0]}}}
    )
    section = with_route(turns, [Waypoint(0, 0, 0), Waypoint(2000, 0, 10, 26.0)]).guidance
    assert section is not None
    assert section.program == {}
    assert [waypoint.speed for waypoint in section.waypoints()] == [25.0, 26.0]


def test_route_of_scenario_not_checked_where_file_replaces_it(tmp_path: Path) -> None:
    """The scenario's own rectangle is too small for fillets in a wind of 18 m/s."""
    path = tmp_path / "windy.yaml"
    text = find_scenario("osprey_route").path.read_text()
    path.write_text(text.replace("    wind: 3.0", "    wind: 18.0"))
    with refusing(r"guidance\.route\["):
        find_scenario(path)
    scenario = with_route(
        find_scenario(path, with_route=False), [Waypoint(0.0, 0.0, 0.0), Waypoint(3000.0, 0.0, 0.0)]
    )
    assert scenario.guidance is not None
    assert (scenario.guidance.wind, len(scenario.guidance.waypoints())) == (18.0, 2)
