# SPDX-FileCopyrightText: RISE-DI contributors
# SPDX-License-Identifier: Apache-2.0
"""Test that the legs of a route are flown, or are said to be missed.

Joining circles, tangents and the wind are compared with closed forms of geometry.
"""

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import ArrayLike
from pytest import approx
from scipy.integrate import solve_ivp
from tests.conftest import refusing

from flight_analysis.report.guided import (
    FlownLeg,
    LegResult,
    flown_legs,
    guidance_notices,
    leg_results,
)
from flight_core.rates import nanoseconds
from flight_core.tape import Signal, Tape
from flight_core.units import GRAVITY
from flight_core.vectors import ChannelError, StampedVector
from flight_guidance import guidance_log
from flight_guidance.guidance import Guidance
from flight_guidance.guidance_state import GuidanceMode, Lateral
from flight_guidance.notices import LEARNED
from flight_guidance.params import GuidanceConfig
from flight_guidance.reach import Authority
from flight_guidance.routes.route_file import Waypoint
from flight_guidance.steering import path
from flight_guidance.steering.lateral import (
    PathParams,
    largest_wind,
    least_radius,
    path_acceleration,
)
from flight_guidance.steering.path import Arc, Line
from flight_guidance.steering.wind import WIND_TIME, wind_estimate, wind_of

SPEED, R = 25.0, 144.0  # m/s and m, of the osprey by rule
FOLLOW = PathParams(period=16.5, damping=0.75, capture=math.radians(30.0))
SECTION: dict[str, Any] = {
    "natural_frequency": [4.0, 1.2, 5.0, 4.0],
    "speed": SPEED,
    "throttle_authority": [3.0, 3.0],
}
CONFIG = GuidanceConfig.validate_mapping(SECTION, "guidance")
MS = 1_000_000  # ns


@pytest.mark.parametrize("distance, radius", [(2000.0, 150.0), (2000.0, -150.0), (20e3, 150.0)])
def test_circle_from_afar_joined_on_its_tangent(distance: float, radius: float) -> None:
    """The way to a circle begins with a turn onto its tangent, and ends with an arc."""

    def derivative(_: float, z: Any) -> list[float]:
        north, east, course = map(float, z)
        a = path_acceleration(
            path.error(Arc((distance, 0.0), radius), (north, east)), course, SPEED, FOLLOW
        )
        limit = GRAVITY * math.tan(math.radians(30.0))
        return [
            SPEED * math.cos(course),
            SPEED * math.sin(course),
            min(max(a, -limit), limit) / SPEED,
        ]

    times = np.arange(0.0, distance / SPEED + 60.0, 0.25)
    north, east, course = solve_ivp(
        derivative, (0.0, times[-1]), [0.0, 0.0, 0.0], t_eval=times, max_step=0.25
    ).y
    off = np.hypot(north - distance, east) - abs(radius)
    joined = int(np.flatnonzero(np.abs(off) < 0.05 * abs(radius))[0])
    tangent = math.sqrt(distance**2 - radius**2)
    # 2 s for the turn by asin(R / d), and the last metres of an exponential approach.
    assert times[joined] == approx(tangent / SPEED, abs=4.0)
    bearings = np.unwrap(np.arctan2(east, north - distance))[: joined + 1]
    assert math.degrees(abs(bearings[-1] - bearings[0])) < 90.0  # acos(R / d) of the tangent
    assert off[joined:].max() < 0.05 * abs(radius)
    assert off[joined:].min() > -0.02 * abs(radius)  # no overshoot
    assert math.sin(course[-1] - math.atan2(east[-1], north[-1] - distance)) == approx(
        math.copysign(1.0, radius), abs=1e-3
    )


@pytest.mark.parametrize("last", [(2000.0, 1500.0), (-700.0, 400.0), (1000.0, -600.0)])
def test_last_line_touches_orbit(last: path.Point) -> None:
    before = (1000.0, 0.0)
    legs = path.route([(0.0, 0.0), before, last] if last[0] > 0.0 else [before, last], 200.0, 100.0)
    line, orbit = legs[-2:]
    assert isinstance(line, Line)
    assert isinstance(orbit, Arc)
    error = path.error(line, orbit.centre)
    # The centre is one radius to the right of the line: a clockwise orbit.
    assert error.e == approx(200.0)
    touching = path.error(orbit, line.end)
    assert touching.e == approx(0.0, abs=1e-9)
    assert math.cos(touching.track - error.track) == approx(1.0)


@given(
    sides=st.lists(st.booleans(), min_size=2, max_size=5),
    bearings=st.lists(st.floats(-3.1, 3.1), min_size=4, max_size=4),
    distances=st.lists(st.floats(2.01 * R, 20.0 * R), min_size=4, max_size=4),
)
def test_lines_between_circles_touch_both_on_their_sides(
    sides: list[bool], bearings: list[float], distances: list[float]
) -> None:
    points = [(0.0, 0.0)]
    for bearing, distance, _ in zip(bearings, distances, sides[1:], strict=False):
        north, east = points[-1]
        points.append((north + distance * math.cos(bearing), east + distance * math.sin(bearing)))
    loiters = {k: path.Loiter(turns=1.0) for k in range(len(points) - 1)}
    left = [k for k, is_left in enumerate(sides) if is_left]
    legs = path.route(points, R, 0.9 * R, loiters, left)
    circles, lines = legs[::2], legs[1::2]
    assert [circle.radius < 0.0 for circle in circles if isinstance(circle, Arc)] == sides
    for k, line in enumerate(lines):
        assert isinstance(line, Line)
        course = path.course_of(line.start, line.end)
        for circle, touch in ((circles[k], line.start), (circles[k + 1], line.end)):
            assert isinstance(circle, Arc)
            # The centre of a clockwise circle is one radius to the right, across the course.
            north = circle.centre[0] - touch[0]
            east = circle.centre[1] - touch[1]
            ahead = north * math.cos(course) + east * math.sin(course)
            right = east * math.cos(course) - north * math.sin(course)
            assert (ahead, right) == approx((0.0, circle.radius), abs=1e-6)


@pytest.mark.parametrize("left", [(), (1, 2)])
def test_drawn_circles_turn_to_their_side(left: tuple[int, ...]) -> None:
    points = [(0.0, 0.0), (1000.0, 0.0), (1000.0, 1000.0)]
    legs = path.route(points, R, 0.9 * R, {1: path.Loiter(turns=1.0)}, left)
    start = points[0]
    for leg in legs:
        north, east = np.array(path.outline(leg, start)).T
        assert (north[0], east[0]) == approx(start)
        start = (north[-1], east[-1])
        if isinstance(leg, Arc):
            bearing = np.unwrap(np.arctan2(east - leg.centre[1], north - leg.centre[0]))
            # at least a full turn, clockwise where the bearing from the centre grows
            assert (bearing[-1] - bearing[0]) * (-1.0 if left else 1.0) > 6.28


@pytest.mark.parametrize(
    ("sides", "distance"), [((1, 1), 5.0), ((1, -1), 3.0), ((-1, 1), 4.0), ((0, -1), 3.0)]
)
def test_length_of_a_tangent_is_that_of_its_right_triangle(
    sides: tuple[int, int], distance: float
) -> None:
    line = path.tangent(((0.0, 0.0), (0.0, distance)), 1.0, sides)
    # the offset of the parallel through the other centre is the other leg
    assert path.length(line) == approx(math.sqrt(distance**2 - (sides[1] - sides[0]) ** 2))


@pytest.mark.parametrize(
    ("left", "distance", "sentence"),
    [
        ((1,), 400.0, r"route\[2\]: found 400 m from the loiter before, expected more than 400 m"),
        ((), 200.0, r"route\[2\]: found 200 m from the loiter before, expected more than 200 m"),
    ],
)
def test_overlapping_circles_refused(left: tuple[int, ...], distance: float, sentence: str) -> None:
    points = [(0.0, 0.0), (2000.0, 0.0), (2000.0, distance)]
    with refusing(sentence):
        path.route(points, 200.0, 100.0, {1: path.Loiter(turns=1.0)}, left)


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_way_onto_leg_is_tangent_and_arc(side: float) -> None:
    """The lengths are for the way onto a course to the north at the origin."""
    at = (0.0, 0.0)
    north = 0.0

    def length(position: path.Point, flown: float) -> float:
        return float(path.joining_length(at, north, side * R, position, flown))

    assert length((-1000.0, 0.0), 0.0) == approx(1000.0)  # straight behind
    # On the opposite course beside the circle: down the tangent, and half of the circle.
    assert length((1000.0, side * 2.0 * R), math.pi) == approx(1000.0 + math.pi * R)
    # Across: the circle is touched at the point behind the centre, and a quarter of it is left.
    assert length((-R, side * (R + 1000.0)), -side * math.pi / 2.0) == approx(
        1000.0 + R * math.pi / 2.0
    )
    # A turn to the tangent costs R times the angle.
    assert length((-1000.0, 0.0), 0.5) == approx(1000.0 + 0.5 * R)


def test_wind_is_velocity_over_ground_less_through_air() -> None:
    # 3-4-5: climbing at 3 m/s of 5 m/s, 4 m/s remain level, to the east.
    assert wind_of(1.0, -2.0, 3.0, math.pi / 2.0, 5.0) == approx((1.0, -6.0))
    wind = (0.0, 0.0)
    # A time constant of a step of 20 ms.
    for _ in range(250):
        wind = wind_estimate(wind, (10.0, -5.0), WIND_TIME / 250)
    assert wind == approx((10.0 * (1.0 - math.exp(-1.0)), -5.0 * (1.0 - math.exp(-1.0))))


def test_largest_wind_takes_whole_bank() -> None:
    bank = math.radians(30.0)
    wind = 3.0
    largest = largest_wind(SPEED, wind, bank)
    assert (SPEED + largest) ** 2 / least_radius(SPEED, wind, bank) == approx(
        GRAVITY * math.tan(bank)
    )


@pytest.mark.parametrize(
    "wind, V, sentence",
    [
        (
            30.0,
            (),
            (
                r"route\[0\].V: found 25 m/s in a wind of 30 m/s, expected more than 36 m/s, or a "
                r"guidance.wind below 20.8 m/s"
            ),
        ),
        (
            22.0,
            (30.0, 25.0),
            r"route\[1\].V: found 25 m/s in a wind of 22 m/s, expected more than 26.4 m/s",
        ),
    ],
)
def test_wind_that_airspeed_cannot_beat_refused(
    wind: float, V: tuple[float, ...], sentence: str
) -> None:
    route = {"north": [0.0, 9e3], "east": [0.0, 0.0], "altitude": [0.0, 0.0], "V": V}
    with refusing(sentence):
        GuidanceConfig.validate_mapping(SECTION | {"wind": wind, "route": route}, "guidance")


CORNER = ((0.0, 0.0, 100.0), (2000.0, 0.0, 100.0), (2000.0, 3000.0, 100.0))


class Flown:
    """Guidance on a route, with given poses."""

    def __init__(
        self,
        *waypoints: tuple[Any, ...],
        start: path.Point = (0.0, 0.0),
        config: GuidanceConfig = CONFIG,
    ) -> None:
        self.made = Guidance(config)
        self._k = 0
        self.route = config.plan([Waypoint(*waypoint) for waypoint in waypoints])
        self.made.take_route(self.route)
        self.at(*start)

    def at(
        self, north: float, east: float, course: float = 0.0, altitude: float = 100.0
    ) -> dict[str, float]:
        """Return the log of a step at a position, on a course, rad, through calm air."""
        now = 20 * MS * self._k
        v = (SPEED * math.cos(course), SPEED * math.sin(course))
        self.made.take_pose(
            StampedVector(now, np.array([0.0, 0.0, course, north, east, altitude, *v, 0.0, 0.0])),
            now,
        )
        self.made.take_y(StampedVector(now, np.zeros(4)), now)
        output = self.made.step(now, now)
        assert output is not None
        self._k = self._k + 1
        self.notices = output.notices
        return dict(zip(self.made.names, output.log.tolist(), strict=True))


def test_first_waypoint_has_to_be_reached() -> None:
    """A route behind the aircraft is not passed at the start, because the first leg is joined."""
    flight = Flown((2500.0, 0.0, 150.0), (1200.0, 0.0, 100.0), (1200.0, 1200.0, 100.0))
    log = flight.at(10.0, 0.0)
    assert (log["leg"], log["missed"], abs(log["joining"])) == (0.0, 0.0, 1.0)
    assert log["target.altitude"] == 150.0  # of the first waypoint
    # The centre lies (2490, -R) ahead: a turn by 2 b to the tangent, b = atan(R / 2490), the
    # tangent, and an arc of pi + 2 b.
    assert log["to_go"] == approx(2490.0 + R * (math.pi + 4.0 * math.atan(R / 2490.0)))
    log = flight.at(2499.0, 3.0, math.pi)
    assert (log["leg"], log["joining"]) == (0.0, 0.0)
    assert log["target.altitude"] == approx(150.0, abs=0.1)  # at the begin of the slope


def test_leg_after_sharp_corner_is_joined() -> None:
    """A corner of 174 deg has no fillet.

    The aircraft passes the waypoint, and a circle leads it onto the leg back.
    """
    flight = Flown(
        (0.0, 0.0, 100.0), (1000.0, 0.0, 100.0), (-600.0, 160.0, 100.0), (-600.0, 2000.0, 100.0)
    )
    assert flight.at(990.0, 3.0)["leg"] == 0.0
    log = flight.at(1001.0, 3.0)
    assert (log["leg"], log["missed"], abs(log["joining"])) == (1.0, 0.0, 1.0)
    back = math.atan2(160.0, -1600.0)
    assert flight.at(1000.0 + 5.0 * math.cos(back), 5.0 * math.sin(back), back)["joining"] == 0.0


def test_leg_passed_far_away_is_missed() -> None:
    flight = Flown(
        (0.0, 0.0, 100.0), (1000.0, 0.0, 100.0), (3000.0, 50.0, 100.0), (5000.0, 0.0, 100.0)
    )
    assert flight.at(990.0, 600.0)["leg"] == 0.0
    log = flight.at(1010.0, 600.0)
    end = flight.route.legs[0].end
    assert end is not None
    assert log["missed"] == approx(math.dist(end, (1010.0, 600.0)))
    assert (log["leg"], abs(log["joining"])) == (1.0, 1.0)
    assert flight.notices == (f"leg 0 missed by {log['missed']:.0f} m",)
    assert flight.at(1011.0, 600.0)["missed"] == 0.0


def test_leg_passed_near_is_flown() -> None:
    flight = Flown((0.0, 0.0, 100.0), (1000.0, 0.0, 100.0), (1000.0, 2000.0, 100.0))
    flight.at(5.0, 0.0)
    end = flight.route.legs[0].end
    assert end is not None
    log = flight.at(end[0] + 1.0, 0.9 * R)
    assert (log["leg"], log["missed"], log["joining"]) == (1.0, 0.0, 0.0)


def test_leg_joined_at_a_point_along_it() -> None:
    flight = Flown(*CORNER)
    flight.made.take_target({"leg": 0.0, "along": 900.0})
    log = flight.at(0.0, 500.0)
    assert (log["target.along"], abs(log["joining"])) == (900.0, 1.0)
    assert flight.at(905.0, 10.0)["joining"] == 0.0
    for values, sentence in (
        (
            {"leg": 0.0, "along": 2500.0},
            "target.along: found 2500 m, expected 0 to 1[0-9.]* m, the length of the leg",
        ),
        ({"along": 10.0}, "found along without leg"),
    ):
        with pytest.raises(ChannelError, match=sentence):
            flight.made.take_target(values)


def test_skip_leaves_waypoint_ahead_out() -> None:
    flight = Flown(*CORNER, (0.0, 3000.0, 100.0))
    assert flight.made.skip()
    log = flight.at(100.0, 0.0)
    assert log["leg"] == 2.0  # the line after the fillet
    assert log["target.along"] == approx(path.length(flight.route.legs[2]))


def test_resume_flies_last_leg_from_nearest_point() -> None:
    flight = Flown(*CORNER)
    assert not flight.made.resume()  # the route is flown
    assert flight.made.hold()
    assert flight.at(700.0, 400.0)["mode.lateral"] == Lateral.HEADING
    assert flight.made.resume()
    log = flight.at(701.0, 400.0)
    assert (log["mode.lateral"], log["leg"], log["target.along"]) == (Lateral.ROUTE, 0.0, 700.0)


@pytest.mark.parametrize("profile", ["slope", "step"])
def test_altitude_changes_along_leg_or_at_its_begin(profile: str) -> None:
    config = GuidanceConfig.validate_mapping(SECTION | {"profile": profile}, "guidance")
    flight = Flown((0.0, 0.0, 100.0), (2000.0, 0.0, 140.0), (4000.0, 0.0, 140.0), config=config)
    log = flight.at(500.0, 5.0)
    if profile == "step":
        assert (log["target.altitude"], log["target.climb"]) == (140.0, 0.0)
    else:
        # The last line touches the orbit: the legs meet at an angle of 4 deg.
        assert log["target.altitude"] == approx(110.0, abs=0.1)
        assert log["target.climb"] == approx(40.0 / 2000.0 * SPEED, abs=0.01)
    assert flight.made.hold()
    assert flight.at(520.0, 5.0)["target.altitude"] == 100.0
    flight.made.take_target({"leg": 0.0, "altitude": 120.0})
    # A command of the user holds on the leg.
    assert flight.at(540.0, 5.0)["target.altitude"] == 120.0
    assert flight.at(560.0, 5.0)["target.altitude"] == 120.0


def circling(
    flown: Flown, centre: path.Point, turns: float, altitude: float = 100.0, first: float = -90.0
) -> dict[str, float]:
    """Return the log after steps of a clockwise flight around a centre.

    The flight begins at a bearing of the centre in deg.
    """
    log: dict[str, float] = {}
    step = SPEED * 0.02 / R
    for k in range(1, int(turns * 2.0 * math.pi / step) + 1):
        bearing = math.radians(first) + k * step
        place = (centre[0] + R * math.cos(bearing), centre[1] + R * math.sin(bearing))
        log = flown.at(*place, bearing + math.pi / 2.0, altitude)
        if log["leg"] != 1.0:
            break
    return log


@pytest.mark.parametrize("turns, wait", [(2.0, 0.0), (0.0, 60.0), (0.5, 60.0)])
def test_loiter_ends_after_its_turns_or_wait(turns: float, wait: float) -> None:
    """The route continues to the north.

    A circle takes 2 pi R / V = 36 s, and the aircraft leaves it in the west.
    """
    centre = (2000.0, 0.0)
    flight = Flown((0.0, 0.0, 100.0), (*centre, 100.0, None, turns, wait), (5000.0, -R, 100.0))
    circle = flight.route.legs[1]
    # The last line touches the orbit round the last waypoint.
    assert circle.end == approx((2000.0, -R), abs=10.0)
    end = flight.route.legs[0].end
    assert end is not None
    assert flight.at(end[0] + 0.5, end[1], path.end_course(flight.route.legs[0]))["leg"] == 1.0
    half = circling(flight, centre, max(turns, wait / 36.2) - 0.5)
    assert 0.5 < half["loitered"] < 1.0
    flight.at(*end, path.end_course(flight.route.legs[0]))
    log = circling(flight, centre, 2.0, first=math.degrees(path.course_of(centre, end)))
    assert log["leg"] == 2.0


def test_steep_leg_begins_with_circle_that_is_left_at_altitude() -> None:
    flight = Flown(
        (0.0, 0.0, 100.0), (1500.0, 0.0, 400.0), (1500.0, 2500.0, 400.0), start=(0.0, -R)
    )
    assert "flown on circles round the waypoint before" in flight.notices[0]
    circle = flight.route.legs[0]
    assert (isinstance(circle, Arc), flight.at(0.0, -R + 1.0)["target.altitude"]) == (True, 400.0)
    assert circle.end is not None
    course = path.end_course(circle)
    assert flight.at(circle.end[0] + 1.0, circle.end[1], course, 300.0)["leg"] == 0.0
    beyond = (circle.end[0] + 25.0 * math.cos(course), circle.end[1] + 25.0 * math.sin(course))
    assert flight.at(*beyond, course, 396.0)["leg"] == 0.0  # too late to leave: another turn
    assert flight.at(circle.end[0] + 1.0, circle.end[1], course, 396.0)["leg"] == 1.0


def test_yaw_rate_beside_bank() -> None:
    flight = Flown((0.0, 0.0, 100.0), (5000.0, 0.0, 100.0))
    flight.made.take_target({"phi": 0.0, "r": 0.05})
    for k in range(50):
        log = flight.at(10.0 + k, 0.0)
    assert log["u_m.r"] == approx(0.05)
    flight.made.take_target({"heading": 0.0})
    assert flight.at(70.0, 0.0)["target.r"] == 0.0
    for values, sentence in (
        ({"r": 0.1}, "found r without phi"),
        ({"phi": 0.0, "r": 0.5}, "expected -12.9[0-9]* to 12.9[0-9]* deg/s"),
    ):
        with pytest.raises(ChannelError, match=sentence):
            flight.made.take_target(values)


def log_of(count: int, **channels: ArrayLike) -> Tape:
    """Return a log of guidance on a route to the north with one sample per second.

    In a name, `_` stands for a dot.
    """
    names = guidance_log.names(CONFIG.outputs)
    level: dict[str, Any] = (
        dict.fromkeys(names, 0.0)
        | dict(zip(LEARNED, Authority(), strict=True))
        | {
            "mode": GuidanceMode.ENGAGED,
            "mode.lateral": Lateral.ROUTE,
            "V_c": SPEED,
            "pose.v_north": SPEED,
        }
    )
    level |= {name.replace("__", "."): value for name, value in channels.items()}
    values = np.column_stack(
        [np.broadcast_to(np.asarray(level[name], dtype=float), count) for name in names]
    )
    return Tape({"guidance": Signal(np.arange(count) * nanoseconds(1.0), names, values)}, 0)


def test_summary_says_which_legs_were_flown() -> None:
    tape = log_of(
        10,
        leg=[0, 0, 0, 1, 1, 2, 2, 2, 2, 2],
        joining=[1, 1, 0, 0, 0, 0, 0, 0, 0, 0],
        missed=[0] * 5 + [321.0] + [0] * 4,
    )
    assert flown_legs(tape) == [
        FlownLeg(leg=0, start=0.0, joined=2.0, stop=3.0, result=LegResult.FLOWN, missed=0.0),
        FlownLeg(leg=1, start=3.0, joined=3.0, stop=5.0, result=LegResult.MISSED, missed=321.0),
        FlownLeg(leg=2, start=5.0, joined=5.0, stop=9.0, result=LegResult.NOT_ENDED, missed=0.0),
    ]
    assert guidance_notices(tape, CONFIG) == ["guidance at t = 5.0 s: leg 1 missed by 321 m"]
    assert (
        leg_results([leg._asdict() for leg in flown_legs(tape)])
        == "legs: 0 flown, 1 missed by 321 m, 2 not ended"
    )
